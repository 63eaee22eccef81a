"""Rewards regressed on snippets of trajectories of known worth: the second half of SSRR.

Chen, Paleja and Gombolay (2020). The rewards of a snippet should sum to its share of its trajectory's worth;
an ensemble of networks is fitted to many snippets in one compiled program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...extras import required
from ...models.inputs.display import shown_briefly
from ...models.networks.modules import DTYPE, MLP, RunningNorm

if TYPE_CHECKING:
    import equinox as eqx
    import optax
else:
    eqx, optax = required("equinox"), required("optax")

WORTH = 10.0
"""Worth of a whole trajectory without noise in the regression, as released."""


class Regression(NamedTuple):
    """Settings of the regression of rewards on snippets; the released defaults take many minutes.

    A cheaper setting: ``hidden=(64, 64), points=32, learning_rate=1e-3, deviation=0.1``. Few and narrow
    layers need larger initial weights than the released, at which they would stay.

    Fields
    ------
    hidden : sizes of the hidden layers (ReLU)
    members : int, networks in the ensemble
    snippets : int, drawn for each network
    shortest, longest : int, steps of a snippet
    points : int
        States of a snippet at which the network is evaluated. A longer snippet is represented by this
        number of states, drawn one from each of as many equal stretches: much cheaper, and noisier.
    batch : int, snippets in an iteration
    iterations : int, of Adam
    learning_rate : float
    penalty : float, of the sum of the squared weights (not biases)
    deviation : float, of the initial weights
    held_out : float, share of the snippets withheld from training
    """

    hidden: Sequence[int] = (256, 256)
    members: int = 3
    snippets: int = 5000
    shortest: int = 50
    longest: int = 499
    points: int = 499
    batch: int = 64
    iterations: int = 3000
    learning_rate: float = 1e-4
    penalty: float = 0.1
    deviation: float = 1e-3
    held_out: float = 0.2

    def checked(self) -> Regression:
        """Validate the settings and return them. Raises ``ValueError`` naming an invalid field."""
        for name in ("members", "shortest", "points", "batch", "iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.longest < self.shortest:
            raise ValueError(f"longest ({self.longest}) is less than shortest ({self.shortest})")
        if not 0 < self.held_out < 1:
            raise ValueError(f"held_out is a share in (0, 1), got {self.held_out}")
        if self.kept < self.batch:
            raise ValueError(f"{self.kept} snippets to train on do not fill a batch of {self.batch}")
        return self

    @property
    def kept(self) -> int:
        """Number of snippets for training."""
        return self.snippets - int(self.held_out * self.snippets)


class SSRRReward(eqx.Module):
    """Rewards of states: the mean of an ensemble.

    Fields
    ------
    members : MLP whose arrays have a leading axis, one entry per network
    norm : RunningNorm, of observations
    """

    members: MLP
    norm: RunningNorm

    @staticmethod
    def create(key: Array, observation_size: int, settings: Regression) -> SSRRReward:
        """Create networks near zero: Gaussian weights with the settings' ``deviation``."""
        sizes = (observation_size, *settings.hidden, 1)
        keys = jax.random.split(key, len(sizes) - 1)
        weights = tuple(
            settings.deviation * jax.random.normal(k, (settings.members, i, o), DTYPE)
            for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)
        )
        biases = tuple(jnp.zeros((settings.members, o), DTYPE) for o in sizes[1:])
        return SSRRReward(MLP(weights, biases, "relu"), RunningNorm.create(observation_size))

    def each(self, observations: Float[Array, "... d"]) -> Float[Array, "E ..."]:
        """Return every network's reward."""
        z = self.norm(observations)
        return jax.vmap(lambda member: member(z)[..., 0])(self.members)

    def __call__(self, observations: Float[Array, "... d"], actions: Any = None) -> Float[Array, "..."]:
        """Return the ensemble's mean. Actions are accepted, as by other rewards, and ignored."""
        del actions
        return self.each(observations).mean(0)


@shown_briefly
class Ranked(NamedTuple):
    """Trajectories of known worth.

    Fields
    ------
    observations : float ``[n, T, d]``
    lengths : int ``[n]``
        Below ``T`` if the task ended early; later entries are ignored.
    worth : float ``[n]``
    """

    observations: Float[Array, "n T d"]
    lengths: Int[Array, " n"]
    worth: Float[Array, " n"]


@shown_briefly
class Snippets(NamedTuple):
    """Stretches of trajectories, arrays ``[m]``; ``label`` is the target of the sum of their rewards."""

    trajectory: Int[Array, " m"]
    start: Int[Array, " m"]
    length: Int[Array, " m"]
    label: Float[Array, " m"]


@shown_briefly
class Fit(NamedTuple):
    """Mean squared errors of each network, ``[E]``: on the last batch, and on the snippets held out."""

    trained: Float[Array, " E"]
    held_out: Float[Array, " E"]


def snippet_lengths(settings: Regression, count: int) -> Int[np.ndarray, " m"]:
    """Spread lengths evenly over ``shortest .. longest``, ascending: the uniform law, in strata."""
    spread = settings.longest - settings.shortest + 1
    return settings.shortest + (spread * (np.arange(count) + 0.5) / count).astype(int)


def draw_snippets(key: Array, ranked: Ranked, lengths: Int[np.ndarray, " m"]) -> Snippets:
    """Draw snippets of the given lengths: trajectory and start uniform; the whole of a shorter trajectory.

    A snippet's label is ``10 worth length / T``. A trajectory that ended early is divided by all ``T`` steps:
    divided by its own length, as released (for tasks that do not end), the steps of the shortest failures
    would be worth most.
    """
    k_which, k_start = jax.random.split(key)
    which = jax.random.randint(k_which, lengths.shape, 0, len(ranked.lengths))
    whole = ranked.lengths[which]
    length = jnp.minimum(jnp.asarray(lengths), whole)
    start = jax.random.randint(k_start, lengths.shape, 0, whole - length + 1)
    share = length / ranked.observations.shape[1]
    return Snippets(which, start, length, (WORTH * ranked.worth[which] * share).astype(DTYPE))


class Packing(NamedTuple):
    """Positions of the states of a batch of snippets in one dense array ``[N]``, and each slot's room."""

    slot: Int[np.ndarray, " N"]
    place: Int[np.ndarray, " N"]
    room: Int[np.ndarray, " B"]

    @staticmethod
    def of(room: Int[np.ndarray, " B"]) -> Packing:
        """Pack batches of the sizes given."""
        slot = np.repeat(np.arange(len(room)), room)
        return Packing(slot, np.concatenate([np.arange(r) for r in room]), room)

    def predicted(
        self,
        reward: Callable[[Array], Array],
        observations: Float[Array, "n T d"],
        batch: Snippets,
        key: Array,
    ) -> Float[Array, " B"]:
        """Sum rewards over a batch of snippets that fit their slots."""
        points = jnp.minimum(batch.length, jnp.asarray(self.room))
        u = jax.random.uniform(key, self.slot.shape, DTYPE)
        # A snippet no longer than its slot is taken whole: stretch i is then state i, whatever was drawn.
        stretch = (batch.length / points).astype(DTYPE)[self.slot]
        place = jnp.where(
            stretch > 1, jnp.floor((self.place + u) * stretch), jnp.asarray(self.place, DTYPE)
        ).astype(jnp.int32)
        t = batch.start[self.slot] + jnp.minimum(place, batch.length[self.slot] - 1)
        r = reward(observations[batch.trajectory[self.slot], t])
        r = jnp.where(self.place < points[self.slot], r * stretch, 0)
        return jax.ops.segment_sum(r, self.slot, len(self.room), indices_are_sorted=True)


def snippet_regression(settings: Regression) -> tuple[Callable[[SSRRReward], Any], Callable[..., tuple]]:
    """Build the regression of an ensemble's sums over snippets on their labels, in one compiled program.

    Returns ``init(reward) -> memory`` of Adam and ``regress(reward, memory, ranked, key) -> (reward, memory,
    Fit)``. The loss of a network is ``mean (sum_t r(s_t) - label)^2 + penalty * |W|^2``; each network has its
    own snippets. A batch has one snippet from each stratum of lengths, so that it fills an array of one size:
    45 % fewer states than padding each to the longest. Inputs are scaled by the normaliser, which first
    includes the ranked states (the released networks see raw observations).
    """
    settings = settings.checked()
    optimiser = optax.adam(settings.learning_rate)
    kept = snippet_lengths(settings, settings.kept)
    held = snippet_lengths(settings, settings.snippets - settings.kept)
    stratum = settings.kept // settings.batch
    packing = Packing.of(np.minimum(kept[stratum - 1 :: stratum][: settings.batch], settings.points))
    # The held-out snippets are evaluated in batches as well; the last batch repeats some.
    rows = np.minimum(np.arange(-(-len(held) // settings.batch) * settings.batch), len(held) - 1)
    judging = rows.reshape(-1, settings.batch)
    wide = Packing.of(np.full(settings.batch, min(settings.longest, settings.points)))

    def init(reward: SSRRReward) -> Any:
        return jax.vmap(optimiser.init)(reward.members)

    @jax.jit
    def regress(reward: SSRRReward, memory: Any, ranked: Ranked, key: Array) -> tuple[SSRRReward, Any, Fit]:
        live = jnp.arange(ranked.observations.shape[1]) < ranked.lengths[:, None]
        norm = _taken_in(reward.norm, jnp.asarray(ranked.observations, DTYPE), live)
        states = norm(ranked.observations)

        def one(member: MLP, memory: Any, key: Array) -> tuple[MLP, Any, Fit]:
            k_kept, k_held, k_steps, k_judge = jax.random.split(key, 4)
            training = draw_snippets(k_kept, ranked, kept)

            def step(carry: tuple[MLP, Any], key: Array) -> tuple[tuple[MLP, Any], Array]:
                member, memory = carry
                k_batch, k_points = jax.random.split(key)
                first = stratum * jnp.arange(settings.batch)
                chosen = first + jax.random.randint(k_batch, (settings.batch,), 0, stratum)
                batch = Snippets(*(x[chosen] for x in training))

                def loss(member: MLP) -> tuple[Array, Array]:
                    sums = packing.predicted(lambda z: member(z)[..., 0], states, batch, k_points)
                    error = jnp.mean((sums - batch.label) ** 2)
                    return error + settings.penalty * sum(jnp.sum(w**2) for w in member.weights), error

                slope, error = jax.grad(loss, has_aux=True)(member)
                change, memory = optimiser.update(slope, memory, member)
                return (optax.apply_updates(member, change), memory), error

            keys = jax.random.split(k_steps, settings.iterations)
            (member, memory), errors = lax.scan(step, (member, memory), keys)
            judged = draw_snippets(k_held, ranked, held)

            def squares(chosen_and_key: tuple[Array, Array]) -> Array:
                chosen, k_points = chosen_and_key
                batch = Snippets(*(x[chosen] for x in judged))
                return (
                    wide.predicted(lambda z: member(z)[..., 0], states, batch, k_points) - batch.label
                ) ** 2

            left = lax.map(squares, (jnp.asarray(judging), jax.random.split(k_judge, len(judging))))
            return member, memory, Fit(errors[-1], jnp.mean(left.reshape(-1)[: len(held)]))

        keys = jax.random.split(key, settings.members)
        # One network after the other: each already uses every core.
        members, memory, fit = lax.map(lambda x: one(*x), (reward.members, memory, keys))
        return SSRRReward(members, norm), memory, fit

    return init, regress


def _taken_in(
    norm: RunningNorm, observations: Float[Array, "n T d"], live: Bool[Array, "n T"]
) -> RunningNorm:
    """Add the live states to the normaliser (their number is known only to the data)."""
    weight = live[..., None].astype(DTYPE)
    n = jnp.sum(weight)
    mean = jnp.sum(weight * observations, (0, 1)) / n
    scatter = jnp.sum(weight * (observations - mean) ** 2, (0, 1))
    total, shift = norm.count + n, mean - norm.mean
    return RunningNorm(
        total,
        norm.mean + shift * n / total,
        norm.scatter + scatter + shift**2 * norm.count * n / total,
    )
