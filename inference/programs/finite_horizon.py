"""Maximum causal entropy inverse reinforcement learning over a finite horizon, in a known tabular process.

Among all (time-dependent) policies that collect the expert's features, the one of greatest causal entropy
is the soft policy of some reward ``theta . phi`` (Ziebart 2010, chapters 6 and 9), and
``theta`` minimises the convex dual

    D(theta) = E_{p0}[V_theta(s_0)] - theta . phi_hat,
    dD/dtheta = E_{pi_theta}[sum_t gamma^t phi_t] - phi_hat.

One backward pass gives the value, one forward pass the gradient. For deterministic dynamics and discount
1 the resulting law is the dissertation's ``P(X) ~ exp(theta . f(X))`` (Eq. 2.2). Otherwise Eq. 2.2 would let
the expert choose chance outcomes, and this law does not.

The minimiser is unique up to directions that no policy can influence (a constant added to every reward,
say): the policy is unique, the weights are one choice among those that give it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import optimize

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import finite_hard_plan, finite_occupancy, finite_soft_plan, reward_of
from ...models.process.units import feature_scale, with_scaled_features

# Up to this number of features Newton finishes what L-BFGS leaves: its Hessian costs K tangent passes.
NEWTON_LIMIT = 64
_MAX_EVALUATIONS = 2000
# Larger rewards (in nats) diverge: the target lies outside what policies can collect.
_DIVERGED = 1e7
_MAX_NEWTON_STEPS = 50
_MAX_HALVINGS = 30


class UnmatchedError(RuntimeError):
    """Target that no weights were found to match; the message names the worst feature."""


@shown_briefly
class CausalEntropyFit(NamedTuple):
    """A reward whose soft policy matches the expert.

    Fields
    ------
    weights : float ``[K]``
        Feature weights ``theta``, or the reward of every state (``K = S``).
    gap : float ``[K]``
        Features of the policy minus the target; at most the tolerance everywhere, in units of the features'
        scales.
    value : float
        The dual ``D(theta)``; at the optimum, the (discounted) causal entropy of the policy, in nats.
    evaluations : int
        Number of forward-backward passes (without Hessians).
    """

    weights: Float[np.ndarray, " K"]
    gap: Float[np.ndarray, " K"]
    value: float
    evaluations: int


@partial(jax.jit, static_argnames="horizon")
def discounted_visits(mdp: TabularMDP, reward: Float[Array, "S A"], horizon: int) -> tuple[Array, Array]:
    """Return the soft value and visits of the finite-horizon soft policy of a reward.

    Returns
    -------
    value : float scalar
        ``E_{p0}[V_0(s)]``.
    visits : float ``[S, A]``
        ``sum_{t < T} gamma^t P(s_t = s, a_t = a)``, the gradient of ``value`` in the reward.
    """
    plan = finite_soft_plan(mdp, reward, horizon)
    pairs = finite_occupancy(mdp, jnp.exp(plan.log_policy))
    visits = jnp.einsum("t,tsa->sa", mdp.discount ** jnp.arange(horizon), pairs)
    return mdp.initial @ plan.values[0], visits


def state_reward(mdp: TabularMDP, rewards: Float[Array, " S"]) -> Float[Array, "S A"]:
    """Build the reward of every pair from a reward of the state alone."""
    return jnp.broadcast_to(rewards[:, None], (mdp.n_states, mdp.n_actions))


@partial(jax.jit, static_argnames="horizon")
def expected_features(mdp: TabularMDP, weights: Float[Array, " K"], horizon: int) -> Float[Array, " K"]:
    """Return ``E[sum_{t < T} gamma^t phi(s_t, a_t)]`` under the soft policy of ``weights``.

    This is the inverse of :func:`fit_weights`.
    """
    return jnp.einsum("sa,sak->k", discounted_visits(mdp, reward_of(mdp, weights), horizon)[1], mdp.features)


@partial(jax.jit, static_argnames="horizon")
def expected_visits(mdp: TabularMDP, rewards: Float[Array, " S"], horizon: int) -> Float[Array, " S"]:
    """Return ``sum_{t < T} gamma^t P(s_t = s)`` under the soft policy of state rewards.

    This is the inverse of :func:`fit_state_rewards`.
    """
    return jnp.sum(discounted_visits(mdp, state_reward(mdp, rewards), horizon)[1], axis=1)


@partial(jax.jit, static_argnames="horizon")
def feature_dual(
    mdp: TabularMDP, weights: Float[Array, " K"], target: Float[Array, " K"], horizon: int
) -> tuple[Array, Array]:
    """Return the dual ``D(theta)`` and its gradient ``[K]``, the feature gap."""
    value, visits = discounted_visits(mdp, reward_of(mdp, weights), horizon)
    return value - weights @ target, jnp.einsum("sa,sak->k", visits, mdp.features) - target


@partial(jax.jit, static_argnames="horizon")
def _state_dual(
    mdp: TabularMDP, rewards: Float[Array, " S"], target: Float[Array, " S"], horizon: int
) -> tuple[Array, Array]:
    # The same dual for one-hot state features, which are never built.
    value, visits = discounted_visits(mdp, state_reward(mdp, rewards), horizon)
    return value - rewards @ target, jnp.sum(visits, axis=1) - target


@partial(jax.jit, static_argnames="horizon")
def _feature_curvature(mdp: TabularMDP, weights: Float[Array, " K"], horizon: int) -> Float[Array, " K"]:
    # Second moments of the features under the visits: the Hessian's diagonal without correlations.
    return jnp.einsum(
        "sa,sak->k", discounted_visits(mdp, reward_of(mdp, weights), horizon)[1], mdp.features**2
    )


@partial(jax.jit, static_argnames="horizon")
def _feature_hessian(
    mdp: TabularMDP, weights: Float[Array, " K"], target: Float[Array, " K"], horizon: int
) -> Float[Array, "K K"]:
    return jax.jacfwd(lambda w: feature_dual(mdp, w, target, horizon)[1])(weights)


def fit_weights(
    mdp: TabularMDP,
    horizon: int,
    target: Float[np.ndarray, " K"],
    *,
    tolerance: float = 1e-6,
    start: Float[np.ndarray, " K"] | None = None,
) -> CausalEntropyFit:
    """Fit weights of the state-action features whose soft policy collects ``target``.

    L-BFGS on the dual; if its line search runs out of digits before the tolerance is met, Newton's
    method finishes (up to ``NEWTON_LIMIT`` features).

    Parameters
    ----------
    mdp : TabularMDP
        Its discount may be 1.
    horizon : int
        ``T``, the steps of a demonstration.
    target : float ``[K]``
        ``phi_hat``, the expert's ``E[sum_{t < T} gamma^t phi(s_t, a_t)]``. From demonstrations of length
        ``T``: ``expectations(...).features / expectations(...).size``.
    tolerance : float
        Largest remaining gap of any feature, in units of its scale (:mod:`~i2rl.models.process.units`). For
        targets averaged over few demonstrations it is the slack of the relaxed constraint: set it to the
        sampling error and the weights stay finite.
    start : float ``[K]``, optional
        Weights to start from (zeros); a previous session's make a warm start.

    Raises
    ------
    ValueError
        For wrong shapes, a horizon below 1, and targets that are not numbers.
    UnmatchedError
        If no policy collects the target, or the tolerance is finer than the arithmetic; names the feature.

    See Also
    --------
    i2rl.inference.solve_dual : the program over an infinite horizon
    i2rl.models.finite_soft_plan : the policy of the weights

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import fit_weights
    >>> fit = fit_weights(five_cells().mdp, horizon=6, target=np.array([0.8, 3.5]))
    >>> print(fit.weights.shape, np.abs(fit.gap).max() < 1e-5)  # the policy collects the target
    (2,) True
    """
    _check(horizon, tolerance)
    target = _vector("target", target, mdp.n_features, "features")
    weights = (
        np.zeros(mdp.n_features) if start is None else _vector("start", start, mdp.n_features, "features")
    )
    scale, scaled = np.asarray(feature_scale(mdp)), with_scaled_features(mdp)
    wanted = target / scale
    # A single pass scatters faster than it gathers (twice, at 1024 states), and processes of one size then
    # share one compiled program. The Hessian, many passes side by side, uses the gather: 6 times faster.
    dual = partial(_evaluate, feature_dual, scaled.without_inflow(), wanted, horizon)
    curvature = np.asarray(_feature_curvature(scaled.without_inflow(), weights * scale, horizon))
    fit = _lbfgs(dual, curvature, weights * scale, tolerance)
    if mdp.n_features <= NEWTON_LIMIT:
        fit = _newton(
            dual, lambda w: np.asarray(_feature_hessian(scaled, w, wanted, horizon)), fit, tolerance
        )
    fit = fit._replace(weights=fit.weights / scale, gap=fit.gap * scale)
    _require_matched(
        fit,
        target,
        tolerance * scale,
        lambda k: f"feature {mdp.feature_names[k]!r}",
        partial(_feature_range, mdp, horizon),
    )
    return fit


def fit_state_rewards(
    mdp: TabularMDP,
    horizon: int,
    target: Float[np.ndarray, " S"],
    *,
    tolerance: float = 1e-6,
    start: Float[np.ndarray, " S"] | None = None,
) -> CausalEntropyFit:
    """Fit one reward per state whose soft policy visits the states as often as the expert.

    The special case of one-hot state features, by L-BFGS, without writing the features out; ``mdp.features``
    is not used. Variables are scaled by the square root of the target, the curvature's order of magnitude.

    Parameters
    ----------
    mdp, horizon, start
        As for :func:`fit_weights`.
    target : float ``[S]``
        The expert's ``sum_{t < T} gamma^t P(s_t = s)``; it sums to ``sum_{t < T} gamma^t``.
    tolerance : float
        Largest remaining gap of any state's visits. Below about 1e-8 the dual's value has no more digits for
        the line search.

    Raises
    ------
    ValueError
        As for :func:`fit_weights`, and for a target that is negative or has another sum.
    UnmatchedError
        If no policy has these visits, or the tolerance is finer than the arithmetic; names the state.
    """
    _check(horizon, tolerance)
    target = _vector("target", target, mdp.n_states, "states")
    rewards = np.zeros(mdp.n_states) if start is None else _vector("start", start, mdp.n_states, "states")
    total = float(np.sum(float(mdp.discount) ** np.arange(horizon)))
    if target.min() < 0:
        s = int(target.argmin())
        raise ValueError(f"target visits must not be negative; state {mdp.state_names[s]!r} has {target[s]}")
    if abs(target.sum() - total) > max(mdp.n_states * tolerance, 1e-8 * total):
        raise ValueError(
            f"target visits must sum to {total:.6g} (the discounted steps of horizon {horizon}), "
            f"got {target.sum():.6g}"
        )
    dual = partial(_evaluate, _state_dual, mdp.without_inflow(), target, horizon)
    fit = _lbfgs(dual, target, rewards, tolerance)
    _require_matched(
        fit,
        target,
        np.full(mdp.n_states, tolerance),
        lambda s: f"state {mdp.state_names[s]!r}",
        partial(_visits_range, mdp, horizon),
    )
    return fit


# -- solvers ------------------------------------------------------------------------------------------


_Dual = Callable[[np.ndarray], tuple[float, np.ndarray]]


def _evaluate(
    dual: Callable[..., tuple[Array, Array]],
    mdp: TabularMDP,
    target: np.ndarray,
    horizon: int,
    weights: np.ndarray,
) -> tuple[float, np.ndarray]:
    value, gap = dual(mdp, weights, target, horizon)
    return float(value), np.asarray(gap)


def _newton(
    dual: _Dual, hessian: Callable[[np.ndarray], np.ndarray], fit: CausalEntropyFit, tolerance: float
) -> CausalEntropyFit:
    """Run Newton on ``gap = 0`` from an earlier fit, halving each step until the gap's norm shrinks.

    The Newton direction always descends on that norm, which unlike the dual's value has all its digits near
    the solution.
    """
    weights, gap, value, evaluations = fit
    for _ in range(_MAX_NEWTON_STEPS):
        if np.abs(gap).max() <= tolerance:
            break
        # Least squares: the step is zero in directions that no policy can influence.
        step = -np.linalg.lstsq(hessian(weights), gap, rcond=1e-12)[0]
        for halving in range(_MAX_HALVINGS):
            length = 0.5**halving
            trial_value, trial_gap = dual(weights + length * step)
            evaluations += 1
            if np.linalg.norm(trial_gap) <= (1 - 1e-4 * length) * np.linalg.norm(gap):
                break
        else:
            break
        weights, gap, value = weights + length * step, trial_gap, trial_value
    return CausalEntropyFit(weights, gap, value, evaluations)


def _lbfgs(dual: _Dual, curvature: np.ndarray, weights: np.ndarray, tolerance: float) -> CausalEntropyFit:
    """Run L-BFGS on the dual, variables scaled by the root of an estimate of its diagonal curvature."""
    scale = np.sqrt(np.maximum(curvature, 1e-3 * curvature.mean() + 1e-12))
    latest = (weights, *dual(weights))
    evaluations = 1

    def scaled(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal latest, evaluations
        if evaluations > 1 or not np.array_equal(z, latest[0] * scale):
            latest = (z / scale, *dual(z / scale))
            evaluations += 1
        return latest[1], latest[2] / scale

    def stop(intermediate_result: optimize.OptimizeResult) -> None:
        if np.abs(latest[2]).max() <= tolerance or np.abs(intermediate_result.x).max() > _DIVERGED:
            raise StopIteration

    if np.abs(latest[2]).max() > tolerance:
        optimize.minimize(
            scaled,
            weights * scale,
            jac=True,
            method="L-BFGS-B",
            callback=stop,
            options={"ftol": 0.0, "gtol": 0.0, "maxiter": _MAX_EVALUATIONS, "maxfun": _MAX_EVALUATIONS},
        )
    final, value, gap = latest
    return CausalEntropyFit(final, gap, value, evaluations)


# -- errors at the border -----------------------------------------------------------------------------


def _check(horizon: int, tolerance: float) -> None:
    if horizon < 1:
        raise ValueError(f"the horizon must be at least 1 step, got {horizon}")
    if not tolerance > 0:
        raise ValueError(f"the tolerance must be positive, got {tolerance}")


def _vector(what: str, given: np.ndarray, length: int, of: str) -> np.ndarray:
    vector = np.asarray(given, dtype=float)
    if vector.shape != (length,):
        raise ValueError(
            f"{what} must have shape [{length}], one number for each of the {of}, got {vector.shape}"
        )
    if not np.isfinite(vector).all():
        k = int(np.flatnonzero(~np.isfinite(vector))[0])
        raise ValueError(f"{what} must be finite; entry {k} is {vector[k]}")
    return vector


@partial(jax.jit, static_argnames="horizon")
def _attainable(mdp: TabularMDP, horizon: int, feature: Float[Array, "S A"]) -> tuple[Array, Array]:
    """Return the least and greatest expectation of one feature's discounted sum, over all policies."""
    least, most = (mdp.initial @ finite_hard_plan(mdp, sign * feature, horizon).values[0] for sign in (-1, 1))
    return 0.0 - least, most


def _feature_range(mdp: TabularMDP, horizon: int, k: int) -> tuple[Array, Array]:
    return _attainable(mdp, horizon, mdp.features[..., k])


def _visits_range(mdp: TabularMDP, horizon: int, s: int) -> tuple[Array, Array]:
    return _attainable(mdp, horizon, state_reward(mdp, jnp.eye(1, mdp.n_states, s)[0]))


def _require_matched(
    fit: CausalEntropyFit,
    target: np.ndarray,
    tolerance: np.ndarray,
    name: Callable[[int], str],
    attainable: Callable[[int], tuple[Array, Array]],
) -> None:
    worst = int((np.abs(fit.gap) / tolerance).argmax())
    if abs(fit.gap[worst]) <= tolerance[worst]:
        return
    least, most = attainable(worst)
    wanted = f"{name(worst)} should reach {target[worst]:.6g}"
    if least <= target[worst] <= most:
        cause = (
            f"{wanted}, and is {abs(fit.gap[worst]):.3g} off after {fit.evaluations} evaluations; "
            f"the target may contradict itself, or the tolerance {tolerance[worst]:g} be finer than the "
            "arithmetic"
        )
    else:
        cause = f"{wanted}, but lies between {least:.6g} and {most:.6g} under any policy"
    raise UnmatchedError(f"no policy was found that collects the target: {cause}")
