"""Stopping criteria: functions of the infos so far."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...models.process.mdp import TabularMDP
from ...models.process.planning import deterministic_policy, hard_plan, policy_values, reward_of
from .learner import SessionInfo


class StoppingCriterion(Protocol):
    """Criterion that ends the sessions, given their infos so far."""

    def __call__(self, infos: Sequence[SessionInfo]) -> bool:
        """Return whether to stop after the last info."""


class LikelihoodChange(NamedTuple):
    """Criterion 1 (Definition 5): the session's log-likelihood changed by at most ``rho``."""

    rho: float

    def __call__(self, infos: Sequence[SessionInfo]) -> bool:
        """Return whether to stop after the last info."""
        if len(infos) < 2:
            return False
        return abs(infos[-1].log_likelihood - infos[-2].log_likelihood) <= self.rho


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

    def __call__(self, infos: Sequence[SessionInfo]) -> bool:
        """Return whether to stop after the last info."""
        if len(infos) < 2:
            return False
        before, after = (float(self._error(_one_reward(r))) for r in infos[-2:])
        return before - after <= self.rho


class MovingWindow:
    """Guard against early stopping (chapter 4): small deviation over the last ``width`` sessions.

    ``of`` is the field of the info whose standard deviation must be within ``tolerance``: ``log_likelihood``
    or ``gradient``. The width is the protection: all fields are constant while the expert is out of view, so
    the width should exceed the longest stretch of hidden sessions. Raises ``ValueError`` for another field or
    a width below 2.
    """

    def __init__(self, width: int, tolerance: float, of: str = "log_likelihood") -> None:
        if of not in ("log_likelihood", "gradient"):
            raise ValueError(f"a moving window is of log_likelihood or gradient, got {of!r}")
        if width < 2:
            raise ValueError(f"a moving window needs at least 2 sessions, got {width}")
        self.width, self.tolerance, self.of = width, tolerance, of

    def __call__(self, infos: Sequence[SessionInfo]) -> bool:
        """Return whether to stop after the last info."""
        if len(infos) < self.width:
            return False
        return float(np.std([getattr(r, self.of) for r in infos[-self.width :]])) <= self.tolerance


class PolicyWindow:
    """Criterion of settled behaviour: the greedy policies of the last ``width`` sessions agree.

    Each may differ from the current one in at most the share ``tolerance`` of all states. It needs no expert,
    has no unit that depends on the data, and measures the policy itself: rewards may change further without
    any effect on it. Raises ``ValueError`` for a width below 2 or a share outside [0, 1].
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

    def __call__(self, infos: Sequence[SessionInfo]) -> bool:
        """Return whether to stop after the last info."""
        if len(infos) < self.width:
            return False
        actions = np.asarray(self._actions(np.stack([_one_reward(r) for r in infos[-self.width :]])))
        return float((actions != actions[-1]).mean(axis=1).max()) <= self.tolerance


def _one_reward(info: SessionInfo) -> Float[np.ndarray, " K"]:
    weights = np.asarray(info.weights)
    if weights.ndim != 1:
        raise ValueError(
            f"this criterion compares one reward with the next; the learner has {len(weights)} at a time: "
            "use LikelihoodChange or MovingWindow"
        )
    return weights
