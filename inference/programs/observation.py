"""The maximum-entropy observation program (chapter 6.1) in CasADi: reliabilities that explain agreement.

Eq. 6.7 as printed asks one product to equal one number for every candidate truth; in general nothing does.
What is solved here has a distribution as its answer: among all ``O(. | g)`` the one of greatest entropy,
weighted by how likely each truth ``g`` is, whose expected agreement on each predicate is a target::

    maximise    sum_g w(g) H(O(. | g))
    subject to  |sum_g w(g) sum_o O(o | g) [psi_j(o) = psi_j(g)] - target_j| <= slack_j

Its answer is ``O(o | g) = exp(sum_j lambda_j [psi_j(o) = psi_j(g)]) / Z_g``: Eq. 6.5, normalised, with
``lambda_j = logit p_j``, which is what :class:`~i2rl.models.FeatureNoise` says of reports.

A report that came with a score is right or wrong as the score says
(:mod:`~i2rl.inference.sensors.observations`). If it is wrong, it is one of the *other* pairs, ``O(o | g, o !=
g)``, and these distributions, weighted by how likely each truth is among wrong reports, join the entropy and
the expected agreement. Right ones have nothing to choose.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.sparse import csgraph

from ...models.inputs.display import shown_briefly
from ...models.observation.agreement import PredicateClasses, agreement_patterns, predicate_classes
from .constraints import ProgramNotSolved
from .dual import COLD_OPTIONS, WARM_OPTIONS, IpoptPoint

# The curvature along a direction that reports say nothing about is zero but for rounding.
_FLAT = 1e-10
# exp of less than this is zero: a row of the program would lose all its terms.
_LEAST_EXPONENT = 700.0


@shown_briefly
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


class _Choices(NamedTuple):
    """How many reports agree with a truth on what: all that the program knows of pairs.

    Fields
    ------
    patterns : float ``[E, J]``
        Agreements and disagreements that occur.
    of_any, of_others : float ``[C, E]``
        Number of pairs that agree so with a truth in each class: of all that can be reported, and of those
        other than the truth, which can be reported itself.
    """

    patterns: Float[np.ndarray, "E J"]
    of_any: Float[np.ndarray, "C E"]
    of_others: Float[np.ndarray, "C E"]


def _choices(classes: PredicateClasses) -> _Choices:
    said = classes.reportable > 0
    agree = classes.agreements[:, said]
    patterns, which = agreement_patterns(agree)
    of_any = np.zeros((len(agree), len(patterns)))
    np.add.at(of_any, (np.arange(len(agree))[:, None], which), classes.reportable[said])
    of_others = of_any - np.outer(said, patterns.all(1))
    return _Choices(patterns, of_any, of_others)


class _Truths(NamedTuple):
    """Shares of truths whose report may be any pair, and of those whose report is another; of sum one."""

    of_any: Float[np.ndarray, " C"]
    of_others: Float[np.ndarray, " C"]


def _truths(
    classes: PredicateClasses, choices: _Choices, reportable: ArrayLike | None, weights: Any, wrong: Any
) -> _Truths:
    """Check weights; raises ``ValueError`` as :meth:`ObservationProgram.solve` says."""
    if wrong is None:
        return _Truths(classes.gather(weights), np.zeros(len(classes.vectors)))
    plain, wrong = classes.checked(weights, zero=True), classes.checked(wrong, zero=True)
    classes.checked(plain + wrong)
    itself = np.ones(wrong.shape, bool) if reportable is None else np.asarray(reportable, bool)
    # A truth that cannot be reported is not left out of what can be.
    total = plain.sum() + wrong.sum()
    of_any = classes.sum(plain + np.where(itself, 0, wrong)) / total
    of_others = classes.sum(np.where(itself, wrong, 0)) / total
    if of_others @ (choices.of_others.sum(1) == 0) > 0:
        raise ValueError(
            "one pair alone can be reported, and no report of it is wrong; wrong reports of it weigh "
            f"{of_others @ (choices.of_others.sum(1) == 0):g}"
        )
    return _Truths(of_any, of_others)


def unidentified_predicates(
    predicates: ArrayLike,
    weights: ArrayLike | None = None,
    reportable: ArrayLike | None = None,
    wrong: ArrayLike | None = None,
) -> Identification:
    """Name the predicates ``[J, S, A]`` whose reliabilities no amount of reports would tell.

    ``weights [S, A]`` is how likely each truth is (equal by default), ``wrong [S, A]`` that among wrong
    scored reports, as in :meth:`ObservationProgram.solve`: predicates that differ only where the truth never
    is cannot be told apart. Raises ``ValueError`` for bad predicates and weights.
    """
    classes = predicate_classes(predicates, reportable)
    choices = _choices(classes)
    if weights is None:
        weights = np.ones(classes.of_pair.shape)
    return _identification(choices, _truths(classes, choices, reportable, weights, wrong))[0]


def _identification(choices: _Choices, truths: _Truths) -> tuple[Identification, Float[np.ndarray, " J"]]:
    """Identification, and the expected agreement of reports made at random.

    The null space of the dual's curvature is the same at all logits; it is measured where they are zero.
    """
    mean, curvature = _moments(choices, truths, np.zeros(choices.patterns.shape[1]))
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
    return Identification(uninformative, groups, identified), mean


def _mean_log_z(choices: _Choices, truths: _Truths, logits: Float[np.ndarray, " J"]) -> float:
    exponents = choices.patterns @ logits
    terms, total = np.exp(exponents - exponents.max()), 0.0
    for counts, share in ((choices.of_any, truths.of_any), (choices.of_others, truths.of_others)):
        total += share[share > 0] @ np.log(counts[share > 0] @ terms)
    return float(total + exponents.max())


def _moments(
    choices: _Choices, truths: _Truths, logits: Float[np.ndarray, " J"]
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, "J J"]]:
    """Expected agreement of reports, and its mean covariance given the truth."""
    patterns = choices.patterns
    mean, covariance = np.zeros(len(logits)), np.zeros((len(logits),) * 2)
    for counts, share in ((choices.of_any, truths.of_any), (choices.of_others, truths.of_others)):
        some = share > 0
        chances = counts[some] * np.exp(patterns @ logits - (patterns @ logits).max())
        chances /= chances.sum(1, keepdims=True)
        means = chances @ patterns
        mean += share[some] @ means
        covariance += (patterns.T * (share[some] @ chances)) @ patterns - (means.T * share[some]) @ means
    return mean, covariance


@shown_briefly
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
        ``sum_g w(g) H(O(. | g))``, and of wrong reports ``H(O(. | g, o != g))``, in nats.
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

        minimise    sum_g w(g) log Z_g(lambda) + sum_g v(g) log Z'_g(lambda)
                    - lambda.target + slack.(plus + minus),     lambda = plus - minus
        subject to  -limit <= lambda <= limit

    ``Z'_g`` sums over the pairs other than ``g``, and ``v(g)`` is how likely ``g`` is among wrong reports.
    Up to a factor it is minus the expected log-likelihood of the reports, if target and weights come from one
    posterior over truths (:func:`~i2rl.models.observation.agreement.reported_matches`): maximum entropy is
    maximum likelihood here, as everywhere in this package.

    Parameters
    ----------
    predicates : bool or int ``[J, S, A]``
        Labels included, as in ``FeatureNoise``.
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
        self._reportable = reportable
        self._choices = patterns, of_any, of_others = _choices(self.classes)
        # Where there is no other pair there is no truth of any weight, but a logarithm.
        of_others = np.where(of_others.any(1, keepdims=True), of_others, 1.0)
        plus, minus = ca.MX.sym("plus", n_predicates), ca.MX.sym("minus", n_predicates)
        truths, blamed = ca.MX.sym("w", n_classes), ca.MX.sym("v", n_classes)
        target, slack = ca.MX.sym("target", n_predicates), ca.MX.sym("slack", n_predicates)
        # Relative to agreement where plus says so and disagreement where minus does, no exponent is positive.
        terms = ca.exp(-ca.DM(1 - patterns) @ plus - ca.DM(patterns) @ minus)
        log_z = ca.dot(truths, ca.log(ca.DM(of_any) @ terms)) + ca.dot(
            blamed, ca.log(ca.DM(of_others) @ terms)
        )
        program = {
            "x": ca.vertcat(plus, minus),
            "p": ca.vertcat(truths, blamed, target, slack),
            "f": ca.sum1(plus) + log_z - ca.dot(plus - minus, target) + ca.dot(slack, plus + minus),
        }
        self._cold = ca.nlpsol("observation_cold", "ipopt", program, COLD_OPTIONS)
        self._warm = ca.nlpsol("observation_warm", "ipopt", program, WARM_OPTIONS)

    def solve(
        self,
        weights: ArrayLike,
        target: ArrayLike,
        slack: ArrayLike = 0.0,
        warm: IpoptPoint | None = None,
        wrong: ArrayLike | None = None,
    ) -> ObservationSolution:
        """Solve from ``warm`` (the previous session's) or from reliabilities of one half.

        Parameters
        ----------
        weights : float ``[S, A]``
            How likely each truth is; normalised here, together with ``wrong``.
        target : float ``[J]``
            Expected agreement on each predicate, in [0, 1]: matches of plain and of wrong reports, divided by
            the number of both. Where predicates are not identified apart, what
            contradicts (two numbers for equal predicates) is replaced by the nearest that does not.
        slack : float or float ``[J]``
            How far the agreement may lie from its target.
        warm : IpoptPoint, optional
        wrong : float ``[S, A]``, optional
            How likely each truth is among wrong reports with a score, on one scale with ``weights``. Either
            may be all zero.

        Raises
        ------
        ValueError
            For weights, targets and slacks of the wrong shape or range, and for wrong reports where only one
            pair can be reported.
        ProgramNotSolved
            When IPOPT gives up.
        """
        n_predicates = self.classes.vectors.shape[1]
        truths = _truths(self.classes, self._choices, self._reportable, weights, wrong)
        wanted = _in_unit_interval("targets", np.asarray(target, float), n_predicates)
        beta = _in_unit_interval(
            "slacks", np.array(np.broadcast_to(slack, (n_predicates,)), float), n_predicates
        )
        identification, at_random = _identification(self._choices, truths)
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
        agreement, _ = _moments(self._choices, truths, logits)
        return ObservationSolution(
            reliabilities=1 / (1 + np.exp(-logits)),
            logits=logits,
            agreement=agreement,
            gap=np.maximum(np.abs(agreement - possible) - beta, 0),
            entropy=_mean_log_z(self._choices, truths, logits) - float(logits @ agreement),
            iterations=iterations,
            warm=point,
            identification=identification,
        )

    def _run(
        self,
        truths: _Truths,
        target: Float[np.ndarray, " J"],
        slack: Float[np.ndarray, " J"],
        warm: IpoptPoint | None,
    ) -> tuple[IpoptPoint, int, str]:
        """A primal-dual point, its iterations, and a status that is empty if it solves the program."""
        # Without slack, plus and minus could grow together for nothing: plus alone is then the logit.
        free = slack == 0
        arguments: dict[str, Any] = {
            "p": np.concatenate([*truths, target, slack]),
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
