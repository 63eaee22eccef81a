"""What is learned from: patrols and their breach, onion sorting, object worlds, a mouse in a labyrinth.

Importing it registers them with Gymnasium; see :mod:`i2rl.domains.environments`. Names of tasks for networks
are imported when they are first used: they need the extra ``adversarial``.
"""

import importlib
from typing import Any

from . import environments  # noqa: F401  (registers them)
from .gym.tabular import TabularEnv
from .labyrinth.process import Bout, Labyrinth, mouse_labyrinth, read_bouts, simulate_bouts
from .noisy.swap_noise import SwapNoise
from .noisy.tasks import (
    NoisyDemonstration,
    NoisyTask,
    agreement_probabilities,
    demonstrate_noisy,
    noisy_patrol,
    noisy_sorting,
)
from .object_world.process import ObjectWorld, random_object_world, walled_world, without_blocked_moves
from .patrol.environment import BreachEnv
from .patrol.process import (
    Interaction,
    Patrol,
    boyd_fifth_floor,
    boyd_with_rooms,
    demonstrate,
    four_hallways,
    instance,
    simulate_patrol,
)
from .patrol.trials import BreachOutcome, breach_trials, greedy_policies, random_policies, soft_policies
from .sorting.line import Line, Tally, sort_belts
from .sorting.process import (
    MixedDemonstration,
    Sorting,
    demonstrate_sorting,
    pick_inspect_place,
    sorting_with_claiming,
    sorting_without_claiming,
)

_HOMES = {
    "robots.control": ("cart_pole", "mountain_car"),
    "robots.experts": ("load_demonstrations", "load_expert"),
    "robots.onion_recordings": ("read_onion_recordings", "write_onion_recordings"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = [
    "Bout",
    "BreachEnv",
    "BreachOutcome",
    "Interaction",
    "Labyrinth",
    "Line",
    "MixedDemonstration",
    "NoisyDemonstration",
    "NoisyTask",
    "ObjectWorld",
    "Patrol",
    "Sorting",
    "SwapNoise",
    "TabularEnv",
    "Tally",
    "agreement_probabilities",
    "boyd_fifth_floor",
    "boyd_with_rooms",
    "breach_trials",
    "demonstrate",
    "demonstrate_noisy",
    "demonstrate_sorting",
    "four_hallways",
    "greedy_policies",
    "instance",
    "mouse_labyrinth",
    "noisy_patrol",
    "noisy_sorting",
    "random_object_world",
    "pick_inspect_place",
    "random_policies",
    "read_bouts",
    "simulate_bouts",
    "simulate_patrol",
    "soft_policies",
    "sort_belts",
    "sorting_with_claiming",
    "sorting_without_claiming",
    "walled_world",
    "without_blocked_moves",
    *_HOME_OF,
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)
