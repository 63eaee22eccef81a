"""Independence of learning from the units of the features.

Run as ``python -m i2rl.analysis.benchmarks.faults.units``.

Every learner, program and sampler learns from one demonstration in a process of which each feature comes in
a unit of its own, from 1e-9 to 1e9 of the original one. Policies have to agree to 1e-6. Then IPOPT solves
random programs without slack, among them such with a constant or a duplicated feature, and has to agree with
Newton's method.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ....inference.learners.boltzmann import boltzmann_log_policy
from ....inference.learners.darko import darko_i2rl
from ....inference.learners.dpm import dpm_birl
from ....inference.learners.jin import jin_i2rl_with_features
from ....inference.learners.lme import batch_lme, lme_i2rl, lme_i2rl_with_random_weights, me_i2rl
from ....inference.learners.maximum_likelihood import em_mlirl, mlirl
from ....inference.learners.mtirl import batch_mme_mtirl, mme_mtirl
from ....inference.learners.noisy import rifom, rimeo, robust_irl
from ....inference.posteriors.policy_walk import birl
from ....inference.posteriors.weights import gather, posterior_mode
from ....inference.programs.constraints import FeatureTarget
from ....inference.programs.dual import CountProgram, DualProgram
from ....inference.programs.finite_horizon import expected_features, fit_weights
from ....inference.programs.maximum_entropy import exponentiated_gradient, fit_counts, solve_dual
from ....inference.programs.minmax import MinMaxProgram
from ....inference.programs.primal import PrimalProgram
from ....inference.sessions.learner import Learner
from ....inference.sessions.running import run_sessions
from ....models.laws.trajectory import TrajectoryLaw, sample_demonstration
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import AnySensor, FeatureNoise, Sensor, Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import feature_expectations, occupancy, reward_of, soft_plan
from ....models.process.units import feature_scale
from ..harness import print_table, publish

TOLERANCE = 1e-6
KEY = jax.random.key(0)
# The expert's scaled weights.
TRUTH = np.array([2.0, -1.5, 1.0])
VIEW = Visibility(np.array([1.0, 0.3, 1.0, 0.5]))
PREDICATES = np.zeros((2, 4, 3), bool)
PREDICATES[0, ::2], PREDICATES[1, :, 0] = True, True
NOISE = FeatureNoise(PREDICATES, np.array([0.9, 0.8]))
SLACK = np.array([0.05, 0.0, 0.1])
KINDS = ("normal", "constant", "duplicate")


@cache
def process() -> TabularMDP:
    """Build a process of four states, three actions and three features of about one."""
    rng = np.random.default_rng(1)
    mdp = TabularMDP.from_successors(
        rng.integers(0, 4, (4, 3, 2)),
        rng.dirichlet(np.ones(2), (4, 3)),
        rng.normal(size=(4, 3, 3)),
        initial=rng.dirichlet(np.ones(4)),
        discount=0.9,
        feature_names=["time", "distance", "energy"],
    )
    return mdp.without_inflow()


def in_units(units: Float[np.ndarray, " K"]) -> TabularMDP:
    """Return the same process, each feature times a factor."""
    return replace(process(), features=process().features * units)


@jax.jit
def policy(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    """Compute the soft policy of weights."""
    return soft_plan(mdp, reward_of(mdp, weights)).policy


@jax.jit
def greedy_policy(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    """Compute the Boltzmann policy of weights."""
    return jnp.exp(boltzmann_log_policy(mdp, weights))


@cache
def demonstration(sensor: str = "clear") -> Demonstration:
    """Simulate twelve trajectories of the expert, seen clearly, half hidden, or through noise."""
    seen: dict[str, AnySensor] = {"clear": Sensor(), "hidden": VIEW, "noisy": NOISE}
    weights = jnp.asarray(TRUTH / feature_scale(process()))
    return sample_demonstration(jax.random.key(3), TrajectoryLaw(process(), weights, seen[sensor], 6), 12)


def target(mdp: TabularMDP) -> FeatureTarget:
    """Compute the features that the expert's policy collects."""
    expert = policy(mdp, jnp.asarray(TRUTH / feature_scale(mdp)))
    return FeatureTarget(feature_expectations(mdp, expert), mdp.initial)


@cache
def counts() -> Float[np.ndarray, "S A"]:
    """Simulate about 500 visits of the expert."""
    expert = policy(process(), jnp.asarray(TRUTH / feature_scale(process())))
    return np.random.default_rng(0).poisson(50 * np.asarray(occupancy(process(), expert))).astype(float)


def _learned(make: Callable[[TabularMDP], Learner], sensor: str = "clear") -> Callable[[TabularMDP], Array]:
    def learn(mdp: TabularMDP) -> Array:
        state = run_sessions(make(mdp), demonstration(sensor).sessions(6), key=KEY).state
        return state.weights

    return learn


def _starts(mdp: TabularMDP) -> Float[np.ndarray, "D K"]:
    return np.array([[1.0, 0, 0], [0, 1.0, 0]]) / np.asarray(feature_scale(mdp))


def _mode(mdp: TabularMDP) -> Float[np.ndarray, " K"]:
    problem, _ = gather(mdp, VIEW, demonstration("hidden"))
    return posterior_mode(problem).position / np.asarray(feature_scale(mdp))


# Each gives weights [K] or [D, K] of a process, in its units.
METHODS: Mapping[str, Callable[[TabularMDP], Array | np.ndarray]] = {
    "solve_dual": lambda mdp: solve_dual(mdp, target(mdp), SLACK, 0.1).weights,
    "fit_counts": lambda mdp: fit_counts(mdp, jnp.asarray(counts()), 20 * SLACK, 0.1).weights,
    "exponentiated_gradient": lambda mdp: exponentiated_gradient(mdp, target(mdp), max_steps=300).weights,
    "DualProgram": lambda mdp: DualProgram(mdp).solve(target(mdp), SLACK, 0.1).weights,
    "CountProgram": lambda mdp: CountProgram(mdp).solve(counts(), 20 * SLACK, 0.1).weights,
    "PrimalProgram": lambda mdp: PrimalProgram(mdp).solve(target(mdp), SLACK).weights,
    "MinMaxProgram": lambda mdp: (
        MinMaxProgram(mdp, 2, 6)
        .solve(np.random.default_rng(0).poisson(4.0, (6, 4, 3)), 1.0, 0.1, 0.1, weights=_starts(mdp))
        .weights
    ),
    "fit_weights": lambda mdp: (
        fit_weights(
            mdp,
            5,
            np.asarray(expected_features(mdp, jnp.asarray(TRUTH / feature_scale(mdp)), 5)),
            tolerance=1e-9,
        ).weights
    ),
    "darko_i2rl": _learned(lambda mdp: darko_i2rl(mdp, radius=2.0)),
    "jin_i2rl_with_features": _learned(jin_i2rl_with_features),
    "mme_mtirl": _learned(lambda mdp: mme_mtirl(mdp, n_components=2, restarts=1, slack=0.01)),
    "mlirl": lambda mdp: mlirl(KEY, mdp, demonstration(), restarts=2, iterations=40).weights,
    "em_mlirl": lambda mdp: em_mlirl(mdp, n_components=2, iterations=4).fit(KEY, demonstration()).weights,
    "dpm_birl": lambda mdp: dpm_birl(mdp, iterations=15, sigma=0.1).fit(KEY, demonstration()).weights,
    "birl": lambda mdp: birl(KEY, mdp, demonstration(), draws=30, warmup=30, chains=2)["posterior"][
        "weights"
    ].values[0],
    "batch_mme_mtirl": lambda mdp: (
        batch_mme_mtirl(mdp, n_components=2, restarts=1).fit(KEY, demonstration()).weights
    ),
    "posterior mode": _mode,
    "lme_i2rl": _learned(lambda mdp: lme_i2rl(mdp, VIEW), "hidden"),
    "lme_i2rl counts": _learned(lambda mdp: lme_i2rl(mdp, VIEW, statistic="counts", ridge=0.3), "hidden"),
    "lme_i2rl features": _learned(lambda mdp: lme_i2rl(mdp, VIEW, statistic="features"), "hidden"),
    "lme_i2rl ipopt": _learned(
        lambda mdp: lme_i2rl(mdp, VIEW, solver="ipopt", slack=0.0, ridge=0.1), "hidden"
    ),
    "me_i2rl ipopt features": _learned(lambda mdp: me_i2rl(mdp, solver="ipopt", statistic="features")),
    "me_i2rl cvxpy": _learned(lambda mdp: me_i2rl(mdp, solver="cvxpy", statistic="features", iterations=2)),
    "me_i2rl exponentiated gradient": _learned(
        lambda mdp: me_i2rl(mdp, solver="exponentiated gradient", statistic="features", iterations=2)
    ),
    "lme_i2rl with random weights": _learned(lambda mdp: lme_i2rl_with_random_weights(mdp, VIEW), "hidden"),
    "batch_lme": lambda mdp: batch_lme(mdp, VIEW, restarts=1).fit(KEY, demonstration("hidden")).weights,
    "robust_irl": lambda mdp: robust_irl(mdp, NOISE, restarts=1).fit(KEY, demonstration("noisy")).weights,
    "rimeo": _learned(lambda mdp: rimeo(mdp, PREDICATES, scores="none"), "noisy"),
    "rimeo ipopt": _learned(lambda mdp: rimeo(mdp, PREDICATES, scores="none", solver="ipopt"), "noisy"),
    "rifom": _learned(lambda mdp: rifom(mdp, PREDICATES, slack=0.01), "noisy"),
}
# Greedy experts, whose policy is not the soft one.
GREEDY = ("mlirl", "em_mlirl", "dpm_birl", "birl", "jin_i2rl_with_features")
# Samplers magnify the least difference: their units are powers of two, which are exact.
SAMPLERS = ("dpm_birl", "birl")


def units_of(name: str, number: int, seed: int = 0) -> Float[np.ndarray, "number K"]:
    """Return units from 1e-9 to 1e9: all small, all large, then mixed at random."""
    exponents = np.random.default_rng(seed).uniform(-9, 9, (max(number - 2, 0), 3))
    exponents = np.concatenate([np.full((1, 3), -9.0), np.full((1, 3), 9.0), exponents])[:number]
    if name in SAMPLERS:
        return 2.0 ** np.round(exponents * np.log2(10))
    return 10.0**exponents


def policies(mdp: TabularMDP, weights: Array | np.ndarray, name: str = "") -> Float[np.ndarray, "D S A"]:
    """Compute the policy of each row of weights under the method's model of experts."""
    of = greedy_policy if name in GREEDY else policy
    return np.stack([of(mdp, jnp.asarray(row)) for row in np.asarray(weights).reshape(-1, 3)])


class Difference(NamedTuple):
    """Effect of units: the largest difference of a policy, and of a weight relative to the largest."""

    policy: float
    weight: float


def difference(name: str, units: Float[np.ndarray, "number K"]) -> Difference:
    """Compute the largest differences between learning in these units and in the original ones."""
    plain = np.asarray(METHODS[name](process()))
    expected = policies(process(), plain, name)
    worst = Difference(0.0, 0.0)
    for each in units:
        mdp = in_units(each)
        weights = np.asarray(METHODS[name](mdp))
        apart = np.abs(policies(mdp, weights, name) - expected).max()
        relative = np.abs(weights * each - plain).max() / np.abs(plain).max()
        worst = Difference(max(worst.policy, float(apart)), max(worst.weight, float(relative)))
    return worst


# -- IPOPT --------------------------------------------------------------------------------------------


def random_process(seed: int, kind: str) -> TabularMDP:
    """Build a process of ten states, three actions, three normal features, the last perhaps constant or a
    duplicate.
    """
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(10, 3, 3))
    if kind == "constant":
        features[..., 2] = 1.0
    if kind == "duplicate":
        features[..., 2] = features[..., 0]
    mdp = TabularMDP.from_successors(
        rng.integers(0, 10, (10, 3, 3)),
        rng.dirichlet(np.ones(3), (10, 3)),
        features,
        initial=rng.dirichlet(np.ones(10)),
        discount=(0.9, 0.95, 0.99)[seed % 3],
    )
    return mdp.without_inflow()


class Solved(NamedTuple):
    """One program: IPOPT's failure in words, or its differences from Newton's method and its iterations."""

    failure: str
    objective: float
    policy: float
    iterations: int


def solve_both(seed: int, kind: str, program: str, length: float = 1.0) -> Solved:
    """Solve a random program without slack by both methods; ``length`` is that of the expert's weights."""
    mdp = random_process(seed, kind)
    weights = jnp.asarray(length * np.random.default_rng(1000 + seed).normal(size=3))
    expert = policy(mdp, weights)
    try:
        if program == "DualProgram":
            aim = FeatureTarget(feature_expectations(mdp, expert), mdp.initial)
            newton, ipopt = solve_dual(mdp, aim), DualProgram(mdp).solve(aim)
        else:
            visits = np.random.default_rng(seed).poisson(60 * np.asarray(occupancy(mdp, expert)))
            newton, ipopt = fit_counts(mdp, jnp.asarray(visits, float)), CountProgram(mdp).solve(visits)
    except (RuntimeError, ValueError) as error:
        return Solved(str(error), np.nan, np.nan, 0)
    apart = np.abs(policies(mdp, ipopt.weights) - policies(mdp, newton.weights)).max()
    return Solved("", abs(ipopt.objective - float(newton.objective)), float(apart), ipopt.iterations)


# -- main ---------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and publish; 1 where something depends on units, or IPOPT fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--units", type=int, default=4, help="units that each method is tried in")
    parser.add_argument("--programs", type=int, default=75, help="random programs of each kind for IPOPT")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", action="append", help="only these methods (may be repeated)")
    parser.add_argument("--output", type=Path, default=None)
    options = parser.parse_args(arguments)
    names = options.method or list(METHODS)
    differences = {}
    for name in names:
        differences[name] = difference(name, units_of(name, options.units, options.seed))
        print(f"{name}: policies {differences[name].policy:.1e}, weights {differences[name].weight:.1e}")
    print_table(
        f"Largest differences over {options.units} units from 1e-9 to 1e9",
        ("method", "policy", "weight, relative"),
        [(name, f"{d.policy:.1e}", f"{d.weight:.1e}") for name, d in differences.items()],
    )
    rows, failed = [], 0
    for program in ("DualProgram", "CountProgram"):
        for kind in KINDS if options.programs else ():
            solved = [
                solve_both(seed, kind, program, length)
                for length in (0.3, 1.0, 3.0)
                for seed in range(options.programs)
            ]
            good = [one for one in solved if not one.failure]
            failed += len(solved) - len(good) + sum(one.objective > TOLERANCE for one in good)
            rows.append(
                (
                    program,
                    kind,
                    f"{len(solved) - len(good)} of {len(solved)}",
                    f"{max(one.objective for one in good):.1e}",
                    f"{max(one.policy for one in good):.1e}",
                    int(np.median([one.iterations for one in good])),
                    max(one.iterations for one in good),
                )
            )
    columns = ("program", "features", "failed", "objective", "policy", "iterations", "most")
    if rows:
        print_table("IPOPT without slack, against Newton's method", columns, rows)
    publish(
        "units",
        {
            "differences": {name: d._asdict() for name, d in differences.items()},
            "ipopt": [dict(zip(columns, row, strict=True)) for row in rows],
        },
        options.output,
    )
    dependent = [name for name, d in differences.items() if not d.policy <= TOLERANCE]
    if dependent:
        print(f"Depend on units: {', '.join(dependent)}")
    if failed:
        print(f"{failed} programs were not solved by IPOPT, or to another objective")
    return int(bool(dependent or failed))


if __name__ == "__main__":
    sys.exit(main())
