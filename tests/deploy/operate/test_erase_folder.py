"""`deploy erase --from`: a participant of a study on this machine, alone and of those who played together."""

from __future__ import annotations

import contextlib
import fcntl
import gzip
import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from console.problem import Exit
from deploy.__main__ import main
from deploy.operate import folder_eraser
from deploy.operate.data_folder import DataFolder
from deploy.operate.folder_eraser import FolderEraser
from hippodrome.limits.rules import ParticipantSlots
from hippodrome.lobby import decisions
from hippodrome.lobby.decisions import Decisions, Unmatched
from hippodrome.model import ids, server
from hippodrome.model.records import from_json, to_json
from hippodrome.model.server import Server, ServerState
from protocol.handover import Handover
from protocol.keys import handover_key, session_key
from protocol.session import parse
from tests.deploy.installation import Ran
from tests.export.data_world import crowd, into_folder
from tests.export.session_world import ANN, BOB, SID, pair, recording_key, said, session, study

LABEL = ids.server_label("maze", ANN)


class Machine:
    """A study's folder with data of `make run`."""

    def __init__(self, tmp: Path, capsys: Any) -> None:
        self.data, self.tmp, self._capsys = tmp / "data", tmp, capsys
        self.put = into_folder(self.data)

    def erase(self, *more: str, user: str = ANN) -> Ran:
        self._capsys.readouterr()
        code = main(["erase", user, "--project", "maze", "--from", str(self.data), *more])
        printed = self._capsys.readouterr()
        return Ran(code, printed.out, printed.err)

    def contents(self) -> dict[str, bytes]:
        """Every file; recordings unpacked."""
        found = {}
        for path in self.data.rglob("*"):
            if path.is_file():
                body = path.read_bytes()
                found[path.relative_to(self.data).as_posix()] = gzip.decompress(body) if path.suffix == ".gz" else body
        return found

    def traces(self, user: str = ANN) -> list[str]:
        told = [user, said(user), ids.server_label("maze", user)]
        return [k for k, body in self.contents().items() if any(t in k or t.encode() in body for t in told)]


@pytest.fixture
def machine(tmp_path: Path, capsys: Any) -> Machine:
    return Machine(tmp_path, capsys)


def test_nothing_of_one_member_stays_and_the_others_is_as_it_was(machine: Machine) -> None:
    study(machine.put, machine.tmp)
    machine.put(f"_servers/{LABEL}.json", b"{}")
    machine.put(f"_lobby/maze/{LABEL}.way", b"{}")
    gone = Unmatched(LABEL, ANN, datetime.now(UTC))
    machine.put(decisions.key("maze"), to_json(Decisions(1, unmatched=(gone,))))
    machine.put("maze/places/0.json", to_json(ParticipantSlots((LABEL, "sother"), 3)))
    theirs = {key: body for key, body in machine.contents().items() if key.startswith(f"maze/users/{BOB}/")}
    ran = machine.erase("--yes")
    assert ran.code == Exit.DONE, ran.err
    assert machine.traces() == []
    after = machine.contents()
    assert theirs.items() <= after.items()
    assert said(BOB).encode() in after[recording_key()]
    assert [each.user_id for each in parse(after[session_key("maze", SID)]).members] == ["", BOB]
    assert from_json(after["maze/places/0.json"], ParticipantSlots) == ParticipantSlots(("sother",), 3)
    assert from_json(after[decisions.key("maze")], Decisions).unmatched == ()
    assert not (machine.data / "maze/users" / ANN).exists()
    again = machine.erase("--yes")
    assert (again.code, "nothing of this participant" in again.err) == (Exit.DONE, True)
    assert machine.contents() == after


def test_when_all_members_are_erased_the_session_is_gone(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    machine.put(".erase/.0123456789abcdef.new", b"of a run that was killed")
    machine.put(f"_servers/{ids.server_label('maze', SID)}.json", b"{}")
    assert machine.erase("--yes").code == machine.erase("--yes", user=BOB).code == Exit.DONE
    assert machine.contents() == {}


def test_a_study_without_sessions(machine: Machine) -> None:
    user, other = crowd(machine.put, machine.tmp, 2)
    kept = {key: body for key, body in machine.contents().items() if f"/{user}/" not in key}
    assert machine.erase("--yes", user=user).code == Exit.DONE
    assert machine.contents() == kept
    assert [key for key in kept if other in key]


def test_a_study_that_is_held_is_not_touched(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    lock = machine.tmp / ".hippodrome" / "data.lock"
    lock.parent.mkdir()
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        ran = machine.erase("--yes")
    assert ran.code == Exit.FAILED
    assert "End `make run` with Ctrl-C" in ran.err
    assert machine.contents() == before
    assert machine.erase("--yes").code == Exit.DONE


@pytest.mark.parametrize("left", ["a server that runs", "an unfinished recording"])
def test_what_a_killed_run_has_left_is_finished_first(machine: Machine, left: str) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    state = machine.tmp / ".hippodrome" / "data"
    put = into_folder(state)
    if left == "a server that runs":
        task = {"folder": f"maze/sessions/{SID}", "pid": os.getpid(), "stopped": None}
        put("tasks/s-1.json", json.dumps(task).encode())
    else:
        put(f"spool/{recording_key()}.part", b"")
    ran = machine.erase("--yes")
    assert (ran.code, "Start `make run` once more" in ran.err) == (Exit.FAILED, True)
    assert machine.contents() == before


def test_what_the_functions_still_know_is_told(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    into_folder(machine.tmp / ".hippodrome" / "data")("queue/1.json", json.dumps({"userId": ANN}).encode())
    assert ".hippodrome/data/queue/1.json still names them" in machine.erase("--yes").err


class Cut(BaseException):
    """The process ends here."""


@contextlib.contextmanager
def cut_off(at: int, after: bool) -> Iterator[None]:
    """End the process before or after the n-th change."""
    count = [0]
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((os, "replace"), (Path, "unlink")):
            whole = getattr(owner, name)

            def change(*args: Any, whole: Any = whole, **how: Any) -> Any:
                count[0] += 1
                if count[0] == at and not after:
                    raise Cut
                answer = whole(*args, **how)
                if count[0] == at:
                    raise Cut
                return answer

            patch.setattr(owner, name, change)
        yield


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_cut_off_at_any_change_it_goes_on_from_there(tmp_path: Path, capsys: Any, after: bool) -> None:
    for at in range(1, 60):
        machine = Machine(tmp_path / str(at), capsys)
        machine.tmp.mkdir()
        study(machine.put, machine.tmp)
        machine.put(f"_lobby/maze/{LABEL}.way", b"{}")
        try:
            with cut_off(at, after):
                FolderEraser(machine.data, "maze", ANN).run()
            break
        except Cut:
            FolderEraser(machine.data, "maze", ANN).run()
        assert machine.traces() == [], at
        assert said(BOB).encode() in machine.contents()[recording_key()]
        assert [path for path in machine.data.rglob("*") if ".erase" in path.name or path.suffix == ".new"] == []
    assert 8 < at < 59


@pytest.mark.parametrize("owner", [ANN, SID])
def test_the_record_that_leads_to_a_warm_server_goes_last(machine: Machine, owner: str) -> None:
    machine.put(session_key("maze", SID), session(ANN, "").to_json())
    now, label = datetime.now(UTC), ids.server_label("maze", "~warm")
    name = ids.server_name(label, 1)
    record = Server("maze", owner, 1, ServerState.CLOSED, "", now, now, "c", warm_server_name=name)
    machine.put(server.key(record.label), to_json(record))
    machine.put(server.key(label), to_json(msgspec.structs.replace(record, user_id="~warm", assigned_to=record.label)))
    machine.put(handover_key("maze", name), Handover(owner, None, name).to_json())
    for at in range(1, 8):
        with contextlib.suppress(Cut), cut_off(at, after=True):
            FolderEraser(machine.data, "maze", ANN).run()
    assert machine.contents() == {}


def test_a_dry_run_and_no_yes_change_nothing(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    dry = machine.erase("--dry-run", "--json")
    assert (dry.code, dry.json["found"]) == (Exit.CHANGES, 7)
    assert machine.erase().code == Exit.DECLINED
    assert machine.erase("--everywhere").code == Exit.FAILED
    assert machine.contents() == before
    assert main(["erase", ANN, "--project", "maze", "--from", str(machine.tmp / "none")]) == Exit.FAILED


def test_a_document_that_has_changed_is_not_replaced(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path)
    (tmp_path / "a.json").write_bytes(b"new")
    assert not folder.replace("a.json", b"old", b"mine")
    assert (tmp_path / "a.json").read_bytes() == b"new"


def test_make_run_keeps_its_lock_and_tasks_where_they_are_looked_for() -> None:
    from local.__main__ import ROOT

    assert folder_eraser.STATE == ROOT
