"""The WebSocket of a participant, with a shorter way for what comes and goes with each frame."""

from __future__ import annotations

from collections.abc import Callable

from websockets.asyncio.server import ServerConnection
from websockets.frames import Frame, Opcode
from websockets.protocol import Event, State


class PlayerSocket(ServerConnection):
    """Sends a frame, and hears of its acknowledgement, without waking a task.

    At 30 frames a second a task that wakes up costs about as much as packing the frame. Everything else goes by `send`
    and `recv`.
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
        self.protocol.send_binary(data)
        self.send_data()

    def process_event(self, event: Event) -> None:
        """Called by websockets for each message."""
        if not (isinstance(event, Frame) and self._heard(event)):
            super().process_event(event)

    def _heard(self, message: Frame) -> bool:
        return self.hear is not None and message.opcode is Opcode.TEXT and message.fin and self.hear(message.data)
