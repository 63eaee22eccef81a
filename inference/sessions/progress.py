"""Say on standard error what a long call does: one changing line on a terminal, a line a step elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_line(progress: bool) -> Iterator[Callable[[str], None]]:
    """Yield a function that prints the step that begins; without ``progress`` it does nothing."""
    if not progress:
        yield lambda step: None
    elif sys.stderr.isatty():
        from rich.console import Console

        with Console(stderr=True).status("starting", spinner="line") as status:
            yield lambda step: status.update(step)
    else:
        yield lambda step: print(step, file=sys.stderr, flush=True)
