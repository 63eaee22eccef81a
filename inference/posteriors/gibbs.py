"""Gibbs sampling of the assignments of trajectories to components (Neal 2000, algorithm 8).

The posterior of :func:`mixture_model` without truncation: proportions are integrated out, leaving the
Chinese restaurant process over partitions. A trajectory chooses between the components of all others and
``auxiliary`` new ones from the prior; then each component's weights move by elliptical slice sampling
(Murray, Adams and MacKay 2010), which needs neither gradients nor tuning; then a random concentration moves.
There is one slot per trajectory, so the slots always suffice.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypedDict, Unpack

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import counted
from ...models.laws.mixture import (
    COMPONENTS,
    component_log_likelihoods,
    soft_policies,
    stick_proportions,
    trajectory_log_likelihoods,
)
from ...models.laws.occlusion import ScaledPrior
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import AnySensor
from ...models.process.mdp import TabularMDP
from ..sessions.progress import progress_line
from .mixture_problem import MixtureProblem, Start, in_threads, mixture_data, pose, resolve_jit, starts

_CONCENTRATION_MOVES = 5


@shown_briefly
class Reference(NamedTuple):
    """Gaussian of the elliptical slices: mean and Cholesky factor over unconstrained weights."""

    mean: Float[Array, " D"]
    scale_tril: Float[Array, "D D"]


@shown_briefly
class Seating(NamedTuple):
    """State of the sampler.

    Fields
    ------
    assignment : int ``[n]``
        Slot of each trajectory.
    position : float ``[n, D]``
        Unconstrained weights of each slot; those of empty slots are arbitrary.
    log_likelihood : float ``[n, u]``
        Log-likelihood of each distinct trajectory under each slot's weights.
    concentration : float
    """

    assignment: Int[Array, " n"]
    position: Float[Array, "n D"]
    log_likelihood: Float[Array, "n u"]
    concentration: Float[Array, ""]


@shown_briefly
class Seated(NamedTuple):
    """A draw: ``assignment [n]``, ``weights [n, K]`` by slot, ``concentration``, and slice evaluations."""

    assignment: Int[Array, " n"]
    weights: Float[Array, "n K"]
    concentration: Float[Array, ""]
    n_steps: Int[Array, ""]


def reference_gaussian(prior: dist.Distribution) -> Reference:
    """Return a Gaussian prior itself, else a Gaussian of its centre and spread (any one is exact)."""
    bare = prior.base if isinstance(prior, ScaledPrior) else prior
    while isinstance(bare, dist.Independent | dist.ExpandedDistribution):
        bare = bare.base_dist
    size = prior.event_shape[0]
    if isinstance(bare, dist.Normal):
        mean, sd = (jnp.broadcast_to(x, (size,)) for x in (bare.loc, bare.scale))
        return Reference(mean, jnp.diag(sd))
    if isinstance(bare, dist.MultivariateNormal):
        return Reference(bare.loc, bare.scale_tril)
    draws = dist.biject_to(prior.support).inv(prior.sample(jax.random.key(0), (4096,)))
    low, middle, high = np.quantile(np.asarray(draws), [0.159, 0.5, 0.841], axis=0)
    return Reference(jnp.asarray(middle), jnp.diag(jnp.asarray(high - low) / 2))


class Sweeps(NamedTuple):
    """Lengths of a chain, and the work of one iteration, see :func:`gibbs_mixture_posterior`."""

    warmup: int
    draws: int
    auxiliary: int = 3
    moves: int = 4
    thin: int = 1


def gibbs_chain(
    key: Array,
    problem: MixtureProblem,
    reference: Reference,
    state: Seating,
    sweeps: Sweeps,
) -> Seated:
    """Run one chain; traceable. Return ``draws``, every ``thin``-th iteration after at least ``warmup``."""
    warmup, draws, auxiliary, moves, thin = sweeps
    step = partial(sweep, problem=problem, reference=reference, auxiliary=auxiliary, moves=moves)
    constrain = dist.biject_to(problem.prior.support)

    def kept(state: Seating, keys: Array) -> tuple:
        state, evaluations = lax.scan(step, state, keys)
        weights = constrain(state.position)
        return state, Seated(state.assignment, weights, state.concentration, jnp.sum(evaluations))

    # One scan, its beginning dropped, compiles in half the time of two.
    begin = -(-warmup // thin)
    chain: Seated = lax.scan(kept, state, jax.random.split(key, (begin + draws, thin)))[1]
    return jax.tree.map(lambda x: x[begin:], chain)


_run_chain = jax.jit(gibbs_chain, static_argnames="sweeps")


def sweep(
    state: Seating,
    key: Array,
    *,
    problem: MixtureProblem,
    reference: Reference,
    auxiliary: int,
    moves: int,
) -> tuple[Seating, Int[Array, ""]]:
    """Update every trajectory, every component's weights, and the concentration once; count evaluations."""
    seat_key, move_key, concentration_key = jax.random.split(key, 3)
    state = _reseat(seat_key, state, problem, auxiliary)
    state, evaluations = _move_weights(move_key, state, problem, reference, moves)
    if isinstance(problem.concentration, dist.Distribution):
        n_components = jnp.sum(jnp.bincount(state.assignment, length=len(state.assignment)) > 0)
        moved = move_concentration(
            concentration_key, state.concentration, problem.concentration, n_components, len(state.assignment)
        )
        state = state._replace(concentration=moved)
    return state, evaluations


def _reseat(key: Array, state: Seating, problem: MixtureProblem, auxiliary: int) -> Seating:
    mdp, perceived, rows = problem.mdp, problem.perceived, problem.rows
    n = len(rows)
    draw_key, choose_key = jax.random.split(key)
    # New components come from the prior whatever the seating, so an iteration plans all of them at once.
    drawn = problem.prior.sample(draw_key, (n, auxiliary))
    policies = soft_policies(mdp, drawn.reshape(n * auxiliary, -1))
    policies = policies.reshape((n, auxiliary, *mdp.available.shape))
    fresh = dist.biject_to(problem.prior.support).inv(drawn)
    spread = jnp.log(state.concentration / auxiliary)

    def one(state: Seating, inputs: tuple) -> tuple:
        i, key, fresh, policies = inputs
        assignment, position, table, _ = state
        row, own = rows[i], assignment[i]
        counts = jnp.bincount(assignment, length=n).at[own].add(-1)
        alone = counts[own] == 0
        offered = jax.vmap(lambda policy: _row_log_likelihood(problem, policy, row))(policies)
        # A trajectory alone in its component has it as the first of the new ones.
        offered = offered.at[0].set(jnp.where(alone, table[own, row], offered[0]))
        known = jnp.where(counts > 0, jnp.log(jnp.maximum(counts, 1)) + table[:, row], -jnp.inf)
        choice = jax.random.categorical(key, jnp.concatenate([known, spread + offered]))
        new = jnp.maximum(choice - n, 0)
        opens = (choice >= n) & ~(alone & (new == 0))
        slot = jnp.where(choice < n, choice, jnp.where(alone, own, jnp.argmin(counts > 0)))
        column = lax.cond(
            opens,
            lambda: trajectory_log_likelihoods(mdp, policies[new], perceived),
            lambda: table[slot],
        )
        position = position.at[slot].set(jnp.where(opens, fresh[new], position[slot]))
        return (
            state._replace(
                assignment=assignment.at[i].set(slot),
                position=position,
                log_likelihood=table.at[slot].set(column),
            ),
            None,
        )

    return lax.scan(one, state, (jnp.arange(n), jax.random.split(choose_key, n), fresh, policies))[0]


def _row_log_likelihood(
    problem: MixtureProblem, log_policy: Float[Array, "S A"], row: Int[Array, ""]
) -> Float[Array, ""]:
    """Return the log-likelihood of one trajectory; run a forward pass only if it has hidden steps."""
    perceived = problem.perceived
    counts, dynamics, log_evidence, live, _ = perceived

    def at(x: Array, i: Array) -> Array:
        return lax.dynamic_slice_in_dim(x, i, 1)

    def seen() -> Float[Array, ""]:
        one = perceived._replace(counts=at(counts, row), dynamics=at(dynamics, row))
        one = one._replace(log_evidence=log_evidence[:0], live=live[:0])
        return trajectory_log_likelihoods(problem.mdp, log_policy, one)[0]

    def hidden() -> Float[Array, ""]:
        i = row - len(counts)
        one = perceived._replace(log_evidence=at(log_evidence, i), live=at(live, i))
        one = one._replace(counts=counts[:0], dynamics=dynamics[:0])
        return trajectory_log_likelihoods(problem.mdp, log_policy, one)[0]

    if not len(live) or not len(counts):
        return seen() if len(counts) else hidden()
    return lax.cond(row < len(counts), seen, hidden)


def _move_weights(
    key: Array, state: Seating, problem: MixtureProblem, reference: Reference, moves: int
) -> tuple[Seating, Int[Array, ""]]:
    mdp, prior = problem.mdp, problem.prior
    constrain = dist.biject_to(prior.support)
    n, u = state.log_likelihood.shape
    members = jnp.zeros((n, u)).at[state.assignment, problem.rows].add(1.0)
    gaussian = dist.MultivariateNormal(reference.mean, scale_tril=reference.scale_tril)

    def evaluate(x: Float[Array, " D"], members: Float[Array, " u"]) -> tuple:
        weights = constrain(x)
        column = component_log_likelihoods(mdp, soft_policies(mdp, weights[None]), problem.perceived)[0]
        return column, height(x, column, members)

    def height(x: Float[Array, " D"], column: Float[Array, " u"], members: Float[Array, " u"]) -> Array:
        """Return the log-density relative to the Gaussian."""
        weights = constrain(x)
        log_prior = prior.log_prob(weights) + constrain.log_abs_det_jacobian(x, weights).sum()
        return jnp.sum(jnp.where(members > 0, members * column, 0.0)) + log_prior - gaussian.log_prob(x)

    def slice_once(carry: tuple, key: Array) -> tuple[tuple, Int[Array, ""]]:
        x, column, level, members = carry
        direction_key, height_key, angle_key = jax.random.split(key, 3)
        away = jax.random.normal(direction_key, x.shape) @ reference.scale_tril.T
        threshold = level + jnp.log(jax.random.uniform(height_key))
        angle_key, first = jax.random.split(angle_key)
        angle = jax.random.uniform(first, maxval=2 * jnp.pi)

        def propose(carry: tuple) -> tuple:
            key, angle, low, high, _, count = carry
            y = reference.mean + (x - reference.mean) * jnp.cos(angle) + away * jnp.sin(angle)
            # The next proposal after a refusal: on the side of the bracket that holds angle zero.
            low, high = jnp.where(angle < 0, angle, low), jnp.where(angle < 0, high, angle)
            key, draw = jax.random.split(key)
            onward = jax.random.uniform(draw, minval=low, maxval=high)
            return key, onward, low, high, (y, *evaluate(y, members)), count + 1

        start = (angle_key, angle, angle - 2 * jnp.pi, angle, (x, column, -jnp.inf), jnp.array(0))
        *_, (y, column_y, level_y), count = lax.while_loop(lambda c: ~(c[4][2] >= threshold), propose, start)
        return (y, column_y, level_y, members), count

    def one_component(inputs: tuple) -> tuple:
        key, x, column, members = inputs

        def move() -> tuple:
            carry = (x, column, height(x, column, members), members)
            carry, counts = lax.scan(slice_once, carry, jax.random.split(key, moves))
            return carry[0], carry[1], jnp.sum(counts)

        return lax.cond(jnp.any(members > 0), move, lambda: (x, column, jnp.array(0)))

    keys = jax.random.split(key, n)
    position, table, count = lax.map(one_component, (keys, state.position, state.log_likelihood, members))
    return state._replace(position=position, log_likelihood=table), jnp.sum(count)


def move_concentration(
    key: Array,
    concentration: Float[Array, ""],
    prior: dist.Distribution,
    n_components: Int[Array, ""],
    n: int,
) -> Float[Array, ""]:
    """Make Metropolis steps of random size on the concentration given the number of components."""
    transform = dist.biject_to(prior.support)

    def density(z: Float[Array, ""]) -> Float[Array, ""]:
        alpha = transform(z)
        log_prior = prior.log_prob(alpha) + transform.log_abs_det_jacobian(z, alpha)
        return log_prior + n_components * jnp.log(alpha) + gammaln(alpha) - gammaln(alpha + n)

    def step(z: Float[Array, ""], key: Array) -> tuple:
        size_key, step_key, accept_key = jax.random.split(key, 3)
        size = jnp.exp(jax.random.uniform(size_key, minval=jnp.log(0.1), maxval=jnp.log(4.0)))
        proposed = z + size * jax.random.normal(step_key)
        accept = jnp.log(jax.random.uniform(accept_key)) < density(proposed) - density(z)
        return jnp.where(accept, proposed, z), None

    z = lax.scan(step, transform.inv(concentration), jax.random.split(key, _CONCENTRATION_MOVES))[0]
    return transform(z)


def seating_of(
    problem: MixtureProblem, assignment: Int[Array, " n"], position: Float[Array, "c D"], concentration: Array
) -> Seating:
    """Return the sampler's state for components ``[c]`` of given unconstrained weights; traceable."""
    n = len(assignment)
    position = jnp.zeros((n, position.shape[1])).at[: len(position)].set(position)
    policies = soft_policies(problem.mdp, dist.biject_to(problem.prior.support)(position))
    table = component_log_likelihoods(problem.mdp, policies, problem.perceived)
    return Seating(jnp.asarray(assignment), position, table, concentration)


def break_remainder(
    key: Array, seated: Seated, prior: dist.Distribution, components: int
) -> tuple[Float[Array, "T K"], Float[Array, " T"], Int[Array, " n"]]:
    """Draw the process given one seating: weights and proportions of ``components``, and the assignment.

    Occupied components come first and share ``Dirichlet(n_1, ..., n_k, alpha)`` with all others, whose share
    is broken into sticks, the last taking the rest. There must be fewer occupied components than
    ``components``.
    """
    share_key, rest_key, stick_key, weight_key = jax.random.split(key, 4)
    n, alpha = len(seated.assignment), seated.concentration
    size = max(n, components)
    counts = jnp.bincount(seated.assignment, length=size)
    order = jnp.argsort(counts == 0, stable=True)
    rank = jnp.argsort(order)
    occupied = counts[order][:components] > 0
    # All draws by inversion (gamma variates are slow to compile): the others' share is Beta(alpha, n), a
    # product of Beta(alpha + i, 1); a component's is a sum of as many exponential variates as it has
    # trajectories.
    rest = jnp.exp(jnp.sum(jnp.log(jax.random.uniform(rest_key, (n,))) / (alpha + jnp.arange(n))))
    shares = jnp.zeros(size).at[seated.assignment].add(jax.random.exponential(share_key, (n,)))
    shares = shares[order][:components]
    sticks = -jnp.expm1(jnp.log(jax.random.uniform(stick_key, (components,))) / alpha)
    broken = stick_proportions(jnp.where(occupied, 0.0, sticks)[:-1])
    proportions = (1 - rest) * shares / jnp.sum(shares) + rest * broken
    drawn = prior.sample(weight_key, (components,))
    slots = jnp.minimum(order, n - 1)[:components]
    weights = jnp.where(occupied[:, None], seated.weights[slots], drawn)
    return weights, proportions, rank[seated.assignment]


@partial(jax.jit, static_argnames="components")
def _break_all(keys: Array, seated: Seated, prior: dist.Distribution, components: int) -> tuple:
    return jax.vmap(lambda k, s: break_remainder(k, s, prior, components))(keys, seated)


class GibbsSampling(NamedTuple):
    """Lengths and number of chains, and the work of one iteration."""

    draws: int = 500
    warmup: int = 200
    chains: int = 4
    auxiliary: int = 3
    moves: int = 4
    thin: int = 1


class GibbsSamplingOptions(TypedDict, total=False):
    """:class:`GibbsSampling` as keyword arguments."""

    draws: int
    warmup: int
    chains: int
    auxiliary: int
    moves: int
    thin: int


def gibbs_mixture_posterior(
    key: Array,
    mdp: TabularMDP,
    sensor: AnySensor,
    demonstration: Demonstration,
    *,
    components: int = COMPONENTS,
    concentration: float | dist.Distribution = 1.0,
    prior: dist.Distribution | None = None,
    progress: bool = False,
    **sampling: Unpack[GibbsSamplingOptions],
) -> az.InferenceData:
    """Draw from the posterior of the Dirichlet process that :func:`mixture_model` truncates.

    Trajectories change components one at a time, so the sampler moves between partitions that NUTS cannot
    leave, though slowly if a component has many trajectories. The two posteriors differ by truncation alone
    (see :func:`truncation_error`). R-hat under label switching: see :func:`sample_mixture_posterior`.

    Parameters
    ----------
    key, mdp, sensor, demonstration, concentration, prior
        As in :func:`sample_mixture_posterior`.
    components : int
        Components in the output: the occupied ones, then others by stick-breaking. There are more if a draw
        has more occupied components, so that none is lost.
    draws, chains : int
        Draws returned by each chain, and number of chains; 500 and 4 by default.
    warmup, thin : int
        Iterations discarded by each chain, and iterations per returned draw; 200 and 1 by default.
    auxiliary : int
        New components offered to a trajectory, Neal's ``m``; 3 by default.
    moves : int
        Slice moves of each component's weights in an iteration; 4 by default.
    progress : bool
        Print each step that begins on standard error.

    Returns
    -------
    arviz.InferenceData
        Laid out as by :func:`sample_mixture_posterior`; ``sample_stats`` has ``lp``, the log-joint of
        partition and weights, and ``n_steps``, the number of slice evaluations.

    Raises
    ------
    DemonstrationError, ValueError
        As :func:`sample_mixture_posterior`; also for ``auxiliary``, ``moves`` or ``thin`` below one.

    See Also
    --------
    i2rl.inference.sample_mixture_posterior : the truncated model by NUTS
    i2rl.models.mixture_model : the truncated model

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import gibbs_mixture_posterior
    >>> mdp, _, sensor, demonstration = five_cells()
    >>> data = gibbs_mixture_posterior(
    ...     jax.random.key(0), mdp, sensor, demonstration, draws=20, warmup=20, chains=1
    ... )
    >>> data.assignments["assignment"].shape, data.assignments["co_clustering"].shape
    ((1, 20, 8), (8, 8))
    """
    draws, warmup, chains, auxiliary, moves, thin = GibbsSampling(**sampling)
    key = as_key(key)
    problem, demonstration, present = pose(
        mdp,
        sensor,
        demonstration,
        concentration=concentration,
        prior=prior,
        at_least_one={
            "components": components,
            "draws": draws,
            "chains": chains,
            "auxiliary": auxiliary,
            "moves": moves,
            "thin": thin,
        },
        warmup=warmup,
    )
    start_key, chain_key, break_key, resolve_key = jax.random.split(key, 4)
    with progress_line(progress) as tell:
        tell("posterior: finding starts, compiling first")
        reference = reference_gaussian(problem.prior)
        run = partial(_run_chain, sweeps=Sweeps(warmup, draws, auxiliary, moves, thin))
        begins = [_seat(problem, start) for start in starts(start_key, problem, chains, len(problem.rows))]
        tell(
            f"posterior: {counted(chains, 'chain')} of {warmup} + {draws * thin} iterations, compiling first"
        )
        keys = jax.random.split(chain_key, chains)
        seated: Seated = in_threads(
            run, [(k, problem, reference, s) for k, s in zip(keys, begins, strict=True)]
        )
        n_draws = chains * draws
        flat = jax.tree.map(lambda x: jnp.asarray(x.reshape(n_draws, *x.shape[2:])), seated)
        most = max(len(np.unique(row)) for row in np.asarray(flat.assignment))
        components = max(components, most + 1)
        weights, proportions, assignment = _break_all(
            jax.random.split(break_key, n_draws), flat, problem.prior, components
        )
        tell("posterior: likelihoods of the draws")
        keys = jax.random.split(resolve_key, n_draws)
        resolved = resolve_jit(keys, weights, proportions, flat.concentration, problem, assignment)
    shape = (chains, draws)
    drawn = tuple(
        np.asarray(x).reshape(*shape, *x.shape[1:]) for x in (weights, proportions, flat.concentration)
    )
    stats = {"lp": np.asarray(resolved.log_joint).reshape(shape), "n_steps": np.asarray(seated.n_steps)}
    method = "Gibbs over assignments (Neal's algorithm 8) with elliptical slices of weights"
    return mixture_data(key, problem, demonstration, present, drawn, resolved, stats, method)


_seating = jax.jit(seating_of)


def _seat(problem: MixtureProblem, start: Start) -> Seating:
    alpha = problem.concentration
    alpha = jnp.ones(()) if isinstance(alpha, dist.Distribution) else alpha
    # Chains start with different numbers of components; one shape for all compiles once.
    position = np.zeros((len(start.assignment), start.position.shape[1]))
    position[: len(start.position)] = start.position
    return _seating(problem, jnp.asarray(start.assignment), jnp.asarray(position), alpha)
