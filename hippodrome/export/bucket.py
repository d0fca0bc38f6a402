"""An installation's bucket as a source of data."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from botocore.exceptions import (
    ClientError,
    ConnectionClosedError,
    IncompleteReadError,
    ReadTimeoutError,
    ResponseStreamingError,
)

from hippodrome.control.aws import errors
from hippodrome.control.aws.retry import retry_while_busy
from hippodrome.export.keys import Listed
from hippodrome.export.source import FileGone, TooLarge

_PIECE = 256 * 1024  # bytes
_CUT_OFF = (ConnectionClosedError, IncompleteReadError, ReadTimeoutError, ResponseStreamingError)


class Bucket:
    """An S3 bucket. botocore repeats requests after transient errors; this class repeats them if a body is cut off."""

    def __init__(self, client: Any, name: str, owner: str) -> None:
        self._client = client
        self._place = {"Bucket": name, "ExpectedBucketOwner": owner}
        self.where = self.place = f"bucket {name}"

    def list(self, prefix: str) -> Iterator[Listed]:
        pages = self._client.get_paginator("list_objects_v2").paginate(Prefix=prefix, **self._place)
        for page in pages:
            for line in page.get("Contents", ()):
                yield Listed(line["Key"], line["ETag"].strip('"'), line["Size"])

    def read(self, key: str, most: int) -> bytes:
        def whole() -> bytes:
            answer = self._get(Key=key)
            if answer["ContentLength"] > most:
                answer["Body"].close()
                raise TooLarge(key)
            body: bytes = answer["Body"].read()
            return body

        return retry_while_busy(whole, _is_cut_off, time.sleep)

    def fetch(self, listed: Listed, to: Path) -> None:
        def whole() -> None:
            answer = self._get(Key=listed.key, IfMatch=f'"{listed.version}"')
            with to.open("wb") as file:
                for piece in answer["Body"].iter_chunks(_PIECE):
                    file.write(piece)

        retry_while_busy(whole, _is_cut_off, time.sleep)

    def _get(self, **request: str) -> Any:
        try:
            return self._client.get_object(**request, **self._place)
        except ClientError as error:
            if errors.code(error) in {"NoSuchKey", "PreconditionFailed", "404", "412"}:
                raise FileGone(request["Key"]) from None
            raise


def _is_cut_off(error: Exception) -> bool:
    return isinstance(error, _CUT_OFF)
