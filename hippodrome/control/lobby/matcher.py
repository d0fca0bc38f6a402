"""Asks the function `match` of agent.py who plays with whom, by documents that servers read and write (`questions.py`).

A server without members answers (`hippodrome/trial/server/matching.py`). The function is the researcher's code, so the
document of its answer may hold anything: the rules use only the possible sessions in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import timedelta

from hippodrome.control.lobby import questions, rules
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.lobby.entries import Entries
from hippodrome.control.lobby.questions import Candidate, MatchAnswer, Question
from hippodrome.control.log import failure, logger
from hippodrome.control.model.project import Project
from hippodrome.control.ports import Platform, RetryLater
from hippodrome.control.storage.compare_and_swap import SharedDocuments
from hippodrome.protocol.keys import groups_folder, groups_key, questions_folder, waiting_key

FORGOTTEN = timedelta(minutes=5)
"""Older questions and answers are deleted. Nobody needs them: a question is asked again after some seconds."""


class Matcher:
    """Asks the functions `match` of all projects."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._documents = platform.documents
        self._shared = SharedDocuments(platform.documents)

    def chosen(
        self,
        project: Project,
        label: str,
        candidate: Callable[[], Candidate],
        document: Decisions,
        entries: Entries,
    ) -> Sequence[Sequence[str]]:
        """Return the sessions that `match` has chosen, each as its members' labels; ask it again if a question is due.

        `label` is that of the participant whose request this is. If they are new, what `candidate` returns is added to
        the question. If other requests change the question all the time, the result is empty. AWS calls: two reads; two
        more if something is written.
        """
        now, key = self._platform.now(), waiting_key(project.id)
        question = self._read(key, project)
        answer = self._answer(project, question)
        free = rules.free(document, entries, now)
        labels = {person.label for person in free}
        chosen = [session for session in answer.sessions if labels.issuperset(session)] if answer else []
        matched = {label for labels_of_session in chosen for label in labels_of_session}
        new: Candidate | None = None
        if label in entries.waiting and label not in question.candidates() and not questions.is_full(question):
            new = candidate()

        def change(current: Question) -> Question:
            late = current.candidates().keys() - question.candidates().keys()  # came after the folder was listed
            if new is not None:
                current = questions.with_candidate(current, new)
            return questions.next_question(
                current,
                project,
                entries.waiting.keys() | late,
                free,
                answered=answer is not None and current.id == question.id,
                matched=matched if current.id == question.id else (),
                now=now,
            )

        if change(question) == question:
            return chosen
        try:
            changed = self._shared.change(key, Question, change, anew=Question())
        except RetryLater:  # many participants come at once; the next request tries again
            logger.info("the question to match keeps changing", extra={"project": project.id})
            return ()
        if answer and answer.problem and changed.before.id == question.id != changed.after.id:
            logger.warning("%s; it is left out", answer.problem, extra={"project": project.id})
        return chosen

    def forget(self, project: Project) -> None:
        """Delete old questions and answers. AWS calls: two listings, and deletes.

        If a participant still waits, their next request asks again.
        """
        now = self._platform.now()
        for folder in (questions_folder(project.id), groups_folder(project.id)):
            for entry in self._documents.list(folder):
                if now - entry.modified > FORGOTTEN:
                    self._documents.delete(entry.key)

    def _read(self, key: str, project: Project) -> Question:
        try:
            return self._shared.read(key, Question)
        except ValueError as error:
            failure("the question to match cannot be read and is made anew", error, project=project.id)
            return Question()

    def _answer(self, project: Project, question: Question) -> MatchAnswer | None:
        """The answer to the question; None if it has none yet, or if too few participants wait for a session."""
        if len(question.waiting) < project.players:
            return None
        document = self._documents.get(groups_key(project.id, question.id))
        return questions.read(document.body, question) if document else None
