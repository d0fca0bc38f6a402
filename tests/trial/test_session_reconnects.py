"""A member who connects to a real server again and again: how often they are let in, and what the others notice."""

import asyncio
import contextlib
import time

from websockets.exceptions import ConnectionClosed

from hippodrome.trial.server.admission import AT_ONCE, SECONDS_EACH
from tests.trial.sessions import hello_of, launch_formed, member, recordings

ON = {"afterAbsent": "policy", "substitute": "random"}


async def connects(server, open_client, user_id):
    """Connect as the member, and leave as soon as they are let in; return the code of a refusal, or None."""
    async with open_client(server.address) as client:
        await client.hello(**hello_of(user_id))
        try:
            await client.until(lambda: client.controls)
        except ConnectionClosed:
            return client.websocket.close_code
    return None


async def test_a_member_who_connects_hundreds_of_times_is_told_to_wait_and_the_others_play(launch, open_client):
    server = launch_formed(launch, trial=ON)
    async with member(server, "bert") as bert:
        async with bert.reading():
            codes, began = [], time.monotonic()
            while codes.count(4429) < 100:
                codes.append(await connects(server, open_client, "anna"))
            lasted = time.monotonic() - began
        await bert.until(lambda: len(bert.frames) > 5)
        assert bert.websocket.close_code is None
        await asyncio.sleep(SECONDS_EACH)
        async with member(server, "anna") as anna:
            await anna.say(command="stop")
            await asyncio.gather(anna.closed(), bert.closed())
    assert set(codes[:AT_ONCE]) == {None}
    assert codes.count(None) <= AT_ONCE + 1 + lasted / SECONDS_EACH
    (lines,) = recordings(server.store).values()
    of_anna = [line for line in lines if line["kind"] == "presence" and line["player"] == "left"]
    assert len([line for line in of_anna if line["what"] in ("joined", "returned")]) <= codes.count(None) + 1


async def test_one_members_connections_are_not_counted_against_another(launch, open_client):
    server = launch_formed(launch, trial=ON)
    async with member(server, "anna") as anna, anna.reading():
        while (code := await connects(server, open_client, "bert")) is None:
            pass
        async with member(server, "anna"):
            assert code == 4429


async def test_a_refused_connection_does_not_replace_the_one_that_plays(launch, open_client):
    server = launch_formed(launch, trial=ON)
    async with contextlib.AsyncExitStack() as stack:
        newest, refused = None, None
        while refused is None:
            playing = newest
            newest = await stack.enter_async_context(open_client(server.address))
            await newest.hello(**hello_of("anna"))
            try:
                await newest.until(lambda client=newest: client.controls)
            except ConnectionClosed:
                refused = newest.websocket.close_code
        await playing.watch(0.3)
        assert refused, playing.websocket.close_code == (4429, None)
