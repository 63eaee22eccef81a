"""Feature sets compared by leave-one-out cross-validation."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from i2rl.analysis.benchmarks.statistics.selection import RIVALS, feature_sets
from i2rl.analysis.posteriors.selection import (
    compare_features,
    compare_posteriors,
    select_features,
    with_features,
)
from i2rl.domains import instance
from i2rl.models import Demonstration, TabularMDP, TrajectoryLaw, Visibility, sample_demonstration
from i2rl.models.observation.demonstration import LOST, PAD

OPTIONS = {"draws": 300, "warmup": 150, "chains": 2}
LENGTH = 5


@pytest.fixture(scope="module")
def ring():
    """Six states; what matters is being at home; whether the step turned back does not."""
    state = np.arange(6)
    successors = np.stack([np.stack([(state + m) % 6, state], 1) for m in (1, -1)], 1)
    features = np.zeros((6, 2, 2))
    features[0, :, 0] = 1
    features[:, 1, 1] = 1
    return TabularMDP.from_successors(
        successors,
        np.broadcast_to([0.8, 0.2], (6, 2, 2)),
        features,
        discount=0.8,
        states=[f"cell {s}" for s in state],
        actions=("clockwise", "counterclockwise"),
        feature_names=("home", "turned"),
    )


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([True, True, True, True, False, False]))


@pytest.fixture(scope="module")
def sets(ring):
    wrong = np.zeros((6, 2, 1))
    wrong[4] = 1
    return {
        "home": select_features(ring, ["home"]),
        "turned": select_features(ring, ["turned"]),
        "elsewhere": with_features(ring, wrong, ("elsewhere",)),
    }


@pytest.fixture(scope="module")
def demonstration(ring, sensor):
    law = TrajectoryLaw(ring, jnp.array([2.5, 0.0]), sensor, LENGTH)
    return sample_demonstration(jax.random.key(4), law, 20)


@pytest.fixture(scope="module")
def comparison(sets, sensor, demonstration):
    return compare_features(jax.random.key(0), sets, sensor, demonstration, **OPTIONS)


def left_out(mdp, sensor, demonstration):
    """Exact log predictive density of each trajectory given the others, one weight integrated on a grid."""
    grid = np.linspace(-12, 12, 481)
    density = jax.vmap(lambda w: TrajectoryLaw(mdp, w[None], sensor, LENGTH).log_prob(demonstration.codes))
    each = np.asarray(density(jnp.asarray(grid)))
    prior = norm.logpdf(grid, scale=2.5)[:, None]
    others = prior + each.sum(1, keepdims=True) - each
    return logsumexp(others + each, axis=0) - logsumexp(others, axis=0)


def test_ranks_and_differences_are_those_of_exact_cross_validation(comparison, sets, sensor, demonstration):
    exact = {name: left_out(mdp, sensor, demonstration) for name, mdp in sets.items()}
    total = {name: values.sum() for name, values in exact.items()}
    table = comparison.table
    assert list(table.index) == sorted(total, key=total.get, reverse=True)
    assert comparison.best == table.index[0] == "home"
    for name in sets:
        assert table.loc[name, "elpd_loo"] == pytest.approx(total[name], abs=0.3)
        difference = exact["home"] - exact[name]
        assert table.loc[name, "elpd_diff"] == pytest.approx(difference.sum(), abs=0.3)
        assert table.loc[name, "dse"] == pytest.approx(difference.std() * np.sqrt(20), abs=0.2)


def test_reliability_is_reported(comparison, sets):
    k = comparison.pareto_k
    assert set(k.index) == set(sets)
    assert ((k["share_above"] >= 0) & (k["share_above"] <= 1)).all()
    assert ((k["largest"] > 0.7) == (k["share_above"] > 0)).all()
    assert all(
        posterior["posterior"].sizes["feature"] == 1 and "completions" not in posterior.groups()
        for posterior in comparison.posteriors.values()
    )


def test_trajectories_that_say_nothing_are_left_out(comparison, sets, sensor, demonstration):
    nothing = np.full((2, LENGTH, 3), -1)
    nothing[0, :, 0], nothing[1, :, 0] = LOST, PAD
    longer = Demonstration.from_codes(np.concatenate([nothing, demonstration.codes]))
    found = compare_features(jax.random.key(0), sets, sensor, longer, **OPTIONS)
    for name, posterior in found.posteriors.items():
        same = comparison.posteriors[name]
        np.testing.assert_array_equal(posterior["posterior"]["weights"], same["posterior"]["weights"])
    assert found.table["elpd_loo"].equals(comparison.table["elpd_loo"])
    few = Demonstration.from_codes(longer.codes[:3])
    with pytest.raises(ValueError, match="at least two trajectories that say something, got 1"):
        compare_features(jax.random.key(0), sets, sensor, few, **OPTIONS)


def test_posteriors_that_do_not_compare(comparison):
    posteriors = comparison.posteriors
    with pytest.raises(ValueError, match="at least two feature sets, got 1"):
        compare_posteriors({"home": posteriors["home"]})
    bare = posteriors["home"].copy()
    del bare.log_likelihood
    with pytest.raises(ValueError, match="posterior 'bare' has no log-likelihood"):
        compare_posteriors({"home": posteriors["home"], "bare": bare})
    fewer = posteriors["turned"].isel(trajectory=slice(0, 7))
    with pytest.raises(ValueError, match="posterior 'fewer' is of 7 trajectories, 'home' of 20"):
        compare_posteriors({"home": posteriors["home"], "fewer": fewer})
    other = posteriors["turned"].copy()
    other.observed_data["state"][0, 0] += 1
    with pytest.raises(ValueError, match="'home' and 'other' are of different demonstrations"):
        compare_posteriors({"home": posteriors["home"], "other": other})


def test_processes_that_do_not_compare(ring, sets, sensor, demonstration):
    def compare(**mdps):
        compare_features(jax.random.key(0), mdps, sensor, demonstration)

    with pytest.raises(ValueError, match="at least two feature sets, got 1"):
        compare(home=ring)
    with pytest.raises(ValueError, match="'a' and 'b' differ in more than features: discount"):
        compare(a=ring, b=replace(sets["home"], discount=jnp.array(0.9)))
    with pytest.raises(ValueError, match="probabilities"):
        compare(a=ring, b=ring.with_probabilities(ring.probabilities[..., ::-1]))
    renamed = replace(ring, labels=replace(ring.labels, actions=("on", "turn")))
    with pytest.raises(ValueError, match="action names"):
        compare(a=ring, b=renamed)


def test_selected_features_are_the_same_numbers(ring):
    both = select_features(ring, ["turned", "home"])
    assert both.feature_names == ("turned", "home")
    np.testing.assert_array_equal(both.features, ring.features[..., ::-1])
    again = with_features(ring, np.asarray(ring.features), ring.feature_names)
    assert again.fingerprint() == ring.fingerprint()
    with pytest.raises(ValueError, match="unknown feature 'away'; known are 'home', 'turned'"):
        select_features(ring, ["away"])
    with pytest.raises(ValueError, match="must differ"):
        select_features(ring, ["home", "home"])
    with pytest.raises(ValueError, match="at least one feature"):
        select_features(ring, [])
    with pytest.raises(ValueError, match="features must have shape"):
        with_features(ring, np.zeros((6, 1, 1)))


def test_the_sets_of_the_benchmark():
    patrol = instance(2)
    sets = feature_sets(patrol)
    assert {name: mdp.n_features for name, mdp in sets.items()} == {
        "six": 6,
        "without moves": 5,
        "turns anywhere": 2,
        "without division 2": 5,
    }
    assert set(RIVALS) < set(sets)
    dropped = set(patrol.mdp.feature_names) - set(sets["without moves"].feature_names)
    assert [float(patrol.weights[patrol.mdp.feature_names.index(n)]) for n in dropped] == [
        max(patrol.weights)
    ]
    # Turning anywhere is turning: exactly the pairs that turn the heading.
    headings = np.array([state.heading for state in patrol.states])
    turned = headings[np.asarray(patrol.mdp.successors)[..., 0]] != headings[:, None]
    np.testing.assert_array_equal(sets["turns anywhere"].features[..., 1] == 1, turned)
