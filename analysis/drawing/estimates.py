"""Learned weights with their uncertainty, as a page's first table and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .page import Table
from .text import number

# Of a normal distribution: the middle 95 %.
_HALF_WIDTH = 1.96


class Estimates(NamedTuple):
    """Weights and standard errors.

    Fields
    ------
    names : sequence of str
    weights : float ``[K]``
    errors : float ``[K]``
        Standard errors; infinite where the data do not determine a weight.
    """

    names: Sequence[str]
    weights: Float[np.ndarray, " K"]
    errors: Float[np.ndarray, " K"]

    @property
    def intervals(self) -> Float[np.ndarray, "K 2"]:
        """Ends of 95 % intervals, normal about the weights."""
        half = _HALF_WIDTH * np.asarray(self.errors)
        return np.stack([self.weights - half, self.weights + half], axis=1)

    @property
    def determined(self) -> list[str]:
        """Names of weights whose interval leaves zero out."""
        low, high = self.intervals.T
        return [name for name, there in zip(self.names, (low > 0) | (high < 0), strict=True) if there]

    def table(self, caption: str, truth: Float[np.ndarray, " K"] | None = None, title: str = "") -> Table:
        """Make a row a weight; with a truth, both also as shares of their L1 norms, which can be compared."""
        headings = ["feature", "weight", "95 % interval"]
        if truth is not None:
            headings += ["share of the L1 norm, learned", "share, true"]
        rows: list[list[str | float]] = []
        for k, (name, weight, (low, high)) in enumerate(
            zip(self.names, self.weights, self.intervals, strict=True)
        ):
            known = np.isfinite([low, high]).all()
            row: list[str | float] = [
                name,
                round(float(weight), 12),
                _ends(low, high) if known else "not determined",
            ]
            if truth is not None:
                row += [f"{share[k]:+.2f}" for share in (_shares(self.weights), _shares(truth))]
            rows.append(row)
        return Table([title or headings[0], *headings[1:]], rows, caption)

    def summary(self) -> list[dict[str, Any]]:
        """Return the same as plain data; None for a weight that is not determined."""
        return [
            {
                "feature": name,
                "weight": float(weight),
                "standard error": float(error) if np.isfinite(error) else None,
                "95 % interval": ends.tolist() if np.isfinite(ends).all() else None,
            }
            for name, weight, error, ends in zip(
                self.names, self.weights, self.errors, self.intervals, strict=True
            )
        ]


def laplace_errors(information: Float[np.ndarray, "K K"]) -> Float[np.ndarray, " K"]:
    """Compute standard errors of the normal distribution with this information (its inverse covariance).

    Infinite for weights that a direction without positive information moves.
    """
    values, axes = np.linalg.eigh((information + information.T) / 2)
    positive = values > 1e-12 * max(float(np.abs(values).max(initial=0.0)), 1e-300)
    variance = np.where(positive, 1 / np.where(positive, values, 1.0), np.inf)
    moved = axes**2 > 1e-16
    # Zero times an infinite variance is zero.
    errors: np.ndarray = np.sqrt(np.sum(np.where(moved, axes**2, 0) * np.where(moved, variance, 0), axis=1))
    return errors


def _shares(weights: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    return np.asarray(weights) / max(float(np.abs(weights).sum()), 1e-300)


def _ends(low: float, high: float) -> str:
    return f"{number(low)} to {number(high)}"
