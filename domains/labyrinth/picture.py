"""Pictures of the mouse in its maze."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Polygon, Rectangle

from ..gym.canvas import (
    FLOOR,
    INK,
    WALL,
    WATER,
    Scene,
    new_canvas,
)
from .process import HOME, LEVELS, N_NODES, WATER_PORT, Labyrinth, parent_of


def maze_layout() -> np.ndarray:
    """Place nodes and home, ``[N_NODES + 1, 2]`` as (x, y): a tree of Hs, left and right as walked."""
    places = np.zeros((N_NODES + 1, 2))
    places[HOME] = 0.0, -16.0
    for node in range(1, N_NODES):
        level = int(np.log2(node + 1))
        ahead = _ahead(places, parent_of(node))
        side = np.array([-ahead[1], ahead[0]]) * (1 if node % 2 else -1)
        places[node] = places[parent_of(node)] + side * 2.0 ** (LEVELS // 2 - (level - 1) // 2)
    return places


def _ahead(places: np.ndarray, node: int) -> np.ndarray:
    """Direction in which a node is entered from above."""
    way = places[node] - places[parent_of(node)]
    return way / np.abs(way).sum()


def labyrinth_scene(labyrinth: Labyrinth) -> Scene:
    """Draw the maze with its water port and the mouse, which faces its destination."""
    places = maze_layout()
    axes = new_canvas(-15.5, 15.5, -17.5, 15.5, 16, caption=3)
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
    """Find the node from which each state was entered."""
    previous = np.full(len(labyrinth.node), -1)
    successors = np.asarray(labyrinth.mdp.successors)[..., 0]
    for s, a in np.argwhere(np.asarray(labyrinth.mdp.available)):
        previous[successors[s, a]] = labyrinth.node[s]
    start = np.asarray(labyrinth.mdp.initial) > 0
    previous[start] = HOME
    previous[labyrinth.node == HOME] = 0
    # A state without predecessor was entered from above.
    unknown = previous < 0
    previous[unknown] = [parent_of(int(n)) for n in labyrinth.node[unknown]]
    return previous
