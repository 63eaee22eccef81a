"""The declared model of a sensor with noise on features of a pair, in PyMC (Bayesian chapter 6.1).

Reliabilities have Beta priors. The data of any number of sessions are the matches of each predicate, the
weight of each hidden pair, and perception's scores. Hidden truths enter by their posterior expectations.
"""

from __future__ import annotations

import warnings
from typing import Any

import arviz as az
import jax
import numpy as np
import pymc as pm
import pytensor.tensor as pt
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ..inputs.arguments import as_key
from ..observation.agreement import PredicateClasses, ReportedMatches, predicate_classes


def observation_feature_model(
    predicates: ArrayLike,
    reported: ReportedMatches,
    *,
    scores: ArrayLike | None = None,
    reportable: ArrayLike | None = None,
    prior: tuple[ArrayLike, ArrayLike] = (1.0, 1.0),
    names: tuple[str, ...] | None = None,
) -> pm.Model:
    r"""PyMC model of the reliabilities of a :class:`FeatureNoise` sensor.

    .. math::
        p_j \sim \text{Beta}(a_j, b_j), \qquad
        \log P(\text{reports} \mid p) = \sum_j n_j \, \text{logit} \, p_j - \sum_g w_g \log Z_g(p)

    with :math:`n_j` the matches of predicate :math:`j` and :math:`w_g` the observations whose truth was
    :math:`g`: Eq. 6.5, normalised. Its maximum over logits is the solution of the maximum-entropy program. If
    every combination of predicates is reportable and equally common, :math:`p_j` is also the frequency with
    which predicate :math:`j` is right, and the posterior is ``Beta(a + matches, b + reports - matches)``.

    A score ``c_t`` is perception's calibrated confidence that its observation is right, in agreement with the
    truth on every predicate. The model gives this event the probability ``mu(p)``, averaged over truths, and
    adds the expectation ``sum_t c_t log mu + (1 - c_t) log(1 - mu)``. Its maximum is at ``mu`` equal to the
    mean score, as in Eq. 6.6, however scores are spread.

    Parameters
    ----------
    predicates : bool or int ``[J, S, A]``
    reported : ReportedMatches
        Counts of all sessions so far; they add up.
    scores : float ``[n]``, optional
        In [0, 1]; NaN where perception gave none. Without scores the model has no ``score``.
    reportable : bool ``[S, A]``, optional
        Pairs that perception may report; all by default.
    prior : pair of float or float ``[J]``
        ``a`` and ``b``; uniform by default.
    names : tuple of str, optional
        Names of the predicates, the coordinate ``predicate``; ``psi1``, ``psi2``, ... by default.

    Returns
    -------
    pymc.Model
        Free variable ``reliability (predicate)``; deterministic ``agreement (predicate)``, the probability
        that a predicate is reported rightly, averaged over the truths; observed ``matches (predicate)`` and
        ``score (report)``.

    Raises
    ------
    ValueError
        For bad predicates, matches that do not fit the observations, scores outside [0, 1], a prior that is
        not positive, and another number of names than of predicates.

    See Also
    --------
    i2rl.models.FeatureNoise : the sensor
    i2rl.inference.ObservationProgram : the maximum-entropy program of the same reliabilities

    Examples
    --------
    >>> import numpy as np
    >>> from i2rl.models import observation_feature_model
    >>> from i2rl.models.observation.agreement import ReportedMatches
    >>> predicates = np.indices((5, 3))  # the cell and the action of each pair
    >>> reported = ReportedMatches(np.full((5, 3), 2.0), np.array([27.0, 24.0]))  # of 30 reports
    >>> model = observation_feature_model(predicates, reported, names=("cell", "action"))
    >>> [x.name for x in model.free_RVs], [x.name for x in model.observed_RVs], model.coords["predicate"]
    (['reliability'], ['matches'], ('cell', 'action'))
    """
    classes = predicate_classes(predicates, reportable)
    n_predicates = classes.vectors.shape[1]
    matches, truths = _checked_matches(classes, reported)
    a, b = _checked_prior(prior, n_predicates)
    names = _checked_names(names, n_predicates)
    known = _checked_scores(scores)
    said = classes.reportable > 0
    agree, log_count = classes.agreements[:, said], np.log(classes.reportable[said])
    # Observations in the truth's own class agree on every predicate.
    own = np.where(said, np.log(np.maximum(classes.reportable, 1.0)), -np.inf)
    coords: dict[str, Any] = {"predicate": list(names)}
    if len(known):
        coords["report"] = np.arange(len(known))
    with pm.Model(coords=coords) as model:
        reliability = pm.Beta("reliability", a, b, dims="predicate")
        logits = pt.log(reliability) - pt.log1p(-reliability)
        exponents = pt.tensordot(pt.as_tensor(agree), logits, 1) + log_count
        log_z = pt.logsumexp(exponents, axis=1)
        chances = pt.exp(exponents - log_z[:, None])
        share = truths / truths.sum()
        pm.Deterministic(
            "agreement",
            pt.tensordot(share[:, None] * chances, pt.as_tensor(agree), [[0, 1], [0, 1]]),
            dims="predicate",
        )
        pm.CustomDist(
            "matches",
            logits,
            pt.dot(truths, log_z),
            logp=_log_likelihood,
            signature="(j),()->(j)",
            observed=matches,
            dims="predicate",
        )
        if len(known):
            right = pt.dot(share, pt.exp(own + pt.sum(logits) - log_z))
            pm.CustomDist("score", right, logp=_log_confidence, observed=known, dims="report")
    return model


def sample_observation_features(
    key: Array,
    predicates: ArrayLike,
    reported: ReportedMatches,
    *,
    draws: int = 1000,
    warmup: int = 500,
    chains: int = 4,
    target_accept: float = 0.9,
    **model: Any,
) -> az.InferenceData:
    """Draw from the posterior of :func:`observation_feature_model`, with NUTS compiled by JAX.

    No C compiler is needed. The same key gives the same draws.

    Parameters
    ----------
    key : JAX random key
    predicates, reported, **model
        Arguments of the model.
    draws, warmup, chains : int
        Draws returned and discarded by each chain, and number of chains.
    target_accept : float
        As in PyMC.

    Returns
    -------
    arviz.InferenceData
        ``posterior``: ``reliability``, ``agreement (chain, draw, predicate)``; ``sample_stats``;
        ``observed_data``: ``matches``, ``score``.

    Raises
    ------
    ValueError
        As the model does, and for numbers of draws or chains below one.

    See Also
    --------
    i2rl.models.observation_feature_model : the model
    i2rl.models.reported_matches : its data
    i2rl.inference.rimeo : learns reliabilities and reward together, without labels

    Examples
    --------
    >>> import jax
    >>> import numpy as np
    >>> from i2rl.models import reported_matches, sample_observation_features
    >>> at_end, ends = np.indices((5, 3))[:1] == 4, np.eye(15).reshape(-1, 5, 3)[[12] * 30]
    >>> matches = reported_matches(at_end, [4] * 27 + [3] * 3, [0] * 30, ends)  # 27 of 30 are right
    >>> sizes = {"draws": 100, "warmup": 100, "chains": 1}
    >>> posterior = sample_observation_features(jax.random.key(0), at_end, matches, **sizes).posterior
    >>> round(float(posterior.agreement.mean()), 1)
    0.9
    """
    key = as_key(key)
    for name, number in (("draws", draws), ("warmup", warmup), ("chains", chains)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    with warnings.catch_warnings(), observation_feature_model(predicates, reported, **model):
        # JAX compiles everything, so the libraries of PyTensor's own compiler do not matter.
        warnings.filterwarnings("ignore", message="PyTensor could not link to a BLAS")
        return pm.sample(
            draws,
            tune=warmup,
            chains=chains,
            target_accept=target_accept,
            nuts_sampler="numpyro",
            nuts_sampler_kwargs={"chain_method": "vectorized"},
            random_seed=int(jax.random.bits(key, dtype=np.uint32)),
            progressbar=False,
            quiet=True,
            compute_convergence_checks=False,
        )


def _log_likelihood(matches: pt.TensorVariable, logits: pt.TensorVariable, log_z: pt.TensorVariable) -> Any:
    return pt.dot(logits, matches) - log_z


def _log_confidence(scores: pt.TensorVariable, right: pt.TensorVariable) -> Any:
    return scores * pt.log(right) + (1 - scores) * pt.log1p(-right)


def _checked_matches(
    classes: PredicateClasses, reported: ReportedMatches
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " C"]]:
    n_predicates = classes.vectors.shape[1]
    matches, total = np.asarray(reported.matches, float), float(np.sum(reported.weights))
    truths = total * classes.gather(reported.weights)
    if matches.shape != (n_predicates,):
        raise ValueError(f"{n_predicates} predicates need as many matches, got shape {list(matches.shape)}")
    wrong = ~((matches >= -1e-9) & (matches <= total + 1e-9))
    if wrong.any():
        j = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"predicate {j} matched on {matches[j]:g} of {total:g} reports")
    return matches, truths


def _checked_prior(prior: tuple[ArrayLike, ArrayLike], n_predicates: int) -> tuple[np.ndarray, np.ndarray]:
    a, b = (np.broadcast_to(np.asarray(x, float), (n_predicates,)) for x in prior)
    if not ((a > 0) & (b > 0) & np.isfinite(a + b)).all():
        raise ValueError(f"Beta priors need positive parameters, got a = {a.tolist()}, b = {b.tolist()}")
    return a, b


def _checked_names(names: tuple[str, ...] | None, n_predicates: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"psi{j + 1}" for j in range(n_predicates))
    if len(names) != n_predicates or len(set(names)) != n_predicates:
        raise ValueError(f"{n_predicates} predicates need as many names, all different; got {list(names)}")
    return tuple(names)


def _checked_scores(scores: ArrayLike | None) -> Float[np.ndarray, " n"]:
    """Check scores and drop missing ones."""
    c = np.zeros(0) if scores is None else np.asarray(scores, float)
    if c.ndim != 1:
        raise ValueError(f"scores have shape [n], one for each report, got {list(c.shape)}")
    wrong = (c < 0) | (c > 1)
    if wrong.any():
        t = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"scores lie between 0 and 1; that of report {t} is {c[t]}")
    return c[~np.isnan(c)]
