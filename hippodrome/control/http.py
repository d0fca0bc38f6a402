"""Reads requests from events of API Gateway's HTTP APIs, and makes its responses, both of payload format 2.0.

https://docs.aws.amazon.com/apigateway/latest/developerguide/http-api-develop-integrations-lambda.html
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

MAX_QUERY_FIELDS = 64  # a query with more fields is malformed
MIN_GZIP_LENGTH = 1000  # characters; shorter responses are not compressed

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
    query: tuple[tuple[str, str], ...] | None  # None: the query is malformed
    headers: Mapping[str, str] = field(repr=False)
    body: bytes | None = field(default=b"", repr=False)
    source: str = field(default="", repr=False)  # the address that the request comes from

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> Request:
        """Read an event of API Gateway. No request of a client makes this raise."""
        http = (event.get("requestContext") or {}).get("http") or {}
        return cls(
            method=str(http.get("method") or "GET").upper(),
            path=str(event.get("rawPath") or "/"),
            query=_query(event),
            headers=_headers(event),
            body=_body(event),
            source=str(http.get("sourceIp") or ""),
        )

    def query_value(self, name: str) -> str | None:
        """Return the value of a query field; None if the field is missing, or given with two different values."""
        values = {value for key, value in self.query or () if key == name}
        return values.pop() if len(values) == 1 else None

    def has_query(self, name: str) -> bool:
        """Return whether the query has this field."""
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
    def is_front_end(self) -> bool:
        """Whether a page of another site, such as HIPPO's front end, asks for JSON: browsers send its origin then.

        They send no such header with a GET to the page's own site (Fetch, 3.1, "append a request Origin header").
        """
        return self.wants_json and "origin" in self.headers

    @property
    def is_https(self) -> bool:
        """Whether the browser spoke TLS: API Gateway adds the header `x-forwarded-proto`."""
        return self.headers.get("x-forwarded-proto", "").strip().lower() == "https"

    @property
    def accepts_gzip(self) -> bool:
        """Whether the client accepts gzip."""
        return _GZIP.search(self.headers.get("accept-encoding", "").lower()) is not None

    def url(self, **changes: str) -> str:
        """Return this request's address, relative to the host, with these query fields set.

        The result goes into headers, so the path, which arrives decoded, is encoded again. It never begins with `//`,
        which would name another host.
        """
        unchanged = [(key, value) for key, value in self.query or () if key not in changes]
        path = quote("/" + self.path.lstrip("/\\"), safe="/:@!$&'()*+,;=~", errors="replace")
        return f"{path}?{urlencode([*unchanged, *changes.items()])}"


def _query(event: Mapping[str, Any]) -> tuple[tuple[str, str], ...] | None:
    """The fields of the query. A link may have been copied from HTML, where `&` is written `&amp;`."""
    raw = event.get("rawQueryString") or ""
    try:
        raw.encode()  # half a surrogate pair could be neither stored nor sent back
        query = parse_qsl(raw, keep_blank_values=True, max_num_fields=MAX_QUERY_FIELDS, errors="strict")
    except ValueError:
        return None
    return tuple((re.sub(r"\A(?:amp;)+", "", name), value) for name, value in query)


def _headers(event: Mapping[str, Any]) -> dict[str, str]:
    """The headers, with names in lower case.

    Bytes that are not UTF-8 arrive from a web server as halves of surrogate pairs; here each becomes a question mark.
    """
    headers = event.get("headers") or {}
    return {str(key).lower(): str(value).encode("utf-8", "replace").decode() for key, value in headers.items()}


def _body(event: Mapping[str, Any]) -> bytes | None:
    raw = str(event.get("body") or "")
    if not event.get("isBase64Encoded"):
        return raw.encode("utf-8", "surrogatepass")
    try:
        return base64.b64decode(raw, validate=True)
    except (binascii.Error, ValueError):
        return None


@dataclass(frozen=True)
class Response:
    """One HTTP response."""

    status: int
    body: bytes | str = ""
    headers: Mapping[str, str] = field(default_factory=dict)

    def to_event(self, compress: bool = False, *, https: bool = False) -> dict[str, Any]:
        """Return the response in API Gateway's format.

        With `compress` a long text is compressed with gzip, because API Gateway's HTTP APIs compress nothing
        themselves. With `https` the response gets the header HSTS, which a response over plain HTTP must not have (RFC
        6797, section 7.2).
        """
        headers, body = {**_COMMON_HEADERS, **(HSTS if https else {}), **self.headers}, self.body
        if compress and isinstance(body, str) and len(body) > MIN_GZIP_LENGTH:
            headers |= {"Content-Encoding": "gzip", "Vary": "Accept-Encoding"}
            body = gzip.compress(body.encode(), compresslevel=6, mtime=0)
        return {
            "statusCode": self.status,
            "headers": headers,
            "body": body if isinstance(body, str) else base64.b64encode(body).decode(),
            "isBase64Encoded": not isinstance(body, str),
        }


class Refusal(Exception):
    """A request is refused with this HTTP status and this sentence, which repeats nothing of the request."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text


def html(status: int, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return a response with a page."""
    return Response(status, text, {"Content-Type": "text/html; charset=utf-8", **(headers or {})})


def as_json(status: int, data: Any) -> Response:
    """Return a response with JSON, which pages of any origin may read."""
    return Response(status, json.dumps(data), {"Content-Type": "application/json", **CORS})


def see_other(url: str) -> Response:
    """Return a response with status 303: the client continues at `url` with a GET."""
    return Response(303, "", {"Location": url})


def found(url: str) -> Response:
    """Return a response with status 302: the client continues at `url`, a browser with a GET."""
    return Response(302, "", {"Location": url})
