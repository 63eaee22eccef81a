"""The scale of each feature, which makes programs, penalties, priors and tolerances independent of units.

A feature's scale is its largest magnitude. Features divided by their scales lie in ``[-1, 1]``, and weights
multiplied by them, *scaled weights*, are the reward in nats that each feature adds at most. A change of unit
(metres to millimetres) changes features and weights, but not their scaled forms. Learners and programs work
on scaled features and return weights of the original ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .mdp import TabularMDP


def feature_scale(mdp: TabularMDP) -> Float[Array, " K"]:
    """Return the largest magnitude of each feature over available pairs, and 1 for a feature that is zero.

    Features of 0 and 1 have scale 1 exactly.

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.models import TabularMDP
    >>> mdp = TabularMDP.from_dense(np.ones((1, 2, 1)), np.array([[[2e6, 0.0, 1.0], [-3e6, 0.0, 0.0]]]))
    >>> [float(scale) for scale in feature_scale(mdp)]
    [3000000.0, 1.0, 1.0]

    See Also
    --------
    with_scaled_features : the process whose features are divided by their scales.
    """
    if isinstance(mdp.features, jax.core.Tracer) or isinstance(mdp.available, jax.core.Tracer):
        return _largest(jnp, mdp.features, mdp.available)
    # Computed outside any trace, so that scales of 1 are known to be 1.
    return _largest(np, np.asarray(mdp.features), np.asarray(mdp.available))


def _largest(xp: Any, features: Any, available: Any) -> Float[Array, " K"]:
    largest = xp.max(xp.where(available[..., None], xp.abs(features), 0.0), axis=(0, 1))
    return xp.where(largest > 0, largest, 1.0)


def with_scaled_features(mdp: TabularMDP) -> TabularMDP:
    """Divide each feature by its scale; return the same process if all scales are 1.

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.models import TabularMDP
    >>> mdp = TabularMDP.from_dense(np.ones((1, 2, 1)), np.array([[[2e6], [-4e6]]]))
    >>> with_scaled_features(mdp).features.ravel().tolist()
    [0.5, -1.0]

    See Also
    --------
    feature_scale : the scales.
    """
    scale = feature_scale(mdp)
    if not isinstance(scale, np.ndarray):
        return replace(mdp, features=mdp.features / scale)
    if (scale == 1).all():
        return mdp
    # XLA multiplies by reciprocals, which leaves the largest magnitude slightly off 1.
    return replace(mdp, features=jnp.asarray(np.asarray(mdp.features) / scale))
