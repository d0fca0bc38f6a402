"""The record of a task on the disk, and the ECS events that are made from it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hippodrome.control.ports import TaskRequest
from hippodrome.local.backend import files
from hippodrome.protocol import environment
from hippodrome.protocol.keys import handover_key
from hippodrome.protocol.session import owner_folder

ARN = "arn:aws:ecs:local:000000000000"
HOST = "127.0.0.1"
KILLED = 137
"""The exit code of a process that SIGKILL has ended."""


@dataclass(frozen=True)
class TaskRecord:
    """A task: a server of one participant or session, as it is stored."""

    name: str
    cluster: str
    id: str
    created: str
    pid: int | None = None  # the id of the shell, which leads the process group
    port: int | None = None
    status: str = "PROVISIONING"  # ECS's word for the state, as in the last event
    version: int = 0
    started: str | None = None
    stopped: str | None = None
    asked: str | None = None  # the reason for which it was asked to stop; None if it was not
    folder: str = ""  # of the participant or session, below data and spool; empty until a warm server is assigned
    server: str = ""  # the name of its folder of recordings; empty: its own name
    handover_key: str = ""  # the key of a warm server's handover; stored as `warm_server`
    kept: bool = False  # whether its recordings belong in the data folder
    claim: str = ""  # a hash of its token, by which servers of the same name differ

    @property
    def arn(self) -> str:
        return f"{ARN}:task/{self.cluster}/{self.id}"

    @property
    def interface(self) -> str:
        return f"eni-{self.id[:17]}"

    @classmethod
    def of(cls, request: TaskRequest, id_: str) -> TaskRecord:
        """Return the record of a requested task that has no process yet."""
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
    """The folder with the tasks' files: for each task its record, and the notes of its shell (`processes.SHELL`)."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def save(self, task: TaskRecord) -> None:
        """Write the record. Raises OSError."""
        # After a power cut every process is gone: the first version suffices to send the event of its end.
        files.write_json(self.file(task.name), _to_json(task), durable=task.version == 0)

    def load(self) -> Iterator[TaskRecord]:
        """Yield the records. A record that cannot be parsed is left out. Raises OSError."""
        for name in files.names(self.path, ".json"):
            try:
                yield _from_json(files.read_json(self.path / name))
            except TypeError:
                continue

    def note(self, name: str, kind: str) -> str:
        """Return the shell's note of this kind ("pid" or "exit"); empty if there is none. Raises OSError."""
        try:
            return self.file(name, kind).read_text().strip()
        except FileNotFoundError:
            return ""

    def remove_notes(self, name: str) -> None:
        """Remove the shell's notes. Raises OSError."""
        for kind in ("pid", "exit"):
            self.file(name, kind).unlink(missing_ok=True)

    def file(self, name: str, kind: str = "json") -> Path:
        """Return the path of a task's record (`kind` "json") or of a note of its shell ("pid" or "exit")."""
        return self.path / f"{name}.{kind}"


def _to_json(task: TaskRecord) -> dict[str, Any]:
    """The record as it is stored."""
    return {"warm_server" if name == "handover_key" else name: value for name, value in asdict(task).items()}


def _from_json(stored: Any) -> TaskRecord:
    """The record from its stored form. Raises TypeError if this is none."""
    fields = dict(**stored)
    handover = fields.pop("warm_server", "")
    return TaskRecord(**fields, handover_key=handover)


def event(task: TaskRecord, exit_code: int | None = None) -> dict[str, Any]:
    """Return the "ECS Task State Change" event that EventBridge would send for this state of a task."""
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
            reason = f"Essential container in task exited{killed}"
            detail |= {"stopCode": "EssentialContainerExited", "stoppedReason": reason}
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
    """Return a hash of the server's token. Servers of the same name differ by it."""
    return hashlib.sha256(request.environment.get(environment.TOKEN, "").encode()).hexdigest()[:16]


def folder_of(project_id: str, owner: str) -> str:
    """Return the folder of a participant or a session, relative to the data folder and without a slash at its end.

    `owner` is the participant's or the session's id.
    """
    return owner_folder(project_id, owner).rstrip("/")


def _folder(variables: Mapping[str, str]) -> str:
    """The folder of the server's participant or session; empty for a warm server."""
    owner = variables.get(environment.SESSION) or variables.get(environment.USER_ID)
    return folder_of(variables.get(environment.PROJECT_ID, ""), owner) if owner else ""


def _handover_key(request: TaskRequest) -> str:
    """The key of a warm server's handover; empty for any other server."""
    variables = request.environment
    if variables.get(environment.WARM_SERVER) != "on":
        return ""
    return handover_key(variables.get(environment.PROJECT_ID, ""), variables.get(environment.SERVER, ""))


def _kept(variables: Mapping[str, str]) -> bool:
    """Whether the project keeps recordings (`s3upload`)."""
    try:
        return json.loads(variables[environment.TRIAL]).get("s3upload") is not False
    except (KeyError, ValueError, AttributeError):
        return False


def now() -> str:
    """Return the present time as ECS writes it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
