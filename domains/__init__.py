"""What is learned from: patrols, their breach, and a mouse in a labyrinth."""

from .breach_trials import BreachOutcome, breach_trials, greedy_policies, random_policies, soft_policies
from .labyrinth import Bout, Labyrinth, labyrinth, read_bouts, simulate_bouts
from .patrol import (
    Interaction,
    Patrol,
    boyd_fifth_floor,
    boyd_with_rooms,
    demonstrate,
    four_hallways,
    instance,
    simulate_patrol,
)

__all__ = [
    "Bout",
    "BreachOutcome",
    "Interaction",
    "Labyrinth",
    "Patrol",
    "boyd_fifth_floor",
    "boyd_with_rooms",
    "breach_trials",
    "demonstrate",
    "four_hallways",
    "greedy_policies",
    "instance",
    "labyrinth",
    "random_policies",
    "read_bouts",
    "simulate_bouts",
    "simulate_patrol",
    "soft_policies",
]
