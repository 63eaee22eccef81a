"""Latent maximum-entropy IRL (chapter 4): learning from partly hidden demonstrations, online and in batch.

A session alternates the E-step (completion under the current policy) and the M-step (a maximum-entropy
program started at the current weights). It is Algorithm 1 with two replacements: exact expectations instead
of sampling, and a solver that can express negative weights and any rationality instead of exponentiated
gradient.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import SEEN as SEEN_STEP
from ...models.observation.demonstration import Demonstration, DemonstrationError
from ...models.observation.evidence import (
    AnySensor,
    Sensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import SoftPlan, require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from ..completion.smoothing import Evidence, evidence_of
from ..programs.maximum_entropy import (
    Solution,
    WarmStart,
)
from ..sessions.learner import Learner, SessionInfo, digest_of
from ..sessions.scaling import on_scaled_features
from ..sessions.schedule import Schedule, described, require_slack_in
from ..sessions.statistic import Completed, blend
from .alternation import (
    Alternation,
    AlternationOptions,
    Method,
    checked_method,
    exponentiated,
    newton,
    random_weights,
    relative_change,
)
from .likelihood import ITERATIONS, likelihood_learner

# Nats per trajectory and unit of scaled weight. A smaller slack admits nearly deterministic experts.
DEFAULT_SLACK = 0.002
# Nats in all, of scaled weights; nearer zero the kept likelihood can run away to a plateau.
DEFAULT_KEPT_RIDGE = 0.02


@shown_briefly
class LMEState(NamedTuple):
    """State that LME-I2RL carries from session to session (Definition 7).

    Fields
    ------
    weights : float ``[K]``
        The reward estimate ``theta^i``.
    statistic : FeatureStatistic or CountStatistic
        The sufficient statistic, a running average over all trajectories so far.
    values : float ``[S]``
        Soft values of ``weights``, planning's warm start.
    program : tuple
        The solver's own warm start; empty for solvers that start from weights and values.
    session : int
        Number of sessions so far.
    key : random key
    """

    weights: Float[Array, " K"]
    statistic: Any
    values: Float[Array, " S"]
    program: Any
    session: Int[Array, ""]
    key: Array


class _Iterate(NamedTuple):
    """One point of the EM iteration."""

    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    change: Float[Array, ""]
    gradient: Float[Array, ""]
    iterations: Int[Array, ""]
    solver_iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    key: Array


def lme_i2rl(
    mdp: TabularMDP,
    sensor: AnySensor,
    *,
    statistic: str = "seen",
    completion: str = "exact",
    solver: str = "newton",
    slack: Schedule | None = None,
    ridge: float | None = None,
    name: str = "LME-I2RL",
    **alternation: Unpack[AlternationOptions],
) -> Learner[LMEState, SessionInfo]:
    """Build online latent maximum-entropy IRL (Algorithm 1).

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process without its reward; discount below 1.
    sensor : Sensor
        Visibility and noise of the learner's perception.
    statistic : {"seen", "counts", "features", "likelihood"}
        Summary of a session; see :mod:`i2rl.inference.sessions.statistic`. ``"likelihood"`` keeps the
        likelihood itself (:mod:`i2rl.inference.sessions.kept_likelihood`), which stays near batch learning
        where steps are read in part or wrongly; it has no slack, and takes Newton steps.
    completion : {"exact", "blocked", "gibbs"}
        The E-step: exact, or estimated from ``draws`` (957 by default).
    solver : {"newton", "ipopt", "cvxpy", "exponentiated gradient"}
        The M-step: proximal Newton in JAX; the CasADi program with IPOPT, warm-started from the last
        session; the CVXPY primal; the normalised exponentiated gradient as printed. The last two solve the
        program of the ``features`` statistic only.
    slack : float or function of the session's number
        Relaxation ``epsilon`` of the matching constraint: an L1 penalty of ``slack`` nats per trajectory on
        scaled weights, rewards in nats that each feature adds at most (:mod:`~i2rl.models.process.units`)
        (``slack / (1 - gamma)`` with the ``features`` statistic, as in Theorem 1). A function is a schedule,
        as in Optax: JAX traces it from the session's number, counted from 1;
        :class:`~i2rl.inference.sessions.schedule.Harmonic` is that of the no-regret theorem (Eq. 4.3). 0.002
        by default; none with the ``likelihood`` statistic.
    ridge : float
        Precision of a Gaussian prior on the scaled weights (nats in all, not per trajectory); for the newton
        and ipopt solvers. None by default; 0.02 with the ``likelihood`` statistic.
    iterations, tolerance : int, float
        A session ends after this number of E- and M-steps (10 by default), or when no scaled weight moves by
        more than ``tolerance`` (1e-3 by default) relative to the largest. With the ``likelihood`` statistic:
        Newton steps (3 by default), and the absolute length of the last (1e-6 by default).

    Returns
    -------
    Learner
        Its ``update`` raises :class:`DemonstrationError` naming trajectory and step for an impossible
        observation, and ``ValueError`` if a schedule turns negative; the given state stays valid.

    Raises
    ------
    ValueError
        For discount 1, an unknown option, or a slack that is negative or not a number.

    See Also
    --------
    i2rl.inference.me_i2rl : the learner under full observability
    i2rl.inference.batch_lme : all trajectories at once
    i2rl.inference.run_sessions : runs the sessions of a stream

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import lme_i2rl
    >>> corridor = five_cells()
    >>> learner = lme_i2rl(corridor.mdp, corridor.sensor)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.session, bool(state.weights[0] > 0)  # the end is worth something
    ('LME-I2RL', 1, True)
    """
    require_discounted(mdp)
    sensor = fitting_sensor(sensor, mdp)
    if statistic == "likelihood":
        return _with_kept_likelihood(mdp, sensor, completion, solver, slack, ridge, name, alternation)
    iterations, tolerance, draws = steps = Alternation(**alternation)
    slack, ridge = DEFAULT_SLACK if slack is None else slack, 0.0 if ridge is None else ridge

    def build(mdp: TabularMDP) -> Learner[LMEState, SessionInfo]:
        method = checked_method(mdp, sensor, statistic, completion, slack, ridge, draws)
        configuration = {
            "statistic": statistic,
            "completion": completion,
            "solver": solver,
            "slack": described(slack),
            "ridge": ridge,
            "draws": draws if completion != "exact" else 0,
            "iterations": iterations,
            "tolerance": tolerance,
            "sensor": digest_of(sensor),
        }
        return _learner(name, method, _carried_on, solver, steps, configuration)

    return on_scaled_features(mdp, build)


def _with_kept_likelihood(
    mdp: TabularMDP,
    sensor: AnySensor,
    completion: str,
    solver: str,
    slack: Schedule | None,
    ridge: float | None,
    name: str,
    alternation: AlternationOptions,
) -> Learner[LMEState, SessionInfo]:
    if completion != "exact" or solver != "newton":
        raise ValueError(
            "the likelihood statistic completes exactly and takes Newton steps, "
            f"got completion={completion!r} and solver={solver!r}"
        )
    if slack is not None and (callable(slack) or slack != 0):
        raise ValueError("the likelihood statistic has no slack: give a ridge instead")
    given = Alternation(**alternation)
    iterations = given.iterations if "iterations" in alternation else ITERATIONS
    tolerance = given.tolerance if "tolerance" in alternation else 1e-6
    if iterations < 1:
        raise ValueError(f"a session needs at least one iteration, got {iterations}")

    def build(mdp: TabularMDP) -> Learner:
        # Of the method's parts only process, sensor and ridge are used.
        precision = DEFAULT_KEPT_RIDGE if ridge is None else ridge
        method = checked_method(mdp, sensor, "counts", "exact", 0.0, precision, 0)
        configuration = {
            "statistic": "likelihood",
            "ridge": method.ridge,
            "iterations": iterations,
            "tolerance": tolerance,
            "sensor": digest_of(sensor),
        }
        return likelihood_learner(name, method, LMEState, configuration, iterations, tolerance)

    return on_scaled_features(mdp, build)


def lme_i2rl_with_random_weights(
    mdp: TabularMDP, sensor: AnySensor, **options: Any
) -> Learner[LMEState, SessionInfo]:
    """Build LME-I2RL without carried weights: every session starts from random ones (section 7.3).

    It is a control for the value of carrying the weights. Options as for :func:`lme_i2rl`, except the
    ``likelihood`` statistic, which belongs to the weights that it was expanded at.
    """
    if options.get("statistic") == "likelihood":
        raise ValueError("the likelihood statistic is expanded at the carried weights: use lme_i2rl")
    sensor = fitting_sensor(sensor, mdp)
    carried = lme_i2rl(mdp, sensor, name="LME-I2RL with random weights", **options)
    configuration = carried.configuration

    def build(mdp: TabularMDP) -> Learner[LMEState, SessionInfo]:
        method = checked_method(
            mdp,
            sensor,
            configuration["statistic"],
            configuration["completion"],
            DEFAULT_SLACK if options.get("slack") is None else options["slack"],
            configuration["ridge"],
            configuration["draws"],
        )
        return _learner(
            carried.name,
            method,
            _started_afresh,
            configuration["solver"],
            Alternation(configuration["iterations"], configuration["tolerance"]),
            configuration,
        )

    return on_scaled_features(mdp, build)


def me_i2rl(mdp: TabularMDP, **options: Any) -> Learner[LMEState, SessionInfo]:
    """Build online maximum-entropy IRL under full observability; options as for :func:`lme_i2rl`.

    Theorem 1 is about the program that ``statistic="features"`` solves.

    See Also
    --------
    i2rl.inference.lme_i2rl : the learner for hidden steps
    i2rl.inference.run_sessions : runs the sessions of a stream

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import me_i2rl
    >>> from i2rl.models import Demonstration
    >>> learner = me_i2rl(five_cells().mdp)
    >>> walk = Demonstration.from_pairs([[0, 1, 2, 3, 4, 4]], [[1, 1, 1, 1, 2, 2]])
    >>> state, info = learner.update(learner.init(jax.random.key(0)), walk)
    >>> bool(state.weights[0] > 0)  # the end is worth something
    True
    """
    return lme_i2rl(mdp, Sensor(), name="ME-I2RL", **options)


# -- building blocks ----------------------------------------------------------------------------------


def _carried_on(method: Method, key: Array, state: LMEState) -> tuple:
    del key
    return state.weights, state.values


def _started_afresh(method: Method, key: Array, state: LMEState) -> tuple:
    return random_weights(key, method.mdp), jnp.zeros_like(state.values)


class _Ending(NamedTuple):
    """The end of the EM iteration: its last point, planned for, and the demonstration completed under it."""

    point: _Iterate
    plan: SoftPlan
    completed: Completed
    reached: Bool[Array, ""]


class _Session(NamedTuple):
    """A session's number, the statistic of earlier ones, and its evidence and observed steps."""

    number: Int[Array, ""]
    kept: Any
    evidence: Evidence
    seen: Bool[Array, "n L"]


def _em(
    method: Method,
    m_step: Callable[..., Solution],
    alternation: Alternation,
    session: _Session,
    key: Array,
    weights: Float[Array, " K"],
    values: Float[Array, " S"],
) -> _Ending:
    """Run the E- and M-steps of a session in one compiled loop, and one more E-step."""
    iterations, tolerance, _ = alternation
    number, kept, evidence, seen = session

    @jax.jit  # traced once, though its shapes are asked for below
    def complete_under(point: _Iterate) -> tuple[Array, SoftPlan, Completed]:
        key, sample = jax.random.split(point.key)
        plan = method.plan(point.weights, point.values)
        return key, plan, method.e_step(sample, plan, evidence, seen)

    def improve(point: _Iterate, plan: SoftPlan, completed: Completed) -> _Iterate:
        working = blend(kept, method.statistic.of_session(method.mdp, plan, completed))
        solution = m_step(
            method.mdp, working, *method.penalties(working, number), WarmStart(point.weights, plan.values)
        )
        gradient = lax.cond(
            point.iterations == 0, lambda: method.gradient(plan, working), lambda: point.gradient
        )
        return _Iterate(
            solution.weights,
            solution.values,
            relative_change(point.weights, solution.weights),
            gradient,
            point.iterations + 1,
            point.solver_iterations + solution.iterations,
            solution.converged,
            point.key,
        )

    # The last E-step is one more turn of the loop: it would otherwise be compiled a second time.
    def step(now: _Ending) -> _Ending:
        point = now.point
        key, plan, completed = complete_under(point)
        point = point._replace(key=key)
        reached = ~((point.change > tolerance) & (point.iterations < iterations))
        point = lax.cond(reached, lambda: point, lambda: improve(point, plan, completed))
        return _Ending(point, plan, completed, reached)

    zero = jnp.zeros((), int)
    unsolved = jnp.array(False)
    first = _Iterate(weights, values, jnp.array(jnp.inf), jnp.array(jnp.inf), zero, zero, unsolved, key)
    _, *shapes = jax.eval_shape(complete_under, first)
    plan, completed = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    beginning = _Ending(first, plan, completed, jnp.array(False))
    return lax.while_loop(lambda now: ~now.reached, step, beginning)


def _close(
    method: Method, state: LMEState, point: _Iterate, program: Any, plan: SoftPlan, completed: Completed
) -> tuple[LMEState, SessionInfo]:
    """End a session: update the statistic by its demonstration, completed under its own result."""
    mdp, statistic = method.mdp, method.statistic
    new = statistic.to_keep(mdp, plan, completed)
    own = jnp.sum(completed.expectations.log_likelihood)
    kept = blend(state.statistic, new)
    fields: dict[str, Any] = {
        "session": state.session + 1,
        "log_likelihood": statistic.log_likelihood(mdp, point.weights, plan.values, kept),
        "demonstration_log_likelihood": own,
        "gradient": point.gradient,
        "iterations": point.iterations,
        "solver_iterations": point.solver_iterations,
        "converged": point.converged,
        "seconds": jnp.array(jnp.nan),
        "weights": point.weights,
    }
    learned = LMEState(point.weights, kept, plan.values, program, state.session + 1, point.key)
    # Keep the previous state if the observation has probability zero; compiled fleets cannot raise.
    possible = jnp.isfinite(own)
    state = jax.tree.map(partial(jnp.where, possible), learned, state._replace(program=program))
    return state, SessionInfo(**fields)


_IN_JAX = {"newton": newton, "exponentiated gradient": exponentiated}
Start = Callable[[Method, Array, LMEState], tuple]


def _begin(start: Start, method: Method, state: LMEState, demonstration: Demonstration) -> tuple:
    evidence = evidence_of(method.mdp, method.sensor, demonstration)
    seen = jnp.asarray(demonstration.kind) == SEEN_STEP
    key, fresh = jax.random.split(state.key)
    return evidence, seen, key, *start(method, fresh, state)


def _session(
    solver: str,
    start: Start,
    method: Method,
    alternation: Alternation,
    state: LMEState,
    demonstration: Demonstration,
) -> tuple[LMEState, SessionInfo]:
    """Learn from a session with a solver in JAX."""
    evidence, seen, key, weights, values = _begin(start, method, state, demonstration)
    ending = _em(
        method,
        _IN_JAX[solver],
        alternation,
        _Session(state.session + 1, state.statistic, evidence, seen),
        key,
        weights,
        values,
    )
    return _close(method, state, ending.point, state.program, ending.plan, ending.completed)


# Compiled once for all learners: the method's numbers are arguments.
_begun = jax.jit(_begin, static_argnums=0)
_learned = jax.jit(_session, static_argnums=(0, 1))


@jax.jit
def _expected(
    method: Method,
    state: LMEState,
    key: Array,
    weights: Float[Array, " K"],
    values: Float[Array, " S"],
    evidence: Evidence,
    seen: Bool[Array, "n L"],
) -> tuple:
    key, sample = jax.random.split(key)
    plan = method.plan(weights, values)
    working, own = method.working(state.statistic, sample, plan, evidence, seen)
    gradient = method.gradient(plan, working)
    return key, plan.values, own, gradient, working, *method.penalties(working, state.session + 1)


@jax.jit
def _closed(
    method: Method,
    state: LMEState,
    point: _Iterate,
    program: Any,
    evidence: Evidence,
    seen: Bool[Array, "n L"],
) -> tuple[LMEState, SessionInfo]:
    key, sample = jax.random.split(point.key)
    plan = method.plan(point.weights, point.values)
    completed = method.e_step(sample, plan, evidence, seen)
    return _close(method, state, point._replace(key=key), program, plan, completed)


@jax.jit
def _initial(method: Method, key: Array) -> LMEState:
    key, fresh = jax.random.split(key)
    weights = random_weights(fresh, method.mdp)
    empty = method.statistic.empty(method.mdp)
    return LMEState(weights, empty, jnp.zeros(method.mdp.n_states), (), jnp.zeros((), int), key)


@jax.jit
def _log_likelihood(method: Method, state: LMEState, weights: Float[Array, " K"]) -> Float[Array, ""]:
    values = method.plan(weights, state.values).values
    return method.statistic.log_likelihood(method.mdp, weights, values, state.statistic)


def _learner(
    name: str,
    method: Method,
    start: Start,
    solver: str,
    alternation: Alternation,
    configuration: Mapping[str, Any],
) -> Learner[LMEState, SessionInfo]:
    mdp = method.mdp
    iterations, tolerance, _ = alternation
    if solver not in (*_IN_JAX, "ipopt", "cvxpy"):
        raise ValueError(f"solver must be newton, ipopt, cvxpy or exponentiated gradient, got {solver!r}")
    if solver in ("cvxpy", "exponentiated gradient"):
        if method.statistic.name != "features":
            raise ValueError(f"the {solver} solver needs the features statistic, not {method.statistic.name}")
        if method.ridge > 0:
            raise ValueError(f"the {solver} solver has no ridge: use newton or ipopt with a prior")
    if iterations < 1:
        raise ValueError(f"a session needs at least one iteration, got {iterations}")

    run: Callable[[LMEState, Demonstration], tuple[LMEState, SessionInfo]]
    session = None
    if solver in _IN_JAX:
        session = partial(_session, solver, start, method, alternation)
        run = partial(_learned, solver, start, method, alternation)
        empty_program: Any = ()
    else:
        from ..programs.host import host_solver

        solve, empty_program = host_solver(mdp, solver, method.statistic.name)

        def run(state: LMEState, demonstration: Demonstration) -> tuple[LMEState, SessionInfo]:
            evidence, seen, key, weights, values = _begun(start, method, state, demonstration)
            program, total, steps, change, converged = state.program, 0, 0, np.inf, False
            first = jnp.array(jnp.nan)
            while steps < iterations and change > tolerance:
                key, values, own, gradient, working, slack, ridge = _expected(
                    method, state._replace(program=()), key, weights, values, evidence, seen
                )
                if not np.isfinite(own):  # no program to solve: update names the impossible step
                    break
                first = gradient if steps == 0 else first
                solution, program = solve(working, slack, ridge, program)
                change = float(relative_change(weights, jnp.asarray(solution.weights)))
                weights, values = jnp.asarray(solution.weights), jnp.asarray(solution.values)
                total, steps = total + int(solution.iterations), steps + 1
                converged = solution.converged
            counted = (
                jnp.array(change),
                first,
                jnp.array(steps),
                jnp.array(total),
                jnp.array(converged),
            )
            point = _Iterate(weights, values, *counted, key)
            return _closed(method, state, point, program, evidence, seen)

    def init(key: Array) -> LMEState:
        return _initial(method, as_key(key))._replace(program=empty_program)

    def update(state: LMEState, demonstration: Demonstration) -> tuple[LMEState, SessionInfo]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration, needed_by="a session")
        require_slack_in(method.slack, int(state.session) + 1)
        new, info = run(state, demonstration.bucketed())
        if not np.isfinite(info.demonstration_log_likelihood):
            require_possible(method.sensor, mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        return new, info.in_plain_numbers(time.perf_counter() - began)

    def log_likelihood(state: LMEState, weights: Float[Array, " K"]) -> float:
        return float(_log_likelihood(method, state, jnp.asarray(weights, float)))

    return Learner(name, mdp, configuration, init, update, session, log_likelihood)


# -- batch --------------------------------------------------------------------------------------------


@shown_briefly
class BatchFit(NamedTuple):
    """Result of batch LME.

    Fields
    ------
    weights : float ``[K]``
        Weights of the best restart.
    log_likelihood : float
        Exact log-likelihood of the demonstration, nats per trajectory.
    objective : float ``[restarts]``
        Penalised log-likelihood (per trajectory) at the end of each restart.
    iterations : int ``[restarts]``
        E- and M-steps of each restart.
    converged : bool ``[restarts]``
        True if the restart's last program met its tolerance.
    """

    weights: Float[np.ndarray, " K"]
    log_likelihood: float
    objective: Float[np.ndarray, " restarts"]
    iterations: Int[np.ndarray, " restarts"]
    converged: Bool[np.ndarray, " restarts"]


@shown_briefly
class Batch(NamedTuple):
    """Batch LME on one decision process; ``fit(key, demonstration)`` uses all trajectories at once."""

    name: str
    fit: Callable[[Array, Demonstration], BatchFit]


@partial(jax.jit, static_argnums=0)
def _fit(
    restarts: int, method: Method, alternation: Alternation, key: Array, demonstration: Demonstration
) -> tuple:
    mdp = method.mdp
    evidence = evidence_of(mdp, method.sensor, demonstration)
    seen = jnp.asarray(demonstration.kind) == SEEN_STEP
    session = _Session(jnp.ones((), int), method.statistic.empty(mdp), evidence, seen)

    def from_start(key: Array) -> tuple:
        weights = random_weights(key, mdp)
        ending = _em(method, newton, alternation, session, key, weights, jnp.zeros(mdp.n_states))
        point, expectations = ending.point, ending.completed.expectations
        size = jnp.maximum(expectations.size, 1.0)
        average = jnp.sum(expectations.log_likelihood) / size
        penalty = method.slack * jnp.sum(jnp.abs(point.weights))
        penalty += method.ridge / size / 2 * jnp.sum(point.weights**2)
        return point.weights, average, average - penalty, point.iterations, point.converged

    # One start after another: memory stays that of one, and no start waits for the slowest.
    return lax.map(from_start, jax.random.split(key, restarts))


def batch_lme(
    mdp: TabularMDP,
    sensor: AnySensor,
    *,
    restarts: int = 3,
    slack: float = DEFAULT_SLACK,
    ridge: float = 0.0,
    iterations: int = 500,
    tolerance: float = 1e-3,
) -> Batch:
    """Build batch latent maximum-entropy IRL: EM over all trajectories from random starts; the best wins.

    Parameters as for :func:`lme_i2rl`, except that ``slack`` is a number. ``fit`` raises
    :class:`DemonstrationError` for an impossible observation.

    See Also
    --------
    i2rl.inference.lme_i2rl : learns session by session
    i2rl.inference.sample_posterior : draws from the posterior

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import batch_lme
    >>> corridor = five_cells()
    >>> learner = batch_lme(corridor.mdp, corridor.sensor, restarts=1)
    >>> fit = learner.fit(jax.random.key(0), corridor.demonstration)
    >>> bool(fit.weights[0] > 0)  # the end is worth something
    True
    """
    require_discounted(mdp)
    if restarts < 1 or iterations < 1:
        raise ValueError(f"restarts and iterations must be at least 1, got {restarts} and {iterations}")
    if callable(slack):
        raise ValueError("batch learning has no sessions, so its slack must be a number, not a schedule")
    sensor = fitting_sensor(sensor, mdp)
    given, mdp = mdp, with_scaled_features(mdp)
    scale = np.asarray(feature_scale(given))
    method = checked_method(mdp, sensor, "counts", "exact", slack, ridge, 0)
    fit = partial(_fit, restarts, method, Alternation(iterations, tolerance))

    def checked(key: Array, demonstration: Demonstration) -> BatchFit:
        key = as_key(key)
        demonstration = checked_demonstration(mdp, demonstration, needed_by="batch learning")
        weights, average, objective, *counted = (np.asarray(x) for x in fit(key, demonstration.bucketed()))
        if not np.isfinite(objective).any():
            require_possible(sensor, mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under every start")
        best = int(np.nanargmax(objective))
        return BatchFit(weights[best] / scale, float(average[best]), objective, *counted)

    return Batch("batch LME", checked)
