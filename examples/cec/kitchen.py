"""The rules: two chefs cook onion soup in a kitchen that is a ring, where they stand in each other's way.

A pot takes three onions and cooks for a while; then the soup is taken on a plate and brought to the hatch.
"""

from __future__ import annotations

from dataclasses import dataclass

PLAYERS = ("you", "partner")
LAYOUT = (
    "##P#P##",
    "#     #",
    "O ### D",
    "#     #",
    "##H#O##",
)
"""P: pot, O: onions, D: plates, H: hatch, #: counter, on which things may lie."""
HEIGHT, WIDTH = len(LAYOUT), len(LAYOUT[0])
POT_HOLDS = 3
COOK_STEPS = 30

STAY, UP, RIGHT, DOWN, LEFT, USE = range(6)
"""The order of actionSpace in config.yml."""
MOVES = {UP: (0, -1), RIGHT: (1, 0), DOWN: (0, 1), LEFT: (-1, 0)}

Place = tuple[int, int]
"""Column and row, from the upper left corner."""


@dataclass
class Chef:
    place: Place
    facing: int = DOWN
    holds: str = ""  # onion, plate, soup, or nothing

    @property
    def ahead(self) -> Place:
        return beside(self.place, self.facing)


@dataclass
class Pot:
    onions: int = 0
    left: int = 0  # steps for which it still cooks

    @property
    def full(self) -> bool:
        return self.onions == POT_HOLDS

    @property
    def ready(self) -> bool:
        return self.full and self.left == 0


class Kitchen:
    """One round of `steps` steps."""

    def __init__(self, steps: int) -> None:
        self.steps = self.left = steps
        self.soups = 0
        self.chefs = {"you": Chef((2, 3)), "partner": Chef((4, 1))}
        self.pots = {place: Pot() for place in tiles("P")}
        self.lying: dict[Place, str] = {}  # things on counters

    def step(self, actions: dict[str, int]) -> int:
        """Let both chefs act, and the pots cook. Return how many soups were delivered."""
        before = self.soups
        self.left -= 1
        for pot in self.pots.values():
            pot.left = max(0, pot.left - 1)
        self._walk({player: actions[player] for player in PLAYERS if actions[player] in MOVES})
        for player in PLAYERS:
            if actions[player] == USE:
                self._use(self.chefs[player])
        return self.soups - before

    def _walk(self, ways: dict[str, int]) -> None:
        """Turn each chef, and move them if the tile is free. If both want the same tile, neither gets it."""
        taken = [chef.place for chef in self.chefs.values()]
        for player, way in ways.items():
            self.chefs[player].facing = way
        wanted = {player: self.chefs[player].ahead for player in ways}
        for player, place in wanted.items():
            if is_floor(place) and place not in taken and list(wanted.values()).count(place) == 1:
                self.chefs[player].place = place

    def _use(self, chef: Chef) -> None:
        """Take what is ahead, or put there what the chef holds."""
        place = chef.ahead
        match tile(place), chef.holds:
            case "O", "":
                chef.holds = "onion"
            case "D", "":
                chef.holds = "plate"
            case "P", "onion" if not self.pots[place].full:
                pot = self.pots[place]
                pot.onions += 1
                pot.left = COOK_STEPS if pot.full else 0
                chef.holds = ""
            case "P", "plate" if self.pots[place].ready:
                self.pots[place], chef.holds = Pot(), "soup"
            case "H", "soup":
                self.soups, chef.holds = self.soups + 1, ""
            case "#", "" if place in self.lying:
                chef.holds = self.lying.pop(place)
            case "#", thing if thing and place not in self.lying:
                self.lying[place], chef.holds = thing, ""


def beside(place: Place, way: int) -> Place:
    right, down = MOVES[way]
    return place[0] + right, place[1] + down


def tile(place: Place) -> str:
    column, row = place
    return LAYOUT[row][column]


def is_floor(place: Place) -> bool:
    return tile(place) == " "


def tiles(kind: str) -> list[Place]:
    return [(column, row) for row in range(HEIGHT) for column in range(WIDTH) if LAYOUT[row][column] == kind]
