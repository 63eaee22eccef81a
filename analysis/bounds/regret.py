"""Average regret of an online learner (Definition 8) with constant and with diminishing thresholds.

A session's loss of log-likelihood has two forms, both in nats per trajectory:

empirical
    ``LL(theta_E | X_{1:i}) - LL(theta^i | X_{1:i})`` on the learner's own statistic, chapter 4's. The learner
    fits that data, so this is usually negative; if its program is convex and solved (the ``features``
    statistic of whole, fully observed trajectories) it is surely at most ``sum_k beta_k |theta_E,k|``, with
    no probability involved.
expected
    The same difference under the expert's own law: the excess risk of ``theta^i``. By Gibbs' inequality it is
    at least zero, and it is the regret proper: the cost of the learner's estimate on fresh data. It equals
    ``sum_s d(s) KL(pi_E(.|s) || pi_theta(.|s))``, with ``d`` the expert's visits: discounted ones for
    ``features``, those of one trajectory for ``counts``, and of them those in view for ``seen``.

Theorem 5 (Theorem 3 of chapter 4) is about the expected form: it promises ``O(log T) / T`` for thresholds
``epsilon_i / (1 - gamma) = c / i`` with probability ``prod_i max(0, 1 - delta_i)``. With a fixed number of
trajectories a session that probability is 0 from some session on, see :func:`last_confident_session`; only
the sure bound of the empirical form is unconditional. This module measures the regret itself, not its bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ...inference.sessions.fleets import run_streams
from ...inference.sessions.learner import Learner, SessionInfo
from ...inference.sessions.running import average_regret
from ...inference.sessions.statistic import STATISTICS
from ...models.inputs.text import counted
from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.planning import reward_of, soft_plan
from ..drawing.style import LIGHT, TEXT, Theme, dress, foot, head, method_styles, new_figure
from ..judging.metrics import quantile_band

# -- what the expert does -----------------------------------------------------------------------------


def expected_visits(
    mdp: TabularMDP, policy: Float[Array, "S A"], length: int, windows: int = 1
) -> Float[Array, "S A"]:
    """Compute the expected visits of one trajectory: the mean over ``windows`` consecutive ones of ``length``
    steps.

    The first begins in the initial distribution and every other where the one before ended, as fragments of
    one long walk do; ``windows = 1`` is for trajectories that all start anew. Raises ``ValueError`` for
    numbers below 1.
    """
    if length < 1 or windows < 1:
        raise ValueError(f"visits need at least one step and one window, got {length} and {windows}")

    def step(carry: tuple, _: None) -> tuple:
        state, total = carry
        pairs = state[:, None] * policy
        return (mdp.push_forward(pairs), total + pairs), None

    nothing = jnp.zeros((mdp.n_states, mdp.n_actions))
    (_, total), _ = lax.scan(step, (mdp.initial, nothing), None, length * windows)
    return total / windows


@jax.jit
def excess_risk(
    mdp: TabularMDP,
    policy: Float[Array, "S A"],
    visits: Float[Array, "S A"],
    weights: Float[Array, " K"],
) -> Float[Array, ""]:
    """Compute ``sum_s d(s) KL(pi(.|s) || pi_theta(.|s))``: nats per trajectory lost by ``weights``.

    ``policy`` is the expert's (any policy; zero risk is within reach only if some weights have it as their
    soft policy), ``visits [S, A]`` its expected visits. With the discounted occupancy and the soft policy
    of ``theta_E`` this is ``(theta_E - theta) . mu_E - p0 . (V_thetaE - V_theta)``.
    """
    learned = soft_plan(mdp, reward_of(mdp, weights)).log_policy
    log_ratio = jnp.where(policy > 0, jnp.log(jnp.where(policy > 0, policy, 1.0)) - learned, 0.0)
    return jnp.sum(visits.sum(1, keepdims=True) * policy * jnp.where(policy > 0, log_ratio, 0.0))


# -- following a learner ------------------------------------------------------------------------------


class Gaps(NamedTuple):
    """Log-likelihood given away in every session, nats per trajectory.

    Fields
    ------
    empirical : float ``[R, T]``
        On the learner's own statistic; negative where the learner fits it better than the true weights do.
    expected : float ``[R, T]``
        Under the expert's law: the excess risk, never negative.
    weights : float ``[R, T, K]``
    """

    empirical: Float[np.ndarray, "R T"]
    expected: Float[np.ndarray, "R T"]
    weights: Float[np.ndarray, "R T K"]

    @property
    def regret(self) -> Float[np.ndarray, "R T"]:
        """Expected average regret after each session."""
        return running_mean(self.expected)

    @property
    def empirical_regret(self) -> Float[np.ndarray, "R T"]:
        """Chapter 4's average regret after each session."""
        return running_mean(self.empirical)


def regret_gaps(
    learner: Learner,
    key: Array,
    demonstrations: Demonstration,
    expert_weights: Float[Array, " K"],
    expert_policy: Float[Array, "S A"],
    visits: Float[Array, "S A"],
) -> Gaps:
    """Run a learner over streams (demonstrations of arrays ``[R, T, n, L]``) and compare it with the expert.

    ``expert_weights`` are those of the empirical form; ``visits`` are the expert's per trajectory in the
    learner's own terms (module docstring). Raises ``ValueError`` as :func:`.run_streams` does.
    """
    mdp = learner.mdp
    statistic = STATISTICS[learner.configuration["statistic"]]
    expert_weights = jnp.asarray(expert_weights, float)
    expert_values = soft_plan(mdp, reward_of(mdp, expert_weights)).values

    def gaps(state: Any, report: SessionInfo) -> tuple:
        expert = statistic.log_likelihood(mdp, expert_weights, expert_values, state.statistic)
        risk = excess_risk(mdp, expert_policy, visits, state.weights)
        return expert - report.log_likelihood, risk, state.weights

    _, kept = run_streams(learner, key, demonstrations, gaps)
    return Gaps(*(np.asarray(x) for x in kept))


def running_mean(gaps: Float[np.ndarray, "... T"]) -> Float[np.ndarray, "... T"]:
    """Average regret after each session, of the gaps of each session."""
    return average_regret(gaps, np.zeros_like(gaps))


# -- how fast it vanishes -----------------------------------------------------------------------------


class Slope(NamedTuple):
    """Least-squares line of ``log regret`` on ``log T``: ``regret ~ exp(intercept) T^slope``."""

    slope: float
    intercept: float
    burn_in: int


def log_log_slope(regret: Float[np.ndarray, " T"], burn_in: int = 10) -> Slope:
    """Compute the slope of an average regret on log-log axes, over every ``T >= burn_in``.

    Every session counts once, so late sessions, dense on a logarithmic axis, decide. Raises ``ValueError``
    for fewer than two sessions after the burn-in, or for a regret that is not positive there.
    """
    regret = np.asarray(regret, float)
    if burn_in < 1 or regret.ndim != 1 or len(regret) < burn_in + 1:
        raise ValueError(
            f"a slope needs two sessions from session {burn_in} on, got regrets of shape {regret.shape}"
        )
    tail = regret[burn_in - 1 :]
    if not np.all(tail > 0):
        i = int(np.flatnonzero(~(tail > 0))[0])
        raise ValueError(
            f"the average regret after session {burn_in + i} is {tail[i]:.3g}: only a positive one has a "
            "logarithm (take the expected form, not the empirical one)"
        )
    sessions = np.arange(burn_in, len(regret) + 1)
    slope, intercept = np.polyfit(np.log(sessions), np.log(tail), 1)
    return Slope(float(slope), float(intercept), burn_in)


def sure_bound(beta: Float[np.ndarray, " T"], expert_weights: Float[np.ndarray, " K"]) -> np.ndarray:
    """Compute ``1/T sum_{i <= T} beta_i |theta_E|_1 [T]``: the bound of the empirical average regret.

    For programs solved to their optimum on a statistic that is the data's (module docstring).
    """
    return running_mean(np.asarray(beta, float) * np.abs(np.asarray(expert_weights)).sum())


def last_confident_session(c: float, session_size: int, n_features: int, discount: float) -> int:
    """Find the last session of Theorem 5 with ``delta_i < 1``, for ``session_size`` trajectories in every
    session.

    ``delta_i = 2 K exp(-2 m i (c (1 - gamma) / i)^2)`` grows with ``i`` towards ``2 K > 1`` and passes 1 at
    ``i = 2 m c^2 (1 - gamma)^2 / log 2K``. From the next session on the theorem's confidence, a product
    that has a factor 0, is 0. Returns 0 where not even the first session has a positive factor.
    """
    limit = 2 * session_size * (c * (1 - discount)) ** 2 / math.log(2 * n_features)
    return max(0, math.ceil(limit) - 1)


# -- the figure ---------------------------------------------------------------------------------------


class RegretCurve(NamedTuple):
    """One threshold's replications: expected and empirical average regret ``[R, T]``, and its name."""

    name: str
    expected: Float[np.ndarray, "R T"]
    empirical: Float[np.ndarray, "R T"]


class BoundCurve(NamedTuple):
    """A bound on the average regret ``[T]``, and its name."""

    name: str
    average: Float[np.ndarray, " T"]


def regret_plot(
    curves: Sequence[RegretCurve],
    *,
    theorem: BoundCurve | None = None,
    sure: Mapping[str, Float[np.ndarray, " T"]] | None = None,
    burn_in: int = 10,
    coverage: float = 0.8,
    theme: Theme = LIGHT,
    title: str = "",
) -> Figure:
    """Average regret against sessions: expected, on log-log axes with fitted slopes, and empirical.

    Lines are medians over replications, bands hold ``coverage`` of them; the slope is that of the mean over
    replications. ``theorem`` is drawn with the expected form, ``sure`` bounds, by the name of their curve,
    with the other. Raises ``ValueError`` for curves of different lengths.
    """
    bounds = {} if sure is None else sure
    lengths = {np.shape(c.expected)[-1] for c in curves} | {len(bound) for bound in bounds.values()}
    if len(lengths) != 1:
        raise ValueError(f"the curves must have one number of sessions, got {sorted(lengths)}")
    figure = new_figure(theme, 10.4, 4.6)
    figure.get_layout_engine().set(wspace=0.06)  # type: ignore[union-attr, call-arg]
    left, right = figure.subplots(1, 2)
    handles: list[Line2D] = []
    surely: list[Line2D] = []
    sessions = np.arange(1, lengths.pop() + 1)
    styles = method_styles(theme, [curve.name for curve in curves])
    for curve in curves:
        slope = log_log_slope(np.mean(curve.expected, axis=0), burn_in)
        color, dashes = styles[curve.name]["color"], styles[curve.name]["linestyle"]
        for axes, values in ((left, curve.expected), (right, curve.empirical)):
            band = quantile_band(values, coverage)
            axes.fill_between(sessions, band.low, band.high, color=color, alpha=0.18, linewidth=0)
            axes.plot(sessions, band.median, color=color, linestyle=dashes, linewidth=1.9)
        if curve.name in bounds:
            dotted: dict[str, Any] = {"color": color, "linewidth": 1.3, "linestyle": (0, (1, 1.6))}
            right.plot(sessions, bounds[curve.name], **dotted)
            surely.append(Line2D([], [], label=f"sure bound, {curve.name}", **dotted))
        label = f"{curve.name}, slope {slope.slope:.2f}"
        handles.append(Line2D([], [], color=color, linestyle=dashes, linewidth=1.9, label=label))
    if theorem is not None:
        style: dict[str, Any] = {"color": theme.muted, "linewidth": 1.4, "linestyle": (0, (1, 1.6))}
        left.plot(sessions, theorem.average, **style)
        handles.append(Line2D([], [], label=theorem.name, **style))
    left.set_xscale("log")
    left.set_yscale("log")
    right.set_xscale("log")
    right.axhline(0.0, color=theme.ink, linewidth=0.8)
    _label(left, theme, "Expected: excess risk, never negative")
    _label(right, theme, "Empirical: on the learner's own data")
    head(figure, theme, handles + surely, title=title, columns=3)
    replications = np.shape(curves[0].expected)[0]
    foot(
        figure,
        theme,
        f"lines: medians of {counted(replications, 'stream')}; bands: central {coverage:.0%}; "
        f"slopes: least squares of the mean over every T from {burn_in} on",
    )
    return figure


def _label(axes: Axes, theme: Theme, title: str) -> None:
    dress(axes, theme, title=title, x="sessions T", y="average regret (nats per trajectory)")
    axes.title.set_fontsize(TEXT)
    axes.xaxis.set_major_formatter(_plain)


def _plain(x: float, _: Any) -> str:
    return f"{x:g}"
