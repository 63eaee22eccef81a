"""Min-max-entropy multi-task IRL (program 5.1, in its sound form) as one CasADi program with IPOPT.

Each component has a trajectory law of maximum entropy under its own feature matching; the mixture of these
laws has proportions of little entropy. The Lagrange dual of the former is the likelihood of soft-optimal
behaviour, and the latter is an entropic prior (:mod:`~i2rl.inference.programs.entropic`), so that the
stationary points are those of::

    maximise    sum_{i,d,s,a} v_id N_i(s, a) log pi_{theta_d}(a | s)
                + temperature { sum_{i,d} v_id (log pi_d - log v_id) + strength sum_d pi_d log pi_d }
                - slack sum |theta| - ridge/2 sum theta^2
    subject to  log sum_a exp(theta_d.phi(s, a) + gamma sum P(s' | s, a) V_d(s')) = V_d(s)
                sum_d v_id = 1,  sum_d pi_d = 1,  v >= 0,  pi >= 0

(the sums over ``s, a`` of trajectory ``i`` are ``theta_d.F_i - W_i.V_d``: only those are ever formed). Given
the rest, and at ``temperature`` 1, the best ``v`` are the posterior probabilities of the components, at which
the maximised function is the marginal likelihood of the mixture; :mod:`~i2rl.inference.mixtures.fit` explains
why a lower temperature is better. Alternating between them, the proportions and the rewards ascends the same
function; from the same start both mostly, but not always, end in the same local maximum. ``N_i`` is
conditional on the states of a trajectory: two components that differ in one choice, made once, are a mixture
no better than one component that draws the choice at random.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.special import logsumexp, xlogy

from ...models.inputs.display import shown_briefly
from ...models.process.mdp import TabularMDP
from ...models.process.planning import require_discounted
from ...models.process.units import feature_scale, with_scaled_features
from .constraints import ProgramNotSolved, flow_constraints
from .dual import soft_maximum
from .entropic import entropic_proportions
from .maximum_entropy import WarmStart, fit_scaled_counts, soft_values

_COLD: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "ipopt.tol": 1e-9,
    # Logarithms of proportions are undefined below zero.
    "ipopt.bound_relax_factor": 0.0,
}
# IPOPT's final barrier at this tolerance: a warm start on the central path needs no recentring.
_WARM_BARRIER = 1e-10
_WARM: dict[str, Any] = {
    **_COLD,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": _WARM_BARRIER,
    "ipopt.warm_start_bound_push": 1e-12,
    "ipopt.warm_start_bound_frac": 1e-12,
    "ipopt.warm_start_slack_bound_push": 1e-12,
    "ipopt.warm_start_slack_bound_frac": 1e-12,
    "ipopt.warm_start_mult_bound_push": 1e-12,
}


@shown_briefly
class MinMaxPoint(NamedTuple):
    """A primal-dual point; all but the trajectories' own part starts the next session.

    Fields
    ------
    proportions : float ``[D]``
    parts : float ``[D, 2K]``
        Positive and negative parts of the scaled weights.
    values : float ``[D, S]``
    proportion_multipliers, part_multipliers : float
        Multipliers of their bounds; ``[D]`` and ``[D, 2K]``.
    bellman_multipliers : float ``[D, S]``
    sum_multiplier : float
        Multiplier of the proportions' sum.
    """

    proportions: Float[np.ndarray, " D"]
    parts: Float[np.ndarray, "D K2"]
    values: Float[np.ndarray, "D S"]
    proportion_multipliers: Float[np.ndarray, " D"]
    part_multipliers: Float[np.ndarray, "D K2"]
    bellman_multipliers: Float[np.ndarray, "D S"]
    sum_multiplier: float


@shown_briefly
class MinMaxSolution(NamedTuple):
    """A local maximum of the min-max-entropy program.

    Fields
    ------
    weights : float ``[D, K]``
        Reward weights of each component.
    values : float ``[D, S]``
        Their soft values.
    proportions : float ``[D]``
        ``pi_d``; close to zero for an empty component.
    responsibilities : float ``[n, D]``
        ``v_{d,i}``; at ``temperature`` 1 the posterior probabilities of the components. Rows sum to one.
    objective : float
        The maximised objective, penalties included (nats).
    iterations : int
        IPOPT's iterations.
    warm : MinMaxPoint
        Start for the next session.
    """

    weights: Float[np.ndarray, "D K"]
    values: Float[np.ndarray, "D S"]
    proportions: Float[np.ndarray, " D"]
    responsibilities: Float[np.ndarray, "n D"]
    objective: float
    iterations: int
    warm: MinMaxPoint


class _Statistics(NamedTuple):
    """Statistics of each trajectory's likelihood, per component: ``F [D, n, K]`` and ``W [D, n, S]``."""

    features: Float[np.ndarray, "D n K"]
    state_weights: Float[np.ndarray, "D n S"]


class _Penalties(NamedTuple):
    strength: float
    temperature: float
    slack: Float[np.ndarray, " K"]
    ridge: float


class MinMaxProgram:
    """The program above, built once for an MDP, ``components`` and at most this many ``trajectories``.

    Raises ``ValueError`` for discount 1, less than one component, or more components than trajectories.
    """

    def __init__(self, mdp: TabularMDP, components: int, trajectories: int) -> None:
        require_discounted(mdp)
        if components < 1:
            raise ValueError(f"at least one component is needed, got {components}")
        if components > trajectories:
            raise ValueError(
                f"{components} components for {trajectories} trajectories: some would have none to explain"
            )
        self.mdp, self.components, self.trajectories = mdp, components, trajectories
        self._scale = np.asarray(feature_scale(mdp))
        self._scaled = mdp = with_scaled_features(mdp)
        self._flow = flow_constraints(mdp, np.ones(mdp.n_states, bool))
        n_states, n_features = mdp.n_states, mdp.n_features
        size = (trajectories, components)
        v, pi = ca.SX.sym("v", *size), ca.SX.sym("pi", components)
        parts, values = ca.SX.sym("parts", 2 * n_features, components), ca.SX.sym("V", n_states, components)
        features = [ca.SX.sym(f"F{d}", trajectories, n_features) for d in range(components)]
        state_weights = [ca.SX.sym(f"W{d}", trajectories, n_states) for d in range(components)]
        counted = ca.SX.sym("counted", trajectories)
        strength, temperature = ca.SX.sym("strength"), ca.SX.sym("temperature")
        slack, ridge = ca.SX.sym("slack", n_features), ca.SX.sym("ridge")
        theta = parts[:n_features, :] - parts[n_features:, :]
        phi = ca.sparsify(ca.DM(self._flow.features))
        advantage = phi @ theta - ca.DM(sparse.csc_matrix(self._flow.balance)).T @ values
        likelihoods = ca.horzcat(
            *[features[d] @ theta[:, d] - state_weights[d] @ values[:, d] for d in range(components)]
        )
        fit = v * (likelihoods + temperature * (ca.repmat(ca.log(pi).T, trajectories, 1) - ca.log(v)))
        objective = (
            ca.dot(counted, ca.sum2(fit))
            + temperature * strength * ca.dot(pi, ca.log(pi))
            - ca.dot(slack, ca.sum2(parts[:n_features, :] + parts[n_features:, :]))
            - ridge / 2 * ca.dot(theta, theta)
        )
        maxima = [soft_maximum(advantage[:, d], self._flow.row) for d in range(components)]
        program = {
            "x": ca.vertcat(ca.vec(v), pi, ca.vec(parts), ca.vec(values)),
            "p": ca.vertcat(
                *map(ca.vec, features),
                *map(ca.vec, state_weights),
                counted,
                strength,
                temperature,
                slack,
                ridge,
            ),
            "f": -objective,
            "g": ca.vertcat(ca.sum2(v), ca.sum1(pi), *maxima),
        }
        self._cold = ca.nlpsol("minmax_cold", "ipopt", program, _COLD)
        self._warm = ca.nlpsol("minmax_warm", "ipopt", program, _WARM)

    def solve(
        self,
        counts: ArrayLike,
        strength: float = 1.0,
        slack: ArrayLike = 0.0,
        ridge: float = 0.0,
        *,
        temperature: float = 1.0,
        responsibilities: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        warm: MinMaxPoint | None = None,
    ) -> MinMaxSolution:
        """Find a local maximum uphill from exactly one of three starts.

        Parameters
        ----------
        counts : float ``[n, S, A]`` or ``[D, n, S, A]``
            Visits ``N_i`` of each trajectory; with ``D``, expected visits completed under each component,
            for demonstrations with hidden steps.
        strength : float
            ``lambda`` of the entropic prior on the proportions.
        slack, ridge : float or ``[K]``, float
            Penalties of each component's scaled weights (:mod:`~i2rl.models.process.units`), in nats in
            all (a Laplace and a Gaussian prior).
        temperature : float
            Weight of a nat of the assignments' entropy, in nats of likelihood; more than zero.
        responsibilities : float ``[n, D]``
            Start: assignments; each component begins at the best weights for its share.
        weights : float ``[D, K]``
            Start: reward weights, with equal proportions.
        warm : MinMaxPoint
            Start: the previous session's ``solution.warm``, the trajectories' own part computed anew. An
            empty component stays empty. If this start fails, its weights are the start, as with
            ``weights``.

        Raises
        ------
        ValueError
            For visits to unavailable pairs or malformed arguments, and unless there is one start.
        ProgramNotSolved
            If IPOPT fails.
        """
        statistics = self._statistics(counts)
        penalties = self._penalties(strength, temperature, slack, ridge)
        given = {"responsibilities": responsibilities, "weights": weights, "warm": warm}
        named = [name for name, start in given.items() if start is not None]
        if len(named) != 1:
            raise ValueError(
                "the program is not convex and needs one start: responsibilities, weights or warm; "
                f"got {' and '.join(named) or 'none'}"
            )
        wasted = 0
        if warm is not None:
            self._check(warm.values, (self.components, self.mdp.n_states), "a warm start's values", "[D, S]")
            solution, status = self._run(statistics, penalties, warm, self._warm)
            if not status:
                return solution
            wasted = solution.iterations
            parts = np.split(warm.parts, 2, axis=1)
            start = self._at(parts[0] - parts[1], np.full(self.components, 1 / self.components))
        elif weights is not None:
            table = np.asarray(weights, float)
            self._check(table, (self.components, self.mdp.n_features), "weights", "[D, K]")
            start = self._at(table * self._scale, np.full(self.components, 1 / self.components))
        else:
            start = self._from_responsibilities(np.asarray(responsibilities, float), counts, penalties)
        solution, status = self._run(statistics, penalties, start, self._cold)
        solution = solution._replace(iterations=wasted + solution.iterations)
        if status:
            raise ProgramNotSolved(
                f"the min-max-entropy program was not solved: IPOPT reports {status} after "
                f"{solution.iterations} iterations. Visits that a deterministic policy explains have "
                "infinite weights: a slack or a ridge makes them finite"
            )
        return solution

    # -- arguments ------------------------------------------------------------------------------------------

    def _statistics(self, counts: ArrayLike) -> _Statistics:
        visits = np.asarray(counts, float)
        pairs = self.mdp.available.shape
        shaped = visits.ndim in (3, 4) and visits.shape[-2:] == pairs
        if not shaped or (visits.ndim == 4 and visits.shape[0] != self.components):
            raise ValueError(
                f"counts must have shape [n, S, A] = [n, {pairs[0]}, {pairs[1]}] or [D, n, S, A] with D = "
                f"{self.components}, got {list(visits.shape)}"
            )
        n = visits.shape[-3]
        if not self.components <= n <= self.trajectories:
            raise ValueError(
                f"the program is for {self.components} to {self.trajectories} trajectories, got {n}"
            )
        if not (np.isfinite(visits) & (visits >= 0)).all():
            raise ValueError(f"counts must be finite and not negative; the least is {visits.min()}")
        stray = (visits > 0) & ~np.asarray(self.mdp.available)
        if stray.any():
            *_, i, s, a = where = tuple(np.argwhere(stray)[0])
            raise ValueError(
                f"counts give trajectory {i} {visits[where]:g} visits to the unavailable pair of state {s}, "
                f"action {a}"
            )
        by_pair = visits[..., self._flow.pair_state, self._flow.pair_action]
        by_pair = np.broadcast_to(by_pair, (self.components, n, by_pair.shape[-1]))
        return _Statistics(by_pair @ self._flow.features, by_pair @ self._flow.balance.T.toarray())

    def _penalties(self, strength: float, temperature: float, slack: ArrayLike, ridge: float) -> _Penalties:
        slack = np.asarray(slack, float)
        if slack.shape not in ((), (self.mdp.n_features,)):
            raise ValueError(
                f"slack must be a number or have shape [K] = [{self.mdp.n_features}], got {list(slack.shape)}"
            )
        for name, value in (("strength", strength), ("slack", slack), ("ridge", ridge)):
            if not (np.isfinite(value) & (np.asarray(value) >= 0)).all():
                raise ValueError(f"{name} must be finite and not negative, got {value}")
        if not (np.isfinite(temperature) and temperature > 0):
            raise ValueError(f"temperature must be finite and more than zero, got {temperature}")
        return _Penalties(
            float(strength), float(temperature), np.broadcast_to(slack, (self.mdp.n_features,)), float(ridge)
        )

    @staticmethod
    def _check(given: np.ndarray, shape: tuple[int, ...], name: str, dims: str) -> None:
        if np.shape(given) != shape or not np.isfinite(given).all():
            raise ValueError(
                f"{name} must be finite numbers of shape {dims} = {list(shape)}, got {list(np.shape(given))}"
            )

    # -- starts ---------------------------------------------------------------------------------------------

    def _at(
        self, weights: np.ndarray, proportions: np.ndarray, values: np.ndarray | None = None
    ) -> MinMaxPoint:
        n_components, n_features = weights.shape
        if values is None:
            origin = jnp.zeros(self.mdp.n_states)
            values = np.stack([soft_values(self._scaled, jnp.asarray(row), origin) for row in weights])
        return MinMaxPoint(
            proportions,
            np.concatenate([np.maximum(weights, 0), np.maximum(-weights, 0)], axis=1),
            values,
            np.zeros(n_components),
            np.zeros((n_components, 2 * n_features)),
            np.zeros_like(values),
            0.0,
        )

    def _from_responsibilities(
        self, shares: np.ndarray, counts: ArrayLike, penalties: _Penalties
    ) -> MinMaxPoint:
        visits = np.asarray(counts, float)
        n = visits.shape[-3]
        self._check(shares, (n, self.components), "responsibilities", "[n, D]")
        if shares.min() < 0 or abs(shares.sum(1) - 1).max() > 1e-6:
            raise ValueError(
                f"rows of responsibilities must be distributions: least {shares.min()}, sums from "
                f"{shares.sum(1).min()} to {shares.sum(1).max()}"
            )
        strength, _, slack, ridge = penalties
        visits = np.broadcast_to(visits, (self.components, *visits.shape[-3:]))
        origin = WarmStart(jnp.zeros(self.mdp.n_features), jnp.zeros(self.mdp.n_states))
        fits = [
            fit_scaled_counts(
                self._scaled, jnp.asarray(np.tensordot(shares[:, d], visits[d], 1)), slack, ridge, origin
            )
            for d in range(self.components)
        ]
        return self._at(
            np.stack([fit.weights for fit in fits]),
            np.asarray(entropic_proportions(shares.sum(0), strength)),
            np.stack([fit.values for fit in fits]),
        )

    # -- solving ------------------------------------------------------------------------------------------

    def _run(
        self,
        statistics: _Statistics,
        penalties: _Penalties,
        start: MinMaxPoint,
        solver: ca.Function,
    ) -> tuple[MinMaxSolution, str]:
        """Solve from a start; status '' means solved."""
        strength, temperature, slack, ridge = penalties
        (n_components, n, n_features), n_states = statistics.features.shape, self.mdp.n_states
        spare = self.trajectories - n
        absent = np.arange(self.trajectories) >= n
        padded = [np.pad(part, ((0, 0), (0, spare), (0, 0))) for part in statistics]
        # Proportions and responsibilities of exactly zero have no logarithm.
        pi = np.maximum(start.proportions, _WARM_BARRIER)
        pi = pi / pi.sum()
        posterior, evidence = _posterior(statistics, start.parts, start.values, pi, temperature)
        v = np.full((self.trajectories, n_components), 1 / n_components)
        v[:n] = np.maximum(posterior, _WARM_BARRIER / 10)
        v /= v.sum(1, keepdims=True)
        # Rows without a trajectory stay fixed. Without slack, plus and minus could grow together at no cost:
        # plus alone is then the weight.
        held = np.broadcast_to(absent[:, None], v.shape)
        free = np.tile(slack == 0, (n_components, 1))
        zero, infinite = np.zeros_like(free, float), np.full(free.shape, np.inf)
        unbounded = np.full((n_components, n_states), np.inf)
        lower = _flat(
            np.where(held, v, 0.0),
            np.zeros(n_components),
            np.concatenate([np.where(free, -np.inf, 0.0), zero], axis=1).T,
            -unbounded.T,
        )
        upper = _flat(
            np.where(held, v, np.inf),
            np.full(n_components, np.inf),
            np.concatenate([infinite, np.where(free, 0.0, np.inf)], axis=1).T,
            unbounded.T,
        )
        sums, bellman = np.ones(self.trajectories + 1), np.zeros(n_components * n_states)
        loose = np.append(absent, False)
        # Stationarity in v gives the multipliers of its rows; interior v have only the barrier's.
        rows = np.zeros(self.trajectories)
        rows[:n] = evidence - temperature
        parts = start.parts
        if free.any():
            joined = np.concatenate([parts[:, :n_features] - parts[:, n_features:], zero], axis=1)
            parts = np.where(np.tile(free, 2), joined, parts)
        result = solver(
            x0=_flat(v, pi, parts.T, start.values.T),
            lam_x0=_flat(
                np.where(held, 0.0, -_WARM_BARRIER / v),
                start.proportion_multipliers,
                start.part_multipliers.T,
                np.zeros_like(start.values.T),
            ),
            lam_g0=_flat(rows, np.array([start.sum_multiplier]), start.bellman_multipliers.T),
            p=_flat(
                *(part for table in padded for part in table),
                ~absent,
                [strength],
                [temperature],
                slack,
                [ridge],
            ),
            lbx=lower,
            ubx=upper,
            lbg=np.concatenate([np.where(loose, -np.inf, sums), bellman]),
            ubg=np.concatenate([np.where(loose, np.inf, sums), bellman]),
        )
        outcome = solver.stats()
        status = "" if outcome["success"] else str(outcome["return_status"])
        x, bounds = (self._parted(np.asarray(result[name]).ravel()) for name in ("x", "lam_x"))
        constraints = np.asarray(result["lam_g"]).ravel()
        found = MinMaxPoint(
            x[0],
            x[1],
            x[2],
            bounds[0],
            bounds[1],
            constraints[self.trajectories + 1 :].reshape(n_components, n_states),
            float(constraints[self.trajectories]),
        )
        return self._concluded(statistics, penalties, found, int(outcome["iter_count"]), not status), status

    def _parted(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split a vector of variables or multipliers into proportions, parts of weights, and values."""
        at = self.trajectories * self.components
        sizes = np.cumsum([at, self.components, 2 * self.mdp.n_features * self.components])
        _, pi, parts, values = np.split(vector, sizes)
        return pi, parts.reshape(self.components, -1), values.reshape(self.components, -1)

    def _concluded(
        self,
        statistics: _Statistics,
        penalties: _Penalties,
        point: MinMaxPoint,
        iterations: int,
        solved: bool,
    ) -> MinMaxSolution:
        strength, temperature, slack, ridge = penalties
        plus, minus = np.split(point.parts, 2, axis=1)
        weights, values = plus - minus, point.values
        if solved:
            values = np.stack(
                [
                    soft_values(self._scaled, jnp.asarray(w), jnp.asarray(v))
                    for w, v in zip(weights, values, strict=True)
                ]
            )
        pi = np.maximum(point.proportions, 0.0)
        pi = pi / pi.sum()
        posterior, evidence = _posterior(statistics, point.parts, values, pi, temperature)
        objective = (
            evidence.sum()
            + temperature * strength * xlogy(pi, pi).sum()
            - (np.abs(weights) @ slack).sum()
            - ridge / 2 * (weights**2).sum()
        )
        return MinMaxSolution(
            weights / self._scale, values, pi, posterior, float(objective), iterations, point
        )


def _posterior(
    statistics: _Statistics,
    parts: np.ndarray,
    values: np.ndarray,
    proportions: np.ndarray,
    temperature: float,
) -> tuple[Float[np.ndarray, "n D"], Float[np.ndarray, " n"]]:
    """Return the best responsibilities, and each trajectory's resulting share of the objective."""
    plus, minus = np.split(parts, 2, axis=1)
    likelihood = np.einsum("dik,dk->id", statistics.features, plus - minus)
    likelihood -= np.einsum("dis,ds->id", statistics.state_weights, values)
    with np.errstate(divide="ignore"):
        joint = np.log(proportions) + likelihood / temperature
    evidence = logsumexp(joint, axis=1)
    return np.exp(joint - evidence[:, None]), temperature * evidence


def _flat(*parts: Any) -> np.ndarray:
    """Stack arrays as CasADi does: column by column."""
    return np.concatenate([np.asarray(part, float).ravel(order="F") for part in parts])
