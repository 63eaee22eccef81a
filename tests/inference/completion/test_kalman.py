"""The filter and smoother of affine-Gaussian chains against the joint Gaussian written out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.inference.completion.kalman import (
    AffineGaussian,
    filter_gaussian,
    sample_filtered,
    smooth_filtered,
)

L, D, M = 7, 3, 2

forward, backward = jax.jit(filter_gaussian), jax.jit(smooth_filtered)
sample = jax.jit(sample_filtered, static_argnums=2)


def covariance(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T / size + 0.1 * np.eye(size)


def random_chain(seed, noise_scale=1.0):
    rng = np.random.default_rng(seed)
    chain = AffineGaussian(
        rng.normal(size=D),
        covariance(rng, D),
        0.7 * rng.normal(size=(L - 1, D, D)),
        rng.normal(size=(L - 1, D)),
        noise_scale * np.stack([covariance(rng, D) for _ in range(L - 1)]),
        rng.normal(size=(M, D)),
        np.stack([covariance(rng, M) for _ in range(L)]),
    )
    return jax.tree.map(jnp.asarray, chain), jnp.asarray(rng.normal(size=(L, M)))


def joint(chain):
    """Mean ``[L D]`` and covariance of all states together, by substituting the recursion into itself."""
    c = jax.tree.map(np.asarray, chain)
    mean, cov = np.zeros((L, D)), np.zeros((L, D, L, D))
    mean[0], cov[0, :, 0] = c.mean, c.covariance
    for t in range(L - 1):
        mean[t + 1] = c.transition[t] @ mean[t] + c.offset[t]
        for u in range(t + 1):
            cov[t + 1, :, u] = c.transition[t] @ cov[t, :, u]
            cov[u, :, t + 1] = cov[t + 1, :, u].T
        cov[t + 1, :, t + 1] = c.transition[t] @ cov[t, :, t] @ c.transition[t].T + c.noise[t]
    return mean.ravel(), cov.reshape(L * D, L * D)


def closed_form(chain, observations, observed):
    """Posterior mean, covariance and log-likelihood by conditioning the joint Gaussian."""
    mean, cov = joint(chain)
    steps = np.flatnonzero(observed)
    H = np.zeros((len(steps), M, L, D))
    R = np.zeros((len(steps), M, len(steps), M))
    for i, t in enumerate(steps):
        H[i, :, t], R[i, :, i] = chain.observation, chain.observation_noise[t]
    H, R = H.reshape(-1, L * D), R.reshape(len(steps) * M, -1)
    y = np.asarray(observations)[steps].ravel()
    S = H @ cov @ H.T + R
    gain = np.linalg.solve(S, H @ cov).T
    return (
        (mean + gain @ (y - H @ mean)).reshape(L, D),
        (cov - gain @ S @ gain.T).reshape(L, D, L, D),
        stats.multivariate_normal(H @ mean, S).logpdf(y),
    )


OBSERVED = {
    "all": np.ones(L, bool),
    "gaps": np.array([1, 0, 1, 0, 0, 1, 1], bool),
    "padding": np.arange(L) < 4,
    "first missing": np.arange(L) > 0,
}


@pytest.mark.parametrize("observed", OBSERVED.values(), ids=OBSERVED.keys())
@pytest.mark.parametrize("noise_scale", [1.0, 1e-8])
def test_smoothing_is_the_conditional_of_the_joint_gaussian(observed, noise_scale):
    chain, observations = random_chain(3, noise_scale)
    mean, cov, log_likelihood = closed_form(chain, observations, observed)
    smoothed = backward(forward(chain, observations, jnp.asarray(observed)))
    np.testing.assert_allclose(smoothed.log_likelihood, log_likelihood, atol=1e-8)
    np.testing.assert_allclose(smoothed.means, mean, atol=1e-8)
    for t in range(L):
        np.testing.assert_allclose(smoothed.covariances[t], cov[t, :, t], atol=1e-8)
        if t:
            np.testing.assert_allclose(smoothed.lagged[t - 1], cov[t, :, t - 1], atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_filtering_uses_the_past_alone(seed):
    chain, observations = random_chain(seed)
    filtered = forward(chain, observations, jnp.ones(L, bool))
    for t in range(L):
        mean, cov, _ = closed_form(chain, observations, np.arange(L) <= t)
        np.testing.assert_allclose(filtered.means[t], mean[t], atol=1e-8)
        np.testing.assert_allclose(filtered.covariances[t], cov[t, :, t], atol=1e-8)


def test_draws_have_the_joint_posterior():
    chain, observations = random_chain(5)
    mean, cov, _ = closed_form(chain, observations, np.ones(L, bool))
    n = 40_000
    drawn = np.asarray(sample(jax.random.key(0), forward(chain, observations, jnp.ones(L, bool)), n))
    cov = cov.reshape(L * D, L * D)
    spread = np.sqrt(np.diag(cov))
    assert (abs(drawn.mean(0) - mean).ravel() < 5 * spread / np.sqrt(n)).all()
    error = np.cov(drawn.reshape(n, -1).T) - cov  # every pair of steps, not neighbours alone
    assert (abs(error) < 6 * np.outer(spread, spread) * np.sqrt(2 / n)).all()


def test_draws_of_a_nearly_noiseless_chain_follow_its_dynamics():
    chain, observations = random_chain(2, 1e-12)
    drawn = np.asarray(sample(jax.random.key(1), forward(chain, observations, jnp.ones(L, bool)), 50))
    followed = np.einsum("tij,ntj->nti", chain.transition, drawn[:, :-1]) + np.asarray(chain.offset)
    assert np.isfinite(drawn).all()
    np.testing.assert_allclose(drawn[:, 1:], followed, atol=2e-5)
