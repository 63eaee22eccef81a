"""The truth behind continuous recordings: the smoother and the Gibbs sampler against exact answers."""

from __future__ import annotations

import re
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.analysis.benchmarks.statistics.gibbs import PENDULUM, particle_smoother
from i2rl.inference.completion.gaussian import (
    Bounds,
    executed_moments,
    fitted_sensor,
    gaussian_truth,
    jax_dynamics,
    log_joint,
)
from i2rl.inference.completion.gibbs import GaussianGibbs
from i2rl.inference.sessions.serialization import decode, encode, restore
from i2rl.models.networks.modules import ActionSpace, GaussianPolicy
from i2rl.models.observation.recordings import GaussianSensor, distort, log_normal, recording

KEY = jax.random.key(0)
d, k = 2, 1
A = np.array([[0.9, 0.2], [-0.3, 0.8]])
B = np.array([[0.1], [0.5]])
C = np.array([0.05, -0.1])
Q = np.array([[0.02, 0.005], [0.005, 0.03]])


class AffinePolicy(NamedTuple):
    """Actions normal about an affine function of the state, in 64 bits."""

    slope: jax.Array
    intercept: jax.Array
    covariance: jax.Array

    def moments(self, s):
        return s @ self.slope.T + self.intercept, jnp.broadcast_to(self.covariance, (*s.shape[:-1], k, k))

    def log_prob(self, s, a):
        return log_normal(a - self.moments(s)[0], self.covariance)


POLICY = AffinePolicy(jnp.array([[-0.5, 0.4]]), jnp.array([0.1]), jnp.array([[0.2]]))
SENSOR = GaussianSensor([[0.3, 0.1], [0.1, 0.2]], 0.1)


def affine(s, a):
    return jnp.asarray(A) @ s + jnp.asarray(B) @ a + jnp.asarray(C)


AFFINE = jax_dynamics(affine)


def simulated(f, lengths, policy, noise, seed=0):
    """Trajectories of the model itself."""
    rng = np.random.default_rng(seed)
    n = len(lengths)
    s, pairs = jnp.asarray(rng.normal(size=(n, d))), []
    for _ in range(max(lengths)):
        mean, covariance = policy.moments(s)
        a = mean + rng.normal(size=(n, k)) @ np.linalg.cholesky(covariance[0]).T
        pairs.append((s, a))
        s = f.next_state(s, a) + rng.normal(size=(n, d)) @ np.linalg.cholesky(noise).T
    observations, actions = (np.stack(x, 1) for x in zip(*pairs, strict=True))
    return recording(
        [o[:length] for o, length in zip(observations, lengths, strict=True)],
        [a[:length] for a, length in zip(actions, lengths, strict=True)],
    )


def affine_problem(lengths=(4, 6)):
    return distort(KEY, SENSOR, simulated(AFFINE, lengths, POLICY, Q))


def least_squares(reported, i, sensor=SENSOR, prior=1.0):
    """Solve one trajectory's posterior as one weighted least-squares problem in all its pairs; return its
    evidence.

    Rows ``J x - b`` with their covariance, one a factor of the model, without elimination or reordering.
    """
    length, D = int(reported.lengths[i]), d + k
    o, b_a = np.asarray(reported.observations[i]), np.asarray(reported.actions[i])
    sensor = sensor.sized(d, k)
    rows, before = [], None
    for t in range(length):
        here = np.zeros((D, length * D))
        here[:, t * D : (t + 1) * D] = np.eye(D)
        s, a = here[:d], here[d:]
        if before is None:
            rows.append((s, np.zeros(d), prior * np.eye(d)))
        else:
            rows.append((s - A @ before[:d] - B @ before[d:], C, Q))
        rows.append((a - np.asarray(POLICY.slope) @ s, np.asarray(POLICY.intercept), POLICY.covariance))
        rows.append((s, o[t], sensor.state_covariance))
        rows.append((a, b_a[t], sensor.action_covariance))
        before = here
    J, b = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    W = np.zeros((len(b), len(b)))
    at = 0
    for _, r, covariance in rows:
        W[at : at + len(r), at : at + len(r)] = np.linalg.inv(covariance)
        at += len(r)
    precision = J.T @ W @ J
    covariance = np.linalg.inv(precision)
    mean = covariance @ J.T @ W @ b
    residual = b - J @ mean
    log_peak = (
        0.5 * np.linalg.slogdet(W)[1] - 0.5 * residual @ W @ residual - 0.5 * len(b) * np.log(2 * np.pi)
    )
    evidence = log_peak + 0.5 * (np.linalg.slogdet(covariance)[1] + len(mean) * np.log(2 * np.pi))
    return mean.reshape(length, D), covariance.reshape(length, D, length, D), evidence


def affine_truth(**options):
    return gaussian_truth(AFFINE, d, process_covariance=Q, initial_covariance=1.0, **options)


def test_the_smoother_is_exact_on_affine_problems():
    reported = affine_problem()
    truth = affine_truth()
    chain, _ = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    posterior = truth.posterior(chain, POLICY, SENSOR)
    for i, length in enumerate(reported.lengths):
        mean, covariance, evidence = least_squares(reported, i)
        np.testing.assert_allclose(posterior.means[i, :length], mean, atol=1e-8)
        np.testing.assert_allclose(truth.estimate(chain)[0][i, :length], mean[:, :d], atol=1e-8)
        np.testing.assert_allclose(posterior.log_likelihood[i], evidence, atol=1e-8)
        for t in range(length):
            np.testing.assert_allclose(posterior.covariances[i, t], covariance[t, :, t], atol=1e-8)
            if t:
                np.testing.assert_allclose(posterior.lagged[i, t - 1], covariance[t, :, t - 1], atol=1e-8)


def test_draws_have_the_posterior_and_their_own_successors():
    reported = affine_problem()
    truth = affine_truth(draws=20_000)
    _, drawn = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    pairs = np.asarray(jnp.concatenate([drawn.observations, drawn.actions], -1))
    for i, length in enumerate(reported.lengths):
        mean, covariance, _ = least_squares(reported, i)
        spread = np.sqrt(np.einsum("titi->ti", covariance))
        assert (abs(pairs[:, i, :length].mean(0) - mean) < 5 * spread / np.sqrt(20_000)).all()
        np.testing.assert_array_equal(
            drawn.successors[:, i, : length - 1], drawn.observations[:, i, 1:length]
        )
        assert np.asarray(drawn.usable[0, i]).sum() == length - 1


def test_gibbs_accepts_everything_and_agrees_with_the_closed_form_on_affine_problems():
    reported = affine_problem()
    gibbs = GaussianGibbs(affine_truth(draws=250), sweeps=1)
    chain = gibbs.init(reported, SENSOR)
    kept = []
    for i in range(40):
        chain, _ = gibbs.refresh(chain, POLICY, jax.random.fold_in(KEY, i), SENSOR)
        if i >= 5:
            kept.append(np.asarray(jnp.concatenate([chain.observations, chain.actions], -1)))
    assert chain.least_acceptance == 1
    np.testing.assert_allclose(chain.acceptance_whole, 1)
    x = np.stack(kept)  # [sweeps, chains, n, L, D]
    for i, length in enumerate(reported.lengths):
        mean, covariance, _ = least_squares(reported, i)
        of_chains = x[:, :, i, :length].mean(
            0
        )  # chains are independent: their spread is the error of the mean
        error = of_chains.std(0, ddof=1) / np.sqrt(x.shape[1])
        assert (abs(of_chains.mean(0) - mean) < 5 * error).all()
        squares = ((x[:, :, i, :length] - mean) ** 2).mean(0)
        error = squares.std(0, ddof=1) / np.sqrt(x.shape[1])
        assert (abs(squares.mean(0) - np.einsum("titi->ti", covariance)) < 5 * error).all()


def pendulum_problem(lengths, sensor, seed=0, process=1e-2):
    policy = AffinePolicy(jnp.array([[-0.3, 0.5]]), jnp.array([0.2]), jnp.array([[0.3]]))
    truth = simulated(PENDULUM, lengths, policy, process * np.eye(d), seed)
    return policy, truth, distort(jax.random.fold_in(KEY, seed), sensor, truth)


def test_smoother_gibbs_and_importance_sampling_agree_on_a_pendulum():
    sensor = GaussianSensor(0.04, 0.05)
    policy, _, reported = pendulum_problem((6, 4), sensor)
    n = 20_000
    truth = gaussian_truth(PENDULUM, d, process_covariance=1e-2, initial_covariance=1.0, draws=n)
    chain, drawn = truth.refresh(truth.init(reported, sensor), policy, KEY, sensor, passes=5)
    posterior = truth.posterior(chain, policy, sensor)
    gibbs = GaussianGibbs(truth._replace(draws=250), sweeps=1)
    walk, total = gibbs.init(reported, sensor), 0
    for i in range(50):
        walk, _ = gibbs.refresh(walk, policy, jax.random.fold_in(KEY, i), sensor)
        if i >= 10:
            total += np.asarray(jnp.concatenate([walk.observations, walk.actions], -1)) / 40
    assert 0.8 < walk.least_acceptance < 1

    following = PENDULUM.next_state(drawn.observations.reshape(-1, d), drawn.actions.reshape(-1, k))
    log_p = log_joint(
        truth.model,
        policy,
        sensor.sized(d, k),
        reported,
        drawn.observations,
        drawn.actions,
        following.reshape(drawn.observations.shape),
    )
    pairs = np.asarray(jnp.concatenate([drawn.observations, drawn.actions], -1))
    for i, length in enumerate(reported.lengths):
        # The draws' own density, up to a constant, from their empirical moments.
        flat = pairs[:, i, :length].reshape(n, -1)
        centred = flat - flat.mean(0)
        log_w = log_p[:, i] + 0.5 * np.sum(centred * np.linalg.solve(np.cov(flat.T), centred.T).T, 1)
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
        effective = 1 / np.sum(w**2)
        assert effective > 2000
        reference = (w @ flat).reshape(length, d + k)
        spread = np.sqrt(np.asarray(jnp.diagonal(posterior.covariances[i, :length], axis1=1, axis2=2)))
        assert (abs(posterior.means[i, :length] - reference) < 0.15 * spread).all()
        of_chains = total[:, i, :length]
        error = np.sqrt(of_chains.var(0, ddof=1) / 250 + spread**2 / effective)
        assert (abs(of_chains.mean(0) - reference) < 5 * error).all()


class Coin(NamedTuple):
    """Actions about -0.6 or 0.6 whatever the state, 64 bits."""

    means: jax.Array

    def moments(self, s):
        spread = 0.04 + jnp.var(self.means)
        return jnp.zeros((*s.shape[:-1], 1)) + self.means.mean(), jnp.full((*s.shape[:-1], 1, 1), spread)

    def log_prob(self, s, a):
        each = jax.scipy.stats.norm.logpdf(a, self.means, 0.2)
        return jax.nn.logsumexp(each, axis=-1) - jnp.log(2.0)


def test_gibbs_sampling_of_a_mixture_agrees_with_the_sum_over_its_components():
    policy, sensor = Coin(jnp.array([-0.6, 0.6])), GaussianSensor(0.1, 0.3)
    reports = np.array([0.3, 0.15, -0.2, -0.1])  # s_0, a_0, s_1, a_1
    dynamics = jax_dynamics(lambda s, a: 0.8 * s + 0.5 * a)
    reported = recording([reports[[0, 2], None]], [reports[[1, 3], None]])
    gibbs = GaussianGibbs(
        gaussian_truth(dynamics, 1, process_covariance=0.1, initial_covariance=1.0, draws=500), sweeps=1
    )
    chain, total = gibbs.init(reported, sensor), 0.0
    for i in range(80):
        chain, _ = gibbs.refresh(chain, policy, jax.random.fold_in(KEY, i), sensor)
        if i >= 20:
            total += np.asarray(jnp.concatenate([chain.observations, chain.actions], -1))[:, 0] / 60
    assert 0.2 < chain.least_acceptance < 1

    root = np.array([[1, 0, 0, 0], [0, 0.2, 0, 0], [0.8, 0.1, 0.1**0.5, 0], [0, 0, 0, 0.2]])
    prior, noise = root @ root.T, np.diag([0.1, 0.3, 0.1, 0.3])
    weights, means = [], []
    for first in (-0.6, 0.6):
        for second in (-0.6, 0.6):
            mean = np.array([0, first, 0.5 * first, second])
            weights.append(stats.multivariate_normal(mean, prior + noise).pdf(reports))
            means.append(mean + prior @ np.linalg.solve(prior + noise, reports - mean))
    exact = (np.array(weights) @ means / np.sum(weights)).reshape(2, 2)
    error = total.std(0, ddof=1) / np.sqrt(500)
    assert (abs(total.mean(0) - exact) < 5 * error).all()


def test_smoothing_brings_a_pendulum_nearer_to_the_truth_and_knows_how_near():
    sensor = GaussianSensor(0.1, 0.05)
    policy, true, reported = pendulum_problem([30] * 19 + [12], sensor)
    truth = gaussian_truth(PENDULUM, d, process_covariance=1e-2, draws=1)
    chain, _ = truth.refresh(truth.init(reported, sensor), policy, KEY, sensor, passes=5)
    live = np.asarray(true.live)

    def error(x):
        return float(jnp.sqrt(jnp.mean((x - true.observations)[live] ** 2)))

    assert error(truth.estimate(chain)[0]) < 0.5 * error(reported.observations)
    off = np.asarray(chain.means - jnp.concatenate([true.observations, true.actions], -1))[live]
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(chain.covariances[live], off[..., None])[..., 0])
    # A calibrated posterior has d + k on average; steps of a trajectory are correlated.
    assert abs(squares.mean() / (d + k) - 1) < 0.25


class Simulator:
    """The pendulum as a program that is no function of JAX's."""

    def __init__(self):
        self.steps = 0

    def next_state(self, s, a):
        self.steps += len(s)
        turning = 0.95 * s[:, 1] - 1.2 * np.sin(s[:, 0]) + 0.6 * np.tanh(a[:, 0])
        return np.stack([s[:, 0] + 0.2 * turning, turning], 1)


def test_a_simulator_serves_as_well_as_a_function_and_is_not_asked_about_padding():
    sensor = GaussianSensor(0.1, 0.05)
    policy, _, reported = pendulum_problem((6, 4), sensor)
    simulator = Simulator()
    results = []
    for dynamics in (PENDULUM, simulator):
        truth = gaussian_truth(dynamics, d, process_covariance=1e-2)
        chain, drawn = truth.refresh(truth.init(reported, sensor), policy, KEY, sensor, passes=3)
        results.append((*chain[1:], drawn.observations))
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(
            one[:, :3] if one.ndim else one, other[:, :3] if one.ndim else other, atol=1e-9
        )
    pairs = 5 + 3
    assert simulator.steps == 3 * pairs * (1 + 2 * (d + k))


def test_estimates_and_draws_stay_within_bounds():
    reported = affine_problem()
    bounds = {"observation_bounds": (-np.inf, [0.1, np.inf]), "action_bounds": ([-0.2], [0.2])}
    truth = affine_truth(**bounds)
    chain, drawn = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    live = np.asarray(reported.live)
    for s, a in (truth.estimate(chain), (drawn.observations[0], drawn.actions[0])):
        assert s[live][:, 0].max() <= 0.1
        assert abs(a[live]).max() <= 0.2


def test_the_em_algorithm_never_lowers_the_likelihood_and_finds_the_covariances():
    true = simulated(AFFINE, [30] * 20, POLICY, Q, seed=3)
    reported = distort(KEY, SENSOR, true)
    truth = affine_truth(draws=1)
    sensor = GaussianSensor(1.0, 1.0).sized(d, k)
    chain, _ = truth.refresh(truth.init(reported, sensor), POLICY, KEY, sensor)
    values = []
    for _ in range(25):
        posterior = truth.posterior(chain, POLICY, sensor)
        values.append(float(jnp.sum(posterior.log_likelihood)))
        sensor = fitted_sensor(reported, posterior, True)
    assert (np.diff(values) > -1e-8).all()
    expected = SENSOR.sized(d, k)
    np.testing.assert_allclose(jnp.diagonal(sensor.state_covariance), [0.3, 0.2], rtol=0.2)
    np.testing.assert_allclose(sensor.state_covariance[0, 1], expected.state_covariance[0, 1], atol=0.04)
    np.testing.assert_allclose(sensor.action_covariance, 0.1, rtol=0.2)


def test_the_em_algorithm_finds_the_covariances_of_a_pendulums_sensor():
    sensor = GaussianSensor(0.1, 0.1)
    policy, _, reported = pendulum_problem([30] * 20, sensor)
    truth = gaussian_truth(PENDULUM, d, process_covariance=1e-2, draws=1)
    learned = GaussianSensor(0.3, 0.3).sized(d, k)
    chain = truth.init(reported, learned)
    for _ in range(25):
        chain, _ = truth.refresh(chain, policy, KEY, learned)
        learned = fitted_sensor(reported, truth.posterior(chain, policy, learned))
    np.testing.assert_allclose(jnp.diagonal(learned.state_covariance), 0.1, rtol=0.2)
    np.testing.assert_allclose(learned.action_covariance, 0.1, rtol=0.2)


def test_an_action_that_is_cut_to_its_bounds_has_the_moments_of_what_is_executed():
    policy = AffinePolicy(jnp.array([[1.0, 0.0]]), jnp.array([0.0]), jnp.array([[0.3]]))
    bounds = Bounds(jnp.array([-9.0, -9.0, -0.5]), jnp.array([9.0, 9.0, 1.0]))
    states = jnp.array([[0.2, 0.0], [-0.6, 0.0], [1.3, 0.0], [20.0, 0.0]])
    mean, covariance = executed_moments(policy, bounds, states)
    raw = states[:, 0] + 0.3**0.5 * np.random.default_rng(0).normal(size=(400_000, 4))
    executed = np.clip(raw, -0.5, 1.0)
    np.testing.assert_allclose(mean[:, 0], executed.mean(0), atol=5 * 0.5 / np.sqrt(400_000))
    np.testing.assert_allclose(covariance[:, 0, 0], executed.var(0) + 0.03**2, atol=2e-3)


def test_a_chain_survives_its_storage_and_resampling_draws_the_same_from_it():
    reported = affine_problem()
    truth = affine_truth()
    chain, _ = truth.refresh(truth.init(reported, SENSOR), POLICY, KEY, SENSOR)
    stored = restore(decode(encode(chain)), truth.init(reported, SENSOR))
    drawn, again = (truth.resample(c, POLICY, KEY, SENSOR) for c in (chain, stored))
    for one, other in zip(drawn, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_network_is_a_policy():
    policy = GaussianPolicy.create(KEY, d, ActionSpace(0, (-1.0,), (1.0,)))
    truth = affine_truth()
    _, drawn = truth.refresh(truth.init(affine_problem(), SENSOR), policy, KEY, SENSOR)
    assert np.isfinite(np.asarray(drawn.observations)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"process_covariance": -1.0}, "process covariance is not positive definite"),
        ({"process_covariance": [1.0, 1.0, 1.0]}, "process covariance .* 2 components"),
        ({"initial_mean": [0.0]}, "initial_mean"),
        ({"draws": 0}, "at least 1"),
        ({"action_bounds": (-1.0, 1.0)}, "both"),
        ({"observation_bounds": (1.0, -1.0), "action_bounds": ([-1.0], [1.0])}, "below"),
    ],
)
def test_what_is_wrong_with_a_model_is_said(options, message):
    with pytest.raises(ValueError, match=message):
        gaussian_truth(AFFINE, d, **options)


def test_recordings_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"expected observations \[n, L, 3\]"):
        gaussian_truth(AFFINE, 3).init(affine_problem(), SENSOR)


def test_gibbs_leaves_the_reports_where_they_are_noisy_and_single_steps_hardly_move():
    sensor, process = GaussianSensor(0.4, 0.4), 0.003
    policy, _, reported = pendulum_problem((6, 4), sensor, seed=2, process=process)
    truth = gaussian_truth(PENDULUM, d, process_covariance=process, initial_covariance=1.0, draws=250)
    gibbs = GaussianGibbs(truth, sweeps=1)
    chain, kept = gibbs.init(reported, sensor), []
    for i in range(30):
        chain, _ = gibbs.refresh(chain, policy, jax.random.fold_in(KEY, i), sensor)
        if i >= 10:
            kept.append(np.asarray(jnp.concatenate([chain.observations, chain.actions], -1))[:, 0])
    first = jax.tree.map(lambda x: x[:1], reported)
    draws = particle_smoother(KEY, policy, process, 0.4, first, particles=4000, draws=800)
    expected, deviations = np.asarray(draws.mean(0)), np.asarray(draws.std(0))
    reports = np.concatenate([reported.observations[0], reported.actions[0]], -1)
    assert (abs(reports - expected) / deviations).max() > 4
    found = np.concatenate(kept)
    assert (abs(found.mean(0) - expected) / deviations).max() < 0.3
    assert 0.85 < (found.std(0) / deviations).mean() < 1.15
    assert 0.3 < chain.least_acceptance < 1
    assert (chain.acceptance_whole > 0.1).all()
    live = np.asarray(reported.live)
    assert np.asarray(chain.mobility)[live].min() > 0.05
    assert np.isnan(np.asarray(chain.mobility)[~live]).all()


def test_steps_that_hardly_move_are_a_warning():
    # Dynamics so exact that what an affine function leaves over of them rules every joint move out.
    sensor, process = GaussianSensor(0.4, 0.4), 1e-8
    policy, _, reported = pendulum_problem((6, 4), sensor, seed=2, process=process)
    truth = gaussian_truth(PENDULUM, d, process_covariance=process, initial_covariance=1.0, draws=250)
    gibbs = GaussianGibbs(truth, sweeps=1)
    chain = gibbs.init(reported, sensor)
    for i in range(6):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            chain, _ = gibbs.refresh(chain, policy, jax.random.fold_in(KEY, i), sensor)
        assert bool(caught) == (np.nanmin(chain.mobility) < 0.01)
    assert re.search(r"of 10 steps hardly moved, .* trajectory \d, step \d", str(caught[0].message))
    assert chain.least_acceptance > 0.5
