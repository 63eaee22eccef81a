"""Page of the study of adversarial learners: tables beside the dissertation's, and figures.

:func:`write` takes a study's results, one
:class:`~i2rl.analysis.studies.adversarial.results.AdversarialResults` a domain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ....models.inputs.text import counted
from ....models.process.mdp import TabularMDP
from ...drawing.page import Lead, Picture, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import study_provenance
from ...drawing.text import listed
from ...judging.returns import Correlation, Recovery, empirical_ile, seed_interval
from ..noisy.examples import Strip
from . import figures
from .results import (
    CLEAN,
    LEARNED,
    NOISY,
    ROBUST,
    SSRR,
    AdversarialResults,
    MethodResult,
    store_results,
)

if TYPE_CHECKING:
    from rich.console import Console

EXPERT = "expert"

TABLE_7_3 = {
    "hopper": {EXPERT: 2810, CLEAN: 2130, NOISY: 702, ROBUST: 1810, SSRR: 2050},
    "walker2d": {EXPERT: 2700, CLEAN: 2204, NOISY: 848, ROBUST: 1390, SSRR: 1932},
    "half-cheetah": {EXPERT: 2507, CLEAN: 2251, NOISY: 750, ROBUST: 1662, SSRR: 1555},
}
"""Averaged episode return."""
TABLE_7_4 = {
    "hopper": {CLEAN: 0.95, NOISY: 0.87, ROBUST: 0.96, SSRR: 0.81},
    "walker2d": {CLEAN: 0.94, NOISY: 0.85, ROBUST: 0.93, SSRR: 0.90},
    "half-cheetah": {CLEAN: 0.96, NOISY: 0.86, ROBUST: 0.94, SSRR: 0.87},
}
"""Pearson's correlation of learned and true rewards."""
TABLE_7_5 = {CLEAN: (0.907, 0.726, 0.199), NOISY: (0.889, 0.625, 0.297), ROBUST: (0.843, 0.637, 0.243)}
"""``V_demo``, ``V_gen`` and empirical ILE, on data of 64 dimensions that were never released."""
LBA_LOST = {"patrol": 0.20, "mountain-car": 0.22}
"""Relative drop of LBA by noise (section 7.4.3)."""
BREACHES = {NOISY: (0.45, 0.53), ROBUST: (0.59, 0.66)}
"""Success of breaches of the patrol (section 7.4.3)."""

_NONE = "-"


# -- tables -------------------------------------------------------------------------------------------


def learning_table(results: AdversarialResults) -> Table:
    """Tabulate LBA and return after the last sessions, beside Table 7.3 where it has the domain."""
    printed = TABLE_7_3.get(results.domain)
    measures = [m for m in ("accuracy", "returns") if any(_has(r, m) for r in results.methods.values())]
    heads = {"accuracy": "LBA, %", "returns": "return"}
    headings = ["method", "replications", *(heads[m] for m in measures)] + ["dissertation"] * (
        printed is not None
    )
    rows: list[list[str]] = []
    if results.expert_return is not None and "returns" in measures:
        cells = {"accuracy": "100", "returns": f"{results.expert_return:,.{_digits(results.expert_return)}f}"}
        rows.append([EXPERT, _NONE, *(cells[m] for m in measures)])
    for name in results.methods:
        late = {m: results.late(name, m) for m in measures}
        replications = max((len(x) for x in late.values() if x is not None), default=0)
        rows.append([name, f"{replications}", *(_late(late[m], m) for m in measures)])
    if printed is not None:
        for row in rows:
            row.append(f"{printed[row[0]]:,}" if row[0] in printed else _NONE)
    sessions = max((len(r.pairs) for r in results.methods.values()), default=0)
    kept = max(sessions // 4, 1)
    fewer = [name for name, r in results.methods.items() if len(r.pairs) < sessions]
    return Table(
        headings,
        rows,
        f"Mean of the last {kept} of {counted(sessions, 'session')} (95 % interval over replications)."
        + "".join(
            f" {name} learned from as much in {counted(len(results.methods[name].pairs), 'session')}."
            for name in fewer
        )
        + (f" LBA over {results.accuracy_over}." if "accuracy" in measures else "")
        + (" The dissertation's returns are of Table 7.3." if printed is not None else ""),
    )


def recovery_table(results: AdversarialResults) -> Table:
    """Tabulate the loss to noise and its recovery, as the dissertation computes both."""
    measure = figures.MEASURED[results.measure]
    clean, noisy = (results.late(name, results.measure) for name in (CLEAN, NOISY))
    rows: list[tuple[str, str, str]] = []
    if clean is not None and noisy is not None:
        printed = LBA_LOST.get(results.domain)
        if results.domain in TABLE_7_3:
            table = TABLE_7_3[results.domain]
            printed = 1 - table[NOISY] / table[CLEAN]
        lost = f"{round(1 - noisy.mean() / clean.mean(), 2) + 0.0:.0%}"  # no bound below zero
        rows.append((f"{measure} lost to noise", lost, _NONE if printed is None else f"{printed:.0%}"))
        robust = results.late(ROBUST, results.measure)
        if robust is not None:
            rows.append((f"{ROBUST}, of {CLEAN}", f"{robust.mean() / clean.mean():.1%}", _NONE))
    for name in (ROBUST, SSRR, LEARNED):
        found = results.recovery(name)
        if found is not None:
            share = _printed_recovery(results.domain, name)
            printed_cell = _NONE if share is None else f"{share:.0%}"
            rows.append((f"of that recovered by {name}", _recovered(found), printed_cell))
    return Table(
        ("", "measured", "dissertation"),
        rows,
        f"Lost: (clean - noisy) / clean of mean {measure}. Recovered: (robust - noisy) / (clean - noisy), "
        "with a 95 % interval by a bootstrap over replications, too narrow for few replications.",
    )


def correlation_table(results: AdversarialResults) -> Table:
    """Tabulate correlations of learned and true rewards, beside Table 7.4; the file has all intervals."""
    printed = TABLE_7_4.get(results.domain, {})
    rows = []
    for name, result in results.methods.items():
        if not result.correlations:
            continue
        cells = [name, f"{len(result.correlations)}"]
        for over in ("steps", "trajectories"):
            found = [getattr(c, over) for c in result.correlations]
            cells += [f"{sum(c.n for c in found):,}", *_correlated(found)]
        rows.append((*cells, f"{printed[name]:.2f}" if name in printed else _NONE))
    return Table(
        (
            "method",
            "replications",
            "steps",
            "Pearson",
            "Spearman",
            "trajectories",
            "Pearson",
            "Spearman",
            "dissertation",
        ),
        rows,
        "Learned against true reward on held-out episodes of a mix of policies, from the expert's to a "
        "uniform one; trajectories by their sums, over equally long episodes unless the task itself ends "
        "them. Mean over replications and Student's 95 % interval (of one replication: a bootstrap of "
        "trajectories with "
        "replacement); none where a reward is the same in all steps. The dissertation's (Table 7.4, Pearson) "
        "come with p-values that fit 4 to 7 points each.",
    )


def ile_table(results: AdversarialResults) -> Table:
    """Tabulate empirical ILE in both forms; that of the onion task beside Table 7.5."""
    published = TABLE_7_5 if results.domain == "onion" else {}
    rows = []
    for name, result in results.methods.items():
        if result.errors:
            columns = np.array([tuple(e) for e in result.errors]).T
            ours = [_with_interval(column, 1, 3) for column in columns]
            rows.append((name, *ours))
        if name in published:
            demonstrated, generated, _ = published[name]
            theirs = empirical_ile(demonstrated, generated)
            rows.append((f"{name}: dissertation", *(f"{x:.3f}" for x in theirs)))
    return Table(
        ("method", "V_demo", "V_gen", "(V_demo - V_gen) / V_demo", "(V_gen - V_demo) / V_gen"),
        rows,
        "Learned rewards through a sigmoid, means a step; the second form is the equation as printed."
        + (
            " The first form reproduces Table 7.5's last column. Table 7.5 is of data of 64 dimensions that "
            "were never released: its rows and ours are of different tasks and cannot be compared in size."
            if published
            else ""
        ),
    )


def breach_table(results: AdversarialResults) -> Table:
    """Tabulate successes of breaches of the patrol."""
    rows = []
    if results.expert_breaches is not None:
        rows.append((EXPERT, _NONE, f"{100 * results.expert_breaches:.1f}", _NONE))
    for name, result in results.methods.items():
        if result.breaches is not None:
            printed = BREACHES.get(name)
            told = _NONE if printed is None else f"{100 * printed[0]:.0f} to {100 * printed[1]:.0f}"
            rows.append((name, f"{len(result.breaches)}", _percent_with_interval(result.breaches), told))
    return Table(
        ("method", "replications", "breaches that succeed, %", "dissertation"),
        rows,
        "With what was learned in the last session, or the expert's own policy, for all patrollers; 95 % "
        "interval over replications.",
    )


def pace_table(results: AdversarialResults) -> Table:
    """Tabulate seconds a session."""
    rows = [(n, f"{r.seconds:.2f}") for n, r in results.methods.items() if r.seconds is not None]
    return Table(("method", "seconds a session"), rows, f"Median once compiled, on {results.machine}.")


def _has(result: MethodResult, measure: str) -> bool:
    return getattr(result, measure) is not None


def _late(replications: Float[np.ndarray, " replications"] | None, measure: str) -> str:
    if replications is None:
        return _NONE
    return (
        _percent_with_interval(replications)
        if measure == "accuracy"
        else _with_interval(replications, 1, _digits(replications))
    )


def _digits(returns: Any) -> int:
    """Choose the digits of a return: a robot's returns are thousands, those of sorting a few."""
    return 0 if np.abs(returns).max() >= 100 else 2


def _percent_with_interval(shares: Float[np.ndarray, " replications"]) -> str:
    """Format Student's interval of a few replications, cut at the ends of the scale."""
    return _with_interval(shares, 100, within=(0, 100))


def _with_interval(
    replications: Float[np.ndarray, " replications"],
    scale: float = 1.0,
    digits: int = 1,
    within: tuple[float, float] = (-math.inf, math.inf),
) -> str:
    band = seed_interval(scale * np.asarray(replications, float))
    if np.isnan(band.mean):
        return _NONE
    if np.isnan(band.low):
        return f"{band.mean:,.{digits}f}"
    low, high = np.clip([band.low, band.high], *within)
    return f"{band.mean:,.{digits}f} ({low:,.{digits}f} to {high:,.{digits}f})"


def _correlated(found: Sequence[Correlation]) -> tuple[str, str]:
    if np.isnan([c.pearson for c in found]).any():
        return _NONE, _NONE
    if len(found) > 1:
        of_values, of_ranks = (
            _with_interval(np.array([getattr(c, of) for c in found]), 1, 2, (-1, 1))
            for of in ("pearson", "spearman")
        )
        return of_values, of_ranks
    one = found[0]
    pairs = ((one.pearson, one.bootstrap), (one.spearman, one.spearman_bootstrap))
    of_values, of_ranks = (
        f"{r:.2f}"
        if np.isnan([ends.low, ends.high]).any()
        else f"{r:.2f} ({ends.low:.2f} to {ends.high:.2f})"
        for r, ends in pairs
    )
    return of_values, of_ranks


def _recovered(found: Recovery) -> str:
    if found.lost < 1 and not (math.isfinite(found.low) and math.isfinite(found.high)):
        told = "not known" if found.lost < 0.5 else f"{found.share:.0%}, interval not known"
        return f"{told}: noise had a cost in {found.lost:.0%} of resamples only"
    if found.n == 1:
        return f"{found.share:.0%} (one replication, no interval)"
    return f"{found.share:.0%} ({found.low:.0%} to {found.high:.0%})"


def _printed_recovery(domain: str, method: str) -> float | None:
    table = TABLE_7_3.get(domain)
    if table is None or method not in table:
        return None
    return (table[method] - table[NOISY]) / (table[CLEAN] - table[NOISY])


def _tables(results: AdversarialResults) -> dict[str, Table]:
    """Return the tables with rows, by their subject."""
    made = {
        "learning": learning_table(results),
        "recovery": recovery_table(results),
        "rewards": correlation_table(results),
        "breaches": breach_table(results),
    }
    if any(r.errors for r in results.methods.values()):
        made["errors"] = ile_table(results)
    made["pace"] = pace_table(results)
    return {name: table for name, table in made.items() if table.rows}


def print_tables(results: AdversarialResults, console: Console) -> None:
    """Print all tables."""
    print_page_tables(list(_tables(results).values()), console, f"{results.title}: {results.noise}")


# -- plain data ---------------------------------------------------------------------------------------


def summary(results: AdversarialResults) -> dict[str, Any]:
    """Return settings and all measures as plain data, one entry a replication."""
    return {
        "domain": results.domain,
        "noise": results.noise,
        "replications": results.replications,
        "machine": results.machine,
        "settings": dict(results.settings),
        "accuracy over": results.accuracy_over,
        "expert return": _number(results.expert_return),
        "expert breaches": _number(results.expert_breaches),
        "methods": [_described(name, result) for name, result in results.methods.items()],
        "recovered": {
            name: {field: _number(x) for field, x in found._asdict().items()}
            for name in (ROBUST, SSRR, LEARNED)
            if (found := results.recovery(name)) is not None
        },
    }


def _described(name: str, result: MethodResult) -> dict[str, Any]:
    return {
        "method": name,
        "pairs": np.asarray(result.pairs).tolist(),
        "accuracy": _numbers(result.accuracy),
        "returns": _numbers(result.returns),
        "breaches": _numbers(result.breaches),
        "seconds a session": _number(result.seconds),
        "correlations": [
            {over: _correlation(getattr(found, over)) for over in ("steps", "trajectories")}
            for found in result.correlations
        ],
        "empirical ILE": [
            {field: _number(x) for field, x in found._asdict().items()} for found in result.errors
        ],
    }


def _correlation(found: Correlation) -> dict[str, Any]:
    ends = ("fisher", "bootstrap", "spearman_bootstrap")
    return {
        "n": found.n,
        "pearson": _number(found.pearson),
        "spearman": _number(found.spearman),
        **{name.replace("_", " "): [_number(x) for x in getattr(found, name)] for name in ends},
    }


def _number(x: float | None) -> float | None:
    return None if x is None or not math.isfinite(x) else float(x)


def _numbers(array: np.ndarray | None) -> Any:
    if array is None:
        return None
    return [_numbers(row) if np.ndim(row) else _number(float(row)) for row in np.asarray(array)]


# -- the page -----------------------------------------------------------------------------------------

_MOUNTAIN_CAR = ((-1.2, -0.07), (0.6, 0.07))


def write(
    studies: AdversarialResults | Iterable[AdversarialResults],
    folder: Path | str,
    strips: Sequence[tuple[Strip, TabularMDP]] = (),
) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, ``results.json``, and raw results.

    ``results.json`` is what :func:`summary` says of each domain; ``DOMAIN.results.json`` is read by
    :func:`~i2rl.analysis.studies.adversarial.results.load_results`. ``strips`` are trajectories of tabular
    tasks, with the posterior over their pairs.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    all_results = [studies] if isinstance(studies, AdversarialResults) else list(studies)
    sections = [section for results in all_results for section in _sections(results, folder)]
    if any(results.recovery() is not None for results in all_results):
        sections.insert(0, _recovery_section(all_results, folder))
    for i, (strip, mdp) in enumerate(strips):
        sections.append(_strip_section(strip, mdp, folder, i))
    for results in all_results:
        store_results(results, folder / f"{results.domain}.results.json")
    told = {
        "provenance": study_provenance(int(all_results[0].settings.get("seed", 0))),
        "domains": [summary(results) for results in all_results],
    }
    title = "Learning through noisy perception, without features"
    return write_page(folder, title, _lead(all_results), sections, told)


def _lead(all_results: Sequence[AdversarialResults]) -> Lead:
    learned, trust = [], []
    for results in all_results:
        measure, name = figures.MEASURED[results.measure], results.title
        late = {
            m: x.mean() for m in (CLEAN, NOISY, ROBUST) if (x := results.late(m, results.measure)) is not None
        }
        shown = [
            f"{100 * x:.0f} % ({m})" if results.measure == "accuracy" else f"{x:,.{_digits(x)}f} ({m})"
            for m, x in late.items()
        ]
        learned.append(f"in {name} a{'n' * (measure == 'LBA')} {measure} of {listed(shown)}")
        found = results.recovery()
        if found is not None:
            known = found.lost == 1 and math.isfinite(found.share)
            trust.append(
                f"in {name} {_recovered(found)} of the loss to noise is recovered"
                if known
                else f"in {name} these replications do not show that noise cost anything"
            )
    replications = min(results.replications for results in all_results)
    few = f"Trust no difference as long as there is {counted(replications, 'replication')} only"
    if replications > 1:
        few = f"Trust differences beyond the spread of {counted(replications, 'replication')}"
    return Lead(
        "Rewards were learned as networks, so there are no weights to list; after the last sessions they "
        f"reach {'; '.join(learned)}.",
        f"{'; '.join([few, *trust])}.",
        [learning_table(results) for results in all_results],
    )


def _recovery_section(all_results: Sequence[AdversarialResults], folder: Path) -> Section:
    told = "Share of AIRL's loss to noise that a learner with a noise model recovers."
    picture = drawn(folder, "recovery", partial(figures.recovery_plot, all_results), told, told)
    return Section("What robustness recovers", "", [], [picture])


def _strip_section(strip: Strip, mdp: TabularMDP, folder: Path, i: int) -> Section:
    from ..noisy.figures import strip_plot

    picture = drawn(
        folder,
        f"strip-{i}",
        partial(strip_plot, strip, mdp),
        "A new trajectory with a wrong observation, completed by the last robust-AIRL of the first "
        "replication.",
        "Grid of pairs against steps shaded by posterior probability, with what was seen and what happened",
    )
    return Section("What one learner believes of a trajectory", "", [], [picture])


_NOTES = {
    "onion": "Table 7.5's data of 64 dimensions were never released. This is the smaller task of 29 "
    "dimensions for which the authors released recordings, or a synthetic mover in their place.",
    "patrol": "Networks alone are carried from session to session, as in the dissertation; the statistic of "
    "earlier sessions that these learners keep by default is off. SSRR is left out: the dissertation applies "
    "it to robots alone.",
}


def _text(results: AdversarialResults) -> str:
    told = (
        f"The expert's states and actions are observed with noise: {results.noise}. "
        f"{counted(results.replications, 'independent replication')}; "
        "all methods of a replication see the same demonstrations "
        "and have equal budgets."
    )
    return "\n\n".join([told, *([_NOTES[results.domain]] if results.domain in _NOTES else [])])


def _sections(results: AdversarialResults, folder: Path) -> list[Section]:
    tables = _tables(results)

    def picture(name: str, draw: Any, told: str, description: str) -> Picture:
        return drawn(folder, f"{results.domain}-{name}", draw, told, description)

    learning = picture(
        "learning",
        partial(figures.learning_plot, results),
        "Learning against the pairs seen (Figures 7.11 to 7.13). Axes need not begin at zero.",
        "Learned behaviour accuracy or return against observed pairs, a line a method",
    )
    first = [tables[name] for name in ("recovery", "breaches", "errors") if name in tables]
    sections = [Section(results.title, _text(results), first, [learning])]
    if results.cells:
        cells = picture(
            "cells",
            partial(figures.cells_plot, results.cells, *_MOUNTAIN_CAR),
            "LBA in each cell of the space of states, mean over replications; many cells are never visited.",
            "Maps of position and velocity shaded by the share of actions equal to the expert's",
        )
        sections.append(Section(f"{results.title}: where", "", [], [cells]))
    if "rewards" in tables or results.scatters:
        pictures = []
        if results.scatters:
            title = f"Learned and true rewards, {results.title}"
            scatter = picture(
                "rewards",
                partial(figures.scatter_plot, results.scatters, title=title),
                "Learned against true rewards of the first replication. A learned reward has its own scale.",
                "Learned reward against true reward, a panel a method",
            )
            pictures.append(scatter)
        rewards = [tables["rewards"]] if "rewards" in tables else []
        sections.append(Section(f"{results.title}: rewards", "", rewards, pictures))
    if results.belief is not None:
        belief = picture(
            "belief",
            partial(figures.belief_plot, results.belief),
            "A noisy trajectory completed by the last robust-AIRL of the first replication.",
            "Observations, truth and posterior band of a trajectory's components against time",
        )
        sections.append(Section(f"{results.title}: what is believed of the truth", "", [], [belief]))
    if results.frames:
        frames = picture(
            "frames",
            partial(figures.frames_plot, results.frames),
            "Moments of an episode of the expert and of what was learned, from the same kind of start.",
            "Rows of silhouettes of the robot at even times",
        )
        sections.append(Section(f"{results.title}: motion", "", [], [frames]))
    if "pace" in tables:
        sections.append(Section(f"{results.title}: time", "", [tables["pace"]]))
    return sections
