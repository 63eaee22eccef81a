"""Learning from a stream of trajectories into a journal: safe to interrupt, and to run again."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import IO

from jaxtyping import Array

from ..inference.journal import Journal, Position
from ..inference.session import Learner, Report
from ..models.demonstration import (
    Demonstration,
    DemonstrationError,
    Record,
    concatenate,
    read_trajectories,
)
from ..models.mdp import TabularMDP


def follow_lines(file: IO[bytes], poll_seconds: float = 0.2) -> Iterator[bytes]:
    """Lines of a file that is still being written, as they become complete; never ends by itself."""
    partial = b""
    while True:
        piece = file.readline()
        if not piece:
            time.sleep(poll_seconds)
            continue
        partial += piece
        if partial.endswith(b"\n"):
            yield partial
            partial = b""


def batches(
    lines: Iterable[str], mdp: TabularMDP, position: Position, size: int, agent: int | None, source: str
) -> Iterator[tuple[Demonstration, Position, list[int]]]:
    """Sessions of ``size`` trajectories of one agent, the input's position after each, and their lines.

    ``lines`` start after ``position``. Lines of other agents are passed over. An incomplete last session
    is yielded when the input ends.
    """
    here = position

    def counted() -> Iterator[str]:
        nonlocal here
        for line in lines:
            here = here.after(line)
            yield line

    collected: list[Record] = []

    def session() -> tuple[Demonstration, Position, list[int]]:
        return concatenate([r.demonstration for r in collected]), here, [r.line for r in collected]

    for record in read_trajectories(counted(), mdp, source, first_line=position.records + 1):
        if agent is None or record.agent is None or record.agent == agent:
            collected.append(record)
        if len(collected) == size:
            yield session()
            collected = []
    if collected:
        yield session()


def learn_stream(
    learner: Learner,
    lines: Iterable[str],
    journal: Journal,
    key: Array,
    *,
    size: int = 1,
    agent: int | None = None,
    source: str = "input",
    on_session: Callable[[Report], None] | None = None,
) -> int:
    """Run a session per ``size`` trajectories of JSON Lines, committing each before the next begins.

    Resumes where the journal left off, to the bit: what was consumed is skipped after checking that it is
    the same input. Returns the number of new sessions. Raises ``DemonstrationError`` naming source, line
    and step, and ``JournalError``; every session before the error is in the journal.
    """
    position = journal.position
    state = learner.init(key) if journal.state is None else journal.state
    done = 0
    unread = position.unread(lines)
    for demonstration, after, numbers in batches(unread, learner.mdp, position, size, agent, source):
        try:
            state, report = learner.update(state, demonstration)
        except ValueError as error:
            # The learner counts trajectories within a session; a person looks for lines.
            place = f"line {numbers[0]}" if len(numbers) == 1 else f"session of lines {_listed(numbers)}"
            raise type(error)(f"{source}, {place}: {error}") from None
        journal.commit(state, report, after)
        done += 1
        if on_session is not None:
            on_session(report)
    return done


def _listed(numbers: list[int]) -> str:
    if len(numbers) > 8:
        return f"{numbers[0]} to {numbers[-1]} ({len(numbers)} trajectories)"
    return ", ".join(str(n) for n in numbers)


def open_lines(path: str, follow: bool) -> tuple[Iterable[str], str]:
    """Lines of a file, or of standard input for ``-``, and the name to call it in messages.

    Raises ``FileNotFoundError``; the lines raise ``DemonstrationError`` naming one that is not UTF-8.
    """
    if path == "-":
        return _decoded(sys.stdin.buffer, "standard input"), "standard input"
    file = open(path, "rb")  # noqa: SIM115 (read to the end of the process)
    source = os.path.basename(path)
    return _decoded(follow_lines(file) if follow else file, source), source


def _decoded(lines: Iterable[bytes], source: str) -> Iterator[str]:
    """Text line by line, after the line is complete: a character may be half written at the end of a file."""
    for number, line in enumerate(lines, start=1):
        try:
            text = line.decode()
        except UnicodeDecodeError as error:
            raise DemonstrationError(
                f"{source}, line {number}: not UTF-8 text at byte {error.start + 1}"
            ) from None
        yield text
