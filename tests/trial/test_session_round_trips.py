"""Members whose browsers are far away: round trips are measured and recorded, and `maxPing` refuses them."""

import asyncio
import contextlib
import json
import math

from websockets.asyncio.client import ClientConnection, connect
from websockets.frames import Frame, Opcode

from tests.trial.far_away import far_away
from tests.trial.sessions import (
    MEMBERS,
    SID,
    TOKEN,
    answer,
    hello_of,
    launch_formed,
    member,
    recordings,
)


@contextlib.asynccontextmanager
async def near_and_far(server, seconds):
    """Connect both members; bert's messages take `seconds` each way."""
    async with (
        far_away(server.port, seconds) as slow,
        member(server, "anna") as anna,
        member(server, "bert", port=slow) as bert,
    ):
        yield anna, bert


async def test_the_recording_holds_each_members_round_trips(launch):
    server = launch_formed(launch, trial={"pingSamples": 3, "maxPing": 5000})
    async with near_and_far(server, 0.3) as (anna, bert):
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
        await anna.say(command="stop")
        await asyncio.gather(anna.closed(), bert.closed())
    assert server.wait() == 0
    (lines,) = recordings(server.store).values()
    trips = {}
    for line in lines:
        if line["kind"] in ("ping", "reset"):
            trips |= line.get("roundTrip", {})
    assert trips.keys() == {"left", "right"}
    assert trips["right"] >= 600
    assert trips["left"] < trips["right"]


async def test_a_member_who_is_too_far_away_and_the_others_are_told_so(launch):
    server = launch_formed(launch, trial={"pingSamples": 3, "maxPing": 700})
    async with near_and_far(server, 0.4) as (anna, bert):
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
        assert (anna.done["outcome"], bert.done["outcome"]) == ("partnerLeft", "ping")
        assert anna.errors
        assert bert.errors
    assert server.wait() == 0
    found = {each: answer(server.store, each)["answers"] for each in MEMBERS}
    assert {each: said["outcome"] for each, said in found.items()} == {"anna": "partnerLeft", "bert": "ping"}
    assert {said["session"] for said in found.values()} == {SID}


async def test_the_others_play_on_without_a_member_who_is_too_far_away(launch):
    instead = {"substitute": "idle", "afterAbsent": "policy"}
    server = launch_formed(launch, trial={"pingSamples": 3, "maxPing": 700, **instead})
    async with near_and_far(server, 0.4) as (anna, bert):
        assert await bert.closed() == 1000
        assert answer(server.store, "bert")["answers"]["outcome"] == "ping"
        await anna.until(lambda: len(anna.frames) > 20)
        assert not (server.store / "study/users/anna/answers/3.json").exists()
        await anna.stop()
    assert server.wait() == 0
    assert answer(server.store, "anna")["answers"]["outcome"] == "stopped"


async def test_a_member_who_is_too_far_away_is_refused_in_the_later_games_too(launch):
    """They come to the next game before the others, who still play, and would be sent away again and again."""
    instead = {"substitute": "idle", "afterAbsent": "policy"}
    trial = {"pingSamples": 3, "maxPing": 150, "countdown": 0, **instead}
    server = launch_formed(launch, trial=trial, GAME_STEPS="3,5,7")
    later = {"outcome": "ping", "player": "right", "session": SID}
    async with near_and_far(server, 0.15) as (anna, bert):
        assert await bert.closed() == 1000
        assert [answer(server.store, "bert", step)["answers"] for step in "57"] == [later, later]
        await anna.until(lambda: len(anna.frames) > 5)
        await anna.stop()
    async with member(server, "anna", step="5") as anna:
        await anna.until(lambda: anna.state.get("state") == "playing")
        assert anna.state["people"]["right"] == "policy"


class CountsPings(ClientConnection):
    pings = 0

    def process_event(self, event):
        self.pings += isinstance(event, Frame) and event.opcode is Opcode.PING
        super().process_event(event)


async def test_only_a_session_sends_pings_of_its_own(launch):
    """A server of one participant sends no ping of its own."""

    async def pings(server, hello, most=math.inf, seconds=2):
        async with connect(
            server.address, create_connection=CountsPings, subprotocols=["hippodrome"], proxy=None
        ) as websocket:
            await websocket.send(json.dumps(hello))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while websocket.pings < most:
                        await asyncio.sleep(0.02)
            return websocket.pings

    alone = launch()
    assert await pings(alone, {"userId": "P1", "token": TOKEN, "step": "3"}) == 0
    server = launch_formed(launch)
    assert await pings(server, hello_of("anna"), 5, 20) == 5
