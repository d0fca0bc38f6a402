"""The simulated servers of a study with `matching: match` that have no members yet: they answer who plays with whom.

They do what `hippodrome/trial/server/matching.py` does: each server reads the question every two seconds, calls `match`, and
creates the document of its answer; the first answer counts. Here a call of `match` takes up to a second (`TAKES`),
while the trial allows it five (`hippodrome/trial/agent/match.py`); it groups the participants in the order of their ids.
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any

from hippodrome.control.ports import Conflict
from hippodrome.protocol.keys import groups_key, waiting_key
from hippodrome.trial.server.matching import LOOK_SECONDS
from testing.simulation.ports import SimPlatform
from testing.tasks import Life

TAKES = (0.05, 1.0)  # seconds from the call of `match` until its answer is stored


class SimMatching:
    """Answers `match` for all servers without members at once, since only the first answer to a question counts."""

    def __init__(self, platform: SimPlatform, project_id: str) -> None:
        self._platform, self._project_id = platform, project_id
        self.answered = 0  # answers that were stored
        self.most_waiting = 0  # the most participants in one question
        self.largest = 0  # bytes of the largest question
        self._look()

    def _look(self) -> None:
        clock = self._platform.clock
        found = self._platform.documents.kept.get(waiting_key(self._project_id))
        if found and self._servers_wait():
            question = json.loads(found[0])
            waiting = question.get("waiting", ())
            self.largest = max(self.largest, len(found[0]))
            self.most_waiting = max(self.most_waiting, len(waiting))
            if len(waiting) >= question.get("players", 0) > 0:
                clock.after(clock.random.uniform(*TAKES), partial(self._answer, question))
        clock.after(LOOK_SECONDS, self._look)

    def _servers_wait(self) -> bool:
        tasks = self._platform.tasks
        return any(task.last is Life.RUNNING and task.session and not tasks.owner(task) for task in tasks.living())

    def _answer(self, question: Any) -> None:
        ids, players = sorted(one["id"] for one in question["waiting"]), question["players"]
        sessions = [ids[at : at + players] for at in range(0, len(ids) - players + 1, players)]
        key = groups_key(self._project_id, question["id"])
        try:
            self._platform.documents.keep(key, json.dumps({"groups": sessions}).encode())
        except Conflict:
            return
        self.answered += 1
