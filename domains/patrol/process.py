"""Perimeter patrol (section 7.1.1, appendix C): robots walk hallways in loops, watched through a keyhole.

Three instances on grids, each a reconstruction from the dissertation and its authors' released code where the
two are silent or disagree (said at each place). Cells are ``(row, column)``, rows grow southward. A
patroller's state is a cell and a heading (and, in instance 1, the hallway whose end it visited last); it
moves forward, turns left or right, or stops. The intended move succeeds with a fixed probability, otherwise
the state stays; one step takes two seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import Visibility, observe
from ...models.process.layout import Layout, Mark
from ...models.process.mdp import TabularMDP
from ...models.process.planning import hard_plan, reward_of

Cell = tuple[int, int]

ACTIONS = ("forward", "left", "right", "stop")
FORWARD, LEFT, RIGHT, STOP = range(4)
HEADINGS = ("east", "north", "west", "south")
_STEP = ((0, 1), (-1, 0), (0, -1), (1, 0))
SECONDS_PER_STEP = 2.0
# The released solver breaks every tie between turns to the right.
_TIE_ORDER = (FORWARD, RIGHT, LEFT, STOP)


class State(NamedTuple):
    """A patroller's state; ``phase`` is 0 except in instance 1."""

    row: int
    column: int
    heading: int
    phase: int = 0

    @property
    def cell(self) -> Cell:
        """The cell it stands on."""
        return self.row, self.column

    @property
    def name(self) -> str:
        """For example ``(0,5) east``, or ``(0,5) east from 2`` in instance 1."""
        phase = f" from {self.phase}" if self.phase else ""
        return f"({self.row},{self.column}) {HEADINGS[self.heading]}{phase}"


@shown_briefly
class Breach(NamedTuple):
    """Breach of a patrol: the learner's start and heading, its goal, and the cells it may use."""

    cells: tuple[Cell, ...]
    start: State
    goals: tuple[Cell, ...]
    discount: float


@shown_briefly
class Patrol(NamedTuple):
    """A patrolling domain.

    ``mdp`` is the patrollers' process without the reward, ``weights`` the reward they really follow,
    ``views`` the learner's view at each degree of observability (percent, as the dissertation names it),
    ``breach`` the learner's own task (None in instance 1), ``loop`` the length of the patrollers' cycle in
    steps, ``observability`` the degree of the dissertation's experiments.
    """

    name: str
    mdp: TabularMDP
    weights: Float[np.ndarray, " K"]
    states: tuple[State, ...]
    patrollers: int
    views: dict[int, Bool[np.ndarray, " S"]]
    breach: Breach | None
    loop: int
    observability: int = 30

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Cells of the patrollers, row by row."""
        return tuple(sorted({state.cell for state in self.states}))

    @property
    def cell_of_state(self) -> Int[np.ndarray, " S"]:
        """Index into :attr:`cells` of each state."""
        index = {cell: i for i, cell in enumerate(self.cells)}
        return np.array([index[state.cell] for state in self.states])

    @property
    def layout(self) -> Layout:
        """The floor for pictures: a state at the side of its cell that it faces; a panel for each phase."""
        phase = [state.phase for state in self.states]
        phases = max(phase)
        breach = self.breach
        marks = [] if breach is None else [
            Mark("S", breach.start.cell, "the learner's start"),
            *(Mark("G", goal, "its goal") for goal in breach.goals),
        ]  # fmt: skip
        return Layout.grid(
            [state.cell for state in self.states],
            headings=np.array([state.heading for state in self.states]) * np.pi / 2,
            layers=[
                f"from hallway {s.phase} to {s.phase % phases + 1}" if phases else "" for s in self.states
            ],
            marks=marks,
            floor=() if breach is None else breach.cells,
        )

    def visibility(self, observability: int | None = None) -> Visibility:
        """Return the visibility at an observability that the dissertation names (30, 70, 100 percent, ...).

        The default is the instance's own. Raises ``ValueError`` naming the degrees this instance has.
        """
        if observability is None:
            observability = self.observability
        if observability not in self.views:
            raise ValueError(f"{self.name} has no {observability} % view; it has {sorted(self.views)}")
        return Visibility(self.views[observability])

    def expert_policy(self) -> Float[np.ndarray, "S A"]:
        """Compute the patrollers' optimal policy; ties go right before left, as in the released code."""
        return greedy_policy(self.mdp, self.weights)


def greedy_policy(mdp: TabularMDP, weights: Float[np.ndarray, " K"]) -> Float[np.ndarray, "S A"]:
    """Compute the deterministic optimal policy under some weights, ties broken by :func:`break_ties`."""
    return break_ties(np.asarray(_optimal(mdp, jnp.asarray(weights, float))))


@jax.jit
def _optimal(mdp: TabularMDP, weights: Float[Array, " K"]) -> Bool[Array, "S A"]:
    return hard_plan(mdp, reward_of(mdp, weights)).optimal


def break_ties(optimal: Bool[np.ndarray, "S A"]) -> Float[np.ndarray, "S A"]:
    """Return one optimal action per state, in the order forward, right, left, stop."""
    order = np.array(_TIE_ORDER)
    chosen = order[np.argmax(optimal[:, order], axis=1)]
    return np.eye(len(ACTIONS))[chosen]


class Interaction(NamedTuple):
    """Meeting of two patrollers: an equilibrium of the passing game, played for some steps.

    ``equilibrium`` holds each patroller's action; forward means to follow its own policy. In the steps
    before the last of ``length`` both wait. ``length`` 0 means they pass through each other.
    """

    equilibrium: tuple[int, int] = (STOP, FORWARD)
    length: int = 1


def simulate_patrol(
    key: Array,
    patrol: Patrol,
    log_policies: Float[Array | np.ndarray, "P S A"],
    start: Int[Array | np.ndarray, " P"],
    steps: int,
    interaction: Interaction = Interaction(),  # noqa: B008 (immutable)
) -> tuple[Int[Array, "P T"], Int[Array, "P T"]]:
    """Simulate states and actions of all patrollers over ``steps``, who pass each other by the interaction's
    rule.

    Two patrollers meet when they share a cell or one stands where the other just was. A waiting patroller
    is recorded as stopping.

    See Also
    --------
    i2rl.domains.demonstrate : the same, seen by a learner
    i2rl.models.simulate : walk a process alone

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import instance, simulate_patrol
    >>> patrol = instance(2)
    >>> policies = jax.numpy.log(jax.numpy.stack([patrol.expert_policy()] * 2))
    >>> states, actions = simulate_patrol(jax.random.key(0), patrol, policies, [0, 60], 10)
    >>> states.shape, actions.shape
    ((2, 10), (2, 10))
    """
    cells = jnp.asarray(patrol.cell_of_state)
    return simulate_patrollers(
        key,
        patrol.mdp,
        cells,
        jnp.asarray(log_policies),
        jnp.asarray(start),
        interaction.equilibrium,
        interaction.length,
        steps,
    )


@partial(jax.jit, static_argnums=(5, 6, 7))
def simulate_patrollers(
    key: Array,
    mdp: TabularMDP,
    cells: Int[Array, " S"],
    log_policies: Float[Array, "P S A"],
    start: Int[Array, " P"],
    equilibrium: tuple[int, int],
    length: int,
    steps: int,
) -> tuple[Int[Array, "P T"], Int[Array, "P T"]]:
    """Let patrollers walk under their policies; return their states and actions."""
    patrollers = log_policies.shape[0]
    side = jnp.asarray(equilibrium[:patrollers] if patrollers > 1 else (FORWARD,))

    def step(carry: tuple, key: Array) -> tuple:
        states, before, counter = carry
        here = cells[states]
        if patrollers == 2:
            meet = (here[0] == here[1]) | (before[0] == here[1]) | (before[1] == here[0])
            counter = jnp.where((counter <= 0) & meet, length, counter)
        act, move = jax.random.split(key)
        own = jax.vmap(lambda k, s, p: jax.random.categorical(k, p[s]))(
            jax.random.split(act, patrollers), states, log_policies
        )
        agreed = jnp.where(side == FORWARD, own, side)
        action = jnp.where(counter > 1, STOP, jnp.where(counter == 1, agreed, own))
        branch = jax.vmap(lambda k, s, a: jax.random.categorical(k, jnp.log(mdp.probabilities[s, a])))(
            jax.random.split(move, patrollers), states, action
        )
        following = mdp.successors[states, action, branch]
        return (following, here, counter - 1), (states, action)

    begin = (jnp.asarray(start, mdp.successors.dtype), jnp.full(patrollers, -1), jnp.array(0))
    walked: tuple = lax.scan(step, begin, jax.random.split(key, steps))[1]
    states, actions = walked
    return states.T, actions.T


def demonstrate(
    key: Array,
    patrol: Patrol,
    observability: int | None,
    sessions: int,
    steps: int = 5,
    interaction: Interaction = Interaction(),  # noqa: B008 (immutable)
) -> tuple[Demonstration, ...]:
    """Simulate the learner's observation of each patroller: ``sessions`` windows of ``steps`` pairs in a row.

    The patrollers start in states drawn from the MDP's initial distribution and follow their optimal
    policies. Row ``i`` of each demonstration is session ``i`` (section 7.4.1: five pairs a session). An
    ``observability`` of None is the instance's own.

    See Also
    --------
    i2rl.domains.simulate_patrol : the states and actions behind it
    i2rl.inference.lme_i2rl : learn from it

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import demonstrate, instance
    >>> first, second = demonstrate(jax.random.key(0), instance(2), 30, sessions=4)
    >>> first.n_trajectories, first.lengths.tolist()
    (4, [5, 5, 5, 5])
    """
    policy = jnp.log(jnp.asarray(patrol.expert_policy()))
    first, walk, look = jax.random.split(key, 3)
    start = jax.random.categorical(first, jnp.log(patrol.mdp.initial), shape=(patrol.patrollers,))
    policies = jnp.broadcast_to(policy, (patrol.patrollers, *policy.shape))
    states, actions = simulate_patrol(walk, patrol, policies, start, sessions * steps, interaction)
    view = patrol.visibility(observability)
    keys = jax.random.split(look, patrol.patrollers)
    return tuple(
        Demonstration.from_codes(np.asarray(observe(k, view, s, a)).reshape(sessions, steps, 3))
        for k, s, a in zip(keys, states, actions, strict=True)
    )


# -- the three instances ------------------------------------------------------------------------------


class _Movement(NamedTuple):
    """The states, the state that each action intends, and the probability that it succeeds."""

    states: tuple[State, ...]
    intend: Callable[[State, int], State]
    success: float


class _Reward(NamedTuple):
    """The features of a transition, and the weights of the patrollers' reward."""

    features: Callable[[State, int, State], tuple[bool, ...]]
    names: tuple[str, ...]
    weights: tuple[float, ...]


class _Views(NamedTuple):
    """The states in view at each percentage, and the percentage of the dissertation's experiments."""

    rules: dict[int, Callable[[State], bool]]
    observability: int = 30


def _build(
    name: str,
    movement: _Movement,
    reward: _Reward,
    views: _Views,
    *,
    discount: float,
    patrollers: int,
    breach: Breach | None,
    loop: int,
) -> Patrol:
    states, intend, success = movement
    index = {state: i for i, state in enumerate(states)}
    shape = (len(states), len(ACTIONS))
    successors = np.zeros((*shape, 2), int)
    probabilities = np.zeros((*shape, 2))
    phi = np.zeros((*shape, len(reward.names)))
    for i, state in enumerate(states):
        for a in range(len(ACTIONS)):
            target = intend(state, a)
            # A blocked or idle action stays with certainty; otherwise failure means staying.
            p = 1.0 if target == state else success
            successors[i, a] = index[target], i
            probabilities[i, a] = p, 1 - p
            phi[i, a] = reward.features(state, a, target)
    mdp = TabularMDP.from_successors(
        successors,
        probabilities,
        phi,
        discount=discount,
        states=[state.name for state in states],
        actions=ACTIONS,
        feature_names=reward.names,
    )
    masks = {percent: np.array([rule(s) for s in states]) for percent, rule in views.rules.items()}
    return Patrol(
        name, mdp, np.array(reward.weights), states, patrollers, masks, breach, loop, views.observability
    )


def cell_ahead(state: State) -> Cell:
    """Return the cell that a patroller faces."""
    down, across = _STEP[state.heading]
    return state.row + down, state.column + across


def _walk(cells: frozenset[Cell]) -> Callable[[State, int], State]:
    def intend(state: State, action: int) -> State:
        if action == LEFT:
            return state._replace(heading=(state.heading + 1) % 4)
        if action == RIGHT:
            return state._replace(heading=(state.heading - 1) % 4)
        if action == FORWARD and cell_ahead(state) in cells:
            row, column = cell_ahead(state)
            return state._replace(row=row, column=column)
        return state

    return intend


def _grid_states(cells: frozenset[Cell]) -> tuple[State, ...]:
    return tuple(State(r, c, h) for r, c in sorted(cells) for h in range(4))


@cache
def four_hallways() -> Patrol:
    """Build instance 1: one patroller visits the ends of four hallways in turn (192 states).

    The released map has 200 states; this reconstruction shortens its corridor by one cell, which gives the
    192 of the dissertation (25 cells in four phases of 13, 11, 13 and 11). A feature fires on the step that
    lands on the end of the next hallway, as appendix C's list defines it.

    See Also
    --------
    i2rl.domains.instance : the patrols by number
    i2rl.domains.boyd_fifth_floor : a patrol that can be breached

    Examples
    --------
    >>> from i2rl.domains import four_hallways
    >>> patrol = four_hallways()
    >>> patrol.mdp.n_states, patrol.patrollers, patrol.breach is None
    (192, 1, True)
    >>> patrol.mdp.feature_names[0]
    'switch to hallway 1'
    """
    corridor = [(r, 4) for r in range(9)]
    rows = {1: 5, 2: 0, 3: 3, 4: 8}
    ends = {1: (5, 0), 2: (0, 8), 3: (3, 8), 4: (8, 0)}

    def hallway(g: int) -> list[Cell]:
        return [(rows[g], c) for c in (range(4) if g in (1, 4) else range(5, 9))]

    legal: dict[int, frozenset[Cell]] = {}
    for g in range(1, 5):
        target = g % 4 + 1
        low, high = sorted((rows[g], rows[target]))
        passage = [cell for cell in corridor if low <= cell[0] <= high]
        legal[g] = frozenset(hallway(g) + passage + hallway(target)) - {ends[target]}
    states = tuple(State(r, c, h, g) for g in range(1, 5) for r, c in sorted(legal[g]) for h in range(4))

    def intend(state: State, action: int) -> State:
        target = state.phase % 4 + 1
        if action == FORWARD and cell_ahead(state) == ends[target]:
            return State(*ends[target], state.heading, target)
        return _walk(legal[state.phase])(state, action)

    def features(state: State, action: int, target: State) -> tuple[bool, ...]:
        return tuple(target.phase == k != state.phase for k in range(1, 5))

    return _build(
        "patrol1",
        _Movement(states, intend, success=0.99),
        _Reward(features, tuple(f"switch to hallway {k}" for k in range(1, 5)), (0.25, 0.25, 0.25, 0.25)),
        _Views(
            {30: lambda s: s.column == 4 and s.row >= 3, 44: lambda s: s.column == 4, 100: lambda s: True}
        ),
        discount=0.995,
        patrollers=1,
        breach=None,
        loop=64,
    )


@cache
def boyd_fifth_floor() -> Patrol:
    """Build instance 2: two patrollers in a hallway with a short arm at either end (124 states).

    The intended move succeeds with probability 0.95. Turning features overlap as in the released code:
    cells (1,1) and (15,1) belong to hallway and corner, (0,2) and (16,2) to corner and first division.

    See Also
    --------
    i2rl.domains.instance : the patrols by number
    i2rl.domains.demonstrate : what a learner sees of one

    Examples
    --------
    >>> from i2rl.domains import boyd_fifth_floor
    >>> patrol = boyd_fifth_floor()
    >>> patrol.mdp.n_states, patrol.patrollers, patrol.observability
    (124, 2, 30)
    >>> sorted(patrol.views)
    [11, 18, 30, 41, 70, 100]
    """
    cells = frozenset(
        [(0, c) for c in range(1, 9)] + [(r, 1) for r in range(1, 16)] + [(16, c) for c in range(1, 9)]
    )

    def features(state: State, action: int, target: State) -> tuple[bool, ...]:
        r, c = state.cell
        turn = action in (LEFT, RIGHT)
        arm = r in (0, 16)
        return (
            target.cell != state.cell,
            turn and 1 <= r <= 15,
            turn and (r <= 1 or r >= 15) and c <= 2,
            turn and arm and 2 <= c <= 3,
            turn and arm and 4 <= c <= 5,
            turn and arm and c >= 6,
        )

    views: dict[int, Callable[[State], bool]] = {
        11: lambda s: s.row == 0 and s.column <= 2,
        18: lambda s: s.row == 0 and s.column <= 4,
        30: lambda s: s.row <= 2 and s.column <= 6,
        41: lambda s: s.row <= 5,
        70: lambda s: s.row <= 14,
        100: lambda s: True,
    }
    return _build(
        "patrol2",
        _Movement(_grid_states(cells), _walk(cells), success=0.95),
        _Reward(
            features,
            (
                "moves",
                "turns in hallway",
                "turns at corner",
                "turns in division 1",
                "turns in division 2",
                "turns in division 3",
            ),
            (4 / 7, 0, 0, 0, 3 / 7, 0),
        ),
        _Views(views),
        discount=0.99,
        patrollers=2,
        breach=Breach(tuple(sorted(cells | {(0, 0)})), State(0, 0, 0), ((9, 1),), 0.99),
        loop=56,
    )


@cache
def boyd_with_rooms() -> Patrol:
    """Build instance 3: two patrollers in hallways with two rooms they avoid (184 states).

    The turning feature fires on left turns in the hallways only, as in the released code (the dissertation
    says any turn). The learner's start, (0,17) facing west, is a reconstruction.

    Two limits on what can be learned here. The features span a potential-based shaping (potential: being in a
    room), so one direction of weights changes no behaviour and no data identifies it. The patrollers never
    enter a room, so their policy inside, in 56 of the 184 states, is an extrapolation.

    See Also
    --------
    i2rl.domains.instance : the patrols by number
    i2rl.domains.boyd_fifth_floor : the hallway without rooms

    Examples
    --------
    >>> from i2rl.domains import boyd_with_rooms
    >>> patrol = boyd_with_rooms()
    >>> patrol.mdp.n_states, patrol.patrollers, patrol.observability
    (184, 2, 18)
    >>> patrol.mdp.feature_names[:2]
    ('moves', 'in a room')
    """
    first_room = [(r, 10) for r in range(1, 6)] + [(2, c) for c in range(4, 10)]
    second_room = [(5, c) for c in range(13, 16)]
    rooms = frozenset(first_room + second_room)
    top, right = [(0, c) for c in range(17)], [(r, 16) for r in range(1, 13)]
    cells = rooms.union(top, right, [(13, c) for c in range(14, 17)])

    def features(state: State, action: int, target: State) -> tuple[bool, ...]:
        moved = target.cell != state.cell
        return (
            moved,
            state.cell in rooms,
            action == LEFT and (state.row == 0 or state.column == 16),
            moved and state.cell not in rooms and target.cell in rooms,
            moved and state.cell in rooms and target.cell not in rooms,
        )

    def view(*rules: Callable[[int, int], bool]) -> Callable[[State], bool]:
        return lambda s: any(rule(s.row, s.column) for rule in rules)

    k1 = [lambda r, c: r == 0 and c >= 14, lambda r, c: (r, c) == (1, 16)]
    k2 = [*k1, lambda r, c: r == 0 and c >= 10]
    k4 = [*k2, lambda r, c: r <= 1 and c >= 10, lambda r, c: r <= 6 and c in (15, 16)]
    k6 = [
        *k4,
        lambda r, c: r == 0 and c >= 8,
        lambda r, c: r == 2 and c >= 9,
        lambda r, c: r == 5 and c >= 14,
        lambda r, c: r <= 7 and c == 16,
    ]
    k10 = [
        *k6,
        lambda r, c: r == 0 and c >= 6,
        lambda r, c: r <= 4 and c >= 10,
        lambda r, c: r == 5 and c >= 12,
        lambda r, c: r <= 7 and c >= 14,
        lambda r, c: r <= 11 and c >= 15,
    ]
    return _build(
        "patrol3",
        _Movement(_grid_states(cells), _walk(cells), success=0.99),
        _Reward(
            features,
            ("moves", "in a room", "turns left in hallway", "enters a room", "leaves a room"),
            (1.0, -1.0, 0.1, 0.0, 0.0),
        ),
        _Views(
            {
                9: view(*k1),
                18: view(*k2),
                33: view(*k4),
                46: view(*k6),
                65: view(*k10),
                100: lambda s: True,
            },
            observability=18,
        ),
        discount=0.99,
        patrollers=2,
        breach=Breach(
            tuple(sorted(cells | {(0, 17), (1, 0), (13, 13)})), State(0, 17, 2), ((1, 0), (13, 13)), 0.95
        ),
        loop=64,
    )


def instance(number: int) -> Patrol:
    """Build patrol instance 1, 2 or 3.

    See Also
    --------
    i2rl.domains.four_hallways : instance 1
    i2rl.domains.boyd_fifth_floor : instance 2
    i2rl.domains.boyd_with_rooms : instance 3

    Examples
    --------
    >>> from i2rl.domains import instance
    >>> patrol = instance(2)
    >>> patrol.mdp.n_states, patrol.mdp.n_actions, patrol.mdp.n_features
    (124, 4, 6)
    >>> view = patrol.visibility(30)
    >>> int((view.visibility > 0).sum())
    32
    """
    builders = {1: four_hallways, 2: boyd_fifth_floor, 3: boyd_with_rooms}
    if number not in builders:
        raise ValueError(f"patrol instances are 1, 2 and 3, got {number}")
    return builders[number]()
