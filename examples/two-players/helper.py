"""The policy that plays in the place of a participant who is not there."""

from __future__ import annotations

from typing import Any

from lanterns import MOVES, PLAYERS, Place, distances

WAITS_EVERY = 3
"""The helper waits at every third step, so that it is no faster than people."""


class Helper:
    """Goes to the plate of `plate_of`, supposing that the other player takes the shortest way to the other plate."""

    def __init__(self, player: str) -> None:
        self._player = player

    def reset(self, seed: int) -> None:
        self._steps = 0

    def act(self, observation: dict[str, Any], info: dict[str, Any]) -> int:
        self._steps += 1
        if self._steps % WAITS_EVERY == 0:
            return 0
        return step_towards(observation, plate_of(observation, self._player))


def plate_of(observation: dict[str, Any], player: str) -> Place:
    """Return the plate that this player should take, so that both plates are reached as soon as possible.

    If it makes no difference, red takes the first plate: otherwise two helpers might both go to the same one.
    """
    me, other, hedges = observation["me"], observation["other"], observation["hedges"]
    first, second = observation["plates"]

    def moves(mine: Place, theirs: Place) -> tuple[int, int]:
        own, others = distances(mine, hedges)[me], distances(theirs, hedges)[other]
        return max(own, others), own + others

    plates = (first, second) if player == PLAYERS[0] else (second, first)
    return min(plates, key=lambda mine: moves(mine, second if mine == first else first))


def step_towards(observation: dict[str, Any], plate: Place) -> int:
    """Return the move after which the plate is nearest. On the plate the helper waits."""
    away = distances(plate, observation["hedges"])
    column, row = observation["me"]
    reached = {move: (column + x, row + y) for move, (x, y) in enumerate(MOVES)}
    return min((move for move in reached if reached[move] in away), key=lambda move: (away[reached[move]], move))
