"""The sweep in a bucket with documents of others: it reads only keys that registered projects may have."""

from __future__ import annotations

from collections import Counter

import pytest

from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ServerSlot, ServerSlots
from hippodrome.control.model import ids, server, warm_pool
from hippodrome.control.model.messages import KeepWarm, StartServer
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.warm_pool import Pool, WarmServer
from hippodrome.control.ports import Topic
from hippodrome.functions import sweep
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import study

MANY = 16_000
GARBAGE = [
    b"",
    b"{",
    b"[]",
    b"3",
    b"\xff",
    b'{"slots": 3}',
    b'{"warmServers": []}',
    b'{"slots": {"x": {}}}',
    b"[" * 100_000,
]
SLOTS = limits.server_slots_key("maze")
STUDY = study(max_servers=3, warm_servers=1, version="1")


@pytest.fixture
def project() -> Project:
    return STUDY


def calls(platform: FakePlatform) -> Counter[str]:
    """Return the calls to the documents that a sweep makes."""
    platform.documents.calls.clear()
    assert sweep.handler({}, None)["failed"] == 0
    return Counter(platform.documents.calls)


FOLDERS = ["_slots/", "_slots/users/{0}/answers/", "_warm/", "_warm/users/{0}/answers/", "_servers/users/{0}/answers/",
           "_servers/", "maze/handovers/", "maze/handovers/users/{0}/answers/", "maze/handovers/{0}/"]  # fmt: skip


@pytest.mark.parametrize("folder", FOLDERS)
def test_keys_of_no_registered_project_are_never_read(platform: FakePlatform, folder: str) -> None:
    before = calls(platform)
    for number in range(MANY // 2):
        platform.documents.put(f"{folder.format(number)}{number:x}.json", b"{}")
        name = ids.server_name(ids.server_label("maze", f"u{number % 50}"), 1)  # servers that never existed
        platform.documents.put(f"{folder.format(number)}x{name}.json", b"{}")
    assert calls(platform) == before


def test_a_document_in_a_deeper_folder_is_no_handover(platform: FakePlatform) -> None:
    for number in range(200):
        name = ids.server_name(ids.server_label("maze", f"u{number}"), 1)
        platform.documents.put(f"maze/handovers/users/x/answers/{name}.json", b"{}")
    before = dict(platform.documents.kept)
    assert sweep.handler({}, None)["handovers"] == 0
    assert platform.documents.kept == before
    assert "delete" not in platform.documents.calls


@pytest.mark.parametrize("body", GARBAGE)
def test_unreadable_slots_of_a_project_do_not_keep_the_sweep_from_others(platform: FakePlatform, body: bytes) -> None:
    other = study(id="other", max_servers=1)
    platform.documents.put(MASTER_LIST, to_json(MasterList([STUDY, other])))
    gone = ids.server_label("other", "alice")
    platform.documents.put(limits.server_slots_key("maze"), body)
    platform.documents.put(limits.server_slots_key("other"), to_json(ServerSlots({gone: ServerSlot(1, 60)})))
    assert sweep.handler({}, None)["slots"] == 1
    assert from_json(platform.documents.kept[limits.server_slots_key("other")][0], ServerSlots).slots == {}


@pytest.mark.parametrize("body", GARBAGE)
def test_an_unreadable_pool_does_not_keep_the_sweep_from_others(platform: FakePlatform, body: bytes) -> None:
    other = study(id="other", warm_servers=1, version="1")
    platform.documents.put(MASTER_LIST, to_json(MasterList([STUDY, other])))
    platform.documents.put(warm_pool.pool_key("maze"), body)
    sweep.handler({}, None)
    assert (Topic.START, {"keepWarm": "other"}) in platform.bus.sent


def test_a_pool_with_invalid_ids_starts_no_server(platform: FakePlatform) -> None:
    asked = platform.now()
    platform.wait(minutes=30)
    pool = Pool({"alice": WarmServer("1", asked), "../x": WarmServer("1", asked), "": WarmServer("1", asked)})
    platform.documents.put(warm_pool.pool_key("maze"), to_json(pool))
    sweep.handler({}, None)
    assert [message for _, message in platform.bus.sent] == [{"keepWarm": "maze"}]


@pytest.mark.parametrize("body", GARBAGE)
def test_an_unreadable_record_does_not_keep_the_sweep_from_others(platform: FakePlatform, body: bytes) -> None:
    servers = Servers(platform)
    for user in ("alice", "bob"):
        servers.start(StartServer("maze", user))
    platform.documents.put(server.key(ids.server_label("maze", "alice")), body)
    platform.wait(days=1)
    assert sweep.handler({}, None)["overdue"] == 1


def test_thousands_of_forgotten_slots_are_given_back_with_one_write(platform: FakePlatform) -> None:
    held = {ids.server_label("maze", str(number)): ServerSlot(1, 60) for number in range(2_000)}
    platform.documents.keep(
        limits.server_slots_key("maze"), to_json(ServerSlots({**held, "no label": ServerSlot(1, 60)}, 5))
    )
    assert sweep.handler({}, None)["slots"] == 2_000
    left = from_json(platform.documents.kept[limits.server_slots_key("maze")][0], ServerSlots)
    assert (set(left.slots), left.used) == ({"no label"}, 5 + 2_000 * 60)
    assert platform.documents.calls.count("put") == 1


@pytest.mark.parametrize("body", GARBAGE)
def test_an_unreadable_pool_does_not_keep_participants_from_a_server(platform: FakePlatform, body: bytes) -> None:
    """The pool lists only warm servers that may be assigned: it is made anew, and the sweep fills it."""
    platform.documents.put(warm_pool.pool_key("maze"), body)
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    assert ids.server_label("maze", "alice") in from_json(platform.documents.kept[SLOTS][0], ServerSlots).slots
    servers.start(KeepWarm("maze"))
    assert len(from_json(platform.documents.kept[warm_pool.pool_key("maze")][0], Pool).warm_servers) == 1


def test_the_sweep_has_an_unreadable_pool_filled_anew(platform: FakePlatform) -> None:
    platform.documents.put(warm_pool.pool_key("maze"), b"{")
    sweep.handler({}, None)
    assert platform.bus.sent == [(Topic.START, {"keepWarm": "maze"})]


@pytest.mark.parametrize("body", [body for body in GARBAGE if body != b'{"warmServers": []}'])
def test_with_unreadable_slots_no_server_starts_and_the_document_stays(platform: FakePlatform, body: bytes) -> None:
    """The number of running servers is not known, so no other may start: `maxServers` could be exceeded."""
    platform.documents.put(SLOTS, body)
    with pytest.raises(ValueError):
        Servers(platform).start(StartServer("maze", "alice"))
    assert list(platform.tasks.list()) == []
    assert platform.documents.kept[SLOTS][0] == body
