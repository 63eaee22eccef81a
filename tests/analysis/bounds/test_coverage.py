"""The coverage study: its simulations are the expert's, and its bounds hold in a small case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.bounds.coverage import (
    Setting,
    complete_features,
    coverage_table,
    expected_gap,
    expected_gaps,
    expert_of,
    full_view_coverage,
    ignorance_gap,
    learned_coverage,
    occluded_coverage,
    regret_coverage,
    simulate_codes,
    simulate_features,
)
from i2rl.models import Visibility, reward_of, soft_plan
from i2rl.models.process.planning import simulate


@pytest.fixture(scope="module")
def setting(random_mdp):
    mdp = random_mdp(5)
    weights = jnp.asarray(np.random.default_rng(5).uniform(size=mdp.n_features))
    return Setting("small", mdp, weights, Visibility(np.arange(mdp.n_states) % 2 == 0), 25)


def test_simulated_features_have_the_experts_mean(setting):
    expert = expert_of(setting.mdp, setting.weights)
    features = np.asarray(simulate_features(jax.random.key(0), setting.mdp, expert, 25, 4, 1000))
    standard_error = features.reshape(-1, features.shape[-1]).std(0) / np.sqrt(4000)
    assert (np.abs(features.mean((0, 1)) - expert.features) < 4 * standard_error).all()
    assert (np.abs(features.mean((0, 1)) - 1.05 * expert.features) > 4 * standard_error).all()


def test_completed_features_have_the_experts_mean_and_vary_less(setting):
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    codes = simulate_codes(jax.random.key(1), mdp, expert, setting.sensor, 25, 4, 250)
    completed = complete_features(jax.random.key(2), mdp, expert, setting.sensor, codes, 4)
    for features in completed:
        flat = np.asarray(features).reshape(1000, -1)
        assert (np.abs(flat.mean(0) - expert.features) < 4 * flat.std(0) / np.sqrt(1000)).all()
    full = np.asarray(simulate_features(jax.random.key(3), mdp, expert, 25, 4, 250)).reshape(1000, -1)
    assert (np.asarray(completed.exact).reshape(1000, -1).std(0) < full.std(0)).all()


def test_sampled_completions_average_to_the_exact_one(setting):
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    codes = simulate_codes(jax.random.key(4), mdp, expert, setting.sensor, 25, 1, 3)
    completed = complete_features(jax.random.key(5), mdp, expert, setting.sensor, codes, 4000)
    # The deviation of a feature over completions is at most its range, 1 / (1 - gamma).
    tolerance = 4 / (1 - float(mdp.discount)) / np.sqrt(4000)
    np.testing.assert_allclose(completed.sampled, completed.exact, atol=tolerance)


def test_the_expected_gap_is_zero_at_the_truth_and_positive_elsewhere(setting):
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    assert float(expected_gap(mdp, expert, expert.weights, expert.values)) == pytest.approx(0, abs=1e-12)
    rng = np.random.default_rng(0)
    for weights in rng.normal(size=(20, mdp.n_features)):
        values = soft_plan(mdp, reward_of(mdp, jnp.asarray(weights))).values
        assert float(expected_gap(mdp, expert, jnp.asarray(weights), values)) > 0


def test_the_expected_gap_is_the_mean_log_likelihood_ratio(setting):
    # Against a simulation of whole trajectories, sum_t gamma^t log pi_E / pi.
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    other = jnp.full(mdp.n_features, -2.0)
    plan = soft_plan(mdp, reward_of(mdp, other))
    ratio = jnp.where(mdp.available, expert.log_policy - plan.log_policy, 0.0)
    states, actions = jax.vmap(lambda k: simulate(k, mdp, expert.log_policy, 200))(
        jax.random.split(jax.random.key(6), 2000)
    )
    sums = np.asarray(ratio[states, actions]) @ np.asarray(float(mdp.discount) ** np.arange(200))
    gap = float(expected_gap(mdp, expert, other, plan.values))
    assert abs(sums.mean() - gap) < 4 * sums.std() / np.sqrt(2000)


def test_without_slack_and_with_the_true_features_nothing_is_lost(setting):
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    gap = expected_gaps(mdp, expert, expert.features[None], jnp.zeros((1, mdp.n_features)))
    assert float(gap[0]) == pytest.approx(0, abs=1e-8)


def test_huge_slack_learns_nothing(setting):
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    gap = expected_gaps(mdp, expert, expert.features[None], jnp.full((1, mdp.n_features), 1e3))
    assert float(gap[0]) == pytest.approx(ignorance_gap(mdp, setting.weights))


@pytest.mark.parametrize(
    ("study", "arguments"),
    [
        (full_view_coverage, (60, 0.8)),
        (occluded_coverage, (20, 4, 0.1)),
        (learned_coverage, (10, 4, 0.1)),
        (regret_coverage, (5.0, 2, 0.1)),
    ],
)
def test_every_bound_covers_in_a_small_case(setting, study, arguments):
    rows = study(jax.random.key(7), setting, 40, *arguments)
    for row in rows:
        assert row.covered >= row.confidence, row
        assert row.looseness >= 1, row
    assert list(coverage_table(rows)["looseness"]) == [row.looseness for row in rows]


def test_a_bound_that_is_too_small_would_be_found_out(setting):
    """Coverage can fail: half the quantile seen, called a bound, is missed more often than stated."""
    row = full_view_coverage(jax.random.key(8), setting, 40, 60, 0.8)[0]
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    features = simulate_features(jax.random.key(9), mdp, expert, 25, 40, 60).mean(axis=1)
    misses = (1 - float(mdp.discount)) * np.abs(np.asarray(features - expert.features)).max(axis=1)
    assert (misses <= row.quantile / 2).mean() < 0.8
