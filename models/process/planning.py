"""Planning: policies of a given reward, and their values, occupancies and feature expectations.

Soft (maximum causal entropy; Ziebart 2010) and hard planning, over an infinite discounted or a finite
horizon. Soft plans and all quantities of a policy are differentiable in the reward, the transition
probabilities and the discount, over an infinite horizon by the implicit function theorem (no unrolling).

A NaN in a reward or a policy raises an error that names its state and action. If JAX traces the table, NaN
makes every result NaN.
Each function checks its arguments and then calls a compiled
one, so that a call outside ``jit`` compiles for a new shape only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..inputs.arguments import as_key, is_traced
from ..inputs.display import shown_briefly
from .mdp import PairNames, TabularMDP

# Up to here a dense [S, S] factorisation beats Krylov iterations (0.1 ms at 124 states, 12 ms at 1024).
DIRECT_LIMIT = 1500
# Policy iteration usually takes a handful of steps, but may take one per state on a corridor whose moves
# cost more than a distant reward is worth at first.
_MAX_STEPS = 20_000
# Work of one accelerated step: this many backups, or Krylov iterations that must gain more than these.
_BACKUPS = 50
_EPS = float(jnp.finfo(jnp.float64).eps)


def _compiled(*static: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function once for each shape, and for each value of its ``static`` arguments."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        # The limit decides which program is traced.
        @partial(jax.jit, static_argnames=("limit", *static))
        def compiled(*arguments: Any, limit: int, **options: Any) -> Any:
            del limit
            return function(*arguments, **options)

        @wraps(function)
        def called(*arguments: Any, **options: Any) -> Any:
            return compiled(*arguments, limit=DIRECT_LIMIT, **options)

        return called

    return decorate


@shown_briefly
class SoftPlan(NamedTuple):
    """Solution of the soft Bellman equations.

    ``values[s] = log sum_a exp(action_values[s, a])``, ``action_values = r + gamma P values``,
    ``log_policy = action_values - values``; unavailable actions have ``-inf`` in both tables.
    """

    values: Float[Array, " S"]
    action_values: Float[Array, "S A"]
    log_policy: Float[Array, "S A"]

    @property
    def policy(self) -> Float[Array, "S A"]:
        """Action probabilities ``pi(a | s)``."""
        return jnp.exp(self.log_policy)


@shown_briefly
class HardPlan(NamedTuple):
    """Solution of the Bellman optimality equations, with all optimal actions."""

    values: Float[Array, " S"]
    action_values: Float[Array, "S A"]
    optimal: Bool[Array, "S A"]


def reward_of(mdp: TabularMDP, weights: Float[Array | np.ndarray, " K"]) -> Float[Array, "S A"]:
    """Return the reward ``theta . phi(s, a)`` of every pair. Raises ``ValueError`` for a weight of NaN.

    See Also
    --------
    i2rl.models.soft_plan : the behaviour that a reward explains
    i2rl.models.hard_plan : the behaviour that is best under it

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import reward_of
    >>> corridor = five_cells()
    >>> print(reward_of(corridor.mdp, corridor.weights)[4].round(1))  # at the end: left, right, stay
    [1.8 1.8 2. ]
    """
    if not is_traced(weights) and np.isnan(np.asarray(weights)).any():
        k = int(np.argwhere(np.isnan(np.asarray(weights)))[0, 0])
        raise ValueError(
            f"weights must be numbers; that of feature {PairNames(mdp.labels).feature(k)} is nan"
        )
    return mdp.features @ weights


def action_values(
    mdp: TabularMDP, reward: Float[Array, "S A"], values: Float[Array, " S"]
) -> Float[Array, "S A"]:
    """Return ``Q(s, a) = r(s, a) + gamma sum_s' P(s' | s, a) V(s')``; ``-inf`` for unavailable actions."""
    return jnp.where(mdp.available, reward + mdp.discount * mdp.expect_next(values), -jnp.inf)


# -- infinite horizon ---------------------------------------------------------------------------------


def require_discounted(mdp: TabularMDP) -> None:
    """Raise ``ValueError`` if infinite-horizon planning has no solution because the discount is 1."""
    if not isinstance(mdp.discount, jax.core.Tracer) and float(mdp.discount) >= 1:
        raise ValueError(
            "discount 1 has no infinite-horizon solution: use a discount below 1, "
            "or plan over a finite horizon"
        )


def _require_numbers(mdp: TabularMDP, what: str, table: Any) -> None:
    """Raise ``ValueError`` naming the first available pair whose entry of a table ``[S, A]`` is NaN."""
    if is_traced(table) or is_traced(mdp.available):
        return
    wrong = np.isnan(np.asarray(table)) & np.asarray(mdp.available)
    if wrong.any():
        *_, s, a = np.argwhere(wrong)[0]
        raise ValueError(f"the {what} of {PairNames(mdp.labels).pair(s, a)} is nan, not a number")


def soft_plan(
    mdp: TabularMDP,
    reward: Float[Array | np.ndarray, "S A"],
    start: Float[Array | np.ndarray, " S"] | None = None,
) -> SoftPlan:
    """Solve the soft Bellman equations over an infinite discounted horizon.

    ``start [S]`` warm-starts the values. Newton's method (soft policy iteration) uses direct solves up to
    ``DIRECT_LIMIT`` states and Krylov solves beyond. Its precision is about 1e-12 of the values' scale, or
    rounding if the discount is above 0.99. Raises ``ValueError`` for discount 1 and a reward of NaN; in a
    traced reward, NaN makes the whole plan NaN.

    See Also
    --------
    i2rl.models.hard_plan : the plan of a deterministic expert
    i2rl.models.finite_soft_plan : the plan over a finite horizon
    i2rl.models.reward_of : the reward of weights

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import reward_of, soft_plan
    >>> corridor = five_cells()
    >>> plan = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights))
    >>> print(plan.policy[0].round(1))  # in cell 0: left, right, stay
    [0.2 0.7 0.2]
    """
    require_discounted(mdp)
    _require_numbers(mdp, "reward", reward)
    return _soft_plan(mdp, reward, start)


@_compiled()
def _soft_plan(mdp: TabularMDP, reward: Float[Array, "S A"], start: Float[Array, " S"] | None) -> SoftPlan:
    start = jnp.zeros(mdp.n_states) if start is None else jnp.asarray(start, float)
    values = _soft_values(mdp, reward, lax.stop_gradient(start))
    q = action_values(mdp, reward, values)
    v = jax.nn.logsumexp(q, axis=1)
    return SoftPlan(v, q, q - v[:, None])


def soft_backup(
    mdp: TabularMDP, reward: Float[Array, "S A"], values: Float[Array, " S"]
) -> Float[Array, " S"]:
    """Apply the soft Bellman equations once, ``log sum_a exp(r + gamma P values)``."""
    return jax.nn.logsumexp(action_values(mdp, reward, values), axis=1)


@jax.custom_jvp
def _soft_values(
    mdp: TabularMDP, reward: Float[Array, "S A"], start: Float[Array, " S"]
) -> Float[Array, " S"]:
    if mdp.n_states > DIRECT_LIMIT:
        return _fixed_point(lambda v: soft_backup(mdp, reward, v), start, mdp.discount, floor=1.0)
    return _policy_iteration(mdp, reward, start, lambda q: jax.nn.softmax(q, axis=1), jax.nn.logsumexp)


@_soft_values.defjvp
def _soft_values_jvp(primals: tuple, tangents: tuple) -> tuple:
    mdp, reward, start = primals
    mdp_dot, reward_dot, _ = tangents
    values = _soft_values(mdp, reward, start)
    policy = jax.nn.softmax(action_values(mdp, reward, values), axis=1)
    _, residual = jax.jvp(lambda m, r: soft_backup(m, r, values), (mdp, reward), (mdp_dot, reward_dot))
    return values, solve_values(mdp, policy, residual)


def hard_plan(mdp: TabularMDP, reward: Float[Array | np.ndarray, "S A"], tolerance: float = 1e-9) -> HardPlan:
    """Solve the Bellman optimality equations; actions within ``tolerance`` of the best count as optimal.

    ``tolerance`` is relative to the spread of the values. Policy iteration, with direct solves up to
    ``DIRECT_LIMIT`` states and Krylov solves beyond. Raises ``ValueError`` for discount 1 and a reward of
    NaN; in a traced reward, NaN makes all values NaN and no action optimal.

    See Also
    --------
    i2rl.models.soft_plan : the plan of a stochastic expert
    i2rl.models.deterministic_policy : a policy that takes one optimal action

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import hard_plan, reward_of
    >>> corridor = five_cells()
    >>> plan = hard_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights))
    >>> print(plan.values.round(1), plan.optimal[0])  # in cell 0 only "right" is optimal
    [11.8 13.5 15.4 17.6 20. ] [False  True False]
    """
    require_discounted(mdp)
    _require_numbers(mdp, "reward", reward)
    return _hard_plan(mdp, reward, tolerance)


@_compiled()
def _hard_plan(mdp: TabularMDP, reward: Float[Array, "S A"], tolerance: Float[Array, ""]) -> HardPlan:
    def backup(values: Float[Array, " S"]) -> Float[Array, " S"]:
        return jnp.max(action_values(mdp, reward, values), axis=1)

    def greedy(q: Float[Array, "S A"]) -> Float[Array, "S A"]:
        return jax.nn.one_hot(jnp.argmax(q, axis=1), mdp.n_actions)

    start = jnp.zeros(mdp.n_states)
    if mdp.n_states > DIRECT_LIMIT:
        values = _fixed_point(backup, start, mdp.discount, floor=1.0)
    else:
        values = _policy_iteration(mdp, reward, start, greedy, jnp.max)
    q = action_values(mdp, reward, values)
    return HardPlan(values, q, greedy_actions(q, tolerance))


def greedy_actions(q: Float[Array, "S A"], tolerance: float | Array = 1e-9) -> Bool[Array, "S A"]:
    """Mark every action whose value is within ``tolerance`` (relative to the values' spread) of the best."""
    best = jnp.max(q, axis=1, keepdims=True)
    finite = jnp.where(jnp.isfinite(q), q, best)
    return q >= best - tolerance * (1 + jnp.max(finite) - jnp.min(finite))


def deterministic_policy(optimal: Bool[Array | np.ndarray, "S A"]) -> Float[Array, "S A"]:
    """Return the policy of the first optimal action of each state; NaN if a state has none.

    See Also
    --------
    i2rl.models.hard_plan : finds the optimal actions

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import deterministic_policy, hard_plan, reward_of
    >>> corridor = five_cells()
    >>> plan = hard_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights))
    >>> deterministic_policy(plan.optimal).argmax(axis=1).tolist()  # to the right, and at the end stay
    [1, 1, 1, 1, 2]
    """
    first = jax.nn.one_hot(jnp.argmax(optimal, axis=1), optimal.shape[1])
    return jnp.where(jnp.any(optimal, axis=1, keepdims=True), first, jnp.nan)


def _precision(discount: Float[Array, ""]) -> Float[Array, ""]:
    """Return the residual, relative to the solution, for a precision of 1e-12 or of rounding."""
    return jnp.maximum(1e-12 * (1 - discount), 16 * _EPS)


def _policy_iteration(
    mdp: TabularMDP,
    reward: Float[Array, "S A"],
    start: Float[Array, " S"],
    policy_of: Callable[[Float[Array, "S A"]], Float[Array, "S A"]],
    best_of: Callable[..., Float[Array, " S"]],
) -> Float[Array, " S"]:
    def residual(values: Float[Array, " S"]) -> tuple:
        q = action_values(mdp, reward, values)
        return q, best_of(q, axis=1) - values

    def improve(carry: tuple) -> tuple:
        values, q, gap, _, step = carry
        matrix = jnp.eye(mdp.n_states) - mdp.discount * mdp.state_transitions(policy_of(q))
        # Newton's form (correct the values by the residual) keeps rounding errors from accumulating.
        values = values + _solve(matrix, gap)
        return values, *residual(values), _largest(gap), step + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        values, _, gap, before, step = carry
        left, scale = _largest(gap), 1 + _largest(values)
        # Sums over many successors have larger rounding errors: a residual that stops shrinking is rounding.
        rounding = (left < 1e-13 * scale) & (left > before / 2)
        return (left > _precision(mdp.discount) * scale) & ~rounding & (step < _MAX_STEPS)

    values, _, gap, *_ = lax.while_loop(unfinished, improve, (start, *residual(start), jnp.array(jnp.inf), 0))
    return _if_numbers(gap, values)


def _largest(x: Float[Array, " S"]) -> Float[Array, ""]:
    return jnp.max(jnp.abs(x))


def _if_numbers(gap: Float[Array, " S"], solution: Float[Array, " S"]) -> Float[Array, " S"]:
    # Comparisons with NaN are false, so an iteration ends at once at its start.
    return jnp.where(jnp.isnan(_largest(gap)), jnp.nan, solution)


def _fixed_point(
    backup: Callable[[Float[Array, " S"]], Float[Array, " S"]],
    start: Float[Array, " S"],
    discount: Float[Array, ""],
    size: Callable[[Float[Array, " S"]], Float[Array, ""]] = _largest,
    forcing: float = 1e-2,
    floor: float = 0.0,
) -> Float[Array, " S"]:
    """Find the fixed point of a backup that contracts by ``discount`` in the norm ``size``.

    Inexact Newton: each step solves the linearised equation by BiCGSTAB to the relative residual
    ``forcing``. A step that gains less than ``_BACKUPS`` plain backups would is replaced by them. Convergence
    then needs at most a few times the work of successive approximation, whatever the chain.
    Precision is relative to ``floor`` plus the size of the solution.
    """
    surely = discount**_BACKUPS

    def newton(x: Float[Array, " S"], gap: Float[Array, " S"]) -> Float[Array, " S"]:
        _, slope = jax.linearize(backup, x)
        correction, _ = jax.scipy.sparse.linalg.bicgstab(
            lambda d: d - slope(d), gap, tol=forcing, maxiter=_BACKUPS
        )
        return x + correction

    def step(carry: tuple) -> tuple:
        x, gap, _, count = carry
        left = size(gap)
        ahead = newton(x, gap)
        ahead_gap = backup(ahead) - ahead
        gains = size(ahead_gap) <= surely * left

        def swept() -> tuple:
            y = lax.fori_loop(0, _BACKUPS, lambda _, y: backup(y), x)
            return y, backup(y) - y

        x, gap = lax.cond(gains, lambda: (ahead, ahead_gap), swept)
        # Except for rounding, a step shrinks the residual: a residual that stops shrinking is rounding.
        return x, gap, size(gap) < (1 + surely) / 2 * left, count + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        x, gap, shrinking, count = carry
        return (size(gap) > _precision(discount) * (floor + size(x))) & shrinking & (count < _MAX_STEPS)

    x, gap, *_ = lax.while_loop(unfinished, step, (start, backup(start) - start, jnp.array(True), 0))
    return _if_numbers(gap, x)


def solve_values(
    mdp: TabularMDP, policy: Float[Array, "S A"], reward: Float[Array, " S ..."]
) -> Float[Array, " S ..."]:
    """Solve ``x = reward + gamma P_pi x``: discounted sums of a state's reward under a policy.

    ``reward`` may carry trailing dimensions ``[S, K]``. Differentiable, forward and in reverse.
    Raises ``ValueError`` for discount 1.
    """
    require_discounted(mdp)
    return _solve_values(mdp, policy, reward)


@_compiled()
def _solve_values(
    mdp: TabularMDP, policy: Float[Array, "S A"], reward: Float[Array, " S ..."]
) -> Float[Array, " S ..."]:
    fixed, fixed_policy = lax.stop_gradient((mdp, policy))

    def expected(mdp: TabularMDP, policy: Float[Array, "S A"], x: Float[Array, " S"]) -> Float[Array, " S"]:
        return mdp.discount * jnp.sum(policy * mdp.expect_next(x), axis=1)

    def spread(x: Float[Array, " S"]) -> Float[Array, " S"]:
        return fixed.discount * fixed.push_forward(x[:, None] * fixed_policy)

    def matvec(x: Array) -> Array:
        return x - _by_column(lambda c: expected(mdp, policy, c), x)

    if mdp.n_states > DIRECT_LIMIT:

        def iterate(_: object, b: Array) -> Array:
            return _by_column(
                lambda c: _fixed_point(
                    lambda x: c + expected(fixed, fixed_policy, x), c, fixed.discount, forcing=1e-8
                ),
                b,
            )

        def iterate_back(_: object, b: Array) -> Array:
            # The transposed chain contracts in the sum of absolute values, not in the largest.
            return _by_column(
                lambda c: _fixed_point(
                    lambda x: c + spread(x), c, fixed.discount, lambda x: jnp.sum(jnp.abs(x)), forcing=1e-8
                ),
                b,
            )

        return lax.custom_linear_solve(matvec, reward, iterate, iterate_back)
    factors = _factor(jnp.eye(mdp.n_states) - fixed.discount * fixed.state_transitions(fixed_policy))
    return lax.custom_linear_solve(
        matvec, reward, lambda _, b: _solve_factored(factors, b), lambda _, b: _solve_transposed(factors, b)
    )


def _one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Run a linear solve that is mapped with ``vmap`` in sequence on a CPU, together elsewhere.

    On two cores, batched LAPACK calls inside compiled loops can deadlock (seen with jaxlib 0.10, whatever the
    number of OpenBLAS's threads); sequential calls never did, at the same speed.
    """
    alone = jax.custom_batching.custom_vmap(function)

    @alone.def_vmap
    def mapped(size: int, batched: Sequence[Any], *arguments: Any) -> tuple:
        def broadcast(x: Array, has_axis: bool) -> Array:
            return x if has_axis else jnp.broadcast_to(x, (size, *x.shape))

        arguments = tuple(
            jax.tree.map(broadcast, x, axes) for x, axes in zip(arguments, batched, strict=True)
        )
        result = lax.platform_dependent(
            *arguments,
            cpu=lambda *xs: lax.map(lambda x: alone(*x), xs),
            default=jax.vmap(function),
        )
        return result, jax.tree.map(lambda _: True, result)

    return alone


@_one_by_one
def _solve(matrix: Float[Array, "S S"], b: Float[Array, " S"]) -> Float[Array, " S"]:
    return jnp.linalg.solve(matrix, b)


@_one_by_one
def _factor(matrix: Float[Array, "S S"]) -> tuple[Array, Array]:
    return jax.scipy.linalg.lu_factor(matrix)


@_one_by_one
def _solve_factored(factors: tuple[Array, Array], b: Float[Array, " S ..."]) -> Float[Array, " S ..."]:
    return jax.scipy.linalg.lu_solve(factors, b)


@_one_by_one
def _solve_transposed(factors: tuple[Array, Array], b: Float[Array, " S ..."]) -> Float[Array, " S ..."]:
    return jax.scipy.linalg.lu_solve(factors, b, trans=1)


def _by_column(function: Callable[[Float[Array, " S"]], Float[Array, " S"]], x: Array) -> Array:
    """Apply a function of ``[S]`` along the first dimension of ``[S, ...]``."""
    columns = x.reshape(x.shape[0], -1)
    return jax.vmap(function, in_axes=1, out_axes=1)(columns).reshape(x.shape) if x.ndim > 1 else function(x)


# -- values and occupancies of a policy -----------------------------------------------------------------


def policy_values(
    mdp: TabularMDP, policy: Float[Array | np.ndarray, "S A"], reward: Float[Array | np.ndarray, "S A"]
) -> Float[Array, " S"]:
    """Return the exact discounted values ``V^pi(s)`` of a policy under a reward.

    See Also
    --------
    i2rl.models.hard_plan : the greatest values
    i2rl.models.occupancy : the visits of a policy

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import policy_values, reward_of
    >>> corridor = five_cells()
    >>> uniform = np.full((5, 3), 1 / 3)
    >>> print(policy_values(corridor.mdp, uniform, reward_of(corridor.mdp, corridor.weights)).round(1))
    [-0.1  0.4  1.5  3.7  7.7]
    """
    require_discounted(mdp)
    _require_numbers(mdp, "reward", reward)
    _require_numbers(mdp, "policy", policy)
    return _policy_values(mdp, policy, reward)


@_compiled()
def _policy_values(
    mdp: TabularMDP, policy: Float[Array, "S A"], reward: Float[Array, "S A"]
) -> Float[Array, " S"]:
    return _solve_values(mdp, policy, jnp.sum(policy * jnp.where(mdp.available, reward, 0.0), axis=1))


def features_to_go(mdp: TabularMDP, policy: Float[Array, "S A"]) -> Float[Array, "S K"]:
    """Return ``mu(s)``, the expected discounted features from each state on."""
    require_discounted(mdp)
    _require_numbers(mdp, "policy", policy)
    return _features_to_go(mdp, policy)


@_compiled()
def _features_to_go(mdp: TabularMDP, policy: Float[Array, "S A"]) -> Float[Array, "S K"]:
    return _solve_values(mdp, policy, jnp.einsum("sa,sak->sk", policy, mdp.features))


def occupancy(
    mdp: TabularMDP,
    policy: Float[Array | np.ndarray, "S A"],
    initial: Float[Array | np.ndarray, " S"] | None = None,
) -> Float[Array, "S A"]:
    """Return the occupancy ``x(s, a) = sum_t gamma^t P(s_t = s, a_t = a)``, of sum ``1 / (1 - gamma)``.

    See Also
    --------
    i2rl.models.feature_expectations : the features that these visits collect
    i2rl.models.simulate : draws a trajectory

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import occupancy, reward_of, soft_plan
    >>> corridor = five_cells()
    >>> policy = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights)).policy
    >>> visits = occupancy(corridor.mdp, policy).sum(axis=1)
    >>> print(visits.round(1), visits.sum().round(1))  # 1 / (1 - discount) visits in all
    [1.6 1.1 0.9 1.  5.4] 10.0
    """
    require_discounted(mdp)
    _require_numbers(mdp, "policy", policy)
    return _occupancy(mdp, policy, initial)


@_compiled()
def _occupancy(
    mdp: TabularMDP, policy: Float[Array, "S A"], initial: Float[Array, " S"] | None
) -> Float[Array, "S A"]:
    initial = mdp.initial if initial is None else jnp.asarray(initial, float)
    # The transpose of the linear map above; its derivative is the transposed solve.
    _, pull = jax.vjp(lambda reward: _solve_values(mdp, policy, reward), jnp.zeros(mdp.n_states))
    return pull(initial)[0][:, None] * policy


def feature_expectations(
    mdp: TabularMDP,
    policy: Float[Array | np.ndarray, "S A"],
    initial: Float[Array | np.ndarray, " S"] | None = None,
) -> Float[Array, " K"]:
    """Return the expected discounted features ``E_X[phi_k]`` of a policy.

    See Also
    --------
    i2rl.models.occupancy : discounted visits of every pair
    i2rl.inference.solve_dual : finds weights that match expected features

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import feature_expectations, reward_of, soft_plan
    >>> corridor = five_cells()
    >>> policy = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights)).policy
    >>> print(feature_expectations(corridor.mdp, policy).round(1))  # discounted steps at the end, and moves
    [5.4 6.5]
    """
    require_discounted(mdp)
    _require_numbers(mdp, "policy", policy)
    return _feature_expectations(mdp, policy, initial)


@_compiled()
def _feature_expectations(
    mdp: TabularMDP, policy: Float[Array, "S A"], initial: Float[Array, " S"] | None
) -> Float[Array, " K"]:
    return jnp.einsum("sa,sak->k", _occupancy(mdp, policy, initial), mdp.features)


def feature_deviations(mdp: TabularMDP, policy: Float[Array, "S A"]) -> Float[Array, " K"]:
    """Return standard deviations over trajectories of discounted features ``sum_t gamma^t phi_k(s_t, a_t)``.

    The result is exact: the second moment of a discounted sum obeys a Bellman equation with discount
    ``gamma^2`` and reward ``phi^2 + 2 gamma phi E[mu(s')]`` (Sobel 1982). Raises ``ValueError`` for
    discount 1.
    """
    require_discounted(mdp)
    _require_numbers(mdp, "policy", policy)
    return _feature_deviations(mdp, policy)


@_compiled()
def _feature_deviations(mdp: TabularMDP, policy: Float[Array, "S A"]) -> Float[Array, " K"]:
    to_go = _features_to_go(mdp, policy)
    onward = jax.vmap(mdp.expect_next, in_axes=1, out_axes=2)(to_go)
    reward = jnp.einsum("sa,sak->sk", policy, mdp.features * (mdp.features + 2 * mdp.discount * onward))
    squared = replace(mdp, discount=mdp.discount**2)
    second = mdp.initial @ _solve_values(squared, policy, reward)
    return jnp.sqrt(jnp.maximum(second - (mdp.initial @ to_go) ** 2, 0.0))


# -- finite horizon -----------------------------------------------------------------------------------


@shown_briefly
class FinitePlan(NamedTuple):
    """Plan over ``T`` steps: ``values[t, s]`` of the steps from ``t`` on, and the policy of each step."""

    values: Float[Array, "T S"]
    log_policy: Float[Array, "T S A"]


def finite_soft_plan(mdp: TabularMDP, reward: Float[Array | np.ndarray, "S A"], horizon: int) -> FinitePlan:
    """Plan softly over ``horizon`` steps in one backward pass; any discount in (0, 1].

    See Also
    --------
    i2rl.models.soft_plan : the plan over an infinite horizon
    i2rl.inference.fit_weights : learns weights over a finite horizon

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import finite_soft_plan, reward_of
    >>> corridor = five_cells()
    >>> plan = finite_soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights), horizon=3)
    >>> print(np.exp(plan.log_policy[:, 3]).round(1))  # cell 3: in the last step a move does not pay any more
    [[0.  0.8 0.1]
     [0.1 0.7 0.2]
     [0.3 0.3 0.4]]
    """
    _require_numbers(mdp, "reward", reward)
    return _finite_soft_plan(mdp, reward, horizon=horizon)


@_compiled("horizon")
def _finite_soft_plan(mdp: TabularMDP, reward: Float[Array, "S A"], *, horizon: int) -> FinitePlan:
    def back(values: Float[Array, " S"], _: None) -> tuple:
        q = action_values(mdp, reward, values)
        v = jax.nn.logsumexp(q, axis=1)
        return v, (v, q - v[:, None])

    plan: tuple = lax.scan(back, jnp.zeros(mdp.n_states), None, horizon, reverse=True)[1]
    return FinitePlan(*plan)


def finite_hard_plan(mdp: TabularMDP, reward: Float[Array, "S A"], horizon: int) -> FinitePlan:
    """Plan optimally over ``horizon`` steps; ties are shared evenly; any discount in (0, 1]."""
    _require_numbers(mdp, "reward", reward)
    return _finite_hard_plan(mdp, reward, horizon=horizon)


@_compiled("horizon")
def _finite_hard_plan(mdp: TabularMDP, reward: Float[Array, "S A"], *, horizon: int) -> FinitePlan:
    def back(values: Float[Array, " S"], _: None) -> tuple:
        q = action_values(mdp, reward, values)
        best = greedy_actions(q)
        return jnp.max(q, axis=1), (jnp.max(q, axis=1), jnp.log(best / best.sum(1, keepdims=True)))

    plan: tuple = lax.scan(back, jnp.zeros(mdp.n_states), None, horizon, reverse=True)[1]
    return FinitePlan(*plan)


def finite_occupancy(
    mdp: TabularMDP, policies: Float[Array, "T S A"], initial: Float[Array, " S"] | None = None
) -> Float[Array, "T S A"]:
    """Return undiscounted visit probabilities ``P(s_t = s, a_t = a)`` of a time-dependent policy."""
    _require_numbers(mdp, "policy", policies)
    return _finite_occupancy(mdp, policies, initial)


@_compiled()
def _finite_occupancy(
    mdp: TabularMDP, policies: Float[Array, "T S A"], initial: Float[Array, " S"] | None
) -> Float[Array, "T S A"]:
    def step(state: Float[Array, " S"], policy: Float[Array, "S A"]) -> tuple:
        pairs = state[:, None] * policy
        return mdp.push_forward(pairs), pairs

    return lax.scan(step, mdp.initial if initial is None else jnp.asarray(initial, float), policies)[1]


# -- reachability -------------------------------------------------------------------------------------


def reachable_states(mdp: TabularMDP, initial: np.ndarray | None = None) -> np.ndarray:
    """Mark the states ``[S]`` that some sequence of actions reaches from the initial distribution."""
    successors = np.asarray(mdp.successors)
    possible = np.asarray(mdp.probabilities) > 0
    seen = np.asarray(mdp.initial if initial is None else initial) > 0
    frontier = np.flatnonzero(seen)
    while len(frontier):
        following = np.unique(successors[frontier][possible[frontier]])
        frontier = following[~seen[following]]
        seen[frontier] = True
    return seen


def simulate(
    key: Array,
    mdp: TabularMDP,
    log_policy: Float[Array | np.ndarray, "S A"],
    length: int,
    first: Int[Array | np.ndarray, ""] | None = None,
) -> tuple[Int[Array, " T"], Int[Array, " T"]]:
    """Draw one trajectory of ``length`` pairs (states, actions) under a policy, from ``first`` or ``p0``.

    See Also
    --------
    i2rl.models.sample_demonstration : simulates trajectories and observes them
    i2rl.models.observe : passes a trajectory through a sensor

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import reward_of, simulate, soft_plan
    >>> corridor = five_cells()
    >>> plan = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights))
    >>> states, actions = simulate(jax.random.key(0), corridor.mdp, plan.log_policy, 6)
    >>> int(states[0]), actions.shape
    (0, (6,))
    """
    _require_numbers(mdp, "log-policy", log_policy)
    return _simulate(as_key(key), mdp, log_policy, first, length=length)


@_compiled("length")
def _simulate(
    key: Array, mdp: TabularMDP, log_policy: Float[Array, "S A"], first: Int[Array, ""] | None, *, length: int
) -> tuple[Int[Array, " T"], Int[Array, " T"]]:
    start_key, key = jax.random.split(key)
    state = jax.random.categorical(start_key, jnp.log(mdp.initial)) if first is None else jnp.asarray(first)

    def step(state: Int[Array, ""], key: Array) -> tuple:
        act, move = jax.random.split(key)
        action = jax.random.categorical(act, log_policy[state])
        branch = jax.random.categorical(move, jnp.log(mdp.probabilities[state, action]))
        return mdp.successors[state, action, branch], (state, action)

    state = state.astype(mdp.successors.dtype)
    return lax.scan(step, state, jax.random.split(key, length))[1]
