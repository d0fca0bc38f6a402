"""The server of a session on AWS has no rights: it reads and stores by presigned requests, as for one participant."""

import asyncio
import json

import pytest

from hippodrome.control.model.server import Reason
from hippodrome.protocol.keys import answer_key, session_key
from hippodrome.trial.recordings import recording
from tests.trial.sessions import MEMBERS, SID, document, hello_of, launch_session
from tests.trial.test_trial_presigned import Town


@pytest.fixture
def town():
    with Town().serving() as made:
        yield made


def form(town, session=None):
    with town.lock:
        town.documents.put(session_key("study", SID), (session or document()).to_json())


def recordings(town, name):
    start = f"study/sessions/{SID}/trials/{name}/"
    with town.lock:
        return {key: recording.read(kept[0]) for key, kept in town.documents.kept.items() if key.startswith(start)}


async def play(launched, open_client, *, frames=10, stop=True):
    """Let both members play; then one of them stops the game, or the server is told to end."""
    async with open_client(launched.address) as anna, open_client(launched.address) as bert:
        for client, user_id in ((anna, "anna"), (bert, "bert")):
            await client.hello(**hello_of(user_id))
            await client.until(lambda client=client: client.controls)
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= frames) for each in (anna, bert)))
        if stop:
            await anna.say(command="stop")
        else:
            launched.terminate()
        codes = await asyncio.gather(anna.closed(), bert.closed())
    assert launched.wait() == 0
    return codes


async def test_a_session_is_stored_by_presigned_requests_alone_and_goes_on_on_the_next_server(
    town, launch, open_client
):
    first = town.start(user=SID)
    running = launch_session(launch, **town.variables(first))
    form(town)
    assert await play(running, open_client, frames=30, stop=False) == [1001, 1001]
    lost = town.close(first, Reason.LOST)
    (before,) = recordings(town, first.name).values()
    second = town.start(user=SID, attempt=2, before=lost)
    assert await play(launch_session(launch, **town.variables(second)), open_client) == [1000, 1000]
    (after,) = recordings(town, second.name).values()
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert after[0]["seed"] == before[0]["seed"]
    for each, outcome in {"anna": "stopped", "bert": "partnerLeft"}.items():
        found = json.loads(town.body(answer_key("study", each, "3")))["answers"]
        assert (found["outcome"], found["session"]) == (outcome, SID)
    assert [seen for seen in town.requests if seen[2] not in (200, 404)] == []


async def test_a_warm_server_that_a_session_gets_stores_what_the_session_leaves(town, launch, open_client):
    warm = town.start_warm()
    told = {"WARM_SERVER": "on", "SESSION": "", "ASSIGNMENT_SECONDS": "0.2"}
    running = launch_session(launch, **{**town.variables(warm), **told})
    own = town.hand_over(warm, SID)
    form(town)
    assert await play(running, open_client) == [1000, 1000]
    assert recordings(town, own)
    assert all(town.body(answer_key("study", each, "3")) for each in MEMBERS)
