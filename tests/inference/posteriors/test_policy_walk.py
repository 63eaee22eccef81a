import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from i2rl.inference.learners.boltzmann import boltzmann_log_likelihoods, boltzmann_log_policy, visit_counts
from i2rl.inference.posteriors.policy_walk import birl
from i2rl.models import Demonstration, DemonstrationError
from i2rl.models.process.planning import simulate
from i2rl.models.process.units import feature_scale

ETA = 2.0
TRUE = jnp.array([0.8, -0.3])


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(4, n_states=3, n_actions=2, n_features=2)


@pytest.fixture(scope="module")
def demonstration(mdp):
    log_policy = jax.jit(lambda: boltzmann_log_policy(mdp, TRUE, ETA))()
    draw = jax.jit(jax.vmap(lambda key: simulate(key, mdp, log_policy, 15)))
    return Demonstration.from_pairs(*draw(jax.random.split(jax.random.key(0), 3)))


@pytest.fixture(scope="module")
def grid(mdp, demonstration):
    """Centres of cells ``[G, 2]`` that tile the box of scaled weights, and the log-likelihood of each."""
    axis = (np.arange(100) + 0.5) / 50 - 1
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    counts = jnp.asarray(visit_counts(mdp, demonstration))
    scaled = jnp.asarray(points / feature_scale(mdp))
    total = jax.jit(
        lambda: jax.lax.map(lambda w: boltzmann_log_likelihoods(mdp, w, counts, ETA).sum(), scaled)
    )
    return points, np.asarray(total())


def cells(weights):
    """Share of draws in each of 4 x 4 cells of the box."""
    return np.histogram2d(*weights.reshape(-1, 2).T, bins=4, range=[[-1, 1]] * 2)[0] / (weights.size / 2)


OPTIONS = {"rationality": ETA, "draws": 10_000, "warmup": 500, "chains": 2}
PRIORS = {
    "uniform": (None, lambda w: np.zeros(len(w))),
    "normal": (dist.Normal(0.5, 0.4), lambda w: -(((w - 0.5) / 0.4) ** 2).sum(1) / 2),
    "positive": (dist.Uniform(0.0, 3.0), lambda w: np.where((w > 0).all(1), 0.0, -np.inf)),
}


@pytest.mark.parametrize("name", PRIORS)
def test_draws_follow_the_posterior(mdp, demonstration, grid, name):
    prior, log_density = PRIORS[name]
    points, log_likelihood = grid
    idata = birl(jax.random.key(1), mdp, demonstration, prior=prior, **OPTIONS)
    mass = np.exp(log_likelihood + log_density(points) - log_likelihood.max())
    expected = np.histogram2d(*points.T, bins=4, range=[[-1, 1]] * 2, weights=mass / mass.sum())[0]
    np.testing.assert_allclose(
        cells(idata.posterior["weights"].values * feature_scale(mdp)), expected, atol=0.02
    )
    assert az.rhat(idata)["weights"].max() < 1.02


def test_inference_data_is_named_and_consistent(mdp, demonstration):
    idata = birl(jax.random.key(1), mdp, demonstration, **OPTIONS)
    assert idata.posterior["weights"].dims == ("chain", "draw", "feature")
    assert idata.log_likelihood["demonstration"].dims == ("chain", "draw", "trajectory")
    assert idata.observed_data["state"].dims == ("trajectory", "step")
    assert list(idata.posterior["feature"].values) == list(mdp.feature_names)
    weights = idata.posterior["weights"].values
    assert (np.abs(weights * feature_scale(mdp)) <= 1 + 1e-12).all()
    counts = visit_counts(mdp, demonstration)
    each = idata.log_likelihood["demonstration"].values
    for chain, draw in ((0, 0), (1, 4321)):
        expected = boltzmann_log_likelihoods(mdp, jnp.asarray(weights[chain, draw]), counts, ETA)
        np.testing.assert_allclose(each[chain, draw], expected, rtol=1e-10)
    np.testing.assert_allclose(idata.sample_stats["lp"].values, each.sum(-1), rtol=1e-10)
    moved = (np.diff(weights, axis=1) != 0).any(-1)
    np.testing.assert_array_equal(moved, idata.sample_stats["accepted"].values[:, 1:])
    # One task: some draw explains the demonstration at least as well as the truth.
    assert each.sum(-1).max() >= boltzmann_log_likelihoods(mdp, TRUE, counts, ETA).sum()
    again = birl(jax.random.key(1), mdp, demonstration, **OPTIONS)
    np.testing.assert_array_equal(weights, again.posterior["weights"].values)


def test_bad_input_is_named(mdp, demonstration):
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="draws must be positive, got 0"):
        birl(key, mdp, demonstration, draws=0)
    with pytest.raises(ValueError, match="one for each feature"):
        birl(key, mdp, demonstration, prior=dist.Normal(0, 1).expand([3]))
    with pytest.raises(ValueError, match=r"Uniform\(.*\) gives no probability to weights in \[-1, 1\]"):
        birl(key, mdp, demonstration, prior=dist.Uniform(2.0, 3.0), **OPTIONS)
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0 is hidden"):
        birl(key, mdp, Demonstration.from_steps([["hidden"]], mdp))
