"""The events that `MotoWorld` makes have the shape of those in `tests/events`."""

from __future__ import annotations

import base64
import json
from typing import Any

import pytest

from hippodrome.control.ports import TaskRequest
from testing import aws_events
from testing.moto_world import MotoWorld

NAME = "s" + "a" * 20 + "-1"


def _shape(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _shape(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_shape(item) for item in value]
    return type(value).__name__


@pytest.mark.parametrize(
    ("file", "status", "how"),
    [
        ("provisioning", "PROVISIONING", {}),
        ("running", "RUNNING", {}),
        ("spot_warning", "RUNNING", {"desired": "STOPPED", "stop_code": "SpotInterruption"}),
        ("deprovisioning_spot", "DEPROVISIONING", {"stop_code": "SpotInterruption", "exit_code": 143}),
        ("stopped_user", "STOPPED", {"stop_code": "UserInitiated"}),
        ("stopped_spot", "STOPPED", {"stop_code": "SpotInterruption", "exit_code": 143}),
        ("stopped_exit", "STOPPED", {}),
        ("stopped_start_failed", "STOPPED", {"stop_code": "TaskFailedToStart"}),
        ("stopped_crash", "STOPPED", {"exit_code": 1}),
        ("stopped_memory", "STOPPED", {"exit_code": 137, "container_reason": "OutOfMemoryError: Container killed"}),
    ],
)
def test_task_events_have_the_shape_of_the_examples(
    moto_world: MotoWorld, file: str, status: str, how: dict[str, Any]
) -> None:
    task = moto_world.platform.tasks.run(TaskRequest(NAME, "hippodrome", "hippodrome", 1, 2, {"TOKEN": "t"}))
    made = moto_world.task_event(task, status, **how)
    kept = json.loads(aws_events.load(f"sqs_task_{file}")["Records"][0]["body"])
    for event in (made, kept):
        event["detail"].pop("overrides")
    assert _shape(made) == _shape(kept)
    for key in ("lastStatus", "desiredStatus", "stopCode", "stoppedReason"):
        if key != "stoppedReason" or file != "stopped_user":
            assert made["detail"].get(key) == kept["detail"].get(key)


def test_the_event_of_a_stopped_task_gives_the_reason(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    task = tasks.run(TaskRequest(NAME, "hippodrome", "hippodrome", 1, 2, {}))
    first = moto_world.task_event(task, "RUNNING")["detail"]
    tasks.stop(task, "hippodrome", "hippodrome: the stop step")
    last = moto_world.task_event(task, "STOPPED")["detail"]
    assert (last["stopCode"], last["stoppedReason"]) == ("UserInitiated", "hippodrome: the stop step")
    assert last["version"] > first["version"]


def test_sqs_batches_have_the_shape_of_the_examples(moto_world: MotoWorld) -> None:
    made = moto_world.sqs_event("start", [{"projectId": "study"}])["Records"][0]
    kept = aws_events.load("sqs_start_raw")["Records"][0]
    assert set(kept) == set(made)
    assert set(made["attributes"]) <= set(kept["attributes"])
    assert json.loads(made["body"]) == {"projectId": "study"}


def test_a_form_arrives_in_base64_and_json_does_not() -> None:
    form, data = aws_events.load("http_post_form"), aws_events.load("http_post_json")
    assert form["isBase64Encoded"]
    assert base64.b64decode(form["body"]).startswith(b"hippodrome-step=2&")
    assert not data["isBase64Encoded"]
    assert json.loads(data["body"])["age"] == 34
