"""MME-MTIRL finds the components of sorting, their trajectories and their rewards."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.judging.multi_task import assignment_accuracy, expected_value_difference
from i2rl.domains.sorting.process import demonstrate_sorting, sorting_with_claiming
from i2rl.inference import batch_mme_mtirl, mme_mtirl, run_sessions, run_streams
from i2rl.inference.journal.journal import Journal
from i2rl.inference.learners.mtirl import assign_trajectories
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    Sensor,
    TrajectoryLaw,
    Visibility,
    concatenate,
)
from i2rl.models.observation.demonstration import HIDDEN, PAD, UNKNOWN

STEPS = 50


@pytest.fixture(scope="module")
def sorting():
    return sorting_with_claiming()


@pytest.fixture(scope="module")
def batch(sorting):
    return batch_mme_mtirl(sorting.mdp)


@pytest.fixture(scope="module")
def online(sorting):
    return mme_mtirl(sorting.mdp)


def lost(sorting, mixed, weights, assignments):
    return expected_value_difference(
        sorting.mdp, sorting.weights, mixed.labels, weights, assignments, mixed.demonstration
    )


def quietly(fit, *arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit(*arguments)


@pytest.mark.parametrize("counts", [(2, 2), (8, 8), (13, 3), (2, 2, 2), (8, 8, 8), (16, 0)])
def test_it_finds_who_did_what_and_why(sorting, batch, counts):
    for seed in range(3):
        mixed = demonstrate_sorting(jax.random.key(seed), sorting, counts, STEPS)
        found = batch.fit(jax.random.key(seed), mixed.demonstration)
        assert found.n_components == np.count_nonzero(counts)
        assert assignment_accuracy(mixed.labels, found.assignments) == 1
        assert lost(sorting, mixed, found.weights, found.assignments) == 0
        np.testing.assert_allclose(found.proportions.sum(), 1, atol=1e-9)
        np.testing.assert_allclose(found.responsibilities.sum(1), 1, atol=1e-9)
        assert (np.diff(found.proportions) <= 0).all()


def test_the_same_key_gives_the_same_bits(sorting, batch):
    mixed = demonstrate_sorting(jax.random.key(5), sorting, (4, 4), STEPS)
    one, other = (batch.fit(jax.random.key(0), mixed.demonstration) for _ in range(2))
    np.testing.assert_array_equal(one.weights, other.weights)


def test_rows_of_padding_change_nothing(sorting, batch):
    mixed = demonstrate_sorting(jax.random.key(6), sorting, (4, 4), STEPS)
    plain = batch.fit(jax.random.key(0), mixed.demonstration)
    padded = batch.fit(jax.random.key(0), mixed.demonstration.padded(11, STEPS))
    assert padded.responsibilities.shape == plain.responsibilities.shape
    np.testing.assert_allclose(padded.weights, plain.weights, atol=1e-9)


def test_half_hidden_trajectories_are_told_apart(sorting):
    batch = batch_mme_mtirl(sorting.mdp, Visibility(np.full(sorting.mdp.n_states, 0.5)))
    mixed = demonstrate_sorting(jax.random.key(7), sorting, (8, 8), 25)
    whole = mixed.demonstration
    hidden = np.random.default_rng(0).random(whole.kind.shape) < 0.5
    seen = replace(
        whole,
        kind=np.where(hidden, HIDDEN, whole.kind),
        state=np.where(hidden, UNKNOWN, whole.state),
        action=np.where(hidden, UNKNOWN, whole.action),
    )
    found = batch.fit(jax.random.key(1), seen)
    assert assignment_accuracy(mixed.labels, found.assignments) >= 0.9


def shuffled_stream(sorting, seed, counts, late=()):
    """Trajectories in random order, then those of ``late`` counts mixed in random order."""
    parts = []
    for i, part in enumerate((counts, late)):
        if sum(part):
            mixed = demonstrate_sorting(jax.random.key(100 * i + seed), sorting, part, STEPS)
            order = np.random.default_rng(seed + i).permutation(len(mixed.labels))
            parts.append((mixed.demonstration.select(order), mixed.labels[order]))
    demonstrations, labels = zip(*parts, strict=True)
    return concatenate(demonstrations), np.concatenate(labels)


@pytest.mark.parametrize("seed", range(3))
def test_online_finds_what_batch_finds_and_a_way_that_comes_late(sorting, online, seed):
    demonstration, labels = shuffled_stream(sorting, seed, (12, 12), (4, 4, 4))
    state, n_components = online.init(jax.random.key(seed)), []
    for session in demonstration.sessions(4):
        state, info = online.update(state, session)
        n_components.append(info.n_components)
    assert n_components[5] == 2
    assert n_components[-1] == 3
    found = np.flatnonzero(state.proportions)
    weights, proportions = np.asarray(state.weights)[found], np.asarray(state.proportions)[found]
    shares = assign_trajectories(sorting.mdp, None, weights, proportions, demonstration)
    assert assignment_accuracy(labels, shares.argmax(1)) == 1
    loss = expected_value_difference(
        sorting.mdp, sorting.weights, labels, weights, shares.argmax(1), demonstration
    )
    assert loss == 0
    # The state holds only these sums of old trajectories (Eq. 5.7 and 5.8).
    np.testing.assert_allclose(float(state.mass.sum()), 36, atol=1e-9)
    np.testing.assert_allclose(float(state.visits.sum()), 36 * STEPS, atol=1e-6)


def test_one_trajectory_after_the_other_is_enough(sorting, online):
    demonstration, _ = shuffled_stream(sorting, 4, (8, 8))
    state = online.init(jax.random.key(0))
    for session in demonstration.sessions(1):
        state, info = online.update(state, session)
    assert info.n_components == 2


def test_a_resumed_learner_equals_one_that_was_never_stopped(sorting, online, tmp_path):
    demonstration, _ = shuffled_stream(sorting, 5, (6, 6))
    sessions = list(demonstration.sessions(4))
    straight = online.init(jax.random.key(0))
    for session in sessions:
        straight, _ = online.update(straight, session)
    path = tmp_path / "journal.db"
    with Journal.open(path, online) as journal:
        run_sessions(online, iter(sessions[:2]), key=jax.random.key(0), journal=journal)
    with Journal.open(path, online) as journal:
        run_sessions(online, iter(sessions[2:]), journal=journal)
        for name, one, other in zip(straight._fields, straight, journal.state, strict=True):
            if name == "key":
                one, other = (jax.random.key_data(k) for k in (one, other))
            np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize("behaviours", [(0,), (0, 1)])
def test_at_the_full_price_people_who_err_are_not_split_by_their_errors(sorting, behaviours):
    full = batch_mme_mtirl(sorting.mdp, temperature=1.0)
    for seed in range(3):
        key = jax.random.key(seed)
        codes = [
            TrajectoryLaw(sorting.mdp, jnp.asarray(3.0 * sorting.weights[b]), Sensor(), STEPS).sample(
                jax.random.fold_in(key, b), (16,)
            )
            for b in behaviours
        ]
        found = full.fit(key, Demonstration.from_codes(np.concatenate([np.asarray(c) for c in codes])))
        assert found.n_components == len(behaviours)
        # Who errs may for once do what the other would.
        assert assignment_accuracy(np.repeat(behaviours, 16), found.assignments) > 0.85


def test_what_a_report_says_of_all_that_is_kept_is_the_learner_s_log_likelihood(sorting, online):
    demonstration, _ = shuffled_stream(sorting, 6, (6, 6))
    state = online.init(jax.random.key(0))
    for session in demonstration.sessions(4):
        state, info = online.update(state, session)
        assert online.log_likelihood(state, state.weights) == pytest.approx(info.log_likelihood, abs=1e-9)
    assert online.log_likelihood(state, np.zeros_like(state.weights)) < info.log_likelihood


def test_streams_whose_first_session_is_empty_learn_from_the_next(sorting):
    learner = mme_mtirl(sorting.mdp, n_components=2, restarts=1)
    demonstration = demonstrate_sorting(jax.random.key(0), sorting, (2, 2), 20).demonstration
    empty = replace(demonstration, kind=np.full_like(demonstration.kind, PAD))
    stream = jax.tree.map(lambda *x: np.stack(x)[None], empty, demonstration, empty)
    state, info = run_streams(learner, jax.random.key(0), stream)
    np.testing.assert_array_equal(info.n_components, [[0, 2, 2]])
    np.testing.assert_allclose(state.mass.sum(), 4, atol=1e-9)
    assert np.isfinite(info.log_likelihood).all()


# -- bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_components": 0}, "n_components must be at least 1, got 0"),
        ({"n_components": 2.5}, "n_components must be a whole number, got 2.5"),
        ({"temperature": 0.0}, "temperature must be more than zero"),
        ({"ridge": -1.0}, "ridge must be finite and not negative"),
        ({"strength": float("nan")}, "strength must be finite and not negative, got nan"),
        ({"temperature": float("inf")}, "temperature must be finite"),
        ({"tolerance": float("nan")}, "tolerance must be a number"),
    ],
)
@pytest.mark.parametrize("learner", [mme_mtirl, batch_mme_mtirl])
def test_senseless_settings_are_refused(sorting, learner, options, message):
    with pytest.raises(ValueError, match=message):
        learner(sorting.mdp, **options)


def test_fewer_trajectories_than_ways_are_said_and_not_crashed(sorting, batch):
    mixed = demonstrate_sorting(jax.random.key(0), sorting, (1, 1), STEPS)
    with pytest.warns(UserWarning, match="`n_components` is 4, but there are 2 trajectories"):
        found = batch.fit(jax.random.key(0), mixed.demonstration)
    assert 1 <= found.n_components <= 2


def test_one_trajectory_is_one_way(sorting, batch):
    mixed = demonstrate_sorting(jax.random.key(0), sorting, (1, 0), STEPS)
    found = quietly(batch.fit, jax.random.key(0), mixed.demonstration)
    assert found.n_components == 1
    assert lost(sorting, mixed, found.weights, found.assignments) == 0


def test_identical_trajectories_are_one_way(sorting, batch):
    one = demonstrate_sorting(jax.random.key(0), sorting, (1, 0), STEPS).demonstration
    found = batch.fit(jax.random.key(0), concatenate([one] * 8))
    assert found.n_components == 1
    np.testing.assert_array_equal(found.responsibilities, np.ones((8, 1)))


def unavailable(sorting):
    """Give the fourth of five trajectories an unavailable action at its third step."""
    mixed = demonstrate_sorting(jax.random.key(0), sorting, (3, 2), STEPS).demonstration
    state, action = np.array(mixed.state), np.array(mixed.action)
    s = state[3, 2]
    action[3, 2] = np.flatnonzero(~np.asarray(sorting.mdp.available)[s])[0]
    return replace(mixed, action=action), sorting.mdp.state_names[s]


def test_an_unavailable_action_is_named_and_costs_nothing_learned(sorting, batch, online):
    wrong, name = unavailable(sorting)
    with pytest.raises(DemonstrationError, match="trajectory 3, step 2") as caught:
        batch.fit(jax.random.key(0), wrong)
    assert name in str(caught.value)
    state, _ = online.update(online.init(jax.random.key(0)), wrong.select([0, 1]))
    before = jax.tree.map(np.array, state._replace(key=jax.random.key_data(state.key)))
    with pytest.raises(DemonstrationError, match="trajectory 3, step 2"):
        online.update(state, wrong)
    after = jax.tree.map(np.array, state._replace(key=jax.random.key_data(state.key)))
    jax.tree.map(np.testing.assert_array_equal, before, after)
    with pytest.raises(DemonstrationError, match="trajectory 3, step 2"):
        assign_trajectories(sorting.mdp, None, np.asarray(state.weights), np.full(4, 0.25), wrong)


def test_no_trajectories_are_nothing_to_learn_from(sorting, batch):
    nothing = Demonstration.from_codes(np.zeros((0, 5, 3), int))
    with pytest.raises(DemonstrationError, match="at least one trajectory"):
        batch.fit(jax.random.key(0), nothing)


@pytest.mark.parametrize(
    ("weights", "proportions", "message"),
    [
        (np.zeros((2, 3)), np.full(2, 0.5), r"shapes \[D, 11\] and \[D\], got \[2, 3\] and \[2\]"),
        (np.zeros((2, 11)), np.ones(1), r"got \[2, 11\] and \[1\]"),
        (np.full((1, 11), np.nan), np.ones(1), "weights must be finite, got nan"),
        (np.zeros((2, 11)), np.zeros(2), "not all zero"),
    ],
)
def test_ways_that_are_none_are_refused(sorting, weights, proportions, message):
    demonstration = demonstrate_sorting(jax.random.key(0), sorting, (1, 1), STEPS).demonstration
    with pytest.raises(ValueError, match=message):
        assign_trajectories(sorting.mdp, None, weights, proportions, demonstration)


def test_a_hidden_step_is_named_where_nothing_can_hide(sorting):
    demonstration = demonstrate_sorting(jax.random.key(0), sorting, (2, 2), STEPS).demonstration
    kind = np.array(demonstration.kind)
    kind[1, 3] = HIDDEN
    hidden = replace(demonstration, kind=kind)
    with pytest.raises(DemonstrationError, match="trajectory 1, step 3: impossible observation: hidden"):
        assign_trajectories(sorting.mdp, None, sorting.weights, np.full(3, 1 / 3), hidden)
