"""Time that each learner takes on one problem: its first call, and a later one.

``python -m i2rl.analysis.benchmarks.cost.learners`` learns from 60 sessions of five steps of a patroller
(instance 2: 124 states, 4 actions, 6 features) and prints a table. Online learners are given session by
session, all others everything at once. *First* is the first call, compilation and tracing included, without
programs of earlier processes; *later* is the median session, or one more call.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ....compilation import compile_quickly
from ....domains.patrol.process import demonstrate, instance
from ....inference.adversarial.tabular.learners import airl_tabular, robust_airl_tabular
from ....inference.learners.darko import darko_i2rl
from ....inference.learners.dpm import dpm_birl
from ....inference.learners.jin import jin_i2rl
from ....inference.learners.lme import batch_lme, lme_i2rl, me_i2rl
from ....inference.learners.maximum_likelihood import em_mlirl, mlirl
from ....inference.learners.mtirl import batch_mme_mtirl, mme_mtirl
from ....inference.learners.noisy import rimeo, robust_irl
from ....inference.posteriors.gibbs import gibbs_mixture_posterior
from ....inference.posteriors.mixture import sample_mixture_posterior
from ....inference.posteriors.noisy import sample_noisy_posterior
from ....inference.posteriors.policy_walk import birl
from ....inference.posteriors.weights import sample_posterior
from ....inference.programs.maximum_entropy import fit_counts
from ....inference.sessions.learner import Learner
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import FeatureNoise
from ....models.process.mdp import TabularMDP
from ..harness import print_table, publish

SESSIONS, STEPS = 60, 5
Call = Callable[[jax.Array], Any]


def cases() -> Iterator[tuple[str, str, Callable[[], tuple[Learner, Demonstration]] | Call]]:
    """Yield name, kind and either a learner with its demonstration, or a call of everything at once."""
    patrol = instance(2)
    mdp, view = patrol.mdp, patrol.visibility(patrol.observability)
    hidden = demonstrate(jax.random.key(0), patrol, patrol.observability, SESSIONS, STEPS)[0]
    whole = demonstrate(jax.random.key(0), patrol, 100, SESSIONS, STEPS)[0]
    predicates = np.indices((mdp.n_states, mdp.n_actions))  # the state and the action of each pair
    noise = FeatureNoise(predicates, np.full(2, 0.95))
    exact = patrol.visibility(100)
    yield "me_i2rl", "session", lambda: (me_i2rl(mdp), whole)
    yield "lme_i2rl", "session", lambda: (lme_i2rl(mdp, view), hidden)
    yield "jin_i2rl", "session", lambda: (jin_i2rl(mdp), whole)
    yield "darko_i2rl", "session", lambda: (darko_i2rl(mdp), whole)
    yield "rimeo", "session", lambda: (rimeo(mdp, predicates, visibility=view, scores="none"), hidden)
    yield "mme_mtirl", "session", lambda: (mme_mtirl(mdp, view, n_components=4), hidden)
    yield "airl_tabular", "session", lambda: (airl_tabular(mdp, horizon=STEPS), whole)
    yield "robust_airl_tabular", "session", lambda: (robust_airl_tabular(mdp, view, horizon=STEPS), hidden)
    yield "fit_counts", "all", lambda key: fit_counts(mdp, jnp.asarray(visits(mdp, whole)))
    batches: tuple[tuple[str, Any, Demonstration], ...] = (
        ("batch_lme", batch_lme(mdp, view), hidden),
        ("robust_irl", robust_irl(mdp, noise * view), hidden),
        ("batch_mme_mtirl", batch_mme_mtirl(mdp, view, n_components=4), hidden),
        ("em_mlirl", em_mlirl(mdp, n_components=2), whole),
        ("dpm_birl", dpm_birl(mdp), whole),
    )
    for name, batch, demonstration in batches:
        yield name, "all", partial(lambda fit, given, key: fit(key, given), batch.fit, demonstration)
    yield "mlirl", "all", lambda key: mlirl(key, mdp, whole)
    yield "birl", "all", lambda key: birl(key, mdp, whole)
    yield "sample_posterior", "all", lambda key: sample_posterior(key, mdp, view, hidden)
    yield (
        "sample_noisy_posterior",
        "all",
        lambda key: sample_noisy_posterior(key, mdp, predicates, whole, visibility=exact),
    )
    yield (
        "sample_mixture_posterior",
        "all",
        lambda key: sample_mixture_posterior(key, mdp, view, hidden, components=2),
    )
    yield (
        "gibbs_mixture_posterior",
        "all",
        lambda key: gibbs_mixture_posterior(key, mdp, view, hidden),
    )


def visits(mdp: TabularMDP, demonstration: Demonstration) -> np.ndarray:
    """Count the pairs of a demonstration in full view."""
    counts = np.zeros((mdp.n_states, mdp.n_actions))
    np.add.at(counts, (demonstration.state, demonstration.action), 1)
    return counts


def measured(kind: str, made: Callable[..., Any]) -> tuple[float, float]:
    """Return the seconds of the first call, and the median of later ones."""
    jax.clear_caches()
    seconds, began = [], time.perf_counter()

    def stop() -> None:
        nonlocal began
        ended = time.perf_counter()
        seconds.append(ended - began)
        began = ended

    if kind == "all":
        for key in jax.random.split(jax.random.key(1)):
            jax.block_until_ready(made(key))
            stop()
    else:
        learner, demonstration = made()
        state = learner.init(jax.random.key(1))
        for session in demonstration.sessions():
            state, _ = learner.update(state, session)
            stop()
    return seconds[0], float(np.median(seconds[1:]))


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", help="names of learners, all by default")
    options = parser.parse_args()
    compile_quickly()
    jax.config.update("jax_enable_compilation_cache", False)
    rows: dict[str, tuple[float, float, str]] = {}
    for name, kind, made in cases():
        if not options.only or name in options.only:
            rows[name] = (*measured(kind, made), kind)
            print(f"{name}: {rows[name]}", file=sys.stderr)
    print_table(
        f"Seconds on {SESSIONS} sessions of {STEPS} steps, patrol 2",
        ["learner", "first", "later", "a call learns from"],
        [(name, first, later, kind) for name, (first, later, kind) in rows.items()],
    )
    publish("learners", {name: row[:2] for name, row in rows.items()})


if __name__ == "__main__":
    main()
