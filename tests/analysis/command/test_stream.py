import itertools
import json
import re
import threading
import time
import tracemalloc
from collections.abc import Iterable, Iterator

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.analysis.benchmarks.faults.kills import content, survive
from i2rl.analysis.command.quarantine import Line, Quarantine
from i2rl.analysis.command.stream import followed, learn_stream, open_lines, read_lines
from i2rl.inference.journal.journal import Journal, JournalError, Position
from i2rl.inference.learners.lme import lme_i2rl
from i2rl.models import DemonstrationError, TabularMDP, Visibility, concatenate, read_trajectories
from i2rl.models.observation.demonstration import LineLimits
from i2rl.models.observation.storage import save_mdp

KEY = jax.random.key(3)
IN_VIEW = np.array([1.0, 1, 1, 0, 0])


def round_trip() -> TabularMDP:
    """Five rooms in a ring; the way on may slip, one action waits, and the last two rooms are out of view."""
    rooms = np.arange(5)
    successors = np.stack([np.stack([rooms, rooms], 1), np.stack([(rooms + 1) % 5, rooms], 1)], 1)
    probabilities = np.broadcast_to([[1.0, 0.0], [0.9, 0.1]], (5, 2, 2))
    features = np.zeros((5, 2, 2))
    features[:, 1, 0] = 1  # goes on
    features[2, 0, 1] = 1  # waits in the kitchen
    return TabularMDP.from_successors(
        successors,
        probabilities,
        features,
        discount=0.9,
        states=["hall", "stairs", "kitchen", "küche 2", "cellar"],
        actions=["wait", "on"],
        feature_names=["goes on", "waits in the kitchen"],
    )


def trajectory(seed: int, agent: int | None = None) -> str:
    """Write a line about a walk that goes on, and half of the time waits in the kitchen."""
    rng = np.random.default_rng(seed)
    state, steps = int(rng.integers(5)), []
    for _ in range(4):
        action = 0 if state == 2 and rng.random() < 0.5 else 1
        steps.append({"s": state, "a": action} if IN_VIEW[state] else "hidden")
        state = (state + action * int(rng.random() < 0.9)) % 5
    return json.dumps(({} if agent is None else {"agent": agent}) | {"steps": steps}) + "\n"


@pytest.fixture(scope="module")
def learner():
    return lme_i2rl(round_trip(), Visibility(IN_VIEW))


@pytest.fixture(scope="module")
def lines() -> list[str]:
    """Two agents' lines and a blank one."""
    agents = (0, 1, 0, 0, None, 1, 0)
    stream = [trajectory(seed, agent) for seed, agent in enumerate(agents)]
    return [*stream[:2], "\n", *stream[2:]]


class Interrupted(Exception):
    pass


def interrupted(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines, and then an interruption instead of the input's end."""
    yield from lines
    raise Interrupted


def learn(learner, lines: Iterable[str], path, **options) -> int:
    with Journal.open(path, learner) as journal:
        return learn_stream(learner, lines, journal, KEY, **options)


# -- sessions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"size": 2}, {"size": 2, "agent": 0}])
def test_learning_resumes_to_the_bit_wherever_it_was_interrupted(learner, lines, options, tmp_path):
    sessions = learn(learner, lines, tmp_path / "whole", **options)
    whole = content(tmp_path / "whole")
    assert len(whole.sessions) == sessions > 2
    for k in range(len(lines) + 1):
        with pytest.raises(Interrupted):
            learn(learner, interrupted(lines[:k]), tmp_path / f"{k}", **options)
        before = content(tmp_path / f"{k}").sessions
        assert before == whole.sessions[: len(before)]
        after = learn(learner, lines, tmp_path / f"{k}", **options)
        assert len(before) + after == sessions
        assert content(tmp_path / f"{k}") == whole


def test_learning_resumes_to_the_bit_when_every_session_is_interrupted(learner, lines, tmp_path):
    learn(learner, lines, tmp_path / "whole")
    whole = content(tmp_path / "whole")

    def stop(report):
        raise Interrupted

    for _ in whole.sessions:
        with pytest.raises(Interrupted):
            learn(learner, lines, tmp_path / "often", on_session=stop)
    assert learn(learner, lines, tmp_path / "often", on_session=stop) == 0
    assert content(tmp_path / "often") == whole


def test_a_session_is_one_update_with_its_trajectories(learner, lines, tmp_path):
    reports = []
    assert learn(learner, lines, tmp_path / "j", size=2, on_session=reports.append) == 4
    records = [r.demonstration for r in read_trajectories(lines, learner.mdp)]
    state = learner.init(KEY)
    with Journal.read(tmp_path / "j") as view:
        stored = list(view.records())
        final = view.stored_state()
    for i, report in enumerate(reports):
        state, expected = learner.update(state, concatenate(records[2 * i : 2 * i + 2]))
        assert report.session == stored[i].session == i + 1
        np.testing.assert_array_equal(report.weights, expected.weights)
        np.testing.assert_array_equal(stored[i].weights, expected.weights)
    # The blank line counts as a line; the last session is a single trajectory.
    assert [r.position.records for r in stored] == [2, 5, 7, 8]
    assert float(state.statistic.size) == 7
    for leaf, value in final.items():
        if leaf.startswith("statistic"):
            field = getattr(state.statistic, leaf.removeprefix("statistic."))
            np.testing.assert_array_equal(value, np.asarray(field))


def test_only_the_agents_own_lines_and_those_of_nobody_are_learned_from(learner, lines, tmp_path):
    own = [line for line in lines if '"agent": 1' not in line and line.strip()]
    assert 0 < len(own) < len(lines)
    assert learn(learner, lines, tmp_path / "mixed", agent=0) == len(own)
    learn(learner, own, tmp_path / "own")
    mixed, alone = content(tmp_path / "mixed"), content(tmp_path / "own")
    assert mixed.state == alone.state
    assert [s[:2] for s in mixed.sessions] == [s[:2] for s in alone.sessions]


def test_blank_lines_teach_nothing(learner, lines, tmp_path):
    spaced = list(itertools.chain.from_iterable(("\n", line, "  \r\n") for line in lines))
    learn(learner, lines, tmp_path / "plain")
    learn(learner, spaced, tmp_path / "spaced")
    assert content(tmp_path / "spaced").state == content(tmp_path / "plain").state


def test_there_is_nothing_to_learn_from_an_empty_input(learner, tmp_path):
    assert learn(learner, [], tmp_path / "j") == 0
    assert learn(learner, ["\n", "\n"], tmp_path / "j") == 0
    with Journal.open(tmp_path / "j", learner) as journal:
        assert journal.state is None


# -- other input, broken input ----------------------------------------------------------------------------


def test_another_input_is_refused_and_the_journal_stays(learner, lines, tmp_path):
    learn(learner, lines[:4], tmp_path / "j")
    kept = content(tmp_path / "j")
    with pytest.raises(JournalError, match="lines 1 to 1 of the input are not those that were learned from"):
        learn(learner, interrupted([lines[1]]), tmp_path / "j")  # without waiting for the others
    with pytest.raises(JournalError, match="lines 1 to 4 of the input are not those that were learned from"):
        learn(learner, [lines[0], lines[0], *lines[2:]], tmp_path / "j")
    with pytest.raises(JournalError, match="ends after 2 lines, but 4 were already learned from"):
        learn(learner, lines[:2], tmp_path / "j")
    assert content(tmp_path / "j") == kept


STEP_INTO_THE_UNSEEN = '{"steps": [{"s": "hall", "a": "on"}, {"s": "cellar", "a": "on"}]}\n'
JUMP = '{"steps": ["hidden", {"s": "hall", "a": "on"}, {"s": "kitchen", "a": "on"}, "hidden"]}\n'


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ('{"steps": [\n', "demos.jsonl, line 4: not valid JSON at character"),
        ('{"steps": ["hidden", {"s": "attic"}]}\n', "demos.jsonl, line 4, step 1: unknown state 'attic'"),
        ('{"steps": ["hidden", {"s": 5}]}\n', "demos.jsonl, line 4, step 1: state 5 is out of range"),
        (STEP_INTO_THE_UNSEEN, "demos.jsonl, line 4: trajectory 0, step 1: .*state 'cellar'"),
        (JUMP, "demos.jsonl, line 4: trajectory 0, step 2: .*state 'kitchen'"),
    ],
)
def test_a_broken_line_is_named_and_once_repaired_learning_goes_on(learner, lines, broken, message, tmp_path):
    learn(learner, lines, tmp_path / "whole")
    whole = content(tmp_path / "whole")
    with pytest.raises(DemonstrationError, match=message):
        learn(learner, [*lines[:3], broken, *lines[4:]], tmp_path / "j", source="demos.jsonl")
    assert content(tmp_path / "j").sessions == whole.sessions[:2]  # one of the three lines is blank
    learn(learner, lines, tmp_path / "j", source="demos.jsonl")
    assert content(tmp_path / "j") == whole


def test_an_impossible_session_names_its_lines(learner, lines, tmp_path):
    stream = [*lines[:2], "\n", lines[3], JUMP, *lines[5:]]
    with pytest.raises(DemonstrationError, match="input, session of lines 4, 5: trajectory 1, step 2"):
        learn(learner, stream, tmp_path / "j", size=2)
    assert len(content(tmp_path / "j").sessions) == 1


def test_a_line_that_is_not_text_is_named(learner, tmp_path):
    (tmp_path / "demos.jsonl").write_bytes(b'{"steps": ["hidden"]}\n{"steps": ["\xff"]}\n')
    opened, source = open_lines(str(tmp_path / "demos.jsonl"), follow=False)
    with pytest.raises(DemonstrationError, match=r"demos.jsonl, line 2: not UTF-8 text at byte 13"):
        learn(learner, opened, tmp_path / "j", source=source)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text("ab\r\u00fc", max_size=6), max_size=5), st.booleans(), st.data())
def test_lines_come_out_of_any_pieces_with_their_positions(texts, ends, data):
    whole = ("\n".join(texts) + "\n" * ends).encode()
    cuts = sorted({0, len(whole), *data.draw(st.lists(st.integers(0, len(whole)), max_size=5))})
    pieces = [p for a, b in itertools.pairwise(cuts) for p in whole[a:b].splitlines(keepends=True) if p]
    pieces = [q for p in pieces for q in re.findall(rb"[^\n]*\n|[^\n]+", p)]
    position = Position()
    expected = re.findall(r"[^\n]*\n|[^\n]+", whole.decode())
    for line, text in zip(read_lines(pieces, "input"), expected, strict=True):
        position = position.after(text)
        assert line == Line(text, position)


def test_of_a_line_without_end_only_the_beginning_is_held():
    def pieces(count: int) -> Iterator[bytes]:
        yield b"first\n"
        yield from itertools.repeat(b"x" * (1 << 16), count)
        yield from (b"\n", b"last\n")

    limits = LineLimits(size=100_000)
    tracemalloc.start()
    found = list(read_lines(pieces(1000), "demos.jsonl", limits, skip=True))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e6  # of 65 MB
    assert [line.text[:5] for line in found] == ["first", "xxxxx", "last\n"]
    assert found[1].fault.startswith("a line must have at most 100,000 bytes")
    # Its position is that of the whole line, so that it may be read in another run that allows more.
    more = list(read_lines(pieces(1000), "demos.jsonl", LineLimits(size=1 << 30)))
    assert [line.position for line in more] == [line.position for line in found]
    with pytest.raises(
        DemonstrationError, match=r"demos.jsonl, line 2: a line must have at most 100,000 bytes; .*--line"
    ):
        list(read_lines(itertools.chain([b"first\n"], itertools.repeat(b"x" * 1000)), "demos.jsonl", limits))


def test_a_trajectory_of_too_many_steps_is_refused_unless_it_is_allowed(learner, tmp_path):
    steps = json.dumps(["hidden"] * 5) + "\n"
    with pytest.raises(
        DemonstrationError, match=r"input, line 1: a line must have at most 4 steps; it has 5: .*--line-st"
    ):
        learn(learner, [steps], tmp_path / "j", limits=LineLimits(steps=4))
    assert learn(learner, [steps], tmp_path / "j", limits=LineLimits(steps=5)) == 1


def test_a_line_cut_off_is_learned_once_it_is_whole(learner, lines, tmp_path):
    demos = tmp_path / "demos.jsonl"
    text = "".join(lines[:4])

    def learn_file():
        opened, source = open_lines(str(demos), follow=False)
        return learn(learner, opened, tmp_path / "j", source=source)

    demos.write_text(text[:-20])
    with pytest.raises(DemonstrationError, match=r"demos.jsonl, line 4: .*the file may have been cut off"):
        learn_file()
    assert len(content(tmp_path / "j").sessions) == 2
    demos.write_text(text[:-1])  # only the line's end is missing
    assert learn_file() == 1
    demos.write_text("".join(lines))
    assert learn_file() == len(lines) - 4
    learn(learner, lines, tmp_path / "whole")
    assert content(tmp_path / "j") == content(tmp_path / "whole")


def test_a_full_disk_keeps_the_sessions_before_it(learner, lines, tmp_path):
    stream = [line for line in lines if line.strip()] * 4
    learn(learner, stream, tmp_path / "whole")
    whole = content(tmp_path / "whole")

    def fill(report):  # SQLite raises the limit to what is already there
        if report.session == 2:
            journal._connection.execute("PRAGMA max_page_count=1")

    with Journal.open(tmp_path / "j", learner) as journal:
        with pytest.raises(JournalError, match=r"cannot take session \d+ \(.* is safe\): .*full"):
            learn_stream(learner, stream, journal, KEY, on_session=fill)
        kept = journal.session
        assert 2 <= kept < len(stream)
    assert content(tmp_path / "j").sessions == whole.sessions[:kept]
    learn(learner, stream, tmp_path / "j")
    assert content(tmp_path / "j") == whole


# -- bad lines, set aside ---------------------------------------------------------------------------------

BAD = [
    '{"steps": [\n',
    '{"steps": ["hidden", {"s": "attic"}]}\n',
    STEP_INTO_THE_UNSEEN,
    '{"steps": ["' + "x" * 500 + '"]}\n',
    json.dumps(["hidden"] * 30) + "\n",
    JUMP,
]
FEW = LineLimits(size=400, steps=20)
REASONS = [
    "not valid JSON",
    "unknown state 'attic'",
    "trajectory 0, step 1: ",
    "at most 400 bytes",
    "at most 20 steps; it has 30",
    "trajectory [01], step 2: ",
]


def spoilt(lines: list[str]) -> list[str]:
    """Insert a bad line after each of the first six."""
    return [x for i, line in enumerate(lines) for x in (line, *BAD[i : i + 1])]


def pieces_of(lines: Iterable[str]) -> Iterator[Line]:
    return read_lines((line.encode() for line in lines), "demos.jsonl", FEW, skip=True)


def set_aside(learner, lines: Iterable[str], folder, **options) -> tuple[int, Quarantine]:
    quarantine = Quarantine(folder / "bad.jsonl")
    options = {"limits": FEW, "source": "demos.jsonl", "quarantine": quarantine} | options
    return learn(learner, pieces_of(lines), folder / "j", **options), quarantine


def entries(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "bad.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("size", [1, 2])
def test_bad_lines_are_set_aside_and_the_good_ones_learned(learner, lines, size, tmp_path):
    sessions = learn(learner, lines, tmp_path / "good", size=size)
    stream = spoilt(lines)
    done, quarantine = set_aside(learner, stream, tmp_path, size=size)
    assert done == sessions
    assert (quarantine.added, quarantine.lines) == (6, 6)
    good, found = content(tmp_path / "good"), content(tmp_path / "j")
    assert found.state == good.state
    assert [s[:2] for s in found.sessions] == [s[:2] for s in good.sessions]
    aside = sorted(entries(tmp_path), key=lambda entry: entry["line"])
    assert [entry["line"] for entry in aside] == [2, 4, 6, 8, 10, 12]
    for entry, line, reason in zip(aside, BAD, REASONS, strict=True):
        assert re.search(reason, entry["reason"])
        assert entry["reason"].startswith("demos.jsonl, ")
        assert entry["source"] == "demos.jsonl"
        assert entry["text"] == line.rstrip("\n") or (
            entry["text"].endswith("...") and line.startswith(entry["text"][:99])
        )


def test_a_line_is_set_aside_once_wherever_learning_was_interrupted(learner, lines, tmp_path):
    stream = spoilt(lines)
    set_aside(learner, stream, tmp_path, size=2)
    whole, aside = content(tmp_path / "j"), entries(tmp_path)
    for k in range(len(stream) + 1):
        folder = tmp_path / f"{k}"
        folder.mkdir()
        with pytest.raises(Interrupted):
            set_aside(learner, interrupted(stream[:k]), folder, size=2)
        before = len(entries(folder))
        with (folder / "bad.jsonl").open("a") as file:
            file.write('{"digest": "12'[:k])  # what a kill may leave of another line
        _, quarantine = set_aside(learner, stream, folder, size=2)
        assert content(folder / "j") == whole
        assert entries(folder) == aside
        assert (quarantine.added, quarantine.lines) == (6 - before, 6)


def test_if_no_trajectory_is_named_the_whole_session_is_set_aside(learner, lines, tmp_path):
    class Refusing:
        def __init__(self, real):
            self.real = real

        def __getattr__(self, name):
            return getattr(self.real, name)

        def update(self, state, demonstration):
            if demonstration.n_trajectories == 2 and state.session == 1:
                raise DemonstrationError("this cannot be")
            return self.real.update(state, demonstration)

    good = [line for line in lines if line.strip()]
    done, quarantine = set_aside(Refusing(learner), good[:7], tmp_path, size=2)
    assert done == 2  # lines 1, 2; then always two that cannot be; then the last
    assert quarantine.lines == 4


def test_errors_that_are_not_the_lines_own_still_stop(learner, lines, tmp_path):
    class Failing:
        def __getattr__(self, name):
            return getattr(learner, name)

        def update(self, state, demonstration):
            raise ValueError("a matrix is singular")

    with pytest.raises(ValueError, match=r"demos.jsonl, line 1: a matrix is singular"):
        set_aside(Failing(), lines, tmp_path)
    assert entries(tmp_path) == []


@pytest.mark.parametrize("text", ["my notes\n", '{"id": 3}\n', '{"digest": "zz", "line": 3}\n'])
def test_a_file_of_something_else_takes_no_bad_lines(text, tmp_path):
    (tmp_path / "bad.jsonl").write_text(text)
    with pytest.raises(ValueError, match=r"bad.jsonl is not a quarantine of lines"):
        Quarantine(tmp_path / "bad.jsonl")
    assert (tmp_path / "bad.jsonl").read_text() == text


# -- a file that grows ------------------------------------------------------------------------------------


def test_lines_are_followed_as_they_become_complete(tmp_path):
    path = tmp_path / "demos.jsonl"
    lines = ['["küche"]\n', "\n", '["hall", "küche"]\r\n', "x" * 10_000 + "\n"]
    path.touch()
    pieces = [bytes([b]) for b in "".join(lines[:3]).encode()] + [
        lines[3][:5000].encode(),
        lines[3][5000:].encode(),
    ]
    written = 0
    complete = []

    def write() -> None:  # byte by byte, so also in the middle of a character
        nonlocal written
        with path.open("ab", buffering=0) as file:
            for piece in pieces:
                written += len(piece)
                file.write(piece)
                time.sleep(0.002)

    writer = threading.Thread(target=write)
    writer.start()
    read = b""
    for line in itertools.islice(whole(followed(str(path), fail, poll_seconds=0.001)), len(lines)):
        read += line
        complete.append(line.decode())
        assert written >= len(read)  # nothing was made up
    writer.join()
    assert complete == lines


def fail(message: str) -> None:
    raise AssertionError(message)


def whole(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """Lines from their pieces."""
    line = b""
    for piece in pieces:
        line += piece
        if line.endswith(b"\n"):
            yield line
            line = b""


class Watched:
    """A file, and what is followed of it."""

    def __init__(self, path) -> None:
        self.path, self.said = path, []
        path.write_text("one\ntwo\n")
        self.lines = whole(followed(str(path), self.said.append, poll_seconds=0.001))
        assert self.read(2) == ["one", "two"]

    def read(self, count: int) -> list[str]:
        return [line.decode().rstrip("\n") for line in itertools.islice(self.lines, count)]


def test_a_rotated_file_is_read_to_its_end_and_then_the_new_one(tmp_path):
    watched = Watched(tmp_path / "demos.jsonl")
    with watched.path.open("a") as old:
        watched.path.rename(tmp_path / "demos.jsonl.1")
        print("three", file=old, flush=True)  # by a writer that has not noticed
        assert watched.read(1) == ["three"]
        watched.path.write_text("four\nfive\n")
        print("three and a half", file=old, flush=True)
    assert watched.read(3) == ["three and a half", "four", "five"]
    assert watched.said == [
        f"{watched.path} was replaced: the old file is read to its end, reading the new one from its start"
    ]
    watched.path.unlink()
    watched.path.write_text("six\n")
    assert watched.read(1) == ["six"]


def test_the_last_line_of_a_rotated_file_ends_there(tmp_path):
    watched = Watched(tmp_path / "demos.jsonl")
    with watched.path.open("a") as file:
        file.write("thr")
    watched.path.rename(tmp_path / "demos.jsonl.1")
    watched.path.write_text("four\n")
    assert watched.read(2) == ["thr", "four"]


@pytest.mark.parametrize(
    "text", ["1\n", "another line altogether\nand one more\n"], ids=["shorter", "longer"]
)
def test_a_file_written_anew_is_read_from_its_start(text, tmp_path):
    watched = Watched(tmp_path / "demos.jsonl")
    watched.path.write_text(text)  # the same file, truncated first
    assert watched.read(text.count("\n")) == text.splitlines()
    assert watched.said == [f"{watched.path} was cut off or written anew: reading it from its start"]


def test_a_growing_file_is_learned_from_while_it_grows(learner, lines, tmp_path):
    demos = tmp_path / "demos.jsonl"
    demos.write_text(lines[0] + lines[1][:30])
    reports = []

    def grow(report):
        # Called after each session: the next line is completed only now, so it cannot have been read before.
        reports.append(report.session)
        if len(reports) == 3:
            raise Interrupted
        with demos.open("a") as file:
            file.write(lines[1][30:] + lines[3][:10] if len(reports) == 1 else lines[3][10:])

    opened, source = open_lines(str(demos), follow=True)
    with pytest.raises(Interrupted):
        learn(learner, opened, tmp_path / "j", source=source, on_session=grow)
    assert reports == [1, 2, 3]
    learn(learner, [lines[0], lines[1], lines[3]], tmp_path / "whole")
    assert content(tmp_path / "j") == content(tmp_path / "whole")


# -- kills ------------------------------------------------------------------------------------------------


def test_a_killed_learner_loses_no_session_and_repeats_none(learner, lines, tmp_path):
    save_mdp(tmp_path / "house.npz", learner.mdp, IN_VIEW)
    (tmp_path / "demos.jsonl").write_text("".join(lines * 4))
    arguments = [
        "--mdp",
        str(tmp_path / "house.npz"),
        "--demonstrations",
        str(tmp_path / "demos.jsonl"),
        "--seed",
        "3",
    ]
    shares = {"starting": 4, "sessions": 10, "closing": 1}
    survival = survive(arguments, tmp_path, kills=30, shares=shares, forked=True)
    assert survival.problems == ()
    assert survival.sessions == 28
    assert len(survival.kills) == 30
    assert sum(0 < k.committed < survival.sessions for k in survival.kills) > 15
    # Nor does it matter that each of these was another process.
    learn(learner, lines * 4, tmp_path / "here")
    assert content(tmp_path / "here") == content(tmp_path / "life-1.db")
