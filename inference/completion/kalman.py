"""Exact inference in affine-Gaussian chains that change from step to step (Kalman 1960; Rauch et al. 1965).

The chain is ``x_0 ~ N(m, P)``, ``x_{t+1} = F_t x_t + b_t + N(0, Q_t)``, observed as
``y_t = H x_t + N(0, R_t)``. Covariances are sums of squares throughout (Joseph's form), which keeps them
positive definite if ``Q_t`` is nearly singular; inverses use Cholesky factors. 64-bit floats.

Functions take one chain. Use ``jax.lax.map`` for several; ``jax.vmap`` works too, but batches of small
factorisations inside a loop are slow on a CPU.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from ...models.inputs.display import shown_briefly


@shown_briefly
class AffineGaussian(NamedTuple):
    """An affine-Gaussian chain of ``L`` steps.

    Fields
    ------
    mean, covariance : float ``[D]``, ``[D, D]``
        Law of the first state.
    transition, offset, noise : float ``[L - 1, D, D]``, ``[L - 1, D]``, ``[L - 1, D, D]``
        ``F_t``, ``b_t`` and ``Q_t``.
    observation, observation_noise : float ``[m, D]``, ``[L, m, m]``
        ``H`` and ``R_t``.
    """

    mean: Float[Array, " D"]
    covariance: Float[Array, "D D"]
    transition: Float[Array, "T D D"]
    offset: Float[Array, "T D"]
    noise: Float[Array, "T D D"]
    observation: Float[Array, "m D"]
    observation_noise: Float[Array, "L m m"]


@shown_briefly
class GaussianFiltered(NamedTuple):
    """Forward pass, and the law of each state given the next.

    ``x_t | x_{t+1}, y_{0:t} ~ N(means_t + gains_t (x_{t+1} - predicted_{t+1}), conditional_t)``.

    Fields
    ------
    log_likelihood : float, in nats
    means, covariances : float ``[L, D]``, ``[L, D, D]``
        Moments of ``x_t`` given ``y_{0:t}``.
    predicted : float ``[L - 1, D]``
        Mean of ``x_{t+1}`` given ``y_{0:t}``.
    gains, conditional : float ``[L - 1, D, D]``
    """

    log_likelihood: Float[Array, ""]
    means: Float[Array, "L D"]
    covariances: Float[Array, "L D D"]
    predicted: Float[Array, "T D"]
    gains: Float[Array, "T D D"]
    conditional: Float[Array, "T D D"]


@shown_briefly
class GaussianSmoothed(NamedTuple):
    """Posterior of a chain given all observations.

    Fields
    ------
    log_likelihood : float, in nats
    means, covariances : float ``[L, D]``, ``[L, D, D]``
    lagged : float ``[L - 1, D, D]``
        ``Cov(x_{t+1}, x_t)``.
    """

    log_likelihood: Float[Array, ""]
    means: Float[Array, "L D"]
    covariances: Float[Array, "L D D"]
    lagged: Float[Array, "T D D"]


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))


def filter_gaussian(
    chain: AffineGaussian, observations: Float[Array, "L m"], observed: Bool[Array, " L"]
) -> GaussianFiltered:
    """Run the forward pass; steps with ``observed`` false (padding, hidden steps) have no observation."""
    identity = jnp.eye(chain.mean.shape[0])
    H = chain.observation

    def update(mean: Array, covariance: Array, y: Array, R: Array, there: Array) -> tuple:
        S = jnp.linalg.cholesky(H @ covariance @ H.T + R)
        error = y - H @ mean
        whitened = jax.scipy.linalg.solve_triangular(S, error, lower=True)
        gain = cho_solve((S, True), H @ covariance).T
        kept = identity - gain @ H
        log_p = -0.5 * (whitened @ whitened + len(error) * jnp.log(2 * jnp.pi)) - jnp.sum(
            jnp.log(jnp.diagonal(S))
        )
        return (
            jnp.where(there, mean + gain @ error, mean),
            jnp.where(there, _symmetric(kept @ covariance @ kept.T + gain @ R @ gain.T), covariance),
            jnp.where(there, log_p, 0.0),
        )

    def step(carry: tuple, inputs: tuple) -> tuple:
        mean, covariance, total = carry
        F, b, Q, y, R, there = inputs
        predicted = F @ mean + b
        ahead = _symmetric(F @ covariance @ F.T + Q)
        gain = cho_solve((jnp.linalg.cholesky(ahead), True), F @ covariance).T
        kept = identity - gain @ F
        conditional = _symmetric(kept @ covariance @ kept.T + gain @ Q @ gain.T)
        following, spread, log_p = update(predicted, ahead, y, R, there)
        return (following, spread, total + log_p), (following, spread, predicted, gain, conditional)

    first = update(chain.mean, chain.covariance, observations[0], chain.observation_noise[0], observed[0])
    inputs = (
        chain.transition,
        chain.offset,
        chain.noise,
        observations[1:],
        chain.observation_noise[1:],
        observed[1:],
    )
    passed: tuple = lax.scan(step, first, inputs)
    (_, _, total), (means, covariances, predicted, gains, conditional) = passed
    return GaussianFiltered(
        total,
        jnp.concatenate([first[0][None], means]),
        jnp.concatenate([first[1][None], covariances]),
        predicted,
        gains,
        conditional,
    )


def smooth_filtered(filtered: GaussianFiltered) -> GaussianSmoothed:
    """Run the backward pass of Rauch, Tung and Striebel."""

    def step(carry: tuple, inputs: tuple) -> tuple:
        following, spread = carry
        mean, predicted, gain, conditional = inputs
        mean = mean + gain @ (following - predicted)
        covariance = _symmetric(conditional + gain @ spread @ gain.T)
        return (mean, covariance), (mean, covariance, spread @ gain.T)

    last = filtered.means[-1], filtered.covariances[-1]
    inputs = (filtered.means[:-1], filtered.predicted, filtered.gains, filtered.conditional)
    smoothed: tuple = lax.scan(step, last, inputs, reverse=True)[1]
    means, covariances, lagged = smoothed
    return GaussianSmoothed(
        filtered.log_likelihood,
        jnp.concatenate([means, last[0][None]]),
        jnp.concatenate([covariances, last[1][None]]),
        lagged,
    )


def sample_filtered(key: Array, filtered: GaussianFiltered, draws: int) -> Float[Array, "draws L D"]:
    """Draw whole chains independently given all observations, backwards from the last state."""
    length, size = filtered.means.shape
    noise = jax.random.normal(key, (length, draws, size), filtered.means.dtype)

    def step(following: Array, inputs: tuple) -> tuple:
        mean, predicted, gain, conditional, z = inputs
        drawn = mean + (following - predicted) @ gain.T + z @ _root(conditional).T
        return drawn, drawn

    last = filtered.means[-1] + noise[-1] @ _root(filtered.covariances[-1]).T
    inputs = (filtered.means[:-1], filtered.predicted, filtered.gains, filtered.conditional, noise[:-1])
    drawn: Array = lax.scan(step, last, inputs, reverse=True)[1]
    return jnp.concatenate([drawn, last[None]]).swapaxes(0, 1)


def log_density_filtered(
    filtered: GaussianFiltered, states: Float[Array, "L D"], observed: Bool[Array, " L"]
) -> Float[Array, ""]:
    """Return the log-density of a chain given all observations, in nats, as :func:`sample_filtered` draws it.

    Only observed steps count: no transition may lead from them to the others, as on padding.
    """

    def step(following: Array, inputs: tuple) -> tuple:
        mean, predicted, gain, conditional, state = inputs
        return state, _log_normal(state - mean - gain @ (following - predicted), conditional)

    inputs = (filtered.means[:-1], filtered.predicted, filtered.gains, filtered.conditional, states[:-1])
    each: Array = lax.scan(step, states[-1], inputs, reverse=True)[1]
    last = _log_normal(states[-1] - filtered.means[-1], filtered.covariances[-1])
    return jnp.sum(jnp.where(observed, jnp.concatenate([each, last[None]]), 0.0))


def _log_normal(difference: Float[Array, " D"], covariance: Float[Array, "D D"]) -> Float[Array, ""]:
    root = _root(covariance)
    z = jax.scipy.linalg.solve_triangular(root, difference, lower=True)
    return -0.5 * (z @ z + len(z) * jnp.log(2 * jnp.pi)) - jnp.sum(jnp.log(jnp.diagonal(root)))


def _root(covariance: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """Return a Cholesky factor of a covariance that rounding may have left slightly indefinite."""
    slack = 1e-14 * jnp.trace(covariance) * jnp.eye(covariance.shape[0])
    return jnp.linalg.cholesky(covariance + slack)
