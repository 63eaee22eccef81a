"""Coverage and looseness of every bound, and its number of trajectories.

``python -m i2rl.analysis.benchmarks.statistics.coverage`` simulates replications on a random MDP and on
patrol 2 (an expert who obeys the soft model of the patrol's true weights), and prints the share of them in
which each bound holds, its ratio to the quantile observed, and the number of trajectories that Theorem 2
(Theorem 4 of appendix B) and the tighter bounds need for the rows of Table 7.1(a).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from rich.console import Console

from ....domains.patrol.process import instance
from ....models.observation.evidence import Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import feature_deviations, reward_of, soft_plan
from ...bounds.coverage import (
    Coverage,
    Setting,
    coverage_table,
    expected_gaps,
    expert_of,
    full_view_coverage,
    ignorance_gap,
    learned_coverage,
    occluded_coverage,
    regret_coverage,
    simulate_features,
)
from ...bounds.theorems import observed_bound, observed_size, size_for, table_7_1a
from ..harness import print_table, publish


def random_setting(seed: int = 0, n_states: int = 12, n_actions: int = 3, n_features: int = 4) -> Setting:
    """Draw a random MDP with a third of its states in view, its expert's weights uniform in [0, 1]."""
    rng = np.random.default_rng(seed)
    successors = np.argsort(rng.random((n_states, n_actions, n_states)), axis=2)[:, :, :3]
    mdp = TabularMDP.from_successors(
        successors,
        rng.dirichlet(np.ones(3), (n_states, n_actions)),
        rng.random((n_states, n_actions, n_features)),
        initial=rng.dirichlet(np.ones(n_states)),
        discount=0.9,
    )
    view = Visibility(np.arange(n_states) % 3 == 0)
    return Setting("random MDP", mdp, jnp.asarray(rng.uniform(size=n_features)), view, 60)


def patrol_setting(length: int) -> Setting:
    """Build the setting of patrol 2 at 30 % observability."""
    patrol = instance(2)
    return Setting("patrol 2", patrol.mdp, jnp.asarray(patrol.weights), patrol.visibility(30), length)


def sample_sizes(setting: Setting, confidence: float = 0.8) -> pd.DataFrame:
    """Compute trajectories for the log-likelihood errors of Table 7.1(a), by Theorem 2 and by the tighter
    bounds.

    ``exact_completion``: Theorem 1's number for the same error in nats and the same confidence, as exact
    completion needs no ``epsilon_s`` and ``delta_s``. ``observed``: with the features' spread observed too.
    ``like_for_like``: for ``epsilon`` and ``delta`` alone, observed spread against Hoeffding.
    """
    mdp, discount = setting.mdp, float(setting.mdp.discount)
    policy = soft_plan(mdp, reward_of(mdp, setting.weights)).policy
    deviations = (1 - discount) * np.asarray(feature_deviations(mdp, policy))
    delta = (1 - confidence) / 2
    table = table_7_1a(mdp.n_features, delta, discount)
    total = table["epsilon"] + table["epsilon_s"]
    table["exact_completion"] = [int(np.ceil(size_for(e, 2 * delta, mdp.n_features))) for e in total]
    table["observed"] = [observed_size(deviations, e, confidence) for e in total]
    table["observed_share"] = table["observed"] / table["sufficient"]
    table["like_for_like"] = [observed_size(deviations, e, 1 - delta) for e in table["epsilon"]]
    table["like_for_like_share"] = table["like_for_like"] / table["sufficient"]
    return table


def planned_coverage(key: jax.Array, setting: Setting, table: pd.DataFrame, replications: int) -> list[dict]:
    """Test whether the observed bound, at the sizes planned for it, has the planned error, and covers."""
    mdp, discount = setting.mdp, float(setting.mdp.discount)
    expert, found = expert_of(mdp, setting.weights), []
    for i, row in enumerate(table.itertuples()):
        features = simulate_features(
            jax.random.fold_in(key, i), mdp, expert, setting.length, replications, row.observed
        )
        each = [observed_bound(x, 0.8, discount) for x in np.asarray(features)]
        errors = np.array([o.bound.error for o in each])
        gaps = expected_gaps(
            mdp, expert, jnp.asarray([o.target for o in each]), jnp.asarray([o.slack for o in each])
        )
        found.append(
            {
                "trajectories": int(row.observed),
                "wanted_nats": float(row.error_nats),
                "median_bound_nats": float(np.median(errors)),
                "covered": float(np.mean(gaps <= errors)),
            }
        )
    return found


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    key, replications = jax.random.key(options.seed), options.replications
    small, patrol, short = random_setting(), patrol_setting(500), patrol_setting(150)
    studies: tuple[tuple[Callable[..., list[Coverage]], Setting, tuple], ...] = (
        (full_view_coverage, small, (240, 0.9)),
        (occluded_coverage, small, (60, 16, 0.1)),
        (learned_coverage, small, (60, 16, 0.1)),
        (regret_coverage, small, (5.0, 8, 0.1)),
        (full_view_coverage, patrol, (240, 0.9)),
        (regret_coverage, patrol, (50.0, 8, 0.1)),
        (occluded_coverage, short, (30, 16, 0.1)),
        (learned_coverage, short, (30, 16, 0.1)),
    )
    rows: list[Coverage] = []
    for i, (study, setting, arguments) in enumerate(studies):
        began = time.perf_counter()
        rows += study(jax.random.fold_in(key, i), setting, replications, *arguments)
        print(f"{study.__name__} on {setting.name}: {time.perf_counter() - began:.0f} s", flush=True)
    table = coverage_table(rows)
    print_table(
        "Coverage",
        ["bound", "n", "stated", "covered", "bound", "quantile", "looseness"],
        [
            (
                f"{r.setting}: {r.result}",
                r.trajectories,
                r.confidence,
                r.covered,
                r.bound,
                r.quantile,
                r.looseness,
            )
            for r in rows
        ],
    )
    ignorance = {s.name: ignorance_gap(s.mdp, s.weights) for s in (small, patrol)}
    print("Gap of zero weights, nats:", ignorance)
    sizes = sample_sizes(patrol)
    Console(width=200).print(sizes.to_string())
    planned = planned_coverage(jax.random.fold_in(key, 99), patrol, sizes, replications)
    print(pd.DataFrame(planned).to_string())
    publish(
        "coverage",
        {
            "replications": replications,
            "coverage": table.reset_index().to_dict("records"),
            "ignorance_gap": ignorance,
            "sample_sizes": sizes.reset_index().to_dict("records"),
            "planned": planned,
        },
    )


if __name__ == "__main__":
    main()
