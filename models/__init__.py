"""Beliefs about the expert: decision processes, demonstrations, sensors, and laws of trajectories.

Importing it switches JAX to 64-bit floats: likelihoods of long trajectories and warm-started programs need
the digits. Names are loaded when they are first used.
"""

from .. import precision  # noqa: F401  (before any computation)
from ..lazy import attached

__getattr__, __dir__, __all__ = attached(__name__, __file__)
