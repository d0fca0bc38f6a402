"""The rules: a squirrel looks for acorns under leaves, and sees those beside it only. picture.py draws the grove."""

from __future__ import annotations

from random import Random

WIDTH, HEIGHT = 8, 6
ACORNS = 3
MOVES_LEFT = 24
MOVES = ((0, -1), (1, 0), (0, 1), (-1, 0))
"""up, right, down, left: the order of actionSpace in config.yml. Rows count from the top."""

Place = tuple[int, int]


class Grove:
    """One game. `left` is the number of moves left."""

    def __init__(self, seed: int | None = None) -> None:
        places = [(column, row) for column in range(WIDTH) for row in range(HEIGHT)]
        self.squirrel: Place = (0, HEIGHT - 1)
        far = [place for place in places if _distance(place, self.squirrel) > 2]
        self.hidden = set(Random(seed).sample(far, ACORNS))
        self.walked = {self.squirrel}
        self.left = MOVES_LEFT

    @property
    def over(self) -> bool:
        return not self.hidden or not self.left

    def seen(self) -> list[Place]:
        """Return the acorns that the squirrel sees."""
        return sorted(place for place in self.hidden if _distance(place, self.squirrel) <= 1)

    def move(self, move: int) -> float:
        """Move the squirrel, unless it is at the edge. Return the points for it."""
        column, row = (part + step for part, step in zip(self.squirrel, MOVES[move], strict=True))
        if 0 <= column < WIDTH and 0 <= row < HEIGHT:
            self.squirrel = (column, row)
        self.left -= 1
        self.walked.add(self.squirrel)
        found = self.squirrel in self.hidden
        self.hidden = self.hidden - {self.squirrel}
        return float(found)

    def in_words(self) -> str:
        """Return where everything is, for someone who sees the whole grove."""
        squirrel, left = self.squirrel, self.left
        acorns = sorted(self.hidden, key=lambda place: _distance(place, squirrel))
        ways = [f"- an acorn {_way(squirrel, place)}" for place in acorns]
        return "\n".join([f"From the squirrel, which has {left} moves left:", *(ways or ["- no acorn is left"])])


def _distance(one: Place, other: Place) -> int:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def _way(start: Place, end: Place) -> str:
    right, down = end[0] - start[0], end[1] - start[1]
    parts = [f"{abs(right)} {'right' if right > 0 else 'left'}"] if right else []
    parts += [f"{abs(down)} {'down' if down > 0 else 'up'}"] if down else []
    return " and ".join(parts)
