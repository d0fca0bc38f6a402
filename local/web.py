"""The web server: requests become API Gateway events for the functions, and their answers responses.

What the events look like was taken from payload format 2.0 of HTTP APIs:
https://docs.aws.amazon.com/apigateway/latest/developerguide/http-api-develop-integrations-lambda.html
and, where that page is silent, from what others measured on AWS: `rawPath` is decoded; a body is text only if it is
`text/*` or JSON, XML or JavaScript by its content type, so that forms arrive in base64 (ministack pull request 766,
middleapi/standard-server pull request 93).
"""

from __future__ import annotations

import asyncio
import base64
import errno
import json
import re
import socket
import threading
import time
import traceback
import uuid
from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

import uvicorn

from hippodrome.participants import pages
from local import guard
from local.connections import Connection

HOST = "127.0.0.1"
LARGEST_BODY = 10 * 1024 * 1024
THREADS = 32
PORTS_TRIED = 20
_NO_MORE = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)  # what accept(2) refuses until there is room
_TEXT = re.compile(r"text/.*|application/(json|xml|javascript)")

Handler = Callable[[dict[str, Any], object], Any]
Say = Callable[[str], None]
Refused = Callable[[BaseException], None]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


class Route(NamedTuple):
    """Which requests go to which function. `{name}` in the path stands for one segment."""

    methods: tuple[str, ...]
    path: str
    function: str

    def match(self, method: str, path: str) -> dict[str, str] | None:
        """The path parameters if the request is for this route."""
        pattern = re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]+)", re.escape(self.path))
        found = re.fullmatch(pattern, path) if method in self.methods else None
        return found.groupdict() if found else None


ROUTES = (
    Route(("GET", "HEAD", "POST", "OPTIONS"), "/next", "next_step"),
    Route(("GET", "HEAD"), "/steps/{projectId}/{file}", "next_step"),
    Route(("GET", "HEAD"), "/", "next_step"),
    Route(("POST", "OPTIONS"), "/start", "send_start_server_message"),
    Route(("POST", "OPTIONS"), "/stop", "send_stop_server_message"),
)


class Answer(NamedTuple):
    """What goes back over the wire."""

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes


class App:
    """The ASGI application. `functions` are the handlers by name; pages of `origins` may ask as our own do."""

    def __init__(self, functions: Mapping[str, Handler], say: Say = print, origins: Collection[str] = ()) -> None:
        self._functions = functions
        self._say = say
        self._origins = frozenset(origins)
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="function")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        answer = await self._answer(scope, receive)
        if answer is None:
            return
        headers = [*self._leaving(scope, answer.headers), (b"content-length", str(len(answer.body)).encode())]
        await send({"type": "http.response.start", "status": answer.status, "headers": headers})
        body = b"" if scope["method"] == "HEAD" else answer.body
        await send({"type": "http.response.body", "body": body})

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _answer(self, scope: Scope, receive: Receive) -> Answer | None:
        """The answer; None if the client has gone."""
        path = scope["path"]
        if path == "/next/":
            path = "/next"
            scope = {**scope, "path": path}
        if path == "/healthz":
            return _plain(200, "ok\n")
        refused = guard.refusal(scope["method"], path, _headers(scope), self._origins)
        if refused:
            return _plain(403, f"{refused}\n")
        for route in ROUTES:
            parameters = route.match(scope["method"], path)
            if parameters is not None:
                break
        else:
            return _nothing_here(scope)
        body = await _body(receive)
        if body is None:
            return None
        if len(body) > LARGEST_BODY:
            return _plain(413, "Request Entity Too Large\n")
        event = event_of(scope, body, route, parameters)
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._call, self._functions[route.function], event)

    def _leaving(self, scope: Scope, headers: Sequence[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        """An answer's headers as they leave this machine (`guard.headers_for`)."""
        cookies = [(name, value) for name, value in headers if name == b"set-cookie"]
        others = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in headers if name != b"set-cookie"]
        kept = guard.headers_for(_headers(scope).get("origin"), others, self._origins)
        return [(name.encode("latin-1"), value.encode("latin-1")) for name, value in kept.items()] + cookies

    def _call(self, handler: Handler, event: dict[str, Any]) -> Answer:
        try:
            return answer_of(handler(event, None))
        except Exception:  # noqa: BLE001 - as API Gateway: the participant learns nothing of it
            self._say(f"a function failed:\n{traceback.format_exc().rstrip()}")
            return _message(500, "Internal Server Error")


def _headers(scope: Scope) -> dict[str, str]:
    """The headers of a request that `guard` looks at; of one that was sent twice, both values."""
    found: dict[str, str] = {}
    for raw_name, raw_value in scope["headers"]:
        name, value = raw_name.decode("latin-1").lower(), raw_value.decode("latin-1")
        found[name] = f"{found[name]},{value}" if name in found else value
    return found


def event_of(scope: Scope, body: bytes, route: Route, parameters: Mapping[str, str]) -> dict[str, Any]:
    """The event of payload format 2.0 for this request."""
    headers: dict[str, str] = {}
    cookies: list[str] = []
    for raw_name, raw_value in scope["headers"]:
        name, value = raw_name.decode("latin-1").lower(), raw_value.decode("latin-1")
        if name == "cookie":
            cookies += [part.strip() for part in value.split(";") if part.strip()]
        else:
            headers[name] = f"{headers[name]},{value}" if name in headers else value
    query: dict[str, str] = {}
    raw_query = scope["query_string"].decode("latin-1")
    for name, value in parse_qsl(raw_query, keep_blank_values=True):
        query[name] = f"{query[name]},{value}" if name in query else value
    now = time.time()
    host = headers.get("host", HOST)
    route_key = f"{scope['method']} {route.path}"
    event: dict[str, Any] = {
        "version": "2.0",
        "routeKey": route_key,
        "rawPath": scope["path"],
        "rawQueryString": raw_query,
        "headers": headers,
        "requestContext": {
            "accountId": "000000000000",
            "apiId": "local",
            "domainName": host,
            "domainPrefix": host.partition(".")[0],
            "http": {
                "method": scope["method"],
                "path": scope["path"],
                "protocol": f"HTTP/{scope.get('http_version', '1.1')}",
                "sourceIp": (scope.get("client") or (HOST,))[0],
                "userAgent": headers.get("user-agent", ""),
            },
            "requestId": str(uuid.uuid4()),
            "routeKey": route_key,
            "stage": "$default",
            "time": datetime.fromtimestamp(now, UTC).strftime("%d/%b/%Y:%H:%M:%S +0000"),
            "timeEpoch": int(now * 1000),
        },
        "isBase64Encoded": False,
    }
    if cookies:
        event["cookies"] = cookies
    if query:
        event["queryStringParameters"] = query
    if parameters:
        event["pathParameters"] = dict(parameters)
    if body:
        text = _text(body, headers.get("content-type", ""))
        event["isBase64Encoded"] = text is None
        event["body"] = base64.b64encode(body).decode() if text is None else text
    return event


def answer_of(result: Any) -> Answer:
    """The response that API Gateway makes of what a function returns. Raises for what it would call an error."""
    if not isinstance(result, dict) or "statusCode" not in result:
        return _json(200, result)
    body = result.get("body") or ""
    data = base64.b64decode(body, validate=True) if result.get("isBase64Encoded") else str(body).encode()
    headers = [(str(name).lower(), str(value)) for name, value in (result.get("headers") or {}).items()]
    if not any(name == "content-type" for name, _ in headers):
        headers.append(("content-type", "text/plain; charset=utf-8"))
    headers += [("set-cookie", str(cookie)) for cookie in result.get("cookies") or ()]
    sent = [
        (name.encode("latin-1"), value.encode("latin-1", "replace"))
        for name, value in headers
        if name not in ("content-length", "transfer-encoding", "connection")
    ]
    return Answer(int(result["statusCode"]), sent, data)


def _text(body: bytes, content_type: str) -> str | None:
    """The body as text; None if it travels in base64."""
    if not _TEXT.fullmatch(content_type.partition(";")[0].strip().lower()):
        return None
    try:
        return body.decode()
    except UnicodeDecodeError:
        return None


async def _body(receive: Receive) -> bytes | None:
    """The whole body; a little more than allowed if it is too large; None if the client has gone."""
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        if len(body) <= LARGEST_BODY:
            body += message.get("body", b"")
        if not message.get("more_body"):
            return bytes(body)


def _plain(status: int, text: str) -> Answer:
    return Answer(status, [(b"content-type", b"text/plain; charset=utf-8")], text.encode())


def _json(status: int, data: Any) -> Answer:
    return Answer(status, [(b"content-type", b"application/json")], json.dumps(data).encode())


def _message(status: int, text: str) -> Answer:
    return _json(status, {"message": text})


def _nothing_here(scope: Scope) -> Answer:
    """What API Gateway says, but in a browser a page: whoever sees it has mistyped an address."""
    accepts = b",".join(value for name, value in scope["headers"] if name.lower() == b"accept")
    if scope["method"] not in ("GET", "HEAD") or b"text/html" not in accepts:
        return _message(404, "Not Found")
    text = "Please open your study link again. It looks like /next?projectId=…"
    page = pages.message_page("There is nothing here", text)
    headers = {"Content-Type": "text/html; charset=utf-8", **page.headers}
    return Answer(404, [(name.lower().encode(), value.encode()) for name, value in headers.items()], page.html.encode())


HIGHEST_PORT = 65535


class NoPort(Exception):
    """The number is no port, or every port that was tried is taken."""


def listen(port: int) -> socket.socket:
    """A socket on this machine alone: at this port or the next free one; 0 for any. Raises `NoPort`."""
    if not 0 <= port <= HIGHEST_PORT:
        raise NoPort(f"{port} is no port: a port is a number from 1 to {HIGHEST_PORT} (PORT=, --port)")
    last = min(port + PORTS_TRIED, HIGHEST_PORT)
    for number in range(port, last + 1):
        if port and _answers(number):  # macOS would let us listen beside a server that listens on every address
            continue
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, number))
            listener.listen(1024)
        except OSError:
            listener.close()
            continue
        return listener
    tried = f"The port {port} is" if last == port else f"The ports {port} to {last} are all"
    raise NoPort(f"{tried} in use or not allowed; choose another (PORT=, --port)")


def _answers(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((HOST, port)) == 0


class _Server(uvicorn.Server):
    """uvicorn, with `refused` told of connections that this machine cannot take (asyncio tries them again)."""

    def __init__(self, config: uvicorn.Config, refused: Refused | None) -> None:
        super().__init__(config)
        self._refused = refused

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self._tell)
        await super().serve(sockets)

    def _tell(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if self._refused is not None and isinstance(error, OSError) and error.errno in _NO_MORE:
            self._refused(error)
        else:
            loop.default_exception_handler(context)


class WebServer:
    """uvicorn in a thread of its own, so that the main thread is free for signals."""

    def __init__(self, app: App, listener: socket.socket, refused: Refused | None = None) -> None:
        self._app = app
        self._listener = listener
        self.url = f"http://{HOST}:{listener.getsockname()[1]}"
        config = uvicorn.Config(
            app,
            http=Connection,
            lifespan="off",
            access_log=False,
            log_level="error",
            server_header=False,
            ws="none",
            timeout_graceful_shutdown=2,
            timeout_keep_alive=5,
        )
        self._server = _Server(config, refused)
        self._thread = threading.Thread(target=self._server.run, args=[[listener]], name="web", daemon=True)

    @property
    def connections(self) -> Collection[object]:
        """Those that are open."""
        return self._server.server_state.connections

    def start(self) -> None:
        """Serve; returns when requests are answered."""
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.01)

    def close(self) -> None:
        """Finish what is being answered, at most two seconds, and end."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(4)
        self._app.close()
        self._listener.close()
