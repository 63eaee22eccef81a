"""Quality of a reward and a policy of networks (section 7.4.3): returns, correlations, LBA, empirical ILE.

Without a table of states all measures are estimated from episodes, so every number comes with its
distribution, its count and an interval. Shares are in [0, 1].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import stats

from ...domains.robots.simulation import Behaviour, acted, simulate
from ...models.networks.environment import Environment, HostEnvironment
from ...models.networks.modules import ActionSpace

RESAMPLES = 2000


def returns_at_fixed_length(
    environment: Environment | HostEnvironment,
    policy: Behaviour,
    key: Array,
    episodes: int,
    length: int | None = 1000,
    *,
    deterministic: bool = False,
) -> Float[np.ndarray, " episodes"]:
    """Simulate undiscounted returns, by the environment's own reward, of episodes of ``length`` steps.

    An episode earns zero after it terminates; to make the length independent of the policy (Table 7.3), use
    an environment that does not terminate: ``locomotion(name, terminate_when_unhealthy=False)``.
    """
    return simulate(environment, policy, key, episodes, length, deterministic=deterministic).returns


# -- rewards ------------------------------------------------------------------------------------------


class Interval(NamedTuple):
    """Ends of an interval."""

    low: float
    high: float


class Correlation(NamedTuple):
    """Correlation of two numbers.

    Fields
    ------
    n : int, pairs of numbers
    pearson, spearman : float; NaN where either number is constant
    fisher : Interval, Pearson's by Fisher's ``z``, as though all pairs were independent
    bootstrap : Interval, Pearson's, trajectories drawn with replacement
    spearman_bootstrap : Interval, likewise, of the whole sample's ranks
    """

    n: int
    pearson: float
    spearman: float
    fisher: Interval
    bootstrap: Interval
    spearman_bootstrap: Interval


class RewardCorrelation(NamedTuple):
    """Over single steps, and over trajectories' sums."""

    steps: Correlation
    trajectories: Correlation


def reward_correlation(
    learned: Float[np.ndarray, "n T"],
    true: Float[np.ndarray, "n T"],
    live: Bool[np.ndarray, "n T"],
    key: Array,
    *,
    coverage: float = 0.95,
    resamples: int = RESAMPLES,
) -> RewardCorrelation:
    """Compute the correlation of a learned reward with the true one over held-out episodes (Table 7.4).

    Steps of one trajectory depend on each other, so of steps Fisher's interval is too narrow; the bootstrap
    draws whole trajectories. Sums of trajectories of unequal length go together by their length alone; take
    episodes of fixed length.

    Raises ``ValueError`` for shapes that differ, fewer than 4 trajectories (Fisher's ``z`` has variance
    ``1 / (n - 3)``), or a live reward that is not finite, naming trajectory and step.
    """
    x, y, alive = (np.asarray(a) for a in (learned, true, live))
    if x.ndim != 2 or not x.shape == y.shape == alive.shape:
        raise ValueError(
            "learned and true rewards and what is live must all have one shape [trajectories, steps], got "
            f"{x.shape}, {y.shape} and {alive.shape}"
        )
    if len(x) < 4:
        raise ValueError(f"a correlation's interval needs at least 4 trajectories, got {len(x)}")
    for name, rewards in (("learned", x), ("true", y)):
        wrong = np.argwhere(alive & ~np.isfinite(rewards))
        if len(wrong):
            i, t = wrong[0]
            raise ValueError(f"trajectory {i}, step {t}: the {name} reward is {rewards[i, t]}, not finite")
    x, y = (np.where(alive, a, 0).astype(float) for a in (x, y))
    # Of 32-bit floats, or the variance of ranks and rewards would be lost to rounding.
    counts = np.asarray(_resampled(key, len(x), resamples), float)
    owner = np.broadcast_to(np.arange(len(x))[:, None], x.shape)[alive]
    ones = np.arange(len(x))
    return RewardCorrelation(
        _correlation(x[alive], y[alive], owner, counts, coverage),
        _correlation(x.sum(1), y.sum(1), ones, counts, coverage),
    )


def fisher_interval(r: float, n: int, coverage: float = 0.95) -> Interval:
    """Compute the interval of Pearson's correlation of ``n`` independent normal pairs (Fisher 1921)."""
    if not abs(r) < 1:
        return Interval(r, r)
    half = stats.norm.ppf(0.5 + coverage / 2) / math.sqrt(n - 3)
    return Interval(*(math.tanh(math.atanh(r) + side * half) for side in (-1, 1)))


def _correlation(
    x: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
    owner: Int[np.ndarray, " N"],
    counts: Float[np.ndarray, "B n"],
    coverage: float,
) -> Correlation:
    """Compute correlations; ``owner`` holds the trajectory of each pair."""
    ranks = stats.rankdata(x), stats.rankdata(y)
    pearson, spearman = (_weighted(a, b, owner, np.ones_like(counts[:1]))[0] for a, b in ((x, y), ranks))
    drawn = [_weighted(a, b, owner, counts) for a, b in ((x, y), ranks)]
    return Correlation(
        len(x),
        float(pearson),
        float(spearman),
        fisher_interval(float(pearson), len(x), coverage),
        *(_percentiles(d, coverage) for d in drawn),
    )


def _weighted(
    x: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
    owner: Int[np.ndarray, " N"],
    counts: Float[np.ndarray, "B n"],
) -> Float[np.ndarray, " B"]:
    """Compute Pearson's correlation with given multiplicities of trajectories."""
    x, y = _standardised(x), _standardised(y)
    moments = (np.ones_like(x), x, y, x * x, y * y, x * y)
    sums = np.stack([np.bincount(owner, m, counts.shape[1]) for m in moments], 1)
    n, sx, sy, sxx, syy, sxy = (counts @ sums).T
    with np.errstate(invalid="ignore", divide="ignore"):
        vx, vy = sxx - sx**2 / n, syy - sy**2 / n
        r = (sxy - sx * sy / n) / np.sqrt(np.maximum(vx, 0) * np.maximum(vy, 0))
    varies = np.minimum(vx, vy) > 1e-9 * n
    clipped: np.ndarray = np.where(varies, np.clip(r, -1, 1), np.nan)
    return clipped


def _standardised(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    deviation = x.std()
    # A constant is left one, whatever the rounding of its mean.
    if not deviation > 1e-12 * np.abs(x).max(initial=0):
        return np.zeros_like(x)
    standardised: np.ndarray = (x - x.mean()) / deviation
    return standardised


def _resampled(key: Array, n: int, resamples: int) -> Int[np.ndarray, "resamples n"]:
    """Draw the multiplicities of ``n`` items, with replacement."""
    drawn = np.asarray(jax.random.randint(key, (resamples, n), 0, n))
    return np.bincount((drawn + n * np.arange(resamples)[:, None]).ravel(), minlength=resamples * n).reshape(
        resamples, n
    )


def _percentiles(drawn: Float[np.ndarray, " B"], coverage: float) -> Interval:
    drawn = drawn[np.isfinite(drawn)]
    if not len(drawn):
        return Interval(math.nan, math.nan)
    tail = (1 - coverage) / 2
    return Interval(*map(float, np.quantile(drawn, [tail, 1 - tail])))


# -- behaviour ----------------------------------------------------------------------------------------


def action_agreement(space: ActionSpace, expert: np.ndarray, learner: np.ndarray) -> Float[np.ndarray, "..."]:
    """Compute agreement of two actions, in [0, 1]: ``1 - |a_E - a_L| / |a_max - a_min|``, or their equality.

    Vectors ``[..., k]`` are cut to their bounds first, as an environment does.
    """
    ours, theirs = np.asarray(learner), np.asarray(expert)
    if space.discrete:
        return (ours == theirs).astype(float)
    low, high = np.asarray(space.low), np.asarray(space.high)
    apart = np.clip(ours, low, high) - np.clip(theirs, low, high)
    alike: np.ndarray = 1 - np.linalg.norm(apart, axis=-1) / np.linalg.norm(high - low)
    return alike


def behaviour_accuracy(
    space: ActionSpace, expert: Behaviour, learner: Behaviour, observations: Float[np.ndarray, "N d"]
) -> float:
    """Compute LBA (section 7.4.3): mean agreement of both policies' deterministic actions in the given
    states.

    The dissertation's is 100 times this. Actions are exact modes; the caller chooses the states.
    """
    seen = jnp.asarray(observations, jnp.float32)
    ours, theirs = (np.asarray(acted(p, _NO_KEY, seen, True)) for p in (learner, expert))
    return float(action_agreement(space, theirs, ours).mean())


# The mode needs no draw.
_NO_KEY = jnp.zeros(2, jnp.uint32)


class BehaviourAccuracy(NamedTuple):
    """LBA over three distributions of states, of ``n`` states each.

    Fields
    ------
    expert : float, states the expert is in when it acts
    learner : float, states the learner is in when it acts
    box : float, uniform in the smallest box around the expert's states
    n : ints, how many states each was taken over
    """

    expert: float
    learner: float
    box: float
    n: tuple[int, int, int]


def behaviour_accuracies(
    environment: Environment | HostEnvironment,
    expert: Behaviour,
    learner: Behaviour,
    key: Array,
    episodes: int = 10,
    length: int | None = None,
) -> BehaviourAccuracy:
    """Compute LBA over the states that either policy meets in so many episodes, actions drawn, and over a box
    around them.
    """
    k_expert, k_learner, k_box = jax.random.split(key, 3)
    own = simulate(environment, expert, k_expert, episodes, length).visited
    met = simulate(environment, learner, k_learner, episodes, length).visited
    box = np.asarray(jax.random.uniform(k_box, own.shape, jnp.float32, own.min(0), own.max(0)))
    of_own, of_met, of_box = (
        behaviour_accuracy(environment.actions, expert, learner, states) for states in (own, met, box)
    )
    return BehaviourAccuracy(of_own, of_met, of_box, (len(own), len(met), len(box)))


def accuracy_of_cells(
    environment: Environment,
    expert: Behaviour,
    learner: Behaviour,
    *,
    cells: int = 10,
    points: int = 10,
) -> Float[np.ndarray, "cells ..."]:
    """Compute LBA in every cell of a bounded space of states, ``cells`` a dimension (mountain car, section
    7.4.3).

    Each is the mean over a grid of ``points`` a dimension, and all cells are equally large, so LBA over the
    whole space is their mean. Raises ``ValueError`` for observations without bounds.
    """
    low, high = np.asarray(environment.low), np.asarray(environment.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"observations of {environment.name} are not bounded: {low} to {high}")
    d, m = environment.observation_size, cells * points
    middles = [a + (b - a) * (np.arange(m) + 0.5) / m for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*middles, indexing="ij"), -1).reshape(-1, d)
    seen = jnp.asarray(grid, jnp.float32)
    ours, theirs = (np.asarray(acted(p, _NO_KEY, seen, True)) for p in (learner, expert))
    alike = action_agreement(environment.actions, theirs, ours)
    shares: np.ndarray = alike.reshape((cells, points) * d).mean(tuple(range(1, 2 * d, 2)))
    return shares


# -- what noise costs ---------------------------------------------------------------------------------


class EmpiricalILE(NamedTuple):
    """Empirical inverse learning error by the learned reward (Table 7.5).

    Fields
    ------
    demonstrated, generated : float, ``V_demo`` and ``V_gen``
    of_table : float, ``(V_demo - V_gen) / V_demo``, by which the table's numbers come out
    of_text : float, ``(V_gen - V_demo) / V_gen``, as the equation of section 7.4.3 is printed
    """

    demonstrated: float
    generated: float
    of_table: float
    of_text: float


def empirical_ile(demonstrated: float, generated: float) -> EmpiricalILE:
    """Compute both forms from two values. NaN where the divisor is zero."""
    apart = demonstrated - generated
    return EmpiricalILE(
        demonstrated,
        generated,
        apart / demonstrated if demonstrated else math.nan,
        -apart / generated if generated else math.nan,
    )


def bounded_ile(
    demonstrated: Float[np.ndarray, "n T"],
    demonstrated_live: Bool[np.ndarray, "n T"],
    generated: Float[np.ndarray, "m U"],
    generated_live: Bool[np.ndarray, "m U"],
) -> EmpiricalILE:
    """Compute empirical ILE of rewards bounded by a sigmoid, of noise-free demonstrations and the learner's.

    Rewards are scaled by the mean and deviation of all of them (the released code: of the reward network's
    running ones) before the sigmoid. A trajectory's value is its mean over steps, which is in [0, 1] as in
    Table 7.5, and all trajectories count alike. The table's form is then at most 1, and negative where the
    learner earns more than the demonstrator. Raises ``ValueError`` for a trajectory without a step.
    """
    parts = [
        (np.asarray(rewards, float), np.asarray(live))
        for rewards, live in ((demonstrated, demonstrated_live), (generated, generated_live))
    ]
    for name, (_, live) in zip(("demonstrated", "generated"), parts, strict=True):
        if not live.any(1).all():
            raise ValueError(f"{name} trajectory {int(np.argmin(live.any(1)))} has no step")
    everything = np.concatenate([rewards[live] for rewards, live in parts])
    centre, scale = everything.mean(), everything.std() or 1.0
    values = []
    for rewards, live in parts:
        bounded = np.where(live, _sigmoid((rewards - centre) / scale), 0.0)
        values.append(float((bounded.sum(1) / live.sum(1)).mean()))
    return empirical_ile(*values)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1 + np.tanh(0.5 * x))


class Recovery(NamedTuple):
    """Share of what noise cost that was won back.

    Fields
    ------
    share : float, ``(robust - noisy) / (clean - noisy)`` of the means over replications
    low, high : float, its interval; infinite ends where too few replications show a loss at all
    lost : float, share of resamples in which noise cost something
    n : int, seeds
    """

    share: float
    low: float
    high: float
    lost: float
    n: int


def recovered_share(
    clean: Float[np.ndarray, " n"],
    noisy: Float[np.ndarray, " n"],
    robust: Float[np.ndarray, " n"],
    key: Array,
    *,
    coverage: float = 0.95,
    resamples: int = 10_000,
) -> Recovery:
    """Estimate the share of the return (or LBA) lost to noise that a robust learner recovers.

    A bootstrap over replications gives the interval: entry ``i`` of all three has one seed, and the three are
    drawn together. If noise may have no cost, the ratio has a pole: means without a loss, of the replications
    or of a resample, count as minus or plus infinity by what the robust learner gained. Of a few replications
    a bootstrap's interval is too narrow. Raises ``ValueError`` for different numbers of replications, none,
    or numbers that are not finite.
    """
    replications = [np.asarray(x, float) for x in (clean, noisy, robust)]
    n = len(replications[0])
    if n == 0 or any(x.shape != (n,) for x in replications):
        raise ValueError(
            f"clean, noisy and robust need one number a replication; got shapes "
            f"{[x.shape for x in replications]}"
        )
    for name, values in zip(("clean", "noisy", "robust"), replications, strict=True):
        if not np.isfinite(values).all():
            raise ValueError(f"replication {int(np.argmin(np.isfinite(values)))} of {name} is not finite")

    def ratio(lost: np.ndarray, gained: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(lost > 0, gained / lost, np.copysign(np.inf, gained))

    cost, won = replications[0] - replications[1], replications[2] - replications[1]
    weights = np.asarray(_resampled(key, n, resamples), float) / n
    lost, share = weights @ cost, ratio(cost.mean(), won.mean())
    drawn = ratio(lost, weights @ won)
    tail = (1 - coverage) / 2
    # Order statistics themselves: interpolation between infinities is no number.
    low, high = np.quantile(drawn, [tail, 1 - tail], method="closest_observation")
    return Recovery(float(share), float(low), float(high), float((lost > 0).mean()), n)


class SeedInterval(NamedTuple):
    """A mean over replications and its interval."""

    mean: Float[np.ndarray, "..."]
    low: Float[np.ndarray, "..."]
    high: Float[np.ndarray, "..."]


def seed_interval(
    replications: Float[np.ndarray, "replications ..."], coverage: float = 0.95
) -> SeedInterval:
    """Compute the mean over the first axis with Student's interval; its ends are NaN for one replication."""
    replications = np.asarray(replications, float)
    n, mean = len(replications), replications.mean(0)
    if n < 2:
        return SeedInterval(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    half = stats.t.ppf(0.5 + coverage / 2, n - 1) * replications.std(0, ddof=1) / math.sqrt(n)
    return SeedInterval(mean, mean - half, mean + half)
