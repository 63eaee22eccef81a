"""The dual of the maximum-entropy program in CasADi with IPOPT, warm-started from session to session."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy import sparse

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import occupancy, reachable_states, require_discounted, reward_of, soft_plan
from ...models.process.units import feature_scale, with_scaled_features
from .constraints import FeatureTarget, ProgramNotSolved, checked_problem, checked_slack, failure
from .maximum_entropy import LinearObjective, count_objective, minimise, soft_values

_QUIET: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "ipopt.max_iter": 200,
}
COLD_OPTIONS: dict[str, Any] = {**_QUIET, "ipopt.tol": 1e-9}
# A previous session's solution lies on its bounds: without these, IPOPT would first push it inside.
WARM_OPTIONS: dict[str, Any] = {
    **COLD_OPTIONS,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-9,
    "ipopt.warm_start_bound_push": 1e-10,
    "ipopt.warm_start_bound_frac": 1e-10,
    "ipopt.warm_start_slack_bound_push": 1e-10,
    "ipopt.warm_start_slack_bound_frac": 1e-10,
    "ipopt.warm_start_mult_bound_push": 1e-10,
}
# Weight of the proximal term, in shares of the discounted visits. The last one moves determined weights by
# less than IPOPT's tolerance, and holds the others where they started. Larger ones before it keep IPOPT from
# steps so long that every policy is deterministic and has no gradient.
_PROXIMAL = 1e-10
_STAGES = (1e-2, 1e-5, _PROXIMAL)
# If that term alone holds weights against a pull of more than this share, the weights are infinite.
_HELD = 1e-7


@shown_briefly
class IpoptPoint(NamedTuple):
    """A primal-dual point: variables ``[2K + S]``, multipliers of their bounds and of the constraints.

    The first ``2K`` variables are the positive and negative parts of the scaled weights.
    """

    variables: Float[np.ndarray, " n"]
    bound_multipliers: Float[np.ndarray, " n"]
    constraint_multipliers: Float[np.ndarray, " S"]


@shown_briefly
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
        IPOPT's iterations.
    converged : bool
        True if IPOPT met its tolerance; solutions returned to a caller have.
    warm : IpoptPoint
        Start for the next session.
    """

    weights: Float[np.ndarray, " K"]
    values: Float[np.ndarray, " S"]
    objective: float
    iterations: int
    converged: bool
    warm: IpoptPoint


class _Problem(NamedTuple):
    """One problem in scaled features; constraints of ``pinned [S]`` states are equations."""

    state_weights: Float[np.ndarray, " S"]
    features: Float[np.ndarray, " K"]
    slack: Float[np.ndarray, " K"]
    ridge: float
    pinned: Bool[np.ndarray, " S"]


class _SoftBellmanProgram:
    """The common program of both duals, built once per MDP::

        minimise    w.V - theta.f + beta.(plus + minus) + ridge/2 |theta|^2 + proximal/2 |theta - centre|^2
        subject to  lower(s) <= log sum_a exp(theta.phi(s, a) + gamma sum P V - V(s)) <= 0

    with ``theta = plus - minus`` and scaled features ``phi``. All but ``phi`` and ``P`` are parameters, and
    ``lower`` is 0 or minus infinity.
    """

    def __init__(self, mdp: TabularMDP) -> None:
        require_discounted(mdp)
        self.mdp = mdp
        self._scale = np.asarray(feature_scale(mdp))
        self._scaled = mdp = with_scaled_features(mdp)
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
        proximal, centre = ca.SX.sym("proximal"), ca.SX.sym("centre", n_features)
        theta = plus - minus
        phi = ca.sparsify(ca.DM(np.asarray(mdp.features)[state, action]))
        advantage = phi @ theta + _matrix(float(mdp.discount) * following - at_state) @ values
        program = {
            "x": ca.vertcat(plus, minus, values),
            "p": ca.vertcat(state_weights, features, slack, ridge, proximal, centre),
            "f": ca.dot(state_weights, values)
            - ca.dot(theta, features)
            + ca.dot(slack, plus + minus)
            + ridge / 2 * ca.dot(theta, theta)
            + proximal / 2 * ca.dot(theta - centre, theta - centre),
            "g": soft_maximum(advantage, state),
        }
        # Strictly feasible: from the boundary IPOPT leaves in directions far from the solution.
        values = soft_values(mdp, jnp.zeros(n_features)) + 1 / (1 - mdp.discount)
        self._origin = np.concatenate([np.zeros(2 * n_features), values])
        self._cold = ca.nlpsol("maxent_cold", "ipopt", program, COLD_OPTIONS)
        self._warm = ca.nlpsol("maxent_warm", "ipopt", program, WARM_OPTIONS)

    def _run(self, problem: _Problem, warm: IpoptPoint | None) -> tuple[DualSolution, str]:
        """Solve from the first start that succeeds; status '' means solved.

        If a warm start fails (the slack changed its pattern, say), cold starts follow: directly, then held by
        proximal terms that loosen, then from Newton's solution.
        """
        spent, status = 0, ""
        for start in (self._from_warm, self._at_once, self._in_stages, self._from_newton):
            found = start(problem, warm)
            if found is None:
                continue
            solution, status = found
            spent += solution.iterations
            if not status:
                break
        return solution._replace(iterations=spent), status

    def _from_warm(self, problem: _Problem, warm: IpoptPoint | None) -> tuple[DualSolution, str] | None:
        return None if warm is None else self._solve(problem, _PROXIMAL, warm)

    def _at_once(self, problem: _Problem, warm: IpoptPoint | None) -> tuple[DualSolution, str]:
        return self._solve(problem, _PROXIMAL, None)

    def _in_stages(self, problem: _Problem, warm: IpoptPoint | None) -> tuple[DualSolution, str]:
        point, spent = None, 0
        for proximal in _STAGES:
            solution, status = self._solve(problem, proximal, point)
            point, spent = solution.warm, spent + solution.iterations
            if status:
                break
        return solution._replace(iterations=spent), status

    def _from_newton(self, problem: _Problem, warm: IpoptPoint | None) -> tuple[DualSolution, str]:
        objective = LinearObjective(jnp.asarray(problem.state_weights), jnp.asarray(problem.features))
        ridge = jnp.asarray(problem.ridge)
        newton = minimise(self._scaled, objective, jnp.asarray(problem.slack), ridge, None)
        weights, n_features = np.asarray(newton.weights), self.mdp.n_features
        free = problem.slack == 0
        parts = np.where(free, weights, np.maximum(weights, 0)), np.where(free, 0, np.maximum(-weights, 0))
        # The multipliers of the Bellman inequalities are the discounted visits of each state.
        policy = soft_plan(self._scaled, reward_of(self._scaled, newton.weights), newton.values).policy
        visits = occupancy(self._scaled, policy, jnp.asarray(problem.state_weights)).sum(1)
        point = IpoptPoint(
            np.concatenate([*parts, newton.values]),
            np.zeros(2 * n_features + self.mdp.n_states),
            np.asarray(visits),
        )
        return self._solve(problem, _PROXIMAL, point)

    def _solve(self, problem: _Problem, proximal: float, warm: IpoptPoint | None) -> tuple[DualSolution, str]:
        """Solve from one start, with a proximal term of this share that is centred there."""
        n_states, n_features = self.mdp.n_states, self.mdp.n_features
        state_weights, features, slack, ridge, pinned = problem
        # Without slack, plus and minus could grow together at no cost: plus alone is then the weight.
        free = slack == 0
        lower = np.concatenate(
            [np.where(free, -np.inf, 0.0), np.zeros(n_features), np.full(n_states, -np.inf)]
        )
        upper = np.concatenate(
            [np.full(n_features, np.inf), np.where(free, 0.0, np.inf), np.full(n_states, np.inf)]
        )
        start = self._origin if warm is None else warm.variables
        centre = start[:n_features] - start[n_features : 2 * n_features]
        visits = state_weights.sum() / (1 - float(self.mdp.discount))
        arguments = {
            "x0": start,
            "p": np.concatenate([state_weights, features, slack, [ridge, proximal * visits], centre]),
            "lbx": lower,
            "ubx": upper,
            "lbg": np.where(pinned, 0.0, -np.inf),
            "ubg": np.zeros(n_states),
        }
        if warm is not None:
            arguments |= {"lam_x0": warm.bound_multipliers, "lam_g0": warm.constraint_multipliers}
        solver = self._cold if warm is None else self._warm
        result = solver(**arguments)
        statistics = solver.stats()
        point = IpoptPoint(*(np.asarray(result[name]).ravel() for name in ("x", "lam_x", "lam_g")))
        plus, minus, values = np.split(point.variables, [n_features, 2 * n_features])
        weights = plus - minus
        if statistics["success"]:
            # The barrier keeps V above its equation by mu / occupancy, which is large for rare states.
            values = np.asarray(soft_values(self._scaled, jnp.asarray(weights), jnp.asarray(values)))
        objective = (
            state_weights @ values
            - features @ weights
            + slack @ np.abs(weights)
            + ridge / 2 * weights @ weights
        )
        status = "" if statistics["success"] else str(statistics["return_status"])
        held = proximal * visits * np.abs(weights - centre).max()
        if not status and proximal == _PROXIMAL and held > _HELD * (1 + np.abs(features).max()):
            status = "weights that grow without bound"
        iterations = int(statistics["iter_count"])
        weights = weights / self._scale
        return DualSolution(weights, values, float(objective), iterations, not status, point), status


class DualProgram(_SoftBellmanProgram):
    """The feature program's dual as a convex program over weights and values.

    ::

        minimise    p0.V - theta.phi_hat + sum_k beta_k |theta_k| + ridge/2 |theta|^2
        subject to  log sum_a exp(theta.phi(s, a) + gamma sum P(s' | s, a) V(s')) <= V(s)

    The multipliers of the constraints are the discounted state occupancies. In states unreachable from ``p0``
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

        ``slack`` (a number or ``[K]``) is ``beta``, in units of each feature's scale, and ``ridge`` penalises
        scaled weights (:mod:`~i2rl.models.process.units`). Weights that the target does not determine stay
        close to their start. Raises ``InfeasibleProgram`` naming the features that no policy can match,
        ``ProgramNotSolved`` if IPOPT fails, naming actions whose avoidance needs infinite weights if there
        are any, and ``ValueError`` for a malformed target.
        """
        features, start, beta = checked_problem(self.mdp, target, slack)
        problem = _Problem(start, features / self._scale, beta, float(ridge), ~self._reachable(start))
        solution, status = self._run(problem, warm)
        if status:
            raise failure(
                self.mdp, target, slack, f"IPOPT reports {status} after {solution.iterations} iterations"
            )
        return solution

    def _reachable(self, start: np.ndarray) -> np.ndarray:
        key = (start > 0).tobytes()
        if key not in self._reached:
            # One entry: sessions usually start where the last one did.
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

        Penalties are in nats, of scaled weights (:mod:`~i2rl.models.process.units`). Raises
        ``ProgramNotSolved`` if IPOPT fails, and ``ValueError`` for counts that are negative, not finite,
        of unavailable pairs or of the wrong shape.
        """
        visits = np.asarray(counts, float)
        objective = count_objective(self._scaled, visits)
        if not (np.isfinite(visits) & (visits >= 0)).all():
            raise ValueError(f"counts must be finite and not negative; the least is {visits.min()}")
        stray = (visits > 0) & ~np.asarray(self.mdp.available)
        if stray.any():
            s, a = np.argwhere(stray)[0]
            raise ValueError(
                f"counts give {visits[s, a]} visits to the unavailable pair of state {s}, action {a}"
            )
        problem = _Problem(
            np.asarray(objective.state_weights),
            np.asarray(objective.features),
            checked_slack(self.mdp, slack),
            float(ridge),
            np.ones(self.mdp.n_states, bool),
        )
        solution, status = self._run(problem, warm)
        if status:
            raise ProgramNotSolved(
                f"the count program was not solved: IPOPT reports {status} after {solution.iterations} "
                "iterations. Visits that a deterministic policy explains have infinite weights: a slack or a "
                "ridge makes them finite"
            )
        return solution


def soft_maximum(advantage: ca.SX, state: np.ndarray) -> ca.SX:
    """Build ``log sum_a exp(advantage)`` of each state, exponents shifted so that the largest is zero."""
    maxima = []
    for s in range(state[-1] + 1):
        own = advantage[np.flatnonzero(state == s).tolist()]
        largest = ca.mmax(own)
        maxima.append(largest + ca.log(ca.sum1(ca.exp(own - largest))))
    return ca.vertcat(*maxima)


def _matrix(matrix: sparse.csc_array) -> ca.DM:
    return ca.DM(sparse.csc_matrix(matrix))
