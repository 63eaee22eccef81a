"""Study of onion sorting with several behaviours (Figure 7.8, Table 7.2): recovery, data and time of each
method.

Batch and online MME-MTIRL and the baselines learn two or three behaviours from the same mixed trajectories.
Learning is timed after a first call that compiles.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ....domains.sorting.process import Sorting, demonstrate_sorting, sorting_with_claiming
from ....inference.learners.dpm import dpm_birl
from ....inference.learners.maximum_likelihood import em_mlirl
from ....inference.learners.mtirl import (
    DEFAULT_COMPONENTS,
    DEFAULT_RESTARTS,
    assign_trajectories,
    batch_mme_mtirl,
    mme_mtirl,
)
from ....inference.mixtures.clustering import Clustering
from ....inference.sessions.learner import Learner
from ....models.observation.demonstration import Demonstration
from ....models.process.mdp import TabularMDP
from ...judging.multi_task import (
    adjusted_rand_index,
    assignment_accuracy,
    expected_value_difference,
    match_components,
)
from .table import SortingTable, table_7_2

Advance = Callable[[str, float | None], None]
# Of the dissertation: numbers of trajectories for two and three tasks, and steps of each.
GRID = {2: (4, 8, 16, 32, 64, 128), 3: (6, 12, 24, 48, 96, 192)}
STEPS = 50
# Fewer, since every method is compiled for every number of trajectories.
FEW = {2: (4, 8, 16), 3: (6, 12, 24)}

BATCH, ONLINE, DPM, EM, EM_UNKNOWN = "mme-mtirl", "online", "dpm-birl", "em-mlirl", "em-mlirl-unknown"
METHODS = {
    BATCH: "MME-MTIRL",
    ONLINE: "online MME-MTIRL",
    DPM: "DPM-BIRL",
    EM: "EM-MLIRL",
    EM_UNKNOWN: "EM-MLIRL, number unknown",
}


class Measures(NamedTuple):
    """Measures of a method, each ``[replications, T]``.

    Fields
    ------
    value_difference : float
        EVD, in units of discounted true reward, a trajectory.
    n_components : int
        Components that are the likeliest of some trajectory.
    accuracy : float
        Share of trajectories rightly assigned, under the best matching.
    rand : float
        Adjusted Rand index.
    seconds : float
        Of learning, compilation left out; online: of all sessions so far.
    """

    value_difference: Float[np.ndarray, "replications T"]
    n_components: Int[np.ndarray, "replications T"]
    accuracy: Float[np.ndarray, "replications T"]
    rand: Float[np.ndarray, "replications T"]
    seconds: Float[np.ndarray, "replications T"]


class MethodResult(NamedTuple):
    """One method.

    Fields
    ------
    name : str
    trajectories : int ``[T]``
        How many it had learned from when it was measured.
    measures : Measures
    found : Clustering
        Its assignment of all trajectories of the first replication.
    """

    name: str
    trajectories: Int[np.ndarray, " T"]
    measures: Measures
    found: Clustering


class SortingStudy(NamedTuple):
    """Settings, results, and Table 7.2 with the weights of the first replication.

    Fields
    ------
    sorting : Sorting
    tasks, n_components, steps, replications, seed : int
        Behaviours demonstrated; components that learners begin with; steps of a trajectory.
    counts : int ``[T]``
        Numbers of trajectories that batch methods learn from.
    sessions : int ``[J]``
        Trajectories that the online learner has seen at the end of each session.
    results : tuple of MethodResult
    one_component : float
        EVD of the best single behaviour for all trajectories of the first replication: the best of a learner
        with one component.
    demonstration, labels
        All trajectories of the first replication, and their behaviours.
    table : SortingTable
    """

    sorting: Sorting
    tasks: int
    n_components: int
    steps: int
    replications: int
    seed: int
    counts: Int[np.ndarray, " T"]
    sessions: Int[np.ndarray, " J"]
    results: tuple[MethodResult, ...]
    one_component: float
    demonstration: Demonstration
    labels: Int[np.ndarray, " n"]
    table: SortingTable

    @property
    def online_share(self) -> float | None:
        """Seconds of all online sessions over those of batch after each session, median over replications.

        None if the two were not both measured at the same numbers of trajectories.
        """
        by_name = {result.name: result for result in self.results}
        batch, online = (by_name.get(METHODS[method]) for method in (BATCH, ONLINE))
        if batch is None or online is None or not np.array_equal(self.counts, self.sessions):
            return None
        return float(np.median(online.measures.seconds[:, -1] / batch.measures.seconds.sum(1)))


class _Stream(NamedTuple):
    """One run: every prefix has about as many trajectories of each behaviour, in random order."""

    key: Array
    demonstration: Demonstration
    labels: Int[np.ndarray, " n"]


class Design(NamedTuple):
    """Independent ``replications`` from a ``seed``, ``steps`` a trajectory, and ``belts`` of Table 7.2."""

    replications: int = 3
    seed: int = 0
    steps: int = STEPS
    belts: int = 300


class DesignOptions(TypedDict, total=False):
    """:class:`Design` as keyword arguments."""

    replications: int
    seed: int
    steps: int
    belts: int


def sorting_study(
    tasks: int = 2,
    counts: Sequence[int] | None = None,
    *,
    methods: Sequence[str] | None = None,
    sessions: int | None = None,
    n_components: int = DEFAULT_COMPONENTS,
    advance: Advance = lambda description, fraction: None,
    **design: Unpack[DesignOptions],
) -> SortingStudy:
    """Learn the sorters' behaviours with every method, from growing numbers of the same trajectories.

    Parameters
    ----------
    tasks : int
        2 (pick-inspect-place, roll-pick-place) or 3 (keep claiming as well).
    counts : sequence of int, optional
        Numbers of trajectories, about as many of each behaviour. By default :data:`FEW` of them;
        :data:`GRID` has the dissertation's.
    methods : sequence of str, optional
        Keys of :data:`METHODS`, all by default. EM-MLIRL is given the true number of components, as in the
        dissertation, or ``n_components`` of them like MME-MTIRL; both from as many starts as that.
    sessions : int, optional
        The online learner's, equal in size. By default its sessions end at ``counts``, as in the
        dissertation.
    n_components : int
        Components that MME-MTIRL starts with: the most it can find.
    replications, seed : int
        Independent repetitions, 3 by default. A smaller number of trajectories is the beginning of a larger
        one's.
    steps : int
        Of a trajectory, 50 by default.
    belts : int
        Simulated belts of Table 7.2, 300 by default.

    Raises
    ------
    ValueError
        For numbers that make no study, saying which.

    See Also
    --------
    i2rl.domains.demonstrate_sorting : its trajectories
    i2rl.inference.mme_mtirl : its online learner
    i2rl.analysis.expected_value_difference : its measure

    Examples
    --------
    >>> from i2rl.analysis import sorting_study
    >>> study = sorting_study(2, [4], replications=1, methods=["em-mlirl"], steps=10, belts=10)
    >>> [(result.name, result.trajectories.tolist()) for result in study.results]
    [('EM-MLIRL', [4])]
    """
    replications, seed, steps, belts = plan = Design(**design)
    _check(tasks, counts, plan, methods, sessions, n_components)
    sizes = np.array(sorted(set(FEW[tasks] if counts is None else counts)))
    most = int(sizes[-1])
    ends = sizes if sessions is None else np.linspace(0, most, sessions + 1).round().astype(int)[1:]
    sorting = sorting_with_claiming()
    walk, belt = jax.random.split(jax.random.key(seed))
    borders = np.union1d(sizes, ends)
    streams = [
        _stream(jax.random.fold_in(walk, run), sorting, tasks, borders, steps) for run in range(replications)
    ]
    chosen = [name for name in METHODS if methods is None or name in methods]
    results = []
    for i, method in enumerate(chosen):

        def tell(what: str, share: float, i: int = i, method: str = method) -> None:
            advance(f"{METHODS[method]}: {what}", (i + share) / len(chosen))

        if method == ONLINE:
            learner = mme_mtirl(sorting.mdp, n_components=n_components)
            measured = _online(sorting, tasks, learner, ends, streams, tell)
        else:
            fits = _batch_fits(sorting.mdp, method, tasks, n_components, sizes)
            with warnings.catch_warnings():
                # The results state once that fewer trajectories than components give fewer components.
                warnings.filterwarnings("ignore", ".* is [0-9]+, but there are [0-9]+ trajectories")
                measured = _batch(sorting, tasks, METHODS[method], fits, streams, tell)
        results.append(measured)
    advance("sorting belts", None)
    first = streams[0]
    learned = {result.name: _behaviours_of(first.labels, result.found)[:2] for result in results}
    table = table_7_2(belt, sorting, learned, belts=belts)
    advance("done", 1.0)
    return SortingStudy(
        sorting,
        tasks,
        n_components,
        steps,
        replications,
        seed,
        sizes,
        ends,
        tuple(results),
        _one_component(sorting, tasks, first),
        first.demonstration,
        first.labels,
        table,
    )


def counts_of(tasks: int, text: str | None) -> tuple[int, ...] | None:
    """Parse numbers of trajectories from ``8,16,32``, or ``all`` of :data:`GRID`; None stays None.

    Raises ``ValueError`` for anything else.
    """
    if text is None:
        return None
    if text.strip() == "all":
        return GRID.get(tasks, ())
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"numbers of trajectories are whole numbers such as 8,16,32, or all, got {text!r}"
        ) from None


def _check(
    tasks: int,
    counts: Sequence[int] | None,
    design: Design,
    methods: Sequence[str] | None,
    sessions: int | None,
    n_components: int,
) -> None:
    if tasks not in GRID:
        raise ValueError(
            f"tasks must be 2 (pick-inspect-place and roll-pick-place) or 3 (and keep claiming), got {tasks}"
        )
    for name, number in (
        ("n_components", n_components),
        ("replications", design.replications),
        ("steps", design.steps),
        ("belts", design.belts),
    ):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    counts = FEW[tasks] if counts is None else counts
    if not len(counts):
        raise ValueError("at least one number of trajectories is needed, got none")
    if min(counts) < tasks:
        raise ValueError(
            f"{tasks} tasks need at least {tasks} trajectories, one of each; got {min(counts)} among the "
            "numbers of trajectories"
        )
    if sessions is not None and not 1 <= sessions <= max(counts):
        raise ValueError(
            f"sessions must be at least 1 and at most the {max(counts)} trajectories, got {sessions}"
        )
    if methods is not None and not methods:
        raise ValueError(f"at least one method is needed: {', '.join(METHODS)}")
    unknown = [name for name in methods or () if name not in METHODS]
    if unknown:
        raise ValueError(f"methods are {', '.join(METHODS)}; got {unknown[0]!r}")


def _stream(key: Array, sorting: Sorting, tasks: int, borders: Int[np.ndarray, " T"], steps: int) -> _Stream:
    """Simulate trajectories in turn, mixed up between one border and the next."""
    walk, order, learn = jax.random.split(key, 3)
    most = int(borders[-1])
    counts = [len(range(b, most, tasks)) for b in range(tasks)]
    demonstration, labels = demonstrate_sorting(walk, sorting, counts, steps)
    # What is learned from at any time is balanced so.
    turn = np.argsort(np.concatenate([np.arange(n) for n in counts]), kind="stable")
    rng = np.random.default_rng(np.asarray(jax.random.key_data(order)))
    rows = np.concatenate([rng.permutation(part) for part in np.split(turn, borders[:-1])])
    return _Stream(learn, demonstration.select(rows), labels[rows])


# -- learning -----------------------------------------------------------------------------------------


def _batch_fits(
    mdp: TabularMDP, method: str, tasks: int, n_components: int, sizes: Int[np.ndarray, " T"]
) -> dict[int, Callable[[Array, Demonstration], Clustering]]:
    if method == BATCH:
        return dict.fromkeys(sizes.tolist(), batch_mme_mtirl(mdp, n_components=n_components).fit)
    if method == DPM:
        return dict.fromkeys(sizes.tolist(), dpm_birl(mdp).fit)
    given = tasks if method == EM else n_components
    # EM requires at most as many components as trajectories.
    return {
        n: em_mlirl(mdp, n_components=min(given, n), restarts=DEFAULT_RESTARTS).fit for n in sizes.tolist()
    }


def _batch(
    sorting: Sorting,
    tasks: int,
    name: str,
    fits: dict[int, Callable[[Array, Demonstration], Clustering]],
    streams: Sequence[_Stream],
    tell: Callable[[str, float], None],
) -> MethodResult:
    columns = []
    for i, (n, fit) in enumerate(fits.items()):
        column = []
        for run, stream in enumerate(streams):
            tell(f"{n} trajectories", (i + run / len(streams)) / len(fits))
            part = stream.demonstration.select(slice(0, n))
            # Other starts for every size: one unlucky start must not spoil a whole curve.
            key = jax.random.fold_in(stream.key, n)
            if run == 0:
                last = fit(key, part)
            began = time.perf_counter()
            found = fit(key, part)
            seconds = time.perf_counter() - began
            column.append(_judged(sorting, tasks, stream.labels[:n], part, found, seconds))
        columns.append(column)
    return MethodResult(name, np.array(list(fits)), _measures(columns), last)


def _online(
    sorting: Sorting,
    tasks: int,
    learner: Learner,
    ends: Int[np.ndarray, " J"],
    streams: Sequence[_Stream],
    tell: Callable[[str, float], None],
) -> MethodResult:
    starts = np.concatenate([[0], ends[:-1]])
    rows, finals = [], []
    for run, stream in enumerate(streams):
        # The first stream twice: compiled in one, timed in the other.
        for timed in (False, True) if run == 0 else (True,):
            state, seconds, row = learner.init(stream.key), 0.0, []
            for j, (start, end) in enumerate(zip(starts, ends, strict=True)):
                tell(f"session {j + 1}", (run + j / len(ends)) / len(streams))
                session = stream.demonstration.select(slice(start, end))
                began = time.perf_counter()
                state, report = learner.update(state, session)
                seconds += time.perf_counter() - began
                if timed:
                    so_far = stream.demonstration.select(slice(0, end))
                    found = _explained(sorting.mdp, state, float(report.log_likelihood), so_far)
                    row.append(_judged(sorting, tasks, stream.labels[:end], so_far, found, seconds))
        rows.append(row)
        finals.append(found)
    columns = list(zip(*rows, strict=True))
    return MethodResult(METHODS[ONLINE], ends, _measures(columns), finals[0])


def _explained(
    mdp: TabularMDP, state: Any, log_likelihood: float, demonstration: Demonstration
) -> Clustering:
    """Explain all trajectories so far by an online learner's current state; it holds none of them."""
    proportions = np.asarray(state.proportions)
    present = np.argsort(-proportions, kind="stable")[: np.count_nonzero(proportions)]
    shares = assign_trajectories(mdp, None, state.weights, proportions, demonstration)[:, present]
    return Clustering(
        np.asarray(state.weights)[present], proportions[present], shares, log_likelihood * len(shares)
    )


def _judged(
    sorting: Sorting,
    tasks: int,
    labels: Int[np.ndarray, " n"],
    demonstration: Demonstration,
    found: Clustering,
    seconds: float,
) -> tuple[float, ...]:
    assignments = found.assignments
    evd = expected_value_difference(
        sorting.mdp, sorting.weights[:tasks], labels, found.weights, assignments, demonstration
    )
    return (
        evd,
        len(np.unique(assignments)),
        assignment_accuracy(labels, assignments),
        adjusted_rand_index(labels, assignments),
        seconds,
    )


def _measures(columns: Sequence[Sequence[tuple[float, ...]]]) -> Measures:
    """Collect measures from rows of numbers by column and replication."""
    evd, n_components, accuracy, rand, seconds = np.array(columns, float).transpose(2, 1, 0)
    return Measures(evd, n_components.astype(int), accuracy, rand, seconds)


def _behaviours_of(labels: Int[np.ndarray, " n"], found: Clustering) -> Float[np.ndarray, "B K"]:
    """Return the learned weights of each behaviour: its component's, or that of most of its trajectories."""
    assignments = found.assignments
    matched = match_components(labels, assignments)
    rows = [
        matched.get(int(b), int(np.bincount(assignments[labels == b]).argmax())) for b in np.unique(labels)
    ]
    return found.weights[rows]


def _one_component(sorting: Sorting, tasks: int, stream: _Stream) -> float:
    nobody_told_apart = np.zeros(len(stream.labels), int)
    return min(
        expected_value_difference(
            sorting.mdp,
            sorting.weights[:tasks],
            stream.labels,
            weights[None],
            nobody_told_apart,
            stream.demonstration,
        )
        for weights in sorting.weights[:tasks]
    )
