"""The answer to "how many demonstrations do I need", as the command line gives it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from .assumptions import Bound, check
from .perception import perception_needed
from .theorems import demonstrations_needed, lme_i2rl_confidence

if TYPE_CHECKING:
    from rich.console import Console

_SYMBOLS = {True: "holds", False: "does not hold", None: "yours to answer for"}


class Answer(NamedTuple):
    """Numbers of trajectories by bound for one ``confidence``, and the error of ignorance.

    For a known expert, ``ignorance_nats`` is the expected log-likelihood gap of zero weights, and
    ``informative`` the trajectories from which on each bound promises less than that. ``perception`` is the
    data for the same error under noisy perception (:func:`.perception_needed`), if requested.
    """

    confidence: float
    n_features: int
    table: pd.DataFrame
    bound: Bound
    ignorance_nats: float | None = None
    informative: pd.DataFrame | None = None
    perception: pd.DataFrame | None = None


class PerceptionSize(NamedTuple):
    """The number ``|Psi|`` of predicates and the steps ``L`` of a trajectory under noisy perception."""

    predicates: int | None = None
    steps: int | None = None


def answer(
    features: int | None,
    epsilon: float,
    confidence: float,
    epsilon_s: float = 0.05,
    discount: float | None = None,
    deviation: float | None = None,
    mdp: str | None = None,
    perception: PerceptionSize = PerceptionSize(),  # noqa: B008 (immutable)
) -> Answer:
    """Ask the theorem and the tighter bounds.

    With ``mdp`` (``patrol1`` to ``patrol3``) the number of features, the discount and the spread of the
    features are those of an expert who softly obeys the patrol's true weights, and assumptions are checked
    against it. ``perception`` has both of its sizes, or neither where perception is not noisy.
    Raises ``ValueError`` for numbers out of range, for neither ``features`` nor ``mdp``, for both ``mdp`` and
    a value that it determines, and for ``predicates`` without ``steps`` or the reverse.
    """
    predicates, steps = perception
    if (predicates is None) != (steps is None):
        raise ValueError("noisy perception is described by --predicates and --steps: give both or neither")
    found = _without_noise(features, epsilon, confidence, epsilon_s, discount, deviation, mdp)
    if predicates is None or steps is None:
        return found
    return found._replace(
        perception=perception_needed(found.n_features, predicates, steps, epsilon + epsilon_s, confidence)
    )


def _without_noise(
    features: int | None,
    epsilon: float,
    confidence: float,
    epsilon_s: float,
    discount: float | None,
    deviation: float | None,
    mdp: str | None,
) -> Answer:
    for name, error in (("epsilon", epsilon), ("epsilon-s", epsilon_s)):
        if error >= 1:
            raise ValueError(f"{name} is the error of an average of values in [0, 1]: below 1, got {error}")
    if mdp is None:
        if features is None:
            raise ValueError("say how many features the reward has (--features), or name a domain (--mdp)")
        gamma = 0.99 if discount is None else discount
        spread = None if deviation is None else np.full(features, deviation)
        table = demonstrations_needed(
            features, epsilon, confidence, gamma, epsilon_s=epsilon_s, deviations=spread
        )
        return Answer(confidence, features, table, _theorem(table, epsilon, epsilon_s, features, gamma))
    if features is not None or discount is not None or deviation is not None:
        raise ValueError("--mdp decides the features, the discount and their deviation: leave those out")
    return _of_patrol(mdp, epsilon, confidence, epsilon_s)


def _of_patrol(name: str, epsilon: float, confidence: float, epsilon_s: float) -> Answer:
    import jax.numpy as jnp

    from ...domains.patrol.process import instance
    from ...models.process.planning import feature_deviations, reward_of, soft_plan
    from .coverage import ignorance_gap

    if name not in ("patrol1", "patrol2", "patrol3"):
        raise ValueError(f"--mdp is patrol1, patrol2 or patrol3, whose expert is known, got {name!r}")
    patrol = instance(int(name[-1]))
    process, weights = patrol.mdp, jnp.asarray(patrol.weights)
    gamma = float(process.discount)
    policy = soft_plan(process, reward_of(process, weights)).policy
    spread = (1 - gamma) * np.asarray(feature_deviations(process, policy))
    table = demonstrations_needed(
        process.n_features, epsilon, confidence, gamma, epsilon_s=epsilon_s, deviations=spread
    )
    bound = _theorem(table, epsilon, epsilon_s, process.n_features, gamma)
    bound = check(bound, mdp=process, weights=patrol.weights, expert=np.asarray(policy))
    ignorance = ignorance_gap(process, weights)
    half = ignorance * (1 - gamma) / (4 * process.n_features)
    informative = demonstrations_needed(
        process.n_features, half, confidence, gamma, epsilon_s=half, deviations=spread
    )
    return Answer(confidence, process.n_features, table, bound, ignorance, informative)


def _theorem(table: pd.DataFrame, epsilon: float, epsilon_s: float, features: int, discount: float) -> Bound:
    row = table.loc["theorem"]
    return lme_i2rl_confidence(row["trajectories"], row["draws"], epsilon, epsilon_s, features, discount)


def summary(answer: Answer) -> dict[str, Any]:
    """Return the answer as plain numbers and words, for JSON."""
    return {
        "confidence": answer.confidence,
        "violated": [a.name for a in answer.bound.violated],
        "bounds": answer.table.reset_index().to_dict("records"),
        "theorem": {"source": answer.bound.source, "confidence": answer.bound.confidence},
        "assumptions": [a._asdict() for a in answer.bound.assumptions],
        "ignorance_nats": answer.ignorance_nats,
        "informative": None if answer.informative is None else answer.informative["trajectories"].to_dict(),
        "perception": None
        if answer.perception is None
        else answer.perception.reset_index().to_dict("records"),
    }


def print_answer(answer: Answer, console: Console) -> None:
    """Print the answer as two tables and, for a known expert, the meaning of the error."""
    from rich.table import Table

    bound = answer.bound
    error = answer.table["error_nats"].iloc[0]
    table = Table(title="How many trajectories are enough")
    table.add_column("bound")
    table.add_column("trajectories", justify="right")
    table.add_column("draws of the hidden steps", justify="right")
    names = {"theorem": bound.source}
    for row in answer.table.itertuples():
        draws = str(row.draws) if row.draws else "none"
        table.add_row(names.get(row.Index, row.Index), str(row.trajectories), draws)
    console.print(table)
    console.print(
        f"Each for LL(theta_E) - LL(theta) <= {error:.4g} nats per trajectory with probability at "
        f"least {answer.confidence:g}.\n"
        "Exact completion: of the hidden steps, under weights as good as the expert's.\n"
        "Observed spread: a plan; the guarantee is the bound computed from the data (observed_bound)."
    )
    if answer.perception is not None:
        _print_perception(answer.perception, console)
    if answer.informative is not None and answer.ignorance_nats < error:
        needed = answer.informative["trajectories"]
        console.print(
            f"Zero weights are {answer.ignorance_nats:.4g} nats from this expert: a bound above that is "
            "vacuous.\nAn informative bound takes "
            f"{needed['theorem']} trajectories by the theorem, {needed['exact completion']} with exact "
            f"completion, {needed['observed spread']} with the observed spread."
        )
    if bound.violated:
        console.print(
            "None of this is a guarantee here: it does not hold that "
            + ", nor that ".join(a.statement for a in bound.violated)
            + "."
        )
    assumed = Table(title="What is assumed")
    assumed.add_column("assumption")
    assumed.add_column("here")
    for a in bound.assumptions:
        assumed.add_row(a.statement, _SYMBOLS[a.holds] + (f": {a.reason}" if a.reason else ""))
    console.print(assumed)


def _print_perception(needed: pd.DataFrame, console: Console) -> None:
    from rich.table import Table

    table = Table(title="The same error under noisy perception")
    names = {"printed": "Theorem 6 of appendix E", "corrected": "corrected"}
    table.add_column("bound")
    for name in ("trajectories", "draws of the hidden pairs", "observations of known truth", "their error"):
        table.add_column(name, justify="right")
    for row in needed.itertuples():
        draws = str(row.draws) if row.draws else "none"
        table.add_row(
            names[row.Index], str(row.trajectories), draws, str(row.observations), f"{row.epsilon_o:.3g}"
        )
    console.print(table)
    console.print(
        "Filled in under weights as good as the expert's. Under weights that are still being learned, no "
        "number\nof trajectories is enough where perception is noisy enough."
    )
