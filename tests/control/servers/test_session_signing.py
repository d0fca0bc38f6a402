"""What the server of a session may ask for: the session's documents and its members' answers, and no other's."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.servers.signing import STORE_AFTER_CLOSE
from hippodrome.protocol.keys import handover_key, session_key, session_recordings_folder
from hippodrome.protocol.session import Member, SessionDocument
from testing.studies import study
from tests.control.servers.test_signing import PRIVKEY, WARM_ID, World, get, put

PAIRS = study(players=2)
SESSION, OTHER = ("s." + "0" * 19 + digit for digit in "12")
FOLDER = session_recordings_folder("maze", SESSION)
NAME = ids.server_name(ids.server_label("maze", SESSION), 1)
RECORDING = f"{FOLDER}{NAME}/3-trial.jsonl.gz"
DOCUMENT = session_key("maze", SESSION)


def answer(user: str, step: str = "3") -> str:
    return f"maze/users/{user}/answers/{step}.json"


@pytest.fixture
def world() -> World:
    made = World()
    made.keep(claim(made))
    return made


def claim(world: World, session: str = SESSION, attempt: int = 1) -> Server:
    return world.claim(session, attempt, PAIRS)


def form(world: World, *users: str) -> None:
    members = tuple(Member(user, None, seat) for seat, user in enumerate(users))
    world.documents.keep(DOCUMENT, SessionDocument(SESSION, 2, members).to_json())


def ask(world: World, *wishes: dict[str, Any], record: Server | None = None, name: str = "") -> int:
    record = record or claim(world)
    name = name or record.name
    credential = world.secrets.get_or_create().credential(name, record.nonce)
    sent = {"server": name, "credential": credential, "requests": [*wishes]}
    return world.send(json.dumps(sent).encode())[0]


@pytest.mark.parametrize(
    "wish",
    [
        get(PRIVKEY), get(DOCUMENT), put(RECORDING), put(f"{FOLDER}{NAME}/3-episode-0001.jsonl.gz"),
        get(answer("alice")), put(answer("alice")), get(answer("bob")), put(answer("bob")),
    ],
    ids=str,
)  # fmt: skip
def test_a_sessions_server_gets_requests_for_the_session_and_each_members_answer(
    world: World, wish: dict[str, Any]
) -> None:
    form(world, "alice", "bob")
    assert ask(world, wish) == 200


@pytest.mark.parametrize(
    "wish",
    [
        put(DOCUMENT), get(session_key("maze", OTHER)), get(f"maze/sessions/{SESSION}/session.json/x"),
        get(answer("carol")), put(answer("carol")), put(answer("alice", "1")), put(answer(SESSION)), put(answer("")),
        put(f"maze/users/{SESSION}/trials/{NAME}/3-trial.jsonl.gz"), put(f"maze/users/alice/trials/{NAME}/3-trial.jsonl.gz"),
        put(RECORDING.replace(SESSION, OTHER)), get(RECORDING), put(f"{FOLDER}{NAME[:-1]}2/3-trial.jsonl.gz"),
        put(f"{FOLDER}{NAME}/4-trial.jsonl.gz"), put(f"{FOLDER}3-trial.jsonl.gz"), get("maze/users/alice/session.json"),
        put("maze/users/alice/session.json"), get("_lobbies/maze.json"), get("maze/users/alice/participant.json"),
    ],
    ids=str,
)  # fmt: skip
def test_a_sessions_server_gets_no_request_for_anything_else(world: World, wish: dict[str, Any]) -> None:
    form(world, "alice", "bob")
    assert ask(world, wish) == 403


def test_a_sessions_server_reads_the_named_answers_of_its_members_alone(world: World) -> None:
    form(world, "alice", "bob")
    record = msgspec.structs.replace(claim(world), read_steps=("1",))
    world.keep(record)
    assert ask(world, get(answer("alice", "1")), get(answer("bob", "1"))) == 200
    for other in (get(answer("carol", "1")), get(answer("alice", "2")), put(answer("alice", "1"))):
        assert ask(world, other) == 403


def test_before_the_session_is_formed_its_server_may_read_only_its_document_and_certificate(world: World) -> None:
    assert ask(world, get(DOCUMENT), get(PRIVKEY)) == 200
    for wish in (put(answer("alice")), get(answer("alice")), put(answer(""))):
        assert ask(world, wish) == 403


@pytest.mark.parametrize("body", [b"", b"{", b'{"id": "s.1"}'])
def test_an_unreadable_session_document_allows_no_members_answer(world: World, body: bytes) -> None:
    world.documents.keep(DOCUMENT, body)
    assert ask(world, put(answer("alice"))) == 403
    assert ask(world, put(RECORDING)) == 200, "the recording is kept"


def test_no_answer_of_a_member_whose_data_were_erased_is_stored(world: World) -> None:
    form(world, "", "bob")
    assert ask(world, put(answer("bob"))) == 200
    assert ask(world, put(answer(""))) == 403


def test_the_next_server_of_the_session_may_read_the_recordings_of_the_earlier_ones(world: World) -> None:
    form(world, "alice", "bob")
    lost = server.close(claim(world), Reason.LOST, world.now())
    second = world.keep(server.replacing(lost, claim(world, attempt=2)))
    assert ask(world, get(RECORDING), get(answer("alice")), record=second) == 200
    assert ask(world, put(RECORDING), record=second) == 403


def test_a_stopped_server_may_still_store_the_answers_of_all_members(world: World) -> None:
    form(world, "alice", "bob")
    world.keep(server.close(claim(world), Reason.STOPPED, world.now()))
    world.wait(seconds=STORE_AFTER_CLOSE.total_seconds() - 1)
    assert ask(world, put(answer("alice")), put(answer("bob")), put(RECORDING)) == 200
    assert ask(world, get(DOCUMENT)) == 403
    world.wait(seconds=1)
    assert ask(world, put(answer("alice"))) == 403


def test_a_warm_server_that_was_assigned_to_a_session_has_the_sessions_rights(world: World) -> None:
    form(world, "alice", "bob")
    warm = world.keep(world.claim(WARM_ID, project=PAIRS, state=server.ServerState.READY))
    world.keep(server.handed_over(warm, claim(world).label, world.now()))
    world.keep(server.assigned(server.reserving(claim(world), warm), warm, world.now()))
    wishes = (get(handover_key("maze", warm.name)), get(DOCUMENT), put(answer("bob")), put(RECORDING))
    assert ask(world, *wishes, record=warm) == 200


def test_a_server_of_one_participant_reads_no_session(world: World) -> None:
    alice = world.keep(world.claim("alice"))
    form(world, "alice", "bob")
    for wish in (get(DOCUMENT), put(RECORDING), put(answer("bob"))):
        assert ask(world, wish, record=alice) == 403


def test_requests_of_a_sessions_server_cost_one_read_more(world: World) -> None:
    form(world, "alice", "bob")
    ask(world, get(DOCUMENT))  # the secret is read once
    for wish, calls in ((get(DOCUMENT), ["get", "get"]), (put(RECORDING), ["get", "get", "list"])):
        world.documents.calls.clear()
        assert ask(world, wish) == 200
        assert world.documents.calls == calls


QUESTION = "0123456789abcdef0123"
MATCHING = [get("_match/maze/waiting.json"), put(f"maze/lobby/groups/{QUESTION}.json")]


@pytest.fixture
def matching(world: World) -> Server:
    return world.keep(world.claim(SESSION, 1, study(players=2, matching="match")))


@pytest.mark.parametrize("wish", MATCHING, ids=str)
def test_only_a_server_without_members_may_answer_questions_of_match(
    world: World, matching: Server, wish: dict[str, Any]
) -> None:
    assert ask(world, wish, record=matching) == 200
    form(world, "alice", "bob")
    assert ask(world, wish, record=matching) == 403


@pytest.mark.parametrize("wish", MATCHING, ids=str)
def test_servers_of_projects_without_match_may_not_answer_its_questions(world: World, wish: dict[str, Any]) -> None:
    assert ask(world, wish) == 403


@pytest.mark.parametrize(
    "wish",
    [
        put("_match/maze/waiting.json"), get(f"maze/lobby/groups/{QUESTION}.json"), get("_match/other/waiting.json"),
        put(f"other/lobby/groups/{QUESTION}.json"), put("maze/lobby/groups/../x.json"), put("maze/lobby/groups/x.json"),
        put(f"maze/lobby/groups/{QUESTION}"), get("_lobby/maze/"), get("_match/maze/waiting.json/x"),
    ],
    ids=str,
)  # fmt: skip
def test_a_server_without_members_gets_nothing_else_of_the_lobby(
    world: World, matching: Server, wish: dict[str, Any]
) -> None:
    assert ask(world, wish, record=matching) == 403
