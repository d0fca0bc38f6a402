"""The garden: a robot drives to its station, around the flowers. The rules, without a picture and without Gymnasium."""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 8, 5
START, STATION = (0, 0), (7, 0)
FLOWERS = frozenset((column, 0) for column in range(1, 7))
"""The flowers lie on the straight way from START to STATION."""
MOVES = {"up": (0, 1), "right": (1, 0), "down": (0, -1), "left": (-1, 0)}
AT_STATION, ON_FLOWERS = 5.0, -1.0
LONGEST = 40
"""The number of steps after which an episode ends."""

Place = tuple[int, int]


class Garden:
    def reset(self) -> Place:
        self.place, self.steps = START, 0
        return self.place

    def step(self, move: int) -> tuple[Place, float, bool, bool]:
        """Drive to the next field; the fence stops the robot. Return place, reward, terminated and truncated."""
        self.steps += 1
        self.place = beside(self.place, move)
        reward = AT_STATION if self.place == STATION else ON_FLOWERS if self.place in FLOWERS else 0.0
        return self.place, reward, self.place == STATION, self.steps >= LONGEST


def beside(place: Place, move: int) -> Place:
    """Return the place to which a move leads."""
    right, up = list(MOVES.values())[move]
    return min(max(place[0] + right, 0), WIDTH - 1), min(max(place[1] + up, 0), HEIGHT - 1)


def features(place: Place) -> np.ndarray:
    """Return the features of a place: its field, its column and its row.

    So what the robot learns on one field also counts a little in the same column and row.
    """
    found = np.zeros(WIDTH * HEIGHT + WIDTH + HEIGHT)
    column, row = place
    found[row * WIDTH + column] = 1
    found[WIDTH * HEIGHT + column] = found[WIDTH * HEIGHT + WIDTH + row] = 0.5
    return found
