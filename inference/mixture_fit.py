"""The min-max-entropy mixture fitted by alternation: assignments, proportions and rewards in turn.

The sound form of program (5.1). Given trajectories and, online, what is kept of earlier ones, it climbs ::

    J = sum_i log sum_d pi_d P(X_i; theta_d) + sum_d n_d log pi_d + sum_d N_d . log pi_theta_d
        + strength sum_d pi_d log pi_d - sum_d (l1 |theta_d|_1 + ridge/2 |theta_d|^2)

(``n_d``, ``N_d``: mass and visits kept of earlier sessions). The E-step makes ``v_{d,i}`` proportional to
``pi_d P(X_i; theta_d)``; the M-steps are :func:`~.entropic.entropic_proportions` and one maximum-entropy
program per way (:func:`~.maxent.fit_counts`). ``J`` never falls.

*How many ways.* The climb starts from more ways than needed, and ways are merged. A sorter who flips a coin
once and then sticks to it, and two sorters who know what they want, give a trajectory the same probability:
the first costs ``log 2`` nats of indecision, the second ``log 2`` nats to say which sorter it was. Mixtures
of rewards are about people who know what they want, so that information is charged at less than its price:
the search ranks solutions by ``J + (1 - price) N I``, ``I`` being the mutual information of trajectory and
way. With ``price`` 1 it ranks by ``J``.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import xlogy
from jaxtyping import Array, Bool, Float, Int

from ..models.mdp import TabularMDP
from ..models.planning import hard_plan, reward_of, soft_plan
from .entropic import entropic_proportions
from .jumble import Explained, Jumble, SeenWhole, explain, explain_each, without_reward
from .maxent import WarmStart, fit_counts


class MixtureProgram(NamedTuple):
    """What is being solved: see the module's formula; ``price`` ranks solutions of different sizes.

    The climb ends when ``J`` gains less than ``tolerance`` nats, or after ``iterations``.
    """

    mdp: TabularMDP
    reachable: Bool[Array, " S"]
    strength: Array | float
    l1: Array | float
    ridge: Array | float
    price: Array | float
    iterations: Array | int
    tolerance: Array | float


class Kept(NamedTuple):
    """What is kept of earlier trajectories: how many were done each way, and the visits they made."""

    mass: Float[Array, " D"]
    visits: Float[Array, "D S A"]


class Mixture(NamedTuple):
    """Ways of doing the task; a way without proportion is an empty slot."""

    weights: Float[Array, "D K"]
    values: Float[Array, "D S"]
    proportions: Float[Array, " D"]


class Fit(NamedTuple):
    """A mixture, what it makes of the jumble, and what finding it took.

    Fields
    ------
    mixture : Mixture
    kept : Kept
        What was kept, merged as the ways were.
    responsibilities : float ``[n, D]``
        ``v_{d,i}``; zero for rows of padding.
    visits, seen : float ``[D, S, A]``
        The jumble's expected visits by way: of all steps, and of the steps seen.
    log_likelihood : float ``[n]``
        ``log sum_d pi_d P(X_i; theta_d)``.
    objective, score : float
        ``J``, and what solutions are ranked by.
    gain : float
        Of ``J`` in the last iteration.
    iterations, solver_iterations : int
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


def nothing_kept(mdp: TabularMDP, ways: int) -> Kept:
    """The statistic before the first trajectory."""
    return Kept(jnp.zeros(ways), jnp.zeros((ways, mdp.n_states, mdp.n_actions)))


def empty_mixture(mdp: TabularMDP, ways: int) -> Mixture:
    """So many empty slots."""
    return Mixture(jnp.zeros((ways, mdp.n_features)), jnp.zeros((ways, mdp.n_states)), jnp.zeros(ways))


# -- the two steps ------------------------------------------------------------------------------------


def log_policies(
    mdp: TabularMDP, weights: Float[Array, "D K"], values: Float[Array, "D S"]
) -> tuple[Float[Array, "D S A"], Float[Array, "D S"]]:
    """Soft log-policies of every way (``-inf`` where an action is unavailable), and their values."""

    def one(inputs: tuple) -> tuple:
        plan = soft_plan(mdp, reward_of(mdp, inputs[0]), inputs[1])
        return plan.log_policy, plan.values

    return lax.map(one, (weights, values))


def _finite_log(p: Array) -> Array:
    """``log p``, and 0 where ``p`` is 0: for sums in which such terms carry no mass."""
    return jnp.where(p > 0, jnp.log(jnp.where(p > 0, p, 1.0)), 0.0)


def assign(
    log_likelihood: Float[Array, "D n"], proportions: Float[Array, " D"], live: Bool[Array, " n"]
) -> tuple[Float[Array, "n D"], Float[Array, " n"]]:
    """Responsibilities, and the log-likelihood of each trajectory under the mixture."""
    present = jnp.where(proportions > 0, _finite_log(proportions), -jnp.inf)
    joint = log_likelihood.T + present
    total = jax.nn.logsumexp(joint, axis=1)
    possible = jnp.isfinite(total)
    shares = jnp.exp(joint - jnp.where(possible, total, 0.0)[:, None])
    return jnp.where((live & possible)[:, None], shares, 0.0), jnp.where(live, total, 0.0)


def _judge(
    program: MixtureProgram,
    kept: Kept,
    mixture: Mixture,
    policies: Float[Array, "D S A"],
    responsibilities: Float[Array, "n D"],
    log_likelihood: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """``J``, and what solutions are ranked by."""
    weights, proportions = mixture.weights, mixture.proportions
    known = jnp.sum(kept.visits * jnp.where(program.mdp.available, policies, 0.0))
    objective = (
        jnp.sum(log_likelihood)
        + kept.mass @ _finite_log(proportions)
        + known
        + program.strength * jnp.sum(xlogy(proportions, proportions))
        - program.l1 * jnp.sum(jnp.abs(weights))
        - program.ridge / 2 * jnp.sum(weights**2)
    )
    mass = kept.mass + jnp.sum(responsibilities, axis=0)
    total = jnp.maximum(jnp.sum(mass), 1e-300)
    # Trajectories of earlier sessions count as surely assigned.
    information = jnp.sum(xlogy(responsibilities, responsibilities)) - jnp.sum(xlogy(mass, mass / total))
    return objective, objective + (1 - program.price) * information


def _collected(responsibilities: Float[Array, "n D"], visits: Float[Array, "D n S A"]) -> Array:
    return jnp.einsum("nd,dnsa->dsa", responsibilities, visits)


def _e_step(
    program: MixtureProgram,
    jumble: Jumble,
    kept: Kept,
    mixture: Mixture,
    before: Float[Array, ""],
    iterations: Array,
    solver_iterations: Array,
) -> Fit:
    policies, values = log_policies(program.mdp, mixture.weights, mixture.values)
    mixture = mixture._replace(values=values)
    explained = explain_each(program.mdp, policies, jumble)
    shares, total = assign(explained.log_likelihood, mixture.proportions, jumble.live)
    objective, score = _judge(program, kept, mixture, policies, shares, total)
    return Fit(
        mixture, kept, shares, _collected(shares, explained.visits), _collected(shares, explained.seen),
        total, objective, score, objective - before, iterations, solver_iterations,
    )  # fmt: skip


def _m_step(
    program: MixtureProgram, kept: Kept, mixture: Mixture, mass: Float[Array, " D"], visits: Array
) -> tuple[Mixture, Int[Array, ""]]:
    """Proportions and rewards for the trajectories assigned to each way, kept ones included."""

    def reward(inputs: tuple) -> tuple:
        counts, *start = inputs
        solution = fit_counts(program.mdp, counts, program.l1, program.ridge, WarmStart(*start))
        return solution.weights, solution.values, solution.iterations

    fitted = lax.map(reward, (kept.visits + visits, mixture.weights, mixture.values))
    proportions = entropic_proportions(kept.mass + mass, program.strength)
    return Mixture(fitted[0], fitted[1], proportions), jnp.sum(fitted[2])


def climb(
    program: MixtureProgram,
    jumble: Jumble,
    kept: Kept,
    mixture: Mixture,
    responsibilities: Float[Array, "n D"],
    visits: Float[Array, "D S A"],
) -> Fit:
    """Alternate until ``J`` stands still, beginning with the M-step for these assignments."""

    def step(fit: Fit) -> Fit:
        mass = jnp.sum(fit.responsibilities, axis=0)
        new, solved = _m_step(program, kept, fit.mixture, mass, fit.visits)
        return _e_step(
            program, jumble, kept, new, fit.objective, fit.iterations + 1, fit.solver_iterations + solved
        )

    def unfinished(fit: Fit) -> Bool[Array, ""]:
        return (fit.gain > program.tolerance) & (fit.iterations < program.iterations)

    return lax.while_loop(unfinished, step, _start(program, jumble, kept, mixture, responsibilities, visits))


def _start(
    program: MixtureProgram,
    jumble: Jumble,
    kept: Kept,
    mixture: Mixture,
    responsibilities: Array,
    visits: Array,
) -> Fit:
    """A fit that is still to be made: assignments alone."""
    nowhere, zero = jnp.array(-jnp.inf), jnp.zeros((), int)
    unknown = jnp.zeros(jumble.live.shape)
    return Fit(
        mixture, kept, responsibilities, visits, visits, unknown, nowhere, nowhere, -nowhere, zero, zero
    )


# -- merging ------------------------------------------------------------------------------------------


def _merged(fit: Fit, a: Int[Array, ""], b: Int[Array, ""]) -> tuple[Kept, Array, Array]:
    """What is kept, the assignments and the visits when way ``b`` becomes part of way ``a``."""

    def pour(x: Array) -> Array:
        return x.at[a].add(x[b]).at[b].set(0.0)

    kept = Kept(pour(fit.kept.mass), pour(fit.kept.visits))
    return kept, pour(fit.responsibilities.T).T, pour(fit.visits)


def _best_possible(visits: Float[Array, "S A"]) -> Float[Array, ""]:
    """Log-likelihood of visits under the policy that fits them best, whatever its reward."""
    return jnp.sum(xlogy(visits, visits)) - jnp.sum(xlogy(visits.sum(1), visits.sum(1)))


def _merge_once(program: MixtureProgram, jumble: Jumble, fit: Fit) -> tuple[Array, Fit]:
    """The best of all mergers of two ways, refitted (one reward) but not climbed from; whether to take it.

    Ways whose greedy policies agree in every reachable state are one, whatever the score says.
    """
    mdp, ways = program.mdp, fit.mixture.proportions.shape[0]
    pairs = jnp.array([(a, b) for a in range(ways) for b in range(a + 1, ways)], int).reshape(-1, 2)
    weights, values, proportions = fit.mixture
    policies, _ = log_policies(mdp, weights, values)
    explained = explain_each(mdp, policies, jumble)
    greedy = lax.map(lambda w: jnp.argmax(hard_plan(mdp, reward_of(mdp, w)).optimal, axis=1), weights)
    own = jnp.sum((fit.kept.visits + fit.visits) * jnp.where(mdp.available, policies, 0.0), axis=(1, 2))

    class _Trial(NamedTuple):
        score: Array
        mixture: Mixture
        kept: Kept
        responsibilities: Array
        visits: Array

    def attempt(pair: Int[Array, " 2"]) -> _Trial:
        a, b = pair
        kept, shares, visits = _merged(fit, a, b)
        together = kept.visits[a] + visits[a]
        nothing = _Trial(jnp.array(-jnp.inf), fit.mixture, kept, shares, visits)

        def refit() -> _Trial:
            solution = fit_counts(mdp, together, program.l1, program.ridge, WarmStart(weights[a], values[a]))
            proportion = entropic_proportions(kept.mass + jnp.sum(shares, axis=0), program.strength)
            new = Mixture(
                weights.at[a].set(solution.weights).at[b].set(0.0),
                values.at[a].set(solution.values),
                proportion,
            )
            policy = soft_plan(mdp, reward_of(mdp, solution.weights), solution.values).log_policy
            changed = explain(mdp, policy, jumble)
            fresh, total = assign(
                explained.log_likelihood.at[a].set(changed.log_likelihood), proportion, jumble.live
            )
            _, score = _judge(program, kept, new, policies.at[a].set(policy), fresh, total)
            return _Trial(score, new, kept, shares, visits)

        alive = (proportions[a] > 0) & (proportions[b] > 0)
        same = jnp.all((greedy[a] == greedy[b]) | ~program.reachable)
        worth = alive
        if isinstance(jumble, SeenWhole):
            # No policy at all could explain both well enough: then no reward's policy does.
            mass = fit.kept.mass + jnp.sum(fit.responsibilities, axis=0)
            pair_mass = mass[a] + mass[b]
            saved = xlogy(pair_mass, pair_mass) - xlogy(mass[a], mass[a]) - xlogy(mass[b], mass[b])
            lost = own[a] + own[b] - _best_possible(together)
            spared = program.strength + _penalty(program, weights[a]) + _penalty(program, weights[b])
            worth &= same | (lost <= program.price * saved + spared)
        trial = lax.cond(worth, refit, lambda: nothing)
        return trial._replace(score=jnp.where(worth & same, jnp.inf, trial.score))

    trials = lax.map(attempt, pairs)
    best = jax.tree.map(lambda x: x[jnp.argmax(trials.score)], trials)
    merged = fit._replace(
        mixture=best.mixture, kept=best.kept, responsibilities=best.responsibilities, visits=best.visits
    )
    return best.score >= fit.score - program.tolerance, merged


def _penalty(program: MixtureProgram, weights: Float[Array, " K"]) -> Float[Array, ""]:
    return program.l1 * jnp.sum(jnp.abs(weights)) + program.ridge / 2 * jnp.sum(weights**2)


def settle(
    program: MixtureProgram,
    jumble: Jumble,
    kept: Kept,
    mixture: Mixture,
    responsibilities: Float[Array, "n D"],
    visits: Float[Array, "D S A"],
) -> Fit:
    """Climb; merge two ways and climb again, as long as that ranks higher."""
    if responsibilities.shape[1] == 1:
        return climb(program, jumble, kept, mixture, responsibilities, visits)

    def step(carry: tuple) -> tuple:
        before, _ = carry
        fit = climb(program, jumble, before.kept, before.mixture, before.responsibilities, before.visits)
        fit = fit._replace(
            iterations=before.iterations + fit.iterations,
            solver_iterations=before.solver_iterations + fit.solver_iterations,
        )
        better, merged = _merge_once(program, jumble, fit)
        return jax.tree.map(lambda x, y: jnp.where(better, x, y), merged, fit), better

    start = _start(program, jumble, kept, mixture, responsibilities, visits)
    return lax.while_loop(lambda carry: carry[1], step, (start, jnp.array(True)))[0]


# -- where to start -----------------------------------------------------------------------------------


def seed_ways(
    key: Array,
    points: Float[Array, "n K"],
    live: Bool[Array, " n"],
    centres: Float[Array, "D K"],
    mass: Float[Array, " D"],
) -> Float[Array, "n D"]:
    """Assign trajectories by their features to known ways and to new ones: k-means++, seeded at random.

    ``centres`` and ``mass`` describe the ways known so far; slots without mass are filled with trajectories
    drawn in proportion to their squared distance from what is there (Arthur and Vassilvitskii 2007).
    """
    ways = mass.shape[0]

    def distances(centres: Float[Array, "D K"], open_: Bool[Array, " D"]) -> Float[Array, "n D"]:
        squared = jnp.sum((points[:, None] - centres) ** 2, axis=-1)
        return jnp.where(open_, squared, jnp.inf)

    def fill(carry: tuple, inputs: tuple) -> tuple:
        centres, open_ = carry
        key, slot = inputs
        nearest = jnp.min(distances(centres, open_), axis=1)
        nearest = jnp.where(jnp.isfinite(nearest), nearest, 1.0)
        chosen = jax.random.categorical(key, jnp.where(live, jnp.log(nearest + 1e-12), -jnp.inf))
        taken = open_[slot]
        centres = centres.at[slot].set(jnp.where(taken, centres[slot], points[chosen]))
        return (centres, open_.at[slot].set(True)), None

    def assigned(centres: Float[Array, "D K"]) -> Float[Array, "n D"]:
        nearest = jnp.argmin(distances(centres, jnp.ones(ways, bool)), axis=1)
        return jax.nn.one_hot(nearest, ways) * live[:, None]

    def settle(_: int, means: Float[Array, "D K"]) -> Float[Array, "D K"]:
        shares = assigned(means)
        size = mass + jnp.sum(shares, axis=0)
        total = mass[:, None] * centres + shares.T @ points
        return jnp.where(size[:, None] > 0, total / jnp.maximum(size, 1e-300)[:, None], means)

    # Known ways come first, wherever their slots are: new ones are to be far from all of them.
    slots = (jax.random.split(key, ways), jnp.arange(ways))
    (filled, _), _ = lax.scan(fill, (centres, mass > 0), slots)
    return assigned(lax.fori_loop(0, 10, settle, filled))


def _seeded(
    program: MixtureProgram, jumble: Jumble, guess: Explained, kept: Kept, key: Array
) -> tuple[Float[Array, "n D"], Float[Array, "D S A"]]:
    """Assignments by features per step, as far as these are known before any reward is."""

    def per_step(visits: Float[Array, "... S A"]) -> Float[Array, "... K"]:
        steps = jnp.maximum(jnp.sum(visits, axis=(-2, -1)), 1e-300)
        return jnp.einsum("...sa,sak->...k", visits, program.mdp.features) / steps[..., None]

    shares = seed_ways(key, per_step(guess.visits), jumble.live, per_step(kept.visits), kept.mass)
    return shares, jnp.einsum("nd,nsa->dsa", shares, guess.visits)


class Search(NamedTuple):
    """The best fit, how many starts were tried, and the score each reached (``-inf`` where not tried)."""

    fit: Fit
    tried: Int[Array, ""]
    scores: Float[Array, " starts"]


def search(
    program: MixtureProgram, jumble: Jumble, kept: Kept, mixture: Mixture, key: Array, restarts: int
) -> Search:
    """Find ways of doing the task: from those known and, if some may be hidden, from ``restarts`` seedings.

    The first start opens no way but those of ``mixture``. Only if it leaves trajectories badly explained, or
    nothing is known yet, are the empty slots filled, ``restarts`` times over; the fit that ranks highest is
    returned.
    """
    known = jnp.any(kept.mass > 0)
    guess = without_reward(program.mdp, jumble)

    def by_known() -> tuple:
        nowhere, zero = jnp.array(-jnp.inf), jnp.zeros((), int)
        fit = _e_step(program, jumble, kept, mixture, nowhere, zero, zero)
        return fit.responsibilities, fit.visits

    def step(carry: tuple) -> tuple:
        number, best, scores, _ = carry
        first = (number == 0) & known
        shares, visits = lax.cond(
            first,
            by_known,
            lambda: _seeded(program, jumble, guess, kept, jax.random.fold_in(key, number)),
        )
        fit = settle(program, jumble, kept, mixture, shares, visits)
        best = jax.tree.map(lambda x, y: jnp.where(fit.score > best.score, x, y), fit, best)
        more = jnp.where(number == 0, ~known | may_hide_a_way(program, jumble, fit), True)
        return number + 1, best, scores.at[number].set(fit.score), more & (number < restarts)

    n_ways = mixture.proportions.shape[0]
    nobody = (jnp.zeros((*jumble.live.shape, n_ways)), jnp.zeros_like(kept.visits))
    none = _start(program, jumble, kept, mixture, *nobody)
    start = (jnp.zeros((), int), none, jnp.full(restarts + 1, -jnp.inf), jnp.array(True))
    tried, best, scores, _ = lax.while_loop(lambda carry: carry[3], step, start)
    return Search(best, tried, scores)


def may_hide_a_way(program: MixtureProgram, jumble: Jumble, fit: Fit) -> Bool[Array, ""]:
    """Whether trajectories are explained so badly that a new way, and an empty slot for it, could pay.

    At best a new way predicts every action of the trajectories that it takes over. If even that would not
    buy the information of who did what, for any number of the worst explained ones, nothing is hidden.
    """
    policies, _ = log_policies(program.mdp, fit.mixture.weights, fit.mixture.values)
    explained = explain_each(program.mdp, policies, jumble)
    surprise = -jnp.where(program.mdp.available, policies, 0.0)
    loss = jnp.einsum("nd,dnsa,dsa->n", fit.responsibilities, explained.visits, surprise)
    worst = jnp.argsort(-loss)
    shares = fit.responsibilities[worst]
    taken = jnp.cumsum(shares, axis=0)
    mass = fit.kept.mass + jnp.sum(shares, axis=0)
    left = jnp.maximum(mass - taken, 0.0)
    number = jnp.sum(taken, axis=1)
    total = jnp.maximum(jnp.sum(mass), 1e-300)
    undecided = jnp.cumsum(jnp.sum(xlogy(shares, shares), axis=1))
    price = jnp.sum(xlogy(mass, mass / total)) - jnp.sum(xlogy(left, left / total), axis=1)
    price = price - xlogy(number, number / total) - undecided
    pays = jnp.cumsum(loss[worst]) > program.price * price + program.tolerance
    return jnp.any(pays & (number > 0)) & jnp.any(fit.mixture.proportions == 0)
