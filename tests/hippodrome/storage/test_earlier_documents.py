"""Documents and messages that an earlier version wrote (`tests/earlier/documents`) are read, and written back unchanged.

They were made by the version before the records' fields were renamed: a running installation holds documents like these.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hippodrome.limits.rules import ParticipantSlots, ServerSlots
from hippodrome.model import messages
from hippodrome.model.messages import to_message
from hippodrome.model.participant import Participant
from hippodrome.model.project import MasterList
from hippodrome.model.records import from_json, to_json
from hippodrome.model.server import Server, ServerState
from hippodrome.model.warm_pool import Pool
from protocol import handover

FOLDER = Path(__file__).resolve().parents[2] / "earlier" / "documents"
RECORDS: dict[str, type[Any]] = {
    "project_master_list": MasterList,
    "participant": Participant,
    "server_spare_ready": Server,
    "server_spare_leaving": Server,
    "server_spare_taken": Server,
    "server_with_spare": Server,
    "server_second_attempt": Server,
    "spares": Pool,
    "places_servers": ServerSlots,
    "places_people": ParticipantSlots,
}
MESSAGES: dict[str, Callable[[Any], Any]] = {
    "message_start": messages.parse_start_server,
    "message_keep_warm": messages.parse_start_server,
    "message_stop": messages.parse_stop_server,
    "message_names_changed": messages.parse_dns_changed,
    "message_task_seen": messages.parse_task_changed,
}


def document(name: str) -> bytes:
    return (FOLDER / f"{name}.json").read_bytes()


def test_every_document_of_the_folder_is_tried() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == {*RECORDS, *MESSAGES, "handover", "answer"}


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_read_and_written_back_unchanged(name: str) -> None:
    body = document(name)
    assert json.loads(to_json(from_json(body, RECORDS[name]))) == json.loads(body)


def test_a_handover_is_read_and_written_back_unchanged() -> None:
    body = document("handover")
    assert json.loads(handover.parse(body).to_json()) == json.loads(body)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_parsed(name: str) -> None:
    said = json.loads(document(name))
    found = MESSAGES[name](said)
    assert found is not None
    if name != "message_task_seen":  # it becomes the event that it replaces
        assert json.loads(json.dumps(to_message(found))) == said


def test_records_of_an_earlier_version_are_read_with_their_meaning() -> None:
    draining, taken = (from_json(document(f"server_spare_{name}"), Server) for name in ("leaving", "taken"))
    assigned, second = (from_json(document(f"server_{name}"), Server) for name in ("with_spare", "second_attempt"))
    assert draining.state is ServerState.DRAINING
    assert (assigned.warm_server_name, taken.assigned_to) == (taken.name, assigned.label)
    assert assigned.name == taken.name
    assert [run.warm_server_name for run in second.earlier] == [taken.name]
    pool, running = from_json(document("spares"), Pool), from_json(document("places_servers"), ServerSlots)
    assert [one.ready for one in pool.warm_servers.values()] == [True, False]
    assert [held.is_warm_server for held in running.slots.values()] == [True, False]
