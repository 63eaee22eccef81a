"""Types of the options that commands share."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer


def count_option(help: str, least: int = 1, most: int = 10**7) -> Any:
    """Make an option for a positive whole number."""
    return typer.Option(min=least, max=most, help=help)


def real_option(help: str, least: float | None = None, most: float | None = None) -> Any:
    """Make an option for a finite number; a range alone would let NaN pass."""
    return typer.Option(min=least, max=most, help=help, callback=_finite)


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


def seed_option(help: str) -> Any:
    """Make an option for a seed; NumPy, JAX and PyMC take 32 bits without a sign."""
    return typer.Option(min=0, max=2**32 - 1, help=help)


Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of tables.")]
Instance = Annotated[int, typer.Option(min=1, max=3, help="Patrol instance (1, 2 or 3).")]
Seed = Annotated[int, seed_option("Random seed; the same seed gives the same result.")]
Percent = Annotated[
    int | None,
    count_option("Percent of the patrol in view (100: everything); by default the instance's own.", 0, 100),
]
