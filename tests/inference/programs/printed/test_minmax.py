"""The printed assignment gradient: not that of its Lagrangian, and blind to the trajectories."""

from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.inference.programs.minmax import MinMaxProgram
from i2rl.inference.programs.printed.minmax import (
    TrajectorySpace,
    ascend_printed,
    assignment_gradient,
    coded_assignment_gradient,
    lagrangian,
    matched_weights,
    optimal_laws,
    printed_assignment_gradient,
)
from i2rl.models.process.planning import simulate

simulate_all = jax.jit(jax.vmap(simulate, in_axes=(0, None, None, None)), static_argnums=3)
VARIANTS = (printed_assignment_gradient, coded_assignment_gradient)
LABELS = np.repeat([0, 1], 8)


def accuracy(assignments, labels=LABELS):
    found = np.asarray(assignments).argmax(1)
    components = range(np.shape(assignments)[1])
    return max(np.mean(np.array(order)[found] == labels) for order in permutations(components))


class Tiny:
    """Trajectories of three steps in a process of two states and two actions, five of them demonstrated."""

    def __init__(self, seed, n_components=2, shown=5):
        rng = np.random.default_rng(seed)
        paths = np.array(np.meshgrid(*[range(4)] * 3)).reshape(3, -1).T
        features = rng.normal(0, 0.4, (4, 2))[paths].sum(1)[rng.permutation(64)]
        self.space = TrajectorySpace(features, shown)
        self.assignments = rng.dirichlet(np.full(n_components, 2.0), 64)
        self.weights = rng.normal(0, 1, (n_components, 2))
        self.row_multipliers = rng.normal(0, 1, shown)
        self.laws, self.normaliser = optimal_laws(self.space, self.assignments, self.weights)

    def value(self, assignments, laws=None, normaliser=None):
        return lagrangian(
            self.space,
            assignments,
            self.laws if laws is None else laws,
            self.normaliser if normaliser is None else normaliser,
            self.weights,
            self.row_multipliers,
        )

    def slopes(self, value, step=1e-6):
        slopes = np.zeros((self.space.demonstrated, self.assignments.shape[1]))
        for i, d in np.ndindex(*slopes.shape):
            up, down = self.assignments.copy(), self.assignments.copy()
            up[i, d] += step
            down[i, d] -= step
            slopes[i, d] = (value(up) - value(down)) / (2 * step)
        return slopes


@pytest.mark.parametrize("n_components", [2, 3])
def test_the_laws_are_optimal_and_sum_to_one(n_components):
    tiny = Tiny(0, n_components)
    proportions = tiny.assignments[: tiny.space.demonstrated].mean(0)
    assert (proportions * (tiny.assignments * tiny.laws).sum(0)).sum() == pytest.approx(1, abs=1e-12)
    rng = np.random.default_rng(1)
    best = tiny.value(tiny.assignments)
    for _ in range(20):
        other = tiny.laws * np.exp(0.1 * rng.normal(size=tiny.laws.shape))
        assert tiny.value(tiny.assignments, other) < best


@pytest.mark.parametrize("n_components", [2, 3])
def test_the_corrected_gradient_is_that_of_the_lagrangian(n_components):
    tiny = Tiny(2, n_components)
    exact = assignment_gradient(tiny.space, tiny.assignments, tiny.weights, tiny.row_multipliers)
    np.testing.assert_allclose(tiny.slopes(tiny.value), exact, atol=1e-7)

    def reoptimised(assignments):
        return tiny.value(assignments, *optimal_laws(tiny.space, assignments, tiny.weights))

    np.testing.assert_allclose(tiny.slopes(reoptimised), exact, atol=1e-7)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_printed_gradient_is_not_whatever_the_multipliers(variant):
    tiny = Tiny(2)
    shown = tiny.assignments[: tiny.space.demonstrated]
    exact = tiny.slopes(tiny.value)
    printed = variant(tiny.space, shown, tiny.weights)
    # Multipliers add a constant to a row: the difference between two components is free of them.
    assert np.abs(np.diff(exact - printed, axis=1)).max() > 0.1


def test_the_term_called_of_higher_order_is_not():
    tiny = Tiny(3)
    n = tiny.space.demonstrated

    def log_omega(assignments):
        proportions = assignments[:n].mean(0)
        return np.log(
            (proportions * np.exp(tiny.space.features @ (proportions[:, None] * tiny.weights).T)).sum()
        )

    proportions = tiny.assignments[:n].mean(0)
    exponent = tiny.space.features @ (proportions[:, None] * tiny.weights).T
    scale = n * np.exp(log_omega(tiny.assignments))
    kept, dropped = np.exp(exponent).sum(0) / scale, (np.exp(exponent) * exponent).sum(0) / scale
    np.testing.assert_allclose(tiny.slopes(log_omega), np.tile(kept + dropped, (n, 1)), atol=1e-8)
    assert np.abs(dropped / kept).max() > 0.1


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_the_trajectories_did_does_not_matter(variant):
    tiny = Tiny(4)
    n = tiny.space.demonstrated
    order = np.r_[np.random.default_rng(5).permutation(n), n : len(tiny.space.features)]
    exchanged = tiny.space._replace(features=tiny.space.features[order])
    shown = tiny.assignments[:n]
    np.testing.assert_allclose(
        variant(exchanged, shown, tiny.weights), variant(tiny.space, shown, tiny.weights), rtol=1e-12
    )
    own = (tiny.assignments, tiny.weights, tiny.row_multipliers)
    change = assignment_gradient(exchanged, *own) - assignment_gradient(tiny.space, *own)
    assert np.abs(change).max() > 0.01


@pytest.fixture(scope="module")
def two_tasks(random_mdp):
    """Visits of 16 trajectories, half by a policy that shuns what the other's does, and their space."""
    mdp = random_mdp(3, n_states=5, n_features=3)
    rng = np.random.default_rng(0)
    liking = 3.0 * rng.normal(size=mdp.available.shape)
    pairs = []
    for key, logits in enumerate((liking, -liking, np.zeros_like(liking))):
        policy = jax.nn.log_softmax(jnp.asarray(logits), axis=1)
        pairs.append(simulate_all(jax.random.split(jax.random.key(key), 100), mdp, policy, 20))
    chosen = [(pairs[0], 8), (pairs[1], 8), (pairs[2], 100)]
    states = np.concatenate([np.asarray(s)[:k] for (s, _), k in chosen])
    actions = np.concatenate([np.asarray(a)[:k] for (_, a), k in chosen])
    counts = np.zeros((len(states), *mdp.available.shape))
    np.add.at(counts, (np.repeat(np.arange(len(states)), 20), states.ravel(), actions.ravel()), 1)
    features = np.einsum("isa,sak->ik", counts, np.asarray(mdp.features))
    return mdp, counts[:16], TrajectorySpace(features, 16)


@pytest.mark.parametrize("variant", VARIANTS)
def test_trajectories_of_different_tasks_that_start_alike_end_alike(two_tasks, variant):
    _, _, space = two_tasks
    half = np.random.default_rng(6).dirichlet(np.ones(2), 8)
    found, _ = ascend_printed(space, np.concatenate([half, half]), variant)
    np.testing.assert_allclose(found[:8], found[8:], rtol=1e-9)
    assert accuracy(found) == 0.5


@pytest.mark.parametrize("variant", VARIANTS)
def test_ascent_leaves_the_accuracy_of_a_random_start(two_tasks, variant):
    _, _, space = two_tasks
    starts = np.random.default_rng(7).dirichlet(np.ones(2), (30, 16))
    ended = [ascend_printed(space, start, variant)[0] for start in starts]
    before, after = np.mean([*map(accuracy, starts)]), np.mean([*map(accuracy, ended)])
    # An arbitrary assignment of 16 is, up to the order of the components, right in 59.8 % on average.
    assert after < before + 0.05


def test_the_sound_form_finds_both_tasks_from_such_starts(two_tasks):
    mdp, counts, _ = two_tasks
    program = MinMaxProgram(mdp, 2, 16)
    starts = np.random.default_rng(7).dirichlet(np.ones(2), (3, 16))
    found = [program.solve(counts, 1.0, 0.1, 0.1, responsibilities=start) for start in starts]
    best = max(found, key=lambda solution: solution.objective)
    assert accuracy(best.responsibilities) == 1.0


def test_the_corrected_gradient_offers_a_way_what_it_explains_least(two_tasks):
    _, _, space = two_tasks
    shown = 0.4 + 0.2 * np.eye(2)[LABELS]
    weights = np.stack([matched_weights(space, share) for share in shown.T])
    everywhere = np.concatenate([shown, np.full((len(space.features) - 16, 2), 0.5)])
    gradient = assignment_gradient(space, everywhere, weights, np.zeros(16))
    towards_first = gradient[:, 0] - gradient[:, 1]
    assert towards_first[LABELS == 0].max() < towards_first[LABELS == 1].min()


def test_assignments_of_other_trajectories_are_refused(two_tasks):
    _, _, space = two_tasks
    with pytest.raises(ValueError, match="n = 16"):
        ascend_printed(space, np.full((5, 2), 0.5))
