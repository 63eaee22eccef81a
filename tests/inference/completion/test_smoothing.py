"""Completion against enumeration of every completion."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.diagnostics
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.inference.completion import smoothing
from i2rl.inference.completion.smoothing import (
    Evidence,
    blocked_posterior,
    collect,
    expectations,
    gibbs_completions,
    gibbs_posterior,
    log_likelihoods,
    sample_completions,
    settled_completions,
    smooth_all,
)
from i2rl.models import Demonstration, ObservationModel, Sensor, Visibility
from i2rl.models.observation.demonstration import HIDDEN, PAD, SEEN, UNKNOWN

N, LENGTH, S, A = 6, 5, 4, 3

evidence_of = jax.jit(smoothing.evidence_of)
exact = jax.jit(expectations)
marginals = jax.jit(smooth_all)
gibbs = jax.jit(gibbs_completions, static_argnums=(4, 5))


def confusion(seed: int) -> ObservationModel:
    rng = np.random.default_rng(seed)
    return ObservationModel.from_probabilities(rng.dirichlet(np.ones(S * A), (S, A)).reshape(S, A, S, A))


def view(seed: int) -> Visibility:
    return Visibility(np.random.default_rng(seed).permutation([True, True, False, False]))


SENSORS = {
    "everything seen": lambda seed: Sensor(),
    "a mask of the view": view,
    "a view that may fail": lambda seed: Visibility(np.random.default_rng(seed).random(S)),
    "noise": confusion,
    "independent noise": lambda seed: ObservationModel.from_factors(
        0.7 * np.eye(S) + 0.3 / S, 0.8 * np.eye(A) + 0.2 / A
    ),
    "hidden and noisy": lambda seed: view(seed) * confusion(seed),
}


def random_log_policy(seed, mdp):
    logits = np.where(mdp.available, np.random.default_rng(seed).normal(size=(S, A)), -np.inf)
    return jnp.asarray(logits - np.log(np.exp(logits).sum(1, keepdims=True)))


@pytest.mark.parametrize("masked", [False, True], ids=["all actions", "action mask"])
@pytest.mark.parametrize("sensor_name", SENSORS)
def test_hidden_steps_are_summed_out_exactly(
    sensor_name, masked, random_mdp, dense_transitions, enumerate_completions, imperfect_demonstration
):
    mdp = random_mdp(3, masked=masked, starts=3)
    sensor, log_policy = SENSORS[sensor_name](5), random_log_policy(7, mdp)
    demonstration = imperfect_demonstration(11, mdp, log_policy, sensor, N, LENGTH)
    evidence = evidence_of(mdp, sensor, demonstration)
    posterior = marginals(mdp, log_policy, evidence)
    result = exact(mdp, log_policy, evidence)

    moves, features, gamma = dense_transitions(mdp), np.asarray(mdp.features), float(mdp.discount)
    counts, start, tail, discounted = np.zeros((S, A)), np.zeros(S), np.zeros(S), np.zeros(2)
    for i, length in enumerate(demonstration.lengths):
        truth = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence[i, :length]))
        expected = np.zeros((LENGTH, S, A))
        for t in range(length):
            np.add.at(expected[t], (truth.states[:, t], truth.actions[:, t]), truth.posterior)
        final = np.einsum("sa,sat->t", expected[length - 1], moves)
        np.testing.assert_allclose(posterior.log_likelihood[i], truth.log_likelihood, atol=1e-10)
        np.testing.assert_allclose(posterior.pairs[i], expected, atol=1e-10)
        np.testing.assert_allclose(posterior.final[i], final, atol=1e-10)
        counts += expected.sum(0)
        discounted += np.einsum("l,lsa,sak->k", gamma ** np.arange(LENGTH), expected, features)
        start += expected[0].sum(1)
        tail += gamma**length * final
    np.testing.assert_allclose(result.log_likelihood, posterior.log_likelihood, atol=1e-12)
    np.testing.assert_allclose(log_likelihoods(mdp, log_policy, evidence), result.log_likelihood, atol=1e-12)
    np.testing.assert_allclose(result.counts, counts, atol=1e-10)
    np.testing.assert_allclose(result.features, discounted, atol=1e-10)
    np.testing.assert_allclose(result.start, start, atol=1e-10)
    np.testing.assert_allclose(result.tail, tail, atol=1e-10)
    assert result.size == N


def test_fully_seen_trajectories_need_no_completion(random_mdp):
    mdp = random_mdp(0, n_successors=S)
    states, actions = np.array([[0, 1, 3, 2, 1]]), np.array([[2, 0, 0, 1, 1]])
    evidence = evidence_of(mdp, Sensor(), Demonstration.from_pairs(states, actions))
    result = exact(mdp, random_log_policy(0, mdp), evidence)
    powers = float(mdp.discount) ** np.arange(LENGTH)
    np.testing.assert_allclose(result.features, powers @ np.asarray(mdp.features)[states[0], actions[0]])
    counts = np.zeros((S, A))
    np.add.at(counts, (states[0], actions[0]), 1)
    np.testing.assert_allclose(result.counts, counts, atol=1e-15)


def test_a_trajectory_all_hidden_is_evidence_for_where_it_was(random_mdp, enumerate_completions):
    mdp = random_mdp(1, n_successors=S)
    sensor, log_policy = Visibility(np.array([True, True, False, False])), random_log_policy(1, mdp)
    evidence = evidence_of(mdp, sensor, Demonstration.from_steps([["hidden"] * LENGTH], mdp))
    result = exact(mdp, log_policy, evidence)
    truth = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence[0]))
    assert np.isfinite(result.log_likelihood[0])
    np.testing.assert_allclose(result.log_likelihood[0], truth.log_likelihood, atol=1e-12)
    np.testing.assert_allclose(np.asarray(result.counts)[:2], 0)
    np.testing.assert_allclose(result.counts.sum(), LENGTH)


def test_impossible_evidence_has_no_likelihood_and_no_nan(random_mdp):
    mdp = random_mdp(2)
    hidden = Demonstration.from_steps([["hidden"] * 3], mdp)
    result = exact(mdp, random_log_policy(2, mdp), evidence_of(mdp, Visibility(np.ones(S)), hidden))
    assert result.log_likelihood[0] == -np.inf
    assert all(not np.isnan(field).any() for field in result)
    assert result.counts.sum() == 0


def test_the_backward_sampler_draws_completions_with_their_posterior_frequency(
    random_mdp, enumerate_completions
):
    mdp = random_mdp(4, n_successors=3)
    log_policy, sensor, draws = random_log_policy(4, mdp), view(4), 20_000
    hidden = Demonstration.from_steps([[(None, 1), "hidden", "hidden", None]], mdp).padded(1, LENGTH)
    evidence = evidence_of(mdp, sensor, hidden)
    states, actions = jax.jit(sample_completions, static_argnums=4)(
        jax.random.key(0), mdp, log_policy, evidence, draws
    )
    assert (np.asarray(states)[:, 0, 4] == UNKNOWN).all()
    assert (np.asarray(actions)[:, 0, 4] == UNKNOWN).all()
    truth = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence[0, :4]))
    pairs = (S * A) ** np.arange(4)
    truth_code = (truth.states * A + truth.actions) @ pairs
    drawn = np.bincount((np.asarray(states * A + actions)[:, 0, :4]) @ pairs, minlength=(S * A) ** 4)
    posterior = np.zeros((S * A) ** 4)
    posterior[truth_code] = truth.posterior
    assert drawn[posterior == 0].sum() == 0
    # Completions rarer than the rest are pooled, so that counts are near enough to normal.
    common = posterior * draws >= 25
    expected = np.append(posterior[common], posterior[~common].sum())
    observed = np.append(drawn[common], drawn[~common].sum()) / draws
    error = np.sqrt(expected * (1 - expected) / draws)
    assert common.sum() > 50
    assert (np.abs(observed - expected) <= 4 * error).all()


def test_blocked_estimates_lie_within_four_standard_errors(
    random_mdp, enumerate_completions, imperfect_demonstration
):
    mdp = random_mdp(5, n_successors=3)
    log_policy, sensor, draws = random_log_policy(5, mdp), SENSORS["hidden and noisy"](5), 4000
    demonstration = imperfect_demonstration(6, mdp, log_policy, sensor, N, LENGTH)
    evidence = evidence_of(mdp, sensor, demonstration)
    truth = exact(mdp, log_policy, evidence)
    drawn = jax.jit(blocked_posterior, static_argnums=4)(jax.random.key(1), mdp, log_policy, evidence, draws)
    estimate = collect(mdp, drawn, evidence.live)
    features, powers = np.asarray(mdp.features), float(mdp.discount) ** np.arange(LENGTH)
    variance = np.zeros(2)
    count_variance = np.zeros((S, A))
    for i, length in enumerate(demonstration.lengths):
        every = enumerate_completions(mdp, log_policy, np.asarray(evidence.log_evidence[i, :length]))
        collected = np.einsum("l,nlk->nk", powers[:length], features[every.states, every.actions])
        variance += every.posterior @ collected**2 - (every.posterior @ collected) ** 2
        for s, a in np.ndindex(S, A):
            visits = ((every.states == s) & (every.actions == a)).sum(1)
            count_variance[s, a] += every.posterior @ visits**2 - (every.posterior @ visits) ** 2
    np.testing.assert_array_equal(estimate.log_likelihood, truth.log_likelihood)
    error = np.abs(np.asarray(estimate.features - truth.features))
    assert (error <= 4 * np.sqrt(variance / draws)).all()
    count_error = np.abs(np.asarray(estimate.counts - truth.counts))
    assert (count_error <= 4 * np.sqrt(count_variance / draws) + 1e-9).all()
    # At most one visit to a state at the start or at the end of each of N trajectories.
    assert (np.abs(np.asarray(estimate.start - truth.start)) <= 4 * np.sqrt(N / 4 / draws)).all()
    assert (np.abs(np.asarray(estimate.tail - truth.tail)) <= 4 * np.sqrt(N / 4 / draws)).all()
    assert estimate.size == truth.size


def test_gibbs_estimates_lie_within_four_standard_errors_where_every_move_is_possible(
    random_mdp, imperfect_demonstration
):
    mdp = random_mdp(6, n_successors=S)
    log_policy, sensor, draws = random_log_policy(6, mdp), SENSORS["hidden and noisy"](6), 6000
    demonstration = imperfect_demonstration(7, mdp, log_policy, sensor, N, LENGTH)
    evidence = evidence_of(mdp, sensor, demonstration)
    truth = exact(mdp, log_policy, evidence)
    key = jax.random.key(2)
    drawn = jax.jit(gibbs_posterior, static_argnums=(4, 5))(key, mdp, log_policy, evidence, draws, 200)
    estimate = collect(mdp, drawn, evidence.live)
    states, actions = gibbs(key, mdp, log_policy, evidence, draws, 200)
    live = np.asarray(evidence.live)
    assert (np.asarray(states)[:, ~live] == UNKNOWN).all()
    collected = np.einsum(
        "nl,l,dnlk->dk",
        live,
        float(mdp.discount) ** np.arange(LENGTH),
        np.asarray(mdp.features)[np.asarray(states), np.asarray(actions)],
    )
    np.testing.assert_allclose(collected.mean(0), estimate.features, rtol=1e-9)
    visits = np.stack(
        [((states == s) & (actions == a) & live).sum((1, 2)) for s, a in np.ndindex(S, A)], axis=1
    )
    for series, true_mean in (
        (collected, np.asarray(truth.features)),
        (visits, np.asarray(truth.counts).reshape(-1)),
    ):
        effective = numpyro.diagnostics.effective_sample_size(series[None].astype(float))
        error = series.std(0) / np.sqrt(effective)
        assert (effective > 200).all()
        assert (np.abs(series.mean(0) - true_mean) <= 4 * error).all()
    np.testing.assert_allclose(estimate.counts.reshape(-1), visits.mean(0), atol=1e-9)


@pytest.mark.parametrize("change", [0.0, 0.03])
def test_sweeps_end_once_the_average_of_a_score_settles(random_mdp, change):
    mdp, draws, burn_in = random_mdp(6, n_successors=3), 200, 5
    log_policy = jnp.full(mdp.available.shape, -np.log(mdp.n_actions))
    rng = np.random.default_rng(0)
    evidence = Evidence(
        jnp.asarray(rng.normal(size=(3, 7, mdp.n_states, mdp.n_actions))),
        jnp.arange(7) < jnp.array([7, 4, 6])[:, None],
    )
    table = jnp.asarray(rng.normal(size=mdp.available.shape))
    key = jax.random.key(4)
    states, actions = gibbs(key, mdp, log_policy, evidence, draws, burn_in)
    settled = jax.jit(
        lambda key: settled_completions(
            key, mdp, log_policy, evidence, draws, burn_in, lambda s, a: table[s, a], change
        )
    )(key)
    count = int(settled.drawn)
    # What is drawn is drawn as without a threshold.
    np.testing.assert_array_equal(settled.states[:count], states[:count])
    np.testing.assert_array_equal(settled.actions[:count], actions[:count])
    scores = np.asarray(table)[states, actions]
    averages = np.cumsum(scores, 0) / np.arange(1, draws + 1)[:, None, None]
    moves = np.abs(np.diff(averages, axis=0))[:, np.asarray(evidence.live)].mean(1)
    expected = next((i + 2 for i, move in enumerate(moves) if move <= change), draws)
    assert count == expected
    assert (count == draws) == (change == 0)


def test_gibbs_never_leaves_what_the_policy_may_do(random_mdp):
    mdp = random_mdp(8, n_successors=S)
    log_policy = jnp.log(jax.nn.one_hot(jnp.array([0, 2, 1, 0]), A))
    evidence = evidence_of(mdp, Sensor(), Demonstration.from_steps([[None] * LENGTH] * 3, mdp))
    states, actions = gibbs(jax.random.key(0), mdp, log_policy, evidence, 50, 0)
    assert (np.asarray(log_policy)[np.asarray(states), np.asarray(actions)] == 0).all()
    np.testing.assert_allclose(exact(mdp, log_policy, evidence).log_likelihood, 0, atol=1e-12)


def test_the_same_key_gives_the_same_completions(random_mdp):
    mdp = random_mdp(9)
    log_policy = random_log_policy(9, mdp)
    evidence = evidence_of(mdp, Sensor(), Demonstration.from_steps([[None] * LENGTH], mdp))
    draw = partial(sample_completions, mdp=mdp, log_policy=log_policy, evidence=evidence, draws=5)
    for one, two in zip(draw(jax.random.key(3)), draw(jax.random.key(3)), strict=True):
        np.testing.assert_array_equal(one, two)


steps = st.one_of(
    st.just((HIDDEN, UNKNOWN, UNKNOWN)),
    st.tuples(st.just(SEEN), st.integers(0, S - 1), st.integers(-1, A - 1)),
)


@given(
    rows=st.lists(st.lists(steps, min_size=1, max_size=LENGTH), min_size=N, max_size=N),
    weights=st.lists(st.floats(-5, 5), min_size=S * A, max_size=S * A),
)
def test_marginals_sum_to_one_on_live_steps_and_padding_changes_nothing(rows, weights, random_mdp):
    mdp = random_mdp(10, n_successors=S)
    log_policy = jax.nn.log_softmax(jnp.asarray(weights).reshape(S, A), axis=1)
    sensor = Visibility(np.full(S, 0.6))
    codes = np.full((N, LENGTH, 3), (PAD, UNKNOWN, UNKNOWN))
    for i, row in enumerate(rows):
        codes[i, : len(row)] = row
    demonstration = Demonstration.from_codes(codes)
    evidence = evidence_of(mdp, sensor, demonstration)
    posterior = marginals(mdp, log_policy, evidence)
    np.testing.assert_allclose(posterior.pairs.sum((2, 3)), np.asarray(evidence.live), atol=1e-12)
    result = exact(mdp, log_policy, evidence)
    grown = exact(mdp, log_policy, evidence_of(mdp, sensor, demonstration.padded(N + 2, LENGTH + 3)))
    np.testing.assert_allclose(grown.log_likelihood[:N], result.log_likelihood, rtol=1e-12)
    np.testing.assert_array_equal(grown.log_likelihood[N:], 0)
    for one, two in zip(result[1:], grown[1:], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-12)


@given(order=st.permutations(range(S)), seed=st.integers(0, 5))
def test_relabelling_states_relabels_the_posterior(
    order, seed, random_mdp, dense_transitions, imperfect_demonstration
):
    mdp = random_mdp(seed, n_successors=S)
    order = np.array(order)
    place = np.argsort(order)
    moved = type(mdp).from_dense(
        dense_transitions(mdp)[order][:, :, order],
        np.asarray(mdp.features)[order],
        initial=np.asarray(mdp.initial)[order],
        discount=0.9,
    )
    log_policy, visibility = random_log_policy(seed, mdp), np.random.default_rng(seed).random(S)
    demonstration = imperfect_demonstration(seed, mdp, log_policy, Visibility(visibility), 2, LENGTH)
    state = np.where(demonstration.state == UNKNOWN, UNKNOWN, place[demonstration.state])
    here = exact(mdp, log_policy, evidence_of(mdp, Visibility(visibility), demonstration))
    there = exact(
        moved,
        log_policy[order],
        evidence_of(moved, Visibility(visibility[order]), replace(demonstration, state=state)),
    )
    np.testing.assert_allclose(there.log_likelihood, here.log_likelihood, atol=1e-10)
    np.testing.assert_allclose(there.counts, np.asarray(here.counts)[order], atol=1e-10)
    np.testing.assert_allclose(there.features, here.features, atol=1e-10)
    np.testing.assert_allclose(there.tail, np.asarray(here.tail)[order], atol=1e-10)
