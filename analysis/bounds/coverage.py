"""Coverage and looseness of the bounds: replications against each theorem's promise.

The expert obeys the model the theorems assume (the soft policy of weights in [0, 1]^K), trajectories are
independent, and the program is the theorems': here every assumption holds, so a miss would refute the
theorem. A replication simulates ``n`` trajectories, fits, and tests whether the expert's expected
log-likelihood is within the bound of the solution's. The rest beyond a trajectory's last step enters with its
exact expectation under the expert, so means and ranges are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from ...inference.learners.lme import lme_i2rl
from ...inference.programs.constraints import FeatureTarget
from ...inference.programs.maximum_entropy import solve_dual
from ...inference.sessions.fleets import fleet
from ...models.laws.chain import filter_all, sample_backward, smooth_all
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import AnySensor, observe, step_log_evidence
from ...models.process.mdp import TabularMDP
from ...models.process.planning import features_to_go, reward_of, simulate, soft_plan
from ...models.process.units import feature_scale
from .theorems import (
    error_for,
    lme_constraint_bound,
    lme_i2rl_confidence,
    me_i2rl_confidence,
    no_regret,
    no_regret_sizes,
    observed_bound,
)

# Trajectories completed together.
_BATCH = 32


class Setting(NamedTuple):
    """An expert to simulate: process, true weights ``[K]``, sensor, and steps of a trajectory."""

    name: str
    mdp: TabularMDP
    weights: Float[Array, " K"]
    sensor: AnySensor
    length: int


class Coverage(NamedTuple):
    """Coverage of a bound in replications.

    Fields
    ------
    setting, result : str
        The process, and the theorem or lemma.
    trajectories : int
        ``n``; in all sessions, for the regret.
    confidence, covered : float
        The stated one, and the share of replications within the bound.
    bound, quantile : float
        The bound (median over replications where it depends on the data), and the observed quantile at the
        stated confidence: the smallest number that would have been right as often.
    replications : int
    """

    setting: str
    result: str
    trajectories: int
    confidence: float
    covered: float
    bound: float
    quantile: float
    replications: int

    @property
    def looseness(self) -> float:
        """Ratio of the bound to the quantile observed."""
        return self.bound / self.quantile


class Expert(NamedTuple):
    """Exact properties of an expert who obeys the soft model."""

    weights: Float[Array, " K"]
    log_policy: Float[Array, "S A"]
    values: Float[Array, " S"]
    to_go: Float[Array, "S K"]
    features: Float[Array, " K"]


def expert_of(mdp: TabularMDP, weights: Float[Array, " K"]) -> Expert:
    """Plan the soft policy of ``weights``, and the features it collects from each state and from ``p0``."""
    plan = soft_plan(mdp, reward_of(mdp, weights))
    to_go = features_to_go(mdp, plan.policy)
    return Expert(weights, plan.log_policy, plan.values, to_go, mdp.initial @ to_go)


# -- simulation ---------------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("length", "replications", "size"))
def simulate_features(
    key: Array, mdp: TabularMDP, expert: Expert, length: int, replications: int, size: int
) -> Float[Array, "replications size K"]:
    """Simulate discounted features of independent, fully seen trajectories."""
    powers = mdp.discount ** jnp.arange(length + 1)

    def one(key: Array) -> Float[Array, " K"]:
        states, actions = simulate(key, mdp, expert.log_policy, length + 1)
        return powers[:-1] @ mdp.features[states[:-1], actions[:-1]] + powers[-1] * expert.to_go[states[-1]]

    return lax.map(jax.vmap(one), jax.random.split(key, (replications, size)))


@partial(jax.jit, static_argnames=("length", "replications", "size"))
def simulate_codes(
    key: Array, mdp: TabularMDP, expert: Expert, sensor: AnySensor, length: int, replications: int, size: int
) -> Int[Array, "replications size L 3"]:
    """Simulate the observation of independent trajectories, as :attr:`Demonstration.codes`."""

    def one(key: Array) -> Int[Array, "L 3"]:
        walk, look = jax.random.split(key)
        return observe(look, sensor, *simulate(walk, mdp, expert.log_policy, length))

    return lax.map(jax.vmap(one), jax.random.split(key, (replications, size)))


class Completed(NamedTuple):
    """Features of each trajectory with its hidden steps filled in under the expert's own weights.

    ``exact`` is their expectation given the observations, ``sampled`` their mean over some completions.
    """

    exact: Float[Array, "replications size K"]
    sampled: Float[Array, "replications size K"]


@partial(jax.jit, static_argnames=("draws",))
def complete_features(
    key: Array, mdp: TabularMDP, expert: Expert, sensor: AnySensor, codes: Array, draws: int
) -> Completed:
    """Complete each trajectory of ``codes [replications, size, L, 3]``, exactly and by ``draws`` samples."""
    replications, size, length, _ = codes.shape
    powers = mdp.discount ** jnp.arange(length + 1)
    beyond = powers[-1] * jax.vmap(mdp.expect_next, in_axes=1, out_axes=2)(expert.to_go)

    def evidence(code: Int[Array, " 3"]) -> Float[Array, "S A"]:
        shape = (mdp.n_states, mdp.n_actions)
        return step_log_evidence(sensor, *shape, code[0], code[1], code[2], jnp.array(jnp.nan))

    def several(inputs: tuple) -> tuple:
        keys, codes = inputs
        factors = jax.vmap(jax.vmap(evidence))(codes) + expert.log_policy
        live = jnp.ones(factors.shape[:2], bool)
        pairs = smooth_all(mdp, factors, live).pairs
        exact = jnp.einsum("l,nlsa,sak->nk", powers[:-1], pairs, mdp.features)
        exact += jnp.einsum("nsa,sak->nk", pairs[:, -1], beyond)

        def sample(key: Array, *passed: Any) -> Float[Array, " K"]:
            draw = jax.vmap(lambda k: sample_backward(k, mdp, *passed))
            states, actions = draw(jax.random.split(key, draws))
            collected = jnp.einsum("l,dlk->dk", powers[:-1], mdp.features[states, actions])
            return (collected + beyond[states[:, -1], actions[:, -1]]).mean(axis=0)

        return exact, jax.vmap(sample)(keys, factors, filter_all(mdp, factors, live), live)

    n = replications * size
    # Whole batches; what is repeated to fill the last one is cut off again.
    rows = jnp.arange(-(-n // _BATCH) * _BATCH).reshape(-1, _BATCH) % n
    given = (jax.random.split(key, n)[rows], codes.reshape(-1, length, 3)[rows])
    completed = lax.map(several, given)
    return Completed(*(x.reshape(-1, x.shape[-1])[:n].reshape(replications, size, -1) for x in completed))


# -- fits ---------------------------------------------------------------------------------------------


@jax.jit
def expected_gaps(
    mdp: TabularMDP,
    expert: Expert,
    targets: Float[Array, "replications K"],
    slacks: Float[Array, "replications K"],
) -> Float[Array, " replications"]:
    """Compute ``LL(theta_E) - LL(theta)`` of each program's solution, in expectation over the expert's
    trajectories.

    ``slacks`` are in units of the features as given.
    Nats per trajectory; never negative (Gibbs' inequality).
    """

    scale = feature_scale(mdp)

    def one(inputs: tuple) -> Float[Array, ""]:
        target, slack = inputs
        learned = solve_dual(mdp, FeatureTarget(target, mdp.initial), slack / scale)
        return expected_gap(mdp, expert, learned.weights, learned.values)

    return lax.map(one, (targets, slacks), batch_size=64)


def expected_gap(
    mdp: TabularMDP, expert: Expert, weights: Float[Array, " K"], values: Float[Array, " S"]
) -> Float[Array, ""]:
    """Compute the expert's expected log-likelihood less that of other weights, given their soft values."""
    return (expert.weights - weights) @ expert.features - mdp.initial @ (expert.values - values)


def ignorance_gap(mdp: TabularMDP, weights: Float[Array, " K"]) -> float:
    """Compute the gap of zero weights: a bound above it promises less than ignorance achieves."""
    expert = expert_of(mdp, jnp.asarray(weights))
    nothing = soft_plan(mdp, jnp.zeros((mdp.n_states, mdp.n_actions)))
    return float(expected_gap(mdp, expert, jnp.zeros(mdp.n_features), nothing.values))


# -- studies ------------------------------------------------------------------------------------------


def full_view_coverage(
    key: Array, setting: Setting, replications: int, size: int, confidence: float
) -> list[Coverage]:
    """Check Theorem 1 beside the bounds from observed variances, on the same fully seen trajectories.

    ``epsilon`` is what ``size`` trajectories allow at ``confidence``.
    """
    mdp, discount = setting.mdp, float(setting.mdp.discount)
    expert = expert_of(mdp, setting.weights)
    features = simulate_features(key, mdp, expert, setting.length, replications, size)
    epsilon = error_for(size, 1 - confidence, mdp.n_features)
    theorem = me_i2rl_confidence(size, epsilon, mdp.n_features, discount)
    target = features.mean(axis=1)
    misses = (1 - discount) * jnp.max(jnp.abs(target - expert.features), axis=1)
    gaps = expected_gaps(mdp, expert, target, jnp.full_like(target, epsilon / (1 - discount)))
    rows = [
        coverage_of(
            setting,
            f"{theorem.source}, its constraints",
            size,
            confidence,
            np.full(replications, epsilon),
            misses,
        ),
        coverage_of(setting, theorem.source, size, confidence, np.full(replications, theorem.error), gaps),
    ]
    for predictable, name in ((False, "observed variances"), (True, "observed variances, predictable")):
        rows += _observed_rows(setting, expert, features, confidence, predictable, name)
    return rows


def _observed_rows(
    setting: Setting, expert: Expert, features: Array, confidence: float, predictable: bool, name: str
) -> list[Coverage]:
    mdp, discount = setting.mdp, float(setting.mdp.discount)
    each = [observed_bound(x, confidence, discount, predictable=predictable) for x in np.asarray(features)]
    targets, slacks = jnp.asarray([o.target for o in each]), jnp.asarray([o.slack for o in each])
    # All constraints hold together if the worst, relative to its own slack, does.
    misses = jnp.max(jnp.abs(targets - expert.features) / slacks, axis=1)
    errors = np.array([o.bound.error for o in each])
    gaps = expected_gaps(mdp, expert, targets, slacks)
    size = features.shape[1]
    return [
        coverage_of(setting, f"{name}, its constraints (of 1)", size, confidence, np.ones(len(each)), misses),
        coverage_of(setting, name, size, confidence, errors, gaps),
    ]


def occluded_coverage(
    key: Array, setting: Setting, replications: int, size: int, draws: int, delta: float
) -> list[Coverage]:
    """Check Lemma 2 and Theorem 2 with completions under the expert's weights, exact and sampled.

    ``delta`` is spent on each of ``epsilon`` (``size`` trajectories) and ``epsilon_s`` (``size * draws``
    sampled completions in all). The exact completion's rows are held to Theorem 1's bound: ``epsilon``
    and ``delta`` alone.
    """
    mdp, discount, n_features = setting.mdp, float(setting.mdp.discount), setting.mdp.n_features
    expert = expert_of(mdp, setting.weights)
    walk, fill = jax.random.split(key)
    codes = simulate_codes(walk, mdp, expert, setting.sensor, setting.length, replications, size)
    completed = complete_features(fill, mdp, expert, setting.sensor, codes, draws)
    epsilon = error_for(size, delta, n_features)
    epsilon_s = error_for(size * draws, delta, n_features)
    lemma = lme_constraint_bound(size, size * draws, epsilon, epsilon_s, n_features)
    theorem = lme_i2rl_confidence(size, size * draws, epsilon, epsilon_s, n_features, discount)
    exactly = me_i2rl_confidence(size, epsilon, n_features, discount)
    rows = []
    for name, features, confidence, slack, error in (
        (f"{lemma.source}, sampled", completed.sampled, lemma.confidence, lemma.error, None),
        (f"{theorem.source}, sampled", completed.sampled, theorem.confidence, lemma.error, theorem.error),
        ("Theorem 1 with exact completion", completed.exact, exactly.confidence, epsilon, exactly.error),
    ):
        target = features.mean(axis=1)
        if error is None:
            seen = (1 - discount) * jnp.max(jnp.abs(target - expert.features), axis=1)
            rows.append(coverage_of(setting, name, size, confidence, np.full(replications, slack), seen))
        else:
            gaps = expected_gaps(mdp, expert, target, jnp.full_like(target, slack / (1 - discount)))
            rows.append(coverage_of(setting, name, size, confidence, np.full(replications, error), gaps))
    name = "observed variances, predictable, exact completion"
    return rows + _observed_rows(setting, expert, completed.exact, exactly.confidence, True, name)


def learned_coverage(
    key: Array, setting: Setting, replications: int, size: int, draws: int, delta: float, batch: int = 25
) -> list[Coverage]:
    """Check Theorem 2 in LME-I2RL's own form: hidden steps completed under its own weights, exactly.

    The lemma's premise about completions is then not known to hold; the bound is the theorem's for ``draws``
    completions a trajectory. All trajectories come in one session.
    """
    discount, n_features = float(setting.mdp.discount), setting.mdp.n_features
    epsilon, epsilon_s = error_for(size, delta, n_features), error_for(size * draws, delta, n_features)
    theorem = lme_i2rl_confidence(size, size * draws, epsilon, epsilon_s, n_features, discount)
    gaps = learned_gaps(key, setting, setting.sensor, replications, size, theorem.epsilon, batch)
    name = f"{theorem.source}, LME-I2RL"
    return [coverage_of(setting, name, size, theorem.confidence, np.full(replications, theorem.error), gaps)]


def learned_gaps(
    key: Array,
    setting: Setting,
    assumed: AnySensor,
    replications: int,
    size: int,
    slack: float,
    batch: int = 25,
) -> Float[np.ndarray, " replications"]:
    """Compute expected gaps of LME-I2RL with the features statistic and the sensor ``assumed``.

    ``slack`` is the ``epsilon`` of its program; ``size`` trajectories come in one session.
    """
    mdp, expert = setting.mdp, expert_of(setting.mdp, setting.weights)
    learners = fleet(lme_i2rl(mdp, assumed, statistic="features", slack=slack, iterations=50))
    gap = jax.jit(jax.vmap(partial(_gap_of_weights, mdp, expert)))
    walk, begin = jax.random.split(key)
    codes = simulate_codes(walk, mdp, expert, setting.sensor, setting.length, replications, size)
    gaps = []
    for i in range(0, replications, batch):
        part = codes[i : i + batch]
        kind, state, action = jnp.moveaxis(part, -1, 0)
        demonstrations = Demonstration(kind, state, action, jnp.full(kind.shape, jnp.nan))  # type: ignore[arg-type]
        states = learners.init(jax.random.fold_in(begin, i), len(part))
        gaps.append(gap(learners.update(states, demonstrations)[0].weights))
    return np.concatenate(gaps)


def regret_coverage(
    key: Array, setting: Setting, replications: int, c: float, sessions: int, delta: float
) -> list[Coverage]:
    """Check Theorem 3: average regret after every session up to the last, with growing sessions.

    A run is covered if its expected regret is within the bound after each of its sessions; the bound and
    the quantile are those after the last.
    """
    mdp, discount = setting.mdp, float(setting.mdp.discount)
    expert = expert_of(mdp, setting.weights)
    sizes = no_regret_sizes(c, sessions, delta, mdp.n_features, discount)
    regret = no_regret(c, sizes, mdp.n_features, discount)
    total = jnp.zeros((replications, mdp.n_features))
    gaps = []
    for i, size in enumerate(sizes, 1):
        features = simulate_features(
            jax.random.fold_in(key, i), mdp, expert, setting.length, replications, int(size)
        )
        total = total + features.sum(axis=1)
        gaps.append(expected_gaps(mdp, expert, total / sizes[:i].sum(), jnp.full_like(total, c / i)))
    average = np.cumsum(gaps, axis=0) / np.arange(1, sessions + 1)[:, None]
    confidence = float(regret.confidence[-1])
    row = coverage_of(
        setting,
        regret.bound.source,
        sizes.sum(),
        confidence,
        np.full(replications, regret.average[-1]),
        average[-1],
    )
    return [row._replace(covered=float((average <= regret.average[:, None]).all(axis=0).mean()))]


def coverage_table(rows: Sequence[Coverage]) -> pd.DataFrame:
    """Tabulate the rows with their looseness, labelled."""
    table = pd.DataFrame([{**row._asdict(), "looseness": row.looseness} for row in rows])
    return table.set_index(["setting", "result"])


def _gap_of_weights(mdp: TabularMDP, expert: Expert, weights: Float[Array, " K"]) -> Float[Array, ""]:
    return expected_gap(mdp, expert, weights, soft_plan(mdp, reward_of(mdp, weights)).values)


def coverage_of(
    setting: Setting,
    result: str,
    size: int,
    confidence: float,
    bounds: Float[np.ndarray, " replications"],
    seen: Float[ArrayLike, " replications"],
) -> Coverage:
    """Compare the ``seen`` value of each replication with its bound."""
    seen = np.asarray(seen)
    return Coverage(
        setting.name,
        result,
        int(size),
        confidence,
        float((seen <= bounds).mean()),
        float(np.median(bounds)),
        float(np.quantile(seen, confidence, method="higher")),
        len(seen),
    )
