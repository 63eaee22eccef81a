"""Stopping rules on 200 streams of the second patrol instance: false stops, and sessions saved.

30 % in view, consecutive fragments of five steps, a session each; the first patroller of each run, so that
streams are independent. All rules see the same infos. A false stop is defined in
:mod:`i2rl.analysis.bounds.stopping`: stopped although the learned behaviour was still worse, by more than 5
points of LBA, than the mean of the stream's last 24 sessions. Other margins (2 and 10 points) are measured to
see whether the verdict hinges on it.

Two controls. A window of ``w`` sessions cannot fire before session ``w``: ``fixed number`` stops every stream
after ``n`` sessions without data. And the single-step rules are the windows' own, of width two in effect.

The width of a window determines the result. For up to 10 sessions in a row no step is in view (the loop has
56 steps), the learner's quantities stand still for want of data, and a rule over fewer sessions takes that
for convergence.

Run as ``python -m i2rl.analysis.benchmarks.online.stopping``; ``--reuse`` judges the streams of the last
run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Float

from ....domains.patrol.process import Patrol, demonstrate, instance
from ....inference.learners.lme import lme_i2rl
from ....inference.sessions.fleets import run_streams
from ....models.process.planning import deterministic_policy, hard_plan, reward_of
from ...bounds.stopping import (
    Histories,
    Sweep,
    Verdict,
    learning_error_change,
    likelihood_change,
    moving_window,
    policy_window,
    stopping_plot,
    sweep_tolerance,
)
from ...drawing.style import save_themes
from ...judging.metrics import evaluate
from ..harness import DEFAULT_FOLDER, print_table, publish

PERCENT, STEPS, TAIL, MARGIN = 30, 5, 24, 0.05
# The same tolerances, in nats, for the single step and for the windows.
TOLERANCES = np.geomspace(1e-4, 1.0, 17)
WIDTHS = (5, 8, 10, 12, 14, 20, 40)
SHARES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5])


def learn(patrol: Patrol, replications: int, sessions: int, seed: int) -> dict[str, np.ndarray]:
    """Learn all streams: log-likelihoods and gradients ``[R, T]``, weights ``[R, T, K]``."""
    key, start = jax.random.key(seed), jax.random.key(seed + 1)
    rows = [demonstrate(k, patrol, PERCENT, sessions, STEPS)[0] for k in jax.random.split(key, replications)]
    streams = jax.tree.map(lambda *parts: np.stack(parts)[:, :, None], *rows)
    learner = lme_i2rl(patrol.mdp, patrol.visibility(PERCENT))
    _, reports = run_streams(learner, start, streams)
    names = ("log_likelihood", "gradient", "weights")
    return {name: np.asarray(getattr(reports, name)) for name in names}


def histories(patrol: Patrol, reports: dict[str, np.ndarray]) -> Histories:
    """Return the infos of all sessions, with each session's learned behaviour and its accuracy."""
    mdp, true = patrol.mdp, jnp.asarray(patrol.weights)
    weights = reports["weights"]
    shape = weights.shape[:2]

    def one(w: Float[jax.Array, " K"]) -> tuple:
        scores = evaluate(mdp, true, w)
        greedy = jnp.argmax(deterministic_policy(hard_plan(mdp, reward_of(mdp, w)).optimal), axis=1)
        return greedy, scores.error.absolute, scores.accuracy.overall

    mapped = jax.jit(lambda w: jax.lax.map(one, w))(jnp.asarray(weights).reshape(-1, weights.shape[-1]))
    greedy, error, accuracy = (np.asarray(x) for x in mapped)
    return Histories(
        reports["log_likelihood"],
        reports["gradient"],
        greedy.reshape(*shape, -1).astype(np.int8),
        error.reshape(shape),
        accuracy.reshape(shape),
    )


def sweeps(h: Histories, margin: float) -> dict[str, Sweep]:
    """Apply every rule over its tolerances."""
    replications, sessions = h.accuracy.shape
    scale = float(h.error.max())

    def swept(name: str, unit: str, rule: Callable[[float], np.ndarray], rho: np.ndarray) -> Sweep:
        return sweep_tolerance(name, unit, rule, rho, h.accuracy, margin, TAIL)

    rows = [
        swept(
            "criterion 1: single step of likelihood",
            "nats",
            partial(likelihood_change, h.log_likelihood),
            TOLERANCES,
        ),
        swept(
            "criterion 2: single step of learning error",
            "value",
            partial(learning_error_change, h.error),
            TOLERANCES * scale,
        ),
        swept("single step of gradient", "nats", partial(likelihood_change, h.gradient), TOLERANCES),
        swept(
            "fixed number of sessions",
            "sessions",
            lambda n: np.full(replications, int(n)),
            np.unique(np.geomspace(1, sessions, 60).round()),
        ),
    ]
    for width in WIDTHS:
        rows += [
            swept(
                f"likelihood, window of {width}",
                "nats",
                partial(moving_window, h.log_likelihood, width),
                TOLERANCES,
            ),
            swept(
                f"gradient, window of {width}", "nats", partial(moving_window, h.gradient, width), TOLERANCES
            ),
            swept(
                f"policy, window of {width}",
                "share of states",
                partial(policy_window, h.greedy, width),
                SHARES,
            ),
        ]
    return {one.name: one for one in rows}


def _told(v: Verdict) -> dict[str, Any]:
    low, high = v.interval()
    return {
        "false stops": v.false_stops,
        "false rate": v.false_rate,
        "interval": [low, high],
        "stops": v.stops,
        "mean sessions": float(v.used.mean()),
        "median sessions": float(np.median(v.used)),
        "saved": v.saved,
        "accuracy given away": v.loss,
    }


def _ratios(single: Sweep, window: Sweep) -> dict[str, float]:
    """Divide false stops of the single step by those of the window, at each tolerance; at least 1 counted."""
    pairs = zip(window.rho, single.verdicts, window.verdicts, strict=True)
    return {f"{rho:.2g}": a.false_stops / max(b.false_stops, 1) for rho, a, b in pairs}


DRAWN = (
    "criterion 1: single step of likelihood",
    "criterion 2: single step of learning error",
    "likelihood, window of 10",
    "likelihood, window of 20",
    "gradient, window of 10",
    "policy, window of 10",
)


def _tell(every: dict[str, Sweep], sessions: int, replications: int) -> None:
    """Print the rules at three tolerances, and false stops of single step and windows at all of them."""
    columns = ("rule", "rho", "false stops", "stops", "mean sessions", "median", "saved")
    rows = []
    for name, one in every.items():
        picked = range(0, len(one.rho), 4) if one.unit == "nats" else range(0, len(one.rho), 6)
        for i in picked:
            v, rho = one.verdicts[i], f"{one.rho[i]:.2g} {one.unit}"
            used = (float(v.used.mean()), float(np.median(v.used)), f"{v.saved:.0%}")
            rows.append((name, rho, v.false_stops, v.stops, *used))
    title = (
        f"{replications} streams of {sessions} sessions; "
        f"a false stop is {100 * MARGIN:g} points of LBA too early"
    )
    print_table(title, columns, rows)
    names = ["criterion 1: single step of likelihood", *(f"likelihood, window of {w}" for w in WIDTHS)]
    print_table(
        "False stops at one and the same tolerance",
        ("rho (nats)", "single step", *(f"window of {w}" for w in WIDTHS)),
        [
            (f"{rho:.2g}", *(every[name].verdicts[i].false_stops for name in names))
            for i, rho in enumerate(TOLERANCES)
        ],
    )


def _draw(every: dict[str, Sweep], sessions: int, replications: int, folder: Path) -> None:
    note = (
        "a point a tolerance; bands: 95 % Wilson intervals; false: more than "
        f"{100 * MARGIN:g} points of LBA below what the stream settles at"
    )
    save_themes(
        lambda theme: stopping_plot(
            [every[name] for name in DRAWN],
            control=every["fixed number of sessions"],
            theme=theme,
            title=f"Stopping rules on {replications} streams of {sessions} sessions",
            note=note,
        ),
        folder,
        "stopping",
    )


def main(
    replications: Annotated[int, typer.Option(help="Streams.")] = 200,
    sessions: Annotated[int, typer.Option(help="Sessions per stream.")] = 240,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    reuse: Annotated[bool, typer.Option(help="Judge the streams of the last run again.")] = False,
    path: Annotated[Path, typer.Option(help="Where the JSON goes.")] = DEFAULT_FOLDER / "stopping.json",
) -> None:
    """Learn from the streams, apply every rule at every tolerance, print, draw and write."""
    began = time.perf_counter()
    patrol, kept = instance(2), path.with_suffix(".npz")
    if reuse:
        with np.load(kept) as arrays:
            reports = dict(arrays)
        replications, sessions = reports["log_likelihood"].shape
    else:
        reports = learn(patrol, replications, sessions, seed)
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(kept, **reports)  # type: ignore[arg-type]
    h = histories(patrol, reports)
    settled = h.accuracy[:, -TAIL:].mean(1)
    results: dict[str, Any] = {
        "replications": replications,
        "sessions": sessions,
        "seed": seed,
        "tail": TAIL,
        "settled accuracy": [float(x) for x in np.quantile(settled, [0, 0.5, 1])],
    }
    for margin in (0.02, MARGIN, 0.1):
        every = sweeps(h, margin)
        single = every["criterion 1: single step of likelihood"]
        late = np.where(settled[:, None] - h.accuracy > margin, np.arange(1, sessions + 1), 0).max(1)
        results[f"margin {margin:g}"] = {
            "last session that is still worse": [float(x) for x in np.quantile(late, [0.5, 0.95, 1])],
            "rules": {
                name: {f"{rho:.3g}": _told(v) for rho, v in zip(one.rho, one.verdicts, strict=True)}
                for name, one in every.items()
            },
            "single step against window, false stops": {
                f"width {w}": _ratios(single, every[f"likelihood, window of {w}"]) for w in WIDTHS
            },
        }
        if margin == MARGIN:
            _tell(every, sessions, replications)
            _draw(every, sessions, replications, path.parent)
    results["seconds"] = time.perf_counter() - began
    publish(path.stem, results, path)


if __name__ == "__main__":
    typer.run(main)
