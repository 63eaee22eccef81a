"""The joint posterior over reward weights and reliabilities of perception, as ArviZ ``InferenceData``.

NUTS moves in weights and logits of reliabilities, with the truth behind every observation summed out exactly.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from numpyro.infer import NUTS
from numpyro.infer.util import potential_energy

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import counted
from ...models.laws.noisy_behaviour import noisy_behaviour_model, reliabilities_prior
from ...models.laws.trajectory import TrajectoryLaw
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import (
    AnySensor,
    FeatureNoise,
    Sensor,
    checked_demonstration,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ...version import __version__
from ..sessions.progress import progress_line
from .chains import Mode, Sampling, SamplingOptions, Transitions, in_threads, mode_of, run_nuts
from .weights import described_prior, fingerprint, gather

# Nats: chains do not start at modes that hold less than e^-this of the best one.
_NEGLIGIBLE = float(np.log(100.0))


@shown_briefly
class NoisyProblem(NamedTuple):
    """Arguments of :func:`noisy_behaviour_model`, identical trajectories gathered."""

    mdp: TabularMDP
    predicates: Bool[Array, "J S A"] | Int[Array, "J S A"]
    reportable: Bool[Array, "S A"]
    visibility: Sensor
    codes: Int[Array, "u L 3"]
    repeats: Int[Array, " u"]
    prior: dist.Distribution
    reliability_prior: dist.Distribution


@shown_briefly
class NoisyChain(NamedTuple):
    """One chain of NUTS: ``weights [draws, K]``, ``reliabilities [draws, J]`` and its statistics."""

    weights: Float[Array, "draws K"]
    reliabilities: Float[Array, "draws J"]
    transitions: Transitions


def _apart(position: Float[Array, " D"], problem: NoisyProblem) -> dict[str, Array]:
    n_reliabilities = problem.predicates.shape[0]
    return {"weights": position[:-n_reliabilities], "reliabilities": position[-n_reliabilities:]}


def _constrained(position: Float[Array, " D"], problem: NoisyProblem) -> dict[str, Array]:
    supports = {"weights": problem.prior.support, "reliabilities": problem.reliability_prior.support}
    return {name: dist.biject_to(supports[name])(x) for name, x in _apart(position, problem).items()}


def noisy_potential(position: Float[Array, " D"], problem: NoisyProblem) -> Float[Array, ""]:
    """Return the negative log-density of the model at unconstrained weights, then reliabilities."""
    options = {
        "visibility": problem.visibility,
        "reportable": problem.reportable,
        "prior": problem.prior,
        "reliability_prior": problem.reliability_prior,
        "repeats": problem.repeats,
    }
    arguments = (problem.mdp, problem.predicates, problem.codes)
    return potential_energy(noisy_behaviour_model, arguments, options, _apart(position, problem))


_potential_and_gradient = jax.jit(jax.value_and_grad(noisy_potential))


def noisy_chain(
    key: Array,
    problem: NoisyProblem,
    start: Float[Array, " D"],
    inverse_mass: Float[Array, "D D"],
    *,
    warmup: int,
    draws: int,
    target_accept: float = 0.9,
    max_tree_depth: int = 10,
) -> NoisyChain:
    """Run one chain of NUTS; traceable, so that chains and replications can be mapped over.

    It starts at an unconstrained position with a dense ``inverse_mass``; both that matrix and the step size
    are adapted during ``warmup``.
    """
    kernel = NUTS(
        potential_fn=lambda z: noisy_potential(z, problem),
        dense_mass=True,
        inverse_mass_matrix=inverse_mass,
        step_size=0.5,
        target_accept_prob=target_accept,
        max_tree_depth=max_tree_depth,
    )
    drawn, transitions = run_nuts(key, kernel, start, lambda z: _constrained(z, problem), warmup, draws)
    return NoisyChain(**drawn, transitions=transitions)


_run_chain = jax.jit(noisy_chain, static_argnames=("warmup", "draws", "target_accept", "max_tree_depth"))


def noisy_mode(problem: NoisyProblem, origin: Float[np.ndarray, " D"] | None = None) -> Mode:
    """Climb from ``origin`` to a mode of the unconstrained density.

    The default origin has zero weights and reliabilities a little above one half. The mode is only a start:
    if expert noise and sensor noise explain the same data, there are others.
    """
    if origin is None:
        sizes = [
            dist.biject_to(prior.support).inverse_shape(prior.event_shape)[0]
            for prior in (problem.prior, problem.reliability_prior)
        ]
        origin = np.concatenate([np.zeros(sizes[0]), np.full(sizes[1], 1.0)])
    return mode_of(lambda x: _potential_and_gradient(x, problem), origin)


def noisy_starts(key: Array, problem: NoisyProblem, chains: int) -> list[Mode]:
    """Return starts of chains, each with its covariance; the same key gives the same starts.

    The first climbs from the default origin of :func:`noisy_mode`, the others from draws of the prior, so
    that modes far apart are found if there are any. A mode that by its height and curvature holds less than a
    hundredth of the best is replaced by the best, because a chain could not leave it, and draws of all chains
    count alike. Starts are dispersed around their modes twice as widely as the curvature suggests.
    """
    spread_key, *keys = jax.random.split(key, chains)
    modes = [noisy_mode(problem)]
    modes += [noisy_mode(problem, _drawn_from_prior(k, problem)) for k in keys]
    held = [
        np.linalg.slogdet(mode.covariance)[1] / 2 - float(_potential_and_gradient(mode.position, problem)[0])
        for mode in modes
    ]
    best = int(np.argmax(held))
    modes = [
        mode if mass > held[best] - _NEGLIGIBLE else modes[best]
        for mode, mass in zip(modes, held, strict=True)
    ]
    away = np.asarray(jax.random.normal(spread_key, (chains, len(modes[0].position))))
    return [
        Mode(mode.position + 2.0 * np.linalg.cholesky(mode.covariance) @ x, mode.covariance)
        for mode, x in zip(modes, away, strict=True)
    ]


def _drawn_from_prior(key: Array, problem: NoisyProblem) -> Float[np.ndarray, " D"]:
    priors = problem.prior, problem.reliability_prior
    drawn = [
        dist.biject_to(prior.support).inv(prior.sample(k))
        for k, prior in zip(jax.random.split(key), priors, strict=True)
    ]
    return np.concatenate(drawn)


@jax.jit
def noisy_log_likelihood(
    weights: Float[Array, "D K"], reliabilities: Float[Array, "D J"], problem: NoisyProblem
) -> Float[Array, "D u"]:
    """Return the log-likelihood of each distinct trajectory under every draw."""

    def one(draw: tuple) -> Float[Array, " u"]:
        sensor = FeatureNoise(problem.predicates, draw[1], problem.reportable) * problem.visibility
        return TrajectoryLaw(problem.mdp, draw[0], sensor, problem.codes.shape[1]).log_prob(problem.codes)

    # One draw at a time: linear solves do not batch, and evidence is [u, L, S, A] for each draw.
    return lax.map(one, (weights, reliabilities))


def noisy_problem(
    mdp: TabularMDP,
    predicates: ArrayLike,
    demonstration: Demonstration,
    *,
    visibility: AnySensor | None = None,
    reportable: ArrayLike | None = None,
    prior: dist.Distribution | None = None,
    reliability_prior: dist.Distribution | None = None,
) -> tuple[NoisyProblem, Int[np.ndarray, " n"]]:
    """Build the posterior's checked problem, and the row of each trajectory in it.

    Raises as :func:`sample_noisy_posterior` does.
    """
    demonstration = checked_demonstration(mdp, demonstration)
    if demonstration.n_trajectories == 0:
        raise ValueError("the demonstration has no trajectories; without data the posterior is the prior")
    require_discounted(mdp)
    psi = np.asarray(predicates)
    noise = FeatureNoise(
        psi, np.full(psi.shape[:1], 0.5), None if reportable is None else np.asarray(reportable)
    )
    seen = Sensor() if visibility is None else Sensor() * visibility
    # The reportable pairs do not depend on the reliabilities.
    require_possible(noise * seen, mdp, demonstration)
    gathered, rows = gather(mdp, seen, demonstration, prior)
    return (
        NoisyProblem(
            mdp,
            noise.predicates,
            noise.reportable,
            seen,
            gathered.codes,
            gathered.repeats,
            gathered.prior,
            reliabilities_prior(len(psi), reliability_prior),
        ),
        rows,
    )


class NoisySamplingOptions(SamplingOptions, total=False):
    """Options of the sampler, names of the predicates, and whether to print each step."""

    names: tuple[str, ...] | None
    progress: bool


def sample_noisy_posterior(
    key: Array,
    mdp: TabularMDP,
    predicates: ArrayLike,
    demonstration: Demonstration,
    *,
    visibility: AnySensor | None = None,
    reportable: ArrayLike | None = None,
    prior: dist.Distribution | None = None,
    reliability_prior: dist.Distribution | None = None,
    **sampling: Unpack[NoisySamplingOptions],
) -> az.InferenceData:
    """Draw from the joint posterior over weights and reliabilities of :func:`noisy_behaviour_model`.

    Chains start around modes found from different origins (:func:`noisy_starts`) and run in as many threads
    as there are processors. The same key gives the same draws. R-hat reveals chains that stay in separate
    modes; their draws then show the modes, but not their masses. A prior that does not favour perception
    better than chance leaves a mirrored mode, see
    :func:`~i2rl.models.laws.noisy_behaviour.reliabilities_prior`.

    Parameters
    ----------
    key : JAX random key
    mdp, predicates, demonstration, visibility, reliability_prior
        Arguments of the model. Scores are ignored.
    names : tuple of str, optional
        Names of the predicates; ``psi1``, ``psi2``, ... by default.
    draws, warmup, chains : int
        Draws returned and discarded by each chain, and number of chains; 500, 300 and 4 by default.
    target_accept, max_tree_depth
        As in NumPyro's ``NUTS``; 0.9 and 10 by default.
    progress : bool
        Print each step that begins on standard error.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``weights (chain, draw, feature)``, ``reliabilities (chain, draw, predicate)``.
        ``log_likelihood``: ``demonstration (chain, draw, trajectory)``.
        ``sample_stats``: ``lp``, ``energy``, ``acceptance_rate``, ``step_size``, ``n_steps``, ``diverging``.
        ``observed_data``: ``kind``, ``state``, ``action (trajectory, step)``.

    Raises
    ------
    DemonstrationError
        Naming trajectory and step, if an observation is impossible.
    ValueError
        For an empty demonstration, predicates, priors or names that do not fit, numbers of draws or chains
        below one, or an undiscounted MDP.

    See Also
    --------
    i2rl.models.noisy_behaviour_model : the model
    i2rl.inference.rimeo : learns in sessions

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_noisy_posterior
    >>> mdp, _, view, demonstration = five_cells()
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> data = sample_noisy_posterior(
    ...     jax.random.key(0), mdp, predicates, demonstration, visibility=view, draws=20, warmup=20, chains=1
    ... )
    >>> dict(data.posterior["reliabilities"].sizes)
    {'chain': 1, 'draw': 20, 'predicate': 2}
    """
    names, progress = sampling.pop("names", None), sampling.pop("progress", False)
    draws, warmup, chains, target_accept, max_tree_depth = Sampling().but(sampling).checked()
    problem, rows = noisy_problem(
        mdp,
        predicates,
        demonstration,
        visibility=visibility,
        reportable=reportable,
        prior=prior,
        reliability_prior=reliability_prior,
    )
    n_predicates = problem.predicates.shape[0]
    names = tuple(f"psi{j + 1}" for j in range(n_predicates)) if names is None else names
    if len(names) != n_predicates:
        raise ValueError(f"there is one name for each of {n_predicates} predicates, got {list(names)}")
    key = as_key(key)
    start_key, chain_key = jax.random.split(key)
    with progress_line(progress) as tell:
        tell("posterior: finding modes, compiling first")
        starts = noisy_starts(start_key, problem, chains)
        tell(f"posterior: {counted(chains, 'chain')} of {warmup} + {draws} draws, compiling first")
        run = partial(
            _run_chain, warmup=warmup, draws=draws, target_accept=target_accept, max_tree_depth=max_tree_depth
        )
        keys = jax.random.split(chain_key, chains)
        chain: NoisyChain = in_threads(
            run, [(k, problem, *start) for k, start in zip(keys, starts, strict=True)]
        )
    flat = (jnp.asarray(x.reshape(chains * draws, -1)) for x in (chain.weights, chain.reliabilities))
    log_likelihood = np.asarray(noisy_log_likelihood(*flat, problem))[:, rows].reshape(chains, draws, -1)
    steps = ["trajectory", "step"]
    attrs = {
        "inference_library": "numpyro",
        "inference_library_version": numpyro.__version__,
        "i2rl_version": __version__,
        "inference": "NUTS over weights and reliabilities, truths summed out",
        "mdp_fingerprint": mdp.fingerprint(),
        "predicates_fingerprint": fingerprint((problem.predicates, problem.reportable)),
        "sensor_fingerprint": fingerprint(problem.visibility),
        "prior": described_prior(problem.prior),
        "reliability_prior": described_prior(problem.reliability_prior),
        "key": str(np.asarray(jax.random.key_data(key)).tolist()),
    }
    return az.from_dict(
        posterior={"weights": chain.weights, "reliabilities": chain.reliabilities},
        sample_stats=chain.transitions._asdict(),
        log_likelihood={"demonstration": log_likelihood},
        observed_data={x: np.asarray(getattr(demonstration, x)) for x in ("kind", "state", "action")},
        coords={"predicate": list(names), "feature": np.arange(mdp.n_features)},
        dims={
            "weights": ["feature"],
            "reliabilities": ["predicate"],
            "demonstration": ["trajectory"],
            **dict.fromkeys(("kind", "state", "action"), steps),
        },
        attrs=attrs,
        posterior_attrs=attrs,
    )
