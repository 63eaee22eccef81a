"""Slack that changes from session to session: a number, or a schedule, a function of the session's number.

As in Optax, a schedule is any function that JAX can trace, from the session's number (an int, counted from
1) to the slack. It is a pure function of that number, so a learner that resumes from a journal continues with
it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from numbers import Real
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

# Harmonic by name: type checkers do not see that a named tuple can be called.
Schedule: TypeAlias = "float | Harmonic | Callable[[Int[Array, '']], ArrayLike]"

# This many sessions of a schedule are evaluated when a learner is made, and identify it.
EXAMINED = 1000


class Harmonic(NamedTuple):
    """The diminishing threshold of the no-regret theorem, ``epsilon_i / (1 - gamma) = c / i`` (Eq. 4.3).

    ``c / i`` is the program's own slack ``beta_i`` in session ``i``, whatever the statistic; do not divide it
    again by ``1 - gamma``. With the ``features`` statistic it bounds the distance of discounted feature
    expectations from the demonstrated ones, and ``epsilon_i = c (1 - gamma) / i``. With ``counts`` and
    ``seen`` it is an L1 penalty of ``c / i`` nats per trajectory and unit of weight. The statistic grows by a
    fixed number of trajectories per session, so this penalty has fixed strength in all: a Laplace prior,
    which the data outgrow.
    """

    c: float

    def __call__(self, session: Int[Array, ""]) -> Any:
        """Return ``c / session``."""
        return self.c / session


def program_slack(slack: Any, session: Any, unit: Any) -> Float[Array, ""]:
    """Return the program's slack ``beta`` in a session.

    ``unit`` is the program's value of a slack of one; :class:`Harmonic` states ``beta`` itself. A negative
    slack of a schedule becomes NaN: ``jit`` cannot raise errors, and a program with that slack is not solved,
    so the weights stay unchanged.
    """
    if isinstance(slack, Harmonic):
        beta = slack(session)
    else:
        beta = unit * (slack(session) if callable(slack) else slack)
    return jnp.where(beta >= 0, beta, jnp.nan)


def require_slack(slack: Any) -> None:
    """Raise ``ValueError`` unless ``slack`` is a number or a schedule, and never negative.

    The first ``EXAMINED`` sessions of a schedule are checked.
    """
    if not callable(slack):
        scalar = isinstance(slack, np.ndarray | jax.Array) and slack.ndim == 0
        if not isinstance(slack, Real) and not scalar:
            raise ValueError(f"slack must be a number or a function of the session's number, got {slack!r}")
        if not 0 <= float(slack) < math.inf:
            raise ValueError(f"slack must not be negative, infinite or NaN, got {slack}")
        return
    values = _values(slack)
    wrong = ~(np.isfinite(values) & (values >= 0))
    if wrong.any():
        first = int(np.flatnonzero(wrong)[0])
        raise ValueError(
            f"slack must be a number that is not negative in every session; the schedule "
            f"{_name(slack)} gives {values[first]} in session {first + 1}"
        )


def require_slack_in(slack: Any, session: int) -> None:
    """Raise ``ValueError`` if a schedule gives an invalid slack in a session beyond those examined."""
    if callable(slack) and session > EXAMINED:
        value = float(slack(jnp.asarray(session)))
        if not 0 <= value < math.inf:
            raise ValueError(f"the slack schedule {_name(slack)} gives {value} in session {session}")


def described(slack: Any) -> float | str:
    """Return the identity of a slack in a learner's configuration, the same in every process.

    A schedule without a readable representation is identified by its values: two that agree on the sessions
    examined (to 10 digits) are one.
    """
    if not callable(slack):
        return slack if isinstance(slack, int | float) else float(slack)
    if isinstance(slack, Harmonic):
        return f"Harmonic(c={float(slack.c)!r})"
    digits = [f"{x:.10g}" for x in _values(slack)]
    digest = hashlib.sha256(" ".join(digits).encode()).hexdigest()[:16]
    return f"schedule {', '.join(digits[:3])}, ... ({digest})"


def _values(schedule: Callable[[Any], Any]) -> Float[np.ndarray, " EXAMINED"]:
    sessions = jnp.arange(1, EXAMINED + 1)
    try:
        values = np.asarray(jax.vmap(schedule)(sessions), float)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"slack must be a number, or a function of the session's number that JAX can trace and that "
            f"gives a number; {_name(schedule)} failed: {str(error).splitlines()[0]}"
        ) from error
    if values.shape != sessions.shape:
        raise ValueError(
            f"a slack schedule gives one number a session, {_name(schedule)} gives shape {values.shape[1:]}"
        )
    return values


def _name(schedule: Any) -> str:
    if isinstance(schedule, jax.tree_util.Partial):  # within a learner
        bound: Any = schedule.func
        schedule = bound.__self__
    return repr(schedule) if isinstance(schedule, tuple) else getattr(schedule, "__name__", repr(schedule))
