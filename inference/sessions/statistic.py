"""Sufficient statistics: the summary of all past demonstrations in an online learner (Definition 7).

Three are offered, running averages over trajectories as in Eq. 4.2. They differ in the treatment of *hidden*
steps, and therefore in the later weight of early, poor completions:

``features``
    Discounted feature expectations of the completed, infinitely continued trajectories, the
    dissertation's. For short fragments most of it is the completed tail.
``counts``
    Expected visits ``N(s, a)`` of all steps. There is no tail, but hidden steps are completed once for good.
``seen``
    Expected visits of the seen steps. Given the state, visibility does not depend on the action, so the
    conditional likelihood of the seen actions is a proper (composite) likelihood. The hidden steps of the
    current session count in full through its exact likelihood, and are then dropped. With full visibility it
    equals ``counts``. A noisy or partial observation enters by its posterior under the weights of its
    session.

Where steps are read in part or wrongly, all three keep what early weights made of them.
:mod:`~i2rl.inference.sessions.kept_likelihood` keeps the likelihood instead.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...models.inputs.display import shown_briefly
from ...models.laws.chain import Smoothed
from ...models.process.mdp import TabularMDP
from ...models.process.planning import SoftPlan, action_values, features_to_go, reward_of
from ..completion.smoothing import Expectations, collect


@shown_briefly
class FeatureStatistic(NamedTuple):
    """``(n, phi_hat, start)``: trajectories, mean discounted features ``[K]``, start distribution ``[S]``."""

    size: Float[Array, ""]
    features: Float[Array, " K"]
    start: Float[Array, " S"]


@shown_briefly
class CountStatistic(NamedTuple):
    """``(n, N)``: trajectories, and mean expected visits per trajectory ``[S, A]``."""

    size: Float[Array, ""]
    counts: Float[Array, "S A"]


@shown_briefly
class Completed(NamedTuple):
    """One session's demonstration completed under the current policy."""

    expectations: Expectations
    seen: Float[Array, "S A"]


def complete(
    mdp: TabularMDP, posterior: Smoothed, live: Bool[Array, "n L"], seen: Bool[Array, "n L"]
) -> Completed:
    """Collect the data of the statistics from the posterior over a session's pairs."""
    return Completed(
        collect(mdp, posterior, live), jnp.einsum("nlsa,nl->sa", posterior.pairs, seen.astype(float))
    )


def blend(kept: Any, new: Any, forgetting: float = 1.0) -> Any:
    """Average two statistics of one type, weighted by their sizes (Eq. 4.2).

    ``forgetting`` is the exponent of the new one's share. At 1 all sessions count alike; below, completions
    under early weights are slowly forgotten, as stochastic-approximation EM requires (Cappe and
    Moulines 2009: between 1/2 and 1).
    """
    total = kept.size + new.size
    share = jnp.where(total > 0, new.size / jnp.where(total > 0, total, 1.0), 0.0) ** forgetting
    merged = [(1 - share) * a + share * b for a, b in zip(kept[1:], new[1:], strict=True)]
    return type(kept)(total, *merged)


class Statistic(Protocol):
    """Summary of sessions in a learner, and the fit of weights to it."""

    name: str

    def empty(self, mdp: TabularMDP) -> Any:
        """Return the statistic before the first session."""

    def of_session(self, mdp: TabularMDP, plan: SoftPlan, completed: Completed) -> Any:
        """Summarise the current session, under the policy that completed it."""

    def to_keep(self, mdp: TabularMDP, plan: SoftPlan, completed: Completed) -> Any:
        """Summarise a session after its end."""

    def slack(self, mdp: TabularMDP, epsilon: Any) -> Any:
        """Return the program's slack ``beta`` for a relaxation ``epsilon``."""

    def log_likelihood(
        self, mdp: TabularMDP, weights: Float[Array, " K"], values: Float[Array, " S"], kept: Any
    ) -> Float[Array, ""]:
        """Return the statistic's mean log-likelihood per trajectory, given weights and their soft values."""


class _Features:
    name = "features"

    def empty(self, mdp: TabularMDP) -> FeatureStatistic:
        return FeatureStatistic(jnp.zeros(()), jnp.zeros(mdp.n_features), jnp.zeros(mdp.n_states))

    def of_session(self, mdp: TabularMDP, plan: SoftPlan, completed: Completed) -> FeatureStatistic:
        # A fragment is a window on a task that goes on: its unseen future is hidden data too.
        e = completed.expectations
        features = e.features + e.tail @ features_to_go(mdp, plan.policy)
        return FeatureStatistic(e.size, _mean(features, e.size), _mean(e.start, e.size))

    to_keep = of_session

    def slack(self, mdp: TabularMDP, epsilon: Any) -> Any:
        """Return ``beta = epsilon / (1 - gamma)``, the relaxed constraint of Theorem 1."""
        return epsilon / (1 - mdp.discount)

    def log_likelihood(self, mdp: TabularMDP, weights: Array, values: Array, kept: FeatureStatistic) -> Array:
        """Return ``sum_t gamma^t log pi(a_t | s_t)`` of the continued trajectories.

        It telescopes to this in expectation over the dynamics.
        """
        return weights @ kept.features - kept.start @ values


class _Counts:
    name = "counts"

    def empty(self, mdp: TabularMDP) -> CountStatistic:
        return CountStatistic(jnp.zeros(()), jnp.zeros((mdp.n_states, mdp.n_actions)))

    def of_session(self, mdp: TabularMDP, plan: SoftPlan, completed: Completed) -> CountStatistic:
        e = completed.expectations
        return CountStatistic(e.size, _mean(e.counts, e.size))

    to_keep = of_session

    def slack(self, mdp: TabularMDP, epsilon: Any) -> Any:
        """Return ``epsilon`` itself, in nats per trajectory and unit of weight."""
        return epsilon

    def log_likelihood(self, mdp: TabularMDP, weights: Array, values: Array, kept: CountStatistic) -> Array:
        """Return ``sum N log pi`` over the visits."""
        log_policy = action_values(mdp, reward_of(mdp, weights), values) - values[:, None]
        return jnp.sum(kept.counts * jnp.where(mdp.available, log_policy, 0.0))


class _Seen(_Counts):
    name = "seen"

    def to_keep(self, mdp: TabularMDP, plan: SoftPlan, completed: Completed) -> CountStatistic:
        size = completed.expectations.size
        return CountStatistic(size, _mean(completed.seen, size))


def _mean(total: Array, size: Array) -> Array:
    return total / jnp.maximum(size, 1.0)


FEATURES: Statistic = _Features()
COUNTS: Statistic = _Counts()
SEEN: Statistic = _Seen()
STATISTICS: dict[str, Statistic] = {s.name: s for s in (SEEN, COUNTS, FEATURES)}
