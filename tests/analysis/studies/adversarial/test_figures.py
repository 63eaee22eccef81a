"""Figures, tables and files of adversarial learners: they show the numbers that they were given."""

import json
import math

import jax
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Polygon

from i2rl.analysis.drawing.style import DARK, LIGHT, method_styles
from i2rl.analysis.judging.returns import empirical_ile, seed_interval
from i2rl.analysis.studies.adversarial.figures import (
    belief_plot,
    cells_plot,
    frames_plot,
    learning_plot,
    recovery_plot,
    scatter_plot,
)
from i2rl.analysis.studies.adversarial.page import (
    breach_table,
    correlation_table,
    ile_table,
    learning_table,
    recovery_table,
    summary,
    write,
)
from i2rl.analysis.studies.adversarial.results import (
    CLEAN,
    NOISY,
    ROBUST,
    SSRR,
    AdversarialResults,
    MethodResult,
    belief_from_draws,
    frame_strip,
    load_results,
    reward_scatter,
    store_results,
)
from i2rl.analysis.studies.noisy.examples import Strip
from i2rl.domains.robots.walkers import locomotion
from i2rl.models import Demonstration, StorageError

LEVELS = {CLEAN: 2000.0, NOISY: 600.0, ROBUST: 1800.0, SSRR: 1500.0}
PAIRS = np.arange(1, 9) * 32


def _scatter(seed):
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(8, 30))
    learned = 3 * true + rng.normal(size=true.shape)
    return reward_scatter(learned, true, np.ones(true.shape, bool), np.arange(8) // 4, jax.random.key(seed))


@pytest.fixture(scope="module")
def hopper():
    rng = np.random.default_rng(0)
    scatters = {name: _scatter(i) for i, name in enumerate(LEVELS)}
    methods = {
        name: MethodResult(
            PAIRS,
            accuracy=rng.uniform(0.7, 0.9, (5, 8)),
            returns=level + rng.normal(0, 50, (5, 8)),
            correlations=(scatters[name].correlation,) * 2,
            seconds=1.5,
        )
        for name, level in LEVELS.items()
    }
    truth = rng.normal(size=(20, 3))
    draws = truth + rng.normal(size=(50, 20, 3))
    belief = belief_from_draws(("height (m)", "pitch (rad)", "torque"), truth + 1.0, truth, draws)
    robot = locomotion("hopper")
    states = robot.observe(robot.reset(jax.random.key(0), 4))
    return AdversarialResults(
        "hopper",
        "normal, covariance 0.05 I",
        5,
        "two cores",
        methods,
        accuracy_over="the expert's states",
        expert_return=2900.0,
        scatters=scatters,
        belief=belief,
        frames=(frame_strip(CLEAN, robot, states, frames=3, seconds=0.03),),
        settings={"iterations": 10},
    )


@pytest.fixture(scope="module")
def patrol():
    rng = np.random.default_rng(1)
    replications = {
        name: np.clip(level / 2100 + rng.normal(0, 0.01, (6, 8)), 0, 1) for name, level in LEVELS.items()
    }
    methods = {
        name: MethodResult(PAIRS, accuracy=x, breaches=x[:, -1] / 2, errors=(empirical_ile(0.9, 0.7),) * 3)
        for name, x in replications.items()
        if name != SSRR
    }
    return AdversarialResults("patrol", "5 % confusions", 6, "two cores", methods)


def _lines(axes):
    return {line.get_label(): line for line in axes.lines}


# -- figures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_learning_shows_each_methods_mean(hopper, patrol, theme):
    figure = learning_plot(hopper, theme)
    accuracy, returns = figure.axes
    for panel, measure in ((accuracy, "accuracy"), (returns, "returns")):
        for name in LEVELS:
            line = _lines(panel)[name]
            np.testing.assert_array_equal(line.get_xdata(), PAIRS)
            np.testing.assert_allclose(line.get_ydata(), getattr(hopper.methods[name], measure).mean(0))
            assert to_hex(line.get_color()) == to_hex(method_styles(theme, [name])[name]["color"])
    assert set(_lines(returns)["expert"].get_ydata()) == {2900.0}
    assert {t.get_text() for t in figure.legends[0].get_texts()} == {*LEVELS, "expert"}
    (only,) = learning_plot(patrol, theme).axes
    assert SSRR not in _lines(only)
    band = only.collections[0].get_paths()[0].vertices
    expected = seed_interval(patrol.methods[CLEAN].accuracy)
    for i, x in enumerate(PAIRS):
        ends = band[band[:, 0] == x, 1]
        np.testing.assert_allclose([ends.min(), ends.max()], [expected.low[i], min(expected.high[i], 1.0)])


def test_recovery_shows_the_share_and_the_dissertations(hopper, patrol):
    (axes,) = recovery_plot([hopper, patrol], LIGHT).axes
    points = {
        (float(x), int(y))
        for line in axes.lines
        if len(line.get_xdata()) == 1
        for x, y in [(line.get_xdata()[0], line.get_ydata()[0])]
    }
    late = {m: hopper.methods[m].returns[:, -2:].mean() for m in LEVELS}
    share = (late[ROBUST] - late[NOISY]) / (late[CLEAN] - late[NOISY])
    assert any(math.isclose(x, share) and y == 0 for x, y in points)
    assert (0.78, 0) in points
    assert [t.get_text() for t in axes.get_yticklabels()] == ["Hopper: return", "Patrol: LBA"]


def test_an_interval_without_an_end_is_shown_to_go_on(patrol):
    rng = np.random.default_rng(2)
    methods = {
        m: r._replace(accuracy=rng.uniform(0.4, 0.6, (6, 8)) - 0.01 * i)
        for i, (m, r) in enumerate(patrol.methods.items())
    }
    unclear = patrol._replace(methods=methods)
    assert unclear.recovery().lost < 1
    (axes,) = recovery_plot([unclear], LIGHT).axes
    assert any(line.get_marker() in ("<", ">") for line in axes.lines)
    assert "not known" in recovery_table(unclear).rows[-1][1]


def test_an_unknown_share_is_no_point_on_the_axis(patrol):
    level = {CLEAN: 0.8, NOISY: 0.9, ROBUST: 0.85}
    methods = {m: MethodResult(PAIRS, accuracy=np.full((1, 8), x)) for m, x in level.items()}
    unclear = patrol._replace(methods=methods, replications=1)
    assert unclear.recovery().share == -math.inf
    figure = recovery_plot([unclear], LIGHT)
    (axes,) = figure.axes
    assert "not known" in axes.texts[0].get_text()
    assert not [line for line in axes.lines if line.get_marker() not in (None, "None", "")]
    assert [len(line.get_xdata()) for line in axes.lines] == [2]  # the target alone
    assert figure.get_supxlabel() == "one replication a row, no interval"


def test_one_seed_has_no_interval_of_its_share(patrol):
    methods = {m: r._replace(accuracy=r.accuracy[:1]) for m, r in patrol.methods.items()}
    rows = recovery_table(patrol._replace(methods=methods, replications=1)).rows
    assert rows[-1][1].endswith("(one replication, no interval)")


def test_a_constant_reward_has_no_correlation_in_the_figure(hopper):
    flat = hopper.scatters[CLEAN]
    for part in ("steps", "trajectories"):
        none = getattr(flat.correlation, part)._replace(pearson=math.nan)
        flat = flat._replace(correlation=flat.correlation._replace(**{part: none}))
    (axes,) = scatter_plot({CLEAN: flat}, LIGHT).axes
    assert "nan" not in axes.get_title(loc="left")
    assert axes.get_title(loc="left").count("not defined") == 2


def test_scatter_shows_the_trajectories_and_tells_the_correlation(hopper):
    figure = scatter_plot(hopper.scatters, DARK, "Rewards")
    shown = [a for a in figure.axes if a.get_visible()]
    assert len(shown) == 4
    scatter = hopper.scatters[CLEAN]
    np.testing.assert_allclose(shown[0].collections[0].get_offsets(), scatter.steps)
    np.testing.assert_allclose(shown[0].collections[1].get_offsets(), scatter.trajectories)
    told = shown[0].get_title(loc="left")
    assert told.startswith(CLEAN)
    assert f"r = {scatter.correlation.steps.pearson:.2f}" in told
    assert any(text.get_text().startswith("240 steps of") for text in figure.texts)
    assert scatter.correlation.steps.n == 240


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_beliefs_show_truth_reports_and_posterior(hopper, theme):
    figure = belief_plot(hopper.belief, theme)
    panels = [a for a in figure.axes if a.get_visible()]
    assert [p.get_title(loc="left") for p in panels] == list(hopper.belief.names)
    for j, panel in enumerate(panels):
        drawn = [line.get_ydata() for line in panel.lines]
        for array in (hopper.belief.truth, hopper.belief.observed, hopper.belief.mean):
            assert any(np.array_equal(line, array[:, j]) for line in drawn)
    inside = np.mean((hopper.belief.low <= hopper.belief.truth) & (hopper.belief.truth <= hopper.belief.high))
    assert f"{inside:.0%} of the truth" in figure.get_supxlabel()


def test_beliefs_have_the_quantiles_of_their_draws():
    draws = np.arange(101.0)[:, None, None] * np.ones((1, 4, 2))
    found = belief_from_draws(("a", "b"), np.zeros((4, 2)), np.zeros((4, 2)), draws)
    np.testing.assert_allclose(found.low, 5)
    np.testing.assert_allclose(found.high, 95)
    np.testing.assert_allclose(found.mean, 50)
    with pytest.raises(ValueError, match="2 components need arrays"):
        belief_from_draws(("a", "b"), np.zeros((4, 2)), np.zeros((4, 3)), draws)


def test_cells_are_shown_where_they_are():
    """The first index is the position, to the right; the second the velocity, upwards."""
    share = np.zeros((4, 4))
    share[3, 0] = 1.0
    figure = cells_plot({CLEAN: share, NOISY: share}, (-1.2, -0.07), (0.6, 0.07), LIGHT)
    picture = figure.axes[0].images[0]
    assert picture.origin == "lower"
    assert picture.get_array()[0, 3] == 1.0
    assert tuple(picture.get_extent()) == (-1.2, 0.6, -0.07, 0.07)


def test_silhouettes_are_the_robots(hopper):
    """Check that every outline point of a limb is a radius away from the line between its ends."""
    figure = frames_plot(hopper.frames, LIGHT, "Hopper")
    (strip,) = hopper.frames
    limbs = [p for p in figure.axes[0].patches if isinstance(p, Polygon)]
    assert len(limbs) == strip.capsules.shape[0] * strip.capsules.shape[1]
    x1, z1, x2, z2, radius = strip.capsules[0, 0]
    outline = limbs[0].get_xy().copy()
    outline[:, 0] += (x1 + x2) / 2 - (outline[:, 0].min() + outline[:, 0].max()) / 2
    start, end = np.array([x1, z1]), np.array([x2, z2])
    along = np.clip((outline - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
    nearest = start + along[:, None] * (end - start)
    np.testing.assert_allclose(np.linalg.norm(outline - nearest, axis=1), radius, rtol=1e-6)
    labels = [t.get_text() for t in figure.axes[0].get_xticklabels()]
    assert labels[0] == "0.00 s\n0.00 m"


def test_a_strip_travels_as_far_as_the_robot():
    robot = locomotion("half-cheetah")
    states = robot.reset(jax.random.key(0), 1)
    start, seen = states[0, 1], []
    for _ in range(26):
        seen.append(robot.observe(states)[0])
        states, _, _ = robot.step(states, np.array([[1.0, -0.5, 0.3, -1.0, 0.5, 0.2]]))
    strip = frame_strip("expert", robot, np.array(seen), frames=6, seconds=25 * robot.step_seconds)
    np.testing.assert_allclose(strip.seconds, np.arange(6) * 5 * robot.step_seconds)
    moved = states[0, 1] - start
    assert strip.travelled[-1] == pytest.approx(moved, abs=0.1 * abs(moved) + 0.1)


# -- tables -------------------------------------------------------------------------------------------


def test_learning_is_told_beside_table_7_3(hopper):
    table = learning_table(hopper)
    assert list(table.headings) == ["method", "replications", "LBA, %", "return", "dissertation"]
    rows = {row[0]: row for row in table.rows}
    assert rows["expert"][-2:] == ["2,900", "2,810"]
    assert [rows[m][-1] for m in LEVELS] == ["2,130", "702", "1,810", "2,050"]
    band = seed_interval(hopper.methods[CLEAN].returns[:, -2:].mean(1))
    assert rows[CLEAN][3] == f"{band.mean:,.0f} ({band.low:,.0f} to {band.high:,.0f})"
    assert "the last 2 of 8 sessions" in table.caption


def test_recovery_is_told_as_the_dissertation_computes_it(hopper, patrol):
    """With the returns of Table 7.3 themselves, what is measured equals what was printed."""
    printed = {CLEAN: 2130.0, NOISY: 702.0, ROBUST: 1810.0, SSRR: 2050.0}
    same = {m: MethodResult(PAIRS, returns=np.full((5, 8), x)) for m, x in printed.items()}
    rows = recovery_table(hopper._replace(methods=same)).rows
    assert rows[0] == ("return lost to noise", "67%", "67%")
    for _, measured, theirs in rows[2:]:
        assert measured == f"{theirs} ({theirs} to {theirs})"
    assert [row[2] for row in rows[2:]] == ["78%", "94%"]
    assert recovery_table(patrol).rows[0][2] == "20%"


def test_breaches_and_errors_are_told_beside_the_dissertations(patrol):
    breaches = {row[0]: row for row in breach_table(patrol).rows}
    assert [breaches[m][-1] for m in (CLEAN, NOISY, ROBUST)] == ["-", "45 to 53", "59 to 66"]
    errors = {row[0]: row for row in ile_table(patrol._replace(domain="onion")).rows}
    assert errors[f"{NOISY}: dissertation"][1:4] == ("0.889", "0.625", "0.297")
    assert errors[NOISY][3] == "0.222 (0.222 to 0.222)"


def test_table_7_5_is_told_of_its_own_task_alone(patrol):
    table = ile_table(patrol)
    assert [row[0] for row in table.rows] == [CLEAN, NOISY, ROBUST]
    assert "7.5" not in table.caption


def test_correlations_are_told_beside_table_7_4(hopper):
    rows = {row[0]: row for row in correlation_table(hopper).rows}
    assert [rows[m][-1] for m in LEVELS] == ["0.95", "0.87", "0.96", "0.81"]
    assert rows[CLEAN][2] == "480"  # of two replications
    one = hopper._replace(
        methods={CLEAN: hopper.methods[CLEAN]._replace(correlations=(hopper.scatters[CLEAN].correlation,))}
    )
    ends = hopper.scatters[CLEAN].correlation.steps.bootstrap
    assert f"({ends.low:.2f} to {ends.high:.2f})" in correlation_table(one).rows[0][3]


def test_a_reward_that_never_changes_is_correlated_with_nothing(hopper):
    learned = np.random.default_rng(0).normal(size=(8, 30))
    same = reward_scatter(
        learned, np.full((8, 30), -1.0), np.ones((8, 30), bool), np.arange(8) // 4, jax.random.key(0)
    )
    shown = hopper._replace(methods={CLEAN: hopper.methods[CLEAN]._replace(correlations=(same.correlation,))})
    assert correlation_table(shown).rows[0][3:5] == ("-", "-")


def test_intervals_of_correlations_end_at_one(hopper):
    ends = [
        x._replace(steps=x.steps._replace(pearson=r))
        for x, r in zip((hopper.scatters[CLEAN].correlation,) * 2, (0.9, -0.3), strict=True)
    ]
    shown = hopper._replace(methods={CLEAN: hopper.methods[CLEAN]._replace(correlations=tuple(ends))})
    assert correlation_table(shown).rows[0][3] == "0.30 (-1.00 to 1.00)"


def test_a_loss_of_nothing_has_no_sign(hopper):
    slightly_better = {
        m: MethodResult(PAIRS, returns=np.full((5, 8), x)) for m, x in ((CLEAN, 2000.0), (NOISY, 2001.0))
    }
    assert recovery_table(hopper._replace(methods=slightly_better)).rows[0][1] == "0%"


@pytest.mark.usefixtures("small_pictures")
def test_a_trajectory_of_pairs_has_its_section(patrol, tmp_path, random_mdp):
    mdp = random_mdp(0)
    drawn = Demonstration.from_pairs(np.array([[0, 1, 2, 3, 0, 1]]), np.array([[0, 1, 2, 0, 1, 2]]))
    posterior = np.full((6, mdp.n_states, mdp.n_actions), 1 / (mdp.n_states * mdp.n_actions))
    page = write(patrol, tmp_path, [(Strip(drawn, drawn, posterior), mdp)]).read_text()
    assert "What one learner believes of a trajectory" in page
    assert (tmp_path / "strip-0-dark.png").exists()


# -- files --------------------------------------------------------------------------------------------


def _same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(_same, a, b))
    return a == b or (a != a and b != b)


def test_results_are_read_as_they_were_stored(hopper, patrol, tmp_path):
    methods = dict(hopper.methods)
    with_gaps = methods[CLEAN].returns.copy()
    with_gaps[0, 0] = np.nan
    methods[CLEAN] = methods[CLEAN]._replace(returns=with_gaps)
    for results in (hopper._replace(methods=methods), patrol):
        store_results(results, tmp_path / "results.json")
        assert _same(results, load_results(tmp_path / "results.json"))
    (tmp_path / "other.json").write_text('{"kind": "Nothing"}')
    with pytest.raises(ValueError, match="there is nothing of the kind 'Nothing'"):
        load_results(tmp_path / "other.json")
    (tmp_path / "other.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="does not hold the results"):
        load_results(tmp_path / "other.json")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 10**5,
        "1" * 5000,
        '{"kind": "Interval"}',
        '{"items": [[[], 1]]}',
        '{"items": 3}',
        "\xff",
        '{"array": [1, 2], "shape": [1099511627776]}',
        '{"float": "x"}',
        '{"a": 1, "a": 2}',
        "{}",
    ],
    ids=range(11),
)
def test_damaged_results_are_refused_by_file(text, tmp_path):
    (tmp_path / "other.json").write_text(text, encoding="latin-1")
    with pytest.raises(StorageError, match=r"other\.json: not stored results: ") as caught:
        load_results(tmp_path / "other.json")
    assert len(str(caught.value)) < 400


@pytest.mark.usefixtures("small_pictures")
def test_the_page_holds_everything(hopper, patrol, tmp_path, page_faults):
    page = write([patrol, hopper], tmp_path).read_text()
    assert page_faults(page) == []
    for name in (
        "patrol-learning",
        "hopper-learning",
        "hopper-rewards",
        "hopper-belief",
        "hopper-frames",
        "recovery",
    ):
        assert (tmp_path / f"{name}-light.png").exists()
        assert (tmp_path / f"{name}-dark.png").exists()
    assert page.count("data:image/png") == 2 * 6
    for told in ("Hopper: rewards", "59 to 66", "2,810", "What robustness recovers", "covariance 0.05 I"):
        assert told in page
    domains = json.loads((tmp_path / "results.json").read_text())["domains"]
    assert [d["domain"] for d in domains] == ["patrol", "hopper"]
    assert domains[1] == json.loads(json.dumps(summary(hopper)))
    clean = domains[1]["methods"][0]
    np.testing.assert_array_equal(clean["returns"], hopper.methods[CLEAN].returns)
    assert clean["correlations"][0]["steps"]["n"] == 240
    assert domains[1]["recovered"][ROBUST]["share"] == pytest.approx(hopper.recovery().share)
    assert _same(load_results(tmp_path / "hopper.results.json"), hopper)
