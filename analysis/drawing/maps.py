"""Pictures of a patrol on its floor: what a policy does in each state, where a hidden patroller may be."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from ...domains.patrol.process import FORWARD, LEFT, RIGHT, SECONDS_PER_STEP, STOP, Cell, Patrol, break_ties
from ...models.process.planning import greedy_actions
from ..judging.metrics import optimal_actions
from .style import LIGHT, SMALL, TEXT, Theme, dress, dress_bar, headline, new_figure

_INCHES_PER_CELL = 0.46


def policy_map(
    patrol: Patrol,
    policy: Float[np.ndarray, "S A"],
    observability: int | None = None,
    *,
    theme: Theme = LIGHT,
    title: str = "Learned policy",
) -> Figure:
    """Draw the likeliest action of a policy in every state, and mark where the expert's differs.

    Each cell carries four glyphs, one per heading, at the side faced: an arrow (forward), a hook (turn) or
    a dot (stop). Every optimal action of the expert counts as agreement; ties of ``policy`` go as in the
    released code, :func:`~i2rl.domains.patrol.process.break_ties`. ``observability`` tints the cells in view.
    Instance 1 shows one map for each hallway visited last.

    Raises ``ValueError`` for a policy of another shape and for an observability the instance lacks.
    """
    policy = np.asarray(policy)
    shape = (patrol.mdp.n_states, patrol.mdp.n_actions)
    if policy.shape != shape:
        raise ValueError(f"a policy of {patrol.name} has shape {shape}, got {policy.shape}")
    view = None if observability is None else np.asarray(patrol.visibility(observability).visibility) > 0
    optimal = np.asarray(optimal_actions(patrol.mdp, jnp.asarray(patrol.weights)))
    actions = break_ties(np.asarray(greedy_actions(jnp.asarray(policy)))).argmax(1)
    agrees = optimal[np.arange(len(actions)), actions]

    phases = sorted({state.phase for state in patrol.states})
    floor = sorted(set(patrol.cells) | set(patrol.breach.cells if patrol.breach else ()))
    rows, columns = (np.ptp([cell[i] for cell in floor]) + 2 for i in (0, 1))
    side = 2 if len(phases) > 1 else 1
    figure = new_figure(
        theme, side * columns * _INCHES_PER_CELL + 3.4, max(side * rows * _INCHES_PER_CELL + 1.6, 5.4)
    )
    grid = figure.add_gridspec(side, side + 1, width_ratios=[columns * _INCHES_PER_CELL] * side + [2.7])
    for i, phase in enumerate(phases):
        axes = figure.add_subplot(grid[divmod(i, side)])
        here = [s for s, state in enumerate(patrol.states) if state.phase == phase]
        visible = {patrol.states[s].cell for s in here if view is not None and view[s]}
        heading = f"from hallway {phase} to {phase % len(phases) + 1}" if phase else ""
        dress(axes, theme, title=heading, x="column (cells)", y="row (cells)", grid=None)
        _draw_floor(axes, theme, patrol, {patrol.states[s].cell for s in here}, visible, floor)
        states = [patrol.states[s] for s in here]
        places = [(state.row, state.column, state.heading) for state in states]
        _draw_actions(axes, theme, places, actions[here], agrees[here])
    legend = figure.add_subplot(grid[:, -1])
    _draw_key(legend, theme, patrol.breach is not None, view is not None)
    seen = "" if observability is None else f", {observability} % observability"
    share = f"{agrees.sum()} of {len(agrees)} states as the expert ({100 * agrees.mean():.1f} %)"
    headline(figure, theme, f"{title}: {share}\n{patrol.name}{seen}", TEXT + 1.5)
    return figure


# In the frame of a patroller that faces the reader's right from a cell's centre: x ahead, y to its left.
_BEND = [(0.15, -0.09), (0.24, -0.09), (0.30, -0.075), (0.335, -0.03), (0.34, 0.02)]


def _arrow(line: Sequence[tuple], head: Sequence[tuple]) -> Path:
    """Make a line and a filled triangle at its end."""
    there_and_back = [*line, *reversed(line)]
    codes = [Path.MOVETO] + [Path.LINETO] * (len(there_and_back) - 1)
    triangle = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    return Path([*there_and_back, *head, head[0]], codes + triangle)


_GLYPHS = {
    FORWARD: _arrow([(0.16, 0.0), (0.32, 0.0)], [(0.31, 0.085), (0.45, 0.0), (0.31, -0.085)]),
    LEFT: _arrow(_BEND, [(0.265, 0.02), (0.34, 0.15), (0.415, 0.02)]),
    RIGHT: _arrow([(x, -y) for x, y in _BEND], [(0.265, -0.02), (0.34, -0.15), (0.415, -0.02)]),
    STOP: Path.circle((0.31, 0.0), 0.06),
}
_WEDGE = np.array([(0.03, 0.0), (0.48, 0.45), (0.48, -0.45)])


def _placed(points: np.ndarray, place: tuple[float, float, int]) -> Float[np.ndarray, "n 2"]:
    """Points of the patroller's frame at (row, column, heading), in axes whose rows grow downward."""
    row, column, heading = place
    cos, sin = np.cos(heading * np.pi / 2), np.sin(heading * np.pi / 2)
    return np.asarray(points) @ np.array([[cos, -sin], [-sin, -cos]]) + (column, row)


def _draw_actions(
    axes: Axes,
    theme: Theme,
    places: Sequence[tuple[float, float, int]],
    actions: Sequence[int],
    agrees: Sequence[bool],
) -> None:
    wedges = [_placed(_WEDGE, place) for place, ok in zip(places, agrees, strict=True) if not ok]
    axes.add_collection(PolyCollection(wedges, facecolors=theme.mismatch, edgecolors="none", zorder=3))
    glyphs = [
        Path(_placed(np.asarray(_GLYPHS[action].vertices), place), _GLYPHS[action].codes)
        for action, place in zip(map(int, actions), places, strict=True)
    ]
    colors = [theme.match if ok else theme.ink for ok in agrees]
    axes.add_collection(
        PathCollection(glyphs, facecolors=colors, edgecolors=colors, linewidths=1.1, zorder=4)
    )


def _draw_mark(axes: Axes, theme: Theme, row: float, column: float, letter: str) -> None:
    axes.add_patch(
        Rectangle(
            (column - 0.46, row - 0.46),
            0.92,
            0.92,
            facecolor="none",
            edgecolor=theme.goal,
            linewidth=2.0,
            zorder=5,
        )
    )
    # In a corner, which glyphs leave free: those of a cell stand at the middles of its sides.
    axes.text(
        column - 0.29,
        row - 0.29,
        letter,
        ha="center",
        va="center_baseline",
        color=theme.goal,
        fontweight="bold",
        fontsize=7.5,
        zorder=6,
        bbox={"boxstyle": "square,pad=0.08", "facecolor": theme.surface, "edgecolor": "none", "alpha": 0.85},
    )


def _draw_floor(
    axes: Axes,
    theme: Theme,
    patrol: Patrol,
    cells: Collection[Cell],
    visible: Collection[Cell],
    floor: Sequence[Cell],
) -> None:
    for cell in floor:
        fill = theme.view if cell in visible else theme.cell if cell in cells else "none"
        edge = theme.surface if cell in cells else theme.grid
        row, column = cell
        corner = (column - 0.5, row - 0.5)
        layer = 2.0 if cell in cells else 2.5
        axes.add_patch(Rectangle(corner, 1, 1, facecolor=fill, edgecolor=edge, linewidth=1.2, zorder=layer))
    if patrol.breach is not None:
        _draw_mark(axes, theme, *patrol.breach.start.cell, "S")
        for goal in patrol.breach.goals:
            _draw_mark(axes, theme, *goal, "G")
    rows, columns = zip(*floor, strict=True)
    axes.set_xlim(min(columns) - 0.7, max(columns) + 0.7)
    axes.set_ylim(max(rows) + 0.7, min(rows) - 0.7)
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(MaxNLocator(9, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(9, integer=True))


def _draw_key(axes: Axes, theme: Theme, marked: bool, occluded: bool) -> None:
    """Draw the key of glyphs and fills with the map's own glyphs, facing up."""
    key: list[tuple[int | str, str]] = [
        (FORWARD, "moves forward"),
        (LEFT, "turns left"),
        (RIGHT, "turns right"),
        (STOP, "stops"),
        ("mismatch", "differs from the expert"),
    ]
    key += [("view", "in the learner's view"), ("cell", "out of view")] if occluded else []
    key += [("S", "the learner's start"), ("G", "its goal")] if marked else []
    axes.set_axis_off()
    axes.set_xlim(-0.1, 6)
    axes.set_ylim(1.9 + len(key), -0.2)
    axes.set_aspect("equal", anchor="NW")
    axes.text(
        0,
        0,
        "A state is a cell and a heading:\nthe glyph at a cell's right edge is\nwhat it does facing right.",
        color=theme.ink,
        fontsize=SMALL,
        va="top",
        linespacing=1.3,
    )
    for i, (what, label) in enumerate(key):
        y = 2.3 + i
        axes.text(1.1, y, label, color=theme.ink, fontsize=SMALL + 0.5, va="center")
        if what in ("view", "cell"):
            fill = theme.view if what == "view" else theme.cell
            axes.add_patch(Rectangle((0.05, y - 0.4), 0.8, 0.8, facecolor=fill, edgecolor=theme.grid))
        elif isinstance(what, str) and what != "mismatch":
            _draw_mark(axes, theme, y, 0.45, what)
        else:
            action = FORWARD if isinstance(what, str) else what
            _draw_actions(axes, theme, [(y + 0.28, 0.45, 1)], [action], [what != "mismatch"])


# -- a hidden path ------------------------------------------------------------------------------------

# Empty rows between corridors that do not continue each other.
_GAP = 2


def hidden_path(
    patrol: Patrol,
    posterior: Float[np.ndarray, "L S"],
    seen: Bool[np.ndarray, " L"],
    path: Int[np.ndarray, " L"] | None = None,
    *,
    theme: Theme = LIGHT,
    title: str = "Where the patroller may have been",
) -> Figure:
    """Draw the belief about one patroller's path: probability of each cell at each step, along the corridors.

    ``posterior[t, s] = P(s_t = s | everything seen)``, the state marginals of
    :func:`~i2rl.inference.completion.smoothing.smooth_all`; ``seen[t]`` says whether the step was seen;
    ``path`` is the true one, where it is known. Cells run along the longest corridor, then the next, as
    listed by :func:`corridors`. Raises ``ValueError`` if the shapes do not fit.
    """
    posterior, seen = np.asarray(posterior), np.asarray(seen, bool)
    length = len(seen)
    if posterior.shape != (length, patrol.mdp.n_states):
        raise ValueError(
            f"posterior must have shape [L, S] = {(length, patrol.mdp.n_states)}, got {posterior.shape}"
        )
    strands = corridors(patrol.cells)
    starts = np.cumsum([0] + [len(strand) + _GAP for strand in strands])
    place = {
        cell: start + i
        for start, strand in zip(starts, strands, strict=False)
        for i, cell in enumerate(strand)
    }
    position = np.array([place[state.cell] for state in patrol.states])
    height = int(starts[-1]) - _GAP
    belief = np.zeros((height, length))
    np.add.at(belief, position, posterior.T)

    seconds = np.arange(length) * SECONDS_PER_STEP
    edges = (np.arange(length + 1) - 0.5) * SECONDS_PER_STEP
    figure = new_figure(theme, 8.6, 0.115 * height + 2.2)
    strip, axes = figure.subplots(2, 1, sharex=True, height_ratios=[0.2, 0.115 * height])
    image = axes.pcolormesh(
        edges, np.arange(height + 1) - 0.5, belief, cmap=theme.colormap, vmin=0, vmax=1, rasterized=True
    )
    for start in starts[1:-1]:
        axes.axhline(start - (_GAP + 1) / 2, color=theme.muted, linewidth=0.9, linestyle=(0, (5, 4)))
    borders = edges[1:-1][seen[1:] != seen[:-1]]
    axes.vlines(borders, -0.5, height - 0.5, color=theme.muted, linewidth=0.8)
    dress(axes, theme, x="time (s)", y="cell (row,column), along the corridor", grid=None)
    ticks = [i for strand in strands for i in _landmarks(strand, place)]
    names = {i: f"({row},{column})" for (row, column), i in place.items()}
    axes.set_yticks(ticks, [names[i] for i in ticks])
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_xlim(edges[0], edges[-1])
    _draw_strip(strip, theme, edges, seen)
    if path is not None:
        cells_walked = position[np.asarray(path)]
        # No line where the path goes over from one corridor to another: it would cross cells never visited.
        jumps = np.flatnonzero(np.abs(np.diff(cells_walked)) > 1) + 1
        line_x, line_y = (np.insert(np.asarray(v, float), jumps, np.nan) for v in (seconds, cells_walked))
        axes.plot(line_x, line_y, color=theme.series[1], linewidth=1.2, zorder=3)
        for which, fill in ((seen, theme.series[1]), (~seen, theme.surface)):
            axes.plot(
                seconds[which],
                cells_walked[which],
                linestyle="none",
                marker="o",
                markersize=3.8,
                markeredgewidth=1.1,
                color=theme.series[1],
                markerfacecolor=fill,
                zorder=4,
            )
        line: dict[str, Any] = {"color": theme.series[1], "linewidth": 1.2, "marker": "o", "markersize": 4}
        handles = [
            Line2D([], [], **line, label="true path, seen"),
            Line2D([], [], **line, markerfacecolor=theme.surface, label="true path, hidden"),
        ]
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=2,
            frameon=False,
            fontsize=TEXT,
            labelcolor=theme.ink,
        )
    bar = figure.colorbar(image, ax=[strip, axes], pad=0.015, fraction=0.04, aspect=35)
    dress_bar(bar, theme, "probability of the cell")
    headline(figure, theme, f"{title} ({patrol.name})", TEXT + 1.5)
    return figure


def _draw_strip(
    axes: Axes, theme: Theme, edges: Float[np.ndarray, " L"], seen: Bool[np.ndarray, " L"]
) -> None:
    """Above the belief: when the patroller was in view."""
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


def corridors(cells: Sequence[Cell]) -> tuple[tuple[Cell, ...], ...]:
    """Cells of a floor in walking order: the longest corridor, then the longest of what is left, and so on.

    A corridor is the longest of the shortest paths between two cells, by 4-neighbourhood.
    """
    left, strands = set(cells), []
    while left:
        ends = {max(_distances(left, cell).items(), key=lambda item: (item[1], item[0])) for cell in left}
        far = max(ends, key=lambda item: (item[1], item[0]))[0]
        distance = _distances(left, far)
        cell = max(distance, key=lambda c: (distance[c], c))
        strand = [cell]
        while cell != far:
            cell = min(_neighbours(cell) & distance.keys(), key=lambda c: (distance[c], c))
            strand.append(cell)
        strands.append(tuple(min(strand, strand[::-1])))
        left -= set(strand)
    return tuple(strands)


def _neighbours(cell: Cell) -> set[Cell]:
    row, column = cell
    return {(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)}


def _distances(cells: set[Cell], start: Cell) -> dict[Cell, int]:
    distance, frontier = {start: 0}, [start]
    while frontier:
        following = {n for cell in frontier for n in _neighbours(cell) & cells} - distance.keys()
        distance.update(dict.fromkeys(following, distance[frontier[0]] + 1))
        frontier = list(following)
    return distance


def _landmarks(strand: Sequence[Cell], place: dict[Cell, int]) -> list[int]:
    """Positions worth a label: ends, corners, and a cell now and then between."""
    corner = [
        i
        for i in range(1, len(strand) - 1)
        if strand[i + 1][0] - strand[i][0] != strand[i][0] - strand[i - 1][0]
    ]
    kept = sorted({0, *corner, len(strand) - 1})
    between = [i for i in range(0, len(strand), 4) if min(abs(i - k) for k in kept) >= 3]
    return [place[strand[i]] for i in sorted({*kept, *between})]
