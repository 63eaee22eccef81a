"""A demonstration under a mixture: how well each component explains each trajectory.

Fully seen trajectories need no completion: their visits are known, and their log-likelihood is linear in the
log-policy. If any step was hidden, lost or noisy, a forward-backward pass completes every trajectory under
every component.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN, Demonstration
from ...models.observation.evidence import AnySensor, fitting_sensor
from ...models.process.mdp import TabularMDP
from .smoothing import Evidence, evidence_of, smooth_all


@shown_briefly
class SeenWhole(NamedTuple):
    """Fully seen trajectories: visits, log-probability of the dynamics, and which rows exist."""

    visits: Float[Array, "n S A"]
    constant: Float[Array, " n"]
    live: Bool[Array, " n"]


@shown_briefly
class SeenInPart(NamedTuple):
    """Trajectories with gaps or noise: evidence of every step, which steps were seen, which rows exist."""

    evidence: Evidence
    seen: Bool[Array, "n L"]
    live: Bool[Array, " n"]


Trajectories = SeenWhole | SeenInPart


@shown_briefly
class Explained(NamedTuple):
    """A demonstration under one component.

    Fields
    ------
    log_likelihood : float ``[n]``
        Exact, hidden steps summed out; ``-inf`` if the component cannot produce the trajectory.
    visits : float ``[n, S, A]``
        Expected visits of all steps.
    seen : float ``[n, S, A]``
        Expected visits of the steps that were seen.
    """

    log_likelihood: Float[Array, " n"]
    visits: Float[Array, "n S A"]
    seen: Float[Array, "n S A"]


def is_seen_whole(sensor: AnySensor, demonstration: Demonstration) -> bool:
    """Return whether every step was observed exactly, state and action."""
    kind, state, action, _ = (np.asarray(x) for x in demonstration.arrays)
    gaps = (kind == HIDDEN) | (kind == LOST) | ((kind == SEEN) & ((state == UNKNOWN) | (action == UNKNOWN)))
    return sensor.noise is None and not gaps.any()


def seen_whole(mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration) -> SeenWhole:
    """Gather the visits of fully seen trajectories; traceable."""
    sensor = fitting_sensor(sensor, mdp)
    kind, state, action, _ = (jnp.asarray(x) for x in demonstration.arrays)
    present = jnp.ones(mdp.n_states) if sensor.visibility is None else sensor.visibility

    def one(kind: Int[Array, " L"], state: Int[Array, " L"], action: Int[Array, " L"]) -> tuple:
        alive = kind != PAD
        visits = jnp.zeros((mdp.n_states, mdp.n_actions)).at[state, action].add(jnp.where(alive, 1.0, 0.0))
        arrived = mdp.successors[state[:-1], action[:-1]] == state[1:, None]
        moves = jnp.sum(jnp.where(arrived, mdp.probabilities[state[:-1], action[:-1]], 0.0), axis=1)
        possible = jnp.where(mdp.available[state, action], present[state], 0.0)
        total = jnp.log(mdp.initial[state[0]]) + jnp.sum(jnp.where(alive, jnp.log(possible), 0.0))
        total += jnp.sum(jnp.where(alive[1:], jnp.log(moves), 0.0))
        return visits, jnp.where(alive[0], total, 0.0)

    visits, constant = jax.vmap(one)(kind, jnp.maximum(state, 0), jnp.maximum(action, 0))
    return SeenWhole(visits, constant, kind[:, 0] != PAD)


def seen_in_part(mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration) -> SeenInPart:
    """Evaluate a sensor on trajectories with gaps or noise; traceable."""
    evidence = evidence_of(mdp, sensor, demonstration)
    return SeenInPart(evidence, jnp.asarray(demonstration.kind) == SEEN, evidence.live[:, 0])


def explain(mdp: TabularMDP, log_policy: Float[Array, "S A"], trajectories: Trajectories) -> Explained:
    """Explain every trajectory by one policy."""
    if isinstance(trajectories, SeenWhole):
        visits, constant, live = trajectories
        gained = jnp.einsum("nsa,sa->n", visits, jnp.where(mdp.available, log_policy, 0.0))
        return Explained(jnp.where(live, constant + gained, 0.0), visits, visits)
    log_likelihood, pairs, _ = smooth_all(mdp, log_policy, trajectories.evidence)
    seen = jnp.einsum("nlsa,nl->nsa", pairs, trajectories.seen.astype(float))
    return Explained(log_likelihood, jnp.sum(pairs, axis=1), seen)


def explain_each(
    mdp: TabularMDP,
    log_policies: Float[Array, "D S A"],
    trajectories: Trajectories,
    present: Bool[Array, " D"] | None = None,
) -> Explained:
    """Explain every trajectory by every policy: fields as in :class:`Explained`, with a leading ``D``.

    Those of policies that are not ``present`` are arbitrary finite numbers.
    """
    if isinstance(trajectories, SeenWhole):
        return jax.vmap(lambda x: explain(mdp, x, trajectories))(log_policies)
    # One policy at a time: a pass holds [n, L, S, A] posteriors, which components should not multiply.
    if present is None:
        return lax.map(lambda x: explain(mdp, x, trajectories), log_policies)
    n = len(trajectories.live)
    nothing = Explained(jnp.zeros(n), *(jnp.zeros((n, mdp.n_states, mdp.n_actions)),) * 2)
    return lax.map(
        lambda x: lax.cond(x[1], lambda: explain(mdp, x[0], trajectories), lambda: nothing),
        (log_policies, present),
    )


def without_reward(mdp: TabularMDP, trajectories: Trajectories) -> Explained:
    """Explain every trajectory by the uniform policy, before any reward is known."""
    uniform = jnp.where(mdp.available, -jnp.log(jnp.sum(mdp.available, axis=1))[:, None], -jnp.inf)
    return explain(mdp, uniform, trajectories)
