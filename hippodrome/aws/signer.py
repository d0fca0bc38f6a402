"""Presigned requests of S3, by Signature Version 4.

Facts. A presigned request has the rights of who signed it, and ends at the latest when the signer's own credentials end
(S3 User Guide, "Download and upload objects with presigned URLs", read November 2026). Whoever uses one must send every
signed header with the very value that was signed. `generate_presigned_url` signs by Signature Version 2 unless it is
told otherwise, and that version leaves conditions such as `If-None-Match` out without a word (boto3 issue 4367); so
nothing is left to the client's defaults here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import quote, urlsplit

from botocore.auth import S3SigV4QueryAuth
from botocore.awsrequest import AWSRequest

from hippodrome.aws.documents import content_type
from hippodrome.servers.signing import Presigned


class S3Signer:
    """Implements `hippodrome.servers.signing.Signer` for the documents of one bucket. No call is made."""

    def __init__(self, client: Callable[[], Any], credentials: Callable[[], Any], bucket: str) -> None:
        """`credentials`: the present ones, frozen; those of a role change while a function lives."""
        self._client = client
        self._credentials = credentials
        self._bucket = bucket

    def reading(self, key: str, seconds: int) -> Presigned:
        return self._signed("GET", key, {}, seconds)

    def creating(self, key: str, size: int, seconds: int) -> Presigned:
        """Its condition and its length are signed too: it overwrites nothing, and takes no other number of bytes."""
        headers = {"Content-Length": str(size), "Content-Type": content_type(key), "If-None-Match": "*"}
        return self._signed("PUT", key, headers, seconds)

    def _signed(self, method: str, key: str, headers: dict[str, str], seconds: int) -> Presigned:
        meta = self._client().meta
        request = AWSRequest(method=method, url=self._address(meta.endpoint_url, key), headers=headers)
        S3SigV4QueryAuth(self._credentials(), "s3", meta.region_name, expires=seconds).add_auth(request)
        return Presigned(method, request.url, headers)

    def _address(self, endpoint: str, key: str) -> str:
        """The bucket is part of the host on AWS, and of the path on emulators, whose hosts have one name."""
        parts = urlsplit(endpoint)
        path = quote(key, safe="/~")
        if (parts.hostname or "").endswith((".amazonaws.com", ".amazonaws.com.cn")) and "." not in self._bucket:
            return f"{parts.scheme}://{self._bucket}.{parts.netloc}/{path}"
        return f"{parts.scheme}://{parts.netloc}/{self._bucket}/{path}"
