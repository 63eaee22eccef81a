"""Finite-horizon maximum causal entropy IRL against enumeration, finite differences and known experts."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, special

from i2rl.inference.programs.finite_horizon import (
    UnmatchedError,
    discounted_visits,
    expected_features,
    expected_visits,
    feature_dual,
    fit_state_rewards,
    fit_weights,
    state_reward,
)
from i2rl.models import TabularMDP, finite_soft_plan, reward_of
from i2rl.models.process.planning import finite_hard_plan, finite_occupancy

T = 6  # one horizon, so that most tests share compiled programs


def random_mdp(
    seed: int,
    n_states: int = 8,
    n_actions: int = 3,
    width: int = 3,
    n_features: int = 4,
    discount: float = 1.0,
) -> TabularMDP:
    rng = np.random.default_rng(seed)
    pairs = [(s, a) for s in range(n_states) for a in range(n_actions)]
    successors = np.array([rng.choice(n_states, width, replace=False) for _ in pairs])
    shape = (n_states, n_actions, width)
    return TabularMDP.from_successors(
        successors.reshape(shape),
        rng.dirichlet(np.ones(width), (n_states, n_actions)),
        rng.random((n_states, n_actions, n_features)),
        initial=rng.dirichlet(np.ones(n_states)),
        discount=discount,
    )


_plan = jax.jit(finite_soft_plan, static_argnames="horizon")


def policy_of(mdp: TabularMDP, weights: np.ndarray, horizon: int) -> np.ndarray:
    return np.exp(_plan(mdp, reward_of(mdp, weights), horizon).log_policy)


def one_hot(mdp: TabularMDP) -> TabularMDP:
    features = np.repeat(np.eye(mdp.n_states)[:, None, :], mdp.n_actions, axis=1)
    return TabularMDP.from_successors(
        np.asarray(mdp.successors),
        np.asarray(mdp.probabilities),
        features,
        initial=np.asarray(mdp.initial),
        discount=float(mdp.discount),
    )


def dense_expectations(mdp: TabularMDP, policies: np.ndarray, discount: float) -> np.ndarray:
    """Compute feature expectations by dense matrix products, independent of the package's recursions."""
    dense = np.zeros((mdp.n_states, mdp.n_actions, mdp.n_states))
    for s, a in np.ndindex(mdp.n_states, mdp.n_actions):
        np.add.at(dense[s, a], np.asarray(mdp.successors[s, a]), np.asarray(mdp.probabilities[s, a]))
    state, total = np.asarray(mdp.initial), np.zeros(mdp.n_features)
    for t, policy in enumerate(policies):
        pairs = state[:, None] * policy
        total += discount**t * np.einsum("sa,sak->k", pairs, np.asarray(mdp.features))
        state = np.einsum("sa,sap->p", pairs, dense)
    return total


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_gradient_of_the_dual_is_its_finite_difference(discount: float):
    mdp, horizon = random_mdp(0, discount=discount), T
    rng = np.random.default_rng(1)
    weights, target = rng.normal(size=4), rng.random(4)
    _, gradient = feature_dual(mdp, weights, target, horizon)
    difference = optimize.approx_fprime(
        weights, lambda w: float(feature_dual(mdp, w, target, horizon)[0]), epsilon=1e-6
    )
    np.testing.assert_allclose(gradient, difference, atol=1e-4)


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_expected_features_are_those_of_dense_matrix_products(discount: float):
    mdp, horizon = random_mdp(2, discount=discount), T
    weights = np.random.default_rng(3).normal(size=4)
    expected = dense_expectations(mdp, policy_of(mdp, weights, horizon), discount)
    np.testing.assert_allclose(expected_features(mdp, weights, horizon), expected, rtol=1e-12)


@pytest.mark.parametrize("discount", [1.0, 0.9])
@pytest.mark.parametrize("seed", range(4))
def test_true_weights_are_recovered_from_state_action_features(seed: int, discount: float):
    mdp, horizon = random_mdp(seed, discount=discount), T
    true = 2 * np.random.default_rng(seed + 50).normal(size=4)
    target = np.asarray(expected_features(mdp, true, horizon))
    fit = fit_weights(mdp, horizon, target, tolerance=1e-10)
    np.testing.assert_allclose(fit.weights, true, atol=1e-7)
    np.testing.assert_allclose(expected_features(mdp, fit.weights, horizon), target + fit.gap, atol=1e-12)
    assert np.abs(fit.gap).max() <= 1e-10


def test_redundant_features_leave_the_policy_unique():
    base, horizon = random_mdp(7), T
    doubled = np.concatenate([base.features, base.features[..., :1], np.ones((8, 3, 1))], axis=-1)
    mdp = TabularMDP.from_successors(
        np.asarray(base.successors),
        np.asarray(base.probabilities),
        doubled,
        initial=np.asarray(base.initial),
        discount=1,
    )
    true = np.array([1.0, -2.0, 0.5, 1.5, 1.0, 3.0])
    fit = fit_weights(mdp, horizon, np.asarray(expected_features(mdp, true, horizon)), tolerance=1e-10)
    np.testing.assert_allclose(policy_of(mdp, fit.weights, horizon), policy_of(mdp, true, horizon), atol=1e-8)


@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_state_rewards_reproduce_the_experts_policy_and_visits(discount: float):
    mdp, horizon = random_mdp(4, n_states=12, discount=discount), T
    true = np.random.default_rng(5).normal(size=12)
    visits = np.asarray(expected_visits(mdp, true, horizon))
    assert visits.sum() == pytest.approx(sum(discount**t for t in range(horizon)))
    fit = fit_state_rewards(mdp, horizon, visits, tolerance=1e-7)
    np.testing.assert_allclose(expected_visits(mdp, fit.weights, horizon), visits, atol=1e-7)
    found = _plan(mdp, state_reward(mdp, fit.weights), horizon).log_policy
    expert = _plan(mdp, state_reward(mdp, true), horizon).log_policy
    np.testing.assert_allclose(found, expert, atol=1e-4)


def test_undiscounted_state_rewards_are_recovered_up_to_a_constant():
    mdp, horizon = random_mdp(4, n_states=12), T
    true = np.random.default_rng(5).normal(size=12)
    fit = fit_state_rewards(mdp, horizon, np.asarray(expected_visits(mdp, true, horizon)), tolerance=1e-7)
    np.testing.assert_allclose(fit.weights - fit.weights.mean(), true - true.mean(), atol=1e-3)


def test_the_three_solvers_find_one_policy():
    """L-BFGS on state rewards, Newton's polish on the same features written out, and SciPy's trust region."""
    mdp, horizon = one_hot(random_mdp(6, n_states=12)), T
    true = np.random.default_rng(8).normal(size=12)
    target = np.asarray(expected_visits(mdp, true, horizon))
    rewards = fit_state_rewards(mdp, horizon, target, tolerance=1e-7)
    polished = fit_weights(mdp, horizon, target, tolerance=1e-11)
    trust = optimize.minimize(
        lambda w: tuple(np.asarray(x) for x in feature_dual(mdp, w, target, horizon)),
        np.zeros(12),
        jac=True,
        method="trust-constr",
        options={"gtol": 1e-9},
    )
    expert = policy_of(mdp, true, horizon)
    for weights, error in ((rewards.weights, 1e-5), (polished.weights, 1e-9), (trust.x, 1e-5)):
        np.testing.assert_allclose(policy_of(mdp, weights, horizon), expert, atol=error)


def test_more_features_than_newton_takes_are_matched_by_gradients_alone():
    mdp, horizon = random_mdp(9, n_states=40, n_features=70), T
    true = np.random.default_rng(10).normal(size=70)
    target = np.asarray(expected_features(mdp, true, horizon))
    fit = fit_weights(mdp, horizon, target, tolerance=1e-6)
    np.testing.assert_allclose(expected_features(mdp, fit.weights, horizon), target, atol=1.1e-6)


def deterministic_mdp(seed: int, n_states: int = 4, n_actions: int = 2, n_features: int = 3) -> TabularMDP:
    rng = np.random.default_rng(seed)
    return TabularMDP.from_successors(
        rng.integers(n_states, size=(n_states, n_actions, 1)),
        np.ones((n_states, n_actions, 1)),
        rng.normal(size=(n_states, n_actions, n_features)),
        initial=np.eye(n_states)[0],
        discount=1.0,
    )


def enumerate_trajectories(mdp: TabularMDP, horizon: int) -> tuple[list[list[tuple[int, int]]], np.ndarray]:
    """Enumerate the trajectories of a deterministic process from state 0, and their feature sums ``f(X)``."""
    paths = []
    for actions in itertools.product(range(mdp.n_actions), repeat=horizon):
        state, path = 0, []
        for action in actions:
            path.append((state, action))
            state = int(mdp.successors[state, action, 0])
        paths.append(path)
    features = np.asarray(mdp.features)
    return paths, np.array([sum(features[s, a] for s, a in path) for path in paths])


@pytest.mark.parametrize("seed", range(3))
def test_deterministic_law_is_maximum_entropy_over_enumerated_trajectories(seed: int):
    """Check Eq. 2.2: ``P(X) ~ exp(theta . f(X))`` and causal entropy coincide in deterministic processes."""
    mdp, horizon = deterministic_mdp(seed), 5
    paths, sums = enumerate_trajectories(mdp, horizon)
    rng = np.random.default_rng(seed + 20)
    # A target of no soft policy: the features of an arbitrary law over trajectories.
    target = rng.dirichlet(np.ones(len(paths))) @ sums
    fit = fit_weights(mdp, horizon, target, tolerance=1e-9)
    log_law = sums @ fit.weights - special.logsumexp(sums @ fit.weights)
    log_policy = np.asarray(_plan(mdp, reward_of(mdp, fit.weights), horizon).log_policy)
    causal = [sum(log_policy[t, s, a] for t, (s, a) in enumerate(path)) for path in paths]
    np.testing.assert_allclose(causal, log_law, atol=1e-10)
    np.testing.assert_allclose(np.exp(log_law) @ sums, target, atol=1e-8)
    brute = optimize.minimize(lambda w: special.logsumexp(sums @ w) - w @ target, np.zeros(3), tol=1e-10)
    np.testing.assert_allclose(fit.weights, brute.x, atol=1e-4)
    assert fit.value == pytest.approx(-np.exp(log_law) @ log_law, abs=1e-7)


def test_optimal_value_is_the_causal_entropy_of_the_policy():
    mdp, horizon = random_mdp(11), T
    true = np.random.default_rng(12).normal(size=4)
    fit = fit_weights(mdp, horizon, np.asarray(expected_features(mdp, true, horizon)), tolerance=1e-9)
    policies = policy_of(mdp, true, horizon)
    pairs = np.asarray(finite_occupancy(mdp, jnp.asarray(policies)))
    assert fit.value == pytest.approx(-np.sum(pairs * np.log(policies)), abs=1e-6)


def test_visits_are_the_gradient_of_the_soft_value_in_the_reward():
    mdp, horizon = random_mdp(13, discount=0.7), T
    reward = np.random.default_rng(14).normal(size=(8, 3))
    _, visits = discounted_visits(mdp, reward, horizon)
    difference = optimize.approx_fprime(
        reward.ravel(),
        lambda r: float(discounted_visits(mdp, jnp.asarray(r).reshape(8, 3), horizon)[0]),
        epsilon=1e-6,
    )
    np.testing.assert_allclose(visits.ravel(), difference, atol=1e-5)


def test_a_warm_start_at_the_answer_costs_one_evaluation():
    mdp, horizon = random_mdp(15), T
    true = np.array([1.0, -1.0, 0.5, 2.0])
    fit = fit_weights(mdp, horizon, np.asarray(expected_features(mdp, true, horizon)), start=true)
    assert fit.evaluations == 1
    np.testing.assert_array_equal(fit.weights, true)


def test_unavailable_actions_are_never_taken():
    rng = np.random.default_rng(16)
    available = np.ones((6, 3), bool)
    available[[0, 2, 4], [1, 0, 2]] = False
    mdp = TabularMDP.from_successors(
        rng.integers(6, size=(6, 3, 2)),
        np.full((6, 3, 2), 0.5),
        rng.random((6, 3, 2)),
        available=available,
        discount=1.0,
    )
    true = np.array([2.0, -1.0])
    fit = fit_weights(mdp, T, np.asarray(expected_features(mdp, true, T)), tolerance=1e-9)
    np.testing.assert_allclose(fit.weights, true, atol=1e-6)
    assert (policy_of(mdp, fit.weights, T)[:, ~available] == 0).all()


def test_a_deterministic_expert_on_the_boundary_is_matched_to_the_tolerance_with_finite_weights():
    mdp, horizon = random_mdp(17), T
    plan = finite_hard_plan(mdp, mdp.features[..., 0], horizon)
    target = dense_expectations(mdp, np.exp(plan.log_policy), 1.0)
    fit = fit_weights(mdp, horizon, target, tolerance=1e-2)
    assert np.isfinite(fit.weights).all()
    assert np.abs(fit.gap).max() <= 1e-2
    assert np.argmax(fit.weights) == 0


def test_an_unreachable_target_names_the_feature_and_what_is_reachable():
    mdp = random_mdp(18)
    most = float(mdp.initial @ finite_hard_plan(mdp, mdp.features[..., 2], T).values[0])
    target = np.array(expected_features(mdp, np.zeros(4), T))
    target[2] = 6.5
    with pytest.raises(UnmatchedError, match=rf"'f2' should reach 6\.5.* and {most:.6g} under any policy"):
        fit_weights(mdp, T, target)


def test_visits_the_dynamics_forbid_name_the_state():
    mdp = random_mdp(19)
    target = np.zeros(8)
    target[3] = 6.0
    with pytest.raises(UnmatchedError, match="'s3' should reach 6,"):
        fit_state_rewards(mdp, T, target)


def test_contradicting_features_are_reported_as_such():
    base = random_mdp(21, n_features=1)
    mdp = TabularMDP.from_successors(
        np.asarray(base.successors),
        np.asarray(base.probabilities),
        np.repeat(base.features, 2, axis=-1),
        discount=1.0,
    )
    middle = float(expected_features(mdp, np.zeros(2), T)[0])
    with pytest.raises(UnmatchedError, match="contradict itself"):
        fit_weights(mdp, T, np.array([middle - 0.1, middle + 0.1]))


@pytest.mark.parametrize(
    ("horizon", "target", "options", "message"),
    [
        (0, np.ones(4), {}, "horizon must be at least 1 step, got 0"),
        (5, np.ones(3), {}, r"target must have shape \[4\]"),
        (5, np.array([1, np.nan, 1, 1]), {}, "target must be finite; entry 1 is nan"),
        (5, np.ones(4), {"start": np.ones((4, 1))}, r"start must have shape \[4\]"),
        (5, np.ones(4), {"tolerance": 0.0}, "tolerance must be positive, got 0.0"),
    ],
)
def test_ill_formed_requests_are_refused(horizon: int, target: np.ndarray, options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        fit_weights(random_mdp(0), horizon, target, **options)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (np.full(7, 5 / 7), r"target must have shape \[8\]"),
        (np.full(8, 0.5), "must sum to 5 .*, got 4"),
        (np.array([-1.0, 6, 0, 0, 0, 0, 0, 0]), "must not be negative; state 's0' has -1.0"),
    ],
)
def test_visits_that_are_none_are_refused(target: np.ndarray, message: str):
    with pytest.raises(ValueError, match=message):
        fit_state_rewards(random_mdp(0), 5, target)
