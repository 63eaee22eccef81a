"""The I2RL framework (chapter 3): learners, sessions, stopping criteria and regret.

A learner is a pair of functions on an explicit state. ``init(key)`` gives the state before the first
session; ``update(state, demonstration)`` runs one session (Definition 4) and returns the new state and a
report. The state holds what Definition 7 allows, the reward estimate and the sufficient statistic (with
warm starts for the solvers), and nothing of earlier demonstrations.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.text import shortened
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import deterministic_policy, hard_plan, policy_values, reward_of
from .progress import told
from .serialization import demonstration_digest

if TYPE_CHECKING:
    from ..journal.journal import Journal


AnyReport = TypeVar("AnyReport", bound=tuple)


class Report(NamedTuple):
    """What a session did: plain numbers (from a fleet, arrays with one entry a stream).

    Fields
    ------
    session : int
        Its number, from 1.
    log_likelihood : float
        ``LL(theta^i | X_i, statistic)`` in nats per trajectory: what the statistic holds once the session is
        in it, under the new weights. The share of the dynamics, which no weights change, is left out, so
        that sessions compare.
    demonstration_log_likelihood : float
        Exact log-likelihood (nats, hidden steps summed out, dynamics included) of this session's
        demonstration alone.
    gradient : float
        Norm of the log-likelihood's gradient in scaled weights (:mod:`~i2rl.models.process.units`) at the
        weights the session began with: how far this session's data disagree with them. ``|phi_hat - E[phi]|``
        of scaled features (line 15 of Algorithm 1) with the features statistic.
    iterations : int
        E- and M-steps.
    solver_iterations : int
        Iterations of the programs' solver, summed over the M-steps.
    converged : bool
        Whether the session's last program met its tolerance. True for a method that solves none.
    seconds : float
        Wall-clock time of the session.
    weights : float ``[K]``
        The new reward weights.
    """

    session: int
    log_likelihood: float
    demonstration_log_likelihood: float
    gradient: float
    iterations: int
    solver_iterations: int
    converged: bool
    seconds: float
    weights: Float[np.ndarray, " K"]

    def in_plain_numbers(self, seconds: float) -> Report:
        """The report of a compiled session with Python's numbers and NumPy's arrays, and the time it took."""
        return in_plain_numbers(self, seconds)


def in_plain_numbers(report: AnyReport, seconds: float) -> AnyReport:
    """A learner's own kind of report in the same form: any named tuple with a field ``seconds``."""
    arrays = {name: np.asarray(value) for name, value in report._asdict().items()}  # type: ignore[attr-defined]
    values: dict[str, Any] = {name: x if x.ndim else x.item() for name, x in arrays.items()}
    return type(report)(**values | {"seconds": seconds})


class Learner(NamedTuple):
    """An online learner: configuration, and two functions on an explicit state.

    ``session`` is the pure, compiled core of ``update`` (state and padded demonstration in, state and
    report out) that :func:`fleet` maps over many streams; None where a solver runs outside JAX.
    """

    name: str
    mdp: TabularMDP
    configuration: Mapping[str, Any]
    init: Callable[[Array], Any]
    update: Callable[[Any, Demonstration], tuple[Any, Report]]
    session: Callable[[Any, Demonstration], tuple[Any, Report]] | None = None
    log_likelihood: Callable[[Any, Float[Array, " K"]], float] | None = None

    @property
    def signature(self) -> str:
        """Digest of the MDP, the method and its configuration: what a journal must have been made for."""
        content = json.dumps(
            [self.mdp.fingerprint(), self.name, dict(self.configuration)], sort_keys=True, default=str
        )
        return hashlib.sha256(content.encode()).hexdigest()


class Fleet(NamedTuple):
    """One learner on many independent streams: states and demonstrations with a leading axis."""

    init: Callable[[Array, int], Any]
    update: Callable[[Any, Demonstration], tuple[Any, Report]]


def fleet(learner: Learner) -> Fleet:
    """Map a learner over independent streams in one compiled program.

    ``init(key, streams)`` and ``update(states, demonstrations)``, the arrays of a demonstration being
    ``[streams, n, L]``. Raises ``ValueError`` for a learner whose solver runs outside JAX. Observations
    are not checked: an impossible one shows as a demonstration log-likelihood of minus infinity, and leaves
    its learner's state as it was. On a CPU the streams take turns: lanes of a mapped loop would all wait for
    the slowest of them, at every level of nested loops.
    """
    if learner.session is None:
        raise ValueError(
            f"{learner.name} solves its programs outside JAX, so it cannot be mapped over streams"
        )
    session = learner.session

    @jax.jit
    def update(states: Any, demonstrations: Demonstration) -> tuple[Any, Report]:
        return lax.platform_dependent(
            states,
            jax.tree.map(jnp.asarray, demonstrations),
            cpu=lambda *streams: lax.map(lambda stream: session(*stream), streams),
            default=jax.vmap(session),
        )

    init = jax.vmap(learner.init)
    return Fleet(lambda key, streams: init(jax.random.split(as_key(key), streams)), update)


def run_streams(
    learner: Learner,
    key: Array,
    demonstrations: Demonstration,
    keep: Callable[[Any, Report], Any] | None = None,
) -> tuple[Any, Any]:
    """Run a learner over whole streams in one compiled program, for studies of many repetitions.

    ``demonstrations`` holds arrays ``[R, T, n, L]``: ``R`` streams of ``T`` sessions. Returns the final
    states ``[R]`` and what ``keep(state, report)``, a pure function called after each session (the report
    by default), gave: arrays ``[R, T]``. Streams run one after the other. Observations are not checked,
    as in a fleet; of the keys, stream ``i`` gets that which stream ``i`` of a fleet gets.
    Raises ``ValueError`` for a learner whose solver runs outside JAX, or arrays of another rank.
    """
    if learner.session is None:
        raise ValueError(f"{learner.name} solves its programs outside JAX, so it cannot run compiled streams")
    shape = np.shape(demonstrations.kind)
    if len(shape) != 4:
        raise ValueError(f"streams need arrays [streams, sessions, trajectories, steps], got {list(shape)}")
    session, init = learner.session, learner.init

    def one(inputs: tuple) -> Any:
        def step(state: Any, demonstration: Demonstration) -> tuple:
            state, report = session(state, demonstration)
            return state, report if keep is None else keep(state, report)

        start, stream = inputs
        return lax.scan(step, init(start), stream)

    inputs = (jax.random.split(as_key(key), shape[0]), jax.tree.map(jnp.asarray, demonstrations))
    return jax.jit(partial(lax.map, one))(inputs)


# -- stopping -----------------------------------------------------------------------------------------


class StoppingCriterion(Protocol):
    """Decides from the reports so far whether the sessions should end."""

    def __call__(self, reports: Sequence[Report]) -> bool:
        """Whether to stop after the last report."""


class LikelihoodChange(NamedTuple):
    """Criterion 1 (Definition 5): the session's log-likelihood changed by at most ``rho``."""

    rho: float

    def __call__(self, reports: Sequence[Report]) -> bool:
        """Whether to stop after the last report."""
        if len(reports) < 2:
            return False
        return abs(reports[-1].log_likelihood - reports[-2].log_likelihood) <= self.rho


class LearningErrorChange:
    """Criterion 2 (Definition 6): the inverse learning error fell by at most ``rho``.

    For evaluation, where the expert's reward ``weights [K]`` are known; takes them and the MDP.
    """

    def __init__(self, rho: float, mdp: TabularMDP, weights: Float[np.ndarray, " K"]) -> None:
        self.rho = rho
        reward = reward_of(mdp, jnp.asarray(weights))
        best = hard_plan(mdp, reward).values

        def error(learned: Float[Array, " K"]) -> Float[Array, ""]:
            policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, learned)).optimal)
            return jnp.sum(jnp.abs(best - policy_values(mdp, policy, reward)))

        self._error = jax.jit(error)

    def __call__(self, reports: Sequence[Report]) -> bool:
        """Whether to stop after the last report."""
        if len(reports) < 2:
            return False
        before, after = (float(self._error(_one_reward(r))) for r in reports[-2:])
        return before - after <= self.rho


class MovingWindow:
    """Against early stopping (chapter 4): the standard deviation over the last ``width`` sessions is small.

    ``of`` is the field of the report that must settle within ``tolerance``: ``log_likelihood`` or
    ``gradient``. What protects is the width: where nothing is seen everything stands still, so it should
    exceed the longest stretch of sessions without a sighting. Raises ``ValueError`` for another field or a
    width below 2.
    """

    def __init__(self, width: int, tolerance: float, of: str = "log_likelihood") -> None:
        if of not in ("log_likelihood", "gradient"):
            raise ValueError(f"a moving window is of log_likelihood or gradient, got {of!r}")
        if width < 2:
            raise ValueError(f"a moving window needs at least 2 sessions, got {width}")
        self.width, self.tolerance, self.of = width, tolerance, of

    def __call__(self, reports: Sequence[Report]) -> bool:
        """Whether to stop after the last report."""
        if len(reports) < self.width:
            return False
        return float(np.std([getattr(r, self.of) for r in reports[-self.width :]])) <= self.tolerance


class PolicyWindow:
    """The learned behaviour has settled: the greedy policies of the last ``width`` sessions agree.

    Each may differ from the current one in at most the share ``tolerance`` of all states. Needs no expert,
    has no unit that depends on the data, and looks at what the learner is for: rewards may go on moving
    where no decision depends on them. Raises ``ValueError`` for a width below 2 or a share outside [0, 1].
    """

    def __init__(self, width: int, tolerance: float, mdp: TabularMDP) -> None:
        if width < 2:
            raise ValueError(f"a window of policies needs at least 2 sessions, got {width}")
        if not 0 <= tolerance <= 1:
            raise ValueError(f"the tolerance is a share of the states in [0, 1], got {tolerance}")
        self.width, self.tolerance = width, tolerance

        def actions(weights: Float[Array, "w K"]) -> Int[Array, "w S"]:
            def one(w: Float[Array, " K"]) -> Int[Array, " S"]:
                return jnp.argmax(deterministic_policy(hard_plan(mdp, reward_of(mdp, w)).optimal), axis=1)

            return lax.map(one, weights)

        self._actions = jax.jit(actions)

    def __call__(self, reports: Sequence[Report]) -> bool:
        """Whether to stop after the last report."""
        if len(reports) < self.width:
            return False
        actions = np.asarray(self._actions(np.stack([_one_reward(r) for r in reports[-self.width :]])))
        return float((actions != actions[-1]).mean(axis=1).max()) <= self.tolerance


def _one_reward(report: Report) -> Float[np.ndarray, " K"]:
    weights = np.asarray(report.weights)
    if weights.ndim != 1:
        raise ValueError(
            f"this criterion compares one reward with the next; the learner has {len(weights)} at a time: "
            "use LikelihoodChange or MovingWindow"
        )
    return weights


# -- running ------------------------------------------------------------------------------------------


class Run(NamedTuple):
    """Final state, the sessions' reports, and whether a criterion stopped them."""

    state: Any
    reports: tuple[Report, ...]
    stopped: bool


def run_sessions(
    learner: Learner,
    stream: Iterable[Demonstration],
    *,
    key: Array | None = None,
    state: Any = None,
    stop: StoppingCriterion | None = None,
    journal: Journal | None = None,
    on_session: Callable[[Any, Report], None] | None = None,
    whole: bool | None = None,
    progress: bool = False,
) -> Run:
    """Run one session per demonstration of the stream until it ends or ``stop`` says so (Definition 7).

    Starts from ``state``, or where ``journal`` left off, or from ``learner.init(key)``. With a journal every
    session is committed before the next one begins, with a digest of its demonstration, so that no session
    is learned twice.

    Parameters
    ----------
    stop : callable, optional
        Sees the reports of this run.
    on_session : callable, optional
        Is called after each session.
    whole : bool, optional
        Where the stream begins, once the journal has sessions. True: with the first session's demonstration.
        Those that the journal has are compared, one by one, and skipped. False: after the last session.
        By default the first demonstration decides. The one of session 1: True. One that no session learned
        from: False, and a later one that is the session's at the same place is refused. One of another
        session is refused. A journal that does not know its demonstrations (of version 1, or committed
        without digests) is continued: False.
    progress : bool
        Says on standard error which session is learned; the first one waits for the compiler.

    Raises
    ------
    TypeError
        An argument is no key, no journal, or no iterable of demonstrations.
    ValueError
        Neither key, state nor a journal with sessions is given; the journal is another learner's or has other
        sessions than ``state``; or the stream is not the one that the journal learned from.

    Whatever ``update`` raises passes through; the state before it stays valid.
    """
    _require_stream(stream)
    if journal is not None:
        if not hasattr(journal, "commit"):
            raise TypeError(f"`journal` must be Journal.open(path, learner); got {shortened(journal)}")
        if journal.origin.signature != learner.signature:
            raise ValueError(f"{journal.path} was opened for another learner than {learner.name}")
        if state is not None and int(state.session) != journal.session:
            raise ValueError(
                f"the state has {int(state.session)} sessions, but {journal.path} has {journal.session}"
            )
        state = journal.state if state is None else state
    if state is None:
        if key is None:
            raise ValueError("run_sessions needs a key, a state or a journal to start from")
        state = learner.init(key)
    reports: list[Report] = []
    unlearned = ((one, b"") for one in stream) if journal is None else _unlearned(stream, journal, whole)
    with told(progress) as tell:
        for demonstration, digest in unlearned:
            compiling = "" if reports else ", compiling first"
            tell(f"{learner.name}: session {int(state.session) + 1}{compiling}")
            state, report = learner.update(state, demonstration)
            reports.append(report)
            if journal is not None:
                journal.commit(state, report, demonstration=digest)
            if on_session is not None:
                on_session(state, report)
            if stop is not None and stop(reports):
                return Run(state, tuple(reports), True)
    return Run(state, tuple(reports), False)


def _require_stream(stream: Any) -> None:
    if isinstance(stream, tuple) and hasattr(stream, "_fields"):
        name = type(stream).__name__
        several = f", {name}.sessions() for one a trajectory" if hasattr(stream, "sessions") else ""
        advice = f"pass [it] for one session{several}"
        raise TypeError(f"`stream` must be an iterable of demonstrations; got one {name}: {advice}")
    if not isinstance(stream, Iterable) or isinstance(stream, str | bytes | Mapping):
        raise TypeError(f"`stream` must be an iterable of demonstrations; got {shortened(stream)}")


def _unlearned(
    stream: Iterable[Demonstration], journal: Journal, whole: bool | None
) -> Iterator[tuple[Demonstration, bytes]]:
    """Demonstrations that the journal has no session of, with their digests."""
    learned, given, decide = journal.session, 0, whole is None
    advice = "give the whole stream, or with whole=False what comes after it"
    for given, demonstration in enumerate(stream, start=1):
        digest = demonstration_digest(demonstration)
        if given == 1 and decide and learned:
            whole = journal.demonstration(1) == digest
            if not whole and (session := journal.learned_from(digest)) is not None:
                raise ValueError(
                    f"the stream must begin with session 1 or after session {learned} of {journal.path}; it "
                    f"begins with the demonstration of session {session}: {advice}"
                )
        known = journal.demonstration(given) if given <= learned else b""
        if whole and given <= learned:
            if known and known != digest:
                raise ValueError(
                    f"demonstration {given} of the stream is not the one that session {given} of "
                    f"{journal.path} learned from: {advice}"
                )
            continue
        if decide and known and known == digest:
            raise ValueError(
                f"demonstration {given} of the stream is the one that session {given} of {journal.path} "
                f"learned from, but demonstration 1 is not that of session 1: {advice}"
            )
        yield demonstration, digest
    if whole and given < learned:
        raise ValueError(
            f"the stream ends after {given} demonstrations, but {journal.path} has {learned} sessions: "
            f"{advice}"
        )


def average_regret(
    expert: Float[np.ndarray, "... T"], learned: Float[np.ndarray, "... T"]
) -> Float[np.ndarray, "... T"]:
    """Average regret after each session: running mean of the log-likelihood given away.

    ``expert`` and ``learned`` are the sessions' log-likelihoods under the true weights and under the
    learner's (``learner.log_likelihood(state, true_weights)`` and the reports' ``log_likelihood``); leading
    axes are streams. The form of chapter 4, ``LL(theta_E | X_i, .) - LL(theta^i | X_i, .)``, whose two sides
    share their data; Definition 8 prints the previous session's estimate on the previous session's data.
    Raises ``ValueError`` if shapes differ.
    """
    expert, learned = np.asarray(expert, float), np.asarray(learned, float)
    if expert.shape != learned.shape or expert.ndim < 1:
        raise ValueError(
            f"log-likelihoods must be two lists of one length, got {expert.shape} and {learned.shape}"
        )
    return np.cumsum(expert - learned, axis=-1) / np.arange(1, expert.shape[-1] + 1)
