"""Stores and reads the answers to steps: `Answers.store` stores a participant's form, `read` reads it for later pages.

`journey.py` finds the step that a form answers and calls the step's type (`steps/`), which calls `store`. The trial
stores the answer to a game step (`hippodrome/trial/recordings/recorder.py`) in a document of the same form
(`hippodrome/protocol/answer.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from hippodrome.control.log import logger
from hippodrome.control.model import participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Progress
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Conflict, Documents
from hippodrome.protocol.answer import answers_in
from hippodrome.protocol.keys import answer_key


class Answers:
    """The answers of all participants. A method makes one AWS call unless its docstring says otherwise."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents

    def store(self, visit: Visit, step: Step, answers: Mapping[str, Any]) -> None:
        """Store the answers to a step, which moves the participant on. An answer that the step has already stays."""
        if self._create(visit, step, answers, answer_key(visit.project.id, visit.user_id, step.key)):
            logger.info("answered", extra={"project": visit.project.id, "step": step.key})

    def store_try(self, visit: Visit, step: Step, number: int, answers: Mapping[str, Any]) -> None:
        """Store the answers of a try at a check. Each try is stored once, so going back gives no further try."""
        self._create(visit, step, answers, participant.try_key(visit.project.id, visit.user_id, step.key, number))

    def _create(self, visit: Visit, step: Step, answers: Mapping[str, Any], key: str) -> bool:
        record = participant.new_answer(visit.project, visit.user_id, step, answers, visit.now)
        try:
            self._documents.create(key, msgspec.json.format(msgspec.json.encode(record), indent=1))
        except Conflict:
            return False
        return True

    def read(self, visit: Visit, step: str) -> Mapping[str, Any]:
        """Return the participant's answers at a step; empty if there are none, or if the document holds no answers."""
        document = self._documents.get(answer_key(visit.project.id, visit.user_id, step))
        answers = answers_in(document.body) if document else {}
        if answers is None:
            logger.warning("an answer's document holds no answers", extra={"project": visit.project.id, "step": step})
        return answers or {}

    def repeats(self, visit: Visit, progress: Progress, answers: Mapping[str, Any]) -> bool:
        """Return whether these answers, of a form that names no step, repeat the answers to a step of the last minute.

        Simultaneous requests get the same result: `progress` has every answer before the due step, and answers never
        change. AWS calls: one read for each answer of that minute, at most `participant.MAX_COMPARED`.
        """
        earlier = (self.read(visit, key) for key in progress.recently_answered(visit.project, visit.now))
        return any(participant.same_answers(answers, answer) for answer in earlier)
