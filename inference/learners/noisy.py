"""Learning under unknown noise of the sensor: RIMEO (chapter 6.1), and its controls.

A session alternates three steps: the posterior over the truth behind every observation, under the current
reward and reliabilities; the maximum-entropy observation program, whose expected agreement is that
posterior's; the maximum-entropy program of the reward. With a posterior instead of the "estimated ground
truth" of Eq. 6.7 this is expectation-maximisation of the observations' likelihood. Sessions carry running
averages (Eq. 6.9): expected visits, and expected agreement of observations with truths.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
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
from .alternation import Alternation, Method, checked_method, newton, random_weights, relative_change
from .lme import Batch, batch_lme

Scores = Literal["stepwise", "averaged", "none"]
Completions = Literal["posterior", "observed", "oracle", "all"]

# Nats in all. Rewards that grow early bias the interpretation of early observations.
DEFAULT_RIDGE = 0.05
# Number of observations, per predicate: agreement is learned as if a quarter of one had been wrong.
DEFAULT_OBSERVATION_SLACK = 0.25
# Sessions are small: one or two alternations are enough for each, and more overfit their completions.
DEFAULT_ITERATIONS = 2
# Exponent of forgetting early completions.
DEFAULT_FORGETTING = 0.8
# Assumed agreement of a predicate before the first session.
DEFAULT_START = 0.75


@shown_briefly
class RIMEOState(NamedTuple):
    """State that RIMEO carries from session to session: ``(|Xi|, P*, phi_hat)`` and the reward.

    Fields
    ------
    weights : float ``[K]``
        The reward estimate.
    statistic : CountStatistic or FeatureStatistic
        Statistic of the truths behind the observations.
    values : float ``[S]``
        Soft values of ``weights``, planning's warm start.
    logits : float ``[J]``
        Logits of the reliabilities ``P*``.
    observation_statistic : ReportStatistic or FrequencyStatistic
        Statistic of the observations.
    program : tuple
        Warm starts of solvers outside JAX.
    session : int
    key : random key
    """

    weights: Float[Array, " K"]
    statistic: Any
    values: Float[Array, " S"]
    logits: Float[Array, " J"]
    observation_statistic: Any
    program: Any
    session: Int[Array, ""]
    key: Array


@shown_briefly
class RIMEOInfo(NamedTuple):
    """Measures of a session, those of :class:`~i2rl.inference.SessionInfo` and of the learned sensor.

    Fields
    ------
    reliabilities : float ``[J]``
        ``p_j`` of Eq. 6.5: parameters, not frequencies.
    agreement : float ``[J]``
        Expected agreement of each predicate with the truth, over all observations so far.
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


@shown_briefly
class RIFOMSettings(NamedTuple):
    """Settings of the predicates and of the alternation, see :func:`rimeo`."""

    reportable: ArrayLike | None = None
    names: tuple[str, ...] | None = None
    forgetting: float = DEFAULT_FORGETTING
    iterations: int = DEFAULT_ITERATIONS
    tolerance: float = 1e-3


class RIFOMOptions(TypedDict, total=False):
    """:class:`RIFOMSettings` as keyword arguments."""

    reportable: ArrayLike | None
    names: tuple[str, ...] | None
    forgetting: float
    iterations: int
    tolerance: float


@shown_briefly
class RIMEOSettings(NamedTuple):
    """Settings of the predicates, of the comparison of observations, and of the alternation."""

    reportable: ArrayLike | None = None
    names: tuple[str, ...] | None = None
    forgetting: float = DEFAULT_FORGETTING
    iterations: int = DEFAULT_ITERATIONS
    tolerance: float = 1e-3
    scores: Scores = "stepwise"
    completion: Completions = "posterior"
    unscored: bool = False
    observation_slack: float = DEFAULT_OBSERVATION_SLACK
    start: ArrayLike = DEFAULT_START


class RIMEOOptions(RIFOMOptions, total=False):
    """:class:`RIMEOSettings` as keyword arguments."""

    scores: Scores
    completion: Completions
    unscored: bool
    observation_slack: float
    start: ArrayLike


def rimeo(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    visibility: AnySensor | None = None,
    solver: str = "newton",
    statistic: str = "seen",
    slack: Schedule = 0.0,
    ridge: float = DEFAULT_RIDGE,
    **settings: Unpack[RIMEOOptions],
) -> Learner[RIMEOState, RIMEOInfo]:
    """Build online IRL that also learns the sensor's noise (Algorithm 2).

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process without its reward; discount below 1. Its start distribution matters: it is the
        prior of a trajectory's first observation.
    predicates : bool or int ``[J, S, A]``
        Features of a pair that perception may get wrong. Only the equality of an observation's and the
        truth's value counts, so a feature may be a label, such as the state. With predicates alone,
        perception may confuse all pairs that they do not distinguish.
    visibility : Sensor, optional
        A ``Visibility``; everything is in view by default.
    solver : {"newton", "ipopt"}
        Both programs in compiled JAX, or in CasADi, each started from its last solution.
    statistic, slack, ridge
        As for :func:`~i2rl.inference.lme_i2rl`.
    reportable : bool ``[S, A]``, optional
        Pairs that perception may report; all by default.
    scores : {"stepwise", "averaged", "none"}
        Perception's probability of being right enters step by step, as the running average of each observed
        pair (Eq. 6.6), or not at all. An average does not say which observation was doubtful, so the first is
        the default.
    completion : {"posterior", "observed", "oracle", "all"}
        Truths to compare observations with: the posterior over the truth; the observation itself; the actual
        truth (sessions must then be :class:`WithTruth`); every pair alike, as Eq. 6.7 is printed.
    unscored : bool
        Allow observations without a score if ``scores`` are used: they inform agreement as all observations
        do with ``scores="none"``; False by default.
    observation_slack : float
        Slack of the observation program: expected agreement may be off by this number of observations in all
        (0.25 by default). It keeps the reliability of a predicate that was never wrong below one.
    start : float or float ``[J]``
        Assumed agreement of the predicates before the first session; 0.75 by default.
    forgetting : float
        Exponent of the weight of earlier sessions (0.8 by default), see
        :func:`~i2rl.inference.sessions.statistic.blend`.
    iterations, tolerance : int, float
        A session ends after this number of alternations (2 by default), or when no weight (relative to the
        largest) and no agreement moves by more than ``tolerance`` (1e-3 by default).
    names : tuple of str, optional
        Names of the predicates, for messages.

    Returns
    -------
    Learner
        Its ``update`` returns a :class:`RIMEOState` and a :class:`RIMEOInfo`. It raises
        :class:`DemonstrationError` naming trajectory and step for an impossible observation, and for a score
        that is missing or outside [0, 1]; the given state stays valid.

    Raises
    ------
    ValueError
        For discount 1, predicates of the wrong shape, an unknown option, or settings out of range.

    Warns
    -----
    UserWarning
        Naming predicates with one value on all reportable pairs, which carry no information.

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
    >>> learner = rimeo(corridor.mdp, predicates, visibility=corridor.sensor, scores="none")
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.reliabilities.shape, bool((info.agreement > 0.5).all())  # mostly right
    ('RIMEO', (2,), True)
    """
    chosen = RIMEOSettings(**settings)
    reportable, names, forgetting, iterations, tolerance = chosen[:5]
    scores, completion, unscored, observation_slack, start = chosen[5:]
    seen = _checked_view(mdp, visibility, slack)
    psi = _checked_predicates(mdp, predicates, reportable, names)
    for name, value, options in (
        ("scores", scores, ("stepwise", "averaged", "none")),
        ("completion", completion, ("posterior", "observed", "oracle", "all")),
        ("solver", solver, ("newton", "ipopt")),
    ):
        if value not in options:
            raise ValueError(f"{name} must be one of {', '.join(options)}, got {value!r}")
    if not 0 <= observation_slack < np.inf:
        raise ValueError(f"errors must be a number of reports, not negative, got {observation_slack}")
    classes = report_classes(psi, reportable)
    if completion == "all":
        if scores == "none":
            raise ValueError("the printed program (completion='all') is made of scores, got scores='none'")
        if psi.dtype != bool:
            raise ValueError("the printed program (completion='all') needs predicates that are true or false")
        perception = printed_perception(classes, psi, np.asarray(mdp.available))
    else:
        program = ObservationProgram(psi, reportable) if solver == "ipopt" else None
        perception = entropic_perception(classes, scores, completion, observation_slack, forgetting, program)
    configuration = {
        "scores": scores,
        "completion": completion,
        "unscored": unscored,
        "solver": solver,
        "statistic": statistic,
        "slack": described(slack),
        "ridge": ridge,
        "observation_slack": observation_slack,
        "forgetting": forgetting,
        "start": np.asarray(start, float).tolist(),
        "iterations": iterations,
        "tolerance": tolerance,
        "visibility": digest_of(seen),
        "predicates": digest_of(_half_sure(psi, reportable)),
    }
    name = "RIMEO" if completion == "posterior" else f"RIMEO ({completion})"
    first_logits = initial_logits(psi, start)

    def build(mdp: TabularMDP) -> Learner[RIMEOState, RIMEOInfo]:
        method = checked_method(mdp, seen, statistic, "exact", slack, ridge, 0)
        return _learner(
            name,
            method,
            _Sensing(
                perception, _half_sure(psi, reportable), first_logits, scores != "none" and not unscored
            ),
            configuration,
            forgetting,
            Alternation(iterations, tolerance),
            solver,
        )

    return on_scaled_features(mdp, build)


def rifom(
    mdp: TabularMDP,
    predicates: ArrayLike,
    *,
    form: Literal["fair", "coded"] = "fair",
    visibility: AnySensor | None = None,
    statistic: str = "seen",
    slack: Schedule = 0.0,
    ridge: float = DEFAULT_RIDGE,
    **settings: Unpack[RIFOMOptions],
) -> Learner[RIMEOState, RIMEOInfo]:
    """Build RIFOM (section 7.3): RIMEO with reliabilities by counting and observations taken for the truth.

    ``form`` is ``"fair"`` (all steps, weighted by scores if there are any, Laplace-smoothed) or ``"coded"``
    (as in the released program, see ``coded_perception``; predicates must then be true or false). Other
    parameters and errors as for :func:`rimeo`.

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
    >>> learner = rifom(corridor.mdp, predicates, visibility=corridor.sensor)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.reliabilities.shape
    ('RIFOM (fair)', (2,))
    """
    reportable, names, forgetting, iterations, tolerance = RIFOMSettings(**settings)
    seen = _checked_view(mdp, visibility, slack)
    psi = _checked_predicates(mdp, predicates, reportable, names)
    if form not in ("fair", "coded"):
        raise ValueError(f"form must be fair or coded, got {form!r}")
    if form == "coded" and psi.dtype != bool:
        raise ValueError("the released program's frequencies are of predicates that are true or false")
    ways = {"fair": counted_perception, "coded": coded_perception}
    perception = ways[form](report_classes(psi, reportable), psi)
    configuration = {
        "form": form,
        "statistic": statistic,
        "slack": described(slack),
        "ridge": ridge,
        "forgetting": forgetting,
        "iterations": iterations,
        "tolerance": tolerance,
        "visibility": digest_of(seen),
        "predicates": digest_of(_half_sure(psi, reportable)),
    }
    first_logits = initial_logits(psi, DEFAULT_START)

    def build(mdp: TabularMDP) -> Learner[RIMEOState, RIMEOInfo]:
        method = checked_method(mdp, seen, statistic, "exact", slack, ridge, 0)
        return _learner(
            f"RIFOM ({form})",
            method,
            _Sensing(perception, _half_sure(psi, reportable), first_logits, scores_needed=False),
            configuration,
            forgetting,
            Alternation(iterations, tolerance),
            "newton",
        )

    return on_scaled_features(mdp, build)


def robust_irl(mdp: TabularMDP, sensor: AnySensor, **options: Any) -> Batch:
    """Build robust IRL (Eqs. 6.3 and 6.4): a known sensor, and all trajectories at once.

    Batch latent maximum-entropy IRL under that sensor; options and errors as for
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


def _checked_view(mdp: TabularMDP, visibility: AnySensor | None, slack: Schedule) -> AnySensor:
    require_discounted(mdp)
    require_slack(slack)
    seen = Sensor() if visibility is None else Sensor() * visibility
    if seen.noise is not None:
        raise ValueError("the visibility says what is hidden; how reports err is learned, not given")
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
    """Build the sensor with reliabilities of one half: the reportable pairs do not depend on them."""
    return FeatureNoise(
        psi, np.full(len(psi), 0.5), None if reportable is None else np.asarray(reportable, bool)
    )


def initial_logits(psi: np.ndarray, start: ArrayLike) -> Float[Array, " J"]:
    """Return logits with agreement ``start`` if every value of a predicate is equally common."""
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
    """Targets of both programs, and further arguments of the M-step."""

    observation_statistic: Any
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
        return session, self.perception.confidence(state.observation_statistic, session.observations)

    def first(self, state: RIMEOState) -> _Point:
        zero, far = jnp.zeros((), int), jnp.array(jnp.inf)
        unknown = jnp.full_like(state.logits, 2.0)
        unsolved = jnp.array(False)
        return _Point(state.weights, state.values, state.logits, unknown, far, far, zero, zero, unsolved)

    def complete(
        self, session: PreparedSession, confidence: Array, plan: Any, logits: Array
    ) -> tuple[Any, Any]:
        """Complete the demonstration and its observations under a plan and reliabilities."""
        evidence = report_log_evidence(
            self.perception.classes, logits, session.observations, confidence, self.method.sensor.visibility
        )
        posterior = smooth_all(self.method.mdp, plan.log_policy, Evidence(evidence, session.live))
        completed = complete(self.method.mdp, posterior, session.live, session.observations.seen)
        return completed, self.perception.summarise(logits, session, confidence, posterior.pairs)

    def expect(
        self, state: RIMEOState, session: PreparedSession, confidence: Array, point: _Point
    ) -> _Expected:
        """Run the E-step."""
        mdp, statistic = self.method.mdp, self.method.statistic
        plan = self.method.plan(point.weights, point.values)
        completed, observed = self.complete(session, confidence, plan, point.logits)
        working = blend(state.statistic, statistic.of_session(mdp, plan, completed), self.forgetting)
        gradient = lax.cond(
            point.iterations == 0,
            lambda: self.method.gradient(plan, working),
            lambda: point.gradient,
        )
        heard = self.perception.blend(state.observation_statistic, observed)
        own = jnp.sum(completed.expectations.log_likelihood)
        return _Expected(heard, working, plan.values, gradient, own)

    def advance(self, point: _Point, expected: _Expected, logits: Array, solution: Any) -> _Point:
        """Return the point after both M-steps."""
        agreement = self.perception.agreement(logits, expected.observation_statistic)
        # Before the first observation no agreement can move.
        moved = jnp.max(jnp.where(jnp.isnan(agreement), 0.0, jnp.abs(agreement - point.agreement)))
        weights = jnp.asarray(solution.weights)
        return _Point(
            weights,
            jnp.asarray(solution.values),
            logits,
            agreement,
            jnp.maximum(relative_change(point.weights, weights), moved),
            expected.gradient,
            point.iterations + 1,
            point.solver_iterations + solution.iterations,
            jnp.asarray(solution.converged),
        )

    def close(
        self, state: RIMEOState, session: PreparedSession, confidence: Array, point: _Point, program: Any
    ) -> tuple[RIMEOState, RIMEOInfo]:
        """End a session: complete it once more, under its own result, and update the statistics."""
        mdp, statistic = self.method.mdp, self.method.statistic
        plan = self.method.plan(point.weights, point.values)
        completed, observed = self.complete(session, confidence, plan, point.logits)
        own = jnp.sum(completed.expectations.log_likelihood)
        kept = blend(state.statistic, statistic.to_keep(mdp, plan, completed), self.forgetting)
        heard = self.perception.blend(state.observation_statistic, observed)
        number = state.session + 1
        info: dict[str, Any] = {
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
        # Keep the previous state if the observation has probability zero; compiled fleets cannot raise.
        possible = jnp.isfinite(own)
        spared = state._replace(program=program)
        return jax.tree.map(partial(jnp.where, possible), learned, spared), RIMEOInfo(**info)


class _Sensing(NamedTuple):
    """The learned perception, the sensor that bounds it, its first logits, and its need of scores."""

    perception: Perception
    reporting: FeatureNoise
    first_logits: Float[Array, " J"]
    scores_needed: bool


def _learner(
    name: str,
    method: Method,
    sensing: _Sensing,
    configuration: Mapping[str, Any],
    forgetting: float,
    alternation: Alternation,
    solver: str,
) -> Learner[RIMEOState, RIMEOInfo]:
    perception, reporting, first_logits, scores_needed = sensing
    iterations, tolerance, _ = alternation
    if iterations < 1:
        raise ValueError(f"a session needs at least one iteration, got {iterations}")
    if not 0 < forgetting <= 1:
        raise ValueError(f"forgetting must be an exponent in (0, 1], got {forgetting}")
    mdp = method.mdp
    parts = _Alternation(method, perception, forgetting)

    def session(state: RIMEOState, demonstration: Any) -> tuple[RIMEOState, RIMEOInfo]:
        prepared, confidence = parts.prepare(state, demonstration)

        def step(point: _Point) -> _Point:
            expected = parts.expect(state, prepared, confidence, point)
            slack, ridge = method.penalties(expected.working, state.session + 1)
            start = WarmStart(point.weights, expected.values)
            solution = newton(mdp, expected.working, slack, ridge, start)
            return parts.advance(
                point, expected, perception.fit(expected.observation_statistic, point.logits), solution
            )

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
            random_weights(fresh, mdp),
            method.statistic.empty(mdp),
            jnp.zeros(mdp.n_states),
            first_logits,
            perception.empty,
            warm,
            jnp.zeros((), int),
            key,
        )

    def update(state: RIMEOState, demonstration: Any) -> tuple[RIMEOState, RIMEOInfo]:
        began = time.perf_counter()
        seen = _checked_session(
            mdp, name, demonstration, scores_needed, configuration.get("completion") == "oracle"
        )
        if isinstance(demonstration, WithTruth):
            _require_truth(mdp, demonstration)
        require_slack_in(method.slack, int(state.session) + 1)
        heard = state
        if perception.hear is not None:
            heard = state._replace(observation_statistic=perception.hear(state.observation_statistic, seen))
        new, info = run(heard, demonstration.bucketed())
        if not np.isfinite(info.demonstration_log_likelihood):
            require_possible(reporting * method.sensor, mdp, seen)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        return new, in_plain_numbers(info, time.perf_counter() - began)

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
        update,
        session if compiled else None,
        log_likelihood,
    )


def _outside(
    parts: _Alternation, iterations: int, tolerance: float
) -> tuple[Callable[[RIMEOState, Any], tuple[RIMEOState, RIMEOInfo]], Any]:
    """Build a session whose two programs are solved by IPOPT, and its first warm starts."""
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
            if not np.isfinite(expected.own):  # no program to solve: update names the impossible step
                break
            slack, ridge = method.penalties(expected.working, state.session + 1)
            solution, rewards = solve(expected.working, slack, ridge, rewards)
            if perception.fit_outside is not None and expected.observation_statistic.size > 0:
                logits, sensor = perception.fit_outside(expected.observation_statistic, sensor)
            else:
                logits = perception.fit(expected.observation_statistic, point.logits)
            reward = WarmStart(jnp.asarray(solution.weights), jnp.asarray(solution.values))
            counted = jnp.asarray(solution.iterations), jnp.asarray(solution.converged)
            point = advance(point, expected, logits, _Solved(*reward, *counted))
        new, info = closing(state, prepared, confidence, point, ())
        return new._replace(program=(rewards, sensor)), info

    return run, (empty, IpoptPoint(np.zeros(0), np.zeros(0), np.zeros(0)))


class _Solved(NamedTuple):
    weights: Float[Array, " K"]
    values: Float[Array, " S"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def _checked_session(
    mdp: TabularMDP, name: str, demonstration: Any, scores_needed: bool, truth_needed: bool
) -> Demonstration:
    """Check a session's demonstration and its scores."""
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
    """Raise :class:`DemonstrationError` unless the truth of every observed step is known."""
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
