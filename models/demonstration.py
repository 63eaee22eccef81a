"""Demonstrations: what a learner was given, gaps included, and their interchange format.

The format is JSON Lines, one trajectory a line (``docs`` of every field in :func:`read_trajectories`)::

    {"id": "patrol-0", "steps": [{"s": "(0,5) east", "a": "forward"}, "hidden", null, {"s": 3, "score": 0.9}]}
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .mdp import TabularMDP

PAD, SEEN, HIDDEN, LOST = 0, 1, 2, 3
UNKNOWN = -1

Step = dict[str, Any] | tuple[Any, Any] | str | None


class DemonstrationError(ValueError):
    """A demonstration that cannot be read or that the model rules out; names the record at fault."""


class Demonstration(NamedTuple):
    """``n`` trajectories padded to ``L`` steps.

    Fields
    ------
    kind : int8 ``[n, L]``
        ``SEEN``; ``HIDDEN`` (the learner looked and saw nothing, which is itself evidence); ``LOST`` (no
        frame, no evidence); ``PAD`` beyond the trajectory's end.
    state, action : int32 ``[n, L]``
        What was seen; ``UNKNOWN`` (-1) for an unseen coordinate.
    score : float ``[n, L]``
        Perception's confidence in a seen pair, NaN where it gave none.
    """

    kind: Int[np.ndarray, "n L"]
    state: Int[np.ndarray, "n L"]
    action: Int[np.ndarray, "n L"]
    score: Float[np.ndarray, "n L"]

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories, padding rows included."""
        return self.kind.shape[0]

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
        """Inverse of :attr:`codes` (without scores)."""
        codes = np.asarray(codes)
        return Demonstration(
            codes[..., 0].astype(np.int8),
            codes[..., 1].astype(np.int32),
            codes[..., 2].astype(np.int32),
            np.full(codes.shape[:-1], np.nan),
        )

    @staticmethod
    def from_pairs(states: Int[np.ndarray, "n L"], actions: Int[np.ndarray, "n L"]) -> Demonstration:
        """Fully observed trajectories of one length."""
        states = np.atleast_2d(np.asarray(states, np.int32))
        actions = np.atleast_2d(np.asarray(actions, np.int32))
        if states.shape != actions.shape:
            raise ValueError(
                f"states and actions must have one shape, got {states.shape} and {actions.shape}"
            )
        return Demonstration(
            np.full(states.shape, SEEN, np.int8), states, actions, np.full(states.shape, np.nan)
        )

    @staticmethod
    def from_steps(trajectories: Iterable[Sequence[Step]], mdp: TabularMDP) -> Demonstration:
        """From lists of steps as in the interchange format (pairs may also be tuples ``(s, a)``).

        Raises :class:`DemonstrationError` naming trajectory and step.
        """
        names = _Names(mdp)
        rows = [
            [names.step(step, f"trajectory {i}, step {t}") for t, step in enumerate(steps)]
            for i, steps in enumerate(trajectories)
        ]
        return _stack(rows)

    def select(self, rows: slice | np.ndarray | list[int]) -> Demonstration:
        """Some of the trajectories."""
        return Demonstration(*(np.asarray(x)[rows] for x in self))

    def padded(self, n_trajectories: int, length: int) -> Demonstration:
        """The same demonstration in a larger array, so that one compiled program serves many sizes."""
        n, width = self.kind.shape
        if n > n_trajectories or width > length:
            raise ValueError(
                f"a demonstration of shape {(n, width)} does not fit into {(n_trajectories, length)}"
            )
        grow = ((0, n_trajectories - n), (0, length - width))
        fills = (PAD, UNKNOWN, UNKNOWN, np.nan)
        return Demonstration(
            *(np.pad(np.asarray(x), grow, constant_values=fill) for x, fill in zip(self, fills, strict=True))
        )

    def bucketed(self) -> Demonstration:
        """Padded to the next powers of two: streams of ragged sessions meet only a few shapes."""
        n, width = self.kind.shape
        return self.padded(_power_of_two(n), _power_of_two(width))

    def sessions(self, trajectories: int = 1) -> Iterator[Demonstration]:
        """Split into consecutive sessions of so many trajectories (Definition 4); the last may be shorter."""
        if trajectories < 1:
            raise ValueError(f"a session needs at least one trajectory, got {trajectories}")
        for start in range(0, self.n_trajectories, trajectories):
            yield self.select(slice(start, start + trajectories))

    def fragments(self, length: int) -> Demonstration:
        """Cut every trajectory into consecutive windows of at most ``length`` steps."""
        if length < 1:
            raise ValueError(f"a fragment needs at least one step, got {length}")
        parts = [
            Demonstration(*(np.asarray(x)[i : i + 1, start : start + length] for x in self))
            for i, total in enumerate(self.lengths)
            for start in range(0, int(total), length)
        ]
        return concatenate(parts)


def concatenate(demonstrations: Sequence[Demonstration]) -> Demonstration:
    """All trajectories of several demonstrations, padded to the longest."""
    if not demonstrations:
        raise ValueError("nothing to concatenate")
    width = max(d.kind.shape[1] for d in demonstrations)
    grown = [d.padded(d.n_trajectories, width) for d in demonstrations]
    return Demonstration(*(np.concatenate(parts) for parts in zip(*grown, strict=True)))


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 0).bit_length()


def _stack(rows: list[list[tuple[int, int, int, float]]]) -> Demonstration:
    width = max((len(row) for row in rows), default=0)
    shape = (len(rows), max(width, 1))
    demo = Demonstration(
        np.full(shape, PAD, np.int8), np.full(shape, UNKNOWN, np.int32),
        np.full(shape, UNKNOWN, np.int32), np.full(shape, np.nan),
    )  # fmt: skip
    for i, row in enumerate(rows):
        for t, values in enumerate(row):
            for array, value in zip(demo, values, strict=True):
                array[i, t] = value
    return demo


class _Names:
    """Resolves names and indices of states and actions, with errors in the user's terms."""

    def __init__(self, mdp: TabularMDP) -> None:
        self.counts = {"state": mdp.n_states, "action": mdp.n_actions}
        self.indices = {
            "state": _index(mdp.labels.states, "s", mdp.n_states),
            "action": _index(mdp.labels.actions, "a", mdp.n_actions),
        }

    def resolve(self, value: Any, kind: str, where: str) -> int:
        count = self.counts[kind]
        if isinstance(value, bool) or not isinstance(value, int | np.integer | str):
            raise DemonstrationError(f"{where}: {kind} must be a name or an index, got {value!r}")
        if isinstance(value, str):
            index = self.indices[kind].get(value)
            if index is None:
                known = ", ".join(list(self.indices[kind])[:4])
                raise DemonstrationError(f"{where}: unknown {kind} {value!r}; known are {known}, ...")
            return index
        if not 0 <= value < count:
            raise DemonstrationError(
                f"{where}: {kind} {value} is out of range; indices run from 0 to {count - 1}"
            )
        return int(value)

    def step(self, step: Step, where: str) -> tuple[int, int, int, float]:
        if step is None:
            return LOST, UNKNOWN, UNKNOWN, math.nan
        if step == "hidden":
            return HIDDEN, UNKNOWN, UNKNOWN, math.nan
        if isinstance(step, tuple) and len(step) == 2:
            step = {"s": step[0], "a": step[1]}
        if not isinstance(step, dict):
            raise DemonstrationError(
                f'{where}: a step is {{"s": ..., "a": ...}}, "hidden" or null for a lost frame, got {step!r}'
            )
        unknown = set(step) - {"s", "a", "score"}
        if unknown:
            raise DemonstrationError(
                f"{where}: unknown field {sorted(unknown)[0]!r}; a step has s, a and score"
            )
        if step.get("s") is None and step.get("a") is None:
            raise DemonstrationError(f'{where}: a seen step needs "s" or "a"; write "hidden" or null instead')
        state = UNKNOWN if step.get("s") is None else self.resolve(step["s"], "state", where)
        action = UNKNOWN if step.get("a") is None else self.resolve(step["a"], "action", where)
        score = step.get("score")
        if score is None:
            return SEEN, state, action, math.nan
        if isinstance(score, bool) or not isinstance(score, int | float | np.number) or not 0 <= score <= 1:
            raise DemonstrationError(f"{where}: score must lie in [0, 1], got {score!r}")
        return SEEN, state, action, float(score)


def _index(names: tuple[str, ...] | None, prefix: str, count: int) -> dict[str, int]:
    return {name: i for i, name in enumerate(names or (f"{prefix}{i}" for i in range(count)))}


class Record(NamedTuple):
    """One line of a file: its number, its ``id`` and ``agent`` (None if absent), and the trajectory."""

    line: int
    id: str | None
    agent: int | None
    demonstration: Demonstration


def parsed_lines(lines: Iterable[str], source: str, first_line: int = 1) -> Iterator[tuple[int, str, Any]]:
    """Number, place for messages, and content of each line of JSON Lines; blank lines are skipped.

    Raises :class:`DemonstrationError` naming ``source`` and line.
    """
    for number, line in enumerate(lines, start=first_line):
        if not line.strip():
            continue
        where = f"{source}, line {number}"
        try:
            yield number, where, json.loads(line)
        except json.JSONDecodeError as error:
            ending = "" if line.endswith("\n") else " (the line has no end: the file may have been cut off)"
            raise DemonstrationError(
                f"{where}: not valid JSON at character {error.pos + 1}: {error.msg}{ending}"
            ) from None


def read_trajectories(
    lines: Iterable[str], mdp: TabularMDP, source: str = "input", first_line: int = 1
) -> Iterator[Record]:
    """Read trajectories from JSON Lines, one at a time.

    A line is an object with ``steps`` and optionally ``id`` (string) and ``agent`` (which of several
    experts, an integer), or just the list of steps. A step is ``{"s": state, "a": action, "score": c}``
    (each by name or index; ``s`` or ``a`` may be missing if it was not perceived; ``score`` in [0, 1] is
    optional), ``"hidden"`` (looked, saw nothing) or ``null`` (a lost frame). Blank lines are skipped;
    ``first_line`` is the number of the first one, for a reader that starts midway.
    Raises :class:`DemonstrationError` naming ``source``, line and step.
    """
    names = _Names(mdp)
    for number, where, content in parsed_lines(lines, source, first_line):
        identity = agent = None
        if isinstance(content, dict):
            unknown = set(content) - {"steps", "id", "agent"}
            if unknown:
                raise DemonstrationError(
                    f"{where}: unknown field {sorted(unknown)[0]!r}; a trajectory has steps, id and agent"
                )
            if "steps" not in content:
                raise DemonstrationError(f'{where}: a trajectory needs the field "steps"')
            identity = None if content.get("id") is None else str(content["id"])
            agent = content.get("agent")
            if agent is not None and (isinstance(agent, bool) or not isinstance(agent, int)):
                raise DemonstrationError(f"{where}: agent must be an integer, got {agent!r}")
            content = content["steps"]
        if not isinstance(content, list) or not content:
            raise DemonstrationError(f"{where}: steps must be a list of at least one step")
        row = [names.step(step, f"{where}, step {t}") for t, step in enumerate(content)]
        yield Record(number, identity, agent, _stack([row]))


def write_trajectories(
    file: IO[str],
    demonstration: Demonstration,
    mdp: TabularMDP,
    *,
    ids: Sequence[str] | None = None,
    agents: Sequence[int] | None = None,
) -> None:
    """Write trajectories as JSON Lines, by name where the MDP has names, otherwise by index.

    Rows that are all padding are no trajectories and are left out. ``ids`` and ``agents`` have an entry for
    every row; ``ValueError`` if not.
    """
    for field, given in (("ids", ids), ("agents", agents)):
        if given is not None and len(given) != demonstration.n_trajectories:
            raise ValueError(
                f"{len(given)} {field} were given for {demonstration.n_trajectories} trajectories"
            )
    states, actions = mdp.labels.states, mdp.labels.actions
    for i, total in enumerate(demonstration.lengths):
        if not total:
            continue
        steps: list[Any] = []
        for t in range(int(total)):
            kind, s, a, score = (x[i, t] for x in demonstration)
            if kind == HIDDEN:
                steps.append("hidden")
            elif kind == LOST:
                steps.append(None)
            else:
                step: dict[str, Any] = {}
                if s != UNKNOWN:
                    step["s"] = states[s] if states else int(s)
                if a != UNKNOWN:
                    step["a"] = actions[a] if actions else int(a)
                if not math.isnan(score):
                    step["score"] = float(score)
                steps.append(step)
        record: dict[str, Any] = {}
        if ids is not None:
            record["id"] = ids[i]
        if agents is not None:
            record["agent"] = int(agents[i])
        file.write(json.dumps(record | {"steps": steps}) + "\n")
