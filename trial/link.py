"""One client's connection: what is sent to it, in which order, and how much of it at a time."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
from collections import deque
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from trial import frames

Pack = Callable[[frames.Frame, int], bytes | str]

SUBPROTOCOL = "hippodrome.1"
STALLED_SECONDS = 3.0
"""A client that acknowledged before and has not for so long is taken as lost or hidden."""

_WIDEST = 15  # frames under way, however long the round trip
_INLINE_BYTES = 400_000  # larger pictures are packed off the event loop
_UNSENT_BYTES = 16_384  # kept in the kernel for a client that does not acknowledge
_TEXTS = 64


class Window:
    """How many frames may be under way to a client: two more than fit into its round trip. Pure.

    A client that has never acknowledged anything is not held back here; its write buffer does that.
    """

    def __init__(self) -> None:
        self._under_way: deque[tuple[int, float]] = deque()
        self._round_trip = math.inf
        self._sent_at = -math.inf
        self.newest = -1
        """Id of the newest frame sent."""

    @property
    def acknowledging(self) -> bool:
        return self._round_trip < math.inf

    def sent(self, frame_id: int, now: float) -> None:
        self._under_way.append((frame_id, now))
        self._sent_at = now
        self.newest = frame_id
        if len(self._under_way) > 4 * _WIDEST:  # a client that never acknowledges
            self._under_way.popleft()

    def acknowledged(self, frame_id: int, now: float) -> None:
        while self._under_way and self._under_way[0][0] <= frame_id:
            seen, at = self._under_way.popleft()
            if seen == frame_id:
                self._round_trip = min(self._round_trip, now - at)

    def wait(self, now: float, rate: int) -> float:
        """Seconds until another frame may be sent; 0 for at once. An acknowledgement may come before that."""
        if not self.acknowledging:
            return 0.0
        if len(self._under_way) < min(2 + math.ceil(self._round_trip * rate), _WIDEST):
            return 0.0
        return max(0.0, self._sent_at + 1.0 - now)  # even then one frame a second, so that nobody waits for ever

    def stalled(self, now: float) -> bool:
        """The client acknowledged before, and has stopped."""
        return self.acknowledging and bool(self._under_way) and now - self._under_way[0][1] > STALLED_SECONDS


class Link:
    """The sending half of a connection. Only `run` writes; everything else leaves it something to write.

    Of pictures and of the trial's state only the newest is kept, so nothing builds up for a slow client.
    """

    def __init__(self, websocket: ServerConnection) -> None:
        self.websocket = websocket
        self.window = Window()
        self.binary = websocket.subprotocol == SUBPROTOCOL
        self.rate = 30
        """Frames per second of the game now."""
        self.told: object = None
        """The state this client was told last."""
        self._encoder = frames.Encoder()
        self._texts: deque[str] = deque()
        self._state: str | None = None
        self._frame: tuple[int, frames.Frame] | None = None
        self._closing: tuple[int, str] | None = None  # code, last words
        self._wake = asyncio.Event()
        _keep_little_unsent(websocket)

    def say(self, text: str) -> None:
        """Send a message. A client that causes more of them than it reads loses the newest."""
        if len(self._texts) < _TEXTS:
            self._texts.append(text)
            self._wake.set()

    def state(self, text: str) -> None:
        """Send the trial's state; replaces one that still waits."""
        self._state = text
        self._wake.set()

    def offer(self, frame: frames.Frame, frame_id: int) -> None:
        """Send a picture; replaces one that still waits. `frame` must not change afterwards."""
        self._frame = (frame_id, frame)
        self._wake.set()

    def acknowledged(self, frame_id: int, now: float) -> None:
        self.window.acknowledged(frame_id, now)
        if self._frame is not None:
            self._wake.set()

    def end(self, code: int, last_words: str) -> None:
        """Close, after what waits to be said and this message, which is never lost. The first call counts."""
        if self._closing is None:
            self._closing = (code, last_words)
            self._wake.set()

    async def run(self) -> None:
        """Send until the connection is closed."""
        loop = asyncio.get_running_loop()
        timer: asyncio.TimerHandle | None = None
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                while self._texts:
                    await self.websocket.send(self._texts.popleft())
                if self._state is not None:
                    text, self._state = self._state, None
                    await self.websocket.send(text)
                if self._closing is not None:
                    code, last_words = self._closing
                    await self.websocket.send(last_words)
                    await self.websocket.close(code)
                    return
                if self._frame is None:
                    continue
                if timer is not None:
                    timer.cancel()
                wait = self.window.wait(loop.time(), self.rate)
                if wait > 0.0:
                    timer = loop.call_later(wait, self._wake.set)
                    continue
                frame_id, frame = self._frame
                self._frame = None
                pack: Pack = self._encoder.encode if self.binary else frames.jpeg_message
                if frame.nbytes > _INLINE_BYTES:
                    data = await asyncio.to_thread(pack, frame, frame_id)
                else:
                    data = pack(frame, frame_id)
                self.window.sent(frame_id, loop.time())
                await self.websocket.send(data)  # returns when the write buffer is empty
        except ConnectionClosed:
            pass
        finally:
            if timer is not None:
                timer.cancel()

    def abort(self) -> None:
        """Cut the connection."""
        with contextlib.suppress(Exception):
            self.websocket.transport.abort()


def _keep_little_unsent(websocket: ServerConnection) -> None:
    sock = websocket.transport.get_extra_info("socket")
    option = getattr(socket, "TCP_NOTSENT_LOWAT", None)
    if sock is not None and option is not None:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, option, _UNSENT_BYTES)
