"""Methods of learning reliabilities: from a posterior over truths, or by counting (section 6.1).

Each method summarises a session's observations, merges summaries, and fits reliabilities;
:mod:`~i2rl.inference.learners.noisy` is the same for all.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import PAD, SEEN, Demonstration
from ...models.process.mdp import TabularMDP
from ..programs.dual import IpoptPoint
from ..programs.observation import ObservationProgram
from ..programs.printed.observation import solve_printed_program
from ..sessions.statistic import blend
from .observations import (
    ReportClasses,
    ReportStatistic,
    SessionReports,
    agreement_of,
    fit_sensor,
    no_reports,
    report_statistic,
    score_statistic,
    session_reports,
)

# Counts of the released program's frequencies before the first observation.
_CODED_COUNT = 1e-4
# Bound of reliabilities that are frequencies: one error in a million, so that their logits are finite.
_SURE = 1e-6


@shown_briefly
class WithTruth(NamedTuple):
    """A noisy demonstration and its truth, for the ``oracle`` only; arrays of one shape."""

    seen: Demonstration
    truth: Demonstration

    @property
    def kind(self) -> Any:
        """Kind of the observed steps."""
        return self.seen.kind

    @property
    def lengths(self) -> Int[np.ndarray, " n"]:
        """Lengths of the observed trajectories."""
        return self.seen.lengths

    def bucketed(self) -> WithTruth:
        """Pad both to one shape."""
        return WithTruth(self.seen.bucketed(), self.truth.bucketed())


@shown_briefly
class PreparedSession(NamedTuple):
    """A session's demonstration, prepared for passes over it.

    Fields
    ------
    observations : SessionReports
    live : bool ``[n, L]``
        Marks of existing steps.
    truth : float ``[n, L, S, A]`` or None
        A point at the true pair, if it is known.
    """

    observations: SessionReports
    live: Bool[Array, "n L"]
    truth: Float[Array, "n L S A"] | None


def prepare(
    mdp: TabularMDP, classes: ReportClasses, demonstration: Demonstration | WithTruth, scored: bool
) -> PreparedSession:
    """Prepare a demonstration; ``scored`` false ignores its scores."""
    seen, truth = demonstration, None
    if isinstance(demonstration, WithTruth):
        seen = demonstration.seen
        states, actions = (
            jnp.asarray(x)[..., None] == jnp.arange(size)
            for x, size in (
                (demonstration.truth.state, mdp.n_states),
                (demonstration.truth.action, mdp.n_actions),
            )
        )
        truth = (states[..., :, None] & actions[..., None, :]).astype(float)
    assert isinstance(seen, Demonstration)
    return PreparedSession(session_reports(classes, seen, scored), jnp.asarray(seen.kind) != PAD, truth)


@shown_briefly
class Perception(NamedTuple):
    """Method of learning reliabilities.

    Fields
    ------
    classes : ReportClasses
    scored : bool
        True if scores are used.
    empty : NamedTuple
        The statistic before the first session.
    blend : ``(kept, new) -> statistic``
    summarise : ``(logits, session, confidence, pairs) -> statistic``
        Summary of one session, ``pairs [n, L, S, A]`` being the posterior over truths.
    fit : ``(statistic, logits) -> logits [J]``
        Start: the current logits.
    agreement : ``(logits, statistic) -> [J]``
        Learned frequency with which an observation's predicate is that of the truth.
    confidence : ``(kept, observations) -> [S, A] or [n, L, S, A]``
        Probability that an observation of each pair is right; NaN without scores.
    fit_outside : ``(statistic, warm) -> (logits, warm)``, or None
        The same fit by a solver outside JAX.
    hear : ``(kept, demonstration) -> statistic``, or None
        Computation outside JAX, before the session begins.
    """

    classes: ReportClasses
    scored: bool
    empty: Any
    blend: Callable[[Any, Any], Any]
    summarise: Callable[[Array, PreparedSession, Array, Array], Any]
    fit: Callable[[Any, Array], Array]
    agreement: Callable[[Array, Any], Array]
    confidence: Callable[[Any, SessionReports], Array]
    fit_outside: Callable[[Any, IpoptPoint], tuple[Array, IpoptPoint]] | None = None
    hear: Callable[[Any, Demonstration], Any] | None = None


# -- maximum entropy ----------------------------------------------------------------------------------


def entropic_perception(
    classes: ReportClasses,
    scores: str,
    completion: str,
    observation_slack: float,
    forgetting: float,
    program: ObservationProgram | None = None,
) -> Perception:
    """Build the observation program with a posterior over truths, observations at face value, or truths."""

    def summarise(
        logits: Array, session: PreparedSession, confidence: Array, pairs: Array
    ) -> ReportStatistic:
        if completion == "observed":
            same = session.observations.same.astype(float)
            pairs = same / jnp.maximum(same.sum((2, 3), keepdims=True), 1.0)
        elif completion == "oracle":
            assert session.truth is not None
            pairs = session.truth
        return report_statistic(classes, logits, session.observations, confidence, pairs)

    def slack(statistic: ReportStatistic) -> Array:
        return observation_slack / jnp.maximum(statistic.size, 1.0)

    def fit(statistic: ReportStatistic, logits: Array) -> Array:
        fitted = fit_sensor(classes, statistic, slack(statistic), logits).logits
        # Before any observation, slack alone would turn the assumed reliabilities into one half.
        return jnp.where(statistic.size > 0, fitted, logits)

    def fit_outside(statistic: ReportStatistic, warm: IpoptPoint) -> tuple[Array, IpoptPoint]:
        assert program is not None
        of_pair = np.asarray(classes.of_pair)
        sizes = np.bincount(of_pair.ravel(), minlength=len(classes.reportable))
        plain, wrong = ((np.asarray(x) / sizes)[of_pair] for x in (statistic.plain, statistic.wrong))
        total = plain.sum() + wrong.sum()
        if total <= 0:  # every observation is scored and right, and carries no information on errors
            return jnp.zeros(classes.patterns.shape[1]), warm
        solution = program.solve(
            plain,
            np.asarray(statistic.matches) / total,
            min(float(slack(statistic)) / total, 1.0),
            warm if np.size(warm.variables) else None,
            wrong=wrong,
        )
        return jnp.asarray(solution.logits), solution.warm

    def confidence(kept: ReportStatistic, observations: SessionReports) -> Array:
        if scores == "stepwise":
            return observations.score[..., None, None]
        if scores == "none":
            return jnp.full((1, 1), jnp.nan)
        sums, numbers = score_statistic(observations)
        total, number = kept.scores * kept.size + sums, kept.scored * kept.size + numbers
        return jnp.where(number > 0, total / jnp.where(number > 0, number, 1.0), jnp.nan)

    return Perception(
        classes,
        scores != "none",
        no_reports(classes),
        partial(blend, forgetting=forgetting),
        summarise,
        fit,
        partial(agreement_of, classes),
        confidence,
        None if program is None else fit_outside,
    )


# -- controls -----------------------------------------------------------------------------------------


@shown_briefly
class FrequencyStatistic(NamedTuple):
    """Reliabilities by counting.

    Fields
    ------
    size : float
        Number of averaged items: observations, or sessions.
    share : float ``[J]``
        Running average of each predicate's credit.
    """

    size: Float[Array, ""]
    share: Float[Array, " J"]


def _no_confidence(kept: FrequencyStatistic, observations: SessionReports) -> Array:
    return jnp.full((1, 1), jnp.nan)


def counted_perception(classes: ReportClasses, predicates: Bool[np.ndarray, "J S A"]) -> Perception:
    """Build RIFOM's frequencies in a fair form: every observation counts as the truth by its score.

    ``p_j = (sum_t c_t + 1) / (T + 2)`` over all steps, a missing score counting as one.
    """
    n_predicates = len(predicates)

    def summarise(
        logits: Array, session: PreparedSession, confidence: Array, pairs: Array
    ) -> FrequencyStatistic:
        seen, score = session.observations.seen, session.observations.score
        size = jnp.sum(seen).astype(float)
        trusted = jnp.sum(jnp.where(seen, jnp.where(jnp.isnan(score), 1.0, score), 0.0))
        return FrequencyStatistic(size, jnp.full(n_predicates, trusted / jnp.maximum(size, 1.0)))

    def agreement(logits: Array, statistic: FrequencyStatistic) -> Array:
        return (statistic.share * statistic.size + 1) / (statistic.size + 2)

    return Perception(
        classes,
        True,
        FrequencyStatistic(jnp.zeros(()), jnp.zeros(n_predicates)),
        blend,
        summarise,
        lambda statistic, logits: _logit(agreement(logits, statistic)),
        agreement,
        _no_confidence,
    )


def coded_perception(classes: ReportClasses, predicates: Bool[np.ndarray, "J S A"]) -> Perception:
    """Build RIFOM's frequencies as the released program counts them, for comparison.

    Only the last observation of each trajectory counts, a predicate is credited if it is true there, and
    credits are normalised over all predicates and their negations; sessions are averaged. A predicate that is
    reliable and always false therefore appears unreliable.
    """
    psi = jnp.asarray(np.asarray(predicates, float))

    def summarise(
        logits: Array, session: PreparedSession, confidence: Array, pairs: Array
    ) -> FrequencyStatistic:
        length = session.observations.kind.shape[1]
        order = jnp.where(session.observations.whole, jnp.arange(length), -1)
        last = (order == order.max(1, keepdims=True)) & (order >= 0)
        true = jnp.einsum("nl,nlsa,jsa->j", last.astype(float), session.observations.same.astype(float), psi)
        credit = true + _CODED_COUNT
        return FrequencyStatistic(jnp.ones(()), credit / (jnp.sum(credit) + len(psi) * _CODED_COUNT))

    def agreement(logits: Array, statistic: FrequencyStatistic) -> Array:
        return statistic.share

    return Perception(
        classes,
        False,
        FrequencyStatistic(jnp.zeros(()), jnp.full(len(psi), 0.5)),
        blend,
        summarise,
        lambda statistic, logits: _logit(statistic.share),
        agreement,
        _no_confidence,
    )


def printed_perception(
    classes: ReportClasses, predicates: Bool[np.ndarray, "J S A"], available: Bool[np.ndarray, "S A"]
) -> Perception:
    """Build Eq. 6.7 as printed, every pair a candidate for every observation; solutions are averaged."""
    empty = FrequencyStatistic(jnp.zeros(()), jnp.full(len(predicates), 0.5))

    def hear(kept: FrequencyStatistic, demonstration: Demonstration) -> FrequencyStatistic:
        named = (demonstration.kind == SEEN) & (demonstration.state >= 0) & (demonstration.action >= 0)
        if not named.any():
            return kept
        candidates = np.broadcast_to(available / available.sum(), (int(named.sum()), *available.shape))
        solution = solve_printed_program(
            predicates,
            demonstration.state[named],
            demonstration.action[named],
            demonstration.score[named],
            candidates,
        )
        return blend(kept, FrequencyStatistic(jnp.ones(()), jnp.asarray(solution.reliabilities)))

    return Perception(
        classes,
        False,
        empty,
        lambda kept, new: kept,
        lambda logits, session, confidence, pairs: empty,
        lambda statistic, logits: _logit(statistic.share),
        lambda logits, statistic: statistic.share,
        _no_confidence,
        hear=hear,
    )


def _logit(p: Array) -> Array:
    p = jnp.clip(p, _SURE, 1 - _SURE)
    return jnp.log(p) - jnp.log1p(-p)
