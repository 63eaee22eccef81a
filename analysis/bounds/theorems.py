"""The dissertation's theorems: sufficient amounts of data, and their assumptions.

A theorem is a small function that returns a :class:`Bound`: an error, the confidence that it holds with, and
the assumptions that it rests on (:mod:`~i2rl.analysis.bounds.assumptions`).
:func:`~i2rl.analysis.bounds.assumptions.check` checks those that an MDP, weights and a run settle, and
:meth:`Bound.guarantee` raises if one of them fails.

The dissertation numbers its results twice (chapters 4 and 6, and again in appendices B and E); both numbers
are given; those of chapter 6.1, about noisy perception, are in :mod:`~i2rl.analysis.bounds.perception`.
Common notation: ``n`` independent trajectories, ``K`` features in [0, 1], discount ``gamma``, ``epsilon`` the
error of one feature's discounted average ``(1 - gamma) phi_hat_k`` in [0, 1], so that the program's slack is
``beta = epsilon / (1 - gamma)``. Log-likelihoods are those of the ``features`` statistic, ``sum_t gamma^t log
pi(a_t | s_t)``, in nats per (infinitely long) trajectory.

The theorems in detail. The program's solution is at most ``beta |theta_E|_1`` nats worse than the expert's
weights *on the data it was fitted to*, surely, with no probability involved. With probability ``1 - delta``,
the expert's *expected* log-likelihood is at most ``2 beta |theta_E|_1 <= 2 K epsilon / (1 - gamma)`` better
than the solution's (Dudik et al. 2007, Theorem 1, which the proofs cite). Coverage is therefore measured on
the expected gap; the sure one is :func:`sure_gap`. Expectations are over trajectories from ``p0``, or over
trajectories from the observed starts if the program is given those (as the learners' is).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ...inference.sessions.schedule import Harmonic, described
from .assumptions import (
    COMPLETION,
    DIMINISHING,
    EXPERT,
    FEATURES,
    FULL_VIEW,
    INDEPENDENT,
    PROGRAM_SOLVED,
    SOLVED,
    WEIGHTS,
    WHOLE,
    Bound,
)
from .checks import counted, counted_sessions, discounted, positive, probability
from .concentration import (
    Interval,
    empirical_bernstein,
    predictable_bernstein,
    predictable_half_width,
    smallest,
)

# -- one side of the union ----------------------------------------------------------------------------


def failure_probability(size: float, error: float, events: float) -> float:
    """Compute ``delta = 2 events exp(-2 n epsilon^2)`` by Hoeffding's inequality and a union bound; may
    exceed 1.
    """
    positive("error", error), counted("events", events)
    if not size >= 0:
        raise ValueError(f"size must not be negative, got {size}")
    return 2 * events * math.exp(-2 * size * error**2)


def size_for(error: float, delta: float, events: float) -> float:
    """Compute trajectories (or samples) for ``delta``: ``log(2 events / delta) / (2 epsilon^2)``, unrounded.

    The dissertation rounds to the nearest integer; the guarantee needs the next one.
    """
    positive("error", error), counted("events", events)
    return math.log(2 * events / probability("delta", delta)) / (2 * error**2)


def error_for(size: float, delta: float, events: float) -> float:
    """Compute the error reached with ``size`` trajectories (or draws) for ``delta``; inverse of
    :func:`size_for`.
    """
    counted("size", size), counted("events", events)
    return math.sqrt(math.log(2 * events / probability("delta", delta)) / (2 * size))


def sure_gap(epsilon: float, n_features: int, discount: float, norm: float | None = None) -> float:
    """Bound the solution's gap on its own data, surely: ``beta |theta_E|_1`` nats per trajectory.

    ``norm`` is ``|theta_E|_1``; without it the ``K`` of weights in [0, 1]. Comes from optimality alone:
    ``LL(theta) - beta |theta|_1`` is largest at the solution.
    """
    positive("epsilon", epsilon), counted("n_features", n_features), discounted(discount)
    return (n_features if norm is None else norm) * epsilon / (1 - discount)


# -- chapter 4 and appendix B -------------------------------------------------------------------------


def me_i2rl_confidence(size: float, epsilon: float, n_features: int, discount: float) -> Bound:
    """Bound by Theorem 1 (chapter 4), Theorem 3 (appendix B): confidence for ME-I2RL, under full
    observability.

    ``LL(theta_E) - LL(theta^i) <= 2 K epsilon / (1 - gamma)`` with probability at least ``max(0, 1 -
    delta)``, ``delta = 2 K exp(-2 n epsilon^2)``. Inverses: :func:`size_for` and :func:`error_for` with ``K``
    events. The first Theorem 4 of appendix B states the same by its error ``e`` in nats, ``delta = 2 K exp(-n
    e^2 (1 - gamma)^2 / (2 K^2))``. Raises ``ValueError`` for sizes or errors that are not positive, or a
    discount outside [0, 1).

    See Also
    --------
    i2rl.analysis.lme_i2rl_confidence : the same with hidden steps
    i2rl.analysis.check : decide its assumptions
    i2rl.analysis.demonstrations_needed : ask for the number of trajectories

    Examples
    --------
    >>> from i2rl.analysis import me_i2rl_confidence
    >>> bound = me_i2rl_confidence(size=400, epsilon=0.1, n_features=2, discount=0.9)
    >>> round(bound.error, 2), round(bound.confidence, 3)
    (4.0, 0.999)
    >>> bound.assuming(full_view=True).undecided[0].statement
    'features lie in [0, 1]'
    """
    discounted(discount)
    delta = failure_probability(size, epsilon, n_features)
    return Bound(
        "Theorem 1 (Theorem 3 of appendix B)",
        "LL(theta_E) - LL(theta) <= 2 K epsilon / (1 - gamma)",
        2 * n_features * epsilon / (1 - discount),
        max(0.0, 1 - delta),
        epsilon,
        (*EXPERT, FULL_VIEW, *PROGRAM_SOLVED),
    )


def lme_constraint_bound(
    size: float, draws: float, epsilon: float, epsilon_s: float, n_features: int
) -> Bound:
    """Bound by Lemma 2 (chapter 4), Lemma 6 (appendix B): constraint bounds for LME-I2RL.

    ``(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon + epsilon_s`` for all ``k`` with probability at least
    ``max(0, 1 - delta - delta_s)``, ``delta_s = 2 K exp(-2 n_s epsilon_s^2)``. That completed features obey
    Hoeffding's inequality with ``n_s`` draws is assumed, not proved: draws under other weights than the
    expert's are biased, and even the exact expectation given the observations is not the realised mean. With
    the exact completion under the expert's weights the completed mean is itself an average of independent
    values in [0, 1], so that ``epsilon`` and ``delta`` alone suffice.
    """
    delta = failure_probability(size, epsilon, n_features)
    delta_s = failure_probability(draws, epsilon_s, n_features)
    return Bound(
        "Lemma 2 (Lemma 6 of appendix B)",
        "(1 - gamma) |E[phi_k] - phi_hat_k| <= epsilon + epsilon_s",
        epsilon + epsilon_s,
        max(0.0, 1 - delta - delta_s),
        epsilon + epsilon_s,
        (FEATURES, INDEPENDENT, WHOLE, COMPLETION),
    )


def lme_i2rl_confidence(
    size: float, draws: float, epsilon: float, epsilon_s: float, n_features: int, discount: float
) -> Bound:
    """Bound by Theorem 2 (chapter 4), Theorem 4 (appendix B): confidence for LME-I2RL.

    ``LL(theta_E) - LL(theta^i) <= 4 K epsilon_l / (1 - gamma)``, ``epsilon_l = (epsilon + epsilon_s) / 2``,
    with probability at least ``max(0, 1 - delta - delta_s)``. The program's slack is ``2 epsilon_l``.

    See Also
    --------
    i2rl.analysis.me_i2rl_confidence : the same in full view
    i2rl.analysis.rimeo_confidence : the same with noise
    i2rl.analysis.check : decide its assumptions

    Examples
    --------
    >>> from i2rl.analysis import lme_i2rl_confidence
    >>> bound = lme_i2rl_confidence(400, 1000, 0.1, 0.05, n_features=2, discount=0.9)
    >>> round(bound.error, 2), round(bound.confidence, 2)
    (6.0, 0.97)
    """
    lemma = lme_constraint_bound(size, draws, epsilon, epsilon_s, n_features)
    return Bound(
        "Theorem 2 (Theorem 4 of appendix B)",
        "LL(theta_E) - LL(theta) <= 4 K epsilon_l / (1 - gamma)",
        2 * n_features * lemma.error / (1 - discounted(discount)),
        lemma.confidence,
        lemma.error,
        (*EXPERT, COMPLETION, *PROGRAM_SOLVED),
    )


class Regret(NamedTuple):
    """Theorem 5's bound on the average regret after each session.

    ``average [T]`` is ``2 K c / T sum_{i <= T} 1 / i`` nats, ``confidence [T]`` the probability with which
    the theorem says that it holds for all sessions up to ``T``, and ``bound`` the statement after the last
    session, with the confidence of the union bound, ``max(0, 1 - sum_i delta_i)``.
    """

    average: Float[np.ndarray, " T"]
    confidence: Float[np.ndarray, " T"]
    bound: Bound


def no_regret(
    c: float, session_sizes: Int[np.ndarray, " T"] | Sequence[int], n_features: int, discount: float
) -> Regret:
    """Bound by Theorem 3 (chapter 4), Theorem 5 (appendix B): average regret with ``epsilon_i / (1 - gamma) =
    c / i``.

    ``Regret_T <= 2 K c H_T / T`` with probability at least ``prod_i max(0, 1 - delta_i)``, ``delta_i = 2 K
    exp(-2 |X_{1:i}| epsilon_i^2)``. Three corrections: ``H_T = sum 1 / i`` exceeds the ``log T`` of the proof
    (by 0.577 in the limit); the product is that of independent events, which sessions that share their data
    are not, so that ``bound`` is quoted with ``1 - sum_i delta_i``; and with sessions of one size ``m``,
    ``|X_{1:i}| epsilon_i^2 = m c^2 (1 - gamma)^2 / i`` goes to zero, so ``delta_i`` goes to ``2 K`` and the
    confidence is 0 from some session on, for every ``c``. Sessions have to grow, see :func:`no_regret_sizes`.
    What survives is :func:`sure_gap`: the regret on the learner's own data is at most half of this bound
    surely.

    ``session_sizes [T]`` are the trajectories of each session.

    See Also
    --------
    i2rl.analysis.me_i2rl_confidence : the bound of one session
    i2rl.inference.average_regret : the regret of a run
    i2rl.inference.Harmonic : the slack it asks for

    Examples
    --------
    >>> from i2rl.analysis import no_regret
    >>> regret = no_regret(2.0, [100, 100, 100], n_features=2, discount=0.9)
    >>> regret.average.round(2).tolist()
    [8.0, 6.0, 4.89]
    >>> regret.confidence.round(2).tolist()
    [1.0, 0.93, 0.67]
    """
    positive("c", c), counted("n_features", n_features), discounted(discount)
    sizes = np.cumsum(counted_sessions(session_sizes))
    i = np.arange(1, len(sizes) + 1)
    epsilon = c * (1 - discount) / i
    delta = 2 * n_features * np.exp(-2 * sizes * epsilon**2)
    average = 2 * n_features * c * np.cumsum(1 / i) / i
    confidence = np.cumprod(np.maximum(0.0, 1 - delta))
    bound = Bound(
        "Theorem 3 (Theorem 5 of appendix B)",
        "average regret <= 2 K c H_T / T",
        float(average[-1]),
        max(0.0, 1 - float(delta.sum())),
        float(epsilon[-1]),
        (*EXPERT, FULL_VIEW, DIMINISHING, SOLVED),
        str(described(Harmonic(c))),
    )
    return Regret(average, confidence, bound)


def no_regret_sizes(c: float, sessions: int, delta: float, n_features: int, discount: float) -> np.ndarray:
    """Compute session sizes with which Theorem 5's confidence stays at least ``1 - delta``, integer ``[T]``.

    The failure probability is spent as ``delta_i = 6 delta / (pi i)^2``, so that ``|X_{1:i}| >=
    i^2 log(2 K / delta_i) / (2 c^2 (1 - gamma)^2)``: sessions grow about linearly.
    """
    positive("c", c), counted("sessions", sessions), counted("n_features", n_features)
    i = np.arange(1, sessions + 1)
    spent = 6 * probability("delta", delta) / (np.pi * i) ** 2
    total = np.ceil(np.log(2 * n_features / spent) * (i / (c * (1 - discounted(discount)))) ** 2 / 2)
    return np.diff(total, prepend=0).astype(int)


class Monotonicity(NamedTuple):
    """Rise of log-likelihoods from session to session, and the largest fall (nats per trajectory).

    ``premise`` is ``|Y_i| / |Y_{1:i-1}|`` at the last session, which the lemmas require to be small.
    """

    rises: bool
    largest_fall: float
    falls: np.ndarray
    premise: float


def monotonicity(
    log_likelihoods: Float[ArrayLike, " T"],
    session_sizes: Int[np.ndarray, " T"] | Sequence[int] | None = None,
) -> Monotonicity:
    """Measure Lemmas 1 and 3 (Lemma 5 of appendix B, Lemma 7 of appendix E): the likelihood rises with every
    session.

    The lemmas compare the fit to sessions ``1..i`` with the fit to ``1..i-1``: different data, whose
    likelihood may fall merely because the new trajectories are less predictable. The proofs show the limit
    (the change vanishes as the accumulated data outweigh a session's) and, within a session, that E- and
    M-steps never lower the likelihood. This function measures a run: ``falls`` are the sessions (from 1)
    whose log-likelihood is below the one before.
    """
    values = np.asarray(log_likelihoods, float)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"monotonicity is about at least two sessions, got shape {values.shape}")
    sizes = counted_sessions([1] * len(values) if session_sizes is None else session_sizes)
    if len(sizes) != len(values):
        raise ValueError(f"{len(values)} log-likelihoods, but {len(sizes)} session sizes")
    change = np.diff(values)
    return Monotonicity(
        bool((change >= 0).all()),
        float(max(0.0, -change.min())),
        np.flatnonzero(change < 0) + 2,
        float(sizes[-1] / sizes[:-1].sum()),
    )


# -- from the data themselves -------------------------------------------------------------------------


class ObservedBound(NamedTuple):
    """A bound computed from the features that were observed.

    ``target [K]`` and ``slack [K]`` are the maximum-entropy program's inputs with which ``bound`` holds for
    its solution. Both are in units of ``phi_hat``: the program takes ``slack`` divided by
    :func:`~i2rl.models.process.units.feature_scale`.
    """

    target: Float[np.ndarray, " K"]
    slack: Float[np.ndarray, " K"]
    bound: Bound


def observed_bound(
    features: Float[np.ndarray, "n K"],
    confidence: float,
    discount: float,
    weights: Float[np.ndarray, " K"] | None = None,
    *,
    predictable: bool = True,
) -> ObservedBound:
    """Compute a bound from the observed spread of each feature, usually tighter than Theorem 1's.

    The union bound over features of an empirical Bernstein interval each; features that vary little get
    little slack, and the error is the sum of what each contributes, ``2 sum_k slack_k |theta_E,k|``, by the
    argument of Theorem 1. Hidden steps: give the expected features of the completed trajectories; averages
    of independent values they still are if completed under one and the same policy, independent of them.

    Parameters
    ----------
    features : float ``[n, K]``
        Discounted features of each trajectory, ``sum_t gamma^t phi(s_t, a_t)``, in ``[0, 1 / (1 - gamma)]``.
    confidence : float
        Probability with which the bound is to hold.
    discount : float
    weights : float ``[K]``, optional
        The expert's, to replace the worst case ``|theta_E,k| <= 1``.
    predictable : bool
        The intervals of Waudby-Smith and Ramdas (2023); else those of Maurer and Pontil (2009).

    Raises
    ------
    ValueError
        For a confidence outside (0, 1), features out of range, or fewer than two trajectories.

    See Also
    --------
    i2rl.analysis.me_i2rl_confidence : the bound from sizes alone
    i2rl.analysis.demonstrations_needed : plan for it

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.analysis import observed_bound
    >>> features = np.tile([[4.0, 1.0], [4.5, 1.5]], (200, 1))
    >>> found = observed_bound(features, 0.95, 0.9)
    >>> found.target.round(1).tolist(), found.slack.round(1).tolist()
    ([4.3, 1.3], [0.2, 0.2])
    """
    x = np.asarray(features, float) * (1 - discounted(discount))
    if x.ndim != 2:
        raise ValueError(f"features must be [n, K], got shape {x.shape}")
    delta = (1 - probability("confidence", confidence)) / x.shape[1]
    interval: Interval = (predictable_bernstein if predictable else empirical_bernstein)(x, delta)
    slack = interval.half_width / (1 - discount)
    size = np.ones(x.shape[1]) if weights is None else np.abs(np.asarray(weights, float))
    if size.shape != slack.shape:
        raise ValueError(f"{x.shape[1]} features, but weights of shape {size.shape}")
    bound = Bound(
        "Theorem 1 with observed variances",
        "LL(theta_E) - LL(theta) <= 2 sum_k slack_k |theta_E,k|",
        float(2 * slack @ size),
        confidence,
        float(interval.half_width.max()),
        (*(EXPERT if weights is None else tuple(a for a in EXPERT if a is not WEIGHTS)), SOLVED),
    )
    return ObservedBound(interval.center / (1 - discount), slack, bound)


def observed_size(deviations: Float[np.ndarray, " K"], error: float, confidence: float) -> int:
    """Compute trajectories with which :func:`observed_bound` is about ``2 K error / (1 - gamma)`` nats.

    ``deviations [K]`` are the standard deviations of the features' discounted averages ``(1 - gamma) f_k``
    (:func:`~i2rl.models.process.planning.feature_deviations` times ``1 - gamma``, or a guess). A plan: the
    guarantee is the bound computed from the actual trajectories. Raises ``ValueError`` for a confidence
    outside (0, 1), an error that is not positive, or deviations outside [0, 1/2].
    """
    spread = np.atleast_1d(np.asarray(deviations, float))
    if spread.ndim != 1 or not ((spread >= 0) & (spread <= 0.5)).all():
        raise ValueError(f"deviations of averages in [0, 1] lie in [0, 0.5], got {spread}")
    delta = (1 - probability("confidence", confidence)) / len(spread)
    positive("error", error)
    values, counts = np.unique(spread, return_counts=True)
    share = counts / len(spread)
    return smallest(lambda n: share @ [predictable_half_width(x, n, delta) for x in values] <= error)


def demonstrations_needed(
    n_features: int,
    epsilon: float,
    confidence: float,
    discount: float = 0.99,
    *,
    epsilon_s: float = 0.05,
    deviations: Float[np.ndarray, " K"] | None = None,
) -> pd.DataFrame:
    """Compute how many trajectories are enough, by the theorem and by the tighter bounds.

    Every row is for the same log-likelihood error, Theorem 2's ``4 K epsilon_l / (1 - gamma)`` nats, with the
    same confidence; ``delta`` and ``delta_s`` share the rest equally. Rows differ in their means: ``theorem``
    draws hidden steps and uses the features' range; ``exact completion`` does not sample, so that
    ``epsilon_s`` and ``delta_s`` are spent on the trajectories; ``observed spread`` (a row for each of some
    standard deviations of the discounted averages ``(1 - gamma) f_k``, or one for the ``deviations [K]``
    given) uses the features' variance.

    Returns a table with columns ``trajectories``, ``draws`` (of the hidden steps, in all) and
    ``error_nats``. Raises ``ValueError`` for a confidence outside (0, 1), errors that are not positive, or
    deviations that are not ``[K]``.

    See Also
    --------
    i2rl.analysis.lme_i2rl_confidence : the theorem's own direction
    i2rl.analysis.perception_needed : the same with noise

    Examples
    --------
    >>> from i2rl.analysis import demonstrations_needed
    >>> table = demonstrations_needed(2, 0.05, 0.9, 0.9)
    >>> table.loc[["theorem", "exact completion"], "trajectories"].tolist()
    [877, 185]
    """
    counted("n_features", n_features), positive("epsilon_s", epsilon_s), positive("epsilon", epsilon)
    delta = (1 - probability("confidence", confidence)) / 2
    total = epsilon + epsilon_s
    rows: list[tuple[str, int, int]] = [
        (
            "theorem",
            math.ceil(size_for(epsilon, delta, n_features)),
            math.ceil(size_for(epsilon_s, delta, n_features)),
        ),
        ("exact completion", math.ceil(size_for(total, 2 * delta, n_features)), 0),
    ]
    if deviations is None:
        for spread in (0.05, 0.1, 0.2):
            size = observed_size(np.full(n_features, spread), total, confidence)
            rows.append((f"observed spread {spread}", size, 0))
    else:
        if np.shape(deviations) != (n_features,):
            raise ValueError(f"{n_features} features, but deviations of shape {np.shape(deviations)}")
        rows.append(("observed spread", observed_size(deviations, total, confidence), 0))
    table = pd.DataFrame(rows, columns=["bound", "trajectories", "draws"]).set_index("bound")
    table["error_nats"] = 2 * n_features * total / (1 - discounted(discount))
    return table


# -- Table 7.1 ----------------------------------------------------------------------------------------


def table_7_1a(n_features: int = 6, delta: float = 0.1, discount: float = 0.99) -> pd.DataFrame:
    """Tabulate Table 7.1(a): trajectories for an error, with confidence ``1 - (delta + delta_s)``, both
    ``delta``.

    Indexed by ``epsilon_l``. ``trajectories`` is the nearest integer, as printed, ``sufficient`` the smallest
    number that keeps the promise. ``draws`` and ``error_nats`` are absent from the caption: the samples that
    ``epsilon_s`` needs, and the log-likelihood error that is bought, ``4 K epsilon_l / (1 - gamma)``.
    """
    rows = []
    for epsilon, epsilon_s in ((0.2, 0.05), (0.1, 0.05), (0.05, 0.05), (0.04, 0.05)):
        size, draws = size_for(epsilon, delta, n_features), size_for(epsilon_s, delta, n_features)
        rows.append(
            {
                "epsilon_l": round((epsilon + epsilon_s) / 2, 12),
                "epsilon": epsilon,
                "epsilon_s": epsilon_s,
                "trajectories": round(size),
                "sufficient": math.ceil(size),
                "draws": math.ceil(draws),
                "error_nats": 2 * n_features * (epsilon + epsilon_s) / (1 - discounted(discount)),
            }
        )
    table = pd.DataFrame(rows).set_index("epsilon_l")
    table.attrs = {"title": "Table 7.1(a)", "K": n_features, "delta": delta, "gamma": discount}
    return table


def table_7_1b(n_features: int = 6, epsilon: float = 0.1, delta_s: float = 0.1) -> pd.DataFrame:
    """Tabulate Table 7.1(b): confidence by number of trajectories, as printed and with ``delta_s`` counted.

    The printed column is ``max(0, 1 - delta)``, Theorem 1's; the caption's ``1 - delta_l`` has ``delta_s``
    in it as well.
    """
    sizes = (115, 135, 200, 375)
    deltas = [failure_probability(n, epsilon, n_features) for n in sizes]
    table = pd.DataFrame(
        {
            "as_printed": [max(0.0, 1 - d) for d in deltas],
            "with_delta_s": [max(0.0, 1 - d - probability("delta_s", delta_s)) for d in deltas],
        },
        index=pd.Index(sizes, name="trajectories"),
    )
    table.attrs = {"title": "Table 7.1(b)", "K": n_features, "epsilon": epsilon, "delta_s": delta_s}
    return table


# -- border -------------------------------------------------------------------------------------------
