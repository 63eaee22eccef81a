"""The patrol studies of adversarial learners: their demonstrations, and their pictures."""

from __future__ import annotations

import numpy as np
import pytest

from i2rl.analysis.benchmarks.statistics.adversarial_patrol import LEVELS, VIEWS
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.analysis.studies.adversarial.patrol import STEPS, interval, noisy_streams
from i2rl.analysis.studies.adversarial.patrol_figures import CLEAN as CLEAN_INPUT
from i2rl.analysis.studies.adversarial.patrol_figures import (
    GAIL,
    LME,
    NOISY,
    ROBUST,
    ROBUST_GAIL,
    noise_curves,
    noise_levels,
    view_curves,
)
from i2rl.domains.patrol.process import FORWARD, LEFT, RIGHT, instance
from i2rl.models.observation.demonstration import PAD


@pytest.fixture(scope="module")
def streams():
    return noisy_streams(instance(2), 0.3, replications=4, sessions=6)


def test_misreports_are_the_two_confusions_as_often_as_stated(streams):
    there = streams.truth.kind != PAD
    np.testing.assert_array_equal(streams.truth.state[there], streams.seen.state[there])
    for truth, report in ((FORWARD, LEFT), (RIGHT, FORWARD)):
        able = there & (streams.truth.action == truth)
        wrong = streams.seen.action[able] != truth
        assert set(streams.seen.action[able][wrong]) == {report}
        assert wrong.mean() == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / able.sum()))
    left = there & (streams.truth.action == LEFT)
    assert (streams.seen.action[left] == LEFT).all()


def test_pairs_are_counted(streams):
    there = (streams.truth.kind != PAD).sum(axis=(2, 3))
    np.testing.assert_array_equal(np.cumsum(there, axis=1), np.broadcast_to(streams.pairs, there.shape))
    sizes = np.diff(streams.pairs, prepend=0)
    assert ((sizes >= 32) & (sizes <= 128) & (sizes % STEPS == 0)).all()


def test_interval_covers_the_mean_as_often_as_it_says():
    draws = np.random.default_rng(0).normal(1.0, 2.0, (8, 4000))
    mean, half = interval(draws)
    assert (np.abs(mean - 1) < half).mean() == pytest.approx(0.95, abs=0.015)


@pytest.fixture(scope="module")
def results():
    rng = np.random.default_rng(1)

    def curve(top: float) -> list:
        return (top - np.exp(-np.arange(20) / 4) + 0.01 * rng.normal(size=(5, 20))).tolist()

    noise = {}
    for level in LEVELS:
        for forgetting in (0.0, 1.0):
            for name, top in ((CLEAN_INPUT, 0.97), (NOISY, 0.97 - level / 4), (ROBUST, 0.96)):
                noise[f"{name}, {level:g}, memory {forgetting:g}"] = {
                    "level": level,
                    "accuracy": curve(top),
                    "success": rng.random(5).tolist(),
                    "pairs": list(range(50, 1050, 50)),
                }
    view = {
        f"{name}, {percent} %, memory {forgetting:g}": {
            "view": percent,
            "accuracy": curve(0.5 + percent / 250),
        }
        for name, forgetting in ((GAIL, 0.0), (ROBUST_GAIL, 1.0), (LME, 1.0))
        for percent in VIEWS
    }
    return {"noise": noise, "view": view}


@pytest.mark.parametrize("draw", [noise_curves, noise_levels, view_curves])
def test_figures_name_all_that_they_show(draw, results):
    for theme in (LIGHT, DARK):
        figure = draw(results, theme)
        figure.draw_without_rendering()
        assert figure.legends[0].get_texts()
        for axes in figure.axes:
            lines = [line.get_label() for line in axes.get_lines() if not line.get_label().startswith("_")]
            assert len(lines) == len(set(lines))


def test_noise_costs_what_the_results_say(results):
    axes = noise_levels(results, LIGHT).axes[0]
    line = next(x for x in axes.get_lines() if x.get_label() == NOISY)
    expected = [
        np.mean(np.array(results["noise"][f"{NOISY}, {level:g}, memory 0"]["accuracy"])[:, -15:])
        for level in LEVELS
    ]
    np.testing.assert_allclose(line.get_ydata(), expected)
