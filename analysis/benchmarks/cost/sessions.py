"""Cost of a session: warm against cold, against the sessions seen, and online against batch.

``python -m i2rl.analysis.benchmarks.cost.sessions`` measures, on patrol instance 2 at 30 % observability:

- IPOPT iterations of a session's programs (warm-started within the session and from the one before), and of
  its last program from a cold start;
- the time of a session after 10 and after 1000 sessions, and the growth of memory in between;
- the cumulative time of 239 online sessions against one batch run over all of them, and against batch
  re-run after every session;
- the time of one E- and M-step against trajectory length, trajectories a session, and states.
"""

from __future__ import annotations

import argparse
import resource
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ....domains.patrol.process import demonstrate, instance
from ....inference.learners.lme import batch_lme, lme_i2rl
from ....inference.programs.constraints import FeatureTarget
from ....inference.programs.dual import CountProgram, DualProgram
from ....inference.sessions.running import run_sessions
from ....models.observation.demonstration import HIDDEN, UNKNOWN, Demonstration
from ....models.observation.evidence import Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, simulate, soft_plan
from ..harness import print_table, publish, seconds


def ipopt_iterations(sessions: int, seed: int = 0) -> dict[str, Any]:
    """Count IPOPT iterations per program: as the learner solves it, and the session's last program from a
    cold start.
    """
    patrol = instance(2)
    demonstration = demonstrate(jax.random.key(seed), patrol, 30, sessions)[0]
    result = {}
    for statistic in ("features", "counts"):
        learner = lme_i2rl(patrol.mdp, patrol.visibility(30), statistic=statistic, solver="ipopt")
        slack = learner.configuration["slack"]
        features, counts = DualProgram(patrol.mdp), CountProgram(patrol.mdp)
        state = learner.init(jax.random.key(seed))
        warm, cold, per_session = [], [], []
        for one in demonstration.sessions():
            state, report = learner.update(state, one)
            kept = state.statistic
            # With these two statistics the state is the last program's data.
            if statistic == "features":
                target = FeatureTarget(np.asarray(kept.features), np.asarray(kept.start))
                solved = features.solve(target, slack / (1 - float(patrol.mdp.discount)))
            else:
                solved = counts.solve(np.asarray(kept.counts), slack)
            cold.append(solved.iterations)
            warm.append(report.solver_iterations / report.iterations)
            per_session.append(report.solver_iterations)
        result[statistic] = {
            "warm, median per program": float(np.median(warm[1:])),
            "warm, median per session": float(np.median(per_session[1:])),
            "cold, median per program": float(np.median(cold)),
        }
    return result


def steady_cost(sessions: int = 1000, window: int = 50) -> dict[str, float]:
    """Measure the median time of a session around the 10th and around the last, and memory growth in MiB."""
    patrol = instance(2)
    demonstration = demonstrate(jax.random.key(1), patrol, 30, sessions + window)[0]
    learner = lme_i2rl(patrol.mdp, patrol.visibility(30))
    # A first stream compiles and warms the caches.
    run_sessions(learner, demonstration.select(slice(0, window)).sessions(), key=jax.random.key(0))
    state = learner.init(jax.random.key(0))
    times, memory = [], []
    for one in demonstration.sessions():
        state, report = learner.update(state, one)
        times.append(report.seconds)
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    early = np.median(times[10 : 10 + window])
    late = np.median(times[sessions : sessions + window])
    return {
        "seconds after 10": float(early),
        f"seconds after {sessions}": float(late),
        "ratio": float(late / early),
        "peak memory growth MiB": float(memory[-1] - memory[10]),
    }


def online_against_batch(sessions: int, replications: int, rerun_points: int = 12) -> dict[str, float]:
    """Measure cumulative seconds of online sessions, of one batch run, and of batch re-run after every
    session.

    Re-running is measured at ``rerun_points`` evenly spread sessions (shapes compiled first) and summed by
    interpolation between them.
    """
    patrol = instance(2)
    learner = lme_i2rl(patrol.mdp, patrol.visibility(30))
    batch = batch_lme(patrol.mdp, patrol.visibility(30))
    online, once, rerun = [], [], []
    for seed in range(replications + 1):
        demonstration = demonstrate(jax.random.key(seed), patrol, 30, sessions)[seed % 2]
        key = jax.random.key(seed)
        # A first pass over the same shapes compiles; it is not timed.
        if seed == 0:
            run_sessions(learner, demonstration.sessions(), key=key)
        points = np.unique(np.linspace(1, sessions, rerun_points).round().astype(int))
        spent = []
        for n in points:
            part = demonstration.select(slice(0, int(n)))
            if seed == 0:
                batch.fit(key, part)
            spent.append(seconds(partial(batch.fit, key, part)))
        if seed == 0:
            continue
        total = sum(r.seconds for r in run_sessions(learner, demonstration.sessions(), key=key).infos)
        online.append(total)
        once.append(spent[-1])
        rerun.append(float(np.interp(np.arange(1, sessions + 1), points, spent).sum()))
    return {
        "online seconds": float(np.median(online)),
        "one batch run seconds": float(np.median(once)),
        "batch re-run every session seconds": float(np.median(rerun)),
        "online / one batch run": float(np.median(np.array(online) / np.array(once))),
        "online / batch re-run": float(np.median(np.array(online) / np.array(rerun))),
    }


def ring(n_states: int, n_actions: int = 4, n_features: int = 6, seed: int = 0) -> TabularMDP:
    """Build a random MDP of local moves on a ring, three successors a pair, binary features."""
    rng = np.random.default_rng(seed)
    offsets = np.stack([np.full((n_states, n_actions), d) for d in (-1, 0, 1)], -1)
    successors = (np.arange(n_states)[:, None, None] + offsets) % n_states
    probabilities = rng.dirichlet(np.ones(3), (n_states, n_actions))
    features = (rng.random((n_states, n_actions, n_features)) < 0.3).astype(float)
    return TabularMDP.from_successors(successors, probabilities, features, discount=0.99)


def session_cost(mdp: TabularMDP, length: int, trajectories: int, sessions: int = 12) -> float:
    """Measure the median seconds of one E- and M-step of a session, with a third of the states in view."""
    view = Visibility(np.arange(mdp.n_states) < mdp.n_states // 3)
    weights = jnp.linspace(-1, 1, mdp.n_features)
    policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
    keys = jax.random.split(jax.random.key(0), sessions * trajectories)
    states, actions = jax.vmap(lambda k: simulate(k, mdp, policy, length))(keys)
    full = Demonstration.from_pairs(np.asarray(states), np.asarray(actions))
    inside = np.asarray(view.in_view)[full.state] > 0
    hidden = Demonstration(
        np.where(inside, full.kind, HIDDEN).astype(np.int8),
        np.where(inside, full.state, UNKNOWN),
        np.where(inside, full.action, UNKNOWN),
        full.score,
    )
    run = run_sessions(lme_i2rl(mdp, view), hidden.sessions(trajectories), key=jax.random.key(0))
    return float(np.median([r.seconds / r.iterations for r in run.infos[2:]]))


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--sessions", type=int, default=239)
    parser.add_argument("--replications", type=int, default=5)
    options = parser.parse_args()
    studies: dict[str, Callable[[], dict[str, Any]]] = {
        "ipopt iterations": lambda: ipopt_iterations(60),
        "session time": steady_cost,
        "online against batch": lambda: online_against_batch(options.sessions, options.replications),
        "seconds of a step against states": lambda: {
            str(n): session_cost(ring(n), 5, 1) for n in (32, 124, 496, 1024)
        },
        "seconds of a step against length": lambda: {
            str(n): session_cost(ring(124), n, 1) for n in (5, 20, 80, 320)
        },
        "seconds of a step against trajectories": lambda: {
            str(n): session_cost(ring(124), 5, n) for n in (1, 4, 16, 64)
        },
    }
    results = {}
    for title, study in studies.items():
        values = results[title] = study()
        rows = [
            (f"{name}: {k}", v)
            for name, entry in values.items()
            if isinstance(entry, dict)
            for k, v in entry.items()
        ]
        rows += [(k, v) for k, v in values.items() if not isinstance(v, dict)]
        print_table(title, ("", "value"), rows)
    publish("sessions", results)


if __name__ == "__main__":
    main()
