"""Canvases for pictures of where an agent is.

A :class:`Scene` draws what stands still once; a frame then costs some milliseconds. Each domain's room builds
its own scene.
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
from matplotlib.patches import Rectangle

from ...models.process.mdp import TabularMDP

DPI = 100
# Okabe and Ito (2008): distinct also to people who do not see red and green alike.
PAGE, INK, MUTED, FLOOR, WALL = "#ffffff", "#1b1f24", "#6b7580", "#e1e6eb", "#57606a"
AGENT, GOAL, WATER = "#d55e00", "#00805d", "#0072b2"


class Frame(NamedTuple):
    """Content of a caption: the state, and the action and reward that led to it (None after a reset)."""

    state: int
    action: int | None = None
    reward: float | None = None


class Backdrop:
    """Static scene, drawn once, with artists and a caption that change from picture to picture."""

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
        """Return the current picture in red, green and blue from 0 to 255."""
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

    def frame(self, content: Frame) -> UInt8[np.ndarray, "height width 3"]:
        """Draw a state."""
        self._place(content.state)
        return self._backdrop.picture(caption(self._mdp, content, self._columns))


def caption(mdp: TabularMDP, content: Frame, columns: int = 10_000) -> str:
    """Write the last action and its reward, and the state reached, in lines of at most so many characters."""
    last = (
        "begins"
        if content.action is None
        else f"{mdp.action_names[content.action]}, reward {content.reward:.3g}"
    )
    return f"{fill(last, columns)}\n{fill(mdp.state_names[content.state], columns)}"


def new_canvas(
    left: float, right: float, bottom: float, top: float, pixels: float, *, caption: float
) -> Axes:
    """Make axes that fill a figure, so many pixels a unit, with so many units for the caption below
    ``bottom``.
    """
    down = caption if top > bottom else -caption
    width, height = abs(right - left), abs(top - bottom) + caption
    figure = Figure(figsize=(width * pixels / DPI, height * pixels / DPI), dpi=DPI, facecolor=PAGE)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(left, right), ylim=(bottom - down, top))
    return axes


def draw_cell(axes: Axes, row: int, column: int, color: str) -> None:
    """Fill a cell of a grid."""
    axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=color, edgecolor=PAGE, linewidth=1.2))


def draw_key(axes: Axes, marks: Sequence[tuple[str, str, str]], columns: int = 4) -> None:
    """Draw a key of the marks above everything: (marker, colour, meaning), so many side by side."""
    handles = []
    for marker, color, meaning in marks:
        handle = Line2D([], [], linestyle="", marker=marker, color=color, markersize=8, label=meaning)
        # Goals are framed, not filled.
        if (marker, color) == ("s", GOAL):
            handle.set_markerfacecolor("none")
            handle.set_markeredgewidth(1.8)
        handles.append(handle)
    axes.legend(
        handles=handles,
        loc="upper left",
        ncols=columns,
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        borderaxespad=0.1,
        handletextpad=0.1,
        columnspacing=0.9,
        handlelength=1.6,
    )


def number_cells(axes: Axes, rows: range, columns: range, gap: float = 0.62) -> None:
    """Write the cells' numbers, as in state names, outside the grid's first row and column."""
    for row in rows:
        axes.text(columns[0] - gap, row, str(row), color=MUTED, fontsize=7, ha="right", va="center")
    for column in columns:
        axes.text(column, rows[0] - gap, str(column), color=MUTED, fontsize=7, ha="center", va="bottom")


def text_scene(mdp: TabularMDP) -> Scene:
    """Make a scene in words, for a process without a picture: the action and the state it leads to."""
    axes = new_canvas(0, 10, 0, 1, 40, caption=2)
    axes.text(0.2, 0.6, "state and last action", color=MUTED, fontsize=9, va="center")
    return Scene(axes, mdp, (), lambda state: None, 60)
