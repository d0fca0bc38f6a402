"""How a connection begins: plain HTTP is answered, a subprotocol chosen, and the first message must authenticate."""

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

from protocol.keys import NAME
from protocol.session import member_token
from trial.core import messages
from trial.core.messages import BadMessage, CloseConnection, Hello, NotAMessage
from trial.programs import environments, watch
from trial.settings import TrialSettings
from trial.wire import notice, plain
from trial.wire.connection import SUBPROTOCOLS
from trial.wire.inbound import RateLimit

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
"""What a client may send that has been refused and stays."""


def process_request(
    websocket: ServerConnection, request: Request, *, gym: str = "none", token: str = ""
) -> Response | None:
    """The answer to a request that is no WebSocket's; None lets the handshake go on.

    The path of programs is there only if the section `trial` has another `gym` than none. A program that would make
    environments is refused here, since its protocol has no words for it, unless it has the token.
    """
    path = urlsplit(request.path).path
    if path == "/healthz":
        return websocket.respond(http.HTTPStatus.OK, "ok\n")
    if path == watch.PATH and gym == "environments":
        try:
            check_matches(token_in_address(websocket), token)
        except CloseConnection as refused:
            return websocket.respond(http.HTTPStatus.UNAUTHORIZED, f"{refused.words}\n")
        return environments.prepare(websocket, request)
    if path == watch.PATH and gym != "none":
        return None
    if path != "/":
        return websocket.respond(http.HTTPStatus.NOT_FOUND, "There is nothing here. The game's WebSocket is at /.\n")
    if "websocket" not in request.headers.get("Upgrade", "").lower():
        return websocket.respond(
            http.HTTPStatus.UPGRADE_REQUIRED, "This is a game's server; it speaks WebSocket only.\n"
        )
    return None


def select_subprotocol(
    websocket: ServerConnection, offered: Sequence[Subprotocol], *, gym: str = "none"
) -> Subprotocol | None:
    """The best of those offered; None for a client of HIPPO's, and of Gymie's."""
    if gym == "environments" and is_program(websocket):
        return environments.SUBPROTOCOL if environments.SUBPROTOCOL in offered else None
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
    return hello if hello.token is not None else replace(hello, token=token_in_address(websocket))


def tokens_for(settings: TrialSettings, user_id: str | None) -> tuple[str, ...]:
    """The tokens with which a client that says this id may play.

    In a session it is the member's own (`protocol.session.member_token`). The server's token opens no session: who has
    one member's token, or knows another member's id, cannot play in another's place. A warm server does not know yet
    whether it will be a session's, so with either token it looks for its handover.
    """
    named = user_id is not None and NAME.fullmatch(user_id) is not None
    own = (member_token(settings.token, user_id),) if user_id is not None and named else ()
    if settings.warm_server:
        return (settings.token, *own)
    return own if settings.session else (settings.token,)


def check_member(websocket: ServerConnection, user_id: str | None, settings: TrialSettings) -> None:
    """Check that the participant is a member of the session, and that their client speaks ours. Raises CloseConnection.

    What a client without a subprotocol sends along is recorded, and could hold another member's id.
    """
    if user_id not in settings.seats:
        raise CloseConnection(4401, _REFUSED)
    if websocket.subprotocol is None:
        raise CloseConnection(4401, "this game is played with others, and needs a client that offers a subprotocol")


def check_access(websocket: ServerConnection, hello: Hello, tokens: Iterable[str], origins: Collection[str]) -> None:
    """Check that a client has one of the tokens, or needs none. Raises CloseConnection.

    It needs none if it offers no subprotocol and its page is of one of `origins`: those of the project's front end, if
    the installation allows such clients. Its id is compared afterwards.
    """
    if hello.token is not None or websocket.subprotocol is not None:
        if not any(_matches(hello.token, token) for token in tokens):
            raise CloseConnection(4401, _REFUSED)
    elif not origins:
        raise CloseConnection(4401, NEEDS_PROOF)
    elif _origin(websocket) not in origins:
        raise CloseConnection(4401, OTHER_ORIGIN)


def check_matches(shown: str | None, expected: str, words: str = _REFUSED) -> None:
    """Compare a token or an id in constant time. Raises CloseConnection."""
    if not _matches(shown, expected):
        raise CloseConnection(4401, words)


def _matches(shown: str | None, expected: str) -> bool:
    """Whether they are the same, in constant time."""
    return hmac.compare_digest((shown or "").encode("utf-8", "surrogatepass"), expected.encode())


async def show_refusal(websocket: ServerConnection, words: str) -> None:
    """Show the words on HIPPO's page, and keep the connection until the page closes it.

    If the server closed it, that page would say that the game has ended, ask for the next step and connect again.
    Raises CloseConnection for a flood, and ConnectionClosed.
    """
    await websocket.send(plain.sentence(words))
    await websocket.send(notice.frame_message(words))  # in place of "please wait"
    rate, loop = RateLimit(REFUSED_MESSAGES_A_SECOND), asyncio.get_running_loop()
    async for _ in websocket:
        if rate.exceeded(loop.time()):
            raise CloseConnection(4429, "too many messages")


def _origin(websocket: ServerConnection) -> str | None:
    """Where the client's page comes from, as its browser says; None if it says nothing, or several things."""
    sent = websocket.request.headers.get_all("Origin") if websocket.request is not None else []
    return sent[0] if len(sent) == 1 else None


def is_program(websocket: ServerConnection) -> bool:
    """Whether the client is a program at the path /gym."""
    return websocket.request is not None and urlsplit(websocket.request.path).path == watch.PATH


def token_in_address(websocket: ServerConnection) -> str | None:
    """What the address says as `token`."""
    request = websocket.request
    tokens = parse_qs(urlsplit(request.path).query).get("token") if request is not None else None
    return tokens[0] if tokens else None
