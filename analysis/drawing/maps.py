"""Pictures of a process where its states lie: what a policy does, what states are worth, a hidden path.

Every picture takes a :class:`~i2rl.models.process.layout.Layout`: cells of a grid, coordinates, or a graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from ...models.inputs.text import counted
from ...models.process.layout import Layout, require_layout
from ...models.process.mdp import TabularMDP
from ...models.process.planning import greedy_actions
from ..judging.metrics import optimal_actions
from .style import LIGHT, SMALL, TEXT, Theme, dress, dress_bar, headline, name_ticks, new_figure
from .text import for_figure

_INCHES_PER_CELL, _SPAN = 0.46, 5.2
FORWARD, LEFT, RIGHT, STAY, TOWARD = range(5)
# Names of more places than these would cover each other.
_MOST_NAMES = 40


def policy_map(
    mdp: TabularMDP,
    policy: Float[np.ndarray, "S A"],
    layout: Layout,
    *,
    weights: Float[np.ndarray, " K"] | None = None,
    in_view: Bool[np.ndarray, " S"] | None = None,
    theme: Theme = LIGHT,
    title: str = "Policy",
    note: str = "",
) -> Figure:
    """Draw what a policy most probably does in every state, as an arrow to where that most probably leads.

    A dot stays. Where states face somewhere, each has its glyph at the side faced: an arrow forward, a hook
    for a turn, a dot to stop. Of actions that are equally probable the first counts. A panel for each of the
    layout's layers.

    Parameters
    ----------
    weights : float ``[K]``, optional
        The expert's reward: states in which the policy does what is not optimal under it are marked, and
        counted in the title.
    in_view : bool ``[S]``, optional
        Tints the places that the learner sees.
    note : str
        A second line below the title.

    Raises
    ------
    ValueError
        For a policy of another shape, a view or a layout of another number of states.

    See Also
    --------
    value_map, hidden_path

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import policy_map
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Layout, reward_of, soft_plan
    >>> corridor = five_cells()
    >>> policy = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights)).policy
    >>> layout = Layout.grid([(0, column) for column in range(5)])
    >>> policy_map(corridor.mdp, np.asarray(policy), layout).axes[0].get_xlabel()
    'column (cells)'
    """
    require_layout(layout, mdp)
    policy = np.asarray(policy)
    shape = (mdp.n_states, mdp.n_actions)
    if policy.shape != shape:
        raise ValueError(f"policy must have shape [S, A] = {shape}; got {policy.shape}")
    if in_view is not None and np.shape(in_view) != shape[:1]:
        raise ValueError(f"in_view must have shape [S] = {shape[:1]}; got {np.shape(in_view)}")
    actions = np.asarray(greedy_actions(jnp.asarray(policy))).argmax(1)
    agrees = np.ones(len(actions), bool)
    if weights is not None:
        optimal = np.asarray(optimal_actions(mdp, jnp.asarray(weights)))
        agrees = optimal[np.arange(len(actions)), actions]
        share = f"{agrees.sum()} of {len(agrees)} states as the expert ({100 * agrees.mean():.1f} %)"
        title = f"{title}: {share}"
    seen = np.zeros(len(actions), bool) if in_view is None else np.asarray(in_view) > 0
    kinds, angles = _moves(mdp, actions, layout)

    frame = _Frame.of(layout)
    figure, panels, legend = _panels(layout, frame, theme, beside=2.7)
    for layer, axes in enumerate(panels):
        here = np.flatnonzero(layout.layer == layer)
        _draw_ground(axes, theme, layout, frame, here, here[seen[here]])
        _draw_actions(axes, theme, layout, frame, here, kinds, angles, agrees)
    _draw_key(legend, theme, layout, kinds, weights is not None, in_view is not None)
    headline(figure, theme, f"{title}\n{note}" if note else title, TEXT + 1.5)
    return figure


def value_map(
    mdp: TabularMDP,
    values: Float[np.ndarray, " S"],
    layout: Layout,
    *,
    label: str = "value (nats)",
    theme: Theme = LIGHT,
    title: str = "Value of each state",
    note: str = "",
) -> Figure:
    """Draw a number for every state as a colour at its place, such as its value or how often it is visited.

    States that share a place share its area: each has the side it faces, or a part of its own. Numbers of
    both signs have one scale about zero, in two colours; numbers of one sign a scale from the least to the
    greatest. NaN is drawn as nothing. ``label`` says what the numbers are, with their unit.

    Raises ``ValueError`` for numbers of another shape or a layout of another number of states.

    See Also
    --------
    policy_map, hidden_path

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import value_map
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Layout, reward_of, soft_plan
    >>> corridor = five_cells()
    >>> values = soft_plan(corridor.mdp, reward_of(corridor.mdp, corridor.weights)).values
    >>> layout = Layout.grid([(0, column) for column in range(5)])
    >>> value_map(corridor.mdp, np.asarray(values), layout).axes[0].get_xlabel()
    'column (cells)'
    """
    require_layout(layout, mdp)
    values = np.asarray(values, float)
    if values.shape != (mdp.n_states,):
        raise ValueError(f"values must have shape [S] = {(mdp.n_states,)}; got {values.shape}")
    shades = _shades(values, theme)
    frame = _Frame.of(layout)
    figure, panels, _ = _panels(layout, frame, theme)
    for layer, axes in enumerate(panels):
        here = np.flatnonzero(layout.layer == layer)
        _draw_ground(axes, theme, layout, frame, here, here[:0])
        known = here[np.isfinite(values[here])]
        colors = shades.to_rgba(values[known])
        # A thin line parts states, and keeps those in sight whose colour is the page's.
        axes.add_collection(PolyCollection(
            [frame.shapes[s] for s in known], facecolors=colors, edgecolors=theme.muted, linewidths=0.35,
            zorder=3,
        ))  # fmt: skip
        _draw_names(axes, theme, layout, frame, here, 5, halo=True)
        _draw_marks(axes, theme, layout, frame)
    bar = figure.colorbar(shades, ax=list(panels), shrink=0.8, aspect=30, pad=0.02)
    dress_bar(bar, theme, label)
    headline(figure, theme, f"{title}\n{note}" if note else title, TEXT + 1.5)
    return figure


def _shades(values: Float[np.ndarray, " S"], theme: Theme) -> ScalarMappable:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if low < 0 < high:
        return theme.signed_shades(finite)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return ScalarMappable(Normalize(low, high), theme.colormap)


# -- the ground ---------------------------------------------------------------------------------------


class _Frame(NamedTuple):
    """A layout in the coordinates of axes: ``xy [P, 2]``, the radius of a place, and the shape of each state.

    ``down`` is -1 where y grows downward, as rows do. ``spots [S, 2]`` are the middles of the shapes.
    """

    xy: Float[np.ndarray, "P 2"]
    radius: float
    down: int
    shapes: list[Float[np.ndarray, "n 2"]]
    spots: Float[np.ndarray, "S 2"]
    sizes: Float[np.ndarray, " S"]

    @staticmethod
    def of(layout: Layout) -> _Frame:
        if layout.kind == "grid":
            xy, radius, down = layout.positions[:, ::-1], 0.5, -1
        else:
            xy, down = layout.positions, 1
            apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), 1)]
            extent = float(np.ptp(xy, axis=0).max()) or 1.0
            nearest = float(apart.min(initial=extent))
            radius = float(np.clip(0.3 * nearest, 0.012 * extent, 0.06 * extent))
        shapes: list[Any] = [None] * layout.n_states
        spots, sizes = xy[layout.place].astype(float), np.ones(layout.n_states)
        for place, layer in {(int(p), int(i)) for p, i in zip(layout.place, layout.layer, strict=True)}:
            together = np.flatnonzero((layout.place == place) & (layout.layer == layer))
            for i, s in enumerate(together):
                shape, spot, size = _part(layout, int(s), i, len(together), down)
                shapes[s] = xy[place] + radius * shape
                spots[s] = xy[place] + radius * spot
                sizes[s] = size
        return _Frame(xy, radius, down, shapes, spots, sizes)


def _part(layout: Layout, s: int, i: int, n: int, down: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Outline, middle and size of the ``i``-th of ``n`` states of a place, in units of its radius."""
    faced = layout.heading is not None
    if layout.kind != "grid":
        start, end = (2 * np.pi * i / n, 2 * np.pi * (i + 1) / n) if n > 1 else (0.0, 2 * np.pi)
        if faced and n > 1:
            start, end = (layout.heading[s] - np.pi / n, layout.heading[s] + np.pi / n)  # type: ignore[index]
        angles = np.linspace(start, end, max(48 // n, 8))
        rim = np.stack([np.cos(angles), np.sin(angles)], 1)
        middle = 0.6 * np.array([np.cos((start + end) / 2), np.sin((start + end) / 2)])
        return (np.vstack([[(0, 0)], rim]), middle, 0.5) if n > 1 else (rim, np.zeros(2), 1.0)
    if faced:
        angle = float(layout.heading[s])  # type: ignore[index]
        turn = np.array([[np.cos(angle), down * np.sin(angle)], [-np.sin(angle), down * np.cos(angle)]])
        return np.array([(0, 0), (1, 1), (1, -1)]) @ turn, np.array([0.62, 0.0]) @ turn, 0.5
    columns = int(np.ceil(np.sqrt(n)))
    rows = -(-n // columns)
    row, column = divmod(i, columns)
    width, height = 2 / columns, 2 / rows
    low = np.array([-1 + column * width, -1 + row * height])
    corners = low + np.array([(0, 0), (width, 0), (width, height), (0, height)])
    return corners, low + np.array([width, height]) / 2, 1 / max(rows, columns)


def _panels(
    layout: Layout, frame: _Frame, theme: Theme, beside: float = 0.0
) -> tuple[Figure, list[Axes], Axes | None]:
    """Make a figure with axes for each layer, and axes for a key ``beside`` them, so many inches wide."""
    n = len(layout.layers)
    side = int(np.ceil(np.sqrt(n)))
    width, height = np.ptp(_ground(layout, frame), axis=0) + 2.4 * frame.radius
    if layout.kind == "grid":
        scale = max(_INCHES_PER_CELL, min(0.95, 3.4 / max(width, height)))
    else:
        scale = _SPAN / max(width, height)
    wide, tall = max(width * scale, 1.8), max(height * scale, 1.4)
    rows = -(-n // side)
    extra = 0.7 + (beside or 1.1)
    figure = new_figure(theme, side * wide + extra, max(rows * tall + 1.2, 5.4 if beside else 2.6))
    ratios = [wide] * side + ([beside] if beside else [])
    grid = figure.add_gridspec(rows, side + bool(beside), width_ratios=ratios)
    panels = [figure.add_subplot(grid[divmod(i, side)]) for i in range(n)]
    for i, axes in enumerate(panels):
        _dress_map(axes, theme, layout, frame, layout.layers[i])
    return figure, panels, figure.add_subplot(grid[:, -1]) if beside else None


def _ground(layout: Layout, frame: _Frame) -> Float[np.ndarray, "Q 2"]:
    """Everything that a map has to hold: places, further floor and marks, as (x, y)."""
    grid = layout.kind == "grid"
    other = [*layout.floor, *(mark.position for mark in layout.marks)]
    return np.array([*frame.xy.tolist(), *((p[1], p[0]) if grid else p for p in other)], float)


def _dress_map(axes: Axes, theme: Theme, layout: Layout, frame: _Frame, title: str) -> None:
    (left, low), (right, high) = (f(_ground(layout, frame), axis=0) for f in (np.min, np.max))
    room = 1.4 * frame.radius
    axes.set_xlim(left - room, right + room)
    axes.set_ylim(*((low - room, high + room) if frame.down > 0 else (high + room, low - room)))
    axes.set_aspect("equal")
    if layout.kind == "graph":
        dress(axes, theme, title=title, grid=None)
        axes.set_axis_off()
        return
    grid = layout.kind == "grid"
    unit = "cells" if grid else layout.unit
    x, y = ("column", "row") if grid else ("x", "y")
    dress(axes, theme, title=title, x=_with_unit(x, unit), y=_with_unit(y, unit), grid=None)
    axes.xaxis.set_major_locator(MaxNLocator(9, integer=grid))
    axes.yaxis.set_major_locator(MaxNLocator(9, integer=grid))


def _with_unit(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _draw_ground(
    axes: Axes,
    theme: Theme,
    layout: Layout,
    frame: _Frame,
    here: Int[np.ndarray, " h"],
    visible: Int[np.ndarray, " v"],
) -> None:
    """Places of some states, the visible ones tinted, with what joins them, further floor and marks."""
    inside, seen = set(layout.place[here].tolist()), set(layout.place[visible].tolist())
    if layout.kind == "grid":
        places = {i: (int(r), int(c)) for i, (r, c) in enumerate(layout.positions)}
        floor = dict.fromkeys(layout.floor, "none") | dict.fromkeys(places.values(), "none")
        floor |= {places[i]: theme.view if i in seen else theme.cell for i in inside}
        for (row, column), fill in sorted(floor.items()):
            state = fill != "none"
            axes.add_patch(Rectangle(
                (column - 0.5, row - 0.5), 1, 1, facecolor=fill, linewidth=1.2,
                edgecolor=theme.surface if state else theme.grid, zorder=2.0 if state else 2.5,
            ))  # fmt: skip
    else:
        lines = frame.xy[layout.edges]
        axes.add_collection(LineCollection(list(lines), colors=theme.grid, linewidths=1.4, zorder=1.5))
        turns = np.linspace(0, 2 * np.pi, 48)
        circle = frame.radius * np.stack([np.cos(turns), np.sin(turns)], 1)
        fills = [theme.view if i in seen else theme.cell for i in sorted(inside)]
        axes.add_collection(PolyCollection(
            [frame.xy[i] + circle for i in sorted(inside)], facecolors=fills, edgecolors=theme.muted,
            linewidths=0.9, zorder=2.0,
        ))  # fmt: skip
        if _are_named(layout):
            _draw_names(axes, theme, layout, frame, here, 4)
    _draw_marks(axes, theme, layout, frame)


def _are_named(layout: Layout) -> bool:
    """Say whether the names of places are few and short enough to stand in their circles."""
    return layout.kind != "grid" and layout.n_places <= _MOST_NAMES and max(map(len, layout.names)) <= 4


def _draw_names(
    axes: Axes, theme: Theme, layout: Layout, frame: _Frame, here: Int[np.ndarray, " h"], layer: float,
    halo: bool = False,
) -> None:  # fmt: skip
    if not _are_named(layout):
        return
    behind: dict[str, Any] = {"boxstyle": "round,pad=0.12", "facecolor": theme.surface, "edgecolor": "none"}
    for i in sorted(set(layout.place[here].tolist())):
        axes.text(
            float(frame.xy[i, 0]), float(frame.xy[i, 1]), for_figure(layout.names[i]), color=theme.ink,
            fontsize=SMALL - 1, ha="center",
            va="center", zorder=layer, bbox={**behind, "alpha": 0.75} if halo else None,
        )  # fmt: skip


def _draw_marks(axes: Axes, theme: Theme, layout: Layout, frame: _Frame) -> None:
    side = 2 * frame.radius * (1.0 if layout.kind == "grid" else 1.35)
    for mark in layout.marks:
        x, y = mark.position[::-1] if layout.kind == "grid" else mark.position
        _draw_mark(axes, theme, x, y, mark.letter, side, frame.down)


def _draw_mark(
    axes: Axes, theme: Theme, x: float, y: float, letter: str, side: float = 1.0, down: int = -1
) -> None:
    corner = (x - 0.46 * side, y - 0.46 * side)
    axes.add_patch(Rectangle(
        corner, 0.92 * side, 0.92 * side, facecolor="none", edgecolor=theme.goal, linewidth=2.0, zorder=5
    ))  # fmt: skip
    # In a corner, which glyphs leave free: those of a cell stand at the middles of its sides.
    axes.text(
        x - 0.29 * side, y + 0.29 * side * down, letter, ha="center", va="center_baseline", color=theme.goal,
        fontweight="bold", fontsize=7.5, zorder=6,
        bbox={"boxstyle": "square,pad=0.08", "facecolor": theme.surface, "edgecolor": "none", "alpha": 0.85},
    )  # fmt: skip


# -- actions ------------------------------------------------------------------------------------------

# In the frame of an agent that faces the reader's right from a place's centre: x ahead, y to its left; places
# are one wide.
_BEND = [(0.15, -0.09), (0.24, -0.09), (0.30, -0.075), (0.335, -0.03), (0.34, 0.02)]


def _arrow(line: Sequence[tuple], head: Sequence[tuple]) -> Path:
    """Make a line and a filled triangle at its end."""
    there_and_back = [*line, *reversed(line)]
    codes = [Path.MOVETO] + [Path.LINETO] * (len(there_and_back) - 1)
    triangle = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path([*there_and_back, *head, head[0]], codes + triangle)


# At the side that a state faces.
_FACING = {
    FORWARD: _arrow([(0.16, 0.0), (0.32, 0.0)], [(0.31, 0.085), (0.45, 0.0), (0.31, -0.085)]),
    LEFT: _arrow(_BEND, [(0.265, 0.02), (0.34, 0.15), (0.415, 0.02)]),
    RIGHT: _arrow([(x, -y) for x, y in _BEND], [(0.265, -0.02), (0.34, -0.15), (0.415, -0.02)]),
    STAY: Path.circle((0.31, 0.0), 0.06),
}
# About the middle of a state's part of its place.
_MIDDLE = {
    TOWARD: _arrow([(-0.31, 0.0), (0.15, 0.0)], [(0.12, 0.13), (0.36, 0.0), (0.12, -0.13)]),
    STAY: Path.circle((0.0, 0.0), 0.09),
}
# Outside the circle of a place, whose name stands inside.
_OUTSIDE = {
    TOWARD: _arrow([(0.5, 0.0), (0.9, 0.0)], [(0.85, 0.16), (1.12, 0.0), (0.85, -0.16)]),
    STAY: Path.circle((0.68, 0.0), 0.11),
}


def _placed(
    points: np.ndarray, at: np.ndarray, angle: float, size: float = 1.0, down: int = -1
) -> Float[np.ndarray, "n 2"]:
    """Points of an agent's frame at (x, y), turned by an angle, in axes whose y grows downward or upward."""
    cos, sin = np.cos(angle), np.sin(angle)
    return size * np.asarray(points) @ np.array([[cos, down * sin], [-sin, down * cos]]) + at


def _moves(
    mdp: TabularMDP, actions: Int[np.ndarray, " S"], layout: Layout
) -> tuple[Int[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Find the likeliest effect of each state's action on the map, and its direction, against the clock."""
    s = np.arange(mdp.n_states)
    likeliest = np.asarray(mdp.probabilities)[s, actions].argmax(1)
    following = np.asarray(mdp.successors)[s, actions, likeliest]
    way = layout.positions[layout.place[following]] - layout.positions[layout.place]
    x, y = (way[:, 1], -way[:, 0]) if layout.kind == "grid" else way.T
    goes = layout.place[following] != layout.place
    kinds, angles = np.where(goes, TOWARD, STAY), np.arctan2(y, x)
    if layout.heading is None:
        return kinds, angles
    heading = layout.heading
    ahead = goes & (np.cos(angles - heading) > 0.99)
    turn = np.round((heading[following] - heading) / (np.pi / 2)).astype(int) % 4
    turned = np.array([STAY, LEFT, LEFT, RIGHT])[turn]
    return np.where(ahead, FORWARD, np.where(goes, TOWARD, turned)), np.where(ahead | ~goes, heading, angles)


def _draw_actions(
    axes: Axes,
    theme: Theme,
    layout: Layout,
    frame: _Frame,
    here: Int[np.ndarray, " h"],
    kinds: Int[np.ndarray, " S"],
    angles: Float[np.ndarray, " S"],
    agrees: Bool[np.ndarray, " S"],
) -> None:
    wedges = [0.96 * frame.shapes[s] + 0.04 * frame.spots[s] for s in here if not agrees[s]]
    axes.add_collection(PolyCollection(wedges, facecolors=theme.mismatch, edgecolors="none", zorder=3))
    glyphs = [_glyph(layout, frame, s, int(kinds[s]), float(angles[s])) for s in here]
    _draw_glyphs(axes, theme, glyphs, agrees[here])


def _glyph(layout: Layout, frame: _Frame, s: int, kind: int, angle: float) -> Path:
    wide = 2 * frame.radius
    if layout.heading is not None and kind in _FACING:
        path, at, size = _FACING[kind], frame.xy[layout.place[s]], wide
        angle = float(layout.heading[s])
    elif _are_named(layout) and frame.sizes[s] == 1:
        path, at, size = _OUTSIDE[kind], frame.xy[layout.place[s]], wide
        angle = np.pi / 3 if kind == STAY else angle
    else:
        path, at, size = _MIDDLE[kind], frame.spots[s], wide * float(frame.sizes[s])
    return Path(_placed(np.asarray(path.vertices), at, angle, size, frame.down), path.codes)


def _draw_glyphs(axes: Axes, theme: Theme, glyphs: Sequence[Path], agrees: Iterable[bool]) -> None:
    colors = [theme.match if ok else theme.ink for ok in agrees]
    axes.add_collection(
        PathCollection(list(glyphs), facecolors=colors, edgecolors=colors, linewidths=1.1, zorder=4)
    )


def _draw_key(
    axes: Axes | None,
    theme: Theme,
    layout: Layout,
    kinds: Int[np.ndarray, " S"],
    judged: bool,
    occluded: bool,
) -> None:
    """Draw the key of glyphs and fills with the map's own glyphs."""
    assert axes is not None
    facing = layout.heading is not None
    place = "cell" if layout.kind == "grid" else "place"
    shared = len({*zip(layout.place, layout.layer, strict=True)}) < layout.n_states
    explained = f"An arrow points to the {place}\nthat most probably follows."
    if facing:
        side = f"the glyph at a {place}'s right edge is"
        explained = f"A state is a {place} and a heading:\n{side}\nwhat it does facing right."
    elif shared:
        explained = f"States of one {place} stand together.\n{explained}"
    glyphs = {
        FORWARD: "moves forward", LEFT: "turns left", RIGHT: "turns right",
        TOWARD: f"goes to another {place}", STAY: "stops" if facing else f"stays in its {place}",
    }  # fmt: skip
    shown = (FORWARD, LEFT, RIGHT, STAY) if facing else ()
    key: list[tuple[int | str, str]] = [
        (kind, label) for kind, label in glyphs.items() if kind in shown or (kinds == kind).any()
    ]
    key += [("mismatch", "differs from the expert")] if judged else []
    key += [("view", "in the learner's view"), ("cell", "out of view")] if occluded else []
    key += list({mark.letter: mark.meaning for mark in layout.marks}.items())
    axes.set_axis_off()
    axes.set_xlim(-0.1, 6)
    axes.set_ylim(1.9 + len(key), -0.2)
    axes.set_aspect("equal", anchor="NW")
    axes.text(0, 0, explained, color=theme.ink, fontsize=SMALL, va="top", linespacing=1.3)
    letters = {mark.letter for mark in layout.marks}
    for i, (what, label) in enumerate(key):
        y = 2.3 + i
        axes.text(1.1, y, for_figure(label), color=theme.ink, fontsize=SMALL + 0.5, va="center")
        if what in ("view", "cell"):
            fill = theme.view if what == "view" else theme.cell
            axes.add_patch(Rectangle((0.05, y - 0.4), 0.8, 0.8, facecolor=fill, edgecolor=theme.grid))
        elif what in letters:
            _draw_mark(axes, theme, 0.45, y, str(what))
        elif what == "mismatch":
            axes.add_patch(Rectangle((0.05, y - 0.4), 0.8, 0.8, facecolor=theme.mismatch, edgecolor="none"))
        else:
            kind = int(what)
            path = _FACING[kind] if facing and kind in _FACING else _MIDDLE[kind]
            at, angle = (np.array([0.45, y + 0.28]), np.pi / 2) if facing else (np.array([0.45, y]), 0.0)
            glyph = Path(_placed(np.asarray(path.vertices), at, angle), path.codes)
            _draw_glyphs(axes, theme, [glyph], [True])


# -- a hidden path ------------------------------------------------------------------------------------

# Empty rows between strands of places that do not continue each other.
_GAP = 2
# Neighbours of a place on average, up to which a floor may be one of corridors.
_NEIGHBOURS = 2.5
# So many strands are corridors; a tree of many short ends has more.
_MOST_STRANDS = 8
# Of many places those are drawn that are ever more probable than this.
_HARDLY = 0.01
_ROOM = 0.165


def hidden_path(
    posterior: Float[np.ndarray, "L S"],
    seen: Bool[np.ndarray, " L"],
    layout: Layout,
    path: Int[np.ndarray, " L"] | None = None,
    *,
    seconds: float | None = None,
    theme: Theme = LIGHT,
    title: str = "Where the agent may have been",
) -> Figure:
    """Draw the belief about one path: probability of each place at each step.

    Places run along the longest corridor, then the next, as listed by :func:`corridors`; the cells of an open
    grid run row by row.

    Parameters
    ----------
    posterior : float ``[L, S]``
        ``posterior[t, s] = P(s_t = s | everything seen)``, the state marginals of
        :func:`~i2rl.inference.completion.smoothing.smooth_all`.
    seen : bool ``[L]``
        Whether each step was seen.
    path : int ``[L]``, optional
        The true states, where they are known.
    seconds : float, optional
        How long a step takes; the axis counts steps without it.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    See Also
    --------
    policy_map, value_map

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import hidden_path
    >>> from i2rl.models import Layout
    >>> belief = np.array([[1, 0, 0], [0.2, 0.8, 0], [0, 0, 1]])  # three steps, three cells
    >>> layout = Layout.grid([(0, 0), (0, 1), (0, 2)])
    >>> hidden_path(belief, np.array([True, False, True]), layout).axes[1].get_xlabel()
    'step'
    """
    posterior, seen = np.asarray(posterior), np.asarray(seen, bool)
    length = len(seen)
    if not isinstance(layout, Layout):
        raise TypeError(f"layout must be a Layout, such as Layout.grid(cells); got {type(layout).__name__}")
    if posterior.shape != (length, layout.n_states):
        raise ValueError(
            f"posterior must have shape [L, S] = {(length, layout.n_states)}; got {posterior.shape}"
        )
    walked = None if path is None else np.asarray(path)
    visited = np.asarray((posterior > _HARDLY).any(0))
    if walked is not None:
        visited[walked] = True
    strands, along = _strands(layout, set(layout.place[visited].tolist()))
    starts = np.cumsum([0] + [len(strand) + _GAP for strand in strands])
    row = np.full(layout.n_places, -1)
    for start, strand in zip(starts, strands, strict=False):
        row[list(strand)] = start + np.arange(len(strand))
    position = row[layout.place]
    height = int(starts[-1]) - _GAP
    belief = np.zeros((height, length))
    np.add.at(belief, position[position >= 0], posterior.T[position >= 0])
    left_out = int((row < 0).sum())

    times = np.arange(length) * (seconds or 1.0)
    edges = (np.arange(length + 1) - 0.5) * (seconds or 1.0)
    # Room for every name where that makes no tower.
    inches = max(_ROOM if _ROOM * height <= 5.0 else 0.115, 2.0 / height)
    figure = new_figure(theme, 8.6, inches * height + 2.2)
    strip, axes = figure.subplots(2, 1, sharex=True, height_ratios=[0.2, inches * height])
    image = axes.pcolormesh(
        edges, np.arange(height + 1) - 0.5, belief, cmap=theme.colormap, vmin=0, vmax=1, rasterized=True
    )
    for start in starts[1:-1]:
        axes.axhline(start - (_GAP + 1) / 2, color=theme.muted, linewidth=0.9, linestyle=(0, (5, 4)))
    borders = edges[1:-1][seen[1:] != seen[:-1]]
    axes.vlines(borders, -0.5, height - 0.5, color=theme.muted, linewidth=0.8)
    place = "cell" if layout.kind == "grid" else "place"
    y = f"{place} (row,column)" if layout.kind == "grid" else place
    dress(axes, theme, x="time (s)" if seconds else "step", y=f"{y}{along}", grid=None)
    ticks = [int(row[i]) for strand in strands for i in _landmarks(strand, layout, inches)]
    names = {int(r): name for r, name in zip(row, layout.names, strict=True)}
    name_ticks(axes, "y", ticks, [names[i] for i in ticks])
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_xlim(edges[0], edges[-1])
    if not seconds:
        axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    _draw_strip(strip, theme, edges, seen)
    if path is not None:
        _draw_walk(figure, axes, theme, times, position[walked], seen)
    bar = figure.colorbar(image, ax=[strip, axes], pad=0.015, fraction=0.04, aspect=35)
    dress_bar(bar, theme, f"probability of the {place}")
    if left_out:
        title = f"{title}\nleft out: {counted(left_out, place)} that never reach {_HARDLY:.0%}"
    headline(figure, theme, title, TEXT + 1.5)
    return figure


def _draw_walk(
    figure: Figure,
    axes: Axes,
    theme: Theme,
    times: Float[np.ndarray, " L"],
    walked: Int[np.ndarray, " L"],
    seen: Bool[np.ndarray, " L"],
) -> None:
    # No line where the path goes over from one strand to another: it would cross places never visited.
    jumps = np.flatnonzero(np.abs(np.diff(walked)) > 1) + 1
    line_x, line_y = (np.insert(np.asarray(v, float), jumps, np.nan) for v in (times, walked))
    axes.plot(line_x, line_y, color=theme.series[1], linewidth=1.2, zorder=3)
    for which, fill in ((seen, theme.series[1]), (~seen, theme.surface)):
        axes.plot(
            times[which], walked[which], linestyle="none", marker="o", markersize=3.8,
            markeredgewidth=1.1, color=theme.series[1], markerfacecolor=fill, zorder=4,
        )  # fmt: skip
    line: dict[str, Any] = {"color": theme.series[1], "linewidth": 1.2, "marker": "o", "markersize": 4}
    handles = [
        Line2D([], [], **line, label="true path, seen"),
        Line2D([], [], **line, markerfacecolor=theme.surface, label="true path, hidden"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=TEXT,
        labelcolor=theme.ink,
    )  # fmt: skip


def _draw_strip(
    axes: Axes, theme: Theme, edges: Float[np.ndarray, " L"], seen: Bool[np.ndarray, " L"]
) -> None:
    """Above the belief: when the agent was in view."""
    for t, here in enumerate(seen):
        color = theme.goal if here else theme.cell
        axes.axvspan(edges[t], edges[t + 1], facecolor=color, edgecolor="none")
    dress(axes, theme, grid=None)
    axes.set_yticks([])
    axes.tick_params(bottom=False, labelbottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.legend(
        handles=[Patch(color=theme.goal, label="in view"), Patch(color=theme.cell, label="hidden")],
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=2,
        frameon=False,
        fontsize=SMALL,
        labelcolor=theme.ink,
    )


def _strands(layout: Layout, visited: set[int]) -> tuple[list[tuple[int, ...]], str]:
    """Places in the order of the rows, in strands that stand apart, and what the axis says of the order.

    Where places are many and no corridors, those alone that are ``visited``.
    """
    if 2 * len(layout.edges) <= _NEIGHBOURS * layout.n_places:
        strands = corridors(layout)
        if len(strands) <= _MOST_STRANDS:
            return strands, ", along the corridor"
    kept = np.arange(layout.n_places)
    if len(kept) > _MOST_NAMES:
        kept = np.array(sorted(visited))
    if layout.kind == "grid":
        rows = layout.positions[kept, 0]
        return [tuple(kept[rows == r].tolist()) for r in np.unique(rows)], ", row by row"
    # Neighbours close together: by the second eigenvector of the graph's Laplacian (Fiedler's).
    joined = np.zeros((layout.n_places, layout.n_places))
    joined[tuple(layout.edges.T)] = joined[tuple(layout.edges.T[::-1])] = 1
    _, vectors = np.linalg.eigh(np.diag(joined.sum(1)) - joined)
    along = vectors[:, min(1, layout.n_places - 1)]
    order = kept[np.argsort(along[kept] * (1 if along[0] <= 0 else -1), kind="stable")]
    return [tuple(order.tolist())], ", neighbours close together"


def corridors(layout: Layout) -> list[tuple[int, ...]]:
    """List places in walking order: the longest corridor, then the longest of what is left, and so on.

    A corridor is the longest of the shortest paths between two places. A closed loop is one, all around.
    """
    neighbours: dict[int, set[int]] = {i: set() for i in range(layout.n_places)}
    for i, j in layout.edges.tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    left, strands = set(neighbours), []
    while left:
        near = {i: neighbours[i] & left for i in left}
        if len(left) > 2 and all(len(n) == 2 for n in near.values()):
            strand = _around(near)
        else:
            ends = {max(_distances(near, i).items(), key=lambda item: (item[1], item[0])) for i in left}
            far = max(ends, key=lambda item: (item[1], item[0]))[0]
            distance = _distances(near, far)
            i = max(distance, key=lambda c: (distance[c], c))
            strand = [i]
            while i != far:
                i = min(near[i], key=lambda c: (distance[c], c))
                strand.append(i)
        strands.append(tuple(min(strand, strand[::-1])))
        left -= set(strand)
    return strands


def _around(near: dict[int, set[int]]) -> list[int]:
    """Order a closed loop from its smallest place, toward its smaller neighbour."""
    strand = [min(near)]
    while following := sorted(near[strand[-1]] - set(strand)):
        strand.append(following[0])
    return strand


def _distances(near: dict[int, set[int]], start: int) -> dict[int, int]:
    distance, frontier = {start: 0}, [start]
    while frontier:
        following = {n for i in frontier for n in near[i]} - distance.keys()
        distance.update(dict.fromkeys(following, distance[frontier[0]] + 1))
        frontier = list(following)
    return distance


def _landmarks(strand: Sequence[int], layout: Layout, inches: float) -> list[int]:
    """Places worth a label: all where there is room, else ends, corners, and one now and then between."""
    if inches >= _ROOM:
        return list(strand)
    corner = [i for i in range(1, len(strand) - 1) if _turns(layout, strand[i - 1 : i + 2])]
    kept = sorted({0, *corner, len(strand) - 1})
    between = [i for i in range(0, len(strand), 4) if min(abs(i - k) for k in kept) >= 3]
    return [strand[i] for i in sorted({*kept, *between})]


def _turns(layout: Layout, three: Sequence[int]) -> bool:
    steps = np.diff(layout.positions[list(three)], axis=0)
    return layout.kind == "grid" and bool(np.ptp(steps, axis=0).any())
