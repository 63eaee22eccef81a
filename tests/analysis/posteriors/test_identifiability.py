"""Fisher information, and the directions of weights that demonstrations do not determine."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.judging.metrics import demonstration_log_likelihoods
from i2rl.analysis.posteriors.identifiability import (
    describe_identifiability,
    directions_table,
    identifiability_of,
    identifiability_section,
)
from i2rl.analysis.posteriors.information import (
    complete_information,
    expected_information,
    observed_information,
    policy_sensitivity,
    scores,
)
from i2rl.analysis.posteriors.invariance import combination, unidentified_directions
from i2rl.domains import demonstrate, instance
from i2rl.inference.programs.maximum_entropy import fit_counts
from i2rl.models import (
    Demonstration,
    Sensor,
    TabularMDP,
    TrajectoryLaw,
    Visibility,
    reward_of,
    sample_demonstration,
    soft_plan,
)
from i2rl.models.observation.evidence import log_evidence
from i2rl.models.process.planning import finite_occupancy, reachable_states

THETA = jnp.array([0.8, -1.1])
# Small demonstrations are padded to one shape, and their sensors of one type, so that they share programs.
ROWS, LENGTH = 8192, 4
HALF = Visibility(np.array([True, False, True, False]))
CLEAR = Visibility(np.ones(4, bool))


@jax.jit
def _log_policy(mdp, weights):
    return soft_plan(mdp, reward_of(mdp, weights)).log_policy


def log_policy_of(mdp, weights):
    """Zero where an action is unavailable."""
    return np.where(mdp.available, _log_policy(mdp, jnp.asarray(weights)), 0.0)


def derivative(function, point, step=1e-5):
    """Central differences along every coordinate; the last axis of the result is the coordinate."""
    moves = step * np.eye(len(point))
    return np.stack([(function(point + m) - function(point - m)) / (2 * step) for m in moves], axis=-1)


def with_features(mdp, features, names=None):
    features = np.where(np.asarray(mdp.available)[..., None], features, 0.0)
    # Without the inflow tables, whose width varies, random processes share compiled programs.
    return replace(
        mdp.without_inflow(), features=jnp.asarray(features), labels=replace(mdp.labels, features=names)
    )


def small(mdp):
    return with_features(mdp, mdp.features)


def extended(mdp, name, column):
    """Return the same process with one more feature."""
    features = np.concatenate([np.asarray(mdp.features), np.asarray(column)[..., None]], axis=2)
    return with_features(mdp, features, (*mdp.feature_names, name))


def shaping(mdp, potential):
    return potential[:, None] - float(mdp.discount) * np.asarray(mdp.expect_next(jnp.asarray(potential)))


def assert_behaviour_unchanged(mdp, direction, key=0):
    """Soft policies along the direction, at random weights, agree wherever a trajectory can get."""
    weights = np.random.default_rng(key).normal(size=mdp.n_features)
    before, after = (log_policy_of(mdp, w) for w in (weights, weights + 3 * direction.vector))
    there = reachable_states(mdp)
    np.testing.assert_allclose(after[there], before[there], atol=1e-6)


# -- information --------------------------------------------------------------------------------------


def test_sensitivity_is_the_derivative_of_the_policy(random_mdp):
    mdp = random_mdp(3, n_states=6, masked=True)
    numeric = derivative(lambda w: log_policy_of(mdp, w), np.asarray(THETA))
    np.testing.assert_allclose(policy_sensitivity(mdp, THETA), numeric, atol=1e-8)


def test_complete_information_is_the_curvature_of_the_divergence(random_mdp):
    mdp = random_mdp(4, n_states=6, masked=True)
    visits = np.arange(1.0, 7.0)
    here = log_policy_of(mdp, THETA)

    def divergence(weights):
        return visits @ (np.exp(here) * (here - log_policy_of(mdp, weights))).sum(1)

    numeric = derivative(lambda w: derivative(divergence, w, 1e-3), np.asarray(THETA), 1e-3)
    np.testing.assert_allclose(complete_information(mdp, THETA, jnp.asarray(visits)), numeric, atol=1e-3)


def test_observed_information_against_enumeration(random_mdp, enumerate_completions, imperfect_demonstration):
    mdp = small(random_mdp(5))
    demo = imperfect_demonstration(1, mdp, log_policy_of(mdp, THETA), HALF, 4, LENGTH)
    evidence = np.asarray(log_evidence(HALF, mdp, demo))

    def log_likelihoods(weights):
        policy = log_policy_of(mdp, weights)
        rows = zip(evidence, demo.lengths, strict=True)
        return np.array([enumerate_completions(mdp, policy, e[:n]).log_likelihood for e, n in rows])

    point, padded = np.asarray(THETA), demo.padded(ROWS, LENGTH)
    gradients = scores(mdp, HALF, THETA, padded)
    np.testing.assert_allclose(gradients[:4], derivative(log_likelihoods, point), atol=1e-7)
    hessian = derivative(lambda w: derivative(lambda v: log_likelihoods(v).sum(), w, 1e-3), point, 1e-3)
    np.testing.assert_allclose(observed_information(mdp, HALF, THETA, padded), -hessian, atol=1e-4)


def visits_of(mdp):
    """Compute the expected visits of each state in a trajectory."""
    policy = jnp.exp(_log_policy(mdp, THETA))
    return finite_occupancy(mdp, jnp.broadcast_to(policy, (LENGTH, *policy.shape))).sum((0, 2))


def test_expected_information_of_full_observation_is_the_complete_one(random_mdp):
    mdp = small(random_mdp(6))
    exact = complete_information(mdp, THETA, 20 * visits_of(mdp))
    simulated = expected_information(jax.random.key(0), mdp, CLEAR, THETA, 20, LENGTH, draws=ROWS)
    np.testing.assert_allclose(simulated, exact, atol=0.05 * np.abs(exact).max())


def test_occlusion_loses_information_but_not_the_information_equality(random_mdp):
    mdp = small(random_mdp(6))
    hidden = expected_information(jax.random.key(0), mdp, HALF, THETA, 1, LENGTH, draws=ROWS)
    shown = sample_demonstration(jax.random.key(1), TrajectoryLaw(mdp, THETA, HALF, LENGTH), ROWS)
    curvature = observed_information(mdp, HALF, THETA, shown) / ROWS
    np.testing.assert_allclose(hidden, curvature, atol=0.06 * np.abs(curvature).max())
    complete = complete_information(mdp, THETA, visits_of(mdp))
    assert np.linalg.eigvalsh(complete - hidden).min() > 0.05 * np.linalg.eigvalsh(complete).min()


def test_estimates_scatter_as_the_information_says(random_mdp):
    mdp = random_mdp(7, n_states=5)
    law = TrajectoryLaw(mdp, THETA, Sensor(), 10)
    codes = law.sample(jax.random.key(2), (200, 60)).reshape(200, -1, 3)
    counts = jax.vmap(lambda c: jnp.zeros((5, 3)).at[c[:, 1], c[:, 2]].add(1.0))(codes)
    estimates = jax.vmap(lambda n: fit_counts(mdp, n).weights)(counts)
    standardise = jax.vmap(
        lambda n, w: jnp.linalg.cholesky(complete_information(mdp, THETA, n.sum(1))).T @ (w - THETA)
    )
    z = np.asarray(standardise(counts, estimates))
    np.testing.assert_allclose(z.mean(0), 0, atol=0.2)
    np.testing.assert_allclose(np.cov(z.T), np.eye(2), atol=0.25)


# -- exactly unidentified -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_generic_features_are_identified(random_mdp, seed):
    mdp = random_mdp(seed, n_states=12, n_features=5, masked=seed % 2 == 0, starts=2, discount=0.95)
    assert unidentified_directions(with_features(mdp, mdp.features)) == ()


def planted(mdp, kind, rng):
    """One more feature that makes a direction of this kind, and that direction."""
    phi = np.asarray(mdp.features)
    if kind == "never active":
        return np.zeros(phi.shape[:2]), [0, 0, 0, 1]
    if kind == "duplicate":
        return 2.5 * phi[..., 1], [0, -2.5, 0, 1]
    if kind == "collinear":
        return phi[..., 0] - 0.5 * phi[..., 2], [-1, 0, 0.5, 1]
    if kind == "constant":
        return 3.0 - phi[..., 2], [0, 0, 1, 1]
    return shaping(mdp, rng.normal(size=mdp.n_states)) - phi[..., 0], [1, 0, 0, 1]


@pytest.mark.parametrize("kind", ["never active", "duplicate", "collinear", "constant", "potential shaping"])
@pytest.mark.parametrize("seed", range(4))
def test_a_planted_direction_is_found_and_named(random_mdp, kind, seed):
    mdp = random_mdp(seed, n_states=9, n_features=3, masked=seed % 2 == 0, starts=3)
    column, vector = planted(mdp, kind, np.random.default_rng(seed))
    mdp = extended(mdp, "planted", np.where(mdp.available, column, 0.0))
    (found,) = unidentified_directions(mdp)
    assert found.exact
    assert found.kind == kind
    np.testing.assert_allclose(abs(found.vector @ vector) / np.linalg.norm(vector), 1, atol=1e-9)
    assert "`planted`" in found.description
    assert_behaviour_unchanged(mdp, found, seed)


@pytest.mark.parametrize("seed", range(4))
def test_directions_planted_together_are_told_apart(random_mdp, seed):
    rng = np.random.default_rng(seed)
    mdp = random_mdp(seed, n_states=9, n_features=3)
    mdp = extended(mdp, "silent", np.zeros((9, 3)))
    mdp = extended(mdp, "copy", mdp.features[..., 1])
    mdp = extended(mdp, "alive", np.ones((9, 3)))
    mdp = extended(mdp, "lure", 1e4 * shaping(mdp, rng.normal(size=9)))
    found = {d.kind: d for d in unidentified_directions(mdp)}
    words = {kind: combination(mdp.feature_names, d.vector) for kind, d in found.items()}
    assert set(words) == {"never active", "duplicate", "constant", "potential shaping"}
    assert words["never active"] == "`silent`"
    assert set(words["duplicate"].split(" - ")) == {"`f1`", "`copy`"}
    assert words["constant"] == "`alive`"
    assert words["potential shaping"] == "`lure`"
    for direction in found.values():
        assert_behaviour_unchanged(mdp, direction, seed)


def test_directions_form_a_basis(random_mdp):
    mdp = random_mdp(1, n_states=9, n_features=3)
    mixing = np.random.default_rng(0).normal(size=(3, 7))
    mdp = with_features(mdp, np.asarray(mdp.features) @ mixing)
    found = unidentified_directions(mdp)
    assert len(found) == 4
    span = np.stack([d.vector for d in found])
    assert np.linalg.svd(span, compute_uv=False).min() > 1e-3
    np.testing.assert_allclose(mixing @ span.T, 0, atol=1e-8)


def two_rooms():
    """Left room {0, 1}, right room {2, 3}, a door from left to right only; both may be started in."""
    successors = np.array([[1, 2, 0], [0, 3, 1], [3, 2, 2], [2, 3, 3]])[..., None].repeat(2, axis=2)
    features = np.zeros((4, 3, 2))
    features[0, 0, 0] = 1  # left only
    features[2, 1, 1] = 1  # right only
    return small(TabularMDP.from_successors(successors, np.full((4, 3, 2), 0.5), features, discount=0.9))


def test_what_demonstrations_never_show_is_not_visited():
    mdp = two_rooms()
    assert unidentified_directions(mdp) == ()
    right = Demonstration.from_pairs(np.array([[2, 3, 2], [3, 2, 2]]), np.array([[0, 0, 1], [0, 1, 1]]))
    result = identifiability_of(mdp, CLEAR, right.padded(ROWS, LENGTH), THETA)
    assert [d.kind for d in result.exact] == ["not visited"]
    np.testing.assert_allclose(np.abs(result.exact[0].vector), [1, 0], atol=1e-12)
    assert "`f0`" in result.exact[0].description
    assert "2 states that the demonstrations never show, such as s0" in result.exact[0].description
    assert np.isinf(result.standard_errors[0])
    assert np.isfinite(result.standard_errors[1])
    assert "1 of 2 directions" in describe_identifiability(result)
    assert [row[2] == "not determined" for row in result.estimates.table("Weights.").rows] == [True, False]
    left = Demonstration.from_pairs(np.array([[0, 1, 0], [1, 3, 2]]), np.array([[0, 0, 1], [1, 0, 1]]))
    assert identifiability_of(mdp, CLEAR, left.padded(ROWS, LENGTH), THETA).exact == ()


def test_a_feature_of_unreachable_states_is_never_active():
    (found,) = unidentified_directions(replace(two_rooms(), initial=jnp.array([0.0, 0.0, 0.5, 0.5])))
    assert found.kind == "never active"
    assert "`f0` is zero for every state and action that can be reached" in found.description


def test_features_that_say_nothing_at_all(random_mdp):
    mdp = random_mdp(0)
    silent = unidentified_directions(with_features(mdp, np.zeros((4, 3, 2))))
    assert [d.kind for d in silent] == ["never active"] * 2
    ones = unidentified_directions(with_features(mdp, np.ones((4, 3, 2))))
    assert [d.kind for d in ones] == ["duplicate", "constant"]


def test_patrols():
    assert unidentified_directions(instance(1).mdp) == ()
    assert unidentified_directions(instance(2).mdp) == ()
    mdp = instance(3).mdp
    (found,) = unidentified_directions(mdp)
    assert found.kind == "potential shaping"
    assert all(f"`{name}`" in found.description for name in ("in a room", "enters a room", "leaves a room"))
    assert "56 states" in found.description  # the rooms
    assert_behaviour_unchanged(mdp, found)


@pytest.mark.parametrize("kind", ["never active", "duplicate", "constant", "potential shaping"])
def test_planted_in_patrol_2(kind):
    mdp = instance(2).mdp
    rng = np.random.default_rng(0)
    columns = {
        "never active": np.zeros(mdp.available.shape),
        "duplicate": mdp.features[..., 4],
        "constant": np.full(mdp.available.shape, 0.3),
        "potential shaping": shaping(mdp, rng.integers(0, 2, mdp.n_states).astype(float)),
    }
    (found,) = unidentified_directions(extended(mdp, "planted", columns[kind]))
    assert found.kind == kind
    assert "`planted`" in found.description


# -- what a demonstration determines ------------------------------------------------------------------


@pytest.fixture(scope="module")
def patrol_result():
    patrol = instance(2)
    demo = demonstrate(jax.random.key(1), patrol, 30, 60)[0]
    return patrol, demo, identifiability_of(patrol.mdp, patrol.visibility(30), demo)


def test_patrol_2_gives_no_false_alarm(patrol_result):
    patrol, _, result = patrol_result
    assert result.exact == ()
    for seed in range(3):
        for demo in demonstrate(jax.random.key(seed), patrol, 30, 60):
            other = identifiability_of(patrol.mdp, patrol.visibility(30), demo, result.weights)
            assert other.exact == ()
            assert np.isfinite(other.information).all()


def test_weak_directions_are_those_the_likelihood_hardly_bends_along(patrol_result):
    patrol, demo, result = patrol_result
    assert result.weak  # an expert who never errs leaves some
    basis = np.stack([d.vector for d in result.weak])
    for direction in result.weak:
        assert not direction.exact
        assert direction.standard_error > result.scale
        curvature = direction.vector @ result.information @ direction.vector
        np.testing.assert_allclose(direction.standard_error, curvature**-0.5)
    # Whatever is orthogonal to them is determined at least as well as the scale.
    rest = np.linalg.svd(basis)[2][len(basis) :]
    assert np.linalg.eigvalsh(rest @ result.information @ rest.T).min() >= result.scale**-2
    sensor, first = patrol.visibility(30), result.weak[0]
    total = lambda w: float(demonstration_log_likelihoods(patrol.mdp, sensor, w, demo).sum())  # noqa: E731
    moved = [result.weights + side * result.scale * first.vector for side in (1, -1)]
    np.testing.assert_allclose(first.loss, [total(result.weights) - total(w) for w in moved], atol=1e-8)
    np.testing.assert_allclose(
        result.length_loss[1], total(result.weights) - total(2 * result.weights), atol=1e-8
    )


def test_more_of_a_soft_expert_determines_more(random_mdp):
    mdp = small(random_mdp(8))
    shown = sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, THETA, HALF, LENGTH), 128)
    few = identifiability_of(mdp, HALF, shown.select([0]).padded(ROWS, LENGTH), THETA)
    many = identifiability_of(mdp, HALF, shown.padded(ROWS, LENGTH), THETA)
    assert few.weak
    assert many.weak == many.exact == few.exact == ()
    np.testing.assert_allclose(
        many.standard_errors, np.sqrt(np.diag(np.linalg.inv(many.information))), rtol=1e-8
    )


def test_what_is_not_determined_is_the_same_in_all_units(random_mdp):
    mdp, units = small(random_mdp(8)), np.array([1e-9, 1e6])
    other = with_features(mdp, np.asarray(mdp.features) * units)
    shown = sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, THETA, HALF, LENGTH), 2)
    plain, found = (
        identifiability_of(process, HALF, shown.padded(ROWS, LENGTH), weights)
        for process, weights in ((mdp, THETA), (other, THETA / units))
    )
    assert plain.weak
    np.testing.assert_allclose(found.standard_errors * units, plain.standard_errors, rtol=1e-6)
    np.testing.assert_allclose(found.length_loss, plain.length_loss, atol=1e-8)
    for a, b in zip(found.weak, plain.weak, strict=True):
        np.testing.assert_allclose(a.vector, b.vector, atol=1e-6)
        assert a.description == b.description


def test_nothing_seen_determines_nothing(random_mdp):
    mdp = small(random_mdp(8))
    demo = Demonstration.from_steps([["hidden"] * LENGTH] * 4, mdp).padded(ROWS, LENGTH)
    result = identifiability_of(mdp, Visibility(np.zeros(4, bool)), demo, THETA)
    assert result.exact == ()
    assert len(result.weak) == 2
    assert all(np.isinf(d.standard_error) or d.standard_error > 1e4 for d in result.weak)
    np.testing.assert_allclose([d.loss for d in result.weak], 0, atol=1e-10)


def test_readable(patrol_result):
    _, _, result = patrol_result
    text, table = describe_identifiability(result), directions_table(result)
    assert list(table["standard_error"]) == [d.standard_error for d in result.weak]
    assert all(d.description in text for d in result.weak)
    np.testing.assert_allclose(table[list(result.features)].to_numpy(), [d.vector for d in result.weak])
    section = identifiability_section({"patroller 0": result})
    (directions,) = section.tables
    assert [row[0] for row in directions.rows] == [d.kind for d in result.directions]
    assert "patroller 0" in directions.caption
    assert [x["weight"] for x in result.estimates.summary()] == result.weights.tolist()


def test_words():
    names = ("moves", "turns", "stops")
    assert combination(names, np.array([0.5, 0.25, 0.0])) == "`moves` + 0.5 `turns`"
    assert combination(names, np.array([0.1, 0.0, -1.0])) == "-0.1 `moves` + `stops`"
    assert combination(names, np.array([0.01, 1.0, 0.0]), least=0.1) == "`turns`"


def test_errors(random_mdp):
    mdp = random_mdp(0)
    demo = Demonstration.from_pairs(np.array([[0]]), np.array([[0]]))
    examine = partial(identifiability_of, mdp, Sensor())
    with pytest.raises(ValueError, match="must have steps"):
        examine(Demonstration.from_pairs(np.zeros((0, 2)), np.zeros((0, 2))))
    with pytest.raises(ValueError, match="scale must be positive, got 0"):
        examine(demo, scale=0.0)
    with pytest.raises(ValueError, match="weights must be 2 numbers"):
        examine(demo, jnp.ones(3))
    with pytest.raises(ValueError, match="weights must be 2 numbers"):
        examine(demo, jnp.array([1.0, np.nan]))
    with pytest.raises(ValueError, match="shown must mark at least one of 4 states"):
        unidentified_directions(mdp, np.zeros(4, bool))
    with pytest.raises(ValueError, match="finite horizon"):
        unidentified_directions(replace(mdp, discount=jnp.array(1.0)))
