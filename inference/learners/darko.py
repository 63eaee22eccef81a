"""DARKO (Rhinehart and Kitani 2017) as an online learner: gradient steps on the session's own feature margin.

A session is the behaviour from one goal to the next (section 3.2): :func:`goal_sessions` cuts a stream of
behaviour there. Its weights are those of the session before, moved down the gradient of the margin
``E[phi | pi] - phi_hat``, ``pi`` being the soft policy of the complete MDP. Sessions carry the weights alone.

This is ME-I2RL with an empty statistic, as "Generalization to Existing Methods" (chapter 4) says: with
``|X_{i-1}| = 0`` and ``phi_hat^{1:i-1} = 0`` Eq. 4.2 leaves ``phi_hat^{1:i} = phi_hat^i``, the program of
Theorem 1 is that of the session alone, and a step here is one down the gradient of its dual. The session is
summarised by the ``features`` statistic of ME-I2RL.

If a goal ends the session but not the task, as on a patrol, the MDP and the plan continue after it: later
steps are completed under the current policy, as for any fragment. DARKO itself makes goals absorbing. If they
do end the task, :func:`ending_at` puts this into the MDP, and no steps follow. The choice matters: a soft
planner is paid for open options, up to ``log |A|`` nats a step. If a goal ends that pay, every weight has to
fall until arriving is worth it. DARKO's own planner, undiscounted and deterministic, conditions on arriving
instead; with chance in the dynamics no policy can guarantee arrival.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import PAD, SEEN, UNKNOWN, Demonstration, DemonstrationError
from ...models.observation.evidence import Sensor, checked_demonstration, require_possible
from ...models.process.mdp import Labels, TabularMDP
from ...models.process.planning import features_to_go, require_discounted, reward_of, soft_plan
from ..completion.smoothing import Evidence, evidence_of, smooth_all
from ..sessions.learner import Learner, SessionInfo
from ..sessions.scaling import on_scaled_features
from ..sessions.statistic import FEATURES, FeatureStatistic, complete


@shown_briefly
class DarkoState(NamedTuple):
    """State that DARKO carries from session to session.

    ``weights [K]``; an empty statistic; ``values [S]``, the weights' soft values, from which planning
    starts (they follow from the weights); number of sessions so far.
    """

    weights: Float[Array, " K"]
    statistic: tuple[()]
    values: Float[Array, " S"]
    session: Int[Array, ""]


@shown_briefly
class Margin(NamedTuple):
    """Margin of a session under some weights: ``margin [K]``, ``E[phi | pi] - phi_hat``, and its parts.

    ``statistic`` holds ``phi_hat`` and the start distribution, ``values [S]`` are the weights' soft values
    and ``log_likelihood`` is that of the demonstration, in nats (-inf if it is impossible).
    """

    margin: Float[Array, " K"]
    statistic: FeatureStatistic
    values: Float[Array, " S"]
    log_likelihood: Float[Array, ""]


def feature_margin(
    mdp: TabularMDP,
    weights: Float[Array, " K"],
    evidence: Evidence,
    seen: Bool[Array, "n L"],
    values: Float[Array, " S"] | None = None,
) -> Margin:
    """Return the margin ``E[phi | pi] - phi_hat`` of a session alone, per trajectory, in discounted features.

    Both expectations start at the session's first states. ``seen`` marks its observed steps, ``values [S]``
    warm-starts the plan. The margin is the gradient of ``start.V - theta.phi_hat``, the dual of ME-I2RL's
    ``features`` program for this session's statistic.
    """
    plan = soft_plan(mdp, reward_of(mdp, weights), values)
    completed = complete(mdp, smooth_all(mdp, plan.log_policy, evidence), evidence.live, seen)
    statistic = FEATURES.of_session(mdp, plan, completed)
    expected = statistic.start @ features_to_go(mdp, plan.policy)
    own = jnp.sum(completed.expectations.log_likelihood)
    return Margin(expected - statistic.features, statistic, plan.values, own)


def darko_i2rl(
    mdp: TabularMDP,
    *,
    learning_rate: float = 1.0,
    decay: float = 0.5,
    radius: float = math.inf,
    steps: int = 1,
) -> Learner[DarkoState, SessionInfo]:
    """Build DARKO: online projected gradient descent on the feature margin, under full observability.

    ``theta^i = project(theta^{i-1} - lambda_i (E[phi | pi] - phi_hat^i))``, with soft value iteration for
    ``pi`` and projection on the Euclidean ball of ``radius``. :func:`goal_sessions` finds goals and cuts the
    stream; any other demonstration is a session too. Lost frames are completed under the current policy; a
    hidden step is an error, as for ME-I2RL: the method assumes full visibility.

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process, discount below 1; goals that end the task as :func:`ending_at` makes them.
        Its initial distribution must allow the goals, where sessions start.
    learning_rate : float
        ``lambda``, per unit of discounted scaled features (:mod:`~i2rl.models.process.units`). The default is
        the best of ``i2rl run methods`` on the second patrol, from sessions of five steps.
    decay : float
        ``lambda_i = lambda / i^decay``. With one half the regret of online gradient descent without a horizon
        is sublinear (Zinkevich 2003); 0 gives a constant rate.
    radius : float
        Bound on the Euclidean norm of the scaled weights; none by default.
    steps : int
        Gradient steps in a session.

    Returns
    -------
    Learner
        The info's ``log_likelihood`` is that of the session alone, ``gradient`` the norm of the margin at the
        session's first weights. ``learner.log_likelihood`` is None, because the method has no statistic.
        ``update`` raises :class:`DemonstrationError` naming trajectory and step for an impossible
        observation.

    Raises
    ------
    ValueError
        For discount 1 or an option that is out of range.

    See Also
    --------
    i2rl.inference.me_i2rl : maximum entropy in sessions
    i2rl.inference.run_sessions : runs the sessions of a stream

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import darko_i2rl
    >>> from i2rl.models import Demonstration
    >>> learner = darko_i2rl(five_cells().mdp)
    >>> walk = Demonstration.from_pairs([[0, 1, 2, 3, 4, 4]], [[1, 1, 1, 1, 2, 2]])
    >>> state, info = learner.update(learner.init(jax.random.key(0)), walk)
    >>> bool(state.weights[0] > 0), info.gradient > 0  # the end is worth something
    (True, True)
    """
    return on_scaled_features(mdp, partial(_learner, learning_rate, decay, radius, steps))


def _learner(
    learning_rate: float, decay: float, radius: float, steps: int, mdp: TabularMDP
) -> Learner[DarkoState, SessionInfo]:
    require_discounted(mdp)
    if not 0 < learning_rate < math.inf or not radius > 0:
        raise ValueError(f"learning rate and radius must be positive, got {learning_rate} and {radius}")
    if not decay >= 0:
        raise ValueError(f"the decay must not be negative, got {decay}")
    if steps < 1:
        raise ValueError(f"a session needs at least one step, got {steps}")
    settings = _Settings(
        jnp.asarray(learning_rate, float),
        jnp.asarray(decay, float),
        jnp.asarray(radius, float),
        jnp.asarray(steps),
    )

    def init(key: Array) -> DarkoState:
        weights = jax.random.uniform(as_key(key), (mdp.n_features,), float)
        return DarkoState(weights, (), jnp.zeros(mdp.n_states), jnp.zeros((), int))

    def session(state: DarkoState, demonstration: Demonstration) -> tuple[DarkoState, SessionInfo]:
        return _session(mdp, settings, state, demonstration)

    def update(state: DarkoState, demonstration: Demonstration) -> tuple[DarkoState, SessionInfo]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration, needed_by="a session")
        new, info = session(state, demonstration.bucketed())
        if not np.isfinite(info.demonstration_log_likelihood):
            require_possible(Sensor(), mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        return new, info.in_plain_numbers(time.perf_counter() - began)

    configuration = {"learning_rate": learning_rate, "decay": decay, "radius": radius, "steps": steps}
    return Learner("DARKO", mdp, configuration, init, update, session)


class _Settings(NamedTuple):
    learning_rate: Float[Array, ""]
    decay: Float[Array, ""]
    radius: Float[Array, ""]
    steps: Int[Array, ""]


@jax.jit
def _session(
    mdp: TabularMDP, settings: _Settings, state: DarkoState, demonstration: Demonstration
) -> tuple[DarkoState, SessionInfo]:
    evidence, seen = evidence_of(mdp, Sensor(), demonstration), demonstration.kind == SEEN
    number = state.session + 1
    learning_rate = settings.learning_rate * number.astype(float) ** -settings.decay

    def descend(i: Int[Array, ""], carry: tuple) -> tuple:
        weights, found, first = carry
        moved = weights - learning_rate * found.margin
        length = jnp.linalg.norm(moved)
        inside = moved * jnp.where(length > settings.radius, settings.radius / length, 1.0)
        # Step zero only evaluates: one compiled margin serves the start, the steps and the end.
        weights = jnp.where(i > 0, inside, weights)
        following = feature_margin(mdp, weights, evidence, seen, found.values)
        return weights, following, jnp.where(i > 0, first, jnp.linalg.norm(following.margin))

    k, s = mdp.n_features, mdp.n_states
    nothing = FeatureStatistic(jnp.zeros(()), jnp.zeros(k), jnp.zeros(s))
    unseen = Margin(jnp.zeros(k), nothing, state.values, jnp.array(jnp.nan))
    begin = (state.weights, unseen, jnp.array(jnp.nan))
    weights, after, first = lax.fori_loop(0, settings.steps + 1, descend, begin)
    info: dict[str, Any] = {
        "session": number,
        "log_likelihood": FEATURES.log_likelihood(mdp, weights, after.values, after.statistic),
        "demonstration_log_likelihood": after.log_likelihood,
        "gradient": first,
        "iterations": settings.steps,
        "solver_iterations": settings.steps,
        "converged": jnp.array(True),
        "seconds": jnp.array(jnp.nan),
        "weights": weights,
    }
    possible = jnp.isfinite(after.log_likelihood)
    learned = DarkoState(weights, (), after.values, number)
    return jax.tree.map(lambda a, b: jnp.where(possible, a, b), learned, state), SessionInfo(**info)


# -- goals --------------------------------------------------------------------------------------------


def goal_sessions(stream: Iterable[Demonstration], goals: Bool[np.ndarray, " S"]) -> Iterator[Demonstration]:
    """Cut a stream of behaviour at its goals; each part is a session, ready for ``update``.

    ``stream`` holds consecutive pieces of one walk (``demonstration.sessions()``, say), their rows in order
    of time; ``goals [S]`` marks the goal states. A goal is reached when the expert is seen in it after being
    elsewhere: waiting there is no second arrival. The pair at the goal begins the next session. A session is
    one trajectory, padded to a power of two so that few lengths occur. Steps after the last goal are not
    yielded. Raises ``ValueError`` for marks that are not a boolean vector.
    """
    goals = np.asarray(goals)
    if goals.ndim != 1 or goals.dtype != bool:
        raise ValueError(
            f"goals must be a boolean array [S], one mark a state, got {goals.dtype} {goals.shape}"
        )
    codes: list[np.ndarray] = []
    scores: list[float] = []
    before = UNKNOWN
    for piece in stream:
        steps = np.asarray(piece.kind).reshape(-1) != PAD
        for code, score in zip(
            piece.codes.reshape(-1, 3)[steps], np.asarray(piece.score).reshape(-1)[steps], strict=True
        ):
            state = int(code[1]) if code[0] == SEEN else UNKNOWN
            if codes and state not in (UNKNOWN, before) and goals[state]:
                yield _row(codes, scores)
                codes, scores = [], []
            codes.append(code)
            scores.append(score)
            before = state


def _row(codes: list[np.ndarray], scores: list[float]) -> Demonstration:
    row = Demonstration.from_codes(np.array(codes)[None])
    return replace(row, score=np.array(scores, float)[None]).bucketed()


def stopping_places(stream: Iterable[Demonstration], n_states: int, steps: int) -> Bool[np.ndarray, " S"]:
    """Find states in which the expert was seen for at least ``steps`` consecutive steps: DARKO's goals.

    ``stream`` as for :func:`goal_sessions`. If moves may fail, choose ``steps`` so that staying so long
    by chance is rare. Raises ``ValueError`` for fewer than two steps.
    """
    if steps < 2:
        raise ValueError(f"a stop lasts at least two steps, got {steps}")
    found = np.zeros(n_states, bool)
    before, stayed = UNKNOWN, 0
    for piece in stream:
        for kind, state in zip(np.asarray(piece.kind).flat, np.asarray(piece.state).flat, strict=True):
            if kind == PAD:
                continue
            here = int(state) if kind == SEEN else UNKNOWN
            stayed = stayed + 1 if here == before else 1
            before = here
            if here != UNKNOWN and stayed >= steps:
                found[here] = True
    return found


def ending_at(mdp: TabularMDP, goals: Bool[np.ndarray, " S"]) -> TabularMDP:
    """Build the process in which reaching a goal ends the task, as for DARKO's planner.

    It has one more state, the last, which is absorbing and has no features. If states have names, it is
    "end", or "end 2" if a state has that name. Every move to a goal from another state leads there instead.
    The goals remain as first states and for waiting, since a session begins where the last one ended. DARKO
    plans for one goal at a time; here all of them end the task. Before learning from an episode, append the
    end as its last step (:func:`with_end`); otherwise the model may explain the last move as failed. Raises
    ``ValueError`` for marks of the wrong shape, or none.
    """
    goals = np.asarray(goals)
    if goals.shape != (mdp.n_states,) or goals.dtype != bool or not goals.any():
        raise ValueError(
            f"goals must be a boolean array [{mdp.n_states}] that marks at least one state, "
            f"got {goals.dtype} {goals.shape} with {int(goals.sum())} marked"
        )
    end = mdp.n_states
    successors = np.asarray(mdp.successors)
    arriving = goals[successors] & (successors != np.arange(end)[:, None, None])
    successors = np.where(arriving, end, successors)
    probabilities = np.asarray(mdp.probabilities)
    last = np.zeros((1, *probabilities.shape[1:]))
    last[0, 0, 0] = 1.0
    available = np.asarray(mdp.available)
    names = mdp.labels
    ended = TabularMDP.from_successors(
        np.concatenate([successors, np.full_like(successors[:1], end)]),
        np.concatenate([probabilities, last]),
        np.concatenate([np.asarray(mdp.features), np.zeros((1, mdp.n_actions, mdp.n_features))]),
        initial=np.append(np.asarray(mdp.initial), 0.0),
        discount=float(mdp.discount),
        available=np.concatenate([available, np.arange(mdp.n_actions)[None] == 0]),
    )
    states = None if names.states is None else (*names.states, _new_name("end", names.states))
    return replace(ended, labels=Labels(states, names.actions, names.features))


def _new_name(name: str, taken: tuple[str, ...]) -> str:
    """Return the name, numbered if it is taken."""
    candidates = (name, *(f"{name} {i}" for i in range(2, len(taken) + 3)))
    return next(candidate for candidate in candidates if candidate not in taken)


def with_end(session: Demonstration, end: int) -> Demonstration:
    """Append the end state (the last of :func:`ending_at`) as the last step of each trajectory."""
    n, width = session.kind.shape
    longer = session.padded(n, width + 1)
    rows, at = np.arange(n), longer.lengths
    for array, value in zip(longer.arrays, (SEEN, end, UNKNOWN, np.nan), strict=True):
        array[rows, at] = value
    return longer
