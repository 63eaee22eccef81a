"""Pictures of adversarial learners (Figures 7.11 to 7.13): learning, rewards, beliefs, robots that move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter

from ....models.inputs.text import counted
from ...drawing.style import (
    SMALL,
    TEXT,
    Theme,
    dress,
    dress_bar,
    foot,
    head,
    headline,
    method_styles,
    name_ticks,
    new_figure,
)
from ...drawing.text import for_figure, listed
from ...judging.returns import Correlation, seed_interval
from .results import (
    LEARNED,
    METHODS,
    ROBUST,
    AdversarialResults,
    Belief,
    FrameStrip,
    RewardScatter,
)

DISSERTATION_RECOVERY = {"hopper": 0.78, "walker2d": 0.40, "half-cheetah": 0.61}
"""Share of the return lost to noise that robust-AIRL recovers in Table 7.3."""

_TARGET = 0.8
MEASURED = {"returns": "return", "accuracy": "LBA"}


def _style(theme: Theme, method: str) -> dict:
    return method_styles(theme, [method])[method]


def learning_plot(results: AdversarialResults, theme: Theme) -> Figure:
    """Draw LBA, return, or both against the pairs seen: a line a method, with its interval."""
    names = {"accuracy": "learned behaviour accuracy (LBA)", "returns": "return"}
    shown = [m for m in names if any(getattr(r, m) is not None for r in results.methods.values())]
    figure = new_figure(theme, 4.7 * len(shown) + 0.5 if len(shown) > 1 else 7.6, 4.6)
    panels = np.atleast_1d(figure.subplots(1, len(shown)))
    for panel, measure in zip(panels, shown, strict=True):
        for name, result in results.methods.items():
            replications = getattr(result, measure)
            if replications is None:
                continue
            style, band = _style(theme, name), seed_interval(replications)
            if len(replications) > 1:
                top = 1.0 if measure == "accuracy" else np.inf
                low = np.maximum(band.low, 0) if measure == "accuracy" else band.low
                panel.fill_between(
                    result.pairs,
                    low,
                    np.minimum(band.high, top),
                    color=style["color"],
                    alpha=0.16,
                    linewidth=0,
                )
            every = max(len(result.pairs) // 7, 1)
            panel.plot(
                result.pairs, band.mean, label=name, linewidth=1.8, markersize=5, markevery=every, **style
            )
        dress(panel, theme, x="observed state-action pairs", y=names[measure])
        panel.set_xlim(left=0)
        panel.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        if measure == "accuracy":
            panel.yaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
            panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
            panel.set_ylim(top=1.01)
        else:
            panel.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
            if results.expert_return is not None:
                panel.axhline(
                    results.expert_return,
                    color=theme.ink,
                    linewidth=1.3,
                    linestyle=(0, (1, 1.5)),
                    label="expert",
                )
    # Of the panel that shows most, so that the expert is among them.
    handles = max((p.get_legend_handles_labels()[0] for p in panels), key=len)
    head(figure, theme, handles, title=results.title, columns=2)
    over = f"; LBA over {results.accuracy_over}" if "accuracy" in shown else ""
    mean = f"line: mean of {counted(results.replications, 'replication')}; band: its 95% interval (Student's)"
    foot(figure, theme, ("line: one replication" if results.replications == 1 else mean) + over)
    return figure


def recovery_plot(results: Sequence[AdversarialResults], theme: Theme) -> Figure:
    """Draw robust-AIRL's recovery of each domain's loss to noise, beside the dissertation's share."""
    rows = [
        (result, method, found)
        for result in results
        for method in (ROBUST, LEARNED)
        if (found := result.recovery(method)) is not None
    ]
    figure = new_figure(theme, 7.6, 1.9 + 0.42 * len(rows))
    axes = figure.subplots()
    axes.axvline(_TARGET, color=theme.ink, linewidth=1.2, linestyle=(0, (1, 1.5)))
    low, high = -0.25, 1.5
    for y, (result, method, found) in enumerate(rows):
        style = _style(theme, method)
        if not math.isfinite(found.share):
            axes.annotate(
                f"not known: noise cost something in {found.lost:.0%} of resamples",
                (0.03, y),
                va="center",
                xycoords=axes.get_yaxis_transform(),
                color=style["color"],
                fontsize=SMALL,
                bbox={"boxstyle": "square,pad=0.2", "facecolor": theme.surface, "edgecolor": "none"},
            )
            continue
        ends = np.clip([found.low, found.high], low, high)
        axes.plot(ends, [y, y], color=style["color"], linewidth=3, alpha=0.55, solid_capstyle="butt")
        if low <= found.share <= high:
            axes.plot(
                found.share, y, linestyle="", marker=style["marker"], markersize=8, color=style["color"]
            )
        else:  # beyond the axis, and said so
            beyond = found.share > high
            axes.annotate(
                f"{found.share:.0%}",
                (high if beyond else low, y),
                (-12 if beyond else 12, 0),
                va="center",
                textcoords="offset points",
                ha="right" if beyond else "left",
                color=theme.ink,
                fontsize=SMALL,
            )
        for end, cut in ((found.low, found.low < low), (found.high, found.high > high)):
            if cut:  # the interval goes on
                axes.plot(
                    np.clip(end, low, high),
                    y,
                    linestyle="",
                    marker="<" if end < low else ">",
                    markersize=7,
                    color=style["color"],
                    clip_on=False,
                )
        printed = DISSERTATION_RECOVERY.get(result.domain)
        if printed is not None and method == ROBUST:
            axes.plot(
                printed,
                y,
                linestyle="",
                marker="d",
                markersize=10,
                markerfacecolor="none",
                markeredgecolor=theme.ink,
                markeredgewidth=1.5,
            )
    dress(axes, theme, x="share of the loss to noise recovered", grid="x")
    # Only its colour marks a domain's second row.
    names = [
        "" if i and r is rows[i - 1][0] else f"{r.title}: {MEASURED[r.measure]}"
        for i, (r, _, _) in enumerate(rows)
    ]
    name_ticks(axes, "y", range(len(rows)), names, fontsize=TEXT)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(low, high)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    handles: list[Artist] = [
        Line2D([], [], linewidth=3, markersize=8, label=method, **{**_style(theme, method), "linestyle": "-"})
        for method in (ROBUST, LEARNED)
        if any(m == method for _, m, _ in rows)
    ]
    if any(r.domain in DISSERTATION_RECOVERY for r, _, _ in rows):
        handles.append(
            Line2D(
                [],
                [],
                linestyle="",
                marker="d",
                markersize=10,
                markerfacecolor="none",
                markeredgecolor=theme.ink,
                markeredgewidth=1.5,
                label="dissertation, Table 7.3",
            )
        )
    handles.append(
        Line2D([], [], color=theme.ink, linewidth=1.2, linestyle=(0, (1, 1.5)), label=f"{_TARGET:.0%}")
    )
    head(figure, theme, handles, title="What robustness recovers", columns=2)
    replications = sorted({found.n for _, _, found in rows})
    foot(
        figure,
        theme,
        "one replication a row, no interval"
        if replications == [1]
        else f"bar: 95% interval, bootstrap over {listed([str(n) for n in replications])} replications",
    )
    return figure


def scatter_plot(scatters: Mapping[str, RewardScatter], theme: Theme, title: str = "") -> Figure:
    """Draw learned against true rewards, a panel a method: steps as dots, whole trajectories as marks.

    The scale of a learned reward is free, so each panel has its own.
    """
    n = len(scatters)
    columns = min(n, 3) if n != 4 else 2
    figure = new_figure(theme, max(3.4 * columns + 0.4, 6.4), 1.1 + 3.3 * -(-n // columns))
    panels = np.atleast_1d(figure.subplots(-(-n // columns), columns)).ravel()
    levels = max(int(s.whose.max()) for s in scatters.values()) + 1
    for panel, (name, scatter) in zip(panels, scatters.items(), strict=False):
        style = _style(theme, name)
        panel.scatter(
            *scatter.steps.T, s=5, color=theme.muted, alpha=0.28, linewidths=0, rasterized=True, zorder=1
        )
        shades = theme.colormap(0.25 + 0.75 * (1 - scatter.whose / max(levels - 1, 1)))
        panel.scatter(
            *scatter.trajectories.T,
            s=36,
            c=shades,
            marker=style["marker"],
            edgecolors=theme.ink,
            linewidths=0.8,
            zorder=2,
        )
        dress(panel, theme, x="true reward a step", y="learned reward a step")
        panel.set_title(
            f"{for_figure(name)}\nsteps: {_told(scatter.correlation.steps)}\n"
            f"trajectories: {_told(scatter.correlation.trajectories)}",
            color=theme.ink,
            fontsize=TEXT,
            loc="left",
        )
    for panel in panels[n:]:
        panel.set_visible(False)
    handles: list[Artist] = [
        Line2D([], [], linestyle="", marker="o", markersize=4, color=theme.muted, alpha=0.6, label="a step"),
        Line2D(
            [],
            [],
            linestyle="",
            marker="o",
            markersize=7,
            markerfacecolor=theme.colormap(1.0),
            markeredgecolor=theme.ink,
            label="a trajectory's mean, the expert's policy",
        ),
    ]
    if levels > 1:
        handles.append(
            Line2D(
                [],
                [],
                linestyle="",
                marker="o",
                markersize=7,
                markerfacecolor=theme.colormap(0.25),
                markeredgecolor=theme.ink,
                label="the worst policy of the mix",
            )
        )
    head(figure, theme, handles, title=title, columns=3 if columns > 2 else 2)
    over = next(iter(scatters.values())).correlation
    foot(
        figure,
        theme,
        f"{counted(over.steps.n, 'step')} of {counted(over.trajectories.n, 'held-out trajectory')}; r: "
        "Pearson's, with a 95% interval (trajectories drawn anew)",
    )
    return figure


def _told(found: Correlation) -> str:
    if np.isnan(found.pearson):
        return "r not defined, a reward is constant"
    ends = found.bootstrap
    if np.isnan([ends.low, ends.high]).any():
        return f"r = {found.pearson:.2f} (interval not known)"
    return f"r = {found.pearson:.2f} ({ends.low:.2f} to {ends.high:.2f})"


def belief_plot(belief: Belief, theme: Theme, title: str = "What happened, and what is believed") -> Figure:
    """Draw a trajectory's components against time: observations, the truth, and the posterior's mean and
    band.
    """
    m = len(belief.names)
    columns = 1 if m < 3 else 2
    rows = -(-m // columns)
    figure = new_figure(theme, 9.2, 1.3 + 1.75 * rows)
    panels = np.atleast_1d(figure.subplots(rows, columns, sharex=True)).ravel()
    steps = np.arange(len(belief.truth)) + 1
    for j, (panel, name) in enumerate(zip(panels, belief.names, strict=False)):
        panel.fill_between(
            steps, belief.low[:, j], belief.high[:, j], color=theme.series[0], alpha=0.28, linewidth=0
        )
        panel.plot(steps, belief.mean[:, j], color=theme.series[0], linewidth=1.8)
        panel.plot(
            steps,
            belief.observed[:, j],
            linestyle="",
            marker="x",
            markersize=4,
            markeredgewidth=1.1,
            color=theme.series[1],
        )
        panel.plot(steps, belief.truth[:, j], color=theme.ink, linewidth=1.2, linestyle=(0, (4, 1.5)))
        dress(panel, theme, title=name)
        panel.title.set_fontsize(TEXT)
        panel.yaxis.set_major_locator(MaxNLocator(4))
    for panel in panels[m:]:
        panel.set_visible(False)
    for panel in panels[max(m - columns, 0) : m]:
        panel.set_xlabel("step", color=theme.ink, fontsize=TEXT)
        panel.tick_params(labelbottom=True)
        panel.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    handles: list[Artist] = [
        Line2D(
            [],
            [],
            linestyle="",
            marker="x",
            markersize=6,
            markeredgewidth=1.4,
            color=theme.series[1],
            label="observed",
        ),
        Line2D([], [], color=theme.ink, linewidth=1.3, linestyle=(0, (4, 1.5)), label="truth"),
        Line2D([], [], color=theme.series[0], linewidth=1.8, label="posterior mean"),
        Patch(color=theme.series[0], alpha=0.28, linewidth=0, label=f"its middle {belief.coverage:.0%}"),
    ]
    head(figure, theme, handles, title=title, columns=4)
    inside = np.mean((belief.low <= belief.truth) & (belief.truth <= belief.high))
    observed, believed = (np.sum((x - belief.truth) ** 2, 0) for x in (belief.observed, belief.mean))
    wrong = observed > 0
    errors = np.sqrt(believed[wrong] / observed[wrong]).mean() if wrong.any() else np.nan
    left = (
        f"; its mean errs {errors:.0%} as much as the observations (root mean square)" if wrong.any() else ""
    )
    foot(
        figure,
        theme,
        f"{inside:.0%} of the truth is inside the band{left}",
    )
    return figure


def cells_plot(
    cells: Mapping[str, Float[np.ndarray, "cells cells"]],
    low: Sequence[float],
    high: Sequence[float],
    theme: Theme,
) -> Figure:
    """Draw LBA in every cell of mountain car's states: the places where a policy agrees with the expert."""
    n = len(cells)
    figure = new_figure(theme, max(2.9 * n + 1.2, 6.0), 3.7)
    panels = np.atleast_1d(figure.subplots(1, n, sharey=True))
    for panel, (name, share) in zip(panels, cells.items(), strict=True):
        picture = panel.imshow(
            share.T,
            origin="lower",
            extent=(low[0], high[0], low[1], high[1]),
            aspect="auto",
            cmap=theme.colormap,
            vmin=0,
            vmax=1,
            interpolation="nearest",
        )
        dress(panel, theme, x="position", grid=None)
        panel.set_title(f"{name}\nmean {share.mean():.0%}", color=theme.ink, fontsize=TEXT, loc="left")
        panel.tick_params(axis="y", left=panel is panels[0])
    panels[0].set_ylabel("velocity (a step)", color=theme.ink, fontsize=TEXT)
    bar = figure.colorbar(picture, ax=list(panels), pad=0.01, fraction=0.03, format=PercentFormatter(1.0))
    dress_bar(bar, theme, "share of equal actions")
    headline(figure, theme, "Where learned actions are the expert's")
    return figure


# -- robots -------------------------------------------------------------------------------------------


def frames_plot(strips: Sequence[FrameStrip], theme: Theme, title: str = "") -> Figure:
    """Draw a row of moments for each episode, seen from the side; time and distance under each."""
    moments = max(len(s.seconds) for s in strips)
    shapes = [_outlines(s) for s in strips]
    width = 1.08 * max(float(np.ptp(s[..., 0], axis=(1, 2)).max()) for s in shapes)
    tall = max(float(s[..., 1].max()) for s in shapes) + 0.05
    inches = 10.4 / (moments * width)
    figure = new_figure(theme, 10.6, 0.5 + len(strips) * (tall * inches + 0.68))
    panels = np.atleast_1d(figure.subplots(len(strips), 1))
    for panel, strip, shape in zip(panels, strips, shapes, strict=True):
        color = _style(theme, strip.name)["color"] if strip.name in METHODS else theme.muted
        panel.axhline(0, color=theme.muted, linewidth=1.4)
        for k, outline in enumerate(shape):
            middle = (outline[..., 0].min() + outline[..., 0].max()) / 2
            for j, limb in enumerate(outline):
                placed = limb + np.array([k * width - middle, 0.0])
                panel.add_patch(
                    Polygon(
                        placed,
                        closed=True,
                        facecolor=color,
                        edgecolor=theme.surface,
                        linewidth=0.8,
                        zorder=2 + j,
                    )
                )
        dress(panel, theme, title=strip.name, grid=None)
        panel.set_xticks(
            np.arange(len(strip.seconds)) * width,
            [f"{t:.2f} s\n{x:.2f} m" for t, x in zip(strip.seconds, strip.travelled, strict=True)],
            fontsize=SMALL,
        )
        panel.set_yticks([])
        panel.tick_params(length=0)
        for spine in panel.spines.values():
            spine.set_visible(False)
        panel.set_xlim(-0.5 * width, (moments - 0.5) * width)
        panel.set_ylim(-0.03 * tall, tall)
        panel.set_aspect("equal")
    if title:
        headline(figure, theme, title)
    return figure


def _outlines(strip: FrameStrip, points: int = 12) -> Float[np.ndarray, "F G points 2"]:
    """Compute the outline of every limb: two half circles about its ends."""
    ends = strip.capsules[..., :4].reshape(*strip.capsules.shape[:-1], 2, 2)
    along = ends[..., 1, :] - ends[..., 0, :]
    angle = np.arctan2(along[..., 1], along[..., 0])[..., None]
    half = np.linspace(-np.pi / 2, np.pi / 2, points)
    radius = strip.capsules[..., 4, None, None]
    caps = [
        ends[..., end, None, :] + radius * np.stack([np.cos(turn), np.sin(turn)], -1)
        for end, turn in ((1, angle + half), (0, angle + half + np.pi))
    ]
    return np.concatenate(caps, -2)
