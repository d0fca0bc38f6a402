"""The rules: two players light a lantern whenever each stands on one of the two plates. picture.py draws them."""

from __future__ import annotations

from collections import deque
from random import Random

WIDTH, HEIGHT = 9, 6
HEDGES, LANTERNS = 9, 12
APART = 4
"""The least number of moves from one plate to the other."""
PLAYERS = ("red", "blue")
MOVES = ((0, 0), (0, -1), (1, 0), (0, 1), (-1, 0))
"""wait, up, right, down, left: the order of actionSpace in config.yml. Rows count from the top."""

Place = tuple[int, int]
START: dict[str, Place] = {"red": (0, HEIGHT - 1), "blue": (WIDTH - 1, 0)}


class Garden:
    """One round. Players may pass each other, and stand on the same field. Either of them may take either plate."""

    def __init__(self, seed: int | None = None) -> None:
        self._chance = Random(seed)
        places = [(column, row) for column in range(WIDTH) for row in range(HEIGHT)]
        free = [place for place in places if place not in START.values()]
        while True:
            self.hedges = frozenset(self._chance.sample(free, HEDGES))
            self._open = [place for place in places if place not in self.hedges]
            if len(distances(START["red"], self.hedges)) == len(self._open):
                break  # each field can be reached
        self.places = dict(START)
        self.lit = 0
        self.plates = self._next_plates()

    @property
    def over(self) -> bool:
        return self.lit == LANTERNS

    @property
    def occupied_plates(self) -> set[Place]:
        """The plates on which a player stands."""
        return set(self.plates) & set(self.places.values())

    def move(self, moves: dict[str, int]) -> float:
        """Move both players at once. Return 1 if they have lit a lantern, else 0."""
        for player, move in moves.items():
            column, row = self.places[player]
            there = column + MOVES[move][0], row + MOVES[move][1]
            if inside(there) and there not in self.hedges:
                self.places[player] = there
        if self.over or self.occupied_plates != set(self.plates):
            return 0.0
        self.lit += 1
        self.plates = self._next_plates()
        return 1.0

    def _next_plates(self) -> tuple[Place, Place]:
        """Return two fields on which no player stands, at least APART moves from each other."""
        free = [place for place in self._open if place not in self.places.values()]
        while True:
            first, second = self._chance.sample(free, 2)
            if distances(first, self.hedges)[second] >= APART:
                return first, second


def inside(place: Place) -> bool:
    return 0 <= place[0] < WIDTH and 0 <= place[1] < HEIGHT


def distances(start: Place, hedges: frozenset[Place]) -> dict[Place, int]:
    """Return the number of moves from `start` to each field that can be reached."""
    found, edge = {start: 0}, deque([start])
    while edge:
        place = edge.popleft()
        for column, row in MOVES[1:]:
            there = place[0] + column, place[1] + row
            if inside(there) and there not in hedges and there not in found:
                found[there] = found[place] + 1
                edge.append(there)
    return found
