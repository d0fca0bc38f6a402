"""Measures for how long an episode shows its first picture (`resetFreeze`), and for how long it is played. Pure.

All times are seconds of one monotonic clock, which is passed in.
"""

from __future__ import annotations


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
