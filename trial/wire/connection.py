"""The sending half of a client's connection: decides in which order, when and in which form things are sent."""

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
from trial.settings import STALLED_SECONDS
from trial.wire.inbound import Inbound
from trial.wire.player_socket import PlayerSocket

log = logging.getLogger("trial")

SUBPROTOCOLS = ("hippodrome.3", "hippodrome.2", "hippodrome.1")
"""The subprotocols, the preferred one first. Clients with the first draw scenes; clients with the last take only
lossless frames."""
REST_SECONDS = 0.25
"""A lossy frame is made exact if no other picture follows within this time or 2.5 frames, whichever is longer."""

_ROWS_RATE = 20  # the least rate of ROWS frames, per second
_INLINE_BYTES = 400_000  # larger pictures are packed on a thread, not on the event loop
_UNSENT_BYTES = 16_384  # the most that the kernel may keep unsent, since some clients do not acknowledge frames
_DONE = 1000  # the close code of a trial that is over
_TEXTS = 64  # the most messages that may wait; more are dropped
_ASSET_PART = 65_536  # the bytes of an image in one message
_ASSET_TIMES = 3  # how often a connection may ask for the same image


class Connection:
    """Sends pictures and messages to a client. `run` sends what the other methods have collected.

    Only `send_now` may send a picture itself, if nothing has to be sent before it. Of pictures and states only the
    newest one waits, so nothing builds up for a slow client.
    Pictures may be lossy (trial/pictures/encoder.py) if the client takes such frames and `lossless` is False. A client
    that does not draw scenes gets them as frames, which `draw` makes on a thread.
    """

    def __init__(
        self,
        websocket: ServerConnection,
        *,
        lossless: bool = False,
        stalled_seconds: float = STALLED_SECONDS,
        assets: Assets | None = None,
        draw: Callable[[Scene], frames.Frame] | None = None,
    ) -> None:
        self.websocket = websocket
        self._direct = websocket if isinstance(websocket, PlayerSocket) else None
        self._loop = asyncio.get_running_loop()
        self.window = Window(stalled_seconds)
        self.binary = websocket.subprotocol in SUBPROTOCOLS
        self.acknowledges_again: Callable[[int], None] | None = None
        """A function that is called when a client that had stopped acknowledging frames acknowledges one, with its
        id."""
        self.rate = 30
        """The game's present frame rate, per second."""
        self._draws_scenes = websocket.subprotocol == SUBPROTOCOLS[0]
        self._encoder = Encoder(lossy=websocket.subprotocol in SUBPROTOCOLS[:2] and not lossless)
        self._scenes = SceneEncoder()
        self._draw = draw
        self._assets = () if assets is None else tuple(assets.by_name.values())
        self._asked: Counter[int] = Counter()  # how often the client has asked for each asset
        self._wanted: deque[tuple[int, int]] = deque()  # assets to send: the number, and the offset of the next part
        self._sharpen_at = math.inf  # when rows that make the last picture exact may be sent
        self._texts: deque[str] = deque()
        self._state: str | None = None
        self._picture: tuple[int, Picture] | None = None
        self._sent = 0, False  # the id of the last picture, and whether it is large
        self._closing: tuple[int, str] | None = None  # the code, and the last message
        self._wake = asyncio.Event()
        self._resting = False  # whether `run` waits for `_wake` to be set
        _limit_unsent(websocket)

    def send(self, text: str) -> None:
        """Send a message. It is dropped if `_TEXTS` others wait, because the client reads slowly."""
        if len(self._texts) < _TEXTS:
            self._texts.append(text)
            self._wake.set()

    def send_state(self, text: str) -> None:
        """Send the trial's state, which replaces a state that still waits."""
        self._state = text
        self._wake.set()

    def put_picture(self, picture: Picture, picture_id: int) -> None:
        """Let a picture wait for `send_now` or the next message. It replaces a picture that still waits.

        `picture` must not change afterwards.
        """
        self._picture = (picture_id, picture)

    def send_now(self) -> None:
        """Send the picture that waits at once, or let `run` send it if something else is sent or written before it."""
        if not self._send_at_once():
            self._wake.set()

    def _send_at_once(self) -> bool:
        """Send the picture that waits. Return False if `run` has to send it, or rows that make it exact."""
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
        return self._encoder.exact

    def send_asset(self, name: str) -> bool:
        """Send an image, at most `_ASSET_TIMES` times to one client. Return False if there is none of this name."""
        number = next((number for number, each in enumerate(self._assets) if each.name == name), None)
        if number is None:
            return False
        self._asked[number] += 1
        if self._asked[number] <= _ASSET_TIMES:
            self._wanted.append((number, 0))
            self._wake.set()
        return True

    def acknowledged(self, frame_id: int, now: float) -> None:
        """Note that the client has shown this frame."""
        had_stopped = self.acknowledges_again is not None and self.window.stalled(now)
        self.window.acknowledged(frame_id, now)
        if had_stopped and self.acknowledges_again is not None:
            self.acknowledges_again(frame_id)
        if self._picture is not None or not self._encoder.exact:
            self._wake.set()

    def hear_acknowledgements(self, inbound: Inbound) -> None:
        """Let `inbound` read each acknowledgement as it arrives. `recv` returns all other messages."""

        def hear(data: bytes | bytearray | memoryview) -> bool:
            now = self._loop.time()
            frame_id = inbound.acknowledged(data, now)
            if frame_id is not None:
                self.acknowledged(frame_id, now)
            return frame_id is not None

        if self._direct is not None:
            self._direct.hear = hear

    def close(self, code: int, last_words: str) -> None:
        """Close with this code, after the messages that wait and the message `last_words`.

        Only the first call counts.
        """
        if self._closing is None:
            self._closing = (code, last_words)
            self._wake.set()

    def close_done(self, episodes: int, score: float, outcome: str | None = None, words: str | None = None) -> None:
        """Tell the client that the trial is over, then close. HIPPO's clients get the word `done` instead of JSON."""
        self.close(_DONE, messages.done(episodes, score, outcome, words) if self.binary else "done")

    async def run(self) -> None:
        """Send until the connection is closed."""
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
                    await self._end(*self._closing)
                    return
                if timer is not None:
                    timer.cancel()
                if self._wanted:
                    await self._send_part()
                    self._wake.set()
                wait = self._wait(self._loop.time())
                if wait > 0.0:
                    if wait < math.inf:
                        timer = self._loop.call_later(wait, self._wake.set)
                    continue
                await self._send_picture()
                self._wake.set()
        except ConnectionClosed:
            pass
        except Exception:
            log.exception("a picture cannot be sent")
            self.abort()  # so that the page connects again, and does not wait for a frame that never comes
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
            await self._direct.drain()  # `PlayerSocket.send_now` does not wait until the data are written

    def _wait(self, now: float) -> float:
        """Return the seconds until the next picture or rows may be sent; infinity if there are none."""
        if self._picture is not None:
            return self.window.wait(now, self.rate)
        if not self.binary or self._encoder.exact:
            return math.inf
        return max(self._sharpen_at - now, self.window.wait(now, self.rate))

    async def _send_part(self) -> None:
        """Send the next part of an image that the client has asked for."""
        number, offset = self._wanted[0]
        packed = self._assets[number].packed
        part = packed[offset : offset + _ASSET_PART]
        if offset + len(part) < len(packed):
            self._wanted[0] = number, offset + len(part)
        else:
            self._wanted.popleft()
        await self.websocket.send(ASSET_HEADER.pack(ASSET, number, offset) + part)

    async def _end(self, code: int, last_words: str) -> None:
        """Send the last message and close.

        If the trial is over, send a picture that waits first, since it shows the end.
        """
        if code == _DONE and self._picture is not None:
            try:
                await self._send_picture()
            except ConnectionClosed:
                raise
            except Exception:
                log.exception("the last picture cannot be sent")
        await self.websocket.send(last_words)
        await self.websocket.close(code)

    async def _send_picture(self) -> None:
        """Send the picture that waits; if none does, the next rows that make the last picture exact."""
        pack: Callable[[], bytes | str]
        if self._picture is not None:
            (frame_id, picture), self._picture = self._picture, None
            pack, large = self._packing(picture, frame_id)
            self._sent, rest = (frame_id, large), self._rest()
        else:
            frame_id, large = self._sent
            pack, rest = partial(self._encoder.sharpen, frame_id), 1.0 / max(self.rate, _ROWS_RATE)
        data: bytes | str = await asyncio.to_thread(pack) if large else pack()
        self._note_sent(frame_id, self._loop.time(), rest)
        await self.websocket.send(data)  # returns when the write buffer is empty

    def _rest(self) -> float:
        """Return the seconds after a picture until its rows follow, if no other picture does."""
        return max(REST_SECONDS, 2.5 / self.rate)

    def _note_sent(self, frame_id: int, now: float, rest: float) -> None:
        self.window.sent(frame_id, now)
        self._sharpen_at = now + rest

    def _packing(self, picture: Picture, frame_id: int) -> tuple[Callable[[], bytes | str], bool]:
        """Return a function that packs a picture for this client, and whether it must run on a thread."""
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
        """Cut the connection without a close frame."""
        with contextlib.suppress(Exception):
            self.websocket.transport.abort()


def _limit_unsent(websocket: ServerConnection) -> None:
    sock = websocket.transport.get_extra_info("socket")
    option = getattr(socket, "TCP_NOTSENT_LOWAT", None)
    if sock is not None and option is not None:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, option, _UNSENT_BYTES)
