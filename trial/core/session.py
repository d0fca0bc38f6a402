"""A trial that several participants play: a session. `Alone` (`trial/core/participants.py`) decides the same for one.

`Presence` knows who is here, and for how long the others wait. This brings the trial's progress into line with it: the
game begins and goes on with all members, is held while one is missing, and then ends for all, or goes on with
`trial.substitute` in the place.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any

from protocol.trial import TrialSection as Config
from trial.core import messages, records
from trial.core.effects import Effect, RecordLine, ResetPolicy, SaveAnswer, SaveMember, WriteLog
from trial.core.flow_control import Window
from trial.core.presence import Presence, Rules, outcomes
from trial.core.progress import TrialProgress
from trial.core.recording import Recordings
from trial.core.seeds import policy_seed
from trial.core.unfinished import RecordedTrial

PARTNER_LEFT = (
    "Another participant has gone and has not come back, so the game ends here for all. "
    "That is not your fault, and what you have played is kept. Please continue."
)
PARTNER_STOPPED = (
    "Another participant has ended the game, so it ends here for all. "
    "That is not your fault, and what you have played is kept. Please continue."
)
PARTNER_MISSING = (
    "Another participant has not come, so the game cannot be played together. That is not your fault. Please continue."
)
LEFT = (
    "You were away for longer than the others could wait, so the game has ended for all. "
    "What you have played is kept. Please continue."
)
PING = (
    "Your connection to the game is too slow for a game with others. That is not your fault: "
    "it may be far from here, or shared with many. Please continue."
)


PARTNER = "partnerLeft"
"""The outcome of those for whom the game has ended because of another."""
NOBODY: frozenset[str] = frozenset()


class TrialSession:
    """The members of a session in one trial. `places` says which player each of them plays, by their id."""

    def __init__(
        self,
        config: Config,
        progress: TrialProgress,
        places: Mapping[str, str],
        *,
        vacant: Sequence[str],
        gone: Sequence[str],
        answered: Mapping[str, Mapping[str, Any]],
        recorded: RecordedTrial | None,
        trial_id: str,
        say_each: Callable[[Callable[[str], str | None]], None],
        recording: Recordings,
        emit: Callable[[Effect], None],
    ) -> None:
        """In the places of `vacant` a policy plays from the start. Those of `gone` are of members who never come back:
        the game is over for all once what was played of it stands. `recorded` is what earlier servers have recorded.
        `answered` are the answers of this step that some members have: who was refused, here or in an earlier game,
        does not play.

        `say_each` tells each client what a function has for its player.
        """
        self._places = places
        self._trial_id = trial_id
        self._say_each = say_each
        self._recording = recording
        self._config = config
        self._vacant = tuple(vacant)
        self._progress = progress
        self._emit = emit
        self._humans = {player: human for human, player in places.items()}
        resumed = recorded is not None and recorded.begun
        self.presence = Presence(
            Rules(config.absent, config.gather, config.countdown, config.max_ping, config.ping_samples),
            (*places.values(), *gone),
            reads=bool(config.instructions) and not resumed,
            begun=resumed,
        )
        self._replaced: set[str] = set()
        """Members in whose place a policy plays."""
        self._answered: dict[str, dict[str, Any]] = {}
        """The answers of those members for whom the trial is over, by their id."""
        self._stopped: set[str] = set()
        """Members who have ended the game for all. Empty: it was not ended so, or on an earlier server."""
        self._stored: set[str] = set()
        """Members whose answer is stored, by their id."""
        self._broke = False  # a break was on when `attend` was called last
        self._met = resumed  # the game has begun, so that a member who is missing has left
        self._settled: int | None = None  # the `version` of the members with which the game was last found to be on
        self._replays = recorded is not None and recorded.unfinished is not None
        """An episode of an earlier server is still to be repeated: until then nothing is over."""
        self._waiting: list[RecordLine] = []
        progress.choices.timed_keys = True
        for player, outcome in (recorded.outcomes if recorded is not None else {}).items():
            if player in self._humans and outcome == "ping":
                self.presence.refused(player)
            elif player in self._humans and outcome == "left":
                self.presence.has_left(player)
            elif player in self._humans and outcome == "stopped":
                self._stopped.add(player)
        for player in gone:
            self.presence.has_left(player)
        for human, answers in answered.items():
            if human in places and answers.get("outcome") == "ping":
                self.presence.refused(places[human])
                self._answered[human] = dict(answers)
                self._stored.add(human)

    @property
    def _plays_on(self) -> bool:
        """A policy takes the place of a member who stays away."""
        return self._config.after_absent == "policy" and self._config.substitute is not None

    def place_of(self, human: str) -> str:
        """The player whom this member plays."""
        return self._places[human]

    def name_of(self, player: str) -> str | None:
        """What the recording calls the member who plays this player."""
        return player

    # ---- what happens

    def come(self, player: str, now: float) -> None:
        """The member has connected. If a policy plays in their place, they play again from the next step on."""
        if self._progress.over:
            return  # too late: the outcomes stand
        what = self.presence.come(player, now)
        self._takes_back(player)
        self._record(player, what)

    def go(self, player: str, now: float, *, closing: bool) -> None:
        """The member has left, or the server is `closing`: let go of their keys."""
        self._progress.choices.let_go(player)
        self.presence.go(player, now)
        self._record(player, "left")

    def stalls(self, player: str, now: float) -> bool:
        """The member's page has stopped answering: treat them as gone. Return whether they were here until now."""
        new = self.presence.stalls(player, now)
        if new:
            self._turned_away(player)
        return new

    def answers_again(self, player: str, now: float) -> None:
        """The member's page answers again, if it did not."""
        if self.presence.answers_again(player):
            self.come(player, now)

    def _hides(self, player: str, hidden: bool, now: float) -> None:
        """The member looks at another page, as if they had gone; or at the game again."""
        if not hidden and self.presence.hidden(player):
            self.come(player, now)
        elif hidden and self.presence.hides(player, now):
            self._turned_away(player)

    def receive(self, player: str, message: messages.Message, window: Window, now: float) -> bool:
        """A message has come. Return whether it is read: not if the member's round trip was too long."""
        if self.presence.over(player) == "ping":
            return False
        if message.hidden is not None:
            self._hides(player, message.hidden, now)
        if not window.stalled(now):
            self.answers_again(player, now)
        self._progress.choices.said_at(player, int(now * 1e9))
        return True

    def _takes_back(self, player: str) -> None:
        """If a policy plays for a member who is waited for again, they play from now on."""
        if player in self._replaced and self.presence.over(player) is None:
            self._replaced.discard(player)
            self._progress.choices.policies.give_back(player)

    def _turned_away(self, player: str) -> None:
        self._progress.choices.let_go(player)
        self._record(player, "left")

    def start(self, player: str, now: float) -> None:
        """The member goes on: from a page, or after a pause."""
        self.presence.goes_on(player, now)

    def stop(self, player: str) -> None:
        """A member ends the game for all, after the step that is being taken."""
        self._stopped.add(player)

    def stopped(self) -> None:
        """The game has ended because a member has stopped it: tell the others."""
        self._say_why_over(self.presence.players)

    def pause(self, now: float) -> None:
        """A member holds the game for all."""
        self._progress.pause()
        self.presence.pauses()

    def saved(self, human: str) -> None:
        """The member's answer is stored."""
        self._stored.add(human)

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """The member's browser has answered a ping. During the game it is recorded."""
        if self._progress.over:
            return  # too late: the outcomes stand
        self.presence.round_trip(player, seconds, now)
        if self.presence.begun:
            self._line("ping", {"roundTrip": {player: round(seconds * 1000)}})

    # ---- what follows

    def attend(self, now: float, seconds: float) -> None:
        """Hold the game, or let it go on, as the members are there; tell those for whom it is over. Not during a step.

        `seconds` were played.
        """
        if not self.settled:
            over_for = self._hold_or_go_on(now)
            if over_for:
                self._say_why_over(over_for)
        if self._replaced:
            self._save_refused(seconds)
        if self._waiting:
            self.write_lines()

    def _hold_or_go_on(self, now: float) -> frozenset[str]:
        """Hold the game, let it go on, or end it, as the members are there; the players for whom it is over now."""
        progress, presence = self._progress, self.presence
        if progress.on_break != self._broke:
            self._broke = progress.on_break
            if self._broke:
                presence.page()
        presence.look(now)
        over_for = NOBODY if progress.over else self._end_or_replace(now)
        if progress.over:
            pass
        elif progress.on_break:
            if presence.all_gone_on(now):
                progress.start()
        elif not presence.may_play(now, on=progress.playing):
            progress.hold()
        elif not progress.playing:
            self._begin()
        self._settled = presence.version if progress.playing and not self._broke else None
        return over_for

    @property
    def settled(self) -> bool:
        """Whether the game is on, and nothing has changed since that was decided, as at most steps."""
        return self._settled == self.presence.version and self._progress.playing

    def _begin(self) -> None:
        if not self._met:
            self._met = True
            trips = self.presence.round_trips()
            if trips:
                self._line("ping", {"roundTrip": trips})
        self._progress.start()

    def _end_or_replace(self, now: float) -> frozenset[str]:
        presence, progress = self.presence, self._progress
        self._replays = self._replays and progress.needs_reset
        if self._replays:
            return NOBODY
        gone = [player for player in presence.players if presence.over(player) and player not in self._replaced]
        refused = frozenset(player for player in gone if presence.over(player) == "ping")
        for player in gone:
            if player in refused:
                self._record(player, "refused")
        if gone and (not self._plays_on or presence.all_refused()):
            why = "their round trip is too long" if presence.over(gone[0]) == "ping" else "they stay away"
            self._emit(WriteLog(logging.INFO, f"the game ends for all without {', '.join(gone)}: {why}"))
            progress.partner_left()
            return frozenset(presence.players)
        for player in gone:
            self._replace(player, now)
        return refused

    def _replace(self, player: str, now: float) -> None:
        progress, plays = self._progress, self._config.substitute
        assert plays is not None
        self._replaced.add(player)
        progress.choices.take_place(player, plays)
        seed = policy_seed(progress.choices.seed, player)
        self._emit(ResetPolicy(player, seed))
        ask = None if progress.needs_reset else progress.choices.ask(player, progress.steps, now)
        if ask is not None:
            self._emit(ask)
        self._emit(WriteLog(logging.INFO, f"{plays} plays in the place of {player}"))
        self._record(player, "replaced", {"seed": seed})

    def _say_why_over(self, players: Collection[str]) -> None:
        """Say in words why the game is over to the clients of these players, if that needs words."""
        self._say_each(lambda player: self.sentence(player) if player in players else None)

    def _save_refused(self, seconds: float) -> None:
        """Store the answers of members who were refused while the others play on: of this game and of later ones.

        They come to a later game before the others, who still play, and from the same place.
        """
        for player in self._replaced:
            human = self._humans[player]
            if human not in self._answered and self.presence.over(player) == "ping":
                self._answered[human] = self._answer(player, seconds)
                self._emit(SaveMember(human, self._answered[human], {"outcome": "ping", "player": player}))

    # ---- recordings and answers

    def answer(self, seconds: float, *, played: bool) -> SaveAnswer:
        """What to store: by id, the answers of the members for whom the trial is over only now.

        `seconds` were played. Without answers if the game could not be `played`.
        """
        left = {human: player for human, player in self._places.items() if human not in self._answered and played}
        found = {human: self._answer(player, seconds) for human, player in left.items()}
        self._answered |= found
        return SaveAnswer(None, found)

    def has_answered(self, human: str) -> bool:
        """Whether the member's answer is stored."""
        return human in self._stored

    def answer_of(self, human: str) -> Mapping[str, Any] | None:
        """The member's own answer, once there is one."""
        return self._answered.get(human)

    def _answer(self, player: str, seconds: float) -> dict[str, Any]:
        return records.member_answers(self._progress, player, self.outcomes()[player], seconds, self._trial_id)

    def outcomes(self) -> Mapping[str, str | None]:
        """By player, how the trial has ended for each member."""
        found = outcomes(self.presence, self._progress.outcome)
        return {player: self._outcome(player, outcome) for player, outcome in found.items()}

    def _outcome(self, player: str, outcome: str | None) -> str | None:
        """If a member has ended the game, it has ended for the others because of them."""
        return PARTNER if outcome == "stopped" and self._stopped and player not in self._stopped else outcome

    def of_reset(self) -> dict[str, Any]:
        """Further fields for the line of a reset."""
        trips = self.presence.round_trips()
        replaced = sorted(self._replaced)
        return {**({"roundTrip": trips} if trips else {}), **({"standIns": replaced} if replaced else {})}

    def write_lines(self) -> None:
        """Write the lines that wait for an open recording."""
        if self._recording.is_open:
            lines, self._waiting = self._waiting, []
            for line in lines:
                self._emit(line)

    def _record(self, player: str, what: str, more: Mapping[str, Any] | None = None) -> None:
        if not self._progress.over:
            self._line("presence", {"player": player, "what": what, **(more or {})})

    def _line(self, kind: Any, fields: Mapping[str, Any]) -> None:
        where = {"episode": self._progress.episode, "step": self._progress.steps}
        self._waiting.append(RecordLine(kind, {**where, **fields}))

    # ---- what members are told

    def wake_at(self, now: float) -> float | None:
        """When to call `attend` again if nothing happens; None if there is no need to."""
        progress = self._progress
        if progress.over or self.settled:
            return None
        wake_at = self.presence.wake_at(now, on_break=progress.on_break)
        return wake_at if wake_at < math.inf else None

    def state(self) -> Hashable:
        """A value that changes whenever members are to be told of each other again."""
        return self.presence.version, self._progress.choices.waits_for

    def told(self, now: float) -> dict[str, Any]:
        """What all members are told of each other. Seconds are those that are left."""
        progress, presence = self._progress, self.presence
        reads = progress.on_break and math.isinf(self._config.between_seconds)
        said: dict[str, Any] = {"people": presence.people(self._vacant, reads=reads, plays_on=self._plays_on)}
        if not progress.over:
            times = {"beginsIn": presence.begins_in(now), "heldFor": presence.held_for(now, reads=reads)}
            said |= {name: round(left, 3) for name, left in times.items() if left is not None}
            if progress.turns is not None and progress.playing:
                said["turnOf"] = list(progress.choices.waits_for)
        return said

    def sentence(self, player: str) -> str | None:
        """The words that tell this member why the game is over; None if it is not, or if no words are needed."""
        over = self.presence.over(player)
        if over == "ping":
            return PING
        if not self._progress.over:
            return None
        if self._progress.outcome == "stopped" and self.outcomes()[player] == PARTNER:
            return PARTNER_STOPPED
        if self._progress.outcome != PARTNER:
            return None
        return LEFT if over == "absent" else PARTNER_LEFT if self._met else PARTNER_MISSING
