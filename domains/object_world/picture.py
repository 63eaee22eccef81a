"""Pictures of an object world."""

from __future__ import annotations

from matplotlib.patches import Circle

from ..gym.canvas import (
    AGENT,
    FLOOR,
    GOAL,
    INK,
    PAGE,
    WALL,
    WATER,
    Scene,
    draw_cell,
    draw_key,
    new_canvas,
    number_cells,
)
from .process import ObjectWorld


def object_world_scene(world: ObjectWorld) -> Scene:
    """Draw the grid with its walls, the two objects as stars, and the agent."""
    rows, columns = world.walls.shape
    pixels = max(16, 420 / max(rows, columns))
    axes = new_canvas(-1.3, columns, rows, -1.3 - 18 / pixels, pixels, caption=48 / pixels)
    draw_key(
        axes,
        [("o", AGENT, "agent"), ("*", GOAL, "first object"), ("*", WATER, "second"), ("s", WALL, "wall")],
    )
    for row in range(rows):
        for column in range(columns):
            draw_cell(axes, row, column, WALL if world.walls[row, column] else FLOOR)
    number_cells(axes, range(rows), range(columns))
    for (row, column), name, color in zip(world.objects, "12", (GOAL, WATER), strict=True):
        axes.plot(column, row, marker="*", markersize=pixels * 0.5, color=color, zorder=2)
        axes.text(column, row, name, color=PAGE, fontsize=7, ha="center", va="center", zorder=3)
    agent = Circle((0, 0), 0.26, facecolor=AGENT, edgecolor=INK, linewidth=1.2, zorder=4)
    axes.add_patch(agent)

    def place(state: int) -> None:
        row, column = world.cells[state]
        agent.set_center((column, row))

    return Scene(axes, world.mdp, (agent,), place, int((columns + 1) * pixels / 6.2))
