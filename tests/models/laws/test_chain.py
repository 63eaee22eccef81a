"""The forward and backward passes: identities, derivatives and numerical range."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.models import TabularMDP
from i2rl.models.laws.chain import condition, filter_forward, sample_backward, smooth, smooth_all

S, A, L = 4, 3, 5

forward = jax.jit(filter_forward)
both = jax.jit(smooth)
value_and_gradient = jax.jit(
    lambda mdp, factors, live: jax.value_and_grad(lambda f: filter_forward(mdp, f, live).log_likelihood)(
        factors
    )
)


def random_factors(seed, length=L):
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(length, S, A)) - 1
    factors[rng.random(factors.shape) < 0.2] = -np.inf
    return jnp.asarray(factors)


def log_space_likelihood(mdp, moves, factors):
    """Run the forward recursion in logarithms throughout, without normalisation."""
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
        np.testing.assert_allclose(np.exp(result.log_predicted[t]), predicted, atol=1e-12)
    np.testing.assert_allclose(np.exp(result.log_predicted[0]), mdp.initial)
    np.testing.assert_allclose(result.final.sum(), 1)


@pytest.mark.parametrize("seed", range(3))
def test_marginals_are_the_gradient_of_the_log_likelihood(seed, random_mdp):
    mdp = random_mdp(seed, n_successors=3).without_inflow()
    factors, live = random_factors(seed), jnp.arange(L) < 4
    _, gradient = value_and_gradient(mdp, factors, live)
    np.testing.assert_allclose(gradient, both(mdp, factors, live).pairs, atol=1e-12)


def test_the_log_likelihood_is_differentiable_in_transitions_and_start(random_mdp):
    mdp, live = random_mdp(1, n_successors=3), jnp.ones(L, bool)
    factors = jnp.where(jnp.isfinite(random_factors(1)), random_factors(1), -3.0)

    def likelihood(probabilities, initial):
        varied = mdp.with_probabilities(probabilities).with_initial(initial)
        return filter_forward(varied, factors, live).log_likelihood

    function = jax.jit(likelihood)
    gradients = jax.jit(jax.grad(likelihood, (0, 1)))(mdp.probabilities, mdp.initial)
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
    mdp = random_mdp(4, n_successors=3).without_inflow()
    factors = random_factors(4).at[2].set(-jnp.inf)
    live = jnp.ones(L, bool)
    value, gradient = value_and_gradient(mdp, factors, live)
    assert value == -np.inf
    assert np.isfinite(gradient).all()
    assert both(mdp, factors, live).pairs.sum() == 0


def test_nothing_beyond_the_end_matters(random_mdp):
    mdp, live = random_mdp(5, n_successors=3).without_inflow(), jnp.arange(L) < 3
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


# -- truths that are less likely than their alternatives by more than a double holds --------------------

N_PATHS = S * A


def every_path(mdp, moves, factors):
    """Paths ``[N, L]`` of pairs and their log-weights, by enumeration in logarithms."""
    with np.errstate(divide="ignore"):
        log_moves, log_start = np.log(moves).reshape(N_PATHS, S), np.log(np.asarray(mdp.initial))
    steps = np.asarray(factors).reshape(len(factors), N_PATHS)
    paths = np.arange(N_PATHS)[:, None]
    weights = np.repeat(log_start, A) + steps[0]
    for step in steps[1:]:
        onward = weights[:, None] + np.repeat(log_moves[paths[:, -1]], A, axis=1) + step
        prefix, pair = np.nonzero(onward > -np.inf)
        paths, weights = np.column_stack([paths[prefix], pair]), onward[prefix, pair]
    return paths, weights


def wide_factors(seed, moves):
    """Factors over 2,000 nats: the evidence turns to a state to which only very unlikely actions led."""
    rng = np.random.default_rng(seed)
    factors, state = np.array(random_factors(seed, 4)), rng.integers(S)
    factors[0] -= 300 * rng.integers(0, 3, (S, A))
    factors[2] -= np.where(moves[:, :, state] > 0, rng.uniform(700, 2000, (S, A)), 0)
    factors[3, np.arange(S) != state] -= 2000 if seed % 2 else np.inf
    return jnp.asarray(factors)


WIDE = range(20)


@pytest.fixture(scope="module")
def wide_problems(random_mdp, dense_transitions):
    problems = []
    for seed in WIDE:
        mdp = random_mdp(seed, starts=2).without_inflow()
        moves = dense_transitions(mdp)
        factors = wide_factors(seed, moves)
        problems.append((mdp, factors, every_path(mdp, moves, factors)))
    return problems


def test_likelihood_and_posterior_are_exact_over_two_thousand_nats(wide_problems):
    live, beyond_doubles = jnp.ones(4, bool), 0
    for mdp, factors, (paths, weights) in wide_problems:
        result = both(mdp, factors, live)
        total = np.logaddexp.reduce(weights)
        np.testing.assert_allclose(result.log_likelihood, total, rtol=1e-12)
        posterior = np.exp(weights - total)
        for t in range(4):
            expected = np.bincount(paths[:, t], posterior, N_PATHS).reshape(S, A)
            np.testing.assert_allclose(result.pairs[t], expected, atol=1e-10)
        predicted = forward(mdp, factors, live).log_predicted
        likeliest = np.asarray(predicted)[3, paths[posterior.argmax(), 3] // A]
        beyond_doubles += likeliest < -745
    assert beyond_doubles >= 10


def test_gradients_are_exact_over_two_thousand_nats(wide_problems):
    live = jnp.ones(4, bool)

    @jax.jit
    def gradients(mdp, factors):
        def likelihood(factors, probabilities, initial):
            varied = mdp.with_probabilities(probabilities).with_initial(initial)
            return filter_forward(varied, factors, live).log_likelihood

        return jax.grad(likelihood, (0, 1, 2))(factors, mdp.probabilities, mdp.initial)

    for mdp, factors, (paths, weights) in wide_problems[::3]:
        by_factor, by_move, by_start = map(np.asarray, gradients(mdp, factors))
        posterior = np.exp(weights - np.logaddexp.reduce(weights))
        np.testing.assert_allclose(by_factor, both(mdp, factors, live).pairs, atol=1e-10)
        first = np.bincount(paths[:, 0] // A, posterior, S)
        np.testing.assert_allclose(by_start * np.asarray(mdp.initial), first, atol=1e-10)
        moved = np.zeros((N_PATHS, S))
        for t in range(3):
            np.add.at(moved, (paths[:, t], paths[:, t + 1] // A), posterior)
        expected = np.take_along_axis(moved.reshape(S, A, S), np.asarray(mdp.successors), 2)
        # Two slots of a pair never lead to one state here.
        np.testing.assert_allclose(by_move * np.asarray(mdp.probabilities), expected, atol=1e-10)


def test_completions_are_drawn_from_the_posterior_over_two_thousand_nats(wide_problems):
    live, draws = jnp.ones(4, bool), 500

    @jax.jit
    def draw(mdp, factors, key):
        filtered = filter_forward(mdp, factors, live)
        keys = jax.random.split(key, draws)
        return jax.vmap(lambda k: sample_backward(k, mdp, factors, filtered, live))(keys)

    for i, (mdp, factors, (paths, weights)) in enumerate(wide_problems[:6]):
        states, actions = map(np.asarray, draw(mdp, factors, jax.random.key(i)))
        posterior = np.exp(weights - np.logaddexp.reduce(weights))
        for t in range(4):
            expected = np.bincount(paths[:, t], posterior, N_PATHS)
            found = np.bincount(states[:, t] * A + actions[:, t], minlength=N_PATHS) / draws
            error = 5 * np.sqrt(np.clip(expected * (1 - expected), 0, 1) / draws)
            assert (np.abs(found - expected) <= error + 1e-9).all()


def test_the_truth_behind_a_detour_of_741_nats_is_found():
    # Both starts are hidden; the one that is 320 e-fold less likely, twice, is the only one that leads on.
    moves = np.zeros((3, 1, 3))
    moves[0, 0] = [1, 0, 0]
    moves[1, 0] = moves[2, 0] = [0, 0, 1]
    tiny = np.exp(-370.35)
    mdp = TabularMDP.from_dense(moves, np.zeros((3, 1, 1)), initial=np.array([1 - tiny, tiny, 0]))
    factors = jnp.asarray(np.array([[[0], [-370.35], [0]], [[-np.inf], [-np.inf], [0]]]))
    for steps in (mdp, mdp.without_inflow()):
        result = both(steps, factors, jnp.ones(2, bool))
        np.testing.assert_allclose(result.log_likelihood, -740.7, rtol=1e-12)
        np.testing.assert_allclose(result.pairs[0].ravel(), [0, 1, 0], atol=1e-12)


def test_a_trajectory_does_not_depend_on_the_ones_beside_it(wide_problems):
    (mdp, wide, _), live = wide_problems[1], jnp.ones((2, 4), bool)
    factors = jnp.stack([random_factors(0, 4), wide])
    together = jax.jit(smooth_all)(mdp, factors, live)
    for i in range(2):
        alone = both(mdp, factors[i], live[i])
        np.testing.assert_allclose(together.log_likelihood[i], alone.log_likelihood, rtol=1e-14)
        np.testing.assert_allclose(together.pairs[i], alone.pairs, atol=1e-14)
    mapped = jax.jit(jax.vmap(filter_forward, (None, 0, 0)))(mdp, factors, live)
    np.testing.assert_allclose(mapped.log_likelihood, together.log_likelihood, rtol=1e-14)


def test_a_path_of_several_rare_steps_is_not_lost():
    # Policy e^-318, transition e^-318, then e^-210 of the state that is certain by now.
    first, second = np.exp(-318.0), np.exp(-210.0)
    moves = np.zeros((5, 2, 5))
    moves[0, 0, 1], moves[0, 1, 1], moves[0, 1, 2] = 1, 1 - first, first
    moves[1, :, 3] = moves[3, :, 3] = moves[4, :, 4] = 1
    moves[2, :, 4], moves[2, :, 3] = second, 1 - second
    mdp = TabularMDP.from_dense(moves, np.zeros((5, 2, 1)), initial=np.eye(5)[0])
    factors = np.zeros((3, 5, 2))
    factors[0, 0, 1], factors[1, 1], factors[2, 3] = -318, -np.inf, -240
    for process in (mdp, mdp.without_inflow()):
        result = smooth(process, jnp.asarray(factors), jnp.ones(3, bool))
        assert float(result.log_likelihood) == pytest.approx(-318 - 318 - 210 + 2 * np.log(2), abs=1e-9)
        assert float(result.final[4]) == pytest.approx(1, abs=1e-12)


def test_the_next_state_after_a_certain_but_unlikely_one_is_not_lost():
    moves = np.zeros((3, 1, 3))
    moves[0, 0, 0] = moves[2, 0, 2] = 1
    moves[1, 0, 0], moves[1, 0, 1] = np.exp(-210.0), 1 - np.exp(-210.0)
    mdp = TabularMDP.from_dense(moves, np.zeros((3, 1, 1)))
    following = condition(mdp, jnp.array([0, np.exp(-600.0), 1.0]), jnp.array([[0.0], [0.0], [-jnp.inf]]))
    assert float(following[0]) == pytest.approx(np.exp(-210.0), rel=1e-9)
