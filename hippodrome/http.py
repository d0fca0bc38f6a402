"""Requests and responses of API Gateway's HTTP API (payload format 2.0), as plain values.

Format: https://docs.aws.amazon.com/apigateway/latest/developerguide/http-api-develop-integrations-lambda.html
"""

from __future__ import annotations

import base64
import binascii
import gzip
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

MAX_QUERY_FIELDS = 64
MIN_GZIP_LENGTH = 1000  # characters

# HIPPO's front end is served from another origin. No cookie protects anything here, so any origin is allowed.
CORS = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Allow-Headers": "Content-Type",
    "Access-Control-Allow-Methods": "OPTIONS,GET,POST",
}
_GZIP = re.compile(r"(?:^|,)\s*gzip\s*(?:;\s*q=(?:1|0\.0*[1-9])[0-9.]*\s*)?(?:,|$)")
# Two years, without includeSubDomains: names below this one may belong to others (RFC 6797, section 6.1).
HSTS = {"Strict-Transport-Security": "max-age=63072000"}
_COMMON_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # links carry ids
    "Cache-Control": "private, no-cache",
}


@dataclass(frozen=True)
class Request:
    """One HTTP request. `query` has every field in order; `body` is None if it could not be decoded."""

    method: str
    path: str
    query: tuple[tuple[str, str], ...] | None  # None: malformed
    headers: Mapping[str, str] = field(repr=False)
    body: bytes | None = field(default=b"", repr=False)

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> Request:
        """Read an HTTP API event. Nothing that a client can send makes it raise."""
        http = event.get("requestContext", {}).get("http", {})
        raw = event.get("body") or ""
        body: bytes | None
        if event.get("isBase64Encoded"):
            try:
                body = base64.b64decode(raw, validate=True)
            except (binascii.Error, ValueError):
                body = None
        else:
            body = raw.encode("utf-8", "surrogatepass")
        raw_query = event.get("rawQueryString") or ""
        try:
            raw_query.encode()  # half a surrogate pair could be neither stored nor sent back
            query = parse_qsl(raw_query, keep_blank_values=True, max_num_fields=MAX_QUERY_FIELDS, errors="strict")
        except ValueError:
            query = None
        return cls(
            method=str(http.get("method", "GET")).upper(),
            path=str(event.get("rawPath") or "/"),
            query=None if query is None else tuple(query),
            headers={str(k).lower(): str(v) for k, v in (event.get("headers") or {}).items()},
            body=body,
        )

    def query_value(self, name: str) -> str | None:
        """The value of a query field; None if it is missing or given with two different values."""
        values = {value for key, value in self.query or () if key == name}
        return values.pop() if len(values) == 1 else None

    def has_query(self, name: str) -> bool:
        """Whether the query has this field."""
        return any(key == name for key, _ in self.query or ())

    @property
    def content_type(self) -> str:
        """The media type of the body in lower case, without parameters."""
        return self.headers.get("content-type", "").split(";")[0].strip().lower()

    @property
    def wants_json(self) -> bool:
        """Whether the client is a program, such as HIPPO's front end, and not a browser that opens a page."""
        accept = self.headers.get("accept", "")
        return "application/json" in accept and "text/html" not in accept

    @property
    def is_https(self) -> bool:
        """Whether the browser spoke TLS: API Gateway adds the header `x-forwarded-proto`."""
        return self.headers.get("x-forwarded-proto", "").strip().lower() == "https"

    @property
    def accepts_gzip(self) -> bool:
        """Whether the client accepts gzip."""
        return _GZIP.search(self.headers.get("accept-encoding", "").lower()) is not None

    def url(self, **changes: str) -> str:
        """This request's address, relative to the host, with these query fields set.

        `path` arrives decoded and goes into headers, so it is encoded again. It never begins with `//`, which would
        name another host.
        """
        kept = [(key, value) for key, value in self.query or () if key not in changes]
        path = quote("/" + self.path.lstrip("/\\"), safe="/:@!$&'()*+,;=~", errors="replace")
        return f"{path}?{urlencode([*kept, *changes.items()])}"


@dataclass(frozen=True)
class Response:
    """One HTTP response."""

    status: int
    body: bytes | str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    def to_event(self, compress: bool = False, *, https: bool = False) -> dict[str, Any]:
        """The response in the format of API Gateway, which does not compress: with `compress`, long texts are in gzip.

        With `https`, the header HSTS is set. A response over plain HTTP must not have it (RFC 6797, section 7.2).
        """
        headers, body = {**_COMMON_HEADERS, **(HSTS if https else {}), **self.headers}, self.body
        if compress and isinstance(body, str) and len(body) > MIN_GZIP_LENGTH:
            headers |= {"Content-Encoding": "gzip", "Vary": "Accept-Encoding"}
            body = gzip.compress(body.encode(), compresslevel=6, mtime=0)
        text = isinstance(body, str)
        return {
            "statusCode": self.status,
            "headers": headers,
            "body": body if isinstance(body, str) else base64.b64encode(body).decode(),
            "isBase64Encoded": not text,
        }


def html(status: int, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """A response with a page."""
    return Response(status, text, {"Content-Type": "text/html; charset=utf-8", **(headers or {})})


def as_json(status: int, data: Any) -> Response:
    """A response with JSON, which pages of any origin may read."""
    return Response(status, json.dumps(data), {"Content-Type": "application/json", **CORS})


def see_other(url: str) -> Response:
    """303: the client continues at `url` with a GET."""
    return Response(303, "", {"Location": url})


def found(url: str) -> Response:
    """302: the client repeats its request at `url`."""
    return Response(302, "", {"Location": url})
