"""Study of adversarial learners under noisy perception: Tables 7.3 and 7.4, Figures 7.12 and 7.13.

Each replication and method has one online learner: every session it is given one new demonstration and trains
for the same number of environment steps. Methods differ in their input (the truth or observations) and in
their learner. The true reward and the expert, hidden from learning, judge every session.

Runs are independent, so processes may share them and store them on disk one by one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from ....domains.robots.experts import load_demonstrations
from ....domains.robots.simulation import LEVELS, Perturbed, Trajectories, graded_mix, simulate
from ....domains.robots.walkers import ROBOTS, locomotion
from ....inference.adversarial.discriminator import airl_discriminator
from ....inference.adversarial.learner import AdversarialTraining, adversarial
from ....inference.adversarial.noise_injection import NoisyTraining
from ....inference.adversarial.policy_optimisation import ppo
from ....inference.adversarial.robust import Smoothed, robust_airl, robust_airl_with_sensor
from ....inference.adversarial.self_supervised import SSRRTraining, ssrr
from ....inference.adversarial.snippets import Regression
from ....inference.sessions.learner import Learner
from ....models.inputs.archives import StorageError
from ....models.observation.recordings import Recording, distort
from ...judging.returns import EmpiricalILE, bounded_ile, returns_at_fixed_length
from .cases import Case, Plan, case
from .results import (
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
    read_plain,
    reward_scatter,
)

STUDIED = (CLEAN, NOISY, ROBUST, LEARNED, SSRR)


class Outcome(NamedTuple):
    """Result of one replication of a method.

    Fields
    ------
    pairs, steps : int ``[T]``, observed pairs and environment steps after each session
    returns, accuracy : float ``[T]``
    seconds : float ``[T]``
    scatter : RewardScatter
    error : EmpiricalILE
    sensor : float ``[T, p]``, the learned sensor (a covariance's diagonal); else empty
    episode : float ``[t, d]``, the beginning of an episode of the learned policy
    belief : Belief or None
    cells : float ``[Q, Q]``, LBA of each cell; empty where there are none
    """

    pairs: Int[np.ndarray, " T"]
    steps: Int[np.ndarray, " T"]
    returns: Float[np.ndarray, " T"]
    accuracy: Float[np.ndarray, " T"]
    seconds: Float[np.ndarray, " T"]
    scatter: RewardScatter
    error: EmpiricalILE
    sensor: Float[np.ndarray, "T p"]
    episode: Float[np.ndarray, "t d"]
    belief: Belief | None
    cells: Float[np.ndarray, "Q Q"]


@lru_cache(maxsize=8)
def learner(name: str, method: str, plan: Plan) -> Learner:
    """Make the learner of a task by a method; compiled once a process. ``ValueError`` for another method."""
    if method not in STUDIED:
        raise ValueError(f"the method is one of {'; '.join(STUDIED)}; got {method!r}")
    of = case(name, plan)
    task = of.environment
    agent = ppo(task, **dict(plan.settings))
    discriminator = airl_discriminator(task.observation_size, task.actions, agent.settings.gamma)
    training = AdversarialTraining(
        plan.iterations,
        plan.updates,
        plan.batch,
        plan.learning_rate,
        penalty=plan.penalty,
        refresh=plan.iterations,
    )
    if method in (CLEAN, NOISY):
        return adversarial("AIRL", agent, discriminator, training=training)
    if method == ROBUST:
        return robust_airl(
            agent, of.truth(draws=_DRAWS), of.sensor, discriminator=discriminator, training=training
        )
    if method == LEARNED:
        return robust_airl_with_sensor(
            agent, of.truth(draws=_DRAWS), of.assumed, of.fit, discriminator=discriminator, training=training
        )
    # The same steps in all: ranking takes some, and the rest is halved between imitation and the end.
    sessions = plan.sessions // _gathered(method, plan)
    ranking = len(_SSRR_LEVELS) * _SSRR_EPISODES * task.horizon / agent.settings.steps
    half = max(int((plan.sessions * plan.iterations / sessions - ranking) // 2), 1)
    return ssrr(
        agent,
        airl_discriminator(task.observation_size, task.actions, agent.settings.gamma, state_only=True),
        NoisyTraining(half, plan.updates, plan.batch, plan.learning_rate),
        SSRRTraining(
            _SSRR_LEVELS, _SSRR_EPISODES, _REGRESSION, iterations=half, average="median", start="first"
        ),
    )


_DRAWS = 4
_SSRR_LEVELS = tuple(0.05 * i for i in range(16))
_SSRR_EPISODES, _SSRR_SESSIONS = 3, 2
_REGRESSION = Regression(
    hidden=(64, 64), points=32, iterations=1000, learning_rate=1e-3, deviation=0.1
)  # of a session, the networks being carried on


def _gathered(method: str, plan: Plan) -> int:
    """Return the number of sessions that are learned from at once: SSRR's ranking needs a long session."""
    halved = method == SSRR and plan.sessions % _SSRR_SESSIONS == 0
    return plan.sessions // _SSRR_SESSIONS if halved else 1


def run(name: str, method: str, seed: int, plan: Plan) -> Outcome:
    """Run one replication of one method."""
    of = case(name, plan)
    k_learner, k_noise, k_judge = jax.random.split(jax.random.key(seed), 3)
    online = learner(name, method, plan)
    state = online.init(k_learner)
    rows: list[tuple] = []
    sensors = []
    gathered = _gathered(method, plan)
    for session in range(plan.sessions // gathered):
        truth = _session(of.demonstrations, session, seed, gathered * plan.trajectories)
        observed = distort(jax.random.fold_in(k_noise, session), of.sensor, truth)
        given: Any = truth if method == CLEAN else observed
        report: Any
        state, report = online.update(state, given)
        policy = state.generator.policy
        returns = returns_at_fixed_length(
            of.level, policy, jax.random.fold_in(k_judge, session), plan.episodes, None, deterministic=True
        )
        accuracy = of.accuracy(policy, k_judge)
        rows.append((report.pairs, report.environment_steps, returns.mean(), accuracy, report.seconds))
        if method == LEARNED:
            sensors.append(_sensor_numbers(state.sensor))
    pairs, steps, seen_returns, accuracies, seconds = map(np.array, zip(*rows, strict=True))
    return Outcome(
        pairs,
        steps,
        seen_returns,
        accuracies,
        seconds,
        _scatter(name, plan, state.network, seed),
        _error(of, state.network, policy, k_judge),
        np.array(sensors) if sensors else np.zeros((0, 0)),
        simulate(of.level, policy, k_judge, 1, 200, deterministic=True).observations[0],
        _belief(of, policy, truth, observed) if method == ROBUST else None,
        of.cells(policy) if of.cells else np.zeros((0, 0)),
    )


def _sensor_numbers(sensor: Any) -> Float[np.ndarray, " p"]:
    parts = [np.asarray(x, float) for x in jax.tree.leaves(sensor)]
    return np.concatenate([np.diag(x) if x.ndim == 2 else np.ravel(x) for x in parts])


def _session(whole: Recording, session: int, seed: int, trajectories: int) -> Recording:
    """Return a session's demonstrations: the next ones in order, from another place for another seed."""
    total = whole.live.shape[0]
    order = np.random.default_rng(seed).permutation(total)
    places = (session * trajectories + np.arange(trajectories)) % total
    return Recording(*(jnp.asarray(x)[order[places]] for x in whole))


@lru_cache(maxsize=4)
def _held_out(name: str, plan: Plan) -> tuple[Trajectories, np.ndarray]:
    """Simulate episodes of the expert, disturbed to several degrees; the same for all methods and
    replications.
    """
    of = case(name, plan)
    policies = [Perturbed(of.expert, share) for share in LEVELS]
    return graded_mix(of.level, policies, jax.random.key(20), 20, of.held_out)


def _learned_reward(network: Any, observations: ArrayLike, actions: ArrayLike) -> np.ndarray:
    return np.asarray(network(jnp.asarray(observations), jnp.asarray(actions)), float)


def _scatter(name: str, plan: Plan, network: Any, seed: int) -> RewardScatter:
    episodes, whose = _held_out(name, plan)
    learned = _learned_reward(network, episodes.observations, episodes.actions)
    return reward_scatter(learned, episodes.rewards, episodes.live, whose, jax.random.key(seed))


def _error(of: Case, network: Any, policy: Any, key: Array) -> EmpiricalILE:
    """Compute ILE under the learned reward: the demonstration before noise, and the learner's behaviour."""
    shown = of.demonstrations
    own = simulate(of.level, policy, key, 10, shown.live.shape[1], deterministic=True)
    return bounded_ile(
        _learned_reward(network, shown.observations, shown.actions),
        np.asarray(shown.live),
        _learned_reward(network, own.observations, own.actions),
        own.live,
    )


def _belief(of: Case, policy: Any, truth: Recording, observed: Recording) -> Belief:
    """Complete the beginning of the last demonstration under the last policy."""
    names, columns = of.components
    steps = min(_SHOWN_STEPS, int(observed.lengths[0]))

    def first(recording: Recording) -> Recording:
        observations, actions, live = (x[:1, :steps] for x in recording[:3])
        return Recording(observations, actions, live, jnp.zeros(1, bool))

    hidden = Smoothed(of.truth(draws=64), of.sensor)
    begun = hidden.begin(first(observed), of.sensor, jax.random.key(0))
    _, drawn = hidden.refresh(begun, of.sensor, policy, jax.random.key(0))
    d = truth.observations.shape[-1]

    def picked(observations: Any, actions: Any) -> np.ndarray:
        parts = [np.asarray(observations)]
        if max(columns) >= d:
            parts.append(np.asarray(actions))
        return np.concatenate(parts, -1)[..., list(columns)]

    return belief_from_draws(
        names,
        picked(first(observed).observations[0], first(observed).actions[0]),
        picked(first(truth).observations[0], first(truth).actions[0]),
        np.moveaxis(picked(drawn.steps.observations, drawn.steps.actions), 1, 0),
    )


_SHOWN_STEPS = 100


# -- all replications and methods ----------------------------------------------------------------------------


def adversarial_study(
    name: str,
    replications: int = 5,
    plan: Plan | None = None,
    methods: Sequence[str] = STUDIED,
    *,
    workers: int = 1,
    folder: Path | None = None,
    machine: str = "",
    advance: Callable[[str, float | None], None] = lambda text, share: None,
) -> AdversarialResults:
    """Run all replications of all methods on one task.

    Finished runs in ``folder`` are loaded, and new ones are stored there. Raises ``ValueError`` for another
    name than :data:`~i2rl.analysis.studies.adversarial.cases.PLANS` has, and for fewer than one replication
    or session.

    See Also
    --------
    i2rl.inference.airl : one of its learners
    i2rl.inference.robust_airl : another
    i2rl.domains.load_demonstrations : the experts' episodes

    Examples
    --------
    >>> from i2rl.analysis import adversarial_study
    >>> from i2rl.analysis.studies.adversarial.cases import PLANS
    >>> quick = PLANS["mountain-car"]._replace(sessions=1, iterations=1, episodes=2)
    >>> results = adversarial_study("mountain-car", 1, quick, ["AIRL, clean input"])
    >>> {name: result.returns.shape for name, result in results.methods.items()}
    {'AIRL, clean input': (1, 1)}
    """
    if replications < 1:
        raise ValueError(f"replications must be at least 1; got {replications}")
    of = case(name, plan)
    if of.plan.sessions < 1:
        raise ValueError(f"there must be at least one session, got {of.plan.sessions}")
    wanted = [(method, seed) for seed in range(replications) for method in methods]
    outcomes = {}
    for done, (which, outcome) in enumerate(_all_runs(name, wanted, of.plan, workers, folder)):
        outcomes[which] = outcome
        method, seed = which
        advance(f"{method}, seed {seed}: return {outcome.returns[-1]:.0f}", (done + 1) / len(wanted))
    by_method = {m: [outcomes[m, seed] for seed in range(replications)] for m in methods}
    shown = {m: repeats[0] for m, repeats in by_method.items()}
    return AdversarialResults(
        name,
        of.noise,
        replications,
        machine,
        {m: _result(repeats) for m, repeats in by_method.items()},
        accuracy_over=of.accuracy_over,
        expert_return=of.expert_return,
        scatters={m: outcome.scatter for m, outcome in shown.items()},
        belief=shown[ROBUST].belief if ROBUST in shown else None,
        frames=_frames(name, shown),
        cells={m: np.mean([r.cells for r in repeats], 0) for m, repeats in by_method.items()}
        if of.cells
        else {},
        settings=_settings(of.plan, by_method),
    )


def _frames(name: str, shown: Mapping[str, Outcome]) -> tuple[FrameStrip, ...]:
    if name not in ROBOTS:
        return ()
    robot = locomotion(name)
    expert = frame_strip("expert", robot, load_demonstrations(name).observations[0])
    return (expert, *(frame_strip(m, robot, outcome.episode) for m, outcome in shown.items()))


def _settings(plan: Plan, repeats: Mapping[str, Sequence[Outcome]]) -> dict[str, Any]:
    """Return the file's settings: the plan, the budget of each method, and the learned sensor."""
    told = {**{k: v for k, v in plan._asdict().items() if k != "settings"}, **dict(plan.settings)}
    told["environment steps"] = {m: int(outcomes[0].steps[-1]) for m, outcomes in repeats.items()}
    if LEARNED in repeats:
        told["learned sensor, a row a replication"] = [o.sensor[-1].tolist() for o in repeats[LEARNED]]
    return told


def _result(repeats: Sequence[Outcome]) -> MethodResult:
    return MethodResult(
        repeats[0].pairs,
        np.array([r.accuracy for r in repeats]),
        np.array([r.returns for r in repeats]),
        tuple(r.scatter.correlation for r in repeats),
        tuple(r.error for r in repeats),
        seconds=float(np.median([r.seconds[1:] for r in repeats])) if len(repeats[0].seconds) > 1 else None,
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
    """Load a finished replication from disk."""
    if folder is None:
        return run(name, method, seed, plan)
    path = Path(folder) / name / f"{plan.digest}-{method.replace(' ', '_').replace(',', '')}-{seed}.json"
    if path.exists():
        fields = read_plain(path)
        if not isinstance(fields, dict) or fields.keys() != set(Outcome._fields):
            raise StorageError(
                f"{path}: the file must hold a finished replication; delete it to run it again"
            )
        return Outcome(**fields)
    outcome = run(name, method, seed, plan)
    path.parent.mkdir(parents=True, exist_ok=True)
    # In one step: an interrupted replication must not leave half a file, which a later run would load.
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(outcome._asdict())))
    part.replace(path)
    return outcome
