"""robust-AIRL for continuous tasks (section 6.2, Algorithm 3): draws of the truth under the policy.

One object handles the noise, the learner's :class:`~i2rl.inference.adversarial.learner.Truth`:

:class:`Smoothed`
    the sensor is known, as in the dissertation;
:class:`SmoothedAndFitted`
    only the sensor's form is known; its parameters are fitted to each session by expectation-maximisation.

Both draw the truth under the generator's current policy, every few iterations (``refresh`` of
:class:`~i2rl.inference.adversarial.learner.AdversarialTraining`); the chain continues from the session's
previous refresh.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...models.inputs.display import shown_briefly
from ...models.networks.modules import Policy
from ...models.observation.recordings import (
    GaussianSensor,
    Recording,
    ShiftSensor,
    Truths,
    require_continuous,
)
from ..completion.gaussian import GaussianTruth, fitted_sensor
from ..completion.partitioned import CandidateTruth, fitted_shift_sensor
from ..sessions.learner import Learner
from .discriminator import Discriminator, ExpertTransitions, Transitions, airl_discriminator
from .learner import AdversarialTraining, adversarial


@shown_briefly
class Look(NamedTuple):
    """The chain, and the policy of its last refresh (None before the first)."""

    chain: Any
    policy: Policy | None


@shown_briefly
class Smoothed(NamedTuple):
    """The truth by smoothing, with a known sensor.

    Fields
    ------
    truth : GaussianTruth, GaussianGibbs, CandidateTruth or PartitionTruth, with the dynamics
    sensor : the sensor assumed
    passes : int
        Relinearisations at the first refresh of a recording; later refreshes, which continue from it, make
        one.
    """

    truth: Any
    sensor: Any
    passes: int = 6

    def prior(self) -> Any:
        """Return the sensor."""
        return self.sensor

    def begin(self, recording: Recording, sensor: Any, key: Array) -> Look:
        """Start at the observations. Raises ``ValueError`` if their sizes differ from the dynamics'."""
        return Look(self.truth.init(recording, sensor), None)

    def refresh(self, chain: Look, sensor: Any, policy: Policy, key: Array) -> tuple[Look, ExpertTransitions]:
        """Relinearise nonlinear dynamics, smooth, and draw under the policy."""
        passes = (
            (self.passes if chain.policy is None else 1,) if isinstance(self.truth, GaussianTruth) else ()
        )
        found, drawn = self.truth.refresh(chain.chain, policy, key, sensor, *passes)
        return Look(found, policy), as_expert(drawn)

    def more(self, chain: Look, sensor: Any, policy: Policy, key: Array) -> tuple[Look, ExpertTransitions]:
        """Draw again without a new linearisation."""
        if isinstance(self.truth, GaussianTruth):
            return chain, as_expert(self.truth.resample(chain.chain, policy, key, sensor))
        return self.refresh(chain, sensor, policy, key)

    def learned(self, chain: Look, sensor: Any) -> Any:
        """Return the sensor unchanged."""
        return sensor


@shown_briefly
class SmoothedAndFitted(NamedTuple):
    """The truth by smoothing, with a sensor that is fitted in every session.

    Fields
    ------
    truth, passes : as in :class:`Smoothed`
    sensor : the assumption before the first session
    fit : ``(truth, chain, policy, sensor) -> sensor``, one step of expectation-maximisation
    steps : int, number of these steps in a session
    """

    truth: Any
    sensor: Any
    fit: Callable[[Any, Any, Policy, Any], Any]
    passes: int = 6
    steps: int = 10

    def prior(self) -> Any:
        """Return the assumed sensor before the first session."""
        return self.sensor

    def begin(self, recording: Recording, sensor: Any, key: Array) -> Look:
        """Start as :meth:`Smoothed.begin` does."""
        return Smoothed(self.truth, sensor, self.passes).begin(recording, sensor, key)

    def refresh(self, chain: Look, sensor: Any, policy: Policy, key: Array) -> tuple[Look, ExpertTransitions]:
        """Refresh as :meth:`Smoothed.refresh` does."""
        return Smoothed(self.truth, sensor, self.passes).refresh(chain, sensor, policy, key)

    def more(self, chain: Look, sensor: Any, policy: Policy, key: Array) -> tuple[Look, ExpertTransitions]:
        """Draw again as :meth:`Smoothed.more` does."""
        return Smoothed(self.truth, sensor, self.passes).more(chain, sensor, policy, key)

    def learned(self, chain: Look, sensor: Any) -> Any:
        """Fit the sensor to the session's observations by maximum likelihood."""
        assert chain.policy is not None
        for _ in range(self.steps):
            sensor = self.fit(self.truth, chain.chain, chain.policy, sensor)
        return sensor


def fit_gaussian(truth: GaussianTruth, chain: Any, policy: Policy, sensor: GaussianSensor) -> GaussianSensor:
    """Fit diagonal covariances, with the dynamics as last linearised (closed form)."""
    return fitted_sensor(chain.reported, truth.posterior(chain, policy, sensor))


def fit_isotropic(truth: GaussianTruth, chain: Any, policy: Policy, sensor: GaussianSensor) -> GaussianSensor:
    """Fit one variance for all coordinates of states and actions (closed form).

    Coordinates that the dynamics hardly determine, such as the velocities of limbs that strike the ground,
    cannot be distinguished from noise alone: :func:`fit_gaussian` leaves them at their assumed values.
    """
    each = fit_gaussian(truth, chain, policy, sensor)
    common = jnp.mean(jnp.concatenate([jnp.diagonal(x) for x in each]))
    return GaussianSensor(*(common * jnp.eye(len(x)) for x in each))


def fit_shift(truth: CandidateTruth, chain: Any, policy: Policy, sensor: ShiftSensor) -> ShiftSensor:
    """Fit the probability of a shift (closed form)."""
    return fitted_shift_sensor(sensor, chain, truth.posterior(chain, policy, sensor))


@jax.jit
def as_expert(drawn: Truths) -> ExpertTransitions:
    """Arrange draws ``[M, n, L]`` as the draws of ``n L`` expert steps."""

    def rows(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(x.shape[0], -1, *x.shape[3:]), 0, 1)

    steps = Transitions(
        rows(drawn.observations), rows(drawn.actions), rows(drawn.successors), rows(drawn.terminated)
    )
    m = drawn.usable.shape[0]
    return ExpertTransitions(steps, rows(drawn.usable).all(1), jnp.full(m, 1 / m))


def robust_airl(
    generator: Any,
    truth: Any,
    sensor: Any,
    *,
    discriminator: Discriminator | None = None,
    training: AdversarialTraining | None = None,
) -> Learner:
    """Build robust-AIRL with a known sensor.

    Parameters
    ----------
    generator : PPO, or as :func:`~i2rl.inference.adversarial.learner.adversarial` takes it
    truth : GaussianTruth, GaussianGibbs, CandidateTruth or PartitionTruth
        With the dynamics: ``gaussian_truth(robot, robot.observation_size)``, say.
    sensor : the sensor behind the observations, such as :class:`GaussianSensor`
    discriminator, training : by default AIRL's, and :class:`AdversarialTraining`'s own

    Raises
    ------
    ValueError
        For an invalid sensor: a covariance of another size or not positive definite, a probability outside
        [0, 1].

    See Also
    --------
    i2rl.inference.gaussian_truth : the truth of Gaussian sensors
    i2rl.inference.airl : takes observations for the truth
    i2rl.inference.robust_airl_tabular : the learner of tabular tasks

    Examples
    --------
    >>> from i2rl.domains import onion_reaching
    >>> from i2rl.inference import gaussian_truth, ppo, robust_airl
    >>> from i2rl.models import GaussianSensor
    >>> robot = onion_reaching()
    >>> agent = ppo(robot, n_envs=2, n_steps=8, minibatch=8)
    >>> truth = gaussian_truth(robot, robot.observation_size)
    >>> learner = robust_airl(agent, truth, GaussianSensor(0.01, 0.01))  # variances
    >>> learner.name, learner.mdp.observation_size, learner.mdp.n_actions
    ('robust-AIRL', 29, 3)
    """
    return _learner("robust-AIRL", generator, Smoothed(truth, sensor), discriminator, training)


def robust_airl_with_sensor(
    generator: Any,
    truth: Any,
    sensor: Any,
    fit: Callable[[Any, Any, Policy, Any], Any] = fit_gaussian,
    *,
    discriminator: Discriminator | None = None,
    training: AdversarialTraining | None = None,
) -> Learner:
    """Build robust-AIRL that also learns the sensor's parameters, starting from ``sensor``."""
    hidden = SmoothedAndFitted(truth, sensor, fit)
    return _learner("robust-AIRL with sensor", generator, hidden, discriminator, training)


def _learner(
    name: str,
    generator: Any,
    hidden: Any,
    discriminator: Discriminator | None,
    training: AdversarialTraining | None,
) -> Learner:
    environment = generator.environment
    if discriminator is None:
        discriminator = airl_discriminator(
            environment.observation_size, environment.actions, generator.settings.gamma
        )
    hidden = hidden._replace(sensor=_carried(hidden.sensor, environment))
    known = {
        "truth": type(hidden.truth).__name__,
        "truth settings": _digest(hidden.truth),
        "sensor": [np.asarray(x).tolist() for x in jax.tree.leaves(hidden.sensor)],
        "passes": hidden.passes,
    }
    if isinstance(hidden, SmoothedAndFitted):
        known |= {"fit": getattr(hidden.fit, "__name__", type(hidden.fit).__name__), "steps": hidden.steps}
    return adversarial(name, generator, discriminator, hidden, training, known)


def _carried(sensor: Any, environment: Any) -> Any:
    """Convert a sensor to arrays of the shapes that a fitted one also has."""
    require_continuous(sensor)
    if isinstance(sensor, GaussianSensor):
        return sensor.sized(environment.observation_size, environment.actions.size)
    return jax.tree.map(lambda x: jnp.asarray(x, float) if isinstance(x, int | float) else x, sensor)


def _digest(truth: Any) -> str:
    """Digest the assumptions on the truth, except the dynamics, which are functions."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(truth):
        if not any(getattr(part, "name", None) == "dynamics" for part in path):
            digest.update(jax.tree_util.keystr(path).encode() + np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
