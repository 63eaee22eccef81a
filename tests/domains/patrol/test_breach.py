"""The learner's own task: what patrollers see, where they will be, how to get past them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from i2rl.domains.patrol.breach import (
    BreachSettings,
    IndependentForecast,
    SimulatedForecast,
    breach_task,
    detection_probability,
    line_of_sight,
    plan_breach,
    project,
    watch,
)
from i2rl.domains.patrol.process import (
    STOP,
    Interaction,
    State,
    boyd_fifth_floor,
    boyd_with_rooms,
    demonstrate,
    four_hallways,
    greedy_policy,
    instance,
    simulate_patrol,
)
from i2rl.domains.patrol.trials import (
    CAUGHT,
    REACHED,
    TIMED_OUT,
    BreachOutcome,
    GoAtBestTime,
    GoAtRandom,
    GoWhenBest,
    Planning,
    Watching,
    breach_trials,
    greedy_policies,
    soft_policies,
)
from i2rl.models import reward_of, soft_plan
from i2rl.models.laws.chain import filter_forward
from i2rl.models.observation.evidence import log_evidence

PATROL = boyd_fifth_floor()
S = PATROL.mdp.n_states
TRUE = greedy_policies(PATROL, np.stack([PATROL.weights] * 2))
CELLS = jnp.asarray(PATROL.cell_of_state)
TASK = breach_task(PATROL)
SETTINGS = BreachSettings()
plan = jax.jit(plan_breach)


def patroller(*state, patrol=PATROL):
    return patrol.states.index(State(*state))


def known(*states):
    return jnp.stack([jax.nn.one_hot(s, S) for s in states])


# -- what patrollers see ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "seen"),
    [
        ((0, 4, 2), {(0, 4), (0, 3), (0, 2), (0, 1)}),
        ((0, 3, 2), {(0, 3), (0, 2), (0, 1), (0, 0)}),
        ((0, 3, 0), {(0, 3), (0, 4), (0, 5), (0, 6)}),
        ((3, 1, 1), {(3, 1), (2, 1), (1, 1), (0, 1)}),
        ((3, 1, 3), {(3, 1), (4, 1), (5, 1), (6, 1)}),
        ((3, 1, 0), {(3, 1)}),
        ((0, 8, 0), {(0, 8)}),
    ],
)
def test_a_patroller_sees_three_cells_ahead_and_its_own(state, seen):
    sees = line_of_sight(PATROL, 3.0)[:, patroller(*state)]
    assert {cell for cell, s in zip(PATROL.breach.cells, sees, strict=True) if s} == seen


@pytest.mark.parametrize("number", [2, 3])
@pytest.mark.parametrize("reach", [0.0, 1.0, 3.0])
def test_line_of_sight_is_the_stated_rule(number, reach):
    patrol = instance(number)
    sees = line_of_sight(patrol, reach)
    for j, (r, c, heading, _) in enumerate(patrol.states):
        for i, (x, y) in enumerate(patrol.breach.cells):
            ahead = [x == r and y >= c, y == c and x <= r, x == r and y <= c, y == c and x >= r][heading]
            assert sees[i, j] == (ahead and (x - r) ** 2 + (y - c) ** 2 <= reach**2)


def test_detection_combines_patrollers_as_independent():
    here = PATROL.breach.cells.index((0, 3))
    looking, away = patroller(0, 5, 2), patroller(0, 5, 0)
    half = 0.5 * known(looking) + 0.5 * known(away)
    certain, doubtful = known(looking)[:, None], half[:, None]

    def detected(*marginals):
        return float(detection_probability(TASK.sees, jnp.concatenate(marginals))[0, here])

    assert detected(certain, doubtful) == 1
    assert detected(doubtful, known(away)[:, None]) == pytest.approx(0.5)
    assert detected(doubtful, doubtful) == pytest.approx(0.75)


# -- where patrollers are ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def glimpses():
    return demonstrate(jax.random.key(8), PATROL, 30, sessions=1, steps=120)


def test_watching_step_by_step_is_the_forward_filter(glimpses):
    view, policies = PATROL.visibility(30), soft_policies(PATROL, np.stack([PATROL.weights * 8] * 2))
    codes = jnp.stack([d.codes[0] for d in glimpses])
    beliefs = current_beliefs(PATROL.mdp, policies, view, codes)
    for belief, log_policy, demonstration in zip(beliefs, policies, glimpses, strict=True):
        factors = log_evidence(view, PATROL.mdp, demonstration)[0] + log_policy
        exact = filter_forward(PATROL.mdp, factors, jnp.ones(120, bool)).final
        assert np.allclose(belief, exact, atol=1e-12)


def current_beliefs(mdp, log_policies, sensor, codes, watcher=watch):
    """Follow the belief about each patroller over the observed steps, from the initial distribution on."""

    @jax.jit
    def one(log_policy, codes):
        def step(belief, code):
            return watcher(mdp, log_policy, sensor, belief, code), None

        return jax.lax.scan(step, mdp.initial, codes)[0]

    return jnp.stack([one(*each) for each in zip(log_policies, jnp.asarray(codes), strict=True)])


def random_policies(seed):
    """Greedy policies under weights uniform on (-0.99, 0.99), the dissertation's random baseline."""
    shape = (PATROL.patrollers, PATROL.mdp.n_features)
    return greedy_policies(PATROL, np.random.default_rng(seed).uniform(-0.99, 0.99, shape))


def after(codes, watcher=watch, policies=TRUE):
    return np.asarray(current_beliefs(PATROL.mdp, policies[:1], PATROL.visibility(30), codes[None], watcher))[
        0
    ]


def code(kind, state=-1, action=-1):
    return [kind, state, action]


SEEN, HIDDEN, LOST = 1, 2, 3


def test_a_pair_seen_leaves_only_the_moves_own_chance():
    state = patroller(2, 1, 3)
    belief = after(jnp.array([code(HIDDEN), code(SEEN, state, 0)]))
    assert belief[patroller(3, 1, 3)] == pytest.approx(0.95)
    assert belief[state] == pytest.approx(0.05)


def test_not_being_seen_rules_out_having_stayed_in_view():
    # Seen heading south at the edge of the view, then not: it must have left.
    codes = jnp.array([code(SEEN, patroller(2, 1, 3), 0), code(HIDDEN)])
    watched, projected = after(codes), after(codes, project)
    assert watched[patroller(3, 1, 3)] == pytest.approx(0.05)
    assert watched[patroller(4, 1, 3)] == pytest.approx(0.95)
    assert projected[patroller(2, 1, 3)] == pytest.approx(0.05**2)
    assert projected[patroller(3, 1, 3)] == pytest.approx(2 * 0.05 * 0.95)


def test_projection_is_the_learned_chain_from_the_last_sighting():
    codes = jnp.array([code(HIDDEN)] * 3 + [code(SEEN, patroller(2, 1, 3), 0)] + [code(HIDDEN)] * 9)
    chain = np.linalg.matrix_power(np.asarray(PATROL.mdp.state_transitions(jnp.exp(TRUE[0]))), 10)
    assert np.allclose(after(codes, project), chain[patroller(2, 1, 3)], atol=1e-13)


def test_perception_overrules_a_policy_that_excludes_it():
    standing = jnp.log(jnp.eye(4)[jnp.full((1, S), STOP)])
    inside = PATROL.views[30]
    contradicted = after(
        jnp.array([code(SEEN, patroller(2, 1, 3), 0), code(HIDDEN), code(HIDDEN)]), policies=standing
    )
    assert contradicted.sum() == pytest.approx(1)
    surprised = after(jnp.array([code(SEEN, patroller(2, 1, 3), 1), code(HIDDEN)]), policies=standing)
    assert surprised.sum() == pytest.approx(1)
    # Turning in view cannot end out of view: the belief starts afresh from the hidden states.
    assert surprised[~inside].sum() > 0.8


@pytest.mark.parametrize("watcher", [watch, project])
def test_beliefs_are_distributions(watcher, glimpses):
    codes = jnp.stack([d.codes[0] for d in glimpses])
    policies = random_policies(2)
    beliefs = current_beliefs(PATROL.mdp, policies, PATROL.visibility(30), codes, watcher)
    assert np.allclose(beliefs.sum(1), 1)
    assert (beliefs >= 0).all()


# -- where they will be -----------------------------------------------------------------------------------

FACING = known(patroller(6, 1, 3), patroller(9, 1, 1))
NO_MEETING = Interaction(length=0)


def forecast(method, beliefs, policies=TRUE, horizon=40):
    return np.asarray(method(jax.random.key(0), PATROL.mdp, CELLS, policies, beliefs, horizon))


@pytest.mark.parametrize("method", [IndependentForecast(), SimulatedForecast(draws=50)])
def test_forecasts_conserve_probability_and_begin_with_what_is_known(method):
    marginals = forecast(method, FACING)
    assert marginals.shape == (2, 40, S)
    assert np.allclose(marginals.sum(2), 1)
    assert np.allclose(marginals[:, 0], FACING)


def test_independent_forecast_is_the_frequency_of_simulated_walks():
    policies = soft_policies(PATROL, np.stack([PATROL.weights * 6, PATROL.weights * 12]))
    exact, draws, horizon = forecast(IndependentForecast(), FACING, policies, 30), 4000, 30
    start = jnp.argmax(FACING, axis=1)
    keys = jax.random.split(jax.random.key(3), draws)
    states = jax.vmap(lambda k: simulate_patrol(k, PATROL, policies, start, horizon, NO_MEETING)[0])(keys)
    for i in range(2):
        for t in (1, 7, 29):
            frequency = np.bincount(np.asarray(states[:, i, t]), minlength=S) / draws
            error = np.sqrt(exact[i, t] * (1 - exact[i, t]) / draws)
            often = exact[i, t] * draws > 10
            assert often.any()
            assert (np.abs(frequency - exact[i, t])[often] <= 4 * error[often]).all()
            assert frequency[exact[i, t] == 0].sum() == 0


def test_simulated_forecast_converges_on_the_exact_one_if_nobody_meets():
    draws = 4000
    exact = forecast(IndependentForecast(), FACING)
    estimate = forecast(SimulatedForecast(NO_MEETING, draws), FACING)
    often = exact * draws > 10
    error = np.sqrt(exact * (1 - exact) / draws)
    # Thousands of comparisons, so that 5 standard errors is already rare.
    assert (np.abs(estimate - exact)[often] <= 5 * error[often] + 1e-12).all()


def test_meetings_delay_those_who_wait():
    draws, waiting = 500, Interaction((STOP, STOP), 4)
    rows = np.array([s.row for s in PATROL.states])
    alone = forecast(IndependentForecast(), FACING, horizon=9)[:, -1] @ rows
    together = forecast(SimulatedForecast(waiting, draws), FACING, horizon=9)[:, -1] @ rows
    assert together[0] < alone[0] - 2
    assert together[1] > alone[1] + 2


# -- planning ---------------------------------------------------------------------------------------------


class Explicit(NamedTuple):
    """The time-augmented process written out: states (t, x), then caught, then over."""

    transitions: np.ndarray
    reward: np.ndarray


def written_out(patrol, detection, settings):
    cells, horizon = patrol.breach.cells, detection.shape[0]
    states = [(r, c, h) for r, c in cells for h in range(4)]
    at = {(t, s): t * len(states) + i for t in range(horizon) for i, s in enumerate(states)}
    caught, over = len(at), len(at) + 1
    p, reward = np.zeros((over + 1, 3, over + 1)), np.zeros(over + 1)
    reward[caught] = -settings.penalty
    p[[caught, over], :, over] = 1
    step = [(0, 1), (-1, 0), (0, -1), (1, 0)]
    for (t, (r, c, h)), here in at.items():
        if t == horizon - 1 or (r, c) in patrol.breach.goals:
            p[here, :, over] = 1
            reward[here] = settings.reward if t < horizon - 1 else 0
            continue
        ahead = (r + step[h][0], c + step[h][1])
        ahead = ahead if ahead in cells else (r, c)
        ends = [(*ahead, h), (r, c, (h + 1) % 4), (r, c, (h - 1) % 4)]
        unseen = 1 - detection[t, cells.index((r, c))]
        p[here, :, caught] = 1 - unseen
        for a in range(3):
            for b, end in enumerate(ends):
                chance = 1 - settings.failure if a == b else settings.failure / 2
                p[here, a, at[t + 1, end]] += unseen * chance
    return Explicit(p, reward)


def test_plan_agrees_with_value_iteration_on_the_written_out_process():
    settings = BreachSettings(failure=0.1, penalty=4.0)
    # A small map, so that the process can be written out densely.
    cells = ((0, 0), (0, 1), (1, 1), (2, 1), (3, 1))
    patrol = PATROL._replace(breach=PATROL.breach._replace(cells=cells, goals=((3, 1),), discount=0.9))
    detection = np.random.default_rng(0).random((9, len(cells))) ** 3
    found = plan(breach_task(patrol), jnp.asarray(detection), settings)
    process = written_out(patrol, detection, settings)
    values = np.zeros(len(process.reward))
    for _ in range(12):
        onward = 0.9 * process.transitions @ values
        values = process.reward + onward.max(1)
    assert np.allclose(found.values.ravel(), values[:-2], atol=1e-12)
    moves = np.asarray(found.moves).ravel()
    assert np.allclose(onward[np.arange(len(moves)), moves], onward[:-2].max(1), atol=1e-12)


@pytest.mark.parametrize(("patrol", "steps"), [(PATROL, 11), (boyd_with_rooms(), 19)])
def test_an_unwatched_goal_is_worth_its_discounted_distance(patrol, steps):
    task, horizon = breach_task(patrol), 30
    detection = jnp.zeros((horizon, len(patrol.breach.cells)))
    values = np.asarray(plan(task, detection, BreachSettings(failure=0.0)).values[:, task.start])
    in_time = np.arange(horizon) + steps <= horizon - 2
    assert np.allclose(values[in_time], 10 * patrol.breach.discount**steps)
    assert np.allclose(values[~in_time], 0)


def test_a_guarded_passage_is_not_worth_entering():
    guard = known(patroller(5, 1, 1))[:, None].repeat(60, axis=1)
    found = plan(TASK, detection_probability(TASK.sees, guard), SETTINGS)
    # Slipping while it hides may still expose the learner, so the value is at most zero.
    assert (found.values[:, TASK.start] <= 0).all()


def random_detection(seed, horizon=12):
    return jnp.asarray(np.random.default_rng(seed).random((horizon, len(PATROL.breach.cells))) ** 4)


@given(st.integers(0, 10**6))
def test_better_detection_never_raises_a_value(seed):
    detection = random_detection(seed)
    better = detection + (1 - detection) * random_detection(seed + 1)
    assert (plan(TASK, better, SETTINGS).values <= plan(TASK, detection, SETTINGS).values + 1e-12).all()


@given(st.integers(0, 10**6), st.sampled_from([3, 8]))
def test_more_time_never_lowers_a_value_where_being_caught_costs_nothing(seed, horizon):
    # With a penalty it may: a learner who cannot reach the goal is saved by the end of the run.
    detection, free = random_detection(seed), SETTINGS._replace(penalty=0.0)
    short = plan(TASK, detection[:horizon], free).values
    assert (plan(TASK, detection, free).values[:horizon] >= short - 1e-12).all()


@given(st.integers(0, 10**6))
def test_values_stay_between_penalty_and_reward(seed):
    values = plan(TASK, random_detection(seed), SETTINGS).values
    assert (values >= -10).all()
    assert (values <= 10).all()


# -- runs -------------------------------------------------------------------------------------------------


def standing_guard(*states):
    """Make a patrol whose members never move."""
    weights = -np.ones(6)
    assert (greedy_policy(PATROL.mdp, weights)[:, 1:3] == 0).all()
    still = jnp.zeros(S).at[jnp.array([patroller(*s) for s in states])].set(1 / len(states))
    cells = PATROL.mdp.with_initial(still)
    # Stopping would do as well as blocked steps; moving is never chosen.
    return PATROL._replace(mdp=cells, weights=weights)


SURE = SETTINGS._replace(failure=0.0)
WATCHING = Watching(observability=100, observed_steps=2)
COMMON = {"watching": WATCHING, "trials": 64, "interaction": NO_MEETING}


def own_policies(patrol):
    return greedy_policies(patrol, np.stack([patrol.weights] * 2))


@pytest.mark.parametrize("go", [GoAtBestTime(), GoWhenBest()])
def test_an_open_way_is_taken_at_once(go):
    patrol = standing_guard((16, 8, 2))
    outcome = breach_trials(
        jax.random.key(0), patrol, own_policies(patrol), settings=SURE, planning=Planning(go=go), **COMMON
    )
    assert outcome.rate(REACHED) == 1
    assert (outcome.waited == 0).all()


def test_a_guarded_way_is_waited_at_until_time_is_over():
    patrol = standing_guard((5, 1, 1))
    outcome = breach_trials(jax.random.key(0), patrol, own_policies(patrol), settings=SURE, **COMMON)
    assert outcome.rate(TIMED_OUT) == 1
    assert np.isnan(outcome.mean_wait)
    assert outcome.threshold == 2 * 2 + 2 * 56 * 2


def test_who_underrates_the_guards_sight_is_caught():
    patrol = standing_guard((5, 1, 1))
    blind = SURE._replace(reach=0.0, penalty=0.0)
    open_way = standing_guard((9, 1, 3))
    outcome = breach_trials(
        jax.random.key(0), patrol, own_policies(patrol), settings=SURE, planning=Planning(blind), **COMMON
    )
    # The guard's own cell lies on the only way, so even a learner who thinks it blind stays.
    assert outcome.rate(TIMED_OUT) == 1
    outcome = breach_trials(
        jax.random.key(0),
        standing_guard((10, 1, 1)),
        own_policies(open_way),
        settings=SURE,
        planning=Planning(blind),
        **COMMON,
    )
    assert outcome.rate(CAUGHT) == 1


def test_runs_are_reproducible_by_key():
    one, same, other = (breach_trials(jax.random.key(k), PATROL, TRUE, **COMMON) for k in (1, 1, 2))
    assert np.array_equal(one.ended, same.ended)
    assert np.array_equal(one.waited, same.waited, equal_nan=True)
    assert not np.array_equal(one.waited, other.waited, equal_nan=True)


def test_slow_learning_times_out():
    seconds = np.where(np.arange(COMMON["trials"]) < 5, 10.0, 500.0)
    patrol = standing_guard((16, 8, 2))
    outcome = breach_trials(
        jax.random.key(0),
        patrol,
        own_policies(patrol),
        settings=SURE,
        **(COMMON | {"watching": WATCHING._replace(learning_seconds=seconds, threshold_seconds=200.0)}),
    )
    assert (outcome.ended == np.where(seconds > 200, TIMED_OUT, REACHED)).all()


def test_leaving_at_random_times_out_half_of_the_time():
    patrol, n = standing_guard((16, 8, 2)), COMMON["trials"]
    outcome = breach_trials(
        jax.random.key(0),
        patrol,
        own_policies(patrol),
        settings=SURE,
        planning=Planning(go=GoAtRandom()),
        **(COMMON | {"trials": n}),
    )
    assert abs(outcome.rate(TIMED_OUT) - 0.5) <= 4 * np.sqrt(0.25 / n)
    assert np.isin(outcome.ended, [REACHED, TIMED_OUT]).all()


def test_knowing_the_patrollers_beats_guessing():
    known_policy = breach_trials(jax.random.key(4), PATROL, TRUE, **COMMON)
    guessed = breach_trials(jax.random.key(4), PATROL, random_policies(4), **COMMON)
    assert known_policy.interval()[0] > guessed.interval()[1]


def test_outcomes_are_counted_with_wilsons_interval():
    outcome = BreachOutcome(np.array([REACHED] * 8 + [CAUGHT] * 2), np.arange(10.0), 60.0)
    assert outcome.rate() == 0.8
    assert outcome.rate(CAUGHT) == pytest.approx(0.2)
    assert outcome.mean_wait == 4.5
    # By hand: centre (p + z^2/2n)/(1 + z^2/n), half-width z sqrt(p q/n + z^2/4n^2)/(1 + z^2/n).
    z = 1.959963984540054
    centre, spread = (0.8 + z**2 / 20) / (1 + z**2 / 10), z * np.sqrt(0.016 + z**2 / 400) / (1 + z**2 / 10)
    assert outcome.interval() == pytest.approx((centre - spread, centre + spread))


# -- policies and errors ----------------------------------------------------------------------------------


def test_policies_are_the_planners(dense_transitions):
    weights = np.stack([PATROL.weights, -PATROL.weights])
    soft, greedy = soft_policies(PATROL, weights), np.exp(greedy_policies(PATROL, weights))
    for i in range(2):
        assert np.allclose(
            soft[i], soft_plan(PATROL.mdp, reward_of(PATROL.mdp, jnp.asarray(weights[i]))).log_policy
        )
        assert (greedy[i].sum(1) == 1).all()
    assert np.array_equal(greedy[0], PATROL.expert_policy())


def test_the_first_instance_has_nothing_to_breach():
    with pytest.raises(ValueError, match="patrol1 has no breach"):
        breach_task(four_hallways())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_policies": TRUE[:1]}, "log_policies must have shape"),
        ({"watching": WATCHING._replace(observability=31)}, "patrol2 has no 31 % view"),
        ({"watching": WATCHING._replace(learning_seconds=-1.0)}, "none negative"),
        ({"watching": WATCHING._replace(learning_seconds=np.ones(3))}, "one per trial"),
    ],
)
def test_errors_name_what_was_given(change, message):
    setting = COMMON | {"log_policies": TRUE} | change
    with pytest.raises(ValueError, match=message):
        breach_trials(jax.random.key(0), PATROL, **setting)
