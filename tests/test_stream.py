import itertools
import json
import threading
import time
from collections.abc import Iterable, Iterator

import jax
import numpy as np
import pytest

from i2rl.analysis.benchmarks.kills import content, survive
from i2rl.analysis.stream import followed, learn_stream, open_lines
from i2rl.inference.journal import Journal, JournalError
from i2rl.inference.lme import lme_i2rl
from i2rl.models import DemonstrationError, TabularMDP, Visibility, concatenate, read_trajectories
from i2rl.models.storage import save_mdp

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
    """A line about somebody who goes on, and half of the time waits in the kitchen."""
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
    """The lines, and then no end of the input but an interruption."""
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
        stored = list(view.reports())
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
    with pytest.raises(JournalError, match="the first 4 lines of the input are not those"):
        learn(learner, [lines[1], *lines[1:]], tmp_path / "j")
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


def test_a_line_that_is_not_text_is_named(tmp_path):
    (tmp_path / "demos.jsonl").write_bytes(b'{"steps": ["hidden"]}\n{"steps": ["\xff"]}\n')
    opened, source = open_lines(str(tmp_path / "demos.jsonl"), follow=False)
    assert source == "demos.jsonl"
    assert next(iter(opened)) == '{"steps": ["hidden"]}\n'
    with pytest.raises(DemonstrationError, match=r"demos.jsonl, line 2: not UTF-8 text at byte 13"):
        next(iter(opened))


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
    with path.open("rb") as file:
        for line in itertools.islice(follow_lines(file, poll_seconds=0.001), len(lines)):
            read += line
            complete.append(line.decode())
            assert written >= len(read)  # nothing was made up
    writer.join()
    assert complete == lines


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
        "--demos",
        str(tmp_path / "demos.jsonl"),
        "--seed",
        "3",
    ]
    shares = {"starting": 1, "sessions": 2, "closing": 1}
    survival = survive(arguments, tmp_path, kills=4, shares=shares)
    assert survival.problems == ()
    assert survival.sessions == 28
    assert len(survival.kills) == 4
    assert any(0 < k.committed < survival.sessions for k in survival.kills)
    # Nor does it matter that each of these was another process.
    learn(learner, lines * 4, tmp_path / "here")
    assert content(tmp_path / "here") == content(tmp_path / "life-1.db")
