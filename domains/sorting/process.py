"""Sorting onions on a conveyor (section 7.1.2, appendix F): careful picking, fast rolling, and idling.

A sorter claims an onion, picks it, inspects it and puts it where it belongs; or rolls its hand over all
onions, which lists the blemished ones at once, and picks those. A state is ``(onion, prediction, hand,
list)``. Three processes share one transition function and differ in their states and available actions:

- :func:`sorting_with_claiming`, 26 states: a new onion may be claimed while one is claimed. The default:
  on it the dissertation's three behaviours are three.
- :func:`sorting_without_claiming`, the 23 states and the features of the released code. Its features cannot
  express "keep claiming": its optimal policy is that of picking (the code's value iteration stopped after one
  iteration, which hid it).
- :func:`pick_inspect_place`, the 22 states that section 7.1.2 speaks of, without the list.

A feature is an expectation over an action's intended outcomes; a slip (5 %) leaves the state and is not
charged to the reward, as in the released code. :attr:`Sorting.transition_features` counts what really
happens, slips included. The hidden quality of an onion is not part of the process: precision and recall need
the simulator of the whole table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import deterministic_policy, hard_plan, reward_of, simulate

ONION = ("on the table", "inspected", "in the bin", "held", "put back")
TABLE, INSPECTED, BIN, HELD, PUT_BACK = range(5)
PREDICTION = ("blemished", "good", "unknown")
BLEMISHED, GOOD, UNKNOWN = range(3)
HAND = ("at the conveyor", "at the eyes", "at the bin", "hovering")
AT_CONVEYOR, AT_EYES, AT_BIN, HOVERING = range(4)
LIST = ("list empty", "list", "no list")
EMPTY, LISTED, NO_LIST = range(3)

ACTIONS = ("inspect", "place on conveyor", "place in bin", "pick", "claim new", "roll", "claim listed")
INSPECT, PLACE_ON_CONVEYOR, PLACE_IN_BIN, PICK, CLAIM_NEW, ROLL, CLAIM_LISTED = range(7)

FEATURES = (
    "good on table",
    "blemished not on table",
    "good not in bin",
    "blemished in bin",
    "not idle",
    "claims a new onion",
    "makes a list",
    "picks unknown",
    "picks blemished",
    "empties the list",
    "inspects a held onion",
)

BEHAVIOURS = ("pick-inspect-place", "roll-pick-place", "keep claiming")
_RAW_WEIGHTS = np.array([
    [2, 1, 2, 1, 0.2, 0.1, 0, 4, 0, 0, 4],
    [0, 4, 0, 4, 0.2, 0, 8, 0, 8, 4, 0],
    [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0],
])  # fmt: skip
# With the first row above, a blemished onion would go back on the table where "place on conveyor" is offered.
_RAW_PICK_INSPECT_PLACE = np.array([2, 2, 2, 2, 0.2, 0.1, 0, 4, 0, 0, 4])

SLIP = 0.05
BLEMISHED_SHARE = 0.5
ROLL_FINDS = 0.95
LIST_ENDS = 0.5
DISCOUNT = 0.99

_STATES_WITHOUT_CLAIMING = (
    "0200 3230 1012 2222 0222 3232 1112 0001 3031 2221 0021 2220 "
    "0202 0220 0100 0110 0120 0130 0210 0230 3130 0011 0031"
)
_STATES_WITH_CLAIMING = _STATES_WITHOUT_CLAIMING + " 4202 0212 0232"


class State(NamedTuple):
    """State of a sorter: the claimed onion's place and prediction, the hand's place, and the list."""

    onion: int
    prediction: int
    hand: int
    listed: int

    @property
    def name(self) -> str:
        """For example ``unknown on the table, hovering, list empty``."""
        return f"{PREDICTION[self.prediction]} {ONION[self.onion]}, {HAND[self.hand]}, {LIST[self.listed]}"


@shown_briefly
class Sorting(NamedTuple):
    """An onion-sorting process and the rewards that sorters follow.

    Fields
    ------
    name : str
    mdp : TabularMDP
        Without a reward; features are expectations over intended outcomes.
    factors : int ``[S, 4]``
        Each state as (onion, prediction, hand, list); codes as in :data:`ONION`, :data:`PREDICTION`, ...
    transition_features : float ``[S, A, K]``
        Expected features of what really happens, slips included.
    behaviours : tuple of str ``[B]``
        Behaviours of sorters.
    weights : float ``[B, K]``
        Their true weights, of L1 norm one.
    """

    name: str
    mdp: TabularMDP
    factors: Int[np.ndarray, "S 4"]
    transition_features: Float[np.ndarray, "S A K"]
    behaviours: tuple[str, ...]
    weights: Float[np.ndarray, "B K"]

    @property
    def states(self) -> tuple[State, ...]:
        """The states by name of their factors."""
        return tuple(State(*map(int, row)) for row in self.factors)

    def expert_policy(self, behaviour: int) -> Float[np.ndarray, "S A"]:
        """Compute the optimal policy of a behaviour; ties (none in ours) go to the first action."""
        return np.asarray(_greedy(self.mdp, jnp.asarray(self.weights[behaviour])))


@shown_briefly
class MixedDemonstration(NamedTuple):
    """Trajectories of several behaviours, and the behaviour of each (``[n]``, for judging only)."""

    demonstration: Demonstration
    labels: Int[np.ndarray, " n"]


# -- the three processes ------------------------------------------------------------------------------


@cache
def sorting_with_claiming() -> Sorting:
    """Build 26 states, 46 pairs, features of the actions: the default for two and three tasks.

    See Also
    --------
    i2rl.domains.demonstrate_sorting : simulate sorters
    i2rl.domains.sorting_without_claiming : the released code's process

    Examples
    --------
    >>> from i2rl.domains import sorting_with_claiming
    >>> sorting = sorting_with_claiming()
    >>> sorting.mdp.n_states, int(sorting.mdp.available.sum())
    (26, 46)
    >>> sorting.behaviours
    ('pick-inspect-place', 'roll-pick-place', 'keep claiming')
    """
    states = _parsed(_STATES_WITH_CLAIMING)
    return _sorting("sorting with claiming", states, _with_claiming, _deeds, BEHAVIOURS, _normalised())


@cache
def sorting_without_claiming() -> Sorting:
    """Build the 23 states, 31 pairs and features of the released code, which depend on outcomes alone.

    Some of those features also fire by accident ("claims a new onion" when one is put back). Only 8 states
    have a real choice.

    See Also
    --------
    i2rl.domains.sorting_with_claiming : the default
    i2rl.domains.pick_inspect_place : the process without a list

    Examples
    --------
    >>> from i2rl.domains import sorting_without_claiming
    >>> sorting = sorting_without_claiming()
    >>> sorting.mdp.n_states, int(sorting.mdp.available.sum())
    (23, 31)
    >>> int((sorting.mdp.available.sum(axis=1) > 1).sum())
    8
    """
    states = _parsed(_STATES_WITHOUT_CLAIMING)
    return _sorting(
        "sorting without claiming", states, _without_claiming, _outcomes, BEHAVIOURS, _normalised()
    )


@cache
def pick_inspect_place() -> Sorting:
    """Build the process of the noisy-perception experiments (section 7.1.2): 22 states, 36 pairs, no list.

    One behaviour, with the weights the authors used for it, of L1 norm one (they divided by 14.3, which
    changes no policy). The features about the list are always zero. The first onion is an unknown one on
    the table, the hand anywhere.

    See Also
    --------
    i2rl.domains.noisy_sorting : the same, seen through noise
    i2rl.domains.sorting_with_claiming : the process of several behaviours

    Examples
    --------
    >>> from i2rl.domains import pick_inspect_place
    >>> sorting = pick_inspect_place()
    >>> sorting.mdp.n_states, int(sorting.mdp.available.sum())
    (22, 36)
    >>> sorting.behaviours
    ('pick-inspect-place',)
    """
    table = [State(TABLE, p, h, NO_LIST) for p, h in product(range(3), range(4))]
    held = [State(HELD, p, HOVERING, NO_LIST) for p in range(3)]
    inspected = [State(INSPECTED, p, AT_EYES, NO_LIST) for p in range(3)]
    binned = [State(BIN, UNKNOWN, h, NO_LIST) for h in range(4)]
    weights = _RAW_PICK_INSPECT_PLACE / _RAW_PICK_INSPECT_PLACE.sum()
    return _sorting(
        "pick-inspect-place",
        (*table, *held, *inspected, *binned),
        _without_list,
        _deeds,
        BEHAVIOURS[:1],
        weights[None],
    )


def demonstrate_sorting(
    key: Array, sorting: Sorting, counts: Sequence[int], steps: int = 50
) -> MixedDemonstration:
    """Simulate sorters who act optimally: ``counts[b]`` trajectories of behaviour ``b``, in that order.

    Fewer counts than behaviours leave the last ones out. Raises ``ValueError`` for more counts than
    behaviours, a negative one, or no trajectory or step at all.

    See Also
    --------
    i2rl.domains.sorting_with_claiming : a process to sort in
    i2rl.inference.mme_mtirl : tell the behaviours apart

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import demonstrate_sorting, sorting_with_claiming
    >>> mixed = demonstrate_sorting(jax.random.key(0), sorting_with_claiming(), [2, 1], steps=10)
    >>> mixed.demonstration.lengths.tolist(), mixed.labels.tolist()
    ([10, 10, 10], [0, 0, 1])
    """
    if len(counts) > len(sorting.behaviours) or min(counts, default=0) < 0 or not sum(counts):
        raise ValueError(
            f"counts must be one non-negative number of trajectories for each of {sorting.behaviours} "
            f"(fewer leave the last out), and not all zero; got {list(counts)}"
        )
    if steps < 1:
        raise ValueError(f"a trajectory needs at least one step, got {steps}")
    labels = np.repeat(np.arange(len(counts)), counts)
    with np.errstate(divide="ignore"):
        log_policies = np.log([sorting.expert_policy(b) for b in range(len(counts))])
    keys = jax.random.split(key, len(labels))
    states, actions = _simulate_all(keys, sorting.mdp, jnp.asarray(log_policies[labels]), steps)
    return MixedDemonstration(Demonstration.from_pairs(np.asarray(states), np.asarray(actions)), labels)


_simulate_all = jax.jit(jax.vmap(simulate, in_axes=(0, None, 0, None)), static_argnums=3)


@jax.jit
def _greedy(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    return deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)


# -- dynamics -----------------------------------------------------------------------------------------


def intended_outcomes(state: State, action: int) -> tuple[tuple[State, float], ...]:
    """Return an action's intended outcomes with probabilities, before slips (the final action versions)."""
    _, prediction, hand, listed = state
    if action == INSPECT:
        if prediction != UNKNOWN:
            return ((State(INSPECTED, prediction, AT_EYES, listed), 1.0),)
        return (
            (State(INSPECTED, GOOD, AT_EYES, NO_LIST), 1 - BLEMISHED_SHARE),
            (State(INSPECTED, BLEMISHED, AT_EYES, NO_LIST), BLEMISHED_SHARE),
        )
    if action == PLACE_ON_CONVEYOR:
        return ((State(TABLE, UNKNOWN, AT_CONVEYOR, NO_LIST), 1.0),)
    if action == PLACE_IN_BIN:
        if listed == LISTED:
            return (
                (State(BIN, UNKNOWN, AT_BIN, LISTED), 1 - LIST_ENDS),
                (State(BIN, UNKNOWN, AT_BIN, EMPTY), LIST_ENDS),
            )
        return ((State(BIN, UNKNOWN, AT_BIN, listed), 1.0),)
    if action == PICK:
        return ((State(HELD, prediction, HOVERING, listed), 1.0),)
    if action == CLAIM_NEW:
        return ((State(TABLE, UNKNOWN, hand, NO_LIST), 1.0),)
    if action == ROLL:
        return (
            (State(TABLE, BLEMISHED, hand, LISTED), ROLL_FINDS),
            (State(TABLE, UNKNOWN, hand, EMPTY), 1 - ROLL_FINDS),
        )
    if listed == LISTED:
        return ((State(TABLE, BLEMISHED, hand, LISTED), 1.0),)
    return ((State(TABLE, UNKNOWN, hand, listed), 1.0),)


def _places(state: State) -> tuple[int, ...] | None:
    """Return the actions of every sorter on an onion in hand; None where the processes differ."""
    by_prediction = {UNKNOWN: INSPECT, BLEMISHED: PLACE_IN_BIN, GOOD: PLACE_ON_CONVEYOR}
    if state.onion in (INSPECTED, HELD):
        return (by_prediction[state.prediction],)
    return None


def _with_list(state: State, before_list: tuple[int, ...], without_list: tuple[int, ...]) -> tuple[int, ...]:
    """Return actions of the processes with a list, before one is made and without one."""
    onion, prediction, _, listed = state
    placed = _places(state)
    if placed is not None:
        return placed
    if onion == TABLE:
        if listed == LISTED:
            return (CLAIM_LISTED,) if prediction == UNKNOWN else (PICK,)
        return before_list if listed == EMPTY else without_list
    return {NO_LIST: (CLAIM_NEW,), EMPTY: (ROLL,), LISTED: (CLAIM_LISTED,)}[listed]


def _with_claiming(state: State) -> tuple[int, ...]:
    return _with_list(state, (ROLL, PICK, CLAIM_NEW), (PICK, CLAIM_NEW))


def _without_claiming(state: State) -> tuple[int, ...]:
    return _with_list(state, (ROLL, PICK), (PICK,))


def _without_list(state: State) -> tuple[int, ...]:
    onion, prediction, _, _ = state
    if onion == TABLE:
        return (PICK, CLAIM_NEW)
    if onion == INSPECTED and prediction != UNKNOWN:
        return (PLACE_ON_CONVEYOR, PLACE_IN_BIN)
    return _places(state) or (CLAIM_NEW,)


# -- features -----------------------------------------------------------------------------------------


def _outcomes(state: State, action: int, following: State) -> tuple[bool, ...]:
    """Evaluate the released code's predicates on a state and its successor."""
    del action
    (onion, prediction, _, listed), (to, becomes, hand, relisted) = state, following
    return (
        prediction == GOOD and to == TABLE,
        prediction == BLEMISHED and to != TABLE,
        prediction == GOOD and to != BIN,
        prediction == BLEMISHED and to == BIN,
        following != state,
        becomes == UNKNOWN and to == TABLE,
        listed == EMPTY and relisted == LISTED,
        onion == TABLE and prediction == becomes == UNKNOWN and hand == HOVERING,
        onion == TABLE and prediction == becomes == BLEMISHED and hand == HOVERING,
        listed == LISTED and relisted == EMPTY,
        onion == HELD and prediction == UNKNOWN and becomes != UNKNOWN,
    )


def _deeds(state: State, action: int, following: State) -> tuple[bool, ...]:
    """Evaluate the same predicates; those named after an action require that action."""
    fired = list(_outcomes(state, action, following))
    fired[0] = fired[0] and action == PLACE_ON_CONVEYOR
    fired[5] = action == CLAIM_NEW
    picks = action == PICK and following.onion == HELD
    fired[7] = picks and state.prediction == UNKNOWN
    fired[8] = picks and state.prediction == BLEMISHED
    return tuple(fired)


# -- construction -------------------------------------------------------------------------------------


def _parsed(codes: str) -> tuple[State, ...]:
    return tuple(State(*map(int, code)) for code in codes.split())


def _normalised() -> Float[np.ndarray, "B K"]:
    return _RAW_WEIGHTS / _RAW_WEIGHTS.sum(axis=1, keepdims=True)


def _sorting(
    name: str,
    states: tuple[State, ...],
    available_in: Callable[[State], tuple[int, ...]],
    features_of: Callable[[State, int, State], tuple[bool, ...]],
    behaviours: tuple[str, ...],
    weights: Float[np.ndarray, "B K"],
) -> Sorting:
    index = {state: i for i, state in enumerate(states)}
    n_states, n_actions = len(states), len(ACTIONS)
    transitions = np.zeros((n_states, n_actions, n_states))
    features = np.zeros((n_states, n_actions, len(FEATURES)))
    transition_features = np.zeros_like(features)
    available = np.zeros((n_states, n_actions), bool)
    for i, state in enumerate(states):
        for action in available_in(state):
            available[i, action] = True
            stays = np.array(features_of(state, action, state), float)
            for following, probability in intended_outcomes(state, action):
                fired = np.array(features_of(state, action, following), float)
                transitions[i, action, index[following]] += (1 - SLIP) * probability
                transitions[i, action, i] += SLIP * probability
                features[i, action] += probability * fired
                transition_features[i, action] += probability * ((1 - SLIP) * fired + SLIP * stays)
    initial = np.array([_may_start(state, states) for state in states], float)
    mdp = TabularMDP.from_dense(
        transitions,
        features,
        initial=initial / initial.sum(),
        discount=DISCOUNT,
        available=available,
        states=[state.name for state in states],
        actions=ACTIONS,
        feature_names=FEATURES,
    )
    return Sorting(name, mdp, np.array(states), transition_features, behaviours, weights)


def _may_start(state: State, states: tuple[State, ...]) -> bool:
    """Test whether a state may be a start: before a list was made or, without lists, with an unknown onion on
    the table.
    """
    if any(other.listed == EMPTY for other in states):
        return state.onion == TABLE and state.listed == EMPTY
    return state.onion == TABLE and state.prediction == UNKNOWN
