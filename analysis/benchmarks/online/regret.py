"""Average regret over hundreds of sessions, with constant thresholds and with ``c / i`` (Theorem 5, Eq. 4.3).

Four settings on the second patrol instance. In all but the last the expert obeys the soft policy of the
true weights, which lie in [0, 1]^K:

``theorem``
    The theorem's: full view, independent trajectories from the initial distribution, the ``features``
    program. A trajectory has 512 steps, so that 0.6 % (``gamma^512``) of its discounted features lie in the
    tail that the learner fills in.
``fragments``
    The same with 5 steps a trajectory: 95 % of the features are the learner's own guess.
``everyday``
    30 % in view, 5 steps a trajectory, the default statistic. Trajectories are independent here too: this
    expert strolls, and half of its long walks stay out of view for hundreds of steps, without evidence.
``greedy``
    The same view of patrollers who never err, and who meet; consecutive fragments of one walk. No weights
    have their policy as a soft policy, so the risk is never 0.

``c`` was not tuned. It is 1 in the units of the discounted features, whose range is 100: a first threshold
``epsilon_1`` of 1 % of the range, and ten times less and more to see whether the slope depends on it. With
the default statistic it is 0.1 nats, which meets the default constant (0.002) in session 50; again with ten
times less and more.

Run as ``python -m i2rl.analysis.benchmarks.online.regret``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Array, Float

from ....domains.patrol.process import Patrol, demonstrate, instance
from ....inference.learners.lme import DEFAULT_SLACK, lme_i2rl, me_i2rl
from ....inference.sessions.learner import Learner
from ....inference.sessions.schedule import Harmonic, Schedule
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import AnySensor, Sensor, observe
from ....models.process.planning import occupancy, reward_of, simulate, soft_plan
from ...bounds.regret import (
    BoundCurve,
    Gaps,
    RegretCurve,
    expected_visits,
    last_confident_session,
    log_log_slope,
    regret_gaps,
    regret_plot,
    sure_bound,
)
from ...bounds.theorems import no_regret
from ...drawing.style import save_themes
from ..harness import DEFAULT_FOLDER, print_table, publish

LONG, SHORT, PERCENT = 512, 5, 30


class Threshold(NamedTuple):
    """A slack, its name, and the program's own slack ``beta [T]``."""

    name: str
    slack: Schedule
    beta: Float[np.ndarray, " T"]


class Setting(NamedTuple):
    """Observed task, its learner, and its thresholds."""

    title: str
    demonstrations: Demonstration
    policy: Float[Array, "S A"]
    visits: Float[Array, "S A"]
    learner: Callable[[Schedule], Learner]
    thresholds: tuple[Threshold, ...]
    convex: bool


def streams(codes: np.ndarray) -> Demonstration:
    """Make streams ``[R, T, n, L]`` from their codes ``[R, T, n, L, 3]``."""
    return Demonstration.from_codes(codes)


def _walks(
    key: Array, patrol: Patrol, log_policy: Array, sensor: AnySensor, shape: tuple[int, int]
) -> np.ndarray:
    """Simulate ``shape[0]`` trajectories of ``shape[1]`` steps as codes."""

    @jax.jit
    def one(key: Array) -> Array:
        act, look = jax.random.split(key)
        return observe(look, sensor, *simulate(act, patrol.mdp, log_policy, shape[1]))

    return np.asarray(jax.lax.map(one, jax.random.split(key, shape[0]), batch_size=256))


def _thresholds(constant: float, beta: float, scales: tuple[float, ...], sessions: int) -> list[Threshold]:
    i = np.arange(1, sessions + 1)
    rows = [Threshold(f"constant {beta:g}", constant, np.full(sessions, beta))]
    return rows + [Threshold(f"c / i, c = {c:g}", Harmonic(c), c / i) for c in scales]


def settings(
    patrol: Patrol, key: Array, replications: int, sessions: int
) -> dict[str, Callable[[], Setting]]:
    """Return the four settings by name; each is simulated when called."""
    mdp, view = patrol.mdp, patrol.visibility(PERCENT)
    plan = soft_plan(mdp, reward_of(mdp, jnp.asarray(patrol.weights)))
    expert = jnp.asarray(patrol.expert_policy())
    in_view = jnp.asarray(patrol.views[PERCENT], float)[:, None]
    # A number is epsilon, which the features program divides by 1 - gamma; the schedule states beta.
    features = _thresholds(1.0 * (1 - float(mdp.discount)), 1.0, (0.1, 1.0, 10.0), sessions)
    seen = _thresholds(DEFAULT_SLACK, DEFAULT_SLACK, (0.01, 0.1, 1.0), sessions)

    def whole(steps: int) -> Setting:
        codes = _walks(key, patrol, plan.log_policy, Sensor(), (replications * sessions, steps))
        return Setting(
            f"full view, {steps} steps, features statistic",
            streams(codes.reshape(replications, sessions, 1, -1, 3)),
            plan.policy,
            occupancy(mdp, plan.policy),
            lambda slack: me_i2rl(mdp, statistic="features", slack=slack),
            tuple(features),
            steps == LONG,
        )

    def everyday() -> Setting:
        codes = _walks(key, patrol, plan.log_policy, view, (replications * sessions, SHORT))
        return Setting(
            f"{PERCENT} % in view, {SHORT} steps, default statistic",
            streams(codes.reshape(replications, sessions, 1, SHORT, 3)),
            plan.policy,
            in_view * expected_visits(mdp, plan.policy, SHORT),
            lambda slack: lme_i2rl(mdp, view, slack=slack),
            tuple(seen),
            False,
        )

    def greedy() -> Setting:
        rows = [
            demonstrate(k, patrol, PERCENT, sessions, SHORT)[0] for k in jax.random.split(key, replications)
        ]
        codes = np.stack([row.codes for row in rows])[:, :, None]
        return Setting(
            f"{PERCENT} % in view, patrollers who never err, default statistic",
            streams(codes),
            expert,
            in_view * expected_visits(mdp, expert, SHORT, sessions),
            lambda slack: lme_i2rl(mdp, view, slack=slack),
            tuple(seen),
            False,
        )

    return {
        "theorem": lambda: whole(LONG),
        "fragments": lambda: whole(SHORT),
        "everyday": everyday,
        "greedy": greedy,
    }


def measure(patrol: Patrol, setting: Setting, key: Array) -> dict[str, Gaps]:
    """Measure every threshold on the same streams."""
    return {
        t.name: regret_gaps(
            setting.learner(t.slack),
            key,
            setting.demonstrations,
            jnp.asarray(patrol.weights),
            setting.policy,
            setting.visits,
        )
        for t in setting.thresholds
    }


def _row(gaps: Gaps, burn_in: int) -> dict[str, Any]:
    regret, sessions = gaps.regret, gaps.regret.shape[1]
    marks = sorted({burn_in, min(100, sessions), sessions})
    each = [log_log_slope(r, burn_in).slope for r in regret]
    mean = regret.mean(0)
    return {
        "slope of the mean": log_log_slope(mean, burn_in).slope,
        "slopes of the replications": [min(each), float(np.median(each)), max(each)],
        "slope of the last three quarters": log_log_slope(mean, sessions // 4).slope,
        "average regret": {str(t): float(mean[t - 1]) for t in marks},
        "last excess risk": float(gaps.expected[:, -1].mean()),
        "empirical average regret": float(gaps.empirical_regret[:, -1].mean()),
        "largest empirical average regret": float(gaps.empirical_regret[:, -1].max()),
        "sessions in which the average regret rose": float(
            np.mean(np.diff(mean[burn_in - 1 :]) > 0) if sessions > burn_in else np.nan
        ),
    }


def _draw(path: Path, setting: Setting, measured: dict[str, Gaps], patrol: Patrol, burn_in: int) -> None:
    curves = [RegretCurve(n, g.regret, g.empirical_regret) for n, g in measured.items()]
    theorem, sure = None, {}
    if setting.convex:
        main, mdp = setting.thresholds[2], patrol.mdp
        sizes = [1] * len(main.beta)
        average = no_regret(float(main.beta[0]), sizes, mdp.n_features, float(mdp.discount)).average
        theorem = BoundCurve("Theorem 5 for c = 1: 2Kc H(T) / T", average)
        sure = {main.name: sure_bound(main.beta, patrol.weights)}
    save_themes(
        lambda theme: regret_plot(
            curves,
            theorem=theorem,
            sure=sure,
            burn_in=burn_in,
            theme=theme,
            title=f"Average regret: {setting.title}",
        ),
        path.parent,
        path.name,
    )


def main(
    replications: Annotated[int, typer.Option(help="Streams per threshold.")] = 4,
    sessions: Annotated[int, typer.Option(help="Sessions per stream.")] = 500,
    burn_in: Annotated[int, typer.Option(help="First session of the slope.")] = 10,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    only: Annotated[str, typer.Option(help="One setting by name; all by default.")] = "",
    path: Annotated[Path, typer.Option(help="Where the JSON goes.")] = DEFAULT_FOLDER / "regret.json",
) -> None:
    """Measure, print, draw and write the average regret of every setting and threshold."""
    patrol = instance(2)
    key = jax.random.key(seed)
    k, discount = patrol.mdp.n_features, float(patrol.mdp.discount)
    results: dict[str, Any] = {
        "replications": replications,
        "sessions": sessions,
        "burn in": burn_in,
        "seed": seed,
        "last session with a positive confidence of Theorem 5, one trajectory a session": {
            f"c = {c:g}": last_confident_session(c, 1, k, discount) for c in (0.1, 1.0, 10.0, 100.0)
        },
    }
    for name, simulated in settings(patrol, key, replications, sessions).items():
        if only not in ("", name):
            continue
        began, setting = time.perf_counter(), simulated()
        measured = measure(patrol, setting, jax.random.fold_in(key, 1))
        rows = {threshold: _row(gaps, burn_in) for threshold, gaps in measured.items()}
        if setting.convex:
            for t in setting.thresholds:
                worst = measured[t.name].empirical_regret - sure_bound(t.beta, patrol.weights)
                rows[t.name]["largest excess over the sure bound"] = float(worst.max())
        results[name] = {"setting": setting.title, "seconds": time.perf_counter() - began, "rows": rows}
        _draw(path.parent / f"regret-{name}", setting, measured, patrol, burn_in)
        print_table(
            f"{name}: {setting.title}; {replications} streams of {sessions} sessions",
            (
                "threshold",
                "slope",
                "slopes of replications",
                "late slope",
                "regret",
                "last risk",
                "empirical",
            ),
            [
                (
                    threshold,
                    row["slope of the mean"],
                    " ".join(f"{x:.2f}" for x in row["slopes of the replications"]),
                    row["slope of the last three quarters"],
                    " ".join(f"{x:.3g}" for x in row["average regret"].values()),
                    row["last excess risk"],
                    row["empirical average regret"],
                )
                for threshold, row in rows.items()
            ],
        )
        publish(path.stem, results, path)


if __name__ == "__main__":
    typer.run(main)
