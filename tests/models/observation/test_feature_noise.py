"""Noise on features: a distribution over observations, whose likelihood is that of enumeration."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2rl.models import FeatureNoise, TrajectoryLaw, Visibility
from i2rl.models.observation.demonstration import HIDDEN, LOST, UNKNOWN
from i2rl.models.process.planning import reward_of, soft_plan

S, A, J = 4, 3, 3
SEEN = 1


def predicates(seed=0):
    return np.random.default_rng(seed).random((J, S, A)) < 0.5


def noise(seed=0, reportable=None):
    p = np.random.default_rng(seed + 1).uniform(0.1, 0.95, J)
    return FeatureNoise(predicates(seed), p, reportable)


def by_definition(sensor):
    """``O(o | g)`` pair by pair, as Eq. 6.5 says, normalised."""
    psi, p = np.asarray(sensor.predicates), np.asarray(sensor.reliabilities)
    table = np.zeros((S, A, S, A))
    for s, a, t, b in product(range(S), range(A), range(S), range(A)):
        equal = psi[:, s, a] == psi[:, t, b]
        table[s, a, t, b] = np.where(equal, p, 1 - p).prod() * bool(sensor.reportable[t, b])
    return table / table.sum((2, 3), keepdims=True)


def labels(seed=0):
    """Two labels of several values each and a predicate."""
    rng = np.random.default_rng(seed)
    state = np.broadcast_to(np.arange(S)[:, None] - 2, (S, A))
    return np.stack([state, rng.integers(3, size=(S, A)), rng.random((S, A)) < 0.5])


def with_labels(seed=0, reportable=None):
    return FeatureNoise(labels(seed), noise(seed).reliabilities, reportable)


@given(st.integers(0, 10_000))
@settings(max_examples=8, deadline=None)
def test_reports_are_distributed_as_defined(seed):
    mask = np.random.default_rng(seed).random((S, A)) < 0.7
    mask[0, 0] = True
    for sensor in (noise(seed), noise(seed, mask), with_labels(seed), with_labels(seed, mask)):
        np.testing.assert_allclose(np.exp(sensor.log_probabilities), by_definition(sensor), atol=1e-12)


@pytest.mark.parametrize("sensor", [noise(3), with_labels(3)], ids=["predicates", "labels"])
def test_agreement_is_how_often_a_predicate_is_reported_rightly(sensor):
    table, psi = by_definition(sensor), np.asarray(sensor.predicates)
    expected = np.array(
        [[[(table[s, a] * (q == q[s, a])).sum() for a in range(A)] for s in range(S)] for q in psi]
    )
    np.testing.assert_allclose(sensor.agreement(), expected, atol=1e-12)


def test_what_injects_noise_is_what_explains_it():
    model = noise(1).noise
    draw = jax.jit(jax.vmap(model.report, in_axes=(0, None, None)))
    states, actions = draw(jax.random.split(jax.random.key(0), 20_000), 2, 1)
    counts = np.zeros((S, A))
    np.add.at(counts, (np.asarray(states), np.asarray(actions)), 1)
    expected = 20_000 * by_definition(noise(1))[2, 1]
    # Chi-square with 11 degrees of freedom exceeds 35 with probability 2e-4.
    assert ((counts - expected) ** 2 / expected).sum() < 35


def test_what_labels_are_called_does_not_matter():
    p = [0.8, 0.6, 0.3]
    table = FeatureNoise(labels(), p).log_probabilities
    np.testing.assert_array_equal(FeatureNoise(7 - 3 * labels(), p).log_probabilities, table)
    # Two values are a predicate, by whatever name.
    psi = predicates()
    plain = FeatureNoise(psi, p)
    for other in (FeatureNoise(psi * 1.0, p), FeatureNoise(psi + 4, p), FeatureNoise(jnp.asarray(~psi), p)):
        np.testing.assert_allclose(other.log_probabilities, plain.log_probabilities, atol=1e-12)


def test_a_predicate_of_reliability_one_half_says_nothing():
    p = np.array([0.8, 0.5, 0.3])
    psi = predicates(5)
    without = FeatureNoise(psi[[0, 2]], p[[0, 2]])
    np.testing.assert_allclose(FeatureNoise(psi, p).log_probabilities, without.log_probabilities, atol=1e-12)


# One compilation for all rows of all tests.
soft_policy = jax.jit(lambda mdp, weights: soft_plan(mdp, reward_of(mdp, weights)).policy)


def enumerated(mdp, weights, sensor, visibility, codes):
    """Likelihood of one trajectory: the sum over everything that can have happened."""
    policy = np.asarray(soft_policy(mdp, weights))
    transition = np.zeros((S, A, S))
    s, a, _ = np.indices(mdp.successors.shape)
    np.add.at(transition, (s, a, np.asarray(mdp.successors)), np.asarray(mdp.probabilities))
    table, total = by_definition(sensor), 0.0
    initial = np.asarray(mdp.initial)
    for path in product(product(range(S), range(A)), repeat=len(codes)):
        p = initial[path[0][0]]
        for t, ((s, a), (kind, seen_s, seen_a)) in enumerate(zip(path, codes, strict=True)):
            p *= policy[s, a] * (transition[path[t - 1][0], path[t - 1][1], s] if t else 1.0)
            if kind == SEEN:
                reported = table[s, a] if seen_s == UNKNOWN else table[s, a][[seen_s]]
                reported = reported if seen_a == UNKNOWN else reported[:, [seen_a]]
                p *= visibility[s] * reported.sum()
            elif kind == HIDDEN:
                p *= 1 - visibility[s]
        total += p
    return np.log(total)


@pytest.mark.parametrize("sensor", [noise(2), with_labels(2)], ids=["predicates", "labels"])
@pytest.mark.parametrize("visibility", [None, np.array([1.0, 0.0, 0.6, 1.0])])
def test_likelihood_of_a_noisy_trajectory_hidden_in_places_is_that_of_enumeration(
    random_mdp, visibility, sensor
):
    mdp = random_mdp(7, n_states=S, n_actions=A, n_features=2, masked=True)
    weights = jnp.array([1.5, -2.0])
    whole = sensor if visibility is None else Visibility(visibility) * sensor
    rows = [
        [[SEEN, 1, 2], [SEEN, 3, 0], [SEEN, 0, 1]],
        [[SEEN, 1, UNKNOWN], [LOST, UNKNOWN, UNKNOWN], [SEEN, UNKNOWN, 1]],
    ]
    if visibility is not None:
        rows.append([[SEEN, 2, 2], [HIDDEN, UNKNOWN, UNKNOWN], [SEEN, 0, 1]])
    law = TrajectoryLaw(mdp, weights, whole, 3)
    view = np.ones(S) if visibility is None else visibility
    for row in rows:
        expected = enumerated(mdp, weights, sensor, view, row)
        assert float(law.log_prob(jnp.array(row))) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("psi", [predicates(2), labels(2)], ids=["predicates", "labels"])
def test_likelihood_has_a_gradient_in_the_reliabilities(random_mdp, psi):
    mdp = random_mdp(7, n_states=S, n_actions=A, n_features=2)
    row = jnp.array([[SEEN, 1, 2], [SEEN, 3, 0], [SEEN, 0, 1]])

    @jax.jit
    def value(p):
        sensor = FeatureNoise(jnp.asarray(psi), p, jnp.ones((S, A), bool))
        return TrajectoryLaw(mdp, jnp.array([1.0, -1.0]), sensor, 3).log_prob(row)

    p = jnp.array([0.7, 0.6, 0.9])
    numeric = [(value(p + 1e-6 * e) - value(p - 1e-6 * e)) / 2e-6 for e in np.eye(J)]
    np.testing.assert_allclose(jax.grad(value)(p), numeric, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((predicates()[0], [0.5]), r"predicates have shape \[J, S, A\], got \[4, 3\]"),
        ((predicates(2) * 0.5, [0.5] * J), r"true or false, or whole .* predicate 0 of the pair .* is 0\.5"),
        ((np.full((J, S, A), np.nan), [0.5] * J), "whole numbers; predicate 0 .* is nan"),
        ((np.full((J, S, A), "left"), [0.5] * J), "whole numbers; got entries of type <U4"),
        ((predicates(), [0.5, 0.5]), r"3 predicates need as many reliabilities, got shape \[2\]"),
        ((predicates(), [0.5, 1.0, 0.5]), "that of predicate 1 is 1.0"),
        ((predicates(), [0.5, np.nan, 0.5]), "that of predicate 1 is nan"),
        ((predicates(), [0.5] * J, np.zeros((S, A), bool)), "at least one of the pairs"),
    ],
)
def test_what_makes_no_sensor_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        FeatureNoise(*arguments)
