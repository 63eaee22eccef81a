"""The sorting study told: tables, figures, and the report that ``i2rl run sorting`` writes."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..inference.mtirl import DEFAULT_RESTARTS
from . import sorting_figures as figures
from .report import Picture, Section, Table, write_report
from .sorting_study import BATCH, DPM, EM, EM_UNTOLD, FEW, METHODS, ONLINE, SortingStudy
from .sorting_table import (
    HEADINGS,
    behaviours,
    caption,
    cells,
    print_sorting_table,
    sorting_table_plot,
    sorting_table_summary,
)
from .style import save_themes

if TYPE_CHECKING:
    from rich.console import Console


def summary(study: SortingStudy) -> dict[str, Any]:
    """Settings and all measures as plain data."""
    return {
        "process": study.sorting.name,
        "tasks": study.tasks,
        "behaviours": list(study.sorting.behaviours[: study.tasks]),
        "ways started from": study.ways,
        "steps": study.steps,
        "runs": study.runs,
        "seed": study.seed,
        "EVD of the best single behaviour": study.one_way,
        "online over batch, seconds": study.online_share,
        "methods": [
            {
                "method": result.name,
                "trajectories": result.trajectories.tolist(),
                "EVD": result.measures.value_difference.tolist(),
                "ways": result.measures.ways.tolist(),
                "assignment accuracy": result.measures.accuracy.tolist(),
                "adjusted Rand index": result.measures.rand.tolist(),
                "seconds": result.measures.seconds.tolist(),
                "weights of the first run": result.found.weights.tolist(),
                "proportions of the first run": result.found.proportions.tolist(),
            }
            for result in study.results
        ],
        "table 7.2": sorting_table_summary(study.table),
    }


def _results_table(study: SortingStudy) -> Table:
    rows: list[tuple[str, ...]] = []
    for result in study.results:
        m = result.measures
        for t, n in enumerate(result.trajectories):
            evd = m.value_difference[:, t]
            rows.append((
                result.name if t == 0 else "", f"{n}",
                f"{evd.mean():.3g} ({evd.min():.3g}-{evd.max():.3g})",
                f"{evd.mean() / study.steps:.2g}",
                f"{np.median(m.ways[:, t]):g} ({(m.ways[:, t] == study.tasks).sum()} of {study.runs})",
                f"{100 * m.accuracy[:, t].mean():.1f}",
                f"{m.rand[:, t].mean():.3f}",
                f"{np.median(m.seconds[:, t]):.3g}",
            ))  # fmt: skip
    share = study.online_share
    online = (
        ""
        if share is None
        else f" All sessions online took {100 * share:.0f} % of the time of batch at the end of each."
    )
    return Table(
        ("method", "N", "EVD (all runs)", "a step", "ways (right in)", "accuracy, %", "Rand", "seconds"),
        rows,
        f"N: trajectories. EVD: mean of {_runs(study)}, in discounted reward a trajectory; the best "
        f"single behaviour for all has {study.one_way:.3g}. Ways: median number found. "
        "Rand: adjusted Rand index. "
        f"Seconds: median, without compilation; online: all sessions so far.{online}",
    )


def _title(study: SortingStudy) -> str:
    names = study.sorting.behaviours[: study.tasks]
    return f"Sorting onions in {study.tasks} ways: {', '.join(names[:-1])} and {names[-1]}"


def _runs(study: SortingStudy) -> str:
    return "one run" if study.runs == 1 else f"{study.runs} independent runs"


def _text(study: SortingStudy) -> str:
    sizes = ", ".join(map(str, study.counts))
    told = {
        METHODS[BATCH]: f"MME-MTIRL starts from {study.ways} ways and finds out how many there are.",
        METHODS[ONLINE]: "Online MME-MTIRL sees every trajectory in one session only and keeps none; it is "
        "judged on all trajectories so far, each assigned by what it knows now.",
        METHODS[DPM]: "DPM-BIRL may find as many ways as there are trajectories.",
        METHODS[EM]: f"EM-MLIRL is given the true number of ways and has {DEFAULT_RESTARTS} starts.",
        METHODS[EM_UNTOLD]: f"EM-MLIRL that is not told is given {study.ways}, and as many starts.",
    }
    methods = " ".join(told[result.name] for result in study.results)
    return f"""Sorters act optimally for one of {study.tasks} rewards; their trajectories of {study.steps} \
steps come in one jumble. Learned from: {sizes} trajectories, the same for every method, in {_runs(study)}. \
{methods} A way counts as found if it is the likeliest of some trajectory.

The value difference (EVD) compares greedy policies, so a reward that is wrong in many ways may lose exactly \
nothing. Not all mistakes cost the same: where there is no list, the best roller picks as the picker does, \
so taking a picker for a roller costs its first steps only.

{_scope(study)}"""


def _scope(study: SortingStudy) -> str:
    """What the numbers of trajectories leave open; empty if nothing."""
    told = []
    if tuple(study.counts) == FEW[study.tasks]:
        told.append(
            "These are few numbers of trajectories, since every method is compiled for each: --trajectories "
            "all --runs 10 is the dissertation's design."
        )
    if study.counts[0] < study.ways:
        told.append(
            f"From {study.counts[0]} trajectories no more than {study.counts[0]} of the {study.ways} ways "
            "started from can be found."
        )
    return " ".join(told)


def print_tables(study: SortingStudy, console: Console) -> None:
    """Print the results and Table 7.2."""
    from rich.table import Table as RichTable

    part = _results_table(study)
    table = RichTable(title=_title(study), caption=part.caption, caption_justify="left")
    for i, heading in enumerate(part.headings):
        table.add_column(heading, justify="left" if i == 0 else "right")
    for i, row in enumerate(part.rows):
        if i and row[0]:
            table.add_section()
        table.add_row(*map(str, row))
    console.print(table)
    if _scope(study):
        console.print(_scope(study), highlight=False)
    print_sorting_table(study.table, console)


def write(study: SortingStudy, folder: Path | str) -> Path:
    """Write the report: ``index.html``, the pictures in both themes, and ``results.json``."""
    folder = Path(folder)
    pictures = [
        Picture(*save_themes(draw, folder, name), told, description)
        for name, draw, told, description in (
            ("clusters", partial(figures.clusters_plot, study),
             "All trajectories of the first run by what they count: which way each was done, and which it "
             "was found to be.",
             "Scatter plots of trajectories' feature counts on two principal components, one a method"),
            ("ways", partial(figures.ways_diagram, study),
             "What a sorter does who follows each way that was found.",
             "State diagrams of each way found: where the onion is, what is thought of it, and what is done"),
            ("evd", partial(figures.evd_plot, study),
             "Value lost by acting as was learned (Figure 7.8).",
             "Expected value difference against trajectories for each method, with the spread over runs"),
            ("number", partial(figures.ways_found_plot, study),
             "How many ways were found.",
             "Number of ways found against trajectories, one panel a method, the true number marked"),
            ("time", partial(figures.time_plot, study),
             "Seconds of learning, compilation left out.",
             "Learning time against trajectories on logarithmic scales"),
            ("table", lambda theme: sorting_table_plot(study.table, theme=theme, title="Table 7.2"),
             "Table 7.2: what the learned ways do on simulated belts, beside the dissertation's belt.",
             "Precision and recall of every method for both behaviours"),
        )
    ]  # fmt: skip
    (folder / "results.json").write_text(json.dumps(summary(study), indent=2) + "\n")
    learned = Section(_title(study), _text(study), [_results_table(study)], pictures[:-1])
    sorted_ = Section(
        "Table 7.2",
        f"The weights that each method learned from all {study.counts[-1]} trajectories of the first run, "
        "each way matched with the behaviour it shares most trajectories with. A behaviour for which no "
        "way was left is carried out as the way that most of its trajectories were put in.",
        [
            Table(HEADINGS, cells(study.table, behaviour), f"{behaviour}. {caption(study.table)}")
            for behaviour in behaviours(study.table)
        ],
        pictures[-1:],
    )
    return write_report(folder, [learned, sorted_], title="Sorting onions")
