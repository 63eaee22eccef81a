from __future__ import annotations

import arviz as az
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from scipy import stats

from i2rl.analysis.posteriors.diagnostics import InferenceDataError
from i2rl.analysis.posteriors.predictive import predictive_check, predictive_visits
from i2rl.models import (
    Demonstration,
    ObservationModel,
    TrajectoryLaw,
    Visibility,
    reward_of,
    sample_demonstration,
    soft_plan,
)
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN
from i2rl.models.observation.evidence import Sensor

WEIGHTS = np.array([1.5, -2.0])
LENGTH = 5
DRAWS = 100


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(4)


@pytest.fixture(scope="module")
def sensor():
    rng = np.random.default_rng(0)
    confusion = 0.8 * np.eye(12) + 0.2 * rng.dirichlet(np.ones(12), 12)
    noise = ObservationModel.from_probabilities(confusion.reshape(4, 3, 4, 3))
    return Visibility(np.array([1.0, 0.7, 0.2, 0.0])) * noise


def draws_of(weights):
    return az.from_dict(posterior={"weights": weights}, dims={"weights": ["feature"]})


@pytest.fixture(scope="module")
def sure():
    """Make a posterior that is certain of the weights."""
    return draws_of(np.broadcast_to(WEIGHTS, (2, DRAWS, 2)))


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    """Simulate, with lost frames, unobserved states and shorter trajectories."""
    codes = np.array(
        sample_demonstration(jax.random.key(5), TrajectoryLaw(mdp, WEIGHTS, sensor, LENGTH), 12).codes
    )
    codes[0, 2:4] = [LOST, UNKNOWN, UNKNOWN]
    codes[1, 3:] = [PAD, UNKNOWN, UNKNOWN]
    codes[2, 1] = [SEEN, UNKNOWN, 1]
    codes[3, 0] = [HIDDEN, UNKNOWN, UNKNOWN]
    return Demonstration.from_codes(codes)


@pytest.fixture(scope="module")
def predicted(sure, mdp, sensor, demonstration):
    return predictive_visits(jax.random.key(0), sure, mdp, sensor, demonstration)


def mean_visits(mdp, moves, sensor, demonstration):
    """Step by step with the dense chain: where the expert is, whether it is seen there, what is read."""
    policy = np.asarray(soft_plan(mdp, reward_of(mdp, jnp.asarray(WEIGHTS))).policy)
    reading = np.exp(np.asarray(sensor.noise.log_probabilities)).sum(-1)
    chain = np.einsum("sa,sat->st", policy, moves)
    expected = np.zeros(mdp.n_states)
    for kinds, states in zip(demonstration.kind, demonstration.state, strict=True):
        place = np.asarray(mdp.initial)
        for kind, state in zip(kinds, states, strict=True):
            if kind not in (PAD, LOST) and not (kind == SEEN and state == UNKNOWN):
                for s, a in np.ndindex(*policy.shape):
                    expected += place[s] * policy[s, a] * float(sensor.visibility[s]) * reading[s, a]
            place = place @ chain
    return expected


def test_expected_visits_are_those_of_the_chain(predicted, mdp, sensor, demonstration, dense_transitions):
    expected = mean_visits(mdp, dense_transitions(mdp), sensor, demonstration)
    got = predicted.posterior_predictive.expected_visits
    assert got.dims == ("chain", "draw", "visited_state")
    np.testing.assert_allclose(got.isel(chain=1, draw=-1), expected, rtol=1e-9)


def test_simulated_visits_have_the_expected_mean(predicted):
    visits, expected = (
        predicted.posterior_predictive[name].values.reshape(2 * DRAWS, -1)
        for name in ("visits", "expected_visits")
    )
    error = visits.std(0) / np.sqrt(len(visits))
    np.testing.assert_array_less(np.abs(visits.mean(0) - expected[0]), 4.5 * error)
    assert len(np.unique(visits, axis=0)) > 20


def test_observed_visits_are_counted_by_state(predicted, demonstration, mdp):
    seen = [int(s) for s in demonstration.state.ravel() if s >= 0]
    visits = predicted.observed_data.visits
    assert [int(visits.sel(visited_state=name)) for name in mdp.state_names] == [
        seen.count(s) for s in range(4)
    ]


def test_p_values_of_the_true_model_are_uniform_and_of_another_are_smaller(sure, mdp, sensor):
    sample = jax.jit(lambda key, w: TrajectoryLaw(mdp, w, sensor, LENGTH).sample(key, (50, 12)))
    p_values = {}
    for name, weights in (("true", WEIGHTS), ("other", -6 * WEIGHTS)):
        seen = map(Demonstration.from_codes, np.asarray(sample(jax.random.key(7), weights)))
        p_values[name] = [
            float(predictive_check(checked).discrepancy_p_value)
            for checked in (
                predictive_visits(jax.random.key(i), sure, mdp, sensor, demonstration)
                for i, demonstration in enumerate(seen)
            )
        ]
    assert stats.kstest(p_values["true"], "uniform").pvalue > 1e-3
    assert stats.kstest(p_values["other"], "uniform", alternative="greater").pvalue < 1e-4


def test_a_check_orders_its_interval_and_counts_ties_half():
    visits = np.array([[[0, 3], [1, 3], [2, 3], [3, 3]]])
    idata = az.from_dict(
        posterior_predictive={"visits": visits, "expected_visits": visits + 0.5},
        observed_data={"visits": np.array([2, 5])},
        coords={"visited_state": ["home", "away"]},
        dims={"visits": ["visited_state"], "expected_visits": ["visited_state"]},
    )
    check = predictive_check(idata, coverage=0.5)
    np.testing.assert_allclose(check.p_value, [0.25 + 0.125, 0.0])
    np.testing.assert_allclose(check.low, np.quantile(visits[0], 0.25, axis=0))
    np.testing.assert_allclose(check.high, np.quantile(visits[0], 0.75, axis=0))
    np.testing.assert_array_equal(check.observed, [2, 5])
    assert check.discrepancy_p_value == 0.0  # the observed 5 is further from 3.5 than any prediction
    with pytest.raises(ValueError, match="coverage must lie between 0 and 1, got 1"):
        predictive_check(idata, coverage=1)


def test_a_posterior_keeps_its_groups_and_goes_into_a_file(sure, mdp, sensor, demonstration, tmp_path):
    data = {name: getattr(demonstration, name) for name in ("kind", "state", "action")}
    idata = sure.copy()
    idata.extend(az.from_dict(observed_data=data, dims={name: ["trajectory", "step"] for name in data}))
    checked = predictive_visits(jax.random.key(2), idata, mdp, sensor)
    assert set(idata.observed_data.data_vars) == set(data)  # the posterior given is left as it was
    assert set(checked.groups()) == {"posterior", "observed_data", "posterior_predictive"}
    assert int(checked.observed_data.visits.sum()) == (demonstration.state >= 0).sum()
    assert checked.observed_data.kind.equals(idata.observed_data.kind)
    again = predictive_visits(jax.random.key(2), checked, mdp, sensor, demonstration)
    assert again.posterior_predictive.equals(checked.posterior_predictive)
    path = str(tmp_path / "checked.nc")
    checked.to_netcdf(path, engine="h5netcdf")
    back = az.from_netcdf(path, engine="h5netcdf")
    for group in checked.groups():
        assert back[group].equals(checked[group]), group
    with mpl.rc_context({"backend": "agg"}):
        az.plot_ppc(checked, var_names=["visits"], num_pp_samples=10, random_seed=0)


def test_what_cannot_be_checked_is_refused(sure, mdp, sensor, demonstration):
    with pytest.raises(InferenceDataError, match=r"has no demonstration .* give it as an argument"):
        predictive_visits(jax.random.key(0), sure, mdp, sensor)
    with pytest.raises(ValueError, match="must have trajectories"):
        predictive_visits(jax.random.key(0), sure, mdp, sensor, demonstration.select([]))
    with pytest.raises(InferenceDataError, match="no visits in posterior_predictive"):
        predictive_check(sure)
    with pytest.raises(ValueError, match="view has shape"):
        predictive_visits(jax.random.key(0), sure, mdp, Sensor(jnp.ones(7)), demonstration)
