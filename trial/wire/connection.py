"""One client's connection: what is sent to it, in which order, and how much of it at a time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
from collections import deque
from collections.abc import Callable
from functools import partial

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from trial.core import messages
from trial.core.flow_control import Window
from trial.pictures import frames
from trial.pictures.encoder import Encoder

log = logging.getLogger("trial")

SUBPROTOCOLS = ("hippodrome.2", "hippodrome.1")
"""What a client may offer, the preferred one first. Clients of `hippodrome.1` know lossless frames only."""
REST_SECONDS = 0.25
"""A lossy frame is made exact if no other follows within this time or that of 2.5 frames, whichever is longer."""

_ROWS_RATE = 20  # at least so many ROWS frames a second
_INLINE_BYTES = 400_000  # larger pictures are packed off the event loop
_UNSENT_BYTES = 16_384  # the most that the kernel keeps unsent: some clients do not acknowledge frames
_TEXTS = 64  # if so many messages wait, new ones are dropped


class Connection:
    """The sending half of a connection. Only `run` sends; the other methods leave it something to send.

    Of pictures and of the trial's state only the newest is kept, so nothing builds up for a slow client.
    Pictures may lose something on the way (trial/pictures/encoder.py) if the client knows such frames and `lossless`
    is False.
    """

    def __init__(self, websocket: ServerConnection, *, lossless: bool = False) -> None:
        self.websocket = websocket
        self.window = Window()
        self.binary = websocket.subprotocol in SUBPROTOCOLS
        self.rate = 30
        """Frames per second of the game now."""
        self._encoder = Encoder(lossy=websocket.subprotocol == SUBPROTOCOLS[0] and not lossless)
        self._sharpen_at = math.inf
        self._texts: deque[str] = deque()
        self._state: str | None = None
        self._frame: tuple[int, frames.Frame] | None = None
        self._sent = 0, 0  # id and bytes of the last picture
        self._closing: tuple[int, str] | None = None  # code, last words
        self._wake = asyncio.Event()
        _keep_little_unsent(websocket)

    def send(self, text: str) -> None:
        """Send a message. It is dropped if the client reads so slowly that `_TEXTS` others wait."""
        if len(self._texts) < _TEXTS:
            self._texts.append(text)
            self._wake.set()

    def send_state(self, text: str) -> None:
        """Send the trial's state. It replaces a state that still waits."""
        self._state = text
        self._wake.set()

    def send_frame(self, frame: frames.Frame, frame_id: int) -> None:
        """Send a frame. It replaces a frame that still waits. `frame` must not change afterwards."""
        self._frame = (frame_id, frame)
        self._wake.set()

    def acknowledged(self, frame_id: int, now: float) -> None:
        """The client has shown this frame."""
        self.window.acknowledged(frame_id, now)
        if self._frame is not None or not self._encoder.exact:
            self._wake.set()

    def close(self, code: int, last_words: str) -> None:
        """Close, after the messages that wait and this one, which is never lost. The first call counts."""
        if self._closing is None:
            self._closing = (code, last_words)
            self._wake.set()

    def close_done(self, episodes: int, score: float) -> None:
        """Say that the trial is over, then close. HIPPO's clients expect the plain word `done`, not JSON."""
        self.close(1000, messages.done(episodes, score) if self.binary else "done")

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
                if timer is not None:
                    timer.cancel()
                wait = self._wait(loop.time())
                if wait > 0.0:
                    if wait < math.inf:
                        timer = loop.call_later(wait, self._wake.set)
                    continue
                await self._send_picture(loop)
                self._wake.set()
        except ConnectionClosed:
            pass
        except Exception:
            log.exception("a picture cannot be sent")
            self.abort()  # without this the page would wait for a frame that never comes; now it connects again
        finally:
            if timer is not None:
                timer.cancel()

    def _wait(self, now: float) -> float:
        """Seconds until the next frame may be sent; infinite if there is none."""
        if self._frame is not None:
            return self.window.wait(now, self.rate)
        if not self.binary or self._encoder.exact:
            return math.inf
        return max(self._sharpen_at - now, self.window.wait(now, self.rate))

    async def _send_picture(self, loop: asyncio.AbstractEventLoop) -> None:
        """Send the picture that waits; if there is none, the next rows that make the last picture exact."""
        pack: Callable[[], bytes | str]
        encode: Callable[[frames.Frame, int], bytes | str]
        if self._frame is not None:
            (frame_id, frame), self._frame = self._frame, None
            self._sent = frame_id, frame.nbytes
            encode = self._encoder.encode if self.binary else frames.jpeg_message
            pack, rest = partial(encode, frame, frame_id), max(REST_SECONDS, 2.5 / self.rate)
        else:
            frame_id, _ = self._sent
            pack, rest = partial(self._encoder.sharpen, frame_id), 1.0 / max(self.rate, _ROWS_RATE)
        data: bytes | str = await asyncio.to_thread(pack) if self._sent[1] > _INLINE_BYTES else pack()
        now = loop.time()
        self.window.sent(frame_id, now)
        self._sharpen_at = now + rest
        await self.websocket.send(data)  # returns when the write buffer is empty

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
