"""Optional packages: what to install where one is missing."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

EXTRA_OF = {"equinox": "adversarial", "optax": "adversarial", "mujoco": "adversarial"}


def required(package: str) -> ModuleType:
    """Import the package and return it.

    Raises ``ModuleNotFoundError`` that says which extra of i2rl to install.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError as missing:
        if missing.name != package.split(".")[0]:
            raise
        extra = EXTRA_OF[missing.name]
        raise ModuleNotFoundError(
            f"this needs the package {missing.name}, which is not installed: pip install 'i2rl[{extra}]'",
            name=missing.name,
        ) from None
