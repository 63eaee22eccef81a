"""Adversarial learners of rewards and policies as networks: AIRL, GAIL and robust-AIRL (chapter 6.2).

A learner has three parts: the discriminator (the reward), the generator (the policy and its improvement) and
the truth (the expert's steps, given the observations). AIRL on clean or noisy input takes observations at
face value; robust-AIRL (Algorithm 3) draws the truth behind them.

A session carries the reward network, its optimiser and normaliser, the generator with its own, generated
steps, the sensor and the key. It discards the demonstration (Definition 7).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...extras import required
from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.networks.modules import DTYPE, ActionSpace, Policy, ShapedReward
from ...models.observation.recordings import Recording, require_recording
from ..sessions.learner import Learner
from .discriminator import (
    AVERAGES,
    Discriminator,
    ExpertTransitions,
    Losses,
    Transitions,
    airl_discriminator,
    cross_entropy,
    gail_discriminator,
    gradient_penalty,
)
from .rollouts import finished_returns
from .truth import FaceValue, Settling, Truth, look
from .updates import Objective, discriminator_updates

if TYPE_CHECKING:
    import equinox as eqx
    import optax
else:
    eqx, optax = required("equinox"), required("optax")


@shown_briefly
class Task(NamedTuple):
    """Task of a learner without a :class:`TabularMDP`: sizes and a name, for its journal."""

    name: str
    observation_size: int
    actions: ActionSpace

    n_states: int = 0
    feature_names: tuple[str, ...] = ()

    @property
    def n_actions(self) -> int:
        """Number of actions; for vectors, their length."""
        return self.actions.size

    def require(self, recording: Recording) -> None:
        """Raise :class:`~i2rl.models.RecordingError` for anything but a recording of this task."""
        require_recording(recording, self.observation_size, self.actions.n, len(self.actions.low))

    def fingerprint(self) -> str:
        """Digest all fields."""
        return hashlib.sha256(json.dumps(tuple(self)).encode()).hexdigest()


@shown_briefly
class AdversarialState(NamedTuple):
    """State that is carried from session to session.

    Fields
    ------
    session : int
    key : random key
    network : ShapedReward
    optimiser : state of the discriminator's optimiser
    generator : state of the generator, with its ``policy``
    replay : Transitions, generated in the latest iterations, ``[K, B, ...]``
    iterations, pairs : int; iterations of training and observed pairs so far
    sensor : the truth's sensor
    """

    session: Int[Array, ""]
    key: Array
    network: ShapedReward
    optimiser: Any
    generator: Any
    replay: Transitions
    iterations: Int[Array, ""]
    pairs: Int[Array, ""]
    sensor: Any

    @property
    def weights(self) -> Float[np.ndarray, " P"]:
        """All parameters of the reward network in one vector."""
        parameters = (self.network.reward, self.network.potential, self.network.absorbing)
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves(parameters)])


@shown_briefly
class AdversarialInfo(NamedTuple):
    """Measures of a session.

    Fields
    ------
    session : int
    log_likelihood : float
        Log-likelihood of the expert's actions under the generator's policy, nats per step, averaged over the
        draws of the truth in the session's last iteration.
    loss, expert_accuracy, generated_accuracy : float ``[iterations]``
        Measures of the discriminator: cross-entropy in nats, and the shares classified right.
    returns : float ``[iterations]``
        Mean return, by the environment's own reward, of the episodes that the generator finished; NaN if
        none ended. Learning does not use it.
    pairs, environment_steps : int
        Observed pairs, and steps of the generator, in all sessions so far.
    iterations : int
        Iterations of this session.
    draws : int ``[k]``
        Draws of the truth, at each refresh.
    sensor : the truth's sensor after the session
    seconds : float
    weights : float ``[P]``
    """

    session: int
    log_likelihood: float
    loss: Float[np.ndarray, " rounds"]
    expert_accuracy: Float[np.ndarray, " rounds"]
    generated_accuracy: Float[np.ndarray, " rounds"]
    returns: Float[np.ndarray, " rounds"]
    pairs: int
    environment_steps: int
    iterations: int
    draws: Int[np.ndarray, " k"]
    sensor: Any
    seconds: float
    weights: Float[np.ndarray, " P"]


class AdversarialTraining(NamedTuple):
    """Settings of a session's training.

    Fields
    ------
    iterations : int, of generator and discriminator, in a session
    updates : int, steps of the discriminator in an iteration
    batch : int, expert steps (and as many generated ones) in a step of the discriminator
    learning_rate : float, of the discriminator's Adam
    average : "log_probabilities" (the objective of section 6.2.1) or "logits" (as released)
    penalty : float, of the gradient (see :func:`gradient_penalty`)
    replay : int, iterations whose generated steps the discriminator draws from
    refresh : int, iterations between refreshes of the draws of the truth
    change : float, nats; infinite for one draw of the truth at a refresh
        A refresh draws until the average logit of a step moves by no more than this
        (:func:`~i2rl.inference.adversarial.truth.look`). The dissertation's ``delta_G`` is a sum over a
        batch: its .1 over 256 steps is 4e-4 here.
    draws : int, the most at a refresh
    """

    iterations: int = 10
    updates: int = 4
    batch: int = 256
    learning_rate: float = 1e-3
    average: str = "log_probabilities"
    penalty: float = 1.0
    replay: int = 1
    refresh: int = 5
    change: float = np.inf
    draws: int = 20

    def checked(self) -> AdversarialTraining:
        """Validate the settings and return them. Raises ``ValueError`` naming an invalid field."""
        for name in ("iterations", "updates", "batch", "replay", "refresh", "draws"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}")
        for name in ("penalty", "change"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.average not in AVERAGES:
            raise ValueError(f"average is one of {', '.join(AVERAGES)}, got {self.average!r}")
        return self


def adversarial(
    name: str,
    generator: Any,
    discriminator: Discriminator,
    truth: Truth | None = None,
    training: AdversarialTraining | None = None,
    configuration: Mapping[str, Any] | None = None,
) -> Learner:
    """Build a learner of the session protocol from its parts; its demonstrations are :class:`Recording`.

    ``generator`` is a :class:`PPO`, or has the same ``environment``, ``settings``, ``init(key)``,
    ``collect(state)`` and ``improve(state, rollout, rewards)``, and states with a ``policy``. ``truth`` is
    :class:`FaceValue` by default. A program is compiled once for each shape of recordings. ``configuration``
    adds to the configuration that identifies the learner to a journal.

    Its ``update`` raises :class:`~i2rl.models.observation.recordings.RecordingError` (a ``ValueError``) for a
    recording of another task or with numbers that are not finite, naming trajectory and step; the given state
    stays valid.
    """
    environment = generator.environment
    task = Task(environment.name, environment.observation_size, environment.actions)
    truth = FaceValue() if truth is None else truth
    how = (training or AdversarialTraining()).checked()
    objective = discriminator_objective(discriminator, how)
    start, trained = discriminator_updates(objective, how.updates, how.batch, how.learning_rate)

    @jax.jit
    def rewarded(network: ShapedReward, policy: Policy, rollout: Any) -> Float[Array, "T n"]:
        return discriminator.rewards(network, policy, _steps(task, rollout))

    @jax.jit
    def logits_of(network: ShapedReward, policy: Policy, steps: Transitions) -> Float[Array, "N M"]:
        return discriminator.logits(network, policy, steps)

    def init(key: Array) -> AdversarialState:
        k_network, k_generator, k_rest = jax.random.split(as_key(key), 3)
        network = discriminator.init(k_network)
        acting = generator.init(k_generator)
        blank = blank_steps(task, (how.replay, generator.settings.steps))
        zero = jnp.zeros((), jnp.int64)
        parts = (network, start(network), acting, blank, zero, zero, truth.prior())
        return AdversarialState(zero, k_rest, *parts)

    def update(state: AdversarialState, recording: Recording) -> tuple[AdversarialState, AdversarialInfo]:
        began = time.perf_counter()
        task.require(recording)
        key, k_chain = jax.random.split(state.key)
        network, memory, acting = state.network, state.optimiser, state.generator
        replay, sensor, iterations = state.replay, state.sensor, int(state.iterations)
        chain = truth.begin(recording, sensor, k_chain)
        losses: list[Losses] = []
        returns: list[float] = []
        draws: list[int] = []
        expert: ExpertTransitions | None = None
        for r in range(how.iterations):
            key, k_truth, k_updates = jax.random.split(key, 3)
            policy = acting.policy
            if expert is None or r % how.refresh == 0:
                logits = partial(logits_of, network, policy)
                chain, expert, made = look(
                    truth,
                    chain,
                    sensor,
                    policy,
                    k_truth,
                    task.actions,
                    logits,
                    Settling(how.change, how.draws),
                )
                draws.append(made)
            before = acting.running
            acting, rollout = generator.collect(acting)
            replay = remembered(replay, _steps(task, rollout), (iterations + r) % how.replay)
            filled = min(iterations + r + 1, how.replay)
            network, memory, met = trained(network, memory, policy, expert, replay, filled, k_updates)
            acting = generator.improve(acting, rollout, rewarded(network, policy, rollout))
            losses.append(met)
            ended = finished_returns(before, rollout)
            returns.append(ended.mean() if len(ended) else np.nan)
        assert expert is not None
        sensor = truth.learned(chain, sensor)
        pairs = state.pairs + int(np.sum(recording.live))
        iterations += how.iterations
        state = AdversarialState(
            state.session + 1,
            key,
            network,
            memory,
            acting,
            replay,
            jnp.asarray(iterations),
            pairs,
            sensor,
        )
        return state, session_info(state, expert, losses, returns, began, draws)

    settings = {**identity(generator, discriminator), **how._asdict(), **dict(configuration or {})}
    return Learner(name, task, settings, init, update)  # type: ignore[arg-type]


def airl(generator: Any, *, training: AdversarialTraining | None = None, **networks: Any) -> Learner:
    """Build AIRL that takes observations for the truth; ``networks`` goes to :func:`airl_discriminator`.

    See Also
    --------
    i2rl.inference.gail : a classifier in place of a reward
    i2rl.inference.robust_airl : samples the truth behind the observations
    i2rl.inference.airl_tabular : the learner of tabular tasks

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import cart_pole
    >>> from i2rl.inference import airl, ppo
    >>> learner = airl(ppo(cart_pole(), n_envs=2, n_steps=8, minibatch=8))
    >>> learner.name, learner.init(jax.random.key(0)).weights.shape  # parameters of its networks
    ('AIRL', (1507,))
    """
    task = generator.environment
    networks.setdefault("discount", generator.settings.gamma)
    discriminator = airl_discriminator(task.observation_size, task.actions, **networks)
    return adversarial("AIRL", generator, discriminator, training=training)


def gail(generator: Any, *, training: AdversarialTraining | None = None, **networks: Any) -> Learner:
    """Build GAIL that takes observations for the truth; ``networks`` goes to :func:`gail_discriminator`.

    See Also
    --------
    i2rl.inference.airl : learns a reward

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import cart_pole
    >>> from i2rl.inference import gail, ppo
    >>> learner = gail(ppo(cart_pole(), n_envs=2, n_steps=8, minibatch=8), hidden=(16, 16))
    >>> learner.name, learner.init(jax.random.key(0)).weights.shape  # parameters of its networks
    ('GAIL', (409,))
    """
    task = generator.environment
    networks.setdefault("discount", generator.settings.gamma)
    discriminator = gail_discriminator(task.observation_size, task.actions, **networks)
    return adversarial("GAIL", generator, discriminator, training=training)


# -- the parts of an iteration ---------------------------------------------------------------------------


@jax.jit
def action_log_likelihood(policy: Policy, expert: ExpertTransitions) -> Float[Array, ""]:
    """Return the mean log-likelihood of the expert's actions, nats per step, over the draws of the truth."""
    each = policy.log_prob(expert.steps.observations, expert.steps.actions) @ expert.weights
    return jnp.sum(jnp.where(expert.live, each, 0)) / jnp.sum(expert.live)


def session_info(
    state: AdversarialState,
    expert: ExpertTransitions,
    losses: Sequence[Losses],
    returns: Sequence[float],
    began: float,
    draws: Sequence[int] = (1,),
) -> AdversarialInfo:
    """Summarise a session from the state after it, its last draws, and its iterations' measures."""
    every: Losses = jax.tree.map(lambda *x: np.asarray(x, np.float64), *losses)
    return AdversarialInfo(
        session=int(state.session),
        log_likelihood=float(action_log_likelihood(state.generator.policy, expert)),
        **every._asdict(),
        returns=np.asarray(returns, np.float64),
        pairs=int(state.pairs),
        environment_steps=int(state.iterations) * int(np.prod(state.replay.terminated.shape[1:])),
        iterations=len(losses),
        draws=np.asarray(draws),
        sensor=jax.tree.map(np.asarray, state.sensor),
        seconds=time.perf_counter() - began,
        weights=state.weights,
    )


def identity(generator: Any, discriminator: Discriminator) -> dict[str, Any]:
    """Return the configuration that identifies the parts of a learner to a journal."""
    return {
        "discriminator": discriminator.name,
        "networks": dict(discriminator.settings),
        "horizon": generator.environment.horizon,
        "environment": dict(getattr(generator.environment, "settings", ())),
        "agent": generator.settings._asdict(),
    }


def _steps(task: Task, rollout: Any) -> Transitions:
    return Transitions(
        rollout.observations,
        task.actions.clip(rollout.actions),
        rollout.next_observations,
        rollout.terminated,
    )


def blank_steps(task: Task, shape: tuple[int, int]) -> Transitions:
    """Allocate room for generated steps, of this ``shape``."""
    d = task.observation_size
    observations = jnp.zeros((*shape, d), DTYPE)
    if task.actions.discrete:
        actions = jnp.zeros(shape, jnp.int32)
    else:
        actions = jnp.zeros((*shape, task.actions.size), DTYPE)
    return Transitions(observations, actions, observations, jnp.zeros(shape, bool))


@jax.jit
def remembered(replay: Transitions, new: Transitions, place: int) -> Transitions:
    """Replace one iteration's generated steps by those of another."""
    return Transitions(
        *(old.at[place].set(x.reshape(old.shape[1:])) for old, x in zip(replay, new, strict=True))
    )


def discriminator_objective(discriminator: Discriminator, how: AdversarialTraining) -> Objective:
    """Build the cross-entropy, averaged and penalised by the training's settings."""

    def objective(
        network: ShapedReward,
        policy: Policy,
        expert: Transitions,
        weights: Float[Array, " M"],
        generated: Transitions,
        places: Array,
        key: Array,
    ) -> tuple[Float[Array, ""], Losses]:
        loss, met = cross_entropy(discriminator, network, policy, expert, weights, generated, how.average)
        if how.penalty:
            first = Transitions(*(x[:, 0] for x in expert))
            loss += how.penalty * gradient_penalty(discriminator, network, first, generated, key)
        return loss, met

    return objective
