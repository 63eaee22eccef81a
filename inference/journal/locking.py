"""A journal's files: who may write them, and whether they still are the files that were opened.

SQLite's locks on a file belong to the process, and closing any descriptor of that file releases them all. So
the header is read here only while this process has no connection to the file (:func:`header_of`,
:class:`InUse`), and the writer's lock is SQLite's own, on a file beside the journal.
"""

from __future__ import annotations

import os
import platform
import sqlite3
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

HEADER_SIZE = 100


class JournalError(RuntimeError):
    """A journal that cannot be opened, read or written; the message names the file and the reason."""


class JournalBusy(JournalError):
    """Another writer holds the journal."""


def connect(path: Path, mode: str, timeout: float = 10.0) -> sqlite3.Connection:
    """Connect to a file as SQLite's ``mode`` says (``ro``, ``rw`` or ``rwc``)."""
    uri = f"{path.as_uri()}?mode={mode}"
    return sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None, check_same_thread=False)


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Turn SQLite's errors into :class:`JournalError`: ``path`` cannot ``doing``, and why.

    A damaged file also makes SQLite ask for more memory than there is, or quote what is no text.
    """
    try:
        yield
    except (sqlite3.Error, OSError, OverflowError, MemoryError, UnicodeDecodeError) as error:
        raise JournalError(f"{path} cannot {doing}: {error}") from error


# -- files ----------------------------------------------------------------------------------------------


class Identity(NamedTuple):
    """Which file a path leads to: no other file has the same identity while this one is open."""

    device: int
    number: int

    def __str__(self) -> str:
        return f"{self.device}:{self.number}"

    @staticmethod
    def of(path: Path | str | int) -> Identity | None:
        """The identity of an open file, or of the file now at a path; None where there is none."""
        try:
            found = os.stat(path)
        except FileNotFoundError:
            return None
        return Identity(found.st_dev, found.st_ino)


_guard = threading.Lock()
_connections: Counter[Identity | None] = Counter()


class InUse:
    """Notice that this process has a connection to a file, from before it connects until :meth:`release`.

    With ``create`` an empty file is made where there is none. Raises ``OSError``.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        with _guard:
            if create and not path.exists():
                os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o644))
            self._identity = Identity.of(path)
            _connections[self._identity] += 1

    def release(self) -> None:
        """Say that the connection is closed; saying so again does nothing."""
        with _guard:
            _connections[self._identity] -= 1
            self._identity = None


def header_of(path: Path) -> bytes | None:
    """Read a file's first bytes without SQLite, which might recover the file or lock it.

    Returns None where this process has a connection to the file: its header was read before, and reading it
    again would release that connection's locks.
    """
    with _guard:
        found = Identity.of(path)
        if found is not None and _connections[found]:
            return None
        with open(path, "rb") as file:
            return file.read(HEADER_SIZE)


# -- the writer -----------------------------------------------------------------------------------------


class Lock:
    """The writer's exclusive lock on ``<path>-lock``: a file of its own, so that readers are not shut out.

    It is SQLite's own file lock: released by the system with the process, seen by other connections of the
    same process, and there on every system that SQLite runs on. The empty file stays behind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = path.with_name(f"{path.name}-lock")

    def __enter__(self) -> Lock:
        if not self.path.parent.is_dir():
            raise JournalError(f"{self.path} cannot be made: there is no folder {self.path.parent}")
        with explained(self.path, "be locked for writing (is its folder read-only?)"):
            self._connection = connect(self.file, "rwc", timeout=0.0)
            try:
                self._connection.execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as error:
                self._connection.close()
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
                    raise
                raise JournalBusy(
                    f"{self.path} is open for writing in {self._holder()}: one writer at a time; "
                    "Journal.read looks at it without writing"
                ) from None
        self.identity = Identity.of(self.file)
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def release(self) -> None:
        """Let another writer in; releasing again does nothing."""
        self._connection.close()

    def _holder(self) -> str:
        with suppress(sqlite3.Error, OSError, TypeError, ValueError):  # no row yet, or a damaged one
            connection = connect(self.path, "rw")
            try:
                pid, host = connection.execute("SELECT pid, host FROM writer").fetchone()
            finally:
                connection.close()
            here = (pid, host) == (os.getpid(), platform.node())
            return "this process" if here else f"process {int(pid)} on {host:.80}"
        return "another process"
