"""Tokens, tickets and signatures are derived from one secret, and documents that researchers read hold none of them.

Documents that earlier versions wrote hold tokens and secrets: these stay valid.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from hippodrome.model import ids, server
from hippodrome.model.messages import StartServer
from hippodrome.model.participant import participant_key
from hippodrome.model.project import MASTER_LIST, read_list, step_key
from hippodrome.model.records import from_json, to_json
from hippodrome.model.server import Server, ServerState
from hippodrome.ports import Address, Conflict, Topic
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.secret import KEY, Secret, SecretCache
from lambdas import installed as place
from lambdas import send_start_server_message, send_stop_server_message, update_project_master_list
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import PAGES, installed, study
from testing.visitors import Browser
from tests.hippodrome.participants.test_journey import poll
from tests.hippodrome.participants.test_relays import ask
from tests.hippodrome.test_registry import registration

LABEL = ids.server_label("maze", "alice")


@pytest.fixture
def platform() -> FakePlatform:
    """No project is registered; the pages of four are there."""
    platform = FakePlatform()
    for project in ("maze", "other", "third", "broken"):
        for file in ("consent-0", "consent-1", "bye", *PAGES):
            platform.documents.put(step_key(project, file), b"x")
    place.use(platform)
    return platform


def register(project_id: str = "maze", **changes: object) -> None:
    answer = update_project_master_list.handler({"project": registration(project_id, **changes)}, None)
    assert answer.get("registered") == project_id, answer


def signatures(*users: object, project_id: str = "maze") -> dict[str, Any]:
    return update_project_master_list.handler({"links": {"projectId": project_id, "userIds": list(users)}}, None)


def document(platform: FakePlatform, key: str) -> Any:
    return json.loads(platform.documents.kept[key][0])


def secret(platform: FakePlatform, project_id: str = "maze") -> str:
    """Return the secret that signs the project's tickets and links, as a new function reads it."""
    project = ProjectCache(platform, SecretCache(platform.documents)).project(project_id)
    assert project
    return project.secret


def as_earlier(platform: FakePlatform, *entries: Any) -> None:
    """The master list as an earlier version wrote it."""
    platform.documents.put(MASTER_LIST, json.dumps({"projects": list(entries)}).encode())


def entry(project_id: str, its_secret: str) -> Any:
    return msgspec.to_builtins(study(id=project_id, secret=its_secret, name=""))


def playing(platform: FakePlatform, **changes: object) -> Server:
    """Write the record of alice's ready server, with these changes."""
    record = server.new_attempt(study(), "alice", 1, nonce="n", settings=platform.settings, now=platform.now())
    record = server.ready(server.naming(record, "task", Address("192.0.2.1", 443), platform.now()), platform.now())
    record = msgspec.structs.replace(record, **changes)
    platform.documents.put(server.key(LABEL), to_json(record))
    return record


# What documents hold


def test_neither_the_list_nor_a_record_holds_a_secret_or_a_token(platform: FakePlatform) -> None:
    steps = [{"key": "1", "page": "consent", "variants": 2}, {"key": "2", "page": "game", "variants": 0}]
    register(steps=[*steps, {"key": "finalStep", "page": "bye", "variants": 0}], trial={"game": "G"}, events={})
    Servers(platform).start(StartServer("maze", "alice"))
    (request,) = platform.tasks.running.values()
    its_secret = secret(platform)
    hidden = [
        its_secret,
        request.environment["TOKEN"],
        request.environment["CREDENTIAL"],
        document(platform, KEY)["secret"],
    ]
    assert all(len(one) >= 48 for one in hidden)
    for key, (body, *_) in platform.documents.kept.items():
        if key != KEY:
            assert not [one for one in hidden if one.encode() in body], key
    assert "secret" not in document(platform, MASTER_LIST)["projects"][0]
    assert document(platform, server.key(LABEL))["token"] == ""


def test_each_project_server_and_attempt_has_its_own_secret() -> None:
    kept = Secret("0" * 64)
    projects = [study(secret="", salt=salt, id=name) for name in ("maze", "other") for salt in ("a", "b")]
    settings, now = FakePlatform().settings, FakePlatform().now()
    servers = [
        server.new_attempt(study(), user, attempt, nonce=nonce, settings=settings, now=now)
        for user in ("alice", "bob") for attempt in (1, 2) for nonce in ("a", "b")
    ]  # fmt: skip
    made = [
        *map(kept.project_secret, projects),
        *map(kept.token, servers),
        *(kept.credential(one.name, one.nonce)[:48] for one in servers),
        *map(Secret("1" * 64).token, servers),
    ]
    assert len(set(made)) == len(made) == 4 + 3 * 8
    assert "0" * 64 not in repr(kept)


def test_a_project_that_was_removed_and_is_registered_again_has_another_secret(platform: FakePlatform) -> None:
    register()
    before = secret(platform)
    as_earlier(platform)
    register()
    assert secret(platform) != before


def test_another_salt_makes_another_secret(platform: FakePlatform) -> None:
    """In this way an administrator replaces a leaked secret, whether derived or of an earlier version."""
    register()
    as_earlier(platform, *document(platform, MASTER_LIST)["projects"], entry("other", "of-old"))
    register()
    before = [secret(platform, name) for name in ("maze", "other")]
    listed = document(platform, MASTER_LIST)
    for one in listed["projects"]:
        one["salt"] = "another"
    platform.documents.put(MASTER_LIST, json.dumps(listed).encode())
    after = [secret(platform, name) for name in ("maze", "other")]
    assert not {*before} & {*after}
    register("other")
    assert [secret(platform, name) for name in ("maze", "other")] == after
    as_earlier(platform, entry("third", "of-old") | {"salt": "another"})
    assert secret(platform, "third") != "of-old", "also where it stands in the list still"


# Calls


def test_a_function_reads_the_secret_once(platform: FakePlatform) -> None:
    register()
    place.use(platform)
    reads = reads_of_secret(platform)
    for user in ("alice", "alice", "bob"):
        assert Browser(platform, f"projectId=maze&userId={user}").send()["statusCode"] == 200
    assert reads == [KEY]


def reads_of_secret(platform: FakePlatform) -> list[str]:
    """Return a list to which each read of the secret from now on is added."""
    reads: list[str] = []
    get = platform.documents.get

    def counted(key: str, *more: Any) -> Any:
        if key == KEY:
            reads.append(key)
        return get(key, *more)

    platform.documents.get = counted  # type: ignore[method-assign]
    return reads


# Signed links


def test_links_are_signed_by_the_function_that_has_the_secret(platform: FakePlatform) -> None:
    register(signedLinks=True)
    signed = signatures("alice", "bob")["signatures"]
    assert signed == [ids.link_signature(secret(platform), "maze", user) for user in ("alice", "bob")]
    assert Browser(platform, f"projectId=maze&userId=alice&signature={signed[0]}").send()["statusCode"] == 200
    assert Browser(platform, f"projectId=maze&userId=bob&signature={signed[0]}").send()["statusCode"] == 403


@pytest.mark.parametrize(
    "asked",
    [
        None, [], "maze", {}, {"projectId": "maze"}, {"projectId": "maze", "userIds": "alice"},
        {"projectId": "maze", "userIds": ["../x"]}, {"projectId": "maze", "userIds": [None]},
        {"projectId": "maze", "userIds": ["a"] * 5001}, {"projectId": "none", "userIds": ["a"]},
        {"projectId": ["maze"], "userIds": ["a"]},
    ],
)  # fmt: skip
def test_a_malformed_request_for_links_gets_none(platform: FakePlatform, asked: object) -> None:
    register()
    answer = update_project_master_list.handler({"links": asked}, None)
    assert list(answer) == ["problems"]
    assert len(answer["problems"]) == 1


# Documents of earlier versions


def test_signed_links_and_open_pages_of_an_earlier_version_stay_valid(platform: FakePlatform) -> None:
    """Before any new registration, after that of another project, and after that of the project itself."""
    link = ids.link_signature("of-old", "maze", "alice")
    as_earlier(platform, entry("maze", "of-old") | {"signedLinks": True}, entry("other", "others-of-old"))
    browser = Browser(platform, f"projectId=maze&userId=alice&signature={link}")
    running = ProjectCache(platform, secrets := SecretCache(platform.documents))
    secrets.get_or_create()
    for step in (lambda: None, lambda: register("third"), lambda: register("maze", signedLinks=True)):
        step()
        assert browser.send()["statusCode"] == 200
        ticket = ids.ticket("of-old", "alice", "1")
        posted = browser.post(**{"hippodrome-step": "1", "hippodrome-ticket": ticket, "consent": "yes"})
        assert posted["statusCode"] == 303
        assert [secret(platform, name) for name in ("maze", "other")] == ["of-old", "others-of-old"]
        platform.wait(minutes=1)
        found = running.project("maze")
        assert found, "also for a function that has read the secret before"
        assert found.secret == "of-old"
    assert b"of-old" not in platform.documents.kept[MASTER_LIST][0]


def test_after_an_old_list_is_restored_all_secrets_stay_valid(platform: FakePlatform) -> None:
    """An administrator restores an old version of the list, so that it holds secrets again."""
    as_earlier(platform, entry("maze", "of-old"))
    before = platform.documents.kept[MASTER_LIST][0]
    register("other")
    others = secret(platform, "other")
    platform.documents.put(MASTER_LIST, before)
    assert secret(platform) == "of-old"
    register("other")
    assert (secret(platform), secret(platform, "other") != others) == ("of-old", True)


@pytest.mark.parametrize("done", [0, 1, 2])
def test_an_interrupted_registration_loses_no_secret(platform: FakePlatform, done: int) -> None:
    """It ends before the secret is made, before it takes the projects' secrets over, or before the list is written without them."""
    as_earlier(platform, entry("maze", "of-old"))

    def cut() -> None:
        raise ConnectionError

    platform.documents.before_write = [*[lambda: None] * done, cut]
    with pytest.raises(ConnectionError):
        register("third")
    platform.documents.before_write = []
    assert secret(platform) == "of-old"
    register("third")
    assert secret(platform) == "of-old"
    assert b"of-old" not in platform.documents.kept[MASTER_LIST][0]


def test_two_functions_that_take_secrets_over_at_once_lose_none(platform: FakePlatform) -> None:
    SecretCache(platform.documents).get_or_create()
    other = SecretCache(platform.documents)
    platform.documents.before_write = [lambda: other.add_project_secrets({"b": "2"})]
    SecretCache(platform.documents).add_project_secrets({"a": "1"})
    assert document(platform, KEY)["projects"] == {"a": "1", "b": "2"}


def test_repeated_conflicts_raise_conflict(platform: FakePlatform) -> None:
    SecretCache(platform.documents).get_or_create()

    def fails(*_: Any) -> str:
        raise Conflict

    platform.documents.replace = fails  # type: ignore[method-assign]
    with pytest.raises(Conflict):
        SecretCache(platform.documents).add_project_secrets({"a": "1"})


def test_an_entry_without_secret_and_salt_still_has_a_secret(platform: FakePlatform) -> None:
    """An earlier version that is installed again for a while drops fields that it does not know."""
    register()
    as_earlier(platform, entry("maze", ""))
    assert len(secret(platform)) == 64
    assert secret(platform) != ids.ticket("", "alice", "1")
    before = secret(platform)
    register()
    assert secret(platform) == before


def test_without_the_document_of_the_secret_no_page_is_shown(platform: FakePlatform) -> None:
    register()
    platform.documents.delete(KEY)
    with pytest.raises(LookupError, match=f"{KEY} is gone"):
        ProjectCache(platform, SecretCache(platform.documents)).project("maze")
    assert Browser(platform, "projectId=maze&userId=alice").send()["statusCode"] == 500


@pytest.mark.parametrize("body", [b'{"secret": ""}', b'{"secret": "short"}', b"{}", b"[]", b"", b"[" * 9_999])
def test_with_a_document_that_holds_no_secret_no_page_is_shown(platform: FakePlatform, body: bytes) -> None:
    """Otherwise anyone who knows the rules of `secret.py` could derive the same proofs from an empty text."""
    register()
    platform.documents.put(KEY, body)
    with pytest.raises((ValueError, RecursionError)):
        ProjectCache(platform, SecretCache(platform.documents)).project("maze")
    assert Browser(platform, "projectId=maze&userId=alice").send()["statusCode"] == 500


def test_a_server_that_an_earlier_version_started_keeps_its_token(platform: FakePlatform) -> None:
    """Its page gets the token that the server knows, and the relays accept it; the secret is not read for that."""
    as_earlier(platform, entry("maze", "of-old"))
    for key in "12":
        platform.documents.put(f"maze/users/alice/answers/{key}.json", b"{}")
    platform.documents.put(participant_key("maze", "alice"), b"{}")
    playing(platform, token="the-old-token")
    reads = reads_of_secret(platform)
    assert poll(Browser(platform))["token"] == "the-old-token"
    assert ask(send_start_server_message, token="the-old-token") == 202
    assert ask(send_stop_server_message, token="the-old-token") == 202
    assert platform.bus.sent[-1] == (Topic.STOP, {"projectId": "maze", "userId": "alice", "attempt": 1})
    assert reads == []


def test_a_start_that_an_earlier_version_began_runs_the_same_task(platform: FakePlatform) -> None:
    """RunTask may have been called already with this token in its client token; another token would start a second task."""
    as_earlier(platform, entry("maze", "of-old"))
    begun = server.new_attempt(study(), "alice", 1, nonce="n", settings=platform.settings, now=platform.now())
    platform.documents.put(server.key(LABEL), to_json(msgspec.structs.replace(begun, token="the-old-token")))
    Servers(platform).start(StartServer("maze", "alice"))
    (request,) = platform.tasks.running.values()
    assert (request.environment["TOKEN"], request.nonce) == ("the-old-token", "the-old-token")


def test_a_warm_server_that_an_earlier_version_started_is_assigned_with_its_token() -> None:
    platform = FakePlatform()
    settings, now = platform.settings, platform.now()
    warm_server = server.new_attempt(
        study(), ids.warm_id("maze", now, 0), 1, token="spares-of-old", settings=settings, now=now
    )
    mine = server.new_attempt(study(), "alice", 1, nonce="n", settings=settings, now=now)
    given = server.assigned(server.reserving(mine, warm_server), warm_server, now)
    assert SecretCache(platform.documents).token(given) == "spares-of-old"
    assert given.state is ServerState.READY


def test_an_assigned_warm_server_has_the_token_of_its_task() -> None:
    platform = FakePlatform()
    secrets = SecretCache(platform.documents)
    settings, now = platform.settings, platform.now()
    warm_server = server.new_attempt(study(), ids.warm_id("maze", now, 0), 1, nonce="s", settings=settings, now=now)
    told = secrets.get_or_create().token(warm_server)
    mine = server.new_attempt(study(), "alice", 1, nonce="n", settings=settings, now=now)
    given = server.assigned(server.reserving(mine, warm_server), warm_server, now)
    assert secrets.token(given) == told != secrets.token(mine)


def test_a_server_that_was_stopped_before_its_start_has_no_token(platform: FakePlatform) -> None:
    register()
    stone = server.stopped_before_start("maze", "alice", 1, platform.now())
    assert SecretCache(platform.documents).token(from_json(to_json(stone), Server)) == ""


def test_secrets_are_taken_out_of_an_earlier_versions_list_on_request(platform: FakePlatform) -> None:
    """`apply` asks for it. Nothing else in the list changes, not even entries that cannot be read."""
    links = {"signedLinks": True}
    as_earlier(
        platform, entry("maze", "1-of-old") | links, entry("other", "2-of-old"), UNREADABLE | {"secret": "3-of-old"}
    )
    before = document(platform, MASTER_LIST)["projects"]
    assert update_project_master_list.handler({"takeOver": True}, None) == {"takenOver": 3}
    assert b"of-old" not in platform.documents.kept[MASTER_LIST][0]
    after = document(platform, MASTER_LIST)["projects"]
    assert [secret(platform, name) for name in ("maze", "other")] == ["1-of-old", "2-of-old"]
    for one in (*before, *after):
        one.pop("secret", None)
    assert read_list(json.dumps({"projects": after}).encode()) == read_list(json.dumps({"projects": before}).encode())
    assert update_project_master_list.handler({"takeOver": True}, None) == {"takenOver": 0}
    register("broken")
    assert secret(platform, "broken") == "3-of-old"


def test_a_registration_during_the_removal_of_secrets_is_not_lost(platform: FakePlatform) -> None:
    as_earlier(platform, entry("maze", "of-old"))
    SecretCache(platform.documents).get_or_create()
    platform.documents.before_write = [lambda: None, lambda: register("other")]
    assert update_project_master_list.handler({"takeOver": True}, None) == {"takenOver": 0}
    assert [one["id"] for one in document(platform, MASTER_LIST)["projects"]] == ["maze", "other"]
    assert secret(platform) == "of-old"


def test_without_a_list_no_secret_is_taken_over(platform: FakePlatform) -> None:
    assert update_project_master_list.handler({"takeOver": True}, None) == {"takenOver": 0}
    assert KEY not in platform.documents.kept
    platform.documents.put(MASTER_LIST, b"{")
    assert list(update_project_master_list.handler({"takeOver": True}, None)) == ["problems"]


# Entries that cannot be read


UNREADABLE = {"id": "broken", "live": True, "steps": {"2": "consent.html"}}  # step 1 is missing
HIPPOS = UNREADABLE | {"steps": {"1": "consent.html"}}


def test_the_secret_of_an_unreadable_entry_is_taken_over_and_used_when_the_project_is_registered_again(
    platform: FakePlatform,
) -> None:
    as_earlier(platform, UNREADABLE | {"secret": "of-old", "odd": [1.50, "é"]})
    register("other")
    (unread,) = read_list(platform.documents.kept[MASTER_LIST][0]).unreadable
    assert json.loads(unread.raw) == UNREADABLE | {"odd": [1.50, "é"]}
    register("broken")
    assert secret(platform, "broken") == "of-old"


def test_an_entry_in_hippos_form_keeps_its_secret_and_its_salt(platform: FakePlatform) -> None:
    as_earlier(platform, HIPPOS | {"secret": "of-old"})
    register("other")
    assert secret(platform, "broken") == "of-old"
    register("broken")
    before, salt = secret(platform, "broken"), document(platform, MASTER_LIST)["projects"][0].get("salt", "")
    assert before == "of-old"
    as_earlier(platform, HIPPOS | {"salt": "ab12"})
    salted = secret(platform, "broken")
    register("broken")
    assert (secret(platform, "broken"), document(platform, MASTER_LIST)["projects"][0]["salt"]) == (salted, "ab12")
    assert salt != "ab12"


def test_an_unreadable_entry_keeps_its_salt_until_the_project_is_registered_again(platform: FakePlatform) -> None:
    register("broken")
    before, salt = secret(platform, "broken"), document(platform, MASTER_LIST)["projects"][0]["salt"]
    as_earlier(platform, UNREADABLE | {"salt": salt})
    register("other")
    register("broken")
    assert secret(platform, "broken") == before


def test_a_registration_cannot_set_a_salt_or_a_secret(platform: FakePlatform) -> None:
    for key, meant in (("salt", "did you mean seats?"), ("secret", "docs/config.md lists all keys")):
        answer = update_project_master_list.handler({"project": registration() | {key: "mine"}}, None)
        assert answer["problems"] == [f"{key}: unknown key; {meant}"]


def test_a_study_in_an_earlier_versions_list_does_not_read_the_secret() -> None:
    """During an upgrade a function may not be allowed to read the secret yet."""
    platform = installed()
    place.use(platform)
    reads = reads_of_secret(platform)
    assert Browser(platform, "projectId=maze&userId=alice").send()["statusCode"] == 200
    assert reads == []


class Before(msgspec.Struct, rename="camel"):
    """The fields that the version before needs of a server's record, to stop the server and to remove its resources."""

    project_id: str
    user_id: str
    attempt: int
    state: str
    token: str
    requested: str
    deadline: str
    cluster: str


def test_the_version_before_can_read_the_records_of_this_version(platform: FakePlatform) -> None:
    """A failed update is rolled back while servers run that it has started: the version before must be able to end them."""
    for record in (playing(platform), server.stopped_before_start("maze", "alice", 1, platform.now())):
        assert msgspec.json.decode(to_json(record), type=Before).token == ""


def test_every_function_reads_a_new_secret_within_an_hour(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An administrator has deleted a leaked secret. Otherwise some functions would use it as long as they run."""
    clock = 0.0
    monkeypatch.setattr("hippodrome.storage.secret.monotonic", lambda: clock)
    register()
    keys = SecretCache(platform.documents)
    before = keys.get_or_create()
    platform.documents.delete(KEY)
    register("other")
    clock = 3599.0
    assert keys.get_or_create() == before
    clock = 3601.0
    assert keys.get_or_create() != before
