"""Onion sorting by a wrist that moves through space: the continuous onion line (section 7.4.3).

An arm reaches over a belt with five onions, brings each to the eyes, and drops it in a bin (blemished) or at
the belt's end (unblemished). The rules (grasp distance, places of the bin and the belt's end, rewards, 400
steps) are those of the environment that the dissertation's authors released for three dimensions.

The 64-dimensional recordings behind Table 7.5 were never released, nor were most of the learned models of the
arm that its simulator needed. This is the smaller successor, of 29 dimensions, for which ten recordings were
released (:mod:`i2rl.domains.robots.onion_recordings`); it does **not** reproduce Table 7.5.

Two things are modelled rather than recorded:

- *The arm.* Shoulder and elbow follow from the wrist. The shoulder rests at the recordings' median and leans
  toward targets out of reach; upper arm (0.30 m) and forearm (0.20 m, to where the wrist was tracked) are the
  recordings' median lengths; the elbow bends down, back and to the right. The authors used regressors that
  they fitted to their recordings.
- *The hand.* Its place is the wrist's: an onion within 0.05 m of the wrist is held and moves with it. In the
  recordings a held onion is 0.1 to 0.3 m from the wrist, so recorded actions, replayed here, miss every
  onion.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment
from ...models.networks.modules import ActionSpace
from .simulation import Trajectories, simulate

ONIONS = 5
SIZE = 9 + 4 * ONIONS
"""Shoulder, elbow and wrist (``x, y, z``, metres), then of each onion ``x, y, z`` and its label."""
UNBLEMISHED, BLEMISHED, GONE = 1.0, 0.0, -1.0
"""Labels; of an onion in the bin all four numbers are -1."""

GRASP = 0.05
STEP_COST = 0.001
STRIDE = 0.75
"""Metres that an action of 1 moves the wrist: the longest recorded displacement along an axis."""

BELT_HEIGHT = 0.77
_BIN = ((0.3, 0.45, 0.95), (0.6, jnp.inf, jnp.inf))
_END = ((0.6, -jnp.inf, -jnp.inf), (0.85, -0.4, 0.85))
_REACH = ((0.2, -0.65, 0.75), (0.95, 0.70, 1.30))

_SHOULDER = (0.47, -0.12, 1.42)
_UPPER_ARM, _FOREARM = 0.30, 0.20
_STRETCHED = _UPPER_ARM + _FOREARM - 1e-3  # never quite straight, where the elbow has no derivative
_BEND = (-1.0, -1.0, -1.0)

_START = (0.54, -0.14, 1.0)
_ROWS = (-0.16, -0.08, 0.01, 0.10, 0.18)


@shown_briefly
class Scene(NamedTuple):
    """An observation taken apart.

    Fields
    ------
    wrist : float ``[..., 3]``
    onions : float ``[..., 5, 3]``
    labels : float ``[..., 5]``
    """

    wrist: Float[Array, "... 3"]
    onions: Float[Array, "... 5 3"]
    labels: Float[Array, "... 5"]

    @property
    def dealt_with(self) -> Bool[Array, "... 5"]:
        """Onions that are in the bin or at the belt's end, and stay there."""
        return (self.labels < -0.5) | _within(self.onions, _END)

    @property
    def held(self) -> Bool[Array, "... 5"]:
        """The onion in the hand: the nearest of those within grasp that are not dealt with."""
        apart = jnp.linalg.norm(self.onions - self.wrist[..., None, :], axis=-1)
        apart = jnp.where(self.dealt_with, jnp.inf, apart)
        nearest = jnp.arange(ONIONS) == jnp.argmin(apart, -1)[..., None]
        return nearest & (apart < GRASP)


def scene(observations: Float[Array, "... 29"]) -> Scene:
    """Extract the scene of an observation: all of it but the arm."""
    things = observations[..., 9:].reshape(*observations.shape[:-1], ONIONS, 4)
    return Scene(observations[..., 6:9], things[..., :3], things[..., 3])


def arm(wrist: Float[Array, "... 3"]) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Compute shoulder and elbow of a wrist, by inverse kinematics of two links; see the module's text."""
    rest, hint = (jnp.asarray(x, wrist.dtype) for x in (_SHOULDER, _BEND))
    reach = jnp.linalg.norm(wrist - rest, axis=-1, keepdims=True)
    toward = (wrist - rest) / reach
    shoulder = rest + jnp.maximum(reach - _STRETCHED, 0) * toward
    reach = jnp.minimum(reach, _STRETCHED)
    along = (_UPPER_ARM**2 - _FOREARM**2 + reach**2) / (2 * reach)
    aside = hint - jnp.sum(hint * toward, -1, keepdims=True) * toward
    aside = aside / jnp.linalg.norm(aside, axis=-1, keepdims=True)
    return shoulder, shoulder + along * toward + jnp.sqrt(_UPPER_ARM**2 - along**2) * aside


def compose(seen: Scene) -> Float[Array, "... 29"]:
    """Compose the observation of a scene; the arm follows from the wrist."""
    things = jnp.concatenate([seen.onions, seen.labels[..., None]], -1)
    flat = things.reshape(*things.shape[:-2], 4 * ONIONS)
    return jnp.concatenate([*arm(seen.wrist), seen.wrist, flat], -1)


@shown_briefly
class Outcome(NamedTuple):
    """Outcome of a step: the next observation, its reward, and whether all onions are dealt with."""

    observation: Float[Array, "... 29"]
    reward: Float[Array, "..."]
    finished: Bool[Array, "..."]


def move(observations: Float[Array, "... 29"], actions: Array, stride: float = STRIDE) -> Outcome:
    """Move the wrist, and the onion it holds, by ``stride`` times the actions ``[..., 3]``, cut to ±1.

    A held onion that comes into the bin is gone; one that comes to the belt's end lies there. Either earns 1
    if that is where its label belongs, or else costs 1; every step costs 0.001.
    """
    before = scene(observations)
    shift = stride * jnp.clip(jnp.asarray(actions, observations.dtype), -1, 1)
    low, high = (jnp.asarray(x, observations.dtype) for x in _REACH)
    wrist = jnp.clip(before.wrist + shift, low, high)
    held, blemished = before.held, before.labels < 0.5
    onions = jnp.where(held[..., None], wrist[..., None, :], before.onions)
    binned, placed = held & _within(onions, _BIN), held & _within(onions, _END)
    onions = onions.at[..., 2].set(jnp.where(placed, BELT_HEIGHT, onions[..., 2]))
    after = Scene(
        wrist,
        jnp.where(binned[..., None], GONE, onions),
        jnp.where(binned, GONE, before.labels),
    )
    right = (binned & blemished) | (placed & ~blemished)
    wrong = (binned & ~blemished) | (placed & blemished)
    reward = jnp.sum(right, -1) - jnp.sum(wrong, -1) - STEP_COST
    return Outcome(compose(after), reward.astype(jnp.float32), after.dealt_with.all(-1))


@lru_cache
def onion_reaching(stride: float = STRIDE, horizon: int = 400) -> Environment:
    """Make the task: observations of 29 numbers in metres, actions of 3 in [-1, 1], in units of ``stride``
    metres.

    First states are drawn: five onions on the belt, each blemished with probability one half. The episode
    terminates when all are dealt with. The observation determines the onion in hand, so it is the state.
    Raises ``ValueError`` for a stride that is not positive.

    See Also
    --------
    i2rl.domains.read_onion_recordings : recordings of the task
    i2rl.inference.robust_airl : learn from noisy ones

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import onion_reaching
    >>> task = onion_reaching()
    >>> task.observation_size, task.actions.size, task.horizon
    (29, 3, 400)
    >>> task.observe(task.reset(jax.random.key(0))).shape
    (29,)
    """
    if not stride > 0:
        raise ValueError(f"the stride is a length in metres, got {stride}")
    return Environment(
        name="onion",
        observation_size=SIZE,
        low=(-1.0,) * SIZE,
        high=(1.5,) * SIZE,
        actions=ActionSpace(0, (-1.0,) * 3, (1.0,) * 3),
        horizon=horizon,
        reset=_reset,
        step=partial(_step, stride=stride),
        observe=_observe,
        next_state=partial(_next_state, stride=stride),
        settings=(("stride", stride),),
    )


def _reset(key: Array) -> Float[Array, " 29"]:
    k_wrist, k_onions, k_labels = jax.random.split(key, 3)
    wrist = jnp.asarray(_START, float) + jax.random.uniform(k_wrist, (3,), float, -0.05, 0.05)
    spread = jax.random.uniform(k_onions, (2, ONIONS), float)
    onions = jnp.stack(
        [
            0.65 + 0.2 * spread[0],
            jnp.asarray(_ROWS) + 0.02 * spread[1] - 0.01,
            jnp.full(ONIONS, BELT_HEIGHT),
        ],
        -1,
    )
    labels = jax.random.bernoulli(k_labels, 0.5, (ONIONS,)).astype(float)
    return compose(Scene(wrist, onions, labels))


def _step(state: Array, action: Array, *, stride: float) -> tuple[Array, Array, Array]:
    return tuple(move(state, action, stride))  # type: ignore[return-value]


def _next_state(observation: Array, action: Array, *, stride: float) -> Array:
    return move(observation, action, stride).observation


def _observe(state: Array) -> Float[Array, "... 29"]:
    return state.astype(jnp.float32)


def _within(points: Float[Array, "... 3"], box: tuple) -> Bool[Array, "..."]:
    low, high = (jnp.asarray(x, points.dtype) for x in box)
    return jnp.all((points > low) & (points < high), -1)


# -- a mover that sorts -------------------------------------------------------------------------------

_LOOK = (0.50, -0.12, 1.17)
_INTO_BIN = (0.45, 0.57, 1.12)
_ON_THE_WAY = (0.50, -0.45, 1.00)
_ONTO_END = (0.70, -0.50, 0.80)
_HOVER = 0.12
_LOOKING_ON = 0.9
_WOBBLE = (0.05, 0.012, 0.015)
_UNSTEADY = 0.06
_LONGEST = 0.45


@shown_briefly
class OnionMover(NamedTuple):
    """Scripted expert that sorts without error from the observation alone, much as the recorded person does.

    The hand hovers over the next onion along the belt, comes down on it, brings it before the eyes, and takes
    it to its destination. Drawn actions wobble before the eyes for about ten steps, vary in length and are a
    little unsteady; the mode has none of this noise.

    Fields
    ------
    stride : float, metres of an action of 1, as the environment's
    looking : float in [0, 1), the chance of a drawn action before the eyes to go on looking. Then the next
        action has two modes; at 0 a normal policy can follow it
    """

    stride: Any = STRIDE
    looking: Any = _LOOKING_ON

    @property
    def actions(self) -> ActionSpace:
        """Vectors of 3 in [-1, 1]."""
        return onion_reaching().actions

    def mode(self, observations: Float[Array, "... 29"]) -> Float[Array, "... 3"]:
        """Move straight to the next way-point."""
        way, _ = _way(observations)
        return self._limited(way, jnp.asarray(_LONGEST, way.dtype))

    def sample(self, key: Array, observations: Float[Array, "... 29"]) -> Float[Array, "... 3"]:
        """Draw actions."""
        way, looking = _way(observations)
        k_look, k_wobble, k_length, k_unsteady = jax.random.split(key, 4)
        batch, dtype = way.shape[:-1], way.dtype
        wobble = jnp.asarray(_WOBBLE, dtype) * jax.random.normal(k_wobble, way.shape, dtype)
        about = jnp.asarray(_LOOK, dtype) + wobble - observations[..., 6:9]
        stays = looking & jax.random.bernoulli(k_look, self.looking, batch)
        longest = jax.random.uniform(k_length, batch, dtype, 0.4, 1.2)[..., None] * _LONGEST
        unsteady = _UNSTEADY * jax.random.normal(k_unsteady, way.shape, dtype)
        moved = self._limited(way, longest)
        moved += unsteady * jnp.linalg.norm(moved, axis=-1, keepdims=True)
        return jnp.where(stays[..., None], self._limited(about, longest), moved)

    def _limited(self, way: Array, longest: Array) -> Array:
        """Convert to the environment's units, cut to ``longest`` metres and the bounds."""
        length = jnp.linalg.norm(way, axis=-1, keepdims=True)
        way = way * jnp.minimum(1, longest / jnp.maximum(length, 1e-9)) / jnp.asarray(self.stride, way.dtype)
        return way / jnp.maximum(jnp.max(jnp.abs(way), -1, keepdims=True), 1)


def _way(observations: Float[Array, "... 29"]) -> tuple[Float[Array, "... 3"], Bool[Array, "..."]]:
    """Return the displacement to the mover's next way-point, and whether it may go on inspecting instead."""
    seen = scene(observations)
    wrist, held = seen.wrist, seen.held
    look, into_bin, on_the_way, onto_end = (
        jnp.asarray(x, wrist.dtype) for x in (_LOOK, _INTO_BIN, _ON_THE_WAY, _ONTO_END)
    )

    def which(mask: Array, yes: Array, no: Array) -> Array:
        return jnp.where(mask[..., None], yes, no)

    waiting = ~seen.dealt_with
    following = waiting & (jnp.cumsum(waiting, -1) == 1)
    onion = jnp.sum(jnp.where(following[..., None], seen.onions, 0), -2)
    near = jnp.linalg.norm((onion - wrist)[..., :2], axis=-1) < 0.1
    above = onion + jnp.array([0, 0, _HOVER], wrist.dtype)
    to_onion = which(near, onion, above)

    blemished = jnp.any(held & (seen.labels < 0.5), -1)
    over_belt = (wrist[..., 0] > 0.58) & (wrist[..., 1] > -0.25)
    to_end = which(wrist[..., 1] > -0.3, on_the_way, onto_end)
    carried = which(over_belt, look, which(blemished, into_bin, to_end))
    carrying = held.any(-1)
    looking = (
        carrying & ~over_belt & (jnp.abs(wrist[..., 1] - look[1]) < 0.05) & (wrist[..., 2] > look[2] - 0.1)
    )
    target = which(carrying, carried, to_onion)
    # The hand stays once all onions are sorted.
    return which(waiting.any(-1), target - wrist, jnp.zeros_like(wrist)), looking


def demonstrate_onions(
    key: Array, n: int, stride: float = STRIDE, looking: float = _LOOKING_ON
) -> Trajectories:
    """Simulate ``n`` synthetic recordings: actions drawn from the mover in :func:`onion_reaching`."""
    return simulate(onion_reaching(stride), OnionMover(stride, looking), key, n)
