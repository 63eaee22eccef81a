"""Figures of the sorting study: components, their behaviours, and learning against data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from ....domains.sorting.process import (
    ACTIONS,
    BIN,
    BLEMISHED,
    GOOD,
    HELD,
    INSPECTED,
    PREDICTION,
    PUT_BACK,
    TABLE,
    UNKNOWN,
    Sorting,
)
from ....models.inputs.text import counted
from ....models.observation.demonstration import PAD, Demonstration
from ....models.process.mdp import TabularMDP
from ....models.process.planning import finite_occupancy, reachable_states
from ...drawing.charts import set_scale
from ...drawing.style import MARKERS, SMALL, TEXT, Theme, dress, foot, head, method_styles, new_figure
from ...judging.metrics import greedy_policy, optimal_actions, policy_accuracy
from ...judging.multi_task import match_components

if TYPE_CHECKING:
    from .study import SortingStudy

# Legends and notes need so many inches, however few the panels are.
_WIDTH_OF_TEXT = 6.5
_COLOURS = len(MARKERS)

# -- clusters -----------------------------------------------------------------------------------------


class Embedding(NamedTuple):
    """Principal components: ``points [n, 2]``, ``shares [2]`` of the variance, ``loadings [2, K]``."""

    points: Float[np.ndarray, "n 2"]
    shares: Float[np.ndarray, " 2"]
    loadings: Float[np.ndarray, "2 K"]


def embed(features: Float[np.ndarray, "n K"]) -> Embedding:
    """Project on the two directions along which features vary most, and place each trajectory (PCA by SVD).

    The largest loading of each direction is positive. Fewer than two varying directions leave zeros.
    """
    centred = features - features.mean(0)
    left, scale, directions = np.linalg.svd(centred, full_matrices=False)
    kept = min(2, len(scale))
    points, loadings, shares = np.zeros((len(features), 2)), np.zeros((2, features.shape[1])), np.zeros(2)
    signs = np.sign(directions[np.arange(kept), np.abs(directions[:kept]).argmax(1)])
    points[:, :kept] = left[:, :kept] * scale[:kept] * signs
    loadings[:kept] = directions[:kept] * signs[:, None]
    total = (scale**2).sum()
    shares[:kept] = scale[:kept] ** 2 / total if total > 0 else 0.0
    return Embedding(points, shares, loadings)


def feature_counts(mdp: TabularMDP, demonstration: Demonstration) -> Float[np.ndarray, "n K"]:
    """Compute undiscounted sums of features over the steps of fully seen trajectories."""
    real = np.asarray(demonstration.kind) != PAD
    per_step = np.asarray(mdp.features)[demonstration.state, demonstration.action]
    return np.sum(np.where(real[..., None], per_step, 0.0), axis=1)


def clusters_plot(study: SortingStudy, theme: Theme) -> Figure:
    """Draw first replication's trajectories on two principal components of feature counts, a panel a method.

    The marker is the true component; the colour the component found.
    """
    mdp = study.sorting.mdp
    embedding = embed(feature_counts(mdp, study.demonstration))
    results = study.results
    columns = min(3, len(results))
    rows = -(-len(results) // columns)
    figure = new_figure(theme, max(1.4 + 3.1 * columns, _WIDTH_OF_TEXT), 1.6 + 2.7 * rows)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    most = 1
    for i, (panel, result) in enumerate(zip(panels, results, strict=False)):
        components = _numbered(study.labels, result.found.assignments)
        found = len(components)
        most = max(most, found)
        for b in range(study.tasks):
            for d, component in enumerate(components):
                rows_here = (study.labels == b) & (result.found.assignments == component)
                panel.plot(
                    *embedding.points[rows_here].T,
                    linestyle="",
                    marker=MARKERS[b],
                    markersize=7,
                    markerfacecolor="none",
                    markeredgecolor=theme.series[d % _COLOURS],
                    markeredgewidth=1.5,
                    alpha=0.85,
                )
        dress(panel, theme, title=f"{result.name}: {counted(found, 'component')}")
        panel.margins(0.12)
        if i >= len(results) - columns:
            panel.set_xlabel(f"component 1 ({embedding.shares[0]:.1%} of variance)", color=theme.ink)
            panel.tick_params(labelbottom=True)
        if i % columns == 0:
            panel.set_ylabel(f"component 2 ({embedding.shares[1]:.1%})", color=theme.ink)
    for panel in panels[len(results) :]:
        panel.set_visible(False)
    names = study.sorting.behaviours
    handles: list[Artist] = [
        Line2D(
            [],
            [],
            linestyle="",
            marker=MARKERS[b],
            markersize=7,
            markerfacecolor="none",
            markeredgecolor=theme.ink,
            label=f"done: {names[b]}",
        )
        for b in range(study.tasks)
    ]
    handles += [
        Line2D(
            [],
            [],
            linestyle="",
            marker="o",
            markersize=8,
            color=theme.series[d % _COLOURS],
            label=f"found: component {d + 1}"
            + (" (more reuse colours)" if d == _COLOURS - 1 < most - 1 else ""),
        )
        for d in range(min(most, _COLOURS))
    ]
    head(figure, theme, handles, title=f"{counted(len(study.labels), 'trajectory')}, first replication")
    told = ";\n".join(f"component {k + 1}: {_loading(mdp, embedding.loadings[k])}" for k in range(2))
    foot(figure, theme, told)
    return figure


def _loading(mdp: TabularMDP, loading: Float[np.ndarray, " K"]) -> str:
    """Name the two features that a component weighs most, signed; short."""
    top = [k for k in np.argsort(-np.abs(loading))[:2] if loading[k]]
    return ", ".join(f"{'more' if loading[k] > 0 else 'less'} {mdp.feature_names[k]!r}" for k in top)


def _numbered(labels: Int[np.ndarray, " n"], assignments: Int[np.ndarray, " n"]) -> list[int]:
    """Order the components that have trajectories: by the behaviours they match, then the unmatched ones."""
    matched = [component for _, component in sorted(match_components(labels, assignments).items())]
    return matched + [component for component in np.unique(assignments).tolist() if component not in matched]


# -- behaviour of a component -------------------------------------------------------------------------

# Where an onion is, left to right, and what is thought of it, from top to bottom; the bin below all.
_COLUMN = {TABLE: 0.0, PUT_BACK: 0.0, HELD: 1.9, INSPECTED: 3.8}
_ROW = {GOOD: 1.15, UNKNOWN: 0.0, BLEMISHED: -1.15}
_BIN = (1.9, -2.3)
_PLACE = {TABLE: "on the table", HELD: "in the hand", INSPECTED: "at the eyes"}
_HALF = (0.48, 0.24)
# What is left out of a diagram: places and actions rarer than this, and outcomes of an action (slips, a roll
# that finds nothing).
RARE_STEP, RARE_OUTCOME = 0.03, 0.12
_DIAGRAMS = 4

Place = tuple[int, int]


class Flow(NamedTuple):
    """Policy over places (the onion's place and prediction) and actions.

    ``visits`` are shares of steps at each place; ``moves`` of steps that go from one place to another by an
    action. Both leave out rare transitions.
    """

    visits: dict[Place, float]
    moves: dict[tuple[Place, Place], dict[int, float]]


def flow_of(sorting: Sorting, policy: Float[np.ndarray, "S A"], steps: int) -> Flow:
    """Compute where ``steps`` steps of a policy are spent, and the flow from place to place."""
    mdp = sorting.mdp
    always = jnp.broadcast_to(jnp.asarray(policy), (steps, *policy.shape))
    share = np.asarray(finite_occupancy(mdp, always)).mean(0)
    places = [(state.onion, state.prediction) for state in sorting.states]
    successors, probabilities = np.asarray(mdp.successors), np.asarray(mdp.probabilities)
    visits: dict[Place, float] = {}
    taken: dict[tuple[Place, int], float] = {}
    moves: dict[tuple[Place, Place, int], float] = {}
    for s, a in np.argwhere(share > 0):
        here, mass = places[s], share[s, a]
        visits[here] = visits.get(here, 0.0) + mass
        taken[here, int(a)] = taken.get((here, int(a)), 0.0) + mass
        for to, probability in zip(successors[s, a], probabilities[s, a], strict=True):
            move = (here, places[to], int(a))
            moves[move] = moves.get(move, 0.0) + mass * probability
    drawn: dict[tuple[Place, Place], dict[int, float]] = {}
    for (here, there, action), mass in moves.items():
        if taken[here, action] >= RARE_STEP and mass >= RARE_OUTCOME * taken[here, action]:
            drawn.setdefault((here, there), {})[action] = mass
    at = {place: share for place, share in visits.items() if share >= RARE_STEP}
    return Flow(at, drawn)


def components_diagram(study: SortingStudy, theme: Theme) -> Figure:
    """Draw each component found as a state diagram of an onion, of the first method of the study.

    Boxes are the onion's place and prediction (hand and list left out); arrows are the greedy policy of the
    learned weights.
    """
    result, sorting = study.results[0], study.sorting
    sizes = np.bincount(result.found.assignments)
    components = _numbered(study.labels, result.found.assignments)
    shown = components[:_DIAGRAMS]
    figure = new_figure(theme, max(0.4 + 5.2 * len(shown), _WIDTH_OF_TEXT), 5.9)
    figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    behaviour_of = {d: b for b, d in match_components(study.labels, result.found.assignments).items()}
    for number, (panel, component) in enumerate(zip(panels, shown, strict=True), start=1):
        policy = np.asarray(greedy_policy(sorting.mdp, jnp.asarray(result.found.weights[component])))
        draw_flow(panel, theme, sorting, flow_of(sorting, policy, study.steps))
        panel.set_title(
            f"Component {number}: {sizes[component]} of {counted(len(study.labels), 'trajectory')}\n"
            + _likeness(sorting, policy, behaviour_of.get(component)),
            color=theme.ink,
            fontsize=TEXT + 1,
            loc="left",
        )
    which = "Components" if len(components) == len(shown) else f"{len(shown)} of {len(components)} components"
    head(figure, theme, [], title=f"{which} found by {result.name}: what is done with an onion")
    foot(
        figure,
        theme,
        f"percent: share of {study.steps} steps, as is an arrow's width; left out: what takes less than "
        f"{RARE_STEP:.0%} of steps, outcomes below {RARE_OUTCOME:.0%} (slips)",
    )
    return figure


def _likeness(sorting: Sorting, policy: Float[np.ndarray, "S A"], behaviour: int | None) -> str:
    if behaviour is None:
        return "no behaviour's own"
    optimal = optimal_actions(sorting.mdp, jnp.asarray(sorting.weights[behaviour]))
    share = float(policy_accuracy(sorting.mdp, optimal, jnp.asarray(policy)).overall)
    name = sorting.behaviours[behaviour]
    n = sorting.mdp.n_states
    return f"{name} (as its expert in {round(share * n)} of {n} states)"


def draw_flow(axes: Axes, theme: Theme, sorting: Sorting, flow: Flow) -> None:
    """Draw one state diagram; places that are hardly visited are faint."""
    reachable = reachable_states(sorting.mdp)
    states = [state for state, reached in zip(sorting.states, reachable, strict=True) if reached]
    tint = {GOOD: theme.goal, BLEMISHED: theme.mismatch, UNKNOWN: theme.match}
    for place in sorted({(state.onion, state.prediction) for state in states}):
        x, y = _position(place)
        seen = place in flow.visits
        color = theme.muted if place[0] == BIN else tint[place[1]]
        axes.add_patch(
            FancyBboxPatch(
                (x - _HALF[0], y - _HALF[1]),
                2 * _HALF[0],
                2 * _HALF[1],
                boxstyle="round,pad=0,rounding_size=0.12",
                zorder=3,
                facecolor=(color, 0.28) if seen else theme.surface,
                edgecolor=color if seen else theme.grid,
                linewidth=1.8 if seen else 1.0,
            )
        )
        text = "in the bin" if place[0] == BIN else PREDICTION[place[1]]
        axes.text(
            x,
            y,
            text,
            ha="center",
            va="center",
            fontsize=SMALL + 0.5,
            zorder=4,
            color=theme.ink if seen else theme.muted,
            linespacing=1.25,
        )
    for onion, name in _PLACE.items():
        axes.text(_COLUMN[onion], 1.68, name, ha="center", va="center", fontsize=TEXT, color=theme.muted)
    for (here, there), actions in flow.moves.items():
        _arrow(axes, theme, here, there, actions)
    axes.set(xlim=(-0.6, 4.4), ylim=(-2.65, 1.85), aspect="equal")
    axes.set_axis_off()


def _position(place: Place) -> tuple[float, float]:
    return _BIN if place[0] == BIN else (_COLUMN[place[0]], _ROW[place[1]])


def _arrow(axes: Axes, theme: Theme, here: Place, there: Place, actions: dict[int, float]) -> None:
    total = sum(actions.values())
    label = "\n".join(f"{ACTIONS[a]} {share:.0%}" for a, share in sorted(actions.items()))
    width = 1.0 + 3.0 * total
    style: dict[str, Any] = {
        "arrowstyle": f"-|>,head_length={4 + width},head_width={2 + width / 1.6}",
        "linewidth": width,
        "color": theme.ink,
        "zorder": 2,
        "shrinkA": 0,
        "shrinkB": 0,
        "capstyle": "butt",
        "joinstyle": "miter",
    }
    (x, y), (u, v) = _position(here), _position(there)
    aside = 0.0
    if here == there:
        axes.add_patch(
            FancyArrowPatch(
                (x - 0.25, y + _HALF[1]), (x + 0.25, y + _HALF[1]), connectionstyle="arc3,rad=-1.25", **style
            )
        )
        at = (x, y + _HALF[1] + 0.44)
    else:
        start, end = _border((x, y), (u, v)), _border((u, v), (x, y))
        axes.add_patch(FancyArrowPatch(start, end, connectionstyle="arc3,rad=0", **style))
        # Off the middle, where arrows cross; those that go back to the table, nearer to it.
        along = 0.63 if u < x else 0.4
        at = (start[0] + along * (end[0] - start[0]), start[1] + along * (end[1] - start[1]))
        aside = 0.1 if u == x else 0.0
    axes.text(
        at[0] + aside,
        at[1],
        label,
        ha="left" if aside else "center",
        va="center",
        fontsize=SMALL,
        color=theme.ink,
        zorder=5,
        linespacing=1.15,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": theme.surface, "edgecolor": "none", "alpha": 0.9},
    )


def _border(centre: tuple[float, float], towards: tuple[float, float]) -> tuple[float, float]:
    """Find the point where the line between two boxes leaves the first."""
    dx, dy = towards[0] - centre[0], towards[1] - centre[1]
    reach = min(_HALF[0] / abs(dx) if dx else np.inf, _HALF[1] / abs(dy) if dy else np.inf)
    return centre[0] + dx * reach, centre[1] + dy * reach


# -- against the number of trajectories ---------------------------------------------------------------


def evd_plot(study: SortingStudy, theme: Theme) -> Figure:
    """Draw EVD against trajectories: every replication a dot, the mean a line, a bar over all replications.

    The scale is logarithmic down to a power of ten below the smallest value that is not zero, and linear
    from there to zero.
    """
    figure = new_figure(theme, 8.6, 4.8)
    axes = figure.subplots()
    for i, result in enumerate(study.results):
        values = result.measures.value_difference
        _draw_runs(axes, theme, study, i, values, values.mean(0))
    axes.axhline(
        study.one_component,
        color=theme.ink,
        linewidth=1.2,
        linestyle=(0, (1, 1.5)),
        label="best single behaviour",
    )
    values = np.concatenate([r.measures.value_difference.ravel() for r in study.results])
    positive = values[values > 0]
    threshold = 10.0 ** np.floor(np.log10(positive.min() / 2)) if positive.size else 1.0
    axes.set_yscale("symlog", linthresh=threshold, linscale=0.4)
    axes.set_ylim(-0.12 * threshold, max(float(values.max()), study.one_component) * 2)
    dress(axes, theme, x="trajectories", y="expected value difference\n(discounted reward a trajectory)")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    _at_counts(axes, study)
    head(
        figure,
        theme,
        axes.get_legend_handles_labels()[0],
        title=f"Value lost, {counted(study.tasks, 'task')}",
    )
    foot(
        figure,
        theme,
        f"line: mean; dots and bar: {_all_runs(study)}; scale linear below {threshold:g}",
    )
    return figure


def _draw_runs(
    axes: Axes,
    theme: Theme,
    study: SortingStudy,
    i: int,
    values: Float[np.ndarray, "replications T"],
    middle: Float[np.ndarray, " T"],
) -> None:
    """Draw the ``i``-th method's replications as dots beside those of the other methods."""
    result = study.results[i]
    style = method_styles(theme, [r.name for r in study.results])[result.name]
    x = result.trajectories * np.exp(0.05 * (i - (len(study.results) - 1) / 2))
    axes.plot(
        np.broadcast_to(x, values.shape).ravel(),
        values.ravel(),
        linestyle="",
        markersize=4.5,
        alpha=0.5,
        marker=style["marker"],
        color=style["color"],
        markeredgewidth=0,
        clip_on=False,
    )
    axes.vlines(x, values.min(0), values.max(0), color=style["color"], linewidth=1.6, alpha=0.45)
    axes.plot(x, middle, label=result.name, linewidth=1.6, markersize=6.5, clip_on=False, **style)


def components_plot(study: SortingStudy, theme: Theme) -> Figure:
    """Draw the number of components found: the area of a disc is a share of replications."""
    results = study.results
    figure = new_figure(theme, max(1.2 + 2.3 * len(results), _WIDTH_OF_TEXT), 3.9)
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    most = max(int(result.measures.n_components.max()) for result in results)
    # Discs of one column or row must not touch.
    columns = max(len(result.trajectories) for result in results)
    largest = min(34.0, 150.0 / most, 135.0 / columns) ** 2
    for i, (panel, result) in enumerate(zip(panels, results, strict=True)):
        panel.axhline(study.tasks, color=theme.goal, linewidth=1.6, zorder=1)
        for t in range(len(result.trajectories)):
            numbers, replications = np.unique(result.measures.n_components[:, t], return_counts=True)
            panel.scatter(
                np.full(len(numbers), t),
                numbers,
                s=largest * replications / study.replications,
                zorder=2,
                linewidth=0,
                color=[theme.series[0] if n == study.tasks else theme.series[1] for n in numbers],
            )
        dress(panel, theme, title=result.name, x="trajectories", grid="y")
        panel.title.set_fontsize(TEXT)
        panel.set_xticks(range(len(result.trajectories)), [f"{n}" for n in result.trajectories])
        panel.set_xlim(-0.6, len(result.trajectories) - 0.4)
        panel.tick_params(axis="y", left=i == 0)
    panels[0].set_ylabel("components found", color=theme.ink)
    panels[0].set_ylim(0.3, most + 0.7)
    panels[0].yaxis.set_major_locator(MaxNLocator(integer=True))
    disc: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 10}
    handles: list[Artist] = [
        Line2D([], [], color=theme.series[0], label="the true number", **disc),
        Line2D([], [], color=theme.series[1], label="another", **disc),
        Line2D([], [], color=theme.goal, linewidth=1.6, label=f"truth: {study.tasks}"),
    ]
    head(figure, theme, handles, title="Number of components found")
    foot(figure, theme, f"area of a disc: share of {_all_runs(study)}")
    return figure


def time_plot(study: SortingStudy, theme: Theme) -> Figure:
    """Draw seconds of learning against trajectories; the online learner's are those of all its sessions so
    far.
    """
    figure = new_figure(theme, 8.6, 4.8)
    axes = figure.subplots()
    for i, result in enumerate(study.results):
        seconds = result.measures.seconds
        _draw_runs(axes, theme, study, i, seconds, np.median(seconds, axis=0))
    dress(axes, theme, x="trajectories", y="learning time (s)")
    set_scale(axes, "y", "log")
    _at_counts(axes, study)
    title = "Learning time, without compilation"
    head(figure, theme, axes.get_legend_handles_labels()[0], title=title)
    foot(figure, theme, f"line: median; dots and bar: {_all_runs(study)}; online: all sessions so far")
    return figure


def _all_runs(study: SortingStudy) -> str:
    return (
        "the one replication"
        if study.replications == 1
        else f"all {counted(study.replications, 'replication')}"
    )


def _at_counts(axes: Axes, study: SortingStudy) -> None:
    ticks = sorted({int(n) for result in study.results for n in result.trajectories})
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{n}" for n in ticks])
    # A single number of trajectories is one place, however many methods stand side by side there.
    axes.set_xlim(ticks[0] / 1.5, ticks[-1] * 1.5)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
