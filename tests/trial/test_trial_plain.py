"""HIPPO's React front end on a real trial server: what it sends, word for word, and which pages need no token."""

import asyncio
import base64
import contextlib
import io
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from hippodrome.trial.core import messages
from hippodrome.trial.core.history import MessageLog
from hippodrome.trial.recordings import recording
from hippodrome.trial.server.handshake import NEEDS_PROOF, OTHER_ID, OTHER_ORIGIN, OTHER_STUDY
from hippodrome.trial.settings import TrialSettings
from hippodrome.trial.wire import plain
from testing.exploration import examples
from tests.trial.hippo_page import hippo_page

HERE = "https://play.example.org"
UI = {
    "left": True,
    "right": True,
    "start": True,
    "pause": True,
    "stop": True,
    "reset": True,
    "fpsUp": True,
    "fpsDown": True,
    "fpsSet": True,
}
TRIAL = {"startingFrameRate": 60, "maxEpisodes": 3, "allowFrameRateChange": True, "ui": UI}


def steps_in(server):
    lines = [line for lines in server.recordings().values() for line in lines]
    return [line for line in lines if line["kind"] == "step"]


def messages_in(server):
    lines = [line for lines in server.recordings().values() for line in lines]
    return [message for line in lines for message in line.get("messages", ())]


# ---- what it sends


async def test_hippos_page_plays_a_whole_session_that_is_recorded(launch, grid):
    server = launch(grid(None), TRIAL, PLAIN_ORIGINS=HERE)
    async with hippo_page(server.address) as page:
        await page.frames(1)
        assert sorted(page.ui) == sorted(UI)
        assert page.state == "ready"
        await page.mouse()
        await page.command("start")
        await page.frames(5)
        assert page.state == "playing"
        await page.key_down("ArrowLeft", "ArrowLeft")
        await page.wait_until_heard()
        await page.frames(20)
        await page.key_up("ArrowLeft", "ArrowLeft")
        await page.frames(10)
        await page.button("right")
        await page.wait_until_heard()
        await page.frames(15)
        await page.command("pause")
        await page.until(lambda: page.state == "paused")
        await page.frame_rate("40")
        await page.until(lambda: page.said[-1].get("frameRate") == 40)
        await page.command("start")
        await page.frames(5)
        await page.command("reset")
        await page.until(lambda: page.said[-1].get("episode") == 2)
        await page.frames(5)
        assert page.errors == []
        await page.command("stop")
        assert await page.closed() == 1000
        assert page.ended
    assert server.wait() == 0
    taken = steps_in(server)
    assert [step["human"] is not None for step in taken[:3]] == [False] * 3
    actions = [step["actionName"] for step in taken]
    assert actions.count("left") >= 18, "a key that is held acts until it goes up"
    assert actions.count("right") >= 18, "a click acts until the next action, over a pause, too"
    assert server.answer()["answers"]["outcome"] == "stopped"
    said = messages_in(server)
    first = next(each for each in said if "fields" in each)
    assert first["fields"]["info"] == "mouse move"
    assert first["fields"]["pos"]["xRel"] == 0.02
    assert first["fields"].keys() >= {"frameCount", "frameId"}
    start = next(each for each in said if each.get("command") == "start")
    assert start["fields"]["browser"] == "Chrome"
    assert {"KEYDOWN": ["ArrowLeft", 65]} in [each.get("fields", {}).get("KeyboardEvent") for each in said]
    assert 40 in [each.get("changeFrameRate") for each in said]
    assert "P1" not in json.dumps(said), "who plays stands in the folder's name alone"


async def test_the_game_goes_on_when_hippos_page_connects_again(launch, grid):
    server = launch(grid(None), TRIAL, PLAIN_ORIGINS=HERE, LINGER_SECONDS="60")
    async with hippo_page(server.address) as page:
        await page.command("start")
        await page.frames(10)
        last = page.frame_id
    async with hippo_page(server.address) as page:
        await page.frames(1)
        assert page.state == "paused"
        assert page.frame_id >= last
        await page.command("start")
        await page.frames(5)
        await page.command("stop")
        assert await page.closed() == 1000
    async with hippo_page(server.address) as page:  # before the process is gone
        assert await page.closed() == 1000


async def test_two_pages_of_one_participant_are_one_player(launch, grid):
    server = launch(grid(None), TRIAL, PLAIN_ORIGINS=HERE)
    async with hippo_page(server.address) as first:
        await first.frames(1)  # it is the first that the server knows
        async with hippo_page(server.address) as second:
            await second.frames(1)
            assert await first.closed() == 4409
            await second.command("start")
            await second.frames(5)


async def test_an_unknown_action_ends_the_last_one_as_with_hippo(launch, grid):
    server = launch(grid(None), {**TRIAL, "ui": {**UI}}, PLAIN_ORIGINS=HERE)
    async with hippo_page(server.address) as page:
        await page.command("start")
        await page.button("left")
        await page.wait_until_heard()
        await page.frames(5)
        await page.button("rotate")
        await page.until(lambda: page.errors)
        await page.frames(5)
        await page.command("stop")
        await page.closed()
    assert server.wait() == 0
    actions = [step["actionName"] for step in steps_in(server)]
    assert "left" in actions
    assert actions[-2:] == ["noop", "noop"]


async def test_a_client_of_our_own_protocol_gets_errors_for_hippos_forms(launch, open_client):
    server = launch(trial=TRIAL, PLAIN_ORIGINS=HERE)
    async with open_client(server.address) as client:
        await client.play()
        for message in ({"command": "start", "frameCount": 3}, {"changeFrameRate": "40"}):
            client.errors.clear()
            await client.say(**message)
            await client.until(lambda: client.errors)
        await client.say(action="left")
        await client.wait_until_heard()
        await client.see(5)
        await client.say(command="stop")
        await client.closed()
    assert server.wait() == 0
    assert [step["actionName"] for step in steps_in(server)].count("left") == 1


# ---- one message


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, messages.Message()),
        ({"command": " Start "}, messages.Message(command="start")),
        ({"command": "requestui"}, messages.Message(command="requestUI")),
        ({"command": "TRAINONLINE"}, messages.Message(command="trainOnline")),
        ({"command": "", "action": None}, messages.Message()),
        ({"command": "hint"}, messages.Message(fields={"command": "hint"})),
        ({"command": 7}, messages.Message(fields={"command": 7})),
        ({"changeFrameRate": " Faster"}, messages.Message(frame_rate="faster")),
        ({"changeFrameRate": "40"}, messages.Message(frame_rate=40.0)),
        ({"changeFrameRate": 40}, messages.Message(frame_rate=40.0)),
        ({"action": "LeftUp"}, messages.Message(action="leftup", lasts=True)),
        ({"action": "left", "held": True}, messages.Message(action="left", held=True)),
        ({"ack": "x", "userId": "P1", "token": "t"}, messages.Message(fields={"ack": "x"})),
        ({"long": "x" * 3600, "b": 1}, messages.Message(fields_dropped=2)),
    ],
)
def test_hippos_messages_are_read(fields, message):
    assert plain.parse(json.dumps(fields)) == message


@pytest.mark.parametrize(
    "fields",
    [
        {"changeFrameRate": "fast"},
        {"changeFrameRate": "nan"},
        {"changeFrameRate": "1e999"},
        {"action": 3},
        {"action": "x" * 65},
        {"action": "left", "held": "yes"},
    ],
)
def test_a_known_field_with_a_wrong_value_gets_a_sentence(fields):
    with pytest.raises(messages.BadMessage):
        plain.parse(json.dumps(fields))


TEXTS = st.text(st.characters(codec="utf-8"), max_size=40)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=12,
)
KNOWN = st.sampled_from(["command", "action", "held", "changeFrameRate", "ack", "userId", "token", "fields"])


@given(st.dictionaries(KNOWN | TEXTS, VALUES | st.sampled_from(["start", "left", "faster", "40"]), max_size=8))
@settings(max_examples=examples(300))
def test_any_message_is_read_or_gets_a_sentence_and_can_be_recorded(said):
    log = MessageLog()
    try:
        log.add(plain.parse(json.dumps(said)), 1)
    except messages.BadMessage as error:
        assert str(error)
        return
    kept = recording.line("step", messages=log.messages)
    assert len(kept) < 8 * plain.FIELDS_LENGTH
    line = json.loads(kept)
    assert all("token" not in each.get("fields", {}) for each in line["messages"])


def test_fields_nested_without_end_are_not_recorded():
    deep = '{"a":' * 600 + "1" + "}" * 600
    assert plain.parse(deep).fields is None
    with pytest.raises(messages.NotAMessage):
        plain.parse('{"a":' * 100_000 + "1" + "}" * 100_000)


@pytest.mark.parametrize(("opened", "closed"), [("[", "]"), ('{"a":', "}")])
def test_fields_are_recorded_twenty_levels_deep(opened, closed):
    def fields(levels):
        return plain.parse(f'{{"said":{opened * (levels - 1)}1{closed * (levels - 1)}}}').fields

    assert fields(20) is not None
    assert fields(21) is None


# ---- who may play without a token


async def first_answer(server, **options):
    """Open a page; return the sentence that refuses it, or None if it gets a frame."""
    async with hippo_page(server.address, **options) as page:
        await page.until(lambda: page.frame_count)
        assert bool(page.ui) != bool(page.instructions)
        return page.instructions[0] if page.instructions else None


@pytest.mark.parametrize(
    ("origins", "user_id", "origin", "words"),
    [
        (HERE, "P1", HERE, None),
        (f"https://other.example.org {HERE}", "P1", HERE, None),
        ("", "P1", HERE, NEEDS_PROOF),
        (HERE, "P1", None, OTHER_ORIGIN),
        (HERE, "P1", "null", OTHER_ORIGIN),
        (HERE, "P1", "http://play.example.org", OTHER_ORIGIN),
        (HERE, "P1", f"{HERE}.evil.example", OTHER_ORIGIN),
        (HERE, "P1", f"{HERE}:8443", OTHER_ORIGIN),
        (HERE, "P1", "https://other.example.org", OTHER_ORIGIN),
        (HERE, "P2", HERE, OTHER_ID),
        (HERE, "p1", HERE, OTHER_ID),
        (HERE, "", HERE, OTHER_ID),
        (HERE, "P1 ", HERE, OTHER_ID),
    ],
)
async def test_the_id_and_the_origin_open_the_server_where_that_is_allowed(launch, origins, user_id, origin, words):
    server = launch(trial=TRIAL, PLAIN_ORIGINS=origins)
    assert await first_answer(server, user_id=user_id, origin=origin) == words


async def test_a_page_of_another_study_cannot_play_this_one(launch):
    """A participant's DNS name leads to one server, whatever studies they take part in."""
    server = launch(trial=TRIAL, PLAIN_ORIGINS=HERE)

    async def come(project_id):
        async with connect(server.address, proxy=None, origin=HERE) as websocket:
            await websocket.send(json.dumps({"userId": "P1", "projectId": project_id}))
            return json.loads(await websocket.recv())

    assert (await come("other"))["Instructions"] == [OTHER_STUDY]
    assert "actionSpace" in await come("study")


async def test_a_request_with_two_origins_is_refused(launch):
    server = launch(trial=TRIAL, PLAIN_ORIGINS=HERE)
    with pytest.raises(InvalidStatus) as refused:
        await first_answer(server, headers={"Origin": "https://evil.example"})
    assert refused.value.response.status_code == 400


async def closed_with(server, hello, **options):
    async with connect(server.address, proxy=None, **options) as websocket:
        await websocket.send(json.dumps(hello))
        said = []
        with contextlib.suppress(ConnectionClosed):
            while True:
                said.append(await websocket.recv())
        return said, websocket.close_code, websocket.close_reason


@pytest.mark.parametrize("token", ["", "wrong", "the-secret-toke"])
async def test_a_wrong_token_is_refused_whatever_the_origin(launch, token):
    server = launch(trial=TRIAL, PLAIN_ORIGINS=HERE)
    _, code, _ = await closed_with(server, {"userId": "P1", "token": token}, origin=HERE)
    assert code == 4401


async def test_our_own_page_always_needs_its_token(launch):
    server = launch(trial=TRIAL, PLAIN_ORIGINS=HERE)
    _, code, _ = await closed_with(server, {"userId": "P1"}, origin=HERE, subprotocols=["hippodrome"])
    assert code == 4401


async def test_a_program_without_a_token_is_closed_and_told_what_is_missing(launch):
    server = launch(trial=TRIAL)
    said, code, reason = await closed_with(server, {"userId": "P1"})
    assert said == [messages.error(NEEDS_PROOF)]
    assert code == 4401
    assert NEEDS_PROOF.startswith(reason)
    assert "sends no token" in reason


def test_a_warm_server_lets_no_page_in_without_the_token():
    env = {
        "PROJECT_ID": "a",
        "SERVER": "c",
        "TOKEN": "d",
        "GAME_STEPS": "1",
        "STORE": "e",
        "TRIAL": "{}",
        "TLS": "off",
        "PLAIN_ORIGINS": HERE,
    }
    assert TrialSettings.from_env({**env, "USER_ID": "b"}).plain_origins == {HERE}
    assert TrialSettings.from_env({**env, "WARM_SERVER": "on"}).plain_origins == frozenset()


async def test_a_refused_page_shows_the_sentence_and_stays_connected(launch):
    server = launch(trial=TRIAL)
    async with hippo_page(server.address) as page:
        await page.until(lambda: page.instructions)
        assert page.instructions == [NEEDS_PROOF]
        assert page.ui == []
        await page.command("start")
        await page.watch(1.5)
        assert page.frame_count == 1
        picture = Image.open(io.BytesIO(base64.b64decode(page.said[1]["frame"]))).convert("L")
        assert picture.size == (600, 400)
        assert 0.01 < sum(picture.histogram()[:100]) / (600 * 400) < 0.2, "words, black on white"
        left, top, right, bottom = picture.point(lambda grey: 255 * (grey < 100)).getbbox()
        assert left > 10
        assert top > 10
        assert right < 590
        assert bottom < 390
        assert not page.ended
        assert page.websocket.close_code is None
    server.terminate()
    assert server.wait() == 0


async def test_refused_pages_neither_flood_the_server_nor_keep_the_participant_out(launch):
    server = launch(trial=TRIAL)
    async with hippo_page(server.address) as page:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(2000):
                await page.command("start")
                await asyncio.sleep(0)
        assert await page.closed() == 4429
    async with asyncio.TaskGroup() as group:
        pages = [hippo_page(server.address) for _ in range(80)]
        for page in pages:
            await page.__aenter__()
        async with connect(f"{server.address}?token=the-secret-token", proxy=None) as websocket:
            await websocket.send('{"userId": "P1"}')
            assert "UI" in json.loads(await websocket.recv())
        for page in pages:
            group.create_task(page.__aexit__(None, None, None))


async def test_a_flood_of_fields_ends_the_connection_and_the_recording_stays_small(launch, grid):
    server = launch(grid(None), TRIAL, PLAIN_ORIGINS=HERE)
    async with hippo_page(server.address) as page:
        await page.command("start")
        await page.frames(2)
        with contextlib.suppress(ConnectionClosed):
            for number in range(2000):
                await page.send(junk="x" * 3500, number=number)
        assert await page.closed() == 4429
    async with hippo_page(server.address) as page:
        await page.command("start")
        await page.frames(3)
        await page.command("stop")
        await page.closed()
    assert server.wait() == 0
    assert "xxxx" not in json.dumps(messages_in(server))
    assert any(each.get("fieldsDropped") == 4 for each in messages_in(server))
