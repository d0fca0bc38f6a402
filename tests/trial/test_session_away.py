"""Two members on a real server: a page stops answering, a member forges acknowledgements, a policy takes a place."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from hippodrome.trial.settings import STALLED_SECONDS
from tests.trial.sessions import answer, launch_formed, member, recordings

AS_PLAYED = str(STALLED_SECONDS)
pytestmark = pytest.mark.timeout(90)


async def until_both_play(anna: Any, bert: Any) -> None:
    for client in (anna, bert):
        await client.until(lambda client=client: client.state.get("state") == "playing")


def people_seen_by(client: Any) -> dict[str, str]:
    found: dict[str, str] = client.state.get("people", {})
    return found


async def test_a_page_that_stops_answering_is_away_and_returns_by_its_acknowledgement_alone(launch):
    server = launch_formed(launch, trial={"startingFrameRate": 20}, STALLED_SECONDS=AS_PLAYED)
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await until_both_play(anna, bert)
        await anna.until(lambda: len(anna.frames) > 5)
        anna.acks = False
        await asyncio.wait_for(bert.until(lambda: people_seen_by(bert).get("left") == "away"), 60)
        assert bert.state["state"] == "paused"
        held = len(bert.frames)
        await anna.until(lambda: people_seen_by(anna).get("left") == "away")
        await anna.say(ack=anna.frames[-1][1])
        anna.acks = True
        await asyncio.wait_for(bert.until(lambda: people_seen_by(bert).get("left") == "here"), 60)
        await bert.until(lambda: bert.state["state"] == "playing" and len(bert.frames) > held + 5)


async def test_a_policy_of_agent_py_takes_a_lost_members_place_and_gives_it_back(launch):
    trial = {"startingFrameRate": 20, "substitute": "agent:Partner", "afterAbsent": "policy", "absent": 1}
    server = launch_formed(launch, trial=trial)
    async with member(server, "bert") as bert:
        async with member(server, "anna") as anna:
            await until_both_play(anna, bert)
        await asyncio.wait_for(bert.until(lambda: people_seen_by(bert).get("left") == "policy"), 60)
        await bert.until(lambda: bert.state["state"] == "playing")
        seen = len(bert.frames)
        await bert.until(lambda: len(bert.frames) > seen + 5)
        async with member(server, "anna") as anna:
            await anna.say(action="up", held=True)
            seen = len(anna.frames)
            await anna.until(lambda: len(anna.frames) > seen + 5)
            assert people_seen_by(anna) == {"left": "here", "right": "here"}
            await anna.say(command="stop")
            await anna.until(lambda: anna.done)
            await bert.until(lambda: bert.done)
    assert server.wait() == 0, server.log_text()
    lines = [line for found in recordings(server.store).values() for line in found]
    head = next(line for line in lines if line["kind"] == "header")
    assert head["players"]["left"] == {
        "kind": "human",
        "substitute": {"kind": "policy", "policy": "agent:Partner"},
        "seat": 0,
    }
    moved = [(line["player"], line["what"]) for line in lines if line["kind"] == "presence"]
    assert [what for player, what in moved if player == "left"][:4] == ["joined", "left", "replaced", "returned"]
    by = [line["players"]["left"]["by"] for line in lines if line["kind"] == "step"]
    assert "policy" in by
    assert by[-1] == "human", "she plays again"
    last = [line for line in lines if line["kind"] == "step"][-1]["players"]["left"]
    assert last["pressedAt"] <= lines[-1]["ns"]
    outcomes = {user: answer(server.store, user)["answers"]["outcome"] for user in ("anna", "bert")}
    assert outcomes == {"anna": "stopped", "bert": "partnerLeft"}


@pytest.mark.parametrize("forged", ["none", "of what was not sent", "before it is shown"])
async def test_whatever_a_member_acknowledges_the_other_sees_the_game_go_on(launch, forged):
    """Acknowledgements control the pace of a member's own pictures alone."""
    server = launch_formed(launch, trial={"startingFrameRate": 20}, STALLED_SECONDS=AS_PLAYED)

    async def forge(bert):
        while forged != "none":
            newest = bert.frames[-1][1] if bert.frames else 0
            await bert.say(ack=newest + (1000 if forged == "of what was not sent" else 0))
            await asyncio.sleep(0.02)

    async with member(server, "anna") as anna, member(server, "bert") as bert:
        bert.acks = False
        tasks = [asyncio.create_task(forge(bert)), asyncio.create_task(bert.watch(60))]
        await anna.until(lambda: len(anna.frames) > 10)
        first = len(anna.frames)
        while len(anna.frames) < first + 80:  # four seconds: after these, a page that does not answer is away
            await anna.take()
            assert anna.state["people"] == {"left": "here", "right": "here"}
        for task in tasks:
            task.cancel()
    assert "Traceback" not in server.log_text()
