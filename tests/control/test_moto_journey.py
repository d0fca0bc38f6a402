"""A participant's study on moto's AWS: from the link until nothing is left, with messages in order and in disorder."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from urllib.parse import urlencode

import pytest

from hippodrome.control.config import read_project
from hippodrome.control.model import ids, server
from hippodrome.functions import (
    send_stop_server_message,
    sweep,
    update_project_master_list,
)
from testing import aws_events
from testing.exploration import sample
from testing.moto_study import AFTER, PROJECT, ROOT, Person, StudyOnMoto
from testing.moto_world import MotoWorld


@pytest.fixture
def study() -> Iterator[StudyOnMoto]:
    with MotoWorld() as world:
        yield StudyOnMoto(world)


@pytest.fixture
def alice(study: StudyOnMoto) -> Person:
    return Person(study, "R_alice")


def test_a_participant_plays_from_the_link_to_the_end_and_nothing_is_left(study: StudyOnMoto, alice: Person) -> None:
    world = study.world
    assert "take part" in alice.look()
    alice.answer(consent="yes")
    assert world.task_arns() == []
    alice.answer(age="33")
    assert alice.poll()["state"] == "queued"

    study.deliver("start")
    assert alice.poll()["state"] == "starting"
    (task,) = study.living()
    name = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    assert world.task(task).started_by == name
    assert list(world.timers()) == [name]

    world.in_sync = False
    study.deliver("task")
    assert world.records() == {f"{name}.servers.example.org": world.public_ip(task)}
    study.deliver("task")
    assert alice.poll()["state"] == "naming"
    world.in_sync = True
    study.deliver()
    ready = alice.poll()
    assert (ready["state"], ready["url"]) == ("ready", f"wss://{name}.servers.example.org:5000/")
    environment = {e["name"]: e["value"] for e in world.task(task).overrides["containerOverrides"][0]["environment"]}
    assert ready["token"] == environment["TOKEN"]
    assert environment["STORE"] == "https://hippodrome-Api.execute-api.us-east-1.amazonaws.com/sign"

    alice.play(score=420)
    assert alice.at == AFTER
    study.settle()
    assert (study.record(alice.user)["state"], study.record(alice.user)["reason"]) == ("closed", "stopped")
    assert "was stopped" not in alice.look()

    alice.answer(fun="5")
    assert "You have finished the study" in alice.page
    assert study.stored(f"{PROJECT}/users/{alice.user}/participant.json")["completionCode"] in alice.page
    answers = {key: study.stored(f"{PROJECT}/users/{alice.user}/answers/{key}.json")["answers"] for key in "124"}
    assert answers == {"1": {"consent": "yes"}, "2": {"age": "33"}, "4": {"fun": "5"}}
    study.deliver()
    assert len(world.task_arns()) == 1


def test_messages_in_the_envelope_of_sns_are_also_accepted() -> None:
    with MotoWorld(raw_delivery=False) as world:
        study = StudyOnMoto(world)
        alice = Person(study, "R_alice")
        alice.to_the_game()
        study.deliver()
        assert alice.poll()["state"] == "ready"
        alice.play()
        study.settle()


def test_two_participants_have_a_server_each(study: StudyOnMoto, alice: Person) -> None:
    bob = Person(study, "R_bob")
    for person in (alice, bob):
        person.to_the_game()
    with study.world.recording() as calls:
        study.deliver()
    changes = [call for call in calls if call.operation == "ChangeResourceRecordSets"]
    assert len(changes) == 1, "one change of names for the batch"
    servers = [person.poll() for person in (alice, bob)]
    assert [found["state"] for found in servers] == ["ready", "ready"]
    assert servers[0]["url"] != servers[1]["url"]
    assert servers[0]["token"] != servers[1]["token"]
    alice.play()
    study.deliver()
    assert len(study.living()) == len(study.world.records()) == len(study.world.timers()) == 1
    assert bob.poll()["state"] == "ready"
    bob.play()
    study.settle()


def test_the_timer_is_set_before_the_task_runs_and_stops_it(study: StudyOnMoto, alice: Person) -> None:
    world = study.world
    alice.to_the_game()
    with world.recording() as calls:
        study.deliver("start")
    actions = [call.action for call in calls]
    assert actions.index("scheduler:CreateSchedule") < actions.index("ecs:RunTask")
    name = world.task(study.living()[0]).started_by
    schedule = world.client("scheduler").get_schedule(GroupName="hippodrome", Name=name)
    assert schedule["Target"]["Arn"] == world.env["STOP_SERVER_TOPIC_ARN"]
    assert schedule["Target"]["RoleArn"] == world.env["SCHEDULE_ROLE_ARN"]
    assert schedule["ActionAfterCompletion"] == "DELETE"
    assert schedule["FlexibleTimeWindow"] == {"Mode": "OFF"}
    assert schedule["ScheduleExpressionTimezone"] == "UTC"
    message = {"projectId": PROJECT, "userId": alice.user, "attempt": 1, "reason": "deadline"}
    assert json.loads(schedule["Target"]["Input"]) == message
    (at, _) = world.timers()[name]
    assert abs(at - datetime.now(UTC) - timedelta(minutes=30)) < timedelta(minutes=1)  # maxRuntime of the example

    study.deliver()
    assert alice.poll()["state"] == "ready"
    assert world.fire_timer(name) == message
    study.settle()
    assert study.record(alice.user)["reason"] == "deadline"
    ended = alice.poll()
    assert (ended["state"], ended["again"]) == ("ended", True)


def test_a_delayed_stop_over_http_sets_its_own_timer(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    study.deliver()
    event = aws_events.load("http_post_json")
    event |= {
        "rawQueryString": urlencode({"projectId": PROJECT, "userId": alice.user}),
        "body": json.dumps({"delay": 300, "token": alice.poll()["token"]}),
        "isBase64Encoded": False,
    }
    assert send_stop_server_message.handler(event, None)["statusCode"] == 202
    (delayed,) = [name for name in study.world.timers() if name.endswith("-delay")]
    study.world.fire_timer(delayed)
    study.settle()


def test_a_server_that_spot_takes_is_replaced(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    study.deliver()
    before, (first,) = alice.poll(), study.living()
    warning = study.world.task_event(first, "RUNNING", desired="STOPPED", stop_code="SpotInterruption")
    study.happen(warning)
    study.deliver()
    assert {**alice.poll(), "seconds": 0} == {**before, "seconds": 0}, "the warning alone changes nothing"

    study.lose(first)
    study.deliver("task")
    assert study.world.records() == {}
    assert study.world.timers() == {}
    assert (alice.poll()["state"], alice.poll()["attempt"]) == ("queued", 2)
    study.deliver()
    after, (second,) = alice.poll(), study.living()
    assert (after["state"], after["attempt"]) == ("ready", 2)
    assert second != first
    assert after["token"] != before["token"]
    assert after["url"] == before["url"].replace("-1.", "-2.")
    assert len(study.world.records()) == len(study.world.timers()) == 1

    study.happen(study.world.task_event(first, "STOPPED", stop_code="SpotInterruption"))  # the event comes again, late
    study.deliver()
    assert alice.poll()["state"] == "ready"
    alice.play()
    study.settle()


def test_a_trial_that_ends_by_itself_leaves_nothing_and_is_not_replaced(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    study.deliver()
    study.lose(study.living()[0], "EssentialContainerExited", exit_code=0)
    study.settle()
    assert study.record(alice.user)["reason"] == "ended"
    assert len(study.world.task_arns()) == 1


def test_without_spot_capacity_the_server_is_on_demand(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    full = {"tasks": [], "failures": [{"reason": "Capacity is unavailable at this time. Please try again later"}]}
    study.world.answer("ecs:RunTask", full)
    study.deliver()
    assert alice.poll()["state"] == "ready"
    assert study.world.task(study.living()[0]).capacity_provider_name == "FARGATE"


def test_a_participants_own_cluster_is_removed_with_the_server() -> None:
    with MotoWorld() as world:
        study = StudyOnMoto(world, cluster="participant")
        alice = Person(study, "R_alice")
        alice.to_the_game()
        study.deliver()
        assert alice.poll()["state"] == "ready"
        assert len(world.client("ecs").list_clusters()["clusterArns"]) == 2
        alice.play()
        study.settle()
        assert [arn.rpartition("/")[2] for arn in world.client("ecs").list_clusters()["clusterArns"]] == ["hippodrome"]


def test_a_replacement_does_not_wait_until_the_old_cluster_can_be_deleted() -> None:
    with MotoWorld() as world:
        study = StudyOnMoto(world, cluster="participant")
        alice = Person(study, "R_alice")
        alice.to_the_game()
        study.deliver()
        (first,) = study.living()
        study.end(first, "DEPROVISIONING")
        study.deliver()
        assert (alice.poll()["state"], alice.poll()["attempt"]) == ("ready", 2)
        assert first.split("/")[-2] in own_clusters(world)
        study.end(first, "STOPPED")
        study.deliver()
        assert own_clusters(world) == {study.living()[0].split("/")[-2]}
        alice.play()
        study.settle()
        assert own_clusters(world) == set()


def own_clusters(world: MotoWorld) -> set[str]:
    found = {arn.rpartition("/")[2] for arn in world.client("ecs").list_clusters()["clusterArns"]}
    return found - {"hippodrome"}


def test_the_second_registration_keeps_the_secret_and_the_study_goes_on(study: StudyOnMoto, alice: Person) -> None:
    alice.look()
    before = study.stored("project_master_list.json")["projects"][0]
    again = update_project_master_list.handler({"project": read_project(ROOT).registration()}, None)
    assert again["registered"] == PROJECT
    (after,) = study.stored("project_master_list.json")["projects"]
    assert after["version"] != before["version"]
    assert after | {"version": ""} == before | {"version": ""}
    assert after["salt"]
    assert "secret" not in after
    alice.answer(consent="yes")
    assert alice.at == "2"


# The sweep


def test_the_sweep_removes_our_leftovers_and_nothing_of_others(study: StudyOnMoto, alice: Person) -> None:
    world = study.world
    bob = Person(study, "R_bob")
    for person in (alice, bob):
        person.to_the_game()
    study.deliver()
    alice.play()
    study.deliver()
    (bobs,) = study.living()
    theirs = strangers(world)
    before = zone(world)

    leftover = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    add_name(world, f"{leftover}.servers.example.org", "203.0.113.66")
    lost = run(world, leftover)
    world.platform.timers.set(leftover, datetime.now(UTC) + timedelta(hours=1), {"projectId": PROJECT})

    swept = sweep.handler(aws_events.load("schedule_sweep"), None)
    assert {what: count for what, count in swept.items() if count} == {"tasks": 1, "names": 1, "timers": 1}
    assert zone(world) == before
    assert sorted(study.living()) == sorted([bobs, *theirs])
    assert world.task(lost).stopped_reason.startswith("hippodrome:")
    bobs_timer = ids.server_name(ids.server_label(PROJECT, bob.user), 1)
    assert set(world.timers()) == {bobs_timer, "nightly-backup"}
    assert bob.poll()["state"] == "ready"

    again = sweep.handler(aws_events.load("schedule_sweep"), None)
    assert not any(again.values())


def test_the_sweep_replaces_a_server_whose_last_event_was_lost(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    study.deliver()
    (task,) = study.living()
    study.world.task_event(task, "STOPPED")  # and the event is lost
    study.ended.add(task)
    label = ids.server_label(PROJECT, alice.user)
    record = {**study.record(alice.user), "requested": "2026-01-01T00:00:00Z"}
    study.put(server.key(label), json.dumps(record).encode())
    assert sweep.handler({}, None)["lost"] == 1
    study.deliver()
    assert (alice.poll()["state"], alice.poll()["attempt"]) == ("ready", 2)


def test_the_sweep_stops_a_server_whose_timer_was_lost(study: StudyOnMoto, alice: Person) -> None:
    alice.to_the_game()
    study.deliver()
    name = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    study.world.platform.timers.cancel(name)
    record = {**study.record(alice.user), "deadline": "2026-01-01T00:00:00Z"}
    study.put(server.key(ids.server_label(PROJECT, alice.user)), json.dumps(record).encode())
    assert sweep.handler({}, None)["overdue"] == 1
    study.settle()


def add_name(world: MotoWorld, name: str, value: str, kind: str = "A", ttl: int = 60) -> None:
    record = {"Name": name, "Type": kind, "TTL": ttl, "ResourceRecords": [{"Value": value}]}
    world.client("route53").change_resource_record_sets(
        HostedZoneId=world.ids["zone"], ChangeBatch={"Changes": [{"Action": "UPSERT", "ResourceRecordSet": record}]}
    )


def zone(world: MotoWorld) -> list[tuple[str, str]]:
    found = world.client("route53").list_resource_record_sets(HostedZoneId=world.ids["zone"])["ResourceRecordSets"]
    return sorted((record["Name"], record["Type"]) for record in found)


def run(world: MotoWorld, started_by: str) -> str:
    """Run a task that none of our functions has started."""
    network = {"subnets": world.env["SUBNET"].split(","), "securityGroups": [world.env["SECURITY_GROUP"]]}
    answer = world.client("ecs").run_task(
        cluster="hippodrome",
        taskDefinition="hippodrome",
        launchType="FARGATE",
        startedBy=started_by,
        networkConfiguration={"awsvpcConfiguration": network},
    )
    return str(answer["tasks"][0]["taskArn"])


def strangers(world: MotoWorld) -> list[str]:
    """Make resources of others in the same zone, cluster and schedule group; their tasks."""
    other = ids.server_name(ids.server_label("somebody-elses", "R_carol"), 1)  # well formed, but not in our bucket
    for name in ("example.org", "www.example.org", f"{other}.example.org", f"{other}.sub.example.org"):
        add_name(world, name, "198.51.100.1")
    add_name(world, "*.example.org", "198.51.100.2")
    add_name(world, "example.org", "10 mail.example.org", kind="MX")
    add_name(world, f"{other}.example.org", '"v=spf1 -all"', kind="TXT", ttl=300)
    world.client("scheduler").create_schedule(
        GroupName="hippodrome",
        Name="nightly-backup",
        ScheduleExpression="at(2030-01-01T00:00:00)",
        FlexibleTimeWindow={"Mode": "OFF"},
        Target={"Arn": world.env["STOP_SERVER_TOPIC_ARN"], "RoleArn": world.env["SCHEDULE_ROLE_ARN"], "Input": "{}"},
    )
    return [run(world, "a-cron-job"), run(world, other)]


# Messages that come twice, late, or in any order


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(6), 3))
def test_repeated_messages_in_any_order_lead_to_the_same_end(seed: int) -> None:
    disorder = random.Random(seed)
    with MotoWorld() as world:
        study = StudyOnMoto(world, disorder)
        people = [Person(study, f"R_{name}") for name in ("alice", "bob", "carol")]
        left = list(people)
        for _ in range(600):
            if not left:
                break
            person = disorder.choice(left)
            if disorder.random() < 0.4 and not person.act():
                left.remove(person)
            study.deliver_some()
        assert not left, "somebody did not come to the end"
        study.settle()
        assert len(world.task_arns()) == len(people), "one server each"
        for person in people:
            assert study.record(person.user)["state"] == "closed"
            assert study.stored(f"{PROJECT}/users/{person.user}/answers/{AFTER}.json")["answers"] == {"said": "at 4"}


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(4), 2))
def test_an_interruption_by_spot_at_any_moment_leads_to_the_same_end(seed: int) -> None:
    disorder = random.Random(1000 + seed)
    with MotoWorld() as world:
        study = StudyOnMoto(world, disorder)
        alice = Person(study, "R_alice")
        struck = 0
        for _ in range(600):
            living = [task for task in study.living() if task in study.begun]
            if living and struck < 2 and disorder.random() < 0.15:
                study.lose(disorder.choice(living))
                struck += 1
            if disorder.random() < 0.4 and not alice.act():
                break
            study.deliver_some()
        else:
            raise AssertionError("she did not come to the end")
        study.settle()
        assert len(world.task_arns()) <= struck + 1
