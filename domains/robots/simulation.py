"""Trajectories of any behaviour in a task of either kind, of a stated length: what networks are judged by.

Whole episodes of a policy network alone are played faster by
:func:`i2rl.inference.adversarial.rollouts.play`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment, HostEnvironment
from ...models.observation.recordings import Recording

LEVELS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


class Behaviour(Protocol):
    """Policy that acts: a policy network, or any JAX pytree with its two functions."""

    def mode(self, observations: Array) -> Array:
        """Compute deterministic actions of observations ``[..., d]``."""
        ...

    def sample(self, key: Array, observations: Array) -> Array:
        """Draw actions."""
        ...


class _PerturbedFields(NamedTuple):
    policy: Any
    share: Any


@shown_briefly
class Perturbed(_PerturbedFields):
    """Mixture of a policy and, with probability ``share``, the uniform policy within the bounds.

    The mode is the policy's own. At 1 it is the uniform policy. ``policy.actions`` must have bounds.
    """

    __slots__ = ()

    def mode(self, observations: Array) -> Array:
        """Return the policy's own action."""
        return self.policy.mode(observations)

    def sample(self, key: Array, observations: Array) -> Array:
        """Draw actions."""
        k_own, k_any, k_which = jax.random.split(key, 3)
        space, batch = self.policy.actions, observations.shape[:-1]
        anything = jax.random.bernoulli(k_which, jnp.asarray(self.share, float), batch)
        own = self.policy.sample(k_own, observations)
        if space.discrete:
            return jnp.where(anything, jax.random.randint(k_any, batch, 0, space.n), own)
        low, high = jnp.asarray(space.low, own.dtype), jnp.asarray(space.high, own.dtype)
        drawn = jax.random.uniform(k_any, own.shape, own.dtype, low, high)
        return jnp.where(anything[..., None], drawn, space.clip(own))


@shown_briefly
class Trajectories(NamedTuple):
    """Trajectories of at most ``T`` steps, from first states drawn; steps after termination are not live.

    Fields
    ------
    observations, next_observations : float ``[n, T, d]``
    actions : int ``[n, T]`` or float ``[n, T, k]``, as carried out (cut to the bounds)
    rewards : float ``[n, T]``, the environment's own; zero at steps that are not live
    live : bool ``[n, T]``
    terminated : bool ``[n]``
    """

    observations: Float[np.ndarray, "n T d"]
    actions: np.ndarray
    next_observations: Float[np.ndarray, "n T d"]
    rewards: Float[np.ndarray, "n T"]
    live: Bool[np.ndarray, "n T"]
    terminated: Bool[np.ndarray, " n"]

    @property
    def returns(self) -> Float[np.ndarray, " n"]:
        """Undiscounted return of each episode."""
        return self.rewards.sum(1)

    @property
    def visited(self) -> Float[np.ndarray, "N d"]:
        """Observations in which the policy acted."""
        return self.observations[self.live]

    @property
    def recording(self) -> Recording:
        """The episodes as a demonstration."""
        return Recording(*map(jnp.asarray, (self.observations, self.actions, self.live, self.terminated)))


def simulate(
    environment: Environment | HostEnvironment,
    policy: Behaviour,
    key: Array,
    episodes: int,
    length: int | None = None,
    *,
    deterministic: bool = False,
) -> Trajectories:
    """Simulate trajectories of ``length`` steps (the environment's horizon by default), or until they
    terminate.

    ``deterministic`` takes the policy's mode. Raises ``ValueError`` for fewer than one episode or step.
    """
    length = environment.horizon if length is None else length
    if episodes < 1 or length < 1:
        raise ValueError(f"there must be at least 1 episode of 1 step, got {episodes} of {length}")
    if isinstance(environment, Environment):
        found = _simulated(environment, policy, key, episodes, length, deterministic)
        return Trajectories(*map(np.asarray, found))
    return _stepped(environment, policy, key, episodes, length, deterministic)


def graded_mix(
    environment: Environment | HostEnvironment,
    policies: Sequence[Behaviour],
    key: Array,
    episodes: int,
    length: int | None = None,
) -> tuple[Trajectories, Int[np.ndarray, " n"]]:
    """Simulate held-out episodes of policies of graded quality, as many of each; return the policy of each.

    Rewards are compared over all of them: over one policy's states alone hardly any reward varies.
    ``[Perturbed(policy, level) for level in LEVELS]`` is such a grading.
    """
    parts = [
        simulate(environment, policy, jax.random.fold_in(key, i), episodes, length)
        for i, policy in enumerate(policies)
    ]
    return Trajectories(*map(np.concatenate, zip(*parts, strict=True))), np.repeat(
        np.arange(len(parts)), episodes
    )


@partial(jax.jit, static_argnums=3)
def acted(policy: Behaviour, key: Array, observations: Array, deterministic: bool) -> Array:
    """Choose a policy's actions: its mode, or a draw. Compiled once for each kind of policy and batch."""
    return policy.mode(observations) if deterministic else policy.sample(key, observations)


@partial(jax.jit, static_argnums=(0, 3, 4, 5))
def _simulated(
    environment: Environment, policy: Any, key: Array, episodes: int, length: int, deterministic: bool
) -> tuple:
    k_first, k_rest = jax.random.split(key)
    states = jax.vmap(environment.reset)(jax.random.split(k_first, episodes))

    def step(carry: tuple, key: Array) -> tuple[tuple, tuple]:
        states, live = carry
        seen = jax.vmap(environment.observe)(states)
        actions = environment.actions.clip(acted(policy, key, seen, deterministic))
        after, rewards, ended = jax.vmap(environment.step)(states, actions)
        following = jax.vmap(environment.observe)(after)
        return (after, live & ~ended), (seen, actions, following, jnp.where(live, rewards, 0), live)

    carry = (states, jnp.ones(episodes, bool))
    (_, live), steps = lax.scan(step, carry, jax.random.split(k_rest, length))
    return *(jnp.swapaxes(x, 0, 1) for x in steps), ~live


def _stepped(
    environment: HostEnvironment, policy: Any, key: Array, episodes: int, length: int, deterministic: bool
) -> Trajectories:
    k_first, k_rest = jax.random.split(key)
    states = np.array(environment.reset(k_first, episodes))
    live = np.ones(episodes, bool)
    space, steps = environment.actions, []
    for key in jax.random.split(k_rest, length):
        if not live.any():
            break
        seen = environment.observe(states)
        actions = acted(policy, key, jnp.asarray(seen, jnp.float32), deterministic)
        actions = np.asarray(space.clip(actions))
        rewards, ended = np.zeros(episodes), np.zeros(episodes, bool)
        states[live], rewards[live], ended[live] = environment.step(states[live], actions[live])
        steps.append((seen, actions, environment.observe(states), rewards, live.copy()))
        live &= ~ended

    def whole(arrays: tuple) -> np.ndarray:
        array = np.stack(arrays, 1)
        return np.pad(array, [(0, 0), (0, length - len(steps))] + [(0, 0)] * (array.ndim - 2))

    seen, actions, following, rewards, alive = map(whole, zip(*steps, strict=True))
    return Trajectories(seen, actions, following, rewards, alive, ~live)
