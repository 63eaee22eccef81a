"""Adversarial learners with exact expert and generator: objective, optimum, sensors, sessions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.adversarial.tabular.discriminator import (
    Sides,
    cross_entropy,
    log_probability_of_mean,
    mean_of_log_probability,
    proximal_plan,
    tabular_airl,
)
from i2rl.inference.adversarial.tabular.learners import (
    airl_tabular,
    gail_tabular,
    gibbs_airl_tabular,
    robust_airl_tabular,
    robust_airl_with_learned_sensor,
    robust_gail_tabular,
)
from i2rl.inference.adversarial.tabular.training import TabularAdversarialState, TabularTraining
from i2rl.inference.completion.smoothing import evidence_of
from i2rl.inference.completion.transitions import (
    TransitionStatistic,
    discounted_transitions,
    exact_transitions,
    summarised,
    visited_transitions,
)
from i2rl.inference.journal.journal import Journal
from i2rl.inference.sessions.learner import Learner
from i2rl.inference.sessions.running import run_sessions
from i2rl.models import Demonstration, DemonstrationError, Sensor, TabularMDP, Visibility, simulate, soft_plan
from i2rl.models.observation.confusions import Confusions
from i2rl.models.observation.demonstration import HIDDEN
from i2rl.models.observation.evidence import observe

LENGTH = 5
NOISE = (0.3, 0.1)


@pytest.fixture(scope="module")
def mdp(random_mdp) -> TabularMDP:
    return random_mdp(2, n_states=5, discount=0.9)


@pytest.fixture(scope="module")
def expert(mdp: TabularMDP) -> np.ndarray:
    """Compute a soft expert's log-policy."""
    reward = jnp.asarray(np.random.default_rng(1).normal(size=mdp.available.shape) * 1.5)
    return np.asarray(soft_plan(mdp, reward).log_policy)


@pytest.fixture(scope="module")
def noise(mdp: TabularMDP) -> Confusions:
    return Confusions.of_actions(mdp.n_states, [(0, 1), (2, 0)], np.array(NOISE), mdp.n_actions)


@pytest.fixture(scope="module")
def sensor(mdp: TabularMDP, noise: Confusions) -> Sensor:
    return noise * Visibility(np.arange(mdp.n_states) != 1)


def _watched(mdp, expert, sensor, n: int, seed: int = 0) -> tuple[Demonstration, Demonstration]:
    """Simulate a behaviour and its observation."""

    def one(key):
        act, look = jax.random.split(key)
        states, actions = simulate(act, mdp, jnp.asarray(expert), LENGTH)
        return states, actions, observe(look, sensor, states, actions)

    s, a, codes = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), n))
    return Demonstration.from_pairs(np.asarray(s), np.asarray(a)), Demonstration.from_codes(np.asarray(codes))


@pytest.fixture(scope="module")
def watched(mdp, expert, sensor) -> tuple[Demonstration, Demonstration]:
    return _watched(mdp, expert, sensor, 256)


@pytest.fixture(scope="module")
def learned(mdp: TabularMDP, noise: Confusions) -> Learner:
    """Learns reward, policy and sensor behind a view: every part there is."""
    assumed = Confusions(noise.observations, np.array([0.15, 0.15]))
    visibility = Visibility(np.arange(mdp.n_states) != 1)
    return robust_airl_with_learned_sensor(
        mdp, assumed, visibility=visibility, iterations=40, learning_rate=1e-2, horizon=LENGTH
    )


# -- the objective ------------------------------------------------------------------------------------


@pytest.mark.parametrize("average", [mean_of_log_probability, log_probability_of_mean])
def test_gradient_of_the_objective_is_that_of_finite_differences(mdp, expert, sensor, watched, average):
    discriminator = tabular_airl(mdp, jnp.eye(mdp.n_states), reward=(4,), potential=(3,))
    network = jax.tree.map(lambda x: x.astype(float), discriminator.init(jax.random.key(3)))
    completed = exact_transitions(
        mdp, expert, evidence_of(mdp, sensor, watched[1].select(slice(0, 4))), LENGTH
    )
    summary = summarised(completed)
    sides = Sides(summary, completed, visited_transitions(mdp, jnp.asarray(expert), summary.starts))
    leaves, structure = jax.tree.flatten(network)

    @jax.jit
    def loss(leaves):
        net = jax.tree.unflatten(structure, leaves)
        return cross_entropy(discriminator, net, jnp.asarray(expert), mdp.successors, sides, average)[0]

    slope = jax.jit(jax.grad(loss))(leaves)
    rng = np.random.default_rng(0)
    direction = [jnp.asarray(rng.normal(size=x.shape)) for x in leaves]
    # The running normaliser's statistics are no parameters.
    fixed = [name for name, leaf in enumerate(leaves) if not np.asarray(slope[name]).any()]
    direction = [d * (i not in fixed) for i, d in enumerate(direction)]
    h = 1e-6
    ahead, behind = (
        loss([x + sign * h * d for x, d in zip(leaves, direction, strict=True)]) for sign in (1, -1)
    )
    along = sum(float(jnp.sum(g * d)) for g, d in zip(slope, direction, strict=True))
    assert abs(along) > 1e-3
    assert along == pytest.approx(float(ahead - behind) / (2 * h), rel=1e-6)


def test_proximal_plan_is_the_best_against_its_own_objective(mdp, expert):
    # The best of a linear reward less a divergence: no other policy does better, in any state.
    reward = jnp.asarray(np.random.default_rng(4).normal(size=mdp.available.shape))
    entropy, step = 0.3, 0.7

    def worth(log_policy):
        policy = np.exp(log_policy)
        gain = step * (np.asarray(reward) - entropy * log_policy) - (log_policy - expert)
        moves = np.zeros((mdp.n_states, mdp.n_states))
        weight = policy[..., None] * np.asarray(mdp.probabilities)
        np.add.at(moves, (np.arange(mdp.n_states)[:, None, None], np.asarray(mdp.successors)), weight)
        return np.linalg.solve(np.eye(mdp.n_states) - 0.9 * moves, (policy * gain).sum(1))

    log_policy, _ = proximal_plan(mdp, reward, jnp.asarray(expert), jnp.zeros(mdp.n_states), entropy, step)
    best = worth(np.asarray(log_policy))
    rng = np.random.default_rng(5)
    for _ in range(20):
        other = np.asarray(log_policy) + rng.normal(size=log_policy.shape) * 0.1
        other -= np.logaddexp.reduce(other, axis=1, keepdims=True)
        assert (worth(other) <= best + 1e-9).all()
    again, _ = proximal_plan(mdp, reward, jnp.asarray(expert), jnp.zeros(mdp.n_states), 0.5, np.inf)
    np.testing.assert_allclose(again, soft_plan(mdp, reward / 0.5).log_policy, atol=1e-9)


# -- the optimum --------------------------------------------------------------------------------------


def _as_if_watched_for_ever(learner: Learner, mdp: TabularMDP, expert: np.ndarray) -> TabularAdversarialState:
    """Initialise the learner's state with the expert's exact occupancy."""
    state = learner.init(jax.random.key(0))
    weights = discounted_transitions(mdp, jnp.asarray(expert), state.statistic.starts)
    return state._replace(statistic=TransitionStatistic(jnp.array(1e12), weights, state.statistic.starts))


def _distance(log_policy, expert) -> float:
    """Largest total variation of the actions in a state."""
    return float(0.5 * np.abs(np.exp(log_policy) - np.exp(expert)).sum(1).max())


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (robust_airl_tabular, {"learning_rate": 1e-2, "network": {"potential": (16,)}}),
        (
            robust_gail_tabular,
            {"learning_rate": 3e-2, "step": 0.3, "entropy": 0.0, "network": {"hidden": (16,)}},
        ),
    ],
)
def test_knowing_what_the_expert_does_its_policy_is_recovered(mdp, expert, watched, make, options):
    learner = make(mdp, Sensor(), iterations=300, occupancy="discounted", horizon=LENGTH, **options)
    state = _as_if_watched_for_ever(learner, mdp, expert)
    begun = _distance(state.log_policy, expert)
    for _ in range(4):
        state, report = learner.update(state, watched[0].select([0]))
    assert _distance(state.log_policy, expert) < 0.04 < begun / 5
    # The two are indistinguishable.
    assert report.loss[-1] == pytest.approx(np.log(2), abs=0.01)


# -- imperfections ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sessions_of(mdp, watched):
    """Policies after four sessions of 64 trajectories."""

    def learn(learner: Learner, reported: bool = True) -> TabularAdversarialState:
        stream = watched[int(reported)].sessions(64)
        return run_sessions(learner, stream, key=jax.random.key(1)).state

    return learn


@pytest.fixture(scope="module")
def sensor_learned(learned: Learner, sessions_of) -> TabularAdversarialState:
    return sessions_of(learned)


def test_hidden_and_wrong_reports_cost_little_where_they_are_understood(
    mdp, expert, sensor, watched, sessions_of, sensor_learned
):
    options = {"iterations": 40, "learning_rate": 1e-2, "horizon": LENGTH}
    known = sessions_of(robust_airl_tabular(mdp, sensor, **options))
    at_face_value = airl_tabular(mdp, **options)
    taken = sessions_of(at_face_value)

    def mean_distance(state):
        return float(0.5 * np.abs(np.exp(state.log_policy) - np.exp(expert)).sum(1).mean())

    assert mean_distance(known) < 0.6 * mean_distance(taken)
    assert mean_distance(sensor_learned) < 0.6 * mean_distance(taken)
    # A wholly hidden session carries no evidence for learners without a model of occlusion.
    blank = watched[1].select(slice(0, 64))
    blank = replace(blank, kind=np.where(blank.kind > 0, HIDDEN, blank.kind), state=0 * blank.state - 1)
    fresh = at_face_value.init(jax.random.key(0))
    after, _ = at_face_value.update(fresh, blank)
    np.testing.assert_array_equal(after.weights, fresh.weights)
    np.testing.assert_array_equal(after.log_policy, fresh.log_policy)
    assert int(after.session) == 1


def test_how_often_reports_err_is_learned(noise, watched, sensor_learned):
    truth, seen = watched
    there = seen.state >= 0
    counts = sensor_learned.confusions
    for m, (action, report) in enumerate([(0, 1), (2, 0)]):
        able = there & (truth.action == action)
        happened = (able & (seen.action == report)).sum()
        assert float(counts.possible[m]) == pytest.approx(able.sum(), rel=0.25)
        share = float(counts.happened[m] / counts.possible[m])
        assert share == pytest.approx(happened / able.sum(), abs=0.06)


def test_a_session_with_sampled_truths_gives_the_state_that_the_next_one_takes(mdp, noise, watched):
    # Traced, not run: the sampler itself is tested with the transitions.
    learner = gibbs_airl_tabular(mdp, Sensor(None, noise.noise), draws=3, burn_in=1, horizon=LENGTH)
    state = learner.init(jax.random.key(0))
    after, report = jax.eval_shape(learner.session, state, watched[1].select(slice(0, 4)))
    same = jax.tree.map(lambda x, y: (x.shape, x.dtype) == (y.shape, y.dtype), state, after)
    assert all(jax.tree.leaves(same))
    assert report.loss.shape == (TabularTraining().iterations,)


# -- sessions -----------------------------------------------------------------------------------------


def test_a_journalled_learner_goes_on_to_the_bit(learned: Learner, watched, tmp_path: Path):
    stream = list(watched[1].sessions(64))
    whole = run_sessions(learned, stream, key=jax.random.key(5)).state
    with Journal.open(tmp_path / "a.db", learned) as journal:
        run_sessions(learned, stream[:2], key=jax.random.key(5), journal=journal)
    with Journal.open(tmp_path / "a.db", learned) as journal:
        resumed = run_sessions(learned, stream[2:], journal=journal).state
    for ours, theirs in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        if jax.dtypes.issubdtype(ours.dtype, jax.dtypes.prng_key):
            ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
        assert np.asarray(ours).tobytes() == np.asarray(theirs).tobytes()


def test_reports_that_cannot_be_leave_the_learner_as_it_was(mdp, learned: Learner, watched):
    seen = watched[1].select(slice(0, 64))
    state = learned.init(jax.random.key(0))
    i, t = np.argwhere(np.asarray(seen.state) == 0)[0]
    impossible = replace(seen, state=seen.state.copy())
    impossible.state[i, t] = 1  # never in view
    with pytest.raises(DemonstrationError, match=f"trajectory {i}, step {t}: impossible"):
        learned.update(state, impossible)
    impossible.state[i, t] = 9
    with pytest.raises(DemonstrationError, match=f"trajectory {i}, step {t}: state 9 is out of range"):
        learned.update(state, impossible)
    with pytest.raises(DemonstrationError, match="horizon"):
        learned.update(state, replace(seen.padded(64, 8), kind=np.ones((64, 8), np.int8)))
    with pytest.raises(DemonstrationError, match="at least one trajectory"):
        learned.update(state, replace(seen, kind=np.zeros_like(seen.kind)))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"iterations": 0}, "iterations must be at least 1"),
        ({"step": 0.0}, "step must be positive"),
        ({"entropy": 0.0}, "entropy"),
        ({"forgetting": 2.0}, "exponent"),
        ({"occupancy": "seen"}, "occupancy is one of visited, discounted"),
        ({"average": "logits"}, "forgetting must be 0"),
        ({"speed": 1}, "no option 'speed'"),
        ({"features": np.ones((2, 2))}, r"\[S, d\] = \[5, d\]"),
        ({"features": np.array([[0.0], [1], [np.nan], [2], [3]])}, "feature 0 of state s2 is nan"),
    ],
)
def test_options_that_cannot_be_are_named(mdp, options, says):
    with pytest.raises(ValueError, match=says):
        airl_tabular(mdp, **options)


def test_what_cannot_be_combined_is_said(mdp, noise, sensor):
    with pytest.raises(ValueError, match="step must be finite"):
        gail_tabular(mdp, step=np.inf)
    with pytest.raises(ValueError, match="learned, not given"):
        robust_airl_with_learned_sensor(mdp, noise, visibility=sensor)
    with pytest.raises(ValueError, match="confusion 1 is 0"):
        robust_airl_with_learned_sensor(mdp, Confusions(noise.observations, np.array([0.1, 0.0])))
    with pytest.raises(ValueError, match="has 5 states"):
        robust_airl_tabular(mdp, Visibility(np.ones(4, bool)))
