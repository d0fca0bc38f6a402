"""The environment Overcooked of the package `cogrid` as a ParallelEnv of PettingZoo, and the state of its kitchen."""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

# If these are installed, cogrid imports them to draw pictures of its own. They are hidden, since agent.py draws here.
HIDDEN = [name for name in ("cv2", "pygame") if name not in sys.modules]
sys.modules.update(dict.fromkeys(HIDDEN))
from cogrid.cogrid_env import CoGridEnv  # noqa: E402
from cogrid.envs import cramped_room_config  # noqa: E402
from cogrid.envs.overcooked.agent import OvercookedAgent  # noqa: E402

for _name in HIDDEN:
    del sys.modules[_name]

Cell = tuple[int, int]
"""The row and the column, from the upper left corner."""

ACTIONS = ("up", "down", "left", "right", "pickup", "noop")
UP, DOWN, LEFT, RIGHT, PICKUP, NOOP = range(len(ACTIONS))
COGRID_ACTIONS = (0, 1, 2, 3, 4, 6)
"""The package's number of each of ACTIONS. Its action 5, `toggle`, does nothing in these kitchens."""

STEPS = {UP: (-1, 0), DOWN: (1, 0), LEFT: (0, -1), RIGHT: (0, 1)}
FACING = (RIGHT, DOWN, LEFT, UP)
"""For each direction, by the package's number, the action that turns a chef there."""

CRAMPED = "overcooked_cramped_room_v0"
SOUP_REWARD = 20.0
POT_HOLDS = 3

FEATURES = [
    "agent_dir",
    "agent_position",
    "can_move_direction",
    "closest_objects",
    "dist_to_other_players",
    "next_to_pot",
    "ordered_pot_features",
    "overcooked_inventory",
]
"""The parts of the package's observations that a chef gets: 202 numbers. By default it gets 892, most of them 0."""


@dataclass
class Chef:
    """One player's chef. `holds` is onion, plate, onion_soup, or nothing."""

    cell: Cell
    facing: int
    holds: str | None

    @property
    def ahead(self) -> Cell:
        down, right = STEPS[self.facing]
        return self.cell[0] + down, self.cell[1] + right


@dataclass
class Kitchen:
    """The state of the kitchen."""

    size: Cell
    chefs: list[Chef]
    fixed: dict[Cell, str] = field(default_factory=dict)
    """counter, onion_stack, plate_stack, pot, delivery_zone"""
    lying: dict[Cell, str] = field(default_factory=dict)
    """Things on counters, and on the floor."""
    pots: dict[Cell, tuple[int, int]] = field(default_factory=dict)
    """By the pot's cell: the number of onions in it, and the number of steps for which a full pot still cooks."""


class Overcooked(ParallelEnv):
    """Two chefs, 0 and 1, cook onion soup: they put three onions into the pot, wait, and deliver the soup on a plate.

    Both get the same rewards: 20 for a soup that is delivered, 3 for an onion in the pot, 5 for soup on a plate.
    """

    metadata = {"name": "overcooked", "render_modes": []}  # noqa: RUF012 - PettingZoo's own form

    def __init__(self, layout: str = CRAMPED, max_steps: int = 600) -> None:
        config = copy.deepcopy(cramped_room_config)
        config["grid"]["layout"], config["max_steps"], config["features"] = layout, max_steps, list(FEATURES)
        self._game = CoGridEnv(config, agent_class=OvercookedAgent)
        self._names = {number: name for name, number in self._game._type_ids.items()}
        self.possible_agents = list(self._game.possible_agents)
        self.agents: list[int] = []
        self.max_steps = max_steps
        self.soups = 0
        observations, _ = self._game.reset(seed=0)
        self._observation_space = spaces.Box(-np.inf, np.inf, observations[0].shape, np.float32)
        self._action_spaces = {agent: spaces.Discrete(len(ACTIONS)) for agent in self.possible_agents}

    def observation_space(self, agent: int) -> spaces.Space[Any]:
        return self._observation_space

    def action_space(self, agent: int) -> spaces.Space[Any]:
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[int, Any], dict[int, Any]]:
        self.soups = 0
        self.agents = list(self.possible_agents)
        # Without a seed the package would always take 42.
        seed = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        return self._game.reset(seed=seed)

    def step(self, actions: dict[int, int]) -> tuple[dict[int, Any], ...]:
        given = {agent: COGRID_ACTIONS[int(actions[agent])] for agent in self.possible_agents}
        observations, rewards, terminations, truncations, infos = self._game.step(given)
        self.soups += rewards[0] >= SOUP_REWARD
        self.agents = list(self._game.agents)
        return observations, rewards, terminations, truncations, infos

    @property
    def steps_left(self) -> int:
        return self.max_steps - self._game.t

    def kitchen(self) -> Kitchen:
        """Return the present state of the kitchen."""
        state = self._game._env_state
        chefs = [
            Chef(_cell(cell), FACING[int(facing)], self._names.get(int(held[0])))
            for cell, facing, held in zip(state.agent_pos, state.agent_dir, state.agent_inv, strict=True)
        ]
        found = Kitchen(state.object_type_map.shape, chefs)
        for row, column in np.argwhere(state.object_type_map > 0):
            cell, name = (int(row), int(column)), self._names[int(state.object_type_map[row, column])]
            if name in _FIXED:
                found.fixed[cell] = name
                on_it = int(state.object_state_map[row, column])
                if name == "counter" and on_it:
                    found.lying[cell] = self._names[on_it]
            elif name in _THINGS:
                found.lying[cell] = name
        for cell, inside, timer in zip(
            state.extra_state["overcooked.pot_positions"],
            state.extra_state["overcooked.pot_contents"],
            state.extra_state["overcooked.pot_timer"],
            strict=True,
        ):
            found.pots[_cell(cell)] = int((inside > 0).sum()), int(timer)
        return found


_FIXED = frozenset({"counter", "wall", "onion_stack", "plate_stack", "pot", "delivery_zone"})
_THINGS = frozenset({"onion", "plate", "onion_soup"})


def _cell(position: Any) -> Cell:
    return int(position[0]), int(position[1])
