"""Reports of perception: evidence and statistic against enumeration, the program against other solvers."""

from itertools import product
from typing import NamedTuple

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from i2rl.inference.programs.observation import ObservationProgram, unidentified_predicates
from i2rl.inference.sensors.observations import (
    CERTAIN,
    LIMIT,
    ReportStatistic,
    agreement_of,
    fit_sensor,
    no_reports,
    report_classes,
    report_log_evidence,
    report_statistic,
    session_reports,
)
from i2rl.models import Demonstration, FeatureNoise
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN

S, A = 4, 2
SA = S * A
VIEW = np.array([1.0, 0.4, 0.7, 0.0])
# A predicate, a label, and a predicate that makes two pairs equal in everything.
FEATURES = np.array(
    [[[0, 1], [0, 1], [0, 1], [0, 1]], [[0, 0], [0, 0], [1, 1], [2, 2]], [[1, 1], [1, 0], [0, 0], [1, 1]]]
)
LOGITS = np.array([1.1, 0.6, -0.4])
# One of the two equal pairs cannot be observed, nor can one without an equal.
MASK = np.array([[0, 1], [1, 1], [1, 1], [0, 1]], bool)
EVERYTHING = np.ones((S, A), bool)
MODES = ["none", "stepwise", "averaged"]
ROWS = [
    [(SEEN, 0, 1, 0.8), (SEEN, 1, 0, 0.0), (SEEN, 2, UNKNOWN, 0.6), (HIDDEN, UNKNOWN, UNKNOWN, np.nan)],
    [(SEEN, 1, 0, np.nan), (LOST, UNKNOWN, UNKNOWN, np.nan), (SEEN, UNKNOWN, 1, np.nan), (SEEN, 2, 0, 0.3)],
    [(SEEN, UNKNOWN, UNKNOWN, 0.9), (SEEN, 3, 1, 1.0), (SEEN, 1, 0, 0.55), (PAD, UNKNOWN, UNKNOWN, np.nan)],
]
# Without those that leave something open, which are computed otherwise.
NAMED = [
    [(kind, 2, 1, c) if kind == SEEN and UNKNOWN in (s, a) else (kind, s, a, c) for kind, s, a, c in row]
    for row in ROWS
]

evidence_of, statistic_of, fit = jax.jit(report_log_evidence), jax.jit(report_statistic), jax.jit(fit_sensor)


def demonstration(rows: list) -> Demonstration:
    kind, state, action, score = (
        np.array(x) for x in zip(*np.moveaxis(np.array(rows), -1, 0)[None], strict=True)
    )
    return Demonstration(*(x[0].astype(np.int32) for x in (kind, state, action)), score[0])


def agreements(features: np.ndarray = FEATURES) -> np.ndarray:
    """``[psi_j(o) = psi_j(g)]`` as ``[J, SA, SA]``."""
    psi = features.reshape(len(features), -1)
    return (psi[:, :, None] == psi[:, None]).astype(float)


def tables(logits: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``O(o | g)`` and ``O(o | g, o != g)`` as ``[SA, SA]``, one pair of pairs at a time."""
    p = 1 / (1 + np.exp(-logits))
    psi = FEATURES.reshape(len(FEATURES), -1)
    plain = np.zeros((SA, SA))
    for g, o in product(range(SA), range(SA)):
        plain[g, o] = np.where(psi[:, g] == psi[:, o], p, 1 - p).prod() * mask.ravel()[o]
    wrong = plain * (1 - np.eye(SA))
    return plain / plain.sum(1, keepdims=True), wrong / wrong.sum(1, keepdims=True)


def by_class(classes, pairs: np.ndarray) -> np.ndarray:
    """Sum ``[SA]`` by class to ``[C]``."""
    return np.bincount(np.asarray(classes.of_pair).ravel(), pairs.ravel(), len(classes.reportable))


class Confidences(NamedTuple):
    """Confidences of a mode: the functions' input, and its value at each step and truth, NaN for no score."""

    given: np.ndarray
    everywhere: np.ndarray


def confidences(mode: str, rows: list, mask: np.ndarray) -> Confidences:
    shape = (len(rows), len(rows[0]), SA)
    if mode == "none":
        return Confidences(np.full((1, 1), np.nan), np.full(shape, np.nan))
    if mode == "stepwise":
        score = np.array(
            [
                [np.clip(step[3], 1 - CERTAIN, CERTAIN) if step[0] == SEEN else np.nan for step in row]
                for row in rows
            ]
        )
        return Confidences(score[..., None, None], np.broadcast_to(score[..., None], shape))
    averaged = np.random.default_rng(1).uniform(0.2, 0.95, (S, A))
    averaged[1, 1] = averaged[3, 0] = np.nan
    return Confidences(averaged, np.broadcast_to(averaged.ravel(), shape))


class Happened(NamedTuple):
    """Compute one step's probabilities of truth and observation ``[SA, SA]`` given the truth: by kind of
    observation.
    """

    plain: np.ndarray
    right: np.ndarray
    wrong: np.ndarray


def happened(step: tuple, confidence: np.ndarray, logits: np.ndarray, mask: np.ndarray) -> Happened:
    plain, wrong = tables(logits, mask)
    _, s, a, _ = step
    named = np.array([s in (UNKNOWN, x) and a in (UNKNOWN, y) for x, y in product(range(S), range(A))])
    scored = ~np.isnan(confidence)
    # Truths that cannot be observed have only wrong observations.
    c = np.where(scored & mask.ravel(), confidence, 0.0)[:, None]
    return Happened(
        plain * named * ~scored[:, None], np.eye(SA) * named * c, wrong * named * (1 - c) * scored[:, None]
    )


def enumerated_evidence(rows: list, mode: str, logits: np.ndarray, mask: np.ndarray) -> np.ndarray:
    evidence = np.ones((len(rows), len(rows[0]), SA))
    confidence = confidences(mode, rows, mask).everywhere
    for i, t in np.ndindex(evidence.shape[:2]):
        step = rows[i][t]
        if step[0] == SEEN:
            evidence[i, t] = sum(happened(step, confidence[i, t], logits, mask)).sum(1) * VIEW.repeat(A)
        elif step[0] == HIDDEN:
            evidence[i, t] = 1 - VIEW.repeat(A)
    return evidence


@pytest.fixture(params=["everything", "some"])
def mask(request):
    return EVERYTHING if request.param == "everything" else MASK


@pytest.fixture(params=["open", "named"])
def rows(request):
    return ROWS if request.param == "open" else NAMED


# -- evidence -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_evidence_is_that_of_enumeration_over_reports(mode, mask, rows):
    classes = report_classes(FEATURES, mask)
    reports = session_reports(classes, demonstration(rows), scored=mode != "none")
    assert bool(reports.open) == (rows is ROWS)
    given_, _ = confidences(mode, rows, mask)
    found = evidence_of(classes, LOGITS, reports, given_, VIEW)
    expected = enumerated_evidence(rows, mode, LOGITS, mask).reshape(found.shape)
    np.testing.assert_allclose(np.exp(found), expected, atol=1e-14, rtol=1e-11)


@pytest.mark.parametrize("score", [np.nan, 0.0, 0.3, 1.0])
def test_all_reports_of_a_truth_sum_to_one(score, mask):
    classes = report_classes(FEATURES, mask)
    rows = [[(SEEN, s, a, score) for s, a in product(range(S), range(A))]]
    reports = session_reports(classes, demonstration(rows))
    found = evidence_of(classes, LOGITS, reports, reports.score[..., None, None])
    np.testing.assert_allclose(np.exp(found).sum((0, 1)), 1, atol=1e-12)


def test_where_one_pair_alone_can_be_reported_it_is():
    only = np.zeros((S, A), bool)
    only[2, 1] = True
    classes = report_classes(FEATURES, only)
    reports = session_reports(classes, demonstration([[(SEEN, 2, 1, 0.3)]]))
    found = evidence_of(classes, LOGITS, reports, reports.score[..., None, None])
    np.testing.assert_allclose(found, 0, atol=1e-12)


def test_a_score_of_zero_does_not_rule_out_the_only_truth_there_is():
    classes = report_classes(FEATURES)
    reports = session_reports(classes, demonstration([[(SEEN, 1, 0, 0.0)]]))
    evidence = evidence_of(classes, jnp.asarray(LOGITS), reports, reports.score[..., None, None])
    np.testing.assert_allclose(np.exp(evidence[0, 0, 1, 0]), 1 - CERTAIN)


def test_unscored_evidence_is_that_of_noise_on_features(mask):
    classes = report_classes(FEATURES, mask)
    reports = session_reports(classes, demonstration(ROWS), scored=False)
    found = report_log_evidence(classes, jnp.asarray(LOGITS), reports, jnp.full((1, 1), jnp.nan))
    reading = FeatureNoise(FEATURES, 1 / (1 + np.exp(-LOGITS)), mask).noise
    for i, t in ((0, 0), (0, 2), (1, 2), (2, 0)):
        _, state, action, score = ROWS[i][t]
        expected = reading.log_likelihood(jnp.array(state), jnp.array(action), jnp.array(score))
        np.testing.assert_allclose(found[i, t], expected, atol=1e-12)


# -- statistic ----------------------------------------------------------------------------------------


def posterior(rows: list, mode: str, logits: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Compute the posterior of the truth at each step, under an uneven prior."""
    joint = enumerated_evidence(rows, mode, logits, mask) * np.linspace(0.5, 2.0, SA)
    return joint / joint.sum(2, keepdims=True)


@pytest.mark.parametrize("mode", MODES)
def test_the_statistic_is_that_of_enumeration_over_truths_and_reports(mode, mask, rows):
    classes = report_classes(FEATURES, mask)
    reports = session_reports(classes, demonstration(rows), scored=mode != "none")
    given_, everywhere = confidences(mode, rows, mask)
    pairs = posterior(rows, mode, LOGITS, mask)
    found = statistic_of(classes, LOGITS, reports, given_, pairs.reshape(3, 4, S, A))
    plain, wrong, right, agreed = np.zeros((SA, SA)), np.zeros((SA, SA)), 0.0, np.zeros(len(FEATURES))
    size = 0
    for i, t in np.ndindex(3, 4):
        if rows[i][t][0] != SEEN:
            continue
        size += 1
        parts = happened(rows[i][t], everywhere[i, t], LOGITS, mask)
        likelihood = sum(parts).sum(1)[:, None]
        rate = np.divide(pairs[i, t][:, None], likelihood, out=np.zeros((SA, 1)), where=likelihood > 0)
        plain += rate * parts.plain
        wrong += rate * parts.wrong
        right += (rate * parts.right).sum()
        agreed += (agreements() * rate * sum(parts)).sum((1, 2))
    assert float(found.size) == size == 9
    np.testing.assert_allclose(found.plain, by_class(classes, plain.sum(1)) / size, atol=1e-12)
    np.testing.assert_allclose(found.wrong, by_class(classes, wrong.sum(1)) / size, atol=1e-12)
    assert float(found.right) == pytest.approx(right / size, abs=1e-12)
    assert float(found.plain.sum() + found.wrong.sum() + found.right) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(found.agreement, agreed / size, atol=1e-12)


def test_scores_are_averaged_by_the_pair_reported():
    classes = report_classes(FEATURES)
    reports = session_reports(classes, demonstration(ROWS))
    pairs = np.full((3, 4, S, A), 1 / SA)
    found = statistic_of(classes, LOGITS, reports, reports.score[..., None, None], pairs)
    # Those that leave something open have no part.
    expected = np.full((S, A), np.nan)
    expected[0, 1], expected[1, 0], expected[2, 0], expected[3, 1] = (
        0.8,
        (0.55 + 1 - CERTAIN) / 2,
        0.3,
        CERTAIN,
    )
    np.testing.assert_allclose(found.confidence, expected)


def test_before_any_report_nothing_is_known():
    classes = report_classes(FEATURES)
    nothing = no_reports(classes)
    assert np.isnan(nothing.agreement).all()
    assert np.isnan(nothing.confidence).all()
    solved = fit(classes, nothing, 0.1, LOGITS)
    assert np.isfinite(solved.logits).all()
    assert np.isnan(solved.agreement).all()


@pytest.mark.parametrize("mode", MODES)
def test_expected_matches_are_the_slope_of_the_likelihood(mode):
    """Fisher's identity: matches found less matches expected, by finite differences of the likelihood."""
    classes = report_classes(FEATURES, MASK)
    reports = session_reports(classes, demonstration(ROWS), scored=mode != "none")
    given_, _ = confidences(mode, ROWS, MASK)
    prior = np.linspace(0.5, 2.0, SA).reshape(S, A)

    def log_likelihood(logits):
        evidence = np.exp(evidence_of(classes, logits, reports, given_, VIEW))
        return np.log((evidence * prior).sum((2, 3))).sum()

    pairs = posterior(ROWS, mode, LOGITS, MASK).reshape(3, 4, S, A)
    found = statistic_of(classes, LOGITS, reports, given_, pairs)
    slope = found.size * (found.agreement - agreement_of(classes, jnp.asarray(LOGITS), found))
    steps = 1e-5 * np.eye(3)
    differences = [(log_likelihood(LOGITS + h) - log_likelihood(LOGITS - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(slope, differences, atol=1e-8)


# -- program ------------------------------------------------------------------------------------------


class Problem(NamedTuple):
    """Compute shares of plain and of wrong observations, truth first ``[SA, SA]``, and of right ones."""

    plain: np.ndarray
    wrong: np.ndarray
    right: float
    mask: np.ndarray

    @property
    def matches(self) -> np.ndarray:
        return (agreements() * (self.plain + self.wrong)).sum((1, 2))

    def statistic(self, classes) -> ReportStatistic:
        return no_reports(classes)._replace(
            size=jnp.array(50.0),
            plain=jnp.asarray(by_class(classes, self.plain.sum(1))),
            wrong=jnp.asarray(by_class(classes, self.wrong.sum(1))),
            right=jnp.array(self.right),
            matches=jnp.asarray(self.matches),
        )

    def expected(self, logits: np.ndarray) -> np.ndarray:
        """Compute the matches of plain and wrong observations under these reliabilities."""
        plain, wrong = tables(logits, self.mask)
        joint = self.plain.sum(1)[:, None] * plain + self.wrong.sum(1)[:, None] * wrong
        return (agreements() * joint).sum((1, 2))

    def dual(self, split: np.ndarray, slack: float) -> tuple[float, np.ndarray]:
        """Value and gradient in positive and negative parts of logits, over all pairs of pairs."""
        logits = split[:3] - split[3:]
        terms = np.exp(np.tensordot(logits, agreements(), 1)) * self.mask.ravel()
        value = self.plain.sum(1) @ np.log(terms.sum(1))
        value += self.wrong.sum(1) @ np.log((terms * (1 - np.eye(SA))).sum(1))
        gradient = self.expected(logits) - self.matches
        return value - logits @ self.matches + slack * split.sum(), np.concatenate(
            [gradient, -gradient]
        ) + slack


def problem(seed: int, mask: np.ndarray, scored: float = 0.6, clarity: float = 0.0) -> Problem:
    """Draw observations; with ``clarity`` one all but the scored and wrong are right in every predicate."""
    rng = np.random.default_rng(seed)
    said = mask.ravel()
    plain = rng.dirichlet(np.ones(SA), SA) * (1 - clarity) + clarity * agreements().all(0)
    wrong = rng.dirichlet(np.ones(SA), SA) * (1 - np.eye(SA))
    # A truth unlike every possible observation has a uniform observation.
    plain, wrong = (x * said + 1e-6 * said * (1 - np.eye(SA)) for x in (plain, wrong))
    plain, wrong = (x / x.sum(1, keepdims=True) for x in (plain, wrong))
    truths = rng.dirichlet(np.ones(SA), 2)
    right = scored * rng.uniform(0.2, 0.8)
    return Problem(
        (1 - scored) * truths[0][:, None] * plain, (scored - right) * truths[1][:, None] * wrong, right, mask
    )


def by_scipy(case: Problem, slack: float) -> np.ndarray:
    found = minimize(
        case.dual,
        np.zeros(6),
        (slack,),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0, LIMIT)] * 6,
        options={"maxiter": 5000, "maxfun": 20000, "ftol": 1e-16, "gtol": 1e-11, "maxcor": 30},
    )
    return found.x[:3] - found.x[3:]


@pytest.mark.parametrize("scored", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("slack", [0.0, 0.02])
def test_three_solvers_of_the_program_agree(scored, slack, mask):
    classes, program = report_classes(FEATURES, mask), ObservationProgram(FEATURES, mask)
    for seed in range(3):
        case = problem(seed, mask, scored)
        statistic, share = case.statistic(classes), 1 - case.right
        found = fit(classes, statistic, slack, np.zeros(3))
        explicit = by_scipy(case, slack)
        weights, wrong = (x.sum(1).reshape(S, A) for x in (case.plain, case.wrong))
        solution = program.solve(weights, case.matches / share, slack / share, wrong=wrong)
        np.testing.assert_allclose(case.expected(found.logits), case.expected(explicit), atol=1e-6)
        np.testing.assert_allclose(solution.agreement * share, case.expected(explicit), atol=1e-6)
        np.testing.assert_allclose(found.agreement, case.expected(explicit) + case.right, atol=1e-6)
        np.testing.assert_allclose(found.logits, explicit, atol=1e-4)
        np.testing.assert_allclose(solution.logits, explicit, atol=1e-4)
        assert solution.gap.max() < 1e-7


def test_wrong_reports_are_of_greatest_entropy():
    case = problem(5, MASK)
    share, said = 1 - case.right, MASK.ravel()
    truths = [case.plain.sum(1) / share, case.wrong.sum(1) / share]
    o = [cp.Variable((SA, SA), nonneg=True) for _ in truths]
    joint = [cp.multiply(w[:, None], x) for w, x in zip(truths, o, strict=True)]
    program = cp.Problem(
        cp.Maximize(sum(cp.sum(cp.multiply(w[:, None], cp.entr(x))) for w, x in zip(truths, o, strict=True))),
        [cp.sum(x, axis=1) == 1 for x in o]
        + [x[:, ~said] == 0 for x in o]
        + [cp.diag(o[1])[said] == 0]
        + [
            sum(cp.sum(cp.multiply(agree, x)) for x in joint) == matches / share
            for agree, matches in zip(agreements(), case.matches, strict=True)
        ],
    )
    program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
    solution = ObservationProgram(FEATURES, MASK).solve(
        truths[0].reshape(S, A), case.matches / share, wrong=truths[1].reshape(S, A)
    )
    plain, wrong = tables(solution.logits, MASK)
    np.testing.assert_allclose(o[0].value, plain, atol=1e-4)
    np.testing.assert_allclose(o[1].value, wrong, atol=1e-4)
    assert solution.entropy == pytest.approx(program.value, abs=1e-6)


@given(
    st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.1]), st.sampled_from([0.0, 0.9, 1.0]), st.booleans()
)
@settings(max_examples=60, deadline=None)
def test_reliabilities_explain_the_statistic_and_no_direction_leads_down(seed, slack, clarity, everything):
    mask = EVERYTHING if everything else MASK
    case = problem(seed, mask, 0.5 * (seed % 3), clarity)
    solved = fit(
        report_classes(FEATURES, mask), case.statistic(report_classes(FEATURES, mask)), slack, np.full(3, 1.0)
    )
    logits = np.asarray(solved.logits)
    gap = case.expected(logits) - case.matches
    inside = np.abs(logits) < LIMIT
    assert (np.abs(logits) <= LIMIT).all()
    assert (np.abs(gap[inside]) <= slack + 1e-7).all()
    moved = inside & (logits != 0)
    np.testing.assert_allclose(gap[moved], -slack * np.sign(logits[moved]), atol=1e-7)
    # At the limit more of the same would help.
    assert (gap[~inside] * np.sign(logits[~inside]) <= -slack + 1e-7).all()
    np.testing.assert_allclose(solved.agreement, case.expected(logits) + case.right, atol=1e-10)


def test_expected_agreement_is_the_slope_of_the_partition_functions():
    classes, case = report_classes(FEATURES, MASK), problem(3, MASK)
    steps = 1e-5 * np.eye(3)

    def value(logits):
        return case.dual(np.concatenate([logits, np.zeros(3)]), 0.0)[0] + logits @ case.matches

    slope = [(value(LOGITS + h) - value(LOGITS - h)) / 2e-5 for h in steps]
    found = agreement_of(classes, jnp.asarray(LOGITS), case.statistic(classes))
    np.testing.assert_allclose(found, np.array(slope) + case.right, atol=1e-8)


def test_equal_predicates_share_what_is_known_of_them():
    features = np.concatenate([FEATURES, 1 - FEATURES[:1]])
    classes, case = report_classes(features), problem(1, EVERYTHING)
    doubled = case.statistic(classes)._replace(matches=jnp.asarray(case.matches[[0, 1, 2, 0]]))
    found = fit(classes, doubled, 0.0, np.zeros(4)).logits
    alone = fit(report_classes(FEATURES), case.statistic(report_classes(FEATURES)), 0.0, np.zeros(3)).logits
    np.testing.assert_allclose(found, [alone[0] / 2, alone[1], alone[2], alone[0] / 2], atol=1e-6)


def test_what_only_wrong_reports_tell_is_identified_by_them():
    # Three exclusive pairs: plain observations are of the third, wrong ones of the first.
    features = np.arange(3)[:, None] == np.arange(3)[:, None, None]
    plain, wrong = np.array([[0.0], [0.0], [1.0]]), np.array([[1.0], [0.0], [0.0]])
    assert unidentified_predicates(features, plain).groups == ((0, 1, 2),)
    # For the first the second is taken or the third, by the odds of their predicates.
    odds = np.array([0, 1, -1]) / np.sqrt(2)
    alone = unidentified_predicates(features, 0 * plain, wrong=wrong)
    np.testing.assert_allclose(alone.identified, np.outer(odds, odds), atol=1e-9)
    assert (alone.uninformative, alone.groups) == ((0,), ((1, 2),))
    told = unidentified_predicates(features, plain, wrong=wrong)
    np.testing.assert_allclose(told.identified, np.eye(3), atol=1e-9)
    solution = ObservationProgram(features).solve(plain, [0.9, 0.8, 0.7], wrong=wrong)
    np.testing.assert_allclose(solution.identification.identified, told.identified, atol=1e-9)


def test_bad_input_is_refused_in_its_own_terms():
    with pytest.raises(ValueError, match="whole numbers; predicate 0"):
        report_classes(FEATURES + 0.5)
    with pytest.raises(ValueError, match="reportable must mark at least one"):
        report_classes(FEATURES, ~EVERYTHING)
    program, target = ObservationProgram(FEATURES), np.full(3, 0.6)
    with pytest.raises(ValueError, match=r"\[S, A\] = \[4, 2\], got \[2, 4\]"):
        program.solve(EVERYTHING, target, wrong=np.ones((2, 4)))
    with pytest.raises(ValueError, match="not negative"):
        program.solve(EVERYTHING, target, wrong=-1.0 * EVERYTHING)
    with pytest.raises(ValueError, match="not all zero"):
        program.solve(0 * EVERYTHING, target, wrong=0 * EVERYTHING)
    only = np.zeros((S, A), bool)
    only[2, 1] = True
    with pytest.raises(ValueError, match=r"one pair alone .* weigh 0\.5"):
        ObservationProgram(FEATURES, only).solve(only, target, wrong=only)


def test_what_is_never_misreported_ends_at_the_limit_and_the_rest_is_still_explained():
    """A small patrol: forward is taken for right and right for forward, at known places."""
    n_states, n_actions = 6, 4
    state, action = np.indices((n_states, n_actions))
    features = np.stack([action == 0, action == 1, state < 2, action == 2, state])
    rng = np.random.default_rng(0)
    truths = rng.dirichlet(np.full(state.size, 0.3))
    swapped = np.where(action == 0, 2, np.where(action == 2, 0, action))
    reported = 0.7 * np.eye(state.size) + 0.3 * np.eye(state.size)[(state * n_actions + swapped).ravel()]
    classes = report_classes(features)
    flat = features.reshape(5, -1)
    agree = flat[:, :, None] == flat[:, None]
    statistic = no_reports(classes)._replace(
        size=jnp.array(100.0),
        plain=jnp.asarray(by_class(classes, truths)),
        matches=jnp.asarray((agree * truths[:, None] * reported).sum((1, 2))),
    )
    solved = fit(classes, statistic, 0.0, np.ones(5))
    logits = np.asarray(solved.logits)
    gap = np.asarray(solved.agreement - statistic.agreement)
    limited = np.abs(logits) == LIMIT
    assert limited.any()
    assert not limited.all()
    np.testing.assert_allclose(gap[~limited], 0, atol=1e-7)
    assert (gap[limited] * np.sign(logits[limited]) < 0).all()
