"""Several behaviours of a task: online against batch, a late component, hidden steps, experts who err.

``python -m i2rl.analysis.benchmarks.statistics.components`` measures MME-MTIRL on onion sorting (26 states,
``D = 4``):

- *online*: trajectories arrive in sessions; value difference and cumulative seconds against re-running the
  batch learner on everything so far at every session (each compiled before it is timed);
- *late*: the third behaviour appears only in the last third of the sessions;
- *hidden*: every step is hidden with probability one half;
- *soft*: one or two experts who obey the soft model (true weights times a sharpness), ``temperature`` 0.5 and
  1.

``i2rl run sorting`` measures numbers of components, value differences and times beside the baselines.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ....domains.sorting.process import (
    MixedDemonstration,
    Sorting,
    demonstrate_sorting,
    sorting_with_claiming,
)
from ....inference.learners.mtirl import BatchMixture, assign_trajectories, batch_mme_mtirl, mme_mtirl
from ....inference.mixtures.clustering import Clustering
from ....inference.sessions.learner import Learner
from ....models.laws.trajectory import TrajectoryLaw
from ....models.observation.demonstration import HIDDEN, UNKNOWN, Demonstration, concatenate
from ....models.observation.evidence import Sensor, Visibility
from ...judging.multi_task import adjusted_rand_index, assignment_accuracy, expected_value_difference
from ..harness import print_table, publish

STEPS = 50


def shuffled(key: jax.Array, mixed: MixedDemonstration) -> MixedDemonstration:
    """Return the same trajectories in a random order."""
    order = np.asarray(jax.random.permutation(key, len(mixed.labels)))
    return MixedDemonstration(mixed.demonstration.select(order), mixed.labels[order])


def run_online(
    learner: Learner, key: jax.Array, demonstration: Demonstration, size: int
) -> tuple[Any, list[Any]]:
    """Feed sessions of ``size`` trajectories; return the final state and all infos."""
    state, reports = learner.init(key), []
    for session in demonstration.sessions(size):
        state, report = learner.update(state, session)
        reports.append(report)
    return state, reports


def rerun(
    batch: BatchMixture, key: jax.Array, demonstration: Demonstration, ends: Sequence[int]
) -> Clustering:
    """Fit the batch learner to everything so far at every end; the last fit."""
    for end in ends:
        fit = batch.fit(key, demonstration.select(slice(0, end)))
    return fit


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Return the wall-clock seconds of a call, and its result."""
    began = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - began, result


def online_against_batch(
    sorting: Sorting, tasks: int, n: int, size: int, seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Measure value differences at equal data, and cumulative seconds."""
    online, batch = mme_mtirl(sorting.mdp), batch_mme_mtirl(sorting.mdp)
    records = []
    for seed in (seeds[0], *seeds):  # the first is done twice: it compiles
        key = jax.random.key(seed)
        mixed = shuffled(key, demonstrate_sorting(key, sorting, [n // tasks] * tasks, STEPS))
        demonstration, labels = mixed
        ends = [min(i + size, len(labels)) for i in range(0, len(labels), size)]
        result: dict[str, Any] = {"tasks": tasks, "n": n, "seed": seed}

        result["online_seconds"], (state, _) = timed(run_online, online, key, demonstration, size)
        result["batch_seconds"], fit = timed(rerun, batch, key, demonstration, ends)
        present = np.asarray(state.proportions) > 0
        weights = np.asarray(state.weights)[present]
        shares = assign_trajectories(
            sorting.mdp, None, weights, np.asarray(state.proportions)[present], demonstration
        )
        result["online_ways"], result["batch_ways"] = int(present.sum()), fit.n_components
        for name, learned, assignments in (
            ("online_evd", weights, shares.argmax(1)),
            ("batch_evd", fit.weights, fit.assignments),
        ):
            result[name] = expected_value_difference(
                sorting.mdp, sorting.weights, labels, learned, assignments, demonstration
            )
        records.append(result)
    return records[1:]


def late_component(sorting: Sorting, sessions: int, size: int, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Learn two behaviours for two thirds of the sessions, three in the last third."""
    learner, records = mme_mtirl(sorting.mdp), []
    early = 2 * sessions // 3
    for seed in seeds:
        key = jax.random.key(seed)
        first, last, order, start = jax.random.split(key, 4)
        parts = []
        for part, many, behaviours in ((first, early, 2), (last, sessions - early, 3)):
            drawn = jax.random.randint(jax.random.fold_in(part, 1), (many * size,), 0, behaviours)
            counts = np.bincount(np.asarray(drawn), minlength=3).tolist()
            parts.append(shuffled(order, demonstrate_sorting(part, sorting, counts, STEPS)))
        demonstration = concatenate([part.demonstration for part in parts])
        labels = np.concatenate([part.labels for part in parts])
        state, reports = run_online(learner, start, demonstration, size)
        present = np.asarray(state.proportions) > 0
        weights = np.asarray(state.weights)[present]
        shares = assign_trajectories(
            sorting.mdp, None, weights, np.asarray(state.proportions)[present], demonstration
        )
        records.append(
            {
                "seed": seed,
                "before": reports[early - 1].n_components,
                "after": reports[-1].n_components,
                "late_trajectories": int((labels == 2).sum()),
                "accuracy": assignment_accuracy(labels, shares.argmax(1)),
                "evd": expected_value_difference(
                    sorting.mdp, sorting.weights, labels, weights, shares.argmax(1), demonstration
                ),
            }
        )
    return records


def hide(key: jax.Array, demonstration: Demonstration, share: float) -> Demonstration:
    """Hide each step with this probability."""
    kind = np.array(demonstration.kind)
    hidden = np.asarray(jax.random.uniform(key, kind.shape)) < share
    return replace(
        demonstration,
        kind=np.where(hidden, HIDDEN, kind),
        state=np.where(hidden, UNKNOWN, demonstration.state),
        action=np.where(hidden, UNKNOWN, demonstration.action),
    )


def hidden_steps(
    sorting: Sorting, tasks: int, n: int, share: float, seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Learn from partly hidden trajectories."""
    sensor = Visibility(np.full(sorting.mdp.n_states, 1 - share))
    batch, records = batch_mme_mtirl(sorting.mdp, sensor), []
    for seed in seeds:
        key = jax.random.key(seed)
        whole, labels = demonstrate_sorting(key, sorting, [n // tasks] * tasks, STEPS)
        seen = hide(jax.random.fold_in(key, 1), whole, share)
        took, fit = timed(batch.fit, key, seen)
        records.append(
            {
                "seed": seed,
                "n_components": fit.n_components,
                "seconds": took,
                "accuracy": assignment_accuracy(labels, fit.assignments),
                "ari": adjusted_rand_index(labels, fit.assignments),
                "evd": expected_value_difference(
                    sorting.mdp, sorting.weights, labels, fit.weights, fit.assignments, whole
                ),
            }
        )
    return records


def soft_experts(
    sorting: Sorting, sharpness: float, tasks: int, n: int, temperature: float, seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Learn from experts who obey the soft model."""
    batch, records = batch_mme_mtirl(sorting.mdp, temperature=temperature), []
    labels: Int[np.ndarray, " n"] = np.repeat(np.arange(tasks), n // tasks)
    for seed in seeds:
        key = jax.random.key(seed)
        codes = [
            TrajectoryLaw(sorting.mdp, jnp.asarray(sharpness * w), Sensor(), STEPS).sample(
                jax.random.fold_in(key, b), (n // tasks,)
            )
            for b, w in enumerate(sorting.weights[:tasks])
        ]
        fit = batch.fit(key, Demonstration.from_codes(np.concatenate([np.asarray(c) for c in codes])))
        records.append(
            {
                "sharpness": sharpness,
                "tasks": tasks,
                "n": n,
                "temperature": temperature,
                "seed": seed,
                "n_components": fit.n_components,
                "accuracy": assignment_accuracy(labels, fit.assignments),
            }
        )
    return records


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=20)
    options = parser.parse_args()
    seeds, sorting = range(options.replications), sorting_with_claiming()
    results: dict[str, Any] = {}

    def record(name: str, runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
        results[name] = runs
        publish("n_components", results)
        return runs

    rows: list[tuple[Any, ...]] = []
    for tasks, n, size in ((2, 64, 4), (2, 128, 8), (3, 96, 6), (3, 192, 12)):
        runs = record(
            f"online, {tasks} tasks, n = {n}",
            online_against_batch(sorting, tasks, n, size, seeds[:10]),
        )
        column = {name: np.array([run[name] for run in runs]) for name in runs[0]}
        rows.append(
            (
                f"{tasks} tasks, {n} in sessions of {size}",
                " / ".join(f"{np.mean(column[f'{side}_ways'] == tasks):.0%}" for side in ("online", "batch")),
                float(column["online_evd"].mean()),
                float(column["batch_evd"].mean()),
                float(np.median(column["online_seconds"])),
                float(np.median(column["batch_seconds"])),
                float(np.median(column["online_seconds"] / column["batch_seconds"])),
            )
        )
    columns = (
        "stream",
        "all components found, online / batch",
        "EVD online",
        "EVD batch",
        "s online",
        "s batch",
    )
    print_table("Online against batch at every session", (*columns, "ratio"), rows)

    runs = record("late", late_component(sorting, 18, 6, seeds))
    print_table(
        "A third component from the last third of 18 sessions of 6 on",
        ("two before", "three after", "mean accuracy", "mean EVD"),
        [
            (
                f"{sum(run['before'] == 2 for run in runs)} of {len(runs)}",
                f"{sum(run['after'] == 3 for run in runs)} of {len(runs)}",
                float(np.mean([run["accuracy"] for run in runs])),
                float(np.mean([run["evd"] for run in runs])),
            )
        ],
    )
    rows = []
    for tasks, n in ((2, 64), (3, 96)):
        runs = record(
            f"hidden, {tasks} tasks",
            hidden_steps(sorting, tasks, n, 0.5, seeds[:10]),
        )
        rows.append(
            (
                f"{tasks} tasks, {n}",
                f"{sum(run['n_components'] == tasks for run in runs)} of {len(runs)}",
                float(np.mean([run["accuracy"] for run in runs])),
                min(run["accuracy"] for run in runs),
                float(np.mean([run["evd"] for run in runs])),
                float(np.median([run["seconds"] for run in runs])),
            )
        )
    columns = ("trajectories", "all components found", "mean accuracy", "least accuracy", "mean EVD", "s")
    print_table("Half of the steps hidden", columns, rows)

    rows = []
    for sharpness in (1.0, 3.0):
        for tasks in (1, 2):
            for temperature in (0.5, 1.0):
                runs = record(
                    f"soft, sharpness {sharpness:g}, {tasks} tasks, temperature {temperature:g}",
                    soft_experts(sorting, sharpness, tasks, 64, temperature, seeds[:10]),
                )
                rows.append(
                    (
                        f"sharpness {sharpness:g}, {tasks} tasks, temperature {temperature:g}",
                        " ".join(str(run["n_components"]) for run in runs),
                        float(np.mean([run["accuracy"] for run in runs])),
                    )
                )
    print_table(
        "Soft experts, 64 trajectories",
        ("experts", "components found, by replication", "mean accuracy"),
        rows,
    )


if __name__ == "__main__":
    main()
