"""A member who connects to a real server again and again: how often they are let in, and what the others notice."""

import asyncio

from websockets.exceptions import ConnectionClosed

from tests.trial.sessions import form, hello_of, launch_session, member, recordings
from trial.wire.reconnects import AT_ONCE, SECONDS_EACH

ON = {"afterAbsent": "policy", "substitute": "random"}


async def connects(server, open_client, user_id):
    """The member connects, and goes as soon as they are let in; the code with which they were refused, or None."""
    async with open_client(server.address) as client:
        await client.hello(**hello_of(user_id))
        try:
            await client.until(lambda: client.controls)
        except ConnectionClosed:
            return client.websocket.close_code
    return None


def test_who_connects_hundreds_of_times_is_told_to_wait_and_the_others_play(launch, open_client):
    server = launch_session(launch, trial=ON)
    form(server.store)

    async def run():
        async with member(server, "bert") as bert:
            codes = [await connects(server, open_client, "anna") for _ in range(150)]
            await bert.until(lambda: len(bert.frames) > 5)
            assert bert.websocket.close_code is None
            await asyncio.sleep(SECONDS_EACH)
            async with member(server, "anna") as anna:
                await anna.say(command="stop")
                await asyncio.gather(anna.closed(), bert.closed())
        return codes

    codes = asyncio.run(run())
    assert set(codes[:AT_ONCE]) == {None}
    assert 4429 in codes
    (lines,) = recordings(server.store).values()
    of_anna = [line for line in lines if line["kind"] == "presence" and line["player"] == "left"]
    assert len([line for line in of_anna if line["what"] in ("joined", "returned")]) < 60, "of 151"


def test_what_one_member_does_is_not_counted_against_another(launch, open_client):
    server = launch_session(launch, trial=ON)
    form(server.store)

    async def run():
        async with member(server, "anna"):
            codes = [await connects(server, open_client, "bert") for _ in range(AT_ONCE + 5)]
            async with member(server, "anna"):
                return codes

    assert asyncio.run(run())[-1] == 4429


def test_a_refused_connection_does_not_replace_the_one_that_plays(launch, open_client):
    server = launch_session(launch, trial=ON)
    form(server.store)

    async def run():
        for _ in range(AT_ONCE - 1):
            await connects(server, open_client, "anna")
        async with member(server, "anna") as anna:
            codes = [await connects(server, open_client, "anna") for _ in range(3)]
            await anna.watch(0.3)
            return codes, anna.websocket.close_code

    assert asyncio.run(run()) == ([4429] * 3, None)
