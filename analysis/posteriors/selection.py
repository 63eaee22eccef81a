"""Selection of features: feature sets compared by leave-one-out cross-validation.

Each set gives a posterior; the sets are ranked by how well they predict a trajectory from all the others
(expected log predictive density, PSIS-LOO of Vehtari, Gelman and Gabry 2017, by ArviZ). The unit left out is
the trajectory, hidden steps summed out: steps of one trajectory are not independent. Fragments of one long
walk are not independent either; the model treats them as such.

An irrelevant feature adds only a weight to estimate to the prediction, so a set without it ranks at least as
high, typically by some tenths of a nat. A difference is significant only if it is several times its standard
error (``elpd_diff`` against ``dse``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

from ...inference.posteriors.weights import sample_posterior
from ...models.inputs.text import listed, shortened
from ...models.observation.demonstration import LOST, PAD, Demonstration
from ...models.observation.evidence import AnySensor
from ...models.process.mdp import Labels, TabularMDP

# Above this the importance weights of a trajectory left out are too uneven to be relied on.
PARETO_LIMIT = 0.7


class FeatureComparison(NamedTuple):
    """Ranking of feature sets.

    Fields
    ------
    table : DataFrame
        As of ``az.compare``, best first: ``rank``, ``elpd_loo`` (nats, all trajectories), ``p_loo``
        (effective number of weights), ``elpd_diff`` to the best, stacking ``weight``, ``se``, ``dse``,
        ``warning``.
    pareto_k : DataFrame
        For each set: the largest ``k``, the share of trajectories above 0.7, and the trajectory of the
        largest. With some above, the ranking rests on unreliable importance weights.
    posteriors : the posteriors, by name
    """

    table: pd.DataFrame
    pareto_k: pd.DataFrame
    posteriors: Mapping[str, az.InferenceData]

    @property
    def best(self) -> str:
        """Name of the set that predicts best."""
        return str(self.table.index[0])


def with_features(
    mdp: TabularMDP, features: Float[np.ndarray, "S A K"], names: Sequence[str] | None = None
) -> TabularMDP:
    """Return the same process with other features ``[S, A, K]``, by other names.

    Raises ``ValueError`` for features of another shape or not finite where an action is available, and for
    names of the wrong number or repeated.
    """
    return TabularMDP.from_successors(
        np.asarray(mdp.successors),
        np.asarray(mdp.probabilities),
        features,
        initial=np.asarray(mdp.initial),
        discount=float(mdp.discount),
        available=np.asarray(mdp.available),
        states=mdp.labels.states,
        actions=mdp.labels.actions,
        feature_names=names,
    )


def select_features(mdp: TabularMDP, names: Sequence[str]) -> TabularMDP:
    """Return the same process with only the features of these names, in this order.

    Raises ``ValueError`` naming an unknown or repeated feature, or for no names at all.

    See Also
    --------
    i2rl.analysis.compare_features : compare such sets

    Examples
    --------
    >>> from i2rl.analysis import select_features
    >>> from i2rl.domains import five_cells
    >>> mdp = select_features(five_cells().mdp, ["at the end"])
    >>> mdp.feature_names, mdp.features.shape
    (('at the end',), (5, 3, 1))
    """
    if not names:
        raise ValueError("select at least one feature")
    for name in names:
        if name not in mdp.feature_names:
            raise ValueError(f"unknown feature {shortened(name)}; known are {listed(mdp.feature_names)}")
    if len(set(names)) != len(names):
        raise ValueError(f"features must differ, got {listed(names)}")
    columns = np.array([mdp.feature_names.index(name) for name in names])
    labels = Labels(mdp.labels.states, mdp.labels.actions, tuple(names))
    return replace(mdp, features=jnp.asarray(mdp.features)[..., columns], labels=labels)


def compare_features(
    key: Array,
    mdps: Mapping[str, TabularMDP],
    sensor: AnySensor,
    demonstration: Demonstration,
    **options: Any,
) -> FeatureComparison:
    """Sample a posterior for each feature set and rank the sets.

    Trajectories without evidence (all frames lost) are left out: every set predicts them equally.

    Parameters
    ----------
    key : JAX random key
    mdps : mapping of names to TabularMDP
        The same process with different features, see :func:`with_features` and :func:`select_features`.
    sensor, demonstration
        The expert's sensor, and its observations.
    options
        As for :func:`sample_posterior`. Hidden steps are not drawn unless ``completions=True``.

    Raises
    ------
    ValueError
        For fewer than two sets, processes that differ in more than features, fewer than two trajectories with
        evidence; and as :func:`sample_posterior`.

    See Also
    --------
    i2rl.analysis.select_features : make a set of features
    i2rl.analysis.compare_posteriors : compare posteriors at hand

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import compare_features, select_features
    >>> from i2rl.domains import five_cells
    >>> mdp, _, *seen = five_cells()
    >>> sets = {"both": mdp, "moves": select_features(mdp, ["moves"])}
    >>> short = dict(draws=100, warmup=100, chains=2)
    >>> compare_features(jax.random.key(0), sets, *seen, **short).best
    'both'
    """
    _require_same_process(mdps)
    kind = np.asarray(demonstration.kind)
    telling = ((kind != LOST) & (kind != PAD)).any(axis=1)
    if telling.sum() < 2:
        raise ValueError(
            f"leaving one out needs at least two trajectories that say something, got {telling.sum()}"
        )
    shown = demonstration.select(telling)
    options = {"completions": False, **options}
    keys = jax.random.split(key, len(mdps))
    posteriors = {
        name: sample_posterior(k, mdp, sensor, shown, **options)
        for k, (name, mdp) in zip(keys, mdps.items(), strict=True)
    }
    return compare_posteriors(posteriors)


def compare_posteriors(posteriors: Mapping[str, az.InferenceData]) -> FeatureComparison:
    """Rank posteriors of one demonstration that were sampled already.

    Raises ``ValueError``, naming the posterior at fault, for fewer than two, one without the group
    ``log_likelihood`` or its variable ``demonstration``, and posteriors of different demonstrations.

    See Also
    --------
    i2rl.analysis.compare_features : sample and compare
    i2rl.inference.sample_posterior : sample a posterior

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import compare_posteriors, select_features
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import sample_posterior
    >>> mdp, _, *seen = five_cells()
    >>> short = dict(draws=100, warmup=100, chains=2, completions=False)
    >>> posteriors = {
    ...     name: sample_posterior(jax.random.key(0), process, *seen, **short)
    ...     for name, process in [("both", mdp), ("moves", select_features(mdp, ["moves"]))]
    ... }
    >>> list(compare_posteriors(posteriors).table.index)
    ['both', 'moves']
    """
    if len(posteriors) < 2:
        raise ValueError(f"a comparison needs at least two feature sets, got {len(posteriors)}")
    first = next(iter(posteriors))
    for name, posterior in posteriors.items():
        if "log_likelihood" not in posterior.groups() or "demonstration" not in posterior["log_likelihood"]:
            raise ValueError(
                f"posterior {name!r} has no log-likelihood of the demonstration; its groups are "
                f"{', '.join(posterior.groups()) or 'none'}. sample_posterior returns one"
            )
    sizes = {name: p["log_likelihood"].sizes["trajectory"] for name, p in posteriors.items()}
    for name, posterior in posteriors.items():
        if sizes[name] != sizes[first]:
            raise ValueError(
                f"posterior {name!r} is of {sizes[name]} trajectories, {first!r} of {sizes[first]}; "
                "only posteriors of one demonstration compare"
            )
        groups = [p["observed_data"] for p in (posteriors[first], posterior) if "observed_data" in p.groups()]
        if len(groups) == 2 and not groups[0].equals(groups[1]):
            raise ValueError(f"posteriors {first!r} and {name!r} are of different demonstrations")
    scores = {name: az.loo(posterior, pointwise=True) for name, posterior in posteriors.items()}
    diagnostics = []
    for name, score in scores.items():
        k = np.asarray(score.pareto_k)
        diagnostics.append((name, float(k.max()), float((k > PARETO_LIMIT).mean()), int(k.argmax())))
    pareto_k = pd.DataFrame(diagnostics, columns=["model", "largest", "share_above", "trajectory"])
    return FeatureComparison(az.compare(scores), pareto_k.set_index("model"), dict(posteriors))


def _require_same_process(mdps: Mapping[str, TabularMDP]) -> None:
    if len(mdps) < 2:
        raise ValueError(f"a comparison needs at least two feature sets, got {len(mdps)}")
    first, *others = mdps
    reference = mdps[first]
    parts = ("successors", "probabilities", "initial", "discount", "available", "state_names", "action_names")
    for name in others:
        different = [
            part.replace("_", " ")
            for part in parts
            if not np.array_equal(getattr(reference, part), getattr(mdps[name], part))
        ]
        if different:
            raise ValueError(
                f"{first!r} and {name!r} differ in more than features: {', '.join(different)}. A comparison "
                "of feature sets needs one process"
            )
