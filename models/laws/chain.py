"""The law of a trajectory as a hidden Markov chain over pairs, and exact inference in it.

Behaviour is ``p0(s_0) prod_t pi(a_t | s_t) P(s_{t+1} | s_t, a_t)``; evidence multiplies it step by step.
Policy and evidence enter only through their product, the factors ``log pi(a | s) + log e_t(s, a)`` given
as ``[L, S, A]``. One pass costs ``O(L S A B)``. Each step is normalised, so long trajectories cannot
underflow.

Passes use plain probabilities, three times as fast as logarithms, and detect states so unlikely that a
double may lose them. If later evidence may favour such a state, the passes are repeated with logarithms:
results are exact however unlikely the truth is.

Functions take one trajectory; those named ``_all`` take many ``[n, ...]``. Use these for many: ``vmap`` of
the others would make both passes every time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..inputs.display import shown_briefly
from ..process.mdp import TabularMDP

Passed = TypeVar("Passed", bound=tuple)

# A possible pair with a smaller share of its step's probability, or a transition of smaller probability, may
# be lost to rounding: products of two such numbers and of a message leave the range of doubles.
_SMALL = 1e-140
# A loss matters only if the later evidence falls short by at least this many nats. Below, the lost mass is
# less than 1e-16 of the posterior (1e-140 e^250 = 3e-32).
_DISAPPOINTED = 250.0
# Smaller numbers have infinite reciprocals.
_TINY = 1e-300


@shown_briefly
class Filtered(NamedTuple):
    """Forward pass over one trajectory.

    ``log_likelihood``: log-probability of the evidence, ``-inf`` if it is impossible.
    ``log_predicted[t, s] = log P(s_t = s | evidence before t)``.
    ``final[s]``: distribution of the state after the last step, given all evidence.
    """

    log_likelihood: Float[Array, ""]
    log_predicted: Float[Array, "L S"]
    final: Float[Array, " S"]


@shown_briefly
class Smoothed(NamedTuple):
    """Forward-backward pass over one trajectory.

    ``pairs[t, s, a] = P(s_t = s, a_t = a | all evidence)``, zero beyond the trajectory's end; also the
    gradient of ``log_likelihood`` in the factors. ``log_likelihood``, ``final``: as in :class:`Filtered`.
    """

    log_likelihood: Float[Array, ""]
    pairs: Float[Array, "L S A"]
    final: Float[Array, " S"]


@shown_briefly
class SmoothedTransitions(NamedTuple):
    """Forward-backward pass with the transitions, ``P(s_t, a_t, s_{t+1} | all evidence)``.

    After the last step the successor follows the dynamics.
    """

    log_likelihood: Float[Array, ""]
    transitions: Float[Array, "L S A B"]


def filter_all(mdp: TabularMDP, factors: Float[Array, "n L S A"], live: Bool[Array, "n L"]) -> Filtered:
    """Run forward passes; ``live`` is false on padding. Differentiable in factors, transitions and ``p0``."""
    return _exactly(_filtered, _filtered_in_logs, mdp, factors, live)


def smooth_all(mdp: TabularMDP, factors: Float[Array, "n L S A"], live: Bool[Array, "n L"]) -> Smoothed:
    """Run forward-backward passes (the exact E-step, replacing the MCMC of Algorithm 1)."""
    return _exactly(_smoothed, _smoothed_in_logs, mdp, factors, live)


def smooth_transitions_all(
    mdp: TabularMDP, factors: Float[Array, "n L S A"], live: Bool[Array, "n L"]
) -> SmoothedTransitions:
    """Run forward-backward passes and return the transitions."""
    return _exactly(_transitions, _transitions_in_logs, mdp, factors, live)


def filter_forward(mdp: TabularMDP, factors: Float[Array, "L S A"], live: Bool[Array, " L"]) -> Filtered:
    """Run :func:`filter_all` on one trajectory."""
    return jax.tree.map(lambda x: x[0], filter_all(mdp, factors[None], live[None]))


def smooth(mdp: TabularMDP, factors: Float[Array, "L S A"], live: Bool[Array, " L"]) -> Smoothed:
    """Run :func:`smooth_all` on one trajectory."""
    return jax.tree.map(lambda x: x[0], smooth_all(mdp, factors[None], live[None]))


def condition(
    mdp: TabularMDP, belief: Float[Array, " S"], factors: Float[Array, "S A"]
) -> Float[Array, " S"]:
    """Return the distribution of the next state after one step; zeros if the factors are impossible."""
    return mdp.push_forward(_shares(_weigh(belief, factors)[0]))


def sample_backward(
    key: Array, mdp: TabularMDP, factors: Float[Array, "L S A"], filtered: Filtered, live: Bool[Array, " L"]
) -> tuple[Int[Array, " L"], Int[Array, " L"]]:
    """Draw one completion (states, actions) from the exact joint posterior; -1 beyond the end."""
    n_actions = mdp.n_actions

    def step(carry: tuple, inputs: tuple) -> tuple:
        following, known = carry
        key, before, factor, alive = inputs
        onward = jnp.where(known, jnp.log(mdp.transition_probability(following)), 0.0)
        flat = jax.random.categorical(key, (before[:, None] + factor + onward).reshape(-1))
        state, action = flat // n_actions, flat % n_actions
        carry = (jnp.where(alive, state, following), known | alive)
        return carry, (jnp.where(alive, state, -1), jnp.where(alive, action, -1))

    keys = jax.random.split(key, factors.shape[0])
    start = (jnp.array(0), jnp.array(False))
    return lax.scan(step, start, (keys, filtered.log_predicted, factors, live), reverse=True)[1]


def _exactly(
    complete: Callable[..., Passed],
    in_logs: Callable[..., Passed],
    mdp: TabularMDP,
    factors: Float[Array, "n L S A"],
    live: Bool[Array, "n L"],
) -> Passed:
    """Run passes in plain numbers, and again in logarithms for trajectories with a loss that matters."""
    every = partial(jax.vmap, in_axes=(None, 0, 0))
    forward = every(_forward)(mdp, factors, live)

    # A derivative stores only the arguments: the branch of logarithms is hardly ever computed.
    again = jax.checkpoint(every(in_logs))

    # Outside the branches, so that it is compiled once.
    plain = jax.vmap(complete, (None, 0, 0, 0))(mdp, factors, live, forward)

    def repaired() -> Passed:
        def chosen(x: Array, y: Array) -> Array:
            return jnp.where(forward.lost.reshape(-1, *[1] * (x.ndim - 1)), x, y)

        return jax.tree.map(chosen, again(mdp, factors, live), plain)

    return lax.cond(_any(lax.stop_gradient(forward.lost)), repaired, lambda: plain)


@jax.custom_batching.custom_vmap
def _any(lost: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Return one answer for all problems under ``vmap``: with one each, both branches would be computed."""
    return jnp.any(lost)


@_any.def_vmap
def _any_of_all(axis_size: int, in_batched: list[bool], lost: Bool[Array, "..."]) -> tuple[Array, bool]:
    return _any(lost), False


# -- in plain numbers -----------------------------------------------------------------------------------


class _Forward(NamedTuple):
    """Forward pass in plain numbers; ``lost`` marks a loss to rounding that may matter."""

    log_likelihood: Float[Array, ""]
    predicted: Float[Array, "L S"]
    final: Float[Array, " S"]
    lost: Bool[Array, ""]


def _bounded_exp(x: Array) -> Array:
    """Compute ``exp(min(x, 0))`` with the derivative of ``exp`` at 0, which ``jnp.minimum`` would halve."""
    return jnp.exp(jnp.where(x > 0, 0.0, x))


def _weigh(predicted: Float[Array, " S"], factors: Float[Array, "S A"]) -> tuple[Array, Array, Array]:
    """Return the joint of one step in linear scale, its sum, and the logarithm of its scale."""
    possible = jnp.where(predicted[:, None] > 0, factors, -jnp.inf)
    scale = lax.stop_gradient(jnp.max(possible))
    scale = jnp.where(jnp.isfinite(scale), scale, 0.0)
    joint = predicted[:, None] * _bounded_exp(factors - scale)
    return joint, jnp.sum(joint), scale


def _forward(mdp: TabularMDP, factors: Float[Array, "L S A"], live: Bool[Array, " L"]) -> _Forward:
    def step(carry: tuple, inputs: tuple) -> tuple:
        predicted, total, ratio = carry
        factor, alive = inputs
        joint, norm, scale = _weigh(predicted, factor)
        # Constant to a derivative, which then is that of the last norm alone: quotients of small norms would
        # leave the range of doubles.
        constant = lax.stop_gradient(norm)
        possible = constant > _TINY
        safe = jnp.where(possible, constant, 1.0)
        log_norm = jnp.where(possible, jnp.log(safe) + scale, -jnp.inf)
        # Divided before the push: a rare transition from an unlikely state would be lost.
        following = jnp.where(possible, mdp.push_forward(joint / safe), 0.0)
        carry = (
            jnp.where(alive, following, predicted),
            total + jnp.where(alive, log_norm, 0.0),
            jnp.where(alive, norm / safe, ratio),
        )
        return carry, (predicted, log_norm)

    passed: tuple = lax.scan(step, (mdp.initial, jnp.zeros(()), jnp.ones(())), (factors, live))
    (final, total, ratio), (predicted, log_norms) = passed
    lost = _lost(*lax.stop_gradient((mdp, factors, live, predicted, log_norms)))
    return _Forward(total + _log(ratio), predicted, _shares(final), lost)


def _lost(
    mdp: TabularMDP,
    factors: Float[Array, "L S A"],
    live: Bool[Array, " L"],
    predicted: Float[Array, "L S"],
    log_norms: Float[Array, " L"],
) -> Bool[Array, ""]:
    """Return whether a forward pass may have lost a state that later evidence favours."""
    rarest = jnp.min(jnp.where(predicted > 0, predicted, 1.0), 1)
    lowest = jnp.min(jnp.where(factors > -jnp.inf, factors, jnp.inf), (1, 2))
    # Lower bound of the least likely pair's share of its step's probability.
    risky = live & (jnp.log(rarest) + lowest - log_norms < math.log(_SMALL))
    given = (mdp.initial, mdp.probabilities)
    rare = sum(jnp.any((x > 0) & (x < _SMALL)) for x in given) > 0
    before = jnp.cumsum(risky) - risky > 0
    # A lost state raises the probability of the evidence by the best of the factors at most.
    short = jnp.where(live & (before | rare), jnp.max(factors, (1, 2)) - log_norms, 0.0)
    # NaN in the factors is NaN in logarithms too.
    return jnp.sum(short) > _DISAPPOINTED


def _filtered(mdp: TabularMDP, factors: Array, live: Array, passed: _Forward) -> Filtered:
    return Filtered(passed.log_likelihood, _log(passed.predicted), passed.final)


def _smoothed(mdp: TabularMDP, factors: Array, live: Array, passed: _Forward) -> Smoothed:
    def step(future: Float[Array, " S"], inputs: tuple) -> tuple:
        predicted, factor, alive = inputs
        joint, _, scale = _weigh(predicted, factor)
        onward = mdp.expect_next(future)
        message = _message(predicted, factor - scale, onward)
        return jnp.where(alive, message, future), jnp.where(alive, _shares(_shares(joint) * onward), 0.0)

    pairs = _back(mdp, step, passed.predicted, factors, live)
    return Smoothed(passed.log_likelihood, pairs, passed.final)


def _transitions(mdp: TabularMDP, factors: Array, live: Array, passed: _Forward) -> SmoothedTransitions:
    def step(future: Float[Array, " S"], inputs: tuple) -> tuple:
        predicted, factor, alive = inputs
        joint, _, scale = _weigh(predicted, factor)
        onward = mdp.probabilities * future[mdp.successors]
        message = _message(predicted, factor - scale, jnp.sum(onward, -1))
        pairs = _shares(joint)[..., None]
        return jnp.where(alive, message, future), jnp.where(alive, _shares(pairs * onward), 0.0)

    triples = _back(mdp, step, passed.predicted, factors, live)
    return SmoothedTransitions(passed.log_likelihood, triples)


def _back(mdp: TabularMDP, step: Callable, *inputs: Array) -> Array:
    return lax.scan(step, jnp.ones(mdp.n_states), inputs, reverse=True)[1]


def _message(
    predicted: Float[Array, " S"], factors: Float[Array, "S A"], onward: Float[Array, "S A"]
) -> Float[Array, " S"]:
    # Only states that can occur matter: messages of the others would grow without bound.
    message = jnp.where(predicted > 0, jnp.sum(_bounded_exp(factors) * onward, axis=1), 0.0)
    # The common scale cancels in the posterior.
    return message / jnp.maximum(lax.stop_gradient(jnp.max(message)), _TINY)


def _shares(joint: Array) -> Array:
    constant = lax.stop_gradient(jnp.sum(joint))
    plain = joint / jnp.where(constant > _TINY, constant, 1.0)
    return plain / jnp.where(constant > _TINY, jnp.sum(plain), 1.0)


# -- in logarithms --------------------------------------------------------------------------------------


def _log(x: Array) -> Array:
    """Take the logarithm with ``log 0 = -inf`` and a zero, not NaN, gradient there."""
    return jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1.0)), -jnp.inf)


def _log_sum(logs: Array, axis: int | tuple[int, ...], weights: Array | float = 1.0) -> Array:
    """Compute ``log sum weights exp(logs)``; ``-inf`` with a zero gradient for an empty sum."""
    top = lax.stop_gradient(jnp.max(jnp.where(weights > 0, logs, -jnp.inf), axis, keepdims=True))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    return _log(jnp.sum(weights * _bounded_exp(logs - top), axis)) + jnp.squeeze(top, axis)


def _push_logs(mdp: TabularMDP, pairs: Float[Array, "S A"]) -> Float[Array, " S"]:
    if mdp.inflow_pairs is not None and (inflow := mdp.inflow_probabilities) is not None:
        return _log_sum(pairs.reshape(-1)[mdp.inflow_pairs], 1, inflow)
    flow = (pairs[..., None] + _log(mdp.probabilities)).reshape(-1)
    to, n = mdp.successors.reshape(-1), mdp.n_states
    top = lax.stop_gradient(jax.ops.segment_max(flow, to, n))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    return _log(jax.ops.segment_sum(_bounded_exp(flow - top[to]), to, n)) + top


def _forward_in_logs(mdp: TabularMDP, factors: Array, live: Array) -> tuple[Array, Array, Array]:
    def step(carry: tuple, inputs: tuple) -> tuple:
        predicted, total = carry
        factor, alive = inputs
        joint = predicted[:, None] + factor
        log_norm = _log_sum(joint, (0, 1))
        following = _push_logs(mdp, joint) - jnp.where(log_norm > -jnp.inf, log_norm, 0.0)
        carry = (jnp.where(alive, following, predicted), total + jnp.where(alive, log_norm, 0.0))
        return carry, predicted

    passed: tuple = lax.scan(step, (_log(mdp.initial), jnp.zeros(())), (factors, live))
    (final, total), predicted = passed
    return total, predicted, final


def _filtered_in_logs(mdp: TabularMDP, factors: Array, live: Array) -> Filtered:
    total, predicted, final = _forward_in_logs(mdp, factors, live)
    return Filtered(total, predicted, jnp.exp(final))


def _backward_in_logs(
    mdp: TabularMDP, keep: Callable[..., Array], predicted: Array, factors: Array, live: Array
) -> Array:
    def step(future: Float[Array, " S"], inputs: tuple) -> tuple:
        before, factor, alive = inputs
        each = future[mdp.successors]
        onward = _log_sum(each, 2, mdp.probabilities)
        weights = factor + onward
        joint = before[:, None] + weights
        total = _log_sum(joint, (0, 1))
        pairs = jnp.exp(joint - jnp.where(total > -jnp.inf, total, 0.0))
        message = _log_sum(weights, 1)
        highest = jnp.max(message)
        message = message - jnp.where(jnp.isfinite(highest), highest, 0.0)
        return jnp.where(alive, message, future), jnp.where(alive, keep(pairs, each, onward), 0.0)

    return lax.scan(step, jnp.zeros(mdp.n_states), (predicted, factors, live), reverse=True)[1]


def _smoothed_in_logs(mdp: TabularMDP, factors: Array, live: Array) -> Smoothed:
    total, predicted, final = _forward_in_logs(mdp, factors, live)
    pairs = _backward_in_logs(mdp, lambda pairs, each, onward: pairs, predicted, factors, live)
    return Smoothed(total, pairs, jnp.exp(final))


def _transitions_in_logs(mdp: TabularMDP, factors: Array, live: Array) -> SmoothedTransitions:
    def shared(pairs: Array, each: Array, onward: Array) -> Array:
        above = jnp.where(onward > -jnp.inf, onward, 0.0)[..., None]
        return pairs[..., None] * mdp.probabilities * _bounded_exp(each - above)

    total, predicted, _ = _forward_in_logs(mdp, factors, live)
    return SmoothedTransitions(total, _backward_in_logs(mdp, shared, predicted, factors, live))
