"""The rules: two players collect acorns in a forest, turn by turn, before the turns are over. picture.py draws them."""

from __future__ import annotations

from collections import deque
from random import Random

WIDTH, HEIGHT = 8, 6
TREES, ACORNS = 9, 8
TURNS = 36
"""The moves of both players together."""
PLAYERS = ("you", "partner")
MOVES = ((0, 0), (0, -1), (1, 0), (0, 1), (-1, 0))
"""wait, up, right, down, left: the order of actionSpace in config.yml. Rows count from the top."""

Place = tuple[int, int]
START: dict[str, Place] = {"you": (0, HEIGHT - 1), "partner": (WIDTH - 1, 0)}


class Forest:
    """One game. `turn` is the player who is to move, `left` the number of turns left. An acorn is a point for both."""

    def __init__(self, seed: int | None = None) -> None:
        chance = Random(seed)
        places = [(column, row) for column in range(WIDTH) for row in range(HEIGHT)]
        free = [place for place in places if place not in START.values()]
        while True:
            self.trees = frozenset(chance.sample(free, TREES))
            open_places = [place for place in free if place not in self.trees]
            if len(distances(START["you"], self.trees)) == len(open_places) + len(PLAYERS):
                break  # each place can be reached
        self.acorns = set(chance.sample(open_places, ACORNS))
        self.places = dict(START)
        self.turn, self.left = PLAYERS[0], TURNS

    @property
    def over(self) -> bool:
        return not self.acorns or not self.left

    def legal(self, player: str) -> list[bool]:
        """Return, for each move, whether the player can make it now."""
        other = next(place for name, place in self.places.items() if name != player)
        beside = (_beside(self.places[player], move) for move in range(len(MOVES)))
        return [inside(place) and place not in self.trees and place != other for place in beside]

    def move(self, move: int) -> float:
        """Move the player whose turn it is, if the move is legal. Return the points for it."""
        player = self.turn
        if self.legal(player)[move]:
            self.places[player] = _beside(self.places[player], move)
        self.turn = PLAYERS[1 - PLAYERS.index(player)]
        self.left -= 1
        found = self.places[player] in self.acorns
        self.acorns.discard(self.places[player])
        return float(found)


def inside(place: Place) -> bool:
    return 0 <= place[0] < WIDTH and 0 <= place[1] < HEIGHT


def distances(start: Place, trees: frozenset[Place]) -> dict[Place, int]:
    """Return the number of moves from `start` to each place that can be reached."""
    found, edge = {start: 0}, deque([start])
    while edge:
        place = edge.popleft()
        for move in range(1, len(MOVES)):
            there = _beside(place, move)
            if inside(there) and there not in trees and there not in found:
                found[there] = found[place] + 1
                edge.append(there)
    return found


def _beside(place: Place, move: int) -> Place:
    return place[0] + MOVES[move][0], place[1] + MOVES[move][1]
