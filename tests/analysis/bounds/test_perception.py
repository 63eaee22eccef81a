"""RIMEO's theorems, printed and corrected, their inverses and what they add to LME-I2RL's."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from i2rl.analysis.bounds.distance import Perception
from i2rl.analysis.bounds.perception import (
    noisy_confidence,
    noisy_constraint_bound,
    perception_needed,
    rimeo_confidence,
    rimeo_constraint_bound,
    rimeo_no_regret,
    rimeo_no_regret_sizes,
    same_reports_constraint_bound,
)
from i2rl.analysis.bounds.theorems import failure_probability, lme_constraint_bound, no_regret
from i2rl.analysis.command.app import app

PERCEPTION = Perception(observations=50_000, epsilon_o=0.01, predicates=4, longest=5)


def test_perfect_perception_makes_rimeos_bound_lmes():
    perception = Perception(observations=10**9, epsilon_o=1e-4, predicates=8, longest=3)
    rimeo = rimeo_constraint_bound(300, 1000, 0.1, 0.05, perception, 6)
    lme = lme_constraint_bound(300, 1000, 0.1, 0.05, 6)
    assert rimeo.confidence == pytest.approx(lme.confidence)
    assert rimeo.error == pytest.approx(lme.error + 3 * 8 * 1e-4)
    theorem = rimeo_confidence(300, 1000, 0.1, 0.05, perception, 6, 0.9)
    assert theorem.error == pytest.approx(2 * 6 * rimeo.error / 0.1)


def test_the_corrected_lemma_spends_less_error_and_less_probability():
    printed = rimeo_constraint_bound(300, 10**9, 0.1, 1e-4, PERCEPTION, 6)
    corrected = noisy_constraint_bound(300, 0.1, PERCEPTION, 6)
    assert corrected.error < printed.error
    assert corrected.confidence > printed.confidence
    deltas = failure_probability(300, 0.1, 6) + failure_probability(50_000, 0.01, 4)
    assert corrected.confidence == pytest.approx(1 - deltas)


def test_counted_reliabilities_tighten_the_lemma_and_the_same_reports_loosen_it():
    p = np.full(4, 0.8)
    ahead = noisy_constraint_bound(300, 0.1, PERCEPTION, 6).error
    assert noisy_constraint_bound(300, 0.1, PERCEPTION, 6, p).error < ahead
    assert same_reports_constraint_bound(300, 0.1, PERCEPTION, 6, p).error > ahead
    names = {a.name for a in same_reports_constraint_bound(300, 0.1, PERCEPTION, 6, p).assumptions}
    assert "other_reports" not in names
    assert "other_reports" in {a.name for a in noisy_constraint_bound(300, 0.1, PERCEPTION, 6).assumptions}


def test_the_theorem_says_whose_posterior_it_is_about():
    lemma = noisy_constraint_bound(300, 0.1, PERCEPTION, 6)
    theorem = noisy_confidence(lemma, 6, 0.9)
    assert theorem.error == pytest.approx(2 * 6 * lemma.error / 0.1)
    assert theorem.epsilon == lemma.error
    assert noisy_confidence(lemma, 6, 0.9, norm=1.0).error == pytest.approx(theorem.error / 6)
    names = [a.name for a in theorem.assumptions]
    assert len(names) == len(set(names))
    assert {"experts_posterior", "known_truths", "weights", "solved", "program"} <= set(names)
    assert "under weights as good as the expert's" in theorem.guarantee()


def test_the_data_that_are_asked_for_keep_the_promise():
    needed = perception_needed(6, 8, 3, 0.3, 0.8)
    printed, corrected = needed.loc["printed"], needed.loc["corrected"]
    perception = Perception(printed.observations, printed.epsilon_o, 8, 3)
    bound = rimeo_constraint_bound(printed.trajectories, printed.draws, 0.1, 0.1, perception, 6)
    assert bound.confidence >= 0.8
    assert bound.error == pytest.approx(0.3)
    perception = Perception(corrected.observations, corrected.epsilon_o, 8, 3)
    bound = noisy_constraint_bound(corrected.trajectories, 0.15, perception, 6)
    assert bound.confidence >= 0.8
    assert bound.error == pytest.approx(0.3)
    assert (corrected[["trajectories", "observations"]] < printed[["trajectories", "observations"]]).all()
    fewer = Perception(corrected.observations * 0.9, corrected.epsilon_o, 8, 3)
    assert noisy_constraint_bound(corrected.trajectories, 0.15, fewer, 6).confidence < 0.8


def test_reports_grow_with_the_square_of_steps():
    short, long = (perception_needed(6, 8, steps, 0.15, 0.8).loc["corrected"] for steps in (3, 300))
    assert long.observations / short.observations == pytest.approx(1e4, rel=0.01)


def test_rimeos_regret_needs_more_than_lmes():
    sizes = [100_000] * 5
    rimeo = rimeo_no_regret(5.0, sizes, sizes, [10**7] * 5, 2, 3, 4, 0.9)
    plain = no_regret(5.0, sizes, 4, 0.9)
    assert (rimeo.confidence <= plain.confidence).all()
    np.testing.assert_allclose(rimeo.average, plain.average)


def test_the_sizes_of_sessions_keep_rimeos_confidence_for_ever():
    sizes = rimeo_no_regret_sizes(5.0, 100, 0.1, 2, 3, 4, 0.9)
    regret = rimeo_no_regret(5.0, sizes.trajectories, sizes.draws, sizes.observations, 2, 3, 4, 0.9)
    assert (regret.confidence >= 0.9).all()
    assert regret.bound.confidence >= 0.9
    assert (sizes.iloc[-1] > sizes.iloc[0]).all()
    for name in sizes:
        fewer = sizes.assign(**{name: np.maximum(sizes[name] // 2, 1)})
        poorer = rimeo_no_regret(5.0, fewer.trajectories, fewer.draws, fewer.observations, 2, 3, 4, 0.9)
        assert poorer.bound.confidence < 0.9
    same = rimeo_no_regret(5.0, [1000] * 100, [10**6] * 100, [10**7] * 100, 2, 3, 4, 0.9)
    assert same.confidence[-1] == 0


def test_errors_and_sizes_out_of_range_are_refused():
    with pytest.raises(ValueError, match="lies in \\(0, 1\\], got 2"):
        perception_needed(6, 8, 3, 2, 0.8)
    with pytest.raises(ValueError, match="confidence must lie strictly between 0 and 1"):
        perception_needed(6, 8, 3, 0.2, 1.0)
    with pytest.raises(ValueError, match="predicates must be at least 1, got 0"):
        perception_needed(6, 0, 3, 0.2, 0.8)
    with pytest.raises(ValueError, match="2 session sizes, but 2 numbers of draws and 1 of observations"):
        rimeo_no_regret(5.0, [1, 1], [1, 1], [1], 2, 3, 4, 0.9)
    with pytest.raises(ValueError, match="longest must be at least 1, got 0"):
        noisy_constraint_bound(10, 0.1, PERCEPTION._replace(longest=0), 6)


def test_the_command_line_says_what_noisy_perception_asks_for():
    asked = ["bounds", "--features", "6", "--predicates", "8", "--steps", "3"]
    content = json.loads(CliRunner().invoke(app, [*asked, "--json"]).stdout)
    needed = perception_needed(6, 8, 3, 0.15, 0.8)
    for row in content["perception"]:
        assert row["observations"] == needed.loc[row["bound"], "observations"]
        assert row["epsilon_o"] == pytest.approx(needed.loc[row["bound"], "epsilon_o"])
    told = " ".join(CliRunner().invoke(app, asked).output.split())
    assert str(needed.loc["corrected", "observations"]) in told
    assert "under weights as good as the expert's" in told
    half = CliRunner().invoke(app, asked[:-2])
    assert half.exit_code != 0
    assert "give both or neither" in half.output
