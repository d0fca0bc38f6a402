"""How many frames may be under way to a client. Pure; the clock is passed in."""

from __future__ import annotations

import math
from collections import deque

STALLED_SECONDS = 3.0
"""A client that acknowledged before, and has not for this time, is lost or hidden."""

_WIDEST = 15  # frames under way, however long the round trip


class Window:
    """The frames that were sent and not acknowledged: at most two more than fit into the round trip.

    To a client that acknowledges two frames at once it is one more, since the first of them waits for the other. A
    client that has never acknowledged a frame is not held back here, but by its write buffer.
    """

    def __init__(self) -> None:
        self._under_way: deque[tuple[int, float, bool]] = deque()  # id, when, whether the first message with this id
        self._round_trip = math.inf
        self._together = False  # the last acknowledgement was that of several frames
        self._sent_at = -math.inf
        self.newest = -1
        """Id of the newest frame sent."""

    @property
    def acknowledging(self) -> bool:
        """Whether the client has acknowledged a frame."""
        return self._round_trip < math.inf

    def sent(self, frame_id: int, now: float) -> None:
        """A frame, or rows of it, were sent."""
        self._under_way.append((frame_id, now, frame_id != self.newest))
        self._sent_at = now
        self.newest = frame_id
        if len(self._under_way) > 4 * _WIDEST:  # a client that never acknowledges
            self._under_way.popleft()

    def acknowledged(self, frame_id: int, now: float) -> None:
        """The client has shown this frame, and so all frames before it."""
        frames = 0
        while self._under_way and self._under_way[0][0] <= frame_id:
            seen, at, first = self._under_way.popleft()
            frames += first
            if seen == frame_id and first:  # of rows, the acknowledgement may be that of an earlier message
                self._round_trip = min(self._round_trip, now - at)
        if frames:
            self._together = frames > 1

    def wait(self, now: float, rate: int) -> float:
        """Seconds until another frame may be sent; 0 for at once. An acknowledgement may come before that."""
        under_way = len(self._under_way)
        if under_way < 2 or not self.acknowledging:  # the first is the usual case
            return 0.0
        if under_way < min(2 + self._together + math.ceil(self._round_trip * rate), _WIDEST):
            return 0.0
        return max(0.0, self._sent_at + 1.0 - now)  # even then one frame a second: an acknowledgement may be lost

    def stalled(self, now: float) -> bool:
        """Whether the client has acknowledged frames, and has stopped doing so."""
        return bool(self._under_way) and now - self._under_way[0][1] > STALLED_SECONDS and self.acknowledging
