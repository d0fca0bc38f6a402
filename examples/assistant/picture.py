"""Draws the grove, by objects: leaves, the fields that the squirrel has walked, and the acorns that it sees."""

from __future__ import annotations

from grove import ACORNS, HEIGHT, WIDTH, Grove, Place

FIELD = 80  # pixels: the side of a field
LEAVES, WALKED = ("#b9cf9c", "#adc58e"), ("#efe6d2", "#e8ddc4")
GLIDE = 200  # milliseconds in which the squirrel is seen to move

Object = dict[str, object]


def draw(grove: Grove) -> dict[str, object]:
    objects: list[Object] = [_field((column, row), grove) for column in range(WIDTH) for row in range(HEIGHT)]
    for place in grove.seen():
        objects += _acorn(place)
    objects += _squirrel(grove.squirrel)
    found = ACORNS - len(grove.hidden)
    return {"objects": objects, "hud": f"{found} of {ACORNS} acorns, {grove.left} moves left"}


def _middle(place: Place) -> tuple[float, float]:
    return (place[0] + 0.5) * FIELD, (place[1] + 0.5) * FIELD


def _field(place: Place, grove: Grove) -> Object:
    color = (WALKED if place in grove.walked else LEAVES)[sum(place) % 2]
    corner = {"x": place[0] * FIELD, "y": place[1] * FIELD}
    return {"id": f"field {place}", "type": "rectangle", **corner, "width": FIELD, "height": FIELD, "color": color}


def _acorn(place: Place) -> list[Object]:
    x, y = _middle(place)
    cap = [(x - 17, y - 3), (x - 12, y - 15), (x, y - 19), (x + 12, y - 15), (x + 17, y - 3)]
    nut = [(x - 14, y - 3), (x + 14, y - 3), (x + 9, y + 13), (x, y + 21), (x - 9, y + 13)]
    return [
        {"id": f"nut {place}", "type": "polygon", "points": nut, "color": "#c98f4a", "depth": 1},
        {"id": f"cap {place}", "type": "polygon", "points": cap, "color": "#7a5230", "depth": 1},
    ]


def _squirrel(place: Place) -> list[Object]:
    x, y = _middle(place)
    parts = (
        ("tail", -20, -2, 17, "#a4471d"),
        ("body", 3, 8, 20, "#c2592a"),
        ("head", 16, -15, 13, "#c2592a"),
        ("ear", 12, -28, 5, "#a4471d"),
        ("belly", 8, 11, 11, "#f3dcc3"),
        ("eye", 20, -18, 3, "#1d1d1d"),
    )
    return [
        {"id": name, "type": "circle", "x": x + right, "y": y + down, "radius": radius, "color": color}
        | {"depth": 2, "tween": GLIDE}
        for name, right, down, radius, color in parts
    ]
