"""The policies: what each was asked, and which action its player takes. Pure; the clock is passed in.

In real time a policy is asked every `frameSkip` steps, if it is to act, and should answer before the next step. If it
is late, its player takes the last action again (`policyActions: single`: the idle action), and a late answer counts at
the following step. Turn by turn a policy
has `policySeconds`; after them, its player takes the idle action. The player of a policy that fails takes the idle
action in that step; after `FAILURES` failures in a row, in all steps until the episode is over.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hippodrome.trial.core.players import Action, By, Mask, Player, View, is_legal, legal_or_idle

FAILURES = 3
"""Failures in a row after which a policy is asked no more in the episode."""


@dataclass(frozen=True, slots=True)
class Observed:
    """The input with which a policy chose an action (observation, info and action mask), and the action's number.

    `action` is None if the policy failed or was late, or if its action had become illegal.
    """

    observation: Any
    info: Any
    mask: Mask | None
    action: int | None


@dataclass(frozen=True, slots=True)
class AskPolicy:
    """Ask the player's policy for an action; answered with `policy_acted` or `policy_failed`."""

    player: str
    ask_id: int
    observation: Any
    info: Any
    mask: Mask | None


class _Place:
    """A player that a policy plays, and the state of that policy in this episode."""

    def __init__(self, player: Player) -> None:
        self.player = player
        self.begin()

    def begin(self) -> None:
        self.asked: int | None = None  # the `ask_id` of the question that is not answered yet
        self.asked_at = 0.0
        self.asked_after = 0  # the number of steps before the last question
        self.due = False  # whether it is to be asked as soon as the player is to act
        self.mask: Mask | None = None
        self.answer: int | None = None  # the action that no step has taken yet
        self.failed = False  # whether it has failed since the last step
        self.failures = 0  # the number of failures in a row
        self.last: int | None = None  # the last action that the policy chose
        self.late = 0  # the number of steps at which it was late

    @property
    def idles(self) -> bool:
        return self.failures >= FAILURES


class Policies:
    """The policies of all players that no human plays."""

    def __init__(
        self, players: Iterable[Player], *, frame_skip: int, seconds: float | None, repeats_last: bool
    ) -> None:
        """`players` are the players that policies play.

        `seconds`: turn by turn, how long a policy may take; None: real time.
        `repeats_last`: at steps for which a policy has chosen no action, its last action is taken again.
        """
        self._places = {player.name: _Place(player) for player in players}
        self._frame_skip = frame_skip
        self._seconds = seconds
        self._repeats_last = repeats_last
        self._asks = 0

    def __bool__(self) -> bool:
        return bool(self._places)

    def __contains__(self, player: str) -> bool:
        return player in self._places

    @property
    def asked(self) -> tuple[Player, ...]:
        """The players whose policies are asked by `AskPolicy`: all but those that a program plays."""
        return tuple(place.player for place in self._places.values() if not place.player.by_program)

    def begin(self) -> None:
        """Forget the questions, answers and failures of the episode before."""
        for place in self._places.values():
            place.begin()

    def resume(self, actions: Mapping[str, int], failures: Mapping[str, int]) -> None:
        """Continue an episode where an earlier server left it.

        By player: `actions` are the last choices of policies, which act until these choose again; `failures` is how
        often each policy has failed in a row.
        """
        for player, count in failures.items():
            if player in self._places:
                self._places[player].failures = count
        for player, action in actions.items():
            if player in self._places:
                self._places[player].last = action

    def take_place(self, player: Player) -> None:
        """Let a policy play for this player from now on."""
        self._places[player.name] = _Place(player)

    def give_back(self, player: str) -> None:
        """Let the human play this player again. Late answers of the policy change nothing."""
        self._places.pop(player, None)

    def late(self) -> dict[str, int]:
        """Return, by player, the number of steps of the episode at which its policy was late, if there are any."""
        return {name: place.late for name, place in self._places.items() if place.late}

    def asks(self, view: View, steps: int, now: float) -> list[AskPolicy]:
        """Return the questions to policies that are due after `steps` steps of the episode."""
        due = self._seconds is not None or steps % self._frame_skip == 0
        questions = []
        for name, place in self._places.items():
            if place.player.by_program or place.idles:
                continue
            place.due = place.due or due
            if name not in view.to_act or not place.due:
                continue
            place.due = False
            if self._seconds is None and (place.asked is not None or place.answer is not None):
                continue  # it has not answered yet, or the next step takes its late answer first
            questions.append(self.ask(name, view, steps, now))
        return questions

    def ask(self, player: str, view: View, steps: int, now: float) -> AskPolicy:
        """Return a question to this player's policy. An earlier question does not count any more."""
        place = self._places[player]
        self._asks += 1
        place.asked, place.asked_at, place.asked_after, place.answer = self._asks, now, steps, None
        place.mask = view.masks.get(player)
        return AskPolicy(player, self._asks, view.observations.get(player), view.infos.get(player), place.mask)

    def acted(self, player: str, ask_id: int, action: Any) -> str | None:
        """Take a policy's answer. Return its mistake in words; None if it is valid or answers an earlier question."""
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
        """Count a policy's error, if it was asked this question last. Return whether it was."""
        place = self._places.get(player)
        if place is None or place.asked != ask_id:
            return False
        place.asked, place.answer, place.last = None, None, None
        place.failed = True
        place.failures += 1
        return True

    def plays(self, player: str) -> str:
        """Return the policy that plays this player now, as `Player.plays` names it."""
        return self._places[player].player.plays

    def idles(self, player: str) -> bool:
        """Whether the policy has failed `FAILURES` times in a row, and is not asked any more in this episode."""
        return self._places[player].idles

    def advise(self, player: str, action: int) -> None:
        """Choose this player's next action for the program that plays it."""
        self._places[player].answer = action

    def take(self, name: str, mask: Mask | None) -> Action:
        """Return the player's action for the step that begins now, in real time."""
        place = self._places[name]
        player, failed = place.player, place.failed
        place.failed = False
        by: By
        observed = place.asked_after if failed else None
        if place.answer is not None:
            return self._answered(place, mask)
        if failed or place.idles or (player.by_program and place.last is None):
            index, by = player.idle, "none"
        elif place.asked is not None or player.by_program:
            place.late += 1
            index, by = self._last(place), "late"
        else:
            index, by = self._last(place), "policy" if self._repeats_last and place.last is not None else "none"
        index = legal_or_idle(index, player, mask)
        return Action(index, player.action_space[index], by, observed)

    def _last(self, place: _Place) -> int:
        return place.last if self._repeats_last and place.last is not None else place.player.idle

    def _answered(self, place: _Place, mask: Mask | None) -> Action:
        player, chosen = place.player, place.answer
        assert chosen is not None
        place.answer = None
        index = legal_or_idle(chosen, player, mask)
        place.last = index
        by: By = "advice" if player.by_program else "policy" if index == chosen else "none"
        return Action(index, player.action_space[index], by, None if player.by_program else place.asked_after)

    def choice(self, name: str, mask: Mask | None, now: float) -> Action | None:
        """Return the player's action in this turn; None if its policy may still choose."""
        place = self._places[name]
        player = place.player
        if place.answer is not None:
            return self._answered(place, mask)
        if place.failed or place.idles:
            observed, place.failed = place.asked_after if place.failed else None, False
            return _idle(player, mask, "none", observed)
        if now < self._until(place):
            return None
        place.late += 1
        if place.asked is None:
            return _idle(player, mask, "late")
        place.asked = None
        place.failures += 1
        # The policy has seen the observation of that step, and may remember it.
        return _idle(player, mask, "late", place.asked_after)

    def turn(self, to_act: frozenset[str], now: float) -> None:
        """Begin a turn: the time of programs runs from now on, and what they chose before does not count."""
        for name, place in self._places.items():
            if name in to_act and place.player.by_program:
                place.asked_at, place.answer = now, None

    def until(self, waiting: Sequence[str]) -> float | None:
        """Return when the first of these players' policies runs out of time; None if no policy plays any of them."""
        return min((self._until(self._places[name]) for name in waiting if name in self._places), default=None)

    def _until(self, place: _Place) -> float:
        return place.asked_at + (self._seconds or 0.0)


def _idle(player: Player, mask: Mask | None, by: By, observed: int | None = None) -> Action:
    index = legal_or_idle(player.idle, player, mask)
    return Action(index, player.action_space[index], by, observed)
