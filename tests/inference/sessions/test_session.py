from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference import (
    LikelihoodChange,
    MovingWindow,
    PolicyWindow,
    SessionInfo,
    airl_tabular,
    average_regret,
    fleet,
    lme_i2rl,
    me_i2rl,
    mme_mtirl,
    run_sessions,
    run_streams,
)
from i2rl.inference.journal.journal import Journal
from i2rl.inference.learners.jin import jin_i2rl
from i2rl.inference.sessions.serialization import demonstration_digest
from i2rl.inference.sessions.stopping import LearningErrorChange
from i2rl.models import (
    Demonstration,
    Sensor,
    TrajectoryLaw,
    Visibility,
    concatenate,
    reward_of,
    sample_demonstration,
    soft_plan,
)


def report(session=1, log_likelihood=0.0, gradient=0.0, weights=(0.0,)):
    return SessionInfo(
        session, log_likelihood, log_likelihood, gradient, 1, 1, True, 0.0, np.array(weights, float)
    )


@pytest.fixture(scope="module")
def world(random_mdp):
    mdp = random_mdp(3, n_states=6, n_actions=3, n_successors=2, n_features=2)
    return mdp, Visibility(np.arange(6) < 4)


@pytest.fixture(scope="module")
def stream(world, imperfect_demonstration):
    mdp, sensor = world
    policy = np.log(np.full((6, 3), 1 / 3))
    return imperfect_demonstration(0, mdp, policy, sensor, 8, 4)


def test_criterion_one_stops_when_the_likelihood_settles():
    stop = LikelihoodChange(0.1)
    assert not stop([report(1, -3.0)])
    assert not stop([report(1, -3.0), report(2, -2.0)])
    assert stop([report(1, -3.0), report(2, -2.0), report(3, -2.05)])


def test_criteria_about_one_reward_refuse_several(random_mdp):
    several = [report(i, weights=np.ones((3, 2))) for i in (1, 2)]
    mdp = random_mdp(1, n_features=2)
    for stop in (LearningErrorChange(1e-6, mdp, np.ones(2)), PolicyWindow(2, 0.0, mdp)):
        with pytest.raises(ValueError, match="the learner has 3 at a time"):
            stop(several)


def test_criterion_two_stops_when_the_learning_error_settles(random_mdp):
    mdp = random_mdp(1, n_features=2)
    true = np.array([1.0, -1.0])
    stop = LearningErrorChange(1e-6, mdp, true)
    wrong, right = report(1, weights=-true), report(2, weights=true)
    assert not stop([wrong])
    assert not stop([wrong, right])
    assert stop([wrong, right, right])
    # The error that got worse fell by a negative amount, which is also at most rho.
    assert stop([right, wrong])


def test_the_moving_window_ignores_a_pause():
    stop = MovingWindow(3, 0.05)
    reports = [report(i, x) for i, x in enumerate([-3.0, -2.0, -2.0])]
    assert LikelihoodChange(0.05)(reports)
    assert not stop(reports)
    assert stop([*reports, report(4, -2.0)])
    assert MovingWindow(2, 0.1, of="gradient")([report(gradient=1.0), report(gradient=1.05)])


def test_a_moving_window_of_something_else_is_refused():
    with pytest.raises(ValueError, match="log_likelihood or gradient"):
        MovingWindow(3, 0.1, of="seconds")
    with pytest.raises(ValueError, match="at least 2"):
        MovingWindow(1, 0.1)


def test_the_gradient_falls_as_sessions_agree(world):
    mdp, _ = world
    law = TrajectoryLaw(mdp, jnp.array([1.0, -1.0]), Sensor(), 8)
    many = sample_demonstration(jax.random.key(0), law, 400)
    reports = run_sessions(me_i2rl(mdp, slack=0.0), many.sessions(20), key=jax.random.key(1)).infos
    assert reports[-1].gradient < 0.1 * reports[0].gradient


@pytest.mark.parametrize("statistic", ["counts", "features"])
def test_the_learners_likelihood_is_that_of_everything_it_saw(world, statistic):
    mdp, _ = world
    many = sample_demonstration(
        jax.random.key(0), TrajectoryLaw(mdp, jnp.array([1.0, -1.0]), Sensor(), 8), 30
    )
    learner = me_i2rl(mdp, slack=0.01, statistic=statistic)
    run = run_sessions(learner, many.sessions(10), key=jax.random.key(1))
    weights = run.state.weights
    assert run.infos[-1].log_likelihood == pytest.approx(learner.log_likelihood(run.state, weights))
    if statistic == "counts":
        log_policy = np.asarray(soft_plan(mdp, reward_of(mdp, weights)).log_policy)
        assert run.infos[-1].log_likelihood == pytest.approx(
            log_policy[many.state, many.action].sum(1).mean()
        )
    better = learner.log_likelihood(run.state, weights)
    assert better > learner.log_likelihood(run.state, weights + 0.5)
    assert better > learner.log_likelihood(run.state, weights - 0.5)


def test_an_impossible_observation_leaves_a_fleets_learner_as_it_was(world):
    mdp, sensor = world
    many = fleet(lme_i2rl(mdp, sensor))
    states = many.init(jax.random.key(0), 2)
    steps = [Demonstration.from_pairs([[0]], [[1]]), Demonstration.from_pairs([[5]], [[1]])]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *steps)
    after, reports = many.update(states, stacked)
    assert np.isfinite(reports.demonstration_log_likelihood).tolist() == [True, False]
    assert after.session.tolist() == [1, 0]
    assert np.array_equal(after.weights[1], states.weights[1])
    assert np.array_equal(after.statistic.counts[1], states.statistic.counts[1])


def test_average_regret_is_the_running_mean_of_the_likelihood_given_away():
    assert np.allclose(average_regret(np.array([0.0, 0.0, 0.0]), np.array([-3.0, -1.0, 1.0])), [3, 2, 1])
    with pytest.raises(ValueError, match="one length"):
        average_regret(np.zeros(2), np.zeros(3))
    streams = np.array([[3.0, 1.0], [0.0, -4.0]])
    assert np.allclose(average_regret(streams, np.zeros((2, 2))), [[3, 2], [0, -2]])


def test_sessions_run_until_the_stream_ends_or_a_criterion_says_so(world, stream):
    learner = lme_i2rl(*world)
    seen = []
    whole = run_sessions(
        learner, stream.sessions(), key=jax.random.key(0), on_session=lambda s, r: seen.append(r.session)
    )
    assert seen == list(range(1, 9))
    assert not whole.stopped
    short = run_sessions(learner, stream.sessions(), key=jax.random.key(0), stop=LikelihoodChange(np.inf))
    assert short.stopped
    assert len(short.infos) == 2


def test_a_run_continued_from_a_state_equals_an_uninterrupted_one_to_the_bit(world, stream):
    learner = lme_i2rl(*world)
    whole = run_sessions(learner, stream.sessions(), key=jax.random.key(0)).state
    half = run_sessions(learner, stream.select(slice(0, 4)).sessions(), key=jax.random.key(0)).state
    rest = run_sessions(learner, stream.select(slice(4, 8)).sessions(), state=half).state
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), whole._replace(key=0), rest._replace(key=0))
    assert all(jax.tree.leaves(same))
    assert jnp.all(jax.random.key_data(whole.key) == jax.random.key_data(rest.key))


def test_a_run_needs_somewhere_to_start(world, stream):
    with pytest.raises(ValueError, match="key, a state or a journal"):
        run_sessions(lme_i2rl(*world), stream.sessions())


def test_a_fleet_learns_what_each_learner_alone_would(world, stream):
    learner = lme_i2rl(*world)
    many = fleet(learner)
    states = many.init(jax.random.key(5), 3)
    streams = [stream.select([i, i + 1]) for i in range(3)]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *streams)
    states, reports = many.update(states, stacked)
    keys = jax.random.split(jax.random.key(5), 3)
    for i, one in enumerate(streams):
        state, alone = learner.update(learner.init(keys[i]), one)
        assert np.allclose(states.weights[i], state.weights, atol=1e-6)
        assert np.allclose(reports.log_likelihood[i], alone.log_likelihood, atol=1e-8)


def test_a_learner_whose_solver_is_outside_jax_makes_no_fleet(world):
    with pytest.raises(ValueError, match="outside JAX"):
        fleet(lme_i2rl(*world, solver="ipopt"))


def test_whole_streams_in_one_program_learn_what_each_learner_alone_would(world, stream):
    learner = lme_i2rl(*world)
    parts = [stream.select([2 * i, 2 * i + 1]) for i in range(2)]
    arrays = jax.tree.map(lambda *leaves: np.stack([x[:, None] for x in leaves]), *parts)
    states, reports = run_streams(learner, jax.random.key(5), arrays)
    _, sizes = run_streams(learner, jax.random.key(5), arrays, lambda state, report: state.statistic.size)
    assert sizes.tolist() == [[1, 2], [1, 2]]
    for i, key in enumerate(jax.random.split(jax.random.key(5), 2)):
        alone = run_sessions(learner, parts[i].sessions(), state=learner.init(key))
        assert np.allclose(states.weights[i], alone.state.weights, atol=1e-6)
        expected = [r.log_likelihood for r in alone.infos]
        assert np.allclose(reports.log_likelihood[i], expected, atol=1e-8)


def test_streams_need_a_learner_in_jax_and_four_axes(world, stream):
    with pytest.raises(ValueError, match="outside JAX"):
        run_streams(lme_i2rl(*world, solver="ipopt"), jax.random.key(0), stream)
    with pytest.raises(ValueError, match=r"\[streams, sessions, trajectories, steps\], got \[8, 4\]"):
        run_streams(lme_i2rl(*world), jax.random.key(0), stream)


def test_the_signature_tells_methods_and_worlds_apart(world, random_mdp):
    mdp, sensor = world
    same, again = lme_i2rl(mdp, sensor), lme_i2rl(mdp, sensor)
    assert same.signature == again.signature
    others = [
        lme_i2rl(mdp, sensor, slack=0.5),
        lme_i2rl(mdp, Visibility(np.ones(6))),
        lme_i2rl(random_mdp(4, n_states=6, n_features=2), sensor),
    ]
    assert len({same.signature, *(other.signature for other in others)}) == 4


def test_what_is_carried_does_not_grow_with_the_sessions(world, stream):
    learner = lme_i2rl(*world)
    state = learner.init(jax.random.key(0))
    before = [np.shape(x) for x in jax.tree.leaves(state)]
    state = run_sessions(learner, concatenate([stream, stream]).sessions(), state=state).state
    assert [np.shape(x) for x in jax.tree.leaves(state)] == before


def test_a_journal_of_another_learner_or_of_other_sessions_is_refused(world, stream, tmp_path):
    learner, other = lme_i2rl(*world), lme_i2rl(*world, slack=0.5)
    with Journal.open(tmp_path / "a.db", learner) as journal:
        run_sessions(learner, stream.select([0, 1]).sessions(), key=jax.random.key(0), journal=journal)
        with pytest.raises(ValueError, match="another learner"):
            run_sessions(other, stream.sessions(), key=jax.random.key(0), journal=journal)
        fresh = learner.init(jax.random.key(0))
        with pytest.raises(ValueError, match=r"0 sessions, but .* has 2"):
            run_sessions(learner, stream.sessions(), state=fresh, journal=journal)


# -- resuming from a journal ------------------------------------------------------------------------------


class Tally:
    """A learner that adds up what it is shown, so that learning twice shows."""

    name, signature, configuration = "tally", "t", {}

    def __init__(self, mdp):
        self.mdp = mdp

    def init(self, key):
        return Added(np.zeros(2), 0)

    def update(self, state, demonstration):
        state = Added(state.weights + np.asarray(demonstration, float), state.session + 1)
        return state, report(state.session, weights=state.weights)


class Added(NamedTuple):
    weights: np.ndarray
    session: int


FIVE = [np.array([i, 1]) for i in (3, 1, 1, 4, 2)]


@pytest.fixture
def begun(random_mdp, tmp_path):
    """Return a function that runs a learner on a stream in one journal, after three of five sessions."""
    learner = Tally(random_mdp(0))

    def run(stream, **options):
        with Journal.open(tmp_path / "j", learner) as journal:
            return run_sessions(learner, stream, key=jax.random.key(0), journal=journal, **options)

    assert run(FIVE[:3]).state.weights.tolist() == [5, 3]
    return run


@pytest.mark.parametrize(
    ("stream", "options"), [(FIVE, {}), (FIVE, {"whole": True}), (FIVE[3:], {"whole": False})]
)
def test_a_stream_is_learned_once_however_it_is_given_again(begun, stream, options):
    run = begun(stream, **options)
    assert run.state.weights.tolist() == [11, 5]
    assert [r.session for r in run.infos] == [4, 5]
    assert begun(iter(FIVE)).infos == ()


def test_what_no_session_learned_from_is_what_comes_next(begun):
    assert begun(FIVE[3:]).state.weights.tolist() == [11, 5]
    assert begun([]).state.session == 5
    with pytest.raises(ValueError, match=r"after session 5 .* begins with the demonstration of session 4"):
        begun(FIVE[3:])  # twice would be learned twice
    assert begun(FIVE[3:], whole=False).state.weights.tolist() == [17, 7]


@pytest.mark.parametrize(
    ("stream", "options", "message", "learned"),
    [
        (
            FIVE[1:],
            {},
            "must begin with session 1 or after session 3 .* of session 2: give the whole stream",
            3,
        ),
        (
            [FIVE[0], FIVE[0], *FIVE[2:]],
            {},
            "demonstration 2 of the stream is not the one that session 2 of .*j",
            3,
        ),
        (FIVE[::-1], {"whole": True}, "demonstration 1 of the stream is not the one that session 1", 3),
        (FIVE[:2], {}, "the stream ends after 2 demonstrations, but .*j has 3 sessions", 3),
        # An edited first demonstration is taken for something new, but what follows gives it away.
        ([9 * FIVE[0], *FIVE[1:]], {}, "demonstration 2 of the stream is the one that session 2", 4),
    ],
)
def test_another_stream_is_refused_and_not_learned_from(begun, stream, options, message, learned):
    with pytest.raises(ValueError, match=message):
        begun(stream, **options)
    assert begun([], whole=False).state.session == learned


def test_a_journal_that_does_not_know_its_demonstrations_is_continued(random_mdp, tmp_path):
    learner = Tally(random_mdp(0))
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*learner.update(learner.init(None), FIVE[0]))
        assert run_sessions(learner, FIVE[1:], journal=journal).state.weights.tolist() == [11, 5]


def test_a_demonstration_has_one_digest_whatever_holds_it():
    steps = Demonstration.from_pairs([[0, 1]], [[1, 0]])
    padded = steps.padded(4, 8)
    as_jax = jax.tree.map(jnp.asarray, steps)
    wide = replace(steps, state=steps.state.astype(np.int64), score=np.array([[-np.nan, np.nan]]))
    assert (
        len(
            {
                demonstration_digest(x)
                for x in (steps, padded, as_jax, wide, jax.tree.map(jnp.asarray, padded))
            }
        )
        == 1
    )
    others = [
        Demonstration.from_pairs([[0, 1]], [[1, 1]]),
        Demonstration.from_pairs([[0], [1]], [[1], [0]]),
        replace(steps, score=np.array([[0.5, np.nan]])),
        replace(steps, kind=np.array([[2, 1]])),
        steps.select([]),
    ]
    assert len({demonstration_digest(x) for x in (steps, *others)}) == 6


# -- mistakes ---------------------------------------------------------------------------------------------


def test_what_is_no_stream_no_key_and_no_journal_is_named(world, stream, tmp_path):
    learner, key = lme_i2rl(*world), jax.random.key(0)
    mistakes = {
        r"got one Demonstration: pass \[it\] for one session, Demonstration.sessions\(\) for one": stream,
        "`stream` must be an iterable of demonstrations; got 'demos.jsonl'": "demos.jsonl",
        "`stream` must be an iterable of demonstrations; got 3": 3,
    }
    for message, wrong in mistakes.items():
        with pytest.raises(TypeError, match=message):
            run_sessions(learner, wrong, key=key)
    with pytest.raises(TypeError, match=r"`journal` must be Journal.open\(path, learner\); got 'run.db'"):
        run_sessions(learner, stream.sessions(), key=key, journal="run.db")
    for wrong in (0.5, np.zeros(2), jax.random.split(key), "seed"):
        with pytest.raises(TypeError, match=r"key must be one random key such as jax.random.key\(0\)"):
            run_sessions(learner, stream.sessions(), key=wrong)
        with pytest.raises(TypeError, match="key must be one random key"):
            fleet(learner).init(wrong, 2)


def test_a_legacy_key_begins_as_the_typed_one_does(world):
    mdp, sensor = world
    legacy, typed = jax.random.PRNGKey(5), jax.random.key(5)
    for learner in (lme_i2rl(mdp, sensor), jin_i2rl(mdp), mme_mtirl(mdp, sensor), airl_tabular(mdp)):
        one, other = learner.init(legacy), learner.init(typed)
        assert jax.tree.structure(one) == jax.tree.structure(other)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert a.dtype == b.dtype
            assert np.array_equal(*(jax.random.key_data(x) if x.dtype == typed.dtype else x for x in (a, b)))


def test_a_journal_begun_with_a_legacy_key_resumes(world, stream, tmp_path):
    learner = lme_i2rl(*world)
    demonstrations = list(stream.select([0, 1]).sessions())
    whole = run_sessions(learner, demonstrations, key=jax.random.key(0)).state
    for count in (1, 2):
        with Journal.open(tmp_path / "a.db", learner) as journal:
            state = run_sessions(
                learner, demonstrations[:count], key=jax.random.PRNGKey(0), journal=journal
            ).state
    assert np.array_equal(state.weights, whole.weights)
    assert state.key == whole.key
