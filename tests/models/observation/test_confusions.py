"""Confusions: one object that injects errors and gives their probability."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.models import Visibility
from i2rl.models.observation.confusions import Confusions

A, B, C = range(3)


@pytest.fixture
def noise() -> Confusions:
    return Confusions.of_actions(2, [(A, B), (C, A)], np.array([0.2, 0.4]), 3)


def test_a_pair_is_reported_as_its_confusion_says(noise: Confusions):
    table = np.exp(noise.noise.log_probabilities)
    np.testing.assert_allclose(table.sum((2, 3)), 1)
    for s in range(2):
        assert table[s, A, s, A] == pytest.approx(0.8)
        assert table[s, A, s, B] == pytest.approx(0.2)
        assert table[s, B, s, B] == pytest.approx(1)
        assert table[s, C, s, A] == pytest.approx(0.4)


def test_reports_occur_as_often_as_they_should(noise: Confusions):
    keys = jax.random.split(jax.random.key(0), 4000)
    s, a = jax.vmap(lambda k: noise.noise.report(k, jnp.array(1), jnp.array(C)))(keys)
    assert (s == 1).all()
    share = float((a == A).mean())
    assert share == pytest.approx(0.4, abs=4 * np.sqrt(0.24 / 4000))


def test_which_confusion_explains_a_report(noise: Confusions):
    truth, observation = jnp.array([0, 0, 2, 4]), jnp.array([0, 1, 0, 4])
    expected = [[False, False], [True, False], [False, True], [False, False]]
    np.testing.assert_array_equal(noise.confused(truth, observation), expected)


def test_composes_with_a_view(noise: Confusions):
    sensor = noise * Visibility(np.array([True, False]))
    np.testing.assert_array_equal(sensor.visibility, [1, 0])
    assert sensor.noise is not None


@pytest.mark.parametrize(
    ("observations", "p", "says"),
    [
        (np.array([[[1, 1]], [[0, 0]]]), [0.1], "2 confusions need as many"),
        (np.array([[[1, 1]]]), [1.5], "confusion 0 is 1.5"),
        (np.array([[[1, 2]]]), [0.1], "0 to 1; got 2"),
        (np.array([[[1, 1]], [[1, 1]]]), [0.1, 0.1], "confused in 2 ways"),
        (np.array([[0.5]]), [0.1], "whole numbers"),
    ],
)
def test_what_is_no_confusion_is_named(observations, p, says):
    with pytest.raises(ValueError, match=says):
        Confusions(observations, np.array(p))
