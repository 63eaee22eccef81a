"""Histories of learners as ArviZ ``InferenceData``.

A learner's weights are point estimates, one a session, and no draws from anything, so they go into a group
``sessions`` of their own (as in a journal's export), and the learner's last estimates into a group
``learned``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import lax
from jaxtyping import Array, Float

from ...inference.sessions.learner import Learner, SessionInfo
from ...inference.sessions.running import Run
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, soft_plan
from ...version import __version__

_LIBRARIES = ("arviz", "jax", "numpy", "numpyro", "xarray")
_UNITS = {
    "log_likelihood": "nats per trajectory",
    "demonstration_log_likelihood": "nats",
    "seconds": "s",
    "weights": "nats per unit of feature",
}
_STATISTIC_DIMS = {"counts": ("state", "action"), "features": ("feature",), "start": ("state",), "size": ()}


def provenance(
    mdp: TabularMDP, method: str, configuration: Mapping[str, Any], seed: int | None = None
) -> dict[str, Any]:
    """Return the results' provenance as attributes, all of types that NetCDF holds.

    ``method``, ``configuration`` and ``library_versions`` (both JSON), ``i2rl_version``,
    ``mdp_fingerprint``, and ``seed`` where one is given.
    """
    attributes = {
        "method": method,
        "configuration": json.dumps(dict(configuration), sort_keys=True, default=_plain),
        "i2rl_version": __version__,
        "library_versions": json.dumps({name: version(name) for name in _LIBRARIES}),
        "mdp_fingerprint": mdp.fingerprint(),
    }
    return attributes if seed is None else {**attributes, "seed": int(seed)}


def _plain(value: object) -> object:
    array = isinstance(value, np.generic | np.ndarray | jax.Array)
    return np.asarray(value).tolist() if array else repr(value)


def run_history(
    learner: Learner,
    run: Run | Sequence[SessionInfo],
    *,
    statistic: Any = None,
    seed: int | None = None,
    true_weights: Float[np.ndarray, " K"] | None = None,
) -> az.InferenceData:
    """Convert a learner's sessions to ``InferenceData``.

    Parameters
    ----------
    learner : Learner
    run : Run or sequence of SessionInfo
        Result of :func:`~i2rl.inference.sessions.running.run_sessions`, or its infos alone.
    statistic : NamedTuple of arrays, optional
        The sufficient statistic at the end; by default that of the run's state.
    seed : int, optional
        Stored as an attribute.
    true_weights : float ``[K]``, optional
        The expert's weights, if known.

    Returns
    -------
    arviz.InferenceData
        ``sessions``: ``weights (session, feature)``; ``log_likelihood``, ``demonstration_log_likelihood``,
        ``gradient``, ``iterations``, ``solver_iterations`` and ``seconds (session)``, see
        :class:`~i2rl.inference.sessions.learner.SessionInfo`. Infos with further fields give further
        variables. ``learned``, the learner's last estimates: ``soft_policy (state, action)``, ``weights
        (feature)`` and the statistic's fields (``counts (state, action)`` or ``features (feature)`` and
        ``start (state)``, and ``size``). ``constant_data``, if the true weights are known: ``true_weights
        (feature)``. Attributes, of the whole and of every group: see :func:`provenance`, and the learner's
        ``signature``.

    Raises
    ------
    ValueError
        For no infos, for infos of a fleet, and for weights that do not fit the learner's MDP.

    See Also
    --------
    i2rl.analysis.fleet_history : the same of many streams
    i2rl.inference.run_sessions : run the sessions

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import run_history
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import lme_i2rl, run_sessions
    >>> mdp, weights, sensor, demonstration = five_cells()
    >>> learner = lme_i2rl(mdp, sensor)
    >>> run = run_sessions(learner, demonstration.sessions(4), key=jax.random.key(0))
    >>> history = run_history(learner, run, true_weights=weights)
    >>> history.groups(), dict(history["sessions"]["weights"].sizes)
    (['constant_data', 'sessions', 'learned'], {'session': 2, 'feature': 2})
    """
    infos, statistic = _infos(run), _statistic_of(run) if statistic is None else statistic
    if np.ndim(infos[0].session) > 0:
        raise ValueError("these are infos of a fleet, an array for each field: use fleet_history")
    return _history(learner, infos, (), statistic, seed, true_weights)


def fleet_history(
    learner: Learner,
    infos: Sequence[SessionInfo],
    *,
    state: Any = None,
    seed: int | None = None,
    true_weights: Float[np.ndarray, " K"] | None = None,
) -> az.InferenceData:
    """Convert the sessions of a fleet as :func:`run_history` does, with a leading dimension ``run``, one
    entry a stream.

    ``infos`` are those of consecutive updates of :func:`~i2rl.inference.sessions.fleets.fleet`, ``state`` is
    the fleet's last state. Raises ``ValueError`` as there, and for infos of a single learner.

    See Also
    --------
    i2rl.analysis.run_history : the same of one stream
    i2rl.inference.fleet : map a learner over streams

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import fleet_history
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import fleet, lme_i2rl
    >>> mdp, _, sensor, demonstration = five_cells()
    >>> learner = lme_i2rl(mdp, sensor)
    >>> streams = jax.tree.map(lambda x: x.reshape(2, 4, -1), demonstration)
    >>> many = fleet(learner)
    >>> state, info = many.update(many.init(jax.random.key(0), 2), streams)
    >>> dict(fleet_history(learner, [info], state=state)["sessions"]["weights"].sizes)
    {'run': 2, 'session': 1, 'feature': 2}
    """
    infos = _infos(infos)
    if np.ndim(infos[0].session) != 1:
        raise ValueError("these are infos of a single learner: use run_history")
    return _history(learner, infos, ("run",), getattr(state, "statistic", None), seed, true_weights)


def _infos(run: Run | Sequence[SessionInfo]) -> Sequence[SessionInfo]:
    # An info is itself a tuple of numbers.
    infos = run.infos if isinstance(run, Run) else run
    if not len(infos):
        raise ValueError("a history needs at least one session; got no infos")
    if not all(hasattr(info, "weights") for info in infos):
        kinds = sorted({type(info).__name__ for info in infos})
        raise ValueError(f"a history is made from a run or a list of infos; got {', '.join(kinds)}")
    return infos


def _statistic_of(run: Run | Sequence[SessionInfo]) -> Any:
    return getattr(run.state, "statistic", None) if isinstance(run, Run) else None


def _history(
    learner: Learner,
    infos: Sequence[SessionInfo],
    streams: tuple[str, ...],
    statistic: Any,
    seed: int | None,
    true_weights: Float[np.ndarray, " K"] | None,
) -> az.InferenceData:
    mdp = learner.mdp
    columns = {
        name: np.stack([np.asarray(getattr(info, name)) for info in infos], axis=len(streams))
        for name in infos[0]._fields
    }
    weights, n = columns["weights"], len(streams) + 1
    if weights.shape[n:] != (mdp.n_features,):
        raise ValueError(
            f"weights of a session of {learner.name} must have shape {(mdp.n_features,)}, "
            f"one for each feature, got {weights.shape[n:]}"
        )
    numbers = columns.pop("session").reshape(-1, len(infos))[0]
    coords: dict[str, Any] = {
        "session": numbers,
        "feature": list(mdp.feature_names),
        "state": list(mdp.state_names),
        "action": list(mdp.action_names),
    }
    if streams:
        coords["run"] = np.arange(len(weights))
    attrs = {**provenance(mdp, learner.name, learner.configuration, seed), "signature": learner.signature}

    def group(variables: Mapping[str, tuple[tuple[str, ...], np.ndarray]]) -> xr.Dataset:
        used = {dim for dims, _ in variables.values() for dim in dims}
        kept = {name: values for name, values in coords.items() if name in used}
        made = xr.Dataset(dict(variables), coords=kept, attrs=attrs)
        for name in set(_UNITS) & set(made.data_vars):
            made[name].attrs["units"] = _UNITS[name]
        return made

    sessions = {
        name: ((*streams, "session", *_trailing(name, array.ndim - n, {"weights": ("feature",)})), array)
        for name, array in columns.items()
    }
    last = weights[..., -1, :]
    policy = _soft_policies(mdp, jnp.asarray(last.reshape(-1, mdp.n_features)))
    learned = {
        "weights": ((*streams, "feature"), last),
        "soft_policy": (
            (*streams, "state", "action"),
            np.asarray(policy).reshape(*last.shape[:-1], *policy.shape[1:]),
        ),
    }
    # A method without a statistic, such as DARKO, carries on an empty tuple.
    for name, value in (statistic._asdict() if statistic else {}).items():
        array = np.asarray(value)
        learned[name] = ((*streams, *_trailing(name, array.ndim - len(streams), _STATISTIC_DIMS)), array)
    groups: dict[str, Any] = {"sessions": group(sessions), "learned": group(learned)}
    if true_weights is not None:
        truth = np.asarray(true_weights, float)
        if truth.shape != (mdp.n_features,):
            raise ValueError(f"true_weights must have shape {(mdp.n_features,)}, got {truth.shape}")
        groups["constant_data"] = group({"true_weights": (("feature",), truth)})
    return az.InferenceData(attrs=attrs, **groups)


def _trailing(name: str, count: int, known: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Name a variable's own dimensions, by ArviZ's defaults for unknown fields."""
    dims = known.get(name, ())
    return dims if len(dims) == count else tuple(f"{name}_dim_{i}" for i in range(count))


@jax.jit
def _soft_policies(mdp: TabularMDP, weights: Float[Array, "n K"]) -> Float[Array, "n S A"]:
    return lax.map(lambda w: soft_plan(mdp, reward_of(mdp, w)).policy, weights)
