"""A session of two participants on a real trial server: its document, its agent, and its members' clients."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed

from hippodrome.protocol.keys import session_key
from hippodrome.protocol.session import Member, SessionDocument, member_token
from hippodrome.trial.recordings import recording
from tests.trial.conftest import Client, client_of
from tests.trial.two_players import TRIAL as ONE_HUMAN
from tests.trial.two_players import two_players

SID = "s.0123456789abcdef0123"
TOKEN = "the-secret-token"  # of every server that conftest.py starts
MEMBERS = ("anna", "bert")
TRIAL: dict[str, Any] = {
    **ONE_HUMAN,
    "players": {"left": "human", "right": "human"},
    "countdown": 0,
    "ui": {"up": True, "down": True, "start": True, "pause": True, "stop": True},
}
ENV = {
    "PROJECT_ID": "study",
    "SERVER": "pair-1",
    "TOKEN": TOKEN,
    "GAME_STEPS": "3",
    "STORE": "x",
    "TLS": "off",
    "TRIAL": "{}",
    "SESSION": SID,
}
"""The environment of a session's server."""


def document(
    members: Iterable[str] = MEMBERS, *, players: int = 2, group: int | None = None, sid: str = SID
) -> SessionDocument:
    """Return a session whose members have the seats 0, 1 and so on."""
    found = tuple(Member(user_id, group, seat) for seat, user_id in enumerate(members))
    return SessionDocument(sid, players, found, group, "2026-11-22T22:00:00.000000Z")


def form(store: Path, session: SessionDocument | None = None) -> None:
    """Form the session, as the lobby does."""
    found = session or document()
    put(store, session_key("study", SID), found.to_json())


def put(store: Path, key: str, body: bytes) -> None:
    """Create a document at once, never half-written."""
    path = store / key
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".new")
    unfinished.write_bytes(body)
    unfinished.replace(path)


def launch_session(launch: Any, *, trial: dict[str, Any] | None = None, agent: str | None = None, **env: str) -> Any:
    """Start the server of the session. `form` writes the session's document."""
    told = {"SESSION": SID, "USER_ID": "", "SERVER": "pair-1", "ASSIGNMENT_SECONDS": "60", **env}
    return launch(agent=agent or two_players(), trial={**TRIAL, **(trial or {})}, **told)


def launch_formed(launch: Any, **options: Any) -> Any:
    """Start the server of the session as `launch_session` does, and form the session."""
    server = launch_session(launch, **options)
    form(server.store)
    return server


def hello_of(user_id: str, **change: Any) -> dict[str, Any]:
    """Return the fields of the hello that a member's page sends."""
    return {"userId": user_id, "token": member_token(TOKEN, user_id), "step": "3", **change}


@contextlib.asynccontextmanager
async def member(
    server: Any, user_id: str, *, port: int = 0, forms: bool = False, **change: Any
) -> AsyncIterator[Client]:
    """Yield a member's client that has been let in, on another `port` if one is given.

    The session is formed before, or with `forms` when the client is connected: the server's idle time begins then.
    """
    async with client_of(f"ws://127.0.0.1:{port or server.port}/") as client:
        if forms:
            form(server.store)
        await client.hello(**hello_of(user_id, **change))
        try:
            await client.until(lambda: client.controls or client.done)
        except ConnectionClosed as closed:
            raise AssertionError(f"{client.errors}; the server said:\n{server.log_text()}") from closed
        yield client


async def refused(server: Any, open_client: Any, code: int = 4401, **hello: Any) -> str:
    """Connect with this hello; the server must close the connection with this code. Return its last error."""
    async with open_client(server.address) as client:
        await client.hello(**{"userId": None, "token": None, **hello})
        assert await client.closed() == code, client.errors
        assert not client.controls
        assert not client.frames
        last: str = client.errors[-1]
        return last


async def both_play(server: Any, frames: int = 5) -> tuple[Client, Client]:
    """Let both members play until they have `frames` pictures; then one stops the game."""
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await anna.say(command="start")
        try:
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= frames) for each in (anna, bert)))
        except ConnectionClosed as closed:
            raise AssertionError(f"{anna.errors}, {bert.errors}; the server said:\n{server.log_text()}") from closed
        await anna.say(command="stop")
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
        return anna, bert


async def wait_for_pictures(frames: int, *clients: Client) -> None:
    """Let all clients take pictures: a client that took none would be away after some seconds, and the game would be held."""
    await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= frames) for each in clients))


def answer(store: Path, user_id: str, step: str = "3") -> dict[str, Any]:
    """Return the document of a member's answer."""
    found: dict[str, Any] = json.loads((store / f"study/users/{user_id}/answers/{step}.json").read_text())
    return found


def recordings(store: Path, server: str = "pair-1") -> dict[str, list[dict[str, Any]]]:
    """Return the lines that a server of the session has recorded, by file."""
    folder = store / f"study/sessions/{SID}/trials/{server}"
    return {path.name: recording.read(path.read_bytes()) for path in sorted(folder.glob("*.gz*"))}
