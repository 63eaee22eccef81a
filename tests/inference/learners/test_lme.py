import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from i2rl.inference import Harmonic, batch_lme, fit_counts, fleet, lme_i2rl, me_i2rl, run_sessions, solve_dual
from i2rl.inference.completion.smoothing import evidence_of, log_likelihoods
from i2rl.inference.journal.journal import Journal
from i2rl.inference.learners.lme import lme_i2rl_with_random_weights
from i2rl.inference.programs.constraints import FeatureTarget
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
from i2rl.models.process.units import feature_scale

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
    scale = feature_scale(mdp)

    @jax.jit
    def value(weights, evidence, slack):
        policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
        return jnp.mean(log_likelihoods(mdp, policy, evidence)) - slack * jnp.abs(weights * scale).sum()

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
    _, info = learner.update(learner.init(jax.random.key(3)), demonstration)
    fit = batch_lme(mdp, sensor, slack=0.01, tolerance=1e-7, iterations=3000).fit(
        jax.random.key(1), demonstration
    )
    assert np.allclose(info.weights, fit.weights, atol=1e-3)
    assert info.demonstration_log_likelihood / 64 == pytest.approx(fit.log_likelihood, abs=1e-7)


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
    assert float(jnp.sum(state.weights * feature_scale(mdp))) == pytest.approx(1)


def test_a_session_in_which_nothing_was_seen_is_allowed(mdp, sensor):
    learner = lme_i2rl(mdp, sensor)
    hidden = Demonstration.from_steps([["hidden"] * 4, [None] * 3], mdp)
    state, info = learner.update(learner.init(jax.random.key(0)), hidden)
    assert np.isfinite(info.log_likelihood)
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
    after, info = learner.update(before, Demonstration.from_pairs([[0]], [[1]]))
    assert info.session == 2
    assert np.all(np.isfinite(np.asarray(after.weights)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"statistic": "all"}, "statistic must be one of seen, counts, features"),
        ({"completion": "mcmc"}, "completion must be"),
        ({"solver": "adam"}, "solver must be"),
        ({"solver": "cvxpy"}, "needs the features statistic"),
        ({"slack": -1.0}, "must not be negative"),
        ({"ridge": -1.0}, "ridge must not be negative"),
        ({"slack": float("nan")}, "must not be negative, infinite or NaN"),
        ({"slack": "small"}, "a number or a function of the session's number, got 'small'"),
        ({"slack": lambda i: -1.0 / i}, "gives -1.0 in session 1"),
        ({"slack": Harmonic(-1.0)}, r"Harmonic\(c=-1.0\) gives -1.0 in session 1"),
        ({"slack": lambda i: 0.5 - 0.125 * i}, "gives -0.125 in session 5"),
        ({"slack": lambda i: 0.1 if i < 3 else 0.0}, "that JAX can trace"),
        ({"slack": lambda i: jnp.ones(2) / i}, r"one number a session.*shape \(2,\)"),
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


# -- schedules ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("statistic", ["features", "counts"])
def test_a_harmonic_slack_meets_equation_4_3_in_every_session(mdp, statistic):
    full = sample_demonstration(jax.random.key(2), TrajectoryLaw(mdp, TRUE, Sensor(), 6), 4)
    c = 0.05
    # One E- and M-step: the statistic of whole trajectories is the fitted one, up to the filled-in tail.
    learner = me_i2rl(mdp, statistic=statistic, slack=Harmonic(c), iterations=60, tolerance=1e-9)
    state = learner.init(jax.random.key(0))
    for i, demonstration in enumerate(full.sessions(1), start=1):
        state, _ = learner.update(state, demonstration)
        if statistic == "features":
            target = FeatureTarget(state.statistic.features, state.statistic.start)
            alone = solve_dual(mdp, target, c / i)
        else:
            alone = fit_counts(mdp, state.statistic.counts, c / i)
        assert np.allclose(state.weights, alone.weights, atol=1e-4)


def test_any_other_schedule_has_the_units_of_the_number(mdp, sensor, demonstration):
    number, schedule = (
        run_sessions(
            lme_i2rl(mdp, sensor, statistic="features", slack=slack),
            demonstration.select(slice(0, 16)).sessions(8),
            key=jax.random.key(0),
        ).state.weights
        for slack in (0.02, lambda i: 0.02)
    )
    assert np.allclose(number, schedule, atol=1e-12)


def test_every_solver_follows_a_schedule(mdp, sensor, demonstration):
    few = demonstration.select(slice(0, 24))
    weights = [
        run_sessions(
            lme_i2rl(
                mdp,
                sensor,
                solver=solver,
                statistic="features",
                slack=Harmonic(0.1),
                iterations=8,
                tolerance=1e-6,
            ),
            few.sessions(8),
            key=jax.random.key(0),
        ).state.weights
        for solver in ("newton", "ipopt", "cvxpy")
    ]
    assert np.allclose(weights[0], weights[1], atol=2e-4)
    assert np.allclose(weights[0], weights[2], atol=2e-4)
    simplex = me_i2rl(mdp, solver="exponentiated gradient", statistic="features", slack=Harmonic(0.1))
    state, _ = simplex.update(simplex.init(jax.random.key(0)), Demonstration.from_pairs([[0]], [[1]]))
    assert float(jnp.sum(state.weights * feature_scale(mdp))) == pytest.approx(1)


def test_a_schedule_counts_each_streams_sessions_in_a_fleet(mdp, sensor, demonstration):
    learner = lme_i2rl(mdp, sensor, slack=Harmonic(0.2))
    old = run_sessions(learner, demonstration.select(slice(0, 4)).sessions(2), key=jax.random.key(1)).state
    states = [old, learner.init(jax.random.key(2))]
    parts = [demonstration.select(slice(4, 6)), demonstration.select(slice(6, 8))]
    alone = [learner.update(s, d)[0].weights for s, d in zip(states, parts, strict=True)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    both = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    together, _ = fleet(learner).update(stacked, both)
    assert together.session.tolist() == [3, 1]
    assert np.allclose(together.weights, alone, atol=1e-6)


def test_a_schedule_resumes_from_a_journal_and_another_one_is_refused(mdp, sensor, demonstration, tmp_path):
    few = demonstration.select(slice(0, 6))
    whole = run_sessions(
        lme_i2rl(mdp, sensor, slack=Harmonic(0.2)), few.sessions(2), key=jax.random.key(0)
    ).state
    learner = lme_i2rl(mdp, sensor, slack=Harmonic(0.2))
    with Journal.open(tmp_path / "a.db", learner) as journal:
        run_sessions(learner, few.select(slice(0, 4)).sessions(2), key=jax.random.key(0), journal=journal)
    again = lme_i2rl(mdp, sensor, slack=Harmonic(0.2))
    with Journal.open(tmp_path / "a.db", again) as journal:
        rest = run_sessions(again, few.select(slice(4, 6)).sessions(2), journal=journal).state
        with pytest.raises(ValueError, match="another learner"):
            run_sessions(
                lme_i2rl(mdp, sensor, slack=Harmonic(0.1)),
                few.sessions(),
                key=jax.random.key(0),
                journal=journal,
            )
    assert np.array_equal(whole.weights, rest.weights)


def test_schedules_are_told_apart_by_their_values(mdp, sensor):
    def signature(slack):
        return lme_i2rl(mdp, sensor, slack=slack).signature

    assert signature(lambda i: 0.3 / i) == signature(lambda session: 0.3 / session)
    different = [0.3, Harmonic(0.3), Harmonic(0.4), lambda i: 0.3 / i, lambda i: 0.3 / (i + (i > 900))]
    assert len({signature(slack) for slack in different}) == len(different)


def test_a_schedule_that_turns_negative_late_is_refused_when_it_does(mdp, sensor):
    demonstration = Demonstration.from_pairs([[0]], [[1]])

    def falling(session):
        return 256 - session / 4

    learner = lme_i2rl(mdp, sensor, slack=falling)
    state = learner.init(jax.random.key(0))._replace(session=jnp.array(1023))
    state, _ = learner.update(state, demonstration)
    with pytest.raises(ValueError, match=r"schedule falling gives -0\.25 in session 1025"):
        learner.update(state, demonstration)
    # A fleet cannot raise, but its weights stay unchanged.
    one = jax.tree.map(lambda x: x[None], state)
    after, _ = fleet(learner).update(one, jax.tree.map(lambda x: x[None], demonstration))
    assert np.array_equal(after.weights[0], state.weights)


def test_random_weights_follow_the_schedule_and_batch_refuses_one(mdp, sensor, demonstration):
    learner = lme_i2rl_with_random_weights(mdp, sensor, slack=Harmonic(1e6))
    state, _ = learner.update(learner.init(jax.random.key(0)), demonstration)
    assert np.all(np.asarray(state.weights) == 0)
    with pytest.raises(ValueError, match="batch learning has no sessions"):
        batch_lme(mdp, sensor, slack=Harmonic(0.1))
