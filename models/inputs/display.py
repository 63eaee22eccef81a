"""Objects shown briefly: representations of a line or two, and small tables for notebooks.

Nothing here computes on a device: an array is told by its type and shape, and its numbers are read only where
they are few and there. Fields may hold anything, since JAX puts tracers, shapes and placeholders into them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Int

from .text import counted, shortened

LONGEST = 200
_FEW = 8
_TEXT = 40

Shown = TypeVar("Shown", bound=type)


def shown_briefly(cls: Shown) -> Shown:
    """Let the objects of a named tuple or a dataclass show themselves by :func:`brief_repr` and in notebooks.

    See Also
    --------
    brief_repr, brief_table

    Examples
    --------
    >>> from typing import NamedTuple
    >>> @shown_briefly
    ... class Point(NamedTuple):
    ...     name: str
    ...     place: np.ndarray
    >>> Point("here", np.array([0.5, 1 / 3])), Point("there", np.zeros((300, 4)))
    (Point(name='here', place=[0.5, 0.333]), Point(name='there', place=float64[300, 4]))
    """
    shown: Any = cls
    shown.__repr__ = brief_repr
    shown._repr_html_ = lambda self: brief_table(type(self).__name__, fields_of(self))
    return cls


def brief_repr(value: Any, fields: Iterable[tuple[str, Any]] | None = None) -> str:
    """Write ``Name(field=..., ...)`` in at most 200 characters; the last fields give way to ``...``.

    ``fields`` are those of the object by default. See :func:`brief` for how each is written.
    """
    return joined(
        type(value).__name__,
        [f"{name}={brief(field)}" for name, field in (fields_of(value) if fields is None else fields)],
    )


def joined(name: str, parts: list[str]) -> str:
    """Write ``name(part, part, ...)`` in at most 200 characters."""
    text = f"{name}({', '.join(parts)})"
    while len(text) > LONGEST and parts:
        parts = parts[:-1]
        text = f"{name}({', '.join([*parts, '...'])})"
    return text


def brief_table(title: str, rows: Iterable[tuple[str, Any]]) -> str:
    """Write an HTML table of names and values, in the colours of the page it stands on."""
    cells = "".join(
        f'<tr><th scope="row" style="text-align: left">{escape(name)}</th>'
        f'<td style="text-align: left">{escape(value if isinstance(value, str) else brief(value))}</td></tr>'
        for name, value in rows
    )
    caption = f'<caption style="text-align: left; font-weight: bold">{escape(title)}</caption>'
    return f"<table>{caption}<tbody>{cells}</tbody></table>"


def fields_of(value: Any) -> list[tuple[str, Any]]:
    """List the names and values of the fields of a named tuple or a dataclass."""
    if isinstance(value, tuple):
        return list(zip(value._fields, value, strict=True))  # type: ignore[attr-defined]
    return [(name, getattr(value, name)) for name in value.__dataclass_fields__ if not name.startswith("_")]


def brief(value: Any) -> str:
    """Write one value: a number, few numbers, an array's type and shape, or the name of what it is.

    Examples
    --------
    >>> brief(np.linspace(0, 1, 4)), brief(np.zeros((124, 4))), brief(jax.random.key(0)), brief([1, 2])
    ('[0, 0.333, 0.667, 1]', 'float64[124, 4]', 'key<fry>', '[1, 2]')
    """
    if value is None or isinstance(value, bool | np.bool_):
        return str(value)
    if isinstance(value, int | np.integer):
        return shortened(int(value), _TEXT)
    if isinstance(value, float | complex | np.inexact):
        return f"{value:.6g}"
    if isinstance(value, str | bytes):
        return shortened(value, _TEXT)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array(value)
    if isinstance(value, type) or (callable(value) and not hasattr(value, "_fields")):
        name = getattr(value, "__name__", type(value).__name__)
        return "function" if name == "<lambda>" else shortened(name, _TEXT).strip("'")
    if isinstance(value, Mapping):
        return _several(list(value), "{", "}")
    if isinstance(value, list | tuple | set | frozenset) and not hasattr(value, "_fields"):
        return _several(list(value), "[", "]")
    return shortened(type(value).__name__, _TEXT).strip("'")


def _array(value: Any) -> str:
    """Write an array's few numbers if they are there, else its type and shape."""
    try:
        shape, dtype = tuple(value.shape), str(value.dtype)
    except Exception:  # whatever a placeholder raises
        return type(value).__name__
    told = f"{dtype}[{', '.join(map(str, shape))}]"
    if dtype.startswith("key<"):
        return told.removesuffix("[]")
    small = len(shape) == 0 or (len(shape) == 1 and shape[0] <= _FEW)
    if not small or not readable(value):
        return told
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        return told
    return brief(array[()]) if array.ndim == 0 else f"[{', '.join(_short_number(x) for x in array)}]"


def step_range(lengths: Int[np.ndarray, " n"]) -> str:
    """Write how many steps trajectories have, those without any left out.

    >>> step_range(np.array([5, 12, 0])), step_range(np.array([7])), step_range(np.array([1]))
    ('5 to 12 steps', '7 steps', '1 step')
    """
    lengths = lengths[lengths > 0]
    low, high = (int(lengths.min()), int(lengths.max())) if len(lengths) else (0, 0)
    return counted(low, "step") if low == high else f"{low} to {high} steps"


def _short_number(x: Any) -> str:
    return str(x) if isinstance(x, np.bool_ | np.integer) else f"{x:.3g}"


def readable(value: Any) -> bool:
    """Say whether an array's numbers can be read without a device computing anything."""
    if isinstance(value, Tracer):
        return False
    if isinstance(value, jax.Array):
        return value.is_fully_addressable and not value.is_deleted()
    return isinstance(value, np.ndarray | np.generic)


def _several(values: list[Any], start: str, end: str) -> str:
    """Write a few short values, or how many there are of which kind."""
    if len(values) <= _FEW:
        text = f"{start}{', '.join(brief(v) for v in values)}{end}"
        plain = not any(hasattr(v, "_fields") or hasattr(v, "__dataclass_fields__") for v in values)
        if plain and len(text) <= 2 * _TEXT:
            return text
    kinds = Counter(type(v).__name__ for v in values)
    (kind, _), *others = kinds.most_common(2)
    return f"{len(values)} {'objects' if others else kind}"
