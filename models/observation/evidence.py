"""Sensors as evidence about hidden state-action pairs.

A sensor turns the observation of a step into ``e_t(s, a)``, the probability of that observation if the
truth were ``(s, a)``. It has two factors: its *visibility* is the probability that a step is in view, and
its *noise* is the distribution of the observation of a step in view. Sensors supply one factor or both and
compose with ``*``.
"""

from __future__ import annotations

from inspect import getattr_static
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ..inputs.arguments import as_key, concrete, described, is_traced, rebuilt_unchecked
from ..inputs.display import shown_briefly
from ..inputs.probabilities import normalised, sum_tolerance
from ..process.mdp import PairNames, TabularMDP
from .demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN, Demonstration, DemonstrationError


class AnySensor(Protocol):
    """Any object that turns observations into evidence; methods treat all of them alike."""

    @property
    def visibility(self) -> Float[Array, " S"] | None:
        """Probability that a step in each state is in view; None means always."""

    @property
    def noise(self) -> ObservationModel | None:
        """Distribution of the observation of a step in view; None means exactly the truth."""


class _Composable:
    """Base of sensors that compose with ``*``."""

    def __mul__(self: AnySensor, other: AnySensor) -> Sensor:
        other = as_sensor(other)
        if self.noise is not None and other.noise is not None:
            raise ValueError("a sensor has one noise: two observation models cannot be multiplied")
        if self.visibility is None or other.visibility is None:
            visibility = self.visibility if other.visibility is None else other.visibility
        else:
            if self.visibility.shape != other.visibility.shape:
                raise ValueError(
                    f"views must be of one number of states to be multiplied; got shapes "
                    f"{self.visibility.shape} and {other.visibility.shape}"
                )
            visibility = self.visibility * other.visibility
        return Sensor._make((visibility, self.noise if other.noise is None else other.noise))


class _SensorFields(NamedTuple):
    visibility: Float[Array, " S"] | None = None
    noise: ObservationModel | None = None


@shown_briefly
@rebuilt_unchecked
class Sensor(_Composable, _SensorFields):  # type: ignore[misc]
    """A product of visibility and noise; ``Sensor()`` sees everything exactly.

    ``visibility`` and ``noise`` may also be sensors that have one. Raises ``ValueError`` for a visibility
    outside [0, 1] and ``TypeError`` for noise that is not an observation model.
    """

    __slots__ = ()

    def __new__(cls, visibility: Any = None, noise: Any = None) -> Sensor:
        """Check and convert; see the class."""
        if visibility is not None:
            visibility = (
                visibility.visibility if _is_sensor(visibility) else _checked_view("visibility", visibility)
            )
        if noise is not None and not hasattr(noise, "log_likelihood"):
            if not _is_sensor(noise):
                raise TypeError(f"noise must be an ObservationModel or None; got {described(noise)}")
            noise = noise.noise
        return super().__new__(cls, visibility, noise)


def _is_sensor(given: Any) -> bool:
    # Looked up statically: a sensor may compute its noise, a large table, whenever the attribute is read.
    missing = object()
    return not isinstance(given, type) and not any(
        getattr_static(given, name, missing) is missing for name in ("visibility", "noise")
    )


def as_sensor(given: Any) -> AnySensor:
    """Take a sensor, or make a :class:`Visibility` from a mask of the states in view.

    Raises ``TypeError`` for anything else and ``ValueError`` for a mask outside [0, 1].

    Examples
    --------
    >>> as_sensor([True, False, True])
    Visibility(in_view=[1, 0, 1])
    """
    if _is_sensor(given):
        return given
    plain = isinstance(given, list | tuple) and not hasattr(given, "_fields")
    if plain or hasattr(given, "__array__"):
        mask = concrete("sensor", given, None)
        if mask is None or (mask.ndim == 1 and mask.dtype.kind in "bf"):
            return Visibility(given)
    raise TypeError(
        "sensor must be a Visibility, an ObservationModel, another sensor or a product of them, or a "
        f"boolean mask [S] of the states in view; Sensor() sees everything; got {described(given)}"
    )


def _checked_view(name: str, given: Any) -> Float[Array, " S"]:
    array = concrete(name, given)
    if array is None:
        return jnp.asarray(given, float)
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape [S], got {array.shape}")
    wrong = ~((array >= 0) & (array <= 1))
    if wrong.any():
        s = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"{name} must be a mask or probabilities in [0, 1]; that of state {s} is {array[s]}")
    return jnp.asarray(array)


class _VisibilityFields(NamedTuple):
    in_view: Float[Array, " S"]


@shown_briefly
@rebuilt_unchecked
class Visibility(_Composable, _VisibilityFields):  # type: ignore[misc]
    """Visibility of states: ``in_view[s]`` is the probability of seeing a step in ``s``.

    A boolean mask is the usual case. A hidden step is evidence that the expert is out of view.
    """

    __slots__ = ()

    def __new__(cls, in_view: ArrayLike) -> Visibility:
        """Check and convert ``in_view``; ``ValueError`` if it is outside [0, 1]."""
        return super().__new__(cls, _checked_view("in_view", in_view))

    @property
    def visibility(self) -> Float[Array, " S"]:
        """The probabilities ``in_view``."""
        return self.in_view

    @property
    def noise(self) -> None:
        """None: steps in view are observed exactly."""
        return None


class _ObservationFields(NamedTuple):
    log_probabilities: Float[Array, "S A S A"]


@shown_briefly
@rebuilt_unchecked
class ObservationModel(_Composable, _ObservationFields):  # type: ignore[misc]
    """Noise that confuses pairs: ``log O(o_s, o_a | s, a)`` as ``[S, A, S, A]``, truth first.

    Build it from probabilities with :meth:`from_probabilities`, or from independent confusions of states
    ``[S, S]`` and actions ``[A, A]`` with :meth:`from_factors`. Rows must sum to one within the precision of
    the given numbers; they are normalised to 64 bits.
    """

    __slots__ = ()

    def __new__(cls, log_probabilities: ArrayLike) -> ObservationModel:
        """Check and convert; ``ValueError`` unless the exponentials of each truth's row sum to one."""
        table = concrete("log_probabilities", log_probabilities)
        if table is None:
            return super().__new__(cls, jnp.asarray(log_probabilities, float))
        if np.isnan(table).any():
            raise ValueError(f"log_probabilities must be numbers; that of {_first(np.isnan(table))} is nan")
        with np.errstate(over="ignore"):
            total = _row_sums(np.exp(table), log_probabilities)
        inexact = np.abs(total - 1) > _KEPT
        return super().__new__(cls, jnp.asarray(np.where(inexact, table - np.log(total), table)))

    @staticmethod
    def from_probabilities(probabilities: ArrayLike) -> ObservationModel:
        """Build from ``O(o | s, a)`` as ``[S, A, S, A]``; ``ValueError`` unless each row sums to one."""
        o = concrete("observation probabilities", probabilities)
        if o is None:
            return ObservationModel._make((safe_log(jnp.asarray(probabilities, float)),))
        if not np.isfinite(o).all() or (o < 0).any():
            raise ValueError("observation probabilities must be non-negative numbers")
        _row_sums(o, probabilities)
        with np.errstate(divide="ignore"):
            log_o = np.log(normalised(o, (2, 3)))
        return ObservationModel._make((jnp.asarray(log_o),))

    @staticmethod
    def from_factors(states: ArrayLike, actions: ArrayLike) -> ObservationModel:
        """Build from independent confusions of states and actions: ``O = O_s(o_s | s) O_a(o_a | a)``."""
        factors = []
        for name, given in (("states", states), ("actions", actions)):
            table = concrete(f"the confusion of {name}", given, None)
            factors.append(jnp.asarray(given) if table is None else table)
            if factors[-1].ndim != 2 or factors[-1].shape[0] != factors[-1].shape[1]:
                raise ValueError(
                    f"a confusion of {name} has shape [n, n], truth first, got {factors[-1].shape}"
                )
        einsum = jnp.einsum if any(is_traced(x) for x in factors) else np.einsum
        return ObservationModel.from_probabilities(einsum("so,ap->saop", *factors))

    @property
    def visibility(self) -> None:
        """None: the noise hides no step."""
        return None

    @property
    def noise(self) -> ObservationModel:
        """The model itself."""
        return self

    def log_likelihood(
        self,
        state: Int[Array | np.ndarray, ""],
        action: Int[Array | np.ndarray, ""],
        score: Float[Array | np.ndarray, ""],
    ) -> Float[Array, "S A"]:
        """Return ``log O(o | s, a)`` of one observation for each truth; a hidden coordinate is summed out."""
        del score  # fixed noise takes no account of confidence
        table = self.log_probabilities
        by_state = jnp.where(
            state == UNKNOWN, safe_log(jnp.sum(jnp.exp(table), axis=2)), table[:, :, jnp.maximum(state, 0)]
        )
        summed = safe_log(jnp.sum(jnp.exp(by_state), axis=2))
        return jnp.where(action == UNKNOWN, summed, by_state[:, :, jnp.maximum(action, 0)])

    def report(
        self, key: Array, state: Int[Array | np.ndarray, ""], action: Int[Array | np.ndarray, ""]
    ) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Draw the observation of a pair."""
        flat = jax.random.categorical(key, self.log_probabilities[state, action].reshape(-1))
        n_actions = self.log_probabilities.shape[1]
        return flat // n_actions, flat % n_actions


# Row sums that differ from one by less than this are rounding: normalising a table would change its bits.
_KEPT = 1e-12


def _row_sums(o: np.ndarray, given: Any) -> Float[np.ndarray, "S A 1 1"]:
    """Sum ``o [S, A, S, A]`` over observations; ``ValueError`` unless each truth's row sums to one."""
    if o.ndim != 4 or o.shape[:2] != o.shape[2:]:
        raise ValueError(f"an observation model has shape [S, A, S, A], truth first, got {o.shape}")
    total = o.sum((2, 3), keepdims=True)
    tolerance = sum_tolerance(np.asarray(given).dtype, o.shape[2] * o.shape[3])
    if not np.abs(total - 1).max(initial=0) <= tolerance:
        s, a, *_ = np.unravel_index(np.abs(total - 1).argmax(), total.shape)
        raise ValueError(f"observation probabilities of pair ({s}, {a}) sum to {total[s, a, 0, 0]}, not 1")
    return total


def _first(wrong: np.ndarray) -> str:
    return str(tuple(np.argwhere(wrong)[0].tolist()))


class _NoiseFields(NamedTuple):
    predicates: Bool[Array, "J S A"] | Int[Array, "J S A"]
    reliabilities: Float[Array, " J"]
    reportable: Bool[Array, "S A"]


@shown_briefly
@rebuilt_unchecked
class FeatureNoise(_Composable, _NoiseFields):  # type: ignore[misc]
    """Noise on features of a pair (6.1): ``O(o | g)`` depends on the predicates on which they agree.

    ``O(o | g) = prod_j p_j^[psi_j(o) = psi_j(g)] (1 - p_j)^[psi_j(o) != psi_j(g)] / Z(g)``, normalised over
    the pairs ``o`` that can be reported; Eq. 6.5 omits ``Z``. A reliability ``p_j`` is a parameter, not a
    frequency: :meth:`agreement` is how often a predicate is reported rightly.

    Parameters
    ----------
    predicates : bool or int ``[J, S, A]``
        ``psi_j(s, a)``. A predicate may be a label, such as the state's index: only the equality of two
        pairs' values counts.
    reliabilities : float ``[J]``
        ``p_j``, between 0 and 1; one half carries no information about its predicate.
    reportable : bool ``[S, A]``, optional
        Pairs that perception may report; all of them by default, unavailable ones included, because
        perception does not depend on the task.

    Raises
    ------
    ValueError
        For predicates that are neither booleans nor whole numbers, reliabilities outside (0, 1), or shapes
        that do not fit.
    """

    __slots__ = ()

    def __new__(
        cls,
        predicates: ArrayLike,
        reliabilities: ArrayLike,
        reportable: ArrayLike | None = None,
    ) -> FeatureNoise:
        """Check and convert; see the class."""
        psi = jnp.asarray(predicates if is_traced(predicates) else checked_predicates(predicates))
        if reportable is None:
            reportable = np.ones(psi.shape[1:], bool)
        p = concrete("reliabilities", reliabilities)
        if p is not None:
            if p.shape != psi.shape[:1]:
                raise ValueError(
                    f"{psi.shape[0]} predicates need as many reliabilities, got shape {list(p.shape)}"
                )
            if not ((p > 0) & (p < 1)).all():
                j = int(np.flatnonzero(~((p > 0) & (p < 1)))[0])
                raise ValueError(f"reliabilities lie between 0 and 1; that of predicate {j} is {p[j]}")
        mask = concrete("reportable", reportable, None)
        if mask is not None:
            if not np.isin(mask, (0, 1)).all():
                raise ValueError(f"reportable must be true or false; got {mask[~np.isin(mask, (0, 1))][0]}")
            if mask.shape != psi.shape[1:] or not mask.any():
                raise ValueError(
                    f"reportable must mark at least one of the pairs [S, A] = {list(psi.shape[1:])}, "
                    f"got shape {list(mask.shape)} with {mask.sum()} marked"
                )
        return super().__new__(
            cls,
            psi,
            jnp.asarray(reliabilities if p is None else p, float),
            jnp.asarray(reportable if mask is None else mask, bool),
        )

    @property
    def visibility(self) -> None:
        """None: the noise hides no step."""
        return None

    @property
    def noise(self) -> ObservationModel:
        """The normalised observation model, which also injects the noise."""
        return ObservationModel._make((self.log_probabilities,))

    @property
    def log_probabilities(self) -> Float[Array, "S A S A"]:
        """``log O(o | g)``, truth first; ``-inf`` for pairs that cannot be reported."""
        n_predicates, *pairs = self.predicates.shape
        psi = self.predicates.reshape(n_predicates, -1)
        logits = jnp.log(self.reliabilities) - jnp.log1p(-self.reliabilities)
        # Up to a term that is constant in o: sum_j logit_j [psi_j(o) = psi_j(g)].
        if psi.dtype == bool:
            true, false = psi.astype(float), (~psi).astype(float)
            exponents = (true * logits[:, None]).T @ true + (false * logits[:, None]).T @ false
        else:
            exponents = _same_labels(psi, logits)
        table = jnp.where(self.reportable.reshape(-1), exponents, -jnp.inf)
        return jax.nn.log_softmax(table, axis=1).reshape(*pairs, *pairs)

    def agreement(self) -> Float[Array, "J S A"]:
        """Probability that each predicate of an observation equals that of the truth ``(s, a)``."""
        psi = self.predicates.reshape(self.predicates.shape[0], -1)
        table = jnp.exp(self.log_probabilities).reshape(psi.shape[1], -1)
        same = jax.lax.map(lambda labels: jnp.sum(table, 1, where=labels[:, None] == labels), psi)
        return same.reshape(self.predicates.shape)


def _same_labels(psi: Int[Array, "J SA"], logits: Float[Array, " J"]) -> Float[Array, "SA SA"]:
    """Compute ``sum_j logit_j [psi_j(o) = psi_j(g)]``, one predicate at a time, in its derivative too."""

    # A derivative that stores all agreements would take [J, SA, SA].
    @jax.checkpoint
    def add(total: Array, one: tuple[Array, Array]) -> tuple[Array, None]:
        labels, logit = one
        return total + jnp.where(labels[:, None] == labels, logit, 0.0), None

    return jax.lax.scan(add, jnp.zeros((psi.shape[1], psi.shape[1])), (psi, logits))[0]


def checked_predicates(predicates: ArrayLike) -> Bool[np.ndarray, "J S A"] | Int[np.ndarray, "J S A"]:
    """Convert predicates to booleans if possible, else to whole numbers; ``ValueError`` otherwise."""
    masked = isinstance(predicates, np.ma.MaskedArray)
    psi = np.asarray(concrete("predicates", predicates, None) if masked else predicates)
    if psi.ndim != 3 or not psi.size:
        raise ValueError(f"predicates have shape [J, S, A], got {list(psi.shape)}")
    if psi.dtype.kind not in "biuf":
        raise ValueError(f"predicates are true or false, or whole numbers; got entries of type {psi.dtype}")
    broken = ~np.isfinite(psi) | (psi != np.rint(psi)) if psi.dtype.kind == "f" else np.zeros(psi.shape, bool)
    if broken.any():
        j, s, a = np.argwhere(broken)[0]
        raise ValueError(
            f"predicates are true or false, or whole numbers; predicate {j} of the pair ({s}, {a}) "
            f"is {psi[j, s, a]}"
        )
    return psi.astype(bool) if np.isin(psi, (0, 1)).all() else psi.astype(int)


def fitting_sensor(sensor: Any, mdp: TabularMDP) -> AnySensor:
    """Take a sensor, or a mask of the states in view, that fits the process.

    Raises ``TypeError`` as :func:`as_sensor` does, and ``ValueError`` for a sensor whose number of states or
    actions differs from the MDP's.
    """
    sensor = as_sensor(sensor)
    if sensor.visibility is not None and sensor.visibility.shape[-1:] != (mdp.n_states,):
        raise ValueError(
            f"the sensor's view has shape {sensor.visibility.shape}, but the MDP has {mdp.n_states} states"
        )
    table = getattr(sensor.noise, "log_probabilities", None)
    if table is not None and table.shape[-2:] != (mdp.n_states, mdp.n_actions):
        raise ValueError(
            f"the observation model is about {table.shape[-2]} states and {table.shape[-1]} actions, "
            f"but the MDP has {mdp.n_states} and {mdp.n_actions}"
        )
    return sensor


def checked_demonstration(
    mdp: TabularMDP,
    demonstration: Demonstration,
    *,
    needed_by: str | None = None,
    record: str = "trajectory",
) -> Demonstration:
    """Check that a demonstration fits the states and actions of a process; traced ones pass.

    Every learner, law and metric calls it before it compiles anything. Inside compiled programs
    :func:`step_log_evidence` gives such steps the probability zero.

    Parameters
    ----------
    needed_by : str, optional
        Name of a caller that needs at least one step ("a session"); without it, empty demonstrations pass.
    record : str
        Name of a row in messages.

    Raises
    ------
    TypeError
        For an object of another type.
    DemonstrationError
        Naming trajectory and step: an index out of range, an unknown kind, a score outside [0, 1], padding
        before a step; arrays of different shapes or not of whole numbers.
    """
    if not isinstance(demonstration, Demonstration):
        raise TypeError(
            "demonstration must be a Demonstration, such as Demonstration.from_pairs(states, actions) or "
            f"Demonstration.from_steps(trajectories, mdp) makes; got {described(demonstration)}"
        )
    if any(is_traced(x) for x in demonstration.arrays):
        return demonstration
    checked = Demonstration(*(np.asarray(x) for x in demonstration.arrays))
    _check_codes(mdp, *checked.arrays[:3], record)
    score = checked.score
    if score.shape != checked.kind.shape:
        raise DemonstrationError(
            f"a demonstration has arrays of one shape [n, L]; got kind {checked.kind.shape} and score "
            f"{score.shape}"
        )
    wrong = (checked.kind == SEEN) & ((score < 0) | (score > 1))
    if wrong.any():
        i, t = np.argwhere(wrong)[0]
        raise DemonstrationError(f"{record} {i}, step {t}: score must lie in [0, 1], got {score[i, t]}")
    if needed_by is not None and not (checked.kind != PAD).any():
        raise DemonstrationError(f"{needed_by} needs at least one trajectory with a step")
    return checked


def checked_codes(mdp: TabularMDP, codes: ArrayLike) -> Int[Array, "... L 3"]:
    """Check :attr:`Demonstration.codes` as :func:`checked_demonstration` does; traced ones pass."""
    if not is_traced(codes):
        array = np.asarray(codes)
        flat = array.reshape(-1, *array.shape[-2:])
        if flat.shape[-1] == 3:
            _check_codes(mdp, flat[..., 0], flat[..., 1], flat[..., 2], "trajectory")
    return jnp.asarray(codes)


def _check_codes(
    mdp: TabularMDP, kind: np.ndarray, state: np.ndarray, action: np.ndarray, record: str
) -> None:
    if not kind.shape == state.shape == action.shape or kind.ndim != 2:
        raise DemonstrationError(
            f"a demonstration has arrays of one shape [n, L]; got kind {kind.shape}, state {state.shape} and "
            f"action {action.shape}"
        )
    for name, array in (("kind", kind), ("state", state), ("action", action)):
        if array.dtype.kind not in "iu":
            raise DemonstrationError(f"{name} must be an array of whole numbers; got {array.dtype}")
    wrong = (kind < PAD) | (kind > LOST)
    if wrong.any():
        i, t = np.argwhere(wrong)[0]
        raise DemonstrationError(
            f"{record} {i}, step {t}: kind must be PAD, SEEN, HIDDEN or LOST (0 to 3), got {kind[i, t]}"
        )
    seen = kind == SEEN
    for index, what, count in ((state, "state", mdp.n_states), (action, "action", mdp.n_actions)):
        wrong = seen & ((index < UNKNOWN) | (index >= count))
        if wrong.any():
            i, t = np.argwhere(wrong)[0]
            raise DemonstrationError(
                f"{record} {i}, step {t}: {what} {index[i, t]} is out of range; "
                f"indices run from 0 to {count - 1}"
            )
    wrong = (kind[:, 1:] != PAD) & (kind[:, :-1] == PAD)
    if wrong.any():
        i, t = np.argwhere(wrong)[0]
        raise DemonstrationError(f"{record} {i}, step {t}: padding comes last, but step {t + 1} is a step")


def step_log_evidence(
    sensor: AnySensor,
    n_states: int,
    n_actions: int,
    kind: Int[Array, ""],
    state: Int[Array, ""],
    action: Int[Array, ""],
    score: Float[Array, ""],
) -> Float[Array, "S A"]:
    """Return ``log e_t(s, a)`` of one step; zero (no evidence) for lost frames and padding.

    The result is minus infinity for an index out of range and for an unknown kind.
    """
    shape = (n_states, n_actions)
    visibility = jnp.ones(n_states) if sensor.visibility is None else sensor.visibility
    if sensor.noise is None:
        match_state = (state == UNKNOWN) | (jnp.arange(n_states) == state)
        match_action = (action == UNKNOWN) | (jnp.arange(n_actions) == action)
        noise = jnp.where(match_state[:, None] & match_action, 0.0, -jnp.inf)
    else:
        noise = sensor.noise.log_likelihood(state, action, score)
    seen = noise + safe_log(visibility)[:, None]
    hidden = jnp.broadcast_to(safe_log(1 - visibility)[:, None], shape)
    # JAX clamps an index beyond an array to the last entry: the step would count as another state.
    in_range = (state >= UNKNOWN) & (state < n_states) & (action >= UNKNOWN) & (action < n_actions)
    nothing = jnp.where((kind == LOST) | (kind == PAD), jnp.zeros(shape), -jnp.inf)
    return jnp.where((kind == SEEN) & in_range, seen, jnp.where(kind == HIDDEN, hidden, nothing))


def safe_log(probability: Array) -> Array:
    """Take the logarithm with ``log 0 = -inf`` and a zero, not NaN, gradient there."""
    return jnp.where(probability > 0, jnp.log(jnp.where(probability > 0, probability, 1.0)), -jnp.inf)


def log_evidence(sensor: AnySensor, mdp: TabularMDP, demonstration: Demonstration) -> Float[Array, "n L S A"]:
    """Return ``log e_t(s, a)`` of every step of every trajectory.

    Raises ``ValueError`` for a sensor whose number of states or actions differs, and as
    :func:`checked_demonstration` does.

    See Also
    --------
    i2rl.models.Sensor : sensors and their products
    i2rl.inference.expectations : completes a demonstration by its evidence

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Demonstration, log_evidence
    >>> corridor = five_cells()
    >>> walk = Demonstration.from_arrays([[1, -1]], [[1, -1]], missing=-1)  # the second step is hidden
    >>> print(np.exp(log_evidence(corridor.sensor, corridor.mdp, walk)[0, 1]).max(axis=1))  # cell 2 or cell 3
    [0. 0. 1. 1. 0.]
    """
    sensor, demonstration = fitting_sensor(sensor, mdp), checked_demonstration(mdp, demonstration)
    step = jax.vmap(jax.vmap(lambda *x: step_log_evidence(sensor, mdp.n_states, mdp.n_actions, *x)))
    kind, state, action, score = (jnp.asarray(x) for x in demonstration.arrays)
    return step(kind, state, action, score)


def observe(
    key: Array,
    sensor: AnySensor,
    states: Int[Array | np.ndarray, " L"],
    actions: Int[Array | np.ndarray, " L"],
) -> Int[Array, "L 3"]:
    """Pass a true trajectory through a sensor; return codes (kind, state, action) of the observations.

    See Also
    --------
    i2rl.models.sample_demonstration : simulates trajectories and observes them
    i2rl.models.distort : the same for recordings

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Demonstration, observe
    >>> codes = observe(jax.random.key(0), five_cells().sensor, np.array([0, 1, 2]), np.array([1, 1, 1]))
    >>> codes.tolist()  # cell 2 is out of view: kind 2 is hidden, -1 is unknown
    [[1, 0, 1], [1, 1, 1], [2, -1, -1]]
    >>> Demonstration.from_codes(codes[None]).state.tolist()
    [[0, 1, -1]]
    """

    sensor = as_sensor(sensor)

    def one(key: Array, state: Int[Array, ""], action: Int[Array, ""]) -> Int[Array, " 3"]:
        look, read = jax.random.split(key)
        seen: Bool[Array, ""] = jnp.array(True)
        if sensor.visibility is not None:
            seen = jax.random.uniform(look) < sensor.visibility[state]
        if sensor.noise is not None:
            state, action = sensor.noise.report(read, state, action)
        values = jnp.stack([jnp.array(SEEN), state, action])
        return jnp.where(seen, values, jnp.array([HIDDEN, UNKNOWN, UNKNOWN])).astype(jnp.int32)

    keys = jax.random.split(as_key(key), states.shape[0])
    return jax.vmap(one)(keys, jnp.asarray(states), jnp.asarray(actions))


_evidence = jax.jit(step_log_evidence, static_argnums=(1, 2))


def require_possible(
    sensor: AnySensor, mdp: TabularMDP, demonstration: Demonstration, record: str = "trajectory"
) -> None:
    """Raise :class:`DemonstrationError` at the first step that no behaviour of the MDP could have produced.

    The check propagates the set of possible states; ``record`` names a row in messages. An index out of range
    is such a step too.

    See Also
    --------
    i2rl.models.log_evidence : the evidence of every step
    i2rl.models.DemonstrationError : the error

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Demonstration, DemonstrationError, require_possible
    >>> corridor, jump = five_cells(), Demonstration.from_pairs([[0, 4]], [[1, 1]])
    >>> try:
    ...     require_possible(corridor.sensor, corridor.mdp, jump)
    ... except DemonstrationError as error:
    ...     print(error)
    trajectory 0, step 1: ...
    """
    sensor = fitting_sensor(sensor, mdp)
    demonstration = checked_demonstration(mdp, demonstration, record=record)
    successors, possible_move = np.asarray(mdp.successors), np.asarray(mdp.probabilities) > 0
    available = np.asarray(mdp.available)
    name = PairNames(mdp.labels)
    names = {SEEN: "seen", HIDDEN: "hidden", LOST: "lost"}
    start = np.asarray(mdp.initial) > 0
    visibility = np.ones(mdp.n_states) if sensor.visibility is None else np.asarray(sensor.visibility)
    for i in range(demonstration.n_trajectories):
        states = start
        columns = (np.asarray(x)[i] for x in demonstration.arrays)
        for t, (kind, s, a, score) in enumerate(zip(*columns, strict=True)):
            if kind == PAD:
                break
            if kind == SEEN and sensor.noise is None:
                pairs = np.zeros_like(available)
                pairs[slice(None) if s == UNKNOWN else s, slice(None) if a == UNKNOWN else a] = True
                pairs &= (visibility > 0)[:, None]
            elif kind == SEEN:
                pairs = (
                    np.asarray(_evidence(sensor, mdp.n_states, mdp.n_actions, kind, s, a, score)) > -np.inf
                )
            elif kind == HIDDEN:
                pairs = np.broadcast_to((visibility < 1)[:, None], available.shape)
            else:
                pairs = np.ones_like(available)
            allowed = pairs & available
            if not (allowed & states[:, None]).any():
                seen = ""
                if kind == SEEN:
                    seen = " " + ", ".join(
                        ([] if s == UNKNOWN else [f"state {name.state(s)}"])
                        + ([] if a == UNKNOWN else [f"action {name.action(a)}"])
                    )
                if not pairs.any():
                    reason = "the sensor excludes it" if kind == SEEN else "every state is in view"
                elif not allowed.any():
                    reason = "the action is not available there"
                elif t == 0:
                    reason = "the initial distribution excludes it"
                else:
                    reason = "no transition leads there from the step before"
                raise DemonstrationError(
                    f"{record} {i}, step {t}: impossible observation: {names[int(kind)]}{seen}; {reason}"
                )
            taken = allowed & states[:, None]
            states = np.zeros(mdp.n_states, bool)
            states[successors[taken][possible_move[taken]]] = True
