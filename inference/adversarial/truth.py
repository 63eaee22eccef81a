"""Samples of what an expert did, given reports: by what rule, and how many.

Lines 6-15 of Algorithm 3: the truth is sampled until the average logit of the discriminator settles.
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
    """What the expert did, given reports: one object for each way to deal with noise."""

    def prior(self) -> Any:
        """The sensor before the first session, as arrays (empty where there is nothing to know)."""

    def begin(self, recording: Recording, sensor: Any, key: Array) -> Any:
        """The chain's state before the first look at a session's reports."""

    def refresh(self, chain: Any, sensor: Any, policy: Policy, key: Array) -> tuple[Any, ExpertTransitions]:
        """Samples of the truth under the current policy, and the chain to go on from."""

    def more(self, chain: Any, sensor: Any, policy: Policy, key: Array) -> tuple[Any, ExpertTransitions]:
        """As many further samples under the same policy."""

    def learned(self, chain: Any, sensor: Any) -> Any:
        """The sensor after a session: as it was, or fitted to it."""


class FaceValue:
    """Reports taken for the truth: AIRL and GAIL as they are, on clean or noisy input."""

    def prior(self) -> tuple:
        """Nothing."""
        return ()

    def begin(self, recording: Recording, sensor: tuple, key: Array) -> Recording:
        """The reports."""
        return recording

    def refresh(
        self, chain: Recording, sensor: tuple, policy: Policy, key: Array
    ) -> tuple[Recording, ExpertTransitions]:
        """The reports as one sample."""
        return chain, reported_steps(chain)

    def more(
        self, chain: Recording, sensor: tuple, policy: Policy, key: Array
    ) -> tuple[Recording, ExpertTransitions]:
        """The same again."""
        return self.refresh(chain, sensor, policy, key)

    def learned(self, chain: Recording, sensor: tuple) -> tuple:
        """Nothing."""
        return sensor


@shown_briefly
class Sampled(NamedTuple):
    """What a look at a session's reports found.

    Fields
    ------
    chain : the truth's, to go on from
    expert : ExpertTransitions
    draws : int, made of the truth
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
    """Sample the truth until the average logit of its steps settles.

    A move is the mean over steps of the absolute change of the average with one more sampling. (Algorithm 3
    as printed compares an average with itself; as released, it sums over a batch and as many generated steps,
    so that what it means depends on the batch.) Whatever is made, samples have the one shape, for which is
    compiled: those that were not drawn weigh nothing. Actions are those of :func:`within_bounds`.
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
    """All samples, each sampling counting alike, with room for ``most`` samplings."""
    absent = most - len(drawn)
    every = [*drawn, *[drawn[0]._replace(weights=0 * drawn[0].weights)] * absent]
    steps = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *(x.steps for x in every))
    live = jnp.all(jnp.stack([x.live for x in drawn]), 0)
    return ExpertTransitions(steps, live, jnp.concatenate([x.weights for x in every]) / len(drawn))


def reported_steps(recording: Recording) -> ExpertTransitions:
    """The reports as transitions: of each trajectory all steps with a successor, or a termination."""
    observations = jnp.asarray(recording.observations)
    following = jnp.concatenate([observations[:, 1:], observations[:, -1:]], 1)
    ends = recording.last & recording.terminated[:, None]
    steps = (observations, jnp.asarray(recording.actions), following, ends)
    flat = (x.reshape(-1, 1, *x.shape[2:]) for x in steps)
    return ExpertTransitions(Transitions(*flat), (recording.followed | ends).reshape(-1), jnp.ones(1))


def within_bounds(actions: ActionSpace, expert: ExpertTransitions) -> ExpertTransitions:
    """Reported actions cut to their bounds, as generated ones are.

    Noise beyond the bounds would tell the two apart whatever either does.
    """
    return expert._replace(steps=expert.steps._replace(actions=actions.clip(expert.steps.actions)))
