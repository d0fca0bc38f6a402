"""Draws the images of assets/. Change them here, and run: .venv/bin/python examples/two-players/make_assets.py"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from PIL import Image, ImageDraw

SIDE, FINE = 144, 4  # pixels of an image; it is drawn FINE times as large, so that edges are smooth
INK = "#1c2430"


class Pen:
    """Draws with coordinates from 0 to 100."""

    def __init__(self) -> None:
        self.image = Image.new("RGBA", (SIDE * FINE, SIDE * FINE))
        self._draw = ImageDraw.Draw(self.image)
        self._scale = SIDE * FINE / 100

    def ellipse(self, left: float, top: float, right: float, bottom: float, fill: str, line: float = 0) -> None:
        box = [value * self._scale for value in (left, top, right, bottom)]
        self._draw.ellipse(box, fill, INK if line else None, round(line * self._scale))

    def box(self, left: float, top: float, right: float, bottom: float, fill: str, round_by: float = 0) -> None:
        box = [value * self._scale for value in (left, top, right, bottom)]
        self._draw.rounded_rectangle(box, round_by * self._scale, fill)

    def shape(self, points: list[tuple[float, float]], fill: str) -> None:
        self._draw.polygon([(x * self._scale, y * self._scale) for x, y in points], fill)

    def line(self, points: list[tuple[float, float]], width: float, color: str = INK) -> None:
        self._draw.line([(x * self._scale, y * self._scale) for x, y in points], color, round(width * self._scale))


def keeper(pen: Pen, coat: str, shade: str, *, pointed: bool) -> None:
    """Draw a keeper of lanterns in a hooded coat. Only one hood is `pointed`, for people who see no colours."""
    if pointed:
        pen.shape([(26, 40), (50, 2), (74, 40)], coat)
    else:
        pen.ellipse(24, 8, 76, 56, coat)
    pen.shape([(30, 52), (70, 52), (82, 94), (18, 94)], coat)
    pen.shape([(50, 52), (70, 52), (82, 94), (58, 94)], shade)
    pen.ellipse(24, 20, 76, 64, coat)
    pen.ellipse(32, 28, 68, 60, "#ffe3c2", 1.5)  # face
    pen.ellipse(40, 38, 46, 47, INK)
    pen.ellipse(54, 38, 60, 47, INK)
    pen.line([(45, 53), (50, 55), (55, 53)], 2)
    pen.ellipse(26, 90, 46, 99, INK)
    pen.ellipse(54, 90, 74, 99, INK)


def plate(pen: Pen) -> None:
    pen.ellipse(12, 24, 88, 84, "#8a6d1f")
    pen.ellipse(12, 18, 88, 78, "#e6b422", 2)
    pen.ellipse(26, 29, 74, 67, "#ffd84d")
    pen.shape([(50, 34), (56, 48), (50, 62), (44, 48)], "#fff4c2")


def hedge(pen: Pen) -> None:
    pen.box(4, 22, 96, 96, "#173f2c", 16)
    for left, top in ((6, 18), (32, 8), (56, 14), (16, 40), (46, 38), (62, 46), (8, 58), (36, 60)):
        pen.ellipse(left, top, left + 32, top + 32, "#2c6b45" if (left + top) % 4 else "#245a3a")


def lantern(pen: Pen, glass: str, *, lit: bool) -> None:
    if lit:
        pen.ellipse(6, 10, 94, 98, "#ffe98a55")
    pen.line([(50, 0), (50, 18)], 4, "#8792a2")
    pen.box(32, 16, 68, 26, "#8792a2", 4)
    pen.box(28, 26, 72, 78, glass, 10)
    pen.box(32, 78, 68, 88, "#8792a2", 4)
    if lit:
        pen.shape([(50, 36), (60, 58), (50, 72), (40, 58)], "#ffffff")


PICTURES: dict[str, Callable[[Pen], None]] = {
    "red": partial(keeper, coat="#e8502f", shade="#c33f22", pointed=True),
    "blue": partial(keeper, coat="#2f86e0", shade="#2169b5", pointed=False),
    "plate": plate,
    "hedge": hedge,
    "lantern": partial(lantern, glass="#3b4656", lit=False),
    "lantern-lit": partial(lantern, glass="#ffd84d", lit=True),
}


def make(folder: Path) -> None:
    """Write every image into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        pen = Pen()
        draw(pen)
        pen.image.reduce(FINE).save(folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "assets")
