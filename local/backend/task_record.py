"""What is kept on the disk of each task, and the ECS events that tell of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hippodrome.ports import TaskRequest
from local.backend import files
from protocol import environment
from protocol.keys import handover_key
from protocol.session import owner_folder

ARN = "arn:aws:ecs:local:000000000000"
HOST = "127.0.0.1"
KILLED = 137
"""The exit code of a process that SIGKILL has ended."""


@dataclass(frozen=True)
class TaskRecord:
    """A task as it is kept on the disk."""

    name: str
    cluster: str
    id: str
    created: str
    pid: int | None = None  # of the shell, which leads the process group
    port: int | None = None
    status: str = "PROVISIONING"  # the last status that was told
    version: int = 0
    started: str | None = None
    stopped: str | None = None
    asked: str | None = None  # why it was asked to stop
    folder: str = ""  # the participant's or the session's, below data and spool; empty until a warm server has one
    server: str = ""  # the name of its recordings' folder, if not its own
    handover_key: str = ""  # of a warm server's handover; stored as `warm_server`
    kept: bool = False  # whether recordings belong into the data folder
    claim: str = ""  # a hash of its token: which server of that name it is

    @property
    def arn(self) -> str:
        return f"{ARN}:task/{self.cluster}/{self.id}"

    @property
    def interface(self) -> str:
        return f"eni-{self.id[:17]}"

    @classmethod
    def of(cls, request: TaskRequest, id_: str) -> TaskRecord:
        """The task that is requested, before it has a process."""
        return cls(
            name=request.name,
            cluster=request.cluster,
            id=id_,
            created=now(),
            folder=_folder(request.environment),
            handover_key=_handover_key(request),
            kept=_kept(request.environment),
            claim=claim_of(request),
        )


class TaskFolder:
    """The folder of the tasks' files: of each its record, and the notes of its shell (`processes.SHELL`)."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def save(self, task: TaskRecord) -> None:
        """Keep the record. Raises OSError."""
        # After a power cut every process is gone: to know that there was one is enough to tell its end.
        files.write_json(self.file(task.name), _to_json(task), durable=task.version == 0)

    def load(self) -> Iterator[TaskRecord]:
        """The records that can be read. Raises OSError."""
        for name in files.names(self.path, ".json"):
            try:
                yield _from_json(files.read_json(self.path / name))
            except TypeError:
                continue

    def note(self, name: str, kind: str) -> str:
        """What the shell has written ("pid" or "exit"); empty if it has not. Raises OSError."""
        try:
            return self.file(name, kind).read_text().strip()
        except FileNotFoundError:
            return ""

    def remove_notes(self, name: str) -> None:
        """Remove what the shell has written. Raises OSError."""
        for kind in ("pid", "exit"):
            self.file(name, kind).unlink(missing_ok=True)

    def file(self, name: str, kind: str = "json") -> Path:
        """A file of the task's: its record ("json"), or a note."""
        return self.path / f"{name}.{kind}"


def _to_json(task: TaskRecord) -> dict[str, Any]:
    """The record as it is stored."""
    return {"warm_server" if name == "handover_key" else name: value for name, value in asdict(task).items()}


def _from_json(stored: Any) -> TaskRecord:
    """The stored record. Raises TypeError if this is no record."""
    fields = dict(**stored)
    handover = fields.pop("warm_server", "")
    return TaskRecord(**fields, handover_key=handover)


def event(task: TaskRecord, exit_code: int | None = None) -> dict[str, Any]:
    """The "ECS Task State Change" event of EventBridge for this state of a task."""
    details = {"subnetId": "subnet-local", "networkInterfaceId": task.interface, "privateIPv4Address": HOST}
    detail: dict[str, Any] = {
        "taskArn": task.arn,
        "clusterArn": f"{ARN}:cluster/{task.cluster}",
        "taskDefinitionArn": f"{ARN}:task-definition/local:1",
        "group": "family:local",
        "launchType": "FARGATE",
        "lastStatus": task.status,
        "desiredStatus": "STOPPED" if task.asked or task.status == "STOPPED" else "RUNNING",
        "startedBy": task.name,
        "version": task.version,
        "createdAt": task.created,
        "updatedAt": now(),
        "attachments": [
            {
                "id": f"{task.id[:8]}-attachment",
                "type": "eni",
                "status": {"RUNNING": "ATTACHED", "STOPPED": "DELETED"}.get(task.status, "PRECREATED"),
                "details": [{"name": name, "value": value} for name, value in details.items()],
            }
        ],
        "containers": [{"name": "trial", "lastStatus": task.status, "taskArn": task.arn}],
    }
    if task.started:
        detail["startedAt"] = task.started
    if task.status == "STOPPED":
        detail["stoppedAt"] = task.stopped
        if task.asked:
            detail |= {"stopCode": "UserInitiated", "stoppedReason": task.asked}
        elif exit_code is None:
            detail |= {"stopCode": "TaskFailedToStart", "stoppedReason": "The process could not be started"}
        else:
            killed = ": the process was killed" if exit_code == KILLED else ""
            said = f"Essential container in task exited{killed}"
            detail |= {"stopCode": "EssentialContainerExited", "stoppedReason": said}
        if exit_code is not None:
            detail["containers"][0]["exitCode"] = exit_code
    return {
        "version": "0",
        "id": f"{task.id[:8]}-{task.version}",
        "detail-type": "ECS Task State Change",
        "source": "aws.ecs",
        "account": "000000000000",
        "time": now(),
        "region": "local",
        "resources": [task.arn],
        "detail": detail,
    }


def claim_of(request: TaskRequest) -> str:
    """A hash of the server's token: which of the servers of that name it is."""
    return hashlib.sha256(request.environment.get(environment.TOKEN, "").encode()).hexdigest()[:16]


def folder_of(project_id: str, owner: str) -> str:
    """Where everything of a server's participant lies, or of its session if that is the `owner`."""
    return owner_folder(project_id, owner).rstrip("/")


def _folder(told: Mapping[str, str]) -> str:
    """As `folder_of`; empty for a warm server."""
    owner = told.get(environment.SESSION) or told.get(environment.USER_ID)
    return folder_of(told.get(environment.PROJECT_ID, ""), owner) if owner else ""


def _handover_key(request: TaskRequest) -> str:
    """The key of a warm server's handover; empty for any other server."""
    told = request.environment
    if told.get(environment.WARM_SERVER) != "on":
        return ""
    return handover_key(told.get(environment.PROJECT_ID, ""), told.get(environment.SERVER, ""))


def _kept(told: Mapping[str, str]) -> bool:
    """Whether the project wants recordings kept (`s3upload`)."""
    try:
        return json.loads(told[environment.TRIAL]).get("s3upload") is not False
    except (KeyError, ValueError, AttributeError):
        return False


def now() -> str:
    """The time as ECS writes it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
