"""Pictures of the study of label bias: the world, log-likelihood against reward, and where it depends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from ....models.inputs.text import counted
from ...drawing.charts import set_scale
from ...drawing.style import (
    SMALL,
    TEXT,
    Theme,
    dress,
    foot,
    head,
    method_styles,
    name_ticks,
    new_figure,
    series_style,
)
from ...drawing.text import number

if TYPE_CHECKING:
    from .study import LabelBiasStudy

_PATHS = 5


def draw_world(study: LabelBiasStudy, theme: Theme) -> Figure:
    """Draw the median world with the paths of some trajectories, from the least reward to the most."""
    world = study.world
    rows, columns = world.walls.shape
    figure = new_figure(theme, 6.4, 5.2)
    axes = figure.subplots()
    for r, c in world.cells:
        axes.add_patch(Rectangle((c - 0.5, r - 0.5), 1, 1, facecolor=theme.cell, edgecolor=theme.surface))
    for r, c in np.argwhere(world.walls):
        axes.add_patch(Rectangle((c - 0.5, r - 0.5), 1, 1, facecolor=theme.muted, edgecolor=theme.surface))
    for r, c in world.objects:
        axes.plot(c, r, marker="*", color=theme.ink, markersize=17, zorder=1)
    handles = [
        Patch(facecolor=theme.muted, label="wall"),
        Line2D([], [], marker="*", color=theme.ink, markersize=12, linestyle="", label="object"),
    ]
    cells = np.array(world.cells)
    ranked = np.argsort(np.asarray(study.trajectories.reward), kind="stable")
    # Evenly between the first and the last of those that differ: most of them earn zero.
    _, distinct = np.unique(np.asarray(study.trajectories.reward)[ranked], return_index=True)
    chosen = ranked[distinct[np.unique(np.linspace(0, len(distinct) - 1, _PATHS).round().astype(int))]]
    for i, path in enumerate(chosen):
        states = np.asarray(study.trajectories.states[path])
        # Side by side, so that paths through one cell stay apart.
        offset = (i - (_PATHS - 1) / 2) * 0.12
        style = series_style(theme, i)
        r, c = cells[states].T
        axes.plot(c + offset, r + offset, color=style["color"], linestyle=style["linestyle"], linewidth=1.6)
        axes.plot(c[0] + offset, r[0] + offset, color=style["color"], marker=style["marker"], markersize=6)
        reward = float(study.trajectories.reward[path])
        handles.append(
            Line2D(
                [],
                [],
                color=style["color"],
                linestyle=style["linestyle"],
                marker=style["marker"],
                label=f"earns {number(reward)}, BIRL {float(study.trajectories.birl[path]):.1f} nats",
            )
        )
    dress(axes, theme, x="column (cells)", y="row (cells)", grid=None)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
    axes.set_xticks(range(columns))
    axes.set_yticks(range(rows))
    legend = figure.legend(handles=handles, loc="outside right upper", frameon=False, fontsize=SMALL)
    for text in legend.get_texts():
        text.set_color(theme.ink)
    foot(figure, theme, "marks: where trajectories begin")
    return figure


def draw_scatter(study: LabelBiasStudy, theme: Theme) -> Figure:
    """Draw log-likelihood against total reward under both methods, side by side."""
    from .study import tell_p

    figure = new_figure(theme, 9.0, 3.9)
    reward = np.asarray(study.trajectories.reward)
    # Rewards are whole numbers: spread a little, so that trajectories on one spot can be counted.
    spread = np.random.default_rng(0).uniform(-0.12, 0.12, len(reward))
    for axes, name, likelihood, found in zip(
        figure.subplots(1, 2),
        ("BIRL", "MaxEnt"),
        (study.trajectories.birl, study.trajectories.maxent),
        (study.birl, study.maxent),
        strict=True,
    ):
        style = method_styles(theme, [name])[name]
        axes.plot(
            reward + (spread if name == "BIRL" else 0),
            np.asarray(likelihood),
            linestyle="",
            markersize=5,
            marker=style["marker"],
            color=style["color"],
            alpha=0.6,
        )
        p = tell_p(found.p)
        title = (
            f"{name}: no correlation, one of the two is constant"
            if np.isnan(found.rho)
            else f"{name}: rho = {found.rho:.3f}, p {p if p.startswith('<') else f'= {p}'}"
        )
        dress(axes, theme, title=title, x="total reward (steps at an object)", y="log-likelihood (nats)")
    foot(
        figure,
        theme,
        f"{counted(study.birl.n, 'trajectory')}; rewards are whole numbers, on the left shown a little spread"
        "",
    )
    return figure


def _critical(n: int) -> float:
    """Compute the correlation of ``n`` pairs that is just significant at 0.05."""
    from scipy.stats import t

    quantile = t.ppf(0.975, n - 2)
    return float(quantile / np.sqrt(n - 2 + quantile**2))


def draw_settings(study: LabelBiasStudy, theme: Theme) -> Figure:
    """Draw every world's correlation, one row a setting."""
    from .study import PRINTED_RHO

    figure = new_figure(theme, 9.0, 1.6 + 0.42 * len(study.results))
    axes = figure.subplots()
    limit = _critical(study.per_world)
    band = axes.axvspan(-limit, limit, color=theme.view, zorder=0, label="not significant at 0.05")
    scatter = np.random.default_rng(0)
    birl, maxent = method_styles(theme, ["BIRL", "MaxEnt"]).values()
    for i, result in enumerate(study.results):
        known = result.birl[np.isfinite(result.birl)]
        height = i + scatter.uniform(-0.22, 0.22, len(known))
        axes.plot(
            known,
            height,
            linestyle="",
            marker=birl["marker"],
            markersize=3.2,
            color=birl["color"],
            alpha=0.45,
        )
        if len(known):
            axes.plot(np.median(known), i, marker="|", markersize=17, markeredgewidth=2.4, color=theme.ink)
        perfect = result.maxent[np.isfinite(result.maxent)]
        axes.plot(
            perfect,
            np.full(len(perfect), i),
            linestyle="",
            marker=maxent["marker"],
            markersize=7,
            color=maxent["color"],
        )
    printed = axes.axvline(
        PRINTED_RHO, color=theme.ink, linewidth=1.2, linestyle=(0, (1, 1.5)), label="dissertation, BIRL"
    )
    dress(axes, theme, x="correlation of log-likelihood and total reward", grid="x")
    name_ticks(axes, "y", range(len(study.results)), [r.setting.name for r in study.results], fontsize=SMALL)
    axes.set(ylim=(len(study.results) - 0.5, -0.5), xlim=(-1.05, 1.05))
    handles = [
        Line2D(
            [],
            [],
            linestyle="",
            marker=birl["marker"],
            markersize=4,
            color=birl["color"],
            label="BIRL, a world",
        ),
        Line2D(
            [],
            [],
            linestyle="",
            marker="|",
            markersize=12,
            markeredgewidth=2.4,
            color=theme.ink,
            label="BIRL, median",
        ),
        Line2D(
            [], [], linestyle="", marker=maxent["marker"], color=maxent["color"], label="MaxEnt, all worlds"
        ),
        band,
        printed,
    ]
    head(figure, theme, handles, title="What the correlation depends on", columns=3)
    return figure


def draw_sweep(study: LabelBiasStudy, theme: Theme) -> Figure:
    """Draw BIRL's correlation against the inverse temperature of experts and of the likelihood alike."""
    from .study import PRINTED_RHO, quantiles

    figure = new_figure(theme, 8.2, 4.4)
    axes = figure.subplots()
    limit = _critical(study.per_world)
    handles: list[Artist] = [
        axes.axhspan(-limit, limit, color=theme.view, zorder=0, label="not significant at 0.05")
    ]
    names = {True: "BIRL, blocked moves stay put", False: "BIRL, only open moves are actions"}
    styles = method_styles(theme, [*names.values(), "MaxEnt"])
    for blocked, results in study.sweep.items():
        style = styles[names[blocked]]
        low, median, high = np.array([quantiles(result.birl) for result in results]).T
        axes.fill_between(study.rationalities, low, high, color=style["color"], alpha=0.2, linewidth=0)
        handles += axes.plot(study.rationalities, median, label=names[blocked], markersize=5, **style)
    handles.append(axes.axhline(1.0, color=styles["MaxEnt"]["color"], linewidth=2, label="MaxEnt"))
    handles.append(
        axes.axhline(
            PRINTED_RHO, color=theme.ink, linewidth=1.2, linestyle=(0, (1, 1.5)), label="dissertation, BIRL"
        )
    )
    dress(
        axes,
        theme,
        x="eta: how sharply experts choose (per unit of value)",
        y="correlation with total reward",
    )
    set_scale(axes, "x", "log")
    axes.set_ylim(-1.05, 1.08)
    head(figure, theme, handles, title="Experts that follow the law they are scored with", columns=2)
    foot(figure, theme, f"line: median; band: 90% of {counted(study.worlds, 'world')}")
    axes.xaxis.label.set_fontsize(TEXT)
    return figure
