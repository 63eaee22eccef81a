"""Assumptions of a bound, checked where possible.

The theorems ask for weights and features in [0, 1], a soft expert, whole independent trajectories, and an
M-step that met its threshold. A :class:`Bound` carries these premises with it; :func:`check` decides those
that an MDP, weights and a run settle; the user is responsible for the rest (:meth:`Bound.assuming`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...inference.sessions.learner import Learner
from ...models.process.mdp import TabularMDP
from ...models.process.planning import feature_expectations, reward_of, soft_plan
from ...models.process.units import feature_scale

# A trajectory is whole if what discounting leaves beyond its end is this share of epsilon at most.
_NEGLIGIBLE = 0.1


class Assumption(NamedTuple):
    """A premise of a theorem: whether it holds (None: undecided), and why."""

    name: str
    statement: str
    holds: bool | None = None
    reason: str = ""


class BoundNotGuaranteed(ValueError):
    """A bound was to be quoted as a guarantee although one of its assumptions does not hold."""


class Bound(NamedTuple):
    """Promise of a theorem.

    Fields
    ------
    source, statement : str
        The theorem's numbers, and the bounded quantity.
    error : float
        The bound: nats per trajectory, or units of ``(1 - gamma) E[phi]`` for a lemma on constraints.
    confidence : float
        The probability with which it holds, ``max(0, 1 - delta)``.
    epsilon : float
        The relaxation of the program that the theorem is about (``slack`` of a learner), in the last session
        where it changes.
    assumptions : tuple of Assumption
    schedule : str
        How the relaxation changes from session to session, as a learner's configuration describes it; empty
        where it does not.
    """

    source: str
    statement: str
    error: float
    confidence: float
    epsilon: float
    assumptions: tuple[Assumption, ...]
    schedule: str = ""

    @property
    def violated(self) -> tuple[Assumption, ...]:
        """Assumptions known not to hold."""
        return tuple(a for a in self.assumptions if a.holds is False)

    @property
    def undecided(self) -> tuple[Assumption, ...]:
        """Assumptions still open."""
        return tuple(a for a in self.assumptions if a.holds is None)

    def assuming(self, **decided: bool) -> Bound:
        """Return the bound with assumptions stated by name, which the user knows and no simulation can show.

        Raises ``ValueError`` for a name that is not one of its assumptions, and for one that was found not
        to hold.
        """
        known = {a.name: a for a in self.assumptions}
        for name, holds in decided.items():
            if name not in known:
                raise ValueError(
                    f"{self.source} has no assumption {name!r}; its assumptions are {', '.join(known)}"
                )
            found = known[name]
            if holds and found.holds is False:
                raise ValueError(f"it cannot be assumed that {found.statement}: {found.reason or 'it fails'}")
        return self._replace(
            assumptions=tuple(
                a._replace(holds=decided[a.name], reason=a.reason or "as stated by the user")
                if a.name in decided
                else a
                for a in self.assumptions
            )
        )

    def guarantee(self) -> str:
        """Write the bound in a sentence, with the assumptions that it still takes on trust.

        Raises :class:`BoundNotGuaranteed` if an assumption does not hold or the confidence is zero.
        """
        if self.violated:
            reasons = "; ".join(f"{a.statement} ({a.reason or 'stated not to hold'})" for a in self.violated)
            raise BoundNotGuaranteed(f"{self.source} gives no guarantee here. It needs: {reasons}")
        if self.confidence <= 0:
            raise BoundNotGuaranteed(f"{self.source} gives no guarantee here: its confidence is 0")
        sentence = f"{self.statement} = {self.error:.4g} with probability at least {self.confidence:.4g}"
        if self.undecided:
            sentence += ", provided that " + "; ".join(a.statement for a in self.undecided)
        return f"{sentence} ({self.source})."


FEATURES = Assumption("features", "features lie in [0, 1]")
WEIGHTS = Assumption("weights", "the expert's weights lie in [0, 1]^K")
SOFT_EXPERT = Assumption("soft_expert", "the expert acts by the soft policy of its weights")
INDEPENDENT = Assumption("independent", "trajectories are independent and equally distributed")
WHOLE = Assumption("whole", "trajectories are so long that their discounted rest is negligible")
PROGRAM = Assumption("program", "the features statistic is kept, with slack epsilon")
DIMINISHING = Assumption(
    "program", "the features statistic is kept, with slack c / i in session i (Harmonic)"
)
SOLVED = Assumption("solved", "the maximum-entropy program was solved within its slack")
COMPLETION = Assumption(
    "completion",
    "completed features are within epsilon_s of the fully observed ones as often as sampled "
    "means are (Hoeffding, n_s draws)",
)
OBSERVATION = Assumption(
    "observation",
    "the estimated observation model is within epsilon_o of the true one as often as a mean of n_o values is",
)
PREDICATES_SEEN = Assumption("predicates_seen", "every predicate is observed in the first session")
INDEPENDENT_PREDICATES = Assumption(
    "independent_predicates",
    "every predicate is observed independently, with one probability at every pair and step",
)
KNOWN_TRUTHS = Assumption(
    "known_truths", "reliabilities were counted on n_o independent observations of known truth"
)
OTHER_REPORTS = Assumption(
    "other_reports", "reliabilities were counted on other observations than those of the trajectories"
)
EXPERTS_POSTERIOR = Assumption(
    "experts_posterior", "hidden pairs are filled in under weights as good as the expert's"
)
FULL_VIEW = Assumption("full_view", "every step is seen")

EXPERT = (FEATURES, WEIGHTS, SOFT_EXPERT, INDEPENDENT, WHOLE)
PROGRAM_SOLVED = (PROGRAM, SOLVED)


def check(
    bound: Bound,
    *,
    mdp: TabularMDP | None = None,
    weights: Float[np.ndarray, " K"] | None = None,
    expert: Float[np.ndarray, "S A"] | None = None,
    length: int | None = None,
    learner: Learner | None = None,
    state: Any = None,
) -> Bound:
    """Check the assumptions that the arguments settle; the others stay open.

    Parameters
    ----------
    bound : Bound
    mdp : TabularMDP
        Settles whether features lie in [0, 1]. Taken from ``learner`` if that is given.
    weights : float ``[K]``
        The expert's: whether they lie in [0, 1].
    expert : float ``[S, A]``
        The expert's policy: whether it is the soft policy of ``weights``. Needs both.
    length : int
        Steps of a trajectory: whether what lies beyond them is negligible against ``epsilon``.
    learner, state
        Settle whether the program is the theorem's, and was solved within its slack in the state's session (a
        bound on regret needs it in every session).

    Raises
    ------
    ValueError
        For weights or a policy of another shape than the MDP's, a state without its learner, or a learner
        of another MDP.

    See Also
    --------
    i2rl.analysis.lme_i2rl_confidence : a bound to check
    i2rl.analysis.observed_bound : another

    Examples
    --------
    >>> from i2rl.analysis import check, me_i2rl_confidence
    >>> from i2rl.domains import five_cells
    >>> corridor = five_cells()
    >>> bound = me_i2rl_confidence(400, 0.1, corridor.mdp.n_features, 0.9)
    >>> checked = check(bound, mdp=corridor.mdp, weights=corridor.weights, length=50)
    >>> [(a.name, a.reason) for a in checked.violated]
    [('weights', 'they range from -0.2 to 2')]
    """
    if learner is None and state is not None:
        raise ValueError("a state is checked against its learner: give both")
    if learner is not None and mdp is not None and learner.mdp.fingerprint() != mdp.fingerprint():
        raise ValueError(f"{learner.name} learns on another MDP than the one given")
    mdp = learner.mdp if mdp is None and learner is not None else mdp
    found: dict[str, tuple[bool, str]] = {}
    if mdp is not None:
        found["features"] = _features_in_range(mdp)
    if weights is not None:
        weights = np.asarray(weights, float)
        if mdp is not None and weights.shape != (mdp.n_features,):
            raise ValueError(f"the MDP has {mdp.n_features} features, but weights have shape {weights.shape}")
        inside = bool((weights >= 0).all() and (weights <= 1).all())
        found["weights"] = inside, f"they range from {weights.min():.4g} to {weights.max():.4g}"
    if expert is not None:
        if mdp is None or weights is None:
            raise ValueError("`expert` also needs `weights` and the MDP, to test whether it is soft")
        found["soft_expert"] = _soft(mdp, weights, np.asarray(expert, float))
    if length is not None:
        if mdp is None:
            raise ValueError("whether a trajectory is whole depends on the discount: give the MDP")
        beyond = float(mdp.discount) ** length
        found["whole"] = (
            beyond <= _NEGLIGIBLE * bound.epsilon,
            f"{100 * beyond:.3g} % of the discounted sum lie beyond {length} steps, "
            f"epsilon is {bound.epsilon:.3g}",
        )
    if learner is not None:
        found["program"] = _theorems_program(learner, bound)
        if state is not None:
            found["solved"] = _solved(learner, state, bound)
    return bound._replace(
        assumptions=tuple(
            a._replace(holds=found[a.name][0], reason=found[a.name][1]) if a.name in found else a
            for a in bound.assumptions
        )
    )


def _features_in_range(mdp: TabularMDP) -> tuple[bool, str]:
    values = np.asarray(mdp.features)[np.asarray(mdp.available)]
    low, high = float(values.min()), float(values.max())
    return low >= 0 and high <= 1, f"they range from {low:.4g} to {high:.4g}"


def _soft(mdp: TabularMDP, weights: np.ndarray, expert: np.ndarray) -> tuple[bool, str]:
    policy = np.asarray(soft_plan(mdp, reward_of(mdp, jnp.asarray(weights))).policy)
    if expert.shape != policy.shape:
        raise ValueError(f"a policy of this MDP has shape {policy.shape}, got {expert.shape}")
    difference = float(np.abs(policy - expert).max())
    return (
        difference <= 1e-6,
        f"its action probabilities differ from the soft policy's by up to {difference:.3g}",
    )


def _theorems_program(learner: Learner, bound: Bound) -> tuple[bool, str]:
    statistic = learner.configuration.get("statistic")
    if statistic != "features":
        return False, f"{learner.name} keeps the {statistic!r} statistic"
    slack, epsilon = learner.configuration.get("slack"), bound.epsilon
    if bound.schedule:
        return slack == bound.schedule, f"its slack is {slack}, the theorem's {bound.schedule}"
    if not isinstance(slack, int | float):
        return False, f"{learner.name} has the slack {slack}, not {epsilon:.4g} in every session"
    return bool(np.isclose(slack, epsilon, rtol=1e-6)), f"its slack is {slack:.4g}, epsilon is {epsilon:.4g}"


def _solved(learner: Learner, state: Any, bound: Bound) -> tuple[bool, str]:
    """Test whether the weights are feasible, and optimal up to a thousandth of the bound."""
    if learner.configuration.get("statistic") != "features":
        return False, "another program was solved"
    mdp, weights, scale = learner.mdp, state.weights, feature_scale(learner.mdp)
    policy = soft_plan(mdp, reward_of(mdp, weights)).policy
    # The program's constraints are on scaled features.
    miss = (feature_expectations(mdp, policy, state.statistic.start) - state.statistic.features) / scale
    weights = weights * scale
    unit = 1 - float(mdp.discount)
    gap = unit * float(jnp.max(jnp.abs(miss)))
    # Complementary slackness: zero at the program's solution, and what else it could gain elsewhere.
    excess = float(weights @ miss + bound.epsilon / unit * jnp.sum(jnp.abs(weights)))
    return (
        gap <= bound.epsilon * (1 + 1e-3) and abs(excess) <= 1e-3 * bound.error,
        f"its constraints are met within {gap:.4g}, its duality gap is {excess:.2g} nats",
    )
