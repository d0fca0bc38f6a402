import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids, messages
from hippodrome.control.model.messages import StartServer, StopServer, StopUser, to_message
from hippodrome.protocol.keys import NAME

texts = st.text(st.characters())  # with halves of surrogate pairs
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
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
    for parse in (
        messages.parse_start_server,
        messages.parse_stop_server,
        messages.parse_task_changed,
        messages.parse_dns_changed,
    ):
        parse(body)


@given(texts | json_values.map(json.dumps))
def test_no_record_makes_the_envelope_fail(body: str) -> None:
    messages.body_of({"body": body})
    messages.body_of({"body": json.dumps({"Type": "Notification", "Message": body})})
    messages.body_of(body)


@pytest.mark.parametrize("body", ['"\\ud800"', '"\ud800"', '{"\\udc00": 1}', "NaN", "[" * 100_000, "1" * 5000])
def test_a_body_that_is_not_json_in_utf_8_is_no_message(body: str) -> None:
    assert messages.body_of({"body": body}) is None
    assert messages.body_of({"body": json.dumps({"Type": "Notification", "Message": body})}) is None
    assert messages.body_of({"Sns": {"Message": body}}) is None


def test_hippos_messages_without_an_attempt_are_understood() -> None:
    body = {"projectId": "maze", "userId": "alice"}
    assert messages.parse_start_server(body) == StartServer("maze", "alice", 1)
    assert messages.parse_stop_server(body) == StopServer("maze", "alice", None)


def test_a_stop_without_a_project_stops_the_participants_servers_of_all_projects() -> None:
    assert messages.parse_stop_server({"userId": "alice"}) == StopUser("alice")
    assert messages.parse_stop_server({"projectId": None, "userId": "alice"}) == StopUser("alice")
    assert messages.parse_stop_server({"userId": "../x"}) is None


@pytest.mark.parametrize("user", ["../x", "", "a\0", 7, None])
def test_messages_with_malformed_ids_are_not_parsed(user: object) -> None:
    assert messages.parse_start_server({"projectId": "maze", "userId": user}) is None
    assert messages.parse_stop_server({"projectId": "maze", "userId": user}) is None


@given(st.from_regex(ids.PROJECT_ID, fullmatch=True), st.from_regex(NAME, fullmatch=True), st.integers(1, 9))
def test_messages_are_parsed_with_and_without_the_envelope_of_sns(project: str, user: str, attempt: int) -> None:
    sent = StartServer(project, user, attempt)
    raw = json.dumps(to_message(sent))
    wrapped = json.dumps({"Type": "Notification", "Message": raw})
    assert messages.parse_start_server(messages.body_of({"body": raw})) == sent
    assert messages.parse_start_server(messages.body_of({"body": wrapped})) == sent
    assert messages.parse_start_server(messages.body_of({"Sns": {"Message": raw}})) == sent


def test_events_of_other_tasks_are_not_parsed() -> None:
    event = {"source": "aws.ecs", "detail": {"taskArn": "t", "clusterArn": "c", "lastStatus": "RUNNING"}}
    for started_by in ("ecs-svc/1", "", None):
        event["detail"]["startedBy"] = started_by  # type: ignore[index]
        assert messages.parse_task_changed(event) is None


def ended(stop_code: str | None = "SpotInterruption", **container: object) -> dict[str, Any]:
    """Return the event of a task whose network interface is being taken down."""
    detail = {
        "startedBy": "s" + "a" * 20 + "-1",
        "taskArn": "t",
        "clusterArn": "c",
        "lastStatus": "DEPROVISIONING",
        "desiredStatus": "STOPPED",
        "stopCode": stop_code,
        "containers": [{"name": "trial", "lastStatus": "STOPPED", **container}],
    }
    return {"source": "aws.ecs", "detail": detail}


@pytest.mark.parametrize(
    "event",
    [ended(exitCode=143), ended(), ended("TaskFailedToStart"), ended("EssentialContainerExited", exitCode=0)],
)
def test_a_task_has_ended_when_its_containers_have_and_the_event_says_why(event: dict[str, Any]) -> None:
    assert messages.parse_task_changed(event).status == "DEPROVISIONING"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "event",
    [
        pytest.param(ended(lastStatus="RUNNING"), id="a container may still run"),
        pytest.param(ended(None), id="no word of the reason yet"),
        pytest.param(ended("EssentialContainerExited"), id="ended by itself, well or not is not told yet"),
    ],
)
def test_a_task_whose_event_does_not_tell_its_whole_end_counts_as_stopping(event: dict[str, Any]) -> None:
    assert messages.parse_task_changed(event).status == "STOPPING"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("code", "words", "read"),
    [
        (None, "Your Spot Task was interrupted.", "SpotInterruption"),
        ("EssentialContainerExited", "Your Spot Task was interrupted.", "SpotInterruption"),
        ("TerminationNotice", "Your Spot Task was interrupted.", "TerminationNotice"),
        ("SpotInterruption", "Your Spot Task was interrupted.", "SpotInterruption"),
        (
            "ServiceSchedulerInitiated",
            "ECS is performing maintenance on the underlying infrastructure hosting the task",
            "InfrastructureHealth",
        ),
        (
            "UserInitiated",
            "ECS is performing maintenance on the underlying infrastructure hosting the task.",
            "InfrastructureHealth",
        ),
        (None, "Essential container in task exited", "EssentialContainerExited"),
        (None, "Task stopped by user", "UserInitiated"),
        (None, "Task failed to start", "TaskFailedToStart"),
        (None, "Timeout waiting for network interface provisioning to complete.", "TaskFailedToStart"),
        (None, "CannotPullContainerError: pull image manifest has been retried", "TaskFailedToStart"),
        (None, "ResourceInitializationError: unable to pull secrets", "TaskFailedToStart"),
        (None, "hippodrome: the stop step", "UserInitiated"),
        ("UserInitiated", "hippodrome: a Spot task that was interrupted", "UserInitiated"),
        (None, "words of next year", None),
        (None, "", None),
        ("", "", None),
        ("TaskFailedToStart", "", "TaskFailedToStart"),
    ],
)
def test_a_missing_stop_code_is_read_from_the_stopped_reason(code: str | None, words: str, read: str | None) -> None:
    said = task(lastStatus="STOPPED", stopCode=code, stoppedReason=words)
    assert messages.parse_task_changed(said).stop_code == read  # type: ignore[union-attr]
    if code is None:
        del said["detail"]["stopCode"]
        assert messages.parse_task_changed(said).stop_code == read  # type: ignore[union-attr]


def test_an_interruption_of_spot_without_a_stop_code_is_read_from_its_first_event() -> None:
    event = ended(None, exitCode=137)
    event["detail"]["stoppedReason"] = "Your Spot Task was interrupted."
    assert messages.parse_task_changed(event).status == "DEPROVISIONING"  # type: ignore[union-attr]


def test_a_task_that_is_listed_as_running_gives_the_message_of_an_event() -> None:
    sent = messages.TaskSeen("arn:task", "own", NAME, "eni-1", 2)
    assert messages.parse_task_changed(json.loads(json.dumps(to_message(sent)))) == messages.TaskChanged(
        "arn:task", "own", NAME, "RUNNING", "eni-1", None, "", None, "", 2
    )
    strange = messages.TaskSeen("arn:task", "own", "somebody-elses", "eni-1")
    assert messages.parse_task_changed(to_message(strange)) is None


def test_spots_warning_is_not_taken_for_a_server_that_runs() -> None:
    detail = {"startedBy": "s" + "a" * 20 + "-1", "taskArn": "t", "clusterArn": "c", "lastStatus": "RUNNING"}
    event = {"source": "aws.ecs", "detail": detail}
    assert messages.parse_task_changed(event).status == "RUNNING"  # type: ignore[union-attr]
    detail["desiredStatus"] = "STOPPED"
    assert messages.parse_task_changed(event).status == "STOPPING"  # type: ignore[union-attr]


NAME = "s" + "a" * 20 + "-1"


def task(**detail: object) -> dict[str, Any]:
    usual = {"startedBy": NAME, "taskArn": "arn:task", "clusterArn": "arn:x/y/own", "lastStatus": "RUNNING"}
    return {"source": "aws.ecs", "detail": {**usual, **detail}}


def test_all_fields_of_a_tasks_event_are_read() -> None:
    details = [{"name": "subnetId", "value": "subnet-1"}, {"name": "networkInterfaceId", "value": "eni-1"}]
    event = task(
        lastStatus="STOPPED",
        attachments=[
            {"type": "elb", "details": [{"name": "networkInterfaceId", "value": "eni-9"}]},
            {"type": "eni", "details": details},
        ],
        stopCode="EssentialContainerExited",
        stoppedReason="Essential container in task exited",
        containers=[{"name": "trial", "reason": "OutOfMemoryError", "exitCode": 137}],
    )
    assert messages.parse_task_changed(event) == messages.TaskChanged(
        task="arn:task",
        cluster="own",
        name=NAME,
        status="STOPPED",
        interface="eni-1",
        stop_code="EssentialContainerExited",
        stopped_reason="Essential container in task exited",
        exit_code=137,
        container_reason="OutOfMemoryError",
    )
    other = [{"type": "ElasticNetworkInterface", "details": details}]
    assert messages.parse_task_changed(task(attachments=other)).interface == "eni-1"  # type: ignore[union-attr]


def test_an_event_with_only_the_necessary_fields_is_read() -> None:
    assert messages.parse_task_changed(task()) == messages.TaskChanged(
        "arn:task", "own", NAME, "RUNNING", None, None, "", None
    )
    zero = task(containers=[{"name": "trial", "exitCode": 0}])
    assert messages.parse_task_changed(zero).exit_code == 0  # type: ignore[union-attr]


@pytest.mark.parametrize("without", ["startedBy", "taskArn", "clusterArn", "lastStatus"])
def test_an_event_without_a_necessary_field_is_not_parsed(without: str) -> None:
    event = task()
    del event["detail"][without]
    assert messages.parse_task_changed(event) is None
    assert messages.parse_task_changed({**task(), "source": "aws.ec2"}) is None


SIDECAR = {"name": "aws-guardduty-agent-1a2b", "lastStatus": "STOPPED"}


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(("sidecar", "trial"), [(137, 0), (0, 1), (0, 3)])
def test_a_sidecars_exit_code_and_reason_are_not_the_trials(place: int, sidecar: int, trial: int) -> None:
    event = ended("EssentialContainerExited", exitCode=trial)
    event["detail"]["containers"].insert(place, {**SIDECAR, "exitCode": sidecar, "reason": "OutOfMemoryError"})
    changed = messages.parse_task_changed(event)
    assert changed
    assert (changed.exit_code, changed.container_reason) == (trial, "")
    assert changed.status == "DEPROVISIONING"


@pytest.mark.parametrize(("trial", "status"), [("RUNNING", "STOPPING"), ("STOPPED", "DEPROVISIONING")])
def test_a_task_has_ended_when_the_trial_has(trial: str, status: str) -> None:
    event = ended(lastStatus=trial, exitCode=0)
    event["detail"]["containers"].insert(0, SIDECAR)
    assert messages.parse_task_changed(event).status == status  # type: ignore[union-attr]


def test_a_sidecars_exit_code_does_not_tell_how_the_trial_ended() -> None:
    event = ended("EssentialContainerExited")
    event["detail"]["containers"].insert(0, {**SIDECAR, "exitCode": 0})
    assert messages.parse_task_changed(event).status == "STOPPING"  # type: ignore[union-attr]


def test_only_envelopes_of_sns_are_opened() -> None:
    inner = json.dumps({"a": 1})
    assert messages.body_of({"body": json.dumps({"Type": "Notification", "Message": inner})}) == {"a": 1}
    assert messages.body_of({"body": json.dumps({"Type": "Other", "Message": inner})}) == {
        "Type": "Other",
        "Message": inner,
    }
    assert messages.body_of({"body": "[1]"}) == [1]
    for record in ({}, {"body": "{"}, {"body": json.dumps({"Type": "Notification"})}, None):
        assert messages.body_of(record) is None


def test_messages_of_the_control_plane_are_read_with_their_limits() -> None:
    warm_server = "~" + "0" * 20
    assert messages.parse_start_server({"projectId": "maze", "userId": warm_server, "attempt": 1}) == StartServer(
        "maze", warm_server, 1
    )
    assert messages.parse_start_server({"projectId": "maze", "userId": "alice", "attempt": 0}) is None
    assert messages.parse_start_server({"projectId": "a b", "userId": "alice"}) is None
    assert messages.parse_stop_server({"projectId": "a b", "userId": "alice"}) is None
    assert messages.parse_start_server({"keepWarm": "maze"}) == messages.KeepWarm("maze")
    assert messages.parse_start_server({"keepWarm": "a b"}) is None
    assert messages.parse_stop_server(
        {"projectId": "maze", "userId": warm_server, "attempt": 2, "reason": "lost"}
    ) == StopServer("maze", warm_server, 2, "lost")
    assert messages.parse_stop_server({"projectId": "maze", "userId": "a"}).reason == "stopped"  # type: ignore[union-attr]
    follow = {"change": "C1", "servers": [{"label": "s", "attempt": 2}], "looked": 3}
    assert messages.parse_dns_changed(follow) == messages.DnsChanged("C1", [messages.ServerAttempt("s", 2)], 3)
    assert messages.parse_dns_changed({"change": "C1", "servers": []}).looked == 0  # type: ignore[union-attr]
    assert messages.STOP_REASON_PREFIX == "hippodrome:"
