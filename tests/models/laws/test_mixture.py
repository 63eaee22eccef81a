"""Declared model of a mixture of behaviours."""

import itertools
from functools import partial
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer import Predictive
from numpyro.infer.util import log_density

from i2rl.models import (
    Demonstration,
    Sensor,
    TrajectoryLaw,
    Visibility,
    require_possible,
)
from i2rl.models.laws.mixture import (
    MixtureLaw,
    as_evidence,
    component_log_likelihoods,
    mixture_model,
    perceive,
    soft_policies,
    stick_proportions,
    truncation_error,
)
from i2rl.models.laws.occlusion import PRIOR_SCALE, occlusion_model
from i2rl.models.observation.evidence import log_evidence
from i2rl.models.process.units import feature_scale

STICKS = jnp.array([0.5, 0.25])
WEIGHTS = jnp.array([[0.7, -1.3], [-2.0, 0.4], [0.1, 3.0]])
VALUES = {"sticks": STICKS, "weights": WEIGHTS}


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(3, n_states=3, n_actions=2, n_successors=3, masked=True)


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([True, True, False]))


@pytest.fixture(scope="module")
def policies(mdp):
    return jax.jit(soft_policies)(mdp, WEIGHTS)


@partial(jax.jit, static_argnames="n")
def simulated(key, mdp, sensor, n):
    return TrajectoryLaw(mdp, WEIGHTS[0], sensor, 4).sample(key, (n,))


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    """Simulate, wholly seen rows among them, with lost frames, a short trajectory and a repeated one."""
    codes = np.array(simulated(jax.random.key(1), mdp, sensor, 7))
    codes[0, 1] = [3, -1, -1]
    codes[1, 2:] = [0, -1, -1]
    codes[2] = codes[3]
    clear = (codes[..., 0] == 1).all(axis=1)
    assert clear.any()
    assert not clear.all()
    return Demonstration.from_codes(codes)


@partial(jax.jit, static_argnames="components")
def log_joint(values, mdp, sensor, codes, components=3, concentration=1.0):
    options = {"components": components, "concentration": concentration}
    return log_density(mixture_model, (mdp, sensor, codes), options, values)[0]


def density(mdp, sensor, codes, values=None, **options):
    return float(log_joint(VALUES if values is None else values, mdp, sensor, codes, **options))


def test_density_is_a_sum_over_every_assignment_and_every_completion(
    mdp, sensor, demonstration, policies, enumerate_completions
):
    evidence = np.asarray(log_evidence(sensor, mdp, demonstration))
    table = np.array(
        [
            [
                enumerate_completions(mdp, log_policy, e[:steps]).log_likelihood
                for e, steps in zip(evidence, demonstration.lengths, strict=True)
            ]
            for log_policy in np.asarray(policies)
        ]
    )
    proportions = [0.5, 0.5 * 0.25, 0.5 * 0.75]
    total = sum(
        np.prod([proportions[d] * np.exp(table[d, i]) for i, d in enumerate(ways)])
        for ways in itertools.product(range(3), repeat=7)
    )
    alpha = 1.7
    prior = np.sum(np.log(alpha) + (alpha - 1) * np.log(1 - np.asarray(STICKS)))
    prior += dist.Normal(0, PRIOR_SCALE / feature_scale(mdp)).log_prob(WEIGHTS).sum()
    expected = float(prior + np.log(total))
    assert density(mdp, sensor, demonstration.codes, concentration=alpha) == pytest.approx(
        expected, rel=1e-10
    )


def test_prepared_trajectories_give_the_same_density_and_gradient(mdp, sensor, demonstration):
    perceived, rows = perceive(mdp, sensor, demonstration.codes)
    assert rows[2] == rows[3]
    assert perceived.repeats.sum() == 7
    assert len(perceived.counts) > 0
    assert len(perceived.live) > 0

    def f(weights, codes):
        return log_joint({"sticks": STICKS, "weights": weights}, mdp, sensor, codes)

    codes, h = demonstration.codes, 1e-5
    value, gradient = jax.jit(jax.value_and_grad(f))(WEIGHTS, perceived)
    np.testing.assert_allclose(value, f(WEIGHTS, codes), rtol=1e-12)
    for d, k in np.ndindex(*WEIGHTS.shape):
        step = jnp.zeros_like(WEIGHTS).at[d, k].set(h)
        slope = float(f(WEIGHTS + step, codes) - f(WEIGHTS - step, codes)) / (2 * h)
        assert float(gradient[d, k]) == pytest.approx(slope, rel=1e-6, abs=1e-7)


def test_trajectories_all_seen_or_all_hidden_are_prepared_too(mdp, policies):
    likelihoods = jax.jit(component_log_likelihoods)
    for sensor, codes in (
        (Sensor(), np.array(simulated(jax.random.key(2), mdp, Sensor(), 3))),
        (Visibility(np.array([0.2, 0.9, 0.5])), np.tile(np.array([2, -1, -1], np.int32), (3, 4, 1))),
    ):
        perceived, rows = perceive(mdp, sensor, codes)
        assert len(perceived.counts) * len(perceived.live) == 0
        prepared = likelihoods(mdp, policies, perceived)[:, rows]
        direct = likelihoods(mdp, policies, as_evidence(mdp, sensor, codes))
        np.testing.assert_allclose(prepared, direct, rtol=1e-12)


def test_one_component_is_the_model_of_one_way(mdp, sensor, demonstration):
    values = {"weights": WEIGHTS[:1]}
    arguments = mdp, sensor, demonstration.codes
    alone = jax.jit(lambda w: log_density(occlusion_model, arguments, {}, {"weights": w})[0])(WEIGHTS[0])
    mixed = density(mdp, sensor, demonstration.codes, values, components=1)
    assert mixed == pytest.approx(float(alone), rel=1e-12)


def test_proportions_break_a_stick():
    np.testing.assert_allclose(stick_proportions(STICKS), [0.5, 0.125, 0.375])
    np.testing.assert_allclose(stick_proportions(jnp.array([1.0, 0.3])), [1.0, 0.0, 0.0])


def test_truncation_error_bounds_the_exact_expression():
    # 4 (1 - E (1 - R)^n), where R is a product of T - 1 independent Beta(alpha, 1): E R^j = (a/(a+j))^(T-1).
    for n, components, alpha in ((1, 3, 0.3), (6, 8, 1.0), (10, 12, 0.5), (4, 20, 3.0)):
        left = sum((-1) ** j * comb(n, j) * (alpha / (alpha + j)) ** (components - 1) for j in range(n + 1))
        bound = truncation_error(n, components, alpha)
        assert 4 * (1 - left) <= bound * (1 + 1e-9)
        assert bound < 3 * 4 * (1 - left)
    assert truncation_error(5, 1, 1.0) == 2.0


def test_two_trajectories_share_a_way_with_the_probability_of_the_process(mdp, sensor):
    alpha, draws = 0.6, 4000
    predictive = Predictive(mixture_model, num_samples=draws, condition_deterministic=True, parallel=False)
    options = {"components": 12, "concentration": alpha, "n_trajectories": 2, "length": 1}
    drawn = jax.jit(partial(predictive, **options))(jax.random.key(0), mdp, sensor)
    assert set(drawn) == {"sticks", "proportions", "weights", "assignment", "demonstration"}
    shared = np.asarray(drawn["assignment"][:, 0] == drawn["assignment"][:, 1])
    expected = 1 / (1 + alpha)
    assert abs(shared.mean() - expected) < 4 * np.sqrt(expected * (1 - expected) / draws)
    np.testing.assert_allclose(drawn["proportions"].sum(axis=1), 1.0)


def test_a_simulated_trajectory_is_done_in_its_own_way(mdp):
    strong = jnp.array([[30.0, 0.0], [-30.0, 0.0]])
    sticks, n = jnp.array([0.4]), 800
    predictive = Predictive(mixture_model, {"sticks": sticks[None], "weights": strong[None]})
    options = {"components": 2, "n_trajectories": n, "length": 3}
    drawn = jax.jit(partial(predictive, **options))(jax.random.key(0), mdp, Sensor())
    require_possible(Sensor(), mdp, Demonstration.from_codes(np.asarray(drawn["demonstration"][0])))
    way = np.asarray(drawn["assignment"]).ravel()
    assert abs(way.mean() - 0.6) < 4 * np.sqrt(0.24 / way.size)
    codes = np.asarray(drawn["demonstration"]).reshape(-1, 3, 3)
    for d, policy in enumerate(np.exp(jax.jit(soft_policies)(mdp, strong))):
        chance = policy[codes[way == d, :, 1], codes[way == d, :, 2]]
        assert chance.min() > 1e-6
        assert (chance.mean(axis=1) > 0.5).mean() > 0.9


def test_samples_of_the_law_follow_its_probabilities(mdp, sensor):
    proportions = jnp.array([0.2, 0.5, 0.3])

    @jax.jit
    def sample(key):
        return MixtureLaw(mdp, proportions, WEIGHTS, sensor, 2).sample(key, (4000,))

    @jax.jit
    def log_prob(codes):
        return MixtureLaw(mdp, proportions, WEIGHTS, sensor, 2).log_prob(codes)

    values, counts = np.unique(sample(jax.random.key(4)).reshape(4000, -1), axis=0, return_counts=True)
    chance = np.exp(log_prob(jnp.asarray(values.reshape(-1, 2, 3), jnp.int32)))
    assert chance.sum() == pytest.approx(1.0, abs=0.01)
    error = np.sqrt(chance * (1 - chance) / 4000)
    np.testing.assert_array_less(np.abs(counts / 4000 - chance), 5 * error + 1 / 4000)


def test_a_random_concentration_is_a_site(mdp, sensor, demonstration):
    values = {**VALUES, "concentration": jnp.array(1.7)}
    mixed = density(mdp, sensor, demonstration.codes, values, concentration=dist.Gamma(2.0, 3.0))
    fixed = density(mdp, sensor, demonstration.codes, concentration=1.7)
    assert mixed - fixed == pytest.approx(float(dist.Gamma(2.0, 3.0).log_prob(1.7)))


def test_what_makes_no_mixture_is_refused(mdp, sensor, demonstration):
    def call(**options):
        return Predictive(mixture_model, num_samples=1)(
            jax.random.key(0), mdp, sensor, **{"n_trajectories": 2, "length": 3, **options}
        )

    with pytest.raises(ValueError, match="at least one component, got 0"):
        call(components=0)
    with pytest.raises(ValueError, match="concentration must be a positive number, got -1"):
        call(concentration=-1.0)
    with pytest.raises(ValueError, match="got Normal over negative ones too"):
        call(concentration=dist.Normal(0.0, 1.0))
    with pytest.raises(ValueError, match=r"got Gamma over shape \(2,\)"):
        call(concentration=dist.Gamma(jnp.ones(2), 1.0))
    with pytest.raises(ValueError, match="needs n_trajectories and length"):
        call(length=None)
    with pytest.raises(ValueError, match="a proportion for each row"):
        MixtureLaw(mdp, jnp.ones(2) / 2, WEIGHTS, sensor, 3)
    with pytest.raises(ValueError, match=r"shape \[..., 3, 3\]"):
        jax.eval_shape(
            lambda codes: MixtureLaw(mdp, jnp.ones(3) / 3, WEIGHTS, sensor, 3).log_prob(codes),
            demonstration.codes,
        )
