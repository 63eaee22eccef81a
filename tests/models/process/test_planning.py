"""Planning against enumeration, finite differences, simulation and a second solver."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.models import (
    TabularMDP,
    deterministic_policy,
    feature_expectations,
    finite_soft_plan,
    hard_plan,
    occupancy,
    policy_values,
    reward_of,
    simulate,
    soft_plan,
)
from i2rl.models.process import planning
from i2rl.models.process.planning import (
    feature_deviations,
    features_to_go,
    finite_hard_plan,
    finite_occupancy,
    reachable_states,
    soft_backup,
)

S, A, K = 4, 3, 2
WEIGHTS = jnp.array([1.5, -0.8])

soft = jax.jit(soft_plan)


@pytest.fixture
def sweeping(monkeypatch):
    """Solve as for large state spaces."""
    monkeypatch.setattr(planning, "DIRECT_LIMIT", 1)
    jax.clear_caches()
    yield
    monkeypatch.undo()
    jax.clear_caches()


@pytest.fixture(params=["direct", "sweeping"])
def solver(request):
    if request.param == "sweeping":
        request.getfixturevalue("sweeping")
    return request.param


def behaviour(mdp, weights):
    """Compute the behaviour of a soft plan, as one vector."""
    plan = soft_plan(mdp, reward_of(mdp, weights))
    visits, to_go = occupancy(mdp, plan.policy), features_to_go(mdp, plan.policy)
    return jnp.concatenate([plan.values, plan.policy.ravel(), visits.ravel(), to_go.ravel()])


def worth(mdp, weights):
    """Soft values and feature expectations of a soft plan, as one vector."""
    plan = soft_plan(mdp, reward_of(mdp, weights))
    return jnp.concatenate([plan.values, feature_expectations(mdp, plan.policy)])


def varied(function, mdp, x):
    """Evaluate a function at a point ``x``: weights, discount, and one direction of the probabilities."""
    tilt = jnp.asarray(np.random.default_rng(9).normal(size=mdp.probabilities.shape))
    probabilities = mdp.probabilities * jnp.exp(x[3] * tilt)
    probabilities = probabilities / jnp.where(
        mdp.available[..., None], probabilities.sum(-1, keepdims=True), 1
    )
    mdp = replace(mdp.with_probabilities(probabilities), discount=mdp.discount + x[2])
    return function(mdp, WEIGHTS + x[:2])


def differences(function, x, step):
    """Differentiate a function of a vector by central differences of fourth order."""
    columns = []
    for direction in np.eye(len(x)):
        f = [function(x + k * step * direction) for k in (-2, -1, 1, 2)]
        columns.append((f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step))
    return np.stack(columns, axis=-1)


def test_derivatives_of_behaviour_match_finite_differences(solver, random_mdp):
    mdp = random_mdp(0, masked=True)
    x = jnp.zeros(4)
    expected = differences(jax.jit(lambda x: varied(behaviour, mdp, x)), x, 1e-3)
    scale = np.abs(expected).max()
    for derivative in (jax.jacfwd, jax.jacrev):
        actual = jax.jit(derivative(lambda x: varied(behaviour, mdp, x)))(x)
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-7 * scale)


def test_second_derivatives_match_finite_differences_of_the_first(solver, random_mdp):
    mdp = random_mdp(1, masked=True)
    mix = jnp.asarray(np.random.default_rng(1).normal(size=S + K))
    value = jax.jit(lambda x: mix @ varied(worth, mdp, x))
    gradient = jax.jit(jax.grad(value))
    x = jnp.zeros(4)
    np.testing.assert_allclose(gradient(x), differences(value, x, 1e-3), rtol=1e-6)
    expected = differences(gradient, x, 1e-3)
    actual = jax.jit(jax.jacfwd(gradient))(x)
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(actual, actual.T, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_the_reward_gradient_of_the_soft_value_is_the_occupancy(random_mdp):
    mdp = random_mdp(2, masked=True)
    reward = reward_of(mdp, WEIGHTS)
    gradient = jax.jit(jax.grad(lambda r: mdp.initial @ soft_plan(mdp, r).values))(reward)
    visits = jax.jit(occupancy)(mdp, soft(mdp, reward).policy)
    np.testing.assert_allclose(gradient, visits, atol=1e-10)


def test_many_successors_round_further_and_still_end(solver):
    rng = np.random.default_rng(0)
    moves, features = rng.dirichlet(np.ones(400), (400, 2)), rng.random((400, 2, 2))
    mdp = TabularMDP.from_dense(moves, features, discount=0.9999)
    reward = reward_of(mdp, WEIGHTS)
    plan = jax.jit(soft_plan)(mdp, reward)
    np.testing.assert_allclose(soft_backup(mdp, reward, plan.values), plan.values, rtol=1e-12)
    occupied = jax.jit(occupancy)(mdp, plan.policy)
    np.testing.assert_allclose(occupied.sum(), 1e4, rtol=1e-8)


def test_values_near_zero_are_found(solver):
    # Each of two actions costs log 2, just what choosing freely between them is worth.
    mdp = TabularMDP.from_dense(np.ones((1, 2, 1)), np.full((1, 2, 1), -np.log(2)), discount=0.99)
    values = soft_plan(mdp, reward_of(mdp, jnp.ones(1)), start=jnp.array([3.0])).values
    np.testing.assert_allclose(values, 0, atol=1e-11)


def test_both_solvers_agree(random_mdp, monkeypatch):
    mdps = [
        random_mdp(3, n_states=40, n_successors=3, masked=True, discount=discount)
        for discount in (0.3, 0.95, 0.999)
    ]

    def everything(mdp):
        reward = reward_of(mdp, 3 * WEIGHTS)
        hard = hard_plan(mdp, reward)
        policy = deterministic_policy(hard.optimal)
        values = policy_values(mdp, policy, reward)
        return behaviour(mdp, 3 * WEIGHTS), hard.values, hard.optimal, values, occupancy(mdp, policy)

    compiled = jax.jit(everything)
    direct = [compiled(mdp) for mdp in mdps]
    monkeypatch.setattr(planning, "DIRECT_LIMIT", 1)
    jax.clear_caches()
    compiled = jax.jit(everything)
    swept = [compiled(mdp) for mdp in mdps]
    monkeypatch.undo()
    jax.clear_caches()
    for one, two in zip(jax.tree.leaves(direct), jax.tree.leaves(swept), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-8, atol=1e-8)


def test_soft_plans_solve_the_soft_bellman_equations(solver, random_mdp):
    mdp = random_mdp(4, masked=True, discount=0.99)
    reward = reward_of(mdp, 20 * WEIGHTS)
    plan = soft_plan(mdp, reward)
    np.testing.assert_allclose(soft_backup(mdp, reward, plan.values), plan.values, rtol=1e-12)
    np.testing.assert_allclose(plan.policy.sum(1), 1)
    assert (np.asarray(plan.policy)[~np.asarray(mdp.available)] == 0).all()
    assert (np.asarray(plan.log_policy)[~np.asarray(mdp.available)] == -np.inf).all()
    warm = soft_plan(mdp, reward, start=plan.values + 1)
    np.testing.assert_allclose(warm.values, plan.values, rtol=1e-11)


def corridor(n, discount):
    """Resting is free, a step costs something, and only the far end pays."""
    moves = np.zeros((n, 2, n))
    moves[np.arange(n), 0, np.arange(n)] = 1
    moves[np.arange(n), 1, np.minimum(np.arange(n) + 1, n - 1)] = 1
    features = np.zeros((n, 2, 1))
    features[:-1, 1], features[-1] = -1, 5
    return TabularMDP.from_dense(moves, features, discount=discount)


def test_rewards_far_away_are_found_even_if_the_policy_improves_one_state_a_step(solver):
    mdp = corridor(150, 0.999)
    weights = jnp.array([100.0])
    # Nearly deterministic: the soft values differ from the optimal ones by at most log 2 a step.
    best = 100 * (-(1 - 0.999 ** np.arange(149, -1, -1)) + 0.999 ** np.arange(149, -1, -1) * 5) / 0.001
    hard = hard_plan(mdp, reward_of(mdp, weights))
    np.testing.assert_allclose(hard.values, best, rtol=1e-9)
    values = np.asarray(soft_plan(mdp, reward_of(mdp, weights)).values)
    assert (values >= best * (1 - 1e-12)).all()
    assert (values <= best + np.log(2) / 0.001).all()
    np.testing.assert_array_equal(hard.optimal[:-1, 1], True)
    np.testing.assert_array_equal(hard.optimal[-1], True)


def test_hard_plans_are_the_best_deterministic_policies(solver, random_mdp, dense_transitions):
    best_plan, evaluate = jax.jit(hard_plan), jax.jit(policy_values)
    for seed in range(4):
        mdp = random_mdp(seed, masked=True)
        reward, moves = np.asarray(reward_of(mdp, WEIGHTS)), dense_transitions(mdp)
        available = np.asarray(mdp.available)
        rows = np.arange(S)
        best = np.full(S, -np.inf)
        for actions in product(*(np.flatnonzero(available[s]) for s in range(S))):
            chain = moves[rows, actions]
            value = np.linalg.solve(np.eye(S) - 0.9 * chain, reward[rows, actions])
            best = np.maximum(best, value)
        plan = best_plan(mdp, reward_of(mdp, WEIGHTS))
        np.testing.assert_allclose(plan.values, best, rtol=1e-10)
        q = np.where(available, reward + 0.9 * moves @ best, -np.inf)
        np.testing.assert_allclose(plan.action_values, q, rtol=1e-10)
        np.testing.assert_array_equal(plan.optimal, q >= q.max(1, keepdims=True) - 1e-8)
        policy = deterministic_policy(plan.optimal)
        np.testing.assert_allclose(evaluate(mdp, policy, reward_of(mdp, WEIGHTS)), best, rtol=1e-10)


def test_every_optimal_action_is_kept(solver):
    moves = np.zeros((2, 3, 2))
    moves[:, :, 1] = 1
    features = np.array([[[1.0], [1.0], [0.5]], [[0.0], [0.0], [0.0]]])
    mdp = TabularMDP.from_dense(moves, features, discount=0.5)
    plan = hard_plan(mdp, reward_of(mdp, jnp.array([1.0])))
    np.testing.assert_array_equal(plan.optimal, [[True, True, False], [True, True, True]])
    np.testing.assert_array_equal(deterministic_policy(plan.optimal), [[1, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize("discount", [0.8, 1.0])
def test_finite_plans_weigh_every_course_of_action(discount, random_mdp, dense_transitions):
    horizon = 4
    mdp = random_mdp(6, masked=True, discount=discount)
    reward, moves = np.asarray(reward_of(mdp, WEIGHTS)), dense_transitions(mdp)
    available = np.asarray(mdp.available)
    soft_tables = finite_soft_plan(mdp, reward_of(mdp, WEIGHTS), horizon)
    hard_tables = finite_hard_plan(mdp, reward_of(mdp, WEIGHTS), horizon)
    assert soft_tables.values.shape == (horizon, S)
    assert soft_tables.log_policy.shape == (horizon, S, A)

    @cache
    def to_go(t, s, best):
        """Optimal or soft value by the recursion down the whole tree of futures."""
        if t == horizon:
            return 0.0
        q = [
            reward[s, a] + discount * moves[s, a] @ [to_go(t + 1, n, best) for n in range(S)]
            for a in np.flatnonzero(available[s])
        ]
        return max(q) if best else np.log(np.sum(np.exp(q)))

    for t, s in np.ndindex(horizon, S):
        np.testing.assert_allclose(soft_tables.values[t, s], to_go(t, s, False), rtol=1e-12)
        np.testing.assert_allclose(hard_tables.values[t, s], to_go(t, s, True), rtol=1e-12)
    for tables in (soft_tables, hard_tables):
        policy = np.exp(np.asarray(tables.log_policy))
        np.testing.assert_allclose(policy.sum(2), 1)
        assert (policy[:, ~available] == 0).all()


def test_finite_hard_plans_are_the_best_deterministic_plans():
    rng = np.random.default_rng(0)
    moves, horizon = rng.dirichlet(np.ones(2), (2, 2)), 3
    mdp = TabularMDP.from_dense(moves, rng.random((2, 2, 1)), discount=1.0)
    reward = np.asarray(reward_of(mdp, jnp.array([1.0])))
    best = np.full(2, -np.inf)
    for plan in product(product(range(2), repeat=2), repeat=horizon):
        value = np.zeros(2)
        for actions in reversed(plan):
            value = reward[[0, 1], actions] + moves[[0, 1], actions] @ value
        best = np.maximum(best, value)
    tables = finite_hard_plan(mdp, reward_of(mdp, jnp.array([1.0])), horizon)
    np.testing.assert_allclose(tables.values[0], best, rtol=1e-12)


def test_ties_of_a_finite_plan_are_shared_evenly():
    mdp = TabularMDP.from_dense(np.ones((1, 3, 1)), np.array([[[1.0], [1.0], [0.0]]]), discount=1.0)
    tables = finite_hard_plan(mdp, reward_of(mdp, jnp.array([2.0])), 2)
    np.testing.assert_allclose(np.exp(tables.log_policy), [[[0.5, 0.5, 0]]] * 2)


def test_a_long_finite_horizon_approaches_the_infinite_one(random_mdp):
    mdp = random_mdp(7)
    reward = reward_of(mdp, WEIGHTS)
    plan = finite_soft_plan(mdp, reward, 400)
    np.testing.assert_allclose(plan.values[0], soft(mdp, reward).values, rtol=1e-10)
    np.testing.assert_allclose(plan.log_policy[0], soft(mdp, reward).log_policy, atol=1e-10)


def test_occupancies_satisfy_the_flow_equations(solver, random_mdp, dense_transitions):
    mdp = random_mdp(8, masked=True, discount=0.95)
    moves = dense_transitions(mdp)
    policy = soft_plan(mdp, reward_of(mdp, WEIGHTS)).policy
    visit, collect = jax.jit(occupancy), jax.jit(feature_expectations)
    for initial in (np.asarray(mdp.initial), np.eye(S)[2]):
        x = np.asarray(visit(mdp, policy, jnp.asarray(initial)))
        np.testing.assert_allclose(x.sum(1), initial + 0.95 * np.einsum("sat,sa->t", moves, x), rtol=1e-10)
        np.testing.assert_allclose(x.sum(), 20)
        np.testing.assert_allclose(x, x.sum(1, keepdims=True) * policy)
        expected = collect(mdp, policy, jnp.asarray(initial))
        np.testing.assert_allclose(expected, initial @ features_to_go(mdp, policy), rtol=1e-10)
        value = initial @ policy_values(mdp, policy, reward_of(mdp, WEIGHTS))
        np.testing.assert_allclose(value, WEIGHTS @ expected, rtol=1e-10)


def test_discounted_visits_add_up_to_the_occupancy(random_mdp):
    mdp = random_mdp(9)
    policy = soft(mdp, reward_of(mdp, WEIGHTS)).policy
    visits = finite_occupancy(mdp, jnp.broadcast_to(policy, (300, S, A)))
    np.testing.assert_allclose(visits.sum((1, 2)), 1)
    discounted = jnp.einsum("t,tsa->sa", 0.9 ** jnp.arange(300), visits)
    np.testing.assert_allclose(discounted, occupancy(mdp, policy), rtol=1e-10)


def test_simulation_collects_the_expected_features(random_mdp):
    mdp = random_mdp(10, masked=True, discount=0.8)
    plan = soft(mdp, reward_of(mdp, WEIGHTS))
    n, length = 20_000, 80
    draw = jax.jit(jax.vmap(lambda key: simulate(key, mdp, plan.log_policy, length)))
    states, actions = map(np.asarray, draw(jax.random.split(jax.random.key(0), n)))
    assert np.asarray(mdp.available)[states, actions].all()
    collected = np.einsum("t,ntk->nk", 0.8 ** np.arange(length), np.asarray(mdp.features)[states, actions])
    error = np.abs(collected.mean(0) - feature_expectations(mdp, plan.policy))
    assert (error <= 4 * collected.std(0) / np.sqrt(n) + 0.8**length * 5).all()
    # The standard error of a standard deviation of 20 000 values is half a percent.
    np.testing.assert_allclose(feature_deviations(mdp, plan.policy), collected.std(0), rtol=0.03)
    fixed, _ = simulate(jax.random.key(1), mdp, plan.log_policy, 5, first=jnp.array(3))
    assert fixed[0] == 3


def test_reachable_states_are_those_of_the_transitive_closure(random_mdp, dense_transitions):
    sizes = set()
    for seed in range(30):
        mdp = random_mdp(seed, n_states=8, n_actions=1, n_successors=1, starts=1)
        step = np.eye(8, dtype=int) + (dense_transitions(mdp).sum(1) > 0)
        closure = np.linalg.matrix_power(step, 8) > 0
        reached = reachable_states(mdp)
        np.testing.assert_array_equal(reached, closure[np.asarray(mdp.initial) > 0].any(0))
        np.testing.assert_array_equal(reachable_states(mdp, np.eye(8)[5]), closure[5])
        sizes.add(int(reached.sum()))
    assert len(sizes) > 2


def test_an_infinite_horizon_needs_a_discount_below_one(random_mdp):
    mdp = random_mdp(11, discount=1.0)
    reward, policy = reward_of(mdp, WEIGHTS), jnp.full((S, A), 1 / A)
    for plan in (
        lambda: soft_plan(mdp, reward),
        lambda: hard_plan(mdp, reward),
        lambda: policy_values(mdp, policy, reward),
        lambda: features_to_go(mdp, policy),
        lambda: occupancy(mdp, policy),
        lambda: feature_expectations(mdp, policy),
    ):
        with pytest.raises(ValueError, match=r"discount 1 has no infinite-horizon solution.*finite horizon"):
            plan()


small = st.lists(st.floats(-3, 3), min_size=S, max_size=S)


@given(potential=small, seed=st.integers(0, 3))
def test_shaping_by_a_potential_leaves_the_soft_policy_unchanged(potential, seed, random_mdp):
    mdp, potential = random_mdp(seed), jnp.asarray(potential)
    reward = reward_of(mdp, WEIGHTS)
    shaped = reward + mdp.discount * mdp.expect_next(potential) - potential[:, None]
    plain, moved = soft(mdp, reward), soft(mdp, shaped)
    np.testing.assert_allclose(moved.log_policy, plain.log_policy, atol=1e-10)
    np.testing.assert_allclose(moved.values, plain.values - potential, atol=1e-10)


@given(order=st.permutations(range(S)), constant=st.floats(-5, 5))
def test_relabelling_states_relabels_the_plan_and_a_constant_reward_shifts_it(
    order, constant, random_mdp, dense_transitions
):
    mdp, order = random_mdp(12, n_successors=S), np.array(order)
    moved = TabularMDP.from_dense(
        dense_transitions(mdp)[order][:, :, order], np.asarray(mdp.features)[order], discount=0.9
    )
    here = soft(mdp, reward_of(mdp, WEIGHTS))
    there = soft(moved, reward_of(moved, WEIGHTS) + constant)
    np.testing.assert_allclose(there.values, np.asarray(here.values)[order] + constant / 0.1, atol=1e-9)
    np.testing.assert_allclose(there.policy, np.asarray(here.policy)[order], atol=1e-10)


def test_the_gradient_in_a_whole_process_is_that_of_its_probabilities(random_mdp):
    mdp = random_mdp(3, n_successors=3, masked=True)
    assert mdp.inflow_pairs is not None
    mix = jnp.asarray(np.random.default_rng(3).normal(size=(4, S, mdp.n_actions)))

    # Expectations of the next state plan, and masses pushed forward visit: both read the probabilities.
    def value(mdp):
        policies = jnp.exp(finite_soft_plan(mdp, reward_of(mdp, WEIGHTS), 4).log_policy)
        return jnp.sum(mix * finite_occupancy(mdp, policies))

    gradient = jax.jit(jax.grad(value, allow_int=True))(mdp).probabilities
    along = jax.jit(lambda x: value(mdp.with_probabilities(mdp.probabilities + x)))
    for pair in np.argwhere(np.asarray(mdp.available)):
        for slot in range(mdp.probabilities.shape[2]):
            step = jnp.zeros(mdp.probabilities.shape).at[(*pair, slot)].set(1e-5)
            difference = (along(step) - along(-step)) / 2e-5
            np.testing.assert_allclose(gradient[(*pair, slot)], difference, rtol=1e-6, atol=1e-9)


NOT_NUMBERS = {
    "soft plan": lambda mdp, bad: soft_plan(mdp, bad).values,
    "hard plan": lambda mdp, bad: hard_plan(mdp, bad).values,
    "greedy policy": lambda mdp, bad: deterministic_policy(hard_plan(mdp, bad).optimal),
    "finite soft plan": lambda mdp, bad: finite_soft_plan(mdp, bad, 9).values[0],
    "finite hard plan": lambda mdp, bad: finite_hard_plan(mdp, bad, 9).values[0],
    "values of a policy": lambda mdp, bad: policy_values(mdp, jnp.ones_like(bad), bad),
    "occupancy": lambda mdp, bad: occupancy(mdp, bad),
    "features to go": lambda mdp, bad: features_to_go(mdp, bad),
}


@pytest.mark.parametrize("function", NOT_NUMBERS.values(), ids=NOT_NUMBERS)
def test_nan_is_named_where_there_are_numbers_and_propagates_where_there_are_none(function, random_mdp):
    mdp = random_mdp(0)
    bad = jnp.ones((S, mdp.n_actions)).at[1, 2].set(jnp.nan)
    with pytest.raises(ValueError, match=r"of state 1, action 2 is nan, not a number"):
        function(mdp, bad)
    # Every state of this process leads to every other.
    assert np.isnan(jax.jit(function)(mdp, bad)).all()


def test_nan_propagates_through_large_plans(sweeping, random_mdp):
    mdp = random_mdp(0)
    bad = jnp.ones((S, mdp.n_actions)).at[1, 2].set(jnp.nan)
    for plan in (soft_plan, hard_plan):
        assert np.isnan(jax.jit(plan)(mdp, bad).values).all()


def test_nan_of_an_action_that_is_not_available_does_not_matter(random_mdp):
    mdp = random_mdp(0, masked=True)
    reward = jnp.where(mdp.available, 1.0, jnp.nan)
    np.testing.assert_allclose(hard_plan(mdp, reward).values, 1 / (1 - mdp.discount))
