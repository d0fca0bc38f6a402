"""The simulated AWS behaves as AWS's documents and public reports say: one test for each fact."""

from __future__ import annotations

import dataclasses
import json
from datetime import timedelta

import pytest

from hippodrome.control.aws.dns import BATCH as BATCH_OF_NAMES
from hippodrome.control.ports import Conflict, DnsRecord, TaskRequest
from hippodrome.functions import installed
from testing.clock import EPOCH
from testing.simulation.assumptions import assumptions
from testing.simulation.aws_bound import aws_alone, aws_alone_together
from testing.simulation.clock import GreenletClock
from testing.simulation.cloud import QUOTAS, Cloud, Throttled, TokenBucket
from testing.simulation.conditions import SLOW_FOR, Conditions, propagation
from testing.simulation.functions import HOPS, Lineage, SimulatedFunction, SimulatedQueue, Wire, ends, enter, lineage
from testing.simulation.people import SimulatedParticipant
from testing.simulation.ports import PAGE
from testing.simulation.world import LOOPS, SimulatedWorld
from testing.tasks import Life

VISIBILITY, RECEIVES = 90.0, 8
ONE = Wire(batch=1, window=0, concurrency=2, visibility=VISIBILITY)
BATCH = Wire(batch=100, window=1, concurrency=2, visibility=VISIBILITY)


@pytest.fixture(autouse=True)
def _platform():
    before = installed._platform, installed._made
    yield
    installed._platform, installed._made = before


class Small:
    """One function behind one queue, in an account that has room for `concurrency` invocations."""

    def __init__(self, act, wire=ONE, concurrency=1000, *, loops=False):
        self.clock = GreenletClock(1)
        self.clock.resumed, self.clock.ends = enter, ends
        self.cloud = Cloud(self.clock, concurrency)
        self.seen: list[tuple[float, list[object]]] = []

        def handler(event, context):
            bodies = [json.loads(record["body"]) for record in event["Records"]]
            self.seen.append((self.clock.seconds, bodies))
            return act(self, bodies)

        self.function = SimulatedFunction("one", handler, self.cloud, None, 60, loops=loops)
        self.queue = SimulatedQueue(self.function, self.clock, self.cloud, wire, RECEIVES)

    def again(self, message, seconds=1.0):
        self.queue.send(message, seconds, lineage())


# Loops


def sends_itself(small, bodies):
    small.again(bodies[0])


def test_lambda_drops_the_seventeenth_invocation_of_a_chain_and_its_message_becomes_a_dead_letter():
    small = Small(sends_itself)
    small.queue.send({})
    small.clock.run(30)
    assert len(small.seen) == HOPS == 16
    assert small.cloud.dropped == {"one": 1}
    small.clock.run(VISIBILITY * (RECEIVES + 1))
    assert len(small.queue.dead) == 1
    assert small.cloud.dropped == {"one": RECEIVES}, "each receive of it is refused"


def test_a_function_that_may_loop_is_not_dropped():
    small = Small(sends_itself, loops=True)
    small.queue.send({})
    small.clock.run(60)
    assert len(small.seen) > 2 * HOPS
    assert not small.cloud.dropped


def test_a_batch_has_the_highest_count_of_its_messages_and_passes_it_on():
    small = Small(lambda small, bodies: small.again("old") if "old" in bodies else None, BATCH)
    small.queue.send("old")
    for second in range(2, 40, 2):
        small.clock.after(second, lambda: small.queue.send("new"))
    small.clock.run(80)
    assert small.cloud.dropped["one"] >= 1
    assert small.queue.waiting > 1, "messages of other chains are refused with it"


def test_messages_that_no_function_sends_begin_a_chain():
    seen: list[Lineage] = []
    small = Small(lambda small, bodies: seen.append(lineage()))
    small.queue.send({}, lineage={"other": 3})
    small.queue.send({})
    small.clock.run(5)
    assert sorted(map(len, seen)) == [1, 2]
    assert lineage() == {}


def test_an_event_of_ecs_begins_a_chain_even_if_a_function_has_caused_it():
    world = SimulatedWorld(1)
    sent = []
    world.platform.tasks.changed = lambda *sending: sent.append(sending)
    request = TaskRequest("s1", "family", "cluster", 1, 2, {"DEADLINE": str(EPOCH.timestamp() + 3600)})
    world.clock.spawn(lambda: world.platform.tasks.stop(world.platform.tasks.run(request), "cluster", "enough"), 1)
    world.run(60)
    assert sent
    assert all(len(sending) == 2 for sending in sent), "the event and its delay, no lineage"


def test_the_template_allows_a_loop_only_to_task_changed():
    assert {"task_changed"} == LOOPS


# Concurrency


def sleeps(small, bodies):
    small.clock.sleep(10)


def test_a_throttled_batch_costs_a_receive_of_each_message_and_its_visibility_timeout():
    small = Small(sleeps, ONE, concurrency=1)
    small.queue.send("first")
    small.queue.send("second", 1.0)
    small.clock.run(VISIBILITY)
    assert [bodies for _, bodies in small.seen] == [["first"]]
    assert small.cloud.throttled["lambda:Invoke"] == 1
    small.clock.run(VISIBILITY + 30)
    assert [bodies for _, bodies in small.seen] == [["first"], ["second"]]
    assert small.seen[1][0] > VISIBILITY


def test_messages_that_are_throttled_at_every_receive_are_dead_letters():
    small = Small(sleeps, concurrency=0)
    small.queue.send("never")
    small.clock.run(VISIBILITY * (RECEIVES + 1))
    assert [held.body for held in small.queue.dead] == ['"never"']


def test_a_mapping_receives_only_messages_that_it_can_pass_on():
    small = Small(sleeps, ONE, concurrency=2)
    for _ in range(20):
        small.queue.send({})
    small.clock.run(300)
    assert len(small.seen) == 20
    assert small.cloud.throttled["lambda:Invoke"] == 0


def test_an_invocation_by_a_timer_waits_for_free_executions():
    small = Small(lambda small, bodies: None, concurrency=0)
    small.clock.spawn(lambda: small.function.later({"Records": []}))
    small.clock.run(20)
    assert not small.seen
    small.cloud.concurrency = 1
    small.clock.run(60)
    assert len(small.seen) == 1


def test_the_gateway_answers_a_page_request_without_a_free_execution():
    world = SimulatedWorld(1, concurrency=0)
    answers = []
    world.clock.spawn(lambda: answers.append(world.ask("GET", "projectId=study&userId=a")))
    world.run(10)
    assert answers == [(503, None)]


# ECS, EC2 and Route 53


def told(conditions, seconds=300.0):
    """Return the events of one task on Spot, in the order in which they come."""
    world = SimulatedWorld(2, conditions)
    found = []
    world.platform.tasks.changed = lambda event, delay: found.append(event["detail"])
    deadline = str(EPOCH.timestamp() + 3600)
    request = TaskRequest("s1", "family", "cluster", 1, 2, {"DEADLINE": deadline}, spot=True)
    world.clock.spawn(lambda: world.platform.tasks.run(request))
    world.run(seconds)
    return found


def test_events_of_an_interruption_may_lack_their_stop_code():
    conditions = {"interrupted": 1.0, "interrupted_after": (5.0, 10.0), "repeated": 0.0}
    for share, code in ((1.0, None), (0.0, "SpotInterruption")):
        events = told(Conditions(untold=share, **conditions))
        ending = [event for event in events if event["desiredStatus"] == "STOPPED"]
        assert [event["lastStatus"] for event in ending] == ["RUNNING", "DEPROVISIONING", "STOPPED"]
        assert {event.get("stopCode") for event in ending} == {code}
        assert {event["stoppedReason"] for event in ending} == {"Your Spot Task was interrupted."}


def test_events_may_be_lost():
    assert told(Conditions(lost=1.0)) == []
    assert told(Conditions()) != []


def test_ec2_may_show_an_address_later_than_its_task():
    world = SimulatedWorld(3, Conditions(late_addresses=1.0, address_late=(10.0, 10.0)))
    tasks, found = world.platform.tasks, []
    request = TaskRequest("s1", "family", "cluster", 1, 2, {"DEADLINE": str(EPOCH.timestamp() + 3600)})

    def look():
        (task,) = [tasks.tasks[tasks.run(request)]]
        while len(found) < 40:
            world.clock.sleep(1.0)
            if task.last is Life.RUNNING:
                found.append((world.clock.seconds - task.runs, bool(tasks.addresses([task.interface]))))

    world.clock.spawn(look)
    world.run(300)
    assert not any(there for after, there in found if after < 9)
    assert all(there for after, there in found if after > 10)


def test_route_53_is_slow_in_some_periods_for_all_changes():
    chance, slow = GreenletClock(1).random, 0
    for span in range(400):
        spreads = [propagation(chance, Conditions(slow_zone=0.1), 7, span * SLOW_FOR + second) for second in range(5)]
        assert all(20 <= spread <= 60 for spread in spreads) or all(60 <= spread <= 120 for spread in spreads)
        slow += min(spreads) >= 60
    assert slow == 40
    assert 20 <= propagation(chance, Conditions(slow_zone=0.0), 7, 0.0) <= 60


def test_changes_of_names_are_limited_and_an_upsert_counts_twice():
    names = SimulatedWorld(7, Conditions(busy_zone=(0.0, 0.0))).platform.dns
    batch = [DnsRecord(f"s{number}.example.org", "198.18.0.1") for number in range(BATCH_OF_NAMES)]
    names.changed(add=batch)  # 800 of the 1,500
    with pytest.raises(Throttled):
        names.changed(add=batch)
    names.changed(remove=batch)
    with pytest.raises(Throttled):
        names.changed(add=batch[:151])
    names.changed(add=batch[:150])


def test_the_limit_of_changes_refills_by_a_hundred_a_second():
    ration = TokenBucket(*QUOTAS["route53:changes"])
    assert ration.take(0.0, 1500)
    assert not ration.take(1.0, 101)
    assert ration.take(1.0, 100)
    assert ration.take(60.0, 1500)


def test_the_time_of_aws_alone_includes_a_slow_zone_and_late_addresses():
    asked = [second / 10 for second in range(600)]
    usual = aws_alone(asked, 7, Conditions(slow_zone=0.0, late_addresses=0.0))
    slow = aws_alone(asked, 7, Conditions(slow_zone=1.0, late_addresses=0.0))
    late = aws_alone(asked, 7, Conditions(slow_zone=0.0, late_addresses=1.0, address_late=(30.0, 30.0)))
    assert 40 < mean(slow) - mean(usual) < 60
    assert 25 < mean(late) - mean(usual) < 35


def test_the_time_of_groups_depends_on_their_servers_and_their_last_member():
    """There is one server for each two participants who are under way; a group is complete when its last member has come."""
    usual = Conditions(slow_zone=0.0, late_addresses=0.0)
    server = min(aws_alone([0.0, 0.0], 7, usual))
    waits = aws_alone_together([0.0] * 4, [1.0, 2.0, 3.0, 500.0], 2, 7, usual)
    assert waits == pytest.approx([server - 1.0, server - 2.0, 497.0, 0.0])
    assert aws_alone_together([0.0] * 3, [1.0, 2.0, 3.0], 2, 7, usual) == pytest.approx(waits[:2])


def mean(values):
    return sum(values) / len(values)


def test_a_change_takes_the_time_that_its_second_determines():
    world = SimulatedWorld(7, Conditions(slow_zone=1.0))
    made = []

    def change():
        made.append((world.clock.seconds, world.platform.dns.change(add=[DnsRecord("s1.example.org", "198.18.0.1")])))

    world.clock.spawn(change)
    world.run(10)
    (begun, number), *_ = made
    assert 60 <= world.platform.dns.in_sync_at(number) - begun <= 122


# S3


def of_s3(act):
    """Return what `act(world, documents)` returns, run as a function would."""
    world, found = SimulatedWorld(1), []
    world.clock.spawn(lambda: found.append(act(world, world.platform.documents)))
    world.run(60)
    return found[0]


def test_a_write_without_a_condition_replaces_the_document():
    def act(world, documents):
        documents.create("a", b"first")
        documents.put("a", b"second")
        documents.put("b", b"new")
        return [documents.get(key).body for key in "ab"], world.cloud.calls["s3:PutObject"]

    assert of_s3(act) == ([b"second", b"new"], 3)


def test_a_document_with_an_earlier_content_has_the_earlier_etag():
    """S3 API Reference, "Object": an ETag is an MD5 of the content. So compare-and-swap does not notice a change from A to B and back to A."""

    def act(world, documents):
        etag = documents.create("a", b"A")
        assert documents.replace("a", b"B", etag) != etag
        documents.put("a", b"A")
        return documents.replace("a", b"C", etag), documents.get("a").body

    assert of_s3(act)[1] == b"C"


def test_replace_with_an_old_etag_raises_conflict():
    def act(world, documents):
        etag = documents.create("a", b"first")
        documents.put("a", b"second")
        with pytest.raises(Conflict):
            documents.replace("a", b"second", etag)
        return world.cloud.conflicts["a"]

    assert of_s3(act) == 1


def test_a_listing_shows_all_earlier_writes_and_deletions():
    def act(world, documents):
        for name in ("in/b", "in/a", "in/c", "out/a"):
            documents.put(name, b"")
        documents.delete("in/b")
        documents.delete("in/b")
        return [entry.key for entry in documents.list("in/")]

    assert of_s3(act) == ["in/a", "in/c"]


def test_the_time_of_a_document_is_cut_to_whole_seconds():
    def act(world, documents):
        world.clock.sleep(7.9 - world.clock.seconds - 0.06)
        documents.put("a", b"")
        return next(documents.list("a")).modified, world.clock.seconds

    modified, seconds = of_s3(act)
    assert 7.8 < seconds < 8
    assert modified == EPOCH + timedelta(seconds=7)


def test_a_listing_makes_a_call_per_thousand_keys_and_shows_writes_between_its_pages():
    def act(world, documents):
        for number in range(PAGE):
            documents.keep(f"in/{number:04d}", b"")
        before = len(list(documents.list("in/"))), world.cloud.calls["s3:ListObjectsV2"]
        documents.keep("in/one-more", b"")
        found = documents.list("in/")
        first = next(found).key
        documents.keep("in/x-between", b"")
        return before, first, len(list(found)), world.cloud.calls["s3:ListObjectsV2"]

    assert of_s3(act) == ((1000, 1), "in/0000", 1001, 3)


# Printed assumptions


@pytest.mark.parametrize(
    "what", ["loops", "Route 53 is slow", "addresses seen late", "events lost", "batches that are throttled"]
)
def test_each_fact_is_among_the_assumptions(what):
    assert what in assumptions(Conditions())


WORSE = {
    "repeated": 0.5, "late": 0.5, "lost": 0.5, "no_spot": lambda seconds: True, "interrupted": 0.5,
    "interrupted_after": (1.0, 2.0), "untold": 0.1, "late_addresses": 0.5, "address_late": (1.0, 2.0), "stillborn": 0.5,
    "starts": (1.0, 2.0, 3.0), "propagation": (1.0, 2.0), "slow_zone": 0.5, "slow_propagation": (1.0, 2.0),
    "busy_zone": (1.0, 2.0), "s3": (1.0, 2.0), "idle": 1.0,
    "authority": (1.0, 2.0),
}  # fmt: skip


@pytest.mark.parametrize("what", [field.name for field in dataclasses.fields(Conditions)])
def test_each_condition_is_printed(what):
    """Some conditions of interruptions are printed only if there are interruptions."""
    usual = Conditions(interrupted=0.2)
    assert assumptions(dataclasses.replace(usual, **{what: WORSE[what]})) != assumptions(usual)


def test_a_world_settles_when_all_participants_have_gone_and_nothing_is_left():
    world = SimulatedWorld(5)
    world.clock.spawn(SimulatedParticipant(world, 0).walk)
    world.settle(7200)
    assert not any(world.left().values())
    assert world.clock.seconds < 1800
