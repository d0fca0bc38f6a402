"""`hippodrome erase --from`: erasing a participant of a study on this machine, who played alone or with others."""

from __future__ import annotations

import contextlib
import fcntl
import gzip
import itertools
import json
import os
import subprocess
import sys
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.console.run_state import mark_of
from hippodrome.control.limits.rules import ParticipantSlots
from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.decisions import Decisions, Unmatched
from hippodrome.control.model import ids, server
from hippodrome.control.model.balance import Cells, Draw, cells_key
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server, ServerState
from hippodrome.deployment.operate import folder_erasure
from hippodrome.deployment.operate.data_folder import DataFolder
from hippodrome.deployment.operate.eraser import Eraser
from hippodrome.deployment.operate.folder_erasure import FolderErasure
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handover_key, session_key
from hippodrome.protocol.session import parse
from hippodrome.trial.recordings import recording
from tests.deployment.installation import CommandResult
from tests.export.data_world import crowd, into_folder
from tests.export.session_world import (
    ANN,
    BOB,
    SID,
    lines,
    packed,
    pair,
    recording_key,
    round_trip,
    said,
    session,
    study,
    tape,
    tape_key,
)

LABEL = ids.server_label("maze", ANN)
_numbers = itertools.count()


class Machine:
    """A study's folder with data of `hippodrome run`."""

    def __init__(self, tmp: Path, capsys: Any) -> None:
        self.data, self.tmp, self._capsys = tmp / "data", tmp, capsys
        self.put = into_folder(self.data)

    def erase(self, *more: str, user: str = ANN) -> CommandResult:
        return self.run("maze", "--from", str(self.data), *more, user=user)

    def run(self, *more: str, user: str = ANN) -> CommandResult:
        self._capsys.readouterr()
        receipt = (
            [] if {"--receipt", "--dry-run"} & {*more} else ["--receipt", str(self.tmp / f"receipt-{next(_numbers)}")]
        )
        code = main(["erase", user, *more, *receipt])
        printed = self._capsys.readouterr()
        return CommandResult(code, printed.out, printed.err)

    def contents(self) -> dict[str, bytes]:
        """Return the contents of every file, with recordings unpacked."""
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


def test_everything_of_one_member_is_erased_and_the_others_data_are_unchanged(machine: Machine) -> None:
    study(machine.put, machine.tmp)
    machine.put(f"_servers/{LABEL}.json", b"{}")
    machine.put(f"_lobby/maze/{LABEL}.way", b"{}")
    gone = Unmatched(LABEL, ANN, datetime.now(UTC))
    machine.put(decisions.key("maze"), to_json(Decisions(1, unmatched=(gone,))))
    machine.put("maze/slots/0.json", to_json(ParticipantSlots((LABEL, "sother"), 3)))
    theirs = {key: body for key, body in machine.contents().items() if key.startswith(f"maze/users/{BOB}/")}
    ran = machine.erase("--yes")
    assert ran.code == Exit.DONE, ran.err
    assert machine.traces() == []
    after = machine.contents()
    assert theirs.items() <= after.items()
    assert said(BOB).encode() in after[recording_key()]
    assert [each.user_id for each in parse(after[session_key("maze", SID)]).members] == ["", BOB]
    assert from_json(after["maze/slots/0.json"], ParticipantSlots) == ParticipantSlots(("sother",), 3)
    assert from_json(after[decisions.key("maze")], Decisions).unmatched == ()
    assert not (machine.data / "maze/users" / ANN).exists()
    again = machine.erase("--yes")
    assert (again.code, "nothing of this participant" in again.err) == (Exit.DONE, True)
    assert machine.contents() == after


def test_what_one_member_has_said_is_erased_also_in_the_requests_to_a_model(machine: Machine) -> None:
    study(machine.put, machine.tmp)
    machine.put(tape_key(), tape())
    assert machine.erase("--yes").code == Exit.DONE
    assert machine.traces() == []
    first, call, answer, other, held = json.loads(machine.contents()[tape_key()])["records"]
    assert (first["n"], first["by"], first["text"], held["text"]) == (1, "left", "", "")
    assert (call["hash"], call["tokens"], "request" in call) == ("abc", {"input": 9, "output": 2}, False)
    assert (answer["text"], other["text"], other["original"]) == ("Hello", said(BOB), "Rude")


@pytest.mark.parametrize("user", ["header", "rewards", "player", "answer", "records", "left", "player_0"])
def test_an_id_that_is_a_word_of_the_format_destroys_no_data_of_the_others(tmp_path: Path, user: str) -> None:
    put = into_folder(tmp_path / "data")
    pair(put, tmp_path, members=(user, BOB))
    made = [line.replace(b'"info":{"t":', b'"info":{"rewards":') for line in lines((user, BOB))]
    put(recording_key(), packed(tmp_path, made))
    put(tape_key(), tape((user, BOB)))
    before = recording.read((tmp_path / "data" / recording_key()).read_bytes())
    Eraser(DataFolder(tmp_path / "data"), "maze", user).erase()
    after = recording.read((tmp_path / "data" / recording_key()).read_bytes())
    assert after[0] == before[0]
    for wanted, found in zip(steps(before), steps(after), strict=True):
        assert found["players"]["right"] == wanted["players"]["right"]
        assert (found["reward"], found["info"], found["extra"]) == (wanted["reward"], wanted["info"], wanted["extra"])
        assert found["messages"] == [message for message in wanted["messages"] if message["player"] == "right"]
    told = json.loads((tmp_path / "data" / tape_key()).read_bytes())
    assert [(record["kind"], record.get("by")) for record in told["records"]] == [
        ("line", "left"), ("call", None), ("line", "ai"), ("line", "right"), ("line", "left"),
    ]  # fmt: skip
    assert told["records"][1]["answer"] == {"x": 1}
    assert [record["text"] for record in told["records"] if "text" in record] == ["", "Hello", said(BOB), ""]


def steps(made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line for line in made if line["kind"] == "step"]


def test_the_id_is_erased_from_what_another_member_has_said(machine: Machine) -> None:
    study(machine.put, machine.tmp)
    piece = json.loads(tape())
    piece["records"][3]["text"] = f"Are you {ANN}? {said(BOB)}"
    machine.put(tape_key(), json.dumps(piece).encode())
    assert machine.erase("--yes").code == Exit.DONE
    assert machine.traces() == []
    assert json.loads(machine.contents()[tape_key()])["records"][3]["text"] == f"Are you ? {said(BOB)}"


def test_after_all_members_are_erased_the_session_is_deleted(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    machine.put(".erase/.0123456789abcdef.new", b"of a run that was killed")
    machine.put(f"_servers/{ids.server_label('maze', SID)}.json", b"{}")
    assert machine.erase("--yes").code == machine.erase("--yes", user=BOB).code == Exit.DONE
    assert machine.contents() == {}


def test_a_participant_of_a_study_without_sessions_is_erased(machine: Machine) -> None:
    user, other = crowd(machine.put, machine.tmp, 2)
    kept = {key: body for key, body in machine.contents().items() if f"/{user}/" not in key}
    assert machine.erase("--yes", user=user).code == Exit.DONE
    assert machine.contents() == kept
    assert [key for key in kept if other in key]


def test_a_study_that_is_running_is_not_changed(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    lock = machine.tmp / ".hippodrome" / "data.lock"
    lock.parent.mkdir()
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        ran = machine.erase("--yes")
    assert ran.code == Exit.FAILED
    assert "End `hippodrome run` with Ctrl-C" in ran.err
    assert machine.contents() == before
    assert machine.erase("--yes").code == Exit.DONE


@pytest.mark.parametrize("folder", ["", f"maze/sessions/{SID}"], ids=["a warm server", "a server of their session"])
def test_while_a_server_of_a_killed_run_plays_on_nothing_is_erased(machine: Machine, folder: str) -> None:
    """A warm server that was just assigned has no note yet of whose it is."""
    pair(machine.put, machine.tmp)
    before = machine.contents()
    state = machine.tmp / ".hippodrome" / "data"
    into_folder(state)("tasks/s-1.json", json.dumps({"folder": folder, "pid": 1}).encode())
    sleep = [sys.executable, "-X", mark_of(state, "s-1"), "-c", "import time; time.sleep(600)"]
    with subprocess.Popen(sleep, start_new_session=True) as server:
        try:
            ran = machine.erase("--yes")
        finally:
            server.kill()
    assert (ran.code, "Start `hippodrome run` once more" in ran.err) == (Exit.FAILED, True)
    assert machine.contents() == before
    assert machine.erase("--yes").code == Exit.DONE


@pytest.mark.parametrize("name", ["3-episode-0001.jsonl.gz.part", "3-episode-0001.jsonl.gz"])
@pytest.mark.parametrize("state", [".hippodrome/data", ".hippodrome/earlier/data-20261121-144640/state"])
def test_recordings_of_their_session_that_were_never_moved_to_the_data_lose_them_too(
    machine: Machine, state: str, name: str
) -> None:
    """`run` was killed, perhaps `run --fresh` followed; or the study keeps no recordings (`s3upload: false`)."""
    folder = machine.tmp / state
    put = machine.put if state.endswith("data") else into_folder(folder.parent / "data")
    machine.put(f"maze/users/{ANN}/participant.json", b"{}")
    pair(put, machine.tmp)
    left = folder / "spool" / f"{recording_key().rpartition('/')[0]}/{name}"
    into_folder(folder)(f"spool/{recording_key().rpartition('/')[0]}/{name}", packed(machine.tmp, lines(), close=False))
    assert machine.erase("--yes").code == Exit.DONE
    assert machine.traces() == []
    told = zlib.decompressobj(31).decompress(left.read_bytes())
    assert (said(BOB).encode() in told, said(ANN).encode() in told) == (True, False)
    assert machine.erase("--yes", user=BOB).code == Exit.DONE
    assert not left.exists()


def test_documents_that_were_half_written_when_run_was_killed_are_deleted(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    half = f"Jane Doe, {ANN}".encode()
    into_folder(machine.tmp / ".hippodrome" / "data")("scratch/.0123456789abcdef.new", half)
    machine.put(".scratch/.0123456789abcdef.new", half)
    machine.put(f"{tape_key().rpartition('/')[0]}/.0123456789abcdef.new", half)
    machine.put(f"maze/users/{ANN}/answers/.0123456789abcdef.new", half)
    ran = machine.erase("--yes")
    assert (ran.code, "still names them" in ran.err) == (Exit.DONE, False)
    assert not list(machine.tmp.rglob("*.new"))


def test_the_logs_of_their_warm_servers_are_erased(machine: Machine) -> None:
    now = datetime.now(UTC)
    hers, others = (ids.server_name(ids.server_label("maze", f"~warm{n}"), 1) for n in range(2))
    record = Server("maze", ANN, 1, ServerState.CLOSED, now, now, "c", warm_server_name=hers)
    machine.put(f"maze/users/{ANN}/participant.json", b"{}")
    machine.put(server.key(record.label), to_json(record))
    put = into_folder(machine.tmp / ".hippodrome" / "data")
    for name in (hers, others):
        put(f"logs/{name}.log", b"Jane Doe says hello")
    assert machine.erase("--yes").code == Exit.DONE
    assert [path.name for path in (machine.tmp / ".hippodrome/data/logs").iterdir()] == [f"{others}.log"]


def test_documents_of_local_functions_that_name_the_participant_are_reported(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    into_folder(machine.tmp / ".hippodrome" / "data")("queue/1.json", json.dumps({"userId": ANN}).encode())
    assert ".hippodrome/data/queue/1.json still names them" in machine.erase("--yes").err


def test_the_state_of_the_participants_own_server_is_erased(machine: Machine) -> None:
    put = into_folder(machine.tmp / ".hippodrome" / "data")
    machine.put(f"maze/users/{ANN}/participant.json", b"{}")
    (machine.tmp / f".hippodrome/data/spool/maze/users/{ANN}/trials").mkdir(parents=True)
    other = ids.server_label("maze", BOB)
    for label, user in ((LABEL, ANN), (other, BOB)):
        put(f"tasks/{label}-1.json", json.dumps({"folder": f"maze/users/{user}"}).encode())
        put(f"logs/{label}-1.log", b"2026-11-28 INFO the agent is ready")
    ran = machine.erase("--yes")
    assert (ran.code, "still names them" in ran.err) == (Exit.DONE, False)
    state = machine.tmp / ".hippodrome" / "data"
    assert [path.name for path in sorted(state.rglob("*")) if path.is_file()] == [f"{other}-1.log", f"{other}-1.json"]
    assert not list(state.rglob(ANN))


def test_without_a_project_the_participant_is_erased_in_all_projects_of_the_folder(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands run in another study's folder, such as Hippodrome's."""
    pair(machine.put, machine.tmp)
    machine.put(f"trust/users/{ANN}/participant.json", b"{}")
    machine.put(f"trust/users/{BOB}/participant.json", b"{}")
    elsewhere = machine.tmp / "elsewhere"
    into_folder(elsewhere)("config.yml", b"project: {id: another-study}")
    monkeypatch.chdir(elsewhere)
    dry = machine.run("--from", str(machine.data), "--dry-run")
    assert (dry.code, "maze" in dry.out, "trust" in dry.out) == (Exit.CHANGES, True, True)
    assert machine.run("--from", str(machine.data), "--yes").code == Exit.DONE
    assert machine.traces() == []
    assert f"trust/users/{BOB}/participant.json" in machine.contents()


def test_an_erasure_in_one_project_says_where_else_the_participant_is(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    machine.put(f"trust/users/{ANN}/participant.json", b"{}")
    ran = machine.erase("--yes")
    assert (ran.code, f"trust/users/{ANN}/participant.json still names them" in ran.err) == (Exit.DONE, True)
    assert machine.traces() == [f"trust/users/{ANN}/participant.json"]


@pytest.mark.parametrize("data", ["data", "."])
def test_a_project_or_folder_that_is_not_there_is_no_erasure(machine: Machine, data: str) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    ran = machine.run("--from", str(machine.tmp / data), "--yes", *(["mase"] if data == "data" else []))
    told = "holds nothing of a project mase" if data == "data" else "is not a data folder: it holds no project"
    assert (ran.code, told in ran.err) == (Exit.FAILED, True)
    assert ("It holds: maze" in ran.err) == (data == "data")
    assert machine.contents() == before


def test_data_that_fresh_has_moved_aside_are_erased_too(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    place = machine.tmp / ".hippodrome" / "earlier" / "data-20261121-144640"
    into_folder(place / "data")(f"maze/users/{ANN}/answers/1.json", b"{}")
    into_folder(place / "state")(f"spool/maze/users/{ANN}/trials/s-1/3-trial.jsonl.part", b"")
    into_folder(place / "state")("queue/1.json", json.dumps({"userId": ANN}).encode())
    ran = machine.run("--from", str(machine.data), "--yes")
    assert (ran.code, machine.traces()) == (Exit.DONE, [])
    assert [path.name for path in place.rglob("*") if path.is_file()] == ["1.json"]
    assert "state/queue/1.json still names them" in ran.err


def test_a_table_in_the_data_folder_that_names_the_participant_is_reported(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    machine.put("tables/answers.csv", f"participant,2.age\n{ANN},33\n".encode())
    machine.put("tables/of-others.csv", f"participant,2.age\n{ANN}-2,33\n".encode())
    ran = machine.erase("--yes")
    assert "tables/answers.csv still names them" in ran.err
    assert "of-others" not in ran.err


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ("", "Everything is gone"),
        (", awsSetup: {cpu: 1, memory: 2}", "may be in two places: in data on this machine, and on AWS"),
    ],
    ids=["here", "here or on AWS"],
)
def test_without_from_the_data_are_those_of_this_machine_only_if_there_can_be_no_others(
    machine: Machine, keys: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.put(f"maze/users/{ANN}/participant.json", b"{}")
    into_folder(machine.tmp)("config.yml", f"project: {{id: maze{keys}}}".encode())
    monkeypatch.chdir(machine.tmp)
    ran = machine.run("--yes")
    assert told in ran.err
    assert (machine.traces() == [], ran.code == Exit.DONE) == (not keys, not keys)


def test_the_receipt_says_what_was_erased_and_names_no_participant(machine: Machine) -> None:
    study(machine.put, machine.tmp)
    machine.put(f"_servers/{LABEL}.json", b"{}")
    file = machine.tmp / "receipt.json"
    assert machine.erase("--yes", "--receipt", str(file)).code == Exit.DONE
    text = file.read_text()
    assert ANN not in text
    assert LABEL not in text
    receipt = json.loads(text)
    (project,) = receipt["projects"]
    assert (receipt["complete"], receipt["folder"], set(project["left"].values())) == (True, str(machine.data), {0})
    assert project["deleted"]["maze/users/{userId}/answers/1.json"] == project["deleted"]["_servers/{server}.json"] == 1
    assert f"maze/sessions/{SID}/session.json" in project["rewritten"]


class Interruption(BaseException):
    """The process ends here."""


@contextlib.contextmanager
def interrupt_at(at: int, after: bool) -> Iterator[None]:
    """End the process before or after the n-th change."""
    count = [0]
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((os, "replace"), (Path, "unlink")):
            whole = getattr(owner, name)

            def change(*args: Any, whole: Any = whole, **how: Any) -> Any:
                count[0] += 1
                if count[0] == at and not after:
                    raise Interruption
                answer = whole(*args, **how)
                if count[0] == at:
                    raise Interruption
                return answer

            patch.setattr(owner, name, change)
        yield


def crowded(folder: Path, capsys: Any) -> Machine:
    """Make a study in which every document that participants share names Ann."""
    machine = Machine(folder, capsys)
    machine.tmp.mkdir()
    study(machine.put, machine.tmp)
    machine.put(tape_key(), tape())
    machine.put(f"_lobby/maze/{LABEL}.way", b"{}")
    then = datetime(2026, 11, 21, tzinfo=UTC)
    machine.put(decisions.key("maze"), to_json(Decisions(1, unmatched=(Unmatched(LABEL, ANN, then),))))
    machine.put("maze/slots/0.json", to_json(ParticipantSlots((LABEL, "sother"), 3)))
    machine.put(cells_key("maze"), to_json(Cells(drawn={ANN: Draw("a", then), BOB: Draw("a", then)})))
    return machine


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_a_run_after_an_interruption_at_any_change_leaves_what_a_whole_run_leaves(
    tmp_path: Path, capsys: Any, after: bool
) -> None:
    whole = crowded(tmp_path / "whole", capsys)
    FolderErasure(whole.data, "maze", ANN).run()
    assert whole.traces() == []
    assert all(said(BOB).encode() in whole.contents()[key] for key in (recording_key(), tape_key()))
    for at in range(1, 60):
        machine = crowded(tmp_path / str(at), capsys)
        try:
            with interrupt_at(at, after):
                FolderErasure(machine.data, "maze", ANN).run()
            break
        except Interruption:
            FolderErasure(machine.data, "maze", ANN).run()
        assert machine.contents() == whole.contents(), at
    assert 12 < at < 59
    tables = tmp_path / "tables"
    assert main(["data", "maze", "--from", str(whole.data), "--to", str(tables)]) == Exit.DONE
    told = "".join(path.read_text() for path in tables.glob("*.csv"))
    assert BOB in told
    assert not [word for word in (ANN, said(ANN), LABEL, str(round_trip(ANN))) if word in told]


@pytest.mark.parametrize("owner", [ANN, SID])
def test_the_record_that_names_a_warm_server_is_erased_last(machine: Machine, owner: str) -> None:
    machine.put(session_key("maze", SID), session(ANN, "").to_json())
    now, label = datetime.now(UTC), ids.server_label("maze", "~warm")
    name = ids.server_name(label, 1)
    record = Server("maze", owner, 1, ServerState.CLOSED, now, now, "c", warm_server_name=name)
    machine.put(server.key(record.label), to_json(record))
    machine.put(server.key(label), to_json(msgspec.structs.replace(record, user_id="~warm", assigned_to=record.label)))
    machine.put(handover_key("maze", name), Handover(owner, None, name).to_json())
    for at in range(1, 8):
        with contextlib.suppress(Interruption), interrupt_at(at, after=True):
            FolderErasure(machine.data, "maze", ANN).run()
    assert machine.contents() == {}


def test_a_dry_run_and_a_missing_yes_change_nothing(machine: Machine) -> None:
    pair(machine.put, machine.tmp)
    before = machine.contents()
    dry = machine.erase("--dry-run", "--json")
    assert (dry.code, dry.json["found"]) == (Exit.CHANGES, {"maze": {"documents": 6, "sessions": 1}})
    assert machine.erase().code == Exit.DECLINED
    assert machine.erase("--everywhere").code == Exit.MISUSE
    assert machine.contents() == before
    assert main(["erase", ANN, "maze", "--from", str(machine.tmp / "none")]) == Exit.FAILED


def test_a_document_that_has_changed_is_not_replaced(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path)
    (tmp_path / "a.json").write_bytes(b"new")
    assert not folder.replace("a.json", b"old", b"mine")
    assert (tmp_path / "a.json").read_bytes() == b"new"


def test_erase_and_make_run_agree_on_the_folder_of_the_lock() -> None:
    from hippodrome.local.run import STATE as ROOT

    assert folder_erasure.STATE == ROOT
