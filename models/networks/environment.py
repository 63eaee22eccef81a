"""Tasks for a generator of behaviour: their protocol, and the rollouts they return.

A task is of one of two kinds. An :class:`Environment` is pure JAX functions, so that a whole rollout
compiles; a :class:`HostEnvironment` steps a batch at a time in NumPy, as a physics engine does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ..inputs.display import shown_briefly
from .modules import ActionSpace


@shown_briefly
class Environment(NamedTuple):
    """A task as pure functions of one state; ``jax.vmap`` makes them functions of many.

    Fields
    ------
    name : str
    observation_size : int
    low, high : tuples of ``observation_size`` floats, bounds of an observation (infinite if there is none)
    actions : ActionSpace
    horizon : int, steps after which an episode is truncated (not terminated)
    reset : ``(key) -> state``, a first state drawn
    step : ``(state, action) -> (state, reward, terminated)``
    observe : ``(state) -> observation [d]``, 32-bit floats
    next_state : ``(observation [..., d], action) -> observation [..., d]``, the dynamics alone, in the
        coordinates of an observation and in the precision of its argument
    settings : pairs that distinguish it from others of its name, for a journal
    """

    name: str
    observation_size: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    actions: ActionSpace
    horizon: int
    reset: Callable[[Array], Array]
    step: Callable[[Array, Array], tuple[Array, Array, Array]]
    observe: Callable[[Array], Array]
    next_state: Callable[[Array, Array], Array]
    settings: tuple[tuple[str, Any], ...] = ()


class HostEnvironment(Protocol):
    """A task stepped in NumPy, many episodes at a time. Actions are clipped to the bounds.

    It may have ``settings`` as an :class:`Environment` does.
    """

    @property
    def name(self) -> str:
        """Name of the task."""
        ...

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        ...

    @property
    def actions(self) -> ActionSpace:
        """Space of actions."""
        ...

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated."""
        ...

    def reset(self, key: Array, n: int) -> np.ndarray:
        """Draw first states ``[n, D]``."""
        ...

    def step(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance one step; return states ``[n, D]``, rewards ``[n]`` and terminations ``[n]``."""
        ...

    def observe(self, states: np.ndarray) -> np.ndarray:
        """Return observations ``[n, d]``."""
        ...


@shown_briefly
class Rollout(NamedTuple):
    """``T`` steps of ``n`` episodes side by side; new ones begin where old ones end.

    Fields
    ------
    observations : float32 ``[T, n, d]``
    actions : int32 ``[T, n]``, or float32 ``[T, n, k]`` as drawn, before clipping
    next_observations : float32 ``[T, n, d]``, the true successors, also of an episode's last step
    rewards : float32 ``[T, n]``, the environment's own
    terminated : bool ``[T, n]``, True if the task ended here
    truncated : bool ``[T, n]``, True if only the time ran out here
    log_probs : float32 ``[T, n]``, of the actions under the policy that drew them
    values : float32 ``[T, n]``, the critic's, of the observations
    """

    observations: Float[Array, "T n d"]
    actions: Array
    next_observations: Float[Array, "T n d"]
    rewards: Float[Array, "T n"]
    terminated: Bool[Array, "T n"]
    truncated: Bool[Array, "T n"]
    log_probs: Float[Array, "T n"]
    values: Float[Array, "T n"]

    def flat(self) -> Rollout:
        """Flatten all steps into one row, ``[T * n, ...]``."""
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), self)
