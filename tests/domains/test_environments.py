import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy import stats

from i2rl.domains import instance, mouse_labyrinth, sorting_with_claiming
from i2rl.domains.environments import ENVIRONMENTS, TabularEnv
from i2rl.domains.gym.canvas import Frame
from i2rl.domains.labyrinth.process import HOME, N_NODES, maze_positions, parent_of

IDS = tuple(ENVIRONMENTS)
TABULAR = tuple(name for name in IDS if "Breach" not in name)


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_has_nothing_to_say(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = gymnasium.make(name)
        check_env(environment.unwrapped)
        environment.close()


def _tabular(name, **options):
    return gymnasium.make(name, **options).unwrapped


@pytest.mark.parametrize("name", TABULAR)
def test_steps_are_distributed_as_the_process_says(name):
    options = {"slip": 0.3} if "ObjectWorld" in name else {}
    environment = _tabular(name, **options)
    mdp, draws = environment.mdp, 1500
    kernel = np.zeros((mdp.n_states, mdp.n_actions, mdp.n_states))
    pairs = np.indices(mdp.successors.shape)
    np.add.at(kernel, (pairs[0], pairs[1], np.asarray(mdp.successors)), np.asarray(mdp.probabilities))
    # The pairs with the most successors, then some deterministic ones.
    spread = (kernel > 0).sum(-1)
    order = np.argsort(-spread, axis=None, kind="stable")
    order = order[np.asarray(mdp.available).ravel()[order]]
    environment.reset(seed=0)
    statistic, freedom = 0.0, 0
    for pair in [*order[:4], order[-1]]:
        state, action = divmod(int(pair), mdp.n_actions)
        reached = []
        for _ in range(draws):
            environment.reset(options={"state": state})
            following, reward, terminated, truncated, info = environment.step(action)
            reached.append(following)
            assert not terminated
            assert not truncated
            assert info["available"]
        expected_reward = np.asarray(mdp.features)[state, action] @ environment.weights
        assert reward == pytest.approx(expected_reward, abs=1e-12)
        counts, chance = np.bincount(reached, minlength=mdp.n_states), kernel[state, action]
        assert not counts[chance == 0].any()
        possible = chance > 0
        statistic += ((counts - draws * chance) ** 2 / np.maximum(draws * chance, 1e-300))[possible].sum()
        freedom += possible.sum() - 1
    assert freedom == 0 or stats.chi2.sf(statistic, freedom) > 1e-3
    assert (freedom > 0) == (name != "i2rl/Labyrinth-v0")


def test_episodes_begin_as_the_process_says():
    environment = _tabular("i2rl/SortingWithClaiming-v0")
    environment.reset(seed=1)
    initial = np.asarray(environment.mdp.initial)
    counts = np.bincount([environment.reset()[0] for _ in range(4000)], minlength=len(initial))
    assert not counts[initial == 0].any()
    possible = initial > 0
    assert stats.chisquare(counts[possible], 4000 * initial[possible]).pvalue > 1e-3


@pytest.mark.parametrize("name", TABULAR)
def test_seeds_repeat_episodes_and_masks_are_kept(name):
    def episode(seed):
        environment = gymnasium.make(name)
        state, info = environment.reset(seed=seed)
        environment.action_space.seed(seed)
        seen, truncated = [state], False
        mdp = environment.unwrapped.mdp
        while not truncated:
            assert info["action_mask"].dtype == np.int8
            assert (info["action_mask"] == np.asarray(mdp.available)[state]).all()
            action = environment.action_space.sample(info["action_mask"])
            state, reward, terminated, truncated, info = environment.step(action)
            assert info["available"]
            assert not terminated
            seen.append((state, reward))
        return seen

    assert episode(3) == episode(3)
    assert episode(3) != episode(4)
    assert len(episode(3)) == gymnasium.spec(name).max_episode_steps + 1


def test_what_a_state_does_not_offer_changes_nothing_or_is_refused():
    forgiving = _tabular("i2rl/SortingWithClaiming-v0")
    state, info = forgiving.reset(seed=0)
    absent = int(np.flatnonzero(info["action_mask"] == 0)[0])
    following, reward, terminated, truncated, info = forgiving.step(absent)
    assert (following, reward, terminated, truncated) == (state, 0.0, False, False)
    assert info["available"] is False
    strict = _tabular("i2rl/SortingWithClaiming-v0", strict=True)
    state, _ = strict.reset(seed=0)
    with pytest.raises(ValueError, match=r"does not offer .*; it offers 'pick'"):
        strict.step(absent)


def test_several_at_once():
    environments = gymnasium.make_vec("i2rl/Patrol2-v0", num_envs=3, vectorization_mode="sync")
    states, info = environments.reset(seed=[5, 6, 7])
    assert states.shape == (3,)
    assert info["action_mask"].shape == (3, 4)
    following, rewards, *_ = environments.step(np.zeros(3, int))
    alone = []
    for seed in (5, 6, 7):
        one = gymnasium.make("i2rl/Patrol2-v0")
        one.reset(seed=seed)
        alone.append(one.step(0)[:2])
    assert list(zip(following, rewards, strict=True)) == alone


def test_the_reward_is_the_callers_to_choose():
    sorting = sorting_with_claiming()
    for i, behaviour in enumerate(sorting.behaviours):
        environment = _tabular("i2rl/SortingWithClaiming-v0", behaviour=behaviour)
        assert (environment.weights == sorting.weights[i]).all()
    assert (_tabular("i2rl/Patrol2-v0").weights == instance(2).weights).all()
    assert _tabular("i2rl/Patrol2-v0", weights=[0, 0, 0, 0, 0, 2]).weights[-1] == 2
    water = _tabular("i2rl/Labyrinth-v0")
    (paid,) = {water.mdp.feature_names[k] for k in np.flatnonzero(water.weights)}
    assert paid == "reaches 116"
    with pytest.raises(ValueError, match="behaviour must be one of pick-inspect-place"):
        gymnasium.make("i2rl/SortingWithClaiming-v0", behaviour="juggle")
    with pytest.raises(ValueError, match="by behaviour or by weights, not both"):
        gymnasium.make("i2rl/SortingWithClaiming-v0", behaviour="keep claiming", weights=np.ones(11))
    with pytest.raises(ValueError, match="weights must be 6 finite numbers"):
        gymnasium.make("i2rl/Patrol2-v0", weights=[1.0])


def test_layouts_are_drawn_from_their_seed():
    one, again, other = (_tabular("i2rl/ObjectWorld-v0", layout=i).mdp.fingerprint() for i in (0, 0, 1))
    assert one == again
    assert one != other
    assert _tabular("i2rl/ObjectWorld-v0", size=5, walls=3).mdp.n_states == 22


def test_a_module_in_the_name_is_enough():
    for module in ("i2rl.domains", "i2rl.domains.environments"):
        assert gymnasium.make(f"{module}:i2rl/ObjectWorld-v0").unwrapped.mdp.n_states == 75


def test_episodes_begin_where_they_are_told():
    environment = _tabular("i2rl/Patrol2-v0")
    assert environment.reset(options={"state": 7})[0] == 7
    name = environment.mdp.state_names[9]
    assert environment.reset(options={"state": name})[0] == 9
    for state in (-1, 124, 1.5):
        with pytest.raises(ValueError, match="states are 0 to 123"):
            environment.reset(options={"state": state})
    with pytest.raises(ValueError, match="no state named 'nowhere'"):
        environment.reset(options={"state": "nowhere"})
    with pytest.raises(ValueError, match="only the option 'state', got 'speed'"):
        environment.reset(options={"speed": 2})


def test_misuse_is_told():
    patrol = instance(2)
    environment = TabularEnv(patrol.mdp, patrol.weights, render_mode="ansi")
    for call in (lambda: environment.step(0), environment.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="actions are 0 to 3, got 4"):
        environment.step(4)
    with pytest.raises(ValueError, match="render_mode must be one of rgb_array, ansi or None, got 'human'"):
        TabularEnv(patrol.mdp, patrol.weights, render_mode="human")


# -- pictures -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in TABULAR if n != "i2rl/SortingWithoutClaiming-v0"])
def test_every_state_looks_different(name):
    environment = _tabular(name, render_mode="rgb_array")
    environment.reset(seed=0)
    height, width, _ = environment.render().shape
    pictures = {}
    for state in range(environment.mdp.n_states):
        environment.reset(options={"state": state})
        frame = environment.render()
        assert frame.shape == (height, width, 3)
        assert frame.dtype == np.uint8
        # Without the caption, which names the state.
        pictures.setdefault(frame[: height - 46].tobytes(), []).append(environment.mdp.state_names[state])
    assert [names for names in pictures.values() if len(names) > 1] == []


def test_a_picture_does_not_depend_on_the_one_before():
    environment = _tabular("i2rl/SortingWithClaiming-v0", render_mode="rgb_array")
    environment.reset(options={"state": 0})
    first = environment.render()
    environment.reset(options={"state": 7})
    other = environment.render()
    environment.reset(options={"state": 0})
    assert (environment.render() == first).all()
    assert (other != first).any()


def test_a_process_nobody_drew_is_shown_in_words(random_mdp):
    mdp = random_mdp(0, n_states=5, n_actions=3, n_features=2)
    environment = TabularEnv(mdp, [1.0, 2.0], render_mode="rgb_array")
    frames = []
    for state in (0, 1):
        environment.reset(seed=0, options={"state": state})
        frames.append(environment.render())
    assert (frames[0] != frames[1]).any()
    spoken = TabularEnv(mdp, [1.0, 2.0], render_mode="ansi")
    spoken.reset(seed=0)
    assert spoken.render().startswith("begins\n")
    state, reward, *_ = spoken.step(2)
    assert spoken.render() == f"{mdp.action_names[2]}, reward {reward:.3g}\n{mdp.state_names[state]}"


def test_the_maze_is_drawn_as_it_is_walked():
    places = maze_positions()
    assert len({tuple(place) for place in places}) == N_NODES + 1
    for node in range(1, N_NODES):
        parent = parent_of(node)
        came, goes = places[parent] - places[parent_of(parent)], places[node] - places[parent]
        turn = came[0] * goes[1] - came[1] * goes[0]
        assert turn > 0 if node % 2 else turn < 0, "left is counter-clockwise"
    # Corridors meet at their ends only.
    cells = []
    for node in range(N_NODES):
        start, end = places[parent_of(node)], places[node]
        steps = int(np.abs(end - start).sum())
        cells += [tuple(start + (end - start) * i / steps) for i in range(1, steps + 1)]
    assert len(cells) == len(set(cells))
    assert tuple(places[HOME]) not in cells


def test_captions_name_what_was_done():
    from i2rl.domains.gym.canvas import caption

    mdp = mouse_labyrinth().mdp
    assert caption(mdp, Frame(0)) == f"begins\n{mdp.state_names[0]}"
    assert caption(mdp, Frame(0, 0, 0.25)).startswith("back, reward 0.25\n")
