"""Players that are no humans: what each of them was asked, and the action that it takes. Pure; the clock is passed in.

In real time a policy is asked after each step at which it is to act (every `frameSkip` steps) and has until the next
one; one that is late takes its last action again, and what comes late counts at the step after. Turn by turn it has
`policySeconds`, then the idle action is taken. A policy that fails idles for the step, one that fails `FAILURES` times
in a row for the rest of the episode.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from trial.core.actions import Action, By
from trial.core.players import Mask, Player, View, is_legal, legal_or_idle

FAILURES = 3
"""Failures in a row after which a policy is asked no more in the episode."""


@dataclass(frozen=True, slots=True)
class Observed:
    """What a policy saw when it chose its action."""

    observation: Any
    info: Any
    mask: Mask | None


@dataclass(frozen=True, slots=True)
class AskPolicy:
    """Ask the player's policy for an action; answered with `policy_acted` or `policy_failed`."""

    player: str
    ask_id: int
    observation: Any
    info: Any
    mask: Mask | None


class _Place:
    """One player's place, and how far its policy is."""

    def __init__(self, player: Player) -> None:
        self.player = player
        self.begin()

    def begin(self) -> None:
        self.asked: int | None = None  # the ask that has not been answered
        self.asked_at = 0.0
        self.asked_after = 0  # steps
        self.due = False  # it is to be asked as soon as it is to act
        self.mask: Mask | None = None
        self.answer: int | None = None
        self.failed = False  # since the last step
        self.failures = 0
        self.last: int | None = None
        self.late = 0

    @property
    def idles(self) -> bool:
        return self.failures >= FAILURES


class Policies:
    """All players of a trial that are no humans. `goes_on`: between two turns of `frame_skip` the last action acts."""

    def __init__(
        self, players: Iterable[Player], *, frame_skip: int = 1, seconds: float | None = None, goes_on: bool = True
    ) -> None:
        self._places = {player.name: _Place(player) for player in players}
        self._frame_skip = frame_skip
        self._seconds = seconds
        """With turns: how long a policy may think."""
        self._goes_on = goes_on
        self._asks = 0

    def __bool__(self) -> bool:
        return bool(self._places)

    def __contains__(self, player: str) -> bool:
        return player in self._places

    @property
    def asked(self) -> tuple[Player, ...]:
        """The players whose policies are asked: all but those that a program plays."""
        return tuple(place.player for place in self._places.values() if not place.player.by_program)

    def begin(self) -> None:
        """An episode begins."""
        for place in self._places.values():
            place.begin()

    def go_on(self, actions: Mapping[str, int], failures: Mapping[str, int]) -> None:
        """The episode goes on where an earlier server left it.

        `actions`: what each policy chose last, which is taken until it chooses again. `failures`: how often each has
        failed in a row.
        """
        for player, count in failures.items():
            if player in self._places:
                self._places[player].failures = count
        for player, action in actions.items():
            if player in self._places:
                self._places[player].last = action

    def take_place(self, player: Player) -> None:
        """From now on a policy plays for this player."""
        self._places[player.name] = _Place(player)

    def give_back(self, player: str) -> None:
        """The policy does not play for this player any more; its late answers change nothing."""
        self._places.pop(player, None)

    def late(self) -> dict[str, int]:
        """By player, in how many steps of the episode its policy was late."""
        return {name: place.late for name, place in self._places.items() if place.late}

    def asks(self, view: View, steps: int, now: float) -> list[AskPolicy]:
        """What to ask the policies after `steps` steps of the episode."""
        due = self._seconds is not None or steps % self._frame_skip == 0
        found = []
        for name, place in self._places.items():
            if place.player.by_program or place.idles:
                continue
            place.due = place.due or due
            if name not in view.to_act or not place.due:
                continue
            place.due = False
            if self._seconds is None and (place.asked is not None or place.answer is not None):
                continue  # it still thinks, or what came late is taken first
            found.append(self.ask(name, view, steps, now))
        return found

    def ask(self, player: str, view: View, steps: int, now: float) -> AskPolicy:
        """What to ask this player's policy now."""
        place = self._places[player]
        self._asks += 1
        place.asked, place.asked_at, place.asked_after, place.answer = self._asks, now, steps, None
        place.mask = view.masks.get(player)
        return AskPolicy(player, self._asks, view.observations.get(player), view.infos.get(player), place.mask)

    def acted(self, player: str, ask_id: int, action: Any) -> str | None:
        """The policy has answered. Return what is wrong with the answer; None if it is right, or came too late."""
        place = self._places.get(player)
        if place is None or place.asked != ask_id:
            return None
        try:
            index = operator.index(action)
        except TypeError:
            self.failed(player, ask_id)
            return f"its action is of the type {type(action).__name__}, not a whole number"
        count = len(place.player.action_space)
        if not 0 <= index < count:
            self.failed(player, ask_id)
            return f"it chose action {str(index)[:20]}, but the actions are 0 to {count - 1}"
        if not is_legal(index, place.mask):
            self.failed(player, ask_id)
            return f"it chose action {index}, which the environment's action mask forbids"
        place.asked, place.answer, place.failures = None, index, 0
        return None

    def failed(self, player: str, ask_id: int) -> bool:
        """The policy has raised an error. Return whether its answer was awaited."""
        place = self._places.get(player)
        if place is None or place.asked != ask_id:
            return False
        place.asked, place.answer, place.last = None, None, None
        place.failed = True
        place.failures += 1
        return True

    def idles(self, player: str) -> bool:
        """Whether the policy is not asked any more in this episode."""
        return self._places[player].idles

    def advise(self, player: str, action: int) -> None:
        """A program chooses the action of the next step."""
        place = self._places[player]
        place.answer = action

    def take(self, name: str, mask: Mask | None, steps: int) -> Action:
        """The player's action of the step that begins now, in real time; `steps` were taken before."""
        place = self._places[name]
        player, failed = place.player, place.failed
        place.failed = False
        by: By
        looked = place.asked_after if failed else None
        if place.answer is not None:
            return self._answered(place, mask)
        if failed or place.idles or (player.by_program and place.last is None):
            index, by = player.idle, "none"
        elif place.asked is not None or player.by_program:
            place.late += 1
            index, by = self._last(place), "late"
        else:
            index, by = self._last(place), "policy" if self._goes_on and place.last is not None else "none"
        index = legal_or_idle(index, player, mask)
        return Action(index, player.action_space[index], by, looked)

    def _last(self, place: _Place) -> int:
        return place.last if self._goes_on and place.last is not None else place.player.idle

    def _answered(self, place: _Place, mask: Mask | None) -> Action:
        player, chosen = place.player, place.answer
        assert chosen is not None
        place.answer = None
        index = legal_or_idle(chosen, player, mask)
        place.last = index
        by: By = "advice" if player.by_program else "policy" if index == chosen else "none"
        return Action(index, player.action_space[index], by, None if player.by_program else place.asked_after)

    def choice(self, name: str, mask: Mask | None, now: float) -> Action | None:
        """The player's action of this turn; None if the game waits for it."""
        place = self._places[name]
        player = place.player
        if place.answer is not None:
            return self._answered(place, mask)
        if place.failed or place.idles:
            looked, place.failed = place.asked_after if place.failed else None, False
            return _idle(player, mask, "none", looked)
        if now < self._until(place):
            return None
        place.late += 1
        if place.asked is None:
            return _idle(player, mask, "late")
        place.asked = None
        place.failures += 1
        return _idle(player, mask, "late", place.asked_after)  # it has observed this all the same, and may remember it

    def turn(self, to_act: frozenset[str], now: float) -> None:
        """A turn begins: programs have their time from now on. What was chosen before does not count."""
        for name, place in self._places.items():
            if name in to_act and place.player.by_program:
                place.asked_at, place.answer = now, None

    def until(self, waiting: Sequence[str]) -> float | None:
        """When the time for the answers of these players is over; None if none of them is a policy."""
        return min((self._until(self._places[name]) for name in waiting if name in self._places), default=None)

    def _until(self, place: _Place) -> float:
        return place.asked_at + (self._seconds or 0.0)


def _idle(player: Player, mask: Mask | None, by: By, observed: int | None = None) -> Action:
    index = legal_or_idle(player.idle, player, mask)
    return Action(index, player.action_space[index], by, observed)
