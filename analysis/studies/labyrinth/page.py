"""Page of the labyrinth study: tables, figures and text."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....domains.labyrinth.process import SHARED_FEATURES
from ....models.inputs.text import counted
from ...drawing.estimates import Estimates
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.text import listed, number
from .study import BY_LEVEL, LEARNER, PLACES, UNIFORM, LabyrinthStudy, ViewStudy, bits_per_decision

if TYPE_CHECKING:
    from rich.console import Console


def summary(result: LabyrinthStudy) -> dict[str, Any]:
    """Return the study as plain numbers (for JSON): every method's scores, weights by feature, values by
    state.
    """
    mdp = result.maze.mdp
    views: dict[str, Any] = {}
    for view in result.views:
        first = view.predictions[0]
        outside = int(view.decisions_out_of_view.sum())
        methods = {
            p.method: {
                "bits_per_decision": bits_per_decision(p.bits, result.decisions)._asdict(),
                f"more_than_{LEARNER}": bits_per_decision(p.bits - first.bits, result.decisions)._asdict(),
                "bits_per_decision_out_of_view": float(p.bits_out_of_view.sum()) / outside
                if outside
                else None,
                "bits_per_decision_afterwards": p.afterwards,
                "parameters": p.parameters,
                "bits_of_each_bout": p.bits.tolist(),
            }
            for p in view.predictions
        }
        views[view.view] = {
            "decisions_out_of_view": outside,
            "methods": methods,
            "seconds_per_session": {
                "median": float(np.median(view.learned.seconds)),
                "first": float(view.learned.seconds[0]),
            },
            "weights": dict(zip(mdp.feature_names, view.learned.weights.tolist(), strict=True)),
            "intervals": None if (found := _estimates(result, view)) is None else found.summary(),
            "values": dict(zip(mdp.state_names, view.learned.values.tolist(), strict=True)),
        }
    told: dict[str, Any] = plain(
        {
            "provenance": study_provenance(0),
            "recording": result.recording,
            "bouts": len(result.decisions),
            "decisions": int(result.decisions.sum()),
            "decisions_of_each_bout": result.decisions.tolist(),
            "discount": float(mdp.discount),
            "ridge": result.ridge,
            "views": views,
        }
    )
    return told


def _estimates(result: LabyrinthStudy, view: ViewStudy) -> Estimates | None:
    """List all weights of a view with their errors; None if part of the maze was hidden."""
    if view.learned.errors is None:
        return None
    return Estimates(result.maze.mdp.feature_names, view.learned.weights, view.learned.errors)


def tables(result: LabyrinthStudy) -> list[Table]:
    """Tabulate each view, methods in order of their score, intervals 95 % over bouts."""
    made = []
    for view in result.views:
        outside = view.decisions_out_of_view.sum()
        first = view.predictions[0]
        rows: list[tuple[str | float, ...]] = []
        for p in sorted(view.predictions, key=lambda p: -p.bits.sum()):
            score = bits_per_decision(p.bits, result.decisions)
            delta = bits_per_decision(p.bits - first.bits, result.decisions)
            apart = p is not first
            rows.append(
                (
                    p.method,
                    f"{score.estimate:.3f} ({score.low:.3f} to {score.high:.3f})",
                    f"{delta.estimate:+.3f} ({delta.low:+.3f} to {delta.high:+.3f})" if apart else "-",
                    *([f"{p.bits_out_of_view.sum() / outside:.3f}"] if outside else []),
                    f"{p.afterwards:.3f}",
                    p.parameters,
                )
            )
        hidden = ["on hidden decisions"] if outside else []
        made.append(
            Table(
                (
                    "method",
                    "bits per decision",
                    f"more than {LEARNER}'s",
                    *hidden,
                    "once learned",
                    "parameters",
                ),
                rows,
                f"With the {view.view if outside else 'whole maze in view'}: bits per decision on bouts not "
                f"yet seen, and how many more than {LEARNER} needs, bout by bout (95 % intervals over "
                "bouts). Once learned: on the recording that was learned from. Parameters: free numbers.",
            )
        )
    return made


def print_tables(result: LabyrinthStudy, console: Console) -> None:
    """Print one table a view."""
    print_page_tables(tables(result), console, f"{result.recording}: {_size(result)}")


def _size(result: LabyrinthStudy) -> str:
    return f"{counted(len(result.decisions), 'bout')}, {counted(int(result.decisions.sum()), 'decision')}"


def _lead(result: LabyrinthStudy) -> Lead:
    view = result.views[0]
    first = view.predictions[0]
    others = {p.method: p for p in view.predictions[1:] if p.method != BY_LEVEL}
    best = min(others.values(), key=lambda p: p.bits.sum())
    mine = bits_per_decision(first.bits, result.decisions)
    uniform = bits_per_decision(others[UNIFORM].bits, result.decisions).estimate
    gain = bits_per_decision(others[UNIFORM].bits - first.bits, result.decisions)
    gap = bits_per_decision(best.bits - first.bits, result.decisions)
    learned = (
        f"From {_size(result)} of {result.recording}, {LEARNER} learned a reward that predicts each new bout "
        f"with {number(mine.estimate)} bits per decision ({number(mine.low)} to {number(mine.high)}), where "
        f"choosing at random takes {number(uniform)}."
    )
    told = f"({gap.low:+.3f} to {gap.high:+.3f} bits per decision, bout by bout)"
    if gain.low <= 0:
        trust = "Do not trust it: it does not predict better than choosing at random beyond chance."
    elif gap.high < 0:
        trust = (
            f"Trust it for what the animal prefers, not as the best predictor: the table {best.method} "
            f"predicts better {told}, so that habits are missing from this reward."
        )
    else:
        trust = (
            "Trust it as far as its intervals go, since no table of counts predicts better; the nearest is "
            f"{best.method} {told}."
        )
    estimates = _estimates(result, view)
    assert estimates is not None
    shared = len(SHARED_FEATURES)
    places = np.argsort(-np.abs(estimates.weights[shared:] / estimates.errors[shared:]))[:PLACES] + shared
    chosen = np.concatenate([np.arange(shared), places])
    shown = Estimates(
        [estimates.names[k] for k in chosen], estimates.weights[chosen], estimates.errors[chosen]
    )
    table = shown.table(
        f"Weights learned with the whole maze in view (nats a step): the {shared} that places share, and the "
        f"{counted(len(places), 'place')} farthest from zero in standard errors. Intervals are those of the "
        f"posterior's curvature under the prior of precision {number(result.ridge)}; "
        f"{len(estimates.determined)} of all {len(estimates.names)} leave zero out."
    )
    return Lead(learned, trust, [table])


def _text(result: LabyrinthStudy) -> str:
    views = [view.view for view in result.views]
    return f"""Each bout is predicted before it is learned from, so every test is on new \
data. The score is the code length of the animal's decisions, in bits; forced steps cost zero bits. \
Learned with: {listed(views)}.

{LEARNER} learns a weight for each place reached and one each for turning round and going deeper. \
{BY_LEVEL} has the latter for each level of the maze. The others count actions, from one on: over all steps \
or over choices alone, given how a junction was entered, given that and its level, or given the node and the \
entry (Markov). The discount is {number(float(result.maze.mdp.discount))}."""


def write(result: LabyrinthStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    from .figures import bits_by_bout, value_on_maze

    pictures = [
        drawn(
            folder,
            "bits",
            lambda theme: bits_by_bout(result, theme),
            "Running bits per decision, each bout predicted before it is learned from; lower is better.",
            "Bits per decision against bouts, a line a method",
        ),
        drawn(
            folder,
            "value",
            lambda theme: value_on_maze(result, theme),
            "Learned value of every place, entered from above: orange ones are worth less than zero, blue "
            "ones more. The maze is drawn as its environment draws it, home below.",
            "The maze with every corridor shaded by the learned value of the place it leads to",
        ),
    ]
    sections = [Section("Prediction", _text(result), tables(result), pictures)]
    return write_page(
        folder, f"What the mouse {result.recording} seeks", _lead(result), sections, summary(result)
    )
