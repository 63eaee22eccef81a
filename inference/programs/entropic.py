"""Mixture proportions under the entropic prior (Brand 1999): the min-entropy half of program (5.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import xlogy
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

# The equation for the largest proportion has one or two solutions that are maxima, searched on this grid.
_GRID = 64
_BISECTIONS = 54
# From the bound of _above_one, eight Newton steps reach rounding for every right-hand side.
_NEWTON_STEPS = 8
_NO_STRENGTH = 1e-14


def entropic_proportions(counts: Float[ArrayLike, " D"], strength: ArrayLike) -> Float[Array, " D"]:
    """Maximise ``sum_d n_d log pi_d + strength * sum_d pi_d log pi_d`` over proportions.

    The maximum is the mode of the posterior of mixture weights after (expected) counts ``n`` under the
    entropic prior ``p(pi) ~ exp(-strength H(pi))``, which prefers few components. Fixed shapes: works under
    ``jit``, ``vmap`` and ``scan``, where bad arguments cannot raise.

    At a maximum ``n_d / pi_d + strength log pi_d`` is the same for every ``d``. It falls with ``pi_d`` up to
    ``n_d / strength``, where a component's share of the objective is concave, and rises beyond. If some
    ``n_d < strength`` the problem is thus not concave. At a maximum at most one component is on its rising
    branch, and it has the largest count. Proof: proportions are in the order of the counts (exchanging two
    preserves the entropy), so that ``n_d / pi_d <= n_max / pi_max``. A rising ``d`` beside a falling largest
    component would contradict ``n_d / pi_d < strength <= n_max / pi_max`` with equal sums. The largest
    proportion therefore determines the others (by Newton's method on Lambert's equation), and is itself found
    where they sum to one; of two such points the better one is returned.

    Parameters
    ----------
    counts : float ``[D]``
        ``n_d >= 0``: number of trajectories of each component, fractions allowed. A component with count zero
        has proportion zero.
    strength : float
        ``lambda >= 0``; zero returns ``n / sum n``.

    Returns
    -------
    float ``[D]``
        Sum one; uniform if all counts are zero. Among equal largest counts, with strength enough to break the
        tie, the first is preferred.

    Raises
    ------
    ValueError
        For counts that are not a vector, or negative or not finite counts or strength.
    """
    counts, strength = jnp.asarray(counts, float), jnp.asarray(strength, float)
    if counts.ndim != 1 or not counts.size or strength.ndim:
        shapes = f"{list(counts.shape)} and {list(strength.shape)}"
        raise ValueError(f"expected counts [D] and one strength, got shapes {shapes}")
    for name, given in (("counts", counts), ("strength", strength)):
        if isinstance(given, jax.core.Tracer):
            continue
        if not (np.isfinite(given) & (np.asarray(given) >= 0)).all():
            raise ValueError(f"{name} must be finite and not negative, got {np.asarray(given)}")
    return _maximise(counts, strength)


def entropic_objective(
    proportions: Float[Array, " D"], counts: Float[ArrayLike, " D"], strength: ArrayLike
) -> Float[Array, ""]:
    """Return ``sum_d n_d log pi_d + strength * sum_d pi_d log pi_d`` (nats), where ``0 log 0 = 0``."""
    likelihood = xlogy(jnp.asarray(counts, float), proportions).sum()
    return likelihood + jnp.asarray(strength, float) * xlogy(proportions, proportions).sum()


@jax.jit
def _maximise(counts: Float[Array, " D"], strength: Float[Array, ""]) -> Float[Array, " D"]:
    total = counts.sum()
    some = total > 0
    largest = jnp.argmax(counts)
    most = jnp.where(some, counts[largest], 1.0)
    positive = counts > 0
    lag = jnp.where(positive, jnp.log(most) - jnp.log(jnp.where(positive, counts, 1.0)), 0.0)
    weak = strength <= _NO_STRENGTH * total
    scale = jnp.where(weak, 1.0, strength)

    def follow(first: Float[Array, " Q"]) -> Float[Array, "Q D"]:
        """Return all components' proportions, given the largest one."""
        # In x = n / (strength pi), stationarity says x - log x = constant - log n.
        ratio = most / (scale * first)
        excess = ratio - 1.0
        # Each logarithm where it is exact: counts may be tiny, and near one the difference is.
        depth = excess - jnp.where(ratio < 0.5, jnp.log(ratio), jnp.log1p(jnp.maximum(excess, -0.5)))
        x = 1.0 + _above_one(jnp.maximum(depth, 0.0)[:, None] + lag)
        others = jnp.where(positive, counts / (scale * x), 0.0)
        return others.at[:, largest].set(first)

    low = most / jnp.where(some, total, 1.0)
    grid = jnp.linspace(low, 1.0, _GRID)
    # By the bounds of the largest proportion, the sum is at most one at the first point and at least one at
    # the last; rounding must not hide that.
    enough = (follow(grid).sum(1) >= 1.0).at[0].set(False).at[-1].set(True)
    crossing = ~enough[:-1] & enough[1:]
    ends = jnp.stack([jnp.argmax(crossing), _GRID - 2 - jnp.argmax(crossing[::-1])])

    def halve(_: int, bracket: tuple) -> tuple:
        below, above = bracket
        middle = 0.5 * (below + above)
        over = follow(middle).sum(1) >= 1.0
        return jnp.where(over, below, middle), jnp.where(over, middle, above)

    _, first = lax.fori_loop(0, _BISECTIONS, halve, (grid[ends], grid[ends + 1]))
    candidates = follow(first)
    candidates = candidates / candidates.sum(1, keepdims=True)
    score = jax.vmap(entropic_objective, in_axes=(0, None, None))(candidates, counts, strength)
    best = candidates[jnp.argmax(score)]
    proportional = jnp.where(some, counts / jnp.where(some, total, 1.0), 1.0 / counts.size)
    return jnp.where(weak | ~some, proportional, best)


def _above_one(depth: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve ``w - log(1 + w) = depth`` for ``w >= 0``: Lambert's ``-W_{-1}(-exp(-1 - depth)) - 1``."""
    root = jnp.sqrt(2.0 * depth)
    # An upper bound (Chatzigeorgiou 2013), from which Newton's method on a convex function only descends.
    start = root + depth

    def step(_: int, w: Float[Array, " n"]) -> Float[Array, " n"]:
        safe = jnp.where(w > 0, w, 1.0)
        descent = (safe - jnp.log1p(safe) - depth) * (1.0 + safe) / safe
        return jnp.where(w > 0, jnp.maximum(safe - descent, 0.0), 0.0)

    return lax.fori_loop(0, _NEWTON_STEPS, step, start)
