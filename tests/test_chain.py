"""The forward and backward passes: identities, derivatives and numerical range."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.models import TabularMDP
from i2rl.models.chain import filter_forward, sample_backward, smooth

S, A, L = 4, 3, 5

forward = jax.jit(filter_forward)
both = jax.jit(smooth)


def random_factors(seed, length=L):
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(length, S, A)) - 1
    factors[rng.random(factors.shape) < 0.2] = -np.inf
    return jnp.asarray(factors)


def log_space_likelihood(mdp, moves, factors):
    """The forward recursion with logarithms throughout and nothing normalised."""
    with np.errstate(divide="ignore"):
        log_moves, alpha = np.log(moves), np.log(np.asarray(mdp.initial))
    for factor in np.asarray(factors):
        joint = alpha[:, None] + factor
        alpha = np.logaddexp.reduce((joint[..., None] + log_moves).reshape(-1, S), axis=0)
    return np.logaddexp.reduce(alpha)


@pytest.mark.parametrize("seed", range(3))
def test_filtering_predicts_each_state_from_the_evidence_before_it(seed, random_mdp, enumerate_completions):
    mdp, factors = random_mdp(seed, n_successors=3), random_factors(seed)
    result = forward(mdp, factors, jnp.ones(L, bool))
    for t in range(1, L):
        # With no evidence at t itself, the posterior of the state there is its prediction.
        silent = jnp.concatenate([factors[:t], jnp.zeros((1, S, A))])
        every = enumerate_completions(mdp, np.zeros((S, A)), silent)
        predicted = np.bincount(every.states[:, t], every.posterior, S)
        np.testing.assert_allclose(result.predicted[t], predicted, atol=1e-12)
    np.testing.assert_allclose(result.predicted[0], mdp.initial)
    np.testing.assert_allclose(result.final.sum(), 1)


@pytest.mark.parametrize("seed", range(3))
def test_marginals_are_the_gradient_of_the_log_likelihood(seed, random_mdp):
    mdp, factors, live = random_mdp(seed, n_successors=3), random_factors(seed), jnp.arange(L) < 4
    gradient = jax.grad(lambda f: filter_forward(mdp, f, live).log_likelihood)(factors)
    np.testing.assert_allclose(gradient, both(mdp, factors, live).pairs, atol=1e-12)


def test_the_log_likelihood_is_differentiable_in_transitions_and_start(random_mdp):
    mdp, live = random_mdp(1, n_successors=3), jnp.ones(L, bool)
    factors = jnp.where(jnp.isfinite(random_factors(1)), random_factors(1), -3.0)

    def likelihood(probabilities, initial):
        varied = mdp.with_probabilities(probabilities).with_initial(initial)
        return filter_forward(varied, factors, live).log_likelihood

    function = jax.jit(likelihood)
    gradients = jax.grad(likelihood, (0, 1))(mdp.probabilities, mdp.initial)
    rng, step = np.random.default_rng(0), 1e-6
    for which, gradient in enumerate(gradients):
        point = [mdp.probabilities, mdp.initial]
        direction = jnp.asarray(rng.normal(size=gradient.shape)) * 0.1
        ahead, behind = list(point), list(point)
        ahead[which], behind[which] = point[which] + step * direction, point[which] - step * direction
        difference = (function(*ahead) - function(*behind)) / (2 * step)
        np.testing.assert_allclose(jnp.vdot(gradient, direction), difference, rtol=1e-6)


def test_a_long_trajectory_neither_underflows_nor_loses_digits(random_mdp, dense_transitions):
    mdp, length = random_mdp(2), 4000
    factors = jnp.asarray(np.random.default_rng(2).normal(size=(length, S, A)) - 20)
    result = both(mdp, factors, jnp.ones(length, bool))
    truth = log_space_likelihood(mdp, dense_transitions(mdp), factors)
    assert truth < -50_000
    np.testing.assert_allclose(result.log_likelihood, truth, rtol=1e-12)
    np.testing.assert_allclose(result.pairs.sum((1, 2)), 1, atol=1e-9)


def test_very_unlikely_actions_keep_their_likelihood(random_mdp, dense_transitions):
    mdp = random_mdp(3)
    factors = jnp.full((L, S, A), -1000.0).at[:, :, 0].set(-1200.0)
    result = both(mdp, factors, jnp.ones(L, bool))
    truth = log_space_likelihood(mdp, dense_transitions(mdp), factors)
    np.testing.assert_allclose(result.log_likelihood, truth, rtol=1e-12)


def test_states_that_cannot_occur_do_not_overflow_the_backward_pass():
    # From "here" three actions stay, fall into a trap that evidence later rules out, or (ruled out at
    # once) leave for "elsewhere", which would explain everything to come ever so much better.
    here, trap, elsewhere = range(3)
    moves = np.zeros((3, 3, 3))
    moves[here, np.arange(3), [here, trap, elsewhere]] = 1
    moves[trap, :, trap] = moves[elsewhere, :, elsewhere] = 1
    mdp = TabularMDP.from_dense(moves, np.zeros((3, 3, 1)), initial=np.array([1.0, 0, 0]))
    length = 60
    factors = np.full((length, 3, 3), -np.inf)
    factors[:, here] = [-50, 0, -np.inf]
    factors[:, elsewhere] = 0
    result = both(mdp, jnp.asarray(factors), jnp.ones(length, bool))
    # The last step may fall into the trap: nothing comes after it.
    np.testing.assert_allclose(result.log_likelihood, np.logaddexp(-50.0 * length, -50.0 * (length - 1)))
    np.testing.assert_allclose(result.pairs[:-1, here, 0], 1)
    np.testing.assert_allclose(result.pairs[-1, here, 1], 1)
    assert not np.isnan(result.pairs).any()


def test_impossible_evidence_is_minus_infinity_with_finite_gradients(random_mdp):
    mdp = random_mdp(4)
    factors = random_factors(4).at[2].set(-jnp.inf)
    live = jnp.ones(L, bool)
    value, gradient = jax.value_and_grad(lambda f: filter_forward(mdp, f, live).log_likelihood)(factors)
    assert value == -np.inf
    assert np.isfinite(gradient).all()
    assert both(mdp, factors, live).pairs.sum() == 0


def test_nothing_beyond_the_end_matters(random_mdp):
    mdp, live = random_mdp(5, n_successors=3), jnp.arange(L) < 3
    factors = random_factors(5)
    one = both(mdp, factors, live)
    two = both(mdp, factors.at[3:].set(-jnp.inf), live)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.pairs[3:], 0)


def test_sampled_completions_are_possible(random_mdp, dense_transitions):
    mdp, factors, live = random_mdp(6, starts=2), random_factors(6), jnp.arange(L) < 4
    filtered = forward(mdp, factors, live)
    assert np.isfinite(filtered.log_likelihood)
    draw = jax.jit(jax.vmap(lambda key: sample_backward(key, mdp, factors, filtered, live)))
    states, actions = map(np.asarray, draw(jax.random.split(jax.random.key(0), 200)))
    moves = dense_transitions(mdp)
    assert (np.asarray(mdp.initial)[states[:, 0]] > 0).all()
    assert (moves[states[:, :3], actions[:, :3], states[:, 1:4]] > 0).all()
    assert np.isfinite(np.asarray(factors)[np.arange(4), states[:, :4], actions[:, :4]]).all()
    assert (states[:, 4] == -1).all()
    assert (actions[:, 4] == -1).all()
