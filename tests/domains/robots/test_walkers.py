"""Walking robots: the same tasks as Gymnasium's, and dynamics that are pure and differentiable."""

import math
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("mujoco")

from i2rl.domains.robots.walkers import ROBOTS, locomotion

PEERS = {"hopper": "Hopper-v5", "walker2d": "Walker2d-v5", "half-cheetah": "HalfCheetah-v5"}


def on_the_way(robot, n, steps=15, seed=0, strength=1.0):
    """States and random actions of ``n`` robots some steps after the start, on the ground or near it."""
    rng = np.random.default_rng(seed)
    states = robot.reset(jax.random.key(seed), n)
    for _ in range(steps):
        states, _, _ = robot.step(states, strength * rng.uniform(-1, 1, (n, robot.actions.size)))
    return states, rng.uniform(-1, 1, (n, robot.actions.size))


@pytest.fixture
def peer(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings about Gymnasium's models where it runs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        environment = gymnasium.make(PEERS[request.param]).unwrapped
    yield request.param, environment
    environment.close()


@pytest.mark.parametrize("peer", ROBOTS, indirect=True)
def test_steps_rewards_and_falls_are_gymnasiums(peer):
    name, environment = peer
    robot, fixed = locomotion(name), locomotion(name, terminate_when_unhealthy=False)
    state = robot.reset(jax.random.key(3), 1)
    nq = environment.model.nq
    environment.reset(seed=0)
    environment.set_state(state[0, 1 : 1 + nq], state[0, 1 + nq :])
    rng = np.random.default_rng(3)
    falls = 0
    for _ in range(60):
        action = rng.uniform(-1, 1, robot.actions.size)
        observation, reward, terminated, _, _ = environment.step(action)
        _, _, never = fixed.step(state, action[None])
        state, rewards, over = robot.step(state, action[None])
        assert_allclose(robot.observe(state)[0], observation, atol=1e-6)
        assert_allclose(rewards[0], reward, atol=1e-6)
        assert bool(over[0]) == bool(terminated)
        assert not never[0]
        falls += terminated
        # errors of one step only: HalfCheetah's are amplified a millionfold in sixty
        state[0, 1:] = np.concatenate([environment.data.qpos, environment.data.qvel])
    assert (falls > 0) == (name != "half-cheetah")
    assert_allclose(robot.step_seconds, environment.dt)


@pytest.mark.parametrize("peer", ROBOTS, indirect=True)
def test_starts_are_gymnasiums(peer):
    name, environment = peer
    robot = locomotion(name)
    ours = robot.observe(robot.reset(jax.random.key(0), 4000))
    theirs = np.stack([environment.reset(seed=seed)[0] for seed in range(400)])
    assert_allclose(ours.mean(0), theirs.mean(0), atol=5 * theirs.std() / math.sqrt(400))
    deviation = theirs.std(0)
    assert_allclose(ours.std(0), deviation, rtol=0.2)
    if name != "half-cheetah":  # uniform, so bounded
        assert np.all(np.abs(ours - ours.mean(0)) <= 5.5e-3)
    assert_array_equal(robot.reset(jax.random.key(0), 3), robot.reset(jax.random.key(0), 4000)[:3])
    assert not np.allclose(robot.reset(jax.random.key(1), 3), robot.reset(jax.random.key(0), 3))


@pytest.mark.parametrize("name", ROBOTS)
def test_same_bits_however_many_robots_and_threads(name):
    robot = locomotion(name, threads=1)
    states, actions = on_the_way(robot, 50)
    together = robot.step(states, actions)
    several = locomotion(name, threads=3).step(states, actions)
    alone = robot.step(states[31:32], actions[31:32])
    for a, b, c in zip(together, several, alone, strict=True):
        assert_array_equal(a, b)
        assert_array_equal(a[31:32], c)


@pytest.mark.parametrize("name", ROBOTS)
def test_pure_dynamics_are_the_simulators(name):
    robot = locomotion(name)
    states, actions = on_the_way(robot, 40, strength=0.3)
    unclipped = np.all(np.abs(states[:, 2 + (robot.observation_size - 1) // 2 :]) < 10, axis=1)
    assert unclipped.sum() >= 10
    following = robot.observe(robot.step(states, actions)[0])
    pure = robot.next_state(robot.observe(states), actions)
    assert_allclose(
        pure[unclipped], following[unclipped], atol=1e-9
    )  # where the robot stands changes rounding
    assert_array_equal(
        robot.next_state(robot.observe(states), 3 * np.sign(actions)),
        robot.next_state(robot.observe(states), np.sign(actions)),
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_jacobians_are_finer_differences(name):
    """Richardson's extrapolation of two wider differences, where no contact changes between their ends."""
    robot = locomotion(name)
    states, actions = on_the_way(robot, 12)
    observations = robot.observe(states)
    by_state, by_action = robot.jacobians(observations, actions)
    rng = np.random.default_rng(1)
    smooth = 0
    for _ in range(4):
        v, u = rng.normal(size=observations.shape), rng.normal(size=actions.shape)

        def slope(h, v=v, u=u):
            ahead = robot.next_state(observations + h * v, actions + h * u)
            return (ahead - robot.next_state(observations - h * v, actions - h * u)) / (2 * h)

        inside = np.all(np.abs(actions) + 1e-4 * np.abs(u) < 1, axis=1)
        wide, narrow = slope(2e-5), slope(1e-5)
        expected = (4 * narrow - wide) / 3
        given = np.einsum("nij,nj->ni", by_state, v) + np.einsum("nij,nj->ni", by_action, u)
        settled = inside & (np.abs(wide - narrow).max(1) < 1e-4 * np.abs(narrow).max(1))
        smooth += settled.sum()
        assert_allclose(given[settled], expected[settled], rtol=1e-4, atol=1e-4)
    assert smooth >= 12


def test_actions_have_no_slope_beyond_their_bounds_and_a_one_sided_one_at_them():
    robot = locomotion("hopper")
    states, actions = on_the_way(robot, 3, steps=3)
    observations = robot.observe(states)
    actions[:, 0] = [1.0, 1.5, 0.5]
    _, by_action = robot.jacobians(observations, actions)
    inside = actions.copy()
    inside[0, 0] -= 1e-5
    _, near = robot.jacobians(observations, inside)
    assert_allclose(by_action[0], near[0], rtol=1e-3, atol=1e-4)
    assert_array_equal(by_action[1, :, 0], 0)
    assert np.abs(by_action[[0, 2], :, 0]).max() > 0.1


def test_fixed_length_costs_a_fallen_robot_its_health():
    robot = locomotion("hopper", terminate_when_unhealthy=False)
    states = robot.reset(jax.random.key(0), 2)
    states[1, 3] = 0.5  # pitched over
    following, rewards, terminated = robot.step(states, np.zeros((2, 3)))
    assert_array_equal(robot.healthy(following), [True, False])
    moved = (following[:, 1] - states[:, 1]) / robot.step_seconds
    assert_allclose(rewards - moved, [1, 0], atol=1e-12)
    assert not terminated.any()


@pytest.mark.parametrize("name", ROBOTS)
def test_silhouette_has_the_limbs_lengths_and_follows_the_pose(name):
    robot = locomotion(name)
    observation = robot.observe(robot.reset(jax.random.key(0), 1))[0]
    limbs = robot.silhouette(observation)
    assert len(limbs) == {"hopper": 4, "walker2d": 7, "half-cheetah": 8}[name]
    lengths = [math.hypot(limb.x2 - limb.x1, limb.z2 - limb.z1) for limb in limbs]
    assert_allclose(lengths[0], {"half-cheetah": 1.0}.get(name, 0.4), rtol=1e-6)  # torso, from the model file
    assert all(min(limb.z1, limb.z2) > 0 for limb in limbs)
    raised = observation.copy()
    raised[0] += 0.3
    for before, after in zip(limbs, robot.silhouette(raised, x=2.0), strict=True):
        expected = np.add(before, (2, 0.3, 2, 0.3, 0))
        assert_allclose(after, expected, atol=1e-12)
    bent = observation.copy()
    bent[2] -= 0.4
    changed = np.abs(np.subtract(limbs, robot.silhouette(bent))).max(1) > 0.01
    assert changed.any()
    assert not changed[0]


def test_errors_say_what_was_given():
    with pytest.raises(ValueError, match="hopper, walker2d, half-cheetah; got 'ant'"):
        locomotion("ant")
    with pytest.raises(ValueError, match="at least 1, got 0"):
        locomotion("hopper", threads=0)
    robot = locomotion("hopper")
    states = robot.reset(jax.random.key(0), 4)
    actions = np.zeros((4, 3))
    with pytest.raises(ValueError, match=r"actions of hopper must be \[robots, 3\], got the shape \[4, 2\]"):
        robot.step(states, actions[:, :2])
    with pytest.raises(ValueError, match="4 robots need 4 actions, got 3"):
        robot.step(states, actions[:3])
    with pytest.raises(ValueError, match=r"states must be \[robots, 13\], got the shape \[13\]"):
        robot.step(states[0], actions)
    actions[2, 1] = np.nan
    with pytest.raises(ValueError, match="actions of hopper: number 1 of robot 2 is nan"):
        robot.step(states, actions)
    observations = robot.observe(states)
    observations[3, 5] = 1e9
    with pytest.raises(
        ValueError,
        match=r"observations of hopper: number 5 of robot 3 is 1000000000\.0; expected a finite one",
    ):
        robot.next_state(observations, np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"observations of hopper must be \[robots, 11\]"):
        robot.jacobians(states, np.zeros((4, 3)))


def test_nobody_to_step():
    robot = locomotion("hopper")
    states, rewards, terminated = robot.step(robot.reset(jax.random.key(0), 0), np.zeros((0, 3)))
    assert states.shape == (0, 13)
    assert rewards.shape == terminated.shape == (0,)
