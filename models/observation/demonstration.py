"""Demonstrations, which may have hidden and lost steps, and their interchange format.

The format is JSON Lines, one trajectory a line (every field is documented in :func:`read_trajectories`)::

    {"id": "patrol-0", "steps": [{"s": "(0,5) east", "a": "forward"}, "hidden", null, {"s": 3, "score": 0.9}]}
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import PurePath
from typing import IO, Any, NamedTuple, NoReturn

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from ..inputs.display import brief_repr, brief_table, fields_of, joined, readable, shown_briefly, step_range
from ..inputs.text import JSONError, JSONSyntaxError, counted, listed, parsed_json, shortened
from ..process.mdp import TabularMDP

PAD, SEEN, HIDDEN, LOST = 0, 1, 2, 3
UNKNOWN = -1
_SURROGATE = re.compile("[\ud800-\udfff]")

Step = dict[str, Any] | tuple[Any, Any] | list[Any] | np.ndarray | str | None


class DemonstrationError(ValueError):
    """A demonstration that cannot be read or that the model excludes; names the record at fault."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["kind", "state", "action", "score"],
    meta_fields=[],
)
@dataclass(frozen=True, eq=False, repr=False)
class Demonstration:
    """``n`` trajectories padded to ``L`` steps.

    A container of trajectories: ``len``, iteration, and indexing by a number, a slice, a mask or numbers give
    demonstrations of some of them. Immutable, and a JAX pytree of its four arrays; compared by identity.

    Attributes
    ----------
    kind : int8 ``[n, L]``
        ``SEEN``; ``HIDDEN`` (the sensor was on and saw no expert, which is evidence); ``LOST`` (no frame,
        no evidence); ``PAD`` beyond the trajectory's end.
    state, action : int32 ``[n, L]``
        The observed coordinates; ``UNKNOWN`` (-1) for a hidden one.
    score : float ``[n, L]``
        Perception's confidence in an observed pair; NaN if it gave none.
    """

    kind: Int[np.ndarray, "n L"]
    state: Int[np.ndarray, "n L"]
    action: Int[np.ndarray, "n L"]
    score: Float[np.ndarray, "n L"]

    def __len__(self) -> int:
        """Count the trajectories, padding rows included."""
        return self.kind.shape[0]

    def __iter__(self) -> Iterator[Demonstration]:
        """Iterate over the trajectories, each a demonstration of one."""
        return (self[i] for i in range(len(self)))

    def __getitem__(self, rows: Any) -> Demonstration:
        """Select trajectories by a number, a slice, a mask ``[n]`` or numbers; always a demonstration.

        Raises ``IndexError`` for a trajectory that does not exist or a mask of another length, ``TypeError``
        for what selects nothing.

        Examples
        --------
        >>> demo = Demonstration.from_pairs([[0, 1], [2, 0], [1, 1]], [[1, 1], [0, 0], [1, 0]])
        >>> len(demo), demo[-1].state.tolist(), demo[[True, False, True]].state.tolist()
        (3, [[1, 1]], [[0, 1], [1, 1]])
        """
        chosen = _rows(rows, len(self))
        return self._map(lambda array: array[chosen])

    def __array__(self, *_: Any, **__: Any) -> NoReturn:
        """Refuse to become one array."""
        raise TypeError("a Demonstration is no array; its attribute `codes` is one")

    def __repr__(self) -> str:
        rows = self._told()
        if rows is None:
            return brief_repr(self)
        (_, n), (_, steps), *counts = rows
        return joined(type(self).__name__, [n, steps, *(f"{count} {name}" for name, count in counts)])

    def _repr_html_(self) -> str:
        rows = self._told()
        return brief_table(type(self).__name__, fields_of(self) if rows is None else rows)

    def _told(self) -> list[tuple[str, str]] | None:
        """Describe the contents in words; None if JAX put something else into the fields."""
        if not readable(self.kind) or np.ndim(self.kind) != 2:
            return None
        kind = np.asarray(self.kind)
        n, steps = counted(len(kind), "trajectory"), step_range(self.lengths)
        kinds = (("seen", SEEN), ("hidden", HIDDEN), ("lost", LOST))
        return [("trajectories", n), ("steps", steps), *((name, str((kind == k).sum())) for name, k in kinds)]

    def _map(self, change: Callable[[np.ndarray], np.ndarray]) -> Demonstration:
        return Demonstration(*(change(np.asarray(x)) for x in self.arrays))

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Kind, state, action and score, each ``[n, L]``."""
        return self.kind, self.state, self.action, self.score

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories, padding rows included."""
        return len(self)

    @property
    def lengths(self) -> Int[np.ndarray, " n"]:
        """Steps of each trajectory."""
        return (np.asarray(self.kind) != PAD).sum(-1)

    @property
    def codes(self) -> Int[np.ndarray, "n L 3"]:
        """Kind, state and action as one integer array: the value type of :class:`TrajectoryLaw`."""
        return np.stack([np.asarray(x, np.int32) for x in (self.kind, self.state, self.action)], axis=-1)

    @staticmethod
    def from_codes(codes: Int[np.ndarray, "n L 3"]) -> Demonstration:
        """Build a demonstration from :attr:`codes` (without scores)."""
        codes = np.asarray(codes)
        return Demonstration(
            codes[..., 0].astype(np.int8),
            codes[..., 1].astype(np.int32),
            codes[..., 2].astype(np.int32),
            np.full(codes.shape[:-1], np.nan),
        )

    @staticmethod
    def from_pairs(states: Int[ArrayLike, "n L"], actions: Int[ArrayLike, "n L"]) -> Demonstration:
        """Build fully observed trajectories of one length from whole numbers ``[n, L]`` or ``[L]``.

        Floats must be whole. Use :meth:`from_arrays` if steps are hidden or trajectories differ in length.
        Raises :class:`DemonstrationError` naming trajectory and step, ``ValueError`` for other shapes and
        ``TypeError`` for arrays of other types.
        """
        return _from_arrays(states, actions, complete=True)

    @staticmethod
    def from_arrays(
        states: Int[ArrayLike, "n L"],
        actions: Int[ArrayLike, "n L"],
        *,
        seen: Bool[ArrayLike, "n L"] | None = None,
        lost: Bool[ArrayLike, "n L"] | None = None,
        lengths: Int[ArrayLike, " n"] | None = None,
        scores: Float[ArrayLike, "n L"] | None = None,
        missing: float | None = None,
    ) -> Demonstration:
        """Build trajectories from arrays in which steps may be hidden.

        Arrays are NumPy's, JAX's, masked arrays, or pandas' series and frames (a row is a trajectory). A
        coordinate is unknown where its array is masked, where pandas has a missing value, or where it equals
        ``missing``. A step of which both coordinates are unknown is hidden.

        Parameters
        ----------
        states, actions : int ``[n, L]`` or ``[L]``
            Whole numbers; floats are accepted if they are whole.
        seen : bool ``[n, L]``, optional
            False hides a step, whatever the arrays hold there: the sensor was on and saw no expert.
        lost : bool ``[n, L]``, optional
            True marks a lost frame, whatever the arrays hold there: the sensor gave no evidence.
        lengths : int ``[n]``, optional
            Steps of each trajectory; the rest is padding, whatever the arrays hold there.
        scores : float ``[n, L]``, optional
            Perception's confidence in [0, 1]; NaN if it gave none.
        missing : number, optional
            The value of an unknown coordinate, such as -1 or NaN.

        Raises
        ------
        DemonstrationError
            For a number that is fractional, negative or beyond 32 bits, for a score outside [0, 1], and for a
            step marked by ``seen`` without a state and an action; names trajectory and step.
        ValueError
            For arrays of other shapes, and lengths outside 0 to ``L``.
        TypeError
            For arrays that do not hold numbers.

        Examples
        --------
        >>> demo = Demonstration.from_arrays([[0, 1, -1], [2, 0, 0]], [[1, 1, -1], [0, 0, 0]],
        ...                                  lengths=[3, 2], missing=-1)
        >>> demo.kind.tolist()
        [[1, 1, 2], [1, 1, 0]]
        """
        return _from_arrays(
            states, actions, seen=seen, lost=lost, lengths=lengths, scores=scores, missing=missing
        )

    @staticmethod
    def from_steps(
        trajectories: Iterable[Sequence[Step] | Int[np.ndarray, "L 2"]], mdp: TabularMDP
    ) -> Demonstration:
        """Build from lists of steps as in the interchange format.

        A seen pair may also be a tuple, a list or an array ``(s, a)``, and a trajectory an array ``[L, 2]``.
        Raises :class:`DemonstrationError` naming trajectory and step, and ``TypeError`` for anything but
        lists of lists of steps.
        """
        names = _Names(mdp)
        return _stack([_row(steps, names, i) for i, steps in enumerate(_iterated(trajectories))])

    def select(self, rows: slice | np.ndarray | list[int]) -> Demonstration:
        """Select some of the trajectories."""
        return self[rows]

    def padded(self, n_trajectories: int, length: int) -> Demonstration:
        """Pad to a larger array, so that one compiled program serves many sizes."""
        n, width = self.kind.shape
        if n > n_trajectories or width > length:
            raise ValueError(
                f"a demonstration of shape {(n, width)} does not fit into {(n_trajectories, length)}"
            )
        grow = ((0, n_trajectories - n), (0, length - width))
        fills = (PAD, UNKNOWN, UNKNOWN, np.nan)
        return Demonstration(
            *(
                np.pad(np.asarray(x), grow, constant_values=fill)
                for x, fill in zip(self.arrays, fills, strict=True)
            )
        )

    def bucketed(self) -> Demonstration:
        """Pad to the next powers of two: ragged sessions then have only a few shapes."""
        n, width = self.kind.shape
        return self.padded(_power_of_two(n), _power_of_two(width))

    def sessions(self, trajectories: int = 1) -> Iterator[Demonstration]:
        """Split into consecutive sessions of ``trajectories`` each (Definition 4); the last may be short."""
        if trajectories < 1:
            raise ValueError(f"a session needs at least one trajectory, got {trajectories}")
        for start in range(0, self.n_trajectories, trajectories):
            yield self.select(slice(start, start + trajectories))

    def fragments(self, length: int) -> Demonstration:
        """Cut every trajectory into consecutive windows of at most ``length`` steps."""
        if length < 1:
            raise ValueError(f"a fragment needs at least one step, got {length}")
        parts = [
            self._map(itemgetter((slice(i, i + 1), slice(start, start + length))))
            for i, total in enumerate(self.lengths)
            for start in range(0, int(total), length)
        ]
        return concatenate(parts)


def concatenate(demonstrations: Sequence[Demonstration]) -> Demonstration:
    """Concatenate the trajectories of several demonstrations, padded to the longest.

    See Also
    --------
    i2rl.models.Demonstration : its methods select, cut and pad trajectories

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import concatenate
    >>> demonstration = five_cells().demonstration  # eight trajectories of six steps
    >>> first, second = demonstration.select([0, 1, 2]), demonstration.select([3]).fragments(3)
    >>> concatenate([first, second]).lengths.tolist()
    [6, 6, 6, 3, 3]
    """
    if not demonstrations:
        raise ValueError("nothing to concatenate")
    width = max(d.kind.shape[1] for d in demonstrations)
    grown = [d.padded(d.n_trajectories, width) for d in demonstrations]
    return Demonstration(*(np.concatenate(parts) for parts in zip(*(d.arrays for d in grown), strict=True)))


def _rows(given: Any, n: int) -> Any:
    """Convert a selection of trajectories to an index that keeps their axis."""
    if isinstance(given, slice):
        return given
    try:
        rows = np.asarray(given)
    except ValueError:  # lists of different lengths
        rows = np.zeros(0, "U1")
    if not rows.size and rows.dtype.kind == "f":  # an empty list
        rows = rows.astype(int)
    if rows.dtype.kind not in "biu" or rows.ndim > 1 or (rows.dtype.kind == "b" and rows.ndim == 0):
        raise TypeError(
            f"trajectories must be selected by a number, a slice, a mask [n] or numbers; "
            f"got {shortened(given)}"
        )
    if rows.dtype.kind == "b":
        if len(rows) != n:
            raise IndexError(f"a mask of {n} trajectories has as many entries; got {len(rows)}")
        return rows
    rows = np.atleast_1d(rows)
    beyond = rows[(rows < -n) | (rows >= n)]
    if beyond.size:
        raise IndexError(f"trajectories must lie in 0 to {n - 1}; got {beyond[0]}")
    return rows


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 0).bit_length()


def _stack(rows: list[list[tuple[int, int, int, float]]]) -> Demonstration:
    width = max((len(row) for row in rows), default=0)
    demo = _padding((len(rows), max(width, 1)))
    for i, row in enumerate(rows):
        for array, values in zip(demo.arrays, zip(*row, strict=True), strict=False):
            array[i, : len(row)] = values
    return demo


def _padding(shape: tuple[int, ...]) -> Demonstration:
    return Demonstration(
        np.full(shape, PAD, np.int8),
        np.full(shape, UNKNOWN, np.int32),
        np.full(shape, UNKNOWN, np.int32),
        np.full(shape, np.nan),
    )


def _iterated(trajectories: Any) -> Iterator[Any]:
    named = isinstance(trajectories, str | bytes | dict | Demonstration)
    if named or not isinstance(trajectories, Iterable):
        raise TypeError(
            f"trajectories must be a list of lists of steps; got a {type(trajectories).__name__}: "
            f"{shortened(trajectories)}"
        )
    return iter(trajectories)


def _row(steps: Any, names: _Names, trajectory: int) -> list[tuple[int, int, int, float]]:
    if isinstance(steps, str | bytes | dict) or not isinstance(steps, Iterable):
        raise TypeError(
            f"a trajectory must be a list of steps or an array [L, 2]; got {shortened(steps)} "
            f"(trajectory {trajectory})"
        )
    if hasattr(steps, "__array__") and getattr(steps, "ndim", 0) == 2 and not np.ma.isMaskedArray(steps):
        steps = np.asarray(steps)
    row = []
    for t, step in enumerate(steps):
        if isinstance(step, list) or (isinstance(step, np.ndarray) and step.ndim):
            step = tuple(step)
        try:
            row.append(names.step(step))
        except DemonstrationError as error:
            raise DemonstrationError(f"trajectory {trajectory}, step {t}: {error}") from None
    return row


# -- arrays -------------------------------------------------------------------------------------------


def _from_arrays(
    states: Any,
    actions: Any,
    *,
    seen: Any = None,
    lost: Any = None,
    lengths: Any = None,
    scores: Any = None,
    missing: float | None = None,
    complete: bool = False,
) -> Demonstration:
    """Build trajectories as :meth:`Demonstration.from_arrays` does; ``complete`` refuses missing values."""
    (s, no_state), (a, no_action) = (
        _numbers(name, given, missing) for name, given in (("states", states), ("actions", actions))
    )
    if s.shape != a.shape:
        raise ValueError(f"states and actions must have one shape, got {s.shape} and {a.shape}")
    n, width = s.shape
    ends = _lengths(lengths, n, width)
    live = np.arange(width) < ends[:, None]
    gone = np.zeros(s.shape, bool) if lost is None else _flags("lost", lost, s.shape)
    shown = ~(no_state & no_action) if seen is None else _flags("seen", seen, s.shape)
    contradicted = live & ~gone & shown & no_state & no_action
    if contradicted.any():
        _refuse(contradicted, "a seen step must have a state or an action; both are missing")
    hint = "; from_arrays takes hidden steps" if complete else "; `missing` names a value for hidden steps"
    if complete and (no_state | no_action).any():
        _refuse(no_state | no_action, f"states and actions must not be missing{hint}")
    here = live & ~gone & shown
    known = here & ~no_state, here & ~no_action
    demo = _padding(s.shape)
    demo.kind[...] = np.where(live, np.where(gone, LOST, np.where(shown, SEEN, HIDDEN)), PAD)
    demo.state[...] = _indices("states", s, known[0], hint)
    demo.action[...] = _indices("actions", a, known[1], hint)
    if scores is not None:
        given, unscored = _numbers("scores", scores, None)
        if given.shape != s.shape:
            raise ValueError(f"scores must have shape {s.shape}, got {given.shape}")
        score = np.where(here & ~unscored, given, np.nan).astype(float)
        wrong = (score < 0) | (score > 1)
        if wrong.any():
            _refuse(wrong, f"scores must lie in [0, 1]; got {score[wrong][0]}")
        demo.score[...] = score
    return demo


def _numbers(name: str, given: Any, missing: float | None) -> tuple[np.ndarray, Bool[np.ndarray, "n L"]]:
    """Convert to numbers ``[n, L]`` of any type, and mark the missing ones."""
    absent: Any = False
    if hasattr(given, "isna") and hasattr(given, "to_numpy"):  # pandas
        absent = np.asarray(given.isna())
        # Beside a missing value, 64-bit integers would become floats and be rounded.
        given = given.to_numpy(dtype=object, na_value=0) if absent.any() else given.to_numpy()
    elif isinstance(given, list | tuple) and any(isinstance(row, np.ma.MaskedArray) for row in given):
        given = np.ma.stack(given)
    if isinstance(given, np.ma.MaskedArray):
        absent, given = np.ma.getmaskarray(given), given.data
    try:
        array = np.asarray(given)
    except ValueError:
        raise ValueError(
            f"{name} must be an array [n, L]; got rows of different lengths: pad them and give lengths"
        ) from None
    if array.dtype.kind == "O" and all(type(x) in (int, float) for x in array.flat):
        whole = all(type(x) is int and -(2**63) <= x < 2**63 for x in array.flat)
        array = array.astype(np.int64) if whole else np.vectorize(_as_float, otypes=[float])(array)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{name} must be numbers; got {array.dtype} (from_steps takes names)")
    if array.ndim not in (1, 2) or array.shape[-1] == 0:
        raise ValueError(f"{name} must have shape [n, L] or [L] with at least one step, got {array.shape}")
    absent = np.broadcast_to(absent, array.shape)
    if missing is not None:
        if not isinstance(missing, int | float | np.number):
            raise TypeError(
                f"`missing` must be a number that stands for what was not seen; got {shortened(missing)}; "
                "missing values of pandas and masks are found without it"
            )
        absent = absent | (np.isnan(array) if missing != missing else array == missing)
    return np.atleast_2d(array), np.atleast_2d(absent)


def _as_float(number: float) -> float:
    try:
        return float(number)
    except OverflowError:
        return math.inf


def _indices(
    name: str, numbers: np.ndarray, known: Bool[np.ndarray, "n L"], hint: str
) -> Int[np.ndarray, "n L"]:
    """Convert known numbers to indices, others to ``UNKNOWN``."""
    with np.errstate(invalid="ignore"):
        wrong = known & ~((numbers >= 0) & (numbers < 2**31) & (numbers == np.floor(numbers)))
    if wrong.any():
        value = numbers[wrong][0]
        advice = "" if value >= 0 else hint
        _refuse(wrong, f"{name} must be whole numbers from 0 to 2147483647; got {value}{advice}")
    indices = np.full(numbers.shape, UNKNOWN, np.int32)
    indices[known] = numbers[known]
    return indices


def _flags(name: str, given: Any, shape: tuple[int, ...]) -> Bool[np.ndarray, "n L"]:
    array = np.atleast_2d(given.filled(False) if isinstance(given, np.ma.MaskedArray) else np.asarray(given))
    if array.dtype != bool or array.shape != shape:
        raise ValueError(f"{name} must be booleans {list(shape)}; got {array.dtype} {list(array.shape)}")
    return array


def _lengths(given: Any, n: int, width: int) -> Int[np.ndarray, " n"]:
    if given is None:
        return np.full(n, width)
    array = np.atleast_1d(np.asarray(given))
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise ValueError(f"lengths must be integers [{n}]; got {array.dtype} {list(array.shape)}")
    wrong = np.flatnonzero((array < 0) | (array > width))
    if len(wrong):
        raise ValueError(
            f"lengths must lie between 0 and {width}; got {array[wrong[0]]} (trajectory {wrong[0]})"
        )
    return array


def _refuse(wrong: Bool[np.ndarray, "n L"], message: str) -> NoReturn:
    i, t = np.argwhere(wrong)[0]
    raise DemonstrationError(f"trajectory {i}, step {t}: {message}")


# -- JSON Lines ---------------------------------------------------------------------------------------


class _Names:
    """Names and indices of states and actions, with errors in the user's terms."""

    def __init__(self, mdp: TabularMDP) -> None:
        if not isinstance(mdp, TabularMDP):
            more = "; pass its mdp" if isinstance(getattr(mdp, "mdp", None), TabularMDP) else ""
            raise TypeError(f"mdp must be a TabularMDP; got a {type(mdp).__name__}{more}")
        self.counts = {"state": mdp.n_states, "action": mdp.n_actions}
        self.indices = {
            "state": _index(mdp.labels.states, "s", mdp.n_states),
            "action": _index(mdp.labels.actions, "a", mdp.n_actions),
        }

    def resolve(self, value: Any, kind: str) -> int:
        count = self.counts[kind]
        if isinstance(value, bool) or not isinstance(value, int | np.integer | str):
            raise DemonstrationError(f"{kind} must be a name or an index, got {shortened(value)}")
        if isinstance(value, str):
            index = self.indices[kind].get(value)
            if index is None:
                raise DemonstrationError(
                    f"unknown {kind} {shortened(value)}; known are {listed(self.indices[kind])}"
                )
            return index
        if not 0 <= value < count:
            raise DemonstrationError(
                f"{kind} {shortened(value)} is out of range; indices run from 0 to {count - 1}"
            )
        return int(value)

    def step(self, step: Any) -> tuple[int, int, int, float]:
        """Return kind, state, action and score of a step; :class:`DemonstrationError` lacks the place."""
        if step is None:
            return LOST, UNKNOWN, UNKNOWN, math.nan
        if isinstance(step, str) and step == "hidden":
            return HIDDEN, UNKNOWN, UNKNOWN, math.nan
        if isinstance(step, tuple) and len(step) == 2:
            step = {"s": step[0], "a": step[1]}
        if not isinstance(step, dict):
            raise DemonstrationError(
                f'a step is {{"s": ..., "a": ...}}, "hidden" or null for a lost frame, got {shortened(step)}'
            )
        unknown = step.keys() - {"s", "a", "score"}
        if unknown:
            raise DemonstrationError(
                f"unknown field {shortened(min(unknown, key=str))}; a step has s, a and score"
            )
        if step.get("s") is None and step.get("a") is None:
            raise DemonstrationError('a seen step needs "s" or "a"; write "hidden" or null instead')
        state = UNKNOWN if step.get("s") is None else self.resolve(step["s"], "state")
        action = UNKNOWN if step.get("a") is None else self.resolve(step["a"], "action")
        score = step.get("score")
        if score is None:
            return SEEN, state, action, math.nan
        if isinstance(score, bool) or not isinstance(score, int | float | np.number) or not 0 <= score <= 1:
            raise DemonstrationError(f"score must lie in [0, 1], got {shortened(score)}")
        return SEEN, state, action, float(score)


def _index(names: tuple[str, ...] | None, prefix: str, count: int) -> dict[str, int]:
    return {name: i for i, name in enumerate(names or (f"{prefix}{i}" for i in range(count)))}


class LineLimits(NamedTuple):
    """Limits of a line of a file, so that reading it takes bounded memory.

    Fields
    ------
    size : int
        Bytes of a line, or characters of a line of text; 4 Mi by default. Parsing takes up to 30 bytes of
        memory for each.
    steps : int
        Steps of a trajectory, or nodes of a bout; 10,000 by default. A learner's memory grows with this
        number times states times actions.
    """

    size: int = 4 * 2**20
    steps: int = 10_000


DEFAULT_LIMITS = LineLimits()


@shown_briefly
class Record(NamedTuple):
    """One line of a file: its number, its ``id`` and ``agent`` (None if absent), and the trajectory."""

    line: int
    id: str | None
    agent: int | None
    demonstration: Demonstration


def parsed_lines(
    lines: Iterable[str | bytes], source: str, first_line: int = 1, limits: LineLimits = DEFAULT_LIMITS
) -> Iterator[tuple[int, str, Any]]:
    """Yield number, place for messages, and content of each line of JSON Lines; skip blank lines.

    Bytes are decoded from UTF-8; a byte order mark may begin the first line of a file. Raises
    :class:`DemonstrationError` naming ``source`` and line for invalid JSON and for lines longer than
    ``limits.size``, and ``TypeError`` for anything but lines.
    """
    if not isinstance(limits, LineLimits):
        raise TypeError(f"limits must be LineLimits(size, steps); got {shortened(limits)}")
    if isinstance(lines, str | bytes | PurePath) or not hasattr(lines, "__iter__"):
        raise TypeError(f"lines must be an open file or a list of lines; got {shortened(lines)}")
    for number, line in enumerate(_decodable(lines, source, first_line), start=first_line):
        where = f"{source}, line {number}"
        if not isinstance(line, str | bytes):
            raise TypeError(f"lines must be lines of text; got {shortened(line)} ({where})")
        if len(line) > limits.size:
            raise DemonstrationError(f"{where}: {too_long(limits, len(line))}")
        if isinstance(line, bytes):
            try:
                line = line.decode()
            except UnicodeDecodeError as error:
                raise DemonstrationError(f"{where}: not UTF-8 text at byte {error.start + 1}") from None
        text = line.removeprefix("\ufeff") if number == 1 else line
        if not text.strip():
            continue
        try:
            yield number, where, parsed_json(text)
        except JSONError as error:
            cut = isinstance(error, JSONSyntaxError) and not line.endswith("\n")
            ending = " (the line has no end: the file may have been cut off)" if cut else ""
            raise DemonstrationError(f"{where}: {error}{ending}") from None


def _decodable(lines: Iterable[str | bytes], source: str, first_line: int) -> Iterator[str | bytes]:
    """Yield the lines; if the file itself decodes them, errors say after which line."""
    read = first_line - 1
    try:
        for line in lines:
            yield line
            read += 1
    except UnicodeDecodeError as error:
        # Files decode ahead of the lines that they yield.
        raise DemonstrationError(
            f"{source}, line {read + 1} or later: not UTF-8 text (byte {error.object[error.start]:#04x})"
        ) from None
    except (EOFError, OSError) as error:  # of a compressed file, say
        raise DemonstrationError(f"{source}, line {read + 1} or later cannot be read: {error}") from None


def read_trajectories(
    lines: Iterable[str | bytes],
    mdp: TabularMDP,
    source: str = "input",
    first_line: int = 1,
    limits: LineLimits = DEFAULT_LIMITS,
) -> Iterator[Record]:
    """Read trajectories from JSON Lines, one at a time.

    A line is an object with ``steps`` and optionally ``id`` (string) and ``agent`` (index of one of several
    experts), or just the list of steps. A step is ``{"s": state, "a": action, "score": c}`` (each by name or
    index; ``s`` or ``a`` may be missing if it was hidden; ``score`` in [0, 1] is optional), ``"hidden"`` (the
    sensor was on and saw no expert) or ``null`` (a lost frame). Blank lines are skipped. ``first_line`` is
    the number of the first line, for a reader that starts midway. ``limits`` bounds the size and steps of a
    line, and thereby the memory that reading it takes. Raises :class:`DemonstrationError` naming ``source``,
    line and step.

    See Also
    --------
    i2rl.models.write_trajectories : writes the same format
    i2rl.models.Demonstration : its from_arrays takes arrays

    Examples
    --------
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import read_trajectories
    >>> lines = ['{"id": "walk", "steps": [{"s": "cell 0", "a": "right"}, "hidden", null]}']
    >>> [record] = read_trajectories(lines, five_cells().mdp)
    >>> record.id, record.demonstration.kind.tolist()  # 1 is seen, 2 hidden, 3 lost
    ('walk', [[1, 2, 3]])
    """
    names = _Names(mdp)
    for number, where, content in parsed_lines(lines, source, first_line, limits):
        identity = agent = None
        if isinstance(content, dict):
            unknown = content.keys() - {"steps", "id", "agent"}
            if unknown:
                raise DemonstrationError(
                    f"{where}: unknown field {shortened(min(unknown))}; a trajectory has steps, id and agent"
                )
            if "steps" not in content:
                raise DemonstrationError(f'{where}: a trajectory needs the field "steps"')
            identity = identity_of(content.get("id"), where)
            agent = content.get("agent")
            if agent is not None and not (type(agent) is int and -(2**63) <= agent < 2**63):
                raise DemonstrationError(f"{where}: agent must be an integer, got {shortened(agent)}")
            content = content["steps"]
        if not isinstance(content, list) or not content:
            raise DemonstrationError(f"{where}: steps must be a list of at least one step")
        require_few(len(content), "steps", where, limits)
        row = []
        for t, step in enumerate(content):
            try:
                row.append(names.step(step))
            except DemonstrationError as error:
                raise DemonstrationError(f"{where}, step {t}: {error}") from None
        yield Record(number, identity, agent, _stack([row]))


def identity_of(value: Any, where: str) -> str | None:
    """Return the ``id`` of a line, text or a number. Raises :class:`DemonstrationError`."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise DemonstrationError(f"{where}: id must be text, got {shortened(value)}")
    if _SURROGATE.search(text := str(value)):
        raise DemonstrationError(f"{where}: id must be text, got {shortened(text)}, with half a character")
    return text


def require_few(count: int, what: str, where: str, limits: LineLimits) -> None:
    """Raise :class:`DemonstrationError` for more steps on a line than the limit."""
    if count > limits.steps:
        raise DemonstrationError(
            f"{where}: a line must have at most {limits.steps:,} {what}; it has {count:,}: write shorter "
            "trajectories or raise `LineLimits.steps` (--line-steps)"
        )


def too_long(limits: LineLimits, size: int) -> str:
    """Say that a line has more bytes than the limit, ``size`` of them at least."""
    return (
        f"a line must have at most {limits.size:,} bytes; it has {size:,} or more: write shorter "
        "trajectories or raise `LineLimits.size` (--line-bytes)"
    )


def write_trajectories(
    file: IO[str],
    demonstration: Demonstration,
    mdp: TabularMDP,
    *,
    ids: Sequence[str] | None = None,
    agents: Sequence[int] | None = None,
) -> None:
    """Write trajectories as JSON Lines, by name if the MDP has names, otherwise by index.

    Rows of padding alone are left out. ``ids`` (text or integers) and ``agents`` (integers) have an entry
    for every row; ``ValueError`` if not, ``TypeError`` for other entries. Raises :class:`DemonstrationError`
    naming trajectory and step for steps that could not be read back: states and actions that the MDP lacks, a
    seen step without either, a score outside [0, 1].

    See Also
    --------
    i2rl.models.read_trajectories : reads the same format

    Examples
    --------
    >>> import sys
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import Demonstration, write_trajectories
    >>> walk = Demonstration.from_arrays([[0, -1]], [[1, -1]], missing=-1)
    >>> write_trajectories(sys.stdout, walk, five_cells().mdp, ids=["walk"])
    {"id": "walk", "steps": [{"s": "cell 0", "a": "right"}, "hidden"]}
    """
    if not hasattr(file, "write"):
        raise TypeError(f"file must be a file open for writing text; got {shortened(file)}")
    if not isinstance(demonstration, Demonstration):
        raise TypeError(f"demonstration must be a Demonstration; got {shortened(demonstration)}")
    names = _Names(mdp)
    n = demonstration.n_trajectories
    extra = {"id": _per_row("ids", ids, n, text=True), "agent": _per_row("agents", agents, n, text=False)}
    arrays = [np.asarray(x) for x in demonstration.arrays]
    for i, total in enumerate(demonstration.lengths):
        if not total:
            continue
        steps = []
        columns = (x[i, :total].tolist() for x in arrays)
        for t, (kind, state, action, score) in enumerate(zip(*columns, strict=True)):
            try:
                steps.append(_written(kind, state, action, score, names, mdp))
            except DemonstrationError as error:
                raise DemonstrationError(f"trajectory {i}, step {t}: {error}") from None
        record = {field: entries[i] for field, entries in extra.items() if entries is not None}
        file.write(json.dumps(record | {"steps": steps}) + "\n")


def _written(kind: int, state: int, action: int, score: float, names: _Names, mdp: TabularMDP) -> Any:
    """Write a step as JSON. Raises :class:`DemonstrationError` for one that could not be read back."""
    if kind in (HIDDEN, LOST):
        return "hidden" if kind == HIDDEN else None
    if kind != SEEN:
        raise DemonstrationError(f"kind must be 1 (seen), 2 (hidden) or 3 (lost) before padding; got {kind}")
    step: dict[str, Any] = {}
    if state != UNKNOWN:
        step["s"] = state
    if action != UNKNOWN:
        step["a"] = action
    if not math.isnan(score):
        step["score"] = score
    names.step(step)
    for field, labels in (("s", mdp.labels.states), ("a", mdp.labels.actions)):
        if labels is not None and field in step:
            step[field] = labels[step[field]]
    return step


def _per_row(field: str, given: Iterable[Any] | None, n: int, *, text: bool) -> list[Any] | None:
    if given is None:
        return None
    entries = list(given)
    if len(entries) != n:
        raise ValueError(f"{len(entries)} {field} were given for {n} trajectories")
    for i, entry in enumerate(entries):
        if isinstance(entry, int | np.integer) and not isinstance(entry, bool):
            if not text and not -(2**63) <= entry < 2**63:
                raise ValueError(
                    f"{field} must be integers of 64 bits; got {shortened(entry)} (trajectory {i})"
                )
            entries[i] = str(entry) if text else int(entry)
        elif not text or not isinstance(entry, str) or _SURROGATE.search(entry):
            wanted = "text or integers" if text else "integers"
            raise TypeError(f"{field} must be {wanted}; got {shortened(entry)} (trajectory {i})")
    return entries
