"""The kitchen (kitchen.py) as an environment with two players, drawn by objects (picture.py).

The partners of partners.py are named here, since `agent:Cook` in config.yml is a class of this file.
"""

import copy

from kitchen import PLAYERS, Kitchen
from partners import Cook, Fickle, Helper, Onions, Plates, Slow, Stubborn  # noqa: F401 - config.yml names them
from picture import STEPS_PER_SECOND, draw


class Agent:
    possible_agents = PLAYERS

    def start(self, game):
        self.reset()

    def reset(self, seed=None, options=None):
        """Begin a round. `options` are those of config.yml."""
        seconds = (options or {}).get("seconds", 60)
        self.seed, self.kitchen = seed, Kitchen(round(seconds * STEPS_PER_SECOND))
        return self._observations(), {player: {} for player in PLAYERS}

    def step(self, actions):
        soups = self.kitchen.step(actions)
        over = self.kitchen.left == 0
        every = dict.fromkeys
        return self._observations(), every(PLAYERS, float(soups)), every(PLAYERS, False), every(PLAYERS, over), {}

    def render(self):
        return draw(self.kitchen)

    def close(self):
        pass

    def _observations(self):
        """What each player sees: copies, since partners think beside the game."""
        chefs = copy.deepcopy(self.kitchen.chefs)
        shared = {"pots": copy.deepcopy(self.kitchen.pots), "lying": dict(self.kitchen.lying)}
        shared |= {"left": self.kitchen.left, "seed": self.seed}
        you, partner = PLAYERS
        return {
            you: {"me": chefs[you], "other": chefs[partner], **shared},
            partner: {"me": chefs[partner], "other": chefs[you], **shared},
        }
