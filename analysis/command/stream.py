"""Learning from a stream of trajectories into a journal: safe to interrupt, and to run again."""

from __future__ import annotations

import hashlib
import io
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from io import FileIO
from typing import NamedTuple, TypedDict, Unpack

from jaxtyping import Array

from ...inference.journal.journal import Journal, JournalError, Position
from ...inference.journal.locking import Identity
from ...inference.sessions.learner import Learner, SessionInfo
from ...inference.sessions.serialization import demonstration_digest
from ...models.observation.demonstration import (
    DEFAULT_LIMITS,
    DemonstrationError,
    LineLimits,
    Record,
    concatenate,
    read_trajectories,
    too_long,
)
from ...models.process.mdp import TabularMDP
from .quarantine import Line, Quarantine

_PIECE = 1 << 16
_HEAD = 1000
_TAIL = 256


# -- lines ------------------------------------------------------------------------------------------------


def followed(path: str, say: Callable[[str], None], poll_seconds: float = 0.2) -> Iterator[bytes]:
    """Yield pieces of lines of a file that is still being written, without end.

    A file that is replaced (rotated) is read to its end, and then the new one from its start. A file that is
    cut off or written anew is read from its start. Both are said; a line that was incomplete then ends.
    Raises ``OSError``.
    """
    return _followed(open(path, "rb", buffering=0), path, say, poll_seconds)


def _followed(file: FileIO, path: str, say: Callable[[str], None], poll_seconds: float) -> Iterator[bytes]:
    tail, leaving = b"", False
    while True:
        change = ""
        if file.seekable() and _is_rewritten(file, tail):
            change = "was cut off or written anew: reading it from its start"
            file.seek(0)
        elif block := file.read(_PIECE):
            tail, leaving = (tail + block)[-_TAIL:], False
            yield from io.BytesIO(block)
        elif file.seekable() and Identity.of(path) not in (None, Identity.of(file.fileno())):
            if leaving:
                change = "was replaced: the old file is read to its end, reading the new one from its start"
                file.close()
                file = open(path, "rb", buffering=0)  # noqa: SIM115
            else:
                leaving = True  # whoever writes the old file may not have noticed yet
                time.sleep(poll_seconds)
        else:
            time.sleep(poll_seconds)
        if change:
            say(f"{path} {change}")
            if tail and not tail.endswith(b"\n"):
                yield b"\n"
            tail, leaving = b"", False


def _is_rewritten(file: FileIO, tail: bytes) -> bool:
    """Test whether the file has other bytes, or fewer, where it was read."""
    return os.pread(file.fileno(), len(tail), file.tell() - len(tail)) != tail


def read_lines(
    pieces: Iterable[bytes], source: str, limits: LineLimits = DEFAULT_LIMITS, *, skip: bool = False
) -> Iterator[Line]:
    """Join pieces to lines; a piece ends at the end of a line or before it.

    A line has at most ``limits.size`` bytes; a longer one comes out with a fault with ``skip``, otherwise it
    raises :class:`DemonstrationError`.
    """
    line = _Unfinished(Position())
    for piece in pieces:
        line.add(piece, limits.size)
        if line.size > limits.size and not skip:
            raise DemonstrationError(
                f"{source}, line {line.before.records + 1}: {too_long(limits, line.size)}"
            )
        if piece.endswith(b"\n"):
            finished = line.finished(limits)
            yield finished
            line = _Unfinished(finished.position)
    if line.size:
        yield line.finished(limits)


class _Unfinished:
    """A line that is being read: its digest of everything, its beginning in memory."""

    def __init__(self, before: Position) -> None:
        self.before, self.size, self.kept = before, 0, bytearray()
        self._hash = hashlib.sha256(bytes.fromhex(before.digest))
        self._returns = 0  # carriage returns, which count unless the line ends with them

    def add(self, piece: bytes, most: int) -> None:
        if self.size <= most:
            self.kept += piece
        self.size += len(piece.removesuffix(b"\n"))
        body = piece.rstrip(b"\r\n")
        if body:
            for _ in range(self._returns):
                self._hash.update(b"\r")
            self._returns = 0
            self._hash.update(body)
        self._returns += len(piece.removesuffix(b"\n")) - len(body)

    def finished(self, limits: LineLimits) -> Line:
        position = Position(self.before.records + 1, self._hash.hexdigest())
        if self.size > limits.size:
            return Line(
                self.kept[:_HEAD].decode(errors="replace") + "...", position, too_long(limits, self.size)
            )
        try:
            return Line(self.kept.decode(), position)
        except UnicodeDecodeError as error:
            text = self.kept.decode(errors="backslashreplace")
            return Line(text, position, f"not UTF-8 text at byte {error.start + 1}")


def open_lines(
    path: str,
    follow: bool,
    limits: LineLimits = DEFAULT_LIMITS,
    *,
    skip: bool = False,
    say: Callable[[str], None] | None = None,
) -> tuple[Iterator[Line], str]:
    """Open a file, or standard input for ``-``; return its lines and its name in messages.

    ``say`` receives messages about a followed file; the default prints to standard error. Raises ``OSError``;
    the lines are as :func:`read_lines` gives them.
    """
    say = partial(print, file=sys.stderr) if say is None else say
    if path == "-":
        source = "standard input"
        if sys.stdin is None:
            raise ValueError("standard input is closed: give a file with --demonstrations")
        pieces = iter(partial(sys.stdin.buffer.readline, _PIECE), b"")
    else:
        source = os.path.basename(path)
        file = open(path, "rb")  # noqa: SIM115 (read to the end of the process)
        pieces = followed(path, say) if follow else iter(partial(file.readline, _PIECE), b"")
    return read_lines(pieces, source, limits, skip=skip), source


def positioned(lines: Iterable[str | Line]) -> Iterator[Line]:
    """Yield lines with their positions; texts have positions from their number on."""
    here = Position()
    for line in lines:
        line = line if isinstance(line, Line) else Line(line, here.after(line))
        here = line.position
        yield line


def unread(lines: Iterable[Line], journal: Journal) -> Iterator[Line]:
    """Yield the lines that the journal has not learned from.

    Raises :class:`JournalError`, before the first of them, where the earlier lines are not those that were
    learned from.
    """
    consumed = journal.position
    known = {place.records: place for place in (journal.position_after(1), consumed) if place is not None}
    lines, read = iter(lines), 0
    while read < consumed.records:
        line = next(lines, None)
        if line is None:
            raise JournalError(
                f"the input ends after {read} lines, but {consumed.records} were already learned from"
            )
        read = line.position.records
        if (place := known.get(read)) is not None and place.digest and place != line.position:
            raise JournalError(
                f"lines 1 to {read} of the input are not those that were learned from; to learn from another "
                "input, start another journal; of a file that was rotated or written anew, give all "
                "its parts, one after the other"
            )
    yield from lines


# -- sessions ---------------------------------------------------------------------------------------------


class Reading(NamedTuple):
    """The input's name, the limits of its lines, and the file for lines that are set aside."""

    source: str = "input"
    limits: LineLimits = DEFAULT_LIMITS
    quarantine: Quarantine | None = None


class ReadingOptions(TypedDict, total=False):
    """:class:`Reading` as keyword arguments."""

    source: str
    limits: LineLimits
    quarantine: Quarantine | None


def learn_stream(
    learner: Learner,
    lines: Iterable[str | Line],
    journal: Journal,
    key: Array,
    *,
    size: int = 1,
    agent: int | None = None,
    on_session: Callable[[SessionInfo], None] | None = None,
    **reading: Unpack[ReadingOptions],
) -> int:
    """Run a session per ``size`` trajectories of JSON Lines, committing each before the next begins.

    Lines of other agents are passed over; the last session may be shorter. Resumes where the journal left
    off, to the bit: the consumed part is skipped after checking that it is the same input.

    With ``quarantine`` bad lines are set aside there: those that are no trajectory, are beyond ``limits``, or
    hold an observation that the model rules out. A session is then made of the next good lines. If it is not
    known which of a session's trajectories is ruled out, all of its lines are set aside.

    Returns the number of new sessions. Raises ``DemonstrationError`` naming source, line and step, and
    ``JournalError``; every session before the error is in the journal.
    """
    source, _, quarantine = options = Reading(**reading)
    state = learner.init(key) if journal.state is None else journal.state
    lines = unread(positioned(lines), journal)
    records = _Records(lines, learner.mdp, options, journal.position)
    collected: list[tuple[Line, Record]] = []
    done = 0

    def session() -> None:
        nonlocal state, done
        demonstration = concatenate([record.demonstration for _, record in collected])
        try:
            state, report = learner.update(state, demonstration)
        except ValueError as error:
            # The learner counts trajectories within a session; people count lines.
            numbers = [record.line for _, record in collected]
            place = f"line {numbers[0]}" if len(numbers) == 1 else f"session of lines {_listed(numbers)}"
            told = f"{source}, {place}: {error}"
            if quarantine is None or not isinstance(error, DemonstrationError):
                raise type(error)(told) from None
            for line, _ in _ruled_out(collected, error):
                quarantine.add(source, line, told)
            return
        journal.commit(state, report, records.here, demonstration_digest(demonstration))
        collected.clear()
        done += 1
        if on_session is not None:
            on_session(report)

    for line, record in records:
        if agent is None or record.agent is None or record.agent == agent:
            collected.append((line, record))
        if len(collected) == size:
            session()
    while collected:
        session()
    return done


class _Records:
    """The trajectories of good lines, each with its line; ``here`` is the input consumed so far."""

    def __init__(
        self,
        lines: Iterator[Line],
        mdp: TabularMDP,
        reading: Reading,
        here: Position,
    ) -> None:
        self._lines, self._mdp, self.here = lines, mdp, here
        self._source, self._limits, self._quarantine = reading
        self._line, self._broken = Line("", here), False

    def __iter__(self) -> Iterator[tuple[Line, Record]]:
        ended = False
        while not ended:
            texts, first = self._texts(), self.here.records + 1
            try:
                for record in read_trajectories(texts, self._mdp, self._source, first, self._limits):
                    yield self._line, record
                ended = True
            except DemonstrationError as error:
                if self._quarantine is None or self._broken:
                    raise
                self._quarantine.add(self._source, self._line, str(error))

    def _texts(self) -> Iterator[str]:
        while True:
            self._broken = True  # the lines themselves raise, and there are no more after that
            line = next(self._lines, None)
            self._broken = False
            if line is None:
                return
            self._line, self.here = line, line.position
            if self._line.fault:
                raise DemonstrationError(f"{self._source}, line {self.here.records}: {self._line.fault}")
            yield self._line.text


def _ruled_out(collected: list[tuple[Line, Record]], error: Exception) -> list[tuple[Line, Record]]:
    """Take the trajectories of a session that an error is about out of it: one, or all if it names none."""
    found = re.match(r"trajectory (\d+)\b", str(error))
    row = int(found[1]) if found is not None else len(collected)
    named = slice(row, row + 1) if row < len(collected) else slice(None)
    out = collected[named]
    del collected[named]
    return out


def _listed(numbers: list[int]) -> str:
    if len(numbers) > 8:
        return f"{numbers[0]} to {numbers[-1]} ({len(numbers)} trajectories)"
    return ", ".join(str(n) for n in numbers)
