"""Transitions behind observations: against enumeration, dense matrices, and each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.adversarial.tabular.discriminator import log_probability_of_mean, mean_of_log_probability
from i2rl.inference.completion.smoothing import Evidence, evidence_of
from i2rl.inference.completion.transitions import (
    Settling,
    discounted_transitions,
    exact_transitions,
    gibbs_transitions,
    reported_transitions,
    summarised,
    visited_transitions,
    wide_successors,
)
from i2rl.models import Demonstration, ObservationModel, Sensor, TabularMDP, Visibility, occupancy
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN

HORIZON = 6


@pytest.fixture(scope="module")
def mdp(random_mdp) -> TabularMDP:
    return random_mdp(3, masked=True)


@pytest.fixture(scope="module")
def log_policy(mdp: TabularMDP) -> np.ndarray:
    scores = np.random.default_rng(5).normal(size=mdp.available.shape)
    return np.asarray(jax.nn.log_softmax(jnp.where(mdp.available, scores, -jnp.inf), axis=1))


@pytest.fixture(scope="module")
def sensor(mdp: TabularMDP) -> Sensor:
    rng = np.random.default_rng(7)
    table = rng.dirichlet(np.ones(mdp.n_states * mdp.n_actions), mdp.available.shape)
    reading = ObservationModel.from_probabilities(table.reshape(*mdp.available.shape, *mdp.available.shape))
    return reading * Visibility(np.array([True, True, False, True]))


@pytest.fixture(scope="module")
def demonstration(imperfect_demonstration, mdp, log_policy, sensor) -> Demonstration:
    return imperfect_demonstration(11, mdp, log_policy, sensor, 3, 4)


@pytest.fixture(scope="module")
def evidence(mdp: TabularMDP, sensor: Sensor, demonstration: Demonstration) -> Evidence:
    return evidence_of(mdp, sensor, demonstration)


def _slots(mdp: TabularMDP, s: np.ndarray, a: np.ndarray, following: np.ndarray) -> np.ndarray:
    return np.argmax(np.asarray(mdp.successors)[s, a] == following[..., None], axis=-1)


def test_expectation_over_the_truth_is_that_of_all_trajectories(
    mdp, log_policy, evidence, demonstration, enumerate_completions
):
    logits = np.random.default_rng(0).normal(size=mdp.successors.shape) * 3
    log_d = -np.logaddexp(0, -logits)
    total = steps = 0.0
    starts = np.zeros((HORIZON, mdp.n_states))
    for i, length in enumerate(demonstration.lengths):
        every = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence)[i, :length])
        s, a = every.states, every.actions
        for t in range(length - 1):
            slot = _slots(mdp, s[:, t], a[:, t], s[:, t + 1])
            total += every.posterior @ log_d[s[:, t], a[:, t], slot]
        onward = np.asarray(mdp.probabilities)[s[:, -1], a[:, -1]]
        total += every.posterior @ (onward * log_d[s[:, -1], a[:, -1]]).sum(-1)
        np.add.at(starts[:length], (slice(None), s[:, 0]), every.posterior)
        steps += length
    completed = exact_transitions(mdp, log_policy, evidence, HORIZON)
    expert = summarised(completed)
    assert float(expert.size) == pytest.approx(steps, abs=1e-10)
    found = mean_of_log_probability(jnp.asarray(logits), expert, completed) * expert.size
    assert float(found) == pytest.approx(total, abs=1e-10)
    np.testing.assert_allclose(completed.starts, starts, atol=1e-12)


def test_likelihood_is_that_of_all_trajectories(
    mdp, log_policy, evidence, demonstration, enumerate_completions
):
    completed = exact_transitions(mdp, log_policy, evidence, HORIZON)
    expected = [
        enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence)[i, :n]).log_likelihood
        for i, n in enumerate(demonstration.lengths)
    ]
    np.testing.assert_allclose(completed.log_likelihood, expected, atol=1e-10)


def test_log_of_the_mean_logit_is_larger_and_equal_only_without_doubt(mdp, log_policy, evidence):
    logits = jnp.asarray(np.random.default_rng(1).normal(size=mdp.successors.shape) * 3)
    completed = exact_transitions(mdp, log_policy, evidence, HORIZON)
    mean, mixed = (f(logits, summarised(completed), completed) for f in _averages())
    assert float(mixed) > float(mean) + 1e-3
    # A transition known for sure has one logit.
    steps = jnp.zeros_like(completed.steps).at[:, :, 1, int(np.argmax(mdp.available[1])), 0].set(1.0)
    certain = completed._replace(steps=steps)
    mean, mixed = (f(logits, summarised(certain), certain) for f in _averages())
    assert float(mixed) == pytest.approx(float(mean), abs=1e-12)


def _averages():
    return mean_of_log_probability, log_probability_of_mean


def test_gibbs_estimates_the_same(random_mdp, sensor, demonstration):
    # Every state may follow: one site at a time can move.
    mdp = random_mdp(8, n_successors=4)
    log_policy = jnp.full(mdp.available.shape, -np.log(mdp.n_actions))
    evidence = evidence_of(mdp, sensor, demonstration)
    exact = exact_transitions(mdp, log_policy, evidence, HORIZON)
    drawn = gibbs_transitions(jax.random.key(0), mdp, log_policy, evidence, HORIZON, 2000, 20)
    # Sweeps are correlated: thrice the deviation of independent draws, as an effective size of a ninth.
    spread = np.sqrt(np.asarray(exact.steps) * (1 - np.asarray(exact.steps)) / 2000) * 3
    assert (np.abs(drawn.steps - exact.steps) < 4 * spread + 2e-3).all()
    np.testing.assert_allclose(drawn.steps.sum((2, 3, 4)), evidence.live, atol=1e-9)


def test_gibbs_until_the_average_logit_settles_is_gibbs_with_fewer_sweeps(random_mdp, sensor, demonstration):
    mdp = random_mdp(8, n_successors=4)
    log_policy = jnp.full(mdp.available.shape, -np.log(mdp.n_actions))
    evidence = evidence_of(mdp, sensor, demonstration)
    logits = jnp.asarray(np.random.default_rng(0).normal(size=mdp.successors.shape))
    key = jax.random.key(0)
    fixed = gibbs_transitions(key, mdp, log_policy, evidence, HORIZON, 30, 5)
    never = gibbs_transitions(key, mdp, log_policy, evidence, HORIZON, 30, 5, Settling(logits, 0.0))
    np.testing.assert_allclose(never.steps, fixed.steps, atol=1e-12)
    early = gibbs_transitions(key, mdp, log_policy, evidence, HORIZON, 30, 5, Settling(logits, 0.05))
    np.testing.assert_allclose(early.steps.sum((2, 3, 4)), evidence.live, atol=1e-9)
    assert np.abs(np.asarray(early.steps - fixed.steps)).max() > 0.01


def test_visits_are_powers_of_the_chain(mdp, log_policy, dense_transitions):
    policy, moves = np.exp(log_policy), dense_transitions(mdp)
    starts = np.random.default_rng(2).random((HORIZON, mdp.n_states))
    chain = np.einsum("sa,sat->st", policy, moves)
    visits = sum(starts[t] @ np.linalg.matrix_power(chain, t) for t in range(HORIZON))
    expected = (visits[:, None] * policy)[..., None] * np.asarray(mdp.probabilities) / visits.sum()
    np.testing.assert_allclose(
        visited_transitions(mdp, log_policy, jnp.asarray(starts)), expected, atol=1e-12
    )
    pairs = np.asarray(occupancy(mdp, jnp.asarray(policy))) * (1 - float(mdp.discount))
    shares = discounted_transitions(mdp, log_policy, jnp.zeros((1, mdp.n_states)))
    np.testing.assert_allclose(np.asarray(shares).sum(-1), pairs, atol=1e-9)


def test_reports_of_a_clear_view_are_the_truth(mdp, log_policy, imperfect_demonstration):
    rough = imperfect_demonstration(4, mdp, log_policy, Sensor(), 3, 4)
    clear = _everything_seen(mdp, log_policy, rough)
    exact = exact_transitions(mdp, log_policy, evidence_of(mdp, Sensor(), clear), HORIZON)
    lists = jnp.asarray(wide_successors(mdp))
    taken = reported_transitions(mdp, lists, log_policy, clear, HORIZON)
    width = mdp.successors.shape[2]
    np.testing.assert_allclose(taken.steps[..., :width], exact.steps, atol=1e-12)
    assert not np.asarray(taken.steps[..., width:]).any()
    np.testing.assert_allclose(taken.starts, exact.starts, atol=1e-12)


def _everything_seen(mdp: TabularMDP, log_policy: np.ndarray, like: Demonstration) -> Demonstration:
    rng = np.random.default_rng(3)
    codes = np.full((*like.kind.shape, 3), UNKNOWN)
    for i, length in enumerate(like.lengths):
        s = rng.choice(mdp.n_states, p=np.asarray(mdp.initial))
        for t in range(length):
            a = rng.choice(mdp.n_actions, p=np.exp(log_policy[s]))
            codes[i, t] = SEEN, s, a
            s = int(rng.choice(np.asarray(mdp.successors)[s, a], p=np.asarray(mdp.probabilities)[s, a]))
        codes[i, length:, 0] = PAD
    return Demonstration.from_codes(codes)


def test_what_was_not_seen_is_left_out_and_begins_another_stretch(mdp, log_policy):
    codes = [[(SEEN, 0, 2), (HIDDEN, -1, -1), (SEEN, 2, 0), (SEEN, 3, 2), (SEEN, 0, 1)]]
    lists = jnp.asarray(wide_successors(mdp))
    taken = reported_transitions(mdp, lists, log_policy, Demonstration.from_codes(np.array(codes)), HORIZON)
    assert float(taken.steps.sum()) == pytest.approx(3)
    expected = np.zeros((HORIZON, mdp.n_states))
    expected[0, [0, 2]] = 1
    expected[1, 2] = 1
    np.testing.assert_array_equal(taken.starts, expected)


def test_a_wrong_action_keeps_the_next_state_that_was_seen(mdp, log_policy):
    # Action 2 leads from state 0 to 1 or 3; "2" can only be seen next because action 0 was taken.
    assert set(np.asarray(mdp.successors)[0, 2]) == {1, 3}
    assert 2 in np.asarray(mdp.successors)[0, 0]
    lists = wide_successors(mdp)
    codes = [[(SEEN, 0, 2), (SEEN, 2, 0), (LOST, -1, -1), (LOST, -1, -1), (LOST, -1, -1)]]
    seen = Demonstration.from_codes(np.array(codes))
    taken = reported_transitions(mdp, jnp.asarray(lists), log_policy, seen, HORIZON)
    weights = np.asarray(taken.steps)[0, 0, 0, 2]
    u = np.flatnonzero(weights)
    assert weights[u] == pytest.approx(1)
    assert lists[0, 2, u] == [2]
