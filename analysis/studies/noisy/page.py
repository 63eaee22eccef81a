"""Page of the study of noisy perception, which ``i2rl run noisy-...`` writes: tables and figures."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ....models.inputs.text import counted
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.style import Theme
from ...drawing.text import number
from ...judging.metrics import quantile_band
from ..sorting.table import SortingTable, caption, sorting_table_plot, sorting_table_summary
from . import figures
from .examples import HEADINGS, belt_cells
from .study import (
    AVERAGED,
    BARE,
    BOTH,
    CLEAR,
    EARLY,
    FAIR,
    HIDDEN,
    HIDDEN_STEPS,
    OBSERVABILITY,
    PLAIN,
    STATES,
    STEPS,
    STEPWISE,
    TRAJECTORIES,
    NoisyStudy,
    mean_interval,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

LATE = 20
# At most this share of the constant one half's divergence, early and in the end.
TARGETS = {PLAIN: (1 / 6, 1 / 12), AVERAGED: (1 / 12, 1 / 24), STEPWISE: (1 / 12, 1 / 24)}


def summary(study: NoisyStudy) -> dict[str, Any]:
    """Return settings and all measures as plain data."""
    told: dict[str, Any] = plain(
        {
            "provenance": study_provenance(study.seed),
            "task": study.task.name,
            "starts": study.starts,
            "replications": study.replications,
            "sessions": study.sessions,
            "trajectories a session": TRAJECTORIES,
            "steps": STEPS,
            "seed": study.seed,
            "true agreement": dict(
                zip(study.task.predicate_names, study.true_agreement.tolist(), strict=True)
            ),
            "divergence of one half": study.control,
            "methods": [
                {
                    "method": name,
                    "replications": len(result.weights),
                    "weights": result.weights[:, -1],
                    "sessions": result.sessions.tolist(),
                    "divergence": _described(result.divergence if _quotable(study, name) else None),
                    "accuracy": {
                        states: _described(result.accuracy[..., i]) for i, states in enumerate(STATES)
                    },
                }
                for name, result in study.results.items()
            ],
            "hidden": None
            if study.hidden is None
            else {name: _described(result.accuracy[..., 0]) for name, result in study.hidden.items()},
            "seconds a session": dict(study.seconds),
            "identified": {method: doubt.known for method, doubt in study.doubt.items()},
            "reliabilities": None
            if study.posterior is None
            else {
                "features": list(study.posterior.names),
                "trajectories": study.posterior.trajectories,
                "posterior mean": study.posterior.draws.mean(0).tolist(),
                "learned": study.posterior.learned.tolist(),
                "truth": study.posterior.truth.tolist(),
                "in these observations": study.posterior.happened.tolist(),
                "divergent transitions": study.posterior.divergences,
            },
            "features": list(study.task.mdp.feature_names),
            "true weights": study.task.weights,
            "reward, first replication": None if (found := _reward(study)) is None else found,
            "random weights": {"draws": len(study.chance), "LBA": np.sort(study.chance)},
            "belts": None if study.belts is None else sorting_table_summary(study.belts),
        }
    )
    return told


def _reward(study: NoisyStudy) -> list[dict[str, Any]] | None:
    """Return the first replication's weights, learned and drawn from the posterior of its early sessions."""
    if study.posterior is None or study.posterior.reward is None:
        return None
    band = quantile_band(study.posterior.reward, 0.95)
    return [
        {
            "feature": name,
            "learned": float(weight),
            "posterior median": float(median),
            "95 % interval": [low, high],
        }
        for name, weight, median, low, high in zip(
            study.task.mdp.feature_names,
            study.results[PLAIN].weights[0, -1],
            band.median,
            band.low,
            band.high,
            strict=True,
        )
    ]


def _described(
    replications: Float[np.ndarray, "replications T"] | None,
) -> dict[str, list[float | None]] | None:
    if replications is None:
        return None
    band = mean_interval(replications)
    return {
        name: [None if math.isnan(x) else x for x in values.tolist()]
        for name, values in zip(("mean", "low", "high"), band, strict=True)
    }


# -- tables -------------------------------------------------------------------------------------------


def _with_interval(
    replications: Float[np.ndarray, " replications"], scale: float = 1.0, digits: int = 1
) -> str:
    band = mean_interval(scale * np.asarray(replications))
    if np.isnan(band.low):
        return f"{band.mean:.{digits}f}"
    return f"{band.mean:.{digits}f} ({band.low:.{digits}f}-{band.high:.{digits}f})"


def sensor_table(study: NoisyStudy) -> Table:
    """Tabulate the divergence of every estimate early and in the end, and as a share of the control."""
    rows = [("constant one half", f"{study.control:.4f}", "1", "", f"{study.control:.4f}", "1", "")]
    early, late = min(EARLY, study.sessions), study.sessions
    for name, result in study.results.items():
        if result.divergence is None:
            continue
        if not _quotable(study, name):
            rows.append((name, *("not identified", "", "") * 2))
            continue
        cells: list[str] = [name]
        for which, session in enumerate((early, late)):
            values = result.divergence[:, session - 1]
            share = values.mean() / study.control
            aimed = name in TARGETS and study.starts == "all" and session == (EARLY, LATE)[which]
            target = TARGETS[name][which] if aimed else None
            met = "" if target is None else f"1/{1 / target:.0f}: {'met' if share <= target else 'missed'}"
            cells += [_with_interval(values, digits=4), f"{share:.3f}", met]
        rows.append(tuple(cells))  # type: ignore[arg-type]
    return Table(
        (
            "estimate",
            f"after {early}",
            "of one half",
            "at most",
            f"after {late}",
            "of one half",
            "at most",
        ),
        rows,
        "Kullback-Leibler divergence of the learned agreement probabilities from the true ones in nats, mean "
        "over predicates, after so many sessions: mean of replications (95 % interval). "
        "At most: shares to reach "
        "after 6 and 20 sessions of all starts.",
    )


def _identified(study: NoisyStudy, method: str) -> bool:
    """Test whether the sensor is identified in at least half of the replications; true if that was not
    tested.
    """
    return method not in study.doubt or study.doubt[method].known >= 0.5


def _quotable(study: NoisyStudy, method: str) -> bool:
    """Test whether to quote a sensor's estimate: one without scores only if the sensor is identified."""
    return method not in (PLAIN, BARE) or _identified(study, PLAIN)


def doubt_table(study: NoisyStudy) -> Table:
    """Tabulate whose the errors are: agreement under assumptions about the expert."""
    rows: list[tuple[str, ...]] = []
    for method, doubt in study.doubt.items():
        for j, name in enumerate(study.task.predicate_names):
            rows.append(
                (
                    method if j == 0 else "",
                    name,
                    _with_interval(doubt.erratic[:, j], digits=2),
                    _with_interval(doubt.optimal[:, j], digits=2),
                    f"{study.true_agreement[j]:.2f}",
                    f"{doubt.identified[:, j].sum()} of {len(doubt.identified)}",
                )
            )
    return Table(
        (
            "learner",
            "predicate",
            "if the expert errs",
            "if the expert is optimal",
            "truth",
            "replications identified",
        ),
        rows,
        "Agreement of observations with the truth, fitted to all observations under the learned reward, "
        "for an expert as erratic as learned and for an optimal one; mean of replications "
        "(95 % interval). If the two are more than 0.05 apart, observations do not identify whose "
        "the errors are.",
    )


def behaviour_table(study: NoisyStudy) -> Table:
    """Tabulate LBA of every method after the last session."""
    kept = [0] if study.states.all() else [0, 1, 2]
    headings = [f"{STATES[i]} states, % ({study.states[i].sum()})" for i in kept]
    rows = [
        (name, f"{len(result.weights)}", *(_with_interval(result.accuracy[:, -1, i], 100) for i in kept))
        for name, result in study.results.items()
    ]
    return Table(
        ("method", "replications", *headings),
        rows,
        f"LBA after {counted(study.sessions, 'session')}: share of states in which the greedy action is one "
        "of the expert's optimal ones; mean of replications (95 % interval). "
        "Choice: more than one action is available; "
        "reachable: from where the task naturally starts, by any actions.",
    )


def hidden_table(study: NoisyStudy) -> Table:
    """Tabulate LBA with most of the patrol out of view."""
    assert study.hidden is not None
    clear, noisy = (study.hidden[name].accuracy[..., 0] for name in (HIDDEN, BOTH))
    early = min(EARLY, study.sessions)
    rows = [
        (name, _with_interval(values[:, early - 1], 100), _with_interval(values[:, -1], 100))
        for name, values in ((HIDDEN, clear), (BOTH, noisy))
    ]
    lost = 100 * (clear - noisy)
    rows.append(("lost to noise", _with_interval(lost[:, early - 1]), _with_interval(lost[:, -1])))
    return Table(
        (f"{OBSERVABILITY} % in view", f"LBA after {early}, %", f"LBA after {study.sessions}, %"),
        rows,
        f"Sessions of {TRAJECTORIES} trajectories of {HIDDEN_STEPS} steps, the same paths in both rows. "
        f"Hidden: observations are exact (LME-I2RL); hidden and noisy: {PLAIN}. Lost: paired over "
        f"replications.",
    )


def pace_table(study: NoisyStudy) -> Table:
    """Tabulate milliseconds a session, once compiled."""
    base = study.seconds.get(FAIR, math.nan)
    rows = [
        (name, f"{1000 * seconds:.2f}", "-" if math.isnan(base) else f"{seconds / base:.2f}")
        for name, seconds in study.seconds.items()
    ]
    return Table(
        ("learner", "milliseconds a session", "over RIFOM"),
        rows,
        "Median of an update once compiled."
        # Section 7.3's seconds are of sorting onions.
        + (" The dissertation: 96.7 s over 86.0 s to converge, 1.12." if study.belts is not None else ""),
    )


def belts_table(study: NoisyStudy) -> Table:
    """Tabulate precision and recall beside the table of Figure 7.9."""
    assert study.belts is not None
    return Table(
        HEADINGS,
        belt_cells(study.belts),
        caption(study.belts)
        + " Belts of a method are divided among its replications, and its intervals are over "
        "replications. Replications that sort "
        "have at least half the expert's recall. The dissertation heads its last two columns the other way "
        "round; its percentages fit the order given here.",
    )


def _tables(study: NoisyStudy) -> list[Table]:
    tables = [sensor_table(study), doubt_table(study), behaviour_table(study), pace_table(study)]
    if study.hidden is not None:
        tables.append(hidden_table(study))
    if study.belts is not None:
        tables.append(belts_table(study))
    return tables


def print_tables(study: NoisyStudy, console: Console) -> None:
    """Print all tables."""
    print_page_tables(_tables(study), console, _title(study))


# -- the page -----------------------------------------------------------------------------------------


def _title(study: NoisyStudy) -> str:
    name = study.task.name
    return f"{name[0].upper()}{name[1:]}, starts: {study.starts}"


def _text(study: NoisyStudy) -> str:
    bare = (
        f"{BARE!r} has only the dissertation's predicates; in its model, pairs with equal predicates are "
        "observed at random. The other learners also have labels of a pair that "
        f"perception might confuse ({', '.join(study.task.label_names)}); they learn that these are clear. "
        if BARE in study.results
        else ""
    )
    natural = (
        "\n\nAll trajectories start alike and are short, so observations without scores hardly identify the "
        "sensor: an odd observation may be wrong, or the expert may be odd. Scores distinguish the two. "
        "LBA over all states counts those that are never visited, too."
        if study.starts == "natural"
        else ""
    )
    return f"""An expert acts optimally; every pair of its trajectories is observed, some of them wrongly. \
The learner does not know the errors or their frequency. There {"is" if study.replications == 1 else "are"} \
{counted(study.replications, "independent replication")} of {counted(study.sessions, "session")} \
of {TRAJECTORIES} trajectories of {STEPS} pairs; observations and calibrated scores are the same for \
every method.

{bare}The sensor is judged by agreement probabilities: how often a predicate of an observation is that of \
the truth. The reliabilities that parametrise the sensor are not frequencies. Controls: the constant one \
half; observations compared with the truth (oracle); observations taken for truths (observed, RIFOM); the \
program as printed (all).

{CLEAR!r} learns from the truth. Methods with a known sensor or without one have the same ridge and \
number of iterations as RIMEO; online methods weigh all sessions equally.{natural}"""


def _doubts(study: NoisyStudy) -> str:
    lines = [
        f"{method}: the sensor is {'' if _identified(study, method) else 'not '}identified "
        f"(in {doubt.known:.0%} of replications all predicates are)."
        for method, doubt in study.doubt.items()
    ]
    return " ".join(lines)


def _lead(study: NoisyStudy) -> Lead:
    result, early = study.results[PLAIN], min(EARLY, study.sessions)
    final = float(result.accuracy[:, -1, 0].mean())
    learned = (
        f"From {counted(study.sessions, 'session')} of {TRAJECTORIES} noisy trajectories each, RIMEO "
        f"learned a reward whose policy agrees with the expert in {number(100 * final)} % of the "
        f"states, and at "
        "the same time how often perception is right."
    )
    reach = float(np.mean(study.chance >= final - 1e-9))
    chance = (
        f"{number(100 * reach, 2)} % of random weights reach that accuracy, half of them "
        f"{number(100 * float(np.median(study.chance)))} %"
    )
    replications = (
        "one replication shows no spread"
        if study.replications == 1
        else f"a mean of {counted(study.replications, 'replication')}"
    )
    sensor = (
        "and the sensor, which these observations identify"
        if _quotable(study, PLAIN)
        else "but not the sensor, whose errors these observations do not separate from the expert's"
    )
    verdict = "Trust the policy" if reach <= 0.05 else "Do not take the accuracy for evidence"
    trust = f"{verdict} ({chance}; {replications}), {sensor}."
    rows = [
        (
            row["feature"],
            round(row["learned"], 12),
            row["posterior median"],
            f"{number(row['95 % interval'][0])} to {number(row['95 % interval'][1])}",
            float(true),
        )
        for row, true in zip(_reward(study) or [], study.task.weights, strict=False)
    ]
    if not rows:
        plain_rows = [
            (name, round(float(weight), 12), float(true))
            for name, weight, true in zip(
                study.task.mdp.feature_names, result.weights[0, -1], study.task.weights, strict=True
            )
        ]
        told = "Weights of the first replication after its last session, without intervals or a posterior."
        return Lead(learned, trust, [Table(("feature", "weight", "true weight"), plain_rows, told)])
    table = Table(
        ("feature", f"weight, {PLAIN}", "posterior median", "95 % interval", "true weight"),
        rows,
        f"Weights of the first replication after its last session, and the posterior (NUTS) of its first "
        f"{counted(early, 'session')}. A reward is known up to its length.",
    )
    return Lead(learned, trust, [table])


def write(study: NoisyStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    divergence = drawn(
        folder,
        "divergence",
        partial(figures.divergence_plot, study),
        "Distance of the learned sensor from the true one (Figures 7.9 and 7.10).",
        "Divergence of agreement probabilities against sessions, logarithmic, RIMEO and controls",
    )
    accuracy = drawn(
        folder,
        "accuracy",
        partial(figures.accuracy_plot, study),
        "Learned behaviour accuracy. The axis does not begin at zero.",
        "Learned behaviour accuracy against sessions for RIMEO, RIFOM and learners with a known sensor",
    )
    strip = drawn(
        folder,
        "strip",
        partial(figures.strip_plot, study.strip, study.task.mdp),
        f"A new trajectory completed by the first replication's learner ({PLAIN}) after its last "
        f"session. Pairs "
        "that are never likely are left out.",
        "Grid of pairs against steps shaded by posterior probability, with the observations and the truth",
    )
    sections = [
        Section("The sensor", _text(study), [sensor_table(study)], [divergence]),
        Section("The expert's errors, or the sensor's?", _doubts(study), [doubt_table(study)]),
        Section("Behaviour", "", [behaviour_table(study)], [accuracy]),
    ]
    if study.hidden is not None:
        text = "The view is the patrol study's: a mask of states. Observations of states in view may err."
        sections.append(Section("Hidden and noisy", text, [hidden_table(study)]))
    believed = study.strip.believed
    told = (
        "Every observation of this trajectory is right."
        if math.isnan(believed)
        else f"At wrong observations the truth has posterior probability {believed:.2f} on average."
    )
    pictures = [strip]
    if study.posterior is not None:
        sensor = drawn(
            folder,
            "sensor",
            partial(figures.sensor_plot, study.posterior),
            "Joint posterior over reward and reliabilities (NUTS), as agreement probabilities, beside "
            "RIMEO's estimate from the same trajectories.",
            "Posterior intervals of each feature's agreement probability with the truth marked",
        )
        pictures.insert(0, sensor)
    sections.append(Section("What one learner believes", told, [], pictures))
    if study.belts is not None:
        belts = drawn(
            folder,
            "belts",
            partial(_draw_belts, study.belts),
            "What the learned policies do on simulated belts, beside the dissertation's belt (Figure 7.9).",
            "Precision and recall of the expert and of each method, with intervals",
        )
        text = (
            "A policy that errs in a single state on the way may stop sorting altogether: "
            "replications sort about as "
            "the expert does, or hardly at all, and a mean over them is like neither."
        )
        sections.append(Section("Sorting", text, [belts_table(study)], [belts]))
    sections.append(Section("Time", "", [pace_table(study)]))
    return write_page(folder, _title(study), _lead(study), sections, summary(study))


def _draw_belts(belts: SortingTable, theme: Theme) -> Figure:
    return sorting_table_plot(belts, theme=theme, title="Sorting after learning")
