"""Figures of posteriors over weights: their concentration, the agreement of chains, their predictions.

ArviZ computes, the project's themes draw. Each function takes a posterior of
:func:`~i2rl.inference.posteriors.weights.sample_posterior` (weights with the dimensions ``chain``, ``draw``
and ``feature``), raises :class:`~i2rl.analysis.posteriors.diagnostics.InferenceDataError` for anything else,
and returns a matplotlib ``Figure``. Some of many features are drawn with ``idata.sel(feature=[...])``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import arviz as az
import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy import stats

from ...models.inputs.text import counted
from ...models.observation.demonstration import PAD, SEEN
from ...models.process.layout import Layout, require_layout
from ...models.process.mdp import TabularMDP
from ..drawing.maps import hidden_path
from ..drawing.style import LIGHT, SMALL, TEXT, Theme, dress, foot, head, name_ticks, new_figure, series_style
from ..drawing.text import for_figure, number
from .diagnostics import InferenceDataError, require_posterior, summary
from .predictive import predictive_check

_MOST_PANELS = 24
# Vehtari, Gelman, Simpson, Carpenter and Bürkner (2021): split-R-hat below 1.01, 100 effective draws a chain.
_RHAT, _ESS_PER_CHAIN = 1.01, 100
_WEIGHT = "weight (nats)"


def weights_by_session(
    idata: az.InferenceData,
    *,
    true_weights: Float[np.ndarray, " K"] | None = None,
    learned: xr.DataArray | None = None,
    coverage: float = 0.9,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Draw posterior of each weight after so many sessions: median, the middle half, the middle ``coverage``.

    ``idata`` is of :func:`~i2rl.analysis.posteriors.diagnostics.posterior_by_session`. ``learned (session,
    feature)`` adds a learner's point estimates, ``run_history(...).sessions.weights``. Weights are in nats:
    those of an expert who never errs have no such scale, and none of them is ``true_weights`` then.

    Raises ``ValueError`` if the true weights or the learner's do not fit.

    See Also
    --------
    i2rl.analysis.posterior_by_session : sample it
    i2rl.analysis.run_history : a learner's estimates beside it

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import posterior_by_session, weights_by_session
    >>> from i2rl.domains import five_cells
    >>> mdp, weights, *seen = five_cells()
    >>> short = dict(draws=100, warmup=100, chains=2)
    >>> narrowing = posterior_by_session(jax.random.key(0), mdp, *seen, [1, 4, 8], **short)
    >>> figure = weights_by_session(narrowing, true_weights=weights)
    >>> [axes.get_title(loc="left") for axes in figure.axes], figure.axes[0].get_xlabel()
    (['at the end', 'moves'], 'session')
    """
    weights = require_posterior(idata, extra=("session",))
    names, sessions = _names(weights), weights["session"].values
    if true_weights is not None and np.shape(true_weights) != (len(names),):
        raise ValueError(
            f"true_weights must have shape {(len(names),)}, one for each feature drawn, "
            f"got {np.shape(true_weights)}"
        )
    if learned is not None and (
        learned.dims != ("session", "feature") or learned.sizes["feature"] != len(names)
    ):
        raise ValueError(
            f"learned must have the dimensions session and feature ({len(names)}), got {dict(learned.sizes)}"
        )
    inner, outer = (_interval(weights, share) for share in (0.5, coverage))
    median = weights.median(("chain", "draw"))
    figure, panels = _panels(theme, len(names))
    color, other = theme.series[0], theme.series[1]
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.axhline(0, color=theme.muted, linewidth=0.8)
        if learned is not None:
            axes.plot(learned["session"], learned[:, k], color=theme.series[2], linewidth=1.5, zorder=3)
        for (low, high), linewidth in ((outer, 1.6), (inner, 4.5)):
            ends = low.isel(feature=k), high.isel(feature=k)
            axes.vlines(sessions, *ends, color=color, linewidth=linewidth, zorder=4)
        axes.plot(
            sessions,
            median.isel(feature=k),
            color=color,
            linewidth=0.9,
            linestyle=(0, (2, 2)),
            marker="o",
            markersize=6.5,
            markerfacecolor=theme.surface,
            markeredgewidth=1.7,
            zorder=5,
        )
        if true_weights is not None:
            axes.axhline(true_weights[k], color=other, linewidth=1.6, linestyle=(0, (6, 2)), zorder=2)
        dress(axes, theme, title=name)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    _label_grid(panels, theme, "session", _WEIGHT)
    dot: dict[str, Any] = {"marker": "o", "markersize": 6.5, "markerfacecolor": theme.surface}
    handles: list[Any] = [
        Line2D([], [], color=color, linestyle=(0, (2, 2)), **dot, label="posterior median"),
        Line2D([], [], color=color, linewidth=4.5, label="middle half"),
        Line2D([], [], color=color, linewidth=1.6, label=f"middle {coverage:.0%}"),
    ]
    if learned is not None:
        handles.append(Line2D([], [], color=theme.series[2], linewidth=1.5, label="online estimate"))
    if true_weights is not None:
        handles.append(Line2D([], [], color=other, linewidth=1.6, linestyle=(0, (6, 2)), label="true weight"))
    head(figure, theme, handles, title=title, columns=5)
    return figure


def forest_plot(
    idata: az.InferenceData, *, coverage: float = 0.9, theme: Theme = LIGHT, title: str = ""
) -> Figure:
    """Draw each weight: all draws together, and below them every chain on its own; chains should agree.

    Points are medians, thick bars hold the middle half of the draws, thin ones the middle ``coverage``.

    See Also
    --------
    i2rl.analysis.summary : the same in numbers
    i2rl.analysis.trace_plot : draw by draw

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import forest_plot
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> figure = forest_plot(posterior)
    >>> figure.axes[0].get_xlabel(), [label.get_text() for label in figure.axes[0].get_yticklabels()]
    ('weight (nats)', ['at the end', 'moves'])
    """
    weights = require_posterior(idata)
    names, chains = _names(weights, most=60), weights.sizes["chain"]
    figure = new_figure(theme, 7.4, 1.5 + len(names) * (0.34 + 0.11 * chains))
    axes = figure.subplots()
    rows = np.arange(len(names), dtype=float)
    axes.axvline(0, color=theme.muted, linewidth=0.9)
    _draw_bars(axes, weights, rows - 0.26, coverage, 5.0, 6.5, color=theme.ink, marker="o")
    for c in range(chains):
        y = rows - 0.26 + 0.66 * (c + 1) / (chains + 0.5)
        one = weights.isel(chain=[c])
        style = series_style(theme, c)
        _draw_bars(axes, one, y, coverage, 2.6, 4.5, color=style["color"], marker=style["marker"])
    dress(axes, theme, x=_WEIGHT, grid="x")
    name_ticks(axes, "y", rows, names, fontsize=TEXT, color=theme.ink)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(names) - 0.4, -0.6)
    for row in rows[:-1]:
        axes.axhline(row + 0.5, color=theme.grid, linewidth=0.7)
    together = [Line2D([], [], color=theme.ink, marker="o", linewidth=5, label="all chains")]
    head(figure, theme, [*together, *_chain_handles(theme, chains, lines=False)], title=title, columns=5)
    foot(figure, theme, f"point: median; bars: middle 50% and {coverage:.0%} of the draws")
    return figure


def trace_plot(idata: az.InferenceData, *, theme: Theme = LIGHT, title: str = "") -> Figure:
    """Draw each weight's density by chain, and its draws in order; divergent ones are ticked.

    See Also
    --------
    i2rl.analysis.rank_plot : whether chains agree
    i2rl.analysis.summary : the same in numbers

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import trace_plot
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> figure = trace_plot(posterior)
    >>> [axes.get_xlabel() for axes in figure.axes if axes.get_xlabel()]
    ['weight (nats)', 'draw']
    """
    weights = require_posterior(idata)
    names, chains = _names(weights, most=_MOST_PANELS), weights.sizes["chain"]
    figure = new_figure(theme, 9.4, 1.1 + 1.15 * len(names))
    grid = figure.subplots(len(names), 2, squeeze=False, width_ratios=[1, 2.2], sharex="col")
    diverging = _diverging(idata)
    for k, (left, right) in enumerate(grid):
        values = weights.isel(feature=k)
        for c in range(chains):
            style = series_style(theme, c)
            draws = values.isel(chain=c).values
            if np.ptp(draws) > 0:
                x, density = az.kde(draws)
                left.plot(
                    x,
                    density / density.max(),
                    color=style["color"],
                    linestyle=style["linestyle"],
                    linewidth=1.5,
                )
            else:  # a chain that never moves has no density
                left.axvline(draws[0], color=style["color"], linestyle=style["linestyle"], linewidth=1.5)
            right.plot(values["draw"], draws, color=style["color"], linewidth=0.6, alpha=0.75)
        dress(left, theme, y="", x="", grid="x")
        dress(right, theme, grid="y")
        left.set_yticks([])
        left.spines["left"].set_visible(False)
        left.set_ylim(bottom=0)
        right.set_title(for_figure(names[k]), color=theme.ink, fontsize=TEXT, loc="left", pad=3)
        if diverging is not None and diverging.any():
            at = diverging.any("chain").values
            right.plot(
                values["draw"].values[at],
                np.zeros(at.sum()),
                linestyle="none",
                marker="|",
                markersize=9,
                markeredgewidth=1.6,
                color=theme.ink,
                transform=right.get_xaxis_transform(),
                clip_on=False,
            )
    grid[-1, 0].set_xlabel(_WEIGHT, color=theme.ink, fontsize=TEXT)
    grid[-1, 1].set_xlabel("draw", color=theme.ink, fontsize=TEXT)
    figure.supylabel(
        "density, each to its own height (left), weight in nats (right)", color=theme.ink, fontsize=TEXT
    )
    handles: list[Any] = _chain_handles(theme, chains, lines=True)
    if diverging is not None and diverging.any():
        handles.append(
            Line2D(
                [],
                [],
                linestyle="none",
                marker="|",
                markersize=9,
                markeredgewidth=1.6,
                color=theme.ink,
                label=f"divergent draw ({int(diverging.sum())})",
            )
        )
    head(figure, theme, handles, title=title, columns=5)
    return figure


def rank_plot(idata: az.InferenceData, *, bins: int = 20, theme: Theme = LIGHT, title: str = "") -> Figure:
    """Draw the ranks of each chain's draws among all draws, which are even for chains of one distribution.

    Every panel has its own scale, up to its highest bar. The band holds 95 % of the counts in one bin for
    independent draws. Raises ``ValueError`` for fewer than
    two bins.

    See Also
    --------
    i2rl.analysis.trace_plot : draw by draw
    i2rl.analysis.summary : R-hat and effective sample sizes

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import rank_plot
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> figure = rank_plot(posterior, bins=10)
    >>> figure.axes[0].get_xlabel()
    'rank among all draws'
    """
    if bins < 2:
        raise ValueError(f"ranks need at least 2 bins, got {bins}")
    weights = require_posterior(idata)
    names, (chains, draws) = _names(weights, most=_MOST_PANELS), weights.shape[:2]
    figure, panels = _panels(theme, len(names))
    edges = np.linspace(0, chains * draws, bins + 1)
    # A bin holds its share of all ranks; which chains they are from is a draw without replacement.
    per_bin = chains * draws / bins
    low, high = stats.hypergeom(chains * draws, draws, round(per_bin)).ppf([0.025, 0.975])
    for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
        ranks = stats.rankdata(weights.isel(feature=k).values).reshape(chains, draws)
        axes.axhspan(low, high, color=theme.cell, linewidth=0)
        axes.axhline(draws / bins, color=theme.muted, linewidth=0.9)
        # Twice the expected count at least, so that a panel of a good fit is flat.
        highest = 2 * draws / bins
        for c in range(chains):
            style = series_style(theme, c)
            counts, _ = np.histogram(ranks[c] - 0.5, edges)
            highest = max(highest, float(counts.max()))
            axes.stairs(
                counts,
                edges,
                baseline=None,
                color=style["color"],
                linestyle=style["linestyle"],
                linewidth=1.4,
            )
        dress(axes, theme, title=name, grid=None)
        axes.set(xlim=(edges[0], edges[-1]), ylim=(0, 1.06 * highest))
    _label_grid(panels, theme, "rank among all draws", "draws in a bin")
    handles = [
        *_chain_handles(theme, chains, lines=True),
        Patch(color=theme.cell, label="95% of bins, independent draws"),
    ]
    head(figure, theme, handles, title=title, columns=5)
    return figure


def convergence_plot(idata: az.InferenceData, *, theme: Theme = LIGHT, title: str = "") -> Figure:
    """Draw R-hat and effective sample sizes of each weight beside their recommended limits.

    Also of a posterior by session. Limits: 1.01, and 100 effective draws a chain (Vehtari and others 2021).
    """
    table = summary(idata)
    weights = idata["posterior"]["weights"]
    labels = [name.removeprefix("weights[").removesuffix("]") for name in table.index]
    chains, draws = weights.shape[:2]
    figure = new_figure(theme, 9.4, 1.7 + 0.3 * len(labels))
    left, right = figure.subplots(1, 2, sharey=True)
    y = np.arange(len(labels))
    blue, orange = series_style(theme, 0), series_style(theme, 1)
    dots: dict[str, Any] = {"linestyle": "none", "markersize": 7}
    # ArviZ gives draws that never change the effective size of as many independent ones.
    frozen = np.ptp(weights.values, axis=(0, 1)).ravel() == 0
    table.loc[frozen, ["r_hat", "ess_bulk", "ess_tail"]] = np.nan
    known = table["r_hat"][np.isfinite(table["r_hat"])]
    low, high = min([0.999, *known]), max([_RHAT + 0.002, *known])
    left.set_xlim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    left.axvspan(_RHAT, left.get_xlim()[1], color=theme.cell, linewidth=0)
    left.plot(table["r_hat"], y, marker="o", color=theme.series[0], **dots)
    if chains == 1:
        left.text(0.5, 0.5, "needs two chains", transform=left.transAxes, ha="center", color=theme.ink)
    for axes in (left, right):
        for row in y[frozen]:
            axes.text(
                0.5,
                row,
                "stuck: every draw is the same",
                transform=axes.get_yaxis_transform(),
                ha="center",
                va="center",
                color=theme.ink,
                fontsize=SMALL,
                fontweight="bold",
            )
    for name, style in (("ess_bulk", blue), ("ess_tail", orange)):
        right.plot(table[name], y, marker=style["marker"], color=style["color"], **dots)
    limit = _ESS_PER_CHAIN * chains
    right.axvspan(0, limit, color=theme.cell, linewidth=0)
    right.axvline(chains * draws, color=theme.muted, linewidth=1, linestyle=(0, (2, 2)))
    right.set_xlim(
        0, 1.08 * np.nanmax([chains * draws, *table[["ess_bulk", "ess_tail"]].values.ravel(), limit])
    )
    dress(left, theme, title="R-hat", x="split R-hat, rank-normalised", grid="both")
    dress(right, theme, title="Effective sample size", x="independent draws of equal worth", grid="both")
    left.xaxis.set_major_locator(MaxNLocator(5))
    name_ticks(left, "y", y, labels, fontsize=TEXT - 0.5, color=theme.ink)
    left.set_ylim(len(labels) - 0.5, -0.5)
    handles: list[Any] = [
        Line2D([], [], marker=blue["marker"], color=blue["color"], **dots, label="R-hat; bulk size"),
        Line2D([], [], marker=orange["marker"], color=orange["color"], **dots, label="tail size"),
        Patch(color=theme.cell, label=f"sample longer: R-hat over {_RHAT}, size under {limit}"),
        Line2D([], [], color=theme.muted, linewidth=1, linestyle=(0, (2, 2)), label="all draws"),
    ]
    head(figure, theme, handles, title=title, columns=4)
    diverging = _diverging(idata)
    count = "unknown" if diverging is None else f"{int(diverging.sum())}"
    sampled = f"{counted(chains, 'chain')} of {counted(draws, 'draw')}"
    foot(figure, theme, f"{sampled}; divergent draws: {count}; R-hat: ratio of pooled to within-chain spread")
    return figure


def completed_path(
    mdp: TabularMDP,
    idata: az.InferenceData,
    trajectories: Sequence[int],
    layout: Layout,
    path: Int[np.ndarray, " L"] | None = None,
    *,
    seconds: float | None = None,
    theme: Theme = LIGHT,
    title: str = "Where the agent may have been",
) -> Figure:
    """Draw completions of a partly hidden path: how often each place in the posterior.

    The uncertainty about the weights is in it, since each draw of the weights has its own completion.
    ``trajectories`` are the rows to show, one after the other (consecutive windows of one patrol, say);
    ``path`` is the true states of their steps. See :func:`~i2rl.analysis.drawing.maps.hidden_path`.

    Raises ``ValueError`` for rows that do not exist and a layout of another number of states.

    See Also
    --------
    i2rl.analysis.hidden_path : the picture of any belief

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import completed_path
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> from i2rl.models import Layout
    >>> mdp, _, sensor, demonstration = five_cells()
    >>> options = {"draws": 100, "warmup": 100, "chains": 2}
    >>> posterior = sample_posterior(jax.random.key(0), mdp, sensor, demonstration, **options)
    >>> layout = Layout.grid([(0, column) for column in range(5)])
    >>> completed_path(mdp, posterior, [0], layout).axes[1].get_xlabel()
    'step'
    """
    require_layout(layout, mdp)
    belief, seen = completion_frequencies(idata, trajectories, mdp)
    return hidden_path(belief, seen, layout, path, seconds=seconds, theme=theme, title=title)


def completion_frequencies(
    idata: az.InferenceData, trajectories: Sequence[int], mdp: TabularMDP
) -> tuple[Float[np.ndarray, "L S"], np.ndarray]:
    """Compute how often each state completes each step, and whether the step was seen; rows joined one by
    one.
    """
    require_posterior(idata, mdp)
    for group, made in (
        ("completions", "sample_posterior(..., completions=True)"),
        ("observed_data", "sample_posterior"),
    ):
        if group not in idata.groups():
            raise InferenceDataError(f"the InferenceData has no group {group!r}, which {made} makes")
    n = idata["completions"].sizes["trajectory"]
    rows = [int(row) for row in trajectories]
    if not rows or not all(0 <= row < n for row in rows):
        raise ValueError(f"trajectories must be some of 0 to {n - 1}, got {list(trajectories)}")
    kinds = idata["observed_data"]["kind"].values[rows].ravel()
    states = idata["completions"]["state"].values[..., rows, :]
    states = states.reshape(-1, len(kinds))[:, kinds != PAD]
    hits = [np.bincount(column, minlength=mdp.n_states) for column in states.T]
    return np.array(hits) / len(states), kinds[kinds != PAD] == SEEN


def predictive_plot(
    idata: az.InferenceData, *, coverage: float = 0.9, theme: Theme = LIGHT, title: str = ""
) -> Figure:
    """Draw visits seen of each state against their posterior predictive interval, the most expected first.

    ``idata`` is of :func:`~i2rl.analysis.posteriors.predictive.predictive_visits`. States never seen and
    hardly ever predicted (an interval of zero alone) are left out, and counted below.
    """
    check = predictive_check(idata, coverage)
    expected = idata["posterior_predictive"]["expected_visits"].mean(("chain", "draw"))
    kept = np.flatnonzero((check["observed"] > 0) | (check["high"] > 0))
    order = kept[np.argsort(-expected.values[kept], kind="stable")]
    shown, mean = check.isel(visited_state=order), expected.values[order]
    observed, low, high = (shown[name].values for name in ("observed", "low", "high"))
    inside = (low <= observed) & (observed <= high)
    x = np.arange(len(order))
    figure = new_figure(theme, max(7.0, min(2.5 + 0.17 * len(order), 13.0)), 4.8)
    axes = figure.subplots()
    axes.vlines(x, low, high, color=theme.series[0], linewidth=3.2, alpha=0.45)
    axes.plot(x, mean, linestyle="none", marker="_", markersize=7, markeredgewidth=1.8, color=theme.series[0])
    within: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 4.5, "color": theme.ink}
    beyond: dict[str, Any] = {
        "linestyle": "none",
        "marker": "D",
        "markersize": 5.5,
        "color": theme.series[1],
    }
    axes.plot(x[inside], observed[inside], **within)
    axes.plot(x[~inside], observed[~inside], **beyond)
    dress(axes, theme, x="state, by expected visits", y="steps seen", grid="y")
    name_ticks(
        axes,
        "x",
        x,
        shown["visited_state"].values,
        rotation=90,
        fontsize=SMALL - 1 if len(x) > 40 else SMALL,
    )
    axes.set_xlim(-0.8, len(x) - 0.2)
    axes.set_ylim(bottom=-0.04 * max(high.max(initial=1), observed.max(initial=1)))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    handles = [
        Line2D(
            [],
            [],
            color=theme.series[0],
            linewidth=3.2,
            alpha=0.45,
            label=f"predicted, middle {coverage:.0%}",
        ),
        Line2D(
            [],
            [],
            color=theme.series[0],
            linestyle="none",
            marker="_",
            markersize=7,
            markeredgewidth=1.8,
            label="predicted mean",
        ),
        Line2D([], [], **within, label=f"seen, inside ({inside.sum()})"),
        Line2D([], [], **beyond, label=f"seen, outside ({(~inside).sum()})"),
    ]
    head(figure, theme, handles, title=title, columns=4)
    left_out = check.sizes["visited_state"] - len(order)
    p = float(check["discrepancy_p_value"])
    note = f"Bayesian p-value of the whole (Freeman-Tukey): {number(p)}"
    rest = f"; {counted(left_out, 'state')} neither seen nor predicted" if left_out else ""
    foot(figure, theme, note + rest)
    return figure


# -- parts --------------------------------------------------------------------------------------------


def _names(weights: xr.DataArray, most: int = _MOST_PANELS) -> list[str]:
    names = [str(name) for name in weights["feature"].values]
    if len(names) > most:
        raise ValueError(
            f"at most {most} features can be drawn legibly, got {len(names)}: "
            "choose some with idata.sel(feature=[...])"
        )
    return names


def _panels(theme: Theme, n: int) -> tuple[Figure, list[Axes]]:
    columns = min(n, 3)
    rows = -(-n // columns)
    figure = new_figure(theme, 3.15 * columns + 0.4 if n > 1 else 5.2, 2.25 * rows + 0.9)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
    for axes in grid.ravel()[n:]:
        axes.set_axis_off()
    for axes in grid[-1, : n - columns * (rows - 1)]:
        axes.tick_params(labelbottom=True)
    return figure, list(grid.ravel()[:n])


def _label_grid(panels: Sequence[Axes], theme: Theme, x: str, y: str) -> None:
    columns = min(len(panels), 3)
    for i, axes in enumerate(panels):
        if i % columns == 0:
            axes.set_ylabel(y, color=theme.ink, fontsize=TEXT)
        if i + columns >= len(panels):
            axes.set_xlabel(x, color=theme.ink, fontsize=TEXT)
            axes.tick_params(labelbottom=True)


def _interval(weights: xr.DataArray, coverage: float) -> tuple[xr.DataArray, xr.DataArray]:
    if not 0 < coverage < 1:
        raise ValueError(f"coverage must lie between 0 and 1, got {coverage}")
    low, high = ((1 - coverage) / 2, (1 + coverage) / 2)
    return weights.quantile(low, ("chain", "draw")), weights.quantile(high, ("chain", "draw"))


def _draw_bars(
    axes: Axes,
    weights: xr.DataArray,
    y: Float[np.ndarray, " K"],
    coverage: float,
    width: float,
    size: float,
    *,
    color: str,
    marker: str,
) -> None:
    axes.hlines(y, *_interval(weights, coverage), color=color, linewidth=width / 3)
    axes.hlines(y, *_interval(weights, 0.5), color=color, linewidth=width)
    median = weights.median(("chain", "draw"))
    axes.plot(median, y, linestyle="none", marker=marker, markersize=size, color=color)


def _chain_handles(theme: Theme, chains: int, *, lines: bool) -> list[Line2D]:
    styles = [series_style(theme, c) for c in range(chains)]
    if lines:
        styles = [{**style, "marker": None} for style in styles]
    else:
        styles = [{**style, "linestyle": "solid", "markersize": 4.5} for style in styles]
    return [Line2D([], [], linewidth=1.8, **style, label=f"chain {c}") for c, style in enumerate(styles)]


def _diverging(idata: az.InferenceData) -> xr.DataArray | None:
    has = "sample_stats" in idata.groups() and "diverging" in idata["sample_stats"]
    return idata["sample_stats"]["diverging"] if has else None
