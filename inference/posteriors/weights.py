"""The posterior over reward weights and hidden steps, as ArviZ ``InferenceData``.

NUTS moves in the weights alone, with the hidden steps summed out exactly; then backward sampling gives each
draw of the weights one joint completion of the demonstration. Together they are draws from
``P(theta, hidden steps | observations)``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import xarray as xr
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpyro.infer import NUTS
from numpyro.infer.util import potential_energy

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import counted
from ...models.laws.chain import filter_all, sample_backward
from ...models.laws.occlusion import ScaledPrior, occlusion_model, scaled_prior
from ...models.observation.demonstration import PAD, UNKNOWN, Demonstration
from ...models.observation.evidence import (
    AnySensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted, reward_of, soft_plan
from ...version import __version__
from ..completion.smoothing import Evidence, evidence_of, log_likelihoods
from ..sessions.progress import progress_line
from .chains import Mode, Sampling, SamplingOptions, Transitions, in_threads, mode_of, room_for, run_nuts


@shown_briefly
class Problem(NamedTuple):
    """Arguments of :func:`occlusion_model`, identical trajectories gathered."""

    mdp: TabularMDP
    sensor: AnySensor
    codes: Int[Array, "u L 3"]
    repeats: Int[Array, " u"]
    prior: dist.Distribution


@shown_briefly
class Chain(NamedTuple):
    """One chain of NUTS: ``weights [draws, K]`` and the sampler's statistics."""

    weights: Float[Array, "draws K"]
    transitions: Transitions

    @property
    def diverging(self) -> Bool[Array, " draws"]:
        """Marks of divergent transitions, ``[draws]``."""
        return self.transitions.diverging


def potential(position: Float[Array, " D"], problem: Problem) -> Float[Array, ""]:
    """Return the negative log-density of the declared model at unconstrained weights."""
    mdp, sensor, codes, repeats, prior = problem
    options = {"prior": prior, "repeats": repeats}
    return potential_energy(occlusion_model, (mdp, sensor, codes), options, {"weights": position})


def nuts_chain(
    key: Array,
    problem: Problem,
    start: Float[Array, " D"],
    inverse_mass: Float[Array, "D D"],
    *,
    warmup: int,
    draws: int,
    target_accept: float = 0.8,
    max_tree_depth: int = 10,
) -> Chain:
    """Run one chain of NUTS; traceable, so that chains and replications can be mapped over.

    It starts at unconstrained weights ``start`` with a dense ``inverse_mass``; both that matrix and the step
    size are adapted during ``warmup``.
    """
    kernel = _kernel(problem, inverse_mass, target_accept, max_tree_depth)
    return Chain(*run_nuts(key, kernel, start, dist.biject_to(problem.prior.support), warmup, draws))


def _kernel(
    problem: Problem, inverse_mass: Float[Array, "D D"], target_accept: Any, max_tree_depth: int
) -> NUTS:
    return NUTS(
        potential_fn=lambda z: potential(z, problem),
        dense_mass=True,
        inverse_mass_matrix=inverse_mass,
        step_size=0.5,
        target_accept_prob=target_accept,
        max_tree_depth=max_tree_depth,
    )


class _Lengths(NamedTuple):
    """Numbers for which a chain is compiled."""

    warmup: int
    room: int
    max_tree_depth: int


@partial(jax.jit, static_argnames="lengths")
def run_padded_chain(
    key: Array,
    problem: Problem,
    start: Float[Array, " D"],
    inverse_mass: Float[Array, "D D"],
    draws: Int[Array, ""],
    target_accept: Float[Array, ""],
    *,
    lengths: _Lengths,
) -> Chain:
    """Run :func:`nuts_chain` with room for ``lengths.room`` draws, of which the first ``draws`` are made."""
    warmup, room, max_tree_depth = lengths
    kernel = _kernel(problem, inverse_mass, target_accept, max_tree_depth)
    constrain = dist.biject_to(problem.prior.support)
    return Chain(*run_nuts(key, kernel, start, constrain, warmup, draws, room))


_potential_and_gradient = jax.jit(jax.value_and_grad(potential))


@shown_briefly
class Completions(NamedTuple):
    """One joint completion of each trajectory for each draw of the weights.

    ``states`` and ``actions`` ``[D, n, L]``, -1 beyond a trajectory's end.
    """

    states: Int[Array, "D n L"]
    actions: Int[Array, "D n L"]


def _evidence(problem: Problem) -> Evidence:
    kind, state, action = (problem.codes[..., i] for i in range(3))
    # Scores are not part of the declared model's event, so completions ignore them too.
    demonstration = Demonstration(kind, state, action, jnp.full(kind.shape, jnp.nan))  # type: ignore[arg-type]
    return evidence_of(problem.mdp, problem.sensor, demonstration)


@jax.jit
def complete(
    keys: Array, weights: Float[Array, "D K"], problem: Problem, rows: Int[Array, " n"]
) -> Completions:
    """Draw a completion of each of the problem's trajectories ``rows`` for every draw of the weights."""
    mdp, (log_evidence, live) = problem.mdp, _evidence(problem)

    def one(inputs: tuple) -> Completions:
        key, theta = inputs
        factors = log_evidence + soft_plan(mdp, reward_of(mdp, theta)).log_policy
        filtered = filter_all(mdp, factors, live)

        def sample(key: Array, row: Int[Array, ""]) -> tuple:
            passed = jax.tree.map(lambda x: x[row], filtered)
            return sample_backward(key, mdp, factors[row], passed, live[row])

        states, actions = jax.vmap(sample)(jax.random.split(key, rows.shape[0]), rows)
        return Completions(states.astype(jnp.int32), actions.astype(jnp.int32))

    # One draw at a time: a pass holds [n, L, S, A] factors, which draws should not multiply.
    return lax.map(one, (keys, weights))


@jax.jit
def pointwise_log_likelihood(weights: Float[Array, "D K"], problem: Problem) -> Float[Array, "D u"]:
    """Return the log-likelihood of each distinct trajectory under every draw of the weights."""
    evidence = _evidence(problem)

    def one(theta: Float[Array, " K"]) -> Float[Array, " u"]:
        log_policy = soft_plan(problem.mdp, reward_of(problem.mdp, theta)).log_policy
        return log_likelihoods(problem.mdp, log_policy, evidence)

    return lax.map(one, weights)


_split = jax.jit(jax.random.split, static_argnums=1)
# Draws that are looked at in one call: one program then serves every number of draws.
_BLOCK = 50
_FEWEST_ROWS = 32
# A draw of the weights takes next to no memory.
_FEWEST_DRAWS = 512


def _room_for_draws(draws: int) -> int:
    return max(_FEWEST_DRAWS, 1 << (draws - 1).bit_length())


@jax.jit
def _complete_block(
    keys: Array, start: Int[Array, ""], weights: Float[Array, "B K"], problem: Problem, rows: Int[Array, " n"]
) -> Completions:
    """:func:`complete` for a block of draws, whose keys begin at ``start``."""
    return complete(lax.dynamic_slice_in_dim(keys, start, len(weights)), weights, problem, rows)


def _in_blocks(function: Callable[[int, np.ndarray], Any], weights: Float[np.ndarray, "D K"]) -> Any:
    """Call ``function`` with the number of its first draw and ``_BLOCK`` draws, until all had their turn.

    The last block is filled up with copies of the last draw; results ``[D, ...]`` are joined without them.
    """
    blocks = []
    for start in range(0, len(weights), _BLOCK):
        block = weights[start : start + _BLOCK]
        filled = np.concatenate([block, np.repeat(block[-1:], _BLOCK - len(block), axis=0)])
        blocks.append(jax.tree.map(np.asarray, function(start, filled)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(weights)], *blocks)


def posterior_mode(problem: Problem) -> Mode:
    """Climb from the origin to the mode of the unconstrained density.

    With a flat prior it is the dissertation's estimate; here it is only a start.
    """

    size = dist.biject_to(problem.prior.support).inverse_shape(problem.prior.event_shape)
    return mode_of(lambda x: _potential_and_gradient(x, problem), np.zeros(size))


def gather(
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    prior: dist.Distribution | None = None,
) -> tuple[Problem, Int[np.ndarray, " n"]]:
    """Gather identical trajectories into the posterior's problem, and return the row of each.

    Most fragments of a rarely seen expert are wholly hidden, hence identical. Rows are padded to a multiple
    of eight, so that growing demonstrations have few shapes.
    """
    sensor = fitting_sensor(sensor, mdp)
    codes = np.asarray(checked_demonstration(mdp, demonstration).codes)
    distinct, rows, repeats = np.unique(
        codes.reshape(len(codes), -1), axis=0, return_inverse=True, return_counts=True
    )
    spare = -(-room_for(len(distinct)) // 8) * 8 - len(distinct)
    distinct = distinct.reshape(-1, *codes.shape[1:])
    # A row of padding has probability one, whatever the weights.
    distinct = np.concatenate([distinct, np.broadcast_to([PAD, UNKNOWN, UNKNOWN], (spare, *codes.shape[1:]))])
    repeats = np.concatenate([repeats, np.ones(spare, int)])
    prior = scaled_prior(mdp, prior)
    return Problem(mdp, sensor, jnp.asarray(distinct, jnp.int32), jnp.asarray(repeats), prior), rows.ravel()


def sample_posterior(
    key: Array,
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    *,
    prior: dist.Distribution | None = None,
    completions: bool = True,
    progress: bool = False,
    **sampling: Unpack[SamplingOptions],
) -> az.InferenceData:
    """Draw from the posterior over weights and hidden steps of :func:`occlusion_model`.

    Chains start around the mode, dispersed twice as widely as its curvature suggests, and run in as many
    threads as there are processors. The same key gives the same draws.

    Parameters
    ----------
    key : JAX random key
    mdp, sensor, demonstration
        The decision process, its sensor, and the observations. Scores are ignored.
    prior : numpyro.distributions.Distribution, optional
        Over ``K`` scaled weights (:mod:`~i2rl.models.process.units`), or over one and used for each;
        ``Normal(0, 2.5)`` by default, see :func:`~i2rl.models.weights_prior`. Larger weights always fit an
        expert without errors better: the prior alone limits them, and the weights' common length depends on
        it.
    completions : bool
        True to draw the hidden steps too.
    progress : bool
        Says on standard error what is being done: finding the mode, sampling, completing.
    draws, warmup, chains : int
        Draws returned and discarded by each chain, and number of chains; 500, 300 and 4 by default.
    target_accept, max_tree_depth
        As in NumPyro's ``NUTS``; 0.9 and 10 by default.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``weights (chain, draw, feature)``.
        ``completions``: ``state``, ``action (chain, draw, trajectory, step)``, integer indices, -1 beyond a
        trajectory's end; each draw of the hidden steps belongs to one posterior draw of the weights. They
        have their own group, so that ``az.summary``, ``az.rhat`` and ``az.plot_trace`` cover the weights
        alone. ``log_likelihood``: ``demonstration (chain, draw, trajectory)``, for ``az.loo`` and
        ``az.compare``. ``sample_stats``: ``lp``, ``energy``, ``acceptance_rate``, ``step_size``, ``n_steps``,
        ``tree_depth``, ``reached_max_treedepth``, ``diverging``. ``observed_data``: ``kind``, ``state``,
        ``action (trajectory, step)``. ``constant_data``: ``state_name``, ``action_name``, the names of the
        indices.

    Raises
    ------
    DemonstrationError
        Naming trajectory and step, if an observation is impossible under the MDP and the sensor.
    ValueError
        For an empty demonstration, a prior of another shape, numbers of draws or chains below one, or an
        undiscounted MDP.

    See Also
    --------
    i2rl.models.occlusion_model : the model
    i2rl.inference.batch_lme : the likeliest weights

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, sensor, demonstration = five_cells()
    >>> data = sample_posterior(jax.random.key(0), mdp, sensor, demonstration, draws=20, warmup=20, chains=1)
    >>> dict(data.posterior["weights"].sizes), data.completions["state"].shape
    ({'chain': 1, 'draw': 20, 'feature': 2}, (1, 20, 8, 6))
    """
    settings = Sampling(**sampling).checked()
    key, demonstration = as_key(key), checked_demonstration(mdp, demonstration)
    if demonstration.n_trajectories == 0:
        raise ValueError("the demonstration has no trajectories; without data the posterior is the prior")
    require_discounted(mdp)
    problem, rows = gather(mdp, sensor, demonstration, prior)
    require_possible(sensor, mdp, demonstration)
    with progress_line(progress) as tell:
        idata = _sampled(key, problem, rows, demonstration, settings, completions, tell)
    for attrs in (idata.attrs, idata["posterior"].attrs):
        attrs["key"] = str(np.asarray(jax.random.key_data(key)).tolist())
    return idata


def _sampled(
    key: Array,
    problem: Problem,
    rows: Int[np.ndarray, " n"],
    demonstration: Demonstration,
    sampling: Sampling,
    completions: bool,
    tell: Callable[[str], None],
) -> az.InferenceData:
    draws, warmup, chains, _, max_tree_depth = sampling
    tell("posterior: finding the mode, compiling first")
    mode = posterior_mode(problem)
    tell(f"posterior: {counted(chains, 'chain')} of {warmup} + {draws} draws, compiling first")
    start_key, chain_key, completion_key = jax.random.split(key, 3)
    chain = run_chains(chain_jobs(start_key, chain_key, problem, mode, sampling), sampling)
    tell("posterior: log-likelihoods of the draws")
    flat = np.asarray(chain.weights).reshape(chains * draws, -1)
    shape = (chains, draws, demonstration.n_trajectories)
    log_likelihood = _in_blocks(lambda _, w: pointwise_log_likelihood(w, problem), flat)[:, rows]
    completed = None
    if completions:
        tell("posterior: hidden steps")
        blocks = -(-len(flat) // _BLOCK)
        keys = _split(completion_key, room_for(blocks, least=1) * _BLOCK)
        padded = np.zeros(room_for(len(rows), _FEWEST_ROWS), rows.dtype)
        padded[: len(rows)] = rows
        drawn = _in_blocks(lambda start, w: _complete_block(keys, start, w, problem, padded), flat)
        completed = Completions(*(x[:, : len(rows)].reshape(*shape, -1) for x in drawn))
    log_likelihood = log_likelihood.reshape(shape)
    return _inference_data(problem, demonstration, chain, log_likelihood, completed, max_tree_depth)


def chain_jobs(
    start_key: Array, chain_key: Array, problem: Problem, mode: Mode, sampling: Sampling
) -> list[tuple]:
    """Return the arguments of each chain of a problem.

    Chains start twice as widely dispersed as the curvature at the mode suggests, as R-hat asks.
    """
    away = np.asarray(jax.random.normal(start_key, (sampling.chains, len(mode.position))))
    starts = mode.position + 2.0 * away @ np.linalg.cholesky(mode.covariance).T
    keys = jax.random.split(chain_key, sampling.chains)
    return [
        (k, problem, x, mode.covariance, sampling.draws, float(sampling.target_accept))
        for k, x in zip(keys, starts, strict=True)
    ]


def run_chains(jobs: Sequence[tuple], sampling: Sampling) -> Chain:
    """Run chains of :func:`chain_jobs` in threads, compiled once for draws within the same room."""
    lengths = _Lengths(sampling.warmup, _room_for_draws(sampling.draws), sampling.max_tree_depth)
    chains: Chain = in_threads(partial(run_padded_chain, lengths=lengths), jobs)
    return jax.tree.map(lambda x: x[:, : sampling.draws], chains)


def _inference_data(
    problem: Problem,
    demonstration: Demonstration,
    chain: Chain,
    log_likelihood: Float[np.ndarray, "C D n"],
    completions: Completions | None,
    max_tree_depth: int,
) -> az.InferenceData:
    mdp = problem.mdp
    n_steps = chain.transitions.n_steps
    names = {
        f"{kind}_name": (f"{kind}_index", np.asarray(labels))
        for kind, labels in (("state", mdp.labels.states), ("action", mdp.labels.actions))
        if labels is not None
    }
    attrs = {
        "inference_library": "numpyro",
        "inference_library_version": numpyro.__version__,
        "i2rl_version": __version__,
        "inference": "NUTS over weights, hidden steps summed out; backward sampling of completions",
        "mdp_fingerprint": mdp.fingerprint(),
        "sensor": type(problem.sensor).__name__,
        "sensor_fingerprint": fingerprint(problem.sensor),
        "prior": described_prior(problem.prior),
    }
    steps = ["trajectory", "step"]
    idata = az.from_dict(
        posterior={"weights": chain.weights},
        sample_stats={
            **chain.transitions._asdict(),
            "tree_depth": np.floor(np.log2(np.maximum(n_steps, 1))).astype(int) + 1,
            "reached_max_treedepth": n_steps >= 2**max_tree_depth - 1,
        },
        log_likelihood={"demonstration": log_likelihood},
        observed_data={x: np.asarray(getattr(demonstration, x)) for x in ("kind", "state", "action")},
        coords={"feature": list(mdp.feature_names)},
        dims={
            "weights": ["feature"],
            "demonstration": ["trajectory"],
            "kind": steps,
            "state": steps,
            "action": steps,
        },
        attrs=attrs,
        posterior_attrs=attrs,
    )
    groups = {}
    if completions is not None:
        grid = {dim: idata.log_likelihood[dim] for dim in ("chain", "draw", "trajectory")}
        grid["step"] = idata.observed_data["step"]
        groups["completions"] = xr.Dataset(
            {
                "state": (tuple(grid), np.asarray(completions.states)),
                "action": (tuple(grid), np.asarray(completions.actions)),
            },
            coords=grid,
            attrs=idata.posterior.attrs,
        )
    if names:
        groups["constant_data"] = xr.Dataset(names)
    if groups:
        idata.add_groups(groups)
    return idata


def fingerprint(tree: object) -> str:
    """Digest the arrays of a pytree, with their types and shapes."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def described_prior(prior: dist.Distribution) -> str:
    """Describe a distribution with its parameters, through the wrappers that only shape it."""
    if isinstance(prior, ScaledPrior):
        scale, base = np.asarray(prior.scale), described_prior(prior.base)
        return base if (scale == 1).all() else f"{base} on weights times {scale.tolist()}"
    while hasattr(prior, "base_dist") and type(prior) in (dist.Independent, dist.ExpandedDistribution):
        prior = prior.base_dist
    values = (f"{name}={np.asarray(getattr(prior, name)).tolist()}" for name in prior.arg_constraints)
    return f"{type(prior).__name__}({', '.join(values)})"
