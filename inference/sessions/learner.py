"""The learner protocol (chapter 3): a learner is a pair of functions on an explicit state.

``init(key)`` gives the state before the first session; ``update(state, demonstration)`` runs one session
(Definition 4) and returns the new state and an info. The state holds only what Definition 7 allows, the
reward estimate and the sufficient statistic (with warm starts for the solvers).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from typing_extensions import TypeVar

from ...models.inputs.display import brief, brief_table, joined, shown_briefly
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP

AnyInfo = TypeVar("AnyInfo", bound=tuple)


@shown_briefly
class SessionInfo(NamedTuple):
    """Measures of a session: plain numbers (in a fleet, arrays with one entry per stream).

    Fields
    ------
    session : int
        Its number, from 1.
    log_likelihood : float
        ``LL(theta^i | X_i, statistic)`` in nats per trajectory: of the statistic with the session included,
        under the new weights. The share of the dynamics, which is constant in the weights, is left out, so
        that sessions compare.
    demonstration_log_likelihood : float
        Exact log-likelihood (nats, hidden steps summed out, dynamics included) of this session's
        demonstration alone.
    gradient : float
        Norm of the log-likelihood's gradient in scaled weights (:mod:`~i2rl.models.process.units`) at the
        session's first weights: how far this session's data disagree with them. ``|phi_hat - E[phi]|`` of
        scaled features (line 15 of Algorithm 1) with the features statistic.
    iterations : int
        Number of E- and M-steps.
    solver_iterations : int
        Iterations of the programs' solver, summed over the M-steps.
    converged : bool
        True if the session's last program met its tolerance, and for methods without programs.
    seconds : float
        Wall-clock time of the session.
    weights : float ``[K]``
        The new reward weights.
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

    def in_plain_numbers(self, seconds: float) -> SessionInfo:
        """Convert a compiled session's info to Python's numbers and NumPy's arrays, and add its time."""
        return in_plain_numbers(self, seconds)


def in_plain_numbers(info: AnyInfo, seconds: float) -> AnyInfo:
    """Convert a learner's own info likewise: any named tuple with a field ``seconds``."""
    arrays = {name: np.asarray(value) for name, value in info._asdict().items()}  # type: ignore[attr-defined]
    values: dict[str, Any] = {name: x if x.ndim else x.item() for name, x in arrays.items()}
    return type(info)(**values | {"seconds": seconds})


State = TypeVar("State", default=Any)
Info = TypeVar("Info", default=Any)


class Learner(NamedTuple, Generic[State, Info]):
    """An online learner: configuration, and two functions on an explicit state.

    ``Learner[State, Info]`` names the types of its state and its info.

    ``session`` is the pure, compiled core of ``update`` (state and padded demonstration in, state and
    info out) that :func:`fleet` maps over many streams; None for solvers outside JAX.
    """

    name: str
    mdp: TabularMDP
    configuration: Mapping[str, Any]
    init: Callable[[Array], State]
    update: Callable[[State, Demonstration], tuple[State, Info]]
    session: Callable[[State, Demonstration], tuple[State, Info]] | None = None
    log_likelihood: Callable[[State, Float[Array, " K"]], float] | None = None

    def __repr__(self) -> str:
        return joined(
            type(self).__name__,
            [brief(self.name), repr(self.mdp), *(f"{name}={value}" for name, value in self._settings())],
        )

    def _repr_html_(self) -> str:
        rows = [("mdp", repr(self.mdp)), *self._settings()]
        return brief_table(f"{type(self).__name__} {brief(self.name)}", rows)

    def _settings(self) -> list[tuple[str, str]]:
        known = self.configuration if isinstance(self.configuration, Mapping) else {}
        return [(brief(str(name)).strip("'"), brief(value)) for name, value in known.items()]

    @property
    def signature(self) -> str:
        """Digest the MDP, the method and its configuration, which identify a journal's learner."""
        content = json.dumps(
            [self.mdp.fingerprint(), self.name, dict(self.configuration)], sort_keys=True, default=str
        )
        return hashlib.sha256(content.encode()).hexdigest()


def digest_of(sensor: Any) -> str:
    """Digest the arrays of a sensor, to identify it in a configuration."""
    digest = hashlib.sha256(type(sensor).__name__.encode())
    for leaf in jax.tree.leaves(sensor):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]
