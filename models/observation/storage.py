"""Decision processes as files: one NPZ archive of plain arrays, no pickles."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..inputs.archives import MAX_BYTES, StorageError, read_arrays
from ..inputs.display import shown_briefly
from ..inputs.text import shortened
from ..process.mdp import TabularMDP
from .evidence import Visibility

_ARRAYS = ("successors", "probabilities", "features", "initial", "discount", "available")
_NAMES = ("states", "actions", "feature_names")
_KINDS = {
    "successors": "iu",
    "probabilities": "fiu",
    "features": "fiub",
    "initial": "fiu",
    "discount": "fiu",
    "available": "b",
    "in_view": "fiub",
    **dict.fromkeys(_NAMES, "Uiu"),
}


@shown_briefly
class StoredMDP(NamedTuple):
    """An MDP read from a file, and the learner's visibility ``[S]`` if the file has one."""

    mdp: TabularMDP
    in_view: Float[np.ndarray, " S"] | None


def save_mdp(path: str | os.PathLike[str], mdp: TabularMDP, in_view: np.ndarray | None = None) -> None:
    """Write an MDP, and optionally a visibility (mask or probabilities ``[S]``), to an ``.npz`` file.

    The arrays ``successors``, ``probabilities`` (``[S, A, B]``), ``features`` ``[S, A, K]``, ``initial``
    ``[S]``, ``discount`` and ``available`` ``[S, A]`` are those of :meth:`TabularMDP.from_successors`;
    ``states``, ``actions`` and ``feature_names`` hold names if there are any. Raises ``ValueError`` for a
    path that does not end in ``.npz`` (NumPy would add it), visibility of the wrong shape or outside [0, 1],
    and names that end in a NUL character (NumPy would drop it).

    See Also
    --------
    i2rl.models.load_mdp : reads the file

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import load_mdp, save_mdp
    >>> corridor = five_cells()
    >>> with TemporaryDirectory() as folder:
    ...     save_mdp(f"{folder}/corridor.npz", corridor.mdp, corridor.sensor.in_view)
    ...     stored = load_mdp(f"{folder}/corridor.npz")
    >>> stored.in_view.tolist()
    [1.0, 1.0, 0.0, 0.0, 1.0]
    """
    if not isinstance(mdp, TabularMDP):
        raise TypeError(f"mdp must be a TabularMDP; got {shortened(mdp)}")
    if not str(path).endswith(".npz"):
        raise ValueError(f"an MDP archive ends in .npz, got {path}")
    if in_view is not None and np.shape(in_view) != (mdp.n_states,):
        raise ValueError(f"in_view must have shape [{mdp.n_states}], got {list(np.shape(in_view))}")
    arrays = {name: np.asarray(getattr(mdp, name)) for name in _ARRAYS}
    labels = (mdp.labels.states, mdp.labels.actions, mdp.labels.features)
    for name, values in zip(_NAMES, labels, strict=True):
        if values:
            arrays[name] = np.array(values)
            wrong = next((text for text in values if text.endswith("\0")), None)
            if wrong is not None:
                raise ValueError(f"{name} must not end in NUL characters; got {shortened(wrong)}")
    if in_view is not None:
        arrays["in_view"] = np.asarray(Visibility(np.asarray(in_view, float)).in_view)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def load_mdp(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> StoredMDP:
    """Read a file of :func:`save_mdp`, or any archive with the same arrays.

    Only ``successors``, ``probabilities`` and ``features`` are required. The arrays are checked by their
    headers before they are read, and may take ``max_bytes`` in all (1 GiB by default); building the process
    takes about three times their size. Raises :class:`StorageError` (a ``ValueError``) naming the file and
    the fault, and ``OSError`` if the file cannot be opened.

    See Also
    --------
    i2rl.models.save_mdp : writes the file
    i2rl.models.TabularMDP : its from_successors takes the same arrays

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import load_mdp, save_mdp
    >>> with TemporaryDirectory() as folder:
    ...     save_mdp(f"{folder}/corridor.npz", five_cells().mdp)
    ...     stored = load_mdp(f"{folder}/corridor.npz")
    >>> stored.mdp.n_states, stored.mdp.feature_names, stored.in_view
    (5, ('at the end', 'moves'), None)
    """
    arrays = read_arrays(path, _KINDS, required=_ARRAYS[:3], what="MDP archive", max_bytes=max_bytes)
    try:
        options: dict[str, Any] = {n: arrays[n] for n in ("initial", "available") if n in arrays}
        if "discount" in arrays:
            if arrays["discount"].ndim:
                raise ValueError(f"discount must be one number; got shape {list(arrays['discount'].shape)}")
            options["discount"] = float(arrays["discount"])
        options |= {name: _names(name, arrays[name]) for name in _NAMES if name in arrays}
        mdp = TabularMDP.from_successors(
            arrays["successors"], arrays["probabilities"], arrays["features"], **options
        )
        in_view = None if "in_view" not in arrays else np.asarray(Visibility(arrays["in_view"]).in_view)
    except (ValueError, TypeError) as error:
        raise StorageError(f"{path}: {error}") from None
    if in_view is not None and in_view.shape != (mdp.n_states,):
        raise StorageError(f"{path}: in_view must have shape [{mdp.n_states}], got {list(in_view.shape)}")
    return StoredMDP(mdp, in_view)


def _names(name: str, array: np.ndarray) -> list[str]:
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape [n], got {list(array.shape)}")
    return [str(x) for x in array]
