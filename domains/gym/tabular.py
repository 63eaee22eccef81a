"""A finite decision process as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from jaxtyping import UInt8

from ...models.inputs.text import listed, shortened
from ...models.process.mdp import TabularMDP

if TYPE_CHECKING:
    from .canvas import Scene


class TabularEnv(gymnasium.Env[int, int]):
    """Finite decision process and a reward as a Gymnasium environment.

    Observations are states, actions the process's actions. ``info["action_mask"]`` (int8, ``[A]``) says at
    every reset and step which actions the state offers; ``env.action_space.sample(info["action_mask"])``
    draws among them. An action that is not offered leaves the state, earns zero and sets
    ``info["available"]`` to False; with ``strict`` it raises a ``ValueError`` that names state and action.
    The reward of a step is ``weights . phi(s, a)``, an expectation if features depend on the outcome.

    Episodes never terminate. ``reset(options={"state": ...})`` begins in a state given by number or name,
    otherwise the first state is drawn from the process's initial distribution.

    Parameters
    ----------
    mdp : TabularMDP
    weights : ``[K]`` numbers
    render_mode : "rgb_array", "ansi" or None
    strict : bool
    scene : function of no arguments or None
        Makes the first picture for ``rgb_array``; None draws the state's name.

    Raises
    ------
    ValueError
        For weights that are not one finite number a feature, and for another ``render_mode``.
    """

    metadata = {"render_modes": ["rgb_array", "ansi"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's name)

    def __init__(
        self,
        mdp: TabularMDP,
        weights: Sequence[float] | np.ndarray,
        *,
        render_mode: str | None = None,
        strict: bool = False,
        scene: Callable[[], Scene] | None = None,
    ):
        theta = np.asarray(weights, float)
        if theta.shape != (mdp.n_features,) or not np.isfinite(theta).all():
            raise ValueError(
                f"weights must be {mdp.n_features} finite numbers, one a feature "
                f"({', '.join(mdp.feature_names[:12])}{', ...' * (mdp.n_features > 12)}), got {weights}"
            )
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode must be one of {', '.join(self.metadata['render_modes'])} or None, "
                f"got {render_mode!r}"
            )
        self.mdp, self.weights, self.strict, self.render_mode = mdp, theta, strict, render_mode
        self.observation_space: Discrete = Discrete(mdp.n_states)  # type: ignore[assignment]
        self.action_space: Discrete = Discrete(mdp.n_actions)  # type: ignore[assignment]
        # NumPy's copies: single look-ups cost JAX a hundred times more.
        self._successors = np.asarray(mdp.successors)
        self._cumulative = np.cumsum(np.asarray(mdp.probabilities), axis=-1)
        self._initial = np.cumsum(np.asarray(mdp.initial))
        self._reward = np.asarray(mdp.features) @ theta
        self._mask = np.asarray(mdp.available).astype(np.int8)
        self._make_scene = scene
        self._scene: Scene | None = None
        self._state: int | None = None
        self._last: tuple[int, float] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Begin an episode; ``options`` may give the ``state`` to begin in, by number or name.

        Raises ``ValueError`` for another option or a state that does not exist.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        state = given.pop("state", None)
        if given:
            raise ValueError(f"reset takes only the option 'state', got {', '.join(map(repr, given))}")
        if state is None:
            self._state = drawn(self._initial, self.np_random.random())
        else:
            self._state = self._state_given(state)
        self._last = None
        return self._state, {"action_mask": self._mask[self._state].copy()}

    def _state_given(self, state: int | str) -> int:
        if isinstance(state, str):
            if state not in self.mdp.state_names:
                first = shortened(self.mdp.state_names[0])
                raise ValueError(f"there is no state named {shortened(state)}; one is {first}")
            return self.mdp.state_names.index(state)
        if not isinstance(state, int | np.integer) or not 0 <= state < self.mdp.n_states:
            raise ValueError(f"states are 0 to {self.mdp.n_states - 1} or a name, got {shortened(state)}")
        return int(state)

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Apply an action; return the state, its reward, False, False, and ``action_mask`` and ``available``.

        Raises ``ValueError`` for an action that does not exist, and if ``strict`` for one that the state does
        not offer; ``gymnasium.error.ResetNeeded`` before the first reset.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset the environment before the first step")
        if not self.action_space.contains(action):
            raise ValueError(f"actions are 0 to {self.mdp.n_actions - 1}, got {shortened(action)}")
        state, action = self._state, int(action)
        offered = bool(self._mask[state, action])
        if not offered and self.strict:
            names = [self.mdp.action_names[a] for a in np.flatnonzero(self._mask[state])]
            raise ValueError(
                f"state {shortened(self.mdp.state_names[state])} ({state}) does not offer "
                f"{shortened(self.mdp.action_names[action])} ({action}); it offers {listed(names, 12)}"
            )
        if offered:
            branch = drawn(self._cumulative[state, action], self.np_random.random())
            self._state = int(self._successors[state, action, branch])
        reward = float(self._reward[state, action]) if offered else 0.0
        self._last = action, reward
        info = {"action_mask": self._mask[self._state].copy(), "available": offered}
        return self._state, reward, False, False, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | str | None:
        """Return a picture (``rgb_array``), the caption alone (``ansi``), or None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render was called without a render_mode; make the environment with one")
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset the environment before rendering it")
        from .canvas import Frame, caption, text_scene

        shown = Frame(self._state, *(self._last or ()))
        if self.render_mode == "ansi":
            return caption(self.mdp, shown)
        if self._scene is None:
            self._scene = self._make_scene() if self._make_scene else text_scene(self.mdp)
        return self._scene.frame(shown)


def drawn(cumulative: np.ndarray, uniform: float) -> int:
    """Draw an index by its cumulative probabilities, never one of probability zero."""
    return int(np.searchsorted(cumulative, uniform * cumulative[-1], side="right"))
