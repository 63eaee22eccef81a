"""Classic control as pure functions: Gymnasium's CartPole-v1 and MountainCar-v0, compiled with their users.

The states are 64-bit floats and the dynamics, rewards, first states, terminations and time limits are
Gymnasium's own (Barto, Sutton and Anderson 1983; Moore 1990).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from ...models.networks.environment import Environment
from ...models.networks.modules import ActionSpace

_GRAVITY = 9.8
_POLE_MASS = 0.1
_TOTAL_MASS = 1.1
_HALF_LENGTH = 0.5
_POLE_MOMENT = _POLE_MASS * _HALF_LENGTH
_FORCE = 10.0
_SECONDS = 0.02
_FURTHEST = 2.4
_STEEPEST = 12 * 2 * math.pi / 360

_LEFT_END, _RIGHT_END = -1.2, 0.6
_TOP_SPEED = 0.07
_FLAG = 0.5
_THRUST = 0.001
_SLOPE = 0.0025


def cart_pole(horizon: int = 500) -> Environment:
    """Build CartPole-v1: 2 actions push the cart left or right; one point for each step until the pole falls.

    Observations are the cart's position (m) and velocity (m/s), the pole's angle (rad) and its velocity
    (rad/s). An episode terminates beyond 2.4 m or 12 degrees.

    See Also
    --------
    i2rl.domains.mountain_car : another task
    i2rl.inference.ppo : learn to act in it

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import cart_pole
    >>> task = cart_pole()
    >>> task.observation_size, task.actions.n, task.horizon
    (4, 2, 500)
    >>> state, reward, terminated = task.step(task.reset(jax.random.key(0)), 1)
    >>> float(reward), bool(terminated)
    (1.0, False)
    """
    wide = (2 * _FURTHEST, math.inf, 2 * _STEEPEST, math.inf)
    return Environment(
        name="cart-pole",
        observation_size=4,
        low=tuple(-x for x in wide),
        high=wide,
        actions=ActionSpace(2),
        horizon=horizon,
        reset=_reset_cart_pole,
        step=_step_cart_pole,
        observe=_observe,
        next_state=cart_pole_dynamics,
    )


def mountain_car(horizon: int = 200) -> Environment:
    """Build MountainCar-v0: 3 actions push left, not at all, or right; every step costs one until the flag.

    Observations are the position, in [-1.2, 0.6], and the velocity, in [-0.07, 0.07] a step. An episode
    terminates at a position of 0.5 or more that is not left again.

    See Also
    --------
    i2rl.domains.cart_pole : another task
    i2rl.domains.load_expert : its expert

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import mountain_car
    >>> task = mountain_car()
    >>> task.observation_size, task.actions.n, task.horizon
    (2, 3, 200)
    >>> state, reward, terminated = task.step(task.reset(jax.random.key(0)), 2)
    >>> float(reward), bool(terminated)
    (-1.0, False)
    """
    return Environment(
        name="mountain-car",
        observation_size=2,
        low=(_LEFT_END, -_TOP_SPEED),
        high=(_RIGHT_END, _TOP_SPEED),
        actions=ActionSpace(3),
        horizon=horizon,
        reset=_reset_mountain_car,
        step=_step_mountain_car,
        observe=_observe,
        next_state=mountain_car_dynamics,
    )


def cart_pole_dynamics(states: ArrayLike, actions: ArrayLike) -> Float[Array, "... 4"]:
    """Compute the states ``[..., 4]`` after actions ``[...]``, by Euler's method."""
    states = jnp.asarray(states)
    x, speed, angle, turning = (states[..., i] for i in range(4))
    force = jnp.where(jnp.asarray(actions) == 1, _FORCE, -_FORCE).astype(states.dtype)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    push = (force + _POLE_MOMENT * turning**2 * sin) / _TOTAL_MASS
    turning_rate = (_GRAVITY * sin - cos * push) / (
        _HALF_LENGTH * (4.0 / 3.0 - _POLE_MASS * cos**2 / _TOTAL_MASS)
    )
    speed_rate = push - _POLE_MOMENT * turning_rate * cos / _TOTAL_MASS
    return jnp.stack(
        [
            x + _SECONDS * speed,
            speed + _SECONDS * speed_rate,
            angle + _SECONDS * turning,
            turning + _SECONDS * turning_rate,
        ],
        -1,
    )


def mountain_car_dynamics(states: ArrayLike, actions: ArrayLike) -> Float[Array, "... 2"]:
    """Compute the states ``[..., 2]`` after actions ``[...]``; the left end stops the car."""
    states = jnp.asarray(states)
    position, velocity = states[..., 0], states[..., 1]
    thrust = (jnp.asarray(actions) - 1).astype(states.dtype) * _THRUST
    velocity = jnp.clip(velocity + (thrust - _SLOPE * jnp.cos(3 * position)), -_TOP_SPEED, _TOP_SPEED)
    position = jnp.clip(position + velocity, _LEFT_END, _RIGHT_END)
    # The end of the track in the states' own precision, or a state of 32 bits would never be at it.
    stopped = (position == jnp.asarray(_LEFT_END, states.dtype)) & (velocity < 0)
    return jnp.stack([position, jnp.where(stopped, 0.0, velocity)], -1)


def at_flag(states: ArrayLike) -> Bool[Array, "..."]:
    """Test whether mountain-car states ``[..., 2]`` are at the flag or beyond it, and not rolling back."""
    states = jnp.asarray(states)
    return (states[..., 0] >= _FLAG) & (states[..., 1] >= 0)


def _reset_cart_pole(key: Array) -> Float[Array, "4"]:
    return jax.random.uniform(key, (4,), jnp.float64, -0.05, 0.05)


def _step_cart_pole(state: Array, action: Array) -> tuple[Array, Array, Array]:
    state = cart_pole_dynamics(state, action)
    terminated = (jnp.abs(state[..., 0]) > _FURTHEST) | (jnp.abs(state[..., 2]) > _STEEPEST)
    return state, jnp.ones(state.shape[:-1], jnp.float32), terminated


def _reset_mountain_car(key: Array) -> Float[Array, "2"]:
    position = jax.random.uniform(key, (), jnp.float64, -0.6, -0.4)
    return jnp.stack([position, jnp.zeros_like(position)])


def _step_mountain_car(state: Array, action: Array) -> tuple[Array, Array, Array]:
    state = mountain_car_dynamics(state, action)
    return state, jnp.full(state.shape[:-1], -1.0, jnp.float32), at_flag(state)


def _observe(state: Array) -> Float[Array, "... d"]:
    return state.astype(jnp.float32)
