"""Decides which members of a session are here, how long the others wait for the missing ones, and when the game is on.

Pure. The game is on while every member is here or a policy plays in their place. Otherwise it is held. A member may be
missing for `gather` seconds before the game, and for `absent` seconds during it. This time runs while the member is
gone and another member waits. It does not run while all are gone, or while a connected member's round trip is measured.
A member who plays gets used time back, but slowly: a member who comes and goes uses their time up. Before the game
begins, and after each hold, there is a countdown. All times are seconds of one monotonic clock, which is passed in.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

Where = Literal["here", "reads", "awaited", "away", "policy"]
"""Where a member is, as clients show it. reads: connected, and still at the page before the game or between two
episodes; awaited: has not come yet, or the round trip is still being measured; away: was here, and is not any more;
policy: a policy plays in the member's place."""
MIN_ABSENCE = 3.0
"""The least time that one absence uses up, in seconds; a third of `absent` (before the game: of `gather`) if that is
less. So a member who comes and goes, and so causes one countdown after the other, soon uses their time up."""
GIVEN_BACK = 0.25
"""The used time that a member gets back for each second of play, in seconds."""
MEASURED_SECONDS = 20.0
"""The most seconds for which a member's round trip is measured. After them, the samples so far decide."""
Over = Literal["absent", "ping"]
"""Why a member does not play any more. absent: missing for too long; ping: their round trip is too long."""


@dataclass(slots=True)
class _Countdown:
    """A number of seconds that count down while the countdown runs."""

    left: float
    """The seconds that were left when it last stopped."""
    until: float | None = None
    """The time at which the countdown is over; None if it does not run."""

    def run(self, now: float, seconds: float) -> None:
        """Count down `seconds` from now on. It changes nothing if the countdown runs already."""
        if self.until is None:
            self.until = now + seconds

    def stop(self, now: float, least: float = 0.0) -> None:
        """Stop it, if it runs, and keep the seconds that are left: at least `least` fewer than `left` was before."""
        if self.until is not None:
            self.left, self.until = max(0.0, min(self.until - now, self.left - least)), None

    def is_over(self, now: float) -> bool:
        return self.until is not None and now >= self.until


@dataclass(slots=True)
class _Member:
    player: str
    samples: deque[float]
    waiting: _Countdown
    """The time for which the others still wait for the member. The countdown runs while they wait."""
    measured: bool
    """Whether the member's round trip is known, or need not be."""
    measuring: _Countdown = field(default_factory=lambda: _Countdown(MEASURED_SECONDS))
    """The time for which the member's round trip may still be measured. The countdown runs while it is measured."""
    connected: bool = False
    stalled: bool = False
    """Their page has stopped answering."""
    hidden: bool = False
    """They look at another tab or application."""
    has_come: bool = False
    """They have connected at least once."""
    gone_on: bool = False
    """They have gone on from the page before the game or between two episodes."""
    over: Over | None = None
    counted: bool = False
    """Whether the others have waited during the member's present absence: then what was left stays, however little."""

    @property
    def takes_part(self) -> bool:
        """Whether the member is connected, with a page that answers and that they look at, and is not refused."""
        return self.connected and not self.stalled and not self.hidden and self.over != "ping"

    @property
    def here(self) -> bool:
        return self.takes_part and self.measured

    @property
    def missing(self) -> bool:
        return self.over is None and not self.here

    @property
    def gone(self) -> bool:
        """Whether the others wait for the member to come or come back. A member who is being measured is not gone."""
        return self.over is None and not self.takes_part

    @property
    def is_measured_now(self) -> bool:
        """Whether the member is connected and their round trip is being measured."""
        return self.over is None and self.takes_part and not self.measured


@dataclass(frozen=True, slots=True)
class Rules:
    """The project's keys about presence: `max_ping` in milliseconds, `ping_samples` a count, the others in seconds."""

    absent: float
    gather: float
    countdown: float
    max_ping: float
    ping_samples: int


@dataclass(slots=True)
class Presence:
    """The presence of all members of a session, by their player."""

    rules: Rules
    players: Sequence[str]
    """The players of the members."""
    reads: bool
    """Whether there is a page before the game: the game begins when all members have gone on from it."""
    begun: bool
    """Whether the game has begun, here or on an earlier server. From then on `max_ping` is not applied."""
    paused: bool = False
    """Whether a member has paused the game."""
    version: int = 0
    """A number that changes whenever the fields about members in clients' messages change."""
    _members: dict[str, _Member] = field(init=False)
    _counts_until: float | None = None
    _page_until: float | None = None
    _on_since: float | None = None
    """When the game went on, or when used time was last given back, whichever is later; None while it is held."""

    def __post_init__(self) -> None:
        left, samples = self.rules.absent if self.begun else self.rules.gather, self.rules.ping_samples
        measured = self.begun or not self.rules.max_ping
        self._members = {
            name: _Member(name, deque(maxlen=samples), _Countdown(left), measured) for name in self.players
        }

    # ---- what happens

    def come(self, player: str, now: float) -> Literal["joined", "returned"]:
        """Mark a member as connected. They play again even if they had been missing for too long.

        Return whether it was their first connection (`joined`) or not (`returned`).
        """
        self._give_time_back(now)
        member = self._members[player]
        returned, member.has_come = member.has_come, True
        member.connected, member.stalled, member.hidden = True, False, False
        if member.over == "absent":
            member.over = None
        self._changed(now)
        return "returned" if returned else "joined"

    def go(self, player: str, now: float) -> bool:
        """Mark a member whose connection is closed as gone. Return False if they were away already."""
        self._give_time_back(now)
        member = self._members[player]
        member.connected = False
        self._changed(now)
        return not member.stalled and not member.hidden

    def stalls(self, player: str, now: float) -> bool:
        """Mark a member whose page has stopped answering as away. Return False if they were away already."""
        member = self._members[player]
        return self._mark_away(member, now, stalled=True, hidden=member.hidden)

    def hides(self, player: str, now: float) -> bool:
        """Mark a member who looks at another tab or application as away. Return False if they were away already."""
        member = self._members[player]
        return self._mark_away(member, now, stalled=member.stalled, hidden=True)

    def _mark_away(self, member: _Member, now: float, *, stalled: bool, hidden: bool) -> bool:
        self._give_time_back(now)
        was_here = not member.stalled and not member.hidden
        member.stalled, member.hidden = stalled, hidden
        if was_here:
            self._changed(now)
        return was_here

    def answers_again(self, player: str) -> bool:
        """Note that a member's page answers. Return whether that makes them present again; then call `come`."""
        member = self._members[player]
        if member.hidden:
            member.stalled = False
        return member.stalled

    def hidden(self, player: str) -> bool:
        """Whether the member looks at another tab or application."""
        return self._members[player].hidden

    def goes_on(self, player: str, now: float) -> None:
        """Let a member go on from the page before the game or between two episodes, or end the pause."""
        self._members[player].gone_on = True
        self.paused = False
        if self._page_until is None:
            self._page_until = now + self.rules.gather
        self._changed(now)

    def pauses(self) -> None:
        """Pause the game for all members, until any of them goes on."""
        self.paused = True

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """Take a sample of a member's round trip: their browser has answered a ping after `seconds`.

        Before the game, the median of the first `ping_samples` decides whether the member may play. A member is refused
        as soon as more than half of the samples must be too long.
        """
        member, rules = self._members[player], self.rules
        member.samples.append(seconds)
        if member.measured:
            return
        too_long = self._too_long(member) > rules.ping_samples // 2
        if too_long or len(member.samples) == rules.ping_samples:
            member.measured = True
            if too_long or _median(member.samples) * 1000 > rules.max_ping:
                member.over = "ping"
            self._changed(now)

    def _too_long(self, member: _Member) -> int:
        return sum(sample * 1000 > self.rules.max_ping for sample in member.samples)

    def begin_break(self) -> None:
        """Begin a break: no member has gone on from its page yet."""
        self._page_until = None
        for member in self._members.values():
            member.gone_on = False
        self._tell()

    def mark_refused(self, player: str) -> None:
        """Refuse a member, because an earlier server or game has found their round trip too long."""
        self._members[player].over = "ping"

    def mark_absent(self, player: str) -> None:
        """Count a member as absent: they stayed away on an earlier server, or their data were erased."""
        self._members[player].over = "absent"

    # ---- what follows

    def look(self, now: float) -> None:
        """Mark members who have been missing for too long as absent, and end measurements that take too long.

        A member whose measurement takes too long is refused if more than half of their samples so far are too long, or
        if there are none. So one slow answer of several refuses no one.
        """
        members = self._members.values()
        absent = [member for member in members if member.waiting.is_over(now)]
        for member in absent:
            member.over = "absent"
        decided = [member for member in members if member.measuring.is_over(now)]
        for member in decided:
            member.measured = True
            if not member.samples or self._too_long(member) > len(member.samples) // 2:
                member.over = "ping"
        if absent or decided:
            self._changed(now)

    def may_play(self, now: float, *, on: bool) -> bool:
        """Return whether the game may be on now. If it is not `on` and no member is missing, the countdown begins."""
        if not self.complete or self.paused or self._held_by_page(now):
            self._give_time_back(now)
            self._on_since = None
            if self._counts_until is not None:
                self._counts_until = None
                self._tell()
            return False
        if on:
            return True
        if self._counts_until is None:
            self._counts_until = now + self.rules.countdown
            self._tell()
        if now < self._counts_until:
            return False
        self._counts_until, self._on_since = None, now
        for member in self._members.values():
            member.measured = True
            if not self.begun:
                member.waiting.left = self.rules.absent
        self.begun, self.reads = True, False
        self._tell()
        return True

    @property
    def complete(self) -> bool:
        """Whether at least one member is here, and none is missing."""
        members = self._members.values()
        return any(member.here for member in members) and not any(member.missing for member in members)

    @property
    def waits(self) -> bool:
        """Whether at least one member takes part, and so may be waiting for the others."""
        return any(member.takes_part for member in self._members.values())

    def all_gone_on(self, now: float) -> bool:
        """Whether all members who are here have gone on from the page, or `gather` seconds are over since the first."""
        if self._page_until is None:
            return False
        return now >= self._page_until or all(member.gone_on for member in self._members.values() if member.here)

    def _held_by_page(self, now: float) -> bool:
        return self.reads and not self.all_gone_on(now)

    def time_left(self, player: str) -> float:
        """Return the seconds for which the others would wait if the member left now; 0 if that time is used up."""
        left = self._members[player].waiting.left
        return left if left >= self._least else 0.0

    def over(self, player: str) -> Over | None:
        """Return why the member does not play any more; None if they play."""
        return self._members[player].over

    def all_refused(self) -> bool:
        """Whether every member is refused because of their round trip."""
        return all(member.over == "ping" for member in self._members.values())

    # ---- what clients are told

    def people(self, vacant: Iterable[str], *, reads: bool, plays_on: bool) -> dict[str, Where]:
        """Return where each player is. `vacant` are the players that policies play from the start.

        `reads`: members are at a page between two episodes. `plays_on`: a policy takes the place of a member who is
        absent or refused.
        """
        page = reads or self.reads
        return {
            **{member.player: _where(member, page, plays_on) for member in self._members.values()},
            **dict.fromkeys(vacant, "policy"),
        }

    def begins_in(self, now: float) -> float | None:
        """Return the seconds of the countdown that are left; None if it does not run."""
        return None if self._counts_until is None else max(0.0, self._counts_until - now)

    def held_for(self, now: float, *, reads: bool) -> float | None:
        """Return the seconds until the members stop waiting for one another; None if no one waits.

        `reads` as in `people`.
        """
        until = self._until(now, reads=reads)
        return None if until == math.inf else max(0.0, until - now)

    def wake_at(self, now: float, *, on_break: bool) -> float:
        """Return when to call `look` and `may_play` again if nothing happens before; infinity if there is no need."""
        counts = math.inf if self._counts_until is None else self._counts_until
        members = self._members.values()
        measuring = [member.measuring.until for member in members if member.measuring.until is not None]
        return min(self._until(now, reads=on_break), counts, *measuring)

    def round_trips(self) -> dict[str, int]:
        """Return, by player, the median of the last `ping_samples` round trips in milliseconds, if there are any."""
        members = self._members.values()
        return {member.player: round(_median(member.samples) * 1000) for member in members if member.samples}

    def _until(self, now: float, *, reads: bool) -> float:
        members = self._members.values()
        ends = [member.waiting.until for member in members if member.waiting.until is not None]
        page = self._page_until
        if (reads or self.reads) and page is not None and not self.all_gone_on(now):
            ends.append(page)
        return min(ends, default=math.inf)

    def _tell(self) -> None:
        """Let clients be sent the fields about members again, since these have changed."""
        self.version += 1

    def _changed(self, now: float) -> None:
        """Start and stop the countdowns of all members, after a member's presence has changed."""
        self._tell()
        waits = self.waits
        for member in self._members.values():
            if member.gone and waits:
                member.waiting.run(now, member.waiting.left if member.counted else self.time_left(member.player))
                member.counted = True
            elif member.gone:
                member.waiting.stop(now)
            else:
                member.waiting.stop(now, self._least)
                member.counted = False
            if member.is_measured_now:
                member.measuring.run(now, member.measuring.left)
            else:
                member.measuring.stop(now)

    @property
    def _least(self) -> float:
        """The least time that one absence uses up now: see `MIN_ABSENCE`."""
        return min(MIN_ABSENCE, (self.rules.absent if self.begun else self.rules.gather) / 3)

    def _give_time_back(self, now: float) -> None:
        """Give members who have played since the last call some of their used time back. Call it before a change."""
        if self._on_since is None:
            return
        played, self._on_since = now - self._on_since, now
        for member in self._members.values():
            if member.here:
                member.waiting.left = min(self.rules.absent, member.waiting.left + GIVEN_BACK * played)


def _where(member: _Member, page: bool, plays_on: bool) -> Where:
    if member.over is not None:
        return "policy" if plays_on else "away"
    if member.here:
        return "reads" if page and not member.gone_on else "here"
    return "away" if member.has_come and not member.takes_part else "awaited"


def _median(samples: Iterable[float]) -> float:
    ordered = sorted(samples)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
