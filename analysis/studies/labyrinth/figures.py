"""Figures of a labyrinth study: bits per decision bout by bout, and the learned value on the maze."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ....domains.labyrinth.process import (
    ACTIONS,
    BACK,
    FROM_ABOVE,
    HOME,
    N_NODES,
    WATER_PORT,
    Labyrinth,
    maze_positions,
    parent_of,
)
from ....models.process.planning import action_values, reward_of
from ...drawing.style import (
    LIGHT,
    SMALL,
    TEXT,
    TITLE,
    Theme,
    dress,
    dress_bar,
    foot,
    headline,
    method_styles,
    new_figure,
)
from ...drawing.text import for_figure
from .study import LEARNER, LabyrinthStudy

# In the units of the maze's layout, whose ends are four apart.
_CORRIDOR, _WALL = 1.44, 0.28


def bits_by_bout(result: LabyrinthStudy, theme: Theme = LIGHT) -> Figure:
    """Draw running bits per decision against bouts, a panel for each view; every line named at its end."""
    figure = new_figure(theme, 6.2 * len(result.views), 4.6)
    panels = figure.subplots(1, len(result.views), squeeze=False, sharey=True)[0]
    bouts = np.arange(1, len(result.decisions) + 1)
    seen = np.cumsum(result.decisions)
    styles = _method_styles(theme, result)
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
                for_figure(f"{p.method}  {end:.3f}"),
                (bouts[-1], end),
                (1.04, y),
                textcoords=("axes fraction", "data"),
                va="center",
                color=theme.ink,
                fontsize=SMALL,
                annotation_clip=False,
                fontweight="bold" if p.method == LEARNER else "normal",
                arrowprops={
                    "arrowstyle": "-",
                    "shrinkA": 0,
                    "shrinkB": 1,
                    "relpos": (0, 0.5),
                    "color": styles[p.method]["color"],
                    "linestyle": styles[p.method]["linestyle"],
                },
            )
    headline(figure, theme, result.recording)
    foot(figure, theme, "each bout predicted before it is learned from")
    return figure


def _method_styles(theme: Theme, result: LabyrinthStudy) -> dict[str, dict[str, Any]]:
    """Return the methods' styles without markers, the learner's line above and wider than the others."""
    names = [p.method for view in result.views for p in view.predictions]
    styles = {
        name: {**style, "marker": None, "linewidth": 1.4}
        for name, style in method_styles(theme, names).items()
    }
    styles[LEARNER] |= {"linewidth": 2.8, "zorder": 3}
    return styles


def _spread(heights: Float[np.ndarray, " m"], gap: float) -> Float[np.ndarray, " m"]:
    """Move increasing heights apart to at least ``gap``, as little as a few iterations can."""
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
    """Draw the learned value of every place on the maze, a panel a view, one scale of colours for all."""
    figure = new_figure(theme, 5.4 * len(result.views) + 0.9, 5.3)
    panels = figure.subplots(1, len(result.views), squeeze=False)[0]
    by_node = [
        values_by_node(result.maze, view.learned.weights, view.learned.values) for view in result.views
    ]
    shades = theme.signed_shades(np.array(by_node))
    for axes, view, values in zip(panels, result.views, by_node, strict=True):
        draw_maze(axes, values, shades, np.unique(result.maze.node[view.hidden]), theme)
        axes.set_title(view.view, color=theme.ink, fontsize=TITLE, loc="left")
    bar = figure.colorbar(shades, ax=list(panels), shrink=0.75, aspect=30, pad=0.01)
    dress_bar(bar, theme, "learned value of stepping in from above (nats)")
    bar.ax.axhline(0.0, color=theme.ink, linewidth=1.6)
    headline(figure, theme, result.recording)
    return figure


def values_by_node(
    maze: Labyrinth, weights: Float[np.ndarray, " K"], values: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " 127"]:
    """Compute the value of stepping into each node from above, with the reward of that step.

    NaN for the root, into which no step leads from above.
    """
    mdp = maze.mdp
    q = np.asarray(action_values(mdp, reward_of(mdp, jnp.asarray(weights)), jnp.asarray(values)))
    target = maze.node[np.asarray(mdp.successors)[..., 0]]
    state, action = np.nonzero((maze.entry == FROM_ABOVE)[:, None] & (np.arange(len(ACTIONS)) != BACK))
    by_node = np.full(N_NODES, np.nan)
    by_node[target[state, action]] = q[state, action]
    return by_node


def draw_maze(
    axes: Axes,
    values: Float[np.ndarray, " 127"],
    shades: ScalarMappable,
    hidden: Int[np.ndarray, " h"],
    theme: Theme = LIGHT,
) -> None:
    """Draw corridors coloured by the value of the node they lead to (none: NaN); hidden ones are hatched.

    The maze lies as its environment draws it (:func:`i2rl.domains.labyrinth.process.maze_positions`).
    """
    position = maze_positions()

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
        low, high = position[hidden].min(0) - 1.0, position[hidden].max(0) + 1.0
        style: dict[str, Any] = {"edgecolor": theme.muted, "linewidth": 0.0, "hatch": "//"}
        axes.add_patch(Rectangle(tuple(low), *(high - low), facecolor=theme.surface, alpha=0.45, **style))
        axes.text(
            (low[0] + high[0]) / 2,
            high[1] + 0.4,
            "out of view",
            ha="center",
            va="bottom",
            color=theme.ink,
            fontsize=TEXT,
        )
    port, home = position[WATER_PORT], position[HOME]
    axes.plot(*port, "o", markersize=8, markerfacecolor=theme.goal, markeredgecolor=theme.surface)
    axes.plot(*home, "s", markersize=9, markerfacecolor=theme.surface, markeredgecolor=theme.ink)
    for place, name in ((port, "water"), (home, "home")):
        axes.annotate(
            name,
            place,
            (0, -12),
            textcoords="offset points",
            ha="center",
            va="top",
            color=theme.ink,
            fontsize=TEXT,
        )
    axes.set(xlim=(-16, 16), ylim=(-19, 17), aspect="equal")
    axes.axis("off")
