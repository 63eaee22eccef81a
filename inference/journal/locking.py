"""Locks on a journal's files, and checks that they are still the files that were opened.

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
    """A journal that another writer holds."""


def connect(path: Path, mode: str, timeout: float = 10.0) -> sqlite3.Connection:
    """Connect to a file in SQLite's ``mode`` (``ro``, ``rw`` or ``rwc``)."""
    uri = f"{path.as_uri()}?mode={mode}"
    return sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None, check_same_thread=False)


@contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Turn SQLite's errors into :class:`JournalError`: ``path`` cannot ``doing``, and why.

    A damaged file may also make SQLite ask for too much memory, or quote invalid text.
    """
    try:
        yield
    except (sqlite3.Error, OSError, OverflowError, MemoryError, UnicodeDecodeError) as error:
        raise JournalError(f"{path} cannot {doing}: {error}") from error


# -- files ----------------------------------------------------------------------------------------------


class Identity(NamedTuple):
    """Identity of a file: no other file has the same one while this one is open."""

    device: int
    number: int

    def __str__(self) -> str:
        return f"{self.device}:{self.number}"

    @staticmethod
    def of(path: Path | str | int) -> Identity | None:
        """Return the identity of an open file, or of the file now at a path; None if there is none."""
        try:
            found = os.stat(path)
        except FileNotFoundError:
            return None
        return Identity(found.st_dev, found.st_ino)


_guard = threading.Lock()
_connections: Counter[Identity | None] = Counter()


class InUse:
    """Record that this process has a connection to a file, from before it connects until :meth:`release`.

    With ``create`` an empty file is made if there is none. Raises ``OSError``.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        with _guard:
            if create and not path.exists():
                os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o644))
            self._identity = Identity.of(path)
            _connections[self._identity] += 1

    def release(self) -> None:
        """Record that the connection is closed; repeated calls do nothing."""
        with _guard:
            _connections[self._identity] -= 1
            self._identity = None


def header_of(path: Path) -> bytes | None:
    """Read a file's first bytes without SQLite, which might recover the file or lock it.

    Returns None if this process has a connection to the file: its header was read before, and reading it
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
    """The writer's exclusive lock on ``<path>-lock``, a separate file, so that readers can connect.

    It is SQLite's own file lock: the system releases it with the process, other connections of the same
    process see it, and every system that runs SQLite has it. The empty file stays behind.
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
        """Release the lock; releasing again does nothing."""
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
