"""The command line: ``i2rl run``, ``bounds``, ``simulate``, ``learn`` and ``show``.

Heavy modules are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ...compilation import compile_quickly, keep_programs
from . import run, simulate
from .bounds import print_bounds
from .console import show_progress
from .learn import learn_online
from .show import show_journal

BROKEN_PIPE = 128 + 13
"""Exit status of a command whose reader went away, the shell's for SIGPIPE."""


class _Commands(TyperGroup):
    """Commands that end quietly when the reader of their output (``head``) goes away."""

    def invoke(self, ctx: Any) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()  # the interpreter's exit would print an error
            return result
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(BROKEN_PIPE) from None


app = typer.Typer(
    cls=_Commands,
    help="Learn the reward behind a behaviour online, from imperfect observations.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(run.commands, name="run")
app.add_typer(simulate.commands, name="simulate")
app.command("bounds")(print_bounds)
app.command("learn")(learn_online)
app.command("show")(show_journal)


def _print_version(wanted: bool) -> None:
    if wanted:
        from ...version import __version__

        print(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print no progress on standard error.")
    ] = False,
) -> None:
    show_progress(not quiet)


def _interrupt_again(unraisable: Any) -> None:
    """Raise Ctrl-C once more after Python swallowed it in JAX's callback of the garbage collector."""
    if unraisable.exc_type is KeyboardInterrupt:
        main_thread = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, (main_thread, signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def main() -> None:
    """Run the command ``i2rl``."""
    sys.unraisablehook = _interrupt_again
    if sys.stdout is None:  # closed by whoever started this
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    compile_quickly()
    keep_programs()
    app()


if __name__ == "__main__":
    main()
