"""Settings, state and info of the adversarial learners of tabular tasks."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....models.inputs.display import shown_briefly
from ...completion.transitions import TransitionStatistic, discounted_transitions, visited_transitions
from .discriminator import AVERAGES

OCCUPANCIES = {"visited": visited_transitions, "discounted": discounted_transitions}


class TabularTraining(NamedTuple):
    """Settings of a session's training.

    Fields
    ------
    iterations : int
        Iterations of discriminator and generator.
    updates : int
        Steps of the discriminator in an iteration.
    learning_rate : float
        Learning rate of its Adam.
    entropy : float
        The generator's reward for a nat of entropy.
    step : float
        Step of the generator, see :func:`~i2rl.inference.adversarial.tabular.discriminator.proximal_plan`;
        infinite for a plan afresh.
    forgetting : float
        Exponent of the current session's share in the statistic of the expert's transitions: 1 counts all
        sessions alike, less forgets slowly, 0 uses the current session alone.
    occupancy : {"visited", "discounted"}
        The generator's transitions: from the expert's first states and over its lengths, or discounted from
        ``p0``.
    average : {"log probabilities", "logits"}
        ``E[log D]``, or as the authors do ``log D`` of the mean logit, which carries no statistic.
    horizon : int
        Longest trajectory of a demonstration.
    """

    iterations: int = 30
    updates: int = 4
    learning_rate: float = 3e-3
    entropy: float = 1.0
    step: float = np.inf
    forgetting: float = 1.0
    occupancy: str = "visited"
    average: str = "log probabilities"
    horizon: int = 16

    def checked(self) -> TabularTraining:
        """Validate the settings and return them. Raises ``ValueError`` naming an invalid field."""
        for name in ("iterations", "updates", "horizon"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "step"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not self.entropy >= 0 or (self.entropy == 0 and np.isinf(self.step)):
            raise ValueError(
                f"the entropy's worth must be positive, or 0 with a finite step, got {self.entropy}"
            )
        if not 0 <= self.forgetting <= 1:
            raise ValueError(f"forgetting is an exponent in [0, 1], got {self.forgetting}")
        for name, known in (("occupancy", OCCUPANCIES), ("average", AVERAGES)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} is one of {', '.join(known)}, got {getattr(self, name)!r}")
        if self.average == "logits" and self.forgetting > 0:
            raise ValueError("the average of logits is over a session's own steps: forgetting must be 0")
        return self


@shown_briefly
class TabularAdversarialState(NamedTuple):
    """State that is carried from session to session.

    Fields
    ------
    network : the discriminator's
    optimiser : its optimiser's state
    log_policy : float ``[S, A]``, the generator
    values : float ``[S]``, warm start of planning
    statistic : TransitionStatistic, of the expert so far (after forgetting)
    confusions : ConfusionStatistic, or empty if the sensor is given
    session : int
    key : random key
    """

    network: Any
    optimiser: Any
    log_policy: Float[Array, "S A"]
    values: Float[Array, " S"]
    statistic: TransitionStatistic
    confusions: Any
    session: Int[Array, ""]
    key: Array

    @property
    def weights(self) -> Float[Array, " P"]:
        """All parameters of the discriminator's network in one vector."""
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(self.network)])


@shown_briefly
class TabularAdversarialInfo(NamedTuple):
    """Measures of a session.

    Fields
    ------
    session : int
    log_likelihood : float
        Log-likelihood of the session's demonstration under the new policy, nats per trajectory, exact. At
        face value, that of the observed actions given the observed states.
    demonstration_log_likelihood : float
        The same, summed over trajectories.
    loss, expert_accuracy, generated_accuracy : float ``[iterations]``
        Measures of the discriminator: cross-entropy in nats, and the shares of either side classified right.
    iterations : int
        Iterations of the session.
    noise : float ``[M]``
        Learned probabilities of the confusions; empty if the sensor is given.
    seconds : float
    weights : float ``[P]``
    """

    session: int
    log_likelihood: float
    demonstration_log_likelihood: float
    loss: Float[np.ndarray, " rounds"]
    expert_accuracy: Float[np.ndarray, " rounds"]
    generated_accuracy: Float[np.ndarray, " rounds"]
    iterations: int
    noise: Float[np.ndarray, " M"]
    seconds: float
    weights: Float[np.ndarray, " P"]
