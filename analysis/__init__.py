"""Conclusions: metrics, bounds, diagnostics, figures and studies.

Names are loaded when they are first used.
"""

from ..lazy import attached

__getattr__, __dir__, __all__ = attached(__name__, __file__)
