"""Arguments in the forms users have: numbers of any library, random keys, parameters in a tuple."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .text import shortened

Fields = TypeVar("Fields", bound=type)


def concrete(name: str, given: Any, dtype: type | None = float) -> np.ndarray | None:
    """Convert an argument to a NumPy array; return None if JAX traces it and it has no numbers to check.

    ``dtype`` None keeps the argument's own. Raises ``TypeError`` for anything but an array of numbers, and
    ``ValueError`` for masked entries.
    """
    if is_traced(given):
        return None
    if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
        at = np.argwhere(np.ma.getmaskarray(given))[0].tolist()
        raise ValueError(f"{name} must be numbers throughout; the entry {at} is masked")
    if isinstance(given, jax.Array) and jax.dtypes.issubdtype(given.dtype, jax.dtypes.prng_key):
        raise TypeError(f"{name} must be an array of numbers; got a random key")
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "biufcSU":  # of pandas, of Python's objects, of fewer bits than NumPy has
            array = np.asarray(given, float)
    except (TypeError, ValueError):
        array = np.zeros(0, "U1")
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must be an array of real numbers; got {described(given)}")
    return array if dtype is None else array.astype(dtype, copy=False)


def is_traced(given: Any) -> bool:
    """Return whether JAX traces an argument, or an entry of a list or tuple of them."""
    if isinstance(given, list | tuple):
        return any(is_traced(entry) for entry in given)
    return isinstance(given, Tracer)


def as_key(key: Any) -> Array:
    """Take one JAX random key, or make one from a seed.

    A legacy key (``jax.random.PRNGKey``) becomes the typed key with the same draws. Raises ``TypeError`` for
    anything else.

    Examples
    --------
    >>> as_key(7) == as_key(jax.random.PRNGKey(7)) == jax.random.key(7)
    Array(True, dtype=bool)
    """
    if isinstance(key, Tracer):
        return key
    if isinstance(key, int | np.integer) and not isinstance(key, bool):
        return jax.random.key(int(key))
    if isinstance(key, jax.Array | np.ndarray):
        if jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0:
            return jnp.asarray(key)
        if key.dtype == np.uint32 and key.ndim == 1:
            return jax.random.wrap_key_data(jnp.asarray(key))
    raise TypeError(f"key must be one random key such as jax.random.key(0), or a seed; got {described(key)}")


def rebuilt_unchecked(cls: Fields) -> Fields:
    """Let JAX, pickles and copies rebuild a checked named tuple without calling ``__new__``.

    Leaves are traced, or placeholders without numbers, or arrays that were checked when a user gave them.
    Checking them again would cost a copy from the device whenever a compiled function returns. ``_make`` does
    the same in the library's own code; ``_replace`` checks.
    """
    fields: Any = cls
    names = fields._fields

    def keyed(value: Any) -> tuple:
        return tuple((jax.tree_util.GetAttrKey(n), x) for n, x in zip(names, value, strict=True)), None

    jax.tree_util.register_pytree_with_keys(
        cls, keyed, lambda _, leaves: fields._make(leaves), lambda value: (tuple(value), None)
    )

    def replaced(self: Any, **changes: Any) -> Any:
        return cls(**self._asdict() | changes)

    fields._replace = replaced
    fields.__reduce__ = lambda self: (fields._make, (tuple(self),))
    return cls


def described(given: Any) -> str:
    """Describe an argument in a message: type, shape and the beginning of its text."""
    shape = getattr(given, "shape", None)
    if shape is not None and hasattr(given, "dtype"):
        return f"{type(given).__name__} of {given.dtype} with shape {list(shape)}"
    return f"{shortened(given, 60)} ({type(given).__name__})"
