import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from i2rl.inference import batch_lme, lme_i2rl, lme_i2rl_with_random_weights, me_i2rl, run_sessions
from i2rl.inference.smoothing import evidence_of, log_likelihoods
from i2rl.models import (
    Demonstration,
    DemonstrationError,
    Sensor,
    TrajectoryLaw,
    Visibility,
    reward_of,
    sample_demonstration,
    soft_plan,
)

TRUE = jnp.array([1.5, -2.0])


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(11, n_states=6, n_actions=3, n_successors=2, n_features=2)


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.arange(6) < 3)


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    return sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, TRUE, sensor, 6), 64)


@pytest.fixture(scope="module")
def objective(mdp):
    """Penalised exact log-likelihood per trajectory, written without the learner."""

    @jax.jit
    def value(weights, evidence, slack):
        policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
        return jnp.mean(log_likelihoods(mdp, policy, evidence)) - slack * jnp.abs(weights).sum()

    return value


def test_batch_em_reaches_a_maximum_of_the_exact_likelihood(mdp, sensor, demonstration, objective):
    evidence = evidence_of(mdp, sensor, demonstration)
    fit = batch_lme(mdp, sensor, slack=0.01, tolerance=1e-7, iterations=3000).fit(
        jax.random.key(1), demonstration
    )
    found = minimize(
        lambda x: -float(objective(jnp.asarray(x), evidence, 0.01)), fit.weights, method="Nelder-Mead"
    )
    assert -found.fun - float(objective(jnp.asarray(fit.weights), evidence, 0.01)) < 1e-6
    assert np.allclose(found.x, fit.weights, atol=2e-2)
    assert fit.objective.max() == pytest.approx(-found.fun, abs=1e-6)


def test_a_first_session_of_everything_equals_batch(mdp, sensor, demonstration):
    learner = lme_i2rl(mdp, sensor, slack=0.01, tolerance=1e-7, iterations=3000)
    _, report = learner.update(learner.init(jax.random.key(3)), demonstration)
    fit = batch_lme(mdp, sensor, slack=0.01, tolerance=1e-7, iterations=3000).fit(
        jax.random.key(1), demonstration
    )
    assert np.allclose(report.weights, fit.weights, atol=1e-3)
    assert report.demonstration_log_likelihood / 64 == pytest.approx(fit.log_likelihood, abs=1e-7)


def test_more_iterations_never_lower_the_penalised_likelihood(mdp, sensor, demonstration, objective):
    evidence = evidence_of(mdp, sensor, demonstration)
    reached = []
    for iterations in (1, 2, 4, 8, 16):
        learner = lme_i2rl(mdp, sensor, slack=0.01, tolerance=0.0, iterations=iterations)
        state, _ = learner.update(learner.init(jax.random.key(0)), demonstration)
        reached.append(float(objective(state.weights, evidence, 0.01)))
    assert np.all(np.diff(reached) > -1e-10)


@pytest.mark.parametrize("statistic", ["seen", "counts"])
def test_online_equals_batch_where_nothing_is_hidden(mdp, statistic):
    full = sample_demonstration(jax.random.key(2), TrajectoryLaw(mdp, TRUE, Sensor(), 6), 32)
    learner = me_i2rl(mdp, statistic=statistic, slack=0.01, tolerance=1e-8, iterations=50)
    state = run_sessions(learner, full.sessions(4), key=jax.random.key(0)).state
    fit = batch_lme(mdp, Sensor(), slack=0.01, tolerance=1e-8).fit(jax.random.key(1), full)
    assert np.allclose(state.weights, fit.weights, atol=1e-4)
    visits = np.zeros((6, 3))
    np.add.at(visits, (full.state.ravel(), full.action.ravel()), 1)
    assert np.allclose(np.asarray(state.statistic.counts) * 32, visits, atol=1e-9)


def test_the_feature_statistic_is_the_running_average_of_equation_4_2(mdp):
    full = sample_demonstration(jax.random.key(2), TrajectoryLaw(mdp, TRUE, Sensor(), 40), 6)
    learner = me_i2rl(mdp, statistic="features", slack=0.001)
    state = run_sessions(learner, full.sessions(2), key=jax.random.key(0)).state
    powers = float(mdp.discount) ** np.arange(40)
    seen = np.einsum("nlk,l->k", np.asarray(mdp.features)[full.state, full.action], powers) / 6
    # All but the discounted tail, at most gamma^40 / (1 - gamma), is what was seen.
    assert np.all(np.abs(np.asarray(state.statistic.features) - seen) <= 0.9**40 / 0.1 + 1e-9)
    starts = np.bincount(full.state[:, 0], minlength=6) / 6
    assert np.allclose(state.statistic.start, starts, atol=1e-9)


def test_kept_counts_are_those_of_the_steps_that_were_seen(mdp, sensor, demonstration):
    learner = lme_i2rl(mdp, sensor)
    state = run_sessions(learner, demonstration.sessions(16), key=jax.random.key(0)).state
    seen = demonstration.kind == 1
    visits = np.zeros((6, 3))
    np.add.at(visits, (demonstration.state[seen], demonstration.action[seen]), 1)
    assert np.allclose(np.asarray(state.statistic.counts) * 64, visits, atol=1e-9)
    assert float(state.statistic.size) == 64


def test_online_learning_with_hidden_steps_finds_the_true_policy(mdp, sensor):
    many = sample_demonstration(jax.random.key(7), TrajectoryLaw(mdp, TRUE, sensor, 6), 1500)
    learner = lme_i2rl(mdp, sensor, slack=0.0)
    state = run_sessions(learner, many.sessions(50), key=jax.random.key(0)).state
    true = soft_plan(mdp, reward_of(mdp, TRUE)).policy
    learned = soft_plan(mdp, reward_of(mdp, state.weights)).policy
    assert np.abs(np.asarray(true - learned)).max() < 0.06


@pytest.mark.parametrize("statistic", ["seen", "features"])
def test_the_solvers_agree_session_by_session(mdp, sensor, demonstration, statistic):
    options = {"statistic": statistic, "slack": 0.01, "tolerance": 1e-6, "iterations": 8}
    solvers = ["newton", "ipopt"] + (["cvxpy"] if statistic == "features" else [])
    weights = []
    for solver in solvers:
        learner = lme_i2rl(mdp, sensor, solver=solver, **options)
        run = run_sessions(learner, demonstration.select(slice(0, 24)).sessions(8), key=jax.random.key(0))
        weights.append(run.state.weights)
    for other in weights[1:]:
        assert np.allclose(weights[0], other, atol=2e-4)


@pytest.mark.parametrize("completion", ["blocked", "gibbs"])
def test_a_sampled_completion_learns_about_the_same(mdp, sensor, demonstration, completion):
    exact, sampled = (
        run_sessions(
            lme_i2rl(mdp, sensor, slack=0.01, completion=c, draws=400),
            demonstration.sessions(32),
            key=jax.random.key(0),
        ).state
        for c in ("exact", completion)
    )
    policies = [np.asarray(soft_plan(mdp, reward_of(mdp, s.weights)).policy) for s in (exact, sampled)]
    # The sampler's error in expected counts is about 1/sqrt(400); single-site chains also mix slowly.
    assert np.abs(policies[0] - policies[1]).max() < (0.05 if completion == "blocked" else 0.2)


def test_random_weights_forget_the_weights_but_not_the_statistic(mdp, sensor, demonstration):
    learner = lme_i2rl_with_random_weights(mdp, sensor, slack=0.01, iterations=1)
    state = learner.init(jax.random.key(0))
    state, _ = learner.update(state, demonstration.select(slice(0, 32)))
    moved = state._replace(weights=state.weights + 100.0, values=state.values * 0 + 1.0)
    same, other = (learner.update(s, demonstration.select([40]))[0] for s in (state, moved))
    assert np.allclose(same.weights, other.weights)
    assert float(same.statistic.size) == 33


def test_the_exponentiated_gradient_stays_on_the_simplex(mdp, sensor, demonstration):
    learner = lme_i2rl(mdp, sensor, statistic="features", solver="exponentiated gradient", iterations=2)
    state, _ = learner.update(learner.init(jax.random.key(0)), demonstration)
    assert np.all(np.asarray(state.weights) >= 0)
    assert float(jnp.sum(state.weights)) == pytest.approx(1)


def test_a_session_in_which_nothing_was_seen_is_allowed(mdp, sensor):
    learner = lme_i2rl(mdp, sensor)
    hidden = Demonstration.from_steps([["hidden"] * 4, [None] * 3], mdp)
    state, report = learner.update(learner.init(jax.random.key(0)), hidden)
    assert np.isfinite(report.log_likelihood)
    assert np.all(np.isfinite(np.asarray(state.weights)))


def test_an_empty_session_is_refused(mdp, sensor):
    learner = lme_i2rl(mdp, sensor)
    with pytest.raises(DemonstrationError, match="at least one trajectory"):
        learner.update(learner.init(jax.random.key(0)), Demonstration.from_pairs([[0]], [[1]]).select([]))


def test_solvers_outside_jax_name_an_impossible_observation_too(mdp, sensor):
    learner = lme_i2rl(mdp, sensor, solver="ipopt", statistic="features")
    with pytest.raises(DemonstrationError, match="trajectory 0, step 0: impossible observation"):
        learner.update(learner.init(jax.random.key(0)), Demonstration.from_pairs([[5]], [[1]]))


def test_an_impossible_observation_names_its_place_and_costs_nothing_learned(mdp, sensor):
    learner = lme_i2rl(mdp, sensor)
    before, _ = learner.update(learner.init(jax.random.key(0)), Demonstration.from_pairs([[0]], [[1]]))
    out_of_view = Demonstration.from_steps([[(0, 0)], ["hidden", (5, 1)]], mdp)
    with pytest.raises(
        DemonstrationError, match=r"trajectory 1, step 1: impossible observation.*excludes it"
    ):
        learner.update(before, out_of_view)
    after, report = learner.update(before, Demonstration.from_pairs([[0]], [[1]]))
    assert report.session == 2
    assert np.all(np.isfinite(np.asarray(after.weights)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"statistic": "all"}, "statistic must be one of seen, counts, features"),
        ({"completion": "mcmc"}, "completion must be"),
        ({"solver": "adam"}, "solver must be"),
        ({"solver": "cvxpy"}, "needs the features statistic"),
        ({"slack": -1.0}, "must not be negative"),
        ({"solver": "cvxpy", "statistic": "features", "ridge": 1.0}, "no ridge"),
        ({"completion": "gibbs", "draws": 0}, "at least one draw"),
        ({"iterations": 0}, "at least one iteration"),
    ],
)
def test_unknown_options_are_refused(mdp, sensor, options, message):
    with pytest.raises(ValueError, match=message):
        lme_i2rl(mdp, sensor, **options)


def test_discount_one_is_refused(random_mdp, sensor):
    with pytest.raises(ValueError, match="discount 1"):
        lme_i2rl(random_mdp(0, n_states=6, discount=1.0), sensor)


def test_the_same_key_gives_the_same_bits(mdp, sensor, demonstration):
    learner = lme_i2rl(mdp, sensor, completion="blocked", draws=20)
    a, b = (run_sessions(learner, demonstration.sessions(16), key=jax.random.key(4)).state for _ in range(2))
    assert np.array_equal(a.weights, b.weights)
