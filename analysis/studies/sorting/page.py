"""Page of the sorting study, which ``i2rl run sorting`` writes: tables and figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from ....inference.learners.mtirl import DEFAULT_RESTARTS
from ....models.inputs.text import counted
from ....models.observation.demonstration import SEEN
from ...drawing.estimates import Estimates, laplace_errors
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.text import listed, number
from ...judging.multi_task import match_components
from ...posteriors.information import complete_information
from . import figures
from .study import BATCH, DPM, EM, EM_UNKNOWN, FEW, METHODS, ONLINE, SortingStudy
from .table import (
    HEADINGS,
    behaviours,
    caption,
    cells,
    print_sorting_table,
    sorting_table_plot,
    sorting_table_summary,
)

# As in the posteriors of one reward.
PRIOR_SCALE = 2.5

if TYPE_CHECKING:
    from rich.console import Console


def summary(study: SortingStudy) -> dict[str, Any]:
    """Return settings and all measures as plain data."""
    told: dict[str, Any] = plain(
        {
            "provenance": study_provenance(study.seed),
            "process": study.sorting.name,
            "tasks": study.tasks,
            "behaviours": list(study.sorting.behaviours[: study.tasks]),
            "n_components": study.n_components,
            "steps": study.steps,
            "replications": study.replications,
            "seed": study.seed,
            "EVD of the best single behaviour": study.one_component,
            "online over batch, seconds": study.online_share,
            "methods": [
                {
                    "method": result.name,
                    "trajectories": result.trajectories.tolist(),
                    "EVD": result.measures.value_difference.tolist(),
                    "components": result.measures.n_components.tolist(),
                    "assignment accuracy": result.measures.accuracy.tolist(),
                    "adjusted Rand index": result.measures.rand.tolist(),
                    "seconds": result.measures.seconds.tolist(),
                    "weights of the first replication": result.found.weights.tolist(),
                    "proportions of the first replication": result.found.proportions.tolist(),
                }
                for result in study.results
            ],
            "components of the first replication": [
                {"component": component, "weights": found.summary()}
                for component, found in _estimates(study).items()
            ],
            "table 7.2": sorting_table_summary(study.table),
        }
    )
    return told


def _estimates(study: SortingStudy) -> dict[str, Estimates]:
    """Return the weights of every component of the first method in the first replication, named after its
    behaviour.

    Errors of maximum-entropy methods are those of the posterior's curvature under a normal prior of scale
    :data:`PRIOR_SCALE`, given who did what: experts who never err leave most directions to the prior. Other
    likelihoods have another curvature, and their weights no errors here.
    """
    result, mdp = study.results[0], study.sorting.mdp
    demonstration = study.demonstration
    behaviour_of = {
        component: b for b, component in match_components(study.labels, result.found.assignments).items()
    }
    seen = demonstration.kind == SEEN
    found: dict[str, Estimates] = {}
    for component in np.unique(result.found.assignments).tolist():
        weights = np.asarray(result.found.weights[component])
        errors = np.full(len(weights), np.inf)
        if result.name in (METHODS[BATCH], METHODS[ONLINE]):
            share = np.broadcast_to(result.found.responsibilities[:, component, None], seen.shape)
            visits = np.bincount(demonstration.state[seen], share[seen], mdp.n_states)
            information = complete_information(mdp, jnp.asarray(weights), jnp.asarray(visits))
            errors = laplace_errors(np.asarray(information) + np.eye(len(weights)) / PRIOR_SCALE**2)
        name = (
            study.sorting.behaviours[behaviour_of[component]]
            if component in behaviour_of
            else "like no behaviour"
        )
        found[f"component {len(found) + 1}, {name}"] = Estimates(mdp.feature_names, weights, errors)
    return found


def _results_table(study: SortingStudy) -> Table:
    rows: list[tuple[str, ...]] = []
    for result in study.results:
        m = result.measures
        for t, n in enumerate(result.trajectories):
            evd = m.value_difference[:, t]
            rows.append(
                (
                    result.name if t == 0 else "",
                    f"{n}",
                    f"{number(evd.mean())} ({number(evd.min())} to {number(evd.max())})",
                    number(evd.mean() / study.steps, 2),
                    f"{np.median(m.n_components[:, t]):g} "
                    f"({(m.n_components[:, t] == study.tasks).sum()} of {study.replications})",
                    f"{100 * m.accuracy[:, t].mean():.1f}",
                    f"{m.rand[:, t].mean():.3f}",
                    number(np.median(m.seconds[:, t])),
                )
            )
    share = study.online_share
    online = (
        ""
        if share is None
        else f" All sessions online took {100 * share:.0f} % of the time of batch at the end of each."
    )
    return Table(
        (
            "method",
            "N",
            "EVD (all replications)",
            "a step",
            "components (right in)",
            "accuracy, %",
            "Rand",
            "seconds",
        ),
        rows,
        f"N: trajectories. EVD: mean of {_runs(study)}, in discounted reward a trajectory; the best "
        f"single behaviour for all has {number(study.one_component)}. Components: median number found. "
        "Rand: adjusted Rand index. "
        f"Seconds: median, without compilation; online: all sessions so far.{online}",
    )


def _title(study: SortingStudy) -> str:
    names = study.sorting.behaviours[: study.tasks]
    return f"Onion sorting with {study.tasks} behaviours: {listed(names)}"


def _runs(study: SortingStudy) -> str:
    return (
        "one replication"
        if study.replications == 1
        else counted(study.replications, "independent replication")
    )


def _text(study: SortingStudy) -> str:
    sizes = ", ".join(map(str, study.counts))
    told = {
        METHODS[BATCH]: f"MME-MTIRL starts with {study.n_components} components and finds their number.",
        METHODS[ONLINE]: "Online MME-MTIRL sees every trajectory in one session only and stores none; it is "
        "judged on all trajectories so far, each assigned by its current state.",
        METHODS[DPM]: "DPM-BIRL may find as many components as there are trajectories.",
        METHODS[EM]: f"EM-MLIRL is given the true number of components and has {DEFAULT_RESTARTS} starts.",
        METHODS[EM_UNKNOWN]: f"EM-MLIRL without it is given {study.n_components}, and as many starts.",
    }
    methods = " ".join(told[result.name] for result in study.results)
    return f"""Sorters act optimally for one of {study.tasks} rewards; their trajectories of {study.steps} \
steps are mixed. Learned from: {sizes} trajectories, the same for every method, in {_runs(study)}. \
{methods} A component counts as found if it is the likeliest of some trajectory.

EVD compares greedy policies, so a reward with many errors may lose exactly \
zero. Errors differ in cost: without a list, the best roller picks as the picker does, \
so taking a picker for a roller costs its first steps only.

{_scope(study)}"""


def _scope(study: SortingStudy) -> str:
    """Write what the numbers of trajectories leave open; empty if they cover everything."""
    told = []
    if tuple(study.counts) == FEW[study.tasks]:
        told.append(
            "These are few numbers of trajectories, since every method is compiled for each; the "
            "dissertation's design is `--trajectories all --replications 10`."
        )
    if study.counts[0] < study.n_components:
        told.append(
            f"From {counted(int(study.counts[0]), 'trajectory')} no more than {study.counts[0]} of the "
            f"{study.n_components} components can be found."
        )
    return " ".join(told)


def _sorting_tables(study: SortingStudy) -> list[Table]:
    """Tabulate Table 7.2, a table a behaviour."""
    return [
        Table(HEADINGS, cells(study.table, behaviour), f"Table 7.2, {behaviour}. {caption(study.table)}")
        for behaviour in behaviours(study.table)
    ]


def print_tables(study: SortingStudy, console: Console) -> None:
    """Print the results and Table 7.2."""
    print_page_tables([_results_table(study)], console, f"{_title(study)}. {_scope(study)}")
    print_sorting_table(study.table, console)


def _lead(study: SortingStudy) -> Lead:
    result = study.results[0]
    m, n = result.measures, int(result.trajectories[-1])
    right, lost = int((m.n_components[:, -1] == study.tasks).sum()), float(m.value_difference[:, -1].mean())
    found = f"{float(np.median(m.n_components[:, -1])):g}"
    learned = (
        f"From {counted(n, 'trajectory')}, mixed, {result.name} learned {found} components, where "
        f"{study.tasks} were demonstrated, assigned {number(100 * float(m.accuracy[:, -1].mean()))} % of the "
        f"trajectories correctly, and loses {number(lost)} of the value, where one component for all "
        f"loses {number(study.one_component)}."
    )
    known = right == study.replications and lost < 0.1 * study.one_component
    spread = (
        "one replication shows no spread"
        if study.replications == 1
        else f"so it was in {right} of {study.replications} replications"
    )
    trust = (
        f"Trust the components and their behaviour ({spread}); the weights of optimal experts have no "
        f"scale of "
        "their own, so trust their signs where an interval leaves zero out."
        if known
        else "Do not trust it as it is: the true number was found in "
        f"{right} of {counted(study.replications, 'replication')}, and more trajectories may be needed."
    )
    tables = [
        estimates.table(
            f"Weights of {component}, of {result.name} in the first replication. "
            + (
                "Intervals are those of the posterior's curvature under a normal prior of scale "
                f"{PRIOR_SCALE}, given the assignments; one of plus and minus "
                f"{number(1.96 * PRIOR_SCALE, 2)} "
                "adds nothing to the prior."
                if np.isfinite(estimates.errors).any()
                else "No intervals are computed for its likelihood."
            )
        )
        for component, estimates in _estimates(study).items()
    ]
    return Lead(learned, trust, tables)


def write(study: SortingStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    pictures = [
        drawn(folder, name, draw, told, description)
        for name, draw, told, description in (
            (
                "clusters",
                partial(figures.clusters_plot, study),
                "All trajectories of the first replication by their features: the true component of "
                "each and the "
                "assigned one.",
                "Scatter plots of trajectories' feature counts on two principal components, one a method",
            ),
            (
                "components",
                partial(figures.components_diagram, study),
                "Behaviour of a sorter under each component found.",
                "State diagram of each component: the onion's place, the prediction, and the action",
            ),
            (
                "evd",
                partial(figures.evd_plot, study),
                "Value lost by the learned behaviour (Figure 7.8).",
                "Expected value difference of each method against trajectories, and its spread",
            ),
            (
                "number",
                partial(figures.components_plot, study),
                "Number of components found.",
                "Number of components found against trajectories, one panel a method, the true number marked",
            ),
            (
                "time",
                partial(figures.time_plot, study),
                "Seconds of learning, compilation left out.",
                "Learning time against trajectories on logarithmic scales",
            ),
            (
                "table",
                lambda theme: sorting_table_plot(study.table, theme=theme, title="Table 7.2"),
                "Table 7.2: the learned components on simulated belts, beside the dissertation's belt.",
                "Precision and recall of every method for both behaviours",
            ),
        )
    ]
    learned = Section("Components of the mixture", _text(study), [_results_table(study)], pictures[:-1])
    sorted_ = Section(
        "Learned sorting",
        f"The weights that each method learned from all {counted(int(study.counts[-1]), 'trajectory')} of "
        "the first replication, each component matched with the behaviour it shares most "
        "trajectories with. A behaviour "
        "without a component is executed as the component of most of its trajectories.",
        _sorting_tables(study),
        pictures[-1:],
    )
    return write_page(folder, _title(study), _lead(study), [learned, sorted_], summary(study))
