"""PPO beside Stable-Baselines3's: the same tasks, steps and settings; returns with intervals, and seconds.

``python -m i2rl.analysis.benchmarks.peers.ppo`` (``make bench-peers`` prepares the peer's environment) prints
a table and writes every run to ``build/bench/ppo_peer.json``.

Each side steps its own environments: ours the compiled cart-pole and MuJoCo's rollout of Hopper-v5, the peer
Gymnasium's CartPole-v1 and Hopper-v4 (which differs by the one point for being healthy, which it pays in the
step of a fall, too). Each seed has three mean returns: of all episodes of training, which measures its speed;
of the last hundred of these; and of the policy's mode, in separate episodes afterwards. The interval is of
the mean over seeds, by Student's t at 95 %; Welch's, of the difference of the two means.

Each side runs in a process of its own, with one thread, pinned to one core, and the runs alternate. Ours is
timed once compiled (compilation is listed beside it); the peer over ``PPO.learn``. If the core is shared with
other work, processor seconds are more reliable than wall seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from ..harness import print_table, publish
from .finite_horizon import Side

COMMON: dict[str, Any] = {
    "gae_lambda": 0.95,
    "clip": 0.2,
    "epochs": 10,
    "minibatch": 64,
    "entropy": 0.0,
    "value_coefficient": 0.5,
    "max_grad_norm": 0.5,
    "gamma": 0.99,
    "log_deviation": 0.0,
    "hidden": [32, 32],
}
TASKS: dict[str, dict[str, Any]] = {
    "cart-pole": {
        "peer_task": "CartPole-v1",
        "steps": 50_000,
        "settings": {
            "n_envs": 8,
            "n_steps": 128,
            "learning_rate": 1e-3,
            "scale_observations": False,
            "scale_rewards": True,
        },
    },
    "hopper": {
        "peer_task": "Hopper-v4",
        "steps": 100_000,
        "settings": {
            "n_envs": 4,
            "n_steps": 256,
            "learning_rate": 3e-4,
            "scale_observations": True,
            "scale_rewards": True,
        },
    },
}
EPISODES = 20
KINDS = {"training": "training_return", "last hundred": "latest_return", "mode": "return"}


class Trainer(Side):
    """A contestant that trains an agent for each request."""

    def train(self, request: dict[str, Any]) -> dict[str, float]:
        """Train one agent; return its returns and seconds."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._answer()


def serve() -> None:
    """Answer requests to our side from standard input, one JSON line each."""
    # Imported here: the process that hands out the work needs neither JAX nor the package's models.
    import jax

    from ....domains.robots.control import cart_pole
    from ....domains.robots.walkers import locomotion
    from ....inference.adversarial.policy_optimisation import ppo
    from ....inference.adversarial.rollouts import Task
    from ....version import __version__

    tasks: dict[str, Task] = {"cart-pole": cart_pole(), "hopper": locomotion("hopper", threads=1)}
    print(json.dumps({"i2rl": __version__, "jax": jax.__version__}), flush=True)
    for request in map(json.loads, sys.stdin):
        agent = ppo(tasks[request["task"]], **request["settings"])
        compiling = time.perf_counter()
        agent.train(agent.init(jax.random.key(request["seed"])), 1)
        began, processor_began = time.perf_counter(), time.process_time()
        state, training = agent.train(agent.init(jax.random.key(request["seed"])), request["steps"])
        jax.block_until_ready(state)
        seconds, processor_seconds = time.perf_counter() - began, time.process_time() - processor_began
        episodes = agent.evaluate(state.policy, jax.random.key(10_000), request["episodes"])
        answer = {
            "return": float(episodes.returns.mean()),
            "training_return": mean_return(training.returns, training.episodes),
            "latest_return": mean_return(*latest(training.returns, training.episodes)),
            "steps": int(training.steps[-1]),
            "seconds": seconds,
            "processor_seconds": processor_seconds,
            "first_round_seconds": began - compiling,
        }
        print(json.dumps(answer), flush=True)


def mean_return(returns: np.ndarray, episodes: np.ndarray) -> float:
    """Compute the mean over all episodes, of means over some."""
    return float(np.nansum(returns * episodes) / episodes.sum())


def latest(returns: np.ndarray, episodes: np.ndarray, count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Compute means, and how many of their episodes are among the last ``count``."""
    later = np.cumsum(episodes[::-1])[::-1] - episodes
    return returns, np.clip(count - later, 0, episodes)


def interval(values: list[float]) -> tuple[float, float]:
    """Compute the mean, and half the width of its 95 % interval."""
    half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return float(np.mean(values)), float(half)


def difference(ours: list[float], peers: list[float]) -> tuple[float, float]:
    """Compute the 95 % interval of the difference of two means, by Welch's t."""
    if np.ptp(ours) == np.ptp(peers) == 0:
        gap = float(np.mean(ours) - np.mean(peers))
        return gap, gap
    between = stats.ttest_ind(ours, peers, equal_var=False).confidence_interval()
    return float(between.low), float(between.high)


def compare(ours: Trainer, peer: Trainer, name: str, seeds: int) -> dict[str, Any]:
    """Run both sides on one task, in turn."""
    task = TASKS[name]
    runs: dict[str, list[dict[str, float]]] = {"ours": [], "peer": []}
    for seed in range(seeds):
        request = {**task, "task": name, "settings": COMMON | task["settings"]}
        request |= {"seed": seed, "episodes": EPISODES}
        runs["ours"].append(ours.train(request))
        runs["peer"].append(peer.train(request))
        print(name, seed, json.dumps({side: answers[-1] for side, answers in runs.items()}), flush=True)

    def of(side: str, key: str) -> list[float]:
        return [answer[key] for answer in runs[side]]

    def median(side: str, key: str) -> float:
        return float(np.median(of(side, key)))

    return {
        "task": name,
        "steps": runs["ours"][0]["steps"],
        "returns": {
            kind: {
                **{side: interval(of(side, key)) for side in runs},
                "difference": difference(of("ours", key), of("peer", key)),
            }
            for kind, key in KINDS.items()
        },
        "seconds": {side: median(side, "seconds") for side in runs},
        "processor_seconds": {side: median(side, "processor_seconds") for side in runs},
        "ratio": median("peer", "seconds") / median("ours", "seconds"),
        "ratio_of_processor_seconds": median("peer", "processor_seconds")
        / median("ours", "processor_seconds"),
        "first_round_seconds": runs["ours"][0]["first_round_seconds"],
        "runs": runs,
    }


def main() -> None:
    """Compare the tasks asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--replications", type=int, default=5, help="agents of each side on each task")
    parser.add_argument("--peer-python", type=Path, default=Path(".venv-peers/bin/python"))
    parser.add_argument("--output", type=Path, default=Path("build/bench/ppo_peer.json"))
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    if options.replications < 2:
        parser.error(f"an interval needs two seeds or more, got {options.replications}")
    if not options.peer_python.exists():
        parser.error(f"no interpreter at {options.peer_python}: `make bench-peers` prepares one")
    # taskset and CPU affinity are Linux's; elsewhere the single thread has to do.
    core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    with tempfile.TemporaryDirectory() as name:
        folder, script = Path(name), Path(__file__).with_name("peer_ppo.py")
        ours = Trainer("ours", [sys.executable, "-m", __spec__.name, "--serve"], folder, core)
        peer = Trainer("peer", [str(options.peer_python.absolute()), str(script)], folder, core)
        rows = [compare(ours, peer, task, options.replications) for task in options.tasks]
        for side in (ours, peer):
            side.close()
    columns = ["task", "steps", "returns", "i2rl", "peer", "difference"]
    table: list[tuple] = [
        (
            row["task"],
            row["steps"],
            kind,
            "{:.0f} ± {:.0f}".format(*of["ours"]),
            "{:.0f} ± {:.0f}".format(*of["peer"]),
            "{:.0f} to {:.0f}".format(*of["difference"]),
        )
        for row in rows
        for kind, of in row["returns"].items()
    ]
    print_table(f"PPO and Stable-Baselines3's, {options.replications} seeds, 95 % intervals", columns, table)
    columns = ["task", "seconds", "peer's", "ratio", "of the processor", "peer's", "ratio", "first round"]
    table = [
        (
            row["task"],
            *row["seconds"].values(),
            row["ratio"],
            *row["processor_seconds"].values(),
            row["ratio_of_processor_seconds"],
            row["first_round_seconds"],
        )
        for row in rows
    ]
    print_table("Median seconds of a training, one thread each", columns, table)
    versions = {**ours.versions, **peer.versions}
    publish(
        "ppo_peer",
        {"versions": versions, "settings": COMMON, "tasks": TASKS, "results": rows},
        options.output,
    )


if __name__ == "__main__":
    main()
