"""Two tasks seen through noisy perception (section 7.4.3): sorting onions, and one patroller.

An observation is a pair ``(s, a)`` that may be wrong. *Predicates* on pairs (appendix F) describe its errors;
the learner of chapter 6.1 estimates the reliability of each predicate.

The dissertation flips "blemished onion", "onion to bin" and "onion to table" with probability 0.3 each and
leaves the others. No pair satisfies that: "onion to bin" and "hand to bin" are one function of the pair, so
are "onion to table" and "hand to table", and a release is at the bin or on the table. The simulation here
states confusions of pairs instead, as a :class:`SwapNoise`: a known prediction with its opposite, and
independently the place of release with the other place. For the patroller, moving forward is confused with
turning right. Such a noise *is* an observation model: it injects the errors (:func:`demonstrate_noisy`),
gives the evidence of a learner with a known sensor, and the true agreement probabilities
(:func:`agreement_probabilities`). :func:`feature_noise` is the other injector, exact under Eq. 6.5
normalised.

An observation may be a pair that the task does not offer, such as releasing a good onion over the bin:
perception is independent of the task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import SEEN, Demonstration
from ...models.observation.evidence import (
    AnySensor,
    FeatureNoise,
    ObservationModel,
    Sensor,
    Visibility,
    checked_predicates,
    fitting_sensor,
    observe,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import finite_occupancy, simulate
from ..patrol import process as patrols
from ..sorting import process as onions
from .swap_noise import SwapNoise

Starts = Literal["all", "natural"]
Scores = Literal["calibrated", "product"]

SORTING_PREDICATES = (
    "blemished onion",
    "move with hand",
    "start from conveyor",
    "leaving at eye",
    "onion to bin",
    "hand to bin",
    "onion to table",
    "hand to table",
)
PATROL_PREDICATES = ("move forward", "turn left", "in the top row", "turn right")

SORTING_LABELS = ("onion location", "hand location")
PATROL_LABELS = ("state",)

SWAP = 0.3
CONCENTRATION = 4.0


# -- predicates ---------------------------------------------------------------------------------------


def sorting_predicates(sorting: onions.Sorting) -> Bool[np.ndarray, "8 S A"]:
    """Compute the eight observation features of onion sorting (appendix F.2), in the dissertation's order.

    As functions of a pair the fifth and the sixth are one, and so are the last two: only the product of
    their reliabilities can be learned.
    """
    onion, prediction, hand, _ = (column[:, None] for column in np.asarray(sorting.factors).T)
    action = np.arange(sorting.mdp.n_actions)[None]
    to_table, to_bin = action == onions.PLACE_ON_CONVEYOR, action == onions.PLACE_IN_BIN
    moves = to_table | to_bin | (action == onions.PICK)
    return _stacked(
        prediction == onions.BLEMISHED,
        moves,
        onion == onions.TABLE,
        (hand == onions.AT_EYES) & moves,
        to_bin,
        to_bin,
        to_table,
        to_table,
    )


def patrol_predicates(patrol: patrols.Patrol) -> Bool[np.ndarray, "4 S A"]:
    """Compute the four observation features of the patroller (appendix F.1).

    "y is 0" means the row, the hallway's far arm: no cell of instance 2 has column 0, so the column would
    make it false everywhere. The released program uses "turns right" nowhere; the dissertation, followed
    here, does.
    """
    row = np.array([state.row for state in patrol.states])[:, None]
    action = np.arange(patrol.mdp.n_actions)[None]
    return _stacked(action == patrols.FORWARD, action == patrols.LEFT, row == 0, action == patrols.RIGHT)


def sorting_labels(sorting: onions.Sorting) -> Int[np.ndarray, "2 S A"]:
    """Return the places of the onion and of the hand, in the codes of ``sorting.factors``."""
    places = np.asarray(sorting.factors)[:, [0, 2]].T
    return np.tile(places[..., None], sorting.mdp.n_actions)


def patrol_labels(patrol: patrols.Patrol) -> Int[np.ndarray, "1 S A"]:
    """Return the state's index."""
    return np.tile(np.arange(patrol.mdp.n_states)[None, :, None], patrol.mdp.n_actions)


def _stacked(*predicates: Bool[np.ndarray, "..."]) -> Bool[np.ndarray, "J S A"]:
    return np.stack(np.broadcast_arrays(*predicates))


# -- the two tasks ------------------------------------------------------------------------------------


@shown_briefly
class NoisyTask(NamedTuple):
    """A task, its expert, and how its pairs are confused.

    Fields
    ------
    name : str
    mdp : TabularMDP
        Starts where a demonstration naturally does; :meth:`starting` gives the others.
    weights : float ``[K]``
        The expert's true weights.
    expert_policy : float ``[S, A]``
        Optimal under them.
    predicate_names : tuple of str ``[J]``
    predicates : bool ``[J, S, A]``
    noise : SwapNoise
        The noise of the simulation.
    label_names : tuple of str ``[M]``
    labels : int ``[M, S, A]``
        Parts of a pair that the noise does not touch; see :attr:`features`.
    """

    name: str
    mdp: TabularMDP
    weights: Float[np.ndarray, " K"]
    expert_policy: Float[np.ndarray, "S A"]
    predicate_names: tuple[str, ...]
    predicates: Bool[np.ndarray, "J S A"]
    noise: SwapNoise
    label_names: tuple[str, ...]
    labels: Int[np.ndarray, "M S A"]

    @property
    def features(self) -> Int[np.ndarray, "J+M S A"]:
        """Predicates and labels that perception observes.

        The dissertation's predicates leave most of a pair open. A model of the predicates alone observes
        states at random that the predicates do not distinguish. The reliabilities of the labels are learned,
        too.
        """
        return np.concatenate([self.predicates.astype(int), self.labels])

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Names of :attr:`features`."""
        return self.predicate_names + self.label_names

    def starting(self, starts: Starts) -> TabularMDP:
        """Return the process begun in all states alike (``"all"``) or at its ``"natural"`` start.

        Raises ``ValueError`` for another word.
        """
        if starts == "natural":
            return self.mdp
        if starts == "all":
            return replace(self.mdp, initial=jnp.full(self.mdp.n_states, 1 / self.mdp.n_states))
        raise ValueError(f"starts are 'all' or 'natural', got {starts!r}")

    def pair_distribution(self, starts: Starts = "all", steps: int = 3) -> Float[np.ndarray, "S A"]:
        """Compute the expert's distribution over pairs in ``steps`` steps (exact; sums to one)."""
        if steps < 1:
            raise ValueError(f"a trajectory needs at least one step, got {steps}")
        policies = jnp.broadcast_to(jnp.asarray(self.expert_policy), (steps, *self.expert_policy.shape))
        return np.asarray(_occupied(self.starting(starts), policies).mean(0))


def noisy_sorting(
    prediction_noise: float = SWAP, place_noise: float = SWAP, sorting: onions.Sorting | None = None
) -> NoisyTask:
    """Make pick-inspect-place on 22 states, with a sensor that confuses predictions and places.

    With ``prediction_noise`` a known prediction is observed as its opposite; independently, with
    ``place_noise``, placing an onion on the conveyor is observed as placing it in the bin, and conversely. In
    ``pick_inspect_place()`` the opposite of every known prediction exists; in another ``sorting`` it may be
    no state of the process; the prediction is then observed correctly. The natural start is an unknown onion
    on the table. Raises ``ValueError`` for noise outside [0, 1].

    See Also
    --------
    i2rl.domains.demonstrate_noisy : simulate its expert
    i2rl.domains.pick_inspect_place : its process
    i2rl.domains.noisy_patrol : the other task

    Examples
    --------
    >>> from i2rl.domains import noisy_sorting
    >>> task = noisy_sorting(prediction_noise=0.2, place_noise=0.1)
    >>> task.mdp.n_states, task.predicates.shape
    (22, (8, 22, 7))
    >>> task.noise.chances.tolist()
    [0.2, 0.1]
    """
    sorting = onions.pick_inspect_place() if sorting is None else sorting
    index = {tuple(row): s for s, row in enumerate(np.asarray(sorting.factors).tolist())}
    opposite = {onions.BLEMISHED: onions.GOOD, onions.GOOD: onions.BLEMISHED, onions.UNKNOWN: onions.UNKNOWN}
    flipped = [
        index.get((onion, opposite[prediction], hand, listed), s)
        for (onion, prediction, hand, listed), s in index.items()
    ]
    swaps = (
        _flat(sorting.mdp, states=np.array(flipped)),
        _flat(sorting.mdp, actions=_exchanged(sorting.mdp, onions.PLACE_ON_CONVEYOR, onions.PLACE_IN_BIN)),
    )
    return NoisyTask(
        "noisy " + sorting.name,
        sorting.mdp,
        sorting.weights[0],
        sorting.expert_policy(0),
        SORTING_PREDICATES,
        sorting_predicates(sorting),
        SwapNoise(np.stack(swaps), np.array([prediction_noise, place_noise])),
        SORTING_LABELS,
        sorting_labels(sorting),
    )


def noisy_patrol(noise: float = SWAP) -> NoisyTask:
    """Make one patroller of instance 2, with a sensor that confuses moves forward and right turns.

    The sensor observes its place, left turns and stops correctly. The natural start is somewhere on its loop
    (the stationary distribution of its policy). Raises ``ValueError`` for noise outside [0, 1].

    See Also
    --------
    i2rl.domains.demonstrate_noisy : simulate its expert
    i2rl.domains.noisy_sorting : the other task

    Examples
    --------
    >>> from i2rl.domains import noisy_patrol
    >>> task = noisy_patrol()
    >>> task.predicates.shape, task.label_names
    ((4, 124, 4), ('state',))
    >>> sharper = noisy_patrol(0.1)
    >>> sharper.noise.chances.tolist()
    [0.1]
    """
    patrol = patrols.instance(2)
    policy = patrol.expert_policy()
    mdp = replace(patrol.mdp, initial=jnp.asarray(_stationary(patrol.mdp, policy)))
    swap = _flat(mdp, actions=_exchanged(mdp, patrols.FORWARD, patrols.RIGHT))
    return NoisyTask(
        "noisy patrol",
        mdp,
        patrol.weights,
        policy,
        PATROL_PREDICATES,
        patrol_predicates(patrol),
        SwapNoise(swap[None], np.array([noise])),
        PATROL_LABELS,
        patrol_labels(patrol),
    )


def feature_noise(task: NoisyTask, confused: float = 1 - SWAP, clear: float = 0.99) -> FeatureNoise:
    """Make noise that follows Eq. 6.5, normalised, exactly, on the predicates that the task's own noise
    changes.

    Those have reliability ``confused``, the others ``clear``. Observations range over all pairs, so an
    observation with every predicate right is often another pair than the truth.
    """
    psi = task.predicates.reshape(len(task.predicates), -1)
    changes = (psi[:, np.asarray(task.noise.swaps).reshape(len(task.noise.chances), -1)] != psi[:, None]).any(
        (1, 2)
    )
    return FeatureNoise(task.predicates, np.where(changes, confused, clear))


def _flat(
    mdp: TabularMDP, states: Int[np.ndarray, " S"] | None = None, actions: Int[np.ndarray, " A"] | None = None
) -> Int[np.ndarray, "S A"]:
    states = np.arange(mdp.n_states) if states is None else states
    actions = np.arange(mdp.n_actions) if actions is None else actions
    return states[:, None] * mdp.n_actions + actions


def _exchanged(mdp: TabularMDP, one: int, other: int) -> Int[np.ndarray, " A"]:
    actions = np.arange(mdp.n_actions)
    actions[[one, other]] = other, one
    return actions


def _stationary(mdp: TabularMDP, policy: Float[np.ndarray, "S A"]) -> Float[np.ndarray, " S"]:
    chain = np.zeros((mdp.n_states, mdp.n_states))
    moves = np.asarray(mdp.probabilities) * policy[..., None]
    np.add.at(chain, (np.arange(mdp.n_states)[:, None, None], np.asarray(mdp.successors)), moves)
    limit: np.ndarray = np.asarray(mdp.initial) @ np.linalg.matrix_power(chain, 2**16)
    # Squaring sixteen times lets rounding grow to 1e-12.
    return limit / limit.sum()


# -- agreement ----------------------------------------------------------------------------------------


def agreement_probabilities(
    noise: AnySensor, predicates: np.ndarray | Array, weights: np.ndarray | Array
) -> Float[np.ndarray, " J"]:
    """Compute probability that a predicate of an observation is that of the truth, under ``weights [S, A]``.

    ``predicates [J, S, A]`` may be labels. The sum over observations is exact; ``weights`` need not be
    normalised. These probabilities judge an estimated sensor: the reliabilities of :class:`FeatureNoise` are
    parameters, not frequencies. Raises ``ValueError`` for noise without an observation model, bad predicates,
    or weights that are no distribution over its pairs.
    """
    model = _reading(noise)
    table = np.exp(np.asarray(model.log_probabilities))
    psi, share = checked_predicates(predicates), np.asarray(weights, float)
    if psi.shape[1:] != table.shape[:2] or share.shape != table.shape[:2]:
        raise ValueError(
            f"the noise is about pairs [S, A] = {list(table.shape[:2])}, but predicates [J, S, A] have shape "
            f"{list(psi.shape)} and weights [S, A] have shape {list(share.shape)}"
        )
    if not ((share >= 0) & np.isfinite(share)).all() or not share.any():
        raise ValueError("weights of pairs must be non-negative numbers, not all zero")
    size = share.size
    psi, share = psi.reshape(len(psi), size), share.reshape(size) / share.sum()
    together = share[:, None] * table.reshape(size, size)
    same = np.array([together[labels[:, None] == labels].sum() for labels in psi])
    # Rounding may lead past one.
    return np.clip(same, 0.0, 1.0)


def _reading(noise: AnySensor) -> ObservationModel:
    if noise.noise is None:
        raise ValueError("this sensor has no observation model: it observes the steps in view exactly")
    return noise.noise


# -- demonstrations -----------------------------------------------------------------------------------


@shown_briefly
class NoisyDemonstration(NamedTuple):
    """Expert's behaviour and its observation by perception.

    Fields
    ------
    truth : Demonstration
        Every pair as it was; for judging only.
    seen : Demonstration
        The observations, with scores if requested.
    mdp : TabularMDP
        The task's process with the start that was simulated.
    """

    truth: Demonstration
    seen: Demonstration
    mdp: TabularMDP


class Scoring(NamedTuple):
    """Options for the scores of reports, see :func:`demonstrate_noisy`."""

    scores: Scores | None = None
    concentration: float = CONCENTRATION
    reliabilities: np.ndarray | None = None


class ScoringOptions(TypedDict, total=False):
    """:class:`Scoring` as keyword arguments."""

    scores: Scores | None
    concentration: float
    reliabilities: np.ndarray | None


def demonstrate_noisy(
    key: Array,
    task: NoisyTask,
    noise: AnySensor | None = None,
    *,
    sessions: int,
    trajectories: int = 2,
    steps: int = 3,
    starts: Starts = "all",
    visibility: Visibility | None = None,
    **scoring: Unpack[ScoringOptions],
) -> NoisyDemonstration:
    """Simulate the task's optimal expert and observe it through ``noise`` (by default the task's own).

    Session ``i`` is ``trajectories`` rows of ``steps`` pairs (``seen.sessions(trajectories)``); section
    7.4.3 has two of three. Every trajectory starts afresh. ``visibility`` hides steps as well. ``scores`` are
    (with ``concentration``, 4 by default, and ``reliabilities``, none by default)

    - ``"calibrated"``, the perception's probability that it made no error. At every step each swap of the
      noise has a clarity ``u ~ Beta`` of mean one minus its noise and ``alpha + beta = concentration``, and
      happens with probability ``1 - u``; the score is the probability that none did. Swaps that do not apply
      do not count, so the score of a pair that is always observed correctly is one. Other noise has one
      clarity a step: with :class:`FeatureNoise` the score is the probability that every predicate is right,
      with a plain observation model that the pair is. Summed over clarities, observations follow the
      observation model exactly.
    - ``"product"``, Eq. 6.5 for the observation that occurred: ``p_j`` for predicates it has right times ``1
      - p_j`` for those it has wrong, with the given ``reliabilities [J]``; by default those of a
      :class:`FeatureNoise`, otherwise the agreement probabilities among the expert's pairs. It differs from
      the probability that the observation is right, and requires the truth.
    - None (the default): no scores.

    Raises ``ValueError`` for other words, sizes below one, a concentration or reliabilities that are none,
    and noise or visibility for another number of states or actions.

    See Also
    --------
    i2rl.domains.noisy_sorting : a task with noise
    i2rl.domains.noisy_patrol : another
    i2rl.inference.rimeo : learn from reports and their noise

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import demonstrate_noisy, noisy_sorting
    >>> noisy = demonstrate_noisy(jax.random.key(0), noisy_sorting(), sessions=10, scores="calibrated")
    >>> noisy.seen.n_trajectories, noisy.seen.score.shape
    (20, (20, 3))
    >>> wrong = (noisy.seen.state != noisy.truth.state) | (noisy.seen.action != noisy.truth.action)
    >>> bool(wrong.any()), bool(wrong.all())
    (True, False)
    """
    scores, concentration, reliabilities = Scoring(**scoring)
    if min(sessions, trajectories, steps) < 1:
        raise ValueError(
            f"sessions, trajectories and steps must be at least 1, got {sessions}, {trajectories} and {steps}"
        )
    if scores not in (None, "calibrated", "product"):
        raise ValueError(f"scores are 'calibrated', 'product' or None, got {scores!r}")
    if not concentration > 0:
        raise ValueError(f"the concentration of the clarity must be positive, got {concentration}")
    noise = task.noise if noise is None else noise
    mdp, model = task.starting(starts), _reading(noise)
    hidden = noise.visibility
    if visibility is not None:
        hidden = visibility.visibility if hidden is None else hidden * visibility.visibility
    sensor = fitting_sensor(Sensor(hidden, model), mdp)
    if scores == "product":
        if reliabilities is None:
            reliabilities = (
                np.asarray(noise.reliabilities)
                if isinstance(noise, FeatureNoise)
                else agreement_probabilities(model, task.predicates, task.pair_distribution(starts, steps))
            )
        p = np.asarray(reliabilities, float)
        if p.shape != (len(task.predicates),) or not ((p >= 0) & (p <= 1)).all():
            raise ValueError(f"reliabilities are {len(task.predicates)} probabilities, got {reliabilities}")
    walk, perceive, judge = jax.random.split(key, 3)
    rows = sessions * trajectories
    with np.errstate(divide="ignore"):
        log_policy = jnp.asarray(np.log(task.expert_policy))
    states, actions = _walks(jax.random.split(walk, rows), mdp, log_policy, steps)
    seen = Demonstration.from_codes(
        np.asarray(_looks(jax.random.split(perceive, rows), sensor, states, actions))
    )
    truth = Demonstration.from_pairs(np.asarray(states), np.asarray(actions))
    if scores is not None:
        g = truth.state * mdp.n_actions + truth.action
        o = np.where(seen.kind == SEEN, seen.state * mdp.n_actions + seen.action, g)
        score = (
            _clarity(judge, noise, g, o, concentration)
            if scores == "calibrated"
            else _product(task.predicates, p, g, o)
        )
        seen = replace(seen, score=np.where(seen.kind == SEEN, score, np.nan))
    return NoisyDemonstration(truth, seen, mdp)


_walks: Callable[..., tuple[Array, Array]] = partial(jax.jit, static_argnums=3)(
    jax.vmap(simulate, in_axes=(0, None, None, None))
)
_occupied = jax.jit(finite_occupancy)
_looks = jax.jit(jax.vmap(observe, in_axes=(0, None, 0, 0)))


def _clarity(
    key: Array,
    noise: AnySensor,
    truth: Int[np.ndarray, "n L"],
    observation: Int[np.ndarray, "n L"],
    concentration: float,
) -> Float[np.ndarray, "n L"]:
    """Draw scores given the errors: the clarity's distribution given whether a swap happened."""
    g, o = truth.reshape(-1), observation.reshape(-1)
    if isinstance(noise, SwapNoise):
        wrong = np.asarray(noise.confused(jnp.asarray(g), jnp.asarray(o)))
        acts = np.asarray(noise.acts).reshape(len(noise.chances), -1).T
        chance = np.where(acts[g], np.asarray(noise.chances), 0.0)
    else:
        table = np.exp(np.asarray(_reading(noise).log_probabilities))
        table = table.reshape(table.shape[0] * table.shape[1], -1)
        right = np.eye(len(table), dtype=bool)
        if isinstance(noise, FeatureNoise):
            psi = np.asarray(noise.predicates).reshape(-1, len(table))
            right = (psi[:, :, None] == psi[:, None]).all(0)
        wrong, chance = ~right[g, o][:, None], np.clip((table * ~right).sum(1), 0, 1)[g, None]
    certain = (chance <= 0) | (chance >= 1)
    mean = 1 - np.where(certain, 0.5, chance)
    draws = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    # Beta is conjugate to whether the swap happened, so the observation may be drawn first, by the model
    # itself.
    clarity = draws.beta(concentration * mean + ~wrong, concentration * (1 - mean) + wrong)
    return np.where(certain, 1 - chance, clarity).prod(axis=1).reshape(truth.shape)


def _product(
    predicates: Bool[np.ndarray, "J S A"],
    reliabilities: Float[np.ndarray, " J"],
    truth: Int[np.ndarray, "n L"],
    observation: Int[np.ndarray, "n L"],
) -> Float[np.ndarray, "n L"]:
    psi, p = predicates.reshape(len(predicates), -1), reliabilities[:, None, None]
    return np.where(psi[:, truth] == psi[:, observation], p, 1 - p).prod(axis=0)
