from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.robots.control import cart_pole, mountain_car
from i2rl.inference.adversarial.discriminator import Transitions, airl_discriminator, cross_entropy
from i2rl.inference.adversarial.noise_injection import (
    LEVELS,
    NoisyTraining,
    importance_weights,
    log_uniform,
    noisy_airl,
    roll_out_noisily,
)
from i2rl.inference.adversarial.policy_optimisation import ppo
from i2rl.inference.adversarial.rollouts import begin
from i2rl.inference.journal.journal import Journal
from i2rl.inference.sessions.running import run_sessions
from i2rl.models.networks.modules import MLP, ActionSpace, CategoricalPolicy, GaussianPolicy
from i2rl.models.observation.recordings import recording

BOX = ActionSpace(0, (-1.0, -2.0), (1.0, 0.5))


class Drifting(NamedTuple):
    """A point on the host that goes where it is pushed, for at most seven steps; it ends beyond 3."""

    name: str = "drifting"
    observation_size: int = 2
    actions: ActionSpace = BOX
    horizon: int = 7

    def reset(self, key, n):
        return np.asarray(jax.random.uniform(key, (n, 2), jnp.float32, -0.1, 0.1))

    def step(self, states, actions):
        states = self.next_state(states, actions)
        return states, states[:, 0], np.abs(states[:, 0]) > 3

    def observe(self, states):
        return states

    def next_state(self, observations, actions):
        return observations + np.clip(actions, BOX.low, BOX.high).astype(np.float32)


def parts(environment, key=0):
    k_policy, k_critic = jax.random.split(jax.random.key(key))
    size, actions = environment.observation_size, environment.actions
    kind = CategoricalPolicy if actions.discrete else GaussianPolicy
    return kind.create(k_policy, size, actions), MLP.create(k_critic, (size, 32, 32, 1))


# -- importance weights -----------------------------------------------------------------------------------


def test_random_actions_have_a_density_that_is_one_in_all():
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 601), np.linspace(-3, 3, 601)), -1)
    # Cells of a hundredth squared; the edge of the box is counted in full.
    assert np.exp(log_uniform(BOX, grid)).sum() * 1e-4 == pytest.approx(1, abs=0.02)
    assert np.exp(log_uniform(ActionSpace(3), np.arange(3))).sum() == pytest.approx(1)


@pytest.mark.parametrize("level", [0.05, 0.25, 0.8])
def test_weights_turn_means_over_noisy_actions_into_means_over_the_policy(level):
    # About a fifth of this policy's actions fall outside of the box, where nothing is random.
    policy, _ = parts(Drifting())
    policy = eqx.tree_at(lambda p: p.log_deviation, policy, jnp.log(jnp.array([0.8, 0.6], jnp.float32)))
    n, rng = 50_000, np.random.default_rng(0)
    state = np.array([0.3, -1.0], np.float32)
    own = np.asarray(policy.mode(state)) + np.array([0.8, 0.6]) * rng.normal(size=(n, 2))
    noise = rng.uniform(BOX.low, BOX.high, (n, 2))
    executed = np.where(rng.random(n)[:, None] < level, noise, own)
    weights = np.asarray(importance_weights(policy, np.tile(state, (n, 1)), jnp.asarray(executed), level))
    assert weights.max() <= 1 / (1 - level) + 1e-5
    for g in (np.ones_like, lambda a: a, lambda a: np.abs(a) > 1, lambda a: np.sin(3 * a)):
        weighed, wanted = weights[:, None] * g(executed), g(own)
        error = np.sqrt((weighed.var(0) + wanted.var(0)) / n)
        assert (np.abs(weighed.mean(0) - wanted.mean(0)) < 4 * error + 1e-9).all()


def test_weights_of_numbered_actions_are_exact_in_expectation():
    policy, _ = parts(mountain_car())
    policy = eqx.tree_at(lambda p: p.logits.biases[-1], policy, jnp.array([0.0, 2.0, -3.0], jnp.float32))
    state = jnp.array([-0.5, 0.02], jnp.float32)
    pi = np.exp(policy.log_probs(state))
    weights = importance_weights(policy, jnp.tile(state, (3, 1)), jnp.arange(3), 0.3)
    np.testing.assert_allclose((0.3 / 3 + 0.7 * pi) * weights, pi, rtol=1e-5)


def test_without_noise_every_action_counts_once():
    policy, _ = parts(Drifting())
    actions = jnp.asarray(np.random.default_rng(0).normal(0, 2, (50, 2)), jnp.float32)
    np.testing.assert_array_equal(importance_weights(policy, jnp.zeros((50, 2)), actions, jnp.zeros(50)), 1)


# -- acting with noise ------------------------------------------------------------------------------------


def acted_out(environment, levels, length, steps=0):
    """Run a policy with noise, in episodes that have lasted some steps already."""
    policy, critic = parts(environment)
    running = begin(environment, jax.random.key(1), len(levels))
    running = running._replace(steps=running.steps + steps)
    _, noisy = roll_out_noisily(environment, policy, critic, running, levels, jax.random.key(2), length)
    return policy, critic, jax.tree.map(np.asarray, noisy)


@pytest.mark.parametrize(
    ("environment", "levels", "length", "steps", "unlike"),
    [
        (cart_pole(100), np.repeat([0.0, 0.6], 5), 128, 97, 1 / 2),
        (Drifting(), np.array([0.0, 0.0, 0.25, 0.6]), 400, 0, 1),
    ],
)
def test_what_is_executed_is_what_happens_and_what_is_intended_is_recorded(
    environment, levels, length, steps, unlike
):
    policy, critic, (r, executed) = acted_out(environment, levels, length, steps)
    changed = (executed != r.actions).reshape(length, len(levels), -1).any(-1)
    following = environment.next_state(r.observations, executed)
    np.testing.assert_allclose(r.next_observations, following, atol=1e-6)
    # Random actions may be what was intended.
    np.testing.assert_allclose(changed.mean(0), levels * unlike, atol=4 * np.sqrt(0.25 / length))
    assert not changed[:, levels == 0].any()
    np.testing.assert_allclose(r.log_probs, policy.log_prob(r.observations, r.actions), rtol=1e-5)
    np.testing.assert_allclose(r.values, critic(policy.norm(r.observations))[..., 0], rtol=1e-4, atol=1e-5)
    # One step's successor is the next one's state, except where an episode ends.
    done = r.terminated | r.truncated
    gone_on = ~done[:-1]
    np.testing.assert_array_equal(r.observations[1:][gone_on], r.next_observations[:-1][gone_on])
    assert done.any(0).all()
    assert (np.abs(r.observations[1:][~gone_on]) <= 0.1).all()
    assert r.truncated[environment.horizon - steps - 1].any()
    assert (np.diff(np.flatnonzero(done[:, 0])) <= environment.horizon).all()


def test_random_actions_are_uniform_over_the_box():
    _, _, (rollout, executed) = acted_out(Drifting(), np.full(8, 0.5), 500)
    random = executed[(executed != rollout.actions).any(-1)]
    assert len(random) == pytest.approx(2000, abs=4 * np.sqrt(1000))
    low, high = np.array(BOX.low), np.array(BOX.high)
    assert ((random >= low) & (random <= high)).all()
    share = (random - low) / (high - low)
    np.testing.assert_allclose(share.mean(0), 0.5, atol=4 / np.sqrt(12 * len(random)))
    np.testing.assert_allclose((share**2).mean(0), 1 / 3, atol=4 * np.sqrt(4 / 45 / len(random)))


# -- the objective ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def classified():
    discriminator = airl_discriminator(2, BOX, state_only=True)
    network = discriminator.init(jax.random.key(0))
    network = eqx.tree_at(lambda net: net.absorbing, network, jnp.float32(0.7))
    rng = np.random.default_rng(1)

    def steps(n):
        return Transitions(
            *(jnp.asarray(rng.normal(size=(n, 2)), jnp.float32) for _ in range(3)),
            jnp.asarray(rng.random(n) < 0.2),
        )

    return discriminator, network, parts(Drifting())[0], steps(30), steps(30)


def test_weighted_steps_count_as_often_as_their_weight_says(classified):
    discriminator, network, policy, expert, generated = classified
    sampled = Transitions(*(x[:, None] for x in expert))
    copies = np.random.default_rng(2).integers(0, 4, 30)
    repeated = generated.rows(np.repeat(np.arange(30), copies))

    def loss(steps, importance):
        known = discriminator, network, policy, sampled, jnp.ones(1), steps
        return cross_entropy(*known, importance=importance)[0]

    none = loss(generated, jnp.zeros(30))
    weighted = loss(generated, jnp.asarray(copies, jnp.float32)) - none
    np.testing.assert_allclose(weighted, (loss(repeated, 1.0) - none) * copies.sum() / 30, rtol=1e-5)


# -- the learner ------------------------------------------------------------------------------------------

TRAINING = NoisyTraining(iterations=12, updates=16, batch=128, learning_rate=3e-3, replay=5)


@pytest.fixture(scope="module")
def agent():
    return ppo(cart_pole(100), n_envs=10, n_steps=128, learning_rate=1e-3, scale_rewards=True)


@pytest.fixture(scope="module")
def learner(agent):
    return noisy_airl(agent, airl_discriminator(4, ActionSpace(2), state_only=True), TRAINING)


@pytest.fixture(scope="module")
def demonstration():
    """Balance a pole by pushes towards its fall."""
    environment = cart_pole(100)
    step, observe = jax.jit(environment.step), jax.jit(environment.observe)
    observations, actions = [], []
    state = environment.reset(jax.random.key(5))
    for _ in range(300):
        x = np.asarray(observe(state))
        observations.append(x)
        actions.append(int(x @ [0.05, 0.1, 1, 0.3] > 0))
        state, _, ended = step(state, actions[-1])
        assert not ended
    return recording([np.array(observations)], [np.array(actions)], n_actions=2)


def same(one, other) -> bool:
    def bits(x) -> bytes:
        x = jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        return np.asarray(x).tobytes()

    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(bits(a) == bits(b) for a, b in leaves)


@pytest.fixture(scope="module")
def sessions(learner, demonstration):
    """Compute states and infos of three sessions."""
    kept = []
    run_sessions(
        learner, [demonstration] * 3, key=jax.random.key(0), on_session=lambda *both: kept.append(both)
    )
    return kept


def test_a_run_resumed_from_its_journal_equals_an_uninterrupted_one_to_the_bit(
    learner, demonstration, sessions, tmp_path
):
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        journal.commit(*sessions[0])
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        resumed = run_sessions(learner, [demonstration], journal=journal).state
    assert same(resumed, sessions[1][0])


def test_everything_is_carried_between_sessions(sessions):
    state, info = sessions[-1]
    assert int(state.session) == info.session == 3
    assert int(state.iterations) == 3 * 12
    assert int(state.pairs) == info.pairs == 900
    assert int(state.optimiser[0].count) == 3 * 12 * 16
    assert int(state.generator.updates) == 3 * 12
    assert info.environment_steps == 3 * 12 * 1280


def test_reports_are_plain_numbers_of_what_happened(demonstration, sessions):
    state, info = sessions[0]
    assert info.loss.shape == info.returns.shape == (12,)
    # Of 300 steps the last has no known successor.
    policy, observations = state.generator.policy, demonstration.observations[0, :-1]
    each = policy.log_prob(observations, demonstration.actions[0, :-1])
    assert info.log_likelihood == pytest.approx(float(each.mean()), rel=1e-5)
    assert np.isfinite(info.weights).all()


def test_the_pole_is_balanced_by_imitation_despite_the_noise(agent, sessions):
    assert sessions[0][1].returns[0] < 40
    learned = sessions[-1][0].generator.policy
    assert agent.evaluate(learned, jax.random.key(1), 10).returns.mean() > 80


def test_the_host_is_acted_in_as_well_and_the_discriminator_sees_actions_within_bounds(tmp_path):
    environment = Drifting()
    agent = ppo(environment, n_envs=2, n_steps=32, minibatch=32)
    agent = agent._replace(improve=lambda state, rollout, rewards: state)  # which is not what is tested
    discriminator = airl_discriminator(2, BOX, state_only=True)

    def guarded(network, z, a, following, terminated):
        inside = jnp.all((a >= jnp.array(BOX.low)) & (a <= jnp.array(BOX.high)), -1)
        return jnp.where(inside, discriminator.score(network, z, a, following, terminated), jnp.nan)

    training = NoisyTraining(iterations=2, updates=2, replay=1, levels=(0.0, 0.3), action="executed")
    learner = noisy_airl(agent, discriminator._replace(score=guarded), training)
    rng = np.random.default_rng(0)
    demonstration = recording([rng.normal(size=(9, 2))], [rng.uniform(-1, 0.5, (9, 2))])
    one, info = learner.update(learner.init(jax.random.key(0)), demonstration)
    other, _ = learner.update(learner.init(jax.random.key(0)), demonstration)
    assert same(one, other)
    assert np.isfinite(info.returns).all()
    assert np.isfinite(info.loss).all()
    with Journal.open(tmp_path / "host.journal", learner) as journal:
        run_sessions(learner, [demonstration], key=jax.random.key(0), journal=journal)
        assert same(journal.state, one)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"iterations": 0}, "iterations"),
        ({"action": "both"}, "intended, executed"),
        ({"levels": (0.0, 1.0)}, "noise level 1"),
        ({"levels": (0.0, 0.1, 0.2)}, "3 noise levels"),
    ],
)
def test_training_that_cannot_be_is_refused_by_name(agent, wrong, named):
    with pytest.raises(ValueError, match=named):
        noisy_airl(agent, airl_discriminator(4, ActionSpace(2)), TRAINING._replace(**wrong))


def test_half_of_the_released_environments_are_without_noise():
    assert len(LEVELS) == 10
    assert np.mean(np.array(LEVELS) == 0) == 0.5
