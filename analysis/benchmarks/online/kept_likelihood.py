"""Error of online learning against batch, by what is kept: visits of seen steps, or the likelihood itself.

``python -m i2rl.analysis.benchmarks.online.kept_likelihood`` learns a chain of six states (steps fail in
three cases of ten) from 128 trajectories of 16 steps, one a session, with the actions unseen or flipped in 35
of 100 cases; and patrol 2 at 30 % in view from 60 trajectories of 60 steps, also with a third of the actions
misread. It prints mean and largest policy errors (the largest difference of an action's probability; on
patrol 2 the mean over visits), their ratio to batch, and how far the penalised log-likelihood of all
trajectories lies below batch's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from ....compilation import compile_quickly
from ....domains.patrol.process import instance
from ....inference.completion.smoothing import evidence_of, log_likelihoods
from ....inference.learners.lme import batch_lme, lme_i2rl
from ....inference.sessions.running import run_sessions
from ....models.laws.trajectory import TrajectoryLaw
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import AnySensor, FeatureNoise, Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import occupancy, reward_of, soft_plan
from ....models.process.units import feature_scale
from ..harness import print_table, publish

RIDGE = 0.02
CERTAIN = 1 - 1e-9


def chain() -> TabularMDP:
    """Build six states in a row, with a feature at either end."""
    here = np.arange(6)
    aims = np.stack([np.maximum(here - 1, 0), np.minimum(here + 1, 5)], axis=1)
    features = np.zeros((6, 2, 2))
    features[0, :, 0] = features[-1, :, 1] = 1
    successors = np.stack([aims, aims[:, ::-1]], axis=2)
    probabilities = np.broadcast_to([0.7, 0.3], successors.shape)
    return TabularMDP.from_successors(successors, probabilities, features, discount=0.9)


def cases() -> dict[str, tuple[TabularMDP, np.ndarray, AnySensor, int, int, bool]]:
    """Return process, true weights, sensor, trajectories, steps, and whether actions go unseen, by name."""
    row, patrol = chain(), instance(2)
    pairs = np.indices((6, 2)), np.indices((patrol.mdp.n_states, patrol.mdp.n_actions))
    view = patrol.visibility(30)
    end, true = np.array([0.0, 1.5]), 14 * np.asarray(patrol.weights)
    misread = FeatureNoise(pairs[1], np.array([CERTAIN, 2 / 3])) * view
    return {
        "chain, actions unseen": (row, end, Visibility(np.ones(6)), 128, 16, True),
        "chain, actions flipped": (
            row,
            end,
            FeatureNoise(pairs[0], np.array([CERTAIN, 0.65])),
            128,
            16,
            False,
        ),
        "patrol 2, hidden": (patrol.mdp, true, view, 60, 60, False),
        "patrol 2, hidden and misread": (patrol.mdp, true, misread, 60, 60, False),
    }


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", help="part of the names of cases")
    options = parser.parse_args()
    compile_quickly()
    rows = []
    for name, (mdp, truth, sensor, n, steps, unseen) in cases().items():
        if options.only and options.only not in name:
            continue
        learners = {
            "seen": lme_i2rl(mdp, sensor, slack=0.0, ridge=RIDGE),
            "likelihood": lme_i2rl(mdp, sensor, statistic="likelihood", ridge=RIDGE),
        }
        batch = batch_lme(mdp, sensor, slack=0.0, ridge=RIDGE, restarts=2)
        scale = np.asarray(feature_scale(mdp))
        expert = soft_plan(mdp, reward_of(mdp, jnp.asarray(truth))).policy
        visits = occupancy(mdp, expert).sum(1)
        found: dict[str, list[tuple[float, float, float]]] = {"batch": [], "seen": [], "likelihood": []}
        for seed in range(options.seeds):
            law = TrajectoryLaw(mdp, jnp.asarray(truth), sensor, steps)
            shown = Demonstration.from_codes(np.asarray(law.sample(jax.random.key(seed), (n,))))
            if unseen:
                shown = replace(shown, action=np.full_like(shown.action, -1))
            evidence, key = evidence_of(mdp, sensor, shown), jax.random.key(100 + seed)
            for method, kept in found.items():
                if method == "batch":
                    weights, spent = batch.fit(key, shown).weights, float("nan")
                else:
                    run = run_sessions(learners[method], shown.sessions(), key=key)
                    weights = np.asarray(run.state.weights)
                    spent = float(np.median([info.seconds for info in run.infos]))
                plan = soft_plan(mdp, reward_of(mdp, jnp.asarray(weights)))
                wrong = jnp.max(jnp.abs(plan.policy - expert), axis=1)
                error = float(jnp.max(wrong) if mdp.n_states < 10 else wrong @ visits / visits.sum())
                height = float(jnp.sum(log_likelihoods(mdp, plan.log_policy, evidence)))
                kept.append((error, height - RIDGE / 2 * np.sum((weights * scale) ** 2), spent))
        reference = np.array(found["batch"])
        for method, kept in found.items():
            errors, heights, spent_all = np.array(kept).T
            below = float(np.mean(reference[:, 1] - heights))
            ratio = float(errors.mean() / reference[:, 0].mean())
            times = float(np.median(spent_all)) * 1e3
            rows.append((name, method, float(errors.mean()), float(errors.max()), ratio, below, times))
            print(rows[-1], flush=True)
    columns = ["case", "kept", "mean error", "largest", "over batch", "nats below batch", "ms a session"]
    print_table(f"{options.seeds} seeds", columns, rows)
    publish("kept_likelihood", {"rows": rows})


if __name__ == "__main__":
    main()
