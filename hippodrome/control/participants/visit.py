"""A visit: one request of a participant, and what its handlers share. From `journey.py` on it is handed along whole."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

from hippodrome.control.http import Request
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import Texts


@dataclass(frozen=True)
class Visit:
    """One request of a participant. `now` is when it came.

    `project` is the study as it is registered. Once the participant's path is known, it is `on` their own path, and at
    a game it has the section `trial` of that game. `user_id` is empty until the link is read.
    """

    request: Request
    project: Project
    user_id: str
    now: datetime

    @cached_property
    def texts(self) -> Texts:
        """The study's texts."""
        return Texts(self.project.texts)

    def on(self, project: Project) -> Visit:
        """Return the visit with another form of its study, such as the participant's own path."""
        return self if project is self.project else replace(self, project=project)
