"""Figures of a labyrinth study: bits per decision bout by bout, and the learned value on the maze."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..domains.labyrinth import (
    ACTIONS,
    BACK,
    FROM_ABOVE,
    HOME,
    LEVELS,
    N_NODES,
    WATER_PORT,
    Labyrinth,
    level_of,
    parent_of,
)
from ..models.planning import action_values, reward_of
from .labyrinth import BY_LEVEL, LEARNER, UNIFORM, LabyrinthStudy
from .style import LIGHT, SMALL, TEXT, TITLE, Theme, dress, foot, new_figure

_CORRIDOR, _WALL = 0.72, 0.14


def bits_by_bout(result: LabyrinthStudy, theme: Theme = LIGHT) -> Figure:
    """Running bits per decision against bouts, a panel for each view; every line named at its end."""
    figure = new_figure(theme, 6.2 * len(result.views), 4.6)
    panels = figure.subplots(1, len(result.views), squeeze=False, sharey=True)[0]
    bouts = np.arange(1, len(result.decisions) + 1)
    seen = np.cumsum(result.decisions)
    styles = _method_styles(theme)
    for axes, view in zip(panels, result.views, strict=True):
        running = {p.method: np.cumsum(p.bits) / seen for p in view.predictions}
        for method, line in running.items():
            axes.plot(bouts, line, **styles[method])
        first = axes is panels[0]
        dress(axes, theme, title=view.view, x="bout", y="bits per decision so far" if first else "")
        axes.set_xlim(1, len(bouts))
        axes.tick_params(labelleft=True)
    # Names are placed once the shared scale is known.
    for axes, view in zip(panels, result.views, strict=True):
        low, high = axes.get_ylim()
        order = sorted(view.predictions, key=lambda p: p.bits.sum())
        ends = np.array([p.bits.sum() / seen[-1] for p in order])
        for p, end, y in zip(order, ends, _spread(ends, 0.052 * (high - low)), strict=True):
            axes.annotate(
                f"{p.method}  {end:.3f}", (bouts[-1], y), (6, 0), textcoords="offset points", va="center",
                color=styles[p.method]["color"], fontsize=SMALL, annotation_clip=False,
                fontweight="bold" if p.method == LEARNER else "normal",
            )  # fmt: skip
    figure.suptitle(result.recording, color=theme.ink, fontsize=TITLE + 0.5, x=0.01, ha="left")
    foot(figure, theme, "each bout predicted before it is learned from")
    return figure


def _method_styles(theme: Theme) -> dict[str, dict[str, Any]]:
    red, blue, green = theme.series[1], theme.series[0], theme.series[2]
    return {
        LEARNER: {"color": red, "linewidth": 2.6, "zorder": 3},
        BY_LEVEL: {"color": red, "linewidth": 1.4, "linestyle": (0, (5, 2))},
        UNIFORM: {"color": theme.muted, "linewidth": 1.4, "linestyle": (0, (1.5, 1.5))},
        "frequencies": {"color": theme.series[4], "linewidth": 1.4},
        "frequencies of choices": {"color": theme.series[4], "linewidth": 1.4, "linestyle": (0, (5, 2))},
        "given entry": {"color": theme.series[3], "linewidth": 1.4},
        "level and entry": {"color": green, "linewidth": 1.4},
        "Markov": {"color": blue, "linewidth": 1.8},
    }


def _spread(heights: Float[np.ndarray, " m"], gap: float) -> Float[np.ndarray, " m"]:
    """Increasing heights moved apart to at least ``gap``, as little as a few sweeps can."""
    placed = np.array(heights, float)
    for _ in range(200):
        short = gap - np.diff(placed)
        if (short <= 1e-9).all():
            break
        push = np.maximum(short, 0.0) / 2
        placed[:-1] -= push
        placed[1:] += push
    return placed


def value_on_maze(result: LabyrinthStudy, theme: Theme = LIGHT) -> Figure:
    """The learned value of every place on the maze, a panel for each view, one scale of colours for all."""
    figure = new_figure(theme, 5.4 * len(result.views) + 0.9, 5.3)
    panels = figure.subplots(1, len(result.views), squeeze=False)[0]
    by_node = [
        values_by_node(result.maze, view.learned.weights, view.learned.values) for view in result.views
    ]
    shades = ScalarMappable(Normalize(np.nanmin(by_node), np.nanmax(by_node)), theme.colormap)
    for axes, view, values in zip(panels, result.views, by_node, strict=True):
        draw_maze(axes, values, shades, np.unique(result.maze.node[view.hidden]), theme)
        axes.set_title(view.view, color=theme.ink, fontsize=TITLE, loc="left")
    bar = figure.colorbar(shades, ax=list(panels), shrink=0.75, aspect=30, pad=0.01)
    bar.set_label("learned value of stepping in from above (nats)", color=theme.ink, fontsize=TEXT)
    bar.ax.tick_params(colors=theme.muted, labelcolor=theme.ink, labelsize=SMALL)
    bar.outline.set_edgecolor(theme.muted)
    figure.suptitle(result.recording, color=theme.ink, fontsize=TITLE + 0.5, x=0.01, ha="left")
    return figure


def values_by_node(
    maze: Labyrinth, weights: Float[np.ndarray, " K"], values: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " 127"]:
    """The value of stepping into each node from above, what it brings on the step included.

    NaN for the root, into which no step leads from above.
    """
    mdp = maze.mdp
    q = np.asarray(action_values(mdp, reward_of(mdp, jnp.asarray(weights)), jnp.asarray(values)))
    target = maze.node[np.asarray(mdp.successors)[..., 0]]
    state, action = np.nonzero((maze.entry == FROM_ABOVE)[:, None] & (np.arange(len(ACTIONS)) != BACK))
    by_node = np.full(N_NODES, np.nan)
    by_node[target[state, action]] = q[state, action]
    return by_node


def maze_layout() -> Float[np.ndarray, "128 2"]:
    """Position of every node, home last: an H-tree entered from the left, left children on the left hand.

    Ends lie on a square grid with spacing 2; corridors halve in length at every second level.
    """
    position = np.zeros((N_NODES + 1, 2))
    heading = np.zeros((N_NODES, 2))
    heading[0] = (1.0, 0.0)
    for node in range(1, N_NODES):
        parent = parent_of(node)
        x, y = heading[parent]
        heading[node] = (-y, x) if node == 2 * parent + 1 else (y, -x)
        position[node] = position[parent] + heading[node] * 2.0 ** ((LEVELS - level_of(node)) // 2)
    position[HOME] = (-9.0, 0.0)
    return position


def draw_maze(
    axes: Axes,
    values: Float[np.ndarray, " 127"],
    shades: ScalarMappable,
    hidden: Int[np.ndarray, " h"],
    theme: Theme = LIGHT,
) -> None:
    """Draw corridors coloured by the value of the node they lead to (none: NaN); hidden ones are hatched."""
    position = maze_layout()

    def corridor(node: int, width: float, colour: Any) -> None:
        start = position[HOME if node == 0 else parent_of(node)]
        low, high = np.minimum(start, position[node]), np.maximum(start, position[node])
        axes.add_patch(
            Rectangle(tuple(low - width / 2), *(high - low + width), facecolor=colour, linewidth=0)
        )

    # Walls are what shows of a wider corridor beneath. Deeper ones first: a junction keeps its own colour.
    for node in range(N_NODES):
        corridor(node, _CORRIDOR + 2 * _WALL, theme.muted)
    for node in reversed(range(N_NODES)):
        corridor(node, _CORRIDOR, theme.cell if np.isnan(values[node]) else shades.to_rgba(values[node]))
    if len(hidden):
        low, high = position[hidden].min(0) - 0.5, position[hidden].max(0) + 0.5
        style: dict[str, Any] = {"edgecolor": theme.muted, "linewidth": 0.0, "hatch": "//"}
        axes.add_patch(Rectangle(tuple(low), *(high - low), facecolor=theme.surface, alpha=0.45, **style))
        axes.text((low[0] + high[0]) / 2, high[1] + 0.2, "out of view", ha="center", va="bottom",
                  color=theme.ink, fontsize=TEXT)  # fmt: skip
    port, home = position[WATER_PORT], position[HOME]
    axes.plot(*port, "o", markersize=8, markerfacecolor=theme.goal, markeredgecolor=theme.surface)
    outward = np.sign(port[0])
    axes.annotate(
        "water", port, (port[0] + 1.1 * outward, port[1]), color=theme.ink, fontsize=TEXT, va="center",
        ha="left" if outward > 0 else "right",
    )  # fmt: skip
    axes.plot(*home, "s", markersize=9, markerfacecolor=theme.surface, markeredgecolor=theme.ink)
    axes.annotate(
        "home", home, (0, 11), textcoords="offset points", ha="center", color=theme.ink, fontsize=TEXT
    )
    axes.set(xlim=(-9.9, 8.2), ylim=(-8.3, 9.0), aspect="equal")
    axes.axis("off")
