"""Truth behind a noisy pendulum by Gibbs sampling, by smoothing and by particles.

``python -m i2rl.analysis.benchmarks.statistics.gibbs`` draws trajectories of a damped pendulum with a torque
at four settings of process and sensor noise, among them one with observation noise that is large against the
process noise, where single steps hardly move. :class:`GaussianGibbs` and the smoother are compared with an
independent referee: a bootstrap particle filter with backward simulation (Godsill, Doucet and West 2004).
Differences of posterior means are in the referee's standard deviations, the largest over all steps and
components. Fails if Gibbs differs from the referee by more than ``TOLERANCE``.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ....inference.completion.gaussian import GaussianTruth, gaussian_truth, jax_dynamics
from ....inference.completion.gibbs import GaussianGibbs
from ....models.observation.recordings import GaussianSensor, Recording, distort, log_normal, recording
from ..harness import print_table, publish

SETTINGS = ((0.01, 0.04), (0.003, 0.04), (0.03, 0.4), (0.003, 0.4))
"""Process covariance, and sensor variance of states and actions."""

TOLERANCE = 0.2
STEPS, POLICY_VARIANCE = 12, 0.3


class Torque(NamedTuple):
    """A policy with actions normal about an affine function of the state."""

    slope: Float[Array, "1 2"]

    def moments(self, s: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """Compute the mean and covariance of the action."""
        return s @ self.slope.T + 0.2, jnp.full((*s.shape[:-1], 1, 1), POLICY_VARIANCE)

    def log_prob(self, s: Float[Array, "... 2"], a: Float[Array, "... 1"]) -> Float[Array, "..."]:
        """Compute the log-density of actions, in nats."""
        return log_normal(a - self.moments(s)[0], POLICY_VARIANCE * jnp.eye(1))


class Moments(NamedTuple):
    """Posterior means and standard deviations of the pairs, ``[L, 3]``."""

    means: Float[np.ndarray, "L 3"]
    deviations: Float[np.ndarray, "L 3"]


def pendulum(s: Float[Array, " 2"], a: Float[Array, " 1"]) -> Float[Array, " 2"]:
    """Follow a damped pendulum with a torque for 0.2 seconds."""
    turning = 0.95 * s[1] - 1.2 * jnp.sin(s[0]) + 0.6 * jnp.tanh(a[0])
    return jnp.stack([s[0] + 0.2 * turning, turning])


PENDULUM, POLICY = jax_dynamics(pendulum), Torque(jnp.array([[-0.3, 0.5]]))


def problem(seed: int, process: float, sensor: GaussianSensor, steps: int) -> Recording:
    """Draw a trajectory from the model and its observation."""
    rng = np.random.default_rng(seed)
    s, pairs = jnp.asarray(rng.normal(size=(1, 2))), []
    for _ in range(steps):
        a = POLICY.moments(s)[0] + POLICY_VARIANCE**0.5 * rng.normal(size=(1, 1))
        pairs.append((s[0], a[0]))
        s = PENDULUM.next_state(s, a) + process**0.5 * rng.normal(size=(1, 2))
    states, actions = (np.stack(x) for x in zip(*pairs, strict=True))
    return distort(jax.random.key(seed), sensor, recording([states], [actions]))


@partial(jax.jit, static_argnames=("particles", "draws"))
def particle_smoother(
    key: Array,
    policy: Any,
    process: float,
    variance: float,
    reported: Recording,
    particles: int,
    draws: int,
) -> Float[Array, "draws L 3"]:
    """Draw truths of a one-trajectory recording: bootstrap filter forward, simulation backward."""
    s_reported, a_reported = reported.observations[0], reported.actions[0]

    def act(key: Array, s: Float[Array, "N 2"]) -> Float[Array, "N 1"]:
        mean, covariance = policy.moments(s)
        return mean + jnp.sqrt(covariance[:, 0]) * jax.random.normal(key, (len(s), 1))

    def weigh(s: Array, a: Array, s_report: Array, a_report: Array) -> Float[Array, " N"]:
        return log_normal(s_report - s, variance * jnp.eye(2)) + log_normal(
            a_report - a, variance * jnp.eye(1)
        )

    def forward(carry: tuple, inputs: tuple) -> tuple:
        s, a = carry
        key, s_report, a_report = inputs
        resample, move, choose = jax.random.split(key, 3)
        log_w = weigh(s, a, s_report, a_report)
        # Systematic: the survivors' numbers are as near to their weights as they can be.
        points = (jax.random.uniform(resample) + jnp.arange(particles)) / particles
        chosen = jnp.searchsorted(jnp.cumsum(jax.nn.softmax(log_w)), points)
        chosen = jnp.minimum(chosen, particles - 1)
        onward = PENDULUM.next_state(s[chosen], a[chosen])
        onward += process**0.5 * jax.random.normal(move, onward.shape)
        return (onward, act(choose, onward)), (s, a, log_w)

    start, choose, walk, last, back = jax.random.split(key, 5)
    s = jax.random.normal(start, (particles, 2))
    inputs = (jax.random.split(walk, len(s_reported)), s_reported, a_reported)
    passed: tuple = lax.scan(forward, (s, act(choose, s)), inputs)[1]
    states, actions, log_w = passed
    following_states = jax.vmap(PENDULUM.next_state)(states[:-1], actions[:-1])

    def draw(key: Array, final: Array) -> Float[Array, "L 3"]:
        def backward(following: Array, inputs: tuple) -> tuple:
            key, s, a, w, onward = inputs
            distance = jnp.sum((following - onward) ** 2, -1)
            here = jax.random.categorical(key, w - 0.5 * distance / process)
            return s[here], jnp.concatenate([s[here], a[here]])

        end = jax.random.categorical(final, log_w[-1])
        keys = jax.random.split(key, len(states) - 1)
        earlier = (keys, states[:-1], actions[:-1], log_w[:-1], following_states)
        before: Array = lax.scan(backward, states[-1, end], earlier, reverse=True)[1]
        return jnp.concatenate([before, jnp.concatenate([states[-1, end], actions[-1, end]])[None]])

    given = (jax.random.split(back, draws), jax.random.split(last, draws))
    return lax.map(lambda keys: draw(*keys), given, batch_size=64)


def by_particles(key: Array, process: float, variance: float, reported: Recording, options: Any) -> Moments:
    """Compute the referee's moments."""
    drawn = np.asarray(
        particle_smoother(key, POLICY, process, variance, reported, options.particles, options.backward)
    )
    return Moments(drawn.mean(0), drawn.std(0))


def by_gibbs(
    key: Array, truth: GaussianTruth, sensor: GaussianSensor, reported: Recording, refreshes: int
) -> tuple[Moments, Any]:
    """Compute moments over the chains and the last two thirds of the refreshes; return the chains, too."""
    gibbs = GaussianGibbs(truth, sweeps=2)
    chain, kept = gibbs.init(reported, sensor), []
    for i in range(refreshes):
        chain, _ = gibbs.refresh(chain, POLICY, jax.random.fold_in(key, i), sensor)
        if 3 * i >= refreshes:
            kept.append(np.asarray(jnp.concatenate([chain.observations, chain.actions], -1))[:, 0])
    drawn = np.concatenate(kept)
    return Moments(drawn.mean(0), drawn.std(0)), chain


def compare(process: float, variance: float, seed: int, options: Any) -> dict[str, float]:
    """Compute the largest differences from the referee at one setting, of one trajectory."""
    sensor = GaussianSensor(variance, variance)
    reported = problem(seed, process, sensor, options.steps)
    key = jax.random.key(seed)
    halves = [by_particles(jax.random.fold_in(key, i), process, variance, reported, options) for i in (1, 2)]
    referee = Moments(*np.mean(halves, 0))
    truth = gaussian_truth(
        PENDULUM, 2, process_covariance=process, initial_covariance=1.0, draws=options.chains
    )
    smoothed, _ = truth.refresh(truth.init(reported, sensor), POLICY, key, sensor, passes=8)
    gibbs, chain = by_gibbs(jax.random.fold_in(key, 3), truth, sensor, reported, options.refreshes)
    reports = np.concatenate([reported.observations[0], reported.actions[0]], -1)

    def off(means: np.ndarray) -> float:
        return float((np.abs(means - referee.means) / referee.deviations).max())

    return {
        "Gibbs": off(gibbs.means),
        "smoother": off(np.asarray(smoothed.means[0])),
        "half the referee": off(halves[0].means),
        "reports": off(reports),
        "deviation, Gibbs / referee": float((gibbs.deviations / referee.deviations).mean()),
        "least acceptance": float(chain.least_acceptance),
        "acceptance, whole": float(chain.acceptance_whole[0]),
        "least mobility": float(np.nanmin(chain.mobility)),
    }


def main() -> None:
    """Compare, print, publish, and fail where Gibbs differs by more than ``TOLERANCE``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--replications", type=int, default=4)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--backward", type=int, default=1500, help="trajectories of half the referee")
    parser.add_argument("--chains", type=int, default=128)
    parser.add_argument("--refreshes", type=int, default=60)
    options = parser.parse_args()
    rows, worst = [], 0.0
    for process, variance in SETTINGS:
        for seed in range(options.replications):
            row = {"process": process, "sensor": variance, "seed": seed}
            row |= compare(process, variance, seed, options)
            rows.append(row)
            worst = max(worst, row["Gibbs"])
    print_table(
        "Posterior means from the referee's, in deviations", list(rows[0]), [[*r.values()] for r in rows]
    )
    publish("gibbs", {"tolerance": TOLERANCE, "worst": worst, "rows": rows})
    if not worst <= TOLERANCE:
        sys.exit(f"Gibbs differs from the referee by {worst:.3g} standard deviations")


if __name__ == "__main__":
    main()
