"""Frames and acknowledgements take the short way of a connection, and everything else keeps its order."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.frames import Frame as RawFrame
from websockets.frames import Opcode
from websockets.typing import Subprotocol

from testing.waiting import PATIENCE
from trial.pictures.frames import Decoder, Frame
from trial.wire.connection import SUBPROTOCOLS, Connection
from trial.wire.inbound import MESSAGES_A_SECOND, Inbound
from trial.wire.player_socket import PlayerSocket


def picture(value: int, size: int = 4) -> Frame:
    return np.full((size, size, 3), value, np.uint8)


@contextlib.asynccontextmanager
async def linked() -> AsyncIterator[tuple[Connection, Any]]:
    """A connection whose `run` has nothing to do, and its client, over a real socket."""
    made: asyncio.Queue[Connection] = asyncio.Queue()

    async def talk(websocket: ServerConnection) -> None:
        connection = Connection(websocket)
        running = asyncio.create_task(connection.run())
        await asyncio.sleep(0)
        made.put_nowait(connection)
        await websocket.wait_closed()
        running.cancel()

    names = [Subprotocol(name) for name in SUBPROTOCOLS]
    async with (
        serve(
            talk,
            "127.0.0.1",
            0,
            subprotocols=names,
            compression=None,
            write_limit=(1, 0),
            create_connection=PlayerSocket,
        ) as server,
        connect(
            f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}", subprotocols=names[:1], compression=None
        ) as client,
    ):
        async with asyncio.timeout(PATIENCE):
            yield await made.get(), client


async def test_a_picture_is_written_before_the_event_that_shows_it_is_over() -> None:
    async with linked() as (connection, client):
        connection.put_picture(picture(7), 1)
        connection.send_now()
        assert connection.window.newest == 1, "no task had to wake up"
        assert np.array_equal(Decoder().decode(await client.recv())[1], picture(7))


async def test_a_message_of_the_same_event_goes_first() -> None:
    async with linked() as (connection, client):
        connection.put_picture(picture(7), 1)
        connection.send_state("state")
        connection.send_now()
        assert await client.recv() == "state"
        assert Decoder().decode(await client.recv())[0] == 1


async def test_after_a_full_socket_the_newest_picture_is_sent() -> None:
    async with linked() as (connection, client):
        for end, option in ((connection.websocket, socket.SO_SNDBUF), (client, socket.SO_RCVBUF)):
            # The kernel's own limits differ: some machines take 50 MB before a socket is full.
            end.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, option, 1 << 16)
        noise = np.random.default_rng(7)
        for number in range(1, 200):  # the client reads none of them
            connection.put_picture(noise.integers(0, 256, (300, 400, 3), np.uint8), number)
            connection.send_now()
            await asyncio.sleep(0)
        sent = connection.window.newest
        assert sent < 150, "the socket is full"
        seen = -1
        while seen < 199:
            data = await client.recv()
            seen = int.from_bytes(data[1:5], "big")
            if seen > sent:
                assert seen == 199, "a picture that is old by now is dropped"


async def test_a_picture_that_cannot_be_packed_ends_its_connection_alone(caplog: pytest.LogCaptureFixture) -> None:
    async with linked() as (connection, client):
        connection.put_picture(np.zeros((2, 3, 0), np.uint8), 1)
        connection.send_now()
        await client.wait_closed()
    assert "a picture cannot be sent" in caplog.text


async def test_an_acknowledgement_is_read_as_it_comes_and_other_messages_are_left_to_the_parser() -> None:
    async with linked() as (connection, client):
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.put_picture(picture(7), 1)
        connection.send_now()
        others = [{"ack": 2}, {"ack": 1, "command": "start"}, {"ack": "1"}]
        for said in ({"ack": 1}, *others):
            await client.send(json.dumps(said))
        left = [json.loads(await connection.websocket.recv()) for _ in others]
        assert left == others
        assert connection.window.acknowledging


async def test_an_acknowledgement_that_comes_alone_needs_no_parser(monkeypatch: pytest.MonkeyPatch) -> None:
    async with linked() as (connection, _):
        parsed: list[bytes] = []
        monkeypatch.setattr(connection.websocket.protocol, "receive_data", parsed.append)
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.window.sent(1, 0.0)
        of_no_frame = text('{"ack": 2}')
        for data in (text('{"ack": 1}'), of_no_frame):
            connection.websocket.data_received(data)
        assert connection.window.acknowledging
        assert parsed == [of_no_frame]


def text(said: str, *, opcode: Opcode = Opcode.TEXT, last: bool = True) -> bytes:
    """Return a message of a client, or a part of one, as it comes from the network."""
    return RawFrame(opcode, said.encode(), fin=last).serialize(mask=True)


async def test_acknowledgements_are_read_however_the_network_cuts_them() -> None:
    said = [text('{"ack": 1}'), text('{"ack": 2}'), text("other"), text('{"ack": 3}')]
    whole = b"".join(said)
    async with linked() as (connection, _):
        heard: list[int] = []
        connection.acknowledged = lambda frame_id, now: heard.append(frame_id)  # type: ignore[method-assign]
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.window.sent(3, 0.0)
        for cut in range(len(whole)):
            for part in (whole[:cut], whole[cut:]):
                if part:
                    connection.websocket.data_received(part)
            assert heard == [1, 2, 3], f"cut after {cut} bytes"
            assert await connection.websocket.recv() == "other"
            heard.clear()
        for part in said:
            connection.websocket.data_received(part)
        assert (heard, await connection.websocket.recv()) == ([1, 2, 3], "other")


@pytest.mark.parametrize(
    ("before", "code"),
    [
        (text("be", last=False), 1002),  # RFC 6455, 5.4: parts of different messages must not be mixed
        (RawFrame(Opcode.CLOSE, b"\x03\xe8").serialize(mask=True), 1000),
    ],
    ids=["within a message of several parts", "after the close"],  # masks are random
)
async def test_an_acknowledgement_where_no_message_may_come_is_not_read(before: bytes, code: int) -> None:
    async with linked() as (connection, client):
        heard: list[int] = []
        connection.acknowledged = lambda frame_id, now: heard.append(frame_id)  # type: ignore[method-assign]
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.window.sent(1, 0.0)
        connection.websocket.data_received(before)
        connection.websocket.data_received(text('{"ack": 1}'))
        assert heard == []
        await client.wait_closed()
        assert client.close_code == code


async def test_bytes_like_an_acknowledgement_within_another_message_are_not_read() -> None:
    inner = text('{"ack": 1}')
    header = bytes((0x82, 0x80 | len(inner), 0, 0, 0, 0))  # binary, masked by zeros
    async with linked() as (connection, _):
        heard: list[int] = []
        connection.acknowledged = lambda frame_id, now: heard.append(frame_id)  # type: ignore[method-assign]
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.window.sent(1, 0.0)
        for cut in range(1, len(header) + 1):
            for part in (header[:cut], header[cut:], inner):
                if part:
                    connection.websocket.data_received(part)
            assert (heard, await connection.websocket.recv()) == ([], inner)


async def test_messages_of_all_lengths_are_sent() -> None:
    async with linked() as (connection, client):
        socket = connection.websocket
        assert isinstance(socket, PlayerSocket)
        for length in (0, 1, 125, 126, 65_535, 65_536, 200_000):
            data = bytes(number % 251 for number in range(length))
            while not socket.free:
                await asyncio.sleep(0)
            socket.send_now(data)
            assert await client.recv() == data


async def test_acknowledgements_count_among_the_messages_of_a_second() -> None:
    connection = Connection(_Socket())  # type: ignore[arg-type]
    inbound = Inbound(connection.window)
    connection.window.sent(1, 0.0)
    heard = [inbound.acknowledged(b'{"ack":1}', 5.0) for _ in range(MESSAGES_A_SECOND + 1)]
    assert heard.count(1), heard.count(None) == (MESSAGES_A_SECOND, 1)


class _Socket:
    subprotocol = SUBPROTOCOLS[0]

    def __init__(self) -> None:
        self.transport = self

    def get_extra_info(self, _: str) -> None:
        return None
