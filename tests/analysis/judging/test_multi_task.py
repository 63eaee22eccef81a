from itertools import combinations, permutations

import jax
import numpy as np
import pytest

from i2rl.analysis import assignment_accuracy, expected_value_difference, match_components
from i2rl.analysis.judging.multi_task import adjusted_rand_index
from i2rl.domains import demonstrate_sorting, sorting_with_claiming
from i2rl.models import Demonstration


def _values(mdp, weights, policy):
    """Values of a deterministic policy by thousands of sweeps."""
    reward = np.asarray(mdp.features) @ weights
    successors, probabilities = np.asarray(mdp.successors), np.asarray(mdp.probabilities)
    rows, values = np.arange(mdp.n_states), np.zeros(mdp.n_states)
    for _ in range(4000):
        following = (probabilities[rows, policy] * values[successors[rows, policy]]).sum(1)
        values = reward[rows, policy] + float(mdp.discount) * following
    return values


def _best(mdp, weights):
    reward = np.asarray(mdp.features) @ weights
    available, values = np.asarray(mdp.available), np.zeros(mdp.n_states)
    for _ in range(4000):
        future = (np.asarray(mdp.probabilities) * values[np.asarray(mdp.successors)]).sum(-1)
        q = np.where(available, reward + float(mdp.discount) * future, -np.inf)
        values = q.max(1)
    return q.argmax(1)


def test_value_difference_is_the_definition_s():
    sorting = sorting_with_claiming()
    mdp, weights = sorting.mdp, sorting.weights
    mixed = demonstrate_sorting(jax.random.key(0), sorting, (2, 1, 2), steps=9)
    learned = np.stack([3 * weights[2], weights[0], np.eye(11)[6]])
    assignments = np.array([1, 0, 2, 0, 1])
    policies = [_best(mdp, w) for w in learned]
    total = 0.0
    for i, (behaviour, component) in enumerate(zip(mixed.labels, assignments, strict=True)):
        best = _values(mdp, weights[behaviour], _best(mdp, weights[behaviour]))
        here = _values(mdp, weights[behaviour], policies[component])
        total += sum(abs(best[s] - here[s]) for s in mixed.demonstration.state[i])
    found = expected_value_difference(mdp, weights, mixed.labels, learned, assignments, mixed.demonstration)
    assert found == pytest.approx(total / 5, rel=1e-9)
    assert found > 1


def test_rewards_of_the_same_behaviour_lose_exactly_nothing_and_padding_does_not_count():
    sorting = sorting_with_claiming()
    mixed = demonstrate_sorting(jax.random.key(1), sorting, (3, 2), steps=7)
    learned = np.stack([5 * sorting.weights[1], 0.1 * sorting.weights[0]])
    lost = expected_value_difference(
        sorting.mdp, sorting.weights, mixed.labels, learned, 1 - mixed.labels, mixed.demonstration
    )
    assert lost == 0.0
    wrong = mixed.labels
    plain = expected_value_difference(
        sorting.mdp, sorting.weights, mixed.labels, learned, wrong, mixed.demonstration
    )
    padded = mixed.demonstration.padded(8, 16)
    more = np.append(mixed.labels, [0, 0, 0])
    assert expected_value_difference(sorting.mdp, sorting.weights, more, learned, more, padded) == plain > 0


def test_value_difference_says_what_does_not_fit():
    sorting = sorting_with_claiming()
    mixed = demonstrate_sorting(jax.random.key(1), sorting, (1, 1), steps=3)
    given = [sorting.mdp, sorting.weights, mixed.labels, sorting.weights, mixed.labels, mixed.demonstration]
    hidden = mixed.demonstration._replace(kind=np.array([[1, 1, 1], [1, 2, 1]], np.int8))
    for place, value, complaint in (
        (3, sorting.weights[:, :4], r"learned weights must have shape \[ways, 11\]"),
        (3, np.full((2, 11), np.nan), "not a number"),
        (4, np.array([0, 3]), "between 0 and 2"),
        (2, np.array([0, 1, 1]), "each of 2 trajectories"),
        (5, hidden, "trajectory 1, step 1"),
        (5, Demonstration(*(np.asarray(x)[:0] for x in mixed.demonstration)), "each of 0"),
    ):
        with pytest.raises(ValueError, match=complaint):
            expected_value_difference(*[value if i == place else x for i, x in enumerate(given)])


def _partitions(n, seed=0, count=60):
    rng = np.random.default_rng(seed)
    return [
        (rng.integers(0, rng.integers(1, 5), n), rng.integers(0, rng.integers(1, 5), n)) for _ in range(count)
    ]


def test_accuracy_is_the_best_of_all_matchings():
    for labels, assignments in _partitions(9):
        names = list(range(5))
        best = max(
            sum(renamed[a] == b for a, b in zip(assignments, labels, strict=True))
            for renamed in permutations(names)
        )
        assert assignment_accuracy(labels, assignments) == pytest.approx(best / 9)
        matched = match_components(labels, assignments)
        assert len(set(matched.values())) == len(matched)
        hits = sum(matched.get(int(b)) == a for a, b in zip(assignments, labels, strict=True))
        assert hits == best


def test_adjusted_rand_index_counts_pairs():
    n = 8
    for labels, assignments in _partitions(n, seed=1):
        pairs = list(combinations(range(n), 2))
        same = np.array([labels[i] == labels[j] for i, j in pairs])
        also = np.array([assignments[i] == assignments[j] for i, j in pairs])
        both, only, other, neither = (
            int(np.sum(x)) for x in (same & also, same & ~also, ~same & also, ~same & ~also)
        )
        below = (both + only) * (only + neither) + (both + other) * (other + neither)
        expected = 1.0 if below == 0 else 2 * (both * neither - only * other) / below
        assert adjusted_rand_index(labels, assignments) == pytest.approx(expected, abs=1e-12)


def test_adjusted_rand_index_is_zero_on_average_over_renumbered_trajectories():
    labels, assignments = np.array([0, 0, 1, 1, 2]), np.array([0, 0, 0, 1, 1])
    values = [adjusted_rand_index(labels, assignments[list(order)]) for order in permutations(range(5))]
    assert np.mean(values) == pytest.approx(0, abs=1e-12)
    assert max(values) > 0.3


def test_a_way_without_a_behaviour_s_trajectories_is_not_that_behaviour():
    labels = np.array([0] * 6 + [1])
    assignments = np.array([0] * 5 + [1] + [0])
    assert match_components(labels, assignments) == {0: 0}


def test_partitions_must_fit():
    for labels, assignments in (([], []), ([0, 1], [0]), ([[0]], [[0]])):
        with pytest.raises(ValueError, match="one entry a trajectory"):
            adjusted_rand_index(np.array(labels), np.array(assignments))
