"""Maps of processes with a layout of any kind: grids, points and graphs."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection, PolyCollection, QuadMesh
from matplotlib.figure import Figure

from i2rl.analysis.drawing import maps, style
from i2rl.domains.labyrinth.process import mouse_labyrinth
from i2rl.domains.object_world.process import random_object_world
from i2rl.models import Layout, TabularMDP
from i2rl.models.process.layout import Mark

N = 4
CELLS = [(r, c) for r in range(N) for c in range(N)]


def grid(copies: int = 1) -> TabularMDP:
    """Make a walk on ``N x N`` cells: up, right, down and left."""
    steps = ((-1, 0), (0, 1), (1, 0), (0, -1))
    inside = [[min(max(r + i, 0), N - 1) * N + min(max(c + j, 0), N - 1) for i, j in steps] for r, c in CELLS]
    successors = np.concatenate([np.array(inside) + N * N * k for k in range(copies)])[..., None]
    shape = successors.shape
    return TabularMDP.from_successors(successors, np.ones(shape), np.zeros((*shape[:2], 1)))


def ring(n: int = 12) -> tuple[TabularMDP, Layout]:
    s, turn = np.arange(n), 2 * np.pi * np.arange(n) / n
    successors = np.stack([(s + 1) % n, (s - 1) % n, s], 1)[..., None]
    mdp = TabularMDP.from_successors(successors, np.ones((n, 3, 1)), np.zeros((n, 3, 1)))
    return mdp, Layout.points(3 * np.stack([np.cos(turn), np.sin(turn)], 1), mdp, unit="m")


def drawn(figure: Figure) -> Figure:
    FigureCanvasAgg(figure).draw()
    return figure


def glyph_tips(figure: Figure) -> np.ndarray:
    """Tips of a map's arrows: the second corner of each head."""
    (glyphs, *_) = [c for c in figure.axes[0].collections if isinstance(c, PathCollection)]
    return np.array([path.vertices[-3] for path in glyphs.get_paths()])


@pytest.mark.parametrize("action", range(4))
def test_an_arrow_on_a_grid_points_to_the_cell_that_follows(action: int) -> None:
    mdp = grid()
    inner = [s for s, (r, c) in enumerate(CELLS) if 0 < r < N - 1 and 0 < c < N - 1]
    figure = drawn(maps.policy_map(mdp, np.eye(4)[np.full(N * N, action)], Layout.grid(CELLS)))
    for s in inner:
        row, column = CELLS[int(mdp.successors[s, action, 0])]
        way = np.array([column, row]) - np.array(CELLS[s])[::-1]
        tip = glyph_tips(figure)[s] - np.array(CELLS[s])[::-1]
        assert tip @ way > 0.3
        assert abs(tip @ way[::-1]) < 1e-9
    assert figure.axes[0].get_xlabel() == "column (cells)"
    assert figure.axes[0].get_ylim()[0] > figure.axes[0].get_ylim()[1]


def test_an_arrow_between_points_points_along_the_edge() -> None:
    mdp, layout = ring()
    figure = drawn(maps.policy_map(mdp, np.eye(3)[np.zeros(12, int)], layout))
    here = layout.positions[layout.place]
    way = np.roll(here, -1, axis=0) - here
    tips = glyph_tips(figure) - here
    cosines = (tips * way).sum(1) / np.linalg.norm(tips, axis=1) / np.linalg.norm(way, axis=1)
    np.testing.assert_allclose(cosines, 1)
    assert (np.linalg.norm(tips, axis=1) < 0.8 * np.linalg.norm(way, axis=1)).all()
    assert figure.axes[0].get_xlabel() == "x (m)"


def test_states_of_one_cell_have_their_own_part_or_their_own_panel() -> None:
    mdp, both = grid(2), CELLS + CELLS
    values = np.arange(2 * N * N, dtype=float)
    (axes, *_) = drawn(maps.value_map(mdp, values, Layout.grid(both))).axes
    (shapes,) = [c for c in axes.collections if type(c) is PolyCollection]
    middles = np.array([(p.vertices[:-1].min(0) + p.vertices[:-1].max(0)) / 2 for p in shapes.get_paths()])
    np.testing.assert_array_equal(np.round(middles), np.array(both)[:, ::-1])
    assert len(np.unique(middles.round(6), axis=0)) == 2 * N * N
    named = Layout.grid(both, layers=["without"] * N * N + ["with"] * N * N)
    figure = drawn(maps.value_map(mdp, values, named))
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["without", "with"]


def test_values_of_both_signs_share_a_scale_about_zero_and_others_their_own() -> None:
    mdp = grid()
    for values, limits in (
        (np.linspace(-1, 3, N * N), (-3, 3)),
        (np.linspace(2, 5, N * N), (2, 5)),
        (np.full(N * N, 4.0), (3.5, 4.5)),
    ):
        figure = drawn(maps.value_map(mdp, values, Layout.grid(CELLS), label="visits (steps)"))
        bar = figure.axes[-1]
        assert bar.get_ylim() == pytest.approx(limits)
        assert bar.get_ylabel() == "visits (steps)"


def test_a_missing_value_is_not_drawn() -> None:
    values = np.ones(N * N)
    values[3] = np.nan
    (axes, *_) = drawn(maps.value_map(grid(), values, Layout.grid(CELLS))).axes
    (shapes,) = [c for c in axes.collections if type(c) is PolyCollection]
    assert len(shapes.get_paths()) == N * N - 1


def test_a_layout_of_a_graph_puts_neighbours_close_together() -> None:
    mdp, _ = ring()
    layout = Layout.graph(mdp)
    apart = np.linalg.norm(layout.positions[:, None] - layout.positions[None], axis=-1)
    steps = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    steps = np.minimum(steps, 12 - steps)
    assert np.corrcoef(apart.ravel(), steps.ravel())[0, 1] > 0.95
    np.testing.assert_array_equal(layout.positions, Layout.graph(mdp).positions)
    drawn(maps.policy_map(mdp, np.ones((12, 3)), layout))


def test_parts_of_a_graph_that_nothing_joins_do_not_lie_on_each_other() -> None:
    mdp = TabularMDP.from_successors(np.arange(5)[:, None, None], np.ones((5, 1, 1)), np.zeros((5, 1, 1)))
    layout = Layout.graph(mdp)
    apart = np.linalg.norm(layout.positions[:, None] - layout.positions[None], axis=-1)
    assert apart[np.triu_indices(5, 1)].min() > 0.3


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
def test_domains_bring_their_layout(theme: style.Theme) -> None:
    for process in (random_object_world(jax.random.key(0)), mouse_labyrinth()):
        mdp, layout = process.mdp, process.layout
        figure = drawn(maps.policy_map(mdp, np.ones((mdp.n_states, mdp.n_actions)), layout, theme=theme))
        told = {text.get_text() for text in figure.axes[-1].texts}
        assert {mark.meaning for mark in layout.marks} <= told
    maze = mouse_labyrinth()
    assert maze.layout.n_places == 128
    np.testing.assert_array_equal(maze.layout.place[maze.node == 5], maze.layout.place[maze.node == 5][0])


@pytest.mark.parametrize("kind", ["open grid", "ring", "maze"])
def test_a_hidden_path_over_any_layout_shows_the_belief(kind: str) -> None:
    layout = {"open grid": Layout.grid(CELLS), "ring": ring()[1], "maze": mouse_labyrinth().layout}[kind]
    rng = np.random.default_rng(0)
    belief = np.zeros((8, layout.n_states))
    belief[np.arange(8), path := rng.integers(0, layout.n_states, 8)] = 1.0
    figure = drawn(maps.hidden_path(belief, np.ones(8, bool), layout, path))
    (axes,) = [axes for axes in figure.axes if axes.get_xlabel() == "step"]
    (mesh,) = [c for c in axes.collections if isinstance(c, QuadMesh)]
    np.testing.assert_allclose(np.asarray(mesh.get_array()).sum(0), 1.0)
    names = {label.get_text() for label in axes.get_yticklabels()}
    assert names <= set(layout.names)
    assert figure.get_size_inches()[1] < 9
    if kind == "maze":
        assert "that never reach 1%" in figure.get_suptitle()


def test_a_closed_loop_is_one_corridor() -> None:
    (strand,) = maps.corridors(ring()[1])
    assert len(strand) == 12


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Layout.grid([(0, 0.5)]), "whole numbers"),
        (lambda: Layout.grid([0, 1]), r"\[S, 2\] as \(row, column\)"),
        (
            lambda: Layout.grid([(0, 0), (0, 1)], layers=["a"]),
            "layers must be one for each of 2 states",
        ),
        (lambda: Layout.grid([(0, 0)], headings=np.zeros(3)), "headings must be one for each of 1 states"),
        (lambda: Layout.points(np.zeros((3, 2)), ring()[0]), r"shape \(12, 2\) as \(x, y\)"),
    ],
)
def test_places_that_do_not_fit_are_refused(make, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


def test_a_mark_has_its_letter_on_the_map_and_its_meaning_in_the_key() -> None:
    layout = Layout.grid(CELLS, marks=[Mark("G", (3, 3), "the goal")])
    figure = drawn(maps.policy_map(grid(), np.ones((N * N, 4)), layout))
    assert "G" in {text.get_text() for text in figure.axes[0].texts}
    assert {"G", "the goal"} <= {text.get_text() for text in figure.axes[-1].texts}
