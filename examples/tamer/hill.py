"""Draws the picture: the hill, the car, an arrow for its action, and the last word that it heard."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT, FINE = 640, 400, 2  # drawn FINE times as large, so that edges are smooth
LEFT, RIGHT, FLAG = -1.2, 0.6, 0.5  # places of MountainCar
SKY, EARTH, GRASS, INK = (232, 243, 248), (196, 172, 137), (92, 143, 80), (38, 50, 56)
BODY, WHEEL, ARROW = (216, 84, 56), (45, 45, 50), (24, 100, 170)
GOOD, BAD = (36, 130, 68), (182, 40, 46)
DOES = ("pushes left", "does not push", "pushes right")


def height(place: float) -> float:
    """Return the height of MountainCar's hill at a place."""
    return math.sin(3 * place) * 0.45 + 0.55


def font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.load_default(size * FINE)


class Hill:
    def __init__(self) -> None:
        self._text, self._large = font(22), font(30)
        self._still = self._landscape()

    def draw(self, place: float, action: int, heard: str | None) -> np.ndarray:
        """Draw the car at `place` while it takes `action`: 0 pushes left, 1 does not push, 2 pushes right."""
        picture = self._still.copy()
        pen = ImageDraw.Draw(picture)
        self._car(pen, place)
        self._motor(pen, place, action)
        pen.text(at(WIDTH / 2, 66), f"The car {DOES[action]}", INK, self._large, anchor="mm")
        if heard:
            colour = GOOD if heard == "good" else BAD
            pen.rounded_rectangle([*at(20, 338), *at(180, 386)], 10 * FINE, fill=colour)
            pen.text(at(100, 362), f"You: {heard}", (255, 255, 255), self._text, anchor="mm")
        return np.asarray(picture.reduce(FINE))

    def _landscape(self) -> Image.Image:
        picture = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), SKY)
        pen = ImageDraw.Draw(picture)
        line = [ground(LEFT + (RIGHT - LEFT) * step / 200) for step in range(201)]
        pen.polygon([*line, at(WIDTH, HEIGHT), at(0, HEIGHT)], EARTH)
        pen.line(line, GRASS, 7 * FINE)
        x, y = ground(FLAG)
        pen.line([(x, y), (x, y - 62 * FINE)], INK, 3 * FINE)
        pen.polygon([(x, y - 62 * FINE), (x - 34 * FINE, y - 50 * FINE), (x, y - 38 * FINE)], GOOD)
        pen.text(at(WIDTH / 2, 28), "Does it do the right thing now?  Say good or bad.", INK, self._text, anchor="mm")
        return picture

    def _car(self, pen: ImageDraw.ImageDraw, place: float) -> None:
        x, y = ground(place)
        ahead, behind = ground(place + 0.01), ground(place - 0.01)
        angle = math.atan2(ahead[1] - behind[1], ahead[0] - behind[0])

        def on_car(along: float, up: float) -> tuple[float, float]:
            """Return a point `along` the ground and `up` from it, in pixels before the picture is reduced."""
            return (
                x + (along * math.cos(angle) + up * math.sin(angle)) * FINE,
                y + (along * math.sin(angle) - up * math.cos(angle)) * FINE,
            )

        shape = [(-26, 10), (26, 10), (26, 22), (14, 24), (8, 36), (-12, 36), (-18, 24), (-26, 22)]
        pen.polygon([on_car(*point) for point in shape], BODY)
        pen.polygon([on_car(*point) for point in [(-9, 33), (6, 33), (10, 25), (-13, 25)]], SKY)
        for along in (-15, 15):
            wheel = on_car(along, 10)
            pen.circle(wheel, 9 * FINE, WHEEL)
            pen.circle(wheel, 3 * FINE, SKY)

    def _motor(self, pen: ImageDraw.ImageDraw, place: float, action: int) -> None:
        x, y = ground(place)
        y -= 74 * FINE
        x = min(max(x, 60 * FINE), (WIDTH - 60) * FINE)
        if action == 1:
            pen.circle((x, y), 8 * FINE, ARROW)
            return
        way = (action - 1) * FINE
        pen.line([(x - 42 * way, y), (x + 22 * way, y)], ARROW, 14 * FINE)
        pen.polygon([(x + 16 * way, y - 22 * FINE), (x + 46 * way, y), (x + 16 * way, y + 22 * FINE)], ARROW)


def at(x: float, y: float) -> tuple[float, float]:
    return x * FINE, y * FINE


def ground(place: float) -> tuple[float, float]:
    """Return the point of the hill's surface at `place`, in pixels before the picture is reduced."""
    return at((place - LEFT) / (RIGHT - LEFT) * WIDTH, HEIGHT - 24 - height(place) * 240)
