"""A warm server: a server that is started, with its agent, before anybody knows whose it will be (`warmServers`).

Whose it is says `{projectId}/spares/{SERVER}.json` in the store, which is written once, before the participant's page
is told the address: `{"schema": 1, "userId": "…", "group": 0 or null, "server": "…"}`. `server` is the name that the
recordings lie under; without `schema` 1 is meant. Until the document is there nobody is let in.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, replace

from trial.settings import LABEL, NAME, Settings
from trial.store import Store, brief

log = logging.getLogger("trial")

SCHEMA = 1


class NotGiven(Exception):
    """The document does not say whose the server is. The words hold nothing of what stands there."""


@dataclass(frozen=True, slots=True)
class Given:
    """Whose the server is: the participant, their group (None: there are none), and the server's name from now on."""

    user_id: str
    group: int | None
    server: str


def key(project_id: str, server: str) -> str:
    """Where the document of the warm server with this name lies."""
    return f"{project_id}/spares/{server}.json"


def parse(body: bytes) -> Given:
    """Read the document. Raises NotGiven, never anything else."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise NotGiven("its document is not JSON") from error
    if not isinstance(found, dict) or found.get("schema", SCHEMA) != SCHEMA:
        raise NotGiven("its document is none that this server can read")
    user_id, group, server = found.get("userId"), found.get("group"), found.get("server")
    if not (isinstance(user_id, str) and NAME.fullmatch(user_id)):
        raise NotGiven("its document names no participant")
    if not (isinstance(server, str) and LABEL.fullmatch(server)):
        raise NotGiven("its document names no server")
    if group is not None and (isinstance(group, bool) or not isinstance(group, int) or group < 0):
        raise NotGiven("its document's group is none")
    return Given(user_id, group, server)


def taken(settings: Settings, given: Given) -> Settings:
    """The settings of a warm server that is somebody's now: those of an ordinary server."""
    return replace(settings, warm_server=False, user_id=given.user_id, group=given.group, server=given.server)


def tell_agent(environment: MutableMapping[str, str], given: Given | None) -> None:
    """Let the researcher's code see whose the server is, as it would on an ordinary one; None: nobody's."""
    if given is None:
        for name in ("USER_ID", "GROUP"):
            environment.pop(name, None)
    else:
        environment["USER_ID"] = given.user_id
        environment["GROUP"] = "" if given.group is None else str(given.group)


class Search:
    """Looks for a warm server's document until it is there: every `seconds`, and at once when somebody asks."""

    def __init__(self, store: Store, key: str, seconds: float) -> None:
        self._store = store
        self._key = key
        self._seconds = seconds
        self._asked = asyncio.Event()
        self._looked = asyncio.Event()
        self._trouble = ""

    async def run(self, give: Callable[[Given], Awaitable[None]]) -> None:
        """Look until it is found; `give` is through before anybody who asked goes on."""
        while True:
            looked, self._looked = self._looked, asyncio.Event()  # who asks from here on waits for the next look
            self._asked.clear()
            given = await self._look()
            if given is not None:
                await give(given)
                looked.set()
                self._looked.set()
                return
            looked.set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._seconds):
                    await self._asked.wait()

    async def asked(self) -> None:
        """Until a look is over that began after this was called."""
        looked = self._looked
        self._asked.set()
        await looked.wait()

    async def _look(self) -> Given | None:
        found, trouble = None, ""
        try:
            body = await asyncio.to_thread(self._store.get, self._key)
            found = None if body is None else parse(body)
        except NotGiven as error:
            trouble = str(error)
        except Exception as error:  # noqa: BLE001 - whatever the store raises, the next look may succeed
            trouble = brief(error)
        if trouble and trouble != self._trouble:
            log.warning("cannot see whose this server is (%s); trying again", trouble)
        self._trouble = trouble
        return found
