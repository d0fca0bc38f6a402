"""Draw the pictures of this study: `python make_assets.py` writes `assets/`. Needs Pillow."""

from __future__ import annotations

import math
from pathlib import Path

from PIL import Image, ImageDraw

ASSETS = Path(__file__).parent / "assets"
FINER = 4
"""Pictures are drawn FINER times larger and then reduced, so that edges are smooth."""

WIDTH, HEIGHT, GROUND = 960, 500, 30
"""The size of the court, and the height of its ground, in pixels."""

SLIME, BALL = (120, 60), 40
"""The sizes of their pictures in pixels: twice the sizes at which they are shown."""

Colour = tuple[int, ...]


def court() -> Image.Image:
    """Draw sky, sea and sand."""
    picture = Image.new("RGB", (WIDTH * 2, HEIGHT * 2), (198, 232, 244))
    draw = ImageDraw.Draw(picture)
    draw.ellipse(_around(1560, 190, 90), fill=(255, 236, 168))
    for x, y, size in ((300, 220, 46), (1120, 130, 38)):
        for shift, part in ((-1.2, 0.7), (0, 1.0), (1.2, 0.75)):
            draw.ellipse(_around(x + shift * size, y - 8 * part, size * part), fill=(236, 247, 251))
        draw.rectangle((x - size * 1.9, y + size * 0.2, x + size * 1.9, y + size), fill=(198, 232, 244))
    draw.rectangle((0, 760, WIDTH * 2, HEIGHT * 2), fill=(104, 178, 204))
    for x in range(0, WIDTH * 2, 120):
        draw.arc((x, 756, x + 120, 786), 180, 360, fill=(150, 206, 224), width=6)
    draw.rectangle((0, (HEIGHT - GROUND) * 2 - 40, WIDTH * 2, HEIGHT * 2), fill=(240, 216, 160))
    draw.rectangle((0, (HEIGHT - GROUND) * 2, WIDTH * 2, HEIGHT * 2), fill=(226, 194, 128))
    return picture.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS).quantize(48, dither=Image.Dither.NONE)


def slime(body: Colour, edge: Colour) -> Image.Image:
    """Draw half a disc with a lighter spot. The game itself draws the eye, which follows the ball."""
    width, height = SLIME[0] * FINER, SLIME[1] * FINER
    picture = Image.new("RGBA", (width, height * 2))
    draw = ImageDraw.Draw(picture)
    draw.ellipse((0, 0, width - 1, height * 2 - 1), fill=edge)
    rim = 5 * FINER
    draw.ellipse((rim, rim, width - 1 - rim, height * 2 - 1 - rim), fill=body)
    draw.ellipse((width * 0.2, height * 0.12, width * 0.45, height * 0.42), fill=_lighter(body, 0.35))
    picture = picture.crop((0, 0, width, height))
    ImageDraw.Draw(picture).rectangle((0, height - rim, width, height), fill=edge)
    shape = Image.new("L", (width, height * 2))
    ImageDraw.Draw(shape).ellipse((0, 0, width - 1, height * 2 - 1), fill=255)
    picture.putalpha(shape.crop((0, 0, width, height)))
    return picture.resize(SLIME, Image.Resampling.LANCZOS)


def ball() -> Image.Image:
    size = BALL * FINER
    picture = Image.new("RGBA", (size, size))
    draw = ImageDraw.Draw(picture)
    draw.ellipse((0, 0, size - 1, size - 1), fill=(176, 72, 24))
    rim = 2 * FINER
    draw.ellipse((rim, rim, size - 1 - rim, size - 1 - rim), fill=(247, 244, 232))
    for turn in range(3):
        angle = math.radians(90 + 120 * turn)
        x, y = size / 2 + math.cos(angle) * size * 0.62, size / 2 + math.sin(angle) * size * 0.62
        draw.arc(_around(x, y, size * 0.55), 0, 360, fill=(217, 106, 44), width=3 * FINER)
    shape = Image.new("L", (size, size))
    ImageDraw.Draw(shape).ellipse((0, 0, size - 1, size - 1), fill=255)
    picture.putalpha(shape)
    return picture.resize((BALL, BALL), Image.Resampling.LANCZOS)


def _around(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    return x - radius, y - radius, x + radius, y + radius


def _lighter(colour: Colour, part: float) -> Colour:
    return tuple(round(value + (255 - value) * part) for value in colour)


def main() -> None:
    ASSETS.mkdir(exist_ok=True)
    pictures = {
        "court": court(),
        "slime-left": slime((226, 92, 74), (158, 48, 40)),
        "slime-right": slime((76, 124, 214), (38, 70, 146)),
        "ball": ball(),
    }
    for name, picture in pictures.items():
        picture.save(ASSETS / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
