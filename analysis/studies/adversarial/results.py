"""Results of a study of adversarial learners, as plain arrays for figures and tables.

Results have one :class:`AdversarialResults` a domain; one :class:`MethodResult` a method, under its name from
:data:`METHODS`, with one row a replication and one column a session. Replication ``i`` has the same seed for
all methods. Fields without use in a domain stay None or empty, and their figures and tables are left out.
Results can be stored and loaded (:func:`store_results`, :func:`load_results`), so that a study may run on one
machine and its page be written on another.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ....models.inputs.archives import StorageError
from ....models.inputs.text import parsed_json, shortened
from ...judging.returns import (
    Correlation,
    EmpiricalILE,
    Interval,
    Recovery,
    RewardCorrelation,
    recovered_share,
    reward_correlation,
)

if TYPE_CHECKING:
    from ....domains.robots.walkers import Locomotion

CLEAN, NOISY = "AIRL, clean input", "AIRL, noisy input"
ROBUST, SSRR = "robust-AIRL, noisy input", "SSRR + noisy-AIRL, noisy input"
LEARNED = "robust-AIRL, sensor learned"
METHODS = (CLEAN, NOISY, ROBUST, SSRR, LEARNED)

DOMAINS = {
    "patrol": "Patrol",
    "mountain-car": "Mountain car",
    "hopper": "Hopper",
    "walker2d": "Walker2d",
    "half-cheetah": "HalfCheetah",
    "onion": "Onion sorting, continuous",
}
"""Names on the command line, and on the page."""

_DRAWN_STEPS = 1500


class MethodResult(NamedTuple):
    """One method on all replications.

    Fields
    ------
    pairs : int ``[T]``
        Reported state-action pairs seen after each session.
    accuracy : float ``[replications, T]`` or None
        LBA in [0, 1], over the states that :attr:`AdversarialResults.accuracy_over` says.
    returns : float ``[replications, T]`` or None
        Mean true return of the learned policy after each session.
    correlations : RewardCorrelation a replication, after the last session; or none
    errors : EmpiricalILE a replication, after the last session; or none
    breaches : float ``[replications]`` or None
        Share of successful breaches of the patrol with the final policy.
    seconds : float or None
        Median of a session, once compiled.
    """

    pairs: Int[np.ndarray, " T"]
    accuracy: Float[np.ndarray, "replications T"] | None = None
    returns: Float[np.ndarray, "replications T"] | None = None
    correlations: tuple[RewardCorrelation, ...] = ()
    errors: tuple[EmpiricalILE, ...] = ()
    breaches: Float[np.ndarray, " replications"] | None = None
    seconds: float | None = None

    @property
    def late(self) -> slice:
        """The last quarter of the sessions, over which tables average (the dissertation: 15 of 35)."""
        return slice(-max(len(self.pairs) // 4, 1), None)


class RewardScatter(NamedTuple):
    """A learned reward against the true one on held-out episodes of one seed; see :func:`reward_scatter`.

    Fields
    ------
    steps : float ``[N, 2]``, true and learned reward of some steps
    trajectories : float ``[n, 2]``, true and learned reward a step, of whole trajectories
    whose : int ``[n]``, which policy of the mix acted, the best being 0
    correlation : RewardCorrelation, over all steps
    """

    steps: Float[np.ndarray, "N 2"]
    trajectories: Float[np.ndarray, "n 2"]
    whose: Int[np.ndarray, " n"]
    correlation: RewardCorrelation


class Belief(NamedTuple):
    """Noisy trajectory and its posterior; see :func:`belief_from_draws`.

    Fields
    ------
    names : str a component, with its unit
    observed, truth : float ``[L, m]``
    mean, low, high : float ``[L, m]``, of the posterior; the ends of its middle ``coverage``
    coverage : float
    """

    names: tuple[str, ...]
    observed: Float[np.ndarray, "L m"]
    truth: Float[np.ndarray, "L m"]
    mean: Float[np.ndarray, "L m"]
    low: Float[np.ndarray, "L m"]
    high: Float[np.ndarray, "L m"]
    coverage: float


class FrameStrip(NamedTuple):
    """Moments of one episode of a robot; see :func:`frame_strip`.

    Fields
    ------
    name : str, whose episode
    seconds : float ``[F]``
    travelled : float ``[F]``, metres since the start
    capsules : float ``[F, G, 5]``, ``x1, z1, x2, z2, radius`` of every limb, in metres, at ``x = 0``
    """

    name: str
    seconds: Float[np.ndarray, " F"]
    travelled: Float[np.ndarray, " F"]
    capsules: Float[np.ndarray, "F G 5"]


class AdversarialResults(NamedTuple):
    """One domain.

    Fields
    ------
    domain : one of :data:`DOMAINS`
    noise : str, the sensor in words ("normal, covariance 0.05 I")
    replications : int
    machine : str, where seconds were measured
    methods : mapping from a name of :data:`METHODS` to MethodResult
    accuracy_over : str, the states of LBA in words
    expert_return : float or None
    scatters : mapping from a method's name to RewardScatter, of one replication
    belief : Belief or None
    frames : FrameStrip a row
    cells : mapping from a method's name to LBA in each cell ``[cells, cells]`` of mountain car, mean of
    replications
    settings : mapping from words to plain values, for the file
    expert_breaches : float or None
        Share of breaches of the patrol that succeed with the expert's own policy.
    """

    domain: str
    noise: str
    replications: int
    machine: str
    methods: Mapping[str, MethodResult]
    accuracy_over: str = "all states"
    expert_return: float | None = None
    scatters: Mapping[str, RewardScatter] = {}
    belief: Belief | None = None
    frames: tuple[FrameStrip, ...] = ()
    cells: Mapping[str, Float[np.ndarray, "cells cells"]] = {}
    settings: Mapping[str, Any] = {}
    expert_breaches: float | None = None

    @property
    def title(self) -> str:
        """The domain's name on the page."""
        return DOMAINS[self.domain]

    @property
    def measure(self) -> str:
        """Measure of the cost of noise: ``"accuracy"`` (LBA) of few actions, ``"returns"`` of vectors."""
        return "accuracy" if self.domain in ("patrol", "mountain-car") else "returns"

    def late(self, method: str, measure: str) -> Float[np.ndarray, " replications"] | None:
        """Average a method's measure over the last quarter of its sessions; None if it has none."""
        result = self.methods.get(method)
        replications = None if result is None else getattr(result, measure)
        return (
            None
            if result is None or replications is None
            else np.asarray(replications)[:, result.late].mean(1)
        )

    def recovery(self, method: str = ROBUST) -> Recovery | None:
        """Compute a method's recovery of the loss to noise; None without all three methods."""
        replications = [self.late(name, self.measure) for name in (CLEAN, NOISY, method)]
        if any(x is None for x in replications):
            return None
        clean, noisy, robust = replications
        return recovered_share(clean, noisy, robust, jax.random.key(0))  # type: ignore[arg-type]


def reward_scatter(
    learned: Float[np.ndarray, "n T"],
    true: Float[np.ndarray, "n T"],
    live: Bool[np.ndarray, "n T"],
    whose: Int[np.ndarray, " n"],
    key: Array,
) -> RewardScatter:
    """Collect rewards of held-out episodes (:func:`~i2rl.domains.robots.simulation.graded_mix`), some steps
    drawn.

    Raises as :func:`~i2rl.analysis.judging.returns.reward_correlation` does.
    """
    k_correlation, k_drawn = jax.random.split(key)
    correlation = reward_correlation(learned, true, live, k_correlation)
    pairs = np.stack([true, learned], -1).astype(float)
    every = pairs[live]
    chosen = np.asarray(jax.random.permutation(k_drawn, len(every)))[:_DRAWN_STEPS]
    sums = np.where(live[..., None], pairs, 0).sum(1)
    return RewardScatter(every[chosen], sums / live.sum(1)[:, None], np.asarray(whose), correlation)


def belief_from_draws(
    names: Sequence[str],
    observed: Float[np.ndarray, "L m"],
    truth: Float[np.ndarray, "L m"],
    draws: Float[np.ndarray, "M L m"],
    coverage: float = 0.9,
) -> Belief:
    """Summarise ``M`` posterior draws of one trajectory's components. ``ValueError`` for unlike shapes."""
    shape = (len(truth), len(names))
    if not np.shape(observed) == np.shape(truth) == np.shape(draws)[1:] == shape:
        raise ValueError(
            f"{len(names)} components need arrays [L, {len(names)}] and draws [M, L, {len(names)}], got "
            f"{np.shape(observed)}, {np.shape(truth)} and {np.shape(draws)}"
        )
    tail = (1 - coverage) / 2
    low, high = np.quantile(draws, [tail, 1 - tail], axis=0)
    return Belief(
        tuple(names), np.asarray(observed), np.asarray(truth), np.mean(draws, 0), low, high, coverage
    )


def frame_strip(
    name: str,
    robot: Locomotion,
    observations: Float[np.ndarray, "L d"],
    frames: int = 10,
    seconds: float = 1.5,
) -> FrameStrip:
    """Return moments evenly spread over the first ``seconds`` of an episode.

    Observations leave the horizontal position out; it is the sum of their velocities.
    """
    last = min(round(seconds / robot.step_seconds), len(observations) - 1)
    steps = np.linspace(0, last, frames).round().astype(int)
    speed = observations[:, (robot.observation_size + 1) // 2 - 1]
    x = np.concatenate([[0.0], np.cumsum(speed[:-1])]) * robot.step_seconds
    capsules = np.array([robot.silhouette(observations[t]) for t in steps])
    return FrameStrip(name, steps * robot.step_seconds, x[steps], capsules)


# -- as a file ----------------------------------------------------------------------------------------

_KINDS = {
    kind.__name__: kind
    for kind in (
        AdversarialResults,
        MethodResult,
        RewardScatter,
        Belief,
        FrameStrip,
        Correlation,
        EmpiricalILE,
        Interval,
        RewardCorrelation,
    )
}


def store_results(results: AdversarialResults, path: Path | str) -> None:
    """Write results as JSON that :func:`load_results` reads."""
    Path(path).write_text(json.dumps(plain(results), allow_nan=False) + "\n")


def load_results(path: Path | str) -> AdversarialResults:
    """Read what :func:`store_results` wrote; :class:`StorageError` for a file of something else."""
    found = read_plain(path)
    if not isinstance(found, AdversarialResults):
        raise StorageError(f"{path}: the file does not hold the results of adversarial learners")
    return found


def read_plain(path: Path | str) -> Any:
    """Read JSON of :func:`plain`; :class:`StorageError` naming the file if it is damaged."""
    try:
        return rebuilt(parsed_json(Path(path).read_text(encoding="utf-8")))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise StorageError(f"{path}: not stored results: {shortened(str(error), 200)[1:-1]}") from None


def plain(value: Any) -> Any:
    """Convert to JSON, which has no arrays, named tuples, or numbers that are not finite."""
    if type(value).__name__ in _KINDS:
        return {"kind": type(value).__name__, **{k: plain(v) for k, v in value._asdict().items()}}
    if isinstance(value, Mapping):
        return {"items": [[k, plain(v)] for k, v in value.items()]}
    if isinstance(value, np.ndarray) or hasattr(value, "__jax_array__") or isinstance(value, jax.Array):
        array = np.asarray(value)
        return {"array": [plain(x) for x in array.ravel().tolist()], "shape": list(array.shape)}
    if isinstance(value, tuple | list):
        return [plain(x) for x in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    return value


def rebuilt(value: Any) -> Any:
    """Invert :func:`plain`; lists come back as tuples, all arrays as NumPy's."""
    if isinstance(value, list):
        return tuple(rebuilt(x) for x in value)
    if not isinstance(value, dict):
        return value
    if "items" in value:
        return {k: rebuilt(v) for k, v in value["items"]}
    if "array" in value:
        return np.array(rebuilt(value["array"])).reshape(value["shape"])
    if "float" in value:
        return float(value["float"])
    kind = _KINDS.get(value.get("kind", ""))
    if kind is None:
        raise ValueError(f"there is nothing of the kind {shortened(value.get('kind'))} in results")
    return kind(**{k: rebuilt(v) for k, v in value.items() if k != "kind"})
