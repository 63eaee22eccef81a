"""The observation program as printed: closed forms, an independent optimiser, and what is wrong with it."""

import numpy as np
import pytest
from scipy import optimize

from i2rl.inference.programs.printed.observation import solve_printed_program
from i2rl.models import FeatureNoise


def points(states, actions, shape=(4, 2)):
    table = np.zeros((len(states), *shape))
    table[np.arange(len(states)), states, actions] = 1
    return table


@pytest.fixture(scope="module")
def predicates():
    return (np.arange(8) // np.array([[1], [2], [4]]) % 2).astype(bool).reshape(3, 4, 2)


def test_reports_taken_for_truths_make_all_reliabilities_equal(predicates):
    states, actions = np.array([0, 1, 3]), np.array([1, 0, 1])
    solution = solve_printed_program(predicates, states, actions, np.full(3, 0.4), points(states, actions))
    # The product of three is 0.4, and entropy prefers equals; the penalty leaves it a little to gain.
    np.testing.assert_allclose(solution.reliabilities, 0.4 ** (1 / 3), atol=1e-3)
    assert solution.residual < 1e-3


def test_with_one_predicate_the_answer_is_the_least_squares_one():
    predicate = np.array([[[0, 0], [0, 0], [0, 1], [1, 1]]], bool)
    rng = np.random.default_rng(0)
    states, actions, scores = rng.integers(4, size=200), rng.integers(2, size=200), rng.uniform(0.6, 1, 200)
    candidates = np.full((200, 4, 2), 1 / 8)
    solution = solve_printed_program(predicate, states, actions, scores, candidates)
    share = np.where(predicate[0, states, actions], 3 / 8, 5 / 8)
    least_squares = (share * scores + (1 - share) * (1 - scores)).mean()
    np.testing.assert_allclose(solution.reliabilities, least_squares, atol=1e-5)


def test_an_independent_optimiser_does_no_better(predicates):
    rng = np.random.default_rng(3)
    states, actions, scores = rng.integers(4, size=9), rng.integers(2, size=9), rng.uniform(0.1, 0.9, 9)
    candidates = rng.dirichlet(np.full(8, 0.3), 9).reshape(9, 4, 2)
    solution = solve_printed_program(predicates, states, actions, scores, candidates)

    def misses(p):
        total = 0.0
        for t, s, a in np.ndindex(9, 4, 2):
            agree = predicates[:, s, a] == predicates[:, states[t], actions[t]]
            total += candidates[t, s, a] * (np.where(agree, p, 1 - p).prod() - scores[t]) ** 2
        return total

    def objective(p):
        return 1e4 / 2 * misses(p) + (p * np.log(p) + (1 - p) * np.log(1 - p)).sum()

    other = optimize.minimize(
        objective, solution.reliabilities, method="Nelder-Mead", bounds=[(0.001, 0.999)] * 3
    )
    assert objective(solution.reliabilities) <= other.fun + 1e-5
    assert abs(solution.residual - np.sqrt(misses(solution.reliabilities) / 9)) < 1e-9


def test_every_pair_as_a_candidate_teaches_nothing(predicates):
    p = np.array([0.9, 0.8, 0.95])
    table = np.exp(FeatureNoise(predicates, p).log_probabilities).reshape(8, 8)
    rng = np.random.default_rng(1)
    truths = rng.integers(8, size=300)
    reports = (rng.random((300, 1)) > np.cumsum(table, 1)[truths]).sum(1)
    scores = table[truths, reports]
    states, actions = np.divmod(reports, 2)

    true = points(*np.divmod(truths, 2))
    oracle = solve_printed_program(predicates, states, actions, scores, true)
    everything = solve_printed_program(predicates, states, actions, scores, np.full((300, 4, 2), 1 / 8))
    np.testing.assert_allclose(oracle.reliabilities, p, atol=1e-4)
    # Products over all candidates sum to one whatever the reliabilities: only their squares are left.
    np.testing.assert_allclose(everything.reliabilities, 0.5, atol=1e-6)
    assert everything.residual > 0.1 > 0.001 > oracle.residual


def test_bad_input_is_refused_in_its_own_terms(predicates):
    states, actions = np.array([0, 1]), np.array([1, 0])
    at = points(states, actions)
    with pytest.raises(ValueError, match="that of report 1 is nan"):
        solve_printed_program(predicates, states, actions, [0.5, np.nan], at)
    with pytest.raises(ValueError, match="2 reports need as many scores"):
        solve_printed_program(predicates, states, actions, [0.5], at)
    with pytest.raises(ValueError, match="report 0 is no distribution"):
        solve_printed_program(predicates, states, actions, [0.5, 0.5], 2 * at)
