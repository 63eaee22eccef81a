"""Learning bout by bout from simulated mice: prediction before learning, baselines, figures."""

from __future__ import annotations

import io
import json

import jax
import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.drawing.style import LIGHT
from i2rl.analysis.studies.labyrinth.figures import value_on_maze, values_by_node
from i2rl.analysis.studies.labyrinth.page import print_tables, summary, tables, write
from i2rl.analysis.studies.labyrinth.study import (
    bits_per_decision,
    labyrinth_study,
    predict_with_learner,
    predict_with_table,
    predict_with_tables,
)
from i2rl.domains.labyrinth.process import (
    FIRST_END,
    HOME,
    WATER_PORT,
    Bout,
    demonstration_of,
    mouse_labyrinth,
    parent_of,
    simulate_bouts,
)
from i2rl.models.process.planning import reward_of, soft_plan

DISCOUNT = 0.6
MAZE = mouse_labyrinth(DISCOUNT)
NOTHING = np.zeros(MAZE.mdp.n_states, bool)


def thirsty_weights():
    """Return the weights of a mouse that dislikes turning, explores, and climbs towards the water port."""
    weights = dict.fromkeys(MAZE.mdp.feature_names, 0.0)
    weights |= {"turns round": -1.5, "goes deeper": 0.7, "reaches home": 1.0, "reaches the water port": 2.0}
    node = parent_of(WATER_PORT)
    while node:
        weights[f"reaches {node}"] = 1.2
        node = parent_of(node)
    return np.array(list(weights.values()))


@pytest.fixture(scope="module")
def mouse():
    return simulate_bouts(jax.random.key(3), MAZE, thirsty_weights(), 40, max_steps=128)


@pytest.fixture(scope="module")
def result(mouse):
    return labyrinth_study(mouse, recording="a simulated mouse", discount=DISCOUNT, ridge=2.0)


def score(result, method, view=0):
    (p,) = (p for p in result.views[view].predictions if p.method == method)
    return p.bits.sum() / result.decisions.sum()


def true_bits(mouse):
    log_policy = np.asarray(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, thirsty_weights())).log_policy)
    demonstration = demonstration_of(MAZE, mouse)
    lengths = -log_policy[demonstration.state, demonstration.action] / np.log(2)
    return np.where(demonstration.kind > 0, lengths, 0).sum() / demonstration.lengths.sum()


def test_the_learner_predicts_a_simulated_mouse_better_than_every_baseline(result, mouse):
    learner = score(result, "i2rl")
    baselines = ("uniform", "frequencies", "given entry", "level and entry", "Markov")
    assert learner < min(score(result, name) for name in baselines) - 0.02
    assert true_bits(mouse) < learner < true_bits(mouse) + 0.15


def test_the_learner_recovers_the_policy_where_the_mouse_has_been(result, mouse):
    view = result.views[0]
    true = np.exp(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, thirsty_weights())).log_policy)
    learned = np.exp(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, view.learned.weights)).log_policy)
    demonstration = demonstration_of(MAZE, mouse)
    visits = np.bincount(demonstration.state[demonstration.kind > 0], minlength=MAZE.mdp.n_states)
    uniform = np.asarray(MAZE.mdp.available) / np.asarray(MAZE.mdp.available).sum(1, keepdims=True)
    distance = {n: 0.5 * np.abs(p - true).sum(1) @ visits for n, p in (("learned", learned), ("no", uniform))}
    assert distance["learned"] < 0.3 * distance["no"]


def test_bits_of_a_bout_depend_on_earlier_bouts_only(result, mouse):
    demonstration = demonstration_of(MAZE, [*mouse[:4], *mouse[10:12]]).padded(6, 128)
    learner, _ = predict_with_learner(MAZE, demonstration, NOTHING, 2.0)
    for p in (learner, *predict_with_tables(MAZE, demonstration, NOTHING)):
        (before,) = (q.bits for q in result.views[0].predictions if q.method == p.method)
        np.testing.assert_allclose(p.bits[:4], before[:4], rtol=1e-9)
        assert (p.bits[4:] != before[4:6]).any()


def test_the_first_bout_is_predicted_from_the_prior(result, mouse):
    prior = np.asarray(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, np.zeros(133))).log_policy)
    demonstration = demonstration_of(MAZE, mouse[:1])
    expected = -prior[demonstration.state, demonstration.action].sum() / np.log(2)
    for view in result.views:
        assert view.predictions[0].bits[0] == pytest.approx(expected, rel=1e-9)


def test_uniform_costs_log_3_at_junctions_and_nothing_at_ends(result, mouse):
    at_junctions = sum(n < FIRST_END for b in mouse for n in b.nodes[:-1])
    assert score(result, "uniform") == pytest.approx(at_junctions * np.log2(3) / result.decisions.sum())


def test_tables_agree_with_hand_computation():
    # Two bouts: down to the left and back home; then straight home.
    bouts = [Bout(None, (0, 1, 0, HOME)), Bout(None, (0, HOME))]
    by_name = {p.method: p for p in predict_with_tables(MAZE, demonstration_of(MAZE, bouts), NOTHING)}
    # Nobody learns within a bout, so the first costs three uniform choices.
    for p in by_name.values():
        assert p.bits[0] == pytest.approx(3 * np.log2(3))
    # Then: one step left and two back seen in all; counts from one, back has 3 of 6.
    assert by_name["frequencies"].bits[1] == pytest.approx(1.0)
    # Entered from above: left once (at 0), back once (at 1); back has 2 of 5.
    assert by_name["given entry"].bits[1] == pytest.approx(np.log2(5 / 2))
    # At level 0 from above, and at node 0 from above: left once; back has 1 of 4.
    assert by_name["level and entry"].bits[1] == pytest.approx(2.0)
    assert by_name["Markov"].bits[1] == pytest.approx(2.0)
    assert {n: p.parameters for n, p in by_name.items()} == {
        "uniform": 0,
        "frequencies": 2,
        "frequencies of choices": 2,
        "given entry": 6,
        "level and entry": 36,
        "Markov": 378,
    }


def test_forced_steps_teach_frequencies_but_not_frequencies_of_choices():
    end = 63
    down = [0, 1, 3, 7, 15, 31, end]
    bouts = [Bout(None, (*down, *reversed(down[:-1]), HOME)), Bout(None, (0, HOME))]
    by_name = {p.method: p for p in predict_with_tables(MAZE, demonstration_of(MAZE, bouts), NOTHING)}
    # Six steps left and seven back, one of them forced.
    assert by_name["frequencies"].bits[1] == pytest.approx(np.log2(16 / 8))
    assert by_name["frequencies of choices"].bits[1] == pytest.approx(np.log2(15 / 7))


def test_tables_learn_only_from_what_is_in_view():
    bouts = [Bout(None, (0, 1, 0, HOME)), Bout(None, (0, 1, 0, HOME))]
    hidden = MAZE.below(1)
    p = predict_with_table(
        MAZE, demonstration_of(MAZE, bouts), hidden, "pooled", np.zeros(MAZE.mdp.n_states, int), MAZE.choice
    )
    # In view: left at 0, back (home) at 0. So left and back have 2 of 5 each; node 1's step is out of view.
    assert p.bits[1] == pytest.approx(3 * np.log2(5 / 2))
    assert p.bits_out_of_view.tolist() == pytest.approx([np.log2(3), np.log2(5 / 2)])


def test_the_learner_never_hears_what_happened_out_of_view():
    hidden = MAZE.below(1)
    last = (0, 1, 4, 9, 4, 1, 0, 2, 0, HOME)
    one, other = (
        predict_with_learner(
            MAZE, demonstration_of(MAZE, [Bout(None, first), Bout(None, last)]).padded(2, 16), hidden, 2.0
        )[0]
        for first in ((0, 1, 3, 7, 3, 1, 0, HOME), (0, 1, 4, 1, 4, 1, 0, HOME))
    )
    assert one.bits[0] != other.bits[0]
    assert one.bits[1] == other.bits[1]


def test_with_half_of_the_maze_hidden_learning_goes_on_and_the_markov_chain_knows_nothing_there(result):
    assert score(result, "i2rl", 1) < score(result, "uniform", 1) - 0.02
    view = result.views[1]
    markov = next(p for p in view.predictions if p.method == "Markov")
    uniform = next(p for p in view.predictions if p.method == "uniform")
    np.testing.assert_allclose(markov.bits_out_of_view, uniform.bits_out_of_view)
    assert view.decisions_out_of_view.sum() > 100
    assert result.views[0].decisions_out_of_view.sum() == 0


def test_intervals_hold_the_estimate_and_vanish_for_equal_bouts():
    constant = bits_per_decision(np.full(9, 6.0), np.full(9, 4))
    assert tuple(constant) == pytest.approx((1.5, 1.5, 1.5))
    varied = bits_per_decision(np.array([1.0, 9.0, 2.0, 8.0]), np.full(4, 5))
    assert varied.estimate == pytest.approx(1.0)
    assert varied.low < varied.estimate < varied.high


def test_an_empty_recording_is_refused():
    with pytest.raises(ValueError, match="no bouts"):
        labyrinth_study([])


@pytest.mark.usefixtures("small_pictures")
def test_the_page_holds_pictures_in_both_themes_and_every_number(result, tmp_path, page_faults):
    page = write(result, tmp_path / "new").read_text(encoding="utf-8")
    assert page_faults(page) == []
    for name in ("bits-light.png", "bits-dark.png", "value-light.png", "value-dark.png"):
        assert (tmp_path / "new" / name).read_bytes().startswith(b"\x89PNG")
    assert page.count("<picture>") == 2
    assert "i2rl learned a reward that predicts each new bout" in page
    content = json.loads((tmp_path / "new" / "results.json").read_text())
    assert content == json.loads(json.dumps(summary(result)))
    methods = content["views"]["whole maze"]["methods"]
    assert methods["i2rl"]["bits_per_decision"]["estimate"] == pytest.approx(score(result, "i2rl"))
    assert sum(methods["Markov"]["bits_of_each_bout"]) == pytest.approx(
        score(result, "Markov") * content["decisions"]
    )
    assert [len(t.rows) for t in tables(result)] == [8, 7]
    console = Console(file=io.StringIO(), width=140)
    print_tables(result, console)
    assert "a simulated mouse" in console.file.getvalue()


@pytest.mark.usefixtures("small_pictures")
def test_the_command_writes_its_page(result, tmp_path, monkeypatch):
    asked = {}

    def shared(bouts, **options):
        asked.update(options, bouts=len(bouts))
        return result

    monkeypatch.setattr("i2rl.analysis.studies.labyrinth.study.labyrinth_study", shared)
    recording = tmp_path / "mouse.jsonl"
    recording.write_text('{"nodes": [0, 1, 0, 127]}\n' * 2)
    command = [
        "run",
        "labyrinth",
        "--recording",
        str(recording),
        "--folder",
        str(tmp_path / "page"),
        "--json",
    ]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert (asked["bouts"], asked["recording"]) == (2, "mouse")
    assert json.loads(done.stdout) == json.loads((tmp_path / "page" / "results.json").read_text())
    assert (tmp_path / "page" / "index.html").exists()


def test_weights_come_with_intervals_that_hold_most_of_the_true_ones(result):
    # Weights on places that a mouse hardly sees are the prior's; those of its habits are the data's.
    content = summary(result)["views"]["whole maze"]["intervals"]
    found = {row["feature"]: row["95 % interval"] for row in content}
    truth = dict(zip(MAZE.mdp.feature_names, thirsty_weights(), strict=True))
    assert all(found[name][0] < found[name][1] for name in truth)
    inside = [found[name][0] <= weight <= found[name][1] for name, weight in truth.items()]
    assert np.mean(inside) > 0.9
    assert found["turns round"][1] < 0
    assert summary(result)["views"]["left half hidden"]["intervals"] is None


def test_signed_values_are_drawn_on_one_scale_with_zero_marked_in_the_middle(result):
    figure = value_on_maze(result, LIGHT)
    bar = next(axes for axes in figure.axes if axes.get_ylabel().startswith("learned value"))
    low, high = bar.get_ylim()
    assert low == -high
    assert any(np.allclose(line.get_ydata(), 0) for line in bar.get_lines())
    # Home is where the environment draws it: below the maze.
    home = next(text for text in figure.axes[0].texts if text.get_text() == "home")
    assert home.xy[1] == min(text.xy[1] for text in figure.axes[0].texts)


def test_the_value_drawn_at_the_water_port_holds_the_reward_of_reaching_it():
    weights = thirsty_weights()
    values = np.asarray(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, weights)).values)
    drawn = values_by_node(MAZE, weights, values)
    at_port = values[np.flatnonzero(MAZE.node == WATER_PORT)[0]]
    assert drawn[WATER_PORT] == pytest.approx(2.0 + 0.7 + DISCOUNT * at_port)
    assert np.flatnonzero(np.isnan(drawn)).tolist() == [0]
