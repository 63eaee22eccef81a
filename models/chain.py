"""The law of a trajectory as a hidden Markov chain over pairs, and exact inference in it.

Behaviour is ``p0(s_0) prod_t pi(a_t | s_t) P(s_{t+1} | s_t, a_t)``; evidence multiplies it step by step.
Policy and evidence enter only through their product, the factors ``log pi(a | s) + log e_t(s, a)`` given
as ``[L, S, A]``. One pass costs ``O(L S A B)``. Each step is normalised, so length never underflows; a
state less than 1e-308 times as likely as all that is known of its step counts as impossible.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .mdp import TabularMDP


class Filtered(NamedTuple):
    """Forward pass over one trajectory.

    ``log_likelihood``: log-probability of the evidence, ``-inf`` if it is impossible.
    ``predicted[t, s] = P(s_t = s | evidence before t)``.
    ``final[s]``: distribution of the state after the last step, given all evidence.
    """

    log_likelihood: Float[Array, ""]
    predicted: Float[Array, "L S"]
    final: Float[Array, " S"]


class Smoothed(NamedTuple):
    """Forward-backward pass over one trajectory.

    ``pairs[t, s, a] = P(s_t = s, a_t = a | all evidence)``, zero beyond the trajectory's end; also the
    gradient of ``log_likelihood`` in the factors. ``log_likelihood``, ``final``: as in :class:`Filtered`.
    """

    log_likelihood: Float[Array, ""]
    pairs: Float[Array, "L S A"]
    final: Float[Array, " S"]


def _bounded_exp(x: Array) -> Array:
    """``exp(min(x, 0))`` with the derivative of ``exp`` at zero, where ``jnp.minimum`` halves it."""
    return jnp.exp(jnp.where(x > 0, 0.0, x))


def _weigh(predicted: Float[Array, " S"], factors: Float[Array, "S A"]) -> tuple:
    """Joint of one step in linear scale, its sum, and the logarithm of the scale taken out."""
    possible = jnp.where(predicted[:, None] > 0, factors, -jnp.inf)
    scale = lax.stop_gradient(jnp.max(possible))
    scale = jnp.where(jnp.isfinite(scale), scale, 0.0)
    joint = predicted[:, None] * _bounded_exp(factors - scale)
    return joint, jnp.sum(joint), scale


def filter_forward(mdp: TabularMDP, factors: Float[Array, "L S A"], live: Bool[Array, " L"]) -> Filtered:
    """Forward pass; ``live`` is false on padding. Differentiable in factors, transitions and ``p0``."""

    def step(carry: tuple, inputs: tuple) -> tuple:
        predicted, total = carry
        factor, alive = inputs
        joint, norm, scale = _weigh(predicted, factor)
        possible = norm > 0
        safe = jnp.where(possible, norm, 1.0)
        log_norm = jnp.where(possible, jnp.log(safe) + scale, -jnp.inf)
        following = mdp.push_forward(joint) / safe
        carry = (jnp.where(alive, following, predicted), total + jnp.where(alive, log_norm, 0.0))
        return carry, predicted

    carry: tuple = lax.scan(step, (mdp.initial, jnp.zeros(())), (factors, live))
    (final, total), predicted = carry
    return Filtered(total, predicted, final)


def smooth(mdp: TabularMDP, factors: Float[Array, "L S A"], live: Bool[Array, " L"]) -> Smoothed:
    """Forward-backward pass over one trajectory (the exact E-step, replacing the MCMC of Algorithm 1)."""
    filtered = filter_forward(mdp, factors, live)

    def step(future: Float[Array, " S"], inputs: tuple) -> tuple:
        predicted, factor, alive = inputs
        joint, _, scale = _weigh(predicted, factor)
        onward = mdp.expect_next(future)
        joint = joint * onward
        total = jnp.sum(joint)
        pairs = joint / jnp.where(total > 0, total, 1.0)
        # Only states that can occur matter: the others' messages would grow without bound.
        message = jnp.where(predicted > 0, jnp.sum(_bounded_exp(factor - scale) * onward, axis=1), 0.0)
        message = message / jnp.maximum(jnp.max(message), 1e-300)
        return jnp.where(alive, message, future), jnp.where(alive, pairs, 0.0)

    ones = jnp.ones(mdp.n_states)
    pairs: Array = lax.scan(step, ones, (filtered.predicted, factors, live), reverse=True)[1]
    return Smoothed(filtered.log_likelihood, pairs, filtered.final)


def sample_backward(
    key: Array, mdp: TabularMDP, factors: Float[Array, "L S A"], filtered: Filtered, live: Bool[Array, " L"]
) -> tuple[Int[Array, " L"], Int[Array, " L"]]:
    """Draw one completion (states, actions) from the exact joint posterior; -1 beyond the end."""
    n_actions = mdp.n_actions

    def step(carry: tuple, inputs: tuple) -> tuple:
        following, known = carry
        key, predicted, factor, alive = inputs
        joint, _, _ = _weigh(predicted, factor)
        onward = jnp.where(known, mdp.transition_probability(following), 1.0)
        flat = jax.random.categorical(key, jnp.log((joint * onward).reshape(-1)))
        state, action = flat // n_actions, flat % n_actions
        carry = (jnp.where(alive, state, following), known | alive)
        return carry, (jnp.where(alive, state, -1), jnp.where(alive, action, -1))

    keys = jax.random.split(key, factors.shape[0])
    start = (jnp.array(0), jnp.array(False))
    return lax.scan(step, start, (keys, filtered.predicted, factors, live), reverse=True)[1]
