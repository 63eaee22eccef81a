"""The study of adversarial learners under noisy perception: Tables 7.3 and 7.4, Figures 7.12 and 7.13.

For each seed and method one online learner: in every session it is given one new demonstration and trains
for the same number of environment steps. Methods differ in what they are given (the truth or reports) and in
what they make of it. Every session is judged by what learning never sees: the true reward and the expert.

Runs are independent, so they may be shared out over processes and kept on disk one by one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..domains.experts import load_demonstrations, load_expert
from ..domains.locomotion import ROBOTS, locomotion
from ..domains.simulation import LEVELS, Perturbed, Trajectories, graded_mix, simulate
from ..inference.airl import Training, adversarial
from ..inference.discriminator import airl_discriminator
from ..inference.gaussian_truth import gaussian_truth
from ..inference.noisy_airl import NoisyTraining
from ..inference.ppo import ppo
from ..inference.robust_airl import robust_airl, robust_airl_with_sensor
from ..inference.session import Learner
from ..inference.ssrr import Regression, SSRRTraining, ssrr
from ..models.sensing import GaussianSensor, Recording, distort
from .adversarial_metrics import behaviour_accuracies, returns_at_fixed_length
from .adversarial_results import (
    CLEAN,
    LEARNED,
    NOISY,
    ROBUST,
    SSRR,
    AdversarialResults,
    Belief,
    FrameStrip,
    MethodResult,
    RewardScatter,
    belief_from_draws,
    frame_strip,
    plain,
    rebuilt,
    reward_scatter,
)

STUDIED = (CLEAN, NOISY, ROBUST, LEARNED, SSRR)


class Plan(NamedTuple):
    """How a robot is learned from.

    Fields
    ------
    sessions : int
    rounds : int, of discriminator and generator in a session; SSRR shares them out over its two policies
    covariance : float, of the sensor, for states and actions
    assumed : float, what is believed of it where it is learned
    trajectories : int, demonstrated in a session
    length : int, steps of each
    updates, batch : int, of the discriminator in a round
    penalty : float, of its gradient
    process : float, ``Q``
    episodes : int, judged in every session
    settings : of PPO, as pairs
    """

    sessions: int = 10
    rounds: int = 25
    covariance: float = 0.05
    assumed: float = 0.02
    trajectories: int = 1
    length: int = 1000
    updates: int = 16
    batch: int = 256
    penalty: float = 1.0
    process: float = 1e-4
    episodes: int = 8
    settings: tuple[tuple[str, Any], ...] = (
        ("n_envs", 20),
        ("n_steps", 128),
        ("hidden", (64, 64)),
        ("log_deviation", -0.5),
        ("scale_rewards", True),
    )

    @property
    def digest(self) -> str:
        """Short name of all settings."""
        return hashlib.sha256(json.dumps(self).encode()).hexdigest()[:12]


PLANS = {
    "hopper": Plan(),
    "walker2d": Plan(),
    "half-cheetah": Plan(),
}


class Outcome(NamedTuple):
    """One run.

    Fields
    ------
    pairs, steps : int ``[T]``, reported pairs and environment steps after each session
    returns, accuracy : float ``[T]``
    seconds : float ``[T]``
    scatter : RewardScatter
    sensor : float ``[T, d + k]``, the diagonal of the learned covariance; else empty
    episode : float ``[t, d]``, the beginning of an episode of what was learned
    belief : Belief or None
    """

    pairs: Int[np.ndarray, " T"]
    steps: Int[np.ndarray, " T"]
    returns: Float[np.ndarray, " T"]
    accuracy: Float[np.ndarray, " T"]
    seconds: Float[np.ndarray, " T"]
    scatter: RewardScatter
    sensor: Float[np.ndarray, "T D"]
    episode: Float[np.ndarray, "t d"]
    belief: Belief | None


@lru_cache(maxsize=8)
def learner(name: str, method: str, plan: Plan) -> Learner:
    """The learner of a robot by a method; compiled once a process."""
    robot = locomotion(name)
    size, k = robot.observation_size, robot.actions.size
    agent = ppo(robot, **dict(plan.settings))
    discriminator = airl_discriminator(size, robot.actions, agent.settings.gamma)
    training = Training(plan.rounds, plan.updates, plan.batch, penalty=plan.penalty, refresh=plan.rounds)
    common = {"discriminator": discriminator, "training": training, **_truth(name, plan)}
    if method in (CLEAN, NOISY):
        return adversarial("AIRL", agent, discriminator, training=training)
    if method == ROBUST:
        sensor = GaussianSensor(plan.covariance, plan.covariance).sized(size, k)
        return robust_airl(agent, sensor, robot, **common)
    if method == LEARNED:
        assumed = GaussianSensor(plan.assumed, plan.assumed).sized(size, k)
        return robust_airl_with_sensor(agent, assumed, robot, **common)
    # The same steps in all: ranking costs some, and the rest is halved between imitation and the end.
    levels = tuple(0.1 * i for i in range(10))
    ranking = len(levels) * robot.horizon / agent.settings.steps
    half = max(int((plan.rounds - ranking) // 2), 1)
    return ssrr(
        agent,
        airl_discriminator(size, robot.actions, agent.settings.gamma, state_only=True),
        NoisyTraining(rounds=half, updates=plan.updates, batch=plan.batch),
        SSRRTraining(levels, 1, Regression(hidden=(64, 64), iterations=300), rounds=half),
    )


def _truth(name: str, plan: Plan) -> dict[str, Any]:
    """What smoothing is told of a robot: how exact its dynamics are, and what is cut off."""
    robot = locomotion(name)
    limit = np.full(robot.observation_size, np.inf)
    if name != "half-cheetah":  # Gymnasium shows velocities of these up to 10 only
        limit[(robot.observation_size + 1) // 2 - 1 :] = 10.0
    bounds = {"observation_bounds": (-limit, limit), "action_bounds": (robot.actions.low, robot.actions.high)}
    return {"process_covariance": plan.process, **bounds}


def run(name: str, method: str, seed: int, plan: Plan) -> Outcome:
    """One seed of one method."""
    robot = locomotion(name)
    level = locomotion(name, terminate_when_unhealthy=False)
    expert = load_expert(name)
    whole = load_demonstrations(name).recording
    k_learner, k_noise, k_judge = jax.random.split(jax.random.key(seed), 3)
    sensor = GaussianSensor(plan.covariance, plan.covariance).sized(
        robot.observation_size, robot.actions.size
    )
    online = learner(name, method, plan)
    state = online.init(k_learner)
    rows: list[tuple] = []
    learned_sensor = []
    reported = truth = _session(whole, 0, seed, plan)
    for session in range(plan.sessions):
        truth = _session(whole, session, seed, plan)
        reported = distort(jax.random.fold_in(k_noise, session), sensor, truth)
        state, report = online.update(state, truth if method == CLEAN else reported)  # type: ignore[arg-type]
        policy = state.generator.policy
        returns = returns_at_fixed_length(
            level, policy, jax.random.fold_in(k_judge, session), plan.episodes, deterministic=True
        )
        agreement = behaviour_accuracies(level, expert, policy, k_judge, 2, 500)
        rows.append(
            (report.pairs, report.environment_steps, returns.mean(), agreement.expert, report.seconds)
        )
        if method == LEARNED:
            learned_sensor.append(np.concatenate([np.diag(np.asarray(c)) for c in state.sensor]))
    pairs, steps, returns, accuracy, seconds = map(np.array, zip(*rows, strict=True))
    belief = _belief(name, policy, truth, reported, sensor, plan) if method == ROBUST else None
    episode = simulate(level, policy, k_judge, 1, 200, deterministic=True).observations[0]
    scatter = _scatter(name, state.network, seed)
    found = np.array(learned_sensor) if learned_sensor else np.zeros((0, 0))
    return Outcome(pairs, steps, returns, accuracy, seconds, scatter, found, episode, belief)


def _session(whole: Recording, session: int, seed: int, plan: Plan) -> Recording:
    """A session's demonstrations: the next of the recorded ones, from a step that the seed says."""
    total = whole.live.shape[0]
    chosen = [(seed + session * plan.trajectories + i) % total for i in range(plan.trajectories)]
    spare = whole.live.shape[1] - plan.length
    first = int(np.random.default_rng([seed, session]).integers(spare + 1))
    steps = slice(first, first + plan.length)
    rows = np.array(chosen)
    return Recording(
        whole.observations[rows, steps],
        whole.actions[rows, steps],
        whole.live[rows, steps],
        whole.terminated[rows] & (spare == 0),
    )


@lru_cache(maxsize=4)
def _held_out(name: str) -> tuple[Trajectories, np.ndarray]:
    """A hundred episodes of the expert, disturbed to five degrees; the same for all methods and seeds."""
    level = locomotion(name, terminate_when_unhealthy=False)
    policies = [Perturbed(load_expert(name), share) for share in LEVELS]
    return graded_mix(level, policies, jax.random.key(20), 20, 200)


def _scatter(name: str, network: Any, seed: int) -> RewardScatter:
    """Any learned reward of state and action, or of the state alone, on the held-out episodes."""
    episodes, whose = _held_out(name)
    seen, done = jnp.asarray(episodes.observations), jnp.asarray(episodes.actions)
    learned = network(seen) if network.__class__.__name__ == "SSRRReward" else network(seen, done)
    return reward_scatter(np.asarray(learned), episodes.rewards, episodes.live, whose, jax.random.key(seed))


def _belief(
    name: str, policy: Any, truth: Recording, reported: Recording, sensor: GaussianSensor, plan: Plan
) -> Belief:
    """What the last policy makes of the beginning of the last demonstration."""
    robot, shown = locomotion(name), slice(0, 100)
    cut = Recording(
        *(x[:1, shown] if x.ndim > 1 else x[:1] & False for x in (reported.observations, reported.actions,
          reported.live, reported.terminated))
    )  # fmt: skip
    smoother = gaussian_truth(robot, robot.observation_size, draws=64, **_truth(name, plan))
    chain = smoother.init(cut, sensor)
    _, drawn = smoother.refresh(chain, policy, jax.random.key(0), sensor, passes=6)
    names, columns = _COMPONENTS[name]
    k = robot.observation_size

    def picked(observations: Array, actions: Array) -> np.ndarray:
        return np.concatenate([np.asarray(observations), np.asarray(actions)], -1)[..., [*columns, k]]

    return belief_from_draws(
        (*names, "first joint's torque (share)"),
        picked(cut.observations[0], cut.actions[0]),
        picked(truth.observations[0, shown], truth.actions[0, shown]),
        picked(drawn.observations[:, 0], drawn.actions[:, 0]),
    )


_COMPONENTS = {
    "hopper": (("height (m)", "forward speed (m/s)"), (0, 5)),
    "walker2d": (("height (m)", "forward speed (m/s)"), (0, 8)),
    "half-cheetah": (("pitch (rad)", "forward speed (m/s)"), (1, 8)),
}


# -- all seeds and methods ----------------------------------------------------------------------------


def study(
    name: str,
    seeds: int = 5,
    plan: Plan | None = None,
    methods: Sequence[str] = STUDIED,
    *,
    workers: int = 1,
    folder: Path | None = None,
    machine: str = "",
    advance: Callable[[str, float | None], None] = lambda text, share: None,
) -> AdversarialResults:
    """All seeds of all methods of one robot.

    Runs found in ``folder`` are not run again, and new ones are kept there. Raises ``ValueError`` for a name
    that is no robot's and for fewer than one seed.
    """
    if name not in ROBOTS:
        raise ValueError(f"the robot is one of {', '.join(ROBOTS)}; got {name!r}")
    if seeds < 1:
        raise ValueError(f"there must be at least one seed, got {seeds}")
    plan = PLANS[name] if plan is None else plan
    wanted = [(method, seed) for seed in range(seeds) for method in methods]
    outcomes = {}
    for done, (which, outcome) in enumerate(_all_runs(name, wanted, plan, workers, folder)):
        outcomes[which] = outcome
        method, seed = which
        advance(f"{method}, seed {seed}: return {outcome.returns[-1]:.0f}", (done + 1) / len(wanted))
    by_method = {m: [outcomes[m, seed] for seed in range(seeds)] for m in methods}
    shown = {m: runs[0] for m, runs in by_method.items()}
    robot = locomotion(name)
    frames: list[FrameStrip] = [frame_strip("expert", robot, load_demonstrations(name).observations[0])]
    frames += [frame_strip(m, robot, outcome.episode) for m, outcome in shown.items()]
    settings = {
        **{k: v for k, v in plan._asdict().items() if k != "settings"},
        **dict(plan.settings),
        "environment steps": int(shown[methods[0]].steps[-1]),
    }
    if LEARNED in by_method:
        last = [outcome.sensor[-1].tolist() for outcome in by_method[LEARNED]]
        settings["learned covariance, a row a seed"] = last
    return AdversarialResults(
        name,
        f"normal, covariance {plan.covariance:g} of every state and action",
        seeds,
        machine,
        {m: _result(runs) for m, runs in by_method.items()},
        accuracy_over="the expert's own states",
        expert_return=float(load_demonstrations(name).returns.mean()),
        scatters={m: outcome.scatter for m, outcome in shown.items()},
        belief=shown[ROBUST].belief if ROBUST in shown else None,
        frames=tuple(frames),
        settings=settings,
    )


def _result(runs: Sequence[Outcome]) -> MethodResult:
    return MethodResult(
        runs[0].pairs,
        np.array([r.accuracy for r in runs]),
        np.array([r.returns for r in runs]),
        tuple(r.scatter.correlation for r in runs),
        seconds=float(np.median([r.seconds[1:] for r in runs])) if len(runs[0].seconds) > 1 else None,
    )


def _all_runs(
    name: str, wanted: Sequence[tuple[str, int]], plan: Plan, workers: int, folder: Path | None
) -> Iterator[tuple[tuple[str, int], Outcome]]:
    if workers <= 1:
        for method, seed in wanted:
            yield (method, seed), _kept(name, method, seed, plan, folder)
        return
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        futures = [(which, pool.submit(_kept, name, *which, plan, folder)) for which in wanted]
        for which, future in futures:
            yield which, future.result()


def _kept(name: str, method: str, seed: int, plan: Plan, folder: Path | None) -> Outcome:
    """A run, from disk where it was kept."""
    if folder is None:
        return run(name, method, seed, plan)
    path = Path(folder) / name / f"{plan.digest}-{method.replace(' ', '_').replace(',', '')}-{seed}.json"
    if path.exists():
        return Outcome(**rebuilt(json.loads(path.read_text())))
    outcome = run(name, method, seed, plan)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(plain(outcome._asdict())))
    return outcome
