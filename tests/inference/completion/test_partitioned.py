"""The truth behind mountain-car recordings: candidates and cells, against enumeration."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from i2rl.domains.robots.control import mountain_car_dynamics
from i2rl.inference.completion.partitioned import (
    candidate_truth,
    fitted_shift_sensor,
    partition,
    partition_truth,
)
from i2rl.models.observation.recordings import ShiftSensor, distort, recording

KEY = jax.random.key(0)
LOW, HIGH = [-1.2, -0.07], [0.6, 0.07]
SENSOR = ShiftSensor()


class Pumping(NamedTuple):
    """Pushes the way the car goes, the more surely the faster it is; 64 bits."""

    sharpness: jax.Array

    def log_probs(self, s):
        push = self.sharpness * s[..., 1:]
        return jax.nn.log_softmax(jnp.concatenate([-push, -1 + 0 * push + s[..., :1], push], -1))


POLICY = Pumping(jnp.array(100.0))


@pytest.fixture(scope="module")
def coarse():
    """Nine cells."""
    return partition_truth(mountain_car_dynamics, LOW, HIGH, 3, parts=3, points=900)


@lru_cache
def drives():
    """Six drives of sixty steps."""
    rng = np.random.default_rng(0)
    s, pairs = jnp.asarray(np.column_stack([rng.uniform(-0.6, -0.4, 6), np.zeros(6)])), []
    for _ in range(60):
        p = np.exp(POLICY.log_probs(s))
        a = (rng.random((6, 1)) > np.cumsum(p, 1)).sum(1)
        pairs.append((s, a))
        s = mountain_car_dynamics(s, a)
    return tuple(np.stack(x, 1) for x in zip(*pairs, strict=True))


def driven(lengths, start=0):
    observations, actions = drives()
    return recording(
        [o[start : start + length] for o, length in zip(observations, lengths, strict=False)],
        [a[start : start + length] for a, length in zip(actions, lengths, strict=False)],
        n_actions=3,
    )


def log_weights(truth, reported, i, sensor):
    """Unnormalised log-probability of every sequence of candidates, term by term."""
    length = int(reported.lengths[i])
    o, a = np.asarray(reported.observations[i]), np.asarray(reported.actions[i])
    steps = []  # each step's two truths, their own terms, and what would follow
    for t in range(length):
        back = np.array([o[t], o[t] - [float(sensor.displacement(a[t])), 0]])
        inside = (back >= np.array(LOW) - 1e-6).all(1) & (back <= np.array(HIGH) + 1e-6).all(1)
        report = np.asarray(sensor.log_prob(o[t], a[t], back, a[t]))
        own = np.where(inside, report, -np.inf) + np.asarray(POLICY.log_probs(jnp.asarray(back)))[:, a[t]]
        steps.append((back, own, np.asarray(mountain_car_dynamics(back, jnp.array([a[t], a[t]])))))
    joint = {}
    for which in itertools.product((0, 1), repeat=length):
        total = sum(own[k] for k, (_, own, _) in zip(which, steps, strict=True))
        for t in range(1, length):
            z = (steps[t][0][which[t]] - steps[t - 1][2][which[t - 1]]) / np.asarray(truth.scale)
            total += np.logaddexp(-0.5 * z @ z, np.log(1e-12) - np.log1p(z**2).sum())
        joint[which] = total
    return joint


def test_the_posterior_of_the_candidates_is_that_of_enumeration():
    truth = candidate_truth(mountain_car_dynamics, LOW, HIGH, precision=2e-2)  # so wide that much is possible
    reported = distort(KEY, SENSOR, driven((5, 4)))
    posterior = truth.posterior(reported, POLICY, SENSOR)
    for i, length in enumerate(reported.lengths):
        joint = log_weights(truth, reported, i, SENSOR)
        assert posterior.log_likelihood[i] == pytest.approx(logsumexp(list(joint.values())), abs=1e-10)
        for t in range(length):
            shifted = logsumexp([v for which, v in joint.items() if which[t]]) - posterior.log_likelihood[i]
            np.testing.assert_allclose(posterior.weights[i, t, 1], np.exp(shifted), atol=1e-10)
        np.testing.assert_allclose(posterior.weights[i, :length].sum(-1), 1, atol=1e-10)
        assert not posterior.weights[i, length:].any()


def test_draws_of_candidates_have_their_joint_posterior():
    truth = candidate_truth(mountain_car_dynamics, LOW, HIGH, precision=2e-2, draws=20_000)
    reported = distort(KEY, SENSOR, driven((5, 4)))
    _, drawn = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    joint = log_weights(truth, reported, 0, SENSOR)
    values = np.array(list(joint.values()))
    p = np.exp(values - logsumexp(values))
    shifted = np.asarray(abs(drawn.observations[:, 0, :, 0] - reported.observations[0, :, 0]) > 1e-9)
    counts = np.bincount(shifted @ (2 ** np.arange(5)[::-1]), minlength=32)
    assert (abs(counts / 20_000 - p) < 5 * np.sqrt(p * (1 - p) / 20_000) + 1e-4).all()


def test_the_dynamics_tell_almost_every_shift():
    true = driven((60, 40, 60, 60, 60, 60))
    reported = distort(KEY, SENSOR, true)
    truth = candidate_truth(mountain_car_dynamics, LOW, HIGH)
    _, drawn = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    live = np.asarray(true.live)

    def wrong(observations):
        return float(np.mean(np.asarray(abs(observations - true.observations) > 1e-6)[live].any(-1)))

    assert wrong(reported.observations) > 0.2
    assert wrong(drawn.observations[0]) < 0.02
    np.testing.assert_array_equal(drawn.observations[0, ..., 1][live], true.observations[..., 1][live])
    np.testing.assert_array_equal(drawn.actions[0], true.actions)


def test_the_probability_of_a_shift_is_learned_and_the_likelihood_never_falls():
    sensor = ShiftSensor(probability=0.4)
    reported = distort(KEY, sensor, driven([60] * 6))
    truth = candidate_truth(mountain_car_dynamics, LOW, HIGH)
    learned, values = ShiftSensor(probability=0.1), []
    for _ in range(10):
        posterior = truth.posterior(reported, POLICY, learned)
        values.append(float(posterior.log_likelihood.sum()))
        learned = fitted_shift_sensor(learned, reported, posterior)
    assert (np.diff(values) > -1e-8).all()
    assert float(learned.probability) == pytest.approx(0.4, rel=0.2)


def test_transitions_of_cells_are_shares_of_their_area():
    """A drift of a third of a cell, and every cell's own image by hand."""
    drifting = partition(
        lambda s, a: s + jnp.where(a[..., None] == 1, jnp.array([0.1, 0.0]), 0.0),
        [0.0, 0.0],
        [0.9, 0.9],
        2,
        parts=3,
        points=60**2,
        slack=0.0,
    )
    dense = np.zeros((9, 2, 9))
    for s in range(9):
        dense[s, 0, s] = 1
        dense[s, 1, s] += 2 / 3
        dense[s, 1, s + 3 if s < 6 else s] += 1 / 3  # beyond the border is counted to the last cell
    found = np.zeros((9, 2, 9))
    mdp = drifting.mdp
    for (s, a, b), p in np.ndenumerate(np.asarray(mdp.probabilities)):
        found[s, a, mdp.successors[s, a, b]] += p
    np.testing.assert_allclose(found, dense, atol=1e-12)


def test_the_policy_of_a_cell_is_its_mean_over_the_cell(coarse):
    cut = coarse.partition
    points = np.random.default_rng(0).uniform(LOW, HIGH, (200_000, 2))
    cells, p = np.asarray(cut.cell(points)), np.exp(POLICY.log_probs(jnp.asarray(points)))
    found = np.exp(cut.log_policy(POLICY))
    for s in range(9):
        here = p[cells == s]
        np.testing.assert_allclose(found[s], here.mean(0), atol=5 * 0.5 / np.sqrt(len(here)))


def test_the_posterior_of_cells_is_that_of_enumeration(coarse):
    truth = coarse
    reported = distort(KEY, ShiftSensor(0.3, 0.4), driven((4, 3), start=20))
    sensor = ShiftSensor(0.3, 0.4)
    factors = np.asarray(truth.factors(reported, POLICY, sensor))
    mdp = truth.partition.mdp
    dense = np.zeros((9, 3, 9))
    for (s, a, b), p in np.ndenumerate(np.asarray(mdp.probabilities)):
        dense[s, a, mdp.successors[s, a, b]] += p
    found = truth.cells(reported, POLICY, sensor)
    for i, length in enumerate(reported.lengths):
        o, actions = np.asarray(reported.observations[i]), np.asarray(reported.actions[i])
        expected, log_policy = np.zeros((length, 9)), np.asarray(truth.partition.log_policy(POLICY))
        step = np.zeros((length, 9))
        for t in range(length):
            for x, share in ((o[t, 0], 0.6), (o[t, 0] - float(sensor.displacement(actions[t])), 0.4)):
                s = int(truth.partition.cell(jnp.array([x, o[t, 1]])))
                step[t, s] += share * (-1.2 <= x <= 0.6) * np.exp(log_policy[s, actions[t]])
        for path in itertools.product(range(9), repeat=int(length)):
            p = np.prod(step[np.arange(length), path])
            for t in range(1, length):
                p *= dense[path[t - 1], actions[t - 1], path[t]]
            for t, s in enumerate(path):
                expected[t, s] += p
        np.testing.assert_allclose(found[i, :length], expected / expected.sum(1, keepdims=True), atol=1e-10)
        assert np.isneginf(factors[i, 0][:, np.arange(3) != actions[0]]).all()


def test_draws_are_behind_the_reports(coarse):
    truth = coarse._replace(draws=3)
    reported = distort(KEY, SENSOR, driven((5, 4)))
    chain, drawn = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    log_p = SENSOR.log_prob(chain.observations, chain.actions, drawn.observations, drawn.actions)
    assert np.isfinite(log_p[:, reported.live]).all()
    assert np.asarray(drawn.usable).sum() == 3 * (4 + 3)


def test_a_report_that_nothing_can_be_behind_is_named(coarse):
    reported = driven((5, 4))
    reported = reported._replace(observations=reported.observations.at[1, 2, 0].set(2.0))
    for truth in (candidate_truth(mountain_car_dynamics, LOW, HIGH), coarse):
        with pytest.raises(ValueError, match="trajectory 1, step 2"):
            truth.init(reported, SENSOR)


def test_bounds_must_be_bounds():
    with pytest.raises(ValueError, match="low below high"):
        candidate_truth(mountain_car_dynamics, HIGH, LOW)
    with pytest.raises(ValueError, match="finite"):
        partition(mountain_car_dynamics, [-np.inf, 0], [0.0, 1.0], 3)
