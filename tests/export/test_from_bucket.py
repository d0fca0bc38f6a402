"""`hippodrome data` on a bucket, also on one that has outlived its installation."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.export import fetch
from hippodrome.export.bucket import Bucket
from hippodrome.export.source import FileGone
from testing.aws_events import ACCOUNT
from testing.studies import study
from tests.deployment.installation import Installed, environment, process
from tests.export import data_world as made_of
from tests.export.data_world import GAME, crowd, into_folder, key
from tests.export.place import rows


@pytest.mark.explores
def test_data_of_more_than_a_page_are_fetched_whole(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any, pages: int
) -> None:
    from moto.s3.models import s3_backends

    made_of.register(world.put)
    monkeypatch.setattr(fetch, "PARALLEL", 1)  # moto answers one at a time; threads would only wait for each other
    count = pages + 20
    backend = s3_backends[ACCOUNT]["aws"]  # its front door takes ten times as long
    for number in range(count):
        body = json.dumps(made_of.answer("1", {"n": str(number)})).encode()
        backend.put_object(world.env["BUCKET"], key(f"u{number:05}", "answers/1.json"), body)
    arguments = ("data", "maze", "--to", str(tmp_path / "out"), "--json")
    ran = world.run(capsys, *arguments)
    assert ran.code == Exit.DONE, ran.err
    assert ran.json["counts"]["participants"] == count
    found = rows(tmp_path / "out" / "answers.csv")
    assert [row["1.n"] for row in found] == [str(number) for number in range(count)]
    with world.recording() as calls:
        again = world.run(capsys, *arguments)
    assert again.json["run"]["unchanged"] == count
    pages_of_study = [made_of.PROJECT.page_key(file) for step in made_of.PROJECT.steps for file in step.files]
    asked = [call.params.get("Key") for call in calls if call.operation == "GetObject"]
    assert asked == ["project_master_list.json", *pages_of_study], "no answer is fetched twice"


def test_a_bucket_and_a_folder_give_the_same_tables(world: Installed, tmp_path: Path, capsys: Any) -> None:
    into = into_folder(tmp_path / "data")

    def both(at: str, body: bytes) -> None:
        world.put(at, body)
        into(at, body)

    users = crowd(both, tmp_path, 4, observe=True)
    both(key(users[0], "stray.txt"), b"?")
    for out, more in (("aws", []), ("here", ["--from", str(tmp_path / "data")])):
        ran = world.run(capsys, "data", "maze", "--to", str(tmp_path / out), *more)
        assert ran.code == Exit.DONE, ran.err
    one, other = (json.loads((tmp_path / out / "manifest.json").read_text()) for out in ("aws", "here"))
    assert one["files"] == other["files"]
    assert (one["source"], other["source"]) == (f"bucket {world.env['BUCKET']}", "folder")
    assert world.run(capsys, "data", "maze", "--to", str(tmp_path / "here")).code == Exit.FAILED


def test_a_body_that_breaks_off_is_fetched_again(world: Installed, tmp_path: Path, monkeypatch: Any) -> None:
    from botocore.exceptions import IncompleteReadError

    monkeypatch.setattr("hippodrome.export.bucket.time.sleep", lambda _: None)
    body = os.urandom(300_000)
    world.put("maze/users/a/participant.json", body)
    s3 = world.client("s3")
    tries = iter(range(10))

    class Flaky:
        def get_object(self, **what: Any) -> Any:
            answer = s3.get_object(**what)
            if next(tries) < 2:
                answer["Body"].read = answer["Body"].iter_chunks = broken
            return answer

    def broken(*_: Any) -> Any:
        raise IncompleteReadError(actual_bytes=5, expected_bytes=9)

    bucket = Bucket(Flaky(), world.env["BUCKET"], "123456789012")
    assert bucket.read("maze/users/a/participant.json", 10**6) == body
    (listed,) = Bucket(s3, world.env["BUCKET"], "123456789012").list("maze/")
    tries = iter(range(10))
    bucket.fetch(listed, tmp_path / "x")
    assert (tmp_path / "x").read_bytes() == body
    world.put("maze/users/a/participant.json", b"another")
    with pytest.raises(FileGone):
        bucket.fetch(listed, tmp_path / "x")


def test_refused_and_unknown_projects_are_reported(world: Installed, tmp_path: Path, capsys: Any) -> None:
    crowd(world.put, tmp_path, 2)
    out = str(tmp_path / "out")
    assert "no project nobody" in world.run(capsys, "data", "nobody", "--to", out).err
    world.register(study(id="empty"))
    assert "No participant has begun empty yet" in world.run(capsys, "data", "empty", "--to", out).err
    world.fail("s3:ListObjectsV2", "AccessDenied", status=403)
    refused = world.run(capsys, "data", "maze", "--to", out)
    assert (refused.code, "may not list objects" in refused.err) == (Exit.FAILED, True)
    assert world.run(capsys, "data", "maze", "--to", out, "--stack", "other").code == Exit.FAILED
    assert world.run(capsys, "data", "maze", "--to", out).code == Exit.DONE


# From a bucket that outlived its installation


def demolish(world: Installed) -> str:
    """Remove the stack but not the bucket, as `destroy` does; return the bucket's name."""
    world.client("cloudformation").delete_stack(StackName="hippodrome")
    return world.env["BUCKET"]


def test_a_kept_bucket_gives_the_same_as_its_installation_did(world: Installed, tmp_path: Path, capsys: Any) -> None:
    crowd(world.put, tmp_path, 4)
    assert world.run(capsys, "data", "maze", "--to", str(tmp_path / "before")).code == Exit.DONE
    kept = demolish(world)
    without = world.run(capsys, "data", "maze", "--to", str(tmp_path / "x")).err
    assert "no stack named hippodrome" in without
    assert "the bucket that `destroy` has named: --bucket." in without
    after = ("data", "maze", "--to", str(tmp_path / "after"), "--bucket", kept)
    assert world.run(capsys, *after, "--dry-run", "--json").json["participants"] == 4
    with world.recording() as calls:
        ran = world.run(capsys, *after)
    assert (ran.code, "gone from" in ran.err) == (Exit.DONE, False), ran.err
    assert {call.params["ExpectedBucketOwner"] for call in calls if call.service == "s3"} == {ACCOUNT}
    assert {call.service for call in calls} == {"s3", "sts"}
    one, other = (json.loads((tmp_path / out / "manifest.json").read_text()) for out in ("before", "after"))
    assert one["files"] == other["files"]
    assert [row["finished"] for row in rows(tmp_path / "after" / "answers.csv")] == ["true", "true", "true", "false"]


def test_a_folder_is_updated_from_the_kept_bucket(world: Installed, tmp_path: Path, capsys: Any) -> None:
    users = crowd(world.put, tmp_path, 3)
    world.run(capsys, "data", "maze", "--to", str(tmp_path / "out"))
    world.put(key(users[2], "answers/3.json"), json.dumps(made_of.answer("3", GAME)).encode())
    again = ("data", "maze", "--to", str(tmp_path / "out"), "--bucket", demolish(world), "--json")
    assert world.run(capsys, *again).json["run"]["new"] == 1


def test_answers_are_fetched_without_the_list_of_projects_with_a_warning(
    world: Installed, tmp_path: Path, capsys: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    kept = demolish(world)
    world.client("s3").delete_object(Bucket=kept, Key="project_master_list.json")
    ran = world.run(capsys, "data", "maze", "--to", str(tmp_path / "out"), "--bucket", kept)
    assert (ran.code, f"project_master_list.json is gone from {kept}" in ran.err) == (Exit.DONE, True), ran.err
    assert [row["finished"] for row in rows(tmp_path / "out" / "answers.csv")] == ["", "", ""]


def test_a_kept_bucket_says_which_projects_it_holds(world: Installed, tmp_path: Path, capsys: Any) -> None:
    crowd(world.put, tmp_path, 2)
    world.put("later/users/ann/answers/1.json", b"{}")
    world.put("pages-only/steps/consent.html", b"")
    world.put("SSL/privkey.pem", b"")
    world.record("ann")
    kept = demolish(world)
    ran = world.run(capsys, "data", "pages-only", "--to", str(tmp_path / "out"), "--bucket", kept)
    assert (ran.code, "It holds those of later, maze: name one" in ran.err) == (Exit.FAILED, True), ran.err


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        (["project_master_list.json"], "holds nothing of participants of maze"),
        (["notes/users/list.txt", "SSL/privkey.pem"], "It holds those of notes"),
        (["next_step-0123.zip"], "holds no installation's data: neither project_master_list.json nor participants'"),
        ([], "holds no installation's data"),
    ],
)
def test_a_bucket_without_the_studys_data_is_reported(
    world: Installed, tmp_path: Path, capsys: Any, keys: list[str], says: str
) -> None:
    world.client("s3").create_bucket(Bucket="photographs")
    for at in keys:
        world.client("s3").put_object(Bucket="photographs", Key=at, Body=b"")
    ran = world.run(capsys, "data", "maze", "--to", str(tmp_path / "out"), "--bucket", "photographs")
    assert (ran.code, says in ran.err) == (Exit.FAILED, True), ran.err
    assert not (tmp_path / "out").exists()


def test_a_missing_or_foreign_bucket_is_reported(world: Installed, tmp_path: Path, capsys: Any) -> None:
    """Gap: moto does not compare ExpectedBucketOwner. S3 answers 403 to HeadBucket then, without a word."""

    def told(name: str) -> str:
        ran = world.run(capsys, "data", "maze", "--to", str(tmp_path / "out"), "--bucket", name)
        assert ran.code == Exit.FAILED
        return ran.err

    assert "There is no bucket hippodrome-gone." in told("hippodrome-gone")
    assert "'s3://photographs/' is no bucket's name" in told("s3://photographs/")
    assert "'' is no bucket's name" in told("")
    world.fail("s3:HeadBucket", "403", status=403)
    assert f"does not belong to the account {ACCOUNT}, or these credentials may not look" in told(world.env["BUCKET"])
    world.fail("sts:GetCallerIdentity", "ExpiredToken", status=403)
    assert "credentials have expired" in told(world.env["BUCKET"])


def test_a_run_that_was_interrupted_twice_is_finished_by_the_next(world: Installed, tmp_path: Path) -> None:
    """One run is ended by Ctrl-C, and the next one by `kill -9`."""
    crowd(world.put, tmp_path, 30)
    out = tmp_path / "out"
    with world.served() as env:
        line = [sys.executable, "-m", "hippodrome", "data", "maze", "--to", str(out)]
        for how in (signal.SIGINT, signal.SIGKILL):
            before = len(list(out.glob("recordings/*/*/*.parquet")))
            with subprocess.Popen(
                line, env=env, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
            ) as running:
                while running.poll() is None and len(list(out.glob("recordings/*/*/*.parquet"))) == before:
                    time.sleep(0.01)
                running.send_signal(how)
                assert running.stderr is not None
                said = running.stderr.read()
            assert "Traceback" not in said, said
            assert running.returncode in (Exit.DONE, Exit.INTERRUPTED, -how)
        dry = process(env, "data", "maze", "--to", str(out), "--dry-run", "--json")
        assert dry.code == (Exit.DONE if running.returncode == Exit.DONE else Exit.CHANGES), dry.err
        whole = process(env, "data", "maze", "--to", str(out), "--json")
        assert whole.code == Exit.DONE, whole.err
        assert whole.json["run"]["new"] == dry.json["new"]
    assert len(rows(out / "answers.csv")) == 30
    assert len(rows(out / "episodes.csv")) == 29
    assert process(environment(), "data", "--to", str(out), "--check").code == Exit.DONE
