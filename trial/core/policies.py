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
    """What a policy acted upon."""

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


class _Seat:
    """One player, and how far its policy is."""

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
        self._seats = {player.name: _Seat(player) for player in players}
        self._frame_skip = frame_skip
        self._seconds = seconds
        """With turns: how long a policy may think."""
        self._goes_on = goes_on
        self._asks = 0

    def __bool__(self) -> bool:
        return bool(self._seats)

    def __contains__(self, player: str) -> bool:
        return player in self._seats

    @property
    def asked(self) -> tuple[Player, ...]:
        """Those that are asked; all but the ones that a program plays."""
        return tuple(seat.player for seat in self._seats.values() if not seat.player.by_program)

    def begin(self) -> None:
        """An episode begins."""
        for seat in self._seats.values():
            seat.begin()

    def go_on(self, actions: Mapping[str, int]) -> None:
        """The episode goes on where an earlier server left it: these actions of policies go on until the next ones."""
        for player, action in actions.items():
            if player in self._seats:
                self._seats[player].last = action

    def late(self) -> dict[str, int]:
        """How many steps of the episode found a policy late, by player."""
        return {name: seat.late for name, seat in self._seats.items() if seat.late}

    def asks(self, view: View, steps: int, now: float) -> list[AskPolicy]:
        """What is to be asked now that `steps` steps of the episode were taken."""
        due = self._seconds is not None or steps % self._frame_skip == 0
        found = []
        for name, seat in self._seats.items():
            if seat.player.by_program or seat.idles:
                continue
            seat.due = seat.due or due
            if name not in view.to_act or not seat.due:
                continue
            seat.due = False
            if self._seconds is None and (seat.asked is not None or seat.answer is not None):
                continue  # it still thinks, or what came late is taken first
            self._asks += 1
            seat.asked, seat.asked_at, seat.asked_after, seat.answer = self._asks, now, steps, None
            seat.mask = view.masks.get(name)
            found.append(AskPolicy(name, self._asks, view.observations.get(name), view.infos.get(name), seat.mask))
        return found

    def acted(self, player: str, ask_id: int, action: Any) -> str | None:
        """The policy has answered. What is wrong with the answer, in words; None if nothing is, or nobody waits."""
        seat = self._seats.get(player)
        if seat is None or seat.asked != ask_id:
            return None
        try:
            index = operator.index(action)
        except TypeError:
            self.failed(player, ask_id)
            return f"its action is of the type {type(action).__name__}, not a whole number"
        count = len(seat.player.action_space)
        if not 0 <= index < count:
            self.failed(player, ask_id)
            return f"it chose action {str(index)[:20]}, but the actions are 0 to {count - 1}"
        if not is_legal(index, seat.mask):
            self.failed(player, ask_id)
            return f"it chose action {index}, which the environment's action mask forbids"
        seat.asked, seat.answer, seat.failures = None, index, 0
        return None

    def failed(self, player: str, ask_id: int) -> bool:
        """The policy has raised an error; whether anything waits for this answer."""
        seat = self._seats.get(player)
        if seat is None or seat.asked != ask_id:
            return False
        seat.asked, seat.answer, seat.last = None, None, None
        seat.failed = True
        seat.failures += 1
        return True

    def idles(self, player: str) -> bool:
        """Whether the policy is asked no more in this episode."""
        return self._seats[player].idles

    def advise(self, player: str, action: int) -> None:
        """A program chooses the action of the next step."""
        seat = self._seats[player]
        seat.answer = action

    def take(self, name: str, mask: Mask | None, steps: int) -> Action:
        """The player's action of the step that begins now, in real time; `steps` were taken before."""
        seat = self._seats[name]
        player, failed = seat.player, seat.failed
        seat.failed = False
        by: By
        looked = seat.asked_after if failed else None
        if seat.answer is not None:
            return self._answered(seat, mask)
        if failed or seat.idles or (player.by_program and seat.last is None):
            index, by = player.idle, "none"
        elif seat.asked is not None or player.by_program:
            seat.late += 1
            index, by = self._last(seat), "late"
        else:
            index, by = self._last(seat), "policy" if self._goes_on and seat.last is not None else "none"
        index = legal_or_idle(index, player, mask)
        return Action(index, player.action_space[index], by, looked)

    def _last(self, seat: _Seat) -> int:
        return seat.last if self._goes_on and seat.last is not None else seat.player.idle

    def _answered(self, seat: _Seat, mask: Mask | None) -> Action:
        player, chosen = seat.player, seat.answer
        assert chosen is not None
        seat.answer = None
        index = legal_or_idle(chosen, player, mask)
        seat.last = index
        by: By = "advice" if player.by_program else "policy" if index == chosen else "none"
        return Action(index, player.action_space[index], by, None if player.by_program else seat.asked_after)

    def choice(self, name: str, mask: Mask | None, now: float) -> Action | None:
        """The player's action of this turn; None if the game waits for it."""
        seat = self._seats[name]
        player = seat.player
        if seat.answer is not None:
            return self._answered(seat, mask)
        if seat.failed or seat.idles:
            looked, seat.failed = seat.asked_after if seat.failed else None, False
            return _idle(player, mask, "none", looked)
        if now < self._until(seat):
            return None
        seat.late += 1
        if seat.asked is None:
            return _idle(player, mask, "late")
        seat.asked = None
        seat.failures += 1
        return _idle(player, mask, "late", seat.asked_after)  # it looks all the same, and remembers that

    def turn(self, to_act: frozenset[str], now: float) -> None:
        """A turn begins: programs have their time from now on, and nothing counts that was chosen before."""
        for name, seat in self._seats.items():
            if name in to_act and seat.player.by_program:
                seat.asked_at, seat.answer = now, None

    def until(self, waiting: Sequence[str]) -> float | None:
        """When the time of one of these players is over; None if none of them is a policy."""
        return min((self._until(self._seats[name]) for name in waiting if name in self._seats), default=None)

    def _until(self, seat: _Seat) -> float:
        return seat.asked_at + (self._seconds or 0.0)


def _idle(player: Player, mask: Mask | None, by: By, observed: int | None = None) -> Action:
    index = legal_or_idle(player.idle, player, mask)
    return Action(index, player.action_space[index], by, observed)
