"""Runs of the breach (section 7.4.1): watch, learn, wait for a good moment, and go.

Success and time-out rates of the dissertation's figures 7.4 and 7.7 are shares of such trials.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import LOST, UNKNOWN
from ...models.observation.evidence import Visibility, observe
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, soft_plan
from .breach import (
    BreachPlan,
    BreachSettings,
    BreachTask,
    Forecast,
    IndependentForecast,
    Watcher,
    breach_task,
    plan_breach,
    watch,
)
from .process import SECONDS_PER_STEP, Interaction, Patrol, greedy_policy, simulate_patrollers

REACHED, CAUGHT, TIMED_OUT, RAN_OUT = range(4)
OUTCOMES = ("reached", "caught", "timed out", "ran out")
CHUNK = 64

# -- when to go ---------------------------------------------------------------------------------------


class GoAtBestTime(NamedTuple):
    """Dissertation's rule: once some departure has positive value, settle on the best one."""

    def __call__(
        self, key: Array, waited: Int[Array, ""], left: Int[Array, ""], values: Float[Array, " T"]
    ) -> tuple[Bool[Array, ""], Int[Array, ""]]:
        """Decide whether to settle now, and on which step.

        ``waited`` and ``left`` are the steps waited so far and still allowed, ``values`` the plan's at the
        start for each departure (``-inf`` beyond the allowed steps).
        """
        best = jnp.argmax(values)
        return values[best] > 0, best


class GoWhenBest(NamedTuple):
    """Default rule: plan afresh at every step, and go once no later departure is worth more.

    Observations during the wait correct the forecast. On instance 2 at 30 % it reaches the goal in about nine
    trials of ten, :class:`GoAtBestTime` in three of four.
    """

    def __call__(
        self, key: Array, waited: Int[Array, ""], left: Int[Array, ""], values: Float[Array, " T"]
    ) -> tuple[Bool[Array, ""], Int[Array, ""]]:
        """Decide as :class:`GoAtBestTime` does."""
        return (values[0] > 0) & (jnp.argmax(values) == 0), jnp.zeros((), int)


class GoAtRandom(NamedTuple):
    """The released code's random baseline: go at a time uniform over twice the allowed time."""

    def __call__(
        self, key: Array, waited: Int[Array, ""], left: Int[Array, ""], values: Float[Array, " T"]
    ) -> tuple[Bool[Array, ""], Int[Array, ""]]:
        """Decide as :class:`GoAtBestTime` does; half of all trials time out."""
        return jax.random.randint(key, (), 0, 2 * (waited + left + 1)) == waited, jnp.zeros((), int)


GoRule = GoAtBestTime | GoWhenBest | GoAtRandom


# -- settings -----------------------------------------------------------------------------------------


@shown_briefly
class Watching(NamedTuple):
    """The learner's view and its times before departure.

    Fields
    ------
    observability : int
        Percent, as in ``patrol.views``.
    observed_steps : int
        Steps perceived before learning: sessions times five.
    learning_seconds : float or float ``[trials]``
        Time that learning takes; it is rounded up to steps of the patrol.
    threshold_seconds : float, optional
        The learner must leave within so many seconds from the start of the run. By default perception, mean
        learning time and ``settings.rounds`` rounds of the patrol (section 7.4.1).
    """

    observability: int
    observed_steps: int
    learning_seconds: float | Float[np.ndarray, " trials"] = 0.0
    threshold_seconds: float | None = None


@shown_briefly
class Planning(NamedTuple):
    """The learner's beliefs about the patrollers, and its rule for departing.

    Fields
    ------
    settings : BreachSettings, optional
        The task that the learner plans for, if it differs from the true one (same horizon).
    watcher : :func:`watch` or :func:`project`
        Update of the belief about a patroller.
    forecast : IndependentForecast or SimulatedForecast
    go : GoAtBestTime, GoWhenBest or GoAtRandom
    """

    settings: BreachSettings | None = None
    watcher: Watcher = watch
    forecast: Forecast = IndependentForecast()
    go: GoRule = GoWhenBest()


# -- trials -------------------------------------------------------------------------------------------


@shown_briefly
class BreachOutcome(NamedTuple):
    """Outcomes of ``n`` trials.

    Fields
    ------
    ended : int ``[n]``
        Index into ``OUTCOMES``: reached a goal unseen; caught; had not left when the time allowed was over;
        left, but the plan's horizon ran out.
    waited : float ``[n]``
        Seconds between the end of learning and departure; NaN for trials that timed out.
    threshold : float
        Seconds from the start of the trial within which the learner had to leave.
    """

    ended: Int[np.ndarray, " n"]
    waited: Float[np.ndarray, " n"]
    threshold: float

    def rate(self, outcome: int = REACHED) -> float:
        """Return the share of trials that ended so."""
        return float(np.mean(self.ended == outcome))

    def interval(self, outcome: int = REACHED, level: float = 0.95) -> tuple[float, float]:
        """Wilson's confidence interval of :meth:`rate`."""
        from scipy import stats  # loading it takes a second

        result = stats.binomtest(int(np.sum(self.ended == outcome)), len(self.ended))
        low, high = result.proportion_ci(level, "wilson")
        return float(low), float(high)

    @property
    def mean_wait(self) -> float:
        """Mean seconds waited by the trials that left; NaN if none did."""
        gone = self.waited[~np.isnan(self.waited)]
        return float(gone.mean()) if len(gone) else math.nan


def breach_trials(
    key: Array,
    patrol: Patrol,
    log_policies: Float[Array | np.ndarray, "P S A"],
    *,
    watching: Watching,
    trials: int,
    interaction: Interaction = Interaction(),  # noqa: B008 (immutable)
    settings: BreachSettings = BreachSettings(),  # noqa: B008 (immutable)
    planning: Planning = Planning(),  # noqa: B008 (immutable)
) -> BreachOutcome:
    """Simulate trials: watch the patrol, learn, wait for a good moment, and try to reach the goal undetected.

    The patrollers start anywhere, follow their true optimal policies and pass each other as ``interaction``
    says. The learner watches ``observed_steps`` steps, is blind while it learns, then watches on until it
    leaves, planning anew at every step until it has settled on a departure (never later than it may leave).
    It stays hidden until then; from then on it follows its plan by elapsed time.

    Parameters
    ----------
    key : random key
    patrol : Patrol
        Instance 2 or 3.
    log_policies : float ``[P, S, A]``
        The patrollers' policies that the learner assumes, see :func:`greedy_policies`.
    watching : Watching
        The learner's view and its times before departure.
    trials : int
    interaction : Interaction
        True meetings of the patrollers.
    settings : BreachSettings
        The true task.
    planning : Planning
        Task that the learner plans for, its beliefs about the patrollers, and its rule for departing.

    Raises
    ------
    ValueError
        For an instance without a breach, an unknown observability, policies of another shape, or learning
        times that are negative or not one per trial.

    See Also
    --------
    i2rl.domains.demonstrate : what the policies are learned from
    i2rl.analysis.patrol_study : learn and breach in one

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import Watching, breach_trials, instance
    >>> patrol = instance(2)
    >>> known = jax.numpy.log(jax.numpy.stack([patrol.expert_policy()] * 2))
    >>> watching = Watching(observability=30, observed_steps=10)
    >>> outcome = breach_trials(jax.random.key(0), patrol, known, watching=watching, trials=5)
    >>> outcome.threshold, outcome.rate() > 0.5
    (244.0, True)
    """
    world = breach_task(patrol, settings.reach)
    observability, observed_steps, learning_seconds, threshold = watching
    believed = settings if planning.settings is None else planning.settings._replace(horizon=settings.horizon)
    log_policies = jnp.asarray(log_policies, float)
    expected = (patrol.patrollers, patrol.mdp.n_states, patrol.mdp.n_actions)
    if log_policies.shape != expected:
        raise ValueError(f"log_policies must have shape [P, S, A] = {expected}, got {log_policies.shape}")
    learning = np.asarray(learning_seconds, float)
    if learning.shape not in ((), (trials,)) or not (learning >= 0).all():
        raise ValueError(
            f"learning_seconds must be one number or one per trial ({trials}), none negative, "
            f"got shape {learning.shape}"
        )
    if threshold is None:
        rounds = settings.rounds * patrol.loop * SECONDS_PER_STEP
        threshold = observed_steps * SECONDS_PER_STEP + float(learning.mean()) + rounds
    ready = observed_steps + np.ceil(np.broadcast_to(learning, (trials,)) / SECONDS_PER_STEP).astype(int)
    deadline = int(threshold / SECONDS_PER_STEP)
    # One compiled program serves learning times of about the same length.
    length = 64 * math.ceil((max(deadline, observed_steps) + 1) / 64) + settings.horizon
    true_policy = jnp.log(jnp.asarray(patrol.expert_policy()))
    one, other = interaction.equilibrium
    ended, waited = _trials(
        jax.random.split(key, trials),
        jnp.asarray(ready),
        _Patrollers(
            patrol.mdp,
            jnp.asarray(patrol.cell_of_state),
            patrol.visibility(observability),
            jnp.broadcast_to(true_policy, expected),
            log_policies,
        ),
        _Tasks(
            world,
            breach_task(patrol, believed.reach),
            settings,
            believed,
            jnp.array(observed_steps),
            jnp.array(deadline),
        ),
        _Lengths(settings.horizon, length, Interaction((one, other), interaction.length)),
        planning.watcher,
        planning.forecast,
        planning.go,
    )
    return BreachOutcome(np.asarray(ended), np.asarray(waited), float(threshold))


class _Patrollers(NamedTuple):
    """The patrollers as they are, and as the learner sees them and takes them to be."""

    mdp: TabularMDP
    cells: Int[Array, " S"]
    view: Visibility
    true_policies: Float[Array, "P S A"]
    log_policies: Float[Array, "P S A"]


class _Tasks(NamedTuple):
    """The learner's true task, the one that it plans for, and its times."""

    world: BreachTask
    planned: BreachTask
    settings: BreachSettings
    believed: BreachSettings
    observed: Int[Array, ""]
    deadline: Int[Array, ""]


class _Lengths(NamedTuple):
    """Numbers of steps for which a program is compiled."""

    horizon: int
    length: int
    interaction: Interaction


# Rules are arguments of their own: as tuples without fields they would equal one another within a tuple.
@partial(jax.jit, static_argnums=(4, 5, 6, 7))
def _trials(
    keys: Array,
    ready: Int[Array, " n"],
    watched: _Patrollers,
    tasks: _Tasks,
    lengths: _Lengths,
    watcher: Watcher,
    forecast: Forecast,
    go: GoRule,
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    mdp, cells, view, true_policies, log_policies = watched
    world, task, settings, believed, observed, deadline = tasks
    horizon, length, interaction = lengths
    patrollers = jnp.arange(log_policies.shape[0])
    lost = jnp.array([LOST, UNKNOWN, UNKNOWN])
    detection = forecast.detection(mdp, cells, log_policies, task.sees, horizon)

    def patrolled(key: Array, look: Array, first: Array) -> tuple[Int[Array, "P N"], Int[Array, "P N 3"]]:
        start = jax.random.categorical(first, jnp.log(mdp.initial), shape=patrollers.shape)
        states, actions = simulate_patrollers(key, mdp, cells, true_policies, start, *interaction, length)
        codes = jax.vmap(lambda p: observe(jax.random.fold_in(look, p), view, states[p], actions[p]))(
            patrollers
        )
        return states, codes

    def perceive(
        codes: Int[Array, "P N 3"], ready: Int[Array, ""], t: Int[Array, ""], beliefs: Float[Array, "P S"]
    ) -> Float[Array, "P S"]:
        seen = jnp.where((t < observed) | (t >= ready), codes[:, t], lost)
        return jax.vmap(lambda p, b, c: watcher(mdp, p, view, b, c))(log_policies, beliefs, seen)

    def learned(codes: Int[Array, "P N 3"], ready: Int[Array, ""]) -> Float[Array, "P S"]:
        beliefs = jnp.broadcast_to(mdp.initial, (*patrollers.shape, mdp.n_states))
        return lax.fori_loop(0, jnp.minimum(ready, length), partial(perceive, codes, ready), beliefs)

    def chunk(inputs: tuple[Array, Int[Array, " n"]]) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        keys, ready = inputs
        first, patrol_key, look, go_key, predict_key, walk_key = jax.vmap(
            lambda key: jax.random.split(key, 6), out_axes=1
        )(keys)
        states, codes = jax.vmap(patrolled)(patrol_key, look, first)

        def plan(now: Int[Array, " n"], beliefs: Float[Array, "n P S"]) -> BreachPlan:
            at = jax.vmap(jax.random.fold_in)(predict_key, now)
            return plan_breach(task, jax.vmap(detection, out_axes=-1)(at, beliefs), believed)

        def decide(now: Int[Array, " n"], beliefs: Float[Array, "n P S"]) -> tuple:
            values = plan(now, beliefs).values[:, task.start].T
            left = deadline - now
            allowed = jnp.where(jnp.arange(horizon) <= left[:, None], values, -jnp.inf)
            return jax.vmap(go.__call__)(go_key, now - ready, left, allowed)

        def waiting(now: Int[Array, " n"], settled: Bool[Array, " n"]) -> Bool[Array, " n"]:
            return (now <= deadline) & ~settled

        def wait(carry: tuple) -> tuple:
            now, beliefs, settled, offset = carry
            here = waiting(now, settled)
            decided, departure = decide(now, beliefs)
            offset = jnp.where(here, departure, offset)
            settled = settled | (here & decided)
            stays = here & ~decided
            seen = jax.vmap(perceive)(codes, ready, now, beliefs)
            beliefs = jnp.where(stays[:, None, None], seen, beliefs)
            return now + stays, beliefs, settled, offset

        now, beliefs, settled, offset = lax.while_loop(
            lambda carry: jnp.any(waiting(carry[0], carry[2])),
            wait,
            (ready, jax.vmap(learned)(codes, ready), jnp.zeros(len(keys), bool), jnp.zeros(len(keys), int)),
        )
        moves = plan(now, beliefs).moves
        seen_by = jnp.any(world.sees[:, states] > 0, axis=2)  # [C, n, N]
        ended = jax.vmap(walk, in_axes=(0, -1, 1, 0, 0))(walk_key, moves, seen_by, now, offset)
        waited = (now + offset - ready) * SECONDS_PER_STEP
        return jnp.where(settled, ended, TIMED_OUT), jnp.where(settled, waited, jnp.nan)

    def walk(
        key: Array,
        moves: Int[Array, "T X"],
        seen: Bool[Array, "C N"],
        now: Int[Array, ""],
        offset: Int[Array, ""],
    ) -> Int[Array, ""]:
        """Follow the plan from ``offset`` steps after ``now`` among the true patrollers."""

        def step(carry: tuple, inputs: tuple) -> tuple:
            state, ended = carry
            t, key = inputs
            slip, which = jax.random.split(key)
            away = (ended < 0) & (t >= offset)
            arrived = world.goal[state]
            caught = seen[world.cell[state], now + t] & ~arrived
            ended = jnp.where(away & arrived, REACHED, jnp.where(away & caught, CAUGHT, ended))
            slipped = jax.random.bernoulli(slip, settings.failure)
            other = (moves[t, state] + jax.random.randint(which, (), 1, 3)) % 3
            move = jnp.where(slipped, other, moves[t, state])
            return (jnp.where(away & (ended < 0), world.following[state, move], state), ended), None

        steps = (jnp.arange(horizon - 1), jax.random.split(key, horizon - 1))
        (_, ended), _ = lax.scan(step, (world.start, jnp.array(-1)), steps)
        return jnp.where(ended < 0, RAN_OUT, ended)

    # In chunks that fit a cache; no trial waits for the slowest of all. The last chunk is filled up.
    trials = len(keys)
    size = min(CHUNK, trials)
    at = jnp.arange(math.ceil(trials / size) * size).reshape(-1, size) % trials
    ended, waited = lax.map(chunk, (keys[at], ready[at]))
    return ended.ravel()[:trials], waited.ravel()[:trials]


# -- what the learner may take for the patrollers' policies -------------------------------------------


def greedy_policies(patrol: Patrol, weights: Float[np.ndarray, "P K"]) -> Float[Array, "P S A"]:
    """Compute log-policies optimal under each patroller's learned weights; ties as in the patrollers' own
    policy.
    """

    policies = [greedy_policy(patrol.mdp, w) for w in np.asarray(weights, float)]
    return jnp.log(jnp.asarray(np.stack(policies)))


def soft_policies(patrol: Patrol, weights: Float[np.ndarray, "P K"]) -> Float[Array, "P S A"]:
    """Compute soft log-policies under each patroller's learned weights."""
    return _soft(patrol.mdp, jnp.asarray(weights, float))


@jax.jit
def _soft(mdp: TabularMDP, weights: Float[Array, "P K"]) -> Float[Array, "P S A"]:
    return jax.vmap(lambda w: soft_plan(mdp, reward_of(mdp, w)).log_policy)(weights)
