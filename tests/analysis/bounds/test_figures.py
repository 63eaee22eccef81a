"""The pictures of the bounds show the numbers they are given."""

import numpy as np
import pytest

from i2rl.analysis.bounds.coverage import Coverage
from i2rl.analysis.bounds.figures import looseness_plot, sample_size_plot
from i2rl.analysis.bounds.theorems import demonstrations_needed, table_7_1a
from i2rl.analysis.drawing.style import THEMES

DEVIATIONS = np.full(6, 0.05)


@pytest.mark.parametrize("theme", THEMES, ids=lambda t: t.name)
def test_the_curves_are_the_sizes_needed(theme):
    axes = sample_size_plot(6, 0.99, DEVIATIONS, 0.8, ignorance=7.8, theme=theme).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    nats, size = lines["exact completion"][3]
    total = nats * 0.01 / 12
    needed = demonstrations_needed(6, total / 2, 0.8, 0.99, epsilon_s=total / 2)["trajectories"]
    assert size == needed["exact completion"]
    np.testing.assert_allclose(lines["Table 7.1(a)"][:, 1], table_7_1a()["trajectories"])
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert "nats" in axes.get_xlabel()


def test_the_table_of_six_features_is_not_shown_for_others():
    axes = sample_size_plot(4, 0.9, DEVIATIONS[:4]).axes[0]
    assert "Table 7.1(a)" not in [line.get_label() for line in axes.get_lines()]


def test_bounds_stand_beside_what_was_seen():
    rows = [
        Coverage("m", "Theorem 1", 240, 0.9, 1.0, 8.0, 0.4, 500),
        Coverage("m", "b", 60, 0.8, 0.9, 2.0, 0.5, 500),
    ]
    axes = looseness_plot(rows).axes[0]
    points = [line.get_xdata() for line in axes.get_lines() if line.get_linestyle() == "None"]
    np.testing.assert_allclose(points, [[0.4, 0.5], [8.0, 2.0]])
    assert [text.get_text() for text in axes.texts] == ["20 times", "4 times"]


def test_an_empty_study_is_refused():
    with pytest.raises(ValueError, match="at least one row"):
        looseness_plot([])
