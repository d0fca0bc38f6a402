"""The sweep on moto, beside thousands of resources of others: it removes our leftovers, and changes no byte of anything else.

Everything is compared before and after: both hosted zones, every cluster and task, every group of schedules, every document
with its ETag and time, every message. `Place` writes directly into moto where its API would take minutes.
"""

from __future__ import annotations

import itertools
import json
import math
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any, Self
from unittest import mock

import msgspec
import pytest
from moto.core.responses import ActionResult
from moto.ecs.models import EC2ContainerServiceBackend, ecs_backends
from moto.ecs.responses import EC2ContainerServiceResponse
from moto.route53.models import Route53Backend, route53_backends
from moto.s3.models import s3_backends
from moto.scheduler.models import EventBridgeSchedulerBackend, scheduler_backends
from moto.sqs.models import sqs_backends

from hippodrome.control.aws import AwsPlatform
from hippodrome.control.model import ids, server
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import Address
from hippodrome.functions import installed, sweep
from testing.aws_events import ACCOUNT
from testing.botocore_sessions import botocore_session
from testing.exploration import TIMES, sample
from testing.moto_world import MotoWorld, _InvalidBatch
from testing.quiet_log import quiet
from testing.studies import study

DOMAIN = "servers.example.org"
STUDY = study(task_definition="hippodrome")
THINGS = ("tasks", "names", "timers", "clusters")


class Place(MotoWorld):
    """An account with our installation and others' resources, and what moto keeps from a sweep of this size."""

    def __init__(self, enforce: bool = False) -> None:
        super().__init__(enforce=enforce)
        self.unlisted: set[str] = set()  # tasks
        self.leftovers: dict[str, list[str]] = {thing: [] for thing in THINGS}  # what a sweep must remove
        self.asked: list[str] = []  # participants for whose servers the start message is sent again
        self.meanwhile: Callable[[str], None] = lambda operation: None  # what happens after each listing
        # One call at a time: a sweep makes several at once, and moto's dictionaries must not change while they are listed.
        self._one = threading.RLock()
        self._numbers = iter(range(10**9))

    def __enter__(self) -> Self:
        super().__enter__()
        session = botocore_session()
        session.register("before-call", self._begin_call)
        session.register("after-call", self._end_call)
        session.register("after-call-error", lambda **_: self._one.release())
        self.platform = AwsPlatform(self.env, session)
        installed.use(self.platform)
        self.put("project_master_list.json", json.dumps({"projects": [msgspec.to_builtins(STUDY)]}).encode())
        return self

    def __exit__(self, *error: object) -> None:
        installed.use(None)
        super().__exit__(*error)

    def _begin_call(self, **_: Any) -> None:
        self._one.acquire()

    def _end_call(self, model: Any, **_: Any) -> None:
        try:
            if model.name.startswith("List"):
                self.meanwhile(model.name)
        finally:
            self._one.release()

    def _build(self) -> None:
        super()._build()
        zone = self.client("route53").create_hosted_zone(Name="example.com.", CallerReference="another")
        self.ids["other_zone"] = zone["HostedZone"]["Id"].removeprefix("/hostedzone/")
        self.client("scheduler").create_schedule_group(Name="payroll")

    def _bridge(self) -> None:
        super()._bridge()
        place = self

        # Gap: moto lists all tasks and clusters at once, takes "hippodrome-staging" for "hippodrome", and describes as
        # many as one likes. ECS gives 100 a page, of one cluster, and describes 100 at most.
        list_tasks = EC2ContainerServiceBackend.list_tasks

        def of_the_cluster(backend: Any, cluster: str, *more: Any) -> Any:
            # Gap: moto's lists are never behind. On ECS a task that was run a moment ago may not be listed yet.
            found = list_tasks(backend, cluster, *more)
            return [t for t in found if t.cluster_arn.endswith(f"/{cluster}") and t.task_arn not in place.unlisted]

        def at_most_100(backend: Any, cluster: str, tasks: list[str]) -> Any:
            assert len(tasks) <= 100
            known = backend.tasks[cluster]
            return [known[arn] for arn in tasks]  # moto compares each with each

        def tasks_page(response: Any) -> Any:
            found = response.ecs_backend.list_tasks(
                response._get_param("cluster"), None, None, response._get_param("startedBy")
            )
            return _page(response, "taskArns", [task.task_arn for task in found])

        def clusters_page(response: Any) -> Any:
            return _page(response, "clusterArns", response.ecs_backend.list_clusters())

        self._patch(EC2ContainerServiceBackend, "list_tasks", of_the_cluster)
        self._patch(EC2ContainerServiceBackend, "describe_tasks", at_most_100)
        self._patch(EC2ContainerServiceResponse, "list_tasks", tasks_page)
        self._patch(EC2ContainerServiceResponse, "list_clusters", clusters_page)

        # Gap: in moto a task told to stop has stopped; on ECS that takes a while.
        stop = EC2ContainerServiceBackend.stop_task

        def stop_slowly(backend: Any, cluster: str, task: str, reason: str) -> Any:
            told = stop(backend, cluster, task, reason)
            told.last_status = "RUNNING"
            return told

        self._patch(EC2ContainerServiceBackend, "stop_task", stop_slowly)

        # Gap: moto gives 50 schedules a page; EventBridge Scheduler 100.
        self._stack.enter_context(
            mock.patch.dict(EventBridgeSchedulerBackend.PAGINATION_MODEL["list_schedules"], limit_default=100)
        )

        # Gap: moto deletes every record of that name and type, whatever its set identifier or alias; Route 53 only the
        # very one that is described, else it refuses the batch.
        change = Route53Backend.change_resource_record_sets

        def exactly(backend: Any, zone_id: str, changes: list[dict[str, Any]]) -> Any:
            if any(one["Action"] != "DELETE" for one in changes):
                return change(backend, zone_id, changes)
            zone = backend.get_hosted_zone(zone_id)
            there = {_described(record): record for record in zone.rrsets}
            wanted = [_asked(one["ResourceRecordSet"]) for one in changes]
            if missing := [name for name, *rest in wanted if (name, *rest) not in there]:
                raise _InvalidBatch(
                    [
                        f"Tried to delete resource record set [name='{n}', type='A'] but it was not found"
                        for n in missing
                    ]
                )
            gone = {id(there[one]) for one in wanted}
            zone.rrsets = [record for record in zone.rrsets if id(record) not in gone]
            return None

        self._patch(Route53Backend, "change_resource_record_sets", exactly)

    # Making resources

    @property
    def number(self) -> int:
        return next(self._numbers)

    def record(
        self, name: str, kind: str = "A", values: tuple[str, ...] = ("198.51.100.7",), zone: str = "zone", **more: Any
    ) -> None:
        """A record as Route 53 keeps it: in lower case, with escapes and a final dot.

        Gap: moto keeps names as they are written.
        """
        told = {"Name": f"{name}.", "Type": kind, "ResourceRecords": list(values), "TTL": 60, **more}
        route53_backends[ACCOUNT]["aws"].get_hosted_zone(self.ids[zone]).add_rrset(told)

    def run(self, started_by: str | None, cluster: str = "hippodrome") -> str:
        backend = ecs_backends[ACCOUNT][self.region]
        network = {"subnets": self.env["SUBNET"].split(","), "securityGroups": [self.env["SECURITY_GROUP"]]}
        (made,) = backend.run_task(
            cluster, "hippodrome", 1, None, started_by or "", [], "FARGATE", {"awsvpcConfiguration": network}
        )
        return str(made.task_arn)

    def timer(self, name: str, group: str = "hippodrome") -> None:
        scheduler_backends[ACCOUNT][self.region].create_schedule(
            name=name, group_name=group, schedule_expression="at(2100-01-01T00:00:00)", state="ENABLED", kms_key_arn="",
            description="", end_date=None, flexible_time_window={"Mode": "OFF"}, schedule_expression_timezone="UTC",
            start_date=None, action_after_completion="DELETE",
            target={"Arn": self.env["STOP_SERVER_TOPIC_ARN"], "RoleArn": self.env["SCHEDULE_ROLE_ARN"], "Input": "{}"},
        )  # fmt: skip

    def cluster(self, name: str) -> None:
        ecs_backends[ACCOUNT][self.region].create_cluster(name, [])

    def put(self, key: str, body: bytes) -> None:
        self.client("s3").put_object(Bucket=self.env["BUCKET"], Key=key, Body=body)

    def host(self) -> str:
        number = self.number
        return f"203.0.{number // 250 % 250}.{number % 250 + 1}"

    # Ours

    def claimed(self, attempt: int = 1, ago: timedelta = timedelta(minutes=1), own_cluster: bool = False) -> Server:
        """Return a new record of one of our servers."""
        project = msgspec.structs.replace(STUDY, cluster="participant" if own_cluster else "shared")
        now = datetime.now(UTC) - ago
        user = f"R_{self.number}"
        return server.new_attempt(project, user, attempt, nonce="t" * 32, settings=self.platform.settings, now=now)

    def save(self, record: Server) -> None:
        self.put(server.key(record.label), to_json(record))

    def things(self, record: Server, name: str | None = None, *, leftover: bool = False, delay: bool = False) -> str:
        """Make all resources of a server: its task, name, timers and cluster; `leftover` if a sweep must remove them."""
        name = name or record.name
        if record.has_own_cluster:
            self.cluster(name)
        task = self.run(name, "hippodrome" if leftover else record.cluster)
        self.record(f"{name}.{DOMAIN}", values=(record.host or self.host(),))
        timers = [name, f"{name}-delay"] if delay else [name]
        for timer in timers:
            self.timer(timer)
        if leftover:
            self.leftovers["tasks"].append(task)
            self.leftovers["names"].append(f"{name}.{DOMAIN}.")
            self.leftovers["timers"] += timers
            self.leftovers["clusters"] += [name] if record.has_own_cluster else []
        return task

    def starting(self) -> None:
        record = self.claimed()
        self.save(record)
        self.timer(record.name)

    def starting_unlisted(self) -> None:
        record = self.claimed()
        self.save(record)
        self.timer(record.name)
        self.unlisted.add(self.run(record.name))

    def long_starting_unlisted(self) -> None:
        """A server without a task, just before it counts as lost: its start message is sent again."""
        record = self.claimed(ago=timedelta(minutes=9))
        self.asked.append(record.user_id)
        self.save(record)
        self.timer(record.name)
        self.unlisted.add(self.run(record.name))

    def naming(self) -> None:
        record = server.naming(self.claimed(), "task", Address(self.host(), 5000), datetime.now(UTC))
        self.save(record)
        self.things(record)

    def ready(self) -> None:
        self.things(self._ready())

    def ready_with_delay(self) -> None:
        self.things(self._ready(ago=timedelta(minutes=20)), delay=True)

    def ready_in_its_cluster(self) -> None:
        self.things(self._ready(own_cluster=True))

    def ready_after_leftovers(self) -> None:
        """A second attempt that is ready, with all leftovers of the first."""
        record = self._ready(attempt=2)
        self.things(record)
        self.things(record, ids.server_name(record.label, 1), leftover=True, delay=True)

    def closed(self) -> None:
        self._closed()

    def closed_with_leftovers(self) -> None:
        self.things(self._closed(), leftover=True, delay=True)

    def closed_with_its_cluster(self) -> None:
        self.things(self._closed(own_cluster=True), leftover=True)

    def _ready(self, **more: Any) -> Server:
        now = datetime.now(UTC)
        record = server.ready(server.naming(self.claimed(**more), "task", Address(self.host(), 5000), now), now)
        self.save(record)
        return record

    def _closed(self, **more: Any) -> Server:
        record = server.close(self.claimed(**more), Reason.STOPPED, datetime.now(UTC))
        self.save(record)
        return record

    # Resources of others

    def similar_name(self) -> str:
        """Return a name like that of a server, without a record in our bucket: it is another installation's."""
        return ids.server_name(ids.server_label("somebody-elses", f"P{self.number}"), 1)

    def their_site(self) -> None:
        self.record(f"host-{self.number}.{DOMAIN}")

    def their_server(self) -> None:
        """All resources of a server of another installation in the same zone, cluster and group."""
        name = self.similar_name()
        self.record(f"{name}.{DOMAIN}")
        self.timer(name)
        self.timer(f"{name}-delay")
        self.run(name)

    def their_cluster(self) -> None:
        name = self.similar_name()
        self.cluster(name)
        self.run(name, name)

    def their_names(self) -> None:
        """Resources of our kinds under other names, and of other kinds under names like ours."""
        name, label, host = self.similar_name(), self.similar_name().partition("-")[0], self.host()
        alias = {"HostedZoneId": "Z1", "DNSName": "lb.example.com.", "EvaluateTargetHealth": False}
        self.record(f"{name}.{DOMAIN}", "AAAA", ("2001:db8::1",))
        self.record(f"{name}.{DOMAIN}", "TXT", ('"v=spf1 -all"',), TTL=300)
        self.record(f"{label}-2.{DOMAIN}", "CNAME", ("www.example.org",))
        self.record(f"{label}-3.{DOMAIN}", "A", (), TTL=None, AliasTarget=alias)
        for weight in (1, 2):
            self.record(f"{label}-4.{DOMAIN}", values=(host,), SetIdentifier=f"w{weight}", Weight=weight)
        self.record(f"{label}-5.{DOMAIN}", values=("203.0.113.1", "203.0.113.2"))
        for more in ("0", "01", "1000", "1x", ""):
            self.record(f"{label}-{more}.{DOMAIN}")
        self.record(f"{name}.deeper-{self.number}.{DOMAIN}")
        self.record(f"caf\\303\\251-{self.number}.{DOMAIN}")
        self.record(f"\\052.team-{self.number}.{DOMAIN}")

    def under_our_names(self) -> None:
        """Resources of others under the names of closed servers of ours."""
        name = self._closed().name
        alias = {"HostedZoneId": "Z1", "DNSName": "lb.example.com.", "EvaluateTargetHealth": False}
        self.record(f"{name}.{DOMAIN}", "AAAA", ("2001:db8::1",))
        self.record(f"{name}.{DOMAIN}", "TXT", ('"theirs"',))
        self.record(f"_acme-challenge.{name}.{DOMAIN}", "TXT", ('"theirs"',))
        self.record(f"{name}.sub.{DOMAIN}")
        self.record(f"{name}.example.com", zone="other_zone")
        for place, more in (
            (self._closed().name, {"SetIdentifier": "blue", "Weight": 1}),
            (self._closed().name, {"TTL": 300}),
        ):
            self.record(f"{place}.{DOMAIN}", **more)
        self.record(f"{self._closed().name}.{DOMAIN}", values=(), TTL=None, AliasTarget=alias)
        self.record(f"{self._closed().name}.{DOMAIN}", values=("203.0.113.1", "203.0.113.2"))
        for timer in (f"{name}-backup", f"{name}-delay-delay", f"x{name}", f"{name}0000", name.upper()):
            self.timer(timer)
        self.timer(name, "payroll")
        self.run(name, self._production)
        self.run(name, "hippodrome-staging")
        for started_by in (f"x{name}", f"{name}-delay", name.upper(), f"ecs-svc/{name}"):
            self.run(started_by)

    @property
    def _production(self) -> str:
        for name in ("production", "hippodrome-staging"):
            if name not in ecs_backends[ACCOUNT][self.region].clusters:
                self.cluster(name)
        return "production"

    def their_tasks(self) -> None:
        for started_by in (None, "ecs-svc/4711", "a-cron-job"):
            self.run(started_by)

    def their_timers(self) -> None:
        self.timer(f"nightly-{self.number}")
        self.timer(f"nightly-{self.number}", "payroll")

    def unreadable_record(self) -> None:
        """An unreadable document in the place of a server's record, and all resources that this server may have."""
        name = self.similar_name()
        label = name.partition("-")[0]
        what = (b"", b"\x00\xff not json", b"[]", b'{"state": "closed"}', b'{"userId": 7, "state": "closed"}')
        self.put(server.key(label), what[self.number % len(what)])
        self.record(f"{name}.{DOMAIN}")
        self.timer(name)
        self.run(name)

    def stray_documents(self) -> None:
        number = self.number
        self.put(f"_servers/README-{number}.txt", b"what is this?")
        self.put(f"_servers/{self.similar_name().partition('-')[0]}.json", b'{"of": "nobody who runs"}')

    # Comparison

    def photograph(self) -> dict[str, dict[str, str]]:
        """Everything that exists, by kind and name, as text. No name comes twice within a kind."""
        ecs, schedules = ecs_backends[ACCOUNT][self.region], scheduler_backends[ACCOUNT][self.region]
        zones = route53_backends[ACCOUNT]["aws"]
        records = [(key, r) for key in ("zone", "other_zone") for r in zones.get_hosted_zone(self.ids[key]).rrsets]
        tasks = [task for known in ecs.tasks.values() for task in known.values()]
        timers = [timer for group in schedules.schedule_groups.values() for timer in group.schedules.values()]
        keys = s3_backends[ACCOUNT]["aws"].buckets[self.env["BUCKET"]].keys
        queues = sqs_backends[ACCOUNT][self.region].queues.values()
        found = {
            "names": [
                (f"{key} {r.name} {r.type} {r.set_identifier}", repr(sorted(vars(r).items()))) for key, r in records
            ],
            "tasks": [
                (t.task_arn, repr((t.last_status, t.desired_status, t.stopped_reason, t.started_by, t.cluster_arn)))
                for t in tasks
            ],
            "clusters": [(c.name, repr((c.status, c.arn))) for c in ecs.clusters.values()],
            "timers": [(timer.arn, json.dumps(timer.to_dict(), default=str)) for timer in timers],
            "documents": [(key, repr((one.value, one.etag, one.last_modified))) for key, one in keys.items()],
            "messages": [(m.id, m.body) for queue in queues for m in queue._messages],
        }
        for kind, things in found.items():
            assert len(dict(things)) == len(things), kind
        return {kind: dict(things) for kind, things in found.items()}

    def sweep(self) -> dict[str, int]:
        return sweep.handler({}, None)

    def assert_only_our_leftovers_went(self, before: dict[str, dict[str, str]]) -> None:
        """Check that exactly those resources have changed since the photograph that a sweep must remove."""
        after = self.photograph()
        left = self.leftovers
        gone = {kind: before[kind].keys() - after[kind].keys() for kind in before}
        both = {kind: before[kind].keys() & after[kind].keys() for kind in before}
        changed = {kind: {key for key in both[kind] if before[kind][key] != after[kind][key]} for kind in before}
        nothing: dict[str, set[str]] = {kind: set() for kind in before}
        group = f"arn:aws:scheduler:{self.region}:{ACCOUNT}:schedule/hippodrome/"
        names = {f"zone {name} A None" for name in left["names"]}
        assert gone == {**nothing, "names": names, "timers": {group + name for name in left["timers"]}}
        assert changed == {**nothing, "tasks": set(left["tasks"]), "clusters": set(left["clusters"])}
        sent = {key: text for key, text in after["messages"].items() if key not in before["messages"]}
        assert sorted(json.loads(text)["userId"] for text in sent.values()) == sorted(self.asked)
        new = {kind: after[kind].keys() - before[kind].keys() for kind in before}
        assert new == {**nothing, "messages": set(sent)}
        assert all("hippodrome: left over" in after["tasks"][task] for task in left["tasks"])


OURS: tuple[Callable[[Place], None], ...] = (
    Place.starting, Place.starting_unlisted, Place.long_starting_unlisted, Place.naming, Place.ready,
    Place.ready_with_delay, Place.ready_in_its_cluster, Place.ready_after_leftovers, Place.closed,
    Place.closed_with_leftovers, Place.closed_with_its_cluster,
)  # fmt: skip
THEIRS: tuple[Callable[[Place], None], ...] = (
    Place.their_site, Place.their_server, Place.their_cluster, Place.their_names, Place.under_our_names,
    Place.their_tasks, Place.their_timers, Place.unreadable_record, Place.stray_documents,
)  # fmt: skip


def _page(response: Any, what: str, found: list[str]) -> Any:
    start = int(response._get_param("nextToken") or 0)
    more = {"nextToken": str(start + 100)} if len(found) > start + 100 else {}
    return ActionResult({what: found[start : start + 100], **more})


def _described(record: Any) -> tuple[str, Any, Any, str, tuple[str, ...]]:
    unlike = record.set_identifier or record.alias_target
    return record.name.rstrip(".").lower(), record.type, record.ttl, repr(unlike), tuple(map(str, record.records or ()))


def _asked(record: dict[str, Any]) -> tuple[str, Any, Any, str, tuple[str, ...]]:
    values = tuple(one["Value"] if isinstance(one, dict) else one for one in record.get("ResourceRecords", ()))
    unlike = record.get("SetIdentifier") or record.get("AliasTarget")
    return record["Name"].rstrip(".").lower(), record["Type"], int(record["TTL"]), repr(unlike), values


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    with quiet():
        yield


@pytest.fixture
def place() -> Iterator[Place]:
    with Place() as place:
        yield place


def stock(place: Place, *what: Callable[[Place], None]) -> None:
    for one in what:
        one(place)


def test_the_sweep_removes_our_leftovers_and_changes_nothing_else(place: Place) -> None:
    stock(place, *OURS, *THEIRS)
    before = place.photograph()
    swept = place.sweep()
    place.assert_only_our_leftovers_went(before)
    assert all(place.leftovers.values())
    assert {thing: swept[thing] for thing in THINGS} == {thing: len(place.leftovers[thing]) for thing in THINGS}
    after = place.photograph()
    assert not sum(place.sweep()[thing] for thing in THINGS)
    assert {**place.photograph(), "messages": {}} == {**after, "messages": {}}


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(4 * max(1, TIMES)), 4))
def test_the_sweep_changes_nothing_else_for_any_resources_in_any_order(place: Place, seed: int) -> None:
    chance = random.Random(seed)
    stock(place, *chance.choices((*OURS, *THEIRS), k=60))
    before = place.photograph()
    place.sweep()
    place.assert_only_our_leftovers_went(before)


@pytest.mark.explores
@pytest.mark.parametrize("seed", sample(range(4 * max(1, TIMES)), 4))
def test_resources_that_are_made_during_a_sweep_stay(place: Place, seed: int) -> None:
    """After each listing, servers of ours start, and others create resources."""
    chance = random.Random(seed)
    living = [Place.starting, Place.starting_unlisted, Place.naming, Place.ready, Place.ready_in_its_cluster]
    new: list[set[str]] = []

    def meanwhile(operation: str) -> None:
        before = place.photograph()
        stock(place, *chance.choices((*living, *THEIRS), k=6))
        before_and_new = place.photograph()
        new.append({f"{kind} {key}" for kind in before for key in before_and_new[kind].keys() - before[kind].keys()})

    stock(place, *OURS, *THEIRS)
    before, place.meanwhile = place.photograph(), meanwhile
    place.sweep()
    assert len(new) > 5
    after = place.photograph()
    there = {f"{kind} {key}" for kind in after for key in after[kind]}
    assert set().union(*new) - there == set()
    old = {
        kind: {key: text for key, text in after[kind].items() if f"{kind} {key}" not in set().union(*new)}
        for kind in after
    }
    place.photograph = lambda: old  # type: ignore[method-assign]
    place.assert_only_our_leftovers_went(before)


def test_a_cluster_is_removed_when_its_task_has_left_it(place: Place) -> None:
    record = place._closed(own_cluster=True)
    place.cluster(record.name)
    task = place.run(record.name, record.name)
    first = place.sweep()
    assert (first["tasks"], first["clusters"], first["failed"]) == (1, 0, 1)
    place.task_event(task, "STOPPED")
    assert place.sweep()["clusters"] == 1
    assert list(place.platform.tasks.clusters()) == []


def test_resources_of_an_unreadable_record_stay(place: Place) -> None:
    """Resources whose record cannot be read stay until a later sweep."""
    stock(place, *[Place.unreadable_record] * 5, Place.closed_with_leftovers)
    before = place.photograph()
    assert place.sweep()["failed"] == 5
    place.assert_only_our_leftovers_went(before)


@pytest.mark.hunt
def test_the_number_of_calls_grows_only_by_pages_of_listings(place: Place) -> None:
    """Ten times as many resources of others only make listings longer. Each name like ours costs one read, of the record that may own it."""
    stock(place, *OURS, *THEIRS)
    place.sweep()  # the leftovers are removed
    few = calls(place)
    for _ in range(300):
        place.their_timers()
        place.their_tasks()
        place.stray_documents()
    for _ in range(3000):
        place.their_site()
    more = calls(place) - few
    assert more == {
        "route53:ListResourceRecordSets": 10,
        "ecs:ListTasks": 9,
        "ecs:DescribeTasks": 9,
        "scheduler:ListSchedules": 3,
    }
    for _ in range(50):
        place.record(f"{place.similar_name()}.{DOMAIN}")
    assert calls(place)["s3:GetObject"] - few["s3:GetObject"] == 50


def calls(place: Place) -> Counter[str]:
    with place.recording() as made:
        place.sweep()
    return Counter(call.action for call in made)


@pytest.mark.hunt
def test_the_sweep_works_with_five_hundred_servers_among_five_thousand_resources_of_others(place: Place) -> None:
    for one in itertools.islice(itertools.cycle(OURS), 500):
        one(place)
    ours = count(place)
    many = {
        Place.their_site: 3000, Place.their_server: 250, Place.their_names: 50, Place.under_our_names: 25,
        Place.their_cluster: 20, Place.their_tasks: 50, Place.their_timers: 100, Place.unreadable_record: 20,
        Place.stray_documents: 20,
    }  # fmt: skip
    for one, times in many.items():
        stock(place, *[one] * times)
    theirs = count(place) - ours
    assert theirs.total() > 5000
    before = place.photograph()
    began, processor = time.monotonic(), time.process_time()
    made = calls(place)
    took, processor = time.monotonic() - began, time.process_time() - processor
    place.assert_only_our_leftovers_went(before)
    left = {thing: len(found) for thing, found in place.leftovers.items()}
    listings = sum(number for action, number in made.items() if ":List" in action or ":Describe" in action)
    print(f"500 servers of ours: {dict(ours)}; strangers: {dict(theirs)}; leftovers: {left}")
    print(
        f"a sweep of {took:.1f} s ({processor:.1f} s of processor, moto's included); {made.total()} calls: {dict(made)}"
    )
    assert listings < (ours + theirs).total() / 20
    assert made["route53:ChangeResourceRecordSets"] == math.ceil(left["names"] / 400)
    assert made["ecs:StopTask"] == left["tasks"]
    assert made["scheduler:DeleteSchedule"] == left["timers"]


def count(place: Place) -> Counter[str]:
    return Counter({kind: len(things) for kind, things in place.photograph().items() if kind != "messages"})
