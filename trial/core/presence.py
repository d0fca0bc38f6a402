"""Who of a session's members is here, how long the others wait for the rest, and when the game may go on. Pure.

The game goes on while every member is here, or a policy plays in their place. Otherwise it is held. A member may be
missing for `gather` seconds before the game, and then for `absent` seconds. This time runs while another member waits,
and stops while all are gone, or while the member is here and their round trip is measured. A member who plays gets used
time back little by little, so a member who comes and goes cannot hold the others for ever. Before the game begins, and
after each hold, there is a countdown. All times are seconds of one monotonic clock, which is passed in.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Where = Literal["here", "reads", "awaited", "away", "policy"]
"""What the others are told of a player. reads: here, but still at the page before the game or between two episodes;
awaited: has not come yet; away: was here."""
LEAST_ABSENCE = 3.0
"""An absence uses at least so many seconds, or a third of `absent` (before the game: of `gather`) if that is less.
After it the countdown begins anew."""
GIVEN_BACK = 0.25
"""For each second of play, a member gets so many seconds of used time back."""
MEASURED_SECONDS = 20.0
"""The most seconds in which a member's round trip is measured. Then the samples so far decide."""
Over = Literal["absent", "ping"]
"""Why a member does not play any more: their time is over, or their round trip is too long."""


@dataclass(slots=True)
class _Countdown:
    """Seconds that count down while it runs."""

    left: float
    until: float | None = None
    """When they are over; None: it does not run. Meanwhile `left` stays what it was."""

    def run(self, now: float, seconds: float) -> None:
        """So many seconds count down from now on, unless it runs already."""
        if self.until is None:
            self.until = now + seconds

    def stop(self, now: float, least: float = 0.0) -> None:
        """Keep what is left. Having run uses up `least` seconds at least."""
        if self.until is not None:
            self.left, self.until = max(0.0, min(self.until - now, self.left - least)), None

    def is_over(self, now: float) -> bool:
        return self.until is not None and now >= self.until


@dataclass(slots=True)
class _Member:
    player: str
    samples: deque[float]
    waiting: _Countdown
    """How long the others wait for them. It runs while they do."""
    measured: bool
    measuring: _Countdown = field(default_factory=lambda: _Countdown(MEASURED_SECONDS))
    """How long their round trip may be measured. It runs while it is."""
    connected: bool = False
    stalled: bool = False
    hidden: bool = False
    met: bool = False
    gone_on: bool = False
    over: Over | None = None

    @property
    def takes_part(self) -> bool:
        return self.connected and not self.stalled and not self.hidden and self.over != "ping"

    @property
    def here(self) -> bool:
        return self.takes_part and self.measured

    @property
    def missing(self) -> bool:
        return self.over is None and not self.here

    @property
    def gone(self) -> bool:
        """The others wait for them, at most while `waiting` runs. Who is here and is still measured is not gone."""
        return self.over is None and not self.takes_part

    @property
    def is_measured_now(self) -> bool:
        """They are here, and their round trip is not known yet. That takes `MEASURED_SECONDS` at most."""
        return self.over is None and self.takes_part and not self.measured


@dataclass(frozen=True, slots=True)
class Rules:
    """The project's numbers for presence, in the units of config.yml: seconds and milliseconds."""

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
    """Those of the members, in their order."""
    reads: bool
    """There is a page to read: the game begins when all have gone on from it."""
    begun: bool
    """The game has begun, here or on an earlier server: round trips are not compared with `max_ping` any more."""
    paused: bool = False
    """A member has paused the game."""
    version: int = 0
    """Changes whenever something changes that members are told."""
    _members: dict[str, _Member] = field(init=False)
    _counts_until: float | None = None
    _page_until: float | None = None
    _on_since: float | None = None
    """The game is on since then."""

    def __post_init__(self) -> None:
        left, samples = self.rules.absent if self.begun else self.rules.gather, self.rules.ping_samples
        measured = self.begun or not self.rules.max_ping
        self._members = {
            name: _Member(name, deque(maxlen=samples), _Countdown(left), measured) for name in self.players
        }

    # ---- what happens

    def come(self, player: str, now: float) -> Literal["joined", "returned"]:
        """The member has connected. If their time was over, they play again."""
        self._give_time_back(now)
        member = self._members[player]
        returned, member.met = member.met, True
        member.connected, member.stalled, member.hidden = True, False, False
        if member.over == "absent":
            member.over = None
        self._changed(now)
        return "returned" if returned else "joined"

    def go(self, player: str, now: float) -> None:
        """The member's connection is closed."""
        self._give_time_back(now)
        self._members[player].connected = False
        self._changed(now)

    def stalls(self, player: str, now: float) -> bool:
        """The member's page has stopped answering. Return whether they were here until now."""
        member = self._members[player]
        return self._turns_away(member, now, stalled=True, hidden=member.hidden)

    def hides(self, player: str, now: float) -> bool:
        """The member looks at another page. Return whether they were here until now."""
        member = self._members[player]
        return self._turns_away(member, now, stalled=member.stalled, hidden=True)

    def _turns_away(self, member: _Member, now: float, *, stalled: bool, hidden: bool) -> bool:
        self._give_time_back(now)
        new = not member.stalled and not member.hidden
        member.stalled, member.hidden = stalled, hidden
        if new:
            self._changed(now)
        return new

    def answers_again(self, player: str) -> bool:
        """The member's page answers. Return whether they were away because it did not: then call `come`."""
        member = self._members[player]
        if member.hidden:
            member.stalled = False
        return member.stalled

    def hidden(self, player: str) -> bool:
        """Whether the member looks at another page."""
        return self._members[player].hidden

    def goes_on(self, player: str, now: float) -> None:
        """The member goes on from the page, and from a pause."""
        self._members[player].gone_on = True
        self.paused = False
        if self._page_until is None:
            self._page_until = now + self.rules.gather
        self._changed(now)

    def pauses(self) -> None:
        """A member pauses the game, until any of them goes on."""
        self.paused = True

    def round_trip(self, player: str, seconds: float, now: float) -> None:
        """The member's browser has answered a ping. Before the game, the first samples decide whether they may play.

        Whoever has more than half of them too long is refused at once.
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
        return sum(each * 1000 > self.rules.max_ping for each in member.samples)

    def page(self) -> None:
        """A break begins: no member has gone on from it yet."""
        self._page_until = None
        for member in self._members.values():
            member.gone_on = False
        self._tell()

    def refused(self, player: str) -> None:
        """An earlier server has refused the member, because their round trip took too long."""
        self._members[player].over = "ping"

    def has_left(self, player: str) -> None:
        """An earlier server has ended the game, because the member stayed away."""
        self._members[player].over = "absent"

    # ---- what follows

    def look(self, now: float) -> None:
        """The others wait no longer for those whose time is over, nor for a round trip that takes too long to measure.

        Whoever has more than half of the samples so far too long, or none at all, is refused: one slow answer of
        several refuses nobody.
        """
        members = self._members.values()
        over = [one for one in members if one.waiting.is_over(now)]
        for member in over:
            member.over = "absent"
        decided = [one for one in members if one.measuring.is_over(now)]
        for member in decided:
            member.measured = True
            if not member.samples or self._too_long(member) > len(member.samples) // 2:
                member.over = "ping"
        if over or decided:
            self._changed(now)

    def may_play(self, now: float, *, on: bool) -> bool:
        """Whether the game may be on now. If it was not `on`, the countdown begins with this call."""
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
        """Whether no member is waited for, and at least one is here."""
        members = self._members.values()
        return any(one.here for one in members) and not any(one.missing for one in members)

    @property
    def waits(self) -> bool:
        """Whether a member waits for the game."""
        return any(one.takes_part for one in self._members.values())

    def all_gone_on(self, now: float) -> bool:
        """Whether all who are here have gone on from the page, or have been waited for long enough."""
        if self._page_until is None:
            return False
        return now >= self._page_until or all(one.gone_on for one in self._members.values() if one.here)

    def _held_by_page(self, now: float) -> bool:
        return self.reads and not self.all_gone_on(now)

    def time_left(self, player: str) -> float:
        """Seconds for which the others would wait for the member from now on; 0 if the member has used them up."""
        left = self._members[player].waiting.left
        return left if left >= self._least else 0.0

    def over(self, player: str) -> Over | None:
        """Why the member does not play any more; None if they play."""
        return self._members[player].over

    def all_refused(self) -> bool:
        """Whether no member is left who may play."""
        return all(one.over == "ping" for one in self._members.values())

    # ---- what is told

    def people(self, vacant: Iterable[str], *, reads: bool, plays_on: bool) -> dict[str, Where]:
        """Where each member is. In the places of `vacant` a policy plays from the start.

        `reads`: there is a page between two episodes. Without `plays_on` no policy takes the place of a member.
        """
        page = reads or self.reads
        return {
            **{one.player: _where(one, page, plays_on) for one in self._members.values()},
            **dict.fromkeys(vacant, "policy"),
        }

    def begins_in(self, now: float) -> float | None:
        """Seconds of the countdown that are left; None if it does not run."""
        return None if self._counts_until is None else max(0.0, self._counts_until - now)

    def held_for(self, now: float, *, reads: bool) -> float | None:
        """Seconds until the others wait no longer; None if they do not wait. `reads` as in `people`."""
        until = self._until(now, reads=reads)
        return None if until == math.inf else max(0.0, until - now)

    def wake_at(self, now: float, *, on_break: bool) -> float:
        """When to call `look` again if nothing happens; infinite if there is no need to."""
        counts = math.inf if self._counts_until is None else self._counts_until
        measuring = [one.measuring.until for one in self._members.values() if one.measuring.until is not None]
        return min(self._until(now, reads=on_break), counts, *measuring)

    def round_trips(self) -> dict[str, int]:
        """By player, the median of the member's last samples in milliseconds, for those who have samples."""
        return {one.player: round(_median(one.samples) * 1000) for one in self._members.values() if one.samples}

    def _until(self, now: float, *, reads: bool) -> float:
        ends = [one.waiting.until for one in self._members.values() if one.waiting.until is not None]
        page = self._page_until
        if (reads or self.reads) and page is not None and not self.all_gone_on(now):
            ends.append(page)
        return min(ends, default=math.inf)

    def _tell(self) -> None:
        """Something has changed that members are told."""
        self.version += 1

    def _changed(self, now: float) -> None:
        """Let the clocks of those who are missing run while another one waits."""
        self._tell()
        waits = self.waits
        for member in self._members.values():
            if member.gone and waits:
                member.waiting.run(now, self.time_left(member.player))
            else:
                member.waiting.stop(now, 0.0 if member.gone else self._least)
            if member.is_measured_now:
                member.measuring.run(now, member.measuring.left)
            else:
                member.measuring.stop(now)

    @property
    def _least(self) -> float:
        return min(LEAST_ABSENCE, (self.rules.absent if self.begun else self.rules.gather) / 3)

    def _give_time_back(self, now: float) -> None:
        """Members who have played since the last call get some of their time back. Call it before a change."""
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
    return "away" if member.met and not member.takes_part else "awaited"


def outcomes(presence: Presence, outcome: str | None) -> Mapping[str, str | None]:
    """By player, how the trial has ended for each member; `outcome` is that of the trial."""
    names: dict[Over | None, str | None] = {"absent": "left", "ping": "ping", None: outcome}
    return {player: names[presence.over(player)] for player in presence.players}


def _median(samples: Iterable[float]) -> float:
    ordered = sorted(samples)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
