"""Perception that takes pairs for other pairs: an observation model that also injects its errors."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.arguments import concrete, is_traced, rebuilt_unchecked
from ...models.inputs.display import shown_briefly
from ...models.observation.evidence import AnySensor, ObservationModel, Sensor


class _SwapFields(NamedTuple):
    swaps: Int[Array, "M S A"]
    chances: Float[Array, " M"]


@shown_briefly
@rebuilt_unchecked
class SwapNoise(_SwapFields):
    """Independent confusions of pairs: the observation is the truth with some swaps applied.

    Parameters
    ----------
    swaps : int ``[M, S, A]``
        Observation of a pair under each swap, as the flat index ``s * A + a``; the pair itself where the swap
        does not apply. Each swap is its own inverse, swaps commute, and different swaps of a pair give
        different observations.
    chances : float ``[M]``
        Probability of each swap where it applies.

    Raises
    ------
    ValueError
        For probabilities outside [0, 1], or swaps that are not as above.
    """

    __slots__ = ()

    def __new__(cls, swaps: np.ndarray | Array, chances: np.ndarray | Array) -> SwapNoise:
        """Check and convert; see the class."""
        flat = jnp.asarray(swaps if is_traced(swaps) else _checked_swaps(np.asarray(swaps)))
        p = concrete("chances", chances)
        if p is not None:
            if p.shape != flat.shape[:1]:
                raise ValueError(
                    f"{flat.shape[0]} swaps need as many probabilities of noise, got shape {list(p.shape)}"
                )
            for m in np.flatnonzero(~((p >= 0) & (p <= 1))):
                raise ValueError(
                    f"the noise of a swap is a probability in [0, 1]; that of swap {m} is {p[m]}"
                )
        return super().__new__(cls, flat, jnp.asarray(chances if p is None else p, float))

    def __mul__(self, other: AnySensor) -> Sensor:  # type: ignore[override]
        """Compose with another sensor, such as a :class:`Visibility`."""
        return self.noise * other

    @property
    def visibility(self) -> None:
        """None: this noise hides no step."""
        return None

    @property
    def acts(self) -> Bool[Array, "M S A"]:
        """Pairs that each swap changes."""
        return self.swaps != jnp.arange(self.swaps[0].size).reshape(self.swaps.shape[1:])

    @property
    def noise(self) -> ObservationModel:
        """Observation model ``O(o | g)``: ``o`` is the truth with a random subset of the swaps applied."""
        shape, (m, size) = self.swaps.shape[1:], self.swaps.reshape(len(self.chances), -1).shape
        chosen = _subsets(m)
        weights = jnp.prod(jnp.where(chosen, self.chances, 1 - self.chances), axis=1)
        table = jnp.zeros((size, size))
        for weight, observation in zip(weights, self._observations(), strict=True):
            table = table.at[jnp.arange(size), observation].add(weight)
        return ObservationModel._make((jnp.log(table).reshape(*shape, *shape),))

    def confused(
        self, truth: Int[Array | np.ndarray, " n"], observation: Int[Array | np.ndarray, " n"]
    ) -> Bool[Array, "n M"]:
        """Find the swaps that turned each truth into its observation (flat indices); none if no swaps do."""
        # The first subset that explains an observation holds no swap without effect.
        return jnp.asarray(_subsets(len(self.chances)))[
            (self._observations()[:, truth] == observation).argmax(0)
        ]

    def _observations(self) -> Int[Array, "2**M S*A"]:
        flat = self.swaps.reshape(len(self.chances), -1)
        observations = []
        for subset in _subsets(len(self.chances)):
            observation = jnp.arange(flat.shape[1])
            for m in np.flatnonzero(subset):
                observation = flat[m][observation]
            observations.append(observation)
        return jnp.stack(observations)


def _subsets(m: int) -> Bool[np.ndarray, "2**M M"]:
    return (np.arange(2**m)[:, None] >> np.arange(m)) % 2 == 1


def _checked_swaps(swaps: np.ndarray) -> Int[np.ndarray, "M S A"]:
    if swaps.ndim != 3 or not swaps.size or not np.issubdtype(swaps.dtype, np.integer):
        raise ValueError(
            f"swaps are whole numbers of shape [M, S, A], got {swaps.dtype} of {list(swaps.shape)}"
        )
    flat = swaps.reshape(len(swaps), -1)
    pairs = np.arange(flat.shape[1])
    if flat.min() < 0 or flat.max() >= len(pairs):
        raise ValueError(f"swaps name pairs by their flat index, 0 to {len(pairs) - 1}; got {flat.max()}")
    for m, swap in enumerate(flat):
        if (swap[swap] != pairs).any():
            g = int(np.flatnonzero(swap[swap] != pairs)[0])
            raise ValueError(
                f"swap {m} takes pair {g} for {swap[g]}, but {swap[g]} for {swap[swap[g]]}, not {g}"
            )
        for n in range(m):
            other = flat[n]
            if (swap[other] != other[swap]).any():
                raise ValueError(f"swaps {n} and {m} do not commute")
            if ((swap == other) & (swap != pairs)).any():
                raise ValueError(f"swaps {n} and {m} take a pair for the same other pair")
    return swaps
