"""The corridor of the examples."""

from __future__ import annotations

import numpy as np

from i2rl.domains import five_cells
from i2rl.models.observation.demonstration import HIDDEN, SEEN


def test_the_middle_of_the_corridor_is_out_of_view():
    corridor = five_cells()
    kind, state = np.asarray(corridor.demonstration.kind), np.asarray(corridor.demonstration.state)
    assert kind.shape == (8, 6)
    assert set(np.unique(kind)) == {HIDDEN, SEEN}
    assert not set(state[kind == SEEN].tolist()) & {2, 3}


def test_every_call_gives_the_same_demonstration():
    assert five_cells() is five_cells()
