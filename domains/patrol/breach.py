"""Breaching a patrol (section 7.1.1): a forecast of the patrollers, and a path to the goal out of their
sight.

The learner tracks each patroller by a belief, predicts its places with the learned policies, and plans a path
to the goal. :class:`BreachSettings` reconstructs the details that the dissertation leaves open (rewards,
horizon, start). Trials of the whole task: :mod:`i2rl.domains.patrol.trials`.

A patroller sees the cells within ``reach`` (Euclidean) straight ahead of it, its own included; walls do not
matter, as in the released code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.laws.chain import condition
from ...models.observation.demonstration import HIDDEN, LOST
from ...models.observation.evidence import AnySensor, step_log_evidence
from ...models.process.mdp import TabularMDP
from .process import Breach, Interaction, Patrol, cell_ahead, simulate_patrollers

MOVES = ("forward", "left", "right")


class BreachSettings(NamedTuple):
    """The learner's task in numbers; none is published, so all are reconstructions.

    ``reward`` is paid at a goal, ``penalty`` when caught; with probability ``failure`` one of the other two
    actions happens instead; a plan covers ``horizon`` steps; patrollers see ``reach`` cells ahead; the
    learner may wait for ``rounds`` rounds of the patrol.
    """

    reward: float = 10.0
    penalty: float = 10.0
    failure: float = 0.05
    horizon: int = 60
    reach: float = 3.0
    rounds: float = 2.0


@shown_briefly
class BreachTask(NamedTuple):
    """The learner's process without time, over ``X`` states (cell, heading) of its ``C`` cells.

    Fields
    ------
    following : int ``[X, 3]``
        State each move intends; a blocked move stays.
    cell : int ``[X]``
        Index of the state's cell in ``patrol.breach.cells``.
    goal : bool ``[X]``
    start : int
    sees : float ``[C, S]``
        1 where a patroller in state ``s`` sees cell ``c``.
    discount : float
    """

    following: Int[Array, "X 3"]
    cell: Int[Array, " X"]
    goal: Bool[Array, " X"]
    start: Int[Array, ""]
    sees: Float[Array, "C S"]
    discount: Float[Array, ""]


@shown_briefly
class BreachPlan(NamedTuple):
    """Optimal values ``[T, X, *n]`` at each step of the plan, and the best move (index into ``MOVES``)."""

    values: Float[Array, "T X *n"]
    moves: Int[Array, "T X *n"]


def line_of_sight(patrol: Patrol, reach: float) -> Bool[np.ndarray, "C S"]:
    """Find the cells of the learner that are in sight of each patroller state."""
    breach = _breach_of(patrol)
    down, right = (
        np.array(breach.cells)[:, axis, None] - np.array([state.cell[axis] for state in patrol.states])
        for axis in (0, 1)
    )
    heading = np.array([state.heading for state in patrol.states])
    east, north, west, south = (heading == h for h in range(4))
    row, column = down == 0, right == 0
    ahead = (
        (east & row & (right >= 0))
        | (west & row & (right <= 0))
        | (north & column & (down <= 0))
        | (south & column & (down >= 0))
    )
    return ahead & (np.hypot(down, right) <= reach)


def breach_task(patrol: Patrol, reach: float = 3.0) -> BreachTask:
    """Build the learner's process on a patrol's map; ``ValueError`` for an instance without such a task."""
    breach = _breach_of(patrol)
    index = {cell: i for i, cell in enumerate(breach.cells)}
    states = [breach.start._replace(row=r, column=c, heading=h) for r, c in breach.cells for h in range(4)]
    following = []
    for state in states:
        cell = cell_ahead(state) if cell_ahead(state) in index else state.cell
        turns = ((state.heading + 1) % 4, (state.heading - 1) % 4)
        at = index[state.cell] * 4
        following.append((index[cell] * 4 + state.heading, at + turns[0], at + turns[1]))
    return BreachTask(
        jnp.array(following),
        jnp.arange(len(states)) // 4,
        jnp.array([state.cell in breach.goals for state in states]),
        jnp.array(states.index(breach.start)),
        jnp.asarray(line_of_sight(patrol, reach), float),
        jnp.array(breach.discount),
    )


def _breach_of(patrol: Patrol) -> Breach:
    if patrol.breach is None:
        raise ValueError(f"{patrol.name} has no breach: the learner of that instance only watches")
    return patrol.breach


# -- where the patrollers are, and where they will be -------------------------------------------------


def watch(
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    sensor: AnySensor,
    belief: Float[Array, " S"],
    code: Int[Array, " 3"],
) -> Float[Array, " S"]:
    """Update the belief: the distribution of the next state after the observation ``code`` of this one
    (exact).

    ``code`` is (kind, state, action) as in :attr:`Demonstration.codes`. Not being seen counts as evidence. An
    observation overrules policy and belief: after a pair seen, the belief is that of the dynamics; after a
    hidden step that was believed impossible, it starts afresh from anywhere out of view.
    """
    kind, state, action = code[0], code[1], code[2]
    no_score = jnp.array(jnp.nan)
    evidence = step_log_evidence(sensor, mdp.n_states, mdp.n_actions, kind, state, action, no_score)
    factors = evidence + log_policy
    possible = jnp.any((belief[:, None] > 0) & (factors > -jnp.inf))
    belief = jnp.where(possible, belief, 1 / mdp.n_states)
    factors = jnp.where(possible, factors, evidence)
    return condition(mdp, belief, factors)


def project(
    mdp: TabularMDP,
    log_policy: Float[Array, "S A"],
    sensor: AnySensor,
    belief: Float[Array, " S"],
    code: Int[Array, " 3"],
) -> Float[Array, " S"]:
    """Propagate the belief from the last sighting, without the evidence of later hidden steps (the
    dissertation's).

    As :func:`watch`, but a hidden step is taken for a lost frame.
    """
    kind = jnp.where(code[0] == HIDDEN, LOST, code[0])
    return watch(mdp, log_policy, sensor, belief, code.at[0].set(kind))


Watcher = Callable[
    [TabularMDP, Float[Array, "S A"], AnySensor, Float[Array, " S"], Int[Array, " 3"]], Float[Array, " S"]
]


Detection = Callable[[Array, Float[Array, "P S"]], Float[Array, "T C"]]
"""Probabilities of detection in each cell at each step to come, from a key and the beliefs."""


class IndependentForecast(NamedTuple):
    """Exact marginals of each patroller walking alone; their meetings are left out (the default)."""

    def __call__(
        self,
        key: Array,
        mdp: TabularMDP,
        cells: Int[Array, " S"],
        log_policies: Float[Array, "P S A"],
        beliefs: Float[Array, "P S"],
        horizon: int,
    ) -> Float[Array, "P T S"]:
        """Compute ``P(s_t)`` of each patroller for ``t = 0..horizon-1``; step 0 is the belief itself."""
        del key, cells
        chains = jax.vmap(mdp.state_transitions)(jnp.exp(log_policies))

        def step(beliefs: Float[Array, "P S"], _: None) -> tuple:
            return jnp.einsum("ps,psz->pz", beliefs, chains), beliefs

        marginals: Array = lax.scan(step, beliefs, None, horizon)[1]
        return jnp.swapaxes(marginals, 0, 1)

    def detection(
        self,
        mdp: TabularMDP,
        cells: Int[Array, " S"],
        log_policies: Float[Array, "P S A"],
        sees: Float[Array, "C S"],
        horizon: int,
    ) -> Detection:
        """Return :func:`detection_probability` of the forecast as a function of key and beliefs.

        What a patroller sees after ``t`` steps from each state depends on its policy alone and is computed
        once: a belief then takes one product instead of a walk of ``horizon`` steps.
        """
        del cells
        chains = jax.vmap(mdp.state_transitions)(jnp.exp(log_policies))

        def step(seen: Float[Array, "P S C"], _: None) -> tuple:
            return chains @ seen, seen

        first = jnp.broadcast_to(sees.T, (len(chains), *sees.T.shape))
        seen: Array = lax.scan(step, first, None, horizon)[1]  # [T, P, S, C]

        def detect(key: Array, beliefs: Float[Array, "P S"]) -> Float[Array, "T C"]:
            del key
            return _any_of(jnp.einsum("ps,tpsc->ptc", beliefs, seen))

        return detect


class SimulatedForecast(NamedTuple):
    """Marginals estimated from joint simulations, meetings included (what the released code ships)."""

    interaction: Interaction = Interaction()
    draws: int = 300

    def __call__(
        self,
        key: Array,
        mdp: TabularMDP,
        cells: Int[Array, " S"],
        log_policies: Float[Array, "P S A"],
        beliefs: Float[Array, "P S"],
        horizon: int,
    ) -> Float[Array, "P T S"]:
        """Forecast as :class:`IndependentForecast`, from ``draws`` walks that start from the beliefs."""
        equilibrium, length = self.interaction

        def one(key: Array) -> Int[Array, "P T"]:
            begin, walk = jax.random.split(key)
            start = jax.random.categorical(begin, jnp.log(beliefs))
            return simulate_patrollers(walk, mdp, cells, log_policies, start, equilibrium, length, horizon)[0]

        states = jax.vmap(one)(jax.random.split(key, self.draws))
        patroller, time = np.ogrid[: beliefs.shape[0], :horizon]
        empty = jnp.zeros((beliefs.shape[0], horizon, mdp.n_states))
        return empty.at[patroller, time, states].add(1 / self.draws)

    def detection(
        self,
        mdp: TabularMDP,
        cells: Int[Array, " S"],
        log_policies: Float[Array, "P S A"],
        sees: Float[Array, "C S"],
        horizon: int,
    ) -> Detection:
        """Return :func:`detection_probability` of the forecast as a function of key and beliefs."""

        def detect(key: Array, beliefs: Float[Array, "P S"]) -> Float[Array, "T C"]:
            return detection_probability(sees, self(key, mdp, cells, log_policies, beliefs, horizon))

        return detect


Forecast = IndependentForecast | SimulatedForecast


def detection_probability(sees: Float[Array, "C S"], marginals: Float[Array, "P T S"]) -> Float[Array, "T C"]:
    """Compute ``1 - prod_i (1 - d_i)``, the probability of detection by independent patrollers."""
    return _any_of(jnp.einsum("cs,pts->ptc", sees, marginals))


def _any_of(probabilities: Float[Array, "P T C"]) -> Float[Array, "T C"]:
    return 1 - jnp.prod(1 - probabilities, axis=0)


# -- planning -----------------------------------------------------------------------------------------


def plan_breach(task: BreachTask, detection: Float[Array, "T C *n"], settings: BreachSettings) -> BreachPlan:
    """Compute the optimal plan against predicted patrollers, exactly, by one backward recursion.

    At each step the learner is first detected, with the probability ``detection [T, C]`` gives for its cell
    (it is caught and pays the penalty), and otherwise moves. A goal ends the trial and pays the reward; the
    last step pays zero. Axes after the first two hold plans of their own: many plans at once are several
    times faster so than under ``vmap``, which puts their axis first.
    """
    goal = task.goal.reshape(-1, *[1] * (detection.ndim - 2))
    goal_value = jnp.where(goal, settings.reward, 0.0)
    slip = settings.failure / 2  # to each of the other two moves

    def back(values: Float[Array, " X *n"], detected: Float[Array, " C *n"]) -> tuple:
        forward, left, right = (values[task.following[:, move]] for move in range(len(MOVES)))
        best = jnp.maximum(forward, jnp.maximum(left, right))
        onward = slip * (forward + left + right) + (1 - 3 * slip) * best
        caught = detected[task.cell]
        value = task.discount * ((1 - caught) * onward - caught * settings.penalty)
        values = jnp.where(goal, goal_value, value)
        moves = jnp.where(forward >= best, 0, jnp.where(left >= best, 1, 2))
        return values, (values, moves)

    last = jnp.zeros((len(task.goal), *detection.shape[2:]))
    swept: tuple = lax.scan(back, last, detection[:-1], reverse=True)[1]
    values, moves = swept
    return BreachPlan(
        jnp.concatenate([values, last[None]]), jnp.concatenate([moves, jnp.zeros_like(moves[:1])])
    )
