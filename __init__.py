"""Online inverse reinforcement learning from imperfect observations.

The parts are imported when they are used, so that ``import i2rl`` costs nothing:
:mod:`i2rl.models`, :mod:`i2rl.inference`, :mod:`i2rl.domains`, :mod:`i2rl.analysis`.
"""

import importlib
from types import ModuleType

from .version import __version__

__all__ = ["__version__", "analysis", "domains", "inference", "models"]


def __getattr__(name: str) -> ModuleType:
    if name in {"analysis", "domains", "inference", "models"}:
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
