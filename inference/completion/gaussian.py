"""The truth behind noisy recordings of continuous states and actions: Technique 2 of section 6.2.3.

Every term of Eq. 6.10 is Gaussian about a function of the truth: T1 and T3 ``s_{t+1} ~ N(f(s_t, a_t), Q)``,
T2 ``a_t ~ pi(. | s_t)``, T4 and T5 the sensor, whose data are the observations; ``s_0`` has a wide Gaussian.
The pairs of a trajectory form one chain, and an iterated Kalman smoother finds its joint posterior: dynamics
and policy are replaced by affine functions about the posterior so far, the affine chain is smoothed exactly,
and so on (posterior linearisation; García-Fernández, Svensson and Särkkä 2017).

Slopes are taken across the posterior, by divided differences along its axes, and the residual of the affine
function is added to ``Q`` (Nørgaard, Poulsen and Ravn 2000). A foot that may or may not touch the ground
thereby loosens its own step only, and tightens it again as the posterior narrows; slopes at a point (the
extended Kalman smoother) make velocities *worse* than the observations there. For affine dynamics and
policies the first pass is exact. :mod:`~i2rl.inference.completion.gibbs` samples the posterior without the
approximation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import solve_triangular
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.arguments import as_key, described
from ...models.inputs.display import shown_briefly
from ...models.observation.recordings import (
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
    log_density_filtered,
    sample_filtered,
    smooth_filtered,
)

FURTHEST = 6.0
"""Standard deviations of the sensor beyond which an observation is discounted."""

CAUTION = ((1.0, 30.0), (3.0, 20.0), (2.0, 10.0), (1.5, 5.0), (1.0, 3.0))
"""Caution of the first passes and, the last entry, of all later ones: factors that widen the posterior before
differences are taken, and that scale their residual (they see each axis, not the axes' common curvature).
Both
are neutral for affine dynamics."""

_FAR = 30.0  # deviations from a bound at which it makes no difference
_LEAST_DEVIATION = 0.03

_REACH = 3.0**0.5  # in deviations: matches a Gaussian's fourth moment


class Dynamics(Protocol):
    """Noise-free successors of states and actions; in JAX or, like MuJoCo, in NumPy."""

    def next_state(self, states: Any, actions: Any) -> Any:
        """Return next states ``[n, d]`` after states ``[n, d]`` and actions ``[n, k]``."""

    def jacobians(self, states: Any, actions: Any) -> tuple[Any, Any]:
        """Return derivatives by the state, ``[n, d, d]``, and by the action, ``[n, d, k]``."""


@shown_briefly
class JaxDynamics(NamedTuple):
    """Compiled dynamics; made by :func:`jax_dynamics`."""

    next_state: Callable
    jacobians: Callable


def jax_dynamics(f: Callable[[Array, Array], Array]) -> JaxDynamics:
    """Compile dynamics from a differentiable function of one state ``[d]`` and one action ``[k]``, in JAX."""
    return JaxDynamics(jax.jit(jax.vmap(f)), jax.jit(jax.vmap(jax.jacfwd(f, (0, 1)))))


@shown_briefly
class TruthChain(NamedTuple):
    """State between calls: the observations, the posterior so far and the dynamics linearised across it.

    Fields
    ------
    reported : Recording
    means, covariances : float ``[n, L, D]``, ``[n, L, D, D]``
        Posterior of the pairs ``(s, a)``, ``D = d + k``.
    following, slope : float ``[n, L, d]``, ``[n, L, d, D]``
        Value and slope of ``f`` at ``centre``.
    centre : float ``[n, L, D]``
    remainder : float ``[n, L, d, d]``
        Covariance of the affine function's residual.
    passes : int
        Number of passes so far.
    """

    reported: Recording
    means: Float[Array, "n L D"]
    covariances: Float[Array, "n L D D"]
    following: Float[Array, "n L d"]
    slope: Float[Array, "n L d D"]
    centre: Float[Array, "n L D"]
    remainder: Float[Array, "n L d d"]
    passes: Int[Array, ""]


@shown_briefly
class Bounds(NamedTuple):
    """Bounds of the pairs ``(s, a)``, ``[D]`` or a number."""

    low: Float[Array, "*D"]
    high: Float[Array, "*D"]


@shown_briefly
class Model(NamedTuple):
    """Law of the truth without the policy: ``Q [d, d]`` and the Gaussian of ``s_0``."""

    process_covariance: Float[Array, "d d"]
    initial_mean: Float[Array, " d"]
    initial_covariance: Float[Array, "d d"]


def policy_moments(policy: Any, observations: Float[Array, "... d"]) -> tuple[Array, Array]:
    """Return mean ``[..., k]`` and covariance ``[..., k, k]`` of a policy's action, in 64 bits.

    They are its own ``moments`` if it has them (a mixture is matched by its first two), otherwise ``mode``
    and ``log_deviation``, as of :class:`~i2rl.models.networks.modules.GaussianPolicy`.
    """
    if hasattr(policy, "moments"):
        mean, covariance = policy.moments(observations)
    else:
        mean = policy.mode(observations)
        covariance = jnp.broadcast_to(
            jnp.diag(jnp.exp(2 * policy.log_deviation.astype(float))), (*mean.shape, mean.shape[-1])
        )
    return mean.astype(float), covariance.astype(float)


def executed_moments(policy: Any, bounds: Bounds, observations: Float[Array, "... d"]) -> tuple[Array, Array]:
    """Return mean and covariance of a policy's action after clipping to its bounds, as in environments.

    A policy whose mean lies far outside always acts at the bound, and carries no information about the state.
    Components are those of a censored Gaussian; their correlations are preserved. Without bounds this is
    :func:`policy_moments`.
    """
    mean, covariance = policy_moments(policy, observations)
    if bounds.low.ndim == 0:
        return mean, covariance
    d = observations.shape[-1]
    sd = jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))
    low = jnp.clip((bounds.low[d:] - mean) / sd, -_FAR, _FAR)
    high = jnp.clip((bounds.high[d:] - mean) / sd, -_FAR, _FAR)
    below, above = norm.cdf(low), norm.sf(high)
    inside = 1 - below - above
    first = low * below + high * above + norm.pdf(low) - norm.pdf(high)
    second = low**2 * below + high**2 * above + inside + low * norm.pdf(low) - high * norm.pdf(high)
    share = jnp.sqrt(jnp.maximum(second - first**2, 0.0))
    # A certain action would leave the slopes of its step no room for error.
    least = _LEAST_DEVIATION**2 * jnp.eye(sd.shape[-1])
    cut = jnp.clip(mean + sd * first, bounds.low[d:], bounds.high[d:])
    return cut, share[..., None] * covariance * share[..., None, :] + least


def _caution(passes: Array) -> tuple[Array, Array]:
    widening, count = jnp.asarray(CAUTION)[jnp.minimum(passes, len(CAUTION) - 1)]
    return widening, count


def _points(centre: Float[Array, "... D"], covariance: Float[Array, "... D D"]) -> tuple[Array, Array]:
    """Return a Cholesky factor, and the centre and both ends of each axis, ``[..., 1 + 2 D, D]``."""
    slack = 1e-14 * jnp.trace(covariance, axis1=-2, axis2=-1)[..., None, None] * jnp.eye(centre.shape[-1])
    factor = jnp.linalg.cholesky(covariance + slack)
    axes, middle = _REACH * factor.swapaxes(-1, -2), centre[..., None, :]
    return factor, jnp.concatenate([middle, middle + axes, middle - axes], -2)


def _differences(factor: Array, values: Float[Array, "... P m"]) -> tuple[Array, Array, Array]:
    """Return mean ``[..., m]``, slope ``[..., m, D]`` and residual covariance of values at the points."""
    D = factor.shape[-1]
    middle, up, down = values[..., 0, :], values[..., 1 : D + 1, :], values[..., D + 1 :, :]
    bend = up + down - 2 * middle[..., None, :]
    slope = solve_triangular(factor, (up - down) / (2 * _REACH), trans=1, lower=True).swapaxes(-1, -2)
    rest = (_REACH**2 - 1) / (4 * _REACH**4) * jnp.einsum("...ai,...aj->...ij", bend, bend)
    return middle + bend.sum(-2) / (2 * _REACH**2), slope, rest


def _affine_chains(
    model: Model, bounds: Bounds, policy: Any, sensor: GaussianSensor, chain: TruthChain
) -> AffineGaussian:
    """Build the linearised chain of pairs ``(s, a)``; every field with a leading ``n``.

    The action depends on the state it is taken in: ``a' = mu + K (s' - s0') + N(0, Sigma)``, hence
    ``(s', a')`` has the transition ``[I; K] [A, B]`` and the noise ``[I; K] Q [I; K]' + diag(0, Sigma)``.
    """
    n, length, d, D = chain.slope.shape
    states = chain.centre[..., :d]
    factor, points = _points(states, chain.covariances[..., :d, :d])
    mean, covariance = executed_moments(policy, bounds, points)
    mu, K, rest = _differences(factor, mean)
    sigma = covariance[..., 0, :, :] + _caution(chain.passes - 1)[1] * rest
    intercept = mu - jnp.einsum("ntkd,ntd->ntk", K, states)
    lift = jnp.concatenate([jnp.broadcast_to(jnp.eye(d), (n, length, d, d)), K], 2)
    start = chain.following - jnp.einsum("ntij,ntj->nti", chain.slope, chain.centre)
    noise = model.process_covariance + chain.remainder

    def with_action(covariance: Array, which: Array, action: Array) -> Array:
        return (which @ covariance @ which.swapaxes(-1, -2)).at[..., d:, d:].add(action)

    offset = jnp.einsum("ntij,ntj->nti", lift[:, 1:], start[:, :-1]).at[..., d:].add(intercept[:, 1:])
    first = jnp.einsum("nij,j->ni", lift[:, 0], model.initial_mean).at[:, d:].add(intercept[:, 0])
    R = jax.scipy.linalg.block_diag(sensor.state_covariance, sensor.action_covariance)
    # Beyond a trajectory's end any finite number is allowed, and zeros cannot grow.
    followed = chain.reported.followed[:, :-1, None, None]
    return AffineGaussian(
        first,
        with_action(model.initial_covariance, lift[:, 0], sigma[:, 0]),
        jnp.where(followed, lift[:, 1:] @ chain.slope[:, :-1], 0.0),
        jnp.where(followed[..., 0], offset, 0.0),
        with_action(noise[:, :-1], lift[:, 1:], sigma[:, 1:]),
        jnp.broadcast_to(jnp.eye(D), (n, D, D)),
        jnp.broadcast_to(R, (n, length, D, D)),
    )


@jax.jit
def _filter(
    model: Model, bounds: Bounds, policy: Any, sensor: GaussianSensor, chain: TruthChain
) -> GaussianFiltered:
    chains = _affine_chains(model, bounds, policy, sensor, chain)
    reports = jnp.concatenate([chain.reported.observations, chain.reported.actions], -1)
    return lax.map(lambda x: filter_gaussian(*x), (chains, reports, chain.reported.live))


@jax.jit
def _smooth(filtered: GaussianFiltered) -> GaussianSmoothed:
    return lax.map(smooth_filtered, filtered)


@partial(jax.jit, static_argnums=2)
def draw_gaussian(key: Array, filtered: GaussianFiltered, draws: int) -> Float[Array, "M n L D"]:
    """Draw trajectories from filtered Gaussian chains."""
    keys = jax.random.split(key, filtered.means.shape[0])
    return lax.map(lambda x: sample_filtered(x[0], x[1], draws), (keys, filtered)).swapaxes(0, 1)


@jax.jit
def log_density(
    filtered: GaussianFiltered, reported: Recording, pairs: Float[Array, "M n L D"]
) -> Float[Array, "M n"]:
    """Return the log-density of truths under the linearised posterior."""

    def one(inputs: tuple) -> Float[Array, " M"]:
        passed, live, drawn = inputs
        return jax.vmap(lambda x: log_density_filtered(passed, x, live))(drawn)

    return lax.map(one, (filtered, reported.live, pairs.swapaxes(0, 1))).T


@jax.jit
def _axes(bounds: Bounds, sensor: GaussianSensor, chain: TruthChain) -> tuple[Array, Array, Array]:
    """Return centre, Cholesky factor, and the points of the differences ``[n, L, 1 + 2 D, D]``."""
    reports = jnp.concatenate([chain.reported.observations, chain.reported.actions], -1)
    radius = FURTHEST * jnp.sqrt(
        jnp.concatenate([jnp.diagonal(sensor.state_covariance), jnp.diagonal(sensor.action_covariance)])
    )
    near = jnp.clip(chain.means, reports - radius, reports + radius)
    centre = jnp.clip(near, bounds.low, bounds.high)
    return centre, *_points(centre, _caution(chain.passes)[0] * chain.covariances)


@jax.jit
def _across(chain: TruthChain, centre: Array, factor: Array, values: Float[Array, "n L P d"]) -> TruthChain:
    """Fit the affine function through the values at the points of :func:`_axes`."""
    following, slope, rest = _differences(factor, values)
    return chain._replace(
        following=following,
        slope=slope,
        centre=centre,
        remainder=_caution(chain.passes)[1] * rest,
        passes=chain.passes + 1,
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
    """Return the exact joint log-density of a truth and the observations, in nats, per trajectory.

    ``following`` is ``f(s_t, a_t)``; its values beyond a trajectory's end are ignored.
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


@shown_briefly
class GaussianTruth(NamedTuple):
    """Smoothing and joint draws of the truth behind a recording; made by :func:`gaussian_truth`.

    ``init(recording, sensor) -> chain``, ``refresh(chain, policy, key, sensor) -> (chain, truths)``. Chains
    persist: the next refresh continues the last one, so that a single pass suffices after the first.
    ``resample`` draws anew, under another policy or sensor, without evaluating the dynamics.
    """

    dynamics: Any
    model: Model
    bounds: Bounds
    draws: int

    def init(self, reported: Recording, sensor: GaussianSensor) -> TruthChain:
        """Start at the observations, with the sensor's uncertainty and no linearisation.

        Raises ``ValueError`` if the sizes differ from the model's, and ``TypeError`` for another sensor.
        """
        if not isinstance(sensor, GaussianSensor):
            raise TypeError(f"sensor must be a GaussianSensor; got {described(sensor)}")
        d = self.model.initial_mean.shape[0]
        if reported.actions.ndim != 3 or reported.observations.shape[-1] != d:
            raise ValueError(
                f"expected observations [n, L, {d}] and actions [n, L, k], got "
                f"{reported.observations.shape} and {reported.actions.shape}"
            )
        k = reported.actions.shape[-1]
        if self.bounds.low.ndim and len(self.bounds.low) != d + k:
            raise ValueError(
                f"there are bounds of {len(self.bounds.low) - d} actions, but actions [n, L, {k}]"
            )
        sensor = sensor.sized(d, k)
        means = jnp.concatenate([reported.observations, reported.actions], -1)
        n, length, D = means.shape
        R = jax.scipy.linalg.block_diag(sensor.state_covariance, sensor.action_covariance)
        return TruthChain(
            reported,
            means,
            jnp.broadcast_to(R, (n, length, D, D)),
            jnp.zeros((n, length, d)),
            jnp.zeros((n, length, d, D)),
            means,
            jnp.zeros((n, length, d, d)),
            jnp.zeros((), int),
        )

    def refresh(
        self, chain: TruthChain, policy: Any, key: Array, sensor: GaussianSensor, passes: int = 1
    ) -> tuple[TruthChain, Truths]:
        """Draw ``[M, n, L, .]`` after this number of passes: 5 or more at first, later one per call.

        Raises ``ValueError`` for fewer than one pass (:meth:`resample` draws without).
        """
        chain, filtered = self.smooth(chain, policy, sensor, passes)
        draws = draw_gaussian(as_key(key), filtered, self.draws)
        return chain, _bounded_truths(self.bounds, chain.reported, draws)

    def smooth(
        self, chain: TruthChain, policy: Any, sensor: GaussianSensor, passes: int = 1
    ) -> tuple[TruthChain, GaussianFiltered]:
        """Relinearise and smooth this number of times; :meth:`refresh` draws from the result."""
        if passes < 1:
            raise ValueError(f"passes must be at least 1, got {passes}")
        sensor = self._sized(sensor, chain)
        for _ in range(passes):
            centre, factor, points = _axes(self.bounds, sensor, chain)
            chain = _across(chain, centre, factor, self._next_states(chain.reported, points))
            filtered = _filter(self.model, self.bounds, policy, sensor, chain)
            smoothed = _smooth(filtered)
            chain = chain._replace(means=smoothed.means, covariances=smoothed.covariances)
        return chain, filtered

    def resample(self, chain: TruthChain, policy: Any, key: Array, sensor: GaussianSensor) -> Truths:
        """Draw with the dynamics as last linearised, after at least one :meth:`refresh`."""
        filtered = _filter(self.model, self.bounds, policy, self._sized(sensor, chain), chain)
        return _bounded_truths(self.bounds, chain.reported, draw_gaussian(as_key(key), filtered, self.draws))

    def posterior(self, chain: TruthChain, policy: Any, sensor: GaussianSensor) -> GaussianSmoothed:
        """Return moments of the pairs ``(s, a)`` and the log-likelihood, with the last linearisation."""
        return _smooth(_filter(self.model, self.bounds, policy, self._sized(sensor, chain), chain))

    def estimate(self, chain: TruthChain) -> tuple[Float[Array, "n L d"], Float[Array, "n L k"]]:
        """Return posterior means of states and actions, within the bounds."""
        means = jnp.clip(chain.means, self.bounds.low, self.bounds.high)
        d = chain.slope.shape[2]
        return means[..., :d], means[..., d:]

    def _sized(self, sensor: GaussianSensor, chain: TruthChain) -> GaussianSensor:
        _, _, d, D = chain.slope.shape
        return sensor.sized(d, D - d)

    def _next_states(self, reported: Recording, points: Float[Array, "n L P D"]) -> Float[Array, "n L P d"]:
        d = self.model.initial_mean.shape[0]
        if isinstance(self.dynamics, JaxDynamics):
            flat = points.reshape(-1, points.shape[-1])
            return self.dynamics.next_state(flat[:, :d], flat[:, d:]).reshape(*points.shape[:-1], d)
        # Simulators are evaluated only at steps that exist.
        there, host = np.asarray(reported.followed), np.asarray(points)
        flat = host[there].reshape(-1, host.shape[-1])
        following = np.zeros((*host.shape[:-1], d))
        following[there] = self.dynamics.next_state(flat[:, :d], flat[:, d:]).reshape(-1, host.shape[2], d)
        return jnp.asarray(following)


@jax.jit
def _bounded_truths(bounds: Bounds, reported: Recording, drawn: Float[Array, "M n L D"]) -> Truths:
    d = reported.observations.shape[-1]
    reports = jnp.concatenate([reported.observations, reported.actions], -1)
    drawn = jnp.where(reported.live[..., None], jnp.clip(drawn, bounds.low, bounds.high), reports)
    return truths(reported, drawn[..., :d], drawn[..., d:])


def gaussian_truth(
    dynamics: Any,
    observation_size: int,
    *,
    process_covariance: ArrayLike = 1e-4,
    initial_mean: ArrayLike | None = None,
    initial_covariance: ArrayLike = 100.0,
    observation_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    action_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    draws: int = 4,
) -> GaussianTruth:
    """Build the truth under given dynamics.

    Parameters
    ----------
    dynamics : Dynamics
        Only ``next_state`` is used.
    observation_size : int, ``d``
    process_covariance : number, ``[d]`` or ``[d, d]``
        ``Q``: covariance of a step about the dynamics.
    initial_mean, initial_covariance : ``[d]`` (zeros by default); number, ``[d]`` or ``[d, d]``
    observation_bounds, action_bounds : pairs of ``[d]`` and of ``[k]``, or None
        Bounds of the truth: estimates and draws are clipped to them, and so are the policy's actions in the
        model (:func:`executed_moments`). Both or neither.
    draws : int, ``M``

    Raises
    ------
    ValueError
        For invalid covariances or those of another size, bounds out of order, and no draws.

    See Also
    --------
    i2rl.inference.robust_airl : a learner with this truth
    i2rl.models.GaussianSensor : the sensor

    Examples
    --------
    >>> from i2rl.domains import onion_reaching
    >>> from i2rl.inference import gaussian_truth
    >>> robot = onion_reaching()  # 29 observations, 3 actions
    >>> truth = gaussian_truth(robot, robot.observation_size, draws=2)
    >>> truth.draws, truth.model.initial_mean.shape
    (2, (29,))
    """
    if draws < 1:
        raise ValueError(f"draws must be at least 1, got {draws}")
    if (observation_bounds is None) != (action_bounds is None):
        raise ValueError(
            "give bounds of both observations and actions, or of neither (infinite ones are fine)"
        )
    d = observation_size
    mean = jnp.zeros(d) if initial_mean is None else jnp.asarray(initial_mean, float)
    if mean.shape != (d,):
        raise ValueError(f"initial_mean must have shape [{d}], got {mean.shape}")
    low, high = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    if observation_bounds is not None and action_bounds is not None:
        low, high = (
            jnp.concatenate(
                [jnp.broadcast_to(jnp.asarray(s, float), (d,)), jnp.asarray(a, float).reshape(-1)]
            )
            for s, a in zip(observation_bounds, action_bounds, strict=True)
        )
        if low.shape != high.shape or not (low < high).all():
            raise ValueError(f"lower bounds must be below upper ones, got {low} and {high}")

    def matrix(whose: str, given: ArrayLike) -> Array:
        return covariance_matrix(whose, checked_covariance(whose, np.asarray(given, float)), d)

    return GaussianTruth(
        dynamics,
        Model(matrix("process", process_covariance), mean, matrix("initial", initial_covariance)),
        Bounds(low, high),
        draws,
    )


@partial(jax.jit, static_argnums=2)
def fitted_sensor(reported: Recording, posterior: GaussianSmoothed, full: bool = False) -> GaussianSensor:
    """Fit the sensor to the observations by maximum likelihood, given the posterior (the M-step).

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
