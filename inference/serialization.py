"""Pytrees of arrays as bytes, every bit kept: the form in which a learner's state is stored.

No pickles: reading executes nothing, and the bytes outlive the classes they came from. The layout::

    magic | header length (uint32, little-endian) | header (JSON) | leaves | BLAKE2b of all before (16 bytes)

The header lists ``[name, kind, dtype, shape]`` of every leaf in flattening order; a leaf is its elements in C
order. Containers are kept only as the paths of their leaves, and static fields not at all: :func:`restore`
takes both from a template.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import jax
import numpy as np

_MAGIC = b"i2rltree"
_DIGEST_SIZE = 16
_KEY = "key:"


class Leaf(NamedTuple):
    """One stored leaf.

    Fields
    ------
    kind : str
        What it was: ``none``, ``text``, ``python`` (a number), ``scalar`` (of NumPy), ``numpy``, ``jax``, or
        ``key:threefry2x32`` (a typed random key and its implementation).
    value : array
        Its elements; of a text the UTF-8 bytes, of a key the key data.
    """

    kind: str
    value: np.ndarray

    @property
    def plain(self) -> Any:
        """The leaf without JAX: a NumPy array or scalar, a Python number, text or None; of a key its data."""
        if self.kind == "none":
            return None
        if self.kind == "text":
            return self.value.tobytes().decode("utf-8", "surrogatepass")
        return self.value.item() if self.kind == "python" else self.value[()]

    @property
    def is_key(self) -> bool:
        """Whether it is a typed random key."""
        return self.kind.startswith(_KEY)

    def __str__(self) -> str:
        if self.kind in ("none", "text"):
            return self.kind
        if self.is_key:
            return f"{self.kind}{list(self.value.shape[:-1])}"
        return f"{self.value.dtype}{list(self.value.shape)}"


def encode(tree: Any) -> bytes:
    """Bytes of a pytree of arrays, numbers, text, typed random keys and None.

    Raises ``TypeError`` naming a leaf that is none of these.
    """
    leaves = {name: _leaf(name, value) for name, value in _flatten(tree)[0].items()}
    entries = [[name, kind, _dtype_name(value.dtype), value.shape] for name, (kind, value) in leaves.items()]
    header = json.dumps(entries).encode()
    parts = [_MAGIC, struct.pack("<I", len(header)), header]
    body = b"".join([*parts, *(leaf.value.tobytes() for leaf in leaves.values())])
    return body + _checksum(body)


def decode(blob: bytes) -> dict[str, Leaf]:
    """The leaves of :func:`encode` by name (``statistic.counts``); a tree of one leaf has the name ``""``.

    Raises ``ValueError`` where the bytes are damaged.
    """
    body, digest = blob[:-_DIGEST_SIZE], blob[-_DIGEST_SIZE:]
    if not body.startswith(_MAGIC) or _checksum(body) != digest:
        raise ValueError("the bytes are damaged (their checksum is wrong)")
    start = len(_MAGIC) + 4
    offset = start + struct.unpack_from("<I", body, len(_MAGIC))[0]
    leaves = {}
    for name, kind, dtype_name, shape in json.loads(body[start:offset]):
        dtype = np.dtype(dtype_name)
        count = int(np.prod(shape, dtype=int))
        stored = np.frombuffer(body, dtype, count, offset).reshape(shape)
        leaves[name] = Leaf(kind, stored.copy())  # aligned, writable, and free of the blob
        offset += count * dtype.itemsize
    return leaves


def restore(leaves: Mapping[str, Leaf], template: Any) -> Any:
    """The tree with these leaves, to the bit, in the template's containers.

    A leaf must have the template's type and shape, with exceptions for what exists only once learning has
    begun: where the template has None anything may stand; where it has an array without elements, any shape
    of its type, or None. A Python number in the template stands for any width of its kind, and a random key
    keeps the implementation it was stored with. Raises ``ValueError`` naming the leaf that does not fit.
    """
    expected, structure = _flatten(template)
    if list(expected) != list(leaves):
        missing = [name for name in expected if name not in leaves]
        unknown = [name for name in leaves if name not in expected]
        raise ValueError(
            f"its parts differ: {unknown} stored and not expected, {missing} expected and not stored"
        )
    for name, stored in leaves.items():
        like = _leaf(name, expected[name])
        if not _fits(stored, like):
            raise ValueError(f"{name or 'the tree'} is stored as {stored} where {like} is expected")
    return jax.tree_util.tree_unflatten(structure, [_revived(leaf) for leaf in leaves.values()])


def _flatten(tree: Any) -> tuple[dict[str, Any], Any]:
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree, is_leaf=lambda leaf: leaf is None)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    if len(named) < len(leaves):
        raise TypeError("two parts of the tree have one path; rename the keys that contain a dot")
    return named, structure


def _leaf(name: str, value: Any) -> Leaf:
    if value is None:
        return Leaf("none", np.zeros(0, np.uint8))
    if isinstance(value, str) and not isinstance(value, np.generic):
        return Leaf("text", np.frombuffer(value.encode("utf-8", "surrogatepass"), np.uint8))
    if isinstance(value, jax.Array):
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            return Leaf(f"{_KEY}{jax.random.key_impl(value)}", np.asarray(jax.random.key_data(value)))
        return Leaf("jax", np.asarray(value))
    array = np.asarray(value)
    if isinstance(value, np.ndarray | np.generic) and _dtype_name(array.dtype) is not None:
        return Leaf("numpy" if isinstance(value, np.ndarray) else "scalar", array)
    if isinstance(value, bool | int | float | complex) and array.dtype.kind in "biufc":
        return Leaf("python", array)
    raise TypeError(
        f"{name or 'the tree'} is {value!r:.60} ({type(value).__name__}); what can be stored is arrays of "
        "numbers or text, numbers of up to 64 bits, text, random keys and None"
    )


def _dtype_name(dtype: np.dtype) -> str | None:
    if dtype.kind in "biufcSUmM":
        return dtype.str
    with suppress(TypeError):  # bfloat16 and its like, of kind V, are known by name alone
        return dtype.name if dtype.kind == "V" and np.dtype(dtype.name) == dtype else None
    return None


def _checksum(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_DIGEST_SIZE).digest()


def _fits(stored: Leaf, like: Leaf) -> bool:
    if like.kind == "none":
        return True
    if "text" in (stored.kind, like.kind):
        return stored.kind == like.kind
    if stored.kind == "none":
        return like.value.size == 0
    if stored.is_key or like.is_key:
        return stored.is_key and like.is_key and stored.value.shape[:-1] == like.value.shape[:-1]
    same_type = stored.value.dtype == like.value.dtype
    if like.kind == "python":
        same_type = stored.value.dtype.kind in {"i": "iu", "u": "iu"}.get(k := like.value.dtype.kind, k)
    return same_type and (stored.value.shape == like.value.shape or like.value.size == 0)


def _revived(leaf: Leaf) -> Any:
    if leaf.is_key:
        return jax.random.wrap_key_data(jax.numpy.asarray(leaf.value), impl=leaf.kind.removeprefix(_KEY))
    if leaf.kind == "jax":
        return jax.numpy.asarray(leaf.value)
    return leaf.value if leaf.kind == "numpy" else leaf.plain
