"""Noisy perception of continuous tasks: recordings, and sensors that both distort and weigh them.

A sensor has two methods with the same parameters: ``sample`` injects the noise, and ``log_prob`` is the
observation model (terms T4 and T5 of Eq. 6.10). Injected and assumed noise therefore agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from ..inputs.arguments import as_key, concrete, described, rebuilt_unchecked
from ..inputs.display import brief_repr, brief_table, fields_of, joined, readable, shown_briefly, step_range
from ..inputs.text import counted

MOUNTAIN_CAR_SHIFT = 0.1 * 1.8 / 10
"""One percent of the range of positions of mountain car, 1.8 (section 7.4.3)."""


class RecordingError(ValueError):
    """A recording that cannot be used; the message names the trajectory and, if there is one, the step."""


class Recording(NamedTuple):
    """Trajectories in continuous spaces, padded to one length ``L``; step ``t`` is the pair ``(s_t, a_t)``.

    The state after the last step is not included.

    Fields
    ------
    observations : float ``[n, L, d]``
    actions : float ``[n, L, k]``, or int ``[n, L]`` where actions are numbered
    live : bool ``[n, L]``
        False on padding, which comes last.
    terminated : bool ``[n]``
        True if the task ended with the last step, False if only the recording ended.
    """

    observations: Float[Array, "n L d"]
    actions: Array
    live: Bool[Array, "n L"]
    terminated: Bool[Array, " n"]

    def __repr__(self) -> str:
        rows = self._rows()
        return brief_repr(self) if rows is None else joined(type(self).__name__, [told for _, told in rows])

    def _repr_html_(self) -> str:
        rows = self._rows()
        return brief_table(type(self).__name__, fields_of(self) if rows is None else rows)

    def _rows(self) -> list[tuple[str, str]] | None:
        """Describe the contents in words; None if JAX put something else into the fields."""
        if not (readable(self.live) and readable(self.terminated)) or np.ndim(self.live) != 2:
            return None
        parts = [
            (name, f"{name} {x.dtype}[{', '.join(map(str, x.shape[2:]))}]")
            for name, x in (("observations", self.observations), ("actions", self.actions))
            if hasattr(x, "shape") and hasattr(x, "dtype")
        ]
        return [
            ("trajectories", counted(len(self.live), "trajectory")),
            ("steps", step_range(self.lengths)),
            *parts,
            ("terminated", f"{int(np.sum(np.asarray(self.terminated)))} terminated"),
        ]

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each trajectory, ``[n]``."""
        return np.asarray(self.live).sum(1)

    @property
    def followed(self) -> Bool[Array, "n L"]:
        """Steps whose successor is a step as well: all but the last of each trajectory, ``[n, L]``."""
        return jnp.concatenate([self.live[:, 1:], jnp.zeros_like(self.live[:, :1])], 1)

    @property
    def last(self) -> Bool[Array, "n L"]:
        """The last step of each trajectory, ``[n, L]``."""
        return self.live & ~self.followed


def recording(
    observations: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    *,
    terminated: Sequence[bool] | None = None,
    n_actions: int | None = None,
    length: int | None = None,
) -> Recording:
    """Build a recording of one array ``[l, d]`` and one ``[l, k]`` (or ``[l]`` of integers) per trajectory.

    ``terminated`` defaults to False throughout. ``n_actions`` bounds numbered actions. ``length`` pads beyond
    the longest trajectory, so that functions compiled for it serve later recordings as well.

    Raises :class:`RecordingError` naming the trajectory, and the step if there is one: numbers that are
    not finite, shapes that do not fit each other, fewer than two steps, numbered actions out of range.

    See Also
    --------
    i2rl.models.distort : passes a recording through a sensor
    i2rl.models.Demonstration : trajectories of states and actions that are numbered

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.models import recording
    >>> trajectories = recording([np.zeros((5, 4)), np.zeros((3, 4))], [np.zeros(5, int), np.zeros(3, int)])
    >>> trajectories.observations.shape, trajectories.actions.shape
    ((2, 5, 4), (2, 5))
    >>> trajectories.lengths.tolist()
    [5, 3]
    """
    if len(observations) == 0 or len(observations) != len(actions):
        raise RecordingError(
            "a recording needs as many arrays of observations as of actions, and at least one: got "
            f"{len(observations)} and {len(actions)}"
        )
    pairs = [(np.asarray(o), np.asarray(a)) for o, a in zip(observations, actions, strict=True)]
    ended = np.zeros(len(pairs), bool) if terminated is None else np.asarray(terminated)
    if ended.shape != (len(pairs),) or ended.dtype != bool:
        raise RecordingError(f"terminated must be {len(pairs)} booleans, got {ended.dtype} {ended.shape}")
    for i, (o, a) in enumerate(pairs):
        _check_trajectory(i, o, a, *pairs[0], n_actions)
    longest = max(len(o) for o, _ in pairs)
    if length is not None and length < longest:
        raise RecordingError(f"length is {length}, but a trajectory has {longest} steps")
    padded = longest if length is None else length

    def pad(arrays: list[np.ndarray], dtype: Any) -> Array:
        out = np.zeros((len(arrays), padded, *arrays[0].shape[1:]), dtype)
        for row, array in zip(out, arrays, strict=True):
            row[: len(array)] = array
            row[len(array) :] = array[-1]  # a point where dynamics and networks are known to be finite
        return jnp.asarray(out)

    numbered = pairs[0][1].ndim == 1
    live = np.arange(padded) < np.array([len(o) for o, _ in pairs])[:, None]
    return Recording(
        pad([o for o, _ in pairs], np.float64),
        pad([a for _, a in pairs], np.int32 if numbered else np.float64),
        jnp.asarray(live),
        jnp.asarray(ended),
    )


def _check_trajectory(
    i: int,
    observations: np.ndarray,
    actions: np.ndarray,
    first_observations: np.ndarray,
    first_actions: np.ndarray,
    n_actions: int | None,
) -> None:
    if observations.ndim != 2 or observations.shape[1] == 0 or actions.ndim not in (1, 2):
        raise RecordingError(
            f"trajectory {i}: observations must have shape [steps, d] and actions [steps, k] or [steps], got "
            f"{observations.shape} and {actions.shape}"
        )
    if len(observations) != len(actions):
        raise RecordingError(
            f"trajectory {i} has {len(observations)} observations and {len(actions)} actions; "
            "each step is one of each"
        )
    if len(observations) < 2:
        raise RecordingError(f"trajectory {i} has {len(observations)} step(s); at least 2 are needed")
    if (observations.shape[1:], actions.shape[1:]) != (first_observations.shape[1:], first_actions.shape[1:]):
        raise RecordingError(
            f"trajectory {i} has observations [steps, {observations.shape[1]}] and actions "
            f"[steps{''.join(f', {k}' for k in actions.shape[1:])}], unlike trajectory 0 with "
            f"{first_observations.shape} and {first_actions.shape}"
        )
    for name, array in (("observation", observations), ("action", actions)):
        if array.dtype.kind not in "fiub":
            raise RecordingError(f"trajectory {i}: the {name}s are no numbers but {array.dtype}")
        wrong = ~np.isfinite(array).reshape(len(array), -1).all(1)
        if wrong.any():
            t = int(np.flatnonzero(wrong)[0])
            raise RecordingError(f"trajectory {i}, step {t}: the {name} is {array[t]}, not finite")
    if actions.ndim == 1:
        if actions.dtype.kind not in "iu":
            raise RecordingError(
                f"trajectory {i}: actions of shape [steps] are numbers of actions and must be integers, got "
                f"{actions.dtype}; vectors of one component have shape [steps, 1]"
            )
        wrong = (actions < 0) | (actions >= (np.inf if n_actions is None else n_actions))
        if wrong.any():
            t = int(np.flatnonzero(wrong)[0])
            known = "" if n_actions is None else f"; there are actions 0 to {n_actions - 1}"
            raise RecordingError(f"trajectory {i}, step {t}: there is no action {actions[t]}{known}")


def require_recording(reported: Recording, observation_size: int, n_actions: int, action_size: int) -> None:
    """Raise :class:`RecordingError` for a recording that a learner of a task cannot take.

    ``n_actions`` is their number, or 0 for vectors of ``action_size``. The check covers shapes, numbers that
    are not finite (naming trajectory and step, padding included because it passes through the dynamics),
    actions out of range, padding between steps, and that at least one step has a known successor or
    termination. Vectors beyond their bounds pass, because noisy observations exceed them.
    """
    if not isinstance(reported, Recording):
        raise RecordingError(f"this learner learns from a Recording, got a {type(reported).__name__}")
    observations, actions, live, ended = (np.asarray(x) for x in reported)
    rows = live.shape
    wanted = rows if n_actions else (*rows, action_size)
    if live.ndim != 2 or observations.shape != (*rows, observation_size) or actions.shape != wanted:
        raise RecordingError(
            f"this task has observations [n, L, {observation_size}] and actions "
            f"{'[n, L] of whole numbers' if n_actions else f'[n, L, {action_size}]'}, got "
            f"{observations.shape} and {actions.shape} with live {rows}"
        )
    if live.dtype != bool or ended.dtype != bool or ended.shape != rows[:1]:
        raise RecordingError(
            f"live [n, L] and terminated [n] must be booleans, got {live.dtype} {rows} and {ended.dtype} "
            f"{ended.shape}"
        )
    for name, array in (("observation", observations), ("action", actions)):
        wrong = np.argwhere(~np.isfinite(array).reshape(*rows, -1).all(-1))
        if len(wrong):
            i, t = wrong[0]
            raise RecordingError(f"trajectory {i}, step {t}: the {name} is {array[i, t]}, not finite")
    if n_actions:
        if actions.dtype.kind not in "iu":
            raise RecordingError(f"numbers of actions must be integers, got {actions.dtype}")
        wrong = np.argwhere(live & ((actions < 0) | (actions >= n_actions)))
        if len(wrong):
            i, t = wrong[0]
            raise RecordingError(
                f"trajectory {i}, step {t}: there is no action {actions[i, t]}; there are actions 0 to "
                f"{n_actions - 1}"
            )
    wrong = np.argwhere(live[:, 1:] & ~live[:, :-1])
    if len(wrong):
        i, t = wrong[0]
        raise RecordingError(f"trajectory {i}: step {t} is padding, but step {t + 1} is not; padding is last")
    if not (live[:, 1:].any() or (live.any(1) & ended).any()):
        raise RecordingError(
            "nothing can be learned from this recording: no step has a successor or ended its task"
        )


class ContinuousSensor(Protocol):
    """Noise of continuous states and actions: draws of observations, and their density given the truth."""

    def sample(self, key: Array, observations: Array, actions: Array) -> tuple[Array, Array]:
        """Draw observations of true states ``[..., d]`` and actions ``[..., k]`` or ``[...]``."""

    def log_prob(
        self, reported_observations: Array, reported_actions: Array, observations: Array, actions: Array
    ) -> Float[Array, "..."]:
        """Return the log-density or log-probability of observations given the truth, ``[...]`` in nats."""


def require_continuous(sensor: Any) -> None:
    """Raise ``TypeError`` for an object that neither draws observations nor weighs them."""
    if isinstance(sensor, type) or not any(hasattr(sensor, x) for x in ("sample", "log_prob", "candidates")):
        raise TypeError(
            "sensor must be one of continuous recordings, such as GaussianSensor(0.1, 0.1) or ShiftSensor(); "
            f"got {described(sensor)}"
        )


def distort(key: Array, sensor: ContinuousSensor, truth: Recording) -> Recording:
    """Replace a recording by the sensor's observations of it; padding is unchanged.

    See Also
    --------
    i2rl.models.GaussianSensor : Gaussian noise of given covariances
    i2rl.models.ShiftSensor : shifted states and replaced actions
    i2rl.models.observe : the same for states and actions that are numbered

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.models import GaussianSensor, distort, recording
    >>> truth = recording([np.zeros((2000, 2))], [np.zeros((2000, 1))])
    >>> reported = distort(jax.random.key(0), GaussianSensor(0.04, 0.01), truth)  # variances
    >>> round(float(reported.observations.std()), 1), round(float(reported.actions.std()), 1)
    (0.2, 0.1)
    """
    require_continuous(sensor)
    observations, actions = sensor.sample(as_key(key), truth.observations, truth.actions)
    live = truth.live[..., None]
    return truth._replace(
        observations=jnp.where(live, observations, truth.observations),
        actions=jnp.where(live if actions.ndim == 3 else truth.live, actions, truth.actions),
    )


class _GaussianFields(NamedTuple):
    state_covariance: Float[Array, "*s"]
    action_covariance: Float[Array, "*a"]


@shown_briefly
@rebuilt_unchecked
class GaussianSensor(_GaussianFields):
    """Gaussian noise, independent for states and actions (section 6.2.3, Technique 2).

    Observations are not clipped to the spaces' bounds, so density and frequencies agree everywhere.

    Parameters
    ----------
    state_covariance : float ``[d, d]``, ``[d]`` (the diagonal) or a number (every coordinate's variance)
    action_covariance : float ``[k, k]``, ``[k]`` or a number; likewise

    Raises
    ------
    ValueError
        For a covariance that is not finite, not symmetric or not positive definite.
    """

    __slots__ = ()

    def __new__(cls, state_covariance: ArrayLike, action_covariance: ArrayLike) -> GaussianSensor:
        """Check and convert both covariances."""
        return super().__new__(
            cls,
            checked_covariance("state", state_covariance),
            checked_covariance("action", action_covariance),
        )

    def sized(self, observation_size: int, action_size: int) -> GaussianSensor:
        """Expand the covariances to ``[d, d]`` and ``[k, k]``; ``ValueError`` if the sizes differ."""
        return GaussianSensor._make(
            (
                covariance_matrix("state", self.state_covariance, observation_size),
                covariance_matrix("action", self.action_covariance, action_size),
            )
        )

    def sample(
        self, key: Array, observations: Float[Array, "... d"], actions: Float[Array, "... k"]
    ) -> tuple[Float[Array, "... d"], Float[Array, "... k"]]:
        """Draw observations of true states and actions; ``ValueError`` if the actions are not vectors."""
        if actions.ndim != observations.ndim:
            raise ValueError(
                f"Gaussian noise needs action vectors [..., k]; got shape {actions.shape} beside "
                f"observations {observations.shape}"
            )
        sensor = self.sized(observations.shape[-1], actions.shape[-1])
        key_s, key_a = jax.random.split(key)
        return (
            observations + _normal(key_s, sensor.state_covariance, observations.shape),
            actions + _normal(key_a, sensor.action_covariance, actions.shape),
        )

    def log_prob(
        self,
        reported_observations: Float[Array, "... d"],
        reported_actions: Float[Array, "... k"],
        observations: Float[Array, "... d"],
        actions: Float[Array, "... k"],
    ) -> Float[Array, "..."]:
        """Return the log-density of observations, in nats."""
        sensor = self.sized(observations.shape[-1], actions.shape[-1])
        return log_normal(reported_observations - observations, sensor.state_covariance) + log_normal(
            reported_actions - actions, sensor.action_covariance
        )


def checked_covariance(whose: str, given: Any) -> Any:
    """Convert a covariance (number, diagonal or matrix) to an array; traced ones pass unchecked.

    Raises ``ValueError`` if it is not finite, not symmetric or not positive definite.
    """
    array = concrete(f"the {whose} covariance", given)
    if array is None:
        return jnp.asarray(given, float)
    if array.ndim > 2 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise ValueError(
            f"the {whose} covariance must be a number, a diagonal [d] or a matrix [d, d], "
            f"got shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"the {whose} covariance has entries that are not finite")
    if array.ndim == 2 and not np.allclose(array, array.T, rtol=1e-8, atol=1e-12):
        raise ValueError(
            f"the {whose} covariance is not symmetric: it differs by {abs(array - array.T).max()}"
        )
    least = np.linalg.eigvalsh(array).min() if array.ndim == 2 else array.min()
    if not least > 0:
        raise ValueError(
            f"the {whose} covariance is not positive definite: its least eigenvalue is {least:.3g}"
        )
    return jnp.asarray(array)


def covariance_matrix(whose: str, covariance: Array, size: int) -> Float[Array, "size size"]:
    """Expand a number or a diagonal to a matrix; ``ValueError`` if its size is another."""
    if covariance.ndim and covariance.shape[-1] != size:
        raise ValueError(
            f"the {whose} covariance has shape {covariance.shape}, but there are {size} components"
        )
    return covariance if covariance.ndim == 2 else covariance * jnp.eye(size)


def _normal(key: Array, covariance: Float[Array, "d d"], shape: tuple[int, ...]) -> Array:
    return jax.random.normal(key, shape, covariance.dtype) @ jnp.linalg.cholesky(covariance).T


def log_normal(difference: Float[Array, "... d"], covariance: Float[Array, "d d"]) -> Float[Array, "..."]:
    """Return the log-density at a difference from the mean, in nats."""
    factor = jnp.linalg.cholesky(covariance)
    whiten = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor)), lower=True)
    z = difference @ whiten.T
    log_det = jnp.sum(jnp.log(jnp.diagonal(factor)))
    return -0.5 * jnp.sum(z**2, -1) - log_det - 0.5 * len(factor) * jnp.log(2 * jnp.pi)


class _ShiftFields(NamedTuple):
    shift: float | Array
    probability: float | Array


@shown_briefly
@rebuilt_unchecked
class ShiftSensor(_ShiftFields):
    """Mountain car's noise: an observed position is sometimes shifted along the action's direction.

    With ``probability`` the first coordinate is observed ``shift`` lower for actions 0 and 1 and ``shift``
    higher for action 2; otherwise the observation is the truth. (Section 7.4.3 gives its 0.75 to
    "otherwise"; only this interpretation sums to one.) Positions are not clipped to the track, so each truth
    has two possible observations everywhere; ``log_prob`` covers both.

    Parameters
    ----------
    shift : float, in units of position
    probability : float in [0, 1]

    Raises
    ------
    ValueError
        For a shift that is not finite, and for a probability outside [0, 1].
    """

    __slots__ = ()

    def __new__(
        cls, shift: float | Array = MOUNTAIN_CAR_SHIFT, probability: float | Array = 0.25
    ) -> ShiftSensor:
        """Check both parameters."""
        by, p = concrete("shift", shift), concrete("probability", probability)
        if by is not None and not (by.ndim == 0 and np.isfinite(by)):
            raise ValueError(f"shift must be a finite number; got {described(shift)}")
        if p is not None and not (p.ndim == 0 and 0 <= p <= 1):
            raise ValueError(f"the probability of a shift must be in [0, 1], got {probability}")
        return super().__new__(cls, shift, probability)

    def displacement(self, actions: Array) -> Float[Array, "..."]:
        """Return the shift that a distorted observation adds to the position, ``[...]``."""
        return jnp.where(actions == 2, self.shift, -jnp.asarray(self.shift))

    def sample(
        self, key: Array, observations: Float[Array, "... d"], actions: Array
    ) -> tuple[Float[Array, "... d"], Array]:
        """Draw observations of true states and (numbered) actions."""
        shifted = jax.random.bernoulli(key, self.probability, actions.shape)
        moved = observations[..., 0] + jnp.where(shifted, self.displacement(actions), 0.0)
        return observations.at[..., 0].set(moved), actions

    def log_prob(
        self,
        reported_observations: Float[Array, "... d"],
        reported_actions: Array,
        observations: Float[Array, "... d"],
        actions: Array,
    ) -> Float[Array, "..."]:
        """Return the log-probability of observations, in nats; equal means within 1e-6 (32-bit numbers)."""
        difference = reported_observations - observations
        same = (reported_actions == actions) & jnp.all(jnp.abs(difference[..., 1:]) < 1e-6, -1)
        true = jnp.abs(difference[..., 0]) < 1e-6
        shifted = jnp.abs(difference[..., 0] - self.displacement(actions)) < 1e-6
        p = jnp.where(true, 1 - jnp.asarray(self.probability), 0.0) + jnp.where(
            shifted, self.probability, 0.0
        )
        return jnp.where(same, jnp.log(p), -jnp.inf)

    def candidates(
        self, reported_observations: Float[Array, "... d"], reported_actions: Array
    ) -> tuple[Float[Array, "... 2 d"], Float[Array, "... 2"]]:
        """List the truths that may be behind an observation, the observation itself first.

        Returns them with the log-probability, in nats, of the observation given each.
        """
        back = self.displacement(reported_actions)
        shifted = reported_observations.at[..., 0].add(-back)
        p = jnp.asarray(self.probability, float)
        log_p = jnp.broadcast_to(jnp.stack([jnp.log1p(-p), jnp.log(p)]), (*back.shape, 2))
        return jnp.stack([reported_observations, shifted], -2), log_p


class FiniteSensor(Protocol):
    """A sensor with finitely many possible truths behind each observation; it observes actions exactly."""

    def candidates(
        self, reported_observations: Float[Array, "... d"], reported_actions: Array
    ) -> tuple[Float[Array, "... K d"], Float[Array, "... K"]]:
        """Return the truths, and the log-probability of the observation given each."""


@shown_briefly
class Truths(NamedTuple):
    """Draws of the truth behind a recording, ``M`` of them, usable as an expert's transitions.

    Fields
    ------
    observations : float ``[M, n, L, d]``
    actions : float ``[M, n, L, k]`` or int ``[M, n, L]``
    successors : float ``[M, n, L, d]``
        The draw's own next state; the state itself if there is none.
    terminated : bool ``[M, n, L]``
        The last step of a trajectory that ended.
    usable : bool ``[M, n, L]``
        Steps that have a successor or terminated; learners must skip the rest.
    """

    observations: Float[Array, "M n L d"]
    actions: Array
    successors: Float[Array, "M n L d"]
    terminated: Bool[Array, "M n L"]
    usable: Bool[Array, "M n L"]


def truths(reported: Recording, observations: Float[Array, "M n L d"], actions: Array) -> Truths:
    """Combine draws of states and actions into transitions."""
    following = jnp.concatenate([observations[:, :, 1:], observations[:, :, -1:]], 2)
    followed = jnp.broadcast_to(reported.followed, observations.shape[:-1])
    ended = jnp.broadcast_to(reported.last & reported.terminated[:, None], followed.shape)
    return Truths(
        observations,
        actions,
        jnp.where(followed[..., None], following, observations),
        ended,
        followed | ended,
    )
