"""Simulation-based calibration of the posterior (Talts et al. 2018).

Weights drawn from the prior generate a demonstration, whose posterior is sampled. Over many replications the
truth's rank among the draws is uniform if and only if model, NUTS and backward sampling agree: for every
weight, for the log-likelihood, and for the expert's behaviour out of view.

Run as ``python -m i2rl.analysis.benchmarks.statistics.calibration``.
"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import typer
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from rich.console import Console
from rich.table import Table
from scipy import stats

from ....inference.posteriors.weights import Problem, complete, nuts_chain, pointwise_log_likelihood
from ....models.laws.occlusion import weights_prior
from ....models.observation.evidence import Visibility, observe
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, simulate, soft_plan


class Setting(NamedTuple):
    """A small world to calibrate in: ``trajectories`` of ``length`` steps, some states out of view."""

    mdp: TabularMDP
    sensor: Visibility
    prior: dist.Distribution
    trajectories: int
    length: int


class Ranks(NamedTuple):
    """Ranks of the truth among posterior draws.

    Fields
    ------
    names : quantities, in the order of the columns
    ranks : int ``[replications, quantities]``
        From 0 to ``draws``, ties broken at random.
    draws : int
    divergences : int
        Divergent transitions in all replications.
    """

    names: tuple[str, ...]
    ranks: Int[np.ndarray, "R Q"]
    draws: int
    divergences: int


class Uniformity(NamedTuple):
    """Chi-square test that ranks are uniform."""

    name: str
    statistic: float
    p_value: float


def small_world() -> Setting:
    """Build a ring of five states, both directions and a rest, two states out of view, three features."""
    n_states, slip = 5, 0.2
    state = np.arange(n_states)
    moves = np.stack([(state + 1) % n_states, (state - 1) % n_states, state], axis=1)
    transitions = np.zeros((n_states, 3, n_states))
    for a in range(3):
        transitions[state, a, moves[:, a]] += 1 - slip
        transitions[state, a, (moves[:, a] + 1) % n_states] += slip
    features = np.zeros((n_states, 3, 3))
    features[1, :, 0] = 1  # being in a state in view
    features[3, :, 1] = 1  # being in a state out of view
    features[:, 2, 2] = 1  # resting
    mdp = TabularMDP.from_dense(transitions, features, discount=0.9, feature_names=("seen", "unseen", "rest"))
    return Setting(mdp, Visibility(state < 3), weights_prior(3, dist.Normal(0.0, 1.5)), 4, 6)


def rank_statistics(
    key: Array,
    replications: int,
    setting: Setting | None = None,
    *,
    draws: int = 63,
    thin: int = 6,
    warmup: int = 200,
) -> Ranks:
    """Replicate prior draw, simulation and posterior; every replication in one compiled program.

    Each posterior gives ``draws``, every ``thin``-th of its chain so that they are close to independent.
    Quantities: every weight; the demonstration's log-likelihood; the steps that the expert spent in the last
    state (out of view in :func:`small_world`).
    """
    setting = small_world() if setting is None else setting
    ranks, diverging = _replicate(
        jax.random.split(key, replications),
        setting.mdp,
        setting.sensor,
        setting.prior,
        (setting.trajectories, setting.length, draws, thin, warmup),
    )
    names = (*setting.mdp.feature_names, "log-likelihood", "hidden visits")
    return Ranks(names, np.asarray(ranks), draws, int(np.sum(diverging)))


@partial(jax.jit, static_argnums=4)
def _replicate(
    keys: Array, mdp: TabularMDP, sensor: Visibility, prior: dist.Distribution, sizes: tuple[int, ...]
) -> tuple[Int[Array, "R Q"], Bool[Array, "R draws"]]:
    n, length, draws, thin, warmup = sizes

    def quantities(
        weights: Float[Array, " K"], log_likelihood: Float[Array, ""], states: Int[Array, "n L"]
    ) -> Float[Array, " Q"]:
        visits = jnp.sum(states == mdp.n_states - 1).astype(float)
        return jnp.concatenate([weights, jnp.stack([log_likelihood, visits])])

    def one(key: Array) -> tuple:
        draw_key, walk_key, look_key, chain_key, complete_key, tie_key = jax.random.split(key, 6)
        truth = prior.sample(draw_key)
        log_policy = soft_plan(mdp, reward_of(mdp, truth)).log_policy
        walk = jax.vmap(lambda k: simulate(k, mdp, log_policy, length))
        states, actions = walk(jax.random.split(walk_key, n))
        look = jax.vmap(lambda k, s, a: observe(k, sensor, s, a))
        codes = look(jax.random.split(look_key, n), states, actions)
        problem = Problem(mdp, sensor, codes, jnp.ones(n, int), prior)
        start = jnp.zeros(mdp.n_features)
        chain = nuts_chain(
            chain_key,
            problem,
            start,
            jnp.eye(len(start)),
            warmup=warmup,
            draws=draws * thin,
            target_accept=0.9,
        )
        weights = chain.weights[thin - 1 :: thin]
        completed = complete(jax.random.split(complete_key, draws), weights, problem, jnp.arange(n))
        total = jnp.sum(pointwise_log_likelihood(weights, problem), axis=1)
        drawn = jax.vmap(quantities)(weights, total, completed.states)
        true = quantities(truth, jnp.sum(pointwise_log_likelihood(truth[None], problem)), states)
        below, ties = jnp.sum(drawn < true, axis=0), jnp.sum(drawn == true, axis=0)
        return below + jax.random.randint(tie_key, ties.shape, 0, ties + 1), chain.diverging

    return lax.map(one, keys, batch_size=32)


def uniformity(ranks: Ranks, bins: int = 16) -> list[Uniformity]:
    """Test each quantity by chi-square; raises ``ValueError`` unless ``bins`` divides ``draws + 1``."""
    if (ranks.draws + 1) % bins:
        raise ValueError(f"{bins} bins cannot share {ranks.draws + 1} ranks evenly")
    tests = []
    for name, column in zip(ranks.names, ranks.ranks.T, strict=True):
        counts = np.bincount(column * bins // (ranks.draws + 1), minlength=bins)
        statistic, p_value = stats.chisquare(counts)
        tests.append(Uniformity(name, float(statistic), float(p_value)))
    return tests


def main(
    replications: Annotated[int, typer.Option(help="Simulated demonstrations.")] = 256,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    path: Annotated[Path, typer.Option(help="File of the JSON results.")] = Path(
        "build/bench/calibration.json"
    ),
) -> None:
    """Calibrate the posterior and report the uniformity of every quantity's ranks."""
    begin = time.perf_counter()
    ranks = rank_statistics(jax.random.key(seed), replications)
    tests = uniformity(ranks)
    report = {
        "replications": replications,
        "draws": ranks.draws,
        "seed": seed,
        "divergences": ranks.divergences,
        "seconds": time.perf_counter() - begin,
        "quantities": [test._asdict() for test in tests],
        "ranks": {name: column.tolist() for name, column in zip(ranks.names, ranks.ranks.T, strict=True)},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1))
    table = Table(
        "quantity",
        "chi-square",
        "p",
        title=f"Ranks of the truth: {replications} replications, {len(tests)} quantities",
    )
    for test in tests:
        table.add_row(test.name, f"{test.statistic:.1f}", f"{test.p_value:.3f}")
    Console(stderr=True).print(table)
    print(json.dumps({name: value for name, value in report.items() if name != "ranks"}))


if __name__ == "__main__":
    typer.run(main)
