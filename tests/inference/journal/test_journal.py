import hashlib
import json
import os
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
import textwrap
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import arviz
import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.inference.journal.journal import (
    APPLICATION_ID,
    SCHEMA_VERSION,
    SESSION_BYTES,
    Journal,
    JournalBusy,
    JournalError,
    Origin,
    Position,
)
from i2rl.inference.sessions.serialization import MOST_LEAVES, decode, encode, restore
from i2rl.models import TabularMDP

# -- a learner small enough to compute by hand ----------------------------------------------------------


class Statistic(NamedTuple):
    counts: Any
    total: Any


class State(NamedTuple):
    weights: Any
    statistic: Statistic
    warm: Any
    session: Any
    key: Any


class SessionInfo(NamedTuple):
    log_likelihood: Any
    gap: Any
    status: str
    found: Any


class Toy(NamedTuple):
    """Adds noise to a demonstration's counts: what it learns depends on every bit of its state."""

    mdp: TabularMDP
    name: str = "toy"
    step: float = 0.5

    @property
    def configuration(self) -> dict[str, Any]:
        return {"step": self.step}

    @property
    def signature(self) -> str:
        return f"{self.mdp.fingerprint()}-{self.name}-{self.step}"

    def init(self, key: Any) -> State:
        k = self.mdp.n_features
        return State(jnp.zeros(k), Statistic(jnp.zeros(k), 0.0), jnp.zeros((0, k)), 0, key)

    def update(self, state: State, counts: Any) -> tuple[State, SessionInfo]:
        key, noise = jax.random.split(state.key)
        weights = state.weights + self.step * (counts + jax.random.normal(noise, state.weights.shape))
        statistic = Statistic(state.statistic.counts + counts, state.statistic.total + 1 / 3)
        session = state.session + 1
        found = None if session == 1 else np.arange(session)
        report = SessionInfo(-weights.sum(), weights**2, "converged", found)
        return State(weights, statistic, jnp.outer(weights, weights), session, key), report


def process(seed: int = 0, feature_names: list[str] | None = None) -> TabularMDP:
    rng = np.random.default_rng(seed)
    transitions = rng.dirichlet(np.ones(3), size=(3, 2))
    return TabularMDP.from_dense(transitions, rng.normal(size=(3, 2, 2)), feature_names=feature_names)


@pytest.fixture
def learner() -> Toy:
    return Toy(process(feature_names=["near", "far"]))


def learned(learner: Toy, sessions: int, state: State | None = None) -> list[tuple[State, SessionInfo]]:
    state = learner.init(jax.random.key(7)) if state is None else state
    history = []
    for _ in range(sessions):
        state, report = learner.update(state, jnp.arange(2.0) + state.session)
        history.append((state, report))
    return history


def committed(path: Path, learner: Toy, sessions: int) -> None:
    with Journal.open(path, learner) as journal:
        for state, report in learned(learner, sessions):
            journal.commit(state, report)


def bits(tree: Any) -> list[tuple]:
    """List everything that distinguishes two trees: containers, types, shapes and bits."""

    def of(leaf: Any) -> tuple:
        if isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf, kind = jax.random.key_data(leaf), str(leaf.dtype)
        else:
            kind = type(leaf).__name__
        array = np.asarray(leaf)
        return kind, array.dtype.str, array.shape, repr(leaf) if leaf is None else array.tobytes()

    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda leaf: leaf is None)
    return [str(structure), *map(of, leaves)]


# -- the bytes ------------------------------------------------------------------------------------------


def test_a_nested_state_comes_back_to_the_bit() -> None:
    payload = np.array([0x7FF8_0000_DEAD_BEEF, 0xFFF0_0000_0000_0001, 0x8000_0000_0000_0000, 1], np.uint64)
    tree = State(
        weights=payload.view(float),
        statistic=Statistic(
            jnp.asarray(payload.view(float)), {"mask": np.array([[True, False]]), "none": None}
        ),
        warm=[
            np.int8(-7),
            np.zeros((0, 3), np.int16),
            np.arange(6).reshape(2, 3).T,
            (1, 2.5, True, 1j),
            "über",
            jnp.bfloat16(1.5),
        ],
        session=2**63,
        key=(jax.random.key(3), jax.random.split(jax.random.key(3, impl="rbg"), 4), np.float32(0.1)),
    )
    assert bits(restore(decode(encode(tree)), tree)) == bits(tree)


dtypes = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(),
    hnp.unsigned_integer_dtypes(),
    hnp.floating_dtypes(sizes=(16, 32, 64)),
    hnp.complex_number_dtypes(sizes=(64, 128)),
    hnp.unicode_string_dtypes(max_len=3),
    hnp.datetime64_dtypes(),
)
numbers = hnp.arrays(dtypes, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
leaves = st.one_of(
    numbers,
    numbers.map(lambda array: array.T),
    hnp.arrays(np.float64, 3).map(jnp.asarray),
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.text(max_size=4),
    st.integers(0, 9).map(jax.random.key),
)
trees = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.builds(Statistic, inner, inner),
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from("abcd"), inner, max_size=3),
    ),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(trees)
def test_any_tree_comes_back_to_the_bit(tree: Any) -> None:
    blob = encode(tree)
    assert bits(restore(decode(blob), tree)) == bits(tree)
    assert encode(tree) == blob


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_flipped_bit_or_lost_end_goes_unnoticed(data: st.DataObject) -> None:
    blob = bytearray(encode({"weights": np.arange(3.0), "session": 4}))
    where = data.draw(st.integers(0, len(blob) - 1))
    if data.draw(st.booleans()):
        blob[where] ^= 1 << data.draw(st.integers(0, 7))
    else:
        del blob[where:]
    with pytest.raises(ValueError, match="damaged"):
        decode(bytes(blob))


@pytest.mark.parametrize(
    "leaf", [object(), 2**70, b"bytes", np.array([None]), np.zeros(1, [("x", int)]), len]
)
def test_what_cannot_be_stored_is_named(leaf: Any) -> None:
    with pytest.raises(TypeError, match=r"^statistic\.total is "):
        encode(State(0, Statistic(1, leaf), None, 0, None))


@pytest.mark.parametrize(
    ("stored", "template"),
    [
        (np.zeros((2, 3)), np.zeros((0, 3))),
        (np.zeros((2, 3)), None),
        (jax.random.key(0), None),
        (None, None),
        (None, np.zeros((0, 3))),
        (np.int64(3), 3),
        (jnp.int32(3), 3),
        (jax.random.key(0, impl="rbg"), jax.random.key(0)),
    ],
)
def test_what_begins_with_the_first_session_may_differ_from_the_template(stored: Any, template: Any) -> None:
    assert bits(restore(decode(encode({"warm": stored})), {"warm": template})) == bits({"warm": stored})


@pytest.mark.parametrize(
    ("stored", "template"),
    [
        (np.zeros(3), np.zeros(2)),
        (np.zeros(3, np.float32), np.zeros(3)),
        (np.zeros((2, 3), int), np.zeros((0, 3))),
        (None, np.zeros(3)),
        (jax.random.split(jax.random.key(0)), jax.random.key(0)),
        (np.zeros(2, np.uint32), jax.random.key(0)),
        (jax.random.key(0), np.zeros(2, np.uint32)),
        ("text", 1.0),
        (1.0, "text"),
        (1.0, 1),
        (True, 1),
    ],
)
def test_a_leaf_that_does_not_fit_is_named(stored: Any, template: Any) -> None:
    with pytest.raises(ValueError, match=r"warm is stored as .* is expected"):
        restore(decode(encode({"warm": stored})), {"warm": template})


def test_parts_that_do_not_fit_are_named() -> None:
    with pytest.raises(ValueError, match=r"\['old'\] stored and not expected, \['new'\] expected and not"):
        restore(decode(encode({"old": 1, "both": 2})), {"new": 1, "both": 2})


# -- sessions -------------------------------------------------------------------------------------------


def test_a_learner_that_stops_and_resumes_learns_the_same_to_the_bit(learner: Toy, tmp_path: Path) -> None:
    whole = learned(learner, 6)
    state = None
    for _ in range(3):
        with Journal.open(tmp_path / "j", learner) as journal:
            assert (journal.state is None) == (state is None)
            for state, report in learned(learner, 2, journal.state):
                journal.commit(state, report)
    with Journal.open(tmp_path / "j", learner) as journal:
        assert bits(journal.state) == bits(whole[-1][0])
        assert journal.session == 6
        for (state, report), record in zip(whole, journal.records(), strict=True):
            assert record.session == state.session
            assert bits(record.weights) == bits(np.asarray(state.weights))
            assert list(record.info) == list(SessionInfo._fields)
            for name, value in report._asdict().items():
                np.testing.assert_array_equal(record.info[name], value)


def test_the_first_state_comes_from_the_learner(learner: Toy, tmp_path: Path) -> None:
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.state is None
        assert (journal.session, journal.position) == (0, Position())
        assert list(journal.records()) == []
        assert journal.stored_state() == {}


def test_a_session_is_not_committed_twice(learner: Toy, tmp_path: Path) -> None:
    (first, report), (second, _) = learned(learner, 2)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(second, report)
        for state in (first, second):
            with pytest.raises(ValueError, match=f"session {state.session} is already committed"):
                journal.commit(state, report)
        assert [record.session for record in journal.records()] == [2]


def test_the_position_is_committed_with_the_session(learner: Toy, tmp_path: Path) -> None:
    lines = ["one\n", "\n", "two\n", "thrée"]
    position = Position()
    with Journal.open(tmp_path / "j", learner) as journal:
        for line, (state, report) in zip(lines[:3], learned(learner, 3), strict=True):
            position = position.after(line)
            journal.commit(state, report, position)
        (last, report) = learned(learner, 1, journal.state)[0]
        journal.commit(last, report)
        assert [record.position.records for record in journal.records()] == [1, 2, 3, 3]
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.position == position
        assert journal.position_after(1) == Position().after("one")
        assert journal.position_after(9) is None


def test_positions_tell_lines_apart_but_not_their_ends() -> None:
    position = Position().after("one\n").after("two\r\n")
    assert position == Position().after("one").after("two")
    for other in (["one", "too"], ["onet", "wo"], ["two", "one"], ["one", "", "two"]):
        here = Position()
        for line in other:
            here = here.after(line)
        assert here != position


def test_the_file_grows_by_reports_and_not_by_states(learner: Toy, tmp_path: Path) -> None:
    (state, report) = learned(learner, 1)[0]
    heavy = state._replace(warm=jnp.ones((1000, 100)))
    sizes = []
    with Journal.open(tmp_path / "j", learner) as journal:
        for session in range(1, 41):
            journal.commit(heavy._replace(session=session), report)
            sizes.append(sum(file.stat().st_size for file in tmp_path.iterdir()))
    assert (tmp_path / "j").stat().st_size < 2.2 * heavy.warm.nbytes
    assert max(sizes) < 10 * heavy.warm.nbytes  # the log is folded in as it grows


def test_a_closed_journal_is_one_file_that_can_be_moved(learner: Toy, tmp_path: Path) -> None:
    (state, report) = learned(learner, 1)[0]
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(state, report)
    journal.close()  # again
    assert sorted(file.name for file in tmp_path.iterdir()) == ["j", "j-lock"]
    assert (tmp_path / "j-lock").stat().st_size == 0
    # Not in log mode any more (SQLite's format versions), so that it can be read in a read-only folder.
    assert (tmp_path / "j").read_bytes()[18:20] == b"\x01\x01"
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(tmp_path / "j", tmp_path / "elsewhere" / "a name with spaces?&#.i2rl")
    with Journal.open(tmp_path / "elsewhere" / "a name with spaces?&#.i2rl", learner) as journal:
        assert bits(journal.state) == bits(state)


# -- who may write --------------------------------------------------------------------------------------


def test_a_second_writer_is_refused_in_the_same_process(learner: Toy, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "j")
    with Journal.open(tmp_path / "j", learner) as journal:
        for name in ("j", "link"):
            with pytest.raises(JournalBusy, match="is open for writing in this process"):
                Journal.open(tmp_path / name, learner)
        (state, report) = learned(learner, 1)[0]
        journal.commit(state, report)  # the refusals released nothing
        with pytest.raises(JournalBusy):
            Journal.open(tmp_path / "j", learner)
    Journal.open(tmp_path / "j", learner).close()


# A writer that needs no JAX computation: it commits a counter and all that follows from it.
COUNTER = textwrap.dedent(
    """
    import os, random, signal, sys, time
    from typing import Any, NamedTuple
    import numpy as np
    from i2rl.inference.journal.journal import Journal, JournalError, Position

    class State(NamedTuple):
        weights: Any
        statistic: Any
        session: int

    class Report(NamedTuple):
        square: int

    class MDP:
        n_states, n_actions, feature_names = 2, 2, ("x", "y")
        def fingerprint(self):
            return "f" * 64

    class Counter:
        name, signature, mdp, configuration = "counter", "s", MDP(), {}
        def init(self, key):
            return State(np.zeros(2), np.zeros(3000), 0)

    learner = Counter()

    def after(session):
        return State(np.arange(2.0) * session, np.arange(3000.0) + session, session)

    def position(session):
        here = Position()
        for i in range(session):
            here = here.after(f"line {i}")
        return here

    def run(path, sessions):
        with Journal.open(path, learner) as journal:
            here = journal.position
            for session in range(journal.session + 1, sessions + 1):
                here = here.after(f"line {session - 1}")
                journal.commit(after(session), Report(session**2), here)
    """
)


def child(script: str, *arguments: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", COUNTER + textwrap.dedent(script), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.PIPE,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )


def test_a_second_writer_is_refused_in_another_process_until_the_first_is_killed(tmp_path: Path) -> None:
    first = child(
        """
        journal = Journal.open(sys.argv[1], learner)
        journal.commit(after(1), Report(1))
        print("open", flush=True)
        sys.stdin.read()
        """,
        tmp_path / "j",
    )
    assert first.stdout.readline() == "open\n"
    with pytest.raises(JournalBusy, match=f"{tmp_path / 'j'} is open for writing in process {first.pid} on "):
        Journal.open(tmp_path / "j", Toy(process()))
    with Journal.read(tmp_path / "j") as view:  # but it may be looked at
        assert view.session == 1
    first.kill()
    first.communicate()
    with pytest.raises(JournalError, match="is a journal of method 'counter'") as refused:
        Journal.open(tmp_path / "j", Toy(process()))
    assert not isinstance(refused.value, JournalBusy)


def test_a_view_sees_sessions_as_they_are_committed(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 3)
    with Journal.open(tmp_path / "j", learner) as journal, Journal.read(tmp_path / "j") as view:
        assert view.session == 0
        for state, report in history:
            reading = view.records()
            journal.commit(state, report, Position().after("line"))
            assert len(list(reading)) == view.session == state.session
            assert view.position == journal.position
            np.testing.assert_array_equal(view.stored_state()["statistic.counts"], state.statistic.counts)
        assert view.origin == journal.origin
        assert view.origin.method == "toy"
        with pytest.raises(AttributeError):
            view.commit(*history[0])
    with Journal.read(tmp_path / "j") as view:
        assert view.session == 3


FILES = ["", "-wal", "-shm", "-lock"]


@pytest.mark.parametrize("suffix", FILES)
@pytest.mark.parametrize("replaced", [False, True], ids=["deleted", "replaced"])
def test_a_file_that_goes_away_is_noticed_at_the_next_commit(
    suffix: str, replaced: bool, learner: Toy, tmp_path: Path
) -> None:
    history = learned(learner, 3)
    file = tmp_path / f"j{suffix}"
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        copy = file.read_bytes()
        file.unlink()
        if replaced:
            file.write_bytes(copy)
        for attempt in history[1:]:
            with pytest.raises(
                JournalError, match=f"{file} was deleted or replaced .*; 1 sessions were before"
            ):
                journal.commit(*attempt)
        assert bits(journal.state) == bits(history[0][0])
    if suffix != "":  # what was committed is still there
        with Journal.open(tmp_path / "j", learner) as journal:
            assert bits(journal.state) == bits(history[0][0])
            journal.commit(*history[1])


def test_a_lock_file_that_is_deleted_lets_no_second_writer_in(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 3)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        (tmp_path / "j-lock").unlink()
        for _ in range(2):  # also where the first attempt has made a new one
            with pytest.raises(JournalBusy, match="j is open elsewhere, and its lock file is not the one"):
                Journal.open(tmp_path / "j", learner)
        with pytest.raises(JournalError, match="j-lock was deleted or replaced"):
            journal.commit(*history[1])
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[1])
    (tmp_path / "j-lock").unlink()
    Journal.open(tmp_path / "j", learner).close()  # of a closed journal it is not missed


def test_what_another_program_writes_is_noticed_at_the_next_commit(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 2)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        damaged(tmp_path / "j", "UPDATE state SET sessions = 5")
        with pytest.raises(
            JournalError, match="j was written to by another program: session 2 was not committed"
        ):
            journal.commit(*history[1])


def test_looking_at_an_open_journal_releases_none_of_its_locks(learner: Toy, tmp_path: Path) -> None:
    # Closing any descriptor of a file releases this process's locks on it, SQLite's among them.
    script = """
        connection = sqlite3.connect(sys.argv[1], timeout=0)
        print(connection.execute("PRAGMA journal_mode=DELETE").fetchone()[0])
        """
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*learned(learner, 1)[0])
        with Journal.read(tmp_path / "j"), Journal.read(tmp_path / "j"), pytest.raises(JournalBusy):
            Journal.open(tmp_path / "j", learner)
        alone = child("import sqlite3" + textwrap.dedent(script), tmp_path / "j")
        output, errors = alone.communicate(timeout=60)
        assert "database is locked" in errors or output == "wal\n", (output, errors)
    with sqlite3.connect(tmp_path / "j") as connection:  # while a closed one is left by its log
        assert connection.execute("PRAGMA journal_mode=DELETE").fetchone() == ("delete",)
    connection.close()


def test_a_reader_beside_a_writer_never_meets_half_a_page(tmp_path: Path) -> None:
    writer = child(
        """
        with Journal.open(sys.argv[1], learner) as journal:
            journal._connection.execute("PRAGMA wal_autocheckpoint=1")
            print("open", flush=True)
            session = 0
            while not os.path.exists(sys.argv[1] + "-enough"):
                session += 1
                journal.commit(after(session), Report(session**2))
        """,
        tmp_path / "j",
    )
    assert writer.stdout.readline() == "open\n"
    seen = []
    for _ in range(150):
        with Journal.read(tmp_path / "j") as view:
            seen.append(view.session)
            assert all(record.info["square"] == record.session**2 for record in view.records(last=2))
    (tmp_path / "j-enough").touch()
    _, errors = writer.communicate(timeout=60)
    assert writer.returncode == 0, errors
    assert seen == sorted(seen)
    assert seen[-1] > seen[0]


# -- what is refused ------------------------------------------------------------------------------------


def snapshot(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.mark.parametrize(
    "kind", ["text", "short text", "zeros", "database", "database with a log", "a folder", "a pipe"]
)
def test_what_is_no_journal_is_left_as_it_was(kind: str, learner: Toy, tmp_path: Path) -> None:
    path = tmp_path / "j"
    foreign = None
    if kind == "text":
        path.write_text("my thesis\n" * 200)
    elif kind == "short text":
        path.write_text("SQLite")
        path.with_name("j-journal").write_text("my journal\n")
    elif kind == "zeros":
        path.write_bytes(bytes(4096))
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    else:
        foreign = sqlite3.connect(path)
        if kind == "database with a log":
            foreign.execute("PRAGMA journal_mode=WAL")
        foreign.execute("CREATE TABLE session (number INTEGER)")
        foreign.commit()
    before = snapshot(tmp_path)
    for refused in (lambda: Journal.open(path, learner), lambda: Journal.read(path)):
        with pytest.raises(JournalError, match=re.escape(str(path))):
            refused()
    assert snapshot(tmp_path) == before


def test_a_newer_journal_is_left_as_it_was(learner: Toy, tmp_path: Path) -> None:
    Journal.open(tmp_path / "j", learner).close()
    with sqlite3.connect(tmp_path / "j") as connection:
        assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION_ID,)
        assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        connection.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
    connection.close()
    before = snapshot(tmp_path)
    for refused in (lambda: Journal.open(tmp_path / "j", learner), lambda: Journal.read(tmp_path / "j")):
        with pytest.raises(JournalError, match=f"newer i2rl .*version {SCHEMA_VERSION + 1}.*update i2rl"):
            refused()
    assert snapshot(tmp_path) == before


def test_a_journal_of_something_else_is_left_as_it_was(learner: Toy, tmp_path: Path) -> None:
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*learned(learner, 1)[0])
    before = snapshot(tmp_path)
    print_of = learner.mdp.fingerprint()[:12]
    others = {
        rf"is a journal of method 'toy' on an MDP with 3 states, 2 actions and 2 features "
        rf"\(fingerprint {print_of}\).*what differs: MDP$": learner._replace(mdp=process(1)),
        "this learner is method 'lme'.*what differs: method$": learner._replace(name="lme"),
        r"what differs: step \(0.5 there, 0.25 here\)$": learner._replace(step=0.25),
    }
    for message, other in others.items():
        with pytest.raises(JournalError, match=message):
            Journal.open(tmp_path / "j", other)
        assert snapshot(tmp_path) == before
    Journal.open(tmp_path / "j", learner).close()  # nothing is still locked


def test_a_state_of_another_form_is_refused(learner: Toy, tmp_path: Path) -> None:
    class Changed(Toy):
        def init(self, key: Any) -> Any:
            return super().init(key)._replace(weights=jnp.zeros(5))

    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*learned(learner, 1)[0])
    with pytest.raises(
        JournalError, match=r"weights is stored as float64\[2\] where float64\[5\] is expected"
    ):
        Journal.open(tmp_path / "j", Changed(*learner))


def test_a_missing_journal_or_folder_is_named(learner: Toy, tmp_path: Path) -> None:
    with pytest.raises(JournalError, match=r"/j does not exist"):
        Journal.read(tmp_path / "j")
    with pytest.raises(JournalError, match=r"there is no folder .*/nowhere"):
        Journal.open(tmp_path / "nowhere" / "j", learner)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_named(learner: Toy) -> None:
    with pytest.raises(JournalError, match=r"/proc/j cannot be locked for writing \(is its folder read-only"):
        Journal.open("/proc/j", learner)


# -- damage ---------------------------------------------------------------------------------------------


def damaged(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path, isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    connection.close()


@pytest.fixture
def twelve(learner: Toy, tmp_path: Path) -> Path:
    """Write a closed journal of twelve sessions."""
    with Journal.open(tmp_path / "j", learner) as journal:
        for state, report in learned(learner, 12):
            journal.commit(state, report, Position(state.session, "00"), bytes([state.session]))
    return tmp_path / "j"


NESTED = "printf('%.*c', 100000, '[')"


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("DELETE FROM session WHERE number = 5", "it has 11 sessions, but its state counts 12"),
        ("DELETE FROM session WHERE number = 12", "it has 11 sessions, but its state counts 12"),
        ("DELETE FROM session", "it has 0 sessions, but its state counts 12"),
        ("DELETE FROM state", "it has 0 rows of state where one belongs"),
        ("DELETE FROM origin", "it has 0 rows of origin where one belongs"),
        ("UPDATE state SET session = 11", "its state is of session 11, but its last session is 12"),
        ("UPDATE state SET chain = zeroblob(32)", "its state is not the one that session 12 led to"),
        ("UPDATE state SET chain = 'x'", "its state does not say after which session it is"),
        ("UPDATE origin SET content = ''", "its origin cannot be read: it is not JSON"),
        ("UPDATE origin SET content = x'00'", "its origin cannot be read: it is not JSON"),
        (f"UPDATE origin SET content = {NESTED}", "its origin cannot be read: it is not JSON"),
        ("UPDATE origin SET content = '[]'", "its origin cannot be read: its fields must be method, "),
        (
            "UPDATE origin SET content = json_set(content, '$.n_states', 'three')",
            "its origin cannot be read: n_states must be of type int; got 'three'",
        ),
        (
            "UPDATE origin SET content = json_set(content, '$.feature_names', json('[1]'))",
            r"feature_names must be text; got \[1\]",
        ),
        ("UPDATE session SET weights = 'x' WHERE number = 12", "session 12 .* weights must be of type blob"),
        ("UPDATE session SET digest = 'zz' WHERE number = 12", "session 12 .* digest must be hexadecimal"),
        (
            f"UPDATE session SET report = zeroblob({SESSION_BYTES + 1}) WHERE number = 12",
            "session 12 cannot be read: report must be of type blob of at most 67,108,864 bytes",
        ),
        (
            "UPDATE session SET report = substr(report, 1, 40) WHERE number = 12",
            "session 12 cannot be read: the bytes are damaged",
        ),
        ("UPDATE session SET records = 0 WHERE number = 12", "session 12 does not follow session 11"),
        ("UPDATE session SET number = 99 WHERE number = 12", "session 99 does not follow session 11"),
        ("PRAGMA user_version = 0", "journal version 0"),
    ],
)
def test_damage_is_named_before_anything_is_shown_or_learned(
    statement: str, message: str, twelve: Path, learner: Toy
) -> None:
    damaged(twelve, statement)
    before = snapshot(twelve.parent)
    for refused in (lambda: Journal.read(twelve), lambda: Journal.open(twelve, learner)):
        with pytest.raises(JournalError, match=f"{re.escape(str(twelve))} .*{message}"):
            refused()
    assert snapshot(twelve.parent) == before


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        (
            "UPDATE session SET report = (SELECT report FROM session WHERE number = 3) WHERE number = 4",
            "session 4 does not follow session 3",
        ),
        ("UPDATE session SET committed = 1 WHERE number = 1", "session 1 does not follow the journal's"),
        ("UPDATE session SET weights = 7 WHERE number = 4", "session 4 cannot be read: weights must be"),
        (
            "DELETE FROM session WHERE number = 4; UPDATE state SET sessions = 11",
            "session 5 does not follow session 3",
        ),
    ],
)
def test_a_wrong_history_is_not_shown_as_true(
    statement: str, message: str, twelve: Path, learner: Toy
) -> None:
    damaged(twelve, *statement.split("; "))
    with Journal.read(twelve) as view:
        assert [record.session for record in view.records(last=3)] == [10, 11, 12]  # nothing else is read
        for refused in (lambda: list(view.records()), view.verify, view.to_inference_data):
            with pytest.raises(JournalError, match=message):
                refused()
    with pytest.raises(JournalError, match=message):
        Journal.open(twelve, learner)


def test_a_flipped_bit_and_swapped_rows_are_noticed(twelve: Path) -> None:
    whole = twelve.read_bytes()
    with Journal.read(twelve) as view:
        assert view.verify() == 12
        weights = list(view.records())[4].weights.tobytes()
    at = whole.index(weights)
    twelve.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
    with (
        Journal.read(twelve) as view,
        pytest.raises(JournalError, match=r"session 5 cannot be read: .*checksum"),
    ):
        view.verify()


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE state SET tree = 'text'", "the state after session 12 has another size"),
        ("UPDATE state SET tree = substr(tree, 2)", "the state after session 12 has another size"),
        (
            "UPDATE state SET tree = zeroblob(length(tree))",
            "the state after session 12 cannot be read: it is another",
        ),
        ("UPDATE state SET tree = zeroblob(100000000)", "the state after session 12 has another size"),
    ],
)
def test_a_damaged_state_is_not_learned_on_from(
    statement: str, message: str, twelve: Path, learner: Toy
) -> None:
    damaged(twelve, statement)
    with Journal.read(twelve) as view:
        assert len(list(view.records())) == 12
        with pytest.raises(JournalError, match=message):
            view.stored_state()
    with pytest.raises(JournalError, match=message):
        Journal.open(twelve, learner)


def crafted(header: bytes, content: bytes = b"", length: int | None = None) -> bytes:
    """Write a tree with this header and a right checksum."""
    body = b"i2rltree" + struct.pack("<I", len(header) if length is None else length) + header + content
    return body + hashlib.blake2b(body, digest_size=16).digest()


def entries(*leaves: Any) -> bytes:
    return json.dumps(leaves).encode()


@pytest.mark.parametrize(
    "blob",
    [
        b"",
        b"i2rltree",
        crafted(b""),
        crafted(b"[", length=2**32 - 1),
        crafted(b"{}"),
        crafted(b"7"),
        crafted(b"[" * 100_000),
        crafted(entries("leaf")),
        crafted(entries(["a", "numpy", "<f8"])),
        crafted(entries(*[["a", "numpy", "<f8", []]] * (MOST_LEAVES + 1))),
        crafted(entries(["a", "numpy", "|u1", [1]], ["a", "numpy", "|u1", [1]]), bytes(2)),
    ],
)
def test_bytes_that_nobody_encoded_are_refused_whatever_their_checksum(blob: bytes) -> None:
    with pytest.raises(ValueError, match="the bytes are damaged"):
        decode(blob)


@pytest.mark.parametrize(
    ("leaf", "size"),
    [
        ([["a"], "numpy", "<f8", []], 8),
        (["a", "object", "<f8", []], 8),
        (["a", "numpy", "|O", []], 8),
        (["a", "numpy", "V8", []], 8),
        (["a", "numpy", "f8,f8", []], 16),
        (["a", "numpy", "rubbish", []], 8),
        (["a", "numpy", "<f8", [-1]], 8),
        (["a", "numpy", "<f8", [2**70]], 8),
        (["a", "numpy", "<f8", [2**39] * 2], 8),
        (["a", "numpy", "<f8", [True]], 8),
        (["a", "numpy", "<f8", [1.0]], 8),
        (["a", "numpy", "<f8", [2]], 8),
        (["a", "numpy", "<f8", [1]], 9),
        (["a", "numpy", "<f8", [1] * 33], 8),
        (["a", "text", "<f8", [1]], 8),
        (["a", "python", "<f8", [1]], 8),
        (["a", "none", "|u1", [1]], 1),
    ],
)
def test_a_leaf_that_nobody_encoded_is_refused_whatever_its_checksum(leaf: list, size: int) -> None:
    with pytest.raises(ValueError, match="the bytes are damaged"):
        decode(crafted(entries(leaf), bytes(size)))


def test_a_key_that_is_none_is_refused() -> None:
    for kind, shape in (("key:rubbish", [2]), ("key:threefry2x32", [3])):
        leaves = decode(crafted(entries(["k", kind, "<u4", shape]), bytes(4 * shape[0])))
        with pytest.raises(ValueError, match=r"k is no random key|k is stored as"):
            restore(leaves, {"k": jax.random.key(0)})


def test_a_tree_of_too_many_leaves_and_a_report_of_too_many_bytes_are_not_written(
    learner: Toy, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="at most 20,000 leaves"):
        encode([0] * (MOST_LEAVES + 1))
    (state, report) = learned(learner, 1)[0]
    with Journal.open(tmp_path / "j", learner) as journal:
        with pytest.raises(ValueError, match="must have at most 67,108,864 bytes each"):
            journal.commit(state, report._replace(gap=np.zeros(SESSION_BYTES // 8, dtype=float)))
        journal.commit(state, report)


def test_a_journal_begun_with_a_legacy_key_goes_on_to_the_bit(learner: Toy, tmp_path: Path) -> None:
    whole = learned(learner, 3)
    state, report = whole[0]
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(state._replace(key=jax.random.key_data(state.key)), report)
    with Journal.open(tmp_path / "j", learner) as journal:
        assert bits(journal.state) == bits(state)
        assert bits(learned(learner, 2, journal.state)[-1]) == bits(whole[-1])


# -- version 1 --------------------------------------------------------------------------------------------

VERSION_1 = """
CREATE TABLE origin (id INTEGER PRIMARY KEY CHECK (id = 1), content TEXT NOT NULL);
CREATE TABLE writer (id INTEGER PRIMARY KEY CHECK (id = 1), pid INTEGER NOT NULL, host TEXT NOT NULL);
CREATE TABLE session (
    number INTEGER PRIMARY KEY, committed REAL NOT NULL, weights BLOB NOT NULL, report BLOB NOT NULL,
    records INTEGER NOT NULL, digest TEXT NOT NULL
);
CREATE TABLE state (id INTEGER PRIMARY KEY CHECK (id = 1), session INTEGER NOT NULL, tree BLOB NOT NULL);
PRAGMA application_id=1764913772;
PRAGMA user_version=1;
"""


def version_1(path: Path, learner: Toy, sessions: int) -> list[tuple[State, SessionInfo]]:
    """Write a journal as version 1 wrote it."""
    history = learned(learner, sessions)
    connection = sqlite3.connect(path)
    connection.executescript(VERSION_1)
    connection.execute("INSERT INTO origin VALUES (1, ?)", (json.dumps(Origin.of(learner)._asdict()),))
    for state, report in history:
        row = (state.session, 1e9, encode(np.asarray(state.weights)), encode(report), state.session, "00")
        connection.execute("INSERT INTO session VALUES (?, ?, ?, ?, ?, ?)", row)
        connection.execute("INSERT OR REPLACE INTO state VALUES (1, ?, ?)", (state.session, encode(state)))
    connection.commit()
    connection.close()
    return history


def test_a_journal_of_version_1_is_shown_and_goes_on(learner: Toy, tmp_path: Path) -> None:
    history = version_1(tmp_path / "j", learner, 5)
    with Journal.read(tmp_path / "j") as view:
        shown = list(view.records())
        assert (view.session, view.sessions, view.position) == (5, 5, Position(5, "00"))
    with Journal.open(tmp_path / "j", learner) as journal:
        assert bits(journal.state) == bits(history[-1][0])
        journal.commit(*learned(learner, 1, journal.state)[0])
    with Journal.read(tmp_path / "j") as view:
        assert view.verify() == 6
        for old, new in zip(shown, view.records(), strict=False):
            assert bits(old.weights) == bits(new.weights)
            assert old.position == new.position
    damaged(tmp_path / "j", "UPDATE session SET records = 7 WHERE number = 2")
    with pytest.raises(JournalError, match="session 2 does not follow session 1"):
        Journal.open(tmp_path / "j", learner)


@pytest.mark.parametrize(
    "statement", ["DELETE FROM session", "DELETE FROM session WHERE number = 5", "DELETE FROM state"]
)
def test_a_damaged_journal_of_version_1_is_refused(statement: str, learner: Toy, tmp_path: Path) -> None:
    version_1(tmp_path / "j", learner, 5)
    damaged(tmp_path / "j", statement)
    for refused in (lambda: Journal.read(tmp_path / "j"), lambda: Journal.open(tmp_path / "j", learner)):
        with pytest.raises(JournalError, match="is damaged"):
            refused()


def test_an_empty_journal_of_version_1_begins(learner: Toy, tmp_path: Path) -> None:
    version_1(tmp_path / "j", learner, 0)
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.state is None
        journal.commit(*learned(learner, 1)[0])
        assert journal.verify() == 1


# -- when things break ----------------------------------------------------------------------------------


def test_a_full_disk_keeps_what_was_committed_and_the_learner_may_go_on(tmp_path: Path) -> None:
    writer = child(
        """
        import resource
        journal = Journal.open(sys.argv[1], learner)
        for session in range(1, 4):
            journal.commit(after(session), Report(session**2), position(session))
        room = os.path.getsize(sys.argv[1] + "-wal")
        for extra in (1, 5000, 20000):  # not even one page, or not all of them
            resource.setrlimit(resource.RLIMIT_FSIZE, (room + extra, -1))
            for session in (4, 5):
                try:
                    journal.commit(after(session), Report(session**2), position(session))
                except JournalError as error:
                    print(error)
                assert journal.session == 3 and journal.position == position(3)
                assert [record.session for record in journal.records()] == [1, 2, 3]
        resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))
        journal.commit(after(5), Report(25), position(5))
        os._exit(0)  # without closing
        """,
        tmp_path / "j",
    )
    output, errors = writer.communicate(timeout=60)
    assert writer.returncode == 0, errors
    message = rf"{tmp_path / 'j'} cannot take session [45] \(what was committed up to session 3 is safe\): .*"
    assert len(re.findall(message, output)) == 6
    with Journal.read(tmp_path / "j") as view:
        assert [record.session for record in view.records()] == [1, 2, 3, 5]
        np.testing.assert_array_equal(view.stored_state()["statistic"], np.arange(3000.0) + 5)


def test_sqlite_out_of_pages_is_a_full_disk_too(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 3)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        journal._connection.execute("PRAGMA max_page_count=1")  # SQLite sets it to the present size
        large = history[1][0]._replace(warm=jnp.ones((200, 200)))
        with pytest.raises(JournalError, match=r"cannot take session 2 \(.*session 1 is safe\): .*full"):
            journal.commit(large, history[1][1])
        assert bits(journal.state) == bits(history[0][0])
        journal._connection.execute("PRAGMA max_page_count=100000")
        journal.commit(*history[1])
    with Journal.open(tmp_path / "j", learner) as journal:
        assert bits(journal.state) == bits(history[1][0])


def test_a_commit_that_fails_half_way_leaves_nothing(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 2)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        journal._connection.execute(
            "CREATE TEMP TRIGGER broken BEFORE INSERT ON main.state BEGIN SELECT RAISE(FAIL, 'broken'); END"
        )
        with pytest.raises(JournalError, match=r"cannot take session 2 .*: broken"):
            journal.commit(*history[1])
        assert journal.session == 1
        assert [record.session for record in journal.records()] == [1]
        journal._connection.execute("DROP TRIGGER broken")
        journal.commit(*history[1])
        assert [record.session for record in journal.records()] == [1, 2]


def test_a_killed_writer_loses_no_session_and_repeats_none(tmp_path: Path) -> None:
    # Forks from one process that has imported everything; each fork resumes, checks and commits on until it
    # is killed, the first of them possibly while it still makes the file.
    keeper = child(
        """
        def check(path):
            with Journal.open(path, learner) as journal:
                n = journal.session
                assert journal.position == position(n), (n, journal.position)
                assert [record.session for record in journal.records()] == list(range(1, n + 1))
                assert all(r.info == {"square": r.session**2} for r in journal.records())
                assert all((r.weights == np.arange(2.0) * r.session).all() for r in journal.records())
                stored = journal.stored_state()
                if n:
                    assert stored["session"] == n and (stored["statistic"] == np.arange(3000.0) + n).all()
                return n

        def kill_a_writer(path, longest):
            pid = os.fork()
            if not pid:
                try:
                    run(path, 10**9)
                except BaseException as error:
                    print("child:", repr(error), file=sys.stderr, flush=True)
                os._exit(1)
            time.sleep(random.uniform(0, longest))
            os.kill(pid, signal.SIGKILL)
            assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL

        random.seed(2024)
        path, last = sys.argv[1], [0]
        run(path, 2)
        for kill in range(14):
            kill_a_writer(path, 0.02 if kill % 2 else 0.15)
            if kill % 4 == 1:  # otherwise the next writer finds what the killed one left
                with Journal.read(path) as view:
                    seen = view.session
                last.append(check(path))
                assert seen == last[-1]
        print(*last)
        for fresh in range(6):  # killed while the file is being made
            kill_a_writer(f"{path}-{fresh}", 0.015)
            n = check(f"{path}-{fresh}")
            run(f"{path}-{fresh}", n + 2)
            assert check(f"{path}-{fresh}") == n + 2
        """,
        tmp_path / "j",
    )
    output, errors = keeper.communicate(timeout=120)
    assert keeper.returncode == 0, errors
    assert "child:" not in errors
    sessions = [int(n) for n in output.split()]
    assert sessions == sorted(sessions)
    assert sessions[-1] > 20  # it did learn in between


@pytest.mark.parametrize("seed", range(3))
def test_a_log_cut_anywhere_leaves_whole_sessions(seed: int, learner: Toy, tmp_path: Path) -> None:
    # What a power cut may leave of the newest commits: the log up to some byte, and noise behind it.
    history = learned(learner, 5)
    rng = np.random.default_rng(seed)
    with Journal.open(tmp_path / "j", learner) as journal:
        for state, report in history:
            journal.commit(state, report, Position(state.session, "00"))
        main, log = (tmp_path / "j").read_bytes(), (tmp_path / "j-wal").read_bytes()
    reached = set()
    for cut in rng.integers(0, len(log) + 1, size=25):
        cut_path = tmp_path / "cut" / "j"
        shutil.rmtree(cut_path.parent, ignore_errors=True)
        cut_path.parent.mkdir()
        cut_path.write_bytes(main)
        cut_path.with_name("j-wal").write_bytes(log[:cut] + rng.bytes(rng.integers(0, 5000)))
        with Journal.open(cut_path, learner) as journal:
            n = journal.session
            assert [record.session for record in journal.records()] == list(range(1, n + 1))
            assert journal.position.records == n
            assert bits(journal.state) == (bits(history[n - 1][0]) if n else bits(None))
        reached.add(n)
    assert len(reached) > 2


@pytest.fixture(scope="module")
def adversity(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Kill writers at every write, fill their disks, damage their journals, and collect the outcomes."""
    folder = tmp_path_factory.mktemp("adversity")
    options = ["--file-systems", "0", "--damaged", "150"]
    done = subprocess.run(
        [sys.executable, "-m", "i2rl.analysis.benchmarks.faults.journals", *options],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((folder / "build" / "bench" / "journals.json").read_text())
    assert found.pop("problems") == []
    return found


@pytest.mark.skipif(shutil.which("strace") is None, reason="kills at a chosen write need strace")
def test_a_learner_killed_at_any_write_resumes_to_the_bit(adversity: dict[str, Any]) -> None:
    kills = adversity["kills"]
    assert kills["wrong"] == 0
    for call, committed, least in (
        ("pwrite64", 0, 30),
        ("pwrite64", 1, 15),
        ("fdatasync", 1, 3),
        ("unlink", 2, 2),
    ):
        assert (
            kills["results"][f"{call}, {committed} committed"] >= least
        )  # in creation, in a commit, at the end


def test_a_learner_on_a_full_disk_resumes_to_the_bit_once_there_is_room(adversity: dict[str, Any]) -> None:
    disks = adversity["full disks"]
    assert (disks["cases"], disks["wrong"]) == (50, 0)
    assert disks["results"]["full"] > 10
    assert disks["results"]["not full"] > 10


def test_a_damaged_journal_is_refused_or_right(adversity: dict[str, Any]) -> None:
    damage = adversity["damaged"]
    assert (damage["cases"], damage["wrong"]) == (150, 0)
    assert damage["results"]["shown: refused; learned: refused"] > 75
    assert damage["results"]["shown: right; learned: right"] > 10


@pytest.mark.parametrize(
    "left", [b"", b"SQLite format 3\0" + bytes(40), bytes(100)], ids=["empty", "short", "zeros"]
)
def test_a_creation_cut_short_begins_again(left: bytes, learner: Toy, tmp_path: Path) -> None:
    # A first write cut short by a full disk, and the journal by which SQLite undoes it.
    empty = bytes.fromhex("d9d505f920a163d7") + struct.pack(">5I", 0, 1, 0, 512, 4096)
    (tmp_path / "j").write_bytes(left)
    (tmp_path / "j-journal").write_bytes(empty.ljust(512, b"\0"))
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*learned(learner, 1)[0])
    with Journal.read(tmp_path / "j") as view:
        assert view.verify() == 1


def test_an_empty_file_is_no_journal_yet(learner: Toy, tmp_path: Path) -> None:
    (tmp_path / "j").touch()
    with pytest.raises(JournalError, match="j is empty: no learner has begun in it"):
        Journal.read(tmp_path / "j")
    assert [file.name for file in tmp_path.iterdir()] == ["j"]
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.session == 0


def test_a_commit_is_flushed_to_the_disk(learner: Toy, tmp_path: Path) -> None:
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal._connection.execute("PRAGMA synchronous").fetchone() == (2,)
        assert journal._connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


# -- export ---------------------------------------------------------------------------------------------


def test_the_history_leaves_as_inference_data(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 3)
    with Journal.open(tmp_path / "j", learner) as journal:
        for state, report in history:
            journal.commit(state, report, Position(10 * state.session, "00"))
        journal.to_netcdf(tmp_path / "history.nc")
    data = arviz.from_netcdf(tmp_path / "history.nc")
    assert data.groups() == ["sessions"]
    sessions = data["sessions"].load()
    assert sessions.weights.dims == ("session", "feature")
    assert list(sessions.session.values) == [1, 2, 3]
    assert list(sessions.feature.values) == ["near", "far"]
    np.testing.assert_array_equal(sessions.weights, [state.weights for state, _ in history])
    np.testing.assert_array_equal(
        sessions.log_likelihood, [float(report.log_likelihood) for _, report in history]
    )
    np.testing.assert_array_equal(sessions.gap, [report.gap for _, report in history])
    np.testing.assert_array_equal(sessions.found, [[np.nan] * 3, [0, 1, np.nan], [0, 1, 2]])
    assert list(sessions.status.values) == ["converged"] * 3
    assert list(sessions.records.values) == [10, 20, 30]
    assert np.all(np.abs(sessions.committed.values - np.datetime64("now")) < np.timedelta64(1, "h"))
    assert sessions.attrs["method"] == "toy"
    assert sessions.attrs["mdp_fingerprint"] == learner.mdp.fingerprint()
    data.close()


def test_an_empty_history_leaves_as_inference_data(learner: Toy, tmp_path: Path) -> None:
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.to_inference_data()["sessions"].sizes["session"] == 0


def test_an_export_onto_a_file_of_the_journal_is_refused(learner: Toy, tmp_path: Path) -> None:
    committed(tmp_path / "j", learner, 2)
    with Journal.read(tmp_path / "j") as view:
        for suffix in ("", "-wal", "-shm", "-journal", "-lock"):
            with pytest.raises(ValueError, match="must be a file of its own"):
                view.to_netcdf(tmp_path / f"j{suffix}")
        assert view.verify() == 2


def test_a_journal_that_was_moved_without_its_log_says_so(learner: Toy, tmp_path: Path) -> None:
    history = learned(learner, 2)
    with Journal.open(tmp_path / "j", learner) as journal:
        journal.commit(*history[0])
        shutil.copy(tmp_path / "j", tmp_path / "alone")
    with Journal.read(tmp_path / "alone") as view:
        assert view.lacks_log
    with Journal.read(tmp_path / "j") as view:
        assert not view.lacks_log
        assert view.verify() == 1


@pytest.mark.parametrize(
    "statements",
    [
        "CREATE TRIGGER t AFTER INSERT ON session BEGIN DELETE FROM session; END",
        "ALTER TABLE session RENAME TO s2; CREATE VIEW session AS SELECT * FROM s2",
    ],
)
def test_a_journal_with_views_or_triggers_is_refused(statements: str, learner: Toy, tmp_path: Path) -> None:
    committed(tmp_path / "j", learner, 2)
    with closing(sqlite3.connect(tmp_path / "j")) as connection:
        connection.executescript(statements)
    for opened in (Journal.read, lambda path: Journal.open(path, learner)):
        with pytest.raises(JournalError, match=r"damaged: it has the (view|trigger)"):
            opened(tmp_path / "j")


def test_paths_that_lead_nowhere_and_what_is_no_learner_are_told(learner: Toy, tmp_path: Path) -> None:
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    for path in (tmp_path / "circle", tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(JournalError, match="cannot be"):
            Journal.read(path)
        with pytest.raises(JournalError, match="cannot be"):
            Journal.open(path, learner)
    with pytest.raises(TypeError, match="`learner` must be a learner"):
        Journal.open(tmp_path / "j", 3)
    committed(tmp_path / "j", learner, 1)
    with Journal.read(tmp_path / "j") as view:
        for last in (0, -1, "3", 10**30):
            with pytest.raises(ValueError, match="positive number of sessions"):
                list(view.records(last))
