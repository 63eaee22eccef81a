"""Classes of pairs that predicates cannot distinguish, and expected agreements with them (chapter 6.1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from ..inputs.display import shown_briefly
from .evidence import FeatureNoise, checked_predicates


@shown_briefly
class PredicateClasses(NamedTuple):
    """Pairs gathered by their predicates: programs cost in classes, not in pairs.

    Fields
    ------
    vectors : bool or int ``[C, J]``
        Values of the predicates in each class.
    reportable : float ``[C]``
        Number of pairs of each class that perception may report.
    of_pair : int ``[S, A]``
        The class of each pair.
    """

    vectors: Bool[np.ndarray, "C J"] | Int[np.ndarray, "C J"]
    reportable: Float[np.ndarray, " C"]
    of_pair: Int[np.ndarray, "S A"]

    @property
    def agreements(self) -> Float[np.ndarray, "C C J"]:
        """Compare each predicate of a hidden pair (first) with that of an observation (second)."""
        return (self.vectors[:, None] == self.vectors[None]).astype(float)

    def gather(self, weights: ArrayLike) -> Float[np.ndarray, " C"]:
        """Sum weights ``[S, A]`` over classes and normalise them to one; ``ValueError`` if they cannot be."""
        w = self.checked(weights)
        return self.sum(w) / w.sum()

    def sum(self, weights: Float[np.ndarray, "S A"]) -> Float[np.ndarray, " C"]:
        """Sum weights of pairs over each class."""
        return np.bincount(self.of_pair.ravel(), weights.ravel(), len(self.vectors))

    def checked(self, weights: ArrayLike, zero: bool = False) -> Float[np.ndarray, "S A"]:
        """Check weights of pairs; ``ValueError`` if negative, not finite, or all zero unless ``zero``."""
        w = np.asarray(weights, float)
        if w.shape != self.of_pair.shape:
            raise ValueError(
                f"weights of truths have shape [S, A] = {list(self.of_pair.shape)}, got {list(w.shape)}"
            )
        if not (np.isfinite(w) & (w >= 0)).all() or not (zero or w.sum() > 0):
            raise ValueError(
                f"weights of truths must be finite, not negative and not all zero; the least is {w.min()}, "
                f"their sum {w.sum()}"
            )
        return w


def predicate_classes(predicates: ArrayLike, reportable: ArrayLike | None = None) -> PredicateClasses:
    """Gather the pairs ``[S, A]`` by their predicates ``[J, S, A]``.

    ``reportable [S, A]`` marks the pairs that perception may report; all by default. Raises ``ValueError``
    as ``FeatureNoise`` does.
    """
    psi = np.asarray(predicates)
    # The border of FeatureNoise: a learner accepts the predicates that an injector accepts.
    mask = None if reportable is None else np.asarray(reportable)
    noise = FeatureNoise(psi, np.full(psi.shape[:1], 0.5), mask)
    psi, mask = np.asarray(noise.predicates), np.asarray(noise.reportable)
    vectors, of_pair = np.unique(psi.reshape(len(psi), -1).T, axis=0, return_inverse=True)
    of_pair = of_pair.reshape(psi.shape[1:])
    return PredicateClasses(
        vectors, np.bincount(of_pair[mask], minlength=len(vectors)).astype(float), of_pair
    )


def agreement_patterns(
    agreements: Bool[np.ndarray, "C R J"] | Float[np.ndarray, "C R J"],
) -> tuple[Float[np.ndarray, "E J"], Int[np.ndarray, "C R"]]:
    """Return the distinct rows of agreements, and the row that each hidden pair and observation has."""
    rows = agreements.reshape(-1, agreements.shape[-1]).astype(bool)
    _, first, which = np.unique(np.packbits(rows, axis=1), axis=0, return_index=True, return_inverse=True)
    return rows[first].astype(float), which.reshape(agreements.shape[:-1])


@shown_briefly
class ReportedMatches(NamedTuple):
    """Expected agreements of a session's observations with the pairs behind them.

    Fields
    ------
    weights : float ``[S, A]``
        Expected number of observations of each hidden pair.
    matches : float ``[J]``
        Expected number of observations whose predicate ``j`` equals that of the hidden pair.
    """

    weights: Float[np.ndarray, "S A"]
    matches: Float[np.ndarray, " J"]

    @property
    def agreement(self) -> Float[np.ndarray, " J"]:
        """The program's target: expected matches per observation."""
        return self.matches / self.weights.sum()


def reported_matches(
    predicates: ArrayLike,
    states: ArrayLike,
    actions: ArrayLike,
    posterior: ArrayLike,
) -> ReportedMatches:
    """Count expected matches of observations with hidden pairs; counts of sessions add up.

    Parameters
    ----------
    predicates : bool or int ``[J, S, A]``
    states, actions : int ``[T]``
        The observed pairs.
    posterior : float ``[T, S, A]``
        Posterior over the pair behind each observation. A point at the true pair gives the ``oracle`` of
        the sources, a point at the observation gives ``observed``.

    Raises
    ------
    ValueError
        For bad predicates, shapes that do not fit, indices out of range, or a posterior whose rows do not sum
        to one.

    See Also
    --------
    i2rl.models.sample_observation_features : the posterior of the reliabilities behind them
    i2rl.inference.ObservationProgram : the maximum-entropy reliabilities

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.models import reported_matches
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> truths = np.eye(15).reshape(-1, 5, 3)[[0, 4]]  # (0, 0) and (1, 1)
    >>> reported_matches(predicates, [0, 2], [0, 1], truths).agreement
    array([0.5, 1. ])
    """
    psi, truth = checked_predicates(predicates), np.asarray(posterior, float)
    s, a = np.asarray(states), np.asarray(actions)
    if s.ndim != 1 or a.shape != s.shape or truth.shape != (len(s), *psi.shape[1:]):
        raise ValueError(
            f"{len(s) if s.ndim else 0} reports of pairs {list(psi.shape[1:])} need as many actions and a "
            f"posterior [T, S, A]; got actions {list(a.shape)} and a posterior {list(truth.shape)}"
        )
    off = (s < 0) | (s >= psi.shape[1]) | (a < 0) | (a >= psi.shape[2])
    if off.any():
        t = int(np.flatnonzero(off)[0])
        raise ValueError(f"report {t} is of the pair ({s[t]}, {a[t]}), outside {list(psi.shape[1:])}")
    total = truth.sum((1, 2))
    wrong = ~((truth >= 0).all((1, 2)) & (np.abs(total - 1) < 1e-6))
    if wrong.any():
        t = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"the posterior of report {t} is no distribution: it sums to {total[t]}")
    # One predicate at a time: a table of all agreements would be [J, T, S, A].
    same = (labels == labels[s, a][:, None, None] for labels in psi)
    return ReportedMatches(truth.sum(0), np.array([truth[which].sum() for which in same]))
