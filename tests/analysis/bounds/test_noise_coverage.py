"""The study of RIMEO's bounds: its counts and posteriors are right, and its bounds hold in a small case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.benchmarks.statistics.perception import binary_noise, rare_setting, shift_setting
from i2rl.analysis.bounds.coverage import (
    complete_features,
    expected_gaps,
    expert_of,
    ignorance_gap,
    simulate_codes,
)
from i2rl.analysis.bounds.distance import Perception
from i2rl.analysis.bounds.noise_coverage import (
    complete_under,
    counted_reliabilities,
    learned_perception_coverage,
    perception_coverage,
    posterior_change,
)
from i2rl.analysis.bounds.perception import rimeo_confidence
from i2rl.models import FeatureNoise, Visibility


@pytest.fixture(scope="module")
def setting():
    return shift_setting(0.8, 4)


def test_reliabilities_are_counted_without_bias():
    p = np.array([0.7, 0.8, 0.9])
    noise = binary_noise(4, 2, 0.5)._replace(reliabilities=jnp.asarray(p))
    counted = np.asarray(counted_reliabilities(jax.random.key(0), noise, 4000, 50))
    error = np.sqrt(p * (1 - p) / 50 / 4000)
    assert (np.abs(counted.mean(axis=0) - p) < 4 * error).all()
    np.testing.assert_allclose(counted.std(axis=0), np.sqrt(p * (1 - p) / 50), rtol=0.1)
    assert ((counted > 0) & (counted < 1)).all()


def test_predicates_that_depend_on_each_other_are_refused():
    twice = np.array([[[0, 1]], [[0, 1]]])
    with pytest.raises(ValueError, match="predicates must be independent"):
        counted_reliabilities(jax.random.key(0), FeatureNoise(twice, np.full(2, 0.8)), 2, 10)


def test_another_sensor_is_refused(setting):
    blind = setting._replace(sensor=Visibility(np.ones(4)))
    with pytest.raises(ValueError, match="the sensor is a Visibility"):
        perception_coverage(jax.random.key(0), blind, 2, 5, 1, 100, 0.1)


def test_completion_uses_the_reliabilities_of_its_run(setting):
    mdp, expert, noise = setting.mdp, expert_of(setting.mdp, setting.weights), setting.sensor
    # Shapes are those of the study below, which is then compiled once.
    codes = simulate_codes(jax.random.key(1), mdp, expert, noise.noise, 4, 30, 50)
    p = jnp.asarray(np.random.default_rng(0).uniform(0.6, 0.9, (30, 3)))
    found = complete_under(jax.random.key(2), mdp, expert, noise, p, codes, 2).exact
    for run in range(2):
        reading = FeatureNoise(noise.predicates, p[run], noise.reportable).noise
        alone = complete_features(jax.random.key(3), mdp, expert, reading, codes[run : run + 1], 2).exact
        np.testing.assert_allclose(found[run], alone[0], atol=1e-12)


def test_every_bound_covers_under_the_experts_posterior(setting):
    rows = perception_coverage(jax.random.key(4), setting, 30, 50, 2, 10_000, 0.05)
    for row in rows:
        assert row.covered >= row.confidence, row
        assert row.looseness >= 1, row
    errors = {row.result: row.bound for row in rows}
    assert errors["Lemma 4, counted reliabilities"] < errors["Lemma 4, corrected"]
    assert errors["Lemma 4, corrected"] < errors["Lemma 4, printed"]


def test_the_proofs_step_fails_where_a_truth_is_rare():
    rows = {row.result: row for row in posterior_change(jax.random.key(5), rare_setting(), 0.005, 20, 60)}
    assert rows["observation term as printed, worst trajectory"].covered < 0.5
    assert rows["observation term by odds, worst trajectory"].covered == 1
    assert rows["observation term by odds, mean of trajectories"].covered == 1


def test_an_error_that_leaves_no_reliability_is_refused():
    with pytest.raises(ValueError, match=r"too near 0 or 1 to be off by 0\.05"):
        posterior_change(jax.random.key(5), rare_setting(), 0.05, 2, 2)


def test_reports_that_say_nothing_teach_nothing_under_the_learners_own_weights():
    """Theorem 6 as printed is false for them: its bound falls with data, the loss does not."""
    setting = shift_setting(0.5, 4)
    nothing = ignorance_gap(setting.mdp, setting.weights)
    perception = Perception(observations=10**9, epsilon_o=1e-4, predicates=3, longest=4)
    theorem = rimeo_confidence(10**5, 10**5, 0.01, 0.01, perception, 2, 0.8)
    assert theorem.confidence > 0.99
    assert theorem.error < nothing / 2
    # For every observation the posterior under zero weights has the features of zero weights.
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    nobody = expert_of(mdp, jnp.zeros(2))
    codes = simulate_codes(jax.random.key(6), mdp, expert, setting.sensor.noise, 4, 30, 50)
    p = jnp.broadcast_to(setting.sensor.reliabilities, (30, 3))
    completed = complete_under(jax.random.key(7), mdp, nobody, setting.sensor, p, codes, 2).exact
    np.testing.assert_allclose(completed, np.broadcast_to(nobody.features, completed.shape))
    slacks = jnp.full((30, 2), theorem.epsilon / (1 - mdp.discount))
    np.testing.assert_allclose(expected_gaps(mdp, expert, completed.mean(axis=1), slacks), nothing)


def test_good_perception_teaches_under_the_learners_own_weights():
    setting = shift_setting(0.95, 25)
    (row,) = learned_perception_coverage(jax.random.key(7), setting, 2, 300, 4, 10**9, 0.05, shift=-1.0)
    assert row.covered == 1
    assert row.quantile < ignorance_gap(setting.mdp, setting.weights) / 2
    with pytest.raises(ValueError, match="off by epsilon_o, got 2 times that"):
        learned_perception_coverage(jax.random.key(7), setting, 2, 300, 4, 10**9, 0.05, shift=2)
