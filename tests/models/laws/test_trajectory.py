"""The law of an imperfectly observed trajectory as a probability distribution."""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpyro.infer.util import log_density

from i2rl.inference.completion.smoothing import evidence_of, log_likelihoods
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    ObservationModel,
    Sensor,
    TrajectoryLaw,
    Visibility,
    reward_of,
    sample_demonstration,
    soft_plan,
)
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN

WEIGHTS = jnp.array([1.0, -0.5])


def noisy_view(n_states, n_actions, seed=0):
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.ones(n_states * n_actions), (n_states, n_actions))
    reading = ObservationModel.from_probabilities(table.reshape(n_states, n_actions, n_states, n_actions))
    return Visibility(rng.random(n_states)) * reading


def every_code(n_states, n_actions, length):
    steps = [(SEEN, s, a) for s, a in np.ndindex(n_states, n_actions)] + [(HIDDEN, UNKNOWN, UNKNOWN)]
    return np.array(list(product(steps, repeat=length)))


@jax.jit
def log_prob(mdp, weights, sensor, codes):
    return TrajectoryLaw(mdp, weights, sensor, codes.shape[-2]).log_prob(codes)


@given(seed=st.integers(0, 50), first=st.floats(-4, 4), second=st.floats(-4, 4))
def test_the_probabilities_of_everything_that_may_be_perceived_sum_to_one(seed, first, second, random_mdp):
    mdp = random_mdp(seed, n_states=3, n_actions=2)
    codes = every_code(3, 2, 3)
    total = jnp.exp(log_prob(mdp, jnp.array([first, second]), noisy_view(3, 2, seed), codes)).sum()
    np.testing.assert_allclose(total, 1, atol=1e-12)


def test_samples_have_the_frequency_their_probability_says(random_mdp):
    mdp, sensor, n = random_mdp(1, n_states=2, n_actions=2, masked=True), noisy_view(2, 2), 20_000
    law = TrajectoryLaw(mdp, WEIGHTS, sensor, 2)
    samples = np.asarray(law.sample(jax.random.key(0), (4, n // 4)))
    assert samples.shape == (4, n // 4, 2, 3)
    samples = samples.reshape(n, 2, 3)
    codes = every_code(2, 2, 2)
    expected = np.exp(log_prob(mdp, WEIGHTS, sensor, codes))
    observed = np.array([(samples == code).all((1, 2)).mean() for code in codes])
    np.testing.assert_allclose(observed.sum(), 1)
    assert (np.abs(observed - expected) <= 4 * np.sqrt(expected * (1 - expected) / n) + 1e-12).all()


def test_the_log_probability_is_that_of_the_completion(random_mdp, enumerate_completions):
    mdp, sensor = random_mdp(2, masked=True), noisy_view(4, 3)
    demo = sample_demonstration(jax.random.key(1), TrajectoryLaw(mdp, WEIGHTS, sensor, 4), 5)
    codes = demo.codes.copy()
    codes[1, 1] = (LOST, UNKNOWN, UNKNOWN)
    codes[2, 3:] = (PAD, UNKNOWN, UNKNOWN)
    codes[3, 2, 2] = UNKNOWN
    demo = Demonstration.from_codes(codes)
    evidence = evidence_of(mdp, sensor, demo)
    log_policy = soft_plan(mdp, reward_of(mdp, WEIGHTS)).log_policy
    values = log_prob(mdp, WEIGHTS, sensor, codes)
    np.testing.assert_allclose(values, log_likelihoods(mdp, log_policy, evidence), atol=1e-12)
    for i, length in enumerate(demo.lengths):
        truth = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence[i, :length]))
        np.testing.assert_allclose(values[i], truth.log_likelihood, atol=1e-10)


def test_the_gradient_in_the_weights_matches_finite_differences(random_mdp):
    mdp, sensor = random_mdp(3), noisy_view(4, 3)
    codes = TrajectoryLaw(mdp, WEIGHTS, sensor, 6).sample(jax.random.key(2), (8,))
    function = jax.jit(lambda w: log_prob(mdp, w, sensor, codes).sum())
    gradient, hessian = jax.jit(jax.grad(function))(WEIGHTS), jax.jit(jax.hessian(function))(WEIGHTS)
    for k, unit in enumerate(np.eye(2)):
        at = [function(WEIGHTS + j * 1e-3 * unit) for j in (-2, -1, 1, 2)]
        difference = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / 12e-3
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-6)
        slopes = [jax.grad(function)(WEIGHTS + j * 1e-3 * unit) for j in (-2, -1, 1, 2)]
        difference = (slopes[0] - 8 * slopes[1] + 8 * slopes[2] - slopes[3]) / 12e-3
        np.testing.assert_allclose(hessian[k], difference, rtol=1e-6)


def test_impossible_values_have_probability_zero(random_mdp):
    mdp = random_mdp(4, starts=1)
    elsewhere = int(np.argmin(mdp.initial))
    codes = np.array([[[SEEN, elsewhere, 0]]])
    assert log_prob(mdp, WEIGHTS, Sensor(), codes)[0] == -np.inf
    hidden = np.array([[[HIDDEN, UNKNOWN, UNKNOWN]]])
    assert log_prob(mdp, WEIGHTS, Visibility(np.ones(4)), hidden)[0] == -np.inf


def test_it_is_a_site_of_a_numpyro_model(random_mdp):
    mdp, sensor, length, n = random_mdp(5), noisy_view(4, 3), 4, 7
    codes = TrajectoryLaw(mdp, WEIGHTS, sensor, length).sample(jax.random.key(3), (n,))

    def model(codes=None):
        weights = numpyro.sample("weights", dist.Normal(0, 1).expand([2]).to_event(1))
        with numpyro.plate("trajectories", n):
            numpyro.sample("codes", TrajectoryLaw(mdp, weights, sensor, length), obs=codes)

    drawn = numpyro.handlers.trace(numpyro.handlers.seed(model, 0)).get_trace()
    assert drawn["codes"]["value"].shape == (n, length, 3)
    joint, _ = log_density(model, (codes,), {}, {"weights": WEIGHTS})
    prior = dist.Normal(0, 1).log_prob(WEIGHTS).sum()
    np.testing.assert_allclose(joint, prior + log_prob(mdp, WEIGHTS, sensor, codes).sum())


def test_it_needs_no_plate(random_mdp):
    mdp, sensor = random_mdp(5), noisy_view(4, 3)
    codes = TrajectoryLaw(mdp, WEIGHTS, sensor, 4).sample(jax.random.key(3), (7,))

    def model():
        numpyro.sample("codes", TrajectoryLaw(mdp, WEIGHTS, sensor, 4), obs=codes)

    joint, _ = log_density(model, (), {}, {})
    np.testing.assert_allclose(joint, log_prob(mdp, WEIGHTS, sensor, codes).sum())


def test_it_passes_through_jit_and_vmap_as_a_value(random_mdp):
    mdp, sensor = random_mdp(6), noisy_view(4, 3)
    law = TrajectoryLaw(mdp, WEIGHTS, sensor, 3)
    codes = law.sample(jax.random.key(4), (2,))
    leaves, structure = jax.tree.flatten(law)
    again = jax.tree.unflatten(structure, leaves)
    assert (again.length, again.event_shape, again.batch_shape) == (3, (3, 3), ())
    np.testing.assert_array_equal(again.log_prob(codes), law.log_prob(codes))
    np.testing.assert_allclose(jax.jit(lambda d, c: d.log_prob(c))(law, codes), law.log_prob(codes))
    np.testing.assert_array_equal(jax.jit(lambda d, k: d.sample(k, (2,)))(law, jax.random.key(4)), codes)
    many = jnp.stack([WEIGHTS, -WEIGHTS, 2 * WEIGHTS])
    values = jax.vmap(lambda w: TrajectoryLaw(mdp, w, sensor, 3).log_prob(codes))(many)
    for weights, value in zip(many, values, strict=True):
        np.testing.assert_allclose(value, log_prob(mdp, weights, sensor, codes), atol=1e-12)
    laws = jax.vmap(lambda w: TrajectoryLaw(mdp, w, sensor, 3))(many)
    np.testing.assert_allclose(jax.vmap(lambda d: d.log_prob(codes))(laws), values, atol=1e-12)
    assert law.expand((5,)).sample(jax.random.key(0)).shape == (5, 3, 3)


def test_the_same_key_draws_the_same_demonstration(random_mdp):
    law = TrajectoryLaw(random_mdp(7), WEIGHTS, noisy_view(4, 3), 4)
    one, two = (sample_demonstration(jax.random.key(5), law, 3) for _ in range(2))
    np.testing.assert_array_equal(one.codes, two.codes)
    assert (one.lengths == 4).all()


def test_the_support_is_known_codes(random_mdp):
    support = TrajectoryLaw(random_mdp(8), WEIGHTS, Sensor(), 2).support
    last = (PAD, UNKNOWN, UNKNOWN)
    inside = [
        [(SEEN, 3, 2), (HIDDEN, -1, -1)],
        [(SEEN, -1, 0), (SEEN, 0, -1)],
        [(LOST, -1, -1), last],
        [last, last],
    ]
    outside = [
        [(SEEN, 4, 0), last],
        [(SEEN, 0, 3), last],
        [(SEEN, -1, -1), last],
        [(SEEN, -2, 0), last],
        [(4, 0, 0), last],
        [(-1, 0, 0), last],
        [last, (SEEN, 0, 0)],
    ]
    np.testing.assert_array_equal(support(jnp.array(inside)), True)
    np.testing.assert_array_equal(support(jnp.array(outside)), False)
    assert support(support.feasible_like(jnp.zeros((2, 3), int)))


def test_values_and_arguments_are_validated(random_mdp):
    mdp = random_mdp(9)
    with pytest.raises(ValueError, match="weights"):
        TrajectoryLaw(mdp, jnp.array([1.0, jnp.nan]), Sensor(), 2, validate_args=True)
    law = TrajectoryLaw(mdp, WEIGHTS, Sensor(), 1, validate_args=True)
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0: state 9 is out of range"):
        law.log_prob(jnp.array([[SEEN, 9, 0]]))
    with pytest.raises(ValueError, match=r"a value has shape \[\.\.\., 1, 3\], got \(2, 3\)"):
        law.log_prob(jnp.zeros((2, 3), int))
    with pytest.raises(ValueError, match=r"view has shape \(5,\), but the MDP has 4 states"):
        TrajectoryLaw(mdp, WEIGHTS, Visibility(np.ones(5)), 2)
    with pytest.raises(ValueError, match="discount 1 has no infinite-horizon solution"):
        TrajectoryLaw(random_mdp(9, discount=1.0), WEIGHTS, Sensor(), 2)
