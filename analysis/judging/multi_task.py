"""Recovery of several behaviours from mixed demonstrations, and the value of each component (section 7.2).

Components found and behaviours demonstrated are numbered independently: agreement of the two is judged up to
a renumbering, values under the true reward of what each trajectory really was.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from scipy.optimize import linear_sum_assignment

from ...models.inputs.text import shortened
from ...models.observation.demonstration import PAD, SEEN, UNKNOWN, Demonstration
from ...models.observation.evidence import checked_demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import (
    deterministic_policy,
    hard_plan,
    policy_values,
    require_discounted,
    reward_of,
)


def expected_value_difference(
    mdp: TabularMDP,
    true_weights: Float[np.ndarray, "B K"],
    labels: Int[np.ndarray, " n"],
    learned: Float[np.ndarray, "D K"],
    assignments: Int[np.ndarray, " n"],
    demonstration: Demonstration,
) -> float:
    """Compute EVD: the value lost by the learned behaviour, summed over a trajectory's states, mean of
    trajectories.

    ``1/N sum_i sum_{s in y_i} |V^{pi(theta*_{b_i})}(s) - V^{pi(theta_{c_i})}(s)|`` with ``b_i`` a
    trajectory's behaviour and ``c_i`` its assigned component (section 7.2). Both policies are greedy, ties as
    in :func:`~i2rl.analysis.judging.metrics.greedy_policy`, and both values exact and under the trajectory's
    own true reward, in units of discounted reward. Equal policies lose exactly zero.

    Parameters
    ----------
    mdp : TabularMDP
    true_weights : float ``[B, K]``
        Of each behaviour.
    labels : int ``[n]``
        Behaviour of each trajectory.
    learned : float ``[D, K]``
        Weights of each component found.
    assignments : int ``[n]``
        Component of each trajectory.
    demonstration : Demonstration
        The trajectories as they really were, every state known. Rows of padding are no trajectories.

    Raises
    ------
    ValueError
        For shapes or numbers that do not fit, weights that are not numbers, an unknown state, no trajectory
        at all, or discount 1.

    See Also
    --------
    i2rl.analysis.assignment_accuracy : how well trajectories were told apart
    i2rl.analysis.inverse_learning_error : the loss of a single reward

    Examples
    --------
    >>> from i2rl.analysis import expected_value_difference
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Demonstration
    >>> mdp, weights = five_cells()[:2]
    >>> walks = Demonstration.from_pairs([[0, 1, 2], [0, 1, 2]], [[1, 1, 1], [1, 1, 1]])
    >>> expected_value_difference(mdp, weights[None], [0, 0], 3 * weights[None], [0, 0], walks)
    0.0
    >>> expected_value_difference(mdp, weights[None], [0, 0], [weights, -weights], [0, 1], walks) > 10
    True
    """
    require_discounted(mdp)
    truth, found = (_weights(mdp, name, w) for name, w in (("true", true_weights), ("learned", learned)))
    n = demonstration.n_trajectories
    of_behaviour = _codes("labels", labels, n, len(truth))
    of_component = _codes("assignments", assignments, n, len(found))
    visits = _state_visits(mdp, checked_demonstration(mdp, demonstration))
    real = demonstration.lengths > 0
    if not real.any():
        raise ValueError("the value difference of no trajectories is not defined")
    # Padded, so that learners with more components or fewer share a compiled program.
    room = 1 << (len(found) - 1).bit_length()
    padded = np.concatenate([found, np.broadcast_to(found[:1], (room - len(found), mdp.n_features))])
    loss = np.asarray(_losses(mdp, jnp.asarray(truth), jnp.asarray(padded)))
    return float(np.sum(visits * loss[of_behaviour, of_component], axis=1)[real].mean())


@jax.jit
def _losses(
    mdp: TabularMDP, true: Float[Array, "B K"], learned: Float[Array, "D K"]
) -> Float[Array, "B D S"]:
    """Compute ``|V^* - V^pi|`` in every state, for each reward and each policy."""

    def greedy(weights: Float[Array, " K"]) -> Float[Array, "S A"]:
        return deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)

    components = lax.map(greedy, learned)

    def of_behaviour(weights: Float[Array, " K"]) -> Float[Array, "D S"]:
        # The expert's policy is evaluated like the others: equal policies then have equal values to the bit.
        policies = jnp.concatenate([greedy(weights)[None], components])
        values = lax.map(lambda policy: policy_values(mdp, policy, reward_of(mdp, weights)), policies)
        return jnp.abs(values[0] - values[1:])

    return lax.map(of_behaviour, true)


def assignment_accuracy(labels: Int[np.ndarray, " n"], assignments: Int[np.ndarray, " n"]) -> float:
    """Compute the share of trajectories in their behaviour's component, under the best one-to-one matching.

    Raises ``ValueError`` for no trajectory or another number of labels than of assignments.

    See Also
    --------
    i2rl.analysis.match_components : the matching itself
    i2rl.analysis.expected_value_difference : what wrong assignments cost

    Examples
    --------
    >>> from i2rl.analysis import assignment_accuracy
    >>> assignment_accuracy([0, 0, 1, 1], [5, 5, 3, 3])
    1.0
    >>> assignment_accuracy([0, 0, 1, 1], [5, 5, 3, 5])
    0.75
    """
    table, _, _ = _contingency(labels, assignments)
    return float(table[linear_sum_assignment(table, maximize=True)].sum() / table.sum())


def match_components(labels: Int[np.ndarray, " n"], assignments: Int[np.ndarray, " n"]) -> dict[int, int]:
    """Match behaviours to components, one to one, with the most trajectories in common.

    A behaviour is missing if no remaining component has any of its trajectories. Errors as for
    :func:`assignment_accuracy`.

    See Also
    --------
    i2rl.analysis.assignment_accuracy : how many trajectories the matching has in common
    i2rl.inference.mme_mtirl : find components

    Examples
    --------
    >>> from i2rl.analysis import match_components
    >>> match_components([0, 0, 1, 1], [5, 5, 3, 5])
    {0: 5, 1: 3}
    >>> match_components([0, 0, 1, 1], [5, 5, 5, 5])
    {0: 5}
    """
    table, behaviours, components = _contingency(labels, assignments)
    pairs = zip(*linear_sum_assignment(table, maximize=True), strict=True)
    return {int(behaviours[b]): int(components[d]) for b, d in pairs if table[b, d]}


def adjusted_rand_index(labels: Int[np.ndarray, " n"], assignments: Int[np.ndarray, " n"]) -> float:
    """Compute the agreement of two partitions over pairs of trajectories, 0 by chance and 1 when equal.

    ``(together - chance) / (most - chance)``: pairs together in both, their expectation under random
    partitions with the same sizes, and the mean of the pairs together in either (Hubert and Arabie 1985). Two
    partitions that both join all trajectories, or separate all, agree: 1. Errors as for
    :func:`assignment_accuracy`.
    """
    table, _, _ = _contingency(labels, assignments)

    def pairs(counts: Int[np.ndarray, "..."]) -> float:
        return float(np.sum(counts * (counts - 1)) / 2)

    in_behaviours, in_components, total = pairs(table.sum(1)), pairs(table.sum(0)), pairs(table.sum())
    if in_behaviours == in_components and in_behaviours in (0.0, total):
        return 1.0
    chance = in_behaviours * in_components / total
    return (pairs(table) - chance) / ((in_behaviours + in_components) / 2 - chance)


def _contingency(labels: Int[np.ndarray, " n"], assignments: Int[np.ndarray, " n"]) -> tuple:
    """Count the trajectories of each behaviour in each component; name rows and columns."""
    labels, assignments = np.asarray(labels), np.asarray(assignments)
    if labels.ndim != 1 or labels.shape != assignments.shape or not labels.size:
        raise ValueError(
            "labels and assignments must have one entry a trajectory, at least one, got shapes "
            f"{labels.shape} and {assignments.shape}"
        )
    behaviours, row = np.unique(labels, return_inverse=True)
    components, column = np.unique(assignments, return_inverse=True)
    table = np.zeros((len(behaviours), len(components)), int)
    np.add.at(table, (row, column), 1)
    return table, behaviours, components


def _weights(mdp: TabularMDP, which: str, weights: Float[np.ndarray, "D K"]) -> Float[np.ndarray, "D K"]:
    weights = np.asarray(weights, float)
    if weights.ndim != 2 or weights.shape[1] != mdp.n_features or not len(weights):
        raise ValueError(
            f"{which} weights must have shape [components, {mdp.n_features}], got {weights.shape}"
        )
    if not np.isfinite(weights).all():
        component, k = np.argwhere(~np.isfinite(weights))[0]
        raise ValueError(
            f"the {which} weight of feature {shortened(mdp.feature_names[k])} in component {component} is "
            f"{weights[component, k]}, not a number"
        )
    return weights


def _codes(name: str, codes: Int[np.ndarray, " n"], n: int, size: int) -> Int[np.ndarray, " n"]:
    codes = np.asarray(codes)
    if codes.shape != (n,) or not np.issubdtype(codes.dtype, np.integer):
        raise ValueError(f"{name} must be an integer for each of {n} trajectories, got shape {codes.shape}")
    if n and not (codes.min() >= 0 and codes.max() < size):
        raise ValueError(f"{name} must lie between 0 and {size - 1}, got {codes.min()} to {codes.max()}")
    return codes


def _state_visits(mdp: TabularMDP, demonstration: Demonstration) -> Int[np.ndarray, "n S"]:
    kind, state = np.asarray(demonstration.kind), np.asarray(demonstration.state)
    unknown = (kind != PAD) & ((kind != SEEN) | (state == UNKNOWN))
    if unknown.any():
        i, t = np.argwhere(unknown)[0]
        raise ValueError(
            f"trajectory {i}, step {t}: the state is not known; value differences need the trajectories as "
            "they really were"
        )
    visits = np.zeros((len(kind), mdp.n_states), int)
    rows, steps = np.nonzero(kind != PAD)
    np.add.at(visits, (rows, state[rows, steps]), 1)
    return visits
