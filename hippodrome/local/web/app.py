"""The ASGI application: it calls the function of each request in a thread."""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from hippodrome.control.participants import frame
from hippodrome.local.web import access
from hippodrome.local.web.gateway import (
    LAB_ROUTES,
    ROUTES,
    GatewayResponse,
    Scope,
    answer_of,
    event_of,
    headers_of,
    joined,
    json_answer,
)

MAX_BODY = 512 * 1024  # bytes; the functions themselves take 256 KB, and say so to participants, as on AWS
THREADS = 32

Handler = Callable[[dict[str, Any], object], Any]
Say = Callable[[str], None]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


class App:
    """The ASGI application. `functions` are the handlers by name. Pages of `origins` are answered, too.

    `any_name`: requests are answered whatever name of this machine they have used.
    """

    def __init__(
        self, functions: Mapping[str, Handler], say: Say, origins: Collection[str] = (), *, any_name: bool = False
    ) -> None:
        self._functions = functions
        self._any_name = any_name
        self._say = say
        self._origins = frozenset(origins)
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="function")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        answer = await self._answer(scope, receive)
        if answer is None:
            return
        origin = joined(headers_of(scope)).get("origin")
        headers = access.headers_for(origin, answer.headers, self._origins) | {"content-length": str(len(answer.body))}
        encoded = [(name.encode("latin-1"), value.encode("latin-1", "replace")) for name, value in headers.items()]
        await send({"type": "http.response.start", "status": answer.status, "headers": encoded})
        body = b"" if scope["method"] == "HEAD" else answer.body
        await send({"type": "http.response.body", "body": body})

    def close(self) -> None:
        """Call no more functions. Functions that run now go on to their end."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _answer(self, scope: Scope, receive: Receive) -> GatewayResponse | None:
        """The answer to a request; None if the client has closed its connection."""
        path = scope["path"]
        if path == "/next/":
            path = "/next"
            scope = {**scope, "path": path}
        if path == "/healthz":
            return _plain(200, "ok\n")
        headers = joined(headers_of(scope))
        scheme = scope.get("scheme", "http")
        refused = access.refusal(scope["method"], path, headers, self._origins, scheme=scheme, any_name=self._any_name)
        if refused:
            return _plain(403, f"{refused}\n")
        for route in (*ROUTES, *LAB_ROUTES):
            parameters = route.match(scope["method"], path)
            if parameters is not None and route.function in self._functions:
                break
        else:
            return _nothing_here(scope["method"], headers.get("accept", ""))
        if int(headers.get("content-length", 0)) > MAX_BODY:  # h11 accepts only a number
            return _plain(413, "Request Entity Too Large\n")
        body = await _body(receive)
        if body is None:
            return None
        if len(body) > MAX_BODY:
            return _plain(413, "Request Entity Too Large\n")
        event = event_of(scope, body, route, parameters)
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._call, self._functions[route.function], event)

    def _call(self, handler: Handler, event: dict[str, Any]) -> GatewayResponse:
        try:
            return answer_of(handler(event, None))
        except Exception:  # noqa: BLE001 - as with API Gateway, the participant sees no details
            self._say(f"a function failed:\n{traceback.format_exc().rstrip()}")
            return _message(500, "Internal Server Error")


async def _body(receive: Receive) -> bytes | None:
    """The body, cut off soon after MAX_BODY; None if the client has closed its connection."""
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        if len(body) <= MAX_BODY:
            body += message.get("body", b"")
        if not message.get("more_body"):
            return bytes(body)


def _plain(status: int, text: str) -> GatewayResponse:
    return GatewayResponse(status, {"content-type": "text/plain; charset=utf-8"}, text.encode())


def _message(status: int, text: str) -> GatewayResponse:
    return json_answer(status, {"message": text})


def _nothing_here(method: str, accept: str) -> GatewayResponse:
    """The answer for a path without a route: a page for browsers, and API Gateway's answer for programs."""
    if method not in ("GET", "HEAD") or "text/html" not in accept:
        return _message(404, "Not Found")
    text = "Please open your study link again. It looks like /next?projectId=…"
    page = frame.message_page("Page not found", text)
    headers = {name.lower(): value for name, value in page.headers.items()}
    return GatewayResponse(404, {"content-type": "text/html; charset=utf-8", **headers}, page.html.encode())
