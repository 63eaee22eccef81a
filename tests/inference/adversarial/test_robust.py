import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.adversarial.learner import AdversarialTraining, airl
from i2rl.inference.adversarial.policy_optimisation import ppo
from i2rl.inference.adversarial.robust import (
    Smoothed,
    as_expert,
    fit_gaussian,
    fit_isotropic,
    robust_airl,
    robust_airl_with_sensor,
)
from i2rl.inference.completion.gaussian import gaussian_truth, jax_dynamics
from i2rl.inference.completion.gibbs import GaussianGibbs
from i2rl.inference.journal.journal import Journal, JournalError
from i2rl.inference.sessions.running import run_sessions
from i2rl.models.networks.environment import Environment
from i2rl.models.networks.modules import ActionSpace, policy_network
from i2rl.models.observation.recordings import GaussianSensor, Recording, ShiftSensor, distort, truths

COVARIANCE = 0.04


def moved(state, action):
    """Push a mass on a line: position and velocity."""
    position, velocity = state[..., 0], state[..., 1]
    velocity = 0.9 * velocity + 0.3 * action[..., 0]
    return jnp.stack([position + 0.3 * velocity, velocity], -1)


@pytest.fixture(scope="module")
def task() -> Environment:
    return Environment(
        name="mass",
        observation_size=2,
        low=(-np.inf,) * 2,
        high=(np.inf,) * 2,
        actions=ActionSpace(0, (-1.0,), (1.0,)),
        horizon=50,
        reset=lambda key: jax.random.normal(key, (2,)),
        step=lambda s, a: (moved(s, jnp.clip(a, -1, 1)), -(s[0] ** 2), jnp.zeros((), bool)),
        observe=lambda s: s.astype(jnp.float32),
        next_state=moved,
    )


@pytest.fixture(scope="module")
def demonstration() -> Recording:
    """Bring the mass to rest by a proportional controller."""
    state = jax.random.normal(jax.random.key(5), (6, 2))
    observations, actions = [], []
    for _ in range(50):
        action = jnp.clip(-0.6 * state[:, :1] - 0.8 * state[:, 1:], -1, 1)
        observations.append(state)
        actions.append(action)
        state = moved(state, action)
    return Recording(
        jnp.stack(observations, 1), jnp.stack(actions, 1), jnp.ones((6, 50), bool), jnp.zeros(6, bool)
    )


@pytest.fixture(scope="module")
def sensor() -> GaussianSensor:
    return GaussianSensor(COVARIANCE, COVARIANCE).sized(2, 1)


@pytest.fixture(scope="module")
def truth():
    return gaussian_truth(jax_dynamics(moved), 2, draws=3)


@pytest.fixture(scope="module")
def reports(demonstration, sensor) -> Recording:
    return distort(jax.random.key(1), sensor, demonstration)


@pytest.fixture(scope="module")
def generator(task):
    return ppo(task, n_envs=4, n_steps=32, minibatch=64, epochs=2, hidden=(16,))


TRAINING = AdversarialTraining(iterations=3, updates=2, batch=32, refresh=2)


def test_draws_become_samples_of_the_same_steps(demonstration):
    drawn = truths(
        demonstration,
        jnp.stack([demonstration.observations, demonstration.observations + 100]),
        jnp.stack([demonstration.actions] * 2),
    )
    expert = as_expert(drawn)
    assert expert.steps.observations.shape == (6 * 50, 2, 2)
    assert int(expert.live.sum()) == 6 * 49
    live = np.flatnonzero(expert.live)
    np.testing.assert_allclose(
        expert.steps.observations[live, 1] - expert.steps.observations[live, 0], 100, rtol=1e-6
    )
    # The first trajectory's rows come first, each followed by its successor.
    np.testing.assert_allclose(expert.steps.successors[0, 0], demonstration.observations[0, 1], rtol=1e-12)


def test_the_truth_is_nearer_than_the_reports(demonstration, reports, sensor, truth, task):
    hidden = Smoothed(truth, sensor)
    policy = policy_network(jax.random.key(0), 2, task.actions)
    chain = hidden.begin(reports, sensor, jax.random.key(1))
    _, expert = hidden.refresh(chain, sensor, policy, jax.random.key(2))
    live = np.flatnonzero(expert.live)

    def error(x) -> float:
        return float(jnp.sqrt(jnp.mean((x - demonstration.observations.reshape(300, 2)[live]) ** 2)))

    reported = error(reports.observations.reshape(300, 2)[live])
    smoothed = error(expert.steps.observations[live].mean(1))
    assert reported == pytest.approx(np.sqrt(COVARIANCE), rel=0.1)
    assert smoothed < 0.5 * reported


def test_drawn_steps_obey_the_dynamics_and_reports_do_not(reports, sensor, truth, task):
    hidden = Smoothed(truth, sensor)
    policy = policy_network(jax.random.key(0), 2, task.actions)
    chain = hidden.begin(reports, sensor, jax.random.key(1))
    _, (steps, live, _) = hidden.refresh(chain, sensor, policy, jax.random.key(2))
    off = steps.successors - moved(steps.observations, steps.actions)
    # Q is 1e-4, and is the variance of what is left.
    assert float(jnp.mean(off[np.flatnonzero(live)] ** 2)) == pytest.approx(1e-4, rel=0.2)


def test_a_run_resumed_from_its_journal_equals_an_uninterrupted_one_to_the_bit(
    generator, truth, sensor, reports, tmp_path
):
    learner = robust_airl_with_sensor(generator, truth, sensor, training=TRAINING)
    whole = run_sessions(learner, [reports] * 3, key=jax.random.key(0)).state
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        run_sessions(learner, [reports] * 2, key=jax.random.key(0), journal=journal)
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        resumed = run_sessions(learner, [reports] * 3, journal=journal).state

    def bits(x) -> bytes:
        x = jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        return np.asarray(x).tobytes()

    assert all(
        bits(a) == bits(b) for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True)
    )


def test_the_sensor_is_learned_to_a_fifth(generator, truth, sensor, demonstration):
    # Believed ten times better than it is.
    learner = robust_airl_with_sensor(
        generator, truth, GaussianSensor(0.004, 0.004).sized(2, 1), training=TRAINING
    )
    state = learner.init(jax.random.key(0))
    for i in range(6):
        state, _ = learner.update(state, distort(jax.random.key(10 + i), sensor, demonstration))
    np.testing.assert_allclose(np.diag(state.sensor.state_covariance), COVARIANCE, rtol=0.2)
    np.testing.assert_allclose(np.diag(state.sensor.action_covariance), COVARIANCE, rtol=0.2)


def test_a_known_sensor_stays_as_it_is(generator, truth, sensor, reports):
    learner = robust_airl(generator, truth, sensor, training=TRAINING)
    state, report = learner.update(learner.init(jax.random.key(0)), reports)
    np.testing.assert_array_equal(state.sensor.state_covariance, sensor.state_covariance)
    assert report.pairs == 300


def test_reports_of_another_size_are_refused_and_nothing_is_lost(generator, truth, sensor, reports):
    learner = robust_airl(generator, truth, sensor, training=TRAINING)
    state, _ = learner.update(learner.init(jax.random.key(0)), reports)
    wrong = reports._replace(observations=jnp.zeros((6, 50, 3)))
    with pytest.raises(ValueError, match="2"):
        learner.update(state, wrong)
    after, _ = learner.update(state, reports)
    assert int(after.session) == 2


def test_a_sensor_given_in_short_has_the_shapes_of_a_fitted_one(generator, truth):
    # Or its journal could not be resumed.
    learner = robust_airl_with_sensor(generator, truth, GaussianSensor(0.02, [0.03]), training=TRAINING)
    first = learner.init(jax.random.key(0)).sensor
    np.testing.assert_array_equal(first.state_covariance, 0.02 * np.eye(2))
    np.testing.assert_array_equal(first.action_covariance, [[0.03]])
    shift = robust_airl_with_sensor(generator, truth, ShiftSensor(0.1, 0.25), training=TRAINING)
    assert all(x.dtype == jnp.float64 for x in jax.tree.leaves(shift.init(jax.random.key(0)).sensor))


@pytest.mark.parametrize("covariance", [-1.0, [[1.0, 2.0], [2.0, 1.0]]])
def test_no_learner_is_made_with_a_covariance_that_is_none(generator, truth, covariance):
    with pytest.raises(ValueError, match="state covariance is not positive definite"):
        robust_airl(generator, truth, GaussianSensor(jnp.asarray(covariance), 0.1))
    with pytest.raises(ValueError, match="process covariance is not positive definite"):
        gaussian_truth(jax_dynamics(moved), 2, process_covariance=jnp.asarray(covariance))


def test_no_learner_is_made_with_a_share_above_one(generator, truth):
    with pytest.raises(ValueError, match=r"in \[0, 1\], got 1.5"):
        robust_airl(generator, truth, ShiftSensor(0.1, 1.5))


def test_bounds_of_other_actions_are_refused(generator, sensor, reports):
    bounds = {"observation_bounds": (-9.0, 9.0), "action_bounds": ([-1.0, -1.0], [1.0, 1.0])}
    learner = robust_airl(generator, gaussian_truth(jax_dynamics(moved), 2, **bounds), sensor)
    with pytest.raises(ValueError, match="bounds of 2 actions"):
        learner.update(learner.init(jax.random.key(0)), reports)


@pytest.mark.parametrize(
    "change",
    [
        {"process_covariance": 1e-3},
        {"draws": 4},
        {"observation_bounds": (-9, 9), "action_bounds": ([-1], [1])},
    ],
)
def test_a_journal_refuses_another_truth(generator, truth, sensor, tmp_path, change):
    Journal.open(tmp_path / "run.journal", robust_airl(generator, truth, sensor)).close()
    other = gaussian_truth(jax_dynamics(moved), 2, **{"draws": 3, **change})
    with pytest.raises(JournalError, match="truth settings"):
        Journal.open(tmp_path / "run.journal", robust_airl(generator, other, sensor))
    # A second construction is equal: equality is independent of memory addresses.
    again = robust_airl(generator, gaussian_truth(jax_dynamics(moved), 2, draws=3), sensor)
    Journal.open(tmp_path / "run.journal", again).close()


def test_a_journal_refuses_another_sensor(generator, truth, sensor, tmp_path):
    Journal.open(tmp_path / "run.journal", robust_airl(generator, truth, sensor)).close()
    nearly = sensor._replace(state_covariance=sensor.state_covariance * (1 + 1e-9))
    with pytest.raises(JournalError, match="sensor"):
        Journal.open(tmp_path / "run.journal", robust_airl(generator, truth, nearly))


def test_the_default_discriminator_has_the_generators_discount(task, truth, sensor):
    agent = ppo(task, n_envs=4, n_steps=32, gamma=0.9)
    assert robust_airl(agent, truth, sensor).configuration["networks"]["discount"] == 0.9


def test_one_covariance_for_all_is_the_mean_of_one_for_each(task, truth, sensor, reports):
    hidden, policy = Smoothed(truth, sensor), policy_network(jax.random.key(0), 2, task.actions)
    chain, _ = hidden.refresh(
        hidden.begin(reports, sensor, jax.random.key(1)), sensor, policy, jax.random.key(2)
    )
    each = fit_gaussian(truth, chain.chain, policy, sensor)
    common = fit_isotropic(truth, chain.chain, policy, sensor)
    expected = np.concatenate([np.diag(x) for x in each]).mean()
    np.testing.assert_allclose(common.state_covariance, expected * np.eye(2))
    np.testing.assert_allclose(common.action_covariance, expected * np.eye(1))


def test_gibbs_sampling_stands_in_for_smoothing(demonstration, reports, sensor, truth, task):
    hidden = Smoothed(GaussianGibbs(truth, sweeps=20), sensor)
    policy = policy_network(jax.random.key(0), 2, task.actions)
    chain = hidden.begin(reports, sensor, jax.random.key(1))
    for i in range(3):  # chains persist
        chain, expert = hidden.refresh(chain, sensor, policy, jax.random.key(2 + i))
    live = np.flatnonzero(expert.live)
    assert int(chain.chain.sweeps) == 3 * 20

    def error(x) -> float:
        return float(jnp.mean((x - demonstration.observations.reshape(300, 2)[live]) ** 2))

    drawn = error(expert.steps.observations[live].mean(1))
    assert drawn < error(reports.observations.reshape(300, 2)[live])


def test_a_look_samples_on_until_the_average_logit_settles(generator, truth, sensor, reports):
    def session(**threshold):
        learner = robust_airl(generator, truth, sensor, training=TRAINING._replace(**threshold))
        return learner.update(learner.init(jax.random.key(0)), reports)

    _, once = session()
    state, strict = session(change=0.002, draws=12)
    _, loose = session(change=0.2, draws=12)
    assert once.draws.tolist() == [1, 1]  # of three iterations, the first and the third refresh
    assert (strict.draws > loose.draws).all()
    assert (loose.draws >= 2).all()
    assert np.isfinite(state.weights).all()


def test_sampling_on_leaves_the_chain_and_the_dynamics_alone(task, truth, sensor, reports):
    hidden, policy = Smoothed(truth, sensor), policy_network(jax.random.key(0), 2, task.actions)
    begun = hidden.begin(reports, sensor, jax.random.key(1))
    chain, first = hidden.refresh(begun, sensor, policy, jax.random.key(2))
    again, further = hidden.more(chain, sensor, policy, jax.random.key(3))
    assert again is chain
    same = jax.tree.map(lambda x, y: x.shape == y.shape and x.dtype == y.dtype, first, further)
    assert all(jax.tree.leaves(same))
    # Both are of one posterior: on average they differ by what few draws do.
    gap = jnp.mean(first.steps.observations.mean(1) - further.steps.observations.mean(1), 0)
    assert (jnp.abs(gap) < 0.03).all()


def test_reported_actions_are_cut_to_what_the_generator_can_show(generator, reports):
    # Noise beyond the bounds would separate an expert from a generator for all behaviours.
    beyond = reports._replace(actions=5 * jnp.ones_like(reports.actions))
    cut = reports._replace(actions=jnp.ones_like(reports.actions))
    learner = airl(generator, training=TRAINING)
    one, _ = learner.update(learner.init(jax.random.key(0)), beyond)
    other, _ = learner.update(learner.init(jax.random.key(0)), cut)
    np.testing.assert_array_equal(one.weights, other.weights)
