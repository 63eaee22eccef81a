"""The maximum-entropy observation program (chapter 6.1) in CasADi: reliabilities that explain agreement.

Eq. 6.7 as printed asks one product to equal one number for every candidate truth; in general nothing does.
What is solved here has a distribution as its answer: among all ``O(. | g)`` the one of greatest entropy,
weighted by how likely each truth ``g`` is, whose expected agreement on each predicate is a target::

    maximise    sum_g w(g) H(O(. | g))
    subject to  |sum_g w(g) sum_o O(o | g) [psi_j(o) = psi_j(g)] - target_j| <= slack_j

Its answer is ``O(o | g) = exp(sum_j lambda_j [psi_j(o) = psi_j(g)]) / Z_g``: Eq. 6.5, normalised, with
``lambda_j = logit p_j``, which is what :class:`~i2rl.models.FeatureNoise` says of reports.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.sparse import csgraph

from ..models.agreement import PredicateClasses, predicate_classes
from .maxent_constraints import ProgramNotSolved
from .maxent_dual import _COLD, _WARM, IpoptPoint

# The curvature along a direction that reports say nothing about is zero but for rounding.
_FLAT = 1e-10
# exp of less than this is zero: a row of the program would lose all its terms.
_LEAST_EXPONENT = 700.0


class Identification(NamedTuple):
    """Which reliabilities reports can tell, whatever they are.

    Fields
    ------
    uninformative : tuple of int
        Predicates with one value on all that can be reported: their reliability changes no probability.
    groups : tuple of tuples of int
        Predicates of which only a combination is identified; of two that are equal (or opposite) everywhere,
        the product of the odds ``p / (1 - p)``.
    identified : float ``[J, J]``
        Projection onto the identified directions of the logits. What it leaves unchanged can be learned;
        two vectors of logits with one projection are one observation model at every truth of some weight.
    """

    uninformative: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    identified: Float[np.ndarray, "J J"]

    def describe(self, names: tuple[str, ...] | None = None) -> str:
        """What cannot be told, in words; empty if everything can."""
        called = (lambda j: f"predicate {j}") if names is None else (lambda j: names[j])
        lines = [
            f"{called(j)} is the same for everything that can be reported: uninformative"
            for j in self.uninformative
        ] + [f"only a combination of {', '.join(map(called, group))} is identified" for group in self.groups]
        return "; ".join(lines)


def unidentified_predicates(
    predicates: ArrayLike, weights: ArrayLike | None = None, reportable: ArrayLike | None = None
) -> Identification:
    """Name the predicates ``[J, S, A]`` whose reliabilities no amount of reports would tell.

    ``weights [S, A]`` is how likely each truth is (equal by default): predicates that differ only where the
    truth never is cannot be told apart. Raises ``ValueError`` for bad predicates and weights.
    """
    classes = predicate_classes(predicates, reportable)
    if weights is None:
        weights = np.ones(classes.of_pair.shape)
    return _identification(classes, classes.gather(weights))[0]


def _identification(
    classes: PredicateClasses, truths: Float[np.ndarray, " C"]
) -> tuple[Identification, Float[np.ndarray, " J"]]:
    """Identification, and the expected agreement of reports made at random.

    The null space of the dual's curvature is the same at all logits; it is measured where they are zero.
    """
    reports = classes.reportable / classes.reportable.sum()
    agreements = classes.agreements
    mean = np.einsum("goj,o->gj", agreements, reports)
    centred = agreements - mean[:, None]
    curvature = np.einsum("g,o,goj,gok->jk", truths, reports, centred, centred, optimize=True)
    sizes, axes = np.linalg.eigh(curvature)
    known = axes[:, sizes > _FLAT]
    identified = known @ known.T
    # A subspace splits over a partition of its coordinates just where the projection is block diagonal.
    loose = np.eye(len(identified)) - identified
    uninformative = tuple(int(j) for j in np.flatnonzero(np.diag(curvature) <= _FLAT))
    linked = np.abs(loose) > 1e-6
    n_parts, part = csgraph.connected_components(linked)
    parts = [tuple(int(j) for j in np.flatnonzero(part == i)) for i in range(n_parts)]
    # An uninformative predicate is loose by itself, and a well identified one is linked to nothing.
    groups = tuple(members for members in parts if len(members) > 1)
    return Identification(uninformative, groups, identified), truths @ mean


class ObservationSolution(NamedTuple):
    """Solution of the observation program.

    Fields
    ------
    reliabilities : float ``[J]``
        ``p_j``; one half for uninformative predicates. Where only a combination is identified, the logits of
        least norm: equal ones for equal predicates.
    logits : float ``[J]``
        ``lambda_j = logit p_j``.
    agreement : float ``[J]``
        Expected agreement of the solution, to be compared with the target.
    gap : float ``[J]``
        How far the agreement lies outside ``target +- slack``: zero but for the solver's tolerance, unless
        the target is beyond what logits within the limit can reach.
    entropy : float
        ``sum_g w(g) H(O(. | g))``, in nats.
    iterations : int
        Of IPOPT.
    warm : IpoptPoint
        Where to start the next session from.
    identification : Identification
        Which reliabilities the truths of this session can tell.
    """

    reliabilities: Float[np.ndarray, " J"]
    logits: Float[np.ndarray, " J"]
    agreement: Float[np.ndarray, " J"]
    gap: Float[np.ndarray, " J"]
    entropy: float
    iterations: int
    warm: IpoptPoint
    identification: Identification


class ObservationProgram:
    """The program's dual, convex in as many variables as there are predicates; built once, solved often.

    ::

        minimise    sum_g w(g) log Z_g(lambda) - lambda.target + slack.(plus + minus),  lambda = plus - minus
        subject to  -limit <= lambda <= limit

    Up to a factor it is minus the expected log-likelihood of the reports, if target and weights come from one
    posterior over truths (:func:`~i2rl.models.agreement.reported_matches`): maximum entropy is maximum
    likelihood here, as everywhere in this package.

    Parameters
    ----------
    predicates : bool ``[J, S, A]``
    reportable : bool ``[S, A]``, optional
        Which pairs perception may report; all by default.
    limit : float
        Largest logit. A target that no observation model meets, or only a noiseless one, then costs
        ``limit`` nats per unit of agreement missed instead of having no solution; 12 is one error in 160 000.

    Raises
    ------
    ValueError
        As ``FeatureNoise``, and for a limit that is not positive or so large that exponentials vanish.
    """

    def __init__(
        self, predicates: ArrayLike, reportable: ArrayLike | None = None, limit: float = 12.0
    ) -> None:
        self.classes = predicate_classes(predicates, reportable)
        n_classes, n_predicates = self.classes.vectors.shape
        if not 0 < limit * n_predicates < _LEAST_EXPONENT:
            raise ValueError(
                f"the limit of {n_predicates} logits must lie between 0 and "
                f"{_LEAST_EXPONENT / n_predicates:g}, got {limit}"
            )
        self.limit = float(limit)
        said = self.classes.reportable > 0
        self._agree = self.classes.agreements[:, said]
        self._log_count = np.log(self.classes.reportable[said])
        n_reports = int(said.sum())
        agree = ca.DM(self._agree.reshape(-1, n_predicates))
        plus, minus = ca.MX.sym("plus", n_predicates), ca.MX.sym("minus", n_predicates)
        truths, target = ca.MX.sym("w", n_classes), ca.MX.sym("target", n_predicates)
        slack = ca.MX.sym("slack", n_predicates)
        # Relative to agreement where plus says so and disagreement where minus does, no exponent is positive.
        exponents = -(1 - agree) @ plus - agree @ minus + np.tile(self._log_count, n_classes)
        log_z = ca.sum1(plus) + ca.log(ca.sum1(ca.reshape(ca.exp(exponents), n_reports, n_classes))).T
        program = {
            "x": ca.vertcat(plus, minus),
            "p": ca.vertcat(truths, target, slack),
            "f": ca.dot(truths, log_z) - ca.dot(plus - minus, target) + ca.dot(slack, plus + minus),
        }
        self._cold = ca.nlpsol("observation_cold", "ipopt", program, _COLD)
        self._warm = ca.nlpsol("observation_warm", "ipopt", program, _WARM)

    def solve(
        self,
        weights: ArrayLike,
        target: ArrayLike,
        slack: ArrayLike = 0.0,
        warm: IpoptPoint | None = None,
    ) -> ObservationSolution:
        """Solve from ``warm`` (the previous session's) or from reliabilities of one half.

        Parameters
        ----------
        weights : float ``[S, A]``
            How likely each truth is; normalised here.
        target : float ``[J]``
            Expected agreement on each predicate, in [0, 1]. Where predicates are not identified apart, what
            contradicts (two numbers for equal predicates) is replaced by the nearest that does not.
        slack : float or float ``[J]``
            How far the agreement may lie from its target.
        warm : IpoptPoint, optional

        Raises
        ------
        ValueError
            For weights, targets and slacks of the wrong shape or range.
        ProgramNotSolved
            When IPOPT gives up.
        """
        n_predicates = self.classes.vectors.shape[1]
        truths = self.classes.gather(weights)
        wanted = _in_unit_interval("targets", np.asarray(target, float), n_predicates)
        beta = _in_unit_interval(
            "slacks", np.array(np.broadcast_to(slack, (n_predicates,)), float), n_predicates
        )
        identification, at_random = _identification(self.classes, truths)
        possible = at_random + identification.identified @ (wanted - at_random)
        point, iterations, status = self._run(truths, possible, beta, warm)
        if status and warm is not None:
            point, more, status = self._run(truths, possible, beta, None)
            iterations += more
        if status:
            raise ProgramNotSolved(
                f"the observation program was not solved: IPOPT reports {status} "
                f"after {iterations} iterations"
            )
        plus, minus = np.split(point.variables, 2)
        logits = identification.identified @ (plus - minus)
        agreement, log_z = self._expectations(truths, logits)
        return ObservationSolution(
            reliabilities=1 / (1 + np.exp(-logits)),
            logits=logits,
            agreement=agreement,
            gap=np.maximum(np.abs(agreement - possible) - beta, 0),
            entropy=float(truths @ log_z - logits @ agreement),
            iterations=iterations,
            warm=point,
            identification=identification,
        )

    def _run(
        self,
        truths: Float[np.ndarray, " C"],
        target: Float[np.ndarray, " J"],
        slack: Float[np.ndarray, " J"],
        warm: IpoptPoint | None,
    ) -> tuple[IpoptPoint, int, str]:
        """A primal-dual point, its iterations, and a status that is empty if it solves the program."""
        # Without slack, plus and minus could grow together for nothing: plus alone is then the logit.
        free = slack == 0
        arguments: dict[str, Any] = {
            "p": np.concatenate([truths, target, slack]),
            "lbx": np.concatenate([np.where(free, -self.limit, 0.0), np.zeros(len(slack))]),
            "ubx": np.concatenate([np.full(len(slack), self.limit), np.where(free, 0.0, self.limit)]),
        }
        if warm is None:
            solver = self._cold
            arguments["x0"] = np.zeros(2 * len(slack))
        else:
            solver = self._warm
            arguments |= {"x0": warm.variables, "lam_x0": warm.bound_multipliers}
        result = solver(**arguments)
        statistics = solver.stats()
        point = IpoptPoint(*(np.asarray(result[name]).ravel() for name in ("x", "lam_x", "lam_g")))
        status = "" if statistics["success"] else str(statistics["return_status"])
        return point, int(statistics["iter_count"]), status

    def _expectations(
        self, truths: Float[np.ndarray, " C"], logits: Float[np.ndarray, " J"]
    ) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " C"]]:
        """Expected agreement ``[J]`` and ``log Z_g`` of each class."""
        exponents = self._agree @ logits + self._log_count
        highest = exponents.max(1, keepdims=True)
        terms = np.exp(exponents - highest)
        total = terms.sum(1, keepdims=True)
        agreement = np.einsum("g,go,goj->j", truths, terms / total, self._agree, optimize=True)
        return agreement, (np.log(total) + highest)[:, 0]


def _in_unit_interval(what: str, numbers: np.ndarray, n_predicates: int) -> Float[np.ndarray, " J"]:
    if numbers.shape != (n_predicates,):
        raise ValueError(
            f"{n_predicates} predicates need as many {what}, got an array of shape {list(numbers.shape)}"
        )
    # Expectations are sums, and sums round.
    outside = ~((numbers >= -1e-9) & (numbers <= 1 + 1e-9))
    if outside.any():
        j = int(np.flatnonzero(outside)[0])
        raise ValueError(f"{what} of agreement lie between 0 and 1; that of predicate {j} is {numbers[j]}")
    return np.clip(numbers, 0, 1)
