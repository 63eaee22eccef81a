import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.bounds.stopping import (
    NEVER,
    Sweep,
    judge_stops,
    learning_error_change,
    likelihood_change,
    moving_window,
    policy_window,
    stopping_plot,
    sweep_tolerance,
)
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.inference import LikelihoodChange, MovingWindow, PolicyWindow, SessionInfo
from i2rl.inference.sessions.stopping import LearningErrorChange
from i2rl.models import deterministic_policy, hard_plan, policy_values, reward_of

STREAMS, SESSIONS = 8, 25


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(5, n_states=6, n_actions=3, n_features=2)


@pytest.fixture(scope="module")
def reports():
    """Streams whose likelihoods, gradients and weights settle, with pauses."""
    rng = np.random.default_rng(0)
    t = np.arange(1, SESSIONS + 1)
    noise = rng.normal(size=(STREAMS, SESSIONS)) * (rng.random((STREAMS, SESSIONS)) < 0.6)
    likelihood = -3 + noise / t
    gradient = np.abs(rng.normal(size=(STREAMS, SESSIONS))) / t
    weights = np.array([1.0, -1.0]) + 4 * rng.normal(size=(STREAMS, SESSIONS, 2)) / t[:, None] ** 1.3
    return [
        [
            SessionInfo(
                int(i), likelihood[s, i - 1], 0.0, gradient[s, i - 1], 1, 1, True, 0.0, weights[s, i - 1]
            )
            for i in t
        ]
        for s in range(STREAMS)
    ]


def stops_of(rule, reports):
    """Apply the rule itself, after every session of every stream."""
    return [next((i for i in range(1, len(stream) + 1) if rule(stream[:i])), NEVER) for stream in reports]


def field(reports, name):
    return np.array([[getattr(r, name) for r in stream] for stream in reports])


@pytest.mark.parametrize("rho", [0.0, 0.01, 0.1, 0.5])
def test_likelihood_rules_on_all_streams_equal_the_rules_themselves(reports, rho):
    likelihood, gradient = field(reports, "log_likelihood"), field(reports, "gradient")
    expected = stops_of(LikelihoodChange(rho), reports)
    assert likelihood_change(likelihood, rho).tolist() == expected
    for width in (2, 5):
        expected = stops_of(MovingWindow(width, rho), reports)
        assert moving_window(likelihood, width, rho).tolist() == expected
        expected = stops_of(MovingWindow(width, rho, "gradient"), reports)
        assert moving_window(gradient, width, rho).tolist() == expected


def test_rules_on_weights_equal_the_rules_themselves(mdp, reports):
    few, true = [stream[:12] for stream in reports[:3]], np.array([1.0, -1.0])
    reward = reward_of(mdp, jnp.asarray(true))
    best = hard_plan(mdp, reward).values

    def plan(weights):
        policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)
        return jnp.argmax(policy, axis=1), jnp.abs(best - policy_values(mdp, policy, reward)).sum()

    greedy, error = jax.jit(jax.vmap(jax.vmap(plan)))(field(few, "weights"))
    seen = set()
    for rho in (0.0, 0.3):
        expected = stops_of(LearningErrorChange(rho, mdp, true), few)
        assert learning_error_change(np.asarray(error), rho).tolist() == expected
        stops = policy_window(np.asarray(greedy), 4, rho).tolist()
        assert stops == stops_of(PolicyWindow(4, rho, mdp), few)
        seen |= {*expected, *stops}
    assert len(seen) > 2


def test_a_window_longer_than_the_stream_never_stops(reports):
    assert not moving_window(field(reports, "gradient"), SESSIONS + 1, 9.0).any()
    assert not policy_window(np.zeros((2, 3, 4), int), 4, 1.0).any()


def test_a_window_of_policies_waits_for_agreement(mdp):
    def report(*weights):
        return SessionInfo(1, 0.0, 0.0, 0.0, 1, 1, True, 0.0, np.array(weights))

    stop = PolicyWindow(3, 0.0, mdp)
    same, opposite = report(1.0, -1.0), report(-1.0, 1.0)
    assert not stop([same, same])
    assert not stop([opposite, same, same])
    assert stop([opposite, same, report(2.0, -2.0), same])
    assert PolicyWindow(2, 1.0, mdp)([opposite, same])
    with pytest.raises(ValueError, match="at least 2"):
        PolicyWindow(1, 0.0, mdp)
    with pytest.raises(ValueError, match="share of the states"):
        PolicyWindow(2, 5, mdp)


def test_a_stop_is_false_where_the_stream_would_have_become_better():
    accuracy = np.array([
        [0.2, 0.6, 0.8, 1.0, 0.9],  # settles at 0.95
        [0.9, 0.9, 0.9, 0.5, 0.5],  # got worse: any stop is fine
        [0.2, 0.2, 0.4, 1.0, 1.0],
        [0.2, 0.2, 0.4, 1.0, 1.0],
    ])  # fmt: skip
    stops = np.array([3, 1, 2, NEVER])
    verdict = judge_stops(stops, accuracy, margin=0.1, tail=2)
    assert (verdict.false_stops, verdict.stops, verdict.replications) == (2, 3, 4)
    assert verdict.used.tolist() == [3, 1, 2, 5]
    assert verdict.false_rate == 0.5
    assert verdict.saved == pytest.approx(1 - 11 / 20)
    assert verdict.loss == pytest.approx((0.15 - 0.4 + 0.8) / 4)
    assert judge_stops(stops, accuracy, margin=0.2, tail=2).false_stops == 1
    low, high = verdict.interval()
    assert 0 < low < 0.5 < high < 1


def test_stopping_at_the_end_or_never_is_no_false_stop():
    accuracy = np.linspace(0, 1, 10)[None].repeat(2, axis=0)
    assert judge_stops(np.array([10, NEVER]), accuracy, 0.0, 1).false_stops == 0
    assert judge_stops(np.array([10, NEVER]), accuracy, 0.0, 1).saved == 0


@pytest.mark.parametrize(
    ("stops", "margin", "tail", "message"),
    [
        ([1, 2], 0.1, 1, "stops must be 3"),
        ([1, 2, 9], 0.1, 1, "from 1 to 9"),
        ([1, 2, -1], 0.1, 1, "from -1"),
        ([1, 2, 3], -0.1, 1, "margin"),
        ([1, 2, 3], 0.1, 5, "tail 1 to 4"),
    ],
)
def test_impossible_judgements_are_refused(stops, margin, tail, message):
    with pytest.raises(ValueError, match=message):
        judge_stops(np.array(stops), np.zeros((3, 4)), margin, tail)


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_the_figure_has_a_line_a_rule(reports, theme):
    likelihood = field(reports, "log_likelihood")
    accuracy = 1 - 1 / np.arange(1, SESSIONS + 1)[None].repeat(STREAMS, axis=0)
    rules = {
        "single": lambda x: likelihood_change(likelihood, x),
        "window": lambda x: moving_window(likelihood, 5, x),
    }
    sweeps = [sweep_tolerance(n, "nats", r, [0.001, 0.1, 1.0], accuracy, 0.05, 3) for n, r in rules.items()]
    assert sweeps[0].at(0.1) is sweeps[0].verdicts[1]
    with pytest.raises(ValueError, match=r"not run at rho = 0.2"):
        sweeps[0].at(0.2)
    figure = stopping_plot(sweeps, control=sweeps[1], theme=theme, title="Stopping")
    axes = figure.axes[0]
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["window", "single", "window"]
    for line, one in zip(axes.lines[1:], sweeps, strict=True):
        assert np.allclose(line.get_xdata(), [v.used.mean() for v in one.verdicts])
        assert np.allclose(line.get_ydata(), [v.false_rate for v in one.verdicts])
    with pytest.raises(ValueError, match="no sweep"):
        stopping_plot([])


def test_a_sweep_judges_every_tolerance():
    accuracy = np.array([[0.0, 1.0, 1.0]])
    one = sweep_tolerance(
        "at once", "sessions", lambda rho: np.array([int(rho)]), [0, 1, 2], accuracy, 0.1, 1
    )
    assert isinstance(one, Sweep)
    assert [v.false_stops for v in one.verdicts] == [0, 1, 0]
