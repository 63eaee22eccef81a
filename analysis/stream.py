"""Learning from a stream of trajectories into a journal: safe to interrupt, and to run again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from typing import IO, Any

from jaxtyping import Array

from ..inference.journal import Journal, Position
from ..inference.session import Learner, Report
from ..models.demonstration import concatenate, read_trajectories
from ..models.mdp import TabularMDP


def follow_lines(file: IO[str], poll_seconds: float = 0.2) -> Iterator[str]:
    """Lines of a file that is still being written, as they become complete; never ends by itself."""
    partial = ""
    while True:
        piece = file.readline()
        if not piece:
            time.sleep(poll_seconds)
            continue
        partial += piece
        if partial.endswith("\n"):
            yield partial
            partial = ""


def batches(
    lines: Iterable[str], mdp: TabularMDP, position: Position, size: int, agent: int | None, source: str
) -> Iterator[tuple[Any, Position]]:
    """Sessions of ``size`` trajectories of one agent, each with the input's position after it.

    ``lines`` start after ``position``. Lines of other agents are passed over. An incomplete last session
    is yielded when the input ends.
    """
    here = position

    def counted() -> Iterator[str]:
        nonlocal here
        for line in lines:
            here = here.after(line)
            yield line

    collected = []
    for record in read_trajectories(counted(), mdp, source, first_line=position.records + 1):
        if agent is None or record.agent is None or record.agent == agent:
            collected.append(record.demonstration)
        if len(collected) == size:
            yield concatenate(collected), here
            collected = []
    if collected:
        yield concatenate(collected), here


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
    for demonstration, after in batches(unread, learner.mdp, position, size, agent, source):
        try:
            state, report = learner.update(state, demonstration)
        except ValueError as error:
            # The learner counts trajectories within a session; a person looks for lines.
            where = f"{source}, session ending at line {after.records}"
            raise type(error)(f"{where}: {error}") from None
        journal.commit(state, report, after)
        done += 1
        if on_session is not None:
            on_session(report)
    return done


def open_lines(path: str, follow: bool) -> tuple[Iterable[str], str]:
    """Lines of a file, or of standard input for ``-``, and the name to call it in messages.

    Raises ``FileNotFoundError``.
    """
    import sys

    if path == "-":
        return sys.stdin, "standard input"
    file = open(path, encoding="utf-8")  # noqa: SIM115 (read to the end of the process)
    return (follow_lines(file) if follow else file), os.path.basename(path)
