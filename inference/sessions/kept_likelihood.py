"""Model of the log-likelihood of all past demonstrations, kept by an online learner in place of them.

Visits completed under early weights confirm those weights. This statistic keeps what is true at any weights:
the exact visits of steps that were read exactly, and of everything else a second-order expansion of the
log-likelihood around the last weights, bent by the completed visits, so that it stays right further away.

With reference weights ``t``, ``d = theta - t``, visits ``N`` of inexact steps, ``G`` and ``P`` gradient and
information of the inexact part at ``t``:

    R(theta) = rho [N . (log pi_theta - log pi_t) - d . grad(N . log pi)(t)] + G . d - d' (P~ - rho F)+ d / 2

where ``F = -hess(N . log pi)(t)``, ``P~`` is ``P`` with eigenvalues of at least one half in the metric of the
summed convex parts ``C``, and ``rho`` lies between the least and the mean share of ``P~`` in ``F`` (nearer
the mean while few sessions are expanded). Demonstrations in which every step was read exactly, or none, are
kept without loss.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, soft_plan
from ..completion.smoothing import Evidence, log_likelihoods, smooth_all

# Eigenvalues of the information that is kept are at least this share of its convex parts.
_FLOOR = 0.5
# Sessions after which the shape counts half as much as its mean share.
_SETTLED = 16.0


@shown_briefly
class KeptLikelihood(NamedTuple):
    """Log-likelihood of everything so far; all derivatives are those at ``weights``.

    Fields
    ------
    size : float
        Number of trajectories.
    exact : float ``[S, A]``
        Visits of steps that were read exactly.
    completed : float ``[S, A]``
        Visits of all other steps, each completed under the weights at the end of its session; a shape only.
    weights : float ``[K]``
        Where the inexact part is expanded.
    value, gradient, information : float, ``[K]``, ``[K, K]``
        Log-likelihood of the inexact part there in nats, its gradient, and its negative Hessian.
    convex : float ``[K, K]``
        Sum of the convex parts of what entered ``information``.
    sessions : int
        Number of expansions.
    raw : Demonstration
        The first trajectories, which are not expanded yet; none later.
    """

    size: Float[Array, ""]
    exact: Float[Array, "S A"]
    completed: Float[Array, "S A"]
    weights: Float[Array, " K"]
    value: Float[Array, ""]
    gradient: Float[Array, " K"]
    information: Float[Array, "K K"]
    convex: Float[Array, "K K"]
    sessions: Int[Array, ""]
    raw: Demonstration


@shown_briefly
class Surrogate(NamedTuple):
    """The model in a session: visits, and a quadratic function around ``weights``.

    ``share`` is ``rho``, ``completed_information`` is ``F``.
    """

    visits: Float[Array, "S A"]
    weights: Float[Array, " K"]
    value: Float[Array, ""]
    gradient: Float[Array, " K"]
    curvature: Float[Array, "K K"]
    share: Float[Array, ""]
    completed_information: Float[Array, "K K"]


def nothing_kept(mdp: TabularMDP, raw: Demonstration) -> KeptLikelihood:
    """Return the statistic before the first session."""
    k, pairs = mdp.n_features, jnp.zeros((mdp.n_states, mdp.n_actions))
    zero, none = jnp.zeros(()), jnp.zeros((k, k))
    return KeptLikelihood(
        zero, pairs, pairs, jnp.zeros(k), zero, jnp.zeros(k), none, none, jnp.zeros((), int), raw
    )


def log_policy_of(
    mdp: TabularMDP, weights: Float[Array, " K"], values: Float[Array, " S"]
) -> Float[Array, "S A"]:
    """Return the log-probabilities of the soft policy of weights, planned from earlier values."""
    return soft_plan(mdp, reward_of(mdp, weights), values).log_policy


def visits_log_likelihood(
    mdp: TabularMDP, visits: Float[Array, "S A"], log_policy: Float[Array, "S A"]
) -> Float[Array, ""]:
    """Return ``sum N log pi``; pairs without visits count nothing."""
    return jnp.sum(visits * jnp.where(mdp.available & (visits != 0), log_policy, 0.0))


def exact_steps(mdp: TabularMDP, evidence: Evidence) -> Bool[Array, "n L"]:
    """Mark steps whose evidence leaves a single pair."""
    possible = jnp.isfinite(evidence.log_evidence) & mdp.available
    return evidence.live & (jnp.sum(possible, axis=(2, 3)) == 1)


def surrogate(mdp: TabularMDP, kept: KeptLikelihood, values: Float[Array, " S"]) -> Surrogate:
    """Return the model for the next session."""

    def shape(theta: Float[Array, " K"]) -> Float[Array, "1"]:
        return visits_log_likelihood(mdp, kept.completed, log_policy_of(mdp, theta, values))[None]

    (value,), (gradient,), (hessian,) = _derivatives(shape, kept.weights)
    information = -_symmetric(hessian)
    floored = _floored(kept.information, kept.convex)
    shares = _shares(floored, _convex_part(information))
    least = jnp.min(shares)
    share = least + (jnp.mean(shares) - least) / (1 + kept.sessions / _SETTLED)
    share = jnp.where(kept.sessions > 0, share, 0.0)
    return Surrogate(
        kept.exact + share * kept.completed,
        kept.weights,
        kept.value - share * value,
        kept.gradient - share * gradient,
        _convex_part(floored - share * information),
        share,
        information,
    )


def model_log_likelihood(
    mdp: TabularMDP, model: Surrogate, weights: Float[Array, " K"], log_policy: Float[Array, "S A"]
) -> Float[Array, ""]:
    """Return the log-likelihood of everything kept, in nats."""
    d = weights - model.weights
    quadratic = model.value + model.gradient @ d - d @ model.curvature @ d / 2
    return visits_log_likelihood(mdp, model.visits, log_policy) + quadratic


def expanded(
    mdp: TabularMDP,
    kept: KeptLikelihood,
    model: Surrogate,
    weights: Float[Array, " K"],
    values: Float[Array, " S"],
    evidence: Evidence,
) -> KeptLikelihood:
    """Expand everything, a session's evidence included, at the weights at the end of the session."""
    log_policy = log_policy_of(mdp, weights, values)
    exact = exact_steps(mdp, evidence)
    pairs = smooth_all(mdp, log_policy, evidence).pairs
    now = jnp.einsum("nlsa,nl->sa", pairs, exact.astype(float))
    others = jnp.einsum("nlsa,nl->sa", pairs, (evidence.live & ~exact).astype(float))

    def both(theta: Float[Array, " K"]) -> Float[Array, "2"]:
        """Return the session's inexact part, and that of the completed visits."""
        policy = log_policy_of(mdp, theta, values)
        whole = jnp.sum(log_likelihoods(mdp, policy, evidence))
        return jnp.stack(
            [
                whole - visits_log_likelihood(mdp, now, policy),
                visits_log_likelihood(mdp, kept.completed, policy),
            ]
        )

    (value, _), (score, gradient), (hessian, other) = _derivatives(both, weights)
    information = -_symmetric(hessian)
    change = model.share * (-_symmetric(other) - model.completed_information)
    before = model_log_likelihood(mdp, model, weights, log_policy)
    d = weights - model.weights
    return KeptLikelihood(
        kept.size + jnp.sum(jnp.any(evidence.live, axis=1)),
        kept.exact + now,
        kept.completed + others,
        weights,
        before - visits_log_likelihood(mdp, kept.exact, log_policy) + value,
        model.share * gradient + model.gradient - model.curvature @ d + score,
        kept.information + change + information,
        kept.convex + _convex_part(change) + _convex_part(information),
        kept.sessions + 1,
        kept.raw,
    )


def _derivatives(function: Callable[[Array], Array], at: Float[Array, " K"]) -> tuple[Array, Array, Array]:
    """Return value, first and second derivatives of a function with several results, in one pass."""

    def first(theta: Float[Array, " K"]) -> tuple[Array, tuple[Array, Array]]:
        value, back = jax.vjp(function, theta)
        (slopes,) = jax.vmap(back)(jnp.eye(len(value)))
        return slopes, (value, slopes)

    second, (value, slopes) = jax.jacfwd(first, has_aux=True)(at)
    return value, slopes, second


def _convex_part(matrix: Float[Array, "K K"]) -> Float[Array, "K K"]:
    """Return the nearest positive semidefinite matrix: negative eigenvalues become zero."""
    values, vectors = jnp.linalg.eigh(_symmetric(matrix))
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T


def _symmetric(matrix: Float[Array, "K K"]) -> Float[Array, "K K"]:
    return (matrix + matrix.T) / 2


def _square_roots(matrix: Float[Array, "K K"], floor: Array) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(_symmetric(matrix))
    roots = jnp.sqrt(jnp.maximum(values, floor))
    return (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T


def _floored(information: Float[Array, "K K"], convex: Float[Array, "K K"]) -> Float[Array, "K K"]:
    """Raise eigenvalues, in the metric of the convex parts, to the floor."""
    root, inverse = _square_roots(convex, jnp.array(1e-12))
    values, vectors = jnp.linalg.eigh(_symmetric(inverse @ information @ inverse))
    return root @ ((vectors * jnp.maximum(values, _FLOOR)) @ vectors.T) @ root


def _shares(information: Float[Array, "K K"], completed: Float[Array, "K K"]) -> Float[Array, " K"]:
    """Return the shares of the information in that of the completed visits, between 0 and 1."""
    largest = jnp.maximum(jnp.max(jnp.linalg.eigvalsh(completed)), 1e-9)
    _, inverse = _square_roots(completed, 1e-9 * largest)
    return jnp.clip(jnp.linalg.eigvalsh(_symmetric(inverse @ information @ inverse)), 0.0, 1.0)
