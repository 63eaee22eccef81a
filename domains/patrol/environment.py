"""Breach past the patrollers as a Gymnasium environment: wait for a good moment, then leave undetected.

The process of :func:`i2rl.domains.patrol.trials` with the learner's moves left to the caller. Patrollers
follow their optimal policies and pass each other as :class:`Interaction` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete
from jaxtyping import Int, UInt8

from ..gym.tabular import drawn
from .breach import MOVES, BreachSettings, breach_task
from .process import FORWARD, HEADINGS, STOP, Interaction, Patrol, State
from .trials import CAUGHT, OUTCOMES, REACHED

if TYPE_CHECKING:
    from .breach_picture import BreachScene

ACTIONS = (*MOVES, "wait")
WAIT = ACTIONS.index("wait")


class BreachEnv(gymnasium.Env[np.ndarray, int]):
    """The learner's task against patrollers that walk.

    An observation is ``[1 + P]``: the learner's state, and each patroller's state; a patroller out of view
    has the number of patrol states. Actions are forward, left, right and wait. The learner stays hidden while
    it waits and may not wait any more once it has left: ``info["action_mask"]`` (int8, ``[4]``) says so;
    waiting then leaves the learner as it is while time passes.

    An episode terminates at a goal (``settings.reward``) or when a patroller sees the learner
    (``-settings.penalty``), also at the start as it leaves; ``info["ended"]`` then says which. With
    probability ``settings.failure`` one of the other two moves happens instead. Its discount is the caller's.

    Parameters
    ----------
    patrol : Patrol
        Instance 2 or 3.
    observability : int
        Percent of the patrollers' states in view, as in ``patrol.views``; at 100 it is a Markov process
        except in meetings of more than one step.
    interaction : Interaction
    settings : BreachSettings
        ``horizon`` and ``rounds`` are not used: Gymnasium's limit of steps ends an episode that takes long.
    render_mode : "rgb_array", "ansi" or None

    Raises
    ------
    ValueError
        For an instance without a breach, an observability it does not have, and another ``render_mode``.
    """

    metadata = {"render_modes": ["rgb_array", "ansi"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's name)

    def __init__(
        self,
        patrol: Patrol,
        *,
        observability: int = 100,
        interaction: Interaction = Interaction(),  # noqa: B008 (immutable)
        settings: BreachSettings = BreachSettings(),  # noqa: B008 (immutable)
        render_mode: str | None = None,
    ):
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode must be one of {', '.join(self.metadata['render_modes'])} or None, "
                f"got {render_mode!r}"
            )
        task = breach_task(patrol, settings.reach)
        assert patrol.breach is not None  # or there were no task
        self.patrol, self.interaction, self.settings, self.render_mode = (
            patrol,
            interaction,
            settings,
            render_mode,
        )
        self.states = tuple(State(r, c, h) for r, c in patrol.breach.cells for h in range(len(HEADINGS)))
        patrol.visibility(observability)  # refuses a view that is not there
        self._seen = patrol.views[observability]
        self._following, self._cell = np.asarray(task.following), np.asarray(task.cell)
        self._goal, self._start = np.asarray(task.goal), int(task.start)
        self.sees = np.asarray(task.sees) > 0
        mdp = patrol.mdp
        self._policy = np.argmax(patrol.expert_policy(), axis=1)
        self._successors = np.asarray(mdp.successors)
        self._cumulative = np.cumsum(np.asarray(mdp.probabilities), axis=-1)
        self._initial = np.cumsum(np.asarray(mdp.initial))
        self._cell_of_state = patrol.cell_of_state
        self.observation_space: MultiDiscrete = MultiDiscrete(
            [len(self.states), *[mdp.n_states + 1] * patrol.patrollers]
        )
        self.action_space: Discrete = Discrete(len(ACTIONS))  # type: ignore[assignment]
        self._patrollers: Int[np.ndarray, " P"] | None = None
        self._scene: BreachScene | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Int[np.ndarray, " 1+P"], dict[str, Any]]:
        """Begin hidden at the start, patrollers anywhere; ``options`` may give their states (``patrollers``).

        Raises ``ValueError`` for another option, and for states that are not one number a patroller.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        patrollers = given.pop("patrollers", None)
        if given:
            raise ValueError(f"reset takes only the option 'patrollers', got {', '.join(map(repr, given))}")
        self._patrollers = (
            np.array([drawn(self._initial, self.np_random.random()) for _ in range(self.patrol.patrollers)])
            if patrollers is None
            else self._states_given(patrollers)
        )
        self._before, self._counter = np.full(self.patrol.patrollers, -1), 0
        self._state, self._gone, self._ended = self._start, False, -1
        self._last: tuple[int, float] | None = None
        return self._observation(), self._info()

    def _states_given(self, patrollers: Sequence[int]) -> Int[np.ndarray, " P"]:
        states, most = np.asarray(patrollers), self.patrol.mdp.n_states
        if (
            states.shape != (self.patrol.patrollers,)
            or not np.issubdtype(states.dtype, np.integer)
            or not ((states >= 0) & (states < most)).all()
        ):
            raise ValueError(
                f"patrollers must be {self.patrol.patrollers} states of 0 to {most - 1}, got {patrollers!r}"
            )
        return states.copy()

    def step(self, action: int) -> tuple[Int[np.ndarray, " 1+P"], float, bool, bool, dict[str, Any]]:
        """Simulate one step of all: the observation, the reward, whether the episode is over, False, and
        ``action_mask``.

        Raises ``ValueError`` for an action that does not exist; ``gymnasium.error.ResetNeeded`` before the
        first reset and after the end.
        """
        if self._patrollers is None or self._ended >= 0:
            raise gymnasium.error.ResetNeeded("reset the environment first: no episode has begun")
        if not self.action_space.contains(action):
            raise ValueError(f"actions are 0 to {len(ACTIONS) - 1}, got {action!r}")
        # Who leaves may be seen at once, and has not moved then.
        if action != WAIT and not self._gone:
            self._gone = True
            self._judge()
        if self._ended < 0:
            if action != WAIT:
                slipped = self.np_random.random() < self.settings.failure
                move = (action + self.np_random.integers(1, 3)) % len(MOVES) if slipped else action
                self._state = int(self._following[self._state, move])
            self._patrol_on()
            if self._gone:
                self._judge()
        reward = {REACHED: self.settings.reward, CAUGHT: -self.settings.penalty}.get(self._ended, 0.0)
        self._last = int(action), float(reward)
        return self._observation(), float(reward), self._ended >= 0, False, self._info()

    def _judge(self) -> None:
        if self._goal[self._state]:
            self._ended = REACHED
        elif self.sees[self._cell[self._state], self._patrollers].any():
            self._ended = CAUGHT

    def _patrol_on(self) -> None:
        """Simulate one step of the patrollers, as :func:`i2rl.domains.simulate_patrol`."""
        states = self._patrollers
        assert states is not None
        here, before = self._cell_of_state[states], self._before
        if len(states) == 2:
            meet = here[0] == here[1] or before[0] == here[1] or before[1] == here[0]
            if self._counter <= 0 and meet:
                self._counter = self.interaction.length
        actions = self._policy[states]
        if self._counter > 1:
            actions = np.full(len(states), STOP)
        elif self._counter == 1:
            side = np.array(self.interaction.equilibrium)[: len(states)]
            actions = np.where(side == FORWARD, actions, side)
        branches = [
            drawn(self._cumulative[s, a], self.np_random.random())
            for s, a in zip(states, actions, strict=True)
        ]
        self._patrollers = self._successors[states, actions, branches]
        self._before, self._counter = here, self._counter - 1

    def _observation(self) -> Int[np.ndarray, " 1+P"]:
        states = self._patrollers
        assert states is not None
        seen = np.where(self._seen[states], states, self.patrol.mdp.n_states)
        return np.array([self._state, *seen], dtype=np.int64)

    def _info(self) -> dict[str, Any]:
        mask = np.ones(len(ACTIONS), np.int8)
        mask[WAIT] = not self._gone
        return {"action_mask": mask, "ended": OUTCOMES[self._ended] if self._ended >= 0 else ""}

    def render(self) -> UInt8[np.ndarray, "height width 3"] | str | None:
        """Return a picture (``rgb_array``), its caption alone (``ansi``), or None without a render mode.

        Everybody is shown, also who is out of the learner's view.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render was called without a render_mode; make the environment with one")
            return None
        if self._patrollers is None:
            raise gymnasium.error.ResetNeeded("reset the environment before rendering it")
        if self.render_mode == "ansi":
            return self.caption()
        if self._scene is None:
            from .breach_picture import BreachScene

            self._scene = BreachScene(self.patrol, self.states, self.sees)
        return self._scene.frame(self._state, self._patrollers, self._gone, self.caption())

    def caption(self) -> str:
        """Write the last action and its reward, and the learner's place or the trial's end."""
        last = "begins" if self._last is None else f"{ACTIONS[self._last[0]]}, reward {self._last[1]:.3g}"
        how = OUTCOMES[self._ended] if self._ended >= 0 else "on its way" if self._gone else "hidden"
        return f"{last}\n{self.states[self._state].name}: {how}"
