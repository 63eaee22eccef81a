import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.inference.ssrr import (
    LEAST,
    MOST,
    Ranked,
    Regression,
    Snippets,
    SSRRReward,
    _Packing,
    draw_snippets,
    fit_noise_curve,
    sigmoid_curve,
    snippet_lengths,
    snippet_regression,
)

LEVELS = np.arange(0, 1, 0.05)

# -- performance against noise ----------------------------------------------------------------------------


@pytest.mark.parametrize("k", [-3.76, -12.0])
def test_the_sigmoid_is_recovered_from_returns_in_any_unit(k):
    # The published fit of one HalfCheetah run, and a steeper one.
    true = np.array([0.294, 0.175, 1.074, k])
    shape = sigmoid_curve(LEVELS, true)
    low, high = shape.min(), shape.max()
    curve = fit_noise_curve(LEVELS, 2000 * shape - 300)
    assert curve.sigmoid
    scaled = np.array([true[0], (true[1] - low) / (high - low), true[2] / (high - low), k])
    np.testing.assert_allclose(curve.parameters, scaled, rtol=1e-4)
    np.testing.assert_allclose(curve.values, (shape - low) / (high - low), atol=1e-6)
    assert curve.explained == pytest.approx(1)


def test_noise_in_the_returns_moves_the_fit_little():
    true = np.array([0.4, 0.0, 1.0, -8.0])
    shape = sigmoid_curve(LEVELS, true)
    curve = fit_noise_curve(LEVELS, shape + np.random.default_rng(0).normal(0, 0.03, len(LEVELS)))
    assert curve.sigmoid
    assert np.corrcoef(curve.values, shape)[0, 1] > 0.99


@given(st.lists(st.floats(-1e3, 1e3), min_size=20, max_size=20))
def test_whatever_was_measured_the_curve_falls_within_its_bounds(returns):
    curve = fit_noise_curve(LEVELS, np.array(returns))
    assert np.isfinite(curve.values).all()
    assert (np.diff(curve.values) <= 1e-12).all()
    assert (curve.parameters >= LEAST).all()
    assert (curve.parameters <= MOST).all()
    assert curve.scores.min() == 0
    assert 0 <= curve.explained <= 1 + 1e-12


def test_an_exponential_in_disguise_stays_within_bounds():
    # What made the released fits degenerate: a curve that falls ever more slowly.
    curve = fit_noise_curve(LEVELS, np.exp(-4 * LEVELS))
    assert curve.sigmoid
    assert curve.parameters[2] <= 2
    assert curve.explained > 0.99


def test_steps_that_no_sigmoid_fits_are_kept_by_the_best_falling_curve():
    returns = np.where(LEVELS < 0.05, 1.0, np.where(LEVELS < 0.95, 0.5, 0.0))
    curve = fit_noise_curve(LEVELS, returns)
    assert not curve.sigmoid
    np.testing.assert_allclose(curve.values, returns)


def test_the_fallback_is_the_least_squares_falling_curve():
    rng = np.random.default_rng(3)
    returns = np.where(LEVELS < 0.08, 1.0, 0.4 - 0.1 * LEVELS) + rng.normal(0, 0.05, len(LEVELS))
    returns[-1] = 0.0
    curve = fit_noise_curve(LEVELS, returns, loss=0.0)
    assert not curve.sigmoid
    falling = cp.Variable(len(LEVELS))
    cp.Problem(cp.Minimize(cp.sum_squares(falling - curve.scores)), [cp.diff(falling) <= 0]).solve(
        solver=cp.CLARABEL
    )
    np.testing.assert_allclose(curve.values, falling.value, atol=1e-6)


@pytest.mark.parametrize("returns", [np.full(20, 7.0), LEVELS])
def test_returns_that_do_not_fall_explain_nothing(returns):
    curve = fit_noise_curve(LEVELS, returns)
    assert curve.explained < 1e-3
    assert np.ptp(curve.values) < 1e-2


@pytest.mark.parametrize(
    ("levels", "returns", "named"),
    [
        (LEVELS, np.where(np.arange(20) == 3, np.nan, 1.0), "level 0.15 is nan"),
        (LEVELS[::-1], LEVELS, "increasing"),
        (2 * LEVELS, LEVELS, "probabilities"),
        (LEVELS, LEVELS[:5], "shapes"),
        (LEVELS[:3], LEVELS[:3], "four levels"),
    ],
)
def test_measurements_that_cannot_be_fitted_are_refused(levels, returns, named):
    with pytest.raises(ValueError, match=named):
        fit_noise_curve(levels, returns)


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
    np.testing.assert_allclose(label, 10 * worth[which] * length / lengths[which], rtol=1e-6)
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
    packed = _Packing.of(np.array([5, 9, 25, 31]))
    assert len(packed.slot) == 70
    predicted = packed.predicted(
        lambda x: jnp.sin(x).sum(-1), jnp.asarray(observations), snippets, jax.random.key(0)
    )
    np.testing.assert_allclose(predicted, sums(observations, snippets), rtol=1e-5)


def test_sums_from_some_of_the_states_are_right_on_average(batch):
    observations, snippets = batch
    packed = _Packing.of(np.array([4, 4, 4, 4]))
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
        hidden=(), members=2, snippets=400, shortest=10, longest=40, iterations=1500, learning_rate=1e-2,
        batch=32, penalty=0.0,
    )  # fmt: skip
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
        hidden=(32, 32), members=2, snippets=600, shortest=10, longest=60, points=20, iterations=400,
        learning_rate=2e-3, batch=32, penalty=1e-3, deviation=0.2,
    )  # fmt: skip
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
