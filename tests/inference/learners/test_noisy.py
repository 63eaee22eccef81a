"""RIMEO: perception and reward learned together, its variants and controls."""

from __future__ import annotations

import dataclasses
from collections import namedtuple
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.noisy import tasks as noisy_perception
from i2rl.inference import Journal, MovingWindow, fleet, run_sessions
from i2rl.inference.learners.lme import lme_i2rl
from i2rl.inference.learners.noisy import rifom, rimeo, robust_irl
from i2rl.inference.sensors.observations import CERTAIN
from i2rl.inference.sensors.reliabilities import WithTruth
from i2rl.models import Demonstration, DemonstrationError, FeatureNoise, TrajectoryLaw, Visibility
from i2rl.models.observation.demonstration import HIDDEN, PAD, SEEN, concatenate
from i2rl.models.observation.evidence import Sensor

KEY = jax.random.key(0)


@cache
def task():
    return noisy_perception.noisy_sorting()


@cache
def learned_with(scores):
    return rimeo(stream()[0], task().features, scores=scores)


@cache
def learned_half_hidden(solver):
    mdp, visibility = stream()[0], Visibility(np.full(22, 0.5))
    return rimeo(mdp, task().features, visibility=visibility, scores="none", solver=solver), visibility


@cache
def stream(scores="calibrated", sessions=6):
    shown = noisy_perception.demonstrate_noisy(
        jax.random.key(5), task(), sessions=sessions, scores=scores, starts="all"
    )
    return shown.mdp, list(shown.seen.sessions(2)), list(shown.truth.sessions(2))


def divergence(task, agreement):
    weights = task.pair_distribution("all", 3)
    p = noisy_perception.agreement_probabilities(task.noise, task.predicates, weights)
    q = np.clip(np.asarray(agreement)[: len(p)], 1e-12, 1 - 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(p > 0, p * np.log(p / q), 0) + np.where(
            p < 1, (1 - p) * np.log((1 - p) / (1 - q)), 0
        )
    return terms.mean()


# -- what it learns -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scores", ["averaged", "stepwise", "none"])
def test_the_sensor_is_learned_far_better_than_a_guess_of_one_half(scores):
    _mdp, seen, _ = stream()
    run = run_sessions(learned_with(scores), seen, key=KEY)
    assert divergence(task(), run.infos[-1].agreement) < divergence(task(), np.full(8, 0.5)) / 6


def test_knowing_the_truth_is_the_upper_bound_of_the_alternation():
    mdp, seen, truth = stream()
    oracle = rimeo(mdp, task().features, scores="none", completion="oracle")
    run = run_sessions(oracle, map(WithTruth, seen, truth), key=KEY)
    reports, happened = concatenate(seen), concatenate(truth)
    psi = task().features
    share = (psi[:, reports.state, reports.action] == psi[:, happened.state, happened.action]).mean((1, 2))
    # Only the slack of a quarter of an observation, and forgetting, differ.
    assert np.abs(run.infos[-1].agreement - share).max() < 0.06


def test_alternations_climb_the_exact_likelihood_of_the_reports():
    mdp, seen, _ = stream("calibrated", 12)
    everything = concatenate(seen)
    psi = task().features
    learner = rimeo(
        mdp,
        psi,
        scores="none",
        statistic="counts",
        iterations=1,
        tolerance=0.0,
        observation_slack=0.0,
        ridge=0.01,
    )
    start = learner.init(KEY)
    values = []
    for _ in range(5):
        # Resumed without memory: one alternation on the same observations.
        state, report = learner.update(start, everything)
        sensor = FeatureNoise(psi, np.asarray(jax.nn.sigmoid(state.logits)))
        law = TrajectoryLaw(mdp, state.weights, sensor, 3)
        exact = float(np.sum(law.log_prob(jnp.asarray(everything.codes))))
        np.testing.assert_allclose(report.demonstration_log_likelihood, exact, rtol=1e-10)
        values.append(exact - 0.005 * float(state.weights @ state.weights))
        start = start._replace(weights=state.weights, values=state.values, logits=state.logits)
    assert (np.diff(values) > -1e-6).all()
    assert values[-1] > values[0] + 0.1


def test_with_a_reliable_sensor_it_is_online_maximum_entropy_irl():
    mdp, _, truth = stream()
    identity = np.arange(mdp.n_states * mdp.n_actions).reshape(1, mdp.n_states, mdp.n_actions)
    settings = {"slack": 0.0, "ridge": 0.1, "iterations": 30, "tolerance": 1e-8}
    ours = rimeo(
        mdp, identity, scores="none", start=1 - 1e-6, observation_slack=0.0, forgetting=1.0, **settings
    )
    theirs = lme_i2rl(mdp, Sensor(), **settings)
    a, b = (run_sessions(x, truth, key=KEY).state.weights for x in (ours, theirs))
    np.testing.assert_allclose(a, b, atol=1e-3)


def test_a_score_of_nearly_one_makes_reports_the_truth():
    _mdp, _, truth = stream()
    sure = [replace(x, score=np.where(x.kind == SEEN, 1.0, np.nan)) for x in truth]
    report = run_sessions(learned_with("stepwise"), sure, key=KEY).infos[-1]
    assert report.agreement.min() > 0.99


def test_what_is_hidden_as_well_is_summed_out():
    mdp, seen, _ = stream()
    learner, visibility = learned_half_hidden("newton")
    hidden = np.random.default_rng(0).random((2, 3)) < 0.5
    hidden[0, 0] = False
    partly = [
        replace(
            x,
            kind=np.where(hidden, HIDDEN, x.kind),
            state=np.where(hidden, -1, x.state),
            action=np.where(hidden, -1, x.action),
            score=np.where(hidden, np.nan, x.score),
        )
        for x in seen
    ]
    state, report = learner.update(learner.init(KEY), partly[0])
    noise = FeatureNoise(task().features, np.asarray(jax.nn.sigmoid(state.logits)))
    law = TrajectoryLaw(mdp, state.weights, noise * visibility, 3)
    np.testing.assert_allclose(
        report.demonstration_log_likelihood, np.sum(law.log_prob(jnp.asarray(partly[0].codes))), rtol=1e-9
    )
    assert float(state.observation_statistic.size) == (~hidden).sum()


@pytest.mark.parametrize("solver", ["newton", "ipopt"])
def test_sessions_without_a_report_do_not_unlearn_what_was_assumed(solver):
    _mdp, seen, _ = stream()
    learner, _ = learned_half_hidden(solver)
    nothing = Demonstration(
        np.full((2, 3), HIDDEN, np.int8), *np.full((2, 2, 3), -1, np.int32), np.full((2, 3), np.nan)
    )
    start = learner.init(KEY)
    state, report = learner.update(start, nothing)
    assert np.isnan(report.agreement).all()
    np.testing.assert_array_equal(state.logits, start.logits)
    late = learner.update(state, seen[0])[1].agreement
    # Chance agrees on these predicates far less often than perception that is thought to be right.
    np.testing.assert_allclose(late, learner.update(start, seen[0])[1].agreement, atol=0.02)


# -- the session protocol -----------------------------------------------------------------------------


def test_casadi_and_compiled_programs_agree():
    mdp, seen, _ = stream()
    compiled = run_sessions(rimeo(mdp, task().predicates, tolerance=1e-9), seen[:2], key=KEY).infos
    posed = run_sessions(
        rimeo(mdp, task().predicates, solver="ipopt", tolerance=1e-9), seen[:2], key=KEY
    ).infos
    for a, b in zip(compiled, posed, strict=True):
        np.testing.assert_allclose(a.agreement, b.agreement, atol=1e-5)
        np.testing.assert_allclose(a.weights, b.weights, atol=1e-4)


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(tmp_path):
    _mdp, seen, _ = stream()
    learner = learned_with("averaged")
    whole = run_sessions(learner, seen, key=KEY)
    with Journal.open(tmp_path / "run.i2rl", learner) as journal:
        run_sessions(learner, seen[:3], key=KEY, journal=journal)
    with Journal.open(tmp_path / "run.i2rl", learner) as journal:
        resumed = run_sessions(learner, seen[3:], journal=journal)
    for a, b in zip(jax.tree.leaves(whole.state), jax.tree.leaves(resumed.state), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_a_journal_written_before_a_field_was_renamed_is_resumed(tmp_path):
    _mdp, seen, _ = stream()
    learner = learned_with("averaged")
    state, info = learner.update(learner.init(KEY), seen[0])
    names = ["reports" if name == "observation_statistic" else name for name in state._fields]
    former = namedtuple("Former", names)(*state)
    with Journal.open(tmp_path / "run.i2rl", learner) as journal:
        journal.commit(former, info)
    with Journal.open(tmp_path / "run.i2rl", learner) as journal:
        assert type(journal.state) is type(state)
        for name, value in state.observation_statistic._asdict().items():
            np.testing.assert_array_equal(getattr(journal.state.observation_statistic, name), value)


def test_padding_changes_nothing():
    _mdp, seen, _ = stream()
    learner = learned_with("averaged")
    state = learner.init(KEY)
    fill = {"kind": PAD, "state": -1, "action": -1, "score": np.nan}
    padded = Demonstration(
        *(np.pad(getattr(seen[0], f), ((0, 2), (0, 1)), constant_values=v) for f, v in fill.items())
    )
    a, b = learner.update(state, seen[0]), learner.update(state, padded)
    np.testing.assert_allclose(a[1].weights, b[1].weights, atol=1e-9)
    np.testing.assert_allclose(a[1].agreement, b[1].agreement, atol=1e-9)


def test_a_fleet_learns_what_its_learners_learn():
    _mdp, seen, _ = stream()
    learner = learned_with("averaged")
    many = fleet(learner)
    states = many.init(KEY, 2)
    both = jax.tree.map(lambda *x: np.stack(x), seen[0], seen[1])
    _, reports = many.update(states, both)
    for i, key in enumerate(jax.random.split(KEY, 2)):
        alone = learner.update(learner.init(key), seen[i])[1]
        np.testing.assert_allclose(reports.agreement[i], alone.agreement, atol=1e-8)
    # A fleet raises nothing; what cannot be leaves its learner as it was.
    left, reports = many.update(states, replace(both, state=both.state + np.array([99, 0])[:, None, None]))
    np.testing.assert_array_equal(np.isneginf(reports.demonstration_log_likelihood), [True, False])
    for field in ("weights", "logits", "session"):
        np.testing.assert_array_equal(getattr(left, field)[0], getattr(states, field)[0])
    assert list(left.session) == [0, 1]


def test_the_moving_window_stops_a_stream_that_has_settled():
    _mdp, seen, _ = stream()
    run = run_sessions(
        learned_with("averaged"), seen * 10, key=KEY, stop=MovingWindow(5, 0.05, of="gradient")
    )
    assert run.stopped
    assert len(run.infos) < 60


# -- variants and controls ----------------------------------------------------------------------------


def test_taking_reports_for_truths_ends_in_believing_them():
    mdp, seen, _ = stream()
    report = run_sessions(
        rimeo(mdp, task().features, scores="none", completion="observed"), seen, key=KEY
    ).infos[-1]
    assert report.agreement.min() > 0.98


def test_fair_frequencies_are_the_smoothed_mean_score():
    mdp, seen, _ = stream()
    report = run_sessions(rifom(mdp, task().features), seen, key=KEY).infos[-1]
    scores = np.clip(np.concatenate([x.score.ravel() for x in seen]), 1 - CERTAIN, CERTAIN)
    np.testing.assert_allclose(report.agreement, (scores.sum() + 1) / (len(scores) + 2))


def test_coded_frequencies_credit_what_is_true_of_each_last_report():
    mdp, seen, _ = stream()
    report = run_sessions(rifom(mdp, task().predicates, form="coded"), seen[:1], key=KEY).infos[-1]
    true = task().predicates[:, seen[0].state[:, -1], seen[0].action[:, -1]].sum(1) + 1e-4
    np.testing.assert_allclose(report.agreement, true / (true.sum() + 8e-4))


def test_the_printed_program_is_no_better_than_a_guess():
    mdp, seen, _ = stream()
    learner = rimeo(mdp, task().predicates, completion="all")
    report = run_sessions(learner, seen, key=KEY).infos[-1]
    assert divergence(task(), report.agreement) > divergence(task(), np.full(8, 0.5)) / 6


def test_robust_irl_knows_its_sensor():
    mdp, seen, _ = stream()
    fit = robust_irl(mdp, task().noise, restarts=1).fit(KEY, concatenate(seen))
    assert np.isfinite(fit.log_likelihood)
    with pytest.raises(ValueError, match="observation model"):
        robust_irl(mdp, Sensor())


# -- bad input ----------------------------------------------------------------------------------------


def test_scores_that_are_missing_or_no_probabilities_are_named():
    mdp, seen, _ = stream()
    learner = learned_with("averaged")
    state = learner.init(KEY)
    score = seen[0].score.copy()
    score[1, 2] = 1.2
    with pytest.raises(DemonstrationError, match=r"trajectory 1, step 2: score must lie in \[0, 1\]"):
        learner.update(state, replace(seen[0], score=score))
    score[1, 2] = np.nan
    with pytest.raises(DemonstrationError, match="trajectory 1, step 2: the report has no score"):
        learner.update(state, replace(seen[0], score=score))
    partly = rimeo(mdp, task().features, unscored=True)
    assert np.isfinite(partly.update(partly.init(KEY), replace(seen[0], score=score))[1].agreement).all()


def test_predicates_of_another_shape_and_silent_ones_are_named():
    mdp, _, _ = stream()
    with pytest.raises(ValueError, match=r"\[J, S, A\] = \[J, 22, 7\], got \[8, 7, 22\]"):
        rimeo(mdp, np.swapaxes(task().predicates, 1, 2))
    silent = np.concatenate([task().predicates, np.ones((1, *mdp.available.shape), bool)])
    names = (*task().predicate_names, "onions exist")
    with pytest.warns(UserWarning, match="onions exist is the same for everything.*uninformative"):
        rimeo(mdp, silent, names=names)


def test_a_report_no_truth_could_give_is_named_and_costs_nothing():
    mdp, seen, _ = stream()
    reportable = np.ones(mdp.available.shape, bool)
    reportable[seen[0].state[1, 1], seen[0].action[1, 1]] = False
    learner = rimeo(mdp, task().features, reportable=reportable)
    state = learner.init(KEY)
    with pytest.raises(DemonstrationError, match="trajectory 1, step 1"):
        learner.update(state, seen[0])
    barred = (seen[0].state[1, 1], seen[0].action[1, 1])
    possible = next(x for x in seen if not ((x.state == barred[0]) & (x.action == barred[1])).any())
    after, fresh = (learner.update(x, possible)[1] for x in (state, learner.init(KEY)))
    np.testing.assert_array_equal(after.agreement, fresh.agreement)
    # In a fleet, which cannot raise, an impossible session leaves the state unchanged.
    assert learner.session is not None
    left, report = jax.jit(learner.session)(state, seen[0].bucketed())
    assert np.isneginf(report.demonstration_log_likelihood)
    for a, b in zip(
        jax.tree.leaves(left._replace(key=0)), jax.tree.leaves(state._replace(key=0)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_truths_that_do_not_fit_the_reports_are_named():
    mdp, seen, truth = stream()
    learner = rimeo(mdp, task().features, scores="none", completion="oracle")
    state = learner.init(KEY)
    with pytest.raises(DemonstrationError, match=r"one shape, got \[1, 3\] and \[2, 3\]"):
        learner.update(state, WithTruth(seen[0], truth[0].select([0])))
    lost = truth[0].state.copy()
    lost[1, 2] = -1
    with pytest.raises(DemonstrationError, match="trajectory 1, step 2: what happened must be a pair"):
        learner.update(state, WithTruth(seen[0], replace(truth[0], state=lost)))
    with pytest.raises(ValueError, match="forgetting must be an exponent"):
        rifom(mdp, task().features, forgetting=2.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": np.full(3, 0.7)}, r"one for each of 8 predicates, got \[3\]"),
        ({"visibility": Visibility(np.ones(1))}, "the MDP has 22 states"),
        ({"scores": "some"}, "scores must be one of"),
        ({"completion": "guess"}, "completion must be one of"),
        ({"observation_slack": -1.0}, "errors must be"),
        ({"forgetting": 0.0}, "forgetting must be an exponent"),
        ({"start": 1.0}, "between 0 and 1"),
        ({"iterations": 0}, "at least one iteration"),
        ({"completion": "all", "scores": "none"}, "made of scores"),
        ({"visibility": FeatureNoise(np.ones((1, 22, 7), bool), np.array([0.5]))}, "learned, not given"),
    ],
)
def test_settings_out_of_range_are_named(options, message):
    mdp, _, _ = stream()
    with pytest.raises(ValueError, match=message):
        rimeo(mdp, task().predicates, **options)


def test_discount_one_is_refused():
    mdp, _, _ = stream()
    with pytest.raises(ValueError, match="discount"):
        rimeo(dataclasses.replace(mdp, discount=1.0), task().predicates)
