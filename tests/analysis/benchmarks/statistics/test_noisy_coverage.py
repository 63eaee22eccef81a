"""Coverage study of the joint posterior: its judge on known posteriors, and three small replications."""

import jax
import numpy as np
import pytest
from scipy import stats

from i2rl.analysis.benchmarks.statistics.noisy_coverage import (
    Run,
    Sampling,
    corridor,
    coverage_interval,
    covers,
    judge,
    rank_among,
    replicate,
    report,
)


def _conjugate_runs(number, spread=1.0, seed=0):
    """Two means with N(0, 1) priors, seen once with unit noise; exact draws, ``spread`` times as wide."""
    rng = np.random.default_rng(seed)
    for _ in range(number):
        truth = rng.normal(size=2)
        mean = (truth + rng.normal(size=2)) / 2
        draws = mean + spread * np.sqrt(0.5) * rng.normal(size=(2, 200, 2))
        flat = draws.reshape(-1, 2)
        # The density as declared, not as drawn from.
        yield Run(truth, draws, -((flat - mean) ** 2).sum(1), float(-((truth - mean) ** 2).sum()), 0)


def test_exact_posteriors_cover_as_they_say():
    replications = 300
    study = judge(("one", "other"), _conjugate_runs(replications))
    found = report(study)
    error = np.sqrt(0.9 * 0.1 / replications)
    for quantity in found["quantities"]:
        assert abs(quantity["covered"] - 0.9) < 3.5 * error, quantity
        assert quantity["from"] < quantity["covered"] < quantity["to"]
    assert found["overall"] == pytest.approx(study.covered.mean())
    assert abs(found["overall"] - 0.9) < 3.5 * found["overall_error"]
    assert found["smallest_p"] > 1e-3
    assert found["largest_r_hat"] < 1.05
    assert study.ranks.min() >= 0
    assert study.ranks.max() <= study.kept


@pytest.mark.parametrize("spread", [0.5, 2.0])
def test_posteriors_of_the_wrong_width_are_found_out(spread):
    replications = 300
    study = judge(("one", "other"), _conjugate_runs(replications, spread))
    # An interval so many times as wide holds this much of a normal distribution.
    expected = 1 - 2 * stats.norm.sf(spread * stats.norm.isf(0.05))
    share = study.covered.mean(0)
    assert (abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / replications) + 0.01).all()
    assert report(study)["smallest_p"] < 1e-6


def test_intervals_and_ranks_of_numbers_that_are_known():
    draws = np.arange(101.0)[:, None] * np.array([1.0, 10.0])
    for truth, inside in (([5.1, 949.0], [True, True]), ([4.9, 951.0], [False, False])):
        assert covers(draws, np.array(truth)).tolist() == inside
    assert covers(draws, np.array([20.0, 300.0]), 0.5).tolist() == [False, True]
    ladder = np.arange(100.0)[:, None]
    assert [int(rank_among(ladder, np.array([x]), 10)[0]) for x in (-1.0, 49.5, 200.0)] == [0, 5, 10]
    covered = np.arange(100) < 90
    assert coverage_interval(covered) == pytest.approx(
        (stats.beta.ppf(0.025, 90, 11), stats.beta.ppf(0.975, 91, 10))
    )


def test_bad_input_is_refused_in_its_own_terms():
    with pytest.raises(ValueError, match="between 0 and 1"):
        covers(np.zeros((4, 1)), np.zeros(1), 1.0)
    with pytest.raises(ValueError, match="4 draws cannot be thinned to 5"):
        rank_among(np.zeros((4, 1)), np.zeros(1), 5)
    with pytest.raises(ValueError, match="at least one replication"):
        judge(("one",), [])
    with pytest.raises(ValueError, match="replications must be at least 1"):
        next(replicate(jax.random.key(0), corridor(), 0))


def test_runs_are_of_the_declared_model_and_their_key():
    setting, sampling = corridor(), Sampling(warmup=60, draws=40)
    key = jax.random.key(3)
    replications, again = (list(replicate(key, setting, 3, sampling)) for _ in range(2))
    for one, other in zip(replications, again, strict=True):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_array_equal(x, y)
    assert not np.array_equal(replications[0].truth, replications[1].truth)
    n_weights, size = setting.mdp.n_features, len(setting.quantities)
    for run in replications:
        assert run.truth.shape == (size,)
        assert run.draws.shape == (2, 40, size)
        assert run.log_density.shape == (80,)
        # Density of parameters and data: likelihood times priors, written out.
        for values, density in ((run.truth, run.true_log_density), (run.draws[1, 7], run.log_density[47])):
            weights, reliabilities = values[:n_weights], values[n_weights:-1]
            prior = stats.norm.logpdf(weights, scale=1.5).sum() + stats.beta.logpdf(reliabilities, 4, 1).sum()
            assert density == pytest.approx(values[-1] + prior, abs=1e-9)
    study = judge(setting.quantities, replications)
    assert study.covered.shape == study.ranks.shape == study.r_hat.shape == study.ess.shape == (3, size)
    assert study.jointly_covered.shape == study.divergences.shape == (3,)
