"""Examples of noisy observations: a sensor beside its posterior, one trajectory, and sorted onions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ....domains.noisy.tasks import (
    NoisyDemonstration,
    NoisyTask,
    Starts,
    agreement_probabilities,
    demonstrate_noisy,
)
from ....domains.sorting.line import Line, Share, Tally, sort_belts
from ....domains.sorting.process import pick_inspect_place
from ....inference.completion.smoothing import evidence_of, smooth_all
from ....inference.posteriors.noisy import sample_noisy_posterior
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import FeatureNoise
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, soft_plan
from ...judging.metrics import greedy_policy, optimal_actions, policy_accuracy
from ..sorting.table import EXPERT, Counts, SortingRow, SortingTable

STRIP_STEPS = 12
BELTS = 1000
# The table of Figure 7.9, one belt each; its heading names the last two columns the wrong way round.
PUBLISHED = {
    EXPERT: Counts(7, 0, 12, 5),
    "RIMEO": Counts(8, 1, 11, 4),
    "RIFOM": Counts(8, 3, 9, 4),
    "AIRL": Counts(5, 4, 8, 7),
    "MLIRL": Counts(7, 3, 9, 5),
}


# -- the sensor ---------------------------------------------------------------------------------------


class SensorPosterior(NamedTuple):
    """Agreement of features: by NUTS, by RIMEO, in truth, and in the data.

    Fields
    ------
    names : tuple of str ``[J]``
    draws : float ``[draws, J]``
    learned, truth : float ``[J]``
    happened : float ``[J]``
        Share of the observations learned from that agree with their truth.
    trajectories, divergences : int
        Trajectories learned from; divergent transitions of NUTS.
    reward : float ``[draws, K]`` or None
        Weights of the same draws.
    """

    names: tuple[str, ...]
    draws: Float[np.ndarray, "draws J"]
    learned: Float[np.ndarray, " J"]
    truth: Float[np.ndarray, " J"]
    happened: Float[np.ndarray, " J"]
    trajectories: int
    divergences: int
    reward: Float[np.ndarray, "draws K"] | None = None


def sensor_posterior(
    key: Array,
    task: NoisyTask,
    demonstrated: NoisyDemonstration,
    learned: Float[np.ndarray, " J"],
    pairs: Float[np.ndarray, "S A"],
    *,
    draws: int = 100,
    warmup: int = 100,
) -> SensorPosterior:
    """Sample the joint posterior over reward and reliabilities, each draw turned into agreement among
    ``pairs``.

    Reliabilities are parameters and are no frequencies, so only agreement can be compared with the truth,
    which is no :class:`FeatureNoise`.
    """
    data = sample_noisy_posterior(
        key, demonstrated.mdp, task.features, demonstrated.seen, draws=draws, warmup=warmup, chains=2
    )
    reliabilities = np.asarray(data["posterior"]["reliabilities"]).reshape(-1, len(task.features))
    agreement = np.asarray(_agreement(jnp.asarray(task.features), jnp.asarray(pairs), reliabilities))
    reports, pairs_done = (
        task.features[:, d.state, d.action] for d in (demonstrated.seen, demonstrated.truth)
    )
    return SensorPosterior(
        task.feature_names,
        agreement,
        np.asarray(learned),
        agreement_probabilities(task.noise, task.features, pairs),
        (reports == pairs_done).mean((1, 2)),
        demonstrated.seen.n_trajectories,
        int(np.asarray(data["sample_stats"]["diverging"]).sum()),
        np.asarray(data["posterior"]["weights"]).reshape(len(reliabilities), -1),
    )


@jax.jit
def _agreement(
    features: Int[Array, "J S A"], pairs: Float[Array, "S A"], reliabilities: Float[Array, "draws J"]
) -> Float[Array, "draws J"]:
    """Compute :func:`agreement_probabilities` of many :class:`FeatureNoise`."""

    def one(p: Float[Array, " J"]) -> Float[Array, " J"]:
        return jnp.einsum("sa,jsa->j", pairs / pairs.sum(), FeatureNoise(features, p).agreement())

    return lax.map(one, reliabilities)


# -- one trajectory -----------------------------------------------------------------------------------


class Strip(NamedTuple):
    """One trajectory: as ``seen``, as it was (``truth``), and ``posterior [L, S, A]`` over its pairs."""

    seen: Demonstration
    truth: Demonstration
    posterior: Float[np.ndarray, "L S A"]

    @property
    def believed(self) -> float:
        """Mean posterior probability of the truth, over wrongly observed steps; NaN without."""
        wrong = (self.seen.state != self.truth.state) | (self.seen.action != self.truth.action)
        steps = np.flatnonzero(wrong[0])
        mass = self.posterior[steps, self.truth.state[0, steps], self.truth.action[0, steps]]
        return float(mass.mean()) if len(steps) else math.nan


def strip(
    key: Array,
    task: NoisyTask,
    weights: Float[np.ndarray, " K"],
    reliabilities: Float[np.ndarray, " J"],
    *,
    starts: Starts = "natural",
    steps: int = STRIP_STEPS,
) -> Strip:
    """Complete a fresh trajectory with a learned reward and sensor."""
    drawn = demonstrate_noisy(key, task, sessions=1, trajectories=1, steps=steps, starts=starts)
    sensor = FeatureNoise(task.features, np.asarray(reliabilities))
    pairs = _interpreted(drawn.mdp, sensor, jnp.asarray(weights), drawn.seen)
    return Strip(drawn.seen, drawn.truth, np.asarray(pairs)[0])


@jax.jit
def _interpreted(
    mdp: TabularMDP, sensor: FeatureNoise, weights: Float[Array, " K"], seen: Demonstration
) -> Float[Array, "n L S A"]:
    plan = soft_plan(mdp, reward_of(mdp, weights))
    return smooth_all(mdp, plan.log_policy, evidence_of(mdp, sensor, seen)).pairs


# -- sorting ------------------------------------------------------------------------------------------


def sorted_belts(
    key: Array,
    task: NoisyTask,
    learned: Mapping[str, Float[np.ndarray, "replications K"]],
    *,
    belts: int = BELTS,
) -> SortingTable:
    """Tally the expert's and the learned policies on simulated belts, beside the table of Figure 7.9.

    The replications of a method share about ``belts`` belts, equally many each and at least one. Its tally
    has one entry a replication, the sum over its belts: belts sorted with one policy are not independent. A
    method whose name begins with that of a published row has it beside it.
    """
    sorting, line = pick_inspect_place(), Line()
    optimal = optimal_actions(task.mdp, jnp.asarray(task.weights))
    expert = sort_belts(key, sorting, task.expert_policy, belts, line)
    rows = [SortingRow(EXPERT, sorting.behaviours[0], expert, 1.0, 1.0, PUBLISHED[EXPERT])]
    taken = {EXPERT}
    for method, weights in learned.items():
        each = max(belts // len(weights), 1)
        sums, accuracy = [], []
        for run, w in enumerate(weights):
            policy = np.asarray(greedy_policy(task.mdp, jnp.asarray(w)))
            counted = sort_belts(jax.random.fold_in(key, run), sorting, policy, each, line)
            sums.append([int(np.sum(count)) for count in counted])
            accuracy.append(policy_accuracy(task.mdp, optimal, jnp.asarray(policy)))
        overall, choice = np.mean(accuracy, axis=0)
        published = next((p for p in PUBLISHED if method.startswith(p) and p not in taken), None)
        taken |= {published} if published else set()
        rows.append(
            SortingRow(
                method,
                sorting.behaviours[0],
                Tally(*np.array(sums).T),
                float(overall),
                float(choice),
                PUBLISHED[published] if published else None,
            )
        )
    return SortingTable(tuple(rows), belts, line, 0.95)


def per_belt(row: SortingRow) -> tuple[float, ...]:
    """Compute the mean TP, FP, TN and FN of a belt, from sums over any number of belts."""
    line = Line()
    onions = sum(row.tally.means)
    return tuple(mean * line.sets * line.onions / onions for mean in row.tally.means)


def _sorting_runs(table: SortingTable, row: SortingRow) -> str:
    """Count the replications that have at least half the expert's recall."""
    if row.method == EXPERT:
        return ""
    enough = table.rows[0].tally.recall().value / 2
    blemished = row.tally.true_positives + row.tally.false_negatives
    return f"{(row.tally.true_positives >= enough * blemished).sum()} of {len(blemished)}"


HEADINGS = (
    "method",
    "belts",
    "TP, FP, TN, FN",
    "precision, %",
    "recall, %",
    "replications that sort",
    "LBA, %",
)


def belt_cells(table: SortingTable) -> list[tuple[str, ...]]:
    """Format the rows as text under :data:`HEADINGS`, published ones beside ours, and those we have no row
    for.
    """

    def percent(share: Share, digits: int) -> str:
        if math.isnan(share.value):
            return "-"
        low, high = (f"{100 * x:.{digits}f}" for x in share[1:])
        return f"{100 * share.value:.1f} ({low}-{high})"

    def measures(counted: Any, digits: int) -> tuple[str, str]:
        return percent(counted.precision(table.level), digits), percent(counted.recall(table.level), digits)

    lines: list[tuple[str, ...]] = []
    for row in table.rows:
        means = ", ".join(f"{mean:.1f}" for mean in per_belt(row))
        accuracy = f"{100 * row.choice_accuracy:.0f}"
        lines.append(
            (row.method, "simulated", means, *measures(row.tally, 1), _sorting_runs(table, row), accuracy)
        )
        if row.published is not None:
            counts = ", ".join(map(str, row.published))
            lines.append(("", "dissertation", counts, *measures(row.published, 0), "", ""))
    counts = ", ".join(map(str, PUBLISHED["AIRL"]))
    lines.append(("AIRL", "dissertation", counts, *measures(PUBLISHED["AIRL"], 0), "", ""))
    return lines
