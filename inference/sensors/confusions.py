"""A sensor's confusions learned from the demonstrations themselves, by expectation-maximisation."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import SEEN, UNKNOWN, Demonstration
from ...models.observation.evidence import ObservationModel


class ConfusionNoise(Protocol):
    """Confusions whose probabilities can be learned: ``Confusions``, or ``SwapNoise``."""

    @property
    def chances(self) -> Float[Array, " M"]:
        """Probability of each confusion, where it acts."""

    @property
    def acts(self) -> Bool[Array, "M S A"]:
        """Marks of the pairs on which each confusion acts."""

    @property
    def noise(self) -> ObservationModel:
        """The observation model."""

    def confused(self, truth: Int[Array, " n"], observation: Int[Array, " n"]) -> Bool[Array, "n M"]:
        """Mark the confusion that turned each truth into its observation (flat indices)."""

    def _replace(self, *, chances: Array = ...) -> Any:
        """Replace the ``chances``."""


@shown_briefly
class ConfusionStatistic(NamedTuple):
    """Expected numbers ``[M]`` of each confusion: occurrences, and opportunities."""

    happened: Float[Array, " M"]
    possible: Float[Array, " M"]


def confusion_counts(
    noise: ConfusionNoise, pairs: Float[Array, "n L S A"], demonstration: Demonstration
) -> ConfusionStatistic:
    """Run the E-step: count confusions over the posterior ``pairs`` of the truth.

    Partly or fully hidden steps do not count.
    """
    kind, state, action = (jnp.asarray(x) for x in demonstration.arrays[:3])
    seen = (kind == SEEN) & (state != UNKNOWN) & (action != UNKNOWN)
    _, n_states, n_actions = noise.acts.shape
    size = n_states * n_actions
    acts = noise.acts.reshape(-1, size).astype(float)
    believed = pairs.reshape(-1, size) * seen.reshape(-1, 1)
    observation = jnp.where(seen, state * n_actions + action, 0).reshape(-1)
    turned = noise.confused(jnp.tile(jnp.arange(size), len(observation)), jnp.repeat(observation, size))
    turned = turned.reshape(len(observation), size, -1).astype(float)
    happened = jnp.einsum("tg,tgm,mg->m", believed, turned, acts)
    return ConfusionStatistic(happened, jnp.einsum("tg,mg->m", believed, acts))


def fitted_confusions(
    assumed: ConfusionNoise, counts: ConfusionStatistic, trust: float
) -> Float[Array, " M"]:
    """Run the M-step: shares of occurrences, with the assumed probabilities as ``trust`` observations."""
    return (trust * assumed.chances + counts.happened) / (trust + counts.possible)
