"""Weights and reliabilities together: the density against enumeration, its gradient, and its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer import Predictive
from numpyro.infer.util import log_density
from scipy import stats

from i2rl.models import FeatureNoise, TrajectoryLaw, Visibility, reward_of, soft_plan
from i2rl.models.laws.noisy_behaviour import noisy_behaviour_model
from i2rl.models.observation.demonstration import HIDDEN, SEEN, UNKNOWN
from i2rl.models.process.units import feature_scale

VIEW = np.array([1.0, 0.4, 0.8])


@pytest.fixture(scope="module")
def toy(random_mdp):
    return random_mdp(3, n_states=3, n_actions=2, n_successors=2, n_features=2)


@pytest.fixture(scope="module")
def predicates():
    return np.array([[[1, 0], [1, 1], [0, 1]], [[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 0], [1, 0]]], bool)


def evidence_by_hand(codes, predicates, reliabilities, reportable, visibility):
    """``log e_t(s, a)`` of one trajectory, one pair of pairs at a time (Eq. 6.5, normalised)."""
    _, n_states, n_actions = predicates.shape
    table = np.zeros((n_states, n_actions, n_states, n_actions))
    for s, a, o, b in np.ndindex(table.shape):
        if reportable[o, b]:
            table[s, a, o, b] = np.prod(
                [
                    p if psi[s, a] == psi[o, b] else 1 - p
                    for psi, p in zip(predicates, reliabilities, strict=True)
                ]
            )
    table /= table.sum((2, 3), keepdims=True)
    evidence = np.ones((len(codes), n_states, n_actions))
    for t, (kind, o, b) in enumerate(codes):
        if kind == SEEN:
            reports = table[:, :, slice(None) if o == UNKNOWN else [o]]
            reports = reports[..., slice(None) if b == UNKNOWN else [b]]
            evidence[t] = reports.sum((2, 3)) * visibility[:, None]
        elif kind == HIDDEN:
            evidence[t] = 1 - visibility[:, None]
    with np.errstate(divide="ignore"):
        return np.log(evidence)


@pytest.mark.parametrize(("hides", "labelled"), [(False, False), (True, False), (True, True)])
def test_the_density_is_that_of_enumeration(
    toy, predicates, hides, labelled, imperfect_demonstration, enumerate_completions
):
    if labelled:
        predicates = np.stack([*predicates[:2], np.tile(np.arange(3)[:, None], 2)])
    rng = np.random.default_rng(int(hides))
    weights, p = rng.normal(size=2), rng.uniform(0.1, 0.95, 3)
    reportable = np.array([[1, 1], [1, 0], [1, 1]], bool)
    visibility = VIEW if hides else np.ones(3)
    log_policy = soft_plan(toy, reward_of(toy, jnp.asarray(weights))).log_policy
    sensor = FeatureNoise(predicates, p, reportable) * Visibility(visibility)
    demonstration = imperfect_demonstration(4, toy, log_policy, sensor, 6, 4)
    expected = stats.norm.logpdf(weights, scale=2.5 / feature_scale(toy)).sum()
    expected += stats.beta.logpdf(p, 3, 1.5).sum()
    for codes, length in zip(np.asarray(demonstration.codes), demonstration.lengths, strict=True):
        by_hand = evidence_by_hand(codes[:length], predicates, p, reportable, visibility)
        expected += enumerate_completions(toy, log_policy, by_hand).log_likelihood
    assert np.isfinite(expected)
    density, _ = log_density(
        noisy_behaviour_model,
        (toy, jnp.asarray(predicates), jnp.asarray(demonstration.codes)),
        {
            "visibility": Visibility(visibility) if hides else None,
            "reportable": jnp.asarray(reportable),
            "reliability_prior": dist.Beta(3.0, 1.5),
        },
        {"weights": jnp.asarray(weights), "reliabilities": jnp.asarray(p)},
    )
    assert abs(float(density) - expected) < 1e-10


def test_the_gradient_is_that_of_differences(toy, predicates, imperfect_demonstration):
    p = np.array([0.8, 0.3, 0.9])
    log_policy = soft_plan(toy, reward_of(toy, jnp.array([1.0, -1.0]))).log_policy
    sensor = FeatureNoise(predicates, p) * Visibility(VIEW)
    codes = jnp.asarray(imperfect_demonstration(2, toy, log_policy, sensor, 8, 5).codes)

    @jax.jit
    def density(x):
        sites = {"weights": x[:2], "reliabilities": x[2:]}
        arguments = (toy, jnp.asarray(predicates), codes)
        return log_density(noisy_behaviour_model, arguments, {"visibility": Visibility(VIEW)}, sites)[0]

    x = np.concatenate([[0.5, -0.2], p])
    steps = 1e-5 * np.eye(5)
    differences = [float(density(x + h) - density(x - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(jax.grad(density)(jnp.asarray(x)), differences, atol=1e-6)


def test_reliabilities_of_nearly_one_leave_the_law_of_exact_perception(toy, imperfect_demonstration):
    # Three predicates that number the six pairs.
    numbers = (np.arange(6) // np.array([[1], [2], [4]]) % 2).astype(bool).reshape(3, 3, 2)
    weights = jnp.array([1.0, 2.0])
    log_policy = soft_plan(toy, reward_of(toy, weights)).log_policy
    codes = jnp.asarray(imperfect_demonstration(5, toy, log_policy, Visibility(VIEW), 10, 4).codes)
    p = np.full(3, 1 - 1e-13)
    sites = {"weights": weights, "reliabilities": jnp.asarray(p)}
    density, _ = log_density(
        noisy_behaviour_model, (toy, jnp.asarray(numbers), codes), {"visibility": Visibility(VIEW)}, sites
    )
    exact = TrajectoryLaw(toy, weights, Visibility(VIEW), 4).log_prob(codes).sum()
    assert np.isfinite(exact)
    prior = stats.norm.logpdf(weights, scale=2.5 / feature_scale(toy)).sum()
    prior += stats.beta.logpdf(p, 4, 1).sum()
    assert abs(float(density) - float(exact) - prior) < 1e-9


def test_without_codes_the_model_simulates(toy, predicates):
    draw = Predictive(noisy_behaviour_model, num_samples=7)
    drawn = draw(jax.random.key(0), toy, jnp.asarray(predicates), n_trajectories=3, length=4)
    assert drawn["demonstration"].shape == (7, 3, 4, 3)
    assert drawn["reliabilities"].shape == (7, 3)
    assert (drawn["demonstration"][..., 0] == SEEN).all()


def test_bad_input_is_refused_in_its_own_terms(toy, predicates):
    def density(*arguments, **options):
        sites = {"weights": jnp.zeros(2), "reliabilities": jnp.full(3, 0.5)}
        log_density(noisy_behaviour_model, arguments, options, sites)

    codes = jnp.zeros((1, 2, 3), jnp.int32).at[..., 0].set(SEEN)
    with pytest.raises(ValueError, match="needs n_trajectories and length"):
        density(toy, jnp.asarray(predicates))
    with pytest.raises(ValueError, match=r"over one number or over \[3\] numbers"):
        density(toy, jnp.asarray(predicates), codes, reliability_prior=dist.Beta(jnp.ones(2), 1.0))
    with pytest.raises(ValueError, match="the prior Normal admits others"):
        density(toy, jnp.asarray(predicates), codes, reliability_prior=dist.Normal(0.0, 1.0))
    with pytest.raises(ValueError, match="observation model is about"):
        density(toy, jnp.asarray(predicates[:, :2]), codes)
    with pytest.raises(ValueError, match="one noise"):
        density(toy, jnp.asarray(predicates), codes, visibility=FeatureNoise(predicates, np.full(3, 0.5)))
