"""What can be learned from a mouse in the labyrinth: prediction, bout by bout, of bouts not yet seen.

Before a learner learns from a bout it says how probable each of its decisions is; the code length of what
the animal then did, in bits per decision, is the score (prequential: nothing is tested on what it has
learned from). Every step counts as a decision; those at ends are forced and cost nobody anything, so that
uniform choice costs ``log2 3`` times the share of steps at junctions. The baselines learn in the same way,
each a table of counts that start at one (Laplace's rule), renormalised over the available actions:

``uniform``
    over the available actions.
``frequencies``
    of the actions over all steps. Forced steps back count too, which is what makes it worse than uniform;
    ``frequencies of choices`` leaves them out.
``given entry``
    frequencies given how the node was entered: from above, from either child, or as an end.
``Markov``
    frequencies per node and entry, a Markov chain over states; ``level and entry`` pools a level's nodes.

Why the Markov chain stays ahead. It has two free numbers for each of 189 situations. A reward on the node
reached, with *one* price for turning round and one for going deeper, cannot say that the animal turns at
one level and goes on at another. Even fitted to the whole recording with hardly a prior (ridge 0.001) it
needs 1.088 bits (D9a) and 1.079 (D9b), where the chain's maximum-likelihood fit takes 0.861 and 0.815: what
is missing is not data. ``level and entry``, with 36 numbers, takes most of the distance, and so it is
habits of a level more than places that the reward lacks; ``i2rl, by level``, whose prices differ from level
to level, recovers about two thirds of the distance on D9a and two fifths on D9b.

Discount and ridge were chosen by this score on D9a among discounts 0.3, 0.5, 0.7, 0.9 and ridges 2, 4, 8,
16, 32; D9b took no part in it. Shorter horizons predict better throughout (discounts below 0.3 gain at most
0.003 bits more). The likelihood without a prior hardly knows the discount, since a weight on every node can
make up for it: what the discount sets is what the prior believes before there are data, and with a long
horizon zero weights mean "seek out places with many ways on".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from ....domains.labyrinth.process import (
    ENTRIES,
    SHARED_FEATURES,
    Bout,
    Labyrinth,
    conceal,
    demonstration_of,
    labyrinth,
    labyrinth_by_level,
    level_of,
)
from ....inference.learners.lme import lme_i2rl
from ....models.observation.demonstration import PAD, SEEN, Demonstration
from ....models.observation.evidence import Sensor, Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, soft_plan
from ...drawing.estimates import Estimates, laplace_errors
from ...drawing.page import Lead, Section, Table, drawn, write_page
from ...drawing.page import print_tables as print_page_tables
from ...drawing.results import plain, study_provenance
from ...drawing.text import counted, listed, number
from ...posteriors.information import complete_information

if TYPE_CHECKING:
    from rich.console import Console

DISCOUNT = 0.3
RIDGE = 16.0
LEARNER, BY_LEVEL, UNIFORM = "i2rl", "i2rl, by level", "uniform"


class Prediction(NamedTuple):
    """How well one method predicted each bout before learning from it.

    Fields
    ------
    method : str
    bits : float ``[n]``
        Code length of each bout's decisions.
    bits_out_of_view : float ``[n]``
        The part of it spent on decisions in states the learner never sees.
    afterwards : float
        Bits per decision over the whole recording under what had been learned by its end: what the method
        can express, as far as its prior lets it.
    parameters : int
        Free numbers it learns.
    """

    method: str
    bits: Float[np.ndarray, " n"]
    bits_out_of_view: Float[np.ndarray, " n"]
    afterwards: float
    parameters: int


class Learned(NamedTuple):
    """What the learner knew at the end.

    Fields
    ------
    weights : float ``[K]``
    errors : float ``[K]`` or None
        Standard errors of the weights under their prior, where everything was in view: the inverse of the
        complete information at the weights and the prior's precision.
    values : float ``[S]``
        Soft values (nats) of those weights.
    seconds : float ``[n]``
        Wall-clock time of each session, compilation included in the first.
    """

    weights: Float[np.ndarray, " K"]
    errors: Float[np.ndarray, " K"] | None
    values: Float[np.ndarray, " S"]
    seconds: Float[np.ndarray, " n"]


class ViewStudy(NamedTuple):
    """Learning with one view of the maze.

    Fields
    ------
    view : str
    hidden : bool ``[S]``
        States out of view.
    decisions_out_of_view : int ``[n]``
    predictions : tuple of Prediction
        The learner first.
    learned : Learned
    """

    view: str
    hidden: Bool[np.ndarray, " S"]
    decisions_out_of_view: Int[np.ndarray, " n"]
    predictions: tuple[Prediction, ...]
    learned: Learned


class LabyrinthStudy(NamedTuple):
    """A recording learned from bout by bout.

    Fields
    ------
    recording : str
    maze : Labyrinth
    ridge : float
    decisions : int ``[n]``
        Decisions of each bout.
    views : tuple of ViewStudy
        The whole maze in view; and the left half hidden, if asked for.
    """

    recording: str
    maze: Labyrinth
    ridge: float
    decisions: Int[np.ndarray, " n"]
    views: tuple[ViewStudy, ...]


class Interval(NamedTuple):
    """An estimate and its 95 % interval."""

    estimate: float
    low: float
    high: float


def study(
    bouts: Sequence[Bout],
    *,
    recording: str = "recording",
    discount: float = DISCOUNT,
    ridge: float = RIDGE,
    hide_left: bool = True,
    on_bout: Callable[[str, int, float], None] | None = None,
) -> LabyrinthStudy:
    """Learn from a recording online, predicting every bout before learning from it.

    Parameters
    ----------
    bouts : sequence of Bout
    recording : str
        Its name, for the report.
    discount, ridge : float
        Of the learner; the ridge is the precision of the Gaussian prior on its weights.
    hide_left : bool
        Whether to learn a second time with the left half of the maze hidden.
    on_bout : callable or None
        Called after each session with the view's name, the bout's number (from 1) and the running bits per
        decision of the learner.

    Raises ``ValueError`` for an empty recording or a discount outside (0, 1).
    """
    if not bouts:
        raise ValueError("the recording has no bouts")
    maze = labyrinth(discount)
    demonstration = demonstration_of(maze, bouts).bucketed().select(slice(0, len(bouts)))
    nothing = np.zeros(maze.mdp.n_states, bool)
    views = {"whole maze": nothing}
    if hide_left:
        views["left half hidden"] = maze.below(1)
    studies = []
    for view, hidden in views.items():
        told = None if on_bout is None else partial(on_bout, view)
        prediction, learned = predict_with_learner(maze, demonstration, hidden, ridge, LEARNER, told)
        predictions = [prediction]
        if not hidden.any():
            richer = labyrinth_by_level(discount)
            predictions.append(predict_with_learner(richer, demonstration, hidden, ridge, BY_LEVEL)[0])
        predictions += predict_with_tables(maze, demonstration, hidden)
        outside = _per_bout(demonstration, hidden[demonstration.state].astype(float)).astype(int)
        studies.append(ViewStudy(view, hidden, outside, tuple(predictions), learned))
    return LabyrinthStudy(recording, maze, ridge, demonstration.lengths, tuple(studies))


def predict_with_learner(
    maze: Labyrinth,
    demonstration: Demonstration,
    hidden: Bool[np.ndarray, " S"],
    ridge: float,
    name: str = LEARNER,
    on_bout: Callable[[int, float], None] | None = None,
) -> tuple[Prediction, Learned]:
    """One session of LME-I2RL a bout; each is predicted whole, also where the learner cannot see.

    The first bout is predicted from the prior's mode, zero weights.
    """
    mdp = maze.mdp
    view = Visibility(~hidden)
    learner = lme_i2rl(mdp, view if hidden.any() else Sensor(), slack=0.0, ridge=ridge)
    state = learner.init(jax.random.key(0))
    state = state._replace(weights=jnp.zeros_like(state.weights))
    perceived = conceal(demonstration, view)
    bits, seconds, spent = np.zeros(demonstration.kind.shape), [], 0.0
    for i in range(demonstration.n_trajectories):
        row = demonstration.select(slice(i, i + 1))
        bits[i] = _code_lengths(_log_policy(mdp, state.weights, state.values), row)[0]
        state, report = learner.update(state, perceived.select(slice(i, i + 1)))
        seconds.append(report.seconds)
        spent += bits[i].sum()
        if on_bout is not None:
            on_bout(i + 1, spent / demonstration.lengths[: i + 1].sum())
    final = _code_lengths(_log_policy(mdp, state.weights, state.values), demonstration)
    errors = None
    if not hidden.any():
        visits = np.bincount(demonstration.state[demonstration.kind == SEEN], minlength=mdp.n_states).astype(
            float
        )
        information = np.asarray(complete_information(mdp, state.weights, jnp.asarray(visits)))
        errors = laplace_errors(information + ridge * np.eye(mdp.n_features))
    learned = Learned(np.asarray(state.weights), errors, np.asarray(state.values), np.array(seconds))
    return _prediction(name, demonstration, hidden, bits, final, mdp.n_features), learned


def predict_with_tables(
    maze: Labyrinth, demonstration: Demonstration, hidden: Bool[np.ndarray, " S"]
) -> list[Prediction]:
    """The baselines, learning from the decisions in view and predicting all of them."""
    n_states = maze.mdp.n_states
    choice = maze.choice
    everywhere, every_state = np.zeros(n_states, int), np.ones(n_states, bool)
    tables = {
        UNIFORM: (everywhere, ~every_state),
        "frequencies": (everywhere, every_state),
        "frequencies of choices": (everywhere, choice),
        "given entry": (maze.entry, every_state),
        "level and entry": (_level_and_entry(maze), every_state),
        "Markov": (np.arange(n_states), every_state),
    }
    return [
        predict_with_table(maze, demonstration, hidden, name, context, teaches)
        for name, (context, teaches) in tables.items()
    ]


def _level_and_entry(maze: Labyrinth) -> Int[np.ndarray, " S"]:
    levels = np.array([level_of(int(node)) for node in maze.node])
    return (levels + 1) * len(ENTRIES) + maze.entry


def predict_with_table(
    maze: Labyrinth,
    demonstration: Demonstration,
    hidden: Bool[np.ndarray, " S"],
    name: str,
    context: Int[np.ndarray, " S"],
    teaches: Bool[np.ndarray, " S"],
) -> Prediction:
    """Action frequencies given a context of the state, counted from one, in the states that ``teaches``."""
    available = np.asarray(maze.mdp.available)
    counts = np.ones((context.max() + 1, available.shape[1]))
    teaches = teaches & ~hidden

    def log_policy() -> Float[np.ndarray, "S A"]:
        weight = np.where(available, counts[context], 0.0)
        with np.errstate(divide="ignore"):
            return np.log(weight / weight.sum(1, keepdims=True))

    bits = np.zeros(demonstration.kind.shape)
    for i in range(demonstration.n_trajectories):
        row = demonstration.select(slice(i, i + 1))
        bits[i] = _code_lengths(log_policy(), row)[0]
        state, action = row.state[row.kind == SEEN], row.action[row.kind == SEEN]
        learned = teaches[state]
        np.add.at(counts, (context[state[learned]], action[learned]), 1.0)
    # A context in which nothing is ever chosen or learned has no free numbers.
    contexts = len(np.unique(context[maze.choice & teaches]))
    final = _code_lengths(log_policy(), demonstration)
    return _prediction(name, demonstration, hidden, bits, final, contexts * (available.shape[1] - 1))


@jax.jit
def _log_policy(
    mdp: TabularMDP, weights: Float[Array, " K"], values: Float[Array, " S"]
) -> Float[Array, "S A"]:
    return soft_plan(mdp, reward_of(mdp, weights), values).log_policy


def _code_lengths(log_policy: ArrayLike, demonstration: Demonstration) -> Float[np.ndarray, "n L"]:
    """Bits that each decision costs under a policy ``[S, A]``; zero on padding."""
    lengths = -np.asarray(log_policy)[demonstration.state, demonstration.action] / np.log(2)
    return np.where(demonstration.kind == PAD, 0.0, lengths)


def _per_bout(demonstration: Demonstration, steps: Float[np.ndarray, "n L"]) -> Float[np.ndarray, " n"]:
    return np.where(demonstration.kind == PAD, 0.0, steps).sum(1)


def _prediction(
    name: str,
    demonstration: Demonstration,
    hidden: Bool[np.ndarray, " S"],
    bits: Float[np.ndarray, "n L"],
    final: Float[np.ndarray, "n L"],
    parameters: int,
) -> Prediction:
    outside = np.where(hidden[demonstration.state], bits, 0.0)
    return Prediction(
        name, bits.sum(1), outside.sum(1), float(final.sum() / demonstration.lengths.sum()), parameters
    )


# -- summaries ----------------------------------------------------------------------------------------


def bits_per_decision(
    bits: Float[np.ndarray, " n"], decisions: Int[np.ndarray, " n"], draws: int = 2000
) -> Interval:
    """Total bits over total decisions, with a bootstrap interval over bouts.

    ``bits`` may be a difference of two methods' bits: the interval is then that of the paired difference.
    The same bouts are drawn at every call.
    """
    n = len(bits)
    drawn = np.asarray(jax.random.randint(jax.random.key(0), (draws, n), 0, n))
    ratios = bits[drawn].sum(1) / decisions[drawn].sum(1)
    low, high = np.quantile(ratios, [0.025, 0.975])
    return Interval(float(bits.sum() / decisions.sum()), float(low), float(high))


def summary(result: LabyrinthStudy) -> dict[str, Any]:
    """The study as plain numbers (for JSON): every method's scores, weights by feature, values by state."""
    mdp = result.maze.mdp
    views: dict[str, Any] = {}
    for view in result.views:
        first = view.predictions[0]
        outside = int(view.decisions_out_of_view.sum())
        methods = {
            p.method: {
                "bits_per_decision": bits_per_decision(p.bits, result.decisions)._asdict(),
                f"more_than_{LEARNER}": bits_per_decision(p.bits - first.bits, result.decisions)._asdict(),
                "bits_per_decision_out_of_view": float(p.bits_out_of_view.sum()) / outside
                if outside
                else None,
                "bits_per_decision_afterwards": p.afterwards,
                "parameters": p.parameters,
                "bits_of_each_bout": p.bits.tolist(),
            }
            for p in view.predictions
        }
        views[view.view] = {
            "decisions_out_of_view": outside,
            "methods": methods,
            "seconds_per_session": {
                "median": float(np.median(view.learned.seconds)),
                "first": float(view.learned.seconds[0]),
            },
            "weights": dict(zip(mdp.feature_names, view.learned.weights.tolist(), strict=True)),
            "intervals": None if (found := _estimates(result, view)) is None else found.summary(),
            "values": dict(zip(mdp.state_names, view.learned.values.tolist(), strict=True)),
        }
    told: dict[str, Any] = plain({
        "provenance": study_provenance(0),
        "recording": result.recording,
        "bouts": len(result.decisions),
        "decisions": int(result.decisions.sum()),
        "decisions_of_each_bout": result.decisions.tolist(),
        "discount": float(mdp.discount),
        "ridge": result.ridge,
        "views": views,
    })  # fmt: skip
    return told


def _estimates(result: LabyrinthStudy, view: ViewStudy) -> Estimates | None:
    """All weights of a view with their errors; None where some of the maze was hidden."""
    if view.learned.errors is None:
        return None
    return Estimates(result.maze.mdp.feature_names, view.learned.weights, view.learned.errors)


def tables(result: LabyrinthStudy) -> list[Table]:
    """One table a view, methods in order of their score, intervals 95 % over bouts."""
    made = []
    for view in result.views:
        outside = view.decisions_out_of_view.sum()
        first = view.predictions[0]
        rows: list[tuple[str | float, ...]] = []
        for p in sorted(view.predictions, key=lambda p: -p.bits.sum()):
            score = bits_per_decision(p.bits, result.decisions)
            delta = bits_per_decision(p.bits - first.bits, result.decisions)
            apart = p is not first
            rows.append((
                p.method,
                f"{score.estimate:.3f} ({score.low:.3f} to {score.high:.3f})",
                f"{delta.estimate:+.3f} ({delta.low:+.3f} to {delta.high:+.3f})" if apart else "-",
                *([f"{p.bits_out_of_view.sum() / outside:.3f}"] if outside else []),
                f"{p.afterwards:.3f}",
                p.parameters,
            ))  # fmt: skip
        hidden = ["on hidden decisions"] if outside else []
        made.append(
            Table(
                (
                    "method",
                    "bits per decision",
                    f"more than {LEARNER}'s",
                    *hidden,
                    "once learned",
                    "parameters",
                ),
                rows,
                f"With the {view.view if outside else 'whole maze in view'}: bits per decision on bouts not "
                f"yet seen, and how many more than {LEARNER} needs, bout by bout (95 % intervals over "
                "bouts). Once learned: on the recording that was learned from. Parameters: free numbers.",
            )
        )
    return made


def print_tables(result: LabyrinthStudy, console: Console) -> None:
    """Print one table a view."""
    print_page_tables(tables(result), console, f"{result.recording}: {_size(result)}")


# -- the page -------------------------------------------------------------------------------------------

# Of the weights on single nodes, those farthest from zero in their standard errors.
_PLACES = 8


def _size(result: LabyrinthStudy) -> str:
    return f"{counted(len(result.decisions), 'bout')}, {counted(int(result.decisions.sum()), 'decision')}"


def _lead(result: LabyrinthStudy) -> Lead:
    view = result.views[0]
    first = view.predictions[0]
    others = {p.method: p for p in view.predictions[1:] if p.method != BY_LEVEL}
    best = min(others.values(), key=lambda p: p.bits.sum())
    mine = bits_per_decision(first.bits, result.decisions)
    uniform = bits_per_decision(others[UNIFORM].bits, result.decisions).estimate
    gain = bits_per_decision(others[UNIFORM].bits - first.bits, result.decisions)
    gap = bits_per_decision(best.bits - first.bits, result.decisions)
    learned = (
        f"From {_size(result)} of {result.recording}, {LEARNER} learned a reward that predicts each new bout "
        f"with {number(mine.estimate)} bits per decision ({number(mine.low)} to {number(mine.high)}), where "
        f"choosing at random takes {number(uniform)}."
    )
    told = f"({gap.low:+.3f} to {gap.high:+.3f} bits per decision, bout by bout)"
    if gain.low <= 0:
        trust = "Do not trust it: it does not predict better than choosing at random beyond chance."
    elif gap.high < 0:
        trust = (
            f"Trust it for what the animal prefers, not as the best predictor: the table {best.method} "
            f"predicts better {told}, so that habits are missing from this reward."
        )
    else:
        trust = (
            "Trust it as far as its intervals go, since no table of counts predicts better; the nearest is "
            f"{best.method} {told}."
        )
    estimates = _estimates(result, view)
    assert estimates is not None
    shared = len(SHARED_FEATURES)
    places = np.argsort(-np.abs(estimates.weights[shared:] / estimates.errors[shared:]))[:_PLACES] + shared
    chosen = np.concatenate([np.arange(shared), places])
    shown = Estimates(
        [estimates.names[k] for k in chosen], estimates.weights[chosen], estimates.errors[chosen]
    )
    table = shown.table(
        f"Weights learned with the whole maze in view (nats a step): the {shared} that places share, and the "
        f"{counted(len(places), 'place')} farthest from zero in standard errors. Intervals are those of the "
        f"posterior's curvature under the prior of precision {number(result.ridge)}; "
        f"{len(estimates.determined)} of all {len(estimates.names)} leave zero out."
    )
    return Lead(learned, trust, [table])


def _text(result: LabyrinthStudy) -> str:
    views = [view.view for view in result.views]
    return f"""Each bout is predicted before it is learned from, so that nothing is tested on what it \
taught. The score is the code length of the animal's decisions, in bits; forced steps cost nobody anything. \
Learned with: {listed(views)}.

{LEARNER} learns a weight for each place reached and one each for turning round and going deeper. \
{BY_LEVEL} has the latter for each level of the maze. The others count actions, from one on: over all steps \
or over choices alone, given how a junction was entered, given that and its level, or given the node and the \
entry (Markov). The discount is {number(float(result.maze.mdp.discount))}."""


def write(result: LabyrinthStudy, folder: Path | str) -> Path:
    """Write the page: ``index.html``, the pictures in both themes, and ``results.json``."""
    from .figures import bits_by_bout, value_on_maze

    pictures = [
        drawn(
            folder, "bits", lambda theme: bits_by_bout(result, theme),
            "Running bits per decision, each bout predicted before it is learned from; lower is better.",
            "Bits per decision against bouts, a line a method",
        ),
        drawn(
            folder, "value", lambda theme: value_on_maze(result, theme),
            "Learned value of every place, entered from above: orange ones are worth less than zero, blue "
            "ones more. The maze is drawn as its environment draws it, home below.",
            "The maze with every corridor shaded by the learned value of the place it leads to",
        ),
    ]  # fmt: skip
    sections = [Section("Prediction", _text(result), tables(result), pictures)]
    return write_page(
        folder, f"What the mouse {result.recording} seeks", _lead(result), sections, summary(result)
    )
