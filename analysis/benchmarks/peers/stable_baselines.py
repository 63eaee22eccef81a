"""PPO by Stable-Baselines3, trained as asked for.

It runs under the interpreter that has ``stable_baselines3``, independent of this package: one request a line
on standard input (JSON), one JSON line of returns and timings on standard output.
"""

import json
import sys
import time
from importlib.metadata import version

import numpy as np


def main() -> None:
    """Answer requests until standard input ends."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    names = ("stable_baselines3", "torch", "gymnasium", "mujoco")
    print(json.dumps({name: version(name) for name in names}), flush=True)
    for request in map(json.loads, sys.stdin):
        chosen, seed = request["settings"], request["seed"]
        tasks = make_vec_env(request["peer_task"], n_envs=chosen["n_envs"], seed=seed)
        environments = VecNormalize(
            tasks,
            norm_obs=chosen["scale_observations"],
            norm_reward=chosen["scale_rewards"],
            gamma=chosen["gamma"],
        )
        agent = PPO(
            "MlpPolicy",
            environments,
            n_steps=chosen["n_steps"],
            batch_size=chosen["minibatch"],
            n_epochs=chosen["epochs"],
            gamma=chosen["gamma"],
            gae_lambda=chosen["gae_lambda"],
            clip_range=chosen["clip"],
            learning_rate=chosen["learning_rate"],
            ent_coef=chosen["entropy"],
            vf_coef=chosen["value_coefficient"],
            max_grad_norm=chosen["max_grad_norm"],
            policy_kwargs={
                "net_arch": {"pi": chosen["hidden"], "vf": chosen["hidden"]},
                "activation_fn": torch.nn.Tanh,
                "log_std_init": chosen["log_deviation"],
            },
            seed=seed,
            device="cpu",
        )
        began, processor_began = time.perf_counter(), time.process_time()
        agent.learn(request["steps"])
        seconds, processor_seconds = time.perf_counter() - began, time.process_time() - processor_began
        training = np.concatenate(tasks.env_method("get_episode_rewards"))
        latest = [episode["r"] for episode in agent.ep_info_buffer]  # a hundred
        environments.training = environments.norm_reward = False
        returns, _ = evaluate_policy(
            agent, environments, request["episodes"], deterministic=True, return_episode_rewards=True
        )
        answer = {
            "return": float(np.mean(returns)),
            "training_return": float(np.mean(training)),
            "latest_return": float(np.mean(latest)),
            "steps": agent.num_timesteps,
            "seconds": seconds,
            "processor_seconds": processor_seconds,
        }
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
