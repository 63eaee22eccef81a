"""Comparison of stopping rules: their false stops and the sessions that they save.

The learned behaviour judges a *false stop*, never the quantity of a rule, so that all rules are judged alike:
a stop after session ``i`` is false if the learned behaviour's accuracy there is worse, by more than
``margin``, than the stream's mean accuracy of its last ``tail`` sessions. (One last session would be a noisy
yardstick, the best one a lucky one.) The accuracy is LBA, which needs the expert: it judges rules, and is
hidden from them. A rule that never fires within the stream makes no false stop and saves zero sessions.

The rules themselves are those of :mod:`i2rl.inference.sessions.stopping`; here each is applied to all streams
at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullLocator, PercentFormatter
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import binomtest

from ..drawing.style import LIGHT, Theme, dress, foot, head, new_figure, series_style

NEVER = 0


class Histories(NamedTuple):
    """Observations of ``R`` streams of ``T`` sessions, and their accuracy.

    Fields
    ------
    log_likelihood, gradient : float ``[R, T]``
        As in :class:`~i2rl.inference.SessionInfo`.
    greedy : int ``[R, T, S]``
        The learned greedy policy's actions.
    error : float ``[R, T]``
        Inverse learning error, absolute.
    accuracy : float ``[R, T]``
        Learned behaviour accuracy in [0, 1].
    """

    log_likelihood: Float[np.ndarray, "R T"]
    gradient: Float[np.ndarray, "R T"]
    greedy: Int[np.ndarray, "R T S"]
    error: Float[np.ndarray, "R T"]
    accuracy: Float[np.ndarray, "R T"]


# -- when the rules stop ------------------------------------------------------------------------------


def likelihood_change(log_likelihood: Float[np.ndarray, "R T"], rho: float) -> Int[np.ndarray, " R"]:
    """Apply criterion 1, :class:`~i2rl.inference.LikelihoodChange`: each stream's stop, or 0."""
    return _first(np.abs(np.diff(log_likelihood, axis=1)) <= rho, 2)


def learning_error_change(error: Float[np.ndarray, "R T"], rho: float) -> Int[np.ndarray, " R"]:
    """Apply criterion 2, ``LearningErrorChange``, to inverse learning errors."""
    return _first(-np.diff(error, axis=1) <= rho, 2)


def moving_window(values: Float[np.ndarray, "R T"], width: int, rho: float) -> Int[np.ndarray, " R"]:
    """Apply :class:`~i2rl.inference.MovingWindow`: as above, of log-likelihoods or gradients."""
    if values.shape[1] < width:
        return np.full(len(values), NEVER)
    return _first(sliding_window_view(values, width, axis=1).std(-1) <= rho, width)


def policy_window(greedy: Int[np.ndarray, "R T S"], width: int, rho: float) -> Int[np.ndarray, " R"]:
    """Apply :class:`~i2rl.inference.PolicyWindow`: as above, of greedy policies."""
    if greedy.shape[1] < width:
        return np.full(len(greedy), NEVER)
    now = greedy[:, width - 1 :]
    count = now.shape[1]
    differing = [(now != greedy[:, lag : lag + count]).mean(-1) for lag in range(width - 1)]
    return _first(np.max(differing, axis=0) <= rho, width)


def _first(fires: Bool[np.ndarray, "R n"], earliest: int) -> Int[np.ndarray, " R"]:
    """Find the session of the first True of each row; the first column is session ``earliest``."""
    return np.where(fires.any(1), fires.argmax(1) + earliest, NEVER)


# -- whether they should have ------------------------------------------------------------------------


class Verdict(NamedTuple):
    """A rule's stops over ``replications`` streams of ``sessions`` sessions.

    Fields
    ------
    false_stops, stops, replications : int
    used : int ``[R]``
        Sessions each stream ran for: all where the rule never fired.
    sessions : int
    loss : float
        Mean accuracy lost by stopping, against the streams' final accuracy; can be negative.
    """

    false_stops: int
    stops: int
    replications: int
    used: Int[np.ndarray, " R"]
    sessions: int
    loss: float

    @property
    def false_rate(self) -> float:
        """Share of all streams that were stopped too soon."""
        return self.false_stops / self.replications

    @property
    def saved(self) -> float:
        """Share of all sessions that were not needed."""
        return 1 - float(self.used.mean()) / self.sessions

    def interval(self, confidence: float = 0.95) -> tuple[float, float]:
        """Compute the Wilson interval of the false-stop rate."""
        interval = binomtest(self.false_stops, self.replications).proportion_ci(confidence, "wilson")
        return float(interval.low), float(interval.high)


def judge_stops(
    stops: Int[np.ndarray, " R"], accuracy: Float[np.ndarray, "R T"], margin: float, tail: int
) -> Verdict:
    """Judge each stream's stop (a session from 1, or 0 for never) by the definition of a false stop.

    Raises ``ValueError`` for stops that do not fit the streams, a negative margin or a tail of no session.

    See Also
    --------
    i2rl.inference.LikelihoodChange : a rule to stop by
    i2rl.inference.MovingWindow : another

    Examples
    --------
    >>> from i2rl.analysis import judge_stops
    >>> accuracy = [[0.5, 0.9, 0.9, 0.9], [0.4, 0.5, 0.6, 0.9]]
    >>> verdict = judge_stops([2, 2], accuracy, margin=0.05, tail=1)
    >>> verdict.false_rate, verdict.saved
    (0.5, 0.5)
    """
    stops, accuracy = np.asarray(stops), np.asarray(accuracy, float)
    replications, sessions = accuracy.shape
    if stops.shape != (replications,) or stops.min() < 0 or stops.max() > sessions:
        raise ValueError(
            f"stops must be {replications} sessions from 0 (never) to {sessions}, got shape {stops.shape} "
            f"from {stops.min()} to {stops.max()}"
        )
    if margin < 0 or not 1 <= tail <= sessions:
        raise ValueError(
            f"the margin must not be negative and the tail 1 to {sessions}, got {margin} and {tail}"
        )
    settled = accuracy[:, -tail:].mean(1)
    stopped = stops != NEVER
    used = np.where(stopped, stops, sessions)
    missing = settled - accuracy[np.arange(replications), used - 1]
    false = stopped & (missing > margin)
    return Verdict(
        int(false.sum()),
        int(stopped.sum()),
        replications,
        used,
        sessions,
        float(missing[stopped].sum() / replications),
    )


# -- sweeping the tolerance ---------------------------------------------------------------------------


class Sweep(NamedTuple):
    """One rule over a range of tolerances ``rho [n]`` in its own ``unit``, and its verdicts."""

    name: str
    unit: str
    rho: Float[np.ndarray, " n"]
    verdicts: tuple[Verdict, ...]

    def at(self, rho: float) -> Verdict:
        """Return the verdict at a tolerance of the sweep."""
        match = np.flatnonzero(np.isclose(self.rho, rho))
        if not len(match):
            raise ValueError(f"{self.name} was not run at rho = {rho:g}")
        return self.verdicts[int(match[0])]


def sweep_tolerance(
    name: str,
    unit: str,
    rule: Callable[[float], Int[np.ndarray, " R"]],
    rho: Sequence[float] | Float[np.ndarray, " n"],
    accuracy: Float[np.ndarray, "R T"],
    margin: float,
    tail: int,
) -> Sweep:
    """Judge ``rule(rho)`` at every tolerance."""
    values = np.asarray(rho, float)
    return Sweep(name, unit, values, tuple(judge_stops(rule(x), accuracy, margin, tail) for x in values))


def stopping_plot(
    sweeps: Sequence[Sweep],
    *,
    control: Sweep | None = None,
    theme: Theme = LIGHT,
    title: str = "",
    note: str = "",
) -> Figure:
    """Draw the false-stop rate against the sessions before a stop, a line a rule, along its sweep of the
    tolerance.

    The lower left is where a rule should go: few sessions, none of them too few. The axis of sessions is
    logarithmic, because the rules differ where nearly all sessions are saved. ``control`` is drawn behind
    them in the colour of secondary text. Raises ``ValueError`` without sweeps.
    """
    if not sweeps:
        raise ValueError("there is no sweep to draw")
    figure = new_figure(theme, 8.4, 5.4)
    axes = figure.subplots()
    handles = []
    if control is not None:
        quiet: dict[str, Any] = {"color": theme.muted, "linewidth": 3.4, "alpha": 0.55, "zorder": 1}
        axes.plot(*_points(control), **quiet)
        handles.append(Line2D([], [], label=control.name, **quiet))
    for i, one in enumerate(sweeps):
        used, rate = _points(one)
        low, high = np.transpose([v.interval() for v in one.verdicts])
        style = series_style(theme, i)
        axes.fill_between(used, low, high, color=style["color"], alpha=0.13, linewidth=0)
        axes.plot(used, rate, linewidth=1.7, markersize=4.5, **style)
        handles.append(Line2D([], [], label=one.name, linewidth=1.7, markersize=4.5, **style))
    sessions = sweeps[0].verdicts[0].sessions
    dress(axes, theme, x=f"sessions learned from, mean (of {sessions})", y="false stops (share of streams)")
    axes.set_xscale("log")
    axes.set_xlim(0.95, 1.1 * sessions)
    axes.set_xticks(
        [x for x in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if x <= sessions],
        minor=False,
    )
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_ylim(-0.02, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    head(figure, theme, handles, title=title, columns=2)
    foot(figure, theme, note or "a point a tolerance; bands: 95 % Wilson intervals")
    return figure


def _points(one: Sweep) -> tuple[np.ndarray, np.ndarray]:
    used = np.array([v.used.mean() for v in one.verdicts])
    return used, np.array([v.false_rate for v in one.verdicts])
