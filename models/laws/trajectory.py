"""The law of an imperfectly observed trajectory, as a NumPyro distribution."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike
from numpyro.distributions import constraints
from numpyro.distributions.util import validate_sample

from ..inputs.arguments import as_key
from ..observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN, Demonstration
from ..observation.evidence import AnySensor, checked_codes, fitting_sensor, observe, step_log_evidence
from ..process.mdp import TabularMDP
from ..process.planning import reward_of, simulate, soft_plan
from .chain import filter_all


class CodesConstraint(constraints.Constraint):
    """Codes (kind, state, action) of known kinds, states and actions."""

    is_discrete = True
    event_dim = 2

    def __init__(self, n_states: int, n_actions: int) -> None:
        self.n_states, self.n_actions = n_states, n_actions
        super().__init__()

    def __call__(self, x: Int[Array, "... L 3"]) -> Bool[Array, "..."]:
        """Return whether codes are of known kinds, states and actions."""
        kind, state, action = x[..., 0], x[..., 1], x[..., 2]
        inside = (
            (state >= UNKNOWN) & (state < self.n_states) & (action >= UNKNOWN) & (action < self.n_actions)
        )
        seen = (kind != SEEN) | (state != UNKNOWN) | (action != UNKNOWN)
        ended = jnp.all((kind[..., :-1] != PAD) | (kind[..., 1:] == PAD), axis=-1)
        return jnp.all((kind >= PAD) & (kind <= LOST) & inside & seen, axis=-1) & ended

    def feasible_like(self, prototype: Array) -> Array:
        """Return hidden steps of the shape of ``prototype``."""
        return jnp.broadcast_to(jnp.array([HIDDEN, UNKNOWN, UNKNOWN], jnp.int32), prototype.shape)

    def tree_flatten(self) -> tuple:
        """Flatten for JAX: no leaves."""
        return (), ((), {"n_states": self.n_states, "n_actions": self.n_actions})


class TrajectoryLaw(dist.Distribution):
    """Law of the observations of ``length`` steps of an expert with ``theta . phi``'s soft policy.

    A value is an integer array ``[..., L, 3]`` of (kind, state, action), as in
    :attr:`Demonstration.codes`; trajectories shorter than ``length`` are padded. ``log_prob`` is exact:
    hidden steps, lost frames and noise are summed out by one forward pass, and it is differentiable in the
    weights. ``sample`` simulates the expert and passes the trajectory through the sensor (without lost
    frames, which carry no evidence).

    Parameters
    ----------
    mdp : TabularMDP
    weights : float ``[K]`` (``theta``)
    sensor : Sensor
        Visibility and noise; ``Sensor()`` sees everything.
    length : int
        Steps of an event, ``L``.

    Raises ``ValueError`` for discount 1, for a sensor made for another MDP, and for values of another
    length; ``log_prob`` raises :class:`DemonstrationError` for a value with an index out of range. For a
    traced value it returns minus infinity instead.
    """

    arg_constraints = {"weights": constraints.real_vector}  # noqa: RUF012
    pytree_data_fields = ("mdp", "weights", "sensor", "log_policy")
    pytree_aux_fields = ("length",)

    def __init__(
        self,
        mdp: TabularMDP,
        weights: ArrayLike,
        sensor: AnySensor,
        length: int,
        *,
        validate_args: bool | None = None,
    ) -> None:
        sensor = fitting_sensor(sensor, mdp)
        self.mdp, self.sensor, self.length = mdp, sensor, length
        self.weights = jnp.asarray(weights)
        self.log_policy = soft_plan(mdp, reward_of(mdp, self.weights)).log_policy
        super().__init__((), (length, 3), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Constraint: integer codes of known kinds, states and actions."""
        return CodesConstraint(self.mdp.n_states, self.mdp.n_actions)

    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Int[Array, "... L 3"]:
        """Simulate observations."""

        def one(key: Array) -> Int[Array, "L 3"]:
            act, look = jax.random.split(key)
            states, actions = simulate(act, self.mdp, self.log_policy, self.length)
            return observe(look, self.sensor, states, actions)

        size = 1
        for n in sample_shape:
            size *= n
        codes = jax.vmap(one)(jax.random.split(as_key(key), size))
        return codes.reshape((*sample_shape, self.length, 3))

    @validate_sample
    def log_prob(self, value: Int[Array | np.ndarray, "... L 3"]) -> Float[Array, "..."]:
        """Return the exact log-probability of observations, hidden steps summed out."""

        def evidence(code: Int[Array, " 3"]) -> Float[Array, "S A"]:
            shape = (self.mdp.n_states, self.mdp.n_actions)
            return step_log_evidence(self.sensor, *shape, code[0], code[1], code[2], jnp.array(jnp.nan))

        value = checked_codes(self.mdp, value)
        if value.shape[-2:] != (self.length, 3):
            raise ValueError(f"a value has shape [..., {self.length}, 3], got {value.shape}")
        flat = value.reshape((-1, self.length, 3))
        factors = jax.vmap(jax.vmap(evidence))(flat) + self.log_policy
        passed = filter_all(self.mdp, factors, flat[..., 0] != PAD)
        return passed.log_likelihood.reshape(value.shape[:-2])


def sample_demonstration(key: Array, law: TrajectoryLaw, n_trajectories: int) -> Demonstration:
    """Simulate a demonstration of independent trajectories.

    See Also
    --------
    i2rl.models.TrajectoryLaw : the distribution that is drawn from
    i2rl.models.simulate : draws one trajectory, all of it seen

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.models import TrajectoryLaw, sample_demonstration
    >>> corridor = five_cells()
    >>> law = TrajectoryLaw(corridor.mdp, corridor.weights, corridor.sensor, 6)
    >>> demonstration = sample_demonstration(jax.random.key(1), law, 8)
    >>> demonstration.lengths.tolist(), demonstration.state[:, 0].tolist()  # all begin in cell 0
    ([6, 6, 6, 6, 6, 6, 6, 6], [0, 0, 0, 0, 0, 0, 0, 0])
    """
    return Demonstration.from_codes(np.asarray(law.sample(key, (n_trajectories,))))
