"""The argument of `StepHandler.show`."""

from __future__ import annotations

from dataclasses import dataclass

from hippodrome.control.http import Request
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.place import Standing
from hippodrome.control.model.project import Project
from hippodrome.control.participants.path import Stop


@dataclass(frozen=True)
class Visit:
    """A participant's request for the page of the step that is due. `project` has their own path, and at a game the
    section `trial` of that game."""

    request: Request
    project: Project
    user_id: str
    standing: Standing
    step: Step
    wrong: tuple[str, ...] = ()
    number: int = 1

    @classmethod
    def at(cls, request: Request, user_id: str, stop: Stop) -> Visit:
        """Return the visit of a participant who stops at this step."""
        project = stop.project.at_game(stop.step, stop.standing.assignment)
        return cls(request, project, user_id, stop.standing, stop.step, stop.wrong, stop.number)

    @property
    def progress(self) -> Progress:
        """The participant's progress."""
        return self.standing.progress
