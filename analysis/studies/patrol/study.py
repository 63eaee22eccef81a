"""Main study: learn a patrol's rewards online through a keyhole, and walk past the patrollers undetected."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ....domains.patrol.process import SECONDS_PER_STEP, Patrol, demonstrate, instance, simulate_patrol
from ....domains.patrol.trials import (
    REACHED,
    TIMED_OUT,
    BreachOutcome,
    Watching,
    breach_trials,
    greedy_policies,
)
from ....inference.completion.smoothing import evidence_of, smooth_all
from ....inference.learners.lme import batch_lme, lme_i2rl, lme_i2rl_with_random_weights
from ....inference.sessions.learner import Learner
from ....inference.sessions.running import run_sessions
from ....models.inputs.text import counted
from ....models.observation.demonstration import SEEN, Demonstration, concatenate
from ....models.observation.evidence import observe
from ....models.process.planning import reward_of, soft_plan
from ...drawing.charts import (
    LearningCurve,
    LearningTime,
    SuccessRate,
    learning_curves,
    learning_time,
    success_rates,
)
from ...drawing.maps import hidden_path, policy_map
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.style import Theme
from ...drawing.text import listed, number
from ...judging.metrics import chance_accuracy, demonstration_log_likelihoods, evaluate
from ...posteriors.identifiability import Identifiability, identifiability_of, identifiability_section

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

ONLINE, FORGETFUL, BATCH, RANDOM, TRUE = (
    "LME-I2RL",
    "LME-I2RL with random weights",
    "batch LME",
    "random weights",
    "true policy",
)
# Names on the command line.
METHODS = {"lme-i2rl": ONLINE, "batch": BATCH, "random": RANDOM}
STEPS_PER_SESSION = 5
# Numbers of trajectories at which batch is timed and judged.
BATCH_POINTS = 7
# Lengths that the true weights are stretched to.
STRETCHES = 2.0 ** np.arange(-2, 14)

Advance = Callable[[str, float | None], None]


class MethodResult(NamedTuple):
    """Results of a method; the first axis ranges over independent replications and the patrollers of each.

    Fields
    ------
    name : str
    points : int ``[T]``
        Sessions at which the rest was measured.
    weights : float ``[replications, patrollers, T, K]``
    accuracy, choice_accuracy : float ``[replications * patrollers, T]``
        LBA over all states and over states with a choice.
    error : float ``[replications * patrollers, T]``
        ILE relative to the value of the optimal policy.
    log_likelihood : float ``[replications * patrollers, T]``
        Exact, of fresh demonstrations; nats per trajectory.
    seconds : float ``[replications, T]``
        Learning time up to there, all patrollers together.
    breach : BreachOutcome or None
        All replications' trials together.
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
    """Study of one patrol: settings, the methods' results, and one stretch observed by the first learner."""

    patrol: Patrol
    observability: int
    sessions: int
    trials: int
    replications: int
    seed: int
    methods: tuple[MethodResult, ...]
    batch_rerun_seconds: np.ndarray | None
    stretch: Stretch
    determined: tuple[Identifiability, ...]
    chance: Float[np.ndarray, " draws"]
    truth: TrueLikelihood


class TrueLikelihood(NamedTuple):
    """Log-likelihood of the true weights at several lengths: an expert who never errs gives them none.

    Fields
    ------
    lengths : float ``[L]``
        Factors that the true weights are multiplied by.
    values : float ``[L]``
        Of the fresh demonstrations that methods are judged by; nats per trajectory.
    """

    lengths: Float[np.ndarray, " L"]
    values: Float[np.ndarray, " L"]

    @property
    def as_given(self) -> float:
        """At the true weights themselves."""
        return float(self.values[self.lengths == 1][0])

    @property
    def best(self) -> tuple[float, float]:
        """The length with the highest likelihood, and that."""
        i = int(np.argmax(self.values))
        return float(self.lengths[i]), float(self.values[i])


class Stretch(NamedTuple):
    """A fresh stretch of patrol, the belief about it, and the truth."""

    posterior: Float[np.ndarray, "L S"]
    seen: np.ndarray
    path: np.ndarray


def patrol_study(
    number: int = 2,
    observability: int | None = None,
    *,
    sessions: int = 60,
    trials: int = 200,
    replications: int = 3,
    seed: int = 0,
    methods: Sequence[str] | None = None,
    advance: Advance = lambda description, fraction: None,
) -> Study:
    """Learn, evaluate and (instances 2 and 3) breach.

    ``replications`` independent demonstrations are learned from, one learner per patroller; each learned set
    of policies then tries ``trials`` breaches, with the time it took to learn on the clock. ``methods`` names
    some of ``lme-i2rl``, ``batch`` and ``random`` (all by default). Raises ``ValueError`` for an instance,
    observability or method that does not exist.

    See Also
    --------
    i2rl.analysis.methods_study : methods in full view
    i2rl.domains.breach_trials : the breaches alone

    Examples
    --------
    >>> from i2rl.analysis import patrol_study
    >>> study = patrol_study(2, sessions=2, trials=5, replications=1, methods=["random"])
    >>> [result.name for result in study.methods]
    ['random weights', 'true policy']
    >>> study.methods[-1].breach.ended.shape
    (5,)
    """
    patrol = instance(number)
    observability = patrol.observability if observability is None else observability
    view = patrol.visibility(observability)
    unknown = [m for m in methods or () if m not in METHODS]
    if unknown:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {unknown[0]!r}")
    wanted = {METHODS[m] for m in methods} if methods else {ONLINE, FORGETFUL, BATCH, RANDOM}
    keys = jax.random.split(jax.random.key(seed), replications)
    data = [demonstrate(k, patrol, observability, sessions, STEPS_PER_SESSION) for k in keys]
    learners = {
        ONLINE: partial(_online, lme_i2rl(patrol.mdp, view)),
        FORGETFUL: partial(_online, lme_i2rl_with_random_weights(patrol.mdp, view)),
        BATCH: partial(_batch, batch_lme(patrol.mdp, view), set()),
        RANDOM: partial(_random, patrol),
        TRUE: partial(_true, patrol),
    }
    names = [n for n in learners if n in wanted or n == TRUE]
    learned: dict[str, list[_Learned]] = {}
    for name in names:
        advance(f"learning: {name}", len(learned) / (2 * len(names)))
        learned[name] = [
            learners[name](k, demonstrations) for k, demonstrations in zip(keys, data, strict=True)
        ]
    batches = learned.get(BATCH)
    rerun = np.stack([_interpolated_sum(b.points, b.seconds) for b in batches]) if batches else None
    first = names[0]
    weights = learned[first][0].weights
    # The directions that the first replication's demonstrations determine, for each patroller learned.
    known = data[0] if first not in (RANDOM, TRUE) else ()
    # Learning was timed alone; nothing below is timed.
    with _threads() as pool:

        def judge(name: str) -> Future[MethodResult]:
            return pool.submit(_evaluated, patrol, observability, name, learned[name], keys, sessions, trials)

        judged = {first: judge(first)}  # compiles what the others run
        stretch = pool.submit(_stretch, jax.random.fold_in(keys[0], 7), patrol, observability, weights[0, -1])
        determined = pool.submit(
            lambda: tuple(
                identifiability_of(patrol.mdp, view, demonstration, jnp.asarray(mine[-1]))
                for demonstration, mine in zip(known, weights, strict=False)
            )
        )
        chance = pool.submit(
            chance_accuracy, jax.random.fold_in(keys[0], 200), patrol.mdp, jnp.asarray(patrol.weights)
        )
        stretched = pool.submit(
            _likelihoods, patrol, observability, STRETCHES[:, None] * np.asarray(patrol.weights)
        )
        judged |= {name: judge(name) for name in names[1:]}
        results: list[MethodResult] = []
        for name in names:
            advance(f"breaching: {name}", 0.5 + len(results) / (2 * len(names)))
            results.append(judged[name].result())
        truth = TrueLikelihood(STRETCHES, stretched.result())
        others = stretch.result(), determined.result(), chance.result(), truth
    advance("done", 1.0)
    return Study(
        patrol,
        observability,
        sessions,
        trials,
        replications,
        seed,
        tuple(results),
        rerun,
        *others,
    )


@contextmanager
def _threads() -> Iterator[ThreadPoolExecutor]:
    """Yield two threads, and let go of what has not begun if the study is interrupted."""
    pool = ThreadPoolExecutor(2)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


class _Learned(NamedTuple):
    """Results of one replication of one method: sessions ``[T]``, ``weights [P, T, K]``, cumulative "
    "seconds ``[T]``."""

    points: np.ndarray
    weights: np.ndarray
    seconds: np.ndarray


def _online(learner: Learner, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    # One session first, unrecorded, so that compilation is not counted as learning.
    learner.update(learner.init(key), demonstrations[0].select([0]))
    replications = [
        run_sessions(learner, d.sessions(), key=jax.random.fold_in(key, p)).infos
        for p, d in enumerate(demonstrations)
    ]
    weights = np.array([[r.weights for r in reports] for reports in replications])
    seconds = np.cumsum(np.sum([[r.seconds for r in reports] for reports in replications], axis=0))
    return _Learned(np.arange(1, weights.shape[1] + 1), weights, seconds)


def _batch(
    batch: Any, compiled: set[tuple[int, ...]], key: jax.Array, demonstrations: Sequence[Demonstration]
) -> _Learned:
    import time

    n = demonstrations[0].n_trajectories
    points = np.unique(np.geomspace(min(5, n), n, BATCH_POINTS).round().astype(int))
    weights, seconds = [], []
    for count in points:
        part = [d.select(slice(0, int(count))) for d in demonstrations]
        if (size := part[0].bucketed().kind.shape) not in compiled:  # before the clock starts
            batch.fit(key, part[0])
            compiled.add(size)
        began = time.perf_counter()
        fits = [batch.fit(key, d) for d in part]
        seconds.append(time.perf_counter() - began)
        weights.append([fit.weights for fit in fits])
    return _Learned(points, np.swapaxes(weights, 0, 1), np.array(seconds))


def _random(patrol: Patrol, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    shape = (patrol.patrollers, 1, patrol.mdp.n_features)
    weights = np.asarray(jax.random.uniform(key, shape, float, -0.99, 0.99))
    return _not_learned(weights, demonstrations)


def _likelihoods(
    patrol: Patrol, observability: int, weights: Float[np.ndarray, "n K"]
) -> Float[np.ndarray, " n"]:
    """Compute nats per trajectory of fresh demonstrations, the same for all methods."""
    fresh = concatenate(demonstrate(jax.random.key(10**6), patrol, observability, 60, STEPS_PER_SESSION))
    view = patrol.visibility(observability)
    each = demonstration_log_likelihoods(patrol.mdp, view, jnp.asarray(weights), fresh)
    return np.asarray(each).mean(axis=1)


def _true(patrol: Patrol, key: jax.Array, demonstrations: Sequence[Demonstration]) -> _Learned:
    del key
    weights = np.broadcast_to(patrol.weights, (patrol.patrollers, 1, patrol.mdp.n_features))
    return _not_learned(weights, demonstrations)


def _not_learned(weights: np.ndarray, demonstrations: Sequence[Demonstration]) -> _Learned:
    points = np.array([demonstrations[0].n_trajectories])
    return _Learned(points, weights, np.zeros(1))


def _interpolated_sum(points: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Interpolate the cumulative cost of a batch run after every session, between its timed points."""
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
    replications, patrollers, n, k = weights.shape
    scores = evaluate(patrol.mdp, jnp.asarray(patrol.weights), jnp.asarray(weights).reshape(-1, k))
    shape = (replications * patrollers, n)
    likelihood = _likelihoods(patrol, observability, weights.reshape(-1, k))
    breach = None
    if patrol.breach is not None:
        outcomes = [
            breach_trials(
                jax.random.fold_in(key, 99),
                patrol,
                greedy_policies(patrol, weights[i, :, -1]),
                watching=Watching(observability, sessions * STEPS_PER_SESSION, float(learned[i].seconds[-1])),
                trials=trials,
            )
            for i, key in enumerate(keys)
        ]
        breach = BreachOutcome(
            np.concatenate([o.ended for o in outcomes]),
            np.concatenate([o.waited for o in outcomes]),
            float(np.mean([o.threshold for o in outcomes])),
        )
    return MethodResult(
        name,
        learned[0].points,
        weights,
        np.asarray(scores.accuracy.overall).reshape(shape),
        np.asarray(scores.accuracy.choice).reshape(shape),
        np.asarray(scores.error.relative).reshape(shape),
        likelihood.reshape(shape),
        np.stack([one.seconds for one in learned]),
        breach,
    )


def _stretch(key: jax.Array, patrol: Patrol, observability: int, weights: np.ndarray) -> Stretch:
    """Simulate one round of a patroller outside the training data, and its posterior under the learned
    weights.
    """
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
    """Return the study's settings and results as plain data."""
    reward: dict[str, Any] = {
        "features": list(study.patrol.mdp.feature_names),
        "true weights": study.patrol.weights,
        "learned, first replication": [
            {"patroller": who, "method": study.methods[0].name, "weights": found.estimates.summary()}
            for who, found in _by_patroller(study).items()
        ],
        "by method, replication and patroller": {m.name: m.weights[:, :, -1] for m in study.methods},
    }
    told: dict[str, Any] = plain(
        {
            "provenance": study_provenance(study.seed),
            "patrol": study.patrol.name,
            "observability": study.observability,
            "sessions": study.sessions,
            "trials": study.trials,
            "replications": study.replications,
            "seed": study.seed,
            "methods": _rows(study),
            "reward": reward,
            "random weights": {"draws": len(study.chance), "LBA": np.sort(study.chance)},
            "true weights": study.truth._asdict(),
        }
    )
    return told


_HEADINGS = (
    "method",
    "LBA",
    "LBA, choice states",
    "ILE",
    "nats a trajectory",
    "success (95 % interval)",
    "time-outs",
    "s / session",
)


def _percent(x: float | None, digits: int = 1) -> str:
    return "-" if x is None else f"{100 * x:.{digits}f} %"


def _results_table(study: Study) -> Table:
    cells: list[tuple[str, ...]] = []
    for row in _rows(study):
        interval = row["success interval"]
        success = _percent(row["success"])
        if interval is not None:
            success += f" ({100 * interval[0]:.0f}-{100 * interval[1]:.0f})"
        cells.append(
            (
                row["method"],
                _percent(row["LBA"]),
                _percent(row["LBA choice states"]),
                f"{row['ILE']:.4f}",
                f"{row['log-likelihood']:.3f}",
                success,
                _percent(row["time-outs"]),
                number(row["seconds per session"]),
            )
        )
    return Table(_HEADINGS, cells, _CAPTION)


_CAPTION = (
    "Medians over replications and patrollers. ILE is relative to the optimal value. Nats: log-likelihood of "
    "fresh "
    "demonstrations. Seconds: all patrollers together; for batch, those of one run over everything, spent "
    "again at each session."
)


def print_tables(study: Study, console: Console) -> None:
    """Print the results."""
    print_page_tables([_results_table(study)], console, _settings(study))


def _settings(study: Study) -> str:
    told = (
        f"{study.patrol.name}, {study.observability} % in view, {counted(study.sessions, 'session')} of "
        f"{STEPS_PER_SESSION} steps, {counted(study.replications, 'replication')}"
    )
    return told if study.patrol.breach is None else f"{told} of {counted(study.trials, 'breach')}"


# -- the page -------------------------------------------------------------------------------------------


def _by_patroller(study: Study) -> dict[str, Identifiability]:
    names = (
        ("the patroller",) if len(study.determined) == 1 else ("the first patroller", "the second patroller")
    )
    return dict(zip(names, study.determined, strict=False))


def _lead(study: Study) -> Lead:
    first, row = study.methods[0], _rows(study)[0]
    if not study.determined:
        return Lead(
            f"No learning here: {listed([m.name for m in study.methods])} were only measured.",
            "Trust the numbers as those of a control.",
        )
    whose = "the patroller's reward" if len(study.determined) == 1 else "the rewards of both patrollers"
    learned = (
        f"From {counted(study.sessions, 'session')} with {study.observability} % of {study.patrol.name} in "
        f"view, {first.name} learned {whose}: the optimal policy of the learned weights agrees with the "
        "expert in "
        f"{number(100 * row['LBA'])} % of the states and loses {_lost(row['ILE'])} of the value."
    )
    vague = sum(len(found.directions) for found in study.determined)
    total = sum(len(found.features) for found in study.determined)
    weights = (
        "and the demonstrations determine every direction of the weights"
        if not vague
        else f"and the demonstrations leave {'all' if vague == total else f'{vague} of the'} {total} "
        "directions of the weights open, so trust the policy rather than single weights"
    )
    reach = _share_as_good(study)
    trust = (
        f"That accuracy is weak evidence, since {_percent(reach, 0)} of random weights reach it as well; "
        "trust the likelihood of fresh demonstrations instead, "
        if reach > 0.05
        else f"Chance does not explain the accuracy, since {_percent(reach, 1)} of random weights reach it, "
    )
    tables = [
        found.estimates.table(
            f"Weights of {who} that {first.name} learned in the first replication. Intervals are "
            f"those of the "
            "likelihood's curvature there; a reward is known up to its length, hence the shares.",
            np.asarray(study.patrol.weights),
        )
        for who, found in _by_patroller(study).items()
    ]
    return Lead(learned, f"{trust}{weights}.", tables)


def _lost(error: float) -> str:
    return "nothing" if error < 5e-7 else f"{number(100 * error)} %"


def _share_as_good(study: Study) -> float:
    """Compute the share of random weights whose LBA is that of the first method, or more."""
    return float(np.mean(study.chance >= np.median(study.methods[0].accuracy[:, -1]) - 1e-9))


def _text(study: Study) -> str:
    first = study.methods[0]
    reached, median = np.median(first.accuracy[:, -1]), float(np.median(study.chance))
    stretched, best = study.truth.best
    learned = float(np.median(first.log_likelihood[:, -1]))
    return f"""Settings: {_settings(study)}.

Chance: of {counted(len(study.chance), "weight vector")} drawn at random, half have an LBA of at least \
{_percent(median)}, and {_percent(_share_as_good(study))} have the {_percent(float(reached))} of \
{first.name} or more. The row of random weights is one draw a patroller and replication.

Likelihood: it is that of a policy that errs less for longer weights, and the patrollers never err. The true \
weights have arbitrary units. As given they reach {number(study.truth.as_given)} nats a \
trajectory, stretched {number(stretched)} times {number(best)}, and {first.name} {number(learned)}. Learned \
weights maximise the likelihood of the observations, their length included; the true weights do not, so a \
likelihood above theirs is consistent."""


def write(study: Study, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    first = study.methods[0]
    policy = greedy_policies(study.patrol, first.weights[0, :1, -1])[0]
    pictures = [
        drawn(
            folder,
            "policy",
            lambda theme: policy_map(
                study.patrol.mdp,
                np.exp(np.asarray(policy)),
                study.patrol.layout,
                weights=study.patrol.weights,
                in_view=study.patrol.views[study.observability],
                theme=theme,
                title=f"Policy of {first.name}",
                note=f"{study.patrol.name}, {study.observability} % observability",
            ),
            "What the first patroller is believed to do in every state; tinted cells are in view.",
            "Map of the patrol with the learned policy as arrows",
        ),
        drawn(
            folder,
            "hidden-path",
            lambda theme: hidden_path(
                study.stretch.posterior,
                study.stretch.seen,
                study.patrol.layout,
                study.stretch.path,
                seconds=SECONDS_PER_STEP,
                theme=theme,
                title=f"Where the patroller may have been ({study.patrol.name})",
            ),
            "A stretch of patrol outside the training data: belief about its hidden steps.",
            "Probability of each cell over time, with the true path",
        ),
    ]
    learning = [m for m in study.methods if m.name not in (RANDOM, TRUE)]
    if learning:
        curves = [LearningCurve(m.name, m.points, m.accuracy, m.log_likelihood) for m in learning]
        pictures.append(
            drawn(
                folder,
                "learning",
                lambda theme: learning_curves(curves, theme=theme),
                "Accuracy of the learned behaviour and likelihood of fresh demonstrations, by session.",
                "Accuracy and log-likelihood against sessions",
            )
        )
        pictures.append(
            drawn(
                folder,
                "time",
                partial(_draw_time, study, learning),
                "Learning time of all patrollers together, without compilation. Running batch after every "
                f"session is summed by interpolation between its {BATCH_POINTS} timed points.",
                "Learning time against trajectories",
            )
        )
    rates = [
        SuccessRate(m.name, int((ended == REACHED).sum()), int((ended == TIMED_OUT).sum()), len(ended))
        for m in study.methods
        if m.breach is not None
        for ended in [m.breach.ended]
    ]
    if rates:
        pictures.append(
            drawn(
                folder,
                "success",
                lambda theme: success_rates(rates, theme=theme),
                "Share of simulated breaches that reached a goal undetected, and that timed out.",
                "Success and time-out rates by method",
            )
        )
    sections = [Section("Results", _text(study), [_results_table(study)], pictures)]
    if study.determined:
        sections.append(identifiability_section(_by_patroller(study)))
    title = f"Rewards of {study.patrol.name}'s patrollers"
    return write_page(folder, title, _lead(study), sections, summary(study))


def _draw_time(study: Study, learning: Sequence[MethodResult], theme: Theme) -> Figure:
    times = [
        LearningTime(m.name if m.name != BATCH else "batch LME, once", m.points, m.seconds) for m in learning
    ]
    if study.batch_rerun_seconds is not None:
        every = np.arange(1, study.sessions + 1)
        times.append(LearningTime("batch LME, again after every session", every, study.batch_rerun_seconds))
    return learning_time(times, theme=theme)
