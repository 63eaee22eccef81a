"""Demonstrations: reading, writing, cutting and joining, and refusals that name the record."""

from __future__ import annotations

import doctest
import io
import json
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import i2rl.models
from i2rl.domains.labyrinth.process import mouse_labyrinth, read_bouts
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    TabularMDP,
    concatenate,
    read_trajectories,
    write_trajectories,
)
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN, LineLimits

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
    for a, b in zip(one.arrays, two.arrays, strict=True):
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
        r"log, line 2, step 1: unknown state 'floor'; known are 'bin'",
    ),
    "unknown action": (
        '[{"a": "throw"}]\n',
        r"log, line 2, step 0: unknown action 'throw'; known are 'grasp'",
    ),
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
    np.testing.assert_array_equal(two.select([0]).state, [[0, 1]])


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
    for before, after in zip(demo.arrays, fragments.arrays, strict=True):
        np.testing.assert_array_equal(before[demo.kind != PAD], after[fragments.kind != PAD])
    assert fragments.n_trajectories == sum(-(-total // length) for total in demo.lengths)


@given(demo=demonstrations)
def test_codes_carry_all_but_the_scores(demo):
    for a, b in zip(Demonstration.from_codes(demo.codes).arrays[:3], demo.arrays[:3], strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isnan(Demonstration.from_codes(demo.codes).score).all()


# -- arrays -----------------------------------------------------------------------------------------------

STATES, ACTIONS = [[0, 1, 2], [2, 0, 0]], [[1, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize("build", [Demonstration.from_pairs, Demonstration.from_arrays])
@pytest.mark.parametrize("part", ["states", "actions"])
@pytest.mark.parametrize(
    ("value", "shown"),
    [(2**40, "1099511627776"), (0.9, "0.9"), (np.nan, "nan"), (-1, "-1"), (10**400, "inf")],
)
def test_numbers_that_are_no_index_are_refused_by_trajectory_and_step(build, part, value, shown):
    arrays = {"states": STATES, "actions": ACTIONS}
    arrays[part] = [arrays[part][0], [0, value, 0]]
    with pytest.raises(
        DemonstrationError, match=rf"trajectory 1, step 1: {part} must be whole numbers .*; got {shown}"
    ):
        build(**arrays)


@pytest.mark.parametrize(
    ("states", "error", "message"),
    [
        (
            np.zeros((1, 1, 1), int),
            ValueError,
            r"shape \[n, L\] or \[L\] with at least one step, got \(1, 1, 1\)",
        ),
        (np.zeros((), int), ValueError, r"got \(\)"),
        (np.zeros((2, 0), int), ValueError, r"at least one step, got \(2, 0\)"),
        ([[0, 1], [2]], ValueError, "rows of different lengths: pad them and give lengths"),
        (["bin", "eye"], TypeError, r"states must be numbers; got <U3 \(from_steps takes names\)"),
        (np.array([True, False]), TypeError, "states must be numbers; got bool"),
        (np.array([1j]), TypeError, "states must be numbers; got complex128"),
        (None, TypeError, "states must be numbers; got object"),
        (pd.Series(["bin", None]), TypeError, "states must be numbers; got object"),
    ],
)
def test_arrays_of_something_else_are_refused(states, error, message):
    for build in (Demonstration.from_pairs, Demonstration.from_arrays):
        with pytest.raises(error, match=message):
            build(states, states)


def test_pairs_do_not_hide_what_is_masked():
    masked = np.ma.masked_equal(STATES, 1)
    with pytest.raises(DemonstrationError, match=r"trajectory 0, step 1: .* must not be missing; from_arr"):
        Demonstration.from_pairs(masked, ACTIONS)
    with pytest.raises(DemonstrationError, match="got -1; from_arrays takes hidden steps"):
        Demonstration.from_pairs([[-1]], [[0]])


HIDDEN_DEMO = Demonstration.from_steps([[(0, 1), "hidden", (2, 0)], [(2, None), (0, 0)]], PLAIN)


def columns(fill):
    """Return the states and actions of ``HIDDEN_DEMO``, with a value at hidden steps."""
    return [[0, fill, 2], [2, 0, fill]], [[1, fill, 0], [fill, 0, fill]]


@pytest.mark.parametrize(
    "case",
    {
        "a number for missing": (lambda x: x, -1, {"missing": -1}),
        "NaN for missing": (np.array, np.nan, {"missing": np.nan}),
        "masked": (lambda x: np.ma.masked_equal(x, 9), 9, {}),
        "rows of masked": (lambda x: [np.ma.masked_equal(row, 9) for row in x], 9, {}),
        "pandas' integers": (lambda x: pd.DataFrame(x, dtype="Int64"), pd.NA, {}),
        "pandas' floats": (lambda x: pd.DataFrame(x), np.nan, {}),
        "pandas' objects": (lambda x: pd.DataFrame(x, dtype=object), None, {}),
        "JAX": (jnp.array, -1, {"missing": -1}),
        "short integers": (lambda x: np.array(x, np.uint8), 255, {"missing": 255}),
    }.items(),
    ids=lambda case: case[0],
)
def test_hidden_steps_may_be_missing_in_arrays_of_any_library(case):
    _, (array, fill, options) = case
    states, actions = columns(fill)
    demo = Demonstration.from_arrays(array(states), array(actions), lengths=[3, 2], **options)
    assert_same(demo, HIDDEN_DEMO)
    assert [x.dtype for x in demo.arrays] == [np.int8, np.int32, np.int32, float]


def test_what_is_not_seen_lost_or_beyond_the_end_is_not_looked_at():
    junk = 10**30
    demo = Demonstration.from_arrays(
        [[0, junk, -7, junk], [1, 2, 0, 1]],
        [[1, np.nan, 0.5, junk], [0, 1, 0, 1]],
        seen=np.array([[True, False, True, True], [True] * 4]),
        lost=np.array([[False, False, True, False], [False] * 4]),
        lengths=np.array([3, 4]),
        scores=[[0.5, 7, 7, 7], [np.nan, 1, 0, 0.25]],
    )
    np.testing.assert_array_equal(demo.kind, [[SEEN, HIDDEN, LOST, PAD], [SEEN] * 4])
    np.testing.assert_array_equal(demo.state, [[0, -1, -1, -1], [1, 2, 0, 1]])
    np.testing.assert_array_equal(demo.action, [[1, -1, -1, -1], [0, 1, 0, 1]])
    np.testing.assert_array_equal(demo.score, [[0.5, np.nan, np.nan, np.nan], [np.nan, 1, 0, 0.25]])


def test_a_series_is_one_trajectory():
    states = pd.Series([0, None, 2], dtype="Int32", index=[7, 8, 9])
    demo = Demonstration.from_arrays(states, pd.Series([1, 0, 1]), seen=[True, False, True])
    np.testing.assert_array_equal(demo.kind, [[SEEN, HIDDEN, SEEN]])
    half = Demonstration.from_arrays(states, pd.Series([1, 0, 1]))
    np.testing.assert_array_equal(half.kind, [[SEEN, SEEN, SEEN]])
    np.testing.assert_array_equal(half.action, [[1, 0, 1]])
    assert half.state[0, 1] == UNKNOWN


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"seen": [[1, 1, 1]] * 2}, ValueError, r"seen must be booleans \[2, 3\]; got int64 \[2, 3\]"),
        ({"lost": np.zeros((2, 2), bool)}, ValueError, r"lost must be booleans \[2, 3\]; got bool \[2, 2\]"),
        ({"lengths": [3]}, ValueError, r"lengths must be integers \[2\]; got int64 \[1\]"),
        ({"lengths": [3, 4]}, ValueError, r"lengths must lie between 0 and 3; got 4 \(trajectory 1\)"),
        ({"lengths": [3.0, 2.0]}, ValueError, r"lengths must be integers \[2\]; got float64"),
        ({"scores": np.ones(3)}, ValueError, r"scores must have shape \(2, 3\), got \(1, 3\)"),
        (
            {"scores": [[0, 0, 0], [0, 1.5, 0]]},
            DemonstrationError,
            r"trajectory 1, step 1: scores .* got 1\.5",
        ),
        (
            {"missing": 0, "seen": np.ones((2, 3), bool), "actions": STATES},
            DemonstrationError,
            "trajectory 0, step 0: a seen step must have a state or an action",
        ),
        ({"actions": [[0, 1]]}, ValueError, r"one shape, got \(2, 3\) and \(1, 2\)"),
    ],
)
def test_masks_lengths_and_scores_are_checked(options, error, message):
    arrays = {"states": STATES, "actions": ACTIONS} | options
    with pytest.raises(error, match=message):
        Demonstration.from_arrays(**arrays)


@given(demo=demonstrations, missing=st.sampled_from([-1, -7, 2**31, 1e300]))
def test_arrays_hold_all_that_a_demonstration_does(demo, missing):
    states, actions = (np.where(x == UNKNOWN, np.float64(missing), x) for x in (demo.state, demo.action))
    again = Demonstration.from_arrays(
        states, actions, lost=demo.kind == LOST, lengths=demo.lengths, scores=demo.score, missing=missing
    )
    assert_same(again, demo)


def test_a_trajectory_in_code_may_be_an_array_of_pairs():
    pairs = np.array([[0, 1], [2, 0]])
    expected = Demonstration.from_pairs([[0, 2]], [[1, 0]])
    for rows in ([pairs], pairs[None], [pairs.tolist()], [list(pairs)], (x for x in [pairs])):
        assert_same(Demonstration.from_steps(rows, NAMED), expected)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("hidden", "trajectories must be a list of lists of steps; got a str: 'hidden'"),
        (3, "trajectories must be a list of lists of steps; got a int: 3"),
        (HIDDEN_DEMO, "trajectories must be a list of lists of steps; got a Demonstration"),
        (["hidden"], r"a trajectory must be a list of steps .*; got 'hidden' \(trajectory 0\)"),
        ([[None], {"s": 1}], r"a trajectory must be a list of steps .*; got {'s': 1} \(trajectory 1\)"),
        ([5], r"a trajectory must be a list of steps .*; got 5 \(trajectory 0\)"),
    ],
)
def test_what_is_no_list_of_lists_of_steps_is_refused(steps, message):
    with pytest.raises(TypeError, match=message):
        Demonstration.from_steps(steps, NAMED)


def test_a_domain_is_no_mdp_but_has_one():
    with pytest.raises(TypeError, match="mdp must be a TabularMDP; got a Labyrinth; pass its mdp"):
        Demonstration.from_steps([["hidden"]], mouse_labyrinth())


# -- writing ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "ids", [np.arange(2), pd.Series([0, 1], index=[5, 6]), ["0", "1"], np.array(["0", "1"])]
)
def test_ids_may_be_numbers_of_any_library(ids):
    demo, file = Demonstration.from_pairs(STATES, ACTIONS), io.StringIO()
    write_trajectories(file, demo, NAMED, ids=ids, agents=np.array([3, 4], np.uint8))
    assert [(r.id, r.agent) for r in read(file.getvalue())] == [("0", 3), ("1", 4)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ids": [0.5, 1.5]}, r"ids must be text or integers; got 0\.5 \(trajectory 0\)"),
        ({"ids": ["a", None]}, r"ids must be text or integers; got None \(trajectory 1\)"),
        ({"agents": [0, 1.5]}, r"agents must be integers; got 1\.5 \(trajectory 1\)"),
        ({"agents": ["0", "1"]}, r"agents must be integers; got '0' \(trajectory 0\)"),
        ({"file": "out.jsonl"}, r"file must be a file open for writing text; got 'out\.jsonl'"),
    ],
)
def test_ids_agents_and_files_of_another_type_are_refused(options, message):
    arguments = {"file": io.StringIO(), "demonstration": Demonstration.from_pairs(STATES, ACTIONS)} | options
    with pytest.raises(TypeError, match=message):
        write_trajectories(**arguments, mdp=NAMED)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("state", 3, "state 3 is out of range; indices run from 0 to 2"),
        ("action", 2, "action 2 is out of range"),
        ("score", 1.5, r"score must lie in \[0, 1\], got 1\.5"),
        ("kind", PAD, r"kind must be 1 \(seen\), 2 \(hidden\) or 3 \(lost\) before padding; got 0"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(field, value, message):
    demo, file = Demonstration.from_pairs(STATES, ACTIONS), io.StringIO()
    getattr(demo, field)[1, 0] = value
    with pytest.raises(DemonstrationError, match=rf"trajectory 1, step 0: {message}"):
        write_trajectories(file, demo, NAMED)
    assert len(read(file.getvalue())) == 1


# -- hostile lines ----------------------------------------------------------------------------------------

LONG = "x" * 10**6


@pytest.mark.parametrize("reader", ["trajectories", "bouts"])
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[" * 1000, "nested too deeply|not valid JSON"),
        ('{"steps": ' * 10**5, "nested too deeply"),
        ('[{"s": ' + "1" * 4301 + "}]", "an integer of more than 4300 digits"),
        ('{"id": 1, "id": 2}', "the field 'id' stands twice in one object"),
        ('{"' + LONG + '": 1, "' + LONG + '": 2}', r"the field 'x+\.\.\.x+' stands twice"),
        ("\x00", "not valid JSON at character 1"),
        ('["hidden"]\x00', "not valid JSON at character 11"),
        ("\ufeff[]", "not valid JSON at character 1: Unexpected UTF-8 BOM"),
        (b'["\xff"]', "not UTF-8 text at byte 3"),
        ("[" + "9" * 10**7, "a line must have at most 4,194,304 bytes; it has 10,000,001 or more"),
        ('{"steps": [' + "null," * 10**4 + 'null], "nodes": [' + "0," * 10**4 + "0]}", "field|at most 10000"),
        (f'["{LONG}"]', "a step is|a bout is"),
        (f'{{"{LONG}": 1, "nodes": [0], "steps": []}}', "unknown field '(nodes|steps)'"),
        (f'{{"{LONG}": 1, "nodes": [0]}}', r"unknown field '(x+\.\.\.x+|nodes)'"),
    ],
    ids=range(14),
)
def test_hostile_lines_are_refused_by_file_and_line_in_a_short_message(reader, line, message):
    blank = "\n" if isinstance(line, str) else b"\n"
    records = (
        read_bouts([blank, line], "log")
        if reader == "bouts"
        else read_trajectories([blank, line], NAMED, "log")
    )
    with pytest.raises(DemonstrationError, match=message) as caught:
        list(records)
    assert str(caught.value).startswith("log, line 2")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "step",
    [
        f'"{LONG}"',
        f'{{"s": "{LONG}"}}',
        f'{{"{LONG}": 1}}',
        f'{{"a": [{LONG.replace("x", "1,")}1]}}',
        '{"s": ' + "1" * 4000 + "}",
        '{"s": 0, "score": ' + "1" * 4000 + "}",
        '{"s": "\\ud800\\u001b[31m"}',
    ],
    ids=range(7),
)
def test_what_a_message_quotes_is_cut_and_escaped(step):
    with pytest.raises(DemonstrationError, match="log, line 1, step 1: ") as caught:
        read(f"[null, {step}]", source="log")
    assert len(str(caught.value)) < 250
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("line", ['{"id": [1], "steps": [null]}', '{"id": "\\ud800", "steps": [null]}'])
def test_an_id_is_text(line):
    with pytest.raises(DemonstrationError, match="line 1: id must be text, got"):
        read(line)


def test_limits_can_be_raised_and_lowered():
    line = json.dumps([{"s": 0, "a": 1}] * 20)
    assert read(line, limits=LineLimits(len(line), 20))[0].demonstration.kind.shape == (1, 20)
    with pytest.raises(DemonstrationError, match="at most 19 steps; it has 20: write shorter"):
        read(line, limits=LineLimits(len(line), 19))
    with pytest.raises(DemonstrationError, match=f"at most {len(line) - 1:,} bytes; it has {len(line):,}"):
        read(line, limits=LineLimits(len(line) - 1, 20))


def test_bytes_and_a_byte_order_mark_are_read():
    lines = [b'\xef\xbb\xbf["hidden"]\n', b'[{"s": "bin"}]\n']
    assert [r.line for r in read_trajectories(lines, NAMED)] == [1, 2]
    with pytest.raises(DemonstrationError, match="line 5: not valid JSON at character 1"):
        list(read_trajectories(lines, NAMED, first_line=5))


def test_a_file_that_is_not_text_is_named(tmp_path):
    (tmp_path / "log").write_bytes(b'["hidden"]\n["\xe9"]\n')
    with (
        open(tmp_path / "log", encoding="utf-8") as file,
        pytest.raises(DemonstrationError, match=r"log, line 1 or later: not UTF-8 text \(byte 0xe9\)"),
    ):
        list(read_trajectories(file, NAMED, "log"))


@pytest.mark.parametrize("lines", ["demos.jsonl", b"[]", Path("demos.jsonl")])
def test_lines_are_not_a_name(lines):
    with pytest.raises(TypeError, match="lines must be an open file or a list of lines; got"):
        list(read_trajectories(lines, NAMED))
    with pytest.raises(TypeError, match=r"lines must be lines of text; got \{\} \(input, line 1\)"):
        list(read_trajectories([{}], NAMED))


def test_the_examples_run():
    for module in (i2rl.models.observation.demonstration, i2rl.models.inputs.text):
        assert doctest.testmod(module).failed == 0


# -- a container of trajectories ------------------------------------------------------------------------


@given(demo=demonstrations)
def test_a_demonstration_is_as_long_as_its_trajectories_are_many(demo):
    assert len(demo) == demo.n_trajectories == len(list(demo))
    assert_same(concatenate(list(demo)), demo)
    for i, one in enumerate(demo):
        assert len(one) == 1
        np.testing.assert_array_equal(one.kind[0], demo.kind[i])
        assert_same(one, demo[i])
        assert_same(one, demo[i - len(demo)])


def test_trajectories_are_selected_as_rows_of_an_array_are():
    demo = Demonstration.from_pairs(np.arange(12).reshape(4, 3), np.zeros((4, 3)))
    mask = np.array([True, False, False, True])
    backward = slice(None, None, -1)
    for rows in (slice(1, None), backward, [2, 0, 0], mask, mask.tolist(), np.array([], int), []):
        chosen = np.zeros(0, int) if isinstance(rows, list) and not rows else rows
        for whole, part in zip(demo.arrays, demo[rows].arrays, strict=True):
            np.testing.assert_array_equal(part, whole[chosen])
    assert_same(demo[np.int64(2)], demo.select([2]))


@pytest.mark.parametrize(
    ("rows", "error", "named"),
    [
        (3, IndexError, "0 to 2; got 3"),
        (-4, IndexError, "0 to 2; got -4"),
        ([0, 7], IndexError, "got 7"),
        ([True, False], IndexError, "a mask of 3 trajectories has as many entries; got 2"),
        ("kind", TypeError, "a number, a slice, a mask .* got 'kind'"),
        (1.5, TypeError, "got 1.5"),
        (None, TypeError, "got None"),
        (True, TypeError, "got True"),
        ((0, 1, [2]), TypeError, "a number, a slice"),
    ],
)
def test_what_selects_no_trajectories_is_refused(rows, error, named):
    demo = Demonstration.from_pairs(np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(error, match=named):
        demo[rows]


def test_a_demonstration_is_a_tree_of_its_arrays_and_survives_a_pickle():
    demo = Demonstration.from_pairs([[0, 1]], [[1, 0]])
    paths = [jax.tree_util.keystr(p, simple=True) for p, _ in jax.tree_util.tree_leaves_with_path(demo)]
    assert paths == ["kind", "state", "action", "score"]
    assert_same(pickle.loads(pickle.dumps(demo)), demo)
    assert_same(jax.jit(lambda d: d)(demo), demo)
    assert jax.jit(lambda d: len(d) * d.state.sum())(demo) == 1
    with pytest.raises(AttributeError):
        demo.kind = None


def test_a_demonstration_does_not_become_an_array_of_something():
    with pytest.raises(TypeError, match="its attribute `codes` is one"):
        np.asarray(Demonstration.from_pairs([[0, 1]], [[1, 0]]))
