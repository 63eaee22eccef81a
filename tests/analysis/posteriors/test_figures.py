"""Figures of posteriors show the numbers that ArviZ computes."""

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis import (
    completed_path,
    forest_plot,
    posterior_by_session,
    predictive_check,
    predictive_visits,
    rank_plot,
    trace_plot,
    weights_by_session,
)
from i2rl.analysis.drawing.style import DARK, THEMES
from i2rl.analysis.posteriors.diagnostics import InferenceDataError
from i2rl.analysis.posteriors.figures import convergence_plot, predictive_plot
from i2rl.domains import instance
from i2rl.inference import sample_posterior
from i2rl.models import TrajectoryLaw, Visibility, sample_demonstration

OPTIONS = {"draws": 25, "warmup": 25, "chains": 2}


@pytest.fixture(scope="module")
def world(random_mdp):
    mdp = random_mdp(2)
    view = Visibility(np.arange(mdp.n_states) % 2 == 0)
    law = TrajectoryLaw(mdp, jnp.array([1.0, -0.5]), view, 6)
    return mdp, view, sample_demonstration(jax.random.key(0), law, 8)


@pytest.fixture(scope="module")
def posterior(world):
    mdp, view, demonstration = world
    drawn = sample_posterior(jax.random.key(1), mdp, view, demonstration, **OPTIONS)
    return predictive_visits(jax.random.key(2), drawn, mdp, view)


def _numbers(axes):
    return np.concatenate([np.concatenate([line.get_xdata(), line.get_ydata()]) for line in axes.get_lines()])


@pytest.mark.parametrize("theme", THEMES, ids=lambda theme: theme.name)
@pytest.mark.parametrize("draw", [forest_plot, trace_plot, rank_plot, convergence_plot, predictive_plot])
def test_every_figure_is_drawn_in_the_themes_colours(posterior, draw, theme):
    figure = draw(posterior, theme=theme)
    assert all(axes.get_facecolor() == figure.get_facecolor() for axes in figure.axes)
    assert any(axes.get_xlabel() or axes.get_ylabel() for axes in figure.axes) or figure.texts


BINS = 10


@pytest.fixture(scope="module")
def stuck():
    """Make four chains: one lies apart in a weight, one never moves in the next, none moves in the last."""
    weights = np.random.default_rng(0).normal(size=(4, 60, 4))
    weights[2, :, 1] = 3 + 0.01 * weights[2, :, 1]
    weights[3, :, 2] = 1.7
    weights[:, :, 3] = 0.5
    return az.from_dict(
        posterior={"weights": weights},
        coords={"feature": ["well", "stuck [m/s]", "$still$", "_frozen"]},
        dims={"weights": ["feature"]},
    )


def test_ranks_show_all_of_the_bars_of_a_stuck_chain(stuck):
    figure = rank_plot(stuck, bins=BINS)
    for axes, (name, weights) in zip(
        figure.axes, stuck.posterior["weights"].groupby("feature"), strict=False
    ):
        del name, weights
        bars = np.concatenate(
            [patch.get_data().values for patch in axes.patches if hasattr(patch, "get_data")]
        )
        assert axes.get_ylim()[0] == 0
        assert axes.get_ylim()[1] >= bars.max()
    # Sixty draws of one chain in the last bins of a panel whose first neighbours have six.
    highest = [axes.get_ylim()[1] for axes in figure.axes[:4]]
    assert highest[1] > 1.5 * highest[0]
    assert highest[2] > 60


def test_traces_show_a_chain_that_never_moves(stuck):
    figure = trace_plot(stuck)
    left = figure.axes[4]
    assert any(np.allclose(line.get_xdata(), 1.7) for line in left.get_lines())
    for axes in figure.axes[::2]:  # one spike does not press the other chains' densities down
        tops = [np.max(line.get_ydata()) for line in axes.get_lines()]
        assert min(tops) == pytest.approx(1)


def test_convergence_marks_what_is_stuck_and_clips_nothing(stuck):
    figure = convergence_plot(stuck)
    left, right = figure.axes
    told = [text.get_text() for axes in (left, right) for text in axes.texts]
    assert told == ["stuck: every draw is the same"] * 2
    assert [t.get_text() for t in left.get_yticklabels()][1:3] == ["stuck [m/s]", r"\$still\$"]
    rhat = next(line for line in left.get_lines() if len(line.get_xdata()) == 4).get_xdata()
    assert np.isnan(rhat).tolist() == [False, False, False, True]
    assert rhat[1] > 1.3
    low, high = left.get_xlim()
    assert low < np.nanmin(rhat)
    assert np.nanmax(rhat) < high
    for line in right.get_lines()[:2]:
        assert np.isnan(line.get_xdata()[3])


def test_the_forest_shows_each_weights_median(posterior):
    axes = forest_plot(posterior).axes[0]
    shown = np.concatenate([line.get_xdata() for line in axes.get_lines()])
    for median in np.median(posterior.posterior["weights"].values, axis=(0, 1)):
        assert np.isclose(shown, median).any()


def test_the_trace_shows_each_chains_draws(posterior):
    traces = trace_plot(posterior).axes
    weights = posterior.posterior["weights"].values
    drawn = [line.get_ydata() for axes in traces for line in axes.get_lines() if len(line.get_ydata()) == 25]
    for chain in range(2):
        assert any(np.allclose(line, weights[chain, :, 0]) for line in drawn)


def test_convergence_shows_arvizs_diagnostics(posterior):
    shown = np.concatenate([_numbers(axes) for axes in convergence_plot(posterior).axes])
    for value in (*az.rhat(posterior)["weights"].values, *az.ess(posterior)["weights"].values):
        assert np.isclose(shown, value).any()


def test_the_predictive_figure_shows_what_was_seen(posterior):
    check = predictive_check(posterior)
    figure = predictive_plot(posterior)
    shown = figure.axes[0]
    heights = np.concatenate([np.atleast_1d(line.get_ydata()) for line in shown.get_lines()])
    assert float(check.observed.max()) in heights
    assert f"{float(check.discrepancy_p_value):.3g}" in figure.get_supxlabel()


def test_weights_by_session_shows_the_median_of_each_session(world):
    mdp, view, demonstration = world
    by_session = posterior_by_session(jax.random.key(3), mdp, view, demonstration, [2, 8], **OPTIONS)
    figure = weights_by_session(by_session, true_weights=np.array([1.0, -0.5]), theme=DARK)
    medians = by_session.posterior["weights"].median(("chain", "draw"))
    for axes, feature in zip(figure.axes, medians["feature"].values, strict=False):
        numbers = _numbers(axes)
        for median in medians.sel(feature=feature).values:
            assert np.isclose(numbers, median).any()


def test_a_path_of_another_domain_or_of_rows_that_do_not_exist_is_refused(posterior):
    with pytest.raises(InferenceDataError):
        completed_path(instance(2).mdp, posterior, [0], instance(2).layout)


def test_a_figure_of_no_posterior_is_refused():
    for draw in (forest_plot, trace_plot, rank_plot, convergence_plot, weights_by_session):
        with pytest.raises(InferenceDataError):
            draw(az.from_dict(prior={"weights": np.zeros((1, 2, 2))}))
