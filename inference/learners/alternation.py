"""Parts of a session that alternates completion and program, shared by LME-I2RL and RIMEO."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...models.laws.chain import Smoothed
from ...models.observation.evidence import (
    AnySensor,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import SoftPlan, features_to_go, reward_of, soft_plan
from ..completion.smoothing import Evidence, blocked_posterior, gibbs_posterior, smooth_all
from ..programs.constraints import FeatureTarget
from ..programs.maximum_entropy import (
    LinearObjective,
    Solution,
    WarmStart,
    count_objective,
    exponentiate_scaled,
    fit_scaled_counts,
    solve_scaled_dual,
)
from ..sessions.schedule import Harmonic, Schedule, program_slack, require_slack
from ..sessions.statistic import STATISTICS, FeatureStatistic, Statistic, blend, complete

# Lemma 2 with eps_s = 0.05 and delta_s = 0.1 for six features (section 7.4.1).
DEFAULT_DRAWS = 957


class Alternation(NamedTuple):
    """Number and tolerance of a session's E- and M-steps, and the draws of an estimated E-step."""

    iterations: int = 10
    tolerance: float = 1e-3
    draws: int = DEFAULT_DRAWS


class AlternationOptions(TypedDict, total=False):
    """:class:`Alternation` as keyword arguments."""

    iterations: int
    tolerance: float
    draws: int


@dataclass(frozen=True)
class Completion:
    """An E-step, exact or estimated from ``draws``."""

    name: str
    draws: int

    def posterior(
        self, key: Array, mdp: TabularMDP, log_policy: Float[Array, "S A"], evidence: Evidence
    ) -> Smoothed:
        """Complete trajectories under a policy."""
        if self.name == "exact":
            return smooth_all(mdp, log_policy, evidence)
        return _SAMPLERS[self.name](key, mdp, log_policy, evidence, draws=self.draws)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Method:
    """Choices that all parts of a session share, an argument of compiled programs.

    Process, sensor, slack and ridge are data: learners that differ in their numbers alone share a program.
    Other schedules than :class:`~i2rl.inference.sessions.schedule.Harmonic`, and sensors that are not
    pytrees of arrays, are part of the program (``jax.tree_util.Partial``).
    """

    mdp: TabularMDP
    given_sensor: Any
    statistic: Statistic = field(metadata={"static": True})
    completion: Completion = field(metadata={"static": True})
    slack: Any
    ridge: Any

    @property
    def sensor(self) -> AnySensor:
        """The sensor as it was given."""
        given = self.given_sensor
        return given() if isinstance(given, jax.tree_util.Partial) else given

    def plan(self, weights: Float[Array, " K"], values: Float[Array, " S"]) -> SoftPlan:
        """Plan softly under weights, from earlier values."""
        return soft_plan(self.mdp, reward_of(self.mdp, weights), values)

    def e_step(self, key: Array, plan: SoftPlan, evidence: Evidence, seen: Bool[Array, "n L"]) -> Any:
        """Complete a session's trajectories under a plan."""
        posterior = self.completion.posterior(key, self.mdp, plan.log_policy, evidence)
        return complete(self.mdp, posterior, evidence.live, seen)

    def working(self, kept: Any, key: Array, plan: SoftPlan, evidence: Evidence, seen: Array) -> tuple:
        """Return the statistic for the M-step, and the session's exact log-likelihood under ``plan``.

        The statistic adds the current session, completed under ``plan``, to the carried one.
        """
        completed = self.e_step(key, plan, evidence, seen)
        working = blend(kept, self.statistic.of_session(self.mdp, plan, completed))
        return working, jnp.sum(completed.expectations.log_likelihood)

    def gradient(self, plan: SoftPlan, working: Any) -> Array:
        """Return the norm of the log-likelihood's gradient.

        With the ``features`` statistic it is ``|phi_hat - E[phi]|``.
        """
        if isinstance(working, FeatureStatistic):
            objective = LinearObjective(working.start, working.features)
        else:
            objective = count_objective(self.mdp, working.counts)
        # The values' own gradient is what their policy collects.
        expected = objective.state_weights @ features_to_go(self.mdp, plan.policy)
        return jnp.linalg.norm(objective.features - expected)

    def penalties(self, statistic: Any, session: Int[Array, ""]) -> tuple:
        """Return the slack of the program in a session, and the prior's precision per trajectory."""
        slack = program_slack(self.slack, session, self.statistic.slack(self.mdp, 1.0))
        return slack, self.ridge / jnp.maximum(statistic.size, 1.0)


_SAMPLERS: dict[str, Callable[..., Smoothed]] = {"blocked": blocked_posterior, "gibbs": gibbs_posterior}


def _as_data(given: Any) -> Any:
    """Return a pytree whose leaves are arrays; for any other object a static function that returns it."""
    plain = int | float | np.ndarray | jax.Array
    if all(isinstance(leaf, plain) for leaf in jax.tree.leaves(given)):
        return jax.tree.map(jnp.asarray, given)
    return jax.tree_util.Partial(lambda: given)


def checked_method(
    mdp: TabularMDP,
    sensor: AnySensor,
    statistic: str,
    completion: str,
    slack: Schedule,
    ridge: float,
    draws: int,
) -> Method:
    """Check the choices of a method, and gather them."""
    if statistic not in STATISTICS:
        raise ValueError(f"statistic must be one of {', '.join(STATISTICS)}, got {statistic!r}")
    if completion != "exact" and completion not in _SAMPLERS:
        raise ValueError(f"completion must be exact, blocked or gibbs, got {completion!r}")
    if completion != "exact" and draws < 1:
        raise ValueError(f"a sampled completion needs at least one draw, got {draws}")
    require_slack(slack)
    if not ridge >= 0:
        raise ValueError(f"ridge must not be negative, got {ridge}")

    if callable(slack) and not isinstance(slack, Harmonic):
        # The bound call, since it is compared by identity: schedules may be equal tuples, or have no hash.
        schedule: Any = slack
        slack = jax.tree_util.Partial(schedule.__call__)
    return Method(
        mdp,
        _as_data(sensor),
        STATISTICS[statistic],
        Completion(completion, draws if completion != "exact" else 0),
        slack,
        ridge,
    )


def random_weights(key: Array, mdp: TabularMDP) -> Float[Array, " K"]:
    """Draw ``theta^0_k ~ uniform(0, 1)``, scaled (Algorithm 1, line 2)."""
    return jax.random.uniform(key, (mdp.n_features,), float)


def newton(mdp: TabularMDP, statistic: Any, slack: Array, ridge: Array, start: WarmStart) -> Solution:
    """Solve the program of a statistic by Newton's method."""
    if isinstance(statistic, FeatureStatistic):
        target = FeatureTarget(statistic.features, statistic.start)
        return solve_scaled_dual(mdp, target, slack, ridge, start)
    return fit_scaled_counts(mdp, statistic.counts, slack, ridge, start)


def exponentiated(mdp: TabularMDP, statistic: Any, slack: Array, ridge: Array, start: WarmStart) -> Solution:
    """Solve the program of features by exponentiated gradient, as Algorithm 1 prints it."""
    del ridge  # the printed update has no prior
    target = FeatureTarget(statistic.features, statistic.start)
    return exponentiate_scaled(mdp, target, slack * (1 - mdp.discount), start=start.weights)


def relative_change(old: Float[Array, " K"], new: Float[Array, " K"]) -> Float[Array, ""]:
    """Return the largest change of a weight, relative to the largest weight."""
    return jnp.max(jnp.abs(new - old)) / (1e-3 + jnp.max(jnp.abs(new)))
