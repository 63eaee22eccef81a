"""Changes of a reward that leave behaviour unchanged, found by linear algebra and named.

A direction ``d`` of weight space changes no soft policy on a closed set of states if and only if ``d.phi(s,
a) = h(s) - gamma E[h(s')]`` there for some potential ``h`` (Ng, Harada and Russell 1999): one sense follows
by differentiating the soft Bellman equations, the other by putting ``V + h`` into them. Zero and constant
``d.phi`` are the simplest cases. A direction that changes no policy at some weights therefore changes none at
all weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import comb, inf
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...models.process.mdp import TabularMDP
from ...models.process.planning import features_to_go, reachable_states, require_discounted, soft_plan
from ..drawing.text import number
from .information import policy_sensitivity

NEVER_ACTIVE, DUPLICATE, COLLINEAR, CONSTANT = "never active", "duplicate", "collinear", "constant"
SHAPING, NOT_VISITED, WEAK = "potential shaping", "not visited", "weakly determined"

# Root mean square over pairs below which a scaled feature, divided by the horizon 1 / (1 - gamma), is zero.
_ZERO = 1e-9
# Supports of one size are searched for sparse directions while there are no more of them than this.
_MOST_SUPPORTS = 20_000


class Direction(NamedTuple):
    """A direction of weight space that is not determined.

    Fields
    ------
    vector : float ``[K]``
        Of length one.
    standard_error : float
        How far the weights can move along it before the log-likelihood falls by half a nat, by its
        curvature, ``(d' I d)^(-1/2)``; infinite where there is none.
    loss : (float, float)
        Nats of log-likelihood really lost by moving one ``scale`` along and against it: they differ where
        the demonstrations bound the direction from one side only. NaN if no demonstration was given.
    kind : str
        One of the kinds named in this module.
    description : str
        Its meaning, in terms of the features.
    exact : bool
        Whether it is exactly unidentified, as opposed to weakly determined.
    """

    vector: Float[np.ndarray, " K"]
    standard_error: float
    loss: tuple[float, float]
    kind: str
    description: str
    exact: bool


def unidentified_directions(
    mdp: TabularMDP, visited: Bool[np.ndarray, " S"] | None = None
) -> tuple[Direction, ...]:
    """Find the directions that change no policy at any reachable state, in sparse, named form.

    They are a complete basis: every other such direction is a sum of these. Each is named by the simplest
    reason that holds: never active, duplicate, collinear, constant, potential shaping, not visited.

    Parameters
    ----------
    mdp : TabularMDP
        With discount below 1.
    visited : bool ``[S]``, optional
        States where the demonstrations may have been. Directions that matter only at states unreachable from
        those are *not visited*.

    Raises
    ------
    ValueError
        For discount 1, or ``visited`` of the wrong shape or empty.
    """
    require_discounted(mdp)
    if visited is not None and (np.shape(visited) != (mdp.n_states,) or not np.any(visited)):
        raise ValueError(
            f"shown must mark at least one of {mdp.n_states} states in a boolean array [{mdp.n_states}], "
            f"got shape {np.shape(visited)} with {np.count_nonzero(visited)} marked"
        )
    reachable = reachable_states(mdp)
    onward = reachable if visited is None else reachable_states(mdp, np.asarray(visited, float))
    available = np.asarray(mdp.available)
    pairs = available & reachable[:, None]
    features = np.asarray(mdp.features)
    # Policies depend on the direction either for all weights or for none: zero weights are as good as any.
    slope = np.asarray(policy_sensitivity(mdp, jnp.zeros(mdp.n_features)))
    size = np.abs(features[pairs]).max(axis=0)
    unit = np.where(size > 0, size, 1.0)
    active = features[pairs] / unit
    horizon = 1.0 / (1.0 - float(mdp.discount))
    stages = (
        (None, active, _ZERO),
        (CONSTANT, active - active.mean(axis=0), _ZERO),
        (SHAPING, slope[pairs] / unit, _ZERO * horizon),
        (NOT_VISITED, slope[available & onward[:, None]] / unit, _ZERO * horizon),
    )
    found: list[Direction] = []
    pivots: list[int] = []
    for kind, rows, tolerance in stages:
        # Directions already named are set aside by doing without one feature of each.
        free = np.setdiff1d(np.arange(mdp.n_features), pivots)
        null = _null_space(rows[:, free], tolerance)
        basis = np.zeros((mdp.n_features, null.shape[1]))
        basis[free] = null
        sparse = sparse_basis(basis, 1e-6)
        for scaled in sparse.T:
            vector = np.where(np.abs(scaled) > 1e-6, scaled, 0.0) / unit
            found.append(_named(mdp, kind, vector / np.linalg.norm(vector), pairs, onward))
        pivots += _pivots(sparse)
    return tuple(found)


def _null_space(rows: Float[np.ndarray, "P K"], tolerance: float) -> Float[np.ndarray, "K m"]:
    """Compute an orthonormal basis of the rows' null space, by root mean square over the rows."""
    triangle = np.linalg.qr(rows, mode="r")
    _, values, axes = np.linalg.svd(triangle, full_matrices=True)
    values = np.pad(values, (0, rows.shape[1] - len(values)))
    return axes[values <= tolerance * np.sqrt(len(rows))].T


def sparse_basis(basis: Float[np.ndarray, "K m"], tolerance: float) -> Float[np.ndarray, "K m"]:
    """Find another basis of the same space, of unit vectors with few features, up to ``tolerance``.

    Takes the sparsest independent vectors by trying supports from small to large; where there are too many
    supports to try, what then remains is left as it is.
    """
    size, count = basis.shape
    found = np.zeros((size, 0))

    def beyond(vectors: np.ndarray) -> np.ndarray:
        span = np.linalg.qr(found)[0]
        return vectors - span @ (span.T @ vectors)

    for support_size in range(1, size + 1):
        if found.shape[1] == count or comb(size, support_size) > _MOST_SUPPORTS:
            break
        supports = np.array(list(combinations(range(size), support_size)))
        # A unit vector of the space has little outside the support if the Gram matrix of what is outside
        # has a small eigenvalue.
        inside = np.einsum("csm,csn->cmn", basis[supports], basis[supports])
        values, axes = np.linalg.eigh(np.eye(count) - inside)
        for row in np.argsort(values[:, 0], kind="stable"):
            vector = basis @ axes[row, :, 0]
            if values[row, 0] > max(tolerance**2, 1e-14) or found.shape[1] == count:
                break
            if np.linalg.norm(beyond(vector)) > max(1e-3, 3 * tolerance):
                found = np.column_stack([found, vector])
    left = np.linalg.svd(beyond(basis), full_matrices=False)[0]
    return np.column_stack([found, left[:, : count - found.shape[1]]])


def _pivots(vectors: Float[np.ndarray, "K m"]) -> list[int]:
    """Find one feature for each vector, as late as possible, that make the vectors independent."""
    chosen: list[int] = []
    for k in reversed(range(len(vectors))):
        if np.linalg.matrix_rank(vectors[[*chosen, k]], tol=1e-3) > len(chosen):
            chosen.append(k)
    return chosen


# -- names --------------------------------------------------------------------------------------------


def combination(features: Sequence[str], vector: Float[np.ndarray, " K"], least: float = 0.0) -> str:
    """Write a direction in words, such as ``\\`moves\\` + 0.5 \\`turns\\```, scaled to one at most.

    Coefficients that are zero or below ``least`` times the largest are left out.
    """
    relative = vector / vector[np.argmax(np.abs(vector) > (1 - 1e-9) * np.abs(vector).max())]
    words = ""
    for name, value in zip(features, relative, strict=True):
        if value == 0 or abs(value) < least:
            continue
        sign = ("-" if not words else " - ") if value < 0 else ("" if not words else " + ")
        amount = "" if abs(abs(value) - 1) < 5e-4 else f"{number(abs(value))} "
        words += f"{sign}{amount}`{name}`"
    return words


def _named(
    mdp: TabularMDP,
    kind: str | None,
    vector: Float[np.ndarray, " K"],
    pairs: Bool[np.ndarray, "S A"],
    onward: Bool[np.ndarray, " S"],
) -> Direction:
    words = combination(mdp.feature_names, vector)
    names = [mdp.feature_names[k] for k in np.flatnonzero(vector)]
    features = np.asarray(mdp.features)
    if kind is None and len(names) == 1:
        kind = NEVER_ACTIVE
        elsewhere = bool(np.any(features @ vector))
        where = "that can be reached" if elsewhere else "there is"
        text = f"`{names[0]}` is zero for every state and action {where}"
    elif kind is None and len(names) == 2:
        kind = DUPLICATE
        first, second = vector[np.flatnonzero(vector)]
        ratio = -first / second
        same = abs(ratio - 1) < 1e-6
        copy = "the same as" if same else f"{ratio:.3g} times"
        total = f"{names[0]}` + {'' if same else f'{number(ratio)} '}`{names[1]}"
        text = f"`{names[1]}` is {copy} `{names[0]}`: only the weights' sum `{total}` matters"
    elif kind is None:
        kind = COLLINEAR
        text = f"{words} is zero for every state and action"
    elif kind == CONSTANT:
        value = (features[pairs] @ (vector / np.abs(vector).max())).mean()
        text = f"{words} is {abs(value):.3g} for every action, so it rewards no behaviour in particular"
    elif kind == SHAPING:
        text = f"{words} pays early and takes the same back later: {_potential(mdp, vector)}"
    else:
        missed = reachable_states(mdp) & ~onward
        example = mdp.state_names[int(np.argmax(missed))]
        text = (
            f"{words} changes behaviour only in {missed.sum()} states that the demonstrations never show, "
            f"such as {example}"
        )
    return Direction(vector, inf, (np.nan, np.nan), kind, text, True)


@jax.jit
def _features_to_go(mdp: TabularMDP) -> Float[Array, "S K"]:
    """Compute expected discounted features under zero weights: their values, in the units of the weights."""
    return features_to_go(mdp, soft_plan(mdp, jnp.zeros(mdp.available.shape)).policy)


def _potential(mdp: TabularMDP, vector: Float[np.ndarray, " K"]) -> str:
    """Find the potential whose changes a shaping direction rewards."""
    scaled = vector / vector[np.argmax(np.abs(vector) > (1 - 1e-9) * np.abs(vector).max())]
    reachable = reachable_states(mdp)
    potential = np.asarray(_features_to_go(mdp)) @ scaled
    potential = np.round(potential - potential[reachable].min(), 6)
    levels, counts = np.unique(potential[reachable], return_counts=True)
    if len(levels) > 2:
        return f"a potential of {len(levels)} levels over the states"
    rarer = levels[np.argmin(counts)]
    states = np.flatnonzero(reachable & (potential == rarer))
    other = levels.max() - levels.min()
    example = mdp.state_names[states[0]]
    return f"a potential that sets {len(states)} states apart by {other:.3g}, such as {example}"
