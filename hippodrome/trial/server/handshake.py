"""The checks at the beginning of a connection: its HTTP request, its subprotocol, its first message and its token."""

from __future__ import annotations

import asyncio
import hmac
import http
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from hippodrome.protocol.keys import NAME
from hippodrome.protocol.session import member_token
from hippodrome.trial.core import messages
from hippodrome.trial.core.messages import BadMessage, CloseConnection, Hello, NotAMessage
from hippodrome.trial.server import watch
from hippodrome.trial.settings import TrialSettings
from hippodrome.trial.wire import plain
from hippodrome.trial.wire.connection import SUBPROTOCOL
from hippodrome.trial.wire.inbound import RateLimit

_REFUSED = "that token does not open this game"
NEEDS_PROOF = (
    "This page cannot open the game: it sends no token, and this study has not allowed pages that send none "
    "(plainClients). Please tell the people who run the study."
)
OTHER_ORIGIN = (
    "This page cannot open the game: it does not come from the address that the study names as its front end "
    "(frontEnd). Please tell the people who run the study."
)
OTHER_ID = "This page cannot open the game: the game is that of another participant. Please open your own link."
OTHER_STUDY = "This page cannot open the game: the game is that of another study. Please open your own link."
REFUSED_MESSAGES_A_SECOND = 20
"""The most messages in a second of a client that is refused and whose connection stays open."""


def process_request(websocket: ServerConnection, request: Request, *, gym: str = "none") -> Response | None:
    """Return the answer to an HTTP request that opens no WebSocket; None: go on with the WebSocket's handshake.

    `gym` is the key of the section `trial`: if it is `none`, there is no path /gym, which programs open.
    """
    path = urlsplit(request.path).path
    if path == "/healthz":
        return websocket.respond(http.HTTPStatus.OK, "ok\n")
    if path == watch.PATH and gym != "none":
        return None
    if path != "/":
        return websocket.respond(http.HTTPStatus.NOT_FOUND, "There is nothing here. The game's WebSocket is at /.\n")
    if "websocket" not in request.headers.get("Upgrade", "").lower():
        return websocket.respond(
            http.HTTPStatus.UPGRADE_REQUIRED, "This is a game's server; it speaks WebSocket only.\n"
        )
    return None


def select_subprotocol(_: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """Return the subprotocol to use; None if the client does not offer it, as HIPPO's clients do not."""
    return Subprotocol(SUBPROTOCOL) if SUBPROTOCOL in offered else None


async def receive_hello(websocket: ServerConnection, seconds: float) -> Hello:
    """Wait for the first message. If it has no token, it gets the token in the address. Raises CloseConnection."""
    try:
        async with asyncio.timeout(seconds):
            data = await websocket.recv()
    except TimeoutError:
        raise CloseConnection(4408, "no first message within the time allowed") from None
    try:
        hello = messages.parse_hello(data)
    except (NotAMessage, BadMessage) as error:
        raise CloseConnection(4401, f"the first message must say who you are: {error}") from None
    return hello if hello.token is not None else replace(hello, token=token_in_address(websocket))


def tokens_for(settings: TrialSettings, user_id: str | None) -> tuple[str, ...]:
    """Return the tokens with which a client that sends this id may play.

    In a session each member has a token of their own (`hippodrome.protocol.session.member_token`), and the server's
    token does not count. So no one can play in another member's place with their own token and the other's id. A warm
    server may still become a session's, so it takes either token, and then looks for its handover.
    """
    named = user_id is not None and NAME.fullmatch(user_id) is not None
    own = (member_token(settings.token, user_id),) if user_id is not None and named else ()
    if settings.warm_server:
        return (settings.token, *own)
    return own if settings.session else (settings.token,)


def check_member(websocket: ServerConnection, user_id: str | None, settings: TrialSettings) -> None:
    """Check that the participant is a member of the session, and that their client has our subprotocol.

    Unknown fields of a client without a subprotocol are recorded, and could hold a member's id. Raises CloseConnection.
    """
    if user_id not in settings.seats:
        raise CloseConnection(4401, _REFUSED)
    if websocket.subprotocol is None:
        raise CloseConnection(
            4401, f"this game is played with others, and needs a client with the subprotocol {SUBPROTOCOL}"
        )


def check_access(websocket: ServerConnection, hello: Hello, tokens: Iterable[str], origins: Collection[str]) -> None:
    """Check that a client has one of the tokens, or needs no token. Raises CloseConnection.

    A client needs no token if it has no subprotocol and its page has one of `origins`, the origins of the project's
    front end if `plainClients` is on. The caller compares the client's id.
    """
    if hello.token is not None or websocket.subprotocol is not None:
        if not any(_matches(hello.token, token) for token in tokens):
            raise CloseConnection(4401, _REFUSED)
    elif not origins:
        raise CloseConnection(4401, NEEDS_PROOF)
    elif _origin(websocket) not in origins:
        raise CloseConnection(4401, OTHER_ORIGIN)


def check_matches(shown: str | None, expected: str, words: str = _REFUSED) -> None:
    """Raise CloseConnection with `words` unless the token or id is the expected one. Compares in constant time."""
    if not _matches(shown, expected):
        raise CloseConnection(4401, words)


def _matches(shown: str | None, expected: str) -> bool:
    """Whether both texts are the same. Takes the same time wherever they differ."""
    return hmac.compare_digest((shown or "").encode("utf-8", "surrogatepass"), expected.encode())


async def show_refusal(websocket: ServerConnection, words: str) -> None:
    """Show the words on the page of HIPPO's front end, and keep the connection until the page closes it.

    If the server closed the connection, that page would say that the game has ended, ask for the next step and connect
    again. Raises CloseConnection if the client sends too many messages, and ConnectionClosed.
    """
    await websocket.send(plain.sentence(words))
    await websocket.send(plain.frame_message(words))  # instead of "please wait"
    rate, loop = RateLimit(REFUSED_MESSAGES_A_SECOND), asyncio.get_running_loop()
    async for _ in websocket:
        if rate.exceeded(loop.time()):
            raise CloseConnection(4429, f"too many messages: at most {REFUSED_MESSAGES_A_SECOND} a second")


def _origin(websocket: ServerConnection) -> str | None:
    """Return the origin of the client's page, from the header that its browser sends; None unless there is just one."""
    origins = websocket.request.headers.get_all("Origin") if websocket.request is not None else []
    return origins[0] if len(origins) == 1 else None


def is_program(websocket: ServerConnection) -> bool:
    """Whether the client is a program at the path /gym."""
    return websocket.request is not None and urlsplit(websocket.request.path).path == watch.PATH


def token_in_address(websocket: ServerConnection) -> str | None:
    """Return the parameter `token` of the address that the client has opened; None if there is none."""
    request = websocket.request
    tokens = parse_qs(urlsplit(request.path).query).get("token") if request is not None else None
    return tokens[0] if tokens else None
