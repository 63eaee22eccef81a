from __future__ import annotations

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import log_density

from i2rl.analysis.posteriors.diagnostics import (
    InferenceDataError,
    posterior_by_session,
    require_posterior,
    summary,
)
from i2rl.inference.posteriors.weights import run_padded_chain
from i2rl.models import DemonstrationError, TrajectoryLaw, Visibility, occlusion_model, sample_demonstration
from i2rl.models.observation.demonstration import Demonstration

AT = (2, 6)
OPTIONS = {"draws": 250, "warmup": 150, "chains": 2}


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(4)


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([True, True, True, False]))


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    law = TrajectoryLaw(mdp, jnp.array([1.5, -2.0]), sensor, 4)
    return sample_demonstration(jax.random.key(5), law, 12)


@pytest.fixture(scope="module")
def by_session(mdp, sensor, demonstration):
    before = run_padded_chain._cache_size()
    idata = posterior_by_session(jax.random.key(0), mdp, sensor, demonstration, AT, trajectories=2, **OPTIONS)
    assert run_padded_chain._cache_size() == before + 1
    return idata


def draws_of(weights, **groups):
    return az.from_dict(
        posterior={"weights": weights},
        coords={"feature": ["near", "far"]},
        dims={"weights": ["feature"]},
        **groups,
    )


def grid_moments(mdp, sensor, demonstration, half=9.0, points=61):
    """Mean and standard deviation of the weights by quadrature over a box."""
    axis = jnp.linspace(-half, half, points)
    grid = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    codes = jnp.asarray(demonstration.codes)
    density = lambda w: log_density(occlusion_model, (mdp, sensor, codes), {}, {"weights": w})[0]  # noqa: E731
    logs = jax.jit(lambda g: jax.lax.map(density, g, batch_size=64))(grid)
    mass = np.exp(np.asarray(logs - logs.max()))
    mass /= mass.sum()
    mean = mass @ np.asarray(grid)
    return mean, np.sqrt(mass @ (np.asarray(grid) - mean) ** 2)


@pytest.mark.parametrize("session", AT)
def test_each_session_has_the_posterior_of_its_data(by_session, mdp, sensor, demonstration, session):
    weights = by_session.posterior.weights.sel(session=session)
    mean, sd = grid_moments(mdp, sensor, demonstration.select(slice(0, 2 * session)))
    error = sd / np.sqrt(az.ess(weights, method="mean").weights.values)
    np.testing.assert_array_less(np.abs(weights.mean(("chain", "draw")).values - mean), 4.5 * error)
    error = sd / np.sqrt(2 * az.ess(weights, method="sd").weights.values)
    np.testing.assert_array_less(np.abs(weights.std(("chain", "draw")).values - sd), 4.5 * error)


def test_a_session_does_not_depend_on_the_others_asked_for(by_session, mdp, sensor, demonstration):
    alone = posterior_by_session(
        jax.random.key(0), mdp, sensor, demonstration, [6], trajectories=2, **OPTIONS
    )
    np.testing.assert_array_equal(alone.posterior.weights, by_session.posterior.weights.sel(session=[6]))


def test_draws_by_session_carry_names_and_provenance(by_session, mdp, tmp_path):
    assert by_session.posterior.weights.dims == ("chain", "draw", "session", "feature")
    assert list(by_session.posterior.session) == list(AT)
    assert by_session.sample_stats.diverging.dims == ("chain", "draw", "session")
    attrs = by_session.posterior.attrs
    assert attrs["mdp_fingerprint"] == mdp.fingerprint()
    assert attrs["method"].startswith("NUTS")
    path = str(tmp_path / "sessions.nc")
    by_session.to_netcdf(path, engine="h5netcdf")
    back = az.from_netcdf(path, engine="h5netcdf")
    assert back.posterior.equals(by_session.posterior)
    assert back.attrs["configuration"] == by_session.attrs["configuration"]


def test_one_session_is_a_posterior_of_its_model(by_session, mdp, sensor, random_mdp):
    one = by_session.sel(session=2)
    assert require_posterior(one, mdp, sensor).sizes == {"chain": 2, "draw": 250, "feature": 2}
    with pytest.raises(InferenceDataError, match=r"got chain, draw, session, feature; choose a session"):
        require_posterior(by_session, mdp, sensor)
    other = random_mdp(5)
    with pytest.raises(InferenceDataError, match=f"another MDP: its fingerprint is {mdp.fingerprint()[:12]}"):
        require_posterior(one, other)
    with pytest.raises(InferenceDataError, match="another sensor: Visibility with fingerprint"):
        require_posterior(one, mdp, Visibility(np.ones(4)))


def test_sessions_that_do_not_exist_are_refused(mdp, sensor, demonstration):
    for at in ([], [0, 2], [2, 13], [3, 2], [2, 2]):
        with pytest.raises(ValueError, match="increasing session numbers from 1 to 12"):
            posterior_by_session(jax.random.key(0), mdp, sensor, demonstration, at)
    with pytest.raises(ValueError, match="trajectories must be at least 1, got 0"):
        posterior_by_session(jax.random.key(0), mdp, sensor, demonstration, [1], trajectories=0)
    impossible = Demonstration.from_steps([[(3, 0)]], mdp)
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0: impossible observation"):
        posterior_by_session(jax.random.key(0), mdp, sensor, impossible, [1])


def autoregressive(rho, chains, draws, size, seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(chains, draws, size))
    x = noise.copy()
    for t in range(1, draws):
        x[:, t] = rho * x[:, t - 1] + np.sqrt(1 - rho**2) * noise[:, t]
    return x


def test_a_summary_counts_what_correlated_draws_are_worth():
    rho, n = 0.6, 4 * 2000
    table = summary(draws_of(autoregressive(rho, 4, 2000, 2)))
    assert list(table.index) == ["weights[near]", "weights[far]"]
    np.testing.assert_allclose(table.ess_bulk, n * (1 - rho) / (1 + rho), rtol=0.3)
    assert (table.ess_tail < n).all()
    assert (table.r_hat < 1.01).all()
    assert table.divergences.isna().all()
    assert not np.isclose(table.r_hat * 1000 % 1, 0).any()  # not rounded
    assert all(kind.kind == "f" for kind in table.dtypes)


def test_a_summary_finds_chains_that_disagree_and_counts_divergences():
    draws = np.random.default_rng(0).normal(size=(4, 500, 2))
    draws[0, :, 1] += 3
    diverging = np.zeros((4, 500), bool)
    diverging[1, :7] = True
    table = summary(draws_of(draws, sample_stats={"diverging": diverging}))
    assert table.r_hat["weights[far]"] > 1.1 > 1.02 > table.r_hat["weights[near]"]
    assert (table.divergences == 7).all()


def test_a_summary_by_session_counts_each_sessions_divergences(by_session):
    marked = by_session.copy()
    diverging = np.zeros(marked.sample_stats.diverging.shape, bool)
    diverging[0, :3, 1] = True
    marked.sample_stats["diverging"] = (("chain", "draw", "session"), diverging)
    table = summary(marked)
    assert table.divergences["weights[2, f0]"] == 0
    assert (table.divergences[["weights[6, f0]", "weights[6, f1]"]] == 3).all()
    one = summary(by_session.sel(session=6))
    np.testing.assert_allclose(table["r_hat"].iloc[2:], one["r_hat"])


def test_what_is_no_posterior_is_refused(mdp):
    draws = np.zeros((2, 10, 2))
    with pytest.raises(InferenceDataError, match="expected an ArviZ InferenceData, got dict"):
        require_posterior({})
    with pytest.raises(InferenceDataError, match=r"no group 'posterior'.* it has prior"):
        summary(az.from_dict(prior={"weights": draws}))
    with pytest.raises(InferenceDataError, match="no variable 'weights'; it has mu"):
        summary(az.from_dict(posterior={"mu": draws}))
    with pytest.raises(InferenceDataError, match="chain, draw, feature, got chain, draw, weights_dim_0"):
        summary(az.from_dict(posterior={"weights": draws}))
    estimates = draws_of(draws).posterior.isel(chain=0).rename(draw="session")
    with pytest.raises(InferenceDataError, match="got session, feature"):
        summary(az.InferenceData(posterior=estimates))
    with pytest.raises(InferenceDataError, match="no draws: its weights have the sizes"):
        summary(draws_of(draws).isel(draw=slice(0)))
    with pytest.raises(InferenceDataError, match="must be finite"):
        summary(draws_of(np.full((2, 10, 2), np.nan)))
    with pytest.raises(InferenceDataError, match="about the features near, far, but the MDP has f0, f1"):
        require_posterior(draws_of(draws), mdp)
    numbered = az.from_dict(posterior={"weights": draws}, dims={"weights": ["feature"]})
    assert require_posterior(numbered, mdp).shape == (2, 10, 2)
