"""Table 7.2 side by side: precision and recall of learned sorting, simulated and as published.

Each learned policy runs on simulated belts (:mod:`i2rl.domains.sorting.line`) beside the experts.
Comparability of the numbers:

- The dissertation carried out each policy once, on 24 onions, on a robot. Seven of twelve blemished onions
  found is a recall of 58 % with a 95 % interval from 32 to 81 %: most differences between its rows are within
  chance. Here hundreds of belts are sorted and the interval is a few percent; both are shown.
- The line's times are calibrated to the dissertation's *expert* row, so that row agrees by construction; only
  the distances of learned rows from it are informative.
- A learned policy equal to the expert's gives the expert's numbers here, to the digit, since all rows sort
  the same belts. On the robot its row differed by chance.
- Every method sorts for the same time here. On the robot, online MME-MTIRL began earlier, since it had
  learned sooner; the dissertation puts its higher recall down to that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from ....domains.sorting.line import Line, Share, Tally, sort_belts, wilson
from ....domains.sorting.process import Sorting
from ....models.inputs.text import counted
from ...drawing.page import Table, print_tables
from ...drawing.style import LIGHT, TEXT, Theme, dress, foot, head, name_ticks, new_figure
from ...judging.metrics import greedy_policy, optimal_actions, policy_accuracy

if TYPE_CHECKING:
    from rich.console import Console

EXPERT = "expert"


class Counts(NamedTuple):
    """Onions of one belt as Table 7.2 counts them: blemished or good, in the bin or left on the table."""

    true_positives: int
    false_positives: int
    true_negatives: int
    false_negatives: int

    def precision(self, level: float = 0.95) -> Share:
        """Compute ``TP / (TP + FP)`` with Wilson's interval, onions taken as independent."""
        return wilson(self.true_positives, self.true_positives + self.false_positives, level)

    def recall(self, level: float = 0.95) -> Share:
        """Compute ``TP / (TP + FN)`` with Wilson's interval, onions taken as independent."""
        return wilson(self.true_positives, self.true_positives + self.false_negatives, level)


_PICKED, _ROLLED = "pick-inspect-place", "roll-pick-place"
# Table 7.2, one belt each. The method's name, then what each behaviour reached.
PUBLISHED: dict[str, dict[str, Counts]] = {
    EXPERT: {_PICKED: Counts(7, 0, 12, 5), _ROLLED: Counts(9, 4, 8, 3)},
    "MME-MTIRL": {_PICKED: Counts(7, 1, 11, 5), _ROLLED: Counts(9, 4, 8, 3)},
    "DPM-BIRL": {_PICKED: Counts(7, 3, 9, 5), _ROLLED: Counts(9, 4, 8, 3)},
    "EM-MLIRL": {_PICKED: Counts(6, 3, 9, 6), _ROLLED: Counts(6, 4, 8, 6)},
    "online MME-MTIRL": {_PICKED: Counts(8, 0, 12, 4), _ROLLED: Counts(10, 4, 8, 2)},
}


class SortingRow(NamedTuple):
    """One method and one behaviour.

    Fields
    ------
    method, behaviour : str
    tally : Tally
        Of the simulated belts.
    accuracy : float
        Share of states in which the policy does what that behaviour's expert does (LBA).
    choice_accuracy : float
        The same over states with a choice.
    published : Counts or None
        The dissertation's one belt.
    """

    method: str
    behaviour: str
    tally: Tally
    accuracy: float
    choice_accuracy: float
    published: Counts | None


class SortingTable(NamedTuple):
    """Rows by method, then behaviour, the experts first; all sort the same ``belts`` belts of ``line``."""

    rows: tuple[SortingRow, ...]
    belts: int
    line: Line
    level: float


def table_7_2(
    key: Array,
    sorting: Sorting,
    learned: Mapping[str, Float[np.ndarray, " B ..."]],
    *,
    belts: int = 1000,
    line: Line = Line(),  # noqa: B008 (immutable)
    level: float = 0.95,
) -> SortingTable:
    """Carry out the experts' and the learned policies on the same simulated belts.

    Parameters
    ----------
    key : random key
    sorting : Sorting
        The process that was learned on.
    learned : mapping from a method's name
        To the weights it learned for each behaviour, ``[B, K]``, carried out greedily, or to its policies
        ``[B, S, A]``; behaviours in the order of ``sorting.behaviours``, the same number for every method.
        A name of Table 7.2 (in any case) gets its published numbers.
    belts : int
        Number of simulated belts of ``line``.
    level : float
        Confidence of the intervals.

    Raises
    ------
    ValueError
        For arrays of another shape, methods of different numbers of behaviours, a method called "expert", a
        level outside (0, 1), and as :func:`sort_belts` and :func:`greedy_policy` do.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie in (0, 1), got {level}")
    given = {name: np.asarray(values, float) for name, values in learned.items()}
    n_behaviours = _checked(sorting, given)
    experts = np.stack([sorting.expert_policy(b) for b in range(n_behaviours)])
    optimal = [
        optimal_actions(sorting.mdp, jnp.asarray(weights)) for weights in sorting.weights[:n_behaviours]
    ]
    policies = {EXPERT: experts} | {name: _policies(sorting, values) for name, values in given.items()}
    published = {name.casefold(): counts for name, counts in PUBLISHED.items()}
    rows = []
    for method, by_behaviour in policies.items():
        for b, policy in enumerate(by_behaviour):
            behaviour = sorting.behaviours[b]
            overall, choice = policy_accuracy(sorting.mdp, optimal[b], jnp.asarray(policy))
            rows.append(
                SortingRow(
                    method,
                    behaviour,
                    sort_belts(key, sorting, policy, belts, line),
                    float(overall),
                    float(choice),
                    published.get(method.casefold(), {}).get(behaviour),
                )
            )
    return SortingTable(tuple(rows), belts, line, level)


def _checked(sorting: Sorting, given: Mapping[str, np.ndarray]) -> int:
    n, mdp = len(sorting.behaviours), sorting.mdp
    for name, values in given.items():
        if name.casefold() == EXPERT:
            raise ValueError("a learned method cannot be called 'expert': that row is the true weights'")
        shape = values.shape
        if shape[1:] not in ((mdp.n_features,), (mdp.n_states, mdp.n_actions)) or not 1 <= shape[0] <= n:
            raise ValueError(
                f"{name} must give weights [B, {mdp.n_features}] or policies "
                f"[B, {mdp.n_states}, {mdp.n_actions}] for 1 <= B <= {n} behaviours, got shape {shape}"
            )
    sizes = {name: len(values) for name, values in given.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"methods must give the same number of behaviours, got {sizes}")
    return next(iter(sizes.values()), min(n, 2))


def _policies(sorting: Sorting, values: np.ndarray) -> Float[np.ndarray, "B S A"]:
    if values.ndim == 3:
        return values
    return np.stack([np.asarray(greedy_policy(sorting.mdp, jnp.asarray(w))) for w in values])


# -- telling --------------------------------------------------------------------------------------------


def sorting_table_summary(table: SortingTable) -> dict[str, Any]:
    """Return the table as plain data for JSON: shares in [0, 1], ``None`` if no onion was binned."""
    return {
        "belts": table.belts,
        "line": table.line._asdict(),
        "level": table.level,
        "rows": [_plain(row, table.level) for row in table.rows],
    }


def _plain(row: SortingRow, level: float) -> dict[str, Any]:
    def share(estimate: Share) -> dict[str, Any]:
        value, low, high = (None if math.isnan(x) else x for x in estimate)
        return {"value": value, "interval": None if value is None else [low, high]}

    def side(counted: Tally | Counts, counts: tuple[float, ...]) -> dict[str, Any]:
        return {
            "TP, FP, TN, FN": list(counts),
            "precision": share(counted.precision(level)),
            "recall": share(counted.recall(level)),
        }

    return {
        "method": row.method,
        "behaviour": row.behaviour,
        "LBA": row.accuracy,
        "LBA choice states": None if math.isnan(row.choice_accuracy) else row.choice_accuracy,
        "simulated": side(row.tally, row.tally.means),
        "dissertation": None if row.published is None else side(row.published, row.published),
    }


HEADINGS = ("method", "belts", "TP, FP, TN, FN", "precision, %", "recall, %", "LBA, %")


def caption(table: SortingTable) -> str:
    """Write the meaning of the columns."""
    return (
        "TP, FP: blemished and good onions in the bin; TN, FN: good and blemished ones left on the table. "
        f"Simulated: means of {counted(table.belts, 'belt')}; dissertation: its one belt of 24 onions. In "
        f"brackets: {table.level:.0%} intervals, Wilson's for the latter. LBA: over states with a choice. "
        "The simulated line is calibrated to the dissertation's expert only."
    )


def behaviours(table: SortingTable) -> tuple[str, ...]:
    """List the behaviours of the table, in its order."""
    return tuple(dict.fromkeys(row.behaviour for row in table.rows))


def cells(table: SortingTable, behaviour: str) -> list[tuple[str, ...]]:
    """Format one behaviour as text, lines as :data:`HEADINGS`: simulated, then the dissertation's if any."""

    def percent(share: Share, digits: int) -> str:
        if math.isnan(share.value):
            return "-"
        low, high = (f"{100 * x:.{digits}f}" for x in share[1:])
        return f"{100 * share.value:.1f} ({low}-{high})"

    def measures(counted: Tally | Counts, digits: int) -> tuple[str, str]:
        precision, recall = counted.precision(table.level), counted.recall(table.level)
        return percent(precision, digits), percent(recall, digits)

    lines: list[tuple[str, ...]] = []
    for row in table.rows:
        if row.behaviour != behaviour:
            continue
        accuracy = "-" if math.isnan(row.choice_accuracy) else f"{100 * row.choice_accuracy:.0f}"
        means = ", ".join(f"{mean:.1f}" for mean in row.tally.means)
        lines.append((row.method, "simulated", means, *measures(row.tally, 1), accuracy))
        if row.published is not None:
            counts = ", ".join(map(str, row.published))
            lines.append(("", "dissertation", counts, *measures(row.published, 0), ""))
    return lines


def print_sorting_table(table: SortingTable, console: Console) -> None:
    """Print one table for each behaviour."""
    for behaviour in behaviours(table):
        shown = Table(HEADINGS, cells(table, behaviour), caption(table))
        print_tables([shown], console, f"{behaviour} (Table 7.2)")


def sorting_table_plot(table: SortingTable, *, theme: Theme = LIGHT, title: str = "") -> Figure:
    """Draw precision and recall of every method, a row of panels for each behaviour.

    Dots are ours; diamonds the dissertation's one belt. Bars are intervals, ours often hidden by the dot.
    """
    names = behaviours(table)
    methods = list(dict.fromkeys(row.method for row in table.rows))
    figure = new_figure(theme, 9.2, 1.5 + len(names) * (0.75 + 0.44 * len(methods)))
    panels = figure.subplots(len(names), 2, sharex=True, sharey=True, squeeze=False)
    figure.get_layout_engine().set(wspace=0.05, hspace=0.06)  # type: ignore[union-attr, call-arg]
    ours, theirs = theme.series[0], theme.series[1]
    for i, behaviour in enumerate(names):
        rows = [row for row in table.rows if row.behaviour == behaviour]
        for panel, measure in zip(panels[i], ("precision", "recall"), strict=True):
            for row in rows:
                middle = methods.index(row.method)
                y = middle if row.published is None else middle - 0.14
                here = getattr(row.tally, measure)(table.level)
                if math.isnan(here.value):
                    panel.annotate(
                        "no onion binned", (0.015, y), va="center", color=theme.muted, fontsize=TEXT - 1
                    )
                panel.hlines(y, here.low, here.high, color=ours, linewidth=2.4)
                panel.plot(here.value, y, "o", markersize=6.5, color=ours, clip_on=False)
                if row.published is not None:
                    value, low, high = getattr(row.published, measure)(table.level)
                    panel.hlines(middle + 0.16, low, high, color=theirs, linewidth=1.2)
                    panel.plot(
                        value,
                        middle + 0.16,
                        "D",
                        markersize=6,
                        markerfacecolor=theme.surface,
                        markeredgecolor=theirs,
                        markeredgewidth=1.4,
                        clip_on=False,
                    )
            dress(
                panel,
                theme,
                title=f"{behaviour}: {measure}",
                grid="x",
                x=_MEANING[measure] if i == len(names) - 1 else "",
            )
            panel.set_xlim(0, 1.02)
            panel.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        name_ticks(panels[i, 0], "y", range(len(methods)), methods, fontsize=TEXT)
        panels[i, 0].set_ylim(len(methods) - 0.4, -0.6)
        panels[i, 1].tick_params(left=False)
    handles = [
        Line2D([], [], color=ours, marker="o", markersize=6.5, linewidth=2.4, label="simulated belts"),
        Line2D(
            [],
            [],
            color=theirs,
            marker="D",
            markersize=6,
            markerfacecolor=theme.surface,
            linewidth=1.2,
            label="dissertation, one belt",
        ),
    ]
    head(figure, theme, handles, title=title)
    belts = f"simulated: {counted(table.belts, 'belt')}; dissertation: one belt, 24 onions"
    foot(figure, theme, f"bars: {table.level:.0%} intervals; {belts}")
    return figure


_MEANING = {
    "precision": "share of binned onions that are blemished",
    "recall": "share of blemished onions binned",
}
