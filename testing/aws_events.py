"""Builds the events that AWS passes to the functions, for all tests and benches.

`load` reads a whole payload from `tests/events`; the ids in these payloads are made up. The events of `http_event`,
`queue_event` and `task_event` have only the keys that the functions read. Those of `sqs_event` and `ecs_event` have all
keys that AWS sends.
"""

from __future__ import annotations

import base64
import json
import uuid
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

ACCOUNT = "123456789012"
IMAGE = f"{ACCOUNT}.dkr.ecr.us-east-1.amazonaws.com/hippodrome:latest"
EVENTS = Path(__file__).parents[1] / "tests" / "events"

LIFE = ["PROVISIONING", "PENDING", "ACTIVATING", "RUNNING", "DEACTIVATING", "STOPPING", "DEPROVISIONING", "STOPPED"]
REASONS = {
    "EssentialContainerExited": "Essential container in task exited",
    "UserInitiated": "Task stopped by user",
    "SpotInterruption": "Your Spot Task was interrupted.",
    "TaskFailedToStart": "CannotPullContainerError: pull image manifest has been retried 5 time(s)",
    "TerminationNotice": "Your Spot Task was interrupted.",
    "InfrastructureHealth": "Task stopped because of a problem of the infrastructure",
}


def load(name: str) -> Any:
    """Return the payload in `tests/events/{name}.json`."""
    return json.loads((EVENTS / f"{name}.json").read_text())


FORM, JSON = "application/x-www-form-urlencoded", "application/json"


def http_event(
    method: str = "GET",
    query: str = "",
    body: str | bytes | None = None,
    path: str = "/next",
    headers: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return a request as an HTTP API passes it to a function (payload format 2.0). A body of bytes becomes base64."""
    event: dict[str, Any] = {
        "version": "2.0",
        "rawPath": path,
        "rawQueryString": query,
        "headers": dict(headers or {}),
        "requestContext": {"http": {"method": method, "path": path}},
    }
    if isinstance(body, bytes):
        event |= {"body": base64.b64encode(body).decode(), "isBase64Encoded": True}
    elif body is not None:
        event |= {"body": body, "isBase64Encoded": False}
    return event


def program_event(method: str, query: Mapping[str, str] | str, form: Mapping[str, str] | str = "") -> dict[str, Any]:
    """Return the request of a program that sends a form and accepts JSON."""
    query, form = (fields if isinstance(fields, str) else urlencode(fields) for fields in (query, form))
    return http_event(method, query, form, headers={"accept": JSON, "content-type": FORM, "host": "study.example.org"})


def queue_event(bodies: Sequence[Any], ids: Sequence[str] = ()) -> dict[str, Any]:
    """Return a batch of messages of a queue. A body that is no text becomes JSON. The `ids` are 1, 2, … unless given."""
    texts = [body if isinstance(body, str) else json.dumps(body) for body in bodies]
    named = ids or [str(number) for number in range(1, len(texts) + 1)]
    return {"Records": [{"messageId": id, "body": text} for id, text in zip(named, texts, strict=True)]}


def task_event(
    arn: str,
    name: str,
    last: str,
    desired: str = "RUNNING",
    *,
    cluster: str = "hippodrome",
    interface: str = "",
    stop_code: str | None = None,
    reason: str = "",
    exit_code: int | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Return an "ECS Task State Change" event; `last` and `desired` are the task's lastStatus and desiredStatus.

    `stop_code`, `reason` and `exit_code` are only in events of tasks that end, as on ECS. `more` are further keys of
    the detail.
    """
    ended = last in ("DEPROVISIONING", "STOPPED")
    container: dict[str, Any] = {"name": "trial", "lastStatus": "STOPPED" if ended else "RUNNING"}
    if ended and exit_code is not None:
        container["exitCode"] = exit_code
    details = [{"name": "networkInterfaceId", "value": interface}]
    detail: dict[str, Any] = {
        "taskArn": arn,
        "clusterArn": f"arn:aws:ecs:us-east-1:{ACCOUNT}:cluster/{cluster}",
        "startedBy": name,
        "lastStatus": last,
        "desiredStatus": desired,
        "containers": [container],
        "attachments": [{"type": "eni", "details": details}] if interface else [],
        **more,
    }
    if desired == "STOPPED":
        detail |= {"stopCode": stop_code} if stop_code else {}
        detail["stoppedReason"] = reason
    return {"source": "aws.ecs", "detail-type": "ECS Task State Change", "detail": detail}


def sqs_event(bodies: Sequence[Any], queue_arn: str, region: str) -> dict[str, Any]:
    """Return the event that Lambda gets for these messages of an SQS queue. A body that is no text becomes JSON."""
    now = str(int(datetime.now(UTC).timestamp() * 1000))
    return {
        "Records": [
            {
                "messageId": str(uuid.uuid4()),
                "receiptHandle": "AQEB" + uuid.uuid4().hex,
                "body": body if isinstance(body, str) else json.dumps(body),
                "attributes": {
                    "ApproximateReceiveCount": "1",
                    "SentTimestamp": now,
                    "SenderId": "AIDAIENQZJOLO23YVJ4VO",
                    "ApproximateFirstReceiveTimestamp": now,
                },
                "messageAttributes": {},
                "md5OfBody": uuid.uuid4().hex,
                "eventSource": "aws:sqs",
                "eventSourceARN": queue_arn,
                "awsRegion": region,
            }
            for body in bodies
        ]
    }


def ecs_event(
    *,
    region: str,
    arn: str,
    cluster_arn: str,
    definition: str,
    status: str,
    desired: str,
    started_by: str,
    capacity_provider: str | None,
    overrides: Mapping[str, Any],
    subnet: str,
    interface: str,
    private_ip: str,
    stop_code: str = "EssentialContainerExited",
    reason: str | None = None,
    exit_code: int | None = 0,
    container_reason: str = "",
    version: int = 1,
    time: datetime,
    ids: Iterator[str] | None = None,
) -> dict[str, Any]:
    """Return an "ECS Task State Change" event of a Fargate task with all its keys, as EventBridge delivers it.

    Source: Amazon ECS Developer Guide, task state change events, and events of real tasks. Containers and attachments
    have no public address. `ids` gives the ids of attachment, container and event; without it they are random.
    """
    fresh = ids or iter(lambda: str(uuid.uuid4()), "")
    attachment, container, event_id = next(fresh), next(fresh), next(fresh)
    at = LIFE.index(status)
    ago = {"created": 40, "pull": 25, "start": 1}  # seconds before this event
    stamps = {name: _stamp(time - timedelta(seconds=seconds)) for name, seconds in ago.items()}
    task_id = last(arn)
    has_interface = at >= LIFE.index("PENDING")
    contained: dict[str, Any] = {
        "containerArn": f"arn:aws:ecs:{region}:{ACCOUNT}:container/{last(cluster_arn)}/{task_id}/{container}",
        "lastStatus": "RUNNING" if status == "RUNNING" else "STOPPED" if at > 4 else "PENDING",
        "name": "trial",
        "image": IMAGE,
        "taskArn": arn,
        "networkInterfaces": (
            [{"attachmentId": attachment, "privateIpv4Address": private_ip}] if has_interface else []
        ),
        "cpu": "0",
    }
    if status == "RUNNING" or at > 4:
        contained["runtimeId"] = f"{task_id}-2531612879"
        contained["imageDigest"] = "sha256:0c8e1f4a" + "5d" * 28
    if at > LIFE.index("STOPPING") and exit_code is not None and stop_code != "TaskFailedToStart":
        contained["exitCode"] = exit_code
    if container_reason:
        contained["reason"] = container_reason
    details = [{"name": "subnetId", "value": subnet}]
    if has_interface:
        details += [
            {"name": "networkInterfaceId", "value": interface},
            {"name": "macAddress", "value": "0a:98:eb:a7:29:ba"},
            {"name": "privateDnsName", "value": f"ip-{private_ip.replace('.', '-')}.ec2.internal"},
            {"name": "privateIPv4Address", "value": private_ip},
        ]
    attached = "PRECREATED" if not has_interface else "DELETED" if status == "STOPPED" else "ATTACHED"
    detail: dict[str, Any] = {
        "attachments": [{"id": attachment, "type": "eni", "status": attached, "details": details}],
        "attributes": [{"name": "ecs.cpu-architecture", "value": "x86_64"}],
        "availabilityZone": f"{region}a",
        "capacityProviderName": capacity_provider,
        "clusterArn": cluster_arn,
        "containers": [contained],
        "cpu": overrides.get("cpu", "1024"),
        "createdAt": stamps["created"],
        "desiredStatus": desired,
        "enableExecuteCommand": False,
        "ephemeralStorage": {"sizeInGiB": 20},
        "group": f"family:{last(definition).partition(':')[0]}",
        "launchType": "FARGATE",
        "lastStatus": status,
        "memory": overrides.get("memory", "2048"),
        "overrides": dict(overrides),
        "platformVersion": "1.4.0",
        "startedBy": started_by,
        "taskArn": arn,
        "taskDefinitionArn": definition,
        "updatedAt": _stamp(time),
        "version": version,
    }
    if capacity_provider is None:
        del detail["capacityProviderName"]
    if at >= LIFE.index("RUNNING"):
        detail |= {"connectivity": "CONNECTED", "connectivityAt": stamps["pull"], "pullStartedAt": stamps["pull"]}
        if stop_code != "TaskFailedToStart":
            detail |= {"pullStoppedAt": stamps["start"], "startedAt": stamps["start"]}
    if desired == "STOPPED":
        detail |= {"stopCode": stop_code, "stoppedReason": reason or REASONS[stop_code]}
        detail["stoppingAt"] = stamps["start"]
    if status == "STOPPED":
        detail["stoppedAt"] = _stamp(time)
    if at > LIFE.index("STOPPING"):
        detail["executionStoppedAt"] = _stamp(time)
    return {
        "version": "0",
        "id": event_id,
        "detail-type": "ECS Task State Change",
        "source": "aws.ecs",
        "account": ACCOUNT,
        "time": time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "region": region,
        "resources": [arn],
        "detail": detail,
    }


def _stamp(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def last(arn: str) -> str:
    """Return the part of an ARN, URL or path after its last slash."""
    return arn.rpartition("/")[2]
