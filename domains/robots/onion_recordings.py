"""Recordings of a person who sorts onions, as files: reading of released recordings, and writing of ours.

One pair of files a recording, comma-separated without a header. ``states_N.csv`` has 29 columns as in
:mod:`i2rl.domains.robots.reaching`; ``actions_N.csv`` has 3, the wrist's displacement in metres, so that
``wrist[t + 1] - wrist[t]`` is ``action[t]``. Every state has an action; the last action has no successor.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...models.inputs.text import shortened
from ...models.observation.recordings import Recording, RecordingError, recording
from .reaching import BLEMISHED, GONE, ONIONS, SIZE, STRIDE, UNBLEMISHED
from .simulation import Trajectories

_DECIMALS = 2
# States and actions of two decimals may be rounded apart by one and a half of the last.
_ROUNDED = 0.0151


def read_onion_recordings(folder: Path | str, stride: float = STRIDE) -> Recording:
    """Read all recordings of a folder, by number; each is one trajectory to its end, of actions over
    ``stride``.

    Raises :class:`~i2rl.models.observation.recordings.RecordingError` (a ``ValueError``) for a folder without
    any, and naming file, row and column (from 1) for: a row of another length, what is not a finite number, a
    label that is none, an action that does not lead to the next wrist or is longer than ``stride`` along an
    axis, states and actions that are not equally many.

    See Also
    --------
    i2rl.domains.write_onion_recordings : write the files
    i2rl.domains.onion_reaching : the task that is recorded

    Examples
    --------
    >>> import tempfile
    >>> import jax
    >>> from i2rl.domains import read_onion_recordings, write_onion_recordings
    >>> from i2rl.domains.robots.reaching import demonstrate_onions
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = write_onion_recordings(folder, demonstrate_onions(jax.random.key(0), 2))
    ...     recorded = read_onion_recordings(folder)
    >>> len(recorded.lengths), recorded.observations.shape[2]
    (2, 29)
    """
    folder = Path(folder)
    found = [match[1] for path in folder.glob("states_*.csv") if (match := _NUMBERED.fullmatch(path.name))]
    numbers = sorted(found, key=lambda number: (len(number.lstrip("0")), number.lstrip("0"), number))
    if not numbers:
        raise RecordingError(
            f"{folder} has no recordings: expected files states_1.csv and actions_1.csv, and so on"
        )
    states, actions = [], []
    for number in numbers:
        names = (folder / f"states_{number}.csv", folder / f"actions_{number}.csv")
        seen, done = (_rows(path, width) for path, width in zip(names, (SIZE, 3), strict=True))
        _check(*names, seen, done, stride)
        states.append(seen)
        actions.append(done / stride)
    return recording(states, actions, terminated=[True] * len(numbers))


def write_onion_recordings(
    folder: Path | str, trajectories: Trajectories, stride: float = STRIDE
) -> list[Path]:
    """Write trajectories of the task in the same layout, two decimals; return the paths of the states.

    The state after the last step is the last row, with the action zero.

    See Also
    --------
    i2rl.domains.read_onion_recordings : read the files
    i2rl.domains.onion_reaching : the task that is recorded

    Examples
    --------
    >>> import tempfile
    >>> import jax
    >>> from i2rl.domains import write_onion_recordings
    >>> from i2rl.domains.robots.reaching import demonstrate_onions
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = write_onion_recordings(folder, demonstrate_onions(jax.random.key(0), 2))
    >>> [path.name for path in paths]
    ['states_1.csv', 'states_2.csv']
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, live in enumerate(trajectories.live):
        last = trajectories.next_observations[i, live][-1:]
        states = np.concatenate([trajectories.observations[i, live], last]).astype(float).round(_DECIMALS)
        # Differences of what is written, so that they lead from one written wrist to the next.
        actions = np.diff(states[:, 6:9], axis=0, append=states[-1:, 6:9])
        for name, rows in (("states", states), ("actions", actions)):
            path = folder / f"{name}_{i + 1}.csv"
            np.savetxt(path, rows + 0.0, fmt=f"%.{_DECIMALS}f", delimiter=",")
        paths.append(folder / f"states_{i + 1}.csv")
    return paths


_NUMBERED = re.compile(r"states_([0-9]+)\.csv")
# Python also reads 1_000 and digits of other scripts.
_NUMBER = re.compile(r"\s*[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?\s*")
_MAX_ROW = 4096


def _rows(path: Path, width: int) -> Float[np.ndarray, "rows width"]:
    if not path.exists():
        raise RecordingError(f"{path} is missing; each recording has one file of states and one of actions")
    rows = []
    with path.open("rb") as file:
        for r, line in enumerate(iter(lambda: file.readline(_MAX_ROW + 1), b""), 1):
            if len(line) > _MAX_ROW:
                raise RecordingError(f"{path}, row {r}: a row must have at most {_MAX_ROW} characters")
            try:
                cells = line.decode("utf-8-sig" if r == 1 else "utf-8").rstrip("\r\n").split(",")
            except UnicodeDecodeError as error:
                raise RecordingError(f"{path}, row {r}: not UTF-8 text at byte {error.start + 1}") from None
            if len(cells) != width:
                raise RecordingError(f"{path}, row {r}: {len(cells)} columns, expected {width}")
            rows.append(np.array([_number(path, r, c, cell) for c, cell in enumerate(cells, 1)]))
    if len(rows) < 2:
        raise RecordingError(f"{path} has {len(rows)} row(s); at least 2 are needed")
    return np.array(rows)


def _number(path: Path, row: int, column: int, cell: str) -> float:
    number = float(cell) if _NUMBER.fullmatch(cell) else np.nan
    if not np.isfinite(number):
        raise RecordingError(
            f"{path}, row {row}, column {column}: {shortened(cell.strip())} is not a finite number"
        )
    return number


def _check(
    states_path: Path, actions_path: Path, states: np.ndarray, actions: np.ndarray, stride: float
) -> None:
    if len(states) != len(actions):
        raise RecordingError(
            f"{states_path} has {len(states)} rows and {actions_path} {len(actions)}; each state needs its "
            "action"
        )
    labels = states[:, 12 : 12 + 4 * ONIONS : 4]
    wrong = np.argwhere(~np.isin(labels, (GONE, BLEMISHED, UNBLEMISHED)))
    if len(wrong):
        r, onion = wrong[0]
        raise RecordingError(
            f"{states_path}, row {r + 1}, column {13 + 4 * onion}: the label is {labels[r, onion]}; expected "
            "1 (unblemished), 0 (blemished) or -1 (gone)"
        )
    wrong = np.argwhere(np.abs(actions) > stride + 1e-9)
    if len(wrong):
        r, axis = wrong[0]
        raise RecordingError(
            f"{actions_path}, row {r + 1}, column {axis + 1}: a displacement of {actions[r, axis]} m, but an "
            f"action moves the wrist by no more than {stride} m"
        )
    missed = np.abs(np.diff(states[:, 6:9], axis=0) - actions[:-1])
    wrong = np.argwhere(missed > _ROUNDED)
    if len(wrong):
        r, axis = wrong[0]
        raise RecordingError(
            f"{actions_path}, row {r + 1}, column {axis + 1}: the displacement is {actions[r, axis]} m, but "
            f"the wrist moves by {states[r + 1, 6 + axis] - states[r, 6 + axis]:.2f} m to row {r + 2} of "
            f"{states_path.name}"
        )
