"""The feature constraints of the maximum-entropy program, and their feasibility."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy import sparse

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import PairNames, TabularMDP
from ...models.process.planning import reachable_states, require_discounted
from ...models.process.units import feature_scale, with_scaled_features

# Constraints are met if scaled features miss by no more than this share of the largest.
_MET = 1e-7
# Discounted visits below this count as zero.
_LEAST_OCCUPANCY = 1e-4


class ProgramNotSolved(RuntimeError):
    """Failure of a solver to meet its tolerances."""


class InfeasibleProgram(ValueError):
    """Constraints that no policy meets; the message names the features and by how much they miss."""


@shown_briefly
class FeatureTarget(NamedTuple):
    """Features that the feature program has to match.

    Fields
    ------
    features : float ``[K]``
        ``phi_hat``: discounted features per trajectory, ``E[sum_t gamma^t phi(s_t, a_t)]``.
    start : float ``[S]``
        ``p0``: distribution of the first state of these trajectories.
    """

    features: Float[Array, " K"] | Float[np.ndarray, " K"]
    start: Float[Array, " S"] | Float[np.ndarray, " S"]


def checked_problem(mdp: TabularMDP, target: FeatureTarget, slack: ArrayLike) -> tuple[np.ndarray, ...]:
    """Check target features ``[K]``, start distribution ``[S]`` and slack ``[K]``; return NumPy arrays.

    Raises ``ValueError`` for discount 1, wrong shapes, numbers that are not finite, a start that is not a
    distribution, or a negative slack.
    """
    require_discounted(mdp)
    features, start = (np.asarray(part, float) for part in shaped_target(mdp, target))
    if not np.isfinite(features).all():
        k = int(np.flatnonzero(~np.isfinite(features))[0])
        raise ValueError(f"target of feature {_feature_name(mdp, k)} is {features[k]}, not a number")
    if not (start >= 0).all() or abs(start.sum() - 1) > 1e-6:
        raise ValueError(
            f"the target's start must be a distribution over states: least {start.min()}, sum {start.sum()}"
        )
    return features, start, checked_slack(mdp, slack)


def checked_slack(mdp: TabularMDP, slack: ArrayLike) -> np.ndarray:
    """Return slack ``[K]`` as a NumPy array; ``ValueError`` unless it is finite and not negative."""
    checked = np.array(shaped_slack(mdp, slack), float)
    if not (np.isfinite(checked) & (checked >= 0)).all():
        raise ValueError(f"slack must be finite and not negative, got {checked}")
    return checked


def shaped_target(mdp: TabularMDP, target: FeatureTarget) -> tuple[Float[Array, " K"], Float[Array, " S"]]:
    """Return target features ``[K]`` and start ``[S]`` as float arrays; ``ValueError`` for a wrong shape."""
    features, start = jnp.asarray(target.features, float), jnp.asarray(target.start, float)
    if features.shape != (mdp.n_features,):
        raise ValueError(
            f"target features must have shape [K] = [{mdp.n_features}], got {list(features.shape)}"
        )
    if start.shape != (mdp.n_states,):
        raise ValueError(
            f"the target's start must have shape [S] = [{mdp.n_states}], got {list(start.shape)}"
        )
    return features, start


def shaped_slack(mdp: TabularMDP, slack: ArrayLike) -> Float[Array, " K"]:
    """Broadcast slack to ``[K]``; ``ValueError`` for a wrong shape."""
    slack = jnp.asarray(slack, float)
    if slack.shape not in ((), (mdp.n_features,)):
        raise ValueError(
            f"slack must be a number or have shape [K] = [{mdp.n_features}], got {list(slack.shape)}"
        )
    return jnp.broadcast_to(slack, (mdp.n_features,))


def _feature_name(mdp: TabularMDP, k: int) -> str:
    return f"{mdp.feature_names[k]!r} ({k})"


@shown_briefly
class FlowConstraints(NamedTuple):
    """The polytope of occupancies: ``x >= 0``, ``balance @ x = p0``, over the pairs that can occur.

    Fields
    ------
    states : int ``[R]``
        States reachable from the start distribution, in order.
    pair_state, pair_action : int ``[n]``
        State and action of each column.
    row : int ``[n]``
        Position of ``pair_state`` in ``states``.
    balance : sparse ``[R, n]``
        ``sum_a x(s', a) - gamma sum P(s' | s, a) x(s, a)``.
    features : float ``[n, K]``
        Features of each column.
    """

    states: np.ndarray
    pair_state: np.ndarray
    pair_action: np.ndarray
    row: np.ndarray
    balance: sparse.csr_array
    features: np.ndarray


def flow_constraints(mdp: TabularMDP, reachable: np.ndarray) -> FlowConstraints:
    """Build the flow constraints over available pairs of the states marked in ``reachable [S]``."""
    states = np.flatnonzero(reachable)
    position = np.full(mdp.n_states, -1)
    position[states] = np.arange(len(states))
    state, action = np.nonzero(np.asarray(mdp.available) & reachable[:, None])
    successors = np.asarray(mdp.successors)[state, action]
    probabilities = np.asarray(mdp.probabilities)[state, action]
    column, branch = np.nonzero(probabilities > 0)
    shape = (len(states), len(state))
    leaves = sparse.csr_array((np.ones(len(state)), (position[state], np.arange(len(state)))), shape)
    enters = sparse.csr_array(
        (probabilities[column, branch], (position[successors[column, branch]], column)), shape
    )
    return FlowConstraints(
        states,
        state,
        action,
        position[state],
        sparse.csr_array(leaves - float(mdp.discount) * enters),
        np.asarray(mdp.features)[state, action],
    )


def nearest_features(mdp: TabularMDP, target: FeatureTarget, slack: ArrayLike = 0.0) -> np.ndarray:
    """Find expected features ``[K]`` of a policy that violates the constraints least, by a linear program.

    It minimises ``sum_k max(|E[phi_k] - phi_hat_k| / scale_k - slack_k, 0)`` over all policies, with the
    features' scales; the constraints are feasible if that sum is zero.
    """
    from scipy import optimize  # loading it takes a third of a second, and few processes come here

    features, start, slack = checked_problem(mdp, target, slack)
    scale = np.asarray(feature_scale(mdp))
    flow = flow_constraints(with_scaled_features(mdp), reachable_states(mdp, start))
    n, k = flow.features.shape
    beyond = -sparse.eye_array(k)
    result = optimize.linprog(
        np.concatenate([np.zeros(n), np.ones(k)]),
        A_ub=sparse.vstack(
            [sparse.hstack([flow.features.T, beyond]), sparse.hstack([-flow.features.T, beyond])]
        ),
        b_ub=np.concatenate([features / scale + slack, slack - features / scale]),
        A_eq=sparse.hstack([flow.balance, sparse.csr_array((len(flow.states), k))]),
        b_eq=start[flow.states],
        method="highs",
    )
    if not result.success:
        raise ProgramNotSolved(f"the feasibility program did not converge: {result.message}")
    return result.x[:n] @ flow.features * scale


def excluded_pairs(
    mdp: TabularMDP, target: FeatureTarget, slack: ArrayLike = 0.0
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """List states and actions that every policy within the constraints avoids, though it reaches the states.

    Weights are finite exactly if there are none: a soft policy takes every action. For feasible constraints a
    linear program maximises ``sum min(x(s, a), least)`` over occupancies ``x``.
    """
    from scipy import optimize

    features, start, slack = checked_problem(mdp, target, slack)
    scale = np.asarray(feature_scale(mdp))
    flow = flow_constraints(with_scaled_features(mdp), reachable_states(mdp, start))
    n, k = flow.features.shape
    least = _LEAST_OCCUPANCY
    allowed = slack + _MET * (1 + np.abs(features / scale).max())
    eye, nothing = sparse.eye_array(n), sparse.csr_array((k, n))
    result = optimize.linprog(
        np.concatenate([np.zeros(n), -np.ones(n)]),
        A_ub=sparse.vstack(
            [
                sparse.hstack([flow.features.T, nothing]),
                sparse.hstack([-flow.features.T, nothing]),
                sparse.hstack([-eye, eye]),
            ]
        ),
        b_ub=np.concatenate([features / scale + allowed, allowed - features / scale, np.zeros(n)]),
        A_eq=sparse.hstack([flow.balance, sparse.csr_array((len(flow.states), n))]),
        b_eq=start[flow.states],
        bounds=[(0, None)] * n + [(0, least)] * n,
        method="highs",
    )
    if not result.success:
        raise ProgramNotSolved(f"the feasibility program did not converge: {result.message}")
    x = result.x[:n]
    visited = np.bincount(flow.row, x, len(flow.states))[flow.row] > least
    avoided = visited & (result.x[n:] < least / 2)
    return flow.pair_state[avoided], flow.pair_action[avoided]


def failure(mdp: TabularMDP, target: FeatureTarget, slack: ArrayLike, reason: str) -> Exception:
    """Build the error for a solver that stopped with ``reason``, naming the cause.

    :class:`InfeasibleProgram` names the features that no policy matches. :class:`ProgramNotSolved` names
    actions that no policy within the constraints takes, if there are any; avoiding them needs infinite
    weights.
    """
    wanted, _, relative = checked_problem(mdp, target, slack)
    scale = np.asarray(feature_scale(mdp))
    allowed = relative * scale
    nearest = nearest_features(mdp, target, slack)
    beyond = np.abs(nearest - wanted) - allowed
    missed = np.flatnonzero(beyond / scale > _MET * (1 + np.abs(wanted / scale).max()))
    if len(missed):
        worst = [
            f"feature {_feature_name(mdp, k)} is to be {wanted[k]:.6g} within {allowed[k]:.3g}, "
            f"the nearest is {nearest[k]:.6g}, {beyond[k]:.3g} beyond the slack"
            for k in missed[np.argsort(-beyond[missed] / scale[missed])][:5]
        ]
        return InfeasibleProgram("no policy has the expected features asked for: " + "; ".join(worst))
    states, actions = excluded_pairs(mdp, target, slack)
    if not len(states):
        return ProgramNotSolved(
            f"the maximum-entropy program was not solved ({reason}). Some policy meets its constraints and "
            "takes every action, so its weights are finite: a slack or a ridge makes it easier to solve"
        )
    name = PairNames(mdp.labels)
    avoided = "; ".join(name.pair(s, a) for s, a in zip(states[:5], actions[:5], strict=True))
    more = f" and {len(states) - 5} more" if len(states) > 5 else ""
    return ProgramNotSolved(
        f"the maximum-entropy program was not solved ({reason}). Its weights are infinite: no policy that "
        f"meets its constraints ever takes {avoided}{more}. A positive slack makes them finite"
    )
