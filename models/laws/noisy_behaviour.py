"""The declared model of an expert perceived through unknown noise: weights and reliabilities together.

The dissertation estimates the sensor, then the reward, and has no posterior over either. Here both have
priors, demonstrations follow :class:`TrajectoryLaw`, and the truth behind every report is summed out, so that
what remains is a density over ``R^(K + J)`` that any NumPyro inference can take. What a sloppy expert and a
sloppy sensor both explain stays undecided in it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Int
from numpyro.handlers import scale as scaled

from ..observation.evidence import AnySensor, FeatureNoise, Sensor
from ..process.mdp import TabularMDP
from .occlusion import scaled_prior
from .trajectory import TrajectoryLaw


def reliabilities_prior(n_predicates: int, prior: dist.Distribution | None = None) -> dist.Distribution:
    """The prior on reliabilities as one distribution with event shape ``[J]``.

    ``None`` is ``Beta(4, 1)``: perception is right four times in five, and in fifteen cases of sixteen more
    often right than wrong. A distribution over a scalar stands for itself, independently for each predicate;
    one over ``J`` numbers is taken as it is. Raises ``ValueError`` for any other shape, and for a prior that
    admits numbers outside (0, 1).

    Under a prior that does not change when ``p`` becomes ``1 - p``, such as the uniform ``Beta(1, 1)``,
    reports that are mostly wrong, of an expert whose weights have the other sign, may explain as much as
    reports that are mostly right of the expert there is. This mirrored mode is far from the other, and
    samplers that walk seldom cross over: ask for such a prior only where perception may be worse than chance.
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


def noisy_behaviour_model(
    mdp: TabularMDP,
    predicates: Bool[Array, "J S A"] | Int[Array, "J S A"],
    codes: Int[Array, "n L 3"] | None = None,
    *,
    view: AnySensor | None = None,
    reportable: Bool[Array, "S A"] | None = None,
    n_trajectories: int | None = None,
    length: int | None = None,
    prior: dist.Distribution | None = None,
    reliability_prior: dist.Distribution | None = None,
    repeats: Int[Array, " n"] | None = None,
) -> Int[Array, "n L 3"]:
    r"""NumPyro model of demonstrations seen through :class:`FeatureNoise` of unknown reliabilities.

    .. math::
        \theta \sim \text{prior}, \qquad p \sim \text{reliability prior}, \qquad
        Y_i \mid \theta, p \sim \text{TrajectoryLaw}(\theta, \text{FeatureNoise}(p) \cdot \text{view})

    Parameters
    ----------
    mdp
    predicates : bool or int ``[J, S, A]``
        Labels such as the state's index included, as in ``FeatureNoise``.
    codes : int ``[n, L, 3]``, optional
        What was perceived, :attr:`Demonstration.codes` (scores are not part of the event). Without it the
        model simulates, as :func:`occlusion_model` does.
    view : Imperfection, optional
        What hides steps besides, :class:`Visibility`; nothing by default.
    reportable : bool ``[S, A]``, optional
        As in ``FeatureNoise``.
    n_trajectories, length : int, optional
        ``n`` and ``L``, needed only without ``codes``.
    prior, reliability_prior : Distribution, optional
        Of the scaled weights, see :func:`~i2rl.models.weights_prior`, and :func:`reliabilities_prior`.
    repeats : int ``[n]``, optional
        How many times each row of ``codes`` was perceived, if identical trajectories were gathered.

    Returns
    -------
    The site ``demonstration``; the others are ``weights [K]`` and ``reliabilities [J]``, the plate is
    ``trajectory``.

    Raises ``ValueError`` for predicates, views and priors that do not fit, and as ``TrajectoryLaw`` does.

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
    if codes is not None:
        n_trajectories, length = codes.shape[0], codes.shape[1]
    if n_trajectories is None or length is None:
        raise ValueError("without codes the model simulates, and needs n_trajectories and length")
    weights = numpyro.sample("weights", scaled_prior(mdp, prior))
    reliabilities = numpyro.sample(
        "reliabilities", reliabilities_prior(predicates.shape[0], reliability_prior)
    )
    sensor = FeatureNoise(predicates, reliabilities, reportable) * (Sensor() if view is None else view)
    law = TrajectoryLaw(mdp, weights, sensor, length)
    with numpyro.plate("trajectory", n_trajectories), scaled(scale=1.0 if repeats is None else repeats):
        return numpyro.sample("demonstration", law, obs=codes)
