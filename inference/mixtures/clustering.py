"""Result of a multi-task learner: several rewards, and the assignment of trajectories to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...models.inputs.display import shown_briefly


@shown_briefly
class Clustering(NamedTuple):
    """Components of a mixture, found in the trajectories of one demonstration.

    Fields
    ------
    weights : float ``[D, K]``
        Reward weights of each component.
    proportions : float ``[D]``
        Mixture weights ``pi_d``; they sum to one.
    responsibilities : float ``[n, D]``
        ``v_{d,i}``: probability that trajectory ``i`` belongs to component ``d``; rows sum to one.
    objective : float
        Maximised objective of the method, in nats.
    """

    weights: Float[np.ndarray, "D K"]
    proportions: Float[np.ndarray, " D"]
    responsibilities: Float[np.ndarray, "n D"]
    objective: float

    @property
    def n_components(self) -> int:
        """Number of components, ``D``."""
        return len(self.weights)

    @property
    def assignments(self) -> Int[np.ndarray, " n"]:
        """The likeliest component of each trajectory."""
        return np.asarray(self.responsibilities).argmax(axis=1)
