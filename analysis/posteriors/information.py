"""Fisher information about reward weights in partly observed behaviour.

Three informations answer three questions:

- :func:`observed_information`: what do *these* demonstrations determine? It is the curvature of the exact
  likelihood, hidden steps summed out, in the posterior;
- :func:`expected_information`: what would demonstrations *like* these determine, of an expert who obeys the
  soft model? It plans a study; an expert who never errs is not of that kind;
- :func:`complete_information`: what would full observation determine? An upper bound, and the Hessian that
  the solvers iterate with. The difference to the others is information lost to occlusion (Louis 1982).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...inference.completion.smoothing import evidence_of, log_likelihoods
from ...models.laws.trajectory import TrajectoryLaw, sample_demonstration
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import AnySensor, checked_demonstration, fitting_sensor
from ...models.process.mdp import TabularMDP
from ...models.process.planning import features_to_go, reward_of, soft_plan


@jax.jit
def policy_sensitivity(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A K"]:
    """Differentiate ``log pi_theta(a | s)`` by the weights; zero for unavailable actions."""
    policy = soft_plan(mdp, reward_of(mdp, weights)).policy
    to_go = features_to_go(mdp, policy)
    next_to_go = jax.vmap(mdp.expect_next, in_axes=1, out_axes=2)(to_go)
    slope = mdp.features + mdp.discount * next_to_go - to_go[:, None]
    return jnp.where(mdp.available[..., None], slope, 0.0)


@jax.jit
def complete_information(
    mdp: TabularMDP, weights: Float[Array, " K"], visits: Float[Array, " S"]
) -> Float[Array, "K K"]:
    """Compute the Fisher information of fully observed behaviour, ``sum_s N(s) Cov_{a ~ pi(.|s)} d log pi(. |
    s)``.

    ``visits [S]`` are (expected) numbers of visits ``N(s)``.
    """
    policy = soft_plan(mdp, reward_of(mdp, weights)).policy
    slope = policy_sensitivity(mdp, weights)
    return jnp.einsum("s,sa,sak,saj->kj", visits, policy, slope, slope)


def _log_likelihoods(
    weights: Float[Array, " K"], mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration
) -> Float[Array, " n"]:
    log_policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
    return log_likelihoods(mdp, log_policy, evidence_of(mdp, sensor, demonstration))


def _total(
    weights: Float[Array, " K"], mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration
) -> Float[Array, ""]:
    return jnp.sum(_log_likelihoods(weights, mdp, sensor, demonstration))


_scores = jax.jit(jax.jacfwd(_log_likelihoods))
_hessian = jax.jit(jax.jacfwd(jax.grad(_total)))


def _given(mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration) -> tuple:
    checked = checked_demonstration(mdp, demonstration)
    return mdp, fitting_sensor(sensor, mdp), checked.bucketed()


@jax.jit
def _along(weights: Float[Array, "W K"], *given: Any) -> Float[Array, " W"]:
    return jax.lax.map(lambda theta: _total(theta, *given), weights)


def total_log_likelihoods(
    mdp: TabularMDP, sensor: AnySensor, weights: Float[Array, "W K"], demonstration: Demonstration
) -> Float[np.ndarray, " W"]:
    """Compute the exact log-likelihood (nats) of the whole demonstration under each of several weights."""
    return np.asarray(_along(jnp.asarray(weights, float), *_given(mdp, sensor, demonstration)))


def scores(
    mdp: TabularMDP, sensor: AnySensor, weights: Float[Array, " K"], demonstration: Demonstration
) -> Float[np.ndarray, "n K"]:
    """Compute the gradient of each trajectory's exact log-likelihood, hidden steps summed out."""
    gradients = _scores(jnp.asarray(weights, float), *_given(mdp, sensor, demonstration))
    return np.asarray(gradients)[: demonstration.n_trajectories]


def observed_information(
    mdp: TabularMDP, sensor: AnySensor, weights: Float[Array, " K"], demonstration: Demonstration
) -> Float[np.ndarray, "K K"]:
    """Compute minus the Hessian of the demonstration's exact log-likelihood, hidden steps summed out.

    Differentiates through the soft plan by the implicit function theorem, twice. Need not be positive away
    from a maximum of the likelihood.
    """
    hessian = np.asarray(_hessian(jnp.asarray(weights, float), *_given(mdp, sensor, demonstration)))
    return -(hessian + hessian.T) / 2


def expected_information(
    key: Array,
    mdp: TabularMDP,
    sensor: AnySensor,
    weights: Float[Array, " K"],
    trajectories: int,
    length: int,
    draws: int = 1000,
) -> Float[np.ndarray, "K K"]:
    """Compute the Fisher information of ``trajectories`` of ``length`` steps of an expert with these weights.

    ``trajectories E[score score']``, the expectation over observations averaged over ``draws`` simulated
    trajectories. Positive semidefinite.
    """
    law = TrajectoryLaw(mdp, jnp.asarray(weights, float), sensor, length)
    gradients = scores(mdp, sensor, weights, sample_demonstration(key, law, draws))
    return trajectories * gradients.T @ gradients / draws
