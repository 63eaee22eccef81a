"""Independence from the units of the features: for every learner, program and posterior.

The benchmark ``units`` runs every method in more units than there is time for here.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from i2rl.analysis.benchmarks.faults.units import (
    KEY,
    METHODS,
    PREDICATES,
    SLACK,
    TOLERANCE,
    VIEW,
    demonstration,
    difference,
    in_units,
    policies,
    policy,
    process,
    random_process,
    solve_both,
    target,
    units_of,
)
from i2rl.inference import fleet, lme_i2rl, me_i2rl, solve_dual
from i2rl.inference.learners.jin import jin_i2rl_with_features
from i2rl.inference.posteriors import mixture_problem
from i2rl.inference.posteriors import noisy as noisy_posterior
from i2rl.inference.posteriors import weights as posterior
from i2rl.inference.programs.constraints import (
    FeatureTarget,
    InfeasibleProgram,
    ProgramNotSolved,
    excluded_pairs,
)
from i2rl.inference.programs.dual import DualProgram
from i2rl.inference.programs.maximum_entropy import require_converged
from i2rl.inference.programs.primal import PrimalProgram
from i2rl.models import Demonstration, Sensor, TabularMDP, feature_expectations
from i2rl.models.laws.occlusion import ScaledPrior, scaled_prior
from i2rl.models.process.units import feature_scale, with_scaled_features

# All small, all large, mixed, mixed otherwise, and such as people use.
UNITS = [
    np.full(3, 1e-9),
    np.full(3, 1e9),
    np.array([1e-9, 1.0, 1e9]),
    np.array([1e6, 1e-6, 1e-9]),
    np.array([3.6, 0.3048, 4184.0]),
]


# -- the scale ----------------------------------------------------------------------------------------


def test_scaled_features_are_the_same_in_all_units():
    for units in UNITS:
        mdp = with_scaled_features(in_units(units))
        np.testing.assert_allclose(mdp.features, with_scaled_features(process()).features, rtol=4e-16)
        assert (feature_scale(mdp) == 1).all()
        assert np.abs(mdp.features).max() == 1
        assert with_scaled_features(mdp) is mdp


def test_zero_features_have_scale_one_and_unavailable_pairs_none():
    features = np.array([[[0.0, 5.0], [0.0, -7.0]]])
    mdp = TabularMDP.from_dense(np.ones((1, 2, 1)), features, available=np.array([[True, False]]))
    assert feature_scale(replace(mdp, features=jnp.asarray(features))).tolist() == [1.0, 5.0]
    assert jax.jit(feature_scale)(mdp).tolist() == [1.0, 5.0]


# -- learners -----------------------------------------------------------------------------------------

# Compiled once for all units: the process is data.
TRACED = {
    "seen": (lambda mdp: lme_i2rl(mdp, VIEW), "hidden"),
    "features": (lambda mdp: lme_i2rl(mdp, VIEW, statistic="features", slack=0.02), "hidden"),
    "exponentiated": (
        lambda mdp: me_i2rl(mdp, statistic="features", solver="exponentiated gradient", iterations=2),
        "clear",
    ),
}


@pytest.mark.parametrize("name", TRACED)
def test_sessions_learn_the_same_behaviour_in_all_units(name):
    make, sensor = TRACED[name]
    sessions = list(demonstration(sensor).sessions(6))

    @jax.jit
    def run(mdp):
        learner = make(mdp)
        state = learner.init(KEY)
        for session in sessions:
            state, report = learner.session(state, session)
        return state, report

    expected, reported = run(process())
    wanted = policies(process(), expected.weights)
    assert np.abs(wanted - 1 / 3).max() > 0.1
    for units in UNITS:
        state, report = run(in_units(units))
        np.testing.assert_allclose(policies(in_units(units), state.weights), wanted, atol=1e-6)
        np.testing.assert_allclose(state.weights * units, expected.weights, rtol=1e-5)
        np.testing.assert_array_equal(report.weights, state.weights)
        for field in ("log_likelihood", "demonstration_log_likelihood", "gradient"):
            np.testing.assert_allclose(getattr(report, field), getattr(reported, field), rtol=1e-6, atol=1e-9)
        assert report.iterations == reported.iterations
        assert report.converged == reported.converged == ("exponentiated" not in name)
        if hasattr(state.statistic, "features"):
            np.testing.assert_allclose(
                state.statistic.features / units, expected.statistic.features, rtol=1e-6
            )


# Their programs are compiled once for all units, or cost little.
CHEAP = [
    "solve_dual",
    "fit_counts",
    "exponentiated_gradient",
    "DualProgram",
    "CountProgram",
    "PrimalProgram",
    "MinMaxProgram",
    "fit_weights",
    "darko_i2rl",
    "jin_i2rl_with_features",
    "mme_mtirl",
    "mlirl",
    "em_mlirl",
    "dpm_birl",
    "birl",
    "batch_mme_mtirl",
]


@pytest.mark.parametrize("name", CHEAP)
def test_methods_learn_the_same_behaviour_in_all_units(name):
    found = difference(name, units_of(name, 4))
    assert found.policy <= TOLERANCE
    assert found.weight <= 1e-4
    assert np.abs(np.asarray(METHODS[name](process()))).max() > 0.05


# A learner whose sessions close over the process: compiled twice.
def test_a_learned_sensor_does_not_disturb_units():
    assert difference("rimeo", np.array([[1e6, 1e-6, 1e-9]])).policy <= TOLERANCE


def test_a_learner_s_likelihood_takes_weights_in_its_own_units():
    learner = jin_i2rl_with_features(process())
    assert learner.mdp is process()
    assert learner.log_likelihood is None
    mdp = in_units(UNITS[3])
    learner, plain = lme_i2rl(mdp, Sensor()), lme_i2rl(process(), Sensor())
    assert learner.mdp is mdp
    state, own = (one.init(KEY) for one in (learner, plain))
    weights = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(
        learner.log_likelihood(state, weights / UNITS[3]), plain.log_likelihood(own, weights), rtol=1e-9
    )
    np.testing.assert_allclose(state.weights * UNITS[3], own.weights, rtol=1e-12)


def test_a_session_that_teaches_nothing_leaves_the_weights_to_the_bit():
    mdp = in_units(np.array([0.3, 7.0, 1e5]))
    many = fleet(lme_i2rl(mdp, VIEW))
    states = many.init(KEY, 2)
    moves = np.asarray(mdp.successors)[0, 0]
    lost = next(s for s in range(4) if s not in moves)
    stacked = jax.tree.map(
        lambda *x: np.stack(x), *(Demonstration.from_pairs([[0, s]], [[0, 0]]) for s in (moves[0], lost))
    )
    after, reports = many.update(states, stacked)
    assert np.isfinite(reports.demonstration_log_likelihood).tolist() == [True, False]
    assert (after.weights[0] != states.weights[0]).all()
    np.testing.assert_array_equal(after.weights[1], states.weights[1])


# -- programs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("units", [np.ones(3), UNITS[2]], ids=["plain", "mixed"])
def test_slack_is_a_share_of_each_feature_s_scale(units):
    mdp = in_units(units)
    aim = target(mdp)
    solution = solve_dual(mdp, aim, SLACK)
    gap = feature_expectations(mdp, policy(mdp, solution.weights)) - aim.features
    np.testing.assert_allclose(np.abs(gap) / feature_scale(mdp), SLACK, atol=1e-7)
    assert solve_dual(mdp, aim, SLACK, start=solution.warm()).iterations <= 1


# -- IPOPT --------------------------------------------------------------------------------------------


# Among them are those that an inequality's boundary, or a direction that data leave open, led astray.
@pytest.mark.parametrize(
    ("kind", "seeds"), [("normal", (1, 8, 14, 24)), ("constant", (2, 32)), ("duplicate", (8, 12, 13, 17, 20))]
)
@pytest.mark.parametrize("program", ["DualProgram", "CountProgram"])
def test_ipopt_solves_without_slack_what_newton_solves(program, kind, seeds):
    for seed in seeds:
        solved = solve_both(seed, kind, program)
        assert solved.failure == ""
        assert solved.objective < 1e-6
        assert solved.policy < 1e-6


@pytest.mark.parametrize("kind", ["constant", "duplicate"])
def test_weights_stay_where_they_started_in_directions_that_data_leave_open(kind):
    mdp = random_process(13, kind)
    weights = np.array([0.7, -0.4, 0.2])
    aim = FeatureTarget(feature_expectations(mdp, policy(mdp, jnp.asarray(weights))), mdp.initial)
    open_way = {"constant": [0.0, 0.0, 1.0], "duplicate": [1.0, 0.0, -1.0]}[kind]
    for found in (solve_dual(mdp, aim).weights, DualProgram(mdp).solve(aim).weights):
        np.testing.assert_allclose(policies(mdp, found), policies(mdp, weights), atol=1e-6)
        assert abs(np.asarray(found) @ open_way) < 1e-2


@pytest.mark.parametrize("units", [np.ones(3), UNITS[2]], ids=["plain", "mixed"])
def test_a_target_of_infinite_weights_is_named_by_the_actions_it_excludes(units):
    mdp = in_units(units)
    # The policy that never takes action 1 in state 2, and the others at random.
    without = np.full((4, 3), 1 / 3)
    without[2] = [0.5, 0.0, 0.5]
    one_hot = replace(mdp, features=mdp.features.at[..., 2].set(jnp.zeros((4, 3)).at[2, 1].set(units[2])))
    aim = FeatureTarget(feature_expectations(one_hot, jnp.asarray(without)), mdp.initial)
    states, actions = excluded_pairs(one_hot, aim)
    assert (states.tolist(), actions.tolist()) == ([2], [1])
    unsolved = solve_dual(one_hot, aim)._replace(converged=jnp.array(False))
    with pytest.raises(ProgramNotSolved, match=r"ever takes state 2, action 1\. A positive slack"):
        require_converged(one_hot, aim, 0.0, unsolved)
    inside = target(mdp)
    assert len(excluded_pairs(mdp, inside)[0]) == 0
    unsolved = solve_dual(mdp, inside)._replace(converged=jnp.array(False))
    with pytest.raises(ProgramNotSolved, match="takes every action, so its weights are finite"):
        require_converged(mdp, inside, 0.0, unsolved)


def test_a_target_beyond_every_policy_is_named_in_the_user_s_units():
    mdp = in_units(UNITS[2])
    aim = target(mdp)
    far = aim._replace(features=aim.features.at[0].add(2e-8))
    for solve in (DualProgram(mdp).solve, PrimalProgram(mdp).solve):
        with pytest.raises(InfeasibleProgram, match=r"'time' \(0\) is to be 1\.99\d*e-08 within 5\.54e-11"):
            solve(far, 0.05)


# -- posteriors ---------------------------------------------------------------------------------------


def test_posteriors_are_the_same_density_of_scaled_weights_in_all_units():
    points = np.random.default_rng(5).normal(size=(2, 3))
    logits = np.array([0.5, -0.5])

    def evaluated(mdp):
        problem, _ = posterior.gather(mdp, VIEW, demonstration("hidden"))
        noisy, _ = noisy_posterior.noisy_problem(mdp, PREDICATES, demonstration())
        mixed, _, _ = mixture_problem.pose(
            mdp, Sensor(), demonstration(), concentration=1.0, prior=None, at_least_one={}, warmup=0
        )
        found = [posterior._potential_and_gradient(jnp.asarray(x), problem) for x in points]
        found += [noisy_posterior._potential_and_gradient(np.append(x, logits), noisy) for x in points]
        sites = {"weights": jnp.asarray(points), "sticks": jnp.zeros(1)}
        found += [mixture_problem._potential_and_gradient(sites, mixed)]
        weights = dist.biject_to(problem.prior.support)(jnp.asarray(points))
        return jax.tree.leaves(found), weights, posterior.posterior_mode(problem)

    expected, weights, mode = evaluated(process())
    np.testing.assert_allclose(weights * feature_scale(process()), points)
    for units in UNITS[:3]:
        found, own, other = evaluated(in_units(units))
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(own * units, weights, rtol=1e-12)
        np.testing.assert_allclose(other.position, mode.position, atol=1e-3)


def test_the_prior_is_the_law_of_weights_whose_scaled_form_follows_it():
    mdp = in_units(np.array([1e3, 1.0, 1e-3]))
    scale = np.asarray(feature_scale(mdp))
    law = scaled_prior(mdp, dist.Laplace(0.0, 2.0))
    draws = np.asarray(law.sample(KEY, (4000,))) * scale
    np.testing.assert_allclose(np.abs(draws).mean(0), 2.0, rtol=0.08)
    x = np.array([1e-3, -2.0, 500.0])
    exact = dist.Laplace(0.0, 2.0 / scale).log_prob(x).sum()
    assert float(law.log_prob(jnp.asarray(x))) == pytest.approx(float(exact))
    assert scaled_prior(mdp, law) is law
    gamma = scaled_prior(mdp, dist.Gamma(2.0, 1.0))
    position = jnp.array([0.3, -1.0, 2.0])
    np.testing.assert_allclose(dist.biject_to(gamma.support)(position) * scale, np.exp(position))
    positive = ScaledPrior(dist.HalfNormal(1.0).expand((3,)).to_event(1), scale)
    assert positive.support(jnp.array([1e-9, 1.0, 1e9]))
    assert not positive.support(jnp.array([-1e-9, 1.0, 1e9]))
