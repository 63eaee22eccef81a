"""Pictures of the bounds: data against error, and the looseness of a bound."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...models.inputs.text import counted
from ..drawing.style import LIGHT, SMALL, Theme, dress, foot, head, name_ticks, new_figure, series_style
from ..drawing.text import number
from .coverage import Coverage
from .theorems import demonstrations_needed, table_7_1a

_NAMES = {
    "theorem": "Theorem 2 (hidden steps sampled)",
    "exact completion": "exact completion",
    "observed spread": "exact completion, observed spread",
}


def sample_size_plot(
    n_features: int,
    discount: float,
    deviations: Float[np.ndarray, " K"],
    confidence: float = 0.8,
    *,
    ignorance: float | None = None,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw trajectories against the log-likelihood error they buy, for the theorem and the tighter bounds.

    ``deviations [K]`` of the features' discounted averages. ``ignorance`` (nats) marks the error that zero
    weights achieve without any data. With six features the rows of Table 7.1(a) are shown as points.
    """
    errors = np.geomspace(4e-3, 0.25, 25)
    sizes: dict[str, list[int]] = {name: [] for name in _NAMES}
    for error in errors:
        # The theorem shares an error equally between epsilon and epsilon_s.
        needed = demonstrations_needed(
            n_features, error / 2, confidence, discount, epsilon_s=error / 2, deviations=deviations
        )["trajectories"]
        for name in sizes:
            sizes[name].append(needed[name])
    figure = new_figure(theme, 7.2, 4.8)
    axes = figure.subplots()
    nats = 2 * n_features * errors / (1 - discount)
    for i, (name, label) in enumerate(_NAMES.items()):
        style = series_style(theme, i)
        axes.plot(
            nats, sizes[name], color=style["color"], linestyle=style["linestyle"], linewidth=2, label=label
        )
    handles = list(axes.get_legend_handles_labels()[0])
    if n_features == 6:
        table = table_7_1a(discount=discount)
        points = axes.plot(
            table["error_nats"],
            table["trajectories"],
            "o",
            color=theme.series[0],
            markersize=6,
            markeredgecolor=theme.surface,
            label="Table 7.1(a)",
        )
        handles += points
    if ignorance is not None:
        axes.axvline(ignorance, color=theme.muted, linewidth=1.2, linestyle=(0, (1, 1.5)))
        axes.annotate(
            "right of this line,\nzero weights\nare as good",
            (ignorance, 0),
            (6, 6),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="bottom",
            fontsize=SMALL,
            color=theme.muted,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    dress(axes, theme, x="error of the log-likelihood (nats per trajectory)", y="trajectories needed")
    head(figure, theme, handles, title=title, columns=2)
    note = (
        "the curve shares the error equally; the table spends 0.05 on epsilon_s. " if n_features == 6 else ""
    )
    foot(
        figure,
        theme,
        f"{note}{counted(n_features, 'feature')}, discount {discount:g}, confidence {confidence:g}",
    )
    return figure


def looseness_plot(rows: Sequence[Coverage], *, theme: Theme = LIGHT, title: str = "") -> Figure:
    """Draw the promise of each bound beside the quantile observed, one line a bound.

    Bounds of one picture should share their unit (nats per trajectory).
    """
    if not rows:
        raise ValueError("`rows` must hold at least one row of a coverage study; got none")
    figure = new_figure(theme, 8.4, 1.7 + 0.42 * len(rows))
    axes = figure.subplots()
    heights = np.arange(len(rows))[::-1]
    for height, row in zip(heights, rows, strict=True):
        axes.plot([row.quantile, row.bound], [height, height], color=theme.grid, linewidth=3, zorder=1)
        axes.annotate(
            f"{number(row.looseness)} times",
            (row.bound, height),
            (7, 0),
            textcoords="offset points",
            va="center",
            fontsize=SMALL,
            color=theme.muted,
        )
    axes.plot([r.quantile for r in rows], heights, linestyle="none", marker="o", color=theme.series[0])
    axes.plot([r.bound for r in rows], heights, linestyle="none", marker="s", color=theme.series[1])
    name_ticks(
        axes, "y", heights, [f"{r.result}\nn = {r.trajectories:,}, covered {r.covered:.1%}" for r in rows]
    )
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 0.14)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    dress(axes, theme, x="gap of the expected log-likelihood (nats per trajectory)", grid="x")
    handles = [
        Line2D([], [], linestyle="none", marker=marker, color=color, label=label)
        for marker, color, label in (
            ("o", theme.series[0], "quantile seen, at the stated confidence"),
            ("s", theme.series[1], "bound"),
        )
    ]
    head(figure, theme, handles, title=title, columns=2)
    foot(figure, theme, f"{counted(rows[0].replications, 'simulated replication')} each")
    return figure
