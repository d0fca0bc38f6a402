"""The garden (lanterns.py) as an environment with two players, drawn by objects (picture.py) for each of them.

The helper of helper.py is named here, since `agent:Helper` in config.yml is a class of this file.
"""

from helper import Helper  # noqa: F401 - config.yml names it
from lanterns import PLAYERS, Garden
from picture import draw


class Agent:
    possible_agents = PLAYERS

    def start(self, game):
        self.garden = Garden()

    def reset(self, seed=None):
        self.garden = Garden(seed)
        return self._observations(), self._infos()

    def step(self, actions):
        points = self.garden.move(actions)
        rewards = dict.fromkeys(PLAYERS, points)
        return self._observations(), rewards, {"__all__": self.garden.over}, {}, self._infos()

    def render(self, player):
        return draw(self.garden, player)

    def close(self):
        pass

    def _observations(self):
        garden = self.garden
        red, blue = PLAYERS
        return {
            player: {
                "me": garden.places[player],
                "other": garden.places[blue if player == red else red],
                "plates": garden.plates,
                "hedges": garden.hedges,
            }
            for player in PLAYERS
        }

    def _infos(self):
        """Return the infos. The recording holds them for each step."""
        garden = self.garden
        return {player: {"place": garden.places[player], "plates": garden.plates} for player in PLAYERS}
