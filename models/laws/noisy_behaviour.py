"""The declared model of an expert observed with unknown noise: weights and reliabilities together.

The dissertation estimates the sensor, then the reward, and has no posterior over either. Here both have
priors, demonstrations follow :class:`TrajectoryLaw`, and the truth behind every observation is summed out.
The result is a density over ``R^(K + J)`` for any NumPyro inference. The posterior stays wide where expert
noise and sensor noise explain the data equally well.
"""

from __future__ import annotations

from typing import NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Int
from numpyro.handlers import scale as scaled

from ..observation.evidence import AnySensor, FeatureNoise, Sensor
from ..process.mdp import TabularMDP
from .occlusion import scaled_prior
from .trajectory import TrajectoryLaw


def reliabilities_prior(n_predicates: int, prior: dist.Distribution | None = None) -> dist.Distribution:
    """Build the prior on reliabilities as one distribution with event shape ``[J]``.

    ``None`` is ``Beta(4, 1)``: perception is right four times in five on average, and more often right than
    wrong with probability 15/16. A distribution over a scalar applies independently to each predicate; one
    over ``J`` numbers is returned as it is. Raises ``ValueError`` for any other shape, and for a prior that
    admits numbers outside (0, 1).

    A prior that is symmetric in ``p`` and ``1 - p``, such as the uniform ``Beta(1, 1)``, may have a mirrored
    mode: mostly wrong observations of an expert whose weights have the opposite sign explain as much as
    mostly right observations of the true expert. The mirrored mode is far away, and local samplers seldom
    reach it. Use such a prior only if perception may be worse than chance.
    """
    if prior is None:
        prior = dist.Beta(4.0, 1.0)
    shape = (*prior.batch_shape, *prior.event_shape)
    if shape not in ((), (n_predicates,)):
        raise ValueError(
            f"a prior on reliabilities is over one number or over [{n_predicates}] numbers, one for each "
            f"predicate; got batch shape {tuple(prior.batch_shape)} and event shape "
            f"{tuple(prior.event_shape)}"
        )
    admits = jnp.any(prior.support(jnp.full(shape, 1.5)))
    if not isinstance(admits, jax.core.Tracer) and bool(admits):
        raise ValueError(
            f"reliabilities lie between 0 and 1, but the prior {type(prior).__name__} admits others"
        )
    if shape == ():
        return prior.expand((n_predicates,)).to_event(1)
    return prior.to_event(len(prior.batch_shape))


class NoisyPriors(NamedTuple):
    """Priors of the scaled weights and of the reliabilities."""

    prior: dist.Distribution | None = None
    reliability_prior: dist.Distribution | None = None


class NoisyPriorOptions(TypedDict, total=False):
    """:class:`NoisyPriors` as keyword arguments."""

    prior: dist.Distribution | None
    reliability_prior: dist.Distribution | None


def noisy_behaviour_model(
    mdp: TabularMDP,
    predicates: Bool[Array | np.ndarray, "J S A"] | Int[Array | np.ndarray, "J S A"],
    codes: Int[Array | np.ndarray, "n L 3"] | None = None,
    *,
    visibility: AnySensor | None = None,
    reportable: Bool[Array | np.ndarray, "S A"] | None = None,
    n_trajectories: int | None = None,
    length: int | None = None,
    repeats: Int[Array | np.ndarray, " n"] | None = None,
    **priors: Unpack[NoisyPriorOptions],
) -> Int[Array, "n L 3"]:
    r"""Define the NumPyro model of demonstrations under :class:`FeatureNoise` of unknown reliabilities.

    .. math::
        \theta \sim \text{prior}, \qquad p \sim \text{reliability prior}, \qquad
        Y_i \mid \theta, p \sim \text{TrajectoryLaw}(\theta, \text{FeatureNoise}(p) \cdot \text{view})

    Parameters
    ----------
    mdp
    predicates : bool or int ``[J, S, A]``
        Labels such as the state's index included, as in ``FeatureNoise``.
    codes : int ``[n, L, 3]``, optional
        Observations, :attr:`Demonstration.codes` (scores are not part of the event). Without them the model
        simulates, as :func:`occlusion_model` does.
    visibility : Sensor, optional
        A :class:`Visibility` that hides steps besides; none by default.
    reportable : bool ``[S, A]``, optional
        As in ``FeatureNoise``.
    n_trajectories, length : int, optional
        ``n`` and ``L``, needed only without ``codes``.
    repeats : int ``[n]``, optional
        Count of each row of ``codes``, if identical trajectories were gathered.
    prior, reliability_prior : Distribution, optional
        Priors of the scaled weights, see :func:`~i2rl.models.weights_prior`, and of
        :func:`reliabilities_prior`.

    Returns
    -------
    The site ``demonstration``; the others are ``weights [K]`` and ``reliabilities [J]``, the plate is
    ``trajectory``.

    Raises ``ValueError`` for predicates, visibilities and priors that do not fit, and as ``TrajectoryLaw``
    does.

    See Also
    --------
    i2rl.inference.sample_noisy_posterior : NUTS for this model
    i2rl.models.FeatureNoise : the sensor
    i2rl.models.observation_feature_model : the model of the reliabilities alone

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from numpyro.infer import Predictive
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import noisy_behaviour_model
    >>> simulate = Predictive(noisy_behaviour_model, num_samples=10)
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> draws = simulate(jax.random.key(0), five_cells().mdp, predicates, n_trajectories=8, length=6)
    >>> draws["reliabilities"].shape, draws["demonstration"].shape
    ((10, 2), (10, 8, 6, 3))
    """
    prior, reliability_prior = NoisyPriors(**priors)
    if codes is not None:
        n_trajectories, length = codes.shape[0], codes.shape[1]
    if n_trajectories is None or length is None:
        raise ValueError("without codes the model simulates, and needs n_trajectories and length")
    weights = numpyro.sample("weights", scaled_prior(mdp, prior))
    reliabilities = numpyro.sample(
        "reliabilities", reliabilities_prior(predicates.shape[0], reliability_prior)
    )
    sensor = FeatureNoise(predicates, reliabilities, reportable) * (
        Sensor() if visibility is None else visibility
    )
    law = TrajectoryLaw(mdp, weights, sensor, length)
    with numpyro.plate("trajectory", n_trajectories), scaled(scale=1.0 if repeats is None else repeats):
        return numpyro.sample("demonstration", law, obs=codes)
