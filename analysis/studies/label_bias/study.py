"""Label bias (Table 5.1): does a likelier trajectory earn more? Under MaxEnt always, under BIRL it depends.

Object World with deterministic moves, a finite number of steps and no discount in a trajectory's total
reward, where the law of maximum entropy is ``P(X) = exp(reward(X)) / Z`` exactly; ``Z`` sums over where a
trajectory begins as well. Bayesian IRL multiplies ``pi(a | s) ~ exp(rationality Q*(s, a))`` over the pairs,
each normalised over the actions of its own state: this adds the number of choices on the path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from scipy import stats

from ....domains.object_world.process import ObjectWorld, random_object_world, without_blocked_moves
from ....domains.sorting.line import Share, wilson
from ....inference.learners.boltzmann import boltzmann_log_policy, optimal_action_values
from ....models.process.mdp import Labels, TabularMDP
from ....models.process.planning import finite_soft_plan, greedy_actions, reward_of
from ...drawing.text import number

Advance = Callable[[str, float | None], None]
# What the dissertation prints for Bayesian IRL.
PRINTED_RHO, PRINTED_P = 0.1771, 0.2914
LEVEL = 0.05
WALLS, STEPS, DISCOUNT = 25, 10, 0.99
# Inverse temperatures of the sweep.
ETAS = (0.1, 0.3, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0)
EXPERTS = ("Boltzmann", "optimal", "maximum entropy")
BOLTZMANN, OPTIMAL, MAXENT = EXPERTS


class Setting(NamedTuple):
    """One choice of the settings that the dissertation leaves open.

    ``expert`` demonstrates: ``Boltzmann`` follows the very law that BIRL scores with, ``optimal`` shares its
    steps evenly among the best actions, ``maximum entropy`` follows the law that MaxEnt scores with.
    ``rationality`` and ``discount`` are BIRL's. ``blocked`` says whether moves against walls are actions.
    """

    expert: str = BOLTZMANN
    rationality: float = 1.0
    discount: float = DISCOUNT
    steps: int = STEPS
    blocked: bool = True

    @property
    def name(self) -> str:
        """For example ``Boltzmann experts, rationality 1``; settings equal to the first are left out."""
        parts = [f"{self.expert} experts", f"eta {self.rationality:g}"]
        parts += [f"discount {self.discount:g}"] * (self.discount != DISCOUNT)
        parts += [f"{self.steps} steps"] * (self.steps != STEPS)
        parts += ["only open moves"] * (not self.blocked)
        return ", ".join(parts)


# The first is as near to the dissertation as its text leads: it writes exp(Q), so eta is 1; 0.99 is the
# discount of its other domains; the experts are those BIRL believes in. Walls and steps it does not give: the
# number of steps matters (see the other settings), that of walls hardly.
FIRST = Setting()
SETTINGS = (
    FIRST,
    Setting(rationality=10.0),
    Setting(OPTIMAL),
    Setting(OPTIMAL, rationality=10.0),
    Setting(MAXENT),
    Setting(steps=20),
    Setting(discount=0.9),
    Setting(blocked=False),
    Setting(OPTIMAL, rationality=10.0, blocked=False),
)


class Trajectories(NamedTuple):
    """Expert trajectories and their statistics.

    ``states, actions [n, T]``; ``reward [n]`` undiscounted; ``maxent`` and ``birl [n]`` log-likelihoods in
    nats (BIRL's without the start, which it has no law for); ``choice [n]``, the nats that BIRL subtracts for
    choices on the path, ``sum_t log sum_a exp(rationality (Q(s_t, a) - max Q(s_t)))``. BIRL is
    ``rationality`` times the sum of advantages, less ``choice``.
    """

    states: Int[Array, "n T"]
    actions: Int[Array, "n T"]
    reward: Float[Array, " n"]
    maxent: Float[Array, " n"]
    birl: Float[Array, " n"]
    choice: Float[Array, " n"]


class Correlation(NamedTuple):
    """Pearson's ``rho`` of ``n`` pairs, its two-sided ``p``, and a 95 % confidence interval."""

    rho: float
    p: float
    low: float
    high: float
    n: int


class SettingResult(NamedTuple):
    """A setting's correlations with total reward in every world, ``[worlds]``; NaN where all earn alike."""

    setting: Setting
    birl: Float[np.ndarray, " worlds"]
    p: Float[np.ndarray, " worlds"]
    maxent: Float[np.ndarray, " worlds"]
    choice: Float[np.ndarray, " worlds"]

    @property
    def significant(self) -> Share:
        """Share of the worlds with a correlation in which BIRL's is significant at 0.05."""
        return _share(self.p < LEVEL, self.p)

    @property
    def negative(self) -> Share:
        """Share of the worlds with a correlation in which BIRL's is significant and negative."""
        return _share((self.p < LEVEL) & (self.birl < 0), self.p)


def _share(which: np.ndarray, p: np.ndarray) -> Share:
    known = np.isfinite(p)
    return wilson(float(np.sum(which & known)), float(np.sum(known)))


class LabelBiasStudy(NamedTuple):
    """Settings and results; ``sweep`` holds a result for each of ``rationalities``, for both kinds of walls.

    ``world``, ``trajectories`` and the two correlations are those of the world whose BIRL correlation in the
    first setting is the median over worlds (the lower one of two).
    """

    worlds: int
    per_world: int
    walls: int
    seed: int
    results: tuple[SettingResult, ...]
    rationalities: tuple[float, ...]
    sweep: dict[bool, tuple[SettingResult, ...]]
    world: ObjectWorld
    trajectories: Trajectories
    birl: Correlation
    maxent: Correlation


def label_bias_study(
    worlds: int = 100,
    trajectories: int = 75,
    *,
    walls: int = WALLS,
    seed: int = 0,
    settings: Sequence[Setting] = SETTINGS,
    rationalities: Sequence[float] = ETAS,
    advance: Advance = lambda description, fraction: None,
) -> LabelBiasStudy:
    """Correlate log-likelihood and total reward of expert trajectories, in many worlds and settings.

    The first of ``settings`` is the one that is shown. Raises ``ValueError`` for no world, fewer than four
    trajectories (their correlation has no interval), no setting, and where no world of the first setting has
    a correlation.

    See Also
    --------
    i2rl.domains.random_object_world : one of its worlds
    i2rl.inference.birl : the learner it is about

    Examples
    --------
    >>> from i2rl.analysis import label_bias_study
    >>> from i2rl.analysis.studies.label_bias.study import FIRST
    >>> study = label_bias_study(3, 20, settings=[FIRST], rationalities=[1.0])
    >>> [result.setting.name for result in study.results], study.results[0].birl.shape
    (['Boltzmann experts, eta 1'], (3,))
    """
    if worlds < 1 or trajectories < 4 or not settings:
        raise ValueError(
            "the study needs at least 1 world, 4 trajectories a world and 1 setting, "
            f"got {worlds}, {trajectories} and {len(settings)}"
        )
    layout, walk = jax.random.split(jax.random.key(seed))
    drawn = [random_object_world(key, walls=walls) for key in jax.random.split(layout, worlds)]
    stacked = {
        True: _stacked([world.mdp for world in drawn]),
        False: _stacked([without_blocked_moves(world).mdp for world in drawn]),
    }
    weights = jnp.asarray(drawn[0].weights)
    keys = jax.random.split(walk, worlds)
    stages = len(settings) + 2 * len(rationalities)
    results, first = [], None
    for i, setting in enumerate(settings):
        advance(setting.name, i / stages)
        walked = _in_every_world(
            keys,
            stacked[setting.blocked],
            weights,
            setting.rationality,
            setting.discount,
            _expert_code(setting.expert),
            steps=setting.steps,
            n=trajectories,
        )
        first = walked if first is None else first
        results.append(_result(setting, walked))
    sweep = {}
    for j, (blocked, mdps) in enumerate(stacked.items()):
        rows = []
        for i, rationality in enumerate(rationalities):
            advance(f"eta {rationality:g}", (len(settings) + j * len(rationalities) + i) / stages)
            walked = _in_every_world(
                keys,
                mdps,
                weights,
                rationality,
                DISCOUNT,
                _expert_code(BOLTZMANN),
                steps=STEPS,
                n=trajectories,
            )
            rows.append(_result(Setting(rationality=rationality, blocked=blocked), walked))
        sweep[blocked] = tuple(rows)
    shown = _median_world(results[0].birl)
    of_world: Trajectories = jax.tree.map(lambda x: x[shown], first)
    advance("done", 1.0)
    return LabelBiasStudy(
        worlds,
        trajectories,
        walls,
        seed,
        tuple(results),
        tuple(rationalities),
        sweep,
        drawn[shown] if settings[0].blocked else without_blocked_moves(drawn[shown]),
        of_world,
        correlation(np.asarray(of_world.birl), np.asarray(of_world.reward)),
        correlation(np.asarray(of_world.maxent), np.asarray(of_world.reward)),
    )


def correlation(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> Correlation:
    """Compute Pearson's correlation of two samples. Raises ``ValueError`` if one of them is constant."""
    if min(_spread(x), _spread(y)) == 0:
        raise ValueError("one of the two samples is constant: there is no correlation to speak of")
    result = stats.pearsonr(x, y)
    interval = result.confidence_interval(0.95)
    return Correlation(
        float(result.statistic), float(result.pvalue), float(interval.low), float(interval.high), len(x)
    )


def _spread(x: np.ndarray) -> float:
    """Compute the standard deviation; zero if it is no more than rounding."""
    spread = float(np.std(x))
    return spread if spread > 1e-12 * (1 + float(np.abs(x).max())) else 0.0


def significance(rho: float, n: int) -> float:
    """Compute the two-sided p-value of a Pearson correlation ``rho`` of ``n`` pairs."""
    return float(2 * stats.t.sf(abs(rho) * np.sqrt((n - 2) / (1 - rho**2)), n - 2))


def _result(setting: Setting, walked: Trajectories) -> SettingResult:
    rows = []
    for i in range(len(walked.reward)):
        reward = np.asarray(walked.reward[i])
        scores = [np.asarray(score[i]) for score in (walked.birl, walked.maxent, walked.choice)]
        rows.append(
            [
                correlation(x, reward)
                if min(_spread(x), _spread(reward)) > 0
                else Correlation(np.nan, np.nan, np.nan, np.nan, len(reward))
                for x in scores
            ]
        )
    birl, maxent, choice = zip(*rows, strict=True)
    return SettingResult(
        setting,
        np.array([c.rho for c in birl]),
        np.array([c.p for c in birl]),
        np.array([c.rho for c in maxent]),
        np.array([c.rho for c in choice]),
    )


def _median_world(rho: Float[np.ndarray, " worlds"]) -> int:
    order = np.argsort(rho)  # NaN last
    known = int(np.isfinite(rho).sum())
    if not known:
        raise ValueError("in no world of the first setting do trajectories differ in likelihood and reward")
    return int(order[(known - 1) // 2])


def _stacked(mdps: Sequence[TabularMDP]) -> TabularMDP:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(_bare, mdps))


def _bare(mdp: TabularMDP) -> TabularMDP:
    """Remove unused parts that differ in kind from world to world, so that one program serves them all."""
    return replace(mdp.without_inflow(), labels=Labels())


@partial(jax.jit, static_argnames=("steps", "n"))
def _in_every_world(
    keys: Array,
    mdps: TabularMDP,
    weights: Float[Array, " K"],
    rationality: float,
    discount: float,
    expert: int,
    *,
    steps: int,
    n: int,
) -> Trajectories:
    return lax.map(
        lambda world: demonstrate_and_score(
            world[0], replace(world[1], discount=discount), weights, rationality, expert, steps, n
        ),
        (keys, mdps),
    )


def _expert_code(expert: str) -> int:
    if expert not in EXPERTS:
        raise ValueError(f"expert must be one of {', '.join(EXPERTS)}, got {expert!r}")
    return EXPERTS.index(expert)


@partial(jax.jit, static_argnames=("steps", "n"))
def demonstrate_and_score(
    key: Array,
    mdp: TabularMDP,
    weights: Float[Array, " K"],
    rationality: float,
    expert: int,
    steps: int,
    n: int,
) -> Trajectories:
    """Draw ``n`` trajectories of ``steps`` pairs from one of ``EXPERTS`` and score them under both laws.

    Boltzmann and optimal experts begin in a cell drawn from the initial distribution; where those of maximum
    entropy begin is part of their law.
    """
    reward = reward_of(mdp, weights)
    law = finite_soft_plan(replace(mdp, discount=jnp.ones(())), reward, steps)
    values = optimal_action_values(mdp, weights)
    boltzmann = boltzmann_log_policy(mdp, weights, rationality)
    best = greedy_actions(values)
    optimal = jnp.log(best / best.sum(1, keepdims=True))
    begins = jax.nn.log_softmax(law.values[0])
    # The expert is a number and not a kind of function, so that all of them are compiled once.
    start = jnp.stack([jnp.log(mdp.initial), jnp.log(mdp.initial), begins])[expert]
    unchanging = jnp.broadcast_to(jnp.stack([boltzmann, optimal])[:, None], (2, *law.log_policy.shape))
    policies = jnp.concatenate([unchanging, law.log_policy[None]])[expert]
    states, actions = jax.vmap(lambda k: _walk(k, mdp, start, policies))(jax.random.split(key, n))
    choices = jax.nn.logsumexp(rationality * (values - values.max(1, keepdims=True)), axis=1)
    return Trajectories(
        states,
        actions,
        reward[states, actions].sum(1),
        begins[states[:, 0]] + law.log_policy[jnp.arange(steps), states, actions].sum(1),
        boltzmann[states, actions].sum(1),
        choices[states].sum(1),
    )


def _walk(
    key: Array, mdp: TabularMDP, start: Float[Array, " S"], policies: Float[Array, "T S A"]
) -> tuple[Int[Array, " T"], Int[Array, " T"]]:
    first, key = jax.random.split(key)

    def step(state: Int[Array, ""], given: tuple) -> tuple:
        key, policy = given
        act, move = jax.random.split(key)
        action = jax.random.categorical(act, policy[state])
        branch = jax.random.categorical(move, jnp.log(mdp.probabilities[state, action]))
        return mdp.successors[state, action, branch], (state, action)

    state = jax.random.categorical(first, start).astype(mdp.successors.dtype)
    return lax.scan(step, state, (jax.random.split(key, len(policies)), policies))[1]


def quantiles(rho: Float[np.ndarray, " worlds"]) -> tuple[float, float, float]:
    """Compute the 5 %, 50 % and 95 % quantiles over the worlds with a correlation; NaN if there is none."""
    known = rho[np.isfinite(rho)]
    low, median, high = np.quantile(known, (0.05, 0.5, 0.95)) if len(known) else [np.nan] * 3
    return float(low), float(median), float(high)


def tell_p(p: float) -> str:
    """Write a p-value to four digits; a smaller one as the power of ten it is below."""
    if p >= 1e-4:
        return f"{p:.4f}"
    return f"< {number(10.0 ** int(np.ceil(np.log10(p))))}" if p > 1e-300 else f"< {number(1e-300)}"
