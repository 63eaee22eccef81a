"""Demonstrations: reading, writing, cutting and joining, and refusals that name the record."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.models import (
    Demonstration,
    DemonstrationError,
    TabularMDP,
    concatenate,
    read_trajectories,
    write_trajectories,
)
from i2rl.models.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN

S, A = 3, 2
NAMES = {"states": ("bin", "table", "eye"), "actions": ("grasp", "place")}


def small_mdp(**names):
    return TabularMDP.from_successors(
        np.zeros((S, A, 1), int), np.ones((S, A, 1)), np.zeros((S, A, 1)), **names
    )


PLAIN, NAMED = small_mdp(), small_mdp(**NAMES)


def read(text, mdp=NAMED, **options):
    return list(read_trajectories(io.StringIO(text), mdp, **options))


def assert_same(one, two):
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_line_says_what_was_seen_hidden_lost_or_half_seen():
    line = (
        '{"id": "shift-7", "agent": 1, "steps": [{"s": "bin", "a": "grasp", "score": 0.9}, "hidden", null, '
        '{"s": 2}, {"a": "place"}]}'
    )
    (record,) = read(line + "\n")
    assert (record.line, record.id, record.agent) == (1, "shift-7", 1)
    demo = record.demonstration
    np.testing.assert_array_equal(demo.kind, [[SEEN, HIDDEN, LOST, SEEN, SEEN]])
    np.testing.assert_array_equal(demo.state, [[0, UNKNOWN, UNKNOWN, 2, UNKNOWN]])
    np.testing.assert_array_equal(demo.action, [[0, UNKNOWN, UNKNOWN, UNKNOWN, 1]])
    np.testing.assert_array_equal(demo.score, [[0.9, np.nan, np.nan, np.nan, np.nan]])


def test_a_bare_list_is_a_trajectory_and_blank_lines_are_skipped():
    records = read('[{"s": 0, "a": 1}]\n\n   \n["hidden"]\n')
    assert [record.line for record in records] == [1, 4]
    assert [record.id for record in records] == [None, None]


def test_numbered_names_stand_for_indices_where_there_are_no_names():
    (record,) = read('[{"s": "s2", "a": "a1"}]', PLAIN)
    assert (record.demonstration.state[0, 0], record.demonstration.action[0, 0]) == (2, 1)


def test_reading_is_lazy():
    def lines():
        yield '["hidden"]\n'
        raise AssertionError("read ahead")

    assert next(read_trajectories(lines(), PLAIN)).line == 1


GOOD_LINE = '[{"s": "bin", "a": "grasp"}]\n'
REFUSED = {
    "truncated": ('{"steps": [{"s": "bin"', r"log, line 2: not valid JSON at character 23.*cut off"),
    "not JSON": ("oops\n", r"log, line 2: not valid JSON at character 1: [^(]*$"),
    "empty object": ("{}\n", r'log, line 2: a trajectory needs the field "steps"'),
    "no steps": ('{"steps": []}\n', r"log, line 2: steps must be a list of at least one step"),
    "empty list": ("[]\n", r"log, line 2: steps must be a list of at least one step"),
    "a number": ("3\n", r"log, line 2: steps must be a list"),
    "unknown field": ('{"steps": ["hidden"], "reward": 1}\n', r"log, line 2: unknown field 'reward'"),
    "agent by name": (
        '{"steps": ["hidden"], "agent": "x"}\n',
        r"log, line 2: agent must be an integer, got 'x'",
    ),
    "unknown state": (
        '["hidden", {"s": "floor"}]\n',
        r"log, line 2, step 1: unknown state 'floor'; known are bin",
    ),
    "unknown action": ('[{"a": "throw"}]\n', r"log, line 2, step 0: unknown action 'throw'; known are grasp"),
    "state out of range": (
        '[{"s": 3}]\n',
        r"line 2, step 0: state 3 is out of range; indices run from 0 to 2",
    ),
    "negative state": ('[{"s": -1}]\n', r"line 2, step 0: state -1 is out of range"),
    "action out of range": (
        '[{"a": 2}]\n',
        r"line 2, step 0: action 2 is out of range; indices run from 0 to 1",
    ),
    "state of another type": (
        '[{"s": 1.5}]\n',
        r"line 2, step 0: state must be a name or an index, got 1\.5",
    ),
    "state true": ('[{"s": true}]\n', r"line 2, step 0: state must be a name or an index, got True"),
    "score above one": (
        '[{"s": 1, "score": 1.5}]\n',
        r"line 2, step 0: score must lie in \[0, 1\], got 1\.5",
    ),
    "score below zero": ('[null, {"s": 1, "score": -0.1}]\n', r"line 2, step 1: score must lie in \[0, 1\]"),
    "score NaN": ('[{"s": 1, "score": NaN}]\n', r"line 2, step 0: score must lie in \[0, 1\], got nan"),
    "score in words": (
        '[{"s": 1, "score": "high"}]\n',
        r"line 2, step 0: score must lie in \[0, 1\], got 'high'",
    ),
    "nothing seen": ('[{"score": 0.5}]\n', r'line 2, step 0: a seen step needs "s" or "a"'),
    "misspelt field": (
        '[{"state": 1}]\n',
        r"line 2, step 0: unknown field 'state'; a step has s, a and score",
    ),
    "another word": ('["missing"]\n', r"line 2, step 0: a step is .*got 'missing'"),
    "a pair as list": ("[[0, 1]]\n", r"line 2, step 0: a step is .*got \[0, 1\]"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_lines_are_refused_by_line_step_and_field(case):
    line, message = REFUSED[case]
    with pytest.raises(DemonstrationError, match=message):
        read(GOOD_LINE + line, source="log")


def test_steps_in_code_may_be_pairs():
    demo = Demonstration.from_steps([[("bin", "place"), (1, None), "hidden"], [None]], NAMED)
    np.testing.assert_array_equal(demo.kind, [[SEEN, SEEN, HIDDEN], [LOST, PAD, PAD]])
    np.testing.assert_array_equal(demo.action, [[1, UNKNOWN, UNKNOWN], [UNKNOWN] * 3])
    np.testing.assert_array_equal(demo.lengths, [3, 1])


def test_scores_may_be_numpy_numbers():
    step = {"s": 0, "score": np.float32(0.5)}
    assert Demonstration.from_steps([[step]], NAMED).score[0, 0] == 0.5


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([["hidden"], [(0, 0), (7, 0)]], r"trajectory 1, step 1: state 7 is out of range"),
        ([[(0, "throw")]], r"trajectory 0, step 0: unknown action 'throw'"),
        ([[(0, 1, 2)]], r"trajectory 0, step 0: a step is"),
        ([[(0,)]], r"trajectory 0, step 0: a step is"),
    ],
)
def test_bad_steps_in_code_are_refused_by_trajectory_and_step(steps, message):
    with pytest.raises(DemonstrationError, match=message):
        Demonstration.from_steps(steps, NAMED)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda d: d.padded(1, 9), r"shape \(2, 3\) does not fit into \(1, 9\)"),
        (lambda d: d.padded(9, 2), r"does not fit into \(9, 2\)"),
        (lambda d: list(d.sessions(0)), r"at least one trajectory, got 0"),
        (lambda d: d.fragments(0), r"at least one step, got 0"),
        (lambda d: concatenate([]), r"nothing to concatenate"),
        (lambda d: Demonstration.from_pairs(np.zeros((1, 3)), np.zeros((1, 2))), r"one shape, got \(1, 3\)"),
        (lambda d: write_trajectories(io.StringIO(), d, PLAIN, ids=["x"]), r"1 ids were given for 2"),
        (lambda d: write_trajectories(io.StringIO(), d, PLAIN, agents=[1]), r"1 agents were given for 2"),
    ],
)
def test_impossible_requests_are_refused(act, message):
    demo = Demonstration.from_steps([["hidden"] * 3, [None]], PLAIN)
    with pytest.raises(ValueError, match=message):
        act(demo)


def test_pairs_fill_one_trajectory_or_many():
    one = Demonstration.from_pairs(np.array([0, 1]), np.array([1, 0]))
    assert one.kind.shape == (1, 2)
    two = Demonstration.from_pairs(np.array([[0, 1], [2, 2]]), np.zeros((2, 2)))
    assert_same(two.select([0])[1:2], (np.array([[0, 1]]),))


def test_buckets_are_powers_of_two():
    demo = Demonstration.from_steps([["hidden"] * 5] * 3, PLAIN)
    assert demo.bucketed().kind.shape == (4, 8)
    assert demo.bucketed().bucketed().kind.shape == (4, 8)
    np.testing.assert_array_equal(demo.bucketed().lengths, [5, 5, 5, 0])


step = st.one_of(
    st.just("hidden"),
    st.none(),
    st.fixed_dictionaries(
        {"s": st.integers(0, S - 1)},
        optional={"a": st.integers(0, A - 1), "score": st.floats(0, 1)},
    ),
    st.fixed_dictionaries({"a": st.sampled_from(NAMES["actions"])}),
)
demonstrations = st.lists(st.lists(step, min_size=1, max_size=6), min_size=1, max_size=5).map(
    lambda rows: Demonstration.from_steps(rows, NAMED)
)


@given(demo=demonstrations, named=st.booleans(), rows=st.integers(0, 2))
def test_what_is_written_reads_back_the_same(demo, named, rows):
    mdp, file = NAMED if named else PLAIN, io.StringIO()
    n = demo.n_trajectories
    # Rows of padding are no trajectories: they leave no line.
    padded = demo.padded(n + rows, demo.kind.shape[1] + rows)
    write_trajectories(
        file, padded, mdp, ids=[f"t{i}" for i in range(n + rows)], agents=list(range(n + rows))
    )
    records = read(file.getvalue(), mdp)
    assert [record.id for record in records] == [f"t{i}" for i in range(n)]
    assert [record.agent for record in records] == list(range(n))
    assert_same(concatenate([record.demonstration for record in records]), demo)


def test_names_are_written_where_the_mdp_has_them():
    demo, file = Demonstration.from_pairs(np.array([1]), np.array([0])), io.StringIO()
    write_trajectories(file, demo, NAMED)
    assert json.loads(file.getvalue()) == {"steps": [{"s": "table", "a": "grasp"}]}


@given(demo=demonstrations, size=st.integers(1, 7))
def test_sessions_joined_again_are_the_demonstration(demo, size):
    sessions = list(demo.sessions(size))
    assert all(session.n_trajectories == size for session in sessions[:-1])
    assert_same(concatenate(sessions), demo)


@given(demo=demonstrations, length=st.integers(1, 7))
def test_fragments_hold_every_step_once_in_order(demo, length):
    fragments = demo.fragments(length)
    assert fragments.lengths.max() <= length
    assert fragments.lengths.min() >= 1
    for before, after in zip(demo, fragments, strict=True):
        np.testing.assert_array_equal(before[demo.kind != PAD], after[fragments.kind != PAD])
    assert fragments.n_trajectories == sum(-(-total // length) for total in demo.lengths)


@given(demo=demonstrations)
def test_codes_carry_all_but_the_scores(demo):
    assert_same(Demonstration.from_codes(demo.codes)[:3], demo[:3])
    assert np.isnan(Demonstration.from_codes(demo.codes).score).all()
