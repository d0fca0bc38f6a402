"""Reads and writes documents in an S3 bucket, with S3's conditional writes.

Facts (S3 User Guide, "How to prevent object overwrites with conditional writes", read November 2026): S3 answers 412 if
the condition fails, 409 ConditionalRequestConflict if another write of the same key is under way (this one wrote
nothing then), and 404 to `If-Match` on a deleted key. A GET of a missing key gets 404 only if the caller has
`s3:ListBucket`. Otherwise it gets 403, which is raised unchanged.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from datetime import UTC
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.ports import Conflict, Document, Entry

MAX_WRITES = 4  # attempts at a write that S3 answers with 409
PAUSE = 0.05  # seconds until the second attempt; doubled after each 409, and half of each pause is random

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
    """Return the Content-Type of a document by its key's suffix; `application/octet-stream` for other suffixes."""
    return CONTENT_TYPES.get(key.rpartition("/")[2].rpartition(".")[2].lower(), "application/octet-stream")


class S3Documents:
    """Implements `hippodrome.control.ports.Documents` in one bucket. ETags are S3's, quotation marks included.

    If a reply is lost, botocore sends the write again, and S3 may answer 412 although the first write succeeded. This
    raises `Conflict` too, so the caller must read the document before it concludes that another writer won.
    """

    def __init__(self, client: Callable[[], Any], bucket: str) -> None:
        self._client = client
        self.bucket = bucket

    def get(self, key: str, known: Document | None = None) -> Document | None:
        """Return the document; None if it is missing; `known` itself if it has not changed since (304).

        AWS calls: one GetObject.
        """
        condition = {"IfNoneMatch": known.etag} if known else {}
        try:
            answer = self._client().get_object(Bucket=self.bucket, Key=key, **condition)
        except ClientError as error:
            if known and errors.status(error) == 304:
                return known
            if errors.code(error) == "NoSuchKey":
                return None
            raise
        return Document(answer["Body"].read(), answer["ETag"])

    def create(self, key: str, body: bytes) -> str:
        return self._put(key, body, {"IfNoneMatch": "*"})

    def replace(self, key: str, body: bytes, etag: str) -> str:
        return self._put(key, body, {"IfMatch": etag})

    def put(self, key: str, body: bytes) -> None:
        self._put(key, body, {})

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield an entry for each key with this prefix, in the order of the keys.

        AWS calls: one ListObjectsV2 for each 1,000 keys, sent when the caller has taken the keys before.
        """
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
