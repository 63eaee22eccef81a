"""Pytrees of arrays as bytes, exact to the bit: the stored form of a learner's state.

No pickles: reading executes no code, and the bytes outlive the classes they came from. The layout::

    magic | header length (uint32, little-endian) | header (JSON) | leaves | BLAKE2b of all before (16 bytes)

The header lists ``[name, kind, dtype, shape]`` of every leaf in flattening order; a leaf is its elements in C
order. The bytes store containers only as the paths of their leaves, and omit static fields: :func:`restore`
takes both from a template. :func:`decode` trusts no entry of a header: each is checked before an array is
made from it.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np

from ...models.inputs.text import shortened
from ...models.observation.demonstration import PAD, Demonstration

DIGEST_SIZE = 16
MOST_LEAVES = 20_000

_MAGIC = b"i2rltree"
_LONGEST_HEADER = 1 << 22
_CACHED = 1 << 14
_LARGEST_SIDE = 1 << 40
_MOST_AXES = 32
_KEY = "key:"
_KINDS = ("none", "text", "python", "scalar", "numpy", "jax")
# First parts of the names of leaves stored by earlier versions, and the present ones.
_FORMER = {"reports": "observation_statistic"}


class Leaf(NamedTuple):
    """One stored leaf.

    Fields
    ------
    kind : str
        Original type: ``none``, ``text``, ``python`` (a number), ``scalar`` (of NumPy), ``numpy``, ``jax``,
        or ``key:threefry2x32`` (a typed random key and its implementation).
    value : array
        Its elements: of a text the UTF-8 bytes, of a key the key data.
    """

    kind: str
    value: np.ndarray

    @property
    def plain(self) -> Any:
        """Return the leaf without JAX: a NumPy array or scalar, a Python number, text, None or key data."""
        if self.kind == "none":
            return None
        if self.kind == "text":
            return self.value.tobytes().decode("utf-8", "surrogatepass")
        return self.value.item() if self.kind == "python" else self.value[()]

    @property
    def is_key(self) -> bool:
        """True for a typed random key."""
        return self.kind.startswith(_KEY)

    def __str__(self) -> str:
        if self.kind in ("none", "text"):
            return self.kind
        if self.is_key:
            return f"{self.kind}{list(self.value.shape[:-1])}"
        return f"{self.value.dtype}{list(self.value.shape)}"


def encode(tree: Any) -> bytes:
    """Encode a pytree of arrays, numbers, text, typed random keys and None as bytes.

    Raises ``TypeError`` naming a leaf of another type, and ``ValueError`` for more than
    :data:`MOST_LEAVES` leaves.
    """
    leaves = {name: _leaf(name, value) for name, value in _flatten(tree)[0].items()}
    entries = [[name, kind, _dtype_name(value.dtype), value.shape] for name, (kind, value) in leaves.items()]
    header = json.dumps(entries).encode()
    if len(leaves) > MOST_LEAVES or len(header) > _LONGEST_HEADER:
        raise ValueError(
            f"a tree must have at most {MOST_LEAVES:,} leaves with short names; got {len(leaves):,} leaves "
            f"and {len(header):,} bytes of names"
        )
    parts = [_MAGIC, struct.pack("<I", len(header)), header]
    body = b"".join([*parts, *(leaf.value.tobytes() for leaf in leaves.values())])
    return body + _checksum(body)


def decode(blob: bytes) -> dict[str, Leaf]:
    """Decode the leaves of :func:`encode` by name (``statistic.counts``); a single leaf has the name ``""``.

    Raises ``ValueError`` if the bytes are damaged.
    """
    body, digest = memoryview(blob)[:-DIGEST_SIZE], blob[-DIGEST_SIZE:]
    start = len(_MAGIC) + 4
    if len(body) < start or body[: len(_MAGIC)] != _MAGIC or _checksum(body) != digest:
        raise ValueError("the bytes are damaged (their checksum is wrong)")
    offset = start + struct.unpack_from("<I", body, len(_MAGIC))[0]
    header = bytes(body[start : min(offset, start + _LONGEST_HEADER + 1)])
    leaves = {}
    for name, kind, dtype, shape, size in (_cached_header if len(header) < _CACHED else _header)(header):
        if offset + size > len(body):
            raise ValueError(f"the bytes are damaged ({shortened(name)} needs more of them than there are)")
        stored = np.empty(shape, dtype)  # aligned, writable, and free of the blob
        stored.reshape(-1).view(np.uint8)[:] = np.frombuffer(body, np.uint8, size, offset)
        leaves[name] = Leaf(kind, stored)
        offset += size
    if offset != len(body):
        raise ValueError(f"the bytes are damaged ({len(body) - offset:,} of them belong to no leaf)")
    return leaves


def demonstration_digest(demonstration: Any) -> bytes:
    """Digest the content of a demonstration, which identifies its session.

    It takes any pytree that :func:`encode` takes. The same arrays of NumPy and of JAX have one digest; for a
    :class:`Demonstration` neither padding nor the width of its integers counts. Raises ``TypeError`` as
    :func:`encode` does.
    """
    if isinstance(demonstration, Demonstration):
        demonstration = _trimmed(demonstration)
    digest = hashlib.blake2b(digest_size=DIGEST_SIZE)
    for name, value in _flatten(demonstration)[0].items():
        array = _leaf(name, value).value
        digest.update(f"{name} {_dtype_name(array.dtype)} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.digest()


def _trimmed(demonstration: Demonstration) -> Demonstration:
    kind, state, action, score = (np.asarray(x) for x in demonstration.arrays)
    live = kind != PAD
    rows, width = live.any(1), int(live.any(0).nonzero()[0].max(initial=-1)) + 1
    arrays = (kind.astype(np.int8), state.astype(np.int32), action.astype(np.int32), score.astype(float))
    return Demonstration(
        *(x[rows, :width] for x in (*arrays[:3], np.where(np.isnan(score), np.nan, arrays[3])))
    )


class _Description(NamedTuple):
    """Description of a leaf in a header, and its size in bytes."""

    name: str
    kind: str
    dtype: np.dtype
    shape: tuple[int, ...]
    size: int


def _header(text: bytes) -> list[_Description]:
    """Read the leaves of a header after checking every entry."""
    if len(text) > _LONGEST_HEADER:
        raise ValueError(f"the bytes are damaged (their header is longer than {_LONGEST_HEADER:,} bytes)")
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("the bytes are damaged (their header is not JSON)") from None
    if not isinstance(entries, list) or len(entries) > MOST_LEAVES:
        raise ValueError(f"the bytes are damaged (their header is no list of up to {MOST_LEAVES:,} leaves)")
    described = []
    for entry in entries:
        leaf = _described(entry)
        if leaf is None:
            raise ValueError(f"the bytes are damaged (a leaf is described by {shortened(entry)})")
        described.append(leaf)
    if len({leaf.name for leaf in described}) < len(described):
        raise ValueError("the bytes are damaged (two leaves have one name)")
    return described


# Sessions of one learner have one header; reading it is most of the work.
_cached_header = lru_cache(maxsize=64)(_header)


def _described(entry: Any) -> _Description | None:
    if not isinstance(entry, list) or len(entry) != 4 or not all(isinstance(x, str) for x in entry[:3]):
        return None
    name, kind, dtype_name, shape = entry
    if kind not in _KINDS and not kind.startswith(_KEY):
        return None
    if not isinstance(shape, list) or len(shape) > _MOST_AXES or len(shape) != _axes(kind, len(shape)):
        return None
    if not all(type(side) is int and 0 <= side < _LARGEST_SIDE for side in shape):
        return None
    try:
        dtype = np.dtype(dtype_name)
    except (TypeError, ValueError, SyntaxError):
        return None
    if not dtype.itemsize or _dtype_name(dtype) != dtype_name:
        return None
    if (kind in ("none", "text") and dtype != np.uint8) or (kind == "none" and shape != [0]):
        return None
    return _Description(name, kind, dtype, tuple(shape), math.prod(shape) * dtype.itemsize)


def _axes(kind: str, given: int) -> int:
    """Return the number of axes of a leaf of the kind, if that is fixed."""
    return {"none": 1, "text": 1, "python": 0, "scalar": 0}.get(kind, given)


def restore(leaves: Mapping[str, Leaf], template: Any) -> Any:
    """Rebuild the tree with these leaves, to the bit, in the template's containers.

    A leaf must have the template's type and shape, with exceptions for parts that exist only after the first
    session: a None in the template accepts any leaf; an array without elements accepts any shape of its type,
    or None. A Python number in the template accepts any width of its kind, and a random key keeps its stored
    implementation; a legacy key (two integers) becomes the typed key with the same draws. Leaves of fields
    that were renamed keep their place. Raises ``ValueError`` naming the leaf that does not fit.
    """
    expected, structure = _flatten(template)
    leaves = {name if name in expected else _renamed(name): leaf for name, leaf in leaves.items()}
    if list(expected) != list(leaves):
        missing = [name for name in expected if name not in leaves]
        unknown = [name for name in leaves if name not in expected]
        raise ValueError(
            f"its parts differ: {shortened(unknown)} stored and not expected, {shortened(missing)} expected "
            "and not stored"
        )
    likes = {name: _leaf(name, value) for name, value in expected.items()}
    for name, stored in leaves.items():
        if not _fits(stored, likes[name]):
            raise ValueError(f"{name or 'the tree'} is stored as {stored} where {likes[name]} is expected")
    revived = [_revived(name, leaf, likes[name]) for name, leaf in leaves.items()]
    return jax.tree_util.tree_unflatten(structure, revived)


def _renamed(name: str) -> str:
    """Return the present name of a leaf stored by an earlier version."""
    first, dot, rest = name.partition(".")
    return _FORMER.get(first, first) + dot + rest


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


def _checksum(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, digest_size=DIGEST_SIZE).digest()


def _fits(stored: Leaf, like: Leaf) -> bool:
    if like.kind == "none":
        return True
    if "text" in (stored.kind, like.kind):
        return stored.kind == like.kind
    if stored.kind == "none":
        return like.value.size == 0
    if _is_legacy_key(stored, like):
        return True
    if stored.is_key or like.is_key:
        return stored.is_key and like.is_key and stored.value.shape[:-1] == like.value.shape[:-1]
    same_type = stored.value.dtype == like.value.dtype
    if like.kind == "python":
        same_type = stored.value.dtype.kind in {"i": "iu", "u": "iu"}.get(k := like.value.dtype.kind, k)
    return same_type and (stored.value.shape == like.value.shape or like.value.size == 0)


def _is_legacy_key(stored: Leaf, like: Leaf) -> bool:
    """Return whether an array of JAX is the ``jax.random.PRNGKey`` form of the expected key."""
    same_data = stored.value.dtype == np.uint32 and stored.value.shape == like.value.shape
    return stored.kind == "jax" and like.kind == f"{_KEY}threefry2x32" and same_data


def _revived(name: str, leaf: Leaf, like: Leaf) -> Any:
    if leaf.is_key or _is_legacy_key(leaf, like):
        implementation = (leaf if leaf.is_key else like).kind.removeprefix(_KEY)
        try:
            return jax.random.wrap_key_data(jax.numpy.asarray(leaf.value), impl=implementation)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name or 'the tree'} is no random key: {shortened(str(error))}") from None
    if leaf.kind == "jax":
        return jax.numpy.asarray(leaf.value)
    return leaf.value if leaf.kind == "numpy" else leaf.plain
