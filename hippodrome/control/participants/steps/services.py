"""The services that the handlers of all types of steps share."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
from hippodrome.control.participants.answers import Answers
from hippodrome.control.participants.waiting import ServerStates
from hippodrome.control.ports import Platform
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository


@dataclass(frozen=True)
class StepServices:
    """The services and caches of one running function for all handlers of steps."""

    platform: Platform
    project_cache: ProjectCache
    repository: Repository
    answers: Answers
    waiting: ServerStates

    def state(
        self,
        project: Project,
        user_id: str,
        step: Step | None,
        record: Server | None,
        since: datetime | None = None,
        *,
        asked: int | None = None,
    ) -> dict[str, Any]:
        """Return the state of the participant's server as JSON data (docs/pages.md); see `ServerStates.state`."""
        dns, now = self.platform.dns, self.platform.now()
        return self.waiting.state(project, user_id, step, record, dns=dns, now=now, since=since, asked=asked)
