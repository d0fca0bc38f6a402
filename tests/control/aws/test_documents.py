"""What `S3Documents` makes of S3's answers, beyond the contract."""

from __future__ import annotations

import pytest
from botocore.exceptions import ClientError

from hippodrome.control.aws import documents
from hippodrome.control.aws.documents import content_type
from hippodrome.control.ports import Conflict
from testing.moto_world import MotoWorld

KEY = "study/users/P1/participant.json"


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documents, "PAUSE", 0)


def test_conditional_writes_send_their_conditions(moto_world: MotoWorld) -> None:
    store = moto_world.platform.documents
    etag = store.create(KEY, b"one")
    known = store.get(KEY)
    store.get(KEY, known)
    store.replace(KEY, b"two", etag)
    put, plain, conditional, replaced = (call.params for call in moto_world.calls)
    assert put["IfNoneMatch"] == "*"
    assert put["ContentType"] == "application/json"
    assert put["Body"] == "<3 bytes>"
    assert "IfNoneMatch" not in plain
    assert conditional["IfNoneMatch"] == etag
    assert replaced["IfMatch"] == etag


@pytest.mark.parametrize("write", ["create", "replace"])
def test_a_write_that_meets_another_is_tried_again(moto_world: MotoWorld, write: str) -> None:
    store = moto_world.platform.documents
    etag = store.create("other.json", b"one")
    moto_world.fail("s3:PutObject", "ConditionalRequestConflict", status=409, times=2)
    if write == "create":
        store.create(KEY, b"two")
    else:
        store.replace("other.json", b"two", etag)
    assert moto_world.actions.count("s3:PutObject") == 4


def test_a_write_that_meets_another_at_every_try_raises_conflict(moto_world: MotoWorld) -> None:
    moto_world.fail("s3:PutObject", "ConditionalRequestConflict", status=409, times=99)
    with pytest.raises(Conflict):
        moto_world.platform.documents.create(KEY, b"one")
    assert len(moto_world.calls) == documents.MAX_WRITES


@pytest.mark.parametrize(("code", "status"), [("AccessDenied", 403), ("SlowDown", 503), ("NoSuchBucket", 404)])
def test_other_errors_are_raised_unchanged(moto_world: MotoWorld, code: str, status: int) -> None:
    store = moto_world.platform.documents
    for action, act in (
        ("s3:GetObject", lambda: store.get(KEY)),
        ("s3:PutObject", lambda: store.create(KEY, b"")),
        ("s3:PutObject", lambda: store.replace(KEY, b"", '"0"')),
        ("s3:ListObjectsV2", lambda: list(store.list(""))),
        ("s3:DeleteObject", lambda: store.delete(KEY)),
    ):
        moto_world.fail(action, code, status=status)
        with pytest.raises(ClientError, match=code):
            act()


@pytest.mark.explores
def test_a_listing_reads_all_pages(moto_world: MotoWorld, pages: int) -> None:
    for n in range(pages + 1):
        moto_world.client("s3").put_object(Bucket=moto_world.env["BUCKET"], Key=f"k{n:04}", Body=b"")
    entries = moto_world.platform.documents.list("k")
    next(entries)
    assert moto_world.actions == ["s3:ListObjectsV2"]
    assert len(list(entries)) == pages
    assert moto_world.actions == ["s3:ListObjectsV2"] * 2


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("study/steps/consent.html", "text/html; charset=utf-8"),
        ("study/users/P1/trial.json", "application/json"),
        ("study/users/P1/trials/1.jsonl.gz", "application/gzip"),
        ("study/images/Maze.PNG", "image/png"),
        ("study.v2/readme", "application/octet-stream"),
        ("", "application/octet-stream"),
    ],
)
def test_content_types(key: str, expected: str) -> None:
    assert content_type(key) == expected
