"""The server of a session that is not formed yet: which clients wait, for how long, and what a warm server becomes."""

import asyncio
import contextlib
import json
import time

import pytest
from websockets.asyncio.client import connect

from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handover_key
from hippodrome.protocol.session import SessionDocument
from hippodrome.trial.server import assignment, handshake
from hippodrome.trial.server.server import TrialServer
from hippodrome.trial.settings import SettingsError, TrialSettings
from testing.waiting import until
from tests.trial.sessions import (
    ENV,
    MEMBERS,
    SID,
    TOKEN,
    TRIAL,
    answer,
    both_play,
    document,
    form,
    hello_of,
    launch_formed,
    launch_session,
    member,
    put,
    recordings,
    refused,
)
from tests.trial.two_players import two_players

WARM = {"SESSION": "", "WARM_SERVER": "on", "SERVER": "warm-1"}


# ---- before the session is formed


async def test_no_client_is_let_in_before_the_session_is_formed(launch, open_client):
    server = launch_session(launch)
    assert "not open yet" in await refused(server, open_client, 1013, **hello_of("anna"))
    await refused(server, open_client, 1013, **hello_of("stranger"))
    await refused(server, open_client, token="wrong", userId="anna")
    assert server.process.poll() is None
    assert not server.store.exists(), "nothing is recorded"


async def test_a_member_who_comes_at_once_is_let_in_as_soon_as_the_session_is_formed(launch, open_client):
    server = launch_session(launch)
    await refused(server, open_client, 1013, **hello_of("anna"))
    form(server.store)
    async with member(server, "anna") as client:
        assert client.controls["player"] == "left"


def test_the_server_looks_for_the_session_by_itself(launch):
    server = launch_formed(launch, ASSIGNMENT_SECONDS="0.1")
    until(lambda: "the members of the session are known now: 2 of 2" in server.log_text())


def test_a_server_whose_session_is_not_formed_waits_until_its_deadline(launch):
    server = launch_session(launch, IDLE_SECONDS="0", GRACE_SECONDS="0", DEADLINE=str(time.time() + 3))
    assert server.wait() == 0
    assert "ending: deadline" in server.log_text()
    assert "idle" not in server.log_text()


def test_a_session_whose_members_never_come_ends_the_server(launch):
    server = launch_formed(launch, ASSIGNMENT_SECONDS="0.1", IDLE_SECONDS="1", GRACE_SECONDS="1")
    assert server.wait() == 0
    assert "ending: idle" in server.log_text()


async def test_a_member_who_comes_while_the_server_reads_old_recordings_is_not_sent_away(
    tmp_path, open_client, monkeypatch, capsys
):
    (tmp_path / "agent.py").write_text(two_players())
    env = {**ENV, "STORE": str(tmp_path / "store"), "AGENT_DIR": str(tmp_path), "PORT": "0", "HOST": "127.0.0.1"}
    server, looks = TrialServer(TrialSettings.from_env({**env, "TRIAL": json.dumps(TRIAL)})), asyncio.Event()
    form(tmp_path / "store")

    async def slowly(settings):
        await looks.wait()
        return []

    monkeypatch.setattr(server, "_leftovers", slowly)
    monkeypatch.setattr(
        "hippodrome.trial.server.server.set_environment", lambda *told: None
    )  # it would be that of the tests

    monkeypatch.setattr("hippodrome.trial.server.server.exit_hard_after", lambda seconds: None)
    serving = asyncio.create_task(server.run())
    while not (said := capsys.readouterr().out):
        await asyncio.sleep(0.01)
    async with open_client(f"ws://127.0.0.1:{json.loads(said)['port']}/") as client:
        await client.hello(**hello_of("anna"))
        await client.watch(0.3)
        looks.set()
        await client.until(lambda: client.controls)
    server.end("enough")
    assert await serving == 0


THIRD = """
import sys


class Third(Partner):
    def __init__(self):
        print("the third player's policy is made", file=sys.stderr, flush=True)


class Trio(Agent):
    possible_agents = ["left", "right", "third"]

    def step(self, actions):
        seen, rewards, *rest = super().step(actions)
        return seen, {**rewards, "third": 0.0}, *rest


Agent = Trio
"""


async def test_the_policies_of_all_groups_are_loaded_before_the_group_is_known(launch):
    players = {"left": "human", "right": "human"}
    groups = {"0": {**players, "third": "random"}, "1": {**players, "third": "agent:Third"}}
    server = launch_session(launch, agent=two_players() + THIRD, trial={"players": groups})
    until(lambda: "the agent is ready" in server.log_text())
    assert "the third player's policy is made" in server.log_text()
    form(server.store, document(group=1))
    await both_play(server)
    assert server.wait() == 0
    assert server.log_text().count("the third player's policy is made") == 1
    (lines,) = recordings(server.store).values()
    assert lines[0]["players"]["third"]["policy"] == "agent:Third"


# ---- a document that is wrong


BAD = {
    "nothing": b"",
    "no JSON": b"{",
    "another session": document(sid="s.aaaaaaaaaaaaaaaaaaaa").to_json(),
    "a later version": json.dumps({**json.loads(document().to_json()), "schema": 2}).encode(),
    "nobody": SessionDocument(SID, 2, ()).to_json(),
    "one seat twice": document().to_json().replace(b'"seat": 1', b'"seat": 0'),
    "a seat that is none": document().to_json().replace(b'"seat": 1', b'"seat": 2'),
    "one member twice": document(("anna", "anna")).to_json(),
    "an id that is none": document(("anna", "../bert")).to_json(),
}


@pytest.mark.parametrize("name", BAD)
def test_a_document_that_is_no_session_of_this_server_lets_no_client_in(name):
    settings = TrialSettings.from_env(ENV)
    with pytest.raises(ValueError, match="its document"):
        assignment._read(settings, BAD[name])


async def test_a_bad_document_is_logged_once_and_a_good_one_is_taken_later(launch, open_client):
    server = launch_session(launch)
    put(server.store, f"study/sessions/{SID}/session.json", BAD["one seat twice"])
    for _ in range(2):
        await refused(server, open_client, 1013, **hello_of("anna"))
    assert server.log_text().count("cannot see whose this server is") == 1
    form(server.store)
    async with member(server, "anna"):
        pass
    assert "anna" not in server.log_text()


# ---- warm servers


async def test_a_warm_server_that_is_handed_to_a_session_plays_that_session(launch, open_client):
    server = launch_session(launch, **WARM)
    await refused(server, open_client, 1013, **hello_of("anna"))
    put(server.store, handover_key("study", "warm-1"), Handover(SID, None, "pair-1").to_json())
    assert "not open yet" in await refused(server, open_client, 1013, **hello_of("anna"))
    await refused(server, open_client, userId="anna", token=TOKEN)
    form(server.store)
    await refused(server, open_client, **hello_of("carl"))
    await both_play(server)
    assert server.wait() == 0
    assert "this server is assigned to a session now" in server.log_text()
    assert {answer(server.store, each)["answers"]["session"] for each in MEMBERS} == {SID}
    assert recordings(server.store)


async def test_a_warm_server_that_is_handed_to_a_participant_takes_no_member_token(launch, open_client):
    server = launch(trial={}, **{**WARM, "SESSION": "", "ASSIGNMENT_SECONDS": "60", "USER_ID": ""})
    await refused(server, open_client, 1013, **hello_of("P1"))
    put(server.store, handover_key("study", "warm-1"), Handover("P1", None, "a-1").to_json())
    await refused(server, open_client, **hello_of("P1"))
    async with open_client(server.address) as client:
        await client.play()


async def test_the_idle_time_begins_when_the_session_is_formed_not_at_the_handover(launch):
    server = launch_session(launch, **WARM, IDLE_SECONDS="1", GRACE_SECONDS="1")
    time.sleep(0.5)
    put(server.store, handover_key("study", "warm-1"), Handover(SID, None, "pair-1").to_json())
    await make_the_server_look(server)
    until(lambda: "assigned to a session now" in server.log_text())
    time.sleep(1.5)
    assert server.process.poll() is None
    form(server.store)
    await make_the_server_look(server)
    assert server.wait() == 0
    assert "ending: idle" in server.log_text()


async def make_the_server_look(server):
    """Make the server look for its session, as a member's page with their token does."""
    async with connect(server.address, subprotocols=["hippodrome"], proxy=None) as websocket:
        await websocket.send(json.dumps(hello_of("anna")))
        with contextlib.suppress(Exception):
            await websocket.recv()


# ---- how long it stays


async def test_the_server_stays_while_a_member_is_connected_and_ends_when_all_are_gone(launch):
    server = launch_session(launch, IDLE_SECONDS="1", GRACE_SECONDS="1")
    async with member(server, "anna", forms=True):
        async with member(server, "bert"):
            pass
        await asyncio.sleep(2)
        assert server.process.poll() is None
    assert server.wait() == 0
    assert "ending: idle" in server.log_text()


async def test_a_server_does_not_wait_gather_seconds_for_members_who_all_left_before_the_game(launch):
    server = launch_session(launch, trial={"gather": 300}, IDLE_SECONDS="1", GRACE_SECONDS="1")
    async with member(server, "anna", forms=True) as anna:
        assert anna.controls["people"] == {"left": "here", "right": "awaited"}
    assert server.wait() == 0
    assert "ending: idle" in server.log_text()


# ---- its environment


def test_a_server_of_a_session_reads_its_settings():
    settings = TrialSettings.from_env({**ENV, "USER_ID": "", "GROUP": "7", "PLAIN_ORIGINS": "https://a.example"})
    assert (settings.session, settings.user_id, settings.group, settings.assigned) == (SID, "", None, False)
    assert settings.plain_origins == frozenset()
    assert settings.private == ()
    formed = assignment.with_members(settings, document(("anna", "", "carl"), players=4, group=2))
    assert formed.assigned
    assert (formed.players, formed.group) == (4, 2)
    assert formed.seats == {"anna": 0, "carl": 2}
    assert formed.private == ("anna", "carl")
    assert formed.recordings_folder == f"study/sessions/{SID}/trials/pair-1"


def test_a_handed_over_session_has_the_settings_of_a_session_that_was_started_for_it():
    warm = TrialSettings.from_env({**ENV, **WARM})
    assert not warm.assigned
    given = assignment.with_handover(warm, Handover(SID, None, "pair-1"))
    assert given == TrialSettings.from_env(ENV)


@pytest.mark.parametrize("bad", ["s.", "s.0123456789ABCDEF0123", "anna", SID + "0", f"{SID}/.."])
def test_a_wrong_id_of_a_session_is_refused(bad):
    with pytest.raises(SettingsError, match="SESSION"):
        TrialSettings.from_env({**ENV, "SESSION": bad})


def test_a_server_without_a_session_has_the_settings_of_one_participant():
    settings = TrialSettings.from_env({**ENV, "SESSION": "", "USER_ID": "P1"})
    assert (settings.session, settings.members, settings.seats, settings.players) == ("", (), {}, 1)
    assert settings.assigned
    assert settings.private == ("P1",)
    assert settings.recordings_folder == "study/users/P1/trials/pair-1"
    assert handshake.tokens_for(settings, "P1") == (TOKEN,)
