"""Where documents are stored, always under the same keys: a bucket or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from protocol import disk
from trial.recordings.presigned import PresignedStore


class Store(Protocol):
    """Blocking calls; use them off the event loop. They raise OSError or the S3 client's errors."""

    def get(self, key: str) -> bytes | None:
        """The document, or None if there is none."""
        ...

    def look(self, key: str) -> bytes | None:
        """The same, of a document that is read every few seconds; tries once."""
        ...

    def create(self, key: str, data: bytes | Path) -> bool:
        """Store bytes or a file's content; False, and nothing changed, if the key exists."""
        ...


def open_store(place: str, server: str = "", credential: str = "") -> Store:
    """The store behind the address that signs requests, at `s3://bucket` (or `s3://bucket/prefix`), or in a folder."""
    if place.startswith(("https://", "http://")):
        return PresignedStore(place, server, credential)
    if place.startswith("s3://"):
        bucket, _, prefix = place[5:].partition("/")
        return S3Store(bucket, prefix)
    return FolderStore(Path(place).resolve())


def short_error(error: BaseException) -> str:
    """A store's error for the log, without the names of files and keys, which hold participants' ids."""
    if isinstance(error, OSError):
        return f"{type(error).__name__}: {error.strerror}"
    response: Any = getattr(error, "response", None)
    code = response.get("Error", {}).get("Code") if isinstance(response, dict) else None
    return type(error).__name__ if code is None else f"{type(error).__name__}: {code}"


class FolderStore:
    """Files under one folder. A file appears whole or not at all; once created, it outlives a power cut."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> bytes | None:
        try:
            return (self.folder / key).read_bytes()
        except FileNotFoundError:
            return None

    def look(self, key: str) -> bytes | None:
        return self.get(key)

    def create(self, key: str, data: bytes | Path) -> bool:
        path = self.folder / key
        disk.make_folder(path.parent)
        try:
            disk.create(path, data)
        except FileExistsError:
            return False
        return True


class S3Store:
    """Objects of one bucket. Credentials and region come from the environment, as boto3 finds them."""

    def __init__(self, bucket: str, prefix: str = "") -> None:
        import boto3  # noqa: PLC0415 - slow to import, and not needed with a folder
        from botocore.config import Config  # noqa: PLC0415

        self._bucket = bucket
        self._prefix = f"{prefix.strip('/')}/" if prefix.strip("/") else ""
        self._client: Any = boto3.client(
            "s3", config=Config(connect_timeout=5, read_timeout=20, retries={"mode": "standard", "max_attempts": 2})
        )

    def get(self, key: str) -> bytes | None:
        from botocore.exceptions import ClientError  # noqa: PLC0415

        try:
            answer = self._client.get_object(Bucket=self._bucket, Key=self._prefix + key)
        except ClientError as error:
            # Without the right to list the bucket, which trials lack, S3 answers AccessDenied for a missing key.
            if error.response["Error"]["Code"] in ("NoSuchKey", "AccessDenied"):
                return None
            raise
        body: bytes = answer["Body"].read()
        return body

    def look(self, key: str) -> bytes | None:
        return self.get(key)

    def create(self, key: str, data: bytes | Path) -> bool:
        from botocore.exceptions import ClientError  # noqa: PLC0415

        try:
            if isinstance(data, Path):
                with data.open("rb") as body:
                    self._put(key, body, "application/gzip")
            else:
                self._put(key, data, "application/json")
        except ClientError as error:
            # 409 means that two writers met; the caller tries again.
            if error.response.get("ResponseMetadata", {}).get("HTTPStatusCode") == 412:
                return False
            raise
        return True

    def _put(self, key: str, body: Any, kind: str) -> None:
        self._client.put_object(
            Bucket=self._bucket, Key=self._prefix + key, Body=body, ContentType=kind, IfNoneMatch="*"
        )
