import json
from dataclasses import replace
from functools import cache
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from i2rl.analysis.command.app import app
from i2rl.analysis.studies.label_bias import page as label_bias_report
from i2rl.analysis.studies.label_bias import study as label_bias
from i2rl.analysis.studies.label_bias.study import BOLTZMANN, EXPERTS, MAXENT, OPTIMAL, Setting
from i2rl.domains.object_world.process import random_object_world, walled_world, without_blocked_moves


def _small_world():
    walls = np.array([[0, 0, 1], [1, 0, 0]], bool)
    return walled_world(walls, ((0, 0), (1, 2)), weights=(1.0, 0.5, -0.1), discount=0.8)


_STEPS, _ETA, _DRAWS = 3, 2.0, 20_000


@cache
def _drawn_in_the_small_world(expert, blocked):
    world = _small_world() if blocked else without_blocked_moves(_small_world())
    return label_bias.demonstrate_and_score(
        jax.random.key(0), world.mdp, jnp.asarray(world.weights), _ETA, EXPERTS.index(expert), _STEPS, _DRAWS
    )


@pytest.mark.parametrize("expert", [BOLTZMANN, OPTIMAL, MAXENT])
@pytest.mark.parametrize("blocked", [True, False])
def test_likelihoods_are_those_of_enumeration(expert, blocked):
    world = _small_world() if blocked else without_blocked_moves(_small_world())
    mdp, steps, rationality = world.mdp, _STEPS, _ETA
    drawn = _drawn_in_the_small_world(expert, blocked)
    reward = np.asarray(mdp.features) @ world.weights
    available, following = np.asarray(mdp.available), np.asarray(mdp.successors)[..., 0]
    value = np.zeros(mdp.n_states)
    for _ in range(300):
        q = np.where(available, reward + 0.8 * value[following], -np.inf)
        value = q.max(1)
    boltzmann = np.exp(rationality * q) / np.exp(rationality * q).sum(1, keepdims=True)
    earned, likely = {}, {}
    for first, *actions in product(range(mdp.n_states), *[range(mdp.n_actions)] * steps):
        state, total, chance, open_way = first, 0.0, 1.0, True
        for action in actions:
            open_way &= bool(available[state, action])
            total += reward[state, action]
            chance *= boltzmann[state, action]
            state = following[state, action]
        if open_way:
            earned[first, *actions], likely[first, *actions] = total, chance
    log_z = np.log(np.exp(list(earned.values())).sum())
    for i in range(20):
        one = (int(drawn.states[i, 0]), *map(int, drawn.actions[i]))
        assert drawn.reward[i] == pytest.approx(earned[one], abs=1e-12)
        assert drawn.maxent[i] == pytest.approx(earned[one] - log_z, abs=1e-12)
        assert drawn.birl[i] == pytest.approx(np.log(likely[one]), abs=1e-9)
        path = np.asarray(drawn.states[i]), np.asarray(drawn.actions[i])
        advantages = (q - q.max(1, keepdims=True))[path].sum()
        assert drawn.birl[i] == pytest.approx(rationality * advantages - float(drawn.choice[i]), abs=1e-9)


def test_experts_draw_from_their_laws():
    starts = len(_small_world().cells)
    for expert in (BOLTZMANN, MAXENT):
        drawn = _drawn_in_the_small_world(expert, True)
        log_law = drawn.birl - np.log(starts) if expert == BOLTZMANN else drawn.maxent
        paths = np.column_stack([drawn.states[:, 0], drawn.actions])
        _, where, counts = np.unique(paths, axis=0, return_index=True, return_counts=True)
        chance = np.exp(np.asarray(log_law)[where])
        often = chance > 5 / _DRAWS
        assert chance[often].sum() > 0.9
        score = (counts - _DRAWS * chance)[often] / np.sqrt(_DRAWS * chance * (1 - chance))[often]
        assert stats.chi2.sf((score**2).sum(), often.sum()) > 1e-4


# As many worlds, trajectories and steps as the study below, so that they share its compiled program.
_WORLDS, _TRAJECTORIES = 8, 75


def _in_every_world(mdps, weights, expert):
    stacked = label_bias._stacked(mdps)
    return label_bias._in_every_world(
        jax.random.split(jax.random.key(3), len(mdps)),
        stacked,
        jnp.asarray(weights),
        1.0,
        0.99,
        label_bias.EXPERTS.index(expert),
        steps=Setting().steps,
        n=_TRAJECTORIES,
    )


def test_optimal_experts_earn_the_most_there_is():
    worlds = [random_object_world(jax.random.key(i)) for i in range(_WORLDS)]
    drawn = _in_every_world([world.mdp for world in worlds], worlds[0].weights, OPTIMAL)
    for i, world in enumerate(worlds):
        best = np.zeros(len(world.cells))
        reward = np.asarray(world.mdp.features) @ world.weights
        following = np.asarray(world.mdp.successors)[..., 0]
        for _ in range(Setting().steps):
            best = (reward + best[following]).max(1)
        np.testing.assert_allclose(drawn.reward[i], best[np.asarray(drawn.states[i, :, 0])])


def test_correlation_is_pearsons():
    x, y = np.random.default_rng(0).normal(size=(2, 40))
    found = label_bias.correlation(x, y)
    assert found.rho == pytest.approx(np.corrcoef(x, y)[0, 1])
    assert found.p == pytest.approx(label_bias.significance(found.rho, 40))
    centre, width = np.arctanh(found.rho), stats.norm.ppf(0.975) / np.sqrt(37)
    assert (found.low, found.high) == pytest.approx((np.tanh(centre - width), np.tanh(centre + width)))
    with pytest.raises(ValueError, match="constant"):
        label_bias.correlation(x, np.full(40, 0.1) * 3)


@cache
def _study():
    settings = (Setting(), Setting(OPTIMAL, rationality=10.0), Setting(MAXENT, blocked=False))
    return label_bias.label_bias_study(
        _WORLDS, _TRAJECTORIES, seed=3, settings=settings, rationalities=(1.0, 10.0)
    )


def test_maximum_entropy_has_no_label_bias():
    for result in _study().results:
        known = np.isfinite(result.maxent)
        assert known.any()
        np.testing.assert_allclose(result.maxent[known], 1.0, atol=1e-8)
    assert _study().maxent.rho == pytest.approx(1.0, abs=1e-8)
    assert _study().maxent.p < 1e-12


def test_bayesian_irl_has():
    first, optimal, _ = _study().results
    assert _study().birl.p > 0.05
    assert first.significant.value < 0.5
    # What the choices met on the way cost outweighs what better actions bring.
    assert (optimal.birl < -0.5).all()
    assert (optimal.choice > 0.5).all()


def test_the_world_shown_is_the_median_one():
    study = _study()
    assert study.birl.rho == pytest.approx(np.sort(study.results[0].birl)[3])
    assert study.trajectories.states.shape == (75, Setting().steps)
    along = study.trajectories.states[:, :-1], study.trajectories.actions[:, :-1]
    assert (study.world.mdp.successors[along][..., 0] == study.trajectories.states[:, 1:]).all()


def test_the_same_seed_gives_the_same_numbers():
    few = {"settings": (Setting(),), "rationalities": (1.0,)}
    one, again, other = (
        label_bias.label_bias_study(_WORLDS, _TRAJECTORIES, seed=s, **few) for s in (0, 0, 1)
    )
    assert (one.results[0].birl == again.results[0].birl).all()
    assert (one.results[0].birl != other.results[0].birl).any()


@pytest.mark.parametrize("given", [(0, 75), (3, 3)])
def test_too_little_is_refused(given):
    with pytest.raises(ValueError, match="at least 1 world, 4 trajectories"):
        label_bias.label_bias_study(*given)


def test_an_unknown_expert_is_refused():
    with pytest.raises(ValueError, match="expert must be"):
        label_bias.label_bias_study(1, 4, settings=(Setting("lucky"),), rationalities=())


@pytest.mark.usefixtures("small_pictures")
def test_worlds_without_a_correlation_are_left_out(tmp_path, page_faults):
    study = _study()
    # Where nothing is a feature, every trajectory earns nothing.
    flat = replace(study.world.mdp, features=jnp.zeros_like(study.world.mdp.features))
    walked = _in_every_world([flat] * _WORLDS, study.world.weights, BOLTZMANN)
    result = label_bias._result(Setting(), walked)
    assert np.isnan(result.birl).all()
    half = result._replace(
        birl=np.append(result.birl[1:], -0.9),
        p=np.append(result.p[1:], 1e-9),
        maxent=np.append(result.p[1:], 1),
    )
    assert (half.significant.value, half.negative.value) == (1.0, 1.0)
    # A page of nothing but such worlds is still one, and still JSON.
    sweep = dict.fromkeys((True, False), (result, half))
    told = label_bias_report.summary(study._replace(results=(half, result), sweep=sweep))
    assert json.loads(json.dumps(told, allow_nan=False))["settings"][1]["BIRL median rho"] is None
    page = label_bias_report.write(study._replace(results=(result, half), sweep=sweep), tmp_path)
    assert page_faults(page.read_text()) == []


def test_the_report_says_where_the_correlation_is_significant():
    study = _study()
    n = study.per_world

    def result(rationality, *rho):
        rho = np.array(rho)
        p = np.array([label_bias.significance(r, n) for r in rho])
        return label_bias.SettingResult(Setting(rationality=rationality), rho, p, np.ones_like(rho), rho)

    told = label_bias_report._conditions(
        study._replace(
            results=(result(1.0, 0.1, -0.1), result(2.0, 0.5, 0.4)),
            sweep={True: (result(3.0, -0.5, -0.4), result(4.0, 0.5, 0.1)), False: ()},
        )
    )
    settings, rationalities = told.split("\n\n")
    assert "significant in at most half of the worlds: Boltzmann experts, eta 1 |" in settings
    assert settings.endswith("positive and significant in more than half: Boltzmann experts, eta 2.")
    assert "significant in at most half of the worlds: 4 |" in rationalities
    assert rationalities.endswith("negative and significant in more than half: 3.")


@pytest.mark.parametrize(
    ("p", "told"), [(0.39321, "0.3932"), (3e-5, "< 0.0001"), (1e-9, "< 1 × 10⁻⁹"), (0.0, "< 1 × 10⁻³⁰⁰")]
)
def test_small_p_values_are_told_by_their_power_of_ten(p, told):
    assert label_bias.tell_p(p) == told


@pytest.mark.usefixtures("small_pictures")
def test_the_page_is_complete(tmp_path, page_faults):
    page = label_bias_report.write(_study(), tmp_path).read_text()
    assert page_faults(page) == []
    assert "Label bias" in page
    for name in ("world", "scatter", "settings", "sweep"):
        for theme in ("light", "dark"):
            assert (tmp_path / f"{name}-{theme}.png").stat().st_size > 500
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["dissertation"]["p of that rho for 75 trajectories"] == pytest.approx(0.1285, abs=1e-4)
    assert len(results["settings"]) == 3


@pytest.mark.usefixtures("small_pictures")
def test_the_command_writes_its_page(tmp_path, monkeypatch):
    monkeypatch.setattr(
        label_bias, "label_bias_study", lambda worlds, *_, **__: _study()._replace(worlds=worlds)
    )
    result = CliRunner().invoke(
        app,
        ["run", "label-bias", "--worlds", str(_WORLDS), "--folder", str(tmp_path), "--json"],
    )
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["worlds"] == _WORLDS
    assert (tmp_path / "index.html").exists()
