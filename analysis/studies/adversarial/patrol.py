"""Adversarial learners on patrol with noisy observations (section 7.4.3, Figure 7.11).

Instance 2, its greedy expert (the dissertation's is a rule by hand), trajectories of 8 pairs from anywhere,
sessions of 32 to 128 pairs. Moving forward is observed as turning left, and turning right as moving forward;
states are always right. The posterior of the truth behind an observation and the generator's plan are exact.

:func:`patrol_results` is the study behind ``i2rl run robust-airl --domain patrol``. Only networks pass from
session to session there, as in the dissertation (``forgetting`` of 0): with the default statistic of earlier
sessions, noise of 5 % costs almost nothing, which leaves nothing to recover.
:mod:`~i2rl.analysis.benchmarks.statistics.adversarial_patrol` measures both.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ....domains.patrol.process import FORWARD, LEFT, RIGHT, Patrol, instance
from ....domains.patrol.trials import Watching, breach_trials
from ....inference.adversarial.tabular.learners import (
    airl_tabular,
    robust_airl_tabular,
    robust_airl_with_learned_sensor,
)
from ....inference.completion.smoothing import evidence_of, smooth_all
from ....inference.sessions.fleets import run_streams
from ....inference.sessions.learner import Learner
from ....models.observation.confusions import Confusions
from ....models.observation.demonstration import PAD, UNKNOWN, Demonstration
from ....models.observation.evidence import Sensor, observe
from ....models.process.mdp import TabularMDP
from ....models.process.planning import deterministic_policy, hard_plan, reward_of, simulate
from ...judging.metrics import optimal_actions, policy_accuracy
from ...judging.returns import seed_interval
from ..noisy.examples import Strip
from .results import CLEAN, LEARNED, NOISY, ROBUST, AdversarialResults, MethodResult

STEPS, LEAST, MOST = 8, 4, 16
SESSIONS = 35
LEVEL = 0.05
ASSUMED = 0.15
"""Probability of both confusions that a learner of the sensor begins with."""

MISREPORT, POLICY = "probability of a wrong observation", "policy of robust-AIRL, first replication"
"""Settings of the results from which :func:`believed_trajectories` are drawn."""


# -- demonstrations -----------------------------------------------------------------------------------


class Streams(NamedTuple):
    """True and observed sessions, ``[R, T, n, L]``; ``pairs [T]`` seen."""

    truth: Demonstration
    seen: Demonstration
    sensor: Sensor
    confusions: Confusions
    pairs: Int[np.ndarray, " T"]


def confusions_of(patrol: Patrol, forward_as_left: float, right_as_forward: float) -> Confusions:
    """Return the two confusions of section 7.4.3."""
    kinds = [(FORWARD, LEFT), (RIGHT, FORWARD)]
    chances = np.array([forward_as_left, right_as_forward])
    return Confusions.of_actions(patrol.mdp.n_states, kinds, chances, patrol.mdp.n_actions)


def noisy_streams(patrol: Patrol, level: float, replications: int, sessions: int, seed: int = 0) -> Streams:
    """Simulate observations of the patroller's greedy expert; the truth is the same at every level."""
    confusions = confusions_of(patrol, level, level)
    sensor = Sensor(None, confusions.noise)
    log_policy = jnp.log(jnp.asarray(patrol.expert_policy()))

    def one(key: Array) -> tuple[Array, Array, Array]:
        act, look = jax.random.split(key)
        states, actions = simulate(act, patrol.mdp, log_policy, STEPS)
        return states, actions, observe(look, sensor, states, actions)

    keys = jax.random.split(jax.random.key(seed), replications * sessions * MOST)
    states, actions, codes = jax.jit(partial(jax.lax.map, one, batch_size=64))(keys)
    # Sizes are those of all replications, so that curves share their axis.
    sizes = np.random.default_rng(seed).integers(LEAST, MOST + 1, sessions)
    there = np.broadcast_to(
        (np.arange(MOST) < sizes[:, None])[..., None], (replications, sessions, MOST, STEPS)
    )

    def shaped(demonstration: Demonstration) -> Demonstration:
        arrays = (np.asarray(x).reshape(there.shape) for x in demonstration.arrays)
        fills = (PAD, UNKNOWN, UNKNOWN, np.nan)
        return Demonstration(
            *(np.where(there, x, f).astype(x.dtype) for x, f in zip(arrays, fills, strict=True))
        )

    truth = shaped(Demonstration.from_pairs(np.asarray(states), np.asarray(actions)))
    seen = shaped(Demonstration.from_codes(np.asarray(codes)))
    return Streams(truth, seen, sensor, confusions, np.cumsum(sizes) * STEPS)


# -- learners, and how they are judged ----------------------------------------------------------------


def noise_learners(patrol: Patrol, sensor: Sensor) -> dict[str, Callable[..., Learner]]:
    """Return each method's factory of learners, given options; only AIRL on clean input sees the truth."""
    mdp = patrol.mdp
    return {
        CLEAN: partial(airl_tabular, mdp),
        NOISY: partial(airl_tabular, mdp),
        ROBUST: partial(robust_airl_tabular, mdp, sensor),
        LEARNED: partial(robust_airl_with_learned_sensor, mdp, confusions_of(patrol, ASSUMED, ASSUMED)),
    }


def greedy_policy_of(mdp: TabularMDP, state: Any) -> Float[Array, "S A"]:
    """Compute the likeliest actions of a learned policy, adversarial or with weights of features."""
    if hasattr(state, "log_policy"):
        return jax.nn.one_hot(jnp.argmax(state.log_policy, axis=1), mdp.n_actions)
    return deterministic_policy(hard_plan(mdp, reward_of(mdp, state.weights)).optimal)


class Outcome(NamedTuple):
    """One learner on all streams.

    Fields
    ------
    accuracy : float ``[R, T]``, LBA over all states of the learned policy's likeliest actions
    policies : float ``[R, S, A]``, the final ones, deterministic
    noise : float ``[R, M]``, learned probabilities of confusions
    """

    accuracy: Float[np.ndarray, "R T"]
    policies: Float[np.ndarray, "R S A"]
    noise: Float[np.ndarray, "R M"]


def outcome_of(patrol: Patrol, learner: Learner, streams: Demonstration, seed: int = 1) -> Outcome:
    """Run a learner over all streams in one compiled program, judged after every session."""
    mdp = patrol.mdp
    optimal = optimal_actions(mdp, jnp.asarray(patrol.weights))

    def judged(state: Any, report: Any) -> tuple:
        accuracy = policy_accuracy(mdp, optimal, greedy_policy_of(mdp, state)).overall
        return accuracy, getattr(report, "noise", jnp.zeros(0))

    states, (accuracy, noise) = run_streams(learner, jax.random.key(seed), streams, judged)
    policies = jax.lax.map(partial(greedy_policy_of, mdp), states)
    return Outcome(np.asarray(accuracy), np.asarray(policies), np.asarray(noise)[:, -1])


def success_rates(
    patrol: Patrol, policies: Float[np.ndarray, "R S A"], trials: int, seed: int = 2
) -> Float[np.ndarray, " R"]:
    """Compute the share of breaches that reach the goal undetected, with each replication's policy for both
    patrollers.

    The learner observes everything exactly while it waits, so only the policies differ.
    """
    rates = []
    for i, policy in enumerate(policies):
        both = jnp.broadcast_to(jnp.log(jnp.asarray(policy)), (patrol.patrollers, *policy.shape))
        outcome = breach_trials(
            jax.random.fold_in(jax.random.key(seed), i),
            patrol,
            both,
            watching=Watching(100, STEPS),
            trials=trials,
        )
        rates.append(outcome.rate())
    return np.array(rates)


def interval(values: Float[np.ndarray, "R ..."]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean over replications and half its 95 % interval (Student), zero for one replication."""
    band = seed_interval(values)
    return band.mean, np.nan_to_num(band.high - band.mean)


# -- the study ----------------------------------------------------------------------------------------


class _Run(NamedTuple):
    """One seed of one method: ``accuracy [T]``, ``seconds [T]``, the last state, and learned confusions."""

    accuracy: list[float]
    seconds: list[float]
    state: Any
    noise: Float[np.ndarray, " M"]


def patrol_results(
    replications: int,
    sessions: int | None = None,
    noise: float = 1.0,
    *,
    trials: int = 40,
    iterations: int = 30,
    advance: Callable[[str, float | None], None] = lambda text, share: None,
) -> AdversarialResults:
    """Run AIRL on the truth and on observations, and robust-AIRL with the sensor given or learned.

    Parameters
    ----------
    replications : int
    sessions : int, optional
        35 by default.
    noise : float
        Times the 5 % of both confusions.
    trials : int
        Breaches simulated with each learned policy.
    iterations : int
        Of discriminator and generator in a session.
    advance : callable
        Called with a description and the share done.

    Raises
    ------
    ValueError
        For fewer than one replication, session or trial, and for noise that gives no probability of the
        confusions.
    """
    sessions = SESSIONS if sessions is None else sessions
    for count, what in ((replications, "seed"), (sessions, "session"), (trials, "trial of a breach")):
        if operator.index(count) < 1:
            raise ValueError(f"there must be at least one {what}, got {count}")
    if not 0 < noise * LEVEL <= 1:
        raise ValueError(
            f"noise multiplies the probability of {LEVEL:g} that an observation errs; it must be "
            f"above 0 and at most {1 / LEVEL:g}; got {noise}"
        )
    level, patrol = noise * LEVEL, instance(2)
    streams = noisy_streams(patrol, level, replications, sessions)
    learners = {
        name: make(forgetting=0.0, iterations=iterations)
        for name, make in noise_learners(patrol, streams.sensor).items()
    }
    learners[CLEAN] = learners[NOISY]  # compiled once
    methods, noises, first = {}, [], np.zeros(0)
    for i, (name, learner) in enumerate(learners.items()):
        given = streams.truth if name == CLEAN else streams.seen
        repeats = []
        for seed in range(replications):
            repeats.append(_run(patrol, learner, _at(given, seed), seed))
            share = (i + (seed + 1) / replications) / len(learners)
            advance(f"{name}, seed {seed}: LBA {repeats[-1].accuracy[-1]:.1%}", share)
        policies = np.array([greedy_policy_of(patrol.mdp, r.state) for r in repeats])
        methods[name] = MethodResult(
            streams.pairs,
            np.array([r.accuracy for r in repeats]),
            breaches=success_rates(patrol, policies, trials),
            seconds=float(np.median([r.seconds[1:] for r in repeats])) if sessions > 1 else None,
        )
        if name == ROBUST:
            first = np.exp(np.asarray(repeats[0].state.log_policy))
        if name == LEARNED:
            noises = [r.noise.tolist() for r in repeats]
    true = np.broadcast_to(patrol.expert_policy(), (replications, *first.shape))
    percent = f"{100 * level:.3g} %"
    return AdversarialResults(
        "patrol",
        f"moving forward is observed as turning left, and turning right as moving forward, {percent} of the "
        "time each; states are observed correctly",
        replications,
        "",
        methods,
        accuracy_over=f"all {patrol.mdp.n_states} states",
        settings={
            MISREPORT: level,
            "sessions": sessions,
            "iterations": iterations,
            "memory of earlier sessions": 0.0,
            "trials of a breach, a policy": trials,
            "probability of a wrong observation, before learning": ASSUMED,
            "learned probabilities of wrong observations, a row a replication": noises,
            POLICY: first.round(6).tolist(),
        },
        expert_breaches=float(success_rates(patrol, true, trials).mean()),
    )


def _run(patrol: Patrol, learner: Learner, sessions: Demonstration, seed: int) -> _Run:
    optimal = optimal_actions(patrol.mdp, jnp.asarray(patrol.weights))
    state = learner.init(jax.random.key(seed))
    accuracy, seconds = [], []
    for session in range(len(sessions.kind)):
        state, report = learner.update(state, _at(sessions, session))
        policy = greedy_policy_of(patrol.mdp, state)
        accuracy.append(float(policy_accuracy(patrol.mdp, optimal, policy).overall))
        seconds.append(report.seconds)
    return _Run(accuracy, seconds, state, np.asarray(report.noise))


def _at(demonstrations: Demonstration, place: Any) -> Demonstration:
    """Select the part of arrays with leading axes."""
    return Demonstration(*(np.asarray(x)[place] for x in demonstrations.arrays))


def believed_trajectories(results: AdversarialResults) -> Sequence[tuple[Strip, TabularMDP]]:
    """Complete a new trajectory with an error by robust-AIRL of the first replication, after learning.

    None if every observation is right in 64 sessions.
    """
    patrol, level = instance(2), results.settings[MISREPORT]
    streams = noisy_streams(patrol, level, replications=1, sessions=64, seed=1)
    wrong = (streams.seen.action != streams.truth.action).any(-1)
    if not wrong.any():
        return ()
    place = tuple(np.argwhere(wrong)[0])
    seen, truth = (_at(d, (*place, None)) for d in (streams.seen, streams.truth))
    log_policy = jnp.log(jnp.asarray(results.settings[POLICY]))
    posterior = smooth_all(patrol.mdp, log_policy, evidence_of(patrol.mdp, streams.sensor, seen)).pairs
    return ((Strip(seen, truth, np.asarray(posterior)[0]), patrol.mdp),)
