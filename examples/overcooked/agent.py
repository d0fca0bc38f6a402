"""Overcooked: the environment, and how it is drawn. Who cooks with whom stands in config.yml (`players`)."""

import json
import math
import os

from kitchen import CRAMPED, DOWN, LEFT, POT_HOLDS, RIGHT, UP, Overcooked

TILE = 96
"""Pixels of one tile; the kitchen has 5 x 4 tiles, and the scene in config.yml 480 x 384 pixels."""

LARGER = {"width": TILE + 1, "height": TILE + 1}
"""The size of a picture that fills its tile: neighbours overlap, so that no line is seen between them."""

STEPS_PER_SECOND = 10
"""The same as `startingFrameRate` in config.yml: the clock beside the score counts steps."""

WALK = 110
"""The milliseconds in which a chef is seen to walk from one tile to the next."""

COOK_STEPS = 30
"""The steps for which a full pot cooks, as the package has it."""

COLOURS = ("blue", "green")
FACING = {UP: "up", DOWN: "down", LEFT: "left", RIGHT: "right"}
HANDS = {UP: (0.0, -0.16), DOWN: (0.0, 0.22), LEFT: (-0.3, 0.12), RIGHT: (0.3, 0.12)}
"""The place of the thing that a chef holds, by the direction in which they face: in tiles from the chef's middle."""


class Agent:
    def start(self, game):
        """Make the environment and return it. Its `reset`, `step` and `close` are called as PettingZoo has them."""
        trial = json.loads(os.environ.get("TRIAL", "{}"))
        options, plays = trial.get("options", {}), trial.get("players", {})
        self.two_people = list(plays.values()).count("human") == 2
        layout, seconds = options.get("layout", CRAMPED), options.get("seconds", 90)
        self.env = Overcooked(layout, max_steps=round(seconds * STEPS_PER_SECOND))
        return self.env

    def render(self, player):
        """Return the scene (docs/objects.md). Objects that never change are `permanent`: they are sent once an episode.

        If two people play, each reads which chef they are. With the policy, the instructions say it.
        """
        kitchen = self.env.kitchen()
        objects = _room(kitchen) if self.env.steps_left == self.env.max_steps else []
        for cell, (onions, timer) in kitchen.pots.items():
            objects += _pot(cell, onions, timer)
        objects += [_sprite(f"on {cell}", name, cell, depth=1) for cell, name in kitchen.lying.items()]
        for number, chef in enumerate(kitchen.chefs):
            objects += _chef(number, chef)
        seconds = math.ceil(self.env.steps_left / STEPS_PER_SECOND)
        you = f"You are {COLOURS[int(player)]} · " if self.two_people else ""
        return {"objects": objects, "hud": f"{you}Soups: {self.env.soups} · {seconds} s"}


def _sprite(name, frame, cell, **more):
    """Return a picture of the atlas, as large as its tile."""
    row, column = cell
    at = {"x": column * TILE, "y": row * TILE, "width": TILE, "height": TILE}
    return {"id": name, "type": "sprite", "image": "kitchen", "frame": frame, **at, **more}


def _room(kitchen):
    """Return floor and tables, which never change."""
    rows, columns = kitchen.size
    cells = [(row, column) for row in range(rows) for column in range(columns)]
    still = {**LARGER, "permanent": True}
    floor = [_sprite(f"floor {cell}", "floor", cell, depth=-2, **still) for cell in cells]
    return floor + [
        _sprite(f"table {cell}", "counter" if name == "wall" else name, cell, depth=-1, **still)
        for cell, name in kitchen.fixed.items()
        if name != "pot"
    ]


def _pot(cell, onions, timer):
    """Return the pot with its onions, and a bar that grows while it cooks."""
    ready = onions == POT_HOLDS and timer == 0
    found = [_sprite(f"pot {cell}", "pot-ready" if ready else f"pot-{onions}", cell, **LARGER)]
    if onions == POT_HOLDS and not ready:
        x, y, full = cell[1] * TILE + 12, cell[0] * TILE + TILE - 14, TILE - 24
        done = full * (COOK_STEPS - timer) / COOK_STEPS
        bar = {"type": "rectangle", "x": x, "y": y, "height": 8}
        found += [
            {"id": f"bar {cell}", **bar, "width": full, "color": "#2c2e34", "depth": 1},
            {"id": f"done {cell}", **bar, "width": done, "color": "#6fd08c", "depth": 2, "tween": WALK},
        ]
    return found


def _chef(number, chef):
    """Return the chef, and the thing that they hold. It is behind them while they face away."""
    found = [_sprite(f"chef {number}", f"chef-{COLOURS[number]}-{FACING[chef.facing]}", chef.cell, depth=4, tween=WALK)]
    if chef.holds:
        right, down = HANDS[chef.facing]
        size = 0.8 * TILE
        held = _sprite(f"held {number}", chef.holds, chef.cell, depth=3 if chef.facing == UP else 5, tween=WALK)
        held["x"] += right * TILE + (TILE - size) / 2
        held["y"] += down * TILE + (TILE - size) / 2
        found.append({**held, "width": size, "height": size})
    return found
