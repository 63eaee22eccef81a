"""Hopper, Walker2d and HalfCheetah, many robots at a time (section 7.4.3).

The tasks of Gymnasium's ``Hopper-v5``, ``Walker2d-v5`` and ``HalfCheetah-v5`` with their own models, rewards
and terminations, stepped by MuJoCo's threaded rollout instead of one Python object a robot. A state is
MuJoCo's full physics, ``[time, positions, velocities]``, and a step is a pure function of it and the action:
every step starts its contact solver cold, so that the bits are independent of the number of robots or threads
stepped together. Gymnasium starts the solver from the previous step, which moves the result by no more than
the solver's tolerance.

Observations leave out the horizontal position ``x``, on which neither dynamics nor rewards depend. So the
dynamics are also there as a function of the observation alone, with its Jacobians, which is what inference
about noisy observations works with.

Needs the extra ``adversarial``.
"""

from __future__ import annotations

import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ...extras import required
from ...models.inputs.display import shown_briefly
from ...models.networks.modules import ActionSpace

if TYPE_CHECKING:
    import mujoco
    import mujoco.rollout as mujoco_rollout
else:
    mujoco = required("mujoco")
    mujoco_rollout = required("mujoco.rollout")

LARGEST = 1e6  # MuJoCo takes larger numbers for an explosion, and starts the robot anew without a word


class _Task(NamedTuple):
    """Gymnasium's rules for one robot; ``None`` for a rule that it does not have."""

    model: str
    frame_skip: int
    control_cost: float
    reset_noise: float
    normal_velocities: bool
    velocity_limit: float = np.inf
    healthy: bool = False
    state_limit: float = np.inf
    height: tuple[float, float] = (-np.inf, np.inf)
    angle: tuple[float, float] = (-np.inf, np.inf)


_TASKS = {
    "hopper": _Task("hopper.xml", 4, 1e-3, 5e-3, False, 10.0, True, 100.0, (0.7, np.inf), (-0.2, 0.2)),
    "walker2d": _Task("walker2d_v5.xml", 4, 1e-3, 5e-3, False, 10.0, True, np.inf, (0.8, 2.0), (-1.0, 1.0)),
    "half-cheetah": _Task("half_cheetah.xml", 5, 0.1, 0.1, True),
}
ROBOTS = tuple(_TASKS)


class Capsule(NamedTuple):
    """A limb from the side: a disc of ``radius`` swept from ``(x1, z1)`` to ``(x2, z2)``, in metres."""

    x1: float
    z1: float
    x2: float
    z2: float
    radius: float


@shown_briefly
class Locomotion(NamedTuple):
    """One robot's task; made by :func:`locomotion`.

    Fields
    ------
    name : one of :data:`ROBOTS`
    observation_size : int, ``d``: positions but ``x`` (m, rad), then velocities (m/s, rad/s)
    actions : ActionSpace of ``k`` motor torques in [-1, 1] of the strongest; others are cut to the bounds
    horizon : int, steps of an episode
    terminate_when_unhealthy : whether a fall ends the episode. If not, it costs the reward of being healthy,
        1 a step, and every episode has full length
    threads : int, how many step at a time
    """

    name: str
    observation_size: int
    actions: ActionSpace
    horizon: int
    terminate_when_unhealthy: bool
    threads: int

    @property
    def settings(self) -> tuple[tuple[str, Any], ...]:
        """Settings in which the task differs from others of its name."""
        return (("terminate_when_unhealthy", self.terminate_when_unhealthy),)

    @property
    def step_seconds(self) -> float:
        """Simulated time of a step."""
        return _simulator(self.name, self.threads).seconds

    def reset(self, key: Array, n: int) -> Float[np.ndarray, "n D"]:
        """Draw first states of ``n`` robots; the first ones are the same for every ``n``.

        They are 32-bit numbers, so that the first observation of a recording says them exactly (but ``x``).
        """
        simulator, task = _simulator(self.name, self.threads), _TASKS[self.name]
        positions, velocities = np.random.default_rng(np.asarray(_data_of(key))).spawn(2)
        nq, nv, noise = simulator.model.nq, simulator.model.nv, task.reset_noise
        states = np.zeros((n, simulator.state_size), np.float32)
        states[:, 1 : 1 + nq] = simulator.model.qpos0 + positions.uniform(-noise, noise, (n, nq))
        states[:, 1 + nq :] = (
            noise * velocities.standard_normal((n, nv))
            if task.normal_velocities
            else velocities.uniform(-noise, noise, (n, nv))
        )
        return states.astype(np.float64)

    def step(
        self, states: Float[np.ndarray, "n D"], actions: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "n D"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Compute the next states, Gymnasium's rewards, and whether the episode is over.

        Raises ``ValueError`` for other shapes, and for numbers that are not finite or beyond 10⁶.
        """
        simulator, task = _simulator(self.name, self.threads), _TASKS[self.name]
        states = _checked(states, simulator.state_size, "states")
        actions = np.clip(self._actions(actions, len(states)), self.actions.low, self.actions.high)
        following = simulator.advance(states, actions)
        rewards = (following[:, 1] - states[:, 1]) / simulator.seconds
        rewards -= task.control_cost * np.sum(actions**2, 1)
        terminated = np.zeros(len(states), bool)
        if task.healthy:
            healthy = self.healthy(following)
            rewards += healthy
            if self.terminate_when_unhealthy:
                terminated = ~healthy
        return following, rewards, terminated

    def observe(self, states: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "n d"]:
        """Compute Gymnasium's observation: positions but ``x``, and velocities (Hopper's and Walker2d's cut
        at ±10).
        """
        task, nq = _TASKS[self.name], (self.observation_size + 1) // 2
        observations = np.array(states[..., 2:])
        if np.isfinite(task.velocity_limit):
            velocities = observations[..., nq - 1 :]
            np.clip(velocities, -task.velocity_limit, task.velocity_limit, out=velocities)
        return observations

    def healthy(self, states: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, " n"]:
        """Test whether the robot is up: Gymnasium's bounds of height and pitch. HalfCheetah always is."""
        task = _TASKS[self.name]
        height, angle = states[:, 2], states[:, 3]
        return (
            (task.height[0] < height)
            & (height < task.height[1])
            & (task.angle[0] < angle)
            & (angle < task.angle[1])
            & np.all(np.abs(states[:, 3:]) < task.state_limit, axis=1)
        )

    def next_state(
        self, observations: Float[np.ndarray, "n d"], actions: Float[np.ndarray, "n k"]
    ) -> Float[np.ndarray, "n d"]:
        """Predict the next observation, with the observation taken for the state; no noise.

        Exact but where a velocity of Hopper or Walker2d was cut at ±10, which is so in every twelfth step of
        the stored Hopper and in half of the stored Walker2d. The worst next velocity is then off by 0.06 and
        by 0.6 rad/s (medians), and now and then by several. Raises as :meth:`step` does.
        """
        return self.observe(_simulator(self.name, self.threads).advance(*self._taken(observations, actions)))

    def jacobians(
        self, observations: Float[np.ndarray, "n d"], actions: Float[np.ndarray, "n k"], width: float = 1e-7
    ) -> tuple[Float[np.ndarray, "n d d"], Float[np.ndarray, "n d k"]]:
        """Differentiate :meth:`next_state` by the observation (``A``) and the action (``B``).

        Central differences of half-width ``width``, all in one rollout of ``2 (d + k)`` robots each. At a
        bound of the actions the difference is taken from inside, and beyond it ``B`` is zero, as the action
        is cut off. If a foot touches the ground, or a velocity is cut off, between the two ends of a
        difference, the derivative does not exist; the result is the slope between them. Raises as
        :meth:`step` does.
        """
        states, cut = self._taken(observations, actions)
        n, d, k = len(states), self.observation_size, self.actions.size
        low = np.maximum(cut - width, self.actions.low)
        high = np.minimum(cut + width, self.actions.high)
        all_states = np.tile(states[:, None], (1, 2 * (d + k), 1))
        all_actions = np.tile(cut[:, None], (1, 2 * (d + k), 1))
        i, j = np.arange(d), np.arange(k)
        all_states[:, i, 2 + i] += width
        all_states[:, d + i, 2 + i] -= width
        all_actions[:, 2 * d + j, j] = high
        all_actions[:, 2 * d + k + j, j] = low
        following = self.observe(
            _simulator(self.name, self.threads).advance(
                all_states.reshape(-1, states.shape[1]), all_actions.reshape(-1, k)
            )
        ).reshape(n, 2 * (d + k), d)
        by_state = (following[:, :d] - following[:, d : 2 * d]) / (2 * width)
        by_action = (following[:, 2 * d : 2 * d + k] - following[:, 2 * d + k :]) / (high - low)[..., None]
        by_action[np.asarray(actions) != cut] = 0.0
        return by_state.swapaxes(1, 2), by_action.swapaxes(1, 2)

    def silhouette(self, observation: Float[np.ndarray, " d"], x: float = 0.0) -> list[Capsule]:
        """Draw the robot from the side at a given ``x``, in metres; the ground is at height zero."""
        simulator = _simulator(self.name, self.threads)
        state = self._states(np.asarray(observation)[None])[0]
        state[1] = x
        return simulator.capsules(state)

    def _actions(self, actions: Float[np.ndarray, "n k"], n: int) -> Float[np.ndarray, "n k"]:
        actions = _checked(actions, self.actions.size, f"actions of {self.name}")
        if len(actions) != n:
            raise ValueError(f"{n} robots need {n} actions, got {len(actions)}")
        return actions

    def _states(self, observations: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n D"]:
        observations = _checked(observations, self.observation_size, f"observations of {self.name}")
        return np.concatenate([np.zeros((len(observations), 2)), observations], 1)

    def _taken(
        self, observations: Float[np.ndarray, "n d"], actions: Float[np.ndarray, "n k"]
    ) -> tuple[Float[np.ndarray, "n D"], Float[np.ndarray, "n k"]]:
        states = self._states(observations)
        return states, np.clip(self._actions(actions, len(states)), self.actions.low, self.actions.high)


def locomotion(name: str, *, terminate_when_unhealthy: bool = True, threads: int | None = None) -> Locomotion:
    """Make the task of ``"hopper"``, ``"walker2d"`` or ``"half-cheetah"``, with Gymnasium's default
    parameters.

    ``threads`` is by default the number of processor cores allowed to this process. Raises ``ValueError``
    for another name, and ``ModuleNotFoundError`` that says what to install where MuJoCo is missing.

    See Also
    --------
    i2rl.domains.load_expert : an expert of each robot
    i2rl.domains.mountain_car : a task without MuJoCo

    Examples
    --------
    >>> from i2rl.domains import locomotion
    >>> robot = locomotion("hopper")
    >>> robot.observation_size, robot.actions.size, robot.horizon
    (11, 3, 1000)
    """
    if name not in _TASKS:
        raise ValueError(f"the robot is one of {', '.join(ROBOTS)}; got {name!r}")
    if threads is None:
        affinity = getattr(os, "sched_getaffinity", None)  # not on every system
        threads = len(affinity(0)) if affinity else os.cpu_count() or 1
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    model = _simulator(name, threads).model
    low, high = model.actuator_ctrlrange.T
    return Locomotion(
        name,
        model.nq + model.nv - 1,
        ActionSpace(0, tuple(map(float, low)), tuple(map(float, high))),
        1000,
        terminate_when_unhealthy,
        threads,
    )


class _Simulator:
    """A compiled model, with as many scratch spaces as threads; one call at a time."""

    def __init__(self, name: str, threads: int) -> None:
        task = _TASKS[name]
        folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
        self.model = _compiled(folder / task.model)
        self.state_size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
        self.frame_skip = task.frame_skip
        self.seconds = float(self.model.opt.timestep) * task.frame_skip
        self._scratch = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = mujoco_rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._lock = threading.Lock()

    def advance(
        self, states: Float[np.ndarray, "n D"], actions: Float[np.ndarray, "n k"]
    ) -> Float[np.ndarray, "n D"]:
        """Compute the states one step later."""
        n, m = len(states), self.frame_skip
        if n == 0:
            return states.copy()
        path, sensors = np.empty((n, m, self.state_size)), np.empty((n, m, self.model.nsensordata))
        with self._lock:
            self._pool.rollout(
                [self.model] * n,
                self._scratch,
                np.ascontiguousarray(states),
                np.repeat(actions[:, None], m, axis=1),
                nstep=m,
                initial_warmstart=np.zeros((n, self.model.nv)),
                state=path,
                sensordata=sensors,
                skip_checks=True,
                control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            )
        return path[:, -1].copy()

    def capsules(self, state: Float[np.ndarray, " D"]) -> list[Capsule]:
        """Place every limb in the plane of motion."""
        model = self.model
        with self._lock:
            scratch = self._scratch[0]
            scratch.qpos[:] = state[1 : 1 + model.nq]
            mujoco.mj_kinematics(model, scratch)
            centres, frames = scratch.geom_xpos.copy(), scratch.geom_xmat.reshape(-1, 3, 3).copy()
        limbs = []
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
            radius, half = model.geom_size[geom, :2]
            (x, _, z), (dx, _, dz) = centres[geom], half * frames[geom, :, 2]
            limbs.append(Capsule(*map(float, (x - dx, z - dz, x + dx, z + dz, radius))))
        return limbs


def _compiled(path: Path) -> mujoco.MjModel:
    # Asked for a total mass, MuJoCo warns on stderr and in a log file, and says to set it like this instead.
    specification = mujoco.MjSpec.from_file(str(path))
    mass, specification.compiler.settotalmass = specification.compiler.settotalmass, -1.0
    model = specification.compile()
    if mass > 0:
        mujoco.mj_setTotalmass(model, mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@lru_cache
def _simulator(name: str, threads: int) -> _Simulator:
    return _Simulator(name, threads)


def _data_of(key: Array) -> Array:
    return jax.random.key_data(key) if jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def _checked(given: Float[np.ndarray, "n m"], size: int, what: str) -> Float[np.ndarray, "n m"]:
    """Validate states or actions as 64-bit floats; an error names the first bad row."""
    rows = np.asarray(given, np.float64)
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(f"{what} must be [robots, {size}], got the shape {list(rows.shape)}")
    wrong = ~(np.abs(rows) <= LARGEST)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise ValueError(
            f"{what}: number {column} of robot {row} is {rows[row, column]}; expected a finite one up to 1e6"
        )
    return rows
