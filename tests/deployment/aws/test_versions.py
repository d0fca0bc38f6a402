"""Deleting every version and delete marker of a bucket, including those that appear meanwhile; refusals are reported."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from moto import mock_aws

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import versions as versioned
from hippodrome.deployment.aws.account import Account, open_account
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.aws.versions import VersionedBucket

NAME = "hippodrome-data"


@pytest.fixture
def account(access_keys: None) -> Iterator[Account]:
    with mock_aws():
        account = open_account(region="us-east-1")
        account.client("s3").create_bucket(Bucket=NAME)
        account.client("s3").put_bucket_versioning(Bucket=NAME, VersioningConfiguration={"Status": "Enabled"})
        yield account


def put(account: Account, *keys: str) -> None:
    for key in keys:
        account.client("s3").put_object(Bucket=NAME, Key=key, Body=b"x")


def left(account: Account) -> list[Version]:
    return [*VersionedBucket(account, NAME).versions()]


def test_versions_and_delete_markers_are_deleted(account: Account) -> None:
    put(account, "a", "a", "b")
    account.client("s3").delete_object(Bucket=NAME, Key="b")
    deleted: list[Version] = []
    VersionedBucket(account, NAME).empty(deleted.extend)
    assert left(account) == []
    assert [(one.key, one.marker) for one in sorted(deleted, key=lambda one: (one.key, one.marker))] == [
        ("a", False),
        ("a", False),
        ("b", False),
        ("b", True),
    ]


def test_objects_that_are_written_meanwhile_are_deleted_too(account: Account) -> None:
    put(account, "a")
    late = iter([("b",), ("c",)])
    VersionedBucket(account, NAME).empty(lambda _: put(account, *next(late, ())))
    assert left(account) == []


def test_only_keys_below_the_prefix_are_listed(account: Account) -> None:
    put(account, "maze/users/ann/1", "maze/users/anna/1", "maze/users/ann", "other/1")
    bucket = VersionedBucket(account, NAME)
    assert [one.key for one in bucket.versions("maze/users/ann/")] == ["maze/users/ann/1"]
    assert [one.key for one in bucket.versions_of("maze/users/ann")] == ["maze/users/ann"]
    assert sorted(bucket.folders()) == ["maze", "other"]


def test_unfinished_uploads_are_aborted(account: Account) -> None:
    s3 = account.client("s3")
    s3.create_multipart_upload(Bucket=NAME, Key="maze/users/ann/1")
    bucket = VersionedBucket(account, NAME)
    assert bucket.delete(bucket.uploads("maze/")) == 1
    assert [*bucket.uploads("maze/")] == []


def test_refused_deletions_are_reported_and_not_counted_as_deleted(
    account: Account, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(account, "a", "b", "c")
    monkeypatch.setattr(versioned, "BATCH", 2)
    versions = left(account)
    kept = versions[1]
    delete = account.client("s3").delete_objects

    def refusing(Delete: Any, **more: Any) -> Any:
        objects = [one for one in Delete["Objects"] if one["Key"] != kept.key]
        answer = delete(Delete={"Objects": objects}, **more) if objects else {}
        return answer | {"Errors": [{"Key": kept.key, "VersionId": kept.id, "Code": "AccessDenied"}]}

    monkeypatch.setattr(account.client("s3"), "delete_objects", refusing, raising=False)
    noted: list[Version] = []

    def note(batch: Sequence[Version]) -> None:
        noted.extend(batch)

    with pytest.raises(Problem, match="1 version in hippodrome-data could not be deleted: AccessDenied"):
        VersionedBucket(account, NAME).delete(versions, note)
    assert [one.key for one in noted] == ["a"]
    assert [one.key for one in left(account)] == ["b", "c"]


def test_a_delete_marker_and_a_version_that_is_gone_have_no_content(account: Account) -> None:
    put(account, "a")
    account.client("s3").delete_object(Bucket=NAME, Key="a")
    bucket = VersionedBucket(account, NAME)
    assert {one.marker: bucket.read(one) for one in bucket.versions()} == {False: b"x", True: b""}
    gone = [*bucket.versions()]
    bucket.empty()
    assert [bucket.read(one) for one in gone] == [b"", b""]
