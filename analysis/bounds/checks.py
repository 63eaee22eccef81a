"""Checks of the numbers that bounds take."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

# The squares of smaller errors, and the sizes that they ask for, leave the range of floats.
LEAST = 1e-60


def positive(name: str, x: float) -> float:
    """Return a finite number above zero, and refuse any other."""
    if not (np.isfinite(x) and x > 0):
        raise ValueError(f"{name} must be positive, got {x}")
    if x < LEAST:
        raise ValueError(f"{name} must be at least {LEAST}, got {x}")
    return x


def probability(name: str, x: float) -> float:
    """Return a number strictly between 0 and 1, and refuse any other."""
    if not 0 < x < 1:
        raise ValueError(f"{name} must lie strictly between 0 and 1, got {x}")
    return x


def counted(name: str, x: float) -> float:
    """Return a number of at least 1, and refuse any other."""
    if not x >= 1:
        raise ValueError(f"{name} must be at least 1, got {x}")
    return x


def discounted(discount: float) -> float:
    """Return a discount in [0, 1), and refuse any other."""
    if not 0 <= discount < 1:
        raise ValueError(f"discount must lie in [0, 1), got {discount}")
    return discount


def counted_sessions(sizes: Int[np.ndarray, " T"] | Sequence[int]) -> np.ndarray:
    """Return the sizes of sessions ``[T]``, each at least 1, and refuse any others."""
    counts = np.asarray(sizes)
    if counts.ndim != 1 or len(counts) == 0 or not (counts >= 1).all():
        raise ValueError(f"session sizes must be a list of positive numbers, got {sizes!r}")
    return counts
