"""The maximum-entropy observation program: against its primal, by stationarity, and by recovery."""

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.inference.programs.observation import ObservationProgram, unidentified_predicates
from i2rl.models import FeatureNoise
from i2rl.models.observation.agreement import predicate_classes, reported_matches


def random_problem(seed, n_predicates=3, shape=(5, 3), hidden=0.0):
    """Make predicates, reliabilities, weights of truths, and the possible observations."""
    rng = np.random.default_rng(seed)
    predicates = rng.random((n_predicates, *shape)) < 0.5
    reportable = rng.random(shape) >= hidden
    reportable.flat[0] = True
    reliabilities = rng.uniform(0.2, 0.95, n_predicates)
    return predicates, reliabilities, rng.dirichlet(np.ones(shape[0] * shape[1])).reshape(shape), reportable


def expected_agreement(predicates, reliabilities, weights, reportable=None):
    return np.einsum("jsa,sa->j", FeatureNoise(predicates, reliabilities, reportable).agreement(), weights)


def dual(predicates, logits, weights, reportable, target, slack):
    """Compute the dual by summation over all pairs of pairs."""
    psi = predicates.reshape(len(predicates), -1)
    agree = psi[:, :, None] == psi[:, None]
    energies = np.tensordot(logits, agree, 1)[:, reportable.ravel()]
    log_z = np.log(np.exp(energies).sum(1))
    return weights.ravel() @ log_z - logits @ target + slack @ np.abs(logits)


def primal(predicates, weights, reportable, target, slack):
    """``O [SA, SA]`` and its entropy by CVXPY, over all distributions."""
    psi = predicates.reshape(len(predicates), -1)
    w, said = weights.ravel(), reportable.ravel()
    o = cp.Variable((len(w), said.sum()), nonneg=True)
    agreement = [
        cp.sum(cp.multiply(o, w[:, None] * (row[:, None] == row[None, said]).astype(float))) for row in psi
    ]
    program = cp.Problem(
        cp.Maximize(cp.sum(cp.multiply(np.tile(w[:, None], said.sum()), cp.entr(o)))),
        [cp.sum(o, axis=1) == 1, cp.abs(cp.hstack(agreement) - target) <= slack],
    )
    program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    return o.value, program.value


@pytest.mark.parametrize("slack", [0.0, 0.03])
def test_the_solution_is_that_of_the_primal_over_all_distributions(slack):
    predicates, reliabilities, weights, reportable = random_problem(
        3, n_predicates=2, shape=(3, 2), hidden=0.2
    )
    target = expected_agreement(predicates, reliabilities, weights, reportable)
    solution = ObservationProgram(predicates, reportable).solve(weights, target, slack)
    table, entropy = primal(predicates, weights, reportable, target, np.full(2, slack))
    found = np.exp(FeatureNoise(predicates, solution.reliabilities, reportable).log_probabilities)
    found = found.reshape(6, 6)[:, reportable.ravel()]
    np.testing.assert_allclose(found, table, atol=2e-5)
    assert abs(solution.entropy - entropy) < 1e-7


@pytest.mark.parametrize("slack", [0.0, 0.05])
def test_no_direction_leads_down_from_the_solution(slack):
    predicates, _, weights, reportable = random_problem(7, n_predicates=4, hidden=0.2)
    target = np.array([0.75, 0.62, 0.52, 0.7])
    beta = np.full(4, slack)
    solution = ObservationProgram(predicates, reportable).solve(weights, target, slack)
    here = dual(predicates, solution.logits, weights, reportable, target, beta)
    step = 1e-4 * np.eye(4)
    slopes = [
        (dual(predicates, solution.logits + sign * h, weights, reportable, target, beta) - here) / 1e-4
        for h in step
        for sign in (1, -1)
    ]
    # The largest curvature of log Z in one logit is a quarter.
    assert min(slopes) > -1e-7
    if not slack:
        assert max(np.abs(slopes)) < 0.25 * 1e-4
    assert solution.gap.max() < 1e-7


def test_slack_rules_small_logits_out():
    predicates, _, weights, _ = random_problem(2, n_predicates=3)
    program = ObservationProgram(predicates)
    at_random = expected_agreement(predicates, np.full(3, 0.5), weights)
    solution = program.solve(weights, at_random + 0.02, 0.03)
    np.testing.assert_allclose(solution.reliabilities, 0.5, atol=1e-6)
    assert program.solve(weights, at_random + 0.04, 0.03).reliabilities.max() > 0.51


@given(st.integers(0, 10_000))
def test_reliabilities_are_recovered_from_exact_agreement(seed):
    predicates, reliabilities, weights, reportable = random_problem(seed, hidden=0.3)
    told = unidentified_predicates(predicates, weights, reportable)
    target = expected_agreement(predicates, reliabilities, weights, reportable)
    solution = ObservationProgram(predicates, reportable).solve(weights, target)
    logits = np.log(reliabilities / (1 - reliabilities))
    np.testing.assert_allclose(solution.logits, told.identified @ logits, atol=1e-5)
    np.testing.assert_allclose(solution.agreement, target, atol=1e-8)
    # Whatever is not identified, the observation model is.
    found = FeatureNoise(predicates, solution.reliabilities, reportable).log_probabilities
    true = FeatureNoise(predicates, reliabilities, reportable).log_probabilities
    np.testing.assert_allclose(np.exp(found), np.exp(true), atol=1e-6)


def test_reliabilities_are_recovered_from_simulated_reports():
    predicates, reliabilities, weights, _ = random_problem(5, n_predicates=4, shape=(6, 4))
    rng = np.random.default_rng(0)
    table = np.exp(FeatureNoise(predicates, reliabilities).log_probabilities).reshape(24, 24)
    truths = rng.choice(24, 40_000, p=weights.ravel())
    reports = (rng.random((len(truths), 1)) > np.cumsum(table, 1)[truths]).sum(1)
    matches = reported_matches(predicates, *np.divmod(reports, 4), np.eye(24)[truths].reshape(-1, 6, 4))
    solution = ObservationProgram(predicates).solve(matches.weights, matches.agreement)
    # An agreement of 40 000 observations has a standard error of at most 0.0025.
    np.testing.assert_allclose(solution.reliabilities, reliabilities, atol=0.02)


def test_a_warm_start_ends_where_a_cold_one_does_in_fewer_iterations():
    predicates, reliabilities, weights, _ = random_problem(11, n_predicates=6, shape=(20, 4))
    target = expected_agreement(predicates, reliabilities, weights)
    program = ObservationProgram(predicates)
    before = program.solve(weights, target, 0.01)
    moved = np.clip(target + 0.004 * np.array([1, -1, 1, 1, -1, 1]), 0, 1)
    warm, cold = program.solve(weights, moved, 0.01, before.warm), program.solve(weights, moved, 0.01)
    np.testing.assert_allclose(warm.logits, cold.logits, atol=1e-6)
    assert warm.iterations < cold.iterations
    # A warm start from another pattern of slack is a start all the same.
    other = program.solve(weights, moved, 0.0, before.warm)
    np.testing.assert_allclose(other.agreement, moved, atol=1e-7)


def test_only_the_product_of_odds_of_equal_predicates_is_identified():
    predicates, reliabilities, weights, _ = random_problem(4, n_predicates=4, shape=(8, 3))
    predicates[2] = predicates[0]
    predicates[3] = ~predicates[0]
    told = unidentified_predicates(predicates)
    assert told.groups == ((0, 2, 3),)
    assert told.uninformative == ()
    assert told.describe(("A", "B", "C", "D")) == "only a combination of A, C, D is identified"
    target = expected_agreement(predicates, reliabilities, weights)
    solution = ObservationProgram(predicates).solve(weights, target)
    logits = np.log(reliabilities / (1 - reliabilities))
    np.testing.assert_allclose(solution.logits[[0, 2, 3]], logits[[0, 2, 3]].mean(), atol=1e-6)
    np.testing.assert_allclose(solution.logits[1], logits[1], atol=1e-6)
    # Contradicting targets of equal predicates count as their mean.
    split = target.copy()
    split[[0, 2, 3]] += [0.04, -0.03, -0.01]
    again = ObservationProgram(predicates).solve(weights, split)
    np.testing.assert_allclose(again.logits, solution.logits, atol=1e-6)


def test_a_constant_predicate_is_named_and_stays_at_one_half():
    predicates, reliabilities, weights, _ = random_problem(6, n_predicates=3)
    predicates[1] = True
    told = unidentified_predicates(predicates)
    assert told.uninformative == (1,)
    assert told.groups == ()
    assert "predicate 1 is the same for everything" in told.describe()
    target = expected_agreement(predicates, reliabilities, weights)
    solution = ObservationProgram(predicates).solve(weights, target)
    np.testing.assert_allclose(solution.reliabilities, [reliabilities[0], 0.5, reliabilities[2]], atol=1e-6)
    assert unidentified_predicates(predicates[[0, 2]]).describe() == ""


def test_predicates_that_differ_only_where_the_truth_never_is():
    # With three exclusive predicates, a truth in the first class determines only the first against the rest.
    predicates = np.stack([np.arange(3)[:, None] == j for j in range(3)])
    assert unidentified_predicates(predicates).groups == ()
    first = np.array([[1.0], [0.0], [0.0]])
    assert unidentified_predicates(predicates, first).groups == ((0, 1, 2),)
    target = expected_agreement(predicates, [0.9, 0.7, 0.7], first)
    solution = ObservationProgram(predicates).solve(first, target)
    found = np.exp(FeatureNoise(predicates, solution.reliabilities).log_probabilities)
    true = np.exp(FeatureNoise(predicates, [0.9, 0.7, 0.7]).log_probabilities)
    np.testing.assert_allclose(found[0, 0], true[0, 0], atol=1e-7)


def test_a_target_out_of_reach_ends_at_the_limit_and_says_by_how_much_it_misses():
    predicates, _, weights, _ = random_problem(8, n_predicates=2)
    program = ObservationProgram(predicates, limit=5.0)
    solution = program.solve(weights, [1.0, 0.0])
    np.testing.assert_allclose(solution.logits, [5, -5], atol=1e-5)
    missed = expected_agreement(predicates, 1 / (1 + np.exp([-5.0, 5.0])), weights) - [1, 0]
    np.testing.assert_allclose(solution.gap, np.abs(missed), atol=1e-6)


def test_classes_gather_pairs_with_equal_predicates():
    predicates, _, weights, reportable = random_problem(9, n_predicates=2, shape=(10, 4), hidden=0.5)
    classes = predicate_classes(predicates, reportable)
    assert len(classes.vectors) == 4
    np.testing.assert_array_equal(classes.vectors[classes.of_pair], np.moveaxis(predicates, 0, -1))
    assert classes.reportable.sum() == reportable.sum()
    np.testing.assert_allclose(classes.gather(5 * weights).sum(), 1)


def test_matches_of_reports_with_a_posterior():
    predicates, _, _, _ = random_problem(10)
    rng = np.random.default_rng(1)
    states, actions = rng.integers(5, size=7), rng.integers(3, size=7)
    posterior = rng.dirichlet(np.ones(15), 7).reshape(7, 5, 3)
    counted = reported_matches(predicates, states, actions, posterior)
    by_hand = np.zeros(3)
    for t, s, a in np.ndindex(7, 5, 3):
        by_hand += posterior[t, s, a] * (predicates[:, s, a] == predicates[:, states[t], actions[t]])
    np.testing.assert_allclose(counted.matches, by_hand)
    np.testing.assert_allclose(counted.agreement, by_hand / 7)
    observed = np.zeros((7, 5, 3))
    observed[np.arange(7), states, actions] = 1
    np.testing.assert_allclose(reported_matches(predicates, states, actions, observed).agreement, 1)


def test_labels_gather_and_match_by_their_values():
    predicates, _, weights, reportable = random_problem(9, n_predicates=2, shape=(10, 4), hidden=0.5)
    rng = np.random.default_rng(2)
    features = np.concatenate([predicates, np.broadcast_to(rng.integers(-1, 3, (10, 1)), (1, 10, 4))])
    classes = predicate_classes(features, reportable)
    np.testing.assert_array_equal(classes.vectors[classes.of_pair], np.moveaxis(features, 0, -1))
    assert len(classes.vectors) == len(np.unique(features.reshape(3, -1), axis=1).T)
    states, actions = rng.integers(10, size=6), rng.integers(4, size=6)
    posterior = rng.dirichlet(weights.ravel() + 0.1, 6).reshape(6, 10, 4)
    by_hand = np.zeros(3)
    for t, s, a in np.ndindex(6, 10, 4):
        by_hand += posterior[t, s, a] * (features[:, s, a] == features[:, states[t], actions[t]])
    np.testing.assert_allclose(reported_matches(features, states, actions, posterior).matches, by_hand)


def test_reliabilities_of_labels_are_recovered_from_exact_agreement():
    predicates, _, weights, reportable = random_problem(12, n_predicates=2, shape=(8, 4), hidden=0.2)
    features = np.concatenate([predicates, np.broadcast_to(np.arange(8)[:, None], (1, 8, 4))])
    p = np.array([0.7, 0.8, 0.995])
    target = expected_agreement(features, p, weights, reportable)
    solution = ObservationProgram(features, reportable).solve(weights, target)
    np.testing.assert_allclose(solution.reliabilities, p, atol=1e-6)


def test_bad_input_is_refused_in_its_own_terms():
    predicates, _, weights, _ = random_problem(1)
    program = ObservationProgram(predicates)
    target = np.full(3, 0.6)
    with pytest.raises(ValueError, match=r"\[S, A\] = \[5, 3\], got \[3, 5\]"):
        program.solve(weights.T, target)
    with pytest.raises(ValueError, match="not negative and not all zero"):
        program.solve(-weights, target)
    with pytest.raises(ValueError, match="3 predicates need as many targets"):
        program.solve(weights, target[:2])
    with pytest.raises(ValueError, match=r"targets of agreement .* predicate 1 is 1\.5"):
        program.solve(weights, [0.5, 1.5, 0.5])
    with pytest.raises(ValueError, match=r"slacks of agreement .* predicate 2 is nan"):
        program.solve(weights, target, [0, 0, np.nan])
    with pytest.raises(ValueError, match=r"predicates have shape \[J, S, A\]"):
        ObservationProgram(predicates[0])
    with pytest.raises(ValueError, match="true or false"):
        unidentified_predicates(0.5 * predicates)
    with pytest.raises(ValueError, match="limit of 3 logits"):
        ObservationProgram(predicates, limit=300.0)
    with pytest.raises(ValueError, match="report 1 is of the pair"):
        reported_matches(predicates, [0, 5], [0, 0], np.full((2, 5, 3), 1 / 15))
    with pytest.raises(ValueError, match="posterior of report 0 is no distribution"):
        reported_matches(predicates, [0], [0], np.full((1, 5, 3), 1.0))
    with pytest.raises(ValueError, match="as many actions"):
        reported_matches(predicates, [0], [0, 1], np.full((1, 5, 3), 1 / 15))
