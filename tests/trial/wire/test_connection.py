"""Which messages a connection keeps for sending, in which order it sends them, and what ends it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.typing import Subprotocol

from hippodrome.trial.pictures.frames import JPEG, Decoder, Frame
from hippodrome.trial.pictures.scene import Scene, as_scene
from hippodrome.trial.pictures.scene_encoder import HEADER, SCENE, SceneDecoder
from hippodrome.trial.wire.connection import SUBPROTOCOL, Connection
from testing.waiting import PATIENCE

NAMES = [Subprotocol(SUBPROTOCOL)]
MANY_BALLS = [{"id": f"ball{n}", "type": "circle", "x": 0.5, "y": 0.25, "radius": 10} for n in range(200)]


def picture(value: int, size: int = 4) -> Frame:
    return np.full((size, size, 3), value, np.uint8)


@contextlib.asynccontextmanager
async def connected(*, ours: bool = True, **options: Any) -> AsyncIterator[tuple[Connection, ClientConnection]]:
    """A connection that sends, and its client, over a real socket."""
    connections: asyncio.Queue[Connection] = asyncio.Queue()

    async def talk(websocket: ServerConnection) -> None:
        connection = Connection(websocket, **options)
        running = asyncio.create_task(connection.run())
        connections.put_nowait(connection)
        await websocket.wait_closed()
        running.cancel()

    names = NAMES if ours else None
    async with (
        serve(talk, "127.0.0.1", 0, subprotocols=names, compression=None, write_limit=(1, 0)) as server,
        connect(
            f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}",
            subprotocols=names,
            compression=None,
            proxy=None,
            max_size=None,
        ) as client,
        asyncio.timeout(PATIENCE),
    ):
        yield await connections.get(), client


class SentMessages:
    """A websocket that keeps the messages that it is given to send."""

    subprotocol = SUBPROTOCOL

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.transport = self

    def get_extra_info(self, _: str) -> None:
        return None

    async def send(self, data: Any) -> None:
        self.sent.append(data)

    async def close(self, code: int) -> None:
        self.sent.append(code)


@pytest.mark.parametrize("code", [1000, 4409])
async def test_a_connection_keeps_few_messages_but_never_loses_the_last_ones(code: int) -> None:
    websocket = SentMessages()
    connection = Connection(websocket)  # type: ignore[arg-type]
    for number in range(10_000):
        connection.send(str(number))
        connection.send_state(f"state {number}")
        connection.show(picture(number % 256), number)
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


async def test_a_picture_follows_the_messages_that_wait() -> None:
    async with connected() as (connection, client):
        connection.show(picture(7), 1)
        connection.send_state("state")
        connection.send("error")
        assert [await client.recv(), await client.recv()] == ["error", "state"]
        assert np.array_equal(Decoder().decode(await client.recv())[1], picture(7))  # type: ignore[arg-type]


@pytest.mark.parametrize("ours", [True, False], ids=["our subprotocol", "none"])
async def test_a_client_that_reads_slowly_gets_the_newest_picture_next(ours: bool) -> None:
    async with connected(ours=ours, decodes=["deflate"]) as (connection, client):
        for end, option in ((connection.websocket, socket.SO_SNDBUF), (client, socket.SO_RCVBUF)):
            # The kernel's own limits differ: some machines take 50 MB before a socket is full.
            end.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, option, 1 << 16)
        noise = np.random.default_rng(7)
        for number in range(1, 200):  # the client reads none of them
            connection.show(noise.integers(0, 256, (300, 400, 3), np.uint8), number)
            await asyncio.sleep(0)
        sent = connection.window.newest
        assert sent < 150, "the socket is full"
        while connection.window.newest == sent:
            await client.recv()
        assert connection.window.newest == 199, "pictures that are old by now are dropped"


@pytest.mark.parametrize("ours", [True, False], ids=["our subprotocol", "none"])
async def test_a_picture_that_cannot_be_packed_ends_its_connection(
    ours: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """The page connects again. If the connection stayed, the page would wait for pictures for ever."""
    async with connected(ours=ours) as (connection, client):
        width, depth = (3, 0) if ours else (65_535, 3)  # without a byte; wider than a JPEG may be
        connection.show(np.zeros((2, width, depth), np.uint8), 1)
        await client.wait_closed()
        assert client.close_code == 1006
    assert "a picture cannot be sent" in caplog.text


async def test_a_client_that_cannot_inflate_gets_every_picture_as_a_jpeg() -> None:
    async with connected(decodes=["jpeg"], lossless=True) as (connection, client):
        for number in (1, 2):
            connection.show(picture(number), number)
            data = await client.recv()
            assert isinstance(data, bytes)
            assert (data[0], Decoder().decode(data)[0]) == (JPEG, number)


async def test_a_client_that_cannot_inflate_gets_large_scenes_as_they_are() -> None:
    async with connected(decodes=["jpeg", "objects"]) as (connection, client):
        connection.show(as_scene(MANY_BALLS), 7)
        data, scene = await client.recv(), SceneDecoder()
        assert isinstance(data, bytes)
        assert HEADER.unpack_from(data) == (SCENE, 7)
        assert scene.decode(data) == 7
        assert len(scene.objects) == len(MANY_BALLS)


@pytest.mark.parametrize("decodes", ["jpeg", "deflate"])
async def test_a_client_that_draws_no_objects_gets_a_picture_of_them(decodes: str) -> None:
    def draw(_: Scene) -> Frame:
        return picture(7)

    async with connected(decodes=[decodes], draw=draw) as (connection, client):
        connection.show(as_scene(MANY_BALLS), 1)
        data = await client.recv()
        assert isinstance(data, bytes)
        assert (data[0] == JPEG) is (decodes == "jpeg")
        assert Decoder().decode(data)[1].mean() == 7
