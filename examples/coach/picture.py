"""Draws the garden, the robot, an arrow for its last move, and the last word that it heard, by objects."""

from __future__ import annotations

from garden import FLOWERS, HEIGHT, MOVES, STATION, WIDTH, Place

FIELD, TOP = 80, 100  # pixels: the side of a field, and the room for words above the garden
INK, ROBOT, ARROW, GOOD, BAD = "#26323a", "#d85438", "#1864aa", "#248244", "#b6282e"
LAWN = ("#d9ead0", "#cfe4c4")
GLIDE = 300  # milliseconds in which the robot is seen to move

Object = dict[str, object]


def draw(before: Place, place: Place, move: int | None, heard: str | None) -> list[Object]:
    """Draw the robot at `place`, to which `move` has taken it from `before`. `move` is None before the first move."""
    return [*_garden(), *_words(before, place, move, heard), *_arrow(before, place, move), *_robot(place, move)]


def _middle(place: Place) -> tuple[float, float]:
    return (place[0] + 0.5) * FIELD, TOP + (HEIGHT - place[1] - 0.5) * FIELD


def _garden() -> list[Object]:
    found: list[Object] = []
    for column in range(WIDTH):
        for row in range(HEIGHT):
            x, y = _middle((column, row))
            lawn: Object = {"type": "rectangle", "x": x, "y": y, "width": FIELD, "height": FIELD, "origin": (0.5, 0.5)}
            found.append({**lawn, "id": f"lawn {column} {row}", "color": LAWN[(column + row) % 2]})
    for place in sorted(FLOWERS):
        found += _flower(place)
    x, y = _middle(STATION)
    station: Object = {"type": "rectangle", "x": x, "y": y, "width": 66, "height": 66, "origin": (0.5, 0.5)}
    found.append({**station, "id": "station", "color": "#ffffff", "outline": INK, "outline_width": 4})
    bolt = [(x + 6, y - 24), (x - 14, y + 4), (x, y + 4), (x - 6, y + 24), (x + 14, y - 6), (x, y - 6)]
    found.append({"id": "bolt", "type": "polygon", "points": bolt, "color": "#e0a800"})
    return found


def _flower(place: Place) -> list[Object]:
    x, y = _middle(place)
    petals = ((0, -15), (14, -5), (9, 12), (-9, 12), (-14, -5))
    name = f"flower {place[0]}"
    return [
        *(
            {
                "id": f"{name} petal {number}",
                "type": "circle",
                "x": x + right,
                "y": y + down,
                "radius": 11,
                "color": "#c05a9e",
            }
            for number, (right, down) in enumerate(petals)
        ),
        {"id": name, "type": "circle", "x": x, "y": y, "radius": 9, "color": "#f3c53c"},
    ]


def _words(before: Place, place: Place, move: int | None, heard: str | None) -> list[Object]:
    if move is None:
        does = "The robot looks around"
    elif place == before:
        does = "It drove against the fence"
    else:
        does = f"It went {list(MOVES)[move]}{', into the flowers' if place in FLOWERS else ''}"
    text: Object = {"type": "text", "x": WIDTH * FIELD / 2, "origin": (0.5, 0.5), "color": INK}
    found: list[Object] = [
        {**text, "id": "question", "y": 26, "size": 24, "text": "Was that a good move?  Say good or bad."},
        {**text, "id": "does", "y": 68, "size": 32, "text": does},
    ]
    if heard:
        box: Object = {"type": "rectangle", "x": 20, "y": TOP + 20, "width": 170, "height": 50}
        found.append({**box, "id": "heard", "color": GOOD if heard == "good" else BAD, "depth": 3})
        said: Object = {**text, "x": 105, "y": TOP + 45, "size": 24, "color": "#ffffff", "depth": 4}
        found.append({**said, "id": "said", "text": f"You: {heard}"})
    return found


def _arrow(before: Place, place: Place, move: int | None) -> list[Object]:
    """Draw an arrow from the previous field towards the present one, or towards the fence that was in the way."""
    if move is None:
        return []
    right, up = list(MOVES.values())[move]
    x, y = _middle(before)
    length = FIELD - 28 if place != before else FIELD / 2  # the robot covers the rest
    tip = (x + right * length, y - up * length)
    head = (tip[0] - 22 * right, tip[1] + 22 * up)
    sides = [(head[0] + 15 * up, head[1] + 15 * right), tip, (head[0] - 15 * up, head[1] - 15 * right)]
    return [
        {"id": "way", "type": "line", "points": [(x, y), head], "width": 9, "color": ARROW, "depth": 1},
        {"id": "tip", "type": "polygon", "points": sides, "color": ARROW, "depth": 1},
    ]


def _robot(place: Place, move: int | None) -> list[Object]:
    x, y = _middle(place)
    right, up = (0, 0) if move is None else list(MOVES.values())[move]
    parts: list[Object] = [
        {"id": "robot", "radius": 27, "color": ROBOT, "outline": INK, "outline_width": 3, "x": x, "y": y},
        *(
            {"id": f"eye {side}", "radius": 6, "color": "#ffffff", "x": x + 9 * right + 9 * side, "y": y - 9 * up - 4}
            for side in (-1, 1)
        ),
    ]
    return [{**part, "type": "circle", "tween": GLIDE, "depth": 2} for part in parts]
