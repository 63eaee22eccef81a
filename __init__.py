"""Online inverse reinforcement learning from imperfect observations.

Parts are imported at their first use, so that ``import i2rl`` is immediate:
:mod:`i2rl.models`, :mod:`i2rl.inference`, :mod:`i2rl.domains`, :mod:`i2rl.analysis`.

Unless ``OPENBLAS_NUM_THREADS`` is set, or SciPy is loaded already (JAX loads it), importing this package asks
for one linear-algebra thread: planning factorises small matrices, where threads that wait for each other cost
up to a hundred times the work on a busy machine.
"""

import importlib
import os
from types import ModuleType

from .version import __version__

# Before anything loads SciPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__all__ = ["__version__", "analysis", "domains", "inference", "models"]


def __getattr__(name: str) -> ModuleType:
    if name in {"analysis", "domains", "inference", "models"}:
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
