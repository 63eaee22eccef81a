"""Durable sessions: every session of a learner committed whole to an SQLite file, or not at all.

Guarantees. When :meth:`Journal.commit` returns, the session's info, the learner's state and the consumed part
of the input are on disk together; a process killed at any instant, or a machine that loses power, leaves the
last committed session, never part of one. The file holds every session's info and weights but only the newest
state, so it grows by one info per session.

Storage. SQLite in write-ahead-log mode with ``synchronous=FULL``. The log was chosen over the rollback
journal for two reasons: a person may read (:meth:`Journal.read`) while a learner writes, without either
waiting for the other, and a commit is one flush to the disk. The log needs shared memory between readers and
the writer: put a journal on a local disk, not a network one, and while it is open (or after a kill) move it
together with its ``-wal`` file. A closed journal is one ordinary file. There is one writer at a time: it
holds a lock on ``<path>-lock``, which the system releases when the process ends; the empty lock file stays
behind.

Damage. Every session holds a digest of itself and of the session before it, the first one of the journal's
origin; the state holds the newest digest and the number of sessions. Opening compares the state, the number
of sessions and the newest of them (for writing the newest 1,000). Reading a session compares it with those
beside it, and :meth:`JournalView.verify` compares everything. The digests are not signatures: they reveal
accidents, not forgery.

Versions. Journals of version 1 have no digests. :meth:`Journal.open` adds them, trusting the content;
:meth:`Journal.read` reads such a journal unverified.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sqlite3
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from ...models.inputs.display import shown_briefly
from ...models.inputs.text import shortened
from ..sessions.serialization import DIGEST_SIZE, Leaf, decode, encode, restore
from .locking import (
    HEADER_SIZE,
    Identity,
    InUse,
    JournalBusy,
    JournalError,
    Lock,
    connect,
    explained,
    header_of,
)

if TYPE_CHECKING:
    import arviz

    from ..sessions.learner import Learner

__all__ = ["Journal", "JournalBusy", "JournalError", "JournalView", "Origin", "Position", "SessionRecord"]

APPLICATION_ID = int.from_bytes(b"i2rl", "big")
SCHEMA_VERSION = 2
SESSION_BYTES = 1 << 26
"""Limit of the bytes of weights, info or origin: nothing larger is read into memory, or written."""

RECENT = 1000
"""Sessions that are compared with their digests when a journal is opened for writing."""

_MAGIC = b"SQLite format 3\0"
_UNDO_MAGIC = bytes.fromhex("d9d505f920a163d7")

_SCHEMA = """
CREATE TABLE origin (id INTEGER PRIMARY KEY CHECK (id = 1), content TEXT NOT NULL);
CREATE TABLE session (
    number INTEGER PRIMARY KEY, committed REAL NOT NULL, records INTEGER NOT NULL, digest TEXT NOT NULL,
    demonstration BLOB NOT NULL, state BLOB NOT NULL, chain BLOB NOT NULL, weights BLOB NOT NULL,
    report BLOB NOT NULL
);
"""
_SINCE_VERSION_2 = """
CREATE INDEX session_demonstration ON session (demonstration);
CREATE TABLE writer (
    id INTEGER PRIMARY KEY CHECK (id = 1), pid INTEGER NOT NULL, host TEXT NOT NULL, lock TEXT NOT NULL
);
CREATE TABLE state (
    id INTEGER PRIMARY KEY CHECK (id = 1), session INTEGER NOT NULL, sessions INTEGER NOT NULL,
    chain BLOB NOT NULL, tree BLOB NOT NULL
);
"""
_TO_VERSION_2 = """
DROP TABLE writer;
DROP TABLE state;
ALTER TABLE session ADD COLUMN demonstration BLOB NOT NULL DEFAULT x'';
ALTER TABLE session ADD COLUMN state BLOB NOT NULL DEFAULT x'';
ALTER TABLE session ADD COLUMN chain BLOB NOT NULL DEFAULT x'';
"""


# -- records --------------------------------------------------------------------------------------------


class Position(NamedTuple):
    """Part of the input that a learner has consumed.

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
        """Return the position after one more line."""
        content = bytes.fromhex(self.digest) + line.rstrip("\r\n").encode("utf-8", "surrogatepass")
        return Position(self.records + 1, hashlib.sha256(content).hexdigest())


@shown_briefly
class SessionRecord(NamedTuple):
    """One committed session.

    Fields
    ------
    session : int
        Its number.
    committed : float
        Time in seconds since 1970 (UTC).
    weights : float array
        The learner's weights after it, in the learner's own shape (``[K]`` for one reward).
    info : dict
        The info's fields by name (nested ones as ``outer.inner``), as NumPy values, text or None; a random
        key as its key data.
    position : Position
        The input consumed until then.
    demonstration : bytes
        Digest of its demonstration (:func:`~i2rl.inference.sessions.serialization.demonstration_digest`);
        empty if unknown.
    """

    session: int
    committed: float
    weights: np.ndarray
    info: dict[str, Any]
    position: Position
    demonstration: bytes = b""


class Origin(NamedTuple):
    """Origin of a journal: an MDP, a method and its configuration."""

    method: str
    configuration: dict[str, Any]
    signature: str
    fingerprint: str
    n_states: int
    n_actions: int
    feature_names: tuple[str, ...]

    @staticmethod
    def of(learner: Learner) -> Origin:
        """Return the origin of a journal of this learner."""
        return Origin(
            method=str(learner.name),
            # Through JSON, so that it equals the origin read back.
            configuration=json.loads(
                json.dumps(dict(getattr(learner, "configuration", {})), default=_jsonable)
            ),
            signature=str(learner.signature),
            fingerprint=learner.mdp.fingerprint(),
            n_states=int(learner.mdp.n_states),
            n_actions=int(learner.mdp.n_actions),
            feature_names=tuple(learner.mdp.feature_names),
        )

    @staticmethod
    def parsed(content: str) -> Origin:
        """Parse the origin from JSON. Raises ``ValueError`` naming an invalid part."""
        try:
            fields = json.loads(content)
        except (ValueError, RecursionError):
            raise ValueError("it is not JSON") from None
        if not isinstance(fields, dict) or set(fields) != set(Origin._fields):
            raise ValueError(f"its fields must be {', '.join(Origin._fields)}; got {shortened(fields)}")
        kinds = {"configuration": dict, "n_states": int, "n_actions": int, "feature_names": list}
        for name, value in fields.items():
            if type(value) is not kinds.get(name, str):
                raise ValueError(
                    f"{name} must be of type {kinds.get(name, str).__name__}; got {shortened(value)}"
                )
        names = fields["feature_names"]
        if not all(isinstance(name, str) for name in names):
            raise ValueError(f"feature_names must be text; got {shortened(names)}")
        return Origin(**fields | {"feature_names": tuple(names)})

    def __str__(self) -> str:
        return (
            f"method {self.method!r} on an MDP with {self.n_states} states, {self.n_actions} actions and "
            f"{len(self.feature_names)} features (fingerprint {self.fingerprint[:12]})"
        )

    def difference(self, other: Origin) -> str:
        """Describe the differences of ``other`` in words; empty if there are none."""
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
                parts.append(f"{key} ({_brief(mine)} there, {_brief(theirs)} here)")
        signatures = f"signature {self.signature[:12]} there, {other.signature[:12]} here"
        return ", ".join(parts) or f"configuration ({signatures})"


def _brief(value: object) -> str:
    return (
        str(value) if isinstance(value, bool | int | float) or value is None else shortened(value).strip("'")
    )


def _jsonable(value: object) -> object:
    is_array = isinstance(value, np.generic | np.ndarray | jax.Array)
    return np.asarray(value).tolist() if is_array else repr(value)


# -- rows -----------------------------------------------------------------------------------------------


class _Row(NamedTuple):
    """Stored row of a session."""

    number: int
    committed: float
    records: int
    digest: str
    demonstration: bytes
    state: bytes
    chain: bytes
    weights: bytes
    report: bytes

    @property
    def position(self) -> Position:
        return Position(self.records, self.digest)

    def linked(self, genesis: bytes, previous: bytes) -> bytes:
        """Return the digest that ``chain`` should be, after a session whose digest is ``previous``."""
        digest = hashlib.blake2b(genesis + previous, digest_size=32)
        numbers = struct.pack("<qdq", self.number, self.committed, self.records)
        texts = (self.digest.encode("utf-8", "surrogatepass"), self.demonstration, self.state)
        for part in (numbers, *texts, self.weights, self.report):
            digest.update(struct.pack("<Q", len(part)))
            digest.update(part)
        return digest.digest()


# Type, and the most bytes of a blob. A value of another type or size is replaced by NULL.
_COLUMNS: dict[str, tuple[str, int]] = {
    "number": ("integer", 0),
    "committed": ("real", 0),
    "records": ("integer", 0),
    "digest": ("text", 0),
    "demonstration": ("blob", 64),
    "state": ("blob", 64),
    "chain": ("blob", 64),
    "weights": ("blob", SESSION_BYTES),
    "report": ("blob", SESSION_BYTES),
}


def _selected(columns: Iterable[str], absent: Sequence[str] = ()) -> str:
    parts = []
    for name in columns:
        kind, most = _COLUMNS[name]
        small = f" AND length({name}) <= {most}" if most else ""
        parts.append("x''" if name in absent else f"iif(typeof({name}) = '{kind}'{small}, {name}, NULL)")
    return ", ".join(parts)


def _stamp(tree: bytes) -> bytes:
    """Return the size and the digest of the state after a session."""
    return struct.pack("<Q", len(tree)) + tree[-DIGEST_SIZE:]


# -- the file -------------------------------------------------------------------------------------------


class JournalView:
    """A journal open for reading; from :meth:`Journal.read`.

    Every call reads one consistent moment and takes no lock that a writer waits for, so a view of a running
    learner's journal shows more sessions as they are committed. Close it, or use it as a context manager.
    Use it in one thread at a time.

    Attributes
    ----------
    lacks_log : bool
        True if the file was moved or copied without its ``-wal`` while a learner had it open or after a kill,
        so that sessions may be missing.
    """

    lacks_log = False

    def __init__(self, path: Path, connection: sqlite3.Connection, in_use: InUse) -> None:
        self.path = path
        self._connection = connection
        self._in_use = in_use
        # SQLite then refuses a longer text before it is read; a longer state raises its own error.
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2 * SESSION_BYTES)
        self._version = self._select("PRAGMA user_version")[0][0]
        content = self._single("SELECT iif(typeof(content) = 'text', content, NULL) FROM origin", "origin")[0]
        try:
            self.origin = Origin.parsed(content if isinstance(content, str) else "")
        except ValueError as error:
            raise self._damaged(f"its origin cannot be read: {error}") from None
        self._genesis = hashlib.blake2b(content.encode("utf-8", "surrogatepass"), digest_size=32).digest()
        self._require_agreement()

    @property
    def session(self) -> int:
        """Number of the last committed session; 0 before the first."""
        return self._select("SELECT coalesce(max(number), 0) FROM session")[0][0]

    @property
    def position(self) -> Position:
        """The input consumed by the last committed session."""
        return self.position_after(self.session) or Position()

    def records(self, last: int | None = None) -> Iterator[SessionRecord]:
        """Yield committed sessions in order: all of them, or only the ``last`` few.

        Raises :class:`JournalError` naming a damaged session, or two sessions with a gap between them.
        """
        if last is not None and not (isinstance(last, int) and 0 < last < 2**63):
            raise ValueError(f"`last` must be a positive number of sessions; got {shortened(last)}")
        for row in self._verified(last):
            yield self._record(row)

    @property
    def sessions(self) -> int:
        """Number of stored sessions: less than :attr:`session` if one could not be committed."""
        return self._state().sessions

    def position_after(self, session: int) -> Position | None:
        """Return the input consumed by a session; None if there is no such session."""
        found = self._rows("WHERE number = ?", session)
        return found[0].position if found else None

    def demonstration(self, session: int) -> bytes:
        """Return the digest of a session's demonstration; empty if unknown or if there is no such session."""
        found = self._rows("WHERE number = ?", session)
        return found[0].demonstration if found else b""

    def learned_from(self, demonstration: bytes) -> int | None:
        """Return the first session of a demonstration with this digest; None if there is none."""
        if self._version < 2:
            return None
        query = "SELECT min(number) FROM session WHERE demonstration = ?"
        return self._select(query, demonstration)[0][0]

    def stored_state(self) -> dict[str, Any]:
        """Return the newest state's leaves by name (see :attr:`SessionRecord.info`); empty at first."""
        try:
            return {name: leaf.plain for name, leaf in self._state_leaves().items()}
        except ValueError as error:
            raise self._damaged(f"its state cannot be read: {error}") from None

    def verify(self) -> int:
        """Compare everything with its digest, and check the file's structure; return the number of sessions.

        Raises :class:`JournalError` naming the first damaged part.
        """
        found = self._select("PRAGMA quick_check(1)")[0][0]
        if found != "ok":
            raise self._damaged(shortened(found, 200))
        sessions = sum(1 for _ in self.records())
        self.stored_state()
        return sessions

    def to_inference_data(self) -> arviz.InferenceData:
        """Convert the sessions to ArviZ ``InferenceData`` with one group, ``sessions``.

        Weights are point estimates, one per session, not posterior draws, so there is no group ``posterior``.
        The group holds ``weights`` (session, feature), each field of the info (a field called
        ``weights``, ``committed`` or ``records`` is prefixed ``report_``), ``committed`` (UTC) and
        ``records``. If shapes change from session to session, or a value is None, NaN fills the rest.
        """
        import arviz

        return arviz.InferenceData(sessions=_dataset(list(self.records()), self.origin))

    def to_netcdf(self, filename: str | os.PathLike[str]) -> None:
        """Write :meth:`to_inference_data` as NetCDF, for ``arviz.from_netcdf``.

        Raises ``ValueError`` for a file of the journal itself.
        """
        require_apart("`filename`", filename, *journal_files(self.path))
        self.to_inference_data().to_netcdf(os.fspath(filename), engine="h5netcdf")

    def close(self) -> None:
        """Close the file; closing again does nothing."""
        self._connection.close()
        self._in_use.release()

    def __enter__(self) -> JournalView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _damaged(self, what: str) -> JournalError:
        return JournalError(f"{self.path} is damaged: {what}")

    def _select(self, query: str, *values: object) -> list[tuple]:
        with explained(self.path, "be read"):
            return self._connection.execute(query, values).fetchall()

    def _single(self, query: str, table: str) -> tuple:
        rows = self._select(query)
        if len(rows) != 1:
            raise self._damaged(f"it has {len(rows)} rows of {table} where one belongs")
        return rows[0]

    @contextmanager
    def _moment(self) -> Iterator[None]:
        """Let several queries see the same sessions."""
        if self._connection.in_transaction:
            yield
            return
        with explained(self.path, "be read"), _transaction(self._connection, "BEGIN"):
            yield

    def _rows(self, which: str, *values: object) -> list[_Row]:
        """Read sessions of the right types. Raises :class:`JournalError` naming one with others."""
        absent = ("demonstration", "state", "chain") if self._version < 2 else ()
        rows = self._select(f"SELECT {_selected(_COLUMNS, absent)} FROM session {which}", *values)
        for values in rows:
            for name, value in zip(_COLUMNS, values, strict=True):
                if value is None or (name == "digest" and not _is_hexadecimal(value)):
                    kind, most = _COLUMNS[name]
                    size = f" of at most {most:,} bytes" if most else ""
                    expected = "hexadecimal text" if name == "digest" else f"of type {kind}{size}"
                    raise self._damaged(f"session {values[0]} cannot be read: {name} must be {expected}")
        return [_Row(*values) for values in rows]

    def _verified(self, last: int | None) -> Iterator[_Row]:
        """Yield sessions in order, each compared with the one before it, and the newest with the state."""
        before, chain = 0, self._genesis
        if last is not None:
            for row in self._rows("ORDER BY number DESC LIMIT 1 OFFSET ?", last):
                before, chain = row.number, row.chain
        while True:
            with self._moment():
                rows = self._rows("WHERE number > ? ORDER BY number LIMIT 1", before)
                newest = None if rows else self._state()
            if newest is not None:
                self._require_newest(newest, before, chain)
                return
            row = rows[0]
            if self._version > 1 and row.linked(self._genesis, chain) != row.chain:
                self._record(row)  # raises first if the row's own bytes are damaged
                after = f"session {before}" if before else "the journal's beginning"
                raise self._damaged(
                    f"session {row.number} does not follow {after}: one of them was changed, or one between "
                    "them is missing"
                )
            before, chain = row.number, row.chain
            yield row

    def _record(self, row: _Row) -> SessionRecord:
        try:
            fields = {name: leaf.plain for name, leaf in decode(row.report).items()}
            weights = decode(row.weights)
            if list(weights) != [""]:
                raise ValueError("its weights are not one array")
        except ValueError as error:
            raise self._damaged(f"session {row.number} cannot be read: {error}") from None
        return SessionRecord(
            row.number, row.committed, weights[""].value, fields, row.position, row.demonstration
        )

    def _state(self) -> _Newest:
        """Read the state's summary of the sessions."""
        if self._version < 2:
            rows = self._select("SELECT session, (SELECT count(*) FROM session) FROM state")
            return _Newest(rows[0][0], rows[0][1], b"") if rows else _Newest(0, 0, b"")
        columns = "session, sessions, iif(typeof(chain) = 'blob' AND length(chain) = 32, chain, NULL)"
        newest = _Newest(*self._single(f"SELECT {columns} FROM state", "state"))
        if not (isinstance(newest.session, int) and isinstance(newest.sessions, int) and newest.chain):
            raise self._damaged("its state does not say after which session it is")
        return newest

    def _require_newest(self, newest: _Newest, session: int, chain: bytes) -> None:
        if newest.session != session:
            raise self._damaged(
                f"its state is of session {newest.session}, but its last session is {session}"
            )
        if self._version > 1 and newest.chain != chain:
            raise self._damaged(f"its state is not the one that session {session} led to")

    def _require_agreement(self) -> None:
        """Compare the state, the number of sessions and the newest of them."""
        with self._moment():
            newest = self._state()
            count = self._select("SELECT count(*) FROM session")[0][0]
            if count != newest.sessions:
                raise self._damaged(f"it has {count} sessions, but its state counts {newest.sessions}")
            for _ in self._verified(last=1):
                pass

    def _state_leaves(self) -> dict[str, Leaf]:
        with self._moment():
            newest = self._rows("ORDER BY number DESC LIMIT 1")
            if not newest:
                return {}
            size = self._single("SELECT iif(typeof(tree) = 'blob', length(tree), -1) FROM state", "state")[0]
            if self._version > 1 and (size,) != struct.unpack("<Q", newest[0].state[:8].ljust(8)):
                raise self._damaged(
                    f"the state after session {newest[0].number} has another size than it had"
                )
            with self._any_length():
                tree = self._select("SELECT tree FROM state")[0][0]
        try:
            if self._version > 1 and _stamp(tree) != newest[0].state:
                raise ValueError("it is another state")
            return decode(tree)
        except (ValueError, TypeError) as error:
            message = f"the state after session {newest[0].number} cannot be read: {error}"
            raise self._damaged(message) from None

    @contextmanager
    def _any_length(self) -> Iterator[None]:
        """Let SQLite read or write a state, which may be longer than a session."""
        before = self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2**31 - 1)
        try:
            yield
        finally:
            self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, before)


class _Newest(NamedTuple):
    """Summary in the state: its session, the number of sessions, and the digest of the last."""

    session: int
    sessions: int
    chain: bytes


class Journal(JournalView):
    """A learner's journal, open for writing; from :meth:`open`.

    Attributes
    ----------
    state : NamedTuple or None
        The learner's state after the last committed session, to the bit; None before the first, when
        learning starts from ``learner.init(key)``.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, in_use: InUse, lock: Lock) -> None:
        super().__init__(path, connection, in_use)
        self._lock = lock
        self._newest = self._state()
        self.state: Any = None
        self._files: dict[Path, Identity | None] = {}

    @staticmethod
    def open(path: str | os.PathLike[str], learner: Learner) -> Journal:
        """Open the journal of this learner; create the file if there is none.

        Raises :class:`JournalBusy` if another writer has it open, and :class:`JournalError` if the file is
        not a journal (it stays unchanged), was made by a newer version, belongs to another MDP, method or
        configuration, is damaged, or cannot be read or written.
        """
        if not hasattr(learner, "signature"):
            raise TypeError(
                f"`learner` must be a learner such as lme_i2rl(mdp, sensor); got {shortened(learner)}"
            )
        path = journal_files(path)[0]
        _refuse_foreign(path)
        with ExitStack() as opened:
            lock = opened.enter_context(Lock(path))
            with explained(path, "be opened for writing"):
                in_use = InUse(path, create=True)
                opened.callback(in_use.release)
                connection = connect(path, "rw")
                opened.callback(connection.close)
                connection.execute("PRAGMA synchronous=FULL")
                connection.execute("PRAGMA fullfsync=ON")  # macOS: its plain flush does not reach the disk
                origin = Origin.of(learner)
                if _is_empty(connection):
                    _create(connection, origin)
                _require_readable(connection, path)
                view = JournalView(path, connection, in_use)
                if difference := view.origin.difference(origin):
                    raise JournalError(
                        f"{path} is a journal of {view.origin}, but this learner is {origin}; "
                        f"what differs: {difference}"
                    )
                for _ in view._verified(last=RECENT):
                    pass
                state = _restored_state(view, learner)
                # Only here, so that a refused journal stays unchanged.
                _require_alone(connection, lock)
                if view._version < SCHEMA_VERSION:
                    _migrate(view)
                connection.execute("PRAGMA journal_mode=WAL")
                writer = (os.getpid(), platform.node(), str(lock.identity))
                connection.execute("INSERT OR REPLACE INTO writer VALUES (1, ?, ?, ?)", writer)
                journal = Journal(path, connection, in_use, lock)
            opened.pop_all()
        journal.state = state
        files = (path, *(path.with_name(path.name + suffix) for suffix in ("-wal", "-shm")))
        journal._files = {file: Identity.of(file) for file in files} | {lock.file: lock.identity}
        return journal

    @staticmethod
    def read(path: str | os.PathLike[str]) -> JournalView:
        """Open a journal for reading, also while a writer runs and without its learner.

        Raises :class:`JournalError` if there is no journal, it was made by a newer version, or is damaged.
        """
        path = journal_files(path)[0]
        if not path.exists():
            raise JournalError(f"{path} does not exist")
        _refuse_foreign(path)
        with explained(path, "be read"), ExitStack() as opened:
            lacks_log = _lacks_log(path)
            in_use = InUse(path)
            opened.callback(in_use.release)
            # Writable, so that SQLite can first undo what a killed writer left half done.
            connection = connect(path, "rw")
            opened.callback(connection.close)
            connection.execute("PRAGMA query_only=ON")
            if _is_empty(connection):
                raise JournalError(
                    f"{path} is empty: no learner has begun in it, or it was ended as it began"
                )
            _require_readable(connection, path)
            view = JournalView(path, connection, in_use)
            view.lacks_log = lacks_log
            opened.pop_all()
            return view

    def commit(
        self, state: Any, info: Any, position: Position | None = None, demonstration: bytes = b""
    ) -> None:
        """Commit one session: all of it is durable when this returns.

        Parameters
        ----------
        state : NamedTuple
            The learner's state after the session, with ``weights`` and the session's number in ``session``.
        info : NamedTuple
            The session's info.
        position : Position, optional
            The input consumed so far; by default unchanged.
        demonstration : bytes, optional
            Digest of the session's demonstration, which identifies it later.

        Raises
        ------
        ValueError
            If the session is already committed (its number is not above :attr:`session`), or its weights or
            info are larger than :data:`SESSION_BYTES`.
        JournalError
            If it could not be written (a full disk, say), or the file was deleted, replaced or written to by
            another program. Earlier sessions are unchanged, and the same session, or a later one, may be
            committed once the cause is gone; a session never committed is missing from the history, though
            not from the state.
        """
        session, last = int(state.session), self._newest.session
        if session <= last:
            raise ValueError(f"{self.path}: session {session} is already committed (the last is {last})")
        weights, tree, told = encode(np.asarray(state.weights)), encode(state), encode(info)
        if max(len(weights), len(told)) > SESSION_BYTES:
            raise ValueError(
                f"weights and info of a session must have at most {SESSION_BYTES:,} bytes each; got "
                f"{len(weights):,} and {len(told):,}"
            )
        records, digest = self.position if position is None else position
        row = _Row(session, time.time(), records, digest, demonstration, _stamp(tree), b"", weights, told)
        row = row._replace(chain=row.linked(self._genesis, self._newest.chain))
        newest = _Newest(session, self._newest.sessions + 1, row.chain)
        kept = f"what was committed up to session {last} is safe" if last else "nothing was committed before"
        with (
            explained(self.path, f"take session {session} ({kept})"),
            self._any_length(),
            _transaction(self._connection),
        ):
            self._require_undisturbed(session)
            columns = ", ".join(_Row._fields)
            self._connection.execute(
                f"INSERT INTO session ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row
            )
            self._connection.execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?, ?, ?)", (*newest, tree))
        self._newest = newest
        self.state = state

    def close(self) -> None:
        """Fold the log into the file and release the lock; closing again does nothing."""
        with suppress(sqlite3.Error):  # with a reader, or on a full disk, the log stays, as durable
            self._connection.execute("PRAGMA busy_timeout=0")
            # SQLite deletes the log by its name, which after a replacement belongs to another writer.
            if not self._displaced():
                self._connection.execute("PRAGMA journal_mode=DELETE")
        super().close()
        self._lock.release()

    def __enter__(self) -> Journal:
        return self

    def _displaced(self) -> list[Path]:
        """List the files that are no longer the ones that were opened."""
        return [file for file, identity in self._files.items() if Identity.of(file) != identity]

    def _require_undisturbed(self, session: int) -> None:
        """Refuse a commit that would vanish with a deleted file, or mix with another writer's."""
        if displaced := self._displaced():
            raise JournalError(
                f"{displaced[0]} was deleted or replaced while its journal was open: session {session} was "
                f"not committed; {self._newest.session} sessions were before"
            )
        if self._state() != self._newest:
            raise JournalError(
                f"{self.path} was written to by another program: session {session} was not committed; this "
                f"writer's last is {self._newest.session}"
            )


def _is_hexadecimal(text: Any) -> bool:
    with suppress(ValueError):
        return isinstance(text, str) and len(text) <= 128 and len(bytes.fromhex(text)) * 2 == len(text)
    return False


def _restored_state(view: JournalView, learner: Learner) -> Any:
    leaves = view._state_leaves()
    if not leaves:
        return None
    try:
        state = restore(leaves, learner.init(jax.random.key(0)))
        number = int(state.session)
    except (TypeError, ValueError) as error:
        message = f"{view.path}: the stored state is not one of method {learner.name!r}: {error}"
        raise JournalError(message) from error
    if number != view.session:
        raise view._damaged(
            f"its state says that it is of session {number}, its last session is {view.session}"
        )
    return state


@contextmanager
def _transaction(connection: sqlite3.Connection, begin: str = "BEGIN IMMEDIATE") -> Iterator[None]:
    connection.execute(begin)
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:  # a failed write may have ended it already
            connection.execute("ROLLBACK")
        raise


def _run(connection: sqlite3.Connection, statements: str) -> None:
    for statement in statements.split(";"):
        connection.execute(statement)


def _is_empty(connection: sqlite3.Connection) -> bool:
    return not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]


def _create(connection: sqlite3.Connection, origin: Origin) -> None:
    # Before the switch to the log, so that the file's header identifies it at once.
    content = json.dumps(origin._asdict())
    genesis = hashlib.blake2b(content.encode(), digest_size=32).digest()
    with _transaction(connection):
        _run(connection, _SCHEMA + _SINCE_VERSION_2)
        connection.execute("INSERT INTO origin VALUES (1, ?)", (content,))
        connection.execute("INSERT INTO state VALUES (1, 0, 0, ?, x'')", (genesis,))
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")


def _migrate(view: JournalView) -> None:
    """Add the digests of version 2 to version 1, computed from the content."""
    connection, newest = view._connection, view._state()
    with view._any_length(), _transaction(connection):
        tree = connection.execute("SELECT coalesce(max(tree), x'') FROM state").fetchone()[0]
        _run(connection, _TO_VERSION_2 + _SINCE_VERSION_2)
        connection.execute("INSERT INTO state VALUES (1, ?, ?, ?, ?)", (*newest, tree))
        chain = view._genesis
        for row in view._verified(None):
            row = row._replace(state=_stamp(tree) if row.number == newest.session else b"")
            chain = row.linked(view._genesis, chain)
            connection.execute(
                "UPDATE session SET state = ?, chain = ? WHERE number = ?", (row.state, chain, row.number)
            )
        connection.execute("UPDATE state SET chain = ?", (chain,))
        connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")


def _require_alone(connection: sqlite3.Connection, lock: Lock) -> None:
    """Refuse a journal that another writer has open under a lock file other than the one just locked.

    The last writer recorded its lock file. If it is another one, holding this lock proves nothing, and SQLite
    decides whether another connection exists: it leaves the log mode only for a connection that is alone.
    """
    if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
        return
    with suppress(sqlite3.Error):
        if connection.execute("SELECT lock FROM writer").fetchone() == (str(lock.identity),):
            return
    with suppress(sqlite3.OperationalError):
        if connection.execute("PRAGMA journal_mode=DELETE").fetchone()[0] != "wal":
            return
    raise JournalBusy(
        f"{lock.path} is open elsewhere, and its lock file is not the one that it was opened with: somebody "
        "deleted or moved it; close what has the journal open"
    )


def journal_files(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return every file that belongs to the journal at a path: itself, its log, and its lock.

    Raises :class:`JournalError` for a path that cannot be resolved (a circle of links, a name too long).
    """
    try:
        path = Path(path).resolve()
        path.exists()
    except (OSError, RuntimeError, ValueError) as error:
        raise JournalError(f"{shortened(os.fspath(path))} cannot be read: {error}") from None
    return (path, *(path.with_name(path.name + suffix) for suffix in ("-wal", "-shm", "-journal", "-lock")))


def require_apart(argument: str, given: str | os.PathLike[str], *others: str | os.PathLike[str]) -> None:
    """Raise ``ValueError`` for an output file that is another file in use, by whatever name."""
    wanted = Path(given)
    for other in map(Path, others):
        same = other.exists() and wanted.exists() and wanted.samefile(other)
        if same or wanted.resolve() == other.resolve():
            raise ValueError(f"{argument} must be a file of its own; got {wanted}, which is {other}")


def _lacks_log(path: Path) -> bool:
    """Return whether a journal was last closed during writing, and its log is not beside it."""
    if not path.exists() or path.with_name(path.name + "-wal").exists():
        return False
    header = header_of(path) or b""
    return header[18:20] == b"\x02\x02"


def _refuse_foreign(path: Path) -> None:
    """Refuse a file that is not a readable journal before anything is written to it or next to it."""
    if path.exists() and not path.is_file():
        raise JournalError(f"{path} is not a file")
    if not path.exists():
        return
    with explained(path, "be read as a journal of learning sessions"):
        header = header_of(path)
    if not header:
        return
    if (len(header) < HEADER_SIZE and _MAGIC.startswith(header[: len(_MAGIC)])) or not any(header):
        with suppress(OSError), open(path.with_name(f"{path.name}-journal"), "rb") as undo:
            if undo.read(len(_UNDO_MAGIC)) == _UNDO_MAGIC:
                return  # the first write to a new file was cut short, as by a full disk: SQLite will undo it
    if len(header) < HEADER_SIZE or not header.startswith(_MAGIC):
        raise JournalError(f"{path} cannot be read as a journal of learning sessions: it is no SQLite file")
    version, application = (int.from_bytes(header[at : at + 4], "big") for at in (60, 68))
    _require_ours(application, version, path)


def _require_readable(connection: sqlite3.Connection, path: Path) -> None:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    _require_ours(application, connection.execute("PRAGMA user_version").fetchone()[0], path)
    # Views and triggers could compute without end, or change committed rows.
    query = "SELECT type, name FROM sqlite_master WHERE type IN ('view', 'trigger')"
    if (found := connection.execute(query).fetchone()) is not None:
        raise JournalError(f"{path} is damaged: it has the {found[0]} {shortened(found[1])}")


def _require_ours(application: int, version: int, path: Path) -> None:
    if application != APPLICATION_ID:
        raise JournalError(f"{path} is not a journal of learning sessions")
    if not 1 <= version <= SCHEMA_VERSION:
        raise JournalError(
            f"{path} was written by a newer i2rl (journal version {version}; this one reads up to "
            f"{SCHEMA_VERSION}): update i2rl to use it"
        )


# -- export ---------------------------------------------------------------------------------------------


def _dataset(records: Sequence[SessionRecord], origin: Origin) -> Any:
    import xarray

    reserved = {"weights", "committed", "records", "session", "feature"}
    names = dict.fromkeys(name for record in records for name in record.info)
    columns: dict[str, Sequence[Any]] = {
        "weights": [record.weights for record in records],
        "committed": [np.datetime64(int(record.committed * 1e9), "ns") for record in records],
        "records": [record.position.records for record in records],
    }
    for name in names:
        column = f"report_{name}" if name in reserved else name.replace(".", "_")
        columns[column] = [record.info.get(name) for record in records]
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
    """Stack one array ``[session, ...]``, NaN (or an empty text) for sessions with fewer entries."""
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
