from collections import Counter
from math import lgamma, log

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.learners.boltzmann import (
    boltzmann_log_likelihoods,
    boltzmann_log_policy,
    reflected,
    visit_counts,
)
from i2rl.inference.learners.dpm import best_sample, crp_log_probability, dpm_birl, log_move
from i2rl.models import Demonstration, DemonstrationError
from i2rl.models.observation.demonstration import concatenate
from i2rl.models.process.planning import simulate
from i2rl.models.process.units import with_scaled_features

ETA, ALPHA = 2.0, 0.8


@pytest.fixture(scope="module")
def mdp(random_mdp):
    # The box is of scaled weights: here they are the weights themselves.
    return with_scaled_features(random_mdp(4, n_states=3, n_actions=2, n_features=1))


@pytest.fixture(scope="module")
def demonstrate(mdp):
    @jax.jit
    def trajectories(key, weight):
        log_policy = boltzmann_log_policy(mdp, jnp.array([1.0]) * weight, ETA)
        return jax.vmap(lambda k: simulate(k, mdp, log_policy, 12))(jax.random.split(key, 4))

    return lambda seed, weight: Demonstration.from_pairs(*trajectories(jax.random.key(seed), weight))


@pytest.fixture(scope="module")
def trajectories(demonstrate):
    return concatenate([demonstrate(0, 0.9).select([0, 1]), demonstrate(1, -0.9).select([0, 1])])


@pytest.fixture(scope="module")
def long_run(mdp, trajectories):
    """Run many iterations of the sampler with moves wide enough to bounce off the box's walls."""
    return dpm_birl(
        mdp, rationality=ETA, alpha=ALPHA, iterations=8_000, proposals=1, updates=1, sigma=0.4
    ).sample(jax.random.key(0), trajectories)


def partitions(n):
    """List all partitions of ``n`` things, as labels by first appearance."""
    found = [(0,)]
    for _ in range(n - 1):
        found = [(*p, label) for p in found for label in range(max(p) + 2)]
    return found


def log_seating(labels, alpha):
    """Probability of a seating, one guest after another."""
    total, sizes = 0.0, Counter()
    for seated, label in enumerate(labels):
        total += log((sizes[label] or alpha) / (seated + alpha))
        sizes[label] += 1
    return total


def frequencies(trace, n, burn_in=500):
    counted = Counter(map(tuple, trace.labels[burn_in:].tolist()))
    return np.array([counted[p] for p in partitions(n)]) / (len(trace.labels) - burn_in)


@pytest.fixture(scope="module")
def enumerated(mdp, trajectories):
    """Probability of each partition, and the posterior mean of each trajectory's weight, by quadrature."""
    axis = np.linspace(-1, 1, 801)
    counts = jnp.asarray(visit_counts(mdp, trajectories))
    table = np.asarray(
        jax.jit(
            lambda: jax.lax.map(
                lambda w: boltzmann_log_likelihoods(mdp, w, counts, ETA), jnp.asarray(axis)[:, None]
            )
        )()
    )
    mass, means = [], []
    for labels in partitions(4):
        evidence, mean = log_seating(labels, ALPHA), np.zeros(4)
        for label in set(labels):
            members = np.array(labels) == label
            density = np.exp(table[:, members].sum(1))
            evidence += np.log(np.trapezoid(density / 2, axis))
            mean[members] = np.trapezoid(axis * density, axis) / np.trapezoid(density, axis)
        mass.append(evidence)
        means.append(mean)
    mass = np.exp(np.array(mass) - np.logaddexp.reduce(mass))
    return mass, mass @ np.array(means)


def test_partition_probabilities_sum_to_one_and_follow_the_restaurant():
    logs = [log_seating(p, ALPHA) for p in partitions(5)]
    assert len(logs) == 52
    np.testing.assert_allclose(np.exp(logs).sum(), 1)
    sizes = [np.bincount(p, minlength=7) for p in partitions(5)]
    np.testing.assert_allclose([crp_log_probability(jnp.asarray(x), ALPHA) for x in sizes], logs)


@pytest.mark.parametrize("mean", [-1.0, 0.9, 0.2])
def test_density_of_a_reflected_move(mean):
    axis = np.linspace(-1, 1, 401)
    log_density = jax.vmap(lambda x: log_move(x[None], jnp.array([mean]), 0.5))(axis)
    density = np.exp(log_density) / (0.5 * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(np.trapezoid(density, axis), 1, atol=1e-4)
    moves = reflected(mean + 0.5 * np.random.default_rng(0).normal(size=200_000))
    assert (np.abs(moves) <= 1).all()
    lower = axis <= 0.5
    below = np.trapezoid(density[lower], axis[lower])
    np.testing.assert_allclose((moves <= 0.5).mean(), below, atol=0.005)


def test_without_data_the_partition_follows_its_prior(mdp, trajectories):
    blind = dpm_birl(mdp, rationality=1e-12, alpha=ALPHA, iterations=8_000, proposals=1, updates=1, sigma=0.4)
    trace = blind.sample(jax.random.key(1), trajectories)
    prior = np.exp([log_seating(p, ALPHA) for p in partitions(4)])
    np.testing.assert_allclose(frequencies(trace, 4), prior, atol=0.02)
    # Nor do the moves off the walls distort the uniform prior of the weights.
    quantiles = np.quantile(trace.weights[500:, 0, 0], np.arange(1, 10) / 10)
    np.testing.assert_allclose(quantiles, np.arange(-4, 5) / 5, atol=0.06)


def test_partitions_follow_the_posterior(long_run, enumerated):
    mass, _ = enumerated
    prior = np.exp([log_seating(p, ALPHA) for p in partitions(4)])
    assert np.abs(mass - prior).sum() / 2 > 0.2
    np.testing.assert_allclose(frequencies(long_run, 4), mass, atol=0.02)


def test_weights_follow_the_posterior(long_run, enumerated):
    _, means = enumerated
    np.testing.assert_allclose(long_run.weights[500:, :, 0].mean(0), means, atol=0.04)


def test_the_joint_density_is_that_of_the_model(mdp, trajectories, long_run):
    counts = jnp.asarray(visit_counts(mdp, trajectories))
    each = jax.jit(
        lambda w: jnp.diagonal(jax.vmap(lambda x: boltzmann_log_likelihoods(mdp, x, counts, ETA))(w))
    )
    for sweep in (0, 17, 5000):
        labels, weights = long_run.labels[sweep], long_run.weights[sweep]
        expected = log_seating(labels, ALPHA) + (labels.max() + 1) * log(0.5) + each(weights).sum()
        np.testing.assert_allclose(long_run.log_joint[sweep], expected, rtol=1e-10)
    best = best_sample(long_run)
    assert best.objective == long_run.log_joint.max()
    at = long_run.log_joint.argmax()
    np.testing.assert_array_equal(best.assignments, long_run.labels[at])
    np.testing.assert_array_equal(best.weights[best.assignments], long_run.weights[at])


def test_one_task_is_explained_as_well_as_by_the_truth(mdp, demonstrate):
    demonstration = demonstrate(2, 0.6)
    found = dpm_birl(mdp, rationality=ETA).fit(jax.random.key(0), demonstration)
    counts = visit_counts(mdp, demonstration)
    truth = boltzmann_log_likelihoods(mdp, jnp.array([0.6]), counts, ETA).sum()
    assert found.n_components == 1
    assert found.objective >= float(truth) + lgamma(4) - lgamma(5) + log(0.5)


def test_padding_one_trajectory_and_identical_trajectories(mdp, trajectories):
    method = dpm_birl(mdp, rationality=ETA)
    alone = method.fit(jax.random.key(0), trajectories.select([0]))
    np.testing.assert_array_equal(alone.responsibilities, [[1]])
    same = trajectories.select([0, 0, 0, 0])
    plain, padded = (method.fit(jax.random.key(1), d) for d in (same, same.padded(6, 12)))
    np.testing.assert_allclose(padded.objective, plain.objective)
    np.testing.assert_allclose(padded.responsibilities[4:], np.tile(plain.proportions, (2, 1)))
    np.testing.assert_allclose(padded.responsibilities.sum(1), 1)


def test_bad_input_is_named(mdp):
    with pytest.raises(ValueError, match="alpha must be positive, got 0"):
        dpm_birl(mdp, alpha=0)
    with pytest.raises(ValueError, match=r"sigma must be at most 0\.5"):
        dpm_birl(mdp, sigma=0.7)
    hidden = Demonstration.from_steps([[(0, 0), None]], mdp)
    with pytest.raises(DemonstrationError, match="trajectory 0, step 1 is a lost frame"):
        dpm_birl(mdp).fit(jax.random.key(0), hidden)
