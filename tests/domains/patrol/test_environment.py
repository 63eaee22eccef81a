import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.domains import instance, simulate_patrol
from i2rl.domains.patrol.breach import BreachSettings, line_of_sight
from i2rl.domains.patrol.environment import WAIT, BreachEnv
from i2rl.domains.patrol.process import Interaction

FORWARD, LEFT, RIGHT = range(3)


def _breach(number=2, **options):
    return gymnasium.make(f"i2rl/Breach{number}-v0", **options).unwrapped


def _meeting(patrol):
    """Two patrollers that face each other three cells apart in the hallway."""
    names = patrol.mdp.state_names
    return [names.index("(6,1) south"), names.index("(9,1) north")]


@pytest.mark.parametrize("length", [1, 3])
def test_patrollers_walk_as_they_do_where_they_are_watched(length):
    patrol, steps, n = instance(2), 6, 3000
    start, meeting = _meeting(patrol), Interaction(length=length)
    environment = BreachEnv(patrol, interaction=meeting)
    environment.reset(seed=0)
    walked = []
    for _ in range(n):
        environment.reset(options={"patrollers": start})
        for _ in range(steps - 1):
            seen = environment.step(WAIT)[0]
        walked.append(tuple(seen[1:]))
    policy = jnp.log(jnp.asarray(patrol.expert_policy()))
    policies = jnp.broadcast_to(policy, (2, *policy.shape))
    simulated = jax.vmap(
        lambda key: simulate_patrol(key, patrol, policies, jnp.asarray(start), steps, meeting)[0][:, -1]
    )(jax.random.split(jax.random.key(1), n))
    pairs, which = np.unique(np.concatenate([walked, simulated]), axis=0, return_inverse=True)
    counts = np.array([np.bincount(part, minlength=len(pairs)) for part in (which[:n], which[n:])])
    rare = counts.sum(0) < 20
    counts = np.column_stack([counts[:, ~rare], counts[:, rare].sum(1)])
    counts = counts[:, counts.sum(0) > 0]
    assert counts.shape[1] > 3
    assert stats.chi2_contingency(counts).pvalue > 1e-3


@pytest.mark.parametrize("number", [2, 3])
def test_an_episode_ends_where_the_learner_is_seen_or_at_a_goal(number):
    environment = _breach(number)
    patrol, settings = environment.patrol, BreachSettings()
    sees = line_of_sight(patrol, settings.reach)
    cells = patrol.breach.cells
    moves = np.random.default_rng(0)
    environment.reset(seed=0)
    endings = []
    for _ in range(150):
        observation, info = environment.reset()
        wait = int(moves.integers(0, 40))
        for _ in range(wait):
            observation, reward, over, *_, info = environment.step(WAIT)
            assert (reward, over, info["ended"]) == (0.0, False, "")
        over = False
        for _ in range(120):
            observation, reward, over, _, info = environment.step(int(moves.choice(3, p=[0.8, 0.1, 0.1])))
            cell = environment.states[observation[0]].cell
            caught = bool(sees[cells.index(cell), observation[1:]].any())
            ended = "reached" if cell in patrol.breach.goals else "caught" if caught else ""
            assert info["ended"] == ended
            assert over == (ended != "")
            assert reward == {"reached": settings.reward, "caught": -settings.penalty, "": 0.0}[ended]
            assert info["action_mask"].tolist() == [1, 1, 1, 0]
            if over:
                break
        endings.append(info["ended"])
    assert {"caught", "reached"} <= set(endings)


def test_who_leaves_in_sight_is_caught_at_the_start():
    environment = _breach(2)
    facing = environment.patrol.mdp.state_names.index("(0,3) west")
    far = environment.patrol.mdp.state_names.index("(16,8) east")
    first, info = environment.reset(options={"patrollers": [facing, far]})
    assert info["action_mask"].tolist() == [1, 1, 1, 1]
    observation, reward, over, _, info = environment.step(FORWARD)
    assert (observation == first).all()
    assert (reward, over, info["ended"]) == (-BreachSettings().penalty, True, "caught")
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(FORWARD)
    environment.reset(options={"patrollers": [facing, far]})
    assert not environment.step(WAIT)[2], "hidden as long as it waits"


def test_moves_fail_as_often_as_said():
    settings = BreachSettings(failure=0.3)
    environment = BreachEnv(instance(2), settings=settings)
    far = environment.patrol.mdp.state_names.index("(16,8) east")
    environment.reset(seed=4)
    reached, n = [], 2000
    for _ in range(n):
        environment.reset(options={"patrollers": [far, far]})
        reached.append(environment.states[environment.step(LEFT)[0][0]].name)
    names, counts = np.unique(reached, return_counts=True)
    assert names.tolist() == ["(0,0) north", "(0,0) south", "(0,1) east"]
    assert stats.chisquare(counts, n * np.array([0.7, 0.15, 0.15])).pvalue > 1e-3


def test_only_what_is_in_view_is_told():
    environment = _breach(2, observability=30)
    patrol = environment.patrol
    view, hidden = patrol.views[30], patrol.mdp.n_states
    near, far = int(np.flatnonzero(view)[0]), int(np.flatnonzero(~view)[0])
    observation, _ = environment.reset(options={"patrollers": [near, far]})
    assert observation[1:].tolist() == [near, hidden]
    assert environment.observation_space.contains(observation)
    with pytest.raises(ValueError, match="has no 31 % view"):
        _breach(2, observability=31)


def test_seeds_repeat_episodes():
    def episode(seed):
        environment = _breach(3)
        seen = [environment.reset(seed=seed)[0].tolist()]
        return seen + [environment.step(WAIT)[0].tolist() for _ in range(30)]

    assert episode(1) == episode(1)
    assert episode(1) != episode(2)
    several = gymnasium.make_vec("i2rl/Breach2-v0", num_envs=2, vectorization_mode="sync")
    assert several.reset(seed=0)[0].shape == (2, 3)


def test_misuse_is_told():
    with pytest.raises(ValueError, match="has no breach"):
        BreachEnv(instance(1))
    with pytest.raises(ValueError, match="render_mode must be one of"):
        _breach(2, render_mode="human")
    environment = BreachEnv(instance(2), render_mode="rgb_array")
    for call in (lambda: environment.step(0), environment.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    for given in ([0], [0, 124], [0, -1], [0.5, 1.5], "ab"):
        with pytest.raises(ValueError, match="patrollers must be 2 states of 0 to 123"):
            environment.reset(options={"patrollers": given})
    with pytest.raises(ValueError, match="only the option 'patrollers', got 'state'"):
        environment.reset(options={"state": 0})
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="actions are 0 to 3, got 4"):
        environment.step(4)


def test_pictures_show_everybody():
    environment = BreachEnv(instance(2), render_mode="rgb_array")
    start = _meeting(environment.patrol)
    environment.reset(seed=0, options={"patrollers": start})
    hidden = environment.render()
    assert hidden.dtype == np.uint8
    environment.reset(options={"patrollers": [start[0], start[0]]})
    assert (environment.render() != hidden).any()
    environment.reset(options={"patrollers": start})
    assert (environment.render() == hidden).all(), "nothing of the picture before is left"
    environment.step(FORWARD)
    assert (environment.render() != hidden).any()
    spoken = BreachEnv(instance(2), render_mode="ansi")
    spoken.reset(seed=0)
    assert spoken.render() == "begins\n(0,0) east: hidden"
    spoken.step(WAIT)
    assert spoken.render() == "wait, reward 0\n(0,0) east: hidden"
