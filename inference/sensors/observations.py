"""A session's observations as evidence about the truth, and statistics of perception under a posterior.

All quantities are in *classes* of pairs with equal predicates, and Eq. 6.5 in the patterns of agreement of
two classes. An observation of a pair costs one number for each class of truths; one with a hidden state or
action is a set of possible pairs, and costs the whole table ``[C, C]`` of Eq. 6.5.

A score ``c`` is perception's probability that its observation is right. A scored observation follows
``c [o = g] + (1 - c) O(o | g, o != g)``, where ``O(o | g, o != g)`` is Eq. 6.5 among the *other* pairs: the
distribution of greatest entropy with this probability of being right and the required expected agreement. An
unscored observation follows ``O(o | g)`` itself. Both share one set of reliabilities.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.display import shown_briefly
from ...models.observation.agreement import agreement_patterns
from ...models.observation.demonstration import HIDDEN, SEEN, UNKNOWN, Demonstration
from ...models.observation.evidence import FeatureNoise
from ..programs.maximum_entropy import quadratic_l1

# Certain perception may still be wrong: a score of one would exclude every other truth, and a score of zero
# the observed one.
CERTAIN = 0.999
# A larger logit is one error in 160 000.
LIMIT = 12.0

_MAX_STEPS = 30
_MAX_HALVINGS = 20
_MAX_SWEEPS = 50


@shown_briefly
class ReportClasses(NamedTuple):
    """Pairs gathered by their predicates and by whether they can be reported.

    Fields
    ------
    patterns : float ``[E, J]``
        Possible patterns of agreement of a truth and an observation on the predicates.
    pattern : int ``[C, C]``
        Pattern of two classes; symmetric.
    choices : float ``[C, E]``
        Number of reportable pairs with each pattern of agreement with a truth.
    reportable : float ``[C]``
        Number of pairs of each class that perception may report: all of a class, or none.
    of_pair : int ``[S, A]``
    can_be_reported : bool ``[S, A]``
    """

    patterns: Float[Array, "E J"]
    pattern: Int[Array, "C C"]
    choices: Float[Array, "C E"]
    reportable: Float[Array, " C"]
    of_pair: Int[Array, "S A"]
    can_be_reported: Bool[Array, "S A"]

    @property
    def wrong_choices(self) -> Float[Array, "C E"]:
        """``choices`` without the truth itself."""
        return self.choices - (self.reportable > 0)[:, None] * self.itself

    @property
    def itself(self) -> Bool[Array, " E"]:
        """The pattern in which every predicate agrees."""
        return jnp.all(self.patterns == 1, axis=1)

    @property
    def certain(self) -> Float[Array, "S A"]:
        """One or zero for truths at which every scored observation must be right or wrong; else NaN."""
        alone = self.can_be_reported & (jnp.sum(self.reportable) == 1)
        return jnp.where(self.can_be_reported, jnp.where(alone, 1.0, jnp.nan), 0.0)

    def gather(self, pairs: Float[Array, "*n S A"]) -> Float[Array, "*n C"]:
        """Sum over the pairs of each class."""
        last = jnp.moveaxis(pairs.reshape(*pairs.shape[:-2], -1), -1, 0)
        return jnp.moveaxis(jax.ops.segment_sum(last, self.of_pair.ravel(), len(self.reportable)), 0, -1)


def report_classes(predicates: ArrayLike, reportable: ArrayLike | None = None) -> ReportClasses:
    """Gather the pairs ``[S, A]``; arguments and errors as for :class:`~i2rl.models.FeatureNoise`."""
    psi, mask = np.asarray(predicates), None if reportable is None else np.asarray(reportable)
    noise = FeatureNoise(psi, np.full(psi.shape[:1], 0.5), mask)
    psi, mask = np.asarray(noise.predicates), np.asarray(noise.reportable)
    keys = np.concatenate([psi.astype(int), mask[None]]).reshape(len(psi) + 1, -1).T
    vectors, of_pair = np.unique(keys, axis=0, return_inverse=True)
    of_pair = of_pair.reshape(mask.shape)
    agree = vectors[:, None, :-1] == vectors[None, :, :-1]
    number = np.bincount(of_pair[mask], minlength=len(vectors)).astype(float)
    patterns, pattern = agreement_patterns(agree)
    choices = np.zeros((len(vectors), len(patterns)))
    np.add.at(choices, (np.arange(len(vectors))[:, None], pattern), number)
    return ReportClasses(
        jnp.asarray(patterns),
        jnp.asarray(pattern),
        jnp.asarray(choices),
        jnp.asarray(number),
        jnp.asarray(of_pair),
        jnp.asarray(mask),
    )


@shown_briefly
class SessionReports(NamedTuple):
    """A session's observations, prepared for any reliabilities.

    Fields
    ------
    kind : int ``[n, L]``
    said : float ``[n, L, C]``
        Number of pairs of each class that the observation may be.
    same : bool ``[n, L, S, A]``
        Pairs that the observation may be.
    score : float ``[n, L]``
        NaN without a score.
    """

    kind: Int[Array, "n L"]
    said: Float[Array, "n L C"]
    same: Bool[Array, "n L S A"]
    score: Float[Array, "n L"]

    @property
    def seen(self) -> Bool[Array, "n L"]:
        """Marks of the observed steps."""
        return self.kind == SEEN

    @property
    def whole(self) -> Bool[Array, "n L"]:
        """Marks of the observations that name one pair."""
        return self.seen & (jnp.sum(self.said, axis=2) == 1)

    @property
    def open(self) -> Bool[Array, ""]:
        """True if any observation may be of more than one pair."""
        return jnp.any(jnp.sum(self.said, axis=2) > 1)


def session_reports(
    classes: ReportClasses, demonstration: Demonstration, scored: bool = True
) -> SessionReports:
    """Prepare a demonstration; ``scored`` false ignores its scores."""
    kind, state, action, score = (jnp.asarray(x) for x in demonstration.arrays)
    n_states, n_actions = classes.of_pair.shape
    states = (state[..., None] == UNKNOWN) | (state[..., None] == jnp.arange(n_states))
    actions = (action[..., None] == UNKNOWN) | (action[..., None] == jnp.arange(n_actions))
    seen = kind == SEEN
    same = states[..., :, None] & actions[..., None, :] & classes.can_be_reported & seen[..., None, None]
    said = classes.gather(same.astype(float))
    # A score of one gains nothing, and could not be corrected.
    score = jnp.where(seen & scored, jnp.clip(score, 1 - CERTAIN, CERTAIN), jnp.nan)
    return SessionReports(kind, said, same, score)


# -- Eq. 6.5 ------------------------------------------------------------------------------------------


class _Terms(NamedTuple):
    """Eq. 6.5 up to one factor.

    Fields
    ------
    by_pattern : float ``[E]``
    total, others : float ``[C]``
        By the class of the truth: sums over all reportable pairs, and over all but the truth; one for an
        empty sum.
    possible : bool ``[C]``
        True if a pair other than the truth can be reported.
    itself : float
        The factor of the truth itself.
    """

    by_pattern: Float[Array, " E"]
    total: Float[Array, " C"]
    others: Float[Array, " C"]
    possible: Bool[Array, " C"]
    itself: Float[Array, ""]


def _terms(classes: ReportClasses, logits: Float[Array, " J"]) -> _Terms:
    """Evaluate Eq. 6.5 for reliabilities ``p_j`` with these logits."""
    exponents = classes.patterns @ logits
    terms = jnp.exp(exponents - exponents.max())
    others = classes.wrong_choices @ terms
    return _Terms(
        terms,
        classes.choices @ terms,
        jnp.where(others > 0, others, 1.0),
        others > 0,
        jnp.sum(terms * classes.itself),
    )


def _reported(
    classes: ReportClasses, observations: SessionReports, by_pattern: Float[Array, " E"]
) -> Float[Array, "n L C"]:
    """Compute ``sum_o said_o f(agreement of g and o)`` of every step, for truths ``g`` in each class."""

    def named() -> Array:
        at = classes.pattern[jnp.argmax(observations.said, axis=2)]
        return jnp.where(observations.whole[..., None], by_pattern[at], 0.0)

    return lax.cond(observations.open, lambda: observations.said @ by_pattern[classes.pattern], named)


def _by_pattern(
    classes: ReportClasses, observations: SessionReports, weights: Float[Array, "n L C"]
) -> Float[Array, " E"]:
    """Sum weights of truths over each pattern: the transpose of :func:`_reported`."""
    zero = jnp.zeros(len(classes.patterns))

    def named() -> Array:
        at = classes.pattern[jnp.argmax(observations.said, axis=2)]
        return zero.at[at].add(jnp.where(observations.whole[..., None], weights, 0.0))

    def sets() -> Array:
        return zero.at[classes.pattern].add(jnp.einsum("nlc,nlo->co", weights, observations.said))

    return lax.cond(observations.open, sets, named)


class _Likelihood(NamedTuple):
    """``P(observation | g)`` of every step, and its parts: ``right + wrong`` if scored, else ``plain``."""

    plain: Float[Array, "n L C"]
    right: Float[Array, "n L S A"]
    wrong: Float[Array, "n L S A"]
    confidence: Float[Array, "... S A"]
    scored: Bool[Array, "n L S A"]
    total: Float[Array, "n L S A"]


def _likelihood(
    classes: ReportClasses, terms: _Terms, observations: SessionReports, confidence: Float[Array, "... S A"]
) -> _Likelihood:
    """Evaluate every step and truth; ``confidence`` is that of an observation, NaN without scores."""
    scored = jnp.broadcast_to(~jnp.isnan(confidence), observations.same.shape)
    c = jnp.where(jnp.isnan(classes.certain), jnp.where(scored, confidence, 0.0), classes.certain)
    reported = _reported(classes, observations, terms.by_pattern)
    plain = reported / terms.total
    others = reported[..., classes.of_pair] - observations.same * terms.itself
    right = c * observations.same
    wrong = (1 - c) * jnp.maximum(others * (terms.possible / terms.others)[classes.of_pair], 0.0)
    return _Likelihood(
        plain, right, wrong, c, scored, jnp.where(scored, right + wrong, plain[..., classes.of_pair])
    )


def report_log_evidence(
    classes: ReportClasses,
    logits: Float[Array, " J"],
    observations: SessionReports,
    confidence: Float[Array, "... S A"],
    visibility: Float[Array, " S"] | None = None,
) -> Float[Array, "n L S A"]:
    """Return ``log e_t(s, a)`` of every step under these reliabilities.

    Parameters
    ----------
    classes, logits, observations
    confidence : float ``[S, A]`` or ``[n, L, S, A]``
        Probability that the observation is right if the truth is ``(s, a)``; NaN without scores. For a truth
        that cannot be reported it is zero, whatever the argument.
    visibility : float ``[S]``, optional
        Probability of being in view; one by default.
    """
    total = _likelihood(classes, _terms(classes, logits), observations, confidence).total
    noise = jnp.where(total > 0, jnp.log(jnp.where(total > 0, total, 1.0)), -jnp.inf)
    view = jnp.ones(classes.of_pair.shape[0]) if visibility is None else visibility
    kind = observations.kind[..., None, None]
    seen, hidden = jnp.log(view)[:, None], jnp.log1p(-view)[:, None]
    return jnp.where(kind == SEEN, noise + seen, jnp.where(kind == HIDDEN, hidden, 0.0))


# -- the statistic ------------------------------------------------------------------------------------


@shown_briefly
class ReportStatistic(NamedTuple):
    """Statistic of observations: running averages over them.

    Fields
    ------
    size : float
        Number of observations.
    plain : float ``[C]``
        Share of unscored observations by class of their truth, under the posterior of their session.
    wrong : float ``[C]``
        Share of wrong scored observations by class of their truth.
    right : float
        Share of right scored observations.
    matches : float ``[J]``
        Share of unscored and of wrong observations that agree with their truth on each predicate.
    scores, scored : float ``[S, A]``
        Per observation: sum of the scores of each observed pair, and their number (Eq. 6.6 is their ratio).
    """

    size: Float[Array, ""]
    plain: Float[Array, " C"]
    wrong: Float[Array, " C"]
    right: Float[Array, ""]
    matches: Float[Array, " J"]
    scores: Float[Array, "S A"]
    scored: Float[Array, "S A"]

    @property
    def confidence(self) -> Float[Array, "S A"]:
        """``O_hat(o)`` of Eq. 6.6; NaN for pairs never observed with a score."""
        some = self.scored > 0
        return jnp.where(some, self.scores / jnp.where(some, self.scored, 1.0), jnp.nan)

    @property
    def agreement(self) -> Float[Array, " J"]:
        """Expected share of observations that agree with their truth on each predicate; NaN before any."""
        return _share(self, self.matches)


def no_reports(classes: ReportClasses) -> ReportStatistic:
    """Return the statistic before the first observation."""
    zero, by_class = jnp.zeros(()), jnp.zeros(len(classes.reportable))
    matches, pairs = jnp.zeros(classes.patterns.shape[1]), jnp.zeros(classes.of_pair.shape)
    return ReportStatistic(zero, by_class, by_class, zero, matches, pairs, pairs)


def score_statistic(observations: SessionReports) -> tuple[Float[Array, "S A"], Float[Array, "S A"]]:
    """Return sum and number of scores by observed pair; observations with hidden coordinates are left out."""
    counts = observations.whole & ~jnp.isnan(observations.score)
    weight = jnp.where(counts, observations.score, 0.0)
    return jnp.einsum("nl,nlsa->sa", weight, observations.same.astype(float)), jnp.einsum(
        "nl,nlsa->sa", counts.astype(float), observations.same.astype(float)
    )


def report_statistic(
    classes: ReportClasses,
    logits: Float[Array, " J"],
    observations: SessionReports,
    confidence: Float[Array, "... S A"],
    pairs: Float[Array, "n L S A"],
) -> ReportStatistic:
    """Summarise a session's observations under a posterior ``pairs`` over truths."""
    terms = _terms(classes, logits)
    parts = _likelihood(classes, terms, observations, confidence)
    mass = pairs * observations.seen[..., None, None]
    plain = jnp.where(parts.plain > 0, classes.gather(jnp.where(parts.scored, 0.0, mass)), 0.0)
    possible = parts.scored & (parts.total > 0)
    share = jnp.where(possible, mass / jnp.where(possible, parts.total, 1.0), 0.0)
    wrong = classes.gather(jnp.sum(share * parts.wrong, axis=(0, 1)))
    # Wrong observations: all pairs that the observation may be, less the truth itself.
    blame = share * (1 - parts.confidence) * (terms.possible / terms.others)[classes.of_pair]
    rate = plain / jnp.where(parts.plain > 0, parts.plain * terms.total, 1.0)
    agreed = _by_pattern(classes, observations, rate + classes.gather(blame))
    agreed = (agreed - classes.itself * jnp.sum(blame * observations.same)) * terms.by_pattern
    size = jnp.sum(observations.seen).astype(float)
    per_observation = 1 / jnp.maximum(size, 1.0)
    scores, scored = score_statistic(observations)
    return ReportStatistic(
        size,
        plain.sum((0, 1)) * per_observation,
        wrong * per_observation,
        jnp.sum(share * parts.right) * per_observation,
        jnp.maximum(agreed, 0.0) @ classes.patterns * per_observation,
        scores * per_observation,
        scored * per_observation,
    )


# -- the program --------------------------------------------------------------------------------------


@shown_briefly
class SensorFit(NamedTuple):
    """Reliabilities fitted to the statistic.

    Fields
    ------
    logits : float ``[J]``
    agreement : float ``[J]``
        Expected agreement of observations with their truths: the statistic's, to within the slack.
    iterations : int
    """

    logits: Float[Array, " J"]
    agreement: Float[Array, " J"]
    iterations: Int[Array, ""]


def _moments(
    classes: ReportClasses, statistic: ReportStatistic, logits: Float[Array, " J"]
) -> tuple[Float[Array, ""], Float[Array, " J"], Float[Array, "J J"]]:
    """Return ``sum_g plain_g log Z_g + sum_g wrong_g log Z'_g``, its gradient (agreement) and curvature."""
    exponents = classes.patterns @ logits
    highest = exponents.max()
    terms = jnp.exp(exponents - highest)
    value, mean = jnp.zeros(()), jnp.zeros(len(logits))
    curvature = jnp.zeros((len(logits), len(logits)))
    for truths, choices in ((statistic.plain, classes.choices), (statistic.wrong, classes.wrong_choices)):
        # A truth without alternatives has no weight.
        total = choices @ terms
        weight, total = jnp.where(total > 0, truths, 0.0), jnp.where(total > 0, total, 1.0)
        share = choices * terms / total[:, None]
        means = share @ classes.patterns
        value += weight @ (jnp.log(total) + highest)
        mean += weight @ means
        curvature += (classes.patterns.T * (weight @ share)) @ classes.patterns - (means.T * weight) @ means
    return value, mean, curvature


def _quadratic_in_box(
    curvature: Float[Array, "J J"],
    slope: Float[Array, " J"],
    slack: Float[Array, " J"],
    origin: Float[Array, " J"],
    tolerance: float,
) -> Float[Array, " J"]:
    """Solve :func:`~i2rl.inference.programs.maximum_entropy.quadratic_l1` for weights within ``LIMIT``.

    ``origin`` is within it. Weights at a limit are guessed and the others solved for; coordinate descent
    corrects the guess.
    """
    damping = 1e-8 * jnp.max(jnp.diag(curvature)) + 1e-200
    damped = curvature + damping * jnp.eye(len(slope))

    def value(w: Array) -> Array:
        move = w - origin
        return slope @ move + 0.5 * move @ (damped @ move) + slack @ jnp.abs(w)

    def coordinate(k: Array, w: Array) -> Array:
        free = w[k] - (slope[k] + damped[k] @ (w - origin)) / damped[k, k]
        shrunk = jnp.sign(free) * jnp.maximum(jnp.abs(free) - slack[k] / damped[k, k], 0.0)
        return w.at[k].set(jnp.clip(shrunk, -LIMIT, LIMIT))

    def improve(carry: tuple) -> tuple:
        w, _, count = carry
        gradient = slope + damped @ (w - origin)
        held = (jnp.abs(w) >= LIMIT) & (gradient * jnp.sign(w) + slack <= 0)
        block = jnp.where(held[:, None] | held, jnp.eye(len(slope)), curvature)
        pull = jnp.where(held, 0.0, slope + damped @ jnp.where(held, w - origin, 0.0))
        aim = quadratic_l1(
            block, pull, jnp.where(held, 0.0, slack), jnp.where(held, w, origin), jnp.asarray(tolerance)
        )
        aim = jnp.clip(aim, -LIMIT, LIMIT)
        w = jnp.where(value(aim) <= value(w), aim, w)
        left = _residual(slope + damped @ (w - origin), slack, w)
        w = lax.cond(left > tolerance, lambda w: lax.fori_loop(0, len(slope), coordinate, w), lambda w: w, w)
        return w, left, count + 1

    def unfinished(carry: tuple) -> Array:
        _, left, count = carry
        return (left > tolerance) & (count < _MAX_SWEEPS)

    return lax.while_loop(unfinished, improve, (origin, jnp.array(jnp.inf), 0))[0]


def _residual(gradient: Array, slack: Array, logits: Array) -> Array:
    """Return zero if no step within the limits would help."""
    step = logits - gradient
    step = jnp.sign(step) * jnp.maximum(jnp.abs(step) - slack, 0.0)
    return jnp.max(jnp.abs(jnp.clip(step, -LIMIT, LIMIT) - logits))


# Compiled by itself, too: a session whose reward program is solved outside JAX calls it from there.
@jax.jit
def fit_sensor(
    classes: ReportClasses,
    statistic: ReportStatistic,
    slack: Float[Array, ""] | float,
    start: Float[Array, " J"],
    tolerance: float = 1e-8,
) -> SensorFit:
    """Solve the observation program's dual by proximal Newton, traceable by JAX.

    The program is that of :class:`~i2rl.inference.programs.observation.ObservationProgram`.

    It minimises ``sum_g plain_g log Z_g + sum_g wrong_g log Z'_g - logits.matches + slack |logits|`` with
    ``Z'`` over the pairs other than the truth. ``slack`` is the largest distance of the expected agreement
    from the statistic's; one error in a hundred observations is a slack of 0.01. Logits stay within
    ``LIMIT``.
    """
    matches = statistic.matches
    beta = jnp.broadcast_to(jnp.asarray(slack, float), matches.shape)

    def expand(logits: Float[Array, " J"]) -> tuple:
        value, mean, curvature = _moments(classes, statistic, logits)
        return value - logits @ matches + beta @ jnp.abs(logits), mean - matches, curvature

    def improve(carry: tuple) -> tuple:
        logits, (value, gradient, curvature), _, count = carry
        aim = _quadratic_in_box(curvature, gradient, beta, logits, tolerance / 10)

        def shorter(trial: tuple) -> tuple:
            length, _, _ = trial
            point = logits + length / 2 * (aim - logits)
            return length / 2, point, expand(point)

        def worse(trial: tuple) -> Array:
            length, _, (there, *_) = trial
            return ~(there <= value + 1e-14 * jnp.abs(value)) & (length > 0.5**_MAX_HALVINGS)

        _, point, there = lax.while_loop(worse, shorter, (jnp.ones(()), aim, expand(aim)))
        better = there[0] <= value + 1e-14 * jnp.abs(value)
        point = jnp.where(better, point, logits)
        there = jax.tree.map(lambda a, b: jnp.where(better, a, b), there, (value, gradient, curvature))
        left = jnp.where(better, _residual(there[1], beta, point), 0.0)
        return point, there, left, count + 1

    def unfinished(carry: tuple) -> Array:
        _, _, left, count = carry
        return (left > tolerance) & (count < _MAX_STEPS)

    first = jnp.clip(start, -LIMIT, LIMIT)
    expansion = expand(first)
    begun = (first, expansion, _residual(expansion[1], beta, first), jnp.zeros((), int))
    logits, (_, gradient, _), _, count = lax.while_loop(unfinished, improve, begun)
    return SensorFit(logits, _share(statistic, gradient + matches), count)


def agreement_of(
    classes: ReportClasses, logits: Float[Array, " J"], statistic: ReportStatistic
) -> Float[Array, " J"]:
    """Return expected agreement ``[J]`` of observations with truths distributed as in the statistic."""
    return _share(statistic, _moments(classes, statistic, logits)[1])


def _share(statistic: ReportStatistic, mean: Float[Array, " J"]) -> Float[Array, " J"]:
    """Return the agreement per observation, given that of plain and wrong ones; NaN before any."""
    total = jnp.sum(statistic.plain) + jnp.sum(statistic.wrong) + statistic.right
    return (mean + statistic.right) / jnp.where(statistic.size > 0, total, jnp.nan)
