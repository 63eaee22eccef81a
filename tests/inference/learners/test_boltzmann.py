import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.learners.boltzmann import (
    boltzmann_log_likelihoods,
    boltzmann_log_policy,
    optimal_action_values,
    visit_counts,
)
from i2rl.models import Demonstration, DemonstrationError, TabularMDP

log_policy_of = jax.jit(boltzmann_log_policy)


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(3, n_states=7, n_actions=3, n_features=3, masked=True)


def iterated_action_values(mdp, dense, weights):
    """``Q*`` by successive approximation on the dense table."""
    reward = np.asarray(mdp.features) @ weights
    q = np.zeros(reward.shape)
    for _ in range(600):
        best = np.where(np.asarray(mdp.available), q, -np.inf).max(1)
        q = reward + float(mdp.discount) * dense @ best
    return np.where(np.asarray(mdp.available), q, -np.inf)


def test_policy_is_the_softmax_of_the_optimal_values(mdp, dense_transitions):
    weights = np.array([0.7, -0.4, 0.2])
    q = iterated_action_values(mdp, dense_transitions(mdp), weights)
    np.testing.assert_allclose(jax.jit(optimal_action_values)(mdp, jnp.asarray(weights)), q, atol=1e-10)
    odds = np.exp(3.0 * (q - q.max(1, keepdims=True)))
    policy = np.exp(log_policy_of(mdp, jnp.asarray(weights), 3.0))
    np.testing.assert_allclose(policy, odds / odds.sum(1, keepdims=True), atol=1e-10)
    assert (policy[~np.asarray(mdp.available)] == 0).all()


def test_likelihood_sums_the_visited_pairs(mdp):
    weights = jnp.array([0.7, -0.4, 0.2])
    log_policy = np.asarray(log_policy_of(mdp, weights, 10.0))
    pairs = np.argwhere(np.asarray(mdp.available))[[0, 3, 3, 5, 1]]
    demonstration = Demonstration.from_pairs(pairs[:, 0], pairs[:, 1]).padded(2, 8)
    counts = visit_counts(mdp, demonstration)
    assert counts.sum() == 5
    assert counts[0, pairs[1, 0], pairs[1, 1]] == 2
    expected = [sum(log_policy[s, a] for s, a in pairs), 0.0]
    np.testing.assert_allclose(boltzmann_log_likelihoods(mdp, weights, counts), expected, rtol=1e-12)


def test_gradient_against_finite_differences(mdp):
    rng = np.random.default_rng(0)
    counts = jnp.asarray(rng.poisson(2.0, (2, 7, 3)) * np.asarray(mdp.available), float)

    @jax.jit
    @jax.value_and_grad
    def total(weights, rationality):
        return jnp.sum(boltzmann_log_likelihoods(mdp, weights, counts, rationality) * jnp.array([1.0, 2.5]))

    for weights in rng.uniform(-1, 1, (5, 3)):
        for rationality in (0.5, 10.0):
            steps = 1e-6 * np.eye(3)
            numeric = [
                (total(weights + h, rationality)[0] - total(weights - h, rationality)[0]) / 2e-6
                for h in steps
            ]
            np.testing.assert_allclose(total(weights, rationality)[1], numeric, rtol=1e-5, atol=1e-5)


def test_gradient_is_finite_where_an_action_is_the_only_one(random_mdp):
    mdp = random_mdp(5, masked=True, n_states=12, n_actions=2)
    assert (np.asarray(mdp.available).sum(1) == 1).any()
    counts = np.asarray(mdp.available, float)[None]
    gradient = jax.jit(jax.grad(lambda w: boltzmann_log_likelihoods(mdp, w, counts)[0]))
    assert np.isfinite(gradient(jnp.array([0.3, 0.4]))).all()


def test_a_visit_to_an_unavailable_action_is_named(mdp):
    s, a = np.argwhere(~np.asarray(mdp.available))[0]
    counts = np.zeros((3, 7, 3))
    counts[2, s, a] = 1
    with pytest.raises(DemonstrationError, match=rf"trajectory 2 visits state {s}, action {a}"):
        boltzmann_log_likelihoods(mdp, jnp.zeros(3), counts)
    traced = jax.jit(lambda c: boltzmann_log_likelihoods(mdp, jnp.zeros(3), c))(counts)
    np.testing.assert_array_equal(traced, [0, 0, -np.inf])
    good = np.argwhere(np.asarray(mdp.available))[0]
    taken = Demonstration.from_pairs([[good[0], s]], [[good[1], a]])
    with pytest.raises(
        DemonstrationError, match=rf"trajectory 0, step 1: state {s}, action {a} is not avail"
    ):
        visit_counts(mdp, taken)


def test_names_are_used_in_errors():
    mdp = TabularMDP.from_successors(
        np.zeros((1, 2, 1), int),
        np.ones((1, 2, 1)),
        np.ones((1, 2, 1)),
        available=np.array([[True, False]]),
        states=["home"],
        actions=["stay", "leave"],
    )
    with pytest.raises(DemonstrationError, match=r"'home' \(0\), action 'leave' \(1\)"):
        visit_counts(mdp, Demonstration.from_pairs([[0]], [[1]]))


@pytest.mark.parametrize(
    ("step", "why"),
    [("hidden", "is hidden"), (None, "is a lost frame"), ({"s": 0}, "was seen only in part")],
)
def test_every_step_must_be_seen(random_mdp, step, why):
    mdp = random_mdp(0)
    demonstration = Demonstration.from_steps([[(0, 0)], [(1, 0), step]], mdp)
    with pytest.raises(DemonstrationError, match=f"trajectory 1, step 1 {why}; this method needs to see"):
        visit_counts(mdp, demonstration)


def test_indices_and_emptiness_are_checked(random_mdp):
    mdp = random_mdp(0)
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0: state 9 is out of range"):
        visit_counts(mdp, Demonstration.from_pairs([[9]], [[0]]))
    with pytest.raises(DemonstrationError, match="no step"):
        visit_counts(mdp, Demonstration.from_steps([], mdp))
    with pytest.raises(ValueError, match=r"shape \[n, S, A\] = \[n, 4, 3\], got \[4, 3\]"):
        boltzmann_log_likelihoods(mdp, jnp.zeros(2), np.zeros((4, 3)))
