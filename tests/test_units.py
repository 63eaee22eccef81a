"""What is learned does not depend on the units of the features: for every learner, program and posterior."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from i2rl.analysis import identifiability_of
from i2rl.inference import (
    batch_lme,
    batch_mme_mtirl,
    birl,
    darko_i2rl,
    dpm_birl,
    em_mlirl,
    exponentiated_gradient,
    fit_counts,
    fit_weights,
    fleet,
    jin_i2rl,
    lme_i2rl,
    me_i2rl,
    mixture_problem,
    mlirl,
    mme_mtirl,
    noisy_posterior,
    posterior,
    rifom,
    rimeo,
    robust_irl,
    solve_dual,
)
from i2rl.inference.jin import jin_i2rl_with_features
from i2rl.inference.maxent import WarmStart, require_converged
from i2rl.inference.maxent_constraints import (
    FeatureTarget,
    InfeasibleProgram,
    ProgramNotSolved,
    excluded_pairs,
)
from i2rl.inference.maxent_dual import CountProgram, DualProgram
from i2rl.inference.maxent_primal import PrimalProgram
from i2rl.inference.mce import expected_features
from i2rl.inference.minmax import MinMaxProgram
from i2rl.models import (
    Demonstration,
    FeatureNoise,
    Sensor,
    TabularMDP,
    TrajectoryLaw,
    Visibility,
    feature_expectations,
    occupancy,
    sample_demonstration,
    soft_plan,
)
from i2rl.models.occlusion import ScaledPrior, scaled_prior
from i2rl.models.units import feature_scale, with_scaled_features

KEY = jax.random.key(0)
TRUTH = np.array([2.0, -1.5, 1.0])
# Micrometres and light seconds: each feature alone in its own unit, all in small or large ones, and mixed.
UNITS = [
    np.full(3, 1e-9),
    np.full(3, 1e9),
    np.array([1e-9, 1.0, 1e9]),
    np.array([1e6, 1e-6, 1e-9]),
    np.array([3.6, 0.3048, 4184.0]),
]
# Powers of two, about 1e-9 and 1e9, round nothing: for samplers, which magnify the least difference.
EXACT = [np.full(3, 2.0**-30), np.array([2.0**30, 2.0**-30, 2.0**10])]
VIEW = Visibility(np.array([1.0, 0.3, 1.0, 0.5]))
PREDICATES = np.zeros((2, 4, 3), bool)
PREDICATES[0, ::2], PREDICATES[1, :, 0] = True, True


@cache
def process() -> TabularMDP:
    rng = np.random.default_rng(1)
    mdp = TabularMDP.from_successors(
        rng.integers(0, 4, (4, 3, 2)),
        rng.dirichlet(np.ones(2), (4, 3)),
        rng.normal(size=(4, 3, 3)),
        initial=rng.dirichlet(np.ones(4)),
        discount=0.9,
        feature_names=["time", "distance", "energy"],
    )
    return replace(mdp, inflow_pairs=None, inflow_probabilities=None)


def in_units(units: np.ndarray) -> TabularMDP:
    return replace(process(), features=process().features * units)


@cache
def demonstration(hidden: bool = False, noise: bool = False) -> Demonstration:
    scale = np.asarray(feature_scale(process()))
    sensor = VIEW if hidden else FeatureNoise(PREDICATES, np.array([0.9, 0.8])) if noise else Sensor()
    law = TrajectoryLaw(process(), jnp.asarray(TRUTH / scale), sensor, 6)
    return sample_demonstration(jax.random.key(3), law, 12)


@jax.jit
def policy(mdp, weights):
    return soft_plan(mdp, mdp.features @ weights).policy


def policies(mdp, weights):
    return np.stack([policy(mdp, jnp.asarray(row)) for row in np.asarray(weights).reshape(-1, 3)])


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
    "lme_i2rl seen": (lambda mdp: lme_i2rl(mdp, VIEW), True),
    "lme_i2rl counts": (lambda mdp: lme_i2rl(mdp, VIEW, statistic="counts", ridge=0.3), True),
    "lme_i2rl features": (lambda mdp: lme_i2rl(mdp, VIEW, statistic="features", slack=0.02), True),
    "me_i2rl exponentiated": (
        lambda mdp: me_i2rl(mdp, statistic="features", solver="exponentiated gradient", iterations=2),
        False,
    ),
    "rimeo": (lambda mdp: rimeo(mdp, PREDICATES, scores="none"), False),
    "rifom": (lambda mdp: rifom(mdp, PREDICATES, slack=0.01), False),
}


@pytest.mark.parametrize("name", TRACED)
def test_sessions_learn_the_same_behaviour_in_all_units(name):
    make, hidden = TRACED[name]
    sessions = list(demonstration(hidden).sessions(6))

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
            assert getattr(report, field) == pytest.approx(getattr(reported, field), rel=1e-6, abs=1e-9)
        assert report.iterations == reported.iterations
        assert report.converged == reported.converged == ("exponentiated" not in name)
        if hasattr(state.statistic, "features"):
            np.testing.assert_allclose(
                state.statistic.features / units, expected.statistic.features, rtol=1e-6
            )


# Their programs take the process as an argument already, or run outside JAX.
UPDATED = {
    "darko_i2rl": (lambda mdp: darko_i2rl(mdp, radius=2.0), False),
    "jin_i2rl": (lambda mdp: jin_i2rl(mdp), False),
    "jin_i2rl_with_features": (lambda mdp: jin_i2rl_with_features(mdp), False),
    "mme_mtirl": (lambda mdp: mme_mtirl(mdp, ways=2, restarts=1, l1=0.01), False),
    "lme_i2rl ipopt": (lambda mdp: lme_i2rl(mdp, VIEW, solver="ipopt", slack=0.0, ridge=0.1), True),
    "me_i2rl cvxpy": (lambda mdp: me_i2rl(mdp, statistic="features", solver="cvxpy", iterations=2), False),
    "rimeo ipopt": (lambda mdp: rimeo(mdp, PREDICATES, scores="none", solver="ipopt"), False),
}


@pytest.mark.parametrize("name", UPDATED)
def test_updates_learn_the_same_behaviour_in_all_units(name):
    make, hidden = UPDATED[name]
    sessions = list(demonstration(hidden).sessions(6))
    own_features = name != "jin_i2rl"

    def run(mdp):
        learner = make(mdp)
        state = learner.init(KEY)
        for session in sessions:
            state, report = learner.update(state, session)
        assert learner.mdp.features.shape != mdp.features.shape or learner.mdp is mdp
        return learner, state, report

    learner, expected, reported = run(process())
    # Compiled anew for each unit where programs run outside JAX: mixed units are the hardest.
    for units in UNITS if name in ("darko_i2rl", "jin_i2rl_with_features", "mme_mtirl") else UNITS[3:4]:
        other, state, report = run(in_units(units))
        factor = units if own_features else 1.0
        assert report.converged is reported.converged is True
        np.testing.assert_allclose(state.weights * factor, expected.weights, rtol=1e-4, atol=1e-6)
        if own_features:
            wanted = policies(process(), expected.weights)
            np.testing.assert_allclose(policies(in_units(units), state.weights), wanted, atol=1e-6)
        if other.log_likelihood is not None:
            known = learner.log_likelihood(expected, expected.weights)
            assert other.log_likelihood(state, state.weights) == pytest.approx(known, abs=1e-6)


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


BATCH = {
    "mlirl": lambda mdp: mlirl(KEY, mdp, demonstration(), restarts=2, iterations=40).weights,
    "em_mlirl": lambda mdp: em_mlirl(mdp, clusters=2, iterations=4).fit(KEY, demonstration()).weights,
    "dpm_birl": lambda mdp: dpm_birl(mdp, sweeps=15, sigma=0.1).fit(KEY, demonstration()).weights,
    "birl": lambda mdp: np.asarray(
        birl(KEY, mdp, demonstration(), draws=30, warmup=30, chains=2).posterior.weights
    )[0],
    "batch_mme_mtirl": lambda mdp: batch_mme_mtirl(mdp, ways=2, restarts=1).fit(KEY, demonstration()).weights,
    "batch_lme": lambda mdp: batch_lme(mdp, VIEW, restarts=1, iterations=8).fit(
        KEY, demonstration(True)
    ).weights,
    "robust_irl": lambda mdp: robust_irl(
        mdp, FeatureNoise(PREDICATES, np.array([0.9, 0.8])), restarts=1, iterations=3
    ).fit(KEY, demonstration(noise=True)).weights,
}  # fmt: skip


@pytest.mark.parametrize("name", BATCH)
def test_batch_methods_learn_the_same_weights_in_all_units(name):
    expected = np.asarray(BATCH[name](process()))
    assert np.abs(expected).max() > 0.05
    for units in EXACT[1:] if name in ("batch_lme", "robust_irl") else EXACT:
        np.testing.assert_array_equal(np.asarray(BATCH[name](in_units(units))) * units, expected)


# -- programs -----------------------------------------------------------------------------------------


@cache
def target(units: tuple[float, ...]) -> FeatureTarget:
    mdp = in_units(np.array(units))
    scale = np.asarray(feature_scale(mdp))
    features = feature_expectations(mdp, policy(mdp, jnp.asarray(TRUTH / scale)))
    return FeatureTarget(features, mdp.initial)


def counts() -> np.ndarray:
    scale = np.asarray(feature_scale(process()))
    visits = occupancy(process(), policy(process(), jnp.asarray(TRUTH / scale)))
    return np.random.default_rng(0).poisson(50 * np.asarray(visits)).astype(float)


SLACK = np.array([0.05, 0.0, 0.1])
PROGRAMS = {
    "solve_dual": lambda mdp, aim: solve_dual(mdp, aim, SLACK, 0.1),
    "fit_counts": lambda mdp, _: fit_counts(mdp, counts(), 20 * SLACK, 0.1),
    "exponentiated_gradient": lambda mdp, aim: exponentiated_gradient(mdp, aim, max_steps=300),
    "DualProgram": lambda mdp, aim: DualProgram(mdp).solve(aim, SLACK, 0.1),
    "CountProgram": lambda mdp, _: CountProgram(mdp).solve(counts(), 20 * SLACK, 0.1),
    "PrimalProgram": lambda mdp, aim: PrimalProgram(mdp).solve(aim, SLACK),
    "MinMaxProgram": lambda mdp, _: MinMaxProgram(mdp, 2, 6).solve(
        np.random.default_rng(0).poisson(4.0, (6, 4, 3)), 1.0, 0.1, 0.1,
        weights=np.array([[1.0, 0, 0], [0, 1.0, 0]]) / np.asarray(feature_scale(mdp)),
    ),
    "fit_weights": lambda mdp, _: fit_weights(
        mdp, 5, np.asarray(expected_features(mdp, jnp.asarray(TRUTH / feature_scale(mdp)), 5)), tolerance=1e-9
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_have_the_same_solution_in_all_units(name):
    expected = PROGRAMS[name](process(), target((1.0, 1.0, 1.0)))
    for units in UNITS:
        solution = PROGRAMS[name](in_units(units), target(tuple(units)))
        np.testing.assert_allclose(
            policies(in_units(units), solution.weights), policies(process(), expected.weights), atol=1e-6
        )
        np.testing.assert_allclose(solution.weights * units, expected.weights, rtol=1e-4, atol=1e-6)
        for field in ("objective", "value"):
            if hasattr(solution, field):
                assert getattr(solution, field) == pytest.approx(getattr(expected, field), abs=1e-6)
        if name in ("solve_dual", "fit_counts"):
            assert solution.converged
            start = WarmStart(solution.weights, solution.values)
            warm = (
                solve_dual(in_units(units), target(tuple(units)), SLACK, 0.1, start)
                if name == "solve_dual"
                else fit_counts(in_units(units), counts(), 20 * SLACK, 0.1, start)
            )
            assert warm.iterations <= 1


@pytest.mark.parametrize("units", [np.ones(3), UNITS[2]], ids=["plain", "mixed"])
def test_slack_is_a_share_of_each_feature_s_scale(units):
    mdp = in_units(units)
    solution = solve_dual(mdp, target(tuple(units)), SLACK)
    gap = feature_expectations(mdp, policy(mdp, solution.weights)) - target(tuple(units)).features
    np.testing.assert_allclose(np.abs(gap) / feature_scale(mdp), SLACK, atol=1e-7)


# -- IPOPT --------------------------------------------------------------------------------------------


def random_process(seed: int, kind: str) -> TabularMDP:
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(10, 3, 3))
    if kind == "constant":
        features[..., 2] = 1.0
    if kind == "duplicate":
        features[..., 2] = features[..., 0]
    mdp = TabularMDP.from_successors(
        rng.integers(0, 10, (10, 3, 3)), rng.dirichlet(np.ones(3), (10, 3)), features,
        initial=rng.dirichlet(np.ones(10)), discount=(0.9, 0.95, 0.99)[seed % 3],
    )  # fmt: skip
    return replace(mdp, inflow_pairs=None, inflow_probabilities=None)


# Among them are those that an inequality's boundary, or a direction that data leave open, led astray.
@pytest.mark.parametrize("kind", ["normal", "constant", "duplicate"])
@pytest.mark.parametrize("seed", [8, 12, 13, 14, 17, 20, 24])
def test_ipopt_solves_without_slack_and_stays_where_data_say_nothing(seed, kind):
    mdp = random_process(seed, kind)
    weights = jnp.asarray(np.random.default_rng(1000 + seed).normal(size=3))
    aim = FeatureTarget(feature_expectations(mdp, policy(mdp, weights)), mdp.initial)
    newton, ipopt = solve_dual(mdp, aim), DualProgram(mdp).solve(aim)
    assert newton.converged
    assert ipopt.converged
    assert ipopt.objective == pytest.approx(float(newton.objective), abs=1e-7)
    np.testing.assert_allclose(policies(mdp, ipopt.weights), policies(mdp, weights), atol=1e-6)
    if kind == "normal":
        np.testing.assert_allclose(ipopt.weights, newton.weights, atol=1e-6)
    else:
        # Neither goes further along the open direction than the expert's own weights are from zero.
        for found in (newton.weights, ipopt.weights):
            assert np.abs(np.asarray(found) * feature_scale(mdp)).max() < 20
    visits = 40 * np.asarray(occupancy(mdp, policy(mdp, weights)))
    counted = CountProgram(mdp).solve(visits)
    np.testing.assert_allclose(policies(mdp, counted.weights), policies(mdp, weights), atol=1e-6)


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
    with pytest.raises(ProgramNotSolved, match="ever takes state 2, action 1. A positive slack"):
        require_converged(one_hot, aim, 0.0, unsolved)
    inside = target(tuple(units))
    assert len(excluded_pairs(mdp, inside)[0]) == 0
    unsolved = solve_dual(mdp, inside)._replace(converged=jnp.array(False))
    with pytest.raises(ProgramNotSolved, match="takes every action, so its weights are finite"):
        require_converged(mdp, inside, 0.0, unsolved)


def test_a_target_beyond_every_policy_is_named_in_the_user_s_units():
    mdp = in_units(UNITS[2])
    aim = target(tuple(UNITS[2]))
    far = aim._replace(features=aim.features.at[0].add(2e-8))
    for solve in (DualProgram(mdp).solve, PrimalProgram(mdp).solve):
        with pytest.raises(InfeasibleProgram, match=r"'time' \(0\) is to be [0-9.]+e-08 within 9[0-9.]*e-11"):
            solve(far, 0.05)


# -- posteriors ---------------------------------------------------------------------------------------


def test_posteriors_are_the_same_density_of_scaled_weights_in_all_units():
    rng = np.random.default_rng(5)
    density = jax.jit(jax.value_and_grad(posterior.potential))
    noisy_density = jax.jit(jax.value_and_grad(noisy_posterior.noisy_potential))
    mixed_density = jax.jit(jax.value_and_grad(mixture_problem.potential))
    points = rng.normal(size=(3, 3))

    def evaluated(mdp, prior):
        problem, _ = posterior.gather(mdp, VIEW, demonstration(True), prior)
        noisy, _ = noisy_posterior.noisy_problem(mdp, PREDICATES, demonstration(), prior=prior)
        mixed, _, _ = mixture_problem.pose(
            mdp, Sensor(), demonstration(), concentration=1.0, prior=prior, at_least_one={}, warmup=0
        )
        found = [density(jnp.asarray(x), problem) for x in points]
        found += [noisy_density(jnp.append(x, jnp.array([0.5, -0.5])), noisy) for x in points]
        found += [mixed_density({"weights": jnp.asarray(points), "sticks": jnp.zeros(2)}, mixed)]
        constrained = dist.biject_to(problem.prior.support)(jnp.asarray(points))
        return jax.tree.leaves(found), np.asarray(constrained), posterior.posterior_mode(problem)

    for prior in (None, dist.HalfNormal(2.0)):
        expected, weights, mode = evaluated(process(), prior)
        scale = np.asarray(feature_scale(process()))
        np.testing.assert_allclose(
            weights,
            dist.biject_to(dist.Normal(0, 1).support if prior is None else prior.support)(points) / scale,
        )
        for units in UNITS[:3]:
            found, own, other = evaluated(in_units(units), prior)
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
    positive = ScaledPrior(dist.HalfNormal(1.0).expand((3,)).to_event(1), scale)
    assert positive.support(jnp.array([1e-9, 1.0, 1e9]))
    assert not positive.support(jnp.array([-1e-9, 1.0, 1e9]))


def test_sampled_weights_come_in_the_user_s_units():
    options = {"draws": 150, "warmup": 150, "chains": 2, "completions": False}
    scale = np.asarray(feature_scale(process()))
    drawn = [
        np.asarray(
            posterior.sample_posterior(KEY, mdp, VIEW, demonstration(True), **options).posterior.weights
        )
        for mdp in (process(), in_units(UNITS[3]))
    ]
    one, other = drawn[0] * scale, drawn[1] * scale * UNITS[3]
    assert np.abs(one.mean((0, 1)) - other.mean((0, 1))).max() < 0.5 * one.std((0, 1)).max()
    np.testing.assert_allclose(one.std((0, 1)), other.std((0, 1)), rtol=0.5)


def test_what_is_not_determined_is_the_same_in_all_units():
    few = demonstration().select(slice(0, 2))
    weights = TRUTH / np.asarray(feature_scale(process()))
    expected = identifiability_of(process(), Sensor(), few, weights)
    assert expected.weak
    for units in UNITS[2:4]:
        found = identifiability_of(in_units(units), Sensor(), few, weights / units)
        np.testing.assert_allclose(found.standard_errors * units, expected.standard_errors, rtol=1e-6)
        np.testing.assert_allclose(found.length_loss, expected.length_loss, atol=1e-8)
        for a, b in zip(found.weak, expected.weak, strict=True):
            np.testing.assert_allclose(a.vector, b.vector, atol=1e-6)
            assert a.description == b.description
