"""Sums of probabilities given in finite precision: tolerance, and normalisation exact to the bit."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

_DOUBLE = float(np.finfo(np.float64).eps)
# 64-bit probabilities may be decimals written with eight digits.
_DECIMALS = 1e-8


def sum_tolerance(dtype: Any, size: int) -> float:
    """Return the tolerance from one of a sum of ``size`` probabilities given in ``dtype``.

    64-bit numbers, integers and booleans: 1e-8. Shorter floats (``float32``, ``bfloat16``): the rounding of
    each number and of their sum, ``4 sqrt(size)`` units of the precision, at most 1/100.

    >>> f"{sum_tolerance('float32', 6):.1e}"
    '1.2e-06'
    """
    kind = np.dtype(dtype)
    if not jnp.issubdtype(kind, jnp.floating):
        return _DECIMALS
    return max(_DECIMALS, min(4 * math.sqrt(max(size, 1)) * float(jnp.finfo(kind).eps), 0.01))


def normalised(
    probabilities: Float[np.ndarray, "..."], axis: int | tuple[int, ...] = -1
) -> Float[np.ndarray, "..."]:
    """Divide by their sums the distributions along ``axis`` whose sums are not one within 64-bit rounding.

    All others keep their bits, so that ``normalised(normalised(p))`` equals ``normalised(p)`` bit by bit.
    So do distributions of zeros only. The result is float64. Sums are not checked (:func:`sum_tolerance`).
    """
    p = np.asarray(probabilities, dtype=np.float64)
    total = p.sum(axis=axis, keepdims=True)
    size = p.size // max(total.size, 1)
    # A sum of n quotients by their sum is one within 2 n - 1 roundings of half a unit each.
    settled = (np.abs(total - 1) <= (size + 1) * _DOUBLE) | (total == 0)
    return p / np.where(settled, 1.0, total)
