"""Completion of demonstrations: exact expectations over hidden steps, and samplers of the same posterior.

``exact`` is the default. ``blocked`` (joint backward sampling) and ``gibbs`` (single-site) estimate the
same quantities from ``n`` draws, the ``n_s`` that Lemma 2 counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.laws import chain
from ...models.laws.chain import Filtered, Smoothed, filter_all, filter_forward, sample_backward
from ...models.observation.demonstration import PAD, Demonstration
from ...models.observation.evidence import AnySensor, log_evidence
from ...models.process.mdp import TabularMDP


@shown_briefly
class Evidence(NamedTuple):
    """A demonstration for a learner: ``log e_t(s, a)`` as ``[n, L, S, A]`` and marks of existing steps."""

    log_evidence: Float[Array, "n L S A"]
    live: Bool[Array, "n L"]


@shown_briefly
class Expectations(NamedTuple):
    """Expected sufficient statistics of a demonstration, hidden steps averaged over their posterior.

    Fields
    ------
    log_likelihood : float ``[n]``
        Log-likelihood of each trajectory.
    counts : float ``[S, A]``
        ``N(s, a)``, expected visits summed over trajectories and steps.
    features : float ``[K]``
        ``sum_n sum_t gamma^t E[phi(s_t, a_t)]`` (the numerator of Eq. 4.1).
    start : float ``[S]``
        Summed posterior of the first state.
    tail : float ``[S]``
        Summed posterior of the state after the last step, each weighted by ``gamma^L``.
    size : float
        Number of trajectories (padding rows excluded).
    """

    log_likelihood: Float[Array, " n"]
    counts: Float[Array, "S A"]
    features: Float[Array, " K"]
    start: Float[Array, " S"]
    tail: Float[Array, " S"]
    size: Float[Array, ""]


def evidence_of(mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration) -> Evidence:
    """Evaluate a sensor on a demonstration once, for all passes over it.

    Raises as :func:`~i2rl.models.observation.evidence.log_evidence` does.
    """
    return Evidence(log_evidence(sensor, mdp, demonstration), jnp.asarray(demonstration.kind) != PAD)


def smooth_all(mdp: TabularMDP, log_policy: Float[Array, "S A"], evidence: Evidence) -> Smoothed:
    """Run forward-backward passes over every trajectory; fields of :class:`Smoothed` with a leading ``n``."""
    return chain.smooth_all(mdp, evidence.log_evidence + log_policy, evidence.live)


def log_likelihoods(
    mdp: TabularMDP, log_policy: Float[Array | np.ndarray, "S A"], evidence: Evidence
) -> Float[Array, " n"]:
    """Return the exact log-likelihood of each trajectory.

    See Also
    --------
    i2rl.inference.expectations : completes the trajectories
    i2rl.models.log_evidence : the evidence
    i2rl.models.TrajectoryLaw : the same likelihood as a NumPyro distribution

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import log_likelihoods
    >>> from i2rl.inference.completion.smoothing import evidence_of
    >>> from i2rl.models import reward_of, soft_plan
    >>> mdp, weights, sensor, demonstration = five_cells()
    >>> plan, evidence = soft_plan(mdp, reward_of(mdp, weights)), evidence_of(mdp, sensor, demonstration)
    >>> each = log_likelihoods(mdp, plan.log_policy, evidence)
    >>> each.shape, bool((each < 0).all())  # in nats
    ((8,), True)
    """
    return filter_all(mdp, evidence.log_evidence + log_policy, evidence.live).log_likelihood


def expectations(
    mdp: TabularMDP, log_policy: Float[Array | np.ndarray, "S A"], evidence: Evidence
) -> Expectations:
    """Run the exact E-step (Eq. 4.1 with the sum over completions carried out).

    See Also
    --------
    i2rl.inference.log_likelihoods : the likelihoods alone
    i2rl.inference.sample_completions : draws completions
    i2rl.inference.fit_counts : the weights that explain the visits

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import expectations
    >>> from i2rl.inference.completion.smoothing import evidence_of
    >>> from i2rl.models import reward_of, soft_plan
    >>> mdp, weights, sensor, demonstration = five_cells()
    >>> plan, evidence = soft_plan(mdp, reward_of(mdp, weights)), evidence_of(mdp, sensor, demonstration)
    >>> completed = expectations(mdp, plan.log_policy, evidence)
    >>> int(completed.size), round(float(completed.counts.sum()))  # trajectories, and their steps
    (8, 48)
    """
    return collect(mdp, smooth_all(mdp, jnp.asarray(log_policy), evidence), evidence.live)


def collect(mdp: TabularMDP, posterior: Smoothed, live: Bool[Array, "n L"]) -> Expectations:
    """Sum a posterior over hidden pairs (exact or estimated) into expected sufficient statistics."""
    log_likelihood, pairs, final = posterior
    powers = mdp.discount ** jnp.arange(live.shape[1])
    exists = jnp.any(live, axis=1)
    discounted = jnp.einsum("nlsa,l->sa", pairs, powers)
    weight = jnp.where(exists, mdp.discount ** jnp.sum(live, axis=1), 0.0)
    return Expectations(
        log_likelihood=log_likelihood,
        counts=jnp.sum(pairs, axis=(0, 1)),
        features=jnp.einsum("sa,sak->k", discounted, mdp.features),
        start=jnp.sum(pairs[:, 0], axis=(0, 2)),
        tail=jnp.einsum("n,ns->s", weight, final),
        size=jnp.sum(exists).astype(float),
    )


def sample_completions(
    key: Array, mdp: TabularMDP, log_policy: Float[Array | np.ndarray, "S A"], evidence: Evidence, draws: int
) -> tuple[Int[Array, "draws n L"], Int[Array, "draws n L"]]:
    """Draw independent joint completions (states, actions) by backward sampling; -1 on padding.

    See Also
    --------
    i2rl.inference.expectations : sums over all completions
    i2rl.inference.sample_posterior : draws weights and completions

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_completions
    >>> from i2rl.inference.completion.smoothing import evidence_of
    >>> from i2rl.models import Demonstration, reward_of, soft_plan
    >>> mdp, weights, sensor, _ = five_cells()
    >>> walk = Demonstration.from_arrays([[0, 1, -1, -1, 4]], [[1, 1, -1, -1, 2]], missing=-1)
    >>> plan, evidence = soft_plan(mdp, reward_of(mdp, weights)), evidence_of(mdp, sensor, walk)
    >>> states, _ = sample_completions(jax.random.key(0), mdp, plan.log_policy, evidence, 5)
    >>> states[:, 0].tolist()  # each draw goes the only way, through cells 2 and 3
    [[0, 1, 2, 3, 4], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4]]
    """

    factors = evidence.log_evidence + log_policy

    def one(key: Array, factors: Array, filtered: Filtered, live: Array) -> tuple:
        keys = jax.random.split(key, draws)
        return jax.vmap(lambda k: sample_backward(k, mdp, factors, filtered, live))(keys)

    keys = jax.random.split(as_key(key), evidence.live.shape[0])
    filtered = filter_all(mdp, factors, evidence.live)
    return jax.vmap(one, out_axes=1)(keys, factors, filtered, evidence.live)


def blocked_posterior(
    key: Array, mdp: TabularMDP, log_policy: Float[Array, "S A"], evidence: Evidence, draws: int
) -> Smoothed:
    """Estimate :func:`smooth_all` from ``draws`` independent joint completions of each trajectory."""
    states, actions = sample_completions(key, mdp, log_policy, evidence, draws)
    return _average(mdp, log_policy, evidence, states, actions)


def gibbs_posterior(
    key: Array,
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    evidence: Evidence,
    draws: int,
    burn_in: int = 20,
) -> Smoothed:
    """Estimate :func:`smooth_all` from ``draws`` of the single-site Gibbs sampler."""
    states, actions = gibbs_completions(key, mdp, log_policy, evidence, draws, burn_in)
    return _average(mdp, log_policy, evidence, states, actions)


class _SingleSite(NamedTuple):
    """Single-site sampler of one trajectory: an initial pair ``(states, actions)``, and one iteration."""

    start: Callable[[Array], tuple[Array, Array]]
    sweep: Callable[[tuple[Array, Array], Array], tuple[Array, Array]]


def _single_site(
    mdp: TabularMDP, log_policy: Float[Array, "S A"], e: Float[Array, "L S A"], live: Bool[Array, " L"]
) -> _SingleSite:
    length, n_states = live.shape[0], mdp.n_states
    uniform = jnp.where(log_policy > -jnp.inf, 0.0, -jnp.inf)
    log_initial = jnp.log(mdp.initial)
    last = jnp.sum(live) - 1

    def start(key: Array) -> tuple[Array, Array]:
        return sample_backward(key, mdp, e + uniform, filter_forward(mdp, e + uniform, live), live)

    def site(carry: tuple, inputs: tuple) -> tuple:
        states, actions = carry
        t, key = inputs
        state_key, action_key = jax.random.split(key)
        before = states[jnp.maximum(t - 1, 0)], actions[jnp.maximum(t - 1, 0)]
        arrive = jnp.zeros(n_states).at[mdp.successors[before]].add(mdp.probabilities[before])
        arrive = jnp.where(t == 0, log_initial, jnp.log(arrive))
        leave = jnp.log(mdp.transition_probability(states[jnp.minimum(t + 1, length - 1)]))
        onward = jnp.where(t < last, leave, 0.0)
        joint = arrive[:, None] + log_policy + e[t] + onward
        state = jax.random.categorical(state_key, joint[:, actions[t]])
        action = jax.random.categorical(action_key, joint[state])
        alive = live[t]
        states = states.at[t].set(jnp.where(alive, state, states[t]))
        actions = actions.at[t].set(jnp.where(alive, action, actions[t]))
        return (states, actions), None

    def sweep(pair: tuple[Array, Array], key: Array) -> tuple[Array, Array]:
        return lax.scan(site, pair, (jnp.arange(length), jax.random.split(key, length)))[0]

    return _SingleSite(start, sweep)


def gibbs_completions(
    key: Array,
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    evidence: Evidence,
    draws: int,
    burn_in: int = 20,
) -> tuple[Int[Array, "draws n L"], Int[Array, "draws n L"]]:
    """Draw completions by single-site Gibbs: an iteration redraws every state, then its action.

    It is the dissertation's MCMC; each redraw is given both neighbours. Unlike in its released code, the
    look-ahead factor ``P(s_{t+1} | s_t, a_t)`` enters at every step. If the dynamics are nearly deterministic
    a single site cannot move, so the sampler mixes poorly or not at all. This is an inherent limit, and the
    reason that it is not the default. The chain starts from a completion drawn under the uniform policy over
    the actions that ``log_policy`` may take.
    """

    def chain(key: Array, e: Array, live: Array) -> tuple:
        start_key, key = jax.random.split(key)
        site = _single_site(mdp, log_policy, e, live)

        def kept(pair: tuple, key: Array) -> tuple:
            pair = site.sweep(pair, key)
            return pair, pair

        every = jax.random.split(key, draws + burn_in)
        pairs: tuple[Array, Array] = lax.scan(kept, site.start(start_key), every)[1]
        return pairs[0][burn_in:], pairs[1][burn_in:]

    keys = jax.random.split(as_key(key), evidence.live.shape[0])
    return jax.vmap(chain, out_axes=1)(keys, *evidence)


@shown_briefly
class Settled(NamedTuple):
    """Completions drawn until an average of them settled.

    Fields
    ------
    states, actions : int ``[draws, n, L]``
        Entries from ``drawn`` on were not drawn.
    drawn : int
    """

    states: Int[Array, "draws n L"]
    actions: Int[Array, "draws n L"]
    drawn: Int[Array, ""]


def settled_completions(
    key: Array,
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    evidence: Evidence,
    draws: int,
    burn_in: int,
    score: Callable[[Int[Array, "n L"], Int[Array, "n L"]], Float[Array, "n L"]],
    change: ArrayLike,
) -> Settled:
    """Draw the first of :func:`gibbs_completions`, until one more hardly moves the average of ``score``.

    Lines 6-15 of Algorithm 3: drawing ends when the running average over completions moves by at most
    ``change``, the mean of its absolute changes over the existing steps; otherwise after ``draws``. The
    algorithm as printed compares an average with itself; here it is compared with the one before.
    """
    n, length = evidence.live.shape
    keys = jax.vmap(jax.random.split)(jax.random.split(as_key(key), n))
    sweeps = jax.vmap(lambda k: jax.random.split(k, draws + burn_in))(keys[:, 1])
    steps = jnp.maximum(jnp.sum(evidence.live), 1)

    def swept(pair: tuple, i: Array) -> tuple:
        return jax.vmap(lambda e, live, *rest: _single_site(mdp, log_policy, e, live).sweep(*rest))(
            *evidence, pair, sweeps[:, i]
        )

    def unsettled(carry: tuple) -> Array:
        return (carry[0] < draws) & (carry[1] > change)

    def one_more(carry: tuple) -> tuple:
        i, _, pair, total, states, actions = carry
        pair = swept(pair, burn_in + i)
        value = jnp.where(evidence.live, score(*pair), 0.0)
        moved = jnp.abs((total + value) / (i + 1) - total / jnp.maximum(i, 1))
        moved = jnp.where(i > 0, jnp.sum(moved) / steps, jnp.inf)
        return i + 1, moved, pair, total + value, states.at[i].set(pair[0]), actions.at[i].set(pair[1])

    pair = jax.vmap(lambda k, e, live: _single_site(mdp, log_policy, e, live).start(k))(keys[:, 0], *evidence)
    pair = lax.fori_loop(0, burn_in, lambda i, pair: swept(pair, jnp.asarray(i)), pair)
    room = [jnp.zeros((draws, n, length), x.dtype) for x in pair]
    begun = (jnp.zeros((), int), jnp.asarray(jnp.inf), pair, jnp.zeros((n, length)), *room)
    count, _, _, _, states, actions = lax.while_loop(unsettled, one_more, begun)
    return Settled(states, actions, count)


def _average(
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    evidence: Evidence,
    states: Int[Array, "draws n L"],
    actions: Int[Array, "draws n L"],
) -> Smoothed:
    draws = states.shape[0]
    n, length = evidence.live.shape

    def average(states: Array, actions: Array) -> Array:
        hits = jnp.zeros((length, mdp.n_states, mdp.n_actions))
        steps = jnp.broadcast_to(jnp.arange(length), (draws, length))
        return hits.at[steps, states, actions].add(1.0 / draws)

    pairs = jax.vmap(average, in_axes=1)(states, actions)
    pairs = jnp.where(evidence.live[..., None, None], pairs, 0.0)
    last = jnp.maximum(jnp.sum(evidence.live, axis=1) - 1, 0)
    final = jax.vmap(mdp.push_forward)(pairs[jnp.arange(n), last])
    return Smoothed(log_likelihoods(mdp, log_policy, evidence), pairs, final)
