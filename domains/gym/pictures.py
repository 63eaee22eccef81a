"""Pictures of where an agent is: a patrol's floor, the maze, the sorting table, the object world.

A :class:`Scene` draws what stands still once; a frame then costs some milliseconds. Builders take a domain
and give its scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from ...models.process.mdp import TabularMDP
from ..labyrinth.process import HOME, N_NODES, WATER_PORT, Labyrinth, maze_positions, parent_of
from ..object_world.process import ObjectWorld
from ..patrol.process import Patrol, State

DPI = 100
# Okabe and Ito (2008): told apart by people who do not see red and green alike.
PAGE, INK, MUTED, FLOOR, WALL = "#ffffff", "#1b1f24", "#6b7580", "#e1e6eb", "#57606a"
AGENT, GOAL, WATER = "#d55e00", "#00805d", "#0072b2"


class Frame(NamedTuple):
    """What a caption says: the state, and the action and reward that led to it (None after a reset)."""

    state: int
    action: int | None = None
    reward: float | None = None


class Backdrop:
    """What stands still, drawn once, with artists and a caption that change from picture to picture."""

    def __init__(self, axes: Axes, moving: Sequence[Artist]):
        self._axes = axes
        self._caption = axes.text(
            0.02, 0.015, "", transform=axes.transAxes, fontsize=9, color=INK, va="bottom"
        )
        self._moving = (*moving, self._caption)
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas = FigureCanvasAgg(axes.figure)  # type: ignore[arg-type]
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(axes.figure.bbox)

    def picture(self, caption: str) -> UInt8[np.ndarray, "height width 3"]:
        """Everything as it is now, in red, green and blue from 0 to 255."""
        self._canvas.restore_region(self._background)
        self._caption.set_text(caption)
        for artist in sorted(self._moving, key=Artist.get_zorder):
            self._axes.draw_artist(artist)
        return np.array(self._canvas.buffer_rgba())[..., :3].copy()


class Scene:
    """A backdrop for a decision process, and artists that ``place`` moves to where a state is.

    ``moving`` are the artists that ``place`` changes; ``columns`` is how many characters fit in a line.
    """

    def __init__(
        self,
        axes: Axes,
        mdp: TabularMDP,
        moving: Sequence[Artist],
        place: Callable[[int], None],
        columns: int,
    ):
        self._mdp, self._place, self._columns = mdp, place, columns
        self._backdrop = Backdrop(axes, moving)

    def frame(self, shown: Frame) -> UInt8[np.ndarray, "height width 3"]:
        """The picture of a state."""
        self._place(shown.state)
        return self._backdrop.picture(caption(self._mdp, shown, self._columns))


def caption(mdp: TabularMDP, shown: Frame, columns: int = 10_000) -> str:
    """The last action and its reward, and the state reached, in lines of at most so many characters."""
    last = (
        "begins" if shown.action is None else f"{mdp.action_names[shown.action]}, reward {shown.reward:.3g}"
    )
    return f"{fill(last, columns)}\n{fill(mdp.state_names[shown.state], columns)}"


def _canvas(left: float, right: float, bottom: float, top: float, pixels: float, *, caption: float) -> Axes:
    """Axes that fill a figure, so many pixels a unit, with so many units for the caption below ``bottom``."""
    down = caption if top > bottom else -caption
    width, height = abs(right - left), abs(top - bottom) + caption
    figure = Figure(figsize=(width * pixels / DPI, height * pixels / DPI), dpi=DPI, facecolor=PAGE)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(left, right), ylim=(bottom - down, top))
    return axes


def _cell(axes: Axes, row: int, column: int, color: str) -> None:
    axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=color, edgecolor=PAGE, linewidth=1.2))


def _key(axes: Axes, marks: Sequence[tuple[str, str, str]], columns: int = 4) -> None:
    """What marks mean, above everything: (marker, colour, meaning), so many side by side."""
    handles = []
    for marker, color, meaning in marks:
        handle = Line2D([], [], linestyle="", marker=marker, color=color, markersize=8, label=meaning)
        # Goals are framed, not filled.
        if (marker, color) == ("s", GOAL):
            handle.set_markerfacecolor("none")
            handle.set_markeredgewidth(1.8)
        handles.append(handle)
    axes.legend(
        handles=handles, loc="upper left", ncols=columns, frameon=False, fontsize=8, labelcolor=INK,
        borderaxespad=0.1, handletextpad=0.1, columnspacing=0.9, handlelength=1.6,
    )  # fmt: skip


def _number(axes: Axes, rows: range, columns: range, gap: float = 0.62) -> None:
    """The numbers by which state names tell cells, outside the grid's first row and column."""
    for row in rows:
        axes.text(columns[0] - gap, row, str(row), color=MUTED, fontsize=7, ha="right", va="center")
    for column in columns:
        axes.text(column, rows[0] - gap, str(column), color=MUTED, fontsize=7, ha="center", va="bottom")


def text_scene(mdp: TabularMDP) -> Scene:
    """The scene of a process nobody drew: what is done and where it leads, in words."""
    axes = _canvas(0, 10, 0, 1, 40, caption=2)
    axes.text(0.2, 0.6, "state and last action", color=MUTED, fontsize=9, va="center")
    return Scene(axes, mdp, (), lambda state: None, 60)


def patrol_scene(patrol: Patrol) -> Scene:
    """The floor with a patroller that points where it heads; instance 1 marks the hallway end it seeks."""
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
    """Axes with floor where the cells are and wall elsewhere, a key, and how many characters fit in a line.

    ``marks`` are the key's, in so many ``lines``.
    """
    (low, left), (high, right) = np.min(cells, axis=0), np.max(cells, axis=0)
    pixels = max(24, min(44, 480 / (high - low + 1)))
    axes = _canvas(
        left - 1.6, right + 1.1, high + 1.1, low - 1.5 - 18 * lines / pixels, pixels, caption=48 / pixels
    )
    size = (right - left + 1.7, high - low + 1.7)
    axes.add_patch(Rectangle((left - 0.85, low - 0.85), *size, facecolor=WALL))
    for row, column in cells:
        _cell(axes, row, column, FLOOR)
    _number(axes, range(low, high + 1), range(left, right + 1), gap=0.95)
    _key(axes, marks, -(-len(marks) // lines))
    return axes, int((right - left + 2.4) * pixels / 6.2)


def outline(axes: Axes) -> Rectangle:
    """The frame of a cell that is sought; its lower corner is for the caller to set."""
    frame = Rectangle((0, 0), 0.86, 0.86, facecolor="none", edgecolor=GOAL, linewidth=2.2, zorder=3)
    axes.add_patch(frame)
    return frame


class Walker:
    """An arrowhead on a floor that points where somebody heads."""

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
    """Instance 1: the cell where each phase becomes the next; nothing elsewhere."""
    successors = np.asarray(patrol.mdp.successors)[..., 0]
    return {
        here.phase: patrol.states[following].cell
        for s, here in enumerate(patrol.states)
        for following in successors[s]
        if patrol.states[following].phase != here.phase
    }


# -- the labyrinth --------------------------------------------------------------------------------------


def labyrinth_scene(labyrinth: Labyrinth) -> Scene:
    """The maze with its water port and the mouse, nose where it is going."""
    places = maze_positions()
    axes = _canvas(-15.5, 15.5, -17.5, 15.5, 16, caption=3)
    axes.add_patch(Rectangle((-15.5, -17.5), 31, 33, facecolor=WALL, zorder=0))
    for node in range(N_NODES):
        x, y = zip(places[node], places[parent_of(node)], strict=True)
        axes.plot(x, y, color=FLOOR, linewidth=11, solid_capstyle="projecting", zorder=1)
    axes.text(1.2, -16.2, "home", color=FLOOR, fontsize=10, va="center")
    axes.text(places[WATER_PORT, 0], -16.2, "water", color=FLOOR, fontsize=10, ha="center", va="center")
    axes.add_patch(Polygon(_DROP + places[WATER_PORT], facecolor=WATER, zorder=2))
    turns = np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0, 2 * np.pi, 24)])
    shapes = [
        (turns * (0.85, 0.5), "#9a5b2a"),
        (turns * 0.3 + (0.45, 0.42), "#6f3d17"),
        (turns * 0.3 + (0.45, -0.42), "#6f3d17"),
        (turns * 0.12 + (0.82, 0.0), INK),
    ]
    parts = [Polygon(shape, facecolor=color, zorder=4 + i) for i, (shape, color) in enumerate(shapes)]
    tail = Polygon(np.zeros((3, 2)), closed=False, fill=False, edgecolor="#6f3d17", linewidth=1.8, zorder=3)
    curl = np.array([(-0.8, 0.0), (-1.2, 0.25), (-1.5, -0.05)])
    for part in (*parts, tail):
        axes.add_patch(part)
    nodes, came_from = labyrinth.node, _previous_nodes(labyrinth)

    def place(state: int) -> None:
        node = nodes[state]
        way = places[node] - places[came_from[state]]
        cos, sin = way / max(np.hypot(*way), 1e-9) if np.any(way) else (0.0, 1.0)
        turn = np.array([[cos, sin], [-sin, cos]])
        for part, (shape, _) in zip(parts, shapes, strict=True):
            part.set_xy(shape @ turn + places[node])
        tail.set_xy(curl @ turn + places[node])

    return Scene(axes, labyrinth.mdp, (tail, *parts), place, 80)


_DROP = np.array(
    [(0.0, 0.95), *[(0.62 * np.cos(t), -0.25 + 0.62 * np.sin(t)) for t in np.linspace(0.45, -3.59, 20)]]
)


def _previous_nodes(labyrinth: Labyrinth) -> np.ndarray:
    """The node each state was entered from."""
    previous = np.full(len(labyrinth.node), -1)
    successors = np.asarray(labyrinth.mdp.successors)[..., 0]
    for s, a in np.argwhere(np.asarray(labyrinth.mdp.available)):
        previous[successors[s, a]] = labyrinth.node[s]
    start = np.asarray(labyrinth.mdp.initial) > 0
    previous[start] = HOME
    previous[labyrinth.node == HOME] = 0
    # What nothing leads to was entered from above.
    unknown = previous < 0
    previous[unknown] = [parent_of(int(n)) for n in labyrinth.node[unknown]]
    return previous


# -- the object world -----------------------------------------------------------------------------------


def object_world_scene(world: ObjectWorld) -> Scene:
    """The grid with its walls, the two objects as stars, and the agent."""
    rows, columns = world.walls.shape
    pixels = max(16, 420 / max(rows, columns))
    axes = _canvas(-1.3, columns, rows, -1.3 - 18 / pixels, pixels, caption=48 / pixels)
    _key(
        axes,
        [("o", AGENT, "agent"), ("*", GOAL, "first object"), ("*", WATER, "second"), ("s", WALL, "wall")],
    )
    for row in range(rows):
        for column in range(columns):
            _cell(axes, row, column, WALL if world.walls[row, column] else FLOOR)
    _number(axes, range(rows), range(columns))
    for (row, column), name, color in zip(world.objects, "12", (GOAL, WATER), strict=True):
        axes.plot(column, row, marker="*", markersize=pixels * 0.5, color=color, zorder=2)
        axes.text(column, row, name, color=PAGE, fontsize=7, ha="center", va="center", zorder=3)
    agent = Circle((0, 0), 0.26, facecolor=AGENT, edgecolor=INK, linewidth=1.2, zorder=4)
    axes.add_patch(agent)

    def place(state: int) -> None:
        row, column = world.cells[state]
        agent.set_center((column, row))

    return Scene(axes, world.mdp, (agent,), place, int((columns + 1) * pixels / 6.2))
