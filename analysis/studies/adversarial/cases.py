"""The continuous tasks of the adversarial study: who is watched, through what, and how learning is judged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ....domains.robots.control import mountain_car
from ....domains.robots.experts import load_demonstrations, load_expert
from ....domains.robots.reaching import OnionMover, demonstrate_onions, onion_reaching
from ....domains.robots.simulation import simulate
from ....domains.robots.walkers import ROBOTS, locomotion
from ....inference.adversarial.robust import fit_isotropic, fit_shift
from ....inference.completion.gaussian import gaussian_truth, jax_dynamics
from ....inference.completion.partitioned import candidate_truth
from ....models.observation.recordings import MOUNTAIN_CAR_SHIFT, GaussianSensor, Recording, ShiftSensor
from ...judging.returns import accuracy_of_cells, behaviour_accuracies


class Plan(NamedTuple):
    """Settings with which a task is learned.

    Fields
    ------
    sessions : int
    iterations : int, of discriminator and generator in a session; SSRR shares them out over its two policies
    trajectories : int, demonstrated in a session
    covariance : float, of a Gaussian sensor, for states and actions
    shift, probability : float, of mountain car's sensor
    process : ``Q``, how far the truth is let stray from the dynamics: a number, or one for a robot's
        positions and one for its velocities (for the onions' arm, and for what lies on the belt)
    updates, batch : int, of the discriminator in a round
    learning_rate, penalty : float, of the discriminator, and of its gradient
    episodes : int, judged after every session
    settings : of PPO, as pairs
    """

    sessions: int = 8
    iterations: int = 20
    trajectories: int = 1
    covariance: float = 0.05
    shift: float = MOUNTAIN_CAR_SHIFT
    probability: float = 0.25
    process: float | tuple[float, float] = 1e-4
    updates: int = 16
    batch: int = 256
    learning_rate: float = 1e-3
    penalty: float = 1.0
    episodes: int = 4
    settings: tuple[tuple[str, Any], ...] = (
        ("n_envs", 20),
        ("n_steps", 128),
        ("hidden", (64, 64)),
        ("log_deviation", -0.5),
        ("scale_rewards", True),
    )

    @property
    def digest(self) -> str:
        """Short name of all settings."""
        return hashlib.sha256(json.dumps(self).encode()).hexdigest()[:12]


class Case(NamedTuple):
    """A task with its expert and its sensor.

    Fields
    ------
    name : one of :data:`~i2rl.analysis.studies.adversarial.results.DOMAINS`
    environment, level : what is learned in, and what is judged in (episodes of fixed length)
    expert : its policy
    demonstrations : Recording, of all that may be shown
    expert_return : float
    sensor, assumed : the sensor, and its prior if it is learned
    noise : str, the sensor in words
    truth : ``(draws=) -> GaussianTruth`` or a like object
    fit : ``(truth, chain, policy, sensor) -> sensor``
    accuracy : ``(policy, key) -> LBA``
    accuracy_over : str, in words
    cells : ``(policy) -> LBA of each cell``, or None
    held_out : int, steps of the episodes over which rewards are compared
    components : names with units, and columns of observation and action together, that are shown
    plan : Plan
    """

    name: str
    environment: Any
    level: Any
    expert: Any
    demonstrations: Recording
    expert_return: float
    sensor: Any
    assumed: Any
    noise: str
    truth: Callable[..., Any]
    fit: Callable
    accuracy: Callable[[Any, Array], float]
    accuracy_over: str
    cells: Callable[[Any], np.ndarray] | None
    held_out: int
    components: tuple[tuple[str, ...], tuple[int, ...]]
    plan: Plan


_ASSUMED = 0.4
"""What is believed of a sensor before it is learned, as a share of its covariance or probability."""


@lru_cache(maxsize=8)
def case(name: str, plan: Plan | None = None) -> Case:
    """Make the task of that name; ``plan`` replaces its own. Raises ``ValueError`` for another name."""
    if name in ROBOTS:
        return _robot(name, plan or PLANS[name])
    if name == "mountain-car":
        return _mountain_car(plan or PLANS[name])
    if name == "onion":
        return _onion(plan or PLANS[name])
    raise ValueError(f"the task is one of {', '.join(PLANS)}; got {name!r}")


PLANS = {
    "hopper": Plan(sessions=12),
    # A quarter of the velocities of its limbs are above what is shown of them, so that what follows strays.
    "walker2d": Plan(sessions=18, process=(1e-3, 0.1)),
    "half-cheetah": Plan(process=1e-3),
    "mountain-car": Plan(
        sessions=20,
        iterations=10,
        trajectories=2,
        learning_rate=3e-3,
        episodes=40,
        settings=(("n_envs", 20), ("n_steps", 128), ("learning_rate", 1e-3), ("scale_rewards", True)),
    ),
    # What is grasped, dropped or put into the bin jumps.
    "onion": Plan(covariance=0.01, trajectories=4, process=(1e-4, 0.1)),
}


# -- robots -------------------------------------------------------------------------------------------

_SHOWN = {
    "hopper": (("height (m)", "forward speed (m/s)", "first torque (share)"), (0, 5, 11)),
    "walker2d": (("height (m)", "forward speed (m/s)", "first torque (share)"), (0, 8, 17)),
    "half-cheetah": (("pitch (rad)", "forward speed (m/s)", "first torque (share)"), (1, 8, 17)),
}


def _robot(name: str, plan: Plan) -> Case:
    robot = locomotion(name)
    level = locomotion(name, terminate_when_unhealthy=False)
    stored, expert = load_demonstrations(name), load_expert(name)
    limit = np.full(robot.observation_size, np.inf)
    positions = (robot.observation_size + 1) // 2 - 1
    if name != "half-cheetah":  # Gymnasium shows velocities of the others up to 10 only
        limit[positions:] = 10.0
    return Case(
        name,
        robot,
        level,
        expert,
        stored.recording,
        float(stored.returns.mean()),
        *_gaussian(robot, plan),
        partial(
            gaussian_truth,
            robot,
            robot.observation_size,
            process_covariance=_each(plan.process, positions, robot.observation_size),
            observation_bounds=(-limit, limit),
            action_bounds=(np.array(robot.actions.low), np.array(robot.actions.high)),
        ),
        fit_isotropic,
        partial(_on_experts_states, level, expert, 500),
        "the expert's own states",
        None,
        200,
        _SHOWN[name],
        plan,
    )


def _gaussian(environment: Any, plan: Plan) -> tuple[GaussianSensor, GaussianSensor, str]:
    sizes = environment.observation_size, environment.actions.size
    known = GaussianSensor(plan.covariance, plan.covariance).sized(*sizes)
    assumed = GaussianSensor(_ASSUMED * plan.covariance, _ASSUMED * plan.covariance).sized(*sizes)
    return known, assumed, f"normal, covariance {plan.covariance:g} of every state and action"


def _each(process: float | tuple[float, float], first: int, size: int) -> np.ndarray:
    """Make a diagonal: one number for the first components, one for the rest."""
    return np.broadcast_to(process, (2,)).repeat([first, size - first])


def _on_experts_states(environment: Any, expert: Any, length: int, policy: Any, key: Array) -> float:
    return behaviour_accuracies(environment, expert, policy, key, 2, length).expert


# -- mountain car -------------------------------------------------------------------------------------


def _mountain_car(plan: Plan) -> Case:
    environment, expert = mountain_car(), load_expert("mountain-car")
    stored = load_demonstrations("mountain-car")
    sensor = ShiftSensor(jnp.asarray(plan.shift), jnp.asarray(plan.probability))

    def cells(policy: Any) -> np.ndarray:
        return accuracy_of_cells(environment, expert, policy)

    return Case(
        "mountain-car",
        environment,
        environment,
        expert,
        stored.recording,
        float(stored.returns.mean()),
        sensor,
        sensor._replace(probability=jnp.asarray(_ASSUMED * float(sensor.probability))),
        f"position shifted by {float(sensor.shift):.3f} in the direction of the push with probability "
        f"{float(sensor.probability):g}",
        lambda draws: candidate_truth(
            environment.next_state, np.array(environment.low), np.array(environment.high), draws=draws
        ),
        fit_shift,
        lambda policy, key: float(cells(policy).mean()),
        "100 equal cells of the space of states",
        cells,
        200,
        (("position", "velocity (a step)"), (0, 1)),
        plan,
    )


# -- onions -------------------------------------------------------------------------------------------

_STRIDE, _ONION_DEMONSTRATIONS = 0.3, 40


def _onion(plan: Plan) -> Case:
    environment = onion_reaching(_STRIDE)
    expert = OnionMover(_STRIDE, looking=0.0)
    shown = demonstrate_onions(jax.random.key(0), _ONION_DEMONSTRATIONS, _STRIDE, 0.0)
    return Case(
        "onion",
        environment,
        environment,
        expert,
        shown.recording,
        float(simulate(environment, expert, jax.random.key(1), 20, deterministic=True).returns.mean()),
        *_gaussian(environment, plan),
        partial(
            gaussian_truth,
            jax_dynamics(environment.next_state),
            environment.observation_size,
            process_covariance=_each(plan.process, 9, environment.observation_size),
        ),
        fit_isotropic,
        partial(_on_experts_states, environment, expert, 200),
        "the expert's own states",
        None,
        200,
        (("wrist, x (m)", "wrist, y (m)", "wrist, z (m)"), (6, 7, 8)),
        plan,
    )
