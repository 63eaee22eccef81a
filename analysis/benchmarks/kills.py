"""Killed at any instant, ``i2rl learn`` loses nothing: python -m i2rl.analysis.benchmarks.kills.

A stream is learned from start to end several times over, each time (a life) into a journal of its own. The
process is killed with SIGKILL again and again and started again with the same command, until the stream is
learned. In the end every journal has to hold the bits of one that was written without interruption, and
after each kill a copy of what is on disk has to hold whole sessions, all that were reported among them, with
those very bits.

A kill at a uniformly random time would nearly always hit the start, which takes seconds where a session takes
milliseconds. So a life's kills are shared out over the phases, and are uniform in time within each:

- starting: interpreter, imports, opening the journal, loading compiled code;
- compiling: as a first run does, without the cache of compiled code that the other starts share;
- sessions: at most two sessions' time after a random session, so that planning, solving, committing and
  reporting are all met as often as they take time;
- closing: after the last session, and once more in a run that finds nothing left to do.

A kill ends the process and not the system: what power loss leaves is SQLite's matter and not measured here.
"""

from __future__ import annotations

import argparse
import os
import select
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...inference.journal import Journal
from .harness import print_table, publish

PHASES = ("starting", "compiling", "sessions", "closing")
# Kills of a life; the first meets an empty journal, and the last a finished one.
SHARES = {"starting": 5, "compiling": 2, "sessions": 11, "closing": 2}

# A process that ends before its instant, as one that is closing may, is tried again so often at most.
ATTEMPTS = 4


class Instant(NamedTuple):
    """When to kill: ``seconds`` after the start, or ``delay`` after as many reports."""

    seconds: float
    reports: float
    delay: float


class Ended(NamedTuple):
    """How a process ended: whether it was killed, its reports until then, and what it took in seconds.

    ``first`` and ``last`` are the times of its first and last report, NaN if there was none.
    """

    killed: bool
    reports: int
    first: float
    last: float
    seconds: float


class Kill(NamedTuple):
    """One kill: the phase it was meant for, the sessions reported by this process, committed, and before it.

    ``problem`` says in words what a copy of the journal, taken right after the kill, had wrong.
    """

    phase: str
    life: int
    seconds: float
    before: int
    reports: int
    committed: int
    problem: str


class Survival(NamedTuple):
    """What became of a stream that was learned under kills.

    Fields
    ------
    kills : tuple of Kill
    sessions : int
        Sessions of the stream.
    problems : tuple of str
        Everything that was not as without kills; empty if all is well.
    seconds : float
        Of all of it.
    """

    kills: tuple[Kill, ...]
    sessions: int
    problems: tuple[str, ...]
    seconds: float


class Content(NamedTuple):
    """A journal in bytes: ``sessions`` (number, weights, position in the input, report), and the state."""

    sessions: list[tuple]
    state: list[tuple]


NEVER = Instant(np.inf, np.inf, 0.0)


def content(path: Path) -> Content:
    """Everything in a journal but the clock's readings, in bytes."""
    with Journal.read(path) as view:
        sessions = [
            (
                record.session,
                record.weights.tobytes(),
                tuple(record.position),
                [(k, np.asarray(v).tobytes()) for k, v in record.report.items() if k != "seconds"],
            )
            for record in view.reports()
        ]
        state = [(name, str(value.dtype), value.tobytes()) for name, value in _arrays(view.stored_state())]
        return Content(sessions, [(view.session, state)] if state else [])


def _arrays(leaves: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    return ((name, np.asarray("" if value is None else value)) for name, value in leaves.items())


def run_until(command: Sequence[str], environment: Mapping[str, str], instant: Instant) -> Ended:
    """Start the command, which prints a line a session, and kill it at an instant unless it ends before.

    Raises ``RuntimeError`` with what it said if it fails by itself.
    """
    began = time.monotonic()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(command, env=dict(environment), stdout=subprocess.PIPE, stderr=said)
        assert child.stdout is not None
        output = child.stdout.fileno()
        reports, first, last, talking = 0, np.nan, np.nan, True

        def read_for(seconds: float) -> None:
            nonlocal reports, first, last, talking
            if not select.select([output], [], [], min(max(seconds, 0.0), 60.0))[0]:
                return
            chunk = os.read(output, 1 << 16)
            talking = bool(chunk)
            if lines := chunk.count(b"\n"):
                last = time.monotonic() - began
                first = last if reports == 0 else first
                reports += lines

        while (
            talking and reports < instant.reports and (left := began + instant.seconds - time.monotonic()) > 0
        ):
            read_for(left)
        if reports >= instant.reports:
            time.sleep(instant.delay)
        if instant != NEVER:
            child.kill()
        while talking:
            read_for(60.0)
        status = child.wait()
        seconds = time.monotonic() - began
        if status not in (0, -9):
            said.seek(0)
            raise RuntimeError(f"it failed with status {status}: {said.read().decode()[-2000:]}")
    return Ended(status == -9, reports, first, last, seconds)


def survive(
    arguments: Sequence[str],
    folder: Path,
    kills: int,
    *,
    seed: int = 0,
    shares: Mapping[str, int] = SHARES,
) -> Survival:
    """Run ``i2rl learn ARGUMENTS --journal ...`` under so many kills, and compare with learning in peace.

    ``folder`` takes journals and compiled code; every ``sum(shares)`` kills go to a life of their own.
    """
    began = time.monotonic()
    rng = np.random.default_rng(seed)
    cold = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    warm = cold | {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }

    def command(journal: Path) -> list[str]:
        tail = ["--journal", str(journal), "--json"]
        return [sys.executable, "-m", "i2rl.analysis.cli", "learn", *arguments, *tail]

    # In peace, compiling everything; once more to fill the cache, and again to time a start that uses it.
    compiled = run_until(command(folder / "peace.db"), cold, NEVER)
    peace = content(folder / "peace.db")
    total = len(peace.sessions)
    if compiled.reports != total or not total:
        raise RuntimeError(f"{compiled.reports} sessions were reported, but {total} are in the journal")
    problems = []
    for name in ("filling.db", "cached.db"):
        cached = run_until(command(folder / name), warm, NEVER)
        if content(folder / name) != peace:
            problems.append(f"without kills, {name} differs from the first run")
    session = (cached.last - cached.first) / max(total - 1, 1)
    closing = cached.seconds - cached.last
    idle = run_until(command(folder / "cached.db"), warm, NEVER).seconds

    def instant(phase: str, left: int, kills_ahead: int) -> Instant:
        if phase == "starting":
            return Instant(rng.uniform(0, cached.first), 1, 0.0)
        if phase == "compiling":
            return Instant(rng.uniform(cached.first, compiled.first), 1, rng.uniform(0, 2 * session))
        if phase == "sessions":  # far enough on average to come to the end with the last of them
            reports = int(rng.integers(1, max(2, 2 * left // (kills_ahead + 1))))
            return Instant(np.inf, min(reports, left), rng.uniform(0, 2 * session))
        if left:
            return Instant(np.inf, left, rng.uniform(0, closing))
        return Instant(rng.uniform(0.5, 1) * idle, np.inf, 0.0)

    done: list[Kill] = []
    life = 0
    while len(done) < kills:
        life += 1
        journal = folder / f"life-{life}.db"
        plan = list(rng.permutation([p for p in shares if p != "closing" for _ in range(shares[p])]))
        plan += ["closing"] * shares["closing"]
        plan, committed = plan[: kills - len(done)], 0
        for i, phase in enumerate(plan):
            for _ in range(ATTEMPTS):
                when = instant(phase, total - committed, plan[i:].count("sessions"))
                ended = run_until(command(journal), cold if phase == "compiling" else warm, when)
                found = _copied(journal, folder)
                before, committed = committed, len(found.sessions)
                if ended.killed:
                    problem = _problem(found, peace, before, ended.reports)
                    done.append(Kill(phase, life, ended.seconds, before, ended.reports, committed, problem))
                    break
        run_until(command(journal), warm, NEVER)
        if content(journal) != peace:
            problems.append(f"life {life} ended with another journal than learning in peace")
    problems += [f"kill {i + 1} ({k.phase}): {k.problem}" for i, k in enumerate(done) if k.problem]
    return Survival(tuple(done), total, tuple(problems), time.monotonic() - began)


def _copied(journal: Path, folder: Path) -> Content:
    """What is on disk, read from a copy, so that the next process itself meets what the kill left."""
    copy = folder / "copy.db"
    for suffix in ("", "-wal", "-shm", "-journal"):
        copy.with_name(copy.name + suffix).unlink(missing_ok=True)
        source = journal.with_name(journal.name + suffix)
        if suffix != "-shm" and source.exists():
            shutil.copy(source, copy.with_name(copy.name + suffix))
    if not copy.exists() or not _begun(copy):
        return Content([], [])
    return content(copy)


def _begun(path: Path) -> bool:
    """Whether the journal's tables are there: the process may have been killed before it had made them."""
    connection = sqlite3.connect(path)
    try:
        return bool(connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0])
    finally:
        connection.close()


def _problem(found: Content, peace: Content, before: int, reports: int) -> str:
    committed = len(found.sessions)
    if [s[0] for s in found.sessions] != list(range(1, committed + 1)):
        return "its sessions are not numbered 1, 2, ..."
    if committed < before + reports:
        return f"{before + reports} sessions were reported, only {committed} are there"
    if found.sessions != peace.sessions[:committed]:
        return "its sessions differ from those learned in peace"
    if [s for s, _ in found.state] != ([committed] if committed else []):
        return "its state is not that of the last session"
    return ""


def _table(kills: Sequence[Kill], sessions: int) -> list[tuple]:
    """By phase: where the kills hit, how many between commit and report, and sessions committed by then."""
    rows: list[tuple] = []
    for phase in PHASES:
        these = [k for k in kills if k.phase == phase]
        if not these:
            continue
        rows.append(
            (
                phase,
                len(these),
                sum(k.committed == k.before and k.committed < sessions for k in these),
                sum(k.before < k.committed < sessions for k in these),
                sum(k.committed == sessions for k in these),
                sum(k.committed > k.before + k.reports for k in these),
                f"{min(k.committed for k in these)} - {max(k.committed for k in these)}",
            )
        )
    return rows


def main() -> None:
    """Run, publish, and fail if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--sessions", type=int, default=400, help="lines of the stream, a session each")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stream = folder / "stream.jsonl"
        cli = [sys.executable, "-m", "i2rl.analysis.cli"]
        simulate = [*cli, "simulate", "patrol", "--instance", "2", "--sessions", str(options.sessions)]
        with stream.open("w") as file:
            subprocess.run(simulate, stdout=file, check=True)
        arguments = ["--mdp", "patrol2", "--agent", "0", "--demos", str(stream)]
        survival = survive(arguments, folder, options.kills, seed=options.seed)
    kills, sessions = survival.kills, survival.sessions
    columns = ("meant for", "kills", "no new session", "mid-stream", "all learned", "unreported", "sessions")
    print_table(f"{len(kills)} kills of a learner of {sessions} sessions", columns, _table(kills, sessions))
    for problem in survival.problems:
        print(f"PROBLEM: {problem}")
    if not survival.problems:
        print("Every journal equals an uninterrupted run's to the bit: no session was lost or repeated.")
    results: dict[str, Any] = {
        "kills": len(kills),
        "sessions": sessions,
        "lives": kills[-1].life,
        "problems": list(survival.problems),
        "seconds": survival.seconds,
        "each": [k._asdict() for k in kills],
    }
    publish("kills", results)
    if survival.problems:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
