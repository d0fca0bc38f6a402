"""Draw the pictures of this study: `python make_assets.py` writes `assets/kitchen.png` and `.json` (Pillow and numpy).

`kitchen.png` is an atlas: all pictures in one file. `kitchen.json` says where each is in it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

ASSETS = Path(__file__).parent / "assets"
TILE = 144
"""The side of a picture in pixels: 1.5 times the tile of the scene, for large screens."""

FINER = 4
"""Pictures are drawn FINER times larger and then reduced, so that edges are smooth."""

COLUMNS = 6
EDGE = 2
"""The width of each picture's border, which repeats its outermost pixels: scaled, it shows nothing of the next one."""

Colour = tuple[int, ...]

FLOOR, JOINT = (232, 222, 204), (218, 206, 184)
WOOD, WOOD_EDGE = (181, 137, 92), (139, 99, 62)
STEEL, STEEL_EDGE, STEEL_LIGHT = (150, 160, 170), (92, 102, 112), (196, 204, 212)
ONION, ONION_EDGE = (238, 196, 92), (176, 126, 40)
PLATE, PLATE_EDGE = (250, 250, 250), (168, 176, 184)
SOUP = (222, 150, 52)
GREEN, DARK = (72, 160, 96), (44, 46, 52)
SKIN, HAT, HAT_EDGE = (240, 200, 164), (252, 252, 252), (186, 192, 200)
CLOTHES = {"blue": (66, 118, 206), "green": (66, 158, 92)}
EYES = {"down": (-1, 1), "left": (-1,), "right": (1,), "up": ()}
AHEAD = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


class Tile:
    """A picture that is being drawn. Lengths are parts of a tile, from 0 to 1."""

    def __init__(self, fill: Colour | None = None) -> None:
        self._size = TILE * FINER
        self.picture = Image.new("RGBA", (self._size, self._size), fill or (0, 0, 0, 0))
        self._draw = ImageDraw.Draw(self.picture)

    def box(self, left: float, top: float, right: float, bottom: float, fill: Colour, round_by: float = 0.0) -> None:
        corners = tuple(part * self._size for part in (left, top, right, bottom))
        self._draw.rounded_rectangle(corners, round_by * self._size, fill=fill)

    def oval(self, x: float, y: float, wide: float, high: float, fill: Colour, edge: Colour | None = None) -> None:
        """Draw an ellipse around a point; `wide` and `high` are its radii."""
        corners = tuple(part * self._size for part in (x - wide, y - high, x + wide, y + high))
        self._draw.ellipse(corners, fill=fill, outline=edge, width=round(0.025 * self._size) if edge else 0)

    def line(self, points: list[tuple[float, float]], fill: Colour, wide: float) -> None:
        self._draw.line([(x * self._size, y * self._size) for x, y in points], fill, round(wide * self._size), "curve")

    def done(self) -> Image.Image:
        return self.picture.resize((TILE, TILE), Image.Resampling.LANCZOS)


def floor() -> Tile:
    tile = Tile(JOINT)
    for x in (0.0, 0.5):
        for y in (0.0, 0.5):
            tile.box(x + 0.01, y + 0.01, x + 0.49, y + 0.49, FLOOR, 0.03)
    return tile


def counter() -> Tile:
    tile = Tile(WOOD_EDGE)
    tile.box(0.03, 0.03, 0.97, 0.86, WOOD, 0.06)
    for y in (0.25, 0.5, 0.7):
        tile.line([(0.1, y), (0.9, y)], (170, 126, 82), 0.015)
    return tile


def onion(tile: Tile, x: float, y: float, size: float) -> None:
    tile.line([(x, y - size * 0.6), (x, y - size * 1.35)], (110, 150, 70), size * 0.3)
    tile.oval(x, y, size, size * 0.92, ONION, ONION_EDGE)
    for side in (-size, size):
        rib = [(x + side * 0.3, y - size * 0.5), (x + side * 0.42, y), (x + side * 0.3, y + size * 0.5)]
        tile.line(rib, ONION_EDGE, 0.012)


def plate(tile: Tile, x: float, y: float, size: float, inside: Colour = (236, 240, 242)) -> None:
    tile.oval(x, y, size, size, PLATE, PLATE_EDGE)
    tile.oval(x, y, size * 0.64, size * 0.64, inside)


def onions() -> Tile:
    tile = counter()
    tile.box(0.1, 0.2, 0.9, 0.82, (120, 84, 48), 0.08)
    for x, y in ((0.3, 0.4), (0.7, 0.4), (0.5, 0.62)):
        onion(tile, x, y, 0.15)
    return tile


def plates() -> Tile:
    tile = counter()
    for number in range(4):
        plate(tile, 0.5, 0.56 - number * 0.05, 0.32)
    return tile


def hatch() -> Tile:
    """Draw an open hatch with an arrow, where soups are delivered."""
    tile = Tile(STEEL_EDGE)
    tile.box(0.04, 0.04, 0.96, 0.9, GREEN, 0.08)
    tile.line([(0.5, 0.2), (0.5, 0.7)], (240, 250, 240), 0.09)
    tile.line([(0.3, 0.5), (0.5, 0.72), (0.7, 0.5)], (240, 250, 240), 0.09)
    return tile


def pot(onions_inside: int, ready: bool = False) -> Tile:
    """Draw the pot on its stove, from above and the front."""
    tile = counter()
    tile.box(0.08, 0.08, 0.92, 0.82, DARK, 0.1)
    tile.box(0.04, 0.36, 0.96, 0.48, STEEL_EDGE, 0.06)
    tile.oval(0.5, 0.44, 0.36, 0.34, STEEL, STEEL_EDGE)
    tile.oval(0.5, 0.42, 0.29, 0.27, SOUP if onions_inside else STEEL_LIGHT, STEEL_EDGE)
    if not ready:
        for x, y in ((0.38, 0.38), (0.62, 0.38), (0.5, 0.54))[:onions_inside]:
            tile.oval(x, y, 0.1, 0.09, ONION, ONION_EDGE)
        return tile
    for x in (0.36, 0.5, 0.64):
        wave = [(x + 0.03 * math.sin(step), 0.36 - 0.03 * step) for step in range(9)]
        tile.line(wave, (250, 250, 250), 0.035)
    return tile


def chef(colour: str, facing: str) -> Tile:
    """Draw a chef from above and the front: clothes, head, tall hat. Hands point ahead."""
    tile, clothes = Tile(), CLOTHES[colour]
    darker = tuple(round(part * 0.7) for part in clothes)
    across, down = AHEAD[facing]
    tile.oval(0.5, 0.9, 0.3, 0.07, (0, 0, 0, 60))
    tile.oval(0.5, 0.72, 0.29, 0.2, clothes, darker)
    for side in (-1, 1):
        x = 0.5 + side * 0.22 * abs(down or 0.3) + across * 0.24
        tile.oval(x, 0.7 + down * 0.1, 0.07, 0.07, SKIN, (196, 150, 116))
    tile.oval(0.5, 0.45, 0.22, 0.2, SKIN, (196, 150, 116))
    for side in EYES[facing]:
        tile.oval(0.5 + (side * 0.09 if facing == "down" else across * 0.11), 0.47, 0.028, 0.036, DARK)
    tile.box(0.3, 0.2, 0.7, 0.38, HAT, 0.04)
    for x, y, size in ((0.34, 0.16, 0.12), (0.5, 0.12, 0.12), (0.66, 0.16, 0.12)):
        tile.oval(x, y, size, size * 0.85, HAT, HAT_EDGE)
    tile.box(0.31, 0.14, 0.69, 0.34, HAT)
    tile.box(0.3, 0.31, 0.7, 0.38, clothes)
    return tile


def thing(name: str) -> Tile:
    """Draw a thing that lies on a counter or is carried, in the middle of its tile."""
    tile = Tile()
    if name == "onion":
        onion(tile, 0.5, 0.52, 0.2)
    else:
        plate(tile, 0.5, 0.5, 0.28, SOUP if name == "onion_soup" else (236, 240, 242))
    return tile


def pictures() -> dict[str, Image.Image]:
    tiles = {
        "floor": floor(),
        "counter": counter(),
        "onion_stack": onions(),
        "plate_stack": plates(),
        "delivery_zone": hatch(),
        **{f"pot-{number}": pot(number) for number in range(4)},
        "pot-ready": pot(3, ready=True),
        **{name: thing(name) for name in ("onion", "plate", "onion_soup")},
        **{f"chef-{colour}-{facing}": chef(colour, facing) for colour in CLOTHES for facing in AHEAD},
    }
    return {name: tile.done() for name, tile in tiles.items()}


def main() -> None:
    found = pictures()
    rows = math.ceil(len(found) / COLUMNS)
    cell = TILE + 2 * EDGE
    atlas, frames = Image.new("RGBA", (COLUMNS * cell, rows * cell)), {}
    for number, (name, picture) in enumerate(found.items()):
        row, column = divmod(number, COLUMNS)
        wider = np.pad(np.asarray(picture), ((EDGE, EDGE), (EDGE, EDGE), (0, 0)), mode="edge")
        atlas.paste(Image.fromarray(wider), (column * cell, row * cell))
        frames[name] = {"frame": {"x": column * cell + EDGE, "y": row * cell + EDGE, "w": TILE, "h": TILE}}
    ASSETS.mkdir(exist_ok=True)
    atlas.quantize(128, Image.Quantize.FASTOCTREE).save(ASSETS / "kitchen.png", optimize=True)
    (ASSETS / "kitchen.json").write_text(json.dumps({"frames": frames}, indent=1) + "\n")


if __name__ == "__main__":
    main()
