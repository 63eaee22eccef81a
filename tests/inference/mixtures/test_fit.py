"""The alternating solution: J never falls, assignments are the best there are, and one program agrees."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.inference.completion.explanations import SeenWhole, seen_in_part, seen_whole, without_reward
from i2rl.inference.learners.mtirl import assign_trajectories
from i2rl.inference.mixtures.fit import (
    Kept,
    MixtureProgram,
    assign,
    climb,
    empty_mixture,
    nothing_kept,
)
from i2rl.inference.mixtures.merging import merge_once
from i2rl.inference.programs.entropic import entropic_proportions
from i2rl.inference.programs.maximum_entropy import count_information
from i2rl.inference.programs.minmax import MinMaxProgram
from i2rl.models import Demonstration, TrajectoryLaw, Visibility
from i2rl.models.observation.demonstration import HIDDEN, LOST
from i2rl.models.process.planning import reachable_states, reward_of, soft_plan
from i2rl.models.process.units import with_scaled_features

WAYS, LENGTH = 3, 10
climbed, merged = jax.jit(climb), jax.jit(merge_once)


@pytest.fixture(scope="module")
def mdp(random_mdp):
    # Mixtures are fitted to scaled features.
    return with_scaled_features(random_mdp(3, n_states=5, n_features=3, masked=True))


@pytest.fixture(scope="module")
def program(mdp):
    return MixtureProgram(mdp, jnp.asarray(reachable_states(mdp)), 1.0, 0.0, 0.2, 0.6, 200, 1e-9)


@pytest.fixture(scope="module")
def sensor(mdp):
    return Visibility(np.arange(5) != 2)


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    codes = [
        np.asarray(TrajectoryLaw(mdp, jnp.array(w), sensor, LENGTH).sample(jax.random.key(i), (6,)))
        for i, w in enumerate(([3.0, -2.0, 1.0], [-2.0, 3.0, -3.0]))
    ]
    return Demonstration.from_codes(np.concatenate(codes))


@pytest.fixture(scope="module")
def trajectories(mdp, sensor, demonstration):
    return seen_in_part(mdp, sensor, demonstration)


@pytest.fixture(scope="module")
def whole(mdp):
    """Compute the visits of twelve wholly seen trajectories."""
    sensor = Visibility(np.ones(5, bool))
    laws = [TrajectoryLaw(mdp, jnp.array(w), sensor, LENGTH) for w in ([3.0, -2.0, 1.0], [-2.0, 3.0, -3.0])]
    codes = [np.asarray(law.sample(jax.random.key(i), (6,))) for i, law in enumerate(laws)]
    return seen_whole(mdp, sensor, Demonstration.from_codes(np.concatenate(codes)))


def started(mdp, trajectories, seed, n_components=WAYS):
    """Draw random assignments, and compute their visits without any reward."""
    shares = jax.random.dirichlet(jax.random.key(seed), jnp.ones(n_components), trajectories.live.shape)
    shares = shares * trajectories.live[:, None]
    return shares, jnp.einsum("nd,nsa->dsa", shares, without_reward(mdp, trajectories).visits)


def dense(mdp):
    """Transition probabilities ``[S, A, S]``."""
    transition = np.zeros((5, mdp.n_actions, 5))
    s, a, _ = np.indices(mdp.successors.shape)
    np.add.at(transition, (s, a, np.asarray(mdp.successors)), np.asarray(mdp.probabilities))
    return transition


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("seen", ["whole", "trajectories"])
@pytest.mark.parametrize("temperature", [0.3, 1.0])
def test_the_objective_never_falls(mdp, program, seen, seed, temperature, request):
    trajectories = request.getfixturevalue(seen)
    kept = Kept(jnp.array([2.0, 0.5, 0.0]), jnp.zeros((WAYS, *mdp.available.shape)))
    shares, visits = started(mdp, trajectories, seed)
    program = program._replace(temperature=temperature, tolerance=-jnp.inf)
    values = [
        float(
            climbed(
                program._replace(iterations=i), trajectories, kept, empty_mixture(mdp, WAYS), shares, visits
            )[6]
        )
        for i in range(1, 16)
    ]
    assert np.isfinite(values).all()
    assert np.diff(values).min() > -1e-9 * abs(values[-1])
    assert values[-1] > values[0]


@jax.jit
def policies_of(mdp, weights):
    return jax.lax.map(lambda w: soft_plan(mdp, reward_of(mdp, w)).policy, weights)


def objective_of(mdp, program, trajectories: SeenWhole, kept, mixture, shares):
    """J as the module states it, term by term."""
    total, visits, constant = 0.0, np.asarray(trajectories.visits), np.asarray(trajectories.constant)
    policies = np.asarray(policies_of(mdp, mixture.weights))
    parts = zip(*(np.asarray(x) for x in (mixture.weights, mixture.proportions)), policies, strict=True)
    for d, (w, p, policy) in enumerate(parts):
        log_policy = np.log(np.where(policy > 0, policy, 1.0))
        log_pi = np.log(p) if p > 0 else 0.0
        total += (np.asarray(kept.visits[d]) * log_policy).sum()
        total += program.temperature * (kept.mass[d] * log_pi + program.strength * p * log_pi)
        total -= program.slack * np.abs(w).sum() + program.ridge / 2 * (w**2).sum()
        for i, v in enumerate(np.asarray(shares)[:, d]):
            if v > 0:
                likelihood = constant[i] + (visits[i] * log_policy).sum()
                total += v * likelihood - program.temperature * v * (np.log(v) - log_pi)
    return float(total)


def test_the_objective_is_the_one_stated_and_assignments_maximise_it(mdp, program, whole):
    rng = np.random.default_rng(0)
    kept = Kept(
        jnp.array([1.0, 0.5, 2.0]), jnp.asarray(rng.random((WAYS, *mdp.available.shape)) * mdp.available)
    )
    fit = climbed(program, whole, kept, empty_mixture(mdp, WAYS), *started(mdp, whole, 0))
    stated = partial(objective_of, mdp, program, whole, kept, fit.mixture)
    assert stated(fit.responsibilities) == pytest.approx(float(fit.objective), abs=1e-8)
    best = np.asarray(fit.responsibilities)
    for _ in range(20):
        other = 0.98 * best + 0.02 * rng.dirichlet(np.ones(WAYS), len(best))
        assert stated(other) < stated(best)


def test_the_climb_ends_where_every_part_is_best(mdp, program, whole):
    kept = nothing_kept(mdp, WAYS)
    fit = climbed(program, whole, kept, empty_mixture(mdp, WAYS), *started(mdp, whole, 1))
    assert fit.iterations < 200
    mass = np.asarray(fit.responsibilities).sum(0)
    np.testing.assert_allclose(fit.mixture.proportions, entropic_proportions(mass, 1.0), atol=1e-4)
    rng = np.random.default_rng(2)
    for _ in range(20):
        moved = fit.mixture._replace(weights=fit.mixture.weights + 0.05 * rng.normal(size=(WAYS, 3)))
        assert (
            objective_of(mdp, program, whole, kept, moved, fit.responsibilities) < float(fit.objective) + 1e-6
        )


def test_mergers_that_are_not_tried_would_not_have_paid(mdp, program):
    """Compare wholly seen trajectories, which save mergers, with the same ones completed, which do not."""
    sensor = Visibility(np.ones(5, bool))
    laws = [TrajectoryLaw(mdp, jnp.array(w), sensor, LENGTH) for w in ([1.8, -1.2, 0.6], [-1.2, 1.8, -1.8])]
    codes = [np.asarray(law.sample(jax.random.key(i), (6,))) for i, law in enumerate(laws)]
    demonstration = Demonstration.from_codes(np.concatenate(codes))
    whole, in_part = (f(mdp, sensor, demonstration) for f in (seen_whole, seen_in_part))
    taken = []
    for swapped, temperature in product((0, 1, 2), (0.2, 0.6)):
        labels = np.roll(np.repeat([0, 1], 6), swapped)
        shares = jnp.eye(WAYS)[labels]
        cheap = program._replace(temperature=temperature, ridge=0.02, iterations=1)
        visits = jnp.einsum("nd,nsa->dsa", shares, whole.visits)
        fit = climbed(cheap, whole, nothing_kept(mdp, WAYS), empty_mixture(mdp, WAYS), shares, visits)
        (paid, one, _), (pays, other, _) = (
            merged(cheap, trajectories, fit) for trajectories in (whole, in_part)
        )
        assert paid == pays
        if paid:
            np.testing.assert_allclose(one.mixture.weights, other.mixture.weights, atol=1e-6)
        taken.append(bool(paid))
    assert set(taken) == {False, True}


@given(
    st.lists(st.floats(-30, 0), min_size=6, max_size=6),
    st.lists(st.floats(0.01, 1), min_size=3, max_size=3),
    st.floats(0.1, 1),
)
@settings(max_examples=50, deadline=None)
def test_at_price_one_assignments_are_bayes_rule(likelihoods, proportions, temperature):
    table = jnp.array(likelihoods).reshape(3, 2)
    pi = jnp.array(proportions) / sum(proportions)
    live = jnp.array([True, True])
    joint = np.asarray(pi)[:, None] * np.exp(np.asarray(table))
    bayes = assign(table, pi, live, 1.0)
    np.testing.assert_allclose(bayes.responsibilities, (joint / joint.sum(0)).T, rtol=1e-9, atol=1e-300)
    np.testing.assert_allclose(bayes.log_likelihood, np.log(joint.sum(0)), atol=1e-9)
    np.testing.assert_allclose(bayes.value, bayes.log_likelihood, atol=1e-9)
    cheap = assign(table, pi, live, temperature)
    np.testing.assert_allclose(cheap.responsibilities.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(cheap.log_likelihood, bayes.log_likelihood, atol=1e-9)


def test_hidden_steps_are_summed_out(mdp, sensor):
    """Responsibilities of occluded trajectories against the enumeration of all that can have happened."""
    short = 4
    weights = jnp.array([[2.0, -1.0, 1.0], [-2.0, 2.0, -1.0]])
    proportions = jnp.array([0.3, 0.7])
    codes = np.array(TrajectoryLaw(mdp, weights[0], sensor, short).sample(jax.random.key(4), (3,)))
    codes[0, 1] = codes[1, 2] = [LOST, -1, -1]
    transition = dense(mdp)
    table = np.zeros((2, 3))
    hidden = 2
    initial = np.asarray(mdp.initial)
    for d, policy in enumerate(np.asarray(policies_of(mdp, weights))):
        for i, row in enumerate(codes):
            for path in product(product(range(5), range(mdp.n_actions)), repeat=short):
                p = initial[path[0][0]]
                for t, (s, a) in enumerate(path):
                    kind, seen_s, seen_a = row[t]
                    if seen_s >= 0:
                        p *= (s, a) == (seen_s, seen_a) and s != hidden
                    elif kind == HIDDEN:
                        p *= s == hidden
                    p *= policy[s, a] * (transition[path[t - 1][0], path[t - 1][1], s] if t else 1.0)
                    if p == 0:
                        break
                table[d, i] += p
    got = assign_trajectories(
        mdp, sensor, np.asarray(weights), np.asarray(proportions), Demonstration.from_codes(codes)
    )
    joint = np.asarray(proportions)[:, None] * table
    np.testing.assert_allclose(got, (joint / joint.sum(0)).T, atol=1e-10)


@pytest.mark.parametrize("temperature", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_one_program_and_alternation_reach_the_same_objective(mdp, program, whole, seed, temperature):
    program = program._replace(temperature=temperature, iterations=5000, tolerance=1e-11)
    blurred = 0.7 * np.eye(WAYS)[np.repeat([0, 1], 6)] + 0.3 * np.asarray(started(mdp, whole, seed)[0])
    visits = jnp.einsum("nd,nsa->dsa", blurred, whole.visits)
    fit = climbed(
        program, whole, nothing_kept(mdp, WAYS), empty_mixture(mdp, WAYS), jnp.asarray(blurred), visits
    )
    joint = MinMaxProgram(mdp, WAYS, 12).solve(
        np.asarray(whole.visits), 1.0, 0.0, 0.2, temperature=temperature, responsibilities=blurred
    )
    dynamics = float(whole.constant.sum())
    assert joint.objective + dynamics == pytest.approx(float(fit.objective), abs=1e-6)


def test_information_is_minus_the_hessian_where_visits_flow_as_the_policy_s(mdp):
    weights = jnp.array([1.0, -2.0, 0.5])
    plan = jax.jit(soft_plan)(mdp, reward_of(mdp, weights))
    # Discounted visits of the policy itself: their expected flow is exact.
    policy = np.asarray(plan.policy)
    transition = np.einsum("sa,sat->st", policy, dense(mdp))
    at = np.linalg.solve(np.eye(5) - float(mdp.discount) * transition.T, np.asarray(mdp.initial))
    counts = jnp.asarray(at[:, None] * policy)

    def log_likelihood(w):
        log_policy = soft_plan(mdp, reward_of(mdp, w)).log_policy
        return jnp.sum(counts * jnp.where(mdp.available, log_policy, 0.0))

    step, gradient = 1e-5, jax.jit(jax.grad(log_likelihood))
    hessian = np.stack(
        [(gradient(weights + step * e) - gradient(weights - step * e)) / (2 * step) for e in np.eye(3)]
    )
    np.testing.assert_allclose(count_information(mdp, counts, weights, plan.values), -hessian, atol=1e-6)
