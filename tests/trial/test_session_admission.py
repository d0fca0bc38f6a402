"""Who is let into a session's game: each member with their own token, to their own place, and no other client."""

import asyncio
import contextlib
import json

from hypothesis import given as for_all
from hypothesis import strategies as st
from websockets.asyncio.client import connect

from hippodrome.protocol.session import member_token
from hippodrome.trial.core.messages import Hello
from hippodrome.trial.server import assignment, handshake
from hippodrome.trial.settings import TrialSettings
from tests.trial.sessions import (
    ENV,
    MEMBERS,
    SID,
    TOKEN,
    answer,
    document,
    form,
    hello_of,
    launch_formed,
    launch_session,
    member,
    put,
    recordings,
    refused,
    wait_for_pictures,
)


async def test_each_member_plays_the_player_of_their_seat(launch):
    server = launch_formed(launch)
    async with member(server, "bert") as bert, member(server, "anna") as anna:
        assert (anna.controls["player"], bert.controls["player"]) == ("left", "right")


async def test_a_member_cannot_play_in_the_place_of_another(launch, open_client):
    server = launch_formed(launch)
    await refused(server, open_client, userId="bert", token=member_token(TOKEN, "anna"))
    await refused(server, open_client, userId="anna", token=member_token(TOKEN, "bert"))
    await refused(server, open_client, userId=None, token=member_token(TOKEN, "anna"))
    async with member(server, "anna", seat=1, player="right") as anna:
        assert anna.controls["player"] == "left", "whoever names a seat keeps their own"


async def test_no_token_lets_in_a_participant_who_is_no_member(launch, open_client):
    server = launch_formed(launch)
    await refused(server, open_client, **hello_of("carl"))
    await refused(server, open_client, userId="carl", token=member_token(TOKEN, "anna"))
    await refused(server, open_client, userId="", token=member_token(TOKEN, ""))
    await refused(server, open_client, userId=SID, token=member_token(TOKEN, SID))


async def test_the_servers_own_token_opens_no_session(launch, open_client):
    server = launch_formed(launch)
    await refused(server, open_client, userId="anna", token=TOKEN)


async def test_a_token_of_another_session_opens_nothing(launch, open_client):
    server = launch_formed(launch)
    await refused(server, open_client, userId="anna", token=member_token("another-server", "anna"))


async def test_a_participant_whose_data_were_erased_is_no_member_any_more(launch, open_client):
    server = launch_session(launch, trial={"substitute": "idle"})
    form(server.store, document(("anna", "")))
    await refused(server, open_client, **hello_of("bert"))
    await refused(server, open_client, userId="", token=member_token(TOKEN, ""))
    async with member(server, "anna"):
        pass


async def test_without_a_substitute_the_game_ends_if_the_data_of_a_member_were_erased(launch):
    """As if that participant had left: the others do not wait for a game that cannot begin."""
    server = launch_session(launch)
    form(server.store, document(("anna", "")))
    async with member(server, "anna") as anna:
        assert await anna.closed() == 1000
        assert anna.done["outcome"] == "partnerLeft"
    assert server.wait() == 0
    assert answer(server.store, "anna")["answers"]["episodes"] == 0


async def test_the_score_of_a_game_with_a_member_whose_data_were_erased_counts_for_the_others(launch):
    first = launch_session(launch)
    form(first.store)
    async with member(first, "anna") as anna, member(first, "bert") as bert:
        await anna.say(action="up", held=True)
        await wait_for_pictures(21, anna, bert)
        first.terminate()
        await asyncio.gather(anna.closed(), bert.closed())
    assert first.wait() == 0
    [lines] = recordings(first.store).values()
    put(first.store, f"study/sessions/{SID}/session.json", document(("anna", "")).to_json())
    second = launch_session(launch, SERVER="pair-2")
    async with member(second, "anna") as anna:
        assert await anna.closed() == 1000
    assert second.wait() == 0
    found = answer(second.store, "anna")["answers"]
    steps = [line for line in lines if line["kind"] == "step"]
    assert found["score"] == sum(line["players"]["left"]["reward"] for line in steps) > 0
    assert (found["outcome"], found["episodes"]) == ("partnerLeft", 1)


@for_all(user_id=st.one_of(st.none(), st.text(), st.sampled_from(MEMBERS)), token=st.one_of(st.none(), st.text()))
def test_whatever_a_client_says_only_a_member_with_their_own_token_gets_in(user_id, token):
    settings = assignment.with_members(TrialSettings.from_env(ENV), document())

    class Socket:
        subprotocol = "hippodrome"

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


async def test_a_second_tab_replaces_the_members_own_and_no_other(launch):
    server = launch_formed(launch)
    async with member(server, "anna") as first, member(server, "bert") as bert, member(server, "anna") as second:
        assert await first.closed() == 4409
        assert "another tab" in first.errors[-1]
        assert second.controls["player"] == "left"
        await bert.watch(0.3)
        assert bert.websocket.close_code is None


async def test_two_browsers_with_one_members_link_are_one_member(launch):
    """The browser that opened it last plays; the other place stays the other member's."""
    server = launch_formed(launch)
    async with contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(member(server, "anna")) for _ in range(3)]
        assert {client.controls["player"] for client in clients} == {"left"}
        assert [await client.closed() for client in clients[:2]] == [4409, 4409]


async def test_a_members_token_opens_nothing_for_programs(launch):
    server = launch_formed(launch, trial={"gym": "watch"})
    async with connect(f"{server.address}gym?token={member_token(TOKEN, 'anna')}", proxy=None) as program:
        await program.wait_closed()
        assert program.close_code == 4401


async def test_a_program_needs_the_servers_token_and_a_formed_session(launch):
    server = launch_session(launch, trial={"gym": "watch"})

    async def watch(code):
        async with connect(f"{server.address}gym?token={TOKEN}", proxy=None) as program:
            if code is None:
                await program.send(json.dumps({"method": "action_space", "params": {"player": "right"}}))
                assert json.loads(await asyncio.wait_for(program.recv(), 10))["n"] == 3
            else:
                await program.wait_closed()
                assert program.close_code == code

    await watch(1013)
    form(server.store)
    async with member(server, "anna"):
        await watch(None)


async def test_a_page_without_a_token_never_gets_into_a_session(launch, open_client):
    page = "https://front.example"
    server = launch_formed(launch, PLAIN_ORIGINS=page)
    async with open_client(server.address, subprotocols=None, origin=page) as client:
        await client.hello(userId="anna", token=None)
        assert await client.closed() == 4401


async def test_a_client_without_a_subprotocol_never_gets_into_a_session(launch, open_client):
    """What such a client sends along is recorded: it could write another participant's id into the recording."""
    server = launch_formed(launch)
    async with open_client(server.address, subprotocols=None) as client:
        await client.hello(**hello_of("anna"))
        assert await client.closed() == 4401
        assert "subprotocol" in client.errors[-1]
