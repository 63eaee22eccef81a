"""LME-I2RL with the kept likelihood: online, and as good as batch learning where steps are read wrongly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.benchmarks.online.kept_likelihood import chain
from i2rl.inference import Journal, batch_lme, fit_counts, lme_i2rl, run_sessions
from i2rl.inference.completion.smoothing import evidence_of, log_likelihoods
from i2rl.inference.learners.lme import lme_i2rl_with_random_weights
from i2rl.inference.sessions.kept_likelihood import (
    exact_steps,
    log_policy_of,
    model_log_likelihood,
    surrogate,
)
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    FeatureNoise,
    TrajectoryLaw,
    Visibility,
    concatenate,
    reward_of,
    soft_plan,
)
from i2rl.models.observation.demonstration import LOST

KEY = jax.random.key(0)
CHAIN = chain()
STEPS, RIDGE, TRUTH = 16, 0.02, np.array([0.0, 1.5])
STATES = CHAIN.n_states


@cache
def flipped() -> FeatureNoise:
    """Build a sensor that reads the state rightly, and the action in 65 of 100 cases."""
    return FeatureNoise(np.indices((STATES, 2)), np.array([1 - 1e-9, 0.65]))


def demonstrated(sensor, n: int, seed: int = 0) -> Demonstration:
    law = TrajectoryLaw(CHAIN, TRUTH, sensor, STEPS)
    return Demonstration.from_codes(np.asarray(law.sample(jax.random.key(seed), (n,))))


def whole() -> Visibility:
    return Visibility(np.ones(STATES))


@cache
def learner():
    return lme_i2rl(CHAIN, flipped(), statistic="likelihood")


def policy_error(weights) -> float:
    ours, truth = (soft_plan(CHAIN, reward_of(CHAIN, jnp.asarray(w))).policy for w in (weights, TRUTH))
    return float(jnp.max(jnp.abs(ours - truth)))


@cache
def exact_learner():
    return lme_i2rl(CHAIN, whole(), statistic="likelihood")


@pytest.mark.parametrize("lost", [False, True])
def test_what_is_read_exactly_or_lost_throughout_is_learned_as_in_batch(lost):
    shown = demonstrated(whole(), 96)
    visits = np.zeros((STATES, 2))
    kept = shown.select(slice(0, 64)) if lost else shown
    np.add.at(visits, (kept.state, kept.action), 1)
    if lost:
        gone = shown.select(slice(64, 96))
        nothing = np.full_like(gone.state, -1)
        gone = Demonstration(
            np.full_like(gone.kind, LOST), nothing, nothing, np.full(gone.kind.shape, np.nan)
        )
        shown = concatenate([kept, gone])
    run = run_sessions(exact_learner(), shown.sessions(32), key=KEY)
    expected = fit_counts(CHAIN, jnp.asarray(visits), 0.0, RIDGE).weights
    np.testing.assert_allclose(run.state.weights, expected, rtol=1e-7)


@pytest.mark.parametrize("hidden", [False, True])
def test_what_is_kept_has_the_derivatives_of_the_exact_log_likelihood(hidden):
    sensor = flipped() * Visibility(np.array([1, 1, 0, 0, 1, 1])) if hidden else flipped()
    shown = demonstrated(sensor, 32)
    online = lme_i2rl(CHAIN, sensor, statistic="likelihood")
    state, info = online.update(online.init(KEY), shown)
    kept, at = state.statistic, state.weights
    assert len(kept.raw.kind) == 0  # expanded
    evidence = evidence_of(CHAIN, sensor, shown)

    def exact(weights):
        return jnp.sum(log_likelihoods(CHAIN, log_policy_of(CHAIN, weights, state.values), evidence))

    model = surrogate(CHAIN, kept._replace(raw=None), state.values)

    def kept_at(weights):
        return model_log_likelihood(CHAIN, model, weights, log_policy_of(CHAIN, weights, state.values))

    np.testing.assert_allclose(kept_at(at), exact(at), rtol=1e-10)
    np.testing.assert_allclose(info.log_likelihood * 32, exact(at), rtol=1e-9)
    np.testing.assert_allclose(jax.grad(kept_at)(at), jax.grad(exact)(at), atol=1e-8)
    np.testing.assert_allclose(kept.information, -jax.jacfwd(jax.grad(exact))(at), atol=1e-8)
    assert not np.asarray(exact_steps(CHAIN, evidence)).any()
    assert float(kept.completed.sum()) == pytest.approx(32 * STEPS)


def test_wrong_readings_cost_an_online_learner_no_more_than_batch():
    errors = {"likelihood": [], "seen": [], "batch": []}
    seen = lme_i2rl(CHAIN, flipped(), slack=0.0, ridge=RIDGE)
    batch = batch_lme(CHAIN, flipped(), slack=0.0, ridge=RIDGE, restarts=1)
    for seed in range(4):
        shown = demonstrated(flipped(), 192, seed)
        key = jax.random.key(seed)
        for name, online in (("likelihood", learner()), ("seen", seen)):
            run = run_sessions(online, shown.sessions(32), key=key)
            errors[name].append(policy_error(run.state.weights))
        errors["batch"].append(policy_error(batch.fit(key, shown).weights))
    mean = {name: np.mean(found) for name, found in errors.items()}
    assert mean["likelihood"] <= 1.1 * mean["batch"]
    assert mean["seen"] > 1.5 * mean["batch"]  # early guesses confirm themselves


def test_a_run_resumed_from_its_journal_equals_an_uninterrupted_one_to_the_bit(tmp_path):
    shown = demonstrated(flipped(), 96)
    whole_run = run_sessions(learner(), shown.sessions(16), key=KEY)
    parts = list(shown.sessions(16))
    for stop in (1, 3):  # while trajectories are raw, and after
        path = tmp_path / f"{stop}.db"
        with Journal.open(path, learner()) as journal:
            run_sessions(learner(), parts[:stop], key=KEY, journal=journal)
        with Journal.open(path, learner()) as journal:
            again = run_sessions(learner(), parts, journal=journal, whole=True)
        for ours, theirs in zip(
            jax.tree.leaves(again.state._replace(key=None)),
            jax.tree.leaves(whole_run.state._replace(key=None)),
            strict=True,
        ):
            np.testing.assert_array_equal(ours, theirs)


def test_an_impossible_observation_is_named_and_leaves_the_state_as_it_was():
    state, _ = exact_learner().update(exact_learner().init(KEY), demonstrated(whole(), 32))
    jump = Demonstration.from_pairs([[0, 5]], [[1, 1]])
    before = jax.tree.map(np.array, state._replace(key=None))
    with pytest.raises(DemonstrationError, match="trajectory 0, step 1"):
        exact_learner().update(state, jump)
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.array, state._replace(key=None)))


def test_units_of_features_do_not_matter():
    scale = np.array([1e4, 1e-4])
    other = replace(CHAIN, features=CHAIN.features * scale)
    shown = demonstrated(flipped(), 64)
    run = run_sessions(learner(), shown.sessions(32), key=KEY)
    scaled = lme_i2rl(other, flipped(), statistic="likelihood")
    theirs = run_sessions(scaled, shown.sessions(32), key=KEY)
    np.testing.assert_allclose(theirs.state.weights * scale, run.state.weights, rtol=1e-6)
    at = theirs.state.weights
    assert scaled.log_likelihood(theirs.state, at) == pytest.approx(
        learner().log_likelihood(run.state, at * scale), rel=1e-9
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"slack": 0.1}, "no slack"),
        ({"solver": "ipopt"}, "Newton steps"),
        ({"completion": "gibbs"}, "completes exactly"),
        ({"iterations": 0}, "at least one iteration"),
        ({"ridge": -1.0}, "must not be negative"),
    ],
)
def test_options_that_it_cannot_have_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        lme_i2rl(CHAIN, whole(), statistic="likelihood", **options)


def test_an_unknown_option_is_refused_and_a_fresh_start_has_no_kept_likelihood():
    with pytest.raises(TypeError, match="statistik"):
        lme_i2rl(CHAIN, whole(), statistic="likelihood", statistik="seen")
    with pytest.raises(ValueError, match="carried weights"):
        lme_i2rl_with_random_weights(CHAIN, whole(), statistic="likelihood")
