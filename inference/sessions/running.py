"""Sessions of a learner on a stream of demonstrations, with or without a journal; average regret."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol

import numpy as np
from jaxtyping import Array, Float

from ...models.inputs.display import brief, brief_table, joined
from ...models.inputs.text import counted, shortened
from ...models.observation.demonstration import Demonstration
from .learner import Info, Learner, State
from .progress import progress_line
from .serialization import demonstration_digest
from .stopping import StoppingCriterion


class SessionStore(Protocol):
    """Store that commits every session of one learner, such as :class:`~i2rl.inference.Journal`."""

    path: Path

    @property
    def origin(self) -> Any:
        """Learner that the store was opened for; ``origin.signature`` identifies it."""

    @property
    def session(self) -> int:
        """Number of sessions committed."""

    @property
    def state(self) -> Any:
        """State after the last session, None before the first."""

    def commit(self, state: Any, info: Any, *, demonstration: bytes) -> None:
        """Commit a session with the digest of its demonstration."""

    def demonstration(self, session: int) -> bytes:
        """Return the digest of a session's demonstration; empty if it is unknown."""

    def learned_from(self, demonstration: bytes) -> int | None:
        """Return the session that learned from a demonstration; None if there is none."""


class Run(NamedTuple, Generic[State, Info]):
    """Final state, the sessions' infos, and a flag that a criterion stopped them."""

    state: State
    infos: tuple[Info, ...]
    stopped: bool

    def __repr__(self) -> str:
        (_, sessions), (_, ended), *last, (_, state) = self._rows()
        shown = [
            counted(int(sessions), "session"),
            ended,
            *(f"{name} {value}" for name, value in last),
            state,
        ]
        return joined(type(self).__name__, shown)

    def _repr_html_(self) -> str:
        return brief_table(type(self).__name__, self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        infos = self.infos if isinstance(self.infos, tuple) else ()
        last = [
            (f"last {name.replace('_', ' ')}", brief(getattr(infos[-1], name)))
            for name in ("log_likelihood", "weights")
            if infos and hasattr(infos[-1], name)
        ]
        ended = "stopped by the criterion" if self.stopped is True else "the stream ended"
        return [("sessions", str(len(infos))), ("end", ended), *last, ("state", brief(self.state))]


def run_sessions(
    learner: Learner[State, Info],
    stream: Iterable[Demonstration],
    *,
    key: Array | None = None,
    state: State | None = None,
    stop: StoppingCriterion | None = None,
    journal: SessionStore | None = None,
    on_session: Callable[[State, Info], None] | None = None,
    whole: bool | None = None,
    progress: bool = False,
) -> Run[State, Info]:
    """Run one session per demonstration of the stream until it ends or ``stop`` returns True (Definition 7).

    It starts from ``state``, from the last session of ``journal``, or from ``learner.init(key)``. With a
    journal every session is committed before the next one begins, with a digest of its demonstration, so that
    each demonstration is learned from once.

    Parameters
    ----------
    stop : callable, optional
        Called with the infos of this run.
    on_session : callable, optional
        Called after each session.
    whole : bool, optional
        First demonstration of the stream, if the journal has sessions. True: that of session 1. Those of the
        journal are compared, one by one, and skipped. False: the one after the last session. By default the
        first demonstration decides. That of session 1 means True. A new one means False, and a later one that
        belongs to the session at the same place is refused. One of another session is refused. A journal
        without digests of its demonstrations (of version 1, or committed without) is continued: False.
    progress : bool
        Print the number of each session to standard error; the first one waits for the compiler.

    Raises
    ------
    TypeError
        If an argument is not a key, a journal, or an iterable of demonstrations.
    ValueError
        If neither key, state nor a journal with sessions is given; if the journal is another learner's or has
        other sessions than ``state``; or if the stream is not that of the journal.

    Errors of ``update`` pass through; the state before it stays valid.

    See Also
    --------
    i2rl.inference.lme_i2rl : a learner
    i2rl.inference.Journal : keeps the sessions on disk
    i2rl.inference.run_streams : runs a learner over many streams

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import lme_i2rl, run_sessions
    >>> corridor = five_cells()
    >>> learner = lme_i2rl(corridor.mdp, corridor.sensor)
    >>> run = run_sessions(learner, corridor.demonstration.sessions(2), key=jax.random.key(0))
    >>> [info.session for info in run.infos], bool(run.state.weights[0] > 0)  # the end is worth something
    ([1, 2, 3, 4], True)
    """
    _require_stream(stream)
    current: Any = state
    if journal is not None:
        if not hasattr(journal, "commit"):
            raise TypeError(f"`journal` must be Journal.open(path, learner); got {shortened(journal)}")
        if journal.origin.signature != learner.signature:
            raise ValueError(f"{journal.path} was opened for another learner than {learner.name}")
        if current is not None and int(current.session) != journal.session:
            raise ValueError(
                f"the state has {int(current.session)} sessions, but {journal.path} has {journal.session}"
            )
        current = journal.state if current is None else current
    if current is None:
        if key is None:
            raise ValueError("run_sessions needs a key, a state or a journal to start from")
        current = learner.init(key)
    infos: list[Any] = []
    unlearned = ((one, b"") for one in stream) if journal is None else _unlearned(stream, journal, whole)
    with progress_line(progress) as tell:
        for demonstration, digest in unlearned:
            compiling = "" if infos else ", compiling first"
            tell(f"{learner.name}: session {int(current.session) + 1}{compiling}")
            current, info = learner.update(current, demonstration)
            infos.append(info)
            if journal is not None:
                journal.commit(current, info, demonstration=digest)
            if on_session is not None:
                on_session(current, info)
            if stop is not None and stop(infos):
                return Run(current, tuple(infos), True)
    return Run(current, tuple(infos), False)


def _require_stream(stream: Any) -> None:
    if isinstance(stream, Demonstration) or (isinstance(stream, tuple) and hasattr(stream, "_fields")):
        name = type(stream).__name__
        several = f", {name}.sessions() for one a trajectory" if hasattr(stream, "sessions") else ""
        advice = f"pass [it] for one session{several}"
        raise TypeError(f"`stream` must be an iterable of demonstrations; got one {name}: {advice}")
    if not isinstance(stream, Iterable) or isinstance(stream, str | bytes | Mapping):
        raise TypeError(f"`stream` must be an iterable of demonstrations; got {shortened(stream)}")


def _unlearned(
    stream: Iterable[Demonstration], journal: SessionStore, whole: bool | None
) -> Iterator[tuple[Demonstration, bytes]]:
    """Yield demonstrations without a session in the journal, with their digests."""
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
    """Return the average regret after each session: the running mean of the lost log-likelihood.

    ``expert`` and ``learned`` are the sessions' log-likelihoods under the true weights and under the
    learner's (``learner.log_likelihood(state, true_weights)`` and the infos' ``log_likelihood``); leading
    axes are streams. It has the form of chapter 4, ``LL(theta_E | X_i, .) - LL(theta^i | X_i, .)``, whose two
    sides share their data; Definition 8 prints the previous session's estimate on the previous session's
    data. Raises ``ValueError`` if shapes differ.

    See Also
    --------
    i2rl.inference.run_sessions : runs the sessions

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.inference import average_regret
    >>> average_regret(np.array([-1.0, -1.0, -1.0]), np.array([-3.0, -2.0, -1.0])).tolist()
    [2.0, 1.5, 1.0]
    """
    expert, learned = np.asarray(expert, float), np.asarray(learned, float)
    if expert.shape != learned.shape or expert.ndim < 1:
        raise ValueError(
            f"log-likelihoods must be two lists of one length, got {expert.shape} and {learned.shape}"
        )
    return np.cumsum(expert - learned, axis=-1) / np.arange(1, expert.shape[-1] + 1)
