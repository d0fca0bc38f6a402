"""Reads requests from events of API Gateway, and makes its responses: HTTP APIs (payloads 2.0 and 1.0) and REST APIs.

Formats: https://docs.aws.amazon.com/apigateway/latest/developerguide/http-api-develop-integrations-lambda.html and, of
REST APIs, https://docs.aws.amazon.com/apigateway/latest/developerguide/set-up-lambda-proxy-integrations.html
"""

from __future__ import annotations

import base64
import binascii
import gzip
import json
import re
from collections.abc import Iterable, Mapping
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
    """One HTTP request. `query` has every field in order; `body` is None if it could not be decoded.

    `path` is the path within the API. If the API has a named stage, clients may see another path: the gateway puts the
    stage in front, or a custom domain maps another path to it. The event does not say which
    (CodeGenieApp/serverless-express, issue 465), so `own_path` is False then.
    """

    method: str
    path: str
    query: tuple[tuple[str, str], ...] | None  # None: the query is malformed
    headers: Mapping[str, str] = field(repr=False)
    body: bytes | None = field(default=b"", repr=False)
    own_path: bool = True  # whether `path` is also the path that clients see
    binary: bool = True  # the gateway decodes responses in base64; a REST API does so only if it is told to

    @classmethod
    def from_event(cls, event: Mapping[str, Any]) -> Request:
        """Read an event of API Gateway. No request of a client makes this raise."""
        context = event.get("requestContext") or {}
        second = event.get("version") == "2.0" or "http" in context or "rawQueryString" in event
        method = (context.get("http") or {}).get("method") if second else event.get("httpMethod")
        rest = "httpMethod" in event and "version" not in event
        own_path = context.get("stage") in (None, "", "$default")
        return cls(
            method=str(method or context.get("httpMethod") or "GET").upper(),
            path=_path(event, "rawPath" if second else "path", own_path),
            query=_raw_query(event) if second else _parsed_query(event),
            headers=_headers(event),
            body=_body(event),
            own_path=own_path,
            binary=not rest,
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
        """Whether the client accepts gzip, and the gateway can return a binary body."""
        return self.binary and _GZIP.search(self.headers.get("accept-encoding", "").lower()) is not None

    def steps_folder(self, project_id: str) -> str:
        """Return the address of the project's files, relative to this request's address; it ends with a slash."""
        return f"{'/' if self.own_path else ''}steps/{project_id}/"

    def url(self, **changes: str) -> str:
        """Return this request's address, relative to the host, with these query fields set.

        The result goes into headers, so the path, which arrives decoded, is encoded again. It never begins with `//`,
        which would name another host. If `self.own_path` is False, the result is the query alone, which browsers add to
        the path that they see.
        """
        kept = [(key, value) for key, value in self.query or () if key not in changes]
        if not self.own_path:
            return f"?{urlencode([*kept, *changes.items()])}"
        path = quote("/" + self.path.lstrip("/\\"), safe="/:@!$&'()*+,;=~", errors="replace")
        return f"{path}?{urlencode([*kept, *changes.items()])}"


def _path(event: Mapping[str, Any], key: str, own_path: bool) -> str:
    """The path within the API. The route, if the event has it, says which part in front is a stage's or a domain's."""
    path = str(event.get(key) or "/")
    route = str(event.get("resource") or event.get("routeKey") or "").rpartition(" ")[2]
    if own_path or not route.startswith("/"):
        return path
    greedy = re.fullmatch(r"(.*/)\{(\w+)\+\}", route)
    if greedy:
        rest = (event.get("pathParameters") or {}).get(greedy[2])
        return path if rest is None else f"{greedy[1]}{rest}"
    count = route.rstrip("/").count("/")
    return "/" + "/".join(path.rstrip("/").split("/")[-count:] if count else ())


def _raw_query(event: Mapping[str, Any]) -> tuple[tuple[str, str], ...] | None:
    raw = event.get("rawQueryString") or ""
    try:
        raw.encode()  # half a surrogate pair could be neither stored nor sent back
        query = parse_qsl(raw, keep_blank_values=True, max_num_fields=MAX_QUERY_FIELDS, errors="strict")
    except ValueError:
        return None
    return _from_html(query)


def _parsed_query(event: Mapping[str, Any]) -> tuple[tuple[str, str], ...] | None:
    """The query of payload format 1.0, which arrives decoded. `queryStringParameters` has only one value per field."""
    several = event.get("multiValueQueryStringParameters") or {
        key: [value] for key, value in (event.get("queryStringParameters") or {}).items()
    }
    query = tuple((str(key), str(value)) for key, values in several.items() for value in values or ())
    try:
        for key, value in query:
            f"{key}{value}".encode()
    except ValueError:
        return None
    return _from_html(query) if len(query) <= MAX_QUERY_FIELDS else None


def _from_html(query: Iterable[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """The fields of a link that may have been copied from HTML, where `&` is written `&amp;`."""
    return tuple((re.sub(r"\A(?:amp;)+", "", name), value) for name, value in query)


def _headers(event: Mapping[str, Any]) -> dict[str, str]:
    """The headers, with names in lower case. Several values of one header are joined by commas, as in format 2.0.

    Bytes that are not UTF-8 arrive from a web server as halves of surrogate pairs; here each becomes a question mark.
    """
    several = {key: ",".join(map(str, values or ())) for key, values in (event.get("multiValueHeaders") or {}).items()}
    values = {**(event.get("headers") or {}), **several}
    return {str(key).lower(): str(value).encode("utf-8", "replace").decode() for key, value in values.items()}


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
