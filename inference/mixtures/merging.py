"""The number of components: merging components, and the starts of their search.

The climb of :mod:`~i2rl.inference.mixtures.fit` starts from more components than needed, and two are merged
as long as the score gains by it: ``J`` less Laplace's estimate of each reward's cost,
``log det(1 + F_d / ridge) / 2`` (``F_d``: information about ``theta_d`` in the visits of component ``d``).
Without that cost, stochastic experts are split by their chance choices.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import xlogy
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.process.planning import hard_plan, reward_of, soft_plan
from ..completion.explanations import (
    Explained,
    SeenWhole,
    Trajectories,
    explain,
    explain_each,
    without_reward,
)
from ..programs.maximum_entropy import WarmStart, count_information, fit_scaled_counts
from .fit import (
    Fit,
    Kept,
    Mixture,
    MixtureProgram,
    assign,
    climb,
    e_step,
    log_policies,
    objective_of,
    penalty,
    proportions_of,
    unmade,
)

# Without a prior on the rewards the estimate would reject every reward.
_LEAST_PRECISION = 1e-3
# Nats that starts are climbed to before the best of them is chosen.
_LOOSE = 1e-2


# -- merging ------------------------------------------------------------------------------------------


def _complexity(
    program: MixtureProgram, mixture: Mixture, visits: Float[Array, "D S A"]
) -> Float[Array, " D"]:
    """Return each reward's cost besides its penalty, by Laplace's approximation of its evidence, in nats."""

    def one(inputs: tuple) -> Float[Array, ""]:
        weights, values, proportion, counts = inputs
        return jnp.where(proportion > 0, _occam(program, weights, values, counts), 0.0)

    return lax.map(one, (*mixture, visits))


def _occam(
    program: MixtureProgram, weights: Float[Array, " K"], values: Float[Array, " S"], visits: Array
) -> Float[Array, ""]:
    information = count_information(program.mdp, visits, weights, values)
    # A Laplace prior counts as the Gaussian of the same variance.
    precision = jnp.maximum(program.ridge + program.slack**2 / 2, _LEAST_PRECISION)
    return 0.5 * jnp.linalg.slogdet(jnp.eye(len(weights)) + information / precision)[1]


def _merged(fit: Fit, a: Int[Array, ""], b: Int[Array, ""]) -> tuple[Kept, Array, Array]:
    """Merge component ``b`` into component ``a``: return statistic, assignments and visits."""

    def pour(x: Array) -> Array:
        return x.at[a].add(x[b]).at[b].set(0.0)

    kept = Kept(pour(fit.kept.mass), pour(fit.kept.visits))
    return kept, pour(fit.responsibilities.T).T, pour(fit.visits)


def _best_possible(visits: Float[Array, "S A"]) -> Float[Array, ""]:
    """Return the log-likelihood of visits under the policy that fits them best, whatever its reward."""
    return jnp.sum(xlogy(visits, visits)) - jnp.sum(xlogy(visits.sum(1), visits.sum(1)))


def merge_once(program: MixtureProgram, trajectories: Trajectories, fit: Fit) -> tuple[Array, Fit, Array]:
    """Return the best merger of two components, refitted (one reward) but not climbed from, and its verdict.

    Components whose greedy policies agree in every reachable state are merged, whatever the score.
    """
    mdp, n_components = program.mdp, fit.mixture.proportions.shape[0]
    pairs = jnp.array([(a, b) for a in range(n_components) for b in range(a + 1, n_components)], int).reshape(
        -1, 2
    )
    weights, values, proportions = fit.mixture
    policies, _ = log_policies(mdp, weights, values)
    explained = explain_each(mdp, policies, trajectories, proportions > 0)
    greedy = lax.map(lambda w: jnp.argmax(hard_plan(mdp, reward_of(mdp, w)).optimal, axis=1), weights)
    complexity = _complexity(program, fit.mixture, fit.kept.visits + fit.visits)
    score = fit.objective - jnp.sum(complexity)
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
            start = WarmStart(weights[a], values[a])
            solution = fit_scaled_counts(mdp, together, program.slack, program.ridge, start)
            proportion = proportions_of(program, kept.mass + jnp.sum(shares, axis=0))
            new = Mixture(
                weights.at[a].set(solution.weights).at[b].set(0.0),
                values.at[a].set(solution.values),
                proportion,
            )
            policy = soft_plan(mdp, reward_of(mdp, solution.weights), solution.values).log_policy
            changed = explain(mdp, policy, trajectories)
            likely = explained.log_likelihood.at[a].set(changed.log_likelihood)
            fresh = assign(likely, proportion, trajectories.live, program.temperature)
            objective = objective_of(program, kept, new, policies.at[a].set(policy), fresh)
            costs = complexity.at[a].set(_occam(program, solution.weights, solution.values, together))
            return _Trial(objective - jnp.sum(costs.at[b].set(0.0)), new, kept, shares, visits)

        alive = (proportions[a] > 0) & (proportions[b] > 0)
        same = jnp.all((greedy[a] == greedy[b]) | ~program.reachable)
        worth = alive
        if isinstance(trajectories, SeenWhole):
            # If the best of all policies fits both badly, every reward's policy does.
            mass = fit.kept.mass + jnp.sum(fit.responsibilities, axis=0)
            pair_mass = mass[a] + mass[b]
            saved = xlogy(pair_mass, pair_mass) - xlogy(mass[a], mass[a]) - xlogy(mass[b], mass[b])
            lost = own[a] + own[b] - _best_possible(together)
            spared = program.temperature * program.strength + complexity[a] + complexity[b]
            spared += penalty(program, weights[a]) + penalty(program, weights[b])
            worth &= same | (lost <= program.temperature * saved + spared)
        trial = lax.cond(worth, refit, lambda: nothing)
        return trial._replace(score=jnp.where(worth & same, jnp.inf, trial.score))

    trials = lax.map(attempt, pairs)
    best = jax.tree.map(lambda x: x[jnp.argmax(trials.score)], trials)
    merged = fit._replace(
        mixture=best.mixture, kept=best.kept, responsibilities=best.responsibilities, visits=best.visits
    )
    # If a trajectory is impossible under all components, all scores are equal.
    return jnp.isfinite(score) & (best.score >= score - program.tolerance), merged, score


def settle(program: MixtureProgram, trajectories: Trajectories, start: Fit) -> Fit:
    """Climb; merge two components and climb again, as long as that gains."""

    def step(carry: tuple) -> tuple:
        before, _ = carry
        fit = climb(
            program, trajectories, before.kept, before.mixture, before.responsibilities, before.visits
        )
        fit = fit._replace(
            iterations=before.iterations + fit.iterations,
            solver_iterations=before.solver_iterations + fit.solver_iterations,
        )
        if start.mixture.proportions.shape[0] == 1:
            complexity = _complexity(program, fit.mixture, fit.kept.visits + fit.visits)
            return fit._replace(score=fit.objective - jnp.sum(complexity)), jnp.array(False)
        better, merged, score = merge_once(program, trajectories, fit)
        fit = fit._replace(score=score)
        return jax.tree.map(lambda x, y: jnp.where(better, x, y), merged, fit), better

    return lax.while_loop(lambda carry: carry[1], step, (start, jnp.array(True)))[0]


# -- starts ---------------------------------------------------------------------------------------------


def seed_components(
    key: Array,
    points: Float[Array, "n K"],
    live: Bool[Array, " n"],
    centres: Float[Array, "D K"],
    mass: Float[Array, " D"],
) -> Float[Array, "n D"]:
    """Assign trajectories by their features to known components and to new ones: k-means++, seeded at random.

    ``centres`` and ``mass`` describe the known components; slots without mass are filled with trajectories
    drawn in proportion to their squared distance from the known centres (Arthur and Vassilvitskii 2007).
    """
    n_components = mass.shape[0]

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
        nearest = jnp.argmin(distances(centres, jnp.ones(n_components, bool)), axis=1)
        return jax.nn.one_hot(nearest, n_components) * live[:, None]

    def settle(_: int, means: Float[Array, "D K"]) -> Float[Array, "D K"]:
        shares = assigned(means)
        size = mass + jnp.sum(shares, axis=0)
        total = mass[:, None] * centres + shares.T @ points
        return jnp.where(size[:, None] > 0, total / jnp.maximum(size, 1e-300)[:, None], means)

    # Known components come first, whatever their slots: new ones are to be far from all of them.
    slots = (jax.random.split(key, n_components), jnp.arange(n_components))
    (filled, _), _ = lax.scan(fill, (centres, mass > 0), slots)
    return assigned(lax.fori_loop(0, 10, settle, filled))


def _seeded(
    program: MixtureProgram, trajectories: Trajectories, guess: Explained, kept: Kept, key: Array
) -> tuple[Float[Array, "n D"], Float[Array, "D S A"]]:
    """Assign by features per step, as far as these are known before any reward is."""

    def per_step(visits: Float[Array, "... S A"]) -> Float[Array, "... K"]:
        steps = jnp.maximum(jnp.sum(visits, axis=(-2, -1)), 1e-300)
        return jnp.einsum("...sa,sak->...k", visits, program.mdp.features) / steps[..., None]

    shares = seed_components(key, per_step(guess.visits), trajectories.live, per_step(kept.visits), kept.mass)
    return shares, jnp.einsum("nd,nsa->dsa", shares, guess.visits)


@shown_briefly
class Search(NamedTuple):
    """Best fit of a search, and the number of its starts."""

    fit: Fit
    tried: Int[Array, ""]


def search(
    program: MixtureProgram,
    trajectories: Trajectories,
    kept: Kept,
    mixture: Mixture,
    key: Array,
    restarts: Array | int,
) -> Search:
    """Find components: from those known and, if some may be hidden, from ``restarts`` seedings.

    The first start uses only the components of ``mixture``. If these explain trajectories badly, or there
    are none yet, the empty slots are filled, ``restarts`` times over; the best fit is returned.
    """
    known = jnp.any(kept.mass > 0)
    guess = without_reward(program.mdp, trajectories)

    nowhere, zero = jnp.array(-jnp.inf), jnp.zeros((), int)
    expected = e_step(program, trajectories, kept, mixture, nowhere, zero, zero)
    suspicious = ~known | may_hide_a_component(program, trajectories, expected)

    def step(carry: tuple) -> tuple:
        number, best, last, _ = carry
        shares, visits = lax.cond(
            (number == 0) & known,
            lambda: (expected.responsibilities, expected.visits),
            lambda: _seeded(program, trajectories, guess, kept, jax.random.fold_in(key, number)),
        )
        fresh = unmade(program, trajectories, kept, mixture, shares, visits)
        # The last of several iterations continues the best of the others until convergence.
        start = jax.tree.map(lambda x, y: jnp.where(last & suspicious, x, y), best, fresh)
        tolerance = jnp.where(last, program.tolerance, jnp.maximum(program.tolerance, _LOOSE))
        fit = settle(program._replace(tolerance=tolerance), trajectories, start)
        best = jax.tree.map(lambda x, y: jnp.where(last | (fit.score > best.score), x, y), fit, best)
        # Without an empty slot there is no component to seed.
        more = suspicious & ((number > 0) | ~known | jnp.any(fit.mixture.proportions == 0))
        tried = number + ~(last & suspicious)
        return tried, best, ~(more & (tried < restarts + known)), last

    n_components = mixture.proportions.shape[0]
    nobody = (jnp.zeros((*trajectories.live.shape, n_components)), jnp.zeros_like(kept.visits))
    none = unmade(program, trajectories, kept, mixture, *nobody)
    begin = (jnp.zeros((), int), none, ~suspicious, jnp.array(False))
    tried, best, _, _ = lax.while_loop(lambda carry: ~carry[3], step, begin)
    return Search(best, tried)


def may_hide_a_component(
    program: MixtureProgram, trajectories: Trajectories, expected: Fit
) -> Bool[Array, ""]:
    """Return whether known components explain trajectories so badly that a new one could pay.

    At best a new component predicts every action of the trajectories that it takes over; the earlier
    statistic is already explained as well as possible. If even then the new component would not pay for the
    information of its assignments, for any number of the worst explained trajectories, the result is False.
    (Hidden actions count as the known components predict them: a component that differs only in hidden states
    is not found.)
    """
    policies, _ = log_policies(program.mdp, expected.mixture.weights, expected.mixture.values)
    explained = explain_each(program.mdp, policies, trajectories, expected.mixture.proportions > 0)
    surprise = -jnp.where(program.mdp.available, policies, 0.0)
    loss = jnp.einsum("nd,dnsa,dsa->n", expected.responsibilities, explained.visits, surprise)
    worst = jnp.argsort(-loss)
    shares = expected.responsibilities[worst]
    taken = jnp.cumsum(shares, axis=0)
    mass = expected.kept.mass + jnp.sum(shares, axis=0)
    left = jnp.maximum(mass - taken, 0.0)
    number = jnp.sum(taken, axis=1)
    total = jnp.maximum(jnp.sum(mass), 1e-300)
    undecided = jnp.cumsum(jnp.sum(xlogy(shares, shares), axis=1))
    information = jnp.sum(xlogy(mass, mass / total)) - jnp.sum(xlogy(left, left / total), axis=1)
    information = information - xlogy(number, number / total) - undecided
    pays = jnp.cumsum(loss[worst]) > program.temperature * information + program.tolerance
    return jnp.any(pays & (number > 0))
