import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.journal.journal import Journal
from i2rl.inference.learners.jin import (
    jin_i2rl,
    jin_i2rl_with_features,
    reward_correction,
    with_state_features,
)
from i2rl.inference.sessions.fleets import fleet
from i2rl.inference.sessions.running import run_sessions
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    concatenate,
    deterministic_policy,
    hard_plan,
    policy_values,
    reward_of,
)
from i2rl.models.process.planning import action_values


@pytest.fixture(scope="module")
def world(random_mdp):
    return random_mdp(4, n_states=6, n_actions=3, n_successors=2, n_features=2)


def walk(mdp, policy, seed, length):
    """One trajectory under a deterministic policy."""
    rng = np.random.default_rng(seed)
    states, actions = [int(rng.integers(mdp.n_states))], []
    for _ in range(length):
        actions.append(int(policy[states[-1]]))
        pair = states[-1], actions[-1]
        p = np.asarray(mdp.probabilities[pair])
        states.append(int(rng.choice(np.asarray(mdp.successors[pair]), p=p / p.sum())))
    return Demonstration.from_pairs([states[:-1]], [actions])


@jax.jit
def predictions(mdp, weights):
    return deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)


@jax.jit
def values_of(mdp, policy, weights):
    reward = reward_of(mdp, weights)
    return action_values(mdp, reward, policy_values(mdp, policy, reward))


def greedy(mdp, weights):
    return np.argmax(predictions(mdp, jnp.asarray(weights)), axis=1)


def test_weights_on_state_features_are_a_reward_table(world):
    table = np.arange(6.0)
    reward = reward_of(with_state_features(world), jnp.asarray(table))
    assert np.array_equal(reward, np.repeat(table[:, None], 3, axis=1))
    assert with_state_features(world).feature_names == world.state_names
    assert with_state_features(world).fingerprint() != world.fingerprint()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("on_states", [True, False])
def test_the_correction_is_the_gradient_of_the_difference_of_values(world, on_states, seed):
    mdp = with_state_features(world) if on_states else world
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=mdp.n_features)
    state, action = int(rng.integers(6)), int(rng.integers(3))
    policy = predictions(mdp, jnp.asarray(weights))
    predicted = int(np.argmax(policy[state]))

    def advantage(w):
        q = values_of(mdp, policy, jnp.asarray(w))
        return float(q[state, action] - q[state, predicted])

    found = jax.jit(reward_correction)(mdp, jnp.asarray(weights), jnp.asarray(state), jnp.asarray(action))
    steps = 1e-4 * np.eye(mdp.n_features)
    slope = [(advantage(weights + d) - advantage(weights - d)) / 2e-4 for d in steps]
    assert np.allclose(found.direction, slope, atol=1e-7)
    # Values are linear in the reward, so the difference itself is the product with it: never positive.
    assert found.direction @ weights == pytest.approx(advantage(weights), abs=1e-9)
    assert advantage(weights) <= 1e-9
    assert bool(found.mistaken) == (action != predicted)
    if on_states:
        assert np.sum(found.direction) == pytest.approx(0, abs=1e-9)


def test_a_demonstration_is_learned_pair_by_pair(world):
    demonstration = walk(world, np.array([2, 1, 0, 2, 1, 1]), 0, 7)
    learner = jin_i2rl(world, learning_rate=0.3)
    at_once = run_sessions(learner, [demonstration], key=jax.random.key(0))
    one_by_one = run_sessions(learner, demonstration.fragments(1).sessions(), key=jax.random.key(0))
    assert int(one_by_one.state.session) == 7
    assert np.allclose(at_once.state.weights, one_by_one.state.weights, atol=1e-12)
    assert at_once.infos[0].iterations == 7
    mistakes = [r.solver_iterations for r in one_by_one.infos]
    assert at_once.infos[0].solver_iterations == sum(mistakes) > 0
    # A pair that was predicted leaves the reward as it is, and only such a pair does.
    before = np.full(6, 1 / np.sqrt(6))
    for info, mistaken in zip(one_by_one.infos, mistakes, strict=True):
        assert np.array_equal(info.weights, before) == (mistaken == 0)
        assert (info.gradient == 0) == (mistaken == 0)
        before = info.weights


def test_the_learning_rate_only_scales_a_reward_table(world):
    demonstration = walk(world, np.array([2, 1, 0, 2, 1, 1]), 1, 30)
    runs = [
        run_sessions(
            jin_i2rl(world, learning_rate=learning_rate),
            demonstration.fragments(5).sessions(),
            key=jax.random.key(0),
        )
        for learning_rate in (0.25, 4.0)
    ]
    for slow, fast in zip(*(run.infos for run in runs), strict=True):
        assert np.allclose((slow.weights - 6**-0.5) * 16, fast.weights - 6**-0.5, atol=1e-9)
        assert slow.solver_iterations == fast.solver_iterations


def test_mistakes_are_bounded_where_the_expert_makes_every_correction_better(random_mdp):
    # Far-sighted corrections follow the learner's policy, not the expert's, so that they need not favour the
    # expert's reward; with a short horizon they do, and the perceptron's bound (Novikoff) holds.
    mdp = with_state_features(random_mdp(7, n_states=8, n_actions=2, n_successors=2, discount=0.05))
    true = np.random.default_rng(0).normal(size=8)
    expert = greedy(mdp, true)
    learner = jin_i2rl(mdp)
    state, steps = learner.init(jax.random.key(0)), []
    for pair in walk(mdp, expert, 0, 400).fragments(1).sessions():
        before = state.weights
        state, info = learner.update(state, pair)
        if info.solver_iterations:
            steps.append(np.asarray(state.weights - before))
    margins = np.array(steps) @ true
    assert margins.min() > 0
    longest = np.max(np.sum(np.square(steps), axis=1))
    assert 0 < len(steps) <= longest * np.sum(true**2) / margins.min() ** 2
    assert np.array_equal(greedy(mdp, state.weights), expert)


def test_what_is_not_seen_in_full_is_passed_over(world):
    seen = [(0, 1), (2, 2), (3, 0)]
    gaps = [seen[0], None, seen[1], {"s": 1}, "hidden", seen[2]]
    learner = jin_i2rl(world)
    with_gaps, without = (
        learner.update(learner.init(jax.random.key(0)), Demonstration.from_steps([steps], world))
        for steps in (gaps, seen)
    )
    assert np.array_equal(with_gaps[0].weights, without[0].weights)
    assert with_gaps[1].iterations == 3
    with pytest.raises(DemonstrationError, match="seen in full"):
        learner.update(learner.init(jax.random.key(0)), Demonstration.from_steps([["hidden"]], world))


def test_an_action_that_does_not_exist_is_refused(random_mdp):
    mdp = random_mdp(0, masked=True)
    s, a = np.argwhere(~np.asarray(mdp.available))[0]
    t = int(np.flatnonzero(mdp.available[0])[0])
    impossible = Demonstration.from_pairs([[0, s]], [[t, a]])
    learner = jin_i2rl(mdp)
    with pytest.raises(DemonstrationError, match=f"trajectory 0, step 1: state s{s} has no action a{a}"):
        learner.update(learner.init(jax.random.key(0)), impossible)
    with pytest.raises(DemonstrationError, match="step 0: state 9 is out of range"):
        learner.update(learner.init(jax.random.key(0)), Demonstration.from_pairs([[9]], [[0]]))
    many = fleet(learner)
    stacked = jax.tree.map(lambda x: np.asarray(x)[None], impossible)
    state, info = many.update(many.init(jax.random.key(0), 1), stacked)
    assert state.session[0] == 0
    assert np.isneginf(info.demonstration_log_likelihood[0])
    assert np.array_equal(state.weights[0], learner.init(jax.random.key(0)).weights)


def test_a_fleet_learns_what_its_members_would(world):
    demonstrations = [walk(world, np.array([2, 1, 0, 2, 1, 1]), seed, 4) for seed in range(3)]
    learner = jin_i2rl_with_features(world, learning_rate=0.1)
    many = fleet(learner)
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *demonstrations)
    states, infos = many.update(many.init(jax.random.key(0), 3), stacked)
    for i, demonstration in enumerate(demonstrations):
        state, info = learner.update(learner.init(jax.random.key(1)), demonstration)
        assert np.allclose(states.weights[i], state.weights, atol=1e-12)
        assert infos.solver_iterations[i] == info.solver_iterations


def test_a_journal_resumes_it_to_the_bit(world, tmp_path):
    sessions = list(concatenate([walk(world, np.array([2, 1, 0, 2, 1, 1]), 3, 12)]).fragments(3).sessions())
    learner = jin_i2rl(world)
    whole = run_sessions(learner, sessions, key=jax.random.key(0))
    for part in (sessions[:2], sessions):
        with Journal.open(tmp_path / "journal.db", learner) as journal:
            resumed = run_sessions(learner, part, key=jax.random.key(0), journal=journal)
    assert np.array_equal(resumed.state.weights, whole.state.weights)
    assert int(resumed.state.session) == 4


def test_what_makes_no_sense_is_refused(world, random_mdp):
    with pytest.raises(ValueError, match="learning rate must be a positive number, got 0"):
        jin_i2rl(world, learning_rate=0)
    with pytest.raises(ValueError, match="discount 1"):
        jin_i2rl(random_mdp(0, discount=1.0))
