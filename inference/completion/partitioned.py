"""The truth behind noisy recordings of continuous states and numbered actions: Technique 1 of section 6.2.3.

Two methods for the same posterior, for sensors with finitely many possible truths behind an observation
(mountain car's has two: the observation, and the observation shifted back).

:func:`partition_truth` is the dissertation's. The space is cut into ``Q`` parts per dimension; a cell's
transitions and policy are integrals over it, and the cells are smoothed exactly as any tabular process is
(:mod:`~i2rl.models.laws.chain`). A draw is then one of the observation's truths within the drawn cell. Detail
below the size of a cell is lost, and mountain car's shift is a tenth of one.

:func:`candidate_truth`, the better one and the default, has no cells: the hidden state of a step *is* one of
its observation's truths, and transitions between truths have a narrow Gaussian about the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy import ndimage, sparse

from ...models.inputs.display import shown_briefly
from ...models.laws.chain import Filtered, filter_all, sample_backward, smooth_all
from ...models.observation.recordings import FiniteSensor, Recording, ShiftSensor, Truths, truths
from ...models.process.mdp import TabularMDP

DynamicsOfActions = Callable[[Array, Array], Array]
"""Next states ``[..., d]`` after states ``[..., d]`` and numbered actions ``[...]``, in JAX."""


@shown_briefly
class CandidatePosterior(NamedTuple):
    """Posterior over the possible truths behind each observation.

    Fields
    ------
    log_likelihood : float ``[n]``
        Log-likelihood of the observations, in nats (a density in the coordinates free under the dynamics).
    weights : float ``[n, L, K]``
        Posterior probability of each truth; zero on padding.
    """

    log_likelihood: Float[Array, " n"]
    weights: Float[Array, "n L K"]


class _Moves(NamedTuple):
    """A hidden Markov chain of ``K`` candidates a step, in logarithms."""

    factors: Float[Array, "L K"]
    moves: Float[Array, "T K K"]


def _forward(chain: _Moves) -> Float[Array, "L K"]:
    """Return ``log p(candidate k at t, all before and at t)``."""

    def step(alpha: Array, inputs: tuple) -> tuple:
        move, factor = inputs
        alpha = jax.nn.logsumexp(alpha[:, None] + move, axis=0) + factor
        return alpha, alpha

    rest: Array = lax.scan(step, chain.factors[0], (chain.moves, chain.factors[1:]))[1]
    return jnp.concatenate([chain.factors[:1], rest])


def _backward(chain: _Moves) -> Float[Array, "L K"]:
    def step(beta: Array, inputs: tuple) -> tuple:
        move, factor = inputs
        beta = jax.nn.logsumexp(move + factor + beta, axis=1)
        return beta, beta

    last = jnp.zeros_like(chain.factors[0])
    rest: Array = lax.scan(step, last, (chain.moves, chain.factors[1:]), reverse=True)[1]
    return jnp.concatenate([rest, last[None]])


def _draw_candidates(key: Array, chain: _Moves, alpha: Float[Array, "L K"]) -> Array:
    """Draw one sequence ``[L]`` of the posterior, backwards."""
    keys = jax.random.split(key, len(alpha))
    last = jax.random.categorical(keys[-1], alpha[-1])

    def step(following: Array, inputs: tuple) -> tuple:
        key, at, move = inputs
        drawn = jax.random.categorical(key, at + move[:, following])
        return drawn, drawn

    rest: Array = lax.scan(step, last, (keys[:-1], alpha[:-1], chain.moves), reverse=True)[1]
    return jnp.concatenate([rest, last[None]])


@shown_briefly
class Box(NamedTuple):
    """Box of possible states, ``[d]`` each."""

    low: Float[Array, " d"]
    high: Float[Array, " d"]

    def holds(self, states: Float[Array, "... d"]) -> Array:
        """Mark the states inside, within a millionth of the width for 32-bit numbers."""
        slack = 1e-6 * (self.high - self.low)
        return jnp.all((states >= self.low - slack) & (states <= self.high + slack), -1)


@partial(jax.jit, static_argnums=0)
def _candidate_chains(
    dynamics: DynamicsOfActions,
    box: Box,
    scale: Float[Array, " d"],
    policy: Any,
    sensor: FiniteSensor,
    reported: Recording,
) -> tuple[_Moves, Float[Array, "n L K d"]]:
    places, log_report = sensor.candidates(reported.observations, reported.actions)
    log_policy = policy.log_probs(places).astype(float)
    chosen = jnp.take_along_axis(log_policy, reported.actions[..., None, None], -1)[..., 0]
    factors = jnp.where(box.holds(places), log_report + chosen, -jnp.inf)
    actions = jnp.broadcast_to(reported.actions[..., None], factors.shape)
    expected = dynamics(places, actions)[:, :-1, :, None]
    z = (places[:, 1:, None] - expected) / scale
    # Tails heavier than a Gaussian's keep a recording possible that breaks the dynamics once.
    moves = jnp.logaddexp(-0.5 * jnp.sum(z**2, -1), jnp.log(1e-12) - jnp.sum(jnp.log1p(z**2), -1))
    # Padding has neither transitions nor observations.
    moves = jnp.where(reported.followed[:, :-1, None, None], moves, 0.0)
    first = jnp.where(jnp.arange(factors.shape[-1]) == 0, 0.0, -jnp.inf)
    return _Moves(jnp.where(reported.live[..., None], factors, first), moves), places


@jax.jit
def _candidate_posterior(chains: _Moves, live: Array) -> CandidatePosterior:
    def one(chain: _Moves) -> tuple:
        alpha = _forward(chain)
        log_p = jax.nn.logsumexp(alpha[-1])
        return log_p, jnp.exp(alpha + _backward(chain) - log_p)

    log_likelihood, weights = jax.vmap(one)(chains)
    return CandidatePosterior(log_likelihood, jnp.where(live[..., None], weights, 0.0))


@partial(jax.jit, static_argnums=3)
def _candidate_draws(key: Array, chains: _Moves, places: Array, draws: int) -> Float[Array, "M n L d"]:
    def one(key: Array, chain: _Moves, places: Array) -> Array:
        alpha = _forward(chain)
        which = jax.vmap(lambda k: _draw_candidates(k, chain, alpha))(jax.random.split(key, draws))
        return jnp.take_along_axis(places[None], which[..., None, None], 2)[:, :, 0]

    return jax.vmap(one, out_axes=1)(jax.random.split(key, len(places)), chains, places)


@shown_briefly
class CandidateTruth(NamedTuple):
    """Smoothing over candidates: ``init(recording, sensor) -> chain``, ``refresh(...) -> (chain, truths)``.

    Made by :func:`candidate_truth`. The arguments of ``refresh`` are ``(chain, policy, key, sensor)``. The
    posterior is exact at every call, so the chain is the recording.
    """

    dynamics: DynamicsOfActions
    box: Box
    scale: Float[Array, " d"]
    draws: int

    def init(self, reported: Recording, sensor: FiniteSensor) -> Recording:
        """Return the recording after checking that its truth exists.

        Raises ``ValueError`` for other sizes, and naming trajectory and step if every truth behind the
        observation is outside the space.
        """
        _check(reported, sensor, self.box)
        return reported

    def refresh(
        self, chain: Recording, policy: Any, key: Array, sensor: FiniteSensor
    ) -> tuple[Recording, Truths]:
        """Draw jointly and independently."""
        chains, places = _candidate_chains(self.dynamics, self.box, self.scale, policy, sensor, chain)
        drawn = _candidate_draws(key, chains, places, self.draws)
        return chain, truths(chain, drawn, jnp.broadcast_to(chain.actions, drawn.shape[:-1]))

    def posterior(self, chain: Recording, policy: Any, sensor: FiniteSensor) -> CandidatePosterior:
        """Return the probability of each truth behind each observation."""
        chains, _ = _candidate_chains(self.dynamics, self.box, self.scale, policy, sensor, chain)
        return _candidate_posterior(chains, chain.live)


def candidate_truth(
    dynamics: DynamicsOfActions,
    low: ArrayLike,
    high: ArrayLike,
    *,
    precision: float = 1e-4,
    draws: int = 4,
) -> CandidateTruth:
    """Build smoothing over the possible truths behind each observation.

    Parameters
    ----------
    dynamics : function in JAX; next states after states and numbered actions
    low, high : ``[d]``
        Bounds of the states; truths outside are excluded.
    precision : float
        Deviation of the Gaussian about the dynamics, as a share of the width of the space.
    draws : int, ``M``
    """
    if draws < 1 or not precision > 0:
        raise ValueError(f"draws must be at least 1 and precision positive, got {draws} and {precision}")
    box = _box(low, high)
    return CandidateTruth(dynamics, box, precision * (box.high - box.low), draws)


def fitted_shift_sensor(
    sensor: ShiftSensor, reported: Recording, posterior: CandidatePosterior
) -> ShiftSensor:
    """Fit the probability of a shift by maximum likelihood, given the posterior (the M-step)."""
    share = jnp.sum(posterior.weights[..., 1]) / jnp.sum(reported.live)
    return sensor._replace(probability=jnp.clip(share, 1e-6, 1 - 1e-6))


@shown_briefly
class Partition(NamedTuple):
    """A space cut into cells.

    Fields
    ------
    box : Box
    points : float ``[S, m, d]``
        A grid in each of the ``S = Q ** d`` cells, over which the policy is averaged.
    mdp : TabularMDP
        The cells' transitions: the share of a cell's points whose successor is in each cell (T1).
    """

    box: Box
    points: Float[Array, "S m d"]
    mdp: TabularMDP

    def cell(self, states: Float[Array, "... d"]) -> Array:
        """Return the indices of the cells of states, ``[...]``; states outside count to the nearest."""
        return _cells(self.box, round(self.mdp.n_states ** (1 / len(self.box.low))), states)

    def log_policy(self, policy: Any) -> Float[Array, "S A"]:
        """Return the logarithm of the policy's mean over each cell (T2)."""
        return _log_mean_policy(policy, self.points)


@jax.jit
def _log_mean_policy(policy: Any, points: Float[Array, "S m d"]) -> Float[Array, "S A"]:
    log_p = policy.log_probs(points).astype(float)
    return jax.nn.logsumexp(log_p, axis=1) - jnp.log(points.shape[1])


def _cells(box: Box, parts: int, states: Float[Array, "... d"]) -> Array:
    share = (states - box.low) / (box.high - box.low)
    digits = jnp.clip(jnp.floor(share * parts).astype(int), 0, parts - 1)
    return digits @ (parts ** jnp.arange(len(box.low))[::-1])


def partition(
    dynamics: DynamicsOfActions,
    low: ArrayLike,
    high: ArrayLike,
    n_actions: int,
    *,
    parts: int = 10,
    points: int = 10_000,
    policy_points: int = 100,
    slack: float = 1e-6,
) -> Partition:
    """Cut a box into ``parts ** d`` cells and integrate the dynamics over each (T1 and T3).

    ``points`` per cell (rounded to a full grid) represent it, and ``policy_points`` average the policy, which
    is smooth and evaluated at every call. ``slack`` goes to the cells around the successors, since a grid
    misses detail finer than itself.
    """
    box = _box(low, high)
    d = len(box.low)
    if parts < 1 or points < 1 or n_actions < 1:
        raise ValueError(
            f"parts, points and n_actions must be at least 1, got {parts}, {points} and {n_actions}"
        )
    width = (box.high - box.low) / parts
    corners = box.low + width * _grid(jnp.arange(parts), d)
    n_cells = len(corners)

    def within(count: int) -> Float[Array, "S m d"]:
        side = max(round(count ** (1 / d)), 1)
        return corners[:, None] + width * _grid((jnp.arange(side) + 0.5) / side, d)

    grid = within(points)
    following = jnp.stack(
        [_cells(box, parts, dynamics(grid, jnp.full(grid.shape[:-1], a))) for a in range(n_actions)], 1
    )
    pair = np.repeat(np.arange(n_cells * n_actions), grid.shape[1])
    shares = sparse.csr_array(
        (np.full(len(pair), 1 / grid.shape[1]), (pair, np.asarray(following).ravel())),
        shape=(n_cells * n_actions, n_cells),
    ).toarray()
    about = ndimage.maximum_filter(
        (shares > 0).reshape(-1, *[parts] * d), size=(1, *[3] * d), mode="constant"
    ).reshape(shares.shape)
    shares = (1 - slack) * shares + slack * about / about.sum(1, keepdims=True)
    mdp = TabularMDP.from_sparse(sparse.csr_array(shares), np.ones((n_cells, n_actions, 1)))
    return Partition(box, within(policy_points), mdp)


def _grid(marks: Array, d: int) -> Float[Array, "N d"]:
    return jnp.stack(jnp.meshgrid(*[marks] * d, indexing="ij"), -1).reshape(-1, d).astype(float)


@shown_briefly
class PartitionTruth(NamedTuple):
    """The dissertation's Technique 1: as :class:`CandidateTruth`, with cells."""

    partition: Partition
    draws: int = 4

    def init(self, reported: Recording, sensor: FiniteSensor) -> Recording:
        """Check the recording as :meth:`CandidateTruth.init` does."""
        _check(reported, sensor, self.partition.box)
        return reported

    def factors(self, chain: Recording, policy: Any, sensor: FiniteSensor) -> Float[Array, "n L S A"]:
        """Multiply policy and evidence of each cell and action, in logarithms.

        The likelihood of an observation in a cell is that of its truths in the cell (T4 and T5; the density
        of a cell's states is uniform, and its constant is left out).
        """
        return _cell_factors(self.partition, policy, sensor, chain)[0]

    def cells(self, chain: Recording, policy: Any, sensor: FiniteSensor) -> Float[Array, "n L S"]:
        """Return the posterior probability of each cell."""
        return _cell_posterior(self.partition, policy, sensor, chain)

    def refresh(
        self, chain: Recording, policy: Any, key: Array, sensor: FiniteSensor
    ) -> tuple[Recording, Truths]:
        """Draw cells jointly, and in each of them a truth of the observation."""
        drawn = _drawn_places(key, self.partition, policy, sensor, chain, self.draws)
        return chain, truths(chain, drawn, jnp.broadcast_to(chain.actions, drawn.shape[:-1]))


class _Behind(NamedTuple):
    """Truths behind each observation: positions, cells, and log-likelihoods of the observation."""

    places: Float[Array, "n L K d"]
    cells: Array
    log_report: Float[Array, "n L K"]


@jax.jit
def _cell_factors(
    partition: Partition, policy: Any, sensor: FiniteSensor, chain: Recording
) -> tuple[Float[Array, "n L S A"], _Behind]:
    places, log_report = sensor.candidates(chain.observations, chain.actions)
    log_report = jnp.where(partition.box.holds(places), log_report, -jnp.inf)
    cells = partition.cell(places)
    held = jax.nn.one_hot(cells, partition.mdp.n_states) * jnp.exp(log_report)[..., None]
    taken = jax.nn.one_hot(chain.actions, partition.mdp.n_actions)
    evidence = jnp.log(held.sum(2)[..., None] * taken[..., None, :])
    return evidence + partition.log_policy(policy), _Behind(places, cells, log_report)


@jax.jit
def _cell_posterior(
    partition: Partition, policy: Any, sensor: FiniteSensor, chain: Recording
) -> Float[Array, "n L S"]:
    factors, _ = _cell_factors(partition, policy, sensor, chain)
    return smooth_all(partition.mdp, factors, chain.live).pairs.sum(-1)


@partial(jax.jit, static_argnums=5)
def _drawn_places(
    key: Array, partition: Partition, policy: Any, sensor: FiniteSensor, chain: Recording, draws: int
) -> Float[Array, "M n L d"]:
    def one(key: Array, factor: Array, filtered: Filtered, live: Array, behind: _Behind) -> Array:
        def draw(key: Array) -> Array:
            key_cell, key_place = jax.random.split(key)
            drawn, _ = sample_backward(key_cell, partition.mdp, factor, filtered, live)
            within = jnp.where(behind.cells == drawn[:, None], behind.log_report, -jnp.inf)
            which = jnp.where(live, jax.random.categorical(key_place, within), 0)
            return jnp.take_along_axis(behind.places, which[:, None, None], 1)[:, 0]

        return jax.vmap(draw)(jax.random.split(key, draws))

    factors, behind = _cell_factors(partition, policy, sensor, chain)
    filtered = filter_all(partition.mdp, factors, chain.live)
    keys = jax.random.split(key, len(factors))
    return jax.vmap(one, out_axes=1)(keys, factors, filtered, chain.live, behind)


def partition_truth(
    dynamics: DynamicsOfActions,
    low: ArrayLike,
    high: ArrayLike,
    n_actions: int,
    *,
    parts: int = 10,
    points: int = 10_000,
    draws: int = 4,
) -> PartitionTruth:
    """Build smoothing over cells; parameters as for :func:`partition` and :func:`candidate_truth`."""
    if draws < 1:
        raise ValueError(f"draws must be at least 1, got {draws}")
    return PartitionTruth(partition(dynamics, low, high, n_actions, parts=parts, points=points), draws)


def _box(low: ArrayLike, high: ArrayLike) -> Box:
    box = Box(jnp.asarray(low, float), jnp.asarray(high, float))
    if box.low.ndim != 1 or box.low.shape != box.high.shape or not (box.low < box.high).all():
        raise ValueError(f"low and high must be [d] with low below high, got {box.low} and {box.high}")
    if not (jnp.isfinite(box.low) & jnp.isfinite(box.high)).all():
        raise ValueError(f"low and high must be finite, got {box.low} and {box.high}")
    return box


def _check(reported: Recording, sensor: FiniteSensor, box: Box) -> None:
    d = len(box.low)
    if reported.actions.ndim != 2 or reported.observations.shape[-1] != d:
        raise ValueError(
            f"expected observations [n, L, {d}] and numbered actions [n, L], got "
            f"{reported.observations.shape} and {reported.actions.shape}"
        )
    places, _ = sensor.candidates(reported.observations, reported.actions)
    nowhere = np.asarray(reported.live & ~jnp.any(box.holds(places), -1))
    if nowhere.any():
        i, t = np.argwhere(nowhere)[0]
        raise ValueError(
            f"trajectory {i}, step {t}: no state between {box.low} and {box.high} can be behind the report "
            f"{reported.observations[i, t]} with action {reported.actions[i, t]}"
        )
