"""The WebSocket of a participant, with a faster path for pictures and their acknowledgements."""

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
    """Sends a picture, and receives its acknowledgement, without waking a task.

    At 30 pictures a second, waking a task takes about as much processor time as packing the picture, and so does
    writing or reading a frame with the package `websockets`. All other messages go through `send` and `recv`.
    """

    hear: Callable[[bytes | bytearray | memoryview], bool] | None = None
    """A function that is called with each text message as it arrives. If it returns True, `recv` does not return it."""

    @property
    def free(self) -> bool:
        """Whether the connection is open and nothing waits to be written."""
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
        """Take received bytes from asyncio. Mostly they are one acknowledgement."""
        if self.hear is not None and self._between_messages:
            text = short_text(data)
            if text is not None and self.hear(text):
                return
        super().data_received(data)

    @property
    def _between_messages(self) -> bool:
        """Whether the next bytes begin a message: the package's parser waits for a frame, and for no continuation.

        An empty buffer would not tell: the parser may also wait within a frame with an empty buffer.
        """
        protocol = self.protocol
        generator: Any = protocol.parser
        while generator.gi_yieldfrom is not None:
            generator = generator.gi_yieldfrom
        return generator.gi_code is _FOR_A_FRAME and protocol.current_size is None and protocol.state is State.OPEN

    def process_event(self, event: Event) -> None:
        """Take a frame that `websockets` has read, because `data_received` did not read it."""
        if not (isinstance(event, Frame) and self._heard(event)):
            super().process_event(event)

    def _heard(self, message: Frame) -> bool:
        return self.hear is not None and message.opcode is Opcode.TEXT and message.fin and self.hear(message.data)
