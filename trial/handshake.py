"""How a connection begins: plain HTTP is answered, a subprotocol chosen, and the first message must authenticate."""

from __future__ import annotations

import asyncio
import hmac
import http
from collections.abc import Sequence
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from trial import messages
from trial.connection import SUBPROTOCOLS
from trial.messages import BadMessage, CloseConnection, Hello, NotAMessage

_REFUSED = "that token does not open this game"


def process_request(websocket: ServerConnection, request: Request) -> Response | None:
    """The answer to a request that is no WebSocket's; None lets the handshake go on."""
    path = urlsplit(request.path).path
    if path == "/healthz":
        return websocket.respond(http.HTTPStatus.OK, "ok\n")
    if path != "/":
        return websocket.respond(http.HTTPStatus.NOT_FOUND, "There is nothing here. The game's WebSocket is at /.\n")
    if "websocket" not in request.headers.get("Upgrade", "").lower():
        return websocket.respond(
            http.HTTPStatus.UPGRADE_REQUIRED, "This is a game's server; it speaks WebSocket only.\n"
        )
    return None


def select_subprotocol(_: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """The best of those offered; None for a client of HIPPO's."""
    return next((Subprotocol(name) for name in SUBPROTOCOLS if name in offered), None)


async def receive_hello(websocket: ServerConnection, seconds: float) -> Hello:
    """The first message, with the token of the address if it names none. Raises CloseConnection."""
    try:
        async with asyncio.timeout(seconds):
            data = await websocket.recv()
    except TimeoutError:
        raise CloseConnection(4408, "no first message within the time allowed") from None
    try:
        hello = messages.parse_hello(data)
    except (NotAMessage, BadMessage) as error:
        raise CloseConnection(4401, f"the first message must say who you are: {error}") from None
    return hello if hello.token is not None else Hello(hello.user_id, _token_in_address(websocket), hello.step)


def check_matches(shown: str | None, expected: str) -> None:
    """Compare a token or an id in constant time. Raises CloseConnection."""
    if not hmac.compare_digest((shown or "").encode("utf-8", "surrogatepass"), expected.encode()):
        raise CloseConnection(4401, _REFUSED)


def _token_in_address(websocket: ServerConnection) -> str | None:
    request = websocket.request
    tokens = parse_qs(urlsplit(request.path).query).get("token") if request is not None else None
    return tokens[0] if tokens else None
