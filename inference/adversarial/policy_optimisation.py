"""Proximal policy optimisation (Schulman et al. 2017): the generator for tasks without an exact planner.

Three functions on one state, separate so that a learner can insert its own reward before the improvement::

    agent = ppo(environment)
    state = agent.init(key)
    state, rollout = agent.collect(state)
    state = agent.improve(state, rollout, rewards)

With a compiled :class:`Environment` all three can be part of a larger compiled program.

The end of an episode enters the advantages. If only the time ran out, the value of the true successor counts;
if the task terminated, it does not. The caller adds a reward after termination (the absorbing state) to the
reward of the last step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from ...extras import required
from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment, Rollout
from ...models.networks.modules import DTYPE, MLP, CategoricalPolicy, GaussianPolicy, Policy, RunningNorm
from .rollouts import Episodes, Running, Task, begin, finished_returns, play, roll_out

if TYPE_CHECKING:
    import equinox as eqx
    import optax
else:
    eqx, optax = required("equinox"), required("optax")


class Settings(NamedTuple):
    """Settings of an agent; the defaults are those of Stable-Baselines3, with scaled observations.

    Fields
    ------
    n_envs, n_steps : int, episodes side by side, and steps of each between improvements
    gamma, gae_lambda : float, the discount, and the weight of longer estimates of the advantage
    clip : float, range of the ratio of new to old probabilities that counts
    epochs, minibatch : int, passes over a rollout, and steps in each gradient
    learning_rate : float, of Adam
    decay_over : int, environment steps over which the rate falls linearly to zero; 0 for a constant rate
    entropy, value_coefficient, max_grad_norm : float
    hidden : layers of the policy and of the critic
    log_deviation : float, initial value for continuous actions
    scale_observations : True if networks see observations in deviations from their mean so far
    scale_rewards : True to divide rewards by the deviation of discounted returns so far, and clip them at
        ten: for rewards of unknown size, or if large values of the critic would dominate the policy
    reward_memory : float, number of steps that this deviation averages; lower for a reward that is learned
    """

    n_envs: int = 8
    n_steps: int = 128
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    epochs: int = 10
    minibatch: int = 64
    learning_rate: float = 3e-4
    decay_over: int = 0
    entropy: float = 0.0
    value_coefficient: float = 0.5
    max_grad_norm: float = 0.5
    hidden: tuple[int, ...] = (32, 32)
    log_deviation: float = 0.0
    scale_observations: bool = True
    scale_rewards: bool = False
    reward_memory: float = math.inf

    @property
    def steps(self) -> int:
        """Environment steps of one rollout."""
        return self.n_envs * self.n_steps


@shown_briefly
class ReturnScale(NamedTuple):
    """Spread of discounted returns so far.

    Fields
    ------
    returns : float32 ``[n]``, of the current episodes, the latest reward last
    norm : RunningNorm, of these returns
    """

    returns: Float[Array, " n"]
    norm: RunningNorm


@shown_briefly
class PPOState(NamedTuple):
    """State of an agent in the middle of its episodes, sufficient to continue.

    Fields
    ------
    policy : the policy network, with the norm of observations
    critic : MLP from a scaled observation to its value
    optimiser : Adam's, of all weights in one vector
    running : the current episodes
    scale : ReturnScale
    updates : int32, improvements so far
    key : random key
    """

    policy: Policy
    critic: MLP
    optimiser: Any
    running: Running
    scale: ReturnScale
    updates: Int[Array, ""]
    key: Array


@shown_briefly
class Training(NamedTuple):
    """Progress of training, one entry for each rollout.

    Fields
    ------
    steps : int ``[U]``, environment steps so far
    returns : float ``[U]``, mean return of the episodes that ended in it; NaN if none did
    episodes : int ``[U]``, number of these episodes
    """

    steps: Int[np.ndarray, " U"]
    returns: Float[np.ndarray, " U"]
    episodes: Int[np.ndarray, " U"]


@shown_briefly
class PPO(NamedTuple):
    """An agent: its task, its settings, and its functions; made by :func:`ppo`.

    Fields
    ------
    init : ``(key) -> PPOState``
    collect : ``(state) -> (state, Rollout)``, with the current policy
    improve : ``(state, rollout, rewards [T, n]) -> state``
    train : ``(state, steps) -> (state, Training)``, at least that many steps by the environment's reward
    evaluate : ``(policy, key, episodes, deterministic=True) -> Episodes``
    """

    environment: Task
    settings: Settings
    init: Callable[[Array], PPOState]
    collect: Callable[[PPOState], tuple[PPOState, Rollout]]
    improve: Callable[[PPOState, Rollout, ArrayLike], PPOState]
    train: Callable[[PPOState, int], tuple[PPOState, Training]]
    evaluate: Callable[..., Episodes]


def ppo(environment: Task, **settings: Any) -> PPO:
    """Build an agent for a task from the :class:`Settings` given by name.

    Scaled observations help if their coordinates differ in size, as a robot's do. They hinder the cart-pole,
    which is learned in 25,000 steps with ``learning_rate=1e-3``, ``scale_observations=False`` and
    ``scale_rewards=True``. Raises ``ValueError`` for a setting out of its range.

    See Also
    --------
    i2rl.inference.airl : learns a reward with this agent
    i2rl.domains.cart_pole : the task

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import cart_pole
    >>> from i2rl.inference import ppo
    >>> agent = ppo(cart_pole(), n_envs=2, n_steps=8, minibatch=8)
    >>> state, rollout = agent.collect(agent.init(jax.random.key(0)))
    >>> rollout.observations.shape, agent.settings.steps
    ((8, 2, 4), 16)
    """
    chosen = _checked(Settings(**settings))

    def evaluate(policy: Policy, key: Array, episodes: int = 10, deterministic: bool = True) -> Episodes:
        return play(environment, policy, key, episodes, deterministic=deterministic)

    return PPO(
        environment,
        chosen,
        partial(_init, environment, chosen),
        partial(_collect, environment, chosen),
        partial(_improve_with, chosen),
        partial(_train, environment, chosen),
        evaluate,
    )


def advantages(
    rewards: Float[Array, "T n"],
    values: Float[Array, "T n"],
    next_values: Float[Array, "T n"],
    terminated: Array,
    truncated: Array,
    gamma: float,
    gae_lambda: float,
) -> Float[Array, "T n"]:
    """Return generalised advantage estimates (Schulman et al. 2016, Eq. 16).

    ``A_t = sum_l (gamma lambda)^l (r_{t+l} + gamma V(s_{t+l+1}) - V(s_{t+l}))``, up to the end of the episode
    or of the rollout. ``next_values`` are of the true successors; those of terminated steps do not count.
    """
    surprises = rewards + gamma * jnp.where(terminated, 0, next_values) - values
    onwards = (1 - (terminated | truncated).astype(DTYPE)) * (gamma * gae_lambda)

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        surprise, onward = step
        now = surprise + onward * later
        return now, now

    return lax.scan(back, jnp.zeros_like(surprises[0]), (surprises, onwards), reverse=True)[1]


@shown_briefly
class Sample(NamedTuple):
    """Minibatch of a gradient: steps of a rollout with their estimates, ``[m, ...]``."""

    observations: Float[Array, "m d"]
    actions: Array
    log_probs: Float[Array, " m"]
    advantages: Float[Array, " m"]
    targets: Float[Array, " m"]


def loss(policy: Policy, critic: MLP, sample: Sample, settings: Settings) -> Float[Array, ""]:
    """Compute the clipped objective (Schulman et al. 2017, Eq. 9), negated, with scaled advantages."""
    weight = sample.advantages
    weight = (weight - weight.mean()) / (weight.std() + 1e-8)
    ratio = jnp.exp(policy.log_prob(sample.observations, sample.actions) - sample.log_probs)
    clipped = jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip)
    gain = jnp.minimum(ratio * weight, clipped * weight).mean()
    values = critic(policy.norm(sample.observations))[..., 0]
    error = jnp.mean((values - sample.targets) ** 2)
    entropy = policy.entropy(sample.observations).mean() if settings.entropy else 0.0
    return -gain + settings.value_coefficient * error - settings.entropy * entropy


# -- the functions of an agent ------------------------------------------------------------------------


def _init(environment: Task, settings: Settings, key: Array) -> PPOState:
    k_policy, k_critic, k_starts, key = jax.random.split(key, 4)
    size, actions = environment.observation_size, environment.actions
    policy: Policy
    if actions.discrete:
        policy = CategoricalPolicy.create(k_policy, size, actions, settings.hidden)
    else:
        policy = GaussianPolicy.create(k_policy, size, actions, settings.hidden, settings.log_deviation)
    critic = MLP.create(k_critic, (size, *settings.hidden, 1))
    weights, _ = ravel_pytree(_weights(policy, critic))
    scale = ReturnScale(jnp.zeros(settings.n_envs, DTYPE), RunningNorm.create(1))
    running = begin(environment, k_starts, settings.n_envs)
    optimiser = _adam(settings).init(weights)
    return PPOState(policy, critic, optimiser, running, scale, jnp.zeros((), jnp.int32), key)


def _collect(environment: Task, settings: Settings, state: PPOState) -> tuple[PPOState, Rollout]:
    roll = _roll_compiled if isinstance(environment, Environment) else _roll
    return roll(environment, settings.n_steps, state)


def _roll(environment: Task, length: int, state: PPOState) -> tuple[PPOState, Rollout]:
    key, k_roll = jax.random.split(state.key)
    running, rollout = roll_out(environment, state.policy, state.critic, state.running, k_roll, length)
    return state._replace(running=running, key=key), rollout


_roll_compiled = jax.jit(_roll, static_argnums=(0, 1))


def _improve_with(settings: Settings, state: PPOState, rollout: Rollout, rewards: ArrayLike) -> PPOState:
    """Improve once: advantages, then epochs of minibatches, then the norm of observations."""
    expected = (settings.n_steps, settings.n_envs)
    if np.shape(rewards) != expected or rollout.rewards.shape != expected:
        raise ValueError(
            f"an agent of {settings.n_steps} steps in {settings.n_envs} environments improves by rewards of "
            f"shape {expected}; got {np.shape(rewards)} for a rollout of {rollout.rewards.shape}"
        )
    # The host's episodes stay on the host, bit by bit.
    improved = _improve(settings, state._replace(running=None), rollout, rewards)  # type: ignore[arg-type]
    return improved._replace(running=state.running)


@partial(jax.jit, static_argnames="settings")
def _improve(settings: Settings, state: PPOState, rollout: Rollout, rewards: ArrayLike) -> PPOState:
    policy, critic = state.policy, state.critic
    rewards = jnp.asarray(rewards, DTYPE)
    done = rollout.terminated | rollout.truncated
    scale = state.scale
    if settings.scale_rewards:
        scale = _spread(scale, rewards, done, settings)
        rewards = jnp.clip(rewards / scale.norm.deviation, -10, 10)
    next_values = critic(policy.norm(rollout.next_observations))[..., 0]
    estimates = advantages(
        rewards,
        rollout.values,
        next_values,
        rollout.terminated,
        rollout.truncated,
        settings.gamma,
        settings.gae_lambda,
    )
    sample = Sample(
        rollout.observations, rollout.actions, rollout.log_probs, estimates, estimates + rollout.values
    )
    sample = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), sample)
    key, k_order = jax.random.split(state.key)
    policy, critic, optimiser = _descend(settings, state, sample, k_order)
    if settings.scale_observations:
        # Last: the ratios above use probabilities under the norm with which the actions were drawn.
        policy = eqx.tree_at(lambda p: p.norm, policy, policy.norm.update(rollout.observations))
    return state._replace(
        policy=policy, critic=critic, optimiser=optimiser, scale=scale, updates=state.updates + 1, key=key
    )


def _descend(settings: Settings, state: PPOState, sample: Sample, key: Array) -> tuple[Policy, MLP, Any]:
    """Run Adam over all minibatches of all epochs, on all weights in one vector."""
    flat, unravel = ravel_pytree(_weights(state.policy, state.critic))
    adam = _adam(settings)
    rate = jnp.asarray(settings.learning_rate, DTYPE)
    if settings.decay_over:
        progress = state.updates.astype(DTYPE) * settings.steps / settings.decay_over
        rate = rate * jnp.maximum(0, 1 - progress)

    def objective(weights: tuple[Policy, MLP], batch: Sample) -> Array:
        return loss(*_networks(weights, state.policy.norm), batch, settings)

    def descend(carry: tuple[Array, Any], batch: Sample) -> tuple[tuple[Array, Any], None]:
        flat, optimiser = carry
        gradient, _ = ravel_pytree(jax.grad(objective)(unravel(flat), batch))
        change, optimiser = adam.update(gradient, optimiser)
        return (flat - rate * change, optimiser), None

    def epoch(carry: tuple[Array, Any], key: Array) -> tuple[tuple[Array, Any], None]:
        order = jax.random.permutation(key, settings.steps).reshape(-1, settings.minibatch)
        return lax.scan(descend, carry, jax.tree.map(lambda x: x[order], sample))

    (flat, optimiser), _ = lax.scan(epoch, (flat, state.optimiser), jax.random.split(key, settings.epochs))
    return *_networks(unravel(flat), state.policy.norm), optimiser


def _train(environment: Task, settings: Settings, state: PPOState, steps: int) -> tuple[PPOState, Training]:
    ended = []
    for _ in range(math.ceil(steps / settings.steps)):
        before = state.running
        state, rollout = _collect(environment, settings, state)
        state = _improve_with(settings, state, rollout, rollout.rewards)
        ended.append(finished_returns(before, rollout))
    rounds = int(state.updates) - len(ended) + 1 + np.arange(len(ended))
    means = [returns.mean() if len(returns) else np.nan for returns in ended]
    counts = [len(returns) for returns in ended]
    return state, Training(rounds * settings.steps, np.array(means, float), np.array(counts, int))


# -- parts of the functions -----------------------------------------------------------------------------


def _weights(policy: Policy, critic: MLP) -> tuple[Policy, MLP]:
    """Return the networks without the norm of observations, which is not learned by gradients."""
    return eqx.tree_at(lambda p: p.norm, policy, None), critic


def _networks(weights: tuple[Policy, MLP], norm: RunningNorm) -> tuple[Policy, MLP]:
    policy, critic = weights
    return eqx.tree_at(lambda p: p.norm, policy, norm, is_leaf=lambda x: x is None), critic


def _adam(settings: Settings) -> Any:
    return optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), optax.scale_by_adam(eps=1e-5))


def _spread(scale: ReturnScale, rewards: Array, done: Array, settings: Settings) -> ReturnScale:
    def accumulate(returns: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, done = step
        returns = settings.gamma * returns + reward
        return jnp.where(done, 0, returns), returns

    last, returns = lax.scan(accumulate, scale.returns, (rewards, done))
    norm = scale.norm.update(returns[..., None])
    if math.isfinite(settings.reward_memory):
        kept = jnp.minimum(1, settings.reward_memory / norm.count)
        norm = RunningNorm(norm.count * kept, norm.mean, norm.scatter * kept)
    return ReturnScale(last, norm)


def _checked(settings: Settings) -> Settings:
    for name in ("n_envs", "n_steps", "epochs", "minibatch"):
        if getattr(settings, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(settings, name)}")
    if settings.steps % settings.minibatch:
        raise ValueError(
            f"a rollout of {settings.n_envs} x {settings.n_steps} = {settings.steps} steps does not divide "
            f"into minibatches of {settings.minibatch}"
        )
    for name in ("gamma", "gae_lambda"):
        if not 0 <= getattr(settings, name) <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {getattr(settings, name)}")
    for name in ("clip", "learning_rate", "max_grad_norm", "reward_memory"):
        if not getattr(settings, name) > 0:
            raise ValueError(f"{name} must be positive, got {getattr(settings, name)}")
    return settings._replace(hidden=tuple(settings.hidden))
