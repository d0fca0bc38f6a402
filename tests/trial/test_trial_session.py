"""The server of a session: who gets in, for how long it waits, what it leaves behind, and how it tells round trips."""

import asyncio
import contextlib
import json
import math
import time

import pytest
from hypothesis import given as for_all
from hypothesis import strategies as st
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode

from protocol.handover import Handover
from protocol.keys import handover_key
from protocol.session import Member, Session, member_token
from tests.trial.far_away import far_away
from tests.trial.sessions import (
    MEMBERS,
    SID,
    TOKEN,
    TRIAL,
    answer,
    document,
    form,
    hello_of,
    launch_session,
    member,
    put,
    recordings,
)
from tests.trial.two_players import two_players
from trial.core.messages import Hello
from trial.core.session import PARTNER_STOPPED
from trial.recordings.recorder import Recorder
from trial.recordings.spool import Spool
from trial.recordings.store import FolderStore
from trial.server import assignment, handshake
from trial.server.server import Server
from trial.settings import Settings, SettingsError

ENV = {
    "PROJECT_ID": "study",
    "SERVER": "pair-1",
    "TOKEN": TOKEN,
    "GAME_STEPS": "3",
    "STORE": "x",
    "TLS": "off",
    "TRIAL": "{}",
    "SESSION": SID,
}
WARM = {"SESSION": "", "SPARE": "on", "SERVER": "warm-1"}


async def refused(server, open_client, code=4401, **hello):
    async with open_client(server.address) as client:
        await client.hello(**{"userId": None, "token": None, **hello})
        assert await client.closed() == code, client.errors
        assert not client.controls
        assert not client.frames
        return client.errors[-1]


async def both_play(server, open_client, frames=5, *, stop=True):
    """Both members play; then one stops the game, where that is offered."""
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await anna.say(command="start")
        try:
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= frames) for each in (anna, bert)))
        except ConnectionClosed as closed:
            raise AssertionError(f"{anna.errors}, {bert.errors}; the server said:\n{server.said()}") from closed
        if stop:
            await anna.say(command="stop")
            assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
        return anna, bert


async def both_see(frames, *clients):
    """Whoever did not take their pictures would be away after some seconds, and the game would be held."""
    await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= frames) for each in clients))


# ---- before the session is formed


def test_nobody_gets_in_before_the_session_is_formed(launch, open_client):
    server = launch_session(launch)

    async def everybody():
        assert "not open yet" in await refused(server, open_client, 1013, **hello_of("anna"))
        await refused(server, open_client, 1013, **hello_of("stranger"))
        await refused(server, open_client, token="wrong", userId="anna")

    asyncio.run(everybody())
    assert server.process.poll() is None
    assert not server.store.exists(), "nothing is recorded"


def test_a_member_who_comes_at_once_is_let_in_as_soon_as_the_session_is_formed(launch, open_client):
    server = launch_session(launch)

    async def run():
        await refused(server, open_client, 1013, **hello_of("anna"))
        form(server.store)
        async with member(server, "anna") as client:
            assert client.controls["player"] == "left"

    asyncio.run(run())


def test_the_server_looks_for_the_session_by_itself(launch):
    server = launch_session(launch, SPARE_SECONDS="0.1")
    form(server.store)
    wait_for(lambda: "the members of the session are known now: 2 of 2" in server.said())


def test_a_server_whose_session_is_not_formed_waits_until_its_deadline(launch):
    server = launch_session(launch, IDLE_SECONDS="0", GRACE_SECONDS="0", DEADLINE=str(time.time() + 3))
    assert server.wait() == 0
    assert "ending: deadline" in server.said()
    assert "idle" not in server.said()


def test_a_session_whose_members_never_come_ends_the_server(launch):
    server = launch_session(launch, SPARE_SECONDS="0.1", IDLE_SECONDS="1", GRACE_SECONDS="1")
    form(server.store)
    assert server.wait() == 0
    assert "ending: idle" in server.said()


def test_a_member_who_comes_while_the_server_still_looks_for_old_recordings_is_not_sent_away(
    tmp_path, open_client, monkeypatch, capsys
):
    (tmp_path / "agent.py").write_text(two_players())
    env = {**ENV, "STORE": str(tmp_path / "store"), "AGENT_DIR": str(tmp_path), "PORT": "0", "HOST": "127.0.0.1"}
    server, looks = Server(Settings.from_env({**env, "TRIAL": json.dumps(TRIAL)})), asyncio.Event()
    form(tmp_path / "store")

    async def slowly(settings):
        await looks.wait()
        return []

    monkeypatch.setattr(server, "_leftovers", slowly)
    monkeypatch.setattr("trial.server.server.set_environment", lambda *told: None)  # it would be that of the tests

    async def run():
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

    monkeypatch.setattr("trial.server.server.exit_hard_after", lambda seconds: None)
    asyncio.run(run())


BAD = {
    "nothing": b"",
    "no JSON": b"{",
    "another session": document(sid="s.aaaaaaaaaaaaaaaaaaaa").to_json(),
    "a later version": json.dumps({**json.loads(document().to_json()), "schema": 2}).encode(),
    "nobody": Session(SID, 2, ()).to_json(),
    "one seat twice": document().to_json().replace(b'"seat": 1', b'"seat": 0'),
    "a seat that is none": document().to_json().replace(b'"seat": 1', b'"seat": 2'),
    "one member twice": document(("anna", "anna")).to_json(),
    "an id that is none": document(("anna", "../bert")).to_json(),
}


@pytest.mark.parametrize("name", BAD)
def test_a_document_that_is_no_session_of_this_server_lets_nobody_in(name):
    settings = Settings.from_env(ENV)
    with pytest.raises(ValueError, match="its document"):
        assignment._read(settings, BAD[name])


def test_a_bad_document_is_said_once_and_a_good_one_is_taken_later(launch, open_client):
    server = launch_session(launch)
    put(server.store, f"study/sessions/{SID}/session.json", BAD["one seat twice"])

    async def run():
        for _ in range(2):
            await refused(server, open_client, 1013, **hello_of("anna"))
        assert server.said().count("cannot see whose this server is") == 1
        form(server.store)
        async with member(server, "anna"):
            pass

    asyncio.run(run())
    assert "anna" not in server.said()


# ---- who gets in


def test_each_member_plays_the_player_of_their_seat(launch, open_client):
    server = launch_session(launch)
    form(server.store)

    async def run():
        async with member(server, "bert") as bert, member(server, "anna") as anna:
            assert (anna.controls["player"], bert.controls["player"]) == ("left", "right")

    asyncio.run(run())


def test_a_member_cannot_play_in_the_place_of_another(launch, open_client):
    server = launch_session(launch)
    form(server.store)

    async def run():
        await refused(server, open_client, userId="bert", token=member_token(TOKEN, "anna"))
        await refused(server, open_client, userId="anna", token=member_token(TOKEN, "bert"))
        await refused(server, open_client, userId=None, token=member_token(TOKEN, "anna"))
        async with member(server, "anna", seat=1, player="right") as anna:
            assert anna.controls["player"] == "left", "whoever names a seat keeps their own"

    asyncio.run(run())


def test_who_is_no_member_gets_in_with_no_token(launch, open_client):
    server = launch_session(launch)
    form(server.store)

    async def run():
        await refused(server, open_client, **hello_of("carl"))
        await refused(server, open_client, userId="carl", token=member_token(TOKEN, "anna"))
        await refused(server, open_client, userId="", token=member_token(TOKEN, ""))
        await refused(server, open_client, userId=SID, token=member_token(TOKEN, SID))

    asyncio.run(run())


def test_the_servers_own_token_opens_no_session(launch, open_client):
    server = launch_session(launch)
    form(server.store)
    asyncio.run(refused(server, open_client, userId="anna", token=TOKEN))


def test_a_token_of_another_session_opens_nothing(launch, open_client):
    server = launch_session(launch)
    form(server.store)
    asyncio.run(refused(server, open_client, userId="anna", token=member_token("another-server", "anna")))


def test_a_participant_whose_data_were_erased_is_no_member_any_more(launch, open_client):
    server = launch_session(launch, trial={"substitute": "idle"})
    form(server.store, document(("anna", "")))

    async def run():
        await refused(server, open_client, **hello_of("bert"))
        await refused(server, open_client, userId="", token=member_token(TOKEN, ""))
        async with member(server, "anna"):
            pass

    asyncio.run(run())


def test_without_a_substitute_the_game_is_over_for_the_others_of_one_whose_data_were_erased(launch):
    """As if that participant had left: nobody is kept at a game that cannot begin."""
    server = launch_session(launch)
    form(server.store, document(("anna", "")))

    async def run():
        async with member(server, "anna") as anna:
            assert await anna.closed() == 1000
            assert anna.done["outcome"] == "partnerLeft"

    asyncio.run(run())
    assert server.wait() == 0
    assert answer(server.store, "anna")["answers"]["episodes"] == 0


def test_what_was_played_with_one_whose_data_were_erased_counts_for_the_others(launch):
    first = launch_session(launch)
    form(first.store)

    async def play():
        async with member(first, "anna") as anna, member(first, "bert") as bert:
            await anna.say(action="up", held=True)
            await both_see(21, anna, bert)
            first.terminate()
            await asyncio.gather(anna.closed(), bert.closed())

    asyncio.run(play())
    assert first.wait() == 0
    [lines] = recordings(first.store).values()
    put(first.store, f"study/sessions/{SID}/session.json", document(("anna", "")).to_json())
    second = launch_session(launch, SERVER="pair-2")

    async def go_on():
        async with member(second, "anna") as anna:
            assert await anna.closed() == 1000

    asyncio.run(go_on())
    assert second.wait() == 0
    found = answer(second.store, "anna")["answers"]
    steps = [line for line in lines if line["kind"] == "step"]
    assert found["score"] == sum(line["players"]["left"]["reward"] for line in steps) > 0
    assert (found["outcome"], found["episodes"]) == ("partnerLeft", 1)


@for_all(user_id=st.one_of(st.none(), st.text(), st.sampled_from(MEMBERS)), token=st.one_of(st.none(), st.text()))
def test_whatever_a_client_says_only_a_member_with_their_own_token_gets_in(user_id, token):
    settings = assignment.formed(Settings.from_env(ENV), document())

    class Socket:
        subprotocol = "hippodrome.3"

    def admitted(shown):
        hello = Hello(user_id=user_id, token=shown, step=None, project_id=None)
        try:
            handshake.check_access(Socket(), hello, handshake.tokens_for(settings, user_id), ())
            handshake.check_member(Socket(), user_id, settings)
        except handshake.CloseConnection:
            return False
        return True

    assert not admitted(token)
    for other in MEMBERS:
        assert admitted(member_token(TOKEN, other)) is (user_id == other)


def test_a_second_tab_replaces_the_members_own_and_no_other(launch, open_client):
    server = launch_session(launch)
    form(server.store)

    async def run():
        async with member(server, "anna") as first, member(server, "bert") as bert, member(server, "anna") as second:
            assert await first.closed() == 4409
            assert "another tab" in first.errors[-1]
            assert second.controls["player"] == "left"
            await bert.watch(0.3)
            assert bert.websocket.close_code is None

    asyncio.run(run())


def test_two_people_with_one_link_are_one_member(launch, open_client):
    """Whoever opens it last plays; the other place stays the other member's."""
    server = launch_session(launch)
    form(server.store)

    async def run():
        async with contextlib.AsyncExitStack() as stack:
            clients = [await stack.enter_async_context(member(server, "anna")) for _ in range(3)]
            assert {client.controls["player"] for client in clients} == {"left"}
            assert [await client.closed() for client in clients[:2]] == [4409, 4409]

    asyncio.run(run())


def test_a_members_token_opens_nothing_for_programs(launch):
    server = launch_session(launch, trial={"gym": "watch"})
    form(server.store)

    async def run():
        async with connect(f"{server.address}gym?token={member_token(TOKEN, 'anna')}", proxy=None) as program:
            await program.wait_closed()
            assert program.close_code == 4401

    asyncio.run(run())


def test_a_program_needs_the_servers_token_and_a_formed_session(launch):
    server = launch_session(launch, trial={"gym": "watch"})

    async def watch(code):
        async with connect(f"{server.address}gym?token={TOKEN}", proxy=None) as program:
            if code is None:
                await program.send(json.dumps({"method": "action_space", "params": {"player": "right"}}))
                assert json.loads(await asyncio.wait_for(program.recv(), 10))["n"] == 3
            else:
                await program.wait_closed()
                assert program.close_code == code

    asyncio.run(watch(1013))
    form(server.store)

    async def run():
        async with member(server, "anna"):
            await watch(None)

    asyncio.run(run())


def test_a_members_token_makes_no_environments(launch):
    server = launch_session(launch, trial={"gym": "environments"})

    async def run():
        with pytest.raises(InvalidStatus) as refusal:
            await connect(f"{server.address}gym?token={member_token(TOKEN, 'anna')}", proxy=None)
        assert refusal.value.response.status_code == 401

    asyncio.run(run())


def test_a_page_without_a_token_never_gets_into_a_session(launch, open_client):
    page = "https://front.example"
    server = launch_session(launch, PLAIN_ORIGINS=page)
    form(server.store)

    async def run():
        async with open_client(server.address, subprotocols=None, origin=page) as client:
            await client.hello(userId="anna", token=None)
            assert await client.closed() == 4401

    asyncio.run(run())


def test_a_client_without_a_subprotocol_never_gets_into_a_session(launch, open_client):
    """What such a client sends along is recorded: it could write another participant's id into the recording."""
    server = launch_session(launch)
    form(server.store)

    async def run():
        async with open_client(server.address, subprotocols=None) as client:
            await client.hello(**hello_of("anna"))
            assert await client.closed() == 4401
            assert "subprotocol" in client.errors[-1]

    asyncio.run(run())


# ---- warm servers


def test_a_warm_server_that_is_handed_to_a_session_is_that_sessions(launch, open_client):
    server = launch_session(launch, **WARM)

    async def run():
        await refused(server, open_client, 1013, **hello_of("anna"))
        put(server.store, handover_key("study", "warm-1"), Handover(SID, None, "pair-1").to_json())
        assert "not open yet" in await refused(server, open_client, 1013, **hello_of("anna"))
        await refused(server, open_client, userId="anna", token=TOKEN)
        form(server.store)
        await refused(server, open_client, **hello_of("carl"))
        await both_play(server, open_client)

    asyncio.run(run())
    assert server.wait() == 0
    assert "this server is assigned to a session now" in server.said()
    assert {answer(server.store, each)["answers"]["session"] for each in MEMBERS} == {SID}
    assert recordings(server.store)


def test_a_warm_server_that_is_handed_to_a_participant_takes_no_member_token(launch, open_client):
    server = launch(trial={}, **{**WARM, "SESSION": "", "SPARE_SECONDS": "60", "USER_ID": ""})

    async def run():
        await refused(server, open_client, 1013, **hello_of("P1"))
        put(server.store, handover_key("study", "warm-1"), Handover("P1", None, "a-1").to_json())
        await refused(server, open_client, **hello_of("P1"))
        async with open_client(server.address) as client:
            await client.play()

    asyncio.run(run())


def test_an_idle_time_begins_when_the_session_is_formed_not_at_the_handover(launch):
    server = launch_session(launch, **WARM, IDLE_SECONDS="1", GRACE_SECONDS="1")
    time.sleep(0.5)
    put(server.store, handover_key("study", "warm-1"), Handover(SID, None, "pair-1").to_json())
    asyncio.run(ask(server))
    wait_for(lambda: "assigned to a session now" in server.said())
    time.sleep(1.5)
    assert server.process.poll() is None
    form(server.store)
    asyncio.run(ask(server))
    assert server.wait() == 0
    assert "ending: idle" in server.said()


async def ask(server):
    """Make the server look, as a member whose page shows their token."""
    async with connect(server.address, subprotocols=["hippodrome.3"], proxy=None) as websocket:
        await websocket.send(json.dumps(hello_of("anna")))
        with contextlib.suppress(Exception):
            await websocket.recv()


def test_a_page_that_slept_is_back_as_soon_as_it_acknowledges_again(launch, open_client):
    """It says nothing else when it wakes: nobody presses a key while the game is held."""
    server = launch_session(launch)
    form(server.store)

    async def run():
        async with member(server, "anna") as anna, member(server, "bert") as bert:
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
            bert.acks = False
            reading = asyncio.create_task(bert.watch(60))
            await anna.until(lambda: anna.state["people"]["right"] == "away")
            held = len(anna.frames)
            await bert.say(ack=bert.frames[-1][1])
            bert.acks = True
            await anna.until(lambda: anna.state["people"]["right"] == "here" and len(anna.frames) > held + 5)
            reading.cancel()

    asyncio.run(run())


# ---- two game steps


def test_a_session_plays_its_game_steps_one_after_the_other(launch, open_client):
    server = launch_session(launch, GAME_STEPS="3,5")
    form(server.store)

    async def run():
        await both_play(server, open_client)
        async with member(server, "anna", step="5") as anna, member(server, "bert", step="5") as bert:
            assert "another step's game" in await refused(server, open_client, 4404, **hello_of("bert", step="3"))
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
            await bert.say(command="stop")
            assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]

    asyncio.run(run())
    assert server.wait() == 0
    assert all(answer(server.store, each, step)["answers"]["session"] == SID for each in MEMBERS for step in "35")


def test_no_member_opens_a_later_game_step_before_their_own_answer_to_the_one_before(launch, open_client):
    """Else a member whose client names another step would keep all the others out of theirs."""
    server = launch_session(launch, GAME_STEPS="3,5")
    form(server.store)

    async def run():
        early = hello_of("bert", step="5")
        assert "an earlier game step" in await refused(server, open_client, 4404, **early)
        await both_play(server, open_client)
        async with member(server, "bert", step="5"):
            pass

    asyncio.run(run())


def test_the_next_server_finds_who_has_answered_an_earlier_game_step(launch, open_client):
    server = launch_session(launch, GAME_STEPS="3,5", SERVER="pair-2")
    form(server.store)
    put(server.store, "study/users/anna/answers/3.json", b'{"answers": {}}')

    async def run():
        assert "an earlier game step" in await refused(server, open_client, 4404, **hello_of("bert", step="5"))
        async with member(server, "anna", step="5"):
            pass

    asyncio.run(run())


# ---- lifetime


def test_the_server_stays_while_one_member_is_there_and_ends_when_all_are_gone(launch, open_client):
    server = launch_session(launch, IDLE_SECONDS="1", GRACE_SECONDS="1")

    async def run():
        async with member(server, "anna", forms=True):
            async with member(server, "bert"):
                pass
            await asyncio.sleep(2)
            assert server.process.poll() is None

    asyncio.run(run())
    assert server.wait() == 0
    assert "ending: idle" in server.said()


def test_a_server_whose_members_have_all_gone_before_the_game_does_not_wait_for_them_for_gather_seconds(launch):
    server = launch_session(launch, trial={"gather": 300}, IDLE_SECONDS="1", GRACE_SECONDS="1")

    async def run():
        async with member(server, "anna", forms=True) as anna:
            assert anna.controls["people"] == {"left": "here", "right": "awaited"}

    asyncio.run(run())
    assert server.wait() == 0
    assert "ending: idle" in server.said()


# ---- what it leaves behind


def test_each_member_has_an_answer_and_the_recording_is_the_sessions(launch, open_client):
    server = launch_session(launch, trial={"seed": 3})
    form(server.store, document(group=1))
    asyncio.run(both_play(server, open_client))
    assert server.wait() == 0
    anna, bert = (answer(server.store, each) for each in MEMBERS)
    for found in (anna, bert):
        assert (found["step"], found["page"], found["group"], found["schema"]) == ("3", "game", 1, 1)
        assert found["answers"]["session"] == SID
    assert (anna["answers"]["outcome"], bert["answers"]["outcome"]) == ("stopped", "partnerLeft")
    assert anna["answers"]["player"] == "left"
    assert bert["answers"]["player"] == "right"
    assert bert["answers"]["score"] == bert["answers"]["scores"]["right"]
    assert anna["answers"]["score"] == anna["answers"]["scores"]["left"]
    (lines,) = recordings(server.store).values()
    assert (lines[0]["sessionId"], lines[0]["session"], lines[0]["group"]) == (SID, "pair-1", 1)
    assert "user" not in lines[0]


def test_no_members_id_stands_in_a_line_of_a_recording_or_of_the_log(launch, open_client):
    """If the researcher's code knows an id and fails with it, the error's words are recorded without the id."""
    members, said = ("Participant-One", "Participant-Two"), "no Participant-Two here"
    broken = two_players(act="pass").replace(
        "self.t += 1", f"self.t += 1\n        if self.t == 3: raise ValueError('{said}')", 1
    )
    broken += f"\n\nclass Agent(Agent):\n    def on_join(self, session, player):\n        raise KeyError('{said}')\n"
    server = launch_session(launch, agent=broken, trial={"maxEpisodes": 2})
    form(server.store, document(members))

    async def run():
        async with member(server, members[0]) as one, member(server, members[1]) as two:
            await one.say(command="start")
            await two.until(lambda: two.errors)
            await two.say(command="pause")
            server.terminate()
            await one.closed()

    asyncio.run(run())
    server.wait()
    written = json.dumps(recordings(server.store))
    assert "ValueError" in server.said()
    for each in members:
        assert each not in server.said()
        assert each not in written
    assert "(participant)" in server.said()
    hidden = said.replace(members[1], "(participant)")
    assert f"ValueError: {hidden}" in written
    assert f"KeyError: '{hidden}'" in written


def test_nothing_lies_in_a_members_folder_but_the_answer(launch, open_client):
    server = launch_session(launch)
    form(server.store)
    asyncio.run(both_play(server, open_client))
    server.wait()
    found = {path.relative_to(server.store).as_posix() for path in server.store.rglob("*") if path.is_file()}
    assert found == {
        "study/users/anna/answers/3.json",
        "study/users/bert/answers/3.json",
        f"study/sessions/{SID}/session.json",
        f"study/sessions/{SID}/trials/pair-1/3-episode-0001.jsonl.gz",
    }


def test_a_step_that_all_have_answered_is_not_played_again(launch, open_client):
    server = launch_session(launch)
    form(server.store)
    asyncio.run(both_play(server, open_client))
    assert server.wait() == 0
    kept = {each: answer(server.store, each) for each in MEMBERS}
    again = launch_session(launch, SERVER="pair-2", LINGER_SECONDS="4")  # the second one comes by then

    async def run():
        async with member(again, "anna") as anna, member(again, "bert") as bert:
            assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
            assert anna.done["score"] == kept["anna"]["answers"]["score"]
            assert bert.done["score"] == kept["bert"]["answers"]["score"]
            assert not anna.frames

    asyncio.run(run())
    assert again.wait() == 0
    assert {each: answer(server.store, each) for each in MEMBERS} == kept
    assert not recordings(server.store, "pair-2")


def test_an_answer_that_an_interrupted_server_did_not_store_is_stored_by_the_next_one(launch, open_client):
    """The server was lost between two answers: what is there stays, what is missing comes."""
    server = launch_session(launch)
    form(server.store)
    asyncio.run(both_play(server, open_client))
    assert server.wait() == 0
    anna, bert = (answer(server.store, each) for each in MEMBERS)
    (server.store / "study/users/bert/answers/3.json").unlink()
    again = launch_session(launch, SERVER="pair-2")

    async def run():
        async with member(again, "bert") as client:
            assert await client.closed() == 1000
            assert client.done["score"] == bert["answers"]["score"]

    asyncio.run(run())
    assert again.wait() == 0
    assert answer(server.store, "anna") == anna, "an answer that exists is not written again"
    again_bert = answer(server.store, "bert")["answers"]
    for key in ("score", "player", "session", "outcome", "frames"):
        assert again_bert[key] == bert["answers"][key]


def recorder_of(tmp_path, *members):
    settings = Settings.from_env({**ENV, "STORE": str(tmp_path), "TRIAL": json.dumps(TRIAL)})
    formed = assignment.formed(settings, Session(SID, len(members), members))
    store = FolderStore(tmp_path)
    return Recorder(formed, "3", "the-trial", store, Spool(formed, store)), store


def save_answers(recorder, answers):
    for each, said in answers.items():
        asyncio.run(recorder.save_member(each, said))


def test_each_answer_is_created_once_with_the_members_own_group(tmp_path):
    recorder, _ = recorder_of(tmp_path, Member("anna", 0, 0), Member("bert", 1, 1))
    given = {"anna": {"score": 1, "player": "left"}, "bert": {"score": 2, "player": "right"}}
    save_answers(recorder, given)
    found = {each: answer(tmp_path, each) for each in MEMBERS}
    assert [found[each]["group"] for each in MEMBERS] == [0, 1]
    assert {each: found[each]["answers"] for each in MEMBERS} == {
        each: {**said, "session": SID} for each, said in given.items()
    }
    save_answers(recorder, {each: {"score": 9} for each in MEMBERS})
    assert {each: answer(tmp_path, each) for each in MEMBERS} == found


def test_a_step_is_over_when_each_member_has_an_answer_and_not_before(tmp_path):
    recorder, _ = recorder_of(tmp_path, Member("anna", None, 0), Member("", None, 1), Member("bert", None, 2))
    assert asyncio.run(recorder.members_answers()) == {}
    bert = {"bert": {"score": 2, "session": SID}}
    asyncio.run(recorder.save_member("bert", {"score": 2}))
    assert asyncio.run(recorder.members_answers()) == bert
    asyncio.run(recorder.save_member("anna", {"score": 1}))
    assert asyncio.run(recorder.members_answers()) == bert | {"anna": {"score": 1, "session": SID}}


# ---- round trips


@contextlib.asynccontextmanager
async def near_and_far(server, seconds):
    """Both members; what bert says and hears takes so long on its way."""
    async with (
        far_away(server.port, seconds) as slow,
        member(server, "anna") as anna,
        member(server, "bert", port=slow) as bert,
    ):
        yield anna, bert


def test_round_trips_of_each_member_stand_in_the_recording(launch, open_client):
    server = launch_session(launch, trial={"pingSamples": 3, "maxPing": 5000})
    form(server.store)

    async def run():
        async with near_and_far(server, 0.3) as (anna, bert):
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
            await anna.say(command="stop")
            await asyncio.gather(anna.closed(), bert.closed())

    asyncio.run(run())
    assert server.wait() == 0
    (lines,) = recordings(server.store).values()
    trips = {}
    for line in lines:
        if line["kind"] in ("ping", "reset"):
            trips |= line.get("roundTrip", {})
    assert trips.keys() == {"left", "right"}
    assert trips["right"] >= 600
    assert trips["left"] < trips["right"]


def test_a_member_who_is_too_far_away_is_told_and_so_are_the_others(launch, open_client):
    server = launch_session(launch, trial={"pingSamples": 3, "maxPing": 700})
    form(server.store)

    async def run():
        async with near_and_far(server, 0.4) as (anna, bert):
            assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
            assert (anna.done["outcome"], bert.done["outcome"]) == ("partnerLeft", "ping")
            assert anna.errors
            assert bert.errors

    asyncio.run(run())
    assert server.wait() == 0
    found = {each: answer(server.store, each)["answers"] for each in MEMBERS}
    assert {each: said["outcome"] for each, said in found.items()} == {"anna": "partnerLeft", "bert": "ping"}
    assert {said["session"] for said in found.values()} == {SID}


def test_the_others_play_on_without_a_member_who_is_too_far_away(launch, open_client):
    instead = {"substitute": "idle", "afterAbsent": "policy"}
    server = launch_session(launch, trial={"pingSamples": 3, "maxPing": 700, **instead})
    form(server.store)

    async def run():
        async with near_and_far(server, 0.4) as (anna, bert):
            assert await bert.closed() == 1000
            assert answer(server.store, "bert")["answers"]["outcome"] == "ping"
            await anna.until(lambda: len(anna.frames) > 20)
            assert not (server.store / "study/users/anna/answers/3.json").exists()
            await anna.say(command="stop")
            assert await anna.closed() == 1000

    asyncio.run(run())
    assert server.wait() == 0
    assert answer(server.store, "anna")["answers"]["outcome"] == "stopped"


def test_who_is_too_far_away_is_out_of_the_later_games_too(launch, open_client):
    """They come there before the others, who still play, and would be sent away again and again."""
    instead = {"substitute": "idle", "afterAbsent": "policy"}
    trial = {"pingSamples": 3, "maxPing": 150, "countdown": 0, **instead}
    server = launch_session(launch, trial=trial, GAME_STEPS="3,5,7")
    form(server.store)
    later = {"outcome": "ping", "player": "right", "session": SID}

    async def run():
        async with near_and_far(server, 0.15) as (anna, bert):
            assert await bert.closed() == 1000
            assert [answer(server.store, "bert", step)["answers"] for step in "57"] == [later, later]
            await anna.until(lambda: len(anna.frames) > 5)
            await anna.say(command="stop")
            assert await anna.closed() == 1000
        async with member(server, "anna", step="5") as anna:
            await anna.until(lambda: anna.state.get("state") == "playing")
            assert anna.state["people"]["right"] == "policy"

    asyncio.run(run())


class CountsPings(ClientConnection):
    pings = 0

    def process_event(self, event):
        self.pings += isinstance(event, Frame) and event.opcode is Opcode.PING
        super().process_event(event)


def test_only_a_session_sends_pings_of_its_own(launch):
    """A participant who plays alone gets no byte more."""

    async def pings(server, hello, most=math.inf, seconds=2):
        async with connect(
            server.address, create_connection=CountsPings, subprotocols=["hippodrome.3"], proxy=None
        ) as websocket:
            await websocket.send(json.dumps(hello))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while websocket.pings < most:
                        await asyncio.sleep(0.02)
            return websocket.pings

    alone = launch()
    assert asyncio.run(pings(alone, {"userId": "P1", "token": TOKEN, "step": "3"})) == 0
    server = launch_session(launch)
    form(server.store)
    assert asyncio.run(pings(server, hello_of("anna"), 5, 20)) == 5


# ---- a lost server


def steps(lines):
    return [line["step"] for line in lines if line["kind"] == "step"]


def test_after_a_kill_the_next_server_goes_on_at_the_last_recorded_step_for_both(launch, open_client, tmp_path):
    """A process that is killed leaves its recording in the spool, and the next process of that server stores it."""
    first = launch_session(launch, trial={"seed": 3})
    form(first.store)

    async def killed():
        async with member(first, "anna") as anna, member(first, "bert") as bert:
            await anna.say(command="start")
            await anna.say(action="up", lasts=None)
            await both_see(40, anna, bert)
            first.process.kill()
            await asyncio.gather(anna.closed(), bert.closed())

    asyncio.run(killed())
    folder = first.store / f"study/sessions/{SID}/trials/pair-1"
    (left,) = folder.glob("*.part")
    left.rename(left.with_suffix(""))  # what the control plane of one machine does, and the next process of this name
    (before,) = recordings(first.store).values()
    assert len(steps(before)) >= 10
    second = launch_session(launch, trial={"seed": 3}, SERVER="pair-2")
    anna, bert = asyncio.run(both_play(second, open_client, 15))
    assert second.wait() == 0
    (after,) = recordings(second.store, "pair-2").values()
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert steps(before) + steps(after) == list(range(1, len(steps(before)) + len(steps(after)) + 1))
    total = [sum(line["players"][name]["reward"] for line in before + after if line["kind"] == "step") for name in PLAY]
    assert [answer(first.store, each)["answers"]["score"] for each in MEMBERS] == total
    assert (anna.errors, bert.errors) == ([], [PARTNER_STOPPED])


PLAY = ("left", "right")


def test_a_killed_process_of_the_same_server_leaves_a_recording_that_the_next_process_stores(launch, open_client):
    first = launch_session(launch)
    form(first.store)

    async def killed():
        async with member(first, "anna") as anna, member(first, "bert") as bert:
            await anna.say(command="start")
            await both_see(30, anna, bert)
            first.process.kill()

    asyncio.run(killed())
    again = launch_session(launch)
    folder = first.store / f"study/sessions/{SID}/trials/pair-1"
    wait_for(lambda: list(folder.glob("*.gz")) and not list(folder.glob("*.part")))
    (lines,) = recordings(again.store).values()
    assert steps(lines)


# ---- what the researcher's code sees

REPORTING = """
import os, json
NAMES = ("USER_ID", "GROUP", "SESSION", "TOKEN")
def told():
    return {name: os.environ.get(name) for name in NAMES}
_first = told()
class Reporting(Agent):
    def reset(self, seed=None):
        seen, infos = super().reset(seed)
        return seen, {"left": {"first": _first, "now": told()}, "right": {}}
Agent = Reporting
"""


@pytest.mark.parametrize("group", [None, 2])
def test_the_agent_sees_the_session_and_its_group_and_no_participants_id(launch, open_client, group):
    agent = two_players() + REPORTING
    server = launch_session(launch, agent=agent, trial={})
    form(server.store, document(group=group))
    asyncio.run(both_play(server, open_client))
    server.wait()
    (lines,) = recordings(server.store).values()
    reset = next(line for line in lines if line["kind"] == "reset")
    found = json.dumps(reset)
    now = {"USER_ID": None, "GROUP": "" if group is None else str(group), "SESSION": SID, "TOKEN": None}
    assert json.dumps(now, separators=(",", ":")) in found.replace(", ", ",").replace(": ", ":")
    assert '"USER_ID": "' not in found


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


def test_policies_of_each_group_are_there_before_the_group_is_known(launch, open_client):
    players = {"left": "human", "right": "human"}
    groups = {"0": {**players, "third": "random"}, "1": {**players, "third": "agent:Third"}}
    server = launch_session(launch, agent=two_players() + THIRD, trial={"players": groups})
    wait_for(lambda: "the agent is ready" in server.said())
    assert "the third player's policy is made" in server.said()
    form(server.store, document(group=1))
    asyncio.run(both_play(server, open_client))
    assert server.wait() == 0
    assert server.said().count("the third player's policy is made") == 1
    (lines,) = recordings(server.store).values()
    assert lines[0]["players"]["third"]["policy"] == "agent:Third"


# ---- settings


def test_the_settings_of_a_session():
    settings = Settings.from_env({**ENV, "USER_ID": "", "GROUP": "7", "PLAIN_ORIGINS": "https://a.example"})
    assert (settings.session, settings.user_id, settings.group, settings.assigned) == (SID, "", None, False)
    assert settings.plain_origins == frozenset()
    assert settings.private == ()
    formed = assignment.formed(settings, document(("anna", "", "carl"), players=4, group=2))
    assert formed.assigned
    assert (formed.players, formed.group) == (4, 2)
    assert formed.seats == {"anna": 0, "carl": 2}
    assert formed.private == ("anna", "carl")
    assert formed.recordings_folder == f"study/sessions/{SID}/trials/pair-1"


def test_a_handed_over_session_has_the_settings_of_a_session_that_was_started_for_it():
    warm = Settings.from_env({**ENV, **WARM})
    assert not warm.assigned
    given = assignment.assigned(warm, Handover(SID, None, "pair-1"))
    assert given == Settings.from_env(ENV)


@pytest.mark.parametrize("bad", ["s.", "s.0123456789ABCDEF0123", "anna", SID + "0", f"{SID}/.."])
def test_a_session_that_is_none_is_refused(bad):
    with pytest.raises(SettingsError, match="SESSION"):
        Settings.from_env({**ENV, "SESSION": bad})


def test_without_a_session_nothing_of_it_is_there():
    settings = Settings.from_env({**ENV, "SESSION": "", "USER_ID": "P1"})
    assert (settings.session, settings.members, settings.seats, settings.players) == ("", (), {}, 1)
    assert settings.assigned
    assert settings.private == ("P1",)
    assert settings.recordings_folder == "study/users/P1/trials/pair-1"
    assert handshake.tokens_for(settings, "P1") == (TOKEN,)


def wait_for(true, seconds=15):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


# ---- acknowledgements that are forged


@pytest.mark.parametrize("forged", ["none", "of what was not sent", "before it is shown"])
def test_whatever_a_member_acknowledges_the_other_sees_the_game_go_on(launch, forged):
    """Acknowledgements pace a member's own pictures alone."""
    server = launch_session(launch, trial={"startingFrameRate": 20})
    form(server.store)

    async def forge(bert):
        while forged != "none":
            newest = bert.frames[-1][1] if bert.frames else 0
            await bert.say(ack=newest + (1000 if forged == "of what was not sent" else 0))
            await asyncio.sleep(0.02)

    async def run():
        async with member(server, "anna") as anna, member(server, "bert") as bert:
            bert.acks = False
            tasks = [asyncio.create_task(forge(bert)), asyncio.create_task(bert.watch(60))]
            await anna.until(lambda: len(anna.frames) > 10)
            first = len(anna.frames)
            while len(anna.frames) < first + 80:  # four seconds, after which a page that sleeps is away
                await anna.take()
                assert anna.state["people"] == {"left": "here", "right": "here"}
            for task in tasks:
                task.cancel()

    asyncio.run(run())
    assert "Traceback" not in server.said()
