"""Durable sessions: every session of a learner committed whole to an SQLite file, or not at all.

What is promised. When :meth:`Journal.commit` returns, the session's report, the learner's state and how much
of the input it had consumed are on disk together; a process killed at any instant, or a machine that loses
power, leaves the last committed session, never part of one. The file keeps every session's report and
weights but only the newest state, so it grows by one report a session.

How. SQLite in write-ahead-log mode with ``synchronous=FULL``. The log was chosen over the rollback journal
because a person may look (:meth:`Journal.read`) while a learner writes without either waiting for the other,
and because a commit is one flush to the disk.
The log's price is shared memory between readers and the writer: keep a journal on a local disk, not a network
one, and while it is open (or after a kill) move it together with its ``-wal`` file. A closed journal is one
ordinary file. One writer at a time: it holds a lock on ``<path>-lock``, which the system releases when the
process ends, however it ends; the empty lock file stays behind.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from .serialization import Leaf, decode, encode, restore

if TYPE_CHECKING:
    import arviz

    from .session import Learner

APPLICATION_ID = int.from_bytes(b"i2rl", "big")
SCHEMA_VERSION = 1

_SCHEMA = """
CREATE TABLE origin (id INTEGER PRIMARY KEY CHECK (id = 1), content TEXT NOT NULL);
CREATE TABLE writer (id INTEGER PRIMARY KEY CHECK (id = 1), pid INTEGER NOT NULL, host TEXT NOT NULL);
CREATE TABLE session (
    number INTEGER PRIMARY KEY, committed REAL NOT NULL, weights BLOB NOT NULL, report BLOB NOT NULL,
    records INTEGER NOT NULL, digest TEXT NOT NULL
);
CREATE TABLE state (id INTEGER PRIMARY KEY CHECK (id = 1), session INTEGER NOT NULL, tree BLOB NOT NULL);
"""


class JournalError(RuntimeError):
    """A journal that cannot be opened, read or written; the message names the file and the reason."""


class JournalBusy(JournalError):
    """Another writer holds the journal."""


# -- what is kept ---------------------------------------------------------------------------------------


class Position(NamedTuple):
    """How much of the input a learner has consumed.

    Fields
    ------
    records : int
        Records (lines of a file, blank ones included) from its beginning.
    digest : str
        Running digest of them, each line's end excluded; empty at the beginning.
    """

    records: int = 0
    digest: str = ""

    def after(self, line: str) -> Position:
        """The position once one more line is consumed."""
        content = bytes.fromhex(self.digest) + line.rstrip("\r\n").encode("utf-8", "surrogatepass")
        return Position(self.records + 1, hashlib.sha256(content).hexdigest())

    def unread(self, lines: Iterable[str]) -> Iterator[str]:
        """The lines not consumed yet.

        Raises :class:`JournalError`, before the first of them, where the earlier lines are not those that
        were consumed.
        """
        lines = iter(lines)
        here = Position()
        while here.records < self.records:
            line = next(lines, None)
            if line is None:
                raise JournalError(
                    f"the input ends after {here.records} lines, but {self.records} were already learned from"
                )
            here = here.after(line)
        if self.digest and here.digest != self.digest:
            raise JournalError(
                f"the first {self.records} lines of the input are not those that were learned from; "
                "to learn from another input, start another journal"
            )
        yield from lines


class SessionRecord(NamedTuple):
    """One committed session.

    Fields
    ------
    session : int
        Its number.
    committed : float
        When, in seconds since 1970 (UTC).
    weights : float array
        The learner's weights after it, in the learner's own shape (``[K]`` for one reward).
    report : dict
        The report's fields by name (nested ones as ``outer.inner``), as NumPy values, text or None; a random
        key as its key data.
    position : Position
        The input consumed by then.
    """

    session: int
    committed: float
    weights: np.ndarray
    report: dict[str, Any]
    position: Position


class Origin(NamedTuple):
    """What a journal was made for: an MDP, a method and its configuration."""

    method: str
    configuration: dict[str, Any]
    signature: str
    fingerprint: str
    n_states: int
    n_actions: int
    feature_names: tuple[str, ...]

    @staticmethod
    def of(learner: Learner) -> Origin:
        """The origin a journal of this learner has."""
        return Origin(
            method=str(learner.name),
            # Through JSON, so that it equals what is read back.
            configuration=json.loads(
                json.dumps(dict(getattr(learner, "configuration", {})), default=_jsonable)
            ),
            signature=str(learner.signature),
            fingerprint=learner.mdp.fingerprint(),
            n_states=int(learner.mdp.n_states),
            n_actions=int(learner.mdp.n_actions),
            feature_names=tuple(learner.mdp.feature_names),
        )

    def __str__(self) -> str:
        return (
            f"method {self.method!r} on an MDP with {self.n_states} states, {self.n_actions} actions and "
            f"{len(self.feature_names)} features (fingerprint {self.fingerprint[:12]})"
        )

    def difference(self, other: Origin) -> str:
        """In words, what of ``other`` is not as here; empty if nothing."""
        if self.signature == other.signature and self.fingerprint == other.fingerprint:
            return ""
        parts = [
            word
            for word, a, b in (
                ("MDP", self.fingerprint, other.fingerprint),
                ("method", self.method, other.method),
            )
            if a != b
        ]
        for key in sorted(self.configuration.keys() | other.configuration.keys()):
            mine, theirs = self.configuration.get(key, "absent"), other.configuration.get(key, "absent")
            if mine != theirs:
                parts.append(f"{key} ({mine} there, {theirs} here)")
        signatures = f"signature {self.signature[:12]} there, {other.signature[:12]} here"
        return ", ".join(parts) or f"configuration ({signatures})"


def _jsonable(value: object) -> object:
    is_array = isinstance(value, np.generic | np.ndarray | jax.Array)
    return np.asarray(value).tolist() if is_array else repr(value)


# -- the file -------------------------------------------------------------------------------------------


class JournalView:
    """A journal as it stands, for looking at; from :meth:`Journal.read`.

    Every call reads one consistent moment and takes no lock that a writer waits for, so a view of a running
    learner's journal shows more sessions as they are committed. Close it, or use it as a context manager.
    One thread at a time.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        content = json.loads(self._select("SELECT content FROM origin")[0][0])
        self.origin = Origin(**content | {"feature_names": tuple(content["feature_names"])})

    @property
    def session(self) -> int:
        """Number of the last committed session; 0 before the first."""
        return self._select("SELECT coalesce(max(number), 0) FROM session")[0][0]

    @property
    def position(self) -> Position:
        """The input consumed by the last committed session."""
        rows = self._select("SELECT records, digest FROM session ORDER BY number DESC LIMIT 1")
        return Position(*rows[0]) if rows else Position()

    def reports(self) -> Iterator[SessionRecord]:
        """Every committed session, in order. Raises :class:`JournalError` naming one that is damaged."""
        columns = "number, committed, weights, report, records, digest"
        for number, committed, weights, report, *position in self._select(
            f"SELECT {columns} FROM session ORDER BY number"
        ):
            try:
                fields = {name: leaf.plain for name, leaf in decode(report).items()}
                yield SessionRecord(number, committed, decode(weights)[""].value, fields, Position(*position))
            except ValueError as error:
                raise JournalError(f"{self.path}: session {number} cannot be read: {error}") from error

    def stored_state(self) -> dict[str, Any]:
        """The newest state's leaves by name (as in :attr:`SessionRecord.report`); empty before the first."""
        return {name: leaf.plain for name, leaf in self._state_leaves().items()}

    def to_inference_data(self) -> arviz.InferenceData:
        """The sessions as ArviZ ``InferenceData`` with one group, ``sessions``.

        Weights are point estimates, one a session, and not draws from anything, so they are no ``posterior``.
        The group holds ``weights`` (session, feature), each field of the report (one that is called
        ``weights``, ``committed`` or ``records`` is prefixed ``report_``), ``committed`` (UTC) and
        ``records``. Where shapes change from session to session, or a value is None, NaN fills the rest.
        """
        import arviz

        return arviz.InferenceData(sessions=_dataset(list(self.reports()), self.origin))

    def to_netcdf(self, filename: str | os.PathLike[str]) -> None:
        """Write :meth:`to_inference_data` as NetCDF, to be read by ``arviz.from_netcdf``."""
        self.to_inference_data().to_netcdf(os.fspath(filename), engine="h5netcdf")

    def close(self) -> None:
        """Close the file; closing again does nothing."""
        self._connection.close()

    def __enter__(self) -> JournalView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _select(self, query: str) -> list[tuple]:
        with _explained(self.path, "be read"):
            return self._connection.execute(query).fetchall()

    def _state_leaves(self) -> dict[str, Leaf]:
        rows = self._select("SELECT session, tree FROM state")
        try:
            return decode(rows[0][1]) if rows else {}
        except ValueError as error:
            message = f"{self.path}: the state after session {rows[0][0]} cannot be read: {error}"
            raise JournalError(message) from error


class Journal(JournalView):
    """A learner's journal, open for writing; from :meth:`open`.

    Attributes
    ----------
    state : NamedTuple or None
        The learner's state after the last committed session, to the bit; None before the first, when
        learning starts from ``learner.init(key)``.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: _Lock, state: Any) -> None:
        super().__init__(path, connection)
        self._lock = lock
        self.state = state

    @staticmethod
    def open(path: str | os.PathLike[str], learner: Learner) -> Journal:
        """Open the journal of this learner, making the file if there is none.

        Raises :class:`JournalBusy` where another writer has it open, and :class:`JournalError` where the file
        is no journal (it is left as it was), was made by a newer version, belongs to another MDP, method or
        configuration, or cannot be read or written.
        """
        path = Path(path).resolve()
        _refuse_foreign(path)
        with ExitStack() as opened:
            lock = opened.enter_context(_Lock(path))
            with _explained(path, "be opened for writing"):
                connection = _connect(path, "rwc")
                opened.callback(connection.close)
                connection.execute("PRAGMA synchronous=FULL")
                connection.execute("PRAGMA fullfsync=ON")  # macOS: its plain flush stops short of the disk
                origin = Origin.of(learner)
                if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                    _create(connection, origin)
                _require_readable(connection, path)
                view = JournalView(path, connection)
                if difference := view.origin.difference(origin):
                    raise JournalError(
                        f"{path} is a journal of {view.origin}, but this learner is {origin}; "
                        f"what differs: {difference}"
                    )
                state = _restored_state(view, learner)
                # Not before here, so that a journal that is refused stays as it was.
                connection.execute("PRAGMA journal_mode=WAL")
                writer = (os.getpid(), platform.node())
                connection.execute("INSERT OR REPLACE INTO writer VALUES (1, ?, ?)", writer)
            opened.pop_all()
            return Journal(path, connection, lock, state)

    @staticmethod
    def read(path: str | os.PathLike[str]) -> JournalView:
        """Open a journal for looking at, also while a writer runs and without knowing its learner.

        Raises :class:`JournalError` where there is no journal or it was made by a newer version.
        """
        path = Path(path).resolve()
        if not path.exists():
            raise JournalError(f"{path} does not exist")
        _refuse_foreign(path)
        with _explained(path, "be read"), ExitStack() as opened:
            # Not opened read-only: what a killed writer left half done is then undone before it is read.
            connection = _connect(path, "rw")
            opened.callback(connection.close)
            connection.execute("PRAGMA query_only=ON")
            _require_readable(connection, path)
            view = JournalView(path, connection)
            opened.pop_all()
            return view

    def commit(self, state: Any, report: Any, position: Position | None = None) -> None:
        """Commit one session: durable, all of it, when this returns.

        Parameters
        ----------
        state : NamedTuple
            The learner's state after the session, with ``weights`` and the session's number in ``session``.
        report : NamedTuple
            The session's report.
        position : Position, optional
            The input consumed so far; by default what it was.

        Raises
        ------
        ValueError
            The session is already committed: its number is not above :attr:`session`.
        JournalError
            It could not be written (a full disk, say). What was committed before is as it was, and the same
            session, or a later one, may be committed once the cause is gone; a session that never was is
            missing from the history, though not from the state.
        """
        session, last = int(state.session), self.session
        if session <= last:
            raise ValueError(f"{self.path}: session {session} is already committed (the last is {last})")
        records, digest = self.position if position is None else position
        weights, tree = encode(np.asarray(state.weights)), encode(state)
        row = (session, time.time(), weights, encode(report), records, digest)
        kept = f"what was committed up to session {last} is safe" if last else "nothing was committed before"
        with _explained(self.path, f"take session {session} ({kept})"), _transaction(self._connection):
            self._connection.execute("INSERT INTO session VALUES (?, ?, ?, ?, ?, ?)", row)
            self._connection.execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?)", (session, tree))
        self.state = state

    def close(self) -> None:
        """Fold the log into the file and release the lock; closing again does nothing."""
        with suppress(sqlite3.Error):  # with a reader there, or a full disk, the log stays, as durable
            self._connection.execute("PRAGMA busy_timeout=0")
            self._connection.execute("PRAGMA journal_mode=DELETE")
        self._connection.close()
        self._lock.release()

    def __enter__(self) -> Journal:
        return self


class _Lock:
    """The writer's exclusive lock, held on a file of its own so that readers are not shut out.

    It is SQLite's own file lock: released by the system with the process, seen by other connections of the
    same process, and there on every system that SQLite runs on.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> _Lock:
        if not self.path.parent.is_dir():
            raise JournalError(f"{self.path} cannot be made: there is no folder {self.path.parent}")
        with _explained(self.path, "be locked for writing (is its folder read-only?)"):
            lock = _connect(self.path.with_name(self.path.name + "-lock"), "rwc", timeout=0.0)
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as error:
                lock.close()
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
                    raise
                raise JournalBusy(
                    f"{self.path} is open for writing in {self._holder()}: one writer at a time; "
                    "Journal.read looks at it without writing"
                ) from None
        self._connection = lock
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def release(self) -> None:
        self._connection.close()

    def _holder(self) -> str:
        with suppress(sqlite3.Error, TypeError):  # TypeError: no row, as it is still being made
            connection = _connect(self.path, "rw")
            try:
                pid, host = connection.execute("SELECT pid, host FROM writer").fetchone()
            finally:
                connection.close()
            here = (pid, host) == (os.getpid(), platform.node())
            return "this process" if here else f"process {pid} on {host}"
        return "another process"


def _connect(path: Path, mode: str, timeout: float = 10.0) -> sqlite3.Connection:
    uri = f"{path.as_uri()}?mode={mode}"
    return sqlite3.connect(uri, uri=True, timeout=timeout, isolation_level=None, check_same_thread=False)


@contextmanager
def _explained(path: Path, doing: str) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise JournalError(f"{path} cannot {doing}: {error}") from error


def _restored_state(view: JournalView, learner: Learner) -> Any:
    leaves = view._state_leaves()
    if not leaves:
        return None
    try:
        return restore(leaves, learner.init(jax.random.key(0)))
    except ValueError as error:
        message = f"{view.path}: the stored state is not one of method {learner.name!r}: {error}"
        raise JournalError(message) from error


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:  # a failed write may have ended it already
            connection.execute("ROLLBACK")
        raise


def _create(connection: sqlite3.Connection, origin: Origin) -> None:
    # Before the file is switched to the log, so that its very header tells what it is.
    with _transaction(connection):
        for statement in _SCHEMA.split(";"):
            connection.execute(statement)
        connection.execute("INSERT INTO origin VALUES (1, ?)", (json.dumps(origin._asdict()),))
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")


def _refuse_foreign(path: Path) -> None:
    """Refuse a file that is not a readable journal before anything is written to it or next to it."""
    if path.exists() and not path.is_file():
        raise JournalError(f"{path} is not a file")
    if not path.exists() or not path.stat().st_size:
        return
    with _explained(path, "be read as a journal of learning sessions"):
        # Immutable: SQLite then neither locks, nor recovers, nor makes a file.
        connection = _connect(path, "ro&immutable=1")
        try:
            _require_readable(connection, path)
        finally:
            connection.close()


def _require_readable(connection: sqlite3.Connection, path: Path) -> None:
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise JournalError(f"{path} is not a journal of learning sessions")
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > SCHEMA_VERSION:
        raise JournalError(
            f"{path} was written by a newer i2rl (journal version {version}; this one reads up to "
            f"{SCHEMA_VERSION}): update i2rl to use it"
        )


# -- export ---------------------------------------------------------------------------------------------


def _dataset(records: Sequence[SessionRecord], origin: Origin) -> Any:
    import xarray

    reserved = {"weights", "committed", "records", "session", "feature"}
    names = dict.fromkeys(name for record in records for name in record.report)
    columns: dict[str, Sequence[Any]] = {
        "weights": [record.weights for record in records],
        "committed": [np.datetime64(int(record.committed * 1e9), "ns") for record in records],
        "records": [record.position.records for record in records],
    }
    for name in names:
        column = f"report_{name}" if name in reserved else name.replace(".", "_")
        columns[column] = [record.report.get(name) for record in records]
    variables = {}
    for column, values in columns.items():
        array = _stacked(values)
        dims = ["session", *(f"{column}_dim_{i}" for i in range(array.ndim - 1))]
        if column == "weights" and array.shape[1:] and array.shape[-1] == len(origin.feature_names):
            dims[-1] = "feature"
        variables[column] = (dims, array)
    return xarray.Dataset(
        variables,
        coords={"session": [record.session for record in records], "feature": list(origin.feature_names)},
        attrs={
            "method": origin.method,
            "configuration": json.dumps(origin.configuration),
            "signature": origin.signature,
            "mdp_fingerprint": origin.fingerprint,
        },
    )


def _stacked(values: Sequence[Any]) -> np.ndarray:
    """One array ``[session, ...]``, NaN (or an empty text) where a session has less than another."""
    if not values:
        return np.zeros(0)
    present = [np.asarray(value) for value in values if value is not None]
    if not present:
        return np.full(len(values), np.nan)
    if any(array.dtype.kind in "US" for array in present):
        return np.array(["" if value is None else str(value) for value in values])
    if len(present) == len(values) and len({array.shape for array in present}) == 1:
        return np.stack(present)
    width = max(array.ndim for array in present)
    padded = [array.reshape((1,) * (width - array.ndim) + array.shape) for array in present]
    shape = np.max([array.shape for array in padded], axis=0, initial=0) if width else ()
    stacked = np.full((len(values), *shape), np.nan, np.result_type(float, *padded))
    rows = [row for row, value in enumerate(values) if value is not None]
    for row, array in zip(rows, padded, strict=True):
        corner = tuple(slice(size) for size in array.shape)
        stacked[row][corner] = array
    return stacked
