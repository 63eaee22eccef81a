"""Layouts of a process's states for pictures: cells of a grid, points, or a graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from ..inputs.display import shown_briefly
from .mdp import TabularMDP

# Of stress majorisation, after which no picture changes visibly.
_SWEEPS = 200


class Mark(NamedTuple):
    """A letter on a place of the map, with its meaning: ``Mark("G", (3, 1), "its goal")``."""

    letter: str
    position: tuple[float, float]
    meaning: str


@shown_briefly
class Layout(NamedTuple):
    """Places, and the place of each state; built by :meth:`grid`, :meth:`points` or :meth:`graph`.

    Fields
    ------
    kind : {"grid", "points", "graph"}
        What positions mean: cells as (row, column), coordinates (x, y), or nothing but who neighbours whom.
    positions : float ``[P, 2]``
        Where each place lies.
    place : int ``[S]``
        The place of each state; several states may share one.
    edges : int ``[E, 2]``
        Places that a transition joins, the smaller number first; of a grid the cells that touch.
    names : tuple of str
        A short name for each place.
    heading : float ``[S]``, optional
        Where a state faces, in radians against the clock from the reader's right.
    layer : int ``[S]``
        The panel each state is drawn on.
    layers : tuple of str
        Titles of the panels.
    marks : tuple of Mark
        Places worth a letter.
    floor : tuple of cells
        Further cells of a grid that hold no state.
    unit : str
        The unit of coordinates.
    """

    kind: str
    positions: Float[np.ndarray, "P 2"]
    place: Int[np.ndarray, " S"]
    edges: Int[np.ndarray, "E 2"]
    names: tuple[str, ...]
    heading: Float[np.ndarray, " S"] | None = None
    layer: Int[np.ndarray, " S"] = np.zeros(0, int)
    layers: tuple[str, ...] = ("",)
    marks: tuple[Mark, ...] = ()
    floor: tuple[tuple[int, int], ...] = ()
    unit: str = ""

    @property
    def n_states(self) -> int:
        """Number of states, ``S``."""
        return len(self.place)

    @property
    def n_places(self) -> int:
        """Number of places, ``P``."""
        return len(self.positions)

    @staticmethod
    def grid(
        cells: Sequence[tuple[int, int]] | Int[np.ndarray, "S 2"],
        *,
        headings: Float[np.ndarray, " S"] | None = None,
        layers: Sequence[str] | None = None,
        marks: Sequence[Mark] = (),
        floor: Sequence[tuple[int, int]] = (),
    ) -> Layout:
        """Lay states out on the cells (row, column) of a grid, row 0 at the top.

        States of one cell are drawn side by side, or at the sides that they face if ``headings`` (radians)
        are given. ``layers`` names a panel for each state. Raises ``ValueError`` for arrays that do not fit.

        See Also
        --------
        points, graph

        Examples
        --------
        >>> Layout.grid([(0, 0), (0, 1), (0, 1)]).names
        ('(0,0)', '(0,1)')
        """
        given = np.asarray(cells)
        if given.ndim != 2 or given.shape[1:] != (2,) or not len(given) or (given != np.round(given)).any():
            raise ValueError(f"cells must be whole numbers [S, 2] as (row, column); got shape {given.shape}")
        places, place = np.unique(given.astype(int), axis=0, return_inverse=True)
        index = {cell: i for i, cell in enumerate(map(tuple, places.tolist()))}
        edges = [
            (i, index[other])
            for (row, column), i in index.items()
            for other in ((row, column + 1), (row + 1, column))
            if other in index
        ]
        names = tuple(f"({row},{column})" for row, column in index)
        layout = _checked("grid", places.astype(float), place.reshape(-1), edges, names, headings, layers)
        return layout._replace(
            marks=tuple(marks), floor=tuple((int(row), int(column)) for row, column in floor)
        )

    @staticmethod
    def points(
        positions: Float[np.ndarray, "S 2"],
        mdp: TabularMDP,
        *,
        unit: str = "",
        headings: Float[np.ndarray, " S"] | None = None,
        layers: Sequence[str] | None = None,
        marks: Sequence[Mark] = (),
    ) -> Layout:
        """Lay states out at coordinates (x, y), joined where ``mdp`` has a transition.

        Raises ``ValueError`` for arrays that do not fit.

        See Also
        --------
        grid, graph
        """
        given = np.asarray(positions, float)
        if given.shape != (mdp.n_states, 2) or not np.isfinite(given).all():
            raise ValueError(
                f"positions must be numbers of shape {(mdp.n_states, 2)} as (x, y); got shape {given.shape}"
            )
        places, first, place = np.unique(given, axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        names = _names(mdp, first)
        return _checked("points", places, place, _edges(mdp, place), names, headings, layers)._replace(
            marks=tuple(marks), unit=unit
        )

    @staticmethod
    def graph(mdp: TabularMDP) -> Layout:
        """Lay states out by the transitions of ``mdp`` alone: neighbours close, others apart.

        Distances on the page come as near as they can to numbers of transitions, whatever their direction
        (stress majorisation; Gansner, Koren and North 2004).

        See Also
        --------
        grid, points
        """
        place = np.arange(mdp.n_states)
        edges = _edges(mdp, place)
        positions = _majorised(_distances(edges, mdp.n_states))
        return _checked("graph", positions, place, edges, _names(mdp, place), None, None)


def require_layout(layout: Layout, mdp: TabularMDP) -> None:
    """Raise ``TypeError`` for what is no layout, and ``ValueError`` for one of another number of states."""
    if not isinstance(layout, Layout):
        raise TypeError(
            "layout must be a Layout, such as Layout.grid(cells), Layout.points(xy, mdp), Layout.graph(mdp) "
            f"or a domain's `layout`; got {type(layout).__name__}"
        )
    if layout.n_states != mdp.n_states:
        raise ValueError(f"layout must place the {mdp.n_states} states of the process; got {layout.n_states}")


def _checked(
    kind: str,
    positions: np.ndarray,
    place: np.ndarray,
    edges: Sequence[tuple[int, int]] | np.ndarray,
    names: tuple[str, ...],
    headings: Float[np.ndarray, " S"] | None,
    layers: Sequence[str] | None,
) -> Layout:
    n = len(place)
    for name, given in (("headings", headings), ("layers", layers)):
        if given is not None and len(given) != n:
            raise ValueError(f"{name} must be one for each of {n} states; got {len(given)}")
    titles = tuple(dict.fromkeys(map(str, layers or [""])))
    layer = np.array([titles.index(str(x)) for x in layers]) if layers is not None else np.zeros(n, int)
    heading = None if headings is None else np.asarray(headings, float)
    return Layout(kind, positions, place, np.array(edges, int).reshape(-1, 2), names, heading, layer, titles)


def _names(mdp: TabularMDP, states: np.ndarray) -> tuple[str, ...]:
    return tuple(mdp.labels.states[s] if mdp.labels.states else f"{s}" for s in states)


def _edges(mdp: TabularMDP, place: np.ndarray) -> Int[np.ndarray, "E 2"]:
    """Pairs of different places that an available transition joins."""
    probabilities = np.asarray(mdp.probabilities) * np.asarray(mdp.available)[..., None]
    s, a, b = np.nonzero(probabilities > 0)
    pairs = np.sort(np.stack([place[s], place[np.asarray(mdp.successors)[s, a, b]]], 1), axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


def _distances(edges: Int[np.ndarray, "E 2"], n: int) -> Float[np.ndarray, "P P"]:
    """Numbers of edges between places; parts that nothing joins are a little further than the farthest."""
    joined = sparse.csr_array((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
    distance = csgraph.shortest_path(joined, directed=False, unweighted=True)
    farthest = distance[np.isfinite(distance)].max(initial=1.0)
    return np.where(np.isfinite(distance), distance, farthest + 1)


def _majorised(distance: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P 2"]:
    """Positions whose distances are as near as possible to those given, relative to them."""
    n = len(distance)
    if n == 1:
        return np.zeros((1, 2))
    # Classical scaling is where to start: the best of all linear pictures.
    centred = distance**2 - (distance**2).mean(0)
    values, vectors = np.linalg.eigh(-0.5 * (centred - centred.mean(1, keepdims=True)))
    positions = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    # A fixed jitter parts places that coincide, which no sweep would.
    positions = positions + 0.05 * np.random.default_rng(0).normal(size=(n, 2))
    weights = np.where(np.eye(n) > 0, 0.0, 1 / np.maximum(distance, 1) ** 2)
    inverse = np.linalg.pinv(np.diag(weights.sum(1)) - weights)
    for _ in range(_SWEEPS):
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
        pull = -weights * distance / np.where(apart > 0, apart, np.inf)
        np.fill_diagonal(pull, -pull.sum(1))
        positions = inverse @ (pull @ positions)
    return positions
