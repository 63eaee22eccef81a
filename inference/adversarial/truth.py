"""Draws of an expert's steps given observations, and their number.

Lines 6-15 of Algorithm 3: the truth is drawn until the average logit of the discriminator settles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...models.inputs.display import shown_briefly
from ...models.networks.modules import ActionSpace, Policy
from ...models.observation.recordings import Recording
from .discriminator import ExpertTransitions, Transitions


class Truth(Protocol):
    """The expert's steps, given observations: one object for each treatment of noise."""

    def prior(self) -> Any:
        """Return the sensor before the first session, as arrays (empty if there is none)."""

    def begin(self, recording: Recording, sensor: Any, key: Array) -> Any:
        """Return the chain's state before the first refresh of a session."""

    def refresh(self, chain: Any, sensor: Any, policy: Policy, key: Array) -> tuple[Any, ExpertTransitions]:
        """Draw the truth under the current policy; return the chain and the draws."""

    def more(self, chain: Any, sensor: Any, policy: Policy, key: Array) -> tuple[Any, ExpertTransitions]:
        """Draw again under the same policy."""

    def learned(self, chain: Any, sensor: Any) -> Any:
        """Return the sensor after a session, unchanged or fitted to it."""


class FaceValue:
    """Observations taken for the truth: plain AIRL and GAIL, on clean or noisy input."""

    def prior(self) -> tuple:
        """Return an empty sensor."""
        return ()

    def begin(self, recording: Recording, sensor: tuple, key: Array) -> Recording:
        """Return the observations."""
        return recording

    def refresh(
        self, chain: Recording, sensor: tuple, policy: Policy, key: Array
    ) -> tuple[Recording, ExpertTransitions]:
        """Return the observations as one draw."""
        return chain, reported_steps(chain)

    def more(
        self, chain: Recording, sensor: tuple, policy: Policy, key: Array
    ) -> tuple[Recording, ExpertTransitions]:
        """Return the same draw again."""
        return self.refresh(chain, sensor, policy, key)

    def learned(self, chain: Recording, sensor: tuple) -> tuple:
        """Return an empty sensor."""
        return sensor


@shown_briefly
class Sampled(NamedTuple):
    """Result of a refresh of a session's draws.

    Fields
    ------
    chain : the truth's, to continue from
    expert : ExpertTransitions
    draws : int, number of draws of the truth
    """

    chain: Any
    expert: ExpertTransitions
    draws: int


class Settling(NamedTuple):
    """Sampling ends when the average logit moves by at most ``change``, or after ``draws`` samplings."""

    change: float = np.inf
    draws: int = 20


def look(
    truth: Truth,
    chain: Any,
    sensor: Any,
    policy: Policy,
    key: Array,
    actions: ActionSpace,
    logits: Callable[[Transitions], Float[Array, "N M"]],
    settling: Settling = Settling(),  # noqa: B008 (immutable)
) -> Sampled:
    """Draw the truth until the average logit of its steps settles.

    The move is the mean over steps of the absolute change of the average with one more draw. (Algorithm 3 as
    printed compares an average with itself; the released code sums over a batch and as many generated steps,
    so that the threshold depends on the batch.) The result has one shape, so that programs compile once;
    missing draws have weight zero. Actions are those of :func:`within_bounds`.
    """
    change, most = settling
    chain, first = truth.refresh(chain, sensor, policy, key)
    first = within_bounds(actions, first)
    if np.isinf(change):
        return Sampled(chain, first, 1)
    drawn, average = [first], _mean(first, logits(first.steps))
    while len(drawn) < most:
        chain, further = truth.more(chain, sensor, policy, jax.random.fold_in(key, len(drawn)))
        further = within_bounds(actions, further)
        drawn.append(further)
        step = (_mean(further, logits(further.steps)) - average) / len(drawn)
        average += step
        live = first.live & further.live
        if float(jnp.sum(jnp.where(live, jnp.abs(step), 0)) / jnp.sum(live)) <= change:
            break
    return Sampled(chain, _pooled(drawn, most), len(drawn))


def _mean(expert: ExpertTransitions, logits: Float[Array, "N M"]) -> Float[Array, " N"]:
    return logits @ expert.weights.astype(logits.dtype)


def _pooled(drawn: Sequence[ExpertTransitions], most: int) -> ExpertTransitions:
    """Pool all draws with equal weights, with room for ``most`` draws."""
    absent = most - len(drawn)
    every = [*drawn, *[drawn[0]._replace(weights=0 * drawn[0].weights)] * absent]
    steps = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *(x.steps for x in every))
    live = jnp.all(jnp.stack([x.live for x in drawn]), 0)
    return ExpertTransitions(steps, live, jnp.concatenate([x.weights for x in every]) / len(drawn))


def reported_steps(recording: Recording) -> ExpertTransitions:
    """Return the observations as transitions: all steps with a successor or a termination."""
    observations = jnp.asarray(recording.observations)
    following = jnp.concatenate([observations[:, 1:], observations[:, -1:]], 1)
    ends = recording.last & recording.terminated[:, None]
    steps = (observations, jnp.asarray(recording.actions), following, ends)
    flat = (x.reshape(-1, 1, *x.shape[2:]) for x in steps)
    return ExpertTransitions(Transitions(*flat), (recording.followed | ends).reshape(-1), jnp.ones(1))


def within_bounds(actions: ActionSpace, expert: ExpertTransitions) -> ExpertTransitions:
    """Clip observed actions to their bounds, as generated ones are.

    Noise beyond the bounds would distinguish the two sides whatever either does.
    """
    return expert._replace(steps=expert.steps._replace(actions=actions.clip(expert.steps.actions)))
