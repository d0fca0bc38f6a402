"""Which messages a connection keeps for sending, and what ends it."""

import asyncio

import numpy as np
import pytest

from trial.pictures.frames import Decoder
from trial.wire.connection import Connection


class SentMessages:
    """A websocket that keeps the messages that it is given to send."""

    subprotocol = "hippodrome.1"

    def __init__(self):
        self.sent = []
        self.transport = self

    def get_extra_info(self, _):
        return None

    async def send(self, data):
        self.sent.append(data)

    async def close(self, code):
        self.sent.append(code)


@pytest.mark.parametrize("code", [1000, 4409])
async def test_a_connection_keeps_few_messages_but_never_loses_the_last_ones(code):
    websocket = SentMessages()
    connection = Connection(websocket)
    for number in range(10_000):
        connection.send(str(number))
        connection.send_state(f"state {number}")
        connection.put_picture(np.full((2, 2, 3), number % 256, np.uint8), number)
        connection.send_now()
    connection.close(code, "done")
    connection.close(4410, "too late")
    await connection.run()
    sent = websocket.sent
    assert len(sent) < 100
    assert sent[0] == "0"
    assert sent[-2:] == ["done", code]
    pictures = [Decoder().decode(each)[0] for each in sent if isinstance(each, bytes)]
    assert pictures == ([9_999] if code == 1000 else []), "the picture that shows how the game ended"
    assert sent[-3 - len(pictures)] == "state 9999"


@pytest.mark.parametrize("subprotocol", [None, "hippodrome.2"])
async def test_a_picture_that_cannot_be_packed_ends_its_connection(subprotocol, caplog):
    """The page connects again. If the connection stayed, the page would wait for pictures for ever."""

    class Cut(SentMessages):
        def abort(self):
            self.sent.append("cut")

    websocket = Cut()
    websocket.subprotocol = subprotocol
    connection = Connection(websocket)
    width, depth = (65_535, 3) if subprotocol is None else (3, 0)  # wider than a JPEG may be; without a byte
    connection.put_picture(np.zeros((2, width, depth), np.uint8), 1)
    connection.send_now()
    await asyncio.wait_for(connection.run(), 5)
    assert websocket.sent == ["cut"]
    assert "a picture cannot be sent" in caplog.text
