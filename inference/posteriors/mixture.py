"""The posterior over a mixture of reward functions, as ArviZ ``InferenceData``.

NUTS moves in weights and proportions, with assignments and hidden steps summed out exactly; then each draw
gets one joint assignment of the trajectories. :mod:`~i2rl.inference.posteriors.gibbs` draws from the same
posterior.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float
from numpyro.distributions import constraints
from numpyro.infer import NUTS

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import counted
from ...models.laws.mixture import COMPONENTS, stick_proportions
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import AnySensor
from ...models.process.mdp import TabularMDP
from ..sessions.progress import progress_line
from .chains import Sampling, SamplingOptions, Transitions, in_threads, run_nuts
from .mixture_problem import (
    MixtureProblem,
    Position,
    Start,
    mixture_data,
    pose,
    potential,
    resolve_jit,
    starts,
)


@shown_briefly
class MixtureChain(NamedTuple):
    """One chain of NUTS.

    ``weights [draws, T, K]``, ``proportions [draws, T]``, ``concentration [draws]``, and the sampler's
    statistics.
    """

    weights: Float[Array, "draws T K"]
    proportions: Float[Array, "draws T"]
    concentration: Float[Array, " draws"]
    transitions: Transitions


def nuts_mixture_chain(
    key: Array,
    problem: MixtureProblem,
    start: Position,
    *,
    warmup: int,
    draws: int,
    target_accept: float = 0.9,
    max_tree_depth: int = 8,
) -> MixtureChain:
    """Run one chain of NUTS from unconstrained sites ``start``; traceable."""
    kernel = NUTS(
        potential_fn=lambda z: potential(z, problem),
        step_size=0.1,
        target_accept_prob=target_accept,
        max_tree_depth=max_tree_depth,
    )
    drawn, transitions = run_nuts(key, kernel, start, lambda z: constrained(z, problem), warmup, draws)
    return MixtureChain(*drawn, transitions)


def constrained(position: Position, problem: MixtureProblem) -> tuple[Array, Array, Array]:
    """Return weights, proportions and concentration at unconstrained sites."""
    weights = dist.biject_to(problem.prior.support)(position["weights"])
    proportions = jnp.ones(1)
    if "sticks" in position:
        proportions = stick_proportions(dist.biject_to(constraints.unit_interval)(position["sticks"]))
    concentration = problem.concentration
    if isinstance(concentration, dist.Distribution):
        concentration = dist.biject_to(concentration.support)(position["concentration"])
    return weights, proportions, concentration


_run_chain = jax.jit(
    nuts_mixture_chain, static_argnames=("warmup", "draws", "target_accept", "max_tree_depth")
)


def _start_position(key: Array, start: Start, problem: MixtureProblem, components: int) -> Position:
    """Return unconstrained sites at a start; components without trajectories are drawn from the prior."""
    alpha = problem.concentration
    position: Position = {}
    if isinstance(alpha, dist.Distribution):
        position["concentration"] = dist.biject_to(alpha.support).inv(jnp.ones(()))
        alpha = jnp.ones(())
    counts = np.bincount(start.assignment, minlength=components)
    after = counts[::-1].cumsum()[::-1] - counts
    sticks = (1.0 + counts) / (1.0 + counts + float(alpha) + after)
    if components > 1:
        position["sticks"] = dist.biject_to(constraints.unit_interval).inv(jnp.asarray(sticks[:-1]))
    spare = components - len(start.position)
    drawn = dist.biject_to(problem.prior.support).inv(problem.prior.sample(key, (spare,)))
    position["weights"] = jnp.concatenate([jnp.asarray(start.position), drawn])
    return position


_SAMPLING = Sampling(warmup=500, max_tree_depth=8)


def sample_mixture_posterior(
    key: Array,
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    *,
    components: int = COMPONENTS,
    concentration: float | dist.Distribution = 1.0,
    prior: dist.Distribution | None = None,
    progress: bool = False,
    **sampling: Unpack[SamplingOptions],
) -> az.InferenceData:
    """Draw from the posterior of :func:`mixture_model` by NUTS, then assignments given each draw.

    NUTS follows gradients and seldom moves between modes: a mode is a partition of the trajectories into
    components, times every naming of them. Each chain starts from another partition (k-means of feature
    counts into two to six components, each at its own posterior mode) and explores only its surroundings.
    R-hat of ``weights`` and ``proportions`` is therefore large whenever chains name the components
    differently, which is no fault, and small only by chance. Diagnose the quantities of
    :func:`label_invariant` instead. If *their* R-hat is large, chains are in different partitions and their
    draws must not be pooled; :func:`gibbs_mixture_posterior`, which moves trajectories one by one, is then
    the better sampler.

    Parameters
    ----------
    key : JAX random key
    mdp, sensor, demonstration
        The decision process, its sensor, and the observations. Scores are ignored.
    components : int
        ``T``, the truncation; the attribute ``truncation_error`` bounds its effect.
    concentration : float or Distribution
        ``alpha``, or its prior.
    prior : Distribution, optional
        Prior of each component's scaled weights (:mod:`~i2rl.models.process.units`), see
        :func:`~i2rl.models.weights_prior`.
    draws, warmup, chains : int
        Draws returned and discarded by each chain, and number of chains; 500, 500 and 4 by default.
    target_accept, max_tree_depth
        As in NumPyro's ``NUTS``; 0.9 and 8 by default.
    progress : bool
        Print each step that begins on standard error.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``weights (chain, draw, component, feature)``, ``proportions (chain, draw,
        component)``, and ``concentration (chain, draw)`` if it is random.
        ``assignments``: ``assignment (chain, draw, trajectory)``, the component of each trajectory in that
        draw; ``n_components (chain, draw)``, the number of occupied components, and its posterior
        ``n_ways_probability (components)``, 1 to the number of trajectories; ``log_joint (chain, draw)``, see
        :class:`Resolved`; ``co_clustering (trajectory, trajectory_)``, the posterior probability that two
        trajectories belong to one component.
        ``log_likelihood``: ``demonstration (chain, draw, trajectory)``, assignments summed out.
        ``sample_stats``: as in :func:`sample_posterior`.
        ``observed_data``: ``kind``, ``state``, ``action (trajectory, step)``.

    Raises
    ------
    DemonstrationError
        Naming trajectory and step, if an observation is impossible under the MDP and the sensor.
    ValueError
        For an empty demonstration, a prior of another shape, a concentration that is not positive, numbers of
        components, draws or chains below one, or an undiscounted MDP.

    See Also
    --------
    i2rl.models.mixture_model : the model
    i2rl.inference.gibbs_mixture_posterior : moves trajectories one at a time
    i2rl.inference.mme_mtirl : learns in sessions

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_mixture_posterior
    >>> mdp, _, sensor, demonstration = five_cells()
    >>> data = sample_mixture_posterior(
    ...     jax.random.key(0), mdp, sensor, demonstration, components=2, draws=20, warmup=20, chains=1
    ... )
    >>> dict(data.posterior["weights"].sizes), data.assignments["assignment"].shape
    ({'chain': 1, 'draw': 20, 'component': 2, 'feature': 2}, (1, 20, 8))
    """
    draws, warmup, chains, target_accept, max_tree_depth = _SAMPLING.but(sampling)
    key = as_key(key)
    problem, demonstration, present = pose(
        mdp,
        sensor,
        demonstration,
        concentration=concentration,
        prior=prior,
        at_least_one={"components": components, "draws": draws, "chains": chains},
        warmup=warmup,
    )
    start_key, fill_key, chain_key, assign_key = jax.random.split(key, 4)
    with progress_line(progress) as tell:
        tell("posterior: finding starts, compiling first")
        run = partial(
            _run_chain, warmup=warmup, draws=draws, target_accept=target_accept, max_tree_depth=max_tree_depth
        )
        begins = [
            _start_position(k, start, problem, components)
            for k, start in zip(
                jax.random.split(fill_key, chains),
                starts(start_key, problem, chains, components),
                strict=True,
            )
        ]
        tell(f"posterior: {counted(chains, 'chain')} of {warmup} + {draws} draws, compiling first")
        keys = jax.random.split(chain_key, chains)
        chain: MixtureChain = in_threads(run, [(k, problem, z) for k, z in zip(keys, begins, strict=True)])
        tell("posterior: assignments of the draws")
        flat = [jnp.asarray(x.reshape(chains * draws, *x.shape[2:])) for x in chain[:3]]
        resolved = resolve_jit(jax.random.split(assign_key, chains * draws), *flat, problem)
    n_steps = chain.transitions.n_steps
    depth = np.floor(np.log2(np.maximum(n_steps, 1))).astype(int) + 1
    stats = {
        **chain.transitions._asdict(),
        "tree_depth": depth,
        "reached_max_treedepth": n_steps >= 2**max_tree_depth - 1,
    }
    method = "NUTS over weights and proportions, assignments and hidden steps summed out; exact assignments"
    drawn = tuple(np.asarray(x) for x in chain[:3])
    return mixture_data(key, problem, demonstration, present, drawn, resolved, stats, method)
