"""The terminal of `make run` reports the answers that servers write."""

import io
import json
from pathlib import Path
from typing import NamedTuple, cast

import pytest
from rich.console import Console

from hippodrome.local.activity.log import ActivityLog
from hippodrome.local.activity.server_logs import WatchedServer
from hippodrome.local.backend.task_process import folder_of
from hippodrome.local.backend.tasks import ProcessTasks
from hippodrome.protocol.keys import answer_key, session_key
from hippodrome.protocol.session import Member, SessionDocument

SID = "s.0123456789abcdef0123"


def answer(data: Path, user_id: str, step: str) -> None:
    path = data / answer_key("study", user_id, step)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"step": step, "page": "game"}))


def watched(data: Path, owner: str) -> WatchedServer:
    return WatchedServer(folder_of("study", owner), data, data / "log", whole_log=True)


def test_answers_of_a_participants_server_are_printed_once(tmp_path: Path) -> None:
    answer(tmp_path, "P1", "1")
    server = watched(tmp_path, "P1")
    assert server.answers() == []
    answer(tmp_path, "P1", "3")
    assert [key for key, _ in server.answers()] == ["study/users/P1/answers/3.json"]
    assert server.answers() == []


def test_answers_of_a_sessions_server_are_printed_for_its_members(tmp_path: Path) -> None:
    answer(tmp_path, "anna", "1")
    server = watched(tmp_path, SID)
    assert server.answers() == []
    document = tmp_path / session_key("study", SID)
    document.parent.mkdir(parents=True)
    document.write_bytes(b"half a document")
    assert server.answers() == [], "it is not formed yet"
    document.write_bytes(
        SessionDocument(SID, 3, (Member("anna", None, 0), Member("bert", None, 1), Member("", 0, 2))).to_json()
    )
    assert server.answers() == [], "what was answered before"
    for each in ("bert", "anna"):
        answer(tmp_path, each, "3")
    assert [key for key, _ in server.answers()] == [answer_key("study", each, "3") for each in ("anna", "bert")]
    assert server.answers() == []


@pytest.mark.parametrize("owner", ["P1", SID])
def test_the_terminal_names_who_has_played(tmp_path: Path, owner: str) -> None:
    text = io.StringIO()
    log = ActivityLog(Console(file=text, width=200))
    document = tmp_path / session_key("study", SID)
    document.parent.mkdir(parents=True)
    document.write_bytes(SessionDocument(SID, 2, (Member("P1", None, 0), Member("P2", None, 1))).to_json())
    server = watched(tmp_path, owner)
    log._tell(server)
    answer(tmp_path, "P1", "3")
    log._tell(server)
    assert "P1" in text.getvalue()
    assert "played step 3" in text.getvalue()


class Task(NamedTuple):
    name: str
    folder: str


class Running:
    """Stands for the processes' tasks."""

    def __init__(self, *tasks: Task) -> None:
        self.tasks = tasks

    def playing(self) -> tuple[Task, ...]:
        return self.tasks

    def log(self, name: str) -> Path:
        return Path("/nowhere") / name


def test_a_game_on_a_warm_server_that_ended_before_the_next_look_is_printed(tmp_path: Path) -> None:
    text = io.StringIO()
    log = ActivityLog(Console(file=text, width=200))
    warm, given = Task("warm-1", ""), Task("warm-1", folder_of("study", "P1"))
    answer(tmp_path, "P1", "1")
    record = {
        "projectId": "study",
        "userId": "P1",
        "attempt": 1,
        "state": "starting",
        "nonce": "n",
        "warmServerName": "warm-1",
    }
    log._look(cast(ProcessTasks, Running(warm)), tmp_path)
    log.wrote("_servers/s.json", json.dumps(record).encode())
    log._look(cast(ProcessTasks, Running(warm)), tmp_path)  # its document does not exist yet
    answer(tmp_path, "P1", "3")
    log._look(cast(ProcessTasks, Running(given)), tmp_path)
    log.close()
    assert text.getvalue().count("played step 3") == 1
    assert "step 1" not in text.getvalue()


def test_the_terminal_names_sessions_and_unmatched_participants(tmp_path: Path) -> None:
    text = io.StringIO()
    log = ActivityLog(Console(file=text, width=200))
    both = SessionDocument(SID, 2, (Member("bert", None, 1), Member("anna", None, 0)))
    for _ in range(2):
        log.wrote(session_key("study", SID), both.to_json())
    other = SID.replace("0", "f")
    log.wrote(session_key("study", other), SessionDocument(other, 3, (Member("cleo", None, 0),)).to_json())
    log.wrote("study/users/anna/session.json", json.dumps({"session": SID, "unmatched": False}).encode())
    log.wrote("study/users/dora/session.json", json.dumps({"session": None, "unmatched": True}).encode())
    said = [line[10:].split("  ", 1) for line in text.getvalue().splitlines()]
    assert [(who.strip(), what.strip()) for who, what in said] == [
        ("s.0123…", "anna, bert play together"),
        ("s.f123…", "cleo plays; a policy plays in 2 places"),
        ("dora", "found no others to play with"),
    ]
