"""What a multi-task learner concludes: several rewards, and which trajectory was done which way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...models.inputs.display import shown_briefly


@shown_briefly
class Clustering(NamedTuple):
    """Ways of doing a task, found in a jumble of trajectories.

    Fields
    ------
    weights : float ``[D, K]``
        Reward weights of each way.
    proportions : float ``[D]``
        Mixture weights ``pi_d``; they sum to one.
    responsibilities : float ``[n, D]``
        ``v_{d,i}``: probability that trajectory ``i`` was done in component ``d``; rows sum to one.
    objective : float
        What the method maximised, in nats.
    """

    weights: Float[np.ndarray, "D K"]
    proportions: Float[np.ndarray, " D"]
    responsibilities: Float[np.ndarray, "n D"]
    objective: float

    @property
    def n_components(self) -> int:
        """Number of ways found, ``D``."""
        return len(self.weights)

    @property
    def assignments(self) -> Int[np.ndarray, " n"]:
        """The likeliest way of each trajectory."""
        return np.asarray(self.responsibilities).argmax(axis=1)
