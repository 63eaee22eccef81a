"""Cost of one robust discriminator update of 32 pairs, truth included.

``python -m i2rl.analysis.benchmarks.cost.adversarial`` prints a table and writes
``build/bench/adversarial_cost.json``. For comparison, the logs released with the dissertation put one such
update (continuous onions) at a median of 0.86, 1.6 and 4.8 minutes on three machines.

Parts, each compiled before it is timed: smoothing and drawing the truth behind a window of 32 observed pairs
under the current policy with the dynamics as last linearised (*draw*), the same after linearising anew
(*refresh*, which simulates), and the update of the discriminator on the draws (*update*).
"""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from ....domains.robots.experts import load_expert
from ....domains.robots.reaching import demonstrate_onions
from ....inference.adversarial.discriminator import Transitions, airl_discriminator
from ....inference.adversarial.learner import AdversarialTraining, discriminator_objective
from ....inference.adversarial.robust import as_expert
from ....inference.adversarial.updates import discriminator_updates
from ....models.networks.modules import policy_network
from ....models.observation.recordings import Recording, distort
from ...studies.adversarial.cases import case
from ..harness import median_seconds, print_table, publish

PAIRS = 32
RUNS = 21


def measured(name: str) -> dict[str, float]:
    """Measure milliseconds of each part, for a task of :mod:`i2rl.analysis.studies.adversarial.cases`."""
    of = case(name)
    task = of.environment
    truth = of.truth(draws=4)
    shown = of.demonstrations
    observations, actions, live = (x[:1, 20 : 20 + PAIRS] for x in shown[:3])
    window = Recording(observations, actions, live, shown.terminated[:1] & False)
    reported = distort(jax.random.key(0), of.sensor, window)
    policy = _policy(name)
    chain, drawn = truth.refresh(truth.init(reported, of.sensor), policy, jax.random.key(1), of.sensor)
    discriminator = airl_discriminator(task.observation_size, task.actions)
    network = discriminator.init(jax.random.key(2))
    start, trained = discriminator_updates(
        discriminator_objective(discriminator, AdversarialTraining()), 1, PAIRS, 1e-3
    )
    memory = start(network)
    expert = as_expert(drawn)
    flat = Transitions(*(np.asarray(x)[:, 0] for x in expert.steps))  # type: ignore[arg-type]
    replay = Transitions(*(x[None] for x in flat))

    def update() -> None:
        found = trained(network, memory, policy, as_expert(drawn), replay, 1, jax.random.key(3))
        jax.block_until_ready(found)

    def refresh() -> None:
        jax.block_until_ready(truth.refresh(chain, policy, jax.random.key(4), of.sensor))

    parts = {"refresh": refresh, "update": update}
    if hasattr(truth, "resample"):
        parts["draw"] = partial(_drawn, truth, chain, policy, of.sensor)
    times = {part: 1e3 * median_seconds(action, RUNS) for part, action in parts.items()}
    return {"draw": times["refresh"], **times}


def _drawn(truth: object, chain: object, policy: object, sensor: object) -> None:
    jax.block_until_ready(truth.resample(chain, policy, jax.random.key(4), sensor))  # type: ignore[attr-defined]


def _policy(name: str) -> object:
    if name != "onion":
        return load_expert(name)
    shown = demonstrate_onions(jax.random.key(0), 1)
    return policy_network(jax.random.key(0), shown.observations.shape[-1], case(name).environment.actions)


def main() -> None:
    """Measure, print and publish."""
    names = ("mountain-car", "onion", "hopper", "walker2d", "half-cheetah")
    results = {name: measured(name) for name in names}
    rows = [
        (name, t["draw"], t["update"], t["draw"] + t["update"], t["refresh"], t["refresh"] + t["update"])
        for name, t in results.items()
    ]
    print_table(
        f"One robust discriminator update of {PAIRS} pairs, ms (median of {RUNS})",
        ["task", "draw", "update", "draw + update", "refresh", "refresh + update"],
        rows,
    )
    publish("adversarial_cost", results)


if __name__ == "__main__":
    main()
