"""Shared parts of the benchmarks: medians of several runs, a JSON file, and a table."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..drawing.text import number

DEFAULT_FOLDER = Path("build/bench")


def seconds(action: Callable[[], Any]) -> float:
    """Measure wall-clock seconds of one call."""
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def median_seconds(action: Callable[[], Any], replications: int = 5) -> float:
    """Measure the median over several calls, after one that compiles."""
    action()
    return float(np.median([seconds(action) for _ in range(replications)]))


def machine() -> dict[str, Any]:
    """Describe the machine of the measurements."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return {"cores": os.cpu_count(), "python": platform.python_version(), "load": round(load, 2)}


def publish(name: str, results: Mapping[str, Any], path: Path | None = None) -> None:
    """Write results as JSON (to ``build/bench/NAME.json``) with the machine they were measured on."""
    path = DEFAULT_FOLDER / f"{name}.json" if path is None else path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"machine": machine(), **results}, indent=2) + "\n")
    print(f"Written to {path}")


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows as a table; numbers to four significant digits."""
    from rich.console import Console

    from ..drawing.page import Table, print_tables

    cells = [[number(x, 4) if isinstance(x, float) else str(x) for x in row] for row in rows]
    print_tables([Table(columns, cells)], Console(width=140), title)
