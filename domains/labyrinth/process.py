"""A mouse in a binary-tree labyrinth (Rosenberg, Zhang, Perona and Meister, eLife 2021).

Six levels of T-junctions below a root, 63 junctions and 64 ends: node ``n`` has the children ``2n + 1``
(left) and ``2n + 2`` (right) and the parent ``(n - 1) // 2``; nodes 63-126 are the ends, 127 is home,
reached from node 0. A thirsty animal finds water at end 116. A *bout* is one visit: it begins at node 0 and
ends at home.

The process has a state for every node and entrance to it, so that turning round is a property of a pair, and
deterministic moves named after where they lead: ``back`` to the parent (from the root: home), ``left`` and
``right`` to the children. Every recorded step is therefore exactly one action. At an end only ``back`` is
available. Home absorbs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.inputs.text import shortened
from ...models.observation.demonstration import (
    DEFAULT_LIMITS,
    HIDDEN,
    SEEN,
    UNKNOWN,
    Demonstration,
    DemonstrationError,
    LineLimits,
    concatenate,
    identity_of,
    parsed_lines,
    require_few,
)
from ...models.observation.evidence import Visibility
from ...models.process.layout import Layout, Mark
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, simulate, soft_plan

LEVELS = 6
N_NODES = 2 ** (LEVELS + 1) - 1
FIRST_END = 2**LEVELS - 1
HOME = N_NODES
WATER_PORT = 116
ACTIONS = ("back", "left", "right")
BACK, LEFT, RIGHT = range(3)
# How a junction was entered; an end has one entrance, and is a kind of its own.
ENTRIES = ("from above", "from the left child", "from the right child", "at an end", "at home")
FROM_ABOVE, FROM_LEFT, FROM_RIGHT, AT_END, AT_HOME = range(5)
SHARED_FEATURES = (
    "reaches home",
    "reaches the water port",
    "reaches an end",
    "turns round",
    "goes deeper",
    "level",
)
_TURNS_ROUND, _GOES_DEEPER = 3, 4
_NODE_FEATURES = tuple(f"reaches {n}" for n in range(N_NODES))


def level_of(node: int) -> int:
    """Count the junctions above a node: 0 for the root to 6 for the ends; -1 for home."""
    return -1 if node == HOME else (node + 1).bit_length() - 1


def parent_of(node: int) -> int:
    """Return the node that a step back leads to."""
    return HOME if node == 0 else (node - 1) // 2


def destination(node: int, action: int) -> int | None:
    """Return the node that an action leads to, or None if the action does not exist."""
    if node == HOME:
        return HOME if action == BACK else None
    if action == BACK:
        return parent_of(node)
    return None if node >= FIRST_END else 2 * node + action


@shown_briefly
class Labyrinth(NamedTuple):
    """The labyrinth as a decision process.

    Fields
    ------
    mdp : TabularMDP
        254 states, 3 actions, 133 features. A pair's features describe the step it makes: whether it
        reaches home, the water port or an end, turns round or goes deeper, the level it reaches (0 to 1),
        and which node it reaches.
    node : int ``[S]``
        Where each state is.
    entry : int ``[S]``
        How it was entered, an index into ``ENTRIES``.
    """

    mdp: TabularMDP
    node: Int[np.ndarray, " S"]
    entry: Int[np.ndarray, " S"]

    @property
    def choice(self) -> Bool[np.ndarray, " S"]:
        """States with more than one available action."""
        return np.asarray(self.mdp.available).sum(1) > 1

    @property
    def layout(self) -> Layout:
        """The maze for pictures, a tree of Hs: the states of a node together, corridors between nodes."""
        marks = (
            Mark("H", (0.0, -16.0), "home"),
            Mark("W", tuple(maze_positions()[WATER_PORT].tolist()), "the water port"),
        )
        named = Layout.points(maze_positions()[self.node], self.mdp, marks=marks)
        nodes = {int(p): int(n) for p, n in zip(named.place, self.node, strict=True)}
        names = tuple("home" if nodes[p] == HOME else str(nodes[p]) for p in range(named.n_places))
        return named._replace(names=names)

    def below(self, node: int) -> Bool[np.ndarray, " S"]:
        """Return states in the part of the maze that begins at ``node``."""
        inside = np.zeros(N_NODES + 1, bool)
        for n in range(node, N_NODES):
            inside[n] = n == node or inside[parent_of(n)]
        return inside[self.node]

    def without_left_half(self) -> Visibility:
        """Return the visibility of all states outside the left half of the maze (node 1 and below)."""
        return Visibility(~self.below(1))


def maze_positions() -> Float[np.ndarray, "127+1 2"]:
    """Place nodes and home at (x, y): a tree of Hs, left and right as walked."""
    places = np.zeros((N_NODES + 1, 2))
    places[HOME] = 0.0, -16.0
    for node in range(1, N_NODES):
        level = int(np.log2(node + 1))
        way = places[parent_of(node)] - places[parent_of(parent_of(node))]
        ahead = way / np.abs(way).sum()
        side = np.array([-ahead[1], ahead[0]]) * (1 if node % 2 else -1)
        places[node] = places[parent_of(node)] + side * 2.0 ** (LEVELS // 2 - (level - 1) // 2)
    return places


@cache
def mouse_labyrinth(discount: float = 0.9) -> Labyrinth:
    """Build the labyrinth. Raises ``ValueError`` for a discount outside (0, 1].

    See Also
    --------
    i2rl.domains.simulate_bouts : simulate a mouse
    i2rl.domains.read_bouts : read a recorded one

    Examples
    --------
    >>> from i2rl.domains import mouse_labyrinth
    >>> maze = mouse_labyrinth()
    >>> maze.mdp.n_states, maze.mdp.n_actions, int(maze.choice.sum())
    (254, 3, 189)
    >>> int((maze.without_left_half().visibility == 0).sum())
    125
    """
    return _build(discount, (*SHARED_FEATURES, *_NODE_FEATURES), _features)


@cache
def labyrinth_by_level(discount: float = 0.9) -> Labyrinth:
    """Build labyrinth with further features: turning round and going deeper, from each level (145 in all).

    A reward that is stationary and linear in the features of :func:`labyrinth` asks for one propensity to
    turn and one to go deeper everywhere. This one lets them differ from level to level.
    """
    names = [f"{what} from level {n}" for what in ("turns round", "goes deeper") for n in range(LEVELS)]

    def features(node: int, entry: int, action: int, target: int) -> Float[np.ndarray, " K"]:
        phi = _features(node, entry, action, target)
        here = np.arange(LEVELS) == level_of(node)
        return np.concatenate([phi, here * phi[_TURNS_ROUND], here * phi[_GOES_DEEPER]])

    return _build(discount, (*SHARED_FEATURES, *_NODE_FEATURES, *names), features)


def _build(
    discount: float,
    feature_names: tuple[str, ...],
    features_of: Callable[[int, int, int, int], Float[np.ndarray, " K"]],
) -> Labyrinth:
    places = [(n, e) for n in range(FIRST_END) for e in (FROM_ABOVE, FROM_LEFT, FROM_RIGHT)]
    places += [(n, AT_END) for n in range(FIRST_END, N_NODES)] + [(HOME, AT_HOME)]
    index = {place: s for s, place in enumerate(places)}
    shape = (len(places), len(ACTIONS))
    successors = np.zeros((*shape, 1), int)
    available = np.zeros(shape, bool)
    features = np.zeros((*shape, len(feature_names)))
    for s, (node, entry) in enumerate(places):
        for a in range(len(ACTIONS)):
            target = destination(node, a)
            if target is None:
                continue
            available[s, a] = True
            successors[s, a] = index[target, _entry(node, target)]
            if node != HOME:
                features[s, a] = features_of(node, entry, a, target)
    mdp = TabularMDP.from_successors(
        successors,
        np.ones((*shape, 1)),
        features,
        initial=np.eye(len(places))[index[0, FROM_ABOVE]],
        discount=discount,
        available=available,
        states=["home" if n == HOME else f"{n} {ENTRIES[e]}" for n, e in places],
        actions=ACTIONS,
        feature_names=feature_names,
    )
    nodes, entries = np.array(places).T
    return Labyrinth(mdp, nodes, entries)


def _entry(node: int, target: int) -> int:
    """Return the action that leads from ``node`` to ``target``."""
    if target == HOME:
        return AT_HOME
    if target >= FIRST_END:
        return AT_END
    if parent_of(target) == node:
        return FROM_ABOVE
    return FROM_LEFT if node == 2 * target + 1 else FROM_RIGHT


def _features(node: int, entry: int, action: int, target: int) -> Float[np.ndarray, " K"]:
    came_from = {FROM_ABOVE: BACK, FROM_LEFT: LEFT, FROM_RIGHT: RIGHT, AT_END: BACK}[entry]
    shared = [
        target == HOME,
        target == WATER_PORT,
        FIRST_END <= target < N_NODES,
        action == came_from,
        action != BACK,
        max(level_of(target), 0) / LEVELS,
    ]
    return np.concatenate([np.array(shared, float), np.arange(N_NODES) == target])


# -- recordings ---------------------------------------------------------------------------------------


@shown_briefly
class Bout(NamedTuple):
    """One visit to the maze.

    Fields
    ------
    id : str or None
    nodes : tuple of int
        The nodes visited, from 0 on; ends at home (127) unless the recording stopped before.
    frames : tuple of int or None
        The video frame at which each was reached.
    """

    id: str | None
    nodes: tuple[int, ...]
    frames: tuple[int, ...] | None = None


def read_bouts(
    lines: Iterable[str | bytes], source: str = "input", limits: LineLimits = DEFAULT_LIMITS
) -> Iterator[Bout]:
    """Read a recording of junction sequences from JSON Lines, one bout a line.

    A line is ``{"nodes": [0, 2, ..., 127]}``, optionally with ``id`` (string) and ``frames`` (as many
    numbers, not decreasing). Blank lines are skipped. A bout begins at node 0; every step goes to the
    parent or to a child; home may only be the last node. A bout that does not end at home is accepted: the
    recording stopped while the animal was inside. ``limits`` bounds the characters and nodes of a line.
    Raises :class:`DemonstrationError` naming ``source``, line and position in ``nodes``.

    See Also
    --------
    i2rl.domains.demonstration_of : make trajectories of bouts
    i2rl.domains.simulate_bouts : bouts without a recording
    i2rl.analysis.labyrinth_study : learn from a recording

    Examples
    --------
    >>> from i2rl.domains import read_bouts
    >>> first, second = read_bouts(['{"id": "a", "nodes": [0, 2, 0, 127]}', '{"nodes": [0, 1, 4]}'])
    >>> first.id, first.nodes, second.nodes
    ('a', (0, 2, 0, 127), (0, 1, 4))
    """
    for _, where, content in parsed_lines(lines, source, limits=limits):
        if not isinstance(content, dict) or not isinstance(content.get("nodes"), list):
            raise DemonstrationError(f'{where}: a bout is an object with a list "nodes"')
        unknown = content.keys() - {"id", "nodes", "frames"}
        if unknown:
            raise DemonstrationError(
                f"{where}: unknown field {shortened(min(unknown))}; a bout has id, nodes and frames"
            )
        nodes, frames = content["nodes"], content.get("frames")
        require_few(len(nodes), "nodes", where, limits)
        _check_nodes(nodes, where)
        if frames is not None:
            _check_frames(frames, len(nodes), where)
        identity = identity_of(content.get("id"), where)
        yield Bout(identity, tuple(nodes), None if frames is None else tuple(frames))


def _check_nodes(nodes: list[Any], where: str) -> None:
    if len(nodes) < 2:
        raise DemonstrationError(f"{where}: a bout visits at least two nodes, got {len(nodes)}")
    for t, node in enumerate(nodes):
        if isinstance(node, bool) or not isinstance(node, int) or not 0 <= node <= HOME:
            raise DemonstrationError(
                f"{where}, nodes[{t}]: unknown node {shortened(node)}; nodes are 0 to {N_NODES - 1}; {HOME} "
                "is home"
            )
    if nodes[0] != 0:
        raise DemonstrationError(f"{where}, nodes[0]: a bout begins at node 0, got {nodes[0]}")
    for t, (node, target) in enumerate(pairwise(nodes), start=1):
        if node == HOME:
            raise DemonstrationError(
                f"{where}, nodes[{t}]: the bout goes on after home; write the next visit on its own line"
            )
        if target not in {destination(node, a) for a in range(len(ACTIONS))}:
            raise DemonstrationError(
                f"{where}, nodes[{t}]: no step leads from node {node} to {target}, "
                "which is neither its parent nor a child"
            )


def _check_frames(frames: Any, n_nodes: int, where: str) -> None:
    if not isinstance(frames, list) or len(frames) != n_nodes:
        given = len(frames) if isinstance(frames, list) else shortened(frames)
        raise DemonstrationError(
            f"{where}: frames must be a list of one number per node ({n_nodes}), got {given}"
        )
    for t, frame in enumerate(frames):
        if isinstance(frame, bool) or not isinstance(frame, int | float) or not abs(frame) < 2**63:
            raise DemonstrationError(f"{where}, frames[{t}]: a frame is a number, got {shortened(frame)}")
        if t and frame < frames[t - 1]:
            raise DemonstrationError(
                f"{where}, frames[{t}]: frames go backwards, {shortened(frames[t - 1])} to {shortened(frame)}"
            )


def pairs_of(maze: Labyrinth, nodes: Sequence[int]) -> tuple[Int[np.ndarray, " L"], Int[np.ndarray, " L"]]:
    """Return states and actions ``[len(nodes) - 1]`` of a valid sequence of nodes that begins at node 0."""
    successors = np.asarray(maze.mdp.successors)[..., 0]
    available = np.asarray(maze.mdp.available)
    leads_to = np.where(available, maze.node[successors], -1)
    state, states, actions = int(np.argmax(maze.mdp.initial)), [], []
    for target in nodes[1:]:
        action = int(np.flatnonzero(leads_to[state] == target)[0])
        states.append(state)
        actions.append(action)
        state = int(successors[state, action])
    return np.array(states), np.array(actions)


def nodes_of(
    maze: Labyrinth, states: Int[np.ndarray, " L"], actions: Int[np.ndarray, " L"]
) -> tuple[int, ...]:
    """List the nodes that pairs pass through, with the last one reached; the inverse of :func:`pairs_of`."""
    last = np.asarray(maze.mdp.successors)[states[-1], actions[-1], 0]
    return tuple(int(n) for n in maze.node[[*states, last]])


def demonstration_of(maze: Labyrinth, bouts: Sequence[Bout]) -> Demonstration:
    """Return bouts as fully observed trajectories, one a row; ``ValueError`` if there are none.

    See Also
    --------
    i2rl.domains.read_bouts : read bouts
    i2rl.domains.mouse_labyrinth : the maze they are in

    Examples
    --------
    >>> from i2rl.domains import Bout, demonstration_of, mouse_labyrinth
    >>> maze = mouse_labyrinth()
    >>> demonstration = demonstration_of(maze, [Bout("a", (0, 2, 0, 127)), Bout("b", (0, 1, 4))])
    >>> demonstration.lengths.tolist()
    [3, 2]
    >>> [maze.mdp.action_names[a] for a in demonstration.action[0]]
    ['right', 'back', 'back']
    """
    return concatenate([Demonstration.from_pairs(*pairs_of(maze, bout.nodes)) for bout in bouts])


def conceal(demonstration: Demonstration, visibility: Visibility) -> Demonstration:
    """Hide the steps in states that a view (a mask) does not cover; they stay in place, as hidden steps."""
    covered = np.asarray(visibility.in_view) > 0
    kind = np.asarray(demonstration.kind)
    hidden = (kind == SEEN) & ~covered[demonstration.state]
    return Demonstration(
        np.where(hidden, HIDDEN, kind).astype(np.int8),
        np.where(hidden, UNKNOWN, demonstration.state).astype(np.int32),
        np.where(hidden, UNKNOWN, demonstration.action).astype(np.int32),
        np.where(hidden, np.nan, demonstration.score),
    )


# -- simulated mice -----------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=(3, 4))
def _simulate(
    key: Array, mdp: TabularMDP, weights: Float[Array, " K"], n: int, length: int
) -> tuple[Int[Array, "n L"], Int[Array, "n L"]]:
    log_policy = soft_plan(mdp, reward_of(mdp, weights)).log_policy
    return jax.vmap(lambda k: simulate(k, mdp, log_policy, length))(jax.random.split(key, n))


def simulate_bouts(
    key: Array, maze: Labyrinth, weights: Float[np.ndarray, " K"], n: int, max_steps: int = 512
) -> list[Bout]:
    """Simulate bouts of a mouse that follows the soft policy of ``weights [K]``.

    A bout that has not come home after ``max_steps`` steps is cut off there, as by the end of a recording.

    See Also
    --------
    i2rl.domains.demonstration_of : make trajectories of bouts
    i2rl.analysis.labyrinth_study : learn from them

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import mouse_labyrinth, simulate_bouts
    >>> maze = mouse_labyrinth()
    >>> bouts = simulate_bouts(jax.random.key(0), maze, jax.numpy.zeros(maze.mdp.n_features), 3, max_steps=64)
    >>> len(bouts), bouts[0].id, bouts[0].nodes[0]
    (3, 'simulated-0', 0)
    """
    states, actions = (np.asarray(x) for x in _simulate(key, maze.mdp, jnp.asarray(weights), n, max_steps))
    bouts = []
    for i in range(n):
        total = int((maze.node[states[i]] != HOME).sum())
        bouts.append(Bout(f"simulated-{i}", nodes_of(maze, states[i, :total], actions[i, :total])))
    return bouts
