"""Finds out who plays on a server that was started ahead: a warm server (`warmServers`), or the server of a session.

A warm server reads its handover (`hippodrome/protocol/handover.py`), which names a participant or a session. The server
of a session reads the members in the session's document (`hippodrome/protocol/session.py`). Until these documents
exist, the server refuses all clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import replace

from hippodrome.protocol import environment as variables
from hippodrome.protocol import handover, session
from hippodrome.protocol.handover import BadHandover, Handover
from hippodrome.protocol.keys import handover_key, session_key
from hippodrome.protocol.session import BadSession, SessionDocument, is_session_id
from hippodrome.trial.recordings.store import Store, short_error
from hippodrome.trial.settings import TrialSettings

log = logging.getLogger("trial")

AssignmentDocument = Handover | SessionDocument
"""A document that says who plays on a server."""


def with_handover(settings: TrialSettings, handover: Handover) -> TrialSettings:
    """Return the settings of a warm server with what its handover says: who plays there, or which session."""
    if is_session_id(handover.user_id):
        return replace(
            settings, warm_server=False, session=handover.user_id, group=handover.group, server=handover.server
        )
    return replace(settings, warm_server=False, user_id=handover.user_id, group=handover.group, server=handover.server)


def with_members(settings: TrialSettings, session_document: SessionDocument) -> TrialSettings:
    """Return the settings of a session's server with the members of the document. Raises BadSession."""
    if session_document.id != settings.session:
        raise BadSession("its document is that of another session")
    return replace(
        settings, players=session_document.players, members=session_document.members, group=session_document.group
    )


def set_environment(environment: MutableMapping[str, str], assignment_document: AssignmentDocument | None) -> None:
    """Set the environment variables that tell the researcher's code who plays; remove them if that is not known yet.

    For a session they hold its id and group; no variable holds a participant's id.
    """
    for name in (*variables.PARTICIPANT, variables.SESSION):
        environment.pop(name, None)
    if isinstance(assignment_document, SessionDocument):
        environment[variables.SESSION] = assignment_document.id
        environment[variables.GROUP] = variables.group_text(assignment_document.group)
    elif assignment_document is not None and not is_session_id(assignment_document.user_id):
        environment[variables.USER_ID] = assignment_document.user_id
        environment[variables.GROUP] = variables.group_text(assignment_document.group)


class Search:
    """Looks for the documents that say who plays: every `warm_server_seconds` (settings), and when `look` is called."""

    def __init__(self, store: Store, settings: TrialSettings) -> None:
        self._store = store
        self._settings = settings
        self._asked = asyncio.Event()
        self._looked = asyncio.Event()
        self._logged = ""

    async def run(self, assign: Callable[[TrialSettings, AssignmentDocument], Awaitable[None]]) -> None:
        """Look until it is known who plays. Call `assign` with each document and the settings that follow from it.

        If a call of `look` leads to a document, it returns only after `assign` has taken the document.
        """
        while not self._settings.assigned:
            looked, self._looked = self._looked, asyncio.Event()  # a `look` from here on waits for the next pass
            self._asked.clear()
            while not self._settings.assigned and (assignment_found := await self._find()) is not None:
                self._settings, document = assignment_found
                await assign(self._settings, document)
            looked.set()
            if self._settings.assigned:
                self._looked.set()
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._settings.warm_server_seconds):
                    await self._asked.wait()

    async def look(self) -> None:
        """Look once more now, and wait until that is done."""
        looked = self._looked
        self._asked.set()
        await looked.wait()

    async def _find(self) -> tuple[TrialSettings, AssignmentDocument] | None:
        """Return the next document that is found, and the settings that follow from it; None if there is none yet."""
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
    """Return the key of the document that a server with these settings still needs."""
    if settings.warm_server:
        return handover_key(settings.project_id, settings.server)
    return session_key(settings.project_id, settings.session)


def _read(settings: TrialSettings, body: bytes) -> tuple[TrialSettings, AssignmentDocument]:
    """Parse the document, and return it with the settings that follow from it. Raises BadHandover and BadSession."""
    if settings.warm_server:
        assigned = handover.parse(body)
        return with_handover(settings, assigned), assigned
    formed = session.parse(body)
    return with_members(settings, formed), formed
