"""The labyrinth as a decision process, its recordings, and simulated mice."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from i2rl.domains.labyrinth.process import (
    AT_END,
    BACK,
    FIRST_END,
    FROM_ABOVE,
    HOME,
    LEFT,
    N_NODES,
    WATER_PORT,
    Bout,
    conceal,
    demonstration_of,
    labyrinth_by_level,
    level_of,
    mouse_labyrinth,
    nodes_of,
    pairs_of,
    parent_of,
    read_bouts,
    simulate_bouts,
)
from i2rl.models.observation.demonstration import HIDDEN, PAD, SEEN, DemonstrationError
from i2rl.models.observation.evidence import require_possible
from i2rl.models.process.planning import reachable_states, reward_of, soft_plan

MAZE = mouse_labyrinth(0.8)


def weights_of(**by_feature):
    weights = np.zeros(MAZE.mdp.n_features)
    for name, value in by_feature.items():
        weights[MAZE.mdp.feature_names.index(name.replace("_", " "))] = value
    return weights


def mouse_bouts(n=20, seed=0, **preferences):
    return simulate_bouts(jax.random.key(seed), MAZE, weights_of(**preferences), n)


def line(nodes, **fields):
    return json.dumps({"nodes": nodes, **fields}) + "\n"


def test_every_node_can_be_reached_in_every_way_of_entering_it():
    assert (MAZE.mdp.n_states, MAZE.mdp.n_features) == (3 * 63 + 64 + 1, 6 + 127)
    assert reachable_states(MAZE.mdp).all()


def test_moves_follow_the_tree_and_stepping_back_undoes_stepping_in():
    successors, available = np.asarray(MAZE.mdp.successors)[..., 0], np.asarray(MAZE.mdp.available)
    for s in range(MAZE.mdp.n_states):
        node = MAZE.node[s]
        if node == HOME:
            assert successors[s, BACK] == s
            assert not available[s, 1:].any()
            continue
        assert MAZE.node[successors[s, BACK]] == (HOME if node == 0 else (node - 1) // 2)
        if node >= FIRST_END:
            assert available[s].tolist() == [True, False, False]
            continue
        for a in (1, 2):
            child = successors[s, a]
            assert MAZE.node[child] == 2 * node + a
            assert MAZE.node[successors[child, BACK]] == node
            assert MAZE.entry[child] == (AT_END if 2 * node + a >= FIRST_END else FROM_ABOVE)


def test_features_describe_the_step():
    phi = {name: np.asarray(MAZE.mdp.features)[..., k] for k, name in enumerate(MAZE.mdp.feature_names)}
    states, actions = pairs_of(MAZE, [0, 2, 6, 13, 27, 56, 27, 55, 112, 55, 111, 55, 27, 13, 6, 2, 0, HOME])

    def steps(name):
        return np.flatnonzero(phi[name][states, actions])

    assert steps("reaches home").tolist() == [16]
    assert steps("reaches an end").tolist() == [7, 9]
    # Out of 56 (entered from above, left again upwards), and out of both ends.
    assert steps("turns round").tolist() == [5, 8, 10]
    assert steps("goes deeper").tolist() == [0, 1, 2, 3, 4, 6, 7, 9]
    assert steps("reaches 27").tolist() == [3, 5, 11]
    assert phi["level"][states, actions][:5] == pytest.approx(np.arange(1, 6) / 6)
    water, action = pairs_of(MAZE, [0, *way_to(WATER_PORT)])
    assert phi["reaches the water port"][water, action].tolist() == [0, 0, 0, 0, 0, 1]
    assert not np.asarray(MAZE.mdp.features)[MAZE.node == HOME].any()


def way_to(node):
    """List the nodes from below the root down to ``node``."""
    path = [node]
    while path[0] != 0:
        path.insert(0, parent_of(path[0]))
    return path[1:]


def test_by_level_the_further_features_sum_to_the_common_ones():
    richer = labyrinth_by_level(0.8).mdp
    phi = {name: np.asarray(richer.features)[..., k] for k, name in enumerate(richer.feature_names)}
    ends = (MAZE.entry == AT_END)[:, None]
    for common in ("turns round", "goes deeper"):
        by_level = sum(phi[f"{common} from level {n}"] for n in range(6))
        np.testing.assert_array_equal(by_level, np.where(ends, 0, phi[common]))
    np.testing.assert_array_equal(richer.features[..., :133], MAZE.mdp.features)


def test_levels_of_a_binary_tree():
    assert [level_of(n) for n in (HOME, 0, 1, 2, 3, 6, 62, 63, 126)] == [-1, 0, 1, 1, 2, 2, 5, 6, 6]


def test_every_step_of_a_bout_is_one_action_and_leads_back_to_the_nodes():
    for bout in mouse_bouts(reaches_home=1.0):
        states, actions = pairs_of(MAZE, bout.nodes)
        assert len(states) == len(bout.nodes) - 1
        assert np.asarray(MAZE.mdp.available)[states, actions].all()
        assert nodes_of(MAZE, states, actions) == bout.nodes


def test_simulated_bouts_begin_at_the_root_and_end_at_home_or_at_the_cut():
    bouts = simulate_bouts(jax.random.key(1), MAZE, np.zeros(133), 30, max_steps=40)
    assert all(b.nodes[0] == 0 and HOME not in b.nodes[:-1] for b in bouts)
    home = [b.nodes[-1] == HOME for b in bouts]
    assert 0 < sum(home) < 30
    assert all(len(b.nodes) == 41 for b, arrived in zip(bouts, home, strict=True) if not arrived)


def test_simulated_bouts_follow_the_soft_policy():
    weights = weights_of(turns_round=-1.0, goes_deeper=0.5, reaches_2=1.0)
    bouts = simulate_bouts(jax.random.key(2), MAZE, weights, 400)
    first = np.array([pairs_of(MAZE, b.nodes)[1][0] for b in bouts])
    policy = np.exp(soft_plan(MAZE.mdp, reward_of(MAZE.mdp, weights)).log_policy[0])
    frequency = np.bincount(first, minlength=3) / 400
    assert np.abs(frequency - policy).max() < 4 * np.sqrt(0.25 / 400)


def test_a_demonstration_of_bouts_is_possible_and_padded():
    bouts = mouse_bouts(n=5, reaches_home=1.0)
    demonstration = demonstration_of(MAZE, bouts)
    assert demonstration.lengths.tolist() == [len(b.nodes) - 1 for b in bouts]
    require_possible(MAZE.without_left_half(), MAZE.mdp, conceal(demonstration, MAZE.without_left_half()))


def test_hiding_the_left_half_hides_exactly_what_happens_below_node_1():
    nodes = (0, 1, 3, 1, 0, 2, 0, HOME)
    demonstration = demonstration_of(MAZE, [Bout("x", nodes), Bout("y", (0, HOME))])
    hidden = conceal(demonstration, MAZE.without_left_half())
    assert hidden.kind.tolist() == [[SEEN, HIDDEN, HIDDEN, HIDDEN, SEEN, SEEN, SEEN], [SEEN] + [PAD] * 6]
    assert hidden.state[0, 1:4].tolist() == [-1, -1, -1]
    assert hidden.action[0].tolist() == [LEFT, -1, -1, -1, 2, BACK, BACK]
    inside = {int(n) for n in MAZE.node[MAZE.below(1)]}
    assert inside == {n for n in range(1, N_NODES) if way_to(n)[0] == 1}


def test_reading_gives_back_what_was_written():
    bouts = mouse_bouts(n=4, reaches_home=1.0)
    lines = [line(b.nodes, id=b.id, frames=list(range(len(b.nodes)))) for b in bouts]
    read = list(read_bouts([lines[0], "\n", *lines[1:]]))
    assert [(b.id, b.nodes) for b in read] == [(b.id, b.nodes) for b in bouts]
    assert read[0].frames == tuple(range(len(bouts[0].nodes)))


def test_a_bout_that_the_recording_cuts_off_is_read_to_its_last_node():
    (bout,) = read_bouts([line([0, 1, 3, 8])])
    assert bout == Bout(None, (0, 1, 3, 8), None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"nodes": [0, 127', r"D9, line 2: not valid JSON .*cut off"),
        ("[0, 127]\n", r'line 2: a bout is an object with a list "nodes"'),
        (line([0, 127], junctions=3), r"line 2: unknown field 'junctions'"),
        (line([0]), r"line 2: a bout visits at least two nodes, got 1"),
        (line([0, 128]), r"line 2, nodes\[1\]: unknown node 128"),
        (line([0, 1.0, 0, 127]), r"line 2, nodes\[1\]: unknown node 1.0"),
        (line([0, True, 0, 127]), r"line 2, nodes\[1\]: unknown node True"),
        (line([1, 0, 127]), r"line 2, nodes\[0\]: a bout begins at node 0, got 1"),
        (line([0, 2, 6, 127]), r"line 2, nodes\[3\]: no step leads from node 6 to 127"),
        (line([0, 2, 2, 0, 127]), r"nodes\[2\]: no step leads from node 2 to 2"),
        (line([0, 1, 3, 7, 15, 31, 63, 127]), r"nodes\[7\]: no step leads from node 63 to 127"),
        (line([0, 127, 0, 127]), r"line 2, nodes\[2\]: the bout goes on after home"),
        (line([0, 127], frames=[5]), r"line 2: frames must be a list of one number per node \(2\), got 1"),
        (line([0, 127], frames=[5, "x"]), r"line 2, frames\[1\]: a frame is a number, got 'x'"),
        ('{"nodes": [0, 127], "frames": [1, NaN]}', r"line 2, frames\[1\]: a frame is a number, got nan"),
        ('{"nodes": [0, 127], "frames": [1, 1e999]}', r"line 2, frames\[1\]: a frame is a number, got inf"),
        (line([0, 127], frames=[1, 2**64]), r"line 2, frames\[1\]: a frame is a number, got 184467440737"),
        (line([0, *[1, 0] * 5000]), r"line 2: a line must have at most 10,000 nodes; it has 10,001"),
        (line([0, 127], frames=[5, 4]), r"line 2, frames\[1\]: frames go backwards, 5 to 4"),
    ],
)
def test_a_wrong_recording_is_refused_by_line_and_place(text, message):
    with pytest.raises(DemonstrationError, match=message):
        list(read_bouts([line([0, HOME]), text], "D9"))
