"""The M-step in CasADi or CVXPY: programs built once, re-solved every session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...models.process.mdp import TabularMDP
from .constraints import FeatureTarget
from .dual import CountProgram, DualProgram, IpoptPoint
from .primal import PrimalProgram

Solve = Callable[[Any, Any, Any, Any], tuple[Any, Any]]


def host_solver(mdp: TabularMDP, solver: str, statistic: str) -> tuple[Solve, Any]:
    """Return the solver ``solve(statistic, slack, ridge, warm) -> (solution, warm)``, and its first start.

    ``ipopt`` starts every solve from the primal and dual point of the last one, across sessions too;
    ``cvxpy`` re-solves its compiled primal.
    """
    if solver == "cvxpy":
        primal = PrimalProgram(mdp)

        def solve_primal(kept: Any, slack: Any, ridge: Any, warm: Any) -> tuple[Any, Any]:
            if float(ridge) > 0:
                raise ValueError(
                    "the primal program has no ridge: use the newton or ipopt solver with a prior"
                )
            return primal.solve(_target(kept), np.asarray(slack)), warm

        return solve_primal, ()
    empty = IpoptPoint(np.zeros(0), np.zeros(0), np.zeros(0))
    dual = DualProgram(mdp) if statistic == "features" else None
    counts = CountProgram(mdp) if dual is None else None

    def solve(kept: Any, slack: Any, ridge: Any, warm: IpoptPoint) -> tuple[Any, Any]:
        warm_or_none = warm if np.size(warm.variables) else None
        if dual is not None:
            solution = dual.solve(_target(kept), np.asarray(slack), float(ridge), warm_or_none)
        else:
            assert counts is not None
            solution = counts.solve(np.asarray(kept.counts), np.asarray(slack), float(ridge), warm_or_none)
        return solution, solution.warm

    return solve, empty


def _target(kept: Any) -> FeatureTarget:
    return FeatureTarget(np.asarray(kept.features), np.asarray(kept.start))
