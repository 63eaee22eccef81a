"""Two tasks seen through noisy perception (section 7.4.3): sorting onions, and one patroller.

A report of perception is a pair ``(s, a)`` that may be wrong. What it gets right and wrong is described by
*predicates* on pairs (appendix F); the learner of chapter 6.1 estimates how reliably each is reported.

The dissertation flips "blemished onion", "onion to bin" and "onion to table" with probability 0.3 each and
nothing else. No report can do that: "onion to bin" and "hand to bin" are one function of the pair, so are
"onion to table" and "hand to table", and a release is at the bin or on the table. The simulation here says
what is confused instead, as a :class:`SwapNoise`: a known prediction with its opposite, and independently
the place of release with the other place. For the patroller, moving forward is confused with turning right.
Such a noise *is* an observation model: it injects the errors (:func:`demonstrate_noisy`), gives the evidence
of a learner who knows it, and the true agreement probabilities (:func:`agreement_probabilities`).
:func:`feature_noise` is the other injector, exact under Eq. 6.5 normalised.

A report may be of a pair that the task does not offer, such as releasing a good onion over the bin:
perception does not know the task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
    "blemished onion", "move with hand", "start from conveyor", "leaving at eye", "onion to bin",
    "hand to bin", "onion to table", "hand to table",
)  # fmt: skip
PATROL_PREDICATES = ("move forward", "turn left", "in the top row", "turn right")

SORTING_LABELS = ("onion location", "hand location")
PATROL_LABELS = ("state",)

SWAP = 0.3
CONCENTRATION = 4.0


# -- predicates ---------------------------------------------------------------------------------------


def sorting_predicates(sorting: onions.Sorting) -> Bool[np.ndarray, "8 S A"]:
    """The eight observation features of onion sorting (appendix F.2), in the order of the dissertation.

    As functions of a pair the fifth and the sixth are one, and so are the last two: only the product of
    their reliabilities can be learned.
    """
    onion, prediction, hand, _ = (column[:, None] for column in np.asarray(sorting.factors).T)
    action = np.arange(sorting.mdp.n_actions)[None]
    to_table, to_bin = action == onions.PLACE_ON_CONVEYOR, action == onions.PLACE_IN_BIN
    moves = to_table | to_bin | (action == onions.PICK)
    return _stacked(
        prediction == onions.BLEMISHED, moves, onion == onions.TABLE, (hand == onions.AT_EYES) & moves,
        to_bin, to_bin, to_table, to_table,
    )  # fmt: skip


def patrol_predicates(patrol: patrols.Patrol) -> Bool[np.ndarray, "4 S A"]:
    """The four observation features of the patroller (appendix F.1).

    "y is 0" is read as the row, the hallway's far arm: no cell of instance 2 has column 0, so that the other
    reading would be false everywhere. The released program uses "turns right" nowhere; the dissertation,
    followed here, does.
    """
    row = np.array([state.row for state in patrol.states])[:, None]
    action = np.arange(patrol.mdp.n_actions)[None]
    return _stacked(action == patrols.FORWARD, action == patrols.LEFT, row == 0, action == patrols.RIGHT)


def sorting_labels(sorting: onions.Sorting) -> Int[np.ndarray, "2 S A"]:
    """Where the onion and the hand are, in the codes of ``sorting.factors``."""
    places = np.asarray(sorting.factors)[:, [0, 2]].T
    return np.tile(places[..., None], sorting.mdp.n_actions)


def patrol_labels(patrol: patrols.Patrol) -> Int[np.ndarray, "1 S A"]:
    """The state's index."""
    return np.tile(np.arange(patrol.mdp.n_states)[None, :, None], patrol.mdp.n_actions)


def _stacked(*predicates: Bool[np.ndarray, "..."]) -> Bool[np.ndarray, "J S A"]:
    return np.stack(np.broadcast_arrays(*predicates))


# -- the two tasks ------------------------------------------------------------------------------------


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
        """Predicates and labels: all that perception can get right or wrong.

        The dissertation's predicates leave most of a pair open, and a model of nothing else has states that
        they do not tell apart reported at random. Nobody tells the learner that labels are clear: their
        reliabilities are learned, too.
        """
        return np.concatenate([self.predicates.astype(int), self.labels])

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Of :attr:`features`."""
        return self.predicate_names + self.label_names

    def starting(self, starts: Starts) -> TabularMDP:
        """The process begun anywhere (``"all"``, uniformly) or where it ``"natural"``ly is.

        Raises ``ValueError`` for another word.
        """
        if starts == "natural":
            return self.mdp
        if starts == "all":
            return replace(self.mdp, initial=jnp.full(self.mdp.n_states, 1 / self.mdp.n_states))
        raise ValueError(f"starts are 'all' or 'natural', got {starts!r}")

    def pair_distribution(self, starts: Starts = "all", steps: int = 3) -> Float[np.ndarray, "S A"]:
        """How often the expert is at each pair in ``steps`` steps (exact; sums to one)."""
        if steps < 1:
            raise ValueError(f"a trajectory needs at least one step, got {steps}")
        policies = jnp.broadcast_to(jnp.asarray(self.expert_policy), (steps, *self.expert_policy.shape))
        return np.asarray(_occupied(self.starting(starts), policies).mean(0))


def noisy_sorting(
    prediction_noise: float = SWAP, place_noise: float = SWAP, sorting: onions.Sorting | None = None
) -> NoisyTask:
    """Pick-inspect-place on 22 states, watched by somebody who mistakes predictions and places.

    With ``prediction_noise`` a known prediction is reported as its opposite; independently, with
    ``place_noise``, placing an onion on the conveyor is reported as placing it in the bin and the other way
    round. In ``pick_inspect_place()`` the opposite of every known prediction exists; in another ``sorting``
    it may be no state of the process, and is then reported rightly. The natural start is an unknown onion on
    the table. Raises ``ValueError`` for noise outside [0, 1].

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
        "noisy " + sorting.name, sorting.mdp, sorting.weights[0], sorting.expert_policy(0),
        SORTING_PREDICATES, sorting_predicates(sorting),
        SwapNoise(np.stack(swaps), np.array([prediction_noise, place_noise])),
        SORTING_LABELS, sorting_labels(sorting),
    )  # fmt: skip


def noisy_patrol(noise: float = SWAP) -> NoisyTask:
    """One patroller of instance 2, whose moves forward and right turns are mistaken for each other.

    Where it is, left turns and stops are reported rightly. It naturally starts somewhere on its loop (the
    stationary distribution of its policy). Raises ``ValueError`` for noise outside [0, 1].

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
        "noisy patrol", mdp, patrol.weights, policy, PATROL_PREDICATES, patrol_predicates(patrol),
        SwapNoise(swap[None], np.array([noise])), PATROL_LABELS, patrol_labels(patrol),
    )  # fmt: skip


def feature_noise(task: NoisyTask, confused: float = 1 - SWAP, clear: float = 0.99) -> FeatureNoise:
    """Noise that Eq. 6.5, normalised, describes exactly, on the predicates that the task's own noise changes.

    Those have reliability ``confused``, the others ``clear``. Reports range over all pairs, so that a report
    with every predicate right is often of another pair than the truth.
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
    """Probability that a predicate of a report is that of the truth, when truths occur as ``weights [S, A]``.

    ``predicates [J, S, A]`` may be labels. Exact, by summing over reports; ``weights`` need not be
    normalised. This is what an estimated sensor is judged by: the reliabilities of :class:`FeatureNoise` are
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
        raise ValueError("this imperfection has no observation model: it reports what is in view exactly")
    return noise.noise


# -- demonstrations -----------------------------------------------------------------------------------


class NoisyDemonstration(NamedTuple):
    """What an expert did and what perception reported of it.

    Fields
    ------
    truth : Demonstration
        Every pair as it was; for judging only.
    seen : Demonstration
        The reports, with scores if any were asked for.
    mdp : TabularMDP
        The task's process with the start that was simulated.
    """

    truth: Demonstration
    seen: Demonstration
    mdp: TabularMDP


def demonstrate_noisy(
    key: Array,
    task: NoisyTask,
    noise: AnySensor | None = None,
    *,
    sessions: int,
    trajectories: int = 2,
    steps: int = 3,
    starts: Starts = "all",
    scores: Scores | None = None,
    view: Visibility | None = None,
    concentration: float = CONCENTRATION,
    reliabilities: np.ndarray | None = None,
) -> NoisyDemonstration:
    """Simulate the task's optimal expert and report it through ``noise`` (by default the task's own).

    Session ``i`` is ``trajectories`` rows of ``steps`` pairs (``seen.sessions(trajectories)``); section
    7.4.3 has two of three. Every trajectory starts afresh. ``view`` hides steps as well. Scores are

    - ``"calibrated"``, the perception's probability of having made no mistake. At every step each swap of the
      noise has a clarity ``u ~ Beta`` of mean one minus its noise and ``alpha + beta = concentration``, and
      happens with probability ``1 - u``; the score is the probability that none did. Swaps with nothing to
      confuse are not asked, so that the score of a pair that is never mistaken is one. Other noise has one
      clarity a step: under :class:`FeatureNoise` the score is the probability that every predicate is
      reported rightly, under a plain observation model that the pair is. Summed over clarities, reports
      follow the observation model exactly.
    - ``"product"``, Eq. 6.5 for the report that occurred: ``p_j`` for predicates it has right times
      ``1 - p_j`` for those it has wrong, with the given ``reliabilities [J]``; by default those of a
      :class:`FeatureNoise`, otherwise the agreement probabilities among the expert's pairs. It is no
      probability that the report is right, and takes knowledge of the truth that no perception has.
    - None: no scores.

    Raises ``ValueError`` for other words, sizes below one, a concentration or reliabilities that are none,
    and noise or a view for another number of states or actions.

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
    visibility = noise.visibility
    if view is not None:
        visibility = view.visibility if visibility is None else visibility * view.visibility
    sensor = fitting_sensor(Sensor(visibility, model), mdp)
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
    walk, look, judge = jax.random.split(key, 3)
    rows = sessions * trajectories
    with np.errstate(divide="ignore"):
        log_policy = jnp.asarray(np.log(task.expert_policy))
    states, actions = _walks(jax.random.split(walk, rows), mdp, log_policy, steps)
    seen = Demonstration.from_codes(np.asarray(_looks(jax.random.split(look, rows), sensor, states, actions)))
    truth = Demonstration.from_pairs(np.asarray(states), np.asarray(actions))
    if scores is not None:
        g = truth.state * mdp.n_actions + truth.action
        o = np.where(seen.kind == SEEN, seen.state * mdp.n_actions + seen.action, g)
        score = (
            _clarity(judge, noise, g, o, concentration)
            if scores == "calibrated"
            else _product(task.predicates, p, g, o)
        )
        seen = seen._replace(score=np.where(seen.kind == SEEN, score, np.nan))
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
    report: Int[np.ndarray, "n L"],
    concentration: float,
) -> Float[np.ndarray, "n L"]:
    """Scores given what happened: the clarity's distribution once it is known whether a swap happened."""
    g, o = truth.reshape(-1), report.reshape(-1)
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
    # Beta is conjugate to whether the swap happened, so the report may be drawn first, by the model itself.
    clarity = draws.beta(concentration * mean + ~wrong, concentration * (1 - mean) + wrong)
    return np.where(certain, 1 - chance, clarity).prod(axis=1).reshape(truth.shape)


def _product(
    predicates: Bool[np.ndarray, "J S A"],
    reliabilities: Float[np.ndarray, " J"],
    truth: Int[np.ndarray, "n L"],
    report: Int[np.ndarray, "n L"],
) -> Float[np.ndarray, "n L"]:
    psi, p = predicates.reshape(len(predicates), -1), reliabilities[:, None, None]
    return np.where(psi[:, truth] == psi[:, report], p, 1 - p).prod(axis=0)
