"""Identification of the sensor: whether the expert's errors could be the sensor's."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from i2rl.domains.noisy import tasks as noisy_perception
from i2rl.inference import run_sessions
from i2rl.inference.learners.identification import sensor_identification
from i2rl.inference.learners.noisy import rimeo
from i2rl.models.observation.demonstration import LOST, DemonstrationError, concatenate

KEY = jax.random.key(2)


@cache
def learned(starts):
    task = noisy_perception.noisy_sorting()
    shown = noisy_perception.demonstrate_noisy(KEY, task, sessions=20, starts=starts)
    sessions = list(shown.seen.sessions(2))
    run = run_sessions(rimeo(shown.mdp, task.features, scores="none"), sessions, key=KEY)
    result = sensor_identification(
        shown.mdp, task.features, concatenate(sessions), run.state.weights, scores="none"
    )
    return task, result


def test_from_all_starts_the_sensor_is_known_whoever_errs():
    task, result = learned("all")
    assert result.identified.all()
    weights = task.pair_distribution("all", 3)
    true = noisy_perception.agreement_probabilities(task.noise, task.features, weights)
    np.testing.assert_allclose(result.erratic, true, atol=0.06)
    np.testing.assert_allclose(result.optimal, true, atol=0.06)


def test_from_the_natural_start_noise_may_be_the_experts_or_the_sensors():
    task, result = learned("natural")
    assert not result.identified.all()
    said = result.describe(task.feature_names)
    assert "not identified" in said
    doubtful = int(np.flatnonzero(~result.identified)[0])
    assert task.feature_names[doubtful] in said
    # Nothing but what the noise changes is in doubt.
    assert set(np.flatnonzero(~result.identified)) <= {0, 4, 5, 6, 7}


def test_duplicated_predicates_are_named_and_only_their_product_is_learned():
    task, result = learned("all")
    assert "only a combination of onion to bin, hand to bin is identified" in result.describe(
        task.feature_names
    )


def test_what_does_not_fit_is_refused():
    task = noisy_perception.noisy_sorting()
    shown = noisy_perception.demonstrate_noisy(KEY, task, sessions=1)
    with pytest.raises(ValueError, match=r"\[K\] = \[11\], got \[3\]"):
        sensor_identification(shown.mdp, task.features, shown.seen, np.ones(3))
    weights = np.ones(11)
    with pytest.raises(ValueError, match=r"\[J, S, A\] = \[J, 22, 7\], got \[10, 3, 7\]"):
        sensor_identification(shown.mdp, task.features[:, :3], shown.seen, weights)
    with pytest.raises(ValueError, match="scores must be one of"):
        sensor_identification(shown.mdp, task.features, shown.seen, weights, scores="some")
    with pytest.raises(ValueError, match="fitted, not given"):
        sensor_identification(shown.mdp, task.features, shown.seen, weights, visibility=task.noise)
    lost = replace(shown.seen, kind=np.full_like(shown.seen.kind, LOST))
    with pytest.raises(DemonstrationError, match="nothing was reported"):
        sensor_identification(shown.mdp, task.features, lost, weights)
    reportable = np.ones(shown.mdp.available.shape, bool)
    reportable[shown.seen.state[1, 1], shown.seen.action[1, 1]] = False
    with pytest.raises(DemonstrationError, match=r"trajectory [01], step [012]: impossible"):
        sensor_identification(shown.mdp, task.features, shown.seen, weights, reportable=reportable)
