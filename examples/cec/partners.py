"""Seven partners by rules. Each decides anew at every step from what it sees, and remembers nothing.

They differ in what they do, not in how well they know the kitchen: so they stand for the seven trained agents of the
study, and are none of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from random import Random
from typing import Any

from kitchen import MOVES, POT_HOLDS, STAY, USE, Chef, Place, beside, is_floor, tiles

Seen = dict[str, Any]
"""`me`, `other` (Chef), `pots`, `lying`, `left` (steps of the round): agent.py makes it."""


class Cook:
    """Does whatever is needed most, and walks around the other chef."""

    def act(self, observation: Seen, info: Seen) -> int:
        for places in self.wanted(observation):
            action = towards(observation["me"], places, self.closed(observation))
            if action is not None:
                return action
        return self.rest(observation)

    def wanted(self, seen: Seen) -> Iterator[list[Place]]:
        """Yield places to use, the most wanted first."""
        yield from plates(seen)
        yield from onions(seen)

    def rest(self, seen: Seen) -> int:
        """Go out of the other chef's way."""
        return aside(seen["me"], seen["other"])

    def closed(self, seen: Seen) -> list[Place]:
        """The places through which this chef does not walk."""
        return [seen["other"].place]


class Onions(Cook):
    """Only fills the pots."""

    def wanted(self, seen: Seen) -> Iterator[list[Place]]:
        yield from onions(seen)


class Plates(Cook):
    """Only brings soups out."""

    def wanted(self, seen: Seen) -> Iterator[list[Place]]:
        yield from plates(seen)


class Helper(Cook):
    """Does what the other chef is not doing."""

    def wanted(self, seen: Seen) -> Iterator[list[Place]]:
        if seen["other"].holds == "onion":
            yield from plates(seen)
            yield from onions(seen)
        else:
            yield from onions(seen)
            yield from plates(seen)


class Slow(Cook):
    """Acts at every third step."""

    def act(self, observation: Seen, info: Seen) -> int:
        return super().act(observation, info) if observation["left"] % 3 == 0 else STAY


class Stubborn(Cook):
    """Walks the shortest way as if nobody else were there, and waits until the other chef has gone."""

    def closed(self, seen: Seen) -> list[Place]:
        return []

    def rest(self, seen: Seen) -> int:
        return STAY


class Fickle(Cook):
    """Walks about by chance for a third of the time."""

    def act(self, observation: Seen, info: Seen) -> int:
        chance = Random(f"{observation['seed']} {observation['left'] // 4}")
        return chance.choice(list(MOVES)) if chance.random() < 1 / 3 else super().act(observation, info)


def onions(seen: Seen) -> Iterator[list[Place]]:
    """The places to use next, for a chef who fills pots."""
    open_pots = [place for place, pot in seen["pots"].items() if not pot.full]
    fullest = max((seen["pots"][place].onions for place in open_pots), default=0)
    match seen["me"].holds:
        case "onion" if open_pots:
            yield [place for place in open_pots if seen["pots"][place].onions == fullest]
        case "":
            missing = sum(POT_HOLDS - seen["pots"][place].onions for place in open_pots)
            if missing > (seen["other"].holds == "onion"):
                yield tiles("O") + [place for place, thing in seen["lying"].items() if thing == "onion"]


def plates(seen: Seen) -> Iterator[list[Place]]:
    """The places to use next, for a chef who brings soups out."""
    full = [place for place, pot in seen["pots"].items() if pot.full]
    match seen["me"].holds:
        case "soup":
            yield tiles("H")
        case "plate" if full:
            least = min(seen["pots"][place].left for place in full)
            yield [place for place in full if seen["pots"][place].left == least]
        case "onion" if full:
            yield [place for place in tiles("#") if place not in seen["lying"]]  # the hands are needed
        case "":
            soups = [place for place, thing in seen["lying"].items() if thing == "soup"]
            if soups:
                yield soups
            if len(full) > (seen["other"].holds == "plate"):
                yield tiles("D") + [place for place, thing in seen["lying"].items() if thing == "plate"]


def towards(me: Chef, places: Iterable[Place], closed: Iterable[Place]) -> int | None:
    """Return the action that uses the nearest of the places, or goes there; None if there is no way."""
    places, seen = set(places), {me.place, *closed}
    if me.ahead in places:
        return USE  # at a pot that still cooks, a plate does nothing
    ways: deque[tuple[Place, int | None]] = deque([(me.place, None)])
    while ways:
        place, first = ways.popleft()
        for way in MOVES:
            ahead = beside(place, way)
            if ahead in places:
                return way if first is None else first
            if is_floor(ahead) and ahead not in seen:
                seen.add(ahead)
                ways.append((ahead, way if first is None else first))
    return None


def aside(me: Chef, other: Chef) -> int:
    """Return the step that leads away from a chef who stands close; STAY if there is none, or nobody is close."""

    def away(place: Place) -> int:
        return abs(place[0] - other.place[0]) + abs(place[1] - other.place[1])

    ways = [way for way in MOVES if is_floor(beside(me.place, way)) and away(beside(me.place, way)) > away(me.place)]
    return ways[0] if ways and away(me.place) <= 2 else STAY
