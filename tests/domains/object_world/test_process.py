import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, shortest_path

from i2rl.domains.object_world.process import (
    ACTIONS,
    STAY,
    STEPS,
    random_object_world,
    walled_world,
    without_blocked_moves,
)
from i2rl.models import hard_plan, reward_of


@pytest.mark.parametrize("seed", range(5))
def test_every_free_cell_is_reachable_from_every_other(seed):
    world = random_object_world(jax.random.key(seed), 10, 40)
    assert world.walls.sum() == 40
    assert len(world.cells) == world.mdp.n_states == 60
    edges = _edges(world)
    assert connected_components(edges, connection="strong")[0] == 1
    assert not world.walls[world.objects[0]]
    assert not world.walls[world.objects[1]]


def _edges(world):
    successors = np.asarray(world.mdp.successors)[..., 0]
    rows = np.repeat(np.arange(len(successors)), successors.shape[1])
    return coo_array((np.ones(rows.size), (rows, successors.ravel())), shape=(len(successors),) * 2)


def test_moves_go_one_cell_and_walls_and_edges_block():
    walls = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]], bool)
    world = walled_world(walls, ((0, 0), (2, 2)))
    assert world.mdp.state_names == ("(0,0)", "(0,1)", "(0,2)", "(1,0)", "(1,2)", "(2,0)", "(2,1)", "(2,2)")
    for s, cell in enumerate(world.cells):
        for a, step in enumerate(STEPS):
            ahead = (cell[0] + step[0], cell[1] + step[1])
            expected = world.cells.index(ahead) if ahead in world.cells else s
            assert int(world.mdp.successors[s, a, 0]) == expected
            moved = expected != s
            assert np.asarray(world.mdp.features[s, a]).tolist() == [cell == (0, 0), cell == (2, 2), moved]


def test_optimal_values_are_those_of_the_shortest_way():
    world = random_object_world(jax.random.key(3), 8, 15, discount=0.9)
    plan = hard_plan(world.mdp, reward_of(world.mdp, jnp.asarray(world.weights)))
    ways = shortest_path(_edges(world), unweighted=True)
    nearest = np.minimum(*(ways[:, world.state_of(cell)] for cell in world.objects))
    np.testing.assert_allclose(plan.values, 0.9**nearest / (1 - 0.9), rtol=1e-9)


def test_a_slip_goes_in_any_direction_but_staying_is_sure():
    walls = np.zeros((3, 3), bool)
    mdp = walled_world(walls, ((0, 0), (2, 2)), slip=0.2).mdp
    dense = np.zeros((9, 5, 9))
    np.add.at(
        dense,
        (np.arange(9)[:, None, None], np.arange(5)[:, None], np.asarray(mdp.successors)),
        np.asarray(mdp.probabilities),
    )
    north, centre = ACTIONS.index("north"), 4
    np.testing.assert_allclose(dense[centre, north, [1, 7, 5, 3]], [0.85, 0.05, 0.05, 0.05])
    # In the corner two of the four directions lead nowhere, and so does the intended one.
    np.testing.assert_allclose(dense[0, north, [0, 1, 3]], [0.9, 0.05, 0.05])
    np.testing.assert_allclose(dense[np.arange(9), STAY, np.arange(9)], 1.0)


def test_the_same_key_draws_the_same_world():
    one, again, other = (random_object_world(jax.random.key(k)) for k in (1, 1, 2))
    assert one.mdp.fingerprint() == again.mdp.fingerprint()
    assert (one.walls != other.walls).any()


def test_without_blocked_moves_only_choices_go():
    world = random_object_world(jax.random.key(0), 6, 8)
    restricted = without_blocked_moves(world)
    available = np.asarray(restricted.mdp.available)
    nowhere = np.asarray(world.mdp.successors)[..., 0] == np.arange(world.mdp.n_states)[:, None]
    assert (available == (~nowhere | (np.arange(5) == STAY))).all()
    values = [hard_plan(w.mdp, reward_of(w.mdp, jnp.asarray(w.weights))).values for w in (world, restricted)]
    np.testing.assert_allclose(*values)


def test_a_crowded_world_is_still_found_and_an_impossible_one_is_refused():
    assert random_object_world(jax.random.key(0), 2, 0).mdp.n_states == 4
    with pytest.raises(ValueError, match=r"no connected layout of 2 walls in 2 x 2 cells"):
        random_object_world(jax.random.key(0), 2, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 1}, "at least 2 x 2 cells, got size 1"),
        ({"walls": 99}, "room for 0 to 98 walls, got 99"),
        ({"walls": -1}, "room for 0 to 98 walls, got -1"),
        ({"objects": ((0, 0), (0, 0))}, "two different cells of the 10 x 10 grid"),
        ({"objects": ((0, 0), (10, 0))}, "two different cells of the 10 x 10 grid"),
        ({"objects": ((0, 0), (1, 0), (2, 0))}, "two different cells of the 10 x 10 grid"),
        ({"weights": (1, 2)}, "weights must be three finite numbers"),
        ({"weights": (1, 2, np.nan)}, "weights must be three finite numbers"),
        ({"slip": 1.5}, r"slip must lie in \[0, 1\], got 1.5"),
        ({"discount": 0.0}, "discount must lie in"),
    ],
)
def test_impossible_worlds_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        random_object_world(jax.random.key(0), **options)


def test_walls_given_are_checked():
    walls = np.zeros((3, 3), bool)
    walls[:, 1] = True
    with pytest.raises(ValueError, match="cut this 3 x 3 world in parts"):
        walled_world(walls, ((0, 0), (2, 2)))
    with pytest.raises(ValueError, match=r"object at \(0, 1\) lies in a wall"):
        walled_world(walls, ((0, 0), (0, 1)))
    with pytest.raises(ValueError, match="boolean array"):
        walled_world(walls.astype(int), ((0, 0), (2, 2)))
    with pytest.raises(ValueError, match="no free cell"):
        random_object_world(jax.random.key(0)).state_of((-1, 0))
