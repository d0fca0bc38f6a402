"""Programs that watch a trial in which a participant plays, and advise where the project allows it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from hippodrome.trial.recordings import resume
from hippodrome.trial.server.watch import MAX_PROGRAMS, Watchers
from tests.trial.two_players import TRIAL, two_players

PROOF = "?token=the-secret-token"
ANSWER_SECONDS = 60


@contextlib.asynccontextmanager
async def program(server: Any, query: str = PROOF) -> Any:
    async with connect(server.address + "gym" + query, compression=None, proxy=None) as websocket:
        yield websocket


async def ask(websocket: ClientConnection, method: str, **params: Any) -> Any:
    """Send a request; return its answer, without the lines that come before it."""
    await websocket.send(json.dumps({"method": method, "params": params}))
    while True:
        said = await next_line(websocket)
        if not (isinstance(said, dict) and "kind" in said):
            return said


async def next_line(websocket: ClientConnection) -> Any:
    async with asyncio.timeout(ANSWER_SECONDS):
        return json.loads(await websocket.recv())


async def closed(websocket: ClientConnection) -> int | None:
    """Wait until the server closes the connection; return the code."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            await websocket.recv()
    return websocket.close_code


async def steps(websocket: ClientConnection, count: int) -> list[dict[str, Any]]:
    """Return the next lines of steps."""
    found: list[dict[str, Any]] = []
    while len(found) < count:
        line = await next_line(websocket)
        if line["kind"] == "step":
            found.append(line)
    return found


async def test_a_program_sees_each_step_as_it_is_recorded(launch, open_client, grid):
    server = launch(grid(20), {"gym": "watch", "maxEpisodes": 1, "recordObservations": True, "startingFrameRate": 60})
    async with program(server) as websocket:
        assert await ask(websocket, "watch") is True
        async with open_client(server.address) as client:
            await client.hello()
            await client.until(lambda: client.controls)
            await client.say(action="right", held=True)
            await client.say(command="start")
            lines = [await next_line(websocket)]
            while lines[-1]["kind"] != "end":
                lines.append(await next_line(websocket))
            await client.closed()
    assert server.wait() == 0
    (recorded,) = server.recordings().values()
    assert lines == recorded[1:]  # without the header
    assert [line["kind"] for line in lines] == ["reset", *["step"] * 20, "end"]
    assert {"reward", "action", "terminated", "observation"} <= lines[1].keys()


async def test_advice_is_taken_for_one_step_while_no_key_acts_and_recorded_as_such(launch, open_client, grid):
    server = launch(grid(None), {"gym": "advise", "startingFrameRate": 30})

    async def advise(websocket: ClientConnection, client: Any) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        assert await ask(websocket, "action_space") == {
            "name": "Discrete",
            "n": 6,
            "names": ["noop", "up", "right", "left", "down", "upright"],
        }
        await ask(websocket, "watch")
        assert await ask(websocket, "advise", action=3) is True
        alone = await steps(websocket, 4)
        await client.say(action="up", held=True)
        while (await steps(websocket, 1))[0]["human"] is None:
            pass
        await ask(websocket, "advise", action=3)
        return alone, await steps(websocket, 3)

    async with program(server) as websocket, open_client(server.address) as client:
        await client.play()
        async with client.reading():
            alone, together = await advise(websocket, client)
    advised = [line for line in alone if line["by"] == "advice"]
    assert [(line["action"], line["actionName"], line["advice"], line["human"]) for line in advised] == [
        (3, "left", 3, None)
    ]
    assert {line["by"] for line in alone} == {"advice", "none"}
    assert {(line["by"], line["action"]) for line in together} == {("human", 1)}


def test_a_resumed_trial_takes_the_recorded_advice_again() -> None:
    recorded = resume.RecordedTrial()
    line = {"kind": "step", "episode": 1, "human": None, "action": 3, "reward": 1.0}
    resume.add_lines(recorded, [{"kind": "reset", "episode": 1, "seed": 4}, line, {**line, "advice": 3}])
    assert recorded.unfinished is not None
    assert [step.advice for step in recorded.unfinished.steps] == [None, 3]


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"method": "advise", "params": {"action": 6}}, "there is no action 6; there are 0 to 5"),
        ({"method": "advise", "params": {"action": -1}}, "there is no action -1; there are 0 to 5"),
        ({"method": "advise", "params": {"action": "left"}}, "action must be the number of an action"),
        ({"method": "advise", "params": []}, "action must be the number of an action"),
        ({"method": "make", "params": {}}, "there are the methods watch, action_space and advise"),
        ({"method": []}, 'a request is {"method": ..., "params": {...}}'),
        ([], 'a request is {"method": ..., "params": {...}}'),
    ],
)
async def test_a_wrong_request_gets_a_sentence(launch, open_client, grid, request_, words):
    server = launch(grid(None), {"gym": "advise"})
    async with program(server) as websocket, open_client(server.address) as client:
        await client.play(1)
        await websocket.send(json.dumps(request_))
        error, watching = await next_line(websocket), await ask(websocket, "watch")
    assert error["error"]["message"] == words
    assert watching is True


async def test_a_program_may_not_advise_where_only_watching_is_allowed(launch, open_client, grid):
    server = launch(grid(None), {"gym": "watch"})
    async with program(server) as websocket, open_client(server.address) as client:
        await client.play(1)
        assert "the project allows no advice" in (await ask(websocket, "advise", action=1))["error"]["message"]


async def test_advice_before_the_game_is_refused(launch, grid):
    server = launch(grid(None), {"gym": "advise"})
    async with program(server) as websocket:
        answers = await ask(websocket, "advise", action=1), await ask(websocket, "action_space")
    assert [answer["error"]["message"] for answer in answers] == ["no game is going on"] * 2


@pytest.mark.parametrize("query", ["", "?token=", "?token=other"])
async def test_a_program_without_the_token_may_not_watch(launch, grid, query):
    server = launch(grid(None), {"gym": "watch"})
    async with program(server, query) as websocket:
        assert await closed(websocket) == 4401


async def test_the_path_for_programs_exists_only_if_the_project_allows_it(launch, grid):
    server = launch(grid(None))
    with pytest.raises(InvalidStatus) as found:
        async with program(server):
            pass
    assert found.value.response.status_code == 404


async def test_the_number_of_programs_that_watch_is_limited(launch, grid):
    server = launch(grid(None), {"gym": "watch"})
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(MAX_PROGRAMS):
            await ask(await stack.enter_async_context(program(server)), "watch")
        async with program(server) as websocket:
            assert await closed(websocket) == 1013


async def test_a_program_does_not_keep_the_server_for_a_participant_who_stays_away(launch, grid):
    server = launch(grid(None), {"gym": "watch"}, IDLE_SECONDS="4")
    async with program(server) as websocket:
        await ask(websocket, "watch")
        assert await closed(websocket) == 1001
    assert server.wait() == 0


def test_a_program_that_reads_nothing_is_cut_off() -> None:
    cut = []
    watchers = Watchers()
    with watchers.lines(lambda: cut.append(True)) as lines:
        for _ in range(1000):
            watchers.tell(b"line")
        assert not cut
        watchers.tell(b"line")
        watchers.tell(b"line")
        assert (cut, len(lines)) == ([True], 1000)


async def test_a_program_that_reads_nothing_fills_no_memory_with_long_lines() -> None:
    cut = []
    watchers = Watchers()
    with watchers.lines(lambda: cut.append(True)) as lines:
        watchers.tell(b"x" * 20_000_000)  # one line may be of any length
        assert not cut
        assert len(await lines.get()) == 20_000_000
        for _ in range(16):
            watchers.tell(b"x" * 1_000_000)
        assert not cut
        watchers.tell(b"x" * 1_000_000)
        assert (cut, len(lines)) == ([True], 16)


async def test_a_program_plays_one_of_two_players_in_its_turns(launch, open_client):
    players = {"left": "human", "right": "gym://learner"}
    keys = {"gym": "advise", "pace": "turns", "players": players, "startingFrameRate": 30, "policySeconds": 60}
    server = launch(two_players(turns=True), trial=TRIAL | keys)
    async with open_client(server.address) as client, program(server) as learner:
        await client.hello()
        await client.until(lambda: client.controls)
        assert await ask(learner, "watch") is True
        assert (await ask(learner, "action_space", player="right"))["names"] == ["noop", "up", "down"]
        assert "no such player" in (await ask(learner, "advise", action=1, player="middle"))["error"]["message"]
        await client.say(command="start")
        await client.until(lambda: client.state.get("toAct"))
        await client.say(action="up")
        (mine,) = await steps(learner, 1)
        assert mine["toAct"] == ["right"], "the program sees that it is its turn"
        assert await ask(learner, "advise", action=2) is True
        (its,) = await steps(learner, 1)
    part = its["players"]["right"]
    assert (part["action"], part["actionName"], part["by"]) == (2, "down", "advice")
    assert its["players"]["left"]["action"] is None
