"""A picture of the breach: the learner, the patrollers, the cells they see, and the goals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int, UInt8
from matplotlib.patches import Rectangle

from ..gym.canvas import AGENT, GOAL, WATER, Backdrop
from .picture import Walker, draw_floor, outline
from .process import Patrol, State

SEEN = "#f7c9a6"


class BreachScene:
    """The floor and everybody on it.

    ``states`` are the learner's, ``sees [C, S]`` says which of its cells a patroller sees from a state.
    """

    def __init__(self, patrol: Patrol, states: Sequence[State], sees: Bool[np.ndarray, "C S"]):
        assert patrol.breach is not None
        self._patrol, self._states, self._sees = patrol, states, sees
        marks = [
            (">", WATER, "learner"),
            (">", AGENT, "patroller"),
            ("s", GOAL, "goal"),
            ("s", SEEN, "seen"),
        ]
        axes, self._columns = draw_floor(patrol.breach.cells, marks, lines=2)
        goals = [outline(axes) for _ in patrol.breach.goals]
        for frame, (row, column) in zip(goals, patrol.breach.goals, strict=True):
            frame.set_xy((column - 0.43, row - 0.43))
        # In the order of the learner's cells.
        self._lit = [
            Rectangle((c - 0.46, r - 0.46), 0.92, 0.92, facecolor=SEEN, zorder=2)
            for r, c in patrol.breach.cells
        ]
        for cell in self._lit:
            axes.add_patch(cell)
        self._walkers = [Walker(axes, AGENT) for _ in range(patrol.patrollers)]
        self._learner = Walker(axes, WATER)
        self._learner.artist.set_zorder(5)
        walkers = [walker.artist for walker in (*self._walkers, self._learner)]
        self._backdrop = Backdrop(axes, [*self._lit, *goals, *walkers])

    def frame(
        self, learner: int, patrollers: Int[np.ndarray, " P"], gone: bool, caption: str
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the breach; the learner is pale until it has ``gone``, since it is hidden."""
        self._learner.stand(self._states[learner])
        self._learner.artist.set_alpha(1.0 if gone else 0.4)
        for walker, state in zip(self._walkers, patrollers, strict=True):
            walker.stand(self._patrol.states[int(state)])
        seen = np.any(self._sees[:, patrollers], axis=1)
        for i, cell in enumerate(self._lit):
            cell.set_visible(bool(seen[i]))
        return self._backdrop.picture(caption)
