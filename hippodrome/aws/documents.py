"""Documents on S3, with its conditional writes.

Facts (S3 User Guide, "How to prevent object overwrites with conditional writes", read November 2026): a failed
condition is 412; a write concurrent with another of the same key is 409 ConditionalRequestConflict and wrote nothing;
`If-Match` on a deleted key is 404. Reading a missing key is 404 only for callers with `s3:ListBucket`; without that
permission it is 403, which is raised unchanged.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from datetime import UTC
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.aws import errors
from hippodrome.ports import Conflict, Document, Entry

MAX_WRITES = 4  # attempts at a write that is concurrent with others
PAUSE = 0.05  # seconds; doubled after each 409, half of it random

CONTENT_TYPES = {
    "json": "application/json",
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "txt": "text/plain; charset=utf-8",
    "md": "text/markdown; charset=utf-8",
    "csv": "text/csv; charset=utf-8",
    "py": "text/x-python; charset=utf-8",
    "yml": "application/yaml",
    "gz": "application/gzip",
    "zip": "application/zip",
    "pdf": "application/pdf",
    "png": "image/png",
    "jpg": "image/jpeg",
    "jpeg": "image/jpeg",
    "gif": "image/gif",
    "webp": "image/webp",
    "svg": "image/svg+xml",
    "mp4": "video/mp4",
    "webm": "video/webm",
}


def content_type(key: str) -> str:
    """The Content-Type of a document, by the suffix of its key."""
    return CONTENT_TYPES.get(key.rpartition("/")[2].rpartition(".")[2].lower(), "application/octet-stream")


class S3Documents:
    """Implements `hippodrome.ports.Documents` in one bucket. ETags are S3's, quotation marks included.

    After a lost reply botocore sends a write again, and S3 may then answer 412 to the very writer that succeeded. That
    is a `Conflict` here too: the caller must read the document again before it concludes that another writer won.
    """

    def __init__(self, client: Callable[[], Any], bucket: str) -> None:
        self._client = client
        self.bucket = bucket

    def get(self, key: str, known: Document | None = None) -> Document | None:
        """The document, or None; `known` itself if it has not changed (304, without a body)."""
        condition = {"IfNoneMatch": known.etag} if known else {}
        try:
            found = self._client().get_object(Bucket=self.bucket, Key=key, **condition)
        except ClientError as error:
            if known and errors.status(error) == 304:
                return known
            if errors.code(error) == "NoSuchKey":
                return None
            raise
        return Document(found["Body"].read(), found["ETag"])

    def create(self, key: str, body: bytes) -> str:
        return self._put(key, body, {"IfNoneMatch": "*"})

    def replace(self, key: str, body: bytes, etag: str) -> str:
        return self._put(key, body, {"IfMatch": etag})

    def put(self, key: str, body: bytes) -> None:
        self._put(key, body, {})

    def list(self, prefix: str) -> Iterator[Entry]:
        """One request for each 1,000 keys, sent when the keys before were taken."""
        pages = self._client().get_paginator("list_objects_v2").paginate(Bucket=self.bucket, Prefix=prefix)
        for page in pages:
            for line in page.get("Contents", ()):
                yield Entry(line["Key"], line["LastModified"].astimezone(UTC), line["Size"])

    def delete(self, key: str) -> None:
        self._client().delete_object(Bucket=self.bucket, Key=key)

    def _put(self, key: str, body: bytes, condition: dict[str, str]) -> str:
        request = {"Bucket": self.bucket, "Key": key, "Body": body, "ContentType": content_type(key), **condition}
        for attempt in range(MAX_WRITES):
            try:
                return str(self._client().put_object(**request)["ETag"])
            except ClientError as error:
                if errors.status(error) == 412 or errors.code(error) == "NoSuchKey":
                    raise Conflict(key) from error
                if errors.status(error) != 409:
                    raise
            if attempt + 1 < MAX_WRITES:
                time.sleep(PAUSE * 2**attempt * (0.5 + random.random() / 2))  # noqa: S311 - spreads writers, guards nothing
        raise Conflict(key)
