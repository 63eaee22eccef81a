import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.extras import required
from i2rl.inference.sessions.serialization import decode, encode, restore
from i2rl.models.networks.modules import (
    MLP,
    ActionSpace,
    CategoricalPolicy,
    GaussianPolicy,
    RunningNorm,
    ShapedReward,
    policy_network,
)

VECTORS = ActionSpace(0, (-1.0, -2.0), (1.0, 2.0))
KEY = jax.random.key(0)


def test_a_running_norm_is_that_of_all_inputs_at_once():
    rng = np.random.default_rng(0)
    parts = [rng.normal(3, 2, (n, 4)) for n in (5, 1, 40)]
    norm = RunningNorm.create(4)
    for part in parts:
        norm = norm.update(part)
    everything = np.concatenate(parts)
    np.testing.assert_allclose(norm.mean, everything.mean(0), rtol=1e-5)
    np.testing.assert_allclose(norm.deviation, everything.std(0), rtol=1e-4)
    scaled = (everything[:2] - everything.mean(0)) / everything.std(0)
    np.testing.assert_allclose(norm(everything[:2]), scaled, rtol=1e-4, atol=1e-5)


def test_a_norm_without_inputs_changes_nothing():
    x = np.array([[0.5, -3.0]])
    np.testing.assert_allclose(RunningNorm.create(2)(x), x, rtol=1e-6)


def test_the_density_of_a_normal_policy_is_scipys():
    policy = GaussianPolicy.create(KEY, 3, VECTORS, log_deviation=-0.3)
    s, a = np.random.default_rng(1).normal(size=(5, 3)), np.random.default_rng(2).normal(size=(5, 2))
    expected = stats.norm.logpdf(a, policy.mode(s), np.exp(-0.3)).sum(1)
    np.testing.assert_allclose(policy.log_prob(s, a), expected, rtol=1e-5)
    np.testing.assert_allclose(policy.entropy(s), 2 * stats.norm.entropy(scale=np.exp(-0.3)), rtol=1e-5)


def test_draws_of_a_normal_policy_have_its_moments():
    policy = GaussianPolicy.create(KEY, 3, VECTORS, log_deviation=0.2)
    s = jnp.broadcast_to(jnp.array([0.1, -1.0, 2.0]), (20_000, 3))
    drawn = policy.sample(jax.random.key(1), s)
    np.testing.assert_allclose(drawn.mean(0), policy.mode(s[0]), atol=5 * np.exp(0.2) / np.sqrt(20_000))
    np.testing.assert_allclose(drawn.std(0), np.exp(0.2), rtol=0.03)


def test_a_categorical_policy_is_a_distribution_and_draws_from_it():
    policy = CategoricalPolicy.create(KEY, 3, ActionSpace(4))
    s = jnp.broadcast_to(jnp.array([0.1, -1.0, 2.0]), (20_000, 3))
    p = np.exp(policy.log_probs(s[0]))
    assert p.sum() == pytest.approx(1, abs=1e-6)
    counts = np.bincount(policy.sample(jax.random.key(1), s), minlength=4)
    assert stats.chisquare(counts, p / p.sum() * 20_000).pvalue > 1e-4
    np.testing.assert_allclose(policy.log_prob(s[:4], jnp.arange(4)), np.log(p), rtol=1e-5)
    assert float(policy.entropy(s[0])) == pytest.approx(stats.entropy(p), rel=1e-5)


def test_actions_are_encoded_and_cut():
    np.testing.assert_array_equal(ActionSpace(3).encode(np.array([2, 0])), [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(VECTORS.clip(jnp.array([[-3.0, 3.0]])), [[-1, 2]])
    assert ActionSpace(3).size == 3
    assert VECTORS.size == 2


def test_the_reward_of_a_state_alone_ignores_the_action():
    reward = ShapedReward.create(KEY, 3, ActionSpace(2), 0.9, state_only=True)
    s = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_array_equal(reward(s, np.zeros(4, int)), reward(s, np.ones(4, int)))


def test_the_shaped_reward_is_the_reward_and_the_change_of_potential():
    reward = ShapedReward.create(KEY, 3, VECTORS, 0.9)
    rng = np.random.default_rng(0)
    s, a, following = rng.normal(size=(4, 3)), rng.normal(size=(4, 2)), rng.normal(size=(4, 3))
    h, later = (reward.potential(reward.norm(x))[..., 0] for x in (s, following))
    np.testing.assert_allclose(
        reward.shaped(s, a, following, np.array([False, False, True, True])),
        reward(s, a) + 0.9 * np.array([1, 1, 0, 0]) * later - h,
        rtol=1e-5,
        atol=1e-6,
    )


@pytest.mark.parametrize("space", [ActionSpace(3), VECTORS])
def test_networks_compute_in_32_bits_and_are_stored_to_the_bit(space):
    policy = policy_network(KEY, 3, space)
    s = np.zeros((2, 3))
    assert policy.sample(KEY, s).dtype in (jnp.float32, jnp.int64, jnp.int32)
    assert policy.log_prob(s, policy.sample(KEY, s)).dtype == jnp.float32
    stored = restore(decode(encode(policy)), policy)
    assert all(
        np.asarray(x).tobytes() == np.asarray(y).tobytes()
        for x, y in zip(jax.tree.leaves(policy), jax.tree.leaves(stored), strict=True)
    )


def test_an_unknown_activation_is_refused():
    with pytest.raises(ValueError, match="sigmoid"):
        MLP.create(KEY, (2, 2), activation="sigmoid")


def test_a_missing_package_is_named_with_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModuleNotFoundError, match=r"mujoco.*pip install 'i2rl\[adversarial\]'"):
        required("mujoco")
