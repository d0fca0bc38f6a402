"""A Fargate task in memory, with its states and their ECS events, for the platforms on which tasks start and end."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from hippodrome.control.ports import TaskRequest
from testing import aws_events


class Life(StrEnum):
    """The values of ECS's lastStatus that make a difference for the functions."""

    PROVISIONING = "PROVISIONING"
    RUNNING = "RUNNING"
    DEPROVISIONING = "DEPROVISIONING"  # its container has ended; its network interface is taken down
    STOPPED = "STOPPED"


@dataclass(repr=False)
class Task:
    """A task. `last` and `desired` are ECS's lastStatus and desiredStatus; `version` is that of its latest event."""

    number: int
    request: TaskRequest = field(repr=False)
    host: str
    interface: str
    last: Life = Life.PROVISIONING
    desired: Life = Life.RUNNING
    stop_code: str | None = None
    reason: str = ""
    exit_code: int | None = None
    version: int = 1
    arn: str = field(init=False)

    def __post_init__(self) -> None:
        self.arn = f"arn:aws:ecs:us-east-1:{aws_events.ACCOUNT}:task/{self.request.cluster}/{self.number:032x}"

    @property
    def name(self) -> str:
        """The name of the server that runs on it."""
        return self.request.name

    @property
    def user(self) -> str:
        """The id of the participant for whom it was started; empty for a warm server and for a session's server."""
        return self.request.environment.get("USER_ID", "")

    @property
    def session(self) -> str:
        """The id of the session for which it was started; empty for all other servers."""
        return self.request.environment.get("SESSION", "")

    @property
    def is_warm_server(self) -> bool:
        """Whether it was started as a warm server, for no participant yet."""
        return self.request.environment.get("WARM_SERVER") == "on"

    @property
    def alive(self) -> bool:
        """Whether it was not told to stop."""
        return self.desired is Life.RUNNING

    @property
    def ended(self) -> bool:
        """Whether its container has ended."""
        return self.last in (Life.DEPROVISIONING, Life.STOPPED)

    def stop(self, code: str | None, reason: str, exit_code: int | None = None) -> None:
        """Tell the task to stop, for this reason. The caller changes `last` later."""
        self.desired, self.stop_code, self.reason, self.exit_code = Life.STOPPED, code, reason, exit_code

    def event(self) -> dict[str, Any]:
        """Return the "ECS Task State Change" event of its present state."""
        return aws_events.task_event(
            self.arn,
            self.name,
            str(self.last),
            str(self.desired),
            cluster=self.request.cluster,
            interface=self.interface,
            stop_code=self.stop_code,
            reason=self.reason,
            exit_code=self.exit_code,
            version=self.version,
        )
