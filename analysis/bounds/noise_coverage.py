"""Replications against RIMEO's bounds: :mod:`.coverage` under noisy, estimated perception.

The expert obeys the soft model; observations follow :class:`~i2rl.models.FeatureNoise`. Its reliabilities are
counted on ``n_o`` observations of known truth, as Hoeffding's ``epsilon_o`` requires. Posteriors over pairs
are exact.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...models.observation.agreement import predicate_classes
from ...models.observation.evidence import FeatureNoise
from ...models.process.mdp import TabularMDP
from .coverage import (
    Completed,
    Coverage,
    Expert,
    Setting,
    complete_features,
    coverage_of,
    expected_gaps,
    expert_of,
    learned_gaps,
    simulate_codes,
)
from .distance import Perception, model_distance
from .perception import (
    noisy_confidence,
    noisy_constraint_bound,
    rimeo_confidence,
    rimeo_constraint_bound,
    same_reports_constraint_bound,
)
from .theorems import error_for


def noise_of(setting: Setting) -> FeatureNoise:
    """Return the setting's noise on predicates; ``ValueError`` for another sensor."""
    if not isinstance(setting.sensor, FeatureNoise):
        raise ValueError(f"the study is of FeatureNoise, but the sensor is a {type(setting.sensor).__name__}")
    return setting.sensor


def counted_reliabilities(
    key: Array, noise: FeatureNoise, replications: int, observations: int
) -> Float[Array, "replications J"]:
    """Count shares of right predicates among ``observations`` of known truth.

    Shares stay half an observation away from 0 and 1. Raises ``ValueError`` unless predicates are observed
    independently, which requires that every combination of them can be observed, equally often.
    """
    classes = predicate_classes(np.asarray(noise.predicates), np.asarray(noise.reportable))
    if len(classes.vectors) != 2 ** len(noise.predicates) or np.ptp(classes.reportable) > 0:
        raise ValueError(
            f"of {2 ** len(noise.predicates)} combinations of the predicates' values "
            f"{np.count_nonzero(classes.reportable)} can be observed, by {classes.reportable.min():g} to "
            f"{classes.reportable.max():g} pairs: predicates must be independent for reliabilities to "
            f"be shares"
        )
    p = noise.reliabilities
    right = jax.random.binomial(key, observations, p, (replications, len(p)))
    return jnp.clip(right, 0.5, observations - 0.5) / observations


@partial(jax.jit, static_argnames=("draws",))
def complete_under(
    key: Array,
    mdp: TabularMDP,
    expert: Expert,
    noise: FeatureNoise,
    reliabilities: Float[Array, "replications J"],
    codes: Int[Array, "replications size L 3"],
    draws: int,
) -> Completed:
    """Complete the features of each replication under its own reliabilities (:func:`.complete_features`)."""

    def one(inputs: tuple) -> Completed:
        key, p, codes = inputs
        perceived = FeatureNoise(noise.predicates, p, noise.reportable).noise
        completed = complete_features(key, mdp, expert, perceived, codes[None], draws)
        return Completed(*(x[0] for x in completed))

    return lax.map(one, (jax.random.split(key, len(codes)), reliabilities, codes))


def perception_coverage(
    key: Array, setting: Setting, replications: int, size: int, draws: int, observations: int, delta: float
) -> list[Coverage]:
    """Simulate Lemma 4 and Theorem 6 (Lemma 8 and Theorem 6 of appendix E), printed and corrected.

    ``delta`` is spent on each of ``epsilon`` (``size`` trajectories), ``epsilon_s`` (``size * draws`` sampled
    completions in all) and ``epsilon_o`` (``observations``), which determine the errors. Hidden pairs are
    filled in under the expert's weights. Raises ``ValueError`` as :func:`counted_reliabilities`.
    """
    mdp, discount, n_features = setting.mdp, float(setting.mdp.discount), setting.mdp.n_features
    noise, expert = noise_of(setting), expert_of(mdp, setting.weights)
    n_predicates = len(noise.predicates)
    walk, count, fill = jax.random.split(key, 3)
    codes = simulate_codes(walk, mdp, expert, noise.noise, setting.length, replications, size)
    counted = counted_reliabilities(count, noise, replications, observations)
    completed = complete_under(fill, mdp, expert, noise, counted, codes, draws)
    epsilon, epsilon_s = error_for(size, delta, n_features), error_for(size * draws, delta, n_features)

    def rows(name: str, features: Array, confidence: float, slack: Array, errors: Array) -> list[Coverage]:
        target = features.mean(axis=1)
        missed = (1 - discount) * jnp.max(jnp.abs(target - expert.features), axis=1)
        slacks = jnp.broadcast_to(slack[:, None] / (1 - discount), target.shape)
        return [
            coverage_of(setting, f"Lemma 4, {name}", size, confidence, np.asarray(slack), missed),
            coverage_of(
                setting,
                f"Theorem 6, {name}",
                size,
                confidence,
                np.asarray(errors),
                expected_gaps(mdp, expert, target, slacks),
            ),
        ]

    # The printed delta_o counts every feature.
    printed = Perception(
        observations, error_for(observations, delta, n_features * n_predicates), n_predicates, setting.length
    )
    sizes = (size, size * draws, epsilon, epsilon_s, printed, n_features)
    lemma, theorem = rimeo_constraint_bound(*sizes), rimeo_confidence(*sizes, discount)
    found = rows(
        "printed",
        completed.sampled,
        theorem.confidence,
        jnp.full(replications, lemma.error),
        jnp.full(replications, theorem.error),
    )
    once = printed._replace(epsilon_o=error_for(observations, delta, n_predicates))
    ahead = noisy_constraint_bound(size, epsilon, once, n_features)
    for name, lemmas in (
        ("corrected", [ahead] * replications),
        (
            "counted reliabilities",
            [noisy_constraint_bound(size, epsilon, once, n_features, p) for p in np.asarray(counted)],
        ),
        (
            "same reports",
            [same_reports_constraint_bound(size, epsilon, once, n_features, p) for p in np.asarray(counted)],
        ),
    ):
        theorems = [noisy_confidence(x, n_features, discount) for x in lemmas]
        found += rows(
            name,
            completed.exact,
            ahead.confidence,
            jnp.asarray([x.error for x in lemmas]),
            jnp.asarray([x.error for x in theorems]),
        )
    return found


def learned_perception_coverage(
    key: Array,
    setting: Setting,
    replications: int,
    size: int,
    draws: int,
    observations: int,
    delta: float,
    shift: float = 1.0,
) -> list[Coverage]:
    """Check Theorem 6 with hidden pairs filled in under the learner's own weights, exactly.

    The learner believes in reliabilities that are all off by ``shift`` times ``epsilon_o``; -1 and 1 are
    corners of the theorem's range. It completes as LME-I2RL does: the premise about completions is not known
    to hold. Raises ``ValueError`` for a ``shift`` outside [-1, 1].
    """
    if not -1 <= shift <= 1:
        raise ValueError(f"the theorem allows reliabilities off by epsilon_o, got {shift} times that")
    discount, n_features = float(setting.mdp.discount), setting.mdp.n_features
    noise = noise_of(setting)
    n_predicates = len(noise.predicates)
    perception = Perception(
        observations, error_for(observations, delta, n_features * n_predicates), n_predicates, setting.length
    )
    epsilon, epsilon_s = error_for(size, delta, n_features), error_for(size * draws, delta, n_features)
    theorem = rimeo_confidence(size, size * draws, epsilon, epsilon_s, perception, n_features, discount)
    p = np.asarray(noise.reliabilities) + shift * perception.epsilon_o
    gaps = learned_gaps(
        key, setting, FeatureNoise(noise.predicates, p, noise.reportable), replications, size, theorem.epsilon
    )
    name = f"Theorem 6, own weights, reliabilities off by {shift:+g} epsilon_o"
    return [coverage_of(setting, name, size, theorem.confidence, np.full(replications, theorem.error), gaps)]


def posterior_change(
    key: Array, setting: Setting, epsilon_o: float, replications: int, size: int
) -> list[Coverage]:
    """Check the proof's step from the true model to one within ``epsilon_o`` of it, for every observation.

    Reliabilities are off by ``epsilon_o`` to a random side. The result is the largest change of a feature's
    ``(1 - gamma) phi_hat`` between the two posteriors, over ``size`` trajectories of a replication and of its
    worst trajectory alone, against ``L |Psi| epsilon_o`` and the bound by odds (:func:`.model_distance`),
    both sure. Every :class:`~i2rl.models.FeatureNoise` is allowed. Raises ``ValueError`` for reliabilities
    within ``epsilon_o`` of 0 or 1.
    """
    mdp, unit = setting.mdp, 1 - float(setting.mdp.discount)
    noise, expert = noise_of(setting), expert_of(mdp, setting.weights)
    walk, side, fill = jax.random.split(key, 3)
    codes = simulate_codes(walk, mdp, expert, noise.noise, setting.length, replications, size)
    true = noise.reliabilities
    off = true + epsilon_o * jax.random.rademacher(side, (replications, len(true)), float)
    if not bool(((off > 0) & (off < 1)).all()):
        raise ValueError(f"reliabilities {np.asarray(true)} are too near 0 or 1 to be off by {epsilon_o}")
    before, after = (
        complete_under(fill, mdp, expert, noise, p, codes, 1).exact
        for p in (jnp.broadcast_to(true, off.shape), off)
    )
    change = unit * np.asarray(after - before)
    by_odds = np.array(
        [
            model_distance(noise, FeatureNoise(noise.predicates, p, noise.reportable)).over(setting.length)[1]
            for p in np.asarray(off)
        ]
    )
    printed = np.full(replications, setting.length * len(true) * epsilon_o)
    mean, single = np.abs(change.mean(axis=1)).max(axis=1), np.abs(change).max(axis=(1, 2))
    return [
        coverage_of(setting, f"observation term {name}, {what}", count, 1.0, bounds, seen)
        for what, count, seen in (("mean of trajectories", size, mean), ("worst trajectory", 1, single))
        for name, bounds in (("as printed", printed), ("by odds", by_odds))
    ]
