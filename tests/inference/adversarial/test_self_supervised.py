import cvxpy as cp
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.inference.adversarial.discriminator import airl_discriminator
from i2rl.inference.adversarial.noise_injection import NoisyTraining
from i2rl.inference.adversarial.policy_optimisation import ppo
from i2rl.inference.adversarial.self_supervised import (
    LEAST,
    MOST,
    SSRRTraining,
    fit_noise_curve,
    rank,
    sigmoid_curve,
    ssrr,
)
from i2rl.inference.adversarial.snippets import Regression
from i2rl.inference.journal.journal import Journal
from i2rl.inference.sessions.running import run_sessions
from i2rl.models.networks.environment import Environment
from i2rl.models.networks.modules import ActionSpace
from i2rl.models.observation.recordings import recording

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


@settings(max_examples=10)
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


# -- a slide on which further is better -------------------------------------------------------------------

PUSH = ActionSpace(0, (-1.0,), (1.0,))


def slid(state, action):
    push = jnp.clip(action[..., 0], -1, 1).astype(state.dtype)
    return jnp.stack([0.9 * state[..., 0] + 0.1 * push, state[..., 1]], -1)


def slide(horizon: int, wall: float) -> Environment:
    """Push a block along; the reward is its place; an irrelevant component accompanies it.

    It ends at a wall on the left.
    """

    def step(state, action):
        following = slid(state, action)
        return following, following[0], following[0] < -wall

    def reset(key):
        return jnp.stack([jnp.zeros((), jnp.float32), jax.random.normal(key, (), jnp.float32)])

    return Environment("slide", 2, (-1.0, -9.0), (1.0, 9.0), PUSH, horizon, reset, step, lambda s: s, slid)


def place_reward(slope: float, absorbing: float):
    """Make a state reward ``slope * place``."""
    network = airl_discriminator(2, PUSH, state_only=True, reward=()).init(jax.random.key(0))
    chosen = (jnp.array([[slope], [0.0]], jnp.float32), jnp.float32(absorbing))
    return eqx.tree_at(lambda n: (n.reward.weights[0], n.absorbing), network, chosen)


@pytest.fixture(scope="module")
def agent():
    settings = {"n_envs": 10, "n_steps": 80, "minibatch": 80, "learning_rate": 1e-3, "log_deviation": -1.0}
    return ppo(slide(40, 0.5), scale_rewards=True, **settings)


def pushing(agent, strength):
    state = agent.init(jax.random.key(0))
    pushes = jnp.full(1, strength, jnp.float32)
    return state._replace(policy=eqx.tree_at(lambda p: p.mean.biases[-1], state.policy, pushes))


def test_trajectories_are_worth_what_their_noise_leaves_of_the_reward(agent):
    curve, ranked = rank(
        agent.environment, pushing(agent, 0.8), place_reward(2.0, 0.0), LEVELS, 5, jax.random.key(1)
    )
    assert ranked.observations.shape == (100, 40, 2)
    assert (ranked.lengths == 40).all()
    np.testing.assert_array_equal(ranked.worth, np.repeat(curve.values, 5).astype(np.float32))
    returns = 2 * np.asarray(ranked.observations)[..., 0].sum(1).reshape(20, 5).mean(1)
    np.testing.assert_allclose(curve.scores, (returns - returns.min()) / np.ptp(returns), atol=1e-4)
    # With probability eps a push is nought on average: the expected place is proportional to 1 - eps.
    np.testing.assert_allclose(returns / returns[0], 1 - LEVELS, atol=0.25)
    assert curve.explained > 0.95


@pytest.mark.parametrize("average", ["mean", "median"])
def test_what_is_left_of_an_episode_that_ended_is_spent_in_the_absorbing_state(agent, average):
    network = place_reward(1.0, -2.0)
    curve, ranked = rank(
        agent.environment, pushing(agent, -0.8), network, LEVELS, 5, jax.random.key(1), average
    )
    lengths, place = np.asarray(ranked.lengths), np.asarray(ranked.observations)[..., 0]
    assert (lengths < 40).any()
    assert (lengths == 40).any()
    scores = [x[:n].sum() - 2 * (40 - n) for x, n in zip(place, lengths, strict=True)]
    returns = getattr(np, average)(np.reshape(scores, (20, 5)), 1)
    np.testing.assert_allclose(curve.scores, (returns - returns.min()) / np.ptp(returns), atol=1e-4)
    # Before its end no episode was beyond the wall, and a push from where it ended could lead there.
    for x, n in zip(place, lengths, strict=True):
        assert (x[:n] >= -0.5).all()
        assert n == 40 or 0.9 * x[n - 1] - 0.1 < -0.5


# -- the learner ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demonstration():
    """Record an expert who pushes at half strength."""
    rng = np.random.default_rng(0)
    observations, actions = [], []
    for _ in range(6):
        states, pushes = [np.array([0, rng.normal()])], rng.normal(0.5, 0.1, (40, 1))
        for push in pushes[:-1]:
            states.append(np.asarray(slid(states[-1], push)))
        observations.append(np.array(states))
        actions.append(pushes)
    return recording(observations, actions)


@pytest.fixture(scope="module")
def learner(agent):
    regression = Regression(
        hidden=(32, 32),
        members=2,
        snippets=1000,
        shortest=5,
        longest=30,
        batch=32,
        iterations=500,
        learning_rate=1e-3,
        penalty=1e-3,
        deviation=0.1,
    )
    return ssrr(
        agent,
        airl_discriminator(2, PUSH, state_only=True),
        NoisyTraining(iterations=30, updates=16, batch=128, learning_rate=3e-3, replay=5),
        SSRRTraining(regression=regression, iterations=40),
    )


@pytest.fixture(scope="module")
def sessions(learner, demonstration):
    kept = []
    run_sessions(learner, [demonstration] * 2, key=jax.random.key(0), on_session=lambda *x: kept.append(x))
    return kept


def test_noise_teaches_what_is_better_than_what_was_shown(agent, sessions, demonstration):
    state, info = sessions[0]
    shown = np.asarray(demonstration.observations)[..., 0].sum(1).mean()
    imitated = agent.evaluate(state.first.generator.policy, jax.random.key(1), 10).returns.mean()
    learned = agent.evaluate(state.generator.policy, jax.random.key(1), 10).returns.mean()
    assert imitated == pytest.approx(shown, rel=0.3)
    assert learned > 1.5 * shown
    assert info.curve.explained > 0.5
    line = np.stack([np.linspace(-1, 1, 21), np.zeros(21)], 1)
    assert np.corrcoef(state.network(line), line[:, 0])[0, 1] > 0.9


def test_everything_is_carried_between_sessions(sessions):
    state, info = sessions[-1]
    assert int(state.session) == int(state.first.session) == info.session == 2
    assert (state.optimiser[0].count == 2 * 500).all()
    assert int(state.generator.updates) == 2 * 40
    assert int(state.first.generator.updates) == 2 * 30
    assert info.pairs == 2 * 240
    assert info.environment_steps == 2 * ((30 + 40) * 800 + 20 * 5 * 40)
    assert info.returns.shape == (40,)
    # The ensemble's statistic of inputs holds the ranked states of both sessions.
    assert float(state.network.norm.count) == 2 * 20 * 5 * 40


def test_a_run_resumed_from_its_journal_equals_an_uninterrupted_one_to_the_bit(
    learner, demonstration, sessions, tmp_path
):
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        journal.commit(*sessions[0])
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        resumed = run_sessions(learner, [demonstration], journal=journal).state

    def bits(x) -> bytes:
        x = jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        return np.asarray(x).tobytes()

    leaves = zip(jax.tree.leaves(resumed), jax.tree.leaves(sessions[1][0]), strict=True)
    assert all(bits(a) == bits(b) for a, b in leaves)


def test_the_second_policy_may_begin_as_the_first(agent, demonstration):
    # An agent that never improves shows what it began as.
    still = agent._replace(improve=lambda state, rollout, rewards: state)
    training = SSRRTraining(
        regression=Regression(hidden=(), members=1, snippets=80, iterations=1, shortest=5, longest=30),
        iterations=1,
        start="first",
    )
    learner = ssrr(
        still, airl_discriminator(2, PUSH, state_only=True), NoisyTraining(iterations=1, updates=1), training
    )
    before = learner.init(jax.random.key(0))
    after, _ = learner.update(before, demonstration)
    weights = [p.generator.policy.mean.weights[0] for p in (before, before.first, after, after.first)]
    assert (weights[0] != weights[1]).any()
    np.testing.assert_array_equal(weights[2], weights[3])


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"iterations": 0}, "iterations"),
        ({"trajectories": 0}, "trajectories"),
        ({"levels": (0.0, 0.5)}, "four levels"),
        ({"average": "mode"}, "mean, median"),
        ({"start": "last"}, "scratch, first"),
        ({"regression": Regression(members=0)}, "members"),
    ],
)
def test_training_that_cannot_be_is_refused_by_name(agent, wrong, named):
    with pytest.raises(ValueError, match=named):
        ssrr(agent, airl_discriminator(2, PUSH), training=SSRRTraining(**wrong))
