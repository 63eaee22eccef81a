"""One iteration of a discriminator, compiled: drawn rows, scaled inputs, steps of Adam."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ...extras import required
from ...models.networks.modules import Policy, ShapedReward
from .discriminator import ExpertTransitions, Losses, Transitions

if TYPE_CHECKING:
    import equinox as eqx
    import optax
else:
    eqx, optax = required("equinox"), required("optax")


class Objective(Protocol):
    """Loss that a step of the discriminator minimises."""

    def __call__(
        self,
        network: ShapedReward,
        policy: Policy,
        expert: Transitions,
        weights: Float[Array, " M"],
        generated: Transitions,
        places: Int[Array, " B"],
        key: Array,
    ) -> tuple[Float[Array, ""], Losses]:
        """Return the loss of expert steps ``[B, M]`` and generated ones ``[B]``, and its measures.

        ``places`` are the positions of the generated steps in the replay: iteration and step.
        """


def discriminator_updates(
    objective: Objective, updates: int, batch: int, learning_rate: float
) -> tuple[Callable[[ShapedReward], Any], Callable[..., tuple[ShapedReward, Any, Losses]]]:
    """Build the optimiser's initial state, and all steps of an iteration in one compiled program.

    The second is ``(network, memory, policy, expert, replay, filled, key) -> (network, memory, losses)``:
    ``expert`` is :class:`ExpertTransitions`, ``replay`` generated steps ``[K, B, ...]`` of which the first
    ``filled`` iterations count, and the losses are those of the last step. The network's normaliser includes
    one batch of each side per iteration.
    """
    optimiser = optax.adam(learning_rate)

    def start(network: ShapedReward) -> Any:
        return optimiser.init(_trainable(network))

    @jax.jit
    def trained(
        network: ShapedReward,
        memory: Any,
        policy: Policy,
        expert: ExpertTransitions,
        replay: Transitions,
        filled: int,
        key: Array,
    ) -> tuple[ShapedReward, Any, Losses]:
        # Live rows first, so that drawing one is drawing a number below their count.
        order, count = jnp.argsort(~expert.live, stable=True), jnp.sum(expert.live)
        size = replay.terminated.shape[1]
        stored = Transitions(*(x.reshape(-1, *x.shape[2:]) for x in replay))
        weights = expert.weights.astype(jnp.float32)

        def drawn(key: Array) -> tuple[Transitions, Transitions, Array]:
            k_expert, k_generated = jax.random.split(key)
            rows = order[jax.random.randint(k_expert, (batch,), 0, count)]
            places = jax.random.randint(k_generated, (batch,), 0, filled * size)
            return expert.steps.rows(rows), stored.rows(places), places

        k_norm, k_updates = jax.random.split(key)
        ours, theirs, _ = drawn(k_norm)
        norm = network.norm.update(ours.observations[:, 0]).update(theirs.observations)
        network = eqx.tree_at(lambda net: net.norm, network, norm)

        def step(carry: tuple, key: Array) -> tuple:
            parameters, memory = carry
            k_batch, k_objective = jax.random.split(key)
            ours, theirs, places = drawn(k_batch)

            def loss(parameters: tuple) -> tuple[Array, Losses]:
                net = eqx.tree_at(_trainable, network, parameters)
                return objective(net, policy, ours, weights, theirs, places, k_objective)

            slope, met = jax.grad(loss, has_aux=True)(parameters)
            change, memory = optimiser.update(slope, memory, parameters)
            return (optax.apply_updates(parameters, change), memory), met

        keys = jax.random.split(k_updates, updates)
        every: Losses
        (parameters, memory), every = lax.scan(step, (_trainable(network), memory), keys)
        network = eqx.tree_at(_trainable, network, parameters)
        return network, memory, jax.tree.map(lambda x: x[-1], every)

    return start, trained


def _trainable(network: ShapedReward) -> tuple:
    return network.reward, network.potential, network.absorbing
