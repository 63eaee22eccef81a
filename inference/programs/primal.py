"""The maximum-entropy program in its primal form, in CVXPY: the reward weights are dual values."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import cvxpy as cp
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reachable_states, require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from .constraints import FeatureTarget, checked_problem, failure, flow_constraints
from .maximum_entropy import soft_values

_SETTINGS: dict[str, dict[str, object]] = {
    # Clarabel aims at the first tolerances. If rounding stops it earlier, it calls a point within the reduced
    # ones "almost solved", as close as it could come: weights agree with the dual's to 1e-6, with tolerances
    # of 1e-10 only to 1e-4.
    "CLARABEL": {
        "tol_gap_abs": 1e-12,
        "tol_gap_rel": 1e-12,
        "tol_feas": 1e-12,
        "reduced_tol_gap_abs": 1e-8,
        "reduced_tol_gap_rel": 1e-8,
        "reduced_tol_feas": 1e-8,
        "max_iter": 200,
    },
    "SCS": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iters": 100_000},
}
_SOLVED = {"CLARABEL": (cp.OPTIMAL, cp.OPTIMAL_INACCURATE), "SCS": (cp.OPTIMAL,)}


@shown_briefly
class PrimalSolution(NamedTuple):
    """Solution of the primal program.

    Fields
    ------
    weights : float ``[K]``
        Reward weights: the multipliers of the feature constraints.
    values : float ``[S]``
        Soft values of these weights.
    objective : float
        The maximised causal entropy (nats), equal to the minimum of the dual.
    occupancy : float ``[S, A]``
        The optimal discounted occupancy; it sums to ``1 / (1 - gamma)``.
    iterations : int
        The solver's iterations.
    converged : bool
        True if the solver met its tolerances; solutions returned to a caller have.
    """

    weights: Float[np.ndarray, " K"]
    values: Float[np.ndarray, " S"]
    objective: float
    occupancy: Float[np.ndarray, "S A"]
    iterations: int
    converged: bool


class _Compiled(NamedTuple):
    problem: cp.Problem
    occupancy: cp.Variable
    features: cp.Parameter
    start: cp.Parameter
    slack: cp.Parameter
    at_least: cp.Constraint
    at_most: cp.Constraint
    states: np.ndarray
    pairs: tuple[np.ndarray, np.ndarray]


class PrimalProgram:
    """Maximise the causal entropy of the discounted occupancy ``x(s, a)`` under the feature constraints.

    ::

        maximise    - sum x(s, a) log (x(s, a) / sum_a x(s, a))
        subject to  sum_a x(s', a) = p0(s') + gamma sum P(s' | s, a) x(s, a)
                    | sum x phi_k - phi_hat_k | <= beta_k,    x >= 0

    over available pairs of states reachable from ``p0``, with features divided by their scales
    (:mod:`~i2rl.models.process.units`). ``phi_hat``, ``p0`` and ``beta`` are parameters: the program is
    compiled at the first solve, and again only if other states become reachable.

    Parameters
    ----------
    mdp : TabularMDP
        With discount below 1 (``ValueError`` otherwise).
    solver : {"CLARABEL", "SCS"}
        An interior-point method, or a first-order one for programs too large to factorise (weights to
        about 1e-4).
    """

    def __init__(self, mdp: TabularMDP, solver: str = "CLARABEL") -> None:
        require_discounted(mdp)
        if solver not in _SETTINGS:
            raise ValueError(f"solver must be one of {', '.join(_SETTINGS)}, got {solver!r}")
        self.mdp = mdp
        self._scale = np.asarray(feature_scale(mdp))
        self._scaled = with_scaled_features(mdp)
        self.solver = solver
        self._compiled: dict[bytes, _Compiled] = {}

    def solve(self, target: FeatureTarget, slack: ArrayLike = 0.0) -> PrimalSolution:
        """Solve for a target.

        ``slack`` (a number or ``[K]``) is ``beta``, in units of each feature's scale. Raises
        ``InfeasibleProgram`` naming the features that no policy can match, ``ProgramNotSolved`` if the solver
        fails, and ``ValueError`` for a malformed target.
        """
        features, start, beta = checked_problem(self.mdp, target, slack)
        program = self._program(reachable_states(self.mdp, start))
        program.features.value = features / self._scale
        program.start.value = start[program.states]
        program.slack.value = beta
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Solution may be inaccurate")
                program.problem.solve(solver=self.solver, warm_start=True, **_SETTINGS[self.solver])
        except cp.error.SolverError as error:
            raise failure(self.mdp, target, slack, f"{self.solver}: {error}") from error
        if program.problem.status not in _SOLVED[self.solver]:
            raise failure(self.mdp, target, slack, f"{self.solver} reports {program.problem.status}")
        weights = program.at_least.dual_value - program.at_most.dual_value
        occupancy = np.zeros(self.mdp.available.shape)
        occupancy[program.pairs] = program.occupancy.value
        return PrimalSolution(
            weights / self._scale,
            np.asarray(soft_values(self._scaled, jnp.asarray(weights))),
            float(program.problem.value),
            occupancy,
            int(program.problem.solver_stats.num_iters or 0),
            True,
        )

    def _program(self, reachable: np.ndarray) -> _Compiled:
        key = reachable.tobytes()
        if key not in self._compiled:
            self._compiled[key] = _compile(self._scaled, reachable)
        return self._compiled[key]


def _compile(mdp: TabularMDP, reachable: np.ndarray) -> _Compiled:
    flow = flow_constraints(mdp, reachable)
    n, k = flow.features.shape
    x = cp.Variable(n, nonneg=True, name="occupancy")
    phi_hat = cp.Parameter(k, name="phi_hat")
    p0 = cp.Parameter(len(flow.states), nonneg=True, name="p0")
    beta = cp.Parameter(k, nonneg=True, name="beta")
    # A state with one action adds no entropy, and its cones would only cost time.
    choice = np.flatnonzero((np.bincount(flow.row) > 1)[flow.row])
    same_state = (flow.row[choice, None] == flow.row[None, :]).astype(float)
    entropy = -cp.sum(cp.rel_entr(x[choice], same_state @ x)) if len(choice) else 0 * cp.sum(x)
    expected = flow.features.T @ x
    at_least, at_most = phi_hat - expected <= beta, expected - phi_hat <= beta
    problem = cp.Problem(cp.Maximize(entropy), [flow.balance @ x == p0, at_least, at_most])
    return _Compiled(
        problem, x, phi_hat, p0, beta, at_least, at_most, flow.states, (flow.pair_state, flow.pair_action)
    )
