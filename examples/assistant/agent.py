"""The grove (grove.py) as an environment, drawn by objects (picture.py), and the owl that gives hints."""

from grove import Grove
from picture import draw

REMEMBERED = 6
"""The owl gets so many of the last lines with each question."""


class Agent:
    def start(self, game):
        self.grove = Grove()

    def reset(self, seed=None):
        self.grove = Grove(seed)
        return self._observation(), {}

    def step(self, move):
        points = self.grove.move(move)
        return self._observation(), points, not self.grove.hidden, self.grove.over and bool(self.grove.hidden), {}

    def render(self):
        return draw(self.grove)

    def close(self):
        pass

    def reply(self, session, player, text):
        """Answer a line of the participant. What is said and asked is recorded; a lost server repeats no call."""
        before = [f"{line['by']}: {line['text']}" for line in session.talk[:-1][-REMEMBERED:]]
        return session.ask("\n".join([f"The squirrel asks: {text}", "", self.grove.in_words(), *_said(before)]))

    def _observation(self):
        return {"squirrel": self.grove.squirrel, "seen": self.grove.seen(), "left": self.grove.left}


def _said(lines):
    return ["", "Said before:", *lines] if lines else []
