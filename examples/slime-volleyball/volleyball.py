"""The environment of the package `slimevb` as a ParallelEnv of PettingZoo."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from slime_volleyball.core import constants
from slime_volleyball.slimevolley_env import SlimeVolleyEnv

LEFT, RIGHT = PLAYERS = ("agent_left", "agent_right")
ACTIONS = ("noop", "left", "leftup", "up", "rightup", "right")
"""In the package's order. `left` is to the left on the screen, for both players."""

MIRRORED = (0, 5, 4, 3, 2, 1)
"""For each action, the number of the same action for the player of the other half."""

STEPS_PER_SECOND = round(1 / constants.TIMESTEP)


class Volleyball(ParallelEnv):
    """Two slimes and a ball. A player scores when the ball falls on the ground of the other half.

    Observations are 12 numbers from the player's own side: x is the distance from the net, positive on the player's
    own half. They are own x, y and speeds, then the ball's, then the opponent's, all divided by 10. A point is a
    reward of 1 for one player and of -1 for the other.
    """

    metadata = {"name": "slime_volleyball", "render_modes": []}  # noqa: RUF012 - PettingZoo's own form

    def __init__(self, points: int = 5, seconds: float = 100) -> None:
        """An episode ends when a player has `points`, or after `seconds`, which are steps at 30 a second."""
        self.possible_agents = list(PLAYERS)
        self.agents: list[str] = []
        self._observation_space = spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self._action_spaces = {player: spaces.Discrete(len(ACTIONS)) for player in PLAYERS}
        self.max_steps = round(seconds * STEPS_PER_SECOND)
        self.scores = dict.fromkeys(PLAYERS, 0)
        # The package mirrors actions of the left player with `human_inputs`: left is then left on the screen.
        self._game = SlimeVolleyEnv({"max_steps": self.max_steps, "human_inputs": True})
        self._game.max_lives = points

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        observations, _ = self._game.reset(seed=seed)
        self.agents = list(PLAYERS)
        self.scores = dict.fromkeys(PLAYERS, 0)
        return _flat(observations), {player: {} for player in PLAYERS}

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        observations, rewards, terminations, truncations, _ = self._game.step(
            {player: int(actions[player]) for player in PLAYERS}
        )
        for player in PLAYERS:
            self.scores[player] += rewards[player] > 0
        over = any(terminations.values()) or any(truncations.values())
        self.agents = [] if over else list(PLAYERS)
        return (
            _flat(observations),
            rewards,
            {player: terminations[player] for player in PLAYERS},
            {player: truncations[player] for player in PLAYERS},
            {player: {} for player in PLAYERS},
        )

    def places(self) -> dict[str, tuple[float, float]]:
        """Return where the players and the `ball` are: x from the net, y from the bottom, in the package's units."""
        state = self._game._env_state
        return {
            LEFT: _place(state.agent_pos[0]),
            RIGHT: _place(state.agent_pos[1]),
            "ball": _place(state.ball_pos),
        }

    def begins(self) -> bool:
        """Whether no step of the episode has been taken."""
        return self._game.t == 0

    def seconds_left(self) -> float:
        return (self.max_steps - self._game.t) / STEPS_PER_SECOND

    def serve(self) -> bool:
        """Whether the ball hangs still before a point begins."""
        return bool(self._game._env_state.delay_life > 0)


def _flat(observations: dict[str, Any]) -> dict[str, Any]:
    return {player: observations[player]["obs"].astype(np.float32) for player in PLAYERS}


def _place(position: Any) -> tuple[float, float]:
    return float(position[0]), float(position[1])
