"""The maximum-entropy program (Eq. 2.4 with relaxed constraints), and its matrix-free solution in JAX.

Among all policies whose expected features are within ``slack`` of the expert's, find the one of largest
causal entropy. Its Lagrange multipliers are the reward weights. Three forms of the one program agree:

- primal, over occupancies, in CVXPY: :mod:`~i2rl.inference.programs.primal`;
- dual, over weights and values, in CasADi with IPOPT: :mod:`~i2rl.inference.programs.dual`;
- dual, over the weights alone, values by soft planning: here. It compiles, so that ``vmap`` maps fleets of
  learners, and needs no more memory than the features, so that it scales.

The dual is ``min_theta p0.V_theta - theta.phi_hat + sum_k slack_k |theta_k| + ridge/2 |theta|^2``. The
slack of the constraints is the L1 penalty of the weights, as in the proofs of Theorems 1 and 3, where
``slack = epsilon / (1 - gamma)``. The conditional likelihood of visit counts has the same shape (a linear
function of values and weights), and is solved by the same iterations.

Every solver divides each feature by its scale first (:mod:`~i2rl.models.process.units`), and multiplies
weights by it: ``slack`` and ``ridge`` penalise scaled weights, tolerances are relative to scaled features,
and results do not depend on the units of a feature. Arguments and results are weights of the original
features.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import (
    feature_expectations,
    features_to_go,
    occupancy,
    require_discounted,
    reward_of,
    soft_plan,
)
from ...models.process.units import feature_scale, with_scaled_features
from .constraints import FeatureTarget, failure, shaped_slack, shaped_target

_MAX_ITERATIONS = 100
_MAX_SWEEPS = 50
_MAX_HALVINGS = 40
# The iteration aims at the first, relative to the features' scale, and calls anything below the second
# converged (as IPOPT's tolerances): rounding may stop it in between when the discount is close to 1.
_TARGET_RESIDUAL = 1e-10
_ACCEPTED_RESIDUAL = 1e-7
# The quadratic model is damped if its steps prove too long (Levenberg 1944).
_LEAST_DAMPING = 1e-2
_LARGEST_DAMPING = 1e4
# One step changes a reward by at most this many nats: beyond it the quadratic model is invalid.
_MAX_REWARD_CHANGE = 50.0


@shown_briefly
class WarmStart(NamedTuple):
    """Start of a solver: ``weights [K]``, and ``values [S]`` close to their soft values."""

    weights: Float[Array, " K"]
    values: Float[Array, " S"]


@shown_briefly
class Solution(NamedTuple):
    """Solution of a program by the JAX solvers.

    Fields
    ------
    weights : float ``[K]``
        ``theta``, the reward weights.
    values : float ``[S]``
        Their soft values ``V_theta``.
    objective : float
        The minimised objective, penalties included (nats).
    residual : float
        Violation of the optimality (KKT) conditions by scaled weights, relative to the target.
    iterations : int
        Newton iterations (gradient steps for the exponentiated gradient).
    converged : bool
        True if the residual met the tolerance.
    """

    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    objective: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]

    def warm(self) -> WarmStart:
        """Return the start for the next session."""
        return WarmStart(self.weights, self.values)


def solve_dual(
    mdp: TabularMDP,
    target: FeatureTarget,
    slack: ArrayLike = 0.0,
    ridge: ArrayLike = 0.0,
    start: WarmStart | None = None,
) -> Solution:
    """Solve the feature program's dual, ``min p0.V - theta.phi_hat + slack.|theta| + ridge/2 |theta|^2``.

    Proximal Newton method with the exact Hessian, ``sum_s occupancy(s) Cov_{a ~ pi(.|s)} dQ(s, .)``. If
    weights are not unique (dependent features without slack) it stays close to its start. Works under ``jit``
    and ``vmap``, where errors cannot be raised: check ``converged``, or pass the solution to
    :func:`require_converged`. A target that only a deterministic policy meets has infinite weights without
    slack or ridge; the result is then large enough to meet the tolerance, and otherwise arbitrary.

    Parameters
    ----------
    mdp : TabularMDP
        With discount below 1.
    target : FeatureTarget
        Features to match and the distribution of the first state.
    slack : float or ``[K]``
        ``beta_k >= 0``: largest distance of expected features from the target, in units of each feature's
        scale (:func:`~i2rl.models.process.units.feature_scale`).
    ridge : float
        Quadratic penalty on the scaled weights.
    start : WarmStart or None
        A previous solution (``solution.warm()``); zero weights by default.

    Raises
    ------
    ValueError
        For discount 1, or arrays of the wrong shape.

    See Also
    --------
    i2rl.inference.DualProgram : the same program with IPOPT
    i2rl.inference.PrimalProgram : its primal with CVXPY
    i2rl.inference.fit_weights : the program over a finite horizon

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import solve_dual
    >>> from i2rl.inference.programs.constraints import FeatureTarget
    >>> from i2rl.inference.programs.maximum_entropy import require_converged
    >>> from i2rl.models import feature_expectations, reward_of, soft_plan
    >>> mdp, weights, *_ = five_cells()
    >>> policy = soft_plan(mdp, reward_of(mdp, weights)).policy
    >>> target = FeatureTarget(feature_expectations(mdp, policy), mdp.initial)
    >>> solution = require_converged(mdp, target, 0.0, solve_dual(mdp, target))
    >>> print(solution.weights.round(2))  # those of the expert
    [ 2.  -0.2]
    """
    require_discounted(mdp)
    features, initial = shaped_target(mdp, target)
    scale = feature_scale(mdp)
    scaled = FeatureTarget(features / scale, initial)
    return _unscaled(
        solve_scaled_dual(with_scaled_features(mdp), scaled, slack, ridge, _scaled(start, scale)), scale
    )


def solve_scaled_dual(
    mdp: TabularMDP,
    target: FeatureTarget,
    slack: ArrayLike = 0.0,
    ridge: ArrayLike = 0.0,
    start: WarmStart | None = None,
) -> Solution:
    """Solve :func:`solve_dual`'s program for a process with scaled features."""
    objective = LinearObjective(jnp.asarray(target.start, float), jnp.asarray(target.features, float))
    return minimise(mdp, objective, shaped_slack(mdp, slack), jnp.asarray(ridge, float), start)


def fit_counts(
    mdp: TabularMDP,
    counts: Float[Array | np.ndarray, "S A"],
    slack: ArrayLike = 0.0,
    ridge: ArrayLike = 0.0,
    start: WarmStart | None = None,
) -> Solution:
    """Maximise the likelihood of visits, ``sum N log pi_theta - slack.|theta| - ridge/2 |theta|^2``.

    ``objective`` is minus that, in nats. The iterations are those of :func:`solve_dual`, with the convex part
    of the Hessian (the program is not convex: with few counts it may have several stationary points, and one
    downhill from the start is returned).

    Parameters
    ----------
    mdp : TabularMDP
        With discount below 1.
    counts : float ``[S, A]``
        ``N(s, a) >= 0``: (expected) visits; zero for unavailable pairs.
    slack, ridge : float or ``[K]``, float
        Penalties on the scaled weights, in nats.
    start : WarmStart or None
        A previous solution; zero weights by default.

    Raises
    ------
    ValueError
        For discount 1, or arrays of the wrong shape.

    See Also
    --------
    i2rl.inference.expectations : expected visits of a demonstration
    i2rl.inference.solve_dual : matches features instead

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import fit_counts
    >>> from i2rl.models import occupancy, reward_of, soft_plan
    >>> mdp, weights, *_ = five_cells()
    >>> visits = occupancy(mdp, soft_plan(mdp, reward_of(mdp, weights)).policy)
    >>> print(fit_counts(mdp, 100 * visits).weights.round(2))  # the weights of the expert
    [ 2.  -0.2]
    """
    require_discounted(mdp)
    scale = feature_scale(mdp)
    return _unscaled(
        fit_scaled_counts(
            with_scaled_features(mdp), jnp.asarray(counts), slack, ridge, _scaled(start, scale)
        ),
        scale,
    )


def fit_scaled_counts(
    mdp: TabularMDP,
    counts: Float[Array, "S A"],
    slack: ArrayLike = 0.0,
    ridge: ArrayLike = 0.0,
    start: WarmStart | None = None,
) -> Solution:
    """Solve :func:`fit_counts`'s program for a process with scaled features."""
    return minimise(
        mdp, count_objective(mdp, counts), shaped_slack(mdp, slack), jnp.asarray(ridge, float), start
    )


def _scaled(start: WarmStart | None, scale: Float[Array, " K"]) -> WarmStart | None:
    return None if start is None else start._replace(weights=jnp.asarray(start.weights, float) * scale)


def _unscaled(solution: Solution, scale: Float[Array, " K"]) -> Solution:
    return solution._replace(weights=solution.weights / scale)


@jax.jit
def soft_values(
    mdp: TabularMDP, weights: Float[Array, " K"], start: Float[Array, " S"] | None = None
) -> Float[Array, " S"]:
    """Return soft values ``V_theta [S]`` of reward weights; ``start`` as for :func:`soft_plan`."""
    return soft_plan(mdp, reward_of(mdp, weights), start).values


# -- the objective, its derivatives -------------------------------------------------------------------


@shown_briefly
class LinearObjective(NamedTuple):
    """``g(theta) = state_weights . V_theta - features . theta``; both programs have this shape.

    Its Hessian is ``sum_s x(s) Cov_{a ~ pi(.|s)} dQ(s, .)``, ``x`` the discounted occupancy that flows from
    ``state_weights``.
    """

    state_weights: Float[Array, " S"]
    features: Float[Array, " K"]


def count_objective(mdp: TabularMDP, counts: ArrayLike) -> LinearObjective:
    """Build minus the conditional log-likelihood: ``sum N (V - Q) = (n - gamma P'N).V - theta.sum N phi``."""
    counts = jnp.asarray(counts, float)
    if counts.shape != mdp.available.shape:
        raise ValueError(
            f"counts must have shape [S, A] = {list(mdp.available.shape)}, got {list(counts.shape)}"
        )
    return LinearObjective(
        counts.sum(1) - mdp.discount * mdp.push_forward(counts),
        jnp.einsum("sa,sak->k", counts, mdp.features),
    )


class _Expansion(NamedTuple):
    """Second-order expansion of the objective's smooth part, and the gradient ``dV [S, K]`` of the values."""

    gradient: Float[Array, " K"]
    hessian: Float[Array, "K K"]
    value_gradient: Float[Array, "S K"]
    scale: Float[Array, ""]


def expand(
    mdp: TabularMDP, objective: LinearObjective, weights: Float[Array, " K"], values: Float[Array, " S"]
) -> _Expansion:
    """Expand the objective to second order around a point."""
    q = mdp.features @ weights + mdp.discount * mdp.expect_next(values)
    policy = jax.nn.softmax(jnp.where(mdp.available, q, -jnp.inf), axis=1)
    to_go = features_to_go(mdp, policy)
    # Visits of another policy give some states negative occupancies. Without these the model stays convex,
    # and above the objective to second order.
    information = jnp.maximum(occupancy(mdp, policy, objective.state_weights).sum(1), 0.0)
    next_to_go = jax.vmap(mdp.expect_next, in_axes=1, out_axes=2)(to_go)
    deviation = (mdp.features + mdp.discount * next_to_go - to_go[:, None]).reshape(-1, mdp.n_features)
    weighted = (information[:, None] * policy).reshape(-1, 1) * deviation
    expected = objective.state_weights @ to_go
    # The terms whose difference is the gradient: the features themselves, without their sign.
    scale = jnp.max(jnp.abs(objective.features) + jnp.abs(objective.state_weights) @ jnp.abs(to_go))
    return _Expansion(expected - objective.features, weighted.T @ deviation, to_go, scale)


def count_information(
    mdp: TabularMDP, counts: Float[Array, "S A"], weights: Float[Array, " K"], values: Float[Array, " S"]
) -> Float[Array, "K K"]:
    """Return the information about weights in visits ``counts [S, A]``: minus the log-likelihood's Hessian.

    It is taken at weights whose soft values are ``values [S]``. It is always positive semi-definite, and
    exact if the visits flow as the soft policy's would.
    """
    return expand(mdp, count_objective(mdp, counts), weights, values).hessian


def _kkt_residual(
    slope: Float[Array, " K"], slack: Float[Array, " K"], weights: Float[Array, " K"]
) -> Float[Array, ""]:
    """Return the distance of zero from ``slope + slack d|weights|``, the largest over features."""
    at_zero = jnp.maximum(jnp.abs(slope) - slack, 0.0)
    return jnp.max(jnp.where(weights == 0, at_zero, jnp.abs(slope + slack * jnp.sign(weights))))


# -- the iterations -----------------------------------------------------------------------------------


class _Iterate(NamedTuple):
    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    objective: Float[Array, ""]
    expansion: _Expansion
    residual: Float[Array, ""]
    damping: Float[Array, ""]
    iterations: Int[Array, ""]
    finished: Bool[Array, ""]


class _Line(NamedTuple):
    """The line that is searched from an iterate: its direction, what it promises, and how far to go."""

    move: Float[Array, " K"]
    change: Float[Array, ""]
    noise: Float[Array, ""]
    length: Float[Array, ""]
    halvings: Int[Array, ""]


@jax.jit
def minimise(
    mdp: TabularMDP,
    objective: LinearObjective,
    slack: Float[Array, " K"],
    ridge: Float[Array, ""],
    start: WarmStart | None,
) -> Solution:
    """Run proximal Newton: quadratic model of the smooth part, exact L1, line search on the objective."""

    def penalty(weights: Float[Array, " K"]) -> Float[Array, ""]:
        return slack @ jnp.abs(weights) + 0.5 * ridge * weights @ weights

    def evaluate(weights: Float[Array, " K"], values: Float[Array, " S"]) -> tuple:
        values = soft_plan(mdp, reward_of(mdp, weights), values).values
        smooth = objective.state_weights @ values - objective.features @ weights
        return values, smooth + penalty(weights)

    def arrive(
        weights: Float[Array, " K"],
        values: Float[Array, " S"],
        value: Float[Array, ""],
        damping: Float[Array, ""],
        iterations: Int[Array, ""],
    ) -> _Iterate:
        at = expand(mdp, objective, weights, values)
        residual = _kkt_residual(at.gradient + ridge * weights, slack, weights)
        relative = residual / jnp.where(at.scale > 0, at.scale, 1.0)
        finished = relative <= _TARGET_RESIDUAL
        return _Iterate(weights, values, value, at, relative, damping, iterations, finished)

    def direction(now: _Iterate) -> _Line:
        at = now.expansion
        curvature = at.hessian + jnp.diag(ridge + now.damping * jnp.diag(at.hessian))
        slope = at.gradient + ridge * now.weights
        move = quadratic_l1(curvature, slope, slack, now.weights, 1e-12 * at.scale) - now.weights
        change = slope @ move + slack @ (jnp.abs(now.weights + move) - jnp.abs(now.weights))
        # The objective is a difference of sums of this size: it cannot resolve smaller changes.
        size = jnp.abs(objective.state_weights) @ jnp.abs(now.values) + jnp.abs(
            objective.features @ now.weights
        )
        noise = 1e-14 * (1.0 + size)
        longest = jnp.max(jnp.abs(mdp.features @ move))
        first = jnp.minimum(1.0, _MAX_REWARD_CHANGE / jnp.maximum(longest, 1e-300))
        return _Line(move, change, noise, first, jnp.array(0))

    def attempt(carry: tuple[_Iterate, _Line]) -> tuple[_Iterate, _Line]:
        now, line = carry
        weights = now.weights + line.length * line.move
        guess = now.values + line.length * (now.expansion.value_gradient @ line.move)
        values, value = evaluate(weights, guess)
        first = now.iterations < 0
        accepted = first | (value <= now.objective + 1e-4 * line.length * line.change + line.noise)

        def advance() -> tuple[_Iterate, _Line]:
            damping = jnp.where(
                line.halvings > 0,
                jnp.clip(now.damping * 4.0, _LEAST_DAMPING, _LARGEST_DAMPING),
                jnp.where(now.damping > _LEAST_DAMPING, now.damping / 4.0, 0.0),
            )
            new = arrive(weights, values, value, damping, now.iterations + 1)
            # A predicted change lost in rounding that no longer improves the residual is the end of the road.
            worse = ~first & ~(new.residual < now.residual)
            stuck = ~accepted | (worse & (jnp.abs(line.change) <= line.noise))
            kept = jax.tree.map(lambda old, fresh: jnp.where(stuck & worse, old, fresh), now, new)
            kept = kept._replace(iterations=now.iterations + 1, finished=new.finished | stuck)
            return kept, lax.cond(kept.finished, lambda: line, lambda: direction(kept))

        def halve() -> tuple[_Iterate, _Line]:
            return now, line._replace(length=0.5 * line.length, halvings=line.halvings + 1)

        return lax.cond(accepted | (line.halvings >= _MAX_HALVINGS), advance, halve)

    def unfinished(carry: tuple[_Iterate, _Line]) -> Bool[Array, ""]:
        now, _ = carry
        return ~now.finished & (now.iterations < _MAX_ITERATIONS)

    if start is None:
        weights, values = jnp.zeros(mdp.n_features), jnp.zeros(mdp.n_states)
    else:
        weights, values = jnp.asarray(start.weights, float), jnp.asarray(start.values, float)
    # One loop over points to evaluate, the start the first of them, so that planning and expanding are in the
    # compiled program once: compiling it is what a first session waits for.
    zero, nowhere = jnp.zeros(()), jnp.array(jnp.inf)
    n = len(weights)
    unknown = _Expansion(jnp.zeros(n), jnp.zeros((n, n)), jnp.zeros((len(values), n)), zero)
    before = _Iterate(weights, values, nowhere, unknown, nowhere, zero, jnp.array(-1), jnp.array(False))
    still = _Line(jnp.zeros(n), zero, zero, zero, jnp.array(0))
    final, _ = lax.while_loop(unfinished, attempt, (before, still))
    return Solution(
        final.weights,
        final.values,
        final.objective,
        final.residual,
        final.iterations,
        final.residual <= _ACCEPTED_RESIDUAL,
    )


def quadratic_l1(
    curvature: Float[Array, "K K"],
    slope: Float[Array, " K"],
    slack: Float[Array, " K"],
    origin: Float[Array, " K"],
    tolerance: Float[Array, ""],
) -> Float[Array, " K"]:
    """Minimise ``slope.(w - origin) + (w - origin)' curvature (w - origin) / 2 + sum slack |w|``.

    Coordinate descent finds which weights are zero and the signs of the others; after each pass the weights
    go to the exact solution for that guess, or as far as it holds. ``curvature`` may be singular: a relative
    damping of 1e-8 stays at the origin in its null space. Stops when the optimality conditions hold to
    ``tolerance``.
    """
    n = slope.shape[0]
    damping = 1e-8 * jnp.max(jnp.diag(curvature)) + 1e-200
    curvature = curvature + damping * jnp.eye(n)

    def value(w: Float[Array, " K"]) -> Float[Array, ""]:
        move = w - origin
        return slope @ move + 0.5 * move @ (curvature @ move) + slack @ jnp.abs(w)

    def coordinate(k: Int[Array, ""], w: Float[Array, " K"]) -> Float[Array, " K"]:
        steepness = curvature[k, k]
        free = w[k] - (slope[k] + curvature[k] @ (w - origin)) / steepness
        return w.at[k].set(jnp.sign(free) * jnp.maximum(jnp.abs(free) - slack[k] / steepness, 0.0))

    def sweep(carry: tuple) -> tuple:
        w, _, sweeps = carry
        w = lax.fori_loop(0, n, coordinate, w)
        active = (w != 0) | (slack == 0)
        block = jnp.where(active[:, None] & active, curvature, jnp.eye(n))
        pull = curvature @ jnp.where(active, 0.0, origin) - slope - slack * jnp.sign(w)
        exact = jnp.where(active, origin + jnp.linalg.solve(block, jnp.where(active, pull, 0.0)), 0.0)
        # On the path the signs must hold: the first weight to change its sign stays at zero.
        crossing = (slack > 0) & active & (exact * w <= 0)
        share = jnp.where(crossing, w / jnp.where(crossing, w - exact, 1.0), 1.0)
        reach = jnp.min(share)
        nearer = jnp.where(crossing & (share <= reach), 0.0, w + reach * (exact - w))
        w = jnp.where(value(nearer) <= value(w), nearer, w)
        return w, _kkt_residual(slope + curvature @ (w - origin), slack, w), sweeps + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        _, residual, sweeps = carry
        return (residual > tolerance) & (sweeps < _MAX_SWEEPS)

    return lax.while_loop(unfinished, sweep, (origin, jnp.array(jnp.inf), 0))[0]


# -- the dissertation's solver ------------------------------------------------------------------------


def exponentiated_gradient(
    mdp: TabularMDP,
    target: FeatureTarget,
    epsilon: ArrayLike = 0.01,
    learning_rate: float | None = None,
    start: Float[Array, " K"] | None = None,
    max_steps: int = 10_000,
) -> Solution:
    """Run normalised exponentiated gradient on the simplex, lines 12-18 of Algorithm 1.

    ``theta_k <- theta_k exp(learning_rate z_k) / sum_j theta_j exp(learning_rate z_j)`` with
    ``z = phi_hat - E[phi]``, until ``max_k |z_k| <= epsilon / (1 - gamma)``. Two deviations: line 16 prints
    ``exp(-eta z)``, which with the ``z`` of line 15 descends the likelihood (the dissertation's code has
    ``exp(-2c (E[phi] - phi_hat))``, the sign used here); and ``E[phi]`` of line 14 is exact, not an average
    of sampled trajectories.

    Scaled weights stay positive and sum to one. The solver therefore cannot express a negative weight, nor
    the expert's rationality (the length of the weight vector), and for most experts no point of the simplex
    meets the stopping rule: it then ends after ``max_steps`` with ``converged`` false. It serves replication
    only; :func:`solve_dual` solves the program of the theorems.

    Parameters
    ----------
    mdp, target
        As for :func:`solve_dual`.
    epsilon : float
        Tolerance per step, ``epsilon`` of Theorem 1, in units of each feature's scale.
    learning_rate : float or None
        The ``eta`` of line 16, per unit of discounted scaled features; ``(1 - gamma) / 4`` by default.
    start : float ``[K]`` or None
        Weights of the previous session, all positive; equal scaled weights by default. Normalised before use.
    max_steps : int
        Bound on the number of gradient steps.

    Returns
    -------
    Solution
        ``objective`` is that of the dual without penalties; ``residual`` is ``max |z|`` relative to
        ``1 / (1 - gamma)``, comparable to ``epsilon``.
    """
    require_discounted(mdp)
    features, initial = shaped_target(mdp, target)
    scale = feature_scale(mdp)
    scaled = FeatureTarget(features / scale, initial)
    weights = None if start is None else jnp.asarray(start, float) * scale
    solution = exponentiate_scaled(
        with_scaled_features(mdp), scaled, epsilon, learning_rate, weights, max_steps
    )
    return _unscaled(solution, scale)


def exponentiate_scaled(
    mdp: TabularMDP,
    target: FeatureTarget,
    epsilon: ArrayLike = 0.01,
    learning_rate: float | None = None,
    start: Float[Array, " K"] | None = None,
    max_steps: int = 10_000,
) -> Solution:
    """Run :func:`exponentiated_gradient` on a process with scaled features."""
    weights = jnp.ones(mdp.n_features) if start is None else jnp.asarray(start, float)
    if not isinstance(weights, jax.core.Tracer) and not (np.asarray(weights) > 0).all():
        raise ValueError(
            f"the exponentiated gradient needs positive starting weights, got {np.asarray(weights)}"
        )
    step = (1 - mdp.discount) / 4 if learning_rate is None else jnp.asarray(learning_rate, float)
    return _exponentiated_gradient(mdp, target, epsilon, step, weights, max_steps)


@jax.jit
def _exponentiated_gradient(
    mdp: TabularMDP,
    target: FeatureTarget,
    epsilon: Float[Array, ""],
    learning_rate: Float[Array, ""],
    weights: Float[Array, " K"],
    max_steps: Int[Array, ""],
) -> Solution:
    def visit(weights: Float[Array, " K"], values: Float[Array, " S"]) -> tuple:
        plan = soft_plan(mdp, reward_of(mdp, weights), values)
        expected = feature_expectations(mdp, plan.policy, jnp.asarray(target.start))
        return weights, plan.values, target.features - expected

    def step(carry: tuple) -> tuple:
        (weights, values, gap), steps = carry
        return visit(jax.nn.softmax(jnp.log(weights) + learning_rate * gap), values), steps + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        (_, _, gap), steps = carry
        return (jnp.max(jnp.abs(gap)) * (1 - mdp.discount) > epsilon) & (steps < max_steps)

    first = visit(weights / weights.sum(), jnp.zeros(mdp.n_states))
    (weights, values, gap), steps = lax.while_loop(unfinished, step, (first, jnp.array(0)))
    residual = jnp.max(jnp.abs(gap)) * (1 - mdp.discount)
    objective = target.start @ values - target.features @ weights
    return Solution(weights, values, objective, residual, steps, residual <= epsilon)


# -- at the border ------------------------------------------------------------------------------------


def require_converged(
    mdp: TabularMDP, target: FeatureTarget, slack: ArrayLike, solution: Solution
) -> Solution:
    """Return the solution of :func:`solve_dual` if it converged.

    Raises :class:`InfeasibleProgram`, naming the features that no policy can match, or
    :class:`ProgramNotSolved`.
    """
    if not bool(solution.converged):
        raise failure(
            mdp,
            target,
            slack,
            f"residual {float(solution.residual):.2g} after {int(solution.iterations)} Newton iterations",
        )
    return solution
