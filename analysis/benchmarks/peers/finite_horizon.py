"""Tabular MCE IRL beside the ``imitation`` library: wall time to the same gap on the same problems.

``python -m i2rl.analysis.benchmarks.peers.finite_horizon`` (``make bench-peers`` prepares the peer's
environment) prints a table and writes every run to ``build/bench/peers.json``.

The problems: random processes with 4 actions and 5 successors, horizon 50, discount 1 (the peer plans
without the discount while it trains), one-hot observations, i.e. one weight per state. The demonstrator's
state visits are given exactly, from a standard-normal reward. Both sides stop when no state's visits differ
from the demonstrator's by more than the tolerance; both policies are then judged by one NumPy evaluation
that belongs to neither. The peer runs Adam at 0.05, its quickest setting measured, and is timed over
``MCEIRL.train`` alone, with its dense model ready and logging off; ours over the fit and the final plan.

The peer counts the state after the last action among the visits (51 of them); we count the states in which
the expert acts (50), which makes the gap the gradient of a convex dual. The judge counts as the peer does,
and our tolerance is made smaller by 50 / 51 to make up for it.

Each side runs in a process of its own, with one thread, pinned to one core, and the runs alternate, so that
other load of the machine affects both.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import sparse

HORIZON = 50
N_ACTIONS = 4
WIDTH = 5
ADAM_RATE = 0.05
_ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "JAX_PLATFORMS": "cpu",
}


# -- the problem and its judge: NumPy alone -----------------------------------------------------------


def random_problem(n_states: int, seed: int, tolerance: float) -> dict[str, np.ndarray]:
    """Draw a random process and the exact visits of the soft expert of a standard-normal state reward."""
    rng = np.random.default_rng(seed)
    rows = n_states * N_ACTIONS
    successors = np.array([rng.choice(n_states, WIDTH, replace=False) for _ in range(rows)])
    problem = {
        "successors": successors.reshape(n_states, N_ACTIONS, WIDTH),
        "probabilities": rng.dirichlet(np.ones(WIDTH), (n_states, N_ACTIONS)),
        "initial": rng.dirichlet(np.ones(n_states)),
        "horizon": np.array(HORIZON),
        "tolerance": np.array(tolerance),
        "adam_rate": np.array(ADAM_RATE),
        "seed": np.array(seed),
    }
    reward = rng.normal(size=n_states)
    matrix = transition_matrix(problem)
    values, policy = np.zeros(n_states), np.empty((HORIZON, n_states, N_ACTIONS))
    for t in reversed(range(HORIZON)):
        q = reward[:, None] + (matrix @ values).reshape(n_states, N_ACTIONS)
        values = np.logaddexp.reduce(q, axis=1)
        policy[t] = np.exp(q - values[:, None])
    visits = state_visits(problem, policy)
    return {**problem, "visits": visits[:-1].sum(0), "visits_and_last": visits.sum(0)}


def transition_matrix(problem: dict[str, np.ndarray]) -> sparse.csr_array:
    """Compute ``P(s' | s, a)`` as a sparse matrix ``[S * A, S]``."""
    n_states, n_actions, width = problem["successors"].shape
    rows = np.repeat(np.arange(n_states * n_actions), width)
    return sparse.csr_array(
        (problem["probabilities"].ravel(), (rows, problem["successors"].ravel())),
        shape=(n_states * n_actions, n_states),
    )


def state_visits(problem: dict[str, np.ndarray], policy: np.ndarray) -> np.ndarray:
    """Compute ``P(s_t = s)`` of a policy ``[T, S, A]`` for ``t = 0 .. T``, as ``[T + 1, S]``."""
    backwards = transition_matrix(problem).T.tocsr()
    states = [problem["initial"]]
    for step in policy:
        states.append(backwards @ (states[-1][:, None] * step).ravel())
    return np.array(states)


def final_gap(problem: dict[str, np.ndarray], policy: np.ndarray) -> float:
    """Compute the largest difference of any state's visits, over all 51 times, from the demonstrator's."""
    return float(np.abs(state_visits(problem, policy).sum(0) - problem["visits_and_last"]).max())


# -- our side, in a process of its own ----------------------------------------------------------------


def serve() -> None:
    """Answer requests ``problem.npz result.npz`` from standard input with one JSON line of timings each."""
    # Imported here: the process that hands out the work needs neither JAX nor the package's models.
    import jax
    import jax.numpy as jnp

    from ....inference.programs.finite_horizon import fit_state_rewards, state_reward
    from ....models.process.mdp import TabularMDP
    from ....models.process.planning import finite_soft_plan
    from ....version import __version__

    plan = jax.jit(finite_soft_plan, static_argnames="horizon")
    print(json.dumps({"i2rl": __version__, "jax": jax.__version__}), flush=True)
    for request in sys.stdin:
        source, destination = request.split()
        problem = dict(np.load(source))
        mdp = TabularMDP.from_successors(
            problem["successors"],
            problem["probabilities"],
            np.zeros((*problem["successors"].shape[:2], 1)),
            initial=problem["initial"],
            discount=1.0,
        )
        horizon = int(problem["horizon"])
        tolerance = float(problem["tolerance"]) * horizon / (horizon + 1)
        jax.block_until_ready(mdp)
        started, processor_started = time.perf_counter(), time.process_time()
        fit = fit_state_rewards(mdp, horizon, problem["visits"], tolerance=tolerance)
        log_policy = jax.block_until_ready(
            plan(mdp, state_reward(mdp, jnp.asarray(fit.weights)), horizon).log_policy
        )
        timing = {
            "seconds": time.perf_counter() - started,
            "processor_seconds": time.process_time() - processor_started,
            "evaluations": fit.evaluations,
        }
        np.savez(destination, policy=np.exp(log_policy))
        print(json.dumps(timing), flush=True)


# -- handing out the work -----------------------------------------------------------------------------


class Side:
    """One contestant: a process with one thread on one core, answering one request at a time."""

    def __init__(self, name: str, command: Sequence[str], folder: Path, core: int | None) -> None:
        self.name = name
        self._result = folder / f"{name}.npz"
        self._process = subprocess.Popen(
            command if core is None else ["taskset", "--cpu-list", str(core), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **_ONE_THREAD},
        )
        self.versions: dict[str, str] = self._answer()

    def solve(self, source: Path, problem: dict[str, np.ndarray]) -> dict[str, float]:
        """Measure wall and processor seconds, gradient evaluations and the judge's gap of one run."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{source} {self._result}\n")
        self._process.stdin.flush()
        answer = self._answer()
        with np.load(self._result) as result:
            return {**answer, "gap": final_gap(problem, result["policy"])}

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process of {self.name} ended with status {self._process.wait()}")
        return json.loads(line)


def compare(
    ours: Side, peer: Side, folder: Path, n_states: int, problems: int, our_runs: int, tolerance: float
) -> dict[str, Any]:
    """Run both sides in turn on ``problems`` random problems of one size.

    Our first run on each problem counts separately: on the first problem it compiles everything, on the
    others what depends on their padding. Raises ``RuntimeError`` if any run misses the tolerance: times to
    different gaps are not comparable.
    """
    runs: dict[str, list[dict[str, float]]] = {"ours_first": [], "ours": [], "peer": []}
    for seed in range(problems):
        problem = random_problem(n_states, seed, tolerance)
        source = folder / f"problem-{n_states}-{seed}.npz"
        np.savez(source, **problem)  # type: ignore[arg-type]
        runs["ours_first"].append(ours.solve(source, problem))
        runs["ours"].append(ours.solve(source, problem))
        runs["peer"].append(peer.solve(source, problem))
        runs["ours"].extend(ours.solve(source, problem) for _ in range(our_runs - 1))
    for side, results in runs.items():
        worst = max(run["gap"] for run in results)
        if worst > tolerance:
            raise RuntimeError(
                f"{side} stopped at a gap of {worst:.3g} with {n_states} states, above {tolerance:g}"
            )

    def median(side: str, key: str) -> float:
        return statistics.median(run[key] for run in runs[side])

    def per_gradient(side: str) -> float:
        return statistics.median(run["seconds"] / run["evaluations"] for run in runs[side])

    first = runs["ours_first"][0]
    ours_seconds, peer_seconds = median("ours", "seconds"), median("peer", "seconds")
    return {
        "states": n_states,
        "tolerance": tolerance,
        "ours_seconds": ours_seconds,
        "peer_seconds": peer_seconds,
        "ratio": peer_seconds / ours_seconds,
        "ratio_of_processor_seconds": median("peer", "processor_seconds")
        / median("ours", "processor_seconds"),
        "ratio_per_gradient": per_gradient("peer") / per_gradient("ours"),
        "ours_first_seconds": first["seconds"],
        "ours_compile_seconds": first["seconds"] - ours_seconds,
        "ratio_with_compilation": peer_seconds / first["seconds"],
        "ours_evaluations": median("ours", "evaluations"),
        "peer_evaluations": median("peer", "evaluations"),
        "ours_worst_gap": max(run["gap"] for run in runs["ours"]),
        "peer_worst_gap": max(run["gap"] for run in runs["peer"]),
        "runs": runs,
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title=f"Tabular MCE IRL to a gap of {rows[0]['tolerance']:g}, median seconds")
    headings = (
        "states",
        "i2rl",
        "imitation",
        "ratio",
        "first i2rl",
        "ratio",
        "gradients",
        "ratio of one",
        "gaps",
    )
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            str(row["states"]),
            f"{row['ours_seconds']:.4f}",
            f"{row['peer_seconds']:.3f}",
            f"{row['ratio']:.0f}",
            f"{row['ours_first_seconds']:.2f}",
            f"{row['ratio_with_compilation']:.1f}",
            f"{row['ours_evaluations']:.0f}, {row['peer_evaluations']:.0f}",
            f"{row['ratio_per_gradient']:.0f}",
            f"{row['ours_worst_gap']:.4f}, {row['peer_worst_gap']:.4f}",
        )
    return table


def main() -> None:
    """Compare the sizes asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, nargs="+", default=[124, 1024], help="numbers of states")
    parser.add_argument("--problems", type=int, default=3, help="random problems of each size")
    parser.add_argument(
        "--replications", type=int, default=5, help="our replications a problem (the peer: one)"
    )
    parser.add_argument("--tolerance", type=float, default=1e-2, help="gap in any state's visits to stop at")
    parser.add_argument("--peer-python", type=Path, default=Path(".venv-peers/bin/python"))
    parser.add_argument("--output", type=Path, default=Path("build/bench/peers.json"))
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    if not options.peer_python.exists():
        parser.error(
            f"no interpreter at {options.peer_python}: `make bench-peers` prepares one with `imitation`"
        )
    # taskset and CPU affinity are Linux's; elsewhere the single thread has to do.
    core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    load = os.getloadavg()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours = Side("ours", [sys.executable, "-m", __spec__.name, "--serve"], folder, core)
        script = Path(__file__).with_name("peer_mce.py")
        peer = Side("peer", [str(options.peer_python.absolute()), str(script)], folder, core)
        rows = [
            compare(ours, peer, folder, n, options.problems, options.replications, options.tolerance)
            for n in options.states
        ]
        for side in (ours, peer):
            side.close()
    report = {
        "versions": {**ours.versions, **peer.versions, "python": platform.python_version()},
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "load_before_and_after": [load[0], os.getloadavg()[0]],
        "horizon": HORIZON,
        "actions": N_ACTIONS,
        "successors": WIDTH,
        "adam_rate": ADAM_RATE,
        "results": rows,
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=1) + "\n")
    Console(width=110).print(_table(rows))
    print(f"written: {options.output}")


if __name__ == "__main__":
    main()
