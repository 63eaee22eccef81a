import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.domains import instance
from i2rl.inference import DualProgram, PrimalProgram, solve_dual
from i2rl.inference.programs.constraints import FeatureTarget
from i2rl.models import feature_expectations, reward_of, soft_plan


@pytest.fixture(params=[1, 2, 3], scope="module")
def problem(request):
    """Make a patrol, weights a soft patroller might have, and its exact feature expectations."""
    patrol = instance(request.param)
    weights = jnp.asarray(patrol.weights) * (20.0 if request.param == 1 else 1.5)
    policy = soft_plan(patrol.mdp, reward_of(patrol.mdp, weights)).policy
    return patrol.mdp, weights, FeatureTarget(feature_expectations(patrol.mdp, policy), patrol.mdp.initial)


def unidentified(mdp):
    """Find directions in which weights change no behaviour, as orthonormal columns.

    Instance 3's features span a potential-based shaping (Ng, Harada and Russell 1999) with the potential "in
    a room": entering gains what leaving and staying lose. Such weights are unidentifiable from data.
    """
    if mdp.n_features != 5:
        return np.zeros((mdp.n_features, 0))
    success, gamma = 0.99, float(mdp.discount)
    direction = np.array([0, -(1 - gamma), 0, success * gamma, -success * gamma])
    return (direction / np.linalg.norm(direction))[:, None]


def test_shaping_changes_no_behaviour(problem):
    mdp, weights, _ = problem
    for direction in unidentified(mdp).T:
        policies = [soft_plan(mdp, reward_of(mdp, w)).policy for w in (weights, weights + 3.0 * direction)]
        assert np.allclose(*policies, atol=1e-10)


def test_all_three_programs_recover_the_weights_from_exact_expectations(problem):
    mdp, weights, target = problem
    solutions = [solve_dual(mdp, target), DualProgram(mdp).solve(target), PrimalProgram(mdp).solve(target)]
    free = unidentified(mdp)
    for solution in solutions:
        difference = np.asarray(solution.weights - weights)
        assert np.allclose(difference - free @ (free.T @ difference), 0, atol=1e-4)
    objectives = [float(s.objective) for s in solutions]
    assert np.ptp(objectives) < 1e-6 * max(1.0, abs(objectives[0]))


def test_all_three_programs_agree_under_slack(problem):
    mdp, _, target = problem
    slack = 0.002 / (1 - float(mdp.discount))
    solutions = [
        solve_dual(mdp, target, slack),
        DualProgram(mdp).solve(target, slack),
        PrimalProgram(mdp).solve(target, slack),
    ]
    for solution in solutions[1:]:
        assert np.allclose(solution.weights, solutions[0].weights, atol=1e-4)
    objectives = [float(s.objective) for s in solutions]
    assert np.ptp(objectives) < 1e-6 * max(1.0, abs(objectives[0]))
