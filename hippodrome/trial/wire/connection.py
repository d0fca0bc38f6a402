"""A client's connection: in which order, when and in which form things are sent, and how long a round trip takes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import socket
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from hippodrome.trial.core import messages
from hippodrome.trial.core.timing import Window
from hippodrome.trial.pictures import frames
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.encoder import Encoder
from hippodrome.trial.pictures.reader import Picture
from hippodrome.trial.pictures.scene import Scene
from hippodrome.trial.pictures.scene_encoder import ASSET, ASSET_HEADER, SceneEncoder
from hippodrome.trial.settings import STALLED_SECONDS

log = logging.getLogger("trial")

SUBPROTOCOL = "hippodrome"
"""The subprotocol of docs/wire.md. Clients without it, such as HIPPO's front end, get HIPPO's messages."""
MAX_ROUND_TRIP = 10.0
"""The longest round trip that is reported. A ping without an answer counts as one of this length."""
PING_SECONDS = 5.0
"""The time from the answer to one ping to the next ping, after the first samples."""
REST_SECONDS = 0.25
"""A lossy frame is made exact if no other picture follows within this time or 2.5 frames, whichever is longer."""

_ROWS_RATE = 20  # the least rate of ROWS frames, per second
_INLINE_BYTES = 400_000  # larger pictures are packed on a thread, not on the event loop
_UNSENT_BYTES = 16_384  # the most that the kernel may keep unsent, since some clients do not acknowledge frames
_DONE = 1000  # the close code of a trial that is over
_TEXTS = 64  # the most messages that may wait; more are dropped
_ASSET_PART = 65_536  # the bytes of an image in one message
_ASSET_TIMES = 3  # how often a connection may ask for the same image
_LINES = 500  # the most lines of talk in a message
_BETWEEN_SAMPLES = 0.1  # seconds between the first pings


class Connection:
    """Sends pictures and messages to a client. `run` sends what the other methods have collected.

    Of pictures and states only the newest one waits, so nothing builds up for a slow client: `run` sends the next
    message when the last one has left the write buffer (`write_limit` in hippodrome/trial/server/listener.py).
    `decodes` names what the client decodes (`Hello.decodes`). Pictures may be lossy
    (hippodrome/trial/pictures/encoder.py) if the client decodes JPEGs and `lossless` is False. A client that does not
    draw objects gets scenes as frames, which `draw` makes on a thread.
    """

    def __init__(
        self,
        websocket: ServerConnection,
        *,
        decodes: Collection[str] = messages.DECODABLE,
        lossless: bool = False,
        stalled_seconds: float = STALLED_SECONDS,
        assets: Assets | None = None,
        draw: Callable[[Scene], frames.Frame] | None = None,
    ) -> None:
        self.websocket = websocket
        self._loop = asyncio.get_running_loop()
        self.window = Window(stalled_seconds)
        self.binary = websocket.subprotocol == SUBPROTOCOL
        """Whether the client has our subprotocol: it gets binary frames, and acknowledges them."""
        self.rate = 30
        """The game's present frame rate, per second."""
        self._inflates = "deflate" in decodes
        self._draws_objects = self.binary and "objects" in decodes
        self._encoder = Encoder(lossy="jpeg" in decodes and not lossless)
        self._scenes = SceneEncoder(deflate=self._inflates)
        self._draw = draw
        self._assets = () if assets is None else tuple(assets.by_name.values())
        self._asked: Counter[int] = Counter()  # how often the client has asked for each asset
        self._wanted: deque[tuple[int, int]] = deque()  # assets to send: the number, and the offset of the next part
        self._sharpen_at = math.inf  # when rows that make the last picture exact may be sent
        self._texts: deque[str] = deque()
        self._talk = PendingTalk()
        self._state: str | None = None
        self._picture: tuple[int, Picture] | None = None
        self._sent = 0, False  # the id of the last picture, and whether it is large
        self._closing: tuple[int, str] | None = None  # the code, and the last message
        self._wake = asyncio.Event()
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

    def send_talk(self, fields: Mapping[str, Any]) -> None:
        """Send a message about talk. However slow the client is, no line is dropped, and of a line only its newest text
        waits. Clients without our subprotocol do not talk."""
        if self.binary:
            self._talk.add(fields)
            self._wake.set()

    def show(self, picture: Picture, picture_id: int) -> None:
        """Send a picture, after the messages that wait. It replaces a picture that still waits.

        `picture` must not change afterwards.
        """
        self._picture = (picture_id, picture)
        self._wake.set()

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

    def acknowledged(self, frame_id: int) -> None:
        """Note that the client has shown this frame."""
        self.window.acknowledged(frame_id, self._loop.time())
        if self._picture is not None or not self._encoder.exact:
            self._wake.set()

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
        try:
            while True:
                await self._until_due()
                while self._texts:
                    await self.websocket.send(self._texts.popleft())
                if self._state is not None:
                    text, self._state = self._state, None
                    await self.websocket.send(text)
                while self._talk:
                    await self.websocket.send(self._talk.take())
                if self._closing is not None:
                    await self._end(*self._closing)
                    return
                if self._wanted:
                    await self._send_part()
                if self._picture_in() <= 0.0:
                    await self._send_picture()
        except ConnectionClosed:
            pass
        except Exception:
            log.exception("a picture cannot be sent")
            self.abort()  # so that the page connects again, and does not wait for a frame that never comes

    async def _until_due(self) -> None:
        """Wait until there is something to send."""
        seconds = 0.0 if self._wanted or self._talk else self._picture_in()
        if seconds > 0.0:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds if seconds < math.inf else None):
                    await self._wake.wait()
        self._wake.clear()

    def _picture_in(self) -> float:
        """Return the seconds until the next picture or rows may be sent; infinity if there are none."""
        now = self._loop.time()
        if self._picture is not None:
            return self.window.wait(now, self.rate)
        if self._encoder.exact:
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
            self._sent, rest = (frame_id, large), max(REST_SECONDS, 2.5 / self.rate)
        else:
            frame_id, large = self._sent
            pack, rest = partial(self._encoder.sharpen, frame_id), 1.0 / max(self.rate, _ROWS_RATE)
        data = await asyncio.to_thread(pack) if large else pack()
        now = self._loop.time()
        self.window.sent(frame_id, now)
        self._sharpen_at = now + rest
        await self.websocket.send(data)  # returns when the write buffer is empty

    def _packing(self, picture: Picture, frame_id: int) -> tuple[Callable[[], bytes | str], bool]:
        """Return a function that packs a picture for this client, and whether it must run on a thread."""
        if isinstance(picture, Scene):
            if self._draws_objects:
                self._encoder.forget()
                return partial(self._scenes.encode, picture, frame_id), False
            return partial(self._drawn, picture, frame_id), True
        self._scenes.forget()
        return partial(self._encode, picture, frame_id), picture.nbytes > _INLINE_BYTES

    def _drawn(self, scene: Scene, frame_id: int) -> bytes | str:
        assert self._draw is not None
        return self._encode(self._draw(scene), frame_id)

    def _encode(self, frame: frames.Frame, frame_id: int) -> bytes | str:
        if not self.binary:
            return frames.jpeg_message(frame, frame_id)
        if not self._inflates:
            return frames.jpeg_frame(frame, frame_id)
        return self._encoder.encode(frame, frame_id)

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


class PendingTalk:
    """The messages about talk that wait for a client. Of a line, only the newest text waits."""

    def __init__(self) -> None:
        self._lines: dict[int, Mapping[str, Any]] = {}
        self._history = False  # whether a message with lines is due, also if there are none
        self._turn: str | None = None
        self._typing: dict[str, bool] = {}
        self._refused: list[Mapping[str, Any]] = []

    def __bool__(self) -> bool:
        return bool(self._lines or self._history or self._turn is not None or self._typing or self._refused)

    def add(self, fields: Mapping[str, Any]) -> None:
        """Add the fields of a message: `lines`, `turn`, `typing` or `refused`."""
        self._history = self._history or fields.get("lines") == []
        for line in fields.get("lines", ()):
            self._lines.pop(line["n"], None)
            self._lines[line["n"]] = line
        self._turn = fields.get("turn", self._turn)
        self._typing |= fields.get("typing", {})
        if "refused" in fields and len(self._refused) < _LINES:
            self._refused.append(fields["refused"])

    def take(self) -> str:
        """Return the next message to send."""
        if self._typing:
            typing, self._typing = self._typing, {}
            return json.dumps({"typing": typing})
        if self._refused:
            return json.dumps({"refused": self._refused.pop(0)})
        self._history = False
        numbers = list(self._lines)[:_LINES]
        message: dict[str, Any] = {"lines": [self._lines.pop(number) for number in numbers]}
        if self._turn is not None and not self._lines:
            message["turn"], self._turn = self._turn, None
        return json.dumps(message, ensure_ascii=False)


async def measure_round_trips(websocket: ServerConnection, samples: int, report: Callable[[float], None]) -> None:
    """Report round trips, in seconds, until the connection is closed. They are those of WebSocket's pings.

    A browser answers a ping by itself, without the page, "as soon as is practical" (RFC 6455, 5.5.2 and 5.5.3). A ping
    waits until earlier data are sent, as the game's pictures do. So the round trip is the one that the participant
    experiences, with the server's own delays. It takes 6 bytes to the browser and 10 back, without TCP and TLS.

    The first `samples` are measured at once, the others every `PING_SECONDS`. One ping is under way at a time. While
    it has no answer, for instance because a phone sleeps, `MAX_ROUND_TRIP` is reported every `MAX_ROUND_TRIP`.
    """
    count = 0
    try:
        while True:
            await _measure_round_trip(websocket, report)
            count += 1
            await asyncio.sleep(_BETWEEN_SAMPLES if count < samples else PING_SECONDS)
    except ConnectionClosed:
        pass


async def _measure_round_trip(websocket: ServerConnection, report: Callable[[float], None]) -> None:
    """Measure and report one round trip. Raises ConnectionClosed."""
    ping, late = asyncio.ensure_future(_round_trip(websocket)), False
    try:
        while True:
            await asyncio.wait({ping}, timeout=MAX_ROUND_TRIP)
            if ping.done():
                break
            late = True
            report(MAX_ROUND_TRIP)
    finally:
        ping.cancel()  # changes nothing once it is done
    seconds = ping.result()
    if not late:
        report(min(seconds, MAX_ROUND_TRIP))


async def _round_trip(websocket: ServerConnection) -> float:
    return await (await websocket.ping())
