"""A warm server starts without a participant. After the handover it is the server of its participant, like any other."""

import asyncio
import contextlib
import json
import os
import queue
import time
import urllib.request

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosedError

from hippodrome.protocol import handover
from hippodrome.protocol.exits import NO_AGENT
from hippodrome.protocol.handover import BadHandover, Handover
from hippodrome.protocol.keys import handover_key
from hippodrome.trial.server import assignment
from hippodrome.trial.server.lifetime import Watchdog
from hippodrome.trial.settings import SettingsError, TrialSettings
from testing.waiting import PATIENCE, until_async

WARM_SERVER, OWN = "sparesparesparespare-1", "a-1"
UI = {"stop": True, "start": True}

REPORTING = """
import os
_told = {name: os.environ.get(name) for name in ("USER_ID", "GROUP")}
class Reporting(Agent):
    def start(self, game):
        self.told = [_told, {name: os.environ.get(name) for name in ("USER_ID", "GROUP")}]
        print("started", flush=True)
        return super().start(game)
    def reset(self, seed=None):
        seen, info = super().reset(seed)
        now = {name: os.environ.get(name) for name in ("USER_ID", "GROUP", "TOKEN")}
        return seen, {"before": self.told, "now": now}
Agent = Reporting
"""


@pytest.fixture
def launch_warm_server(launch):
    """Start a warm server: without USER_ID and GROUP."""

    def start(agent=None, trial=None, **env):
        told = {"WARM_SERVER": "on", "SERVER": WARM_SERVER, "USER_ID": "", "ASSIGNMENT_SECONDS": "60", **env}
        return launch(trial={"ui": UI, **(trial or {})}, **({} if agent is None else {"agent": agent}), **told)

    return start


def hand_over(server, user_id="P1", group=None, own=OWN, warm_server=WARM_SERVER):
    """Hand the warm server over to a participant, as the control plane does."""
    said = json.dumps({"schema": 1, "userId": user_id, "group": group, "server": own})
    write_handover(server, said.encode(), warm_server)


def write_handover(server, body, warm_server=WARM_SERVER):
    path = server.store / f"study/handovers/{warm_server}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".new")
    unfinished.write_bytes(body)
    unfinished.replace(path)


async def refused(server, open_client, code, **hello):
    async with open_client(server.address) as client:
        await client.hello(**hello)
        assert await client.closed() == code, client.errors
        assert client.errors
        assert not client.controls
        assert not client.frames
        return client.errors[-1]


async def play_to_the_end(server, open_client, frames=5):
    async with open_client(server.address) as client:
        await client.play(frames)
        await client.stop()
        return client


async def play_and_end(server, open_client, frames):
    """Play; then the server is told to go, as when Spot takes it back."""
    async with open_client(server.address) as client:
        await client.play(frames)
        server.terminate()
        assert await client.closed() == 1001


def steps(lines):
    return [line["step"] for line in lines if line["kind"] == "step"]


# ---- before the handover


async def test_a_warm_server_lets_no_client_in_before_it_is_handed_over(launch_warm_server, open_client):
    server = launch_warm_server()
    assert "not open yet" in await refused(server, open_client, 1013)
    await refused(server, open_client, 1013, userId="P2")
    await refused(server, open_client, 1013, userId="")
    await refused(server, open_client, 1013, userId=None)
    await refused(server, open_client, 4401, token="wrong")
    await refused(server, open_client, 4401, token="")
    await refused(server, open_client, 4401, userId="", token=None)
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/healthz", timeout=20) as answer:
        assert answer.status == 200
    assert server.process.poll() is None
    assert not server.store.exists(), "nothing is recorded"


async def test_only_a_client_with_the_token_makes_a_warm_server_look(launch_warm_server, open_client):
    server = launch_warm_server()
    await refused(server, open_client, 1013)  # its first look is over
    hand_over(server)
    for _ in range(5):
        await refused(server, open_client, 4401, token="wrong")
    assert "assigned to a participant now" not in server.log_text()
    await refused(server, open_client, 4401, userId="P2")
    assert "assigned to a participant now" in server.log_text()


def test_a_warm_server_waits_beyond_its_idle_time(launch_warm_server):
    server = launch_warm_server(IDLE_SECONDS="0", GRACE_SECONDS="0")
    time.sleep(1)
    assert server.process.poll() is None


def test_the_deadline_ends_a_warm_server_without_a_participant(launch_warm_server):
    server = launch_warm_server(DEADLINE=str(time.time() + 2))
    assert server.wait() == 0
    assert "deadline" in server.log_text()
    assert not server.store.exists()


async def test_sigterm_ends_a_warm_server_without_a_participant(launch_warm_server, open_client):
    server = launch_warm_server()
    await refused(server, open_client, 1013)
    server.terminate()
    assert server.wait() == 0
    assert "Traceback" not in server.log_text()
    assert not server.store.exists()


def test_a_warm_server_whose_agent_does_not_start_is_replaced(launch_warm_server):
    server = launch_warm_server("raise ValueError('broken')")
    assert server.wait() == NO_AGENT
    assert "ValueError: broken" in server.log_text()


# ---- after the handover


async def test_the_participant_plays_and_the_files_are_where_other_servers_store_them(launch_warm_server, open_client):
    server = launch_warm_server()
    hand_over(server, group=2)
    await play_to_the_end(server, open_client)
    assert server.wait() == 0
    assert server.answer()["group"] == 2
    assert server.answer()["answers"]["outcome"] == "stopped"
    (lines,) = server.recordings(server=OWN).values()
    assert (lines[0]["userId"], lines[0]["server"]) == ("P1", OWN)
    assert len(steps(lines)) == server.answer()["answers"]["frames"]
    assert not (server.store / "study/users/P1/trials" / WARM_SERVER).exists()
    assert not list(server.store.rglob("*.part"))
    assert "P1" not in server.log_text()


async def test_no_other_participant_gets_in_with_the_same_token(launch_warm_server, open_client):
    server = launch_warm_server()
    await refused(server, open_client, 1013, userId="P2")
    hand_over(server)
    for user_id in ("P2", "", None, WARM_SERVER):
        await refused(server, open_client, 4401, userId=user_id)
    await refused(server, open_client, 4401, token="wrong")
    await play_to_the_end(server, open_client)


async def test_a_page_that_came_too_early_gets_in_the_next_time(launch_warm_server, open_client):
    server = launch_warm_server()
    await refused(server, open_client, 1013)
    hand_over(server)
    await play_to_the_end(server, open_client)
    assert server.answered()


async def test_the_participant_gets_in_when_many_clients_come_at_the_handover(launch_warm_server, open_client):
    server = launch_warm_server(LINGER_SECONDS="60")

    async def come():
        with contextlib.suppress(AssertionError):  # too early, like a page that is opened again and again
            await refused(server, open_client, 0)

    coming = [asyncio.create_task(come()) for _ in range(20)]
    await asyncio.sleep(0.02)
    hand_over(server)
    async with asyncio.timeout(30):  # no client may wait for a look that never comes
        for _ in coming:
            async with open_client(server.address) as client:
                with contextlib.suppress(ConnectionClosedError):
                    await client.play()
                    await client.say(command="stop")
                code = await client.closed()
            assert code in (1000, 4409)
            if code == 1000:
                break  # else one of the others came late, and took the game over
        await asyncio.gather(*coming)


class SlowStore:
    """A store that answers a look when a test tells it to."""

    def __init__(self):
        self.looks = 0
        self.answers = queue.SimpleQueue()

    def get(self, key):
        self.looks += 1
        return self.answers.get(timeout=PATIENCE)


async def test_a_client_that_asks_during_a_look_waits_for_the_next_one_if_that_look_finds_nothing():
    """A look that began before a client asked may have missed a handover that was written just then."""
    store, given_to = SlowStore(), []

    async def hand_over(settings, given):
        given_to.append(given)

    search = assignment.Search(store, TrialSettings.from_env({**ENV, "ASSIGNMENT_SECONDS": "60"}))
    searching = asyncio.create_task(search.run(hand_over))
    async with asyncio.timeout(PATIENCE):
        await until_async(lambda: store.looks)
        first = asyncio.create_task(search.look())
        await asyncio.sleep(0.01)
        store.answers.put(None)
        await until_async(lambda: store.looks >= 2)
        assert not first.done()
        second = asyncio.create_task(search.look())
        await asyncio.sleep(0.01)
        store.answers.put(json.dumps(GOOD).encode())
        await asyncio.gather(first, second, searching)
    assert given_to == [Handover("P1", None, OWN)]
    assert store.looks == 2


def test_the_idle_time_begins_at_the_handover(launch_warm_server):
    server = launch_warm_server(IDLE_SECONDS="2", ASSIGNMENT_SECONDS="0.1")
    time.sleep(2.5)
    assert server.process.poll() is None
    given_at = time.monotonic()
    hand_over(server)
    assert server.wait() == 0
    assert time.monotonic() - given_at >= 2
    assert "idle" in server.log_text()
    assert not (server.store / "study/users").exists()


async def test_the_agent_starts_before_the_handover_and_knows_the_participant_at_the_first_reset(
    launch_warm_server, open_client, grid
):
    server = launch_warm_server(grid() + REPORTING, GROUP="7", USER_ID="somebody-else")
    assert server.process.stdout.readline() == "started\n", "before anybody comes"
    hand_over(server, group=1)
    await play_to_the_end(server, open_client)
    (lines,) = server.recordings(server=OWN).values()
    nobody = {"USER_ID": None, "GROUP": None}
    assert lines[1]["info"]["before"] == [nobody, nobody]
    assert lines[1]["info"]["now"] == {"USER_ID": "P1", "GROUP": "1", "TOKEN": None}


async def test_a_study_without_groups_has_an_empty_one(launch_warm_server, open_client, grid):
    server = launch_warm_server(grid() + REPORTING)
    hand_over(server)
    await play_to_the_end(server, open_client)
    (lines,) = server.recordings(server=OWN).values()
    assert lines[1]["info"]["now"]["GROUP"] == ""
    assert server.answer()["group"] is None


async def test_a_server_that_is_no_warm_server_does_not_look(launch, open_client):
    server = launch(WARM_SERVER="off", SERVER=WARM_SERVER)
    hand_over(server, user_id="P2")
    await refused(server, open_client, 4401, userId="P2")


# ---- one game on several servers


async def test_a_warm_server_goes_on_with_the_game_of_a_lost_server(launch, launch_warm_server, open_client):
    first = launch(trial={"ui": UI}, SERVER="a-1")
    await play_and_end(first, open_client, 30)
    assert first.wait() == 0
    (before,) = first.recordings(server="a-1").values()
    second = launch_warm_server()
    hand_over(second, own="a-2")
    await play_to_the_end(second, open_client, 10)
    (after,) = second.recordings(server="a-2").values()
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert steps(before) + steps(after) == list(range(1, len(steps(before)) + len(steps(after)) + 1))
    assert second.answer()["answers"]["frames"] == len(steps(before)) + len(steps(after))


async def test_another_server_goes_on_with_the_game_of_a_lost_warm_server(launch, launch_warm_server, open_client):
    first = launch_warm_server()
    hand_over(first, own="a-1")
    await play_and_end(first, open_client, 30)
    assert first.wait() == 0
    (before,) = first.recordings(server="a-1").values()
    second = launch(trial={"ui": UI}, SERVER="a-2")
    await play_to_the_end(second, open_client, 10)
    (after,) = second.recordings(server="a-2").values()
    assert after[1]["kind"] == "resume"
    assert second.answer()["answers"]["frames"] == len(steps(before)) + len(steps(after))


async def test_a_warm_server_that_is_killed_and_started_again_keeps_what_it_recorded(launch_warm_server, open_client):
    first = launch_warm_server()
    hand_over(first)
    async with open_client(first.address) as client:
        await client.play(40)
        await client.watch(1)
        first.process.kill()
    first.wait()
    (part,) = first.store.rglob("*.part")
    again = launch_warm_server()
    await play_to_the_end(again, open_client)
    assert again.wait() == 0
    assert not part.exists()
    assert len(again.recordings(server=OWN)) == 2


# ---- what may stand in the document

GOOD = {"schema": 1, "userId": "P1", "group": None, "server": OWN}
HOSTILE = {
    "nothing": b"",
    "half": json.dumps(GOOD).encode()[:-9],
    "a list": b"[1]",
    "too deep": b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "a number without end": b'{"schema": 1' + b"0" * 10_000 + b"}",
    "no schema": json.dumps({**GOOD, "schema": None}).encode(),
    "a later schema": json.dumps({**GOOD, "schema": 2}).encode(),
    "no participant": json.dumps({**GOOD, "userId": ""}).encode(),
    "a participant like a path": json.dumps({**GOOD, "userId": "../P1"}).encode(),
    "a warm server's id": json.dumps({**GOOD, "userId": "~0123456789abcdef0123"}).encode(),
    "a line more": json.dumps({**GOOD, "userId": "P1\n"}).encode(),
    "a list of participants": json.dumps({**GOOD, "userId": ["P1"]}).encode(),
    "no server": json.dumps({**GOOD, "server": None}).encode(),
    "a server like a path": json.dumps({**GOOD, "server": "../../P2/trials/a-1"}).encode(),
    "a group like true": json.dumps({**GOOD, "group": True}).encode(),
    "a group below zero": json.dumps({**GOOD, "group": -1}).encode(),
    "a group like text": json.dumps({**GOOD, "group": "1"}).encode(),
}


def test_a_warm_server_reads_the_handover_that_the_control_plane_writes():
    for group in (None, 0, 3):
        written = Handover("P1", group, "saaaaaaaaaaaaaaaaaaaa-2").to_json()
        assert handover.parse(written) == Handover("P1", group, "saaaaaaaaaaaaaaaaaaaa-2")
    assert handover_key("study", WARM_SERVER) == f"study/handovers/{WARM_SERVER}.json"


@pytest.mark.parametrize("name", HOSTILE)
def test_a_bad_handover_is_refused_with_a_message_without_its_ids(name):
    with pytest.raises(BadHandover) as raised:
        handover.parse(HOSTILE[name])
    assert "P1" not in str(raised.value)


@given(st.binary() | st.recursive(st.none() | st.booleans() | st.text() | st.integers() | st.floats(),
       lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from([*GOOD, "x"]), inner)).map(lambda v: json.dumps(v).encode()))  # fmt: skip
@example(json.dumps(GOOD).encode())
def test_any_document_is_read_or_refused(body):
    try:
        found = handover.parse(body)
    except BadHandover:
        return
    own = assignment.with_handover(TrialSettings.from_env(ENV), found)
    assert own.user_id or own.session


async def test_a_half_written_document_is_looked_at_again(launch_warm_server, open_client):
    server = launch_warm_server()
    for name in ("half", "nothing", "too deep", "a participant like a path"):
        write_handover(server, HOSTILE[name])
        await refused(server, open_client, 1013)
    hand_over(server)
    await play_to_the_end(server, open_client)
    said = server.log_text()
    assert "cannot see whose this server is (its document is not JSON)" in said
    assert "Traceback" not in said
    assert "P1" not in said


async def test_the_server_asks_a_store_that_fails_again(launch_warm_server, open_client):
    server = launch_warm_server(ASSIGNMENT_SECONDS="0.1")
    blocked = server.store / "study/handovers"
    blocked.parent.mkdir(parents=True)
    blocked.write_text("a file where a folder must be")
    await refused(server, open_client, 1013)
    await asyncio.sleep(0.5)
    blocked.unlink()
    hand_over(server)
    await play_to_the_end(server, open_client)
    said = server.log_text()
    assert said.count("cannot see whose this server is (NotADirectoryError") == 1, "said once, not at every look"
    assert WARM_SERVER not in said


async def test_clients_do_not_wait_long_for_a_store_that_hangs(launch_warm_server, open_client):
    server = launch_warm_server(HELLO_SECONDS="3")
    path = server.store / f"study/handovers/{WARM_SERVER}.json"
    path.parent.mkdir(parents=True)
    os.mkfifo(path)  # a process that opens it waits for one that writes
    try:
        began = time.monotonic()
        await refused(server, open_client, 1013)
        assert 2.9 < time.monotonic() - began < 7
    finally:
        server.terminate()
        waited_for = os.open(path, os.O_RDWR)  # frees the thread that waits, and later looks
        path.unlink()
        os.close(waited_for)
    assert server.wait() == 0


# ---- what it is told when it is started

ENV = {
    "PROJECT_ID": "p",
    "SERVER": "s-1",
    "TOKEN": "t",
    "GAME_STEPS": "2",
    "STORE": "x",
    "TLS": "off",
    "TRIAL": "{}",
    "WARM_SERVER": "on",
}


def test_a_warm_server_needs_no_participant_and_ignores_one_in_its_variables():
    for more in ({}, {"USER_ID": "P1", "GROUP": "1"}, {"USER_ID": "../x", "GROUP": "x"}):
        settings = TrialSettings.from_env({**ENV, **more})
        assert (settings.warm_server, settings.user_id, settings.group) == (True, "", None)
    assert settings.warm_server_seconds == 20


def test_after_the_handover_a_warm_server_has_the_settings_of_an_ordinary_one():
    settings = assignment.with_handover(TrialSettings.from_env(ENV), Handover("P1", 3, "a-2"))
    ordinary = {**ENV, "WARM_SERVER": "off", "USER_ID": "P1", "GROUP": "3", "SERVER": "a-2"}
    assert settings == TrialSettings.from_env(ordinary)


@pytest.mark.parametrize(
    "change", [{"WARM_SERVER": "yes"}, {"WARM_SERVER": "off"}, {"WARM_SERVER": ""}, {"SERVER": ""}]
)
def test_without_a_participant_only_a_warm_server_can_start(change):
    with pytest.raises(SettingsError):
        TrialSettings.from_env({**ENV, **change})


def test_the_watchdog_of_a_warm_server_counts_from_the_handover():
    dog = Watchdog(now=None, idle=10, grace=60, deadline=1000)
    assert dog.expires() == 1000
    assert dog.verdict(999) is None
    assert dog.verdict(1000) == "deadline"
    dog.wait(500)
    assert dog.expires() == 510
    assert dog.verdict(510) == "idle"
