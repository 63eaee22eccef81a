"""Checks of posteriors over weights: their variables, convergence and concentration.

Posteriors are those of :func:`~i2rl.inference.posteriors.weights.sample_posterior`: ``weights`` with the
dimensions ``chain``, ``draw`` and ``feature``; from :func:`posterior_by_session` also with a ``session``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pandas as pd
import xarray as xr
from jaxtyping import Array

from ...inference.posteriors.chains import Sampling, SamplingOptions
from ...inference.posteriors.weights import (
    Chain,
    Problem,
    chain_jobs,
    described_prior,
    fingerprint,
    gather,
    posterior_mode,
    run_chains,
)
from ...models.inputs.arguments import as_key
from ...models.observation.demonstration import PAD, UNKNOWN, Demonstration
from ...models.observation.evidence import AnySensor, checked_demonstration, require_possible
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from .history import provenance


class InferenceDataError(ValueError):
    """Error of an ``InferenceData`` that does not fit a diagnostic; states the given and the expected
    content.
    """


def require_posterior(
    idata: az.InferenceData,
    mdp: TabularMDP | None = None,
    sensor: AnySensor | None = None,
    *,
    extra: tuple[str, ...] = (),
) -> xr.DataArray:
    """Return the weights ``(chain, draw, ..., feature)``; raise unless they are a posterior of this model.

    ``extra`` names the dimensions that weights must have besides ``chain``, ``draw`` and ``feature``. An MDP
    or sensor is compared by the fingerprints that :func:`~i2rl.inference.posteriors.weights.sample_posterior`
    and :func:`posterior_by_session` leave; a posterior from elsewhere without them, by its features alone.

    Raises :class:`InferenceDataError` for anything that is no ``InferenceData``, has no group ``posterior``,
    no variable ``weights``, no chains or draws, other dimensions or values that are not finite, and for a
    posterior of another MDP or sensor.
    """
    if not isinstance(idata, az.InferenceData):
        raise InferenceDataError(f"expected an ArviZ InferenceData, got {type(idata).__name__}")
    if "posterior" not in idata.groups():
        raise InferenceDataError(
            f"the InferenceData has no group 'posterior', which sample_posterior makes; "
            f"it has {_listed(idata.groups())}"
        )
    posterior = idata["posterior"]
    if "weights" not in posterior:
        raise InferenceDataError(
            f"the posterior has no variable 'weights'; it has {_listed(posterior.data_vars)}"
        )
    weights = posterior["weights"]
    expected = ("chain", "draw", *extra, "feature")
    if weights.dims != expected:
        hint = "; choose a session with idata.sel(session=...)" if "session" in weights.dims else ""
        raise InferenceDataError(
            f"the posterior's weights must have the dimensions {_listed(expected)}, "
            f"got {_listed(weights.dims)}{hint}"
        )
    if 0 in weights.shape:
        raise InferenceDataError(
            f"the posterior has no draws: its weights have the sizes {dict(weights.sizes)}"
        )
    if not np.isfinite(weights.values).all():
        raise InferenceDataError("the posterior's weights must be finite, but some are not numbers")
    attrs = {**idata.attrs, **posterior.attrs}
    if mdp is not None:
        mine, theirs = mdp.fingerprint(), attrs.get("mdp_fingerprint", mdp.fingerprint())
        if mine != theirs:
            raise InferenceDataError(
                f"the posterior is about another MDP: its fingerprint is {theirs[:12]}, "
                f"that of the MDP given is {mine[:12]}"
            )
        names = weights["feature"].values
        # Features without names were numbered by ArviZ.
        unnamed = names.dtype.kind not in "UO" and len(names) == mdp.n_features
        if not unnamed and [str(name) for name in names] != list(mdp.feature_names):
            raise InferenceDataError(
                f"the posterior is about the features {_listed(names)}, "
                f"but the MDP has {_listed(mdp.feature_names)}"
            )
    if sensor is not None:
        mine = fingerprint(sensor)
        theirs = attrs.get("sensor_fingerprint", mine)
        if mine != theirs:
            raise InferenceDataError(
                f"the posterior was sampled through another sensor: {attrs.get('sensor', 'one')} with "
                f"fingerprint {theirs[:12]}, that of the {type(sensor).__name__} given is {mine[:12]}"
            )
    return weights


def _listed(names: Any) -> str:
    return ", ".join(str(name) for name in names) or "nothing"


def summary(idata: az.InferenceData, **options: Any) -> pd.DataFrame:
    """Compute ArviZ's summary of the weights, unrounded, and the number of divergent draws.

    A row for each weight (``weights[near]``, or ``weights[20, near]`` by session) with ``mean``, ``sd``, the
    highest-density interval, ``mcse_mean``, ``mcse_sd``, ``ess_bulk``, ``ess_tail``, ``r_hat`` (NaN for a
    single chain), and ``divergences``: of the chains that the weight was drawn by, NaN where the sampler left
    no statistics. ``options`` as for ``az.summary`` (``hdi_prob``, say). Raises :class:`InferenceDataError`
    for data that are no posterior.

    See Also
    --------
    i2rl.analysis.forest_plot : draw the weights
    i2rl.analysis.trace_plot : draw the chains
    i2rl.inference.sample_posterior : sample one

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import summary
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> posterior = sample_posterior(jax.random.key(0), mdp, *seen, draws=100, warmup=100, chains=2)
    >>> table = summary(posterior)
    >>> list(table.index), bool(table["mean"].iloc[0] > 0), bool((table["r_hat"] < 1.1).all())
    (['weights[at the end]', 'weights[moves]'], True, True)
    """
    weights = require_posterior(idata, extra=_by_session(idata))
    # Unrounded, ArviZ's columns are of type object.
    with np.errstate(invalid="ignore"):  # draws that are all the same have no R-hat
        table = az.summary(idata, var_names=["weights"], round_to="none", **options).astype(float)
    divergences = xr.DataArray(np.nan)
    if "sample_stats" in idata.groups() and "diverging" in idata["sample_stats"]:
        divergences = idata["sample_stats"]["diverging"].sum(("chain", "draw"))
    table["divergences"] = (
        divergences.broadcast_like(weights.isel(chain=0, draw=0, drop=True))
        .transpose(*weights.dims[2:])
        .values.ravel()
    )
    return table


def _by_session(idata: az.InferenceData) -> tuple[str, ...]:
    if not isinstance(idata, az.InferenceData) or "posterior" not in idata.groups():
        return ()
    return ("session",) if "session" in idata["posterior"].get("weights", xr.DataArray()).dims else ()


# -- a posterior for each session ---------------------------------------------------------------------


def posterior_by_session(
    key: Array,
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    at: Sequence[int],
    *,
    trajectories: int = 1,
    prior: dist.Distribution | None = None,
    **sampling: Unpack[SamplingOptions],
) -> az.InferenceData:
    """Sample posteriors over the weights after so many sessions, each from all data up to then.

    All sessions share one compiled sampler: trajectories that a session has not met yet are padding to it.
    A session's draws do not depend on which other sessions are asked for.

    Parameters
    ----------
    key : JAX random key
    mdp, sensor, demonstration, prior, draws, warmup, chains, target_accept, max_tree_depth
        As for :func:`~i2rl.inference.posteriors.weights.sample_posterior`.
    at : increasing sequence of int
        After which sessions, counted from 1.
    trajectories : int
        Trajectories a session, as for :meth:`~i2rl.models.observation.demonstration.Demonstration.sessions`.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``weights (chain, draw, session, feature)``; ``sample_stats``: the sampler's
        statistics ``(chain, draw, session)``. ``idata.sel(session=20)`` is one session's posterior.

    Raises
    ------
    DemonstrationError, ValueError
        As there, and ``ValueError`` for sessions that do not exist or do not increase.

    See Also
    --------
    i2rl.analysis.weights_by_session : draw it
    i2rl.inference.sample_posterior : the posterior of everything

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import posterior_by_session
    >>> from i2rl.domains import five_cells
    >>> mdp, _, *seen = five_cells()
    >>> short = dict(draws=100, warmup=100, chains=2)
    >>> narrowing = posterior_by_session(jax.random.key(0), mdp, *seen, [1, 4, 8], **short)
    >>> dict(narrowing["posterior"]["weights"].sizes)
    {'chain': 2, 'draw': 100, 'session': 3, 'feature': 2}
    """
    draws, warmup, chains, target_accept, max_tree_depth = settings = Sampling(**sampling).checked()
    if trajectories < 1:
        raise ValueError(f"trajectories must be at least 1, got {trajectories}")
    key, demonstration = as_key(key), checked_demonstration(mdp, demonstration)
    last = -(-demonstration.n_trajectories // trajectories)
    numbers = [int(number) for number in at]
    if not numbers or sorted(set(numbers)) != numbers or not 1 <= numbers[0] <= numbers[-1] <= last:
        raise ValueError(f"at must be increasing session numbers from 1 to {last}, got {list(at)}")
    require_discounted(mdp)
    problem, rows = gather(mdp, sensor, demonstration, prior)
    require_possible(sensor, mdp, demonstration)
    jobs: list[tuple] = []
    for number in numbers:
        part = _restricted(problem, rows[: number * trajectories])
        mode = posterior_mode(part)
        start_key, chain_key = jax.random.split(jax.random.fold_in(key, number))
        jobs += chain_jobs(start_key, chain_key, part, mode, settings)
    stacked: Chain = jax.tree.map(
        lambda x: np.moveaxis(x.reshape(len(numbers), chains, *x.shape[1:]), 0, 2),
        run_chains(jobs, settings),
    )
    configuration = {
        "draws": draws,
        "warmup": warmup,
        "chains": chains,
        "target_accept": target_accept,
        "max_tree_depth": max_tree_depth,
        "trajectories": trajectories,
        "key": np.asarray(jax.random.key_data(key)),
    }
    attrs = {
        **provenance(mdp, "NUTS over weights, hidden steps summed out", configuration),
        "inference_library": "numpyro",
        "inference_library_version": version("numpyro"),
        "sensor": type(sensor).__name__,
        "sensor_fingerprint": fingerprint(sensor),
        "prior": described_prior(problem.prior),
    }
    n_steps = stacked.transitions.n_steps
    statistics = {
        **stacked.transitions._asdict(),
        "tree_depth": np.floor(np.log2(np.maximum(n_steps, 1))).astype(int) + 1,
        "reached_max_treedepth": n_steps >= 2**max_tree_depth - 1,
    }
    return az.from_dict(
        posterior={"weights": stacked.weights},
        sample_stats=statistics,
        coords={"feature": list(mdp.feature_names), "session": numbers},
        dims={"weights": ["session", "feature"], **{name: ["session"] for name in statistics}},
        attrs=attrs,
        posterior_attrs=attrs,
    )


def _restricted(problem: Problem, rows: np.ndarray) -> Problem:
    """Restrict the problem to some trajectories, by their rows, in arrays of the same shape."""
    repeats = np.bincount(rows, minlength=len(problem.repeats))
    absent = (repeats == 0)[:, None, None]
    # A row of padding has probability one, whatever the weights.
    codes = jnp.where(absent, jnp.array([PAD, UNKNOWN, UNKNOWN], jnp.int32), problem.codes)
    return problem._replace(codes=codes, repeats=jnp.asarray(np.maximum(repeats, 1)))
