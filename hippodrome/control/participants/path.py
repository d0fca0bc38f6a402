"""Leads a participant along their path, up to the page that is to be shown.

`Paths.next` does what `Standing.place` says: it assigns, skips, judges, and notes that a time is over, each by one
document that is created once, and asks again. Every action may be repeated: a crash in between changes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from hippodrome.control.log import logger
from hippodrome.control.model import ids, participant
from hippodrome.control.model.design import Assignment, End, Step
from hippodrome.control.model.participant import Ended, Progress
from hippodrome.control.model.place import SKIPPED, TIME_OVER, Next, Place, Standing, wrong_fields
from hippodrome.control.model.project import Project
from hippodrome.control.participants.answers import Answers
from hippodrome.control.participants.assigning import Assigning
from hippodrome.control.participants.events import publish_events, publish_stop
from hippodrome.control.ports import Platform
from hippodrome.control.storage.repository import Repository


@dataclass(frozen=True)
class Stop:
    """Where a participant stops: at a step that is asked, or at an end. `wrong` are the fields that were not right."""

    standing: Standing
    step: Step
    ended: Ended | None = None
    end: End | None = None
    wrong: tuple[str, ...] = ()

    @property
    def project(self) -> Project:
        """The project with the participant's own path."""
        return self.standing.project

    @property
    def number(self) -> int:
        """The number of the next try, from 1."""
        return self.standing.progress.tries.get(self.step.key, 0) + 1


class Paths:
    """Leads participants along their paths. AWS calls of `next`, if nothing is to be done: one read, if the participant
    has an assignment that is not in the cache, and one for each answer that a rule asks about.
    """

    def __init__(self, platform: Platform, repository: Repository, answers: Answers) -> None:
        self._platform = platform
        self._repository = repository
        self._answers = answers
        self._assigning = Assigning(platform, repository)

    def next(self, project: Project, user_id: str, progress: Progress) -> Stop:
        """Do what is due, and return the step or the end at which the participant is then."""
        if progress.has_ended and (ended := self._repository.ended(project.id, user_id)) is not None:
            return Stop(self._standing(project, user_id, progress), project.final, ended, _end_of(project, ended.end))
        return self._go_on(project, user_id, self._standing(project, user_id, progress))

    def _go_on(self, project: Project, user_id: str, standing: Standing) -> Stop:
        while True:
            place = standing.place(self._platform.now())
            if place.next is Next.ASK:
                return Stop(standing, place.step)
            if place.next is Next.END and place.end is not None:
                return Stop(standing, place.step, self._finish(project, user_id, place.end), place.end)
            if place.next is Next.ASSIGN:
                assignment = self._assigning.assign(project, user_id)
                if assignment is None:
                    return Stop(standing, place.step)  # the game, in whose lobby the participant waits for others
                standing = self._assigned(project, standing, assignment)
                continue
            answers, wrong = self._answers_at(project, user_id, standing, place)
            if wrong:
                return Stop(standing, place.step, wrong=tuple(wrong))
            if place.next is Next.SKIP:
                publish_events(self._platform, standing.project, user_id, place.step)
            self._answers.store(standing.project, user_id, place.step, answers)
            answered = {**standing.progress.answered, place.step.key: self._platform.now()}
            standing = replace(standing, progress=replace(standing.progress, answered=answered))

    def assigned(self, project: Project, user_id: str, standing: Standing) -> Stop:
        """Assign the participant to levels and orders at a page that needs them, and go on from there."""
        assignment = self._assigning.assign(project, user_id)
        return self._go_on(project, user_id, self._assigned(project, standing, assignment) if assignment else standing)

    def _standing(self, project: Project, user_id: str, progress: Progress) -> Standing:
        assignment = self._repository.assignment_of(project, user_id, progress)
        return Standing(
            project.own(assignment),
            progress,
            lambda key: self._answers.read(project.id, user_id, key),
            lambda: self._participant(project, user_id),
            assignment,
        )

    def _participant(self, project: Project, user_id: str) -> Mapping[str, Any]:
        record = self._repository.participant(project.id, user_id)
        if record is None:
            return {}
        return {**record.link, "device": participant.device(record.headers.get("user-agent", ""))}

    def _answers_at(
        self, project: Project, user_id: str, standing: Standing, place: Place
    ) -> tuple[Mapping[str, Any], list[str]]:
        """The answers with which a step is over that is skipped, judged, or out of time; and the fields of a check that
        is to be tried again.
        """
        step = place.step
        if place.next is not Next.JUDGE:
            return {"outcome": SKIPPED if place.next is Next.SKIP else TIME_OVER}, []
        number = standing.progress.tries[step.key]
        sent = self._answers.read(project.id, user_id, f"{step.key}.{number}")
        wrong = wrong_fields(step, sent)
        judged = {**sent, "passed": not wrong, "tries": number}
        may_try_again = bool(wrong) and (not step.tries or number < step.tries)
        if may_try_again and place.is_over:
            return {**judged, "outcome": TIME_OVER}, []
        return judged, wrong if may_try_again else []

    def _finish(self, project: Project, user_id: str, end: End) -> Ended:
        """Write that the participant has reached this end, after the message that stops their server."""
        publish_stop(self._platform, project, user_id)
        code = end.code or ids.completion_code(project.secret, user_id, end.name)
        ended = Ended(end.name, self._platform.now(), code, end.link)
        if self._repository.create_ended(project.id, user_id, ended):
            logger.info("ended", extra={"project": project.id, "end": end.name})
            return ended
        return self._repository.ended(project.id, user_id) or ended

    def _assigned(self, project: Project, standing: Standing, assignment: Assignment) -> Standing:
        """The standing on the path that follows from an assignment."""
        progress = replace(standing.progress, assigned=self._platform.now())
        return replace(standing, project=project.own(assignment), assignment=assignment, progress=progress)


def _end_of(project: Project, name: str) -> End | None:
    return next((end for end in project.ends if end.name == name), None)
