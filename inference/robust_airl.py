"""robust-AIRL for continuous tasks (section 6.2, Algorithm 3): the truth behind reports, under the policy.

What is done about noise is one object, the learner's :class:`~i2rl.inference.airl.Truth`:

:class:`Smoothed`
    the sensor is known, as the dissertation has it;
:class:`SmoothedAndFitted`
    only its form is, and its covariances are fitted to each session by expectation-maximisation.

Either way the truth is found under the generator's current policy, so it sharpens as the policy does, and the
chain goes on from where the last look left it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..models.networks import Policy
from ..models.sensing import GaussianSensor, Recording, Truths
from .airl import Training, adversarial
from .discriminator import Discriminator, ExpertTransitions, Transitions, airl_discriminator
from .gaussian_truth import GaussianTruth, fitted_sensor, gaussian_truth
from .session import Learner


class Look(NamedTuple):
    """The chain, and the policy it was last looked at under (None before the first look)."""

    chain: Any
    policy: Policy | None


class Smoothed(NamedTuple):
    """The truth by smoothing, the sensor being known.

    Fields
    ------
    truth : GaussianTruth, CandidateTruth or PartitionTruth, with the dynamics
    sensor : the sensor it is about
    passes : int
        Relinearisations of the first look at a recording; later looks, which go on from it, make one.
    """

    truth: Any
    sensor: Any
    passes: int = 6

    def prior(self) -> Any:
        """The sensor."""
        return self.sensor

    def begin(self, recording: Recording, sensor: Any, key: Array) -> Look:
        """Start at the reports. Raises ``ValueError`` where their sizes are not the dynamics'."""
        return Look(self.truth.init(recording, sensor), None)

    def refresh(self, chain: Look, sensor: Any, policy: Policy, key: Array) -> tuple[Look, ExpertTransitions]:
        """Relinearise where there is something to, smooth, and draw under the policy."""
        passes = (
            (self.passes if chain.policy is None else 1,) if isinstance(self.truth, GaussianTruth) else ()
        )
        found, drawn = self.truth.refresh(chain.chain, policy, key, sensor, *passes)
        return Look(found, policy), as_expert(drawn)

    def learned(self, chain: Look, sensor: Any) -> Any:
        """The sensor as it was."""
        return sensor


class SmoothedAndFitted(NamedTuple):
    """The truth by smoothing, the sensor's covariances being fitted in every session.

    Fields
    ------
    truth : GaussianTruth
    sensor : GaussianSensor, what is believed before the first session
    passes : int, as of :class:`Smoothed`
    steps : int, of expectation-maximisation a session
    """

    truth: GaussianTruth
    sensor: GaussianSensor
    passes: int = 6
    steps: int = 4

    def prior(self) -> GaussianSensor:
        """What is believed of the sensor before the first session."""
        return self.sensor

    begin = Smoothed.begin
    refresh = Smoothed.refresh

    def learned(self, chain: Look, sensor: GaussianSensor) -> GaussianSensor:
        """Covariances under which the session's reports are likeliest (diagonal).

        Each step is an E-step with the dynamics as last linearised, and the closed-form M-step.
        """
        for _ in range(self.steps):
            posterior = self.truth.posterior(chain.chain, chain.policy, sensor)
            sensor = fitted_sensor(chain.chain.reported, posterior)
        return sensor


@jax.jit
def as_expert(drawn: Truths) -> ExpertTransitions:
    """Draws ``[M, n, L]`` as the samples of ``n L`` expert steps."""

    def rows(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(x.shape[0], -1, *x.shape[3:]), 0, 1)

    steps = Transitions(
        rows(drawn.observations), rows(drawn.actions), rows(drawn.successors), rows(drawn.terminated)
    )
    m = drawn.usable.shape[0]
    return ExpertTransitions(steps, rows(drawn.usable).all(1), jnp.full(m, 1 / m))


def robust_airl(
    generator: Any,
    sensor: GaussianSensor,
    dynamics: Any,
    *,
    discriminator: Discriminator | None = None,
    training: Training | None = None,
    **truth: Any,
) -> Learner:
    """robust-AIRL with a known sensor.

    ``dynamics`` has ``next_state`` (:class:`~i2rl.inference.gaussian_truth.Dynamics`), as the robots of
    :mod:`i2rl.domains.locomotion` do; ``truth`` goes to :func:`gaussian_truth`.
    """
    return _learner("robust-AIRL", Smoothed, generator, sensor, dynamics, discriminator, training, truth)


def robust_airl_with_sensor(
    generator: Any,
    sensor: GaussianSensor,
    dynamics: Any,
    *,
    discriminator: Discriminator | None = None,
    training: Training | None = None,
    **truth: Any,
) -> Learner:
    """robust-AIRL that learns the sensor's covariances too, from ``sensor`` on; else :func:`robust_airl`."""
    name = "robust-AIRL with sensor"
    return _learner(name, SmoothedAndFitted, generator, sensor, dynamics, discriminator, training, truth)


def _learner(
    name: str,
    kind: Any,
    generator: Any,
    sensor: GaussianSensor,
    dynamics: Any,
    discriminator: Discriminator | None,
    training: Training | None,
    truth: dict[str, Any],
) -> Learner:
    environment = generator.environment
    d, k = environment.observation_size, environment.actions.size
    if discriminator is None:
        discriminator = airl_discriminator(d, environment.actions)
    hidden = kind(gaussian_truth(dynamics, d, **truth), sensor.sized(d, k))
    return adversarial(name, generator, discriminator, hidden, training, {"truth": truth})
