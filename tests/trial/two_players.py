"""An agent.py with two players, and a partner for one of them, for tests on real trial servers.

An observation is the number of the step and a number that depends on the seed. The second number is
never 0: with a 0, some tests' policies would answer zeros.
"""

TWO = '''
import sys
import time
import numpy as np

LENGTH = {length}

class Agent:
    possible_agents = ["left", "right"]

    def start(self, game):
        pass

    def reset(self, seed=None):
        self.t, self.seed, self.last = 0, seed, {{"left": 0, "right": 0}}
        return self.seen(), {{"left": {{}}, "right": {{}}}}

    def seen(self):
        return {{name: np.array([self.t, 1 + self.seed % 100], np.float32) for name in self.possible_agents}}

    def step(self, actions):
        self.t += 1
        self.last = dict(actions)
        rewards = {{"left": float(actions["left"]), "right": float(10 * actions["right"] + self.seed % 7)}}
        return self.seen(), rewards, {{"__all__": self.t == LENGTH}}, {{}}, {{"left": {{}}, "right": {{"t": self.t}}}}

    {to_act}

    def render(self):
        return np.full((9, 16, 3), self.t % 256, np.uint8)

    def close(self):
        pass


class Partner:
    """Counts what it was asked since the last reset; acts by that alone."""

    def reset(self, seed):
        self.asked = 0

    def resume(self, steps):
        print("told of", [(int(observation[0]), action) for observation, info, action in steps], file=sys.stderr)
        self.asked = len(steps)

    def act(self, observation, info):
        print("asked at", int(observation[0]), file=sys.stderr)
        self.asked += 1
        {act}
        return self.asked % 3
'''
TURN = """
    def to_act(self):
        return ["left", "right"][self.t % 2]
""".strip()
TRIAL = {"players": {"left": "human", "right": "agent:Partner"}, "actionSpace": ["noop", "up", "down"]}


def two_players(*, length: int | None = None, turns: bool = False, act: str = "") -> str:
    """Return the source of agent.py.

    `turns`: the players take turns; `act`: code that the partner runs before it acts.
    """
    return TWO.format(length=length, to_act=TURN if turns else "", act=act or "pass")
