"""Rewards and policies as networks, for tasks without engineered features (chapter 6.2).

Modules of Equinox whose leaves are arrays only, so that they are carried, journalled and compared like any
other state. All take batches, ``[..., d]``, and compute in 32-bit floats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from ...extras import required
from ..inputs.display import shown_briefly

if TYPE_CHECKING:
    import equinox as eqx
else:
    eqx = required("equinox")

DTYPE = jnp.float32


@shown_briefly
class ActionSpace(NamedTuple):
    """Actions of a task: ``n`` of them, or vectors between ``low [k]`` and ``high [k]`` (then ``n`` is 0)."""

    n: int
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    @property
    def discrete(self) -> bool:
        """True if there are finitely many actions."""
        return self.n > 0

    @property
    def size(self) -> int:
        """Length of an action as a network's input: one-hot, or the vector itself."""
        return self.n if self.discrete else len(self.low)

    def encode(self, actions: ArrayLike) -> Float[Array, "... size"]:
        """Encode actions as inputs of a network."""
        if self.discrete:
            return jax.nn.one_hot(jnp.asarray(actions), self.n, dtype=DTYPE)
        return jnp.asarray(actions, DTYPE)

    def clip(self, actions: Float[Array, "... k"]) -> Float[Array, "... k"]:
        """Clip vectors to the bounds; discrete actions are unchanged."""
        if self.discrete:
            return actions
        return jnp.clip(actions, jnp.asarray(self.low, DTYPE), jnp.asarray(self.high, DTYPE))


class MLP(eqx.Module):
    """Fully connected layers with ``tanh`` or ``relu`` between them.

    Fields
    ------
    weights, biases : arrays ``[in, out]`` and ``[out]``, one per layer
    """

    weights: tuple[Float[Array, "in out"], ...]
    biases: tuple[Float[Array, " out"], ...]
    activation: str = eqx.field(static=True, default="tanh")

    @staticmethod
    def create(
        key: Array,
        sizes: Sequence[int],
        *,
        activation: str = "tanh",
        scale: float = 2.0**0.5,
        last: float = 1.0,
    ) -> MLP:
        """Create orthogonal weights times ``scale`` (the last layer's times ``last``), and zero biases.

        ``sizes`` counts input, hidden layers and output. Raises ``ValueError`` for another activation.
        """
        if activation not in ("tanh", "relu"):
            raise ValueError(f"the activation is 'tanh' or 'relu', got {activation!r}")
        keys = jax.random.split(key, len(sizes) - 1)
        gains = [scale] * (len(sizes) - 2) + [last]
        weights = tuple(
            gain * jax.nn.initializers.orthogonal()(k, (i, o), DTYPE)
            for k, gain, i, o in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
        )
        return MLP(weights, tuple(jnp.zeros(o, DTYPE) for o in sizes[1:]), activation)

    def __call__(self, x: Float[Array, "... in"]) -> Float[Array, "... out"]:
        """Return the outputs of a batch."""
        between = jnp.tanh if self.activation == "tanh" else jax.nn.relu
        for w, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = between(x @ w + b)
        return x @ self.weights[-1] + self.biases[-1]


class RunningNorm(eqx.Module):
    """Scaling by the mean and deviation of all inputs so far (Chan, Golub and LeVeque 1983).

    Fields
    ------
    count : float, number of inputs
    mean : float ``[d]``
    scatter : float ``[d]``, the sum of squared deviations from the mean
    """

    count: Float[Array, ""]
    mean: Float[Array, " d"]
    scatter: Float[Array, " d"]

    @staticmethod
    def create(size: int) -> RunningNorm:
        """Create the identity, before any input."""
        return RunningNorm(jnp.zeros((), DTYPE), jnp.zeros(size, DTYPE), jnp.zeros(size, DTYPE))

    def update(self, x: Float[Array, "... d"]) -> RunningNorm:
        """Add a batch of inputs to the statistic."""
        flat = jnp.asarray(x, DTYPE).reshape(-1, x.shape[-1])
        n, mean = flat.shape[0], flat.mean(0)
        total = self.count + n
        shift = mean - self.mean
        return RunningNorm(
            total,
            self.mean + shift * n / total,
            self.scatter + jnp.sum((flat - mean) ** 2, 0) + shift**2 * self.count * n / total,
        )

    @property
    def deviation(self) -> Float[Array, " d"]:
        """Standard deviation of the inputs; one before the second."""
        variance = self.scatter / jnp.maximum(self.count, 1)
        return jnp.where(self.count > 1, jnp.sqrt(variance + 1e-6), 1.0).astype(DTYPE)

    def __call__(self, x: Float[Array, "... d"]) -> Float[Array, "... d"]:
        """Scale inputs, and clip them ten deviations from the mean. The statistic has no gradient."""
        mean, deviation = jax.lax.stop_gradient((self.mean, self.deviation))
        return jnp.clip((jnp.asarray(x, DTYPE) - mean) / deviation, -10, 10)


class ShapedReward(eqx.Module):
    """``f(s, a, s') = g(s, a) + gamma h(s') - h(s)`` (Fu, Luo and Levine 2018, Eq. 4).

    ``g`` is the reward, ``h`` a potential that shapes it and changes no optimal behaviour (Ng, Harada and
    Russell 1999). An episode that terminates continues in an absorbing state of potential zero, where every
    step earns ``absorbing``. Without it, negative rewards would favour ending the episode (Kostrikov et al.
    2019).

    Fields
    ------
    reward, potential : MLP
    norm : RunningNorm, of observations
    absorbing : float
    """

    reward: MLP
    potential: MLP
    norm: RunningNorm
    absorbing: Float[Array, ""]
    actions: ActionSpace = eqx.field(static=True)
    discount: float = eqx.field(static=True)
    state_only: bool = eqx.field(static=True, default=False)

    @staticmethod
    def create(
        key: Array,
        observation_size: int,
        actions: ActionSpace,
        discount: float,
        *,
        reward: Sequence[int] = (32,),
        potential: Sequence[int] = (32, 32),
        state_only: bool = False,
        activation: str = "relu",
    ) -> ShapedReward:
        """Create networks with the given hidden layers; ``state_only`` makes ``g(s)`` of the state alone."""
        k_g, k_h = jax.random.split(key)
        inputs = observation_size + (0 if state_only else actions.size)
        return ShapedReward(
            MLP.create(k_g, (inputs, *reward, 1), activation=activation, last=0.1),
            MLP.create(k_h, (observation_size, *potential, 1), activation=activation, last=0.1),
            RunningNorm.create(observation_size),
            jnp.zeros((), DTYPE),
            actions,
            discount,
            state_only,
        )

    def __call__(self, observations: Float[Array, "... d"], actions: ArrayLike) -> Float[Array, "..."]:
        """Return the reward ``g(s, a)``."""
        return self.reward_at(self.norm(observations), self.actions.encode(actions))

    def shaped(
        self,
        observations: Float[Array, "... d"],
        actions: ArrayLike,
        successors: Float[Array, "... d"],
        terminated: ArrayLike,
    ) -> Float[Array, "..."]:
        """Return ``f(s, a, s')``; after termination the potential is zero."""
        z, following = self.norm(observations), self.norm(successors)
        return self.shaped_at(z, self.actions.encode(actions), following, jnp.asarray(terminated))

    def reward_at(self, z: Float[Array, "... d"], a: Float[Array, "... size"]) -> Float[Array, "..."]:
        """Return ``g`` of a scaled observation and an encoded action."""
        return self.reward(z if self.state_only else jnp.concatenate([z, a], -1))[..., 0]

    def shaped_at(
        self,
        z: Float[Array, "... d"],
        a: Float[Array, "... size"],
        following: Float[Array, "... d"],
        terminated: Array,
    ) -> Float[Array, "..."]:
        """Return ``f`` of scaled observations and encoded actions."""
        after = jnp.where(terminated, 0.0, self.potential(following)[..., 0])
        return self.reward_at(z, a) + self.discount * after - self.potential(z)[..., 0]


class GaussianPolicy(eqx.Module):
    """Gaussian actions about a network of the state, with deviations independent of the state.

    Fields
    ------
    mean : MLP
    log_deviation : float ``[k]``
    norm : RunningNorm, of observations
    """

    mean: MLP
    log_deviation: Float[Array, " k"]
    norm: RunningNorm
    actions: ActionSpace = eqx.field(static=True)

    @staticmethod
    def create(
        key: Array,
        observation_size: int,
        actions: ActionSpace,
        hidden: Sequence[int] = (32, 32),
        log_deviation: float = 0.0,
    ) -> GaussianPolicy:
        """Create a policy whose means are near zero."""
        net = MLP.create(key, (observation_size, *hidden, actions.size), last=0.01)
        return GaussianPolicy(
            net, jnp.full(actions.size, log_deviation, DTYPE), RunningNorm.create(observation_size), actions
        )

    def mode(self, observations: Float[Array, "... d"]) -> Float[Array, "... k"]:
        """Return the mean action."""
        return self.mean(self.norm(observations))

    def sample(self, key: Array, observations: Float[Array, "... d"]) -> Float[Array, "... k"]:
        """Draw actions; environments clip them to the bounds."""
        mean = self.mode(observations)
        return mean + jnp.exp(self.log_deviation) * jax.random.normal(key, mean.shape, DTYPE)

    def log_prob(
        self, observations: Float[Array, "... d"], actions: Float[Array, "... k"]
    ) -> Float[Array, "..."]:
        """Return the log-density, in nats."""
        z = (jnp.asarray(actions, DTYPE) - self.mode(observations)) * jnp.exp(-self.log_deviation)
        return (
            -0.5 * jnp.sum(z**2, -1) - jnp.sum(self.log_deviation) - 0.5 * z.shape[-1] * math.log(2 * math.pi)
        )

    def entropy(self, observations: Float[Array, "... d"]) -> Float[Array, "..."]:
        """Return the differential entropy, in nats."""
        one = jnp.sum(self.log_deviation + 0.5 * math.log(2 * math.pi * math.e)).astype(DTYPE)
        return jnp.broadcast_to(one, observations.shape[:-1])


class CategoricalPolicy(eqx.Module):
    """Choice of one of ``n`` actions, with logits from a network of the state.

    Fields
    ------
    logits : MLP
    norm : RunningNorm, of observations
    """

    logits: MLP
    norm: RunningNorm
    actions: ActionSpace = eqx.field(static=True)

    @staticmethod
    def create(
        key: Array, observation_size: int, actions: ActionSpace, hidden: Sequence[int] = (32, 32)
    ) -> CategoricalPolicy:
        """Create a policy near uniform."""
        net = MLP.create(key, (observation_size, *hidden, actions.n), last=0.01)
        return CategoricalPolicy(net, RunningNorm.create(observation_size), actions)

    def log_probs(self, observations: Float[Array, "... d"]) -> Float[Array, "... n"]:
        """Return the log-probabilities of all actions, in nats."""
        return jax.nn.log_softmax(self.logits(self.norm(observations)))

    def mode(self, observations: Float[Array, "... d"]) -> Int[Array, "..."]:
        """Return the likeliest action."""
        return jnp.argmax(self.log_probs(observations), -1)

    def sample(self, key: Array, observations: Float[Array, "... d"]) -> Int[Array, "..."]:
        """Draw actions."""
        return jax.random.categorical(key, self.log_probs(observations))

    def log_prob(
        self, observations: Float[Array, "... d"], actions: Int[Array, "..."]
    ) -> Float[Array, "..."]:
        """Return the log-probability, in nats."""
        chosen = jnp.asarray(actions)[..., None]
        return jnp.take_along_axis(self.log_probs(observations), chosen, -1)[..., 0]

    def entropy(self, observations: Float[Array, "... d"]) -> Float[Array, "..."]:
        """Return the entropy, in nats."""
        log_p = self.log_probs(observations)
        return -jnp.sum(jnp.exp(log_p) * log_p, -1)


Policy = GaussianPolicy | CategoricalPolicy


def policy_network(
    key: Array, observation_size: int, actions: ActionSpace, hidden: Sequence[int] = (32, 32)
) -> Policy:
    """Create the policy of the action space: categorical or Gaussian."""
    kind = CategoricalPolicy if actions.discrete else GaussianPolicy
    return kind.create(key, observation_size, actions, hidden)
