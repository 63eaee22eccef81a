"""Discriminators and generators of tabular tasks, both exact: weights on all transitions, and soft plans.

The objective is that of section 6.2.1: the expert's transitions are hidden behind observations, so ``log D``
is averaged over the posterior of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....models.inputs.display import shown_briefly
from ....models.networks.modules import DTYPE, MLP, ActionSpace, ShapedReward
from ....models.process.mdp import TabularMDP
from ....models.process.planning import soft_plan
from ...completion.transitions import Completed, TransitionStatistic

# -- discriminators -----------------------------------------------------------------------------------


@shown_briefly
class TabularDiscriminator(NamedTuple):
    """A classifier of transitions whose log-odds are a reward, evaluated on all of them at once.

    Fields
    ------
    name : str
    init : function of a key, returning the network
    logits : function ``(network, log_policy [S, A], successors [S, A, U])`` returning log-odds of "expert"
        ``[S, A, U]``
    reward : function ``(network, log_policy)`` returning the generator's reward, ``[S, A]``
    """

    name: str
    init: Callable[[Array], Any]
    logits: Callable[[Any, Float[Array, "S A"], Int[Array, "S A U"]], Float[Array, "S A U"]]
    reward: Callable[[Any, Float[Array, "S A"]], Float[Array, "S A"]]


def tabular_airl(
    mdp: TabularMDP,
    features: Float[Array, "S d"],
    *,
    reward: Sequence[int] = (32,),
    potential: Sequence[int] = (32, 32),
) -> TabularDiscriminator:
    """Build ``D = exp f / (exp f + pi)``, ``f = g(s, a) + gamma h(s') - h(s)`` (Fu, Luo and Levine 2018).

    The generator earns ``g``: shaping preserves the soft-optimal policies of an unending task.
    """
    discount, n_actions = float(mdp.discount), mdp.n_actions
    by_pair = jnp.broadcast_to(features[:, None], (*mdp.available.shape, features.shape[1]))

    def init(key: Array) -> ShapedReward:
        return ShapedReward.create(
            key, features.shape[1], ActionSpace(n_actions), discount, reward=reward, potential=potential
        )

    def earned(network: ShapedReward, log_policy: Float[Array, "S A"]) -> Float[Array, "S A"]:
        del log_policy
        return network(by_pair, jnp.broadcast_to(jnp.arange(n_actions), mdp.available.shape))

    def logits(network: ShapedReward, log_policy: Array, successors: Array) -> Float[Array, "S A U"]:
        h = network.potential(network.norm(features))[:, 0]
        f = earned(network, log_policy)[..., None] + discount * h[successors] - h[:, None, None]
        return f - _finite(mdp, log_policy)[..., None]

    return TabularDiscriminator("AIRL", init, logits, earned)


def tabular_gail(
    mdp: TabularMDP, features: Float[Array, "S d"], *, hidden: Sequence[int] = (64, 8)
) -> TabularDiscriminator:
    """Build a free classifier of state and action whose reward is ``-log(1 - D)`` (Ho and Ermon 2016)."""
    shape = mdp.available.shape
    by_pair = jnp.broadcast_to(features[:, None], (*shape, features.shape[1]))
    actions = jnp.broadcast_to(jnp.eye(mdp.n_actions, dtype=DTYPE), (*shape, mdp.n_actions))
    inputs = jnp.concatenate([by_pair, actions], -1)

    def init(key: Array) -> MLP:
        return MLP.create(key, (inputs.shape[-1], *hidden, 1), last=0.1)

    def logits(network: MLP, log_policy: Array, successors: Array) -> Float[Array, "S A U"]:
        del log_policy
        return jnp.broadcast_to(network(inputs), successors.shape)

    def earned(network: MLP, log_policy: Array) -> Float[Array, "S A"]:
        del log_policy
        return jax.nn.softplus(network(inputs)[..., 0])

    return TabularDiscriminator("GAIL", init, logits, earned)


def _finite(mdp: TabularMDP, log_policy: Float[Array, "S A"]) -> Float[Array, "S A"]:
    return jnp.where(mdp.available, log_policy, 0.0)


# -- the objective ------------------------------------------------------------------------------------


def mean_of_log_probability(
    logits: Float[Array, "S A U"], expert: TransitionStatistic, completed: Completed
) -> Float[Array, ""]:
    """Average ``log D`` over the truth, exactly, in nats per step: the expert's part (section 6.2.1)."""
    del completed
    return jnp.sum(expert.weights * jax.nn.log_sigmoid(logits))


def log_probability_of_mean(
    logits: Float[Array, "S A U"], expert: TransitionStatistic, completed: Completed
) -> Float[Array, ""]:
    """Return ``log D`` of each step's mean logit, as in lines 13 and 16 of Algorithm 3.

    ``log D`` is concave in the logit, so this is at least :func:`mean_of_log_probability` (Jensen). Only the
    current session's steps count.
    """
    del expert
    mean = jnp.einsum("nlsau,sau->nl", completed.steps, logits)
    there = jnp.sum(completed.steps, axis=(2, 3, 4))
    return jnp.sum(there * jax.nn.log_sigmoid(mean)) / jnp.maximum(jnp.sum(there), 1e-300)


AVERAGES = {"log probabilities": mean_of_log_probability, "logits": log_probability_of_mean}


@shown_briefly
class Losses(NamedTuple):
    """Cross-entropy of the discriminator (nats), and the shares of either side that it classifies right."""

    loss: Float[Array, ""]
    expert_accuracy: Float[Array, ""]
    generated_accuracy: Float[Array, ""]


@shown_briefly
class Sides(NamedTuple):
    """Both sides of a discriminator: the expert's transitions, and the generator's ``[S, A, B]``."""

    expert: TransitionStatistic
    completed: Completed
    generated: Float[Array, "S A B"]


def cross_entropy(
    discriminator: TabularDiscriminator,
    network: Any,
    log_policy: Float[Array, "S A"],
    successors: Int[Array, "S A U"],
    sides: Sides,
    average: Callable[..., Float[Array, ""]] = mean_of_log_probability,
) -> tuple[Float[Array, ""], Losses]:
    """Return the mean cross-entropy of both sides, nats per step, on the expert's ``successors``.

    The generator's successors are the first entries of these lists.
    """
    logits = discriminator.logits(network, log_policy, successors)
    own = logits[..., : sides.generated.shape[-1]]
    of_expert = average(logits, sides.expert, sides.completed)
    of_generated = jnp.sum(sides.generated * jax.nn.log_sigmoid(-own))
    loss = -0.5 * (of_expert + of_generated)
    right = jnp.sum(sides.expert.weights * (logits > 0)), jnp.sum(sides.generated * (own < 0))
    return loss, Losses(loss, *right)


# -- the generator ------------------------------------------------------------------------------------


def proximal_plan(
    mdp: TabularMDP,
    reward: Float[Array, "S A"],
    log_policy: Float[Array, "S A"],
    values: Float[Array, " S"],
    entropy: float,
    step: float,
) -> tuple[Float[Array, "S A"], Float[Array, " S"]]:
    """Improve a policy exactly: maximise ``E[step (r + entropy H(pi))] - KL(pi, old)``; also return values.

    The result is a soft plan, of the reward ``(step r + log old) / (1 + step entropy)``: the trust region of
    a policy gradient without gradients. An infinite step is the soft plan of ``r / entropy``. For a constant
    reward the fixed points are those of the infinite step. ``values`` warm-start.
    """
    if np.isinf(step):
        plan = soft_plan(mdp, reward / entropy, values)
    else:
        plan = soft_plan(mdp, (step * reward + _finite(mdp, log_policy)) / (1 + step * entropy), values)
    return plan.log_policy, plan.values
