"""A warm server: it is started, with its agent, before its participant is known (`warmServers`).

Its handover (`protocol/handover.py`) tells it later. Until that document is there, it refuses all clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import replace

from protocol import environment as variables
from protocol import handover
from protocol.handover import BadHandover, Handover
from trial.recordings.store import Store, short_error
from trial.settings import Settings

log = logging.getLogger("trial")


def assigned(settings: Settings, found: Handover) -> Settings:
    """The settings of a warm server after its handover: those of an ordinary server."""
    return replace(settings, warm_server=False, user_id=found.user_id, group=found.group, server=found.server)


def set_environment(environment: MutableMapping[str, str], found: Handover | None) -> None:
    """Let the researcher's code see the participant as on an ordinary server; None: it has none."""
    if found is None:
        for name in variables.PARTICIPANT:
            environment.pop(name, None)
    else:
        environment[variables.USER_ID] = found.user_id
        environment[variables.GROUP] = variables.group_text(found.group)


class HandoverSearch:
    """Looks for a warm server's handover until it is there: every `seconds`, and at once when `look` is called."""

    def __init__(self, store: Store, key: str, seconds: float) -> None:
        self._store = store
        self._key = key
        self._seconds = seconds
        self._asked = asyncio.Event()
        self._looked = asyncio.Event()
        self._logged = ""

    async def run(self, assign: Callable[[Handover], Awaitable[None]]) -> None:
        """Look until it is found. `assign` has returned before any `look` returns."""
        while True:
            looked, self._looked = self._looked, asyncio.Event()  # a `look` from here on waits for the next one
            self._asked.clear()
            found = await self._find()
            if found is not None:
                await assign(found)
                looked.set()
                self._looked.set()
                return
            looked.set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._seconds):
                    await self._asked.wait()

    async def look(self) -> None:
        """Wait for the end of a look that begins after this was called."""
        looked = self._looked
        self._asked.set()
        await looked.wait()

    async def _find(self) -> Handover | None:
        found, problem = None, ""
        try:
            body = await asyncio.to_thread(self._store.get, self._key)
            found = None if body is None else handover.parse(body)
        except BadHandover as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - whatever the store raises, the next look may succeed
            problem = short_error(error)
        if problem and problem != self._logged:
            log.warning("cannot see whose this server is (%s); trying again", problem)
        self._logged = problem
        return found
