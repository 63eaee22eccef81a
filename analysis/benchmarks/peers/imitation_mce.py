"""Tabular MCE IRL by the ``imitation`` library, on problems handed over as files.

It runs under the interpreter that has ``imitation``, independent of this package: one request a line on
standard input, ``problem.npz result.npz``, one JSON line of timings on standard output. The result holds the
policy ``[T, S, A]`` that ``MCEIRL`` returns.
"""

import json
import sys
import time
from importlib.metadata import version

import numpy as np


def main() -> None:
    """Answer requests until standard input ends."""
    import torch
    from gymnasium import spaces
    from imitation.algorithms import mce_irl
    from imitation.rewards import reward_nets
    from seals.base_envs import TabularModelPOMDP

    torch.set_num_threads(1)
    print(json.dumps({"imitation": version("imitation"), "torch": version("torch")}), flush=True)
    for request in sys.stdin:
        source, destination = request.split()
        problem = np.load(source)
        n_states, n_actions, width = problem["successors"].shape
        transitions = np.zeros((n_states, n_actions, n_states))
        s, a, _ = np.indices((n_states, n_actions, width))
        np.add.at(transitions, (s, a, problem["successors"]), problem["probabilities"])
        env = TabularModelPOMDP(
            transition_matrix=transitions,
            observation_matrix=np.eye(n_states, dtype=np.float32),
            reward_matrix=np.zeros(n_states),
            horizon=int(problem["horizon"]),
            initial_state_dist=problem["initial"],
        )
        torch.manual_seed(int(problem["seed"]))
        # No hidden layer: a linear reward, one weight a state (and a constant without effect).
        reward = reward_nets.BasicRewardNet(
            env.observation_space,
            spaces.Discrete(n_actions),
            use_action=False,
            use_next_state=False,
            use_done=False,
            hid_sizes=[],
        )
        steps = 0

        class CountedAdam(torch.optim.Adam):
            def step(self, closure=None):  # type: ignore[no-untyped-def]
                nonlocal steps
                steps += 1
                return super().step(closure)

        learner = mce_irl.MCEIRL(
            problem["visits_and_last"],
            env,
            reward,
            optimizer_cls=CountedAdam,
            optimizer_kwargs={"lr": float(problem["adam_rate"])},
            linf_eps=float(problem["tolerance"]),
            log_interval=None,
            rng=np.random.default_rng(0),
        )
        started, processor_started = time.perf_counter(), time.process_time()
        learner.train(max_iter=10_000)
        timing = {
            "seconds": time.perf_counter() - started,
            "processor_seconds": time.process_time() - processor_started,
            "evaluations": steps,
        }
        np.savez(destination, policy=learner.policy.pi)
        print(json.dumps(timing), flush=True)


if __name__ == "__main__":
    main()
