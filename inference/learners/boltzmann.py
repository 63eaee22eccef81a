"""The Boltzmann-rational expert: ``pi(a | s) ~ exp(rationality Q*(s, a))``.

The likelihood of Bayesian and maximum-likelihood IRL (Ramachandran and Amir 2007; Babes-Vroman et al. 2011;
Choi and Kim 2012). Unlike the soft policy of maximum causal entropy, the expert plans for optimal actions
from the next step on, but errs in the present one. Trajectories enter through their visit counts alone: the
dynamics' part of their probability does not depend on the weights and is left out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ...models.observation.demonstration import HIDDEN, LOST, PAD, UNKNOWN, Demonstration, DemonstrationError
from ...models.observation.evidence import checked_demonstration
from ...models.process.mdp import PairNames, TabularMDP
from ...models.process.planning import action_values, hard_plan, policy_values, reward_of

# Inverse temperature of the published baselines.
ETA = 10.0
# Scaled weights lie in [-BOX, BOX]: the likelihood of a greedy expert has no maximum without a bound.
BOX = 1.0


def optimal_action_values(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    """Return ``Q*(s, a)``, differentiable in the weights if each state has one best action.

    The derivative is ``dQ* / dtheta = phi + gamma P mu`` with ``mu`` the features to go of the greedy policy;
    for tied actions it is that of the first. Unavailable actions have ``-inf``.
    """
    plan = hard_plan(mdp, reward_of(mdp, lax.stop_gradient(weights)))
    greedy = jax.nn.one_hot(jnp.argmax(plan.action_values, axis=1), mdp.n_actions)
    reward = reward_of(mdp, weights)
    return action_values(mdp, reward, policy_values(mdp, greedy, reward))


def boltzmann_log_policy(
    mdp: TabularMDP, weights: Float[Array, " K"], rationality: float | Array = ETA
) -> Float[Array, "S A"]:
    """Return ``log pi(a | s)``, the log-softmax of ``rationality Q*`` over available actions, else ``-inf``.

    ``rationality`` is the inverse temperature, per unit of value. Differentiable as
    :func:`optimal_action_values`. Raises ``ValueError`` for discount 1.
    """
    return jax.nn.log_softmax(rationality * optimal_action_values(mdp, weights), axis=1)


def boltzmann_log_likelihoods(
    mdp: TabularMDP,
    weights: Float[Array, " K"],
    counts: Float[Array, "n S A"],
    rationality: float | Array = ETA,
) -> Float[Array, " n"]:
    """Return ``sum_{s, a} N_i(s, a) log pi(a | s)`` of each trajectory's visits ``N_i``, in nats.

    Differentiable as :func:`optimal_action_values`. Raises ``DemonstrationError`` for a visit to an
    unavailable action, naming trajectory, state and action (under a trace the trajectory's log-likelihood is
    ``-inf`` instead).
    """
    _require_available_visits(mdp, counts)
    # 0 log 0 = 0
    finite = jnp.where(mdp.available, boltzmann_log_policy(mdp, weights, rationality), 0.0)
    impossible = jnp.any((counts > 0) & ~mdp.available, axis=(1, 2))
    return jnp.where(impossible, -jnp.inf, jnp.einsum("nsa,sa->n", counts, finite))


def _require_available_visits(mdp: TabularMDP, counts: Float[Array, "n S A"]) -> None:
    """Raise ``DemonstrationError`` if a trajectory's counts visit an unavailable action."""
    if isinstance(counts, jax.core.Tracer) or isinstance(mdp.available, jax.core.Tracer):
        return
    given, expected = np.asarray(counts), (mdp.n_states, mdp.n_actions)
    if given.ndim != 3 or given.shape[1:] != expected:
        raise ValueError(
            f"visit counts must have shape [n, S, A] = [n, {expected[0]}, {expected[1]}], "
            f"got {list(given.shape)}"
        )
    wrong = np.argwhere((given > 0) & ~np.asarray(mdp.available))
    if len(wrong):
        i, s, a = wrong[0]
        raise DemonstrationError(
            f"trajectory {i} visits {PairNames(mdp.labels).pair(s, a)}, which is not available there"
        )


def visit_counts(mdp: TabularMDP, demonstration: Demonstration) -> Float[np.ndarray, "n S A"]:
    """Count ``N_i(s, a)``, the visits of each trajectory to each pair; padding rows count zero.

    Raises ``DemonstrationError`` naming trajectory and step: for a step that was hidden, lost or seen in part
    (these methods need every step), for an index out of range, and for an unavailable action; also if no
    trajectory has a step.
    """
    kind, state, action, _ = checked_demonstration(mdp, demonstration).arrays
    live = kind != PAD
    if not live.any():
        raise DemonstrationError("the demonstration has no step; this method needs at least one trajectory")
    seen = live & ~np.isin(kind, (HIDDEN, LOST)) & (state != UNKNOWN) & (action != UNKNOWN)
    names = PairNames(mdp.labels)
    if (live & ~seen).any():
        i, t = np.argwhere(live & ~seen)[0]
        why = {HIDDEN: "is hidden", LOST: "is a lost frame"}.get(int(kind[i, t]), "was seen only in part")
        raise DemonstrationError(
            f"trajectory {i}, step {t} {why}; this method needs to see the state and action of every step"
        )
    i, t = np.nonzero(seen)
    s, a = state[i, t], action[i, t]
    barred = np.flatnonzero(~np.asarray(mdp.available)[s, a])
    if len(barred):
        at = barred[0]
        raise DemonstrationError(
            f"trajectory {i[at]}, step {t[at]}: {names.pair(s[at], a[at])} is not available there"
        )
    counts = np.zeros((len(kind), mdp.n_states, mdp.n_actions))
    np.add.at(counts, (i, s, a), 1.0)
    return counts


# -- parts of the baselines -----------------------------------------------------------------------------


def random_weights(key: Array, n_features: int) -> Float[Array, " K"]:
    """Draw weights uniformly on the box."""
    return jax.random.uniform(key, (n_features,), float, -BOX, BOX)


def reflected(x: Float[Array, " K"]) -> Float[Array, " K"]:
    """Fold the line into the box, as between two mirrors."""
    along = jnp.mod(x + BOX, 4 * BOX)
    return jnp.where(along > 2 * BOX, 4 * BOX - along, along) - BOX


def require_positive(**numbers: float) -> None:
    """Raise ``ValueError`` naming the first number that is not positive and finite."""
    for name, number in numbers.items():
        if not (number > 0 and np.isfinite(number)):
            raise ValueError(f"{name} must be positive, got {number}")
