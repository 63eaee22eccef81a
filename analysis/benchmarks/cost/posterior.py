"""Diagnostics and cost of the posterior over weights on patrol instance 2.

``python -m i2rl.analysis.benchmarks.cost.posterior`` samples it by NUTS from 60 fragments at 30 %
observability and reports R-hat, effective sample sizes, divergences, and seconds with compilation.
"""

from __future__ import annotations

import argparse
import time

import arviz as az
import jax

from ....domains.patrol.process import demonstrate, instance
from ....inference.posteriors.weights import sample_posterior
from ..harness import print_table, publish


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fragments", type=int, default=60)
    parser.add_argument("--replications", type=int, default=1)
    options = parser.parse_args()
    patrol = instance(2)
    rows = []
    for seed in range(options.replications):
        for patroller, demonstration in enumerate(
            demonstrate(jax.random.key(seed), patrol, 30, options.fragments)
        ):
            began = time.perf_counter()
            key = jax.random.fold_in(jax.random.key(seed), 1 + patroller)
            data = sample_posterior(key, patrol.mdp, patrol.visibility(30), demonstration)
            spent = time.perf_counter() - began
            summary = az.summary(data, var_names=["weights"], round_to="none")
            rows.append(
                {
                    "seed": seed,
                    "patroller": patroller,
                    "R-hat": float(summary["r_hat"].max()),
                    "bulk ESS": float(summary["ess_bulk"].min()),
                    "tail ESS": float(summary["ess_tail"].min()),
                    "divergences": int(data["sample_stats"]["diverging"].sum()),
                    "seconds": spent,
                }
            )
    print_table(
        f"NUTS, patrol 2, {options.fragments} fragments (worst weight)",
        tuple(rows[0]),
        [tuple(r.values()) for r in rows],
    )
    publish("posterior", {"replications": rows})


if __name__ == "__main__":
    main()
