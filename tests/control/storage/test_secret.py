"""Tokens, tickets and signatures are derived from one secret, and documents that researchers read hold none of them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.project import MASTER_LIST, step_key
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import KEY, Secret, SecretCache
from hippodrome.functions import installed as place
from hippodrome.functions import update_project_master_list
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import PAGES, study
from testing.visitors import Browser
from tests.control.test_registry import registration

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


def write_list(platform: FakePlatform, *entries: Any) -> None:
    platform.documents.put(MASTER_LIST, json.dumps({"projects": list(entries)}).encode())


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


def test_each_project_server_and_attempt_has_its_own_secret() -> None:
    kept = Secret("0" * 64)
    projects = [study(salt=salt, id=name) for name in ("maze", "other") for salt in ("a", "b")]
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
    write_list(platform)
    register()
    assert secret(platform) != before


def test_another_salt_makes_another_secret(platform: FakePlatform) -> None:
    """In this way an administrator replaces a project's leaked secret."""
    register()
    register("other")
    before = [secret(platform, name) for name in ("maze", "other")]
    listed = document(platform, MASTER_LIST)
    for one in listed["projects"]:
        one["salt"] = "another"
    platform.documents.put(MASTER_LIST, json.dumps(listed).encode())
    after = [secret(platform, name) for name in ("maze", "other")]
    assert not {*before} & {*after}
    register("other")
    assert [secret(platform, name) for name in ("maze", "other")] == after


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


# The document of the secret


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
    with pytest.raises(ValueError):
        ProjectCache(platform, SecretCache(platform.documents)).project("maze")
    assert Browser(platform, "projectId=maze&userId=alice").send()["statusCode"] == 500


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


# Entries that cannot be read


UNREADABLE = {"id": "broken", "live": True, "steps": {"2": "consent.html"}}  # step 1 is missing


def test_an_unreadable_entry_keeps_its_salt_until_the_project_is_registered_again(platform: FakePlatform) -> None:
    register("broken")
    before, salt = secret(platform, "broken"), document(platform, MASTER_LIST)["projects"][0]["salt"]
    write_list(platform, UNREADABLE | {"salt": salt})
    register("other")
    register("broken")
    assert secret(platform, "broken") == before


def test_a_registration_cannot_set_a_salt_or_a_secret(platform: FakePlatform) -> None:
    for key, meant in (("salt", "did you mean seats?"), ("secret", "docs/config.md lists all keys")):
        answer = update_project_master_list.handler({"project": registration() | {key: "mine"}}, None)
        assert answer["problems"] == [f"{key}: unknown key; {meant}"]


def test_every_function_reads_a_new_secret_within_an_hour(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An administrator has deleted a leaked secret. Otherwise some functions would use it as long as they run."""
    clock = 0.0
    monkeypatch.setattr("hippodrome.control.storage.secret.monotonic", lambda: clock)
    register()
    keys = SecretCache(platform.documents)
    before = keys.get_or_create()
    platform.documents.delete(KEY)
    register("other")
    clock = 3599.0
    assert keys.get_or_create() == before
    clock = 3601.0
    assert keys.get_or_create() != before
