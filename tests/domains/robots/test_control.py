"""Classic control against Gymnasium's own environments, step by step."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.robots.control import (
    at_flag,
    cart_pole,
    cart_pole_dynamics,
    mountain_car,
    mountain_car_dynamics,
)

TASKS = {"CartPole-v1": cart_pole(), "MountainCar-v0": mountain_car()}


def _push_with_motion(rng, state):
    """Build up speed in the mountain car, so that it meets the flag, the end of the track and both clips."""
    return int(rng.integers(3)) if rng.random() < 0.2 else (2 if state[1] > 0 else 0)


def _random_push(rng, state):
    return int(rng.integers(2))


@pytest.mark.parametrize(
    ("name", "act"), [("CartPole-v1", _random_push), ("MountainCar-v0", _push_with_motion)]
)
def test_trajectories_are_gymnasiums(name, act):
    task, peer = TASKS[name], gymnasium.make(name).unwrapped
    step, observe = jax.jit(task.step), jax.jit(task.observe)
    rng = np.random.default_rng(0)
    endings = 0
    for seed in range(4):
        peer.reset(seed=seed)
        state = jnp.asarray(np.array(peer.state, np.float64))
        for _ in range(task.horizon):
            action = act(rng, state)
            seen, reward, terminated, _, _ = peer.step(action)
            state, our_reward, ended = step(state, action)
            np.testing.assert_allclose(state, np.array(peer.state, np.float64), rtol=1e-12, atol=1e-13)
            np.testing.assert_allclose(observe(state), seen, rtol=1e-6, atol=1e-12)
            assert observe(state).dtype == jnp.float32
            assert float(our_reward) == reward
            assert bool(ended) == terminated
            if terminated:
                endings += 1
                break
    assert endings >= 3


@pytest.mark.parametrize(("name", "count"), [("CartPole-v1", 2), ("MountainCar-v0", 3)])
def test_one_step_from_anywhere_is_gymnasiums(name, count):
    """States spread over and beyond what a trajectory meets, terminal ones and the track's ends included."""
    task, peer = TASKS[name], gymnasium.make(name).unwrapped
    rng = np.random.default_rng(1)
    reach = np.array([3.0, 3.0, 0.3, 3.0]) if count == 2 else np.array([1.3, 0.08])
    states = rng.uniform(-1, 1, (300, task.observation_size)) * reach
    actions = rng.integers(count, size=len(states))
    ours, _, ended = task.step(jnp.asarray(states), jnp.asarray(actions))
    endings = 0
    for state, action, ours_next, ours_ended in zip(states, actions, ours, ended, strict=True):
        peer.reset(seed=0)
        peer.state = tuple(state)
        _, _, terminated, _, _ = peer.step(int(action))
        np.testing.assert_allclose(ours_next, np.array(peer.state, np.float64), rtol=1e-12, atol=1e-13)
        assert bool(ours_ended) == terminated
        endings += terminated
    assert 0 < endings < len(states)


@pytest.mark.parametrize("name", TASKS)
def test_limits_and_bounds_are_gymnasiums(name):
    task, peer = TASKS[name], gymnasium.make(name)
    assert task.horizon == peer.spec.max_episode_steps
    assert task.actions.n == peer.action_space.n
    np.testing.assert_allclose(task.low, peer.observation_space.low, rtol=1e-6)
    np.testing.assert_allclose(task.high, peer.observation_space.high, rtol=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_first_states_have_gymnasiums_distribution(name):
    """Uniform over the box that Gymnasium's own draws fill: moments within five standard errors."""
    task, peer = TASKS[name], gymnasium.make(name).unwrapped
    keys = jax.random.split(jax.random.key(0), 4000)
    ours = np.array(jax.vmap(task.reset)(keys))
    theirs = np.array([peer.reset(seed=i)[0] for i in range(4000)], np.float64)
    error = 5 * theirs.std(0) * np.sqrt(2 / 4000)
    assert np.all(np.abs(ours.mean(0) - theirs.mean(0)) <= error + 1e-12)
    np.testing.assert_allclose(ours.std(0), theirs.std(0), rtol=0.05, atol=1e-12)
    np.testing.assert_allclose(ours.min(0), theirs.min(0), atol=1e-3)
    np.testing.assert_allclose(ours.max(0), theirs.max(0), atol=1e-3)


@pytest.mark.parametrize("dynamics", [cart_pole_dynamics, mountain_car_dynamics])
def test_dynamics_keep_precision_and_take_batches(dynamics):
    size = 4 if dynamics is cart_pole_dynamics else 2
    states = 0.05 * jax.random.normal(jax.random.key(2), (3, 5, size), jnp.float64)
    actions = jax.random.randint(jax.random.key(3), (3, 5), 0, 2)
    batch = dynamics(states, actions)
    one = jax.vmap(jax.vmap(dynamics))(states, actions)
    np.testing.assert_allclose(batch, one, rtol=1e-13)
    narrow = dynamics(states.astype(jnp.float32), actions)
    assert narrow.dtype == jnp.float32
    np.testing.assert_allclose(narrow, batch, atol=1e-6)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_left_end_stops_the_car_in_either_precision(dtype):
    state = mountain_car_dynamics(jnp.array([-1.19, -0.06], dtype), 0)
    np.testing.assert_allclose(state, [-1.2, 0.0], rtol=1e-6)
    assert state[1] == 0


def test_the_flag_is_reached_moving_right_only():
    np.testing.assert_array_equal(
        at_flag([[0.5, 0.0], [0.55, 0.01], [0.55, -0.01], [0.49, 0.07]]), [True, True, False, False]
    )
