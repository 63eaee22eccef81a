"""Assumptions of a bound, which is quoted only if they hold."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.bounds.assumptions import BoundNotGuaranteed, check
from i2rl.analysis.bounds.theorems import lme_i2rl_confidence, me_i2rl_confidence, no_regret
from i2rl.domains import instance
from i2rl.inference import Harmonic, lme_i2rl, me_i2rl, run_sessions
from i2rl.models import Sensor, TrajectoryLaw, Visibility, reward_of, sample_demonstration, soft_plan

EVERYTHING = dict.fromkeys(("features", "weights", "soft_expert", "independent", "whole", "full_view"), True)


def _holds(bound, name):
    return next(a.holds for a in bound.assumptions if a.name == name)


def test_a_bound_names_what_it_takes_on_trust():
    bound = me_i2rl_confidence(500, 0.1, 6, 0.99)
    sentence = bound.guarantee()
    assert "Theorem 1" in sentence
    assert "provided that" in sentence
    assert "trajectories are independent" in sentence
    assert "provided" not in bound.assuming(**EVERYTHING, program=True, solved=True).guarantee()


def test_a_bound_is_not_quoted_where_an_assumption_fails():
    bound = me_i2rl_confidence(500, 0.1, 6, 0.99).assuming(independent=False)
    with pytest.raises(BoundNotGuaranteed, match="trajectories are independent"):
        bound.guarantee()


def test_an_unknown_assumption_is_refused_by_name():
    with pytest.raises(ValueError, match="has no assumption 'iid'; its assumptions are features, weights"):
        me_i2rl_confidence(500, 0.1, 6, 0.99).assuming(iid=True)


def test_patrol_3s_negative_weight_is_outside_the_theorem():
    patrol = instance(3)
    bound = me_i2rl_confidence(500, 0.1, patrol.mdp.n_features, float(patrol.mdp.discount))
    checked = check(bound, mdp=patrol.mdp, weights=patrol.weights)
    assert _holds(checked, "weights") is False
    assert _holds(checked, "features") is True
    with pytest.raises(BoundNotGuaranteed, match=r"weights lie in \[0, 1\]\^K \(they range from -1 to 1\)"):
        checked.guarantee()


def test_a_greedy_expert_is_not_the_soft_one_of_the_theorem():
    patrol = instance(2)
    bound = me_i2rl_confidence(500, 0.1, patrol.mdp.n_features, float(patrol.mdp.discount))
    weights = jnp.asarray(patrol.weights)
    soft = soft_plan(patrol.mdp, reward_of(patrol.mdp, weights)).policy
    for policy, answer in ((patrol.expert_policy(), False), (soft, True)):
        checked = check(bound, mdp=patrol.mdp, weights=patrol.weights, expert=policy)
        assert _holds(checked, "soft_expert") is answer


def test_five_steps_are_not_a_whole_trajectory(random_mdp):
    patrol = instance(2)
    bound = me_i2rl_confidence(500, 0.1, 6, 0.99)
    assert _holds(check(bound, mdp=patrol.mdp, length=5), "whole") is False
    assert _holds(check(bound, mdp=patrol.mdp, length=1000), "whole") is True


def test_features_out_of_range_are_found(random_mdp):
    mdp = random_mdp(0)
    larger = dataclasses.replace(mdp, features=3 * jnp.abs(mdp.features) + 1)
    bound = me_i2rl_confidence(500, 0.1, mdp.n_features, 0.9)
    assert _holds(check(bound, mdp=larger), "features") is False


def test_a_run_of_the_theorems_program_is_recognised(random_mdp):
    mdp = random_mdp(1)
    weights = jnp.linspace(0.2, 0.8, mdp.n_features)
    demonstration = sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, weights, Sensor(), 120), 8)
    bound = me_i2rl_confidence(8, 0.1, mdp.n_features, float(mdp.discount))
    learner = me_i2rl(mdp, statistic="features", slack=0.1, iterations=30)
    run = run_sessions(learner, demonstration.sessions(4), key=jax.random.key(1))
    checked = check(bound, learner=learner, state=run.state)
    assert _holds(checked, "program") is True
    assert _holds(checked, "solved") is True
    assert _holds(checked, "features") is not None
    moved = run.state._replace(weights=run.state.weights + 3.0)
    assert _holds(check(bound, learner=learner, state=moved), "solved") is False


def test_feasible_weights_that_are_not_the_programs_solution_do_not_count_as_solved(random_mdp):
    mdp = random_mdp(1)
    weights = jnp.linspace(0.2, 0.8, mdp.n_features)
    demonstration = sample_demonstration(jax.random.key(0), TrajectoryLaw(mdp, weights, Sensor(), 120), 8)
    learner = me_i2rl(mdp, statistic="features", slack=0.3, iterations=30)
    state = run_sessions(learner, demonstration.sessions(8), key=jax.random.key(1)).state
    bound = me_i2rl_confidence(8, 0.3, mdp.n_features, float(mdp.discount))
    assert _holds(check(bound, learner=learner, state=state), "solved") is True
    wide = state._replace(weights=weights)  # within the slack, but not of largest entropy
    checked = check(bound, learner=learner, state=wide)
    assert _holds(checked, "solved") is False
    assert "duality gap" in next(a.reason for a in checked.assumptions if a.name == "solved")


def test_what_was_found_false_cannot_be_assumed():
    patrol = instance(3)
    bound = me_i2rl_confidence(500, 0.1, patrol.mdp.n_features, float(patrol.mdp.discount))
    checked = check(bound, mdp=patrol.mdp, weights=patrol.weights)
    with pytest.raises(ValueError, match=r"cannot be assumed that the expert's weights lie in \[0, 1\]"):
        checked.assuming(weights=True)


def test_another_statistic_or_slack_is_not_the_theorems_program(random_mdp):
    mdp = random_mdp(1)
    bound = lme_i2rl_confidence(300, 900, 0.1, 0.05, mdp.n_features, 0.9)
    sensor = Visibility(np.arange(mdp.n_states) % 2 == 0)
    for options in ({"statistic": "seen"}, {"statistic": "features", "slack": 0.1}):
        checked = check(bound, learner=lme_i2rl(mdp, sensor, **options))
        assert _holds(checked, "program") is False
    right = lme_i2rl(mdp, sensor, statistic="features", slack=0.15)
    assert _holds(check(bound, learner=right), "program") is True


def test_the_no_regret_theorem_is_about_the_harmonic_schedule(random_mdp):
    mdp = random_mdp(1)
    bound = no_regret(2.0, [1000] * 3, mdp.n_features, float(mdp.discount)).bound
    for slack, answer in ((Harmonic(2.0), True), (Harmonic(3.0), False), (0.1, False)):
        learner = me_i2rl(mdp, statistic="features", slack=slack)
        assert _holds(check(bound, learner=learner), "program") is answer


def test_a_slack_that_is_an_array_is_the_number_it_holds(random_mdp):
    mdp = random_mdp(1)
    bound = me_i2rl_confidence(8, 0.1, mdp.n_features, float(mdp.discount))
    learner = me_i2rl(mdp, statistic="features", slack=jnp.asarray(0.1))
    assert _holds(check(bound, learner=learner), "program") is True
    assert learner.signature == me_i2rl(mdp, statistic="features", slack=0.1).signature


def test_what_cannot_be_checked_together_is_refused(random_mdp):
    mdp = random_mdp(1)
    bound = me_i2rl_confidence(8, 0.1, mdp.n_features, 0.9)
    with pytest.raises(ValueError, match="against its learner"):
        check(bound, state=object())
    with pytest.raises(ValueError, match="learns on another MDP"):
        check(bound, mdp=random_mdp(2), learner=me_i2rl(mdp))
    with pytest.raises(ValueError, match="give the MDP"):
        check(bound, length=5)
    with pytest.raises(ValueError, match="features, but weights have shape"):
        check(bound, mdp=mdp, weights=np.ones(99))
    with pytest.raises(ValueError, match="also needs `weights` and the MDP"):
        check(bound, expert=np.ones((2, 2)))
