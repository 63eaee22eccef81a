from __future__ import annotations

import struct
import warnings
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from i2rl.analysis.drawing import charts as figures
from i2rl.analysis.drawing import maps, style
from i2rl.analysis.judging.metrics import greedy_policy
from i2rl.analysis.studies.adversarial import results as adversarial_results
from i2rl.analysis.studies.noisy import study as noisy_study
from i2rl.analysis.studies.patrol import study as patrol_study
from i2rl.analysis.studies.sorting import study as sorting_study
from i2rl.domains.patrol.process import RIGHT, STOP, demonstrate, instance
from i2rl.inference.completion.smoothing import evidence_of, smooth_all
from i2rl.models import reward_of, soft_plan
from i2rl.models.observation.demonstration import SEEN, Demonstration


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def drawn(figure: Figure) -> Figure:
    """Render the figure, so that errors and warnings of drawing show."""
    FigureCanvasAgg(figure).draw()
    return figure


def charts(figure: Figure) -> list:
    return [axes for axes in figure.axes if axes.axison]


@jax.jit
def state_marginals(mdp, weights, sensor, demonstration):
    log_policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
    return smooth_all(mdp, log_policy, evidence_of(mdp, sensor, demonstration)).pairs[0].sum(-1)


@cache
def belief(number: int, observability: int, steps: int = 30):
    patrol = instance(number)
    demonstration = demonstrate(jax.random.key(3), patrol, observability, 1, steps)[0]
    posterior = state_marginals(
        patrol.mdp, 10 * jnp.asarray(patrol.weights), patrol.visibility(observability), demonstration
    )
    return patrol, demonstration, np.asarray(posterior)


@cache
def expert_policy(number: int):
    return instance(number).expert_policy()


def curve(method: str, replications: int = 3) -> figures.LearningCurve:
    rng = np.random.default_rng(0)
    return figures.LearningCurve(
        method, np.arange(1, 21), rng.random((replications, 20)), -rng.random((replications, 20))
    )


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_experts_own_map_has_no_disagreement(number: int, theme: style.Theme) -> None:
    patrol = instance(number)
    figure = drawn(
        maps.policy_map(
            patrol.mdp,
            expert_policy(number),
            patrol.layout,
            weights=patrol.weights,
            in_view=patrol.views[min(patrol.views)],
            theme=theme,
        )
    )
    n = patrol.mdp.n_states
    assert f"{n} of {n} states as the expert (100.0 %)" in figure.get_suptitle()
    panels = charts(figure)
    assert len(panels) == (4 if number == 1 else 1)
    for axes in panels:
        assert axes.get_xlabel() == "column (cells)"
        assert axes.get_ylabel() == "row (cells)"
        wedges = [c for c in axes.collections if type(c) is PolyCollection]
        assert sum(len(c.get_paths()) for c in wedges) == 0


def test_a_map_marks_exactly_the_states_that_differ() -> None:
    patrol = instance(2)
    policy = np.array(expert_policy(int(patrol.name[-1])))
    policy[[5, 17, 40]] = np.eye(4)[STOP]
    figure = drawn(maps.policy_map(patrol.mdp, policy, patrol.layout, weights=patrol.weights))
    (axes,) = charts(figure)
    wedges = [path for c in axes.collections if type(c) is PolyCollection for path in c.get_paths()]
    at = {(round(y), round(x)) for x, y in (path.vertices[:3].mean(0) for path in wedges)}
    assert len(wedges) == 3
    assert at == {patrol.states[s].cell for s in (5, 17, 40)}
    assert "121 of 124" in figure.get_suptitle()


def test_glyphs_point_where_the_action_leads() -> None:
    north, east = np.pi / 2, 0.0
    ahead = maps._placed(np.array([(1.0, 0.0)]), np.array([2.0, 5.0]), north)
    np.testing.assert_allclose(ahead, [(2.0, 4.0)], atol=1e-12)
    upward = maps._placed(np.array([(1.0, 0.0)]), np.array([2.0, 5.0]), north, down=1)
    np.testing.assert_allclose(upward, [(2.0, 6.0)], atol=1e-12)
    # Facing east, the right hand points south: larger rows, at the bottom of the page.
    hook = maps._placed(maps._FACING[RIGHT].vertices, np.zeros(2), east)
    assert hook[:, 1].max() > -hook[:, 1].min()


def test_soft_and_greedy_policies_of_the_same_weights_give_the_same_map() -> None:
    patrol = instance(3)
    soft = jax.jit(soft_plan)(patrol.mdp, reward_of(patrol.mdp, 50 * jnp.asarray(patrol.weights))).policy
    titles = [
        maps.policy_map(patrol.mdp, policy, patrol.layout, weights=patrol.weights).get_suptitle()
        for policy in (soft, greedy_policy(patrol.mdp, patrol.weights))
    ]
    assert titles[0] == titles[1]
    assert "184 of 184" in titles[0]


def test_a_map_refuses_another_process_policy_view_or_layout() -> None:
    patrol, policy = instance(2), expert_policy(2)
    with pytest.raises(ValueError, match=r"\[S, A\] = \(124, 4\); got \(3, 4\)"):
        maps.policy_map(patrol.mdp, np.ones((3, 4)), patrol.layout)
    with pytest.raises(ValueError, match=r"in_view must have shape \[S\] = \(124,\); got \(3,\)"):
        maps.policy_map(patrol.mdp, policy, patrol.layout, in_view=np.ones(3, bool))
    with pytest.raises(ValueError, match="place the 124 states of the process; got 184"):
        maps.policy_map(patrol.mdp, policy, instance(3).layout)
    with pytest.raises(TypeError, match=r"layout must be a Layout, .* got Patrol"):
        maps.value_map(patrol.mdp, np.ones(124), patrol)
    with pytest.raises(ValueError, match=r"values must have shape \[S\] = \(124,\); got \(3,\)"):
        maps.value_map(patrol.mdp, np.ones(3), patrol.layout)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_corridors_hold_every_cell_once_and_each_can_be_walked(number: int) -> None:
    layout = instance(number).layout
    strands = maps.corridors(layout)
    assert sorted(i for strand in strands for i in strand) == list(range(layout.n_places))
    for strand in strands:
        steps = np.abs(np.diff(layout.positions[list(strand)], axis=0)).sum(1)
        assert (steps == 1).all()
    assert [len(s) for s in strands] == sorted((len(s) for s in strands), reverse=True)


def test_the_hallway_of_the_second_instance_is_one_corridor() -> None:
    layout = instance(2).layout
    (strand,) = maps.corridors(layout)
    assert (layout.names[strand[0]], layout.names[strand[-1]]) == ("(0,8)", "(16,8)")


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
@pytest.mark.parametrize(("number", "observability"), [(1, 44), (2, 30), (3, 46)])
def test_a_hidden_path_shows_all_of_the_belief(number: int, observability: int, theme: style.Theme) -> None:
    patrol, demonstration, posterior = belief(number, observability)
    seen = demonstration.kind[0] == SEEN
    figure = drawn(
        maps.hidden_path(posterior, seen, patrol.layout, posterior.argmax(1), seconds=2.0, theme=theme)
    )
    (axes,) = [axes for axes in figure.axes if axes.get_xlabel() == "time (s)"]
    (mesh,) = [c for c in axes.collections if isinstance(c, QuadMesh)]
    shown = np.asarray(mesh.get_array())
    np.testing.assert_allclose(shown.sum(0), 1.0)
    # Rows are cells, and gaps between corridors are empty.
    by_cell = np.zeros((len(posterior), len(patrol.cells)))
    np.add.at(by_cell.T, patrol.cell_of_state, posterior.T)
    np.testing.assert_allclose(np.sort(shown.max(1))[-len(patrol.cells) :], np.sort(by_cell.max(0)))
    assert mesh.get_clim() == (0, 1)
    assert "cell" in axes.get_ylabel()
    assert any(a.get_ylabel() == "probability of the cell" for a in figure.axes)
    names = [label.get_text() for label in axes.get_yticklabels()]
    ends = {s[i] for s in maps.corridors(patrol.layout) for i in (0, -1)}
    assert {patrol.layout.names[i] for i in ends} <= set(names)


def test_a_hidden_path_refuses_a_belief_of_another_length() -> None:
    patrol = instance(2)
    with pytest.raises(ValueError, match=r"\(4, 124\); got \(5, 124\)"):
        maps.hidden_path(np.ones((5, 124)) / 124, np.ones(4, bool), patrol.layout)


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
@pytest.mark.parametrize("x_scale", ["linear", "log"])
def test_learning_curves_show_every_method_once(x_scale: str, theme: style.Theme) -> None:
    curves = [curve("one"), curve("two", 5), curve("alone", 1)]
    figure = drawn(
        figures.learning_curves(
            curves, expert_log_likelihood=-0.2, x_scale=x_scale, theme=theme, title="A title"
        )
    )
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "two", "alone", "true weights"]
    assert legend.get_title().get_text() == "A title"
    left, right = charts(figure)
    assert (left.get_ylabel(), right.get_ylabel()) == ("share of states", "nats per trajectory")
    assert left.get_xlabel() == right.get_xlabel() == "session"
    assert left.get_xscale() == x_scale
    assert left.get_ylim()[0] == 0
    np.testing.assert_allclose(left.lines[0].get_ydata(), np.median(curves[0].accuracy, axis=0))
    # A single run has no spread to show.
    assert len(left.collections) == 2
    assert "middle 50% of 1 to 5 replications" in figure.get_supxlabel()


def test_learning_curves_refuse_runs_of_another_length() -> None:
    short = curve("short")._replace(sessions=np.arange(3))
    with pytest.raises(ValueError, match=r"short: replications of shape \(3, 20\) do not fit \(3,\)"):
        figures.learning_curves([short])


def test_learning_time_is_on_logarithmic_scales_with_plain_numbers() -> None:
    x = np.array([1, 10, 100])
    times = [
        figures.LearningTime(m, x, np.outer([1, 2, 3], x) * s) for m, s in (("online", 0.01), ("batch", 1.0))
    ]
    figure = drawn(figures.learning_time(times))
    (axes,) = charts(figure)
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylabel() == "learning time (s)"
    assert {"1", "10", "100"} <= {label.get_text() for label in axes.get_xticklabels()}
    with pytest.raises(ValueError, match="batch must be positive"):
        figures.learning_time([times[1]._replace(seconds=np.zeros((1, 3)))])


def test_success_rates_show_rates_within_their_intervals() -> None:
    rates = [figures.SuccessRate("all", 20, 0, 20), figures.SuccessRate("half", 10, 5, 20)]
    figure = drawn(figures.success_rates(rates))
    left, right = charts(figure)
    np.testing.assert_allclose(left.lines[0].get_xdata(), [1.0, 0.5])
    np.testing.assert_allclose(right.lines[0].get_xdata(), [0.0, 0.25])
    for axes in (left, right):
        (bars,) = axes.collections
        for (low, high), rate in zip(
            (segment[:, 0] for segment in bars.get_segments()), axes.lines[0].get_xdata(), strict=True
        ):
            assert low - 1e-12 <= rate <= high + 1e-12
    # Wilson's score interval solves (rate - p)^2 = z^2 p (1 - p) / n.
    for p in left.collections[0].get_segments()[1][:, 0]:
        assert (0.5 - p) ** 2 == pytest.approx(1.959964**2 * p * (1 - p) / 20, rel=1e-5)
    assert [label.get_text() for label in left.get_yticklabels()] == ["all", "half"]
    with pytest.raises(ValueError, match="odd: 3 successes and 2 time-outs of 4 replications"):
        figures.success_rates([figures.SuccessRate("odd", 3, 2, 4)])


def test_weights_are_compared_by_direction() -> None:
    true, draws = np.array([1.0, -1.0, 0.0]), np.array([[2.0, -2.0, 0.0], [30.0, -30.0, 0.0]])
    figure = drawn(figures.weights_plot(["a", "b", "c"], true, draws))
    (axes,) = charts(figure)
    learned, truth = (line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 3)
    np.testing.assert_allclose(learned, [0.5, -0.5, 0.0])
    np.testing.assert_allclose(truth, learned)
    with pytest.raises(ValueError, match="no direction"):
        figures.weights_plot(["a"], np.zeros(1), np.ones(1))


def luminance(color: str) -> float:
    channels = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
    return float(np.dot([0.2126, 0.7152, 0.0722], channels))


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
def test_themes_are_legible(theme: style.Theme) -> None:
    def contrast(a: str, b: str) -> float:
        bright, dark = sorted((luminance(a), luminance(b)), reverse=True)
        return (bright + 0.05) / (dark + 0.05)

    # WCAG 2: 4.5 for text, 3 for graphics.
    assert min(contrast(c, theme.surface) for c in (theme.ink, theme.muted)) >= 4.5
    assert min(contrast(c, theme.surface) for c in (*theme.series, theme.goal)) >= 3
    assert min(contrast(theme.match, ground) for ground in (theme.cell, theme.view)) >= 3
    assert contrast(theme.ink, theme.mismatch) >= 4
    steps = [luminance(theme.colormap(x)[:3]) for x in np.linspace(0, 1, 30)]
    assert abs(np.sign(np.diff(steps)).sum()) == 29


# Machado, Oliveira and Fernandes (2009): sight without one kind of cones, in linear sRGB.
SIGHTS = {
    "all": np.eye(3),
    "no red": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue": [
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}  # fmt: skip


def oklab(linear: np.ndarray) -> np.ndarray:
    cones = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    axes = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    return np.cbrt(np.clip(linear, 0, 1) @ np.transpose(cones)) @ np.transpose(axes)


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
def test_every_two_colours_of_methods_are_told_apart(theme: style.Theme, sight: str) -> None:
    rgb = np.array([to_rgb(colour) for colour in theme.series])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = oklab(np.clip(linear @ np.transpose(SIGHTS[sight]), 0, 1))
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1)[np.triu_indices(len(seen), 1)]
    assert apart.min() > 0.1


# Methods that share a panel.
TOGETHER = [
    [patrol_study.ONLINE, patrol_study.FORGETFUL, patrol_study.BATCH, "batch LME, again after every session"],
    [
        "Jin et al., table over states",
        "Jin et al., features",
        "DARKO, goals",
        "DARKO, windows of 5",
        "ME-I2RL, features",
        "LME-I2RL, seen",
    ],
    list(sorting_study.METHODS.values()),
    [noisy_study.PLAIN, noisy_study.AVERAGED, noisy_study.STEPWISE, noisy_study.BARE],
    [noisy_study.ORACLE, noisy_study.OBSERVED, noisy_study.FAIR, noisy_study.CODED, noisy_study.ALL],
    [
        noisy_study.PLAIN,
        noisy_study.AVERAGED,
        noisy_study.STEPWISE,
        noisy_study.FAIR,
        noisy_study.KNOWN,
        noisy_study.CLEAR,
        noisy_study.ROBUST,
        noisy_study.MLIRL,
    ],
    [noisy_study.HIDDEN, noisy_study.BOTH],
    list(adversarial_results.METHODS),
    ["AIRL, clean input", "AIRL, noisy input", "robust-AIRL", "robust-AIRL, sensor learned", "LME-I2RL"],
    ["AIRL, noisy input", "robust-AIRL", "AIRL, noisy input, memory", "robust-AIRL, memory"],
    [
        "i2rl",
        "i2rl, by level",
        "uniform",
        "frequencies",
        "frequencies of choices",
        "given entry",
        "level and entry",
        "Markov",
    ],
    ["BIRL", "MaxEnt"],
]


@pytest.mark.parametrize("names", TOGETHER, ids=lambda names: names[0])
def test_methods_of_a_panel_differ_in_colour_in_dashes_and_in_marker(names: list[str]) -> None:
    assert {style._SAME.get(name, name) for name in names} <= set(style.METHOD_LOOKS)
    looks = style.method_styles(style.LIGHT, names)
    for part in ("color", "linestyle", "marker"):
        assert len({look[part] for look in looks.values()}) == len(names)


def test_no_two_methods_look_the_same_and_none_changes_its_look() -> None:
    assert len(set(style.METHOD_LOOKS.values())) == len(style.METHOD_LOOKS)
    for names in TOGETHER:
        for name in names:
            alone = style.method_styles(style.DARK, [name])[name]
            assert style.method_styles(style.DARK, [*names, "another"])[name] == alone


def test_methods_of_others_take_colours_that_are_left() -> None:
    looks = style.method_styles(style.LIGHT, ["mine", "LME-I2RL", "yours"])
    assert len({look["color"] for look in looks.values()}) == 3


@pytest.mark.parametrize("theme", style.THEMES, ids=lambda theme: theme.name)
def test_signed_shades_put_zero_in_the_middle_and_grow_to_both_sides(theme: style.Theme) -> None:
    shades = theme.signed_shades(np.array([-0.5, 2.0, np.nan]))
    assert (shades.norm.vmin, shades.norm.vmax) == (-2, 2)
    np.testing.assert_allclose(shades.to_rgba(0.0)[:3], to_rgb(theme.signed[2]), atol=0.01)
    steps = [luminance(shades.to_rgba(x)[:3]) for x in np.linspace(-2, 2, 41)]
    away = np.abs(np.array(steps) - steps[20])
    assert (np.diff(away[:21]) <= 1e-9).all()
    assert (np.diff(away[20:]) >= -1e-9).all()
    assert theme.signed_shades(np.zeros(3)).norm.vmax > 0


NAMES = ["speed [m/s]", "cost $x_1$ of $x_2$", "_hidden", "\x1b[31mred"]


def shown_texts(figure: Figure) -> list[str]:
    told = []
    for text in drawn(figure).findobj(mpl.text.Text):
        content, formula = text._preprocess_math(text.get_text())
        assert not formula, content
        told.append(content.removeprefix("\u2060"))
    return told


def test_names_of_methods_and_features_are_drawn_as_they_are() -> None:
    curves = [curve(name) for name in NAMES]
    rates = [figures.SuccessRate(name, 1, 1, 3) for name in NAMES]
    for figure in (
        figures.learning_curves(curves, title="a $b$ c"),
        figures.success_rates(rates),
        figures.weights_plot(NAMES, np.ones(4), np.ones((2, 4))),
    ):
        told = shown_texts(figure)
        for name in NAMES[:3]:
            assert name in told
        assert "\\x1b[31mred" in told


def test_drawing_leaves_matplotlibs_settings_alone() -> None:
    before = dict(mpl.rcParams)
    drawn(figures.learning_curves([curve("one")], theme=style.DARK))
    drawn(maps.policy_map(instance(2).mdp, expert_policy(2), instance(2).layout, theme=style.DARK))
    assert dict(mpl.rcParams) == before


def test_both_themes_are_saved_as_small_png_files(tmp_path: Path) -> None:
    patrol = instance(1)
    paths = style.save_themes(
        lambda theme: maps.policy_map(patrol.mdp, expert_policy(1), patrol.layout, theme=theme),
        tmp_path / "new",
        "map",
    )
    assert [path.name for path in paths] == ["map-light.png", "map-dark.png"]
    for path in paths:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG")
        assert min(struct.unpack(">II", content[16:24])) > 600
        assert len(content) < 200_000
    assert paths[0].read_bytes() != paths[1].read_bytes()


def test_a_demonstration_seen_throughout_leaves_no_doubt() -> None:
    patrol, demonstration, posterior = belief(2, 100, 10)
    assert isinstance(demonstration, Demonstration)
    np.testing.assert_allclose(posterior[np.arange(10), demonstration.state[0]], 1.0)
    seen = demonstration.kind[0] == SEEN
    figure = drawn(maps.hidden_path(posterior, seen, patrol.layout, demonstration.state[0], seconds=2.0))
    (axes,) = [axes for axes in figure.axes if axes.get_xlabel() == "time (s)"]
    (mesh,) = [c for c in axes.collections if isinstance(c, QuadMesh)]
    assert set(np.unique(np.asarray(mesh.get_array()).round(9))) == {0.0, 1.0}
