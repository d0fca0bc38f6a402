"""Who plays on a server that was started before that was known: a warm server (`warmServers`), and that of a session.

A warm server reads it in its handover (`protocol/handover.py`), which may name a session. Who the members of a session
are stands in its document (`protocol/session.py`). Until these documents are there, the server refuses all clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import replace

from protocol import environment as variables
from protocol import handover, session
from protocol.handover import BadHandover, Handover
from protocol.keys import handover_key, session_key
from protocol.session import BadSession, SessionDocument, is_session_id
from trial.recordings.store import Store, short_error
from trial.settings import TrialSettings

log = logging.getLogger("trial")

Found = Handover | SessionDocument


def assigned(settings: TrialSettings, found: Handover) -> TrialSettings:
    """The settings of a warm server after its handover: those of an ordinary server, or of a session's."""
    if is_session_id(found.user_id):
        return replace(settings, warm_server=False, session=found.user_id, group=found.group, server=found.server)
    return replace(settings, warm_server=False, user_id=found.user_id, group=found.group, server=found.server)


def formed(settings: TrialSettings, found: SessionDocument) -> TrialSettings:
    """The settings of a session's server once its members are known. Raises BadSession."""
    if found.id != settings.session:
        raise BadSession("its document is that of another session")
    return replace(settings, players=found.players, members=found.members, group=found.group)


def set_environment(environment: MutableMapping[str, str], found: Found | None) -> None:
    """Let the researcher's code see who plays, as on an ordinary server; None: it is not known yet.

    In a session it sees the session's id and group, and no participant's id.
    """
    for name in (*variables.PARTICIPANT, variables.SESSION):
        environment.pop(name, None)
    if isinstance(found, SessionDocument):
        environment[variables.SESSION] = found.id
        environment[variables.GROUP] = variables.group_text(found.group)
    elif found is not None and not is_session_id(found.user_id):
        environment[variables.USER_ID] = found.user_id
        environment[variables.GROUP] = variables.group_text(found.group)


class Search:
    """Looks for the documents that say who plays, until they are there: at intervals, and when `look` is called.

    The interval is `warm_server_seconds` of the settings.
    """

    def __init__(self, store: Store, settings: TrialSettings) -> None:
        self._store = store
        self._settings = settings
        self._asked = asyncio.Event()
        self._looked = asyncio.Event()
        self._logged = ""

    async def run(self, assign: Callable[[TrialSettings, Found], Awaitable[None]]) -> None:
        """Look until all is known. `assign` is told of each document; it has returned before any `look` returns."""
        while not self._settings.assigned:
            looked, self._looked = self._looked, asyncio.Event()  # a `look` from here on waits for the next one
            self._asked.clear()
            while not self._settings.assigned and (found := await self._find()) is not None:
                self._settings, document = found
                await assign(self._settings, document)
            looked.set()
            if self._settings.assigned:
                self._looked.set()
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._settings.warm_server_seconds):
                    await self._asked.wait()

    async def look(self) -> None:
        """Look once more, from now on, and wait for its end."""
        looked = self._looked
        self._asked.set()
        await looked.wait()

    async def _find(self) -> tuple[TrialSettings, Found] | None:
        """The next document, and the settings with what it says."""
        settings, found, problem = self._settings, None, ""
        try:
            body = await asyncio.to_thread(self._store.get, _key(settings))
            found = None if body is None else _read(settings, body)
        except (BadHandover, BadSession) as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - whatever the store raises, the next look may succeed
            problem = short_error(error)
        if problem and problem != self._logged:
            log.warning("cannot see whose this server is (%s); trying again", problem)
        self._logged = problem
        return found


def _key(settings: TrialSettings) -> str:
    """The key of the document that says what is not known yet."""
    if settings.warm_server:
        return handover_key(settings.project_id, settings.server)
    return session_key(settings.project_id, settings.session)


def _read(settings: TrialSettings, body: bytes) -> tuple[TrialSettings, Found]:
    """Raises BadHandover and BadSession."""
    if settings.warm_server:
        given = handover.parse(body)
        return assigned(settings, given), given
    members = session.parse(body)
    return formed(settings, members), members
