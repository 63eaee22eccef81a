"""Identification of a sensor's noise: separates the expert's errors from the sensor's.

An observation that fits badly may be the expert's error as well as the sensor's. If every observed pair is
possible, the likelihood of Eq. 6.5 hardly distinguishes the two (and the little it does may come from
predicates that describe the sensor badly). Scores, or knowledge of the expert's rationality, must. The sensor
is therefore fitted twice to one demonstration: for an expert as erratic as the learned one, and for one who
always acts optimally under the same reward. If the two disagree, agreement is known only to lie between them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import SEEN, Demonstration, DemonstrationError
from ...models.observation.evidence import (
    AnySensor,
    FeatureNoise,
    Sensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import deterministic_policy, hard_plan, reward_of, soft_plan
from ..completion.smoothing import Evidence, smooth_all
from ..programs.observation import Identification, unidentified_predicates
from ..sensors.observations import report_classes, report_log_evidence
from ..sensors.reliabilities import Perception, PreparedSession, entropic_perception, prepare
from .noisy import DEFAULT_START, initial_logits

# Error rate of the optimal expert, so that all observations stay possible.
_ERRS = 1e-3
_ITERATIONS = 100


@shown_briefly
class SensorIdentification(NamedTuple):
    """Dependence of agreement on the assumed behaviour of the expert.

    Fields
    ------
    erratic : float ``[J]``
        Agreement of observations with truths if the expert is as erratic as learned.
    optimal : float ``[J]``
        Agreement if the expert always acts optimally under the learned reward.
    structure : Identification
        Predicates that no observation of this demonstration identifies, whatever the expert does.
    tolerance : float
        Largest difference of the two for an identified predicate.
    """

    erratic: Float[np.ndarray, " J"]
    optimal: Float[np.ndarray, " J"]
    structure: Identification
    tolerance: float

    @property
    def identified(self) -> Bool[np.ndarray, " J"]:
        """Marks of predicates whose agreement is known, up to the tolerance."""
        known: Bool[np.ndarray, " J"] = np.abs(self.erratic - self.optimal) <= self.tolerance
        known[list(self.structure.uninformative)] = False
        return known

    def describe(self, names: tuple[str, ...] | None = None) -> str:
        """Describe the unidentified predicates in words; empty if all are identified."""
        called = [f"predicate {j}" if names is None else names[j] for j in range(len(self.erratic))]
        lines = [
            f"{called[j]}: not identified; reports agree in {self.optimal[j]:.0%} of cases if the expert "
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
    """Fit the sensor under the learned reward, for an erratic and for an optimal expert.

    Parameters
    ----------
    mdp, predicates
        As for :func:`~i2rl.inference.rimeo`.
    demonstration : Demonstration
        Observations to fit, the more the better; needs no truth.
    weights : float ``[K]``
        The learned reward.
    **options
        Options of :func:`sensor_identifier`, which is the better choice for many demonstrations.

    Raises
    ------
    ValueError
        For weights or predicates of the wrong shape, unknown options, and a demonstration without
        observations or with an impossible one.

    See Also
    --------
    i2rl.inference.rimeo : learns the reward and the sensor

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sensor_identification
    >>> corridor = five_cells()
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> options = {"visibility": corridor.sensor, "scores": "none"}
    >>> found = sensor_identification(
    ...     corridor.mdp, predicates, corridor.demonstration, corridor.weights, **options
    ... )
    >>> found.erratic.shape, found.identified.shape
    ((2,), (2,))
    """
    return sensor_identifier(mdp, predicates, **options)(demonstration, weights)


def sensor_identifier(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    visibility: AnySensor | None = None,
    reportable: ArrayLike | None = None,
    scores: str = "stepwise",
    observation_slack: float = 0.25,
    tolerance: float = 0.05,
) -> Callable[[Demonstration, ArrayLike], SensorIdentification]:
    """Build :func:`sensor_identification` for many demonstrations, compiled once for each of their shapes.

    ``visibility``, ``reportable``, ``scores`` and ``observation_slack`` are those of
    :func:`~i2rl.inference.rimeo`; predicates whose agreement differs by at most ``tolerance`` count as
    identified.
    """
    if scores not in ("stepwise", "averaged", "none"):
        raise ValueError(f"scores must be one of stepwise, averaged, none, got {scores!r}")
    if not 0 <= observation_slack < np.inf:
        raise ValueError(f"errors must be a number of reports, not negative, got {observation_slack}")
    psi = np.asarray(predicates)
    if psi.ndim != 3 or psi.shape[1:] != mdp.available.shape:
        raise ValueError(
            f"predicates have shape [J, S, A] = [J, {mdp.n_states}, {mdp.n_actions}], got {list(psi.shape)}"
        )
    seen: AnySensor = Sensor() if visibility is None else Sensor() * visibility
    if seen.noise is not None:
        raise ValueError("the visibility says what is hidden; how reports err is fitted, not given")
    seen = fitting_sensor(seen, mdp)
    mask = None if reportable is None else np.asarray(reportable, bool)
    classes = report_classes(psi, mask)
    perception = entropic_perception(classes, scores, "posterior", observation_slack, 1.0)
    fit = _fit(mdp, perception, seen.visibility, initial_logits(psi, DEFAULT_START))
    slips = mdp.available / mdp.available.sum(1, keepdims=True)

    def identify(demonstration: Demonstration, weights: ArrayLike) -> SensorIdentification:
        w = np.asarray(weights, float)
        if w.shape != (mdp.n_features,):
            raise ValueError(f"weights have shape [K] = [{mdp.n_features}], got {list(w.shape)}")
        if not np.isfinite(w).all():
            raise ValueError(f"weights must be numbers, got {w}")
        demonstration = checked_demonstration(mdp, demonstration)
        if not (demonstration.kind == SEEN).any():
            raise DemonstrationError("nothing was reported: there is nothing to judge the sensor by")
        session = prepare(mdp, classes, demonstration.bucketed(), perception.scored)
        reward = reward_of(mdp, jnp.asarray(w))
        best = deterministic_policy(hard_plan(mdp, reward).optimal)
        optimal = (1 - _ERRS) * best + _ERRS * slips
        (erratic, likely), (sure, _) = (
            fit(session, policy) for policy in (soft_plan(mdp, reward).log_policy, jnp.log(optimal))
        )
        if not np.isfinite(likely).all():
            require_possible(FeatureNoise(psi, np.full(len(psi), 0.5), mask) * seen, mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under the learned policy")
        # Uniform over the reachable truths: predicates that agree on all of them are not identified.
        structure = unidentified_predicates(psi, np.asarray(optimal), reportable)
        return SensorIdentification(np.asarray(erratic), np.asarray(sure), structure, tolerance)

    return identify


def _fit(
    mdp: TabularMDP,
    perception: Perception,
    visibility: Float[Array, " S"] | None,
    first_logits: Float[Array, " J"],
) -> Callable[[PreparedSession, Float[Array, "S A"]], tuple[Float[Array, " J"], Float[Array, " n"]]]:
    """Return the agreement after alternating truths and sensor, for given behaviour of the expert.

    Also returns the log-likelihood of each trajectory.
    """

    @jax.jit
    def fit(
        session: PreparedSession, log_policy: Float[Array, "S A"]
    ) -> tuple[Float[Array, " J"], Float[Array, " n"]]:
        confidence = perception.confidence(perception.empty, session.observations)

        def step(_: int, carry: tuple) -> tuple:
            logits = carry[0]
            evidence = report_log_evidence(
                perception.classes, logits, session.observations, confidence, visibility
            )
            completion = smooth_all(mdp, log_policy, Evidence(evidence, session.live))
            heard = perception.summarise(logits, session, confidence, completion.pairs)
            logits = perception.fit(heard, logits)
            return logits, perception.agreement(logits, heard), completion.log_likelihood

        begun = first_logits, jnp.zeros_like(first_logits), jnp.zeros(len(session.live))
        return lax.fori_loop(0, _ITERATIONS, step, begun)[1:]

    return fit
