"""``i2rl run robust-airl`` on patrol: its page, its output, and its errors."""

from __future__ import annotations

import json
import re
from functools import partial

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.studies.adversarial import patrol as adversarial_patrol
from i2rl.analysis.studies.adversarial.cases import PLANS
from i2rl.analysis.studies.adversarial.page import breach_table, learning_table
from i2rl.analysis.studies.adversarial.patrol import believed_trajectories, patrol_results
from i2rl.analysis.studies.adversarial.results import (
    CLEAN,
    LEARNED,
    NOISY,
    ROBUST,
    AdversarialResults,
    MethodResult,
    load_results,
)
from i2rl.analysis.studies.adversarial.running import answer
from i2rl.analysis.studies.adversarial.study import adversarial_study, run
from i2rl.domains.patrol.process import FORWARD, LEFT, RIGHT

TRIALS, SESSIONS = 3, 2


@pytest.fixture(scope="module")
def printed_report(tmp_path_factory):
    """Return the folder of a tiny page, and the JSON printed with it."""
    folder = tmp_path_factory.mktemp("report")
    small = partial(patrol_results, trials=TRIALS, iterations=3)
    command = ["run", "robust-airl", "--domain", "patrol", "--replications", "1", "--sessions", str(SESSIONS)]
    # Compilation takes nearly all of the time.
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(adversarial_patrol, "patrol_results", small)
            result = CliRunner().invoke(app, [*command, "--noise", "4", "--folder", str(folder), "--json"])
    finally:
        jax.config.update("jax_disable_most_optimizations", False)
        jax.clear_caches()  # of slow programs
    assert result.exit_code == 0, (result.stderr, result.exception)
    return folder, json.loads(result.stdout)["domains"][0]


def test_every_method_is_told_in_json(printed_report):
    _, printed = printed_report
    assert [m["method"] for m in printed["methods"]] == [CLEAN, NOISY, ROBUST, LEARNED]
    assert printed["settings"]["probability of a wrong observation"] == pytest.approx(4 * 0.05)
    for method in printed["methods"]:
        accuracy, pairs = np.array(method["accuracy"]), np.array(method["pairs"])
        assert accuracy.shape == (1, SESSIONS)
        np.testing.assert_allclose(accuracy * 124, np.round(accuracy * 124))  # shares of 124 states
        assert (accuracy > 0.25).all()  # better than one of four actions at random
        sizes = np.diff(pairs, prepend=0)
        assert ((sizes >= 32) & (sizes <= 128)).all()
        successes = np.array(method["breaches"]) * TRIALS
        np.testing.assert_allclose(successes, np.round(successes))
    assert 0 <= printed["expert breaches"] <= 1


def test_the_report_has_its_page_its_numbers_and_its_figures_in_both_themes(printed_report):
    folder, printed = printed_report
    page = (folder / "index.html").read_text()
    for words in ("20 % of the time", "is left out: the dissertation applies", "breaches that succeed"):
        assert words in page
    assert json.loads((folder / "results.json").read_text())["domains"] == [printed]
    for name in ("patrol-learning", "recovery", "strip-0"):
        for theme in ("light", "dark"):
            assert (folder / f"{name}-{theme}.png").read_bytes().startswith(b"\x89PNG")


def test_the_believed_trajectory_is_possible_under_the_sensor(printed_report):
    folder, _ = printed_report
    ((strip, mdp),) = believed_trajectories(load_results(folder / "patrol.results.json"))
    np.testing.assert_allclose(strip.posterior.sum((1, 2)), 1)
    seen, truth = strip.seen, strip.truth
    assert (seen.action != truth.action).any()
    possible = np.zeros(strip.posterior.shape, bool)
    steps = np.arange(len(possible))
    possible[steps, seen.state[0], seen.action[0]] = True
    for happened, reported in ((FORWARD, LEFT), (RIGHT, FORWARD)):
        here = seen.action[0] == reported
        possible[steps[here], seen.state[0, here], happened] = True
    assert (strip.posterior[~possible] == 0).all()
    assert (strip.posterior[steps, truth.state[0], truth.action[0]] > 0).all()
    assert mdp.n_states == strip.posterior.shape[1]


def test_reports_without_an_error_have_nothing_to_show():
    rare = {
        adversarial_patrol.MISREPORT: 1e-9,
        adversarial_patrol.POLICY: np.full((124, 4), 0.25).tolist(),
    }
    assert believed_trajectories(AdversarialResults("patrol", "", 1, "", {}, settings=rare)) == ()


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("0", "noise is a multiple, above zero, of the study's own; got 0.0"),
        ("21", "noise multiplies the probability of 0.05 that an observation errs; .* at most 20; got 21.0"),
    ],
)
def test_noise_that_cannot_be_is_refused(tmp_path, noise, message):
    command = ["run", "robust-airl", "--domain", "patrol", "--noise", noise, "--folder", str(tmp_path / "no")]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 1, (result.stdout, result.exception)
    assert not result.stdout
    assert re.search(f"^Error: {message}\n$", result.stderr, re.MULTILINE)
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(("replications", "sessions", "what"), [(0, 2, "seed"), (1, 0, "session")])
def test_counts_below_one_are_refused(replications, sessions, what):
    with pytest.raises(ValueError, match=f"at least one {what}, got 0"):
        patrol_results(replications, sessions)


def test_shares_of_few_seeds_stay_within_a_hundred_percent():
    accuracy, breaches = np.array([[0.7, 0.99], [0.8, 0.97]]), np.array([0.2, 0.95])
    methods = {NOISY: MethodResult(np.array([40, 90]), accuracy, breaches=breaches)}
    results = AdversarialResults("patrol", "", 2, "", methods, expert_breaches=0.975)
    expert, noisy = breach_table(results).rows
    assert expert == ("expert", "-", "97.5", "-")
    assert noisy[2] == "57.5 (0.0 to 100.0)"
    # Student's quantile of one degree of freedom is 12.706.
    (row,) = learning_table(results).rows
    assert row[2] == f"98.0 ({98 - 12.706:.1f} to 100.0)"


def test_studies_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match=r"domain is one of patrol, hopper.*got 'ant'"):
        answer("ant")
    with pytest.raises(ValueError, match="at least one session, got 0"):
        adversarial_study("mountain-car", 1, PLANS["mountain-car"]._replace(sessions=0))
    with pytest.raises(ValueError, match=r"method is one of AIRL, clean input.*got 'AIRL'"):
        run("mountain-car", "AIRL", 0, PLANS["mountain-car"])
