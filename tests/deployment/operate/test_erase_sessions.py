"""`hippodrome erase` of a participant who played with others: their data are deleted, and the others' stay whole."""

from __future__ import annotations

import gzip
import json
import sys
import zlib
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.lobby import decisions, entries
from hippodrome.control.lobby.decisions import Decisions, Formed, Matched, OpenSession, Proposal, Unmatched
from hippodrome.control.lobby.lobby import Lobby
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer, parse_task_changed
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import ServerState
from hippodrome.control.servers.signing import STORE_AFTER_CLOSE, VALID_SECONDS
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.aws.account import find_installation
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import stages
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.operate.aws_erasure import SIGNING, AwsErasure
from hippodrome.deployment.operate.eraser import Eraser
from hippodrome.protocol.keys import groups_key, session_key, sessions_folder, waiting_key
from hippodrome.protocol.session import parse
from hippodrome.trial.recordings import recording
from testing.exploration import sample
from testing.servers import Servers
from testing.studies import study
from tests.deployment.installation import CommandResult, Installed, account_here
from tests.deployment.operate.test_erase import Interruption, interrupt_at
from tests.export.session_world import (
    ANN,
    BOB,
    OTHER,
    SID,
    lines,
    packed,
    pair,
    recording_key,
    round_trip,
    said,
    session,
)
from tests.test_docs import code

STUDY = msgspec.structs.replace(study(), task_definition="hippodrome", players=2)
LABEL = ids.server_label("maze", ANN)


@pytest.fixture
def world(installed: Installed, tmp_path: Path, monkeypatch: Any, access_keys: None) -> Installed:
    installed.register(STUDY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stages, "PAUSE", 0)
    monkeypatch.setattr(
        "hippodrome.deployment.operate.aws_erasure.SIGNING", -VALID_SECONDS - STORE_AFTER_CLOSE.total_seconds()
    )
    return installed


def erase(world: Installed, capsys: Any, user: str = ANN, *more: str) -> CommandResult:
    return world.run(capsys, "erase", user, "maze", "--yes", *more)


def contents(world: Installed) -> dict[tuple[str, str], bytes]:
    """Return the contents of every version of every document, by key and version id, with recordings unpacked."""
    s3, bucket = world.client("s3"), world.env["BUCKET"]
    found = {}
    for page in s3.get_paginator("list_object_versions").paginate(Bucket=bucket):
        for line in page.get("Versions", ()):
            body = s3.get_object(Bucket=bucket, Key=line["Key"], VersionId=line["VersionId"])["Body"].read()
            unpack = zlib.decompressobj(31)  # also of a recording that was cut off
            found[line["Key"], line["VersionId"]] = unpack.decompress(body) if line["Key"].endswith(".gz") else body
        for line in page.get("DeleteMarkers", ()):
            found[line["Key"], line["VersionId"]] = b""
    return found


def traces(world: Installed, user: str = ANN) -> list[str]:
    """Return the keys of documents of which a version names this participant."""
    told = [user, said(user), ids.server_label("maze", user), f":{round_trip(user)}"]
    return [
        key for (key, _), body in contents(world).items() if any(each in key or each.encode() in body for each in told)
    ]


def of(world: Installed, user: str) -> dict[tuple[str, str], bytes]:
    return {each: body for each, body in contents(world).items() if each[0].startswith(f"maze/users/{user}/")}


def start(world: Installed, session_id: str = SID) -> str:
    """Start the session's server. Returns its task."""
    servers, before = Servers(world.platform), set(world.task_arns())
    servers.start(StartServer("maze", session_id))
    (task,) = set(world.task_arns()) - before
    event = parse_task_changed(world.task_event(task, "RUNNING"))
    assert event is not None
    assert servers.tasks_changed([event]) == []
    return task


def erasure(world: Installed, user: str = ANN, **how: Any) -> AwsErasure:
    account = account_here()
    return AwsErasure(account, find_installation(account), "maze", user, **how)


def run(world: Installed, user: str = ANN, **how: Any) -> bool:
    """Erase the participant. Returns whether anything is left."""
    return any(erasure(world, user, **how).run().values())


def test_everything_of_one_member_is_erased_and_the_others_data_are_unchanged(
    world: Installed, tmp_path: Path, capsys: Any
) -> None:
    pair(world.put, tmp_path)
    pair(world.put, tmp_path, members=("dora-0001", "emil-0001"), session_id=OTHER)
    world.put(session_key("maze", SID), session(ANN, BOB).to_json())  # an older version exists in the bucket
    world.put(recording_key(attempt=2), packed(tmp_path, lines()[:9], close=False)[:-3])
    world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key=recording_key(name="3-episode-0002"))
    world.client("s3").create_multipart_upload(Bucket=world.env["BUCKET"], Key=recording_key(name="3-episode-0009"))
    before, theirs = recording.read(world.get(recording_key())), of(world, BOB)
    another = {each: body for each, body in contents(world).items() if each[0].startswith(f"maze/sessions/{OTHER}/")}

    ran = erase(world, capsys, ANN, "--receipt", "receipt.json", "--json")

    assert ran.code == Exit.DONE, ran.err
    assert traces(world) == []
    assert of(world, BOB) == theirs
    assert another.items() <= contents(world).items()
    left = parse(world.get(session_key("maze", SID)))
    assert [(each.user_id, each.seat) for each in left.members] == [("", 0), (BOB, 1)]
    after = recording.read(world.get(recording_key()))
    assert [line["action"] for line in before if line["kind"] == "step"] == [
        line["action"] for line in after if line["kind"] == "step"
    ]
    assert said(BOB) in json.dumps(after)
    assert not world.client("s3").list_multipart_uploads(Bucket=world.env["BUCKET"]).get("Uploads")
    receipt = json.loads(Path("receipt.json").read_text())
    for hidden in (ANN, LABEL):
        assert hidden not in json.dumps(receipt) + ran.err
    (project,) = receipt["projects"]
    assert (receipt["complete"], set(project["left"].values())) == (True, {0})
    assert len(project["rewritten"]) == 3  # two recordings, and the session's document
    versions = {key: number for key, number in project["deleted"].items() if key.startswith("maze/sessions/")}
    assert versions[session_key("maze", SID)] == 2
    assert sum(versions.values()) == 5  # and a version of each recording, and an upload


def test_data_can_be_exported_after_an_erasure(world: Installed, tmp_path: Path, capsys: Any) -> None:
    from tests.export.place import rows

    pair(world.put, tmp_path, observe=True)
    out = tmp_path / "out"
    made = ["data", "maze", "--to", str(out), "--aws", "--format", "csv,parquet,minari"]
    assert world.run(capsys, *made).code == Exit.DONE
    assert erase(world, capsys).code == Exit.DONE
    for folder in (out, tmp_path / "anew"):
        ran = world.run(capsys, "data", "maze", "--to", str(folder), *made[4:])
        assert ran.code == Exit.DONE, ran.err
        assert [row["participant"] for row in rows(folder / "answers.csv")] == [BOB]
        assert [(row["participant"], row["score"]) for row in rows(folder / "episodes.csv")] == [
            ("", "6.0"),
            (BOB, "3.0"),
        ]
        assert rows(folder / "problems.csv") == []
        assert [path.name for path in (folder / "minari").iterdir()] == ["maze-3-right-v0"]
        for path in folder.rglob("*"):
            assert not path.is_file() or ANN.encode() not in path.read_bytes(), path


def test_a_second_run_finds_nothing_and_changes_nothing(world: Installed, tmp_path: Path, capsys: Any) -> None:
    pair(world.put, tmp_path)
    assert erase(world, capsys).code == Exit.DONE
    before = contents(world)
    again = erase(world, capsys, ANN)
    assert again.code == Exit.DONE
    assert "nothing of this participant" in again.err
    assert contents(world) == before


@pytest.mark.explores
def test_a_run_after_an_interruption_at_any_call_finishes(world: Installed, tmp_path: Path) -> None:
    """Each call that changes something is the last one of a run; the next run finishes the work (a sample of the calls)."""

    def check(at: int) -> int:
        user, other = f"annabel-{at:04}", f"bobby-{at:04}"
        sid = f"s.{at:020x}"
        pair(world.put, tmp_path, members=(user, other), session_id=sid)
        label = ids.server_label("maze", user)
        world.put(f"_lobby/maze/{label}.way", b"{}")
        world.put(decisions.key("maze"), to_json(Decisions(at, open=(OpenSession("s.0", datetime.now(UTC), label),))))
        theirs = of(world, other)
        with pytest.MonkeyPatch.context() as patch:
            count = interrupt_at(patch, at)
            with pytest.raises(Interruption) if at else nullcontext():
                assert not run(world, user)
        if at:
            assert not run(world, user)
        left = [
            key for (key, _), body in contents(world).items() if user in key or user.encode() in body or label in key
        ]
        assert left == [], at
        assert of(world, other) == theirs
        body = world.get(recording_key(sid))
        words = gzip.decompress(body)
        assert (said(user).encode() in words, said(other).encode() in words) == (False, True)
        assert {m["player"] for line in recording.read(body) for m in line.get("messages", ())} == {"right"}
        bucket = VersionedBucket(account_here(), world.env["BUCKET"])
        bucket.delete(bucket.versions("maze/"))
        return count[0]

    calls = check(0)
    assert calls >= 8
    for at in sample(range(1, calls + 1), 6):
        check(at)


def test_erase_first_stops_a_session_that_plays(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """As for a participant who played alone, the trial stores its data before erase deletes anything."""
    pair(world.put, tmp_path)
    start(world)
    order: list[str] = []
    rewrite = Eraser.leave

    def leave(self: Eraser, found: Any) -> None:
        order.append("while it ran" if list(world.platform.tasks.list()) else "rewritten")
        rewrite(self, found)

    monkeypatch.setattr(Eraser, "leave", leave)
    ran = erase(world, capsys)
    assert ran.code == Exit.DONE, ran.err
    assert "1 session will be stopped, for all who play there" in ran.err
    assert order == ["rewritten"]
    assert traces(world) == []
    record = from_json(world.get(server.key(ids.server_label("maze", SID))), server.Server)
    assert (record.state, record.user_id) == (ServerState.CLOSED, SID), "what the others' page needs to go on"
    assert not [*world.platform.tasks.list()]
    assert not world.timers()
    assert not world.records()


def test_erase_waits_until_the_sessions_server_can_store_nothing_more(
    world: Installed, tmp_path: Path, monkeypatch: Any
) -> None:
    """The server's record stays for the other members, so requests can be signed for it for a while after its end."""
    monkeypatch.setattr("hippodrome.deployment.operate.aws_erasure.SIGNING", SIGNING)
    pair(world.put, tmp_path)
    world.record(SID, ServerState.CLOSED, project=STUDY, closed=world.platform.now())
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        world.put(recording_key(name="3-episode-0002"), packed(tmp_path, lines()))

    assert not run(world, executor=Executor(sleep))
    (seconds,) = slept
    assert seconds == pytest.approx(STORE_AFTER_CLOSE.total_seconds() + VALID_SECONDS + SIGNING, abs=20)
    assert traces(world) == []


def test_erase_does_not_wait_for_a_session_that_ended_long_ago(
    world: Installed, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr("hippodrome.deployment.operate.aws_erasure.SIGNING", SIGNING)
    pair(world.put, tmp_path)
    world.record(SID, ServerState.CLOSED, project=STUDY, closed=world.platform.now() - timedelta(minutes=10))
    slept: list[float] = []
    assert not run(world, executor=Executor(slept.append))
    assert slept == []


def test_erase_stops_a_session_again_that_plays_again(world: Installed, tmp_path: Path, monkeypatch: Any) -> None:
    pair(world.put, tmp_path)
    times, rewrite = iter(range(1)), Eraser._rewrite_played

    def rewrite_while_it_starts(self: Eraser, key: str, seat: int) -> None:
        rewrite(self, key, seat)
        if next(times, None) is not None:
            start(world)
            world.put(recording_key(attempt=1, name="3-episode-0002"), packed(tmp_path, lines()))

    monkeypatch.setattr(Eraser, "_rewrite_played", rewrite_while_it_starts)
    assert not run(world)
    assert traces(world) == []


def test_after_all_members_are_erased_the_session_is_deleted(world: Installed, tmp_path: Path, capsys: Any) -> None:
    pair(world.put, tmp_path)
    world.record(SID, ServerState.CLOSED, project=STUDY, closed=world.platform.now() - timedelta(hours=1))
    assert erase(world, capsys, ANN).code == Exit.DONE
    assert [key for key, _ in contents(world) if SID in key or ids.server_label("maze", SID) in key]
    assert erase(world, capsys, BOB).code == Exit.DONE
    kept = {key for key, _ in contents(world)}
    assert not [key for key in kept if SID in key or ids.server_label("maze", SID) in key or "/users/" in key]
    assert not [key for key in kept if key.startswith(sessions_folder("maze"))]


def test_a_participant_in_the_lobby_is_erased_from_it(world: Installed, capsys: Any) -> None:
    now = datetime.now(UTC)
    other = ids.server_label("maze", BOB)
    world.participant(ANN, answered=1)
    for name in (f"{LABEL}.1790000000000.-", f"{LABEL}.yes.{SID}", f"{LABEL}.left.1790000000000", f"{LABEL}.way"):
        for _ in range(2):
            world.put(f"_lobby/maze/{name}", to_json(entries.WaitingDocument(ANN)))
    world.put(f"_lobby/maze/{other}.1790000000000.-", to_json(entries.WaitingDocument(BOB)))
    decided = Decisions(
        3,
        open=(OpenSession("s.1", now, LABEL),),
        proposed=(Proposal("s.2", (LABEL, other), now),),
        formed=(Formed("s.3", (Matched(LABEL, ANN), Matched("slabel-of-another", "dora-0001")), now),),
        unmatched=(Unmatched(LABEL, ANN, now),),
    )
    for version in (2, 3):
        world.put(decisions.key("maze"), to_json(msgspec.structs.replace(decided, version=version)))
    assert erase(world, capsys).code == Exit.DONE
    assert traces(world) == []
    left = from_json(world.get(decisions.key("maze")), Decisions)
    assert (left.version, [each.id for each in left.open], left.proposed, left.unmatched) == (4, ["s.1"], (), ())
    assert [member.user_id for member in left.formed[0].members] == ["", "dora-0001"]
    assert world.keys("_lobby/") == [f"_lobby/maze/{other}.1790000000000.-"]


def test_questions_and_answers_of_match_are_erased(world: Installed, capsys: Any) -> None:
    other = ids.server_label("maze", BOB)
    theirs, others = ({"waiting": [{"id": each}], "groups": [[each]]} for each in (LABEL, other))
    world.participant(ANN, answered=1)
    for said_of in (others, theirs, others):
        world.put(waiting_key("maze"), json.dumps(said_of).encode())
    world.put(groups_key("maze", "0" * 20), json.dumps(theirs).encode())
    world.put(groups_key("maze", "1" * 20), json.dumps(others).encode())
    assert erase(world, capsys, ANN, "--receipt", "receipt.json").code == Exit.DONE
    assert traces(world) == []
    assert [key for key, _ in contents(world) if key == waiting_key("maze")] == [waiting_key("maze")] * 2
    assert world.keys("maze/lobby/groups/") == [groups_key("maze", "1" * 20)]
    (project,) = json.loads(Path("receipt.json").read_text())["projects"]
    assert set(project["deleted"]) == {
        waiting_key("maze"),
        groups_key("maze", "0" * 20),
        "maze/users/{userId}/participant.json",
        "maze/users/{userId}/answers/1.json",
    }


@pytest.mark.parametrize("written", [True, False], ids=["carried out", "not carried out"])
def test_the_lobby_does_not_write_an_erased_participant_again(world: Installed, tmp_path: Path, written: bool) -> None:
    """A decision may remain in the lobby's document after it was carried out, or be carried out later."""
    then = datetime.now(UTC) - timedelta(minutes=1)
    other = ids.server_label("maze", BOB)
    formed = Formed(SID, (Matched(LABEL, ANN), Matched(other, BOB)), then)
    world.put(decisions.key("maze"), to_json(Decisions(3, formed=(formed,))))
    world.participant(ANN, answered=1)
    if written:
        pair(world.put, tmp_path)
    assert not run(world)
    Lobby(world.platform, Repository(world.platform.documents)).repair(STUDY)
    assert traces(world) == []
    assert [each.user_id for each in parse(world.get(session_key("maze", SID))).members] == ["", BOB]


def test_a_lobby_that_changed_meanwhile_is_erased_from_in_the_next_round(world: Installed, monkeypatch: Any) -> None:
    world.participant(ANN, answered=1)
    world.put(decisions.key("maze"), to_json(Decisions(1, open=(OpenSession("s.1", datetime.now(UTC), LABEL),))))
    times, replace = iter(range(1)), VersionedBucket.replace

    def replace_too_late(self: VersionedBucket, key: str, before: bytes, after: bytes) -> bool:
        if next(times, None) is not None:
            world.put(key, to_json(msgspec.structs.replace(from_json(before, Decisions), version=2)))
        return replace(self, key, before, after)

    monkeypatch.setattr(VersionedBucket, "replace", replace_too_late)
    assert not run(world)
    assert traces(world) == []
    assert from_json(world.get(decisions.key("maze")), Decisions).version == 3


def test_a_session_without_its_document_is_found_by_the_membership(
    world: Installed, tmp_path: Path, capsys: Any
) -> None:
    pair(world.put, tmp_path)
    for key, version in contents(world):
        if key == session_key("maze", SID):
            world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key=key, VersionId=version)
    assert erase(world, capsys).code == Exit.DONE
    assert traces(world) == []
    assert said(BOB).encode() in gzip.decompress(world.get(recording_key()))


def test_an_unreadable_document_that_names_the_participant_is_reported(
    world: Installed, tmp_path: Path, capsys: Any
) -> None:
    pair(world.put, tmp_path)
    world.put(session_key("maze", OTHER), f'{{"members": "{ANN}"}}'.encode())
    ran = erase(world, capsys)
    assert f"maze/sessions/{OTHER}/session.json in hippodrome cannot be read" in ran.err


def test_a_member_is_erased_from_a_kept_bucket_as_documented(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    pair(world.put, tmp_path)
    world.put(f"_lobby/maze/{LABEL}.way", b"{}")
    world.put(waiting_key("maze"), json.dumps({"waiting": [{"id": LABEL, "answers": {"age": 41}}]}).encode())
    theirs = of(world, BOB)
    (program,) = [block for block in code("docs/data.md", "python") if "eraser.erase()" in block]
    for user in (ANN, BOB):
        monkeypatch.setattr(sys, "argv", ["forget.py", world.env["BUCKET"], "maze", user])
        capsys.readouterr()
        exec(program, {})
        assert capsys.readouterr().out == "{'documents': 0, 'sessions': 0} left\n"
        assert traces(world, user) == []
        assert of(world, BOB) == (theirs if user == ANN else {})
    assert not [key for key, _ in contents(world) if SID in key]


def test_a_dry_run_counts_sessions_and_changes_nothing(world: Installed, tmp_path: Path, capsys: Any) -> None:
    pair(world.put, tmp_path)
    before = contents(world)
    dry = world.run(capsys, "erase", ANN, "maze", "--dry-run", "--json")
    assert (dry.code, dry.json["found"]["maze"]["sessions"]) == (Exit.CHANGES, 1)
    shown = world.run(capsys, "erase", ANN, "maze", "--dry-run")
    assert "sessions" in shown.out + shown.err
    assert contents(world) == before
