"""Discriminators of an expert's steps from a generator's, and the rewards that they define.

The objective is that of section 6.2.1 of the dissertation: the expert's transitions are hidden behind noisy
observations, so ``log D`` is averaged over draws of the truth given the observations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...models.inputs.display import shown_briefly
from ...models.networks.modules import ActionSpace, Policy, ShapedReward


@shown_briefly
class Transitions(NamedTuple):
    """Steps ``(s, a, s')``, and flags of those after which the episode terminated.

    Arrays ``[..., d]``, ``[...]`` or ``[..., k]``, ``[..., d]`` and ``[...]``.
    """

    observations: Array
    actions: Array
    successors: Array
    terminated: Array

    def rows(self, chosen: Array) -> Transitions:
        """Select rows by their indices on the first axis."""
        return Transitions(*(x[chosen] for x in self))


@shown_briefly
class ExpertTransitions(NamedTuple):
    """``M`` draws of the truth behind each of ``N`` observed steps.

    Fields
    ------
    steps : Transitions, arrays ``[N, M, ...]``
    live : bool ``[N]``; False for padding
    weights : float ``[M]``, of the draws, summing to one
    """

    steps: Transitions
    live: Array
    weights: Array


@shown_briefly
class Discriminator(NamedTuple):
    """A classifier whose log-odds are a reward.

    Fields
    ------
    name : str
    init : function of a key, returning the network
    score : function ``(network, z, a, z', terminated)`` of scaled observations and encoded actions, returning
        the network's part of the log-odds of "expert"
    offset : function ``(policy, transitions)``, the policy's part of the log-odds
    rewards : function ``(network, policy, transitions)`` returning the generator's reward, ``[...]``; the
    last
        step includes the reward after termination
    settings : mapping of all that distinguishes it from others of its name, for a journal
    """

    name: str
    init: Callable[[Array], ShapedReward]
    score: Callable[[ShapedReward, Array, Array, Array, Array], Array]
    offset: Callable[[Policy, Transitions], Array]
    rewards: Callable[[ShapedReward, Policy, Transitions], Array]
    settings: Mapping[str, Any] = {}

    def logits(self, network: ShapedReward, policy: Policy, steps: Transitions) -> Float[Array, "..."]:
        """Return the log-odds of "expert", in nats."""
        return self.score(network, *_scaled(network, steps)) + self.offset(policy, steps)


def _scaled(network: ShapedReward, steps: Transitions) -> tuple[Array, Array, Array, Array]:
    z, following = network.norm(steps.observations), network.norm(steps.successors)
    return z, network.actions.encode(steps.actions), following, jnp.asarray(steps.terminated)


def airl_discriminator(
    observation_size: int,
    actions: ActionSpace,
    discount: float = 0.99,
    *,
    entropy: float = 1.0,
    reward: Sequence[int] = (32,),
    potential: Sequence[int] = (32, 32),
    state_only: bool = False,
) -> Discriminator:
    """Build ``D = exp f / (exp f + pi)`` with ``f = g + gamma h(s') - h(s)`` (Fu, Luo and Levine 2018).

    The generator earns ``f - entropy * log pi``. With 1 this is ``log D - log(1 - D)``, whose optimum is the
    soft-optimal policy; with 0 it is ``f`` alone, as in the released code. Raises ``ValueError`` for a
    discount of 1 or more, for which the value after termination is infinite.
    """
    _require_discount(discount)

    def init(key: Array) -> ShapedReward:
        return ShapedReward.create(
            key,
            observation_size,
            actions,
            discount,
            reward=reward,
            potential=potential,
            state_only=state_only,
        )

    def rewards(network: ShapedReward, policy: Policy, steps: Transitions) -> Array:
        own = network.shaped(*steps) - entropy * policy.log_prob(steps.observations, steps.actions)
        return own + _for_ever(network.absorbing, discount) * steps.terminated

    return Discriminator(
        "AIRL",
        init,
        lambda network, *inputs: network.shaped_at(*inputs),
        lambda policy, steps: -policy.log_prob(steps.observations, steps.actions),
        rewards,
        {
            "discount": discount,
            "entropy": entropy,
            "reward": list(reward),
            "potential": list(potential),
            "state_only": state_only,
        },
    )


def gail_discriminator(
    observation_size: int,
    actions: ActionSpace,
    discount: float = 0.99,
    *,
    hidden: Sequence[int] = (64, 64),
) -> Discriminator:
    """Build a free classifier of state and action (Ho and Ermon 2016).

    The generator earns ``log D - log(1 - D)``. With ``log D`` alone every step would cost, and with
    ``-log(1 - D)`` alone every step would pay; they favour ending or prolonging episodes, whatever the expert
    does (Kostrikov et al. 2019). Raises as :func:`airl_discriminator`.
    """
    _require_discount(discount)

    def init(key: Array) -> ShapedReward:
        return ShapedReward.create(
            key, observation_size, actions, discount, reward=hidden, potential=(1,), activation="tanh"
        )

    def rewards(network: ShapedReward, policy: Policy, steps: Transitions) -> Array:
        own = network(steps.observations, steps.actions)
        return own + _for_ever(network.absorbing, discount) * steps.terminated

    return Discriminator(
        "GAIL",
        init,
        lambda network, z, a, following, terminated: network.reward_at(z, a),
        lambda policy, steps: jnp.zeros((), jnp.float32),
        rewards,
        {"discount": discount, "hidden": list(hidden)},
    )


def _require_discount(discount: float) -> None:
    if not 0 <= discount < 1:
        raise ValueError(
            f"the discount must be in [0, 1), or what follows termination has no value; got {discount}"
        )


def _for_ever(reward: Array, discount: float) -> Array:
    return discount / (1 - discount) * reward


# -- the objective --------------------------------------------------------------------------------------


def mean_log_probability(logits: Float[Array, "B M"], weights: Float[Array, " M"]) -> Float[Array, " B"]:
    """Average ``log D`` over the draws of the truth: the expert's part of the objective (section 6.2.1)."""
    return jax.nn.log_sigmoid(logits) @ weights


def log_probability_of_mean(logits: Float[Array, "B M"], weights: Float[Array, " M"]) -> Float[Array, " B"]:
    """Return ``log D`` of the mean logit, as in line 13 of Algorithm 3.

    ``log D`` is concave in the logit, so this is at least :func:`mean_log_probability` (Jensen).
    """
    return jax.nn.log_sigmoid(logits @ weights)


AVERAGES = {"log_probabilities": mean_log_probability, "logits": log_probability_of_mean}


@shown_briefly
class Losses(NamedTuple):
    """Measures of one step of the discriminator: cross-entropy (nats), and the shares classified right."""

    loss: Float[Array, ""]
    expert_accuracy: Float[Array, ""]
    generated_accuracy: Float[Array, ""]


def cross_entropy(
    discriminator: Discriminator,
    network: ShapedReward,
    policy: Policy,
    expert: Transitions,
    weights: Float[Array, " M"],
    generated: Transitions,
    average: str = "log_probabilities",
    importance: ArrayLike = 1.0,
) -> tuple[Float[Array, ""], Losses]:
    """Return the mean cross-entropy over expert steps ``[B, M]`` and generated steps ``[B]``, nats per step.

    Steps in the absorbing state count once for each episode that ended. ``importance`` weighs generated steps
    ``[B]`` that were not drawn from the policy alone.
    """
    of_expert = discriminator.logits(network, policy, expert)
    of_generated = discriminator.logits(network, policy, generated)
    absorbed = network.absorbing
    loss = -jnp.mean(AVERAGES[average](of_expert, weights))
    loss -= jnp.mean(importance * jax.nn.log_sigmoid(-of_generated))
    loss -= jnp.mean(expert.terminated @ weights) * jax.nn.log_sigmoid(absorbed)
    loss -= jnp.mean(importance * generated.terminated) * jax.nn.log_sigmoid(-absorbed)
    right = Losses(0.5 * loss, jnp.mean((of_expert > 0) @ weights), jnp.mean(of_generated < 0))
    return 0.5 * loss, right


def gradient_penalty(
    discriminator: Discriminator,
    network: ShapedReward,
    expert: Transitions,
    generated: Transitions,
    key: Array,
) -> Float[Array, ""]:
    """Return the mean of ``(|grad| - 1)^2`` between expert and generated steps (Gulrajani et al. 2017).

    The gradient is that of the network's part of the logit, in scaled observation and encoded action, at
    points drawn between steps ``[B]`` of the two. It keeps the classifier smooth, so that its reward has a
    slope even where the two sides are easily distinguished.
    """
    share = jax.random.uniform(key, expert.terminated.shape, jnp.float32)[:, None]
    ours, theirs = _scaled(network, expert), _scaled(network, generated)
    z, a, following = (share * x + (1 - share) * y for x, y in zip(ours[:3], theirs[:3], strict=True))

    def slopes(*inputs: Array) -> tuple[Array, Array]:
        return jax.grad(lambda z, a: discriminator.score(network, z, a, *inputs[2:]), argnums=(0, 1))(
            *inputs[:2]
        )

    by_state, by_action = jax.vmap(slopes)(z, a, following, generated.terminated)
    norms = jnp.sqrt(jnp.sum(by_state**2, -1) + jnp.sum(by_action**2, -1) + 1e-12)
    return jnp.mean((norms - 1) ** 2)
