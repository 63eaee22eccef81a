"""Policies that mix others: a Gaussian mixture whose components are policies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...extras import required
from .modules import DTYPE, GaussianPolicy

if TYPE_CHECKING:
    import equinox as eqx
else:
    eqx = required("equinox")


class MixturePolicy(eqx.Module):
    """Mixture of Gaussian policies; every step draws a component anew.

    Fields
    ------
    components : GaussianPolicy, one or more
    logits : float, one per component; the weights are their softmax
    """

    components: tuple[GaussianPolicy, ...]
    logits: Float[Array, " m"]

    def log_prob(
        self, observations: Float[Array, "... d"], actions: Float[Array, "... k"]
    ) -> Float[Array, "..."]:
        """Return the log-density, in nats."""
        each = jnp.stack([p.log_prob(observations, actions) for p in self.components], -1)
        return jax.nn.logsumexp(each + jax.nn.log_softmax(self.logits), axis=-1)

    def sample(self, key: Array, observations: Float[Array, "... d"]) -> Float[Array, "... k"]:
        """Draw actions."""
        key_which, *keys = jax.random.split(key, len(self.components) + 1)
        each = [p.sample(k, observations) for p, k in zip(self.components, keys, strict=True)]
        which = jax.random.categorical(key_which, self.logits, shape=observations.shape[:-1])
        return jnp.take_along_axis(jnp.stack(each, -2), which[..., None, None], -2)[..., 0, :]

    def mode(self, observations: Float[Array, "... d"]) -> Float[Array, "... k"]:
        """Return the mean action of the heaviest component."""
        modes = jnp.stack([p.mode(observations) for p in self.components], -2)
        return jnp.take(modes, jnp.argmax(self.logits), axis=-2)

    def moments(
        self, observations: Float[Array, "... d"]
    ) -> tuple[Float[Array, "... k"], Float[Array, "... k k"]]:
        """Return mean and covariance of an action, which the smoother of noisy recordings uses."""
        weights = jax.nn.softmax(self.logits).astype(DTYPE)
        modes = jnp.stack([p.mode(observations) for p in self.components], -2)
        mean = jnp.einsum("m,...mk->...k", weights, modes)
        off = modes - mean[..., None, :]
        own = jnp.diag(
            sum(w * jnp.exp(2 * p.log_deviation) for w, p in zip(weights, self.components, strict=True))
        )
        return mean, jnp.einsum("m,...mk,...mj->...kj", weights, off, off) + own
