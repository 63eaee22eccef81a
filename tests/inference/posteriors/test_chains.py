"""Chains of NUTS on densities that are known in closed form."""

import time

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer import NUTS

from i2rl.inference.posteriors.chains import in_threads, mode_of, run_nuts

MEAN = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, -0.5], [0.0, -0.5, 0.5]])
PRECISION = np.linalg.inv(COVARIANCE)
CHAINS, DRAWS = 2, 1500


def potential(x):
    return (x - MEAN) @ PRECISION @ (x - MEAN) / 2


@jax.jit
def chain(key):
    kernel = NUTS(potential_fn=potential, step_size=0.1, dense_mass=True)
    shifted = lambda z: {"x": z, "product": z[0] * z[1]}  # noqa: E731
    return run_nuts(key, kernel, jnp.full(3, 8.0), shifted, 300, DRAWS)


@pytest.fixture(scope="module")
def chains():
    return in_threads(chain, [(key,) for key in jax.random.split(jax.random.key(1), CHAINS)])


def test_draws_have_the_moments_of_the_gaussian(chains):
    drawn, transitions = chains
    assert drawn["x"].shape == (CHAINS, DRAWS, 3)
    assert not transitions.diverging.any()
    centred = drawn["x"] - MEAN
    moments = {"mean": centred, "second": centred[..., :, None] * centred[..., None, :]}
    data = az.from_dict(posterior=moments)
    error = az.mcse(data, method="mean")
    for name, expected in (("mean", np.zeros(3)), ("second", COVARIANCE)):
        away = np.abs(moments[name].mean((0, 1)) - expected)
        np.testing.assert_array_less(away, 4.5 * error[name].values)


def test_transitions_belong_to_the_draws_and_the_warmup_is_dropped(chains):
    drawn, transitions = chains
    x = drawn["x"].reshape(-1, 3)
    np.testing.assert_allclose(drawn["product"].ravel(), x[:, 0] * x[:, 1])
    np.testing.assert_allclose(transitions.lp.ravel(), -jax.vmap(potential)(x), rtol=1e-10)
    assert (transitions.energy >= -transitions.lp).all()
    # A step size is adapted in the warmup only.
    assert (transitions.step_size == transitions.step_size[:, :1]).all()
    assert len(np.unique(transitions.step_size)) == CHAINS


def test_the_same_key_gives_the_same_bits_and_another_does_not(chains):
    keys = jax.random.split(jax.random.key(1), CHAINS)
    again = chain(keys[1])
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(chains), strict=True):
        np.testing.assert_array_equal(a, b[1])
    assert (chains[0]["x"][0] != chains[0]["x"][1]).all()


def test_threads_keep_the_order_of_their_arguments_and_hand_on_errors():
    def run(i, fails):
        # The first ends last.
        time.sleep(0.05 * (3 - i))
        if fails:
            raise ArithmeticError(f"number {i}")
        return np.full(2, i), {"square": i**2}

    numbers, named = in_threads(run, [(i, False) for i in range(4)])
    np.testing.assert_array_equal(numbers, [[0, 0], [1, 1], [2, 2], [3, 3]])
    np.testing.assert_array_equal(named["square"], [0, 1, 4, 9])
    with pytest.raises(ArithmeticError, match="number 2"):
        in_threads(run, [(i, i == 2) for i in range(4)])


def test_the_mode_of_a_quadratic_has_its_inverse_curvature():
    mode = mode_of(jax.value_and_grad(potential), np.zeros(3))
    np.testing.assert_allclose(mode.position, MEAN, atol=1e-4)
    np.testing.assert_allclose(mode.covariance, COVARIANCE, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("curvature", [0.0, 1e-3, -1.0])
def test_no_axis_is_longer_than_ten_times_the_shortest(curvature):
    """Around a point where the density is flat along one axis, nearly, or is least there."""
    scales, axes = np.array([4.0, curvature]), np.array([[0.6, -0.8], [0.8, 0.6]])
    hessian = (axes * scales) @ axes.T
    mode = mode_of(lambda x: (x @ hessian @ x / 2, hessian @ x), np.zeros(2))
    np.testing.assert_allclose(mode.covariance, (axes / [4.0, 0.04]) @ axes.T, rtol=1e-6)
