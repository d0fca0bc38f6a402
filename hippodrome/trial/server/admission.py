"""Admits clients: checks their first message, and tells a client that may not play now the reason.

The checks are in `handshake.py`. This module decides their order, waits until the server knows who plays there, limits
how often a member of a session may connect, and checks that they have answered the game steps before.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Collection, Coroutine
from typing import Any

from websockets.asyncio.server import ServerConnection

from hippodrome.protocol.keys import answer_key
from hippodrome.trial.core.messages import CloseConnection, Hello
from hippodrome.trial.recordings.store import Store, short_error
from hippodrome.trial.server.assignment import Search
from hippodrome.trial.server.handshake import (
    OTHER_ID,
    OTHER_STUDY,
    check_access,
    check_matches,
    check_member,
    receive_hello,
    show_refusal,
    tokens_for,
)
from hippodrome.trial.settings import TrialSettings

log = logging.getLogger("trial")

NOT_ASSIGNED = "The game is not open yet. Please wait: it is tried again."
_TOO_OFTEN = "You connect too often. Please wait: it is tried again."

AT_ONCE = 30
"""The number of connections that a member may make at once."""
SECONDS_EACH = 2.0
"""After AT_ONCE connections, the seconds until the member may connect once more."""


class Admission:
    """Admits the participant of this server, or the members of its session.

    `settings` returns the present settings: a server may learn only later who plays there. `finished_steps` are the
    game steps whose answers are stored; in a session, the answers of all members.
    """

    def __init__(
        self, settings: Callable[[], TrialSettings], search: Search, store: Store, finished_steps: Collection[str]
    ) -> None:
        self._settings = settings
        self._search = search
        self._store = store
        self._finished_steps = finished_steps
        self._reconnects = Reconnects()

    async def admit(self, websocket: ServerConnection) -> Hello:
        """Wait for a client's first message, and return it if the client may play. Raises CloseConnection."""
        hello = await receive_hello(websocket, self._settings().hello_seconds)
        try:
            await self._check_client(websocket, hello)
        except CloseConnection as closing:
            if closing.code == 4401 and hello.names_project and websocket.subprotocol is None:
                await show_refusal(websocket, closing.words)
            raise
        settings = self._settings()
        if hello.step is not None and hello.step not in settings.game_steps:
            raise CloseConnection(4404, "that is not a game step of this server")
        if settings.session and not self._reconnects.allowed(hello.user_id or "", asyncio.get_running_loop().time()):
            raise CloseConnection(4429, _TOO_OFTEN)
        if settings.session and hello.step is not None:
            await self._check_turn(hello.user_id or "", hello.step)
        return hello

    async def _check_client(self, websocket: ServerConnection, hello: Hello) -> None:
        """Raise CloseConnection unless this is the client of a participant of this server, with a token if needed."""
        before = self._settings()
        check_access(websocket, hello, tokens_for(before, hello.user_id), before.plain_origins)
        if not before.assigned:
            await self._wait_for_assignment(websocket)
        settings = self._settings()
        if before.warm_server:  # only now the server knows which token counts
            check_access(websocket, hello, tokens_for(settings, hello.user_id), settings.plain_origins)
        if settings.session:
            check_member(websocket, hello.user_id, settings)
        elif hello.token is None:
            check_matches(hello.user_id, settings.user_id, OTHER_ID)
            if hello.project_id is not None:  # a participant of two studies may have servers of one name
                check_matches(hello.project_id, settings.project_id, OTHER_STUDY)
        else:
            check_matches(hello.user_id, settings.user_id)

    async def _wait_for_assignment(self, websocket: ServerConnection) -> None:
        """Look once more for the documents that say who plays here. Raises CloseConnection if they do not exist yet."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._settings().hello_seconds):
                await first_of(self._search.look(), websocket.wait_closed())
        if not self._settings().assigned:
            raise CloseConnection(1013, NOT_ASSIGNED)

    async def _check_turn(self, user_id: str, step: str) -> None:
        """Raise CloseConnection unless the member has answered every game step before this one.

        Otherwise a client that names a later step would begin the game of that step, and the other members could not
        enter the game of theirs.
        """
        settings = self._settings()
        steps = settings.game_steps
        earlier = [
            earlier_step for earlier_step in steps[: steps.index(step)] if earlier_step not in self._finished_steps
        ]
        for key in (answer_key(settings.project_id, user_id, earlier_step) for earlier_step in earlier):
            try:
                async with asyncio.timeout(settings.hello_seconds):
                    document = await asyncio.to_thread(self._store.get, key)
            except Exception as error:
                log.warning("cannot look for an earlier answer (%s)", short_error(error))
                raise CloseConnection(1013, NOT_ASSIGNED) from error
            if document is None:
                raise CloseConnection(4404, "an earlier game step is not over for you")


async def first_of(*waits: Coroutine[Any, Any, Any]) -> None:
    """Wait until the first of these coroutines is done, and cancel the others."""
    tasks = [asyncio.ensure_future(wait) for wait in waits]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()


class Reconnects:
    """Counts the connections of each member of a session, and says when there are too many.

    Each connection of a member is recorded and reported to all members, and may make a policy give the player back. Our
    page does not reach the limit: it waits for at least half a second after each loss, and longer while it is refused.
    """

    def __init__(self) -> None:
        self._free_at: dict[str, float] = {}
        """By member, the time at which they may connect AT_ONCE times again."""

    def allowed(self, human: str, now: float) -> bool:
        """Return whether the member may connect now. A connection that is refused does not count."""
        free_at = max(self._free_at.get(human, now), now)
        if free_at - now > (AT_ONCE - 1) * SECONDS_EACH:
            return False
        self._free_at[human] = free_at + SECONDS_EACH
        return True
