import json
from functools import cache

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.analysis.studies.methods import study as online_methods
from i2rl.domains import instance
from i2rl.inference import me_i2rl
from i2rl.inference.learners.darko import darko_i2rl
from i2rl.inference.learners.jin import jin_i2rl
from i2rl.models import Demonstration


def test_the_table_counts_what_learners_carry(random_mdp):
    mdp = random_mdp(0, n_states=5, n_actions=3, n_features=2)
    seen = Demonstration.from_pairs([[0, 1, 2]], [[0, 0, 0]])
    table = online_methods.methods_table(mdp, seen).set_index("method")
    carried, reward = table["statistic numbers"], table["reward numbers"]
    # Table 8.1: nothing for the first two; a count with a running average for the rest.
    assert carried["Jin et al."] == carried["DARKO"] == 0
    assert carried["ME-I2RL, features"] == carried["LME-I2RL, features"] == 1 + 2 + 5
    assert carried["LME-I2RL, counts"] == carried["LME-I2RL, seen"] == 1 + 5 * 3
    assert carried["LME-I2RL with random weights, seen"] == carried["LME-I2RL, seen"]
    assert carried["batch LME, of one stream"] == 6
    assert reward["Jin et al."] == 5
    assert (reward.drop("Jin et al.") == 2).all()
    assert table.loc["DARKO", "statistic"] == "none"
    assert "batch LME, of one stream" not in set(online_methods.methods_table(mdp)["method"])


def test_no_statistic_grows_with_sessions(random_mdp):
    mdp = random_mdp(0, n_states=5, n_actions=3, n_features=2)
    sessions = [Demonstration.from_pairs(*np.zeros((2, n, 5), int)) for n in (1, 8)]
    for learner in (jin_i2rl(mdp), darko_i2rl(mdp), me_i2rl(mdp, statistic="features")):
        start = learner.init(jax.random.key(0))
        for session in sessions:
            state, _ = jax.eval_shape(learner.session, start, session)
            assert [x.shape for x in jax.tree.leaves(state)] == [x.shape for x in jax.tree.leaves(start)]


def test_patrollers_turn_round_at_their_goals():
    patrol = instance(2)
    goals = online_methods.turning_places(patrol)
    names = {patrol.states[i].name for i in np.flatnonzero(goals)}
    assert {"(0,5) east", "(16,5) east"} <= names
    # Corners are turned at once, and on the way back nobody turns round.
    assert not names & {"(0,1) north", "(16,1) south", "(0,5) south", "(0,5) west", "(8,1) north"}


def test_the_rate_is_the_smallest_that_is_as_good():
    assert online_methods.chosen_learning_rate([0.1, 1.0, 10.0], np.array([0.5, 0.895, 0.9])) == 1.0
    assert online_methods.chosen_learning_rate([10.0, 1.0], np.array([0.9, 0.9])) == 1.0
    assert online_methods.chosen_learning_rate([0.1, 1.0], np.array([0.5, 0.9])) == 1.0


METHODS = ("Jin et al., features", "DARKO, goals", "LME-I2RL, seen")


@cache
def small_study():
    return online_methods.methods_study(
        2, sessions=8, replications=1, seed=1, learning_rates=(0.3,), methods=METHODS
    )


def test_every_method_is_measured_at_the_same_pairs():
    study = small_study()
    assert study.points[0] == 5
    assert study.points[-1] == 40
    assert tuple(curve.name for curve in study.curves) == METHODS
    for curve in study.curves:
        assert curve.accuracy.shape == (2, len(study.points))
        assert ((curve.accuracy >= 0) & (curve.accuracy <= 1)).all()
    # DARKO stays at its start until it reaches the first goal.
    waiting = next(curve for curve in study.curves if curve.name == "DARKO, goals").accuracy
    assert (waiting[:, 0] == waiting[:, 1]).all()
    best = next(curve for curve in study.curves if curve.name == "LME-I2RL, seen")
    assert np.median(best.accuracy[:, -1]) > 0.85


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_the_figure_shows_the_medians(theme):
    study = small_study()
    figure = online_methods.draw(study, theme)
    drawn = {line.get_label(): line.get_ydata() for axes in figure.axes for line in axes.get_lines()}
    for curve in study.curves:
        assert np.allclose(drawn[curve.name], np.median(curve.accuracy, axis=0))
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}


@pytest.mark.usefixtures("small_pictures")
def test_run_methods_writes_a_page(tmp_path, monkeypatch, page_faults):
    monkeypatch.setattr(online_methods, "methods_study", lambda *_, **__: small_study())
    folder = tmp_path / "report"
    shown = CliRunner().invoke(app, ["run", "methods", "--folder", str(folder)])
    assert shown.exit_code == 0, shown.output
    assert "DARKO" in shown.output
    page = (folder / "index.html").read_text()
    assert page.count("<table") == 4
    assert page_faults(page) == []
    assert "data:image/png" in page
    result = CliRunner().invoke(app, ["run", "methods", "--folder", str(folder), "--json"])
    content = json.loads(result.output)
    assert content == json.loads((folder / "results.json").read_text())
    assert content["pairs"][-1] == 40
    weights = np.array(content["methods"][-1]["weights"])
    assert weights.shape == (2, small_study().patrol.mdp.n_features)
    assert [x["weight"] for x in content["weights, first stream"]] == weights[0].tolist()
    assert [row["method"] for row in content["table 8.1"]][-1] == "batch LME, of one stream"


def test_an_instance_or_method_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="instances are 1, 2 and 3, got 7"):
        online_methods.methods_study(7)
    with pytest.raises(ValueError, match=r"methods are Jin .*; got 'AIRL'"):
        online_methods.methods_study(2, methods=["AIRL"])
