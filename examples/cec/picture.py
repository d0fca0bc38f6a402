"""Draws the kitchen by objects (docs/objects.md): rectangles and circles, without any image."""

from __future__ import annotations

from collections.abc import Iterator

from kitchen import COOK_STEPS, HEIGHT, LAYOUT, MOVES, WIDTH, Chef, Kitchen, Place, Pot

TILE = 80  # pixels; the scene in config.yml has 560 x 400
GLIDE = 150  # milliseconds in which a chef is seen to walk
STEPS_PER_SECOND = 6  # the same as `startingFrameRate` in config.yml
FLOOR, COUNTER, HATCH, STOVE = "#efe6d8", "#b99a74", "#4e9a68", "#5d6068"
ONION, SOUP, PLATE = "#d9a441", "#c4622d", "#fbfbf8"
CHEFS = {"you": "#2f6fb5", "partner": "#c2476b"}

Object = dict[str, object]


def draw(kitchen: Kitchen) -> dict[str, object]:
    objects = list(_room()) if kitchen.left == kitchen.steps else []
    for place, pot in kitchen.pots.items():
        objects += _pot(place, pot)
    for place, thing in kitchen.lying.items():
        objects += _thing(f"on {place}", thing, _middle(place), depth=2)
    for player, chef in kitchen.chefs.items():
        objects += _chef(player, chef)
    return {"objects": objects, "hud": f"Soups: {kitchen.soups} · {-(-kitchen.left // STEPS_PER_SECOND)} s"}


def _middle(place: Place) -> tuple[float, float]:
    return (place[0] + 0.5) * TILE, (place[1] + 0.5) * TILE


def _circle(name: str, middle: tuple[float, float], radius: float, color: str, **more: object) -> Object:
    return {"id": name, "type": "circle", "x": middle[0], "y": middle[1], "radius": radius, "color": color, **more}


def _box(name: str, x: float, y: float, width: float, height: float, color: str, **more: object) -> Object:
    size = {"width": width, "height": height}
    return {"id": name, "type": "rectangle", "x": x, "y": y, **size, "color": color, **more}


def _room() -> Iterator[Object]:
    """What never changes: floor, counters, and what is taken from there."""
    still = {"permanent": True}
    colors = {" ": FLOOR, "H": HATCH, "P": STOVE}
    for row in range(HEIGHT):
        for column in range(WIDTH):
            kind, place = LAYOUT[row][column], (column, row)
            color = colors.get(kind, COUNTER)
            yield _box(f"tile {place}", column * TILE, row * TILE, TILE + 1, TILE + 1, color, depth=-3, **still)
            x, y = _middle(place)
            if kind in "OD":
                what, radius = (ONION, 13) if kind == "O" else (PLATE, 17)
                for number, aside in enumerate((-16, 16, 0)):
                    middle = (x + aside, y + (10 if number < 2 else -12))
                    yield _circle(f"{place} {number}", middle, radius, what, outline="#7a5b24", depth=-2, **still)
            if kind == "H":
                size = {"text": "OUT", "size": 22, "color": "#ffffff", "origin": [0.5, 0.5]}
                yield {"id": f"sign {place}", "type": "text", "x": x, "y": y, **size, "depth": -2, **still}


def _pot(place: Place, pot: Pot) -> list[Object]:
    """The pot with its onions; a bar grows while it cooks, and a ready soup is bright."""
    x, y = _middle(place)
    objects = [_circle(f"pot {place}", (x, y), 30, "#2c2e34")]
    if pot.ready:
        return [*objects, _circle(f"soup {place}", (x, y), 24, SOUP, outline="#ffd9a0", outline_width=3)]
    for number in range(pot.onions):
        middle = (x + (-11, 11, 0)[number], y + (-7, -7, 11)[number])
        objects.append(_circle(f"in {place} {number}", middle, 9, ONION, depth=1))
    if pot.full:
        done = 60 * (COOK_STEPS - pot.left) / COOK_STEPS
        objects.append(_box(f"bar {place}", x - 30, y + 30, 60, 7, "#1d1e22", depth=1))
        objects.append(_box(f"done {place}", x - 30, y + 30, done, 7, "#6fd08c", depth=2))
    return objects


def _chef(player: str, chef: Chef) -> list[Object]:
    """A chef with a white hat, whose nose shows where they face; what they hold is before them."""
    x, y = _middle(chef.place)
    right, down = MOVES[chef.facing]
    glide: Object = {"tween": GLIDE}
    nose = (x + 22 * right, y + 22 * down)
    objects = [
        _circle(f"{player} nose", nose, 9, CHEFS[player], depth=4, **glide),
        _circle(f"{player} body", (x, y), 26, CHEFS[player], depth=5, **glide),
        _circle(f"{player} hat", (x, y - 3), 14, "#ffffff", depth=6, **glide),
    ]
    if chef.holds:
        hands = (x + 30 * right, y + 30 * down)
        objects += _thing(f"{player} holds", chef.holds, hands, depth=7, tween=GLIDE)
    return objects


def _thing(name: str, thing: str, middle: tuple[float, float], **more: object) -> list[Object]:
    if thing == "onion":
        return [_circle(name, middle, 13, ONION, outline="#7a5b24", **more)]
    plate = _circle(name, middle, 17, PLATE, outline="#7a5b24", **more)
    return [plate, _circle(f"{name} soup", middle, 11, SOUP, **more)] if thing == "soup" else [plate]
