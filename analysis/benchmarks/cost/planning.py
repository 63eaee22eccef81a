"""Time and memory of planning as the number of states grows.

``python -m i2rl.analysis.benchmarks.cost.planning`` prints one JSON object a line for every pair of a size
and a discount, each measured in a process of its own, so that peak memory is that measurement's alone;
``--states 1000000 --discounts 0.99`` measures one pair.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ....models.process.mdp import TabularMDP
from ....models.process.planning import feature_expectations, reward_of, soft_backup, soft_plan

SIZES = (124, 1024, 10_000, 100_000, 1_000_000)
DISCOUNTS = (0.95, 0.99)
REACH = 3


def local_moves(n_states: int, discount: float, seed: int = 0) -> TabularMDP:
    """Build a ring on which each of 4 actions leads to 3 random states at most ``REACH`` steps away.

    Local moves are the slow case for sweeping: news crosses the ring a few states at a time. The two
    features are uniform random numbers.
    """
    rng = np.random.default_rng(seed)
    shape = (n_states, 4, 3)
    steps = rng.integers(-REACH, REACH + 1, shape)
    probabilities = rng.dirichlet(np.ones(3), shape[:2])
    return TabularMDP.from_successors(
        (np.arange(n_states)[:, None, None] + steps) % n_states,
        probabilities,
        rng.random((n_states, 4, 2)),
        discount=discount,
    )


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    started = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - started


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(n_states: int, discount: float) -> dict[str, float]:
    """Measure seconds, peak memory of this process (MiB) and Bellman residual of one size.

    ``plan_seconds`` is by the wall clock once compiled; ``plan_cpu_seconds``, of all cores, is the cost on a
    busy machine too.
    """
    mdp, build_seconds = _timed(local_moves, n_states, discount)
    build_peak = _peak_mib()
    plan = jax.jit(soft_plan)
    expect = jax.jit(feature_expectations)
    reward = reward_of(mdp, jnp.array([2.0, -1.0]))
    result, first_seconds = _timed(plan, mdp, reward)
    cpu_started = time.process_time()
    result, plan_seconds = _timed(plan, mdp, reward)
    plan_cpu_seconds = time.process_time() - cpu_started
    plan_peak = _peak_mib()
    residual = jnp.max(jnp.abs(soft_backup(mdp, reward, result.values) - result.values))
    _timed(expect, mdp, result.policy)
    _, expect_seconds = _timed(expect, mdp, result.policy)
    return {
        "states": n_states,
        "discount": discount,
        "build_seconds": build_seconds,
        "build_peak_mib": build_peak,
        "first_plan_seconds": first_seconds,
        "plan_seconds": plan_seconds,
        "plan_cpu_seconds": plan_cpu_seconds,
        "plan_peak_mib": plan_peak,
        "feature_expectations_seconds": expect_seconds,
        "peak_mib": _peak_mib(),
        "bellman_residual": float(residual),
        "value_scale": float(jnp.max(jnp.abs(result.values))),
    }


def main() -> None:
    """Measure the sizes and discounts asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, nargs="+", default=SIZES, help="numbers of states")
    parser.add_argument("--discounts", type=float, nargs="+", default=DISCOUNTS)
    options = parser.parse_args()
    pairs = [(n, discount) for n in options.states for discount in options.discounts]
    if len(pairs) == 1:
        print(json.dumps(measure(*pairs[0])), flush=True)
        return
    for n_states, discount in pairs:
        command = [
            sys.executable,
            "-m",
            __spec__.name,
            "--states",
            str(n_states),
            "--discounts",
            str(discount),
        ]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
