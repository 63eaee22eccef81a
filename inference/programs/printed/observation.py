"""The observation program as chapter 6.1 prints it (Eqs. 6.5 to 6.7), in CasADi, for comparison.

The unnormalised product of Eq. 6.5 should equal the mean score of an observation for every candidate truth.
With several candidates no reliabilities satisfy this, and it is met in the least-squares sense, by a penalty
that grows tenfold four times. :class:`~i2rl.inference.programs.observation.ObservationProgram` replaces it.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ....models.inputs.display import shown_briefly
from ....models.observation.agreement import predicate_classes, reported_matches
from ..constraints import ProgramNotSolved
from ..dual import COLD_OPTIONS

_PENALTIES = (1.0, 10.0, 100.0, 1e3, 1e4)
# Entropy has no derivative at the ends of the unit interval.
_INSIDE = 1e-6


@shown_briefly
class PrintedSolution(NamedTuple):
    """Solution of the printed program.

    Fields
    ------
    reliabilities : float ``[J]``
        ``P(psi_j)``.
    residual : float
        Root of the mean squared difference between products and scores.
    iterations : int
        IPOPT's iterations, over all penalties.
    """

    reliabilities: Float[np.ndarray, " J"]
    residual: float
    iterations: int


def solve_printed_program(
    predicates: ArrayLike,
    states: ArrayLike,
    actions: ArrayLike,
    scores: ArrayLike,
    candidates: ArrayLike,
) -> PrintedSolution:
    """Find reliabilities of greatest entropy whose products are the observations' scores.

    ::

        maximise  sum_j H(p_j) - v/2 sum_t sum_g candidates[t, g] (prod_j p_j(t, g) - c_t)^2

    with ``v`` from 1 to 1e4, where ``p_j(t, g)`` is ``p_j`` if observation ``t`` agrees with ``g`` on
    predicate ``j``, else ``1 - p_j``. Averaging the scores of each pair first (Eq. 6.6) would change only the
    residual. The program is not convex: from one half it ends in a local optimum.

    Parameters
    ----------
    predicates : bool ``[J, S, A]``
    states, actions : int ``[T]``
        The observed pairs.
    scores : float ``[T]``
        In [0, 1].
    candidates : float ``[T, S, A]``
        Weights of candidate truths, of sum one for each observation. Uniform over the task's pairs is the
        program as printed (``all``), a point at the observation ``observed``, a point at the truth
        ``oracle``.

    Raises
    ------
    ValueError
        For shapes that do not fit, indices out of range, scores outside [0, 1] or missing, and candidates
        that are not distributions.
    ProgramNotSolved
        If IPOPT fails.
    """
    matches = reported_matches(predicates, states, actions, candidates)
    c = np.asarray(scores, float)
    n_reports, n_predicates = len(np.asarray(states)), len(matches.matches)
    if c.shape != (n_reports,):
        raise ValueError(f"{n_reports} reports need as many scores, got shape {list(c.shape)}")
    if not n_reports:
        raise ValueError("the program needs at least one report")
    wrong = ~((c >= 0) & (c <= 1))
    if wrong.any():
        t = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"the printed program needs scores between 0 and 1; that of report {t} is {c[t]}")
    classes = predicate_classes(predicates)
    n_classes = len(classes.vectors)
    said = classes.of_pair[np.asarray(states), np.asarray(actions)]
    by_truth = np.zeros((n_classes, n_reports))
    np.add.at(by_truth, classes.of_pair.ravel(), np.asarray(candidates, float).reshape(n_reports, -1).T)
    weight = np.zeros((n_classes, n_classes))
    np.add.at(weight, said, by_truth.T)
    wanted = np.zeros((n_classes, n_classes))
    np.add.at(wanted, said, (by_truth * c).T)
    used = weight > 0
    agree, weight, wanted = classes.agreements[used], weight[used], wanted[used] / weight[used]
    # One penalty for one event: classes with the same agreements are merged.
    events, event = np.unique(agree, axis=0, return_inverse=True)
    total = np.bincount(event.ravel(), weight)
    mean = np.bincount(event.ravel(), weight * wanted) / total
    p, penalty = ca.MX.sym("p", n_predicates), ca.MX.sym("v")
    log_products = ca.DM(events) @ ca.log(p) + ca.DM(1 - events) @ ca.log(1 - p)
    misses = ca.dot(total, (ca.exp(log_products) - mean) ** 2)
    entropy = -ca.dot(p, ca.log(p)) - ca.dot(1 - p, ca.log(1 - p))
    program = {"x": p, "p": penalty, "f": penalty / 2 * misses - entropy}
    solver = ca.nlpsol("printed", "ipopt", program, COLD_OPTIONS)
    start, iterations = np.full(n_predicates, 0.5), 0
    for v in _PENALTIES:
        result = solver(x0=start, p=v, lbx=_INSIDE, ubx=1 - _INSIDE)
        statistics = solver.stats()
        iterations += int(statistics["iter_count"])
        if not statistics["success"]:
            raise ProgramNotSolved(
                f"the printed program was not solved: IPOPT reports {statistics['return_status']}"
            )
        start = np.asarray(result["x"]).ravel()
    products = np.exp(events @ np.log(start) + (1 - events) @ np.log(1 - start))[event.ravel()]
    spread = n_reports * float(np.mean(c**2)) - float(weight @ wanted**2)
    residual = np.sqrt(max(float(weight @ (products - wanted) ** 2) + spread, 0.0) / n_reports)
    return PrintedSolution(start, float(residual), iterations)
