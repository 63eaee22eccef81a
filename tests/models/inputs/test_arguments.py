"""Users' inputs: sensors, demonstrations and keys in any form, checked wherever there are numbers."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from i2rl.analysis import demonstration_log_likelihoods, identifiability_of, posterior_by_session
from i2rl.domains import SwapNoise
from i2rl.inference import (
    airl_tabular,
    batch_lme,
    batch_mme_mtirl,
    birl,
    darko_i2rl,
    dpm_birl,
    em_mlirl,
    fleet,
    gibbs_mixture_posterior,
    jin_i2rl,
    lme_i2rl,
    mlirl,
    mme_mtirl,
    rifom,
    rimeo,
    robust_airl_tabular,
    robust_irl,
    sample_mixture_posterior,
    sample_noisy_posterior,
    sample_posterior,
    sensor_identification,
)
from i2rl.inference.completion.smoothing import evidence_of
from i2rl.models import (
    Confusions,
    Demonstration,
    DemonstrationError,
    FeatureNoise,
    GaussianSensor,
    MixtureLaw,
    ObservationModel,
    Sensor,
    ShiftSensor,
    TabularMDP,
    TrajectoryLaw,
    Visibility,
    distort,
    log_evidence,
    require_possible,
    sample_demonstration,
    simulate,
)
from i2rl.models.inputs.arguments import as_key, concrete
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN
from i2rl.models.observation.evidence import as_sensor, checked_demonstration, step_log_evidence

S, A = 3, 2
NAN = np.nan

# -- sensors ----------------------------------------------------------------------------------------------

MASKED = np.ma.masked_array([1.0, 0.0, 1.0], [False, True, False])
WRONG = {
    "view": (Visibility, [30.0, 0.0, 100.0], r"in_view must be a mask or probabilities .* state 0 is 30"),
    "negative view": (Visibility, [0.5, -0.1, 1.0], r"state 1 is -0\.1"),
    "view of nan": (Visibility, [NAN, 0.0, 1.0], r"state 0 is nan"),
    "view of two dimensions": (Visibility, [[1.0, 0.0]], r"in_view must have shape \[S\]"),
    "visibility": (Sensor, [2.0, 0.0, 1.0], r"visibility must be .* state 0 is 2"),
    "log-confusion": (ObservationModel, np.zeros((1, 2, 1, 2)), r"pair \(0, 0\) sum to 2"),
    "log-confusion of nan": (ObservationModel, np.full((1, 1, 1, 1), NAN), r"\(0, 0, 0, 0\) is nan"),
    "confusion": (ObservationModel.from_probabilities, np.ones((1, 2, 1, 2)), r"pair \(0, 0\) sum to 2"),
    "confused states": (
        lambda x: ObservationModel.from_factors(x, np.eye(2)),
        [[0.9, 0.0], [0.0, 1.0]],
        r"sum to 0\.9",
    ),
    "predicates": (lambda x: FeatureNoise(x, [0.9]), [[[0.5, 1.0]]], r"true or false, or whole numbers"),
    "reliabilities": (lambda x: FeatureNoise([[[True, False]]], x), [1.5], r"predicate 0 is 1\.5"),
    "reportable": (lambda x: FeatureNoise([[[True, False]]], [0.9], x), [[0, 0]], r"at least one of"),
    "partly reportable": (lambda x: FeatureNoise([[[True, False]]], [0.9], x), [[0.5, 1]], r"true or false"),
    "confusions": (lambda x: Confusions(x, [0.1]), [[[0, 5]]], r"0 to 1; got 5"),
    "chance of confusions": (lambda x: Confusions([[[1, 1]]], x), [-0.1], r"confusion 0 is -0\.1"),
    "chance of swaps": (lambda x: SwapNoise([[[1, 0]]], x), [1.1], r"swap 0 is 1\.1"),
    "covariance": (lambda x: GaussianSensor(x, 1.0), [[1.0, 2.0], [2.0, 1.0]], r"not positive definite"),
    "variance": (lambda x: GaussianSensor(1.0, x), -1.0, r"least eigenvalue is -1"),
    "chance of a shift": (lambda x: ShiftSensor(0.1, x), 1.5, r"must be in \[0, 1\], got 1\.5"),
    "shift": (ShiftSensor, np.inf, r"shift must be a finite number"),
}
LIBRARIES = {"numpy": np.asarray, "jax": jnp.asarray, "python": lambda x: np.asarray(x).tolist()}


@pytest.mark.parametrize("library", LIBRARIES.values(), ids=LIBRARIES)
@pytest.mark.parametrize(("build", "given", "message"), WRONG.values(), ids=WRONG)
def test_parameters_of_a_sensor_are_checked_whatever_their_library(library, build, given, message):
    with pytest.raises(ValueError, match=message):
        build(library(given))


def test_tables_of_pandas_and_masked_arrays_are_checked_too():
    np.testing.assert_array_equal(Visibility(pd.Series([True, False])).in_view, [1, 0])
    with pytest.raises(ValueError, match=r"state 1 is 3"):
        Visibility(pd.Series([1.0, 3.0]))
    with pytest.raises(ValueError, match=r"in_view must be numbers throughout; the entry \[1\] is masked"):
        Visibility(MASKED)
    np.testing.assert_array_equal(Visibility(np.ma.masked_array([1.0, 0.0])).in_view, [1, 0])
    with pytest.raises(ValueError, match=r"the entry \[0, 0\] is masked"):
        GaussianSensor(np.ma.masked_array(np.eye(2), np.eye(2, dtype=bool)), 1.0)
    with pytest.raises(TypeError, match=r"in_view must be an array of real numbers; got 'all' \(str\)"):
        Visibility("all")
    with pytest.raises(TypeError, match=r"array of real numbers; got \[\[1\], \[2, 3\]\] \(list\)"):
        Visibility([[1], [2, 3]])
    with pytest.raises(TypeError, match="got a random key"):
        Visibility(jax.random.key(0))


def test_a_changed_sensor_is_checked_and_one_that_jax_rebuilds_is_not():
    view = Visibility([1.0, 0.0])
    with pytest.raises(ValueError, match=r"state 0 is 7"):
        view._replace(in_view=jnp.array([7.0, 0.0]))
    # A derivative, say, is no view.
    slope = jax.grad(lambda v: 9.0 * v.in_view.sum())(view)
    assert isinstance(slope, Visibility)
    np.testing.assert_array_equal(slope.in_view, [9, 9])
    assert jax.jit(lambda p: Visibility(p).in_view * 2)(jnp.array([7.0]))[0] == 14
    assert jax.tree.map(lambda _: object(), view) is not None
    assert jax.tree_util.keystr(jax.tree_util.tree_leaves_with_path(view)[0][0]) == ".in_view"


@pytest.mark.parametrize("precision", [np.float32, np.float16])
def test_confusions_of_fewer_bits_are_normalised(precision):
    rng = np.random.default_rng(0)
    exact = rng.dirichlet(np.ones(6), (3, 2)).reshape(3, 2, 3, 2)
    given = exact.astype(precision)
    for sensor in (
        ObservationModel.from_probabilities(given),
        ObservationModel.from_probabilities(jnp.asarray(given)),
        ObservationModel(jnp.log(jnp.asarray(given))),
    ):
        table = np.exp(sensor.log_probabilities)
        np.testing.assert_allclose(table.sum((2, 3)), 1, atol=1e-14)
        np.testing.assert_allclose(table, exact, atol=2 * np.finfo(precision).eps)
    with pytest.raises(ValueError, match="not 1"):
        ObservationModel.from_probabilities(given * precision(1.1))
    # What is exact to rounding keeps its bits.
    kept = ObservationModel.from_probabilities(exact).log_probabilities
    np.testing.assert_array_equal(kept, jnp.asarray(np.log(exact)))


def test_imperfections_stand_for_what_they_have():
    noise = FeatureNoise(np.ones((1, S, A), bool), [0.9])
    sensor = Sensor(Visibility([1, 0, 1]), noise)
    np.testing.assert_array_equal(sensor.visibility, [1, 0, 1])
    assert isinstance(sensor.noise, ObservationModel)
    with pytest.raises(TypeError, match=r"noise must be an ObservationModel or None; got 3"):
        Sensor(None, 3)
    with pytest.raises(ValueError, match=r"one number of states .* got shapes \(2,\) and \(3,\)"):
        Visibility([1, 0]) * Visibility([1, 0, 1])
    assert isinstance(noise * [True, False, True], Sensor)


# -- where a sensor is expected -----------------------------------------------------------------------------

MDP = TabularMDP.from_dense(
    np.full((S, A, S), 1 / S), np.random.default_rng(0).random((S, A, 2)), discount=0.9
)
PREDICATES = np.array([np.arange(S * A).reshape(S, A) % 2 == 0, np.arange(S * A).reshape(S, A) < 3])
NOISE = FeatureNoise(PREDICATES, [0.8, 0.7])
GOOD = Demonstration.from_pairs([[0, 1, 2], [2, 1, 0]], [[1, 1, 0], [0, 1, 1]])
SENSORS = {
    "lme_i2rl": lambda s: lme_i2rl(MDP, s),
    "batch_lme": lambda s: batch_lme(MDP, s),
    "robust_irl": lambda s: robust_irl(MDP, NOISE * s),
    "rimeo": lambda s: rimeo(MDP, PREDICATES, visibility=s),
    "rifom": lambda s: rifom(MDP, PREDICATES, visibility=s),
    "mme_mtirl": lambda s: mme_mtirl(MDP, s),
    "batch_mme_mtirl": lambda s: batch_mme_mtirl(MDP, s),
    "robust_airl_tabular": lambda s: robust_airl_tabular(MDP, s),
    "TrajectoryLaw": lambda s: TrajectoryLaw(MDP, jnp.zeros(2), s, 3),
    "MixtureLaw": lambda s: MixtureLaw(MDP, jnp.ones(1), jnp.zeros((1, 2)), s, 3),
    "log_evidence": lambda s: log_evidence(s, MDP, GOOD),
    "require_possible": lambda s: require_possible(s, MDP, GOOD),
    "log-likelihood": lambda s: demonstration_log_likelihoods(MDP, s, np.zeros(2), GOOD),
}


@pytest.mark.parametrize("use", SENSORS.values(), ids=SENSORS)
@pytest.mark.parametrize("wrong", ["bridge", 3, Visibility, GaussianSensor(1.0, 1.0), np.arange(3)])
def test_what_is_no_sensor_is_refused_with_what_to_pass(use, wrong):
    with pytest.raises(TypeError, match=r"sensor must be a Visibility, .*; Sensor\(\) sees everything; got"):
        use(wrong)


@pytest.mark.parametrize("mask", [[True, True, True], np.ones(3), jnp.ones(3, bool), pd.Series([True] * 3)])
def test_a_bare_mask_is_a_view(mask):
    assert isinstance(as_sensor(mask), Visibility)
    # The evidence of a mask is that of its view.
    np.testing.assert_array_equal(
        log_evidence(mask, MDP, GOOD), log_evidence(Visibility(np.asarray(mask)), MDP, GOOD)
    )
    assert (lme_i2rl(MDP, mask).signature) == lme_i2rl(MDP, Visibility(np.asarray(mask))).signature


def test_continuous_sensors_are_told_from_tabular_ones():
    with pytest.raises(TypeError, match=r"one of continuous recordings, such as GaussianSensor"):
        distort(jax.random.key(0), Visibility([1.0]), None)


# -- demonstrations -------------------------------------------------------------------------------------

OUTSIDE = Demonstration.from_pairs([[0, 1, 2], [0, 1, 7]], [[0, 0, 0], [1, 1, 0]])
MESSAGE = r"trajectory 1, step 2: state 7 is out of range; indices run from 0 to 2"
KEY = jax.random.key(0)
USES = {
    "evidence": lambda d: log_evidence(NOISE, MDP, d),
    "evidence of a learner": lambda d: evidence_of(MDP, NOISE, d),
    "LME": lambda d: update(lme_i2rl(MDP, NOISE), d),
    "LME, IPOPT": lambda d: update(lme_i2rl(MDP, NOISE, solver="ipopt"), d),
    "batch LME": lambda d: batch_lme(MDP, NOISE).fit(KEY, d),
    "Robust IRL": lambda d: robust_irl(MDP, NOISE).fit(KEY, d),
    "RIMEO": lambda d: update(rimeo(MDP, PREDICATES, scores="none"), d),
    "RIFOM": lambda d: update(rifom(MDP, PREDICATES), d),
    "identification": lambda d: sensor_identification(MDP, PREDICATES, d, np.zeros(2)),
    "MTIRL": lambda d: update(mme_mtirl(MDP, NOISE, n_components=1), d),
    "MTIRL, seen": lambda d: update(mme_mtirl(MDP, n_components=1), d),
    "batch MTIRL": lambda d: batch_mme_mtirl(MDP, NOISE, n_components=1).fit(KEY, d),
    "Jin": lambda d: update(jin_i2rl(MDP), d),
    "DARKO": lambda d: update(darko_i2rl(MDP), d),
    "AIRL": lambda d: update(airl_tabular(MDP), d),
    "robust-AIRL": lambda d: update(robust_airl_tabular(MDP, NOISE), d),
    "MLIRL": lambda d: mlirl(KEY, MDP, d),
    "EM-MLIRL": lambda d: em_mlirl(MDP, n_components=1).fit(KEY, d),
    "DPM-BIRL": lambda d: dpm_birl(MDP).fit(KEY, d),
    "BIRL": lambda d: birl(KEY, MDP, d),
    "posterior": lambda d: sample_posterior(KEY, MDP, NOISE, d),
    "posterior by session": lambda d: posterior_by_session(KEY, MDP, NOISE, d, [1]),
    "noisy posterior": lambda d: sample_noisy_posterior(KEY, MDP, PREDICATES, d),
    "mixture posterior": lambda d: sample_mixture_posterior(KEY, MDP, NOISE, d),
    "Gibbs mixture": lambda d: gibbs_mixture_posterior(KEY, MDP, NOISE, d),
    "law": lambda d: TrajectoryLaw(MDP, jnp.zeros(2), NOISE, 3).log_prob(d.codes),
    "mixture law": lambda d: MixtureLaw(MDP, jnp.ones(1), jnp.zeros((1, 2)), NOISE, 3).log_prob(d.codes),
    "log-likelihood": lambda d: demonstration_log_likelihoods(MDP, NOISE, np.zeros(2), d),
    "identifiability": lambda d: identifiability_of(MDP, NOISE, d),
}


def update(learner, demonstration):
    return learner.update(learner.init(KEY), demonstration)


@pytest.mark.parametrize("use", USES.values(), ids=USES)
def test_an_index_of_no_state_is_refused_before_anything_compiles(use):
    with pytest.raises(DemonstrationError, match=MESSAGE):
        use(OUTSIDE)


@pytest.mark.parametrize("use", [u for n, u in USES.items() if "law" not in n])
def test_what_is_no_demonstration_is_refused_with_what_to_pass(use):
    with pytest.raises(TypeError, match=r"must be a Demonstration|takes a Demonstration"):
        use([(0, 1), (1, 1)])


def changed(**fields):
    return replace(OUTSIDE.select([0]), **{n: np.asarray(x)[None] for n, x in fields.items()})


@pytest.mark.parametrize(
    ("demonstration", "message"),
    [
        (
            changed(action=[0, 5, 0]),
            "trajectory 0, step 1: action 5 is out of range; .* 0 to 1",
        ),
        (changed(state=[0, -2, 0]), "step 1: state -2 is out of range"),
        (changed(state=[0.0, 0.9, 1.0]), "state must be an array of whole numbers; got float64"),
        (changed(kind=[SEEN, 9, SEEN]), r"step 1: kind must be PAD, SEEN, HIDDEN or LOST \(0 to 3\), got 9"),
        (changed(kind=[SEEN, PAD, SEEN]), "step 1: padding comes last, but step 2 is a step"),
        (changed(score=[NAN, 1.5, NAN]), r"step 1: score must lie in \[0, 1\], got 1\.5"),
        (changed(score=[NAN, 1.0]), r"arrays of one shape .* score \(1, 2\)"),
        (changed(action=[0, 1]), r"arrays of one shape .* action \(1, 2\)"),
    ],
)
def test_demonstrations_that_are_none_are_refused(demonstration, message):
    with pytest.raises(DemonstrationError, match=message):
        checked_demonstration(MDP, demonstration)


def test_indices_of_steps_that_were_not_seen_do_not_matter():
    hidden = changed(kind=[SEEN, HIDDEN, LOST], state=[0, 99, -7])
    assert checked_demonstration(MDP, hidden).kind.tolist() == [[SEEN, HIDDEN, LOST]]
    unknown = changed(state=[0, UNKNOWN, 1])
    assert np.isfinite(np.asarray(log_evidence(NOISE, MDP, unknown))).all()


def test_compiled_programs_give_indices_of_nothing_probability_zero():
    @jax.jit
    def evidence(kind, state, action):
        return step_log_evidence(NOISE, S, A, kind, state, action, jnp.nan)

    for state, action in ((7, 0), (-2, 0), (0, 2), (0, -5)):
        np.testing.assert_array_equal(evidence(SEEN, state, action), -np.inf)
    np.testing.assert_array_equal(evidence(9, 0, 0), -np.inf)
    for kind in (HIDDEN, LOST, PAD):
        assert (evidence(kind, 7, 7) > -np.inf).all() or kind == HIDDEN
    law = TrajectoryLaw(MDP, jnp.zeros(2), NOISE, 3)
    assert jax.jit(law.log_prob)(jnp.asarray(OUTSIDE.codes)).tolist()[1] == -np.inf


def test_a_fleet_keeps_its_state_where_an_index_is_of_no_state():
    crew = fleet(lme_i2rl(MDP, NOISE, iterations=2))
    state = crew.init(KEY, 1)
    new, info = crew.update(state, jax.tree.map(lambda x: jnp.asarray(x)[None], OUTSIDE.bucketed()))
    assert info.demonstration_log_likelihood[0] == -np.inf
    np.testing.assert_array_equal(new.weights, state.weights)


# -- keys -----------------------------------------------------------------------------------------------


def test_a_seed_stands_for_its_key():
    for seed in (0, np.int64(0)):
        assert as_key(seed) == jax.random.key(0)
    legacy = jax.random.PRNGKey(3)
    assert as_key(legacy) == as_key(np.asarray(legacy)) == jax.random.key(3)
    law = TrajectoryLaw(MDP, jnp.zeros(2), Sensor(), 3)
    np.testing.assert_array_equal(law.sample(5), law.sample(jax.random.key(5)))
    assert sample_demonstration(0, law, 2).n_trajectories == 2
    policy = jnp.log(jnp.full((S, A), 1 / A))
    np.testing.assert_array_equal(simulate(1, MDP, policy, 4), simulate(jax.random.key(1), MDP, policy, 4))


@pytest.mark.parametrize("wrong", ["0", 0.5, None, True, jnp.zeros(2), np.zeros(2, int)])
def test_what_is_no_key_is_refused_with_what_to_pass(wrong):
    with pytest.raises(TypeError, match=r"key must be one random key such as jax\.random\.key"):
        sample_posterior(wrong, MDP, Sensor(), GOOD)


def test_traced_arguments_have_no_numbers():
    seen = []
    jax.jit(lambda x: seen.append((concrete("x", x), concrete("x", [x, 1.0]))))(1.0)
    assert seen == [(None, None)]
    assert concrete("x", 1).dtype == float
    with pytest.raises(TypeError, match="real numbers"):
        concrete("x", 1j)


def test_sensors_that_jax_rebuilt_are_copied_and_pickled():
    mapped = jax.vmap(Visibility)(jnp.full((2, 3), 0.5))
    slope = jax.grad(lambda view: 3 * view.in_view.sum())(Visibility([0.2, 0.7, 1.0]))
    for sensor in (mapped, slope, Sensor(jnp.ones(3)), jax.tree.map(lambda x: x.shape, mapped)):
        for again in (copy.copy(sensor), copy.deepcopy(sensor), pickle.loads(pickle.dumps(sensor))):
            assert type(again) is type(sensor)
            jax.tree.map(np.testing.assert_array_equal, again, sensor)
