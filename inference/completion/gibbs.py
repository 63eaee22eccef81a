"""Gibbs sampling of the truth behind continuous recordings, corrected by Metropolis and Hastings.

The dissertation's sampler (Eq. 6.10, Technique 2) as an exact one. A state given its Markov blanket, or an
action, is proposed from a Gaussian in information form, the dynamics and the policy linearised about the
current value, and accepted by the exact densities; the reverse proposal has its own linearisation. Given all
odd steps the even ones are independent, and given the states so are the actions, so an iteration is three
updates of everything at once. With affine dynamics and policy every proposal is accepted.

Tightly coupled neighbours (small ``Q``) move each other slowly, however many proposals are accepted. Chains
therefore start about the posterior of :mod:`~i2rl.inference.completion.gaussian`'s smoother, each from its
own draw and further out, and every iteration also moves whole trajectories: by steps that preserve the
smoother's posterior (preconditioned Crank-Nicolson; Cotter et al. 2013), accepted by the ratio of the exact
posterior to it. Steps that hardly move raise a warning. The smoother is the default, and this sampler its
check. Bounds are not imposed here.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.recordings import GaussianSensor, Recording, Truths, log_normal, truths
from .gaussian import (
    GaussianTruth,
    JaxDynamics,
    Model,
    TruthChain,
    draw_gaussian,
    log_density,
    log_joint,
    policy_moments,
)
from .kalman import GaussianFiltered

FIRST_PASSES = 6
"""Passes of the smoother before the first iteration; one before every later refresh."""

DISPERSION = 2.0
"""Dispersion of the chains' starts about the smoother's means, relative to the smoother's draws."""

STRIDES = (1.0, 0.5, 0.15)
"""Sizes of moves of whole trajectories, as a share of the smoother's posterior; 1 is a fresh draw."""

FROZEN = 0.01
"""Mobility below which a step counts as frozen."""


@shown_briefly
class GibbsChain(NamedTuple):
    """The observations, ``M`` draws of the truth, and their acceptance.

    Fields
    ------
    reported : Recording
    smoothed : TruthChain
        The smoother's chain, about which chains start and move as a whole.
    observations, actions : float ``[M, n, L, d]``, ``[M, n, L, k]``
    accepted : float ``[2, n, L]``
        Accepted proposals of each state and of each action since ``init``, over all chains.
    accepted_whole : float ``[n]``
        Accepted moves of whole trajectories since ``init``, over all chains.
    sweeps : int
        Number of iterations since ``init``.
    mobility : float ``[n, L]``
        Mean square by which the last refresh moved each step (over chains and coordinates), in units of
        independent draws of the smoother's posterior; NaN on padding and before the first refresh.
    """

    reported: Recording
    smoothed: TruthChain
    observations: Float[Array, "M n L d"]
    actions: Float[Array, "M n L k"]
    accepted: Float[Array, "2 n L"]
    accepted_whole: Float[Array, " n"]
    sweeps: Int[Array, ""]
    mobility: Float[Array, "n L"]

    @property
    def acceptance(self) -> Float[Array, "2 n L"]:
        """Share of accepted proposals of each state and action; NaN on padding."""
        return jnp.where(self.reported.live, self.accepted / (self.sweeps * len(self.observations)), jnp.nan)

    @property
    def acceptance_whole(self) -> Float[Array, " n"]:
        """Share of accepted moves of each whole trajectory."""
        return self.accepted_whole / (self.sweeps * len(self.observations) * len(STRIDES))

    @property
    def least_acceptance(self) -> Float[Array, ""]:
        """Least share over all steps."""
        return jnp.nanmin(self.acceptance)


class _Blanket(NamedTuple):
    """Markov blanket of a state or an action; leading axes ``N``.

    ``first`` and ``followed`` mark the terms: T1 of a first state is the Gaussian of ``s_0``, and a last step
    has no T3.
    """

    expected: Array
    following: Array
    other: Array
    report: Array
    first: Array
    followed: Array


class _Tangent(NamedTuple):
    """Value, next state, and the slope of the next state in the value."""

    value: Array
    following: Array
    slope: Array


def _law_of_start(model: Model, blanket: _Blanket) -> tuple[Array, Array]:
    first = blanket.first[:, None]
    return (
        jnp.where(first, model.initial_mean, blanket.expected),
        jnp.where(first[..., None], model.initial_covariance, model.process_covariance),
    )


def _inverse(covariance: Array) -> Array:
    eye = jnp.broadcast_to(jnp.eye(covariance.shape[-1]), covariance.shape)
    return cho_solve((jnp.linalg.cholesky(covariance), True), eye)


def _pull_back(model: Model, blanket: _Blanket, at: _Tangent) -> tuple[Array, Array]:
    """Return T3 as precision and information of the value."""
    weight = _inverse(model.process_covariance)
    slope = jnp.where(blanket.followed[:, None, None], at.slope, 0.0)
    pulled = jnp.einsum("nji,jk->nik", slope, weight)
    target = blanket.following - at.following + jnp.einsum("nij,nj->ni", slope, at.value)
    return pulled @ slope, jnp.einsum("nij,nj->ni", pulled, target)


def _tangent_policy(policy: Any, observations: Float[Array, "N d"]) -> tuple[Array, Array, Array]:
    """Return mean ``[N, k]``, its derivative ``[N, k, d]`` and covariance ``[N, k, k]`` at observations."""
    means, covariances = policy_moments(policy, observations)
    slopes = jax.vmap(jax.jacfwd(lambda s: policy_moments(policy, s)[0]))(observations)
    return means, slopes, covariances


def _state_law(
    model: Model, policy: Any, sensor: GaussianSensor, blanket: _Blanket, at: _Tangent
) -> tuple[Array, Array]:
    """Return precision and information of a state: T1, T3, T4 and, through the policy's slope, T2."""
    mean, covariance = _law_of_start(model, blanket)
    prior, read = _inverse(covariance), _inverse(sensor.state_covariance)
    mu, K, sigma = _tangent_policy(policy, at.value)
    through = K.swapaxes(-1, -2) @ _inverse(sigma)
    target = blanket.other - mu + jnp.einsum("nij,nj->ni", K, at.value)
    precision, information = _pull_back(model, blanket, at)
    precision += prior + read + through @ K
    information += jnp.einsum("nij,nj->ni", prior, mean) + blanket.report @ read
    return precision, information + jnp.einsum("nij,nj->ni", through, target)


def _action_law(
    model: Model, policy: Any, sensor: GaussianSensor, blanket: _Blanket, at: _Tangent
) -> tuple[Array, Array]:
    """Return precision and information of an action: T2, T3 and T5."""
    mu, sigma = policy_moments(policy, blanket.other)
    prior, read = _inverse(sigma), _inverse(sensor.action_covariance)
    precision, information = _pull_back(model, blanket, at)
    precision += prior + read
    return precision, information + jnp.einsum("nij,nj->ni", prior, mu) + blanket.report @ read


def _log_step(model: Model, blanket: _Blanket, at: _Tangent) -> Array:
    step = log_normal(blanket.following - at.following, model.process_covariance)
    return jnp.where(blanket.followed, step, 0.0)


def _log_state(
    model: Model, policy: Any, sensor: GaussianSensor, blanket: _Blanket, at: _Tangent
) -> Float[Array, " N"]:
    start = log_normal(at.value - model.initial_mean, model.initial_covariance)
    move = log_normal(at.value - blanket.expected, model.process_covariance)
    report = log_normal(blanket.report - at.value, sensor.state_covariance)
    act = policy.log_prob(at.value, blanket.other).astype(float)
    return jnp.where(blanket.first, start, move) + _log_step(model, blanket, at) + report + act


def _log_action(
    model: Model, policy: Any, sensor: GaussianSensor, blanket: _Blanket, at: _Tangent
) -> Float[Array, " N"]:
    report = log_normal(blanket.report - at.value, sensor.action_covariance)
    act = policy.log_prob(blanket.other, at.value).astype(float)
    return _log_step(model, blanket, at) + report + act


_LAWS = {"states": (_state_law, _log_state), "actions": (_action_law, _log_action)}


def _log_proposal(value: Array, precision: Array, information: Array) -> Array:
    factor = jnp.linalg.cholesky(precision)
    mean = cho_solve((factor, True), information[..., None])[..., 0]
    z = jnp.einsum("nji,nj->ni", factor, value - mean)
    return jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)), -1) - 0.5 * jnp.sum(z**2, -1)


@partial(jax.jit, static_argnums=0)
def _proposed(
    which: str,
    key: Array,
    model: Model,
    policy: Any,
    sensor: GaussianSensor,
    blanket: _Blanket,
    at: _Tangent,
) -> Array:
    precision, information = _LAWS[which][0](model, policy, sensor, blanket, at)
    factor = jnp.linalg.cholesky(precision)
    mean = cho_solve((factor, True), information[..., None])
    z = jax.random.normal(key, mean.shape, mean.dtype)
    return (mean + solve_triangular(factor, z, trans=1, lower=True))[..., 0]


@partial(jax.jit, static_argnums=0)
def _log_acceptance(
    which: str,
    model: Model,
    policy: Any,
    sensor: GaussianSensor,
    blanket: _Blanket,
    at: _Tangent,
    to: _Tangent,
) -> Float[Array, " N"]:
    law, log_density = _LAWS[which]
    there = _log_proposal(to.value, *law(model, policy, sensor, blanket, at))
    back = _log_proposal(at.value, *law(model, policy, sensor, blanket, to))
    gain = log_density(model, policy, sensor, blanket, to) - log_density(model, policy, sensor, blanket, at)
    return gain + back - there


@shown_briefly
class GaussianGibbs(NamedTuple):
    """Gibbs sampler: ``init(recording, sensor) -> chain``, ``refresh(chain, policy, key, sensor)``.

    ``refresh`` returns ``(chain, truths)``. A learner accepts it in place of a :class:`GaussianTruth`.

    Fields
    ------
    truth : GaussianTruth
        Dynamics (with ``jacobians``), ``Q``, the law of ``s_0`` and the number of draws (chains, ``M``).
    sweeps : int
        Iterations of a refresh; the draws are the chains after them.
    """

    truth: GaussianTruth
    sweeps: int = 10

    def init(self, reported: Recording, sensor: GaussianSensor) -> GibbsChain:
        """Start at the observations; the first refresh, which has the policy, starts the chains.

        Raises as :meth:`GaussianTruth.init` does.
        """
        smoothed = self.truth.init(reported, sensor)
        rows, shape = reported.live.shape, (self.truth.draws, 1, 1, 1)
        return GibbsChain(
            reported,
            smoothed,
            jnp.tile(reported.observations, shape),
            jnp.tile(reported.actions, shape),
            jnp.zeros((2, *rows)),
            jnp.zeros(rows[0]),
            jnp.zeros((), int),
            jnp.full(rows, jnp.nan),
        )

    def refresh(
        self, chain: GibbsChain, policy: Any, key: Array, sensor: GaussianSensor
    ) -> tuple[GibbsChain, Truths]:
        """Run ``sweeps`` iterations: even states, odd states, actions, whole trajectories.

        Warns of steps that hardly moved (:attr:`GibbsChain.mobility` below ``FROZEN``).
        """
        t, key = self.truth, as_key(key)
        sensor = sensor.sized(chain.observations.shape[-1], chain.actions.shape[-1])
        first = not chain.sweeps
        smoothed, filtered = t.smooth(chain.smoothed, policy, sensor, FIRST_PASSES if first else 1)
        chain = chain._replace(smoothed=smoothed)
        if first:
            key, begin = jax.random.split(key)
            chain = _dispersed(chain, draw_gaussian(begin, filtered, t.draws))
        before = chain
        sweep = _compiled_sweep if isinstance(t.dynamics, JaxDynamics) else _sweep
        for key_sweep in jax.random.split(key, self.sweeps):
            key_steps, key_whole = jax.random.split(key_sweep)
            chain = sweep(t.dynamics, t.model, policy, sensor, chain, key_steps)
            chain = _move_whole(t, policy, sensor, filtered, chain, key_whole)
        chain = chain._replace(sweeps=chain.sweeps + self.sweeps, mobility=_mobility(before, chain))
        _warn_of_frozen(np.asarray(chain.mobility))
        return chain, truths(chain.reported, chain.observations, chain.actions)


def _pairs(chain: GibbsChain) -> Float[Array, "M n L D"]:
    return jnp.concatenate([chain.observations, chain.actions], -1)


def _with_pairs(chain: GibbsChain, pairs: Float[Array, "M n L D"]) -> GibbsChain:
    d = chain.observations.shape[-1]
    moved = jnp.where(chain.reported.live[..., None], pairs, _pairs(chain))
    return chain._replace(observations=moved[..., :d], actions=moved[..., d:])


@jax.jit
def _dispersed(chain: GibbsChain, drawn: Float[Array, "M n L D"]) -> GibbsChain:
    means = chain.smoothed.means
    return _with_pairs(chain, means + DISPERSION * (drawn - means))


@jax.jit
def _mobility(before: GibbsChain, after: GibbsChain) -> Float[Array, "n L"]:
    variances = jnp.diagonal(after.smoothed.covariances, axis1=-2, axis2=-1)
    square = jnp.mean((_pairs(after) - _pairs(before)) ** 2, 0) / (2 * variances)
    return jnp.where(after.reported.live, jnp.min(square, -1), jnp.nan)


def _warn_of_frozen(mobility: Float[np.ndarray, "n L"]) -> None:
    frozen = mobility < FROZEN
    if frozen.any():
        i, t = np.unravel_index(np.nanargmin(mobility), mobility.shape)
        warnings.warn(
            f"{frozen.sum()} of {np.isfinite(mobility).sum()} steps hardly moved, the least of them "
            f"trajectory {i}, step {t} ({mobility[i, t]:.1g} of what independent draws would): make more "
            "sweeps, or smooth with GaussianTruth",
            stacklevel=3,
        )


def _move_whole(
    truth: GaussianTruth,
    policy: Any,
    sensor: GaussianSensor,
    filtered: GaussianFiltered,
    chain: GibbsChain,
    key: Array,
) -> GibbsChain:
    """Move whole trajectories by several step sizes, for narrow and wide posteriors."""
    log_ratio = _log_exact_to_smoothed(truth, policy, sensor, filtered, chain)
    for stride, k in zip(STRIDES, jax.random.split(key, len(STRIDES)), strict=True):
        key_draw, key_accept = jax.random.split(k)
        candidate = _stridden(chain, draw_gaussian(key_draw, filtered, truth.draws), stride)
        log_candidate = _log_exact_to_smoothed(truth, policy, sensor, filtered, candidate)
        chain, log_ratio = _chosen(key_accept, chain, candidate, log_ratio, log_candidate)
    return chain


@jax.jit
def _stridden(chain: GibbsChain, drawn: Float[Array, "M n L D"], stride: float) -> GibbsChain:
    means = chain.smoothed.means
    here, there = _pairs(chain) - means, drawn - means
    return _with_pairs(chain, means + jnp.sqrt(1 - stride**2) * here + stride * there)


@jax.jit
def _chosen(
    key: Array, chain: GibbsChain, candidate: GibbsChain, log_ratio: Array, log_candidate: Array
) -> tuple[GibbsChain, Array]:
    accept = jnp.log(jax.random.uniform(key, log_ratio.shape)) < log_candidate - log_ratio
    rows = accept[..., None, None]
    chain = chain._replace(
        observations=jnp.where(rows, candidate.observations, chain.observations),
        actions=jnp.where(rows, candidate.actions, chain.actions),
        accepted_whole=chain.accepted_whole + jnp.sum(accept, 0),
    )
    return chain, jnp.where(accept, log_candidate, log_ratio)


def _log_exact_to_smoothed(
    truth: GaussianTruth, policy: Any, sensor: GaussianSensor, filtered: GaussianFiltered, chain: GibbsChain
) -> Float[Array, "M n"]:
    """Return each chain's joint log-density of truth and observations, minus the smoother's of the truth."""
    s, a = chain.observations, chain.actions
    flat = _next(truth.dynamics, s.reshape(-1, s.shape[-1]), a.reshape(-1, a.shape[-1]))
    exact = log_joint(truth.model, policy, sensor, chain.reported, s, a, flat.reshape(s.shape))
    return exact - log_density(filtered, chain.reported, _pairs(chain))


def _sweep(
    dynamics: Any,
    model: Model,
    policy: Any,
    sensor: GaussianSensor,
    chain: GibbsChain,
    key: Array,
) -> GibbsChain:
    length = chain.observations.shape[2]
    updates = (("states", 0, 2), ("states", 1, 2), ("actions", 0, 1))
    for (which, first, stride), k in zip(updates, jax.random.split(key, 3), strict=True):
        steps = np.arange(first, length, stride)
        chain = _update(which, steps, dynamics, model, policy, sensor, chain, k)
    return chain


# A simulator is not part of a compiled function.
_compiled_sweep = jax.jit(_sweep, static_argnums=0)


def _update(
    which: str,
    steps: np.ndarray,
    dynamics: Any,
    model: Model,
    policy: Any,
    sensor: GaussianSensor,
    chain: GibbsChain,
    key: Array,
) -> GibbsChain:
    key_move, key_accept = jax.random.split(key)
    s, a, reported = chain.observations, chain.actions, chain.reported
    before, after = np.maximum(steps - 1, 0), np.minimum(steps + 1, s.shape[2] - 1)
    draws = s.shape[0]

    def rows(x: Array) -> Array:
        return x.reshape(-1, *x.shape[3:])

    def tiled(x: Array) -> Array:
        return rows(jnp.broadcast_to(x, (draws, *x.shape)))

    moving, other = (s, a) if which == "states" else (a, s)
    report = reported.observations if which == "states" else reported.actions
    here = rows(s[:, :, steps])
    blanket = _Blanket(
        expected=_next(dynamics, rows(s[:, :, before]), rows(a[:, :, before])) if which == "states" else here,
        following=rows(s[:, :, after]),
        other=rows(other[:, :, steps]),
        report=tiled(report[:, steps]),
        first=tiled(jnp.broadcast_to(steps == 0, (s.shape[1], len(steps)))),
        followed=tiled(reported.followed[:, steps]),
    )
    value = rows(moving[:, :, steps])
    at = _tangent(which, dynamics, value, blanket.other)
    candidate = _proposed(which, key_move, model, policy, sensor, blanket, at)
    to = _tangent(which, dynamics, candidate, blanket.other)
    log_ratio = _log_acceptance(which, model, policy, sensor, blanket, at, to)
    live = tiled(reported.live[:, steps])
    accept = live & (jnp.log(jax.random.uniform(key_accept, log_ratio.shape)) < log_ratio)
    new = jnp.where(accept[:, None], candidate, value).reshape(moving[:, :, steps].shape)
    moved = moving.at[:, :, steps].set(new)
    by_step = jnp.sum(accept.reshape(new.shape[:3]), 0)
    return chain._replace(
        observations=moved if which == "states" else s,
        actions=a if which == "states" else moved,
        accepted=chain.accepted.at[int(which == "actions"), :, steps].add(by_step.T),
    )


def _native(dynamics: Any, s: Array, a: Array) -> tuple[Any, Any]:
    return (s, a) if isinstance(dynamics, JaxDynamics) else (np.asarray(s), np.asarray(a))


def _next(dynamics: Any, s: Array, a: Array) -> Array:
    return jnp.asarray(dynamics.next_state(*_native(dynamics, s, a)))


def _tangent(which: str, dynamics: Any, value: Array, other: Array) -> _Tangent:
    s, a = _native(dynamics, *((value, other) if which == "states" else (other, value)))
    slopes = dynamics.jacobians(s, a)
    return _Tangent(value, _next(dynamics, s, a), jnp.asarray(slopes[0 if which == "states" else 1]))
