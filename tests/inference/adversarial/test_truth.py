import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.adversarial.discriminator import ExpertTransitions, Transitions
from i2rl.inference.adversarial.truth import FaceValue, Settling, look, reported_steps, within_bounds
from i2rl.models.networks.modules import ActionSpace
from i2rl.models.observation.recordings import recording

N, M = 50, 2
LIVE = np.arange(N) < 40
KEY = jax.random.key(0)


def logits(steps: Transitions):
    return steps.observations[..., 0]


class Normal:
    """Truths whose logits are standard normal; the chain counts how often it was asked."""

    def refresh(self, chain, sensor, policy, key):
        x = jax.random.normal(key, (N, M, 1))
        steps = Transitions(x, jnp.zeros((N, M), int), x, jnp.zeros((N, M), bool))
        return chain + 1, ExpertTransitions(steps, jnp.asarray(LIVE), jnp.full(M, 1 / M))

    more = refresh


def looked(change: float, most: int):
    return look(Normal(), 0, (), None, KEY, ActionSpace(1), logits, Settling(change, most))


def test_reported_steps_are_those_with_a_successor_or_a_termination():
    observations = [np.arange(3.0)[:, None], 10 + np.arange(2.0)[:, None]]
    rec = recording(observations, [np.array([0, 1, 0]), np.array([1, 1])], terminated=[False, True])
    steps, live, weights = reported_steps(rec)
    kept = np.flatnonzero(live)
    np.testing.assert_array_equal(steps.observations[kept, 0, 0], [0, 1, 10, 11])
    np.testing.assert_array_equal(steps.successors[kept, 0, 0][:3], [1, 2, 11])
    np.testing.assert_array_equal(steps.terminated[kept, 0], [False, False, False, True])
    assert weights.sum() == 1


def test_without_a_threshold_the_truth_is_sampled_once():
    chain, expert, draws = looked(np.inf, 20)
    assert chain == draws == 1
    assert expert.steps.observations.shape == (N, M, 1)


@pytest.mark.parametrize("change", [0.05, 0.02])
def test_the_truth_is_sampled_until_the_average_logit_settles(change):
    _, expert, draws = looked(change, 200)
    assert 2 < draws < 200
    drawn = np.asarray(logits(expert.steps))[:, : draws * M].reshape(N, draws, M).mean(-1)
    averages = np.cumsum(drawn, 1) / np.arange(1, draws + 1)
    moves = np.abs(np.diff(averages, axis=1))[LIVE].mean(0)
    assert moves[-1] <= change < moves[:-1].min()


def test_moves_are_counted_for_each_logit_however_many_there_are():
    # A mean of n standard normal pairs moves by about |N(0, 1/2)| / n when one is added: .56 / n.
    _, _, draws = looked(0.02, 200)
    assert draws == pytest.approx(0.56 / 0.02, rel=0.25)


def test_samples_that_were_not_drawn_weigh_nothing():
    _, expert, draws = looked(0.05, 60)
    assert expert.steps.observations.shape == (N, 60 * M, 1)
    drawn = np.asarray(expert.weights) > 0
    np.testing.assert_array_equal(drawn, np.arange(60 * M) < draws * M)
    assert float(expert.weights.sum()) == pytest.approx(1)
    average = np.asarray(logits(expert.steps) @ expert.weights)
    np.testing.assert_allclose(average, logits(expert.steps)[:, drawn].mean(1), rtol=1e-5, atol=1e-7)


def test_at_most_so_many_samplings_are_made():
    chain, expert, draws = looked(0.0, 7)
    assert chain == draws == 7
    np.testing.assert_allclose(expert.weights, 1 / (7 * M), rtol=1e-6)


def test_reports_at_face_value_settle_at_once():
    rec = recording([np.arange(5.0)[:, None]], [np.zeros(5, int)])
    found = look(FaceValue(), rec, (), None, KEY, ActionSpace(1), logits, Settling(1e-9, 20))
    assert found.draws == 2


def test_actions_are_cut_to_their_bounds():
    rec = recording([np.zeros((3, 1))], [np.array([[-3.0], [0.5], [2.0]])])
    cut = within_bounds(ActionSpace(0, (-1.0,), (1.0,)), reported_steps(rec))
    np.testing.assert_array_equal(cut.steps.actions[:, 0, 0], [-1, 0.5, 1])
