"""How long the first picture of an episode stands, and how long the episode is played. Pure; the clock is passed in.

All times are seconds of one monotonic clock.
"""

from __future__ import annotations


class EpisodeTime:
    """The times of one episode after the other.

    `freeze` is how long the first picture stands; `limit` is how long an episode may be played, 0 for no limit.
    """

    def __init__(self, freeze: float, limit: float) -> None:
        self._freeze, self._limit = freeze, limit
        self._stands_since: float | None = None
        self._moves = freeze == 0
        self._played = 0.0
        self._runs_since: float | None = None

    def begin(self) -> None:
        """An episode begins: its first picture stands for a while."""
        self._moves = self._freeze == 0
        self._played = 0.0
        self._stands_since = self._runs_since = None

    def go_on(self, played: float) -> None:
        """The episode goes on. It was played for so many seconds on an earlier server."""
        self.begin()
        self._moves, self._played = True, played

    def rest(self, now: float) -> None:
        """The game is held. A first picture that was standing stands for its whole time again afterwards."""
        if self._runs_since is not None:
            self._played += now - self._runs_since
        self._stands_since = self._runs_since = None

    def starts_in(self, now: float) -> float:
        """Seconds for which the first picture still stands. They are counted from the first call on."""
        if self._moves:
            return 0.0
        if self._stands_since is None:
            self._stands_since = now
        left = max(0.0, self._stands_since + self._freeze - now)
        self._moves = left == 0.0
        return left

    def run(self, now: float) -> None:
        """The episode is played from now on, until `rest`."""
        if self._runs_since is None:
            self._runs_since = now

    def left(self, now: float) -> float | None:
        """Seconds of play that are left in the episode; None if it has no limit."""
        if not self._limit:
            return None
        running = 0.0 if self._runs_since is None else now - self._runs_since
        return max(0.0, self._limit - self._played - running)
