"""Decision processes: what is accepted, what is refused and how, and the two directions of the dynamics."""

from __future__ import annotations

import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from i2rl.models import TabularMDP
from i2rl.models.process.mdp import Labels


def ring(n=5, **changes):
    """Two actions that move around a ring, each slipping with probability 0.1."""
    here = np.arange(n)[:, None, None]
    arguments = {
        "successors": (here + np.array([[1, 0], [-1, 0]])) % n,
        "probabilities": np.broadcast_to([0.9, 0.1], (n, 2, 2)).copy(),
        "features": np.linspace(0, 1, n * 4).reshape(n, 2, 2),
    } | changes
    return TabularMDP.from_successors(**arguments)


def changed(array, index, value):
    array = np.array(array, dtype=np.result_type(array, type(value)))
    array[index] = value
    return array


GOOD = ring()
PROBABILITIES, FEATURES, SUCCESSORS = (
    np.asarray(x) for x in (GOOD.probabilities, GOOD.features, GOOD.successors)
)
LETTERS = tuple("abcde")

REFUSED = {
    "not one sum": (
        {"probabilities": changed(PROBABILITIES, (3, 1, 0), 0.8), "states": LETTERS},
        r"must sum to 1; those of state 'd' \(3\), action 1 sum to 0\.9",
    ),
    "negative": (
        {"probabilities": changed(PROBABILITIES, (2, 0), [1.1, -0.1])},
        r"probability of state 2, action 0 is negative: -0\.1",
    ),
    "NaN": (
        {"probabilities": changed(PROBABILITIES, (4, 1, 1), np.nan), "actions": ("left", "right")},
        r"probability of state 4, action 'right' \(1\) is not a number",
    ),
    "infinite": (
        {"probabilities": changed(PROBABILITIES, (4, 1, 1), np.inf)},
        r"probability of state 4, action 1 is not a number",
    ),
    "successor beyond the states": (
        {"successors": changed(SUCCESSORS, (1, 0, 0), 5)},
        r"state 1, action 0 leads to state 5, but states are 0 to 4",
    ),
    "negative successor": ({"successors": changed(SUCCESSORS, (1, 0, 0), -1)}, r"leads to state -1"),
    "fractional successor": ({"successors": SUCCESSORS + 0.5}, r"successors must be integers.*float64"),
    "shapes of transitions": (
        {"successors": SUCCESSORS[:, :, :1]},
        r"one shape \[S, A, B\], got \(5, 2, 1\) and \(5, 2, 2\)",
    ),
    "no states": (
        {"successors": np.zeros((0, 2, 2), int), "probabilities": np.zeros((0, 2, 2))},
        r"at least one state, action and successor",
    ),
    "state without action": (
        {"available": changed(np.ones((5, 2), bool), 3, False), "states": LETTERS},
        r"state 'd' \(3\) has no available action",
    ),
    "mask of another shape": (
        {"available": np.ones((5, 3), bool)},
        r"available must be a boolean array \[5, 2\]",
    ),
    "mask of numbers": ({"available": np.ones((5, 2))}, r"available must be a boolean array.*got float64"),
    "discount zero": ({"discount": 0.0}, r"discount must lie in \(0, 1\], got 0\.0"),
    "discount above one": ({"discount": 1.01}, r"discount must lie in \(0, 1\], got 1\.01"),
    "discount NaN": ({"discount": np.nan}, r"discount must lie in \(0, 1\], got nan"),
    "feature NaN": (
        {"features": changed(FEATURES, (2, 1, 1), np.nan), "feature_names": ("near", "far")},
        r"feature 'far' \(1\) of state 2, action 1 is nan, not a number",
    ),
    "feature infinite": (
        {"features": changed(FEATURES, (2, 1, 0), np.inf)},
        r"feature 0 of state 2, action 1 is inf",
    ),
    "features of another shape": ({"features": FEATURES[:4]}, r"features must have shape .*got \(4, 2, 2\)"),
    "features without a last axis": ({"features": FEATURES[..., 0]}, r"features must have shape"),
    "no features": ({"features": FEATURES[..., :0]}, r"K >= 1\], got \(5, 2, 0\)"),
    "too few names": ({"states": LETTERS[:4]}, r"4 state names were given for 5 states"),
    "too many names": ({"actions": LETTERS}, r"5 action names were given for 2 actions"),
    "repeated names": ({"states": ("a", "b", "a", "d", "d")}, r"state names must differ; repeated: 'a', 'd'"),
    "repeated numbers for names": ({"actions": (1, "1")}, r"action names must differ; repeated: '1'"),
    "repeated feature names": ({"feature_names": ("x", "x")}, r"feature names must differ; repeated: 'x'"),
    "start of another length": ({"initial": np.ones(4) / 4}, r"initial must have shape \[5\], got \(4,\)"),
    "start not summing to one": ({"initial": np.ones(5)}, r"initial must be a distribution.*its sum 5\.0"),
    "negative start": ({"initial": np.array([1.5, -0.5, 0, 0, 0])}, r"initial .*its least value is -0\.5"),
    "start NaN": ({"initial": np.full(5, np.nan)}, r"initial must be a distribution"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_refused_in_the_users_terms(case):
    changes, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        ring(**changes)


def test_finite_features_outside_the_unit_interval_are_allowed():
    assert ring(features=FEATURES * 10 - 5).features.min() == -5


def test_numbers_of_unavailable_pairs_do_not_matter():
    available = changed(np.ones((5, 2), bool), (1, 0), False)
    mdp = ring(
        available=available,
        probabilities=changed(PROBABILITIES, (1, 0), np.nan),
        features=changed(FEATURES, (1, 0), np.nan),
        successors=changed(SUCCESSORS, (1, 0), 99),
    )
    assert mdp.probabilities[1, 0].sum() == 0
    assert mdp.features[1, 0].sum() == 0
    assert mdp.successors.max() < 5


def test_dense_and_sparse_transitions_describe_the_same_process(random_mdp, dense_transitions):
    mdp = random_mdp(0, masked=True)
    dense = dense_transitions(mdp)
    options = {
        "initial": np.asarray(mdp.initial),
        "discount": 0.9,
        "available": np.asarray(mdp.available),
    }
    features = np.asarray(mdp.features)
    built = [
        TabularMDP.from_dense(dense, features, **options),
        TabularMDP.from_sparse(sparse.coo_matrix(dense.reshape(-1, 4)), features, **options),
        TabularMDP.from_sparse([sparse.csr_array(dense[:, a]) for a in range(3)], features, **options),
    ]
    for other in built:
        np.testing.assert_allclose(dense_transitions(other), dense)
    assert len({other.fingerprint() for other in built}) == 1


def test_duplicate_sparse_entries_add_up_and_the_callers_matrix_is_left_alone():
    rows, columns = np.array([0, 0, 0, 1]), np.array([1, 0, 1, 1])
    matrix = sparse.csr_matrix((2, 2))
    matrix.indptr, matrix.indices = np.array([0, 3, 4]), columns.copy()
    matrix.data = np.array([0.3, 0.4, 0.3, 1.0])
    mdp = TabularMDP.from_sparse(matrix, np.zeros((2, 1, 1)))
    np.testing.assert_allclose(mdp.transition_probability(1)[:, 0], [0.6, 1])
    np.testing.assert_array_equal(matrix.indices, columns)
    assert matrix.nnz == len(rows)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: TabularMDP.from_dense(np.ones((2, 3)), np.zeros((2, 3, 1))), r"\[S, A, S\], got \(2, 3\)"),
        (lambda: TabularMDP.from_dense(np.ones((2, 1, 3)), np.zeros((2, 1, 1))), r"\[S, A, S\]"),
        (lambda: TabularMDP.from_sparse(sparse.eye_array(3, 2), np.zeros((2, 1, 1))), r"\[S \* A, S\]"),
        (lambda: TabularMDP.from_sparse([], np.zeros((2, 1, 1))), r"at least one action's matrix"),
        (
            lambda: TabularMDP.from_sparse([sparse.eye_array(2), sparse.eye_array(3)], np.zeros((2, 2, 1))),
            r"each action's matrix must be \[S, S\]",
        ),
    ],
)
def test_transitions_of_the_wrong_shape_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("gathered", [True, False], ids=["inflow table", "scatter"])
def test_expecting_and_pushing_forward_are_each_others_transpose(gathered, random_mdp, dense_transitions):
    mdp = random_mdp(1, masked=True)
    if not gathered:
        # Every transition of a large process leads to one sink: too uneven for an inflow table.
        moves = np.zeros((40, 1, 40))
        moves[:, :, 0] = 1
        mdp = TabularMDP.from_dense(moves, np.zeros((40, 1, 1)))
    assert (mdp.inflow_pairs is not None) is gathered
    dense, rng = dense_transitions(mdp), np.random.default_rng(0)
    values, pairs = rng.normal(size=mdp.n_states), rng.normal(size=(mdp.n_states, mdp.n_actions))
    np.testing.assert_allclose(mdp.expect_next(jnp.asarray(values)), dense @ values, atol=1e-14)
    pushed = mdp.push_forward(jnp.asarray(pairs))
    np.testing.assert_allclose(pushed, np.einsum("sa,sat->t", pairs, dense), atol=1e-14)
    for s in range(mdp.n_states):
        np.testing.assert_allclose(mdp.transition_probability(s), dense[:, :, s], atol=1e-14)
    policy = np.abs(pairs)
    chain = np.einsum("sa,sat->st", policy, dense)
    np.testing.assert_allclose(mdp.state_transitions(jnp.asarray(policy)), chain, atol=1e-14)


def test_names_default_to_numbered_ones():
    assert ring().state_names == ("s0", "s1", "s2", "s3", "s4")
    assert ring().action_names == ("a0", "a1")
    assert ring().feature_names == ("f0", "f1")
    named = ring(states=LETTERS, actions=("left", "right"), feature_names=("near", "far"))
    assert (named.state_names, named.action_names, named.feature_names) == (
        LETTERS,
        ("left", "right"),
        ("near", "far"),
    )


def test_every_part_of_an_mdp_enters_its_fingerprint():
    variants = [
        {},
        {"discount": 0.9},
        {"states": LETTERS},
        {"initial": np.eye(5)[0]},
        {"features": FEATURES[::-1]},
        {"successors": (SUCCESSORS + 1) % 5},
        {"probabilities": PROBABILITIES[..., ::-1]},
        {"available": changed(np.ones((5, 2), bool), (0, 0), False)},
    ]
    assert ring().fingerprint() == ring().fingerprint()
    assert len({ring(**changes).fingerprint() for changes in variants}) == len(variants)


def test_an_mdp_is_compared_by_identity_and_can_be_a_key():
    one, two = ring(), ring()
    assert one != two
    assert len({one, two, one}) == 2


def test_an_mdp_passes_through_transformations():
    mdp = ring(states=LETTERS)
    values = jnp.arange(5.0)
    compiled = jax.jit(lambda m, v: (m, m.expect_next(v)))
    returned, expected = compiled(mdp, values)
    assert returned.fingerprint() == mdp.fingerprint()
    np.testing.assert_allclose(expected, mdp.expect_next(values))
    starts = jnp.eye(5)
    batch = jax.vmap(lambda p: mdp.with_initial(p).initial)(starts)
    np.testing.assert_array_equal(batch, starts)


def test_compiled_functions_recognise_equal_names():
    traces = []

    @jax.jit
    def total(mdp):
        traces.append(None)
        return mdp.features.sum()

    total(ring(states=LETTERS))
    total(ring(states=LETTERS))
    assert len(traces) == 1
    total(ring(states=tuple("vwxyz")))
    assert len(traces) == 2


def test_names_stay_equal_in_another_process():
    labels = Labels(states=LETTERS)
    script = (
        "import pickle, sys; from i2rl.models.process.mdp import Labels;"
        "sys.stdout.buffer.write(pickle.dumps(Labels(states=tuple('abcde'))))"
    )
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout
    assert pickle.loads(other) == labels
    assert hash(pickle.loads(other)) == hash(labels)
    assert (
        pickle.loads(pickle.dumps(ring(states=LETTERS))).fingerprint() == ring(states=LETTERS).fingerprint()
    )


@given(seed=st.integers(0, 1000), masked=st.booleans())
def test_mass_is_conserved(seed, masked, random_mdp):
    mdp = random_mdp(seed, masked=masked)
    mass = np.where(mdp.available, np.random.default_rng(seed).random(mdp.available.shape), 0.0)
    np.testing.assert_allclose(mdp.push_forward(jnp.asarray(mass)).sum(), mass.sum())
    ones = np.asarray(mdp.expect_next(jnp.ones(mdp.n_states)))
    np.testing.assert_allclose(ones, np.asarray(mdp.available).astype(float))
