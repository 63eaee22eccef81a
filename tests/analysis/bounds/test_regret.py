import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.bounds.regret import (
    BoundCurve,
    RegretCurve,
    excess_risk,
    expected_visits,
    last_confident_session,
    log_log_slope,
    regret_gaps,
    regret_plot,
    running_mean,
    sure_bound,
)
from i2rl.analysis.bounds.theorems import no_regret
from i2rl.analysis.drawing.style import DARK, LIGHT
from i2rl.inference import Harmonic, lme_i2rl, me_i2rl
from i2rl.models import (
    Demonstration,
    Sensor,
    TrajectoryLaw,
    Visibility,
    feature_expectations,
    occupancy,
    reward_of,
    sample_demonstration,
    soft_plan,
)

TRUE = jnp.array([1.0, 0.4])
OTHER = jnp.array([-0.5, 1.5])


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(11, n_states=6, n_actions=3, n_successors=2, n_features=2, discount=0.7)


@pytest.fixture(scope="module")
def plan(mdp):
    return soft_plan(mdp, reward_of(mdp, TRUE))


def streams(mdp, sensor, replications, sessions, length, trajectories=1):
    """Independent trajectories of the soft expert as arrays ``[R, T, n, L]``."""
    law = TrajectoryLaw(mdp, TRUE, sensor, length)
    codes = sample_demonstration(jax.random.key(3), law, replications * sessions * trajectories).codes
    return Demonstration.from_codes(codes.reshape(replications, sessions, trajectories, length, 3))


def test_visits_are_powers_of_the_transition_matrix(mdp, plan, dense_transitions):
    policy = np.asarray(plan.policy)
    chain = np.einsum("sa,sat->st", policy, dense_transitions(mdp))
    state, total = np.asarray(mdp.initial), np.zeros(6)
    for _ in range(12):
        total += state
        state = state @ chain
    assert np.allclose(expected_visits(mdp, plan.policy, 4, 3), total[:, None] * policy / 3, atol=1e-12)
    with pytest.raises(ValueError, match="one step and one window"):
        expected_visits(mdp, plan.policy, 0)


def test_the_excess_risk_of_whole_trajectories_is_the_difference_of_likelihoods(mdp, plan):
    features = feature_expectations(mdp, plan.policy)

    def expected(weights):
        return weights @ features - mdp.initial @ soft_plan(mdp, reward_of(mdp, weights)).values

    risk = excess_risk(mdp, plan.policy, occupancy(mdp, plan.policy), OTHER)
    assert risk == pytest.approx(float(expected(TRUE) - expected(OTHER)), rel=1e-9)
    assert risk > 0
    assert excess_risk(mdp, plan.policy, occupancy(mdp, plan.policy), TRUE) == pytest.approx(0, abs=1e-12)


def test_the_excess_risk_of_fragments_is_what_simulation_gives(mdp, plan):
    n, length = 2000, 5
    drawn = sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, TRUE, Sensor(), length), n)
    other = soft_plan(mdp, reward_of(mdp, OTHER)).log_policy
    ratio = np.asarray(plan.log_policy - other)[drawn.state, drawn.action].sum(1)
    risk = float(excess_risk(mdp, plan.policy, expected_visits(mdp, plan.policy, length), OTHER))
    assert abs(ratio.mean() - risk) < 4 * ratio.std() / np.sqrt(n)


def test_a_deterministic_expert_has_a_finite_positive_risk(mdp):
    policy = jnp.eye(3)[jnp.zeros(6, int)]
    risk = excess_risk(mdp, policy, expected_visits(mdp, policy, 5), TRUE)
    assert np.isfinite(risk)
    assert risk > 0


def test_the_empirical_regret_of_the_features_program_is_surely_bounded(mdp, plan):
    # gamma^40 is below 1e-6: nothing is left for the learner to fill in.
    data = streams(mdp, Sensor(), 3, 8, 40)
    learner = me_i2rl(mdp, statistic="features", slack=Harmonic(0.1))
    gaps = regret_gaps(learner, jax.random.key(1), data, TRUE, plan.policy, occupancy(mdp, plan.policy))
    beta = 0.1 / np.arange(1, 9)
    assert np.all(gaps.empirical <= beta * 1.4 + 1e-6)
    assert np.all(gaps.empirical_regret <= sure_bound(beta, TRUE) + 1e-6)
    assert gaps.empirical.min() < 0
    assert np.all(gaps.expected > 0)
    # By hand, what the compiled run of all streams did.
    state = learner.init(jax.random.split(jax.random.key(1), 3)[2])
    for t in range(2):
        state, report = learner.update(state, jax.tree.map(lambda x, t=t: x[2, t], data))
    assert gaps.weights[2, 1] == pytest.approx(report.weights, abs=1e-6)
    assert gaps.empirical[2, 1] == pytest.approx(
        learner.log_likelihood(state, TRUE) - report.log_likelihood, abs=1e-7
    )


def test_a_diminishing_threshold_loses_its_bias_and_a_constant_one_does_not(mdp, plan):
    view = Visibility(np.arange(6) < 3)
    data = streams(mdp, view, 3, 80, 4, trajectories=4)
    visits = jnp.asarray(np.arange(6) < 3, float)[:, None] * expected_visits(mdp, plan.policy, 4)
    constant, harmonic = (
        regret_gaps(lme_i2rl(mdp, view, slack=slack), jax.random.key(1), data, TRUE, plan.policy, visits)
        for slack in (0.1, Harmonic(0.1))
    )
    assert log_log_slope(harmonic.regret.mean(0)).slope < -0.5
    assert log_log_slope(constant.regret.mean(0)).slope > -0.35
    assert harmonic.expected[:, -1].mean() < 0.3 * constant.expected[:, -1].mean()


def test_the_slope_of_a_power_law_is_its_exponent():
    t = np.arange(1, 200)
    assert log_log_slope(3.0 * t**-0.7, 5).slope == pytest.approx(-0.7)
    assert np.exp(log_log_slope(3.0 * t**-0.7, 5).intercept) == pytest.approx(3.0)
    with pytest.raises(ValueError, match="after session 12 is -1: only a positive one"):
        log_log_slope(np.r_[np.ones(11), -1.0, 1.0])
    with pytest.raises(ValueError, match="two sessions from session 10 on"):
        log_log_slope(np.ones(10))


def test_the_average_regret_is_a_running_mean():
    assert np.allclose(running_mean(np.array([[4.0, 2.0, 0.0], [1, 1, 1]])), [[4, 3, 2], [1, 1, 1]])


@pytest.mark.parametrize(("c", "size"), [(1.0, 10), (40.0, 7), (100.0, 3)])
def test_the_theorems_confidence_ends_where_it_says(c, size):
    k, discount = 6, 0.99
    last = last_confident_session(c, size, k, discount)
    sessions = last + 3
    sizes = size * np.arange(1, sessions + 1)
    epsilon = c * (1 - discount) / np.arange(1, sessions + 1)
    delta = 2 * k * np.exp(-2 * sizes * epsilon**2)
    assert np.array_equal(delta < 1, np.arange(1, sessions + 1) <= last)
    confidence = no_regret(c, [size] * sessions, k, discount).confidence
    assert np.all(confidence[last:] == 0)
    assert np.all(confidence[:last] > 0)


def test_the_failure_probability_tends_to_twice_the_features():
    sizes = np.arange(1, 100_001)
    delta = 12 * np.exp(-2 * sizes * (5.0 * 0.01 / sizes) ** 2)
    assert np.all(np.diff(delta) > 0)
    assert delta[-1] == pytest.approx(12, rel=1e-6)


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_the_figure_says_what_it_shows(theme):
    t = np.arange(1, 61)
    rng = np.random.default_rng(0)
    noise = rng.uniform(0.9, 1.1, (5, 60))
    curves = [
        RegretCurve("c / i", noise * t**-0.8, -noise / t),
        RegretCurve("constant", noise * 0.3, -noise / t),
    ]
    bound = BoundCurve("a bound", 2.0 / t)
    figure = regret_plot(curves, theorem=bound, sure={"c / i": bound.average}, theme=theme, title="Regret")
    left, right = figure.axes
    assert left.get_xscale() == left.get_yscale() == "log"
    assert right.get_yscale() == "linear"
    assert {a.get_xlabel() for a in figure.axes} == {"sessions T"}
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[0].startswith("c / i, slope -0.8")
    assert names[2:] == ["a bound", "sure bound, c / i"]
    with pytest.raises(ValueError, match="one number of sessions, got"):
        regret_plot([curves[0], RegretCurve("short", noise[:, :9], noise[:, :9])])
