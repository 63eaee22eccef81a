"""The incremental method of Jin et al. (2011) as an online learner: a reward corrected by every mistake.

A session is one state-action pair (section 3.2). Solve the MDP with the reward so far; if the expert's action
differs from the predicted optimal one, move the reward towards making it right,
``R^i = R^{i-1} + alpha v_i``. Sessions carry the reward alone: the method has no sufficient statistic (Table
8.1).

The dissertation calls ``v_i`` "the difference in the expected value of the observed action and the
(predicted) optimal action". Added to a reward it must be a vector. Here it is the gradient of that difference
in the reward, ``v_i = d/dR [Q(s, a) - Q(s, a*)]`` under the predicted policy: the difference between the
expected discounted visits after the one and after the other. The difference of values itself is ``v_i . R``
(values are linear in the reward), and the correction is the mistake-driven step of a perceptron, the subject
of the paper's bound on the number of mistakes.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import SEEN, UNKNOWN, Demonstration, DemonstrationError
from ...models.observation.evidence import checked_demonstration
from ...models.process.mdp import Labels, TabularMDP
from ...models.process.planning import (
    deterministic_policy,
    hard_plan,
    occupancy,
    require_discounted,
    reward_of,
)
from ..sessions.learner import Learner, SessionInfo
from ..sessions.scaling import on_scaled_features


@shown_briefly
class JinState(NamedTuple):
    """State of the method: ``weights [K]``, the reward; an empty statistic; number of sessions so far."""

    weights: Float[Array, " K"]
    statistic: tuple[()]
    session: Int[Array, ""]


@shown_briefly
class Correction(NamedTuple):
    """Correction of a reward by a pair: ``direction [K]`` (``v_i``), and a flag of a wrong prediction."""

    direction: Float[Array, " K"]
    mistaken: Bool[Array, ""]


def with_state_features(mdp: TabularMDP) -> TabularMDP:
    """Replace the features by one indicator per state: weights are then a reward table ``R [S]``.

    Every tool that takes an MDP and weights thereby works on reward tables. Such a table cannot express a
    reward of actions, such as a cost of turning.
    """
    indicators = jnp.eye(mdp.n_states)[:, None, :] * mdp.available[:, :, None]
    labels = Labels(mdp.labels.states, mdp.labels.actions, mdp.state_names)
    return replace(mdp, features=indicators, labels=labels)


def reward_correction(
    mdp: TabularMDP, weights: Float[Array, " K"], state: Int[Array, ""], action: Int[Array, ""]
) -> Correction:
    """Return ``v_i`` of one observed pair: the gradient of its action's value minus the predicted one's.

    ``direction = phi(s, a) - phi(s, a*) + gamma (P(.|s, a) - P(.|s, a*)) . mu``, with ``mu`` the expected
    discounted features under the optimal policy for ``weights`` (its first optimal action in every state).
    The result is zero if the observed action is the predicted one.
    """
    policy = deterministic_policy(hard_plan(mdp, reward_of(mdp, weights)).optimal)
    predicted = jnp.argmax(policy[state])
    # Occupancy is linear in its first distribution: one solve gives the difference of both expectations.
    apart = (
        jnp.zeros(mdp.n_states)
        .at[mdp.successors[state, action]]
        .add(mdp.probabilities[state, action])
        .at[mdp.successors[state, predicted]]
        .add(-mdp.probabilities[state, predicted])
    )
    later = jnp.einsum("sa,sak->k", occupancy(mdp, policy, apart), mdp.features)
    now = mdp.features[state, action] - mdp.features[state, predicted]
    return Correction(now + mdp.discount * later, predicted != action)


def jin_i2rl(mdp: TabularMDP, *, learning_rate: float = 1.0) -> Learner[JinState, SessionInfo]:
    """Build Jin et al.'s online IRL: a reward table over states, corrected by each wrong prediction.

    A session of one pair is the method's own (section 3.2); a demonstration of several steps is processed
    pair by pair, with the same result as a session each. Partly hidden steps are skipped: the method assumes
    full observability. The reward starts at ``1 / sqrt(S)`` in every state, where all actions have one value.
    The prediction is therefore *one* optimal action, the first of the MDP, and any other is a mistake: if
    ties counted as right, the first reward would never change.

    ``learner.mdp`` is :func:`with_state_features` of ``mdp``, of which ``weights`` are the reward table.
    ``alpha`` only scales that table: corrections sum to zero and depend on the policy alone, and neither a
    constant nor the scale changes a policy. All learning rates are equivalent (up to the tolerance of ties).

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process, discount below 1.
    learning_rate : float
        ``alpha > 0``.

    Returns
    -------
    Learner
        In its info ``iterations`` is the number of pairs, ``solver_iterations`` that of mistakes, and
        ``gradient`` is ``|sum v_i|``; likelihoods are NaN, as the method has no probabilities. Its ``update``
        raises :class:`DemonstrationError` naming trajectory and step for an unavailable action; in a fleet
        such a session changes nothing and its log-likelihood is minus infinity.

    Raises
    ------
    ValueError
        For discount 1 or a learning rate that is not positive.

    See Also
    --------
    i2rl.inference.darko_i2rl : another learner of pairs that are seen
    i2rl.inference.run_sessions : runs the sessions of a stream

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import jin_i2rl
    >>> from i2rl.models import Demonstration
    >>> learner = jin_i2rl(five_cells().mdp)
    >>> walk = Demonstration.from_pairs([[0, 1, 2, 3, 4, 4]], [[1, 1, 1, 1, 2, 2]])
    >>> state, info = learner.update(learner.init(jax.random.key(0)), walk)
    >>> state.weights.shape, info.iterations  # a reward for each cell; pairs
    ((5,), 6)
    """
    return _learner("Jin et al.", with_state_features(mdp), learning_rate)


def jin_i2rl_with_features(mdp: TabularMDP, *, learning_rate: float = 0.3) -> Learner[JinState, SessionInfo]:
    """Build the same corrections on the weights of ``mdp``'s own features; see :func:`jin_i2rl`.

    It is a control: the method's result if it has the domain's features, as the others do. Scaled weights
    (:mod:`~i2rl.models.process.units`) start at ``1 / sqrt(K)``, and corrections are of them, so the learning
    rate matters here; the default is the best of ``i2rl run methods`` on the second patrol.
    """
    return on_scaled_features(mdp, lambda scaled: _learner("Jin et al. with features", scaled, learning_rate))


def _learner(name: str, mdp: TabularMDP, learning_rate: float) -> Learner[JinState, SessionInfo]:
    require_discounted(mdp)
    if not 0 < learning_rate < math.inf:
        raise ValueError(f"the learning rate must be a positive number, got {learning_rate}")
    step_size = jnp.asarray(learning_rate, float)

    def init(key: Array) -> JinState:
        as_key(key)  # unused: the first reward is fixed
        size = mdp.n_features
        return JinState(jnp.full(size, 1 / math.sqrt(size)), (), jnp.zeros((), int))

    def session(state: JinState, demonstration: Demonstration) -> tuple[JinState, SessionInfo]:
        return _session(mdp, step_size, state, demonstration)

    def update(state: JinState, demonstration: Demonstration) -> tuple[JinState, SessionInfo]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration)
        _require_available(mdp, demonstration)
        new, info = session(state, demonstration.bucketed())
        return new, info.in_plain_numbers(time.perf_counter() - began)

    return Learner(name, mdp, {"learning_rate": learning_rate}, init, update, session)


@jax.jit
def _session(
    mdp: TabularMDP, step_size: Float[Array, ""], state: JinState, demonstration: Demonstration
) -> tuple[JinState, SessionInfo]:
    kind, states, actions = (jnp.asarray(x).reshape(-1) for x in demonstration.arrays[:3])
    full = (kind == SEEN) & (states != UNKNOWN) & (actions != UNKNOWN)
    in_range = (states >= 0) & (states < mdp.n_states) & (actions >= 0) & (actions < mdp.n_actions)

    def look(carry: tuple, pair: tuple) -> tuple:
        s, a, usable = pair

        def learn() -> tuple:
            weights, mistakes = carry
            found = reward_correction(mdp, weights, s, a)
            step = jnp.where(found.mistaken, step_size, 0.0) * found.direction
            return weights + step, mistakes + found.mistaken

        return lax.cond(usable, learn, lambda: carry), None

    begin = (state.weights, jnp.zeros((), int))
    (weights, mistakes), _ = lax.scan(look, begin, (states, actions, full))
    possible = jnp.all(~full | (in_range & mdp.available[states, actions]))
    learned = JinState(weights, (), state.session + 1)
    info: dict[str, Any] = {
        "session": state.session + 1,
        "log_likelihood": jnp.where(possible, jnp.nan, -jnp.inf),
        "demonstration_log_likelihood": jnp.where(possible, jnp.nan, -jnp.inf),
        "gradient": jnp.linalg.norm(weights - state.weights) / step_size,
        "iterations": jnp.sum(full),
        "solver_iterations": mistakes,
        "converged": jnp.array(True),
        "seconds": jnp.array(jnp.nan),
        "weights": weights,
    }
    return jax.tree.map(lambda a, b: jnp.where(possible, a, b), learned, state), SessionInfo(**info)


def _require_available(mdp: TabularMDP, demonstration: Demonstration) -> None:
    kind, states, actions, _ = demonstration.arrays
    full = (kind == SEEN) & (states != UNKNOWN) & (actions != UNKNOWN)
    if not full.any():
        raise DemonstrationError("a session needs at least one step seen in full, its state and its action")
    missing = full & ~np.asarray(mdp.available)[np.where(full, states, 0), np.where(full, actions, 0)]
    if missing.any():
        i, t = np.argwhere(missing)[0]
        raise DemonstrationError(
            f"trajectory {i}, step {t}: state {mdp.state_names[states[i, t]]} has no action "
            f"{mdp.action_names[actions[i, t]]}"
        )
