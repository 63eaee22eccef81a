"""The truth behind noisy recordings of continuous states and actions: Technique 2 of section 6.2.3.

Every term of Eq. 6.10 is Gaussian about a function of the truth: T1 and T3 ``s_{t+1} ~ N(f(s_t, a_t), Q)``,
T2 ``a_t ~ pi(. | s_t)``, T4 and T5 the sensor, whose data are the *reports*; ``s_0`` has a wide Gaussian.
The pairs of a trajectory then are one chain, and its joint posterior is found by the iterated extended
Kalman smoother (Bell 1994): dynamics and policy are linearised about the estimate, the affine chain is
smoothed exactly, and the estimate moves towards the result as far as the exact joint density rises
(Särkkä and Svensson 2020). It is exact for affine dynamics and policies; elsewhere draws are those of the
Gaussian about the likeliest trajectory. :mod:`.gaussian_gibbs` samples the same posterior without that.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from ..models.sensing import (
    GaussianSensor,
    Recording,
    Truths,
    checked_covariance,
    covariance_matrix,
    log_normal,
    truths,
)
from .kalman import (
    AffineGaussian,
    GaussianFiltered,
    GaussianSmoothed,
    filter_gaussian,
    sample_filtered,
    smooth_filtered,
)

STEPS = (1.0, 0.5, 0.25, 0.1)
"""Shares of the way to the smoothed mean that are tried."""

FURTHEST = 6.0
"""Standard deviations of the sensor beyond which a report is not believed to be from the truth."""


class Dynamics(Protocol):
    """What follows a state and an action, without noise; in JAX or, like MuJoCo, in NumPy."""

    def next_state(self, states: Any, actions: Any) -> Any:
        """Next states ``[n, d]`` after states ``[n, d]`` and actions ``[n, k]``."""

    def jacobians(self, states: Any, actions: Any) -> tuple[Any, Any]:
        """Derivatives by the state, ``[n, d, d]``, and by the action, ``[n, d, k]``."""


class JaxDynamics(NamedTuple):
    """Compiled dynamics; made by :func:`jax_dynamics`."""

    next_state: Callable
    jacobians: Callable


def jax_dynamics(f: Callable[[Array, Array], Array]) -> JaxDynamics:
    """Dynamics of a differentiable function of one state ``[d]`` and one action ``[k]``, in JAX."""
    return JaxDynamics(jax.jit(jax.vmap(f)), jax.jit(jax.vmap(jax.jacfwd(f, (0, 1)))))


class Point(NamedTuple):
    """An estimate of the truth, and the dynamics linearised about it.

    Fields
    ------
    observations, actions : float ``[n, L, d]``, ``[n, L, k]``
    following : float ``[n, L, d]``
        ``f(s_t, a_t)``.
    by_state, by_action : float ``[n, L, d, d]``, ``[n, L, d, k]``
    """

    observations: Float[Array, "n L d"]
    actions: Float[Array, "n L k"]
    following: Float[Array, "n L d"]
    by_state: Float[Array, "n L d d"]
    by_action: Float[Array, "n L d k"]


class TruthChain(NamedTuple):
    """What is kept between calls: the reports, and the estimate so far."""

    reported: Recording
    point: Point


class Model(NamedTuple):
    """The law of the truth but for the policy: ``Q [d, d]`` and the Gaussian of ``s_0``."""

    process_covariance: Float[Array, "d d"]
    initial_mean: Float[Array, " d"]
    initial_covariance: Float[Array, "d d"]


def policy_moments(policy: Any, observations: Float[Array, "... d"]) -> tuple[Array, Array]:
    """Mean ``[..., k]`` and covariance ``[..., k, k]`` of a policy's action, in 64 bits.

    Its own ``moments`` where it has them (a mixture is matched by its first two); otherwise ``mode`` and
    ``log_deviation``, as of :class:`~i2rl.models.networks.GaussianPolicy`.
    """
    if hasattr(policy, "moments"):
        mean, covariance = policy.moments(observations)
    else:
        mean = policy.mode(observations)
        covariance = jnp.broadcast_to(
            jnp.diag(jnp.exp(2 * policy.log_deviation.astype(float))), (*mean.shape, mean.shape[-1])
        )
    return mean.astype(float), covariance.astype(float)


def linear_policy(policy: Any, observations: Float[Array, "N d"]) -> tuple[Array, Array, Array]:
    """Mean ``[N, k]``, its derivative ``[N, k, d]`` and covariance ``[N, k, k]`` at each observation."""

    def mean(s: Array) -> Array:
        return policy_moments(policy, s)[0]

    means, covariances = policy_moments(policy, observations)
    return means, jax.vmap(jax.jacfwd(mean))(observations), covariances


def _affine_chains(
    model: Model, policy: Any, sensor: GaussianSensor, reported: Recording, point: Point
) -> AffineGaussian:
    """The chain of pairs ``(s, a)``, linearised; every field with a leading ``n``.

    The action is drawn from the state it is taken in: ``a' = mu + K (s' - s0') + N(0, Sigma)``, hence
    ``(s', a')`` has the transition ``[I; K] [A, B]`` and the noise ``[I; K] Q [I; K]' + diag(0, Sigma)``.
    """
    n, length, d = point.observations.shape
    k = point.actions.shape[-1]
    flat = point.observations.reshape(-1, d)
    mu, K, sigma = (x.reshape(n, length, *x.shape[1:]) for x in linear_policy(policy, flat))
    intercept = mu - jnp.einsum("ntkd,ntd->ntk", K, point.observations)
    lift = jnp.concatenate([jnp.broadcast_to(jnp.eye(d), (n, length, d, d)), K], 2)
    # Beyond a trajectory's end anything finite will do, and zeros cannot grow.
    followed = reported.followed[:, :-1, None, None]
    slope = jnp.concatenate([point.by_state, point.by_action], -1)[:, :-1]
    pairs = jnp.concatenate([point.observations, point.actions], -1)
    start = point.following[:, :-1] - jnp.einsum("ntij,ntj->nti", slope, pairs[:, :-1])
    D = d + k

    def action_block(covariance: Array) -> Array:
        return jnp.zeros((*covariance.shape[:-2], D, D)).at[..., d:, d:].set(covariance)

    def lifted(covariance: Array, which: Array) -> Array:
        return which @ covariance @ which.swapaxes(-1, -2)

    offset = jnp.einsum("ntij,ntj->nti", lift[:, 1:], start).at[..., d:].add(intercept[:, 1:])
    first = jnp.einsum("nij,j->ni", lift[:, 0], model.initial_mean).at[:, d:].add(intercept[:, 0])
    R = jax.scipy.linalg.block_diag(sensor.state_covariance, sensor.action_covariance)
    return AffineGaussian(
        first,
        lifted(model.initial_covariance, lift[:, 0]) + action_block(sigma[:, 0]),
        jnp.where(followed, lift[:, 1:] @ slope, 0.0),
        jnp.where(followed[..., 0], offset, 0.0),
        lifted(model.process_covariance, lift[:, 1:]) + action_block(sigma[:, 1:]),
        jnp.broadcast_to(jnp.eye(D), (n, D, D)),
        jnp.broadcast_to(R, (n, length, D, D)),
    )


@jax.jit
def _filter(model: Model, policy: Any, sensor: GaussianSensor, chain: TruthChain) -> GaussianFiltered:
    chains = _affine_chains(model, policy, sensor, chain.reported, chain.point)
    reports = jnp.concatenate([chain.reported.observations, chain.reported.actions], -1)
    return lax.map(lambda x: filter_gaussian(*x), (chains, reports, chain.reported.live))


@jax.jit
def _smooth(filtered: GaussianFiltered) -> GaussianSmoothed:
    return lax.map(smooth_filtered, filtered)


@partial(jax.jit, static_argnums=2)
def _draw(key: Array, filtered: GaussianFiltered, draws: int) -> Float[Array, "M n L D"]:
    keys = jax.random.split(key, filtered.means.shape[0])
    return lax.map(lambda x: sample_filtered(x[0], x[1], draws), (keys, filtered)).swapaxes(0, 1)


@jax.jit
def _on_the_way(sensor: GaussianSensor, chain: TruthChain, means: Array) -> tuple[Array, Array]:
    """Estimates ``STEPS`` of the way to the means, none beyond ``FURTHEST``; ``[len(STEPS), n, L, .]``."""
    reported, point = chain.reported, chain.point
    d = point.observations.shape[-1]

    def towards(now: Array, mean: Array, report: Array, covariance: Array) -> Array:
        radius = FURTHEST * jnp.sqrt(jnp.diagonal(covariance))
        shares = jnp.asarray(STEPS)[:, None, None, None]
        moved = jnp.clip(now + shares * (mean - now), report - radius, report + radius)
        return jnp.where(reported.live[..., None], moved, now)

    return (
        towards(point.observations, means[..., :d], reported.observations, sensor.state_covariance),
        towards(point.actions, means[..., d:], reported.actions, sensor.action_covariance),
    )


@jax.jit
def log_joint(
    model: Model,
    policy: Any,
    sensor: GaussianSensor,
    reported: Recording,
    observations: Float[Array, "*m n L d"],
    actions: Float[Array, "*m n L k"],
    following: Float[Array, "*m n L d"],
) -> Float[Array, "*m n"]:
    """Exact log-density of a truth together with the reports, in nats, per trajectory.

    ``following`` is ``f(s_t, a_t)``; what it is beyond a trajectory's end does not matter.
    """
    start = log_normal(observations[..., 0, :] - model.initial_mean, model.initial_covariance)
    moves = log_normal(observations[..., 1:, :] - following[..., :-1, :], model.process_covariance)
    acts = policy.log_prob(observations, actions).astype(float)
    reports = sensor.log_prob(reported.observations, reported.actions, observations, actions)
    return (
        start
        + jnp.sum(jnp.where(reported.followed[:, :-1], moves, 0.0), -1)
        + jnp.sum(jnp.where(reported.live, acts + reports, 0.0), -1)
    )


@jax.jit
def _chosen(candidates: Array, best: Array, better: Array, now: Array) -> Array:
    picked = jnp.take_along_axis(candidates, best.reshape(1, -1, *[1] * (now.ndim - 1)), 0)[0]
    return jnp.where(better.reshape(-1, *[1] * (now.ndim - 1)), picked, now)


class GaussianTruth(NamedTuple):
    """Smoothing and joint draws of the truth behind a recording; made by :func:`gaussian_truth`.

    ``init(recording) -> chain``, ``refresh(chain, policy, key, sensor) -> (chain, truths)``. Chains persist:
    the next refresh starts where the last one ended, so one relinearisation a refresh is enough in the long
    run. ``resample`` draws anew under another policy or sensor without a relinearisation, in milliseconds
    for a short chain whatever the dynamics.
    """

    dynamics: Any
    model: Model
    draws: int
    iterations: int
    widths: tuple[float, ...]

    def init(self, reported: Recording) -> TruthChain:
        """Start at the reports. Raises ``ValueError`` where the sizes are not the model's."""
        d = self.model.initial_mean.shape[0]
        if reported.actions.ndim != 3 or reported.observations.shape[-1] != d:
            raise ValueError(
                f"expected observations [n, L, {d}] and actions [n, L, k], got "
                f"{reported.observations.shape} and {reported.actions.shape}"
            )
        s, a = reported.observations, reported.actions
        return TruthChain(reported, self._linearised(reported, s, a, self._following(reported, s, a), 0))

    def refresh(
        self, chain: TruthChain, policy: Any, key: Array, sensor: GaussianSensor
    ) -> tuple[TruthChain, Truths]:
        """Improve the estimate by ``iterations`` relinearisations, then draw."""
        for i in range(self.iterations):
            s, a, following = self._improved(chain, policy, sensor, self._filtered(chain, policy, sensor))
            chain = chain._replace(point=self._linearised(chain.reported, s, a, following, i))
        return chain, self.resample(chain, policy, key, sensor)

    def resample(self, chain: TruthChain, policy: Any, key: Array, sensor: GaussianSensor) -> Truths:
        """Draws ``[M, n, L, .]`` with the dynamics as last linearised."""
        filtered = self._filtered(chain, policy, sensor)
        s, a, _ = self._improved(chain, policy, sensor, filtered)
        return _centred(chain.reported, s, a, _smooth(filtered).means, _draw(key, filtered, self.draws))

    def posterior(self, chain: TruthChain, policy: Any, sensor: GaussianSensor) -> GaussianSmoothed:
        """Moments of the pairs ``(s, a)``, ``[n, L, D]`` and so on, with the dynamics as last linearised."""
        filtered = self._filtered(chain, policy, sensor)
        s, a, _ = self._improved(chain, policy, sensor, filtered)
        return _smooth(filtered)._replace(means=jnp.concatenate([s, a], -1))

    def log_joint(self, chain: TruthChain, policy: Any, sensor: GaussianSensor) -> Float[Array, " n"]:
        """Exact log-density of the estimate together with the reports, in nats."""
        return log_joint(self.model, policy, self._sized(chain, sensor), chain.reported, *chain.point[:3])

    def _sized(self, chain: TruthChain, sensor: GaussianSensor) -> GaussianSensor:
        return sensor.sized(chain.point.observations.shape[-1], chain.point.actions.shape[-1])

    def _filtered(self, chain: TruthChain, policy: Any, sensor: GaussianSensor) -> GaussianFiltered:
        return _filter(self.model, policy, self._sized(chain, sensor), chain)

    def _improved(
        self, chain: TruthChain, policy: Any, sensor: GaussianSensor, filtered: GaussianFiltered
    ) -> tuple[Array, Array, Array]:
        """The estimate as far towards the smoothed mean as the joint density is highest; it never falls."""
        sensor = self._sized(chain, sensor)
        now = log_joint(self.model, policy, sensor, chain.reported, *chain.point[:3])
        s, a = _on_the_way(sensor, chain, _smooth(filtered).means)
        f = self._following(chain.reported, s, a)
        tried = jnp.nan_to_num(
            log_joint(self.model, policy, sensor, chain.reported, s, a, f), nan=-jnp.inf, neginf=-jnp.inf
        )
        best = jnp.argmax(tried, 0)
        better = jnp.max(tried, 0) > now
        s, a, f = (_chosen(x, best, better, old) for x, old in zip((s, a, f), chain.point[:3], strict=True))
        return s, a, f

    def _following(self, reported: Recording, s: Array, a: Array) -> Array:
        if isinstance(self.dynamics, JaxDynamics):
            flat = self.dynamics.next_state(s.reshape(-1, s.shape[-1]), a.reshape(-1, a.shape[-1]))
            return flat.reshape(s.shape)
        # Simulators are asked only about steps that exist.
        following = np.array(s)
        there = np.broadcast_to(np.asarray(reported.followed), s.shape[:-1])
        following[there] = self.dynamics.next_state(following[there], np.asarray(a)[there])
        return jnp.asarray(following)

    def _linearised(self, reported: Recording, s: Array, a: Array, following: Array, i: int) -> Point:
        (n, length, d), k = s.shape, a.shape[-1]
        if isinstance(self.dynamics, JaxDynamics):
            A, B = self.dynamics.jacobians(s.reshape(-1, d), a.reshape(-1, k))
            return Point(s, a, following, A.reshape(n, length, d, d), B.reshape(n, length, d, k))
        width = self.widths[min(i, len(self.widths) - 1) :][:1]
        A, B = np.zeros((n, length, d, d)), np.zeros((n, length, d, k))
        there = np.asarray(reported.followed)
        A[there], B[there] = self.dynamics.jacobians(np.asarray(s)[there], np.asarray(a)[there], *width)
        return Point(s, a, following, jnp.asarray(A), jnp.asarray(B))


@jax.jit
def _centred(reported: Recording, s: Array, a: Array, means: Array, drawn: Array) -> Truths:
    """Draws moved from the smoothed mean to the estimate, which differ where the dynamics bend."""
    d = s.shape[-1]
    spread = jnp.where(reported.live[..., None], drawn - means, 0.0)
    return truths(reported, s + spread[..., :d], a + spread[..., d:])


def gaussian_truth(
    dynamics: Any,
    observation_size: int,
    *,
    process_covariance: ArrayLike = 1e-4,
    initial_mean: ArrayLike | None = None,
    initial_covariance: ArrayLike = 100.0,
    draws: int = 4,
    iterations: int = 3,
    widths: tuple[float, ...] = (),
) -> GaussianTruth:
    """The truth under given dynamics.

    Parameters
    ----------
    dynamics : Dynamics
    observation_size : int, ``d``
    process_covariance : number, ``[d]`` or ``[d, d]``
        ``Q``: how far a step may be from what the dynamics say.
    initial_mean, initial_covariance : ``[d]`` (zeros by default); number, ``[d]`` or ``[d, d]``
    draws : int, ``M``
    iterations : int
        Relinearisations a refresh.
    widths : floats
        Half-widths of the differences from which a simulator takes its slopes (a third argument of its
        ``jacobians``), iteration by iteration, the last one from then on; empty leaves it to the simulator.
        Where contacts make the dynamics jump, wide differences first and narrower ones later go much further.

    Raises
    ------
    ValueError
        For covariances that are none or of another size, and counts below one.
    """
    if draws < 1 or iterations < 1:
        raise ValueError(f"draws and iterations must be at least 1, got {draws} and {iterations}")
    d = observation_size
    mean = jnp.zeros(d) if initial_mean is None else jnp.asarray(initial_mean, float)
    if mean.shape != (d,):
        raise ValueError(f"initial_mean must have shape [{d}], got {mean.shape}")

    def matrix(whose: str, given: ArrayLike) -> Array:
        return covariance_matrix(whose, checked_covariance(whose, given), d)

    return GaussianTruth(
        dynamics,
        Model(matrix("process", process_covariance), mean, matrix("initial", initial_covariance)),
        draws,
        iterations,
        tuple(widths),
    )


@partial(jax.jit, static_argnums=2)
def fitted_sensor(reported: Recording, posterior: GaussianSmoothed, full: bool = False) -> GaussianSensor:
    """The sensor under which the reports are likeliest, given the posterior (the M-step).

    Covariances are means of ``E[(o - x)(o - x)']`` over all steps; their diagonals unless ``full``.
    """
    reports = jnp.concatenate([reported.observations, reported.actions], -1)
    live = reported.live[..., None]
    error = jnp.where(live, reports - posterior.means, 0.0)
    second = jnp.einsum("nti,ntj->ij", error, error)
    second += jnp.sum(jnp.where(live[..., None], posterior.covariances, 0.0), (0, 1))
    second /= jnp.sum(reported.live)
    d = reported.observations.shape[-1]
    return GaussianSensor(
        *(b if full else jnp.diag(jnp.diagonal(b)) for b in (second[:d, :d], second[d:, d:]))
    )
