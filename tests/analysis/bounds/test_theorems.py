"""The theorems, their inverses and their tables."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.analysis.bounds.assumptions import BoundNotGuaranteed
from i2rl.analysis.bounds.theorems import (
    demonstrations_needed,
    error_for,
    failure_probability,
    lme_constraint_bound,
    lme_i2rl_confidence,
    me_i2rl_confidence,
    monotonicity,
    no_regret,
    no_regret_sizes,
    observed_bound,
    size_for,
    sure_gap,
    table_7_1a,
    table_7_1b,
)
from i2rl.inference import solve_dual
from i2rl.inference.programs.constraints import FeatureTarget
from i2rl.models import feature_expectations, reward_of, soft_plan
from i2rl.models.process.units import feature_scale


def test_table_7_1a_is_reproduced():
    table = table_7_1a()
    assert list(table.index) == [0.125, 0.075, 0.05, 0.045]
    assert list(table["trajectories"]) == [60, 239, 957, 1496]


def test_the_sufficient_sizes_of_table_7_1a_keep_the_promise():
    for row in table_7_1a().itertuples():
        assert failure_probability(row.sufficient, row.epsilon, 6) <= 0.1
        assert failure_probability(row.sufficient - 1, row.epsilon, 6) > 0.1


def test_table_7_1b_is_reproduced_as_printed_and_with_delta_s():
    table = table_7_1b()
    assert [f"{x:.2f}" for x in table["as_printed"]] == ["0.00", "0.19", "0.78", "0.99"]
    assert [f"{x:.2f}" for x in table["with_delta_s"]] == ["0.00", "0.09", "0.68", "0.89"]


@given(st.floats(0.01, 0.5), st.floats(1e-4, 0.9), st.integers(1, 50))
def test_size_error_and_delta_are_inverses_of_each_other(error, delta, events):
    size = size_for(error, delta, events)
    assert failure_probability(size, error, events) == pytest.approx(delta)
    assert error_for(size, delta, events) == pytest.approx(error)


@given(st.integers(1, 10_000), st.floats(0.001, 0.5), st.integers(1, 20), st.floats(0.0, 0.999))
def test_the_theorem_by_log_likelihood_error_is_the_theorem_by_epsilon(size, epsilon, n_features, discount):
    bound = me_i2rl_confidence(size, epsilon, n_features, discount)
    # The printed delta of appendix B.
    printed = 2 * n_features * math.exp(-size * (bound.error * (1 - discount)) ** 2 / (2 * n_features**2))
    assert bound.confidence == pytest.approx(max(0.0, 1 - printed))


def test_lme_spends_its_relaxation_and_its_confidence_on_both_errors():
    lemma = lme_constraint_bound(239, 957, 0.1, 0.05, 6)
    theorem = lme_i2rl_confidence(239, 957, 0.1, 0.05, 6, 0.99)
    assert lemma.error == pytest.approx(0.15)
    assert theorem.error == pytest.approx(4 * 6 * 0.075 / 0.01)
    assert theorem.confidence == lemma.confidence == pytest.approx(0.8, abs=2e-3)


def test_without_samples_of_the_hidden_steps_there_is_no_confidence():
    # Section 4.1.1: with n_s = 0, delta_s is larger than 1.
    assert lme_i2rl_confidence(10_000, 0, 0.1, 0.05, 6, 0.99).confidence == 0


def test_the_programs_solution_never_loses_more_than_the_sure_gap(random_mdp):
    for seed in range(5):
        mdp = random_mdp(seed)
        rng = np.random.default_rng(seed)
        true = jnp.asarray(rng.uniform(size=mdp.n_features))
        # A target that some behaviour has, but not the expert's.
        other = soft_plan(mdp, reward_of(mdp, jnp.asarray(rng.normal(size=mdp.n_features)))).policy
        features = feature_expectations(mdp, other)
        epsilon = 0.05
        slack = epsilon / (1 - mdp.discount)
        solution = solve_dual(mdp, FeatureTarget(features, mdp.initial), slack / feature_scale(mdp))

        def likelihood(weights, mdp=mdp, features=features):
            return weights @ features - mdp.initial @ soft_plan(mdp, reward_of(mdp, weights)).values

        gap = likelihood(true) - likelihood(solution.weights)
        discount = float(mdp.discount)
        assert gap <= sure_gap(epsilon, mdp.n_features, discount, float(true.sum())) + 1e-9
        assert sure_gap(epsilon, mdp.n_features, discount, float(true.sum())) <= sure_gap(
            epsilon, mdp.n_features, discount
        )


def test_with_sessions_of_one_size_the_no_regret_theorem_loses_all_confidence():
    regret = no_regret(50.0, [200] * 100, 6, 0.99)
    assert regret.confidence[0] > 0.99
    assert regret.confidence[-1] == 0
    with pytest.raises(BoundNotGuaranteed, match="confidence is 0"):
        regret.bound.guarantee()


def test_growing_sessions_keep_the_no_regret_theorems_confidence():
    sizes = no_regret_sizes(50.0, 200, 0.1, 6, 0.99)
    regret = no_regret(50.0, sizes, 6, 0.99)
    assert (regret.confidence >= 0.9).all()
    assert sizes[-1] > sizes[0]
    smaller = no_regret(50.0, np.maximum(sizes // 2, 1), 6, 0.99)
    assert smaller.confidence[-1] < 0.9


def test_the_regret_is_quoted_with_the_union_bound_since_sessions_share_data():
    sizes, epsilon = np.array([40, 40, 40]), 5.0 * 0.1 / np.arange(1, 4)
    regret = no_regret(5.0, sizes, 4, 0.9)
    deltas = [failure_probability(n, e, 4) for n, e in zip(np.cumsum(sizes), epsilon, strict=True)]
    assert regret.bound.confidence == pytest.approx(1 - sum(deltas))
    assert regret.confidence[-1] == pytest.approx(np.prod([1 - d for d in deltas]))
    assert 0 < regret.bound.confidence < regret.confidence[-1]


def test_the_regret_bound_sums_the_theorems_bound_over_sessions():
    regret = no_regret(5.0, [10] * 30, 4, 0.9)
    each = [me_i2rl_confidence(1, 5.0 * 0.1 / i, 4, 0.9).error for i in range(1, 31)]
    np.testing.assert_allclose(regret.average, np.cumsum(each) / np.arange(1, 31))
    # The proof's log T is too small a bound on the harmonic sum.
    assert regret.average[-1] > 2 * 4 * 5.0 * math.log(30) / 30


def test_monotonicity_names_the_sessions_that_fall():
    found = monotonicity(np.array([-3.0, -2.0, -2.5, -1.0]), [5, 5, 5, 5])
    assert not found.rises
    assert list(found.falls) == [3]
    assert found.largest_fall == pytest.approx(0.5)
    assert found.premise == pytest.approx(5 / 15)
    assert monotonicity(np.array([-3.0, -2.0])).rises


def test_an_observed_bound_adds_up_what_each_feature_contributes():
    features = np.random.default_rng(0).uniform(2, 4, (50, 3))
    observed = observed_bound(features, 0.9, 0.9, np.array([0.5, 0.0, 0.25]))
    assert observed.bound.error == pytest.approx(2 * (0.5 * observed.slack[0] + 0.25 * observed.slack[2]))
    assert observed_bound(features, 0.9, 0.9).bound.error == pytest.approx(2 * observed.slack.sum())


def test_an_observed_bound_covers_the_expected_likelihood(random_mdp):
    """The bound is on the expert's expected log-likelihood: simulate whole trajectories' features."""
    mdp = random_mdp(3)
    weights = jnp.asarray(np.random.default_rng(3).uniform(size=mdp.n_features))
    plan = soft_plan(mdp, reward_of(mdp, weights))
    mean = np.asarray(feature_expectations(mdp, plan.policy))
    discount = float(mdp.discount)
    # Any independent values in range with the expert's mean will do: the theorem knows no more of them.
    rng = np.random.default_rng(4)
    scaled = mean * (1 - discount)
    replications = [rng.binomial(20, scaled, (150, len(scaled))) / 20 / (1 - discount) for _ in range(40)]

    @jax.jit
    def gap(target, slack):
        learned = solve_dual(mdp, FeatureTarget(target, mdp.initial), slack / feature_scale(mdp))
        return (weights - learned.weights) @ mean - mdp.initial @ (plan.values - learned.values)

    covered = []
    for features in replications:
        observed = observed_bound(features, 0.9, discount, np.asarray(weights))
        value = float(gap(jnp.asarray(observed.target), jnp.asarray(observed.slack)))
        assert value >= -1e-9
        covered.append(value <= observed.bound.error)
    assert np.mean(covered) >= 0.9


@pytest.mark.parametrize("confidence", [0.0, 1.0, 1.5])
def test_a_confidence_outside_zero_and_one_is_refused(confidence):
    with pytest.raises(ValueError, match="confidence must lie strictly between 0 and 1"):
        observed_bound(np.zeros((5, 2)), confidence, 0.9)


def test_errors_sizes_and_discounts_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"error must be positive, got -0\.1"):
        size_for(-0.1, 0.1, 6)
    for error in (1e-300, 1e-61):  # their squares, and the sizes they ask for, leave the range of floats
        with pytest.raises(ValueError, match=f"error must be at least 1e-60, got {error}"):
            size_for(error, 0.1, 6)
        with pytest.raises(ValueError, match=f"epsilon must be at least 1e-60, got {error}"):
            demonstrations_needed(6, error, 0.8)
    with pytest.raises(ValueError, match="delta must lie strictly between 0 and 1, got 2"):
        size_for(0.1, 2.0, 6)
    with pytest.raises(ValueError, match=r"discount must lie in \[0, 1\), got 1"):
        me_i2rl_confidence(10, 0.1, 6, 1.0)
    with pytest.raises(ValueError, match="events must be at least 1, got 0"):
        failure_probability(10, 0.1, 0)
    with pytest.raises(ValueError, match="size must not be negative, got -3"):
        failure_probability(-3, 0.1, 6)
    with pytest.raises(ValueError, match="session sizes must be a list of positive numbers"):
        no_regret(1.0, [], 6, 0.9)
    with pytest.raises(ValueError, match="at least two sessions"):
        monotonicity(np.array([1.0]))
