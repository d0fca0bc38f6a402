"""Does what API Gateway does: it makes events of requests for the functions, and responses of what these return.

The events have the payload format 2.0 of HTTP APIs:
https://docs.aws.amazon.com/apigateway/latest/developerguide/http-api-develop-integrations-lambda.html
That page does not say how `rawPath` and bodies are coded. Others have measured it on AWS: `rawPath` is decoded; a body
is text only if its content type is `text/*`, JSON, XML or JavaScript, so that forms arrive in base64 (ministack pull
request 766, middleapi/standard-server pull request 93).
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping, MutableMapping
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

_HOST = "127.0.0.1"  # the address of a client that has none

Scope = MutableMapping[str, Any]

_TEXT = re.compile(r"text/.*|application/(json|xml|javascript)")


class Route(NamedTuple):
    """The requests that a function answers. `{name}` in the path stands for one segment."""

    methods: tuple[str, ...]
    path: str
    function: str

    def match(self, method: str, path: str) -> dict[str, str] | None:
        """Return the path parameters of a request for this route; None if it is for another route."""
        pattern = re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(self.path))
        match = re.fullmatch(pattern, path) if method in self.methods else None
        return match.groupdict() if match else None


ROUTES = (
    Route(("GET", "HEAD", "POST", "OPTIONS"), "/next", "next_step"),
    Route(("GET", "HEAD"), "/steps/{projectId}/{file}", "next_step"),
    Route(("GET", "HEAD"), "/", "next_step"),
    Route(("GET", "POST", "OPTIONS"), "/start", "send_start_server_message"),
    Route(("GET", "POST", "OPTIONS"), "/stop", "send_stop_server_message"),
)
"""The routes of the site, as on AWS."""
LAB_ROUTES = (Route(("GET", "HEAD"), "/join/{projectId}", "join"), Route(("GET", "HEAD"), "/lab", "lab"))
"""Those that only a lab's server has beside them (`local/lab.py`)."""


class GatewayResponse(NamedTuple):
    """The status, headers and body that a function returns. The names of headers are in lower case."""

    status: int
    headers: dict[str, str]
    body: bytes


def headers_of(scope: Scope) -> list[tuple[str, str]]:
    """Return the headers of a request. Their names are in lower case."""
    return [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]


def joined(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the values by their names. Values of the same name are joined by commas, as API Gateway does."""
    fields: dict[str, str] = {}
    for name, value in pairs:
        fields[name] = f"{fields[name]},{value}" if name in fields else value
    return fields


def event_of(scope: Scope, body: bytes, route: Route, parameters: Mapping[str, str]) -> dict[str, Any]:
    """Return the event of payload format 2.0 for this request, with the fields that functions read."""
    headers = joined(headers_of(scope))
    raw_query = scope["query_string"].decode("latin-1")
    query = joined(parse_qsl(raw_query, keep_blank_values=True))
    http = {
        "method": scope["method"],
        "path": scope["path"],
        "sourceIp": (scope.get("client") or (_HOST,))[0],
    }
    event: dict[str, Any] = {
        "version": "2.0",
        "routeKey": f"{scope['method']} {route.path}",
        "rawPath": scope["path"],
        "rawQueryString": raw_query,
        "headers": headers,
        "requestContext": {"http": http},
        "isBase64Encoded": False,
    }
    if query:
        event["queryStringParameters"] = query
    if parameters:
        event["pathParameters"] = dict(parameters)
    if body:
        text = _text(body, headers.get("content-type", ""))
        event["isBase64Encoded"] = text is None
        event["body"] = base64.b64encode(body).decode() if text is None else text
    return event


def answer_of(result: Any) -> GatewayResponse:
    """Return the response that API Gateway makes of a function's result.

    Raises an exception where API Gateway would send a 500.
    """
    if not isinstance(result, dict) or "statusCode" not in result:
        return json_answer(200, result)
    body = result.get("body") or ""
    data = base64.b64decode(body, validate=True) if result.get("isBase64Encoded") else str(body).encode()
    headers = {str(name).lower(): str(value) for name, value in (result.get("headers") or {}).items()}
    for set_here in ("content-length", "transfer-encoding", "connection"):
        headers.pop(set_here, None)
    return GatewayResponse(int(result["statusCode"]), {"content-type": "text/plain; charset=utf-8", **headers}, data)


def _text(body: bytes, content_type: str) -> str | None:
    """The body as text; None if the event has it in base64."""
    if not _TEXT.fullmatch(content_type.partition(";")[0].strip().lower()):
        return None
    try:
        return body.decode()
    except UnicodeDecodeError:
        return None


def json_answer(status: int, data: Any) -> GatewayResponse:
    """Return a response with JSON."""
    return GatewayResponse(status, {"content-type": "application/json"}, json.dumps(data).encode())
