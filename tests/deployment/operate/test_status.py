"""`hippodrome status`: where participants are and which servers run, from listings, without any id of a participant."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import pytest
from botocore.exceptions import ClientError
from rich.console import Console

from hippodrome.console.problem import Exit
from hippodrome.control.model import server
from hippodrome.control.model.server import Reason, ServerState
from hippodrome.control.servers.causes import Cause
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.core import server_records
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.operate import status
from hippodrome.deployment.operate.snapshot import Snapshot
from hippodrome.protocol.keys import session_key
from hippodrome.protocol.session import Member, SessionDocument
from testing.studies import study
from tests.deployment.certificates import chain
from tests.deployment.installation import Installed, process

CLOSED = msgspec.structs.replace(study(), id="old", live=False)


@pytest.fixture
def world(installed: Installed) -> Installed:
    installed.register(study(), CLOSED)
    return installed


def look(world: Installed, capsys: Any, *arguments: str) -> Any:
    ran = world.run(capsys, "status", "--json", *(arguments or ["--all"]))
    assert ran.code == Exit.DONE, ran.err
    return ran.json


def test_participants_stand_at_the_first_step_without_an_answer(world: Installed, capsys: Any) -> None:
    for number, answered in enumerate([0, 0, 1, 2, 3, 4, 4]):
        world.participant(f"person-{number}", answered=answered, recordings=2)
    world.participant("early-bird", project=CLOSED)
    maze, old = look(world, capsys)["projects"]
    assert (maze["participants"], maze["finished"], maze["arrivedToday"]) == (7, 2, 7)
    assert [(step["step"], step["here"]) for step in maze["steps"]] == [
        ("1", 2),
        ("2", 1),
        ("3", 1),
        ("4", 1),
        ("finalStep", 2),
    ]
    assert (old["live"], old["participants"]) == (False, 1)
    text = " ".join(world.run(capsys, "status", "--all").out.split())
    assert "1 consent: 2, 2 questionnaire: 1, 3 game: 1, 4 survey: 1" in text
    assert "person-" not in text + world.run(capsys, "status", "--all", "--json").out


def test_unknown_objects_in_the_bucket_count_as_no_participants(world: Installed, capsys: Any) -> None:
    world.participant("alice", answered=1)
    for key in (
        "maze/users/.DS_Store",
        "maze/users/notes.txt",
        "maze/users/bad id/participant.json",
        "maze/users/ghost/answers/1.json",
        "maze/users/alice/answers/9.json",
        "maze/users/alice/answers/x/participant.json",
        "maze/users//participant.json",
        "mazeful/users/bob/participant.json",
        "_servers/readme.md",
        "_servers/s5go4w6wkgepm2vg3dun5.json.bak",
    ):
        world.put(key, b"{}")
    maze = look(world, capsys)["projects"][0]
    assert maze["participants"] == 1
    assert [step["here"] for step in maze["steps"]] == [0, 1, 0, 0, 0]


@pytest.mark.explores
def test_status_counts_participants_beyond_a_page_of_keys_without_reading_them(
    world: Installed, capsys: Any, pages: int
) -> None:
    s3, bucket = world.client("s3"), world.env["BUCKET"]
    count = pages + 100
    for number in range(count):
        for key in ("answers/1.json", "answers/2.json", "participant.json"):
            s3.put_object(Bucket=bucket, Key=f"maze/users/p{number:05}/{key}", Body=b"{}")
    with world.recording() as calls:
        maze = look(world, capsys)["projects"][0]
    assert (maze["participants"], maze["steps"][2]["here"]) == (count, count)
    read = [call.params["Key"] for call in calls if call.operation == "GetObject"]
    assert not [key for key in read if "/users/" in key]


def test_status_shows_the_age_and_the_minutes_left_of_servers(world: Installed, capsys: Any) -> None:
    ready = world.record("alice")
    world.record("bob", ServerState.STARTING)
    world.record("carol", ServerState.CLOSED, reason=Reason.LOST, closed=datetime.now(UTC))
    world.put("_servers/sbbbbbbbbbbbbbbbbbbbb.json", b"not a record")
    before = datetime.now(UTC)
    found, shown = look(world, capsys)["servers"], world.run(capsys, "status", "--all").out
    ages = [(now - ready.requested) / timedelta(minutes=1) for now in (before, datetime.now(UTC))]
    assert found["byState"] == {"ready": 1, "starting": 1}
    assert found["closedToday"] == {"lost": 1}
    one = next(server for server in found["open"] if server["state"] == "ready")
    assert one["server"] == ready.name
    assert round(ages[0], 1) <= one["ageMinutes"] <= round(ages[1], 1)
    assert round(30 - ages[1], 1) <= one["minutesLeft"] <= round(30 - ages[0], 1)
    assert look(world, capsys, "old")["servers"]["byState"] == {}
    minutes = range(round(30 - ages[1]), round(30 - ages[0]) + 1)
    assert any(f" {left} min" in shown for left in minutes)


def test_status_says_why_servers_failed_and_what_to_do(world: Installed, capsys: Any) -> None:
    now = datetime.now(UTC)

    def lost(user: str, ago: timedelta, cause: str, **more: Any) -> server.Server:
        return world.record(user, ServerState.CLOSED, reason=Reason.LOST, closed=now - ago, cause=cause, **more)

    first = server.past_attempt(lost("carol", timedelta(minutes=3), Cause.SPOT))
    last = lost("carol", timedelta(0), Cause.IMAGE, attempt=2, earlier=(first,))
    lost("dave", timedelta(minutes=9), Cause.IMAGE)
    lost("eve", timedelta(hours=25), Cause.OUT_OF_MEMORY)
    lost("frank", timedelta(0), "of a later version")
    world.record("grace", ServerState.CLOSED, reason=Reason.ENDED, closed=now)
    image, spot = look(world, capsys)["servers"]["failed"]
    assert (image["project"], image["cause"], image["servers"], image["lastServer"]) == ("maze", "image", 2, last.name)
    assert image["matters"]
    assert (spot["cause"], spot["servers"], spot["matters"]) == ("spot", 1, False)
    text = " ".join(world.run(capsys, "status", "--all").out.split())
    assert f"! maze: 2 servers failed, the last {now:%H:%M} UTC ({last.name})." in text
    assert Cause.IMAGE.sentence in text
    assert "by no fault of yours, and replaced where AWS could: 1 spot (maze)." in text
    assert not any(user in text for user in ("carol", "dave"))


@pytest.mark.parametrize(
    ("state", "warned"), [("UPDATE_COMPLETE", False), ("IMPORT_COMPLETE", False), ("UPDATE_ROLLBACK_COMPLETE", True)]
)
def test_status_warns_only_of_a_stack_whose_last_operation_failed_or_goes_on(state: str, warned: bool) -> None:
    installation = Installation("hippodrome", "us-east-1", state, {"Site": "https://study.example.org"})
    lines = Console(width=200)
    with lines.capture() as shown:
        lines.print(status.picture(Snapshot(at=datetime.now(UTC)), installation))
    assert (f"! The stack is in {state}." in shown.get()) == warned


def test_without_failures_status_says_nothing_of_them(world: Installed, capsys: Any) -> None:
    world.record("alice")
    assert look(world, capsys)["servers"]["failed"] == []
    assert "fault" not in world.run(capsys, "status", "--all").out


WARM_SERVERS = [f"~{number:020x}" for number in range(5)]


def test_warm_servers_are_counted_separately_and_not_as_participants(world: Installed, capsys: Any) -> None:
    world.register(study(warm_servers=4), CLOSED)
    for warm_server in WARM_SERVERS[:3]:
        world.record(warm_server)
    world.record(WARM_SERVERS[3], ServerState.STARTING)
    world.record(WARM_SERVERS[4], ServerState.CLOSED, reason=Reason.ASSIGNED, closed=datetime.now(UTC))
    world.record("alice", warm_server_name="s" + "a" * 20 + "-1")
    found = look(world, capsys)
    maze, old = found["projects"]
    assert maze["warmServers"] == {"wanted": 4, "ready": 3, "there": 4, "assignedToday": 1}
    assert old["warmServers"] == {"wanted": 0, "ready": 0, "there": 0, "assignedToday": 0}
    assert maze["participants"] == 0
    assert found["servers"]["byState"] == {"ready": 4, "starting": 1}
    assert sorted(server["warm"] for server in found["servers"]["open"]) == [False, True, True, True, True]
    assert found["servers"]["closedToday"] == {}  # a participant plays on it
    text = world.run(capsys, "status", "--all").out
    assert "maze: 3 of 4 warm servers ready; 1 assigned today." in text
    assert "4 ready, 1 starting, 4 of them warm" in text
    assert text.count("Spot, warm") == 4
    assert "~" not in text


def test_servers_of_sessions_are_shown_with_the_number_of_their_members(world: Installed, capsys: Any) -> None:
    formed, ahead = ("s." + "0" * 19 + digit for digit in "12")
    pairs = study(players=2)
    world.register(pairs)
    for session in (formed, ahead):
        world.record(session, project=pairs)
    members = (Member("person-1", None, 0), Member("person-2", None, 1))
    world.put(session_key("maze", formed), SessionDocument(formed, 2, members).to_json())
    found = look(world, capsys)["servers"]["open"]
    assert sorted((one["session"], one["members"]) for one in found) == [(True, 0), (True, 2)]
    text = world.run(capsys, "status", "--all").out
    assert "2 ready, 2 of sessions with 2 members" in text
    assert "Spot, session of 2" in text
    assert "Spot, started ahead" in text
    assert not any(part in text for part in ("person-", formed, ahead))


def test_servers_of_single_participants_are_shown_without_members(world: Installed, capsys: Any) -> None:
    world.record("alice")
    (one,) = look(world, capsys)["servers"]["open"]
    assert one.keys().isdisjoint({"session", "members"})


def test_warm_servers_of_a_closed_study_are_shown(world: Installed, capsys: Any) -> None:
    world.register(study(warm_servers=4, live=False))
    world.record(WARM_SERVERS[0], ServerState.DRAINING)
    assert look(world, capsys)["projects"][0]["warmServers"]["wanted"] == 0
    assert "maze: 1 warm server on the way out." in world.run(capsys, "status", "--all").out


def test_todays_spending_counts_the_time_of_servers_today(world: Installed, capsys: Any) -> None:
    assert look(world, capsys)["spentToday"]["likely"] == 0
    world.record("alice", ServerState.CLOSED, reason=Reason.ENDED, closed=datetime.now(UTC), spot=False)
    before = datetime.now(UTC)
    spent = look(world, capsys)["spentToday"]["likely"]
    after = datetime.now(UTC)
    midnight = after.replace(hour=0, minute=0, second=0, microsecond=0)
    hours = [min(timedelta(minutes=10), now - midnight) / timedelta(hours=1) for now in (before, after)]
    least, most = (each * (0.04048 + 2 * 0.004445 + 0.005) for each in hours)
    rounded = 0.00005  # dollars
    assert 0.95 * least - rounded <= spent <= 1.05 * most + rounded


def test_status_shows_queues_alarms_and_the_certificate(world: Installed, capsys: Any) -> None:
    found = look(world, capsys)
    assert [(q["name"], q["waiting"], q["deadLetters"]) for q in found["queues"]] == [
        ("hippodrome-start-dead-letters", 0, True),
        ("hippodrome-start-server-queue", 0, False),
    ]
    assert (found["certificate"], found["alarms"], found["problems"]) == (None, [], {})
    sqs = world.client("sqs")
    dead = sqs.get_queue_url(QueueName="hippodrome-start-dead-letters")["QueueUrl"]
    sqs.send_message(QueueUrl=dead, MessageBody="{}")
    world.client("cloudwatch").set_alarm_state(
        AlarmName="hippodrome-dead-letters", StateValue="ALARM", StateReason="test"
    )
    world.client("cloudwatch").put_metric_alarm(  # another owner's
        AlarmName="hippodrome-other", Namespace="x", MetricName="y", Statistic="Maximum", Period=60,
        EvaluationPeriods=1, Threshold=0, ComparisonOperator="GreaterThanThreshold",
    )  # fmt: skip
    world.client("cloudwatch").set_alarm_state(AlarmName="hippodrome-other", StateValue="ALARM", StateReason="test")
    world.put("SSL/servers.example.org/fullchain.pem", chain("*.servers.example.org", days=60))
    found = look(world, capsys)
    assert found["alarms"] == ["hippodrome-dead-letters"]
    assert (found["certificate"]["daysLeft"], found["certificate"]["staging"]) == (60, False)
    assert found["queues"][0]["waiting"] == 1
    text = world.run(capsys, "status", "--all").out
    assert "1 message could not be dealt with" in text
    assert "Certificate: 60 days left (*.servers.example.org)" in text


@pytest.mark.parametrize(
    ("days", "issuer", "says"),
    [(-3, "R12", "-3 days left"), (50, "(STAGING) Riddling Rhubarb R12", "STAGING: browsers refuse it")],
)
def test_status_names_expired_and_staging_certificates(
    world: Installed, capsys: Any, days: int, issuer: str, says: str
) -> None:
    world.put("SSL/servers.example.org/fullchain.pem", chain("*.servers.example.org", days=days, issuer=issuer))
    assert says in world.run(capsys, "status", "--all").out


def test_status_shows_the_rest_if_a_part_is_refused(world: Installed, capsys: Any) -> None:
    world.participant("alice")
    world.record("alice")
    world.fail("cloudformation:ListStackResources", "AccessDenied", status=403)
    world.fail("cloudwatch:DescribeAlarms", "AccessDenied", status=403)
    world.put("SSL/servers.example.org/fullchain.pem", b"-----BEGIN NONSENSE-----")
    found = look(world, capsys)
    assert found["projects"][0]["participants"] == 1
    assert found["servers"]["byState"] == {"ready": 1}
    assert set(found["problems"]) == {"queues", "alarms", "certificate"}
    assert "These credentials may not list stack resources" in found["problems"]["queues"]


def test_a_broken_list_of_projects_is_reported_in_a_sentence(world: Installed, capsys: Any) -> None:
    world.put("project_master_list.json", b'{"projects": {"id": 7}}')
    assert "The list of projects cannot be read" in look(world, capsys)["problems"]["projects"]


def test_status_of_an_installation_without_projects_says_so(installed: Installed, capsys: Any) -> None:
    assert look(installed, capsys)["projects"] == []
    assert "No project is registered yet" in installed.run(capsys, "status", "--all").out


def test_a_second_look_reads_only_changed_records(world: Installed, monkeypatch: Any) -> None:
    monkeypatch.setattr(server_records, "SETTLED", timedelta(0))  # by default, recently written records are read again
    for user in ("alice", "bob", "carol"):
        world.record(user)
    records = Records(world.platform.documents)
    assert len(records.since()) == 3
    with world.recording() as calls:
        assert len(records.since()) == 3
    assert [call.operation for call in calls] == ["ListObjectsV2"]


def test_an_unreadable_record_counts_until_it_is_deleted(world: Installed) -> None:
    key = "_servers/sbbbbbbbbbbbbbbbbbbbb.json"
    world.put(key, b"not a record")
    records = Records(world.platform.documents)
    records.since()
    assert records.unreadable == 1
    world.platform.documents.delete(key)
    records.since()
    assert records.unreadable == 0


def test_watching_ends_at_ctrl_c(world: Installed, capsys: Any, monkeypatch: Any) -> None:
    world.participant("alice")
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        if len(slept) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(status.time, "sleep", sleep)
    ran = world.run(capsys, "status", "--all", "--watch")
    assert ran.code == Exit.DONE
    assert "maze" in ran.out
    assert "Interrupted" not in ran.err


def test_wrong_options_of_status_are_reported_in_a_sentence(world: Installed, capsys: Any) -> None:
    assert world.run(capsys, "status", "--all", "--watch", "--json").code == Exit.FAILED
    ran = world.run(capsys, "status", "--json", "labyrinth")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "No project named labyrinth" in ran.err


def test_status_in_another_region_says_where_the_installation_is(world: Installed, capsys: Any) -> None:
    name = "hippodrome-code-123456789012-ca-central-1"
    world.client("s3").create_bucket(Bucket=name, CreateBucketConfiguration={"LocationConstraint": "ca-central-1"})
    ran = world.run(capsys, "status", "--all", "--region", "eu-west-1")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "There is no stack named hippodrome in eu-west-1." in ran.err
    assert "→ Something of that name is in another region: say AWS_REGION=ca-central-1." in ran.err


def test_without_permission_to_list_buckets_status_says_how_to_name_another_region(
    world: Installed, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    denied = ClientError({"Error": {"Code": "AccessDenied", "Message": "no"}}, "ListBuckets")

    class Denied:
        def list_buckets(self) -> Any:
            raise denied

    monkeypatch.setattr(Account, "fail_fast_client", lambda *_: Denied())
    ran = world.run(capsys, "status", "--all", "--region", "eu-west-1")
    assert ran.code == Exit.FAILED
    assert "or name another region (AWS_REGION, --region)" in ran.err


def test_as_a_process(world: Installed) -> None:
    world.participant("alice", answered=2)
    world.record("alice")
    with world.served() as env:
        ran = process(env, "status", "--all", "--json")
        plain = process(env, "status", "--all")
        nowhere = process(env, "status", "--all", "--stack", "nowhere")
    assert ran.code == plain.code == Exit.DONE
    assert ran.json["projects"][0]["participants"] == 1
    assert ran.json["problems"] == {}
    assert "Servers: 1 ready" in plain.out
    assert (nowhere.code, nowhere.out) == (Exit.FAILED, "")
    assert "There is no stack named nowhere" in nowhere.err
