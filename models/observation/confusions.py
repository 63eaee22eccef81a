"""Perception that confuses some pairs with others, each confusion with a probability."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ..inputs.arguments import concrete, is_traced, rebuilt_unchecked
from ..inputs.display import shown_briefly
from .evidence import AnySensor, ObservationModel, Sensor


class _ConfusionFields(NamedTuple):
    observations: Int[Array, "M S A"]
    chances: Float[Array, " M"]


@shown_briefly
@rebuilt_unchecked
class Confusions(_ConfusionFields):
    """Noise that reports a pair as another with the probability of the one confusion that acts on it.

    It is an observation model that also injects its noise; its few probabilities can be learned.

    Parameters
    ----------
    observations : int ``[M, S, A]``
        The pair that each confusion reports, as the flat index ``s * A + a``; the pair itself where the
        confusion does not act. At most one confusion acts on a pair.
    chances : float ``[M]``
        Probability of each confusion, where it acts.

    Raises
    ------
    ValueError
        For probabilities outside [0, 1], indices outside the pairs, or two confusions of one pair.
    """

    __slots__ = ()

    def __new__(cls, observations: ArrayLike, chances: ArrayLike) -> Confusions:
        """Check and convert; see the class."""
        flat = jnp.asarray(observations if is_traced(observations) else _checked(np.asarray(observations)))
        p = concrete("chances", chances)
        if p is not None:
            if p.shape != flat.shape[:1]:
                raise ValueError(f"{len(flat)} confusions need as many probabilities, got {list(p.shape)}")
            for m in np.flatnonzero(~((p >= 0) & (p <= 1))):
                raise ValueError(f"a confusion has a probability in [0, 1]; that of confusion {m} is {p[m]}")
        return super().__new__(cls, flat, jnp.asarray(chances if p is None else p, float))

    @staticmethod
    def of_actions(
        n_states: int, pairs: list[tuple[int, int]], chances: np.ndarray, n_actions: int
    ) -> Confusions:
        """Build confusions ``(truth, observation)`` of actions in every state, each with its chance."""
        itself = np.arange(n_states * n_actions).reshape(n_states, n_actions)
        observations = np.tile(itself, (len(pairs), 1, 1))
        for m, (truth, observation) in enumerate(pairs):
            observations[m, :, truth] = itself[:, observation]
        return Confusions(observations, np.asarray(chances, float))

    def __mul__(self, other: AnySensor) -> Sensor:  # type: ignore[override]
        """Compose with another sensor, such as a :class:`Visibility`."""
        return self.noise * other

    @property
    def visibility(self) -> None:
        """None: the noise hides no step."""
        return None

    @property
    def acts(self) -> Bool[Array, "M S A"]:
        """Marks of the pairs on which each confusion acts."""
        return self.observations != jnp.arange(self.observations[0].size).reshape(self.observations.shape[1:])

    @property
    def noise(self) -> ObservationModel:
        """``O(o | g)``: the probability of the confusion at its observation, the rest at the pair itself."""
        shape, size = self.observations.shape[1:], self.observations[0].size
        chance = jnp.where(self.acts, self.chances[:, None, None], 0.0).reshape(len(self.chances), size)
        g = jnp.arange(size)
        table = jnp.zeros((size, size)).at[g, g].add(1 - chance.sum(0))
        table = table.at[g, self.observations.reshape(-1, size)].add(chance)
        return ObservationModel._make((jnp.log(table).reshape(*shape, *shape),))

    def confused(
        self, truth: Int[Array | np.ndarray, " n"], observation: Int[Array | np.ndarray, " n"]
    ) -> Bool[Array, "n M"]:
        """Mark the confusion that turned each hidden pair into its observation (flat indices), if any did."""
        flat = self.observations.reshape(len(self.chances), -1)[:, truth]
        return ((flat == observation) & (flat != truth)).T


def _checked(pairs: np.ndarray) -> Int[np.ndarray, "M S A"]:
    if pairs.ndim != 3 or not pairs.size or not np.issubdtype(pairs.dtype, np.integer):
        raise ValueError(
            f"confusions are whole numbers of shape [M, S, A], got {pairs.dtype} of {list(pairs.shape)}"
        )
    size = pairs[0].size
    if pairs.min() < 0 or pairs.max() >= size:
        wrong = pairs.min() if pairs.min() < 0 else pairs.max()
        raise ValueError(f"confusions name pairs by their flat index, 0 to {size - 1}; got {wrong}")
    ways = (pairs != np.arange(size).reshape(pairs.shape[1:])).sum(0)
    if ways.max() > 1:
        s, a = np.argwhere(ways > 1)[0]
        raise ValueError(f"the pair ({s}, {a}) is confused in {ways[s, a]} ways; at most one is possible")
    return pairs
