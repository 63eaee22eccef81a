"""Experts of the continuous tasks, trained by the package's own PPO, and their recordings.

``make experts`` trains them all and writes ``recordings/``: for each task the policy's arrays, episodes, and
the facts of both. The expert acts in them by the mode of its policy, without the noise it explored with, and
each episode begins at a state of its own draw. The robots' episodes have full length whether or not the robot
falls, for returns are compared "at fixed length" (section 7.4.3); the true rewards are stored beside the
observations and actions.

Needs the extra ``adversarial``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...inference.adversarial.policy_optimisation import PPO, Training, ppo
from ...inference.adversarial.rollouts import Task, play
from ...models.inputs.archives import StorageError, read_arrays
from ...models.inputs.display import shown_briefly
from ...models.inputs.text import parsed_json, shortened
from ...models.networks.modules import Policy, policy_network
from ...models.observation.recordings import Recording, recording
from .control import mountain_car
from .walkers import ROBOTS, locomotion

EXPERTS = (*ROBOTS, "mountain-car")
FOLDER = Path(str(files(__package__))) / "recordings"

_EPISODES = {"observations": "f", "actions": "fiu", "rewards": "f", "lengths": "iu", "terminated": "b"}

TARGETS = {"hopper": 2810.0, "walker2d": 2700.0, "half-cheetah": 2507.0, "mountain-car": -110.0}
"""Returns to reach: the dissertation's experts' (Table 7.3), and Gymnasium's for a solved mountain car."""


class Recipe(NamedTuple):
    """Training settings of an expert.

    Fields
    ------
    steps : int, of the environment
    seed : int, of the key
    episodes : int, recorded
    horizon : int, steps of an episode while learning
    settings : of :class:`i2rl.inference.adversarial.policy_optimisation.Settings`
    """

    steps: int
    seed: int
    episodes: int
    horizon: int
    settings: Mapping[str, Any]


_ROBOT = {"hidden": (64, 64), "log_deviation": -0.5, "scale_rewards": True}
# With HalfCheetah's settings Hopper still fell in some episodes after a million steps.
_LEGGED = {"n_envs": 32, "n_steps": 128, "minibatch": 128, "gamma": 0.995, "gae_lambda": 0.97, **_ROBOT}
RECIPES = {
    "hopper": Recipe(1_500_000, 1, 10, 1000, _LEGGED),
    "walker2d": Recipe(2_000_000, 1, 10, 1000, _LEGGED),
    "half-cheetah": Recipe(1_000_000, 1, 10, 1000, {"n_envs": 32, "n_steps": 64, "minibatch": 64, **_ROBOT}),
    "mountain-car": Recipe(
        1_000_000, 1, 40, 1000, {"n_envs": 16, "n_steps": 128, "minibatch": 256, "scale_rewards": True}
    ),
}


@shown_briefly
class Demonstrations(NamedTuple):
    """Episodes of an expert, zero from their end to the common length ``L``.

    Fields
    ------
    observations : float32 ``[n, L, d]``
    actions : float32 ``[n, L, k]`` or int32 ``[n, L]``, as executed (within the bounds)
    rewards : float32 ``[n, L]``, the task's own
    lengths : int32 ``[n]``
    terminated : bool ``[n]``, whether the task ended with the last step; otherwise the time ran out
    """

    observations: Float[np.ndarray, "n L d"]
    actions: np.ndarray
    rewards: Float[np.ndarray, "n L"]
    lengths: Int[np.ndarray, " n"]
    terminated: Bool[np.ndarray, " n"]

    @property
    def returns(self) -> Float[np.ndarray, " n"]:
        """Sum of the rewards of each episode, not discounted."""
        return self.rewards.sum(1, dtype=np.float64)

    @property
    def recording(self) -> Recording:
        """Recording that learners take."""
        return recording(
            [o[:end] for o, end in zip(self.observations, self.lengths, strict=True)],
            [a[:end] for a, end in zip(self.actions, self.lengths, strict=True)],
            terminated=list(self.terminated),
        )


def expert_task(name: str) -> Task:
    """Make the task on which an expert is recorded: mountain car, or a robot at fixed length.

    Raises ``ValueError`` for a name that is not in :data:`EXPERTS`.
    """
    _known(name)
    return mountain_car() if name == "mountain-car" else locomotion(name, terminate_when_unhealthy=False)


def expert_agent(name: str, steps: int) -> PPO:
    """Make the agent that learns to be the expert ``name``; its learning rate falls to zero over ``steps``.

    A robot's episodes end when it falls, and mountain car's are longer than when recorded, or it would find
    the flag too rarely. Raises as :func:`expert_task`.
    """
    recipe = RECIPES[_known(name)]
    robot = name in ROBOTS
    learned = locomotion(name) if robot else mountain_car(recipe.horizon)
    return ppo(learned, decay_over=steps, **recipe.settings)


def train_expert(
    name: str, key: Array, steps: int, on_part: Callable[[Training], None] | None = None
) -> tuple[Policy, Training]:
    """Train a policy for ``steps`` steps by the true reward; return it and the course of the training.

    ``on_part`` is called with each part of the training, every 50 rollouts. Raises as :func:`expert_task`.
    """
    agent = expert_agent(name, steps)
    state, parts, done = agent.init(key), list[Training](), 0
    while done < steps:
        state, part = agent.train(state, min(50 * agent.settings.steps, steps - done))
        parts.append(part)
        done = int(part.steps[-1])
        if on_part is not None:
            on_part(part)
    return state.policy, Training(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def demonstrate_expert(task: Task, policy: Policy, key: Array, n: int) -> Demonstrations:
    """Simulate ``n`` episodes of the policy's likeliest actions, without noise, as they are executed."""
    episodes = play(task, policy, key, n, deterministic=True)
    live = np.arange(episodes.actions.shape[1]) < np.asarray(episodes.lengths)[:, None]
    longest = int(max(episodes.lengths))
    actions = np.asarray(task.actions.clip(jnp.asarray(episodes.actions)))
    wide = live.reshape(*live.shape, *[1] * (actions.ndim - 2))
    return Demonstrations(
        np.where(live[..., None], episodes.observations[:, :-1], 0)[:, :longest].astype(np.float32),
        np.where(wide, actions, 0)[:, :longest].astype(actions.dtype),
        episodes.rewards[:, :longest].astype(np.float32),
        np.asarray(episodes.lengths, np.int32),
        np.asarray(episodes.terminated, bool),
    )


def load_demonstrations(name: str) -> Demonstrations:
    """Load the stored episodes of an expert.

    Raises ``ValueError`` for a name that is not in :data:`EXPERTS`, and :class:`StorageError` (a
    ``ValueError``) naming a file that holds something else.

    See Also
    --------
    i2rl.domains.load_expert : the expert who was recorded
    i2rl.inference.airl : learn from the recording

    Examples
    --------
    >>> from i2rl.domains import load_demonstrations
    >>> episodes = load_demonstrations("mountain-car")
    >>> episodes.observations.shape[0], episodes.observations.shape[2]
    (40, 2)
    >>> bool(episodes.terminated.all()), round(float(episodes.returns.mean()), -1)
    (True, -110.0)
    """
    path = FOLDER / f"{_known(name)}-demonstrations.npz"
    arrays = read_arrays(path, _EPISODES, required=tuple(_EPISODES), what="archive of demonstrations")
    episodes = Demonstrations(**arrays)
    rows = episodes.rewards.shape
    for field, array, ranks in zip(_EPISODES, episodes, ((3,), (2, 3), (2,), (1,), (1,)), strict=True):
        if array.ndim not in ranks or array.shape[:2] != rows[: array.ndim]:
            raise StorageError(
                f"{path}: the array {field!r} of shape {array.shape} does not fit rewards [n, L] of {rows}"
            )
    if not ((episodes.lengths >= 0) & (episodes.lengths <= rows[1])).all():
        raise StorageError(f"{path}: the array 'lengths' must lie between 0 and {rows[1]}")
    return episodes


def load_expert(name: str) -> Policy:
    """Load the stored policy of an expert. Raises as :func:`load_demonstrations`.

    See Also
    --------
    i2rl.domains.load_demonstrations : what it was recorded doing
    i2rl.domains.mountain_car : its task

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> from i2rl.domains import load_expert
    >>> expert = load_expert("mountain-car")
    >>> rolling_left, rolling_right = [-0.6, -0.03], [-0.5, 0.03]
    >>> expert.mode(jnp.array([rolling_left, rolling_right])).tolist()
    [0, 2]
    """
    task, facts = expert_task(name), load_facts(name)
    template = jax.eval_shape(
        lambda key: policy_network(key, task.observation_size, task.actions, facts["settings"]["hidden"]),
        jax.random.key(0),
    )
    paths, structure = jax.tree_util.tree_flatten_with_path(template)
    path, names = FOLDER / f"{name}-policy.npz", [_name(at) for at, _ in paths]
    arrays = read_arrays(path, dict.fromkeys(names, "f"), required=names, what="archive of a policy")
    for leaf, (_, like) in zip(names, paths, strict=True):
        if arrays[leaf].shape != like.shape:
            raise StorageError(
                f"{path}: the array {leaf!r} must have shape {like.shape}; got {arrays[leaf].shape}"
            )
    return jax.tree_util.tree_unflatten(structure, [jnp.asarray(arrays[leaf]) for leaf in names])


def load_facts(name: str) -> dict[str, Any]:
    """Load how an expert was trained, and the returns of its stored episodes.

    Raises as :func:`load_demonstrations`.
    """
    path = FOLDER / f"{_known(name)}.json"
    try:
        facts = parsed_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise StorageError(f"{path}: {error}") from None
    if not isinstance(facts, dict) or not isinstance(facts.get("settings"), dict):
        raise StorageError(f"{path}: the facts of an expert must have settings; got {shortened(facts)}")
    return facts


def store_expert(
    name: str, policy: Policy, demonstrations: Demonstrations, facts: Mapping[str, Any], folder: Path = FOLDER
) -> None:
    """Write an expert as :func:`load_expert`, :func:`load_demonstrations` and :func:`load_facts` read it."""
    folder.mkdir(parents=True, exist_ok=True)
    leaves: dict[str, Any] = {
        _name(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(policy)
    }
    np.savez_compressed(folder / f"{name}-policy.npz", **leaves)
    np.savez_compressed(folder / f"{name}-demonstrations.npz", **demonstrations._asdict())
    (folder / f"{name}.json").write_text(json.dumps(facts, indent=2) + "\n")


def make_expert(name: str) -> None:
    """Train, record and store one expert by its :class:`Recipe`, telling how it goes."""
    recipe, began = RECIPES[_known(name)], time.perf_counter()

    def on_part(part: Training) -> None:
        ended = part.returns[np.isfinite(part.returns)]
        shown = f"{ended.mean():.0f}" if len(ended) else "none ended"
        print(f"{name}: {part.steps[-1]} steps, return {shown}", flush=True)

    k_train, k_record = jax.random.split(jax.random.key(recipe.seed))
    policy, training = train_expert(name, k_train, recipe.steps, on_part)
    demonstrations = demonstrate_expert(expert_task(name), policy, k_record, recipe.episodes)
    returns = demonstrations.returns
    settings = expert_agent(name, recipe.steps).settings._asdict()
    settings["reward_memory"] = str(settings["reward_memory"])  # JSON has no infinity
    facts = {
        "task": name,
        "seed": recipe.seed,
        "steps": int(training.steps[-1]),
        "seconds": round(time.perf_counter() - began),
        "episode_steps_while_learning": recipe.horizon,
        "settings": settings,
        "acting": "the mode of the policy, cut to the bounds of the actions",
        "returns": [round(float(r), 2) for r in returns],
        "mean_return": round(float(returns.mean()), 2),
    }
    store_expert(name, policy, demonstrations, facts)
    print(f"{name}: mean return {returns.mean():.0f} of {len(returns)} episodes, wanted {TARGETS[name]:.0f}")


def main(names: Sequence[str]) -> None:
    """Make these experts, or all."""
    for name in [_known(name) for name in names] or EXPERTS:
        make_expert(name)


def _known(name: str) -> str:
    if name not in EXPERTS:
        raise ValueError(f"there are experts of {', '.join(EXPERTS)}; got {name!r}")
    return name


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


if __name__ == "__main__":
    main(sys.argv[1:])
