import operator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference import fleet, me_i2rl, run_sessions, solve_dual
from i2rl.inference.completion.smoothing import evidence_of
from i2rl.inference.learners.darko import (
    darko_i2rl,
    ending_at,
    feature_margin,
    goal_sessions,
    stopping_places,
    with_end,
)
from i2rl.inference.programs.constraints import FeatureTarget
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    concatenate,
    reward_of,
    soft_plan,
)
from i2rl.models.observation.demonstration import SEEN, UNKNOWN
from i2rl.models.observation.evidence import Sensor
from i2rl.models.process.mdp import Labels
from i2rl.models.process.units import with_scaled_features


@jax.jit
def plan_of(mdp, weights):
    return soft_plan(mdp, reward_of(mdp, weights))


@jax.jit
def margin(mdp, weights, session):
    evidence = evidence_of(mdp, Sensor(), session)
    return feature_margin(mdp, weights, evidence, session.kind == SEEN)


@pytest.fixture(scope="module")
def world(random_mdp):
    # Steps are of scaled weights: here they are the weights themselves.
    mdp = random_mdp(5, n_states=6, n_actions=3, n_successors=2, n_features=3, masked=True)
    return with_scaled_features(mdp)


def sampled(mdp, weights, n, length, seed=0):
    """Trajectories of the soft policy of some weights."""
    rng = np.random.default_rng(seed)
    policy = np.asarray(plan_of(mdp, jnp.asarray(weights)).policy)
    successors, chances = np.asarray(mdp.successors), np.asarray(mdp.probabilities)

    def draw(probabilities):
        below = np.cumsum(probabilities, axis=-1) < rng.random((n, 1))
        return np.minimum(below.sum(-1), probabilities.shape[-1] - 1)

    here = draw(np.broadcast_to(mdp.initial, (n, mdp.n_states)))
    states, actions = [], []
    for _ in range(length):
        states.append(here)
        actions.append(draw(policy[here]))
        here = successors[here, actions[-1], draw(chances[here, actions[-1]])]
    return Demonstration.from_pairs(np.stack(states, 1), np.stack(actions, 1))


def test_the_margin_is_the_gradient_of_me_i2rls_program_for_the_session_alone(world):
    weights = jnp.array([0.3, -1.0, 0.7])
    session = sampled(world, [1.0, -1.0, 0.0], 2, 4)
    found = margin(world, weights, session)

    def dual(w):
        values = plan_of(world, jnp.asarray(w)).values
        return float(found.statistic.start @ values - w @ np.asarray(found.statistic.features))

    steps = 1e-5 * np.eye(3)
    slope = [(dual(np.asarray(weights) + d) - dual(np.asarray(weights) - d)) / 2e-5 for d in steps]
    assert np.allclose(found.margin, slope, atol=1e-6)
    assert np.linalg.norm(found.margin) > 0.1

    # ME-I2RL with its statistic emptied: |X| = 0 and phi_hat = 0 leave the session alone (chapter 4).
    forgetful = me_i2rl(world, statistic="features", slack=0.0)
    state = forgetful.init(jax.random.key(0))._replace(weights=weights)
    assert float(state.statistic.size) == 0
    _, info = forgetful.update(state, session)
    assert info.gradient == pytest.approx(float(jnp.linalg.norm(found.margin)))
    learning_rate = 0.01
    learner = darko_i2rl(world, learning_rate=learning_rate)
    moved, _ = learner.update(learner.init(jax.random.key(0))._replace(weights=weights), session)
    assert np.allclose((weights - moved.weights) / learning_rate, found.margin, atol=1e-9)


def test_one_session_learned_to_the_end_solves_me_i2rls_program(random_mdp):
    mdp = ending_at(random_mdp(2, n_states=5, n_actions=3, n_features=2), np.arange(5) == 4)
    session = sampled(mdp, [-0.5, 0.4], 32, 64)
    session = session.select(np.flatnonzero(session.state[:, -1] == 5)[:16])
    assert session.n_trajectories == 16  # these have ended: nothing is left to fill in
    target = margin(mdp, jnp.zeros(2), session).statistic
    solution = solve_dual(mdp, FeatureTarget(target.features, target.start))
    learner = darko_i2rl(mdp, learning_rate=0.5, decay=0.0, steps=800)
    state, info = learner.update(learner.init(jax.random.key(0)), session)
    assert np.allclose(state.weights, solution.weights, atol=1e-6)
    assert float(jnp.linalg.norm(margin(mdp, state.weights, session).margin)) < 1e-6
    assert info.log_likelihood == pytest.approx(-float(solution.objective))


def test_nothing_of_earlier_sessions_is_kept_but_the_weights(world):
    first, second = (sampled(world, [1.0, -1.0, 0.0], 2, 4, seed) for seed in (0, 1))
    learner = darko_i2rl(world, learning_rate=0.1, decay=0.0)
    state, _ = learner.update(learner.init(jax.random.key(0)), first)
    after, _ = learner.update(state, second)
    afresh = learner.init(jax.random.key(9))._replace(weights=state.weights)
    assert np.allclose(learner.update(afresh, second)[0].weights, after.weights, atol=1e-9)
    assert jax.tree.leaves(after.statistic) == []


def test_many_sessions_find_the_weights(world):
    true = np.array([1.0, -1.0, 0.5])
    sessions = sampled(world, true, 4000, 4)
    learner = darko_i2rl(world, learning_rate=1.0)
    state = run_sessions(learner, sessions.sessions(2), key=jax.random.key(0)).state
    policy, expert = (np.asarray(plan_of(world, jnp.asarray(w)).policy) for w in (state.weights, true))
    start = learner.init(jax.random.key(0)).weights
    first = np.asarray(plan_of(world, start).policy)
    assert np.abs(policy - expert).max() < 0.05 < np.abs(first - expert).max()


def test_rate_and_radius_act_as_named(world):
    session = sampled(world, [1.0, -1.0, 0.0], 2, 4)
    learner = darko_i2rl(world, learning_rate=0.2)
    start = learner.init(jax.random.key(0))
    later = start._replace(session=jnp.asarray(3))
    early, late = (learner.update(s, session)[0].weights - start.weights for s in (start, later))
    assert np.allclose(early, 2 * late, atol=1e-9)  # the fourth session's rate is half the first's
    bounded, _ = darko_i2rl(world, learning_rate=50.0, radius=0.7).update(start, session)
    free, _ = darko_i2rl(world, learning_rate=50.0).update(start, session)
    assert float(jnp.linalg.norm(free.weights)) > 0.7
    assert np.allclose(bounded.weights, 0.7 * free.weights / jnp.linalg.norm(free.weights))


def impossible_pair(mdp):
    """Make an unavailable action of a state, in arrays as large as the other sessions'."""
    s, a = np.argwhere(~np.asarray(mdp.available))[0]
    return Demonstration.from_pairs([[s]], [[a]]).padded(2, 4)


def test_a_fleet_learns_what_its_members_would_and_nothing_from_the_impossible(world):
    sessions = [sampled(world, [1.0, -1.0, 0.0], 2, 4, seed) for seed in range(2)]
    learner = darko_i2rl(world, learning_rate=0.2)
    many = fleet(learner)
    states = many.init(jax.random.key(4), 3)
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *sessions, impossible_pair(world))
    after, infos = many.update(states, stacked)
    for i, session in enumerate(sessions):
        state, info = learner.update(jax.tree.map(operator.itemgetter(i), states), session)
        assert np.allclose(after.weights[i], state.weights, atol=1e-9)
        assert infos.log_likelihood[i] == pytest.approx(info.log_likelihood)
    assert after.session.tolist() == [1, 1, 0]
    assert np.array_equal(after.weights[2], states.weights[2])
    assert np.isneginf(infos.demonstration_log_likelihood[2])


def test_an_impossible_observation_is_refused(world):
    learner = darko_i2rl(world)
    state = learner.init(jax.random.key(0))
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0"):
        learner.update(state, impossible_pair(world))
    with pytest.raises(DemonstrationError, match="step 0"):
        learner.update(state, Demonstration.from_steps([["hidden"]], world).padded(2, 4))
    with pytest.raises(DemonstrationError, match="at least one trajectory"):
        learner.update(state, Demonstration.from_steps([[]], world))


# -- goals --------------------------------------------------------------------------------------------


def test_a_stream_is_cut_where_a_goal_is_reached():
    states = np.array([[3, 0, 1], [1, 2, 1], [4, 2, 0]])
    actions = np.arange(9).reshape(3, 3)
    stream = Demonstration.from_pairs(states, actions)
    goals = np.isin(np.arange(5), [1, 4])
    sessions = list(goal_sessions(stream.sessions(), goals))
    parts = [
        [(int(s), int(a)) for s, a in zip(d.state[0], d.action[0], strict=True) if s != UNKNOWN]
        for d in sessions
    ]
    # Waiting in state 1 is no second arrival; what follows the last goal, (4, 6) on, is no session yet.
    assert parts == [[(3, 0), (0, 1)], [(1, 2), (1, 3), (2, 4)], [(1, 5)]]
    assert [d.kind.shape for d in sessions] == [(1, 2), (1, 4), (1, 1)]
    whole = list(goal_sessions([concatenate([stream])], goals))
    assert all(np.array_equal(a.codes, b.codes) for a, b in zip(sessions, whole, strict=True))


def test_a_goal_that_was_not_seen_is_not_reached(world):
    steps = [(0, 0), "hidden", None, (2, 1), (1, 0), (3, 0), (1, 2)]
    stream = [Demonstration.from_steps([steps], world)]
    sessions = list(goal_sessions(stream, np.arange(6) == 1))
    assert [int(d.lengths[0]) for d in sessions] == [4, 2]
    assert list(goal_sessions(stream, np.arange(6) == 4)) == []


def test_stops_are_found_where_somebody_stayed(world):
    pieces = [
        Demonstration.from_pairs([[0, 2, 2]], [[0, 0, 0]]),
        Demonstration.from_steps([[(2, 0), (3, 0), (3, 0), None, (3, 1)]], world),
    ]
    assert np.flatnonzero(stopping_places(pieces, 6, 3)).tolist() == [2]
    assert np.flatnonzero(stopping_places(pieces, 6, 2)).tolist() == [2, 3]
    with pytest.raises(ValueError, match="at least two steps"):
        stopping_places(pieces, 6, 1)


def test_at_an_ending_goal_nothing_follows(world, dense_transitions):
    goals = np.isin(np.arange(6), [2, 4])
    ended = ending_at(world, goals)
    before, after = dense_transitions(world), dense_transitions(ended)
    staying = np.zeros((6, 3, 6))
    staying[np.arange(6), :, np.arange(6)] = 1
    kept = before * (~goals | (staying > 0))
    assert np.allclose(after[:6, :, :6], kept)
    assert np.allclose(after[:6, :, 6], (before - kept).sum(-1))
    weights = jnp.array([1.0, 2.0, -0.5])
    plan = plan_of(ended, weights)
    assert plan.values[6] == pytest.approx(0)
    # Independent: soft value iteration by hand, goals worth nothing on arrival.
    values = np.zeros(6)
    for _ in range(500):
        q = np.asarray(reward_of(world, weights)) + 0.9 * kept @ values
        values = np.log((np.exp(q) * np.asarray(world.available)).sum(1))
    assert np.allclose(plan.values[:6], values)


def test_an_episodes_end_is_its_last_step(world):
    goals = np.arange(6) == 2
    ended = ending_at(world, goals)
    ragged = concatenate(
        [Demonstration.from_pairs([[0, 1]], [[1, 2]]), Demonstration.from_pairs([[3]], [[0]])]
    )
    episode = with_end(ragged, 6)
    assert episode.state.tolist() == [[0, 1, 6], [3, 6, UNKNOWN]]
    assert episode.lengths.tolist() == [3, 2]
    possible = ended.transition_probability(6) > 0
    s, a = np.argwhere(np.asarray(possible[:6]))[0]
    one = with_end(Demonstration.from_pairs([[s]], [[a]]), 6)
    statistic = margin(ended, jnp.ones(3), one).statistic
    assert np.allclose(statistic.features, world.features[s, a])


def test_what_makes_no_sense_is_refused(world, random_mdp):
    for options in ({"learning_rate": 0.0}, {"radius": 0.0}, {"decay": -1.0}, {"steps": 0}):
        with pytest.raises(ValueError, match=r"must|at least"):
            darko_i2rl(world, **options)
    with pytest.raises(ValueError, match="discount 1"):
        darko_i2rl(random_mdp(0, discount=1.0))
    with pytest.raises(ValueError, match=r"boolean array \[6\]"):
        ending_at(world, np.zeros(6, bool))
    with pytest.raises(ValueError, match="boolean array"):
        list(goal_sessions([], np.arange(6)))


def test_an_end_among_states_of_that_name_gets_another(world):
    goals = np.arange(6) == 2
    for names, added in (
        (("a", "b", "c", "d", "e", "f"), "end"),
        (("end", "b", "c", "end 2", "e", "f"), "end 3"),
    ):
        named = replace(world, labels=Labels(names, None, None))
        assert ending_at(named, goals).state_names == (*names, added)
    assert ending_at(world, goals).state_names[-1] == "s6"
