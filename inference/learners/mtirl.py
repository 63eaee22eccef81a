"""Min-max-entropy multi-task IRL (chapter 5): several reward functions from one demonstration.

Batch and online. The number of components, the assignments, and the reward of each are learned together, by
the alternation of :mod:`~i2rl.inference.mixtures.fit`; :mod:`~i2rl.inference.programs.minmax` poses the same
program as one. The dissertation's printed gradient of the assignments cannot separate trajectories:
:mod:`~i2rl.inference.programs.printed.minmax` shows it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.observation.demonstration import Demonstration, DemonstrationError
from ...models.observation.evidence import (
    AnySensor,
    Sensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reachable_states, require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from ..completion.explanations import Trajectories, explain_each, is_seen_whole, seen_in_part, seen_whole
from ..mixtures.clustering import Clustering
from ..mixtures.fit import (
    Assigned,
    Kept,
    Mixture,
    MixtureProgram,
    assign,
    empty_mixture,
    log_policies,
    nothing_kept,
)
from ..mixtures.merging import Search, search
from ..sessions.learner import Learner, digest_of, in_plain_numbers
from ..sessions.scaling import on_scaled_features

DEFAULT_COMPONENTS = 4
DEFAULT_RESTARTS = 4
# Experts are nearly deterministic: a prior of scale 7 on each weight admits one error in a thousand choices.
DEFAULT_RIDGE = 0.02
_FEWEST_ROWS = 32


@shown_briefly
class MixtureState(NamedTuple):
    """State that online MME-MTIRL carries from session to session (section 5.2). Empty slots have no mass.

    Fields
    ------
    weights : float ``[D, K]``
        Reward weights of each component, ``theta_d``.
    values : float ``[D, S]``
        Their soft values, planning's warm start.
    proportions : float ``[D]``
        Mixture weights ``pi_d``.
    mass : float ``[D]``
        ``sum_i v_{d,i}`` over all trajectories so far; it sums to their number.
    visits : float ``[D, S, A]``
        ``sum_i v_{d,i} N_i(s, a)``, visits of seen steps. ``|X| phi_hat_d`` of Eq. 5.8 is its product with
        the features; adding to the two sums is Eq. 5.7 and 5.8.
    session : int
        Number of sessions so far.
    key : random key
    """

    weights: Float[Array, "D K"]
    values: Float[Array, "D S"]
    proportions: Float[Array, " D"]
    mass: Float[Array, " D"]
    visits: Float[Array, "D S A"]
    session: Int[Array, ""]
    key: Array


@shown_briefly
class MixtureInfo(NamedTuple):
    """Measures of a session; fields as in :class:`~i2rl.inference.SessionInfo`, unless stated otherwise.

    Fields
    ------
    session : int
    log_likelihood : float
        Log-likelihood of the carried statistic, in nats per trajectory, without dynamics: each trajectory
        under its own component, and the component under the proportions.
    demonstration_log_likelihood : float
        Exact log-likelihood of this session's trajectories under the mixture, dynamics included.
    gradient : float
        Norm over all components of the log-likelihood's gradient in scaled weights, at the session's first
        weights.
    iterations, solver_iterations : int
        Iterations of the alternation and of the programs' solver, in the selected start.
    converged : bool
        True if the programs of its last alternation met their tolerances.
    seconds : float
    weights : float ``[D, K]``
    proportions : float ``[D]``
        Zero for empty slots.
    n_components : int
        Number of components now.
    starts : int
        Number of starts tried; one if no new component could pay.
    assignments : int ``[n]``
        The likeliest component of each of this session's trajectories.
    responsibilities : float ``[n, D]``
    """

    session: int
    log_likelihood: float
    demonstration_log_likelihood: float
    gradient: float
    iterations: int
    solver_iterations: int
    converged: bool
    seconds: float
    weights: Float[np.ndarray, "D K"]
    proportions: Float[np.ndarray, " D"]
    n_components: int
    starts: int
    assignments: Int[np.ndarray, " n"]
    responsibilities: Float[np.ndarray, "n D"]


class MixtureSettings(NamedTuple):
    """Settings of MME-MTIRL, see :func:`mme_mtirl`."""

    n_components: int = DEFAULT_COMPONENTS
    strength: float = 1.0
    temperature: float = 0.5
    slack: float = 0.0
    ridge: float = DEFAULT_RIDGE
    restarts: int = DEFAULT_RESTARTS
    iterations: int = 50
    tolerance: float = 1e-6


class MixtureOptions(TypedDict, total=False):
    """:class:`MixtureSettings` as keyword arguments."""

    n_components: int
    strength: float
    temperature: float
    slack: float
    ridge: float
    restarts: int
    iterations: int
    tolerance: float


def mme_mtirl(
    mdp: TabularMDP,
    sensor: AnySensor | None = None,
    **settings: Unpack[MixtureOptions],
) -> Learner[MixtureState, MixtureInfo]:
    """Build online MME-MTIRL: a session learns from its trajectories and the statistic of earlier ones (5.2).

    A session first explains its trajectories by the known components. If their fit is so bad that a new
    component could pay for itself, the empty slots are tried too, so that a component that appears late is
    found.

    Parameters
    ----------
    mdp : TabularMDP
        The task without its reward; discount below 1.
    sensor : Imperfection, optional
        Visibility and noise; without it everything is seen.
    n_components : int
        Largest number of components at a time, ``D``; 4 by default.
    strength : float
        ``lambda`` of the entropic prior on the proportions, ``exp(-lambda H(pi))``: the min-entropy half of
        program (5.1). The default is the dissertation's, 1.
    temperature : float
        Weight of a nat of the assignments' entropy, in nats of likelihood; see
        :mod:`~i2rl.inference.mixtures.fit`. With 0.5 (the default) the mixture prefers several deterministic
        experts to one stochastic expert; use 1 (the likelihood itself) for stochastic experts.
    slack, ridge : float
        Rate of a Laplace and precision of a Gaussian prior on each scaled weight (nats in all, not per
        trajectory), the reward in nats that a feature adds at most (:mod:`~i2rl.models.process.units`).
        The defaults are 0 and 0.02.
    restarts : int
        Number of seedings of the empty slots; 4 by default.
    iterations, tolerance : int, float
        A climb ends after this number of alternations (50 by default), or when one gains less than
        ``tolerance`` nats (1e-6 by default).

    Returns
    -------
    Learner
        ``update(state, demonstration)`` returns a :class:`MixtureState` and a :class:`MixtureInfo`. It raises
        :class:`DemonstrationError` naming trajectory and step for an impossible observation, an unavailable
        action included; the given state stays valid.

    Raises
    ------
    ValueError
        For discount 1, fewer than one component, or settings that are negative or not finite.

    See Also
    --------
    i2rl.inference.batch_mme_mtirl : all trajectories at once
    i2rl.inference.lme_i2rl : one reward
    i2rl.inference.run_sessions : runs the sessions of a stream

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import mme_mtirl
    >>> corridor = five_cells()
    >>> learner = mme_mtirl(corridor.mdp, corridor.sensor, n_components=2, restarts=1, iterations=5)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> state.weights.shape, round(float(state.mass.sum()))  # every trajectory has its component
    ((2, 2), 8)
    """
    chosen = MixtureSettings(**settings)
    sensor = Sensor() if sensor is None else fitting_sensor(sensor, mdp)

    def build(mdp: TabularMDP) -> Learner[MixtureState, MixtureInfo]:
        program = _program(mdp, chosen)
        configuration = {**chosen._asdict(), "sensor": digest_of(sensor)}
        return _learner(program, sensor, chosen.n_components, chosen.restarts, configuration)

    return on_scaled_features(mdp, build)


def _learner(
    program: MixtureProgram,
    sensor: AnySensor,
    n_components: int,
    restarts: int,
    configuration: Mapping[str, Any],
) -> Learner[MixtureState, MixtureInfo]:
    mdp = program.mdp

    def session(state: MixtureState, demonstration: Demonstration) -> tuple[MixtureState, MixtureInfo]:
        trajectories = seen_in_part(mdp, sensor, demonstration)
        return _conclude(program, state, *_begin(program, state, trajectories, restarts, search))

    def init(key: Array) -> MixtureState:
        empty, kept = empty_mixture(mdp, n_components), nothing_kept(mdp, n_components)
        return MixtureState(*empty, *kept, jnp.zeros((), int), as_key(key))

    def update(state: MixtureState, demonstration: Demonstration) -> tuple[MixtureState, MixtureInfo]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration, needed_by="multi-task learning")
        rows = np.flatnonzero(demonstration.lengths)
        trajectories = _gather(mdp, sensor, demonstration)
        new, info = _concluded(program, state, *_begin(program, state, trajectories, restarts, _searched))
        if not np.isfinite(info.demonstration_log_likelihood):
            _explain_impossible(sensor, mdp, demonstration)
        info = info._replace(
            assignments=np.asarray(info.assignments)[rows],
            responsibilities=np.asarray(info.responsibilities)[rows],
        )
        return new, in_plain_numbers(info, time.perf_counter() - began)

    @jax.jit
    def likelihood(state: MixtureState, weights: Float[Array, "D K"]) -> Float[Array, ""]:
        return _kept_log_likelihood(mdp, state, weights)

    def log_likelihood(state: MixtureState, weights: Float[Array, "D K"]) -> float:
        return float(likelihood(state, jnp.asarray(weights, float)))

    return Learner(
        "online MME-MTIRL",
        mdp,
        configuration,
        init,
        update,
        session,
        log_likelihood,
    )


@shown_briefly
class BatchMixture(NamedTuple):
    """Batch multi-task IRL; ``fit(key, demonstration)`` uses all trajectories at once."""

    name: str
    fit: Callable[[Array, Demonstration], Clustering]


def batch_mme_mtirl(
    mdp: TabularMDP,
    sensor: AnySensor | None = None,
    **settings: Unpack[MixtureOptions],
) -> BatchMixture:
    """Build batch MME-MTIRL (section 5.1): the alternation from several seedings; the best is returned.

    Parameters as for :func:`mme_mtirl`. The :class:`Clustering` has the components, the largest first, and
    the min-max-entropy program's objective ``J``. With fewer trajectories than ``n_components`` there is a
    warning, and at most one component per trajectory. ``fit`` raises :class:`DemonstrationError` as
    :func:`mme_mtirl` does.

    See Also
    --------
    i2rl.inference.mme_mtirl : learns session by session
    i2rl.inference.sample_mixture_posterior : draws from the posterior of a mixture

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import batch_mme_mtirl
    >>> corridor = five_cells()
    >>> learner = batch_mme_mtirl(corridor.mdp, corridor.sensor, n_components=2, restarts=1, iterations=5)
    >>> found = learner.fit(jax.random.key(0), corridor.demonstration)
    >>> print(found.proportions.sum().round(6), found.assignments.shape)
    1.0 (8,)
    """
    chosen = MixtureSettings(**settings)
    n_components, restarts = chosen.n_components, chosen.restarts
    sensor = Sensor() if sensor is None else fitting_sensor(sensor, mdp)
    scale = np.asarray(feature_scale(mdp))
    mdp = with_scaled_features(mdp)
    program = _program(mdp, chosen)
    nothing, empty = nothing_kept(mdp, n_components), empty_mixture(mdp, n_components)

    def fit(key: Array, demonstration: Demonstration) -> Clustering:
        demonstration = checked_demonstration(mdp, demonstration, needed_by="multi-task learning")
        rows = np.flatnonzero(demonstration.lengths)
        if len(rows) < n_components:
            warnings.warn(
                f"`n_components` is {n_components}, but there are {len(rows)} trajectories: no more "
                "components than that can be found",
                stacklevel=2,
            )
        trajectories = _gather(mdp, sensor, demonstration)
        found = _searched(program, trajectories, nothing, empty, as_key(key), restarts).fit
        if not np.isfinite(found.objective):
            _explain_impossible(sensor, mdp, demonstration)
        proportions = np.asarray(found.mixture.proportions)
        order = np.argsort(-proportions, kind="stable")[: np.count_nonzero(proportions)]
        return Clustering(
            np.asarray(found.mixture.weights)[order] / scale,
            proportions[order],
            np.asarray(found.responsibilities)[rows][:, order],
            float(found.objective),
        )

    return BatchMixture("MME-MTIRL", fit)


def assign_trajectories(
    mdp: TabularMDP,
    sensor: AnySensor | None,
    weights: Float[np.ndarray, "D K"],
    proportions: Float[np.ndarray, " D"],
    demonstration: Demonstration,
) -> Float[np.ndarray, "n D"]:
    """Return the probability of each component for each trajectory, hidden steps summed out.

    It is Bayes' rule (temperature 1), for any trajectories. Raises as :func:`mme_mtirl`'s ``update`` does,
    and ``ValueError`` for weights that are not finite, proportions that are negative or all zero, or shapes
    that do not fit.
    """
    weights, proportions = np.asarray(weights, float), np.asarray(proportions, float)
    if weights.shape != (*proportions.shape, mdp.n_features) or weights.ndim != 2:
        raise ValueError(
            f"weights and proportions must have shapes [D, {mdp.n_features}] and [D], got "
            f"{list(weights.shape)} and {list(proportions.shape)}"
        )
    if not np.isfinite(weights).all():
        raise ValueError(f"weights must be finite, got {weights[~np.isfinite(weights)][0]}")
    if not (np.isfinite(proportions) & (proportions >= 0)).all() or not proportions.any():
        raise ValueError(f"proportions must be finite, not negative and not all zero, got {proportions}")
    sensor = Sensor() if sensor is None else fitting_sensor(sensor, mdp)
    demonstration = checked_demonstration(mdp, demonstration, needed_by="multi-task learning")
    rows = np.flatnonzero(demonstration.lengths)
    trajectories = _gather(mdp, sensor, demonstration)
    assigned = _assigned(mdp, jnp.asarray(weights), jnp.asarray(proportions), trajectories)
    if not np.isfinite(assigned.log_likelihood).all():
        _explain_impossible(sensor, mdp, demonstration)
    return np.asarray(assigned.responsibilities)[rows]


@jax.jit
def _assigned(
    mdp: TabularMDP, weights: Float[Array, "D K"], proportions: Float[Array, " D"], trajectories: Trajectories
) -> Assigned:
    policies, _ = log_policies(mdp, weights, jnp.zeros((len(weights), mdp.n_states)))
    return assign(
        explain_each(mdp, policies, trajectories).log_likelihood, proportions, trajectories.live, 1.0
    )


# -- building blocks ----------------------------------------------------------------------------------


def _program(mdp: TabularMDP, settings: MixtureSettings) -> MixtureProgram:
    n_components, strength, temperature, slack, ridge, restarts, iterations, tolerance = settings
    require_discounted(mdp)
    for name, number in (("n_components", n_components), ("restarts", restarts), ("iterations", iterations)):
        if not number >= 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
        if number != int(number):
            raise ValueError(f"{name} must be a whole number, got {number}")
    for name, value in (
        ("strength", strength),
        ("temperature", temperature),
        ("slack", slack),
        ("ridge", ridge),
    ):
        if not 0 <= value < float("inf"):
            raise ValueError(f"{name} must be finite and not negative, got {value}")
    if np.isnan(tolerance):
        raise ValueError("tolerance must be a number of nats, got nan")
    if temperature == 0:
        raise ValueError(
            "temperature must be more than zero: with 0 every trajectory would be its own component"
        )
    reachable = jnp.asarray(reachable_states(mdp))
    # Of one type whatever was given: 1 and 1.0 are different programs to the compiler.
    strength, slack, ridge, temperature = (float(x) for x in (strength, slack, ridge, temperature))
    return MixtureProgram(
        mdp, reachable, strength, slack, ridge, temperature, int(iterations), float(tolerance)
    )


_seen_whole, _seen_in_part = jax.jit(seen_whole), jax.jit(seen_in_part)


def _gather(mdp: TabularMDP, sensor: AnySensor, demonstration: Demonstration) -> Trajectories:
    padded, seen_by = demonstration.bucketed(), Sensor(sensor.visibility, sensor.noise)
    if not is_seen_whole(sensor, demonstration):
        return _seen_in_part(mdp, seen_by, padded)
    # Visits of a few trajectories more cost less than compiling for one shape more.
    rows = max(padded.n_trajectories, _FEWEST_ROWS)
    return _seen_whole(mdp, seen_by, padded.padded(rows, padded.kind.shape[1]))


def _explain_impossible(sensor: AnySensor, mdp: TabularMDP, demonstration: Demonstration) -> None:
    require_possible(sensor, mdp, demonstration)
    raise DemonstrationError("a trajectory has probability zero under every component")


# Compiled once for all learners of one shape of problem, batch and online.
_searched = jax.jit(search)


def _begin(
    program: MixtureProgram,
    state: MixtureState,
    trajectories: Trajectories,
    restarts: int,
    find: Callable[..., Search],
) -> tuple[Search, Array]:
    key, seed = jax.random.split(state.key)
    kept = Kept(state.mass, state.visits)
    mixture = Mixture(state.weights, state.values, state.proportions)
    return find(program, trajectories, kept, mixture, seed, restarts), key


def _kept_log_likelihood(
    mdp: TabularMDP, state: MixtureState, weights: Float[Array, "D K"]
) -> Float[Array, ""]:
    """Return the carried statistic's log-likelihood under these weights, in nats per trajectory."""
    policies, _ = log_policies(mdp, weights, state.values)
    done = jnp.sum(state.visits * jnp.where(mdp.available, policies, 0.0))
    chosen = state.mass @ jnp.log(jnp.where(state.proportions > 0, state.proportions, 1.0))
    return (done + chosen) / jnp.maximum(jnp.sum(state.mass), 1.0)


def _conclude(
    program: MixtureProgram, state: MixtureState, found: Search, key: Array
) -> tuple[MixtureState, MixtureInfo]:
    mdp, fit = program.mdp, found.fit
    mass = fit.kept.mass + jnp.sum(fit.responsibilities, axis=0)
    learned = MixtureState(*fit.mixture, mass, fit.kept.visits + fit.seen, state.session + 1, key)

    def known(weights: Float[Array, "D K"]) -> Float[Array, ""]:
        return _kept_log_likelihood(mdp, learned, weights)

    present = fit.mixture.proportions > 0
    own = jnp.sum(fit.log_likelihood)
    fields: dict[str, Any] = {
        "session": state.session + 1,
        "log_likelihood": known(fit.mixture.weights),
        "demonstration_log_likelihood": own,
        "gradient": jnp.linalg.norm(jax.grad(known)(state.weights)),
        "iterations": fit.iterations,
        "solver_iterations": fit.solver_iterations,
        "converged": fit.converged,
        "seconds": jnp.array(jnp.nan),
        "weights": fit.mixture.weights,
        "proportions": fit.mixture.proportions,
        "n_components": jnp.sum(present),
        "starts": found.tried,
        "assignments": jnp.argmax(fit.responsibilities, axis=1),
        "responsibilities": fit.responsibilities,
    }
    # Keep the previous state if the observation has probability zero; compiled fleets cannot raise.
    possible = jnp.isfinite(own)
    return jax.tree.map(partial(jnp.where, possible), learned, state), MixtureInfo(**fields)


_concluded = jax.jit(_conclude)
