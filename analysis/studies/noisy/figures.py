"""Pictures of the study of noisy perception: the sensor, the behaviour, and the past as they are learned."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter

from ....models.inputs.text import counted
from ....models.process.mdp import TabularMDP
from ...drawing.charts import set_scale
from ...drawing.style import (
    SMALL,
    TEXT,
    TITLE,
    Theme,
    dress,
    dress_bar,
    foot,
    head,
    method_styles,
    name_ticks,
    new_figure,
)
from ...judging.metrics import quantile_band
from .examples import SensorPosterior, Strip
from .study import (
    ALL,
    AVERAGED,
    BARE,
    BOTH,
    CLEAR,
    CODED,
    FAIR,
    HIDDEN,
    KNOWN,
    MLIRL,
    OBSERVABILITY,
    OBSERVED,
    ORACLE,
    PLAIN,
    ROBUST,
    STEPWISE,
    MethodResult,
    NoisyStudy,
    mean_interval,
)

# Pairs with less posterior mass at every step are left out of a strip.
RARE_PAIR = 0.1


def _draw_mean(
    axes: Axes,
    theme: Theme,
    result: MethodResult,
    replications: Float[np.ndarray, "replications T"],
    top: float = np.inf,
) -> None:
    """Draw a method's mean and its band, which ends at ``top`` and at a fifth of the mean.

    The normal interval ignores the ends of a scale; a logarithmic one has no zero.
    """
    style, band = method_styles(theme, [result.name])[result.name], mean_interval(replications)
    x = result.sessions
    if len(replications) > 1:
        low, high = np.maximum(band.low, band.mean / 5), np.minimum(band.high, top)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
    axes.plot(
        x, band.mean, label=result.name, linewidth=1.8, markersize=5, markevery=max(len(x) // 7, 1), **style
    )


def _panels(figure: Figure, n: int) -> np.ndarray:
    figure.get_layout_engine().set(wspace=0.05)  # type: ignore[union-attr, call-arg]
    return np.atleast_1d(figure.subplots(1, n, sharey=True))


def _legend_above(panel: Axes, theme: Theme, title: str) -> None:
    """Set a panel's own title and legend: more methods than there are styles share a figure."""
    legend = panel.legend(
        title=title,
        loc="lower left",
        bbox_to_anchor=(-0.03, 1.0),
        ncols=2,
        frameon=False,
        fontsize=TEXT - 1,
        title_fontsize=TITLE,
        alignment="left",
        labelcolor=theme.ink,
    )
    legend.get_title().set_color(theme.ink)


def _mean_of(replications: int, interval: str = "band") -> str:
    """Write the small print of a figure of means."""
    return (
        "line: one replication"
        if replications == 1
        else f"line: mean of {counted(replications, 'replication')}; {interval}: its 95% interval"
    )


def _count_sessions(panel: Axes, sessions: int) -> None:
    ticks = MaxNLocator(8, steps=[1, 2, 5, 10], integer=True).tick_values(1, sessions)
    panel.set_xticks([int(t) for t in ticks if 1 <= t <= sessions])


def divergence_plot(study: NoisyStudy, theme: Theme) -> Figure:
    """Draw the divergence of the learned sensor against sessions, logarithmic, for learners and controls."""
    groups = (
        ("RIMEO", (PLAIN, AVERAGED, STEPWISE, BARE)),
        ("Controls", (ORACLE, OBSERVED, FAIR, CODED, ALL)),
    )
    figure = new_figure(theme, 9.6, 4.9)
    panels = _panels(figure, 2)
    for panel, (title, names) in zip(panels, groups, strict=True):
        shown = [name for name in names if name in study.results]
        for name in shown:
            result = study.results[name]
            assert result.divergence is not None
            _draw_mean(panel, theme, result, result.divergence)
        panel.axhline(
            study.control, color=theme.ink, linewidth=1.3, linestyle=(0, (1, 1.5)), label="constant one half"
        )
        reference = study.results[PLAIN]
        assert reference.divergence is not None
        if PLAIN not in names:
            panel.plot(
                reference.sessions,
                reference.divergence.mean(0),
                color=theme.muted,
                linewidth=1.0,
                label=f"{PLAIN} (again)",
            )
        dress(panel, theme, x="session")
        _legend_above(panel, theme, title)
        set_scale(panel, "y", "log")
        _count_sessions(panel, study.sessions)
        panel.tick_params(axis="y", left=panel is panels[0])
    panels[0].set_ylabel(
        "divergence of agreement probabilities\n(nats, mean over predicates)", color=theme.ink
    )
    head(figure, theme, [], title=f"What is learned of perception, {study.task.name}")
    foot(figure, theme, _mean_of(study.replications))
    return figure


def accuracy_plot(study: NoisyStudy, theme: Theme) -> Figure:
    """Draw LBA against sessions: a panel for each set of states, or one in full view and one through a
    keyhole.
    """
    names = [m for m in (PLAIN, AVERAGED, STEPWISE, FAIR, KNOWN, CLEAR) if m in study.results]
    everywhere = study.states.all()
    titles = (
        ("In full view",) if everywhere else ("All states", "Where there is a choice", "Naturally reached")
    )
    n = len(titles) + (study.hidden is not None)
    figure = new_figure(theme, max(3.4 * n + 0.6, 9.6), 5.2)
    panels = _panels(figure, n)
    lowest = 1.0
    for which, (panel, title) in enumerate(zip(panels, titles, strict=False)):
        for name in names:
            values = study.results[name].accuracy[..., which]
            _draw_mean(panel, theme, study.results[name], values, 1.0)
            lowest = min(lowest, float(np.nanmin([mean_interval(values).low, values.mean(0)])))
        for name, shift in ((ROBUST, 0.6), (MLIRL, 1.2)):
            if name in study.results:
                style = method_styles(theme, [name])[name]
                band = mean_interval(study.results[name].accuracy[:, -1, which])
                x = study.sessions + shift
                panel.vlines(x, band.low, min(float(band.high), 1.0), color=style["color"], linewidth=1.2)
                panel.plot(x, band.mean, markersize=8, label=name, **{**style, "linestyle": ""})
                lowest = min(lowest, float(band.mean))
        dress(panel, theme, title=title, x="session")
    if study.hidden is not None:
        for name in (HIDDEN, BOTH):
            values = study.hidden[name].accuracy[..., 0]
            _draw_mean(panels[-1], theme, study.hidden[name], values, 1.0)
            lowest = min(lowest, float(np.nanmin([mean_interval(values).low, values.mean(0)])))
        dress(panels[-1], theme, title=f"{OBSERVABILITY} % in view", x="session")
        # Other lines than those of the first panel, in some of its colours.
        panels[-1].legend(loc="lower right", frameon=False, fontsize=TEXT, labelcolor=theme.ink)
    for panel in panels:
        _count_sessions(panel, study.sessions)
        panel.tick_params(axis="y", left=panel is panels[0])
    panels[0].set_ylim(max(np.floor(10 * lowest) / 10, 0.0), 1.01)
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    panels[0].set_ylabel("learned behaviour accuracy\n(share of states)", color=theme.ink)
    head(
        figure, theme, panels[0].get_legend_handles_labels()[0], title=f"Behaviour learned, {study.task.name}"
    )
    few = {len(study.results[m].weights) for m in (ROBUST, MLIRL) if m in study.results}
    batch = f"; batch: all sessions at once, {counted(few.pop(), 'replication')}" if few else ""
    foot(figure, theme, _mean_of(study.replications, "band and bar") + batch)
    return figure


def sensor_plot(posterior: SensorPosterior, theme: Theme) -> Figure:
    """Draw agreement probabilities: posterior (median, middle 90 %), RIMEO's estimate, and truth."""
    band = quantile_band(posterior.draws, 0.9)
    n = len(posterior.names)
    figure = new_figure(theme, 7.4, 1.9 + 0.36 * n)
    axes = figure.subplots()
    y = np.arange(n)
    axes.hlines(y, band.low, band.high, color=theme.series[0], linewidth=3.0, alpha=0.6)
    axes.plot(band.median, y, linestyle="", marker="o", markersize=6, color=theme.series[0])
    axes.plot(
        posterior.truth,
        y,
        linestyle="",
        marker="D",
        markersize=9,
        markerfacecolor="none",
        markeredgewidth=1.7,
        color=theme.series[1],
        clip_on=False,
    )
    axes.plot(
        posterior.learned,
        y,
        linestyle="",
        marker="|",
        markersize=13,
        markeredgewidth=2.4,
        color=theme.series[2],
        clip_on=False,
    )
    axes.plot(
        posterior.happened,
        y + 0.26,
        linestyle="",
        marker="x",
        markersize=6,
        markeredgewidth=1.6,
        color=theme.ink,
        clip_on=False,
    )
    dress(axes, theme, x="probability that an observation agrees with the truth", grid="x")
    name_ticks(axes, "y", y, posterior.names, fontsize=TEXT)
    axes.set_ylim(n - 0.4, -0.6)
    least = np.min([band.low, posterior.truth, posterior.learned, posterior.happened])
    axes.set_xlim(max(least - 0.03, 0.0), 1.0)
    handles: list[Artist] = [
        Line2D(
            [],
            [],
            color=theme.series[0],
            marker="o",
            linewidth=3,
            markersize=6,
            label="posterior: median, middle 90%",
        ),
        Line2D(
            [],
            [],
            color=theme.series[2],
            marker="|",
            linestyle="",
            markersize=13,
            markeredgewidth=2.4,
            label=PLAIN,
        ),
        Line2D(
            [],
            [],
            color=theme.series[1],
            marker="D",
            linestyle="",
            markersize=8,
            markerfacecolor="none",
            markeredgewidth=1.7,
            label="truth",
        ),
        Line2D(
            [],
            [],
            color=theme.ink,
            marker="x",
            linestyle="",
            markersize=6,
            markeredgewidth=1.6,
            label="share of these observations",
        ),
    ]
    head(figure, theme, handles, title="How reliable each feature is thought to be", columns=2)
    foot(figure, theme, f"learned from {counted(posterior.trajectories, 'trajectory')} without scores")
    return figure


def strip_plot(strip: Strip, mdp: TabularMDP, theme: Theme) -> Figure:
    """Draw a trajectory step by step: the observation, the truth, and the posterior mass of each pair."""
    length = len(strip.posterior)
    seen = strip.seen.state[0] * mdp.n_actions + strip.seen.action[0]
    true = strip.truth.state[0] * mdp.n_actions + strip.truth.action[0]
    mass = strip.posterior.reshape(length, -1)
    shown = np.unique(np.concatenate([seen, true, np.flatnonzero((mass >= RARE_PAIR).any(0))]))
    # From top to bottom in the order in which they are first thought to have happened.
    first = [int(np.argmax((mass[:, g] >= RARE_PAIR) | (true == g) | (seen == g))) for g in shown]
    shown = shown[np.lexsort((-mass[first, shown], np.array(first)))]
    row = {int(g): i for i, g in enumerate(shown)}
    figure = new_figure(theme, 10.0, 2.0 + 0.3 * len(shown))
    axes = figure.subplots()
    picture = axes.imshow(
        mass[:, shown].T, cmap=theme.colormap, vmin=0, vmax=1, aspect="auto", interpolation="nearest"
    )
    steps = np.arange(length)
    seen_style: dict[str, Any] = {
        "linestyle": "",
        "marker": "s",
        "markersize": 14,
        "markerfacecolor": "none",
        "markeredgecolor": theme.series[1],
        "markeredgewidth": 2.0,
    }
    true_style: dict[str, Any] = {
        "linestyle": "",
        "marker": "o",
        "markersize": 6.5,
        "markerfacecolor": theme.surface,
        "markeredgecolor": theme.ink,
        "markeredgewidth": 1.2,
    }
    axes.plot(steps, [row[int(g)] for g in seen], **seen_style)
    axes.plot(steps, [row[int(g)] for g in true], **true_style)
    dress(axes, theme, x="step", grid=None)
    axes.set_xticks(steps, [str(t + 1) for t in steps])
    name_ticks(axes, "y", range(len(shown)), _pair_names(mdp, shown), fontsize=SMALL)
    for edge in np.arange(len(shown) - 1) + 0.5:
        axes.axhline(edge, color=theme.grid, linewidth=0.6)
    for edge in steps[:-1] + 0.5:
        axes.axvline(edge, color=theme.grid, linewidth=0.6)
    bar = figure.colorbar(picture, ax=axes, pad=0.01, fraction=0.03)
    dress_bar(bar, theme, "posterior probability")
    handles: list[Artist] = [
        Line2D([], [], label="seen", **seen_style),
        Line2D([], [], label="happened", **true_style),
    ]
    wrong = int((seen != true).sum())
    head(
        figure,
        theme,
        handles,
        title=f"What is believed of one trajectory ({wrong} of {counted(length, 'report')} wrong)",
    )
    return figure


def _pair_names(mdp: TabularMDP, pairs: np.ndarray) -> list[str]:
    """Name state and action, without the parts that all states share."""
    parts = [name.split(", ") for name in mdp.state_names]
    alike = len({len(p) for p in parts}) == 1
    varies = [not alike or len(set(column)) > 1 for column in zip(*parts, strict=False)]
    names = []
    for g in pairs:
        s, a = divmod(int(g), mdp.n_actions)
        state = (
            ", ".join(p for p, kept in zip(parts[s], varies, strict=True) if kept)
            if alike
            else mdp.state_names[s]
        )
        names.append(f"{state}: {mdp.action_names[a]}")
    return names
