"""SSRR: rewards regressed on how performance falls as actions grow noisy (Chen, Paleja and Gombolay 2020).

The baseline of section 7.4.3. Four steps: noisy-AIRL learns a policy and a first reward from what the expert
showed; that policy, acted out at twenty levels of noise, shows how the reward it earns falls with the noise
(:func:`fit_noise_curve`); networks are then regressed on what that curve says each snippet of those
trajectories is worth (:func:`snippet_regression`); and a second policy is learned from their mean. No
demonstration beyond the first step is used, so what is learned can be better than what was shown, and can be
far from what the expert was after (section 2.6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import isotonic_regression, least_squares

from ..models.extras import required
from ..models.networks import DTYPE, MLP, RunningNorm

if TYPE_CHECKING:
    import equinox as eqx
    import optax
else:
    eqx, optax = required("equinox"), required("optax")

WORTH = 10.0
"""What a whole trajectory without noise is worth to the regression, as released."""

# -- performance against noise ----------------------------------------------------------------------------

LEAST = np.array([-0.5, -1.0, 1e-6, -200.0])
MOST = np.array([1.5, 1.0, 2.0, -1e-3])
_STARTS = [(x0, 0.0, 1.0, k) for x0 in (0.1, 0.4, 0.7) for k in (-3.0, -15.0)]


class NoiseCurve(NamedTuple):
    """Performance as a decreasing function of the noise in the actions.

    Fields
    ------
    levels : float ``[E]``
        Probabilities of a random action.
    scores : float ``[E]``
        What was measured, scaled to [0, 1].
    values : float ``[E]``
        The fitted curve at the levels.
    parameters : float ``[4]``
        ``x0, y0, c, k`` of the sigmoid ``c / (1 + exp(-k (eps - x0))) + y0``.
    sigmoid : bool
        Whether ``values`` are the sigmoid's; if not, they are the best decreasing curve's.
    explained : float
        Share of the scores' variance that ``values`` explain; 0 where the scores do not fall with the noise
        (the first reward is then no guide, nor is what is regressed on it).
    """

    levels: Float[np.ndarray, " E"]
    scores: Float[np.ndarray, " E"]
    values: Float[np.ndarray, " E"]
    parameters: Float[np.ndarray, "4"]
    sigmoid: Bool[np.ndarray, ""]
    explained: Float[np.ndarray, ""]


def sigmoid_curve(
    levels: Float[np.ndarray, "..."], parameters: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "..."]:
    """``c / (1 + exp(-k (eps - x0))) + y0`` with the parameters ``x0, y0, c, k``."""
    x0, y0, c, k = parameters
    return c / (1 + np.exp(-k * (np.asarray(levels) - x0))) + y0


def _sigmoid_slopes(levels: Float[np.ndarray, " E"], parameters: Float[np.ndarray, "4"]) -> np.ndarray:
    x0, _, c, k = parameters
    share = 1 / (1 + np.exp(-k * (levels - x0)))
    steep = c * share * (1 - share)
    return np.stack([-k * steep, np.ones_like(levels), share, (levels - x0) * steep], 1)


def fit_noise_curve(
    levels: Float[np.ndarray, " E"], returns: Float[np.ndarray, " E"], loss: float = 0.05
) -> NoiseCurve:
    """Fit mean returns at levels of noise, scaled to [0, 1], by a falling sigmoid.

    Least squares from six starts within ``x0 in [-.5, 1.5]``, ``y0 in [-1, 1]``, ``c in (0, 2]`` and
    ``k in [-200, 0)``: without bounds, as released, most published fits are no sigmoids (heights of 50 to
    2000 above floors as deep). Where the sigmoid explains less of the scores' variance than the best
    decreasing curve does by more than ``loss``, that curve (isotonic regression) takes its place.

    Raises ``ValueError`` for levels outside [0, 1] or not increasing, fewer than four of them, returns of
    another shape, or numbers that are not finite (naming the level).
    """
    levels, returns = np.asarray(levels, float), np.asarray(returns, float)
    if levels.ndim != 1 or returns.shape != levels.shape or len(levels) < 4:
        raise ValueError(
            "a noise curve needs at least four levels and one return each, got the shapes "
            f"{levels.shape} and {returns.shape}"
        )
    if not (np.all(np.diff(levels) > 0) and levels[0] >= 0 and levels[-1] <= 1):
        raise ValueError(f"levels of noise are probabilities in increasing order, got {levels}")
    if not np.isfinite(returns).all():
        i = int(np.flatnonzero(~np.isfinite(returns))[0])
        raise ValueError(f"the return at noise level {levels[i]:g} is {returns[i]}, not finite")
    spread = returns.max() - returns.min()
    scores = (returns - returns.min()) / spread if spread > 0 else np.zeros_like(returns)

    fits = [
        least_squares(
            lambda p: sigmoid_curve(levels, p) - scores,
            start,
            lambda p: _sigmoid_slopes(levels, p),
            bounds=(LEAST, MOST),
            max_nfev=200,
        )
        for start in _STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    falling = isotonic_regression(scores, increasing=False).x
    total = np.sum((scores - scores.mean()) ** 2)
    left_by_falling = np.sum((falling - scores) ** 2)
    sigmoid = 2 * best.cost - left_by_falling <= loss * total + 1e-9
    left = 2 * best.cost if sigmoid else left_by_falling
    return NoiseCurve(
        levels,
        scores,
        sigmoid_curve(levels, best.x) if sigmoid else falling,
        best.x,
        np.asarray(sigmoid),
        np.asarray(max(0.0, 1 - left / total) if total > 0 else 0.0),
    )


# -- regression on snippets -------------------------------------------------------------------------------


class Regression(NamedTuple):
    """How rewards are regressed on snippets; the defaults are those released.

    Fields
    ------
    hidden : sizes of the hidden layers (ReLU)
    members : int, networks in the ensemble
    snippets : int, drawn for each network
    shortest, longest : int, steps of a snippet
    points : int
        States of a snippet at which the network is evaluated. A longer one is represented by so many of its
        states, one drawn from each of as many equal stretches: much cheaper, and noisier.
    batch : int, snippets an iteration
    iterations : int, of Adam
    learning_rate : float
    penalty : float, of the sum of the squared weights (not biases)
    deviation : float, of the first weights
    held_out : float, share of the snippets not trained on
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
        """Itself. Raises ``ValueError`` naming a field that cannot be."""
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
        """How many snippets are trained on."""
        return self.snippets - int(self.held_out * self.snippets)


class SSRRReward(eqx.Module):
    """Rewards of states: the mean of an ensemble.

    Fields
    ------
    members : MLP whose arrays have a leading axis, one entry a network
    norm : RunningNorm, of observations
    """

    members: MLP
    norm: RunningNorm

    @staticmethod
    def create(key: Array, observation_size: int, settings: Regression) -> SSRRReward:
        """Networks that are nearly zero: weights normal with the settings' ``deviation``."""
        sizes = (observation_size, *settings.hidden, 1)
        keys = jax.random.split(key, len(sizes) - 1)
        weights = tuple(
            settings.deviation * jax.random.normal(k, (settings.members, i, o), DTYPE)
            for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)
        )
        biases = tuple(jnp.zeros((settings.members, o), DTYPE) for o in sizes[1:])
        return SSRRReward(MLP(weights, biases, "relu"), RunningNorm.create(observation_size))

    def each(self, observations: Float[Array, "... d"]) -> Float[Array, "E ..."]:
        """Every network's reward."""
        z = self.norm(observations)
        return jax.vmap(lambda member: member(z)[..., 0])(self.members)

    def __call__(self, observations: Float[Array, "... d"]) -> Float[Array, "..."]:
        """The ensemble's mean."""
        return self.each(observations).mean(0)


class Ranked(NamedTuple):
    """Trajectories acted out with noise, and what the noise curve says each is worth.

    Fields
    ------
    observations : float ``[n, T, d]``
    lengths : int ``[n]``
    worth : float ``[n]``, the curve at the trajectory's level
    """

    observations: Float[Array, "n T d"]
    lengths: Int[Array, " n"]
    worth: Float[Array, " n"]


class Snippets(NamedTuple):
    """Stretches of trajectories, arrays ``[m]``; ``label`` is what their rewards should sum to."""

    trajectory: Int[Array, " m"]
    start: Int[Array, " m"]
    length: Int[Array, " m"]
    label: Float[Array, " m"]


class Fit(NamedTuple):
    """Mean squared errors of each network, ``[E]``: on the last batch, and on the snippets held out."""

    trained: Float[Array, " E"]
    held_out: Float[Array, " E"]


def snippet_lengths(settings: Regression, count: int) -> Int[np.ndarray, " m"]:
    """Lengths evenly spread over ``shortest .. longest``, ascending: the uniform law, in strata."""
    spread = settings.longest - settings.shortest + 1
    return settings.shortest + (spread * (np.arange(count) + 0.5) / count).astype(int)


def draw_snippets(key: Array, ranked: Ranked, lengths: Int[np.ndarray, " m"]) -> Snippets:
    """Snippets of the given lengths: trajectory and start uniform; the whole of a shorter trajectory.

    A snippet's label is ``worth * 10 * length / length of the trajectory``.
    """
    k_which, k_start = jax.random.split(key)
    which = jax.random.randint(k_which, lengths.shape, 0, len(ranked.lengths))
    whole = ranked.lengths[which]
    length = jnp.minimum(jnp.asarray(lengths), whole)
    start = jax.random.randint(k_start, lengths.shape, 0, whole - length + 1)
    return Snippets(which, start, length, (WORTH * ranked.worth[which] * length / whole).astype(DTYPE))


class _Packing(NamedTuple):
    """Where the states of a batch of snippets lie in one array ``[N]`` without gaps; each slot's room."""

    slot: Int[np.ndarray, " N"]
    place: Int[np.ndarray, " N"]
    room: Int[np.ndarray, " B"]

    @staticmethod
    def of(room: Int[np.ndarray, " B"]) -> _Packing:
        slot = np.repeat(np.arange(len(room)), room)
        return _Packing(slot, np.concatenate([np.arange(r) for r in room]), room)

    def predicted(
        self,
        reward: Callable[[Array], Array],
        observations: Float[Array, "n T d"],
        batch: Snippets,
        key: Array,
    ) -> Float[Array, " B"]:
        """Sums of rewards over a batch of snippets that fit their slots."""
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
    """Regression of an ensemble's sums over snippets on their labels, all of it in one compiled program.

    Returns ``init(reward) -> memory``, Adam's, and ``regress(reward, memory, ranked, key) -> (reward, memory,
    Fit)``. The loss of a network is ``mean (sum_t r(s_t) - label)^2 + penalty * |W|^2``; each has snippets of
    its own. A batch has one snippet from each stratum of lengths, so that it fills an array of one size: 45 %
    fewer states than padding each to the longest. Inputs are scaled by the normaliser, which takes the ranked
    states in first (the released networks see raw observations).
    """
    settings = settings.checked()
    optimiser = optax.adam(settings.learning_rate)
    kept = snippet_lengths(settings, settings.kept)
    held = snippet_lengths(settings, settings.snippets - settings.kept)
    stratum = settings.kept // settings.batch
    packing = _Packing.of(np.minimum(kept[stratum - 1 :: stratum][: settings.batch], settings.points))
    # The snippets held out are judged in batches as well, the last of which repeats some.
    rows = np.minimum(np.arange(-(-len(held) // settings.batch) * settings.batch), len(held) - 1)
    judging = rows.reshape(-1, settings.batch)
    wide = _Packing.of(np.full(settings.batch, min(settings.longest, settings.points)))

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
        # One network after the other: each already keeps every core busy.
        members, memory, fit = lax.map(lambda x: one(*x), (reward.members, memory, keys))
        return SSRRReward(members, norm), memory, fit

    return init, regress


def _taken_in(
    norm: RunningNorm, observations: Float[Array, "n T d"], live: Bool[Array, "n T"]
) -> RunningNorm:
    """The normaliser with the live states taken in (their number is known only to the data)."""
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
