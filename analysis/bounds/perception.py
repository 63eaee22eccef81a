"""Bounds of RIMEO, for noisy perception with an estimated observation model (chapter 6.1, appendix E).

Printed and corrected statements stand side by side; notation is that of
:mod:`~i2rl.analysis.bounds.theorems`. ``p_j`` are the reliabilities of the ``|Psi|`` predicates, ``O(o | g)``
the observation model that they make (Eq. 6.5), ``L`` the steps of the longest trajectory, ``n_o`` the
observations that the model was estimated from.

Lemma 4 (Lemma 8 of appendix E) in detail. Its term ``L |Psi| epsilon_o`` can be proved in another form than
the printed one, and for another quantity:

- The lemma lets ``epsilon_o`` bound ``|O - O_hat|`` at the observed pairs, and assigns every other pair
  ``|Psi|`` times that error. Equal products do not determine their factors: reliabilities (0.9, 0.1) and
  (0.1, 0.9) give an observation with both predicates right the same 0.09, and one with only the first right
  0.81 or 0.01. If ``epsilon_o`` bounds the error of each *reliability*, then observations of one truth differ
  by at most ``|Psi| epsilon_o`` in total variation, and ``L |Psi| epsilon_o`` over a trajectory.
- Hoeffding's inequality concerns a mean of values whose expectation is the estimand. Matches counted against
  a known truth are such values; a running average of scores (Eq. 6.6) is not, and without truths or scores
  the reliabilities may be unidentified.
- The posterior's normaliser ``eta`` belongs to a model; the proof gives both models the same one, and then
  drops it from ``sum_xi f_k(xi) eta P(xi) <= 1 / (1 - gamma)``, although it is the inverse probability of the
  observation, large for a rare one. For the observed trajectories the term therefore fails: with one
  predicate, one step, a truth of probability 0.01, reliabilities 0.99 and 0.995, the observation that it
  holds moves the posterior by 0.17 instead of 0.005. *In expectation over observations* it is a bound. With
  ``P`` and ``P_hat`` the laws of observations under the two models and the expert's behaviour, ``E_P[phi_hat]
  - E[phi] = sum_o (P(o) - P_hat(o)) phi_hat(o)``, because ``E_P_hat[phi_hat] = E[phi]``: at most the total
    variation of the two laws, which is at most that of the observations of one truth.
- That requires the expert's weights in the posterior, and a model independent of the observations that it
  explains. Without the latter, or for the posterior's change itself, only odds give a bound:
  :func:`.posterior_distance`.
- RIMEO's posterior uses its own weights, and then no bound of this form holds. The printed one does not
  depend on the noise of perception. At reliabilities of 1/2, known exactly, the posterior is the prior, all
  weights reproduce themselves, and the program with slack returns zero: the loss is that of ignorance, for
  every number of trajectories. The study of coverage shows this at 0.6 too.
- ``delta_o`` counts every feature ``k``, although one event (all reliabilities are within ``epsilon_o``)
  makes the term hold for all of them: ``2 |Psi| exp(-2 n_o epsilon_o^2)`` is enough. ``epsilon_s`` and
  ``delta_s`` are superfluous, as in Lemma 2: the posterior's expected features, or those of any number of
  completions drawn from it, are independent values in [0, 1] themselves.
- Discounting does not shorten ``L``: the observation of a late step is evidence about early ones. The
  features' discounted sum has the range ``1 / (1 - gamma)`` for late errors, too.
- Eq. 6.5 is a distribution over observations only if every combination of predicates can be observed.
  Normalised over the possible combinations, a reliability is a parameter and ``|Psi| epsilon_o`` no bound;
  :func:`.model_distance` measures the replacement of ``epsilon_o |Psi|``.
- The features of earlier sessions are not completed again when the model improves (Eq. 6.9): ``n_o`` counts
  the observations behind the model of the *first* session, or ``epsilon_o`` is an average over sessions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from ...inference.sessions.schedule import Harmonic, described
from .assumptions import (
    COMPLETION,
    DIMINISHING,
    EXPERT,
    EXPERTS_POSTERIOR,
    FEATURES,
    INDEPENDENT,
    INDEPENDENT_PREDICATES,
    KNOWN_TRUTHS,
    OBSERVATION,
    OTHER_REPORTS,
    PREDICATES_SEEN,
    PROGRAM_SOLVED,
    SOLVED,
    WHOLE,
    Bound,
)
from .checks import counted, counted_sessions, discounted, positive, probability
from .distance import Perception, observation_distance, posterior_distance
from .theorems import (
    Regret,
    failure_probability,
    lme_constraint_bound,
    no_regret,
    size_for,
)

# -- the constraint bound -----------------------------------------------------------------------------


def rimeo_constraint_bound(
    size: float, draws: float, epsilon: float, epsilon_s: float, perception: Perception, n_features: int
) -> Bound:
    """Bound by Lemma 4 (chapter 6), Lemma 8 (appendix E), as printed: constraints under estimated perception.

    ``(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon_r = epsilon + epsilon_s + L |Psi| epsilon_o`` with
    probability at least ``max(0, 1 - delta - delta_s - delta_o)``, ``delta_o = 2 K |Psi| exp(-2 n_o
    epsilon_o^2)``. The module states its faults; :func:`noisy_constraint_bound` is what can be proved.
    """
    lemma = lme_constraint_bound(size, draws, epsilon, epsilon_s, n_features)
    counted("predicates", perception.predicates), counted("longest", perception.longest)
    deltas = (
        failure_probability(size, epsilon, n_features),
        failure_probability(draws, epsilon_s, n_features),
        failure_probability(
            perception.observations, perception.epsilon_o, n_features * perception.predicates
        ),
    )
    error = lemma.error + perception.longest * perception.predicates * perception.epsilon_o
    return Bound(
        "Lemma 4 (Lemma 8 of appendix E)",
        "(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon + epsilon_s + L |Psi| epsilon_o",
        error,
        max(0.0, 1 - sum(deltas)),
        error,
        (FEATURES, INDEPENDENT, WHOLE, COMPLETION, OBSERVATION, PREDICATES_SEEN),
    )


def noisy_constraint_bound(
    size: float,
    epsilon: float,
    perception: Perception,
    n_features: int,
    reliabilities: Float[np.ndarray, " J"] | None = None,
) -> Bound:
    """Bound by Lemma 4 corrected: ``(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon + d`` for all ``k``.

    With probability at least ``max(0, 1 - delta - delta_o)``, ``delta_o = 2 |Psi| exp(-2 n_o epsilon_o^2)``,
    and ``d`` the :func:`.observation_distance`, smaller if the estimated ``reliabilities [J]`` are given.
    ``phi_hat`` is the posterior's, exact or of independent draws from it, under the expert's weights and
    reliabilities counted on ``n_o`` other observations of known truth.
    """
    distance = observation_distance(perception, reliabilities)
    return _corrected(size, epsilon, distance, perception, n_features, (OTHER_REPORTS,))


def same_reports_constraint_bound(
    size: float,
    epsilon: float,
    perception: Perception,
    n_features: int,
    reliabilities: Float[np.ndarray, " J"],
) -> Bound:
    """Bound as :func:`noisy_constraint_bound`, with ``d`` the :func:`.posterior_distance`.

    Reliabilities may then come from the observations that the posterior explains.
    """
    distance = posterior_distance(perception, reliabilities)
    return _corrected(size, epsilon, distance, perception, n_features, ())


def _corrected(
    size: float, epsilon: float, distance: float, perception: Perception, n_features: int, more: tuple
) -> Bound:
    delta = failure_probability(size, epsilon, n_features)
    delta_o = failure_probability(perception.observations, perception.epsilon_o, perception.predicates)
    return Bound(
        "Lemma 4 (Lemma 8 of appendix E), corrected",
        "(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon + d",
        epsilon + distance,
        max(0.0, 1 - delta - delta_o),
        epsilon + distance,
        (FEATURES, INDEPENDENT, WHOLE, EXPERTS_POSTERIOR, INDEPENDENT_PREDICATES, KNOWN_TRUTHS, *more),
    )


# -- the log-likelihood -------------------------------------------------------------------------------


def rimeo_confidence(
    size: float,
    draws: float,
    epsilon: float,
    epsilon_s: float,
    perception: Perception,
    n_features: int,
    discount: float,
) -> Bound:
    """Bound by Theorem 1 (chapter 6), Theorem 6 (appendix E), as printed: confidence for RIMEO.

    ``LL(theta_E) - LL(theta^i) <= 2 K epsilon_r / (1 - gamma)`` with probability ``max(0, 1 - delta_r)``. The
    likelihood is that of the completed trajectories (the proof's ``Q``), not of the observations. The
    program's slack has to be ``epsilon_r / (1 - gamma)``; the proof starts with ``epsilon / (1 - gamma)``,
    for which the cited step fails. It also takes ``|theta|_1 = 1``, which gives ``2 epsilon_r / (1 -
    gamma)``: the factor ``K`` belongs to weights in [0, 1]^K (:func:`noisy_confidence` has it as ``norm``).

    See Also
    --------
    i2rl.analysis.lme_i2rl_confidence : the same without noise
    i2rl.analysis.perception_needed : ask for the sizes

    Examples
    --------
    >>> from i2rl.analysis import rimeo_confidence
    >>> from i2rl.analysis.bounds.distance import Perception
    >>> perception = Perception(observations=100_000, epsilon_o=0.01, predicates=3, longest=4)
    >>> bound = rimeo_confidence(400, 1000, 0.1, 0.05, perception, n_features=2, discount=0.9)
    >>> round(bound.error, 1), round(bound.confidence, 2)
    (10.8, 0.97)
    """
    lemma = rimeo_constraint_bound(size, draws, epsilon, epsilon_s, perception, n_features)
    return Bound(
        "Theorem 6 of appendix E",
        "LL(theta_E) - LL(theta) <= 2 K epsilon_r / (1 - gamma)",
        2 * n_features * lemma.error / (1 - discounted(discount)),
        lemma.confidence,
        lemma.error,
        (*EXPERT, COMPLETION, OBSERVATION, PREDICATES_SEEN, *PROGRAM_SOLVED),
    )


def noisy_confidence(lemma: Bound, n_features: int, discount: float, norm: float | None = None) -> Bound:
    """Bound by Theorem 6 from a corrected ``lemma``: of the expert's *expected* log-likelihood, as all of
    :mod:`~i2rl.analysis.bounds.theorems`.

    ``E[LL(theta_E) - LL(theta)] <= 2 epsilon_r |theta_E|_1 / (1 - gamma)`` with the lemma's probability, for
    the program with slack ``epsilon_r / (1 - gamma)``. ``norm`` is ``|theta_E|_1``; without it the ``K`` of
    weights in [0, 1].
    """
    counted("n_features", n_features)
    size = n_features if norm is None else positive("norm", norm)
    premises = {a.name: a for a in (*EXPERT, *lemma.assumptions, *PROGRAM_SOLVED)}
    return lemma._replace(
        source="Theorem 6 of appendix E, corrected",
        statement="LL(theta_E) - LL(theta) <= 2 |theta_E|_1 epsilon_r / (1 - gamma)",
        error=2 * size * lemma.error / (1 - discounted(discount)),
        assumptions=tuple(premises.values()),
    )


def perception_needed(
    n_features: int, predicates: int, longest: int, error: float, confidence: float
) -> pd.DataFrame:
    """Compute the data for ``(1 - gamma) |E[phi_k] - phi_hat_k| <= error``, as printed and corrected.

    The terms share ``error`` and the rest of ``confidence`` equally. Returns a table with rows ``printed``
    and ``corrected`` and columns ``trajectories``, ``draws`` (of completions), ``observations`` (``n_o``) and
    ``epsilon_o``. Raises ``ValueError`` for an error outside (0, 1], a confidence outside (0, 1), or counts
    below 1.

    See Also
    --------
    i2rl.analysis.rimeo_confidence : the theorem's own direction
    i2rl.analysis.demonstrations_needed : the same without noise

    Examples
    --------
    >>> from i2rl.analysis import perception_needed
    >>> table = perception_needed(n_features=2, predicates=3, longest=4, error=0.3, confidence=0.9)
    >>> table.trajectories.to_dict(), table.observations.to_dict()
    ({'printed': 240, 'corrected': 98}, {'printed': 42380, 'corrected': 13229})
    """
    counted("predicates", predicates), counted("longest", longest)
    if not 0 < error <= 1:
        raise ValueError(f"the error of an average of values in [0, 1] lies in (0, 1], got {error}")
    delta, factors = 1 - probability("confidence", confidence), longest * predicates
    printed, corrected = error / 3 / factors, -math.expm1(math.log1p(-error / 2) / factors)
    share, half = size_for(error / 3, delta / 3, n_features), size_for(error / 2, delta / 2, n_features)
    known = size_for(printed, delta / 3, n_features * predicates), size_for(corrected, delta / 2, predicates)
    rows = [
        ("printed", math.ceil(share), math.ceil(share), math.ceil(known[0]), printed),
        ("corrected", math.ceil(half), 0, math.ceil(known[1]), corrected),
    ]
    columns = ["bound", "trajectories", "draws", "observations", "epsilon_o"]
    return pd.DataFrame(rows, columns=columns).set_index("bound")


# -- regret -------------------------------------------------------------------------------------------


def rimeo_no_regret(
    c: float,
    session_sizes: Int[np.ndarray, " T"] | Sequence[int],
    session_draws: Int[np.ndarray, " T"] | Sequence[int],
    session_observations: Int[np.ndarray, " T"] | Sequence[int],
    predicates: int,
    longest: int,
    n_features: int,
    discount: float,
) -> Regret:
    """Bound by Theorem 2 (chapter 6), Theorem 7 (appendix E): regret with ``epsilon_{r,i} = c (1 - gamma) /
    i``.

    The relaxation is spent in thirds on ``epsilon``, ``epsilon_s`` and ``L |Psi| epsilon_o`` (the
    dissertation leaves it open). ``session_sizes [T]`` are the trajectories of each session,
    ``session_draws [T]`` the draws ``n_s`` in it, ``session_observations [T]`` the observations it adds to
    ``n_o``. The remarks of :func:`~i2rl.analysis.bounds.theorems.no_regret` on ``log T``, products and
    growing sessions hold for all three, see :func:`rimeo_no_regret_sizes`. Besides, ``phi_hat`` averages over
    sessions (Eq. 6.9), of which the early ones were completed with the early models: for ``epsilon_{o,i}``
    falling as ``1 / i`` and sessions of one size the average falls as ``log T / T`` only. The theorem holds
    for a learner that completes all sessions again.
    """
    counted("predicates", predicates), counted("longest", longest)
    plain = no_regret(c, session_sizes, n_features, discount)
    i = np.arange(1, len(plain.average) + 1)
    third = c * (1 - discount) / i / 3
    draws, observations = counted_sessions(session_draws), counted_sessions(session_observations)
    if not len(draws) == len(observations) == len(i):
        raise ValueError(
            f"{len(i)} session sizes, but {len(draws)} numbers of draws "
            f"and {len(observations)} of observations"
        )
    epsilon_o = third / (longest * predicates)
    delta = (
        2
        * n_features
        * (
            np.exp(-2 * np.cumsum(counted_sessions(session_sizes)) * third**2)
            + np.exp(-2 * draws * third**2)
            + predicates * np.exp(-2 * np.cumsum(observations) * epsilon_o**2)
        )
    )
    confidence = np.cumprod(np.maximum(0.0, 1 - delta))
    bound = plain.bound._replace(
        source="Theorem 7 of appendix E",
        confidence=max(0.0, 1 - float(delta.sum())),
        assumptions=(*EXPERT, COMPLETION, OBSERVATION, PREDICATES_SEEN, DIMINISHING, SOLVED),
        schedule=str(described(Harmonic(c))),
    )
    return Regret(plain.average, confidence, bound)


def rimeo_no_regret_sizes(
    c: float, sessions: int, delta: float, predicates: int, longest: int, n_features: int, discount: float
) -> pd.DataFrame:
    """Compute each session's trajectories, draws and observations that hold Theorem 7's confidence at ``1 -
    delta``.

    The failure probability is spent as in :func:`~i2rl.analysis.bounds.theorems.no_regret_sizes`, in thirds:
    the additions of a session grow about linearly, its draws with the square. Indexed by session, from 1.
    """
    positive("c", c), counted("sessions", sessions), counted("n_features", n_features)
    counted("predicates", predicates), counted("longest", longest)
    i = np.arange(1, sessions + 1)
    spent = 2 * probability("delta", delta) / (np.pi * i) ** 2
    third = c * (1 - discounted(discount)) / i / 3
    size = np.log(2 * n_features / spent) / (2 * third**2)
    known = np.log(2 * n_features * predicates / spent) / 2 * (longest * predicates / third) ** 2
    return pd.DataFrame(
        {
            "trajectories": np.diff(np.ceil(size), prepend=0).astype(int),
            "draws": np.ceil(size).astype(int),
            "observations": np.diff(np.ceil(known), prepend=0).astype(int),
        },
        index=pd.Index(i, name="session"),
    )
