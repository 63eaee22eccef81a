import json
from functools import cache

import jax
import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.analysis.studies.sorting.table import (
    EXPERT,
    HEADINGS,
    PUBLISHED,
    cells,
    print_sorting_table,
    sorting_table_plot,
    sorting_table_summary,
    table_7_2,
)
from i2rl.domains import sorting_with_claiming, sorting_without_claiming

BELTS = 256
# Weights that the baselines learned, hard-coded in the released script: picking, then rolling.
RELEASED = {
    "DPM-BIRL": [
        [.07518, -.46416, -.01859, .43075, -.64150, -.23101, -.09228, .97435, -.05171, .67075, -.97822],
        [.85374, .77131, .25764, .63570, -.49274, -.97124, .57323, -.53363, -.71852, .08800, -.76939],
    ],
    "EM-MLIRL": [
        [.38710, -1, -.46898, .70320, -.85195, -.20946, -1, 1, -.98565, -.69491, -1],
        [-.16447, -.00726, .97438, .16352, -.98574, .00137, .14701, .93283, 1, -.94228, -.99995],
    ],
}  # fmt: skip


@cache
def table():
    """Tabulate true weights rescaled, the behaviours confused, one that never bins, and an unpublished
    method.
    """
    sorting = sorting_with_claiming()
    picking, rolling, claiming = sorting.weights
    learned = {
        "mme-mtirl": np.stack([3 * picking, 7 * rolling]),
        "DPM-BIRL": np.stack([picking, picking]),
        "EM-MLIRL": np.stack([claiming, rolling]),
        "made up": np.stack([sorting.expert_policy(1), sorting.expert_policy(0)]),
    }
    return table_7_2(jax.random.key(0), sorting, learned, belts=BELTS)


def row(method: str, behaviour: int):
    return next(
        r
        for r in table().rows
        if (r.method, r.behaviour) == (method, sorting_with_claiming().behaviours[behaviour])
    )


def test_the_published_percentages_follow_from_the_published_counts():
    printed = {
        EXPERT: ("100.00, 58.33", "69.23, 75.00"),
        "MME-MTIRL": ("87.50, 58.33", "69.23, 75.00"),
        "DPM-BIRL": ("70.00, 58.33", "69.23, 75.00"),
        "EM-MLIRL": ("66.67, 50.00", "60.00, 50.00"),
        "online MME-MTIRL": ("100.00, 66.67", "71.43, 83.33"),
    }
    assert printed.keys() == PUBLISHED.keys()
    for method, texts in printed.items():
        for counts, text in zip(PUBLISHED[method].values(), texts, strict=True):
            assert sum(counts) == 24
            assert f"{100 * counts.precision().value:.2f}, {100 * counts.recall().value:.2f}" == text


def test_weights_that_mean_the_same_give_the_same_row():
    for behaviour in (0, 1):
        expert, learned = row(EXPERT, behaviour), row("mme-mtirl", behaviour)
        np.testing.assert_array_equal(learned.tally, expert.tally)
        assert learned.accuracy == learned.choice_accuracy == 1


def test_a_confused_behaviour_shows():
    np.testing.assert_array_equal(row("DPM-BIRL", 1).tally, row(EXPERT, 0).tally)
    # Picking and rolling differ where an onion lies before any list: 8 of 26 states, 8 of 12 with a choice.
    assert row("DPM-BIRL", 1).accuracy == pytest.approx(18 / 26)
    assert row("DPM-BIRL", 1).choice_accuracy == pytest.approx(4 / 12)
    # Policies are carried out as they are given.
    np.testing.assert_array_equal(row("made up", 0).tally, row(EXPERT, 1).tally)


def test_published_numbers_stand_beside_methods_of_that_name():
    assert row("mme-mtirl", 0).published == PUBLISHED["MME-MTIRL"]["pick-inspect-place"]
    assert row(EXPERT, 1).published == (9, 4, 8, 3)
    assert row("made up", 0).published is None


def test_one_belt_of_24_says_little():
    found = row(EXPERT, 0)
    low, high = stats.binomtest(7, 12).proportion_ci(method="wilson")
    assert found.published.recall() == pytest.approx((7 / 12, low, high))
    ours, theirs = found.tally.recall(), found.published.recall()
    assert theirs.high - theirs.low > 10 * (ours.high - ours.low)
    assert theirs.low < ours.value < theirs.high


def test_picking_is_the_more_precise_and_rolling_finds_more():
    picking, rolling = row(EXPERT, 0).tally, row(EXPERT, 1).tally
    assert picking.precision().low > rolling.precision().high
    assert picking.recall().high < rolling.recall().low


def test_released_weights_sort_as_the_expert():
    sorting = sorting_without_claiming()
    learned = {name: np.array(weights) for name, weights in RELEASED.items()}
    found = table_7_2(jax.random.key(0), sorting, learned, belts=BELTS)
    assert [r.accuracy for r in found.rows] == [1.0] * 6
    tallies = [np.array(r.tally) for r in found.rows]
    for tally, expert in zip(tallies[2:], tallies[:2] * 2, strict=True):
        np.testing.assert_array_equal(tally, expert)


def test_experts_alone():
    found = table_7_2(jax.random.key(0), sorting_with_claiming(), {}, belts=BELTS)
    assert [r.behaviour for r in found.rows] == ["pick-inspect-place", "roll-pick-place"]


def test_the_summary_is_plain_data():
    summary = json.loads(json.dumps(sorting_table_summary(table()), allow_nan=False))
    assert summary["belts"] == BELTS
    assert summary["line"]["onions"] == 8
    rows = {(r["method"], r["behaviour"]): r for r in summary["rows"]}
    assert len(rows) == 10
    expert = rows[EXPERT, "roll-pick-place"]
    assert expert["dissertation"]["TP, FP, TN, FN"] == [9, 4, 8, 3]
    assert expert["simulated"]["precision"]["value"] == row(EXPERT, 1).tally.precision().value
    assert sum(expert["simulated"]["TP, FP, TN, FN"]) == pytest.approx(24)
    never = rows["EM-MLIRL", "pick-inspect-place"]["simulated"]
    assert never["precision"] == {"value": None, "interval": None}
    assert never["recall"]["value"] == 0
    assert rows["made up", "pick-inspect-place"]["dissertation"] is None


def test_the_printed_table():
    console = Console(width=110, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    print_sorting_table(table(), console)
    text = console.export_text()
    assert "7, 0, 12, 5" in text
    assert "100.0 (65-100)" in text
    assert f"{BELTS} belts" in text
    lines = cells(table(), "pick-inspect-place")
    # Five methods, of which the dissertation has four.
    assert len(lines) == 9
    assert all(len(line) == len(HEADINGS) for line in lines)


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_the_figure_shows_both(theme):
    figure = sorting_table_plot(table(), theme=theme, title="Sorting")
    panels = figure.axes
    assert [p.get_title(loc="left") for p in panels] == [
        "pick-inspect-place: precision",
        "pick-inspect-place: recall",
        "roll-pick-place: precision",
        "roll-pick-place: recall",
    ]
    dots = [line for line in panels[1].lines if line.get_marker() == "o"]
    diamonds = [line for line in panels[1].lines if line.get_marker() == "D"]
    np.testing.assert_allclose(
        [line.get_xdata()[0] for line in dots],
        [r.tally.recall().value for r in table().rows if r.behaviour == "pick-inspect-place"],
    )
    np.testing.assert_allclose([line.get_xdata()[0] for line in diamonds], [7 / 12, 7 / 12, 7 / 12, 6 / 12])
    assert [t.get_text() for t in panels[0].texts] == ["no onion binned"]
    figure.draw_without_rendering()


@pytest.mark.parametrize(
    ("learned", "complaint"),
    [
        ({"a": np.zeros((2, 10))}, r"a must give weights \[B, 11\] or policies \[B, 26, 7\]"),
        ({"a": np.zeros((4, 11))}, "1 <= B <= 3 behaviours"),
        ({"a": np.zeros(11)}, "a must give weights"),
        ({"a": np.zeros((1, 11)), "b": np.zeros((2, 11))}, "same number of behaviours"),
        ({"Expert": np.zeros((1, 11))}, "cannot be called 'expert'"),
        ({"a": np.full((1, 11), np.nan)}, "not a number"),
        ({"a": np.full((1, 26, 7), 1 / 7)}, "not offered there"),
    ],
)
def test_what_is_no_method(learned, complaint):
    with pytest.raises(ValueError, match=complaint):
        table_7_2(jax.random.key(0), sorting_with_claiming(), learned, belts=BELTS)


def test_what_is_no_level():
    with pytest.raises(ValueError, match="level"):
        table_7_2(jax.random.key(0), sorting_with_claiming(), {}, level=95)
