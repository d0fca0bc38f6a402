"""What strangers and broken clients send."""

import asyncio
import contextlib
import json
import urllib.error
import urllib.request

import pytest
from websockets.exceptions import ConnectionClosed

from testing.waiting import until_async


async def test_a_wrong_hello_closes_the_connection(launch, open_client):
    server = launch()

    async def greet(expected, text=None, address="", **change):
        async with open_client(server.address + address) as client:
            if text is not None:
                await client.websocket.send(text)
            else:
                await client.hello(**change)
            assert await client.closed() == expected, (text, change)
            assert client.errors
            assert not client.frames
            return client.errors[-1]

    await asyncio.gather(
        greet(4401, token="wrong"),
        greet(4401, token=""),
        greet(4401, token=None),
        greet(4401, token=7),
        greet(4401, token="é\ud800"),
        greet(4401, userId="P2"),
        greet(4401, userId=None),
        greet(4401, userId=["P1"]),
        greet(4401, text="not json"),
        greet(4401, text="[]"),
        greet(4401, text=b"{}"),
        greet(4401, text='{"command": "start"}'),
        greet(4401, address="?token=wrong", token=None),
        greet(4401, address="?token=the-secret-token", token="wrong"),
        greet(4404, step="4"),
        greet(4404, step=4),
        greet(4401, step={}),
    )
    async with open_client(server.address) as client:  # the participant is still let in
        await client.play()
    async with open_client(server.address + "?token=the-secret-token") as client:
        await client.enter(token=None, step=3)
    log = server.log_text()
    assert "Traceback" not in log
    assert "wrong" not in log


async def test_a_client_that_says_nothing_is_closed(launch, open_client):
    server = launch(HELLO_SECONDS="1")
    async with open_client(server.address) as client:
        assert await client.closed() == 4408


async def test_wrong_messages_get_a_sentence_and_the_third_without_json_closes_the_connection(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play()
        bad = [
            {"command": "fly"},
            {"command": ["start"]},
            {"command": None},
            {"what": 1},
            {},
            {"action": 3},
            {"action": ""},
            {"action": "x" * 100},
            {"held": True},
            {"action": "left", "held": "yes"},
            {"changeFrameRate": "up"},
            {"changeFrameRate": True},
            {"changeFrameRate": None},
            {"ack": -1},
            {"ack": "1"},
            {"ack": 4_000_000_000},
        ]
        for number, message in enumerate(bad, 1):
            await client.say(**message)
            await client.until(lambda number=number: len(client.errors) == number)
        await client.websocket.send('{"changeFrameRate": 1e999}')
        await client.websocket.send('{"changeFrameRate": NaN}')
        await client.until(lambda: len(client.errors) == len(bad) + 2)
        for text in ("{", "[1]", b"\x00\xff"):
            await client.websocket.send(text)
        assert await client.closed() == 4400
    assert "Traceback" not in server.log_text()


async def test_too_long_a_message_closes_with_1009(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play()
        await client.websocket.send(json.dumps({"action": "x" * 5000}))
        assert await client.closed() == 1009
    async with open_client(server.address) as client:
        await client.websocket.send("x" * 4097)
        assert await client.closed() == 1009


async def test_a_flood_closes_with_4429(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play()
        with contextlib.suppress(ConnectionClosed):
            for _ in range(2000):  # ten times as many as are allowed in a second, however slow this machine is
                await client.say(action="left")
        assert await client.closed() == 4429
    async with open_client(server.address) as client:
        await client.enter()
        assert client.controls["state"] == "paused"


async def test_many_strangers_do_not_keep_the_participant_out(launch, open_client):
    server = launch()
    async with contextlib.AsyncExitStack() as stack:
        strangers = [await stack.enter_async_context(open_client(server.address)) for _ in range(90)]
        async with open_client(server.address) as client:
            await client.play()
        await until_async(lambda: sum(each.websocket.close_code is not None for each in strangers) >= 20)
        for stranger in strangers:
            stranger.websocket.transport.abort()
    assert "Traceback" not in server.log_text()


@pytest.mark.parametrize(("path", "status"), [("healthz", 200), ("", 426), ("etc/passwd", 404)])
def test_a_plain_http_request_gets_its_status(launch, path, status):
    server = launch()
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/{path}", timeout=20) as answer:
            found, text = answer.status, answer.read()
    except urllib.error.HTTPError as error:
        found, text = error.code, error.read()
    assert found == status
    assert text.strip()
    assert status != 200 or text == b"ok\n"
