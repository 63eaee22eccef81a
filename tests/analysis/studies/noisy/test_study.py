import io
import json
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from scipy.stats import entropy
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.analysis.judging.metrics import learned_behavior_accuracy
from i2rl.analysis.studies.noisy import figures as noisy_figures
from i2rl.analysis.studies.noisy import page as noisy_report
from i2rl.analysis.studies.noisy import study as noisy_study
from i2rl.analysis.studies.noisy.examples import SensorPosterior, per_belt, sorted_belts, strip
from i2rl.analysis.studies.noisy.study import (
    PLAIN,
    divergence,
    draw_streams,
    mean_interval,
    taken_at_face_value,
)
from i2rl.domains.noisy.tasks import agreement_probabilities, demonstrate_noisy, noisy_sorting
from i2rl.inference.sessions.learner import Learner
from i2rl.models import Demonstration


@cache
def task():
    return noisy_sorting()


@cache
def small():
    return noisy_study.noisy_study(
        "sorting", replications=2, sessions=2, seed=3, belts=8, draws=0, methods=("MLIRL, batch",)
    )


def test_divergence_is_that_of_bernoulli_distributions():
    rng = np.random.default_rng(0)
    truth, estimate = rng.uniform(size=5), rng.uniform(size=(3, 5))
    pairs = [[entropy([p, 1 - p], [q, 1 - q]) for p, q in zip(truth, row, strict=True)] for row in estimate]
    np.testing.assert_allclose(divergence(truth, estimate), np.mean(pairs, 1), atol=1e-12)
    sure = np.array([0.0, 1.0, 0.3])
    assert divergence(sure, sure) == pytest.approx(0, abs=1e-11)
    # Wrong certainty costs much, but not everything.
    assert 20 < divergence(np.ones(1), np.zeros(1)) < 30


def test_control_is_log_two_less_the_entropy_of_the_truth():
    study = small()
    p = study.true_agreement
    exact = agreement_probabilities(task().noise, task().predicates, task().pair_distribution("all", 3))
    np.testing.assert_allclose(p, exact)
    assert study.control == pytest.approx(np.mean(np.log(2) - entropy(np.stack([p, 1 - p]))))


def test_mean_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    band = mean_interval(rng.exponential(size=(60, 3000)))
    assert np.mean((band.low < 1) & (band.high > 1)) == pytest.approx(0.94, abs=0.02)
    assert np.isnan(mean_interval(np.ones((1, 2))).low).all()


def test_streams_are_the_demonstration_cut_into_runs_and_sessions():
    key, replications, sessions = jax.random.key(4), 2, 2
    streams = draw_streams(key, task(), replications=replications, sessions=sessions)
    drawn = demonstrate_noisy(key, task(), sessions=replications * sessions, scores="calibrated")
    for i, session in enumerate(drawn.seen.sessions(2)):
        for ours, theirs in zip(streams.session(*divmod(i, sessions)).arrays, session.arrays, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    whole = streams.whole(1, "truth")
    np.testing.assert_array_equal(whole.state, np.asarray(drawn.truth.state)[4:8])
    # Some observations are wrong, or the sensor would be trivial.
    assert (np.asarray(streams.seen.state) != np.asarray(streams.truth.state)).any()


@pytest.mark.parametrize("fed", ["seen", "truth", "both"])
def test_learners_get_those_sessions_one_after_the_other(fed):
    class Noted(NamedTuple):
        weights: jax.Array
        agreement: jax.Array

    def session(state, demonstration):
        seen, truth = demonstration if fed == "both" else (demonstration, demonstration)
        state = 10 * state + jnp.sum(seen.state)
        return state, Noted(state[None], jnp.sum(truth.action)[None])

    streams = draw_streams(jax.random.key(4), task(), replications=2, sessions=2)
    learner = Learner("noting", streams.mdp, {}, lambda key: jnp.zeros((), int), None, session)
    entry = noisy_study._Entry(lambda mdp, task: learner, fed)
    weights, agreement, last = noisy_study._learned(jax.random.key(0), learner, streams, entry)
    for run in range(2):
        noted = 0
        for t in range(2):
            noted = 10 * noted + streams.session(run, t, "truth" if fed == "truth" else "seen").state.sum()
            assert weights[run, t, 0] == noted
            done = streams.session(run, t, "seen" if fed == "seen" else "truth").action.sum()
            assert agreement[run, t, 0] == done
        assert last[run] == noted


def test_results_are_judged_by_the_expert_and_by_the_true_sensor():
    result, truth = small().results[PLAIN], small().true_agreement
    assert result.agreement.shape == (2, 2, len(task().features))
    assert result.divergence[1, 0] == pytest.approx(divergence(truth, result.agreement[1, 0, : len(truth)]))
    overall, choice = learned_behavior_accuracy(
        task().mdp, jnp.asarray(task().weights), jnp.asarray(result.weights[1, -1])
    )
    np.testing.assert_allclose(result.accuracy[1, -1, :2], [overall, choice])
    assert small().results["MLIRL, batch"].divergence is None


def test_what_is_not_offered_is_dropped_at_face_value():
    mdp = task().mdp
    offered = np.argwhere(np.asarray(mdp.available))
    s, a = np.argwhere(~np.asarray(mdp.available))[0]
    (s1, a1), (s2, a2) = offered[0], offered[-1]
    reports = Demonstration.from_pairs([[s1, s, s2]], [[a1, a, a2]])
    anywhere, kept = taken_at_face_value(mdp, reports)
    assert kept.state.tolist() == [[s1], [s2]]
    assert kept.action.tolist() == [[a1], [a2]]
    assert (np.asarray(anywhere.initial) > 0).all()


def test_an_infallible_sensor_believes_what_it_sees():
    drawn = strip(jax.random.key(0), task(), task().weights, np.full(10, 1 - 1e-9))
    np.testing.assert_allclose(drawn.posterior.sum((1, 2)), 1, atol=1e-9)
    seen = np.arange(12), drawn.seen.state[0], drawn.seen.action[0]
    available = np.asarray(task().mdp.available)[seen[1:]]
    # Features are equal for an onion in hand that was judged good and for an unknown one.
    believed = np.argmax(drawn.posterior.reshape(12, -1), axis=1)
    features = task().features.reshape(10, -1)
    flat = seen[1] * task().mdp.n_actions + seen[2]
    np.testing.assert_array_equal(features[:, believed][:, available], features[:, flat][:, available])


def test_the_true_reward_sorts_as_the_expert_does():
    table = sorted_belts(jax.random.key(1), task(), {"RIMEO": np.tile(task().weights, (4, 1))}, belts=400)
    expert, learned = table.rows
    assert sum(per_belt(learned)) == pytest.approx(24)
    for measure in ("precision", "recall"):
        ours, theirs = (getattr(row.tally, measure)().value for row in (learned, expert))
        assert ours == pytest.approx(theirs, abs=0.03)
    assert learned.published.precision().value == pytest.approx(8 / 9)


@pytest.mark.usefixtures("small_pictures")
def test_page_has_every_method_and_both_themes(tmp_path, page_faults):
    study = small()
    page = noisy_report.write(study, tmp_path).read_text()
    assert page_faults(page) == []
    # Results of sorting onions appear in no other task.
    assert "96.7 s" in page
    assert "96.7 s" not in noisy_report.pace_table(study._replace(belts=None)).caption
    stored = json.loads((tmp_path / "results.json").read_text())
    np.testing.assert_allclose(stored["methods"][0]["weights"], study.results[PLAIN].weights[:, -1])
    assert stored["provenance"]["seed"] == 3
    assert [m["method"] for m in stored["methods"]] == list(study.results)
    assert {PLAIN, "MLIRL, batch"} == set(study.results)
    for name in study.results:
        assert name in page
    assert page.count("<picture>") == 4
    assert len(list(tmp_path.glob("*-dark.png"))) == len(list(tmp_path.glob("*-light.png"))) == 4
    console = Console(file=io.StringIO(), width=140)
    noisy_report.print_tables(study, console)
    assert "constant one half" in console.file.getvalue()


def test_sensor_plot_has_each_feature_and_the_truth_where_it_is():
    truth = np.array([0.7, 0.95])
    draws = np.random.default_rng(2).beta(20, 5, size=(50, 2))
    posterior = SensorPosterior(
        ("forward", "state"), draws, draws.mean(0), truth, np.array([0.8, 1.0]), 12, 0
    )
    axes = noisy_figures.sensor_plot(posterior, LIGHT).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["forward", "state"]
    median, marked, learned, happened = (line.get_xdata() for line in axes.get_lines())
    np.testing.assert_allclose(marked, truth)
    np.testing.assert_allclose(learned, draws.mean(0))
    np.testing.assert_allclose(happened, [0.8, 1.0])
    low, high = axes.get_xlim()
    assert low < min(truth.min(), median.min())
    assert high == 1


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_strip_marks_every_report_and_every_truth(theme):
    drawn = small().strip
    axes = noisy_figures.strip_plot(drawn, task().mdp, theme).axes[0]
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert len(set(names)) == len(names)
    for line, demonstration in zip(axes.get_lines()[:2], (drawn.seen, drawn.truth), strict=True):
        for t, row in enumerate(line.get_ydata()):
            assert names[int(row)].endswith(task().mdp.action_names[demonstration.action[0, t]])


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="tasks are sorting, patrol; got 'laundry'"):
        noisy_study.noisy_study("laundry")
    with pytest.raises(ValueError, match="replications must be at least 1, got 0"):
        noisy_study.noisy_study("sorting", replications=0)
    with pytest.raises(ValueError, match=r"methods are RIMEO, no scores; .*; got 'AIRL'"):
        noisy_study.noisy_study("sorting", methods=("AIRL",))


@pytest.mark.usefixtures("small_pictures")
def test_command_writes_its_page(tmp_path, monkeypatch):
    monkeypatch.setattr(
        noisy_study, "noisy_study", lambda name, **options: small()._replace(seed=options["seed"])
    )
    options = ["--replications", "2", "--sessions", "2", "--seed", "5", "--folder", str(tmp_path), "--json"]
    result = CliRunner().invoke(app, ["run", "noisy-sorting", *options])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["seed"] == 5
    assert "RIMEO" in (tmp_path / "index.html").read_text()
    wrong = CliRunner().invoke(app, ["run", "noisy-patrol", "--starts", "somewhere"])
    assert wrong.exit_code != 0


def test_where_the_experts_errors_could_be_the_sensors_no_number_is_quoted():
    shares = np.ones((2, len(task().predicates)))
    doubt = noisy_study.SensorDoubt(shares, shares - 0.2, np.zeros(shares.shape, bool))
    study = small()._replace(doubt={PLAIN: doubt})
    row = next(r for r in noisy_report.sensor_table(study).rows if r[0] == PLAIN)
    assert row[1] == "not identified"
    assert not any(character.isdigit() for cell in row[1:] for character in str(cell))
    kept = {m["method"]: m["divergence"] for m in noisy_report.summary(study)["methods"]}
    assert kept[PLAIN] is None
