"""The declared model of an expert watched through an imperfect sensor (Bayesian reading of chapter 4).

Weights have a prior, demonstrations follow :class:`TrajectoryLaw`, and hidden steps are summed out, so what
remains is a density over ``R^K`` that any NumPyro inference can take.
"""

from __future__ import annotations

import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Int
from numpyro.handlers import scale as scaled

from .evidence import Imperfection
from .mdp import TabularMDP
from .trajectory import TrajectoryLaw

# A weight is a log-odds per unit of feature, as in logistic regression, and 2.5 is that model's customary
# weakly informative scale: it admits experts who err once in hundreds of choices, not infinitely sure ones.
PRIOR_SCALE = 2.5


def weights_prior(n_features: int, prior: dist.Distribution | None = None) -> dist.Distribution:
    """The prior on weights as one distribution with event shape ``[K]``.

    ``None`` is ``Normal(0, PRIOR_SCALE)`` for each feature; a distribution over a scalar stands for itself,
    independently for each feature (``Laplace(0, 1 / beta)`` is the prior whose mode meets the L1 penalty of
    the relaxed maximum-entropy program); one over ``K`` numbers is taken as it is. Raises ``ValueError`` for
    any other shape.
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


def occlusion_model(
    mdp: TabularMDP,
    sensor: Imperfection,
    codes: Int[Array, "n L 3"] | None = None,
    *,
    n_trajectories: int | None = None,
    length: int | None = None,
    prior: dist.Distribution | None = None,
    repeats: Int[Array, " n"] | None = None,
) -> Int[Array, "n L 3"]:
    r"""NumPyro model of demonstrations seen through ``sensor``.

    .. math:: \theta \sim \text{prior}, \qquad Y_i \mid \theta \sim \text{TrajectoryLaw}(\theta), \; i < n

    Parameters
    ----------
    mdp, sensor
        The decision process and how it is perceived.
    codes : int ``[n, L, 3]``, optional
        What was perceived, :attr:`Demonstration.codes` (scores are not part of the event). Without it the
        model simulates: ``Predictive(occlusion_model, num_samples=100)(key, mdp, sensor,
        n_trajectories=20, length=5)`` is the prior predictive.
    n_trajectories, length : int, optional
        ``n`` and ``L``, needed only without ``codes``.
    prior : Distribution, optional
        See :func:`weights_prior`.
    repeats : int ``[n]``, optional
        How many times each row of ``codes`` was perceived, if identical trajectories were gathered: they
        have one likelihood, so this is the same model at less cost.

    Returns
    -------
    The site ``demonstration``; the other site is ``weights [K]`` and the plate is ``trajectory``.
    """
    if codes is not None:
        n_trajectories, length = codes.shape[0], codes.shape[1]
    if n_trajectories is None or length is None:
        raise ValueError("without codes the model simulates, and needs n_trajectories and length")
    weights = numpyro.sample("weights", weights_prior(mdp.n_features, prior))
    law = TrajectoryLaw(mdp, weights, sensor, length)
    with numpyro.plate("trajectory", n_trajectories), scaled(scale=1.0 if repeats is None else repeats):
        return numpyro.sample("demonstration", law, obs=codes)
