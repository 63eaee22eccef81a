import io
import json
from functools import cache
from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.analysis.studies.sorting import figures as sorting_figures
from i2rl.analysis.studies.sorting import page as sorting_report
from i2rl.analysis.studies.sorting import study as sorting_study
from i2rl.analysis.studies.sorting.figures import embed, feature_counts, flow_of
from i2rl.domains import demonstrate_sorting, sorting_with_claiming
from i2rl.domains.sorting.process import (
    BIN,
    BLEMISHED,
    CLAIM_LISTED,
    CLAIM_NEW,
    GOOD,
    HELD,
    INSPECT,
    INSPECTED,
    PICK,
    PLACE_IN_BIN,
    PLACE_ON_CONVEYOR,
    ROLL,
    TABLE,
    UNKNOWN,
)
from i2rl.inference.learners.dpm import dpm_birl


@cache
def small():
    """Run the methods that compile fastest, on few and short trajectories."""
    return sorting_study.sorting_study(
        2, (6,), replications=2, steps=20, methods=("dpm-birl", "em-mlirl"), belts=20, n_components=3, seed=3
    )


def test_every_prefix_of_a_stream_is_balanced_and_labelled():
    study = small()
    assert [r.name for r in study.results] == ["DPM-BIRL", "EM-MLIRL"]
    assert study.labels.tolist() != sorted(study.labels.tolist())
    borders = np.array([4, 6, 12])
    stream = sorting_study._stream(jax.random.key(0), study.sorting, 2, borders, 20)
    for n in borders:
        assert np.bincount(stream.labels[:n]).tolist() == [n // 2, n // 2]
    # Rolling is something only rollers do.
    rolls = (np.asarray(stream.demonstration.action) == ROLL).any(1)
    np.testing.assert_array_equal(rolls, stream.labels == 1)


def test_measures_are_those_of_the_fit_itself():
    study = small()
    found, last = study.results[0].found, study.results[0].measures
    sorting = sorting_with_claiming()
    first = jax.random.fold_in(jax.random.split(jax.random.key(3))[0], 0)
    key = sorting_study._stream(first, sorting, 2, study.counts, 20).key
    again = dpm_birl(sorting.mdp).fit(jax.random.fold_in(key, 6), study.demonstration)
    np.testing.assert_array_equal(again.assignments, found.assignments)
    assert last.n_components[0, -1] == len(set(again.assignments))
    best = max(
        np.mean([renaming[a] == b for a, b in zip(again.assignments, study.labels, strict=True)])
        for renaming in _renamings(again.n_components)
    )
    assert last.accuracy[0, -1] == pytest.approx(best)
    assert (last.seconds > 0).all()
    assert (last.value_difference >= 0).all()


def _renamings(n_components):
    return permutations(range(max(n_components, 2)))


def test_online_learner_is_judged_on_everything_by_what_it_knows_at_the_end():
    sorting = sorting_with_claiming()
    mixed = demonstrate_sorting(jax.random.key(2), sorting, (2, 2), steps=30)

    class Known:
        weights = jnp.asarray([20 * sorting.weights[0], np.zeros(11), 20 * sorting.weights[1]])
        proportions = jnp.asarray([0.4, 0.0, 0.6])

    found = sorting_study._explained(sorting.mdp, Known, -1.5, mixed.demonstration)
    # The empty way is none; the largest comes first.
    assert found.n_components == 2
    assert found.objective == -6.0
    np.testing.assert_array_equal(found.assignments, 1 - mixed.labels)
    np.testing.assert_allclose(found.responsibilities.sum(1), 1)


def test_a_behaviour_without_a_way_is_carried_out_as_its_trajectories_were_taken_for():
    found = small().results[0].found
    labels = np.array([0, 0, 0, 1])
    one_component = found._replace(weights=np.eye(11)[:2], responsibilities=np.eye(2)[[0, 0, 1, 1]])
    np.testing.assert_array_equal(sorting_study._behaviours_of(labels, one_component), np.eye(11)[:2])
    merged = found._replace(weights=np.eye(11)[:2], responsibilities=np.eye(2)[[1, 1, 1, 1]])
    np.testing.assert_array_equal(sorting_study._behaviours_of(labels, merged), np.eye(11)[[1, 1]])


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"tasks": 4}, "tasks must be 2 .* or 3 .* got 4"),
        ({"counts": (8, 1)}, "2 tasks need at least 2 trajectories, one of each; got 1"),
        ({"counts": ()}, "at least one number of trajectories"),
        ({"n_components": 0}, "n_components must be at least 1, got 0"),
        ({"replications": 0}, "replications must be at least 1"),
        ({"sessions": 9, "counts": (4, 8)}, "at most the 8 trajectories, got 9"),
        ({"methods": ("gail",)}, "methods are mme-mtirl, .*got 'gail'"),
        ({"methods": ()}, "at least one method"),
    ],
)
def test_bad_studies_are_told(given, complaint):
    with pytest.raises(ValueError, match=complaint):
        sorting_study.sorting_study(**given)


def test_numbers_of_trajectories_are_read_from_text():
    assert sorting_study.counts_of(2, " 8, 16,32") == (8, 16, 32)
    assert sorting_study.counts_of(3, "all") == sorting_study.GRID[3]
    assert sorting_study.counts_of(2, None) is None


def test_embedding_keeps_distances_of_planar_features():
    rng = np.random.default_rng(0)
    plane, _ = np.linalg.qr(rng.normal(size=(5, 2)))
    flat = rng.normal(size=(7, 2)) * [3, 1]
    found = embed(flat @ plane.T + 4)
    distances = np.linalg.norm(flat[:, None] - flat[None], axis=-1)
    ours = np.linalg.norm(found.points[:, None] - found.points[None], axis=-1)
    np.testing.assert_allclose(ours, distances, atol=1e-12)
    variance = np.linalg.eigvalsh(np.cov(flat.T))[::-1]
    np.testing.assert_allclose(found.shares, variance / variance.sum())
    np.testing.assert_allclose(found.points.var(0, ddof=1), variance)
    # One trajectory, or equal ones, vary in no direction.
    assert not embed(np.ones((3, 5))).shares.any()
    assert not embed(np.ones((1, 5))).points.any()


def test_feature_counts_leave_padding_out():
    sorting = sorting_with_claiming()
    mixed = demonstrate_sorting(jax.random.key(0), sorting, (1, 1), steps=5)
    by_hand = [
        sum(np.asarray(sorting.mdp.features)[s, a] for s, a in zip(states, actions, strict=True))
        for states, actions in zip(mixed.demonstration.state, mixed.demonstration.action, strict=True)
    ]
    np.testing.assert_allclose(feature_counts(sorting.mdp, mixed.demonstration.padded(2, 8)), by_hand)


def test_flow_of_each_expert_is_its_routine():
    sorting = sorting_with_claiming()
    picking, rolling, claiming = (flow_of(sorting, sorting.expert_policy(b), 50) for b in range(3))
    unknown, held = (TABLE, UNKNOWN), (HELD, UNKNOWN)
    good, bad, binned = (INSPECTED, GOOD), (INSPECTED, BLEMISHED), (BIN, UNKNOWN)
    routine = {move: set(actions) for move, actions in picking.moves.items()}
    assert routine == {
        (unknown, held): {PICK},
        (held, good): {INSPECT},
        (held, bad): {INSPECT},
        (good, unknown): {PLACE_ON_CONVEYOR},
        (bad, binned): {PLACE_IN_BIN},
        (binned, unknown): {CLAIM_NEW},
    }
    listed, carried = (TABLE, BLEMISHED), (HELD, BLEMISHED)
    assert {move: set(actions) for move, actions in rolling.moves.items()} == {
        (listed, carried): {PICK},
        (carried, binned): {PLACE_IN_BIN},
        (binned, listed): {ROLL, CLAIM_LISTED},
    }
    assert {move: set(actions) for move, actions in claiming.moves.items()} == {
        (unknown, unknown): {CLAIM_NEW}
    }
    # Every onion binned was picked: the shares of steps agree but for slips and the ends.
    assert picking.moves[bad, binned][PLACE_IN_BIN] == pytest.approx(
        picking.moves[binned, unknown][CLAIM_NEW], abs=0.02
    )
    assert sum(picking.visits.values()) <= 1


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda t: t.name)
def test_figures_show_what_was_measured(theme):
    study = small()
    evd = sorting_figures.evd_plot(study, theme)
    axes = evd.axes[0]
    line = next(x for x in axes.get_lines() if x.get_label() == "DPM-BIRL")
    np.testing.assert_allclose(line.get_ydata(), study.results[0].measures.value_difference.mean(0))
    assert axes.get_yscale() == "symlog"
    assert axes.get_ylim()[0] < 0
    clusters = sorting_figures.clusters_plot(study, theme)
    drawn = [sum(len(x.get_xdata()) for x in panel.get_lines()) for panel in clusters.axes[:2]]
    assert drawn == [6, 6]
    number = sorting_figures.components_plot(study, theme)
    for panel, result in zip(number.axes, study.results, strict=True):
        shown = np.concatenate([x.get_offsets() for x in panel.collections])
        expected = {(t, n) for t in range(1) for n in result.measures.n_components[:, t]}
        assert {(int(x), int(y)) for x, y in shown} == expected
    times = sorting_figures.time_plot(study, theme).axes[0]
    assert {tick.get_text() for tick in times.get_xticklabels()} >= {"6"}
    n_components = sorting_figures.components_diagram(study, theme)
    assert len(n_components.axes) == min(len(set(study.results[0].found.assignments)), 4)
    assert n_components.get_facecolor() == evd.get_facecolor()


@pytest.mark.parametrize("plot", ["clusters_plot", "components_plot", "components_diagram"])
def test_legend_and_small_print_of_a_single_method_fit_the_figure(plot):
    study = small()
    figure = getattr(sorting_figures, plot)(study._replace(results=study.results[:1]), LIGHT)
    figure.draw_without_rendering()
    whole = figure.bbox
    for artist in [*figure.legends, figure._supxlabel]:
        box = artist.get_window_extent()
        assert whole.x0 <= box.x0 < box.x1 <= whole.x1


@pytest.mark.usefixtures("small_pictures")
def test_command_writes_its_page(tmp_path, monkeypatch, page_faults):
    asked = {}

    def shared(tasks, counts, **options):
        asked.update(options, tasks=tasks, counts=list(counts))
        return small()

    monkeypatch.setattr(sorting_study, "sorting_study", shared)
    command = [
        "run",
        "sorting",
        "--trajectories",
        "6",
        "--replications",
        "1",
        "--method",
        "em-mlirl",
        "--steps",
    ]
    command += ["20", "--belts", "10", "--json", "--folder", str(tmp_path)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert (asked["counts"], asked["replications"], asked["steps"]) == ([6], 1, 20)
    assert (asked["belts"], asked["methods"]) == (10, ("em-mlirl",))
    told = json.loads(result.stdout)
    assert told == json.loads((tmp_path / "results.json").read_text())
    assert [m["method"] for m in told["methods"]] == ["DPM-BIRL", "EM-MLIRL"]
    assert told["methods"][0]["trajectories"] == [6]
    found = set(small().results[0].found.assignments.tolist())
    assert len(told["components of the first replication"]) == len(found)
    page = (tmp_path / "index.html").read_text()
    assert page_faults(page) == []
    assert "EM-MLIRL" in page
    assert page.count("<figure>") == 6
    for name in ("clusters", "components", "evd", "number", "time", "table"):
        assert (tmp_path / f"{name}-dark.png").exists()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--trajectories", "8,many"], "whole numbers such as 8,16,32, or all, got '8,many'"),
        (["--trajectories", "1"], "2 tasks need at least 2 trajectories"),
        (["--components", "0"], "Input should be greater than or equal to 1"),
        (["--tasks", "5"], "Input should be less than or equal to 3"),
        (["--method", "gail"], "gail"),
        (["--sessions", "99"], "at most the"),
    ],
)
def test_command_tells_mistakes_in_one_line(options, complaint, tmp_path):
    result = CliRunner().invoke(app, ["run", "sorting", *options, "--folder", str(tmp_path / "none")])
    assert result.exit_code != 0
    assert "Traceback" not in result.output
    assert complaint in " ".join(result.output.split())
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("plot", ["evd_plot", "time_plot"])
def test_a_single_number_of_trajectories_is_one_place_on_the_axis(plot):
    (axes,) = getattr(sorting_figures, plot)(small(), LIGHT).axes
    low, high = np.log(axes.get_xlim())
    dots = np.log(
        np.concatenate([line.get_xdata() for line in axes.get_lines() if line.get_marker() != "None"])
    )
    assert np.ptp(dots) < 0.2 * (high - low)
    assert abs(np.log(6) - (low + high) / 2) < 0.1 * (high - low)


def test_tables_print():
    console = Console(width=150, record=True, file=io.StringIO())
    sorting_report.print_tables(small(), console)
    text = console.export_text()
    assert "DPM-BIRL" in text
    assert "roll-pick-place (Table 7.2)" in text
