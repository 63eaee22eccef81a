"""Page on label bias: Table 5.1 beside the dissertation's, and its significance by setting."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....models.inputs.text import counted
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.text import NOTHING, number
from . import figures
from .study import (
    DISCOUNT,
    PRINTED_P,
    PRINTED_RHO,
    STEPS,
    Correlation,
    LabelBiasStudy,
    SettingResult,
    quantiles,
    significance,
    tell_p,
)

if TYPE_CHECKING:
    from rich.console import Console


def _rows(study: LabelBiasStudy) -> list[dict[str, Any]]:
    rows = []
    for result in study.results:
        low, median, high = quantiles(result.birl)
        deviations = np.abs(1 - result.maxent[np.isfinite(result.maxent)])
        rows.append(
            {
                "setting": result.setting.name,
                "worlds with a correlation": int(np.isfinite(result.birl).sum()),
                "BIRL median rho": median,
                "BIRL rho, 5 % and 95 % of worlds": [low, high],
                "share significant": result.significant.value,
                "share significant, 95 % interval": list(result.significant[1:]),
                "share significantly negative": result.negative.value,
                "median rho of choices met": quantiles(result.choice)[1],
                "MaxEnt largest |1 - rho|": float(np.max(deviations, initial=0.0)),
            }
        )
    return rows


def summary(study: LabelBiasStudy) -> dict[str, Any]:
    """Return settings and results as plain data; None if no world has a correlation."""
    told: dict[str, Any] = plain({"provenance": study_provenance(study.seed), **_summary(study)})
    return told


def _summary(study: LabelBiasStudy) -> dict[str, Any]:
    sweep = {
        f"{what}, {walls}": [value(result) for result in study.sweep[blocked]]
        for blocked, walls in ((True, "blocked moves stay"), (False, "only open moves"))
        for what, value in (
            ("median rho", lambda result: quantiles(result.birl)[1]),
            ("share significant", lambda result: result.significant.value),
        )
    }
    return {
        "worlds": study.worlds,
        "trajectories": study.per_world,
        "walls": study.walls,
        "seed": study.seed,
        "median world": {"BIRL": study.birl._asdict(), "MaxEnt": study.maxent._asdict()},
        "settings": _rows(study),
        "sweep": {"rationality": list(study.rationalities), **sweep},
        "dissertation": {
            "rho": PRINTED_RHO,
            "p": PRINTED_P,
            "p of that rho for 75 trajectories": significance(PRINTED_RHO, 75),
        },
    }


def _tables(study: LabelBiasStudy) -> tuple[Table, ...]:
    def progress_line(c: Correlation) -> tuple[str, ...]:
        if np.isnan(c.rho):
            return "none", NOTHING, NOTHING, f"{c.n}"
        return f"{c.rho:.4f}", f"{c.low:.2f} to {c.high:.2f}", tell_p(c.p), f"{c.n}"

    table = Table(
        ("", "rho", "95 % interval", "p", "n"),
        [
            ("BIRL", *progress_line(study.birl)),
            ("dissertation, BIRL", f"{PRINTED_RHO}", "not given", f"{PRINTED_P}", "75"),
            ("MaxEnt", *progress_line(study.maxent)),
            ("dissertation, MaxEnt", "1.0", "not given", "0.0", "75"),
        ],
        f"Log-likelihood and total reward in the median world of {study.results[0].setting.name}; MaxEnt's "
        f"rho is within {number(max(abs(1 - study.maxent.rho), np.finfo(float).eps), 1)} of one. "
        f"A correlation of {PRINTED_RHO} of 75 pairs has p = {significance(PRINTED_RHO, 75):.3f}; the p "
        f"printed would go with some 37 pairs (p = {significance(PRINTED_RHO, 37):.3f}).",
    )
    settings = [
        (
            row["setting"],
            *_told_of_birl(result),
            _share(result.negative.value),
            _signed(row["median rho of choices met"]),
            number(row["MaxEnt largest |1 - rho|"], 1),
        )
        for row, result in zip(_rows(study), study.results, strict=True)
    ]
    sweep = [
        (f"{rationality:g}", *_told_of_birl(stay), *_told_of_birl(go))
        for rationality, stay, go in zip(
            study.rationalities, study.sweep[True], study.sweep[False], strict=True
        )
    ]
    return (
        table,
        Table(
            (
                "setting",
                "BIRL, rho: median (90 % of worlds)",
                "worlds with p < 0.05",
                "and rho < 0",
                "choices met",
                "MaxEnt, |1 - rho|",
            ),
            settings,
            f"{counted(study.worlds, 'world')}, {counted(study.per_world, 'trajectory')} each; where a "
            "correlation is by chance only, 5 % of the worlds have p < 0.05. In brackets after a share: its "
            "95 % interval. Choices met: median correlation of the total reward and the nats BIRL takes off "
            "for choices. MaxEnt: the largest deviation in any world.",
        ),
        Table(
            ("rationality", "rho, blocked moves stay", "p < 0.05", "rho, only open moves", "p < 0.05"),
            sweep,
            f"BIRL with Boltzmann experts of the same eta, {STEPS} steps, discount {DISCOUNT:g}.",
        ),
    )


def _signed(rho: float) -> str:
    return NOTHING if np.isnan(rho) else f"{rho:+.2f}"


def _told_of_birl(result: SettingResult) -> tuple[str, str]:
    low, median, high = quantiles(result.birl)
    share, least, most = result.significant
    return (
        "none" if np.isnan(median) else f"{median:+.2f} ({low:+.2f} to {high:+.2f})",
        NOTHING if np.isnan(share) else f"{_share(share)} ({100 * least:.0f} to {100 * most:.0f})",
    )


def _share(share: float) -> str:
    return NOTHING if np.isnan(share) else f"{100 * share:.0f} %"


def _text(study: LabelBiasStudy) -> str:
    first = study.results[0]
    return f"""A world of 10 x 10 cells with {counted(study.walls, "wall")}, a desirable object in each of \
two corners, deterministic moves. The law of maximum entropy makes a trajectory's log-likelihood its reward \
less a constant, so the two correlate perfectly for every expert.

Bayesian IRL normalises over actions in every state. Its log-likelihood is the sum of advantages times \
the rationality, which grows with the reward, less the cost of the choices on the path, and at an object \
in a corner there are most equally good choices: a move against either edge stays, too. The two pull in \
opposite directions, and the result depends on the experts' rationality.

With exp(Q) as the dissertation writes it (rationality 1), a discount of {DISCOUNT:g}, \
{first.setting.steps} steps and experts that follow that law, the correlation is significant at 0.05 in \
{_share(first.significant.value)} of the worlds; chance alone would give 5 %.

{_conditions(study)}

The dissertation does not state its setting, so its number is one point of the curve below and \
not a property of the method. The property of the method is that the correlation can take any value."""


def _conditions(study: LabelBiasStudy) -> str:
    """Write when BIRL's correlation is and is not significant in more than half of the worlds."""
    told = []
    for title, results, name in (
        ("Of the settings, the correlation is", study.results, lambda r: r.setting.name),
        ("Where blocked moves stay put, by eta, it is", study.sweep[True], _eta_of),
        ("Where only open moves are actions, by eta, it is", study.sweep[False], _eta_of),
    ):
        parts: dict[str, list[str]] = {
            "significant in at most half of the worlds": [],
            "positive and significant in more than half": [],
            "negative and significant in more than half": [],
        }
        rarely, positive, negative = parts.values()
        for result in results:
            rho = quantiles(result.birl)[1]
            if np.isfinite(rho):
                often = positive if rho > 0 else negative
                (often if result.significant.value > 0.5 else rarely).append(name(result))
        listed = [f"{kind}: {'; '.join(names)}" for kind, names in parts.items() if names]
        if listed:
            told.append(f"{title} {' | '.join(listed)}.")
    return "\n\n".join(told)


def _eta_of(result: SettingResult) -> str:
    return f"{result.setting.rationality:g}"


def print_tables(study: LabelBiasStudy, console: Console) -> None:
    """Print Table 5.1 as reproduced, and what other settings give."""
    print_page_tables(_tables(study), console)


def _lead(study: LabelBiasStudy) -> Lead:
    first = study.results[0]
    low, median, high = quantiles(first.birl)
    learned = (
        f"In {counted(study.worlds, 'world')} of known reward, the log-likelihood of MaxEnt correlates "
        "perfectly with the reward that a trajectory earns, and that of BIRL "
        + (
            "with zero spread, since all trajectories earn the same."
            if np.isnan(median)
            else f"with rho {median:+.2f} (90 % of worlds: {low:+.2f} to {high:+.2f}) in the first setting."
        )
    )
    share, least, most = first.significant
    often = (
        ""
        if np.isnan(share)
        else f"BIRL's correlation is significant in {_share(share)} of these worlds ({100 * least:.0f} to "
        f"{100 * most:.0f}; by chance 5), and "
    )
    trust = (
        f"Trust the first as a theorem, and the second for its setting only: {often}other settings below "
        "give it any value."
    )
    return Lead(learned, trust, _tables(study)[:1])


def write(study: LabelBiasStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    pictures = [
        drawn(folder, name, partial(draw, study), caption, description)
        for name, draw, caption, description in (
            (
                "world",
                figures.draw_world,
                "Median world: walls, the two objects, and trajectories from the least reward to the most.",
                "Grid with walls, two objects in opposite corners, and five paths",
            ),
            (
                "scatter",
                figures.draw_scatter,
                "Log-likelihood against total reward of the median world's trajectories.",
                "Two scatter plots: no clear relation for BIRL, a straight line for MaxEnt",
            ),
            (
                "settings",
                figures.draw_settings,
                "Correlation in every world, setting by setting, and the dissertation's one.",
                "Correlations of BIRL from minus one to one depending on the setting; of MaxEnt always one",
            ),
            (
                "sweep",
                figures.draw_sweep,
                "Correlation against how sharply experts choose (and are believed to choose).",
                "BIRL's correlation falls from positive to minus one with eta where blocked moves stay",
            ),
        )
    ]
    section = Section("What the correlation depends on", _text(study), _tables(study)[1:], pictures)
    return write_page(folder, "Label bias (Table 5.1)", _lead(study), [section], summary(study))
