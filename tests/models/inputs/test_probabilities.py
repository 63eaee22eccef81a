"""Probabilities in finite precision: what sums to one, and what normalisation leaves alone."""

from __future__ import annotations

import doctest

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from i2rl.models import TabularMDP
from i2rl.models.inputs import probabilities
from i2rl.models.inputs.probabilities import normalised, sum_tolerance

SHORT = (np.float16, np.float32, jnp.bfloat16)


def random_rows(seed, size, n=20):
    return np.random.default_rng(seed).dirichlet(np.full(size, 0.7), n)


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 300), axis=st.sampled_from([-1, 0, (0, 1)]))
def test_normalising_again_changes_no_bit(seed, size, axis):
    rough = random_rows(seed, size) * np.random.default_rng(seed).uniform(0.5, 2, (20, 1))
    once = normalised(rough, axis)
    np.testing.assert_allclose(once.sum(axis), 1, atol=1e-13)
    assert normalised(once, axis).tobytes() == once.tobytes()


def test_what_sums_to_one_within_rounding_keeps_its_bits():
    for p in ([0.6, 0.3, 0.1], [1 / 6] * 6, [0.1] * 10, [1.0], [0.0, 0.0]):
        assert normalised(np.array(p)).tobytes() == np.array(p).tobytes()
    assert abs(normalised(np.array([0.5, 0.5 + 1e-12])).sum() - 1) < 3e-16


@pytest.mark.parametrize("kind", SHORT, ids=lambda kind: np.dtype(kind).name)
@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 400))
def test_rows_rounded_to_their_type_are_within_its_tolerance(kind, seed, size):
    rows = random_rows(seed, size).astype(kind)
    assert np.abs(rows.astype(float).sum(-1) - 1).max() <= sum_tolerance(kind, size)


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 400))
def test_float32_rows_divided_by_a_sum_taken_one_by_one_are_within_tolerance(seed, size):
    rows = (10 * random_rows(seed, size)).astype(np.float32)
    rows /= np.cumsum(rows, -1, dtype=np.float32)[:, -1:]
    assert np.abs(rows.astype(float).sum(-1) - 1).max() <= sum_tolerance(np.float32, size)


def test_tolerance_is_that_of_the_type():
    assert sum_tolerance(float, 10**6) == sum_tolerance(int, 5) == sum_tolerance(bool, 5) == 1e-8
    assert 4.7e-7 < sum_tolerance(np.float32, 1) < sum_tolerance(np.float32, 10**6) < 5e-4
    assert sum_tolerance(np.float16, 10**9) == 0.01


def mdp_of(transitions, **options):
    size = transitions.shape[0]
    return TabularMDP.from_dense(transitions, np.zeros((size, transitions.shape[1], 1)), **options)


@pytest.mark.parametrize("kind", SHORT, ids=lambda kind: np.dtype(kind).name)
def test_processes_in_short_floats_are_accepted_and_sum_to_one(kind):
    for seed in range(20):
        rows = random_rows(seed, 5, 10).reshape(5, 2, 5).astype(kind)
        mdp = mdp_of(rows, initial=random_rows(seed, 5, 1)[0].astype(kind))
        np.testing.assert_allclose(mdp.probabilities.sum(-1), 1, atol=1e-15)
        np.testing.assert_allclose(mdp.initial.sum(), 1, atol=1e-15)
        first = mdp.state_transitions(jnp.eye(2)[np.zeros(5, int)])
        np.testing.assert_allclose(first, rows[:, 0].astype(float), rtol=0.02)


def test_sparse_and_jax_float32_are_accepted():
    rows = random_rows(0, 4, 8).astype(np.float32)
    dense = mdp_of(jnp.asarray(rows.reshape(4, 2, 4)))
    assert TabularMDP.from_sparse(sparse.csr_array(rows), dense.features).fingerprint() == dense.fingerprint()


@pytest.mark.parametrize("kind", [np.float32, float])
def test_float32_is_no_excuse_for_a_thousandth(kind):
    rows = random_rows(1, 4, 8).reshape(4, 2, 4).astype(kind)
    rows[2, 1] *= 0.999
    with pytest.raises(ValueError, match=r"must sum to 1; those of state 2, action 1 sum to 0\.99[89]"):
        mdp_of(rows)
    with pytest.raises(ValueError, match="initial must be a distribution"):
        mdp_of(np.eye(4)[:, None], initial=np.array([0.3, 0.3, 0.3, 0.099], kind))


def test_64_bit_transitions_keep_their_bits_and_their_digest():
    rows = np.array([[[1 / 3 + 1e-9, 2 / 3]], [[0.0, 1.0]]])
    assert np.asarray(mdp_of(rows).probabilities)[0, 0].tobytes() == rows[0, 0].tobytes()


@pytest.mark.parametrize("part", ["probabilities", "features", "initial"])
def test_complex_numbers_are_refused(part):
    arrays = {"probabilities": np.ones((2, 1, 1)), "features": np.ones((2, 1, 1)), "initial": np.full(2, 0.5)}
    arrays[part] = arrays[part] + 0j
    with pytest.raises(ValueError, match=f"{part} must be real numbers; got complex128"):
        TabularMDP.from_successors(np.zeros((2, 1, 1), int), **arrays)


def test_the_examples_run():
    assert doctest.testmod(probabilities).failed == 0
