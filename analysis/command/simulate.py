"""``i2rl simulate``: simulated demonstrations as JSON Lines."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from .console import reported_errors
from .options import Instance, Percent, Seed, count_option

commands = typer.Typer(help="Write simulated demonstrations as JSON Lines.", no_args_is_help=True)


@commands.command("patrol")
def simulate_patrol(
    instance: Instance = 2,
    observability: Percent = None,
    sessions: Annotated[int, count_option("Trajectories per patroller.")] = 60,
    steps: Annotated[int, count_option("Steps of a trajectory.")] = 5,
    seed: Seed = 0,
) -> None:
    """Write a learner's observations of the patrollers, one trajectory a line, to standard output."""
    import jax

    from ...domains.patrol.process import demonstrate
    from ...domains.patrol.process import instance as patrol_instance
    from ...models.observation.demonstration import write_trajectories

    with reported_errors():
        patrol = patrol_instance(instance)
        demonstrations = demonstrate(jax.random.key(seed), patrol, observability, sessions, steps)
        for i in range(sessions):
            for agent, demonstration in enumerate(demonstrations):
                name = f"{patrol.name}-{i}-{agent}"
                write_trajectories(
                    sys.stdout, demonstration.select([i]), patrol.mdp, ids=[name], agents=[agent]
                )
