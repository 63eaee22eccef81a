"""PPO: its estimates against direct sums, its steps against plain gradients, its states to the bit."""

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from i2rl.domains.robots.control import cart_pole, cart_pole_dynamics
from i2rl.inference.adversarial.policy_optimisation import Sample, advantages, loss, ppo
from i2rl.inference.adversarial.rollouts import finished_returns, play
from i2rl.inference.sessions.serialization import decode, encode, restore
from i2rl.models.networks.modules import ActionSpace


class HostCartPole(NamedTuple):
    """The cart-pole stepped from the host, with the same first states for the same key."""

    name: str = "cart-pole on the host"
    observation_size: int = 4
    actions: ActionSpace = ActionSpace(2)
    horizon: int = 500

    def reset(self, key, n):
        return np.asarray(jax.vmap(cart_pole().reset)(jax.random.split(key, n)))

    def step(self, states, actions):
        _, speed, angle, turning = states.T
        force = np.where(actions == 1, 10.0, -10.0)
        push = (force + 0.05 * turning**2 * np.sin(angle)) / 1.1
        spin = (9.8 * np.sin(angle) - np.cos(angle) * push) / (0.5 * (4 / 3 - 0.1 * np.cos(angle) ** 2 / 1.1))
        pace = push - 0.05 * spin * np.cos(angle) / 1.1
        states = states + 0.02 * np.stack([speed, pace, turning, spin], 1)
        fallen = (np.abs(states[:, 0]) > 2.4) | (np.abs(states[:, 2]) > np.radians(12))
        return states, np.ones(len(states)), fallen

    def observe(self, states):
        return states


class Slope(NamedTuple):
    """A ball to be held at zero by a force; off the table beyond 2."""

    name: str = "slope"
    observation_size: int = 2
    actions: ActionSpace = ActionSpace(0, (-1.0,), (1.0,))
    horizon: int = 20

    def reset(self, key, n):
        return np.random.default_rng(np.asarray(jax.random.key_data(key))).uniform(-1, 1, (n, 2))

    def step(self, states, actions):
        x, speed = states.T
        force = np.clip(actions[:, 0].astype(float), -1, 1)
        x, speed = x + 0.2 * speed, speed + 0.2 * (force + 0.3 * x)
        return np.stack([x, speed], 1), 1 - x**2, np.abs(x) > 2

    def observe(self, states):
        return states


SMALL = {"n_envs": 4, "n_steps": 64, "minibatch": 64, "epochs": 2}
SCALED = {**SMALL, "scale_rewards": True, "reward_memory": 100.0, "gamma": 0.9}
SHORT = cart_pole(horizon=12)
TASKS = [SHORT, HostCartPole(horizon=12), Slope()]


def after_some_rounds(environment, rounds=3, key=0, **settings):
    agent = ppo(environment, **SCALED, **settings)
    state = agent.init(jax.random.key(key))
    for _ in range(rounds):
        state, rollout = agent.collect(state)
        state = agent.improve(state, rollout, rollout.rewards)
    return agent, state


gradient = jax.jit(jax.grad(loss), static_argnums=3)


# -- estimates ----------------------------------------------------------------------------------------


def test_advantages_are_the_sum_of_discounted_surprises():
    rng = np.random.default_rng(0)
    steps, n, gamma, lam = 12, 3, 0.9, 0.8
    rewards, values, following = rng.normal(size=(3, steps, n)).astype(np.float32)
    terminated = rng.random((steps, n)) < 0.15
    truncated = ~terminated & (rng.random((steps, n)) < 0.15)
    assert terminated.any()
    assert truncated.any()
    expected = np.zeros((steps, n))
    for t, i in np.ndindex(steps, n):
        for k in range(t, steps):
            successor = 0.0 if terminated[k, i] else following[k, i]
            expected[t, i] += (gamma * lam) ** (k - t) * (rewards[k, i] + gamma * successor - values[k, i])
            if terminated[k, i] or truncated[k, i]:
                break
    ours = advantages(rewards, values, following, terminated, truncated, gamma, lam)
    assert ours.dtype == jnp.float32
    np.testing.assert_allclose(ours, expected, atol=1e-5)


def test_time_running_out_counts_the_value_of_what_would_follow_and_an_end_does_not():
    rewards, values, following = np.ones((1, 2)), np.full((1, 2), 3.0), np.full((1, 2), 5.0)
    ended, cut = np.array([[True, False]]), np.array([[False, True]])
    np.testing.assert_allclose(
        advantages(rewards, values, following, ended, cut, 0.9, 0.95), [[1 - 3, 1 + 0.9 * 5 - 3]], rtol=1e-6
    )


@pytest.mark.parametrize("environment", TASKS, ids=lambda e: e.name)
def test_first_gradient_is_the_plain_policy_gradient(environment):
    """Check the likelihood's gradient: all ratios are one under the norm of collection."""
    agent, state = after_some_rounds(environment)
    _, rollout = agent.collect(state)
    flat = rollout.flat()
    log_probs = state.policy.log_prob(flat.observations, flat.actions)
    np.testing.assert_allclose(np.exp(log_probs - flat.log_probs), 1, atol=1e-5)
    np.testing.assert_allclose(
        flat.values, state.critic(state.policy.norm(flat.observations))[..., 0], atol=1e-5
    )
    weight = np.random.default_rng(1).normal(size=len(flat.values)).astype(np.float32)
    sample = Sample(flat.observations, flat.actions, flat.log_probs, weight, flat.values + 1)
    scaled = (weight - weight.mean()) / weight.std()

    def plain(policy):
        return -jnp.mean(scaled * policy.log_prob(flat.observations, flat.actions))

    ours = gradient(state.policy, state.critic, sample, agent.settings)
    for one, other in zip(
        jax.tree.leaves(ours), jax.tree.leaves(jax.jit(jax.grad(plain))(state.policy)), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=2e-5)
    np.testing.assert_allclose(
        loss(state.policy, state.critic, sample, agent.settings), 0.5, atol=1e-4
    )  # value_coefficient times the square of one; the policy's part is zero on average


def test_ratios_beyond_the_clip_have_no_gradient_where_they_would_gain():
    agent, state = after_some_rounds(SHORT, 1)
    _, rollout = agent.collect(state)
    flat = rollout.flat()
    weight = np.where(np.arange(len(flat.values)) % 2 == 0, 1.0, -1.0).astype(np.float32)
    beyond = flat.log_probs - np.log(1.5) * weight  # ratio 1.5 where good, 1 / 1.5 where bad

    def steepest(old):
        sample = Sample(flat.observations, flat.actions, old, weight, flat.values)
        return np.abs(gradient(state.policy, state.critic, sample, agent.settings).logits.weights[0]).max()

    assert steepest(beyond) < 1e-9
    assert steepest(flat.log_probs + np.log(1.5) * weight) > 1e-4


def test_one_minibatch_is_one_step_of_clipped_adam():
    """Against Optax on the tree of weights, and estimates as above."""
    settings = {**SMALL, "epochs": 1, "minibatch": 256, "learning_rate": 1e-2, "entropy": 0.01}
    agent = ppo(SHORT, **settings)
    state = agent.init(jax.random.key(3))
    _, rollout = agent.collect(state)
    assert rollout.terminated.any()
    assert rollout.truncated.any()
    rewards = jax.random.normal(jax.random.key(4), rollout.rewards.shape, jnp.float32)
    following = state.critic(rollout.next_observations)[..., 0]
    ahead = advantages(rewards, rollout.values, following, rollout.terminated, rollout.truncated, 0.99, 0.95)
    sample = Sample(rollout.observations, rollout.actions, rollout.log_probs, ahead, ahead + rollout.values)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), sample)
    weights = (state.policy.logits, state.critic)

    def objective(weights):
        policy = type(state.policy)(weights[0], state.policy.norm, state.policy.actions)
        return loss(policy, weights[1], flat, agent.settings)

    @jax.jit
    def descended(weights):
        descent = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-2, eps=1e-5))
        change, _ = descent.update(jax.grad(objective)(weights), descent.init(weights))
        return optax.apply_updates(weights, change)

    expected = descended(weights)
    improved = agent.improve(state, rollout, rewards)
    ours = (improved.policy.logits, improved.critic)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)
    np.testing.assert_allclose(
        improved.policy.norm.mean, np.mean(rollout.observations, (0, 1)), rtol=1e-4, atol=1e-6
    )


def test_scaled_rewards_have_no_unit():
    agent = ppo(SHORT, **SCALED)
    state = agent.init(jax.random.key(0))
    improved = {}
    for unit in (1.0, 1000.0):
        s = state
        for _ in range(2):
            s, rollout = agent.collect(s)
            s = agent.improve(s, rollout, unit * rollout.rewards)
        improved[unit] = s
        returns = np.asarray(s.scale.norm.deviation)
        assert 0.5 * unit < returns < 10 * unit
    for one, other in zip(*(jax.tree.leaves(s.policy) for s in improved.values()), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_the_scale_of_rewards_is_the_spread_of_discounted_returns():
    agent = ppo(SHORT, **SCALED)
    state, rollout = agent.collect(agent.init(jax.random.key(5)))
    rewards = np.random.default_rng(0).normal(size=rollout.rewards.shape)
    done = np.asarray(rollout.terminated | rollout.truncated)
    sums, returns = np.zeros(done.shape[1]), []
    for reward, ended in zip(rewards, done, strict=True):
        sums = 0.9 * sums + reward
        returns.append(sums)
        sums = np.where(ended, 0, sums)
    scale = agent.improve(state, rollout, rewards).scale
    np.testing.assert_allclose(scale.norm.deviation, np.std(returns), rtol=1e-4)
    np.testing.assert_allclose(scale.returns, sums, rtol=1e-4, atol=1e-5)
    assert scale.norm.count == 100  # of 256


def test_a_decaying_rate_ends_at_zero():
    agent, before = after_some_rounds(SHORT, rounds=3, decay_over=3 * 256)
    after, rollout = agent.collect(before)
    after = agent.improve(after, rollout, rollout.rewards)
    for one, other in zip(
        jax.tree.leaves((before.policy.logits, before.critic)),
        jax.tree.leaves((after.policy.logits, after.critic)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    _, at_first = after_some_rounds(SHORT, rounds=2, decay_over=3 * 256)
    assert np.any(at_first.critic.weights[0] != before.critic.weights[0])


# -- rollouts -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("environment", TASKS[:2], ids=["jax", "host"])
def test_successors_are_true_and_starts_are_new(environment):
    agent, state = after_some_rounds(environment, 1)
    _, rollout = agent.collect(state)
    follow = cart_pole_dynamics(np.asarray(rollout.observations, np.float64), rollout.actions)
    np.testing.assert_allclose(rollout.next_observations, follow, atol=1e-6)
    done = np.asarray(rollout.terminated | rollout.truncated)[:-1]
    after = np.asarray(rollout.observations)[1:]
    np.testing.assert_array_equal(after[~done], np.asarray(rollout.next_observations)[:-1][~done])
    assert np.abs(after[done]).max() <= 0.05
    assert len(np.unique(after[done], axis=0)) == done.sum()
    fallen = np.abs(np.asarray(rollout.next_observations)[..., 2]) > np.radians(12)
    np.testing.assert_array_equal(rollout.terminated, fallen)
    assert rollout.terminated.any()
    assert rollout.truncated.any()
    for i in range(4):
        at = np.flatnonzero(done[:, i])
        assert np.all(np.diff(at) <= 12)
        np.testing.assert_array_equal(
            np.asarray(rollout.truncated)[at[1:], i],
            (np.diff(at) == 12) & ~np.asarray(rollout.terminated)[at[1:], i],
        )


def test_host_and_compiled_act_alike():
    """The same key draws the same first states and noise: equal until an episode ends."""
    rollouts = []
    _, state = after_some_rounds(SHORT)
    for environment in TASKS[:2]:
        agent = ppo(environment, **SCALED)
        fresh = agent.init(jax.random.key(8))
        rollouts.append(agent.collect(fresh._replace(policy=state.policy, critic=state.critic))[1])
    done = np.asarray(rollouts[0].terminated | rollouts[0].truncated)
    first = np.cumsum(done, 0) - done == 0
    assert first.sum() > 30
    for name in ("observations", "actions", "rewards", "terminated", "log_probs", "values"):
        ours, theirs = (np.asarray(getattr(r, name))[first] for r in rollouts)
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("environment", TASKS, ids=lambda e: e.name)
def test_noise_has_the_policys_law(environment):
    """Frequencies of actions, or their standard scores, as ``log_prob`` says."""
    agent, state = after_some_rounds(environment, 1)
    _, rollout = agent.collect(state)
    flat = rollout.flat()
    if environment.actions.discrete:
        likely = np.exp(state.policy.log_probs(flat.observations))[:, 1]
        excess = np.sum(np.asarray(flat.actions) - likely)
        assert abs(excess) < 4 * np.sqrt(np.sum(likely * (1 - likely)))
    else:
        z = (flat.actions - state.policy.mode(flat.observations)) / np.exp(state.policy.log_deviation)
        assert abs(float(z.mean())) < 4 / 16
        assert abs(float(z.std()) - 1) < 4 / np.sqrt(2 * 256)


@pytest.mark.parametrize("environment", TASKS, ids=lambda e: e.name)
def test_returns_of_finished_episodes_and_of_those_under_way(environment):
    agent, before = after_some_rounds(environment)
    after, rollout = agent.collect(before)
    finished = finished_returns(before.running, rollout)
    done = np.asarray(rollout.terminated | rollout.truncated)
    assert len(finished) == done.sum() > 0
    total = np.sum(before.running.returns) + np.sum(rollout.rewards)
    np.testing.assert_allclose(finished.sum() + np.sum(after.running.returns), total, rtol=1e-5)
    assert np.all(np.asarray(after.running.steps) < environment.horizon)
    if environment.actions.discrete:  # one point a step
        np.testing.assert_allclose(after.running.returns, after.running.steps)


def test_whole_episodes_are_the_same_either_way():
    _, state = after_some_rounds(SHORT, 5)
    for deterministic in (True, False):
        ours, theirs = (
            play(e, state.policy, jax.random.key(1), 6, deterministic=deterministic)
            for e in (cart_pole(horizon=60), HostCartPole(horizon=60))
        )
        np.testing.assert_array_equal(ours.lengths, theirs.lengths)
        np.testing.assert_array_equal(ours.terminated, theirs.terminated)
        np.testing.assert_array_equal(ours.returns, ours.lengths)
        for i, length in enumerate(ours.lengths):
            np.testing.assert_array_equal(ours.actions[i, :length], theirs.actions[i, :length])
            np.testing.assert_allclose(
                ours.observations[i, : length + 1], theirs.observations[i, : length + 1], atol=1e-5
            )
        assert ours.terminated.any()
        assert np.all(ours.terminated | (ours.lengths == 60))


# -- states -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("environment", TASKS, ids=lambda e: e.name)
def test_resumed_from_bytes_goes_on_to_the_bit(environment):
    agent, state = after_some_rounds(environment, 2)
    stored = restore(decode(encode(state)), agent.init(jax.random.key(7)))
    straight, _ = agent.train(state, 512)
    resumed, _ = agent.train(stored, 512)
    assert encode(straight) == encode(resumed)
    _, again = after_some_rounds(environment, 4)
    assert encode(again) == encode(straight)
    _, other = after_some_rounds(environment, 4, key=1)
    assert encode(other) != encode(straight)


@pytest.mark.parametrize("environment", TASKS, ids=lambda e: e.name)
def test_all_computing_is_in_32_bits(environment):
    agent, state = after_some_rounds(environment, 1)
    state, rollout = agent.collect(state)
    networks = state._replace(running=state.running._replace(states=None), key=None)
    for leaf in jax.tree.leaves((networks, rollout)):
        assert leaf.dtype in (np.float32, np.int32, bool)


def test_no_wider_number_is_computed_on_the_way():
    """In the improvement itself, 64 bits are only in constants and in the orders of minibatches."""
    agent = ppo(SHORT, **SMALL, scale_rewards=True, decay_over=1000, entropy=0.1)
    state, rollout = agent.collect(agent.init(jax.random.key(0)))
    text = str(jax.make_jaxpr(agent.improve)(state._replace(running=None), rollout, rollout.rewards))
    assert re.findall(r"f32\[\d", text)
    assert re.findall(r"f64\[\d.*", text) == []


# -- learning -----------------------------------------------------------------------------------------


def test_learns_to_balance():
    agent = ppo(cart_pole(), learning_rate=1e-3, scale_observations=False, scale_rewards=True)
    state, training = agent.train(agent.init(jax.random.key(0)), 25_000)
    assert training.steps[-1] == 25 * 1024
    assert training.returns[0] < 50
    total = np.nansum(training.returns * training.episodes) + np.sum(state.running.returns)
    np.testing.assert_allclose(total, training.steps[-1], rtol=1e-5)  # one point a step
    assert agent.evaluate(state.policy, jax.random.key(1), 20).returns.mean() >= 475


def test_learns_continuous_actions_on_the_host():
    """Match a spring and a damper, set by hand, from the same first states."""
    slope, key = Slope(), jax.random.key(1)
    agent = ppo(slope, **{**SMALL, "epochs": 10}, learning_rate=3e-3, gamma=0.9)
    state = agent.init(jax.random.key(0))
    before = agent.evaluate(state.policy, key, 50)
    state, _ = agent.train(state, 10_000)
    after = agent.evaluate(state.policy, key, 50)
    np.testing.assert_array_equal(before.observations[:, 0], after.observations[:, 0])
    states, damped = after.observations[:, 0].astype(float), np.zeros(50)
    for _ in range(slope.horizon):
        states, rewards, _ = slope.step(states, states @ [[-2.0], [-2.0]])
        damped += rewards
    assert before.returns.mean() < 0
    assert damped.mean() > 10
    assert after.returns.mean() > 0.97 * damped.mean()


# -- mistakes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_envs": 0}, "n_envs must be at least 1, got 0"),
        ({"n_steps": 100, "minibatch": 64}, "8 x 100 = 800 steps does not divide into minibatches of 64"),
        ({"gamma": 1.5}, r"gamma must be in \[0, 1\], got 1.5"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, got 0.0"),
        ({"clip": float("nan")}, "clip must be positive, got nan"),
    ],
)
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        ppo(cart_pole(), **settings)


def test_rewards_of_another_shape_are_refused():
    agent = ppo(SHORT, **SCALED)
    state, rollout = agent.collect(agent.init(jax.random.key(0)))
    with pytest.raises(ValueError, match=r"rewards of shape \(64, 4\); got \(256,\)"):
        agent.improve(state, rollout, rollout.rewards.reshape(-1))
