"""The argument of `StepHandler.show`."""

from __future__ import annotations

from dataclasses import dataclass

from hippodrome.http import Request
from hippodrome.model.participant import Progress
from hippodrome.model.project import Project, Step


@dataclass(frozen=True)
class Visit:
    """A participant's request for the page of the step that is due."""

    request: Request
    project: Project
    user_id: str
    progress: Progress
    step: Step
