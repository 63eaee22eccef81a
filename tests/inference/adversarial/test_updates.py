import jax
import jax.numpy as jnp
import numpy as np
import optax

from i2rl.inference.adversarial.discriminator import (
    ExpertTransitions,
    Losses,
    Transitions,
    airl_discriminator,
)
from i2rl.inference.adversarial.updates import discriminator_updates
from i2rl.models.networks.modules import ActionSpace, CategoricalPolicy

TWO = ActionSpace(2)


def numbered(n: int, first: int = 0) -> Transitions:
    """Make steps whose observations carry their numbers."""
    which = jnp.arange(first, first + n, dtype=jnp.float32)[:, None]
    return Transitions(which, jnp.zeros(n, jnp.int32), which, jnp.zeros(n, bool))


def parts():
    network = airl_discriminator(1, TWO).init(jax.random.key(0))
    return network, CategoricalPolicy.create(jax.random.key(1), 1, TWO)


def expert_of(live) -> ExpertTransitions:
    steps = Transitions(*(x[:, None] for x in numbered(len(live))))
    return ExpertTransitions(steps, jnp.asarray(live), jnp.ones(1))


def test_rows_are_drawn_among_live_and_stored_ones_alone_and_places_say_which():
    live = np.array([False, True, True, False, True, False])
    network, policy = parts()

    def objective(net, policy, expert, weights, generated, places, key):
        # Told as losses: whether anything was drawn that must not be.
        first = expert.observations[:, 0, 0].astype(int)
        allowed = jnp.asarray(live)[first].all()
        same = (generated.observations[:, 0] == 100 + places).all() & (places < 8).all()
        return jnp.zeros(()), Losses(0.0, allowed.astype(float), same.astype(float))

    start, trained = discriminator_updates(objective, 5, 64, 1e-3)
    replay = Transitions(*(x.reshape(3, 4, *x.shape[1:]) for x in numbered(12, 100)))
    for seed in range(4):
        _, _, told = trained(
            network, start(network), policy, expert_of(live), replay, 2, jax.random.key(seed)
        )
        assert float(told.expert_accuracy) == 1.0
        assert float(told.generated_accuracy) == 1.0


def test_updates_are_adams_on_the_objective():
    network, policy = parts()

    def objective(net, *inputs):
        return (net.absorbing - 3.0) ** 2, Losses(0.0, 0.0, 0.0)

    start, trained = discriminator_updates(objective, 7, 4, 0.1)
    replay = Transitions(*(x[None] for x in numbered(4)))
    found, _, _ = trained(
        network, start(network), policy, expert_of([True] * 3), replay, 1, jax.random.key(0)
    )
    adam = optax.adam(0.1)
    x, memory = jnp.float32(0.0), adam.init(jnp.float32(0.0))
    for _ in range(7):
        change, memory = adam.update(2 * (x - 3.0), memory)
        x = optax.apply_updates(x, change)
    np.testing.assert_allclose(found.absorbing, x, rtol=1e-5)
    np.testing.assert_array_equal(found.reward.weights[0], network.reward.weights[0])


def test_the_normaliser_takes_in_both_sides_once_a_round():
    network, policy = parts()

    def objective(net, *inputs):
        return net.absorbing, Losses(0.0, 0.0, 0.0)

    start, trained = discriminator_updates(objective, 3, 50, 1e-3)
    replay = Transitions(*(x[None] for x in numbered(4, 100)))
    found, _, _ = trained(
        network, start(network), policy, expert_of([True] * 4), replay, 1, jax.random.key(0)
    )
    assert float(found.norm.count) == 100
    assert 45 < float(found.norm.mean[0]) < 58  # half from 0 to 3, half from 100 to 103
