"""The continuous onion task: its rules against a plain-Python account of them, its arm, its mover, its files.

Tests of the recordings run where the environment variable ``I2RL_ONION_RECORDINGS`` names their folder.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.robots.onion_recordings import read_onion_recordings, write_onion_recordings
from i2rl.domains.robots.reaching import (
    STRIDE,
    OnionMover,
    Scene,
    arm,
    compose,
    demonstrate_onions,
    move,
    onion_reaching,
    scene,
)
from i2rl.domains.robots.simulation import simulate
from i2rl.models.observation.recordings import RecordingError

RECORDINGS = os.environ.get("I2RL_ONION_RECORDINGS", "")
needs_recordings = pytest.mark.skipif(
    not RECORDINGS, reason="I2RL_ONION_RECORDINGS does not name the folder of the released recordings"
)
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def sorted_belts():
    return demonstrate_onions(KEY, 200)


# -- rules --------------------------------------------------------------------------------------------


def _in_bin(x, y, z):
    return 0.3 < x < 0.6 and y > 0.45 and z > 0.95


def _at_end(x, y, z):
    return 0.6 < x < 0.85 and y < -0.4 and z < 0.85


def _by_the_rules(wrist, onions, action, stride):
    """Compute one step from named parts: ``onions`` is a list of ``(x, y, z, label)``."""
    moved = [
        min(max(w + stride * min(max(a, -1.0), 1.0), low), high)
        for w, a, low, high in zip(wrist, action, (0.2, -0.65, 0.75), (0.95, 0.70, 1.30), strict=True)
    ]
    loose = [i for i, o in enumerate(onions) if o[3] != -1 and not _at_end(*o[:3])]
    reward, after = -0.001, [tuple(o) for o in onions]
    nearest = min(loose, key=lambda i: np.linalg.norm(np.subtract(onions[i][:3], wrist)), default=None)
    if nearest is not None and np.linalg.norm(np.subtract(onions[nearest][:3], wrist)) < 0.05:
        label = onions[nearest][3]
        if _in_bin(*moved):
            after[nearest] = (-1.0,) * 4
            reward += 1 if label == 0 else -1
        elif _at_end(*moved):
            after[nearest] = (moved[0], moved[1], 0.77, label)
            reward += 1 if label == 1 else -1
        else:
            after[nearest] = (*moved, label)
    finished = all(o[3] == -1 or _at_end(*o[:3]) for o in after)
    return moved, after, reward, finished


def test_steps_follow_the_rules():
    """From states about every place that matters, hands mostly near an onion, sometimes near two."""
    rng = np.random.default_rng(0)
    places = np.array([[0.45, 0.55, 1.1], [0.7, -0.5, 0.8], [0.75, 0.0, 0.77], [0.6, -0.4, 0.85]])
    n, stride, events = 400, 0.75, {"right": 0, "wrong": 0, "finished": 0, "held": 0}
    wrists = np.clip(
        places[rng.integers(4, size=n)] + rng.normal(0, 0.1, (n, 3)), (0.2, -0.65, 0.75), (0.95, 0.70, 1.30)
    )
    onions = np.empty((n, 5, 4))
    onions[..., :3] = wrists[:, None] + rng.normal(0, rng.choice([0.02, 0.3], (n, 5, 1)), (n, 5, 3))
    onions[..., 3] = rng.integers(2, size=(n, 5))
    onions[rng.random((n, 5)) < 0.5] = -1
    aims = places[rng.integers(4, size=n)] + rng.normal(0, 0.05, (n, 3))
    actions = (aims - wrists) / stride

    @jax.jit
    def moved(wrists, onions, actions):
        found = move(compose(Scene(wrists, onions[..., :3], onions[..., 3])), actions, stride)
        return found, scene(found.observation)

    found, after = jax.tree.map(np.asarray, moved(wrists, onions, actions))
    for i in range(n):
        wrist, things, reward, finished = _by_the_rules(wrists[i], onions[i].tolist(), actions[i], stride)
        np.testing.assert_allclose(after.wrist[i], wrist)
        np.testing.assert_allclose(after.onions[i], np.array(things)[:, :3])
        np.testing.assert_array_equal(after.labels[i], np.array(things)[:, 3])
        assert float(found.reward[i]) == pytest.approx(reward, abs=1e-6)
        assert bool(found.finished[i]) == finished
        events["right"] += reward > 0.5
        events["wrong"] += reward < -0.5
        events["finished"] += finished
        events["held"] += not np.allclose(np.array(things), onions[i])
    assert min(events.values()) > 20, events


def test_the_observation_is_the_state():
    task = onion_reaching()
    step, following, drawn = map(jax.jit, (task.step, task.next_state, OnionMover().sample))
    state = task.reset(KEY)
    assert state.dtype == jnp.float64
    for key in jax.random.split(KEY, 20):
        action = drawn(key, task.observe(state))
        after, _, _ = step(state, action)
        np.testing.assert_array_equal(following(state, action), after)
        assert following(task.observe(state), action).dtype == jnp.float32
        np.testing.assert_allclose(following(task.observe(state), action), after, atol=2e-6)
        state = after
    assert task.observe(state).shape == (task.observation_size,) == (29,)
    assert onion_reaching() is task


def test_a_belt_has_five_onions_within_reach_and_either_label():
    states = jax.jit(jax.vmap(onion_reaching().reset))(jax.random.split(KEY, 300))
    seen = jax.jit(scene)(states)
    dealt_with, held = jax.jit(lambda s: (scene(s).dealt_with, scene(s).held))(states)
    assert not dealt_with.any()
    assert not held.any()
    assert abs(float(seen.labels.mean()) - 0.5) < 0.05
    apart = jnp.linalg.norm(seen.onions[:, 1:] - seen.onions[:, :-1], axis=-1)
    assert apart.min() > 0.05  # a hand at one does not reach the next
    with pytest.raises(ValueError, match="the stride is a length in metres, got 0"):
        onion_reaching(0)


# -- arm ----------------------------------------------------------------------------------------------


def test_links_keep_their_length_and_the_shoulder_leans_only_where_it_must():
    rng = np.random.default_rng(1)
    wrist = rng.uniform((0.2, -0.65, 0.75), (0.95, 0.70, 1.30), (500, 3))
    shoulder, elbow = map(np.asarray, jax.jit(arm)(wrist))
    np.testing.assert_allclose(np.linalg.norm(elbow - shoulder, axis=1), 0.30, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(wrist - elbow, axis=1), 0.20, atol=1e-9)
    rest = np.array([0.47, -0.12, 1.42])
    near = np.linalg.norm(wrist - rest, axis=1) < 0.499
    assert 0.1 < near.mean() < 0.9
    np.testing.assert_allclose(shoulder[near], np.broadcast_to(rest, (near.sum(), 3)))
    assert (np.linalg.norm(wrist - shoulder, axis=1)[~near] < 0.4991).all()
    assert (elbow[:, 2] < shoulder[:, 2]).all()


def test_the_dynamics_have_derivatives(sorted_belts):
    """Automatic ones equal finite differences, arm bent or stretched, hand empty or full."""
    task = onion_reaching()
    trajectories = sorted_belts
    states = trajectories.observations[0, 1:25].astype(float)
    actions = trajectories.actions[0, 1:25].astype(float)
    by_both = jax.jit(jax.vmap(jax.jacfwd(task.next_state, (0, 1))))(states, actions)
    following = jax.jit(task.next_state)
    checked = 0
    for of, given, other in ((0, states, actions), (1, actions, states)):
        exact = np.asarray(by_both[of])
        assert np.isfinite(exact).all()
        for j in range(given.shape[1]):
            up, down = (given + h * np.eye(given.shape[1])[j] for h in (1e-6, -1e-6))
            pairs = [(up, other), (down, other)] if of == 0 else [(other, up), (other, down)]
            high, low = (np.asarray(following(*pair)) for pair in pairs)
            slope = (high - low) / 2e-6
            smooth = np.abs(slope).max(1) < 100  # not where a rule changes in between
            np.testing.assert_allclose(exact[smooth, :, j], slope[smooth], atol=1e-4)
            checked += smooth.sum()
    assert checked > 0.95 * len(states) * 32


# -- the mover ----------------------------------------------------------------------------------------


def test_the_mover_never_errs(sorted_belts):
    hasty = demonstrate_onions(KEY, 200, looking=0.0)
    for found in (sorted_belts, hasty):
        assert found.terminated.all()
        np.testing.assert_allclose(found.returns, 5 - 0.001 * found.live.sum(1), atol=1e-5)
    # Geometric pauses of 9 steps on average, five of them; some onions are passed along without any.
    assert 25 < (sorted_belts.live.sum(1) - hasty.live.sum(1)).mean() < 45


@pytest.mark.parametrize("stride", [STRIDE, 0.1])
def test_its_mode_sorts_at_any_stride(stride):
    found = simulate(onion_reaching(stride), OnionMover(stride), KEY, 100, deterministic=True)
    assert found.terminated.all()
    np.testing.assert_allclose(found.returns, 5 - 0.001 * found.live.sum(1), atol=1e-5)
    assert np.abs(found.actions).max() <= 1


# -- files --------------------------------------------------------------------------------------------


def test_what_is_written_is_read(tmp_path, sorted_belts):
    few = type(sorted_belts)(*(x[:12] for x in sorted_belts))
    paths = write_onion_recordings(tmp_path, few)
    assert paths[11].name == "states_12.csv"
    found = read_onion_recordings(tmp_path)
    np.testing.assert_array_equal(found.lengths, few.live.sum(1) + 1)
    for i, live in enumerate(few.live):  # in the order of their numbers, 10 after 9
        steps = live.sum()
        np.testing.assert_allclose(found.observations[i, :steps], few.observations[i, live], atol=0.00501)
        np.testing.assert_allclose(found.actions[i, :steps], few.actions[i, live], atol=0.0101 / STRIDE)
        _check_facts(
            np.asarray(found.observations[i, : steps + 1]), np.asarray(found.actions[i, : steps + 1])
        )


def _check_facts(states, actions):
    """Check every released recording: actions lead to the next wrist, and every onion is sorted correctly."""
    np.testing.assert_allclose(np.diff(states[:, 6:9], axis=0), STRIDE * actions[:-1], atol=1e-9)
    labels = states[:, 12::4]
    np.testing.assert_array_equal(labels[-1] == -1, labels[0] == 0)
    assert (states[:, 9:].reshape(-1, 5, 4)[labels == -1] == -1).all()


def _change(path, row, column, value):
    lines = [line.split(",") for line in path.read_text().splitlines()]
    lines[row - 1][column - 1] = value
    path.write_text("\n".join(map(",".join, lines)) + "\n", errors="surrogateescape")


@pytest.mark.parametrize(
    ("name", "row", "column", "value", "told"),
    [
        ("states", 4, 7, "wrist", r"states_2.csv, row 4, column 7: 'wrist' is not a finite number"),
        ("states", 1, 1, "nan", r"states_2.csv, row 1, column 1: 'nan' is not a finite number"),
        ("states", 3, 3, "1_0", r"states_2.csv, row 3, column 3: '1_0' is not a finite number"),
        ("states", 3, 3, "1e999", r"states_2.csv, row 3, column 3: '1e999' is not a finite number"),
        ("states", 3, 3, "x" * 2000, r"states_2.csv, row 3, column 3: 'x+\.\.\.x+' is not a finite number"),
        ("states", 3, 3, "0" * 5000, r"states_2.csv, row 3: a row must have at most 4096 characters"),
        ("states", 3, 3, "\udcff", r"states_2.csv, row 3: not UTF-8 text at byte"),
        ("actions", 3, 3, "", r"actions_2.csv, row 3, column 3: '' is not a finite number"),
        ("states", 5, 2, "0.1,0.2", r"states_2.csv, row 5: 30 columns, expected 29"),
        ("states", 6, 17, "0.5", r"states_2.csv, row 6, column 17: the label is 0.5; expected 1"),
        ("actions", 2, 1, "0.95", r"actions_2.csv, row 2, column 1: a displacement of 0.95 m, but"),
        ("actions", 2, 3, "0.7", r"actions_2.csv, row 2, column 3: the displacement is 0.7 m, but the wrist"),
    ],
)
def test_files_that_are_wrong_are_named(tmp_path, sorted_belts, name, row, column, value, told):
    write_onion_recordings(tmp_path, type(sorted_belts)(*(x[:2] for x in sorted_belts)))
    _change(tmp_path / f"{name}_2.csv", row, column, value)
    with pytest.raises(RecordingError, match=told):
        read_onion_recordings(tmp_path)


def test_files_that_are_missing_are_named(tmp_path, sorted_belts):
    with pytest.raises(RecordingError, match=r"has no recordings: expected files states_1.csv"):
        read_onion_recordings(tmp_path)
    write_onion_recordings(tmp_path, type(sorted_belts)(*(x[:2] for x in sorted_belts)))
    path = tmp_path / "actions_2.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(RecordingError, match=r"states_2.csv has \d+ rows and .*actions_2.csv \d+"):
        read_onion_recordings(tmp_path)
    path.unlink()
    with pytest.raises(RecordingError, match=r"actions_2.csv is missing"):
        read_onion_recordings(tmp_path)


# -- recordings ---------------------------------------------------------------------------------------


@needs_recordings
def test_the_released_recordings_are_read_whole():
    found = read_onion_recordings(Path(RECORDINGS))
    assert found.observations.shape == (10, 78, 29)
    assert found.lengths.sum() == 709
    for states, actions, live in zip(*map(np.asarray, found[:3]), strict=True):
        _check_facts(states[live], actions[live])


@needs_recordings
def test_the_mover_moves_somewhat_like_the_recorded_person(sorted_belts):
    found = read_onion_recordings(Path(RECORDINGS))
    live = np.asarray(found.live)
    ours, theirs = sorted_belts.visited, np.asarray(found.observations)[live]
    assert sorted_belts.live.sum(1).mean() == pytest.approx(found.lengths.mean(), rel=0.15)
    lengths = [
        np.quantile(np.linalg.norm(STRIDE * a, axis=1), [0.1, 0.25, 0.5, 0.75, 0.9])
        for a in (sorted_belts.actions[sorted_belts.live], np.asarray(found.actions)[live])
    ]
    np.testing.assert_allclose(lengths[0], lengths[1], rtol=0.6)
    np.testing.assert_allclose(ours[:, 6:9].mean(0), theirs[:, 6:9].mean(0), atol=0.1)
    np.testing.assert_allclose(ours[:, 6:9].std(0), theirs[:, 6:9].std(0), rtol=0.4)


@needs_recordings
def test_the_arm_is_somewhat_like_the_recorded_persons():
    found = read_onion_recordings(Path(RECORDINGS))
    states = np.asarray(found.observations)[np.asarray(found.live)]
    shoulder, elbow = map(np.asarray, jax.jit(arm)(states[:, 6:9]))
    assert np.median(np.linalg.norm(shoulder - states[:, :3], axis=1)) < 0.05
    assert np.median(np.linalg.norm(elbow - states[:, 3:6], axis=1)) < 0.10
