"""Posterior predictive checks of the visits that were seen."""

from __future__ import annotations

from typing import Any

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import lax
from jaxtyping import Array, Bool, Float

from ...models.observation.demonstration import LOST, PAD, SEEN, UNKNOWN, Demonstration
from ...models.observation.evidence import AnySensor, fitting_sensor, observe
from ...models.process.mdp import TabularMDP
from ...models.process.planning import finite_occupancy, reward_of, simulate, soft_plan
from .diagnostics import InferenceDataError, require_posterior


def predictive_visits(
    key: Array,
    idata: az.InferenceData,
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration | None = None,
) -> az.InferenceData:
    """Add the posterior's prediction of how often each state is seen.

    For every draw of the weights, as many trajectories of the same lengths are simulated from their soft
    policy and perceived through the same sensor; then steps seen (as read, where the sensor misreads) are
    counted by state, as in the demonstration. Steps whose frame was lost, or that were seen without a state,
    are left out of both. Simulates all draws: thin with ``idata.sel(draw=slice(None, None, 5))``.

    Parameters
    ----------
    key : JAX random key
    idata : arviz.InferenceData
        A posterior of :func:`~i2rl.inference.posteriors.weights.sample_posterior`.
    mdp, sensor
        Those of the posterior.
    demonstration : Demonstration, optional
        What to compare with; that of the group ``observed_data`` by default.

    Returns
    -------
    arviz.InferenceData
        A copy with ``posterior_predictive``: ``visits`` (simulated) and ``expected_visits`` (the exact mean
        given the draw), ``(chain, draw, visited_state)``; and ``observed_data``: ``visits
        (visited_state)``. For ``az.plot_ppc(..., var_names="visits")`` and :func:`predictive_check`.

    Raises
    ------
    InferenceDataError
        For data that are no posterior, or one of another MDP or sensor.
    ValueError
        For a demonstration without trajectories, or a sensor that does not fit the MDP.

    See Also
    --------
    i2rl.analysis.predictive_check : compare the two
    i2rl.inference.sample_posterior : the posterior

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import predictive_visits
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> predicted = predictive_visits(jax.random.key(1), posterior, mdp, seen[0])
    >>> dict(predicted["posterior_predictive"]["visits"].sizes)
    {'chain': 2, 'draw': 100, 'visited_state': 5}
    >>> predicted["observed_data"]["visits"].values[2:4].tolist()
    [0, 0]
    """
    weights = require_posterior(idata, mdp, sensor)
    sensor = fitting_sensor(sensor, mdp)
    demonstration = _observed(idata) if demonstration is None else demonstration
    kind, state = np.asarray(demonstration.kind), np.asarray(demonstration.state)
    if not len(kind):
        raise ValueError("the demonstration must have trajectories to compare with; got none")
    counted = (kind != PAD) & (kind != LOST) & ~((kind == SEEN) & (state == UNKNOWN))
    flat = jnp.asarray(weights.values.reshape(-1, mdp.n_features))
    keys = jax.random.split(key, len(flat))
    drawn = _replicate(keys, flat, mdp, sensor, jnp.asarray(counted))
    shape = (*weights.shape[:2], mdp.n_states)
    dims = ("chain", "draw", "visited_state")
    names = {"visited_state": list(mdp.state_names)}
    visits, expected = (np.asarray(x).reshape(shape) for x in drawn)
    predictive = xr.Dataset(
        {"visits": (dims, visits), "expected_visits": (dims, expected)},
        coords={dim: idata["posterior"][dim] for dim in dims[:2]} | names,
        attrs=idata["posterior"].attrs,
    )
    seen = np.bincount(state[counted & (kind == SEEN)], minlength=mdp.n_states)
    observed = xr.Dataset({"visits": ("visited_state", seen)}, coords=names)
    if "observed_data" in idata.groups():
        observed = idata["observed_data"].drop_vars("visits", errors="ignore").assign(observed.data_vars)
    kept: dict[str, Any] = {
        name: idata[name] for name in idata.groups() if name not in ("posterior_predictive", "observed_data")
    }
    return az.InferenceData(
        attrs=idata.attrs, **kept, posterior_predictive=predictive, observed_data=observed
    )


def _observed(idata: az.InferenceData) -> Demonstration:
    data = idata["observed_data"] if "observed_data" in idata.groups() else xr.Dataset()
    if not {"kind", "state", "action"} <= set(data.data_vars):
        raise InferenceDataError(
            f"the InferenceData has no demonstration (observed_data with kind, state and action, but it has "
            f"{', '.join(map(str, data.data_vars)) or 'nothing'}): give it as an argument"
        )
    return Demonstration.from_codes(np.stack([data[x].values for x in ("kind", "state", "action")], axis=-1))


@jax.jit
def _replicate(
    keys: Array,
    weights: Float[Array, "D K"],
    mdp: TabularMDP,
    sensor: AnySensor,
    counted: Bool[Array, "n L"],
) -> tuple[Float[Array, "D S"], Float[Array, "D S"]]:
    """Simulate the steps seen in each state, and compute their exact expectation, for every draw."""
    n, length = counted.shape

    def one(inputs: tuple) -> tuple:
        key, theta = inputs
        plan = soft_plan(mdp, reward_of(mdp, theta))

        def perceive(key: Array) -> Array:
            act, look = jax.random.split(key)
            return observe(look, sensor, *simulate(act, mdp, plan.log_policy, length))

        codes = jax.vmap(perceive)(jax.random.split(key, n))
        seen = counted & (codes[..., 0] == SEEN)
        # Out of range, and so dropped, at steps that are not counted.
        place = jnp.where(seen, codes[..., 1], mdp.n_states)
        visits = jnp.zeros(mdp.n_states, int).at[place].add(1, mode="drop")
        return visits, _expected_visits(mdp, plan.policy, sensor, jnp.sum(counted, 0))

    return lax.map(one, (keys, weights))


def _expected_visits(
    mdp: TabularMDP, policy: Float[Array, "S A"], sensor: AnySensor, steps: Array
) -> Float[Array, " S"]:
    """Compute the expected number of steps seen in each state; ``steps [L]`` counts the trajectories at each
    time.
    """
    pairs = finite_occupancy(mdp, jnp.broadcast_to(policy, (len(steps), *policy.shape)))
    total = jnp.einsum("t,tsa->sa", steps, pairs)
    if sensor.visibility is not None:
        total = total * sensor.visibility[:, None]
    if sensor.noise is None:
        return jnp.sum(total, axis=1)
    return jnp.einsum("sa,saop->o", total, jnp.exp(sensor.noise.log_probabilities))


def predictive_check(idata: az.InferenceData, coverage: float = 0.9) -> xr.Dataset:
    """Compare observed visits with their posterior predictive distribution, with Bayesian p-values.

    Returns
    -------
    xarray.Dataset
        By ``visited_state``: ``observed``, ``median``, ``low`` and ``high`` (the middle ``coverage`` of the
        predicted counts), and ``p_value = P(predicted > observed) + P(predicted = observed) / 2``: near 0
        (or 1) where more (or fewer) visits were seen than predicted.
        ``discrepancy_p_value``: ``P(T(predicted, theta) >= T(observed, theta))`` of the Freeman-Tukey
        discrepancy ``T(y, theta) = sum_s (sqrt(y_s) - sqrt(E[y_s | theta]))^2`` (Gelman, Meng and Stern
        1996): near 0 where the model misses the visits as a whole.

    Raises :class:`InferenceDataError` without the groups of :func:`predictive_visits`, and ``ValueError``
    for a coverage outside (0, 1).

    See Also
    --------
    i2rl.analysis.predictive_visits : predict the visits
    i2rl.analysis.compare_posteriors : compare models by prediction

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import predictive_check, predictive_visits
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> predicted = predictive_visits(jax.random.key(1), posterior, mdp, seen[0])
    >>> checked = predictive_check(predicted)
    >>> checked["observed"].values.tolist()
    [14, 13, 0, 0, 7]
    >>> bool(checked["discrepancy_p_value"] > 0.05)
    True
    """
    if not 0 < coverage < 1:
        raise ValueError(f"coverage must lie between 0 and 1, got {coverage}")
    for group in ("posterior_predictive", "observed_data"):
        if group not in idata.groups() or "visits" not in idata[group]:
            raise InferenceDataError(
                f"the InferenceData has no visits in {group}: add them with predictive_visits"
            )
    predictive, observed = idata["posterior_predictive"], idata["observed_data"]["visits"]
    draws, over = predictive["visits"], ("chain", "draw")
    low, median, high = (
        draws.quantile(q, over).drop_vars("quantile") for q in ((1 - coverage) / 2, 0.5, (1 + coverage) / 2)
    )

    def discrepancy(visits: xr.DataArray) -> xr.DataArray:
        return ((visits**0.5 - predictive["expected_visits"] ** 0.5) ** 2).sum("visited_state")

    return xr.Dataset(
        {
            "observed": observed,
            "median": median,
            "low": low,
            "high": high,
            "p_value": (draws > observed).mean(over) + 0.5 * (draws == observed).mean(over),
            "discrepancy_p_value": (discrepancy(draws) >= discrepancy(observed)).mean(),
        },
        attrs={"coverage": coverage},
    )
