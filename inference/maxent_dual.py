"""The dual of the maximum-entropy program in CasADi with IPOPT, warm-started from session to session."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy import sparse

from ..models.mdp import TabularMDP
from ..models.planning import reachable_states, require_discounted
from .maxent import count_objective, soft_values
from .maxent_constraints import FeatureTarget, ProgramNotSolved, checked_problem, checked_slack, failure

_QUIET: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
}
_COLD: dict[str, Any] = {**_QUIET, "ipopt.tol": 1e-9}
# A previous session's solution lies on its bounds: without these, IPOPT would first push it back inside.
_WARM: dict[str, Any] = {
    **_COLD,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-9,
    "ipopt.warm_start_bound_push": 1e-10,
    "ipopt.warm_start_bound_frac": 1e-10,
    "ipopt.warm_start_slack_bound_push": 1e-10,
    "ipopt.warm_start_slack_bound_frac": 1e-10,
    "ipopt.warm_start_mult_bound_push": 1e-10,
}


class IpoptPoint(NamedTuple):
    """A primal-dual point: variables ``[2K + S]``, multipliers of their bounds and of the constraints."""

    variables: Float[np.ndarray, " n"]
    bound_multipliers: Float[np.ndarray, " n"]
    constraint_multipliers: Float[np.ndarray, " S"]


class DualSolution(NamedTuple):
    """Solution of a program by IPOPT.

    Fields
    ------
    weights : float ``[K]``
        Reward weights.
    values : float ``[S]``
        Soft values of these weights.
    objective : float
        The minimised objective at these weights, penalties included (nats).
    iterations : int
        Of IPOPT.
    warm : IpoptPoint
        Where to start the next session from.
    """

    weights: Float[np.ndarray, " K"]
    values: Float[np.ndarray, " S"]
    objective: float
    iterations: int
    warm: IpoptPoint


class _SoftBellmanProgram:
    """The program that both duals are instances of, built once per MDP::

        minimise    w.V - theta.f + beta.(plus + minus) + ridge/2 |theta|^2,    theta = plus - minus
        subject to  lower(s) <= log sum_a exp(theta.phi(s, a) + gamma sum P V - V(s)) <= 0

    ``w``, ``f``, ``beta`` and ``ridge`` are parameters, and ``lower`` is 0 or minus infinity.
    """

    def __init__(self, mdp: TabularMDP) -> None:
        require_discounted(mdp)
        self.mdp = mdp
        n_states, n_features = mdp.n_states, mdp.n_features
        state, action = np.nonzero(np.asarray(mdp.available))
        pair = np.arange(len(state))
        probabilities = np.asarray(mdp.probabilities)[state, action]
        successors = np.asarray(mdp.successors)[state, action]
        following = sparse.csc_array(
            (probabilities.ravel(), (np.repeat(pair, probabilities.shape[1]), successors.ravel())),
            (len(pair), n_states),
        )
        at_state = sparse.csc_array((np.ones(len(pair)), (pair, state)), (len(pair), n_states))
        plus, minus = ca.SX.sym("plus", n_features), ca.SX.sym("minus", n_features)
        values = ca.SX.sym("V", n_states)
        state_weights, features = ca.SX.sym("w", n_states), ca.SX.sym("f", n_features)
        slack, ridge = ca.SX.sym("beta", n_features), ca.SX.sym("ridge")
        theta = plus - minus
        phi = ca.sparsify(ca.DM(np.asarray(mdp.features)[state, action]))
        advantage = phi @ theta + _matrix(float(mdp.discount) * following - at_state) @ values
        program = {
            "x": ca.vertcat(plus, minus, values),
            "p": ca.vertcat(state_weights, features, slack, ridge),
            "f": ca.dot(state_weights, values)
            - ca.dot(theta, features)
            + ca.dot(slack, plus + minus)
            + ridge / 2 * ca.dot(theta, theta),
            "g": ca.log(_matrix(at_state).T @ ca.exp(advantage)),
        }
        self._origin = np.concatenate([np.zeros(2 * n_features), soft_values(mdp, jnp.zeros(n_features))])
        self._cold = ca.nlpsol("maxent_cold", "ipopt", program, _COLD)
        self._warm = ca.nlpsol("maxent_warm", "ipopt", program, _WARM)

    def _run(
        self,
        state_weights: np.ndarray,
        features: np.ndarray,
        slack: np.ndarray,
        ridge: float,
        pinned: np.ndarray,
        warm: IpoptPoint | None,
    ) -> tuple[DualSolution, str]:
        """Solve with the constraints of ``pinned [S]`` states held as equations; status '' means solved.

        A warm start that leads nowhere (the slack changed its pattern, say) is followed by a cold one.
        """
        solution, status = self._run_from(warm, state_weights, features, slack, ridge, pinned)
        if status and warm is not None:
            wasted = solution.iterations
            solution, status = self._run_from(None, state_weights, features, slack, ridge, pinned)
            solution = solution._replace(iterations=wasted + solution.iterations)
        return solution, status

    def _run_from(
        self,
        warm: IpoptPoint | None,
        state_weights: np.ndarray,
        features: np.ndarray,
        slack: np.ndarray,
        ridge: float,
        pinned: np.ndarray,
    ) -> tuple[DualSolution, str]:
        n_states, n_features = self.mdp.n_states, self.mdp.n_features
        # Without slack, plus and minus could grow together for nothing: plus alone is then the weight.
        free = slack == 0
        lower = np.concatenate(
            [np.where(free, -np.inf, 0.0), np.zeros(n_features), np.full(n_states, -np.inf)]
        )
        upper = np.concatenate(
            [np.full(n_features, np.inf), np.where(free, 0.0, np.inf), np.full(n_states, np.inf)]
        )
        arguments = {
            "p": np.concatenate([state_weights, features, slack, [ridge]]),
            "lbx": lower,
            "ubx": upper,
            "lbg": np.where(pinned, 0.0, -np.inf),
            "ubg": np.zeros(n_states),
        }
        if warm is None:
            solver = self._cold
            arguments["x0"] = self._origin
        else:
            solver = self._warm
            arguments |= {
                "x0": warm.variables,
                "lam_x0": warm.bound_multipliers,
                "lam_g0": warm.constraint_multipliers,
            }
        result = solver(**arguments)
        statistics = solver.stats()
        point = IpoptPoint(*(np.asarray(result[name]).ravel() for name in ("x", "lam_x", "lam_g")))
        plus, minus, values = np.split(point.variables, [n_features, 2 * n_features])
        weights = plus - minus
        if statistics["success"]:
            # The barrier keeps V above its equation by mu / occupancy, which is much where nobody goes.
            values = np.asarray(soft_values(self.mdp, jnp.asarray(weights), jnp.asarray(values)))
        objective = (
            state_weights @ values
            - features @ weights
            + slack @ np.abs(weights)
            + ridge / 2 * weights @ weights
        )
        solution = DualSolution(weights, values, float(objective), int(statistics["iter_count"]), point)
        return solution, "" if statistics["success"] else str(statistics["return_status"])


class DualProgram(_SoftBellmanProgram):
    """The feature program's dual as a convex program over weights and values.

    ::

        minimise    p0.V - theta.phi_hat + sum_k beta_k |theta_k| + ridge/2 |theta|^2
        subject to  log sum_a exp(theta.phi(s, a) + gamma sum P(s' | s, a) V(s')) <= V(s)

    The multipliers of the constraints are the discounted state occupancies. Where nobody comes from ``p0``
    they are zero, and the constraint would leave ``V`` free to drift upwards; there it is an equation.
    Built once per MDP; ``ValueError`` for discount 1.
    """

    def __init__(self, mdp: TabularMDP) -> None:
        super().__init__(mdp)
        self._reached: dict[bytes, np.ndarray] = {}

    def solve(
        self,
        target: FeatureTarget,
        slack: ArrayLike = 0.0,
        ridge: float = 0.0,
        warm: IpoptPoint | None = None,
    ) -> DualSolution:
        """Solve for a target, from ``warm`` (the previous session's) or from zero weights.

        ``slack`` (a number or ``[K]``) is ``beta``, in units of the target's features. Raises
        ``InfeasibleProgram`` naming the features that no policy can match, ``ProgramNotSolved`` when IPOPT
        gives up, and ``ValueError`` for a malformed target.
        """
        features, start, beta = checked_problem(self.mdp, target, slack)
        solution, status = self._run(start, features, beta, ridge, ~self._reachable(start), warm)
        if status:
            raise failure(
                self.mdp, target, slack, f"IPOPT reports {status} after {solution.iterations} iterations"
            )
        return solution

    def _reachable(self, start: np.ndarray) -> np.ndarray:
        key = (start > 0).tobytes()
        if key not in self._reached:
            # One entry: sessions start where the last one did, more often than not.
            self._reached = {key: reachable_states(self.mdp, start)}
        return self._reached[key]


class CountProgram(_SoftBellmanProgram):
    """The conditional likelihood of visit counts ``N(s, a)``, with the Bellman equations as constraints.

    ::

        maximise    sum N(s, a) log pi_theta(a | s) - sum_k beta_k |theta_k| - ridge/2 |theta|^2
        subject to  log sum_a exp(theta.phi(s, a) + gamma sum P(s' | s, a) V(s')) = V(s)

    where ``log pi = theta.phi + gamma P V - V``. Not convex: a local optimum is returned. Built once per
    MDP; ``ValueError`` for discount 1.
    """

    def solve(
        self, counts: ArrayLike, slack: ArrayLike = 0.0, ridge: float = 0.0, warm: IpoptPoint | None = None
    ) -> DualSolution:
        """Solve for counts ``[S, A]``, from ``warm`` or zero weights; ``objective`` is minus the maximum.

        Penalties are in nats. Raises ``ProgramNotSolved`` when IPOPT gives up, and ``ValueError`` for
        counts that are negative, not finite, of unavailable pairs or of the wrong shape.
        """
        visits = np.asarray(counts, float)
        objective = count_objective(self.mdp, visits)
        if not (np.isfinite(visits) & (visits >= 0)).all():
            raise ValueError(f"counts must be finite and not negative; the least is {visits.min()}")
        stray = (visits > 0) & ~np.asarray(self.mdp.available)
        if stray.any():
            s, a = np.argwhere(stray)[0]
            raise ValueError(
                f"counts give {visits[s, a]} visits to the unavailable pair of state {s}, action {a}"
            )
        everywhere = np.ones(self.mdp.n_states, bool)
        solution, status = self._run(
            np.asarray(objective.state_weights), np.asarray(objective.features),
            checked_slack(self.mdp, slack), ridge, everywhere, warm,
        )  # fmt: skip
        if status:
            raise ProgramNotSolved(
                f"the count program was not solved: IPOPT reports {status} after {solution.iterations} "
                "iterations. Visits that a deterministic policy explains have infinite weights: a slack or a "
                "ridge makes them finite"
            )
        return solution


def _matrix(matrix: sparse.csc_array) -> ca.DM:
    return ca.DM(sparse.csc_matrix(matrix))
