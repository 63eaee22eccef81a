"""Inference about the expert: completion, convex programs, samplers, and learners.

Names are loaded when they are first used: the solvers behind some of them take seconds to load.
"""

from .. import precision  # noqa: F401  (before any computation)
from ..lazy import attached

__getattr__, __dir__, __all__ = attached(__name__, __file__)
