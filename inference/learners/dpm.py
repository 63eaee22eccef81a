"""DPM-BIRL: Bayesian IRL of a mixture of Boltzmann experts, their number unknown (Choi and Kim 2012).

A Dirichlet process over reward weights: a Chinese restaurant process assigns trajectories to components, each
component's weights are uniform on ``[-1, 1]^K``, and its trajectories follow the Boltzmann policy of those
weights. Sampled by Metropolis-Hastings: assignments are proposed from the restaurant process (Neal 2000,
algorithm 5), weights by Langevin moves.

The table of components has a place for every trajectory. ``n`` trajectories have at most ``n`` components, so
the table cannot overflow and nothing is truncated.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from ..mixtures.clustering import Clustering
from .boltzmann import (
    BOX,
    ETA,
    boltzmann_log_policy,
    random_weights,
    reflected,
    require_positive,
    visit_counts,
)

# The density of a move omits reflections beyond the nearest: exact to rounding up to this width.
_WIDEST = 0.5


@shown_briefly
class Seating(NamedTuple):
    """State of the sampler.

    Fields
    ------
    labels : int ``[n]``
        Place of each trajectory's component in the table.
    sizes : int ``[n]``
        Trajectories of each place; zero if it is free.
    weights : float ``[n, K]``
    log_policies : float ``[n, S, A]``
        Boltzmann policies of ``weights``, zero for unavailable actions.
    """

    labels: Int[Array, " n"]
    sizes: Int[Array, " n"]
    weights: Float[Array, "n K"]
    log_policies: Float[Array, "n S A"]


@shown_briefly
class Settings(NamedTuple):
    """Settings of the model and its sampler; see :func:`dpm_birl`."""

    alpha: Float[Array, ""]
    rationality: Float[Array, ""]
    sigma: Float[Array, ""]


@shown_briefly
class DPMTrace(NamedTuple):
    """Every iteration of the sampler, without its random start.

    Fields
    ------
    labels : int ``[iterations, n]``
        Component of each trajectory, numbered by first appearance, -1 for rows of padding.
    n_components : int ``[iterations]``
    weights : float ``[iterations, n, K]``
        Weights of each trajectory's component, NaN for rows of padding.
    log_joint : float ``[iterations]``
        Joint log-density of assignments, weights and demonstration, in nats.
    assignment_acceptance, weight_acceptance : float ``[iterations]``
        Share of accepted proposals (an assignment to the same component counts as accepted).
    """

    labels: Int[np.ndarray, "sweeps n"]
    n_components: Int[np.ndarray, " sweeps"]
    weights: Float[np.ndarray, "sweeps n K"]
    log_joint: Float[np.ndarray, " sweeps"]
    assignment_acceptance: Float[np.ndarray, " sweeps"]
    weight_acceptance: Float[np.ndarray, " sweeps"]


@shown_briefly
class DPMBIRL(NamedTuple):
    """DPM-BIRL on one decision process.

    ``sample(key, demonstration)`` returns all iterations; ``fit(key, demonstration)`` the one of highest
    joint density, with each trajectory wholly in its component.
    """

    name: str
    fit: Callable[[Array, Demonstration], Clustering]
    sample: Callable[[Array, Demonstration], DPMTrace]


def crp_log_probability(sizes: Int[Array, " D"], alpha: Float[Array, ""]) -> Float[Array, ""]:
    """Return the log-probability of one partition with components of these sizes (zeros are empty).

    ``alpha^D Gamma(alpha) / Gamma(alpha + n) prod_d (n_d - 1)!``
    """
    sizes = jnp.asarray(sizes)
    used = sizes > 0
    tables = jnp.where(used, jnp.log(alpha) + jax.scipy.special.gammaln(jnp.where(used, sizes, 1)), 0.0)
    total = jnp.sum(sizes)
    return jnp.sum(tables) + jax.scipy.special.gammaln(alpha) - jax.scipy.special.gammaln(alpha + total)


def _log_policy(mdp: TabularMDP, weights: Float[Array, " K"], rationality: Array) -> Float[Array, "S A"]:
    return jnp.where(mdp.available, boltzmann_log_policy(mdp, weights, rationality), 0.0)


def _log_joint(seating: Seating, counts: Float[Array, "n S A"], alpha: Array) -> Float[Array, ""]:
    n_features = seating.weights.shape[1]
    prior = -n_features * jnp.log(2 * BOX) * jnp.sum(seating.sizes > 0)
    data = jnp.sum(counts * seating.log_policies[seating.labels])
    return crp_log_probability(seating.sizes, alpha) + prior + data


def _first_seating(key: Array, mdp: TabularMDP, counts: Float[Array, "n S A"], settings: Settings) -> Seating:
    """Draw one of ``n`` labels for each trajectory, and weights from the prior."""
    n = counts.shape[0]
    label_key, weight_key = jax.random.split(key)
    labels = jax.random.randint(label_key, (n,), 0, n)
    weights = jax.vmap(random_weights, in_axes=(0, None))(jax.random.split(weight_key, n), mdp.n_features)
    policies = lax.map(lambda w: _log_policy(mdp, w, settings.rationality), weights)
    return Seating(labels, jnp.zeros(n, int).at[labels].add(1), weights, policies)


# -- assignments --------------------------------------------------------------------------------------


def _reseat(
    mdp: TabularMDP,
    settings: Settings,
    counts: Float[Array, "n S A"],
    seating: Seating,
    inputs: tuple[Int[Array, ""], Array],
) -> tuple[Seating, Array]:
    """Propose another component for one trajectory from the restaurant process, given all others."""
    trajectory, key = inputs
    choice_key, prior_key, accept_key = jax.random.split(key, 3)
    here = seating.labels[trajectory]
    others = seating.sizes.at[here].add(-1)
    # A place is free without this trajectory: its own, if it was alone.
    free = jnp.argmin(others)
    share = jnp.log(others.at[free].set(0).astype(float)).at[free].set(jnp.log(settings.alpha))
    there = jax.random.categorical(choice_key, share)

    def new_cluster() -> tuple:
        weights = random_weights(prior_key, mdp.n_features)
        return weights, _log_policy(mdp, weights, settings.rationality)

    weights, policy = lax.cond(
        there == free, new_cluster, lambda: (seating.weights[there], seating.log_policies[there])
    )
    gain = jnp.sum(counts[trajectory] * (policy - seating.log_policies[here]))
    accepted = jnp.log(jax.random.uniform(accept_key)) < gain
    moved = Seating(
        seating.labels.at[trajectory].set(there),
        others.at[there].add(1),
        seating.weights.at[there].set(weights),
        seating.log_policies.at[there].set(policy),
    )
    return lax.cond(accepted, lambda: moved, lambda: seating), accepted


# -- weights ------------------------------------------------------------------------------------------


def log_move(to: Float[Array, " K"], mean: Float[Array, " K"], sigma: Array) -> Float[Array, ""]:
    """Return the log-density of a reflected Gaussian move, up to a constant."""
    images = jnp.stack([to, 2 * BOX - to, -2 * BOX - to, to + 4 * BOX, to - 4 * BOX])
    return jnp.sum(jax.nn.logsumexp(-0.5 * ((images - mean) / sigma) ** 2, axis=0))


def _langevin(
    mdp: TabularMDP,
    settings: Settings,
    visits: Float[Array, "S A"],
    weights: Float[Array, " K"],
    policy: Float[Array, "S A"],
    key: Array,
    updates: int,
) -> tuple:
    """Make Langevin moves of a component's weights, Metropolis-corrected; a uniform prior has no gradient."""
    sigma = settings.sigma

    @partial(jax.value_and_grad, has_aux=True)
    def objective(w: Float[Array, " K"]) -> tuple:
        log_policy = _log_policy(mdp, w, settings.rationality)
        return jnp.sum(visits * log_policy), log_policy

    def drifted(w: Float[Array, " K"], gradient: Float[Array, " K"]) -> Float[Array, " K"]:
        return jnp.clip(w + sigma**2 / 2 * gradient, -BOX, BOX)

    def move(point: tuple, key: Array) -> tuple:
        w, value, gradient, _ = point
        noise_key, accept_key = jax.random.split(key)
        mean = drifted(w, gradient)
        proposal = reflected(mean + sigma * jax.random.normal(noise_key, w.shape))
        (value_there, policy_there), gradient_there = objective(proposal)
        back = log_move(w, drifted(proposal, gradient_there), sigma)
        ratio = value_there - value + back - log_move(proposal, mean, sigma)
        accepted = jnp.log(jax.random.uniform(accept_key)) < ratio
        there = (proposal, value_there, gradient_there, policy_there)
        return jax.tree.map(partial(jnp.where, accepted), there, point), accepted

    (value, _), gradient = objective(weights)
    first = (weights, value, gradient, policy)
    ends: tuple = lax.scan(move, first, jax.random.split(key, updates))
    last, accepted = ends
    return last[0], last[3], jnp.sum(accepted)


def _move_weights(
    mdp: TabularMDP,
    settings: Settings,
    counts: Float[Array, "n S A"],
    updates: int,
    seating: Seating,
    inputs: tuple[Int[Array, ""], Array],
) -> tuple[Seating, Array]:
    place, key = inputs

    def occupied() -> tuple:
        visits = jnp.einsum("n,nsa->sa", (seating.labels == place).astype(float), counts)
        start = (seating.weights[place], seating.log_policies[place])
        return _langevin(mdp, settings, visits, *start, key, updates)

    def free() -> tuple:
        return seating.weights[place], seating.log_policies[place], jnp.zeros((), int)

    weights, policy, accepted = lax.cond(seating.sizes[place] > 0, occupied, free)
    moved = seating._replace(
        weights=seating.weights.at[place].set(weights),
        log_policies=seating.log_policies.at[place].set(policy),
    )
    return moved, accepted


# -- the sampler --------------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("iterations", "proposals", "updates"))
def _sample(
    key: Array,
    mdp: TabularMDP,
    counts: Float[Array, "n S A"],
    settings: Settings,
    iterations: int,
    proposals: int,
    updates: int,
) -> tuple:
    n = counts.shape[0]

    def sweep(seating: Seating, key: Array) -> tuple:
        seat_key, move_key = jax.random.split(key)
        turns = jnp.repeat(jnp.arange(n), proposals)
        keys = jax.random.split(seat_key, n * proposals)
        seating, seated = lax.scan(partial(_reseat, mdp, settings, counts), seating, (turns, keys))
        move = partial(_move_weights, mdp, settings, counts, updates)
        seating, moved = lax.scan(move, seating, (jnp.arange(n), jax.random.split(move_key, n)))
        n_components = jnp.sum(seating.sizes > 0)
        weight_acceptance = jnp.sum(moved) / (n_components * updates)
        log_joint = _log_joint(seating, counts, settings.alpha)
        return seating, (seating.labels, seating.weights, log_joint, jnp.mean(seated), weight_acceptance)

    start_key, sweep_key = jax.random.split(key)
    first = _first_seating(start_key, mdp, counts, settings)
    return lax.scan(sweep, first, jax.random.split(sweep_key, iterations))[1]


def dpm_birl(
    mdp: TabularMDP,
    *,
    rationality: float = ETA,
    alpha: float = 1.0,
    iterations: int = 100,
    proposals: int = 2,
    updates: int = 10,
    sigma: float = 0.01,
) -> DPMBIRL:
    """Build Dirichlet-process mixture Bayesian IRL (Choi and Kim 2012), sampled by Metropolis-Hastings.

    An iteration proposes ``proposals`` times another component for each trajectory (an existing one in
    proportion to its size without the trajectory, a new one in proportion to ``alpha`` with weights from the
    prior) and accepts with ``min(1, P(X | theta') / P(X | theta))``; then it moves every component's weights
    ``updates`` times. It starts from a random one of ``n`` labels for each trajectory.

    The prior of a component's scaled weights (:mod:`~i2rl.models.process.units`) is uniform on the box, the
    default of the authors' code; the dissertation has a Gaussian base distribution of unstated width.

    There is one deviation from the authors' code: it clips a proposed weight that leaves the box, a move
    without density, which piles weights up on the boundary. Here the drift is clipped and the noise
    reflected, and the correction uses the density of exactly that, so the sampler's distribution is the
    posterior.

    Parameters
    ----------
    mdp : TabularMDP
    rationality : float
        Inverse temperature of the experts, per unit of value.
    alpha : float
        Concentration: large values favour many components.
    iterations, proposals, updates : int
        Outer iterations; assignment proposals per trajectory and weight moves per component in each.
    sigma : float
        Width of the scaled weights' moves, at most 0.5.

    Returns
    -------
    DPMBIRL
        Its functions raise ``DemonstrationError`` naming trajectory and step for one that was hidden or
        impossible. They compile once for each number of trajectories.

    Raises
    ------
    ValueError
        For numbers that are not positive, a ``sigma`` above 0.5, or an undiscounted MDP.

    See Also
    --------
    i2rl.inference.em_mlirl : a mixture whose size is given
    i2rl.inference.gibbs_mixture_posterior : the posterior with hidden steps

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import dpm_birl
    >>> from i2rl.models import Demonstration
    >>> walks = Demonstration.from_pairs([[0, 1, 2, 3]] * 2 + [[0] * 4] * 2, [[1] * 4] * 2 + [[2] * 4] * 2)
    >>> learner = dpm_birl(five_cells().mdp, iterations=5)
    >>> found = learner.fit(jax.random.key(0), walks)
    >>> learner.name, found.assignments.shape
    ('DPM-BIRL', (4,))
    """
    require_discounted(mdp)
    require_positive(
        rationality=rationality,
        alpha=alpha,
        iterations=iterations,
        proposals=proposals,
        updates=updates,
        sigma=sigma,
    )
    if sigma > _WIDEST:
        raise ValueError(f"sigma must be at most {_WIDEST}, a quarter of the box [-1, 1], got {sigma}")
    scale, scaled = np.asarray(feature_scale(mdp)), with_scaled_features(mdp)
    settings = Settings(*(jnp.asarray(float(x)) for x in (alpha, rationality, sigma)))

    def sample(key: Array, demonstration: Demonstration) -> DPMTrace:
        counts = visit_counts(mdp, demonstration)
        real = demonstration.lengths > 0
        places, table, *rest = (
            np.asarray(x)
            for x in _sample(
                as_key(key), scaled, jnp.asarray(counts[real]), settings, iterations, proposals, updates
            )
        )
        labels = np.full((iterations, len(real)), -1)
        labels[:, real] = [_by_appearance(row) for row in places]
        weights = np.full((iterations, len(real), mdp.n_features), np.nan)
        weights[:, real] = np.take_along_axis(table, places[..., None], axis=1) / scale
        return DPMTrace(labels, labels.max(1) + 1, weights, *rest)

    def fit(key: Array, demonstration: Demonstration) -> Clustering:
        return best_sample(sample(key, demonstration))

    return DPMBIRL("DPM-BIRL", fit, sample)


def best_sample(trace: DPMTrace) -> Clustering:
    """Return the iteration of highest joint density as a clustering; padding rows get the proportions."""
    best = int(np.argmax(trace.log_joint))
    labels, n_components = trace.labels[best], int(trace.n_components[best])
    responsibilities = (labels[:, None] == np.arange(n_components)).astype(float)
    proportions = responsibilities.sum(0) / responsibilities.sum()
    responsibilities[labels < 0] = proportions
    first = [int(np.flatnonzero(labels == d)[0]) for d in range(n_components)]
    return Clustering(trace.weights[best, first], proportions, responsibilities, float(trace.log_joint[best]))


def _by_appearance(labels: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Renumber the components of a partition in the order in which they appear."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]
