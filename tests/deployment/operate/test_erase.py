"""`hippodrome erase`: it deletes every version of one participant's data, changes no others', and writes a receipt."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec
import pytest
from botocore.client import BaseClient

from hippodrome.console.problem import Exit
from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.limits.slots import Slots
from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.decisions import Decisions, Unmatched
from hippodrome.control.model import ids
from hippodrome.control.model.messages import StartServer, parse_task_changed
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import ServerState
from hippodrome.control.ports import RunningTask, TaskRequest
from hippodrome.control.servers.signing import STORE_AFTER_CLOSE, VALID_SECONDS
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.aws import versions as versioned
from hippodrome.deployment.aws.account import find_installation
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import stages
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.operate.aws_erasure import SIGNING, AwsErasure
from hippodrome.deployment.operate.eraser import Eraser
from testing import template as cfn
from testing.exploration import sample
from testing.servers import Servers
from testing.studies import study
from tests.deployment.installation import CommandResult, Installed, account_here
from tests.test_docs import code

STUDY = msgspec.structs.replace(study(), task_definition="hippodrome")
OTHER = msgspec.structs.replace(STUDY, id="other")
ANN, ANNA = "annabel-0042", "annabel-0042b"


@pytest.fixture
def world(installed: Installed, tmp_path: Path, monkeypatch: Any, access_keys: None) -> Installed:
    installed.register(STUDY, OTHER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stages, "PAUSE", 0)
    monkeypatch.setattr(
        "hippodrome.deployment.operate.aws_erasure.SIGNING", -VALID_SECONDS - STORE_AFTER_CLOSE.total_seconds()
    )
    return installed


def run(world: Installed, capsys: Any, *more: str, user: str = ANN, project: str = "maze") -> CommandResult:
    where = () if "--everywhere" in more else (project,)
    return world.run(capsys, "erase", user, *where, "--yes", *more)


def versions(world: Installed, prefix: str = "") -> dict[str, int]:
    """Return the number of versions and delete markers of each key."""
    found: dict[str, int] = {}
    for page in world.client("s3").get_paginator("list_object_versions").paginate(Bucket=world.env["BUCKET"]):
        for line in [*page.get("Versions", ()), *page.get("DeleteMarkers", ())]:
            if line["Key"].startswith(prefix):
                found[line["Key"]] = found.get(line["Key"], 0) + 1
    return found


def traces(world: Installed, user: str) -> list[str]:
    """Return the keys, servers and timers that belong to the participant."""
    label = ids.server_label("maze", user)
    keys = [key for key in versions(world) if key.startswith(f"maze/users/{user}/") or label in key]
    tasks = [task.name for task in world.platform.tasks.list() if label in task.name]
    return [*keys, *tasks, *(t for t in world.timers() if label in t), *(n for n in world.records() if label in n)]


def start(world: Installed, user: str = ANN) -> str:
    """Start a participant's server with its timer and DNS name. Returns its task."""
    servers = Servers(world.platform)
    before = set(world.task_arns())
    servers.start(StartServer("maze", user))
    (task,) = set(world.task_arns()) - before
    event = parse_task_changed(world.task_event(task, "RUNNING"))
    assert event is not None
    assert servers.tasks_changed([event]) == []
    return task


def bodies(world: Installed) -> list[bytes]:
    """Return the contents of every version of every document."""
    s3, bucket = world.client("s3"), world.env["BUCKET"]
    found = s3.list_object_versions(Bucket=bucket)["Versions"]
    return [s3.get_object(Bucket=bucket, Key=v["Key"], VersionId=v["VersionId"])["Body"].read() for v in found]


def test_a_participant_is_erased_from_a_kept_bucket_as_documented(
    world: Installed, monkeypatch: Any, capsys: Any
) -> None:
    kept = msgspec.structs.replace(STUDY, warm_servers=1, max_participants=20)
    world.register(kept, OTHER)
    world.warm(kept, 1)
    for user in (ANN, ANNA):
        assert Slots(world.platform).admit(kept, user)
        world.participant(user, answered=5, recordings=2)
        Servers(world.platform).start(StartServer("maze", user))  # Ann plays on a warm server
    world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key=f"maze/users/{ANN}/answers/1.json")
    before = versions(world, f"maze/users/{ANNA}/")
    names = re.compile(rb"%b\b|%b" % (ANN.encode(), ids.server_label("maze", ANN).encode()))
    assert any(map(names.search, bodies(world)))
    (program,) = [block for block in code("docs/data.md", "python") if "eraser.erase()" in block]
    monkeypatch.setattr(sys, "argv", ["forget.py", world.env["BUCKET"], "maze", ANN])
    capsys.readouterr()
    exec(program, {})
    assert capsys.readouterr().out == "{'documents': 0, 'sessions': 0} left\n"
    assert not any(names.search(text) for text in [*bodies(world), *map(str.encode, versions(world))])
    assert versions(world, f"maze/users/{ANNA}/") == before
    assert versions(world, "project_master_list.json")


def test_everything_of_one_participant_is_erased_and_nothing_of_others(world: Installed, capsys: Any) -> None:
    for user in (ANN, ANNA, "ann"):
        world.participant(user, answered=5, recordings=2, PROLIFIC_PID=f"prolific-{user}")
        start(world, user)
    world.participant(ANN, answered=1, project=OTHER)
    world.put(f"maze/users/{ANN}/participant.json", b"an older version stays in the bucket")
    world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key=f"maze/users/{ANN}/answers/1.json")
    world.client("s3").create_multipart_upload(Bucket=world.env["BUCKET"], Key=f"maze/users/{ANN}/trials/x/big.gz")
    mine = {*traces(world, ANN)}
    others = {key: count for key, count in versions(world).items() if key not in mine}

    ran = run(world, capsys, "--receipt", "receipt.json", "--json")

    assert ran.code == Exit.DONE, ran.err
    assert traces(world, ANN) == []
    assert versions(world) == others  # ANN's data in another project are among them
    assert len([*world.platform.tasks.list()]) == len(world.timers()) == len(world.records()) == 2
    uploads = world.client("s3").list_multipart_uploads(Bucket=world.env["BUCKET"])
    assert "Uploads" not in uploads


def test_the_receipt_says_what_was_erased_and_names_no_participant(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=3, recordings=1)
    start(world)
    ran = run(world, capsys, "--receipt", "receipt.json", "--json")
    text = Path("receipt.json").read_text()
    receipt = json.loads(text)
    assert ran.json == receipt
    for hidden in (ANN, ids.server_label("maze", ANN)):
        assert hidden not in text
        assert hidden not in ran.err
    assert receipt["complete"] is True
    assert receipt["by"].startswith("arn:aws:")
    person = receipt["person"]
    assert person["sha256"] == hashlib.sha256(f"{person['salt']}{ANN}".encode()).hexdigest()
    (project,) = receipt["projects"]
    assert set(project["left"].values()) == {0}
    assert {key for key in project["deleted"] if "/answers/" in key} == {
        f"maze/users/{{userId}}/answers/{step}.json" for step in (1, 2, 3)
    }
    assert any("{server}-1/3-episode" in key for key in project["deleted"])
    assert project["deleted"]["_servers/{server}.json"] >= 2
    assert project["ended"] == {"servers": 1, "tasks": 1, "timers": 1, "names": 1, "clusters": 0, "draining": 0}
    named = run(world, capsys, "--with-id", "--receipt", "named.json", "--json")
    assert named.json["person"]["userId"] == ANN


def test_a_second_run_says_that_there_is_nothing(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=2)
    assert run(world, capsys).code == Exit.DONE
    before = versions(world)
    again = run(world, capsys, "--receipt", "again.json")
    assert again.code == Exit.DONE
    assert "nothing of this participant" in again.err
    assert versions(world) == before
    assert json.loads(Path("again.json").read_text())["projects"][0]["deleted"] == {}


def test_a_mistyped_participant_needs_no_confirmation_and_changes_nothing(
    world: Installed, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = versions(world)
    assert world.run(capsys, "erase", "no-such-person", "maze").code == Exit.DONE
    assert versions(world) == before
    assert world.run(capsys, "erase", "../ann", "maze").code == Exit.FAILED
    assert world.run(capsys, "erase", ANN, "maze", "--everywhere").code == Exit.MISUSE
    monkeypatch.chdir(tmp_path)
    assert world.run(capsys, "erase", ANN).code == Exit.MISUSE  # there is no config.yml here
    dry = world.run(capsys, "erase", "no-such-person", "maze", "--dry-run")
    assert (dry.code, dry.out) == (Exit.DONE, "There is nothing of this participant in maze.\n")


def test_an_unknown_project_is_refused(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=2)
    ran = run(world, capsys, project="mase")
    assert ran.code == Exit.FAILED
    assert "holds nothing of a project mase" in ran.err
    assert "It holds: maze, other." in ran.err
    assert not list(Path().glob("erased-*"))


def test_a_dry_run_and_a_missing_yes_change_nothing(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=2)
    start(world)
    with world.recording() as calls:
        dry = world.run(capsys, "erase", ANN, "maze", "--dry-run", "--json")
        asked = world.run(capsys, "erase", ANN, "maze")
    assert (dry.code, asked.code) == (Exit.CHANGES, Exit.DECLINED)
    assert dry.json["found"]["maze"]["tasks"] == 1
    assert not [c for c in calls if not c.operation.startswith(("Get", "List", "Describe", "Head"))]
    assert not list(Path().glob("erased-*"))


def test_everywhere_erases_in_every_project_registered_or_not(world: Installed, capsys: Any) -> None:
    forgotten = msgspec.structs.replace(STUDY, id="forgotten")
    for project in (STUDY, OTHER, forgotten):
        world.participant(ANN, answered=1, project=project)
        world.participant("somebody-else", answered=1, project=project)
    assert run(world, capsys, "--everywhere").code == Exit.DONE
    assert not [key for key in versions(world) if ANN in key]
    assert len([key for key in versions(world) if "somebody-else" in key]) == 6


@pytest.mark.explores
def test_more_objects_than_a_listing_or_a_deletion_takes_are_erased(
    world: Installed, capsys: Any, pages: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr(versioned, "BATCH", pages)
    world.participant(ANN)
    for number in range(1, pages + pages // 7):
        world.put(f"maze/users/{ANN}/trials/s/3-episode-{number:04}.jsonl.gz", b"")
    assert run(world, capsys).code == Exit.DONE
    assert traces(world, ANN) == []


def test_documents_that_a_trial_saves_while_it_ends_are_erased_too(
    world: Installed, capsys: Any, monkeypatch: Any
) -> None:
    """erase deletes documents only after the task has ended."""
    world.participant(ANN, answered=3)
    start(world)
    looks = iter([["x"], ["x"], []])
    name = ids.server_name(ids.server_label("maze", ANN), 1)
    seen = []

    def draining(self: EcsTasks, *clusters: str) -> list[RunningTask]:
        if [task for task in world.platform.tasks.list() if task.name == name]:
            return []
        still = next(looks, [])
        seen.append(len(versions(world, f"maze/users/{ANN}/")))
        if still:
            world.put(f"maze/users/{ANN}/trials/{name}/3-episode-000{len(seen)}.jsonl.gz", b"saved at the end")
        return [RunningTask("arn", "hippodrome", name)] if still else []

    monkeypatch.setattr(EcsTasks, "draining", draining)
    assert run(world, capsys).code == Exit.DONE
    assert seen[:3] == [4, 5, 6]  # nothing was deleted while the trial was saving
    assert traces(world, ANN) == []


@pytest.mark.parametrize(
    ("state", "seconds"),
    [
        (ServerState.READY, STORE_AFTER_CLOSE.total_seconds() + VALID_SECONDS + SIGNING),
        (ServerState.CLOSED, VALID_SECONDS + SIGNING),
    ],
)
def test_a_document_stored_late_by_an_earlier_presigned_request_is_erased(
    world: Installed, monkeypatch: Any, state: ServerState, seconds: float
) -> None:
    monkeypatch.setattr("hippodrome.deployment.operate.aws_erasure.SIGNING", SIGNING)
    world.participant(ANN, answered=2)
    world.record(ANN, state, closed=world.platform.now() - STORE_AFTER_CLOSE if state is ServerState.CLOSED else None)
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        world.put(f"maze/users/{ANN}/answers/3.json", b"{}")

    assert not erases(world, sleep=sleep)
    assert max(slept) == pytest.approx(seconds, abs=20)
    assert traces(world, ANN) == []


def test_a_participant_without_a_recent_server_is_erased_without_waiting(world: Installed, monkeypatch: Any) -> None:
    monkeypatch.setattr("hippodrome.deployment.operate.aws_erasure.SIGNING", SIGNING)
    world.participant(ANN, answered=2)
    over = timedelta(seconds=VALID_SECONDS + SIGNING)
    world.record(ANN, ServerState.CLOSED, closed=world.platform.now() - STORE_AFTER_CLOSE - over)
    slept: list[float] = []
    assert not erases(world, sleep=slept.append)
    assert slept == []
    assert traces(world, ANN) == []


def test_signing_takes_no_longer_than_erase_assumes() -> None:
    assert cfn.resources("AWS::Lambda::Function")["SignRequests"]["Timeout"] <= SIGNING


def test_a_task_that_does_not_end_keeps_the_documents(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=3)
    start(world)
    name = ids.server_name(ids.server_label("maze", ANN), 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EcsTasks, "draining", lambda self, *clusters: [RunningTask("arn", "hippodrome", name)])
        patch.setattr("hippodrome.deployment.operate.aws_erasure.WAIT", 0)
        ran = run(world, capsys)
    assert ran.code == Exit.FAILED
    assert "still runs" in ran.err
    assert len(versions(world, f"maze/users/{ANN}/")) == 4
    assert run(world, capsys).code == Exit.DONE
    assert traces(world, ANN) == []


def erases(
    world: Installed, clock: Callable[[], float] = monotonic, sleep: Callable[[float], None] | None = None
) -> bool:
    """Erase the participant. Returns whether anything is left."""
    account = account_here()
    erasure = AwsErasure(account, find_installation(account), "maze", ANN, Executor(sleep, clock))
    return any(erasure.run().values())


def test_a_participant_who_returns_meanwhile_is_erased_again(world: Installed, monkeypatch: Any) -> None:
    world.participant(ANN, answered=2)
    rounds, erase = [0], Eraser.erase

    def erase_and_return(self: Eraser, advance: Any) -> None:
        erase(self, advance)
        rounds[0] += 1
        if rounds[0] < 3:
            world.participant(ANN, answered=1)
            back = world.record(ANN, attempt=2)
            world.platform.timers.set(back.name, world.platform.now(), {})
            world.platform.dns.change(add=[back.dns_record] if back.dns_record else [])

    monkeypatch.setattr(Eraser, "erase", erase_and_return)
    assert not erases(world)
    assert rounds == [3]
    assert traces(world, ANN) == []


@pytest.mark.parametrize(
    ("owner", "method", "naming"),
    [(VersionedBucket, "replace", ()), (Eraser, "_in_lobby", ("SECRETCODE",))],
    ids=["while it replaces them", "after its own version"],
)
def test_a_lobby_that_writes_its_decisions_meanwhile_keeps_no_version_with_the_participant(
    world: Installed, monkeypatch: Any, owner: Any, method: str, naming: Sequence[str]
) -> None:
    """The lobby's newest version no longer names them, but versions before it do."""
    key, label = decisions.key("maze"), ids.server_label("maze", ANN)
    newest = to_json(Decisions(9))
    whole = getattr(owner, method)

    def store(code: str) -> None:
        world.put(key, to_json(Decisions(1, unmatched=(Unmatched(label, ANN, world.platform.now(), code),))))

    def race(self: Any, *args: Any) -> Any:
        monkeypatch.setattr(owner, method, whole)
        for past in naming:
            store(past)
        world.put(key, newest)
        return whole(self, *args)

    world.participant(ANN, answered=2)
    store("SECRETCODE")
    monkeypatch.setattr(owner, method, race)
    assert not erases(world)
    assert not [body for body in bodies(world) if label.encode() in body or b"SECRETCODE" in body]
    assert world.get(key) == newest


def test_erase_reports_a_participant_who_keeps_returning(world: Installed, capsys: Any, monkeypatch: Any) -> None:
    world.participant(ANN, answered=2)
    erase = Eraser.erase

    def erase_and_return(self: Eraser, advance: Any) -> None:
        erase(self, advance)
        world.participant(ANN, answered=1)

    monkeypatch.setattr(Eraser, "erase", erase_and_return)
    ran = run(world, capsys)
    assert ran.code == Exit.FAILED
    assert "--no-live" in ran.err
    (receipt,) = Path().glob("erased-*.json")
    assert json.loads(receipt.read_text())["complete"] is False


def test_each_of_several_erasures_in_one_second_has_its_own_receipt(
    world: Installed, capsys: Any, monkeypatch: Any
) -> None:
    class Stopped(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            return datetime(2026, 3, 4, 12, tzinfo=tz)

    monkeypatch.setattr("hippodrome.deployment.operate.erase.datetime", Stopped)
    names = ["erased-20260304T120000Z.json", "erased-20260304T120000Z-2.json", "erased-20260304T120000Z-3.json"]
    for number, name in enumerate(names, 1):
        ran = run(world, capsys)
        assert (ran.code, name in ran.err + ran.out) == (Exit.DONE, True)
        assert len(list(Path().glob("erased-*"))) == number


class Interruption(BaseException):
    """The process ends here."""


def interrupt_at(monkeypatch: Any, at: int) -> list[int]:
    """End the process after the n-th call that changes something, which is before the next one; 0: count these calls."""
    count = [0]
    whole = BaseClient._make_api_call
    changing = ("Put", "Delete", "Abort", "Upload", "Complete", "Create", "Stop", "Change")

    def call(self: BaseClient, operation: str, params: Any) -> Any:
        changes = operation.startswith(changing)
        count[0] += changes
        answer = whole(self, operation, params)
        if changes and count[0] == at:
            raise Interruption
        return answer

    monkeypatch.setattr(BaseClient, "_make_api_call", call)
    return count


@pytest.mark.explores
def test_a_run_after_an_interruption_at_any_call_finishes_the_erasure(
    world: Installed, capsys: Any, monkeypatch: Any
) -> None:
    """Each call that changes something is the last one of a run; the next run finishes the work (a sample of the calls)."""
    monkeypatch.setattr(versioned, "BATCH", 3)

    def check(at: int) -> int:
        world.participant(ANN, answered=4, recordings=2)
        start(world)
        with pytest.MonkeyPatch.context() as patch:
            count = interrupt_at(patch, at)
            with suppress(Interruption):
                run(world, capsys, "--receipt", f"cut-{at}.json")
        partial = Path(f"cut-{at}.json")
        cut = at > 0 and count[0] == at
        assert not cut or not partial.exists() or json.loads(partial.read_text())["complete"] is False
        if cut:
            assert run(world, capsys, "--receipt", f"whole-{at}.json").code == Exit.DONE
            assert json.loads(Path(f"whole-{at}.json").read_text())["complete"] is True
        assert traces(world, ANN) == [], at
        return count[0]

    calls = check(0)
    assert calls >= 7
    for at in sample(range(1, calls + 1), 4):
        check(at)


def test_a_refused_deletion_fails_the_erasure(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=2)
    errors = [{"Key": f"maze/users/{ANN}/participant.json", "Code": "AccessDenied", "Message": "object lock"}]
    for page in world.client("s3").get_paginator("list_object_versions").paginate(Bucket=world.env["BUCKET"]):
        for line in page["Versions"]:
            if line["Key"] == errors[0]["Key"]:
                errors[0]["VersionId"] = line["VersionId"]
    world.answer("s3:DeleteObjects", {"Errors": errors})
    ran = run(world, capsys)
    assert ran.code == Exit.FAILED
    assert "AccessDenied" in ran.err
    (receipt,) = Path().glob("erased-*.json")
    deleted = json.loads(receipt.read_text())["projects"][0]["deleted"]
    assert "participant" not in deleted  # the receipt does not list refused deletions


def test_a_new_task_that_ecs_lists_late_is_stopped(world: Installed, monkeypatch: Any) -> None:
    monkeypatch.setattr("hippodrome.deployment.operate.aws_erasure.SIGNING", SIGNING)
    world.participant(ANN, answered=1)
    world.platform.timers.set(ids.server_name(ids.server_label("maze", ANN), 1), world.platform.now(), {})
    now = world.platform.now()
    world.record(ANN, ServerState.STARTING, requested=now)
    time = [0.0]
    tasks = EcsTasks.list

    def late(self: EcsTasks) -> Any:
        if time[0] == 10 and not world.task_arns():
            name = ids.server_name(ids.server_label("maze", ANN), 1)
            world.platform.tasks.run(TaskRequest(name, "hippodrome", "hippodrome", 1, 2, {}))
        return tasks(self)

    monkeypatch.setattr(EcsTasks, "list", late)
    assert not erases(world, clock=lambda: time[0], sleep=lambda seconds: time.__setitem__(0, time[0] + 10))
    assert world.task_arns()
    assert [*tasks(world.platform.tasks)] == []
    assert traces(world, ANN) == []


def test_a_receipt_that_cannot_be_written_stops_the_erasure_beforehand(world: Installed, capsys: Any) -> None:
    world.participant(ANN, answered=2)
    Path("there.json").write_text("somebody's")
    for target in ("there.json", "no/such/folder.json"):
        assert run(world, capsys, "--receipt", target).code == Exit.FAILED
    assert len(versions(world, f"maze/users/{ANN}/")) == 3
    assert Path("there.json").read_text() == "somebody's"


def test_a_participant_is_erased_from_a_bucket_without_versions(world: Installed, capsys: Any) -> None:
    world.client("s3").put_bucket_versioning(
        Bucket=world.env["BUCKET"], VersioningConfiguration={"Status": "Suspended"}
    )
    world.participant(ANN, answered=2)
    assert run(world, capsys).code == Exit.DONE
    assert traces(world, ANN) == []


WARM = msgspec.structs.replace(STUDY, warm_servers=2)


def take_warm_server(world: Installed, user: str) -> str:
    """Let a participant take a warm server. Returns its name."""
    (name,) = world.warm(WARM, 1)
    Servers(world.platform).start(StartServer("maze", user))
    return name


def test_the_warm_server_of_the_participant_is_erased_too(world: Installed, capsys: Any) -> None:
    world.register(WARM)
    hers, others = take_warm_server(world, ANN), take_warm_server(world, ANNA)
    (waiting,) = world.warm(WARM, 1)
    world.participant(ANN, answered=1)
    label, kept = hers.rpartition("-")[0], others.rpartition("-")[0]
    about = [f"maze/handovers/{hers}.json", f"_servers/{label}.json"]
    assert ANN.encode() in world.get(about[0])
    assert ids.server_label("maze", ANN).encode() in world.get(about[1])
    ran = run(world, capsys, "--receipt", "receipt.json")
    assert ran.code == Exit.DONE, ran.err
    left = versions(world)
    assert not [key for key in left if key in about]
    assert traces(world, ANN) == []
    assert {f"maze/handovers/{others}.json", f"_servers/{kept}.json"} <= set(left)
    assert {task.name for task in world.platform.tasks.list()} == {others, waiting}
    receipt = Path("receipt.json").read_text()
    assert label not in receipt
    assert json.loads(receipt)["projects"][0]["deleted"]["maze/handovers/{server}-1.json"] == 2  # and a delete marker


def test_warm_servers_of_earlier_attempts_are_erased_too(world: Installed, capsys: Any) -> None:
    world.register(WARM)
    first = take_warm_server(world, ANN)
    servers = Servers(world.platform)
    (task,) = world.task_arns()
    lost = parse_task_changed(world.task_event(task, "STOPPED", stop_code="SpotInterruption"))
    assert lost is not None
    assert servers.tasks_changed([lost]) == []
    servers.start(StartServer("maze", ANN, 2))
    record = Repository(world.platform.documents).server_of("maze", ANN)
    assert record is not None
    assert (record.warm_server_name, [run.warm_server_name for run in record.earlier]) == (None, [first])
    assert run(world, capsys).code == Exit.DONE
    assert not [key for key in versions(world) if first.rpartition("-")[0] in key]


@pytest.mark.parametrize("refused", ["maze/handovers/", "_servers/"])
def test_the_record_that_names_a_warm_server_is_erased_last(
    world: Installed, capsys: Any, monkeypatch: Any, refused: str
) -> None:
    world.register(WARM)
    name = take_warm_server(world, ANN)
    world.participant(ANN, answered=1)
    batch = VersionedBucket._delete_batch

    def cut_off(self: VersionedBucket, versions: Sequence[Version], note: Any) -> None:
        if any(version.key.startswith(refused) for version in versions):
            raise KeyboardInterrupt
        batch(self, versions, note)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VersionedBucket, "_delete_batch", cut_off)
        assert run(world, capsys).code == Exit.INTERRUPTED
    assert world.get(f"_servers/{ids.server_label('maze', ANN)}.json")
    assert run(world, capsys, "--receipt", "whole.json").code == Exit.DONE
    assert not [key for key in versions(world) if name.rpartition("-")[0] in key]


def test_the_place_of_the_participant_is_free_again(world: Installed, capsys: Any) -> None:
    limited = msgspec.structs.replace(STUDY, max_participants=2)
    places = Slots(world.platform)
    for user in (ANN, ANNA):
        assert places.admit(limited, user)
        world.participant(user, answered=1)
    assert not Slots(world.platform).admit(limited, "carol")
    assert run(world, capsys).code == Exit.DONE
    labels = [ids.server_label("maze", user).encode() for user in (ANN, ANNA)]
    assert [any(label in body for body in bodies(world)) for label in labels] == [False, True]
    assert Slots(world.platform).admit(limited, "carol")
