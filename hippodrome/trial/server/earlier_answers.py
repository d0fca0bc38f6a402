"""Reads what participants have answered in earlier steps, as far as the game's key `answers` names these steps.

The agent gets the answers before the first episode. Who is alone on a server has given all of them. Members of a
session may still be at a page between two games: the game waits for them, as it waits for members who have not come.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from hippodrome.protocol.answer import answers_in
from hippodrome.protocol.keys import answer_key
from hippodrome.trial.recordings.store import Store
from hippodrome.trial.settings import TrialSettings

LOOK_SECONDS = 1.0
"""Seconds between two looks for the answers of members who are not here yet."""


async def read_earlier(store: Store, settings: TrialSettings, over: Collection[str] = ()) -> dict[str, dict[str, Any]]:
    """Return the answers of each participant by their id: by step, or by step and level after a block.

    A session's server waits for missing answers, for `gather` seconds at most, but not for those of members for whom
    the game is `over`. An answer that is not there is left out. Raises OSError.
    """
    users = settings.seats if settings.session else (settings.user_id,)
    missing = [(user, key) for user in users for key in settings.answers]
    found: dict[str, dict[str, Any]] = {user: {} for user in users}
    until = asyncio.get_running_loop().time() + (settings.trial.gather if settings.session else 0)
    while True:
        keys = (answer_key(settings.project_id, user, key) for user, key in missing)
        bodies = await asyncio.gather(*(asyncio.to_thread(store.get, key) for key in keys))
        for (user, key), body in zip(missing, bodies, strict=True):
            if body is not None:
                put(found[user], settings.answers[key], answers_in(body) or {})
        missing = [name for name, body in zip(missing, bodies, strict=True) if body is None]
        left = until - asyncio.get_running_loop().time()
        if left <= 0 or all(user in over for user, _ in missing):
            return found
        await asyncio.sleep(min(LOOK_SECONDS, left))


def put(answers: dict[str, Any], names: Sequence[str], given: Mapping[str, Any]) -> None:
    """Put the answers to one step where the agent finds them: under the step's name, or under its name and a level."""
    name, *level = names
    if level:
        answers.setdefault(name, {})[level[0]] = given
    else:
        answers[name] = given
