"""A picture of the sorting table: the onion's place and prediction, the hand, and the list."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, Ellipse, FancyBboxPatch, Polygon, Rectangle

from ..gym.canvas import FLOOR, INK, MUTED, PAGE, WALL, Scene, new_canvas
from .process import (
    AT_BIN,
    AT_CONVEYOR,
    AT_EYES,
    BIN,
    BLEMISHED,
    EMPTY,
    GOOD,
    HELD,
    HOVERING,
    INSPECTED,
    LISTED,
    NO_LIST,
    PUT_BACK,
    TABLE,
    UNKNOWN,
    Sorting,
)

# Where things are, in the picture's units.
_ONION = {
    TABLE: (3.7, 1.65),
    PUT_BACK: (2.4, 1.65),
    HELD: (5.2, 4.0),
    INSPECTED: (7.0, 5.0),
    BIN: (10.0, 1.75),
}
_HAND = {AT_CONVEYOR: (3.7, 2.75), HOVERING: (5.2, 4.45), AT_EYES: (7.0, 5.45), AT_BIN: (10.0, 3.3)}
_RAIL = 6.9
_SKIN = {BLEMISHED: "#b4531a", GOOD: "#3d9a6f", UNKNOWN: "#d9cfa8"}
_SIGN = {BLEMISHED: "x", GOOD: "ok", UNKNOWN: "?"}
_LIST = {
    NO_LIST: ("no list", "onions not rolled"),
    EMPTY: ("list empty", "none blemished"),
    LISTED: ("list", "blemished onions"),
}


def sorting_scene(sorting: Sorting) -> Scene:
    """Draw the conveyor, eyes, bin, hand, and the claimed onion in the colour of its prediction."""
    axes = new_canvas(0, 11.6, 0, 7.2, 46, caption=1.1)
    _draw_table(axes)
    onion = Ellipse((0, 0), 0.92, 0.84, edgecolor=INK, linewidth=1.4, zorder=6)
    shoot = Polygon(np.zeros((3, 2)), facecolor="#6b8e4e", edgecolor=INK, linewidth=0.8, zorder=5)
    sign = axes.text(0, 0, "", fontsize=11, fontweight="bold", ha="center", va="center", zorder=8)
    arm = Rectangle((0, 0), 0.16, 1, facecolor=WALL, zorder=3)
    palm = Rectangle((0, 0), 0.9, 0.2, facecolor=WALL, edgecolor=INK, linewidth=1.0, zorder=7)
    fingers = [
        Rectangle((0, 0), 0.14, 0.5, facecolor=WALL, edgecolor=INK, linewidth=1.0, zorder=7) for _ in "lr"
    ]
    for patch in (onion, shoot, arm, palm, *fingers):
        axes.add_patch(patch)
    title = axes.text(0.55, 6.0, "", fontsize=10, fontweight="bold", color=INK, va="center", zorder=4)
    detail = axes.text(0.55, 5.55, "", fontsize=8, color=INK, va="center", zorder=4)
    marks = [
        Circle((0.8 + 0.5 * i, 4.98), 0.17, facecolor=_SKIN[BLEMISHED], edgecolor=INK, zorder=4)
        for i in range(3)
    ]
    for mark in marks:
        axes.add_patch(mark)

    def place(state: int) -> None:
        where, prediction, hand, listed = map(int, sorting.factors[state])
        x, y = _ONION[where]
        onion.set_center((x, y))
        onion.set_facecolor(_SKIN[prediction])
        shoot.set_xy([(x - 0.14, y + 0.38), (x, y + 0.68), (x + 0.14, y + 0.38)])
        sign.set_position((x, y - 0.02))
        sign.set_text(_SIGN[prediction])
        sign.set_color(INK if prediction == UNKNOWN else PAGE)
        hx, hy = _HAND[hand]
        arm.set_xy((hx - 0.08, hy + 0.2))
        arm.set_height(_RAIL - hy - 0.2)
        palm.set_xy((hx - 0.45, hy + 0.15))
        # Closed around an onion that is held, open otherwise.
        reach = (
            0.5 if (where == HELD and hand == HOVERING) or (where == INSPECTED and hand == AT_EYES) else 0.36
        )
        for finger, side in zip(fingers, (-0.52, 0.38), strict=True):
            finger.set_xy((hx + side, hy + 0.15 - reach))
            finger.set_height(reach)
        name, what = _LIST[listed]
        title.set_text(name)
        detail.set_text(what)
        for mark in marks:
            mark.set_visible(listed == LISTED)

    return Scene(
        axes, sorting.mdp, (arm, shoot, onion, palm, *fingers, sign, title, detail, *marks), place, 84
    )


def _draw_table(axes: Axes) -> None:
    # The belt and the unclaimed onions.
    axes.add_patch(Rectangle((0.2, 0.75), 6.4, 0.45, facecolor=WALL, edgecolor=INK, linewidth=1.0))
    for x in np.arange(0.6, 6.6, 0.8):
        axes.add_patch(Circle((x, 0.97), 0.15, facecolor=FLOOR, edgecolor=INK, linewidth=0.8))
    for x in (0.8, 1.5, 5.4, 6.1):
        axes.add_patch(Ellipse((x, 1.5), 0.62, 0.56, facecolor="#efe9d4", edgecolor=MUTED))
    axes.text(3.4, 0.5, "conveyor", color=MUTED, fontsize=9, ha="center", va="center")
    # The bin, its front drawn over what lies in it.
    axes.add_patch(
        Polygon([(9.0, 2.5), (9.3, 0.75), (10.7, 0.75), (11.0, 2.5)], facecolor=FLOOR, edgecolor=INK)
    )
    axes.text(10.0, 0.5, "bin", color=MUTED, fontsize=9, ha="center", va="center")
    axes.add_patch(Rectangle((0, _RAIL), 11.6, 0.14, facecolor=WALL))
    # The eyes.
    for x in (8.15, 8.85):
        axes.add_patch(Ellipse((x, 5.1), 0.6, 0.4, facecolor=PAGE, edgecolor=INK, linewidth=1.3))
        axes.add_patch(Circle((x - 0.12, 5.1), 0.13, facecolor=INK))
        axes.add_patch(Arc((x, 5.25), 0.7, 0.5, theta1=40, theta2=140, edgecolor=INK, linewidth=1.3))
    axes.text(8.5, 4.65, "eyes", color=MUTED, fontsize=9, ha="center", va="center")
    axes.text(6.25, 3.95, "hover", color=MUTED, fontsize=9, ha="center", va="center")
    axes.add_patch(
        FancyBboxPatch((0.4, 4.6), 2.4, 1.75, boxstyle="round,pad=0.05", facecolor="#fbf7e8", edgecolor=MUTED)
    )
