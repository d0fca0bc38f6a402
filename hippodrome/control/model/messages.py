"""The records of messages and ECS events, which functions parse here from untrusted JSON. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import msgspec

from hippodrome.control.model import ids
from hippodrome.control.model.records import Record, from_data
from hippodrome.control.ports import Message
from hippodrome.protocol.session import is_session_id

R = TypeVar("R", bound=Record)
CONTAINER = "trial"
"""The name of the container that runs the trial. AWS may put others into its task, such as GuardDuty's sidecar."""
STOP_REASON_PREFIX = "hippodrome:"  # begins each stoppedReason that our functions give
_WORDS_BEFORE_CODE = (  # patterns of stoppedReason that decide even if there is a stopCode
    ("SpotInterruption", re.compile(r"\bspot\b.{0,40}\binterrupt", re.IGNORECASE)),
    ("InfrastructureHealth", re.compile(r"performing maintenance on the underlying infrastructure", re.IGNORECASE)),
)
_WORDS_WITHOUT_CODE = (  # patterns of stoppedReason that decide only if there is no stopCode
    ("UserInitiated", re.compile(r"stopped by user", re.IGNORECASE)),
    ("EssentialContainerExited", re.compile(r"essential container in task exited", re.IGNORECASE)),
    (
        "TaskFailedToStart",
        re.compile(r"failed to start|timeout waiting|^(Cannot|ResourceInit|ContainerRuntime|Internal)", re.IGNORECASE),
    ),
)


class StartServer(Record, frozen=True):
    """A message of the start topic: start this participant's server. `attempt` counts from 1.

    `user_id` may also be a warm server's id, or a session's. In a project with several players a participant's message
    starts no server of their own: it says that they are under way to the game. `players` is the number of players of a
    session; 0 means the number in its server's record, or the registered number if there is no record.
    """

    project_id: str
    user_id: str
    attempt: int = 1
    players: int = 0


class StopServer(Record, frozen=True):
    """A message of the stop topic: stop this attempt of the server.

    Without `attempt`, as in HIPPO's messages, it means the present attempt.
    """

    project_id: str
    user_id: str
    attempt: int | None = None
    reason: str = "stopped"


class StopUser(Record, frozen=True):
    """A message of the stop topic: stop the participant's servers in all projects.

    HIPPO's relay and timers send it, since they name no project.
    """

    user_id: str


class KeepWarm(Record, frozen=True):
    """A message of the start topic: bring the project's pool of warm servers to its size."""

    keep_warm: str  # the project's id


class ServerAttempt(Record, frozen=True):
    """One attempt of a server, by the label of the server's record."""

    label: str
    attempt: int


class DnsChanged(Record, frozen=True):
    """A message from `task_changed` to itself: check whether this DNS change is INSYNC. If so, the servers are ready.

    `looked` counts the earlier checks. With `unmade`, the zone was busy, and the change must still be made.
    """

    change: str
    servers: list[ServerAttempt]
    looked: int = 0
    unmade: bool = False


class TaskSeen(Record, frozen=True):
    """A message to `task_changed`, from itself or the sweep: this task runs and has no DNS record yet.

    `looked` counts how often its address was looked up before.
    """

    task: str
    cluster: str
    name: str  # startedBy
    interface: str
    looked: int = 0


class TaskChanged(NamedTuple):
    """The fields of an "ECS Task State Change" event that are used."""

    task: str
    cluster: str
    name: str  # startedBy
    status: str  # lastStatus; STOPPING if it is to stop and its container may still run, as after Spot's warning
    interface: str | None  # the id of its network interface
    stop_code: str | None = None
    stopped_reason: str = ""
    exit_code: int | None = None
    container_reason: str = ""
    looked: int = 0  # how often its address was looked up before


def body_of(record: Any) -> Any:
    """Return the JSON message in a record of SQS or SNS; None if it is not JSON in UTF-8 (RFC 8259).

    What UTF-8 cannot hold, half of a surrogate pair, is refused here: no document or name of ours could hold it.

    SNS puts a message into an envelope. In an SQS record the envelope is JSON text; in an event that SNS sends to a
    function it is an object: https://docs.aws.amazon.com/lambda/latest/dg/with-sns.html
    """
    try:
        if "Sns" in record:
            return msgspec.json.decode(record["Sns"]["Message"])
        body = msgspec.json.decode(record["body"])
        if isinstance(body, dict) and body.get("Type") == "Notification":
            body = msgspec.json.decode(body["Message"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return body


def parse_start_server(body: Any) -> StartServer | KeepWarm | None:
    """Read a message of the start topic; None if it is not a valid one."""
    if warm := _read(body, KeepWarm):
        return warm if ids.is_project_id(warm.keep_warm) else None
    message = _read(body, StartServer)
    return message if message and _ids_are_valid(message) and message.attempt >= 1 else None


def parse_stop_server(body: Any) -> StopServer | StopUser | None:
    """Read a message of the stop topic; None if it is not a valid one."""
    if isinstance(body, dict) and body.get("projectId") is None:
        everywhere = _read(body, StopUser)
        return everywhere if everywhere and ids.is_user_id(everywhere.user_id) else None
    message = _read(body, StopServer)
    return message if message and _ids_are_valid(message) else None


def parse_dns_changed(body: Any) -> DnsChanged | None:
    """Read a message about a DNS change; None if it is not a valid one."""
    return _read(body, DnsChanged)


def parse_task_changed(body: Any) -> TaskChanged | None:
    """Read an ECS event or a `TaskSeen`; None if the body is neither, or if the task is not a server's."""
    if task_seen := _read(body, TaskSeen):
        running = TaskChanged(
            task_seen.task,
            task_seen.cluster,
            task_seen.name,
            status="RUNNING",
            interface=task_seen.interface,
            looked=task_seen.looked,
        )
        return running if ids.parse_server_name(task_seen.name) else None
    try:
        detail = body["detail"]
        if body["source"] != "aws.ecs" or ids.parse_server_name(detail["startedBy"]) is None:
            return None
        interfaces = [a for a in detail.get("attachments", []) if a["type"] in ("eni", "ElasticNetworkInterface")]
        details = {d["name"]: d["value"] for a in interfaces for d in a["details"]}
        container = _container(detail)
        return TaskChanged(
            task=str(detail["taskArn"]),
            cluster=str(detail["clusterArn"]).rsplit("/", 1)[-1],
            name=detail["startedBy"],
            status=_status(detail),
            interface=details.get("networkInterfaceId"),
            stop_code=_stop_code(detail),
            stopped_reason=str(detail.get("stoppedReason") or ""),
            exit_code=container.get("exitCode"),
            container_reason=str(container.get("reason") or ""),
        )
    except (KeyError, TypeError, AttributeError):
        return None


def _container(detail: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the event says of the trial's container; empty if it says nothing of it."""
    return next((container for container in detail.get("containers", []) if container.get("name") == CONTAINER), {})


def _status(detail: Mapping[str, Any]) -> str:
    """`lastStatus`; STOPPING instead, if the trial may still run or the event does not say how they ended."""
    last = str(detail["lastStatus"])
    if last == "RUNNING" and detail.get("desiredStatus") == "STOPPED":
        return "STOPPING"
    if last == "DEPROVISIONING" and not _has_ended(detail):
        return "STOPPING"
    return last


def _has_ended(detail: Mapping[str, Any]) -> bool:
    """Whether the trial has stopped and the event says why: a trial that ended by itself needs an exit code."""
    container, code = _container(detail), _stop_code(detail)
    exited = code != "EssentialContainerExited" or container.get("exitCode") is not None
    return bool(code) and exited and container.get("lastStatus", "STOPPED") == "STOPPED"


def _stop_code(detail: Mapping[str, Any]) -> str | None:
    """`stopCode`, or the code for the words in `stoppedReason` (ECS Developer Guide, "Stopped task error messages").

    A Spot interruption is recognised by its words: real events came without a code (aws/containers-roadmap, issues 797
    and 1565), and a program that ends within the two minutes after the warning has the exit code 0. The retirement of a
    Fargate machine is recognised by its words too ("Task retirement and maintenance"), whatever the code.
    """
    code, words = detail.get("stopCode"), str(detail.get("stoppedReason") or "")
    if words.startswith(STOP_REASON_PREFIX):
        return "UserInitiated"
    certain = next((name for name, pattern in _WORDS_BEFORE_CODE if pattern.search(words)), None)
    if certain and not (certain == "SpotInterruption" and code == "TerminationNotice"):
        return certain
    return str(code) if code else next((name for name, pattern in _WORDS_WITHOUT_CODE if pattern.search(words)), None)


def to_message(record: Record) -> Message:
    """Return the message as plain JSON data for the bus."""
    return dict(msgspec.to_builtins(record))


def _read(body: Any, kind: type[R]) -> R | None:
    """Read a record of this kind; None if the body is no such record."""
    try:
        return from_data(body, kind)
    except ValueError:
        return None


def _ids_are_valid(message: StartServer | StopServer) -> bool:
    is_known = ids.is_user_id(message.user_id) or ids.is_warm_id(message.user_id) or is_session_id(message.user_id)
    return is_known and ids.is_project_id(message.project_id)
