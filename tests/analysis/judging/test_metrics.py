from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.analysis.judging import metrics
from i2rl.domains.patrol.process import break_ties, instance
from i2rl.models import Demonstration, TabularMDP, Visibility, reward_of, soft_plan
from i2rl.models.observation.demonstration import PAD
from i2rl.models.observation.evidence import log_evidence

LEFT, RIGHT, STAY = range(3)


def corridor(available: np.ndarray | None = None) -> TabularMDP:
    """Three cells in a row; features: standing at the left end, standing at the right end."""
    successors = np.array([[max(s - 1, 0), min(s + 1, 2), s] for s in range(3)])[..., None]
    features = np.zeros((3, 3, 2))
    features[0, :, 0] = features[2, :, 1] = 1
    return TabularMDP.from_successors(
        successors, np.ones(successors.shape), features, discount=0.5, available=available
    )


def test_a_reward_that_prescribes_the_opposite_scores_by_hand() -> None:
    # Expert goes left: optimal {left, stay}, {left}, {left}. Learner goes right: right, right, and of its
    # tie {right, stay} in the last cell the first, right. No match anywhere.
    result = metrics.evaluate(corridor(), [1.0, 0.0], [0.0, 1.0])
    assert float(result.accuracy.overall) == 0.0
    # V* = (2, 1, 1/2); going right collects 1 in the first cell, once: V = (1, 0, 0).
    assert float(result.error.absolute) == pytest.approx(1 + 1 + 0.5)
    assert float(result.error.relative) == pytest.approx(2.5 / 3.5)
    assert float(result.value) == pytest.approx(1 / 3)
    assert float(result.best_value) == pytest.approx(3.5 / 3)


def test_every_optimal_action_of_the_expert_counts() -> None:
    mdp = corridor()
    optimal = metrics.optimal_actions(mdp, [1.0, 0.0])
    assert np.asarray(optimal)[0].tolist() == [True, False, True]
    for first in (LEFT, STAY):
        policy = jnp.eye(3)[jnp.array([first, LEFT, LEFT])]
        assert float(metrics.policy_accuracy(mdp, optimal, policy).overall) == 1.0
    assert float(metrics.policy_accuracy(mdp, optimal, jnp.full((3, 3), 1 / 3)).overall) == pytest.approx(
        4 / 9
    )


def test_a_reward_that_says_nothing_is_not_credited_with_every_action() -> None:
    mdp = corridor()
    np.testing.assert_array_equal(metrics.greedy_policy(mdp, [0.0, 0.0]).argmax(1), [LEFT, LEFT, LEFT])
    assert float(metrics.learned_behavior_accuracy(mdp, [0.0, 1.0], [0.0, 0.0]).overall) == 0.0


def test_ties_can_be_broken_as_the_patrols_do() -> None:
    patrol = instance(2)
    optimal = metrics.optimal_actions(patrol.mdp, patrol.weights)
    nothing = np.ones(optimal.shape, bool)
    by_order = metrics.policy_accuracy(patrol.mdp, optimal, metrics.greedy_policy(patrol.mdp, np.zeros(6)))
    by_patrol = metrics.policy_accuracy(patrol.mdp, optimal, jnp.asarray(break_ties(nothing)))
    # Both take "forward" everywhere: share of states where that is optimal.
    assert float(by_order.overall) == float(by_patrol.overall) == float(np.asarray(optimal)[:, 0].mean())


def test_choice_states_leave_out_those_with_one_action() -> None:
    available = np.ones((3, 3), bool)
    available[0] = [False, True, False]
    mdp = corridor(available)
    # Cell 0 can only move right, so it always matches; in the others going right is wrong for this expert.
    result = metrics.learned_behavior_accuracy(mdp, [1.0, 0.0], [0.0, 1.0])
    assert float(result.overall) == pytest.approx(1 / 3)
    assert float(result.choice) == 0.0


def test_choice_accuracy_equals_overall_where_all_states_are_choices_and_is_nan_where_none_is() -> None:
    mdp = corridor()
    result = metrics.learned_behavior_accuracy(mdp, [1.0, 0.0], [1.0, 0.9])
    assert float(result.choice) == float(result.overall)
    forced = corridor(np.eye(3, dtype=bool)[[1, 1, 1]])
    result = metrics.learned_behavior_accuracy(forced, [1.0, 0.0], [0.0, 1.0])
    assert float(result.overall) == 1.0
    assert np.isnan(result.choice)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_true_weights_are_perfect_at_any_scale(number: int) -> None:
    patrol = instance(number)
    for scale in (1.0, 1e-3, 400.0):
        result = metrics.evaluate(patrol.mdp, patrol.weights, scale * patrol.weights)
        assert float(result.accuracy.overall) == float(result.accuracy.choice) == 1.0
        assert float(result.error.relative) < 1e-10
        assert float(result.value) == pytest.approx(float(result.best_value), rel=1e-10)


@given(seed=st.integers(0, 10_000), scale=st.floats(1e-3, 1e3))
def test_scaling_rewards_scales_only_the_error(random_mdp, seed: int, scale: float) -> None:
    mdp = random_mdp(seed % 7, masked=True)
    rng = np.random.default_rng(seed)
    truth, learned = rng.normal(size=(2, mdp.n_features))
    plain = metrics.evaluate(mdp, truth, learned)
    larger = metrics.evaluate(mdp, scale * truth, scale * learned)
    assert float(larger.accuracy.overall) == float(plain.accuracy.overall)
    np.testing.assert_allclose(larger.error.relative, plain.error.relative, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        larger.error.absolute, scale * plain.error.absolute, rtol=1e-6, atol=1e-9 * scale
    )
    assert 0 <= float(plain.accuracy.overall) <= 1
    assert float(plain.value) <= float(plain.best_value) + 1e-9


def test_error_agrees_with_summing_rewards_along_the_chain(random_mdp, dense_transitions) -> None:
    mdp = random_mdp(3)
    truth, learned = np.array([1.0, -0.4]), np.array([-0.2, 1.0])
    policy = np.asarray(metrics.greedy_policy(mdp, learned))
    moves, reward = dense_transitions(mdp), np.asarray(mdp.features) @ truth
    best, values = np.zeros(mdp.n_states), np.zeros(mdp.n_states)
    for _ in range(600):
        best = (reward + 0.9 * moves @ best).max(1)
        values = (policy * (reward + 0.9 * moves @ values)).sum(1)
    loss = np.abs(best - values).sum()
    assert loss > 0
    result = metrics.inverse_learning_error(mdp, truth, learned)
    assert float(result.absolute) == pytest.approx(loss, rel=1e-9)
    value = metrics.evaluate(mdp, truth, learned).value
    assert float(value) == pytest.approx(np.asarray(mdp.initial) @ values)


def test_relative_error_is_undefined_without_reward() -> None:
    result = metrics.inverse_learning_error(corridor(), [0.0, 0.0], [1.0, 0.0])
    assert float(result.absolute) == 0.0
    assert np.isnan(result.relative)


def test_chance_is_the_accuracy_of_weights_drawn_at_random() -> None:
    key, mdp = jax.random.key(4), corridor()
    found = metrics.chance_accuracy(key, mdp, jnp.array([1.0, 0.0]), 40)
    drawn = np.asarray(jax.random.uniform(key, (40, 2), float, -0.99, 0.99))
    alone = [float(metrics.evaluate(mdp, [1.0, 0.0], list(w)).accuracy.overall) for w in drawn[:8]]
    np.testing.assert_allclose(found[:8], alone)
    # Weights for the left end and against the right one give the expert's actions; the opposite weights do
    # not.
    assert (found[(drawn[:, 0] > 0) & (drawn[:, 1] < 0)] == 1).all()
    assert (found[(drawn[:, 0] < 0) & (drawn[:, 1] > 0)] == 0).all()
    assert found.min() < found.max()


def test_evaluation_maps_over_many_weights() -> None:
    mdp = corridor()
    weights = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.9]])
    mapped = jax.vmap(partial(metrics.evaluate, mdp, [1.0, 0.0]))(weights)
    at_once = metrics.evaluate(mdp, [1.0, 0.0], weights[None])
    for i, one in enumerate(weights):
        single = metrics.evaluate(mdp, [1.0, 0.0], one)
        jax.tree.map(lambda many, one, i=i: np.testing.assert_allclose(many[i], one), mapped, single)
        jax.tree.map(lambda many, one, i=i: np.testing.assert_allclose(many[0, i], one), at_once, single)


def test_log_likelihood_is_that_of_summing_over_all_completions(
    random_mdp, enumerate_completions, imperfect_demonstration
) -> None:
    mdp = random_mdp(1)
    sensor = Visibility(np.array([1.0, 0.3, 0.0, 1.0]))
    weights = np.array([0.8, -1.5])
    log_policy = soft_plan(mdp, reward_of(mdp, jnp.asarray(weights))).log_policy
    demonstration = imperfect_demonstration(4, mdp, log_policy, sensor, 3, 4)
    evidence = np.asarray(log_evidence(sensor, mdp, demonstration))
    result = metrics.demonstration_log_likelihoods(mdp, sensor, weights, demonstration)
    assert result.shape == (3,)
    for i, length in enumerate(demonstration.lengths):
        brute = enumerate_completions(mdp, log_policy, evidence[i, :length])
        assert float(result[i]) == pytest.approx(brute.log_likelihood)
    assert (demonstration.kind == PAD).any()


def test_scores_refuse_weights_that_are_not_numbers_or_not_as_many() -> None:
    with pytest.raises(ValueError, match=r"weight of feature 'f1' is nan"):
        metrics.evaluate(corridor(), [1.0, 0.0], [0.0, np.nan])
    with pytest.raises(ValueError, match=r"shape \[2\].*\(3,\)"):
        metrics.evaluate(corridor(), [1.0, 0.0], [0.0, 1.0, 2.0])


def test_scores_refuse_undiscounted_processes() -> None:
    mdp = TabularMDP.from_successors(
        np.zeros((1, 1, 1), int), np.ones((1, 1, 1)), np.ones((1, 1, 1)), discount=1.0
    )
    with pytest.raises(ValueError, match="discount 1"):
        metrics.evaluate(mdp, [1.0], [1.0])
    with pytest.raises(ValueError, match="discount 1"):
        metrics.demonstration_log_likelihoods(
            mdp, Visibility([1.0]), [1.0], Demonstration.from_pairs(np.zeros((1, 2)), np.zeros((1, 2)))
        )


def test_a_band_holds_the_middle_of_the_runs() -> None:
    replications = np.stack([np.arange(5.0), 10 * np.arange(5.0)], axis=1)[[3, 0, 4, 2, 1]]
    band = metrics.quantile_band(replications)
    np.testing.assert_allclose(band.low, [1, 10])
    np.testing.assert_allclose(band.median, [2, 20])
    np.testing.assert_allclose(band.high, [3, 30])
    wide = metrics.quantile_band(replications, 0.999)
    assert (wide.low < band.low).all()
    assert (wide.high > band.high).all()


def test_a_failed_run_shows_in_the_band() -> None:
    assert np.isnan(metrics.quantile_band(np.array([[1.0], [np.nan]])).median).all()


def test_a_band_needs_runs_and_a_share() -> None:
    with pytest.raises(ValueError, match="at least one replication"):
        metrics.quantile_band(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="coverage"):
        metrics.quantile_band(np.zeros((2, 3)), 1.0)
