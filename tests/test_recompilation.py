from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from jax import monitoring

from i2rl.inference import Harmonic, batch_lme, batch_mme_mtirl, lme_i2rl, run_sessions, sample_posterior
from i2rl.models import (
    Visibility,
    feature_expectations,
    finite_soft_plan,
    hard_plan,
    occupancy,
    policy_values,
    reward_of,
    simulate,
    soft_plan,
)
from i2rl.models.process.planning import (
    feature_deviations,
    features_to_go,
    finite_hard_plan,
    finite_occupancy,
)

EVENTS = []
monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: EVENTS.append(event) if event.endswith("backend_compile_duration") else None
)


def compilations(function, *arguments):
    before = len(EVENTS)
    jax.block_until_ready(function(*arguments))
    return len(EVENTS) - before


PLANNING = {
    "soft plan": lambda mdp, reward, policy: soft_plan(mdp, reward),
    "warm soft plan": lambda mdp, reward, policy: soft_plan(mdp, reward, jnp.zeros(mdp.n_states)),
    "hard plan": lambda mdp, reward, policy: hard_plan(mdp, reward),
    "finite soft plan": lambda mdp, reward, policy: finite_soft_plan(mdp, reward, 5),
    "finite hard plan": lambda mdp, reward, policy: finite_hard_plan(mdp, reward, 5),
    "finite occupancy": lambda mdp, reward, policy: finite_occupancy(mdp, jnp.stack([policy, policy])),
    "policy values": lambda mdp, reward, policy: policy_values(mdp, policy, reward),
    "features to go": lambda mdp, reward, policy: features_to_go(mdp, policy),
    "occupancy": lambda mdp, reward, policy: occupancy(mdp, policy),
    "feature expectations": lambda mdp, reward, policy: feature_expectations(mdp, policy),
    "feature deviations": lambda mdp, reward, policy: feature_deviations(mdp, policy),
    "simulation": lambda mdp, reward, policy: simulate(jax.random.key(0), mdp, jnp.log(policy), 5),
}


@pytest.mark.parametrize("function", PLANNING.values(), ids=PLANNING)
def test_planning_compiles_nothing_at_a_second_call(function, random_mdp):
    mdp = random_mdp(0)
    policy = jnp.full(mdp.available.shape, 1 / mdp.n_actions)
    rewards = [reward_of(mdp, jnp.array(weights)) for weights in ([1.0, -1.0], [0.5, 2.0])]
    function(mdp, rewards[0], policy)
    assert compilations(function, mdp, rewards[1], policy) == 0


def perceived(random_mdp, imperfect_demonstration, seed, n):
    mdp = random_mdp(0)
    log_policy = soft_plan(mdp, reward_of(mdp, jnp.array([1.0, -1.0]))).log_policy
    sensor = Visibility(np.array([True, True, False, True]))
    return mdp, sensor, imperfect_demonstration(seed, mdp, log_policy, sensor, n, 5)


def test_a_posterior_with_other_options_compiles_nothing(random_mdp, imperfect_demonstration):
    mdp, sensor, first = perceived(random_mdp, imperfect_demonstration, 0, 20)
    *_, second = perceived(random_mdp, imperfect_demonstration, 1, 23)
    common = {"warmup": 5, "chains": 2}
    sample_posterior(jax.random.key(0), mdp, sensor, first, draws=5, **common)

    def again():
        options = {"draws": 7, "target_accept": 0.7, "prior": dist.Normal(0.0, 1.0)} | common
        return sample_posterior(jax.random.key(1), mdp, sensor, second, **options).posterior.weights.values

    assert compilations(again) == 0


def test_mixtures_with_other_options_compile_nothing(random_mdp, imperfect_demonstration):
    mdp, sensor, first = perceived(random_mdp, imperfect_demonstration, 0, 20)
    *_, second = perceived(random_mdp, imperfect_demonstration, 1, 20)
    batch_mme_mtirl(mdp, sensor, n_components=2).fit(jax.random.key(0), first)
    options = {
        "temperature": 1,
        "slack": 1,
        "ridge": 0,
        "restarts": 2,
        "iterations": 9,
        "tolerance": 1,
        "strength": 2,
    }
    other = batch_mme_mtirl(mdp, sensor, n_components=2, **options)
    assert compilations(lambda: other.fit(jax.random.key(1), second).weights) == 0


def test_learners_that_differ_in_numbers_share_a_program(random_mdp, imperfect_demonstration):
    mdp, other = random_mdp(0), replace(random_mdp(0), features=random_mdp(1).features)
    view = Visibility(np.array([True, True, False, True]))
    log_policy = soft_plan(mdp, reward_of(mdp, jnp.array([1.0, -1.0]))).log_policy
    demonstration = imperfect_demonstration(0, mdp, log_policy, view, 6, 5)
    key, half = jax.random.key(0), Visibility(np.array([1.0, 0.5, 0.5, 1.0]))

    def online(mdp, view, **options):
        learner = lme_i2rl(mdp, view, **options)
        return learner.update(learner.init(key), demonstration)[0].weights

    first = online(mdp, view)
    assert compilations(lambda: online(other, half, slack=0.1, ridge=2.0, iterations=3, tolerance=0.1)) == 0
    assert not np.allclose(first, online(mdp, view, slack=0.1))
    online(mdp, view, slack=Harmonic(0.1))
    assert compilations(lambda: online(mdp, view, slack=Harmonic(0.3))) == 0
    by_schedule = [online(mdp, view, slack=lambda n, c=c: c + 0 * n) for c in (0.01, 0.1)]
    np.testing.assert_allclose(by_schedule, [online(mdp, view, slack=c) for c in (0.01, 0.1)], rtol=1e-9)

    def batch(mdp, view, **options):
        return batch_lme(mdp, view, restarts=1, **options).fit(key, demonstration).weights

    batch(mdp, view)
    assert compilations(lambda: batch(other, half, slack=0.1, ridge=2.0, iterations=3)) == 0


def test_schedules_that_are_equal_as_tuples_are_told_apart(random_mdp, imperfect_demonstration):
    class Rising(NamedTuple):
        c: float

        def __call__(self, session):
            return self.c * session

    class Falling(Rising):
        def __call__(self, session):
            return self.c / session

    assert Rising(0.1) == Falling(0.1)
    mdp, key = random_mdp(0), jax.random.key(0)
    view = Visibility(np.array([True, True, False, True]))
    log_policy = soft_plan(mdp, reward_of(mdp, jnp.array([1.0, -1.0]))).log_policy
    demonstration = imperfect_demonstration(0, mdp, log_policy, view, 6, 5)

    def learned(slack):
        learner = lme_i2rl(mdp, view, slack=slack)
        return run_sessions(learner, demonstration.sessions(3), key=key).state.weights

    np.testing.assert_allclose(learned(Rising(0.1)), learned(lambda n: 0.1 * n), rtol=1e-9)
    np.testing.assert_allclose(learned(Falling(0.1)), learned(lambda n: 0.1 / n), rtol=1e-9)
    assert not np.allclose(learned(Rising(0.1)), learned(Falling(0.1)))


def test_a_sensor_of_another_library_is_part_of_the_program(random_mdp, imperfect_demonstration):
    class Theirs:
        visibility, noise = np.array([1.0, 1.0, 0.0, 1.0]), None

    mdp = random_mdp(0)
    log_policy = soft_plan(mdp, reward_of(mdp, jnp.array([1.0, -1.0]))).log_policy
    demonstration = imperfect_demonstration(0, mdp, log_policy, Visibility(Theirs.visibility), 6, 5)
    learners = [lme_i2rl(mdp, sensor) for sensor in (Theirs(), Visibility(Theirs.visibility))]
    theirs, ours = (x.update(x.init(jax.random.key(0)), demonstration)[0].weights for x in learners)
    np.testing.assert_allclose(theirs, ours, rtol=1e-12)
