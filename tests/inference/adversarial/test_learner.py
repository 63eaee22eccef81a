import jax
import numpy as np
import pytest

from i2rl.domains.robots.control import cart_pole
from i2rl.domains.robots.reaching import onion_reaching
from i2rl.inference.adversarial.discriminator import airl_discriminator, gail_discriminator
from i2rl.inference.adversarial.learner import AdversarialTraining, adversarial, airl
from i2rl.inference.adversarial.noise_injection import NoisyTraining, noisy_airl
from i2rl.inference.adversarial.policy_optimisation import ppo
from i2rl.inference.journal.journal import Journal, JournalError
from i2rl.inference.sessions.running import run_sessions
from i2rl.models.observation.recordings import Recording, RecordingError, recording

SMALL = AdversarialTraining(iterations=3, updates=2, batch=32)


@pytest.fixture(scope="module")
def task():
    return cart_pole()


@pytest.fixture(scope="module")
def generator(task):
    return ppo(task, n_envs=4, n_steps=32, minibatch=32, epochs=2, scale_rewards=True)


@pytest.fixture(scope="module")
def demonstration() -> Recording:
    rng = np.random.default_rng(0)
    return recording(
        [rng.normal(0, 0.05, (40, 4)) for _ in range(2)],
        [rng.integers(0, 2, 40) for _ in range(2)],
        n_actions=2,
    )


@pytest.fixture(scope="module")
def learner(task, generator):
    return adversarial("AIRL", generator, airl_discriminator(4, task.actions), training=SMALL)


def same(one, other) -> bool:
    def bits(x) -> bytes:
        x = jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        return np.asarray(x).tobytes()

    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(bits(a) == bits(b) for a, b in leaves)


def test_the_same_key_gives_the_same_bits(learner, demonstration):
    one, _ = learner.update(learner.init(jax.random.key(3)), demonstration)
    other, _ = learner.update(learner.init(jax.random.key(3)), demonstration)
    assert same(one, other)


def test_a_run_resumed_from_its_journal_equals_an_uninterrupted_one_to_the_bit(
    learner, demonstration, tmp_path
):
    stream = [demonstration] * 3
    whole = run_sessions(learner, stream, key=jax.random.key(0)).state
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        run_sessions(learner, stream[:2], key=jax.random.key(0), journal=journal)
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        resumed = run_sessions(learner, stream, journal=journal).state
    assert same(whole, resumed)


def test_everything_is_carried_between_sessions(learner, demonstration):
    first, _ = learner.update(learner.init(jax.random.key(0)), demonstration)
    second, info = learner.update(first, demonstration)
    assert int(second.session) == 2
    assert int(second.iterations) == 2 * SMALL.iterations
    assert info.environment_steps == 2 * SMALL.iterations * 4 * 32
    assert info.pairs == 4 * 40
    adam = second.optimiser[0]
    assert int(adam.count) == 2 * SMALL.iterations * SMALL.updates
    assert int(second.generator.updates) == 2 * SMALL.iterations


def test_reports_are_plain_numbers_of_what_happened(learner, demonstration):
    _, info = learner.update(learner.init(jax.random.key(0)), demonstration)
    assert info.loss.shape == info.returns.shape == (SMALL.iterations,)
    assert ((info.expert_accuracy >= 0) & (info.expert_accuracy <= 1)).all()
    # A fresh categorical policy is nearly uniform over two actions.
    assert info.log_likelihood == pytest.approx(np.log(0.5), abs=0.1)
    assert np.isfinite(info.weights).all()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"iterations": 0}, "iterations"),
        ({"batch": 0}, "batch"),
        ({"average": "median"}, "average"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"penalty": -1.0}, "penalty"),
        ({"change": float("nan")}, "change"),
        ({"draws": 0}, "draws"),
    ],
)
def test_training_that_cannot_be_is_refused_by_name(generator, task, wrong, named):
    with pytest.raises(ValueError, match=named):
        adversarial("AIRL", generator, airl_discriminator(4, task.actions), training=SMALL._replace(**wrong))


def spoiled(x, at, value):
    x = np.array(x)
    x[at] = value
    return x


@pytest.mark.parametrize(
    ("field", "change", "named"),
    [
        ("observations", lambda x: spoiled(x, (1, 3, 0), np.nan), "trajectory 1, step 3: the observation"),
        ("observations", lambda x: x[..., :3], r"observations \[n, L, 4\].*got \(2, 40, 3\)"),
        ("actions", lambda x: spoiled(x, (0, 2), 7), "trajectory 0, step 2: there is no action 7.*0 to 1"),
        ("actions", lambda x: spoiled(x, (1, 5), -1), "trajectory 1, step 5: there is no action -1"),
        ("actions", lambda x: np.asarray(x, float), "integers, got float64"),
        ("actions", lambda x: np.zeros((2, 40, 1)), r"got \(2, 40, 4\) and \(2, 40, 1\)"),
        ("live", lambda x: spoiled(x, (0, 3), False), "trajectory 0: step 3 is padding, but step 4 is not"),
        ("live", np.zeros_like, "nothing can be learned"),
    ],
)
@pytest.mark.parametrize("method", ["AIRL", "noisy-AIRL"])
def test_recordings_that_cannot_be_are_refused_and_nothing_is_lost(
    learner, generator, task, demonstration, method, field, change, named
):
    if method == "noisy-AIRL":
        learner = noisy_airl(generator, airl_discriminator(4, task.actions), NoisyTraining(levels=(0.0, 0.1)))
    state = learner.init(jax.random.key(0))
    before = jax.tree.map(np.array, state.network)
    with pytest.raises(RecordingError, match=named):
        learner.update(state, demonstration._replace(**{field: change(getattr(demonstration, field))}))
    assert same(before, state.network)


def test_what_is_no_recording_is_refused(learner, demonstration):
    with pytest.raises(RecordingError, match="learns from a Recording, got a tuple"):
        learner.update(learner.init(jax.random.key(0)), tuple(demonstration))


@pytest.mark.parametrize("setting", [{"discount": 0.9}, {"entropy": 0.0}, {"reward": (8,)}])
def test_a_journal_refuses_another_discriminator(learner, generator, task, tmp_path, setting):
    Journal.open(tmp_path / "run.journal", learner).close()
    other = adversarial("AIRL", generator, airl_discriminator(4, task.actions, **setting), training=SMALL)
    with pytest.raises(JournalError, match="networks"):
        Journal.open(tmp_path / "run.journal", other)
    with Journal.open(tmp_path / "run.journal", learner) as journal:
        assert journal.session == 0


def test_a_journal_refuses_another_setting_of_the_task(tmp_path):
    def learner(stride: float):
        return airl(ppo(onion_reaching(stride), n_envs=2, n_steps=8, minibatch=8), training=SMALL)

    Journal.open(tmp_path / "run.journal", learner(0.3)).close()
    with pytest.raises(JournalError, match="environment"):
        Journal.open(tmp_path / "run.journal", learner(0.2))


@pytest.mark.parametrize("kind", [airl_discriminator, gail_discriminator])
def test_a_discount_of_one_is_refused(task, kind):
    with pytest.raises(ValueError, match=r"discount must be in \[0, 1\)"):
        kind(4, task.actions, 1.0)


@pytest.mark.parametrize("kind", [airl_discriminator, gail_discriminator])
def test_the_pole_is_balanced_by_imitation_alone(task, kind):
    # A demonstrator that is good enough to last: it pushes towards where the pole falls.
    def demonstrator(observation: np.ndarray) -> int:
        return int(observation[2] + 0.3 * observation[3] + 0.05 * observation[0] + 0.1 * observation[1] > 0)

    observations, actions = [], []
    step, observe = jax.jit(task.step), jax.jit(task.observe)
    state = task.reset(jax.random.key(5))
    for _ in range(300):
        seen = np.asarray(observe(state))
        observations.append(seen)
        actions.append(demonstrator(seen))
        state, _, ended = step(state, actions[-1])
        assert not ended
    demonstration = recording([np.array(observations)], [np.array(actions)], n_actions=2)
    agent = ppo(task, n_envs=8, n_steps=128, learning_rate=1e-3, scale_rewards=True)
    training = AdversarialTraining(iterations=48, updates=16, learning_rate=3e-3)
    learner = adversarial("x", agent, kind(4, task.actions), training=training)
    state, info = learner.update(learner.init(jax.random.key(0)), demonstration)
    random = info.returns[0]
    learned = agent.evaluate(state.generator.policy, jax.random.key(1), 10).returns.mean()
    assert random < 40
    assert learned > 200
