"""Intervals hold as often as they say, and sample sizes are the smallest that suffice."""

import numpy as np
import pytest

from i2rl.analysis.bounds.concentration import (
    confidence_sequence,
    empirical_bernstein,
    predictable_bernstein,
    predictable_half_width,
)
from i2rl.analysis.bounds.theorems import error_for, observed_size, size_for

INTERVALS = [empirical_bernstein, predictable_bernstein]


def _betas(rng, mean, deviation, shape):
    total = mean * (1 - mean) / deviation**2 - 1
    return rng.beta(mean * total, (1 - mean) * total, shape)


@pytest.mark.parametrize("interval", INTERVALS)
@pytest.mark.parametrize(("mean", "deviation"), [(0.5, 0.45), (0.03, 0.1), (0.4, 0.05)])
def test_an_interval_covers_as_often_as_it_says(interval, mean, deviation):
    values = _betas(np.random.default_rng(1), mean, deviation, (2000, 60, 1))
    assert interval(values, 0.1).covers(np.array([mean])).mean() >= 0.9


def test_an_interval_misses_when_values_are_dependent():
    # The check above can fail: with copies of one value the interval is far too narrow.
    values = np.repeat(_betas(np.random.default_rng(2), 0.5, 0.45, (500, 1, 1)), 60, axis=1)
    assert empirical_bernstein(values, 0.1).covers(np.array([0.5])).mean() < 0.9


def test_a_confidence_sequence_covers_at_all_times_together():
    values = _betas(np.random.default_rng(3), 0.3, 0.2, (1000, 300, 1))
    assert confidence_sequence(values, 0.1).covers(np.array([0.3])).all(axis=1).mean() >= 0.9


def test_watching_hoeffding_at_all_times_breaks_it():
    # Why a sequence is needed: coin tosses, looked at after each one.
    values = np.random.default_rng(4).integers(0, 2, (1000, 300, 1)).astype(float)
    means = values.cumsum(axis=1) / np.arange(1, 301)[:, None]
    half = np.array([error_for(n, 0.1, 1) for n in range(1, 301)])[:, None]
    assert (np.abs(means - 0.5) <= half).all(axis=1).mean() < 0.9
    assert confidence_sequence(values, 0.1).covers(np.array([0.5])).all(axis=1).mean() >= 0.9


def test_empirical_bernstein_follows_its_formula():
    values = np.random.default_rng(5).uniform(size=(40, 2))
    log = np.log(4 / 0.05)
    expected = np.sqrt(2 * np.var(values, axis=0, ddof=1) * log / 40) + 7 * log / (3 * 39)
    np.testing.assert_allclose(empirical_bernstein(values, 0.05).half_width, expected, rtol=1e-12)


def test_predictable_bernstein_follows_its_recursion():
    # Waudby-Smith and Ramdas (2023), Theorem 2, one value at a time.
    values, delta = np.random.default_rng(6).uniform(0.2, 0.4, 50), 0.05
    mean, variance, past = 0.5, 0.25, []
    bets, costs = [], []
    for i, x in enumerate(values, 1):
        bet = min(0.75, np.sqrt(2 * np.log(2 / delta) / (variance * len(values))))
        bets.append(bet)
        costs.append(4 * (x - mean) ** 2 * (-np.log(1 - bet) - bet) / 4)
        mean = (0.5 + values[:i].sum()) / (i + 1)
        past.append((x - mean) ** 2)
        variance = (0.25 + sum(past)) / (i + 1)
    interval = predictable_bernstein(values[:, None], delta)
    np.testing.assert_allclose(interval.center[0], np.dot(bets, values) / np.sum(bets), rtol=1e-12)
    half = (np.log(2 / delta) + np.sum(costs)) / np.sum(bets)
    np.testing.assert_allclose(interval.half_width[0], half, rtol=1e-12)


def test_an_interval_is_the_same_for_each_quantity_and_run_alone():
    values = np.random.default_rng(7).uniform(size=(3, 30, 2))
    for interval in (*INTERVALS, confidence_sequence):
        together = interval(values, 0.1)
        alone = interval(values[1, :, 1:], 0.1)
        np.testing.assert_allclose(together.half_width[1, ..., 1:], alone.half_width, rtol=1e-12)
        np.testing.assert_allclose(together.center[1, ..., 1:], alone.center, rtol=1e-12)


@pytest.mark.parametrize(
    ("mean", "deviation", "error"), [(0.4, 0.08, 0.1), (0.03, 0.05, 0.05), (0.5, 0.3, 0.1)]
)
def test_the_planned_size_gives_the_planned_interval(mean, deviation, error):
    n = observed_size(np.array([deviation]), error, 0.98)
    values = _betas(np.random.default_rng(8), mean, deviation, (200, n, 1))
    assert np.median(predictable_bernstein(values, 0.02).half_width) == pytest.approx(error, rel=0.1)


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.5])
def test_the_planned_half_width_is_the_sum_over_single_values(deviation):
    """Blocks of late values and closed forms of the cumulative sums against adding up one by one."""
    n, delta = 50_000, 0.03
    squares = [deviation**2 + (deviation**2 * (t - 1) + 0.25) / t**2 for t in range(1, n + 1)]
    known = (0.25 + np.concatenate([[0.0], np.cumsum(squares)[:-1]])) / np.arange(1, n + 1)
    bets = np.minimum(np.sqrt(2 * np.log(2 / delta) / (known * n)), 0.75)
    cost = (-np.log1p(-bets) - bets) @ squares
    expected = (np.log(2 / delta) + cost) / bets.sum()
    assert predictable_half_width(deviation, n, delta) == pytest.approx(expected, rel=1e-6)


def test_a_tiny_error_is_planned_for_at_once():
    # In the limit the interval is that of the normal approximation with the sub-Gaussian quantile.
    expected = 2 * 0.04 * np.log(2 / 0.03) / 1e-16
    assert observed_size(np.array([0.2]), 1e-8, 0.97) == pytest.approx(expected, rel=1e-3)


def test_values_that_vary_little_need_fewer_trajectories():
    assert observed_size(np.full(6, 0.08), 0.1, 0.9) < 0.5 * size_for(0.1, 0.1, 6)
    assert observed_size(np.full(6, 0.5), 0.1, 0.9) > size_for(0.1, 0.1, 6)


def test_values_outside_the_unit_interval_are_refused():
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\], got 0 to 3; discounted features"):
        empirical_bernstein(np.array([[0.0], [3.0]]), 0.1)


@pytest.mark.parametrize("interval", [empirical_bernstein, predictable_bernstein])
@pytest.mark.parametrize("delta", [0.0, 1.0, 1.5, -1.0, float("nan")])
def test_a_failure_probability_outside_zero_and_one_is_refused(interval, delta):
    with pytest.raises(ValueError, match="strictly between 0 and 1"):
        interval(np.zeros((3, 1)), delta)


def test_an_error_that_is_not_positive_is_refused():
    for size in (
        lambda e, d: size_for(e, d, 1),
        lambda e, d: observed_size(np.array([0.1]), e, 1 - d),
    ):
        with pytest.raises(ValueError, match="error must be positive, got 0"):
            size(0.0, 0.1)
        with pytest.raises(ValueError, match="error must be at least 1e-60, got 1e-300"):
            size(1e-300, 0.1)
        assert size(1e-60, 0.1) > 1e100


def test_one_value_has_no_variance():
    with pytest.raises(ValueError, match="at least 2 values, got 1"):
        empirical_bernstein(np.zeros((1, 1)), 0.1)
