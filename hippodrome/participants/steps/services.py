"""The services that the handlers of all types of steps share."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from hippodrome.model import participant
from hippodrome.model.messages import StartServer, StopServer, to_message
from hippodrome.model.project import Project, Step
from hippodrome.model.server import Server
from hippodrome.participants.waiting import Waiting
from hippodrome.ports import Platform, Topic
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository


@dataclass(frozen=True)
class StepServices:
    """The services of one running function, which all handlers of steps share."""

    platform: Platform
    project_cache: ProjectCache
    repository: Repository
    waiting: Waiting

    def state(
        self, project: Project, user_id: str, step: Step | None, record: Server | None, since: datetime | None = None
    ) -> dict[str, Any]:
        """The state of the participant's server, for the waiting page (docs/pages.md)."""
        dns, now = self.platform.dns, self.platform.now()
        return self.waiting.state(project, user_id, step, record, dns=dns, now=now, since=since)

    def publish_events(self, project: Project, user_id: str, step: Step) -> None:
        """Publish the start or stop message that reaching `step` calls for."""
        if participant.starts_server(project, step):
            self.platform.bus.publish(Topic.START, to_message(StartServer(project.id, user_id)))
        if participant.stops_server(project, step):
            self.platform.bus.publish(Topic.STOP, to_message(StopServer(project.id, user_id)))
