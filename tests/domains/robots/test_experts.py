"""Experts: that they reach what they should, and that what is stored of them is what they do."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("mujoco")
pytest.importorskip("equinox")

from i2rl.domains.robots import experts
from i2rl.domains.robots.control import at_flag, mountain_car
from i2rl.domains.robots.experts import (
    EXPERTS,
    TARGETS,
    demonstrate_expert,
    expert_task,
    load_demonstrations,
    load_expert,
    load_facts,
    store_expert,
    train_expert,
)
from i2rl.domains.robots.walkers import ROBOTS, locomotion
from i2rl.models import StorageError


@pytest.mark.parametrize("name", EXPERTS)
def test_returns_reach_the_dissertations(name):
    stored, facts = load_demonstrations(name), load_facts(name)
    assert stored.returns.mean() >= TARGETS[name]
    assert_allclose(facts["returns"], stored.returns, atol=0.01)
    assert facts["steps"] >= experts.RECIPES[name].steps


@pytest.mark.parametrize("name", EXPERTS)
def test_episodes_are_whole_and_finite(name):
    stored, task = load_demonstrations(name), expert_task(name)
    n, length = stored.rewards.shape
    assert stored.observations.shape == (n, length, task.observation_size)
    assert stored.observations.dtype == stored.rewards.dtype == np.float32
    assert all(np.isfinite(array).all() for array in stored)
    assert len(np.unique(stored.observations[:, 0], axis=0)) == n >= 10
    after = np.arange(length) >= stored.lengths[:, None]
    assert not np.any(stored.observations[after])
    assert not np.any(stored.rewards[after])
    if name in ROBOTS:
        assert_array_equal(stored.lengths, 1000)
        assert not stored.terminated.any()
        assert np.abs(stored.actions).max() <= 1
    else:
        assert set(np.unique(stored.actions)) <= {0, 1, 2}
        assert_array_equal(stored.returns, -stored.lengths)
    taken = stored.recording
    assert_array_equal(taken.lengths, stored.lengths)
    assert_array_equal(taken.terminated, stored.terminated)


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_do_it_again(name):
    stored, robot = load_demonstrations(name), locomotion(name)
    states = np.pad(stored.observations[:, 0].astype(float), ((0, 0), (2, 0)))
    for t in range(50):
        assert_allclose(robot.observe(states), stored.observations[:, t], atol=1e-3)
        states, rewards, _ = robot.step(states, stored.actions[:, t])
        assert_allclose(rewards, stored.rewards[:, t], atol=1e-3)


def test_cars_do_it_again():
    stored, dynamics = load_demonstrations("mountain-car"), jax.jit(mountain_car().next_state)
    states = stored.observations[:, 0].astype(float)
    for t in range(stored.rewards.shape[1]):
        driving = t < stored.lengths
        assert_allclose(states[driving], stored.observations[driving, t], atol=1e-3)
        states = np.where(driving[:, None], dynamics(states, stored.actions[:, t]), states)
    assert_array_equal(at_flag(states), stored.terminated)


@pytest.mark.parametrize("name", EXPERTS)
def test_stored_actions_are_the_stored_policys(name):
    stored, policy = load_demonstrations(name), load_expert(name)
    live = np.arange(stored.rewards.shape[1]) < stored.lengths[:, None]
    actions = jax.jit(lambda seen: policy.actions.clip(policy.mode(seen)))(stored.observations[live])
    if name in ROBOTS:
        assert_allclose(actions, stored.actions[live], atol=1e-4)
    else:
        assert np.mean(actions == stored.actions[live]) > 0.999  # a tie may fall otherwise on another machine


def test_they_are_small():
    assert sum(path.stat().st_size for path in experts.FOLDER.iterdir()) <= 3 * 2**20


def test_training_is_repeated_stored_and_read_back(tmp_path, monkeypatch):
    recipe = experts.RECIPES["mountain-car"]
    small = {**recipe.settings, "n_envs": 4, "n_steps": 16, "minibatch": 32, "epochs": 1}
    monkeypatch.setitem(experts.RECIPES, "mountain-car", recipe._replace(settings=small))
    parts = []
    policy, training = train_expert("mountain-car", jax.random.key(0), 100, parts.append)
    again, _ = train_expert("mountain-car", jax.random.key(0), 100)
    other, _ = train_expert("mountain-car", jax.random.key(1), 100)
    assert_array_equal(training.steps, [64, 128])
    assert_array_equal(parts[0].steps, training.steps)
    same, different = (
        [np.array_equal(x, y) for x, y in zip(jax.tree.leaves(policy), jax.tree.leaves(p), strict=True)]
        for p in (again, other)
    )
    assert all(same)
    assert not all(different)

    recorded = demonstrate_expert(mountain_car(12), policy, jax.random.key(2), 3)
    assert_array_equal(recorded.lengths, 12)
    monkeypatch.setattr(experts, "FOLDER", tmp_path)
    hidden = [w.shape[1] for w in policy.logits.weights[:-1]]
    store_expert("mountain-car", policy, recorded, {"settings": {"hidden": hidden}}, tmp_path)
    for x, y in zip(jax.tree.leaves(policy), jax.tree.leaves(load_expert("mountain-car")), strict=True):
        assert_array_equal(x, y)
    for x, y in zip(recorded, load_demonstrations("mountain-car"), strict=True):
        assert_array_equal(x, y)
        assert x.dtype == y.dtype


def test_unknown_experts_are_named():
    for ask in (load_expert, load_demonstrations, load_facts, expert_task):
        with pytest.raises(ValueError, match="hopper, walker2d, half-cheetah, mountain-car; got 'ant'"):
            ask("ant")


def test_damaged_recordings_are_refused_by_file(tmp_path, monkeypatch):
    stored = {name: np.array(value) for name, value in load_demonstrations("mountain-car")._asdict().items()}
    monkeypatch.setattr(experts, "FOLDER", tmp_path)
    path = tmp_path / "mountain-car-demonstrations.npz"
    for changes, message in (
        ({"rewards": stored["rewards"][:, :5]}, r"'observations' of shape .* does not fit rewards"),
        ({"lengths": stored["lengths"] + 10**6}, r"'lengths' must lie between 0 and"),
        ({"terminated": stored["terminated"].astype(int)}, r"'terminated' must hold booleans; got integers"),
        ({"colour": np.zeros(3)}, r"unknown array 'colour'"),
    ):
        np.savez(path, **{**stored, **changes})
        with pytest.raises(StorageError, match=rf"mountain-car-demonstrations\.npz.*{message}"):
            load_demonstrations("mountain-car")
    for text, message in (
        ("[" * 10**5, "nested too deeply"),
        ("[]", "must have settings"),
        ("\xff", "utf-8"),
    ):
        (tmp_path / "mountain-car.json").write_text(text, encoding="latin-1")
        with pytest.raises(StorageError, match=rf"mountain-car\.json: .*{message}"):
            load_expert("mountain-car")
    (tmp_path / "mountain-car.json").write_text('{"settings": {"hidden": [4]}}')
    np.savez(tmp_path / "mountain-car-policy.npz", a=np.zeros(3))
    with pytest.raises(
        StorageError, match=r"mountain-car-policy\.npz: an archive of a policy has an unknown"
    ):
        load_expert("mountain-car")
