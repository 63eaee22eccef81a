"""AIRL by the ``imitation`` library, one request a line, in an interpreter that has it.

It is independent of this package. A request is JSON: ``env``, ``demonstrations`` (an ``.npz`` with arrays
``observations [n, L + 1, d]`` and ``actions [n, L, ...]``), ``n_envs``, ``n_steps``, ``rounds``, ``updates``,
``batch``, ``seed``. The answer is one JSON line: seconds of ``AIRL.train`` and the mean return of ten
deterministic episodes after it.
"""

import json
import sys
import time
from importlib.metadata import version


def main() -> None:
    """Answer requests until standard input ends."""
    import gymnasium
    import numpy as np
    import torch
    from imitation.algorithms.adversarial.airl import AIRL
    from imitation.data.types import Trajectory
    from imitation.data.wrappers import RolloutInfoWrapper
    from imitation.rewards.reward_nets import BasicShapedRewardNet
    from imitation.util.logger import configure
    from imitation.util.networks import RunningNorm
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import DummyVecEnv

    torch.set_num_threads(1)  # quicker than two for networks this small
    print(json.dumps({"imitation": version("imitation"), "torch": version("torch")}), flush=True)
    for request in sys.stdin:
        ask = json.loads(request)
        torch.manual_seed(ask["seed"])
        stored = np.load(ask["demonstrations"])
        demonstrations = [
            Trajectory(obs=o, acts=a, infos=None, terminal=True)
            for o, a in zip(stored["observations"], stored["actions"], strict=True)
        ]

        def made(name: str = ask["env"]) -> gymnasium.Env:
            return RolloutInfoWrapper(gymnasium.make(name))

        venv = DummyVecEnv([made for _ in range(ask["n_envs"])])
        venv.seed(ask["seed"])
        learner = PPO(
            "MlpPolicy",
            venv,
            n_steps=ask["n_steps"],
            batch_size=64,
            n_epochs=10,
            seed=ask["seed"],
            policy_kwargs={"net_arch": [32, 32]},
            device="cpu",
        )
        reward = BasicShapedRewardNet(
            venv.observation_space, venv.action_space, normalize_input_layer=RunningNorm
        )
        size = ask["n_envs"] * ask["n_steps"]
        trainer = AIRL(
            demonstrations=demonstrations,
            demo_batch_size=ask["batch"],
            gen_replay_buffer_capacity=size,
            n_disc_updates_per_round=ask["updates"],
            venv=venv,
            gen_algo=learner,
            reward_net=reward,
            allow_variable_horizon=True,
            custom_logger=configure(None, []),
        )
        began = time.perf_counter()
        trainer.train(size * ask["rounds"])
        seconds = time.perf_counter() - began
        mean, _ = evaluate_policy(learner, DummyVecEnv([made]), n_eval_episodes=10)
        print(json.dumps({"seconds": seconds, "return": float(mean)}), flush=True)


if __name__ == "__main__":
    main()
