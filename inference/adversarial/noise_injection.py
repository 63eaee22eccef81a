"""Noisy-AIRL: AIRL whose generator also acts with random actions (Chen et al. 2020).

The first step of robust-AIRL's baseline, :mod:`~i2rl.inference.adversarial.self_supervised` (section 7.3).
The generator acts side by side in environments that replace its actions by random ones, each with its own
probability. The discriminator thereby sees worse behaviour than the generator's and learns a reward that
holds beyond the states of the expert. Importance weights correct for the generated actions that do not come
from the policy.

Each step has two actions: the *intended* one, drawn from the policy, and the *executed* one. A rollout holds
the intended actions, so its log-probabilities are those of the policy and PPO improves on-policy. The
discriminator sees one of them (``action``). The released code uses the intended action and its weight; action
and successor then do not match, which a reward of states alone does not notice. The weights of the executed
action are the correct ones for the mixture: ``E_executed[w g] = E_policy[g]`` at each state.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ...extras import required
from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment, HostEnvironment, Rollout
from ...models.networks.modules import DTYPE, MLP, ActionSpace, Policy, ShapedReward
from ...models.observation.recordings import Recording
from ..sessions.learner import Learner
from .discriminator import Discriminator, Losses, Transitions, cross_entropy
from .learner import (
    AdversarialInfo,
    AdversarialState,
    Task,
    blank_steps,
    identity,
    remembered,
    session_info,
)
from .policy_optimisation import PPO, PPOState
from .rollouts import Running, finished_returns, roll_out
from .truth import reported_steps, within_bounds
from .updates import Objective, discriminator_updates

if TYPE_CHECKING:
    import optax
else:
    optax = required("optax")

LEVELS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.10, 0.15, 0.20, 0.25)
"""Probabilities of a random action in the generator's ten environments, as released."""

ACTIONS = ("intended", "executed")

# -- random actions ---------------------------------------------------------------------------------------


def log_uniform(actions: ActionSpace, chosen: ArrayLike) -> Float[Array, "..."]:
    """Return the log-density of a uniformly random action: minus infinity beyond the bounds."""
    chosen = jnp.asarray(chosen)
    if actions.discrete:
        return jnp.full(chosen.shape, -np.log(actions.n), DTYPE)
    low, high = np.asarray(actions.low), np.asarray(actions.high)
    inside = jnp.all((chosen >= low) & (chosen <= high), -1)
    return jnp.where(inside, -np.log(high - low).sum(), -jnp.inf).astype(DTYPE)


def importance_weights(
    policy: Policy, observations: Float[Array, "... d"], chosen: Array, levels: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return ``pi(a|s) / (eps u(a) + (1 - eps) pi(a|s))``, the weight of an action if ``eps`` are random.

    ``u`` is uniform over the actions. The weight is at most ``1 / (1 - eps)``, and 1 without noise.
    """
    log_pi = policy.log_prob(observations, chosen)
    levels = jnp.asarray(levels, DTYPE)
    random = jnp.log(levels) + log_uniform(policy.actions, chosen)
    return jnp.exp(log_pi - jnp.logaddexp(random, jnp.log1p(-levels) + log_pi))


def _random_actions(
    key: Array, actions: ActionSpace, levels: Float[Array, " n"], length: int
) -> tuple[Array, Array]:
    """Draw replacements for ``length`` steps: flags ``[length, n]`` and random actions."""
    k_whether, k_what = jax.random.split(key)
    shape = (length, levels.shape[0])
    replaced = jax.random.uniform(k_whether, shape, DTYPE) < levels
    if actions.discrete:
        return replaced, jax.random.randint(k_what, shape, 0, actions.n, jnp.int32)
    low, high = jnp.asarray(actions.low, DTYPE), jnp.asarray(actions.high, DTYPE)
    return replaced, jax.random.uniform(k_what, (*shape, actions.size), DTYPE, low, high)


def _replace(replaced: Any, random: Any, intended: Any) -> Any:
    xp = np if isinstance(intended, np.ndarray) else jnp
    return xp.where(replaced[..., None] if intended.ndim > replaced.ndim else replaced, random, intended)


# -- acting with noise ------------------------------------------------------------------------------------


@shown_briefly
class NoisyRollout(NamedTuple):
    """Rollout in which some actions were replaced.

    Fields
    ------
    rollout : Rollout, with the intended actions
    executed : int32 ``[T, n]`` or float32 ``[T, n, k]``, the executed actions
    """

    rollout: Rollout
    executed: Array

    def steps(self, action: str) -> Transitions:
        """Return transitions ``[T, n, ...]`` with the ``intended`` or the ``executed`` actions, as drawn."""
        chosen = self.executed if action == "executed" else self.rollout.actions
        return Transitions(
            self.rollout.observations, chosen, self.rollout.next_observations, self.rollout.terminated
        )


def roll_out_noisily(
    environment: Environment | HostEnvironment,
    policy: Policy,
    critic: MLP,
    running: Running,
    levels: ArrayLike,
    key: Array,
    length: int,
) -> tuple[Running, NoisyRollout]:
    """Roll out ``length`` steps of every episode, with random actions in the ``i``-th at rate ``levels[i]``.

    New episodes begin where old ones end, as in :func:`~i2rl.inference.adversarial.rollouts.roll_out`. Noise
    is drawn before the first step.
    """
    levels = jnp.asarray(levels, DTYPE)
    if isinstance(environment, Environment):
        return _compiled(environment, length, policy, critic, running, levels, key)
    k_roll, k_noise = jax.random.split(key)
    replaced, random = map(np.asarray, _random_on_host(k_noise, environment.actions, levels, length))
    disturbed = _Disturbed(environment, replaced, random)
    running, rollout = roll_out(disturbed, policy, critic, running, k_roll, length)
    executed = _replace(replaced, random, np.asarray(rollout.actions))
    return running, NoisyRollout(rollout, jnp.asarray(executed))


_random_on_host = jax.jit(_random_actions, static_argnums=(1, 3))


class _Disturbed:
    """A task on the host in one rollout: its steps in sequence, some with replaced actions."""

    def __init__(self, environment: HostEnvironment, replaced: np.ndarray, random: np.ndarray) -> None:
        self.name, self.observation_size = environment.name, environment.observation_size
        self.actions, self.horizon = environment.actions, environment.horizon
        self.reset, self.observe = environment.reset, environment.observe
        self._step, self._noise = environment.step, zip(replaced, random, strict=True)

    def step(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step the task with the executed actions."""
        return self._step(states, _replace(*next(self._noise), actions))


@partial(jax.jit, static_argnums=(0, 1))
def _compiled(
    environment: Environment,
    length: int,
    policy: Policy,
    critic: MLP,
    running: Running,
    levels: Float[Array, " n"],
    key: Array,
) -> tuple[Running, NoisyRollout]:
    n = levels.shape[0]
    k_noise, k_starts, k_actions = jax.random.split(key, 3)
    replaced, random = _random_actions(k_noise, environment.actions, levels, length)
    observe, step = jax.vmap(environment.observe), jax.vmap(environment.step)

    def advance(running: Running, inputs: tuple[Array, ...]) -> tuple[Running, tuple[Array, ...]]:
        replaced, random, k_start, k_action = inputs
        observations = observe(running.states)
        intended = policy.sample(k_action, observations).astype(random.dtype)
        executed = _replace(replaced, random, intended)
        states, rewards, terminated = step(running.states, executed)
        rewards, steps = rewards.astype(DTYPE), running.steps + 1
        truncated = (steps >= environment.horizon) & ~terminated
        done = terminated | truncated
        starts = jax.vmap(environment.reset)(jax.random.split(k_start, n))
        following = Running(
            jnp.where(done.reshape(n, *[1] * (states.ndim - 1)), starts, states),
            jnp.where(done, 0, steps),
            jnp.where(done, 0, running.returns + rewards),
        )
        recorded = (observations, intended, observe(states), rewards, terminated, truncated)
        return following, (*recorded, executed)

    keys = (jax.random.split(k_starts, length), jax.random.split(k_actions, length))
    running, recorded = lax.scan(advance, running, (replaced, random, *keys))
    observations, intended, following, rewards, terminated, truncated, executed = recorded
    log_probs, values = policy.log_prob(observations, intended), critic(policy.norm(observations))[..., 0]
    rollout = Rollout(observations, intended, following, rewards, terminated, truncated, log_probs, values)
    return running, NoisyRollout(rollout, executed)


# -- the learner ------------------------------------------------------------------------------------------


class NoisyTraining(NamedTuple):
    """Settings of a session's training.

    Fields
    ------
    iterations : int, of generator and discriminator, in a session
    updates : int, steps of the discriminator in an iteration
    batch : int, expert steps (and as many generated ones) in a step of the discriminator
    learning_rate : float, of the discriminator's Adam
    replay : int
        Iterations whose generated steps the discriminator draws from. Their probabilities are those under
        the current policy. The released code uses the policy of their time, for which the log-odds are
        wrong.
    levels : probabilities of a random action, dealt out to the environments in turn
    action : "intended" (as released) or "executed", the action that the discriminator sees and weighs
    """

    iterations: int = 10
    updates: int = 10
    batch: int = 32
    learning_rate: float = 1e-3
    replay: int = 20
    levels: Sequence[float] = LEVELS
    action: str = "intended"

    def checked(self, environments: int) -> NoisyTraining:
        """Validate the settings and return them. Raises ``ValueError`` naming an invalid field."""
        for name in ("iterations", "updates", "batch", "replay"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.action not in ACTIONS:
            raise ValueError(f"`action` must be one of {', '.join(ACTIONS)}; got {self.action!r}")
        for i, level in enumerate(self.levels):
            if not 0 <= level < 1:
                raise ValueError(f"noise level {i} must be a probability below 1, got {level}")
        if not len(self.levels) or environments % len(self.levels):
            raise ValueError(
                f"{len(self.levels)} noise levels cannot be dealt out evenly to {environments} environments"
            )
        return self


def noisy_airl(
    agent: PPO,
    discriminator: Discriminator,
    training: NoisyTraining | None = None,
    configuration: Mapping[str, Any] | None = None,
) -> Learner:
    """Build noisy-AIRL as a learner of the session protocol; its demonstrations are :class:`Recording`.

    State and info are those of :func:`~i2rl.inference.adversarial.learner.adversarial`, all carried.
    ``discriminator`` is :func:`~i2rl.inference.adversarial.discriminator.airl_discriminator`, with
    ``state_only=True`` for the published method (whose discount is 1; here it must be below 1, so that the
    value after termination is finite). ``agent`` has as many environments as there are noise levels, or a
    multiple. ``configuration`` adds to the configuration that identifies the learner to a journal.

    See Also
    --------
    i2rl.inference.ssrr : regresses a reward on ranked trajectories
    i2rl.inference.airl : the learner without injected noise

    Examples
    --------
    >>> from i2rl.domains import cart_pole
    >>> from i2rl.inference import noisy_airl, ppo
    >>> from i2rl.inference.adversarial.discriminator import airl_discriminator
    >>> agent = ppo(cart_pole(), n_envs=10, n_steps=8, minibatch=8)
    >>> discriminator = airl_discriminator(4, agent.environment.actions, state_only=True)
    >>> learner = noisy_airl(agent, discriminator)
    >>> learner.name, learner.configuration["levels"]
    ('noisy-AIRL', (0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.1, 0.15, 0.2, 0.25))
    """
    environment, settings = agent.environment, agent.settings
    n, size = settings.n_envs, settings.steps
    how = (training or NoisyTraining()).checked(n)
    levels = jnp.tile(jnp.asarray(how.levels, DTYPE), n // len(how.levels))
    task = Task(environment.name, environment.observation_size, environment.actions)
    start, trained = discriminator_updates(
        _objective(discriminator, levels), how.updates, how.batch, how.learning_rate
    )

    @jax.jit
    def rewarded(network: ShapedReward, policy: Policy, noisy: NoisyRollout) -> Float[Array, "T n"]:
        return discriminator.rewards(network, policy, _within(task.actions, noisy.steps("intended")))

    def init(key: Array) -> AdversarialState:
        k_network, k_agent, key = jax.random.split(as_key(key), 3)
        network = discriminator.init(k_network)
        zero = jnp.zeros((), jnp.int64)
        return AdversarialState(
            session=zero,
            key=key,
            network=network,
            optimiser=start(network),
            generator=agent.init(k_agent),
            replay=blank_steps(task, (how.replay, size)),
            iterations=zero,
            pairs=zero,
            sensor=(),
        )

    def update(state: AdversarialState, recording: Recording) -> tuple[AdversarialState, AdversarialInfo]:
        began = time.perf_counter()
        task.require(recording)
        expert = within_bounds(task.actions, reported_steps(recording))
        key, network, memory = state.key, state.network, state.optimiser
        acting, replay, iterations = state.generator, state.replay, int(state.iterations)
        losses, returns = [], []
        for _ in range(how.iterations):
            key, k_collect, k_updates = jax.random.split(key, 3)
            before = acting.running
            acting, noisy = _acted(agent, acting, levels, k_collect)
            replay = remembered(replay, noisy.steps(how.action), iterations % how.replay)
            iterations += 1
            network, memory, last = trained(
                network, memory, acting.policy, expert, replay, min(iterations, how.replay), k_updates
            )
            acting = agent.improve(acting, noisy.rollout, rewarded(network, acting.policy, noisy))
            losses.append(last)
            finished = finished_returns(before, noisy.rollout)
            returns.append(finished.mean() if len(finished) else np.nan)
        state = AdversarialState(
            session=state.session + 1,
            key=key,
            network=network,
            optimiser=memory,
            generator=acting,
            replay=replay,
            iterations=jnp.asarray(iterations, jnp.int64),
            pairs=state.pairs + int(np.sum(recording.live)),
            sensor=(),
        )
        return state, session_info(state, expert, losses, returns, began)

    # The field's name in the journals of earlier versions.
    stored = {"shown" if name == "action" else name: x for name, x in how._asdict().items()}
    known = {**identity(agent, discriminator), **stored, **dict(configuration or {})}
    return Learner("noisy-AIRL", task, known, init, update)  # type: ignore[arg-type]


def _acted(
    agent: PPO, state: PPOState, levels: Float[Array, " n"], key: Array
) -> tuple[PPOState, NoisyRollout]:
    running, noisy = roll_out_noisily(
        agent.environment, state.policy, state.critic, state.running, levels, key, agent.settings.n_steps
    )
    return state._replace(running=running), noisy


def _within(actions: ActionSpace, steps: Transitions) -> Transitions:
    return steps._replace(actions=actions.clip(steps.actions))


def _objective(discriminator: Discriminator, levels: Float[Array, " n"]) -> Objective:
    def objective(
        network: ShapedReward,
        policy: Policy,
        expert: Transitions,
        weights: Float[Array, " M"],
        generated: Transitions,
        places: Array,
        key: Array,
    ) -> tuple[Float[Array, ""], Losses]:
        # A stored step's place is (iteration * T + step) * n + environment.
        at = levels[places % levels.shape[0]]
        # Weights are of the action as drawn: beyond the bounds it cannot have been a random one.
        importance = importance_weights(policy, generated.observations, generated.actions, at)
        drawn = _within(network.actions, generated)
        return cross_entropy(discriminator, network, policy, expert, weights, drawn, importance=importance)

    return objective
