"""Distances of observations and of posteriors, against enumeration."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.analysis.bounds.distance import (
    Perception,
    model_distance,
    observation_distance,
    posterior_distance,
)
from i2rl.models import FeatureNoise, Visibility

BITS = np.array(list(itertools.product([0, 1], repeat=4)))


def likelihoods(reliabilities):
    """Compute the probability of each observation (second) of each truth (first): two steps of two
    predicates.
    """
    agree = BITS[:, None] == BITS[None]
    p = np.tile(reliabilities, 2)
    return np.where(agree, p, 1 - p).prod(axis=2)


def posteriors(prior, table):
    joint = prior[:, None] * table
    return joint / joint.sum(axis=0)


def binary_noise(reliabilities):
    """Predicates are the bits of a pair's index: eight pairs for three of them."""
    bits = np.arange(8) >> np.arange(3)[:, None] & 1
    return FeatureNoise(bits.reshape(3, 4, 2), np.asarray(reliabilities))


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 0.15))
def test_reports_and_posteriors_are_within_their_distances(seed, error):
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.2, 0.8, 2)
    counted = true + rng.uniform(-error, error, 2)
    perception = Perception(1, error, predicates=2, longest=2)
    before, after = likelihoods(true), likelihoods(counted)
    variation = np.abs(before - after).sum(axis=1).max() / 2
    assert variation <= observation_distance(perception, counted) + 1e-12
    assert observation_distance(perception, counted) <= observation_distance(perception) <= 4 * error
    prior = rng.dirichlet(np.ones(16))
    change = np.abs(posteriors(prior, before) - posteriors(prior, after)).sum(axis=0).max() / 2
    assert change <= posterior_distance(perception, counted) + 1e-12


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 0.15))
def test_the_mean_over_reports_changes_by_the_distance_of_reports_at_most(seed, error):
    """Check the corrected lemma's step, exactly: any prior, any features, the truth's own observations."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.2, 0.8, 2)
    counted = true + error * rng.choice([-1, 1], 2)
    prior, features = rng.dirichlet(np.full(16, 0.3)), rng.uniform(size=16)
    observations = prior @ likelihoods(true)
    learned = features @ posteriors(prior, likelihoods(counted))
    perception = Perception(1, error, predicates=2, longest=2)
    assert abs(observations @ learned - prior @ features) <= observation_distance(perception, counted) + 1e-12


def one_predicate(belief, reliability):
    """Compute the posterior of a truth of probability ``belief`` after each observation, no and yes."""
    yes = belief * reliability / (belief * reliability + (1 - belief) * (1 - reliability))
    no = belief * (1 - reliability) / (belief * (1 - reliability) + (1 - belief) * reliability)
    return np.array([no, yes])


def test_the_printed_step_fails_for_a_single_report():
    change = np.abs(one_predicate(0.01, 0.99) - one_predicate(0.01, 0.995))
    assert change.max() == pytest.approx(0.168, abs=1e-3)
    assert change.max() > 30 * 0.005
    assert change.max() <= posterior_distance(Perception(1, 0.005, 1, 1), np.array([0.99]))


def test_no_smaller_multiple_of_the_error_would_do_in_expectation():
    belief, true, counted = 0.01, 0.99999, 0.99998
    yes = belief * true + (1 - belief) * (1 - true)
    bias = np.array([1 - yes, yes]) @ one_predicate(belief, counted) - belief
    assert 0.95 < abs(bias) / (true - counted) <= 1


def test_under_other_weights_not_even_the_expectation_is_bounded():
    # The truth holds half of the time; a learner who believes in one percent reads yes too cautiously.
    observations = np.array([0.5, 0.5])
    change = observations @ (one_predicate(0.01, 0.995) - one_predicate(0.01, 0.99))
    assert abs(change) > 10 * 0.005


def test_products_that_agree_on_what_was_observed_say_nothing_of_the_rest():
    one, other = np.array([0.9, 0.1]), np.array([0.1, 0.9])
    assert one.prod() == pytest.approx(other.prod())
    assert one[0] * (1 - one[1]) - other[0] * (1 - other[1]) == pytest.approx(0.8)


def test_two_truths_can_attain_the_bound_by_odds():
    true, counted = 0.6, 0.7
    odds = (counted / (1 - counted)) / (true / (1 - true))
    # The prior at which the two posteriors lie evenly about one half.
    belief = 1 / (1 + np.sqrt(odds) * true / (1 - true))
    change = (one_predicate(belief, counted) - one_predicate(belief, true))[1]
    noise = [FeatureNoise(np.array([[[0], [1]]]), np.array([p])) for p in (true, counted)]
    assert change < model_distance(*noise).over(1)[1]
    # An observation moves one likelihood up and the other down.
    belief = 1 / (1 + np.sqrt(odds * (true / (1 - true)) ** 2))
    change = (one_predicate(belief, counted) - one_predicate(belief, true))[1]
    assert change == pytest.approx(model_distance(*noise).over(1)[1], rel=1e-9)


def test_models_of_independent_predicates_are_as_far_apart_as_enumerated():
    true, counted = np.array([0.7, 0.8, 0.6]), np.array([0.72, 0.77, 0.61])
    found = model_distance(binary_noise(true), binary_noise(counted))
    bits = np.array(list(itertools.product([0, 1], repeat=3)))
    laws = [np.where(bits, p, 1 - p).prod(axis=1) for p in (true, counted)]
    assert found.variation == pytest.approx(np.abs(laws[0] - laws[1]).sum() / 2)
    change = np.abs(np.log(counted / (1 - counted)) - np.log(true / (1 - true)))
    assert found.odds == pytest.approx(change.sum())
    assert found.variation <= np.abs(true - counted).sum()


def test_normalised_over_what_can_be_reported_a_reliability_is_no_probability():
    """Check a predicate of one pair of a hundred: 0.99 observes it correctly half of the time."""
    holds = (np.arange(100) == 7).reshape(1, 50, 2)
    found = model_distance(FeatureNoise(holds, np.array([0.99])), FeatureNoise(holds, np.array([0.995])))
    assert found.variation > 30 * 0.005
    elsewhere = model_distance(
        FeatureNoise(holds, np.array([0.99])), FeatureNoise(holds, np.array([0.995])), ~holds[0]
    )
    assert elsewhere.variation < 0.005


def test_a_reliability_that_may_be_one_leaves_no_bound_by_odds():
    perception = Perception(1, 0.05, 1, 3)
    assert posterior_distance(perception, np.array([0.96])) == 1
    assert posterior_distance(perception, np.array([0.9])) < 1
    assert observation_distance(perception, np.array([0.96])) < 1


def test_what_cannot_be_compared_is_refused():
    perception = Perception(1, 0.05, 2, 3)
    with pytest.raises(ValueError, match="reliabilities are 2 probabilities"):
        observation_distance(perception, np.array([0.9]))
    with pytest.raises(ValueError, match="epsilon_o must be positive, got 0"):
        observation_distance(perception._replace(epsilon_o=0.0))
    noise = binary_noise([0.9, 0.9, 0.9])
    with pytest.raises(ValueError, match="both sensors must have observation models"):
        model_distance(noise, Visibility(np.ones(4)))
    with pytest.raises(ValueError, match="truths mark some of the pairs"):
        model_distance(noise, noise, np.zeros((4, 2), bool))
    with pytest.raises(ValueError, match="the models are about pairs"):
        model_distance(noise, FeatureNoise(np.array([[[0], [1]]]), np.array([0.9])))
