"""Archives of plain arrays (``.npz``), checked by their headers before they are read, within a limit."""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO, NamedTuple

import numpy as np

from .text import shortened

MAX_BYTES = 2**30
"""Default limit of the bytes of an archive's arrays: 1 GiB."""

_MAX_HEADER = 4096
_MAX_DIMENSIONS = 8
_CHUNK = 2**16
_LAST_CHARACTER = 0x10FFFF
# ZipFile reads the list of an archive's entries in one piece; every other piece is a chunk at most.
_MAX_PIECE = 2**17
_ENCRYPTED = 0x1
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_WORDS = {
    "b": "booleans",
    "i": "integers",
    "u": "integers",
    "f": "real numbers",
    "U": "text",
    "S": "bytes",
    "c": "complex numbers",
    "O": "objects",
    "V": "records",
    "M": "dates",
    "m": "durations",
}
# The kinds of header: bytes of its length, and its encoding.
_VERSIONS = {(1, 0): (2, "latin-1"), (2, 0): (4, "latin-1"), (3, 0): (4, "utf-8")}
_FIELD = re.compile(
    r"'(descr|fortran_order|shape)'\s*:\s*('[<>|=]?[a-zA-Z][0-9]{0,9}'|True|False|\([0-9\s,]*\))"
)
_HEADER = re.compile(rf"\{{\s*{_FIELD.pattern}(?:\s*,\s*{_FIELD.pattern}){{2}}(?:\s*,)?\s*\}}\s*")


class StorageError(ValueError):
    """A file that is invalid; the message names the file and, if there is one, the array."""


class _Header(NamedTuple):
    dtype: np.dtype
    fortran_order: bool
    shape: tuple[int, ...]
    n_elements: int
    begin: int


def read_arrays(
    path: str | os.PathLike[str],
    kinds: Mapping[str, str],
    *,
    required: Sequence[str] = (),
    what: str = "archive",
    max_bytes: int = MAX_BYTES,
) -> dict[str, np.ndarray]:
    """Read the arrays of an ``.npz`` file; execute nothing in it and read no unexpected array.

    The arrays are read only after the list of entries and the header of every array have shown that their
    names are known, their types allowed, their sizes consistent, and their total within ``max_bytes``. They
    are then inflated piece by piece into memory of that size.

    Parameters
    ----------
    path : path
    kinds : mapping from str to str
        NumPy's letters for the kinds of type that each possible array may have: ``"iu"`` for integers,
        ``"f"`` for real numbers.
    required : sequence of str
        Arrays that the file must have.
    what : str
        Name of such a file in messages.
    max_bytes : int
        Limit of the arrays' size in all; 1 GiB by default.

    Raises
    ------
    StorageError
        For a file that is not such an archive or has been damaged, and for arrays that are missing, unknown,
        of another type or too large.
    OSError
        For a file that cannot be opened.
    """
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(_Pieces(file)) as archive:
                entries = _entries(archive, kinds, required, what, max_bytes)
                headers = {name: _header(archive, name, entries[name], kinds[name]) for name in entries}
                return {name: _array(archive, name, entries[name], headers[name]) for name in entries}
        except StorageError as error:
            raise StorageError(f"{path}: {error}") from None
        # zipfile and zlib raise a dozen kinds of exceptions for damaged archives.
        except Exception as error:
            reason = shortened(str(error), 200)[1:-1] or type(error).__name__
            raise StorageError(f"{path}: not an {what} (.npz of plain arrays): {reason}") from None


class _Pieces:
    """A file whose reads are limited to small pieces."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        piece = self._file.read(_MAX_PIECE + 1 if size is None or size < 0 else min(size, _MAX_PIECE + 1))
        if len(piece) > _MAX_PIECE:
            raise StorageError(f"its list of entries is longer than {_MAX_PIECE} bytes")
        return piece


def _entries(
    archive: zipfile.ZipFile, kinds: Mapping[str, str], required: Sequence[str], what: str, max_bytes: int
) -> dict[str, zipfile.ZipInfo]:
    entries: dict[str, zipfile.ZipInfo] = {}
    known = f"; it has {', '.join(required)}" + (" and optional arrays" if len(kinds) > len(required) else "")
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name not in kinds or name == entry.filename:
            raise StorageError(f"an {what} has an unknown array {shortened(name)}{known}")
        if name in entries:
            raise StorageError(f"an {what} has the array {name!r} twice")
        if entry.flag_bits & _ENCRYPTED:
            raise StorageError(f"the array {name!r} is encrypted; arrays must be stored without a password")
        if entry.compress_type not in _METHODS:
            raise StorageError(
                f"the array {name!r} must be stored or deflated; its method of compression is number "
                f"{entry.compress_type}"
            )
        entries[name] = entry
    missing = [name for name in required if name not in entries]
    if missing:
        raise StorageError(f"an {what} misses the array {missing[0]!r}{known}")
    total = sum(entry.file_size for entry in entries.values())
    if total > max_bytes:
        raise StorageError(f"its arrays take {total} bytes; max_bytes is {max_bytes}")
    return entries


def _header(archive: zipfile.ZipFile, name: str, entry: zipfile.ZipInfo, allowed: str) -> _Header:
    with archive.open(entry) as stream:
        magic = _exactly(stream, 8, name)
        version = (magic[6], magic[7])
        if magic[:6] != b"\x93NUMPY" or version not in _VERSIONS:
            raise StorageError(f"the array {name!r} is not in NumPy's format")
        width, encoding = _VERSIONS[version]
        length = int.from_bytes(_exactly(stream, width, name), "little")
        if length > _MAX_HEADER:
            raise StorageError(
                f"the header of the array {name!r} takes {length} bytes; at most {_MAX_HEADER} do"
            )
        text = _exactly(stream, length, name).decode(encoding)
    dtype, fortran_order, shape = _description(name, text)
    if dtype.kind not in allowed:
        wanted = " or ".join(dict.fromkeys(_WORDS[kind] for kind in allowed))
        raise StorageError(f"the array {name!r} must hold {wanted}; got {_WORDS.get(dtype.kind, dtype)}")
    n_elements = math.prod(shape)
    begin, size = len(magic) + width + length, n_elements * dtype.itemsize
    if not size or begin + size != entry.file_size:
        raise StorageError(
            f"the array {name!r} of shape {shortened(shape)} must take {shortened(size)} bytes, at least 1; "
            f"got {entry.file_size - begin}"
        )
    return _Header(dtype, fortran_order, shape, n_elements, begin)


def _description(name: str, text: str) -> tuple[np.dtype, bool, tuple[int, ...]]:
    fields = dict(_FIELD.findall(text))
    if _HEADER.fullmatch(text) and len(fields) == 3:
        with suppress(KeyError, TypeError, ValueError):
            shape = tuple(int(n) for n in fields["shape"].strip("()").split(",") if n.strip())
            if len(shape) <= _MAX_DIMENSIONS:
                order = {"True": True, "False": False}[fields["fortran_order"]]
                return np.dtype(fields["descr"].strip("'")), order, shape
    raise StorageError(f"the header of the array {name!r} is not that of a plain array: {shortened(text)}")


def _array(archive: zipfile.ZipFile, name: str, entry: zipfile.ZipInfo, header: _Header) -> np.ndarray:
    flat = np.empty(header.n_elements, header.dtype)
    content, at = flat.view(np.uint8), 0
    with archive.open(entry) as stream:
        _exactly(stream, header.begin, name)
        while at < len(content):
            piece = stream.read(min(_CHUNK, len(content) - at))
            if not piece:
                raise StorageError(f"the array {name!r} ends after {at} of {len(content)} bytes")
            content[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)
    if header.dtype.kind == "b" and content.max() > 1:
        raise StorageError(f"the array {name!r} must hold booleans; it has bytes that are neither 0 nor 1")
    if header.dtype.kind == "U" and flat.view(header.dtype.byteorder + "u4").max() > _LAST_CHARACTER:
        raise StorageError(f"the array {name!r} must hold text; it has numbers that are no characters")
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")


def _exactly(stream: IO[bytes], size: int, name: str) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise StorageError(f"the array {name!r} ends within its header")
    return content
