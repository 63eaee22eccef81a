"""The joint posterior over weights and reliabilities: against quadrature, and at its borders."""

from dataclasses import replace

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from i2rl.inference.posteriors.noisy import (
    noisy_log_likelihood,
    noisy_mode,
    noisy_potential,
    noisy_problem,
    noisy_starts,
    sample_noisy_posterior,
)
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    FeatureNoise,
    TrajectoryLaw,
    Visibility,
    sample_demonstration,
)
from i2rl.models.observation.demonstration import SEEN, UNKNOWN
from i2rl.models.process.units import feature_scale

PREDICATES = np.array([[[1, 0], [1, 1], [0, 1]]], bool)
VIEW = np.array([1.0, 0.4, 0.8])


@pytest.fixture(scope="module")
def toy(random_mdp):
    return random_mdp(3, n_states=3, n_actions=2, n_successors=2, n_features=1)


@pytest.fixture(scope="module")
def demonstration(toy):
    sensor = FeatureNoise(PREDICATES, np.array([0.85])) * Visibility(VIEW)
    law = TrajectoryLaw(toy, jnp.array([3.0]), sensor, 4)
    return sample_demonstration(jax.random.key(1), law, 40)


def test_the_posterior_is_that_of_quadrature(toy, demonstration):
    priors = {"prior": dist.Normal(0.0, 2.0), "reliability_prior": dist.Beta(3.0, 1.5)}
    drawn = sample_noisy_posterior(
        jax.random.key(0),
        toy,
        PREDICATES,
        demonstration,
        visibility=Visibility(VIEW),
        names=("edge",),
        chains=2,
        draws=600,
        **priors,
    )
    assert drawn.posterior.predicate.values.tolist() == ["edge"]
    problem, rows = noisy_problem(toy, PREDICATES, demonstration, visibility=Visibility(VIEW))
    theta, p = (x.ravel() for x in np.meshgrid(np.linspace(-8, 12, 61), (np.arange(60) + 0.5) / 60))
    likelihood = noisy_log_likelihood(jnp.asarray(theta[:, None]), jnp.asarray(p[:, None]), problem)
    log_posterior = np.asarray(likelihood)[:, rows].sum(1)
    log_posterior += -((theta * feature_scale(toy)[0] / 2) ** 2) / 2 + 2 * np.log(p) + 0.5 * np.log(1 - p)
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    error = az.mcse(drawn, method="mean")
    for name, grid in (("weights", theta), ("reliabilities", p)):
        x = drawn.posterior[name]
        mean = weight @ grid
        assert abs(float(x.mean()) - mean) < 4 * float(error[name][0]) + 1e-3
        np.testing.assert_allclose(float(x.std()), np.sqrt(weight @ (grid - mean) ** 2), rtol=0.15)
    # What the InferenceData says of each trajectory is the law's own log-probability.
    at = {name: drawn.posterior[name][0, 5].values for name in ("weights", "reliabilities")}
    sensor = FeatureNoise(PREDICATES, at["reliabilities"]) * Visibility(VIEW)
    law = TrajectoryLaw(toy, jnp.asarray(at["weights"]), sensor, 4)
    np.testing.assert_allclose(
        drawn.log_likelihood.demonstration[0, 5], law.log_prob(jnp.asarray(demonstration.codes)), atol=1e-10
    )


def test_labels_take_the_place_of_predicates(toy, demonstration):
    potential = jax.jit(jax.value_and_grad(noisy_potential))
    position = jnp.array([1.2, 0.7])
    plain, named = (
        potential(position, noisy_problem(toy, psi, demonstration, visibility=Visibility(VIEW))[0])
        for psi in (PREDICATES, 7 - 4 * PREDICATES)
    )
    np.testing.assert_allclose(named[0], plain[0], rtol=1e-12)
    np.testing.assert_allclose(named[1], plain[1], rtol=1e-9)
    state = np.tile(np.arange(3)[:, None], 2)[None]
    drawn = sample_noisy_posterior(
        jax.random.key(0), toy, state, demonstration, visibility=Visibility(VIEW), chains=1, draws=5, warmup=5
    )
    assert np.isfinite(drawn.posterior.reliabilities).all()


def test_bad_input_is_refused_in_its_own_terms(toy, demonstration):
    def sample(demonstration=demonstration, predicates=PREDICATES, **options):
        sample_noisy_posterior(
            jax.random.key(0), toy, predicates, demonstration, visibility=Visibility(VIEW), **options
        )

    with pytest.raises(ValueError, match="chains must be at least 1"):
        sample(chains=0)
    with pytest.raises(ValueError, match="observation model is about"):
        sample(predicates=PREDICATES[:, :2])
    with pytest.raises(ValueError, match="there is one name for each of 1 predicates"):
        sample(names=("one", "two"))
    with pytest.raises(ValueError, match="admits others"):
        sample(reliability_prior=dist.Normal(0.0, 1.0))
    mute = np.ones((3, 2), bool)
    mute[1, 1] = False
    told = Demonstration.from_codes(np.array([[[SEEN, 0, 0], [SEEN, 1, 1]]], np.int32))
    with pytest.raises(DemonstrationError, match="trajectory 0, step 1: impossible observation"):
        sample(told, reportable=mute)


def test_chains_start_in_both_modes_where_both_hold_something(toy):
    # One predicate and its own negative as the only feature: wrong observations with reversed weights are as
    # likely.
    action = np.tile(np.arange(2), (3, 1))
    mdp = replace(toy, features=jnp.asarray(action[..., None] - 0.5))
    told = np.concatenate([np.zeros((90, 1), int), np.ones((10, 1), int)])
    reports = Demonstration.from_arrays(np.full((100, 1), UNKNOWN), told, missing=UNKNOWN)
    even, _ = noisy_problem(mdp, action[None], reports, reliability_prior=dist.Beta(1.0, 1.0))
    starts = noisy_starts(jax.random.key(0), even, 8)
    modes = np.array([noisy_mode(even, start.position).position for start in starts])
    assert {*np.sign(modes[:, 1])} == {-1.0, 1.0}
    np.testing.assert_allclose(np.abs(modes), np.broadcast_to(np.abs(modes[0]), modes.shape), rtol=1e-3)
    assert (np.sign(modes[:, 0]) == -np.sign(modes[:, 1])).all()
    # The same key gives the same starts; perception better than chance leaves one mode.
    for one, again in zip(starts, noisy_starts(jax.random.key(0), even, 8), strict=True):
        np.testing.assert_array_equal(one.position, again.position)
    better, _ = noisy_problem(mdp, action[None], reports)
    starts = noisy_starts(jax.random.key(0), better, 8)
    modes = np.array([noisy_mode(better, start.position).position for start in starts])
    assert (modes[:, 1] > 0).all()
