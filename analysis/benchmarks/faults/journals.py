"""Journals killed at every write, on full disks, and damaged.

Run as ``python -m i2rl.analysis.benchmarks.faults.journals``.

A learner that needs no JAX, and whose state follows from the number of its session, commits a few sessions.
Then it does so again in adversity. The remaining journal is opened, shown, and learned on in to the end. The
end must equal an undisturbed journal bit by bit.

- Kills: SIGKILL at the first, second, ... call that writes, flushes, cuts or deletes one of the journal's
  files (``strace`` injects it), from creation to the folding in of the log. Each session is checkpointed, so
  that kills meet checkpoints.
- Full disks: the same with files that may grow to so many bytes only (``RLIMIT_FSIZE``), and on file systems
  of so many pages (a tmpfs, for root). Then there is room again.
- Damage: random bits, cuts, swapped pages, noise, and rows deleted, exchanged or of other types. A damaged
  journal is refused with :class:`JournalError`, or all that it shows is true.

Forked processes suffer kills and full disks, and journals are opened here only afterwards: JAX, which opening
a journal uses, does not survive a fork.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter as Tally
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ....inference.journal.journal import Journal, JournalError
from ..harness import print_table, publish
from .kills import Content, content

CALLS = ("pwrite64", "fdatasync", "fsync", "ftruncate", "unlink")
SUFFIXES = ("", "-wal", "-shm", "-journal", "-lock")
_PR_SET_PTRACER = 0x59616D61


# -- a learner --------------------------------------------------------------------------------------------


class CounterState(NamedTuple):
    """Weights and a statistic that follow from the session's number."""

    weights: np.ndarray
    statistic: np.ndarray
    session: int


class CounterInfo(NamedTuple):
    """A number that follows from the session's, and something of some size."""

    square: int
    padding: np.ndarray


class _Anywhere:
    n_states, n_actions, feature_names = 2, 2, ("x", "y")

    def fingerprint(self) -> str:
        return "f" * 64


class Counter:
    """A learner whose state is the number of its sessions, written out at some length."""

    name, signature, mdp, configuration = "counter", "s" * 64, _Anywhere(), {"size": 1500}

    def init(self, key: Any) -> CounterState:
        """Return the state before the first session."""
        del key
        return self.after(0)

    def after(self, session: int) -> CounterState:
        """Return the state after so many sessions."""
        return CounterState(np.arange(2.0) * session, np.arange(1500.0) + session, session)


def learn(path: Path, sessions: int, committed: Callable[[int], object] = lambda session: None) -> None:
    """Learn up to a session, checkpointing each."""
    learner = Counter()
    with Journal.open(path, learner) as journal:  # type: ignore[arg-type]
        journal._connection.execute("PRAGMA wal_autocheckpoint=1")
        here = journal.position
        for session in range(journal.session + 1, sessions + 1):
            here = here.after(f"line {session}")
            report = CounterInfo(session**2, np.arange(60.0) + session)
            journal.commit(learner.after(session), report, here, session.to_bytes(16, "big"))
            committed(session)


def progress_line(content: Content) -> list[tuple]:
    """Return a journal's content without the clock."""
    return [*content.sessions, *content.state]


class Left(NamedTuple):
    """Damage of a journal, the file that it left, and the sessions that were committed by then."""

    case: str
    path: Path
    reported: int
    result: str


class Outcome(NamedTuple):
    """Damage of a journal, the result, and its fault (empty if there is none)."""

    case: str
    result: str
    problem: str


def outcome(left: Left, peace: Content) -> Outcome:
    """Read the remaining journal, learn on to the end, and compare with an undisturbed journal."""
    found, total = [], len(peace.sessions)
    try:
        with Journal.read(left.path) as view:
            found = [record.session for record in view.records()]
    except JournalError as error:
        begun = "is empty" not in str(error) and "does not exist" not in str(error)
        if begun or left.reported:
            return Outcome(left.case, left.result, f"{left.reported} sessions were committed: {error}")
    if found != list(range(1, len(found) + 1)) or len(found) < left.reported:
        return Outcome(left.case, left.result, f"{left.reported} sessions were committed; it has {found}")
    try:
        learn(left.path, total)
    except JournalError as error:
        return Outcome(left.case, left.result, str(error))
    same = progress_line(content(left.path)) == progress_line(peace)
    return Outcome(left.case, left.result, "" if same else "it ended with other bits")


# -- processes --------------------------------------------------------------------------------------------


def _forked(action: Callable[[], object], stopped: bool = False) -> int:
    """Run in a process of its own; a stopped one waits for a tracer and SIGCONT."""
    if pid := os.fork():
        return pid
    try:
        if stopped:
            ctypes.CDLL(None).prctl(_PR_SET_PTRACER, ctypes.c_ulong(-1), 0, 0, 0)  # anybody may trace it
            os.kill(os.getpid(), signal.SIGSTOP)
        action()
        os._exit(0)
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(1)


def _status(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _files(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in SUFFIXES]


def _emptied(path: Path) -> Path:
    for file in _files(path):
        file.unlink(missing_ok=True)
    return path


class _Tally:
    """Counts sessions in another process, up to its very end."""

    def __init__(self) -> None:
        self._reading, self._writing = os.pipe()

    def add(self, session: int) -> None:
        os.write(self._writing, b".")

    def total(self) -> int:
        """Return the count; only once."""
        os.close(self._writing)
        with open(self._reading, "rb") as pipe:
            return len(pipe.read())


def killed_at(call: str, n: int, path: Path, action: Callable[[], object]) -> bool:
    """Run in a process that is killed at its ``n``-th such call on the journal's files; whether it was."""
    pid = _forked(action, stopped=True)
    os.waitpid(pid, os.WUNTRACED)
    which = [option for file in _files(path) for option in ("-P", str(file))]
    inject = ["-e", f"trace={call}", "-e", f"inject={call}:signal=KILL:when={n}"]
    tracer = subprocess.Popen(
        ["strace", "-qq", "-o", os.devnull, "-p", str(pid), *which, *inject], stderr=subprocess.DEVNULL
    )
    while "TracerPid:\t0\n" in Path(f"/proc/{pid}/status").read_text() and tracer.poll() is None:
        time.sleep(0.0005)
    os.kill(pid, signal.SIGCONT)
    status = _status(pid)
    if tracer.wait() not in (0, -signal.SIGKILL) or status not in (0, -signal.SIGKILL):
        raise RuntimeError(f"{call} {n}: the learner ended with {status}, strace with {tracer.returncode}")
    return status != 0


# -- what is done -----------------------------------------------------------------------------------------


def _folders(folder: Path, name: str) -> Iterator[Path]:
    """Return paths for one journal after the other."""
    i = 0
    while True:
        (folder / f"{name}-{i}").mkdir()
        yield folder / f"{name}-{i}" / "run.db"
        i += 1


def kills_at_every_call(folder: Path, sessions: int = 2, every: int = 1) -> Iterator[Left]:
    """Kill at the first, second, ... call of each kind until there is none left to be killed at."""
    paths = _folders(folder, "kill")
    for call in CALLS:
        n = 1
        while True:
            path, tally = next(paths), _Tally()
            killed = killed_at(call, n, path, partial(learn, path, sessions, tally.add))
            reported = tally.total()
            if not killed:
                break
            yield Left(f"{call} {n}", path, reported, f"{call}, {reported} committed")
            n += every


def full_disks(folder: Path, sizes: int = 50, sessions: int = 4) -> Iterator[Left]:
    """Learn where no file may grow above a size; then there is room again."""
    for path, size in zip(_folders(folder, "disk"), np.linspace(0, 120_000, sizes).astype(int), strict=False):
        tally = _Tally()

        def limited(path: Path = path, size: int = int(size), tally: _Tally = tally) -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
            try:
                learn(path, sessions, tally.add)
            except JournalError:
                os._exit(3)

        status = _status(_forked(limited))
        result = {0: "not full", 3: "full"}.get(status, f"the learner ended with status {status}")
        yield Left(f"at most {size} bytes", path, tally.total(), result)


def full_file_systems(folder: Path, peace: Content, sizes: int = 50, sessions: int = 4) -> Iterator[Outcome]:
    """Learn on file systems of so many pages; then there is room again. Needs root."""
    small = folder / "small"
    small.mkdir()
    for pages in range(2, 2 + sizes):
        mount = ["mount", "-t", "tmpfs", "-o", f"size={pages * 4}k", "tmpfs", str(small)]
        subprocess.run(mount, check=True)
        try:
            counted: list[int] = []
            result = "not full"
            try:
                learn(small / "run.db", sessions, counted.append)
            except JournalError:
                result = "full"
            subprocess.run(["mount", "-o", "remount,size=10m", str(small)], check=True)
            yield outcome(Left(f"{pages} pages", small / "run.db", len(counted), result), peace)
        finally:
            subprocess.run(["umount", str(small)], check=True)


SQL_DAMAGE = (
    "DELETE FROM session WHERE number = {a}",
    "DELETE FROM session WHERE number > {a}",
    "DELETE FROM session",
    "DELETE FROM state",
    "DELETE FROM origin",
    "DELETE FROM session; DELETE FROM state",
    "UPDATE session SET number = number + 100 WHERE number = {a}",
    "UPDATE session SET number = -number WHERE number = {a}",
    "UPDATE session SET {column} = (SELECT {column} FROM session WHERE number = {b}) WHERE number = {a}",
    "UPDATE session SET {column} = 'text' WHERE number = {a}",
    "UPDATE session SET {column} = 7.5 WHERE number = {a}",
    "UPDATE session SET {column} = zeroblob({size}) WHERE number = {a}",
    "UPDATE session SET {column} = substr({column}, 1, {size} % 40) WHERE number = {a}",
    "UPDATE state SET {of_state} = zeroblob({size})",
    "UPDATE state SET {of_state} = 'text'",
    "UPDATE state SET tree = substr(tree, 1, {size})",
    "UPDATE state SET session = {a}, sessions = {a}",
    "UPDATE origin SET content = {text}",
    "UPDATE origin SET content = zeroblob({size})",
    "DROP TABLE {table}",
    "ALTER TABLE {table} RENAME TO elsewhere",
    "PRAGMA user_version = {b}",
    "PRAGMA application_id = {size}",
)
_COLUMNS = ("committed", "records", "digest", "demonstration", "state", "chain", "weights", "report")
_ORIGINS = ("''", "'{}'", "'[1]'", "'null'", "printf('%.*c', 100000, '[')", "'{\"method\": 1}'")


def _damage(path: Path, rng: np.random.Generator, sessions: int) -> str:
    """Damage a journal's file at random; return a description."""
    data = bytearray(path.read_bytes())
    kind = rng.choice(["bits", "cut", "pages", "noise", "SQL"], p=[0.35, 0.1, 0.15, 0.1, 0.3])
    pages = len(data) // 4096
    if kind == "bits":
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    elif kind == "cut":
        del data[rng.integers(len(data)) :]
    elif kind == "pages":
        one, other = (slice(4096 * i, 4096 * (i + 1)) for i in rng.choice(pages, 2, replace=False))
        data[one], data[other] = data[other], data[one]
    elif kind == "noise":
        start, size = int(rng.integers(len(data))), int(rng.integers(1, 200))
        data[start : start + size] = rng.bytes(min(size, len(data) - start))
    else:
        a, b = (int(i) for i in rng.integers(1, sessions + 1, 2))
        statements = str(rng.choice(SQL_DAMAGE)).format(
            a=a,
            b=b,
            column=rng.choice(_COLUMNS),
            of_state=rng.choice(["session", "sessions", "chain", "tree"]),
            table=rng.choice(["session", "state", "origin", "writer"]),
            size=int(rng.integers(0, 20_000)),
            text=rng.choice(_ORIGINS),
        )
        connection = sqlite3.connect(path)
        connection.executescript(statements)
        connection.close()
        return statements
    path.write_bytes(data)
    return str(kind)


def damaged(folder: Path, count: int = 2000, seed: int = 0, sessions: int = 20) -> Iterator[Outcome]:
    """Damage journals at random: refused with :class:`JournalError`, or all that they show is true."""
    rng = np.random.default_rng(seed)
    learn(folder / "whole.db", sessions)
    learn(folder / "end.db", sessions + 1)
    end, path = content(folder / "end.db"), folder / "run.db"
    for i in range(count):
        shutil.copy(folder / "whole.db", _emptied(path))
        case = f"{i}: {_damage(path, rng, sessions)}"
        yield Outcome(case, *_judged(path, end, sessions))


def _judged(path: Path, end: Content, sessions: int) -> tuple[str, str]:
    """Read a damaged journal, learn on in it, and return the result and its fault."""
    shown = learned = "right"
    try:
        if content(path).sessions != end.sessions[:sessions]:
            return "wrong", "other sessions were shown than were committed"
    except JournalError:
        shown = "refused"
    except Exception as error:
        return "wrong", f"showing raised {type(error).__name__}: {error}"
    done: list[int] = []
    try:
        learn(path, sessions + 1, done.append)
    except JournalError:
        learned = "refused"
    except Exception as error:
        return "wrong", f"learning raised {type(error).__name__}: {error}"
    if done not in ([], [sessions + 1]) or (learned == "right" and not done):
        return "wrong", f"sessions {done} were learned"
    if learned == "right" and shown == "right" and progress_line(content(path)) != progress_line(end):
        return "wrong", "it ended with other bits"
    return f"shown: {shown}; learned: {learned}", ""


# -- the benchmark ----------------------------------------------------------------------------------------


def _outcomes(folder: Path, options: argparse.Namespace) -> dict[str, list[Outcome]]:
    left: dict[str, list[Left]] = {}
    if options.every and shutil.which("strace"):
        left["kills"] = list(kills_at_every_call(folder, every=options.every))
    left["full disks"] = list(full_disks(folder, options.sizes))
    outcomes = {}
    for what, sessions in (("kills", 2), ("full disks", 4)):
        learn(folder / f"peace-{sessions}.db", sessions)
        peace = content(folder / f"peace-{sessions}.db")
        if what in left:
            outcomes[what] = [outcome(one, peace) for one in left[what]]
    if options.file_systems and os.geteuid() == 0:
        outcomes["full file systems"] = list(full_file_systems(folder, peace, options.file_systems))
    outcomes["damaged"] = list(damaged(folder, options.damaged, options.seed))
    return outcomes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, publish, and fail if anything was lost, repeated or shown wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--every", type=int, default=1, help="kill at every so many calls; 0 for none")
    parser.add_argument("--sizes", type=int, default=50, help="full disks")
    parser.add_argument("--file-systems", type=int, default=50, help="full file systems, for root")
    parser.add_argument("--damaged", type=int, default=2000, help="damaged journals")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        outcomes = _outcomes(Path(name), options)
    rows: list[tuple] = []
    problems: list[str] = []
    results: dict[str, Any] = {}
    for what, found in outcomes.items():
        wrong = [f"{what}, {o.case}: {o.problem}" for o in found if o.problem]
        problems += wrong
        tally = dict(sorted(Tally(o.result for o in found).items()))
        rows += [(what, len(found), len(wrong), "")]
        rows += [("", "", "", f"{count} x {result}") for result, count in tally.items()]
        results[what] = {"cases": len(found), "wrong": len(wrong), "results": tally}
    print_table("Journals in adversity", ("what", "cases", "wrong", "among them"), rows)
    for problem in problems:
        print(f"PROBLEM: {problem}")
    publish("journals", {**results, "problems": problems})
    if problems:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
