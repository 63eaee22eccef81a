"""Planning: what an expert with a given reward would do, and what would come of it.

Soft (maximum causal entropy; Ziebart 2010) and hard planning, over an infinite discounted or a finite
horizon; values, occupancies and feature expectations of a policy. Everything is differentiable in the
reward, the transition probabilities and the discount by the implicit function theorem: no unrolling.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .mdp import TabularMDP

# Up to here a dense [S, S] factorisation beats sweeping (0.1 ms at 124 states, 12 ms at 1024).
DIRECT_LIMIT = 1500
_NEWTON_STEPS = 60
_MAX_SWEEPS = 200_000


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


class HardPlan(NamedTuple):
    """Solution of the Bellman optimality equations, with every optimal action kept."""

    values: Float[Array, " S"]
    action_values: Float[Array, "S A"]
    optimal: Bool[Array, "S A"]


def reward_of(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    """Reward ``theta . phi(s, a)`` of every pair."""
    return mdp.features @ weights


def action_values(
    mdp: TabularMDP, reward: Float[Array, "S A"], values: Float[Array, " S"]
) -> Float[Array, "S A"]:
    """``Q(s, a) = r(s, a) + gamma sum_s' P(s' | s, a) V(s')``; ``-inf`` where the action is unavailable."""
    return jnp.where(mdp.available, reward + mdp.discount * mdp.expect_next(values), -jnp.inf)


# -- infinite horizon ---------------------------------------------------------------------------------


def require_discounted(mdp: TabularMDP) -> None:
    """Raise ``ValueError`` if infinite-horizon planning has no solution because the discount is 1."""
    if not isinstance(mdp.discount, jax.core.Tracer) and float(mdp.discount) >= 1:
        raise ValueError(
            "discount 1 has no infinite-horizon solution: use a discount below 1, or plan over a finite horizon"
        )


def soft_plan(
    mdp: TabularMDP, reward: Float[Array, "S A"], start: Float[Array, " S"] | None = None
) -> SoftPlan:
    """Solve the soft Bellman equations over an infinite discounted horizon.

    ``start [S]`` warm-starts the values. Newton's method (soft policy iteration) with direct solves up to
    ``DIRECT_LIMIT`` states, otherwise sweeps with MacQueen's bounds; to about 1e-12 of the values' scale.
    Raises ``ValueError`` for discount 1.
    """
    require_discounted(mdp)
    if start is None:
        start = jnp.zeros(mdp.n_states, reward.dtype)
    values = _soft_values(mdp, reward, lax.stop_gradient(start))
    q = action_values(mdp, reward, values)
    v = jax.nn.logsumexp(q, axis=1)
    return SoftPlan(v, q, q - v[:, None])


def _soft_backup(mdp: TabularMDP, reward: Float[Array, "S A"], values: Float[Array, " S"]) -> Float[Array, " S"]:
    return jax.nn.logsumexp(action_values(mdp, reward, values), axis=1)


@jax.custom_jvp
def _soft_values(
    mdp: TabularMDP, reward: Float[Array, "S A"], start: Float[Array, " S"]
) -> Float[Array, " S"]:
    if mdp.n_states > DIRECT_LIMIT:
        return _sweep(lambda v: _soft_backup(mdp, reward, v), start, mdp.discount)

    def newton(carry: tuple) -> tuple:
        values, _, step = carry
        q = action_values(mdp, reward, values)
        backup = jax.nn.logsumexp(q, axis=1)
        chain = mdp.state_transitions(jnp.exp(q - backup[:, None]))
        matrix = jnp.eye(mdp.n_states) - mdp.discount * chain
        new = values + jnp.linalg.solve(matrix, backup - values)
        return new, jnp.max(jnp.abs(new - values)), step + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        values, change, step = carry
        return (change > 1e-12 * (1 + jnp.max(jnp.abs(values)))) & (step < _NEWTON_STEPS)

    return lax.while_loop(unfinished, newton, (start, jnp.array(jnp.inf), 0))[0]


@_soft_values.defjvp
def _soft_values_jvp(primals: tuple, tangents: tuple) -> tuple:
    mdp, reward, start = primals
    mdp_dot, reward_dot, _ = tangents
    values = _soft_values(mdp, reward, start)
    policy = jax.nn.softmax(action_values(mdp, reward, values), axis=1)
    _, residual = jax.jvp(lambda m, r: _soft_backup(m, r, values), (mdp, reward), (mdp_dot, reward_dot))
    return values, solve_values(mdp, policy, residual)


def hard_plan(mdp: TabularMDP, reward: Float[Array, "S A"], tolerance: float = 1e-9) -> HardPlan:
    """Solve the Bellman optimality equations; actions within ``tolerance`` of the best count as optimal.

    ``tolerance`` is relative to the spread of the values. Policy iteration up to ``DIRECT_LIMIT`` states,
    otherwise value iteration. Raises ``ValueError`` for discount 1.
    """
    require_discounted(mdp)

    def backup(values: Float[Array, " S"]) -> Float[Array, " S"]:
        return jnp.max(action_values(mdp, reward, values), axis=1)

    start = jnp.zeros(mdp.n_states)
    if mdp.n_states > DIRECT_LIMIT:
        values = _sweep(backup, start, mdp.discount)
    else:
        values = _policy_iteration(mdp, reward, start)
    q = action_values(mdp, reward, values)
    return HardPlan(values, q, greedy_actions(q, tolerance))


def greedy_actions(q: Float[Array, "S A"], tolerance: float = 1e-9) -> Bool[Array, "S A"]:
    """Every action whose value is within ``tolerance`` (relative to the values' spread) of the best."""
    best = jnp.max(q, axis=1, keepdims=True)
    finite = jnp.where(jnp.isfinite(q), q, best)
    return q >= best - tolerance * (1 + jnp.max(finite) - jnp.min(finite))


def deterministic_policy(optimal: Bool[Array, "S A"]) -> Float[Array, "S A"]:
    """The policy that takes the first optimal action of each state with certainty."""
    return jax.nn.one_hot(jnp.argmax(optimal, axis=1), optimal.shape[1])


def _policy_iteration(
    mdp: TabularMDP, reward: Float[Array, "S A"], start: Float[Array, " S"]
) -> Float[Array, " S"]:
    def improve(carry: tuple) -> tuple:
        values, _, step = carry
        q = action_values(mdp, reward, values)
        policy = jax.nn.one_hot(jnp.argmax(q, axis=1), mdp.n_actions)
        matrix = jnp.eye(mdp.n_states) - mdp.discount * mdp.state_transitions(policy)
        # Newton's form (correct the values by the residual) keeps rounding errors from accumulating.
        new = values + jnp.linalg.solve(matrix, jnp.max(q, axis=1) - values)
        return new, jnp.max(jnp.abs(new - values)), step + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        values, change, step = carry
        return (change > 1e-12 * (1 + jnp.max(jnp.abs(values)))) & (step < 1000)

    return lax.while_loop(unfinished, improve, (start, jnp.array(jnp.inf), 0))[0]


def _sweep(backup: object, start: Float[Array, " S"], discount: Float[Array, ""]) -> Float[Array, " S"]:
    """Iterate a monotone backup; MacQueen's bounds place the fixed point within the spread of the change."""

    def sweep(carry: tuple) -> tuple:
        values, _, step = carry
        new = backup(values)  # type: ignore[operator]
        change = new - values
        return new, jnp.stack([jnp.min(change), jnp.max(change)]), step + 1

    def unfinished(carry: tuple) -> Bool[Array, ""]:
        values, (low, high), step = carry
        gap = (high - low) * discount / (1 - discount)
        return (gap > 1e-11 * (1 + jnp.max(jnp.abs(values)))) & (step < _MAX_SWEEPS)

    values, bounds, _ = lax.while_loop(unfinished, sweep, (start, jnp.array([-jnp.inf, jnp.inf]), 0))
    return values + jnp.mean(bounds) * discount / (1 - discount)


def solve_values(
    mdp: TabularMDP, policy: Float[Array, "S A"], rate: Float[Array, " S ..."]
) -> Float[Array, " S ..."]:
    """Solve ``x = rate + gamma P_pi x``: discounted sums of a per-state rate under a policy.

    ``rate`` may carry trailing dimensions ``[S, K]``. Differentiable, forward and in reverse.
    """
    discount = mdp.discount

    def matvec(x: Array) -> Array:
        return x - discount * jnp.einsum("sa,sab,sab...->s...", policy, mdp.probabilities, x[mdp.successors])

    if mdp.n_states > DIRECT_LIMIT:

        def iterate(operator: object, b: Array) -> Array:
            def step(carry: tuple) -> tuple:
                x, _, i = carry
                new = b + x - operator(x)  # type: ignore[operator]
                return new, jnp.max(jnp.abs(new - x)), i + 1

            def unfinished(carry: tuple) -> Bool[Array, ""]:
                x, change, i = carry
                return (change * discount > 1e-12 * (1 - discount) * (1e-30 + jnp.max(jnp.abs(x)))) & (i < _MAX_SWEEPS)

            return lax.while_loop(unfinished, step, (b, jnp.array(jnp.inf), 0))[0]

        return lax.custom_linear_solve(matvec, rate, iterate, iterate)
    matrix = jnp.eye(mdp.n_states) - discount * mdp.state_transitions(lax.stop_gradient(policy))
    factors = jax.scipy.linalg.lu_factor(lax.stop_gradient(matrix))
    return lax.custom_linear_solve(
        matvec,
        rate,
        lambda _, b: jax.scipy.linalg.lu_solve(factors, b),
        lambda _, b: jax.scipy.linalg.lu_solve(factors, b, trans=1),
    )


# -- what a policy is worth, and where it goes --------------------------------------------------------


def policy_values(
    mdp: TabularMDP, policy: Float[Array, "S A"], reward: Float[Array, "S A"]
) -> Float[Array, " S"]:
    """Exact discounted values ``V^pi(s)`` of a policy under a reward."""
    require_discounted(mdp)
    return solve_values(mdp, policy, jnp.sum(policy * jnp.where(mdp.available, reward, 0.0), axis=1))


def features_to_go(mdp: TabularMDP, policy: Float[Array, "S A"]) -> Float[Array, "S K"]:
    """``mu(s)``: expected discounted features collected from each state on."""
    return solve_values(mdp, policy, jnp.einsum("sa,sak->sk", policy, mdp.features))


def occupancy(
    mdp: TabularMDP, policy: Float[Array, "S A"], initial: Float[Array, " S"] | None = None
) -> Float[Array, "S A"]:
    """Discounted occupancy ``x(s, a) = sum_t gamma^t P(s_t = s, a_t = a)``; it sums to ``1 / (1 - gamma)``."""
    initial = mdp.initial if initial is None else initial
    # The transpose of the linear map above; differentiating it gives the transposed solve.
    _, pull = jax.vjp(lambda rate: solve_values(mdp, policy, rate), jnp.zeros(mdp.n_states))
    return pull(initial)[0][:, None] * policy


def feature_expectations(
    mdp: TabularMDP, policy: Float[Array, "S A"], initial: Float[Array, " S"] | None = None
) -> Float[Array, " K"]:
    """Expected discounted features ``E_X[phi_k]`` of a policy."""
    return jnp.einsum("sa,sak->k", occupancy(mdp, policy, initial), mdp.features)


# -- finite horizon -----------------------------------------------------------------------------------


class FinitePlan(NamedTuple):
    """Plan over ``T`` steps: ``values[t, s]`` of the steps from ``t`` on, and the policy of each step."""

    values: Float[Array, "T S"]
    log_policy: Float[Array, "T S A"]


def finite_soft_plan(mdp: TabularMDP, reward: Float[Array, "S A"], horizon: int) -> FinitePlan:
    """Soft plan over ``horizon`` steps by one backward sweep; any discount in (0, 1]."""

    def back(values: Float[Array, " S"], _: None) -> tuple:
        q = action_values(mdp, reward, values)
        v = jax.nn.logsumexp(q, axis=1)
        return v, (v, q - v[:, None])

    _, (values, log_policy) = lax.scan(back, jnp.zeros(mdp.n_states), None, horizon, reverse=True)
    return FinitePlan(values, log_policy)


def finite_hard_plan(mdp: TabularMDP, reward: Float[Array, "S A"], horizon: int) -> FinitePlan:
    """Optimal plan over ``horizon`` steps; ties are shared evenly; any discount in (0, 1]."""

    def back(values: Float[Array, " S"], _: None) -> tuple:
        q = action_values(mdp, reward, values)
        best = greedy_actions(q)
        return jnp.max(q, axis=1), (jnp.max(q, axis=1), jnp.log(best / best.sum(1, keepdims=True)))

    _, (values, log_policy) = lax.scan(back, jnp.zeros(mdp.n_states), None, horizon, reverse=True)
    return FinitePlan(values, log_policy)


def finite_occupancy(
    mdp: TabularMDP, policies: Float[Array, "T S A"], initial: Float[Array, " S"] | None = None
) -> Float[Array, "T S A"]:
    """Undiscounted visit probabilities ``P(s_t = s, a_t = a)`` of a time-dependent policy."""

    def step(state: Float[Array, " S"], policy: Float[Array, "S A"]) -> tuple:
        pairs = state[:, None] * policy
        return mdp.push_forward(pairs), pairs

    _, pairs = lax.scan(step, mdp.initial if initial is None else initial, policies)
    return pairs


# -- reachability -------------------------------------------------------------------------------------


def reachable_states(mdp: TabularMDP, initial: np.ndarray | None = None) -> np.ndarray:
    """Boolean ``[S]``: the states that some sequence of actions reaches from the initial distribution."""
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
    log_policy: Float[Array, "S A"],
    length: int,
    first: Int[Array, ""] | None = None,
) -> tuple[Int[Array, " T"], Int[Array, " T"]]:
    """Draw one trajectory of ``length`` pairs (states, actions) under a policy; starts at ``first`` or ``p0``."""
    start_key, key = jax.random.split(key)
    state = jax.random.categorical(start_key, jnp.log(mdp.initial)) if first is None else jnp.asarray(first)

    def step(state: Int[Array, ""], key: Array) -> tuple:
        act, move = jax.random.split(key)
        action = jax.random.categorical(act, log_policy[state])
        branch = jax.random.categorical(move, jnp.log(mdp.probabilities[state, action]))
        return mdp.successors[state, action, branch], (state, action)

    state = state.astype(mdp.successors.dtype)
    _, (states, actions) = lax.scan(step, state, jax.random.split(key, length))
    return states, actions
