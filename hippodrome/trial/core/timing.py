"""Decides what is due: a step, a reset, a frame, or the end of a turn, a break, a first picture or an episode. Pure.

All times are seconds of one monotonic clock, which is passed in.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from enum import Enum, auto
from typing import Any, NamedTuple

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.settings import STALLED_SECONDS

_WIDEST = 15  # the most frames under way, however long the round trip is


class EpisodeTime:
    """Measures the times of the present episode, in seconds.

    `freeze`: for how long the episode shows its first picture. `limit`: for how long it may be played; 0: no limit.
    """

    def __init__(self, freeze: float, limit: float) -> None:
        self._freeze, self._limit = freeze, limit
        self.begin()

    def begin(self) -> None:
        """Begin an episode, which shows its first picture."""
        self._frozen = self._freeze > 0
        self._frozen_since: float | None = None
        self._played = 0.0
        self._runs_since: float | None = None

    def resume(self, played: float) -> None:
        """Continue an episode that was played for `played` seconds on an earlier server."""
        self.begin()
        self._frozen, self._played = False, played

    def rest(self, now: float) -> None:
        """Stop all times, since the game is held. The time of the first picture begins anew when it goes on."""
        if self._runs_since is not None:
            self._played += now - self._runs_since
        self._frozen_since = self._runs_since = None

    def starts_in(self, now: float) -> float:
        """Return the seconds for which the first picture is still shown. They run from the first call on."""
        if not self._frozen:
            return 0.0
        if self._frozen_since is None:
            self._frozen_since = now
        left = max(0.0, self._frozen_since + self._freeze - now)
        self._frozen = left > 0.0
        return left

    def run(self, now: float) -> None:
        """Count the time from now on, until `rest`, as played."""
        if self._runs_since is None:
            self._runs_since = now

    def left(self, now: float) -> float | None:
        """Return the seconds of play that are left in the episode; None if it has no limit."""
        if not self._limit:
            return None
        running = 0.0 if self._runs_since is None else now - self._runs_since
        return max(0.0, self._limit - self._played - running)


class Due(Enum):
    """What is due now."""

    NOTHING = auto()
    RESET = auto()
    STEP = auto()


class StateTimes(NamedTuple):
    """The times that a client is sent with the trial's state, in seconds from now on. None: there is no such time."""

    next_in: float | None = None
    """The time until the break ends; infinite if the participant ends it."""
    turn_ends_in: float | None = None
    starts_in: float | None = None
    """The time for which the first picture is still shown before the game goes on."""
    time_left: float | None = None
    """The time of play that is left in the episode."""
    session: Mapping[str, Any] | None = None
    """In a session, the fields about its members."""


class Pacer:
    """Says when each frame is due. Frames whose time was missed are skipped."""

    def __init__(self) -> None:
        self._due: float | None = None

    def rest(self) -> None:
        """Let the next frame be due at once when the game goes on. Call it while the game is held."""
        self._due = None

    def next(self, now: float, rate: int) -> float:
        """Return the time at which the next frame is due. `rate`: frames per second."""
        interval = 1.0 / rate
        if self._due is None:
            self._due = now
            return now
        self._due += interval
        missed = max(0, int((now - self._due) / interval))
        self._due += missed * interval  # whole intervals: the next frames are due at the same regular times as before
        return self._due


class Window:
    """Limits the frames that were sent and not yet acknowledged: two more than the game shows in one round trip.

    If the client acknowledges several frames at once, one more is allowed, since the first of them waits for the last.
    A client that has never acknowledged a frame is limited by its write buffer alone.
    """

    def __init__(self, stalled_seconds: float = STALLED_SECONDS) -> None:
        self._stalled_seconds = stalled_seconds
        self._under_way: deque[tuple[int, float, bool]] = deque()  # id, time, and whether it is the id's first message
        self._round_trip = math.inf  # the shortest round trip so far
        self._together = False  # whether the last acknowledgement was for several frames
        self._sent_at = -math.inf
        self.newest = -1
        """The id of the last frame sent; -1 before the first."""
        self.acknowledgements = 0
        """How many acknowledgements have come for frames that were under way."""

    @property
    def acknowledging(self) -> bool:
        """Whether the client has acknowledged a frame."""
        return self._round_trip < math.inf

    def sent(self, frame_id: int, now: float) -> None:
        """Note that a message with this frame, or with rows of it, was sent."""
        self._under_way.append((frame_id, now, frame_id != self.newest))
        self._sent_at = now
        self.newest = frame_id
        if len(self._under_way) > 4 * _WIDEST:  # a client that never acknowledges
            self._under_way.popleft()

    def acknowledged(self, frame_id: int, now: float) -> None:
        """Note that the client has shown this frame, and so all frames before it."""
        frames = 0
        while self._under_way and self._under_way[0][0] <= frame_id:
            sent_id, at, first = self._under_way.popleft()
            frames += first
            if sent_id == frame_id and first:  # rows of one frame share its id, so they tell no round trip
                self._round_trip = min(self._round_trip, now - at)
        if frames:
            self.acknowledgements += 1
            self._together = frames > 1

    def wait(self, now: float, rate: int) -> float:
        """Return the seconds until another frame may be sent; 0 for at once. `rate`: the game's frames per second.

        Ask again after each acknowledgement, which may make the time shorter.
        """
        under_way = len(self._under_way)
        if under_way < 2 or not self.acknowledging:  # the first is the usual case
            return 0.0
        if under_way < min(2 + self._together + math.ceil(self._round_trip * rate), _WIDEST):
            return 0.0
        return max(0.0, self._sent_at + 1.0 - now)  # at least one frame a second, since an acknowledgement may be lost

    def stalled(self, now: float) -> bool:
        """Whether the client has stopped acknowledging frames, after it has acknowledged some."""
        return bool(self._under_way) and now - self._under_way[0][1] > self._stalled_seconds and self.acknowledging


class Timing:
    """Keeps the times of one trial, and ends breaks, first pictures, turns and episodes whose time is over."""

    def __init__(self, config: TrialSection) -> None:
        self.seconds = 0.0
        """The time that was played, in seconds."""
        self.wake_at: float | None = None
        """After `next` returned NOTHING: the time to call it again; None if only another event makes something due."""
        self._between = config.between_seconds
        self._max_steps = config.max_steps
        self._episode = EpisodeTime(config.reset_freeze, config.episode_seconds)
        self._limit = config.episode_seconds or None
        self._pacer = Pacer()
        self._due: float | None = None
        self._last_step: float | None = None
        self._break_began: float | None = None

    # ---- what has happened

    def begin_episode(self) -> None:
        """Begin an episode, which shows its first picture."""
        self._episode.begin()

    def resume_episode(self, played: float) -> None:
        """Continue an episode that was played for `played` seconds on an earlier server."""
        self._episode.resume(played)

    def skip(self) -> None:
        """Let the next frame be due in the place of the step that was due and is not taken."""
        self._due = None

    def stepped(self, now: float, frame_rate: int) -> None:
        """Count the time since the step before as played, after a step was taken."""
        self.seconds += 1.0 / frame_rate if self._last_step is None else now - self._last_step
        self._last_step = now

    # ---- what is due

    def next(self, progress: TrialProgress, now: float) -> Due | None:
        """Return what is due now. If NOTHING is due, `wake_at` says when to ask again.

        None: nothing for the caller to do, but the progress has changed, so ask again at once.
        """
        self.wake_at = None
        playing = progress.playing
        if not playing:
            self._episode.rest(now)
            left = self._break_left(progress, now)
            if left is not None:
                self._rest()
                return self._break_over(progress, left, now)
        else:
            self._break_began = None
        if progress.needs_reset:
            return Due.RESET
        if not playing:
            self._rest()
            if progress.turns is not None:
                progress.turns.hold(now)
            return Due.NOTHING
        if self._frozen(progress, now):
            return Due.NOTHING
        return self._step_due(progress, now) if progress.turns is None else self._turn_over(progress, now)

    def _rest(self) -> None:
        """Forget when the next step is due, since none is taken now. When the game goes on, a step is due at once."""
        self._pacer.rest()
        self._due = self._last_step = None

    def _break_left(self, progress: TrialProgress, now: float) -> float | None:
        """Return the seconds until the break ends, infinite if the participant ends it; None outside a break.

        The time of a break runs from the first call in it.
        """
        if not progress.on_break:
            return None
        if self._break_began is None:
            self._break_began = now
        return max(0.0, self._break_began + self._between - now)

    def _break_over(self, progress: TrialProgress, left: float, now: float) -> Due | None:
        if left > 0.0:
            self.wake_at = now + left if left < math.inf else None
            return Due.NOTHING
        progress.go_on()
        return None

    def _frozen(self, progress: TrialProgress, now: float) -> bool:
        """Return whether the first picture is still to be shown. If not, count the time from now on as played."""
        left = self._episode.starts_in(now)
        if left > 0.0:
            self._rest()
            if progress.turns is not None:
                progress.turns.hold(now)
            self.wake_at = now + left
            return True
        if progress.frozen:
            progress.thaw()
        self._episode.run(now)
        return False

    def _step_due(self, progress: TrialProgress, now: float) -> Due:
        """In real time: return STEP if the next frame is due, else NOTHING."""
        if self._due is None:
            self._due = self._pacer.next(now, progress.frame_rate)
        if now < self._due:
            self.wake_at = self._due
            return Due.NOTHING
        self._due = None
        return Due.STEP

    def _turn_over(self, progress: TrialProgress, now: float) -> Due | None:
        """Turn by turn: return STEP once all have chosen and the last picture was shown for one frame's time."""
        turns, choices = progress.turns, progress.choices
        assert turns is not None
        turns.run(now)
        choices.policies_choose(now)
        ends_in = turns.ends_in(now) if choices.waits_for else None
        if ends_in is not None and ends_in <= 0.0:
            progress.turn_over()
            return None
        if turns.waiting:
            left = self._episode.left(now)
            if left is not None and left <= 0.0:
                progress.time_over()
                return None
            ends = (choices.policies_until(), *(None if each is None else now + each for each in (left, ends_in)))
            self.wake_at = min((each for each in ends if each is not None), default=None)
            return Due.NOTHING
        due = None if self._last_step is None else self._last_step + 1.0 / progress.frame_rate
        if due is not None and now < due:
            self.wake_at = due
            return Due.NOTHING
        return Due.STEP

    def limit_of_step(self, progress: TrialProgress, now: float) -> str | None:
        """Return the key of `trial` whose limit makes the step that is due the episode's last; None if none does."""
        if self._max_steps and progress.steps + 1 >= self._max_steps:
            return "maxSteps"
        left = self._episode.left(now)
        half_frame = 0.5 / progress.frame_rate  # the step less than half a frame before the limit is the nearest to it
        return "episodeSeconds" if left is not None and left <= half_frame else None

    def _time_left(self, progress: TrialProgress, now: float) -> float | None:
        """Return the seconds of play that are left; all of them if the episode before is still being recorded."""
        return self._limit if progress.needs_reset and progress.ended else self._episode.left(now)

    # ---- what clients are told

    def state_times(self, progress: TrialProgress, now: float, session: Mapping[str, Any] | None) -> StateTimes:
        """Return the times that clients are sent with the state. `session`: the fields about a session's members."""
        return StateTimes(
            next_in=self._break_left(progress, now),
            turn_ends_in=None if progress.turns is None else progress.turns.ends_in(now),
            starts_in=self._episode.starts_in(now) if progress.shows_first_picture else None,
            time_left=None if progress.over or progress.on_break else self._time_left(progress, now),
            session=session,
        )
