"""Progress, errors and tables of the commands on the terminal."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from jax.typing import ArrayLike
    from rich.console import Console

LONGEST_MESSAGE = 1000
_FIRST_STEP = "starting: the first step is compiled, unless the cache has its program"
_SECONDS_A_LINE = 2.0
_quiet = False


def print_results(teller: Any, study: Any, folder: Path, as_json: bool) -> None:
    """Print a study's results: its page's ``results.json``, or its tables and the path of its page."""
    from ..drawing.text import printable

    if as_json:
        print(json.dumps(json.loads((folder / "results.json").read_text(encoding="utf-8"))))
        return
    teller.print_tables(study, output_console())
    print(printable(f"Page: {folder / 'index.html'}"))


@contextmanager
def reported_errors() -> Iterator[None]:
    """End with one clear line, without a traceback, for faulty input."""
    from ...inference.journal.journal import JournalError
    from ...inference.programs.constraints import ProgramNotSolved

    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, JournalError, ProgramNotSolved) as error:
        if os.environ.get("I2RL_TRACEBACK"):
            raise
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{error.filename}: {error.strerror}"
        if len(message) > LONGEST_MESSAGE:
            message = f"{message[: LONGEST_MESSAGE - 200]} ... {message[-200:]}"
        print_message(f"Error: {message}")
        raise typer.Exit(1) from None
    except MemoryError:
        print_message("Error: there is not enough memory for so much; ask for less")
        raise typer.Exit(1) from None


def show_progress(visible: bool) -> None:
    """Show the progress of the command that follows, or none."""
    global _quiet
    _quiet = not visible


@contextmanager
def progress(quiet: bool) -> Iterator[Any]:
    """Show progress on standard error; yield ``advance(description, fraction)``.

    A terminal shows a bar. A file or a pipe gets a line a step, at most one every two seconds.
    """
    if quiet or _quiet:
        yield lambda description, fraction: None
        return
    if not sys.stderr.isatty():
        yield _lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from ..drawing.text import printable

    description = TextColumn("{task.description}", markup=False)
    columns = (SpinnerColumn(), description, BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(_FIRST_STEP, total=None)

        def advance(description: str, fraction: float | None) -> None:
            total = None if fraction is None else 1.0
            bar.update(task, description=printable(description), total=total, completed=fraction or 0.0)

        yield advance


def _lines() -> Callable[[str, float | None], None]:
    """Return ``advance(description, fraction)`` that prints lines, the first one now."""
    print_message(_FIRST_STEP)
    before = time.monotonic()

    def advance(description: str, fraction: float | None) -> None:
        nonlocal before
        if time.monotonic() - before >= _SECONDS_A_LINE:
            before = time.monotonic()
            share = "" if fraction is None else f" ({fraction:.0%})"
            print_message(f"{description}{share}")

    return advance


def output_console() -> Console:
    """Make a console as wide as the terminal, or 120 columns without one."""
    from rich.console import Console

    class Output(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # Rich would end the process

    return Output(width=None if sys.stdout.isatty() else 120)


def print_message(text: str) -> None:
    """Print a line on standard error."""
    from ..drawing.text import printable

    print(printable(text), file=sys.stderr)


def print_rewards(console: Console, names: Sequence[str], weights: ArrayLike, title: str) -> None:
    """Print weights ``[K]`` or ``[n, K]`` as a table, a feature a row: two columns for each reward."""
    import numpy as np
    from rich.table import Table

    from ..drawing.text import for_terminal

    rewards = np.atleast_2d(np.asarray(weights))
    table = Table(title=title)
    table.add_column("feature")
    scales = np.maximum(np.abs(rewards).sum(1), 1e-300)
    for i in range(len(rewards)):
        number = f" {i}" if len(rewards) > 1 else ""
        for column in (f"weight{number}", f"L1-normalised{number}"):
            table.add_column(column, justify="right")
    for name, row in zip(names, rewards.T, strict=True):
        cells = [x for w, scale in zip(row, scales, strict=True) for x in (f"{w:.3f}", f"{w / scale:.3f}")]
        table.add_row(for_terminal(name), *cells)
    console.print(table)
