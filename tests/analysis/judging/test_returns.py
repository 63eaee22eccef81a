"""Metrics of learned networks against SciPy, closed forms and simulation."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2rl.analysis.judging.returns import (
    accuracy_of_cells,
    action_agreement,
    behaviour_accuracies,
    behaviour_accuracy,
    bounded_ile,
    empirical_ile,
    fisher_interval,
    recovered_share,
    returns_at_fixed_length,
    reward_correlation,
    seed_interval,
)
from i2rl.domains.robots.control import cart_pole, mountain_car
from i2rl.domains.robots.simulation import Perturbed, graded_mix, simulate
from i2rl.domains.robots.walkers import locomotion
from i2rl.models.networks.modules import ActionSpace, policy_network

KEY = jax.random.key(0)
BOUNDED = ActionSpace(0, (-1.0, -2.0), (1.0, 2.0))


class Linear(NamedTuple):
    """Acts by ``gain @ observation + shift``; draws with a deviation of one."""

    gain: Any
    shift: Any
    actions: ActionSpace = BOUNDED

    def mode(self, observations):
        return observations @ self.gain.T + self.shift

    def sample(self, key, observations):
        mean = self.mode(observations)
        return mean + jax.random.normal(key, mean.shape, mean.dtype)


class Energetic(NamedTuple):
    """Mountain car's usual solution: push the way it rolls, ``+ 1`` being to the right of ``threshold``."""

    threshold: Any = 0.0

    def mode(self, observations):
        return jnp.where(observations[..., 1] >= self.threshold, 2, 0)

    def sample(self, key, observations):
        return self.mode(observations)


class Balancing(NamedTuple):
    """Pushes the cart under the pole."""

    gains: Any

    def mode(self, observations):
        return (observations @ self.gains > 0).astype(jnp.int32)

    def sample(self, key, observations):
        return self.mode(observations)


class OnHost:
    """A compiled environment behind the protocol of those that are stepped in NumPy."""

    def __init__(self, environment):
        self.name, self.actions = environment.name, environment.actions
        self.observation_size, self.horizon = environment.observation_size, environment.horizon
        self._of = environment
        self._step = jax.jit(jax.vmap(environment.step))

    def reset(self, key, n):
        return np.asarray(jax.vmap(self._of.reset)(jax.random.split(key, n)))

    def step(self, states, actions):
        return tuple(np.asarray(x) for x in self._step(states, actions))

    def observe(self, states):
        return np.asarray(jax.vmap(self._of.observe)(states))


CART = cart_pole()
HOSTED = OnHost(CART)


# -- acting -------------------------------------------------------------------------------------------


def test_both_protocols_give_the_same_episodes():
    balancing = Balancing(jnp.array([0.0, 0.0, 1.0, 0.3], jnp.float32))
    compiled = simulate(CART, balancing, KEY, 4, 120, deterministic=True)
    hosted = simulate(HOSTED, balancing, KEY, 4, 120, deterministic=True)
    assert compiled.live.sum() > 60
    for ours, theirs in zip(compiled, hosted, strict=True):
        live = compiled.live if ours.ndim > 1 else slice(None)
        np.testing.assert_allclose(ours[live], theirs[live], rtol=1e-6)
    np.testing.assert_array_equal(compiled.returns, compiled.live.sum(1))


def test_an_episode_earns_nothing_after_it_ended():
    falling = Balancing(jnp.array([0.0, 0.0, 0.0, 0.0], jnp.float32))  # always to the left
    for environment in (CART, HOSTED):
        found = simulate(environment, falling, KEY, 4, 120, deterministic=True)
        assert found.terminated.all()
        assert (found.live[:, 1:] <= found.live[:, :-1]).all()
        lengths = found.live.sum(1)
        assert ((lengths >= 8) & (lengths <= 11)).all()  # Gymnasium's own constant policy lasts 8 to 11
        np.testing.assert_array_equal(found.returns, lengths)
        np.testing.assert_array_equal(found.recording.lengths, lengths)
        assert len(found.visited) == lengths.sum()


def test_the_length_alone_ends_an_episode_that_does_not_terminate():
    idle = Energetic(jnp.float32(1.0))  # always left: never at the flag
    returns = returns_at_fixed_length(mountain_car(), idle, KEY, 2, 300, deterministic=True)
    np.testing.assert_array_equal(returns, [-300.0, -300.0])
    assert (returns_at_fixed_length(mountain_car(), Energetic(), KEY, 5, None) > -200).all()


def test_returns_of_a_robot_are_the_rewards_of_its_steps():
    cheetah = locomotion("half-cheetah")
    policy = policy_network(jax.random.key(1), cheetah.observation_size, cheetah.actions)
    found = simulate(cheetah, policy, KEY, 3, 20)
    states = cheetah.reset(jax.random.split(KEY)[0], 3)
    total = np.zeros(3)
    for t in range(20):
        np.testing.assert_allclose(found.observations[:, t], cheetah.observe(states))
        states, rewards, _ = cheetah.step(states, found.actions[:, t])
        total += rewards
    np.testing.assert_allclose(found.returns, total)
    assert np.abs(found.actions).max() <= 1
    np.testing.assert_allclose(found.next_observations[:, :-1], found.observations[:, 1:])


def test_a_perturbed_policy_does_anything_as_often_as_it_says():
    seen = jnp.zeros((20_000, 2), jnp.float32)
    still = Linear(jnp.zeros((2, 2), jnp.float32), jnp.full(2, 5.0, jnp.float32))  # far beyond the bounds
    drawn = np.asarray(Perturbed(still, 0.3).sample(KEY, seen))
    anything = (drawn < [1.0, 2.0]).any(1)
    assert abs(anything.mean() - 0.3) < 0.015
    assert stats.kstest(drawn[anything][:, 1], stats.uniform(-2, 4).cdf).pvalue > 1e-3
    whole = np.asarray(Perturbed(still, 1).sample(KEY, seen[:100]))  # a share need not be a float
    assert (whole < [1.0, 2.0]).any(1).all()


def test_a_mix_says_whose_each_episode_is():
    car = mountain_car()
    mix, whose = graded_mix(car, [Energetic(), Energetic(jnp.float32(1.0))], KEY, 4, 150)
    np.testing.assert_array_equal(whose, [0, 0, 0, 0, 1, 1, 1, 1])
    assert mix.terminated[:4].all()
    assert not mix.terminated[4:].any()


def test_there_must_be_an_episode():
    with pytest.raises(ValueError, match="at least 1 episode of 1 step, got 0 of 5"):
        simulate(mountain_car(), Energetic(), KEY, 0, 5)


# -- rewards ------------------------------------------------------------------------------------------


def test_correlations_are_scipys():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 20))
    y = np.exp(0.5 * x) + rng.normal(size=x.shape)
    live = np.arange(20) < rng.integers(5, 21, 6)[:, None]
    found = reward_correlation(x, y, live, KEY)
    peer = stats.pearsonr(x[live], y[live])
    assert found.steps.n == live.sum()
    assert found.steps.pearson == pytest.approx(peer.statistic, abs=1e-12)
    assert found.steps.fisher == pytest.approx(tuple(peer.confidence_interval()), abs=1e-12)
    assert found.steps.spearman == pytest.approx(stats.spearmanr(x[live], y[live]).statistic, abs=1e-12)
    sums = (np.where(live, x, 0).sum(1), np.where(live, y, 0).sum(1))
    assert found.trajectories.n == 6
    assert found.trajectories.pearson == pytest.approx(stats.pearsonr(*sums).statistic, abs=1e-12)


def test_only_scale_and_shift_are_free():
    x = np.random.default_rng(1).normal(size=(5, 7))
    live = np.ones(x.shape, bool)
    same = reward_correlation(3e4 + 1e-3 * x, x, live, KEY)
    assert same.steps.pearson == pytest.approx(1.0)
    assert same.steps.bootstrap.low == pytest.approx(1.0)
    bent = reward_correlation(np.exp(4 * x), x, live, KEY).steps
    assert bent.spearman == pytest.approx(1.0)
    assert bent.pearson < 0.95
    assert reward_correlation(-x, x, live, KEY).trajectories.pearson == pytest.approx(-1.0)
    assert math.isnan(reward_correlation(np.full_like(x, 0.1), x, live, KEY).steps.pearson)


def test_fishers_interval_covers_the_truth_as_often_as_it_says():
    rng, rho, n = np.random.default_rng(2), 0.6, 20
    draws = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], (2000, n))
    covered = 0
    for sample in draws:
        low, high = fisher_interval(np.corrcoef(sample.T)[0, 1], n)
        covered += low <= rho <= high
    assert abs(covered / 2000 - 0.95) < 0.02


def test_steps_of_a_trajectory_depend_on_each_other_and_the_bootstrap_knows():
    """Share most of a trajectory's level between both rewards, so that steps repeat the trajectory."""
    rng, rho, trajectories, steps, repeats = np.random.default_rng(3), 0.5, 40, 25, 150
    fisher = bootstrap = 0
    live = np.ones((trajectories, steps), bool)
    for i in range(repeats):
        level = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], (trajectories, 1))
        own = rng.multivariate_normal([0, 0], [[1, rho], [rho, 1]], (trajectories, steps))
        pair = np.sqrt(0.9) * level + np.sqrt(0.1) * own  # still of correlation rho
        found = reward_correlation(*np.moveaxis(pair, -1, 0), live, jax.random.key(i), resamples=400).steps
        fisher += found.fisher.low <= rho <= found.fisher.high
        bootstrap += found.bootstrap.low <= rho <= found.bootstrap.high
    assert fisher / repeats < 0.5
    assert bootstrap / repeats > 0.87


def test_rewards_that_cannot_be_compared_are_refused():
    x, live = np.zeros((5, 3)), np.ones((5, 3), bool)
    with pytest.raises(ValueError, match="one shape"):
        reward_correlation(x, x[:, :2], live, KEY)
    with pytest.raises(ValueError, match="at least 4 trajectories, got 3"):
        reward_correlation(x[:3], x[:3], live[:3], KEY)
    wrong = x.copy()
    wrong[2, 1] = np.nan
    with pytest.raises(ValueError, match="trajectory 2, step 1: the learned reward is nan"):
        reward_correlation(wrong, x, live, KEY)
    live[2, 1] = False  # what is not live does not count
    reward_correlation(wrong, x, live, KEY)


# -- behaviour ----------------------------------------------------------------------------------------


def test_agreement_of_vectors_is_one_less_their_distance_over_the_longest():
    alike = action_agreement(
        BOUNDED, np.array([[1.0, 2.0], [0.0, 0.0], [9.0, 0.0]]), np.array([[-1.0, -2.0]])
    )
    np.testing.assert_allclose(alike, [0.0, 0.5, 1 - math.hypot(2, 2) / math.hypot(2, 4)])
    np.testing.assert_array_equal(
        action_agreement(ActionSpace(3), np.array([0, 1]), np.array([0, 2])), [1, 0]
    )


def test_accuracy_over_a_uniform_law_is_its_integral():
    """Policies ``s / 2`` and zero on [-1, 1]: mean ``1 - |s| / 4`` is 7/8."""
    space = ActionSpace(0, (-1.0,), (1.0,))
    half, none = (
        Linear(jnp.full((1, 1), g, jnp.float32), jnp.zeros(1, jnp.float32), space) for g in (0.5, 0)
    )
    states = np.linspace(-1, 1, 4001)[:, None]
    assert behaviour_accuracy(space, half, none, states) == pytest.approx(0.875, abs=1e-3)
    assert behaviour_accuracy(space, half, half, states) == 1.0


def test_accuracy_is_told_over_three_laws_of_states():
    car = mountain_car()
    found = behaviour_accuracies(car, Energetic(), Energetic(jnp.float32(0.01)), KEY, 4, 150)
    assert (
        found.n[0] == found.n[2] == simulate(car, Energetic(), jax.random.split(KEY, 3)[0], 4, 150).live.sum()
    )
    assert all(0 < share < 1 for share in found[:3])
    same = behaviour_accuracies(car, Energetic(), Energetic(), KEY, 4, 150)
    assert same[:3] == (1.0, 1.0, 1.0)


def test_accuracy_of_mountain_cars_cells_is_the_share_of_their_area():
    """Two policies that differ where 0 <= velocity < 0.0105, three quarters of a cell's height of 0.014."""
    shares = accuracy_of_cells(
        mountain_car(), Energetic(), Energetic(jnp.float32(0.0105)), cells=10, points=20
    )
    expected = np.ones(10)
    expected[5] = 0.25
    np.testing.assert_allclose(shares, np.broadcast_to(expected, (10, 10)))
    with pytest.raises(ValueError, match="not bounded"):
        accuracy_of_cells(cart_pole(), Energetic(), Energetic())


# -- what noise costs ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("demonstrated", "generated", "printed"),
    [(0.907, 0.726, 0.199), (0.889, 0.625, 0.297), (0.843, 0.637, 0.243)],
)
def test_the_tables_form_gives_the_numbers_of_table_7_5(demonstrated, generated, printed):
    found = empirical_ile(demonstrated, generated)
    assert found.of_table == pytest.approx(printed, abs=0.0015)
    assert abs(found.of_text - printed) > 0.1
    assert found.of_text == pytest.approx(1 - demonstrated / generated)


def test_bounded_values_are_means_of_sigmoids():
    rng = np.random.default_rng(4)
    demonstrated, generated = rng.normal(1, 2, (3, 10)), rng.normal(0, 2, (4, 8))
    short = np.arange(10) < np.array([10, 4, 7])[:, None]
    whole = np.ones((4, 8), bool)
    found = bounded_ile(demonstrated, short, generated, whole)
    pooled = np.concatenate([demonstrated[short], generated[whole]])
    scaled = (demonstrated - pooled.mean()) / pooled.std()
    by_hand = np.mean(
        [1 / (1 + np.exp(-scaled[i, : short[i].sum()])) @ np.ones(n) / n for i, n in enumerate(short.sum(1))]
    )
    assert found.demonstrated == pytest.approx(by_hand)
    assert 0 < found.generated < found.demonstrated < 1
    same = bounded_ile(demonstrated, short, demonstrated, short)
    assert same.of_table == same.of_text == 0
    with pytest.raises(ValueError, match="demonstrated trajectory 1 has no step"):
        bounded_ile(demonstrated, short & (np.arange(3) != 1)[:, None], generated, whole)


@pytest.mark.parametrize(
    ("clean", "noisy", "robust", "share"),
    [(2130, 702, 1810, 0.78), (2204, 848, 1390, 0.40), (2251, 750, 1662, 0.61)],
)
def test_the_dissertations_recovered_shares_follow_from_table_7_3(clean, noisy, robust, share):
    found = recovered_share([clean], [noisy], [robust], KEY)
    assert found.share == pytest.approx(share, abs=0.005)
    assert found.low == found.high == found.share
    assert found.lost == 1


def test_the_interval_of_a_recovered_share_covers_it():
    rng, covered = np.random.default_rng(5), 0
    for i in range(200):
        clean, noisy, robust = (rng.normal(m, 20, 25) for m in (100, 50, 90))
        found = recovered_share(clean, noisy, robust, jax.random.key(i), resamples=500)
        covered += found.low <= 0.8 <= found.high
    assert 0.89 < covered / 200 < 0.99


def test_where_noise_may_have_cost_nothing_the_interval_has_no_end():
    rng = np.random.default_rng(6)
    clean, noisy, robust = rng.normal(0, 1, (3, 10))
    found = recovered_share(clean, noisy, robust + 1, KEY)
    assert 0 < found.lost < 1
    assert found.high == math.inf
    with pytest.raises(ValueError, match="one number a replication"):
        recovered_share(clean, noisy[:9], robust, KEY)
    with pytest.raises(ValueError, match="replication 1 of robust is not finite"):
        recovered_share([1.0, 1.0], [0.0, 0.0], [0.5, np.nan], KEY)


@pytest.mark.parametrize(("gained", "share"), [(-0.3, -math.inf), (0.3, math.inf)])
def test_of_nothing_lost_no_share_is_won_back(gained, share):
    # Minus 0.3 of minus 0.5 is not 60 % of a loss.
    found = recovered_share([1.0, 1.0], [1.5, 1.5], [1.5 + gained] * 2, KEY)
    assert found.share == found.low == found.high == share
    assert found.lost == 0


def test_the_interval_over_few_seeds_covers_the_mean():
    replications = np.random.default_rng(7).normal(3.0, 2.0, (5, 4000))
    band = seed_interval(replications)
    assert abs(((band.low <= 3) & (band.high >= 3)).mean() - 0.95) < 0.015
    assert np.isnan(seed_interval(replications[:1]).low).all()
