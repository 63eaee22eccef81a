"""Sessions of a learner on a stream of demonstrations, with or without a journal; average regret."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Array, Float

from ...models.inputs.text import shortened
from ...models.observation.demonstration import Demonstration
from .learner import Learner, SessionInfo
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
        """Return the digest of a session's demonstration, empty where it is unknown."""

    def learned_from(self, demonstration: bytes) -> int | None:
        """Return the session that learned from a demonstration, None if there is none."""


class Run(NamedTuple):
    """Final state, the sessions' reports, and whether a criterion stopped them."""

    state: Any
    infos: tuple[SessionInfo, ...]
    stopped: bool


def run_sessions(
    learner: Learner,
    stream: Iterable[Demonstration],
    *,
    key: Array | None = None,
    state: Any = None,
    stop: StoppingCriterion | None = None,
    journal: SessionStore | None = None,
    on_session: Callable[[Any, SessionInfo], None] | None = None,
    whole: bool | None = None,
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

    Raises
    ------
    TypeError
        An argument is no key, no journal, or no iterable of demonstrations.
    ValueError
        Neither key, state nor a journal with sessions is given; the journal is another learner's or has other
        sessions than ``state``; or the stream is not the one that the journal learned from.

    Whatever ``update`` raises passes through; the state before it stays valid.

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
    infos: list[SessionInfo] = []
    unlearned = ((one, b"") for one in stream) if journal is None else _unlearned(stream, journal, whole)
    for demonstration, digest in unlearned:
        state, info = learner.update(state, demonstration)
        infos.append(info)
        if journal is not None:
            journal.commit(state, info, demonstration=digest)
        if on_session is not None:
            on_session(state, info)
        if stop is not None and stop(infos):
            return Run(state, tuple(infos), True)
    return Run(state, tuple(infos), False)


def _require_stream(stream: Any) -> None:
    if isinstance(stream, tuple) and hasattr(stream, "_fields"):
        name = type(stream).__name__
        several = f", {name}.sessions() for one a trajectory" if hasattr(stream, "sessions") else ""
        advice = f"pass [it] for one session{several}"
        raise TypeError(f"`stream` must be an iterable of demonstrations; got one {name}: {advice}")
    if not isinstance(stream, Iterable) or isinstance(stream, str | bytes | Mapping):
        raise TypeError(f"`stream` must be an iterable of demonstrations; got {shortened(stream)}")


def _unlearned(
    stream: Iterable[Demonstration], journal: SessionStore, whole: bool | None
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
    learner's (``learner.log_likelihood(state, true_weights)`` and the infos' ``log_likelihood``); leading
    axes are streams. The form of chapter 4, ``LL(theta_E | X_i, .) - LL(theta^i | X_i, .)``, whose two sides
    share their data; Definition 8 prints the previous session's estimate on the previous session's data.
    Raises ``ValueError`` if shapes differ.

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
