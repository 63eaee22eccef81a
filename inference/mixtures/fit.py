"""The min-max-entropy mixture fitted by alternation: assignments, proportions and rewards in turn.

The sound form of program (5.1). Given trajectories and, online, the statistic of earlier ones, it climbs ::

    J = sum_{i,d} v_{d,i} log P(X_i; theta_d) + sum_d N_d . log pi_theta_d
        - temperature { sum_{i,d} v_{d,i} log v_{d,i} - sum_d (n_d + sum_i v_{d,i}) log pi_d
                        - strength sum_d pi_d log pi_d }
        - sum_d (slack |theta_d|_1 + ridge/2 |theta_d|^2)

(``n_d``, ``N_d``: mass and visits of earlier sessions). The E-step makes ``v_{d,i}`` proportional to
``pi_d P(X_i; theta_d)^(1/temperature)``; the M-steps are
:func:`~i2rl.inference.programs.entropic.entropic_proportions` and one maximum-entropy program per component
(:func:`~i2rl.inference.programs.maximum_entropy.fit_counts`). ``J`` never falls while the set of components
is fixed. Features are scaled (:mod:`~i2rl.models.process.units`), so penalties are of scaled weights.

*Number of components.* With ``temperature`` 1, ``J`` is the likelihood of a mixture. It cannot distinguish
one stochastic expert, who draws a choice once and repeats it, from two deterministic experts: the first costs
``log 2`` nats for the choice, the second ``log 2`` nats for the assignment. A lower temperature weighs the
assignment less (a point further along the same rate-distortion curve) and prefers several deterministic
experts. :mod:`~i2rl.inference.mixtures.merging` chooses the number of components.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import xlogy
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, soft_plan
from ..completion.explanations import Trajectories, explain_each
from ..programs.entropic import entropic_proportions
from ..programs.maximum_entropy import WarmStart, fit_scaled_counts


@shown_briefly
class MixtureProgram(NamedTuple):
    """Settings of the program in the module's formula; features of ``mdp`` are scaled.

    The climb ends when ``J`` gains less than ``tolerance`` nats, or after ``iterations``.
    """

    mdp: TabularMDP
    reachable: Bool[Array, " S"]
    strength: Array | float
    slack: Array | float
    ridge: Array | float
    temperature: Array | float
    iterations: Array | int
    tolerance: Array | float


@shown_briefly
class Kept(NamedTuple):
    """Statistic of earlier trajectories: mass and visits of each component."""

    mass: Float[Array, " D"]
    visits: Float[Array, "D S A"]


@shown_briefly
class Mixture(NamedTuple):
    """Components of a mixture; a component without proportion is an empty slot."""

    weights: Float[Array, "D K"]
    values: Float[Array, "D S"]
    proportions: Float[Array, " D"]


@shown_briefly
class Fit(NamedTuple):
    """A mixture, its assignment of the trajectories, and the work of finding it.

    Fields
    ------
    mixture : Mixture
    kept : Kept
        Statistic of earlier trajectories, merged as the components were.
    responsibilities : float ``[n, D]``
        ``v_{d,i}``; zero for rows of padding.
    visits, seen : float ``[D, S, A]``
        Expected visits of the trajectories by component: of all steps, and of the seen steps.
    log_likelihood : float ``[n]``
        ``log sum_d pi_d P(X_i; theta_d)``.
    objective, score : float
        ``J``, and the score that ranks solutions of different sizes (minus infinity until it is computed).
    gain : float
        Gain of ``J`` in the last iteration.
    iterations, solver_iterations : int
    converged : bool
        True if the programs of the last M-step met their tolerances.
    """

    mixture: Mixture
    kept: Kept
    responsibilities: Float[Array, "n D"]
    visits: Float[Array, "D S A"]
    seen: Float[Array, "D S A"]
    log_likelihood: Float[Array, " n"]
    objective: Float[Array, ""]
    score: Float[Array, ""]
    gain: Float[Array, ""]
    iterations: Int[Array, ""]
    solver_iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def nothing_kept(mdp: TabularMDP, n_components: int) -> Kept:
    """Return the statistic before the first trajectory."""
    return Kept(jnp.zeros(n_components), jnp.zeros((n_components, mdp.n_states, mdp.n_actions)))


def empty_mixture(mdp: TabularMDP, n_components: int) -> Mixture:
    """Return a mixture of ``n_components`` empty slots."""
    return Mixture(
        jnp.zeros((n_components, mdp.n_features)),
        jnp.zeros((n_components, mdp.n_states)),
        jnp.zeros(n_components),
    )


# -- the two steps ------------------------------------------------------------------------------------


def log_policies(
    mdp: TabularMDP, weights: Float[Array, "D K"], values: Float[Array, "D S"]
) -> tuple[Float[Array, "D S A"], Float[Array, "D S"]]:
    """Return soft log-policies of every component (``-inf`` for unavailable actions), and their values."""

    def one(inputs: tuple) -> tuple:
        plan = soft_plan(mdp, reward_of(mdp, inputs[0]), inputs[1])
        return plan.log_policy, plan.values

    return lax.map(one, (weights, values))


def _finite_log(p: Array) -> Array:
    """Return ``log p``, and 0 where ``p`` is 0: for sums in which such terms carry no mass."""
    return jnp.where(p > 0, jnp.log(jnp.where(p > 0, p, 1.0)), 0.0)


@shown_briefly
class Assigned(NamedTuple):
    """Assignments: responsibilities, each trajectory's share of ``J``, and its log-likelihood."""

    responsibilities: Float[Array, "n D"]
    value: Float[Array, " n"]
    log_likelihood: Float[Array, " n"]


def assign(
    log_likelihood: Float[Array, "D n"],
    proportions: Float[Array, " D"],
    live: Bool[Array, " n"],
    temperature: Array | float,
) -> Assigned:
    """Run the E-step, given the log-likelihood of every trajectory under every component."""
    present = jnp.where(proportions > 0, _finite_log(proportions), -jnp.inf)
    joint = log_likelihood.T / temperature + present
    total = jax.nn.logsumexp(joint, axis=1)
    possible = jnp.isfinite(total)
    shares = jnp.exp(joint - jnp.where(possible, total, 0.0)[:, None])
    return Assigned(
        jnp.where((live & possible)[:, None], shares, 0.0),
        jnp.where(live, temperature * total, 0.0),
        jnp.where(live, jax.nn.logsumexp(log_likelihood.T + present, axis=1), 0.0),
    )


def proportions_of(program: MixtureProgram, mass: Float[Array, " D"]) -> Float[Array, " D"]:
    """Return the best proportions for each component's mass; without mass all slots stay empty."""
    return jnp.where(jnp.sum(mass) > 0, entropic_proportions(mass, program.strength), 0.0)


def penalty(program: MixtureProgram, weights: Float[Array, "*D K"]) -> Float[Array, ""]:
    """Return the penalty of the priors on the weights in ``J``, in nats."""
    return program.slack * jnp.sum(jnp.abs(weights)) + program.ridge / 2 * jnp.sum(weights**2)


def objective_of(
    program: MixtureProgram, kept: Kept, mixture: Mixture, policies: Float[Array, "D S A"], assigned: Assigned
) -> Float[Array, ""]:
    """Evaluate ``J``."""
    weights, proportions = mixture.weights, mixture.proportions
    known = jnp.sum(kept.visits * jnp.where(program.mdp.available, policies, 0.0))
    entropic = program.strength * jnp.sum(xlogy(proportions, proportions))
    return (
        jnp.sum(assigned.value)
        + known
        + program.temperature * (kept.mass @ _finite_log(proportions) + entropic)
        - penalty(program, weights)
    )


def _collected(responsibilities: Float[Array, "n D"], visits: Float[Array, "D n S A"]) -> Array:
    return jnp.einsum("nd,dnsa->dsa", responsibilities, visits)


def e_step(
    program: MixtureProgram,
    trajectories: Trajectories,
    kept: Kept,
    mixture: Mixture,
    before: Float[Array, ""],
    iterations: Array,
    solver_iterations: Array,
) -> Fit:
    """Assign trajectories under these components, and evaluate ``J`` and its gain over ``before``."""
    policies, values = log_policies(program.mdp, mixture.weights, mixture.values)
    mixture = mixture._replace(values=values)
    explained = explain_each(program.mdp, policies, trajectories, mixture.proportions > 0)
    assigned = assign(explained.log_likelihood, mixture.proportions, trajectories.live, program.temperature)
    objective = objective_of(program, kept, mixture, policies, assigned)
    shares = assigned.responsibilities
    return Fit(
        mixture,
        kept,
        shares,
        _collected(shares, explained.visits),
        _collected(shares, explained.seen),
        assigned.log_likelihood,
        objective,
        jnp.array(-jnp.inf),
        objective - before,
        iterations,
        solver_iterations,
        jnp.array(True),
    )


def _m_step(
    program: MixtureProgram, kept: Kept, mixture: Mixture, mass: Float[Array, " D"], visits: Array
) -> tuple[Mixture, Int[Array, ""], Bool[Array, ""]]:
    """Fit proportions and rewards to the trajectories assigned to each component, earlier ones included.

    Also returns the iterations of the solver, and a flag that every program met its tolerance.
    """

    def reward(inputs: tuple) -> tuple:
        counts, *start = inputs
        solution = fit_scaled_counts(program.mdp, counts, program.slack, program.ridge, WarmStart(*start))
        return solution.weights, solution.values, solution.iterations, solution.converged

    fitted = lax.map(reward, (kept.visits + visits, mixture.weights, mixture.values))
    proportions = proportions_of(program, kept.mass + mass)
    return Mixture(fitted[0], fitted[1], proportions), jnp.sum(fitted[2]), jnp.all(fitted[3])


def climb(
    program: MixtureProgram,
    trajectories: Trajectories,
    kept: Kept,
    mixture: Mixture,
    responsibilities: Float[Array, "n D"],
    visits: Float[Array, "D S A"],
) -> Fit:
    """Alternate until ``J`` converges, beginning with the M-step for these assignments."""

    def step(fit: Fit) -> Fit:
        mass = jnp.sum(fit.responsibilities, axis=0)
        new, spent, converged = _m_step(program, kept, fit.mixture, mass, fit.visits)
        counted = (fit.iterations + 1, fit.solver_iterations + spent)
        return e_step(program, trajectories, kept, new, fit.objective, *counted)._replace(converged=converged)

    def unfinished(fit: Fit) -> Bool[Array, ""]:
        return (fit.gain > program.tolerance) & (fit.iterations < program.iterations)

    return lax.while_loop(
        unfinished, step, unmade(program, trajectories, kept, mixture, responsibilities, visits)
    )


def unmade(
    program: MixtureProgram,
    trajectories: Trajectories,
    kept: Kept,
    mixture: Mixture,
    responsibilities: Array,
    visits: Array,
) -> Fit:
    """Return a fit with assignments alone, to be climbed from."""
    nowhere, zero = jnp.array(-jnp.inf), jnp.zeros((), int)
    unknown = jnp.zeros(trajectories.live.shape)
    return Fit(
        mixture,
        kept,
        responsibilities,
        visits,
        visits,
        unknown,
        nowhere,
        nowhere,
        -nowhere,
        zero,
        zero,
        jnp.array(True),
    )
