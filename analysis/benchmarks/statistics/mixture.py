"""Two samplers of a mixture's posterior, against each other and against their prior.

``python -m i2rl.analysis.benchmarks.statistics.mixture`` asks two questions of NUTS (assignments summed out)
and of Gibbs sampling over assignments (Neal's algorithm 8):

- Do they draw from the same posterior? Moments that are invariant to the order of the components are compared
  over several mixtures, each difference in units of its Monte-Carlo standard error.
- Is it the posterior of the declared model? Simulation-based calibration (Talts et al. 2018) of each, as
  :mod:`~i2rl.analysis.benchmarks.statistics.calibration` does for one component: mixtures drawn from the
  prior generate demonstrations, and the truth's rank among the draws must be uniform. The public samplers are
  called, their starts and output included.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import arviz as az
import jax
import numpy as np
import numpyro.distributions as dist
from jax import lax
from jaxtyping import Array, Float, Int
from numpyro import handlers
from scipy import stats

from ....inference.posteriors.gibbs import gibbs_mixture_posterior
from ....inference.posteriors.mixture import sample_mixture_posterior
from ....inference.posteriors.mixture_problem import label_invariant, pose, resolve_jit
from ....models.laws.mixture import mixture_model
from ....models.observation.demonstration import SEEN, Demonstration
from ....models.observation.evidence import Visibility
from ....models.process.mdp import TabularMDP
from ..harness import print_table, publish
from . import calibration
from .calibration import Ranks, uniformity

# An untruncated process is simulated with this many components: what is left of the stick is negligible.
_PROCESS = 30
# Indicators rarer than this have a mean that is not close to normal.
_RARE = 0.01


class Setting(NamedTuple):
    """A mixture to draw from the prior: ``trajectories`` of ``length`` steps in a small world.

    ``components`` is where NUTS truncates; ``prior`` is over one weight, ``concentration`` over ``alpha``.
    """

    mdp: TabularMDP
    sensor: Visibility
    prior: dist.Distribution
    concentration: dist.Distribution
    components: int
    trajectories: int
    length: int


# Either public sampler, its options bound.
Sampler = Callable[[Array, TabularMDP, Visibility, Demonstration], az.InferenceData]


class Comparison(NamedTuple):
    """One posterior mean by both samplers; ``z`` is their difference over its Monte-Carlo standard error."""

    mixture: int
    name: str
    nuts: float
    gibbs: float
    error: float
    z: float


class Mixtures(NamedTuple):
    """Prior draws, and the components and codes of the demonstrations that they generated."""

    weights: Float[Array, "R T K"]
    proportions: Float[Array, "R T"]
    concentration: Float[Array, " R"]
    assignment: Int[Array, "R n"]
    codes: Int[Array, "R n L 3"]


class Drawn(NamedTuple):
    """One mixture, or many draws alike (leading dimensions), with its log-densities."""

    weights: Float[np.ndarray, "... T K"]
    proportions: Float[np.ndarray, "... T"]
    concentration: Float[np.ndarray, "..."]
    assignment: Int[np.ndarray, "... n"]
    log_likelihood: Float[np.ndarray, "..."]
    log_joint: Float[np.ndarray, "..."]


def small_mixture(trajectories: int, length: int, components: int = 8) -> Setting:
    """Build the process of the calibration with one component, two of its five states out of view."""
    world = calibration.small_world()
    return Setting(
        world.mdp,
        world.sensor,
        dist.Normal(0.0, 1.5),
        dist.Gamma(6.0, 10.0),
        components,
        trajectories,
        length,
    )


@partial(jax.jit, static_argnames=("components", "trajectories", "length"))
def _draw(
    keys: Array,
    mdp: TabularMDP,
    sensor: Visibility,
    prior: dist.Distribution,
    concentration: dist.Distribution,
    *,
    components: int,
    trajectories: int,
    length: int,
) -> Mixtures:
    options = {"components": components, "n_trajectories": trajectories, "length": length}

    def one(key: Array) -> Mixtures:
        model = handlers.seed(mixture_model, key)
        sites = handlers.trace(model).get_trace(
            mdp, sensor, prior=prior, concentration=concentration, **options
        )
        names = ("weights", "proportions", "concentration", "assignment", "demonstration")
        return Mixtures(*(sites[name]["value"] for name in names))

    return lax.map(one, keys)


def draw_mixtures(key: Array, replications: int, setting: Setting, components: int) -> Mixtures:
    """Draw mixtures and their demonstrations from the declared model with so many components."""
    return _draw(
        jax.random.split(key, replications),
        setting.mdp,
        setting.sensor,
        setting.prior,
        setting.concentration,
        components=components,
        trajectories=setting.trajectories,
        length=setting.length,
    )


def moments(idata: az.InferenceData) -> dict[str, Float[np.ndarray, "chain draw"]]:
    """Compute draws of quantities that are invariant to the order of the components; their means are
    compared.
    """
    invariant, components = label_invariant(idata), idata["assignments"].assignment.values
    found = {
        f"trajectories {i} and {j} together": components[..., i] == components[..., j]
        for i, j in itertools.combinations(range(components.shape[-1]), 2)
    }
    counts = range(1, components.shape[-1] + 1)
    found |= {f"{k} components": invariant.n_components.values == k for k in counts}
    found |= {
        "number of components": invariant.n_components.values,
        "concentration": invariant.concentration.values,
    }
    found |= {name: invariant[name].values for name in ("log_likelihood", "log_joint")}
    found["largest proportion"] = invariant.proportion.values[..., 0]
    for i, name in itertools.product(range(components.shape[-1]), invariant.feature.values):
        drawn = invariant.trajectory_weights.sel(feature=name).isel(trajectory=i)
        found[f"weight of {name} in trajectory {i}"] = drawn.values
    return {name: np.asarray(draws, float) for name, draws in found.items()}


def compare(mixture: int, nuts: az.InferenceData, gibbs: az.InferenceData) -> list[Comparison]:
    """Compare every moment that varies."""
    compared = []
    for (name, one), other in zip(moments(nuts).items(), moments(gibbs).values(), strict=True):
        middle = (one.mean() + other.mean()) / 2
        if set(np.unique(one)) <= {0.0, 1.0} and not _RARE <= middle <= 1 - _RARE:
            continue
        error = float(np.sqrt(sum(x.var() / az.ess(x, method="mean") for x in (one, other))))
        z = (one.mean() - other.mean()) / error
        compared.append(Comparison(mixture, name, float(one.mean()), float(other.mean()), error, float(z)))
    return compared


def agreement(
    key: Array, mixtures: int, setting: Setting, nuts: Sampler, gibbs: Sampler
) -> tuple[list[Comparison], list[dict[str, Any]]]:
    """Sample the posterior of each of several mixtures by both; and how well each sampler mixed."""
    draw_key, *keys = jax.random.split(key, 1 + 2 * mixtures)
    drawn = draw_mixtures(draw_key, mixtures, setting, setting.components)
    compared, mixed = [], []
    for r in range(mixtures):
        demonstration = Demonstration.from_codes(np.asarray(drawn.codes[r]))
        data = []
        for name, sample, k in (("NUTS", nuts, keys[2 * r]), ("Gibbs", gibbs, keys[2 * r + 1])):
            began = time.perf_counter()
            data.append(sample(k, setting.mdp, setting.sensor, demonstration))
            spent = time.perf_counter() - began
            varying = [x for x in moments(data[-1]).values() if np.ptp(x) > 0]
            mixed.append(
                {
                    "mixture": r,
                    "sampler": name,
                    "seconds": spent,
                    "R-hat": max(float(az.rhat(x)) for x in varying),
                    "ESS": min(float(az.ess(x, method="mean")) for x in varying),
                    "components": float(data[-1]["assignments"].n_components.mean()),
                }
            )
        compared += compare(r, *data)
    return compared, mixed


def invariant_statistics(drawn: Drawn, feature_names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Compute the ranked statistics, ``[...]``; they are invariant to the order of the components."""
    counts = (drawn.assignment[..., None] == np.arange(drawn.proportions.shape[-1])).sum(-2)
    first = np.take_along_axis(drawn.weights, drawn.assignment[..., :1, None], axis=-2)[..., 0, :]
    ranked = {
        "components": (counts > 0).sum(-1),
        "pairs together": (counts * (counts - 1) // 2).sum(-1),
        "concentration": drawn.concentration,
        "largest proportion": drawn.proportions.max(-1),
        "evenness": (drawn.proportions**2).sum(-1),
        "log-likelihood": drawn.log_likelihood,
        "log-joint": drawn.log_joint,
    }
    return ranked | {f"weight of {name}": first[..., k] for k, name in enumerate(feature_names)}


def rank_statistics(
    key: Array, replications: int, setting: Setting, sample: Sampler, components: int, *, draws: int = 63
) -> Ranks:
    """Replicate prior draw, simulation and posterior; ranks of the truth among ``draws`` thinned evenly.

    ``components`` of the truth: those of the sampler's model, or many for the process itself.
    """
    truth_key, sample_key, resolve_key, tie_key = jax.random.split(key, 4)
    drawn = draw_mixtures(truth_key, replications, setting, components)
    keys = jax.random.split(sample_key, replications)
    resolve_keys = jax.random.split(resolve_key, replications)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(tie_key)))
    names = setting.mdp.feature_names

    def true_and_drawn(r: int) -> tuple[dict, dict, int]:
        demonstration = Demonstration.from_codes(np.asarray(drawn.codes[r]))
        problem, *_ = pose(
            setting.mdp,
            setting.sensor,
            demonstration,
            concentration=setting.concentration,
            prior=setting.prior,
            at_least_one={},
            warmup=0,
        )
        sites = [x[r : r + 1] for x in drawn[:3]]
        known = resolve_jit(resolve_keys[r : r + 1], *sites, problem, drawn.assignment[r : r + 1])
        totals = (known.assignment, known.log_likelihood.sum(-1), known.log_joint)
        true = Drawn(*(np.asarray(x)[0] for x in (*sites, *totals)))
        idata = sample(keys[r], setting.mdp, setting.sensor, demonstration)
        posterior, group = idata["posterior"], idata["assignments"]
        chain = Drawn(
            posterior.weights.values,
            posterior.proportions.values,
            posterior.concentration.values,
            group.assignment.values,
            idata["log_likelihood"].demonstration.values.sum(-1),
            group.log_joint.values,
        )
        thin = chain.concentration.shape[1] // draws
        kept = Drawn(*(x[0, thin - 1 :: thin] for x in chain))
        chain_stats = idata["sample_stats"]
        diverging = int(chain_stats.diverging.sum()) if "diverging" in chain_stats else 0
        return invariant_statistics(true, names), invariant_statistics(kept, names), diverging

    # NumPyro's handlers share one stack, so nothing may be traced in two threads at once: whatever shapes
    # there are (some trajectories wholly seen, some not) come once beforehand.
    whole: np.ndarray = (np.asarray(drawn.codes)[..., 0] == SEEN).all(-1)
    kinds = [(bool(x.any()), bool(x.all())) for x in whole]
    first = {kind: r for r, kind in reversed(list(enumerate(kinds)))}
    done = {r: true_and_drawn(r) for r in sorted(first.values())}
    others = [r for r in range(replications) if r not in done]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        done |= dict(zip(others, pool.map(true_and_drawn, others), strict=True))
    ranks = np.empty((replications, len(done[0][0])), int)
    for r, (true, found, _) in done.items():
        for q, (value, among) in enumerate(zip(true.values(), found.values(), strict=True)):
            below, ties = (among < value).sum(), (among == value).sum()
            ranks[r, q] = below + rng.integers(ties + 1)
    return Ranks(tuple(done[0][0]), ranks, draws, sum(x[2] for x in done.values()))


def tails(compared: list[Comparison]) -> dict[str, Any]:
    """Count ``|z|`` above 2 and 3, with their expectations under agreement, and find the largest.

    Moments of one posterior are correlated, so that counts vary more than those of independent ones; the
    chance of so large a ``|z|`` among as many independent ones is then an upper bound.
    """
    sizes = np.abs([c.z for c in compared])
    worst = compared[int(sizes.argmax())]
    found: dict[str, Any] = {
        "quantities": len(sizes),
        "root mean square z": float(np.sqrt((sizes**2).mean())),
        "largest z": worst._asdict(),
        "chance of one as large": float(-np.expm1(len(sizes) * np.log1p(-2 * stats.norm.sf(sizes.max())))),
    }
    for limit in (2, 3):
        found[f"beyond {limit}"] = int((sizes > limit).sum())
        found[f"expected beyond {limit}"] = float(len(sizes) * 2 * stats.norm.sf(limit))
    return found


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mixtures", type=int, default=2, help="posteriors that both samplers draw from")
    parser.add_argument("--replications", type=int, default=208, help="of the calibration of each sampler")
    parser.add_argument("--draws", type=int, default=1200, help="by each of 4 chains compared")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    agree_key, nuts_key, gibbs_key = jax.random.split(jax.random.key(options.seed), 3)
    results: dict[str, Any] = {"seed": options.seed, "replications": options.replications}

    setting = small_mixture(trajectories=6, length=8, components=10)
    shared = {
        "components": setting.components,
        "concentration": setting.concentration,
        "prior": setting.prior,
    }
    if options.mixtures:
        began = time.perf_counter()
        compared, mixed = agreement(
            agree_key,
            options.mixtures,
            setting,
            partial(sample_mixture_posterior, **shared, draws=options.draws),
            partial(gibbs_mixture_posterior, **shared, draws=options.draws, thin=4),
        )
        spread = tails(compared)
        results["agreement"] = {
            **spread,
            "seconds": time.perf_counter() - began,
            "mixing": mixed,
            "compared": [c._asdict() for c in compared],
        }
        print_table("Chains", tuple(mixed[0]), [tuple(m.values()) for m in mixed])
        print_table(
            f"NUTS and Gibbs: {len(compared)} moments of {options.mixtures} posteriors, furthest apart",
            Comparison._fields,
            sorted(compared, key=lambda c: -abs(c.z))[:6],
        )
        print_table(
            "Differences in standard errors",
            ("", "value"),
            [(name, value) for name, value in spread.items() if name != "largest z"],
        )
        publish("mixture", results)

    setting = small_mixture(trajectories=5, length=6, components=5)
    shared["components"] = setting.components
    # Chains long enough that thinned draws are close to independent.
    calibrated: dict[str, tuple[Array, Sampler, int]] = {
        "Gibbs": (
            gibbs_key,
            partial(gibbs_mixture_posterior, **shared, chains=1, draws=31, warmup=60, thin=20),
            _PROCESS,
        ),
        "NUTS": (
            nuts_key,
            partial(sample_mixture_posterior, **shared, chains=1, draws=31 * 10, warmup=120),
            setting.components,
        ),
    }
    results["calibration"] = {}
    for name, (key, sample, components) in calibrated.items() if options.replications else ():
        began = time.perf_counter()
        ranks = rank_statistics(key, options.replications, setting, sample, components, draws=31)
        tests = uniformity(ranks)
        least = min(test.p_value for test in tests)
        results["calibration"][name] = {
            "draws": ranks.draws,
            "divergences": ranks.divergences,
            "quantities": [test._asdict() for test in tests],
            "smallest p": least,
            "chance of one as small": 1 - (1 - least) ** len(tests),
            "seconds": time.perf_counter() - began,
            "ranks": {q: column.tolist() for q, column in zip(ranks.names, ranks.ranks.T, strict=True)},
        }
        print_table(
            f"{name}: ranks of the truth, {options.replications} replications "
            f"({results['calibration'][name]['seconds']:.0f} s)",
            ("quantity", "chi-square", "p"),
            tests,
        )
        publish("mixture", results)


if __name__ == "__main__":
    main()
