import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.inference.adversarial.discriminator import (
    Transitions,
    airl_discriminator,
    cross_entropy,
    gail_discriminator,
    gradient_penalty,
    log_probability_of_mean,
    mean_log_probability,
)
from i2rl.models.networks.modules import ActionSpace, CategoricalPolicy

TWO = ActionSpace(2)


def steps(key, n: int, d: int = 3, samples: tuple[int, ...] = ()) -> Transitions:
    keys = jax.random.split(key, 3)
    shape = (n, *samples)
    return Transitions(
        jax.random.normal(keys[0], (*shape, d), jnp.float32),
        jax.random.randint(keys[1], shape, 0, 2),
        jax.random.normal(keys[2], (*shape, d), jnp.float32),
        jnp.zeros(shape, bool),
    )


@given(
    st.lists(st.floats(-20, 20), min_size=4, max_size=4), st.lists(st.floats(0.01, 1), min_size=4, max_size=4)
)
def test_the_log_probability_of_the_mean_logit_is_never_below_the_mean_log_probability(logits, weights):
    w = np.array(weights) / np.sum(weights)
    x = jnp.array([logits])
    assert log_probability_of_mean(x, w)[0] >= mean_log_probability(x, w)[0] - 1e-9


def test_averages_agree_where_there_is_one_sample():
    x = jnp.array([[0.3], [-2.0]])
    np.testing.assert_allclose(
        log_probability_of_mean(x, jnp.ones(1)), mean_log_probability(x, jnp.ones(1)), rtol=1e-12
    )


def test_the_odds_of_airl_are_those_of_exp_f_against_the_policy():
    d = airl_discriminator(3, TWO, 0.9)
    network, policy = d.init(jax.random.key(0)), CategoricalPolicy.create(jax.random.key(1), 3, TWO)
    batch = steps(jax.random.key(2), 5)
    f = network.shaped(*batch)
    p = jnp.exp(policy.log_prob(batch.observations, batch.actions))
    by_definition = jnp.exp(f) / (jnp.exp(f) + p)
    np.testing.assert_allclose(jax.nn.sigmoid(d.logits(network, policy, batch)), by_definition, rtol=1e-5)


@pytest.mark.parametrize("kind", [airl_discriminator, gail_discriminator])
def test_what_the_generator_earns_is_log_d_minus_log_one_minus_d(kind):
    d = kind(3, TWO, 0.9)
    network, policy = d.init(jax.random.key(0)), CategoricalPolicy.create(jax.random.key(1), 3, TWO)
    batch = steps(jax.random.key(2), 5)
    odds = jax.nn.sigmoid(d.logits(network, policy, batch))
    np.testing.assert_allclose(
        d.rewards(network, policy, batch), jnp.log(odds) - jnp.log1p(-odds), rtol=1e-4, atol=1e-5
    )


def test_the_potential_telescopes_to_its_first_value_when_an_episode_terminates():
    discount = 0.9
    network = airl_discriminator(3, TWO, discount).init(jax.random.key(0))
    states = jax.random.normal(jax.random.key(1), (6, 3), jnp.float32)
    actions = jnp.array([0, 1, 1, 0, 1])
    ends = jnp.arange(5) == 4
    f = network.shaped(states[:-1], actions, states[1:], ends)
    g = network(states[:-1], actions)
    gamma = discount ** np.arange(5)
    first = network.potential(network.norm(states[0]))[0]
    assert float(gamma @ f) == pytest.approx(float(gamma @ g - first), abs=1e-5)


@pytest.mark.parametrize("kind", [airl_discriminator, gail_discriminator])
def test_termination_earns_the_absorbing_reward_for_ever(kind):
    d = kind(3, TWO, 0.9)
    network, policy = d.init(jax.random.key(0)), CategoricalPolicy.create(jax.random.key(1), 3, TWO)
    value = -0.7
    network = eqx.tree_at(lambda net: net.absorbing, network, jnp.float32(value))
    batch = steps(jax.random.key(2), 4)
    ended = batch._replace(terminated=jnp.ones(4, bool))
    gain = d.rewards(network, policy, ended) - d.rewards(network, policy, batch)
    expected = jnp.full(4, value * 0.9 / 0.1)
    if d.name == "AIRL":
        expected -= 0.9 * network.potential(network.norm(batch.successors))[..., 0]
    np.testing.assert_allclose(gain, expected, rtol=1e-4, atol=1e-5)


def test_the_best_classifier_of_gail_has_the_log_ratio_of_frequencies_as_its_odds():
    # Two states by two actions, all pairs present: the optimum of the cross-entropy is known.
    d = gail_discriminator(2, TWO, hidden=(16, 16))
    network, policy = d.init(jax.random.key(0)), CategoricalPolicy.create(jax.random.key(1), 2, TWO)
    pairs = [(s, a) for s in (0, 1) for a in (0, 1)]
    expert_counts, generated_counts = [8, 1, 3, 4], [2, 6, 4, 4]

    def batch(counts) -> Transitions:
        rows = np.repeat(np.arange(4), counts)
        states = np.eye(2, dtype=np.float32)[[pairs[i][0] for i in rows]]
        return Transitions(
            jnp.asarray(states),
            jnp.array([pairs[i][1] for i in rows]),
            jnp.asarray(states),
            jnp.zeros(len(rows), bool),
        )

    ours, theirs = batch(expert_counts), batch(generated_counts)
    expert = Transitions(*(x[:, None] for x in ours))
    optimiser = optax.adam(1e-2)

    @jax.jit
    def fitted(reward):
        def objective(reward):
            net = eqx.tree_at(lambda net: net.reward, network, reward)
            return cross_entropy(d, net, policy, expert, jnp.ones(1, jnp.float32), theirs)[0]

        def step(carry, _):
            reward, memory = carry
            change, memory = optimiser.update(jax.grad(objective)(reward), memory)
            return (optax.apply_updates(reward, change), memory), None

        return jax.lax.scan(step, (reward, optimiser.init(reward)), length=2000)[0][0]

    network = eqx.tree_at(lambda net: net.reward, network, fitted(network.reward))
    each = batch([1, 1, 1, 1])
    ratio = np.log(np.array(expert_counts) / 16) - np.log(np.array(generated_counts) / 16)
    np.testing.assert_allclose(d.logits(network, policy, each), ratio, atol=0.02)


def test_the_gradient_penalty_is_the_squared_distance_of_the_norm_from_one():
    # A score linear in its inputs has one gradient everywhere.
    slope_z, slope_a = jnp.array([2.0, -1.0, 0.5], jnp.float32), jnp.array([0.3, -0.4], jnp.float32)
    d = airl_discriminator(3, TWO)._replace(score=lambda net, z, a, *after: z @ slope_z + a @ slope_a)
    network = d.init(jax.random.key(0))
    penalty = gradient_penalty(
        d, network, steps(jax.random.key(1), 7), steps(jax.random.key(2), 7), jax.random.key(3)
    )
    norm = np.sqrt(4 + 1 + 0.25 + 0.09 + 0.16)
    assert float(penalty) == pytest.approx((norm - 1) ** 2, rel=1e-5)


def test_absorbing_steps_teach_that_only_the_generator_falls():
    d = airl_discriminator(3, TWO)
    network, policy = d.init(jax.random.key(0)), CategoricalPolicy.create(jax.random.key(1), 3, TWO)
    expert = steps(jax.random.key(2), 8, samples=(1,))
    falls = steps(jax.random.key(3), 8)._replace(terminated=jnp.arange(8) < 2)

    def loss(absorbing):
        net = eqx.tree_at(lambda net: net.absorbing, network, absorbing)
        return cross_entropy(d, net, policy, expert, jnp.ones(1, jnp.float32), falls)[0]

    # Two of eight generated episodes fell and no expert's did: at zero the slope is half of 2/8 times 1/2.
    assert float(jax.grad(loss)(jnp.float32(0.0))) == pytest.approx(0.5 * 0.25 * 0.5, rel=1e-5)
