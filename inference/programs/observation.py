"""The maximum-entropy observation program (chapter 6.1) in CasADi: reliabilities that explain agreement.

Eq. 6.7 as printed asks one product to equal one number for every candidate truth, which is infeasible in
general. The program here has a distribution as its solution: among all ``O(. | g)`` the one of greatest
entropy, weighted by the probability of each truth ``g``, whose expected agreement on each predicate is a
target::

    maximise    sum_g w(g) H(O(. | g))
    subject to  |sum_g w(g) sum_o O(o | g) [psi_j(o) = psi_j(g)] - target_j| <= slack_j

The solution is ``O(o | g) = exp(sum_j lambda_j [psi_j(o) = psi_j(g)]) / Z_g``: Eq. 6.5, normalised, with
``lambda_j = logit p_j``, the model of :class:`~i2rl.models.FeatureNoise`.

A score says whether its observation is right or wrong (:mod:`~i2rl.inference.sensors.observations`). A wrong
observation is one of the *other* pairs, ``O(o | g, o != g)``. These distributions, weighted by the
probability of each truth among wrong observations, join the entropy and the expected agreement. Right ones
have one outcome.
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

# In directions without information the curvature is zero up to rounding.
_FLAT = 1e-10
# exp of less than this is zero: a row of the program would lose all its terms.
_LEAST_EXPONENT = 700.0


@shown_briefly
class Identification(NamedTuple):
    """Reliabilities that observations can identify, whatever their values.

    Fields
    ------
    uninformative : tuple of int
        Predicates with one value on all reportable pairs: their reliability changes no probability.
    groups : tuple of tuples of int
        Predicates of which only a combination is identified; for two that are equal (or opposite) everywhere,
        the product of the odds ``p / (1 - p)``.
    identified : float ``[J, J]``
        Projection onto the identified directions of the logits. Its fixed vectors can be learned; two vectors
        of logits with one projection are one observation model at every truth of positive weight.
    """

    uninformative: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    identified: Float[np.ndarray, "J J"]

    def describe(self, names: tuple[str, ...] | None = None) -> str:
        """Describe the unidentified predicates in words; empty if all are identified."""
        called = (lambda j: f"predicate {j}") if names is None else (lambda j: names[j])
        lines = [
            f"{called(j)} is the same for everything that can be reported: uninformative"
            for j in self.uninformative
        ] + [f"only a combination of {', '.join(map(called, group))} is identified" for group in self.groups]
        return "; ".join(lines)


class _Choices(NamedTuple):
    """Number of observations that agree with a truth in each pattern: the program's view of pairs.

    Fields
    ------
    patterns : float ``[E, J]``
        Agreements and disagreements that occur.
    of_any, of_others : float ``[C, E]``
        Number of pairs with each pattern of agreement with a truth in each class: of all reportable pairs,
        and of those other than the truth, which may be reportable itself.
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
    """Shares of truths with any observation, and of truths with another pair as observation; of sum one."""

    of_any: Float[np.ndarray, " C"]
    of_others: Float[np.ndarray, " C"]


def _truths(
    classes: PredicateClasses, choices: _Choices, reportable: ArrayLike | None, weights: Any, wrong: Any
) -> _Truths:
    """Check weights; raise ``ValueError`` as :meth:`ObservationProgram.solve` does."""
    if wrong is None:
        return _Truths(classes.gather(weights), np.zeros(len(classes.vectors)))
    plain, wrong = classes.checked(weights, zero=True), classes.checked(wrong, zero=True)
    classes.checked(plain + wrong)
    itself = np.ones(wrong.shape, bool) if reportable is None else np.asarray(reportable, bool)
    # A truth that cannot be reported is not among the reportable pairs to leave out.
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
    """Name the predicates ``[J, S, A]`` whose reliabilities no number of observations identifies.

    ``weights [S, A]`` are the probabilities of the truths (equal by default), ``wrong [S, A]`` those among
    wrong scored observations, as in :meth:`ObservationProgram.solve`: predicates that differ only at
    impossible truths are not identified. Raises ``ValueError`` for bad predicates and weights.
    """
    classes = predicate_classes(predicates, reportable)
    choices = _choices(classes)
    if weights is None:
        weights = np.ones(classes.of_pair.shape)
    return _identification(choices, _truths(classes, choices, reportable, weights, wrong))[0]


def _identification(choices: _Choices, truths: _Truths) -> tuple[Identification, Float[np.ndarray, " J"]]:
    """Return the identification, and the expected agreement of observations made at random.

    The null space of the dual's curvature is the same at all logits; it is computed at zero logits.
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
    """Return the expected agreement of observations, and its mean covariance given the truth."""
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
        ``p_j``; one half for uninformative predicates. If only a combination is identified, the logits of
        least norm: equal ones for equal predicates.
    logits : float ``[J]``
        ``lambda_j = logit p_j``.
    agreement : float ``[J]``
        Expected agreement of the solution, for comparison with the target.
    gap : float ``[J]``
        Distance of the agreement from ``target +- slack``: zero up to the solver's tolerance, unless the
        target is beyond what logits within the limit can reach.
    entropy : float
        ``sum_g w(g) H(O(. | g))``, plus ``H(O(. | g, o != g))`` of wrong observations, in nats.
    iterations : int
        IPOPT's iterations.
    warm : IpoptPoint
        Start for the next session.
    identification : Identification
        Reliabilities that the truths of this session identify.
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
    """The program's dual, convex in one variable per predicate; built once, solved often.

    ::

        minimise    sum_g w(g) log Z_g(lambda) + sum_g v(g) log Z'_g(lambda)
                    - lambda.target + slack.(plus + minus),     lambda = plus - minus
        subject to  -limit <= lambda <= limit

    ``Z'_g`` sums over the pairs other than ``g``, and ``v(g)`` is the probability of ``g`` among wrong
    observations. Up to a factor the objective is minus the expected log-likelihood of the observations, if
    target and weights come from one posterior over truths
    (:func:`~i2rl.models.observation.agreement.reported_matches`): maximum entropy is maximum likelihood.

    Parameters
    ----------
    predicates : bool or int ``[J, S, A]``
        Labels included, as in ``FeatureNoise``.
    reportable : bool ``[S, A]``, optional
        Pairs that perception may report; all by default.
    limit : float
        Largest logit. A target that no observation model meets, or only a noiseless one, then costs
        ``limit`` nats per unit of agreement missed instead of being infeasible; 12 is one error in 160 000.

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
        # A truth without other pairs has weight zero, but needs a finite logarithm.
        of_others = np.where(of_others.any(1, keepdims=True), of_others, 1.0)
        plus, minus = ca.MX.sym("plus", n_predicates), ca.MX.sym("minus", n_predicates)
        truths, blamed = ca.MX.sym("w", n_classes), ca.MX.sym("v", n_classes)
        target, slack = ca.MX.sym("target", n_predicates), ca.MX.sym("slack", n_predicates)
        # Relative to agreement for plus and to disagreement for minus, no exponent is positive.
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
            Probability of each truth; normalised here, together with ``wrong``.
        target : float ``[J]``
            Expected agreement on each predicate, in [0, 1]: matches of plain and of wrong observations,
            divided by the number of both. For predicates that are not identified apart, contradictory
            targets (two numbers for equal predicates) are replaced by the nearest consistent ones.
        slack : float or float ``[J]``
            Largest distance of the agreement from its target.
        warm : IpoptPoint, optional
        wrong : float ``[S, A]``, optional
            Probability of each truth among wrong observations with a score, on one scale with
            ``weights``. Either may be all zero.

        Raises
        ------
        ValueError
            For weights, targets and slacks of the wrong shape or range, and for wrong observations with a
            single reportable pair.
        ProgramNotSolved
            If IPOPT fails.
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
        """Return a primal-dual point, its iterations, and a status that is empty if the program is solved."""
        # Without slack, plus and minus could grow together at no cost: plus alone is then the logit.
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
    # Expectations are sums, which round.
    outside = ~((numbers >= -1e-9) & (numbers <= 1 + 1e-9))
    if outside.any():
        j = int(np.flatnonzero(outside)[0])
        raise ValueError(f"{what} of agreement lie between 0 and 1; that of predicate {j} is {numbers[j]}")
    return np.clip(numbers, 0, 1)
