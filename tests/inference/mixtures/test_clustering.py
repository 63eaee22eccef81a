"""Conclusions of a multi-task learner."""

import numpy as np

from i2rl.inference.mixtures.clustering import Clustering


def test_a_trajectory_belongs_to_its_likeliest_way():
    shares = np.array([[0.9, 0.1, 0.0], [0.2, 0.3, 0.5]])
    found = Clustering(np.zeros((3, 2)), np.array([0.5, 0.3, 0.2]), shares, -1.0)
    assert found.n_components == 3
    assert found.assignments.tolist() == [0, 2]
