"""Learning through noisy perception whose noise is not known: RIMEO (chapter 6.1), and its controls.

A session alternates three steps: the posterior over the truth behind every report, under the present reward
and the present reliabilities; the maximum-entropy observation program, whose expected agreement is that
posterior's; the maximum-entropy program of the reward. With a posterior in the place of the "estimated
ground truth" of Eq. 6.7 this is expectation-maximisation of the reports' likelihood. What is kept are
running averages (Eq. 6.9): expected visits, and expected agreement of reports with truths.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.arguments import as_key
from ...models.observation.demonstration import SEEN, Demonstration, DemonstrationError
from ...models.observation.evidence import (
    AnySensor,
    FeatureNoise,
    Sensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ..completion.smoothing import Evidence, smooth_all
from ..programs.dual import IpoptPoint
from ..programs.host import host_solver
from ..programs.maximum_entropy import WarmStart
from ..programs.observation import ObservationProgram, unidentified_predicates
from ..sensors.observations import report_classes, report_log_evidence
from ..sensors.reliabilities import (
    Perception,
    PreparedSession,
    WithTruth,
    coded_perception,
    counted_perception,
    entropic_perception,
    prepare,
    printed_perception,
)
from ..sessions.learner import Learner, digest_of, in_plain_numbers
from ..sessions.scaling import on_scaled_features
from ..sessions.schedule import Schedule, described, require_slack, require_slack_in
from ..sessions.statistic import blend, complete
from .alternation import Method, checked_method, newton, random_weights, relative_change
from .lme import Batch, batch_lme

Scores = Literal["stepwise", "averaged", "none"]
Truths = Literal["posterior", "observed", "oracle", "all"]

# Nats in all. Rewards that grow early decide what early reports are taken for.
DEFAULT_RIDGE = 0.05
# Reports in all, per predicate: agreement is learned as if a quarter of a report had been wrong.
DEFAULT_ERRORS = 0.25
# Sessions are small: of each, one or two alternations are enough, and more make too much of its guesses.
DEFAULT_ITERATIONS = 2
# Exponent by which early guesses are forgotten.
DEFAULT_FORGETTING = 0.8
# How often a predicate is thought to be reported rightly before the first session.
DEFAULT_START = 0.75


class RIMEOState(NamedTuple):
    """What RIMEO carries from session to session: ``(|Xi|, P*, phi_hat)`` and the reward.

    Fields
    ------
    weights : float ``[K]``
        The reward estimate.
    statistic : CountStatistic or FeatureStatistic
        Of the truths behind the reports.
    values : float ``[S]``
        Soft values of ``weights``: planning's warm start.
    logits : float ``[J]``
        Of the reliabilities ``P*``.
    reports : ReportStatistic or FrequencyStatistic
        Of the reports.
    program : tuple
        Warm starts of solvers outside JAX.
    session : int
    key : random key
    """

    weights: Float[Array, " K"]
    statistic: Any
    values: Float[Array, " S"]
    logits: Float[Array, " J"]
    reports: Any
    program: Any
    session: Int[Array, ""]
    key: Array


class RIMEOInfo(NamedTuple):
    """Numbers of a session, those of :class:`~i2rl.inference.SessionInfo` and of the sensor that was learned.

    Fields
    ------
    reliabilities : float ``[J]``
        ``p_j`` of Eq. 6.5: parameters, not frequencies.
    agreement : float ``[J]``
        How often each predicate of a report is expected to be that of the truth, over all reports so far.
    """

    session: int
    log_likelihood: float
    demonstration_log_likelihood: float
    gradient: float
    iterations: int
    solver_iterations: int
    converged: bool
    seconds: float
    weights: Float[np.ndarray, " K"]
    reliabilities: Float[np.ndarray, " J"]
    agreement: Float[np.ndarray, " J"]


def rimeo(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    view: AnySensor | None = None,
    reportable: ArrayLike | None = None,
    scores: Scores = "stepwise",
    truths: Truths = "posterior",
    unscored: bool = False,
    solver: str = "newton",
    statistic: str = "seen",
    slack: Schedule = 0.0,
    ridge: float = DEFAULT_RIDGE,
    errors: float = DEFAULT_ERRORS,
    start: ArrayLike = DEFAULT_START,
    forgetting: float = DEFAULT_FORGETTING,
    iterations: int = DEFAULT_ITERATIONS,
    tolerance: float = 1e-3,
    names: tuple[str, ...] | None = None,
) -> Learner:
    """Online IRL through perception whose noise is learned, too (Algorithm 2).

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process without its reward; discount below 1. Its start distribution matters: it is what
        the first report of a trajectory is weighed against.
    predicates : bool or int ``[J, S, A]``
        Features of a pair that perception may get wrong. What counts is whether a report has the same value
        as the truth, so a feature may be a label, such as the state: perception that is known by predicates
        alone is thought to mix up all that they do not tell apart.
    view : Imperfection, optional
        What is hidden (a ``Visibility``); everything is in view by default.
    reportable : bool ``[S, A]``, optional
        Which pairs perception may report; all by default.
    scores : {"stepwise", "averaged", "none"}
        Perception's probability of being right enters step by step, as the running average of each reported
        pair (Eq. 6.6), or not at all. An average forgets which report was the doubtful one, so the first is
        the default.
    truths : {"posterior", "observed", "oracle", "all"}
        What reports are compared with: the posterior over the truth; the report itself; what happened
        (sessions must then be :class:`WithTruth`); every pair alike, as Eq. 6.7 is printed.
    unscored : bool
        Allow reports without a score where ``scores`` are used: they tell of agreement as all reports do with
        ``scores="none"``.
    solver : {"newton", "ipopt"}
        Both programs in compiled JAX, or in CasADi, each started from its last solution.
    statistic, slack, ridge
        As for :func:`~i2rl.inference.lme_i2rl`.
    errors : float
        Slack of the observation program: expected agreement may be off by ``errors`` reports in all. It keeps
        a predicate that was never seen wrong from being thought infallible.
    start : float or float ``[J]``
        How often predicates are thought to be right before the first session.
    forgetting : float
        Exponent with which earlier sessions are kept, see :func:`~i2rl.inference.sessions.statistic.blend`.
    iterations, tolerance : int, float
        A session ends after so many alternations, or when no weight (relative to the largest) and no
        agreement moves by more than ``tolerance``.
    names : tuple of str, optional
        Of the predicates, for messages.

    Returns
    -------
    Learner
        Its ``update`` gives a :class:`RIMEOState` and a :class:`RIMEOInfo`. It raises
        :class:`DemonstrationError` naming trajectory and step for a report no truth could give, and for a
        score that is missing or outside [0, 1]; the state it was given stays valid.

    Raises
    ------
    ValueError
        For discount 1, predicates of the wrong shape, an unknown option, or settings out of range.

    Warns
    -----
    UserWarning
        Naming predicates that are the same for everything that can be reported, and so say nothing.

    See Also
    --------
    i2rl.inference.rifom : counts agreement instead
    i2rl.inference.robust_irl : the reliabilities are known
    i2rl.models.FeatureNoise : the sensor that is learned

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import rimeo
    >>> corridor = five_cells()
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> learner = rimeo(corridor.mdp, predicates, view=corridor.sensor, scores="none")
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.reliabilities.shape, bool((info.agreement > 0.5).all())  # mostly right
    ('RIMEO', (2,), True)
    """
    seen = _checked_view(mdp, view, slack)
    psi = _checked_predicates(mdp, predicates, reportable, names)
    for name, value, options in (
        ("scores", scores, ("stepwise", "averaged", "none")),
        ("truths", truths, ("posterior", "observed", "oracle", "all")),
        ("solver", solver, ("newton", "ipopt")),
    ):
        if value not in options:
            raise ValueError(f"{name} must be one of {', '.join(options)}, got {value!r}")
    if not 0 <= errors < np.inf:
        raise ValueError(f"errors must be a number of reports, not negative, got {errors}")
    classes = report_classes(psi, reportable)
    if truths == "all":
        if scores == "none":
            raise ValueError("the printed program (truths='all') is made of scores, got scores='none'")
        if psi.dtype != bool:
            raise ValueError("the printed program (truths='all') needs predicates that are true or false")
        perception = printed_perception(classes, psi, np.asarray(mdp.available))
    else:
        program = ObservationProgram(psi, reportable) if solver == "ipopt" else None
        perception = entropic_perception(classes, scores, truths, errors, forgetting, program)
    configuration = {
        "scores": scores, "truths": truths, "unscored": unscored, "solver": solver, "statistic": statistic,
        "slack": described(slack), "ridge": ridge, "errors": errors, "forgetting": forgetting,
        "start": np.asarray(start, float).tolist(), "iterations": iterations, "tolerance": tolerance,
        "view": digest_of(seen), "predicates": digest_of(_half_sure(psi, reportable)),
    }  # fmt: skip
    name = "RIMEO" if truths == "posterior" else f"RIMEO ({truths})"
    first_logits = initial_logits(psi, start)

    def build(mdp: TabularMDP) -> Learner:
        method = checked_method(mdp, seen, statistic, "exact", slack, ridge, 0)
        return _learner(
            name, method, perception, _half_sure(psi, reportable), configuration, first_logits,
            forgetting, iterations, tolerance, solver, scores != "none" and not unscored,
        )  # fmt: skip

    return on_scaled_features(mdp, build)


def rifom(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    form: Literal["fair", "coded"] = "fair",
    view: AnySensor | None = None,
    reportable: ArrayLike | None = None,
    statistic: str = "seen",
    slack: Schedule = 0.0,
    ridge: float = DEFAULT_RIDGE,
    forgetting: float = DEFAULT_FORGETTING,
    iterations: int = DEFAULT_ITERATIONS,
    tolerance: float = 1e-3,
    names: tuple[str, ...] | None = None,
) -> Learner:
    """RIFOM (section 7.3): RIMEO with reliabilities by counting, every report taken for the truth.

    ``form`` is ``"fair"`` (all steps, weighted by scores where there are any, Laplace-smoothed) or
    ``"coded"`` (as in the released program, see ``coded_perception``;
    predicates must then be true or false). Other parameters and errors as of :func:`rimeo`.

    See Also
    --------
    i2rl.inference.rimeo : infers the truth behind each observation
    i2rl.models.FeatureNoise : the sensor that is learned

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import rifom
    >>> corridor = five_cells()
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> learner = rifom(corridor.mdp, predicates, view=corridor.sensor)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.reliabilities.shape
    ('RIFOM (fair)', (2,))
    """
    seen = _checked_view(mdp, view, slack)
    psi = _checked_predicates(mdp, predicates, reportable, names)
    if form not in ("fair", "coded"):
        raise ValueError(f"form must be fair or coded, got {form!r}")
    if form == "coded" and psi.dtype != bool:
        raise ValueError("the released program's frequencies are of predicates that are true or false")
    ways = {"fair": counted_perception, "coded": coded_perception}
    perception = ways[form](report_classes(psi, reportable), psi)
    configuration = {
        "form": form, "statistic": statistic, "slack": described(slack), "ridge": ridge,
        "forgetting": forgetting,
        "iterations": iterations, "tolerance": tolerance, "view": digest_of(seen),
        "predicates": digest_of(_half_sure(psi, reportable)),
    }  # fmt: skip
    first_logits = initial_logits(psi, DEFAULT_START)

    def build(mdp: TabularMDP) -> Learner:
        method = checked_method(mdp, seen, statistic, "exact", slack, ridge, 0)
        return _learner(
            f"RIFOM ({form})", method, perception, _half_sure(psi, reportable), configuration,
            first_logits, forgetting, iterations, tolerance, "newton", False,
        )  # fmt: skip

    return on_scaled_features(mdp, build)


def robust_irl(mdp: TabularMDP, sensor: AnySensor, **options: Any) -> Batch:
    """Robust IRL (Eqs. 6.3 and 6.4): the sensor is known, and all trajectories are there at once.

    Batch latent maximum-entropy IRL under that sensor; options and errors as of
    :func:`~i2rl.inference.batch_lme`. Raises ``ValueError`` for a sensor without an observation model.

    See Also
    --------
    i2rl.inference.rimeo : learns the sensor, too
    i2rl.inference.batch_lme : the same program for any sensor

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import robust_irl
    >>> from i2rl.models import FeatureNoise
    >>> corridor = five_cells()
    >>> noise = FeatureNoise(np.indices((5, 3)), [0.9, 0.9])  # of the cell and of the action
    >>> learner = robust_irl(corridor.mdp, noise * corridor.sensor, restarts=1, iterations=20)
    >>> learner.fit(jax.random.key(0), corridor.demonstration).weights.shape
    (2,)
    """
    sensor = fitting_sensor(sensor, mdp)
    if sensor.noise is None:
        raise ValueError("robust IRL needs a sensor with an observation model; this one reports exactly")
    return batch_lme(mdp, sensor, **options)._replace(name="Robust IRL")


# -- building blocks ----------------------------------------------------------------------------------


def _checked_view(mdp: TabularMDP, view: AnySensor | None, slack: Schedule) -> AnySensor:
    require_discounted(mdp)
    require_slack(slack)
    seen = Sensor() if view is None else Sensor() * view
    if seen.noise is not None:
        raise ValueError("the view says what is hidden; how reports err is learned, not given")
    return fitting_sensor(seen, mdp)


def _checked_predicates(
    mdp: TabularMDP, predicates: ArrayLike, reportable: ArrayLike | None, names: tuple[str, ...] | None
) -> np.ndarray:
    psi = np.asarray(predicates)
    if psi.ndim != 3 or psi.shape[1:] != mdp.available.shape or not len(psi):
        raise ValueError(
            f"predicates have shape [J, S, A] = [J, {mdp.n_states}, {mdp.n_actions}], got {list(psi.shape)}"
        )
    if names is not None and len(names) != len(psi):
        raise ValueError(f"there is one name for each of {len(psi)} predicates, got {list(names)}")
    if psi.dtype != bool and np.isin(psi, (0, 1)).all():
        psi = psi.astype(bool)
    silent = unidentified_predicates(psi, reportable=reportable)
    if silent.uninformative:
        warnings.warn(silent._replace(groups=()).describe(names), stacklevel=3)
    return psi


def _half_sure(psi: np.ndarray, reportable: ArrayLike | None) -> FeatureNoise:
    """The sensor without what is to be learned: what can be reported at all does not depend on it."""
    return FeatureNoise(
        psi, np.full(len(psi), 0.5), None if reportable is None else np.asarray(reportable, bool)
    )


def initial_logits(psi: np.ndarray, start: ArrayLike) -> Float[Array, " J"]:
    """Logits that are right this often where every value of a predicate is equally common."""
    p = np.asarray(start, float)
    if p.shape not in ((), (len(psi),)):
        raise ValueError(
            f"start is one number, or one for each of {len(psi)} predicates, got {list(p.shape)}"
        )
    p = np.broadcast_to(p, (len(psi),))
    if not ((p > 0) & (p < 1)).all():
        raise ValueError(f"start is how often predicates are right, between 0 and 1, got {p.tolist()}")
    others = np.array([max(len(np.unique(values)) - 1, 1) for values in psi])
    return jnp.asarray(np.log(p) - np.log1p(-p) + np.log(others))


class _Point(NamedTuple):
    """One point of the alternation."""

    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    logits: Float[Array, " J"]
    agreement: Float[Array, " J"]
    change: Float[Array, ""]
    gradient: Float[Array, ""]
    iterations: Int[Array, ""]
    solver_iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class _Expected(NamedTuple):
    """What both programs are fitted to, and what the M-step needs besides."""

    reports: Any
    working: Any
    values: Float[Array, " S"]
    gradient: Float[Array, ""]
    own: Float[Array, ""]


class _Alternation(NamedTuple):
    """The parts of a session."""

    method: Method
    perception: Perception
    forgetting: float

    def prepare(self, state: RIMEOState, demonstration: Any) -> tuple[PreparedSession, Array]:
        session = prepare(self.method.mdp, self.perception.classes, demonstration, self.perception.scored)
        return session, self.perception.confidence(state.reports, session.reports)

    def first(self, state: RIMEOState) -> _Point:
        zero, far = jnp.zeros((), int), jnp.array(jnp.inf)
        unknown = jnp.full_like(state.logits, 2.0)
        unsolved = jnp.array(False)
        return _Point(state.weights, state.values, state.logits, unknown, far, far, zero, zero, unsolved)

    def complete(
        self, session: PreparedSession, confidence: Array, plan: Any, logits: Array
    ) -> tuple[Any, Any]:
        """The demonstration and its reports under a plan and reliabilities."""
        evidence = report_log_evidence(
            self.perception.classes, logits, session.reports, confidence, self.method.sensor.visibility
        )
        posterior = smooth_all(self.method.mdp, plan.log_policy, Evidence(evidence, session.live))
        completed = complete(self.method.mdp, posterior, session.live, session.reports.seen)
        return completed, self.perception.summarise(logits, session, confidence, posterior.pairs)

    def expect(
        self, state: RIMEOState, session: PreparedSession, confidence: Array, point: _Point
    ) -> _Expected:
        """The E-step."""
        mdp, statistic = self.method.mdp, self.method.statistic
        plan = self.method.plan(point.weights, point.values)
        completed, reports = self.complete(session, confidence, plan, point.logits)
        working = blend(state.statistic, statistic.of_session(mdp, plan, completed), self.forgetting)
        gradient = lax.cond(
            point.iterations == 0,
            lambda: self.method.gradient(point.weights, plan.values, working),
            lambda: point.gradient,
        )
        heard = self.perception.blend(state.reports, reports)
        own = jnp.sum(completed.expectations.log_likelihood)
        return _Expected(heard, working, plan.values, gradient, own)

    def advance(self, point: _Point, expected: _Expected, logits: Array, solution: Any) -> _Point:
        """The point after both M-steps."""
        agreement = self.perception.agreement(logits, expected.reports)
        # Before the first report there is no agreement that could move.
        moved = jnp.max(jnp.where(jnp.isnan(agreement), 0.0, jnp.abs(agreement - point.agreement)))
        weights = jnp.asarray(solution.weights)
        return _Point(
            weights, jnp.asarray(solution.values), logits, agreement,
            jnp.maximum(relative_change(point.weights, weights), moved), expected.gradient,
            point.iterations + 1,
            point.solver_iterations + solution.iterations, jnp.asarray(solution.converged),
        )  # fmt: skip

    def close(
        self, state: RIMEOState, session: PreparedSession, confidence: Array, point: _Point, program: Any
    ) -> tuple[RIMEOState, RIMEOInfo]:
        """End a session: complete it once more, under its own result, and keep the statistics."""
        mdp, statistic = self.method.mdp, self.method.statistic
        plan = self.method.plan(point.weights, point.values)
        completed, reports = self.complete(session, confidence, plan, point.logits)
        own = jnp.sum(completed.expectations.log_likelihood)
        kept = blend(state.statistic, statistic.to_keep(mdp, plan, completed), self.forgetting)
        heard = self.perception.blend(state.reports, reports)
        number = state.session + 1
        report: dict[str, Any] = {
            "session": number,
            "log_likelihood": statistic.log_likelihood(mdp, point.weights, plan.values, kept),
            "demonstration_log_likelihood": own,
            "gradient": point.gradient,
            "iterations": point.iterations,
            "solver_iterations": point.solver_iterations,
            "converged": point.converged,
            "seconds": jnp.array(jnp.nan),
            "weights": point.weights,
            "reliabilities": jax.nn.sigmoid(point.logits),
            "agreement": self.perception.agreement(point.logits, heard),
        }
        learned = RIMEOState(
            point.weights, kept, plan.values, point.logits, heard, program, number, state.key
        )
        # A report that cannot be must not spoil what was learned (a fleet raises nothing).
        possible = jnp.isfinite(own)
        spared = state._replace(program=program)
        return jax.tree.map(partial(jnp.where, possible), learned, spared), RIMEOInfo(**report)


def _learner(
    name: str,
    method: Method,
    perception: Perception,
    reporting: FeatureNoise,
    configuration: Mapping[str, Any],
    first_logits: Float[Array, " J"],
    forgetting: float,
    iterations: int,
    tolerance: float,
    solver: str,
    scores_needed: bool,
) -> Learner:
    if iterations < 1:
        raise ValueError(f"a session needs at least one iteration, got {iterations}")
    if not 0 < forgetting <= 1:
        raise ValueError(f"forgetting is an exponent in (0, 1], got {forgetting}")
    mdp = method.mdp
    parts = _Alternation(method, perception, forgetting)

    def session(state: RIMEOState, demonstration: Any) -> tuple[RIMEOState, RIMEOInfo]:
        prepared, confidence = parts.prepare(state, demonstration)

        def step(point: _Point) -> _Point:
            expected = parts.expect(state, prepared, confidence, point)
            slack, ridge = method.penalties(expected.working, state.session + 1)
            start = WarmStart(point.weights, expected.values)
            solution = newton(mdp, expected.working, slack, ridge, start)
            return parts.advance(point, expected, perception.fit(expected.reports, point.logits), solution)

        def unfinished(point: _Point) -> Array:
            return (point.change > tolerance) & (point.iterations < iterations)

        point = lax.while_loop(unfinished, step, parts.first(state))
        return parts.close(state, prepared, confidence, point, state.program)

    run: Callable[[RIMEOState, Any], tuple[RIMEOState, RIMEOInfo]]
    if solver == "newton":
        run, warm = jax.jit(session), ()
    else:
        run, warm = _outside(parts, iterations, tolerance)

    def init(key: Array) -> RIMEOState:
        key, fresh = jax.random.split(as_key(key))
        return RIMEOState(
            random_weights(fresh, mdp), method.statistic.empty(mdp), jnp.zeros(mdp.n_states), first_logits,
            perception.empty, warm, jnp.zeros((), int), key,
        )  # fmt: skip

    def update(state: RIMEOState, demonstration: Any) -> tuple[RIMEOState, RIMEOInfo]:
        began = time.perf_counter()
        seen = _checked_session(
            mdp, name, demonstration, scores_needed, configuration.get("truths") == "oracle"
        )
        if isinstance(demonstration, WithTruth):
            _require_truth(mdp, demonstration)
        require_slack_in(method.slack, int(state.session) + 1)
        heard = state
        if perception.hear is not None:
            heard = state._replace(reports=perception.hear(state.reports, seen))
        new, report = run(heard, demonstration.bucketed())
        if not np.isfinite(report.demonstration_log_likelihood):
            require_possible(reporting * method.sensor, mdp, seen)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        return new, in_plain_numbers(report, time.perf_counter() - began)

    @jax.jit
    def likelihood(state: RIMEOState, weights: Float[Array, " K"]) -> Float[Array, ""]:
        values = method.plan(weights, state.values).values
        return method.statistic.log_likelihood(mdp, weights, values, state.statistic)

    def log_likelihood(state: RIMEOState, weights: Float[Array, " K"]) -> float:
        return float(likelihood(state, jnp.asarray(weights, float)))

    compiled = solver == "newton" and perception.hear is None
    return Learner(
        name,
        mdp,
        configuration,
        init,
        update,  # type: ignore[arg-type]
        session if compiled else None,  # type: ignore[arg-type]
        log_likelihood,
    )


def _outside(
    parts: _Alternation, iterations: int, tolerance: float
) -> tuple[Callable[[RIMEOState, Any], tuple[RIMEOState, RIMEOInfo]], Any]:
    """A session whose two programs are solved by IPOPT, and its first warm starts."""
    method, perception = parts.method, parts.perception
    solve, empty = host_solver(method.mdp, "ipopt", method.statistic.name)
    opening, expect = jax.jit(parts.prepare), jax.jit(parts.expect)
    advance, closing = jax.jit(parts.advance), jax.jit(parts.close)

    def run(state: RIMEOState, demonstration: Any) -> tuple[RIMEOState, RIMEOInfo]:
        rewards, sensor = state.program
        state = state._replace(program=())
        prepared, confidence = opening(state, demonstration)
        point = parts.first(state)
        while point.iterations < iterations and point.change > tolerance:
            expected = expect(state, prepared, confidence, point)
            if not np.isfinite(expected.own):  # no program to solve: update says which step cannot be
                break
            slack, ridge = method.penalties(expected.working, state.session + 1)
            solution, rewards = solve(expected.working, slack, ridge, rewards)
            if perception.fit_outside is not None and expected.reports.size > 0:
                logits, sensor = perception.fit_outside(expected.reports, sensor)
            else:
                logits = perception.fit(expected.reports, point.logits)
            reward = WarmStart(jnp.asarray(solution.weights), jnp.asarray(solution.values))
            counted = jnp.asarray(solution.iterations), jnp.asarray(solution.converged)
            point = advance(point, expected, logits, _Solved(*reward, *counted))
        new, report = closing(state, prepared, confidence, point, ())
        return new._replace(program=(rewards, sensor)), report

    return run, (empty, IpoptPoint(np.zeros(0), np.zeros(0), np.zeros(0)))


class _Solved(NamedTuple):
    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def _checked_session(
    mdp: TabularMDP, name: str, demonstration: Any, scores_needed: bool, truth_needed: bool
) -> Demonstration:
    """What was seen, with the scores that are needed."""
    if truth_needed != isinstance(demonstration, WithTruth):
        given = type(demonstration).__name__
        raise TypeError(
            f"{name} takes {'WithTruth(seen, truth)' if truth_needed else 'a Demonstration'}, got {given}"
        )
    given = demonstration.seen if truth_needed else demonstration
    seen = checked_demonstration(mdp, given, needed_by="a session")
    missing = (seen.kind == SEEN) & np.isnan(seen.score)
    if scores_needed and missing.any():
        i, t = np.argwhere(missing)[0]
        raise DemonstrationError(
            f"trajectory {i}, step {t}: the report has no score; learn without scores (scores='none') or "
            "allow reports without one (unscored=True)"
        )
    return seen


def _require_truth(mdp: TabularMDP, demonstration: WithTruth) -> None:
    """Raise :class:`DemonstrationError` unless what happened is known wherever something was reported."""
    seen, truth = demonstration
    if np.shape(truth.kind) != np.shape(seen.kind):
        raise DemonstrationError(
            f"what happened and what was seen are arrays of one shape, got {list(np.shape(truth.kind))} and "
            f"{list(np.shape(seen.kind))}"
        )
    states, actions = np.asarray(truth.state), np.asarray(truth.action)
    known = (states >= 0) & (states < mdp.n_states) & (actions >= 0) & (actions < mdp.n_actions)
    missing = (np.asarray(seen.kind) == SEEN) & ~known
    if missing.any():
        i, t = np.argwhere(missing)[0]
        raise DemonstrationError(
            f"trajectory {i}, step {t}: what happened must be a pair of the MDP, "
            f"got state {states[i, t]}, action {actions[i, t]}"
        )
