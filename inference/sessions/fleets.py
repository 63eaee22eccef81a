"""One learner on many independent streams at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration
from .learner import Learner, SessionInfo


@shown_briefly
class Fleet(NamedTuple):
    """One learner on many independent streams: states and demonstrations with a leading axis."""

    init: Callable[[Array, int], Any]
    update: Callable[[Any, Demonstration], tuple[Any, SessionInfo]]


def fleet(learner: Learner) -> Fleet:
    """Map a learner over independent streams in one compiled program.

    ``init(key, streams)`` and ``update(states, demonstrations)`` take demonstrations of arrays
    ``[streams, n, L]``. Raises ``ValueError`` for a learner whose solver runs outside JAX. Observations
    are not checked: an impossible one gives a demonstration log-likelihood of minus infinity, and leaves its
    learner's state unchanged. On a CPU the streams run in sequence: lanes of a mapped loop would all wait for
    the slowest of them, at every level of nested loops.

    See Also
    --------
    i2rl.inference.run_streams : runs whole streams
    i2rl.inference.run_sessions : runs one stream, with checks

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import fleet, lme_i2rl
    >>> corridor = five_cells()
    >>> learners = fleet(lme_i2rl(corridor.mdp, corridor.sensor))
    >>> streams = jax.tree.map(lambda x: x.reshape(4, 2, 6), corridor.demonstration)  # of 2 trajectories
    >>> states, info = learners.update(learners.init(jax.random.key(0), 4), streams)
    >>> states.weights.shape, info.session.tolist()
    ((4, 2), [1, 1, 1, 1])
    """
    if learner.session is None:
        raise ValueError(f"{learner.name} runs in part outside JAX, so it cannot be mapped over streams")
    session = learner.session

    @jax.jit
    def update(states: Any, demonstrations: Demonstration) -> tuple[Any, SessionInfo]:
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
    keep: Callable[[Any, SessionInfo], Any] | None = None,
) -> tuple[Any, Any]:
    """Run a learner over whole streams in one compiled program, for studies of many replications.

    ``demonstrations`` holds arrays ``[R, T, n, L]``: ``R`` streams of ``T`` sessions. Returns the final
    states ``[R]`` and the results of ``keep(state, info)``, a pure function called after each session (the
    info by default): arrays ``[R, T]``. Streams run one after the other. Observations are not checked, as in
    a fleet; stream ``i`` gets the key of stream ``i`` of a fleet. Raises ``ValueError`` for a learner whose
    solver runs outside JAX, or arrays of another rank.

    See Also
    --------
    i2rl.inference.fleet : runs one session of every stream
    i2rl.inference.run_sessions : runs one stream, with checks

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import lme_i2rl, run_streams
    >>> corridor = five_cells()
    >>> streams = jax.tree.map(lambda x: x.reshape(2, 2, 2, 6), corridor.demonstration)  # of two sessions
    >>> learner = lme_i2rl(corridor.mdp, corridor.sensor)
    >>> states, infos = run_streams(learner, jax.random.key(0), streams)
    >>> states.weights.shape, infos.session.tolist()
    ((2, 2), [[1, 2], [1, 2]])
    """
    if learner.session is None:
        raise ValueError(f"{learner.name} runs in part outside JAX, so it cannot run compiled streams")
    shape = np.shape(demonstrations.kind)
    if len(shape) != 4:
        raise ValueError(f"streams need arrays [streams, sessions, trajectories, steps], got {list(shape)}")
    session, init = learner.session, learner.init

    def one(inputs: tuple) -> Any:
        def step(state: Any, demonstration: Demonstration) -> tuple:
            state, info = session(state, demonstration)
            return state, info if keep is None else keep(state, info)

        start, stream = inputs
        return lax.scan(step, init(start), stream)

    inputs = (jax.random.split(as_key(key), shape[0]), jax.tree.map(jnp.asarray, demonstrations))
    return jax.jit(partial(lax.map, one))(inputs)
