"""Directions of weight space that the demonstrations do not determine, and their meaning.

Two different properties prevent the learning of a reward:

- *exactly unidentified*: moving the weights along the direction changes no policy anywhere a trajectory can
  get, so no amount of data determines it. This is a property of the features, found by linear algebra:
  ``d.phi(s, a) = h(s) - gamma E[h(s')]`` for some potential ``h`` (Ng, Harada and Russell 1999), of which
  zero and constant ``d.phi`` are the simplest cases. It holds for all weights if it holds for one;
- *weakly determined*: these demonstrations determine the direction less than a prior would. This is a
  property of the data, in the Fisher information.

The information is the observed one (:mod:`~i2rl.analysis.posteriors.information` has others): these
demonstrations determine the directions in which their likelihood, hidden steps summed out, is curved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float

from ...inference.completion.smoothing import evidence_of, smooth_all
from ...inference.posteriors.weights import gather, posterior_mode
from ...models.observation.demonstration import SEEN, Demonstration
from ...models.observation.evidence import (
    AnySensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted, reward_of, soft_plan
from ...models.process.units import feature_scale, with_scaled_features
from ..drawing.estimates import Estimates
from ..drawing.page import Section, Table
from ..drawing.text import number
from .information import observed_information, total_log_likelihoods
from .invariance import NOT_VISITED, WEAK, Direction, combination, sparse_basis, unidentified_directions

# Coefficients below this share of the largest are left out of the wording of a weak direction.
_MINOR = 0.15


class Identifiability(NamedTuple):
    """Directions of the weights that a demonstration determines.

    Fields
    ------
    features : names of the features
    weights : float ``[K]``
        Where the likelihood was examined.
    information : float ``[K, K]``
        Observed information there (nats per squared unit of weight).
    standard_errors : float ``[K]``
        Of each weight, from the inverse of the information; infinite if an exactly unidentified direction
        moves it or the likelihood does not curve downward.
    exact, weak : directions of the two sorts
        Exact ones are of the weights as given, weak ones of scaled weights
        (:mod:`~i2rl.models.process.units`).
    scale : float
        A direction counts as weakly determined if its standard error exceeds this.
    length_loss : (float, float)
        Nats lost by halving and by doubling all weights. An expert who never errs is fitted ever better by
        longer weights: the second is then negative, and the weights' common length comes from the prior.
    """

    features: tuple[str, ...]
    weights: Float[np.ndarray, " K"]
    information: Float[np.ndarray, "K K"]
    standard_errors: Float[np.ndarray, " K"]
    exact: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    scale: float
    length_loss: tuple[float, float]

    @property
    def estimates(self) -> Estimates:
        """The weights with their standard errors."""
        return Estimates(self.features, self.weights, self.standard_errors)

    @property
    def directions(self) -> tuple[Direction, ...]:
        """The exact ones, then the weak ones."""
        return self.exact + self.weak


# -- what demonstrations determine --------------------------------------------------------------------


@jax.jit
def _shown(
    weights: Float[Array, " K"], mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration
) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
    """Compute expected visits of each state, at all steps and at the steps that were seen."""
    evidence = evidence_of(mdp, sensor, demonstration)
    posterior = smooth_all(mdp, soft_plan(mdp, reward_of(mdp, weights)).log_policy, evidence)
    seen = jnp.asarray(demonstration.kind) == SEEN
    return jnp.sum(posterior.pairs, (0, 1, 3)), jnp.einsum("nlsa,nl->s", posterior.pairs, seen)


def identifiability_of(
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    weights: Float[Array | np.ndarray, " K"] | None = None,
    *,
    scale: float = 2.5,
) -> Identifiability:
    """Find and name the directions of weight space that a demonstration does not determine.

    Exactly unidentified ones by :func:`unidentified_directions`; weakly determined ones among the rest as
    eigenvectors of the observed information about scaled weights with a standard error above ``scale``,
    turned so that each involves few features.

    Parameters
    ----------
    mdp, sensor, demonstration
        The decision process, its sensor, the observations.
    weights : float ``[K]``, optional
        The point at which the likelihood is expanded; the posterior mode under the prior ``Normal(0, 2.5)``
        by default (the likelihood itself need not have a maximum).
    scale : float
        Plausible size of scaled weights (:mod:`~i2rl.models.process.units`). The default is the prior's
        standard deviation: a weak direction is determined by the prior more than by the demonstration.

    Raises
    ------
    DemonstrationError
        If the MDP and the sensor rule an observation out.
    ValueError
        For discount 1, an empty demonstration, weights of the wrong number or not finite, or a scale that
        is not positive.

    See Also
    --------
    i2rl.inference.sample_posterior : the posterior where it is weak
    i2rl.analysis.select_features : leave a feature out

    Examples
    --------
    >>> from i2rl.analysis import identifiability_of
    >>> from i2rl.domains import five_cells
    >>> mdp, weights, sensor, demonstration = five_cells()
    >>> found = identifiability_of(mdp, sensor, demonstration, weights)
    >>> found.features, len(found.exact), len(found.weak)
    (('at the end', 'moves'), 0, 0)
    >>> [bool(error < found.scale) for error in found.standard_errors]
    [True, True]
    """
    require_discounted(mdp)
    sensor, demonstration = fitting_sensor(sensor, mdp), checked_demonstration(mdp, demonstration)
    if not demonstration.lengths.any():
        raise ValueError("the demonstration must have steps; without data no direction is determined")
    if not scale > 0:
        raise ValueError(f"scale must be positive, got {scale}")
    require_possible(sensor, mdp, demonstration)
    units = np.asarray(feature_scale(mdp))
    if weights is None:
        # Unconstrained positions under a normal prior are scaled weights.
        weights = posterior_mode(gather(mdp, sensor, demonstration)[0]).position / units
    theta = np.asarray(weights, float)
    if theta.shape != (mdp.n_features,) or not np.isfinite(theta).all():
        raise ValueError(f"weights must be {mdp.n_features} numbers, one a feature, got {theta}")
    as_given = mdp
    mdp, theta = with_scaled_features(mdp), theta * units
    given = (mdp, sensor, demonstration.bucketed())
    # Zero weights take every action everywhere, so they visit every reachable state.
    visited = np.asarray(_shown(jnp.zeros(mdp.n_features), *given)[0]) > 0
    seen = np.asarray(_shown(jnp.asarray(theta), *given)[1]) > 1e-9
    information = observed_information(mdp, sensor, jnp.asarray(theta), demonstration)
    exact = unidentified_directions(as_given, visited)
    rest = _complement([direction.vector * units for direction in exact], mdp.n_features)
    values, axes = np.linalg.eigh(rest.T @ information @ rest)
    axes = rest @ axes
    weak = sparse_basis(axes[:, values < scale**-2], _MINOR)
    # Turned so that the largest coefficient is positive: rising means that its weight rises.
    weak = weak * np.sign(weak[np.argmax(np.abs(weak), axis=0), np.arange(weak.shape[1])])
    # As many points as there could be directions, so that one compiled program serves any number.
    moves = np.zeros((2, mdp.n_features, mdp.n_features))
    moves[:, : weak.shape[1]] = scale * weak.T, -scale * weak.T
    points = np.concatenate([theta * np.array([[1.0], [0.5], [2.0]]), theta + moves.reshape(-1, len(theta))])
    totals = total_log_likelihoods(mdp, sensor, jnp.asarray(points), demonstration)
    _, halved, doubled, *moved = (float(x) for x in totals[0] - totals)
    directions = [
        _weak(mdp, d, information, (along, against), seen, scale)
        for d, along, against in zip(weak.T, moved, moved[mdp.n_features :], strict=False)
    ]
    return Identifiability(
        mdp.feature_names,
        theta / units,
        information * np.outer(units, units),
        _standard_errors(values, axes, exact) / units,
        tuple(direction._replace(loss=(0.0, 0.0)) for direction in exact),
        tuple(sorted(directions, key=lambda direction: -direction.standard_error)),
        scale,
        (halved, doubled),
    )


def _complement(vectors: Sequence[Float[np.ndarray, " K"]], size: int) -> Float[np.ndarray, "K r"]:
    if not vectors:
        return np.eye(size)
    span = np.stack([vector / np.linalg.norm(vector) for vector in vectors], axis=1)
    return np.linalg.qr(span, mode="complete")[0][:, len(vectors) :]


def _standard_errors(
    values: Float[np.ndarray, " r"], axes: Float[np.ndarray, "K r"], exact: Sequence[Direction]
) -> Float[np.ndarray, " K"]:
    variances = np.where(values > 0, 1 / np.where(values > 0, values, 1.0), inf)
    squares = np.where(axes**2 > 1e-16, axes**2, 0.0)
    with np.errstate(invalid="ignore"):
        total = np.nansum(squares * variances, axis=1)  # zero times an infinite variance is zero
    for direction in exact:
        total = np.where(direction.vector != 0, inf, total)
    return np.sqrt(total)


def _weak(
    mdp: TabularMDP,
    vector: Float[np.ndarray, " K"],
    information: Float[np.ndarray, "K K"],
    loss: tuple[float, float],
    seen: Bool[np.ndarray, " S"],
    scale: float,
) -> Direction:
    curvature = float(vector @ information @ vector)
    main = np.abs(vector) >= _MINOR * np.abs(vector).max()
    at_hand = np.abs(np.asarray(mdp.features))[seen].max(axis=(0, 1), initial=0.0) > 0
    words = combination(mdp.feature_names, vector, _MINOR)
    kind = NOT_VISITED if not at_hand[main].any() else WEAK
    why = (
        "rewards pairs that are unavailable in all states seen, so only the paths there carry evidence"
        if kind == NOT_VISITED
        else "made little difference to the observations"
    )
    text = f"{words} {why}: {_sides(loss, scale)}"
    return Direction(vector, curvature**-0.5 if curvature > 0 else inf, loss, kind, text, False)


def _sides(loss: tuple[float, float], scale: float) -> str:
    up, down = loss
    # Half a nat is one standard error of a weight that is determined.
    if up > 0.5 >= down:
        return (
            f"it may fall by {scale:g} at {number(max(down, 0), 2)} nats, but not rise ({number(up, 2)} nats)"
        )
    if down > 0.5 >= up:
        return (
            f"it may rise by {scale:g} at {number(max(up, 0), 2)} nats, but not fall ({number(down, 2)} nats)"
        )
    return f"a rise by {scale:g} {_cost(up)} nats, a fall {_cost(down)}"


def _cost(loss: float) -> str:
    return f"{'costs' if loss >= 0 else 'gains'} {number(abs(loss), 2)}"


# -- for readers --------------------------------------------------------------------------------------


def describe_identifiability(result: Identifiability) -> str:
    """Write the findings in sentences, one direction a line."""
    lines = [f"{d.kind}: {d.description}." for d in result.exact]
    count = len(result.features)
    head = (
        f"Every direction of the {count} weights makes a difference to behaviour."
        if not lines
        else f"{len(lines)} of {count} directions of the weights change no behaviour; no demonstration of "
        "this kind determines them:"
    )
    lines = [head, *(f"- {line}" for line in lines)]
    if result.weak:
        more = len(result.weak)
        lines.append(
            f"{more} more {'is' if more == 1 else 'are'} weakly determined: the standard error exceeds "
            f"{result.scale:g}:"
        )
        lines += [
            f"- {d.kind} (standard error {number(d.standard_error, 2)}): {d.description}."
            for d in result.weak
        ]
    else:
        lines.append(f"These demonstrations determine the others, each to within {result.scale:g}.")
    return "\n".join([*lines, _length(result)])


def _length(result: Identifiability) -> str:
    halved, doubled = (
        f"loses {number(x, 2)}" if x > 0 else f"gains {number(abs(x), 2)}" for x in result.length_loss
    )
    text = f"Halving all weights {halved} nats of likelihood, doubling them {doubled}."
    if result.length_loss[1] < -1e-9:
        text += " The expert errs too rarely to bound the weights' common length from above."
    return text


def directions_table(result: Identifiability) -> pd.DataFrame:
    """Tabulate directions, one a row: kind, wording, standard error and losses, then coefficients."""
    rows = [
        {
            "kind": d.kind,
            "exact": d.exact,
            "direction": combination(result.features, d.vector, 0.0 if d.exact else _MINOR),
            "standard_error": d.standard_error,
            "loss_along": d.loss[0],
            "loss_against": d.loss[1],
            "description": d.description,
        }
        for d in result.directions
    ]
    fixed = ["kind", "exact", "direction", "standard_error", "loss_along", "loss_against", "description"]
    table = pd.DataFrame(rows, columns=fixed)
    for k, name in enumerate(result.features):
        table[name] = [float(d.vector[k]) for d in result.directions]
    return table


def identifiability_section(results: Mapping[str, Identifiability]) -> Section:
    """Make a section of a page on one demonstration or several, keyed by whose they are."""
    tables = []
    for title, result in results.items():
        if result.directions:
            found = [
                (d.kind, "none" if d.exact else number(d.standard_error, 2), d.description)
                for d in result.directions
            ]
            caption = (
                f"Directions of the weights of {title} that are not determined; one without a standard error "
                "is determined by no amount of data."
            )
            tables.append(Table(("kind", "standard error", "direction"), found, caption))
    text = (
        "Behaviour determines a reward only up to changes that leave the behaviour unchanged. If a direction "
        "of the weights changes no behaviour at all, no amount of data determines it. If it is weakly "
        "determined, the prior matters: quite different weights explain the observations as well.\n\n"
        + "\n\n".join(f"{title[:1].upper()}{title[1:]}: {_length(r)}" for title, r in results.items())
    )
    return Section("Directions that the demonstrations determine", text, tables)
