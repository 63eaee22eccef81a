"""The declared mixture model of a demonstration with several reward functions (Bayesian chapter 5).

A Dirichlet process over reward weights by truncated stick-breaking (Ishwaran and James 2001). The component
of each trajectory and its hidden steps are both summed out. The result is a density for any NumPyro
inference, and partly hidden trajectories are assigned together with the others.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpyro.distributions import constraints
from numpyro.distributions.util import validate_sample

from ..inputs.arguments import as_key
from ..inputs.display import shown_briefly
from ..observation.demonstration import PAD, SEEN, UNKNOWN
from ..observation.evidence import (
    AnySensor,
    checked_codes,
    fitting_sensor,
    observe,
    safe_log,
    step_log_evidence,
)
from ..process.mdp import TabularMDP
from ..process.planning import reward_of, simulate, soft_plan
from .chain import filter_all
from .occlusion import scaled_prior
from .trajectory import CodesConstraint

COMPONENTS = 10


@shown_briefly
class Perceived(NamedTuple):
    """Trajectories prepared for many evaluations of a mixture: quantities without weights are computed once.

    ``m`` fully seen trajectories, whose log-likelihood is ``counts . log_policy + dynamics``, then ``h``
    others, which take a forward pass. ``repeats`` counts each trajectory's observations (0 for spare rows).

    Fields
    ------
    counts : float ``[m, S, A]``
    dynamics : float ``[m]``
        Log-probability of the states and of seeing them, given the actions.
    log_evidence : float ``[h, L, S, A]``
    live : bool ``[h, L]``
    repeats : int ``[m + h]``
    """

    counts: Float[Array, "m S A"]
    dynamics: Float[Array, " m"]
    log_evidence: Float[Array, "h L S A"]
    live: Bool[Array, "h L"]
    repeats: Int[Array, " u"]


def as_evidence(mdp: TabularMDP, sensor: AnySensor, codes: Int[Array, "n L 3"]) -> Perceived:
    """Prepare every trajectory for a forward pass; traceable."""
    shape = (mdp.n_states, mdp.n_actions)

    def step(code: Int[Array, " 3"]) -> Float[Array, "S A"]:
        return step_log_evidence(sensor, *shape, code[0], code[1], code[2], jnp.array(jnp.nan))

    evidence = jax.vmap(jax.vmap(step))(codes)
    return Perceived(
        jnp.zeros((0, *shape)), jnp.zeros(0), evidence, codes[..., 0] != PAD, jnp.ones(len(codes), int)
    )


_as_evidence = jax.jit(as_evidence)


def perceive(
    mdp: TabularMDP, sensor: AnySensor, codes: Int[np.ndarray, "n L 3"]
) -> tuple[Perceived, Int[np.ndarray, " n"]]:
    """Gather identical trajectories and separate fully seen ones; also return each trajectory's row.

    Both parts are padded to a multiple of eight, so that growing demonstrations have few shapes. Not
    traceable.
    """
    sensor, codes = fitting_sensor(sensor, mdp), np.asarray(checked_codes(mdp, codes))
    distinct, row, repeats = np.unique(
        codes.reshape(len(codes), -1), axis=0, return_inverse=True, return_counts=True
    )
    distinct = distinct.reshape(-1, *codes.shape[1:])
    kind, state, action = np.moveaxis(distinct, -1, 0)
    clear = ((kind == PAD) | ((kind == SEEN) & (state != UNKNOWN) & (action != UNKNOWN))).all(axis=1)
    if sensor.noise is not None:
        clear[:] = False
    blank = np.broadcast_to(np.array([PAD, UNKNOWN, UNKNOWN]), (1, *codes.shape[1:]))
    parts, places, numbers, start = [], np.zeros(len(distinct), int), [], 0
    for members in (np.flatnonzero(clear), np.flatnonzero(~clear)):
        spare = -len(members) % 8
        parts.append(np.concatenate([distinct[members], np.repeat(blank, spare, axis=0)]))
        numbers.append(np.concatenate([repeats[members], np.zeros(spare, int)]))
        places[members] = start + np.arange(len(members))
        start += len(parts[-1])
    seen, others = (_as_evidence(mdp, sensor, jnp.asarray(part, jnp.int32)) for part in parts)
    counts = np.zeros((len(parts[0]), mdp.n_states, mdp.n_actions))
    number, step = np.nonzero(parts[0][..., 0] == SEEN)
    np.add.at(counts, (number, parts[0][number, step, 1], parts[0][number, step, 2]), 1.0)
    indifferent = jnp.where(mdp.available, 0.0, -jnp.inf)
    return (
        Perceived(
            jnp.asarray(counts),
            _dynamics(mdp, indifferent + seen.log_evidence, seen.live),
            others.log_evidence,
            others.live,
            jnp.asarray(np.concatenate(numbers)),
        ),
        places[row.ravel()],
    )


def _passes(
    mdp: TabularMDP, factors: Float[Array, "h L S A"], live: Bool[Array, "h L"]
) -> Float[Array, " h"]:
    return filter_all(mdp, factors, live).log_likelihood if len(live) else jnp.zeros(0)


_dynamics = jax.jit(_passes)


def trajectory_log_likelihoods(
    mdp: TabularMDP, log_policy: Float[Array, "S A"], perceived: Perceived
) -> Float[Array, " u"]:
    """Return the log-likelihood of each trajectory under one policy, hidden steps summed out."""
    return component_log_likelihoods(mdp, log_policy[None], perceived)[0]


def soft_policies(mdp: TabularMDP, weights: Float[Array, "T K"]) -> Float[Array, "T S A"]:
    """Return the log-policy of the soft plan of each row of weights."""
    return lax.map(lambda w: soft_plan(mdp, reward_of(mdp, w)).log_policy, weights)


def component_log_likelihoods(
    mdp: TabularMDP, log_policies: Float[Array, "T S A"], perceived: Perceived
) -> Float[Array, "T u"]:
    """Return the log-likelihood of each trajectory under each policy."""
    # An unavailable action has log-probability -inf; times zero visits it would be NaN.
    finite = jnp.where(mdp.available, log_policies, 0.0)
    seen = jnp.einsum("msa,tsa->tm", perceived.counts, finite) + perceived.dynamics
    # All passes of all policies in one call: a map over policies would add passes in logarithms.
    factors = perceived.log_evidence + log_policies[:, None, None]
    live = jnp.tile(perceived.live, (len(factors), 1))
    passed = _passes(mdp, factors.reshape(-1, *factors.shape[2:]), live)
    return jnp.concatenate([seen, passed.reshape(seen.shape[0], -1)], axis=1)


def stick_proportions(sticks: Float[Array, " T-1"]) -> Float[Array, " T"]:
    r"""Return mixture proportions :math:`\pi_d = v_d \prod_{j<d} (1 - v_j)`; the last takes the rest."""
    ones = jnp.ones(1)
    return jnp.concatenate([sticks, ones]) * jnp.concatenate([ones, jnp.cumprod(1 - sticks)])


def truncation_error(n_trajectories: int, components: int, concentration: float) -> float:
    r"""Bound the effect of truncation on a demonstration's law, :math:`4 n (\alpha/(1+\alpha))^{T-1}`.

    The effect is the integral of the absolute difference of densities, hence at most 2. Ishwaran and James
    (2001, Theorem 2) give :math:`4 (1 - E(1 - R)^n)` with ``R`` the rest after ``T - 1`` breaks; Bernoulli's
    inequality gives the bound. Their closing :math:`4 n e^{-(T-1)/\alpha}` replaces ``E R`` by the smaller
    ``exp(E log R)`` and fails as a bound for small ``alpha``.
    """
    return min(2.0, 4.0 * n_trajectories * (concentration / (1 + concentration)) ** (components - 1))


class MixtureLaw(dist.Distribution):
    """Law of the observations of ``length`` steps of an expert with one of several reward functions.

    A mixture of :class:`TrajectoryLaw`, one for each row of weights, with the same values. ``log_prob`` sums
    out the component and the hidden steps exactly; ``sample`` draws a component, simulates, and observes.

    Parameters
    ----------
    mdp : TabularMDP
    proportions : float ``[..., T]``
        Probability of each component; leading dimensions are the batch.
    weights : float ``[T, K]``
        Reward weights of each component.
    sensor : Sensor
    length : int
        Steps of an event, ``L``.

    Raises ``ValueError`` for discount 1, for a sensor made for another MDP, for another number of proportions
    than of weights, and for values of another length.
    """

    arg_constraints = {"proportions": constraints.simplex}  # noqa: RUF012
    pytree_data_fields = ("mdp", "proportions", "weights", "sensor", "log_policies")
    pytree_aux_fields = ("length",)

    def __init__(
        self,
        mdp: TabularMDP,
        proportions: Float[Array | np.ndarray, "... T"],
        weights: Float[Array | np.ndarray, "T K"],
        sensor: AnySensor,
        length: int,
        *,
        validate_args: bool | None = None,
    ) -> None:
        sensor = fitting_sensor(sensor, mdp)
        if proportions.shape[-1:] != weights.shape[:1]:
            raise ValueError(
                f"a mixture has a proportion for each row of weights, got shapes {proportions.shape} "
                f"and {weights.shape}"
            )
        self.mdp, self.proportions, self.weights = mdp, jnp.asarray(proportions), jnp.asarray(weights)
        self.sensor, self.length = sensor, length
        self.log_policies = soft_policies(mdp, self.weights)
        super().__init__(proportions.shape[:-1], (length, 3), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Constraint: integer codes of known kinds, states and actions."""
        return CodesConstraint(self.mdp.n_states, self.mdp.n_actions)

    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Int[Array, "... L 3"]:
        """Simulate observations."""

        def one(key: Array, log_proportions: Float[Array, " T"]) -> Int[Array, "L 3"]:
            choose, act, look = jax.random.split(key, 3)
            log_policy = self.log_policies[jax.random.categorical(choose, log_proportions)]
            return observe(look, self.sensor, *simulate(act, self.mdp, log_policy, self.length))

        shape = (*sample_shape, *self.batch_shape)
        chances = jnp.broadcast_to(jnp.log(self.proportions), (*shape, len(self.weights)))
        chances = chances.reshape(-1, len(self.weights))
        codes = jax.vmap(one)(jax.random.split(as_key(key), len(chances)), chances)
        return codes.reshape((*shape, self.length, 3))

    @validate_sample
    def log_prob(self, value: Int[Array | np.ndarray, "... L 3"]) -> Float[Array, "..."]:
        """Return the exact log-probability of observations; components and hidden steps summed out."""
        value = checked_codes(self.mdp, value)
        if value.shape[-2:] != (self.length, 3):
            raise ValueError(f"a value has shape [..., {self.length}, 3], got {value.shape}")
        perceived = as_evidence(self.mdp, self.sensor, value.reshape((-1, self.length, 3)))
        each = component_log_likelihoods(self.mdp, self.log_policies, perceived)
        return jax.nn.logsumexp(safe_log(self.proportions) + each.T.reshape((*value.shape[:-2], -1)), axis=-1)


def concentration_prior(
    concentration: float | Float[Array, ""] | dist.Distribution,
) -> Float[Array, ""] | dist.Distribution:
    """Check a concentration; return a number as an array, or its prior as it is.

    Raises ``ValueError`` for a number that is not positive and for a prior that is not over one positive
    number.
    """
    if isinstance(concentration, dist.Distribution):
        shape = (*concentration.batch_shape, *concentration.event_shape)
        negative = shape == () and concentration.support(jnp.array(-1.0))
        if shape or (not isinstance(negative, jax.core.Tracer) and bool(negative)):
            raise ValueError(
                f"the concentration's prior is over one positive number, got {type(concentration).__name__} "
                f"over {'negative ones too' if not shape else f'shape {shape}'}"
            )
        return concentration
    if not isinstance(concentration, jax.core.Tracer) and not 0 < float(concentration) < np.inf:
        raise ValueError(f"the concentration must be a positive number, got {concentration}")
    return jnp.asarray(concentration, float)


def mixture_model(
    mdp: TabularMDP,
    sensor: AnySensor,
    codes: Int[Array | np.ndarray, "n L 3"] | Perceived | None = None,
    *,
    components: int = COMPONENTS,
    concentration: float | Float[Array | np.ndarray, ""] | dist.Distribution = 1.0,
    prior: dist.Distribution | None = None,
    n_trajectories: int | None = None,
    length: int | None = None,
) -> Int[Array, "n L 3"] | None:
    r"""Define the NumPyro model of a demonstration whose trajectories have different reward functions.

    .. math::
        v_d \sim \text{Beta}(1, \alpha), \; d < T, \qquad \theta_d \sim \text{prior}, \; d \le T, \qquad
        Y_i \sim \sum_d \pi_d \, \text{TrajectoryLaw}(\theta_d), \; i \le n

    with :math:`\pi` as in :func:`stick_proportions`. Two trajectories have the same component with prior
    probability ``1 / (1 + alpha)``, up to truncation (:func:`truncation_error`).

    Parameters
    ----------
    mdp, sensor
        The decision process and its sensor.
    codes : int ``[n, L, 3]`` or Perceived, optional
        Observations, :attr:`Demonstration.codes`; :func:`perceive` prepares them for many evaluations of the
        same density. Without them the model simulates, as :func:`occlusion_model` does, and also returns the
        component of each trajectory.
    components : int
        ``T``: the largest number of components.
    concentration : float or Distribution
        ``alpha``, or its prior (``Gamma(2, 2)``, say): the larger, the more components.
    prior : Distribution, optional
        Prior of each component's scaled weights, see :func:`~i2rl.models.weights_prior`.
    n_trajectories, length : int, optional
        ``n`` and ``L``, needed only without ``codes``.

    Returns
    -------
    The site ``demonstration`` (None if it was prepared). Other sites: ``weights [T, K]``,
    ``sticks [T - 1]`` (if ``T > 1``), deterministic ``proportions [T]``, ``concentration`` if it is
    random, and ``assignment [n]`` in simulations.

    See Also
    --------
    i2rl.inference.sample_mixture_posterior : NUTS for this model
    i2rl.inference.gibbs_mixture_posterior : a Gibbs sampler without truncation
    i2rl.models.occlusion_model : the model of one reward

    Examples
    --------
    >>> import jax
    >>> from numpyro.infer import Predictive
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import mixture_model
    >>> corridor, simulate = five_cells(), Predictive(mixture_model, num_samples=10)
    >>> draws = simulate(jax.random.key(0), corridor.mdp, corridor.sensor, n_trajectories=8, length=6)
    >>> draws["weights"].shape, draws["assignment"].shape  # ten components by default
    ((10, 10, 2), (10, 8))
    """
    if components < 1:
        raise ValueError(f"a mixture needs at least one component, got {components}")
    alpha = concentration_prior(concentration)
    if isinstance(alpha, dist.Distribution):
        alpha = numpyro.sample("concentration", alpha)
    proportions = jnp.ones(1)
    if components > 1:
        sticks = numpyro.sample("sticks", dist.Beta(1.0, alpha).expand((components - 1,)).to_event(1))
        proportions = stick_proportions(sticks)
    proportions = numpyro.deterministic("proportions", proportions)
    each = scaled_prior(mdp, prior).expand((components,)).to_event(1)
    weights = numpyro.sample("weights", each)
    if isinstance(codes, Perceived):
        table = component_log_likelihoods(mdp, soft_policies(mdp, weights), codes)
        mixed = jax.nn.logsumexp(safe_log(proportions)[:, None] + table, axis=0)
        numpyro.factor("demonstration", codes.repeats * mixed)
        return None
    if codes is not None:
        n_trajectories, length = codes.shape[0], codes.shape[1]
    if n_trajectories is None or length is None:
        raise ValueError("without codes the model simulates, and needs n_trajectories and length")
    with numpyro.plate("trajectory", n_trajectories):
        if codes is None:
            way = numpyro.sample("assignment", dist.Categorical(proportions))
            proportions = jax.nn.one_hot(way, components)
        law = MixtureLaw(mdp, proportions, weights, sensor, length)
        return numpyro.sample("demonstration", law, obs=codes)
