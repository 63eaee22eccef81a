"""The min-max-entropy program: against alternation, stationarity, and a program for one component."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.sorting.process import demonstrate_sorting, sorting_with_claiming
from i2rl.inference.programs import minmax
from i2rl.inference.programs.constraints import ProgramNotSolved
from i2rl.inference.programs.dual import CountProgram
from i2rl.inference.programs.entropic import entropic_proportions
from i2rl.inference.programs.maximum_entropy import WarmStart, fit_counts
from i2rl.inference.programs.minmax import MinMaxProgram
from i2rl.models.process.planning import reward_of, simulate, soft_plan
from i2rl.models.process.units import feature_scale

simulate_all = jax.jit(jax.vmap(simulate, in_axes=(0, None, 0, None)), static_argnums=3)


@jax.jit
def log_policy(mdp, weights):
    policy = soft_plan(mdp, reward_of(mdp, weights)).policy
    return jnp.where(mdp.available, jnp.log(jnp.where(policy > 0, policy, 1.0)), 0.0)


def visits_of(states, actions, mdp):
    counts = np.zeros((len(states), *mdp.available.shape))
    rows = np.repeat(np.arange(len(states)), states.shape[1])
    np.add.at(counts, (rows, np.asarray(states).ravel(), np.asarray(actions).ravel()), 1)
    return counts


def mixed_visits(mdp, seed, each=8, length=12, components=2, scale=3.0):
    """Visits of soft-optimal agents with ``components`` random rewards, ``each`` trajectories of each."""
    weights = np.random.default_rng(seed).normal(0, scale, (components, mdp.n_features))
    policies = jnp.stack([jnp.where(mdp.available, log_policy(mdp, row), -jnp.inf) for row in weights])
    keys = jax.random.split(jax.random.key(seed), components * each)
    states, actions = simulate_all(keys, mdp, policies[np.repeat(np.arange(components), each)], length)
    return visits_of(states, actions, mdp)


def sorting_visits(seed, counts):
    sorting = sorting_with_claiming()
    seen = demonstrate_sorting(jax.random.key(seed), sorting, counts).demonstration
    return visits_of(seen.state, seen.action, sorting.mdp)


class Prior(NamedTuple):
    strength: float = 1.0
    slack: float = 0.1
    ridge: float = 0.1


PRIORS = [Prior(), Prior(strength=0.0), Prior(0.5, 0.0, 0.2), Prior(2.0, 0.3, 0.01), Prior(1.0, 1.0, 0.0)]


def objective_of(mdp, counts, weights, proportions, prior):
    """Compute the marginal form, written independently; ``counts [D, n, S, A]``."""
    policies = jnp.stack([log_policy(mdp, row) for row in weights])
    mixed = proportions > 0
    log_proportions = jnp.log(jnp.where(mixed, proportions, 1.0))
    joint = jnp.where(mixed, log_proportions, -jnp.inf) + jnp.einsum("disa,dsa->id", counts, policies)
    scaled = weights * feature_scale(mdp)
    penalty = prior.slack * jnp.abs(scaled).sum() + prior.ridge / 2 * (scaled**2).sum()
    entropic = prior.strength * (proportions * log_proportions).sum()
    return jax.nn.logsumexp(joint, axis=1).sum() + entropic - penalty, jax.nn.softmax(joint, axis=1)


def alternate(mdp, counts, shares, prior, sweeps=2000):
    """Update assignments, proportions and rewards in turn, until the objective stands still."""
    counts = np.broadcast_to(counts, (shares.shape[1], *counts.shape[-3:]))
    origin = WarmStart(jnp.zeros(mdp.n_features), jnp.zeros(mdp.n_states))
    warm, last = [origin] * shares.shape[1], -np.inf
    for _ in range(sweeps):
        proportions = entropic_proportions(shares.sum(0), prior.strength)
        fits = [
            fit_counts(mdp, np.tensordot(shares[:, d], counts[d], 1), prior.slack, prior.ridge, warm[d])
            for d in range(shares.shape[1])
        ]
        warm = [fit.warm() for fit in fits]
        weights = jnp.stack([fit.weights for fit in fits])
        objective, shares = objective_of(mdp, counts, weights, proportions, prior)
        shares = np.asarray(shares)
        if objective - last < 1e-11 * abs(objective):
            break
        last = objective
    return float(objective), shares


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(3, n_states=5, n_features=3, masked=True)


@pytest.fixture(scope="module")
def program(mdp):
    return MinMaxProgram(mdp, 3, 20)


@pytest.mark.parametrize(("seed", "prior"), zip((1, 2, 3, 6, 5), PRIORS, strict=True))
def test_one_program_and_alternation_climb_to_the_same_optimum(mdp, program, seed, prior):
    counts = mixed_visits(mdp, seed)
    random = np.random.default_rng(seed).dirichlet(np.ones(3), len(counts))
    shares = 0.5 * np.eye(3)[np.repeat([0, 1], 8)] + 0.5 * random
    expected, responsibilities = alternate(mdp, counts, shares, prior)
    solution = program.solve(counts, *prior, responsibilities=shares)
    assert solution.objective == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(solution.responsibilities.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(
        np.sort(solution.responsibilities.sum(0)), np.sort(responsibilities.sum(0)), atol=1e-2
    )


@pytest.mark.parametrize("seed", range(4))
def test_alternation_has_nothing_to_add_to_the_optimum(mdp, program, seed):
    # Whichever hill a random start leads to: a point where alternation stands still.
    counts = mixed_visits(mdp, 40 + seed)
    shares = np.random.default_rng(seed).dirichlet(np.ones(3), len(counts))
    solution = program.solve(counts, *PRIORS[seed], responsibilities=shares)
    further, _ = alternate(mdp, counts, solution.responsibilities, PRIORS[seed])
    assert solution.objective == pytest.approx(further, abs=1e-6)


@pytest.mark.parametrize(("components", "prior"), [(2, Prior(0.1, 0.01, 0.01)), (4, Prior(1.0, 0.1, 0.01))])
def test_they_agree_on_two_ways_of_sorting(components, prior):
    mdp = sorting_with_claiming().mdp
    counts = sorting_visits(0, (8, 8))
    start = np.random.default_rng(1).dirichlet(np.ones(components), 16)
    if components == 2:
        start = 0.3 + 0.4 * np.eye(2)[np.repeat([0, 1], 8)]
    expected, _ = alternate(mdp, counts, start, prior)
    solution = MinMaxProgram(mdp, components, 16).solve(counts, *prior, responsibilities=start)
    assert solution.objective == pytest.approx(expected, abs=1e-6)


def test_expected_visits_may_differ_by_component(mdp, program):
    rng = np.random.default_rng(11)
    counts = mixed_visits(mdp, 11)
    completed = np.stack([counts, counts, counts]) + 0.3 * rng.random((3, *counts.shape)) * np.asarray(
        mdp.available
    )
    shares = rng.dirichlet(np.ones(3), len(counts))
    expected, _ = alternate(mdp, completed, shares, Prior())
    assert program.solve(completed, *Prior(), responsibilities=shares).objective == pytest.approx(
        expected, abs=1e-6
    )
    same = np.stack([counts, counts, counts])
    one, other = (program.solve(given, *Prior(), responsibilities=shares) for given in (counts, same))
    assert one.objective == pytest.approx(other.objective, abs=1e-9)


def test_the_marginal_likelihood_is_stationary_there(mdp):
    counts, prior = mixed_visits(mdp, 21), Prior(0.5, 0.0, 0.2)
    solution = MinMaxProgram(mdp, 2, 16).solve(counts, *prior, weights=np.eye(3)[:2])
    assert solution.proportions.min() > 0.01
    repeated = np.stack([counts] * 2)

    def along(point):
        weights, proportions = jnp.asarray(point[:-2].reshape(2, 3)), jax.nn.softmax(point[-2:])
        return float(objective_of(mdp, repeated, weights, proportions, prior)[0])

    at = np.concatenate([solution.weights.ravel(), np.log(solution.proportions)])
    assert along(at) == pytest.approx(solution.objective, abs=1e-8)
    steps = 1e-4 * np.eye(len(at))
    slopes = [(along(at + step) - along(at - step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(slopes, 0, atol=1e-5)
    assert all(along(at + 100 * step) < along(at) for step in (*steps[:-2], *-steps[:-2]))
    found = jnp.asarray(solution.weights), jnp.asarray(solution.proportions)
    _, posterior = objective_of(mdp, repeated, *found, prior)
    np.testing.assert_allclose(solution.responsibilities, posterior, atol=1e-9)


def test_one_component_is_the_count_program(mdp):
    counts = mixed_visits(mdp, 4)
    alone = CountProgram(mdp).solve(counts.sum(0), slack=0.2, ridge=0.1)
    solution = MinMaxProgram(mdp, 1, 16).solve(counts, 1.0, 0.2, 0.1, weights=np.zeros((1, 3)))
    assert solution.objective == pytest.approx(-alone.objective, abs=1e-7)
    np.testing.assert_allclose(solution.weights[0], alone.weights, atol=1e-4)
    np.testing.assert_allclose(solution.responsibilities, 1)


def test_a_warm_start_saves_most_iterations_when_a_tenth_is_new():
    mdp, prior = sorting_with_claiming().mdp, Prior(1.0, 0.1, 0.01)
    counts, others = sorting_visits(1, (10, 10, 10)), sorting_visits(2, (10, 10, 10))
    start = 0.2 / 4 + 0.8 * np.eye(4)[np.repeat(np.arange(3), 10)]
    program = MinMaxProgram(mdp, 4, 30)
    before = program.solve(counts, *prior, responsibilities=start)
    counts[::10] = others[::10]
    cold = program.solve(counts, *prior, responsibilities=start)
    warm = program.solve(counts, *prior, warm=before.warm)
    assert warm.objective == pytest.approx(cold.objective, abs=1e-6)
    assert warm.iterations < cold.iterations / 2
    labels = np.repeat(np.arange(3), 10)
    np.testing.assert_array_equal(warm.responsibilities.argmax(1), labels)
    # The fourth component died.
    assert warm.proportions.min() < 1e-6


def test_a_program_for_many_solves_fewer(mdp, program):
    counts = mixed_visits(mdp, 7)
    shares = np.random.default_rng(7).dirichlet(np.ones(3), len(counts))
    roomy = program.solve(counts, *Prior(), responsibilities=shares)
    exact = MinMaxProgram(mdp, 3, len(counts)).solve(counts, *Prior(), responsibilities=shares)
    assert roomy.objective == pytest.approx(exact.objective, abs=1e-6)
    assert roomy.responsibilities.shape == (len(counts), 3)
    grown = np.concatenate([counts, mixed_visits(mdp, 8, each=2)])
    later = program.solve(grown, *Prior(), warm=roomy.warm)
    anew = program.solve(grown, *Prior(), weights=roomy.weights)
    assert later.objective == pytest.approx(anew.objective, abs=1e-6)


def test_malformed_programs_and_starts_are_named(random_mdp, mdp, program):
    with pytest.raises(ValueError, match="at least one component"):
        MinMaxProgram(mdp, 0, 5)
    with pytest.raises(ValueError, match="6 components for 5 trajectories"):
        MinMaxProgram(mdp, 6, 5)
    with pytest.raises(ValueError, match="discount"):
        MinMaxProgram(random_mdp(0, discount=1.0), 1, 5)
    counts, weights = mixed_visits(mdp, 0), np.zeros((3, 3))
    for start, named in (
        ({}, "got none"),
        ({"weights": weights, "responsibilities": np.full((16, 3), 1 / 3)}, "responsibilities and weights"),
        ({"weights": np.zeros((2, 3))}, r"weights .* \[3, 3\]"),
        ({"responsibilities": np.full((16, 3), 0.5)}, "distributions"),
        ({"responsibilities": np.full((15, 3), 1 / 3)}, r"\[16, 3\]"),
    ):
        with pytest.raises(ValueError, match=named):
            program.solve(counts, **start)


def test_malformed_counts_and_penalties_are_named(mdp, program):
    counts, weights = mixed_visits(mdp, 0), np.zeros((3, 3))
    state, action = np.argwhere(~np.asarray(mdp.available))[0]
    stray = counts.copy()
    stray[3, state, action] = 2
    with pytest.raises(ValueError, match=rf"trajectory 3 2 visits .* state {state}, action {action}"):
        program.solve(stray, weights=weights)
    for given, named in (
        (counts[..., :1], "shape"),
        (counts[:2], "3 to 20 trajectories, got 2"),
        (np.concatenate([counts, counts]), "3 to 20 trajectories, got 32"),
        (-counts, "not negative"),
    ):
        with pytest.raises(ValueError, match=named):
            program.solve(given, weights=weights)
    for penalty in ({"strength": -1.0}, {"slack": -1.0}, {"ridge": np.nan}, {"slack": np.zeros(2)}):
        with pytest.raises(ValueError, match=next(iter(penalty))):
            program.solve(counts, weights=weights, **penalty)


def test_giving_up_is_reported(mdp, monkeypatch):
    monkeypatch.setattr(minmax, "_COLD", {**minmax._COLD, "ipopt.max_iter": 2})
    impatient = MinMaxProgram(mdp, 2, 16)
    with pytest.raises(ProgramNotSolved, match="Maximum_Iterations_Exceeded after 2 iterations"):
        impatient.solve(mixed_visits(mdp, 0), weights=np.eye(3)[:2])
