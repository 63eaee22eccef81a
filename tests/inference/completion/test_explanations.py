"""Explanations of mixed demonstrations, wholly seen or completed, are equal."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.completion.explanations import (
    explain,
    explain_each,
    is_seen_whole,
    seen_in_part,
    seen_whole,
    without_reward,
)
from i2rl.models import Demonstration, Sensor, TrajectoryLaw, Visibility
from i2rl.models.observation.demonstration import HIDDEN
from i2rl.models.process.planning import reward_of, soft_plan

WEIGHTS = jnp.array([[2.0, -1.0, 1.0], [-2.0, 2.0, -1.0]])


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(3, n_states=5, n_features=3, masked=True)


@pytest.fixture(scope="module")
def policies(mdp):
    return jnp.stack([soft_plan(mdp, reward_of(mdp, w)).log_policy for w in WEIGHTS])


@pytest.fixture(scope="module")
def demonstration(mdp):
    law = TrajectoryLaw(mdp, WEIGHTS[0], Sensor(), 7)
    long = Demonstration.from_codes(np.asarray(law.sample(jax.random.key(0), (3,))))
    # Of unequal length, and one row more than there are trajectories.
    kind = np.array(long.kind)
    kind[1, 4:] = 0
    return replace(long, kind=kind).padded(4, 8)


@pytest.mark.parametrize("sensor", [Sensor(), Visibility(np.array([1.0, 0.4, 0.7, 1.0, 0.9]))])
def test_both_forms_explain_a_fully_seen_jumble_alike(mdp, policies, demonstration, sensor):
    assert is_seen_whole(sensor, demonstration)
    whole = explain_each(mdp, policies, seen_whole(mdp, sensor, demonstration))
    in_part = explain_each(mdp, policies, seen_in_part(mdp, sensor, demonstration))
    for name, one, other in zip(whole._fields, whole, in_part, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10, err_msg=name)
    np.testing.assert_allclose(whole.visits[0].sum((1, 2)), demonstration.lengths)


def test_the_law_of_a_trajectory_is_its_likelihood(mdp, policies, demonstration):
    got = explain(mdp, policies[1], seen_whole(mdp, Sensor(), demonstration)).log_likelihood
    law = TrajectoryLaw(mdp, WEIGHTS[1], Sensor(), 8)
    expected = [float(law.log_prob(jnp.asarray(row))) for row in demonstration.codes[:3]]
    np.testing.assert_allclose(got[:3], expected, atol=1e-9)
    assert got[3] == 0


def test_a_hidden_step_asks_for_completion(mdp, policies, demonstration):
    kind = np.array(demonstration.kind)
    state, action = np.array(demonstration.state), np.array(demonstration.action)
    kind[0, 2], state[0, 2], action[0, 2] = HIDDEN, -1, -1
    gappy = replace(demonstration, kind=kind, state=state, action=action)
    sensor = Visibility(np.array([1.0, 0.4, 0.7, 1.0, 0.9]))
    assert not is_seen_whole(sensor, gappy)
    explained = explain(mdp, policies[0], seen_in_part(mdp, sensor, gappy))
    np.testing.assert_allclose(explained.visits.sum((1, 2)), demonstration.lengths, atol=1e-10)
    np.testing.assert_allclose((explained.visits - explained.seen)[0].sum(), 1, atol=1e-10)
    np.testing.assert_allclose(explained.visits[1:], explained.seen[1:], atol=1e-10)


def test_an_unavailable_action_cannot_have_happened(mdp, policies, demonstration):
    s, a = (int(x) for x in np.argwhere(~np.asarray(mdp.available))[0])
    state, action = np.array(demonstration.state), np.array(demonstration.action)
    state[0, 0], action[0, 0] = s, a
    wrong = replace(demonstration, state=state, action=action)
    explained = explain(mdp, policies[0], seen_whole(mdp, Sensor(), wrong))
    assert np.asarray(explained.log_likelihood)[0] == -np.inf
    assert np.isfinite(np.asarray(explained.log_likelihood)[1:]).all()


def test_without_a_reward_every_available_action_is_as_likely(mdp, demonstration):
    trajectories = seen_whole(mdp, Sensor(), demonstration)
    choices = np.asarray(mdp.available).sum(1)
    expected = trajectories.constant - np.einsum("nsa,s->n", np.asarray(trajectories.visits), np.log(choices))
    np.testing.assert_allclose(without_reward(mdp, trajectories).log_likelihood, expected, atol=1e-10)
