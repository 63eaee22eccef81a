"""Cost of a session of learning through noisy perception: RIMEO against RIFOM, and how it grows.

``python -m i2rl.analysis.benchmarks.cost.noisy`` measures, once everything is compiled:

- seconds of a session (two trajectories of three pairs) on noisy sorting and noisy patrol, of RIFOM, of RIMEO
  in its three uses of scores, and of RIMEO by IPOPT; learners take turns within one stream, so that they
  share what else the machine does, and ratios are of the same sessions;
- seconds of the parts of a session of RIMEO, each compiled alone;
- seconds of a session against the number of predicates, of states, and of pairs in a session, with the
  exponent of a power of that number fitted to the medians.

Section 6.1.4 states that "the complexity of each iteration of each session is ``O(m |Xi_d| L N_sa + L K + m^2
n_bfgs + eta)``, where ``eta = n_RL + n_desc``": ``m`` predicates, ``|Xi_d|`` trajectories of ``L`` steps,
``N_sa`` pairs, ``K`` features, and three numbers of iterations taken for constants. It is linear in pairs
``N_sa``, linear in the steps of a session, and of degree two in ``m``. Two costs are not in it: planning and
smoothing, and normalising Eq. 6.5, which is a sum over observations for every class of truths. Here that is
``O(C E (m + 1) + E m^2)`` a Newton step for ``C`` classes and ``E`` patterns of agreement, with ``E <=
min(2^m, C^2)``: no polynomial in ``m`` until all pairs differ.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from ....domains.noisy.tasks import NoisyTask, demonstrate_noisy, noisy_patrol, noisy_sorting
from ....domains.object_world.process import random_object_world
from ....inference.completion.smoothing import Evidence, smooth_all
from ....inference.learners.alternation import checked_method, newton
from ....inference.learners.noisy import (
    DEFAULT_FORGETTING,
    DEFAULT_OBSERVATION_SLACK,
    DEFAULT_RIDGE,
    rifom,
    rimeo,
)
from ....inference.programs.maximum_entropy import WarmStart
from ....inference.sensors.observations import (
    fit_sensor,
    report_classes,
    report_log_evidence,
    report_statistic,
    session_reports,
)
from ....inference.sensors.reliabilities import entropic_perception, prepare
from ....inference.sessions.learner import Learner
from ....inference.sessions.statistic import blend, complete
from ....models.observation.demonstration import Demonstration
from ....models.observation.evidence import Sensor
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, simulate, soft_plan
from ..harness import median_seconds, print_table, publish, seconds

REPORTED = "RIMEO, stepwise"
COUNTED = "RIFOM"
# Probability that an observation is any pair.
ASTRAY = 0.1
WARM = 3


class Stream(NamedTuple):
    """Task of a timed learner: a process, predicates ``[J, S, A]``, and sessions of ``trajectories``."""

    mdp: TabularMDP
    predicates: Int[np.ndarray, "J S A"]
    seen: Demonstration
    trajectories: int


class Growth(NamedTuple):
    """Medians against a size, and the exponent of that size fitted to them, with its 95 % interval."""

    sizes: tuple[int, ...]
    seconds: Float[np.ndarray, " N"]
    exponent: float
    low: float
    high: float


def stream_of(task: NoisyTask, sessions: int, trajectories: int = 2, steps: int = 3, seed: int = 0) -> Stream:
    """Simulate scored observations of a noisy task."""
    drawn = demonstrate_noisy(
        jax.random.key(seed),
        task,
        sessions=sessions,
        trajectories=trajectories,
        steps=steps,
        scores="calibrated",
    )
    return Stream(drawn.mdp, task.features, drawn.seen, trajectories)


def random_stream(size: int, predicates: int, sessions: int, *, named: bool = False, seed: int = 0) -> Stream:
    """Simulate a grid of ``size x size`` cells, predicates of its pairs drawn by coin, observations with
    scores.

    With ``named``, state and action have two further labels, so that every pair is a class of its own. A
    tenth of the observations are of any pair; the expert is soft.
    """
    rng = np.random.default_rng(seed)
    world = random_object_world(jax.random.key(seed), size, 0, slip=0.1, discount=0.95)
    mdp = world.mdp
    psi = rng.integers(0, 2, (predicates, *mdp.available.shape))
    if named:
        psi = np.concatenate([psi, np.indices(mdp.available.shape)])
    policy = soft_plan(mdp, reward_of(mdp, 3.0 * jnp.asarray(world.weights))).log_policy
    keys = jax.random.split(jax.random.key(seed), 2 * sessions)
    pairs = [np.asarray(x) for x in jax.vmap(lambda k: simulate(k, mdp, policy, 3))(keys)]
    astray = rng.random(pairs[0].shape) < ASTRAY
    anything = np.argwhere(np.asarray(mdp.available))[rng.integers(0, int(mdp.available.sum()), astray.shape)]
    state, action = (np.where(astray, anything[..., i], pairs[i]) for i in (0, 1))
    seen = Demonstration.from_pairs(state, action)
    return Stream(mdp, psi, replace(seen, score=np.full(state.shape, 1 - ASTRAY)), 2)


def interleaved_seconds(
    learners: Mapping[str, Learner], stream: Stream
) -> dict[str, Float[np.ndarray, " sessions"]]:
    """Measure wall-clock seconds of ``update`` for every session after the first few, by learner.

    Whose turn is first changes from session to session.
    """
    states = {name: learner.init(jax.random.key(0)) for name, learner in learners.items()}
    spent: dict[str, list[float]] = {name: [] for name in learners}
    names = list(learners)
    for number, one in enumerate(stream.seen.sessions(stream.trajectories)):
        for name in names[number % len(names) :] + names[: number % len(names)]:

            def update(name: str = name, one: Demonstration = one) -> None:
                states[name] = learners[name].update(states[name], one)[0]

            spent[name].append(seconds(update))
    return {name: np.array(x[WARM:]) for name, x in spent.items()}


def ratio_of_medians(
    one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"], draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Compute the ratio of medians of paired times, and its 95 % interval by bootstrap over pairs."""
    rows = np.random.default_rng(seed).integers(0, len(one), (draws, len(one)))
    ratios = np.median(one[rows], 1) / np.median(other[rows], 1)
    low, high = np.quantile(ratios, (0.025, 0.975))
    return float(np.median(one) / np.median(other)), float(low), float(high)


def growth(sizes: Sequence[int], medians: Sequence[float]) -> Growth:
    """Fit ``log seconds = a + b log size`` by least squares; the interval is Student's.

    Raises ``ValueError`` for fewer than three sizes.
    """
    if len(sizes) < 3:
        raise ValueError(f"an exponent and its interval take at least three sizes, got {len(sizes)}")
    fit = stats.linregress(np.log(sizes), np.log(medians))
    half = fit.stderr * stats.t.ppf(0.975, len(sizes) - 2)
    return Growth(tuple(sizes), np.asarray(medians), fit.slope, fit.slope - half, fit.slope + half)


def measured_growth(sizes: Sequence[int], make: Callable[[int], Stream]) -> dict[str, Growth]:
    """Measure growth of RIMEO's and RIFOM's session with the streams that ``make`` makes of each size."""
    medians: dict[str, list[float]] = {REPORTED: [], COUNTED: []}
    for size in sizes:
        stream = make(size)
        learners = {
            REPORTED: rimeo(stream.mdp, stream.predicates),
            COUNTED: rifom(stream.mdp, stream.predicates),
        }
        for name, spent in interleaved_seconds(learners, stream).items():
            medians[name].append(float(np.median(spent)))
    return {name: growth(sizes, x) for name, x in medians.items()}


def session_seconds(task: NoisyTask, sessions: int) -> dict[str, dict[str, float]]:
    """Measure seconds of a session by learner, and how many times RIFOM's."""
    stream = stream_of(task, sessions + WARM)
    mdp, psi = stream.mdp, stream.predicates
    spent = interleaved_seconds(
        {
            COUNTED: rifom(mdp, psi),
            "RIMEO, no scores": rimeo(mdp, psi, scores="none"),
            "RIMEO, averaged": rimeo(mdp, psi, scores="averaged"),
            REPORTED: rimeo(mdp, psi),
            "RIMEO, stepwise, by IPOPT": rimeo(mdp, psi, solver="ipopt"),
        },
        stream,
    )
    found = {}
    for name, x in spent.items():
        ratio, low, high = ratio_of_medians(x, spent[COUNTED])
        found[name] = {
            "median": float(np.median(x)),
            "nine in ten below": float(np.quantile(x, 0.9)),
            "times RIFOM": ratio,
            "from": low,
            "to": high,
        }
    return found


def part_seconds(task: NoisyTask, sessions: int = 20, replications: int = 200) -> dict[str, float]:
    """Measure seconds of each part of RIMEO's session, with scores step by step, compiled alone.

    At the state that a learner is in after ``sessions``. Reports are prepared once, the two fits occur
    as often as a session alternates (twice by default), the others once more.
    """
    stream = stream_of(task, sessions)
    mdp, classes = stream.mdp, report_classes(stream.predicates)
    learner = rimeo(mdp, stream.predicates)
    state = learner.init(jax.random.key(0))
    for one in stream.seen.sessions(stream.trajectories):
        state, _ = learner.update(state, one)
    method = checked_method(mdp, Sensor(), "seen", "exact", 0.0, DEFAULT_RIDGE, 0)
    perception = entropic_perception(
        classes, "stepwise", "posterior", DEFAULT_OBSERVATION_SLACK, DEFAULT_FORGETTING
    )
    session = prepare(mdp, classes, one.bucketed(), True)
    confidence = session.observations.score[..., None, None]
    plan = method.plan(state.weights, state.values)
    evidence = report_log_evidence(classes, state.logits, session.observations, confidence)
    posterior = smooth_all(mdp, plan.log_policy, Evidence(evidence, session.live))
    completed = complete(mdp, posterior, session.live, session.observations.seen)
    told = report_statistic(classes, state.logits, session.observations, confidence, posterior.pairs)
    heard = perception.blend(state.observation_statistic, told)
    working = blend(state.statistic, method.statistic.of_session(mdp, plan, completed), DEFAULT_FORGETTING)
    slack, ridge = method.penalties(working, state.session + 1)
    start = WarmStart(state.weights, plan.values)
    parts: dict[str, tuple[Callable[..., Any], tuple]] = {
        "planning": (method.plan, (state.weights, state.values)),
        "evidence": (
            lambda logits, observations: report_log_evidence(
                classes, logits, observations, observations.score[..., None, None]
            ),
            (state.logits, session.observations),
        ),
        "smoothing": (
            lambda log_policy, e: smooth_all(mdp, log_policy, Evidence(e, session.live)),
            (plan.log_policy, evidence),
        ),
        "statistic of observations": (
            lambda logits, observations, pairs: report_statistic(
                classes, logits, observations, observations.score[..., None, None], pairs
            ),
            (state.logits, session.observations, posterior.pairs),
        ),
        "fit of the sensor": (perception.fit, (heard, state.logits)),
        "fit of the reward": (lambda x: newton(mdp, x, slack, ridge, start), (working,)),
        "preparing the observations": (lambda x: session_reports(classes, x), (one.bucketed(),)),
    }
    found = {}
    for name, (part, arguments) in parts.items():
        compiled = jax.jit(part)
        found[name] = median_seconds(lambda: jax.block_until_ready(compiled(*arguments)), replications)  # noqa: B023
    return found


def pattern_seconds(
    predicates: Sequence[int] = (2, 4, 8, 12, 16), size: int = 5
) -> dict[str, dict[str, float]]:
    """Measure classes, patterns of agreement and seconds of one sensor fit, against random predicates."""
    found = {}
    for number in predicates:
        stream = random_stream(size, number, 1)
        classes = report_classes(stream.predicates)
        observations = session_reports(classes, stream.seen)
        confidence, logits = observations.score[..., None, None], jnp.ones(number)
        pairs = jnp.full(observations.same.shape, 1 / observations.same[0, 0].size)
        told = report_statistic(classes, logits, observations, confidence, pairs)
        fit = jax.jit(lambda x, logits: fit_sensor(classes, x, 0.05, logits))  # noqa: B023
        found[str(number)] = {
            "classes": len(classes.reportable),
            "patterns": len(classes.patterns),
            "seconds of a fit": median_seconds(lambda: jax.block_until_ready(fit(told, logits)), 20),  # noqa: B023
        }
    return found


def main() -> None:
    """Run and publish."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--sessions", type=int, default=100, help="of each task")
    parser.add_argument("--points", type=int, default=20, help="sessions timed at each size")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    tasks = {task.name: task for task in (noisy_sorting(), noisy_patrol())}
    results: dict[str, Any] = {
        "session": {name: session_seconds(task, options.sessions) for name, task in tasks.items()},
        "parts": {name: part_seconds(task) for name, task in tasks.items()},
        "patterns": pattern_seconds(),
    }
    for title, values in results["session"].items():
        columns = ("", *next(iter(values.values())))
        print_table(f"Seconds of a session: {title}", columns, [(n, *x.values()) for n, x in values.items()])
    for title, parts in results["parts"].items():
        print_table(f"Seconds of a part: {title}", ("", "seconds"), list(parts.items()))
    rows = [(f"{number} predicates", *x.values()) for number, x in results["patterns"].items()]
    print_table("Random predicates of 125 pairs", ("", "classes", "patterns", "seconds of a fit"), rows)
    count, lengths = (
        options.points + WARM,
        {6: (2, 3), 30: (5, 6), 150: (10, 15), 600: (20, 30), 1500: (30, 50)},
    )
    patrol = tasks["noisy patrol"]
    studies: dict[str, Callable[[], dict[str, Growth]]] = {
        "predicates (25 states)": lambda: measured_growth(
            (2, 4, 8, 12, 16), lambda m: random_stream(5, m, count)
        ),
        "states (4 predicates)": lambda: measured_growth(
            (49, 100, 196, 400, 784), lambda s: random_stream(round(s**0.5), 4, count)
        ),
        "states (4 predicates, state and action)": lambda: measured_growth(
            (49, 100, 196, 400), lambda s: random_stream(round(s**0.5), 4, count, named=True)
        ),
        "pairs in a session (noisy patrol)": lambda: measured_growth(
            tuple(lengths), lambda pairs: stream_of(patrol, count, *lengths[pairs])
        ),
    }
    results["growth"] = {}
    for title, study in studies.items():
        found = study()
        results["growth"][title] = {
            name: g._asdict() | {"seconds": g.seconds.tolist()} for name, g in found.items()
        }
        print_table(
            f"Seconds of a session against {title}",
            ("", *(str(size) for size in found[REPORTED].sizes), "exponent", "from", "to"),
            [(name, *map(float, g.seconds), g.exponent, g.low, g.high) for name, g in found.items()],
        )
    publish("noisy_cost", results, options.out)


if __name__ == "__main__":
    main()
