"""Accuracy of online learning under occlusion, on the three patrols.

``python -m i2rl.analysis.benchmarks.online.accuracy`` prints learned behaviour accuracy of LME-I2RL after
some sessions of five steps, for every sufficient statistic, beside batch LME on the same data and the same
accuracy of random rewards: medians over replications and patrollers, and the share of replications within
0.01 of batch.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ....domains.patrol.process import demonstrate, instance
from ....inference.learners.lme import batch_lme, lme_i2rl
from ....inference.sessions.running import run_sessions
from ...judging.metrics import evaluate
from ..harness import print_table, publish


def accuracies(
    number: int, observability: int, points: tuple[int, ...], replications: int, statistics: tuple[str, ...]
) -> dict[str, Float[np.ndarray, "replications points"]]:
    """Measure LBA of each method at each number of sessions; a row is a seed and a patroller."""
    patrol = instance(number)
    view = patrol.visibility(observability)
    score = partial(evaluate, patrol.mdp, jnp.asarray(patrol.weights))
    learners = {s: lme_i2rl(patrol.mdp, view, statistic=s) for s in statistics}
    batch = batch_lme(patrol.mdp, view)
    weights: dict[str, list[Any]] = {name: [] for name in (*learners, "batch", "random rewards")}
    for seed in range(replications):
        key = jax.random.key(seed)
        for patroller, demonstration in enumerate(demonstrate(key, patrol, observability, max(points))):
            start = jax.random.fold_in(key, patroller)
            for name, learner in learners.items():
                reports = run_sessions(learner, demonstration.sessions(), key=start).infos
                weights[name].append([reports[n - 1].weights for n in points])
            fits = [batch.fit(start, demonstration.select(slice(0, n))) for n in points]
            weights["batch"].append([fit.weights for fit in fits])
            random = jax.random.uniform(start, (len(points), patrol.mdp.n_features), float, -0.99, 0.99)
            weights["random rewards"].append(random)
    return {
        name: np.asarray(
            score(jnp.asarray(np.array(w)).reshape(-1, patrol.mdp.n_features)).accuracy.overall
        ).reshape(-1, len(points))
        for name, w in weights.items()
    }


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=10)
    parser.add_argument("--instances", type=int, nargs="+", default=[2, 1, 3])
    options = parser.parse_args()
    settings = {1: (30, (22, 60, 230)), 2: (30, (22, 60, 239)), 3: (18, (22, 60, 230))}
    results = {}
    for number in options.instances:
        observability, points = settings[number]
        statistics = ("seen", "counts", "features") if number == 2 else ("seen",)
        measured = accuracies(number, observability, points, options.replications, statistics)
        rows, summary = [], {}
        for name, values in measured.items():
            close = np.mean(values >= measured["batch"] - 0.01, axis=0)
            summary[name] = {
                str(n): {
                    "median": float(np.median(values[:, i])),
                    "least": float(values[:, i].min()),
                    "share not 0.01 below batch": float(close[i]),
                }
                for i, n in enumerate(points)
            }
            rows.append(
                (
                    name,
                    *(
                        f"{np.median(values[:, i]):.3f} ({values[:, i].min():.3f})"
                        for i in range(len(points))
                    ),
                )
            )
        replications = f"{options.replications} replications, each patroller"
        title = f"LBA, patrol {number}, {observability} % in view, median (least) of {replications}"
        print_table(title, ("statistic or method", *(f"{n} sessions" for n in points)), rows)
        results[f"patrol{number}"] = summary
    publish("accuracy", results)


if __name__ == "__main__":
    main()
