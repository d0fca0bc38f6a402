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
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.participant import Ended, Progress
from hippodrome.control.model.place import SKIPPED, TIME_OVER, Next, Place, Standing, wrong_fields
from hippodrome.control.participants.assigning import Assigning
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Platform, Topic


@dataclass(frozen=True)
class Stop:
    """Where a participant stops: at a step that is asked, or at an end. `wrong` are the fields that were not right.

    `visit` is on the participant's own path, and at a game it has the section `trial` of that game.
    """

    visit: Visit
    standing: Standing
    step: Step
    ended: Ended | None = None
    end: End | None = None
    wrong: tuple[str, ...] = ()

    @property
    def progress(self) -> Progress:
        """The participant's progress."""
        return self.standing.progress

    @property
    def number(self) -> int:
        """The number of the next try, from 1."""
        return self.progress.tries.get(self.step.key, 0) + 1


class Paths:
    """Leads participants along their paths. AWS calls of `next`, if nothing is to be done: one read, if the participant
    has an assignment that is not in the cache, and one for each answer that a rule asks about.
    """

    def __init__(self, services: Services) -> None:
        self._platform = services.platform
        self._repository = services.repository
        self._answers = services.answers
        self._assigning = Assigning(services.platform, services.repository)

    def next(self, visit: Visit, progress: Progress) -> Stop:
        """Do what is due, and return the step or the end at which the participant is then."""
        project, standing = visit.project, self._standing(visit, progress)
        if progress.has_ended and (ended := self._repository.ended(project.id, visit.user_id)) is not None:
            end = next((end for end in project.ends if end.name == ended.end), None)
            return Stop(visit.on(standing.project), standing, project.final, ended, end)
        return self._go_on(visit, standing)

    def assigned(self, visit: Visit, standing: Standing) -> Stop:
        """Assign the participant to levels and orders at a page that needs them, and go on from there."""
        assignment = self._assigning.assign(visit.project, visit.user_id)
        return self._go_on(visit, _assigned(visit, standing, assignment) if assignment else standing)

    def _go_on(self, visit: Visit, standing: Standing) -> Stop:
        while True:
            place, own = standing.place(visit.now), visit.on(standing.project)
            if place.next is Next.ASK:
                return _asked(own, standing, place.step)
            if place.next is Next.END and place.end is not None:
                return Stop(own, standing, place.step, self._finish(visit, place.end), place.end)
            if place.next is Next.ASSIGN:
                assignment = self._assigning.assign(visit.project, visit.user_id)
                if assignment is None:
                    return _asked(own, standing, place.step)  # the game, in whose lobby they wait for others
                standing = _assigned(visit, standing, assignment)
                continue
            answers, wrong = self._answers_at(visit, standing, place)
            if wrong:
                return _asked(own, standing, place.step, tuple(wrong))
            if place.next is Next.SKIP:
                publish_events(self._platform, own, place.step)
            self._answers.store(own, place.step, answers)
            answered = {**standing.progress.answered, place.step.key: visit.now}
            standing = replace(standing, progress=replace(standing.progress, answered=answered))

    def _standing(self, visit: Visit, progress: Progress) -> Standing:
        assignment = self._repository.assignment_of(visit.project, visit.user_id, progress)
        return Standing(
            visit.project.own(assignment),
            progress,
            lambda key: self._answers.read(visit, key),
            lambda: self._participant(visit),
            assignment,
        )

    def _participant(self, visit: Visit) -> Mapping[str, Any]:
        record = self._repository.participant(visit.project.id, visit.user_id)
        if record is None:
            return {}
        return {**record.link, "device": participant.device(record.headers.get("user-agent", ""))}

    def _answers_at(self, visit: Visit, standing: Standing, place: Place) -> tuple[Mapping[str, Any], list[str]]:
        """The answers with which a step is over that is skipped, judged, or out of time; and the fields of a check that
        is to be tried again.
        """
        step = place.step
        if place.next is not Next.JUDGE:
            return {"outcome": SKIPPED if place.next is Next.SKIP else TIME_OVER}, []
        number = standing.progress.tries[step.key]
        sent = self._answers.read(visit, f"{step.key}.{number}")
        wrong = wrong_fields(step, sent)
        judged = {**sent, "passed": not wrong, "tries": number}
        may_try_again = bool(wrong) and (not step.tries or number < step.tries)
        if may_try_again and place.is_over:
            return {**judged, "outcome": TIME_OVER}, []
        return judged, wrong if may_try_again else []

    def _finish(self, visit: Visit, end: End) -> Ended:
        """Write that the participant has reached this end, after the message that stops their server."""
        project, user_id = visit.project, visit.user_id
        publish_stop(self._platform, visit)
        code = end.code or ids.completion_code(project.secret, user_id, end.name)
        ended = Ended(end.name, visit.now, code, end.link)
        if self._repository.create_ended(project.id, user_id, ended):
            logger.info("ended", extra={"project": project.id, "end": end.name})
            return ended
        return self._repository.ended(project.id, user_id) or ended


def _asked(own: Visit, standing: Standing, step: Step, wrong: tuple[str, ...] = ()) -> Stop:
    """The stop at a step that is asked."""
    return Stop(own.on(own.project.at_game(step, standing.assignment)), standing, step, wrong=wrong)


def _assigned(visit: Visit, standing: Standing, assignment: Assignment) -> Standing:
    """The standing on the path that follows from an assignment."""
    progress = replace(standing.progress, assigned=visit.now)
    return replace(standing, project=visit.project.own(assignment), assignment=assignment, progress=progress)


def publish_events(platform: Platform, visit: Visit, step: Step) -> None:
    """Publish the start message, the stop message, or none, according to the project's `events` at this step."""
    if participant.starts_server(visit.project, step):
        platform.bus.publish(Topic.START, to_message(StartServer(visit.project.id, visit.user_id)))
    if participant.stops_server(visit.project, step):
        publish_stop(platform, visit)


def publish_stop(platform: Platform, visit: Visit) -> None:
    """Publish the stop message, if the study has servers."""
    if visit.project.events.start_server_step is not None:
        platform.bus.publish(Topic.STOP, to_message(StopServer(visit.project.id, visit.user_id)))
