"""The declared model of an expert observed by a sensor (Bayesian chapter 4).

Weights have a prior, demonstrations follow :class:`TrajectoryLaw`, and hidden steps are summed out. The
result is a density over ``R^K`` for any NumPyro inference.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float, Int
from numpyro.distributions import constraints
from numpyro.distributions.transforms import AffineTransform, ComposeTransform, Transform
from numpyro.handlers import scale as scaled

from ..observation.evidence import AnySensor
from ..process.mdp import TabularMDP
from ..process.units import feature_scale
from .trajectory import TrajectoryLaw

# A scaled weight is a log-odds of at most that size, as in logistic regression with standardised inputs.
# There 2.5 is the customary weakly informative scale: it admits experts who err once in hundreds of choices,
# and excludes almost certain ones.
PRIOR_SCALE = 2.5


def weights_prior(n_features: int, prior: dist.Distribution | None = None) -> dist.Distribution:
    """Build the prior on scaled weights as one distribution with event shape ``[K]``.

    A scaled weight is the reward in nats that a feature adds at most (:mod:`~i2rl.models.process.units`).
    ``None`` is ``Normal(0, PRIOR_SCALE)`` for each feature. A distribution over a scalar applies
    independently to each feature (``Laplace(0, 1 / beta)`` has its mode at the L1 penalty of the relaxed
    maximum-entropy program); one over ``K`` numbers is returned as it is. Raises ``ValueError`` for any other
    shape.

    See Also
    --------
    i2rl.models.occlusion_model : a model with this prior

    Examples
    --------
    >>> import numpyro.distributions as dist
    >>> from i2rl.models import weights_prior
    >>> weights_prior(6).event_shape
    (6,)
    >>> weights_prior(6, dist.Laplace(0, 1)).event_shape  # one distribution for each feature
    (6,)
    """
    if prior is None:
        prior = dist.Normal(0.0, PRIOR_SCALE)
    shape = (*prior.batch_shape, *prior.event_shape)
    if shape == ():
        return prior.expand((n_features,)).to_event(1)
    if shape != (n_features,):
        raise ValueError(
            f"a prior on weights is over one number or over [{n_features}] numbers, one for each feature; "
            f"got batch shape {tuple(prior.batch_shape)} and event shape {tuple(prior.event_shape)}"
        )
    return prior.to_event(len(prior.batch_shape))


class _Scaled(constraints.Constraint[Any]):
    """Constraint on weights whose product with ``scale`` meets ``base``."""

    def __init__(self, base: constraints.Constraint, scale: Float[Array, " K"]) -> None:
        self.base, self.scale = base, scale

    @property
    def event_dim(self) -> int:
        return self.base.event_dim

    def __call__(self, x: Float[Array, "... K"]) -> Bool[Array, "..."]:
        return self.base(x * self.scale)

    def feasible_like(self, prototype: Float[Array, "... K"]) -> Float[Array, "... K"]:
        return self.base.feasible_like(prototype) / self.scale

    def tree_flatten(self) -> tuple:
        return (self.base, self.scale), (("base", "scale"), {})


@dist.biject_to.register(_Scaled)
def _to_scaled(constraint: _Scaled) -> Transform:
    # Samplers thereby move in scaled weights, whatever the units.
    unscale = AffineTransform(0.0, 1 / constraint.scale)
    return ComposeTransform([dist.biject_to(constraint.base), unscale])


class ScaledPrior(dist.Distribution):
    """The law of weights ``theta [K]`` whose scaled form ``theta * scale`` follows ``base``."""

    pytree_data_fields = ("base", "scale")
    reparametrized_params = ()

    def __init__(self, base: dist.Distribution, scale: Float[Array, " K"]) -> None:
        self.base, self.scale = base, jnp.asarray(scale)
        super().__init__((), base.event_shape)

    @property
    def support(self) -> constraints.Constraint:
        """Constraint: weights whose scaled form is in the base's support."""
        return _Scaled(self.base.support, self.scale)

    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Float[Array, "... K"]:
        """Draw weights."""
        return self.base.sample(key, sample_shape) / self.scale

    def log_prob(self, value: Float[Array, "... K"]) -> Float[Array, "..."]:
        """Return the log-density of weights."""
        return self.base.log_prob(value * self.scale) + jnp.sum(jnp.log(self.scale))


def scaled_prior(mdp: TabularMDP, prior: dist.Distribution | None = None) -> ScaledPrior:
    """Build the law of ``mdp``'s weights under a prior on scaled weights; see :func:`weights_prior`."""
    if isinstance(prior, ScaledPrior):
        return prior
    return ScaledPrior(weights_prior(mdp.n_features, prior), feature_scale(mdp))


def occlusion_model(
    mdp: TabularMDP,
    sensor: AnySensor,
    codes: Int[Array | np.ndarray, "n L 3"] | None = None,
    *,
    n_trajectories: int | None = None,
    length: int | None = None,
    prior: dist.Distribution | None = None,
    repeats: Int[Array | np.ndarray, " n"] | None = None,
) -> Int[Array, "n L 3"]:
    r"""Define the NumPyro model of demonstrations seen through ``sensor``.

    .. math:: \theta \sim \text{prior}, \qquad Y_i \mid \theta \sim \text{TrajectoryLaw}(\theta), \; i < n

    Parameters
    ----------
    mdp, sensor
        The decision process and its sensor.
    codes : int ``[n, L, 3]``, optional
        Observations, :attr:`Demonstration.codes` (scores are not part of the event). Without them the
        model simulates: ``Predictive(occlusion_model, num_samples=100)(key, mdp, sensor,
        n_trajectories=20, length=5)`` is the prior predictive.
    n_trajectories, length : int, optional
        ``n`` and ``L``, needed only without ``codes``.
    prior : Distribution, optional
        Prior of the scaled weights, see :func:`weights_prior`.
    repeats : int ``[n]``, optional
        Count of each row of ``codes``, if identical trajectories were gathered; they share one likelihood,
        so this is the same model at less cost.

    Returns
    -------
    The site ``demonstration``; the other site is ``weights [K]`` and the plate is ``trajectory``.

    See Also
    --------
    i2rl.inference.sample_posterior : NUTS for this model
    i2rl.models.weights_prior : the prior
    i2rl.models.TrajectoryLaw : the distribution of one trajectory

    Examples
    --------
    >>> import jax
    >>> from numpyro.infer import Predictive
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import occlusion_model
    >>> corridor, simulate = five_cells(), Predictive(occlusion_model, num_samples=10)
    >>> draws = simulate(jax.random.key(0), corridor.mdp, corridor.sensor, n_trajectories=8, length=6)
    >>> draws["weights"].shape, draws["demonstration"].shape
    ((10, 2), (10, 8, 6, 3))
    """
    if codes is not None:
        n_trajectories, length = codes.shape[0], codes.shape[1]
    if n_trajectories is None or length is None:
        raise ValueError("without codes the model simulates, and needs n_trajectories and length")
    weights = numpyro.sample("weights", scaled_prior(mdp, prior))
    law = TrajectoryLaw(mdp, weights, sensor, length)
    with numpyro.plate("trajectory", n_trajectories), scaled(scale=1.0 if repeats is None else repeats):
        return numpyro.sample("demonstration", law, obs=codes)
