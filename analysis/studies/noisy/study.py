"""Study of learning through noisy perception (section 7.4.3): the learned sensor and behaviour.

Every method learns from the same simulated observations, many streams of them; learners that compile run all
their streams in one program. The sensor is judged by agreement probabilities, the behaviour by learned
behaviour accuracy (LBA).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ....domains.noisy.tasks import (
    NoisyDemonstration,
    NoisyTask,
    Starts,
    agreement_probabilities,
    demonstrate_noisy,
    noisy_patrol,
    noisy_sorting,
)
from ....domains.patrol.process import instance
from ....inference.learners.identification import sensor_identifier
from ....inference.learners.lme import lme_i2rl
from ....inference.learners.maximum_likelihood import mlirl
from ....inference.learners.noisy import DEFAULT_ITERATIONS, DEFAULT_RIDGE, rifom, rimeo, robust_irl
from ....inference.sensors.reliabilities import WithTruth
from ....inference.sessions.fleets import run_streams
from ....inference.sessions.learner import Learner
from ....inference.sessions.running import run_sessions
from ....models.observation.demonstration import SEEN, Demonstration
from ....models.observation.evidence import AnySensor, Sensor, Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import deterministic_policy, hard_plan, reachable_states, reward_of
from ...judging.metrics import chance_accuracy, optimal_actions
from ..sorting.table import SortingTable
from .examples import BELTS, SensorPosterior, Strip, sensor_posterior, sorted_belts, strip

Advance = Callable[[str, float | None], None]
TASKS: Mapping[str, Callable[[], NoisyTask]] = {"sorting": noisy_sorting, "patrol": noisy_patrol}
TRAJECTORIES, STEPS = 2, 3
# With most states hidden, three steps from anywhere are mostly hidden.
HIDDEN_STEPS = 10
OBSERVABILITY = 30
# Methods that do not compile, or learn once from everything, get so many of the streams.
FEW = 10
# The dissertation's divergence settles after so many sessions.
EARLY = 6

PLAIN, AVERAGED, STEPWISE = "RIMEO, no scores", "RIMEO, scores averaged", "RIMEO, scores stepwise"
BARE = "RIMEO, predicates alone"
ORACLE, OBSERVED, ALL = "oracle", "observed", "all, as printed"
FAIR, CODED = "RIFOM", "RIFOM, as coded"
KNOWN, CLEAR = "true sensor", "no noise"
ROBUST, MLIRL = "Robust IRL, batch", "MLIRL, batch"
HIDDEN, BOTH = "hidden", "hidden and noisy"
TIMED = (PLAIN, AVERAGED, STEPWISE, FAIR)
# Learners whose sensor is asked whether the expert's errors could be its own, and their scores.
DOUBTED = {PLAIN: "none", STEPWISE: "stepwise"}
STATES = ("all", "choice", "reachable")

# Chances that are not quite zero or one, so that a wrong certainty costs much but not everything.
_SURE = 1e-12


def divergence(
    truth: Float[np.ndarray, " J"], estimate: Float[np.ndarray, "... J"]
) -> Float[np.ndarray, "..."]:
    """Compute the mean over predicates of ``KL(Bernoulli(truth) || Bernoulli(estimate))``, in nats."""
    p, q = np.asarray(truth, float), np.clip(np.asarray(estimate, float), _SURE, 1 - _SURE)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = np.where(p > 0, p * np.log(p / q), 0.0)
        wrong = np.where(p < 1, (1 - p) * np.log((1 - p) / (1 - q)), 0.0)
    mean: np.ndarray = np.maximum(right + wrong, 0.0).mean(-1)
    return mean


class MeanInterval(NamedTuple):
    """A mean over replications and its 95 % interval."""

    mean: Float[np.ndarray, "..."]
    low: Float[np.ndarray, "..."]
    high: Float[np.ndarray, "..."]


def mean_interval(replications: Float[np.ndarray, "replications ..."]) -> MeanInterval:
    """Compute the mean over the first axis with a normal interval; its ends are NaN for one replication."""
    replications = np.asarray(replications, float)
    mean, n = replications.mean(0), len(replications)
    half = 1.96 * replications.std(0, ddof=1) / np.sqrt(n) if n > 1 else np.full_like(mean, np.nan)
    return MeanInterval(mean, mean - half, mean + half)


class Streams(NamedTuple):
    """Learners' data: ``seen`` and ``truth`` with arrays ``[replications, sessions, trajectories, steps]``.

    ``mdp`` is the process with the start that was simulated.
    """

    seen: Demonstration
    truth: Demonstration
    mdp: TabularMDP

    def session(self, run: int, session: int, of: str = "seen") -> Demonstration:
        """One session, counted from zero."""
        return Demonstration(*(np.asarray(x)[run, session] for x in getattr(self, of).arrays))

    def whole(self, run: int, of: str = "seen") -> Demonstration:
        """Return all trajectories of a replication."""
        arrays = getattr(self, of).arrays
        return Demonstration(*(np.asarray(x)[run].reshape(-1, x.shape[-1]) for x in arrays))


def draw_streams(
    key: Array,
    task: NoisyTask,
    *,
    replications: int,
    sessions: int,
    starts: Starts = "all",
    steps: int = STEPS,
    noise: AnySensor | None = None,
    visibility: Visibility | None = None,
) -> Streams:
    """Simulate independent streams with calibrated scores, all trajectories drawn in one go.

    Raises ``ValueError`` as :func:`demonstrate_noisy` does.
    """
    drawn = demonstrate_noisy(
        key,
        task,
        noise,
        sessions=replications * sessions,
        trajectories=TRAJECTORIES,
        steps=steps,
        starts=starts,
        scores="calibrated",
        visibility=visibility,
    )
    shape = (replications, sessions, TRAJECTORIES, steps)
    seen, truth = (
        Demonstration(*(np.asarray(x).reshape(shape) for x in d.arrays)) for d in (drawn.seen, drawn.truth)
    )
    return Streams(seen, truth, drawn.mdp)


class MethodResult(NamedTuple):
    """Result of one method on its streams.

    Fields
    ------
    name : str
    sessions : int ``[T]``
        Sessions after which it was measured.
    weights : float ``[replications, T, K]``
    agreement : float ``[replications, T, J]`` or None
        Learned agreement probabilities of the learner's predicates, the task's first.
    divergence : float ``[replications, T]`` or None
        Divergence from the true probabilities, mean over predicates, in nats.
    accuracy : float ``[replications, T, 3]``
        LBA over :data:`STATES`.
    state
        The learner's final states (leading axis: replications), None for those that have none.
    """

    name: str
    sessions: Int[np.ndarray, " T"]
    weights: Float[np.ndarray, "replications T K"]
    agreement: Float[np.ndarray, "replications T J"] | None
    divergence: Float[np.ndarray, "replications T"] | None
    accuracy: Float[np.ndarray, "replications T 3"]
    state: Any = None


class SensorDoubt(NamedTuple):
    """Identification of the learned sensors, by replication: see
    :mod:`i2rl.inference.learners.identification`.

    Fields
    ------
    erratic, optimal : float ``[replications, J]``
        Agreement of the task's predicates, by the assumption about the expert.
    identified : bool ``[replications, J]``
    """

    erratic: Float[np.ndarray, "replications J"]
    optimal: Float[np.ndarray, "replications J"]
    identified: Bool[np.ndarray, "replications J"]

    @property
    def known(self) -> float:
        """Share of replications in which all predicates are identified."""
        return float(self.identified.all(1).mean())


class NoisyStudy(NamedTuple):
    """Settings, streams and results.

    Fields
    ------
    task : NoisyTask
    starts, replications, sessions, seed
    streams : Streams
    true_agreement : float ``[J]``
        Of the task's predicates, among the expert's pairs.
    states : bool ``[3, S]``
        Over which accuracy is averaged, see :data:`STATES`.
    results : mapping from a method's name to MethodResult
    seconds : mapping from a method's name to float
        Median of a session once compiled, for :data:`TIMED`.
    doubt : mapping from a method's name to SensorDoubt
        For :data:`DOUBTED`, on the first :data:`FEW` streams.
    hidden : mapping, or None
        Where most of the patrol is out of view: results with noise and without.
    posterior : SensorPosterior or None
        Of the first stream's first :data:`EARLY` sessions.
    strip : Strip
        Another trajectory, as the learner of the first stream understands it in the end.
    belts : SortingTable or None
        Of the sorting task.
    chance : float ``[draws]``
        LBA over all states of random weights.
    """

    task: NoisyTask
    starts: Starts
    replications: int
    sessions: int
    seed: int
    streams: Streams
    true_agreement: Float[np.ndarray, " J"]
    states: Bool[np.ndarray, "3 S"]
    results: Mapping[str, MethodResult]
    seconds: Mapping[str, float]
    doubt: Mapping[str, SensorDoubt]
    hidden: Mapping[str, MethodResult] | None
    posterior: SensorPosterior | None
    strip: Strip
    belts: SortingTable | None
    chance: Float[np.ndarray, " draws"]

    @property
    def control(self) -> float:
        """Divergence of the constant estimate one half."""
        return float(divergence(self.true_agreement, np.full_like(self.true_agreement, 0.5)))


# -- methods ------------------------------------------------------------------------------------------


class _Entry(NamedTuple):
    """Learner of a study, its input, and whether it estimates agreement."""

    learner: Callable[[TabularMDP, NoisyTask], Learner]
    fed: str = "seen"
    perceives: bool = True


def _plain_learner(mdp: TabularMDP, sensor: AnySensor) -> Learner:
    """Build maximum-entropy IRL with RIMEO's settings and a known sensor."""
    return lme_i2rl(mdp, sensor, slack=0.0, ridge=DEFAULT_RIDGE, iterations=DEFAULT_ITERATIONS)


LEARNERS: Mapping[str, _Entry] = {
    PLAIN: _Entry(lambda mdp, task: rimeo(mdp, task.features, scores="none")),
    AVERAGED: _Entry(lambda mdp, task: rimeo(mdp, task.features, scores="averaged")),
    STEPWISE: _Entry(lambda mdp, task: rimeo(mdp, task.features, scores="stepwise")),
    BARE: _Entry(lambda mdp, task: rimeo(mdp, task.predicates, scores="none")),
    ORACLE: _Entry(lambda mdp, task: rimeo(mdp, task.features, scores="none", completion="oracle"), "both"),
    OBSERVED: _Entry(lambda mdp, task: rimeo(mdp, task.features, scores="none", completion="observed")),
    FAIR: _Entry(lambda mdp, task: rifom(mdp, task.features)),
    CODED: _Entry(lambda mdp, task: rifom(mdp, task.predicates, form="coded")),
    ALL: _Entry(lambda mdp, task: rimeo(mdp, task.predicates, completion="all")),
    KNOWN: _Entry(lambda mdp, task: _plain_learner(mdp, task.noise), perceives=False),
    CLEAR: _Entry(lambda mdp, task: _plain_learner(mdp, Sensor()), "truth", perceives=False),
}
METHODS = (*LEARNERS, ROBUST, MLIRL)


class _Judge(NamedTuple):
    """Truth with which learned agreement and weights are compared."""

    task: NoisyTask
    true_agreement: Float[np.ndarray, " J"]
    states: Bool[np.ndarray, "3 S"]

    def result(
        self,
        name: str,
        sessions: Int[np.ndarray, " T"],
        weights: Any,
        agreement: Any = None,
        state: Any = None,
    ) -> MethodResult:
        weights = np.asarray(weights)
        optimal = optimal_actions(self.task.mdp, jnp.asarray(self.task.weights))
        hits = np.asarray(_hits(self.task.mdp, optimal, jnp.asarray(weights.reshape(-1, weights.shape[-1]))))
        shares = (hits @ self.states.T / self.states.sum(1)).reshape(*weights.shape[:-1], len(STATES))
        if agreement is None:
            return MethodResult(name, sessions, weights, None, None, shares, state)
        agreement = np.asarray(agreement)
        apart = divergence(self.true_agreement, agreement[..., : len(self.true_agreement)])
        return MethodResult(name, sessions, weights, agreement, apart, shares, state)

    def online(
        self, name: str, key: Array, learner: Learner, streams: Streams, entry: _Entry
    ) -> MethodResult:
        """Run a learner on all streams."""
        weights, agreement, state = _learned(key, learner, streams, entry)
        return self.result(name, np.arange(1, streams.seen.kind.shape[1] + 1), weights, agreement, state)

    def batch(self, name: str, key: Array, streams: Streams) -> MethodResult:
        """Run a learner on all sessions of a stream at once, on a few streams."""
        replications, sessions = streams.seen.kind.shape[:2]
        robust = robust_irl(streams.mdp, self.task.noise, slack=0.0, ridge=DEFAULT_RIDGE)
        weights = []
        for run in range(min(replications, FEW)):
            observations, own = streams.whole(run), jax.random.fold_in(key, run)
            if name == ROBUST:
                weights.append(robust.fit(own, observations).weights)
            else:
                weights.append(mlirl(own, *taken_at_face_value(streams.mdp, observations)).weights)
        return self.result(name, np.array([sessions]), np.array(weights)[:, None])


@jax.jit
def _hits(mdp: TabularMDP, optimal: Bool[Array, "S A"], weights: Float[Array, "N K"]) -> Float[Array, "N S"]:
    """Test at which states the greedy policy of each weights agrees with the expert."""

    def one(w: Float[Array, " K"]) -> Float[Array, " S"]:
        policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, w)).optimal)
        return jnp.sum(jnp.where(optimal, policy, 0.0), axis=1)

    # One after another: batched factorisations may wait for one another on a CPU with few threads.
    return lax.map(one, weights)


def _judged_states(task: NoisyTask) -> Bool[np.ndarray, "3 S"]:
    """Return all states, those with a choice, and those reachable from the task's natural start."""
    available = np.asarray(task.mdp.available)
    return np.stack([np.ones(len(available), bool), available.sum(1) > 1, reachable_states(task.mdp)])


def _learned(key: Array, learner: Learner, streams: Streams, entry: _Entry) -> tuple:
    """Return weights and agreement after every session, and the final states."""
    replications = len(streams.seen.kind)
    if learner.session is None:
        kept = [
            _one_by_one(jax.random.fold_in(key, r), learner, streams, r)
            for r in range(min(replications, FEW))
        ]
        weights, agreement = (np.array(x) for x in zip(*kept, strict=True))
        return weights, agreement, None
    fed = {
        "seen": streams.seen,
        "truth": streams.truth,
        "both": WithTruth(streams.seen, streams.truth),
    }[entry.fed]
    keep = partial(_kept, entry.perceives)
    state, (weights, agreement) = run_streams(learner, key, fed, keep)  # type: ignore[arg-type]
    return weights, agreement if entry.perceives else None, state


def _kept(perceives: bool, state: Any, report: Any) -> tuple:
    return report.weights, report.agreement if perceives else report.weights


def _one_by_one(key: Array, learner: Learner, streams: Streams, run: int) -> tuple:
    sessions = streams.seen.kind.shape[1]
    infos: Any = run_sessions(learner, (streams.session(run, t) for t in range(sessions)), key=key).infos
    return [info.weights for info in infos], [info.agreement for info in infos]


def taken_at_face_value(mdp: TabularMDP, observations: Demonstration) -> tuple[TabularMDP, Demonstration]:
    """Take observations for truths, for a learner without a noise model: each pair by itself, anywhere.

    Wrong observations follow one another as no process could, so transitions carry no information;
    unavailable pairs are dropped.
    """
    seen = np.asarray(observations.kind) == SEEN
    states, actions = np.asarray(observations.state)[seen], np.asarray(observations.action)[seen]
    offered = np.asarray(mdp.available)[states, actions]
    anywhere = mdp.with_initial(jnp.full(mdp.n_states, 1 / mdp.n_states))
    return anywhere, Demonstration.from_pairs(states[offered, None], actions[offered, None])


def _doubted(task: NoisyTask, streams: Streams, result: MethodResult, scores: str) -> SensorDoubt:
    identify = sensor_identifier(streams.mdp, task.features, scores=scores)
    found = [
        identify(streams.whole(run), result.weights[run, -1]) for run in range(min(len(result.weights), FEW))
    ]
    n_predicates = len(task.predicates)
    erratic, optimal, identified = (
        np.array([getattr(x, name)[:n_predicates] for x in found])
        for name in ("erratic", "optimal", "identified")
    )
    return SensorDoubt(erratic, optimal, identified)


# -- the study ----------------------------------------------------------------------------------------


class Examples(NamedTuple):
    """Sizes of the examples: simulated ``belts`` of each method, ``draws`` of each chain of the posterior."""

    belts: int = BELTS
    draws: int = 100


class ExampleOptions(TypedDict, total=False):
    """:class:`Examples` as keyword arguments."""

    belts: int
    draws: int


def noisy_study(
    name: str,
    *,
    replications: int = 50,
    sessions: int = 20,
    starts: Starts = "all",
    seed: int = 0,
    methods: Sequence[str] | None = None,
    advance: Advance = lambda description, fraction: None,
    **examples: Unpack[ExampleOptions],
) -> NoisyStudy:
    """Learn the ``"sorting"`` or the ``"patrol"`` task through its noise with every method.

    Parameters
    ----------
    name : {"sorting", "patrol"}
    replications, sessions : int
        Independent streams, and sessions of each: two trajectories of three pairs. Learners in batch, and
        those outside JAX, get the first :data:`FEW` streams.
    starts : {"all", "natural"}
        Trajectories start in all states alike, or where the task naturally does.
    seed : int
    methods : sequence of str, optional
        Some of :data:`METHODS` besides :data:`PLAIN`, which is always there; all by default.
    belts : int
        Simulated belts for each method (sorting).
    draws : int
        Of each of two chains of the joint posterior, 100 by default; none is sampled for zero.

    Raises
    ------
    ValueError
        For a task or method that does not exist, other starts, and numbers below one.

    See Also
    --------
    i2rl.domains.demonstrate_noisy : its streams
    i2rl.inference.rimeo : its learner

    Examples
    --------
    >>> from i2rl.analysis import noisy_study
    >>> study = noisy_study("sorting", replications=1, sessions=2, belts=10, draws=0, methods=[])
    >>> list(study.results), study.true_agreement.shape
    (['RIMEO, no scores'], (8,))
    """
    belts, draws = Examples(**examples)
    if name not in TASKS:
        raise ValueError(f"tasks are {', '.join(TASKS)}; got {name!r}")
    for what, number in (("replications", replications), ("sessions", sessions), ("belts", belts)):
        if number < 1:
            raise ValueError(f"{what} must be at least 1, got {number}")
    if draws < 0:
        raise ValueError(f"draws must not be negative, got {draws}")
    unknown = [method for method in methods or () if method not in METHODS]
    if unknown:
        raise ValueError(f"methods are {'; '.join(METHODS)}; got {unknown[0]!r}")
    task = TASKS[name]()
    chosen = [m for m in METHODS if methods is None or m in methods or m == PLAIN]
    draw, learn, hide, show = jax.random.split(jax.random.key(seed), 4)
    streams = draw_streams(draw, task, replications=replications, sessions=sessions, starts=starts)
    pairs = task.pair_distribution(starts, STEPS)
    judge = _Judge(task, agreement_probabilities(task.noise, task.predicates, pairs), _judged_states(task))
    results = {}
    for i, method in enumerate(chosen):
        advance(method, i / (len(chosen) + 3))
        if method in LEARNERS:
            entry = LEARNERS[method]
            results[method] = judge.online(method, learn, entry.learner(streams.mdp, task), streams, entry)
        else:
            results[method] = judge.batch(method, learn, streams)
    advance("timing", len(chosen) / (len(chosen) + 3))
    seconds = _seconds([method for method in TIMED if method in results], task, streams)
    doubt = {m: _doubted(task, streams, results[m], scores) for m, scores in DOUBTED.items() if m in results}
    advance("out of view", (len(chosen) + 1) / (len(chosen) + 3))
    hidden = _hidden(hide, judge, replications, sessions, starts) if name == "patrol" else None
    advance("examples", (len(chosen) + 2) / (len(chosen) + 3))
    posterior, happened, sorted_ = _examples(show, judge, streams, results, pairs, Examples(belts, draws))
    advance("done", 1.0)
    return NoisyStudy(
        task,
        starts,
        replications,
        sessions,
        seed,
        streams,
        judge.true_agreement,
        judge.states,
        results,
        seconds,
        doubt,
        hidden,
        posterior,
        happened,
        sorted_,
        chance_accuracy(jax.random.fold_in(show, 200), task.mdp, jnp.asarray(task.weights)),
    )


def _seconds(methods: Sequence[str], task: NoisyTask, streams: Streams) -> dict[str, float]:
    """Time the first stream, learned twice: the first time compiles.

    Learners take turns, so that other load of the machine slows all of them equally.
    """
    learners = [LEARNERS[method].learner(streams.mdp, task) for method in methods]
    for _ in range(2):
        states: list[Any] = [learner.init(jax.random.key(0)) for learner in learners]
        taken: list[list[float]] = [[] for _ in learners]
        for t in range(streams.seen.kind.shape[1]):
            session = streams.session(0, t)
            for i, learner in enumerate(learners):
                states[i], report = learner.update(states[i], session)
                taken[i].append(report.seconds)
    return {method: float(np.median(seconds)) for method, seconds in zip(methods, taken, strict=True)}


def _hidden(
    key: Array, judge: _Judge, replications: int, sessions: int, starts: Starts
) -> dict[str, MethodResult]:
    """Run with most states out of view, without noise and with learned noise; the walks are the same."""
    view = instance(2).visibility(OBSERVABILITY)
    draw, learn = jax.random.split(key)
    # Until something is seen there is no agreement to judge.
    clear = _Entry(lambda mdp, task: _plain_learner(mdp, view), perceives=False)
    noisy = _Entry(
        lambda mdp, task: rimeo(mdp, task.features, scores="none", visibility=view), perceives=False
    )
    results = {}
    for method, noise, entry in ((HIDDEN, noisy_patrol(0.0).noise, clear), (BOTH, judge.task.noise, noisy)):
        streams = draw_streams(
            draw,
            judge.task,
            replications=replications,
            sessions=sessions,
            starts=starts,
            steps=HIDDEN_STEPS,
            noise=noise,
            visibility=view,
        )
        learner = entry.learner(streams.mdp, judge.task)
        results[method] = judge.online(method, learn, learner, streams, entry)
    return results


def _examples(
    key: Array,
    judge: _Judge,
    streams: Streams,
    results: Mapping[str, MethodResult],
    pairs: Float[np.ndarray, "S A"],
    examples: Examples,
) -> tuple[SensorPosterior | None, Strip, SortingTable | None]:
    """Return the posterior of the first stream's early sessions, and the completion of a new trajectory."""
    learned, early = results[PLAIN], min(EARLY, streams.seen.kind.shape[1])
    assert learned.agreement is not None
    sample, walk, belt = jax.random.split(key, 3)
    first = slice(0, early * TRAJECTORIES)
    seen, truth = (streams.whole(0, of).select(first) for of in ("seen", "truth"))
    posterior = None
    belts, draws = examples
    if draws:
        estimate = learned.agreement[0, early - 1]
        posterior = sensor_posterior(
            sample, judge.task, NoisyDemonstration(truth, seen, streams.mdp), estimate, pairs, draws=draws,
            warmup=draws,
        )  # fmt: skip
    reliabilities = jax.nn.sigmoid(learned.state.logits[0])
    happened = strip(walk, judge.task, learned.weights[0, -1], np.asarray(reliabilities))
    if judge.task.name == TASKS["patrol"]().name:
        return posterior, happened, None
    sorters = {m: results[m].weights[:, -1] for m in (AVERAGED, STEPWISE, PLAIN, FAIR, MLIRL) if m in results}
    return posterior, happened, sorted_belts(belt, judge.task, sorters, belts=belts)
