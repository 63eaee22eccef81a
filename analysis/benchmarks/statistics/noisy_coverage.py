"""Coverage of intervals of the joint posterior over weights and reliabilities.

``python -m i2rl.analysis.benchmarks.statistics.noisy_coverage`` draws weights and reliabilities from the
model's own prior, observes a soft expert of those weights through :class:`FeatureNoise` of those
reliabilities, and samples the joint posterior by NUTS. Intervals of probability 0.9 then cover the truth in
90 % of the replications, and the truth's rank among the draws is uniform (Cook, Gelman and Rubin 2006; Talts
et al. 2018), if model, simulation and sampler agree. That holds on average over the prior, also if the data
do not separate sloppy experts from sloppy sensors: it is no statement about identification or about a single
truth.

Reliabilities come from the model's default, Beta(4, 1), perception being more often right than wrong. With
``--uniform`` ones a predicate observed wrongly, and weights of the other sign, explain almost as well: a
second mode, which chains seldom reach from the first.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import xarray as xr
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from rich.console import Console
from rich.progress import track
from scipy import stats

from ....domains.noisy.tasks import SORTING_PREDICATES, noisy_sorting
from ....inference.posteriors.noisy import NoisyProblem, noisy_chain, noisy_problem, noisy_starts
from ....models.laws.trajectory import TrajectoryLaw
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import FeatureNoise
from ....models.process.mdp import TabularMDP
from ..harness import print_table, publish
from .calibration import Ranks, uniformity

PROBABILITY = 0.9
MIXED = 1.05


class NoisySetting(NamedTuple):
    """Replicated setting: a task, its predicates and priors, ``trajectories`` of ``length`` steps."""

    name: str
    mdp: TabularMDP
    predicates: Bool[np.ndarray, "J S A"]
    predicate_names: tuple[str, ...]
    prior: dist.Distribution | None
    reliability_prior: dist.Distribution | None
    trajectories: int
    length: int

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the judged quantities: every weight, every reliability, and the log-likelihood."""
        weights = (f"weight of {name}" for name in self.mdp.feature_names)
        return (*weights, *(f"reliability of {name}" for name in self.predicate_names), "log-likelihood")


class Sampling(NamedTuple):
    """Settings of every posterior's sampler; it retains ``draws`` of each of ``chains``."""

    chains: int = 2
    warmup: int = 300
    draws: int = 300


class Run(NamedTuple):
    """One replication: the truth beside the draws.

    Fields
    ------
    truth : float ``[Q]``
    draws : float ``[chains, draws, Q]``
    log_density : float ``[chains * draws]``
        Of weights, reliabilities and data together, at every draw.
    true_log_density : float
    divergences : int
    """

    truth: Float[np.ndarray, " Q"]
    draws: Float[np.ndarray, "chains draws Q"]
    log_density: Float[np.ndarray, " draws"]
    true_log_density: float
    divergences: int


class CoverageStudy(NamedTuple):
    """Results of all replications.

    Fields
    ------
    quantities : tuple of str ``[Q]``
    covered : bool ``[R, Q]``
        Coverage by the central interval of probability 0.9.
    jointly_covered : bool ``[R]``
        Coverage by the region of highest joint density of that probability.
    ranks : int ``[R, Q]``
        Rank of the truth among ``kept`` draws, equally far apart.
    kept : int
    r_hat, ess : float ``[R, Q]``
        Rank-normalised R-hat and bulk effective sample size.
    divergences : int ``[R]``
    """

    quantities: tuple[str, ...]
    covered: Bool[np.ndarray, "R Q"]
    jointly_covered: Bool[np.ndarray, " R"]
    ranks: Int[np.ndarray, "R Q"]
    kept: int
    r_hat: Float[np.ndarray, "R Q"]
    ess: Float[np.ndarray, "R Q"]
    divergences: Int[np.ndarray, " R"]


# -- settings -----------------------------------------------------------------------------------------


def corridor(reliability_prior: dist.Distribution | None = None) -> NoisySetting:
    """Build a corridor of four cells, two headings and three actions: go on, turn round, wait; one in ten
    fails.

    Ten trajectories of five steps; three weights, ``Normal(0, 1.5)``, and three predicates.
    """
    cells, slip = 4, 0.1
    cell, heading = (x.ravel() for x in np.meshgrid(np.arange(cells), (0, 1), indexing="ij"))
    state = np.arange(2 * cells)
    ahead = np.clip(cell + np.where(heading, 1, -1), 0, cells - 1) * 2 + heading
    transitions = np.zeros((len(state), 3, len(state)))
    for action, following in enumerate((ahead, state ^ 1, state)):
        transitions[state, action, following] += 1 - slip
        transitions[state, action, state] += slip
    features = np.zeros((len(state), 3, 3))
    features[ahead != state, 0, 0] = 1
    features[cell == cells - 1, :, 1] = 1
    features[:, 2, 2] = 1
    predicates = np.zeros((3, len(state), 3), bool)
    predicates[0, :, 0] = True
    predicates[1, :, 1] = True
    predicates[2, cell < cells // 2] = True
    mdp = TabularMDP.from_dense(
        transitions, features, discount=0.9, feature_names=("moving", "the far end", "waiting")
    )
    return NoisySetting(
        "corridor",
        mdp,
        predicates,
        ("going on", "turning", "the near half"),
        dist.Normal(0.0, 1.5),
        reliability_prior,
        10,
        5,
    )


def sorting(reliability_prior: dist.Distribution | None = None) -> NoisySetting:
    """Make noisy sorting, six sessions of two trajectories of three steps that start anywhere.

    Two pairs of its eight predicates are one function, and some features never occur: only priors determine
    their parameters.
    """
    task = noisy_sorting()
    return NoisySetting(
        task.name, task.starting("all"), task.predicates, SORTING_PREDICATES, None, reliability_prior, 12, 3
    )


# -- replications -------------------------------------------------------------------------------------


def replicate(
    key: Array, setting: NoisySetting, replications: int, sampling: Sampling | None = None
) -> Iterator[Run]:
    """Draw truths from the prior, simulate, and sample each posterior; a key determines the replications.

    Chains start as those of ``sample_noisy_posterior``. All replications share one compiled sampler and keep
    every processor busy. Raises ``ValueError`` for fewer than one run.
    """
    if replications < 1:
        raise ValueError(f"replications must be at least 1, got {replications}")
    sampling = Sampling() if sampling is None else sampling
    template = _template(setting)
    one = partial(_replication, template=template, setting=setting, sampling=sampling)
    first, *others = jax.random.split(key, replications)
    # Alone, so that threads do not compile the same programs side by side.
    yield one(first)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        yield from pool.map(one, others)


def _template(setting: NoisySetting) -> NoisyProblem:
    """Compile the problem that all replications share: the setting's priors, a row for each trajectory."""
    # Every observation is possible for every truth, so one suffices for the checks.
    report = Demonstration.from_pairs(np.zeros((1, 1), int), np.zeros((1, 1), int))
    problem, _ = noisy_problem(
        setting.mdp,
        setting.predicates,
        report,
        prior=setting.prior,
        reliability_prior=setting.reliability_prior,
    )
    n, length = setting.trajectories, setting.length
    return problem._replace(codes=jnp.zeros((n, length, 3), jnp.int32), repeats=jnp.ones(n, int))


def _replication(key: Array, template: NoisyProblem, setting: NoisySetting, sampling: Sampling) -> Run:
    truth_key, look_key, start_key, chain_key = jax.random.split(key, 4)
    of_weights, of_reliabilities = jax.random.split(truth_key)
    weights = template.prior.sample(of_weights)
    reliabilities = template.reliability_prior.sample(of_reliabilities)
    codes = _simulated(look_key, template, weights, reliabilities)
    problem = template._replace(codes=codes)
    starts = noisy_starts(start_key, problem, sampling.chains)
    chains = [
        _sampled(k, problem, *start, warmup=sampling.warmup, draws=sampling.draws)
        for k, start in zip(jax.random.split(chain_key, sampling.chains), starts, strict=True)
    ]
    drawn = np.array([c.weights for c in chains]), np.array([c.reliabilities for c in chains])
    # The truth before all draws.
    points = (
        jnp.concatenate([true[None], x.reshape(-1, len(true))])
        for true, x in zip((weights, reliabilities), drawn, strict=True)
    )
    log_likelihood, log_density = (np.asarray(x) for x in _densities(*points, problem))
    return Run(
        np.concatenate([weights, reliabilities, log_likelihood[:1]]),
        np.concatenate([*drawn, log_likelihood[1:].reshape(sampling.chains, -1, 1)], axis=-1),
        log_density[1:],
        float(log_density[0]),
        int(sum(np.sum(c.transitions.diverging) for c in chains)),
    )


@jax.jit
def _simulated(
    key: Array, problem: NoisyProblem, weights: Float[Array, " K"], reliabilities: Float[Array, " J"]
) -> Int[Array, "n L 3"]:
    n, length, _ = problem.codes.shape
    sensor = FeatureNoise(problem.predicates, reliabilities, problem.reportable)
    codes: Int[Array, "n L 3"] = TrajectoryLaw(problem.mdp, weights, sensor, length).sample(key, (n,))
    return codes


_sampled = jax.jit(noisy_chain, static_argnames=("warmup", "draws"))


@jax.jit
def _densities(
    weights: Float[Array, "D K"], reliabilities: Float[Array, "D J"], problem: NoisyProblem
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Compute the log-likelihood, and the log-density of parameters and data together, at every point."""

    def one(draw: tuple) -> tuple:
        sensor = FeatureNoise(problem.predicates, draw[1], problem.reportable)
        law = TrajectoryLaw(problem.mdp, draw[0], sensor, problem.codes.shape[1])
        log_likelihood = jnp.sum(law.log_prob(problem.codes))
        log_prior = problem.prior.log_prob(draw[0]) + problem.reliability_prior.log_prob(draw[1])
        return log_likelihood, log_likelihood + log_prior

    return lax.map(one, (weights, reliabilities))


# -- judging ------------------------------------------------------------------------------------------


def covers(
    draws: Float[np.ndarray, "D Q"], truth: Float[np.ndarray, " Q"], probability: float = PROBABILITY
) -> Bool[np.ndarray, " Q"]:
    """Test whether each truth lies in the central interval of its draws.

    Raises ``ValueError`` for a probability outside (0, 1).
    """
    if not 0 < probability < 1:
        raise ValueError(f"an interval has a probability between 0 and 1, got {probability}")
    tail = (1 - probability) / 2
    lower, upper = np.quantile(draws, (tail, 1 - tail), axis=0)
    return (lower <= truth) & (truth <= upper)


def rank_among(
    draws: Float[np.ndarray, "D Q"], truth: Float[np.ndarray, " Q"], kept: int
) -> Int[np.ndarray, " Q"]:
    """Rank each truth, from 0 to ``kept``, among as many draws equally far apart.

    Raises ``ValueError`` for more draws than there are.
    """
    if not 1 <= kept <= len(draws):
        raise ValueError(f"{len(draws)} draws cannot be thinned to {kept}")
    thinned = draws[(np.arange(1, kept + 1) * len(draws)) // kept - 1]
    ranks: Int[np.ndarray, " Q"] = (thinned < truth).sum(0)
    return ranks


def judge(quantities: tuple[str, ...], replications: Iterable[Run], kept: int = 31) -> CoverageStudy:
    """Judge the coverage, ranks and diagnostics of every replication.

    Raises ``ValueError`` without replications, and as its parts do.
    """
    rows = []
    for run in replications:
        draws = run.draws.reshape(-1, run.draws.shape[-1])
        data = xr.DataArray(run.draws, dims=("chain", "draw", "quantity")).to_dataset(name="x")
        rows.append(
            (
                covers(draws, run.truth),
                run.true_log_density >= np.quantile(run.log_density, 1 - PROBABILITY),
                rank_among(draws, run.truth, kept),
                az.rhat(data).x.values,
                az.ess(data).x.values,
                run.divergences,
            )
        )
    if not rows:
        raise ValueError("coverage is judged over at least one replication")
    covered, jointly, ranks, r_hat, ess, divergences = (np.array(x) for x in zip(*rows, strict=True))
    return CoverageStudy(quantities, covered, jointly, ranks, kept, r_hat, ess, divergences)


def coverage_interval(covered: Bool[np.ndarray, " R"]) -> tuple[float, float]:
    """Compute Clopper and Pearson's 95 % interval for the probability behind a share of replications."""
    interval = stats.binomtest(int(covered.sum()), len(covered)).proportion_ci(0.95, "exact")
    return float(interval.low), float(interval.high)


def report(study: CoverageStudy, bins: int = 16) -> dict[str, Any]:
    """Return the study's results as numbers for JSON.

    ``overall``: the share of all intervals, over replications and quantities, that cover; its error is that
    of a mean over replications, as quantities of one run go together. ``ranks p``: chi-square test over
    ``bins``. Chains of a run have ``mixed`` if every R-hat is below ``MIXED``.
    """
    replications = len(study.covered)
    tests = uniformity(Ranks(study.quantities, study.ranks, study.kept, int(study.divergences.sum())), bins)
    columns = [*zip(study.quantities, study.covered.T, strict=True), ("all jointly", study.jointly_covered)]
    ps = [*(test.p_value for test in tests), None]
    quantities = []
    for (name, covered), p in zip(columns, ps, strict=True):
        low, high = coverage_interval(covered)
        quantities.append(
            {"quantity": name, "covered": float(covered.mean()), "from": low, "to": high, "ranks p": p}
        )
    per_run, mixed = study.covered.mean(1), (study.r_hat < MIXED).all(1)
    return {
        "replications": replications,
        "quantities": quantities,
        "overall": float(per_run.mean()),
        "overall_error": float(per_run.std(ddof=1) / np.sqrt(replications)) if replications > 1 else None,
        "smallest_p": min(test.p_value for test in tests),
        "largest_r_hat": float(study.r_hat.max()),
        "runs_mixed": int(mixed.sum()),
        "overall_where_mixed": float(per_run[mixed].mean()) if mixed.any() else None,
        "smallest_ess": float(study.ess.min()),
        "runs_with_fewer_ess_than_ranks": int((study.ess < study.kept).any(1).sum()),
        "divergences": int(study.divergences.sum()),
        "runs_with_divergences": int((study.divergences > 0).sum()),
    }


SETTINGS = {"corridor": corridor, "sorting": sorting}


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replications", type=int, default=400)
    parser.add_argument("--task", choices=tuple(SETTINGS), default="corridor")
    parser.add_argument(
        "--uniform", action="store_true", help="reliabilities from Beta(1, 1), not the model's default"
    )
    parser.add_argument("--warmup", type=int, default=Sampling().warmup)
    parser.add_argument("--draws", type=int, default=Sampling().draws)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    setting = SETTINGS[options.task](dist.Beta(1.0, 1.0) if options.uniform else None)
    sampling = Sampling(warmup=options.warmup, draws=options.draws)
    began = time.perf_counter()
    replications = replicate(jax.random.key(options.seed), setting, options.replications, sampling)
    study = judge(
        setting.quantities, track(replications, total=options.replications, console=Console(stderr=True))
    )
    found = {"task": setting.name, **vars(options), **report(study), "seconds": time.perf_counter() - began}
    print_table(
        f"Share of {options.replications} replications whose {PROBABILITY:.0%} intervals "
        "cover the truth: "
        f"{setting.name}",
        tuple(found["quantities"][0]),
        [["-" if x is None else x for x in q.values()] for q in found["quantities"]],
    )
    for name, value in found.items():
        if name != "quantities":
            print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    by_run = {name: getattr(study, name).tolist() for name in ("covered", "ranks", "r_hat", "divergences")}
    publish(
        f"noisy_coverage_{options.task}{'_uniform' if options.uniform else ''}", {**found, "by_run": by_run}
    )


if __name__ == "__main__":
    main()
