"""Sensors: their evidence, their products, and impossible observations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.models import (
    Demonstration,
    DemonstrationError,
    ObservationModel,
    Sensor,
    TabularMDP,
    Visibility,
    log_evidence,
    require_possible,
)
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN
from i2rl.models.observation.evidence import observe, step_log_evidence

S, A = 3, 2
VIEW = np.array([1.0, 0.0, 0.4])


def confusion(seed=0):
    return np.random.default_rng(seed).dirichlet(np.ones(S * A), (S, A)).reshape(S, A, S, A)


def walk(**options):
    """Build a process: action 0 stays, action 1 moves on: 0 to 1 to 2, where it ends. Starts in 0."""
    successors = np.array([[[0], [1]], [[1], [2]], [[2], [2]]])
    return TabularMDP.from_successors(
        successors, np.ones((S, A, 1)), np.zeros((S, A, 1)), initial=np.array([1.0, 0, 0]), **options
    )


MDP = walk()
evidence = jax.jit(step_log_evidence, static_argnums=(1, 2))


def probability(sensor, kind, state=UNKNOWN, action=UNKNOWN):
    return np.exp(evidence(sensor, S, A, kind, state, action, jnp.nan))


def test_a_clear_view_is_certain_of_the_pair_seen():
    np.testing.assert_array_equal(probability(Sensor(), SEEN, 1, 0), [[0, 0], [1, 0], [0, 0]])
    np.testing.assert_array_equal(probability(Sensor(), SEEN, 1), [[0, 0], [1, 1], [0, 0]])
    np.testing.assert_array_equal(probability(Sensor(), SEEN, action=1), [[0, 1], [0, 1], [0, 1]])


def test_not_being_seen_is_evidence_of_being_out_of_view():
    np.testing.assert_allclose(probability(Visibility(VIEW), HIDDEN), np.stack([1 - VIEW] * A, axis=1))
    np.testing.assert_allclose(probability(Visibility(VIEW), SEEN, 2, 1), [[0, 0], [0, 0], [0, 0.4]])


@pytest.mark.parametrize("kind", [LOST, PAD])
def test_lost_frames_and_padding_are_no_evidence(kind):
    for sensor in (
        Sensor(),
        Visibility(VIEW),
        Visibility(VIEW) * ObservationModel.from_probabilities(confusion()),
    ):
        np.testing.assert_array_equal(probability(sensor, kind, 1, 1), 1)


def test_noise_weighs_every_truth_by_its_confusion():
    table = confusion()
    sensor = ObservationModel.from_probabilities(table)
    np.testing.assert_allclose(probability(sensor, SEEN, 2, 1), table[:, :, 2, 1])
    np.testing.assert_allclose(probability(sensor, SEEN, 2), table[:, :, 2].sum(2))
    np.testing.assert_allclose(probability(sensor, SEEN, action=1), table[:, :, :, 1].sum(2))
    np.testing.assert_allclose(probability(sensor, HIDDEN), 0)


def test_independent_confusions_multiply():
    states, actions = np.array([[0.8, 0.2, 0], [0.1, 0.9, 0], [0, 0, 1]]), np.array([[0.7, 0.3], [0.4, 0.6]])
    sensor = ObservationModel.from_factors(states, actions)
    np.testing.assert_allclose(probability(sensor, SEEN, 1, 0), np.outer(states[:, 1], actions[:, 0]))


def test_products_hide_and_confuse_at_once_in_either_order():
    noise, other = ObservationModel.from_probabilities(confusion()), Visibility(np.array([0.5, 1, 1]))
    one, two = Visibility(VIEW) * noise * other, other * (noise * Visibility(VIEW))
    seen = confusion()[:, :, 1, 1] * (VIEW * [0.5, 1, 1])[:, None]
    for sensor in (one, two):
        np.testing.assert_allclose(probability(sensor, SEEN, 1, 1), seen)
        hidden = probability(sensor, HIDDEN)
        np.testing.assert_allclose(hidden[:, 0], 1 - VIEW * [0.5, 1, 1])
    assert (Sensor() * noise).noise is noise
    with pytest.raises(ValueError, match="two observation models cannot be multiplied"):
        noise * noise


@given(
    view=st.lists(st.floats(0, 1), min_size=S, max_size=S),
    seed=st.integers(0, 100),
    state=st.integers(0, S - 1),
    action=st.integers(0, A - 1),
)
def test_the_probabilities_of_everything_that_may_be_perceived_sum_to_one(view, seed, state, action):
    sensor = Visibility(view) * ObservationModel.from_probabilities(confusion(seed))
    total = probability(sensor, HIDDEN)
    for s, a in np.ndindex(S, A):
        total = total + probability(sensor, SEEN, s, a)
    np.testing.assert_allclose(total[state, action], 1, atol=1e-12)


def test_what_a_sensor_draws_has_the_probability_it_assigns():
    sensor, n = Visibility(VIEW) * ObservationModel.from_probabilities(confusion()), 20_000
    look = jax.jit(observe)
    for s, a in np.ndindex(S, A):
        codes = np.asarray(look(jax.random.key(s * A + a), sensor, jnp.full(n, s), jnp.full(n, a)))
        hidden = (codes == (HIDDEN, UNKNOWN, UNKNOWN)).all(1)
        frequencies = [hidden.mean()]
        expected = [probability(sensor, HIDDEN)[s, a]]
        for o, b in np.ndindex(S, A):
            frequencies.append((codes == (SEEN, o, b)).all(1).mean())
            expected.append(probability(sensor, SEEN, o, b)[s, a])
        expected = np.array(expected)
        np.testing.assert_allclose(expected.sum(), 1)
        error = 4 * np.sqrt(expected * (1 - expected) / n)
        assert (np.abs(np.array(frequencies) - expected) <= error + 1e-12).all()


def test_evidence_has_finite_gradients_where_the_sensor_is_certain():
    table = confusion()
    table[0, 0] = 0
    table[0, 0, 0, 0] = 1
    certain = ObservationModel.from_probabilities(table)

    def total(log_probabilities, view, state, action):
        sensor = Visibility(view) * ObservationModel(log_probabilities)
        terms = [step_log_evidence(sensor, S, A, kind, state, action, jnp.nan) for kind in (SEEN, HIDDEN)]
        return sum(jnp.sum(jnp.exp(term)) for term in terms)

    view = jnp.array([0.0, 1.0, 0.5])
    for state, action in ((1, 1), (UNKNOWN, 1), (1, UNKNOWN)):
        gradients = jax.grad(total, (0, 1))(certain.log_probabilities, view, state, action)
        assert all(np.isfinite(gradient).all() for gradient in gradients)


def test_sensors_pass_through_transformations():
    sensor = Visibility(VIEW) * ObservationModel.from_probabilities(confusion())
    shapes = jax.eval_shape(lambda v: Visibility(v.in_view / 2), Visibility(VIEW))
    assert shapes.in_view.shape == (S,)
    assert jax.tree.map(lambda _: None, Visibility(VIEW)).in_view is None
    views = jax.vmap(Visibility)(jnp.stack([jnp.asarray(VIEW)] * 4))
    batched = jax.vmap(lambda v: step_log_evidence(v, S, A, SEEN, 2, 1, jnp.nan))(views)
    np.testing.assert_allclose(np.exp(batched)[:, 2, 1], 0.4)
    assert jax.tree.structure(sensor) == jax.tree.structure(jax.jit(lambda x: x)(sensor))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Visibility([0.5, 1.2, 0]), r"that of state 1 is 1\.2"),
        (lambda: Visibility([0.5, 0.5, -0.1]), r"that of state 2 is -0\.1"),
        (lambda: Visibility([np.nan, 0, 0]), r"that of state 0 is nan"),
        (lambda: Visibility(np.ones((3, 2))), r"in_view must have shape \[S\], got \(3, 2\)"),
        (
            lambda: ObservationModel.from_probabilities(np.ones((3, 2))),
            r"shape \[S, A, S, A\], truth first, got",
        ),
        (
            lambda: ObservationModel.from_probabilities(np.ones((3, 2, 2, 3))),
            r"truth first, got \(3, 2, 2, 3\)",
        ),
        (lambda: ObservationModel.from_probabilities(-confusion()), r"must be non-negative numbers"),
        (lambda: ObservationModel.from_probabilities(confusion() * np.nan), r"must be non-negative numbers"),
        (
            lambda: ObservationModel.from_factors(np.diag([1, 1, 0.9]), np.eye(2)),
            r"of pair \(2, 0\) sum to 0\.9, not 1",
        ),
    ],
)
def test_bad_sensors_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (Visibility(np.ones(4)), r"view has shape \(4,\), but the MDP has 3 states"),
        (Visibility(np.ones(1)), r"view has shape \(1,\), but the MDP has 3 states"),
        (
            ObservationModel.from_factors(np.eye(3), np.eye(3)),
            r"about 3 states and 3 actions, but the MDP has 3 and 2",
        ),
    ],
)
def test_a_sensor_made_for_another_mdp_is_refused(sensor, message):
    demo = Demonstration.from_steps([["hidden"]], MDP)
    for use in (log_evidence, require_possible):
        with pytest.raises(ValueError, match=message):
            use(sensor, MDP, demo)


NOISY = ObservationModel.from_factors(np.array([[0.9, 0.1, 0], [0.1, 0.9, 0], [0, 0, 1]]), np.eye(2))
NAMED = walk(states=("bin", "table", "eye"), actions=("stay", "go"))
MASKED = walk(available=np.array([[True, False], [True, True], [True, True]]))
IMPOSSIBLE = {
    "cannot start there": (
        Sensor(),
        NAMED,
        [(1, 0)],
        r"trajectory 0, step 0: .*: seen state 'table' \(1\), action 'stay' \(0\); the initial distribution",
    ),
    "no transition": (
        Sensor(),
        NAMED,
        [(0, 1), (1, 0), (2, 0)],
        r"trajectory 0, step 2: .*: seen state 'eye' \(2\).*; no transition leads there",
    ),
    "no transition through a gap": (
        Sensor(),
        MDP,
        [(0, 1), None, (0, 0)],
        r"step 2: .*seen state 0, action 0; no transition",
    ),
    "no action": (Sensor(), MASKED, [(0, 1)], r"step 0: .*; the action is not available there"),
    "seen out of view": (Visibility([0, 1, 1]), MDP, [(0, 0)], r"step 0: .*; the sensor excludes it"),
    "hidden in full view": (
        Visibility([1, 1, 1]),
        MDP,
        ["hidden"],
        r"step 0: .*: hidden; every state is in view",
    ),
    "hidden where it could not be": (
        Visibility([1, 1, 0]),
        MDP,
        [(0, 0), "hidden"],
        r"step 1: .*: hidden; no transition leads there",
    ),
    "never confused": (NOISY, MDP, [(0, 0), {"s": 2}], r"step 1: .*: seen state 2; no transition"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_observations_name_trajectory_step_and_reason(case):
    sensor, mdp, steps, message = IMPOSSIBLE[case]
    with pytest.raises(DemonstrationError, match=message):
        require_possible(sensor, mdp, Demonstration.from_steps([steps], mdp))
    possible = [[{"s": 0, "a": 0}]] if case not in ("cannot start there", "seen out of view") else [[None]]
    rows = Demonstration.from_steps([*possible, steps], mdp)
    with pytest.raises(DemonstrationError, match=r"session 1, step \d: impossible observation"):
        require_possible(sensor, mdp, rows, record="session")


@pytest.mark.parametrize(
    ("state", "action", "message"),
    [
        (7, 0, r"trajectory 0, step 0: state 7 is out of range; indices run from 0 to 2"),
        (-3, 0, r"trajectory 0, step 0: state -3 is out of range"),
        (0, 2, r"trajectory 0, step 0: action 2 is out of range; indices run from 0 to 1"),
    ],
)
def test_indices_out_of_range_are_named(state, action, message):
    demo = Demonstration.from_codes(np.array([[[SEEN, state, action]]]))
    for sensor in (Sensor(), NOISY):
        with pytest.raises(DemonstrationError, match=message):
            require_possible(sensor, NAMED, demo)


def test_possible_observations_pass():
    steps = [[(0, 0), None, {"a": 1}, "hidden"], ["hidden"] * 3, [None, (0, 1), {"s": 1}]]
    require_possible(Visibility([0.5, 0.5, 0]), MDP, Demonstration.from_steps(steps, MDP).bucketed())


@given(
    seed=st.integers(0, 2),
    steps=st.lists(
        st.one_of(
            st.none(),
            st.just("hidden"),
            st.tuples(st.integers(0, 3), st.one_of(st.none(), st.integers(0, 2))),
        ),
        min_size=1,
        max_size=4,
    ),
    masked=st.booleans(),
)
def test_exactly_what_no_completion_explains_is_impossible(
    seed, steps, masked, random_mdp, enumerate_completions
):
    mdp = random_mdp(seed, masked=masked, starts=2)
    sensor = Visibility([1, 1, 0, 0.5])
    demo = Demonstration.from_steps([steps], mdp)
    log_policy = np.where(mdp.available, 0.0, -np.inf)
    truth = enumerate_completions(mdp, log_policy, log_evidence(sensor, mdp, demo)[0])
    try:
        require_possible(sensor, mdp, demo)
    except DemonstrationError:
        assert truth.log_likelihood == -np.inf
    else:
        assert truth.log_likelihood > -np.inf
