"""Makes presigned requests of S3 with Signature Version 4.

Facts. A presigned request has the rights of its signer, and expires at the latest with the signer's credentials (S3
User Guide, "Download and upload objects with presigned URLs", read November 2026). The sender must send every signed
header with exactly the signed value. `generate_presigned_url` uses Signature Version 2 by default, which silently
leaves out conditions such as `If-None-Match` (boto3 issue 4367), so this module signs requests itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import quote, urlsplit

from botocore.auth import S3SigV4QueryAuth
from botocore.awsrequest import AWSRequest

from hippodrome.control.aws.documents import content_type
from hippodrome.control.servers.signing import Presigned


class S3Signer:
    """Implements `hippodrome.control.servers.signing.Signer` for the documents of one bucket. Makes no AWS call."""

    def __init__(self, client: Callable[[], Any], credentials: Callable[[], Any], bucket: str) -> None:
        """`credentials` returns the present frozen credentials: a role's change while its function lives."""
        self._client = client
        self._credentials = credentials
        self._bucket = bucket

    def presign_get(self, key: str, seconds: int) -> Presigned:
        return self._signed("GET", key, {}, seconds)

    def presign_put(self, key: str, size: int, seconds: int) -> Presigned:
        """Sign the condition and the length too: the request overwrites nothing and carries exactly `size` bytes."""
        headers = {"Content-Length": str(size), "Content-Type": content_type(key), "If-None-Match": "*"}
        return self._signed("PUT", key, headers, seconds)

    def _signed(self, method: str, key: str, headers: dict[str, str], seconds: int) -> Presigned:
        meta = self._client().meta
        request = AWSRequest(method=method, url=self._url(meta.endpoint_url, key), headers=headers)
        S3SigV4QueryAuth(self._credentials(), "s3", meta.region_name, expires=seconds).add_auth(request)
        return Presigned(method, request.url, headers)

    def _url(self, endpoint: str, key: str) -> str:
        """The URL of the document: the bucket is part of the host on AWS, and of the path on emulators."""
        parts = urlsplit(endpoint)
        path = quote(key, safe="/~")
        if (parts.hostname or "").endswith((".amazonaws.com", ".amazonaws.com.cn")) and "." not in self._bucket:
            return f"{parts.scheme}://{self._bucket}.{parts.netloc}/{path}"
        return f"{parts.scheme}://{parts.netloc}/{self._bucket}/{path}"
