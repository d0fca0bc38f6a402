"""The forest (forest.py) as an environment with two players, drawn by objects (picture.py).

The partners of partners.py are named here, since `agent:Planner` in config.yml is a class of this file.
"""

from forest import PLAYERS, Forest
from partners import Nearest, Planner  # noqa: F401 - config.yml names them
from picture import draw


class Agent:
    possible_agents = PLAYERS

    def start(self, game):
        self.forest = Forest()

    def reset(self, seed=None):
        self.forest = Forest(seed)
        return self._observations(), self._infos()

    def to_act(self):
        return self.forest.turn

    def step(self, actions):
        points = self.forest.move(actions[self.forest.turn])
        rewards = dict.fromkeys(PLAYERS, points)
        terminations = dict.fromkeys(PLAYERS, not self.forest.acorns)
        truncations = dict.fromkeys(PLAYERS, self.forest.over and bool(self.forest.acorns))
        return self._observations(), rewards, terminations, truncations, self._infos()

    def render(self):
        return draw(self.forest)

    def close(self):
        pass

    def _observations(self):
        forest = self.forest
        you, partner = PLAYERS
        return {
            player: {
                "me": forest.places[player],
                "other": forest.places[partner if player == you else you],
                "acorns": sorted(forest.acorns),
                "trees": forest.trees,
                "left": forest.left,
            }
            for player in PLAYERS
        }

    def _infos(self):
        return {player: {"action_mask": self.forest.legal(player)} for player in PLAYERS}
