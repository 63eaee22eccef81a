"""Quarantine of a stream's bad lines, with their reasons, so that learning can continue.

A line is on disk before the journal's position moves past it, so a kill loses none. A digest identifies a
line that comes again because its session was never committed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from ...inference.journal.journal import Position

_BEGINNING = b'{"digest": "'
_PIECE = 1 << 16
_LONGEST_REASON = 1000


class Line(NamedTuple):
    """A line of an input.

    Fields
    ------
    text : str
        Its text; of one that is too long the beginning.
    position : Position
        The input consumed once the line is.
    fault : str
        Reason why the line is bad; empty for a good line.
    """

    text: str
    position: Position
    fault: str = ""


class Quarantine:
    """A JSON Lines file of bad lines: ``digest``, ``source``, ``line`` (its number), ``reason`` and ``text``.

    Attributes
    ----------
    lines : int
        Lines in the file.
    added : int
        Lines that were added by this object.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the file, making it if there is none.

        Raises ``ValueError`` for a file with other content, and ``OSError``.
        """
        self.path = Path(path)
        self.added = 0
        self._digests: set[bytes] = set()
        self._file = open(self.path, "a+b", buffering=0)  # noqa: SIM115 (open until the process ends)
        self._read()
        _flush_folder(self.path.parent)

    @property
    def lines(self) -> int:
        """Lines in the file."""
        return len(self._digests)

    def add(self, source: str, line: Line, reason: str) -> None:
        """Add a line, on disk on return; a line that is there already is added once."""
        digest = bytes.fromhex(line.position.digest)
        if digest in self._digests:
            return
        entry = {"digest": digest.hex(), "source": source, "line": line.position.records}
        content = (
            json.dumps(
                entry | {"reason": reason[:_LONGEST_REASON], "text": line.text.rstrip("\r\n")}
            ).encode()
            + b"\n"
        )
        while content:
            content = content[self._file.write(content) :]
        os.fsync(self._file.fileno())
        self._digests.add(digest)
        self.added += 1

    def _read(self) -> None:
        """Collect the digests, and cut off a line that a kill or a full disk left half written."""
        self._file.seek(0)
        with open(self._file.fileno(), "rb", closefd=False) as file:
            start = 0
            while piece := file.readline(_PIECE):
                if not piece.startswith(_BEGINNING[: len(piece)]):
                    raise ValueError(
                        f"{self.path} is not a quarantine of lines: its byte {start + 1} begins another"
                    )
                digest, whole = piece[len(_BEGINNING) :][:64], piece
                while not whole.endswith(b"\n") and (whole := file.readline(_PIECE)):
                    pass
                if not whole:
                    self._file.truncate(start)
                    return
                self._digests.add(_digest(digest, self.path))
                start = file.tell()


def _digest(text: bytes, path: Path) -> bytes:
    try:
        return bytes.fromhex(text.decode("ascii"))
    except ValueError:
        raise ValueError(f"{path} is not a quarantine of lines: it has {text!r} for a digest") from None


def _flush_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
