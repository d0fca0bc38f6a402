"""Messages of the topics and queues, and ECS events: their records, and how they are parsed from untrusted JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from hippodrome.model import ids
from hippodrome.model.records import Record, from_data
from hippodrome.ports import Message
from protocol.session import is_session_id

STOP_REASON_PREFIX = "hippodrome:"  # begins each stoppedReason that our functions give
_WORDS_BEFORE_CODE = (  # in stoppedReason; they decide even if there is a stopCode
    ("SpotInterruption", re.compile(r"\bspot\b.{0,40}\binterrupt", re.IGNORECASE)),
    ("InfrastructureHealth", re.compile(r"performing maintenance on the underlying infrastructure", re.IGNORECASE)),
)
_WORDS_WITHOUT_CODE = (  # they decide only if there is no stopCode
    ("UserInitiated", re.compile(r"stopped by user", re.IGNORECASE)),
    ("EssentialContainerExited", re.compile(r"essential container in task exited", re.IGNORECASE)),
    (
        "TaskFailedToStart",
        re.compile(r"failed to start|timeout waiting|^(Cannot|ResourceInit|ContainerRuntime|Internal)", re.IGNORECASE),
    ),
)


class StartServer(Record, frozen=True):
    """Start topic: start this participant's server. `attempt` is from 1.

    `user_id` may also be a warm server's id, or a session's. If sessions of the project have several players, a
    participant's message starts no server of their own: it says that they are under way to the game. `players` is the
    number of players of a session; 0: the number that its record says, or else the one that is registered now.
    """

    project_id: str
    user_id: str
    attempt: int = 1
    players: int = 0


class StopServer(Record, frozen=True):
    """Stop topic: stop the server, but only this attempt. HIPPO's messages name none: then stop any attempt."""

    project_id: str
    user_id: str
    attempt: int | None = None
    reason: str = "stopped"


class StopUser(Record, frozen=True):
    """Stop topic: stop the participant's servers of all projects. HIPPO's relay and timers name no project."""

    user_id: str


class KeepWarm(Record, frozen=True):
    """Start topic: bring the project's pool of warm servers to its size."""

    keep_warm: str  # the project's id


class ServerAttempt(Record, frozen=True):
    """One attempt of a server."""

    label: str
    attempt: int


class DnsChanged(Record, frozen=True):
    """From `task_changed` to itself: check whether this DNS change is INSYNC. `looked` counts the checks before.

    `unmade`: the zone was busy, so the change must still be made.
    """

    change: str
    servers: list[ServerAttempt]
    looked: int = 0
    unmade: bool = False


class TaskSeen(Record, frozen=True):
    """To `task_changed`, from itself or the sweep: this task runs and has no DNS name yet."""

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
    stop_code: str | None
    stopped_reason: str
    exit_code: int | None
    container_reason: str = ""
    looked: int = 0  # how often its address was looked up before


def body_of(record: Any) -> Any:
    """The JSON body of a record of SQS or SNS, taken out of SNS's envelope if there is one; None if it is not JSON.

    An event that SNS sends to a function has the envelope as an object:
    https://docs.aws.amazon.com/lambda/latest/dg/with-sns.html
    """
    try:
        if "Sns" in record:
            return json.loads(record["Sns"]["Message"])
        body = json.loads(record["body"])
        if isinstance(body, dict) and body.get("Type") == "Notification":
            body = json.loads(body["Message"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return body


def parse_start_server(body: Any) -> StartServer | KeepWarm | None:
    """The start message in a body; None if it is not a valid one."""
    warm: KeepWarm | None = _read(body, KeepWarm)
    if warm:
        return warm if ids.is_project_id(warm.keep_warm) else None
    message: StartServer | None = _read(body, StartServer)
    return message if message and _ids_are_valid(message) and message.attempt >= 1 else None


def parse_stop_server(body: Any) -> StopServer | StopUser | None:
    """The stop message in a body; None if it is not a valid one."""
    if isinstance(body, dict) and body.get("projectId") is None:
        everywhere: StopUser | None = _read(body, StopUser)
        return everywhere if everywhere and ids.is_user_id(everywhere.user_id) else None
    message: StopServer | None = _read(body, StopServer)
    return message if message and _ids_are_valid(message) else None


def parse_dns_changed(body: Any) -> DnsChanged | None:
    """The follow-up message in a body; None if it is not a valid one."""
    message: DnsChanged | None = _read(body, DnsChanged)
    return message


def parse_task_changed(body: Any) -> TaskChanged | None:
    """The ECS event or the `TaskSeen` in a body; None if it is neither, or if the task is not a server's."""
    seen: TaskSeen | None = _read(body, TaskSeen)
    if seen:
        named = TaskChanged(
            seen.task, seen.cluster, seen.name, "RUNNING", seen.interface, None, "", None, "", seen.looked
        )
        return named if ids.parse_server_name(seen.name) else None
    try:
        detail = body["detail"]
        if body["source"] != "aws.ecs" or ids.parse_server_name(detail["startedBy"]) is None:
            return None
        interfaces = [a for a in detail.get("attachments", []) if a["type"] in ("eni", "ElasticNetworkInterface")]
        details = {d["name"]: d["value"] for a in interfaces for d in a["details"]}
        containers = detail.get("containers", [])
        exits = [c["exitCode"] for c in containers if c.get("exitCode") is not None]
        return TaskChanged(
            task=str(detail["taskArn"]),
            cluster=str(detail["clusterArn"]).rsplit("/", 1)[-1],
            name=detail["startedBy"],
            status=_status(detail),
            interface=details.get("networkInterfaceId"),
            stop_code=_stop_code(detail),
            stopped_reason=str(detail.get("stoppedReason") or ""),
            exit_code=exits[0] if exits else None,
            container_reason=" ".join(str(c["reason"]) for c in containers if c.get("reason")),
        )
    except (KeyError, TypeError, AttributeError):
        return None


def _status(detail: Mapping[str, Any]) -> str:
    """`lastStatus`, or STOPPING; DEPROVISIONING only if the event has all that is needed about the task's end."""
    last = str(detail["lastStatus"])
    if last == "RUNNING" and detail.get("desiredStatus") == "STOPPED":
        return "STOPPING"
    if last == "DEPROVISIONING" and not _has_ended(detail):
        return "STOPPING"
    return last


def _has_ended(detail: Mapping[str, Any]) -> bool:
    """Whether no container runs any more and the event says why: a trial that ended by itself has an exit code."""
    containers, code = detail.get("containers", []), _stop_code(detail)
    exited = code != "EssentialContainerExited" or any(c.get("exitCode") is not None for c in containers)
    return bool(code) and exited and all(c.get("lastStatus") == "STOPPED" for c in containers)


def _stop_code(detail: Mapping[str, Any]) -> str | None:
    """`stopCode`, or the code that `stoppedReason` belongs to (ECS Developer Guide, "Stopped task error messages").

    A Spot interruption is recognised by its words: real events came without a code (aws/containers-roadmap, issues 797
    and 1565), and a program that ends within the two minutes after the warning has the exit code 0. The retirement of
    a Fargate machine also has words of its own ("Task retirement and maintenance"), with any code.
    """
    code, words = detail.get("stopCode"), str(detail.get("stoppedReason") or "")
    if words.startswith(STOP_REASON_PREFIX):
        return "UserInitiated"
    certain = next((name for name, pattern in _WORDS_BEFORE_CODE if pattern.search(words)), None)
    if certain and not (certain == "SpotInterruption" and code == "TerminationNotice"):
        return certain
    return str(code) if code else next((name for name, pattern in _WORDS_WITHOUT_CODE if pattern.search(words)), None)


def to_message(record: Record) -> Message:
    """The message as plain JSON data for the bus."""
    return dict(msgspec.to_builtins(record))


def _read(body: Any, kind: type[Any]) -> Any:
    try:
        return from_data(body, kind)
    except (msgspec.ValidationError, RecursionError):
        return None


def _ids_are_valid(message: StartServer | StopServer) -> bool:
    known = ids.is_user_id(message.user_id) or ids.is_warm_id(message.user_id) or is_session_id(message.user_id)
    return known and ids.is_project_id(message.project_id)
