"""Slime volleyball: the environment, and how it is drawn. Who plays whom stands in config.yml (`players`)."""

import json
import math
import os

from slime_volleyball.core import constants, physics
from volleyball import LEFT, PLAYERS, RIGHT, Volleyball

WIDTH, HEIGHT = 960, 500
"""The size of the scene in config.yml, in pixels. `assets/court.png` has the same size."""

SCALE = WIDTH / constants.REF_W
"""The pixels of one unit of the package."""

SAND = 30
"""The pixels from the bottom of the picture to the ground."""

SLIMES = {LEFT: "slime-left", RIGHT: "slime-right"}
COLOURS = {LEFT: "red", RIGHT: "blue"}
NET, WHITE, BLACK = "#7a5230", "#ffffff", "#20242a"


class Agent:
    def start(self, game):
        """Make the environment and return it. Its `reset`, `step` and `close` are called as PettingZoo has them."""
        trial = json.loads(os.environ.get("TRIAL", "{}"))
        options, plays = trial.get("options", {}), trial.get("players", {})
        self.two_people = list(plays.values()).count("human") == 2
        self.env = Volleyball(points=options.get("points", 5), seconds=options.get("seconds", 100))
        return self.env

    def render(self, player):
        """Return the scene (docs/objects.md). Objects that never change are `permanent`: they are sent once an episode.

        If two people play, each reads which slime they are. Against the policy, the instructions say it.
        """
        places = self.env.places()
        ball = places["ball"]
        objects = [*(STILL if self.env.begins() else ()), *_ball(ball)]
        for each in PLAYERS:
            objects += _slime(each, places[each], ball)
        if self.env.serve() and any(self.env.scores.values()):  # before the first point the page itself says "Ready?"
            x, y = _at(0, 14)
            objects.append(
                {"id": "serve", "type": "text", "text": "Ready?", "x": x, "y": y, "origin": [0.5, 1], "size": 34}
            )
        scores = self.env.scores
        left = math.ceil(self.env.seconds_left())
        you = f"You are {COLOURS[player]} · " if self.two_people else ""
        return {"objects": objects, "hud": f"{you}Red {scores[LEFT]} : {scores[RIGHT]} Blue · {left} s"}


def _at(x, y):
    """Convert a place to pixels. The package measures it from the net, and from the lower edge of the ground."""
    return WIDTH / 2 + x * SCALE, HEIGHT - SAND - (y - constants.REF_U) * SCALE


def _sprite(name, image, box, **more):
    x, y, width, height = box
    return {"id": name, "type": "sprite", "image": image, "x": x, "y": y, "width": width, "height": height, **more}


def _circle(name, place, radius, color, **more):
    return {"id": name, "type": "circle", "x": place[0], "y": place[1], "radius": radius, "color": color, **more}


def _slime(player, place, ball):
    """Return a slime: its body is a sprite, and its eye looks at the ball."""
    x, y = _at(*place)
    radius = physics.AGENT_RADIUS * SCALE
    eye = x + (0.4 if player == LEFT else -0.4) * radius, y - 0.55 * radius
    to_x, to_y = _at(*ball)[0] - eye[0], _at(*ball)[1] - eye[1]
    far = math.hypot(to_x, to_y) or 1
    pupil = eye[0] + to_x / far * 3, eye[1] + to_y / far * 3
    return [
        _sprite(player, SLIMES[player], (x - radius, y - radius, 2 * radius, radius), depth=1),
        _circle(f"{player} eye", eye, 6, WHITE, depth=2),
        _circle(f"{player} pupil", pupil, 3, BLACK, depth=3),
    ]


def _ball(place):
    """Return the ball, which turns as it flies; an arrow that points to it if it is above the picture."""
    x, y = _at(*place)
    size = 2 * physics.BALL_RADIUS * SCALE
    if y > -size / 2:
        return [_sprite("ball", "ball", (x, y, size, size), origin=[0.5, 0.5], angle=round(x * 3) % 360, depth=4)]
    points = [[x - 9, 20], [x + 9, 20], [x, 6]]
    return [{"id": "above", "type": "polygon", "points": points, "color": BLACK, "depth": 4}]


def _still():
    x, top = _at(0, constants.REF_WALL_HEIGHT)
    wide = constants.REF_WALL_WIDTH * SCALE
    net = {"x": x - wide / 2, "y": top, "width": wide, "height": HEIGHT - SAND - top, "color": NET}
    return [
        _sprite("court", "court", (0, 0, WIDTH, HEIGHT), depth=-2, permanent=True),
        {"id": "net", "type": "rectangle", **net, "depth": -1, "permanent": True},
        _circle("net top", (x, top), physics.FENCE_STUB_R * SCALE, NET, depth=-1, permanent=True),
    ]


STILL = _still()
