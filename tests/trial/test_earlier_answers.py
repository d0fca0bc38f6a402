"""The agent reads what participants have answered in the steps that `answers` names, before the first episode."""

import asyncio
import json

import msgspec
import pytest

from hippodrome.protocol.keys import answer_key
from tests.trial.conftest import grid_agent
from tests.trial.sessions import form, launch_session, member, put, recordings
from tests.trial.test_trial_presigned import Town
from tests.trial.test_trial_warm import hand_over
from tests.trial.two_players import two_players

ALONE = """
class Agent(Agent):
    def reset(self, seed=None, answers=None):
        first, info = super().reset(seed)
        return first, {**info, "reset": answers}
    def on_session_start(self, session):
        return session.answers
"""
TOGETHER = """
class Agent(Agent):
    on_session_start = lambda self, session: session.answers
"""


def stored(**fields):
    return json.dumps({"step": "1", "page": "beliefs", "answers": fields}).encode()


def told(lines):
    """The answers that the callback and `reset` have got, as the recording has them."""
    (called,) = [line["value"] for line in lines if line.get("callback") == "on_session_start"]
    (begun,) = [line for line in lines if line["kind"] == "reset"]
    return called, begun.get("info", {}).get("reset")


async def test_a_warm_server_gives_the_agent_the_answers_of_the_participant_who_comes(launch, open_client):
    server = launch(
        agent=grid_agent(3) + ALONE,
        trial={"answers": ["1"], "maxEpisodes": 1},
        WARM_SERVER="on", SERVER="sparesparesparespare-1", USER_ID="", ASSIGNMENT_SECONDS="0.2",
    )  # fmt: skip
    put(server.store, answer_key("study", "P1", "1"), stored(trust="4", likes=["a", "b"]))
    hand_over(server)
    async with open_client(server.address) as client:
        await client.start()
        await client.closed()
    (lines,) = server.recordings(server="a-1").values()
    expected = {"1": {"trust": "4", "likes": ["a", "b"]}}
    assert told(lines) == (expected, expected)


async def test_a_game_that_names_no_steps_gets_no_answers(launch, open_client):
    server = launch(agent=grid_agent(3) + ALONE, trial={"maxEpisodes": 1})
    put(server.store, answer_key("study", "P1", "1"), stored(trust="4"))
    async with open_client(server.address) as client:
        await client.start()
        await client.closed()
    (lines,) = server.recordings().values()
    assert told(lines) == ({}, None)


@pytest.fixture
def town():
    with Town().serving() as made:
        yield made


async def test_on_aws_the_answers_are_read_by_presigned_requests(town, launch, open_client):
    record = town.keep(msgspec.structs.replace(town.start(), read_steps=("1",)))
    with town.lock:
        town.documents.put(answer_key("study", "P1", "1"), stored(trust="4"))
    trial = {"answers": ["1"], "maxEpisodes": 1}
    server = launch(agent=grid_agent(3) + ALONE, trial=trial, **town.variables(record))
    async with open_client(server.address) as client:
        await client.start()
        await client.closed()
    assert server.wait() == 0
    (lines,) = town.recordings(record.name).values()
    assert told(lines)[0] == {"1": {"trust": "4"}}


async def test_a_server_that_may_not_read_them_ends_so_that_another_replaces_it(town, launch, open_client):
    """Its record is from before a registration that named them; the next server's record is not."""
    server = launch(agent=grid_agent(3) + ALONE, trial={"answers": ["1"]}, **town.variables(town.start()))
    async with open_client(server.address) as client:
        await client.hello()
        assert await client.closed() == 1011
    assert server.wait() == 1
    assert "answers to earlier steps cannot be read" in server.log_text()


async def test_a_session_begins_when_all_members_have_answered(launch):
    server = launch_session(launch, agent=two_players() + TOGETHER, trial={"answers": ["1"]})
    form(server.store)
    put(server.store, answer_key("study", "anna", "1"), stored(trust="4"))

    async def play(user_id):
        async with member(server, user_id) as client:
            await client.until(lambda: len(client.frames) >= 3)
            await client.say(command="stop")
            await client.closed()

    first = asyncio.create_task(play("anna"))
    await asyncio.sleep(1.5)
    assert not recordings(server.store)
    put(server.store, answer_key("study", "bert", "1"), stored(trust="2"))
    await asyncio.gather(first, play("bert"))
    (lines,) = recordings(server.store).values()
    assert told(lines)[0] == {"left": {"1": {"trust": "4"}}, "right": {"1": {"trust": "2"}}}


async def test_a_session_waits_no_longer_than_gather_for_answers(launch):
    trial = {"answers": ["1"], "gather": 0.5, "afterAbsent": "policy", "substitute": "idle"}
    server = launch_session(launch, agent=two_players() + TOGETHER, trial=trial)
    form(server.store)
    put(server.store, answer_key("study", "anna", "1"), stored(trust="4"))
    async with member(server, "anna") as anna:
        await anna.until(lambda: len(anna.frames) >= 3)
        await anna.say(command="stop")
        await anna.closed()
    (lines,) = recordings(server.store).values()
    assert told(lines)[0] == {"left": {"1": {"trust": "4"}}, "right": {}}
