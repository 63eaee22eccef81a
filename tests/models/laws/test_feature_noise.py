"""The declared model of noise on features: closed forms, quadrature, enumeration, and the point estimate."""

import arviz as az
import jax
import numpy as np
import pytest
from scipy import special, stats

from i2rl.inference.programs.observation import ObservationProgram
from i2rl.models import FeatureNoise, observation_feature_model, sample_observation_features
from i2rl.models.observation.agreement import ReportedMatches

# Every combination of two predicates once: the two are independent.
INDEPENDENT = np.array([[0, 0, 1, 1], [0, 1, 0, 1]], bool).reshape(2, 2, 2)
REPORTED = ReportedMatches(np.array([[10.0, 20.0], [5.0, 15.0]]), np.array([43.0, 30.0]))
SCORES = np.array([0.25, 1.0, 0.32, 0.0, np.nan, 0.3, 0.38, 0.21])


def random_reports(seed, n_predicates=3, shape=(4, 3)):
    rng = np.random.default_rng(seed)
    weights = rng.gamma(1.0, size=shape)
    reportable = rng.random(shape) < 0.8
    matches = weights.sum() * rng.uniform(0.55, 0.8, n_predicates)
    return rng.random((n_predicates, *shape)) < 0.5, ReportedMatches(weights, matches), reportable


def log_density(model, reliabilities):
    """Compute the model's density of reliabilities (not of their logits) and of the data."""
    point = {"reliability_logodds__": special.logit(reliabilities)}
    return float(model.compile_logp(jacobian=False, mode="FAST_COMPILE")(point))


def by_enumeration(predicates, reported, reportable, reliabilities):
    """Log-likelihood of matches and probability of agreement on everything, over all pairs of pairs."""
    psi = predicates.reshape(len(predicates), -1)
    agree = psi[:, :, None] == psi[:, None]
    p = np.asarray(reliabilities)[:, None, None]
    odds = np.where(agree, p / (1 - p), 1.0).prod(0)[:, reportable.ravel()]
    z, truths = odds.sum(1), np.asarray(reported.weights).ravel()
    right = (odds * agree.all(0)[:, reportable.ravel()]).sum(1) / z
    return reported.matches @ special.logit(reliabilities) - truths @ np.log(z), truths @ right / truths.sum()


def test_the_posterior_of_independent_predicates_is_the_conjugate_one():
    a, b = np.array([2.0, 1.0]), np.array([3.0, 0.5])
    drawn = sample_observation_features(
        jax.random.key(1), INDEPENDENT, REPORTED, prior=(a, b), chains=2, names=("shape", "colour")
    )
    assert drawn.posterior.predicate.values.tolist() == ["shape", "colour"]
    assert drawn.posterior.sizes == {"chain": 2, "draw": 1000, "predicate": 2}
    exact = stats.beta(a + REPORTED.matches, b + 50 - REPORTED.matches)
    reliability = drawn.posterior.reliability
    error = az.mcse(drawn, var_names="reliability", method="mean").reliability.values
    assert (np.abs(reliability.mean(("chain", "draw")) - exact.mean()) < 4 * error).all()
    # Of a thousand effective draws, a standard deviation is known to a fortieth.
    np.testing.assert_allclose(reliability.std(("chain", "draw")), exact.std(), rtol=0.1)
    np.testing.assert_allclose(drawn.posterior.agreement, reliability, atol=1e-12)
    np.testing.assert_allclose(drawn.observed_data.matches, REPORTED.matches)
    assert not drawn.sample_stats.diverging.any()


def test_the_posterior_with_scores_is_that_of_quadrature():
    drawn = sample_observation_features(
        jax.random.key(2), INDEPENDENT, REPORTED, scores=SCORES, chains=2, draws=1500
    )
    known = SCORES[~np.isnan(SCORES)]
    p = (np.arange(400) + 0.5) / 400
    first, second = np.meshgrid(p, p, indexing="ij")
    log_posterior = stats.beta.logpdf(first, 44, 8) + stats.beta.logpdf(second, 31, 21)
    log_posterior += known.sum() * np.log(first * second) + (1 - known).sum() * np.log(1 - first * second)
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    mean = drawn.posterior.reliability.mean(("chain", "draw"))
    error = az.mcse(drawn, var_names="reliability", method="mean").reliability.values
    assert (np.abs(mean - [(weight * first).sum(), (weight * second).sum()]) < 4 * error + 1e-4).all()
    # Scores this low are heard.
    assert (mean < np.array([44, 31]) / 52 - 0.005).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_density_is_that_of_enumeration(seed):
    predicates, reported, reportable = random_reports(seed)
    p = np.random.default_rng(seed).uniform(0.1, 0.95, 3)
    model = observation_feature_model(
        predicates, reported, scores=SCORES, reportable=reportable, prior=(2.0, 1.5)
    )
    matched, right = by_enumeration(predicates, reported, reportable, p)
    known = SCORES[~np.isnan(SCORES)]
    expected = matched + stats.beta.logpdf(p, 2.0, 1.5).sum()
    expected += known.sum() * np.log(right) + (1 - known).sum() * np.log1p(-right)
    np.testing.assert_allclose(log_density(model, p), expected, atol=1e-10)


def test_the_likelihood_is_stationary_at_the_maximum_entropy_estimate():
    predicates, reported, reportable = random_reports(5)
    estimate = ObservationProgram(predicates, reportable).solve(reported.weights, reported.agreement)
    assert estimate.gap.max() < 1e-7
    model = observation_feature_model(predicates, reported, reportable=reportable)

    def at(logits):
        return log_density(model, special.expit(logits))

    here = at(estimate.logits)
    for j in range(3):
        step = 1e-3 * np.eye(3)[j]
        up, down = at(estimate.logits + step), at(estimate.logits - step)
        assert abs(up - down) / 2e-3 < 1e-5
        assert max(up, down) < here


def test_the_agreement_of_the_model_is_that_of_the_sensor():
    predicates, reported, reportable = random_reports(4)
    model = observation_feature_model(predicates, reported, reportable=reportable)
    p = np.array([0.9, 0.3, 0.7])
    expected = np.einsum(
        "jsa,sa->j", FeatureNoise(predicates, p, reportable).agreement(), reported.weights
    ) / np.sum(reported.weights)
    given = {model["reliability"]: p}
    np.testing.assert_allclose(model["agreement"].eval(given, mode="FAST_COMPILE"), expected, atol=1e-12)


def test_bad_input_is_refused_in_its_own_terms():
    def build(reported=REPORTED, **options):
        observation_feature_model(INDEPENDENT, reported, **options)

    with pytest.raises(ValueError, match=r"that of report 1 is 1\.2"):
        build(scores=[0.5, 1.2])
    with pytest.raises(ValueError, match="one for each report"):
        build(scores=[[0.5]])
    with pytest.raises(ValueError, match="predicate 0 matched on 60 of 50 reports"):
        build(REPORTED._replace(matches=np.array([60.0, 1.0])))
    with pytest.raises(ValueError, match="2 predicates need as many matches"):
        build(REPORTED._replace(matches=np.array([1.0])))
    with pytest.raises(ValueError, match="not negative and not all zero"):
        build(REPORTED._replace(weights=np.zeros((2, 2))))
    with pytest.raises(ValueError, match="Beta priors need positive parameters"):
        build(prior=(1.0, 0.0))
    with pytest.raises(ValueError, match="as many names, all different"):
        build(names=("one", "one"))
    with pytest.raises(ValueError, match="draws must be at least 1"):
        sample_observation_features(jax.random.key(0), INDEPENDENT, REPORTED, draws=0)


def test_the_same_key_gives_the_same_draws():
    short = {"draws": 20, "warmup": 20, "chains": 1}
    once, again = (
        sample_observation_features(jax.random.key(3), INDEPENDENT, REPORTED, **short) for _ in range(2)
    )
    np.testing.assert_array_equal(once.posterior.reliability, again.posterior.reliability)
