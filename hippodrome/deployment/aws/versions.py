"""Lists the versions, delete markers and unfinished uploads of a versioned bucket, and deletes them for good.

Facts (S3 API Reference, read November 2026): a versioned bucket keeps a deleted object until each of its versions is
deleted by its id; in a bucket without versioning the id is "null". DeleteObjects takes 1,000 keys. It answers 200 and
lists in `Errors` what it has not deleted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.object_version import Version

BATCH = 1_000  # versions deleted by one call
_PIECE = 256 * 1024  # bytes


class VersionedBucket:
    """A bucket of the account. Every request names the account that must own it."""

    def __init__(self, account: Account, name: str) -> None:
        self.name = name
        self._s3 = account.client("s3")
        self._bucket = {"Bucket": name, "ExpectedBucketOwner": account.id}

    def versions(self, prefix: str = "") -> Iterator[Version]:
        """Yield every version and delete marker whose key has this prefix. A request lists 1,000 of them."""
        for page in self._s3.get_paginator("list_object_versions").paginate(Prefix=prefix, **self._bucket):
            for line in page.get("Versions", ()):
                yield Version(line["Key"], line["VersionId"], line["Size"], latest=line["IsLatest"])
            for line in page.get("DeleteMarkers", ()):
                yield Version(line["Key"], line["VersionId"], marker=True, latest=line["IsLatest"])

    def versions_of(self, key: str) -> Iterator[Version]:
        """Return every version and delete marker of one object."""
        return (version for version in self.versions(key) if version.key == key)

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Yield every unfinished upload whose key has this prefix."""
        for page in self._s3.get_paginator("list_multipart_uploads").paginate(Prefix=prefix, **self._bucket):
            for line in page.get("Uploads", ()):
                yield Version(line["Key"], "", upload=line["UploadId"])

    def folders(self) -> Iterator[str]:
        """Yield the top-level folders of all keys that have a version, without the slash."""
        for page in self._s3.get_paginator("list_object_versions").paginate(Delimiter="/", **self._bucket):
            yield from (line["Prefix"].removesuffix("/") for line in page.get("CommonPrefixes", ()))

    def read(self, version: Version) -> bytes:
        """Return the content of a version; empty if the version is gone or is a delete marker."""
        try:
            return bytes(self._get(version)["Body"].read())
        except ClientError as error:
            # S3 answers 405 for a delete marker, with the code MethodNotAllowed (API Reference, GetObject).
            if errors.status(error) == 405 or errors.code(error) in {"NoSuchKey", "NoSuchVersion", "404"}:
                return b""
            raise

    def fetch(self, version: Version, to: Path) -> None:
        """Write the content of a version into a file."""
        with to.open("wb") as file:
            for piece in self._get(version)["Body"].iter_chunks(_PIECE):
                file.write(piece)

    def store(self, key: str, file: Path) -> None:
        """Store a file as a new version of an object, in one PUT, which is enough for the largest recording."""
        with file.open("rb") as body:
            self._s3.put_object(Key=key, Body=body, **self._bucket)

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Store a new version of a small object if its newest version is still `before`.

        Return whether it was stored.
        """
        try:
            answer = self._s3.get_object(Key=key, **self._bucket)
            if answer["Body"].read() != before:
                return False
            self._s3.put_object(Key=key, Body=after, IfMatch=answer["ETag"], **self._bucket)
        except ClientError as error:
            if errors.code(error) in {"PreconditionFailed", "ConditionalRequestConflict", "NoSuchKey", "404"}:
                return False
            raise
        return True

    def _get(self, version: Version) -> Any:
        return self._s3.get_object(Key=version.key, VersionId=version.id, **self._bucket)

    def delete(self, versions: Iterable[Version], note: Callable[[Sequence[Version]], None] = lambda _: None) -> int:
        """Delete these versions for good, and return how many. `note` gets the deleted versions after each request.

        Raises `Problem` if S3 refuses some of them.
        """
        rest, deleted = iter(versions), 0
        while batch := list(islice(rest, BATCH)):
            self._delete_batch(batch, note)
            deleted += len(batch)
        return deleted

    def empty(self, note: Callable[[Sequence[Version]], None] = lambda _: None) -> None:
        """Delete every version until a listing finds none. Raises `Problem` if S3 refuses to delete some."""
        while self.delete(self.versions(), note):
            pass

    def _delete_batch(self, batch: Sequence[Version], note: Callable[[Sequence[Version]], None]) -> None:
        for version in batch:
            if version.upload:
                self._s3.abort_multipart_upload(Key=version.key, UploadId=version.upload, **self._bucket)
        objects = [{"Key": version.key, "VersionId": version.id} for version in batch if not version.upload]
        answer = self._s3.delete_objects(Delete={"Objects": objects, "Quiet": True}, **self._bucket) if objects else {}
        refused = {(line.get("Key"), line.get("VersionId")): str(line.get("Code")) for line in answer.get("Errors", ())}
        note([version for version in batch if (version.key, version.id) not in refused])
        if refused:
            codes = ", ".join(sorted(set(refused.values())))
            raise Problem(
                f"{count(len(refused), 'version')} in {self.name} could not be deleted: {codes}.",
                "These credentials need s3:DeleteObjectVersion, and nothing may be under an object lock.",
            )
