"""The corridor: somebody walks to its end, and the cells in the middle are out of view."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ...models.laws.trajectory import TrajectoryLaw, sample_demonstration
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import Visibility
from ...models.process.mdp import TabularMDP

CELLS, SLIP = 5, 0.1


class Corridor(NamedTuple):
    """A process, the reward weights of its expert, a sensor, and a demonstration seen through it.

    Fields
    ------
    mdp : TabularMDP
        Five cells, the actions left, right and stay, and the features "at the end" and "moves". A move slips
        with probability 0.1: the walker stays.
    weights : float ``[2]``
    sensor : Visibility
        Cells 2 and 3 are out of view.
    demonstration : Demonstration
        Eight trajectories of six steps.
    """

    mdp: TabularMDP
    weights: Float[np.ndarray, " 2"]
    sensor: Visibility
    demonstration: Demonstration


@cache
def five_cells() -> Corridor:
    """Build the corridor, with a demonstration that is the same at every call.

    See Also
    --------
    i2rl.domains.instance : a patrol, the library's main domain

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> corridor.mdp.n_states, corridor.mdp.n_actions, corridor.mdp.feature_names
    (5, 3, ('at the end', 'moves'))
    """
    cell = np.arange(CELLS)
    aims = np.stack([np.maximum(cell - 1, 0), np.minimum(cell + 1, CELLS - 1), cell], axis=1)
    successors = np.stack([aims, np.broadcast_to(cell[:, None], aims.shape)], axis=2)
    probabilities = np.broadcast_to([1 - SLIP, SLIP], successors.shape)
    features = np.stack(
        [np.broadcast_to(cell[:, None] == CELLS - 1, aims.shape), np.broadcast_to([1, 1, 0], aims.shape)], 2
    )
    mdp = TabularMDP.from_successors(
        successors,
        probabilities,
        features,
        initial=cell == 0,
        discount=0.9,
        states=[f"cell {s}" for s in cell],
        actions=["left", "right", "stay"],
        feature_names=["at the end", "moves"],
    )
    weights, sensor = np.array([2.0, -0.2]), Visibility(np.array([1, 1, 0, 0, 1]))
    law = TrajectoryLaw(mdp, weights, sensor, 6)
    demonstration = sample_demonstration(jax.random.key(0), law, 8)
    return Corridor(mdp, weights, sensor, demonstration)
