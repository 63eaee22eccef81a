"""Entropic proportions: against grids, another solver, and what must hold whatever the counts."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from i2rl.inference.programs.entropic import entropic_objective, entropic_proportions

N_COMPONENTS = 4
solve = jax.jit(entropic_proportions)
objective = jax.jit(entropic_objective)
objectives = jax.jit(jax.vmap(entropic_objective, in_axes=(0, None, None)))

counts_of_four = st.lists(
    st.one_of(st.just(0.0), st.floats(1e-3, 50.0)), min_size=N_COMPONENTS, max_size=N_COMPONENTS
).filter(any)
strengths = st.one_of(st.just(0.0), st.floats(1e-3, 100.0))


def simplex_grid(n_components, steps):
    bars = np.array(list(combinations(range(steps + n_components - 1), n_components - 1)))
    edges = np.pad(bars, ((0, 0), (1, 1)), constant_values=(-1, steps + n_components - 1))
    return (np.diff(edges, axis=1) - 1) / steps


GRIDS = {2: simplex_grid(2, 4000), 3: simplex_grid(3, 200), 4: simplex_grid(4, 40)}


def random_problem(rng):
    """Draw counts far above, around and far below the strength; equal, nearly equal, or not at all."""
    n_components = int(rng.integers(2, 5))
    counts = rng.gamma(rng.choice([0.2, 1.0, 5.0]), 1.0, n_components)
    if rng.random() < 0.5:
        spread = rng.choice([0.0, 1e-6, 1e-3, 1e-2, 0.1])
        counts = counts[0] * (1 + spread * rng.random(n_components))
    near = counts.sum() * (1 + 0.3 * rng.standard_normal())
    strength = abs(near) if rng.random() < 0.5 else rng.gamma(1.0, rng.choice([0.3, 3.0, 30.0]))
    return counts, strength


def test_no_point_of_a_grid_is_better():
    rng = np.random.default_rng(0)
    not_concave = 0
    for _ in range(150):
        counts, strength = random_problem(rng)
        found = solve(counts, strength)
        grid = np.asarray(objectives(GRIDS[len(counts)], counts, strength))
        assert float(objective(found, counts, strength)) >= grid.max() - 1e-12
        not_concave += counts.min() < strength
    assert not_concave > 30


def test_the_optimum_is_that_of_a_general_solver():
    rng = np.random.default_rng(1)
    for _ in range(20):
        counts, strength = rng.uniform(2.0, 10.0, 4), rng.uniform(0.1, 2.0)
        loss = jax.value_and_grad(lambda p, n=counts, s=strength: -entropic_objective(p, n, s))
        optimum = minimize(
            lambda p, loss=loss: tuple(np.asarray(part) for part in loss(jnp.asarray(p))),
            np.full(4, 0.25),
            jac=True,
            method="SLSQP",
            bounds=[(1e-9, 1.0)] * 4,
            constraints={"type": "eq", "fun": lambda p: p.sum() - 1, "jac": np.ones_like},
            options={"ftol": 1e-15, "maxiter": 500},
        )
        assert optimum.success
        np.testing.assert_allclose(solve(counts, strength), optimum.x, atol=1e-6)
        assert float(objective(solve(counts, strength), counts, strength)) >= -optimum.fun - 1e-10


@given(counts_of_four, strengths)
def test_proportions_are_a_stationary_point_of_second_order(counts, strength):
    counts = np.array(counts)
    found = np.asarray(solve(counts, strength))
    assert abs(found.sum() - 1) < 1e-12
    assert ((counts == 0) <= (found == 0)).all()
    inside = found > 0
    multipliers = counts[inside] / found[inside] + strength * np.log(found[inside])
    np.testing.assert_allclose(multipliers, multipliers[0], rtol=1e-8, atol=1e-8 * counts.sum())
    curvature = strength / found[inside] - counts[inside] / found[inside] ** 2
    tangent = np.linalg.qr(np.column_stack([np.ones(inside.sum()), np.eye(inside.sum())]))[0][:, 1:]
    reduced = tangent.T @ (curvature[:, None] * tangent)
    assert np.linalg.eigvalsh(reduced).max(initial=-1.0) <= 1e-6 * np.abs(curvature).max()


@given(counts_of_four, strengths)
def test_proportions_keep_the_order_and_are_sharper_than_the_shares(counts, strength):
    counts = np.array(counts)
    order = np.argsort(-counts, kind="stable")
    found, share = np.asarray(solve(counts, strength))[order], counts[order] / counts.sum()
    assert (np.diff(found) <= 1e-12).all()
    # Majorisation, of which lower entropy is a consequence.
    assert (np.cumsum(found) >= np.cumsum(share) - 1e-12).all()


@given(counts_of_four, strengths, st.permutations(range(N_COMPONENTS)))
def test_the_order_of_components_does_not_matter(counts, strength, order):
    counts, order = np.array(counts), list(order)
    assume((counts == counts.max()).sum() == 1)
    np.testing.assert_allclose(
        solve(counts[order], strength), np.asarray(solve(counts, strength))[order], atol=1e-9
    )


@given(st.floats(1e-6, 1e3), strengths)
def test_the_only_component_gets_everything(count, strength):
    found = solve(np.array([0.0, count, 0.0, 0.0]), strength)
    np.testing.assert_allclose(found, [0, 1, 0, 0], rtol=1e-15)


def test_two_components_by_hand():
    # With n = (3, 2) and pi = (p, 1 - p): 3/p - 2/(1 - p) + log(p / (1 - p)) = 0.
    p = float(solve(np.array([3.0, 2.0]), 1.0)[0])
    assert abs(3 / p - 2 / (1 - p) + np.log(p / (1 - p))) < 1e-10
    np.testing.assert_allclose(solve(np.array([3.0, 2.0]), 0.0), [0.6, 0.4], atol=1e-15)


def test_a_strong_prior_leaves_a_symmetric_compromise():
    counts = np.full(3, 1 / 3)
    found = np.asarray(solve(counts, 1.0))
    assert found[0] > 0.5
    assert found[1] == pytest.approx(found[2])
    np.testing.assert_allclose(solve(counts, 0.5), counts, atol=1e-9)


def test_vanishing_counts_and_extreme_strengths_stay_finite():
    np.testing.assert_array_equal(solve(np.zeros(3), 1.0), np.full(3, 1 / 3))
    for counts in ([1e-300, 1.0, 0.0], [1e-12, 2e-12, 1e-12], [1e8, 1.0, 1e-8]):
        for strength in (0.0, 1e-20, 1e-10, 1.0, 1e8):
            found = np.asarray(solve(np.array(counts), strength))
            assert abs(found.sum() - 1) < 1e-12
            assert (found >= 0).all()
    # Where n_1 and n_2 vanish, n_2 / pi_2 + log pi_2 = 0.
    tiny = float(solve(np.array([2e-12, 1e-12]), 1.0)[1])
    assert 1e-12 / tiny == pytest.approx(-np.log(tiny), rel=1e-6)


def test_many_problems_at_once_are_solved_as_each_alone():
    rng = np.random.default_rng(2)
    counts, strength = rng.gamma(1.0, 3.0, (7, 4)), rng.gamma(1.0, 2.0, 7)
    together = jax.jit(jax.vmap(entropic_proportions))(counts, strength)
    np.testing.assert_allclose(together, [solve(n, s) for n, s in zip(counts, strength, strict=True)])
    _, scanned = jax.lax.scan(lambda c, p: (c, entropic_proportions(*p)), 0, (counts, strength))
    np.testing.assert_allclose(scanned, together)


@pytest.mark.parametrize(
    ("counts", "strength", "named"),
    [
        ([1.0, -1.0], 1.0, "counts"),
        ([1.0, np.nan], 1.0, "counts"),
        ([1.0], -1.0, "strength"),
        ([[1.0]], 1.0, "shapes"),
        ([], 1.0, "shapes"),
    ],
)
def test_bad_arguments_are_named(counts, strength, named):
    with pytest.raises(ValueError, match=named):
        entropic_proportions(np.array(counts), strength)
