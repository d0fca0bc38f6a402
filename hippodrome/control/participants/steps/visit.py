"""The argument of `StepHandler.show`."""

from __future__ import annotations

from dataclasses import dataclass

from hippodrome.control.http import Request
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.project import Project, Step


@dataclass(frozen=True)
class Visit:
    """A participant's request for the page of the step that is due."""

    request: Request
    project: Project
    user_id: str
    progress: Progress
    step: Step
