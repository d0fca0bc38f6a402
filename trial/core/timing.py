"""What is due now: a step, the end of a turn, a break or a first picture; and how long was played. Pure.

All times are seconds of one monotonic clock, which is passed in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple

from protocol.trial import TrialSection
from trial.core.episode_time import EpisodeTime
from trial.core.progress import TrialProgress


class Due(Enum):
    """What is due now. MORE: the progress has changed, so ask again."""

    NOTHING = "nothing"
    MORE = "more"
    RESET = "reset"
    STEP = "step"


class StateTimes(NamedTuple):
    """Seconds that are left: of a break, a turn, the first picture, the episode. None: it does not run, or never ends.

    `session` is what the members of a session are told of each other.
    """

    next_in: float | None = None
    turn_ends_in: float | None = None
    starts_in: float | None = None
    time_left: float | None = None
    session: Mapping[str, Any] | None = None


class Pacer:
    """When the next frame is due. Late frames are skipped, never made up for."""

    def __init__(self) -> None:
        self._due: float | None = None

    def rest(self) -> None:
        """Forget when the last frame was due: the next one is due at once."""
        self._due = None

    def next(self, now: float, rate: int) -> float:
        """The moment at which the next frame is due."""
        interval = 1.0 / rate
        if self._due is None:
            self._due = now
            return now
        self._due += interval
        missed = int((now - self._due) / interval)
        if missed > 0:  # skip whole frames and stay on the old grid: what follows is evenly spaced again
            self._due += missed * interval
        return self._due


class Timing:
    """The times of one trial. It ends breaks, first pictures, turns and episodes whose time is over."""

    def __init__(self, config: TrialSection) -> None:
        self.seconds = 0.0
        """Seconds that were played."""
        self.wake_at: float | None = None
        """When something is due if nothing is now; None: no time makes it so."""
        self._between = config.between_seconds
        self._max_steps = config.max_steps
        self._episode = EpisodeTime(config.reset_freeze, config.episode_seconds)
        self._pacer = Pacer()
        self._due: float | None = None
        self._last_step: float | None = None
        self._break_began: float | None = None

    # ---- what has happened

    def begin_episode(self) -> None:
        """An episode begins: its first picture stands for a while."""
        self._episode.begin()

    def resume_episode(self, played: float) -> None:
        """The episode goes on. It was played for so many seconds on an earlier server."""
        self._episode.go_on(played)

    def skip(self) -> None:
        """The step that was due is not taken."""
        self._due = None

    def stepped(self, now: float, frame_rate: int) -> None:
        """A step was taken."""
        self.seconds += 1.0 / frame_rate if self._last_step is None else now - self._last_step
        self._last_step = now

    # ---- what is due

    def next(self, progress: TrialProgress, now: float) -> Due:
        """What is due now. With NOTHING, `wake_at` says when to ask again."""
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
        if self._stands(progress, now):
            return Due.NOTHING
        return self._step_due(progress, now) if progress.turns is None else self._turn_over(progress, now)

    def _rest(self) -> None:
        """No steps are taken now. The next one is due at once."""
        self._pacer.rest()
        self._due = self._last_step = None

    def _break_left(self, progress: TrialProgress, now: float) -> float | None:
        """Seconds until the next episode, infinite if the player begins it; None if this is no break.

        The time of a break begins when this is asked first.
        """
        if not progress.on_break:
            self._break_began = None
            return None
        if self._break_began is None:
            self._break_began = now
        return max(0.0, self._break_began + self._between - now)

    def _break_over(self, progress: TrialProgress, left: float, now: float) -> Due:
        if left > 0.0:
            self.wake_at = now + left if left < math.inf else None
            return Due.NOTHING
        progress.go_on()
        return Due.MORE

    def _stands(self, progress: TrialProgress, now: float) -> bool:
        """Whether the episode's first picture still stands; if not, the episode is played from now on."""
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
        """In real time: whether the step of the next frame is due."""
        if self._due is None:
            self._due = self._pacer.next(now, progress.frame_rate)
        if now < self._due:
            self.wake_at = self._due
            return Due.NOTHING
        self._due = None
        return Due.STEP

    def _turn_over(self, progress: TrialProgress, now: float) -> Due:
        """Turn by turn: a step is due once all have chosen. The frame rate lets the step before be seen."""
        turns, choices = progress.turns, progress.choices
        assert turns is not None
        turns.run(now)
        choices.policies_choose(now)
        ends_in = turns.ends_in(now) if choices.waits_for else None
        if ends_in is not None and ends_in <= 0.0:
            progress.turn_over()
            return Due.MORE
        if turns.waiting:
            left = self._episode.left(now)
            if left is not None and left <= 0.0:
                progress.time_over()
                return Due.MORE
            ends = (choices.policies_until(), *(None if each is None else now + each for each in (left, ends_in)))
            self.wake_at = min((each for each in ends if each is not None), default=None)
            return Due.NOTHING
        due = None if self._last_step is None else self._last_step + 1.0 / progress.frame_rate
        if due is not None and now < due:
            self.wake_at = due
            return Due.NOTHING
        return Due.STEP

    def limit_of_step(self, progress: TrialProgress, now: float) -> str | None:
        """The key of `trial` whose limit this step reaches, so that it is the episode's last one; None if none."""
        if self._max_steps and progress.steps + 1 >= self._max_steps:
            return "maxSteps"
        left = self._episode.left(now)
        nearest = 0.5 / progress.frame_rate  # the step before would be farther from the limit, or the next one
        return "episodeSeconds" if left is not None and left <= nearest else None

    # ---- what clients are told

    def told(self, progress: TrialProgress, now: float, session: Mapping[str, Any] | None) -> StateTimes:
        """All seconds that are left, and what is told of the `session`."""
        return StateTimes(
            next_in=self._break_left(progress, now),
            turn_ends_in=None if progress.turns is None else progress.turns.ends_in(now),
            starts_in=self._episode.starts_in(now) if progress.stands else None,
            time_left=None if progress.over or progress.on_break else self._episode.left(now),
            session=session,
        )
