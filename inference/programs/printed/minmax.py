"""The assignment gradient of MME-MTIRL as printed, to show that it cannot assign trajectories.

Section 5.1.2 ascends the Lagrangian (5.6) in the assignments ``v_{d,i}`` by::

    (sum_X P(X | d) + 1 + |X| / v_{d,i} (1 - log Z)) / sum_i v_{d,i},   P(X | d) = exp(pi_d theta_d.f_X) / Z

which does not depend on trajectory ``i``. The derivative of (5.6), with the laws at their optimum (D.5), is
instead, for a demonstrated trajectory::

    (1 + log pi_d + eta S_d + theta_d.G_d - theta_d.f_i) / |X| + lambda_i

where ``S_d = sum_X v Pr`` and ``G_d = sum_X v Pr f``; terms with ``Pr_d(X_i)`` cancel by (D.5). Appendix D
makes three errors:

- ``lambda_i``, one number per trajectory, is solved for from component ``d``'s own equation
  ``dL/dv_{d,i} = 0`` (D.15), as if each component had its own, and substituted (D.16). Its part
  ``theta_d.f_i / |X|`` then cancels ``-theta_d.f_i / |X|``, which (D.17) still has and (D.18), its
  derivative, lacks. (Substituted throughout, it would make that derivative zero.)
- ``d log Omega / dv`` is ``sum_X exp(u_X) (1 + u_X) / (|X| Omega)`` with ``u_X = pi_d theta_d.f_X``; (D.11)
  drops ``u_X`` as of higher order than 1. It is of the same order.
- ``eta`` is one number, but (D.6) has one for each component.

The corrected gradient does depend on the trajectory, with an unexpected sign: of two trajectories, a
component is offered more of the one that its reward explains *less*. The reason is that (5.6) is maximised
over assignments as it is over laws, and assignments whose laws have much entropy separate trajectories badly.
The sound form (:mod:`~i2rl.inference.programs.minmax`) therefore maximises the likelihood over both weights
and assignments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq, minimize
from scipy.special import logsumexp, softmax

from ....models.inputs.display import shown_briefly

# The released code adds it to every denominator.
_OFFSET = 1e-3
_LEAST_ASSIGNMENT = 1e-6


@shown_briefly
class TrajectorySpace(NamedTuple):
    """Possible trajectories, the demonstrated ones first.

    Fields
    ------
    features : float ``[M, K]``
        ``f_X = sum_t phi(s_t, a_t)`` of each.
    demonstrated : int
        ``|X| = n``: number of demonstrated trajectories, from the first on.
    """

    features: Float[np.ndarray, "M K"]
    demonstrated: int


AssignmentGradient = Callable[
    [TrajectorySpace, Float[np.ndarray, "n D"], Float[np.ndarray, "D K"]], Float[np.ndarray, "n D"]
]


def printed_assignment_gradient(
    space: TrajectorySpace, assignments: Float[np.ndarray, "n D"], weights: Float[np.ndarray, "D K"]
) -> Float[np.ndarray, "n D"]:
    """Return the gradient of section 5.1.2 (and D.18), the same for all trajectories with one assignment."""
    law_sums, log_omega = _law_sums(space, assignments, weights)
    n = len(assignments)
    return (law_sums + 1 + n / assignments * (1 - log_omega)) / assignments.sum(0)


def coded_assignment_gradient(
    space: TrajectorySpace, assignments: Float[np.ndarray, "n D"], weights: Float[np.ndarray, "D K"]
) -> Float[np.ndarray, "n D"]:
    """Return the released code's step: the printed one with a minus before its third term, and an offset."""
    law_sums, log_omega = _law_sums(space, assignments, weights)
    n, mass = len(assignments), assignments.sum(0) + _OFFSET
    return (law_sums + 1) / mass - n / ((assignments + _OFFSET) * mass) * (1 - log_omega)


def _law_sums(
    space: TrajectorySpace, assignments: np.ndarray, weights: np.ndarray
) -> tuple[Float[np.ndarray, " D"], float]:
    """Return ``sum_X P(X | d)`` over all trajectories of the space, and ``log Omega``."""
    proportions = assignments.mean(0)
    log_sums = logsumexp(space.features @ (proportions[:, None] * weights).T, axis=0)
    log_omega = float(logsumexp(log_sums, b=proportions))
    return np.exp(log_sums - log_omega), log_omega


# -- the Lagrangian -------------------------------------------------------------------------------------


def lagrangian(
    space: TrajectorySpace,
    assignments: Float[np.ndarray, "M D"],
    laws: Float[np.ndarray, "M D"],
    normaliser: float,
    weights: Float[np.ndarray, "D K"],
    row_multipliers: Float[np.ndarray, " n"],
) -> float:
    """Evaluate (5.6); assignments and laws ``Pr_d(X)`` cover the whole space, ``normaliser`` is ``eta``."""
    n = space.demonstrated
    shown = assignments[:n]
    proportions, joint = shown.mean(0), assignments * laws
    expected = proportions[:, None] * (joint.T @ space.features)
    return float(
        -(joint * np.log(joint)).sum()
        + (proportions * np.log(proportions)).sum()
        + normaliser * ((proportions * joint.sum(0)).sum() - 1)
        + (weights * (expected - shown.T @ space.features[:n] / n)).sum()
        + row_multipliers @ (shown.sum(1) - 1)
    )


def optimal_laws(
    space: TrajectorySpace, assignments: Float[np.ndarray, "M D"], weights: Float[np.ndarray, "D K"]
) -> tuple[Float[np.ndarray, "M D"], float]:
    """Return the laws ``Pr_d`` that maximise (5.6), and the ``eta`` for which its first constraint holds.

    ``v Pr = exp(-1 + pi_d (eta + theta_d.f))`` is (D.5); ``eta`` is one number for all components.
    """
    proportions = assignments[: space.demonstrated].mean(0)
    tilted = space.features @ weights.T

    def log_joint(normaliser: float) -> np.ndarray:
        return -1 + proportions * (normaliser + tilted)

    def excess(normaliser: float) -> float:
        return float(logsumexp(log_joint(normaliser), b=proportions))

    reach = 1.0 + abs(excess(0.0)) / proportions.min()
    normaliser = brentq(excess, -reach, reach, xtol=1e-14, rtol=1e-15)
    return np.exp(log_joint(normaliser)) / assignments, float(normaliser)


def assignment_gradient(
    space: TrajectorySpace,
    assignments: Float[np.ndarray, "M D"],
    weights: Float[np.ndarray, "D K"],
    row_multipliers: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n D"]:
    """Return the gradient of (5.6) in demonstrated trajectories' assignments, the laws at their optimum."""
    n = space.demonstrated
    laws, normaliser = optimal_laws(space, assignments, weights)
    joint, proportions = assignments * laws, assignments[:n].mean(0)
    generated = np.einsum("xd,xk,dk->d", joint, space.features, weights)
    common = 1 + np.log(proportions) + normaliser * joint.sum(0) + generated
    return (common - space.features[:n] @ weights.T) / n + row_multipliers[:, None]


# -- ascent ---------------------------------------------------------------------------------------------


def ascend_printed(
    space: TrajectorySpace,
    assignments: Float[np.ndarray, "n D"],
    gradient: AssignmentGradient = printed_assignment_gradient,
    iterations: int = 20,
    steps: int = 10,
    learning_rate: float = 0.01,
    ridge: float = 1e-2,
) -> tuple[Float[np.ndarray, "n D"], Float[np.ndarray, "D K"]]:
    """Alternate full descents in the weights with short ascents in the assignments.

    The weights of a component match its features, ``exp(pi_d theta_d.f)`` normalised over the space. The
    assignments take ``steps`` steps of length ``learning_rate``, clipped to be positive and normalised after
    each (the released code leaves them unbounded). Returns assignments ``[n, D]`` and weights ``[D, K]``.
    """
    shown = space.features[: space.demonstrated]
    if len(assignments) != len(shown):
        raise ValueError(
            f"assignments must be [n, D] with n = {len(shown)} demonstrated trajectories, got "
            f"{list(np.shape(assignments))}"
        )
    current = np.maximum(np.asarray(assignments, float), _LEAST_ASSIGNMENT)
    current = current / current.sum(1, keepdims=True)
    weights = np.zeros((current.shape[1], shown.shape[1]))
    for _ in range(iterations):
        weights = np.stack([matched_weights(space, share, ridge) for share in current.T])
        for _ in range(steps):
            moved = current + learning_rate * gradient(space, current, weights)
            current = np.clip(moved, _LEAST_ASSIGNMENT, 1e6)
            current = current / current.sum(1, keepdims=True)
    return current, weights


def matched_weights(
    space: TrajectorySpace, share: Float[np.ndarray, " n"], ridge: float = 1e-2
) -> Float[np.ndarray, " K"]:
    """Fit ``theta_d`` whose law ``exp(pi_d theta_d.f)`` has the mean features of ``share``, up to the ridge.

    This is the zero of the first gradient of section 5.1.2 for a normalised law, both sides divided by
    ``pi_d``; ``ridge`` is on ``pi_d theta_d``.
    """
    shown = space.features[: space.demonstrated]
    target = share @ shown / share.sum()

    def dual(tilt: np.ndarray) -> tuple[float, np.ndarray]:
        energy = space.features @ tilt
        mean = softmax(energy) @ space.features
        return (
            float(logsumexp(energy) - tilt @ target + ridge / 2 * tilt @ tilt),
            mean - target + ridge * tilt,
        )

    tilt = minimize(dual, np.zeros(shown.shape[1]), jac=True, method="L-BFGS-B").x
    return tilt / share.mean()
