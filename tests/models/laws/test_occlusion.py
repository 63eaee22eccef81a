"""The declared occlusion model."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer import Predictive
from numpyro.infer.util import log_density

from i2rl.models import Demonstration, TabularMDP, Visibility, require_possible, reward_of, soft_plan
from i2rl.models.laws.occlusion import PRIOR_SCALE, occlusion_model, weights_prior
from i2rl.models.process.units import feature_scale

STATES, ACTIONS, FEATURES = 3, 2, 2


@pytest.fixture(scope="module")
def mdp():
    rng = np.random.default_rng(0)
    transitions = rng.dirichlet(np.ones(STATES), (STATES, ACTIONS))
    return TabularMDP.from_dense(transitions, rng.uniform(size=(STATES, ACTIONS, FEATURES)), discount=0.9)


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([True, True, False]))


@pytest.fixture(scope="module")
def demonstration(mdp):
    return Demonstration.from_steps(
        [[(0, 1), "hidden", (1, 0)], ["hidden", None], ["hidden", None], [(1, 1), (0, 0), None]], mdp
    )


def density(mdp, sensor, codes, weights, **options):
    return log_density(occlusion_model, (mdp, sensor, codes), options, {"weights": weights})[0]


def brute_force(mdp, demonstration, weights):
    """Sum over every trajectory of pairs that what was perceived allows; state 2 is out of view."""
    policy = np.asarray(soft_plan(mdp, reward_of(mdp, weights)).policy)
    moves = np.zeros((STATES, ACTIONS, STATES))
    np.add.at(
        moves,
        (np.arange(STATES)[:, None, None], np.arange(ACTIONS)[:, None], np.asarray(mdp.successors)),
        np.asarray(mdp.probabilities),
    )
    total = 0.0
    for kinds, states, actions in zip(
        demonstration.kind, demonstration.state, demonstration.action, strict=True
    ):
        length = int((kinds != 0).sum())
        likelihood = 0.0
        for path in itertools.product(itertools.product(range(STATES), range(ACTIONS)), repeat=length):
            p = np.asarray(mdp.initial)[path[0][0]]
            for t, (s, a) in enumerate(path):
                agrees = {1: (s, a) == (states[t], actions[t]) and s != 2, 2: s == 2, 3: True}[int(kinds[t])]
                p *= policy[s, a] * agrees
                if t:
                    p *= moves[(*path[t - 1], s)]
            likelihood += p
        total += np.log(likelihood)
    return total


def test_density_is_the_prior_times_the_sum_over_every_completion(mdp, sensor, demonstration):
    weights = jnp.array([0.7, -1.3])
    prior = dist.Normal(0, PRIOR_SCALE / feature_scale(mdp)).log_prob(weights).sum()
    expected = prior + brute_force(mdp, demonstration, weights)
    assert density(mdp, sensor, demonstration.codes, weights) == pytest.approx(float(expected), rel=1e-10)


def test_density_is_differentiable_in_the_weights(mdp, sensor, demonstration):
    def f(weights):
        return density(mdp, sensor, demonstration.codes, weights)

    weights, h = jnp.array([0.7, -1.3]), 1e-5
    differences = [(f(weights + e) - f(weights - e)) / (2 * h) for e in h * np.eye(FEATURES)]
    np.testing.assert_allclose(jax.grad(f)(weights), differences, rtol=1e-6)


def test_gathering_identical_trajectories_changes_no_density(mdp, sensor, demonstration):
    weights = jnp.array([0.7, -1.3])
    gathered = demonstration.select([0, 1, 3]).codes
    assert density(mdp, sensor, gathered, weights, repeats=jnp.array([1, 2, 1])) == pytest.approx(
        float(density(mdp, sensor, demonstration.codes, weights)), rel=1e-12
    )


def test_prior_predictive_simulates_what_the_sensor_could_perceive(mdp, sensor):
    drawn = Predictive(occlusion_model, num_samples=40)(
        jax.random.key(0), mdp, sensor, n_trajectories=5, length=4
    )
    assert drawn["weights"].shape == (40, FEATURES)
    assert drawn["demonstration"].shape == (40, 5, 4, 3)
    demonstration = Demonstration.from_codes(np.asarray(drawn["demonstration"]).reshape(-1, 4, 3))
    require_possible(sensor, mdp, demonstration)
    assert 0 < (demonstration.kind == 2).mean() < 1


def test_predictive_from_given_weights_follows_their_policy(mdp, sensor):
    strong = jnp.tile(jnp.array([[8.0, -3.0]]), (200, 1))
    codes = Predictive(occlusion_model, {"weights": strong})(
        jax.random.key(1), mdp, sensor, n_trajectories=5, length=4
    )["demonstration"]
    kind, state, action = np.moveaxis(np.asarray(codes), -1, 0)
    policy = np.asarray(soft_plan(mdp, reward_of(mdp, strong[0])).policy)
    chosen = action[(kind == 1) & (state == 0)]
    error = np.sqrt(policy[0, 1] * policy[0, 0] / len(chosen))
    assert abs(chosen.mean() - policy[0, 1]) < 4.5 * error


def test_a_prior_over_one_weight_stands_for_each_feature():
    prior = weights_prior(3, dist.Laplace(0.0, 2.0))
    assert prior.event_shape == (3,)
    value = jnp.array([0.0, 1.0, -2.0])
    assert prior.log_prob(value) == pytest.approx(-3 * np.log(4.0) - 1.5)


def test_a_prior_over_all_weights_is_taken_as_it_is():
    joint = dist.MultivariateNormal(jnp.zeros(2), jnp.array([[2.0, 0.5], [0.5, 1.0]]))
    assert weights_prior(2, joint).log_prob(jnp.ones(2)) == joint.log_prob(jnp.ones(2))
    separate = dist.Normal(jnp.zeros(2), jnp.array([1.0, 3.0]))
    assert weights_prior(2, separate).event_shape == (2,)


def test_a_prior_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match=r"over \[3\] numbers.*batch shape \(2,\)"):
        weights_prior(3, dist.Normal(jnp.zeros(2), 1.0))


def test_simulation_needs_to_know_how_much(mdp, sensor):
    with pytest.raises(ValueError, match="needs n_trajectories and length"):
        Predictive(occlusion_model, num_samples=1)(jax.random.key(0), mdp, sensor, length=3)
