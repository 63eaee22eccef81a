"""A mixture of policies has the density and the moments of its draws, and serves the Gibbs sampler."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from i2rl.inference.completion.gaussian import gaussian_truth, jax_dynamics
from i2rl.inference.completion.gibbs import GaussianGibbs
from i2rl.models.networks.mixture_policy import MixturePolicy
from i2rl.models.networks.modules import ActionSpace, GaussianPolicy
from i2rl.models.observation.recordings import GaussianSensor, recording

KEY = jax.random.key(0)
SPACE = ActionSpace(0, (-1.0, -1.0), (1.0, 1.0))


def mixture():
    parts = []
    for i, deviation in enumerate((-1.0, -0.5)):
        policy = GaussianPolicy.create(jax.random.fold_in(KEY, i), 3, SPACE, (8,), deviation)
        parts.append(
            jax.tree.map(
                lambda x, i=i: x + (0.2 + 0.3 * i if x.shape == (2,) and (x == 0).all() else 0), policy
            )
        )
    return MixturePolicy(tuple(parts), jnp.log(jnp.array([0.3, 0.7], jnp.float32)))


def test_the_density_is_the_weighted_sum_of_the_components():
    policy = mixture()
    s = jax.random.normal(KEY, (5, 3))
    a = jax.random.normal(jax.random.key(1), (5, 2))
    p = sum(
        w * stats.norm(np.asarray(c.mode(s)), np.exp(np.asarray(c.log_deviation))).pdf(np.asarray(a)).prod(1)
        for w, c in zip((0.3, 0.7), policy.components, strict=True)
    )
    np.testing.assert_allclose(policy.log_prob(s, a), np.log(p), rtol=1e-4, atol=1e-4)


def test_draws_have_the_moments():
    policy = mixture()
    n = 100_000
    s = jnp.array([0.5, -1.0, 0.3])
    drawn = np.asarray(policy.sample(KEY, jnp.broadcast_to(s, (n, 3))))
    mean, covariance = policy.moments(s)
    np.testing.assert_allclose(drawn.mean(0), mean, atol=5 / np.sqrt(n))
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=8 / np.sqrt(n))
    assert abs(policy.components[0].mode(s) - policy.components[1].mode(s)).max() > 0.1


class Coin(NamedTuple):
    """Actions about -0.6 or 0.6 whatever the state, 64 bits."""

    means: jax.Array

    def moments(self, s):
        spread = 0.04 + jnp.var(self.means)
        return jnp.zeros((*s.shape[:-1], 1)) + self.means.mean(), jnp.full((*s.shape[:-1], 1, 1), spread)

    def log_prob(self, s, a):
        each = jax.scipy.stats.norm.logpdf(a, self.means, 0.2)
        return jax.nn.logsumexp(each, axis=-1) - jnp.log(2.0)


def test_gibbs_sampling_of_a_mixture_agrees_with_the_sum_over_its_components():
    policy, sensor = Coin(jnp.array([-0.6, 0.6])), GaussianSensor(0.1, 0.3)
    reports = np.array([0.3, 0.15, -0.2, -0.1])  # s_0, a_0, s_1, a_1
    dynamics = jax_dynamics(lambda s, a: 0.8 * s + 0.5 * a)
    reported = recording([reports[[0, 2], None]], [reports[[1, 3], None]])
    gibbs = GaussianGibbs(
        gaussian_truth(dynamics, 1, process_covariance=0.1, initial_covariance=1.0, draws=500), sweeps=1
    )
    chain, total = gibbs.init(reported, sensor), 0.0
    for i in range(80):
        chain, _ = gibbs.refresh(chain, policy, jax.random.fold_in(KEY, i), sensor)
        if i >= 20:
            total += np.asarray(jnp.concatenate([chain.observations, chain.actions], -1))[:, 0] / 60
    assert 0.2 < chain.least_acceptance < 1

    root = np.array([[1, 0, 0, 0], [0, 0.2, 0, 0], [0.8, 0.1, 0.1**0.5, 0], [0, 0, 0, 0.2]])
    prior, noise = root @ root.T, np.diag([0.1, 0.3, 0.1, 0.3])
    weights, means = [], []
    for first in (-0.6, 0.6):
        for second in (-0.6, 0.6):
            mean = np.array([0, first, 0.5 * first, second])
            weights.append(stats.multivariate_normal(mean, prior + noise).pdf(reports))
            means.append(mean + prior @ np.linalg.solve(prior + noise, reports - mean))
    exact = (np.array(weights) @ means / np.sum(weights)).reshape(2, 2)
    error = total.std(0, ddof=1) / np.sqrt(500)
    assert (abs(total.mean(0) - exact) < 5 * error).all()
