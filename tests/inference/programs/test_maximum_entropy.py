"""The maximum-entropy program: three forms, one answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.inference.programs.constraints import (
    FeatureTarget,
    InfeasibleProgram,
    ProgramNotSolved,
    flow_constraints,
    nearest_features,
)
from i2rl.inference.programs.dual import CountProgram, DualProgram
from i2rl.inference.programs.maximum_entropy import (
    LinearObjective,
    WarmStart,
    count_objective,
    expand,
    exponentiated_gradient,
    fit_counts,
    quadratic_l1,
    require_converged,
    soft_values,
    solve_dual,
)
from i2rl.inference.programs.primal import PrimalProgram
from i2rl.models.process.mdp import TabularMDP
from i2rl.models.process.planning import (
    deterministic_policy,
    feature_expectations,
    hard_plan,
    occupancy,
    reachable_states,
    reward_of,
    soft_plan,
)
from i2rl.models.process.units import feature_scale

soft_policy = jax.jit(lambda mdp, weights: soft_plan(mdp, reward_of(mdp, weights)).policy)
expected_features = jax.jit(feature_expectations)
visits = jax.jit(occupancy)


def random_mdp(seed, n_states=12, n_actions=3, n_features=3, masked=False, islands=0, discount=0.9):
    """Random successors; ``islands`` last states lead anywhere but are entered from nowhere else."""
    rng = np.random.default_rng(seed)
    mainland = n_states - islands
    successors = rng.integers(0, mainland, (n_states, n_actions, 3))
    available = np.ones((n_states, n_actions), bool)
    if masked:
        available = rng.random((n_states, n_actions)) < 0.7
        available[np.arange(n_states), rng.integers(0, n_actions, n_states)] = True
    initial = np.zeros(n_states)
    initial[:mainland] = rng.dirichlet(np.ones(mainland))
    mdp = TabularMDP.from_successors(
        successors,
        rng.dirichlet(np.ones(3), (n_states, n_actions)),
        rng.random((n_states, n_actions, n_features)),
        initial=initial,
        discount=discount,
        available=available,
    )
    # The width of the inflow table differs from one to the next: without it, one shape compiles once.
    return mdp.without_inflow()


def patrol_like(seed=0, n_states=124):
    rng = np.random.default_rng(seed)
    successors = (np.arange(n_states)[:, None, None] + rng.integers(-6, 7, (n_states, 4, 3))) % n_states
    features = (rng.random((n_states, 4, 6)) < 0.3).astype(float)
    return TabularMDP.from_successors(
        successors, rng.dirichlet(np.ones(3), (n_states, 4)), features, discount=0.99
    )


def expert_target(mdp, weights):
    policy = soft_policy(mdp, jnp.asarray(weights))
    return FeatureTarget(expected_features(mdp, policy), mdp.initial)


def expert_counts(mdp, weights, size=1.0):
    return size * np.asarray(visits(mdp, soft_policy(mdp, jnp.asarray(weights))))


def random_weights(seed, n_features=3):
    return np.random.default_rng(1000 + seed).normal(size=n_features)


def problem(seed):
    """Make twenty problems of 8 to 20 states; some lack actions, one has unreachable states."""
    sizes = {0: 8, 1: 14, 5: 20}
    return random_mdp(seed, sizes.get(seed % 6, 8), masked=seed % 3 == 1, islands=3 if seed == 5 else 0)


# -- one program, three solvers -----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_the_three_forms_agree_and_recover_the_expert(seed):
    mdp, truth = problem(seed), random_weights(seed)
    assert reachable_states(mdp).all() == (seed != 5)
    primal, dual = PrimalProgram(mdp), DualProgram(mdp)
    exact = expert_target(mdp, truth)
    slack = np.random.default_rng(seed).uniform(0.01, 0.3, 3)
    for beta in (0.0, slack, np.where(np.arange(3) == 1, 0.0, slack)):
        jax_solution = require_converged(mdp, exact, beta, solve_dual(mdp, exact, beta))
        ipopt, convex = dual.solve(exact, beta), primal.solve(exact, beta)
        for other in (ipopt, convex):
            np.testing.assert_allclose(other.weights, jax_solution.weights, atol=1e-4)
            np.testing.assert_allclose(other.values, jax_solution.values, atol=1e-3)
            assert float(jax_solution.objective) == pytest.approx(other.objective, abs=1e-6)
        if np.ndim(beta) == 0:
            np.testing.assert_allclose(jax_solution.weights, truth, atol=1e-4)
            np.testing.assert_allclose(convex.occupancy, expert_counts(mdp, truth), atol=1e-4)


def test_the_first_order_solver_of_the_primal_agrees_too():
    mdp = problem(2)
    target = expert_target(mdp, random_weights(2))
    scs = PrimalProgram(mdp, solver="SCS").solve(target, 0.05)
    np.testing.assert_allclose(scs.weights, solve_dual(mdp, target, 0.05).weights, atol=1e-4)


@pytest.mark.parametrize("ridge", [0.0, 0.3])
@pytest.mark.parametrize("slack", [0.0, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_both_count_programs_agree(seed, slack, ridge):
    mdp = problem(seed)
    counts = np.random.default_rng(seed).poisson(expert_counts(mdp, random_weights(seed), 60.0))
    jax_solution = fit_counts(mdp, counts, slack, ridge)
    ipopt = CountProgram(mdp).solve(counts, slack, ridge)
    assert jax_solution.converged
    np.testing.assert_allclose(ipopt.weights, jax_solution.weights, atol=1e-6)
    assert ipopt.objective == pytest.approx(float(jax_solution.objective), abs=1e-6)


def test_expected_counts_of_an_expert_give_back_the_expert():
    mdp, truth = problem(4), random_weights(4)
    counts = expert_counts(mdp, truth)
    np.testing.assert_allclose(fit_counts(mdp, counts).weights, truth, atol=1e-7)
    np.testing.assert_allclose(CountProgram(mdp).solve(counts).weights, truth, atol=1e-6)


def test_minus_the_count_objective_is_the_log_likelihood_of_the_visits():
    mdp, weights = problem(1), jnp.asarray(random_weights(1))
    counts = expert_counts(mdp, random_weights(2), 10.0)
    objective = count_objective(mdp, counts)
    plan = soft_plan(mdp, reward_of(mdp, weights))
    log_likelihood = jnp.sum(jnp.where(mdp.available, counts * plan.log_policy, 0.0))
    assert objective.state_weights @ plan.values - objective.features @ weights == pytest.approx(
        -log_likelihood
    )


def test_the_ridge_is_the_same_penalty_in_casadi_and_jax():
    mdp = problem(3)
    target = expert_target(mdp, random_weights(3))
    ridged = DualProgram(mdp).solve(target, 0.05, ridge=0.5)
    solution = solve_dual(mdp, target, 0.05, 0.5)
    np.testing.assert_allclose(ridged.weights, solution.weights, atol=1e-6)
    assert np.abs(ridged.weights).max() < np.abs(DualProgram(mdp).solve(target, 0.05).weights).max()


def test_a_start_other_than_the_process_s_own_changes_what_is_reachable():
    mdp = problem(5)
    everywhere = FeatureTarget(jnp.zeros(3), jnp.full(mdp.n_states, 1 / mdp.n_states))
    truth = jnp.asarray(random_weights(5))
    policy = soft_policy(mdp, truth)
    target = everywhere._replace(features=expected_features(mdp, policy, everywhere.start))
    for solution in (
        PrimalProgram(mdp).solve(target),
        DualProgram(mdp).solve(target),
        solve_dual(mdp, target),
    ):
        np.testing.assert_allclose(solution.weights, truth, atol=1e-4)


# -- optimality ---------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), slack=st.floats(0.0, 2.0))
def test_solutions_meet_the_optimality_conditions(seed, slack):
    mdp = random_mdp(seed % 7, n_states=8)
    target = expert_target(mdp, random_weights(seed))
    solution = solve_dual(mdp, target, slack)
    policy = soft_policy(mdp, solution.weights)
    # Slack is in units of each feature's scale.
    gap = (expected_features(mdp, policy) - target.features) / feature_scale(mdp)
    assert solution.converged
    assert (jnp.abs(gap) <= slack + 1e-6).all()
    # A constraint that is not tight has no multiplier; one that is pulls towards the target.
    tight = jnp.abs(gap) > slack - 1e-6
    assert (solution.weights[~tight] == 0).all()
    np.testing.assert_allclose(gap, -slack * jnp.sign(solution.weights) * tight + gap * ~tight, atol=1e-6)


def test_enough_slack_leaves_no_reward_to_learn():
    mdp = problem(0)
    target = expert_target(mdp, random_weights(0))
    aimless = expert_target(mdp, np.zeros(3))
    slack = jnp.abs(aimless.features - target.features) / feature_scale(mdp) + 1e-3
    assert (solve_dual(mdp, target, slack).weights == 0).all()
    np.testing.assert_allclose(DualProgram(mdp).solve(target, slack).weights, 0, atol=1e-6)
    np.testing.assert_allclose(PrimalProgram(mdp).solve(target, slack).weights, 0, atol=1e-6)


def test_gradient_and_hessian_are_those_of_the_dual():
    mdp = problem(1)
    target = expert_target(mdp, random_weights(9))
    weights = jnp.asarray(random_weights(1))

    def dual(w):
        return target.start @ soft_values(mdp, w) - target.features @ w

    objective = LinearObjective(target.start, target.features)
    expansion = expand(mdp, objective, weights, soft_values(mdp, weights))
    np.testing.assert_allclose(expansion.gradient, jax.grad(dual)(weights), rtol=1e-8)
    np.testing.assert_allclose(expansion.hessian, jax.hessian(dual)(weights), rtol=1e-8)
    nudge = 1e-6 * jnp.eye(3)
    by_differences = jnp.stack([(dual(weights + d) - dual(weights - d)) / 2e-6 for d in nudge])
    np.testing.assert_allclose(expansion.gradient, by_differences, atol=1e-6)


def test_fisher_information_is_the_hessian_where_the_counts_are_the_policy_s_own():
    mdp, weights = problem(1), jnp.asarray(random_weights(1))
    objective = count_objective(mdp, expert_counts(mdp, random_weights(1), 7.0))

    def loss(w):
        return objective.state_weights @ soft_values(mdp, w) - objective.features @ w

    expansion = expand(mdp, objective, weights, soft_values(mdp, weights))
    np.testing.assert_allclose(expansion.hessian, jax.hessian(loss)(weights), rtol=1e-7)
    np.testing.assert_allclose(expansion.gradient, 0, atol=1e-8)


def test_the_quadratic_model_of_counts_is_convex_and_never_flatter_than_the_likelihood():
    mdp, flatter = problem(1), 0
    for seed in range(20):
        pairs = np.argwhere(mdp.available)
        counts = np.zeros(mdp.available.shape)
        counts[tuple(pairs[seed % len(pairs)])] = 1.0
        objective = count_objective(mdp, counts)
        weights = jnp.asarray(4 * random_weights(seed))

        def loss(w, objective=objective):
            return objective.state_weights @ soft_values(mdp, w) - objective.features @ w

        model = expand(mdp, objective, weights, soft_values(mdp, weights)).hessian
        exact = jax.hessian(loss)(weights)
        assert np.linalg.eigvalsh(model).min() >= -1e-10
        assert np.linalg.eigvalsh(model - exact).min() >= -1e-8
        flatter += np.linalg.eigvalsh(exact).min() < -1e-3
    assert flatter > 0  # the likelihood itself is not concave: the model is needed


def test_a_few_visits_are_fitted_to_convergence():
    mdp = problem(1)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        counts = rng.poisson(0.3, mdp.available.shape) * np.asarray(mdp.available)
        start = WarmStart(jnp.asarray(3 * random_weights(seed)), jnp.zeros(mdp.n_states))
        solution = fit_counts(mdp, counts, 1e-3, start=start)
        assert solution.converged, seed


minimise_quadratic = jax.jit(quadratic_l1)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 100_000), rank=st.integers(1, 5))
def test_the_quadratic_model_is_solved_to_its_optimality_conditions(seed, rank):
    rng = np.random.default_rng(seed)
    n = 5
    root = rng.normal(size=(n, rank))
    curvature, slack, origin = root @ root.T, rng.uniform(0, 2, n) * (rng.random(n) < 0.7), rng.normal(size=n)
    # Bounded below, with or without slack, because the slope lies in the range of the curvature.
    slope = root @ rng.normal(size=rank)
    found = np.asarray(minimise_quadratic(curvature, slope, slack, origin, 1e-10))
    pull = slope + curvature @ (found - origin)
    np.testing.assert_allclose(pull[found != 0], -(slack * np.sign(found))[found != 0], atol=1e-5)
    assert (np.abs(pull) <= slack + 1e-5).all()


def test_dependent_features_get_finite_weights_and_the_right_behaviour():
    base = problem(6)
    features = np.asarray(base.features)
    constant = np.ones((*features.shape[:2], 1))
    nothing = 0 * constant
    mdp = TabularMDP.from_successors(
        np.asarray(base.successors),
        np.asarray(base.probabilities),
        np.concatenate([features, features[..., :1] + features[..., 1:2], constant, nothing], -1),
        initial=np.asarray(base.initial),
        discount=0.9,
        available=np.asarray(base.available),
    )
    truth = random_weights(6)
    target = expert_target(mdp, np.concatenate([truth, np.zeros(3)]))
    behaviour = soft_policy(base, jnp.asarray(truth))
    solution = solve_dual(mdp, target)
    assert solution.converged
    assert np.abs(solution.weights).max() < 10
    for weights in (solution.weights, DualProgram(mdp).solve(target).weights):
        np.testing.assert_allclose(soft_policy(mdp, jnp.asarray(weights)), behaviour, atol=1e-6)


# -- sessions -----------------------------------------------------------------------------------------


def session_targets(mdp, truth, n, seed=0):
    """Simulate running averages of sessions: the target settles while demonstrations come in."""
    rng = np.random.default_rng(seed)
    exact = expert_target(mdp, truth)
    return [
        expert_target(mdp, truth + 0.1 * rng.normal(size=len(truth)) / (i + 1))._replace(start=exact.start)
        for i in range(n)
    ]


@pytest.mark.parametrize("slack", [0.0, 0.5])
def test_ipopt_takes_few_iterations_from_the_previous_session(slack):
    mdp = patrol_like()
    program = DualProgram(mdp)
    first, *later = session_targets(mdp, random_weights(0, 6), 6)
    warm = program.solve(first, slack).warm
    cold_iterations, warm_iterations = [], []
    for target in later:
        cold, continued = program.solve(target, slack), program.solve(target, slack, warm=warm)
        np.testing.assert_allclose(continued.weights, cold.weights, atol=1e-6)
        warm = continued.warm
        cold_iterations.append(cold.iterations)
        warm_iterations.append(continued.iterations)
    assert np.median(warm_iterations) <= 6
    assert np.median(warm_iterations) < 0.6 * np.median(cold_iterations)


@pytest.mark.parametrize("slack", [0.0, 0.5])
def test_jax_takes_fewer_iterations_from_the_previous_session(slack):
    mdp = patrol_like()
    first, *later = session_targets(mdp, random_weights(0, 6), 6)
    start = solve_dual(mdp, first, slack).warm()
    cold_iterations, warm_iterations = [], []
    for target in later:
        cold, warm = solve_dual(mdp, target, slack), solve_dual(mdp, target, slack, start=start)
        np.testing.assert_allclose(warm.weights, cold.weights, atol=1e-8)
        start = warm.warm()
        cold_iterations.append(int(cold.iterations))
        warm_iterations.append(int(warm.iterations))
    assert np.median(warm_iterations) <= 3 < np.median(cold_iterations)
    assert int(solve_dual(mdp, later[-1], slack, start=start).iterations) == 0


def test_counts_warm_start_from_the_previous_session():
    mdp = problem(7)
    program = CountProgram(mdp)
    counts = np.random.default_rng(0).poisson(expert_counts(mdp, random_weights(7), 50.0))
    more = counts + np.random.default_rng(1).poisson(expert_counts(mdp, random_weights(7), 5.0))
    cold, warm = program.solve(more, 1.0), program.solve(more, 1.0, warm=program.solve(counts, 1.0).warm)
    np.testing.assert_allclose(warm.weights, cold.weights, atol=1e-6)
    assert warm.iterations < cold.iterations
    continued = fit_counts(mdp, more, 1.0, start=fit_counts(mdp, counts, 1.0).warm())
    assert continued.iterations < fit_counts(mdp, more, 1.0).iterations


def test_a_warm_start_survives_a_change_of_slack_and_a_wild_guess():
    mdp = problem(8)
    program, target = DualProgram(mdp), expert_target(mdp, random_weights(8))
    warm = program.solve(target).warm
    slacked = program.solve(target, 0.2, warm=warm)
    np.testing.assert_allclose(slacked.weights, solve_dual(mdp, target, 0.2).weights, atol=1e-6)
    back = program.solve(target, 0.0, warm=slacked.warm)
    np.testing.assert_allclose(back.weights, random_weights(8), atol=1e-6)
    wild = WarmStart(jnp.array([300.0, -200.0, 500.0]), jnp.full(mdp.n_states, -1e4))
    far = solve_dual(mdp, target, start=wild)
    assert far.converged
    np.testing.assert_allclose(far.weights, random_weights(8), atol=1e-6)


def test_a_fleet_of_learners_solves_as_each_would_alone():
    mdp = problem(9)
    targets = [expert_target(mdp, random_weights(s)) for s in range(6)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *targets)
    solve_all = jax.jit(jax.vmap(lambda target, slack: solve_dual(mdp, target, slack), in_axes=(0, None)))
    for slack in (0.0, 0.1):
        fleet = solve_all(stacked, slack)
        for i, target in enumerate(targets):
            alone = solve_dual(mdp, target, slack)
            np.testing.assert_allclose(fleet.weights[i], alone.weights, atol=1e-9)
            assert fleet.iterations[i] == alone.iterations


# -- what cannot be done ------------------------------------------------------------------------------


@pytest.mark.parametrize("slack", [0.0, 0.25])
def test_a_target_no_policy_meets_is_refused_by_the_feature_s_name(slack):
    base = problem(10)
    mdp = TabularMDP.from_successors(
        np.asarray(base.successors),
        np.asarray(base.probabilities),
        np.asarray(base.features),
        initial=np.asarray(base.initial),
        discount=0.9,
        available=np.asarray(base.available),
        feature_names=["speed", "comfort", "noise"],
    )
    most = hard_plan(mdp, mdp.features[..., 1])
    best = expected_features(mdp, deterministic_policy(most.optimal))
    target = FeatureTarget(best.at[1].add(1.5), mdp.initial)
    for solve in (
        lambda: PrimalProgram(mdp).solve(target, slack),
        lambda: DualProgram(mdp).solve(target, slack),
        lambda: require_converged(mdp, target, slack, solve_dual(mdp, target, slack)),
    ):
        with pytest.raises(InfeasibleProgram, match="'comfort' \\(1\\)"):
            solve()
    shortfall = np.maximum(np.abs(nearest_features(mdp, target, slack) - target.features) - slack, 0).sum()
    assert 0 < shortfall <= 1.5 - slack + 1e-9
    assert not jnp.isnan(solve_dual(mdp, target, slack).weights).any()


def test_visits_of_a_deterministic_expert_need_a_penalty():
    mdp = random_mdp(3, n_states=8, n_features=2)
    weights = jnp.array([1.0, -1.0])
    policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)
    counts = np.asarray(occupancy(mdp, policy))
    solution = fit_counts(mdp, counts, 0.1)
    assert solution.converged
    np.testing.assert_allclose(CountProgram(mdp).solve(counts, 0.1).weights, solution.weights, atol=1e-5)


def test_an_unfinished_solve_is_an_error_and_not_a_result():
    mdp = problem(0)
    target = expert_target(mdp, random_weights(0))
    unfinished = solve_dual(mdp, target)._replace(converged=jnp.array(False))
    with pytest.raises(ProgramNotSolved, match="Newton iterations"):
        require_converged(mdp, target, 0.0, unfinished)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": jnp.zeros(2)}, r"\[K\] = \[3\]"),
        ({"start": jnp.ones(4)}, r"\[S\] ="),
        ({"features": jnp.array([0.0, jnp.nan, 1.0])}, "'f1' \\(1\\) is nan"),
        ({"start": jnp.ones(8)}, "distribution over states"),
    ],
)
def test_malformed_targets_are_refused(change, message):
    mdp = problem(0)
    target = expert_target(mdp, random_weights(0))._replace(**change)
    for program in (PrimalProgram(mdp), DualProgram(mdp)):
        with pytest.raises(ValueError, match=message):
            program.solve(target)


def test_malformed_slack_counts_solvers_and_discounts_are_refused():
    mdp = problem(1)
    target = expert_target(mdp, random_weights(1))
    with pytest.raises(ValueError, match="not negative"):
        DualProgram(mdp).solve(target, -0.1)
    with pytest.raises(ValueError, match="slack must be a number or have shape"):
        solve_dual(mdp, target, jnp.ones(2))
    with pytest.raises(ValueError, match="solver must be one of"):
        PrimalProgram(mdp, solver="MAGIC")
    stray = np.where(np.asarray(mdp.available), 1.0, 2.0)
    with pytest.raises(ValueError, match="unavailable pair"):
        CountProgram(mdp).solve(stray)
    with pytest.raises(ValueError, match="counts must have shape"):
        fit_counts(mdp, jnp.ones(3))
    endless = random_mdp(0, discount=1.0)
    for build in (PrimalProgram, DualProgram, CountProgram, lambda m: solve_dual(m, target)):
        with pytest.raises(ValueError, match="discount 1"):
            build(endless)


def test_flow_constraints_hold_for_the_occupancy_of_any_policy():
    mdp = problem(5)
    flow = flow_constraints(mdp, reachable_states(mdp))
    x = expert_counts(mdp, random_weights(0))[flow.pair_state, flow.pair_action]
    np.testing.assert_allclose(flow.balance @ x, np.asarray(mdp.initial)[flow.states], atol=1e-12)
    assert x.sum() == pytest.approx(1 / (1 - 0.9))


# -- the dissertation's solver ------------------------------------------------------------------------


def test_exponentiated_gradient_finds_an_expert_on_the_simplex():
    mdp = problem(2)
    truth = jnp.array([0.2, 0.7, 0.1]) / feature_scale(mdp)
    target = expert_target(mdp, truth)
    solution = exponentiated_gradient(mdp, target, epsilon=1e-4)
    assert solution.converged
    assert solution.residual <= 1e-4
    assert (feature_scale(mdp) * solution.weights).sum() == pytest.approx(1)
    np.testing.assert_allclose(solution.weights, truth, atol=0.1)
    better = exponentiated_gradient(mdp, target, epsilon=1e-8, start=solution.weights)
    np.testing.assert_allclose(better.weights, truth, atol=1e-5)


def test_exponentiated_gradient_cannot_express_dislike():
    mdp = problem(2)
    target = expert_target(mdp, [0.5, -1.0, 0.5])
    solution = exponentiated_gradient(mdp, target, epsilon=0.01, max_steps=500)
    assert not solution.converged
    assert (solution.weights >= 0).all()
    assert solve_dual(mdp, target).weights[1] == pytest.approx(-1.0)
    with pytest.raises(ValueError, match="positive starting weights"):
        exponentiated_gradient(mdp, target, start=jnp.array([1.0, -1.0, 0.0]))
