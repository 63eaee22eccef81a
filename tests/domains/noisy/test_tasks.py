"""The noise of the noisy tasks against its statement, and what it injects against the model it says it is."""

from functools import cache
from itertools import product

import jax
import numpy as np
import pytest
from scipy import stats

from i2rl.domains import sorting_with_claiming
from i2rl.domains.noisy.swap_noise import SwapNoise
from i2rl.domains.noisy.tasks import (
    NoisyTask,
    agreement_probabilities,
    demonstrate_noisy,
    feature_noise,
    noisy_patrol,
    noisy_sorting,
)
from i2rl.domains.patrol.process import instance
from i2rl.models import FeatureNoise, Visibility, log_evidence
from i2rl.models.observation.demonstration import HIDDEN, SEEN

INSPECT, TO_CONVEYOR, TO_BIN, PICK, CLAIM = range(5)
FORWARD, LEFT, RIGHT, STOP = range(4)
# Sessions that frequencies are taken from: one number, so that little is compiled.
MANY = 3000

sorting_task, patrol_task = cache(noisy_sorting), cache(noisy_patrol)
TASKS = {"sorting": sorting_task, "patrol": patrol_task}


def states_22() -> list[str]:
    """List the 22 states as digits (onion, prediction, hand), in the order of the process."""
    held = [f"3{p}3" for p in range(3)] + [f"1{p}1" for p in range(3)]
    return [f"0{p}{h}" for p in range(3) for h in range(4)] + held + [f"22{h}" for h in range(4)]


def stated_sorting(prediction: float, place: float) -> np.ndarray:
    """O(o | g) as [S, A, S, A], written down pair by pair from the statement of the noise."""
    states = states_22()
    table = np.zeros((22, 7, 22, 7))
    for (s, name), a in product(enumerate(states), range(7)):
        seen_states = {s: 1.0}
        if name[1] != "2":
            other = states.index(name[0] + {"0": "1", "1": "0"}[name[1]] + name[2])
            seen_states = {s: 1 - prediction, other: prediction}
        swapped = {TO_CONVEYOR: TO_BIN, TO_BIN: TO_CONVEYOR}.get(a)
        seen_actions = {a: 1.0} if swapped is None else {a: 1 - place, swapped: place}
        for (t, p), (b, q) in product(seen_states.items(), seen_actions.items()):
            table[s, a, t, b] += p * q
    return table


def table_of(noise: SwapNoise | FeatureNoise) -> np.ndarray:
    return np.exp(np.asarray(noise.noise.log_probabilities))


# -- predicates ---------------------------------------------------------------------------------------


def test_sorting_predicates_say_what_their_names_say() -> None:
    task = sorting_task()
    assert task.predicates.shape == (8, 22, 7)
    expected = np.array(
        [
            [
                [
                    s[1] == "0",
                    a in (TO_CONVEYOR, TO_BIN, PICK),
                    s[0] == "0",
                    s[2] == "1" and a in (TO_CONVEYOR, TO_BIN, PICK),
                    a == TO_BIN,
                    a == TO_BIN,
                    a == TO_CONVEYOR,
                    a == TO_CONVEYOR,
                ]
                for a in range(7)
            ]
            for s in states_22()
        ]
    ).transpose(2, 0, 1)
    np.testing.assert_array_equal(task.predicates, expected)


def test_exactly_two_sorting_predicates_duplicate_others() -> None:
    psi = sorting_task().predicates.reshape(8, -1)
    same = {(i, j) for i in range(8) for j in range(i) if (psi[i] == psi[j]).all()}
    assert same == {(5, 4), (7, 6)}


def test_patrol_predicates_say_what_their_names_say_and_none_is_constant() -> None:
    task, states = patrol_task(), instance(2).states
    expected = np.array(
        [[[a == FORWARD, a == LEFT, state.row == 0, a == RIGHT] for a in range(4)] for state in states]
    ).transpose(2, 0, 1)
    np.testing.assert_array_equal(task.predicates, expected)
    among_the_expert = (task.predicates * task.pair_distribution("natural", 5)).sum((1, 2))
    assert ((among_the_expert > 0.01) & (among_the_expert < 0.99)).all()
    # The other meaning of "y is 0".
    assert not any(state.column == 0 for state in states)


@pytest.mark.parametrize("name", TASKS)
def test_labels_are_untouched_by_the_noise_and_features_hold_them(name: str) -> None:
    task = TASKS[name]()
    np.testing.assert_allclose(
        agreement_probabilities(task.noise, task.labels, np.ones(task.labels.shape[1:])), 1
    )
    n_predicates = len(task.predicates)
    assert len(task.feature_names) == len(task.features) == n_predicates + len(task.labels)
    np.testing.assert_array_equal(task.features[:n_predicates], task.predicates)
    np.testing.assert_array_equal(task.features[n_predicates:], task.labels)


def test_labels_say_where_things_are() -> None:
    onion, hand = sorting_task().labels
    digits = np.array([[int(d) for d in s] for s in states_22()])
    np.testing.assert_array_equal(onion, np.tile(digits[:, [0]], 7))
    np.testing.assert_array_equal(hand, np.tile(digits[:, [2]], 7))
    np.testing.assert_array_equal(patrol_task().labels[0], np.indices((124, 4))[0])


# -- noise --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [(0.3, 0.3), (0.1, 0.45), (0.0, 1.0)])
def test_sorting_noise_is_the_stated_confusion(levels: tuple[float, float]) -> None:
    np.testing.assert_allclose(table_of(noisy_sorting(*levels).noise), stated_sorting(*levels), atol=1e-12)


def test_patrol_noise_is_the_stated_confusion() -> None:
    actions = np.eye(4)
    actions[np.ix_([FORWARD, RIGHT], [FORWARD, RIGHT])] = [[0.7, 0.3], [0.3, 0.7]]
    expected = np.einsum("so,ap->saop", np.eye(124), actions)
    np.testing.assert_allclose(table_of(patrol_task().noise), expected, atol=1e-12)


@pytest.mark.parametrize("name", TASKS)
def test_rows_of_every_observation_model_sum_to_one(name: str) -> None:
    task = TASKS[name]()
    for noise in (task.noise, feature_noise(task)):
        np.testing.assert_allclose(table_of(noise).sum((2, 3)), 1, atol=1e-10)


def test_a_prediction_whose_opposite_is_no_state_is_reported_rightly() -> None:
    sorting = sorting_with_claiming()
    factors = [tuple(map(int, row)) for row in sorting.factors]
    confused = np.asarray(noisy_sorting(sorting=sorting).noise.acts)[0].any(1)
    for (onion, prediction, hand, listed), acts in zip(factors, confused, strict=True):
        opposite = (onion, 1 - prediction, hand, listed)
        assert acts == (prediction != 2 and opposite in factors)
    assert not confused[factors.index((0, 0, 0, 1))]
    assert confused[factors.index((1, 0, 1, 2))]


def test_noise_composes_with_a_view_and_passes_through_compilation() -> None:
    task = sorting_task()
    visibility = Visibility(np.arange(22) % 3 != 0)
    data = demonstrate_noisy(jax.random.key(0), task, sessions=10, visibility=visibility)
    plain = log_evidence(visibility * task.noise, data.mdp, data.seen)
    np.testing.assert_array_equal(log_evidence(task.noise * visibility, data.mdp, data.seen), plain)
    compiled = jax.jit(lambda noise: noise.noise.log_probabilities)(task.noise)
    np.testing.assert_allclose(np.exp(compiled), table_of(task.noise), atol=1e-12)


@pytest.mark.parametrize("name", TASKS)
def test_feature_noise_doubts_only_what_the_noise_changes(name: str) -> None:
    doubted = np.flatnonzero(np.asarray(feature_noise(TASKS[name](), 0.6, 0.95).reliabilities) < 0.9)
    assert doubted.tolist() == {"sorting": [0, 4, 5, 6, 7], "patrol": [0, 3]}[name]


# -- agreement ----------------------------------------------------------------------------------------


def test_agreement_probabilities_are_those_of_enumeration() -> None:
    task = sorting_task()
    weights = np.random.default_rng(0).random((22, 7))
    for noise in (task.noise, feature_noise(task)):
        table, psi = table_of(noise), task.features
        expected = [
            sum(
                weights[s, a] * table[s, a, t, b] * (psi[j, s, a] == psi[j, t, b])
                for s, a, t, b in product(range(22), range(7), range(22), range(7))
                if table[s, a, t, b] > 1e-12
            )
            / weights.sum()
            for j in (0, 3, 4, 8)
        ]
        np.testing.assert_allclose(
            agreement_probabilities(noise, psi, weights)[[0, 3, 4, 8]], expected, atol=1e-10
        )


def test_agreement_where_the_noise_acts_is_as_stated() -> None:
    """0.7 for a known prediction, 0.7 for the four features of a place among releases, 1 for the rest."""
    task = sorting_task()
    known = np.array([s[1] != "2" for s in states_22()])[:, None] * np.ones(7)
    releases = np.ones((22, 1)) * np.isin(np.arange(7), (TO_CONVEYOR, TO_BIN))
    among = [
        agreement_probabilities(task.noise, task.predicates, w) for w in (known, releases, known * releases)
    ]
    np.testing.assert_allclose(among[0][0], 0.7)
    np.testing.assert_allclose(among[1][4:], 0.7)
    np.testing.assert_allclose(among[2], [0.7, 1, 1, 1, 0.7, 0.7, 0.7, 0.7])


def test_agreement_of_the_patrol_is_one_less_the_noise_on_moves_and_right_turns() -> None:
    task = patrol_task()
    weights = task.pair_distribution("natural", 4)
    moves = weights[:, [FORWARD, RIGHT]].sum()
    expected = [1 - 0.3 * moves, 1, 1, 1 - 0.3 * moves]
    np.testing.assert_allclose(agreement_probabilities(task.noise, task.predicates, weights), expected)


# -- what is injected ---------------------------------------------------------------------------------


def exact_report_counts(task: NoisyTask, noise: SwapNoise | FeatureNoise, truth: np.ndarray) -> np.ndarray:
    """Compute the expected observations [S*A], given how often each truth [S*A] occurred."""
    size = truth.size
    return truth @ table_of(noise).reshape(size, size)


def flat(demonstration: object, n_actions: int) -> np.ndarray:
    return (np.asarray(demonstration.state) * n_actions + np.asarray(demonstration.action)).reshape(-1)


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("of", ["swaps", "features"])
def test_injected_errors_occur_as_often_as_the_model_says(name: str, of: str) -> None:
    task = TASKS[name]()
    noise = task.noise if of == "swaps" else feature_noise(task)
    data = demonstrate_noisy(jax.random.key(1), task, noise, sessions=MANY)
    n_actions = task.mdp.n_actions
    g, o = flat(data.truth, n_actions), flat(data.seen, n_actions)
    size = task.mdp.n_states * n_actions
    # Given the truths, observations are independent: for every frequent truth, a chi-square of its
    # observations.
    table = table_of(noise).reshape(size, size)
    assert (table[g, o] > 0).all()
    statistic, freedom = 0.0, 0
    for truth, n in zip(*np.unique(g, return_counts=True), strict=True):
        expected = n * table[truth]
        common = expected > 5
        observed = np.bincount(o[g == truth], minlength=size)
        seen = [*observed[common], observed[~common].sum()]
        due = [*expected[common], expected[~common].sum()]
        cells = np.array(due) > 1e-9
        if cells.sum() > 1 and min(np.array(due)[cells]) > 5:
            statistic += float(np.sum((np.array(seen) - due)[cells] ** 2 / np.array(due)[cells]))
            freedom += int(cells.sum()) - 1
    assert freedom >= 5
    assert 0.001 < stats.chi2.sf(statistic, freedom) < 0.999


@pytest.mark.parametrize("starts", ["all", "natural"])
@pytest.mark.parametrize("name", TASKS)
def test_predicates_agree_as_often_as_calculated(name: str, starts: str) -> None:
    task = TASKS[name]()
    data = demonstrate_noisy(jax.random.key(2), task, sessions=MANY, starts=starts)
    n_actions = task.mdp.n_actions
    psi = task.predicates.reshape(len(task.predicates), -1)
    agree = psi[:, flat(data.truth, n_actions)] == psi[:, flat(data.seen, n_actions)]
    expected = agreement_probabilities(task.noise, task.predicates, task.pair_distribution(starts))
    # Of one trajectory's three steps, at worst all agree together.
    error = np.sqrt(3 * expected * (1 - expected) / agree.shape[1])
    assert (np.abs(agree.mean(1) - expected) <= 3.5 * error + 1e-12).all()


@pytest.mark.parametrize("starts", ["all", "natural"])
def test_experts_visit_pairs_as_calculated(starts: str) -> None:
    task = sorting_task()
    data = demonstrate_noisy(jax.random.key(3), task, sessions=MANY, starts=starts)
    visits = np.bincount(flat(data.truth, 7), minlength=22 * 7) / data.truth.state.size
    expected = task.pair_distribution(starts).reshape(-1)
    error = np.sqrt(3 * expected * (1 - expected) / data.truth.state.size)
    assert (np.abs(visits - expected) <= 4 * error + 1e-12).all()
    first = np.bincount(data.truth.state[:, 0], minlength=22)
    allowed = [starts == "all" or s[:2] == "02" for s in states_22()]
    np.testing.assert_array_equal(first > 0, allowed)


def test_the_patrol_naturally_starts_where_it_is_in_the_long_run() -> None:
    task = patrol_task()
    one, many = (task.pair_distribution("natural", steps).sum(1) for steps in (1, 50))
    np.testing.assert_allclose(one, many, atol=1e-9)
    assert (one > 0).sum() == instance(2).loop


# -- scores -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("of", ["swaps", "features"])
@pytest.mark.parametrize("name", TASKS)
def test_calibrated_scores_are_calibrated(name: str, of: str) -> None:
    task = TASKS[name]()
    noise = task.noise if of == "swaps" else feature_noise(task)
    data = demonstrate_noisy(jax.random.key(4), task, noise, sessions=MANY, scores="calibrated")
    n_actions = task.mdp.n_actions
    g, o = flat(data.truth, n_actions), flat(data.seen, n_actions)
    psi = task.predicates.reshape(len(task.predicates), -1)
    right = (g == o) if of == "swaps" else (psi[:, g] == psi[:, o]).all(0)
    score = np.asarray(data.seen.score).reshape(-1)
    assert ((score >= 0) & (score <= 1)).all()
    edges = np.linspace(0, 1, 11)
    bins = np.clip(np.digitize(score, edges) - 1, 0, 9)
    filled = 0
    for k in range(10):
        inside = bins == k
        if inside.sum() < 50:
            continue
        filled += 1
        # The number right is a sum of independent coins with the scores as probabilities.
        spread = np.sqrt((score * (1 - score))[inside].sum())
        assert abs(right[inside].sum() - score[inside].sum()) <= 4 * spread + 1e-9
    assert filled >= 8


def test_scores_of_swaps_have_the_distribution_of_the_clarity() -> None:
    """Check the score of a pair with one swap: over right and wrong observations together it has the stated
    Beta.
    """
    task = patrol_task()
    data = demonstrate_noisy(jax.random.key(5), task, sessions=MANY, scores="calibrated", concentration=6.0)
    action, score = data.truth.action.reshape(-1), np.asarray(data.seen.score).reshape(-1)
    swapped = np.isin(action, (FORWARD, RIGHT))
    assert stats.kstest(score[swapped], stats.beta(0.7 * 6, 0.3 * 6).cdf).pvalue > 0.001
    np.testing.assert_array_equal(score[~swapped], 1)


def test_two_clarities_multiply() -> None:
    task = sorting_task()
    data = demonstrate_noisy(jax.random.key(6), task, sessions=MANY, scores="calibrated")
    both = np.asarray(task.noise.acts).reshape(2, -1).all(0)[flat(data.truth, 7)]
    score = np.asarray(data.seen.score).reshape(-1)[both]
    u = np.random.default_rng(0).beta(0.7 * 4, 0.3 * 4, (2, 20000)).prod(0)
    assert both.sum() > 500
    assert stats.ks_2samp(score, u).pvalue > 0.001


def test_scores_of_a_plain_observation_model_are_about_the_pair() -> None:
    task = sorting_task()
    data = demonstrate_noisy(jax.random.key(10), task, task.noise.noise, sessions=MANY, scores="calibrated")
    right, score = flat(data.truth, 7) == flat(data.seen, 7), np.asarray(data.seen.score).reshape(-1)
    never_mistaken = ~np.asarray(task.noise.acts).reshape(2, -1).any(0)[flat(data.truth, 7)]
    np.testing.assert_allclose(score[never_mistaken], 1)
    for low in (0.0, 0.4, 0.7):
        inside = ~never_mistaken & (score >= low) & (score < low + 0.3)
        spread = np.sqrt((score * (1 - score))[inside].sum())
        assert inside.sum() > 200
        assert abs(right[inside].sum() - score[inside].sum()) <= 4 * spread


def test_noise_that_is_certain_has_certain_scores() -> None:
    task = noisy_sorting(0.0, 1.0)
    data = demonstrate_noisy(jax.random.key(7), task, sessions=10, scores="calibrated")
    right = flat(data.truth, 7) == flat(data.seen, 7)
    np.testing.assert_array_equal(np.asarray(data.seen.score).reshape(-1), right.astype(float))
    assert not right.all()


@pytest.mark.parametrize("of", ["swaps", "features"])
def test_product_scores_are_equation_6_5(of: str) -> None:
    task = sorting_task()
    noise = task.noise if of == "swaps" else feature_noise(task)
    data = demonstrate_noisy(jax.random.key(8), task, noise, sessions=10, scores="product")
    p = (
        agreement_probabilities(noise, task.predicates, task.pair_distribution())
        if of == "swaps"
        else np.asarray(noise.reliabilities)
    )
    for i, t in product(range(20), range(3)):
        g = (data.truth.state[i, t], data.truth.action[i, t])
        o = (data.seen.state[i, t], data.seen.action[i, t])
        agree = task.predicates[:, *g] == task.predicates[:, *o]
        expected = np.prod([p[j] if agree[j] else 1 - p[j] for j in range(8)])
        np.testing.assert_allclose(data.seen.score[i, t], expected)


def test_sessions_scores_and_views_of_a_demonstration() -> None:
    task = patrol_task()
    visibility = instance(2).visibility(30)
    data = demonstrate_noisy(
        jax.random.key(9),
        task,
        sessions=4,
        trajectories=3,
        steps=5,
        visibility=visibility,
        scores="calibrated",
        starts="natural",
    )
    assert [part.kind.shape for part in data.seen.sessions(3)] == [(3, 5)] * 4
    in_view = np.asarray(visibility.in_view)[data.truth.state] == 1
    np.testing.assert_array_equal(data.seen.kind, np.where(in_view, SEEN, HIDDEN))
    np.testing.assert_array_equal(np.isnan(data.seen.score), ~in_view)
    unscored = demonstrate_noisy(
        jax.random.key(9), task, sessions=4, trajectories=3, steps=5, starts="natural"
    )
    assert np.isnan(unscored.seen.score).all()
    np.testing.assert_array_equal(unscored.truth.state, data.truth.state)


# -- bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [-0.1, 1.2, np.nan])
def test_noise_outside_zero_and_one_is_refused(level: float) -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\].*swap 1"):
        noisy_sorting(place_noise=level)
    with pytest.raises(ValueError, match=r"\[0, 1\].*swap 0"):
        noisy_patrol(level)


@pytest.mark.parametrize(
    ("swaps", "message"),
    [
        (np.array([[[1, 2, 0]]]), "takes pair 0 for 1"),
        (np.array([[[1, 0, 2]], [[0, 2, 1]]]), "do not commute"),
        (np.array([[[1, 0, 2]], [[1, 0, 2]]]), "same other pair"),
        (np.array([[[0, 1, 3]]]), "0 to 2"),
        (np.array([0, 1, 2]), r"\[M, S, A\]"),
        (np.array([[[0.0, 1.0, 2.0]]]), "whole numbers"),
    ],
)
def test_swaps_that_are_none_are_refused(swaps: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SwapNoise(swaps, np.full(len(swaps), 0.1))


def test_as_many_noises_as_swaps() -> None:
    with pytest.raises(ValueError, match="1 swaps need as many"):
        SwapNoise(np.array([[[1, 0, 2]]]), np.array([0.1, 0.2]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scores": "exact"}, "'calibrated', 'product' or None, got 'exact'"),
        ({"starts": "here"}, "'all' or 'natural', got 'here'"),
        ({"steps": 0}, "at least 1, got 2, 2 and 0"),
        ({"concentration": 0.0, "scores": "calibrated"}, "must be positive, got 0.0"),
        ({"reliabilities": np.full(3, 0.5), "scores": "product"}, "8 probabilities"),
        ({"reliabilities": np.full(8, 1.5), "scores": "product"}, "8 probabilities"),
        ({"noise": Visibility(np.ones(22))}, "no observation model"),
        ({"visibility": Visibility(np.ones(5))}, "22 states"),
    ],
)
def test_demonstrations_of_nothing_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        demonstrate_noisy(jax.random.key(0), sorting_task(), **{"sessions": 2} | options)


def test_noise_of_another_task_is_refused() -> None:
    with pytest.raises(ValueError, match="22 states and 7 actions, but the MDP has 124 and 4"):
        demonstrate_noisy(jax.random.key(0), patrol_task(), sorting_task().noise, sessions=1)


def test_weights_that_are_no_distribution_are_refused() -> None:
    task = sorting_task()
    wrong = {"not all zero": np.zeros((22, 7)), "non-negative": -np.ones((22, 7)), "7, 22": np.ones((7, 22))}
    for message, weights in wrong.items():
        with pytest.raises(ValueError, match=message):
            agreement_probabilities(task.noise, task.predicates, weights)
    with pytest.raises(ValueError, match="at least one step"):
        task.pair_distribution(steps=0)
