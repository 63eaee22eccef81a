"""AIRL beside the ``imitation`` library, in one run on the same cores: steps a second, and CartPole's return.

``python -m i2rl.analysis.benchmarks.peers.airl --peer-python PATH`` (``make bench-peers`` prepares the peer's
environment). Both sides learn from the same demonstrations with the same budget: Hopper with the
dissertation's settings (4 environments x 256 steps a round, 4 discriminator updates of 256 pairs, PPO with
minibatches of 64 and 10 epochs), and CartPole-v1 for 50,000 steps. Runs alternate, so that other load of the
machine affects both. Ours is timed from the second run on: the first compiles, and is given beside.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ....domains.robots.control import cart_pole
from ....domains.robots.walkers import locomotion
from ....inference.adversarial.discriminator import airl_discriminator
from ....inference.adversarial.learner import AdversarialTraining, adversarial
from ....inference.adversarial.policy_optimisation import PPO, ppo
from ....inference.adversarial.rollouts import Episodes
from ....models.observation.recordings import recording
from ..harness import print_table, publish


class Setting(NamedTuple):
    """One comparison: the peer's environment and everything both sides share."""

    env: str
    n_envs: int
    n_steps: int
    iterations: int
    updates: int
    batch: int

    @property
    def steps(self) -> int:
        """Environment steps in all."""
        return self.n_envs * self.n_steps * self.iterations


HOPPER = Setting("Hopper-v4", 4, 256, 20, 4, 256)
CART_POLE = Setting("CartPole-v1", 8, 128, 48, 16, 256)


class Peer:
    """The other library in a process of its own."""

    def __init__(self, python: str) -> None:
        script = Path(__file__).with_name("peer_airl.py")
        self._process = subprocess.Popen(
            [python, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.versions = self._answer()

    def run(self, setting: Setting, demonstrations: Path, seed: int) -> dict[str, float]:
        """Measure seconds and return of one run."""
        assert self._process.stdin is not None
        request = {**setting._asdict(), "demonstrations": str(demonstrations), "seed": seed}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the peer's process ended with status {self._process.wait()}")
        return json.loads(line)


def ours(agent: PPO, setting: Setting, episodes: Episodes, seed: int, **training: Any) -> dict[str, float]:
    """Measure seconds and return of one run of ours."""
    environment = agent.environment
    kept = [slice(0, n) for n in episodes.lengths]
    reports = recording(
        [o[s] for o, s in zip(episodes.observations, kept, strict=True)],
        [a[s] for a, s in zip(episodes.actions, kept, strict=True)],
    )
    learner = _learner(agent, setting, **training)
    state, report = learner.update(learner.init(jax.random.key(seed)), reports)
    judged = agent.evaluate(state.generator.policy, jax.random.key(1000 + seed), 10)
    assert report.environment_steps == setting.steps, environment.name
    return {"seconds": report.seconds, "return": float(judged.returns.mean())}


_LEARNERS: dict[Any, Any] = {}


def _learner(agent: PPO, setting: Setting, **training: Any) -> Any:
    # One learner a setting: another would be compiled again.
    if setting not in _LEARNERS:
        environment = agent.environment
        how = AdversarialTraining(
            iterations=setting.iterations, updates=setting.updates, batch=setting.batch, **training
        )
        discriminator = airl_discriminator(environment.observation_size, environment.actions)
        _LEARNERS[setting] = adversarial("AIRL", agent, discriminator, training=how)
    return _LEARNERS[setting]


def _stored(folder: Path, name: str, episodes: Episodes) -> Path:
    length = int(episodes.lengths.min())
    path = folder / f"{name}.npz"
    np.savez(path, observations=episodes.observations[:, : length + 1], actions=episodes.actions[:, :length])
    return path


def main() -> None:
    """Run both sides and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer-python", default=None, help="interpreter that has imitation")
    parser.add_argument("--replications", type=int, default=5)
    arguments = parser.parse_args()
    peer = Peer(arguments.peer_python) if arguments.peer_python else None
    results: dict[str, Any] = {"ours": sys.version.split()[0], "peer": peer.versions if peer else None}
    with tempfile.TemporaryDirectory() as folder:
        results["hopper"] = _compare(_hopper(), HOPPER, peer, Path(folder), arguments.replications)
        results["cart_pole"] = _compare(
            _cart_pole(), CART_POLE, peer, Path(folder), arguments.replications, learning_rate=3e-3
        )
    if peer:
        peer.close()
    rows = []
    for name, setting in (("hopper", HOPPER), ("cart_pole", CART_POLE)):
        for side, runs in results[name].items():
            times = [run["seconds"] for run in runs[1 if side == "ours" else 0 :]]
            returns = " ".join(f"{run['return']:.0f}" for run in runs)
            rows.append(
                (setting.env, side, float(np.median(times)), setting.steps / np.median(times), returns)
            )
    print_table(
        "AIRL: the same demonstrations, steps and settings",
        ["task", "side", "seconds (median)", "steps a second", "returns after learning"],
        rows,
    )
    publish("airl_peers", results)


def _compare(
    task: tuple[PPO, Episodes], setting: Setting, peer: Peer | None, folder: Path, seeds: int, **training: Any
) -> dict[str, list[dict[str, float]]]:
    agent, episodes = task
    path = _stored(folder, setting.env, episodes)
    runs: dict[str, list[dict[str, float]]] = {"ours": [ours(agent, setting, episodes, 0, **training)]}
    for seed in range(seeds):
        runs["ours"].append(ours(agent, setting, episodes, seed, **training))
        if peer:
            runs.setdefault("peer", []).append(peer.run(setting, path, seed))
    return runs


def _hopper() -> tuple[PPO, Episodes]:
    """Cost alone: the demonstrator moves at random, without falling being counted."""
    task = locomotion("hopper", terminate_when_unhealthy=False)
    agent = ppo(locomotion("hopper"), n_envs=HOPPER.n_envs, n_steps=HOPPER.n_steps)
    return agent, ppo(task).evaluate(agent.init(jax.random.key(0)).policy, jax.random.key(1), 2, False)


def _cart_pole() -> tuple[PPO, Episodes]:
    """Train the demonstrator: our PPO's policy after 60,000 steps by the true reward."""
    settings = {"n_envs": CART_POLE.n_envs, "n_steps": CART_POLE.n_steps, "learning_rate": 1e-3}
    agent = ppo(cart_pole(), scale_rewards=True, **settings)
    state, _ = agent.train(agent.init(jax.random.key(0)), 60_000)
    return agent, agent.evaluate(state.policy, jax.random.key(1), 8)


if __name__ == "__main__":
    main()
