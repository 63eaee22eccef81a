"""Recordings are checked on input; sensors observe with their stated frequencies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.models.observation.recordings import (
    GaussianSensor,
    RecordingError,
    ShiftSensor,
    distort,
    recording,
    truths,
)

KEY = jax.random.key(0)


def trajectories(lengths=(3, 5), d=2, k=1):
    rng = np.random.default_rng(1)
    return [rng.normal(size=(n, d)) for n in lengths], [rng.normal(size=(n, k)) for n in lengths]


def test_trajectories_are_padded_and_their_ends_known():
    o, a = trajectories()
    r = recording(o, a, terminated=[True, False], length=6)
    assert r.observations.shape == (2, 6, 2)
    assert list(r.lengths) == [3, 5]
    np.testing.assert_array_equal(r.observations[0, :3], o[0])
    assert np.asarray(r.followed).sum(1).tolist() == [2, 4]
    assert np.argwhere(np.asarray(r.last)).tolist() == [[0, 2], [1, 4]]


def test_draws_become_transitions_that_respect_ends():
    o, a = trajectories()
    r = recording(o, a, terminated=[True, False])
    draws = truths(r, r.observations[None], r.actions[None])
    np.testing.assert_array_equal(draws.successors[0, 1, 1], o[1][2])
    assert np.asarray(draws.usable[0]).sum(1).tolist() == [3, 4]  # the first one's last step terminated
    assert np.argwhere(np.asarray(draws.terminated[0])).tolist() == [[0, 2]]


def _nan(o, a):
    o[1][2, 0] = np.nan
    return o, a


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_nan, "trajectory 1, step 2: the observation"),
        (lambda o, a: (o, [a[0], a[1][:-1]]), "trajectory 1 has 5 observations and 4 actions"),
        (lambda o, a: ([o[0][:1], o[1]], [a[0][:1], a[1]]), "trajectory 0 has 1 step"),
        (lambda o, a: ([o[0], o[1][:, :1]], a), "trajectory 1 has observations .* unlike trajectory 0"),
        (lambda o, a: (o, [x[:, 0] for x in a]), "must be integers"),
        (lambda o, a: (o, [np.array([0, 1, 3]), np.zeros(5, int)]), "trajectory 0, step 2: .* no action 3"),
        (lambda o, a: (o, a[:1]), "got 2 and 1"),
    ],
)
def test_what_is_wrong_with_a_recording_is_named(spoil, message):
    with pytest.raises(RecordingError, match=message):
        recording(*spoil(*trajectories()), n_actions=3)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (0.0, "least eigenvalue is 0"),
        ([1.0, -1.0], "least eigenvalue is -1"),
        ([[1.0, 2.0], [2.0, 1.0]], "state covariance is not positive definite"),
        ([[1.0, 0.5], [0.0, 1.0]], "not symmetric"),
        (np.nan, "not finite"),
        (np.ones((2, 3)), "got shape"),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance, message):
    with pytest.raises(ValueError, match=message):
        GaussianSensor(covariance, 1.0)


def test_a_covariance_of_the_wrong_size_is_refused():
    with pytest.raises(ValueError, match=r"state covariance .* 3 components"):
        GaussianSensor([1.0, 2.0], 1.0).log_prob(*(jnp.zeros(3), jnp.zeros(1)) * 2)


def test_the_gaussian_sensor_reports_with_the_moments_and_density_of_its_covariances():
    state = np.array([[0.5, 0.2], [0.2, 0.3]])
    sensor = GaussianSensor(state, 0.05)
    s, a = jnp.array([1.0, -2.0]), jnp.array([0.5])
    n = 100_000
    o, b = sensor.sample(KEY, jnp.broadcast_to(s, (n, 2)), jnp.broadcast_to(a, (n, 1)))
    np.testing.assert_allclose(np.cov(np.asarray(o).T), state, atol=6 * 0.5 * np.sqrt(2 / n))
    np.testing.assert_allclose(np.var(np.asarray(b)), 0.05, rtol=6 * np.sqrt(2 / n))
    assert abs(np.corrcoef(np.asarray(jnp.concatenate([o, b], 1)).T)[2, :2]).max() < 6 / np.sqrt(n)
    density = stats.multivariate_normal(s, state).logpdf(o) + stats.norm(0.5, 0.05**0.5).logpdf(b[:, 0])
    np.testing.assert_allclose(sensor.log_prob(o, b, s, a), density, rtol=1e-10)


def test_a_number_a_diagonal_and_a_matrix_are_one_sensor():
    points = jnp.arange(6.0).reshape(3, 2), jnp.ones((3, 1)), jnp.zeros((3, 2)), jnp.zeros((3, 1))
    values = [GaussianSensor(c, 1.0).log_prob(*points) for c in (0.3, [0.3, 0.3], 0.3 * np.eye(2))]
    np.testing.assert_allclose(values[0], values[1])
    np.testing.assert_allclose(values[0], values[2])


def test_the_shift_sensor_reports_with_the_frequencies_it_claims():
    sensor = ShiftSensor(0.1, 0.3)
    n = 20_000
    for action, direction in ((0, -1), (1, -1), (2, 1)):
        s, a = jnp.broadcast_to(jnp.array([-1.19, 0.01]), (n, 2)), jnp.full(n, action)
        o, b = sensor.sample(jax.random.key(action), s, a)
        assert (b == action).all()
        assert (o[:, 1] == 0.01).all()
        reports, counts = np.unique(np.asarray(o[:, 0]), return_counts=True)
        at = jnp.column_stack([reports, np.full(len(reports), 0.01)])
        p = np.exp(sensor.log_prob(at, jnp.full(2, action), s[:2], a[:2]))
        assert p.sum() == pytest.approx(1)
        np.testing.assert_allclose(counts / n, p, atol=5 * np.sqrt(0.25 / n))
        assert sorted(reports) == pytest.approx(sorted([-1.19, -1.19 + direction * 0.1]))


def test_what_the_shift_sensor_cannot_report_is_impossible():
    sensor = ShiftSensor()
    s, a = jnp.array([0.1, 0.01]), jnp.array(2)
    for report, action in (([0.1, 0.02], 2), ([0.1, 0.01], 1), ([0.1 - sensor.shift, 0.01], 2)):
        assert sensor.log_prob(jnp.array(report), jnp.array(action), s, a) == -jnp.inf


def test_distortion_leaves_padding_alone():
    r = recording(*trajectories())
    noisy = distort(KEY, GaussianSensor(0.1, 0.1), r)
    dead = ~np.asarray(r.live)
    np.testing.assert_array_equal(noisy.observations[dead], r.observations[dead])
    assert (noisy.observations != r.observations)[r.live].all()


def test_normal_noise_is_not_added_to_numbers_of_actions():
    numbered = recording([np.zeros((5, 2))], [np.zeros(5, int)])
    with pytest.raises(ValueError, match=r"action vectors .*got shape \(1, 5\) beside"):
        distort(jax.random.key(0), GaussianSensor(0.1, 0.1), numbered)
