"""One client's connection: what is sent to it, in which order, and how much of it at a time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
from collections import Counter, deque
from collections.abc import Callable
from functools import partial

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from trial.core import messages
from trial.core.flow_control import Window
from trial.pictures import frames
from trial.pictures.assets import Assets
from trial.pictures.encoder import Encoder
from trial.pictures.picture import Picture
from trial.pictures.scene import Scene
from trial.pictures.scene_encoder import ASSET, ASSET_HEADER, SceneEncoder
from trial.wire.inbound import Inbound
from trial.wire.player_socket import PlayerSocket

log = logging.getLogger("trial")

SUBPROTOCOLS = ("hippodrome.3", "hippodrome.2", "hippodrome.1")
"""What a client may offer, the preferred one first. Clients of the first draw scenes; of the last, they know lossless
frames only."""
REST_SECONDS = 0.25
"""A lossy frame is made exact if no other follows within this time or that of 2.5 frames, whichever is longer."""

_ROWS_RATE = 20  # at least so many ROWS frames a second
_INLINE_BYTES = 400_000  # larger pictures are packed off the event loop
_UNSENT_BYTES = 16_384  # the most that the kernel keeps unsent: some clients do not acknowledge frames
_DONE = 1000  # the close code of a trial that is over
_TEXTS = 64  # if so many messages wait, new ones are dropped
_ASSET_PART = 65_536  # bytes of an image that are sent at a time
_ASSET_TIMES = 3  # that a connection may ask for an image


class Connection:
    """The sending half of a connection. `run` sends what the other methods leave it to send.

    Only a picture for which nothing else has to wait is sent at once, by `send_now`.

    Of pictures and of the trial's state only the newest is kept, so nothing builds up for a slow client.
    Pictures may lose something on the way (trial/pictures/encoder.py) if the client knows such frames and `lossless`
    is False. A client that does not draw scenes gets them as frames, which `draw` makes; it runs on a thread.
    """

    def __init__(
        self,
        websocket: ServerConnection,
        *,
        lossless: bool = False,
        assets: Assets | None = None,
        draw: Callable[[Scene], frames.Frame] | None = None,
    ) -> None:
        self.websocket = websocket
        self._direct = websocket if isinstance(websocket, PlayerSocket) else None
        self._loop = asyncio.get_running_loop()
        self.window = Window()
        self.binary = websocket.subprotocol in SUBPROTOCOLS
        self.woke: Callable[[int], None] | None = None
        """Called with the frame's id when a client acknowledges again that had stopped."""
        self.rate = 30
        """Frames per second of the game now."""
        self._draws_scenes = websocket.subprotocol == SUBPROTOCOLS[0]
        self._encoder = Encoder(lossy=websocket.subprotocol in SUBPROTOCOLS[:2] and not lossless)
        self._scenes = SceneEncoder()
        self._draw = draw
        self._assets = () if assets is None else tuple(assets.by_name.values())
        self._asked: Counter[int] = Counter()  # how often for each asset
        self._wanted: deque[tuple[int, int]] = deque()  # assets that are asked for, by number, each with an offset
        self._sharpen_at = math.inf
        self._texts: deque[str] = deque()
        self._state: str | None = None
        self._picture: tuple[int, Picture] | None = None
        self._sent = 0, False  # id of the last picture, and whether it is large
        self._closing: tuple[int, str] | None = None  # code, last words
        self._wake = asyncio.Event()
        self._resting = False  # `run` has nothing to do
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

    def put_picture(self, picture: Picture, picture_id: int) -> None:
        """A picture to be sent, by `send_now` or with the next message. It replaces one that still waits.

        `picture` must not change afterwards.
        """
        self._picture = (picture_id, picture)

    def send_now(self) -> None:
        """Send the picture that waits, at once if nothing else has to be sent or written."""
        if not self._send_at_once():
            self._wake.set()

    def _send_at_once(self) -> bool:
        """Send the picture that waits; False if `run` has to send it."""
        direct, now = self._direct, self._loop.time()
        if direct is None or self._picture is None or not self._resting or self._wake.is_set() or not direct.free:
            return False
        if self.window.wait(now, self.rate) > 0.0:
            return False
        frame_id, picture = self._picture
        pack, large = self._packing(picture, frame_id)
        if large or not self.binary:
            return False
        self._picture = None
        try:
            data = pack()
            assert isinstance(data, bytes)
            self._sent = (frame_id, False)
            self._note_sent(frame_id, now, self._rest())
            direct.send_now(data)
        except Exception:
            log.exception("a picture cannot be sent")
            self.abort()
            return True
        return self._encoder.exact  # else `run` makes it so

    def send_asset(self, name: str) -> bool:
        """Send an image; False if there is none of this name. A client that asks for it too often gets it no more."""
        number = next((number for number, each in enumerate(self._assets) if each.name == name), None)
        if number is None:
            return False
        self._asked[number] += 1
        if self._asked[number] <= _ASSET_TIMES:
            self._wanted.append((number, 0))
            self._wake.set()
        return True

    def acknowledged(self, frame_id: int, now: float) -> None:
        """The client has shown this frame."""
        slept = self.woke is not None and self.window.stalled(now)
        self.window.acknowledged(frame_id, now)
        if slept and self.woke is not None:
            self.woke(frame_id)
        if self._picture is not None or not self._encoder.exact:
            self._wake.set()

    def hear_acknowledgements(self, inbound: Inbound) -> None:
        """From now on `inbound` reads acknowledgements as they come. Messages that say more are left to `recv`."""

        def hear(data: bytes | bytearray | memoryview) -> bool:
            now = self._loop.time()
            frame_id = inbound.acknowledged(data, now)
            if frame_id is not None:
                self.acknowledged(frame_id, now)
            return frame_id is not None

        if self._direct is not None:
            self._direct.hear = hear

    def close(self, code: int, last_words: str) -> None:
        """Close, after the messages that wait and this one, which is never lost. The first call counts."""
        if self._closing is None:
            self._closing = (code, last_words)
            self._wake.set()

    def close_done(self, episodes: int, score: float, outcome: str | None = None) -> None:
        """Say that the trial is over, then close. HIPPO's clients expect the plain word `done`, not JSON."""
        self.close(_DONE, messages.done(episodes, score, outcome) if self.binary else "done")

    async def run(self) -> None:
        """Send until the connection is closed."""
        loop = asyncio.get_running_loop()
        timer: asyncio.TimerHandle | None = None
        try:
            while True:
                await self._something_to_do()
                while self._texts:
                    await self.websocket.send(self._texts.popleft())
                if self._state is not None:
                    text, self._state = self._state, None
                    await self.websocket.send(text)
                if self._closing is not None:
                    await self._end(loop, *self._closing)
                    return
                if timer is not None:
                    timer.cancel()
                if self._wanted:
                    await self._send_part()
                    self._wake.set()
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
            self._resting = False
            if timer is not None:
                timer.cancel()

    async def _something_to_do(self) -> None:
        self._resting = True
        await self._wake.wait()
        self._resting = False
        self._wake.clear()
        if self._direct is not None:
            await self._direct.drain()  # `send_now` does not wait for it

    def _wait(self, now: float) -> float:
        """Seconds until the next frame may be sent; infinite if there is none."""
        if self._picture is not None:
            return self.window.wait(now, self.rate)
        if not self.binary or self._encoder.exact:
            return math.inf
        return max(self._sharpen_at - now, self.window.wait(now, self.rate))

    async def _send_part(self) -> None:
        """Send the next bytes of an image that was asked for."""
        number, offset = self._wanted[0]
        packed = self._assets[number].packed
        part = packed[offset : offset + _ASSET_PART]
        if offset + len(part) < len(packed):
            self._wanted[0] = number, offset + len(part)
        else:
            self._wanted.popleft()
        await self.websocket.send(ASSET_HEADER.pack(ASSET, number, offset) + part)

    async def _end(self, loop: asyncio.AbstractEventLoop, code: int, last_words: str) -> None:
        """Send the last words and close; if the trial is over, after the picture that still waits: it shows how."""
        if code == _DONE and self._picture is not None:
            try:
                await self._send_picture(loop)
            except ConnectionClosed:
                raise
            except Exception:
                log.exception("the last picture cannot be sent")
        await self.websocket.send(last_words)
        await self.websocket.close(code)

    async def _send_picture(self, loop: asyncio.AbstractEventLoop) -> None:
        """Send the picture that waits; if there is none, the next rows that make the last picture exact."""
        pack: Callable[[], bytes | str]
        if self._picture is not None:
            (frame_id, picture), self._picture = self._picture, None
            pack, large = self._packing(picture, frame_id)
            self._sent, rest = (frame_id, large), self._rest()
        else:
            frame_id, large = self._sent
            pack, rest = partial(self._encoder.sharpen, frame_id), 1.0 / max(self.rate, _ROWS_RATE)
        data: bytes | str = await asyncio.to_thread(pack) if large else pack()
        self._note_sent(frame_id, loop.time(), rest)
        await self.websocket.send(data)  # returns when the write buffer is empty

    def _rest(self) -> float:
        """Seconds after a picture until rows of it follow, if no other picture does."""
        return max(REST_SECONDS, 2.5 / self.rate)

    def _note_sent(self, frame_id: int, now: float, rest: float) -> None:
        self.window.sent(frame_id, now)
        self._sharpen_at = now + rest

    def _packing(self, picture: Picture, frame_id: int) -> tuple[Callable[[], bytes | str], bool]:
        """What packs a picture for this client, and whether that takes so long that a thread has to do it."""
        if isinstance(picture, Scene):
            if self._draws_scenes:
                self._encoder.forget()
                return partial(self._scenes.encode, picture, frame_id), False
            return partial(self._drawn, picture, frame_id), True
        self._scenes.forget()
        return partial(self._encode, picture, frame_id), picture.nbytes > _INLINE_BYTES

    def _drawn(self, scene: Scene, frame_id: int) -> bytes | str:
        assert self._draw is not None
        return self._encode(self._draw(scene), frame_id)

    def _encode(self, frame: frames.Frame, frame_id: int) -> bytes | str:
        return self._encoder.encode(frame, frame_id) if self.binary else frames.jpeg_message(frame, frame_id)

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
