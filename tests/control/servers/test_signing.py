"""What a server may ask for: its own documents, and no other's."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import msgspec
import pytest

from hippodrome.control.http import Request
from hippodrome.control.model import ids, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.servers.signing import (
    MAX_ANSWER,
    MAX_RECORDED,
    MAX_RECORDINGS,
    MAX_REQUESTS,
    STORE_AFTER_CLOSE,
    VALID_SECONDS,
    Presigned,
    Signing,
)
from hippodrome.control.storage.secret import KEY, SecretCache
from hippodrome.protocol.keys import handover_key
from testing.fake_platform import FakePlatform
from testing.studies import study

PROJECT, ALICE, BOB = "maze", "alice", "bob"
NAME = ids.server_name(ids.server_label(PROJECT, ALICE), 1)
FULLCHAIN, PRIVKEY = (f"SSL/servers.example.org/{name}.pem" for name in ("fullchain", "privkey"))
FOLDER = f"{PROJECT}/users/{ALICE}"
TRIALS = f"{FOLDER}/trials/{NAME}"
ANSWER = f"{FOLDER}/answers/3.json"


class FakeSigner:
    """A signer that returns what it was asked to sign."""

    def presign_get(self, key: str, seconds: int) -> Presigned:
        return Presigned("GET", f"signed:{key}", {"for": str(seconds)})

    def presign_put(self, key: str, size: int, seconds: int) -> Presigned:
        return Presigned("PUT", f"signed:{key}", {"for": str(seconds), "bytes": str(size)})


class World(FakePlatform):
    def __init__(self) -> None:
        super().__init__()
        self.signer = FakeSigner()
        self.signing = Signing(self)
        self.secrets = SecretCache(self.documents)
        self.secrets.get_or_create()

    def claim(self, user: str = ALICE, attempt: int = 1, project: Project | None = None, **change: Any) -> Server:
        """Return the record of a server that has just been started."""
        made = server.new_attempt(
            project or study(id=PROJECT), user, attempt,
            nonce=f"nonce-{user}-{attempt}", settings=self.settings, now=self.now(),
        )  # fmt: skip
        return msgspec.structs.replace(made, **change)

    def keep(self, record: Server) -> Server:
        self.documents.put(server.key(record.label), to_json(record))
        return record

    def credential(self, record: Server) -> str:
        return self.secrets.get_or_create().credential(record.name, record.nonce)

    def ask(self, *wishes: dict[str, Any], **change: Any) -> tuple[int, dict[str, Any]]:
        """Alice's server asks."""
        record = self.claim()
        sent = {"server": record.name, "credential": self.credential(record), "requests": list(wishes), **change}
        return self.send(json.dumps(sent).encode())

    def send(self, body: bytes | None, method: str = "POST") -> tuple[int, dict[str, Any]]:
        answer = self.signing.respond(Request(method, "/sign", (), {}, body))
        return answer.status, json.loads(answer.body)


@pytest.fixture
def world() -> World:
    made = World()
    made.keep(made.claim())
    return made


def get(key: str) -> dict[str, Any]:
    return {"method": "GET", "key": key}


def put(key: str, size: int | None = 9) -> dict[str, Any]:
    return {"method": "PUT", "key": key, **({} if size is None else {"size": size})}


@pytest.mark.parametrize(
    "wish",
    [
        get(FULLCHAIN),
        get(PRIVKEY),
        get(ANSWER),
        put(ANSWER),
        put(ANSWER, MAX_ANSWER),
        put(f"{TRIALS}/3-episode-0001.jsonl.gz"),
        put(f"{TRIALS}/3-episode-0001-2.jsonl.gz"),
        put(f"{TRIALS}/3-episode-12345.jsonl.gz"),
        put(f"{TRIALS}/3-trial.jsonl.gz"),
        put(f"{TRIALS}/3-talk-0001.json"),
        put(f"{TRIALS}/3-talk-12345.json"),
    ],
    ids=str,
)
def test_a_server_gets_requests_for_its_own_documents(world: World, wish: dict[str, Any]) -> None:
    status, found = world.ask(wish)
    assert (status, found["seconds"]) == (200, VALID_SECONDS)
    (request,) = found["requests"]
    size = {"bytes": str(wish["size"])} if "size" in wish else {}
    assert request == {
        "method": wish["method"],
        "url": f"signed:{wish['key']}",
        "headers": {"for": str(VALID_SECONDS), **size},
    }


OTHER = ids.server_name(ids.server_label(PROJECT, BOB), 1)


@pytest.mark.parametrize(
    "wish",
    [
        get("project_master_list.json"), get(KEY), get(f"_servers/{NAME[:-2]}.json"), get(f"_slots/{PROJECT}.json"),
        get("SSL/account.json"), get("SSL/fullchain.pem"), get("SSL/privkey.pem"), get("SSL/other.example.org/privkey.pem"), put(PRIVKEY), put(FULLCHAIN),
        get(f"{PROJECT}/users/{BOB}/answers/3.json"), put(f"{PROJECT}/users/{BOB}/answers/3.json"),
        get(f"{PROJECT}/users/{BOB}/trials/{OTHER}/3-trial.jsonl.gz"), put(f"{PROJECT}/users/{BOB}/trials/{OTHER}/3-trial.jsonl.gz"),
        get(f"other/users/{ALICE}/answers/3.json"), put(f"other/users/{ALICE}/answers/3.json"),
        get(f"{FOLDER}/participant.json"), put(f"{FOLDER}/participant.json"),
        put(f"{FOLDER}/answers/1.json"), get(f"{FOLDER}/answers/1.json"), put(f"{FOLDER}/answers/final.json"),
        put(f"{FOLDER}/answers/3.json/x"), put(f"{FOLDER}/answers/3"), put(f"/{ANSWER}"), put(f"{ANSWER} "),
        put(f"{FOLDER}/answers/../answers/3.json"), put(f"{FOLDER}/answers/3.JSON"),
        put(ANSWER, None), put(ANSWER, -1), put(ANSWER, MAX_ANSWER + 1), put(f"{TRIALS}/3-trial.jsonl.gz", 5 * 1024**3 + 1),
        put(f"{TRIALS}/4-trial.jsonl.gz"), put(f"{TRIALS}/3-trial.jsonl.gz.part"), put(f"{TRIALS}/3-talk-1.json"), put(f"{TRIALS}/4-talk-0001.json"), put(f"{TRIALS}/3-trial-0.jsonl.gz"),
        put(f"{TRIALS}/3-trial-100.jsonl.gz"), put(f"{TRIALS}/x/3-trial.jsonl.gz"), put(f"{TRIALS}/3-episode-1.jsonl.gz"),
        put(f"{TRIALS}/3-trial.jsonl.gz\n"), put(f"{FOLDER}/trials/{NAME[:-1]}2/3-trial.jsonl.gz"), put(f"{FOLDER}/trials/3-trial.jsonl.gz"),
        get(f"{TRIALS}/3-trial.jsonl.gz"), get(f"{FOLDER}/trials/{NAME[:-1]}2/3-trial.jsonl.gz"),
        get(f"{FOLDER}/trials/{OTHER}/3-trial.jsonl.gz"),
        get(handover_key(PROJECT, OTHER)), put(handover_key(PROJECT, NAME)),
        get(f"{PROJECT}/steps/1.html"), put(f"{PROJECT}/steps/1.html"), get(""), put(""),
    ],
    ids=str,
)  # fmt: skip
def test_a_server_gets_no_request_for_any_other_document(world: World, wish: dict[str, Any]) -> None:
    status, found = world.ask(wish)
    assert status == 403
    assert "requests" not in found
    assert not any(part in json.dumps(found) for part in (ALICE, BOB, PROJECT, NAME)), "the sentence names nothing"


def test_a_server_reads_the_answers_that_the_study_names_and_stores_none(world: World) -> None:
    world.keep(world.claim(project=study(id=PROJECT, trial={"game": "x", "answers": ["1"]})))
    consent = f"{FOLDER}/answers/1.json"
    assert world.ask(get(consent))[0] == 200
    for other in (put(consent), get(f"{FOLDER}/answers/2.json"), get(f"{PROJECT}/users/{BOB}/answers/1.json")):
        assert world.ask(other)[0] == 403


def test_one_document_that_is_not_allowed_refuses_the_whole_request(world: World) -> None:
    assert world.ask(put(ANSWER), put(f"{FOLDER}/answers/1.json"))[0] == 403


def test_a_token_or_another_servers_credential_is_refused(world: World) -> None:
    bob = world.keep(world.claim(BOB))
    for wrong in ("the-token", "", world.credential(bob), world.credential(world.claim())[:-1], "ü", "0" * 64):
        assert world.ask(get(ANSWER), credential=wrong)[0] == 403, wrong
    assert world.ask(get(ANSWER), server=bob.name)[0] == 403
    assert world.ask(get(ANSWER), server="nobody")[0] == 403
    assert world.ask(get(ANSWER), server=f"{NAME[:-1]}2")[0] == 403


def test_all_unknown_servers_get_the_same_answer(world: World) -> None:
    world.documents.put(server.key(ids.server_label(PROJECT, "gone")), to_json(world.claim("gone", nonce="")))
    gone = ids.server_name(ids.server_label(PROJECT, "gone"), 1)
    answers = [
        world.ask(get(ANSWER), credential="wrong"),
        world.ask(get(ANSWER), server="nobody"),
        world.ask(get(ANSWER), server=OTHER),
        world.ask(get(ANSWER), server=gone, credential=world.secrets.get_or_create().credential(gone, "")),
    ]
    assert all(answer == answers[0] for answer in answers)


def test_without_a_secret_every_server_is_refused(world: World) -> None:
    world.documents.delete(KEY)
    assert world.ask(get(ANSWER))[0] == 403
    assert KEY not in world.documents.kept, "and none is made"


@pytest.mark.parametrize(
    "body",
    [
        None, b"", b"[]", b"{}", b"\xff", b'"', b"[" * 20_000, b'{"server": 1, "credential": "", "requests": []}',
        b'{"server": "a", "credential": "b", "requests": []}',
        b'{"server": "a", "credential": "b", "requests": [{"method": "DELETE", "key": "x"}]}',
        b'{"server": "a", "credential": "b", "requests": [{"method": "GET", "key": null}]}',
        b'{"server": "a", "credential": "b", "requests": [{"method": "PUT", "key": "x", "size": 1.5}]}',
        b'{"server": "a", "credential": "b", "requests": [{"method": "PUT", "key": "x", "size": true}]}',
        b" " * 33_000,
    ],
    ids=lambda body: str(body)[:60],
)  # fmt: skip
def test_an_unreadable_body_is_refused_with_a_sentence(world: World, body: bytes | None) -> None:
    reads = len(world.documents.calls)
    status, found = world.send(body)
    assert status in (400, 413)
    assert set(found) == {"message"}
    assert len(world.documents.calls) == reads, "and costs nothing"


def test_the_number_of_requests_at_once_is_limited(world: World) -> None:
    assert world.ask(*[get(ANSWER)] * MAX_REQUESTS)[0] == 200
    assert world.ask(*[get(ANSWER)] * (MAX_REQUESTS + 1))[0] == 400


def test_other_methods_than_post_are_refused(world: World) -> None:
    assert world.send(b"", "GET")[0] == 405


def test_the_size_of_a_servers_documents_is_limited(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    key = f"{TRIALS}/3-episode-0002.jsonl.gz"
    world.documents.put(f"{TRIALS}/3-episode-0001.jsonl.gz", b"12345")
    assert world.ask(put(key, 9))[0] == 200
    monkeypatch.setattr("hippodrome.control.servers.signing.MAX_RECORDED", 13)
    assert world.ask(put(key, 9))[0] == 403
    assert world.ask(put(key, 8))[0] == 200
    assert world.ask(put(key, 8), put(f"{TRIALS}/3-episode-0003.jsonl.gz", 1))[0] == 403
    monkeypatch.setattr("hippodrome.control.servers.signing.MAX_RECORDINGS", 1)
    assert world.ask(put(key, 1))[0] == 403
    assert world.ask(put(ANSWER))[0] == 200, "its answer has room in any case"


def test_a_server_may_store_6000_recordings_of_20_gib_in_all(world: World) -> None:
    assert (MAX_RECORDED, MAX_RECORDINGS) == (20 * 1024**3, 6_000)


# When


def test_a_server_may_ask_as_soon_as_it_starts(world: World) -> None:
    """It fetches its certificate before the control plane knows that it runs."""
    assert from_json(world.documents.kept[server.key(NAME[:-2])][0], Server).state is server.ServerState.STARTING
    assert world.ask(get(PRIVKEY), get(ANSWER))[0] == 200


@pytest.mark.parametrize("reason", [Reason.STOPPED, Reason.DEADLINE, Reason.LOST, Reason.ENDED])
def test_a_stopped_server_may_still_store_answers_and_recordings(world: World, reason: Reason) -> None:
    world.keep(server.close(world.claim(), reason, world.now()))
    world.wait(seconds=STORE_AFTER_CLOSE.total_seconds() - 1)
    assert world.ask(put(ANSWER), put(f"{TRIALS}/3-trial.jsonl.gz"))[0] == 200
    for wish in (get(ANSWER), get(PRIVKEY), get(f"{FOLDER}/answers/1.json")):
        assert world.ask(wish)[0] == 403, "it needs to read nothing any more"
    world.wait(seconds=1)
    assert world.ask(put(ANSWER))[0] == 403


def test_the_time_to_store_is_longer_than_a_task_may_take_to_end() -> None:
    from hippodrome.deployment.study.definition import STOP_TIMEOUT

    assert timedelta(seconds=2 * STOP_TIMEOUT) <= STORE_AFTER_CLOSE


def test_a_lost_and_replaced_server_may_still_store_its_recordings(world: World) -> None:
    """The last recording of this server may arrive when its participant has the next one already."""
    lost = server.close(world.claim(), Reason.LOST, world.now())
    world.wait(seconds=60)
    world.keep(server.replacing(lost, world.claim(attempt=2)))
    assert world.ask(put(f"{TRIALS}/3-trial.jsonl.gz"))[0] == 200
    assert world.ask(get(PRIVKEY))[0] == 403
    world.wait(seconds=STORE_AFTER_CLOSE.total_seconds())
    assert world.ask(put(f"{TRIALS}/3-trial.jsonl.gz"))[0] == 403


def test_the_next_server_may_read_the_recordings_of_the_earlier_ones(world: World) -> None:
    second = world.keep(server.replacing(server.close(world.claim(), Reason.LOST, world.now()), world.claim(attempt=2)))
    theirs = {"server": second.name, "credential": world.credential(second)}
    assert world.ask(get(f"{TRIALS}/3-trial.jsonl.gz"), get(f"{TRIALS}/3-episode-0001.jsonl.gz"), **theirs)[0] == 200
    assert world.ask(put(f"{TRIALS}/3-trial.jsonl.gz"), **theirs)[0] == 403, "but adds nothing to them"
    assert world.ask(put(f"{FOLDER}/trials/{second.name}/3-trial.jsonl.gz"), **theirs)[0] == 200


def test_after_an_erasure_a_server_has_another_credential(world: World) -> None:
    before = world.credential(world.claim())
    world.keep(world.claim(nonce="another"))
    assert world.ask(put(ANSWER), credential=before)[0] == 403


def test_a_server_of_several_games_stores_the_answer_of_each(world: World) -> None:
    steps = [Step("1", "a"), Step("2", "game"), Step("3", "game"), Step("final", "b")]
    world.keep(world.claim(project=study(id=PROJECT, steps=steps)))
    assert world.ask(put(f"{FOLDER}/answers/2.json"), put(ANSWER))[0] == 200
    assert world.ask(put(f"{FOLDER}/answers/1.json"))[0] == 403


# Warm servers


WARM_ID = "~" + "0" * 20


@pytest.fixture
def warm_server(world: World) -> Server:
    """A warm server for a participant, ready."""
    return world.keep(world.claim(WARM_ID, state=server.ServerState.READY))


@pytest.fixture
def asks(world: World, warm_server: Server) -> Callable[..., int]:
    credential = world.credential(warm_server)
    return lambda *wishes: world.ask(*wishes, server=warm_server.name, credential=credential)[0]


def test_a_warm_server_may_read_only_its_certificate_and_its_handover(
    warm_server: Server, asks: Callable[..., int]
) -> None:
    assert asks(get(PRIVKEY), get(handover_key(PROJECT, warm_server.name))) == 200
    own = f"{PROJECT}/users/{WARM_ID}"
    for wish in (put(ANSWER), get(ANSWER), put(f"{TRIALS}/3-trial.jsonl.gz"), put(f"{own}/answers/3.json"),
                 put(f"{PROJECT}/users//answers/3.json"), put(f"{own}/trials/{warm_server.name}/3-trial.jsonl.gz")):  # fmt: skip
        assert asks(wish) == 403, wish


def assign_to_alice(world: World, warm_server: Server) -> Server:
    """Assign the warm server to alice; her server's record."""
    world.keep(server.handed_over(warm_server, ids.server_label(PROJECT, ALICE), world.now()))
    return world.keep(server.assigned(server.reserving(world.claim(), warm_server), warm_server, world.now()))


def test_an_assigned_warm_server_has_the_rights_of_its_participants_server(
    world: World, warm_server: Server, asks: Callable[..., int]
) -> None:
    record = assign_to_alice(world, warm_server)
    assert asks(get(handover_key(PROJECT, warm_server.name)), get(PRIVKEY), get(ANSWER)) == 200
    assert asks(put(ANSWER), put(f"{TRIALS}/3-trial.jsonl.gz")) == 200
    assert asks(put(f"{PROJECT}/users/{BOB}/answers/3.json")) == 403
    assert asks(put(f"{FOLDER}/trials/{warm_server.name}/3-trial.jsonl.gz")) == 403, (
        "they lie under the participant's name"
    )
    world.keep(server.close(record, Reason.STOPPED, world.now()))
    assert asks(put(ANSWER)) == 200
    assert asks(get(ANSWER)) == 403
    world.wait(seconds=STORE_AFTER_CLOSE.total_seconds())
    assert asks(put(ANSWER)) == 403


def test_an_assigned_warm_server_that_was_lost_may_still_store_its_recordings(
    world: World, warm_server: Server, asks: Callable[..., int]
) -> None:
    lost = server.close(assign_to_alice(world, warm_server), Reason.LOST, world.now())
    world.keep(server.replacing(lost, world.claim(attempt=2)))
    assert asks(put(f"{TRIALS}/3-trial.jsonl.gz")) == 200
    assert asks(put(f"{FOLDER}/trials/{NAME[:-1]}2/3-trial.jsonl.gz")) == 403


@pytest.mark.parametrize("end", [server.draining, lambda s: server.close(s, Reason.STOPPED, s.requested)])
def test_a_drained_or_closed_warm_server_gets_nothing(
    world: World, warm_server: Server, asks: Callable[..., int], end: Callable[[Server], Server]
) -> None:
    world.keep(end(warm_server))
    assert asks(get(PRIVKEY)) == 403


def test_a_request_costs_one_read_and_for_recordings_a_listing(world: World) -> None:
    world.ask(get(ANSWER))  # the secret is read once
    for wish, calls in (
        (get(ANSWER), ["get"]),
        (put(ANSWER), ["get"]),
        (put(f"{TRIALS}/3-trial.jsonl.gz"), ["get", "list"]),
    ):
        world.documents.calls.clear()
        assert world.ask(wish)[0] == 200
        assert world.documents.calls == calls
