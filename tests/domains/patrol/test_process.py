"""The patrol domains against the maps, features and rules they reconstruct."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains.patrol.process import (
    FORWARD,
    LEFT,
    RIGHT,
    STOP,
    Interaction,
    State,
    boyd_fifth_floor,
    boyd_with_rooms,
    break_ties,
    demonstrate,
    four_hallways,
    instance,
    simulate_patrol,
)
from i2rl.models import hard_plan, reward_of
from i2rl.models.observation.demonstration import HIDDEN, SEEN

# Drawn by hand, row by row; "." is a cell that patrollers can stand on.
MAPS = {
    2: [".########", *[".#......."] * 15, ".########"],
    3: [
        "#################.",
        "..........#.....#.",
        "....#######.....#.",
        "..........#.....#.",
        "..........#.....#.",
        "..........#..####.",
        *["................#."] * 7,
        "..............###.",
    ],
}
INSTANCES = (1, 2, 3)


def drawn_cells(number):
    # In these maps "#" marks the hallways, as in the released code.
    return {(r, c) for r, row in enumerate(MAPS[number]) for c, mark in enumerate(row) if mark == "#"}


def index_of(patrol, *state):
    return patrol.states.index(State(*state))


def follow(patrol, state, action):
    """Return the state that an action intends: the likelier of the listed successors."""
    return patrol.states[int(patrol.mdp.successors[index_of(patrol, *state), action, 0])]


def expert_cycle(patrol, start, steps=200):
    """Follow the optimal policy to its loop if every move succeeds."""
    policy = patrol.expert_policy().argmax(1)
    successors = np.asarray(patrol.mdp.successors)[..., 0]
    path = [start]
    for _ in range(steps):
        path.append(int(successors[path[-1], policy[path[-1]]]))
    first = path.index(path[-1])
    loop = path[first:-1]
    return loop[: next((n for n in range(1, len(loop)) if loop[n] == loop[0]), len(loop))]


# -- maps -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "count"), [(1, 192), (2, 124), (3, 184)])
def test_instances_have_the_dissertations_number_of_states(number, count):
    assert instance(number).mdp.n_states == len(set(instance(number).states)) == count


@pytest.mark.parametrize("number", [2, 3])
def test_cells_are_those_of_the_drawn_map(number):
    assert set(instance(number).cells) == drawn_cells(number)


def test_first_instance_has_25_cells_in_four_phases():
    patrol = four_hallways()
    phases = [{s.cell for s in patrol.states if s.phase == g} for g in range(1, 5)]
    assert [len(cells) for cells in phases] == [13, 11, 13, 11]
    assert len(patrol.cells) == 25


@pytest.mark.parametrize(("number", "extra"), [(2, {(0, 0)}), (3, {(0, 17), (1, 0), (13, 13)})])
def test_the_learner_may_use_a_few_cells_more(number, extra):
    patrol = instance(number)
    assert set(patrol.breach.cells) - set(patrol.cells) == extra
    assert patrol.breach.start.cell in extra


def test_first_instance_has_no_breach_and_other_numbers_no_instance():
    assert four_hallways().breach is None
    with pytest.raises(ValueError, match="1, 2 and 3, got 4"):
        instance(4)


# -- movement ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [2, 3])
def test_moves_turn_in_place_step_ahead_or_stay(number):
    patrol = instance(number)
    cells = drawn_cells(number)
    ahead = [(0, 1), (-1, 0), (0, -1), (1, 0)]
    for state in patrol.states:
        r, c, h, _ = state
        down, across = ahead[h]
        target = (r + down, c + across)
        expected = target if target in cells else (r, c)
        assert follow(patrol, state, FORWARD) == State(*expected, h)
        assert follow(patrol, state, LEFT) == State(r, c, (h + 1) % 4)
        assert follow(patrol, state, RIGHT) == State(r, c, (h - 1) % 4)
        assert follow(patrol, state, STOP) == state


@pytest.mark.parametrize(("number", "success"), [(1, 0.99), (2, 0.95), (3, 0.99)])
def test_a_move_succeeds_or_changes_nothing(number, success, dense_transitions):
    patrol = instance(number)
    moves = dense_transitions(patrol.mdp)
    stay = np.einsum("sas->sa", moves)
    assert set(np.round(stay, 12).ravel()) == {round(1 - success, 12), 1.0}
    # All mass that does not stay lands on one state.
    assert np.allclose(stay + np.where(np.eye(len(moves))[:, None] > 0, 0, moves).max(2), 1)
    assert (stay[:, STOP] == 1).all()


def test_first_instance_changes_phase_on_reaching_the_next_end():
    patrol = four_hallways()
    assert follow(patrol, State(0, 7, 0, 1), FORWARD) == State(0, 8, 0, 2)
    assert follow(patrol, State(3, 7, 0, 2), FORWARD) == State(3, 8, 0, 3)
    assert follow(patrol, State(8, 1, 2, 3), FORWARD) == State(8, 0, 2, 4)
    assert follow(patrol, State(5, 1, 2, 4), FORWARD) == State(5, 0, 2, 1)
    # A hallway whose turn it is not yet is walled off.
    assert follow(patrol, State(3, 4, 0, 1), FORWARD) == State(3, 4, 0, 1)


def test_first_instance_rewards_exactly_the_steps_that_change_phase():
    patrol = four_hallways()
    intended = np.asarray(patrol.mdp.successors)[..., 0]
    phase = np.array([s.phase for s in patrol.states])
    fired = np.asarray(patrol.mdp.features)
    changes = phase[intended] != phase[:, None]
    assert np.array_equal(fired.sum(2) == 1, changes)
    s, a = np.nonzero(changes)
    assert np.array_equal(fired[s, a].argmax(1) + 1, phase[intended[s, a]])


# -- features ---------------------------------------------------------------------------------------------


def test_second_instance_features_follow_the_table():
    patrol = boyd_fifth_floor()
    regions = [
        {(r, 1) for r in range(1, 16)},
        {(0, 1), (0, 2), (1, 1), (15, 1), (16, 1), (16, 2)},
        {(0, 2), (0, 3), (16, 2), (16, 3)},
        {(0, 4), (0, 5), (16, 4), (16, 5)},
        {(r, c) for r in (0, 16) for c in (6, 7, 8)},
    ]
    phi = np.asarray(patrol.mdp.features)
    for i, state in enumerate(patrol.states):
        blocked = follow(patrol, state, FORWARD) == state
        assert phi[i, FORWARD].tolist() == [not blocked, 0, 0, 0, 0, 0]
        assert phi[i, STOP].tolist() == [0] * 6
        for turn in (LEFT, RIGHT):
            assert phi[i, turn].tolist() == [0, *(state.cell in region for region in regions)]


def test_third_instance_features_follow_the_table():
    patrol = boyd_with_rooms()

    def in_room(state):
        return state.column < 16 and 0 < state.row < 13

    assert sum(in_room(State(r, c, 0)) for r, c in patrol.cells) == 14
    phi = np.asarray(patrol.mdp.features)
    for (i, state), action in itertools.product(enumerate(patrol.states), range(4)):
        target = follow(patrol, state, action)
        moved = target.cell != state.cell
        turns = action == LEFT and (state.row == 0 or state.column == 16)
        enters = moved and not in_room(state) and in_room(target)
        leaves = moved and in_room(state) and not in_room(target)
        assert phi[i, action].tolist() == [moved, in_room(state), turns, enters, leaves]


@pytest.mark.parametrize(
    ("number", "weights"),
    [(1, [1, 1, 1, 1]), (2, [0.57, 0, 0, 0, 0.43, 0]), (3, [1, -1, 0.1, 0, 0])],
)
def test_true_weights_are_the_dissertations_up_to_scale(number, weights):
    given, patrol = np.array(weights, float), instance(number)
    scale = given[0] / patrol.weights[0]
    assert np.allclose(patrol.weights * scale, given, atol=0.005)


# -- behaviour --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", INSTANCES)
def test_the_expert_walks_the_loop(number):
    patrol = instance(number)
    assert {len(expert_cycle(patrol, s)) for s in range(0, patrol.mdp.n_states, 7)} == {patrol.loop}
    assert patrol.loop == {1: 64, 2: 56, 3: 64}[number]


def test_second_instance_turns_round_at_the_fifth_cell():
    patrol = boyd_fifth_floor()
    policy = patrol.expert_policy().argmax(1)
    turns = [patrol.states[s].cell for s in expert_cycle(patrol, 0) if policy[s] in (LEFT, RIGHT)]
    # Two turns at each end, one at each corner on the way there and back.
    assert sorted(turns) == [(0, 1)] * 2 + [(0, 5)] * 2 + [(16, 1)] * 2 + [(16, 5)] * 2


def test_first_instance_visits_all_four_ends():
    patrol = four_hallways()
    visited = {patrol.states[s].cell for s in expert_cycle(patrol, 0)}
    assert {(5, 0), (0, 8), (3, 8), (8, 0)} <= visited


def test_third_instance_keeps_out_of_the_rooms():
    patrol = boyd_with_rooms()
    cells = {patrol.states[s].cell for s in expert_cycle(patrol, 0)}
    assert cells == {(0, c) for c in range(17)} | {(r, 16) for r in range(1, 14)}


@pytest.mark.parametrize(("number", "tied"), [(2, 6), (3, 15)])
def test_ties_between_turns_go_right(number, tied):
    patrol = instance(number)
    optimal = np.asarray(hard_plan(patrol.mdp, reward_of(patrol.mdp, jnp.asarray(patrol.weights))).optimal)
    policy = patrol.expert_policy()
    ties = optimal.sum(1) > 1
    assert ties.sum() == tied
    assert (optimal[ties][:, [LEFT, RIGHT]]).all()
    assert (policy[ties].argmax(1) == RIGHT).all()
    assert (policy <= optimal).all()


def test_break_ties_prefers_forward_then_right_then_left():
    optimal = np.array([[1, 1, 1, 1], [0, 1, 1, 1], [0, 1, 0, 1], [0, 0, 0, 1]], bool)
    assert break_ties(optimal).argmax(1).tolist() == [FORWARD, RIGHT, LEFT, STOP]


# -- views ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "observability", "cells", "share"),
    [
        (1, 30, 6, 0.312),
        (1, 44, 9, None),
        (1, 100, 25, 1.0),
        (2, 11, 2, 0.107),
        (2, 18, 4, 0.179),
        (2, 30, 8, 0.304),
        (2, 41, 13, 0.411),
        (2, 70, 22, 0.732),
        (2, 100, 31, 1.0),
        (3, 9, 4, 0.156),
        (3, 18, 8, 0.281),
        (3, 33, 15, 0.438),
        (3, 46, 21, 0.531),
        (3, 65, 30, 0.719),
        (3, 100, 46, 1.0),
    ],
)
def test_views_cover_the_stated_cells_and_share_of_the_loop(number, observability, cells, share):
    patrol = instance(number)
    view = patrol.views[observability]
    assert len({s.cell for s, seen in zip(patrol.states, view, strict=True) if seen}) == cells
    loop = expert_cycle(patrol, 0)
    if share is not None:
        assert view[loop].mean() == pytest.approx(share, abs=0.0015)


@pytest.mark.parametrize("number", [2, 3])
def test_views_grow_and_do_not_depend_on_heading(number):
    patrol = instance(number)
    views = [patrol.views[k] for k in sorted(patrol.views)]
    assert all((small <= large).all() for small, large in itertools.pairwise(views))
    cell = patrol.cell_of_state
    assert all(len(set(view[cell == c])) == 1 for view in views for c in range(len(patrol.cells)))


def test_an_unknown_view_names_those_there_are():
    with pytest.raises(ValueError, match=r"patrol2 has no 50 % view; it has \[11, 18, 30, 41, 70, 100\]"):
        boyd_fifth_floor().visibility(50)


# -- meeting ----------------------------------------------------------------------------------------------


def walk(patrol, starts, steps, interaction, key=0):
    policy = jnp.log(jnp.asarray(patrol.expert_policy()))
    policies = jnp.broadcast_to(policy, (len(starts), *policy.shape))
    start = jnp.array([index_of(patrol, *s) for s in starts])
    states, actions = simulate_patrol(jax.random.key(key), patrol, policies, start, steps, interaction)
    return np.asarray(states), np.asarray(actions)


def meetings(patrol, states):
    """By step: do the two share a cell, or does one stand where the other just was?"""
    cell = patrol.cell_of_state[states]
    before = np.concatenate([np.full((2, 1), -1), cell[:, :-1]], axis=1)
    return (cell[0] == cell[1]) | (before[0] == cell[1]) | (before[1] == cell[0])


def expected_actions(patrol, states, interaction):
    """Apply the passing rule to a joint walk, step by step; None where a patroller is free to act."""
    meet, counter, rows = meetings(patrol, states), 0, []
    for t in range(states.shape[1]):
        if counter <= 0 and meet[t]:
            counter = interaction.length
        if counter > 1:
            rows.append((STOP, STOP))
        elif counter == 1:
            rows.append(tuple(None if a == FORWARD else a for a in interaction.equilibrium))
        else:
            rows.append((None, None))
        counter -= 1
    return rows


FACING = ((6, 1, 3), (9, 1, 1))


@pytest.mark.parametrize("length", [0, 1, 3])
@pytest.mark.parametrize(
    "equilibrium", [(FORWARD, FORWARD), (STOP, FORWARD), (FORWARD, STOP), (LEFT, FORWARD)]
)
def test_patrollers_act_by_the_passing_rule(length, equilibrium):
    patrol = boyd_fifth_floor()
    interaction = Interaction(equilibrium, length)
    states, actions = walk(patrol, FACING, 120, interaction)
    own = patrol.expert_policy().argmax(1)[states]
    for t, row in enumerate(expected_actions(patrol, states, interaction)):
        for i, forced in enumerate(row):
            assert actions[i, t] == (own[i, t] if forced is None else forced)
    assert meetings(patrol, states).any()


def test_without_a_passing_game_patrollers_walk_on_unaware():
    patrol = boyd_fifth_floor()
    states, actions = walk(patrol, FACING, 200, Interaction(length=0))
    assert np.array_equal(actions, patrol.expert_policy().argmax(1)[states])


def test_those_who_wait_stay_where_they_are():
    patrol = boyd_fifth_floor()
    states, actions = walk(patrol, FACING, 100, Interaction(length=3))
    waiting = actions[:, :-1] == STOP
    assert waiting.any()
    assert (states[:, 1:][waiting] == states[:, :-1][waiting]).all()


def test_passing_takes_both_patrollers_as_long_as_the_game_lasts():
    patrol = boyd_fifth_floor()
    states, actions = walk(patrol, FACING, 30, Interaction((STOP, FORWARD), 3))
    first = int(np.argmax(meetings(patrol, states)))
    assert actions[:, first : first + 2].tolist() == [[STOP, STOP]] * 2
    assert actions[0, first + 2] == STOP
    assert actions[1, first + 2] == FORWARD


def test_steps_taken_are_possible_under_the_dynamics(dense_transitions):
    patrol = boyd_with_rooms()
    states, actions = walk(patrol, ((0, 3, 0), (5, 16, 1)), 300, Interaction())
    moves = dense_transitions(patrol.mdp)
    assert (moves[states[:, :-1], actions[:, :-1], states[:, 1:]] > 0).all()


def test_a_single_patroller_meets_nobody():
    patrol = four_hallways()
    states, actions = walk(patrol, ((5, 2, 2, 1),), 200, Interaction(length=3))
    assert np.array_equal(actions, patrol.expert_policy().argmax(1)[states])


# -- demonstrations ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "observability"), [(1, 30), (2, 30), (3, 18)])
def test_demonstrations_hide_exactly_the_steps_out_of_view(number, observability):
    patrol = instance(number)
    key = jax.random.key(4)
    limited = demonstrate(key, patrol, observability, sessions=40)
    full = demonstrate(key, patrol, 100, sessions=40)
    assert len(limited) == patrol.patrollers
    for seen, truth in zip(limited, full, strict=True):
        assert seen.kind.shape == (40, 5)
        assert (truth.kind == SEEN).all()
        view = patrol.views[observability][truth.state]
        assert np.array_equal(seen.kind == SEEN, view)
        assert np.array_equal(seen.kind == HIDDEN, ~view)
        assert np.array_equal(seen.state[view], truth.state[view])
        assert np.array_equal(seen.action[view], truth.action[view])
        assert (seen.state[~view] == -1).all()
        assert (seen.action[~view] == -1).all()


def test_sessions_are_consecutive_windows_of_one_walk(dense_transitions):
    patrol = boyd_fifth_floor()
    moves = dense_transitions(patrol.mdp)
    for truth in demonstrate(jax.random.key(1), patrol, 100, sessions=30, steps=7):
        states, actions = truth.state.ravel(), truth.action.ravel()
        assert (moves[states[:-1], actions[:-1], states[1:]] > 0).all()


def test_demonstrations_are_reproducible_by_key():
    patrol = boyd_fifth_floor()
    one, same, other = (demonstrate(jax.random.key(k), patrol, 30, 20) for k in (5, 5, 6))
    for a, b, c in zip(one, same, other, strict=True):
        assert np.array_equal(a.codes, b.codes)
        assert not np.array_equal(a.codes, c.codes)


def test_each_instance_is_viewed_at_its_own_observability():
    for patrol, degree in ((instance(1), 30), (instance(2), 30), (instance(3), 18)):
        assert patrol.observability == degree
        np.testing.assert_array_equal(patrol.visibility().in_view, patrol.views[degree])
