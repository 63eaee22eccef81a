"""Learners that work on scaled features and return weights of the original features."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...models.observation.demonstration import Demonstration
from ...models.process.mdp import TabularMDP
from ...models.process.units import feature_scale, with_scaled_features
from .learner import Info, Learner, State
from .statistic import FeatureStatistic


def unscaled(named: Any, scale: Float[Array, " K"]) -> Any:
    """Convert the scaled weights and features of a named tuple to the original units."""
    return _translated(named, lambda weights: weights / scale, lambda features: features * scale)


def scaled(named: Any, scale: Float[Array, " K"]) -> Any:
    """Scale the weights and features of a named tuple; :func:`unscaled` is the inverse."""
    return _translated(named, lambda weights: weights * scale, lambda features: features / scale)


def _translated(named: Any, weights: Callable[[Any], Any], features: Callable[[Any], Any]) -> Any:
    changed: dict[str, Any] = {"weights": weights(named.weights)}
    statistic = getattr(named, "statistic", None)
    if isinstance(statistic, FeatureStatistic):
        changed["statistic"] = statistic._replace(features=features(statistic.features))
    return named._replace(**changed)


def _kept(before: Any, inside: Any, new: Any, after: Any) -> Any:
    """Return ``after``, with unchanged parts of the state restored to the bit: scaling rounds."""
    changed: dict[str, Any] = {
        "weights": jnp.where(new.weights == inside.weights, before.weights, after.weights)
    }
    statistic = getattr(after, "statistic", None)
    if isinstance(statistic, FeatureStatistic):
        alone = new.statistic.features == inside.statistic.features
        features = jnp.where(alone, before.statistic.features, statistic.features)
        changed["statistic"] = statistic._replace(features=features)
    return after._replace(**changed)


def on_scaled_features(
    mdp: TabularMDP, build: Callable[[TabularMDP], Learner[State, Info]]
) -> Learner[State, Info]:
    """Build a learner on the process with scaled features, its states and infos in the original units.

    Slack, priors, initial weights, learning rates and tolerances of the learner then mean scaled weights
    (:mod:`~i2rl.models.process.units`), and its results do not depend on the units of a feature. If all
    scales are 1 it is ``build(mdp)`` itself.
    """
    free = with_scaled_features(mdp)
    learner = build(free)
    if free is mdp:
        return learner
    scale = feature_scale(mdp)

    def translated(run: Callable[[Any, Any], tuple[Any, Any]]) -> Callable[[Any, Any], tuple[Any, Any]]:
        def translate(state: Any, demonstration: Demonstration) -> tuple[Any, Any]:
            inside = scaled(state, scale)
            new, report = run(inside, demonstration)
            return _kept(state, inside, new, unscaled(new, scale)), unscaled(report, scale)

        return translate

    likelihood = learner.log_likelihood

    def log_likelihood(state: Any, weights: Float[Array, "*D K"]) -> float:
        assert likelihood is not None
        return likelihood(scaled(state, scale), weights * scale)

    return learner._replace(
        mdp=mdp,
        init=lambda key: unscaled(learner.init(key), scale),
        update=translated(learner.update),
        session=None if learner.session is None else translated(learner.session),
        log_likelihood=None if likelihood is None else log_likelihood,
    )
