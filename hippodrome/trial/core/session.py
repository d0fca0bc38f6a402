"""The participants of a trial that several play: the members of a session. Pure: it emits effects.

`Presence` knows who is here, and how long the others wait. `TrialSession` controls the trial's progress accordingly:
the game begins and goes on with all members, is held while one is missing, and then ends for all, or goes on with the
policy `trial.substitute` in the place of the missing one. `Alone` (`hippodrome/trial/core/participants.py`) has the
same methods.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any

from hippodrome.protocol.trial import TrialSection as Config
from hippodrome.trial.core import history, messages, records
from hippodrome.trial.core.effects import Effect, RecordLine, ResetPolicy, SaveAnswer, SaveMember, WriteLog
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.players import policy_seed
from hippodrome.trial.core.presence import Presence, Rules
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.records import Recordings
from hippodrome.trial.core.timing import Window

PARTNER_LEFT = (
    "Another participant left, so the game has ended for everyone. This is not your fault. Everything so far is "
    "saved. Please continue with the study."
)
PARTNER_STOPPED = (
    "Another participant ended the game, so it is over for everyone. This is not your fault. Everything so far is "
    "saved. Please continue with the study."
)
PARTNER_MISSING = (
    "Another participant did not join, so the game cannot be played. This is not your fault. Please continue "
    "with the study."
)
LEFT = (
    "You were away for too long, so the game has ended for everyone. Everything so far is saved. Please continue "
    "with the study."
)
PING = (
    "Your connection is too slow to play with others. This is not your fault: the game server may be far away, "
    "or others may be using your network. Please continue with the study."
)


NOBODY: frozenset[str] = frozenset()


class TrialSession:
    """Controls one trial by the presence of a session's members, and keeps what each of them is told and answers."""

    def __init__(
        self,
        config: Config,
        progress: TrialProgress,
        places: Mapping[str, str],
        *,
        vacant: Sequence[str],
        erased: Sequence[str],
        answered: Mapping[str, Mapping[str, Any]],
        recorded: RecordedTrial | None,
        trial_id: str,
        say_each: Callable[[Callable[[str], str | None]], None],
        recording: Recordings,
        emit: Callable[[Effect], None],
    ) -> None:
        """`places` is the player that each member plays, by the member's id.

        `vacant` are the players that a policy plays from the start. `erased` are the players of members whose data were
        erased: they count as absent from the start. `recorded` is what earlier servers have recorded. `answered` holds
        the answers of this step that some members have already, by their ids: a member whose answer says that they were
        refused does not play.

        `say_each` takes a function from a player to a sentence or None, and sends each client the sentence.
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
            (*places.values(), *erased),
            reads=bool(config.instructions) and not resumed,
            begun=resumed,
        )
        self._replaced: set[str] = set()
        """The players whose members a policy replaces now."""
        self._answered: dict[str, dict[str, Any]] = {}
        """The answers of the members for whom the trial is over, by their ids."""
        self._stopped: set[str] = set()
        """The players whose members have sent `stop`, on this server or an earlier one."""
        self._stored: set[str] = set()
        """The ids of the members whose answer is stored."""
        self._was_on_break = False  # whether there was a break at the last call of `attend`
        self._begun = resumed
        """Whether the game has begun: a member who is missing afterwards has left, and before has not come."""
        self._settled: int | None = None
        """`Presence.version` when `attend` last found the game to be on, and no break; None if it was not."""
        self._replays = recorded is not None and recorded.unfinished is not None
        """Whether an episode of an earlier server is still to be repeated. Until then no one is replaced, and the game
        does not end."""
        self._waiting: list[RecordLine] = []
        """The lines that wait for an open recording."""
        progress.choices.timed_keys = True
        for player, outcome in (recorded.outcomes if recorded is not None else {}).items():
            if player in self._humans and outcome == "ping":
                self.presence.mark_refused(player)
            elif player in self._humans and outcome == "left":
                self.presence.mark_absent(player)
            elif player in self._humans and outcome == "stopped":
                self._stopped.add(player)
        for player in erased:
            self.presence.mark_absent(player)
        for human, answers in answered.items():
            if human in places and answers.get("outcome") == "ping":
                self.presence.mark_refused(places[human])
                self._answered[human] = dict(answers)
                self._stored.add(human)

    @property
    def _plays_on(self) -> bool:
        """Whether a policy takes the place of a member who is absent or refused."""
        return self._config.after_absent == "policy" and self._config.substitute is not None

    def place_of(self, human: str) -> str:
        """Return the player whom this member plays."""
        return self._places[human]

    def name_of(self, player: str) -> str | None:
        """Return the name under which messages of this player's member are recorded: the player's."""
        return player

    # ---- what happens

    def come(self, player: str, now: float) -> None:
        """Take part from now on: the member has connected. If a policy plays in their place, they replace it."""
        if self._progress.over:
            return  # too late: each member's outcome is decided
        event = self.presence.come(player, now)
        self._take_back(player)
        self._record(player, event)

    def go(self, player: str, now: float, *, closing: bool) -> None:
        """Release the keys of a member whose connection is closed, and count them as gone. `closing` has no effect."""
        self._progress.choices.let_go(player)
        if self.presence.go(player, now):
            self._record(player, "left")

    def stalls(self, player: str, now: float) -> bool:
        """Count a member whose page has stopped answering as gone. Return False if they were gone already."""
        was_here = self.presence.stalls(player, now)
        if was_here:
            self._record_away(player)
        return was_here

    def answers_again(self, player: str, now: float) -> None:
        """Count a member whose page answers as here again, if it had stopped answering."""
        if self.presence.answers_again(player):
            self.come(player, now)

    def _hides(self, player: str, hidden: bool, now: float) -> None:
        """Count a member as gone while they look at another tab or application (`hidden`), and then as here again."""
        if not hidden and self.presence.hidden(player):
            self.come(player, now)
        elif hidden and self.presence.hides(player, now):
            self._record_away(player)

    def receive(self, player: str, message: messages.Message, window: Window, now: float) -> bool:
        """Note from a member's message that they are here or hidden. Return False if they are refused: ignore it."""
        if self.presence.over(player) == "ping":
            return False
        if message.hidden is not None:
            self._hides(player, message.hidden, now)
        if not window.stalled(now):
            self.answers_again(player, now)
        self._progress.choices.set_message_time(player, int(now * 1e9))
        return True

    def _take_back(self, player: str) -> None:
        """Give the player back to its member if a policy has replaced them and they may play again."""
        if player in self._replaced and self.presence.over(player) is None:
            self._replaced.discard(player)
            self._progress.choices.policies.give_back(player)

    def _record_away(self, player: str) -> None:
        self._progress.choices.let_go(player)
        self._record(player, "left")

    def start(self, player: str, now: float) -> None:
        """Let a member who has sent `start` go on, from a page or after a pause."""
        self.presence.goes_on(player, now)

    def stop(self, player: str) -> None:
        """Remember who ends the game for all. `Commands` ends it after the present step."""
        self._stopped.add(player)

    def stopped(self) -> None:
        """Tell the other members that the game has ended because one of them has stopped it."""
        self._say_why_over(self.presence.players)

    def pause(self, now: float) -> None:
        """Hold the game for all members."""
        self._progress.pause()
        self.presence.pauses()

    def saved(self, human: str) -> None:
        """Note that the member's answer is stored."""
        self._stored.add(human)

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """Take a sample of a member's round trip, in seconds. Once the game has begun, the sample is recorded."""
        if self._progress.over:
            return  # too late: each member's outcome is decided
        self.presence.round_trip(player, seconds, now)
        if self.presence.begun:
            self._line("ping", {"roundTrip": {player: round(seconds * 1000)}})

    # ---- what follows

    @property
    def silent(self) -> set[str]:
        """The players who cannot speak: those without a member, and those whose members are absent or refused."""
        return {*self._vacant, *(player for player in self.presence.players if self.presence.over(player))}

    def attend(self, now: float, seconds: float) -> None:
        """Hold the game, let it go on, or end it, depending on who is here; tell the members for whom it is over.

        Call it between two steps. `seconds`: the time that was played.
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
        """Hold the game, let it go on, or end it; return the players for whose members it is over now."""
        progress, presence = self._progress, self.presence
        if progress.on_break != self._was_on_break:
            self._was_on_break = progress.on_break
            if self._was_on_break:
                presence.begin_break()
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
        self._settled = presence.version if progress.playing and not self._was_on_break else None
        return over_for

    @property
    def settled(self) -> bool:
        """Whether the game is on, and no member's presence has changed since that was decided: true at most steps."""
        return self._settled == self.presence.version and self._progress.playing

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            trips = self.presence.round_trips()
            if trips:
                self._line("ping", {"roundTrip": trips})
        self._progress.start()

    def _end_or_replace(self, now: float) -> frozenset[str]:
        """If members are absent or refused, end the game or let a policy replace them. Returns as `_hold_or_go_on`."""
        presence, progress = self.presence, self._progress
        self._replays = self._replays and progress.needs_reset
        if self._replays:
            return NOBODY
        out = [player for player in presence.players if presence.over(player) and player not in self._replaced]
        refused = frozenset(player for player in out if presence.over(player) == "ping")
        for player in out:
            if player in refused:
                self._record(player, "refused")
        if out and (not self._plays_on or presence.all_refused()):
            why = "their round trip is too long" if presence.over(out[0]) == "ping" else "they stay away"
            self._emit(WriteLog(logging.INFO, f"the game ends for all without {', '.join(out)}: {why}"))
            progress.partner_left()
            return frozenset(presence.players)
        for player in out:
            self._replace(player, now)
        return refused

    def _replace(self, player: str, now: float) -> None:
        progress, substitute = self._progress, self._config.substitute
        assert substitute is not None
        self._replaced.add(player)
        progress.choices.take_place(player, substitute)
        seed = policy_seed(progress.choices.seed, player)
        self._emit(ResetPolicy(player, seed))
        ask = None if progress.needs_reset else progress.choices.ask(player, progress.steps, now)
        if ask is not None:
            self._emit(ask)
        self._emit(WriteLog(logging.INFO, f"{substitute} plays in the place of {player}"))
        self._record(player, "replaced", {"seed": seed})

    def _say_why_over(self, players: Collection[str]) -> None:
        """Send the members of these players the sentence that says why the game is over, if there is one."""
        self._say_each(lambda player: self.sentence(player) if player in players else None)

    def _save_refused(self, seconds: float) -> None:
        """Store the answers of members who were refused while the others play on: to this game and to all later games.

        So they go on at once, and never come to a later game of the session, which they could not play either.
        """
        for player in self._replaced:
            human = self._humans[player]
            if human not in self._answered and self.presence.over(player) == "ping":
                self._answered[human] = self._answer(player, seconds)
                self._emit(SaveMember(human, self._answered[human], {"outcome": "ping", "player": player}))

    # ---- recordings and answers

    def answer(self, seconds: float, *, played: bool) -> SaveAnswer:
        """Return what to store, after `seconds` of play: the answers of the members who have none yet, by their ids.

        There are none if the game could not be `played`.
        """
        missing = {human: player for human, player in self._places.items() if human not in self._answered and played}
        answers = {human: self._answer(player, seconds) for human, player in missing.items()}
        self._answered |= answers
        return SaveAnswer(None, answers)

    def has_answered(self, human: str) -> bool:
        """Whether the member's own answer is stored."""
        return human in self._stored

    def answer_of(self, human: str) -> Mapping[str, Any] | None:
        """Return the member's own answer; None if the trial is not over for them."""
        return self._answered.get(human)

    def _answer(self, player: str, seconds: float) -> dict[str, Any]:
        return records.member_answers(self._progress, player, self._outcome(player), seconds, self._trial_id)

    def outcomes(self) -> Mapping[str, str | None]:
        """Return, by player, how the trial has ended for each member; None while it goes on."""
        return {player: self._outcome(player) for player in self.presence.players}

    def _outcome(self, player: str) -> str | None:
        over, outcome = self.presence.over(player), self._progress.outcome
        if over is not None:
            return "left" if over == "absent" else "ping"
        stopped_by_another = outcome == "stopped" and self._stopped and player not in self._stopped
        return history.PARTNER_LEFT if stopped_by_another else outcome

    def reset_fields(self) -> dict[str, Any]:
        """Return further fields for the line of a reset: round trips, and the players whose members are replaced."""
        trips = self.presence.round_trips()
        replaced = sorted(self._replaced)
        return {**({"roundTrip": trips} if trips else {}), **({"standIns": replaced} if replaced else {})}

    def write_lines(self) -> None:
        """Write the lines that wait for an open recording."""
        if self._recording.is_open:
            lines, self._waiting = self._waiting, []
            for line in lines:
                self._emit(line)

    def _record(self, player: str, event: str, more: Mapping[str, Any] | None = None) -> None:
        if not self._progress.over:
            self._line("presence", {"player": player, "what": event, **(more or {})})

    def _line(self, kind: Any, fields: Mapping[str, Any]) -> None:
        where = {"episode": self._progress.episode, "step": self._progress.steps}
        self._waiting.append(RecordLine(kind, {**where, **fields}))

    # ---- what clients are told

    def wake_at(self, now: float) -> float | None:
        """Return when to call `attend` again if nothing happens before; None if there is no need.

        Do not call it once the trial is over: nobody attends then.
        """
        if self.settled:
            return None
        wake_at = self.presence.wake_at(now, on_break=self._progress.on_break)
        return wake_at if wake_at < math.inf else None

    def session_version(self) -> Hashable:
        """Return a value that changes whenever the fields about members do."""
        return self.presence.version, self._progress.choices.waits_for

    def session_fields(self, now: float) -> dict[str, Any]:
        """Return the fields about members in the messages to clients (docs/wire.md). Times are seconds from now on."""
        progress, presence = self._progress, self.presence
        reads = progress.on_break and math.isinf(self._config.between_seconds)
        fields: dict[str, Any] = {"people": presence.people(self._vacant, reads=reads, plays_on=self._plays_on)}
        if not progress.over:
            fields |= messages.seconds(beginsIn=presence.begins_in(now), heldFor=presence.held_for(now, reads=reads))
            if progress.turns is not None and progress.playing:
                fields["turnOf"] = list(progress.choices.waits_for)
        return fields

    def sentence(self, player: str) -> str | None:
        """Return the sentence that tells a member why the game is over; None if it is not, or needs no sentence."""
        over = self.presence.over(player)
        if over == "ping":
            return PING
        if not self._progress.over:
            return None
        if self._progress.outcome == "stopped" and self._outcome(player) == history.PARTNER_LEFT:
            return PARTNER_STOPPED
        if self._progress.outcome != history.PARTNER_LEFT:
            return None
        return LEFT if over == "absent" else PARTNER_LEFT if self._begun else PARTNER_MISSING
