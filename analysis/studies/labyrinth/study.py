"""Study of a mouse in the labyrinth: prediction, bout by bout, of bouts not yet seen.

A learner predicts each decision of a bout before learning from it; the score is the code length of the
animal's decisions, in bits per decision (prequential: every test is on new data). Every step counts as a
decision; those at ends are forced and cost zero bits, so uniform choice costs ``log2 3`` times the share of
steps at junctions. The baselines learn in the same way, each a table of counts that start at one (Laplace's
rule), renormalised over the available actions:

``uniform``
    over the available actions.
``frequencies``
    of the actions over all steps. Forced steps back count too, which makes it worse than uniform;
    ``frequencies of choices`` leaves them out.
``given entry``
    frequencies given how the node was entered: from above, from either child, or as an end.
``Markov``
    frequencies per node and entry, a Markov chain over states; ``level and entry`` pools a level's nodes.

The Markov chain stays ahead for this reason. It has two free numbers for each of 189 situations. A reward on
the node reached, with *one* weight for turning round and one for going deeper, cannot express that the animal
turns at one level and goes on at another. Even fitted to the whole recording with hardly a prior (ridge
0.001) it needs 1.088 bits (D9a) and 1.079 (D9b), where the chain's maximum-likelihood fit takes 0.861 and
0.815: more data would not help. ``level and entry``, with 36 numbers, takes most of the distance, so the
reward lacks habits of a level more than places; ``i2rl, by level``, whose weights differ from level to level,
recovers about two thirds of the distance on D9a and two fifths on D9b.

Discount and ridge were chosen by this score on D9a among discounts 0.3, 0.5, 0.7, 0.9 and ridges 2, 4, 8, 16,
32; D9b took no part in it. Shorter horizons predict better throughout (discounts below 0.3 gain at most 0.003
bits more). The likelihood without a prior hardly depends on the discount, since a weight on every node can
compensate for it: the discount sets the prior's behaviour, and with a long horizon zero weights mean "seek
places with many exits".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from ....domains.labyrinth.process import (
    ENTRIES,
    Bout,
    Labyrinth,
    conceal,
    demonstration_of,
    labyrinth_by_level,
    level_of,
    mouse_labyrinth,
)
from ....inference.learners.lme import lme_i2rl
from ....models.observation.demonstration import PAD, SEEN, Demonstration
from ....models.observation.evidence import Sensor, Visibility
from ....models.process.mdp import TabularMDP
from ....models.process.planning import reward_of, soft_plan
from ...drawing.estimates import laplace_errors
from ...posteriors.information import complete_information

if TYPE_CHECKING:
    pass

DISCOUNT = 0.3
RIDGE = 16.0
LEARNER, BY_LEVEL, UNIFORM = "i2rl", "i2rl, by level", "uniform"


class Prediction(NamedTuple):
    """Prediction of each bout by one method before it learns from the bout.

    Fields
    ------
    method : str
    bits : float ``[n]``
        Code length of each bout's decisions.
    bits_out_of_view : float ``[n]``
        The part of it spent on decisions in states the learner never sees.
    afterwards : float
        Bits per decision over the whole recording under what had been learned by its end: the method's
        capacity, within its prior.
    parameters : int
        Free numbers it learns.
    """

    method: str
    bits: Float[np.ndarray, " n"]
    bits_out_of_view: Float[np.ndarray, " n"]
    afterwards: float
    parameters: int


class Learned(NamedTuple):
    """State of the learner at the end.

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


def labyrinth_study(
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
        Its name, for the page.
    discount, ridge : float
        Of the learner; the ridge is the precision of the Gaussian prior on its weights.
    hide_left : bool
        Whether to learn a second time with the left half of the maze hidden.
    on_bout : callable or None
        Called after each session with the view's name, the bout's number (from 1) and the running bits per
        decision of the learner.

    Raises ``ValueError`` for an empty recording or a discount outside (0, 1).

    See Also
    --------
    i2rl.domains.simulate_bouts : bouts to learn from
    i2rl.domains.read_bouts : read recorded ones

    Examples
    --------
    >>> import jax
    >>> from i2rl.analysis import labyrinth_study
    >>> from i2rl.domains import mouse_labyrinth, simulate_bouts
    >>> maze = mouse_labyrinth()
    >>> bouts = simulate_bouts(jax.random.key(0), maze, jax.numpy.zeros(maze.mdp.n_features), 3, max_steps=64)
    >>> predictions = labyrinth_study(bouts, hide_left=False).views[0].predictions
    >>> predictions[0].bits.shape, [prediction.method for prediction in predictions[:3]]
    ((3,), ['i2rl', 'i2rl, by level', 'uniform'])
    """
    if not bouts:
        raise ValueError("the recording has no bouts")
    maze = mouse_labyrinth(discount)
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
    """Run LME-I2RL, a session a bout; predict each bout whole, also its hidden steps.

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
    """Predict all decisions by the baselines, which learn from the decisions in view."""
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
    """Predict by action frequencies given a context of the state, counted from one, in the states that
    ``teaches``.
    """
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
    # A context without choices or data has no free numbers.
    contexts = len(np.unique(context[maze.choice & teaches]))
    final = _code_lengths(log_policy(), demonstration)
    return _prediction(name, demonstration, hidden, bits, final, contexts * (available.shape[1] - 1))


@jax.jit
def _log_policy(
    mdp: TabularMDP, weights: Float[Array, " K"], values: Float[Array, " S"]
) -> Float[Array, "S A"]:
    return soft_plan(mdp, reward_of(mdp, weights), values).log_policy


def _code_lengths(log_policy: ArrayLike, demonstration: Demonstration) -> Float[np.ndarray, "n L"]:
    """Compute the bits of each decision under a policy ``[S, A]``; zero on padding."""
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
    """Compute total bits over total decisions, with a bootstrap interval over bouts.

    ``bits`` may be a difference of two methods' bits: the interval is then that of the paired difference.
    The same bouts are drawn at every call.
    """
    n = len(bits)
    drawn = np.asarray(jax.random.randint(jax.random.key(0), (draws, n), 0, n))
    ratios = bits[drawn].sum(1) / decisions[drawn].sum(1)
    low, high = np.quantile(ratios, [0.025, 0.975])
    return Interval(float(bits.sum() / decisions.sum()), float(low), float(high))


# -- the page -------------------------------------------------------------------------------------------

# Of the weights on single nodes, those farthest from zero in their standard errors.
PLACES = 8
