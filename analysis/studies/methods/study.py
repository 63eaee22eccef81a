"""The online methods of others beside this library's: Table 8.1 counted from the learners, and a study.

The study gives every method the same fully observed patrol and asks how many state-action pairs it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ....domains.patrol.process import LEFT, RIGHT, Patrol, demonstrate, instance
from ....inference.learners.darko import darko_i2rl, goal_sessions
from ....inference.learners.jin import jin_i2rl, jin_i2rl_with_features
from ....inference.learners.lme import lme_i2rl, lme_i2rl_with_random_weights, me_i2rl
from ....inference.sessions.learner import Learner
from ....inference.sessions.running import run_sessions
from ....models.inputs.text import counted
from ....models.observation.demonstration import SEEN, Demonstration
from ....models.observation.evidence import Sensor
from ....models.process.mdp import TabularMDP
from ...drawing.charts import draw_band, set_scale
from ...drawing.estimates import Estimates, laplace_errors
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.style import Theme, dress, foot, head, method_styles, new_figure
from ...drawing.text import number
from ...judging.metrics import behaviour_accuracies, chance_accuracy, optimal_actions, quantile_band
from ...posteriors.information import complete_information

if TYPE_CHECKING:
    import pandas
    from rich.console import Console

Advance = Callable[[str, float | None], None]
PAIRS_PER_SESSION = 5
# Learning rates tried, for each method that has one.
RATES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
# Demonstrations that rates are chosen on come from keys no evaluation uses.
_TUNING = 7919


# -- Table 8.1 ----------------------------------------------------------------------------------------


def methods_table(mdp: TabularMDP, demonstration: Demonstration | None = None) -> pandas.DataFrame:
    """Tabulate Table 8.1 for this library: each method's reward and memory.

    One row per method: ``reward`` and ``statistic`` name the parts, ``reward numbers`` and ``statistic
    numbers`` count their floats in the learner's own state on ``mdp``. Random keys, session counters and warm
    starts, which follow from the rest, are neither. With a ``demonstration`` batch LME is added as a
    contrast: it stores every pair seen so far (two numbers).
    """
    import pandas

    sensor = Sensor()
    learners: list[Learner] = [
        jin_i2rl(mdp),
        jin_i2rl_with_features(mdp),
        darko_i2rl(mdp),
        me_i2rl(mdp, statistic="features"),
        *(lme_i2rl(mdp, sensor, statistic=name) for name in ("seen", "counts", "features")),
        lme_i2rl_with_random_weights(mdp, sensor),
    ]
    rows = [_described(learner) for learner in learners]
    if demonstration is not None:
        reward = ("theta [K]", mdp.n_features)
        rows.append(
            ("batch LME, of one stream", *reward, "all trajectories", 2 * int(demonstration.lengths.sum()))
        )
    columns = ["method", "reward", "reward numbers", "statistic", "statistic numbers"]
    return pandas.DataFrame(rows, columns=columns)


def _described(learner: Learner) -> tuple[str, str, int, str, int]:
    state = learner.init(jax.random.key(0))
    chosen = learner.configuration.get("statistic")
    parts = getattr(type(state.statistic), "_fields", ())
    table = learner.mdp.feature_names == learner.mdp.state_names
    return (
        learner.name if chosen is None else f"{learner.name}, {chosen}",
        "R [S]" if table else "theta [K]",
        int(state.weights.size),
        ", ".join(parts) or "none",
        sum(int(np.size(leaf)) for leaf in jax.tree.leaves(state.statistic)),
    )


# -- the study ----------------------------------------------------------------------------------------


class MethodCurve(NamedTuple):
    """One method.

    Fields
    ------
    name : str
    accuracy : float ``[streams, points]``
        LBA in [0, 1].
    learning_rate : float or None
        None: has none.
    weights : float ``[streams, K]``
        Learned by the end.
    """

    name: str
    accuracy: Float[np.ndarray, "streams points"]
    learning_rate: float | None
    weights: Float[np.ndarray, "streams K"]


class MethodsStudy(NamedTuple):
    """Settings, the pairs seen at which accuracy was measured, the methods' curves, and the sweeps.

    ``sweeps`` holds for each method with a learning learning_rate its score at each of ``learning_rates`` on
    the tuning demonstrations: the median over streams of the mean accuracy over ``points``. ``chance`` are
    LBAs of random weights, ``visits`` the first stream's visits of each state.
    """

    patrol: Patrol
    sessions: int
    replications: int
    seed: int
    points: Int[np.ndarray, " points"]
    curves: tuple[MethodCurve, ...]
    learning_rates: tuple[float, ...]
    sweeps: Mapping[str, Float[np.ndarray, " rates"]]
    table: pandas.DataFrame
    chance: Float[np.ndarray, " draws"]
    visits: Float[np.ndarray, " S"]


class _Entry(NamedTuple):
    """A method: how to make its learner at a rate, and how it cuts a stream of windows into sessions."""

    learner: Callable[[float], Learner]
    cut: Callable[[Iterable[Demonstration]], Iterable[Demonstration]] = lambda windows: windows
    tuned: bool = True


def turning_places(patrol: Patrol) -> Bool[np.ndarray, " S"]:
    """Find where a patroller turns round: it turns, and turns again in the same cell.

    They are DARKO's goals, from the true policy: an advantage that the other methods do not have.
    """
    policy = patrol.expert_policy().argmax(1)
    turns = np.isin(policy, (LEFT, RIGHT))
    following = np.asarray(patrol.mdp.successors)[np.arange(len(policy)), policy, 0]
    return turns & turns[following]


def methods_study(
    number: int = 2,
    *,
    sessions: int = 120,
    replications: int = 3,
    seed: int = 0,
    learning_rates: Sequence[float] = RATES,
    methods: Sequence[str] | None = None,
    advance: Advance = lambda description, fraction: None,
) -> MethodsStudy:
    """Run every method ``replications`` times on the same fully observed patrols, a stream a patroller.

    A stream is ``sessions`` windows of five pairs. Windows are the sessions of all methods but DARKO, whose
    sessions end at the goals (:func:`turning_places`); what it learned at the last goal counts until the
    next. Each learning rate is the :func:`chosen_learning_rate` of ``learning_rates`` by their score (see
    :class:`MethodsStudy`) on one further run, drawn for this and used for nothing else.
    ``methods`` names some of the methods, all by default. Raises ``ValueError`` for an instance or a method
    that does not exist.

    See Also
    --------
    i2rl.analysis.patrol_study : the same patrols, partly hidden
    i2rl.inference.me_i2rl : one of the methods

    Examples
    --------
    >>> from i2rl.analysis import methods_study
    >>> study = methods_study(2, sessions=4, replications=1, methods=["ME-I2RL, features"])
    >>> [curve.name for curve in study.curves], study.points.tolist()
    (['ME-I2RL, features'], [5, 10, 15, 20])
    >>> study.curves[0].accuracy.shape
    (2, 4)
    """
    patrol = instance(number)
    entries = _entries(patrol)
    unknown = [name for name in methods or () if name not in entries]
    if unknown:
        raise ValueError(f"methods are {'; '.join(entries)}; got {unknown[0]!r}")
    entries = {name: entry for name, entry in entries.items() if methods is None or name in methods}
    points = np.unique(np.geomspace(1, sessions, 24).round().astype(int)) * PAIRS_PER_SESSION
    streams = _streams(jax.random.key(seed), patrol, sessions, replications)
    tuning = _streams(jax.random.key(seed + _TUNING), patrol, sessions, 1)
    curves, sweeps = [], {}
    for i, (name, entry) in enumerate(entries.items()):
        advance(name, i / len(entries))
        learning_rate = None
        if entry.tuned:
            tried = [_accuracies(patrol, entry, float(r), tuning, points)[0].mean(1) for r in learning_rates]
            sweeps[name] = np.median(tried, axis=1)
            learning_rate = chosen_learning_rate(learning_rates, sweeps[name])
        measured, weights = _accuracies(
            patrol, entry, 1.0 if learning_rate is None else learning_rate, streams, points
        )
        curves.append(MethodCurve(name, measured, learning_rate, weights))
    advance("done", 1.0)
    table = methods_table(patrol.mdp, streams[0][1])
    chance = chance_accuracy(
        jax.random.fold_in(jax.random.key(seed), 200), patrol.mdp, jnp.asarray(patrol.weights)
    )
    first = streams[0][1]
    visits = np.bincount(first.state[first.kind == SEEN], minlength=patrol.mdp.n_states).astype(float)
    return MethodsStudy(
        patrol,
        sessions,
        replications,
        seed,
        points,
        tuple(curves),
        tuple(learning_rates),
        sweeps,
        table,
        chance,
        visits,
    )


def _entries(patrol: Patrol) -> dict[str, _Entry]:
    mdp, goals = patrol.mdp, turning_places(patrol)
    return {
        "Jin et al., table over states": _Entry(
            lambda learning_rate: jin_i2rl(mdp, learning_rate=learning_rate)
        ),
        "Jin et al., features": _Entry(
            lambda learning_rate: jin_i2rl_with_features(mdp, learning_rate=learning_rate)
        ),
        "DARKO, goals": _Entry(
            lambda learning_rate: darko_i2rl(mdp, learning_rate=learning_rate),
            partial(goal_sessions, goals=goals),
        ),
        "DARKO, windows of 5": _Entry(lambda learning_rate: darko_i2rl(mdp, learning_rate=learning_rate)),
        "ME-I2RL, features": _Entry(lambda _: me_i2rl(mdp, statistic="features"), tuned=False),
        "LME-I2RL, seen": _Entry(lambda _: lme_i2rl(mdp, Sensor()), tuned=False),
    }


def chosen_learning_rate(learning_rates: Sequence[float], scores: Float[np.ndarray, " rates"]) -> float:
    """Choose the smallest rate whose score is within 0.01 of the best."""
    good = np.asarray(scores) >= np.max(scores) - 0.01
    return min(float(learning_rate) for learning_rate, kept in zip(learning_rates, good, strict=True) if kept)


def _streams(
    key: Array, patrol: Patrol, sessions: int, replications: int
) -> list[tuple[Array, Demonstration]]:
    """Simulate the windows of every patroller of every replication, with a key for its first weights."""
    return [
        (jax.random.fold_in(one, p), windows)
        for one in jax.random.split(key, replications)
        for p, windows in enumerate(demonstrate(one, patrol, 100, sessions, PAIRS_PER_SESSION))
    ]


def _accuracies(
    patrol: Patrol,
    entry: _Entry,
    learning_rate: float,
    streams: Sequence[tuple[Array, Demonstration]],
    points: Int[np.ndarray, " points"],
) -> tuple[Float[np.ndarray, "streams points"], Float[np.ndarray, "streams K"]]:
    """Compute accuracy after so many pairs, and the weights in the end."""
    learner = entry.learner(learning_rate)
    optimal = optimal_actions(patrol.mdp, jnp.asarray(patrol.weights))
    rows, final = [], []
    for key, windows in streams:
        sessions = list(entry.cut(windows.sessions()))
        reports = run_sessions(learner, sessions, key=key).infos
        weights = np.array([learner.init(key).weights, *(report.weights for report in reports)])
        seen = np.cumsum([0, *(int(session.lengths.sum()) for session in sessions)])
        # What was learned at the last session that had ended by then.
        learned = weights[np.searchsorted(seen, points, side="right") - 1]
        rows.append(np.asarray(behaviour_accuracies(learner.mdp, optimal, jnp.asarray(learned))))
        final.append(weights[-1])
    return np.array(rows), np.array(final)


# -- telling ------------------------------------------------------------------------------------------


def draw(study: MethodsStudy, theme: Theme) -> Figure:
    """Draw accuracy against state-action pairs seen (logarithmic): medians, and bands of the middle half.

    One panel a family of methods, since six bands would overlap; the last method, this library's default, is
    repeated in all of them as a thin line to compare with.
    """
    figure = new_figure(theme, 9.6, 4.4)
    reference = study.curves[-1]
    families: dict[str, list[int]] = {}
    for i, curve in enumerate(study.curves):
        families.setdefault(_family(curve.name), []).append(i)
    panels = np.atleast_1d(figure.subplots(1, len(families), sharey=True))
    handles = []
    styles = method_styles(theme, [curve.name for curve in study.curves])
    for panel, (family, members) in zip(panels, families.items(), strict=True):
        for i in members:
            curve = study.curves[i]
            draw_band(panel, styles[curve.name], curve.name, study.points, curve.accuracy, 0.5)
        handles += panel.get_legend_handles_labels()[0]
        if len(study.curves) - 1 not in members:
            level = np.median(reference.accuracy, axis=0)
            panel.plot(
                study.points, level, color=theme.muted, linewidth=1.0, label=f"{reference.name}, median"
            )
        dress(panel, theme, title=family, x="state-action pairs seen")
        set_scale(panel, "x", "log")
        panel.tick_params(axis="y", left=panel is panels[0])
    compared = [line for line in panels[0].get_lines() if line.get_label() == f"{reference.name}, median"]
    panels[0].set_ylabel("learned behaviour accuracy\n(share of states)", color=theme.ink)
    panels[0].set_ylim(0, 1.02)
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    head(figure, theme, handles + compared, title=_title(study))
    streams = len(reference.accuracy)
    foot(
        figure,
        theme,
        "line: one patroller"
        if streams == 1
        else f"line: median; band: middle 50% of {streams} patrollers watched",
    )
    return figure


def _family(name: str) -> str:
    return "Jin et al." if name.startswith("Jin") else "DARKO" if name.startswith("DARKO") else "I2RL"


def summary(study: MethodsStudy) -> dict[str, Any]:
    """Return settings, curves, sweeps and the live Table 8.1 as plain data."""
    told: dict[str, Any] = plain(
        {
            "provenance": study_provenance(study.seed),
            "patrol": study.patrol.name,
            "sessions": study.sessions,
            "replications": study.replications,
            "seed": study.seed,
            "pairs": study.points.tolist(),
            "methods": [
                {
                    "method": curve.name,
                    "learning rate": curve.learning_rate,
                    "median accuracy": np.median(curve.accuracy, axis=0).tolist(),
                    "pairs to 90 %": _pairs_to(study, curve, 0.9),
                    "weights": curve.weights,
                }
                for curve in study.curves
            ],
            "sweeps": {name: scores.tolist() for name, scores in study.sweeps.items()},
            "table 8.1": study.table.to_dict("records"),
            "random weights": {"draws": len(study.chance), "LBA": np.sort(study.chance)},
            "weights, first stream": None if (found := _estimates(study)) is None else found.summary(),
        }
    )
    return told


def _estimates(study: MethodsStudy) -> Estimates | None:
    """Return weights of the last method in the first stream, if they are of the process's features."""
    mdp, weights = study.patrol.mdp, study.curves[-1].weights[0]
    if not study.curves[-1].name.startswith(("LME", "ME")):
        return None
    information = complete_information(mdp, jnp.asarray(weights), jnp.asarray(study.visits))
    return Estimates(mdp.feature_names, weights, laplace_errors(np.asarray(information)))


def _pairs_to(study: MethodsStudy, curve: MethodCurve, level: float) -> int | None:
    """Find the pairs from which on the median accuracy stays at ``level``; None if it does not."""
    enough = np.median(curve.accuracy, axis=0) >= level
    stays = np.logical_and.accumulate(enough[::-1])[::-1]
    return int(study.points[np.argmax(stays)]) if stays.any() else None


def _title(study: MethodsStudy) -> str:
    return f"Online methods, {study.patrol.name}, everything in view"


def _tables(study: MethodsStudy) -> tuple[Table, ...]:
    results = []
    for curve in study.curves:
        band = quantile_band(curve.accuracy[:, -1])
        reached = _pairs_to(study, curve, 0.9)
        results.append(
            (
                curve.name,
                "-" if curve.learning_rate is None else f"{curve.learning_rate:g}",
                "never" if reached is None else f"{reached}",
                f"{100 * band.median:.1f} % ({100 * band.low:.0f}-{100 * band.high:.0f})",
            )
        )
    sweep = [(name, *(f"{score:.3f}" for score in scores)) for name, scores in study.sweeps.items()]
    live = [tuple(row) for row in study.table.itertuples(index=False)]
    return (
        Table(
            ("method", "learning rate", "pairs to stay at 90 %", f"LBA after {study.points[-1]} pairs"),
            results,
            "Median over streams (middle half).",
        ),
        Table(
            (
                "mean LBA while learning",
                *(f"rate {learning_rate:g}" for learning_rate in study.learning_rates),
            ),
            sweep,
            "On a further replication. Above, each method has the smallest rate within 0.01 of its "
            "best. A reward table over states learns the same policy at every rate.",
        ),
        Table(
            tuple(study.table.columns),
            live,
            "Table 8.1, counted from the learners' states. R is a table over states, theta a weight a "
            "feature. The dissertation lists LME-I2RL's statistic as the number of trajectories and their "
            "features; the features statistic also keeps where they start, which its program needs. Batch "
            "keeps everything it is given.",
        ),
    )


_TEXT = """Every method is given the same pairs, all of them in view. Windows of five pairs are a session, \
which for the method of Jin et al. is five sessions of one pair; DARKO's sessions also come as it has them, \
from goal to goal; only it is given the goals (where a patroller turns round). Jin's reward is a table \
over states and cannot say what an action costs; its second form has the features that the others have.

The patrollers pass one another by stopping, which no reward explains, and they are deterministic, which a \
soft policy only approaches. With everything in view LME-I2RL and ME-I2RL are one learner: the two lines \
differ in the statistic."""


def _lead(study: MethodsStudy) -> Lead:
    last = study.curves[-1]
    final = float(np.median(last.accuracy[:, -1]))
    reached = _pairs_to(study, last, 0.9)
    name = last.name.split(",")[0]
    at = "never stays at 90 %" if reached is None else f"stays at 90 % or more from {reached} pairs on"
    quickest = [(pairs, c.name) for c in study.curves[:-1] if (pairs := _pairs_to(study, c, 0.9)) is not None]
    others = f"; the quickest of the others does so from {min(quickest)[0]} on" if quickest else ""
    learned = (
        f"From {counted(int(study.points[-1]), 'state-action pair')} of {study.patrol.name}, {name} learned "
        f"a reward whose policy does as the expert in {number(100 * final)} % of the states, and {at}"
        f"{others}."
    )
    reach = float(np.mean(study.chance >= final - 1e-9))
    streams = len(last.accuracy)
    trust = (
        (
            "Trust no small difference, since one patroller was watched, "
            if streams == 1
            else f"Trust differences that exceed the spread of {streams} patrollers watched, "
        )
        + (
            f"and no accuracy by itself: {number(100 * reach, 2)} % of random weights reach that one"
            if reach > 0.05
            else f"which chance does not explain: {number(100 * reach, 2)} % of random weights reach that "
            "accuracy"
        )
        + f" (half of them {number(100 * float(np.median(study.chance)))} %)."
    )
    found = _estimates(study)
    if found is None:
        return Lead(learned, trust)
    table = found.table(
        f"Weights that {name} learned from the first stream, with intervals of the likelihood's "
        "curvature there. A reward is known up to its length, hence the shares.",
        np.asarray(study.patrol.weights),
    )
    return Lead(learned, trust, [table])


def print_tables(study: MethodsStudy, console: Console) -> None:
    """Print the results, the sweeps and the live Table 8.1."""
    print_page_tables(_tables(study), console, _title(study))


def write(study: MethodsStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the picture in both themes, and ``results.json``."""
    picture = drawn(
        folder,
        "methods",
        partial(draw, study),
        "Accuracy of the learned behaviour against the number of state-action pairs seen.",
        "Learned behaviour accuracy of each online method against pairs seen, on a logarithmic axis",
    )
    section = Section("Methods compared", _TEXT, _tables(study), [picture])
    return write_page(folder, _title(study), _lead(study), [section], summary(study))
