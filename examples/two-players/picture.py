"""Draws the garden for one player, by objects. Sprites show the images of assets/, which make_assets.py draws."""

from __future__ import annotations

from lanterns import HEIGHT, LANTERNS, PLAYERS, WIDTH, Garden, Place

FIELD = 72  # pixels: the side of a field
TOP = 48  # pixels above the garden, where the lanterns hang
GLIDE = 160  # milliseconds in which a player is seen to move: about one step
GRASS = ((0x22, 0x3A, 0x33), (0x26, 0x40, 0x37))
LIT_GRASS = (0x62, 0x8A, 0x4E)  # its colour when all lanterns are lit
ASIDE = {"red": -9, "blue": 9}  # pixels from the middle of a field, so that both players are seen on the same one

Object = dict[str, object]


def draw(garden: Garden, player: str) -> dict[str, object]:
    objects = [*_ground(garden.lit), *(_lantern(number, garden.lit) for number in range(LANTERNS))]
    objects += [_sprite(f"hedge {place}", "hedge", place) for place in sorted(garden.hedges)]
    for place in garden.plates:
        objects += _plate(place, lit=place in garden.occupied_plates)
    objects += [part for each in PLAYERS for part in _figure(each, garden.places[each], me=each == player)]
    return {"objects": objects, "hud": f"You are {player}. {garden.lit} of {LANTERNS} lanterns lit"}


def _corner(place: Place) -> tuple[int, int]:
    return place[0] * FIELD, TOP + place[1] * FIELD


def _ground(lit: int) -> list[Object]:
    """Draw the grass. It gets lighter with each lantern."""
    found: list[Object] = []
    for column in range(WIDTH):
        for row in range(HEIGHT):
            x, y = _corner((column, row))
            dark = GRASS[(column + row) % 2]
            mixed = (round(a + (b - a) * lit / LANTERNS) for a, b in zip(dark, LIT_GRASS, strict=True))
            color = "#" + "".join(f"{part:02x}" for part in mixed)
            size = {"width": FIELD, "height": FIELD, "color": color}
            found.append({"id": f"grass {column} {row}", "type": "rectangle", "x": x, "y": y, **size})
    return found


def _sprite(name: str, image: str, place: Place, depth: int = 2) -> Object:
    x, y = _corner(place)
    return {
        "id": name,
        "type": "sprite",
        "image": image,
        "x": x,
        "y": y,
        "width": FIELD,
        "height": FIELD,
        "depth": depth,
    }


def _lantern(number: int, lit: int) -> Object:
    x = (number + 0.5) * WIDTH * FIELD / LANTERNS - TOP / 2
    image = "lantern-lit" if number < lit else "lantern"
    size = {"width": TOP, "height": TOP}
    return {"id": f"lantern {number}", "type": "sprite", "image": image, "x": x, "y": 0, **size, "depth": 2}


def _plate(place: Place, *, lit: bool) -> list[Object]:
    x, y = _corner(place)
    middle = {"x": x + FIELD / 2, "y": y + FIELD / 2}
    glow: Object = {"id": f"glow {place}", "type": "circle", **middle, "radius": 46 if lit else 36, "color": "#ffd84d"}
    return [{**glow, "alpha": 0.75 if lit else 0.25, "depth": 1}, _sprite(f"plate {place}", "plate", place)]


def _figure(player: str, place: Place, *, me: bool) -> list[Object]:
    """Draw a player. The figure of the participant who sees the picture has a ring around it."""
    x, y = _corner(place)
    found: list[Object] = []
    if me:
        ring: Object = {"x": x + ASIDE[player] + FIELD / 2, "y": y + FIELD / 2, "radius": FIELD / 2 - 2, "depth": 3}
        ring |= {"color": "#ffffff33", "outline": "#ffffff", "outline_width": 3, "tween": GLIDE}
        found.append({**ring, "id": "you", "type": "circle"})
    sprite = _sprite(player, player, place, depth=5 if me else 4)
    return [*found, {**sprite, "x": x + ASIDE[player], "tween": GLIDE}]
