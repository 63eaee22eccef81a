"""Gymnasium environments of every domain; importing this module registers them.

======================================  ================================================================
``i2rl/Patrol1-v0`` to ``Patrol3-v0``   one patroller on its floor
``i2rl/Labyrinth-v0``                   a mouse that is rewarded for water
``i2rl/SortingWithClaiming-v0``         onion sorting, 26 states; ``behaviour`` says whose reward
``i2rl/SortingWithoutClaiming-v0``      onion sorting, 23 states; likewise
``i2rl/PickInspectPlace-v0``            onion sorting, 22 states
``i2rl/ObjectWorld-v0``                 a walled grid; ``layout`` seeds its walls
``i2rl/Breach2-v0``, ``Breach3-v0``     the learner's path past the patrollers; ``observability`` its view
======================================  ================================================================

Those with a :class:`TabularMDP` are :class:`TabularEnv` and take ``weights``, the reward ``weights .
phi(s, a)`` (by default the domain's true ones). Their episodes never terminate; they are truncated after the
steps given at registration (``max_episode_steps``). A breach is :class:`BreachEnv` and ends at a goal or when
the learner is seen.

Several at once: ``gymnasium.make_vec("i2rl.domains:i2rl/Patrol2-v0", ...)``. In processes of their own
(``vectorization_mode="async"``) they need ``vector_kwargs={"context": "spawn"}``, since JAX does not survive
a fork.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import jax
import numpy as np

from .gym.tabular import TabularEnv
from .labyrinth.process import WATER_PORT, mouse_labyrinth
from .object_world.process import random_object_world
from .patrol.process import instance
from .sorting.process import Sorting, pick_inspect_place, sorting_with_claiming, sorting_without_claiming

if TYPE_CHECKING:
    from .gym.canvas import Scene
    from .patrol.environment import BreachEnv


def patrol_environment(number: int = 2, weights: Sequence[float] | None = None, **options: Any) -> TabularEnv:
    """Make the environment of one patroller of an instance; other options as :class:`TabularEnv`."""
    patrol = instance(number)

    def scene() -> Scene:
        from .patrol.picture import patrol_scene

        return patrol_scene(patrol)

    return TabularEnv(patrol.mdp, patrol.weights if weights is None else weights, scene=scene, **options)


def labyrinth_environment(weights: Sequence[float] | None = None, **options: Any) -> TabularEnv:
    """Make the mouse's environment; by default it earns one at the water port and zero elsewhere."""
    maze = mouse_labyrinth()
    thirst = np.array([name == f"reaches {WATER_PORT}" for name in maze.mdp.feature_names], float)

    def scene() -> Scene:
        from .labyrinth.picture import labyrinth_scene

        return labyrinth_scene(maze)

    return TabularEnv(maze.mdp, thirst if weights is None else weights, scene=scene, **options)


_SORTING = {
    "with claiming": sorting_with_claiming,
    "without claiming": sorting_without_claiming,
    "pick-inspect-place": pick_inspect_place,
}


def sorting_environment(
    process: str = "with claiming",
    behaviour: str | None = None,
    weights: Sequence[float] | None = None,
    **options: Any,
) -> TabularEnv:
    """Make the environment of onion sorting; the reward is that of ``behaviour`` (by default the first), or
    ``weights``.

    Raises ``ValueError`` for a process or behaviour that does not exist, and if both ``behaviour`` and
    ``weights`` are given.
    """
    if process not in _SORTING:
        raise ValueError(f"process must be one of {', '.join(_SORTING)}, got {process!r}")
    sorting = _SORTING[process]()
    if weights is not None and behaviour is not None:
        raise ValueError("a reward is given by behaviour or by weights, not both")
    reward = _weights_of(sorting, behaviour) if weights is None else weights

    def scene() -> Scene:
        from .sorting.picture import sorting_scene

        return sorting_scene(sorting)

    return TabularEnv(sorting.mdp, reward, scene=scene, **options)


def _weights_of(sorting: Sorting, behaviour: str | None) -> np.ndarray:
    name = sorting.behaviours[0] if behaviour is None else behaviour
    if name not in sorting.behaviours:
        raise ValueError(f"behaviour must be one of {', '.join(sorting.behaviours)}, got {name!r}")
    return sorting.weights[sorting.behaviours.index(name)]


def object_world_environment(
    layout: int = 0,
    size: int = 10,
    walls: int = 25,
    slip: float = 0.0,
    weights: Sequence[float] | None = None,
    **options: Any,
) -> TabularEnv:
    """Make the environment of an Object World; the seed ``layout`` determines its walls."""
    world = random_object_world(jax.random.key(layout), size, walls, slip=slip)

    def scene() -> Scene:
        from .object_world.picture import object_world_scene

        return object_world_scene(world)

    return TabularEnv(world.mdp, world.weights if weights is None else weights, scene=scene, **options)


def breach_environment(number: int = 2, **options: Any) -> BreachEnv:
    """Make the environment of an instance's breach; other options as :class:`BreachEnv`."""
    from .patrol.environment import BreachEnv

    return BreachEnv(instance(number), **options)


_HERE = __name__
ENVIRONMENTS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "i2rl/Patrol1-v0": ("patrol_environment", 200, {"number": 1}),
    "i2rl/Patrol2-v0": ("patrol_environment", 200, {"number": 2}),
    "i2rl/Patrol3-v0": ("patrol_environment", 200, {"number": 3}),
    "i2rl/Labyrinth-v0": ("labyrinth_environment", 200, {}),
    "i2rl/SortingWithClaiming-v0": ("sorting_environment", 50, {"process": "with claiming"}),
    "i2rl/SortingWithoutClaiming-v0": ("sorting_environment", 50, {"process": "without claiming"}),
    "i2rl/PickInspectPlace-v0": ("sorting_environment", 50, {"process": "pick-inspect-place"}),
    "i2rl/ObjectWorld-v0": ("object_world_environment", 50, {}),
    # Two rounds of the patrol to leave in, and sixty steps for the path.
    "i2rl/Breach2-v0": ("breach_environment", 172, {"number": 2}),
    "i2rl/Breach3-v0": ("breach_environment", 188, {"number": 3}),
}
for _id, (_maker, _steps, _options) in ENVIRONMENTS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(_id, f"{_HERE}:{_maker}", max_episode_steps=_steps, kwargs=_options)
