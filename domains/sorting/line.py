"""Belt of onions with hidden quality: precision and recall of a sorter's policy.

The process of :mod:`i2rl.domains.sorting.process` has no true quality, so a policy is executed here on a belt
of onions that have one (section 7.4.2: three sets of eight, four blemished, each gone after a fixed time).
The policy sees only the state of its process; the world holds the place and the quality of every onion, and
the time. The world determines these random outcomes of the process:

- the prediction of an inspection: the onion's quality, right with probability :attr:`Line.inspection`;
- the list that rolling makes: every onion on the table is judged by itself, right with probability
  :attr:`Line.rolling`, independently each time it is rolled;
- the end of the list: it is empty once the last onion listed is in the bin.

The process determines the rest. An onion is claimed at random, and putting one back claims another. A slip (5
%) only costs the action's time. The world settles the details that the process leaves open:

- an onion put back has been sorted: it is not claimed or rolled again, and counts as left on the table;
- the claimed onion stays on the list until it is in the bin; a claim takes another onion if there is one;
- a set comes in with an unknown onion claimed, no list made yet, and the hand where it was (first: at the
  conveyor);
- an action not over when the set disappears has no effect, and an onion in the hand is not in the bin;
- once no onion is left to sort, the sorter waits for the next set.

The dissertation states no times and no accuracies. The defaults of :class:`Line` are set once. The accuracies
are constants of earlier versions of the released code (0.95 for its detector, 0.7 for rolling). The times are
plausible for a slow arm; those of a set, of rolling and of inspecting were picked from a grid of 36 so that
the two *experts* come near their row of Table 7.2. No default is calibrated to a learner's row.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from scipy.special import ndtri

from ...models.inputs.display import shown_briefly
from .process import (
    ACTIONS,
    AT_CONVEYOR,
    BLEMISHED,
    CLAIM_LISTED,
    CLAIM_NEW,
    EMPTY,
    INSPECT,
    LISTED,
    NO_LIST,
    PICK,
    PLACE_IN_BIN,
    PLACE_ON_CONVEYOR,
    ROLL,
    SLIP,
    TABLE,
    UNKNOWN,
    Sorting,
    State,
    intended_outcomes,
)

UNSORTED, IN_BIN, LEFT = range(3)


class Line(NamedTuple):
    """Belt, perception and speed of the sorter; times in seconds. The module states their origin.

    ``sets`` of ``onions`` each, ``blemished`` of them blemished, disappear one after the other, each after
    ``set_seconds``. ``inspection`` and ``rolling`` are the probabilities that an onion is judged rightly.
    With probability ``slip`` an action has no effect. ``claim_seconds`` holds for both claiming actions,
    ``place_seconds`` for both places (the claim that goes with putting an onion back included),
    ``roll_seconds`` for rolling over the whole table once.
    """

    sets: int = 3
    onions: int = 8
    blemished: int = 4
    set_seconds: float = 65.0
    inspection: float = 0.95
    rolling: float = 0.7
    slip: float = SLIP
    claim_seconds: float = 1.0
    pick_seconds: float = 4.0
    inspect_seconds: float = 3.0
    place_seconds: float = 4.0
    roll_seconds: float = 12.0

    @property
    def seconds(self) -> tuple[float, ...]:
        """Duration of each action, in the order of ``ACTIONS``."""
        by_action = {
            INSPECT: self.inspect_seconds,
            PLACE_ON_CONVEYOR: self.place_seconds,
            PLACE_IN_BIN: self.place_seconds,
            PICK: self.pick_seconds,
            CLAIM_NEW: self.claim_seconds,
            ROLL: self.roll_seconds,
            CLAIM_LISTED: self.claim_seconds,
        }
        return tuple(by_action[a] for a in range(len(ACTIONS)))


class Share(NamedTuple):
    """Estimated share with its confidence interval; all NaN without trials."""

    value: float
    low: float
    high: float


@shown_briefly
class Tally(NamedTuple):
    """Outcomes of the onions of ``n`` belts.

    Fields
    ------
    true_positives : int ``[n]``
        Blemished onions in the bin.
    false_positives : int ``[n]``
        Good onions in the bin.
    true_negatives : int ``[n]``
        Good onions left on the table.
    false_negatives : int ``[n]``
        Blemished onions left on the table.
    """

    true_positives: Int[np.ndarray, " n"]
    false_positives: Int[np.ndarray, " n"]
    true_negatives: Int[np.ndarray, " n"]
    false_negatives: Int[np.ndarray, " n"]

    @property
    def means(self) -> tuple[float, float, float, float]:
        """Mean TP, FP, TN and FN of a belt, in the order of Table 7.2."""
        tp, fp, tn, fn = (float(np.mean(count)) for count in self)
        return tp, fp, tn, fn

    def precision(self, level: float = 0.95) -> Share:
        """Compute the share of blemished onions among those in the bin, ``TP / (TP + FP)``; NaN if none was
        binned.
        """
        return _ratio(self.true_positives, self.true_positives + self.false_positives, level)

    def recall(self, level: float = 0.95) -> Share:
        """Compute the share of the blemished onions that are in the bin, ``TP / (TP + FN)``."""
        return _ratio(self.true_positives, self.true_positives + self.false_negatives, level)


def wilson(successes: float, trials: float, level: float = 0.95) -> Share:
    """Compute a binomial share with Wilson's score interval; NaN without trials. Counts may be fractional."""
    if not trials:
        return Share(math.nan, math.nan, math.nan)
    share, z = successes / trials, float(ndtri((1 + level) / 2))
    middle = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    # Rounding must not put the share outside its own interval.
    return Share(share, min(max(middle - half, 0.0), share), max(min(middle + half, 1.0), share))


def _ratio(part: Int[np.ndarray, " n"], whole: Int[np.ndarray, " n"], level: float) -> Share:
    """Compute the ratio of sums over belts, with Wilson's interval for the effective number of onions.

    Onions of one belt are not independent. The delta method gives the variance of the ratio; Wilson's formula
    takes the number of independent onions of that variance (Korn and Graubard 1998). If no belt differs from
    the ratio (every onion binned was blemished), onions count one by one.
    """
    total, n = int(whole.sum()), len(whole)
    if total == 0:
        return Share(math.nan, math.nan, math.nan)
    share = float(part.sum() / total)
    variance = n / max(n - 1, 1) * float(np.sum((part - share * whole) ** 2)) / total**2
    effective = share * (1 - share) / variance if variance > 0 else float(total)
    return wilson(share * effective, effective, level)


def sort_belts(
    key: Array,
    sorting: Sorting,
    policy: Float[np.ndarray, "S A"],
    belts: int = 1000,
    line: Line = Line(),  # noqa: B008 (immutable)
) -> Tally:
    """Carry out a policy on ``belts`` independent belts.

    Parameters
    ----------
    key : random key
        Belt ``i`` depends on it and on ``i`` alone, for every duration of the sets.
    sorting : Sorting
        The process whose states the policy is about.
    policy : float ``[S, A]``
        Probabilities of actions in each state; of a learner or of :meth:`Sorting.expert_policy`.
    belts : int
    line : Line

    Raises
    ------
    ValueError
        For a policy of another shape, that is no distribution or takes an action that is not offered; for a
        line without onions, with more blemished than onions, with a probability outside [0, 1], or with a
        time that is not positive and finite; without belts.

    See Also
    --------
    i2rl.domains.sorting_with_claiming : the process of its policies
    i2rl.analysis.sorting_study : learn the policies and sort

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import sort_belts, sorting_with_claiming
    >>> sorting = sorting_with_claiming()
    >>> tally = sort_belts(jax.random.key(0), sorting, sorting.expert_policy(0), belts=100)
    >>> tally.true_positives.shape, tally.precision().value > 0.9
    ((100,), True)
    """
    policy = np.asarray(policy, float)
    _check_policy(sorting, policy)
    _check_line(line)
    if belts < 1:
        raise ValueError(f"at least one belt is needed, got {belts}")
    with np.errstate(divide="ignore"):
        log_policy = jnp.asarray(np.log(policy))
    # States, too, are padded with unreachable ones, so that all processes share that program.
    log_policy, process = jax.tree.map(_states_padded, (log_policy, _tables(sorting)))
    speeds = jnp.array(line.seconds), jnp.array(float(line.set_seconds))
    chances = jnp.array([line.inspection, line.rolling, line.slip], float)
    # Padded to a power of two, so that many numbers of belts share a compiled program.
    padded = 1 << max(8, (belts - 1).bit_length())
    counts = _sort_belts(
        jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(padded)),
        log_policy,
        process,
        speeds,
        chances,
        jnp.array(line.blemished),
        line.sets,
        line.onions,
    )
    return Tally(*np.asarray(counts)[:belts].T)


def _check_policy(sorting: Sorting, policy: Float[np.ndarray, "S A"]) -> None:
    mdp = sorting.mdp
    expected = (mdp.n_states, mdp.n_actions)
    if policy.shape != expected:
        raise ValueError(
            f"a policy for {sorting.name} must have shape [S, A] = {expected}, got {policy.shape}"
        )
    if not (policy >= 0).all() or not np.allclose(policy.sum(1), 1, atol=1e-6):
        raise ValueError("a policy must give every state a distribution over actions: non-negative, sum one")
    forbidden = np.argwhere((policy > 0) & ~np.asarray(mdp.available))
    if len(forbidden):
        s, a = forbidden[0]
        raise ValueError(
            f"the policy takes {mdp.action_names[a]!r} in {mdp.state_names[s]!r}, not offered there"
        )


def _check_line(line: Line) -> None:
    if line.sets < 1 or line.onions < 1 or not 0 <= line.blemished <= line.onions:
        raise ValueError(
            "a line needs sets and onions, and no more blemished onions than onions in a set; got "
            f"sets={line.sets}, onions={line.onions}, blemished={line.blemished}"
        )
    for name in ("inspection", "rolling", "slip"):
        if not 0 <= getattr(line, name) <= 1:
            raise ValueError(f"{name} is a probability, got {getattr(line, name)}")
    for name in line._fields:
        if name.endswith("seconds") and not 0 < getattr(line, name) < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {getattr(line, name)}")


# -- the world ----------------------------------------------------------------------------------------


class _Tables(NamedTuple):
    """A process as the world uses it.

    ``outcome[s, a, e]`` is the state an action leads to, ``e`` being 1 if the onion is judged blemished or
    the list is not empty; ``hand`` and ``listed`` are states' factors; a set starts in ``start[hand]``.
    """

    outcome: Int[Array, "S A 2"]
    hand: Int[Array, " S"]
    listed: Bool[Array, " S"]
    start: Int[Array, " 4"]


class _World(NamedTuple):
    """One set: state, seconds gone by, number of actions, and per onion where it is and if it is listed."""

    state: Int[Array, ""]
    clock: Float[Array, ""]
    step: Int[Array, ""]
    claimed: Int[Array, ""]
    where: Int[Array, " n"]
    listed: Bool[Array, " n"]


def _tables(sorting: Sorting) -> _Tables:
    states = sorting.states
    index = {state: i for i, state in enumerate(states)}
    outcome = np.zeros((len(states), len(ACTIONS), 2), int)
    for i, a in np.argwhere(sorting.mdp.available):
        for following, _ in intended_outcomes(states[i], a):
            decided = len(intended_outcomes(states[i], a)) > 1
            event = int(following.prediction == BLEMISHED or following.listed == LISTED)
            outcome[i, a, event if decided else slice(None)] = index[following]
    before = EMPTY if any(state.listed == EMPTY for state in states) else NO_LIST
    start = [index[State(TABLE, UNKNOWN, hand, before)] for hand in range(4)]
    listed = sorting.factors[:, 3] == LISTED
    return _Tables(jnp.array(outcome), jnp.array(sorting.factors[:, 2]), jnp.array(listed), jnp.array(start))


def _states_padded(table: Array) -> Array:
    """Pad a table ``[S, ...]`` with zeros up to the next multiple of 32 states."""
    return jnp.pad(table, [(0, -len(table) % 32), *[(0, 0)] * (table.ndim - 1)])


def _any_of(key: Array, mask: Bool[Array, " n"]) -> Int[Array, ""]:
    return jax.random.categorical(key, jnp.where(mask, 0.0, -jnp.inf))


@partial(jax.jit, static_argnums=(6, 7))
def _sort_belts(
    keys: Array,
    log_policy: Float[Array, "S A"],
    process: _Tables,
    speeds: tuple[Float[Array, " A"], Float[Array, ""]],
    chances: Float[Array, " 3"],
    blemished: Int[Array, ""],
    sets: int,
    onions: int,
) -> Int[Array, "n 4"]:
    seconds, allowed = speeds
    inspection, rolling, slip = chances
    # Onions are claimed at random, so which of them are blemished does not matter.
    bad = jnp.arange(onions) < blemished

    def act(key: Array, world: _World) -> _World:
        choose, slipping, judge, claim = jax.random.split(jax.random.fold_in(key, world.step), 4)
        state, _, _, claimed, where, listed = world
        action = jax.random.categorical(choose, log_policy[state])
        clock = world.clock + seconds[action]
        accuracy = jnp.where(action == ROLL, rolling, inspection)
        judged = bad == jax.random.bernoulli(judge, accuracy, (onions,))
        at_claimed = jnp.arange(onions) == claimed

        where = jnp.where(at_claimed & (action == PLACE_IN_BIN), IN_BIN, where)
        where = jnp.where(at_claimed & (action == PLACE_ON_CONVEYOR), LEFT, where)
        unsorted = where == UNSORTED
        listed = jnp.where(action == ROLL, judged, listed) & unsorted
        event = jnp.where(action == INSPECT, judged[claimed], jnp.any(listed))
        following = process.outcome[state, action, event.astype(int)]
        listed &= process.listed[following]
        others = unsorted & ~at_claimed
        claims = (
            (action == CLAIM_NEW)
            | (action == PLACE_ON_CONVEYOR)
            | (action == ROLL)
            | (action == CLAIM_LISTED)
        )
        candidates = jnp.where(
            jnp.any(listed), listed, jnp.where((action == CLAIM_NEW) & jnp.any(others), others, unsorted)
        )
        claimed = jnp.where(claims, _any_of(claim, candidates), claimed)

        done = _World(following, clock, world.step + 1, claimed, where, listed)
        undone = world._replace(clock=clock, step=world.step + 1)
        failed = jax.random.bernoulli(slipping, slip) | (clock > allowed)
        return jax.tree.map(partial(jnp.where, failed), undone, done)

    def sort_set(hand: Int[Array, ""], key: Array) -> tuple:
        first, key = jax.random.split(key)
        begin = _World(
            process.start[hand],
            jnp.zeros(()),
            jnp.zeros((), int),
            jax.random.randint(first, (), 0, onions),
            jnp.full(onions, UNSORTED),
            jnp.zeros(onions, bool),
        )
        end = lax.while_loop(
            lambda world: (world.clock < allowed) & jnp.any(world.where == UNSORTED), partial(act, key), begin
        )
        binned = end.where == IN_BIN
        counts = [jnp.sum(x) for x in (binned & bad, binned & ~bad, ~binned & ~bad, ~binned & bad)]
        return process.hand[end.state], jnp.stack(counts)

    def sort_belt(key: Array) -> Int[Array, " 4"]:
        counts: Array = lax.scan(sort_set, jnp.array(AT_CONVEYOR), jax.random.split(key, sets))[1]
        return jnp.sum(counts, axis=0)

    return jax.vmap(sort_belt)(keys)
