"""Maximum-likelihood IRL of Boltzmann experts, with one reward function or several.

MLIRL (Vroman 2014) climbs the Boltzmann likelihood of the demonstration. EM-MLIRL (Babes-Vroman et al. 2011)
is a mixture of a given number of such experts, fitted by expectation-maximisation. The likelihood is linear
in the visits, so a component's M-step is MLIRL on the visits weighted by the responsibilities.
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
    boltzmann_log_likelihoods,
    random_weights,
    require_positive,
    visit_counts,
)


@shown_briefly
class MLIRLFit(NamedTuple):
    """Result of MLIRL.

    Fields
    ------
    weights : float ``[K]``
        Weights of the best start; scaled weights lie in ``[-1, 1]``.
    log_likelihood : float
        Log-likelihood of the whole demonstration, in nats, without transition probabilities.
    objective : float ``[restarts]``
        Log-likelihood at the end of each start.
    iterations : int ``[restarts]``
        Number of evaluations of each start.
    """

    weights: Float[np.ndarray, " K"]
    log_likelihood: float
    objective: Float[np.ndarray, " restarts"]
    iterations: Int[np.ndarray, " restarts"]


@shown_briefly
class Ascent(NamedTuple):
    """Point of the projected gradient ascent: value and gradient there, and the step to try next."""

    weights: Float[Array, " K"]
    value: Float[Array, ""]
    gradient: Float[Array, " K"]
    step: Float[Array, ""]
    iterations: Int[Array, ""]


def ascend(
    mdp: TabularMDP,
    counts: Float[Array, "S A"],
    start: Float[Array, " K"],
    rationality: float | Array,
    iterations: int,
    tolerance: float = 1e-7,
) -> Ascent:
    """Climb ``sum N(s, a) log pi(a | s)`` by gradient ascent projected on the box; traceable.

    The step grows after success and halves after failure (Armijo's condition), so the value never falls;
    it ends when a step would move no weight by ``tolerance``.
    """

    @jax.value_and_grad
    def objective(weights: Float[Array, " K"]) -> Float[Array, ""]:
        return boltzmann_log_likelihoods(mdp, weights, counts[None], rationality)[0]

    def reach(point: Ascent) -> Float[Array, ""]:
        return point.step * jnp.max(jnp.abs(point.gradient))

    def attempt(point: Ascent) -> Ascent:
        weights = jnp.clip(point.weights + point.step * point.gradient, -BOX, BOX)
        value, gradient = objective(weights)
        gain = point.gradient @ (weights - point.weights)
        better = value >= point.value + 1e-4 * gain
        moved = Ascent(weights, value, gradient, 2 * point.step, point.iterations + 1)
        stayed = point._replace(step=point.step / 2, iterations=point.iterations + 1)
        return jax.tree.map(partial(jnp.where, better), moved, stayed)

    def unfinished(point: Ascent) -> Array:
        projected = jnp.clip(point.weights + point.step * point.gradient, -BOX, BOX) - point.weights
        return (point.iterations < iterations) & (jnp.max(jnp.abs(projected)) > tolerance)

    value, gradient = objective(start)
    first = Ascent(start, value, gradient, jnp.ones(()), jnp.zeros((), int))
    # The first step is a tenth of the box, whatever the amount of data.
    first = first._replace(step=0.2 * BOX / jnp.maximum(reach(first), 1e-12))
    return lax.while_loop(unfinished, attempt, first)


@partial(jax.jit, static_argnames=("restarts", "iterations"))
def _climb(
    key: Array, mdp: TabularMDP, counts: Array, rationality: Array, restarts: int, iterations: int
) -> Ascent:
    def from_start(key: Array) -> Ascent:
        return ascend(mdp, counts, random_weights(key, mdp.n_features), rationality, iterations)

    return lax.map(from_start, jax.random.split(key, restarts))


def mlirl(
    key: Array,
    mdp: TabularMDP,
    demonstration: Demonstration,
    *,
    rationality: float = ETA,
    restarts: int = 5,
    iterations: int = 300,
) -> MLIRLFit:
    """Find the weights of maximum likelihood of the demonstration.

    Scaled weights (:mod:`~i2rl.models.process.units`) are restricted to ``[-1, 1]^K``.

    Parameters
    ----------
    key : JAX random key
        Key of the starts, uniform on the box.
    mdp, demonstration
        The decision process; its demonstration, every step seen.
    rationality : float
        Inverse temperature of the expert, per unit of value.
    restarts, iterations : int
        Starts, and evaluations from each at most. The likelihood has several local maxima, and ridges
        (where the greedy policy changes) on which gradient ascent may stop; the best start is returned.

    Raises
    ------
    DemonstrationError
        Naming trajectory and step, for a step that was hidden or that is impossible.
    ValueError
        For a ``rationality``, ``restarts`` or ``iterations`` that is not positive, or an undiscounted MDP.

    See Also
    --------
    i2rl.inference.em_mlirl : a mixture of experts
    i2rl.inference.birl : the posterior of the same expert

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import mlirl
    >>> from i2rl.models import Demonstration
    >>> walk = Demonstration.from_pairs([[0, 1, 2, 3, 4, 4]], [[1, 1, 1, 1, 2, 2]])
    >>> fit = mlirl(jax.random.key(0), five_cells().mdp, walk, restarts=1, iterations=20)
    >>> fit.weights.shape, bool(fit.weights[0] > 0)  # the end is worth something
    ((2,), True)
    """
    require_discounted(mdp)
    require_positive(rationality=rationality, restarts=restarts, iterations=iterations)
    counts = visit_counts(mdp, demonstration).sum(0)
    scaled = with_scaled_features(mdp)
    ends = _climb(
        as_key(key), scaled, jnp.asarray(counts), jnp.asarray(float(rationality)), restarts, iterations
    )
    best = int(np.argmax(ends.value))
    return MLIRLFit(
        np.asarray(ends.weights[best] / feature_scale(mdp)),
        float(ends.value[best]),
        np.asarray(ends.value),
        np.asarray(ends.iterations),
    )


def require_components(n_components: int, trajectories: int) -> None:
    """Raise ``ValueError`` if there are fewer trajectories than components."""
    if n_components > trajectories:
        raise ValueError(
            f"`n_components` must be at most the number of trajectories, {trajectories}; got {n_components}"
        )


# -- mixture ------------------------------------------------------------------------------------------


@shown_briefly
class Mixture(NamedTuple):
    """Parameters of a mixture of Boltzmann experts: ``weights [D, K]``, ``proportions [D]``."""

    weights: Float[Array, "D K"]
    proportions: Float[Array, " D"]


@shown_briefly
class EMTrace(NamedTuple):
    """Full result of an EM fit.

    Fields
    ------
    clustering : Clustering
        Clustering of the best start; its ``objective`` is the marginal log-likelihood.
    log_likelihoods : float ``[restarts, iterations + 1]``
        Marginal log-likelihood of the demonstration at the start and after each iteration, in nats.
    """

    clustering: Clustering
    log_likelihoods: Float[np.ndarray, "restarts iterations"]


@shown_briefly
class EMMLIRL(NamedTuple):
    """EM-MLIRL on one decision process: ``fit(key, demonstration)`` uses all trajectories at once.

    ``trace(key, demonstration)`` is the same fit with its history.
    """

    name: str
    fit: Callable[[Array, Demonstration], Clustering]
    trace: Callable[[Array, Demonstration], EMTrace]


def component_log_likelihoods(
    mdp: TabularMDP, weights: Float[Array, "D K"], counts: Float[Array, "n S A"], rationality: float | Array
) -> Float[Array, "n D"]:
    """Return the log-likelihood of every trajectory under every component's weights; traceable."""

    def one(theta: Float[Array, " K"]) -> Float[Array, " n"]:
        return boltzmann_log_likelihoods(mdp, theta, counts, rationality)

    return lax.map(one, weights).T


def _e_step(mdp: TabularMDP, mixture: Mixture, counts: Float[Array, "n S A"], rationality: Array) -> tuple:
    """Return responsibilities ``[n, D]`` and the marginal log-likelihood."""
    joint = jnp.log(mixture.proportions) + component_log_likelihoods(
        mdp, mixture.weights, counts, rationality
    )
    marginal = jax.nn.logsumexp(joint, axis=1)
    return jnp.exp(joint - marginal[:, None]), jnp.sum(marginal)


@partial(jax.jit, static_argnames=("n_components", "restarts", "iterations", "ascents"))
def _em(
    key: Array,
    mdp: TabularMDP,
    counts: Float[Array, "n S A"],
    rationality: Float[Array, ""],
    n_components: int,
    restarts: int,
    iterations: int,
    ascents: int,
) -> tuple:
    def improve(mixture: Mixture, _: None) -> tuple:
        responsibilities, log_likelihood = _e_step(mdp, mixture, counts, rationality)
        visits = jnp.einsum("nd,nsa->dsa", responsibilities, counts)
        weights = lax.map(
            lambda x: ascend(mdp, x[0], x[1], rationality, ascents).weights, (visits, mixture.weights)
        )
        return Mixture(weights, jnp.mean(responsibilities, axis=0)), log_likelihood

    def from_start(key: Array) -> tuple:
        keys = jax.random.split(key, n_components)
        start = jax.vmap(random_weights, in_axes=(0, None))(keys, mdp.n_features)
        first = Mixture(start, jnp.full(n_components, 1 / n_components))
        ends: tuple = lax.scan(improve, first, None, iterations)
        mixture, history = ends
        responsibilities, log_likelihood = _e_step(mdp, mixture, counts, rationality)
        return mixture, responsibilities, jnp.append(history, log_likelihood)

    return lax.map(from_start, jax.random.split(key, restarts))


def em_mlirl(
    mdp: TabularMDP,
    *,
    n_components: int,
    rationality: float = ETA,
    iterations: int = 50,
    restarts: int = 1,
    ascents: int = 30,
) -> EMMLIRL:
    """Build EM for a mixture of Boltzmann experts of known number (Babes-Vroman et al. 2011).

    Responsibilities are ``v_{d,i} ~ rho_d prod_t pi_rationality(a_t | s_t; theta_d)``; proportions are their
    means. Weights climb the responsibility-weighted log-likelihood from their previous values, so the
    marginal log-likelihood never falls. Starts: weights uniform on the box, equal proportions. The box
    ``[-1, 1]^K`` is of scaled weights (:mod:`~i2rl.models.process.units`).

    Parameters
    ----------
    mdp : TabularMDP
    n_components : int
        Number of components, ``D``.
    rationality : float
        Inverse temperature of the experts, per unit of value.
    iterations, restarts : int
        EM iterations, and number of starts; the likeliest is returned.
    ascents : int
        Gradient evaluations of each component in an M-step, at most.

    Returns
    -------
    EMMLIRL
        ``fit`` raises ``ValueError`` for more components than trajectories, and ``DemonstrationError``
        naming trajectory and step for one that was hidden or that is impossible.

    Raises
    ------
    ValueError
        For numbers that are not positive, or an undiscounted MDP.

    See Also
    --------
    i2rl.inference.mlirl : one expert
    i2rl.inference.dpm_birl : a mixture of unknown size
    i2rl.inference.batch_mme_mtirl : a mixture with hidden steps

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import em_mlirl
    >>> from i2rl.models import Demonstration
    >>> walks = Demonstration.from_pairs([[0, 1, 2, 3]] * 2 + [[0] * 4] * 2, [[1] * 4] * 2 + [[2] * 4] * 2)
    >>> learner = em_mlirl(five_cells().mdp, n_components=2, iterations=5)
    >>> found = learner.fit(jax.random.key(0), walks)
    >>> ours = found.assignments  # two who walk, two who stay
    >>> bool(ours[0] == ours[1] != ours[2] == ours[3])
    True
    """
    require_discounted(mdp)
    require_positive(
        n_components=n_components,
        rationality=rationality,
        iterations=iterations,
        restarts=restarts,
        ascents=ascents,
    )
    scale, scaled = feature_scale(mdp), with_scaled_features(mdp)

    def trace(key: Array, demonstration: Demonstration) -> EMTrace:
        counts = visit_counts(mdp, demonstration)
        require_components(n_components, int((demonstration.lengths > 0).sum()))
        # Rows of padding would count for the proportions.
        real = demonstration.lengths > 0
        mixtures, responsibilities, history = _em(
            as_key(key),
            scaled,
            jnp.asarray(counts[real]),
            jnp.asarray(float(rationality)),
            n_components,
            restarts,
            iterations,
            ascents,
        )
        best = int(np.argmax(history[:, -1]))
        proportions = np.asarray(responsibilities[best]).mean(0)
        rows = np.broadcast_to(proportions, (len(real), n_components)).copy()
        rows[real] = responsibilities[best]
        clustering = Clustering(
            np.asarray(mixtures.weights[best] / scale), proportions, rows, float(history[best, -1])
        )
        return EMTrace(clustering, np.asarray(history))

    return EMMLIRL("EM-MLIRL", lambda key, demonstration: trace(key, demonstration).clustering, trace)
