"""AIRL on patrol with noisy observations, and GAIL on patrol with hidden steps (7.4.3 and 7.4.1).

``python -m i2rl.analysis.benchmarks.statistics.adversarial_patrol`` writes
``build/bench/adversarial_patrol.json`` and, beside it, figures (``patrol-view`` is to be seen beside Figure
7.4(c)):

- *noise*: instance 2, its greedy expert (the dissertation's is a rule by hand), trajectories of 8 pairs from
  anywhere, sessions of 32 to 128 pairs. Moving forward is observed as turning left, and turning right as
  moving forward; states are always right. LBA after every session of AIRL on the truth, of AIRL and
  robust-AIRL on the observations, with the sensor given or learned, and of LME-I2RL on the same observations,
  with the six features of the expert's reward. AIRL learners with and without memory of earlier sessions.
  Success of each final policy in passing the patrollers undetected.
- *view*: the same patrol, sessions of one trajectory of 5 pairs for each patroller, at three degrees of
  observability; online GAIL on the steps seen, GAIL on the posterior of the hidden steps too, and LME-I2RL.

Parts and methods that the file already holds are not measured again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ....domains.patrol.process import Patrol, demonstrate, instance
from ....inference.adversarial.tabular.learners import (
    gail_tabular,
    gibbs_airl_tabular,
    robust_airl_tabular,
    robust_gail_tabular,
)
from ....inference.learners.lme import lme_i2rl
from ....inference.sessions.learner import Learner
from ....models.observation.demonstration import Demonstration
from ...studies.adversarial import results as methods
from ...studies.adversarial.patrol import (
    Outcome,
    Streams,
    interval,
    noise_learners,
    noisy_streams,
    outcome_of,
    success_rates,
)
from ...studies.adversarial.patrol_figures import (
    CLEAN,
    GAIL,
    LAST,
    LEARNED,
    LME,
    NOISY,
    ROBUST,
    ROBUST_GAIL,
    write_figures,
)
from ..harness import DEFAULT_FOLDER, machine, print_table, seconds

LEVELS = (0.05, 0.1, 0.2, 0.3)
GIBBS, LOGITS = "robust-AIRL, Gibbs", "robust-AIRL, average of logits"
# Of those tried, the best for GAIL in a full view.
GAIL_OPTIONS: dict[str, Any] = {"occupancy": "discounted"}
VIEWS = (100, 70, 30)
WINDOW = 5


def view_streams(patrol: Patrol, view: int, replications: int, sessions: int, seed: int = 0) -> Demonstration:
    """Simulate windows of both patrollers of each replication, ``[replications * patrollers, sessions, 1,
    WINDOW]``.
    """
    keys = jax.random.split(jax.random.key(seed), replications)
    rows = [d for key in keys for d in demonstrate(key, patrol, view, sessions, WINDOW)]
    return jax.tree.map(lambda *parts: np.stack(parts)[:, :, None], *rows)


# -- studies ------------------------------------------------------------------------------------------


class _File:
    """Results as they come: what is there is not measured again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def measure(self, part: str, name: str, action: Callable[[], Mapping[str, Any]]) -> None:
        known = self.results.setdefault(part, {})
        if name not in known:
            known[name] = {"machine": machine(), **action()}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.write_text(json.dumps(self.results) + "\n")
            print(part, name, {k: v for k, v in known[name].items() if np.ndim(v) == 0}, flush=True)


def _timed(patrol: Patrol, learner: Learner, streams: Demonstration) -> tuple[Outcome, float]:
    """Run all streams of a learner; return the seconds they took, compilation included."""
    found: list[Outcome] = []
    took = seconds(lambda: found.append(outcome_of(patrol, learner, streams)))
    return found[0], took


def noise_methods(
    streams: Streams, patrol: Patrol
) -> dict[str, tuple[Callable[..., Learner], Demonstration]]:
    """Return learners (given options) and the input of each."""
    mdp = patrol.mdp
    shared = noise_learners(patrol, streams.sensor)
    return {
        CLEAN: (shared[methods.CLEAN], streams.truth),
        NOISY: (shared[methods.NOISY], streams.seen),
        ROBUST: (shared[methods.ROBUST], streams.seen),
        LEARNED: (shared[methods.LEARNED], streams.seen),
        GIBBS: (partial(gibbs_airl_tabular, mdp, streams.sensor, draws=10, burn_in=10), streams.seen),
        LOGITS: (partial(robust_airl_tabular, mdp, streams.sensor, average="logits"), streams.seen),
        LME: (lambda **_: lme_i2rl(mdp, streams.sensor), streams.seen),
    }


def noise_study(
    file: _File,
    *,
    replications: int,
    few: int,
    sessions: int,
    trials: int,
    levels: Sequence[float],
    iterations: int,
) -> None:
    """Run every method at the first level; at the others, on ``few`` replications, the methods that show the
    cost of noise.

    AIRL learners with and without memory of earlier sessions.
    """
    patrol = instance(2)
    true = np.broadcast_to(patrol.expert_policy(), (replications, *patrol.expert_policy().shape))

    def with_the_true_policy() -> dict[str, Any]:
        success = success_rates(patrol, true, trials)
        return {"success": success.tolist(), "success mean": float(success.mean()), "trials": trials}

    file.measure("noise", "true policy", with_the_true_policy)
    first, *others = levels
    jobs = [
        *((first, name, 0.0) for name in (CLEAN, NOISY, ROBUST)),
        *((first, name, 1.0) for name in (CLEAN, NOISY, ROBUST, LME, LEARNED)),
        *(
            (level, name, forgetting)
            for level in others
            for forgetting in (0.0, 1.0)
            for name in (NOISY, ROBUST)
        ),
        *((first, name, 0.0) for name in (LEARNED, LOGITS, GIBBS)),
    ]
    streams_of = cache(partial(noisy_streams, patrol, replications=replications, sessions=sessions))
    for level, name, forgetting in jobs:
        everything = level == first and name not in (GIBBS, LOGITS)
        count, tried = (replications, trials) if everything else (min(few, replications), 0)
        streams = streams_of(level)
        make, seen = noise_methods(streams, patrol)[name]
        learner = make(forgetting=forgetting, iterations=iterations)
        own = Demonstration(*(x[:count] for x in seen.arrays))

        def action(
            name: str = name,
            forgetting: float = forgetting,
            level: float = level,
            learner: Learner = learner,
            own: Demonstration = own,
            tried: int = tried,
            pairs: np.ndarray = streams.pairs,
        ) -> dict[str, Any]:
            found, took = _timed(patrol, learner, own)
            success = success_rates(patrol, found.policies, tried) if tried else np.zeros(0)
            return {
                "name": name,
                "level": level,
                "forgetting": forgetting,
                "seconds": took,
                "final": float(found.accuracy[:, -LAST:].mean()),
                "trials": tried,
                "success mean": float(success.mean()) if tried else None,
                "pairs": pairs.tolist(),
                "accuracy": found.accuracy.round(5).tolist(),
                "success": success.tolist(),
                "noise": found.noise.round(5).tolist(),
            }

        file.measure("noise", f"{name}, {level:g}, memory {forgetting:g}", action)


def view_study(file: _File, *, replications: int, sessions: int, iterations: int) -> None:
    """Run GAIL and LME-I2RL at three degrees of observability."""
    patrol = instance(2)
    mdp = patrol.mdp
    options: dict[str, Any] = {"iterations": iterations, "updates": 5, "horizon": 8, **GAIL_OPTIONS}
    for view in VIEWS:
        seen = view_streams(patrol, view, replications, sessions)
        visibility = patrol.visibility(view)
        learners = [
            (LME, 1.0, lme_i2rl(mdp, visibility)),
            (GAIL, 0.0, gail_tabular(mdp, forgetting=0.0, **options)),
            (GAIL, 1.0, gail_tabular(mdp, forgetting=1.0, **options)),
            (ROBUST_GAIL, 1.0, robust_gail_tabular(mdp, visibility, forgetting=1.0, **options)),
        ]
        for name, forgetting, learner in learners:

            def action(
                name: str = name,
                forgetting: float = forgetting,
                view: int = view,
                learner: Learner = learner,
                seen: Demonstration = seen,
            ) -> dict[str, Any]:
                found, took = _timed(patrol, learner, seen)
                return {
                    "name": name,
                    "view": view,
                    "forgetting": forgetting,
                    "seconds": took,
                    "final": float(found.accuracy[:, -1].mean()),
                    "accuracy": found.accuracy.round(5).tolist(),
                }

            file.measure("view", f"{name}, {view} %, memory {forgetting:g}", action)


def _print(results: Mapping[str, Any]) -> None:
    rows: list[tuple[Any, ...]] = []
    for key, r in results.get("noise", {}).items():
        if "accuracy" not in r:
            continue
        final, half = interval(np.array(r["accuracy"])[:, -LAST:].mean(1))
        breach: tuple[str, str] = ("-", "-")
        if r["success"]:
            mean, spread = interval(np.array(r["success"]))
            breach = (f"{mean:.3f}", f"{spread:.3f}")
        rows.append((key, len(r["accuracy"]), float(final), float(half), *breach))
    print_table(
        "Noisy observations: LBA, mean of the last 15 sessions; breaches that succeed",
        ("method, noise", "replications", "LBA", "+-", "success", "+-"),
        rows,
    )
    rows = []
    for key, r in results.get("view", {}).items():
        mean, half = interval(np.array(r["accuracy"])[:, -1])
        rows.append((key, len(r["accuracy"]), float(mean), float(half)))
    print_table("Hidden steps: LBA after the last session", ("method, view", "streams", "LBA", "+-"), rows)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", choices=("noise", "view", "all"), default="all")
    parser.add_argument("--replications", type=int, default=20)
    parser.add_argument(
        "--few", type=int, default=8, help="replications of other levels, and of slow variants"
    )
    parser.add_argument("--sessions", type=int, default=35)
    parser.add_argument("--view-sessions", type=int, default=100)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--levels", type=float, nargs="+", default=LEVELS)
    parser.add_argument("--out", type=Path, default=DEFAULT_FOLDER / "adversarial_patrol.json")
    given = parser.parse_args()
    file = _File(given.out)
    if given.part != "view":
        noise_study(
            file,
            replications=given.replications,
            few=given.few,
            sessions=given.sessions,
            trials=given.trials,
            levels=given.levels,
            iterations=given.iterations,
        )
    if given.part != "noise":
        view_study(
            file,
            replications=max(given.replications // 4, 1),
            sessions=given.view_sessions,
            iterations=given.iterations,
        )
    _print(file.results)
    for path in write_figures(file.results, given.out.parent):
        print(f"Written to {path}")


if __name__ == "__main__":
    main()
