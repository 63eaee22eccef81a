"""Charts of an experiment: learning curves, learning time, success rates, weights.

Each function returns a matplotlib ``Figure`` made of plain arrays, in the theme asked for; see
:func:`i2rl.analysis.drawing.style.save_themes` for writing both. Floor maps are in
:mod:`i2rl.analysis.drawing.maps`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter
from scipy.stats import binomtest

from ...models.inputs.text import counted
from ..judging.metrics import quantile_band
from .style import LIGHT, TEXT, Theme, dress, foot, head, method_styles, name_ticks, new_figure
from .text import for_figure


class LearningCurve(NamedTuple):
    """One method's replications over the same sessions.

    ``sessions [T]`` are session numbers, ``accuracy [replications, T]`` LBA in [0, 1], ``log_likelihood
    [replications, T]`` nats per trajectory.
    """

    method: str
    sessions: Int[np.ndarray, " T"]
    accuracy: Float[np.ndarray, "replications T"]
    log_likelihood: Float[np.ndarray, "replications T"]


def learning_curves(
    curves: Sequence[LearningCurve],
    *,
    expert_log_likelihood: float | None = None,
    coverage: float = 0.5,
    x_scale: str = "linear",
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw accuracy and log-likelihood against sessions: medians, and bands that hold ``coverage`` of them.

    ``expert_log_likelihood`` (nats per trajectory) draws the level of the true weights. ``x_scale`` is
    ``linear`` or ``log``. Raises ``ValueError`` for arrays that do not fit.

    See Also
    --------
    i2rl.analysis.weights_plot : draw what was learned
    i2rl.analysis.quantile_band : compute the bands

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import learning_curves
    >>> from i2rl.analysis.drawing.charts import LearningCurve
    >>> accuracy = np.array([[0.4, 0.7, 0.9], [0.5, 0.8, 0.9]])
    >>> figure = learning_curves([LearningCurve("LME-I2RL", np.arange(1, 4), accuracy, 10 * accuracy - 12)])
    >>> [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes]
    [('session', 'share of states'), ('session', 'nats per trajectory')]
    """
    figure = new_figure(theme, 9.2, 4.1)
    figure.get_layout_engine().set(wspace=0.05)  # type: ignore[union-attr, call-arg]
    left, right = figure.subplots(1, 2)
    styles = method_styles(theme, [curve.method for curve in curves])
    for curve in curves:
        for axes, values in ((left, curve.accuracy), (right, curve.log_likelihood)):
            draw_band(axes, styles[curve.method], curve.method, curve.sessions, values, coverage)
    if expert_log_likelihood is not None:
        right.axhline(
            expert_log_likelihood,
            color=theme.ink,
            linewidth=1.4,
            linestyle=(0, (1, 1.5)),
            label="true weights",
        )
    dress(left, theme, title="Learned behaviour accuracy", x="session", y="share of states")
    dress(right, theme, title="Log-likelihood", x="session", y="nats per trajectory")
    left.set_ylim(0, 1.02)
    left.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    for axes in (left, right):
        set_scale(axes, "x", x_scale)
    head(figure, theme, right.get_legend_handles_labels()[0], title=title)
    foot(figure, theme, _of_runs({len(np.atleast_2d(curve.accuracy)) for curve in curves}, coverage))
    return figure


class LearningTime(NamedTuple):
    """One method's time: ``seconds [replications, T]`` spent learning from the first ``trajectories [T]``."""

    method: str
    trajectories: Int[np.ndarray, " T"]
    seconds: Float[np.ndarray, "replications T"]


def learning_time(
    times: Sequence[LearningTime],
    *,
    coverage: float = 0.5,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw cumulative seconds of learning against trajectories seen, both on logarithmic scales.

    Lines are medians, bands hold ``coverage`` of the replications. Raises ``ValueError`` for arrays that do
    not fit and for times that are not positive.
    """
    figure = new_figure(theme, 7.0, 4.4)
    axes = figure.subplots()
    styles = method_styles(theme, [time.method for time in times])
    for time in times:
        if not (np.asarray(time.seconds) > 0).all():
            raise ValueError(
                f"the seconds of {time.method} must be positive to be shown on a logarithmic scale"
            )
        draw_band(axes, styles[time.method], time.method, time.trajectories, time.seconds, coverage)
    dress(axes, theme, x="trajectories seen", y="learning time (s)")
    set_scale(axes, "x", "log")
    set_scale(axes, "y", "log")
    head(figure, theme, axes.get_legend_handles_labels()[0], title=title, columns=2)
    foot(figure, theme, _of_runs({len(np.atleast_2d(time.seconds)) for time in times}, coverage))
    return figure


class SuccessRate(NamedTuple):
    """Counts of one method: ``successes`` and ``timeouts`` out of ``replications``."""

    method: str
    successes: int
    timeouts: int
    replications: int


def success_rates(
    rates: Sequence[SuccessRate],
    *,
    confidence: float = 0.95,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw shares of replications that reached the goal undetected and that timed out, with Wilson intervals.

    Raises ``ValueError`` for a method without replications or with more outcomes than replications.
    """
    for rate in rates:
        if (
            rate.replications < 1
            or min(rate.successes, rate.timeouts) < 0
            or rate.successes + rate.timeouts > rate.replications
        ):
            raise ValueError(
                f"{rate.method}: {rate.successes} successes and {rate.timeouts} time-outs "
                f"of {rate.replications} replications"
            )
    figure = new_figure(theme, 8.6, 1.5 + 0.42 * len(rates))
    panels = figure.subplots(1, 2, sharey=True)
    figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr, call-arg]
    y = np.arange(len(rates))
    replications = np.array([rate.replications for rate in rates])
    for panel, counts, name, color in (
        (panels[0], [rate.successes for rate in rates], "Reached the goal undetected", theme.series[0]),
        (panels[1], [rate.timeouts for rate in rates], "Timed out", theme.series[1]),
    ):
        shares = np.array(counts) / replications
        tests = [binomtest(count, n) for count, n in zip(counts, replications.tolist(), strict=True)]
        low, high = np.transpose([test.proportion_ci(confidence, "wilson") for test in tests])
        panel.hlines(y, low, high, color=color, linewidth=2.2, alpha=0.65)
        panel.plot(shares, y, linestyle="none", marker="o", markersize=7, color=color)
        for at, share, top in zip(y, shares, high, strict=True):
            inside = top > 0.86
            panel.annotate(
                f"{share:.0%}",
                (low[at] if inside else top, at),
                xytext=(-6 if inside else 6, 0),
                textcoords="offset points",
                ha="right" if inside else "left",
                va="center",
                color=theme.ink,
                fontsize=TEXT - 0.5,
            )
        dress(panel, theme, title=name, x="share of replications", grid="x")
        panel.set_xlim(-0.02, 1.02)
        panel.set_xticks([0, 0.25, 0.5, 0.75, 1])
        panel.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    name_ticks(panels[0], "y", y, [rate.method for rate in rates], fontsize=TEXT)
    panels[0].set_ylim(len(rates) - 0.4, -0.6)
    panels[0].set_ylabel("method", color=theme.ink, fontsize=TEXT)
    panels[1].tick_params(left=False)
    if title:
        head(figure, theme, [], title=title)
    trials = _counts(set(replications.tolist()), "trial")
    foot(figure, theme, f"bar: {confidence:.0%} Wilson interval of {trials} a method")
    return figure


def weights_plot(
    feature_names: Sequence[str],
    true_weights: Float[np.ndarray, " K"],
    learned: Float[np.ndarray, "draws K"],
    *,
    coverage: float = 0.9,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw reward's direction: learned weights or posterior draws beside the true ones, each of L1 norm 1.

    Points are medians, bars hold ``coverage`` of the draws. Different directions may prescribe one
    behaviour: a reward is identified no further than that. Raises ``ValueError`` if shapes do not fit or
    if weights are all zero.

    See Also
    --------
    i2rl.analysis.learning_curves : draw how it was learned
    i2rl.analysis.forest_plot : draw a posterior, chain by chain

    Examples
    --------
    >>> from i2rl.analysis import weights_plot
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> figure = weights_plot(corridor.mdp.feature_names, corridor.weights, [[1.8, -0.3], [2.2, -0.1]])
    >>> figure.axes[0].get_xlabel()
    'weight (share of the L1 norm)'
    >>> [label.get_text() for label in figure.axes[0].get_yticklabels()]
    ['at the end', 'moves']
    """
    truth, draws = _direction(np.asarray(true_weights)[None])[0], _direction(np.atleast_2d(learned))
    if draws.shape[1] != len(truth) or len(feature_names) != len(truth):
        raise ValueError(
            f"{len(feature_names)} names, {len(truth)} true weights and {draws.shape[1]} learned do not fit"
        )
    band = quantile_band(draws, coverage)
    figure = new_figure(theme, 6.4, 1.6 + 0.36 * len(truth))
    axes = figure.subplots()
    y = np.arange(len(truth))
    axes.axvline(0, color=theme.muted, linewidth=0.9)
    axes.hlines(y, band.low, band.high, color=theme.series[0], linewidth=2.4, alpha=0.7)
    axes.plot(band.median, y, linestyle="none", marker="o", markersize=6.5, color=theme.series[0])
    axes.plot(
        truth,
        y,
        linestyle="none",
        marker="D",
        markersize=8.5,
        markerfacecolor="none",
        markeredgewidth=1.8,
        color=theme.series[1],
    )
    dress(axes, theme, x="weight (share of the L1 norm)", y="feature", grid="x")
    name_ticks(axes, "y", y, feature_names)
    axes.set_ylim(len(truth) - 0.4, -0.6)
    style: dict[str, Any] = {"linestyle": "none", "markersize": 8}
    learned_label = (
        "learned" if len(draws) == 1 else f"learned: median and middle {coverage:.0%} of {len(draws)}"
    )
    handles = [
        Line2D([], [], marker="o", color=theme.series[0], label=learned_label, **style),
        Line2D([], [], marker="D", color=theme.series[1], markerfacecolor="none", label="true", **style),
    ]
    head(figure, theme, handles, title=title)
    return figure


# -- parts --------------------------------------------------------------------------------------------


def draw_band(
    axes: Axes,
    style: Mapping[str, Any],
    method: str,
    x: Int[np.ndarray, " T"],
    replications: Float[np.ndarray, "replications T"],
    coverage: float,
) -> None:
    """Draw a method's median as a line in its style, and a band that holds ``coverage`` of the replications.

    Raises ``ValueError`` for replications of another length than ``x``.
    """
    x, replications = np.asarray(x), np.atleast_2d(replications)
    if x.ndim != 1 or replications.shape[1:] != x.shape:
        raise ValueError(
            f"{method}: replications of shape {replications.shape} do not fit {x.shape} points along the axis"
        )
    band = quantile_band(replications, coverage)
    if len(replications) > 1:
        axes.fill_between(x, band.low, band.high, color=style["color"], alpha=0.18, linewidth=0)
    axes.plot(
        x,
        band.median,
        label=for_figure(method),
        linewidth=1.8,
        markersize=5,
        markevery=max(len(x) // 8, 1),
        **style,
    )


def set_scale(axes: Axes, which: str, scale: str) -> None:
    """Scale of the axis ``which``, ``x`` or ``y``: ``linear`` or ``log``, the latter with plain numbers."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)(scale)
    if scale == "linear" and which == "x":  # sessions are whole
        axis.set_major_locator(MaxNLocator(8, integer=True))
    if scale == "log":
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _direction(weights: Float[np.ndarray, "n K"]) -> Float[np.ndarray, "n K"]:
    norm = np.abs(weights).sum(1, keepdims=True)
    if not (norm > 0).all():
        raise ValueError("weights that are all zero have no direction")
    return weights / norm


def _of_runs(replications: set[int], coverage: float) -> str:
    """Write the small print of a figure of medians and bands."""
    if replications == {1}:
        return "line: one replication"
    return f"line: median; band: middle {coverage:.0%} of {_counts(replications, 'replication')}"


def _counts(counts: set[int], noun: str) -> str:
    low, high = min(counts), max(counts)
    return counted(low, noun) if low == high else f"{low:,} to {counted(high, noun)}"
