import jax
import numpy as np
import pytest

from i2rl.domains import five_cells
from i2rl.inference import (
    birl,
    gibbs_mixture_posterior,
    lme_i2rl,
    run_sessions,
    sample_mixture_posterior,
    sample_noisy_posterior,
    sample_posterior,
)
from i2rl.models import Demonstration, Visibility, reward_of, soft_plan


def perceived(random_mdp, imperfect_demonstration):
    mdp = random_mdp(0)
    sensor = Visibility(np.array([True, True, False, True]))
    log_policy = soft_plan(mdp, reward_of(mdp, np.array([1.0, -1.0]))).log_policy
    return mdp, sensor, imperfect_demonstration(0, mdp, log_policy, sensor, 20, 5)


def test_sessions_are_told_on_standard_error_when_asked_for(random_mdp, imperfect_demonstration, capsys):
    mdp, sensor, demonstration = perceived(random_mdp, imperfect_demonstration)
    learner = lme_i2rl(mdp, sensor)
    run_sessions(learner, [demonstration], key=jax.random.key(0))
    assert capsys.readouterr() == ("", "")
    run_sessions(learner, [demonstration] * 2, key=jax.random.key(0), progress=True)
    assert capsys.readouterr() == ("", "LME-I2RL: session 1, compiling first\nLME-I2RL: session 2\n")


def test_a_posterior_tells_its_steps_when_asked_for(random_mdp, imperfect_demonstration, capsys):
    arguments = (jax.random.key(0), *perceived(random_mdp, imperfect_demonstration))
    sample_posterior(*arguments, draws=5, warmup=5, chains=2, progress=True)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "posterior: finding the mode, compiling first"
    assert lines[1] == "posterior: 2 chains of 5 + 5 draws, compiling first"
    assert lines[-1] == "posterior: hidden steps"


@pytest.mark.parametrize(
    ("sample", "model", "options"),
    [
        (sample_mixture_posterior, [five_cells().sensor], {"components": 2}),
        (gibbs_mixture_posterior, [five_cells().sensor], {}),
        (sample_noisy_posterior, [np.indices((5, 3))], {}),
        (birl, [], {}),
    ],
)
def test_every_sampler_tells_its_steps_when_asked_for(sample, model, options, capsys):
    walk = Demonstration.from_pairs([[0, 1]], [[1, 1]])
    arguments = (jax.random.key(0), five_cells().mdp, *model, walk)
    sample(*arguments, draws=2, warmup=3, chains=1, **options)
    assert capsys.readouterr() == ("", "")
    sample(*arguments, draws=2, warmup=3, chains=1, progress=True, **options)
    assert "posterior: 1 chain of 3 + 2" in capsys.readouterr().err
