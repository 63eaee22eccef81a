"""Figures of the patrol studies of adversarial learners: noisy observations and hidden steps.

All draw the results of :mod:`i2rl.analysis.benchmarks.statistics.adversarial_patrol`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

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
    new_figure,
    save_themes,
    series_style,
)
from .patrol import interval

Results = Mapping[str, Mapping[str, Any]]

CLEAN, NOISY, ROBUST, LEARNED, LME = (
    "AIRL, clean input",
    "AIRL, noisy input",
    "robust-AIRL",
    "robust-AIRL, sensor learned",
    "LME-I2RL",
)
GAIL, ROBUST_GAIL = "online GAIL", "GAIL, hidden steps in expectation"
LAST = 15
# Section 7.4.3: success of AIRL and of robust-AIRL on noisy observations, 95 % ranges.
PUBLISHED = {NOISY: (0.45, 0.53), ROBUST: (0.59, 0.66)}
_MEMORY = {
    0.0: "Networks alone carried on, as in the dissertation",
    1.0: "With a statistic of earlier sessions",
}


def noise_curves(results: Results, theme: Theme, level: float = 0.05) -> Figure:
    """Draw LBA against pairs seen, without and with memory of earlier sessions; LME-I2RL in both for
    reference.
    """
    figure = new_figure(theme, 9.6, 4.8)
    figure.get_layout_engine().set(wspace=0.05)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(1, 2, sharey=True)
    least = 0.9
    for panel, (forgetting, title) in zip(panels, _MEMORY.items(), strict=True):
        for name in (CLEAN, NOISY, ROBUST, LEARNED, LME):
            one = _noise(results, name, 0.05 if name == CLEAN else level, 1.0 if name == LME else forgetting)
            if one is None:
                continue
            style = method_styles(theme, [name])[name]
            _draw_mean(panel, style, name, np.array(one["pairs"]), np.array(one["accuracy"]))
            least = min(least, float(np.mean(one["accuracy"], axis=0)[1:].min()))
        dress(panel, theme, title=title, x="state-action pairs seen")
        panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    panels[0].set_ylim(np.floor(least * 20) / 20, 1.005)
    panels[0].set_ylabel("learned behaviour accuracy\n(share of states)", color=theme.ink, fontsize=TEXT)
    shown = {label: h for p in panels for h, label in zip(*p.get_legend_handles_labels(), strict=True)}
    title = f"Patrol, {level:.0%} of forward moves and right turns observed wrongly"
    head(figure, theme, list(shown.values()), title=title)
    replications = max(len(r["accuracy"]) for r in results["noise"].values() if "accuracy" in r)
    foot(
        figure,
        theme,
        f"line: mean of {counted(replications, 'replication')}; band: its 95% interval; "
        "the axis does not begin at zero",
    )
    return figure


def noise_levels(results: Results, theme: Theme, level: float = 0.05) -> Figure:
    """Draw the cost of noise: LBA of the last sessions by its level, and successful breaches at one level.

    Grey bars are the dissertation's ranges of success.
    """
    figure = new_figure(theme, 10.4, 5.2)
    figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr, call-arg]
    left, right = figure.subplots(1, 2)
    levels = sorted({r["level"] for r in results["noise"].values() if "level" in r})
    for i, (name, forgetting) in enumerate(((NOISY, 0.0), (ROBUST, 0.0), (NOISY, 1.0), (ROBUST, 1.0))):
        found = [(x, _noise(results, name, x, forgetting)) for x in levels]
        values = [(x, interval(_last(one))) for x, one in found if one is not None]
        x, (mean, half) = np.array([x for x, _ in values]), np.array([v for _, v in values]).T
        label = _with_memory(name, forgetting)
        style = method_styles(theme, [label])[label]
        at = x + (i - 1.5) * 0.0025
        left.vlines(at, mean - half, np.minimum(mean + half, 1.0), color=style["color"], linewidth=1.4)
        left.plot(at, mean, label=label, linewidth=1.6, markersize=6, **style)
    for forgetting, dash in ((0.0, (0, (2, 2))), (1.0, (0, (7, 2)))):
        clean = _noise(results, CLEAN, level, forgetting)
        if clean is not None:
            label = _with_memory(CLEAN, forgetting)
            left.axhline(_last(clean).mean(), color=theme.ink, linewidth=1.2, linestyle=dash, label=label)
    dress(
        left,
        theme,
        title=f"Accuracy, mean of the last {LAST} sessions",
        x="probability of a wrong observation",
    )
    left.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    left.set_xticks(levels)
    # One level alone is one place, however many methods stand side by side there.
    left.set_xlim(min(levels) - 0.02, max(levels) + 0.02)
    left.set_ylabel("learned behaviour accuracy (share of states)", color=theme.ink, fontsize=TEXT)
    _breaches(right, results, theme, level)
    for axis in (left.yaxis, right.xaxis):
        axis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    handles = left.get_legend_handles_labels()[0]
    head(figure, theme, handles, title="Cost of wrong observations on patrol", columns=2)
    foot(
        figure,
        theme,
        "point: mean over replications; bar: its 95% interval; grey: range in the dissertation; "
        "the left axis does "
        "not begin at zero",
    )
    return figure


def _breaches(axes: Axes, results: Results, theme: Theme, level: float) -> None:
    rows = [(name, forgetting) for forgetting in (0.0, 1.0) for name in (CLEAN, NOISY, ROBUST, LEARNED)]
    rows.append((LME, 1.0))
    there = [(n, m, one) for n, m in rows if (one := _noise(results, n, level, m)) and one["success"]]
    named = [(n if n == LME else _with_memory(n, m), np.array(one["success"])) for n, m, one in there]
    if "true policy" in results["noise"]:
        named.append(("true policy", np.array(results["noise"]["true policy"]["success"])))
    for y, (name, success) in enumerate(named):
        if name in PUBLISHED:
            low, high = PUBLISHED[name]
            axes.barh(y, high - low, left=low, height=0.55, color=theme.muted, alpha=0.45, linewidth=0)
        mean, half = interval(success)
        axes.hlines(y, mean - half, min(mean + half, 1.0), color=theme.series[0], linewidth=2.2, alpha=0.65)
        axes.plot(mean, y, linestyle="", marker="o", markersize=7, color=theme.series[0])
    dress(
        axes,
        theme,
        title=f"Breaches that succeed, {level:.0%} wrong observations",
        x="share of breaches",
        grid="x",
    )
    axes.set_yticks(range(len(named)), [label for label, _ in named], fontsize=SMALL)
    axes.set_ylim(len(named) - 0.4, -0.6)
    axes.set_xlim(0, 1.02)


def _with_memory(name: str, forgetting: float) -> str:
    return f"{name}, memory" if forgetting else name


def _last(one: Mapping[str, Any]) -> Float[np.ndarray, " R"]:
    values: np.ndarray = np.array(one["accuracy"])[:, -LAST:].mean(1)
    return values


def view_curves(results: Results, theme: Theme, gail_memory: float = 0.0) -> Figure:
    """Draw LBA against trajectories at each observability, and the cost of hidden steps relative to a full
    view.

    The right panels are those of Figure 7.4(c): ``(LBA_full - LBA_hidden) / LBA_full``.
    """
    methods = [(GAIL, gail_memory), (ROBUST_GAIL, 1.0), (LME, 1.0)]
    methods = [m for m in methods if _view(results, m[0], 100, m[1]) is not None]
    figure = new_figure(theme, 10.4, 6.6)
    figure.get_layout_engine().set(wspace=0.04, hspace=0.06)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(2, len(methods), sharex=True, sharey="row")
    views = sorted({r["view"] for r in results["view"].values()}, reverse=True)
    for column, (name, forgetting) in enumerate(methods):
        full = np.array(_required(_view(results, name, 100, forgetting))["accuracy"])
        for i, view in enumerate(views):
            one = _view(results, name, view, forgetting)
            if one is None:
                continue
            accuracy = np.array(one["accuracy"])
            x = np.arange(1, accuracy.shape[1] + 1)
            style = series_style(theme, i)
            _draw_mean(panels[0, column], style, f"{view} % in view", x, accuracy)
            if view != 100:
                lost = (full - accuracy) / full
                _draw_mean(panels[1, column], style, f"{view} % in view", x, lost)
        # A line for each part of a name, or the titles of neighbours meet.
        told = name if name == LME else _with_memory(name, forgetting).replace(", ", "\n", 1)
        dress(panels[0, column], theme, title=told)
        dress(panels[1, column], theme, x="trajectories seen")
        panels[1, column].axhline(0, color=theme.muted, linewidth=0.9)
        set_scale(panels[1, column], "x", "log")
        for row in range(2):
            panels[row, column].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    panels[0, 0].set_ylim(0, 1.02)
    panels[0, 0].set_ylabel("learned behaviour accuracy\n(share of states)", color=theme.ink, fontsize=TEXT)
    panels[1, 0].set_ylabel("accuracy lost against a full view\n(share)", color=theme.ink, fontsize=TEXT)
    head(
        figure,
        theme,
        panels[0, 0].get_legend_handles_labels()[0],
        title="Patrol through a keyhole: online GAIL beside LME-I2RL",
    )
    foot(
        figure,
        theme,
        f"line: mean of {counted(len(full), 'stream')} of 5 pairs a trajectory; band: its 95% interval",
    )
    return figure


def write_figures(results: Results, folder: Path | str) -> list[Path]:
    """Write all figures that have results, in both themes."""
    written: list[Path] = []
    if results.get("noise"):
        written += save_themes(lambda theme: noise_curves(results, theme), folder, "patrol-noise")
        written += save_themes(lambda theme: noise_levels(results, theme), folder, "patrol-noise-levels")
    if results.get("view"):
        written += save_themes(lambda theme: view_curves(results, theme), folder, "patrol-view")
    return written


# -- parts --------------------------------------------------------------------------------------------


def _noise(results: Results, name: str, level: float, forgetting: float) -> Mapping[str, Any] | None:
    return results["noise"].get(f"{name}, {level:g}, memory {forgetting:g}")


def _view(results: Results, name: str, view: int, forgetting: float) -> Mapping[str, Any] | None:
    return results["view"].get(f"{name}, {view} %, memory {forgetting:g}")


def _required(one: Mapping[str, Any] | None) -> Mapping[str, Any]:
    if one is None:
        raise ValueError("the results of a full view are missing")
    return one


def _draw_mean(
    axes: Axes, style: Mapping[str, Any], name: str, x: np.ndarray, replications: np.ndarray
) -> None:
    mean, half = interval(replications)
    top = np.minimum(mean + half, 1.0)
    axes.fill_between(x, mean - half, top, color=style["color"], alpha=0.18, linewidth=0)
    every = max(len(x) // 7, 1)
    axes.plot(x, mean, label=name, linewidth=1.8, markersize=5, markevery=every, **style)
