"""Assigns participants to the cells and orders of a study, by compare-and-swap on one document per study.

The document (`model/balance.py`) is written first, and remembers the participant, so that a crash before their own
document is written changes nothing: the repeated request gets the same cell and orders.
"""

from __future__ import annotations

import time
from datetime import datetime
from random import SystemRandom

from hippodrome.control.log import logger
from hippodrome.control.model.balance import Cells, Draw, assignment_of, cells_key, outcome_of
from hippodrome.control.model.design import LATIN, Assignment
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.ports import Conflict, Document, Platform
from hippodrome.control.storage.errors import RetryLater
from hippodrome.control.storage.repository import Repository

TRIES = 40
PAUSE = 0.02  # seconds, times a random number; twice as long after each conflict, up to 32 times
_RANDOM = SystemRandom()


class Assigning:
    """Assigns participants. AWS calls of `assign`: three (a read, a conditional write, a creation), and more if
    others are assigned at the same moment, or if participants of an hour ago are looked up.
    """

    def __init__(self, platform: Platform, repository: Repository) -> None:
        self._platform = platform
        self._repository = repository

    def assign(self, project: Project, user_id: str) -> Assignment:
        """Draw the participant's levels and orders, and write their assignment. A second time it is the same.

        `project` is the study, not a path. Raises `RetryLater` if too many are assigned at this moment.
        """
        now = self._platform.now()
        needs_balance = bool(project.conditions) or any(block.order == LATIN for block in project.blocks)
        draw = self._draw(project, user_id, now) if needs_balance else Draw("", now)
        assignment = assignment_of(project, user_id, draw)
        if self._repository.create_assignment(project.id, user_id, assignment):
            logger.info("assigned", extra={"project": project.id})
            return assignment
        return self._repository.assignment(project.id, user_id) or assignment

    def _draw(self, project: Project, user_id: str, now: datetime) -> Draw:
        documents, key = self._platform.documents, cells_key(project.id)
        for attempt in range(TRIES):
            found = documents.get(key)
            cells = from_json(found.body, Cells) if found else Cells()
            cells, draw = self._settled(project, cells, now).draw(project, user_id, now, _RANDOM)
            try:
                self._write(key, found, cells)
                return draw
            except Conflict:
                time.sleep(PAUSE * _RANDOM.random() * min(2**attempt, 32))
        raise RetryLater("too many participants are assigned at this moment")

    def _write(self, key: str, found: Document | None, cells: Cells) -> None:
        if found is None:
            self._platform.documents.create(key, to_json(cells))
        else:
            self._platform.documents.replace(key, to_json(cells), found.etag)

    def _settled(self, project: Project, cells: Cells, now: datetime) -> Cells:
        """The cells after a look at those who have done nothing for long: whether they have finished, or left."""
        for user_id in cells.unsettled(now):
            progress = self._repository.progress(project.id, user_id)
            assignment = self._repository.assignment(project.id, user_id) if progress.is_assigned else None
            path = [step.key for step in project.own(assignment).steps[:-1]]
            cells = cells.settled(user_id, *outcome_of(path, progress.answered, progress.has_ended, now))
        return cells
