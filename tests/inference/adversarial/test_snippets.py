import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.adversarial.snippets import (
    Packing,
    Ranked,
    Regression,
    Snippets,
    SSRRReward,
    draw_snippets,
    snippet_lengths,
    snippet_regression,
)

# -- snippets ---------------------------------------------------------------------------------------------


def test_lengths_are_uniform_between_their_bounds():
    lengths = snippet_lengths(Regression(), 4500)
    assert (np.diff(lengths) >= 0).all()
    values, counts = np.unique(lengths, return_counts=True)
    np.testing.assert_array_equal(values, np.arange(50, 500))
    assert (counts == 10).all()


def test_snippets_lie_in_their_trajectories_and_are_worth_their_share():
    lengths = np.array([300, 90, 40])
    worth = np.array([1.0, 0.5, 0.2])
    ranked = Ranked(jnp.zeros((3, 300, 1)), jnp.asarray(lengths), jnp.asarray(worth))
    wanted = np.tile(np.arange(50, 120), 60)
    which, start, length, label = map(np.asarray, draw_snippets(jax.random.key(0), ranked, wanted))
    np.testing.assert_array_equal(length, np.minimum(wanted, lengths[which]))
    assert ((start >= 0) & (start + length <= lengths[which])).all()
    np.testing.assert_allclose(label, 10 * worth[which] * length / 300, rtol=1e-6)
    shares = np.bincount(which) / len(which)
    np.testing.assert_allclose(shares, 1 / 3, atol=4 * np.sqrt(2 / 9 / len(which)))
    # All places that a snippet of 60 steps can begin at in 300 steps are as likely.
    mean = start[(which == 0) & (wanted == 60)].mean()
    assert mean == pytest.approx(120, abs=4 * 241 / np.sqrt(12 * 20))


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    length = np.array([3, 9, 20, 31])
    return rng.normal(size=(5, 40, 2)), Snippets(
        jnp.array([0, 4, 2, 2]), jnp.array([37, 0, 11, 9]), jnp.asarray(length), jnp.zeros(4)
    )


def sums(observations, batch):
    return np.array(
        [
            np.sin(observations[i, s : s + n]).sum()
            for i, s, n in zip(*map(np.asarray, batch[:3]), strict=True)
        ]
    )


def test_packed_snippets_sum_to_what_a_loop_sums(batch):
    observations, snippets = batch
    packed = Packing.of(np.array([5, 9, 25, 31]))
    assert len(packed.slot) == 70
    predicted = packed.predicted(
        lambda x: jnp.sin(x).sum(-1), jnp.asarray(observations), snippets, jax.random.key(0)
    )
    np.testing.assert_allclose(predicted, sums(observations, snippets), rtol=1e-5)


def test_sums_from_some_of_the_states_are_right_on_average(batch):
    observations, snippets = batch
    packed = Packing.of(np.array([4, 4, 4, 4]))
    keys = jax.random.split(jax.random.key(1), 4000)
    drawn = np.asarray(
        jax.vmap(
            lambda k: packed.predicted(lambda x: jnp.sin(x).sum(-1), jnp.asarray(observations), snippets, k)
        )(keys)
    )
    error = drawn.std(0) / np.sqrt(len(drawn))
    assert (np.abs(drawn.mean(0) - sums(observations, snippets)) < 4 * error + 1e-4).all()
    assert error[0] < 1e-6  # three states fit into four places


# -- regression -------------------------------------------------------------------------------------------


def linear_trajectories(weights, n=40, length=120, shortest=60, seed=0):
    """States whose reward ``weights . s`` is the trajectory's worth at every step, and all else noise."""
    rng = np.random.default_rng(seed)
    worth = rng.random(n)
    states = rng.normal(size=(n, length, len(weights)))
    unit = weights / np.linalg.norm(weights)
    states -= (states @ unit)[..., None] * unit
    states += worth[:, None, None] * weights / (weights @ weights)
    lengths = rng.integers(shortest, length + 1, n)
    states[np.arange(length) >= lengths[:, None]] = 1e3  # padding, which must not count
    return Ranked(jnp.asarray(states, jnp.float32), jnp.asarray(lengths), jnp.asarray(worth))


def test_a_linear_ensemble_finds_the_linear_reward():
    weights = np.array([1.0, -2.0, 0.5])
    ranked = linear_trajectories(weights, length=100, shortest=100)
    settings = Regression(
        hidden=(),
        members=2,
        snippets=400,
        shortest=10,
        longest=40,
        iterations=1500,
        learning_rate=1e-2,
        batch=32,
        penalty=0.0,
    )
    init, regress = snippet_regression(settings)
    reward = SSRRReward.create(jax.random.key(0), 3, settings)
    reward, _, fit = regress(reward, init(reward), ranked, jax.random.key(1))
    fresh = np.random.default_rng(5).normal(size=(50, 3))
    # Labels are 10 worth length / 100, so a step's reward is a tenth of its worth.
    np.testing.assert_allclose(reward(fresh), 0.1 * fresh @ weights, atol=2e-3)
    assert (np.asarray(fit.held_out) < 1e-3).all()


@pytest.fixture(scope="module")
def reduced():
    settings = Regression(
        hidden=(32, 32),
        members=2,
        snippets=600,
        shortest=10,
        longest=60,
        points=20,
        iterations=400,
        learning_rate=2e-3,
        batch=32,
        penalty=1e-3,
        deviation=0.2,
    )
    return settings, *snippet_regression(settings)


def test_networks_find_the_reward_up_to_scale(reduced):
    settings, init, regress = reduced
    weights = np.array([1.0, -2.0, 0.5])
    ranked = linear_trajectories(weights)
    reward = SSRRReward.create(jax.random.key(0), 3, settings)
    learned, _, fit = regress(reward, init(reward), ranked, jax.random.key(1))
    fresh = linear_trajectories(weights, seed=9).observations[:, :60]
    assert np.corrcoef(np.ravel(learned(fresh)), np.ravel(fresh @ weights))[0, 1] > 0.9
    assert fit.trained.shape == fit.held_out.shape == (2,)
    # The normaliser saw the live states and no padding.
    live = np.arange(120) < np.asarray(ranked.lengths)[:, None]
    seen = np.asarray(ranked.observations)[live]
    np.testing.assert_allclose(learned.norm.mean, seen.mean(0), atol=1e-4)
    np.testing.assert_allclose(learned.norm.deviation, seen.std(0), rtol=1e-3)


def test_the_ensemble_is_the_mean_of_members_with_snippets_of_their_own(reduced):
    settings, init, regress = reduced
    reward = SSRRReward.create(jax.random.key(0), 3, settings)
    ranked = linear_trajectories(np.ones(3))
    learned, _, _ = regress(reward, init(reward), ranked, jax.random.key(2))
    again, _, _ = regress(reward, init(reward), ranked, jax.random.key(2))
    for one, other in zip(jax.tree.leaves(learned), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    x = np.random.default_rng(0).normal(size=(4, 7, 3))
    each = np.asarray(learned.each(x))
    assert each.shape == (2, 4, 7)
    np.testing.assert_allclose(learned(x), each.mean(0), rtol=1e-6)
    assert np.abs(each[0] - each[1]).max() > 1e-4


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"members": 0}, "members"),
        ({"longest": 10}, "longest"),
        ({"held_out": 1.0}, "held_out"),
        ({"snippets": 40}, "batch of 64"),
    ],
)
def test_a_regression_that_cannot_be_is_refused_by_name(wrong, named):
    with pytest.raises(ValueError, match=named):
        snippet_regression(Regression(**wrong))
