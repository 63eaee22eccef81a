"""An expert's behaviour as weights on transitions ``(s, a, s')``, given hidden or noisy observations.

Transitions are stored as successor lists ``[S, A, B]``, never as a dense ``[S, A, S]``. Three methods lead
from observations to transitions: their exact posterior under a policy, an estimate of it by single-site Gibbs
sampling (section 6.2.3), and the observations at face value.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.display import shown_briefly
from ...models.laws.chain import smooth_transitions_all
from ...models.observation.demonstration import SEEN, Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import occupancy
from .smoothing import Evidence, gibbs_completions, log_likelihoods, settled_completions


@shown_briefly
class Completed(NamedTuple):
    """A session's demonstration as transitions.

    Fields
    ------
    log_likelihood : float ``[n]``
        Log-likelihood of each trajectory, nats.
    steps : float ``[n, L, S, A, U]``
        Distribution of each step over ``(s, a, s')``, by successor lists; zero for absent steps.
    starts : float ``[H, S]``
        Number of stretches of behaviour that began in each state and were still followed ``t`` steps later.
    """

    log_likelihood: Float[Array, " n"]
    steps: Float[Array, "n L S A U"]
    starts: Float[Array, "H S"]


@shown_briefly
class TransitionStatistic(NamedTuple):
    """The expert's transitions so far, means per step.

    Fields
    ------
    size : float
        Expected steps (first, so that :func:`~i2rl.inference.sessions.statistic.blend` can average).
    weights : float ``[S, A, U]``
        Share of each transition.
    starts : float ``[H, S]``
        :attr:`Completed.starts` per step.
    """

    size: Float[Array, ""]
    weights: Float[Array, "S A U"]
    starts: Float[Array, "H S"]


def summarised(completed: Completed) -> TransitionStatistic:
    """Summarise one session in a statistic."""
    weights = jnp.sum(completed.steps, axis=(0, 1))
    size = jnp.sum(weights)
    share = 1 / jnp.maximum(size, 1e-300)
    return TransitionStatistic(size, weights * share, completed.starts * share)


# -- three methods from observations to transitions -----------------------------------------------------


def exact_transitions(
    mdp: TabularMDP, log_policy: Float[Array, "S A"], evidence: Evidence, horizon: int
) -> Completed:
    """Return the posterior of every transition given all observations, hidden steps and noise summed out."""
    log_likelihood, steps = smooth_transitions_all(mdp, evidence.log_evidence + log_policy, evidence.live)
    return Completed(log_likelihood, steps, _starts(steps, evidence.live, horizon))


@shown_briefly
class Settling(NamedTuple):
    """The discriminator's ``logits [S, A, B]``, and the ``change`` of their average that ends sampling."""

    logits: Float[Array, "S A B"]
    change: ArrayLike


def gibbs_transitions(
    key: Array,
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    evidence: Evidence,
    horizon: int,
    draws: int,
    burn_in: int,
    settling: Settling | None = None,
) -> Completed:
    """Estimate the same from ``draws`` of the single-site sampler (Eq. 6.10, lines 6-15).

    After the last step the successor follows the dynamics. With ``settling``, drawing stops when the average
    logit moves by at most ``settling.change``
    (:func:`~i2rl.inference.completion.smoothing.settled_completions`).
    """
    n, length = evidence.live.shape
    follows = evidence.live & jnp.pad(evidence.live, ((0, 0), (0, 1)))[:, 1:]

    def landed_at(states: Array, actions: Array) -> tuple[Array, Array, Array]:
        s, a = jnp.maximum(states, 0), jnp.maximum(actions, 0)
        landed = _landed(mdp.successors, s, a) * mdp.probabilities[s, a]
        landed = landed / jnp.maximum(jnp.sum(landed, -1, keepdims=True), 1e-300)
        return s, a, jnp.where(follows[..., None], landed, mdp.probabilities[s, a])

    if settling is None:
        states, actions = gibbs_completions(key, mdp, log_policy, evidence, draws, burn_in)
        weights = jnp.full(draws, 1 / draws)
    else:
        known, change = settling

        def score(states: Array, actions: Array) -> Array:
            s, a, landed = landed_at(states, actions)
            return jnp.sum(landed * known[s, a], -1)

        states, actions, count = settled_completions(
            key, mdp, log_policy, evidence, draws, burn_in, score, change
        )
        weights = (jnp.arange(draws) < count) / count
    s, a, landed = landed_at(states, actions)
    landed = jnp.where(evidence.live[..., None], landed * weights[:, None, None, None], 0.0)
    row, step = jnp.arange(n)[:, None], jnp.arange(length)
    steps = jnp.zeros((n, length, *mdp.successors.shape)).at[row, step, s, a].add(landed)
    starts = _starts(steps, evidence.live, horizon)
    return Completed(log_likelihoods(mdp, log_policy, evidence), steps, starts)


def reported_transitions(
    mdp: TabularMDP,
    successors: Int[Array, "S A U"],
    log_policy: Float[Array, "S A"],
    demonstration: Demonstration,
    horizon: int,
) -> Completed:
    """Take the observations for the truth; leave out steps that were hidden, even in part.

    Observations of unavailable actions are left out too. ``successors`` are those of :func:`wide_successors`.
    If the next observation is not a possible successor, or there is none, the successor follows the dynamics.
    The log-likelihood is that of the observed actions, given the observed states.
    """
    kind, state, action = (jnp.asarray(x) for x in demonstration.arrays[:3])
    s, a = jnp.maximum(state, 0), jnp.maximum(action, 0)
    in_range = (state >= 0) & (state < mdp.n_states) & (action >= 0) & (action < mdp.n_actions)
    seen = (kind == SEEN) & in_range & mdp.available[s, a]
    following = _landed(successors, s, a) & jnp.pad(seen, ((0, 0), (0, 1)))[:, 1:, None]
    known = jnp.any(following, -1, keepdims=True)
    # The list's own first entries are the dynamics' successors.
    dynamics = jnp.pad(
        mdp.probabilities, ((0, 0), (0, 0), (0, successors.shape[2] - mdp.probabilities.shape[2]))
    )
    first = following & (jnp.cumsum(following, -1) == 1)
    landed = jnp.where(known, first, dynamics[s, a]) * seen[..., None]
    n, length = seen.shape
    row, step = jnp.arange(n)[:, None], jnp.arange(length)
    steps = jnp.zeros((n, length, *successors.shape)).at[row, step, s, a].add(landed)

    # A stretch is a run of seen steps.
    def run(carry: tuple, inputs: tuple) -> tuple:
        place, begun = carry
        at, visible = inputs
        begun = jnp.where(place == 0, at, begun)
        following = jnp.where(visible, place + 1, 0)
        return (following, begun), (place, begun)

    zeros = jnp.zeros(n, s.dtype)
    runs: tuple = lax.scan(run, (zeros, zeros), (s.T, seen.T))[1]
    places, begun = runs
    starts = jnp.zeros((horizon, mdp.n_states)).at[places, begun].add(seen.T)
    chosen = jnp.where(seen, log_policy[s, a], 0.0)
    return Completed(jnp.sum(chosen, axis=1), steps, starts)


def wide_successors(mdp: TabularMDP) -> Int[np.ndarray, "S A U"]:
    """Lengthen successor lists by the states that other actions lead to from the same state.

    A wrongly observed action leaves the next state unchanged.
    """
    own, possible = np.asarray(mdp.successors), np.asarray(mdp.probabilities) > 0
    more = [np.unique(own[s][possible[s]]) for s in range(mdp.n_states)]
    width = max(len(row) for row in more)
    padded = np.stack([np.pad(row, (0, width - len(row)), mode="edge") for row in more])
    around = np.broadcast_to(padded[:, None], (*own.shape[:2], width))
    return np.concatenate([own, around], axis=2)


def _landed(
    successors: Int[Array, "S A U"], states: Int[Array, "... L"], actions: Int[Array, "... L"]
) -> Bool[Array, "... L U"]:
    """Mark the entries of the lists that equal the state of the next step."""
    following = jnp.roll(states, -1, axis=-1)
    return successors[states, actions] == following[..., None]


def _starts(steps: Float[Array, "n L S A U"], live: Bool[Array, "n L"], horizon: int) -> Float[Array, "H S"]:
    first = jnp.sum(steps[:, 0], axis=(2, 3))
    lengths = jnp.sum(live, axis=1)
    return (jnp.arange(horizon)[:, None] < lengths).astype(float) @ first


# -- transitions of a policy ----------------------------------------------------------------------------


def visited_transitions(
    mdp: TabularMDP, log_policy: Float[Array, "S A"], starts: Float[Array, "H S"]
) -> Float[Array, "S A B"]:
    """Return shares of a policy's transitions from the expert's first states, over the expert's lengths.

    The shares are exact: ``sum_t P_pi^t starts_t``, by Horner's rule.
    """
    policy = jnp.exp(log_policy)

    def step(ahead: Float[Array, " S"], start: Float[Array, " S"]) -> tuple:
        return start + mdp.push_forward(ahead[:, None] * policy), None

    visits: Array = lax.scan(step, jnp.zeros(mdp.n_states), starts, reverse=True)[0]
    return _shares(mdp, visits[:, None] * policy)


def discounted_transitions(
    mdp: TabularMDP, log_policy: Float[Array, "S A"], starts: Float[Array, "H S"]
) -> Float[Array, "S A B"]:
    """Return shares of transitions in the discounted occupancy of a policy from ``p0``; ignore ``starts``."""
    del starts
    return _shares(mdp, occupancy(mdp, jnp.exp(log_policy)))


def _shares(mdp: TabularMDP, pairs: Float[Array, "S A"]) -> Float[Array, "S A B"]:
    return (pairs / jnp.maximum(jnp.sum(pairs), 1e-300))[..., None] * mdp.probabilities
