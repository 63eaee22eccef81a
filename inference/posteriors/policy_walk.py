"""Bayesian IRL (Ramachandran and Amir 2007): the posterior over the weights of one Boltzmann expert.

PolicyWalk explores a grid of rewards by Metropolis-Hastings. With rewards linear in features the grid becomes
the box ``[-1, 1]^K``, and its steps a random walk reflected at the walls.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypedDict, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import lax
from jaxtyping import Array, Bool, Float

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import counted
from ...models.laws.occlusion import weights_prior
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from ...version import __version__
from ..learners.boltzmann import (
    BOX,
    ETA,
    boltzmann_log_likelihoods,
    random_weights,
    reflected,
    require_positive,
    visit_counts,
)
from ..sessions.progress import progress_line
from .weights import described_prior

# Target acceptance of the step: best for a random walk in several dimensions (Roberts et al. 1997).
_TARGET_ACCEPT = 0.3


@shown_briefly
class Walk(NamedTuple):
    """Draws of the chains; every field has leading dimensions ``[chains, draws]``.

    Fields
    ------
    weights : float ``[K]``
    log_likelihood : float ``[n]``
        Log-likelihood of each trajectory.
    lp : float
        Log-density, up to the evidence.
    acceptance_rate : float
        Probability of accepting the proposal.
    accepted : bool
    step_size : float
    """

    weights: Float[Array, "... K"]
    log_likelihood: Float[Array, "... n"]
    lp: Float[Array, "..."]
    acceptance_rate: Float[Array, "..."]
    accepted: Bool[Array, "..."]
    step_size: Float[Array, "..."]


class _Lengths(NamedTuple):
    """Numbers for which a walk is compiled."""

    chains: int
    warmup: int
    draws: int


@partial(jax.jit, static_argnames="lengths")
def _walk(
    key: Array,
    mdp: TabularMDP,
    counts: Float[Array, "n S A"],
    prior: dist.Distribution | None,
    rationality: Float[Array, ""],
    step: Float[Array, ""],
    lengths: _Lengths,
) -> Walk:
    chains, warmup, draws = lengths

    def evaluate(weights: Float[Array, " K"]) -> tuple:
        each = boltzmann_log_likelihoods(mdp, weights, counts, rationality)
        if prior is None:
            return each, jnp.sum(each)
        # Densities are evaluated inside their support only: outside, many return a number all the same.
        inside = jnp.all(prior.support(weights))
        return each, jnp.where(inside, jnp.sum(each) + prior.log_prob(weights), -jnp.inf)

    def move(point: Walk, key: Array) -> Walk:
        noise_key, accept_key = jax.random.split(key)
        # Reflection preserves the symmetry of the proposal, so it needs no correction.
        weights = reflected(
            point.weights + point.step_size * jax.random.normal(noise_key, mdp.features.shape[2:])
        )
        each, lp = evaluate(weights)
        rate = jnp.where(jnp.isfinite(lp), jnp.exp(jnp.minimum(lp - point.lp, 0.0)), 0.0)
        accepted = jax.random.uniform(accept_key) < rate
        there = Walk(weights, each, lp, rate, accepted, point.step_size)
        kept = point._replace(acceptance_rate=rate, accepted=accepted)
        return jax.tree.map(partial(jnp.where, accepted), there, kept)

    def tune(point: Walk, inputs: tuple) -> tuple:
        turn, key = inputs
        point = move(point, key)
        change = (point.acceptance_rate - _TARGET_ACCEPT) / jnp.sqrt(1.0 + turn)
        return point._replace(step_size=jnp.clip(point.step_size * jnp.exp(change), 1e-4, BOX)), None

    def advance(point: Walk, key: Array) -> tuple:
        point = move(point, key)
        return point, point

    def chain(key: Array) -> Walk:
        start_key, warmup_key, draw_key = jax.random.split(key, 3)
        if prior is None:
            weights = random_weights(start_key, mdp.n_features)
        else:
            weights = jnp.clip(prior.sample(start_key), -BOX, BOX)
        each, lp = evaluate(weights)
        first = Walk(weights, each, lp, jnp.zeros(()), jnp.array(False), step)
        turns = (jnp.arange(warmup), jax.random.split(warmup_key, warmup))
        tuned, _ = lax.scan(tune, first, turns)
        return lax.scan(advance, tuned, jax.random.split(draw_key, draws))[1]

    return lax.map(chain, jax.random.split(key, chains))


class Walking(NamedTuple):
    """Lengths and number of chains, and the initial width of their steps."""

    draws: int = 2000
    warmup: int = 1000
    chains: int = 4
    step: float = 0.1


class WalkingOptions(TypedDict, total=False):
    """:class:`Walking` as keyword arguments."""

    draws: int
    warmup: int
    chains: int
    step: float


def birl(
    key: Array,
    mdp: TabularMDP,
    demonstration: Demonstration,
    *,
    rationality: float = ETA,
    prior: dist.Distribution | None = None,
    progress: bool = False,
    **sampling: Unpack[WalkingOptions],
) -> az.InferenceData:
    """Draw from the posterior over weights of one Boltzmann expert.

    Scaled weights (:mod:`~i2rl.models.process.units`) lie in ``[-1, 1]^K``.

    Parameters
    ----------
    key : JAX random key
    mdp, demonstration
        The decision process; its demonstration, every step seen.
    rationality : float
        Inverse temperature of the expert, per unit of value.
    prior : numpyro.distributions.Distribution, optional
        Over ``K`` scaled weights, or over one and used for each; restricted to the box.
        Uniform on the box by default.
    draws, warmup, chains : int
        Draws returned and discarded by each chain, and number of chains, which start at draws of the prior;
        2000, 1000 and 4 by default.
    step : float
        Initial width of the random walk of scaled weights (0.1 by default); tuned during the warm-up and then
        fixed.
    progress : bool
        Print each step that begins on standard error.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``weights (chain, draw, feature)``.
        ``log_likelihood``: ``demonstration (chain, draw, trajectory)``, without transition probabilities.
        ``sample_stats``: ``lp``, ``acceptance_rate``, ``accepted``, ``step_size``.
        ``observed_data``: ``kind``, ``state``, ``action (trajectory, step)``.

    Raises
    ------
    DemonstrationError
        Naming trajectory and step, for a step that was hidden or that is impossible.
    ValueError
        For numbers that are not positive, a prior of another shape or that excludes the whole box, or an
        undiscounted MDP.

    See Also
    --------
    i2rl.inference.sample_posterior : the posterior with hidden steps
    i2rl.inference.mlirl : the likeliest weights

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import birl
    >>> from i2rl.models import Demonstration
    >>> walk = Demonstration.from_pairs([[0, 1, 2, 3, 4, 4]], [[1, 1, 1, 1, 2, 2]])
    >>> data = birl(jax.random.key(0), five_cells().mdp, walk, draws=20, warmup=20, chains=1)
    >>> dict(data.posterior["weights"].sizes)
    {'chain': 1, 'draw': 20, 'feature': 2}
    """
    draws, warmup, chains, step = Walking(**sampling)
    require_discounted(mdp)
    require_positive(rationality=rationality, draws=draws, chains=chains, step=step)
    if warmup < 0:
        raise ValueError(f"warmup must be at least 0, got {warmup}")
    counts = visit_counts(mdp, demonstration)
    prior = None if prior is None else weights_prior(mdp.n_features, prior)
    with progress_line(progress) as tell:
        tell(f"posterior: {counted(chains, 'chain')} of {warmup} + {draws} draws, compiling first")
        walk: Walk = jax.tree.map(
            np.asarray,
            _walk(
                as_key(key),
                with_scaled_features(mdp),
                jnp.asarray(counts),
                prior,
                jnp.asarray(float(rationality)),
                jnp.asarray(float(step)),
                _Lengths(chains, warmup, draws),
            ),
        )
    if prior is not None and not np.isfinite(walk.lp[:, -1]).all():
        raise ValueError(f"the prior {described_prior(prior)} gives no probability to weights in [-1, 1]")
    attrs = {
        "inference_library": "i2rl",
        "i2rl_version": __version__,
        "inference": "random-walk Metropolis-Hastings over scaled weights in [-1, 1], Boltzmann likelihood",
        "rationality": float(rationality),
        "mdp_fingerprint": mdp.fingerprint(),
        "prior": "Uniform(-1, 1)" if prior is None else f"{described_prior(prior)} on [-1, 1]",
        "key": str(np.asarray(jax.random.key_data(key)).tolist()),
    }
    steps = ["trajectory", "step"]
    return az.from_dict(
        posterior={"weights": walk.weights / np.asarray(feature_scale(mdp))},
        sample_stats={x: getattr(walk, x) for x in ("lp", "acceptance_rate", "accepted", "step_size")},
        log_likelihood={"demonstration": walk.log_likelihood},
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
