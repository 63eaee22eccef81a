"""Object World (Levine, Popović and Koltun, NIPS 2011) as in chapter 5: a walled grid with two objects.

Table 5.1's world has 10 x 10 cells, a desirable object in each of two corners, and walls at random. The
dissertation gives neither the number of walls nor the reward; both are parameters here. Cells are ``(row,
column)``, rows grow southward. A move leads to the neighbouring cell, or nowhere if a wall or the edge is in
the way: moving against a wall is one more action that stays. :func:`without_blocked_moves` is the same world
where it is no action at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.inputs.display import shown_briefly
from ...models.process.layout import Layout, Mark
from ...models.process.mdp import TabularMDP

Cell = tuple[int, int]

ACTIONS = ("north", "south", "east", "west", "stay")
STAY = 4
STEPS = ((-1, 0), (1, 0), (0, 1), (0, -1), (0, 0))
FEATURES = ("at the first object", "at the second object", "moves")
_MOST_DRAWS = 10_000


@shown_briefly
class ObjectWorld(NamedTuple):
    """Walled grid with two objects and a reward.

    Fields
    ------
    mdp : TabularMDP
        A state for every free cell, in reading order, named like ``(3,4)``. The features of a pair say
        whether the cell it is taken in holds the first or the second object, and whether it leads elsewhere.
    walls : bool ``[rows, columns]``
        Cells that block movement.
    objects : tuple of two cells
        Cells of the first and the second object.
    weights : float ``[3]``
        The reward that makes them desirable.
    cells : tuple of cells
        The cell of each state.
    """

    mdp: TabularMDP
    walls: Bool[np.ndarray, "rows columns"]
    objects: tuple[Cell, Cell]
    weights: Float[np.ndarray, " K"]
    cells: tuple[Cell, ...]

    @property
    def layout(self) -> Layout:
        """The free cells for pictures, with the objects marked."""
        first, second = self.objects
        marks = (Mark("1", first, "the first object"), Mark("2", second, "the second object"))
        return Layout.grid(self.cells, marks=marks)

    def state_of(self, cell: Cell) -> int:
        """Return the state of a free cell. Raises ``ValueError`` for a wall and outside the grid."""
        cell = (int(cell[0]), int(cell[1]))
        if cell not in self.cells:
            raise ValueError(f"cell {cell} is no free cell of this {_size(self.walls)} world")
        return self.cells.index(cell)


def random_object_world(
    key: Array,
    size: int = 10,
    walls: int = 25,
    *,
    objects: tuple[Cell, Cell] | None = None,
    weights: Sequence[float] = (1.0, 1.0, 0.0),
    slip: float = 0.0,
    discount: float = 0.99,
) -> ObjectWorld:
    """Draw a world of ``size x size`` cells, ``walls`` of them walls, uniformly among the connected layouts.

    ``objects`` defaults to the first and the last corner. A layout whose free cells are not all reachable
    from one another is drawn again. The same key draws the same world. The rest as :func:`walled_world`.

    Raises ``ValueError`` for a size below 2, a number of walls that leaves less than two cells besides the
    objects' or is negative, and where no connected layout turns up in 10 000 draws.

    See Also
    --------
    i2rl.analysis.label_bias_study : a study of many worlds
    i2rl.domains.five_cells : a smaller process

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import random_object_world
    >>> world = random_object_world(jax.random.key(0), size=6, walls=5)
    >>> world.mdp.n_states, int(world.walls.sum()), world.objects
    (31, 5, ((0, 0), (5, 5)))
    >>> world.state_of((5, 5))
    30
    """
    if size < 2:
        raise ValueError(f"an object world needs at least 2 x 2 cells, got size {size}")
    if objects is None:
        objects = ((0, 0), (size - 1, size - 1))
    taken = _checked_objects(objects, (size, size))
    most = size * size - len(taken)
    if not 0 <= walls <= most:
        raise ValueError(f"a {size} x {size} world has room for 0 to {most} walls, got {walls}")
    free = [r * size + c for r, c in product(range(size), repeat=2) if (r, c) not in taken]
    # One seed of NumPy's generator, since a layout may take thousands of draws.
    draws = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    for _ in range(_MOST_DRAWS):
        layout = np.zeros((size, size), bool)
        layout.flat[draws.choice(free, walls, replace=False)] = True
        if _connected(layout):
            return walled_world(layout, objects, weights=weights, slip=slip, discount=discount)
    raise ValueError(
        f"no connected layout of {walls} walls in {size} x {size} cells turned up in {_MOST_DRAWS} draws; "
        "ask for fewer walls"
    )


def walled_world(
    walls: Bool[np.ndarray, "rows columns"],
    objects: tuple[Cell, Cell],
    *,
    weights: Sequence[float] = (1.0, 1.0, 0.0),
    slip: float = 0.0,
    discount: float = 0.99,
) -> ObjectWorld:
    """Build the world with these walls and objects.

    ``weights`` are of being at the first object, being at the second, and moving. With probability ``slip``
    a move goes in one of the four directions at random; staying never slips. The first cell is drawn
    uniformly. Raises ``ValueError`` for walls that are no boolean grid or cut free cells off,
    objects that are not two different free cells, weights that are not three finite numbers, a ``slip``
    outside [0, 1] and a discount outside (0, 1].
    """
    walls = np.asarray(walls)
    if walls.dtype != bool or walls.ndim != 2:
        raise ValueError(f"walls must be a boolean array [rows, columns], got {walls.dtype} {walls.shape}")
    objects = _checked_objects(objects, walls.shape)
    for cell in objects:
        if walls[cell]:
            raise ValueError(f"the object at {cell} lies in a wall")
    if not _connected(walls):
        raise ValueError(f"walls cut this {_size(walls)} world in parts; every free cell must be reachable")
    theta = np.asarray(weights, float)
    if theta.shape != (len(FEATURES),) or not np.isfinite(theta).all():
        raise ValueError(f"weights must be three finite numbers ({', '.join(FEATURES)}), got {weights}")
    if not 0 <= slip <= 1:
        raise ValueError(f"slip must lie in [0, 1], got {slip}")
    cells = tuple((int(r), int(c)) for r, c in np.argwhere(~walls))
    mdp = _decision_process(cells, objects, slip, discount)
    return ObjectWorld(mdp, walls, objects, theta, cells)


def _decision_process(
    cells: tuple[Cell, ...], objects: tuple[Cell, Cell], slip: float, discount: float
) -> TabularMDP:
    index = {cell: s for s, cell in enumerate(cells)}
    target = np.array(
        [[index.get((r + down, c + across), s) for down, across in STEPS] for s, (r, c) in enumerate(cells)]
    )
    shape = target.shape
    moves = np.arange(len(ACTIONS)) != STAY
    # Branch 0 is what was intended, the others are where a slip may lead.
    slipped = np.where(moves[:, None], target[:, None, moves], target[:, STAY, None, None])
    successors = np.concatenate([target[..., None], slipped], axis=2)
    probabilities = np.concatenate([np.full((*shape, 1), 1 - slip), np.full(slipped.shape, slip / 4)], axis=2)
    if slip == 0:
        successors, probabilities = successors[..., :1], probabilities[..., :1]
    features = np.zeros((*shape, len(FEATURES)))
    for k, place in enumerate(objects):
        features[index[place], :, k] = 1.0
    features[..., -1] = target != target[:, [STAY]]
    return TabularMDP.from_successors(
        successors,
        probabilities,
        features,
        discount=discount,
        states=[f"({r},{c})" for r, c in cells],
        actions=ACTIONS,
        feature_names=FEATURES,
    )


def without_blocked_moves(world: ObjectWorld) -> ObjectWorld:
    """Remove the actions that run into a wall or the edge, so that cells differ in their choices."""
    mdp = world.mdp
    open_way = np.asarray(mdp.features)[..., -1] > 0
    open_way[:, STAY] = True
    restricted = TabularMDP.from_successors(
        np.asarray(mdp.successors),
        np.asarray(mdp.probabilities),
        np.asarray(mdp.features),
        initial=np.asarray(mdp.initial),
        discount=float(mdp.discount),
        available=open_way,
        states=mdp.state_names,
        actions=mdp.action_names,
        feature_names=mdp.feature_names,
    )
    return world._replace(mdp=restricted)


def _connected(walls: Bool[np.ndarray, "rows columns"]) -> bool:
    from scipy.ndimage import label  # loading it takes a quarter of a second

    return label(~walls)[1] <= 1


def _checked_objects(objects: Sequence[Cell], shape: tuple[int, ...]) -> tuple[Cell, Cell]:
    places = [tuple(int(i) for i in cell) for cell in objects]
    inside = all(len(p) == 2 and 0 <= p[0] < shape[0] and 0 <= p[1] < shape[1] for p in places)
    if len(places) != 2 or len(set(places)) != 2 or not inside:
        raise ValueError(
            f"objects must be two different cells of the {shape[0]} x {shape[1]} grid, got {objects}"
        )
    first, second = places
    return (first[0], first[1]), (second[0], second[1])


def _size(walls: np.ndarray) -> str:
    return f"{walls.shape[0]} x {walls.shape[1]}"
