"""Publishes the messages of a step that a participant reaches (`events` in config.yml)."""

from __future__ import annotations

from hippodrome.control.model import participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.ports import Platform, Topic


def publish_events(platform: Platform, project: Project, user_id: str, step: Step) -> None:
    """Publish the start message, the stop message, or none, according to the project's `events` at this step."""
    if participant.starts_server(project, step):
        platform.bus.publish(Topic.START, to_message(StartServer(project.id, user_id)))
    if participant.stops_server(project, step):
        publish_stop(platform, project, user_id)


def publish_stop(platform: Platform, project: Project, user_id: str) -> None:
    """Publish the stop message, if the study has servers."""
    if project.events.start_server_step is not None:
        platform.bus.publish(Topic.STOP, to_message(StopServer(project.id, user_id)))
