"""RIMEO's bounds under noisy perception: coverage, looseness and data required.

``python -m i2rl.analysis.benchmarks.statistics.perception`` simulates replications on two small tasks whose
predicates are observed independently, and of the proof's step alone also on onion sorting, where they are
dependent. Hidden pairs are filled in under the expert's weights, then under the learner's own, at several
reliabilities.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from ....domains.noisy.tasks import feature_noise, noisy_sorting
from ....models.observation.evidence import FeatureNoise
from ....models.process.mdp import TabularMDP
from ...bounds.coverage import Coverage, Setting, coverage_table, ignorance_gap
from ...bounds.noise_coverage import learned_perception_coverage, perception_coverage, posterior_change
from ...bounds.perception import perception_needed
from ..harness import print_table, publish

_DELTA = 0.1 / 3
# Steps after which discounting with 0.8 leaves less than half a percent.
_WHOLE = 25


def binary_noise(n_states: int, n_actions: int, reliability: float) -> FeatureNoise:
    """Build noise on one predicate for each bit of a pair's index, so that each combination of them is one
    pair.
    """
    size = n_states * n_actions
    bits = np.arange(size) >> np.arange(int(np.log2(size)))[:, None] & 1
    return FeatureNoise(bits.reshape(-1, n_states, n_actions), np.full(len(bits), reliability))


def shift_setting(reliability: float, length: int) -> Setting:
    """Build a shift register of two bits, filled by actions; action 1 and two of them in the register are
    rewarded.
    """
    state, action = np.indices((4, 2))
    successors = np.stack([(2 * state + action) % 4, (2 * state + 1 - action) % 4], axis=2)
    features = np.stack([action == 1, state == 3], axis=2).astype(float)
    mdp = TabularMDP.from_successors(
        successors,
        np.broadcast_to([0.9, 0.1], successors.shape),
        features,
        initial=np.full(4, 0.25),
        discount=0.8,
    )
    name = f"shift register, p = {reliability:g}, L = {length}"
    return Setting(name, mdp, jnp.ones(2), binary_noise(4, 2, reliability), length)


def random_reported_setting(reliability: float, length: int, seed: int = 0) -> Setting:
    """Draw a process of eight states, two actions and four features."""
    rng, shape = np.random.default_rng(seed), (8, 2)
    mdp = TabularMDP.from_successors(
        np.argsort(rng.random((*shape, 8)), axis=2)[:, :, :3],
        rng.dirichlet(np.ones(3), shape),
        rng.random((*shape, 4)),
        initial=rng.dirichlet(np.ones(8)),
        discount=0.9,
    )
    name = f"random MDP, p = {reliability:g}, L = {length}"
    return Setting(name, mdp, jnp.asarray(rng.uniform(size=4)), binary_noise(8, 2, reliability), length)


def sorting_setting() -> Setting:
    """Build onion sorting from all states by a soft expert of the true weights, the largest one."""
    task = noisy_sorting()
    weights = jnp.asarray(task.weights / task.weights.max())
    return Setting("sorting", task.starting("all"), weights, feature_noise(task), 3)


def rare_setting() -> Setting:
    """Build a process of one step in one of two states, the second with probability 0.01."""
    mdp = TabularMDP.from_successors(
        np.zeros((2, 1, 1), int),
        np.ones((2, 1, 1)),
        np.array([[[0.0]], [[1.0]]]),
        initial=np.array([0.99, 0.01]),
        discount=0.01,
    )
    return Setting("rare truth, p = 0.99, L = 1", mdp, jnp.ones(1), binary_noise(2, 1, 0.99), 1)


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=300)
    parser.add_argument("--learned-replications", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    key, replications, learned = (
        jax.random.key(options.seed),
        options.replications,
        options.learned_replications,
    )
    studies: list[tuple[Callable[..., list[Coverage]], Setting, tuple]] = [
        (perception_coverage, shift_setting(0.7, 3), (replications, 3000, 4, 10**7, _DELTA)),
        (perception_coverage, random_reported_setting(0.8, 5), (replications, 60, 8, 20_000, _DELTA)),
        (posterior_change, shift_setting(0.7, 3), (0.01, replications, 60)),
        (posterior_change, random_reported_setting(0.8, 5), (0.01, replications, 60)),
        (posterior_change, rare_setting(), (0.005, replications, 60)),
        (posterior_change, sorting_setting(), (0.005, 30, 60)),
    ]
    for reliability, length, size, observations in (
        (0.7, 3, 3000, 10**7),
        *((p, _WHOLE, 2000, 10**9) for p in (0.5, 0.6, 0.7, 0.9)),
    ):
        setting = shift_setting(reliability, length)
        for shift in (-1.0, 1.0):
            arguments = (learned, size, 4, observations, _DELTA, shift)
            studies.append((learned_perception_coverage, setting, arguments))
    rows: list[Coverage] = []
    ignorance = {}
    for i, (study, setting, arguments) in enumerate(studies):
        began = time.perf_counter()
        rows += study(jax.random.fold_in(key, i), setting, *arguments)
        ignorance[setting.name] = ignorance_gap(setting.mdp, setting.weights)
        print(f"{study.__name__} on {setting.name}: {time.perf_counter() - began:.0f} s", flush=True)
    print_table(
        "Coverage",
        ["bound", "n", "replications", "stated", "covered", "bound", "quantile", "looseness"],
        [
            (
                f"{r.setting}: {r.result}",
                r.trajectories,
                r.replications,
                r.confidence,
                r.covered,
                r.bound,
                r.quantile,
                r.looseness,
            )
            for r in rows
        ],
    )
    print("Gap of zero weights, nats:", ignorance)
    # Sorting as section 7.4.3 has it, and as the theorem asks: as long as discounting with 0.99 leaves 0.015.
    needed = {steps: perception_needed(11, 8, steps, 0.15, 0.8) for steps in (3, 418)}
    for steps, table in needed.items():
        print(f"Sorting, {steps} steps, epsilon_r = 0.15, confidence 0.8:")
        Console(width=140).print(table.to_string())
    publish(
        "perception",
        {
            "coverage": coverage_table(rows).reset_index().to_dict("records"),
            "ignorance_gap": ignorance,
            "needed": {steps: table.reset_index().to_dict("records") for steps, table in needed.items()},
        },
    )


if __name__ == "__main__":
    main()
