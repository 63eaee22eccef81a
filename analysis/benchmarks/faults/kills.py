"""Kills of ``i2rl learn`` at any instant, without loss: python -m i2rl.analysis.benchmarks.faults.kills.

A stream is learned from start to end several times over, each time (a life) into a journal of its own. The
process is killed with SIGKILL again and again and started again with the same command, until the stream is
learned. In the end every journal has to hold the bits of one that was written without interruption, and after
each kill a copy of the files on disk has to hold whole sessions, all printed ones among them, with the same
bits.

A kill at a uniformly random time would nearly always hit the start, which takes seconds where a session takes
milliseconds. So a life's kills are shared out over the phases, and are uniform in time within each:

- starting: interpreter, imports, opening the journal, loading compiled code;
- compiling: as a first run does, without the cache of compiled code that the other starts share;
- sessions: at most two sessions' time after a random session, so that kills meet planning, solving,
  committing and printing in proportion to their time;
- closing: after the last session, and once more in a run without remaining sessions.

Processes may be forked from one that has imported everything: a kill then costs about half of the time, and
none of them meets the imports, during which no file is open.

A kill ends the process and not the system: power loss is SQLite's concern and not measured here.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ....inference.journal.journal import Journal
from ..harness import print_table, publish

PHASES = ("starting", "compiling", "sessions", "closing")
# Kills of a life; the first meets an empty journal, and the last a finished one.
SHARES = {"starting": 5, "compiling": 2, "sessions": 11, "closing": 2}

# A process that ends before its instant, as one that is closing may, is tried again so often at most.
ATTEMPTS = 4


class Instant(NamedTuple):
    """Instant of a kill: ``seconds`` after the start, or ``delay`` after as many lines of output."""

    seconds: float
    reports: float
    delay: float


class Ended(NamedTuple):
    """End of a process: whether it was killed, its lines of output until then, and its seconds.

    ``first`` and ``last`` are the times of its first and last line of output, NaN if there was none.
    """

    killed: bool
    reports: int
    first: float
    last: float
    seconds: float


class Kill(NamedTuple):
    """Kill: its intended phase, the sessions printed by this process, committed, and before it.

    ``problem`` describes the fault of a copy of the journal, taken right after the kill.
    """

    phase: str
    life: int
    seconds: float
    before: int
    reports: int
    committed: int
    problem: str


class Survival(NamedTuple):
    """Outcome of a stream that was learned under kills.

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
    """Journal in bytes: ``sessions`` (number, weights, position in the input, info), and the state."""

    sessions: list[tuple]
    state: list[tuple]


NEVER = Instant(np.inf, np.inf, 0.0)


def content(path: Path) -> Content:
    """Return everything in a journal but the clock's times, in bytes."""
    with Journal.read(path) as view:
        sessions = [
            (
                record.session,
                record.weights.tobytes(),
                tuple(record.position),
                [(k, np.asarray(v).tobytes()) for k, v in record.info.items() if k != "seconds"],
            )
            for record in view.records()
        ]
        state = [(name, str(value.dtype), value.tobytes()) for name, value in _arrays(view.stored_state())]
        return Content(sessions, [(view.session, state)] if state else [])


def _arrays(leaves: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    return ((name, np.asarray("" if value is None else value)) for name, value in leaves.items())


# -- processes --------------------------------------------------------------------------------------------


class Started(Protocol):
    """Running learner: its output, a line a session, and a handle to kill it."""

    @property
    def output(self) -> int:
        """The descriptor to read that from."""

    def kill(self) -> None:
        """End it with SIGKILL."""

    def wait(self) -> tuple[int, str]:
        """Return its exit status and its standard error."""


Start = Callable[[Sequence[str], bool], Started]
"""Starts ``i2rl`` with arguments, with the cache of compiled code or without."""


class _Process:
    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 (open until it has been read)
        self._child = subprocess.Popen(
            command, env=dict(environment), stdout=subprocess.PIPE, stderr=self._said
        )
        assert self._child.stdout is not None
        self.output = self._child.stdout.fileno()

    def kill(self) -> None:
        self._child.kill()

    def wait(self) -> tuple[int, str]:
        status = self._child.wait()
        self._child.communicate()
        self._said.seek(0)
        return status, self._said.read().decode()


def processes(compiled: Path) -> Start:
    """Start a process of its own each time; ``compiled`` is the folder of the cache."""
    cold = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    warm = cold | {name.upper(): str(value) for name, value in _cache(compiled).items()}

    def start(arguments: Sequence[str], cached: bool) -> Started:
        return _Process(
            [sys.executable, "-m", "i2rl.analysis.command.app", *arguments], warm if cached else cold
        )

    return start


def _cache(folder: Path) -> dict[str, Any]:
    return {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }


class Forks:
    """Processes forked from one that has imported everything, before any computation."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._server = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.kills", "--serve", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={k: v for k, v in os.environ.items() if not k.startswith("JAX_")},
        )

    def start(self, arguments: Sequence[str], cached: bool) -> Started:
        """Start as :data:`Start` says; one process at a time."""
        pipe = self._folder / "pipe"
        pipe.unlink(missing_ok=True)
        os.mkfifo(pipe)
        assert self._server.stdin is not None
        pid = int(self._asked(json.dumps([list(arguments), cached])))
        return _Fork(os.open(pipe, os.O_RDONLY), pid, self._folder / "said", lambda: self._asked(""))

    def _asked(self, line: str) -> str:
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(line + "\n")
        self._server.stdin.flush()
        return self._server.stdout.readline()

    def __enter__(self) -> Forks:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.communicate()


class _Fork(NamedTuple):
    output: int
    pid: int
    said: Path
    status: Callable[[], str]

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> tuple[int, str]:
        os.close(self.output)
        return int(self.status()), self.said.read_text()


def _serve(folder: Path) -> None:
    """Fork a learner for each request on standard input: print its process, and when it ends its status."""
    import i2rl.analysis.command.stream
    import i2rl.inference.learners.lme
    import i2rl.models.observation.storage  # noqa: F401

    while request := sys.stdin.readline():
        arguments, cached = json.loads(request)
        if pid := os.fork():
            print(pid, flush=True)
            sys.stdin.readline()  # until the last kill: its number is its own until it is reaped
            print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
            continue
        _become(folder, arguments, cached)


def _become(folder: Path, arguments: Sequence[str], cached: bool) -> None:
    """Be the command from here on."""
    import jax

    from ...command.app import main as command

    os.dup2(os.open(folder / "said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(folder / "pipe", os.O_WRONLY), 1)
    for name, value in _cache(folder / "compiled").items() if cached else ():
        jax.config.update(name, value)
    sys.argv = ["i2rl", *arguments]
    status = 1
    try:
        command()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.stdout.flush()
        os._exit(status)


def run_until(learner: Started, instant: Instant, began: float) -> Ended:
    """Let a learner run, and kill it at an instant unless it ends before.

    Raises ``RuntimeError`` with its message if it fails by itself.
    """
    reports, first, last, talking = 0, np.nan, np.nan, True

    def read_for(seconds: float) -> None:
        nonlocal reports, first, last, talking
        if not select.select([learner.output], [], [], min(max(seconds, 0.0), 60.0))[0]:
            return
        chunk = os.read(learner.output, 1 << 16)
        talking = bool(chunk)
        if lines := chunk.count(b"\n"):
            last = time.monotonic() - began
            first = last if reports == 0 else first
            reports += lines

    while talking and reports < instant.reports and (left := began + instant.seconds - time.monotonic()) > 0:
        read_for(left)
    if reports >= instant.reports:
        time.sleep(instant.delay)
    if instant != NEVER:
        learner.kill()
    while talking:
        read_for(60.0)
    status, said = learner.wait()
    seconds = time.monotonic() - began
    if status not in (0, -9):
        raise RuntimeError(f"it failed with status {status}: {said[-2000:]}")
    return Ended(status == -9, reports, first, last, seconds)


# -- lives ------------------------------------------------------------------------------------------------


def survive(
    arguments: Sequence[str],
    folder: Path,
    kills: int,
    *,
    seed: int = 0,
    shares: Mapping[str, int] = SHARES,
    forked: bool = False,
) -> Survival:
    """Run ``i2rl learn ARGUMENTS --journal ...`` under so many kills, and compare with learning in peace.

    ``folder`` takes journals and compiled code; every ``sum(shares)`` kills go to a life of their own. With
    ``forked`` the processes are :class:`Forks`.
    """
    with ExitStack() as stack:
        start = stack.enter_context(Forks(folder)).start if forked else processes(folder / "compiled")
        return _survive(start, arguments, folder, kills, np.random.default_rng(seed), shares)


def _survive(
    start: Start,
    arguments: Sequence[str],
    folder: Path,
    kills: int,
    rng: np.random.Generator,
    shares: Mapping[str, int],
) -> Survival:
    began = time.monotonic()

    def run(journal: Path, instant: Instant = NEVER, cached: bool = True) -> Ended:
        before = time.monotonic()
        learner = start(["learn", *arguments, "--journal", str(journal), "--json"], cached)
        return run_until(learner, instant, before)

    # In peace, compiling everything for the cache; again to time a start that uses it, and one without it.
    first = run(folder / "peace.db")
    peace = content(folder / "peace.db")
    total = len(peace.sessions)
    if first.reports != total or not total:
        raise RuntimeError(f"{first.reports} sessions were printed, but {total} are in the journal")
    problems = []
    cached = run(folder / "cached.db")
    compiled = run(folder / "compiled.db", cached=False) if shares.get("compiling") else cached
    for name in ("cached.db", *(["compiled.db"] if shares.get("compiling") else [])):
        if content(folder / name) != peace:
            problems.append(f"without kills, {name} differs from the first run")
    session = (cached.last - cached.first) / max(total - 1, 1)
    closing = cached.seconds - cached.last
    idle = run(folder / "cached.db").seconds

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
        plan = [
            str(p) for p in rng.permutation([p for p in shares if p != "closing" for _ in range(shares[p])])
        ]
        plan += ["closing"] * shares["closing"]
        plan, committed = plan[: kills - len(done)], 0
        for i, phase in enumerate(plan):
            for _ in range(ATTEMPTS):
                when = instant(phase, total - committed, plan[i:].count("sessions"))
                ended = run(journal, when, cached=phase != "compiling")
                found = _copied(journal, folder)
                before, committed = committed, len(found.sessions)
                if ended.killed:
                    problem = _problem(found, peace, before, ended.reports)
                    done.append(Kill(phase, life, ended.seconds, before, ended.reports, committed, problem))
                    break
        run(journal)
        if content(journal) != peace:
            problems.append(f"life {life} ended with another journal than learning in peace")
    problems += [f"kill {i + 1} ({k.phase}): {k.problem}" for i, k in enumerate(done) if k.problem]
    return Survival(tuple(done), total, tuple(problems), time.monotonic() - began)


def _copied(journal: Path, folder: Path) -> Content:
    """Read the files on disk from a copy, so that the next process itself meets the state after the kill."""
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
    """Test whether the journal's tables exist: the kill may have come before they were made."""
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
        return f"{before + reports} sessions were printed, only {committed} are there"
    if found.sessions != peace.sessions[:committed]:
        return "its sessions differ from those learned in peace"
    if [s for s, _ in found.state] != ([committed] if committed else []):
        return "its state is not that of the last session"
    return ""


def _table(kills: Sequence[Kill], sessions: int) -> list[tuple]:
    """Tabulate by phase: where the kills hit, how many between commit and output, and sessions committed by
    then.
    """
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
    parser.add_argument("--forked", action="store_true", help="fork learners: half of the time a kill")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        _serve(options.serve)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stream = folder / "stream.jsonl"
        cli = [sys.executable, "-m", "i2rl.analysis.command.app"]
        simulate = [*cli, "simulate", "patrol", "--instance", "2", "--sessions", str(options.sessions)]
        with stream.open("w") as file:
            subprocess.run(simulate, stdout=file, check=True)
        arguments = ["--mdp", "patrol2", "--agent", "0", "--demonstrations", str(stream)]
        survival = survive(arguments, folder, options.kills, seed=options.seed, forked=options.forked)
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
