"""Distances between observations, and between posteriors of behaviour, under an inexact observation model.

``p_j`` are the reliabilities of ``|Psi|`` predicates (Eq. 6.5), known within ``epsilon_o``. Distances are
total variations, by which the expectation of a value in [0, 1] can change.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...models.observation.evidence import AnySensor
from .checks import counted, positive


class Perception(NamedTuple):
    """Properties of perception that the bounds need.

    ``observations`` used to estimate the observation model (``n_o``), its error ``epsilon_o``, the number of
    ``predicates`` (``|Psi|``), and the ``longest`` trajectory's steps (``L``).
    """

    observations: float
    epsilon_o: float
    predicates: int
    longest: int


def observation_distance(
    perception: Perception, reliabilities: Float[np.ndarray, " J"] | None = None
) -> float:
    """Bound the distance between observations of one trajectory under true and estimated reliabilities.

    Total variation, at most ``1 - (1 - epsilon_o)^(L |Psi|) <= L |Psi| epsilon_o`` (a coupling of the
    observations lets each predicate of each step differ with probability ``epsilon_o``). With the estimated
    ``reliabilities [J]`` also at most ``sqrt(1 - rho^2)``, ``rho`` the Bhattacharyya coefficient, which grows
    with the root of ``L |Psi|`` only; the smaller is returned. Predicates are observed independently. Raises
    ``ValueError`` for an error that is not positive, or reliabilities that are not ``|Psi|`` probabilities.
    """
    coupled = _over_steps(_error(perception), perception.longest * perception.predicates)
    if reliabilities is None:
        return coupled
    p, ends = _intervals(perception, reliabilities)
    # Concave in the true reliability, so that an end of its interval is worst.
    overlap = (np.sqrt(p * ends) + np.sqrt((1 - p) * (1 - ends))).min(axis=0)
    rho = np.exp(perception.longest * np.log(np.minimum(overlap, 1)).sum())
    return float(min(coupled, np.sqrt(-np.expm1(2 * np.log(rho))) if rho > 0 else 1.0))


def posterior_distance(perception: Perception, reliabilities: Float[np.ndarray, " J"]) -> float:
    """Bound the distance between posteriors over trajectories under true and estimated reliabilities, surely.

    Total variation, at most ``tanh(L / 4 sum_j |logit p_j - logit p_hat_j|)``, for all observations, weights
    and estimates: likelihood ratios of two trajectories change by at most the exponential of ``L`` times that
    sum. One if a reliability may be 0 or 1. Errors as :func:`observation_distance`.
    """
    p, ends = _intervals(perception, reliabilities)
    if not ((ends > 0) & (ends < 1)).all():
        return 1.0
    change = np.abs(np.log(ends) - np.log1p(-ends) - np.log(p) + np.log1p(-p)).max(axis=0)
    return float(np.tanh(perception.longest * change.sum() / 4))


class ModelDistance(NamedTuple):
    """Distance of two observation models at one step.

    Fields
    ------
    variation : float
        Total variation between the observations of a truth, at the worst truth. ``1 - (1 - variation)^L``
        takes the place of :func:`observation_distance`.
    odds : float
        Largest change of the logarithm of a likelihood ratio of two truths, at the worst observation.
        ``tanh(L odds / 4)`` takes the place of :func:`posterior_distance`.
    """

    variation: float
    odds: float

    def over(self, steps: int) -> tuple[float, float]:
        """Bound the total variation of a trajectory's observations, and that of the posterior."""
        counted("steps", steps)
        return _over_steps(self.variation, steps), math.tanh(steps * self.odds / 4)


def model_distance(
    one: AnySensor, other: AnySensor, truths: Bool[np.ndarray, "S A"] | None = None
) -> ModelDistance:
    """Compare two observation models of any kind, at the ``truths`` that can occur (all by default).

    Raises ``ValueError`` for sensors without an observation model, or about different pairs.
    """
    if one.noise is None or other.noise is None:
        raise ValueError("both sensors must have observation models; a sensor without one observes exactly")
    tables = [np.asarray(x.noise.log_probabilities) for x in (one, other)]  # type: ignore[union-attr]
    if tables[0].shape != tables[1].shape:
        raise ValueError(f"the models are about pairs {tables[0].shape[:2]} and {tables[1].shape[:2]}")
    mask = np.ones(tables[0].shape[:2], bool) if truths is None else np.asarray(truths, bool)
    if mask.shape != tables[0].shape[:2] or not mask.any():
        raise ValueError(f"truths mark some of the pairs {tables[0].shape[:2]}, got shape {mask.shape}")
    log_p, log_q = (x.reshape(mask.size, mask.size)[mask.ravel()] for x in tables)
    variation = float(np.abs(np.exp(log_p) - np.exp(log_q)).sum(axis=1).max() / 2)
    possible = np.isfinite(log_p) | np.isfinite(log_q)
    with np.errstate(invalid="ignore"):
        ratio = log_p - log_q
    odds = np.where(possible, ratio, -np.inf).max(0) - np.where(possible, ratio, np.inf).min(0)
    return ModelDistance(min(1.0, variation), float(odds[possible.any(0)].max()))


def _over_steps(variation: float, steps: int) -> float:
    return -math.expm1(steps * math.log1p(-variation)) if variation < 1 else 1.0


# -- border -------------------------------------------------------------------------------------------


def _error(perception: Perception) -> float:
    counted("predicates", perception.predicates), counted("longest", perception.longest)
    return positive("epsilon_o", perception.epsilon_o)


def _intervals(
    perception: Perception, reliabilities: Float[np.ndarray, " J"]
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, "2 J"]]:
    """Return the estimates and the ends of their ranges of true reliabilities."""
    error, p = _error(perception), np.asarray(reliabilities, float)
    if p.shape != (perception.predicates,) or not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"reliabilities are {perception.predicates} probabilities, got {reliabilities}")
    return p, np.clip([p - error, p + error], 0, 1)
