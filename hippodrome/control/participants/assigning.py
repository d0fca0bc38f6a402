"""Assigns participants to the cells and orders of a study, by compare-and-swap on one document per study.

The document (`model/balance.py`) is written first, and remembers the participant, so that a crash before their own
document is written changes nothing: the repeated request gets the same cell and orders. Participants who play together
are assigned together: their session is drawn, and each gets a copy of its assignment.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import datetime
from random import SystemRandom

from hippodrome.control.log import logger
from hippodrome.control.model.balance import (
    Cells,
    Draw,
    Outcome,
    assignment_of,
    cells_key,
    left_after,
    most_active,
    outcome_of,
)
from hippodrome.control.model.design import LATIN, Assignment
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.ports import Conflict, Document, Platform, RetryLater
from hippodrome.control.servers.sessions import members_of
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.session import is_session_id

TRIES = 40
PAUSE = 0.02  # seconds, times a random number; twice as long after each conflict, up to 32 times
_RANDOM = SystemRandom()
Outcomes = Mapping[str, tuple[Outcome, datetime]]
"""What became of participants or sessions, and the time of their last answers."""


class Assigning:
    """Assigns participants. AWS calls of `assign`: three (a read, a conditional write, a creation), and more if
    others are assigned at the same moment, or if participants of an hour ago are looked up. With sessions two more (the
    membership, and the copy).
    """

    def __init__(self, platform: Platform, repository: Repository) -> None:
        self._platform = platform
        self._repository = repository

    def assign(self, project: Project, user_id: str, cell: str | None = None) -> Assignment | None:
        """Draw the participant's levels and orders, and write their assignment. A second time it is the same.

        The result is None as long as it is not known with whom the participant plays. Who plays with nobody gets no
        levels and no runs. `project` is the study, not a path. With the name of a `cell` the participant, or their
        session, gets this one: only a study on one machine gives it (`local/own_cells.py`). Raises `RetryLater` if too
        many are assigned at this moment.
        """
        if not project.has_sessions:
            return self._assignment(project, user_id, cell)
        membership = self._repository.membership(project.id, user_id)
        if membership is None:
            return None
        if membership.session is None:
            alone = Assignment(project.version, orders={block.name: () for block in project.blocks})
            return self._created(project, user_id, alone)
        return self._created(project, user_id, self._assignment(project, membership.session, cell))

    def _assignment(self, project: Project, owner: str, cell: str | None = None) -> Assignment:
        """The assignment of a participant, or of a session, drawn now or before."""
        now = self._platform.now()
        needs_balance = bool(project.conditions) or any(block.order == LATIN for block in project.blocks)
        draw = self._draw(project, owner, now, cell) if needs_balance else Draw("", now)
        return self._created(project, owner, assignment_of(project, owner, draw))

    def _created(self, project: Project, owner: str, assignment: Assignment) -> Assignment:
        if self._repository.create_assignment(project.id, owner, assignment):
            logger.info("assigned", extra={"project": project.id})
            return assignment
        return self._repository.assignment(project.id, owner) or assignment

    def _draw(self, project: Project, owner: str, now: datetime, cell: str | None) -> Draw:
        documents, key = self._platform.documents, cells_key(project.id)
        outcomes: Outcomes | None = None  # looked up once: others write the document while this one looks
        for attempt in range(TRIES):
            document = documents.get(key)
            cells = from_json(document.body, Cells) if document else Cells()
            if outcomes is None:
                outcomes = self._outcomes(project, cells, now)
            cells, draw = _settled(project, cells, outcomes, now).draw(project, owner, now, _RANDOM, cell)
            try:
                self._write(key, document, cells)
                return draw
            except Conflict:
                time.sleep(PAUSE * _RANDOM.random() * min(2**attempt, 32))
        raise RetryLater("too many participants are assigned at this moment")

    def _write(self, key: str, document: Document | None, cells: Cells) -> None:
        if document is None:
            self._platform.documents.create(key, to_json(cells))
        else:
            self._platform.documents.replace(key, to_json(cells), document.etag)

    def _outcomes(self, project: Project, cells: Cells, now: datetime) -> Outcomes:
        """What became of those who have done nothing for long: whether they have finished, or left."""
        outcomes = {}
        for owner in cells.unsettled(now, left_after(project)):
            users = members_of(self._repository, project.id, owner) if is_session_id(owner) else [owner]
            outcomes[owner] = most_active([self._outcome(project, user_id, now) for user_id in users], now)
        return outcomes

    def _outcome(self, project: Project, user_id: str, now: datetime) -> tuple[Outcome, datetime]:
        progress, own = self._repository.path_of(project, user_id)
        path = [step.key for step in own.steps[:-1]]
        return outcome_of(path, progress.answered, progress.has_ended, now, left_after(project))


def _settled(project: Project, cells: Cells, outcomes: Outcomes, now: datetime) -> Cells:
    """The cells without those who have finished or left, unless they were settled or drawn anew meanwhile."""
    for owner in cells.unsettled(now, left_after(project)):
        if owner in outcomes:
            cells = cells.settled(owner, *outcomes[owner])
    return cells
