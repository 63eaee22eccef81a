"""Quality of a learned reward (section 7.2), and uncertainty of the numbers.

A learned reward is judged by the behaviour it prescribes, under the expert's true reward: agreement with the
expert, and loss of value. Everything is exact: no simulation, no offset, no rescaling.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from ...inference.completion.smoothing import evidence_of, log_likelihoods
from ...models.inputs.text import shortened
from ...models.observation.demonstration import Demonstration
from ...models.observation.evidence import AnySensor, checked_demonstration, fitting_sensor
from ...models.process.mdp import TabularMDP
from ...models.process.planning import (
    deterministic_policy,
    hard_plan,
    policy_values,
    require_discounted,
    reward_of,
    soft_plan,
)

Judged = TypeVar("Judged")


class Accuracy(NamedTuple):
    """Learned behaviour accuracy (LBA): a share in [0, 1] of all states, and of the choice states.

    A *choice state* has more than one available action; elsewhere no error is possible. If every state is one
    (all patrol instances) the two shares are equal; without any, ``choice`` is NaN.
    """

    overall: Float[Array, ""]
    choice: Float[Array, ""]


class LearningError(NamedTuple):
    """Inverse learning error (ILE): ``||V* - V^pi||_1``, and its ratio to ``||V*||_1`` (NaN if that is 0)."""

    absolute: Float[Array, ""]
    relative: Float[Array, ""]


class Evaluation(NamedTuple):
    """All measures of a learned reward; ``value`` and ``best_value`` start from ``p0``."""

    accuracy: Accuracy
    error: LearningError
    value: Float[Array, ""]
    best_value: Float[Array, ""]


def greedy_policy(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    """Compute deterministic policy that is optimal for ``weights``; ties go to the first action of the MDP.

    Actions within 1e-9 of the best, relative to the spread of the values, count as tied. Raises
    ``ValueError`` for discount 1, weights of the wrong number, or weights that are not numbers.
    """
    return _greedy(mdp, _checked(mdp, weights))


def optimal_actions(mdp: TabularMDP, weights: Float[Array, " K"]) -> Bool[Array, "S A"]:
    """Find every action that is optimal for ``weights``; ties and errors as for :func:`greedy_policy`."""
    return _optimal(mdp, _checked(mdp, weights))


def policy_accuracy(
    mdp: TabularMDP, optimal: Bool[Array | np.ndarray, "S A"], policy: Float[Array | np.ndarray, "S A"]
) -> Accuracy:
    """Compute the probability that ``policy`` takes one of the ``optimal`` actions, averaged over states.

    For a deterministic policy this is LBA; pass a policy here to break its ties differently. Every optimal
    action counts as a match.

    See Also
    --------
    i2rl.analysis.learned_behavior_accuracy : the same of learned weights
    i2rl.analysis.evaluate : every measure at once

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from i2rl.analysis import policy_accuracy
    >>> from i2rl.domains import five_cells
    >>> mdp = five_cells().mdp
    >>> right, uniform = jnp.eye(3)[jnp.ones(5, int)], jnp.full((5, 3), 1 / 3)
    >>> [round(float(policy_accuracy(mdp, right > 0, policy).overall), 2) for policy in (right, uniform)]
    [1.0, 0.33]
    """
    hit = jnp.sum(jnp.where(optimal, policy, 0.0), axis=1)
    choice = jnp.sum(mdp.available, axis=1) > 1
    n = jnp.sum(choice)
    share = jnp.sum(jnp.where(choice, hit, 0.0)) / jnp.maximum(n, 1)
    return Accuracy(jnp.mean(hit), jnp.where(n > 0, share, jnp.nan))


def learned_behavior_accuracy(
    mdp: TabularMDP,
    true_weights: Float[Array | np.ndarray, " K"],
    learned_weights: Float[Array | np.ndarray, " K"],
) -> Accuracy:
    """Compute LBA: the share of states where the learned greedy action is one of the expert's optimal
    actions.

    The learner commits to one action per state, as in :func:`greedy_policy` (so a constant reward is not
    credited with every action); the expert's ties all count. Source: section 7.2. Errors as there.

    See Also
    --------
    i2rl.analysis.inverse_learning_error : what the errors cost
    i2rl.analysis.evaluate : both at once

    Examples
    --------
    >>> from i2rl.analysis import learned_behavior_accuracy
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> float(learned_behavior_accuracy(corridor.mdp, corridor.weights, corridor.weights / 2).overall)
    1.0
    >>> float(learned_behavior_accuracy(corridor.mdp, corridor.weights, [0.0, -1.0]).overall)
    0.2
    """
    return evaluate(mdp, true_weights, learned_weights).accuracy


def chance_accuracy(
    key: Array, mdp: TabularMDP, true_weights: Float[Array, " K"], draws: int = 200
) -> Float[np.ndarray, " draws"]:
    """Compute LBA of random weights, uniform on ``[-0.99, 0.99]^K``.

    An accuracy that many of them reach does not prove learning. Errors as for :func:`greedy_policy`.
    """
    drawn = jax.random.uniform(key, (draws, mdp.n_features), float, -0.99, 0.99)
    return np.asarray(behaviour_accuracies(mdp, optimal_actions(mdp, true_weights), drawn))


@jax.jit
def behaviour_accuracies(
    mdp: TabularMDP, optimal: Bool[Array, "S A"], weights: Float[Array, "N K"]
) -> Float[Array, " N"]:
    """Compute LBA of many weights, of features that need not be the true reward's; ``optimal`` is the
    expert's.
    """

    def accuracy(learned: Float[Array, " K"]) -> Float[Array, ""]:
        policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, learned)).optimal)
        return policy_accuracy(mdp, optimal, policy).overall

    # One after another: batched factorisations may wait for one another on a CPU with few threads.
    return lax.map(accuracy, weights)


def inverse_learning_error(
    mdp: TabularMDP,
    true_weights: Float[Array | np.ndarray, " K"],
    learned_weights: Float[Array | np.ndarray, " K"],
) -> LearningError:
    """Compute ILE of :func:`greedy_policy` of the learned weights, in units of discounted true reward.

    ``||V^{pi*} - V^{pi}||_1`` sums over states; both values are exact and under the true reward (chapter 3,
    section 7.2). Errors as for :func:`greedy_policy`.

    See Also
    --------
    i2rl.analysis.learned_behavior_accuracy : how often the behaviours agree
    i2rl.analysis.evaluate : both at once

    Examples
    --------
    >>> from i2rl.analysis import inverse_learning_error
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> round(float(inverse_learning_error(corridor.mdp, corridor.weights, corridor.weights / 2).relative), 2)
    0.0
    >>> round(float(inverse_learning_error(corridor.mdp, corridor.weights, [0.0, -1.0]).relative), 2)
    0.74
    """
    return evaluate(mdp, true_weights, learned_weights).error


def evaluate(
    mdp: TabularMDP,
    true_weights: Float[Array | np.ndarray, " K"],
    learned_weights: Float[Array | np.ndarray, "*n K"],
) -> Evaluation:
    """Compute all measures above for the cost of one of them.

    Many learned weights ``[..., K]`` are evaluated by one program, one after another; each measure then has
    their leading axes. Raises ``ValueError`` as :func:`greedy_policy` does.

    See Also
    --------
    i2rl.analysis.learned_behavior_accuracy : the accuracy alone
    i2rl.analysis.inverse_learning_error : the error alone
    i2rl.analysis.demonstration_log_likelihoods : judge without an expert

    Examples
    --------
    >>> from i2rl.analysis import evaluate
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> judged = evaluate(corridor.mdp, corridor.weights, [0.0, -1.0])
    >>> round(float(judged.accuracy.overall), 1), round(float(judged.error.relative), 2)
    (0.2, 0.74)
    >>> round(float(judged.value), 1), round(float(judged.best_value), 1)
    (0.0, 11.8)
    """
    return _evaluate(mdp, _checked(mdp, true_weights), _checked(mdp, learned_weights, many=True))


def demonstration_log_likelihoods(
    mdp: TabularMDP,
    sensor: AnySensor,
    weights: Float[Array | np.ndarray, "*m K"],
    demonstration: Demonstration,
) -> Float[Array, "*m n"]:
    """Compute the exact log-likelihood (nats) of each trajectory under the soft policy of ``weights``.

    Hidden steps are summed out (section 1 of the methods); ``-inf`` for a trajectory the model rules out.
    Many weights ``[..., K]`` are judged by one program; the trajectories are then the last axis. Errors as
    for :func:`greedy_policy`, and ``ValueError`` for a sensor made for another MDP.

    See Also
    --------
    i2rl.analysis.evaluate : judge by the expert's weights
    i2rl.inference.log_likelihoods : the same under any policy

    Examples
    --------
    >>> from i2rl.analysis import demonstration_log_likelihoods
    >>> from i2rl.domains import five_cells
    >>> mdp, weights, sensor, demonstration = five_cells()
    >>> expert = demonstration_log_likelihoods(mdp, sensor, weights, demonstration)
    >>> uniform = demonstration_log_likelihoods(mdp, sensor, 0 * weights, demonstration)
    >>> expert.shape, bool(expert.sum() > uniform.sum())
    ((8,), True)
    """
    # Padded to a power of two, so that demonstrations of many sizes share a compiled program.
    sensor, demonstration = fitting_sensor(sensor, mdp), checked_demonstration(mdp, demonstration)
    padded = demonstration.bucketed()
    each = _log_likelihoods(mdp, sensor, _checked(mdp, weights, many=True), padded)
    return each[..., : demonstration.n_trajectories]


def _checked(mdp: TabularMDP, given: Float[ArrayLike, "*n K"], *, many: bool = False) -> Float[Array, "*n K"]:
    require_discounted(mdp)
    weights = jnp.asarray(given, float)
    if (weights.shape[-1:] if many else weights.shape) != (mdp.n_features,):
        raise ValueError(f"weights must have shape [{mdp.n_features}], one a feature, got {weights.shape}")
    # A learner that failed must not be scored by whatever argmax makes of NaN.
    if not isinstance(weights, jax.core.Tracer) and not np.isfinite(weights).all():
        at = tuple(np.argwhere(~np.isfinite(weights))[0])
        raise ValueError(
            f"the weight of feature {shortened(mdp.feature_names[at[-1]])} is {weights[at]}, not a number"
        )
    return weights


def _of_each(judge: Callable[[Float[Array, " K"]], Judged], weights: Float[Array, "*n K"]) -> Judged:
    """Judge all weights one after another: as a batch they would leave the cache of the processor."""
    if weights.ndim == 1:
        return judge(weights)
    lead = weights.shape[:-1]
    judged = lax.map(judge, weights.reshape(-1, weights.shape[-1]))
    return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), judged)


@jax.jit
def _optimal(mdp: TabularMDP, weights: Float[Array, " K"]) -> Bool[Array, "S A"]:
    return hard_plan(mdp, reward_of(mdp, weights)).optimal


@jax.jit
def _greedy(mdp: TabularMDP, weights: Float[Array, " K"]) -> Float[Array, "S A"]:
    return deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)


@jax.jit
def _evaluate(
    mdp: TabularMDP, true_weights: Float[Array, " K"], learned_weights: Float[Array, "*n K"]
) -> Evaluation:
    reward = reward_of(mdp, true_weights)
    best = hard_plan(mdp, reward)

    def judge(weights: Float[Array, " K"]) -> Evaluation:
        policy = _greedy(mdp, weights)
        values = policy_values(mdp, policy, reward)
        return Evaluation(
            policy_accuracy(mdp, best.optimal, policy),
            _error(best.values, values),
            mdp.initial @ values,
            mdp.initial @ best.values,
        )

    return _of_each(judge, learned_weights)


def _error(best: Float[Array, " S"], values: Float[Array, " S"]) -> LearningError:
    loss, scale = jnp.sum(jnp.abs(best - values)), jnp.sum(jnp.abs(best))
    return LearningError(loss, jnp.where(scale > 0, loss / jnp.where(scale > 0, scale, 1.0), jnp.nan))


@jax.jit
def _log_likelihoods(
    mdp: TabularMDP, sensor: AnySensor, weights: Float[Array, "*m K"], demonstration: Demonstration
) -> Float[Array, "*m n"]:
    evidence = evidence_of(mdp, sensor, demonstration)

    def judge(weights: Float[Array, " K"]) -> Float[Array, " n"]:
        return log_likelihoods(mdp, soft_plan(mdp, reward_of(mdp, weights)).log_policy, evidence)

    return _of_each(judge, weights)


# -- how sure the numbers are -------------------------------------------------------------------------


class Band(NamedTuple):
    """Median and quantiles of replications."""

    low: Float[np.ndarray, " ..."]
    median: Float[np.ndarray, " ..."]
    high: Float[np.ndarray, " ..."]


def quantile_band(replications: Float[np.ndarray, "replications ..."], coverage: float = 0.5) -> Band:
    """Compute the median and central quantiles over the first axis; ``coverage`` 0.5 gives the quartiles.

    The band says where the middle ``coverage`` of the replications lie; it is not a confidence interval of
    the median. A NaN among the replications makes its column NaN rather than vanish. Raises ``ValueError``
    without replications or for a coverage outside (0, 1).

    See Also
    --------
    i2rl.analysis.learning_curves : draw such bands

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import quantile_band
    >>> band = quantile_band(np.array([[0.2, 0.6], [0.4, 0.8], [0.6, 1.0]]))
    >>> band.median.tolist()
    [0.4, 0.8]
    >>> band.low.round(2).tolist(), band.high.round(2).tolist()
    ([0.3, 0.7], [0.5, 0.9])
    """
    replications = np.asarray(replications, float)
    if replications.ndim < 1 or replications.shape[0] == 0:
        raise ValueError(
            f"a band needs at least one replication along the first axis; got shape {replications.shape}"
        )
    if not 0 < coverage < 1:
        raise ValueError(f"coverage must lie in (0, 1), got {coverage}")
    tail = (1 - coverage) / 2
    return Band(*np.quantile(replications, [tail, 0.5, 1 - tail], axis=0))
