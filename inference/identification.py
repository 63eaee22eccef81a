"""What reports can tell about perception at all: who errs, the expert or the sensor?

A report that fits badly is explained by an expert who errs as well as by a sensor that does. Where every pair
that is reported could have happened, the likelihood of Eq. 6.5 hardly tells the two apart (and what it
does tell may come from predicates that describe the sensor badly); scores, or knowing how decided the expert
is, must. So the sensor is fitted twice to one demonstration: to an expert as erratic as was learned, and to
one who always does what is best under the same reward. Where the two disagree, agreement is known only to
lie between them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..models.demonstration import Demonstration
from ..models.evidence import Imperfection, Sensor
from ..models.mdp import TabularMDP
from ..models.planning import deterministic_policy, hard_plan, reward_of, soft_plan
from .observation_program import Identification, unidentified_predicates
from .perception import Perception, PreparedSession, entropic_perception, prepare
from .reports import report_classes, report_log_evidence
from .smoothing import Evidence, smooth_all

# How often the decided expert still errs, so that nothing is ruled out.
_ERRS = 1e-3
_ITERATIONS = 100


class SensorIdentification(NamedTuple):
    """How far agreement depends on what is assumed of the expert.

    Fields
    ------
    erratic : float ``[J]``
        Agreement of reports with truths if the expert is as erratic as was learned.
    decided : float ``[J]``
        If he always does what is best under the learned reward.
    structure : Identification
        What no reports of this demonstration could tell, whoever errs.
    tolerance : float
        By how much the two may differ.
    """

    erratic: Float[np.ndarray, " J"]
    decided: Float[np.ndarray, " J"]
    structure: Identification
    tolerance: float

    @property
    def identified(self) -> Bool[np.ndarray, " J"]:
        """Whether a predicate's agreement is known, up to the tolerance."""
        known: Bool[np.ndarray, " J"] = np.abs(self.erratic - self.decided) <= self.tolerance
        known[list(self.structure.uninformative)] = False
        return known

    def describe(self, names: tuple[str, ...] | None = None) -> str:
        """What cannot be told, in words; empty if everything can."""
        called = [f"predicate {j}" if names is None else names[j] for j in range(len(self.erratic))]
        lines = [
            f"{called[j]}: not identified; reports agree in {self.decided[j]:.0%} of cases if the expert "
            f"always does what is best, in {self.erratic[j]:.0%} if he errs as was learned"
            for j in np.flatnonzero(~self.identified)
            if j not in self.structure.uninformative
        ]
        structure = self.structure.describe(names)
        return "; ".join([*lines, structure] if structure else lines)


def sensor_identification(
    mdp: TabularMDP,
    predicates: ArrayLike,
    demonstration: Demonstration,
    weights: ArrayLike,
    **options: Any,
) -> SensorIdentification:
    """Fit the sensor under the learned reward, to an erratic and to a decided expert.

    Parameters
    ----------
    mdp, predicates
        As of :func:`~i2rl.inference.rimeo`.
    demonstration : Demonstration
        To judge by, the more the better; needs no truth.
    weights : float ``[K]``
        The reward that was learned.
    **options
        Of :func:`sensor_identifier`, which is the better choice for many demonstrations.

    Raises
    ------
    ValueError
        For weights or predicates of the wrong shape.
    """
    return sensor_identifier(mdp, predicates, **options)(demonstration, weights)


def sensor_identifier(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    view: Imperfection | None = None,
    reportable: ArrayLike | None = None,
    scores: str = "stepwise",
    errors: float = 0.25,
    tolerance: float = 0.05,
) -> Callable[[Demonstration, ArrayLike], SensorIdentification]:
    """:func:`sensor_identification` of many demonstrations, compiled once for each of their shapes.

    ``view``, ``reportable``, ``scores`` and ``errors`` are those of :func:`~i2rl.inference.rimeo`; agreement
    may differ by ``tolerance`` and still be called identified.
    """
    psi = np.asarray(predicates)
    classes = report_classes(psi, reportable)
    perception = entropic_perception(classes, scores, "posterior", errors, 1.0)
    fit = _fit(mdp, perception, (Sensor() if view is None else Sensor() * view).presence)
    slips = mdp.available / mdp.available.sum(1, keepdims=True)

    def identify(demonstration: Demonstration, weights: ArrayLike) -> SensorIdentification:
        w = np.asarray(weights, float)
        if w.shape != (mdp.n_features,):
            raise ValueError(f"weights have shape [K] = [{mdp.n_features}], got {list(w.shape)}")
        session = prepare(mdp, classes, demonstration.bucketed(), perception.scored)
        reward = reward_of(mdp, jnp.asarray(w))
        best = deterministic_policy(hard_plan(mdp, reward).optimal)
        decided = (1 - _ERRS) * best + _ERRS * slips
        erratic, sure = (
            np.asarray(fit(session, policy))
            for policy in (soft_plan(mdp, reward).log_policy, jnp.log(decided))
        )
        # Wherever this expert may be: what differs nowhere cannot be told.
        structure = unidentified_predicates(psi, np.asarray(decided), reportable)
        return SensorIdentification(erratic, sure, structure, tolerance)

    return identify


def _fit(
    mdp: TabularMDP, perception: Perception, presence: Float[Array, " S"] | None
) -> Callable[[PreparedSession, Float[Array, "S A"]], Float[Array, " J"]]:
    """Agreement after the alternation of truths and sensor, the expert's behaviour being given."""

    @jax.jit
    def fit(session: PreparedSession, log_policy: Float[Array, "S A"]) -> Float[Array, " J"]:
        confidence = perception.confidence(perception.empty, session.reports)

        def step(_: int, carry: tuple) -> tuple:
            logits, _agreement = carry
            evidence = report_log_evidence(perception.classes, logits, session.reports, confidence, presence)
            pairs = smooth_all(mdp, log_policy, Evidence(evidence, session.live)).pairs
            heard = perception.summarise(logits, session, confidence, pairs)
            logits = perception.fit(heard, logits)
            return logits, perception.agreement(logits, heard)

        # From a sensor that is right more often than not, about everything alike.
        n_predicates = perception.classes.patterns.shape[1]
        start = jnp.ones(n_predicates), jnp.zeros(n_predicates)
        return lax.fori_loop(0, _ITERATIONS, step, start)[1]

    return fit
