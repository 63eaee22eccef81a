"""The simulated line against exact expectations, worked out here by enumeration."""

from functools import cache
from math import comb, isnan

import jax
import numpy as np
import pytest
from scipy import stats

from i2rl.domains.sorting.line import Line, Tally, sort_belts, wilson
from i2rl.domains.sorting.process import pick_inspect_place, sorting_with_claiming, sorting_without_claiming

PIP, RPP, STAY = range(3)
BELTS = 2000


def tally(behaviour: int, line: Line = Line(), *, seed: int = 0, belts: int = BELTS) -> Tally:  # noqa: B008
    sorting = sorting_with_claiming()
    return sort_belts(jax.random.key(seed), sorting, sorting.expert_policy(behaviour), belts, line)


def agrees(counts: np.ndarray, expected: float) -> bool:
    """Test whether an exact expectation lies within four standard errors of a simulated mean."""
    return abs(counts.mean() - expected) < 4 * counts.std(ddof=1) / np.sqrt(len(counts)) + 1e-12


@pytest.mark.parametrize("behaviour", [PIP, RPP, STAY])
def test_no_onion_is_lost(behaviour):
    tp, fp, tn, fn = tally(behaviour)
    np.testing.assert_array_equal(tp + fn, 12)
    np.testing.assert_array_equal(fp + tn, 12)
    assert min(tp.min(), fp.min(), tn.min(), fn.min()) >= 0


# -- exact expectations --------------------------------------------------------------------------------


def expected_of_picking(line: Line) -> np.ndarray:
    """Exact mean (TP, FP) of one set: onions are picked, inspected and placed until time is over."""
    seconds = {
        "pick": line.pick_seconds,
        "inspect": line.inspect_seconds,
        "bin": line.place_seconds,
        "back": line.place_seconds,
        "claim": line.claim_seconds,
    }

    @cache
    def ahead(phase: str, clock: float, bad: int, good: int, blemished: bool) -> tuple[float, float]:
        """From before an action; ``bad`` and ``good`` onions on the table beside the claimed one."""
        clock += seconds[phase]
        if clock > line.set_seconds:
            return 0.0, 0.0
        stays = np.array(ahead(phase, clock, bad, good, blemished)) * line.slip

        def claimed(phase: str) -> np.ndarray:
            """Claim a random other onion."""
            left, total = bad + good, np.zeros(2)
            if bad:
                total += bad / left * np.array(ahead(phase, clock, bad - 1, good, True))
            if good:
                total += good / left * np.array(ahead(phase, clock, bad, good - 1, False))
            return total

        if phase == "claim":
            moves = claimed("pick") if bad + good else np.zeros(2)
        elif phase == "pick":
            moves = np.array(ahead("inspect", clock, bad, good, blemished))
        elif phase == "inspect":
            binned = line.inspection if blemished else 1 - line.inspection
            moves = binned * np.array(ahead("bin", clock, bad, good, blemished))
            moves = moves + (1 - binned) * np.array(ahead("back", clock, bad, good, blemished))
        elif phase == "back":
            moves = claimed("pick") if bad + good else np.zeros(2)
        else:
            # Which onion the claim after binning takes is settled when it is over.
            moves = np.array([blemished, not blemished], float)
            moves = moves + np.array(ahead("claim", clock, bad, good, False))
        one, other = stays + (1 - line.slip) * moves
        return float(one), float(other)

    bad, good = line.blemished, line.onions - line.blemished
    total = np.zeros(2)
    if bad:
        total += bad / line.onions * np.array(ahead("pick", 0.0, bad - 1, good, True))
    if good:
        total += good / line.onions * np.array(ahead("pick", 0.0, bad, good - 1, False))
    return total


def expected_of_rolling(line: Line) -> np.ndarray:
    """Exact mean (TP, FP) of one set: roll, then claim, pick and bin what is listed, and roll again."""
    seconds = {
        "roll": line.roll_seconds,
        "pick": line.pick_seconds,
        "bin": line.place_seconds,
        "claim": line.claim_seconds,
    }

    def chance(k: int, n: int, p: float) -> float:
        return comb(n, k) * p**k * (1 - p) ** (n - k)

    @cache
    def ahead(
        phase: str, clock: float, bad: int, good: int, rightly: int, wrongly: int
    ) -> tuple[float, float]:
        clock += seconds[phase]
        if clock > line.set_seconds or not bad + good:
            return 0.0, 0.0
        total = line.slip * np.array(ahead(phase, clock, bad, good, rightly, wrongly))
        done = 1 - line.slip
        if phase == "roll":
            for i in range(bad + 1):
                for j in range(good + 1):
                    p = chance(i, bad, line.rolling) * chance(j, good, 1 - line.rolling)
                    total += done * p * np.array(ahead("pick" if i + j else "roll", clock, bad, good, i, j))
        elif phase == "bin":
            listed = rightly + wrongly
            following = "claim" if listed > 1 else "roll"
            if rightly:
                later = ahead(following, clock, bad - 1, good, rightly - 1, wrongly)
                total += done * rightly / listed * (np.array([1, 0]) + later)
            if wrongly:
                later = ahead(following, clock, bad, good - 1, rightly, wrongly - 1)
                total += done * wrongly / listed * (np.array([0, 1]) + later)
        else:
            following = {"claim": "pick", "pick": "bin"}[phase]
            total += done * np.array(ahead(following, clock, bad, good, rightly, wrongly))
        one, other = total
        return float(one), float(other)

    return np.array(ahead("roll", 0.0, line.blemished, line.onions - line.blemished, 0, 0))


LINES = [Line(), Line(slip=0.3, rolling=0.85, inspection=0.8, blemished=5, set_seconds=97.0)]


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize(("behaviour", "oracle"), [(PIP, expected_of_picking), (RPP, expected_of_rolling)])
def test_means_are_the_enumerated_ones(behaviour, oracle, line):
    found = tally(behaviour, line)
    tp, fp = line.sets * oracle(line)
    assert agrees(found.true_positives, tp)
    assert agrees(found.false_positives, fp)


def test_experts_are_near_their_row_of_the_table():
    # Expectations, so nothing is left to chance; precision 100 and recall 58.3, 69.2 and 75.
    tp, fp = expected_of_picking(Line())
    assert tp / (tp + fp) > 0.94
    assert abs(tp / 4 - 7 / 12) < 0.02
    tp, fp = expected_of_rolling(Line())
    assert abs(tp / (tp + fp) - 9 / 13) < 0.02
    assert abs(tp / 4 - 9 / 12) < 0.02


# -- limits ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("behaviour", [PIP, RPP])
def test_perfect_perception_and_time_enough_sort_perfectly(behaviour):
    found = tally(behaviour, Line(set_seconds=2000, inspection=1.0, rolling=1.0), belts=100)
    assert found.means == (12, 0, 12, 0)
    assert found.precision().value == found.recall().value == 1
    # A hundred belts are not certainty.
    assert 0.99 < found.precision().low < 1


@pytest.mark.parametrize("behaviour", [PIP, RPP])
def test_guessing_has_precision_one_half(behaviour):
    found = tally(behaviour, Line(inspection=0.5, rolling=0.5))
    assert agrees(found.true_positives - found.false_positives, 0)
    assert found.true_positives.sum() > 1000
    precision = found.precision(0.9999)
    assert precision.low < 0.5 < precision.high


@pytest.mark.parametrize("behaviour", [PIP, RPP])
def test_more_time_never_sorts_fewer(behaviour):
    before = np.zeros(BELTS, int)
    means = []
    for seconds in (5, 30, 65, 66, 120, 400):
        found = tally(behaviour, Line(set_seconds=seconds))
        binned = found.true_positives + found.false_positives
        assert (binned >= before).all()
        before = binned
        means.append(binned.mean())
    assert means[0] == 0
    assert means[1] < means[2] < means[4]


def test_claiming_for_ever_sorts_nothing():
    found = tally(STAY, belts=50)
    assert found.means == (0, 0, 12, 12)
    assert all(isnan(x) for x in found.precision())
    recall = found.recall()
    assert recall.value == recall.low == 0 < recall.high < 0.01


def test_onions_put_back_are_not_claimed_again():
    # All are thought good; were they claimed again, hours of inspection would bin a wrongly judged one.
    found = tally(PIP, Line(set_seconds=5000, inspection=0.95, blemished=0, sets=1))
    binned = found.false_positives
    assert stats.binomtest(int(binned.sum()), 8 * BELTS, 0.05).pvalue > 1e-3


# -- predictions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("blemished", "chance"), [(1, 0.9), (0, 0.1)])
def test_inspection_is_right_as_often_as_said(blemished, chance):
    found = tally(PIP, Line(sets=1, onions=1, blemished=blemished, inspection=0.9, slip=0.0))
    binned = int((found.true_positives + found.false_positives).sum())
    assert stats.binomtest(binned, BELTS, chance).pvalue > 1e-3


def test_rolling_judges_each_onion_by_itself():
    # Time for one roll and for binning all that it can list.
    found = tally(RPP, Line(sets=1, roll_seconds=100, set_seconds=199, slip=0.0))
    joint = np.histogram2d(found.true_positives, found.false_positives, bins=(range(6), range(6)))[0]
    law = np.outer(stats.binom.pmf(range(5), 4, 0.7), stats.binom.pmf(range(5), 4, 0.3))
    common = law * BELTS > 5
    observed = np.append(joint[common], joint[~common].sum())
    expected = np.append(law[common], law[~common].sum()) * BELTS
    assert stats.chisquare(observed, expected).pvalue > 1e-3


def test_slips_cost_time():
    line = Line(sets=1, onions=1, blemished=1, inspection=1.0, set_seconds=11.0, slip=0.2)
    # Pick, inspect, place: there is no second to spare.
    assert stats.binomtest(int(tally(PIP, line).true_positives.sum()), BELTS, 0.8**3).pvalue > 1e-3
    assert not tally(PIP, line._replace(set_seconds=10.9)).true_positives.any()
    assert tally(PIP, line._replace(slip=0.0)).true_positives.all()


# -- interface ------------------------------------------------------------------------------------------


def test_the_same_behaviour_sorts_alike_in_every_process():
    belts = [
        sort_belts(jax.random.key(2), sorting, sorting.expert_policy(PIP), 200)
        for sorting in (sorting_with_claiming(), sorting_without_claiming(), pick_inspect_place())
    ]
    for other in belts[1:]:
        np.testing.assert_array_equal(other, belts[0])


def test_a_mixed_policy_lies_between():
    sorting = sorting_with_claiming()
    mixed = (sorting.expert_policy(PIP) + sorting.expert_policy(STAY)) / 2
    half = sort_belts(jax.random.key(0), sorting, mixed, BELTS).recall().value
    assert 0 < half < tally(PIP).recall().value


def test_belts_depend_on_key_and_number_alone():
    few, many = tally(RPP, belts=7), tally(RPP, belts=20)
    np.testing.assert_array_equal(np.array(many)[:, :7], few)
    assert (np.array(tally(RPP, belts=20, seed=1)) != np.array(many)).any()


def test_intervals_cover():
    runs = np.concatenate([np.array(tally(RPP, seed=seed)) for seed in range(20)], axis=1)
    truth_tp, truth_fp = expected_of_rolling(Line())
    for name, truth in (("precision", truth_tp / (truth_tp + truth_fp)), ("recall", truth_tp / 4)):
        intervals = [getattr(Tally(*run), name)() for run in runs.reshape(4, 200, 200).swapaxes(0, 1)]
        covered = sum(low <= truth <= high for _, low, high in intervals)
        assert stats.binomtest(covered, 200, 0.95).pvalue > 1e-3
        width = np.mean([high - low for _, low, high in intervals])
        spread = np.std([value for value, *_ in intervals])
        assert width == pytest.approx(2 * 1.96 * spread, rel=0.2)


def test_wilson_is_the_textbook_interval():
    share = wilson(7, 12)
    low, high = stats.binomtest(7, 12).proportion_ci(method="wilson")
    assert share == pytest.approx((7 / 12, low, high))
    assert all(isnan(x) for x in wilson(0, 0))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"onions": 0}, "onions=0"),
        ({"blemished": 9}, "blemished=9"),
        ({"sets": 0}, "sets=0"),
        ({"inspection": 1.2}, "inspection is a probability"),
        ({"rolling": float("nan")}, "rolling is a probability"),
        ({"slip": -0.1}, "slip is a probability"),
        ({"claim_seconds": 0.0}, "claim_seconds must be positive"),
        ({"set_seconds": float("inf")}, "set_seconds must be positive and finite"),
    ],
)
def test_impossible_lines(change, complaint):
    with pytest.raises(ValueError, match=complaint):
        tally(PIP, Line()._replace(**change), belts=1)


def test_impossible_policies():
    sorting = sorting_with_claiming()
    key, expert = jax.random.key(0), sorting.expert_policy(PIP)
    with pytest.raises(ValueError, match=r"shape \[S, A\] = \(26, 7\), got \(22, 7\)"):
        sort_belts(key, sorting, pick_inspect_place().expert_policy(0))
    with pytest.raises(ValueError, match="sum one"):
        sort_belts(key, sorting, expert * 2)
    wrong = expert.copy()
    wrong[1] = np.eye(7)[5]
    with pytest.raises(ValueError, match="'roll' in 'unknown held"):
        sort_belts(key, sorting, wrong)
    with pytest.raises(ValueError, match="at least one belt"):
        sort_belts(key, sorting, expert, 0)
