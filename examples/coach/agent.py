"""The robot acts and learns (coach.py) in the garden (garden.py); the participant watches it and says good or bad."""

import json
import os

import numpy as np
from coach import Coach
from garden import MOVES, Garden, features
from picture import draw

WORDS = {"good": 1.0, "bad": -1.0}
SHOWN_STEPS = 2
"""The number of steps for which the picture shows the last word that the robot has heard."""


class Agent:
    def start(self, game):
        trial = json.loads(os.environ.get("TRIAL", "{}"))  # the section `trial` of config.yml
        learning = {"learningRate": 0.5, "decay": 0.6, "delay": 0.2, **trial.get("options", {})}
        delay = int(learning["delay"] * trial.get("startingFrameRate", 2))  # in steps
        self.garden = Garden()
        size = len(features(self.garden.reset()))
        self.coach = Coach(size, len(MOVES), learning["learningRate"], learning["decay"], delay)

    def reset(self, seed=None):
        self.coach.begin()  # what it has learnt stays
        self.chance = np.random.default_rng(seed)
        self.place = self.before = self.garden.reset()
        self.move = None
        self.heard, self.heard_for = None, 0
        return self.place, {}

    def step(self, _action):
        """Take a move that the robot draws from its policy. The participant takes no action."""
        known = features(self.place)
        probabilities = self.coach.probabilities(known)
        self.move = self.coach.choose(known, self.chance)
        self.coach.took(known, self.move)
        self.heard_for = max(0, self.heard_for - 1)
        self.before = self.place
        self.place, reward, terminated, truncated = self.garden.step(self.move)
        # In actionSpace, noop comes before the moves.
        info = {"action": self.move + 1, "probabilities": probabilities.round(3).tolist()}
        return self.place, reward, terminated, truncated, info

    def feedback(self, word):
        if word in WORDS:
            self.coach.hear(WORDS[word])
            self.heard, self.heard_for = word, SHOWN_STEPS

    def render(self):
        return draw(self.before, self.place, self.move, self.heard if self.heard_for else None)

    def close(self):
        pass
