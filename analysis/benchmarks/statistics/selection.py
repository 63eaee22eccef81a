"""Selection of the expert's features by leave-one-out cross-validation.

``python -m i2rl.analysis.benchmarks.statistics.selection`` compares four feature sets on patrol 2, from
fragments of five steps at 30 % observability, for two experts: the domain's patrollers, who never err, and
one who obeys the soft model with the same weights ten times as long (as long as those fitted to the
patrollers). The sets:

- ``six``: the domain's own;
- ``without moves``: the feature of the largest weight (4/7) is missing; moving is what patrolling is about;
- ``turns anywhere``: one feature for turning takes the place of the five that say where; a wrong set;
- ``without division 2``: the other feature of positive weight (3/7) is missing. A separate question: the
  patrollers turn back there, but only *not* turning elsewhere needs a reason, which the others can give.

Each is picked or not among the first three; the last is compared with ``six`` alone.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Mapping
from typing import Any

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np

from ....domains.patrol.process import LEFT, RIGHT, Patrol, demonstrate, instance
from ....models.laws.trajectory import TrajectoryLaw, sample_demonstration
from ....models.observation.demonstration import Demonstration
from ....models.process.mdp import TabularMDP
from ...posteriors.selection import compare_features, compare_posteriors, select_features, with_features
from ..harness import print_table, publish

OBSERVABILITY = 30
SHARPNESS = 10.0
RIVALS = ("six", "without moves", "turns anywhere")
EXPERTS = ("greedy", "soft")


def feature_sets(patrol: Patrol) -> dict[str, TabularMDP]:
    """Return the four sets."""
    mdp, names = patrol.mdp, patrol.mdp.feature_names
    turning = np.zeros((mdp.n_states, mdp.n_actions, 1))
    turning[:, [LEFT, RIGHT]] = 1
    moving = np.asarray(mdp.features)[..., [names.index("moves")]]
    return {
        "six": mdp,
        "without moves": select_features(mdp, [n for n in names if n != "moves"]),
        "turns anywhere": with_features(
            mdp, np.concatenate([moving, turning], axis=2), ("moves", "turns anywhere")
        ),
        "without division 2": select_features(mdp, [n for n in names if n != "turns in division 2"]),
    }


def shown(expert: str, seed: int, patrol: Patrol, fragments: int) -> Demonstration:
    """Simulate the observation of one of the two experts."""
    key = jax.random.key(seed)
    if expert == "greedy":
        return demonstrate(key, patrol, OBSERVABILITY, fragments)[0]
    weights = jnp.asarray(SHARPNESS * patrol.weights)
    law = TrajectoryLaw(patrol.mdp, weights, patrol.visibility(OBSERVABILITY), 5)
    return sample_demonstration(key, law, fragments)


def judge(posteriors: Mapping[str, az.InferenceData]) -> dict[str, Any]:
    """Compute differences to the six features, their standard errors, and their reliability."""
    main = compare_posteriors({name: posteriors[name] for name in RIVALS})
    record: dict[str, Any] = {"picked": main.best}
    for name in posteriors:
        if name == "six":
            continue
        pair = compare_posteriors({"six": posteriors["six"], name: posteriors[name]})
        sign = 1 if pair.best == "six" else -1
        record[name] = {
            "advantage": sign * float(pair.table["elpd_diff"].max()),
            "standard_error": float(pair.table["dse"].max()),
        }
        k = pair.pareto_k
        record["largest_k"] = max(record.get("largest_k", 0.0), float(k["largest"].max()))
        record["share_above"] = max(record.get("share_above", 0.0), float(k["share_above"].max()))
    record["divergences"] = int(sum(p["sample_stats"]["diverging"].sum() for p in posteriors.values()))
    record["R-hat"] = max(float(az.rhat(p)["weights"].max()) for p in posteriors.values())
    return record


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=20)
    parser.add_argument("--fragments", type=int, default=60)
    parser.add_argument("--draws", type=int, default=100, help="of each of two chains")
    parser.add_argument("--warmup", type=int, default=75)
    options = parser.parse_args()
    patrol = instance(2)
    sets, runs = feature_sets(patrol), []
    for expert in EXPERTS:
        for seed in range(options.replications):
            began = time.perf_counter()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of Pareto shapes, which are printed
                compared = compare_features(
                    jax.random.fold_in(jax.random.key(seed), EXPERTS.index(expert)),
                    sets,
                    patrol.visibility(OBSERVABILITY),
                    shown(expert, seed, patrol, options.fragments),
                    draws=options.draws,
                    warmup=options.warmup,
                    chains=2,
                    target_accept=0.8,
                )
                record = {"expert": expert, "seed": seed, **judge(compared.posteriors)}
            record["seconds"] = time.perf_counter() - began
            runs.append(record)
            advantages = ", ".join(
                f"{name} {record[name]['advantage']:.1f}" for name in sets if name != "six"
            )
            print(f"seed {seed}, {expert}: {record['picked']}; advantage over {advantages}", flush=True)
            publish("selection", {"fragments": options.fragments, "draws": options.draws, "runs": runs})
    rows = []
    for expert in EXPERTS:
        own = [run for run in runs if run["expert"] == expert]
        harder = [run["without division 2"] for run in own]
        rows.append(
            (
                expert,
                f"{sum(run['picked'] == 'six' for run in own)} of {len(own)}",
                float(min(min(run[name]["advantage"] for name in RIVALS[1:]) for run in own)),
                f"{sum(pair['advantage'] > 0 for pair in harder)} of {len(own)}",
                float(np.median([pair["advantage"] for pair in harder])),
                max(run["largest_k"] for run in own),
                max(run["share_above"] for run in own),
                max(run["R-hat"] for run in own),
                sum(run["divergences"] for run in own),
                float(np.median([run["seconds"] for run in own])),
            )
        )
    print_table(
        f"Patrol 2, {options.fragments} fragments at {OBSERVABILITY} %: is the true set of features picked?",
        (
            "expert",
            "picked",
            "least advantage",
            "against five",
            "median advantage",
            "largest k",
            "share above 0.7",
            "R-hat",
            "divergences",
            "seconds",
        ),
        rows,
    )


if __name__ == "__main__":
    main()
