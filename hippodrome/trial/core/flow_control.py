"""Limits the number of frames that are under way to a client. Pure; the clock is passed in."""

from __future__ import annotations

import math
from collections import deque

from hippodrome.trial.settings import STALLED_SECONDS

_WIDEST = 15  # the most frames under way, however long the round trip is


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
