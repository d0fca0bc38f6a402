"""On which side are more dots? Participants judge, read what an advisor judges, and judge again, which counts.

`options` say how often the advisor is right; `none` is training without one. The agent reads what its participant has
answered before (`answers` in config.yml): who relies little on advice is shown the advisor's record.
"""

import random

SIDES = ("left", "right")
FEW, MANY = 22, 27
LITTLE = 3  # of 7


class Agent:
    def start(self, game):
        self.right = self.judged = 0
        self.shows_record = False

    def on_session_start(self, session):
        """Begin with a new advisor. The last rating before counts; before the first advisor, what was expected."""
        self.right = self.judged = 0
        if session.answers:
            earlier = [session.answers["expect"], *session.answers.get("rate", {}).values()]
            trust = int(earlier[-1]["trust"])
            self.shows_record = trust <= LITTLE
            return {"trust": trust, "showsRecord": self.shows_record}

    def reset(self, seed=None, options=None):
        chance, often = random.Random(seed), (options or {}).get("advisor", "none")
        self.more = chance.randrange(2)
        self.advice = None if often == "none" else self.more if chance.random() < often else 1 - self.more
        self.dots = [scattered(chance, side, MANY if side == self.more else FEW) for side in (0, 1)]
        self.first = self.last = None
        return [self.more], {}

    def step(self, action):
        if self.first is None and self.advice is not None:
            self.first = action
            return [self.more], 0, False, False, {"advice": SIDES[self.advice]}
        self.last, success = action, action == self.more
        self.judged += 1
        self.right += self.advice == self.more
        return [self.more], int(success), True, False, {"success": success}

    def on_episode_end(self, session):
        """Record the judgements and the advice: whoever follows it switches where it differs from their first."""
        if self.advice is not None and self.last is not None:
            sides = {"first": self.first, "advice": self.advice, "last": self.last, "more": self.more}
            return {name: SIDES[side] for name, side in sides.items()}

    def render(self):
        objects = [{"id": "middle", "type": "line", "points": [[240, 20], [240, 240]], "width": 2, "color": "#c9c2b4"}]
        for side in (0, 1):
            for place, (x, y) in enumerate(self.dots[side]):
                dot = {"type": "circle", "x": x, "y": y, "radius": 4, "color": "#23303d"}
                objects.append({"id": f"{side}-{place}", **dot})
        if self.first is None:
            return {"objects": [*objects, text("words", 262, "Which side has more dots?")]}
        objects.append(text("words", 252, f"The advisor says: {SIDES[self.advice]}. Judge again."))
        if self.shows_record and self.judged:
            objects.append(text("record", 284, f"The advisor was right {self.right} of {self.judged} times."))
        return {"objects": objects}

    def close(self):
        pass


def scattered(chance, side, number):
    """Choose the places of so many dots, no two of them on one another."""
    places = [(x, y) for x in range(30, 220, 14) for y in range(20, 240, 14)]
    return [(x + 230 * side + chance.randrange(5), y + chance.randrange(5)) for x, y in chance.sample(places, number)]


def text(name, y, words):
    return {
        "id": name,
        "type": "text",
        "x": 240,
        "y": y,
        "text": words,
        "size": 20,
        "color": "#23303d",
        "origin": [0.5, 0],
    }
