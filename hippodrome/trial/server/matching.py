"""Answers the lobby's question who plays with whom, by the function `match` of agent.py (`matching: match`).

The lobby writes the participants who wait into a document, the question, which has an id. Servers without members read
it, call `match`, and create a document with the answer; the first answer counts. `match` runs on a thread of its own:
if it never returns, the server can still play.
"""

from __future__ import annotations

import asyncio
import json
import logging
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from hippodrome.protocol.keys import QUESTION_ID, groups_key, waiting_key
from hippodrome.protocol.session import MAX_PLAYERS
from hippodrome.trial.agent import match
from hippodrome.trial.agent.match import BadGroups
from hippodrome.trial.agent.tracebacks import where
from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import AgentTimeout
from hippodrome.trial.recordings.store import Store, short_error
from hippodrome.trial.settings import TrialSettings

log = logging.getLogger("trial")

LOOK_SECONDS = 2.0
"""The time between two looks for a question."""


class Matching:
    """Answers the lobby's questions until the server has members."""

    def __init__(self, store: Store, settings: Callable[[], TrialSettings], function: Callable[..., Any]) -> None:
        """`settings` returns the present settings. `function` is `match` of agent.py."""
        self._store = store
        self._settings = settings
        self._function = function
        self._worker = Worker("match")
        self._answered = ""  # the id of the last question that was answered
        self._logged: set[str] = set()

    async def run(self) -> None:
        """Answer the lobby's questions until the members are known.

        If a call of `match` does not return, end at once.
        """
        while not self._settings().assigned:
            if self._settings().session:
                try:
                    await self._look()
                except Exception as error:  # noqa: BLE001 - whatever the store raises, the next look may succeed
                    self._log_once(logging.WARNING, f"cannot see who waits ({short_error(error)}); trying again")
            if self._worker.busy:
                return
            await asyncio.sleep(LOOK_SECONDS)
        self._worker.close()

    async def _look(self) -> None:
        project = self._settings().project_id
        body = await asyncio.to_thread(self._store.look, waiting_key(project))
        question = None if body is None else read(body)
        if question is None or question["id"] == self._answered or len(question["waiting"]) < question["players"]:
            return
        if self._settings().assigned:
            return
        groups = await self._groups(question)
        answer = json.dumps({"groups": groups}).encode()
        await asyncio.to_thread(self._store.create, groups_key(project, question["id"]), answer)
        self._answered = question["id"]

    async def _groups(self, question: Mapping[str, Any]) -> list[list[str]]:
        """Call `match`, and return the groups that it chooses; none if it fails, which is logged once."""
        folder = self._settings().agent_dir
        try:
            groups, problem = await self._worker.call(
                lambda: match.groups(self._function, question), limit=match.SECONDS
            )
        except BadGroups as error:
            self._log_once(logging.ERROR, f"{error}; nobody is matched")
            return []
        except AgentTimeout as error:
            place = where(error, folder)
            text = f"match() has not returned within {match.SECONDS:g} s" + (f", and is in {place}" if place else "")
            self._log_once(logging.ERROR, f"{text}; this server calls it no more")
            return []
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            # Its message is left out, since it may quote an answer.
            text = f"{''.join(traceback.format_tb(error.__traceback__))}{where(error, folder)}: {type(error).__name__}"
            self._log_once(logging.ERROR, f"match() failed, and nobody is matched\n{text}")
            return []
        if problem:
            self._log_once(logging.ERROR, f"{problem}; that group is left out")
        return groups

    def _log_once(self, level: int, text: str) -> None:
        if text not in self._logged and len(self._logged) < 100:
            self._logged.add(text)
            log.log(level, "%s", text)


def read(body: bytes) -> dict[str, Any] | None:
    """Parse a question: its `id`, the `players` of a session, and who is `waiting`. None if it cannot be read."""
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    question_id, players, waiting = document.get("id"), document.get("players"), document.get("waiting")
    if not (isinstance(question_id, str) and QUESTION_ID.fullmatch(question_id)) or not isinstance(waiting, list):
        return None
    if not isinstance(players, int) or not 2 <= players <= MAX_PLAYERS:
        return None
    valid = all(isinstance(person, dict) and isinstance(person.get("id"), str) for person in waiting)
    return {"id": question_id, "players": players, "waiting": waiting} if valid else None
