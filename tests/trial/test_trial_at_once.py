"""Frames and acknowledgements take the short way of a connection, and everything else keeps its order."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.typing import Subprotocol

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
        yield await made.get(), client


def talked(talk: Callable[[Connection, Any], Coroutine[Any, Any, None]]) -> None:
    async def within() -> None:
        async with asyncio.timeout(20), linked() as (connection, client):
            await talk(connection, client)

    asyncio.run(within())


def test_a_picture_is_written_before_the_event_that_shows_it_is_over() -> None:
    async def talk(connection: Connection, client: Any) -> None:
        connection.put_picture(picture(7), 1)
        connection.send_now()
        assert connection.window.newest == 1, "no task had to wake up"
        assert np.array_equal(Decoder().decode(await client.recv())[1], picture(7))

    talked(talk)


def test_a_message_of_the_same_event_goes_first() -> None:
    async def talk(connection: Connection, client: Any) -> None:
        connection.put_picture(picture(7), 1)
        connection.send_state("state")
        connection.send_now()
        assert await client.recv() == "state"
        assert Decoder().decode(await client.recv())[0] == 1

    talked(talk)


def test_of_pictures_for_a_socket_that_is_full_the_newest_is_sent() -> None:
    async def talk(connection: Connection, client: Any) -> None:
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

    talked(talk)


def test_a_picture_that_cannot_be_packed_ends_its_connection_alone(caplog: pytest.LogCaptureFixture) -> None:
    async def talk(connection: Connection, client: Any) -> None:
        connection.put_picture(np.zeros((2, 3, 0), np.uint8), 1)
        connection.send_now()
        await client.wait_closed()

    talked(talk)
    assert "a picture cannot be sent" in caplog.text


def test_an_acknowledgement_is_heard_as_it_comes_and_the_rest_is_left() -> None:
    async def talk(connection: Connection, client: Any) -> None:
        connection.hear_acknowledgements(Inbound(connection.window))
        connection.put_picture(picture(7), 1)
        connection.send_now()
        others = [{"ack": 2}, {"ack": 1, "command": "start"}, {"ack": "1"}]
        for said in ({"ack": 1}, *others):
            await client.send(json.dumps(said))
        left = [json.loads(await connection.websocket.recv()) for _ in others]
        assert left == others
        assert connection.window.acknowledging

    talked(talk)


def test_acknowledgements_count_among_the_messages_of_a_second() -> None:
    async def count() -> tuple[int, int]:
        connection = Connection(_Socket())  # type: ignore[arg-type]
        inbound = Inbound(connection.window)
        connection.window.sent(1, 0.0)
        heard = [inbound.acknowledged(b'{"ack":1}', 5.0) for _ in range(MESSAGES_A_SECOND + 1)]
        return heard.count(1), heard.count(None)

    assert asyncio.run(count()) == (MESSAGES_A_SECOND, 1)


class _Socket:
    subprotocol = SUBPROTOCOLS[0]

    def __init__(self) -> None:
        self.transport = self

    def get_extra_info(self, _: str) -> None:
        return None
