"""The common problem of samplers of a mixture's posterior: its arguments, starts, and output."""

from __future__ import annotations

from typing import NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import xarray as xr
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Int
from numpyro.infer.util import potential_energy
from scipy import optimize

from ...models.inputs.display import shown_briefly
from ...models.laws.chain import smooth_all
from ...models.laws.mixture import (
    Perceived,
    component_log_likelihoods,
    concentration_prior,
    mixture_model,
    perceive,
    soft_policies,
    truncation_error,
)
from ...models.laws.occlusion import scaled_prior
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import (
    AnySensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
    safe_log,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ...version import __version__
from .chains import in_threads as in_threads
from .weights import described_prior, fingerprint

# Chains start with at most this many components: each costs a climb, and warmup empties superfluous ones.
_MOST_STARTING_WAYS = 6


@shown_briefly
class MixtureProblem(NamedTuple):
    """Arguments of :func:`mixture_model` with prepared trajectories; ``rows`` is each one's index among them.

    ``prior`` is over one component's weights ``[K]``; ``concentration`` is a number or its prior.
    """

    mdp: TabularMDP
    sensor: AnySensor
    perceived: Perceived
    rows: Int[Array, " n"]
    prior: dist.Distribution
    concentration: Float[Array, ""] | dist.Distribution


@shown_briefly
class Resolved(NamedTuple):
    """Assignment and densities of each draw of weights and proportions.

    Fields
    ------
    assignment : int ``[draws, n]``
        Component of each trajectory.
    log_likelihood : float ``[draws, n]``
        Log-likelihood of each trajectory, assignments and hidden steps summed out.
    log_joint : float ``[draws]``
        Log-density of the partition into components, of the weights of occupied ones, of the concentration if
        it is random, and of the observations; it does not depend on the components' names.
    """

    assignment: Int[Array, "draws n"]
    log_likelihood: Float[Array, "draws n"]
    log_joint: Float[Array, " draws"]


Position = dict[str, Array]


def potential(position: Position, problem: MixtureProblem) -> Float[Array, ""]:
    """Return the negative log-density of the declared model at unconstrained sites."""
    mdp, sensor, perceived, _, prior, concentration = problem
    options = {"components": len(position["weights"]), "concentration": concentration, "prior": prior}
    return potential_energy(mixture_model, (mdp, sensor, perceived), options, position)


_potential_and_gradient = jax.jit(jax.value_and_grad(potential))


def log_partition(counts: Int[Array, " T"], concentration: Float[Array, ""]) -> Float[Array, ""]:
    r"""Return the log of :math:`\alpha^k \prod_d (n_d - 1)! \, \Gamma(\alpha)/\Gamma(\alpha+n)`."""
    occupied = counts > 0
    tables = jnp.where(occupied, gammaln(jnp.where(occupied, counts, 1).astype(float)), 0.0)
    spread = jnp.sum(occupied) * jnp.log(concentration) + jnp.sum(tables)
    return spread + gammaln(concentration) - gammaln(concentration + jnp.sum(counts))


def resolve(
    keys: Array,
    weights: Float[Array, "draws T K"],
    proportions: Float[Array, "draws T"],
    concentration: Float[Array, " draws"],
    problem: MixtureProblem,
    assignment: Int[Array, "draws n"] | None = None,
) -> Resolved:
    """Assign every trajectory in each draw (or use the assignment given) and evaluate it; traceable."""
    rows = problem.rows

    def one(inputs: tuple) -> Resolved:
        key, weights, proportions, concentration, given = inputs
        policies = soft_policies(problem.mdp, weights)
        table = component_log_likelihoods(problem.mdp, policies, problem.perceived)[:, rows]
        joint = safe_log(proportions)[:, None] + table
        components = jax.random.categorical(key, joint, axis=0) if given is None else given
        counts = jnp.bincount(components, length=len(weights))
        prior = jnp.where(counts > 0, problem.prior.log_prob(weights), 0.0)
        log_joint = log_partition(counts, concentration) + jnp.sum(prior)
        if isinstance(problem.concentration, dist.Distribution):
            log_joint += problem.concentration.log_prob(concentration)
        log_joint += jnp.sum(table[components, jnp.arange(len(rows))])
        return Resolved(components.astype(jnp.int32), jax.nn.logsumexp(joint, axis=0), log_joint)

    return lax.map(one, (keys, weights, proportions, concentration, assignment))


resolve_jit = jax.jit(resolve)


@shown_briefly
class Start(NamedTuple):
    """Start of a chain: each trajectory's component (the first is largest), and unconstrained weights."""

    assignment: Int[np.ndarray, " n"]
    position: Float[np.ndarray, "c D"]


@jax.jit
def _mean_features(problem: MixtureProblem) -> Float[Array, "n K"]:
    """Return features of each trajectory, hidden steps averaged under the uniform policy."""
    mdp, (counts, _, log_evidence, live, _) = problem.mdp, problem.perceived
    if len(live):
        indifferent = jnp.where(
            mdp.available, -jnp.log(jnp.sum(mdp.available, axis=1, keepdims=True)), -jnp.inf
        )
        hidden = smooth_all(mdp, log_evidence + indifferent, live).pairs
        counts = jnp.concatenate([counts, hidden.sum(1)])
    steps = jnp.maximum(jnp.sum(counts, axis=(1, 2)), 1.0)
    return (jnp.einsum("usa,sak->uk", counts, mdp.features) / steps[:, None])[problem.rows]


def _k_means(
    rng: np.random.Generator, points: Float[np.ndarray, "n K"], components: int
) -> Int[np.ndarray, " n"]:
    """Run Lloyd's algorithm from random centres (k-means++); components may stay empty."""
    centres = points[rng.integers(len(points), size=1)]
    while len(centres) < components:
        distance = ((points[:, None] - centres) ** 2).sum(-1).min(1) + 1e-12
        centres = np.vstack([centres, points[rng.choice(len(points), p=distance / distance.sum())]])
    for _ in range(20):
        nearest = ((points[:, None] - centres) ** 2).sum(-1).argmin(1)
        centres = np.stack(
            [points[nearest == d].mean(0) if (nearest == d).any() else c for d, c in enumerate(centres)]
        )
    return nearest


def starts(key: Array, problem: MixtureProblem, chains: int, most: int) -> list[Start]:
    """Build a start per chain: k-means of feature counts, into several components, and their modes."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    points = np.asarray(_mean_features(problem))
    points = points / np.maximum(points.std(0), 1e-12)
    most = min(most, _MOST_STARTING_WAYS, len(points))
    # One component's density involves neither the concentration nor the number of trajectories.
    one_component = problem._replace(concentration=jnp.ones(()), rows=problem.rows[:0])
    rows, size = np.asarray(problem.rows), len(problem.perceived.repeats)

    def climb(members: Int[np.ndarray, " i"]) -> Float[np.ndarray, " D"]:
        repeats = jnp.asarray(np.bincount(rows[members], minlength=size))
        chosen = one_component._replace(perceived=problem.perceived._replace(repeats=repeats))

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = _potential_and_gradient({"weights": x[None]}, chosen)
            return float(value), np.asarray(slope["weights"])[0]

        shape = dist.biject_to(problem.prior.support).inverse_shape(problem.prior.event_shape)
        return optimize.minimize(
            objective, np.zeros(shape), jac=True, method="L-BFGS-B", options={"maxiter": 30}
        ).x

    found = []
    for _ in range(chains):
        nearest = _k_means(rng, points, int(rng.integers(min(2, most), most + 1)))
        names, assignment, counts = np.unique(nearest, return_inverse=True, return_counts=True)
        rank = np.argsort(np.argsort(-counts, kind="stable"))
        assignment = rank[assignment]
        modes = [climb(np.flatnonzero(assignment == d)) for d in range(len(names))]
        found.append(Start(assignment, np.stack(modes)))
    return found


def pose(
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    *,
    concentration: float | dist.Distribution,
    prior: dist.Distribution | None,
    at_least_one: dict[str, int],
    warmup: int,
) -> tuple[MixtureProblem, Demonstration, Int[np.ndarray, " n"]]:
    """Check and prepare the arguments; also return the rows with steps, and their indices.

    Errors as in :func:`~i2rl.inference.posteriors.mixture.sample_mixture_posterior`.
    """
    for name, number, least in (*((n, x, 1) for n, x in at_least_one.items()), ("warmup", warmup, 0)):
        if number < least:
            raise ValueError(f"{name} must be at least {least}, got {number}")
    sensor, demonstration = fitting_sensor(sensor, mdp), checked_demonstration(mdp, demonstration)
    present = np.flatnonzero(demonstration.lengths)
    if not len(present):
        raise ValueError("the demonstration has no trajectories; without data the posterior is the prior")
    require_discounted(mdp)
    require_possible(sensor, mdp, demonstration)
    demonstration = demonstration.select(present)
    perceived, rows = perceive(mdp, sensor, demonstration.codes)
    prior = scaled_prior(mdp, prior)
    alpha = concentration_prior(concentration)
    return MixtureProblem(mdp, sensor, perceived, jnp.asarray(rows), prior, alpha), demonstration, present


def mixture_data(
    key: Array,
    problem: MixtureProblem,
    demonstration: Demonstration,
    present: Int[np.ndarray, " n"],
    drawn: tuple[np.ndarray, ...],
    resolved: Resolved,
    stats: dict[str, np.ndarray],
    method: str,
) -> az.InferenceData:
    """Arrange draws ``(weights, proportions, concentration)`` of either sampler in one layout."""
    weights, proportions, concentration = drawn
    chains, draws, components, _ = weights.shape
    n = demonstration.n_trajectories
    posterior = {"weights": weights, "proportions": proportions}
    attrs = {
        "inference_library": "numpyro",
        "inference_library_version": numpyro.__version__,
        "i2rl_version": __version__,
        "inference": method,
        "key": str(np.asarray(jax.random.key_data(key)).tolist()),
        "mdp_fingerprint": problem.mdp.fingerprint(),
        "sensor": type(problem.sensor).__name__,
        "sensor_fingerprint": fingerprint(problem.sensor),
        "prior": described_prior(problem.prior),
        # The worst over draws if the concentration is random.
        "truncation_error": truncation_error(n, components, float(np.max(concentration))),
    }
    if isinstance(problem.concentration, dist.Distribution):
        posterior["concentration"] = concentration
        attrs["concentration"] = described_prior(problem.concentration)
    else:
        attrs["concentration"] = float(problem.concentration)
    steps = ["trajectory", "step"]
    idata = az.from_dict(
        posterior=posterior,
        sample_stats=stats,
        log_likelihood={"demonstration": np.asarray(resolved.log_likelihood).reshape(chains, draws, n)},
        observed_data={x: np.asarray(getattr(demonstration, x)) for x in ("kind", "state", "action")},
        coords={"feature": list(problem.mdp.feature_names), "trajectory": present},
        dims={
            "weights": ["component", "feature"],
            "proportions": ["component"],
            "demonstration": ["trajectory"],
            "kind": steps,
            "state": steps,
            "action": steps,
        },
        attrs=attrs,
        posterior_attrs=attrs,
    )
    assignment = np.asarray(resolved.assignment)
    shared = np.zeros((n, n))
    occupied = np.zeros(len(assignment), int)
    for d in range(components):
        here = (assignment == d).astype(float)
        shared += here.T @ here
        occupied += here.any(axis=1)
    grid = {dim: idata.log_likelihood[dim] for dim in ("chain", "draw", "trajectory")}
    group = xr.Dataset(
        {
            "assignment": (tuple(grid), assignment.reshape(chains, draws, n)),
            "n_components": (("chain", "draw"), occupied.reshape(chains, draws)),
            "log_joint": (("chain", "draw"), np.asarray(resolved.log_joint).reshape(chains, draws)),
            "n_ways_probability": (
                "components",
                np.bincount(occupied, minlength=n + 1)[1:] / len(assignment),
            ),
            "co_clustering": (("trajectory", "trajectory_"), shared / len(assignment)),
        },
        coords=grid | {"trajectory_": grid["trajectory"].values, "components": np.arange(1, n + 1)},
        attrs=attrs,
    )
    idata.add_groups({"assignments": group})
    return idata


def label_invariant(idata: az.InferenceData) -> xr.Dataset:
    """Return quantities of a mixture's posterior that do not depend on the components' names.

    For ``az.rhat``, ``az.ess``, ``az.summary`` and ``az.plot_trace``: ``n_components``, ``log_joint`` and
    ``log_likelihood (chain, draw)``, ``proportion (chain, draw, rank)`` from the largest down,
    ``trajectory_weights (chain, draw, trajectory, feature)``, the weights of each trajectory's component, and
    ``concentration`` if it is random. (R-hat of a constant quantity, such as ``n_components`` if it is
    certain, is NaN.)
    """
    posterior, group = idata["posterior"], idata["assignments"]
    descending = -np.sort(-posterior.proportions.values, axis=-1)
    invariant = xr.Dataset(
        {
            "n_components": group.n_components,
            "log_joint": group.log_joint,
            "log_likelihood": idata["log_likelihood"].demonstration.sum("trajectory"),
            "proportion": (("chain", "draw", "rank"), descending),
            "trajectory_weights": posterior.weights.isel(component=group.assignment).drop_vars("component"),
        }
    )
    if "concentration" in posterior:
        invariant["concentration"] = posterior.concentration
    return invariant
