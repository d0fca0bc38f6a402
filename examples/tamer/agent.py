"""The car acts and learns (tamer.py); the participant watches it (hill.py) and says good or bad.

The game is Gymnasium's MountainCar: the motor is too weak for the hill, so the car has to swing.
"""

import json
import os

import gymnasium
import numpy as np
from hill import Hill
from tamer import Bumps, Tamer

WORDS = {"good": 1.0, "bad": -1.0}
SHOWN_SECONDS = 0.8
"""The time for which the picture shows the last word that the car has heard."""

ACTIONS = 3  # push left, no push, push right


class Agent:
    def start(self, game):
        trial = json.loads(os.environ.get("TRIAL", "{}"))  # the section `trial` of config.yml
        self.rate = trial.get("startingFrameRate", 10)
        learning = {"bumps": 6, "learningRate": 2.0, **trial.get("options", {})}
        self.env = gymnasium.make(game)
        space = self.env.observation_space
        features = Bumps(space.low, space.high, int(learning["bumps"]))
        self.tamer = Tamer(features, ACTIONS, 1 / self.rate, float(learning["learningRate"]))
        self.hill = Hill()
        return self.env

    def reset(self, seed=None):
        self.tamer.begin()  # what it has learnt stays
        self.state, info = self.env.reset(seed=seed)
        self.action = int(np.random.default_rng(seed).integers(ACTIONS))
        self.heard, self.heard_for = None, 0
        return self.state, info

    def step(self, _action):
        """Take the action for which the car expects most praise. The participant takes none."""
        predicted = self.tamer.predict(self.state)
        self.action = self.tamer.choose(self.state, self.action)
        self.tamer.took(self.state, self.action)
        self.heard_for = max(0, self.heard_for - 1)
        self.state, reward, terminated, truncated, _ = self.env.step(self.action)
        info = {"action": self.action, "predicted": predicted.round(3).tolist()}
        return self.state, reward, terminated, truncated, info

    def feedback(self, word):
        if word in WORDS:
            self.tamer.hear(WORDS[word])
            self.heard, self.heard_for = word, round(SHOWN_SECONDS * self.rate)

    def render(self):
        return self.hill.draw(float(self.state[0]), self.action, self.heard if self.heard_for else None)

    def close(self):
        self.env.close()
