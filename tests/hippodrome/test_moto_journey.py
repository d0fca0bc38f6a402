"""The functions' journey on AWS as moto plays it: from the link until nothing is left, in order and in disorder."""

from __future__ import annotations

import base64
import html
import json
import random
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

from hippodrome.config import read_project
from hippodrome.model import ids, server
from lambdas import (
    installed,
    next_step,
    send_stop_server_message,
    start_server,
    stop_server,
    sweep,
    task_changed,
    update_project_master_list,
)
from testing import aws_events
from testing.moto_world import MotoWorld
from testing.visitors import body_of, hidden
from tests.hunting import sample

ROOT = Path(__file__).resolve().parents[2]
PROJECT = "ms-pacman"
FUNCTIONS = {"start": start_server, "stop": stop_server, "task": task_changed}
GAME, AFTER = "3", "4"


class Town:
    """An account with the example study, and what AWS does between the functions: queues, ECS's events, delays.

    With `disorder`, every message comes twice, late and in any order, and names take their time to get known.
    """

    def __init__(self, world: MotoWorld, disorder: random.Random | None = None, **changes: Any) -> None:
        self.world, self.disorder = world, disorder
        self.waiting: list[tuple[str, str]] = []  # queue and body
        self.begun: set[str] = set()
        self.ended: set[str] = set()
        installed.use(world.platform)
        registration = {**read_project(ROOT).registration(), **changes}
        for file in (ROOT / "steps").iterdir():
            self.put(f"{PROJECT}/steps/{file.name}", file.read_bytes())
        answer = update_project_master_list.handler({"project": registration}, None)
        assert answer.get("registered") == PROJECT, answer

    # S3 as others see it

    def put(self, key: str, body: bytes) -> None:
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def stored(self, key: str) -> Any:
        s3 = self.world.client("s3")
        try:
            return json.loads(s3.get_object(Bucket=self.world.env["BUCKET"], Key=key)["Body"].read())
        except s3.exceptions.NoSuchKey:
            return None

    def record(self, user: str) -> Any:
        return self.stored(server.key(ids.server_label(PROJECT, user)))

    # What AWS does

    def happen(self, *events: dict[str, Any]) -> None:
        """ECS events on their way to `task_changed`."""
        self._send("task", *[json.dumps(event) for event in events])

    def deliver(self, queue: str | None = None) -> None:
        """Hand on what waits, and what follows from it, until all is quiet. With `queue`, only what waits there."""
        for _ in range(1000):
            if self.disorder:
                self.world.in_sync = True
            self._collect()
            here = [(q, body) for q, body in self.waiting if queue in (None, q)]
            if not here:
                return
            self._hand_over(here)
            if queue:
                return
        raise AssertionError(f"no quiet: {len(self.waiting)} messages, such as {self.waiting[0]}")

    def deliver_some(self) -> None:
        self._collect()
        if self.disorder:
            # Each look at a change that is not in sync is followed by another, and here by two: more than half of them
            # must find it in sync, or there would be ever more.
            self.world.in_sync = self.disorder.random() < 0.7
        if self.waiting:
            self._hand_over(self.waiting)

    def _send(self, queue: str, *bodies: str) -> None:
        self.waiting += [(queue, body) for body in bodies for _ in range(2 if self.disorder else 1)]

    def _collect(self) -> None:
        self.world.skip_delays()
        for queue in FUNCTIONS:
            self._send(queue, *[record["body"] for record in self.world.receive(queue)["Records"]])
        for arn in self.world.task_arns():
            task = self.world.task(arn)
            if arn not in self.begun and task.desired_status == "RUNNING":
                self.begun.add(arn)
                self.happen(*[self.world.task_event(arn, status) for status in ("PROVISIONING", "PENDING", "RUNNING")])
            if arn not in self.ended and task.desired_status == "STOPPED":
                self.ended.add(arn)
                reason = task.stopped_reason
                self.happen(self.world.task_event(arn, "STOPPED", stop_code="UserInitiated", reason=reason))

    def _hand_over(self, messages: list[tuple[str, str]]) -> None:
        if self.disorder:
            self.disorder.shuffle(messages)
        queue = messages[0][0]
        batch = [message for message in messages if message[0] == queue][
            : self.disorder.randint(1, 4) if self.disorder else 10
        ]
        event = self.world.sqs_event(queue, [body for _, body in batch])
        for message in batch:
            self.waiting.remove(message)
        failed = FUNCTIONS[queue].handler(event, None)["batchItemFailures"]
        again = {failure["itemIdentifier"] for failure in failed}
        assert self.disorder or not again, "something failed in good order"
        self.waiting += [m for m, r in zip(batch, event["Records"], strict=True) if r["messageId"] in again]

    def lose(self, task: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """The task ends without our asking, which is told twice."""
        self.end(task, "DEPROVISIONING", stop_code, exit_code)
        self.end(task, "STOPPED", stop_code, exit_code)

    def end(self, task: str, status: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """One step of the end of a task that we did not ask for."""
        self.ended.add(task)
        self.happen(self.world.task_event(task, status, stop_code=stop_code, exit_code=exit_code, desired="STOPPED"))

    # What is left

    def living(self) -> list[str]:
        return [arn for arn in self.world.task_arns() if self.world.task(arn).desired_status == "RUNNING"]

    def assert_nothing_left(self) -> None:
        assert self.living() == []
        assert self.world.records() == {}
        assert self.world.timers() == {}


class Person:
    """A participant with a browser."""

    def __init__(self, town: Town, user: str) -> None:
        self.town, self.user = town, user
        self.page = ""

    def send(self, payload: str, query: str = "", body: str | None = None, **changes: Any) -> dict[str, Any]:
        event = aws_events.load(payload)
        event["rawQueryString"] = urlencode({"projectId": PROJECT, "userId": self.user}) + query
        if body is not None:
            event |= {"body": base64.b64encode(body.encode()).decode(), "isBase64Encoded": True}
        return next_step.handler({**event, **changes}, None)

    def look(self) -> str:
        answer = self.send("http_get")
        assert answer["statusCode"] == 200, answer
        self.page = html.unescape(body_of(answer).decode())
        return self.page

    @property
    def hidden(self) -> dict[str, str]:
        return hidden(self.page)

    def answer(self, **fields: str) -> None:
        """Submit the page that is open, and see the next."""
        answer = self.send("http_post_form", body=urlencode({**self.hidden, **fields}))
        assert answer["statusCode"] == 303, answer
        self.look()

    @property
    def at(self) -> str:
        """The step whose page is open."""
        return re.findall(r'data-step="([^"]+)"', self.page)[0]

    def poll(self) -> Any:
        answer = self.send("http_get", f"&poll={GAME}", headers={"accept": "application/json"})
        assert answer["statusCode"] == 200
        return json.loads(body_of(answer))

    def play(self, score: int = 120) -> None:
        """The trial writes down that it is done, and the browser comes back."""
        body = json.dumps({"step": GAME, "answers": {"score": score}}).encode()
        self.town.put(f"{PROJECT}/users/{self.user}/answers/{GAME}.json", body)
        self.look()

    def to_the_game(self) -> None:
        self.look()
        self.answer(consent="yes")
        self.answer(age="33")
        assert self.at == GAME

    def act(self) -> bool:
        """Do the next thing there is to do, if it can be done now; False at the end."""
        self.look()
        if self.at == "finalStep":
            return False
        if self.at != GAME:
            self.answer(said=f"at {self.at}")
        elif self.poll()["state"] == "ready":
            self.play()
        return True


@pytest.fixture
def town() -> Iterator[Town]:
    with MotoWorld() as world:
        yield Town(world)
    installed.use(None)


@pytest.fixture
def alice(town: Town) -> Person:
    return Person(town, "R_alice")


def test_a_participant_from_the_link_until_nothing_is_left(town: Town, alice: Person) -> None:
    world = town.world
    assert "take part" in alice.look()
    alice.answer(consent="yes")
    assert world.task_arns() == []
    alice.answer(age="33")
    assert alice.poll()["state"] == "queued"

    town.deliver("start")
    assert alice.poll()["state"] == "starting"
    (task,) = town.living()
    name = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    assert world.task(task).started_by == name
    assert list(world.timers()) == [name]

    world.in_sync = False
    town.deliver("task")
    assert world.records() == {f"{name}.servers.example.org": world.public_ip(task)}
    town.deliver("task")
    assert alice.poll()["state"] == "naming"
    world.in_sync = True
    town.deliver()
    ready = alice.poll()
    assert (ready["state"], ready["url"]) == ("ready", f"wss://{name}.servers.example.org:5000/")
    environment = {e["name"]: e["value"] for e in world.task(task).overrides["containerOverrides"][0]["environment"]}
    assert ready["token"] == environment["TOKEN"]
    assert environment["STORE"] == "https://study.example.org/sign"

    alice.play(score=420)
    assert alice.at == AFTER
    town.deliver()
    town.assert_nothing_left()
    assert (town.record(alice.user)["state"], town.record(alice.user)["reason"]) == ("closed", "stopped")
    assert "was stopped" not in alice.look()

    alice.answer(fun="5")
    assert "You have finished the study" in alice.page
    assert town.stored(f"{PROJECT}/users/{alice.user}/participant.json")["completionCode"] in alice.page
    answers = {key: town.stored(f"{PROJECT}/users/{alice.user}/answers/{key}.json")["answers"] for key in "124"}
    assert answers == {"1": {"consent": "yes"}, "2": {"age": "33"}, "4": {"fun": "5"}}
    town.deliver()
    assert len(world.task_arns()) == 1


def test_messages_in_the_envelope_of_sns_do_as_well() -> None:
    with MotoWorld(raw_delivery=False) as world:
        town = Town(world)
        alice = Person(town, "R_alice")
        alice.to_the_game()
        town.deliver()
        assert alice.poll()["state"] == "ready"
        alice.play()
        town.deliver()
        town.assert_nothing_left()
    installed.use(None)


def test_two_participants_have_a_server_each(town: Town, alice: Person) -> None:
    bob = Person(town, "R_bob")
    for person in (alice, bob):
        person.to_the_game()
    with town.world.recording() as calls:
        town.deliver()
    changes = [call for call in calls if call.operation == "ChangeResourceRecordSets"]
    assert len(changes) == 1, "one change of names for the batch"
    servers = [person.poll() for person in (alice, bob)]
    assert [found["state"] for found in servers] == ["ready", "ready"]
    assert servers[0]["url"] != servers[1]["url"]
    assert servers[0]["token"] != servers[1]["token"]
    alice.play()
    town.deliver()
    assert len(town.living()) == len(town.world.records()) == len(town.world.timers()) == 1
    assert bob.poll()["state"] == "ready"
    bob.play()
    town.deliver()
    town.assert_nothing_left()


def test_the_shutdown_is_there_before_the_task_and_stops_it(town: Town, alice: Person) -> None:
    world = town.world
    alice.to_the_game()
    with world.recording() as calls:
        town.deliver("start")
    actions = [call.action for call in calls]
    assert actions.index("scheduler:CreateSchedule") < actions.index("ecs:RunTask")
    name = world.task(town.living()[0]).started_by
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

    town.deliver()
    assert alice.poll()["state"] == "ready"
    assert world.fire_timer(name) == message
    town.deliver()
    town.assert_nothing_left()
    assert town.record(alice.user)["reason"] == "deadline"
    ended = alice.poll()
    assert (ended["state"], ended["again"]) == ("ended", True)


def test_a_delayed_stop_over_http_is_a_timer_of_its_own(town: Town, alice: Person) -> None:
    alice.to_the_game()
    town.deliver()
    event = aws_events.load("http_post_json")
    event |= {
        "rawQueryString": urlencode({"projectId": PROJECT, "userId": alice.user}),
        "body": json.dumps({"delay": 300, "token": alice.poll()["token"]}),
        "isBase64Encoded": False,
    }
    assert send_stop_server_message.handler(event, None)["statusCode"] == 202
    (delayed,) = [name for name in town.world.timers() if name.endswith("-delay")]
    town.world.fire_timer(delayed)
    town.deliver()
    town.assert_nothing_left()


def test_a_server_taken_by_spot_is_followed_by_another(town: Town, alice: Person) -> None:
    alice.to_the_game()
    town.deliver()
    before, (first,) = alice.poll(), town.living()
    warning = town.world.task_event(first, "RUNNING", desired="STOPPED", stop_code="SpotInterruption")
    town.happen(warning)
    town.deliver()
    assert {**alice.poll(), "seconds": 0} == {**before, "seconds": 0}, "the warning alone changes nothing"

    town.lose(first)
    town.deliver("task")
    assert town.world.records() == {}
    assert town.world.timers() == {}
    assert (alice.poll()["state"], alice.poll()["attempt"]) == ("queued", 2)
    town.deliver()
    after, (second,) = alice.poll(), town.living()
    assert (after["state"], after["attempt"]) == ("ready", 2)
    assert second != first
    assert after["token"] != before["token"]
    assert after["url"] == before["url"].replace("-1.", "-2.")
    assert len(town.world.records()) == len(town.world.timers()) == 1

    town.happen(town.world.task_event(first, "STOPPED", stop_code="SpotInterruption"))  # said once more, late
    town.deliver()
    assert alice.poll()["state"] == "ready"
    alice.play()
    town.deliver()
    town.assert_nothing_left()


def test_a_trial_that_ends_by_itself_leaves_nothing_and_is_not_replaced(town: Town, alice: Person) -> None:
    alice.to_the_game()
    town.deliver()
    town.lose(town.living()[0], "EssentialContainerExited", exit_code=0)
    town.deliver()
    town.assert_nothing_left()
    assert town.record(alice.user)["reason"] == "ended"
    assert len(town.world.task_arns()) == 1


def test_without_spot_capacity_the_server_is_on_demand(town: Town, alice: Person) -> None:
    alice.to_the_game()
    full = {"tasks": [], "failures": [{"reason": "Capacity is unavailable at this time. Please try again later"}]}
    town.world.answer("ecs:RunTask", full)
    town.deliver()
    assert alice.poll()["state"] == "ready"
    assert town.world.task(town.living()[0]).capacity_provider_name == "FARGATE"


def test_a_cluster_of_the_participants_own_goes_with_the_server() -> None:
    with MotoWorld() as world:
        town = Town(world, cluster="participant")
        alice = Person(town, "R_alice")
        alice.to_the_game()
        town.deliver()
        assert alice.poll()["state"] == "ready"
        assert len(world.client("ecs").list_clusters()["clusterArns"]) == 2
        alice.play()
        town.deliver()
        town.assert_nothing_left()
        assert [arn.rpartition("/")[2] for arn in world.client("ecs").list_clusters()["clusterArns"]] == ["hippodrome"]
    installed.use(None)


def test_nobody_waits_until_their_cluster_can_be_deleted() -> None:
    with MotoWorld() as world:
        town = Town(world, cluster="participant")
        alice = Person(town, "R_alice")
        alice.to_the_game()
        town.deliver()
        (first,) = town.living()
        town.end(first, "DEPROVISIONING")
        town.deliver()
        assert (alice.poll()["state"], alice.poll()["attempt"]) == ("ready", 2)
        assert first.split("/")[-2] in own_clusters(world)
        town.end(first, "STOPPED")
        town.deliver()
        assert own_clusters(world) == {town.living()[0].split("/")[-2]}
        alice.play()
        town.deliver()
        town.assert_nothing_left()
        assert own_clusters(world) == set()
    installed.use(None)


def own_clusters(world: MotoWorld) -> set[str]:
    found = {arn.rpartition("/")[2] for arn in world.client("ecs").list_clusters()["clusterArns"]}
    return found - {"hippodrome"}


def test_the_second_registration_keeps_the_secret_and_the_study_goes_on(town: Town, alice: Person) -> None:
    alice.look()
    before = town.stored("project_master_list.json")["projects"][0]
    again = update_project_master_list.handler({"project": read_project(ROOT).registration()}, None)
    assert again["registered"] == PROJECT
    (after,) = town.stored("project_master_list.json")["projects"]
    assert after["version"] != before["version"]
    assert after | {"version": ""} == before | {"version": ""}
    assert after["salt"]
    assert "secret" not in after
    alice.answer(consent="yes")
    assert alice.at == "2"


# The sweep


def test_the_sweep_removes_our_leftovers_and_nothing_of_strangers(town: Town, alice: Person) -> None:
    world = town.world
    bob = Person(town, "R_bob")
    for person in (alice, bob):
        person.to_the_game()
    town.deliver()
    alice.play()
    town.deliver()
    (bobs,) = town.living()
    theirs = strangers(world)
    before = zone(world)

    leftover = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    add_name(world, f"{leftover}.example.org", "203.0.113.66")
    lost = run(world, leftover)
    world.platform.timers.set(leftover, datetime.now(UTC) + timedelta(hours=1), {"projectId": PROJECT})

    swept = sweep.handler(aws_events.load("schedule_sweep"), None)
    assert {what: count for what, count in swept.items() if count} == {"tasks": 1, "names": 1, "timers": 1}
    assert zone(world) == before
    assert sorted(town.living()) == sorted([bobs, *theirs])
    assert world.task(lost).stopped_reason.startswith("hippodrome:")
    bobs_timer = ids.server_name(ids.server_label(PROJECT, bob.user), 1)
    assert set(world.timers()) == {bobs_timer, "nightly-backup"}
    assert bob.poll()["state"] == "ready"

    again = sweep.handler(aws_events.load("schedule_sweep"), None)
    assert not any(again.values())


def test_the_sweep_replaces_a_server_whose_end_nobody_told_us(town: Town, alice: Person) -> None:
    alice.to_the_game()
    town.deliver()
    (task,) = town.living()
    town.world.task_event(task, "STOPPED")  # and the event is lost
    town.ended.add(task)
    label = ids.server_label(PROJECT, alice.user)
    record = {**town.record(alice.user), "requested": "2026-01-01T00:00:00Z"}
    town.put(server.key(label), json.dumps(record).encode())
    assert sweep.handler({}, None)["lost"] == 1
    town.deliver()
    assert (alice.poll()["state"], alice.poll()["attempt"]) == ("ready", 2)


def test_the_sweep_stops_what_its_timer_has_forgotten(town: Town, alice: Person) -> None:
    alice.to_the_game()
    town.deliver()
    name = ids.server_name(ids.server_label(PROJECT, alice.user), 1)
    town.world.platform.timers.cancel(name)
    record = {**town.record(alice.user), "deadline": "2026-01-01T00:00:00Z"}
    town.put(server.key(ids.server_label(PROJECT, alice.user)), json.dumps(record).encode())
    assert sweep.handler({}, None)["overdue"] == 1
    town.deliver()
    town.assert_nothing_left()


def add_name(world: MotoWorld, name: str, value: str, kind: str = "A", ttl: int = 60) -> None:
    record = {"Name": name, "Type": kind, "TTL": ttl, "ResourceRecords": [{"Value": value}]}
    world.client("route53").change_resource_record_sets(
        HostedZoneId=world.ids["zone"], ChangeBatch={"Changes": [{"Action": "UPSERT", "ResourceRecordSet": record}]}
    )


def zone(world: MotoWorld) -> list[tuple[str, str]]:
    found = world.client("route53").list_resource_record_sets(HostedZoneId=world.ids["zone"])["ResourceRecordSets"]
    return sorted((record["Name"], record["Type"]) for record in found)


def run(world: MotoWorld, started_by: str) -> str:
    """A task that none of our functions has run."""
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
    """What others keep in the same zone, cluster and schedule group; their tasks."""
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


# Twice, late, in any order


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(6), 3))
def test_everything_twice_and_in_any_order_comes_to_the_same_end(seed: int) -> None:
    disorder = random.Random(seed)
    with MotoWorld() as world:
        town = Town(world, disorder)
        people = [Person(town, f"R_{name}") for name in ("alice", "bob", "carol")]
        left = list(people)
        for _ in range(600):
            if not left:
                break
            person = disorder.choice(left)
            if disorder.random() < 0.4 and not person.act():
                left.remove(person)
            town.deliver_some()
        assert not left, "somebody did not come to the end"
        town.deliver()
        town.assert_nothing_left()
        assert len(world.task_arns()) == len(people), "one server each"
        for person in people:
            assert town.record(person.user)["state"] == "closed"
            assert town.stored(f"{PROJECT}/users/{person.user}/answers/{AFTER}.json")["answers"] == {"said": "at 4"}
    installed.use(None)


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(4), 2))
def test_spot_may_strike_at_any_moment_of_the_disorder(seed: int) -> None:
    disorder = random.Random(1000 + seed)
    with MotoWorld() as world:
        town = Town(world, disorder)
        alice = Person(town, "R_alice")
        struck = 0
        for _ in range(600):
            living = [task for task in town.living() if task in town.begun]
            if living and struck < 2 and disorder.random() < 0.15:
                town.lose(disorder.choice(living))
                struck += 1
            if disorder.random() < 0.4 and not alice.act():
                break
            town.deliver_some()
        else:
            raise AssertionError("she did not come to the end")
        town.deliver()
        town.assert_nothing_left()
        assert len(world.task_arns()) <= struck + 1
    installed.use(None)
