"""Every function's handler, with AWS's payloads in `tests/events` and with malformed events."""

from __future__ import annotations

import base64
import gzip
import io
import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.project import Events
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import DnsRecord, RetryLater, Topic
from hippodrome.control.servers.causes import Cause
from hippodrome.control.storage.secret import KEY
from hippodrome.functions import (
    installed,
    next_step,
    send_start_server_message,
    send_stop_server_message,
    start_server,
    stop_server,
    sweep,
    task_changed,
    update_project_master_list,
)
from testing import aws_events, studies
from testing.exploration import examples
from testing.fake_platform import FakePlatform

PROJECT = "ms-pacman"
SECRET = "xyzzy-do-not-log"
QUEUES = {"start": start_server.handler, "stop": stop_server.handler, "task": task_changed.handler}
WEB = {
    "next": next_step.handler,
    "start": send_start_server_message.handler,
    "stop": send_stop_server_message.handler,
}
NOTHING_FAILED: dict[str, Any] = {"batchItemFailures": []}


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    yield new_platform()
    installed.use(None)


def new_platform() -> FakePlatform:
    """Return a platform in memory with the study that the payloads name."""
    made = studies.installed(studies.study(id=PROJECT, events=Events("2", "4")))
    installed.use(made)
    return made


def users(event: dict[str, Any]) -> list[str]:
    """Return the participants of the ECS events of a batch, in order."""
    found = []
    for record in event["Records"]:
        overrides = json.loads(record["body"])["detail"]["overrides"]["containerOverrides"]
        found += [e["value"] for o in overrides for e in o["environment"] if e["name"] == "USER_ID"]
    return found


def attempt_of(record: dict[str, Any]) -> tuple[str, int]:
    named = ids.parse_server_name(json.loads(record["body"])["detail"]["startedBy"])
    assert named
    return named


def claimed(platform: FakePlatform, event: dict[str, Any], **changes: Any) -> None:
    """The records of the servers that a batch of ECS events is about, as `start_server` leaves them."""
    for record, user in zip(event["Records"], users(event), strict=True):
        label, attempt = attempt_of(record)
        task = json.loads(record["body"])["detail"]["taskArn"]
        found = Server(
            project_id=PROJECT,
            user_id=user,
            attempt=attempt,
            state=ServerState.STARTING,
            requested=platform.now(),
            deadline=platform.now(),
            cluster="hippodrome",
            task=task,
            dns=f"{ids.server_name(label, attempt)}.example.org",
        )
        found = msgspec.structs.replace(found, **changes)
        platform.documents.put(server.key(label), msgspec.json.encode(found))
        platform.timers.set(found.name, platform.now(), {})
        if found.dns_record:
            platform.dns.records[found.dns_record.name] = found.dns_record.host


def records(platform: FakePlatform, event: dict[str, Any]) -> list[Server]:
    kept = [platform.documents.kept[server.key(attempt_of(record)[0])][0] for record in event["Records"]]
    return [msgspec.json.decode(stored, type=Server) for stored in kept]


def states(platform: FakePlatform, event: dict[str, Any]) -> list[tuple[ServerState, Reason | None]]:
    return [(record.state, record.reason) for record in records(platform, event)]


# The payloads of AWS


def test_every_payload_has_a_test() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    missing = [file.stem for file in aws_events.EVENTS.glob("*.json") if f'"{file.stem}"' not in here]
    assert missing == []


def test_a_get_shows_the_first_page_and_stores_the_participant(platform: FakePlatform) -> None:
    answer = next_step.handler(aws_events.load("http_get"), None)
    assert answer["statusCode"] == 200
    assert answer["headers"]["Content-Type"] == "text/html; charset=utf-8"
    assert f"{PROJECT}/users/R_3fGxW2vPqT9aBcD/participant.json" in platform.documents.kept


def test_a_posted_form_is_stored_and_redirects(platform: FakePlatform) -> None:
    """A form in base64, as API Gateway delivers it. Its ticket is invalid, so the participant's present step is answered."""
    user = "R_3fGxW2vPqT9aBcD"
    next_step.handler(aws_events.load("http_get"), None)
    platform.documents.put(f"{PROJECT}/users/{user}/answers/1.json", b"{}")
    answer = next_step.handler(aws_events.load("http_post_form"), None)
    assert (answer["statusCode"], answer["headers"]["Location"]) == (303, f"/next?projectId={PROJECT}&userId={user}")
    stored = json.loads(platform.documents.kept[f"{PROJECT}/users/{user}/answers/2.json"][0])
    assert stored["answers"] == {
        "age": "34",
        "played": ["arcade", "phone"],
        "comment": "Très bien \u2013 10 % plus vite ✓",
    }


def test_a_posted_json_form_is_answered_with_json(platform: FakePlatform) -> None:
    """HIPPO's front end: JSON in, JSON out."""
    event = aws_events.load("http_post_json")
    next_step.handler({**event, "requestContext": {"http": {"method": "GET"}}}, None)
    answer = next_step.handler(event, None)
    assert answer["statusCode"] == 200
    assert answer["headers"]["Content-Type"] == "application/json"
    assert answer["headers"]["Content-Encoding"] == "gzip"
    assert set(json.loads(gzip.decompress(base64.b64decode(answer["body"])))) >= {"page", "css"}


def test_a_start_message_directly_from_the_topic_starts_one_server(platform: FakePlatform) -> None:
    for _ in range(2):
        assert start_server.handler(aws_events.load("sns_start"), None) == NOTHING_FAILED
    assert len(platform.tasks.running) == 1


def test_a_stop_message_without_a_project_directly_from_the_topic_stops_the_server(platform: FakePlatform) -> None:
    start_server.handler(aws_events.load("sns_start"), None)
    for _ in range(2):
        assert stop_server.handler(aws_events.load("sns_stop_user"), None) == NOTHING_FAILED
    assert not platform.tasks.running
    assert not platform.timers.due


def test_a_failed_event_of_the_topic_raises_so_that_lambda_repeats_it(platform: FakePlatform) -> None:
    """Lambda does not look at what the function returns, so the function raises."""
    platform.tasks.fail = [ConnectionError()]
    with pytest.raises(RetryLater):
        start_server.handler(aws_events.load("sns_start"), None)
    assert start_server.handler(aws_events.load("sns_start"), None) == NOTHING_FAILED
    assert len(platform.tasks.running) == 1


def test_start_messages_of_the_queue_start_one_server(platform: FakePlatform) -> None:
    """The second participant never had a first server, so their second attempt is not started."""
    event = aws_events.load("sqs_start_raw")
    for _ in range(2):
        assert start_server.handler(deepcopy(event), None) == NOTHING_FAILED
    (request,) = platform.tasks.running.values()
    assert request.name == ids.server_name(ids.server_label(PROJECT, "R_3fGxW2vPqT9aBcD"), 1)


def test_stop_messages_in_the_envelope_of_sns_stop_the_server(platform: FakePlatform) -> None:
    start_server.handler(aws_events.load("sqs_start_raw"), None)
    event = aws_events.load("sqs_stop_wrapped")
    for _ in range(2):
        assert stop_server.handler(deepcopy(event), None) == NOTHING_FAILED
    assert not platform.tasks.running
    assert not platform.timers.due


def test_a_running_task_is_named_and_ready_with_one_event(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_task_running")
    claimed(platform, event)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.READY, None)]
    assert list(platform.dns.records) == [f"{ids.server_name(*attempt_of(event['Records'][0]))}.example.org"]


def test_a_task_that_is_only_being_provided_changes_nothing(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_task_provisioning")
    claimed(platform, event)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.STARTING, None)]


@pytest.mark.parametrize("payload", ["sqs_task_spot_warning", "sqs_task_spot_warning_no_code"])
def test_a_warning_of_spot_does_not_close_a_ready_server(platform: FakePlatform, payload: str) -> None:
    event = aws_events.load(payload)
    claimed(platform, event, state=ServerState.READY, dns="a.example.org", host="203.0.113.9", port=5000)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.READY, None)]
    assert platform.dns.records == {"a.example.org": "203.0.113.9"}


@pytest.mark.parametrize(
    ("payload", "reason", "again"),
    [
        ("sqs_task_stopped_spot", Reason.LOST, True),
        ("sqs_task_stopped_start_failed", Reason.LOST, True),
        ("sqs_task_stopped_exit", Reason.ENDED, False),
        ("sqs_task_stopped_crash", Reason.LOST, True),
        ("sqs_task_stopped_memory", Reason.LOST, True),
        ("sqs_task_stopped_initialisation", Reason.LOST, True),
        ("sqs_task_deprovisioning_spot", Reason.LOST, True),
        ("sqs_task_stopped_spot_no_code", Reason.LOST, True),
        ("sqs_task_deprovisioning_spot_no_code", Reason.LOST, True),
        ("sqs_task_stopped_maintenance", Reason.LOST, True),
        ("sqs_task_stopped_exit_no_code", Reason.ENDED, False),
    ],
)
def test_a_task_that_stopped_is_cleaned_up(platform: FakePlatform, payload: str, reason: Reason, again: bool) -> None:
    event = aws_events.load(payload)
    claimed(platform, event, state=ServerState.READY, dns="a.example.org", host="203.0.113.9", port=5000)
    _, attempt = attempt_of(event["Records"][0])
    for _ in range(2):
        assert task_changed.handler(deepcopy(event), None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.CLOSED, reason)]
    assert platform.dns.records == {}
    assert platform.timers.due == {}
    (user,) = users(event)
    following = {"projectId": PROJECT, "userId": user, "attempt": attempt + 1}
    assert {json.dumps(m, sort_keys=True) for _, m in platform.bus.sent} == (
        {json.dumps(following, sort_keys=True)} if again else set()
    )
    assert {topic for topic, _ in platform.bus.sent} <= {Topic.START}


@pytest.mark.parametrize(
    ("payload", "cause"),
    [
        ("sqs_task_stopped_start_failed", Cause.IMAGE),
        ("sqs_task_stopped_initialisation", Cause.INITIALISATION),
        ("sqs_task_stopped_crash", Cause.ENDED_AT_ONCE),
        ("sqs_task_stopped_memory", Cause.OUT_OF_MEMORY),
        ("sqs_task_stopped_spot", Cause.SPOT),
        ("sqs_task_deprovisioning_spot", Cause.SPOT),
        ("sqs_task_stopped_exit", ""),
        ("sqs_task_stopped_spot_no_code", Cause.SPOT),
        ("sqs_task_deprovisioning_spot_no_code", Cause.SPOT),
        ("sqs_task_stopped_maintenance", Cause.MACHINE),
        ("sqs_task_stopped_exit_no_code", ""),
    ],
)
def test_the_record_of_a_failed_server_holds_the_cause(platform: FakePlatform, payload: str, cause: str) -> None:
    event = aws_events.load(payload)
    claimed(platform, event)
    task_changed.handler(event, None)
    (record,) = records(platform, event)
    assert record.cause == cause


@pytest.mark.parametrize(
    ("payload", "sidecar", "reason"),
    [("sqs_task_stopped_exit", 137, Reason.ENDED), ("sqs_task_stopped_crash", 0, Reason.LOST)],
)
def test_the_exit_code_of_a_sidecar_does_not_decide(
    platform: FakePlatform, payload: str, sidecar: int, reason: Reason
) -> None:
    """GuardDuty puts a container of its own into tasks on Fargate, and may stop it after the trial's."""
    event = aws_events.load(payload)
    (record,) = event["Records"]
    body = json.loads(record["body"])
    agent = {"name": "aws-guardduty-agent-1a2b", "lastStatus": "STOPPED", "exitCode": sidecar}
    body["detail"]["containers"].insert(0, agent)
    record["body"] = json.dumps(body)
    claimed(platform, event, state=ServerState.READY, dns="a.example.org", host="203.0.113.9", port=5000)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.CLOSED, reason)]


def test_the_second_event_of_a_servers_end_changes_nothing(platform: FakePlatform) -> None:
    ended, gone = aws_events.load("sqs_task_deprovisioning_spot"), aws_events.load("sqs_task_stopped_spot")
    claimed(platform, ended, state=ServerState.READY, dns="a.example.org", host="203.0.113.9", port=5000)
    task_changed.handler(ended, None)
    (user,) = users(ended)
    _, attempt = attempt_of(ended["Records"][0])
    start = {"projectId": PROJECT, "userId": user, "attempt": attempt + 1}
    start_server.handler({"Records": [{"messageId": "1", "body": json.dumps(start)}]}, None)
    before = dict(platform.documents.kept)
    task_changed.handler(gone, None)
    assert platform.documents.kept == before
    assert [m["attempt"] for _, m in platform.bus.sent] == [attempt + 1]


def test_the_event_of_a_task_that_hippodrome_stopped_changes_nothing(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_task_stopped_user")
    claimed(platform, event)
    assert json.loads(event["Records"][0]["body"])["detail"]["stoppedReason"].startswith("hippodrome:")
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.STARTING, None)]


def test_each_event_of_a_batch_is_handled(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_tasks")
    claimed(platform, event)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    by_status: dict[str, list[tuple[ServerState, Reason | None]]] = {}
    for record, state in zip(event["Records"], states(platform, event), strict=True):
        detail = json.loads(record["body"])["detail"]
        by_status.setdefault(detail.get("stopCode", detail["lastStatus"]), []).append(state)
    assert by_status["PROVISIONING"] == [(ServerState.STARTING, None)]
    assert by_status["RUNNING"] == [(ServerState.READY, None)]
    assert by_status["EssentialContainerExited"] == [(ServerState.CLOSED, Reason.ENDED)]
    assert by_status["TaskFailedToStart"] == [(ServerState.CLOSED, Reason.LOST)]
    assert (ServerState.CLOSED, Reason.LOST) in by_status["SpotInterruption"]


def test_the_timers_event_runs_the_sweep(platform: FakePlatform) -> None:
    platform.dns.records["www.example.org"] = "198.51.100.1"
    assert not any(sweep.handler(aws_events.load("schedule_sweep"), None).values())
    assert platform.dns.records == {"www.example.org": "198.51.100.1"}


# Partial failures


def test_only_the_start_that_failed_comes_again(platform: FakePlatform) -> None:
    bodies = [{"projectId": PROJECT, "userId": user} for user in ("a", "b", "c")]
    event = batch(*bodies)
    platform.tasks.fail = [ConnectionError()]
    failed = start_server.handler(event, None)
    assert failed == {"batchItemFailures": [{"itemIdentifier": event["Records"][0]["messageId"]}]}
    assert len(platform.tasks.running) == 2


def test_only_the_stop_that_failed_comes_again(platform: FakePlatform) -> None:
    bodies = [{"projectId": PROJECT, "userId": user} for user in ("a", "b", "c")]
    start_server.handler(batch(*bodies), None)
    platform.tasks.fail_stops = [ConnectionError()]
    event = batch(*bodies)
    failed = stop_server.handler(event, None)
    assert failed == {"batchItemFailures": [{"itemIdentifier": event["Records"][0]["messageId"]}]}
    assert len(platform.tasks.running) == 1
    assert stop_server.handler(event, None) == NOTHING_FAILED
    assert not platform.tasks.running


def test_only_the_task_without_an_address_is_checked_again(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_task_running")
    other = deepcopy(event["Records"][0])
    body = json.loads(other["body"])
    user = "R_other"
    body["detail"]["startedBy"] = ids.server_name(ids.server_label(PROJECT, user), 1)
    body["detail"]["taskArn"] += "0"
    for item in body["detail"]["attachments"][0]["details"]:
        if item["name"] == "networkInterfaceId":
            item["value"] = "eni-bare"  # this interface has no address in the fake
    for item in body["detail"]["overrides"]["containerOverrides"][0]["environment"]:
        if item["name"] == "USER_ID":
            item["value"] = user
    other |= {"body": json.dumps(body), "messageId": "the-one-without"}
    event["Records"].append(other)
    claimed(platform, event)
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert [state for state, _ in states(platform, event)] == [ServerState.READY, ServerState.STARTING]
    ((_, message),) = platform.bus.delayed
    again = messages.parse_task_changed(dict(message))
    assert again
    assert (again.interface, again.status) == ("eni-bare", "RUNNING")


def test_when_the_names_cannot_be_changed_every_event_of_the_batch_comes_again(platform: FakePlatform) -> None:
    event = aws_events.load("sqs_task_running")
    claimed(platform, event)
    change = platform.dns.change
    platform.dns.change = None  # type: ignore[assignment,method-assign]
    assert len(task_changed.handler(event, None)["batchItemFailures"]) == 1
    platform.dns.change = change  # type: ignore[method-assign]
    assert task_changed.handler(event, None) == NOTHING_FAILED
    assert states(platform, event) == [(ServerState.READY, None)]


# Messages of others, and private content


def batch(*bodies: Any) -> dict[str, Any]:
    return aws_events.sqs_event(bodies, "arn:aws:sqs:us-east-1:123456789012:hippodrome-start", "us-east-1")


HALF_A_CHARACTER = [
    '{"projectId":"p","userId":"u","attempt":"\\ud800"}',
    '{"projectId":"p","userId":"\\ud800"}',
    '{"keepWarm":"\\udc00"}',
    '{"change":"\\ud800","servers":[]}',
    '{"userId":"u","\\ud800":1}',
    '"\ud800"',
]
NOT_OURS = [
    SECRET,
    "",
    "{",
    "null",
    json.dumps([SECRET]),
    json.dumps({"projectId": SECRET}),
    json.dumps({"projectId": f"../{SECRET}", "userId": "x"}),
    json.dumps({"projectId": PROJECT, "userId": f"{SECRET}/.."}),
    json.dumps({"projectId": PROJECT, "userId": SECRET, "attempt": "one"}),
    json.dumps({"Type": "Notification", "Message": SECRET}),
    json.dumps({"Type": "Notification"}),
    json.dumps({"source": "aws.ecs", "detail": {"startedBy": f"ecs-svc/{SECRET}"}}),
    json.dumps({"source": "aws.ecs", "detail": SECRET}),
    "[" * 100_000,
    '{"a":' * 50_000,
    *HALF_A_CHARACTER,
]


@pytest.mark.parametrize("queue", QUEUES)
def test_messages_of_others_are_dropped_and_their_content_is_not_logged(
    platform: FakePlatform, log: io.StringIO, queue: str
) -> None:
    event = batch(*NOT_OURS)
    before = dict(platform.documents.kept)
    assert QUEUES[queue](event, None) == NOTHING_FAILED
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    dropped = [line["messageId"] for line in lines if line["level"] == "WARNING"]
    assert dropped == [record["messageId"] for record in event["Records"]]
    assert SECRET not in log.getvalue()
    assert platform.documents.kept == before
    assert not platform.tasks.running
    assert not platform.bus.sent


def test_valid_messages_of_a_batch_are_handled_beside_others(platform: FakePlatform) -> None:
    ours = {"projectId": PROJECT, "userId": "alice"}
    assert start_server.handler(batch(SECRET, ours, {"userId": 1}), None) == NOTHING_FAILED
    assert len(platform.tasks.running) == 1


def test_answers_ids_and_tokens_are_never_logged(platform: FakePlatform, log: io.StringIO) -> None:
    """A whole journey with a failure of every function; all private values contain a mark."""
    user = f"{SECRET}-user"
    get = {**aws_events.load("http_get"), "rawQueryString": f"projectId={PROJECT}&userId={user}&note={SECRET}"}
    post = {**aws_events.load("http_post_form"), "rawQueryString": get["rawQueryString"], "isBase64Encoded": False}
    next_step.handler(get, None)
    for key in "12":
        next_step.handler({**post, "body": f"hippodrome-step={key}&words={SECRET}"}, None)
    message = {"projectId": PROJECT, "userId": user}
    platform.tasks.fail = [ConnectionError(SECRET)]
    start_server.handler(batch(message), None)
    start_server.handler(batch(message), None)
    secret = msgspec.json.decode(platform.documents.kept[KEY][0])["secret"]
    token = next(iter(platform.tasks.running.values())).environment["TOKEN"]
    change = platform.dns.change

    def fails(*args: Any, **kwargs: Any) -> str:
        raise ValueError(SECRET) from KeyError(SECRET)

    (task,) = platform.tasks.running
    running = json.loads(aws_events.load("sqs_task_running")["Records"][0]["body"])
    running["detail"] |= {"taskArn": task, "startedBy": platform.tasks.running[task].name}
    platform.dns.change = fails  # type: ignore[method-assign]
    assert task_changed.handler(batch(running), None)["batchItemFailures"]
    platform.dns.change = change  # type: ignore[method-assign]
    task_changed.handler(batch(running), None)
    platform.documents.before_write = [fails]
    assert next_step.handler({**post, "body": f"words={SECRET}"}, None)["statusCode"] in (303, 500)
    platform.documents.before_write = [fails]
    stop_server.handler(batch(message), None)
    stop_server.handler(batch(message), None)
    for relay in (send_start_server_message, send_stop_server_message):
        relay.handler({**post, "body": f"token={SECRET}"}, None)
    sweep.handler({}, None)
    update_project_master_list.handler({"project": {"id": PROJECT, "researcher": SECRET, "steps": SECRET}}, None)
    text = log.getvalue()
    assert "server closed" in text
    assert "failed" in text
    assert SECRET not in text
    assert token not in text
    assert secret not in text


# Arbitrary input

ANY_TEXT = st.text(st.characters(), max_size=12)  # with halves of surrogate pairs
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | ANY_TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(ANY_TEXT, inner, max_size=4),
    max_leaves=12,
)
DEEP = st.sampled_from(["[", '{"projectId":', '{"servers":[', '{"detail":{"containers":['])
KEYS = [
    "projectId", "userId", "attempt", "reason", "change", "servers", "label", "looked", "source", "detail", "startedBy",
    "attachments", "containers", "details", "lastStatus", "taskArn", "clusterArn", "stopCode", "stoppedReason", "type",
    "name", "value", "exitCode", "Type", "Message",
]  # fmt: skip
VALUES = st.sampled_from([
    PROJECT, "maze", "alice", "R_3fGxW2vPqT9aBcD", "aws.ecs", "RUNNING", "STOPPED", "deadline", "stopped", "Notification",
    "eni", "networkInterfaceId", "eni-1", "eni-bare", "SpotInterruption", "arn:aws:ecs:us-east-1:1:task/c/1",
    ids.server_name(ids.server_label(PROJECT, "alice"), 1), ids.server_label(PROJECT, "alice"), 0, 1, 2, -1, 2**70,
])  # fmt: skip
NEARLY = st.recursive(
    VALUES | JSON,
    lambda inner: st.dictionaries(st.sampled_from(KEYS), inner, max_size=8) | st.lists(inner, max_size=3),
    max_leaves=25,
)
BODIES = (
    st.text(st.characters(), max_size=60)
    | JSON.map(json.dumps)
    | NEARLY.map(json.dumps)
    | DEEP.map(lambda begin: begin * 20_000)
)
MESSAGES = st.fixed_dictionaries({"messageId": st.uuids().map(str), "body": BODIES})


@pytest.fixture
def _put_back() -> Iterator[None]:
    yield
    installed.use(None)


def mostly(number: int) -> Any:
    return settings(max_examples=examples(number))


@pytest.mark.usefixtures("_put_back")
@mostly(150)
@given(records=st.lists(MESSAGES, max_size=4), queue=st.sampled_from(sorted(QUEUES)))
def test_no_batch_raises_and_only_its_own_messages_come_again(records: list[dict[str, Any]], queue: str) -> None:
    platform = new_platform()
    start_server.handler(batch({"projectId": PROJECT, "userId": "alice"}), None)
    failed = QUEUES[queue]({"Records": records}, None)["batchItemFailures"]
    assert {failure["itemIdentifier"] for failure in failed} <= {record["messageId"] for record in records}
    for key in platform.documents.kept:
        assert ".." not in key


@pytest.mark.usefixtures("_put_back")
@mostly(100)
@given(bodies=st.lists(BODIES, min_size=1, max_size=3))
def test_no_message_of_others_affects_ours(bodies: list[str]) -> None:
    platform = new_platform()
    ours = json.dumps({"projectId": PROJECT, "userId": "bob"})
    name = ids.server_name(ids.server_label(PROJECT, "bob"), 1)
    records = [{"messageId": str(n), "body": body} for n, body in enumerate([*bodies, ours])]
    failed = start_server.handler({"Records": records}, None)["batchItemFailures"]
    assert name in {task.name for task in platform.tasks.running.values()}
    failed += stop_server.handler({"Records": records}, None)["batchItemFailures"]
    assert name not in {task.name for task in platform.tasks.running.values()}
    assert {"itemIdentifier": str(len(bodies))} not in failed


ODD_RECORDS = st.dictionaries(st.sampled_from(["messageId", "body", "attributes"]), JSON, max_size=3)


@pytest.mark.usefixtures("_put_back")
@mostly(100)
@given(records=st.lists(ODD_RECORDS | JSON, max_size=4), queue=st.sampled_from(sorted(QUEUES)))
def test_malformed_records_do_not_raise(records: list[Any], queue: str) -> None:
    new_platform()
    QUEUES[queue]({"Records": records}, None)


TEXTS = st.text(max_size=40)
QUERIES = st.lists(
    st.tuples(st.sampled_from(["projectId", "userId", "PROLIFIC_PID", "poll", "x"]), st.sampled_from(
        [PROJECT, "alice", "%ff", "%00", "..%2f..", "a/b", "3", "finalStep", "", "%F0%9F%90%8E", "😀", "\ud800"]
    )),
    max_size=5,
).map(lambda pairs: "&".join(f"{k}={v}" for k, v in pairs))  # fmt: skip
FORMS = st.dictionaries(
    st.sampled_from(["hippodrome-step", "hippodrome-ticket", "hippodrome-action", "token", "delay", "projectId", "userId"]),
    st.sampled_from(["1", "3", "finalStep", "restart", "-1", "1e9", "NaN", PROJECT, "alice", "😀"]) | JSON,
)  # fmt: skip
REQUESTS = st.fixed_dictionaries(
    {
        "requestContext": st.fixed_dictionaries(
            {"http": st.fixed_dictionaries({"method": st.sampled_from(["GET", "POST", "HEAD", "PUT", "OPTIONS", "é"])})}
        )
    },
    optional={
        "rawPath": st.sampled_from(["/next", "/", "/steps/ms-pacman/consent.png", "/steps/../x", "/steps//", "/é\0"]) | TEXTS,
        "rawQueryString": QUERIES | TEXTS,
        "headers": st.dictionaries(st.sampled_from(["accept", "content-type", "Accept", "x"]), st.sampled_from([
            "text/html", "application/json", "application/x-www-form-urlencoded", "application/json; charset=utf-16", "", "*/*"
        ])),
        "body": TEXTS | FORMS.map(json.dumps) | st.binary(max_size=30).map(lambda b: base64.b64encode(b).decode()),
        "isBase64Encoded": st.booleans(),
    },
)  # fmt: skip


@pytest.mark.usefixtures("_put_back")
@mostly(300)
@given(event=REQUESTS, which=st.sampled_from(sorted(WEB)))
def test_every_request_gets_an_answer(event: dict[str, Any], which: str) -> None:
    new_platform()
    answer = WEB[which](event, None)
    assert 200 <= answer["statusCode"] < 500
    assert isinstance(answer["body"], str)
    json.dumps(answer).encode()
    for name, value in answer["headers"].items():
        assert "\n" not in value, name


@pytest.mark.usefixtures("_put_back")
@mostly(100)
@given(event=st.dictionaries(ANY_TEXT, JSON, max_size=5), project=JSON | NEARLY)
def test_any_registration_gets_an_answer(event: dict[str, Any], project: Any) -> None:
    platform = new_platform()
    before = dict(platform.documents.kept)
    for given_event in (event, {"project": project}, {**event, "project": {**event, "id": PROJECT}}):
        answer = update_project_master_list.handler(given_event, None)
        assert answer.get("problems")
    assert platform.documents.kept == before


@pytest.mark.parametrize("where", [{"name": "\ud800"}, {"texts": {"\ud800": "x"}}, {"trial": {"\udc00": {"a": 1}}}])
def test_a_registration_with_half_a_character_is_refused(platform: FakePlatform, where: dict[str, Any]) -> None:
    """Such a key once made the check of the values run for ever."""
    before = dict(platform.documents.kept)
    answer = update_project_master_list.handler({"project": {"id": PROJECT, **where}}, None)
    assert "half of a character" in answer["problems"][0]
    assert platform.documents.kept == before


def test_an_internal_failure_shows_a_sentence_and_no_traceback(platform: FakePlatform) -> None:
    def broken(*args: Any) -> Any:
        raise RuntimeError(SECRET)

    platform.documents.get = broken  # type: ignore[method-assign]
    for accept in ("text/html", "application/json"):
        event = {**aws_events.load("http_get"), "headers": {"accept": accept}}
        answer = next_step.handler(event, None)
        assert answer["statusCode"] == 500
        assert "try again" in answer["body"]
        assert SECRET not in json.dumps(answer)
        assert "Traceback" not in answer["body"]


def test_a_follow_up_with_invalid_labels_changes_no_name(platform: FakePlatform) -> None:
    """A follow-up names servers by label only; an invalid label has no effect."""
    follow_up = {"change": "C1", "servers": [{"label": "../../etc", "attempt": 1}, {"label": "", "attempt": -5}]}
    assert task_changed.handler(batch(follow_up), None) == NOTHING_FAILED
    assert platform.dns.records == {}
    assert DnsRecord("x", "y") not in list(platform.dns.list())


HANDLERS: list[Callable[[dict[str, Any], object], Any]] = [*QUEUES.values(), *WEB.values(), sweep.handler]


@pytest.mark.parametrize("handler", HANDLERS)
def test_an_empty_event_does_not_raise(
    platform: FakePlatform, handler: Callable[[dict[str, Any], object], Any]
) -> None:
    assert isinstance(handler({}, None), dict)


@pytest.mark.parametrize("handler", [next_step, send_start_server_message, send_stop_server_message])
@pytest.mark.parametrize("method", ["GET", "POST", "OPTIONS", "PUT"])
def test_responses_over_https_have_strict_transport_security_and_others_do_not(handler: Any, method: str) -> None:
    installed.use(studies.installed())
    said = []
    for headers in ({"x-forwarded-proto": "https"}, {"x-forwarded-proto": "http"}, {}):
        for query in ("", "projectId=maze&userId=alice", "projectId=maze"):
            event = aws_events.http_event(method, query, headers=headers)
            said.append((bool(headers), handler.handler(event, None)["headers"].get("Strict-Transport-Security")))
    assert said == [(True, "max-age=63072000")] * 3 + [(True, None)] * 3 + [(False, None)] * 3
    installed.use(None)
