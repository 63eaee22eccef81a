"""Pictures of a patrol's floor and of who walks there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle

from ..gym.canvas import (
    AGENT,
    FLOOR,
    GOAL,
    INK,
    WALL,
    Scene,
    draw_cell,
    draw_key,
    new_canvas,
    number_cells,
)
from .process import Patrol, State


def patrol_scene(patrol: Patrol) -> Scene:
    """Draw the floor with a patroller in its heading; instance 1 marks the hallway end it seeks."""
    ends = _hallway_ends(patrol)
    marks = [(">", AGENT, "patroller"), *([("s", GOAL, "end it seeks")] if ends else [])]
    axes, columns = draw_floor(patrol.cells, marks)
    body = Walker(axes, AGENT)
    sought = outline(axes)

    def place(state: int) -> None:
        here = patrol.states[state]
        body.stand(here)
        sought.set_visible(here.phase in ends)
        if here.phase in ends:
            row, column = ends[here.phase]
            sought.set_xy((column - 0.43, row - 0.43))

    return Scene(axes, patrol.mdp, (sought, body.artist), place, columns)


def draw_floor(
    cells: Sequence[tuple[int, int]], marks: Sequence[tuple[str, str, str]], lines: int = 1
) -> tuple[Axes, int]:
    """Make axes with floor at the cells and wall elsewhere, a key, and a number of characters a line.

    ``marks`` are the key's, in so many ``lines``.
    """
    (low, left), (high, right) = np.min(cells, axis=0), np.max(cells, axis=0)
    pixels = max(24, min(44, 480 / (high - low + 1)))
    axes = new_canvas(
        left - 1.6, right + 1.1, high + 1.1, low - 1.5 - 18 * lines / pixels, pixels, caption=48 / pixels
    )
    size = (right - left + 1.7, high - low + 1.7)
    axes.add_patch(Rectangle((left - 0.85, low - 0.85), *size, facecolor=WALL))
    for row, column in cells:
        draw_cell(axes, row, column, FLOOR)
    number_cells(axes, range(low, high + 1), range(left, right + 1), gap=0.95)
    draw_key(axes, marks, -(-len(marks) // lines))
    return axes, int((right - left + 2.4) * pixels / 6.2)


def outline(axes: Axes) -> Rectangle:
    """Make the frame of a goal cell; the caller sets its lower corner."""
    frame = Rectangle((0, 0), 0.86, 0.86, facecolor="none", edgecolor=GOAL, linewidth=2.2, zorder=3)
    axes.add_patch(frame)
    return frame


class Walker:
    """Arrowhead on a floor that points in the direction of movement."""

    def __init__(self, axes: Axes, color: str):
        self.artist = Polygon(np.zeros((4, 2)), facecolor=color, edgecolor=INK, linewidth=1.0, zorder=4)
        axes.add_patch(self.artist)

    def stand(self, here: State) -> None:
        """Put it in a cell, pointing along the heading."""
        angle = here.heading * np.pi / 2
        # Rows grow downward: a turn to the left is one against the clock all the same.
        turn = np.array([[np.cos(angle), -np.sin(angle)], [-np.sin(angle), -np.cos(angle)]])
        self.artist.set_xy(_ARROWHEAD @ turn + (here.column, here.row))


_ARROWHEAD = np.array([(0.42, 0.0), (-0.32, 0.3), (-0.16, 0.0), (-0.32, -0.3)])


def _hallway_ends(patrol: Patrol) -> dict[int, tuple[int, int]]:
    """Find the cell where each phase becomes the next in instance 1; None elsewhere."""
    successors = np.asarray(patrol.mdp.successors)[..., 0]
    return {
        here.phase: patrol.states[following].cell
        for s, here in enumerate(patrol.states)
        for following in successors[s]
        if patrol.states[following].phase != here.phase
    }
