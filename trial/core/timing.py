"""When the next step and the next episode are due, and how long was played. Pure; the clock is passed in.

All times are seconds of one monotonic clock.
"""

from __future__ import annotations


class Pacer:
    """When the next frame is due. Late frames are skipped, never made up for."""

    def __init__(self) -> None:
        self._due: float | None = None

    def rest(self) -> None:
        """Forget the rhythm: the next frame is due at once."""
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
    """The times of one trial."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Seconds that were played."""
        self._pacer = Pacer()
        self._due: float | None = None
        self._last_step: float | None = None
        self._break_began: float | None = None

    def rest(self) -> None:
        """No steps are taken now. The next one is due at once."""
        self._pacer.rest()
        self._due = self._last_step = None

    def skip(self) -> None:
        """The step that was due is not taken."""
        self._due = None

    def step_due(self, now: float, frame_rate: int) -> float:
        """When the next step is due."""
        if self._due is None:
            self._due = self._pacer.next(now, frame_rate)
        return self._due

    def turn_due(self, frame_rate: int) -> float | None:
        """When the next step is due turn by turn, if all have chosen; None: at once.

        The rhythm only keeps it from coming before the step before was seen.
        """
        return None if self._last_step is None else self._last_step + 1.0 / frame_rate

    def stepped(self, now: float, frame_rate: int) -> None:
        """A step was taken."""
        self.seconds += 1.0 / frame_rate if self._last_step is None else now - self._last_step
        self._last_step = now

    def break_left(self, now: float, length: float) -> float:
        """Seconds of the break that are left. Its time begins when this is asked first."""
        if self._break_began is None:
            self._break_began = now
        return max(0.0, self._break_began + length - now)

    def break_over(self) -> None:
        """There is no break now."""
        self._break_began = None
