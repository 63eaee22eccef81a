"""The comparison with a peer: its problems and its judge, checked against the package."""

import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.benchmarks.peers import finite_horizon as peers
from i2rl.inference.programs.finite_horizon import expected_visits, state_reward
from i2rl.models import TabularMDP, finite_soft_plan


def test_the_judges_visits_are_those_of_the_package():
    problem = peers.random_problem(20, seed=1, tolerance=1e-2)
    mdp = TabularMDP.from_successors(
        problem["successors"],
        problem["probabilities"],
        np.zeros((20, 4, 1)),
        initial=problem["initial"],
        discount=1.0,
    )
    rewards = jnp.asarray(np.random.default_rng(2).normal(size=20))
    log_policy = finite_soft_plan(mdp, state_reward(mdp, rewards), peers.HORIZON).log_policy
    visits = peers.state_visits(problem, np.exp(log_policy))
    np.testing.assert_allclose(visits.sum(1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(visits[:-1].sum(0), expected_visits(mdp, rewards, peers.HORIZON), rtol=1e-10)


def test_doing_nothing_in_particular_does_not_pass_the_judge():
    problem = peers.random_problem(124, seed=0, tolerance=1e-2)
    assert peers.final_gap(problem, np.full((peers.HORIZON, 124, 4), 0.25)) > 5e-2


def test_our_side_answers_within_the_tolerance(tmp_path):
    core = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    ours = peers.Side(
        "ours",
        [sys.executable, "-m", "i2rl.analysis.benchmarks.peers.finite_horizon", "--serve"],
        tmp_path,
        core,
    )
    problem = peers.random_problem(20, seed=3, tolerance=1e-3)
    np.savez(tmp_path / "problem.npz", **problem)
    run = ours.solve(tmp_path / "problem.npz", problem)
    ours.close()
    assert run["gap"] <= 1e-3
    assert run["evaluations"] > 1


def test_a_side_that_ends_early_is_an_error_not_a_time(tmp_path):
    with pytest.raises(RuntimeError, match="the process of peer ended with status 3"):
        peers.Side("peer", [sys.executable, "-c", "raise SystemExit(3)"], tmp_path, None)


def test_the_benchmark_says_what_is_missing_without_the_peers_interpreter(tmp_path):
    command = [
        sys.executable,
        "-m",
        "i2rl.analysis.benchmarks.peers.finite_horizon",
        "--peer-python",
        str(tmp_path / "python"),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 2
    assert "make bench-peers" in answer.stderr
