"""Tasks to learn from: patrols and their breach, onion sorting, object worlds, a mouse in a labyrinth.

Importing it registers them with Gymnasium; see :mod:`i2rl.domains.environments`. Names are loaded when they
are first used; continuous tasks need the extra ``adversarial``.
"""

from .. import precision  # noqa: F401  (before anything computes)
from ..lazy import attached
from . import environments  # noqa: F401  (registers them)

__getattr__, __dir__, __all__ = attached(__name__, __file__)
