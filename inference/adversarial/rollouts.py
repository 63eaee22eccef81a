"""Behaviour of a policy in a task: rollouts for learning, and whole episodes for evaluation.

Compiled tasks are rolled out in one scan. Tasks in NumPy are stepped from the host, and the network is
evaluated in NumPy too: for a few rows this takes a fifth of the time of dispatching a compiled program. In
both cases all noise is drawn from the key before the first step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, islice
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment, HostEnvironment, Rollout
from ...models.networks.modules import DTYPE, MLP, CategoricalPolicy, GaussianPolicy, Policy

Task = Environment | HostEnvironment
_SPARE_STARTS = 32


@shown_briefly
class Running(NamedTuple):
    """Current episodes, side by side.

    Fields
    ------
    states : ``[n, D]``, the environment's
    steps : int32 ``[n]``, length of each so far
    returns : float32 ``[n]``, return of each so far, by the environment's reward
    """

    states: Array
    steps: Int[Array, " n"]
    returns: Float[Array, " n"]


@shown_briefly
class Episodes(NamedTuple):
    """Whole episodes from their first states, side by side.

    Fields
    ------
    observations : float32 ``[n, T + 1, d]``, with the one after the last step
    actions : int32 ``[n, T]`` or float32 ``[n, T, k]``
    rewards : float32 ``[n, T]``, zero after the end
    lengths : int ``[n]``, steps; later entries of the arrays are meaningless
    terminated : bool ``[n]``, True if the task ended, False if the time ran out
    """

    observations: Float[np.ndarray, "n T+1 d"]
    actions: np.ndarray
    rewards: Float[np.ndarray, "n T"]
    lengths: Int[np.ndarray, " n"]
    terminated: Bool[np.ndarray, " n"]

    @property
    def returns(self) -> Float[np.ndarray, " n"]:
        """Undiscounted returns by the environment's reward."""
        return self.rewards.sum(1, dtype=np.float64)


def begin(environment: Task, key: Array, n: int) -> Running:
    """Begin ``n`` episodes at their first states."""
    if isinstance(environment, Environment):
        states = jax.vmap(environment.reset)(jax.random.split(key, n))
        return Running(states, jnp.zeros(n, jnp.int32), jnp.zeros(n, DTYPE))
    return Running(
        np.array(environment.reset(key, n)),  # type: ignore[arg-type]
        np.zeros(n, np.int32),  # type: ignore[arg-type]
        np.zeros(n, np.float32),  # type: ignore[arg-type]
    )


def roll_out(
    environment: Task, policy: Policy, critic: MLP, running: Running, key: Array, length: int
) -> tuple[Running, Rollout]:
    """Roll out ``length`` steps of every episode; new ones begin where old ones end.

    With a compiled environment this is a pure function that can be part of a larger program.
    """
    if isinstance(environment, Environment):
        return _roll_out_compiled(environment, policy, critic, running, key, length)
    return _roll_out_on_host(environment, policy, critic, running, key, length)


def play(environment: Task, policy: Policy, key: Array, n: int, *, deterministic: bool = False) -> Episodes:
    """Play ``n`` whole episodes; ``deterministic`` takes the policy's mode instead of a draw."""
    if isinstance(environment, Environment):
        return Episodes(*map(np.asarray, _play_compiled(environment, policy, key, n, deterministic)))
    return _play_on_host(environment, policy, key, n, deterministic)


def finished_returns(before: Running, rollout: Rollout) -> Float[np.ndarray, " episodes"]:
    """Return the returns of the episodes that ended in a rollout, which began at ``before``."""
    rewards = np.asarray(rollout.rewards)
    done = np.asarray(rollout.terminated | rollout.truncated)
    returns, sums = [], np.array(before.returns)
    for reward, ended in zip(rewards, done, strict=True):
        sums += reward
        returns.append(sums[ended])
        sums[ended] = 0
    return np.concatenate(returns)


# -- drawing actions ----------------------------------------------------------------------------------


def _noise(policy: Policy, key: Array, shape: tuple[int, ...]) -> Array:
    if isinstance(policy, CategoricalPolicy):
        return jax.random.gumbel(key, (*shape, policy.actions.n), DTYPE)
    return jax.random.normal(key, (*shape, policy.actions.size), DTYPE)


def _act(policy: Policy, observations: Array, noise: Array) -> Array:
    """Draw actions from the policy as a function of standard noise."""
    if isinstance(policy, CategoricalPolicy):
        return jnp.argmax(policy.log_probs(observations) + noise, -1).astype(jnp.int32)
    return policy.mode(observations) + jnp.exp(policy.log_deviation) * noise


def _host_actor(policy: Policy) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Build :func:`_act` in NumPy."""
    mean, deviation = np.asarray(policy.norm.mean), np.asarray(policy.norm.deviation)
    if isinstance(policy, GaussianPolicy):
        network, spread = _host_network(policy.mean), np.exp(np.asarray(policy.log_deviation))
    else:
        network = _host_network(policy.logits)

    def act(observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        scaled = (observations - mean) / deviation
        outputs = network(np.minimum(np.maximum(scaled, -10, out=scaled), 10, out=scaled))
        if isinstance(policy, CategoricalPolicy):
            return np.argmax(outputs + noise, -1).astype(np.int32)
        return outputs + spread * noise

    return act


def _host_network(mlp: MLP) -> Callable[[np.ndarray], np.ndarray]:
    weights = [(np.asarray(w), np.asarray(b)) for w, b in zip(mlp.weights, mlp.biases, strict=True)]
    tanh = mlp.activation == "tanh"

    def forward(x: np.ndarray) -> np.ndarray:
        for w, b in weights[:-1]:
            x = x @ w
            x += b
            x = np.tanh(x, out=x) if tanh else np.maximum(x, 0, out=x)
        w, b = weights[-1]
        return x @ w + b

    return forward


# -- tasks that compile -------------------------------------------------------------------------------


def _roll_out_compiled(
    environment: Environment, policy: Policy, critic: MLP, running: Running, key: Array, length: int
) -> tuple[Running, Rollout]:
    n = running.steps.shape[0]
    k_noise, k_starts = jax.random.split(key)
    noise = _noise(policy, k_noise, (length, n))
    starts = jax.vmap(jax.vmap(environment.reset))(jax.random.split(k_starts, (length, n)))
    observe, step = jax.vmap(environment.observe), jax.vmap(environment.step)

    def advance(running: Running, inputs: tuple[Array, Array]) -> tuple[Running, tuple[Array, ...]]:
        noise, start = inputs
        observations = observe(running.states)
        actions = _act(policy, observations, noise)
        states, rewards, terminated = step(running.states, actions)
        steps, rewards = running.steps + 1, rewards.astype(DTYPE)
        truncated = (steps >= environment.horizon) & ~terminated
        done = terminated | truncated
        following = Running(
            jnp.where(done.reshape(n, *[1] * (states.ndim - 1)), start, states),
            jnp.where(done, 0, steps),
            jnp.where(done, 0, running.returns + rewards),
        )
        return following, (observations, actions, observe(states), rewards, terminated, truncated)

    running, recorded = lax.scan(advance, running, (noise, starts))
    return running, _judged(policy, critic, *recorded)


@partial(jax.jit, static_argnames=("environment", "n", "deterministic"))
def _play_compiled(
    environment: Environment, policy: Policy, key: Array, n: int, deterministic: bool
) -> tuple[Array, ...]:
    k_noise, k_starts = jax.random.split(key)
    noise = _noise(policy, k_noise, (environment.horizon, n))
    states = jax.vmap(environment.reset)(jax.random.split(k_starts, n))
    observe, step = jax.vmap(environment.observe), jax.vmap(environment.step)

    def advance(carry: tuple[Array, Array], noise: Array) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        states, alive = carry
        observations = observe(states)
        actions = policy.mode(observations) if deterministic else _act(policy, observations, noise)
        actions = actions.astype(jnp.int32) if policy.actions.discrete else actions
        states, rewards, terminated = step(states, actions)
        rewards = jnp.where(alive, rewards, 0).astype(DTYPE)
        return (states, alive & ~terminated), (observations, actions, rewards, alive, alive & terminated)

    (states, _), recorded = lax.scan(advance, (states, jnp.ones(n, bool)), noise)
    observations, actions, rewards, alive, terminated = (jnp.swapaxes(x, 0, 1) for x in recorded)
    observations = jnp.concatenate([observations, observe(states)[:, None]], 1)
    return observations, actions, rewards, alive.sum(1), terminated.any(1)


# -- tasks on the host --------------------------------------------------------------------------------


def _roll_out_on_host(
    environment: HostEnvironment, policy: Policy, critic: MLP, running: Running, key: Array, length: int
) -> tuple[Running, Rollout]:
    states, steps, returns = (np.array(x) for x in running)
    n, d = len(steps), environment.observation_size
    k_noise, k_starts = jax.random.split(key)
    noise = np.asarray(_noise_on_host(policy, k_noise, (length, n)))
    starts = _starts(environment, k_starts)
    act = _host_actor(policy)
    observations = np.empty((length, n, d), np.float32)
    next_observations = np.empty((length, n, d), np.float32)
    actions = _no_actions(policy, length, n)
    rewards = np.empty((length, n), np.float32)
    terminated, truncated = np.zeros((length, n), bool), np.zeros((length, n), bool)
    seen = environment.observe(states)
    for t in range(length):
        observations[t] = seen
        actions[t] = act(observations[t], noise[t])
        states, rewards[t], terminated[t] = environment.step(states, actions[t])
        seen = environment.observe(states)
        next_observations[t] = seen
        steps += 1
        returns += rewards[t]
        truncated[t] = (steps >= environment.horizon) & ~terminated[t]
        done = terminated[t] | truncated[t]
        if done.any():
            states = np.array(states)
            states[done] = list(islice(starts, int(done.sum())))
            seen = environment.observe(states)
            steps[done], returns[done] = 0, 0
    recorded = (observations, actions, next_observations, rewards, terminated, truncated)
    rollout = _judged_on_host(policy, critic, *recorded)
    return Running(np.asarray(states), steps, returns), rollout  # type: ignore[arg-type]


def _play_on_host(
    environment: HostEnvironment, policy: Policy, key: Array, n: int, deterministic: bool
) -> Episodes:
    length, d = environment.horizon, environment.observation_size
    k_noise, k_starts = jax.random.split(key)
    noise = np.asarray(_noise_on_host(policy, k_noise, (length, n)))
    if deterministic:
        noise = np.zeros_like(noise)
    act = _host_actor(policy)
    states = np.array(environment.reset(k_starts, n))
    observations = np.zeros((n, length + 1, d), np.float32)
    observations[:, 0] = environment.observe(states)
    actions = _no_actions(policy, n, length)
    rewards, lengths = np.zeros((n, length), np.float32), np.zeros(n, int)
    terminated, alive = np.zeros(n, bool), np.arange(n)
    for t in range(length):
        actions[alive, t] = act(observations[alive, t], noise[t, alive])
        states, rewards[alive, t], ended = environment.step(states, actions[alive, t])
        observations[alive, t + 1] = environment.observe(states)
        lengths[alive] += 1
        terminated[alive] = ended
        alive, states = alive[~ended], states[~ended]
        if not len(alive):
            break
    return Episodes(observations, actions, rewards, lengths, terminated)


def _no_actions(policy: Policy, *shape: int) -> np.ndarray:
    if policy.actions.discrete:
        return np.zeros(shape, np.int32)
    return np.zeros((*shape, policy.actions.size), np.float32)


def _starts(environment: HostEnvironment, key: Array) -> Iterator[np.ndarray]:
    """Yield first states, drawn some at a time."""
    for i in count():
        yield from environment.reset(jax.random.fold_in(key, i), _SPARE_STARTS)


_noise_on_host = jax.jit(_noise, static_argnums=2)


def _judged(
    policy: Policy,
    critic: MLP,
    observations: Array,
    actions: Array,
    next_observations: Array,
    rewards: Array,
    terminated: Array,
    truncated: Array,
) -> Rollout:
    """Complete a recorded rollout with the log-probabilities and the values of all its steps."""
    log_probs = policy.log_prob(observations, actions)
    values = critic(policy.norm(observations))[..., 0]
    return Rollout(
        observations, actions, next_observations, rewards, terminated, truncated, log_probs, values
    )


_judged_on_host = jax.jit(_judged)
