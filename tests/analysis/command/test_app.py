import base64
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import typing
from typing import NamedTuple

import arviz
import jax
import numpy as np
import pytest
import typer
from jax.experimental.compilation_cache import compilation_cache
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.inference.journal.journal import Journal
from i2rl.inference.learners.lme import lme_i2rl
from i2rl.models import TabularMDP, Visibility, read_trajectories
from i2rl.models.observation.storage import save_mdp

COMMAND = [sys.executable, "-m", "i2rl.analysis.command.app"]
IN_VIEW = np.array([1.0, 1, 1, 0])
LINES = [
    '{"id": "a", "agent": 0, "steps": [{"s": "north", "a": "on"}, {"s": "east", "a": "on"}, "hidden"]}\n',
    '{"id": "b", "agent": 1, "steps": [{"s": "north", "a": "stay"}, {"s": "north", "a": "on"}, null]}\n',
    '{"id": "c", "agent": 0, "steps": ["hidden", {"s": "west", "a": "on"}, {"s": "north", "a": "on"}]}\n',
    '{"id": "d", "agent": 0, "steps": [{"s": "east", "a": "on"}, "hidden", "hidden"]}\n',
]


def circle(discount: float = 0.9) -> TabularMDP:
    """West, north, east and, out of view, south; one action stays and one goes on."""
    places = np.arange(4)
    successors = np.stack([np.stack([places, places], 1), np.stack([(places + 1) % 4, places], 1)], 1)
    probabilities = np.broadcast_to([[1.0, 0.0], [0.8, 0.2]], (4, 2, 2))
    features = np.zeros((4, 2, 2))
    features[:, 1, 0] = 1
    features[1, :, 1] = 1
    return TabularMDP.from_successors(
        successors,
        probabilities,
        features,
        discount=discount,
        states=["west", "north", "east", "south"],
        actions=["stay", "on"],
        feature_names=["goes on", "is north"],
    )


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory):
    """Share compiled programs between all ``learn`` commands here, also those in other processes."""
    settings = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("compiled")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: getattr(jax.config, name) for name in settings}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            jax.config.update(name, value)
            patch.setenv(name.upper(), str(value))
        compilation_cache.reset_cache()
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture
def house(tmp_path):
    """Make a folder with an MDP, demonstrations, and the options that learn from them."""
    save_mdp(tmp_path / "circle.npz", circle(), IN_VIEW)
    (tmp_path / "demos.jsonl").write_text("".join(LINES))
    return tmp_path


def options(folder, **changes) -> list[str]:
    """Arguments of ``learn`` in the folder, some changed or added."""
    values = {
        "mdp": folder / "circle.npz",
        "demonstrations": folder / "demos.jsonl",
        "journal": folder / "learned.db",
    } | changes
    return ["learn", *(str(x) for k, v in values.items() for x in (f"--{k.replace('_', '-')}", v))]


def call(*arguments: object, given: str | None = None):
    """Run a command that is expected to succeed."""
    result = CliRunner().invoke(app, ["--quiet", *map(str, arguments)], input=given)
    assert result.exit_code == 0, (result.stderr, result.exception)
    return result


def refused(*arguments: object) -> str:
    """Run a command that is expected to fail with one line, and return it."""
    result = CliRunner().invoke(app, ["--quiet", *map(str, arguments)])
    assert result.exit_code == 1, (result.stdout, result.exception)
    assert isinstance(result.exception, SystemExit)
    assert re.fullmatch(r"Error: .*\n", result.stderr), result.stderr
    assert not result.stdout
    return result.stderr


# -- help -------------------------------------------------------------------------------------------------


def every_command() -> list[list[str]]:
    def below(group, path: list[str]) -> list[list[str]]:
        found = [path]
        for name, command in getattr(group, "commands", {}).items():
            found += below(command, [*path, name])
        return found

    return below(typer.main.get_command(app), [])


def test_the_commands_are_there():
    assert {"learn", "show", "run patrol", "simulate patrol"} <= {" ".join(c) for c in every_command()}


@pytest.mark.parametrize("command", every_command(), ids=" ".join)
def test_help_says_what_the_command_and_each_option_do(command):
    text = call(*command, "--help").stdout
    here = typer.main.get_command(app)
    for name in command:
        here = here.commands[name]
    assert here.help
    assert here.help.split()[0] in text
    for parameter in here.params:
        assert getattr(parameter, "help", None), parameter.name
        assert parameter.opts[0] in text or parameter.name.upper() in text.upper()


def test_help_loads_nothing_heavy():
    script = f"""
import sys
import i2rl
assert "jax" not in sys.modules and "numpy" not in sys.modules
from i2rl.analysis.command.app import app
for command in {every_command()!r}:
    try:
        app([*command, "--help"])
    except SystemExit as end:
        assert not end.code
heavy = {{"arviz", "casadi", "cvxpy", "jax", "matplotlib", "numpy", "pymc", "scipy"}}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_the_version_is_printed():
    import i2rl

    assert call("--version").stdout == f"{i2rl.__version__}\n"


def numeric_options() -> list[tuple[list[str], str, bool]]:
    """List every option that takes a number: its command, its name, and whether the number is whole."""
    found = []
    for path in every_command():
        command = typer.main.get_command(app)
        for name in path:
            command = command.commands[name]
        hints = {} if command.callback is None else typing.get_type_hints(command.callback)
        for option in command.params:
            kinds = {hints.get(option.name), *typing.get_args(hints.get(option.name))}
            if kinds & {int, float}:
                found.append((path, option.opts[0], int in kinds))
    return found


def usage_error(*arguments: str) -> str:
    """Give a command something that it cannot take, and return how it says so."""
    result = CliRunner().invoke(app, list(arguments), env={"COLUMNS": "200"})
    assert result.exit_code == 2, (arguments, result.stderr, result.exception)
    return " ".join(result.stderr.replace("│", " ").split())


def test_numbers_that_no_command_can_take_are_usage_errors():
    options = numeric_options()
    assert {o for _, o, whole in options if not whole} >= {"--epsilon", "--ridge", "--slack", "--noise"}
    assert len([path for path, option, _ in options if option == "--seed"]) >= 8
    for path, option, whole in options:
        if whole and option == "--agent":  # compared with what the lines say, whatever it is
            continue
        for value in ["9" * 20, "1.5"] if whole else ["nan", "inf", "1e999", "x"]:
            message = usage_error(*path, option, value)
            assert f"Invalid value for '{option}'" in message, (path, option, value, message)


@pytest.mark.parametrize("seed", ["12345678901234567890", "-1", "4294967296"])
def test_a_seed_has_32_bits(seed):
    assert re.search(
        r"Invalid value for '--seed': .*(less than or equal to 4294967295|greater than or equal to 0)",
        usage_error("simulate", "patrol", "--seed", seed),
    )


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("--epsilon", "1e-300", "greater than or equal to 0.000000001"),
        ("--epsilon", "-0.1", "greater than or equal to 0.000000001"),
        ("--epsilon-s", "0", "greater than or equal to 0.000000001"),
        ("--confidence", "1.2", "less than or equal to 1"),
        ("--features", "0", "greater than or equal to 1"),
        ("--features", "1000001", "less than or equal to 1000000"),
        ("--deviation", "0.7", "less than or equal to 0.5"),
    ],
)
def test_bounds_names_the_range_of_what_is_outside(option, value, allowed):
    assert f"Invalid value for '{option}': Input should be {allowed}" in usage_error("bounds", option, value)


def test_bounds_answers_at_the_ends_of_its_ranges():
    for epsilon, features in (("1e-9", "1"), ("1e-9", "1000000"), ("0.94", "1")):
        asked = [
            "bounds",
            "--epsilon",
            epsilon,
            "--features",
            features,
            "--predicates",
            "10000000",
            "--steps",
            "10000000",
            "--json",
        ]
        answer = json.loads(call(*asked).stdout)
        assert all(row["trajectories"] >= 1 for row in answer["bounds"] + answer["perception"])


# -- learning, and looking at it --------------------------------------------------------------------------


def test_what_is_simulated_can_be_read_and_learned_from(tmp_path):
    from i2rl.domains.patrol.process import instance

    # Without an option the view is the instance's own, here 18 %.
    simulated = call("simulate", "patrol", "--instance", 3, "--sessions", 3, "--steps", 4, "--seed", 5).stdout
    patrol = instance(3)
    records = list(read_trajectories(simulated.splitlines(keepends=True), patrol.mdp))
    assert [(r.id, r.agent) for r in records] == [(f"patrol3-{i}-{a}", a) for i in range(3) for a in (0, 1)]
    assert all(r.demonstration.lengths.tolist() == [4] for r in records)
    again = call(
        "simulate",
        "patrol",
        "--instance",
        3,
        "--sessions",
        3,
        "--steps",
        4,
        "--seed",
        5,
        "--observability",
        18,
    ).stdout
    assert again == simulated

    # From standard input, the second patroller only; the table names the features.
    journal = tmp_path / "second.db"
    learned = call(
        "learn",
        "--mdp",
        "patrol3",
        "--demonstrations",
        "-",
        "--journal",
        journal,
        "--agent",
        1,
        given=simulated,
    )
    assert "3 sessions learned (0 were in" in learned.stdout
    shown = call("show", journal).stdout
    for name in patrol.mdp.feature_names:
        assert name in learned.stdout
        assert name in shown
    assert "an MDP of 184 states and 4 actions; 3 sessions" in shown


def test_learning_again_goes_on_where_it_stopped(house):
    (house / "demos.jsonl").write_text("".join(LINES[:2]))
    assert "2 sessions learned (0 were in" in call(*options(house)).stdout
    (house / "demos.jsonl").write_text("".join(LINES))
    assert "2 sessions learned (2 were in" in call(*options(house)).stdout
    assert "0 sessions learned (4 were in" in call(*options(house)).stdout
    call(*options(house, journal=house / "whole.db"))
    with Journal.read(house / "learned.db") as often, Journal.read(house / "whole.db") as once:
        for mine, theirs in zip(often.records(), once.records(), strict=True):
            np.testing.assert_array_equal(mine.weights, theirs.weights)


def test_json_is_what_the_journal_holds(house):
    learned = [json.loads(line) for line in call(*options(house), "--json").stdout.splitlines()]
    shown = json.loads(call("show", house / "learned.db", "--json").stdout)
    with Journal.read(house / "learned.db") as view:
        records = list(view.records())
    assert [r["session"] for r in learned] == [s["session"] for s in shown["sessions"]] == [1, 2, 3, 4]
    for report, session, record in zip(learned, shown["sessions"], records, strict=True):
        assert report["weights"] == session["weights"] == record.weights.tolist()
        assert report["log_likelihood"] == session["log_likelihood"] == record.info["log_likelihood"]
    assert shown["origin"]["feature_names"] == ["goes on", "is north"]


def test_an_archive_s_view_is_used(house):
    # Going unseen through east, which is in view, is impossible with the view and fine without.
    (house / "demos.jsonl").write_text(
        '{"steps": [{"s": "north", "a": "on"}, "hidden", {"s": "east", "a": "on"}]}\n'
    )
    assert "demos.jsonl, line 1: trajectory 0, step 1: impossible observation: hidden" in refused(
        *options(house)
    )
    (house / "lost.jsonl").write_text(
        '{"steps": [{"s": "north", "a": "on"}, null, {"s": "east", "a": "on"}]}\n'
    )
    call(*options(house, demonstrations=house / "lost.jsonl"))


def test_the_history_is_exported_as_netcdf(house):
    call(*options(house))
    told = call("show", house / "learned.db", "--export", house / "history.nc").stdout
    assert "history.nc" in told.replace("\n", "")
    sessions = arviz.from_netcdf(house / "history.nc")["sessions"]
    with Journal.read(house / "learned.db") as view:
        weights = np.stack([r.weights for r in view.records()])
    np.testing.assert_array_equal(sessions["weights"].transpose("session", "feature"), weights)
    assert sessions["feature"].values.tolist() == ["goes on", "is north"]


def test_only_the_last_sessions_are_listed(house):
    call(*options(house))
    listed = re.findall(r"^│ +(\d+) │", call("show", house / "learned.db", "--last", 2).stdout, re.MULTILINE)
    assert listed == ["3", "4"]


def test_no_more_sessions_are_read_than_are_shown(house):
    call(*options(house))
    with sqlite3.connect(house / "learned.db") as connection:
        connection.execute("UPDATE session SET report = x'00' WHERE number = 1")
    connection.close()
    assert "3" in call("show", house / "learned.db", "--last", 2).stdout
    sessions = json.loads(call("show", house / "learned.db", "--last", 2, "--json").stdout)["sessions"]
    assert [session["session"] for session in sessions] == [3, 4]
    for all_of_it in (["--last", 4], ["--verify"], ["--export", house / "history.nc"]):
        assert "session 1 cannot be read: the bytes are damaged" in refused(
            "show", house / "learned.db", *all_of_it
        )


def test_a_journal_is_verified(house):
    call(*options(house))
    assert (
        call("show", house / "learned.db", "--verify").stderr
        == "All 4 sessions are as they were committed.\n"
    )


def test_a_journal_of_several_rewards_and_other_reports_is_shown(tmp_path):
    class State(NamedTuple):
        weights: np.ndarray
        session: int

    class SessionInfo(NamedTuple):
        log_likelihood: float
        components: np.ndarray

    learner = lme_i2rl(circle(), Visibility(IN_VIEW))
    with Journal.open(tmp_path / "two.db", learner) as journal:
        journal.commit(State(np.array([[1.0, -2.0], [0.25, 0.0]]), 1), SessionInfo(-1.5, np.ones(2)))
    shown = call("show", tmp_path / "two.db").stdout
    assert re.search(r"goes on +│ +1.000 │ +0.333 │ +0.250 │ +1.000 │", shown)
    assert re.search(r"│ +1 │ +-1.5000 │", shown)


def test_bad_lines_are_set_aside_and_counted(house):
    bad = [
        "no JSON\n",
        '{"steps": [{"s": "attic"}]}\n',
        "[" + ", ".join(['"hidden"'] * 9) + "]\n",
        "[" + " " * 999 + "]\n",
    ]
    mixed = [x for pair in zip(LINES, bad, strict=True) for x in pair]
    (house / "demos.jsonl").write_text("".join(mixed[:3]))
    asked = [*options(house, quarantine=house / "bad.jsonl", line_steps=8, line_bytes=900)]
    assert (
        call(*asked).stderr.replace("\n", "") == f"Lines set aside in {house / 'bad.jsonl'}: 1 new, 1 in all."
    )
    (house / "demos.jsonl").write_text("".join(mixed))
    again = call(*asked)
    assert again.stderr.replace("\n", "") == f"Lines set aside in {house / 'bad.jsonl'}: 3 new, 4 in all."
    assert "2 sessions learned (2 were in" in again.stdout
    reasons = [json.loads(line)["reason"] for line in (house / "bad.jsonl").read_text().splitlines()]
    for reason, expected in zip(
        reasons,
        ("not valid JSON", "unknown state 'attic'", "at most 8 steps; it has 9", "at most 900 bytes"),
        strict=True,
    ):
        assert expected in reason


@pytest.mark.parametrize("file", ["demos.jsonl", "learned.db"])
def test_a_quarantine_is_a_file_of_its_own(house, file):
    call(*options(house))
    before = (house / file).read_bytes()
    assert "--quarantine must be a file of its own" in refused(*options(house, quarantine=house / file))
    assert (house / file).read_bytes() == before


def test_a_name_of_ten_megabytes_is_cut_in_the_message(house):
    (house / "demos.jsonl").write_text('{"steps": [{"s": "' + "x" * 10**7 + '"}]}\n')
    assert "at most 4,194,304 bytes" in refused(*options(house))
    assert len(refused(*options(house, line_bytes=10**8))) < 1100


# -- mistakes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mdp": "patrol7"}, "patrol1, patrol2, patrol3, labyrinth or an .npz file, got 'patrol7'"),
        ({"mdp": "absent.npz"}, "absent.npz: No such file or directory"),
        ({"mdp": "broken.npz"}, "broken.npz: not an MDP archive"),
        ({"mdp": "poor.npz"}, "poor.npz: an MDP archive misses the array 'probabilities'"),
        ({"mdp": "patrol2", "observability": 17}, r"patrol2 has no 17 % view; it has \[11, 18, 30"),
        ({"observability": 30}, "--observability is for the patrols; give an MDP file an in_view array"),
        ({"demonstrations": "absent.jsonl"}, "absent.jsonl: No such file or directory"),
        ({"demonstrations": "."}, r"\.: Is a directory"),
        ({"statistic": "all"}, "statistic must be one of seen, counts, features, got 'all'"),
        (
            {"solver": "simplex"},
            "solver must be newton, ipopt, cvxpy or exponentiated gradient, got 'simplex'",
        ),
        ({"journal": "absent/learned.db"}, "there is no folder .*absent"),
        ({"journal": "demos.jsonl"}, "demos.jsonl cannot be read as a journal"),
    ],
)
def test_mistakes_in_the_options_are_told_in_one_line(house, monkeypatch, changes, message):
    monkeypatch.chdir(house)
    (house / "broken.npz").write_text("no archive")
    np.savez(house / "poor.npz", successors=np.zeros((2, 1, 1), int))
    before = sorted(os.listdir(house))
    assert re.search(message, refused(*options(house, **changes)))
    if "demonstrations" in changes:
        assert re.search(message, refused(*options(house, **changes), "--follow"))
    assert sorted(os.listdir(house)) == before  # a refused command leaves nothing behind


def test_a_broken_line_is_told_and_the_sessions_before_it_are_kept(house):
    (house / "demos.jsonl").write_text("".join([*LINES[:2], '{"steps": [{"s": "west"}, {"s": "attic"}]}\n']))
    result = CliRunner().invoke(app, ["--quiet", *options(house)])
    assert result.exit_code == 1
    assert result.stderr == (
        "Error: demos.jsonl, line 3, step 1: unknown state 'attic'; "
        "known are 'west', 'north', 'east', 'south'\n"
    )
    with Journal.read(house / "learned.db") as view:
        assert view.session == 2


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"statistic": "counts"}, r"statistic \(seen there, counts here\)"),
        ({"slack": 0.5}, r"slack \(0.002 there, 0.5 here\)"),
        ({"agent": 1}, r"agent \(0 there, 1 here\)"),
        ({"session_size": 2}, r"session_size"),
        ({"mdp": "other.npz"}, "MDP"),
    ],
)
def test_a_journal_of_something_else_is_refused(house, monkeypatch, changes, difference):
    monkeypatch.chdir(house)
    save_mdp("other.npz", circle(discount=0.8), IN_VIEW)
    call(*options(house, agent=0))
    told = refused(*options(house, **({"agent": 0} | changes)))
    assert re.search(f"what differs: {difference}", told)


def test_a_busy_journal_is_refused(house):
    with Journal.open(house / "learned.db", lme_i2rl(circle(), Visibility(IN_VIEW))):
        told = refused(*options(house))
    assert "learned.db is open for writing in this process: one writer at a time" in told


def test_what_is_no_journal_is_not_shown(house):
    assert "demos.jsonl cannot be read as a journal" in refused("show", house / "demos.jsonl")
    assert "absent.db does not exist" in refused("show", house / "absent.db")


def test_an_unknown_option_is_a_mistake_of_usage(house):
    result = CliRunner().invoke(app, [*options(house), "--sesion-size", "2"])
    assert result.exit_code == 2
    assert "No such option" in result.stderr


def test_commands_say_what_they_do_from_the_start_unless_they_are_quiet(house):
    (house / "demos.jsonl").write_text(LINES[0])
    result = CliRunner().invoke(app, options(house))
    assert result.exit_code == 0
    assert result.stderr.startswith("starting: the first step is compiled")
    assert call(*options(house, journal=house / "other.db")).stderr == ""


# -- as a process -----------------------------------------------------------------------------------------


def test_an_interrupted_learner_says_what_is_safe_and_goes_on_when_run_again(house):
    command = [*COMMAND, *options(house, demonstrations="-"), "--json"]
    learner = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    learner.stdin.write("".join(LINES[:3]))
    learner.stdin.flush()
    for session in (1, 2, 3):  # each is reported while the input is still open
        assert json.loads(learner.stdout.readline())["session"] == session
    learner.send_signal(signal.SIGINT)
    learner.wait(timeout=60)
    told = learner.stderr.read()
    learner.communicate()
    assert learner.returncode == 130, told
    assert re.fullmatch(r"Interrupted; 3 sessions are in .*learned\.db\. Run again to go on\.\n", told)
    assert "1 sessions learned (3 were in" in call(*options(house)).stdout


def test_an_interrupt_that_python_swallows_comes_again():
    script = """
import gc, sys, time
from i2rl.analysis.command import app as cli

def collecting(phase, info):  # JAX has such a callback, and Python goes on when Ctrl-C hits it
    gc.callbacks.remove(collecting)
    raise KeyboardInterrupt

def command():
    gc.callbacks.append(collecting)
    try:
        gc.collect()
        time.sleep(30)
        print("slept")
    except KeyboardInterrupt:
        print("interrupted")

cli.app = command
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=20)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


@pytest.mark.parametrize("flags", [["--json"], []], ids=["json", "table"])
def test_a_reader_that_leaves_is_no_error(house, flags):
    call(*options(house))
    shown = subprocess.Popen(
        [*COMMAND, "show", str(house / "learned.db"), *flags], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    shown.stdout.close()  # as head does, only sooner
    assert shown.stderr.read() == b""
    shown.stderr.close()
    assert shown.wait(timeout=60) == 141  # as of a tool that SIGPIPE ends


def test_a_learner_whose_reader_leaves_says_what_is_safe_and_goes_on_when_run_again(house):
    (house / "demos.jsonl").write_text("".join(LINES * 20))
    command = [*COMMAND, *options(house), "--json"]
    learner = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert json.loads(learner.stdout.readline())["session"] == 1
    learner.stdout.close()
    told = learner.stderr.read()
    learner.stderr.close()
    assert learner.wait(timeout=60) == 141, told
    found = re.fullmatch(
        r"The output's reader went away; (\d+) sessions are in .*learned\.db\. Run again to go on\.\n", told
    )
    with Journal.read(house / "learned.db") as view:
        assert view.session == int(found[1]) < 80
    assert f"{80 - int(found[1])} sessions learned ({found[1]} were in" in call(*options(house)).stdout


# -- the study --------------------------------------------------------------------------------------------


def test_bounds_answers_with_the_theorem_the_tighter_ones_and_what_is_assumed():
    asked = ["bounds", "--features", "6", "--epsilon", "0.1", "--confidence", "0.8"]
    told = CliRunner().invoke(app, asked)
    assert told.exit_code == 0
    assert "What is assumed" in told.output
    assert "trajectories are independent" in told.output
    content = json.loads(CliRunner().invoke(app, [*asked, "--json"]).stdout)
    sizes = {row["bound"]: row["trajectories"] for row in content["bounds"]}
    # Table 7.1(a) rounds 239.4 down; the promise needs 240.
    assert sizes["theorem"] == 240
    assert sizes["observed spread 0.05"] < sizes["exact completion"] < sizes["theorem"]


def test_bounds_of_a_domain_checks_what_it_can_and_says_what_is_worth_nothing():
    content = json.loads(CliRunner().invoke(app, ["bounds", "--mdp", "patrol2", "--json"]).stdout)
    holds = {a["name"]: a["holds"] for a in content["assumptions"]}
    assert holds["features"] is holds["weights"] is holds["soft_expert"] is True
    assert holds["independent"] is None
    assert content["ignorance_nats"] < content["bounds"][0]["error_nats"]
    assert content["informative"]["theorem"] > content["informative"]["observed spread"] > 240


def test_bounds_of_an_expert_outside_the_theorem_says_that_nothing_is_guaranteed():
    asked = ["bounds", "--mdp", "patrol3"]
    told = " ".join(CliRunner().invoke(app, asked).output.split())
    assert (
        "None of this is a guarantee here: it does not hold that the expert's weights lie in [0, 1]^K."
        in told
    )
    assert json.loads(CliRunner().invoke(app, [*asked, "--json"]).stdout)["violated"] == ["weights"]


def test_bounds_states_the_confidence_that_was_asked_for():
    told = CliRunner().invoke(app, ["bounds", "--features", "6", "--epsilon", "0.9", "--confidence", "0.8"])
    assert "with probability at least 0.8." in " ".join(told.output.split())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--features", "6", "--confidence", "1"], "confidence must lie strictly between 0 and 1, got 1.0"),
        (["--features", "6", "--epsilon", "1"], "epsilon is the error of an average of values in [0, 1]"),
        (["--features", "6", "--discount", "1"], "discount must lie in [0, 1), got 1.0"),
        ([], "say how many features the reward has"),
        (["--mdp", "patrol2", "--features", "6"], "leave those out"),
        (["--mdp", "labyrinth"], "patrol1, patrol2 or patrol3"),
    ],
)
def test_bounds_refuses_what_makes_no_sense(options, message):
    told = CliRunner().invoke(app, ["bounds", *options])
    assert told.exit_code == 1
    assert message in told.stderr


@pytest.mark.usefixtures("small_pictures")
def test_the_patrol_study_writes_its_page(tmp_path, page_faults):
    result = call(
        "run",
        "patrol",
        "--instance",
        2,
        "--sessions",
        3,
        "--trials",
        4,
        "--replications",
        1,
        "--folder",
        tmp_path / "report",
        "--json",
    )
    assert json.loads(result.stdout) == json.loads((tmp_path / "report" / "results.json").read_text())
    page = (tmp_path / "report" / "index.html").read_text()
    assert page_faults(page) == []
    told = json.loads(result.stdout)
    assert told["provenance"].keys() >= {"i2rl", "command", "seed", "versions"}
    patrollers = told["reward"]["learned, first replication"]
    assert [p["patroller"] for p in patrollers] == ["the first patroller", "the second patroller"]
    for p, weights in zip(
        patrollers, told["reward"]["by method, replication and patroller"]["LME-I2RL"][0], strict=True
    ):
        assert [w["weight"] for w in p["weights"]] == weights
        assert all(
            w["95 % interval"] is None or w["95 % interval"][0] < w["weight"] < w["95 % interval"][1]
            for w in p["weights"]
        )
    # What random weights score stands beside what was learned, in words.
    share = np.mean(np.array(told["random weights"]["LBA"]) >= told["methods"][0]["LBA"] - 1e-9)
    assert f"{100 * share:.1f} % have the" in page
    lengths, values = told["true weights"].values()
    assert values[lengths.index(1.0)] == pytest.approx(told["methods"][-1]["log-likelihood"])
    pictures = sorted((tmp_path / "report").glob("*.png"))
    assert len(pictures) == 2 * page.count("<picture>") > 0  # for light and for dark screens
    for picture in pictures:
        assert base64.b64encode(picture.read_bytes()).decode() in page
