"""What is learned from: patrols, their breach, and a mouse in a labyrinth."""

from .breach_trials import BreachOutcome, breach_trials, greedy_policies, random_policies, soft_policies
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
    "BreachOutcome",
    "Interaction",
    "Patrol",
    "boyd_fifth_floor",
    "boyd_with_rooms",
    "breach_trials",
    "demonstrate",
    "four_hallways",
    "greedy_policies",
    "instance",
    "random_policies",
    "simulate_patrol",
    "soft_policies",
]
