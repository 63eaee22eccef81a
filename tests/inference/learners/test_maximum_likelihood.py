import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.learners.boltzmann import boltzmann_log_likelihoods, boltzmann_log_policy, visit_counts
from i2rl.inference.learners.maximum_likelihood import ascend, em_mlirl, mlirl
from i2rl.models import Demonstration, DemonstrationError
from i2rl.models.observation.demonstration import concatenate
from i2rl.models.process.planning import simulate
from i2rl.models.process.units import with_scaled_features

ETA = 3.0
TRUE = np.array([[0.9, -0.6], [-0.8, 0.5]])


@pytest.fixture(scope="module")
def mdp(random_mdp):
    # The box is of scaled weights: here they are the weights themselves.
    return with_scaled_features(random_mdp(2, n_states=6, n_actions=3, n_features=2))


@pytest.fixture(scope="module")
def demonstrate(mdp):
    @jax.jit
    def trajectories(key, weights):
        log_policy = boltzmann_log_policy(mdp, weights, ETA)
        return jax.vmap(lambda k: simulate(k, mdp, log_policy, 20))(jax.random.split(key, 8))

    return lambda seed, weights: Demonstration.from_pairs(
        *trajectories(jax.random.key(seed), jnp.asarray(weights))
    )


@pytest.fixture(scope="module")
def trajectories(demonstrate):
    return concatenate([demonstrate(0, TRUE[0]), demonstrate(1, TRUE[1])])


@pytest.fixture(scope="module")
def log_likelihood(mdp):
    value = jax.jit(lambda w, counts: boltzmann_log_likelihoods(mdp, w, counts, ETA))
    return lambda weights, counts: np.asarray(value(jnp.asarray(weights), jnp.asarray(counts)))


def test_one_expert_is_fitted_as_well_as_a_grid_search_fits_it(mdp, demonstrate, log_likelihood):
    demonstration = demonstrate(0, TRUE[0])
    counts = visit_counts(mdp, demonstration)
    fit = mlirl(jax.random.key(0), mdp, demonstration, rationality=ETA)
    np.testing.assert_allclose(log_likelihood(fit.weights, counts).sum(), fit.log_likelihood, rtol=1e-10)
    assert fit.log_likelihood == fit.objective.max()
    assert fit.log_likelihood >= log_likelihood(TRUE[0], counts).sum()
    axis = np.linspace(-1, 1, 31)
    grid = jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
    searched = jax.jit(lambda: jax.lax.map(lambda w: boltzmann_log_likelihoods(mdp, w, counts, ETA), grid))()
    assert fit.log_likelihood >= searched.sum(1).max()


def test_the_ascent_never_falls_and_stays_in_the_box(mdp, demonstrate):
    counts = jnp.asarray(visit_counts(mdp, demonstrate(0, TRUE[0])).sum(0))
    climb = jax.jit(lambda start, steps: ascend(mdp, counts, start, 10.0, steps))
    values = [climb(jnp.array([0.3, 0.9]), steps) for steps in (0, 1, 2, 4, 8, 16, 64)]
    assert (np.diff([point.value for point in values]) >= 0).all()
    assert all((np.abs(point.weights) <= 1).all() for point in values)


def test_the_marginal_likelihood_of_em_never_falls(mdp, trajectories, log_likelihood):
    trace = em_mlirl(mdp, n_components=2, rationality=ETA, iterations=15, restarts=3).trace(
        jax.random.key(0), trajectories
    )
    assert trace.log_likelihoods.shape == (3, 16)
    assert (np.diff(trace.log_likelihoods, axis=1) >= -1e-8).all()
    weights, proportions, responsibilities, objective = trace.clustering
    assert objective == trace.log_likelihoods[:, -1].max()
    # What is reported belongs together, by the definition of a mixture.
    counts = visit_counts(mdp, trajectories)
    joint = np.log(proportions) + np.stack([log_likelihood(w, counts) for w in weights], axis=1)
    assert np.logaddexp.reduce(joint, axis=1).sum() >= objective - 1e-8
    np.testing.assert_allclose(responsibilities.sum(1), 1)
    np.testing.assert_allclose(proportions, responsibilities.mean(0))


def test_two_ways_are_told_apart(mdp, trajectories, log_likelihood):
    clustering = em_mlirl(mdp, n_components=2, rationality=ETA, iterations=15, restarts=3).fit(
        jax.random.key(0), trajectories
    )
    found, truth = clustering.assignments, np.repeat([0, 1], 8)
    counts = visit_counts(mdp, trajectories)
    oracle = np.stack([log_likelihood(w, counts) for w in TRUE], axis=1)
    # No method can do better than somebody who knows both rewards.
    best = (oracle.argmax(1) == truth).mean()
    assert max((found == truth).mean(), (found != truth).mean()) >= best - 1 / 16
    assert clustering.objective >= np.logaddexp.reduce(oracle + np.log(0.5), axis=1).sum()


def test_one_cluster_is_mlirl(mdp, trajectories):
    clustering = em_mlirl(mdp, n_components=1, rationality=ETA, iterations=15, restarts=3).fit(
        jax.random.key(1), trajectories
    )
    alone = mlirl(jax.random.key(2), mdp, trajectories, rationality=ETA)
    np.testing.assert_allclose(clustering.objective, alone.log_likelihood, atol=0.05)
    np.testing.assert_array_equal(clustering.responsibilities, 1)


def test_padding_rows_and_identical_trajectories(mdp, trajectories):
    same = trajectories.select([3] * 16)
    em = em_mlirl(mdp, n_components=2, rationality=ETA, iterations=15, restarts=3)
    plain, padded = (em.fit(jax.random.key(0), d) for d in (same, same.padded(18, 20)))
    assert np.ptp(plain.responsibilities, axis=0).max() < 1e-12
    np.testing.assert_allclose(padded.objective, plain.objective)
    np.testing.assert_allclose(padded.responsibilities[16:], np.tile(plain.proportions, (2, 1)))


def test_bad_input_is_named(mdp, trajectories):
    em = em_mlirl(mdp, n_components=2, rationality=ETA, iterations=3)
    with pytest.raises(ValueError, match="at most the number of trajectories, 1; got 2"):
        em.fit(jax.random.key(0), trajectories.select([0]))
    with pytest.raises(ValueError, match="n_components must be positive, got 0"):
        em_mlirl(mdp, n_components=0)
    with pytest.raises(ValueError, match="rationality must be positive, got -1"):
        mlirl(jax.random.key(0), mdp, trajectories, rationality=-1)
    hidden = Demonstration.from_steps([[(0, 0)], ["hidden"]], mdp)
    with pytest.raises(DemonstrationError, match="trajectory 1, step 0 is hidden"):
        em.fit(jax.random.key(0), hidden)
    with pytest.raises(DemonstrationError, match="trajectory 1, step 0 is hidden"):
        mlirl(jax.random.key(0), mdp, hidden)
