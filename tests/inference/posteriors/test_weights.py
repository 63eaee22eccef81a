"""The posterior over weights and hidden steps."""

from dataclasses import replace

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer.util import log_density

from i2rl.analysis.benchmarks.statistics.calibration import Ranks, rank_statistics, uniformity
from i2rl.inference.completion.smoothing import evidence_of, smooth_all
from i2rl.inference.posteriors.weights import gather, potential, sample_posterior
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    TabularMDP,
    TrajectoryLaw,
    Visibility,
    reward_of,
    sample_demonstration,
    soft_plan,
)
from i2rl.models.laws.occlusion import occlusion_model

DRAWS, CHAINS = 400, 2
OPTIONS = {"draws": DRAWS, "warmup": 200, "chains": CHAINS}


@pytest.fixture(scope="module")
def mdp():
    n_states = 4
    ring = np.arange(n_states)
    transitions = np.zeros((n_states, 2, n_states))
    for a, move in enumerate((1, -1)):
        transitions[ring, a, (ring + move) % n_states] = 0.8
        transitions[ring, a, ring] = 0.2
    features = np.zeros((n_states, 2, 2))
    features[0, :, 0] = 1
    features[:, 1, 1] = 1
    return TabularMDP.from_dense(
        transitions,
        features,
        discount=0.8,
        states=("north", "east", "south", "west"),
        actions=("on", "back"),
        feature_names=("home", "turned"),
    )


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([True, True, False, False]))


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    """Simulate, with a lost frame, a shorter trajectory, and two that are wholly hidden."""
    law = TrajectoryLaw(mdp, jnp.array([1.5, -1.0]), sensor, 5)
    codes = np.array(sample_demonstration(jax.random.key(5), law, 12).codes)
    codes[0, 2] = [3, -1, -1]
    codes[1, 3:] = [0, -1, -1]
    codes[2:4] = [2, -1, -1]
    return Demonstration.from_codes(codes)


@pytest.fixture(scope="module")
def idata(mdp, sensor, demonstration):
    return sample_posterior(jax.random.key(0), mdp, sensor, demonstration, **OPTIONS)


def grid_moments(mdp, sensor, demonstration, prior, low, high, points=121):
    """Mean and standard deviation of the weights by quadrature over a box."""
    axis = jnp.linspace(low, high, points)
    grid = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    density = jax.jit(
        lambda w: log_density(
            occlusion_model, (mdp, sensor, demonstration.codes), {"prior": prior}, {"weights": w}
        )[0]
    )
    logs = jax.lax.map(density, grid, batch_size=64)
    mass = np.exp(np.asarray(logs - logs.max()))
    mass /= mass.sum()
    mean = mass @ np.asarray(grid)
    return mean, np.sqrt(mass @ (np.asarray(grid) - mean) ** 2)


def assert_moments(idata, mean, sd):
    weights = idata.posterior.weights
    error = sd / np.sqrt(az.ess(idata, method="mean").weights.values)
    np.testing.assert_array_less(np.abs(weights.mean(("chain", "draw")).values - mean), 4.5 * error)
    error = sd / np.sqrt(2 * az.ess(idata, method="sd").weights.values)
    np.testing.assert_array_less(np.abs(weights.std(("chain", "draw")).values - sd), 4.5 * error)


def test_posterior_agrees_with_quadrature(idata, mdp, sensor, demonstration):
    assert_moments(idata, *grid_moments(mdp, sensor, demonstration, None, -12.0, 12.0))
    assert not idata.sample_stats.diverging.any()
    assert float(az.rhat(idata).weights.max()) < 1.03


def test_draws_are_the_same_but_for_units(idata, mdp, sensor, demonstration):
    units = np.array([2.0**30, 2.0**-20])
    other = replace(mdp, features=mdp.features * units)
    drawn = (
        sample_posterior(
            jax.random.key(0), other, sensor, demonstration, completions=False, **OPTIONS
        ).posterior.weights
        * units
    )
    plain = idata.posterior.weights
    # Rounding of the priors' scales sets chains apart, and nothing else does.
    error = np.hypot(az.mcse(plain).weights.values, az.mcse(drawn).weights.values)
    np.testing.assert_array_less(np.abs((plain - drawn).mean(("chain", "draw")).values), 4.5 * error)


def test_posterior_under_a_prior_on_positive_weights_agrees_with_quadrature(mdp, sensor, demonstration):
    prior = dist.HalfNormal(2.0)
    idata = sample_posterior(
        jax.random.key(1), mdp, sensor, demonstration, prior=prior, completions=False, **OPTIONS
    )
    assert float(idata.posterior.weights.min()) >= 0
    mean, sd = grid_moments(mdp, sensor, demonstration, prior, 1e-6, 9.0, points=241)
    # The density is cut off at zero, where a rectangle rule errs by half a cell.
    weights = idata.posterior.weights
    error = 4.5 * az.mcse(idata).weights.values + 0.5 * 9 / 240
    np.testing.assert_array_less(np.abs(weights.mean(("chain", "draw")).values - mean), error)
    np.testing.assert_allclose(weights.std(("chain", "draw")).values, sd, rtol=0.2)


def test_without_information_the_posterior_is_the_prior(mdp, demonstration):
    blind = Visibility(np.zeros(4))
    nothing = Demonstration.from_codes(np.where(demonstration.codes[:, :1] == 0, 0, [2, -1, -1]).repeat(5, 1))
    idata = sample_posterior(
        jax.random.key(2), mdp, blind, nothing, completions=False, prior=dist.Normal(1.0, 2.0), **OPTIONS
    )
    assert_moments(idata, np.ones(2), np.full(2, 2.0))


def test_completions_follow_the_smoothing_marginals_of_their_draws(idata, mdp, sensor, demonstration):
    evidence = evidence_of(mdp, sensor, demonstration)
    weights = jnp.asarray(idata.posterior.weights.values.reshape(-1, 2))

    def marginals(w):
        return smooth_all(mdp, soft_plan(mdp, reward_of(mdp, w)).log_policy, evidence).pairs

    probability = np.asarray(jax.jit(lambda ws: jax.lax.map(marginals, ws))(weights))
    states = idata.completions.state.values.reshape(-1, *demonstration.kind.shape)
    actions = idata.completions.action.values.reshape(states.shape)
    hits = (states[..., None, None] == np.arange(4)[:, None]) & (actions[..., None, None] == np.arange(2))
    # Given the weights the completions are independent, so the error of their frequency is known.
    error = np.sqrt((probability * (1 - probability)).sum(0))
    np.testing.assert_array_less(np.abs(hits.sum(0) - probability.sum(0)), 5 * error + 1e-6)


def test_completions_keep_what_was_seen_and_stay_out_of_view_elsewhere(idata, demonstration):
    states, actions = idata.completions.state.values, idata.completions.action.values
    seen, hidden, pad = (demonstration.kind == kind for kind in (1, 2, 0))
    assert (states[..., seen] == demonstration.state[seen]).all()
    assert (actions[..., seen] == demonstration.action[seen]).all()
    assert (states[..., hidden] >= 2).all()
    assert (states[..., pad] == -1).all()
    assert (actions[..., pad] == -1).all()


def test_log_likelihood_is_that_of_the_law_at_each_draw(idata, mdp, sensor, demonstration):
    for chain, draw in ((0, 0), (1, 17)):
        weights = jnp.asarray(idata.posterior.weights.values[chain, draw])
        expected = TrajectoryLaw(mdp, weights, sensor, 5).log_prob(jnp.asarray(demonstration.codes))
        np.testing.assert_allclose(
            idata.log_likelihood.demonstration.values[chain, draw], expected, rtol=1e-10
        )


def test_draws_carry_names(idata, mdp, demonstration):
    n, length = demonstration.kind.shape
    assert idata.posterior.weights.dims == ("chain", "draw", "feature")
    assert list(idata.posterior.feature.values) == ["home", "turned"]
    assert idata.completions.state.sizes == {"chain": CHAINS, "draw": DRAWS, "trajectory": n, "step": length}
    assert idata.log_likelihood.demonstration.dims == ("chain", "draw", "trajectory")
    assert idata.observed_data.kind.dims == ("trajectory", "step")
    assert idata.posterior.attrs["mdp_fingerprint"] == mdp.fingerprint()
    named = idata.constant_data.state_name[idata.completions.state.isel(trajectory=2, step=0)]
    assert set(np.unique(named)) == {"south", "west"}
    assert list(az.summary(idata).index) == ["weights[home]", "weights[turned]"]


def test_sampler_statistics_have_arviz_names(idata):
    stats = idata.sample_stats
    names = {
        "lp",
        "energy",
        "acceptance_rate",
        "step_size",
        "n_steps",
        "tree_depth",
        "reached_max_treedepth",
        "diverging",
    }
    assert names <= set(stats.data_vars)
    assert (stats.n_steps < 2**stats.tree_depth).all()
    assert np.isfinite(az.bfmi(idata)).all()
    assert np.isfinite(az.loo(idata).elpd_loo)


def test_posterior_survives_a_file(idata, tmp_path):
    path = tmp_path / "posterior.nc"
    idata.to_netcdf(str(path), engine="h5netcdf")
    back = az.from_netcdf(str(path), engine="h5netcdf")
    assert set(back.groups()) == set(idata.groups())
    for group in idata.groups():
        assert back[group].equals(idata[group]), group
    assert back.posterior.attrs == idata.posterior.attrs
    assert back.attrs["mdp_fingerprint"] == idata.attrs["mdp_fingerprint"]


def test_the_same_key_gives_the_same_bits(idata, mdp, sensor, demonstration):
    again = sample_posterior(jax.random.key(0), mdp, sensor, demonstration, **OPTIONS)
    for group in ("posterior", "completions", "log_likelihood", "sample_stats"):
        assert again[group].equals(idata[group]), group
    other = sample_posterior(jax.random.key(9), mdp, sensor, demonstration, **OPTIONS)
    assert not other.posterior.equals(idata.posterior)


def test_completions_are_left_out_when_not_wanted(mdp, sensor, demonstration):
    idata = sample_posterior(
        jax.random.key(0), mdp, sensor, demonstration, **{**OPTIONS, "completions": False}
    )
    assert "completions" not in idata.groups()


def test_gathered_trajectories_give_the_same_density(mdp, sensor, demonstration):
    problem, rows = gather(mdp, sensor, demonstration)
    assert rows[2] == rows[3]
    np.testing.assert_array_equal(np.asarray(problem.codes)[rows], demonstration.codes)
    weights = jnp.array([0.4, -2.0])
    expected = log_density(occlusion_model, (mdp, sensor, demonstration.codes), {}, {"weights": weights})[0]
    assert -potential(weights, problem) == pytest.approx(float(expected), rel=1e-12)


def test_impossible_observations_are_named(mdp, sensor):
    impossible = Demonstration.from_steps([["hidden"], [("north", "on"), ("south", "on")]], mdp)
    with pytest.raises(DemonstrationError, match="trajectory 1, step 1: impossible observation"):
        sample_posterior(jax.random.key(0), mdp, sensor, impossible)


def test_wrong_sizes_are_refused(mdp, sensor, demonstration):
    with pytest.raises(ValueError, match="draws must be at least 1, got 0"):
        sample_posterior(jax.random.key(0), mdp, sensor, demonstration, draws=0)
    with pytest.raises(ValueError, match=r"over \[2\] numbers"):
        sample_posterior(jax.random.key(0), mdp, sensor, demonstration, prior=dist.Normal(jnp.zeros(3), 1.0))
    with pytest.raises(ValueError, match="no trajectories"):
        sample_posterior(jax.random.key(0), mdp, sensor, demonstration.select([]))


def test_ranks_of_the_truth_are_uniform():
    ranks = rank_statistics(jax.random.key(3), 64, draws=31, thin=6, warmup=150)
    assert ranks.ranks.shape == (64, 5)
    for quantity in uniformity(ranks, bins=8):
        assert quantity.p_value > 1e-3, quantity


def test_bins_must_share_the_ranks_evenly():
    ranks = Ranks(("weight",), np.zeros((4, 1), int), 31, 0)
    with pytest.raises(ValueError, match="5 bins cannot share 32 ranks"):
        uniformity(ranks, bins=5)


def test_ranks_that_lean_to_one_side_are_found_out():
    lean = np.random.default_rng(0).binomial(31, 0.6, (64, 1))
    assert uniformity(Ranks(("weight",), lean, 31, 0), bins=8)[0].p_value < 1e-6
