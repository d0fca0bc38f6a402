"""Draws the forest, by objects. Sprites show the images of assets/, which make_assets.py draws."""

from __future__ import annotations

from forest import ACORNS, HEIGHT, WIDTH, Forest, Place

FIELD = 80  # pixels: the side of a field
RING = "#1864aa"
GRASS = ("#dcebcf", "#d2e4c3")
GLIDE = 250  # milliseconds in which a player is seen to move

Object = dict[str, object]


def draw(forest: Forest) -> dict[str, object]:
    objects = [*_ground(), *(_sprite(f"tree {place}", "tree", place) for place in sorted(forest.trees))]
    objects += [_sprite(f"acorn {place}", "acorn", place) for place in sorted(forest.acorns)]
    objects.append(_whose_turn(forest))
    for player in ("partner", "you"):
        objects.append({**_sprite(player, player, forest.places[player]), "tween": GLIDE, "depth": 3})
    return {"objects": objects, "hud": f"{ACORNS - len(forest.acorns)} of {ACORNS} acorns, {forest.left} turns left"}


def _corner(place: Place) -> tuple[int, int]:
    return place[0] * FIELD, place[1] * FIELD


def _ground() -> list[Object]:
    found: list[Object] = []
    for column in range(WIDTH):
        for row in range(HEIGHT):
            x, y = _corner((column, row))
            size = {"width": FIELD, "height": FIELD, "color": GRASS[(column + row) % 2]}
            found.append({"id": f"grass {column} {row}", "type": "rectangle", "x": x, "y": y, **size})
    return found


def _sprite(name: str, image: str, place: Place) -> Object:
    x, y = _corner(place)
    return {"id": name, "type": "sprite", "image": image, "x": x, "y": y, "width": FIELD, "height": FIELD, "depth": 2}


def _whose_turn(forest: Forest) -> Object:
    """Draw a ring around the player who is to move. The page also says in words whose turn it is."""
    x, y = _corner(forest.places[forest.turn])
    ring: Object = {"x": x + FIELD / 2, "y": y + FIELD / 2, "radius": FIELD / 2 - 3, "color": "#ffffff88"}
    return {**ring, "id": "turn", "type": "circle", "outline": RING, "outline_width": 4, "depth": 1, "tween": GLIDE}
