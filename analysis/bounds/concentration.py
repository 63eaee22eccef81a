"""Concentration of a mean of independent values in [0, 1] about its expectation.

Hoeffding's inequality, which the dissertation's theorems use, depends only on the range
(:func:`~i2rl.analysis.bounds.theorems.error_for`). For values that vary little, such as discounted feature
averages, the observed variance gives much narrower intervals: Maurer and Pontil (2009), and the predictable
plug-in intervals of Waudby-Smith and Ramdas (2023), whose confidence sequence holds at all sample sizes at
once, so that an online learner may check it after every session.

Values are ``[..., n, K]``: ``n`` independent observations of ``K`` quantities. ``delta`` is the failure
probability of *one* quantity's two-sided interval; for ``K`` at once give ``delta / K`` (union bound).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import digamma, polygamma

# Largest bet of the predictable intervals; Waudby-Smith and Ramdas (2023) recommend 1/2 or 3/4.
_LARGEST_BET = 0.75


class Interval(NamedTuple):
    """``center`` +- ``half_width``, each ``[..., K]``."""

    center: Float[np.ndarray, "... K"]
    half_width: Float[np.ndarray, "... K"]

    def covers(self, expectation: Float[np.ndarray, "... K"]) -> np.ndarray:
        """Test whether each interval holds the expectation, boolean ``[..., K]``."""
        return np.abs(self.center - expectation) <= self.half_width


# -- intervals ----------------------------------------------------------------------------------------


def empirical_bernstein(values: Float[np.ndarray, "... n K"], delta: float) -> Interval:
    """Compute an interval from the observed variance (Maurer and Pontil 2009, Theorem 4).

    ``mean +- sqrt(2 V log(4 / delta) / n) + 7 log(4 / delta) / (3 (n - 1))`` with the sample variance ``V``.
    Raises ``ValueError`` for fewer than two values.
    """
    values = _in_unit_interval(values, least=2)
    n = values.shape[-2]
    log = _log(delta) + np.log(2)  # of each of two sides
    half = np.sqrt(2 * values.var(axis=-2, ddof=1) * log / n) + 7 * log / (3 * (n - 1))
    return Interval(values.mean(axis=-2), half)


def predictable_bernstein(values: Float[np.ndarray, "... n K"], delta: float) -> Interval:
    """Compute predictable plug-in interval (Waudby-Smith and Ramdas 2023, Theorem 2) for a fixed sample size.

    Values are weighed by ``lambda_i``, chosen from the values before them to suit ``n``; the constant of
    its lower-order term is half that of :func:`empirical_bernstein`. Depends on the order of the values.
    """
    values = _in_unit_interval(values)
    n = values.shape[-2]
    bets, squares = _bets(values, lambda t: np.full(len(t), n), delta)
    return Interval(
        (bets * values).sum(axis=-2) / bets.sum(axis=-2),
        (_log(delta) + (_cost(bets) * squares).sum(axis=-2)) / bets.sum(axis=-2),
    )


def confidence_sequence(values: Float[np.ndarray, "... n K"], delta: float) -> Interval:
    """Compute intervals after each value that hold at all times (Waudby-Smith and Ramdas 2023, Theorem 2).

    Arrays are ``[..., n, K]``: entry ``t`` uses the first ``t + 1`` values. With probability ``1 - delta``
    none of them misses, for every length of the sequence and every stopping rule, so that later intervals may
    be intersected with earlier ones.
    """
    values = _in_unit_interval(values)
    bets, squares = _bets(values, lambda t: t * np.log(1 + t), delta)
    total = bets.cumsum(axis=-2)
    return Interval(
        (bets * values).cumsum(axis=-2) / total,
        (_log(delta) + (_cost(bets) * squares).cumsum(axis=-2)) / total,
    )


def _bets(
    values: np.ndarray, horizon: Callable[[np.ndarray], np.ndarray], delta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute bets ``lambda_t`` and squared errors ``(X_t - mu_{t-1})^2`` of the predictions made before
    ``X_t``.
    """
    t = np.arange(1, values.shape[-2] + 1)[:, None]
    means = (0.5 + values.cumsum(axis=-2)) / (t + 1)
    variances = (0.25 + ((values - means) ** 2).cumsum(axis=-2)) / (t + 1)
    means, variances = _delayed(means, 0.5), _delayed(variances, 0.25)
    bets = np.sqrt(2 * _log(delta) / (variances * horizon(t[:, 0])[:, None]))
    return np.minimum(bets, _LARGEST_BET), (values - means) ** 2


def _delayed(x: np.ndarray, first: float) -> np.ndarray:
    return np.concatenate([np.full_like(x[..., :1, :], first), x[..., :-1, :]], axis=-2)


def _cost(bets: np.ndarray) -> np.ndarray:
    """Compute ``4 psi_E(lambda)``, the factor of squared errors without the 4."""
    return -np.log1p(-bets) - bets


# -- sample sizes -------------------------------------------------------------------------------------


def predictable_half_width(deviation: float, size: int, delta: float) -> float:
    """Predict the half-width of :func:`predictable_bernstein` for values of known deviation.

    Includes the cost of its first predictions for the least favourable expectation, 0 or 1.
    """
    variance, (t, count) = deviation**2, _blocks(size)
    # Expected squared error of the prediction before value t, which starts at 1/2 with a value's weight.
    squares = variance + (variance * (t - 1) + 0.25) / t**2
    # Sums of 1/i and 1/i^2 over i < t, of which the squares' sum is made.
    harmonic, inverse = digamma(t) + np.euler_gamma, np.pi**2 / 6 - polygamma(1, t)
    known = (0.25 + variance * (t - 1 + harmonic) + (0.25 - variance) * inverse) / t
    bets = np.minimum(np.sqrt(2 * _log(delta) / (known * size)), _LARGEST_BET)
    return float((_log(delta) + count @ (_cost(bets) * squares)) / (count @ bets))


def _blocks(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times ``1..size`` and their multiplicities; late times share blocks to bound the cost."""
    first = min(size, 4096)
    t = np.arange(1.0, first + 1)
    if size == first:
        return t, np.ones(first)
    edges = np.geomspace(first, float(size), 2000)
    count = np.diff(edges)
    return np.append(t, edges[:-1] + (count + 1) / 2), np.append(np.ones(first), count)


def smallest(enough: Callable[[int], object]) -> int:
    """Find the smallest positive integer that is enough, by doubling and bisection."""
    low, high = 0, 1
    while not enough(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


# -- border -------------------------------------------------------------------------------------------


def _log(delta: float) -> float:
    if not 0 < delta < 1:
        raise ValueError(f"a failure probability lies strictly between 0 and 1, got {delta}")
    return float(np.log(2 / delta))


def _in_unit_interval(values: Float[np.ndarray, "... n K"], least: int = 1) -> np.ndarray:
    values = np.asarray(values, float)
    if values.ndim < 2:
        raise ValueError(f"values must be [..., n, K], got shape {values.shape}")
    if values.shape[-2] < least:
        raise ValueError(f"an interval needs at least {least} values, got {values.shape[-2]}")
    if not (values.min() >= -1e-9 and values.max() <= 1 + 1e-9):
        raise ValueError(
            f"values must lie in [0, 1], got {values.min():.4g} to {values.max():.4g}; "
            "discounted features are to be multiplied by (1 - discount)"
        )
    return values
