"""The main job: learn a patrol's rewards online through a keyhole, and walk past the patrollers unseen."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float
from rich.console import Console

from ..domains.breach_trials import REACHED, TIMED_OUT, BreachOutcome, breach_trials, greedy_policies
from ..domains.patrol import Patrol, demonstrate, instance, simulate_patrol
from ..inference.lme import batch_lme, lme_i2rl, lme_i2rl_with_random_weights
from ..inference.session import Learner, run_sessions
from ..inference.smoothing import evidence_of, smooth_all
from ..models.demonstration import SEEN, Demonstration, concatenate
from ..models.evidence import observe
from ..models.planning import reward_of, soft_plan
from .figures import (
    LearningCurve,
    LearningTime,
    SuccessRate,
    learning_curves,
    learning_time,
    success_rates,
)
from .identifiability import Identifiability, identifiability_of, identifiability_section
from .maps import hidden_path, policy_map
from .metrics import demonstration_log_likelihoods, evaluate
from .report import Picture, Section, Table, write_report
from .style import Theme, save_themes

ONLINE, FORGETFUL, BATCH, RANDOM, TRUE = (
    "LME-I2RL", "LME-I2RL with random weights", "batch LME", "random weights", "true policy",
)  # fmt: skip
# Names on the command line.
METHODS = {"lme-i2rl": ONLINE, "batch": BATCH, "random": RANDOM}
STEPS_PER_SESSION = 5

Advance = Callable[[str, float | None], None]


class MethodResult(NamedTuple):
    """What a method reached; the first axis runs over independent runs and the patrollers of each.

    Fields
    ------
    name : str
    points : int ``[T]``
        Sessions at which the rest was measured.
    weights : float ``[runs, patrollers, T, K]``
    accuracy, choice_accuracy : float ``[runs * patrollers, T]``
        LBA over all states and over states with a choice.
    error : float ``[runs * patrollers, T]``
        ILE relative to the value of the optimal policy.
    log_likelihood : float ``[runs * patrollers, T]``
        Exact, of fresh demonstrations that nobody learned from; nats per trajectory.
    seconds : float ``[runs, T]``
        Learning time up to there, all patrollers together.
    breach : BreachOutcome or None
        All runs' trials together.
    """

    name: str
    points: np.ndarray
    weights: np.ndarray
    accuracy: np.ndarray
    choice_accuracy: np.ndarray
    error: np.ndarray
    log_likelihood: np.ndarray
    seconds: np.ndarray
    breach: BreachOutcome | None


class Study(NamedTuple):
    """A study of one patrol: settings, the methods' results, and one stretch the first learner looked at."""

    patrol: Patrol
    observability: int
    sessions: int
    trials: int
    runs: int
    seed: int
    methods: tuple[MethodResult, ...]
    batch_rerun_seconds: np.ndarray | None
    stretch: Stretch
    determined: tuple[Identifiability, ...]


class Stretch(NamedTuple):
    """A fresh stretch of patrol, the belief about it, and the truth."""

    posterior: Float[np.ndarray, "L S"]
    seen: np.ndarray
    path: np.ndarray


def study(
    number: int = 2,
    observability: int | None = None,
    *,
    sessions: int = 60,
    trials: int = 200,
    runs: int = 3,
    seed: int = 0,
    methods: Sequence[str] | None = None,
    advance: Advance = lambda description, fraction: None,
) -> Study:
    """Learn, evaluate and (instances 2 and 3) breach.

    ``runs`` independent demonstrations are learned from, one learner per patroller; each learned set of
    policies then tries ``trials`` breaches, with the time it took to learn on the clock. ``methods`` names
    some of ``lme-i2rl``, ``batch`` and ``random`` (all by default). Raises ``ValueError`` for an instance,
    observability or method that does not exist.
    """
    patrol = instance(number)
    observability = patrol.observability if observability is None else observability
    view = patrol.visibility(observability)
    unknown = [m for m in methods or () if m not in METHODS]
    if unknown:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {unknown[0]!r}")
    wanted = {METHODS[m] for m in methods} if methods else {ONLINE, FORGETFUL, BATCH, RANDOM}
    keys = jax.random.split(jax.random.key(seed), runs)
    data = [demonstrate(k, patrol, observability, sessions, STEPS_PER_SESSION) for k in keys]
    learners = {
        ONLINE: partial(_online, lme_i2rl(patrol.mdp, view)),
        FORGETFUL: partial(_online, lme_i2rl_with_random_weights(patrol.mdp, view)),
        BATCH: partial(_batch, batch_lme(patrol.mdp, view)),
        RANDOM: partial(_random, patrol),
        TRUE: partial(_true, patrol),
    }
    results: list[MethodResult] = []
    rerun = None
    names = [n for n in learners if n in wanted or n == TRUE]
    stages = 2 * len(names)
    for name in names:
        advance(f"learning: {name}", len(results) * 2 / stages)
        learned = [
            learners[name](key, demonstrations) for key, demonstrations in zip(keys, data, strict=True)
        ]
        if name == BATCH:
            rerun = np.stack([_interpolated_sum(one.points, one.seconds) for one in learned])
        advance(f"breaching: {name}", (len(results) * 2 + 1) / stages)
        results.append(_evaluated(patrol, observability, name, learned, keys, sessions, trials))
    first = results[0]
    stretch = _stretch(jax.random.fold_in(keys[0], 7), patrol, observability, first.weights[0, 0, -1])
    # What the first run's demonstrations say of each patroller, where something was learned from them.
    known = data[0] if first.name not in (RANDOM, TRUE) else ()
    determined = tuple(
        identifiability_of(patrol.mdp, view, demonstration, jnp.asarray(weights[-1]))
        for demonstration, weights in zip(known, first.weights[0], strict=False)
    )
    advance("done", 1.0)
    return Study(
        patrol, observability, sessions, trials, runs, seed, tuple(results), rerun, stretch, determined
    )


class _Learned(NamedTuple):
    """One run of one method: sessions ``[T]``, ``weights [P, T, K]``, cumulative seconds ``[T]``."""

    points: np.ndarray
    weights: np.ndarray
    seconds: np.ndarray


def _online(learner: Learner, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    # One session first, unrecorded, so that compilation is not counted as learning.
    learner.update(learner.init(key), demonstrations[0].select([0]))
    runs = [
        run_sessions(learner, d.sessions(), key=jax.random.fold_in(key, p)).reports
        for p, d in enumerate(demonstrations)
    ]
    weights = np.array([[r.weights for r in reports] for reports in runs])
    seconds = np.cumsum(np.sum([[r.seconds for r in reports] for reports in runs], axis=0))
    return _Learned(np.arange(1, weights.shape[1] + 1), weights, seconds)


def _batch(batch: Any, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    import time

    n = demonstrations[0].n_trajectories
    points = np.unique(np.geomspace(min(5, n), n, 3).round().astype(int))
    weights, seconds = [], []
    for count in points:
        part = [d.select(slice(0, int(count))) for d in demonstrations]
        batch.fit(key, part[0])  # compiled for this size before the clock starts
        began = time.perf_counter()
        fits = [batch.fit(key, d) for d in part]
        seconds.append(time.perf_counter() - began)
        weights.append([fit.weights for fit in fits])
    return _Learned(points, np.swapaxes(weights, 0, 1), np.array(seconds))


def _random(patrol: Patrol, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    shape = (patrol.patrollers, 1, patrol.mdp.n_features)
    weights = np.asarray(jax.random.uniform(key, shape, float, -0.99, 0.99))
    return _not_learned(weights, demonstrations)


def _true(patrol: Patrol, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    del key
    weights = np.broadcast_to(patrol.weights, (patrol.patrollers, 1, patrol.mdp.n_features))
    return _not_learned(weights, demonstrations)


def _not_learned(weights: np.ndarray, demonstrations: Sequence[Demonstration]) -> _Learned:
    points = np.array([demonstrations[0].n_trajectories])
    return _Learned(points, weights, np.zeros(1))


def _interpolated_sum(points: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Cumulative cost of running batch again after every session, between the points it was timed at."""
    return np.cumsum(np.interp(np.arange(1, points[-1] + 1), points, seconds))


def _evaluated(
    patrol: Patrol,
    observability: int,
    name: str,
    learned: Sequence[_Learned],
    keys: jax.Array,
    sessions: int,
    trials: int,
) -> MethodResult:
    weights = np.stack([one.weights for one in learned])
    runs, patrollers, n, k = weights.shape
    scores = jax.vmap(partial(evaluate, patrol.mdp, jnp.asarray(patrol.weights)))(
        jnp.asarray(weights).reshape(-1, k)
    )
    shape = (runs * patrollers, n)
    # Everybody is judged by the same fresh demonstrations, learned from by nobody.
    fresh = concatenate(demonstrate(jax.random.key(10**6), patrol, observability, 60, STEPS_PER_SESSION))
    view = patrol.visibility(observability)
    likelihood = lax.map(
        lambda w: jnp.mean(demonstration_log_likelihoods(patrol.mdp, view, w, fresh)),
        jnp.asarray(weights).reshape(-1, k), batch_size=16,
    )  # fmt: skip
    breach = None
    if patrol.breach is not None:
        outcomes = [
            breach_trials(
                jax.random.fold_in(key, 99), patrol, greedy_policies(patrol, weights[i, :, -1]),
                observability=observability, observed_steps=sessions * STEPS_PER_SESSION, trials=trials,
                learning_seconds=float(learned[i].seconds[-1]),
            )
            for i, key in enumerate(keys)
        ]  # fmt: skip
        breach = BreachOutcome(
            np.concatenate([o.ended for o in outcomes]), np.concatenate([o.waited for o in outcomes]),
            float(np.mean([o.threshold for o in outcomes])),
        )  # fmt: skip
    return MethodResult(
        name, learned[0].points, weights, np.asarray(scores.accuracy.overall).reshape(shape),
        np.asarray(scores.accuracy.choice).reshape(shape), np.asarray(scores.error.relative).reshape(shape),
        np.asarray(likelihood).reshape(shape), np.stack([one.seconds for one in learned]), breach,
    )  # fmt: skip


def _stretch(key: jax.Array, patrol: Patrol, observability: int, weights: np.ndarray) -> Stretch:
    """One round of a patroller that was not learned from, and what the learned weights say about it."""
    policy = jnp.log(jnp.asarray(patrol.expert_policy()))[None]
    first, walk, look = jax.random.split(key, 3)
    # Started in view, so that the first hidden gap lies between two sightings.
    inside = jnp.asarray(patrol.views[observability]) & (patrol.mdp.initial > 0)
    start = jax.random.categorical(first, jnp.where(inside, 0.0, -jnp.inf), shape=(1,))
    states, actions = simulate_patrol(walk, patrol, policy, start, int(1.5 * patrol.loop))
    view = patrol.visibility(observability)
    demonstration = Demonstration.from_codes(np.asarray(observe(look, view, states[0], actions[0]))[None])
    plan = soft_plan(patrol.mdp, reward_of(patrol.mdp, jnp.asarray(weights)))
    posterior = smooth_all(patrol.mdp, plan.log_policy, evidence_of(patrol.mdp, view, demonstration))
    return Stretch(
        np.asarray(posterior.pairs[0].sum(-1)), demonstration.kind[0] == SEEN, np.asarray(states[0])
    )


# -- telling --------------------------------------------------------------------------------------------


def _rows(study: Study) -> list[dict[str, Any]]:
    rows = []
    for m in study.methods:
        learns = m.name not in (RANDOM, TRUE)
        row: dict[str, Any] = {
            "method": m.name,
            "log-likelihood": float(np.median(m.log_likelihood[:, -1])),
            "LBA": float(np.median(m.accuracy[:, -1])),
            "LBA choice states": float(np.median(m.choice_accuracy[:, -1])),
            "ILE": float(np.median(m.error[:, -1])),
            "success": m.breach.rate(REACHED) if m.breach else None,
            "success interval": m.breach.interval(REACHED) if m.breach else None,
            "time-outs": m.breach.rate(TIMED_OUT) if m.breach else None,
            "seconds": float(np.median(m.seconds[:, -1])) if learns else None,
            "seconds per session": float(np.median(m.seconds[:, -1]) / study.sessions) if learns else None,
        }
        if m.name == BATCH:
            # Batch has no sessions: its share of one run over everything would flatter it.
            row["seconds per session"] = float(np.median(m.seconds[:, -1]))
        rows.append(row)
    return rows


def summary(study: Study) -> dict[str, Any]:
    """The study's settings and results as plain data."""
    return {
        "patrol": study.patrol.name,
        "observability": study.observability,
        "sessions": study.sessions,
        "trials": study.trials,
        "runs": study.runs,
        "seed": study.seed,
        "methods": _rows(study),
    }


_HEADINGS = (
    "method",
    "LBA",
    "LBA, choice states",
    "ILE",
    "success (95 % interval)",
    "time-outs",
    "s / session",
)


def _cells(study: Study) -> list[tuple[str, ...]]:
    def percent(x: float | None) -> str:
        return "-" if x is None else f"{100 * x:.1f} %"

    cells: list[tuple[str, ...]] = []
    for row in _rows(study):
        interval = row["success interval"]
        success = percent(row["success"])
        if interval is not None:
            success += f" ({100 * interval[0]:.0f}-{100 * interval[1]:.0f})"
        seconds = row["seconds per session"]
        cells.append((
            row["method"], percent(row["LBA"]), percent(row["LBA choice states"]), f"{row['ILE']:.4f}",
            success, percent(row["time-outs"]), "-" if seconds is None else f"{seconds:.4f}",
        ))  # fmt: skip
    return cells


_CAPTION = (
    "Medians over runs and patrollers. LBA: learned behaviour accuracy. ILE: inverse learning error "
    "relative to the optimal value. Seconds: all patrollers together; for batch, those of one run over "
    "everything, spent again at each session."
)


def print_table(study: Study, console: Console) -> None:
    """Print the results."""
    from rich.table import Table as RichTable

    table = RichTable(title=_title(study), caption=_CAPTION, caption_justify="left")
    for i, heading in enumerate(_HEADINGS):
        table.add_column(heading, justify="left" if i == 0 else "right")
    for row in _cells(study):
        table.add_row(*row)
    console.print(table)


def _title(study: Study) -> str:
    return (
        f"{study.patrol.name}, {study.observability} % in view, {study.sessions} sessions, "
        f"{study.runs} runs of {study.trials} breaches"
    )


def write(study: Study, folder: Path | str) -> Path:
    """Write the report: ``index.html``, the pictures in both themes, and ``results.json``."""
    folder = Path(folder)
    first = study.methods[0]
    policy = greedy_policies(study.patrol, first.weights[0, :1, -1])[0]
    drawings: list[tuple[str, Callable[[Theme], Any], str, str]] = [
        (
            "policy", lambda theme: policy_map(
                study.patrol, np.exp(np.asarray(policy)), study.observability, theme=theme,
                title=f"Policy of {first.name}",
            ),
            "What the first patroller is believed to do in every state; tinted cells are in view.",
            "Map of the patrol with the learned policy as arrows",
        ),
        (
            "hidden-path", lambda theme: hidden_path(
                study.patrol, study.stretch.posterior, study.stretch.seen, study.stretch.path, theme=theme
            ),
            "A stretch of patrol nobody learned from: belief about the hidden steps, given the seen ones.",
            "Probability of each cell over time, with the true path",
        ),
    ]  # fmt: skip
    learning = [m for m in study.methods if m.name not in (RANDOM, TRUE)]
    if learning:
        curves = [LearningCurve(m.name, m.points, m.accuracy, m.log_likelihood) for m in learning]
        drawings.append((
            "learning", lambda theme: learning_curves(curves, theme=theme),
            "Accuracy of the learned behaviour, and likelihood of fresh demonstrations, as sessions go by.",
            "Accuracy and log-likelihood against sessions",
        ))  # fmt: skip
        times = [
            LearningTime(m.name if m.name != BATCH else "batch LME, one run", m.points, m.seconds)
            for m in learning
        ]
        if study.batch_rerun_seconds is not None:
            every = np.arange(1, study.sessions + 1)
            times.append(
                LearningTime("batch LME, again after every session", every, study.batch_rerun_seconds)
            )
        drawings.append((
            "time", lambda theme: learning_time(times, theme=theme),
            "Learning time of all patrollers together, without compilation. Batch was timed at three points; "
            "running it after every session is summed by interpolation between them.",
            "Learning time against trajectories",
        ))  # fmt: skip
    breached = [m for m in study.methods if m.breach is not None]
    if breached:
        rates = [
            SuccessRate(m.name, int((ended == REACHED).sum()), int((ended == TIMED_OUT).sum()), len(ended))
            for m in breached
            if m.breach is not None
            for ended in [m.breach.ended]
        ]
        drawings.append((
            "success", lambda theme: success_rates(rates, theme=theme),
            "Share of simulated breaches that reached a goal unseen, and that timed out.",
            "Success and time-out rates by method",
        ))  # fmt: skip
    pictures = []
    for name, draw, caption, description in drawings:
        light, dark = save_themes(draw, folder, name)
        pictures.append(Picture(light, dark, caption, description))
    table = Table(_HEADINGS, _cells(study), _CAPTION)
    (folder / "results.json").write_text(json.dumps(summary(study), indent=2) + "\n")
    sections = [Section(_title(study), "", [table], pictures)]
    if study.determined:
        names = (
            ("the patroller",)
            if len(study.determined) == 1
            else ("the first patroller", "the second patroller")
        )
        sections.append(identifiability_section(dict(zip(names, study.determined, strict=True))))
    return write_report(folder, sections, title="Patrol")
