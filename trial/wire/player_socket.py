"""The WebSocket of a participant, with a shorter way for what comes and goes with each frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import Frame, Opcode
from websockets.protocol import Event, State
from websockets.streams import StreamReader

from trial.wire.websocket_frames import BINARY, framed, short_text

_FOR_A_FRAME = StreamReader.at_eof.__code__


class PlayerSocket(ServerConnection):
    """Sends a picture, and hears of its acknowledgement, without waking a task.

    At 30 pictures a second a task that wakes up costs about as much as packing the picture, and so does the package's
    way of writing and reading a frame. Everything else goes by `send` and `recv`.
    """

    hear: Callable[[bytes | bytearray | memoryview], bool] | None = None
    """Is shown each text message as it comes. If it returns True, `recv` never returns that message."""

    @property
    def free(self) -> bool:
        """The connection is open, and nothing waits to be written."""
        return (
            not self.paused
            and self.send_in_progress is None
            and self.protocol.state is State.OPEN
            and not self.transport.is_closing()
        )

    def send_now(self, data: bytes) -> None:
        """Send a binary message. Call it only while the connection is `free`."""
        self.transport.write(framed(BINARY, data))

    def data_received(self, data: bytes) -> None:
        """Called by asyncio. Most of what comes is one acknowledgement."""
        if self.hear is not None and self._between_messages:
            text = short_text(data)
            if text is not None and self.hear(text):
                return
        super().data_received(data)

    @property
    def _between_messages(self) -> bool:
        """What comes next is the beginning of a message: the package's parser waits for one, or for the end.

        It may also wait within a frame with nothing in its buffer, so the buffer does not tell.
        """
        protocol = self.protocol
        waits: Any = protocol.parser
        while waits.gi_yieldfrom is not None:
            waits = waits.gi_yieldfrom
        return waits.gi_code is _FOR_A_FRAME and protocol.current_size is None and protocol.state is State.OPEN

    def process_event(self, event: Event) -> None:
        """Called by websockets for each message that `data_received` left to it."""
        if not (isinstance(event, Frame) and self._heard(event)):
            super().process_event(event)

    def _heard(self, message: Frame) -> bool:
        return self.hear is not None and message.opcode is Opcode.TEXT and message.fin and self.hear(message.data)
