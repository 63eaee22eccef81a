"""Content of a study's ``results.json``: plain data and its provenance."""

from __future__ import annotations

import math
import platform
import shlex
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ...version import __version__

_COMPUTED_WITH = ("jax", "jaxlib", "numpy", "scipy")


def study_provenance(seed: int) -> dict[str, Any]:
    """Return version, command line, seed, and versions of what computes, as plain data.

    >>> sorted(study_provenance(7))
    ['command', 'i2rl', 'python', 'seed', 'versions']
    """
    return {
        "i2rl": __version__,
        "command": command_line(sys.argv),
        "seed": seed,
        "python": platform.python_version(),
        "versions": {package: version(package) for package in _COMPUTED_WITH},
    }


def command_line(arguments: list[str]) -> str:
    """Write arguments as a shell takes them; this library's own command by its name alone."""
    program, *rest = arguments or [""]
    ours = Path(program).stem in ("i2rl", "cli")
    return shlex.join(["i2rl" if ours else program, *rest])


def plain(value: Any) -> Any:
    """Turn arrays, tuples and named tuples into what JSON takes; a number that is not finite becomes null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    return plain(value.tolist()) if hasattr(value, "tolist") else value
