"""LME-I2RL that keeps the likelihood of past demonstrations rather than their completed visits.

The first trajectories stay raw, and are learned from as batch learning does; they are then expanded, all at
once, at the weights that they led to (:mod:`~i2rl.inference.sessions.kept_likelihood`). Later sessions take a
few Newton steps on what is kept and the exact likelihood of what they see.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.arguments import as_key
from ...models.observation.demonstration import Demonstration, DemonstrationError, concatenate
from ...models.observation.evidence import checked_demonstration, require_possible
from ..completion.smoothing import Evidence, evidence_of, log_likelihoods
from ..sessions.kept_likelihood import (
    KeptLikelihood,
    Surrogate,
    expanded,
    model_log_likelihood,
    nothing_kept,
    surrogate,
)
from ..sessions.learner import Learner, SessionInfo
from .alternation import Method, random_weights

# Trajectories and steps that are kept raw. A session that is expanded before the weights have travelled is
# never repaired.
RAW_TRAJECTORIES, RAW_STEPS = 8, 500
# Newton steps of a session that learns from raw trajectories, and of a later one: more commit too early.
RAW_ITERATIONS, ITERATIONS = 30, 3
# Length of a step in scaled weights, and the lengths tried, each half of the one before.
_LONGEST_STEP = 1.0
_LENGTHS = 14


class _Iterate(NamedTuple):
    """A point on the way to the session's weights."""

    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    change: Float[Array, ""]
    gradient: Float[Array, ""]
    iterations: Int[Array, ""]


def _maximise(
    method: Method,
    model: Surrogate,
    evidence: Evidence,
    start: _Iterate,
    iterations: Int[Array, ""],
    tolerance: float,
) -> _Iterate:
    """Maximise what is kept and the likelihood of the evidence, less the prior, by damped Newton steps."""
    mdp, ridge = method.mdp, method.ridge

    def objective(weights: Float[Array, " K"], values: Float[Array, " S"]) -> Float[Array, ""]:
        log_policy = method.plan(weights, values).log_policy
        now = jnp.sum(log_likelihoods(mdp, log_policy, evidence))
        return model_log_likelihood(mdp, model, weights, log_policy) + now - ridge / 2 * weights @ weights

    def gradients(
        weights: Float[Array, " K"], values: Float[Array, " S"]
    ) -> tuple[Array, tuple[Array, Array]]:
        value, gradient = jax.value_and_grad(objective)(weights, values)
        return gradient, (value, gradient)

    def step(now: _Iterate) -> _Iterate:
        hessian, (value, gradient) = jax.jacfwd(gradients, has_aux=True)(now.weights, now.values)
        eigenvalues, vectors = jnp.linalg.eigh(-(hessian + hessian.T) / 2)
        direction = vectors @ ((vectors.T @ gradient) / jnp.maximum(jnp.abs(eigenvalues), 1e-6))
        direction *= jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(jnp.linalg.norm(direction), 1e-300))

        def halve(at: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            scale, tried = at[0] / 2, at[2] + 1
            reached = objective(now.weights + scale * direction, now.values)
            rises = reached >= value + 1e-4 * scale * (gradient @ direction) - 1e-12 * jnp.abs(value)
            return scale, rises, tried

        scale, found, _ = lax.while_loop(
            lambda at: ~at[1] & (at[2] < _LENGTHS),
            halve,
            (jnp.array(2.0), jnp.array(False), jnp.zeros((), int)),
        )
        moved = jnp.where(found, scale, 0.0) * direction
        weights = now.weights + moved
        return _Iterate(
            weights,
            method.plan(weights, now.values).values,
            jnp.max(jnp.abs(moved)),
            jnp.where(now.iterations == 0, jnp.linalg.norm(gradient + ridge * now.weights), now.gradient),
            now.iterations + 1,
        )

    def goes_on(now: _Iterate) -> Bool[Array, ""]:
        return (now.iterations < iterations) & (now.change > tolerance)

    return lax.while_loop(goes_on, step, start)


@jax.jit
def _learned(
    method: Method,
    iterations: Int[Array, ""],
    tolerance: float,
    kept: KeptLikelihood,
    weights: Float[Array, " K"],
    values: Float[Array, " S"],
    demonstration: Demonstration,
) -> tuple[_Iterate, Surrogate, Float[Array, ""], Float[Array, " n"]]:
    """Return the session's end, what it was kept by, and the log-likelihood of all and of each trajectory."""
    mdp = method.mdp
    evidence = evidence_of(mdp, method.sensor, demonstration)
    far = jnp.array(jnp.inf)
    begun = _Iterate(weights, method.plan(weights, values).values, far, far, jnp.zeros((), int))
    model = surrogate(mdp, kept, values)
    end = _maximise(method, model, evidence, begun, iterations, tolerance)
    log_policy = method.plan(end.weights, end.values).log_policy
    each = log_likelihoods(mdp, log_policy, evidence)
    return end, model, model_log_likelihood(mdp, model, end.weights, log_policy) + jnp.sum(each), each


@jax.jit
def _expanded(
    method: Method,
    kept: KeptLikelihood,
    model: Surrogate,
    weights: Float[Array, " K"],
    values: Float[Array, " S"],
    demonstration: Demonstration,
) -> KeptLikelihood:
    evidence = evidence_of(method.mdp, method.sensor, demonstration)
    return expanded(method.mdp, kept, model, weights, values, evidence)


@jax.jit
def _log_likelihood(
    method: Method,
    kept: KeptLikelihood,
    values: Float[Array, " S"],
    weights: Float[Array, " K"],
    raw: Demonstration | None,
) -> Float[Array, ""]:
    mdp = method.mdp
    model = surrogate(mdp, kept, values)
    log_policy = method.plan(weights, values).log_policy
    total, size = model_log_likelihood(mdp, model, weights, log_policy), kept.size
    if raw is not None:
        evidence = evidence_of(mdp, method.sensor, raw)
        total += jnp.sum(log_likelihoods(mdp, log_policy, evidence))
        size += jnp.sum(jnp.any(evidence.live, axis=1))
    return total / jnp.maximum(size, 1.0)


def likelihood_learner(
    name: str,
    method: Method,
    state: Any,
    configuration: Mapping[str, Any],
    iterations: int,
    tolerance: float,
) -> Learner:
    """Build the learner; ``state`` is the type of its states, that of LME-I2RL."""
    mdp = method.mdp
    none = Demonstration(*(np.zeros((0, 0), kind) for kind in (np.int8, np.int32, np.int32, np.float64)))

    def init(key: Array) -> Any:
        key, fresh = jax.random.split(as_key(key))
        weights = random_weights(fresh, mdp)
        values = jnp.zeros(mdp.n_states)
        return state(weights, nothing_kept(mdp, none), values, (), jnp.zeros((), int), key)

    def update(given: Any, demonstration: Demonstration) -> tuple[Any, SessionInfo]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration, needed_by="a session")
        kept, raw = given.statistic, given.statistic.raw
        is_raw = int(kept.sessions) == 0
        before = len(np.asarray(raw.kind))
        everything = concatenate([raw, demonstration]) if before else demonstration
        bare = kept._replace(raw=none)
        most = RAW_ITERATIONS if is_raw else iterations
        padded = everything.bucketed()
        if is_raw:  # the first sessions share a program
            n, width = padded.kind.shape
            padded = padded.padded(max(n, RAW_TRAJECTORIES), width)
        end, model, total, each = _learned(
            method, jnp.array(most), tolerance, bare, given.weights, given.values, padded
        )
        own = float(np.sum(np.asarray(each)[before : everything.n_trajectories]))
        if not np.isfinite(own):
            require_possible(method.sensor, mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        number = int((everything.lengths > 0).sum())
        if is_raw and (number < RAW_TRAJECTORIES or everything.lengths.sum() < RAW_STEPS):
            new = bare._replace(raw=everything)
        else:
            new = _expanded(method, bare, model, end.weights, end.values, padded)
            new = new._replace(raw=none)  # of NumPy's arrays, as before
        size = float(kept.size) + number
        info = SessionInfo(
            session=int(given.session) + 1,
            log_likelihood=float(total) / max(size, 1.0),
            demonstration_log_likelihood=own,
            gradient=float(end.gradient) / max(size, 1.0),
            iterations=int(end.iterations),
            solver_iterations=int(end.iterations),
            converged=bool(end.change <= tolerance),
            seconds=time.perf_counter() - began,
            weights=np.asarray(end.weights),
        )
        return given._replace(
            weights=end.weights, statistic=new, values=end.values, session=given.session + 1
        ), info

    def log_likelihood(given: Any, weights: Float[Array, " K"]) -> float:
        kept = given.statistic
        raw = kept.raw.bucketed() if len(np.asarray(kept.raw.kind)) else None
        at = jnp.asarray(weights, float)
        return float(_log_likelihood(method, kept._replace(raw=none), given.values, at, raw))

    return Learner(name, mdp, configuration, init, update, None, log_likelihood)
