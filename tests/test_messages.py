import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome import ids, messages
from hippodrome.messages import StartServer, StopServer, to_message

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)
almost = st.fixed_dictionaries(
    {},
    optional={
        "projectId": json_values,
        "userId": json_values,
        "attempt": json_values,
        "source": st.just("aws.ecs") | json_values,
        "detail": st.fixed_dictionaries(
            {"startedBy": st.just("s" + "a" * 20 + "-1")},
            optional={
                "taskArn": json_values,
                "clusterArn": json_values,
                "attachments": json_values,
                "containers": json_values,
            },
        ),
        "change": json_values,
        "servers": json_values,
    },
)


@given(json_values | almost)
def test_no_body_makes_a_parser_fail(body: object) -> None:
    for parse in (messages.start_server, messages.stop_server, messages.task_changed, messages.names_changed):
        parse(body)


@given(st.text() | json_values.map(json.dumps))
def test_no_record_makes_the_envelope_fail(body: str) -> None:
    messages.body_of({"body": body})
    messages.body_of({"body": json.dumps({"Type": "Notification", "Message": body})})
    messages.body_of(body)


def test_hippos_messages_without_an_attempt_are_understood() -> None:
    body = {"projectId": "maze", "userId": "alice"}
    assert messages.start_server(body) == StartServer("maze", "alice", 1)
    assert messages.stop_server(body) == StopServer("maze", "alice", None)


@pytest.mark.parametrize("user", ["../x", "", "a\0", 7, None])
def test_messages_with_malformed_ids_are_not_ours(user: object) -> None:
    assert messages.start_server({"projectId": "maze", "userId": user}) is None
    assert messages.stop_server({"projectId": "maze", "userId": user}) is None


@given(st.from_regex(ids.PROJECT_ID, fullmatch=True), st.from_regex(ids.USER_ID, fullmatch=True), st.integers(1, 9))
def test_messages_survive_the_way_through_topic_and_queue(project: str, user: str, attempt: int) -> None:
    sent = StartServer(project, user, attempt)
    raw = json.dumps(to_message(sent))
    wrapped = json.dumps({"Type": "Notification", "Message": raw})
    assert messages.start_server(messages.body_of({"body": raw})) == sent
    assert messages.start_server(messages.body_of({"body": wrapped})) == sent


def test_tasks_of_others_are_not_ours() -> None:
    event = {"source": "aws.ecs", "detail": {"taskArn": "t", "clusterArn": "c", "lastStatus": "RUNNING"}}
    for started_by in ("ecs-svc/1", "", None):
        event["detail"]["startedBy"] = started_by  # type: ignore[index]
        assert messages.task_changed(event) is None


def ended(stop_code: str | None = "SpotInterruption", **container: object) -> dict[str, Any]:
    """The event of a task whose network interface is being taken down."""
    detail = {
        "startedBy": "s" + "a" * 20 + "-1",
        "taskArn": "t",
        "clusterArn": "c",
        "lastStatus": "DEPROVISIONING",
        "desiredStatus": "STOPPED",
        "stopCode": stop_code,
        "containers": [{"lastStatus": "STOPPED", **container}],
    }
    return {"source": "aws.ecs", "detail": detail}


@pytest.mark.parametrize(
    "event",
    [
        ended(exitCode=143),
        ended(),
        ended("TaskFailedToStart"),
        ended("EssentialContainerExited", exitCode=0),
    ],
)
def test_a_task_has_ended_when_its_containers_have_and_it_is_told_why(event: dict[str, Any]) -> None:
    assert messages.task_changed(event).status == "DEPROVISIONING"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "event",
    [
        pytest.param(ended(lastStatus="RUNNING"), id="a container may still run"),
        pytest.param(ended(None), id="no word of the reason yet"),
        pytest.param(ended("EssentialContainerExited"), id="ended by itself, well or not is not told yet"),
    ],
)
def test_a_task_whose_end_is_not_all_told_is_waited_for(event: dict[str, Any]) -> None:
    assert messages.task_changed(event).status == "STOPPING"  # type: ignore[union-attr]


def test_spots_warning_is_not_taken_for_a_server_that_runs() -> None:
    detail = {"startedBy": "s" + "a" * 20 + "-1", "taskArn": "t", "clusterArn": "c", "lastStatus": "RUNNING"}
    event = {"source": "aws.ecs", "detail": detail}
    assert messages.task_changed(event).status == "RUNNING"  # type: ignore[union-attr]
    detail["desiredStatus"] = "STOPPED"
    assert messages.task_changed(event).status == "STOPPING"  # type: ignore[union-attr]
