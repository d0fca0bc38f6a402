"""Draws the images of assets/. Change them here, and run: .venv/bin/python examples/gridworld/make_assets.py"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from PIL import Image, ImageDraw

SIDE, FINE = 160, 4  # pixels of an image; it is drawn FINE times as large, so that edges are smooth
INK = "#26323a"


class Pen:
    """Draws with coordinates from 0 to 100."""

    def __init__(self) -> None:
        self.image = Image.new("RGBA", (SIDE * FINE, SIDE * FINE))
        self._draw = ImageDraw.Draw(self.image)
        self._scale = SIDE * FINE / 100

    def ellipse(self, left: float, top: float, right: float, bottom: float, fill: str, line: float = 0) -> None:
        box = [value * self._scale for value in (left, top, right, bottom)]
        self._draw.ellipse(box, fill, INK if line else None, round(line * self._scale))

    def shape(self, points: list[tuple[float, float]], fill: str) -> None:
        self._draw.polygon([(x * self._scale, y * self._scale) for x, y in points], fill)

    def line(self, points: list[tuple[float, float]], width: float) -> None:
        self._draw.line([(x * self._scale, y * self._scale) for x, y in points], INK, round(width * self._scale))


def you(pen: Pen) -> None:
    """Draw a squirrel."""
    pen.ellipse(56, 18, 94, 84, "#a9592b", 2)  # tail
    pen.ellipse(66, 30, 86, 74, "#c97a45")
    pen.shape([(24, 28), (30, 6), (42, 24)], "#a9592b")  # ears
    pen.shape([(44, 24), (56, 6), (60, 28)], "#a9592b")
    pen.ellipse(22, 46, 68, 94, "#c46f38", 2)  # body
    pen.ellipse(32, 58, 58, 92, "#f2dcc0")
    pen.ellipse(18, 16, 66, 58, "#c46f38", 2)  # head
    pen.ellipse(28, 28, 37, 39, INK)
    pen.ellipse(47, 28, 56, 39, INK)
    pen.ellipse(38, 41, 46, 47, INK)


def partner(pen: Pen) -> None:
    """Draw a robot."""
    pen.line([(50, 22), (50, 8)], 3)
    pen.ellipse(45, 2, 55, 12, "#e0a800", 1.5)
    pen.ellipse(18, 18, 82, 66, "#7ea7c4", 2.5)  # head
    pen.ellipse(26, 30, 74, 58, "#f4f6f2")
    pen.ellipse(34, 36, 46, 50, INK)
    pen.ellipse(54, 36, 66, 50, INK)
    pen.shape([(28, 66), (72, 66), (78, 92), (22, 92)], "#5b86a6")
    pen.ellipse(22, 82, 42, 98, INK)
    pen.ellipse(58, 82, 78, 98, INK)


def acorn(pen: Pen) -> None:
    pen.ellipse(32, 34, 68, 84, "#b9813f", 2)
    pen.shape([(44, 80), (56, 80), (50, 90)], "#8a5c28")
    pen.ellipse(27, 24, 73, 54, "#7a5230", 2)
    pen.line([(50, 26), (55, 12)], 4)


def tree(pen: Pen) -> None:
    pen.shape([(43, 66), (57, 66), (60, 96), (40, 96)], "#7a5230")
    for top, half in ((4, 26), (22, 33), (42, 39)):
        pen.shape([(50, top), (50 + half, top + 34), (50 - half, top + 34)], "#2f7d4f")
        pen.shape([(50, top), (50 + half, top + 34), (50 + half * 0.2, top + 34)], "#266a42")


PICTURES: dict[str, Callable[[Pen], None]] = {"you": you, "partner": partner, "acorn": acorn, "tree": tree}


def make(folder: Path) -> None:
    """Write every image into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        pen = Pen()
        draw(pen)
        pen.image.reduce(FINE).save(folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "assets")
