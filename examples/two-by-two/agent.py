"""Give and take: in each round both players give or keep, at the same time. What is given counts three for the other.

Which partner plays, and what the picture shows, stands in `options` (config.yml): both follow from the cell.
"""

import random

GIVE, KEEP = 0, 1
COST, GIFT = 1, 3
NAMES = {GIVE: "gave", KEEP: "kept"}


class Agent:
    def start(self, game):
        self.rounds = []

    def reset(self, seed=None, options=None):
        """Begin a game with the partner of `options`. Gymnasium's environments take options in the same way."""
        options = options or {}
        self.partner, self.history = options.get("partner", "random"), options.get("history", "shown")
        self.chance, self.rounds = random.Random(seed), []
        return self.observation(), {}

    def step(self, action):
        answer = self.partners_move()
        points = COST * (action == KEEP) + GIFT * (answer == GIVE)
        self.rounds.append((action, answer))
        return self.observation(), points, False, False, {"partner": NAMES[answer]}

    def partners_move(self):
        """Choose as the partner does, before seeing the participant's choice of this round."""
        if self.partner == "greedy":
            return KEEP if self.chance.random() < 0.9 else GIVE
        if self.partner == "copycat":
            return self.rounds[-1][0] if self.rounds else GIVE
        return self.chance.choice([GIVE, KEEP])

    def observation(self):
        return [len(self.rounds), *(self.rounds[-1] if self.rounds else (-1, -1))]

    def render(self):
        objects = [text("you", 120, 30, "You"), text("partner", 360, 30, "Partner")]
        shown = self.rounds if self.history == "shown" else self.rounds[-1:]
        for number, choices in enumerate(shown):
            for player, choice in enumerate(choices):
                x, y = 120 + 240 * player, 80 + 36 * number
                color = "#2f7d5b" if choice == GIVE else "#b3541e"
                objects.append(text(f"{player}-{number}", x, y, NAMES[choice], color))
        return {"objects": objects, "hud": f"Round {len(self.rounds) + 1}"}

    def close(self):
        pass


def text(name, x, y, words, color="#23303d"):
    return {"id": name, "type": "text", "x": x, "y": y, "text": words, "size": 24, "color": color, "origin": [0.5, 0]}
