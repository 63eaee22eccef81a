"""Decision processes as files: one NPZ archive of plain arrays, no pickles."""

from __future__ import annotations

import os
import zipfile
import zlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .evidence import Visibility
from .mdp import TabularMDP

_ARRAYS = ("successors", "probabilities", "features", "initial", "discount", "available")
_NAMES = ("states", "actions", "feature_names")


class StoredMDP(NamedTuple):
    """An MDP read from a file, and the learner's view ``[S]`` if the file has one."""

    mdp: TabularMDP
    in_view: Float[np.ndarray, " S"] | None


def save_mdp(path: str | os.PathLike[str], mdp: TabularMDP, in_view: np.ndarray | None = None) -> None:
    """Write an MDP, and optionally a view (mask or probabilities ``[S]``), to an ``.npz`` file.

    The arrays ``successors``, ``probabilities`` (``[S, A, B]``), ``features`` ``[S, A, K]``, ``initial``
    ``[S]``, ``discount`` and ``available`` ``[S, A]`` are those of :meth:`TabularMDP.from_successors`;
    ``states``, ``actions`` and ``feature_names`` hold names where there are any. Raises ``ValueError`` for a
    path that does not end in ``.npz`` (NumPy would add it) or a view of the wrong shape.
    """
    if not str(path).endswith(".npz"):
        raise ValueError(f"an MDP archive ends in .npz, got {path}")
    if in_view is not None and np.shape(in_view) != (mdp.n_states,):
        raise ValueError(f"in_view must have shape [{mdp.n_states}], got {list(np.shape(in_view))}")
    arrays = {name: np.asarray(getattr(mdp, name)) for name in _ARRAYS}
    labels = (mdp.labels.states, mdp.labels.actions, mdp.labels.features)
    arrays |= {name: np.array(values) for name, values in zip(_NAMES, labels, strict=True) if values}
    if in_view is not None:
        arrays["in_view"] = np.asarray(in_view, float)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def load_mdp(path: str | os.PathLike[str]) -> StoredMDP:
    """Read what :func:`save_mdp` wrote, or an archive made by other means with the same arrays.

    Only ``successors``, ``probabilities`` and ``features`` are required. Raises ``ValueError`` naming the
    file and what is wrong with it, ``FileNotFoundError`` if there is none.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"{path}: not an MDP archive (.npz of plain arrays): {error}") from None
    missing = [name for name in _ARRAYS[:3] if name not in arrays]
    unknown = sorted(set(arrays) - {*_ARRAYS, *_NAMES, "in_view"})
    if missing or unknown:
        problem = f"misses the array {missing[0]!r}" if missing else f"has an unknown array {unknown[0]!r}"
        raise ValueError(f"{path}: an MDP archive {problem}; it has {', '.join(_ARRAYS)} and optional names")
    try:
        options: dict[str, object] = {n: arrays[n] for n in ("initial", "available") if n in arrays}
        if "discount" in arrays:
            options["discount"] = float(arrays["discount"])
        options |= {name: [str(x) for x in arrays[name]] for name in _NAMES if name in arrays}
        mdp = TabularMDP.from_successors(
            arrays["successors"], arrays["probabilities"], arrays["features"], **options  # type: ignore[arg-type]
        )  # fmt: skip
        in_view = None if "in_view" not in arrays else np.asarray(Visibility(arrays["in_view"]).in_view)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    if in_view is not None and in_view.shape != (mdp.n_states,):
        raise ValueError(f"{path}: in_view must have shape [{mdp.n_states}], got {list(in_view.shape)}")
    return StoredMDP(mdp, in_view)
