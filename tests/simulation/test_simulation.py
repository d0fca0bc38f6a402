"""The functions on a simulated AWS: after any fault at any time, no participant is stranded and nothing is left."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hippodrome.control.participants import scripts
from hippodrome.deployment.aws.concurrency import starts
from testing import template
from testing.port_faults import FaultAt, PortFault
from testing.simulation import faults
from testing.simulation.aws_bound import aws_alone
from testing.simulation.clock import GreenletClock
from testing.simulation.conditions import AUTHORITY, Conditions
from testing.simulation.people import POLLS, SimulatedParticipant, retry_delay
from testing.simulation.world import TIMEOUTS, WIRES, SimulatedWorld
from tests.simulation.explored import assert_faults_do_harm_without_repair, assert_no_fault_does_harm

SEED = 7


def crowd(seed, people, seconds, conditions=None, **account):
    world = SimulatedWorld(seed, conditions, **account)
    arrived = [SimulatedParticipant(world, number) for number in range(people)]
    for person in arrived:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, seconds))
    world.settle(2 * 3600)
    return world, [person.visit for person in arrived]


def test_the_same_seed_is_the_same_run():
    (one, visits), (other, again) = crowd(3, 20, 10), crowd(3, 20, 10)
    assert one.cloud.timeline == other.cloud.timeline
    assert visits == again
    assert crowd(4, 20, 10)[0].cloud.timeline != one.cloud.timeline


@pytest.mark.parametrize("journey", faults.JOURNEYS, ids=lambda journey: journey.name)
def test_a_journey_without_faults_ends_as_expected(journey):
    _, outcome = faults.run(journey, SEED)
    assert outcome.well, outcome
    everybody = (outcome.visit, *outcome.others)
    # Chance decides which of them get a slot.
    room = min(len(everybody), journey.limits.get("max_servers", len(everybody)))
    finished = sum(visit.finished is not None for visit in everybody)
    assert finished == (room if journey.finishes else 0), outcome


@pytest.mark.explores
@pytest.mark.timeout(600)
@pytest.mark.parametrize("journey", faults.JOURNEYS, ids=lambda journey: journey.name)
def test_a_fault_at_any_call_strands_no_participant_and_leaves_nothing(journey):
    assert_no_fault_does_harm(journey, SEED, tried=96)


def test_without_the_sweep_and_with_one_delivery_faults_leave_something_behind(monkeypatch):
    assert_faults_do_harm_without_repair(faults.JOURNEYS[0], SEED, monkeypatch)


def test_an_interrupted_server_is_replaced_twice_and_the_last_is_on_demand():
    journey = faults.SimulatedJourney(
        "Spot takes the server back from somebody who plays for long",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(120.0, 240.0)),
        person=lambda world: SimulatedParticipant(world, 0, play=600.0),
    )
    world, outcome = faults.run(journey, SEED)
    kinds = [task.request.spot for task in world.platform.tasks.tasks.values()]
    assert kinds == [True, True, False], outcome
    assert outcome.visit.interruptions == 2


def test_under_bad_conditions_all_participants_are_served_and_nothing_is_left():
    conditions = Conditions(repeated=0.5, late=0.5, interrupted=0.2, no_spot=lambda seconds: 60 < seconds < 90)
    world, visits = crowd(11, 120, 60, conditions)
    assert not any(world.left().values()), world.story()
    assert all(visit.finished is not None for visit in visits), world.story()


@pytest.mark.parametrize(
    "conditions",
    [
        Conditions(busy_zone=(5.0, 15.0)),
        Conditions(no_spot=lambda seconds: True),
        Conditions(interrupted=0.1, interrupted_after=(5.0, 120.0)),
    ],
    ids=["a zone busy for 5 to 15 s", "Spot sold out", "10 % interruptions"],
)
def test_under_worse_assumptions_all_participants_are_served_before_they_give_up(conditions):
    world, visits = crowd(11, 150, 10, conditions)
    assert not any(world.left().values()), world.story()
    assert all(visit.finished is not None for visit in visits), world.story()
    assert max(visit.ready - visit.asked for visit in visits) < 300


def test_servers_without_names_are_served_although_events_that_they_run_are_lost():
    """The certificate waits for the task to be seen, and the sweep sees it: by the next sweep after three minutes."""
    world, visits = crowd(11, 60, 60, Conditions(authority=AUTHORITY, lost=0.3))
    served_and_gone(world, visits)
    assert len(world.platform.tasks.tasks) == len(visits), "no server is started in vain"
    assert max(visit.ready - visit.asked for visit in visits) < 10 * 60


def waits(visits):
    return sorted(visit.ready - visit.asked for visit in visits)


def served_and_gone(world, visits):
    assert not any(world.left().values()), world.story()
    assert all(visit.finished is not None for visit in visits), world.story()
    assert not world.cloud.dropped, "no chain of messages is taken for a loop"


def test_names_are_known_soon_even_if_route_53_is_always_slow():
    conditions = Conditions(slow_zone=1.0)
    world, visits = crowd(7, 60, 20, conditions)
    served_and_gone(world, visits)
    alone = sorted(aws_alone([visit.asked for visit in visits], 7, conditions))
    assert waits(visits)[-1] < alone[-1] + 45


def test_an_address_that_is_seen_late_costs_seconds_and_no_visibility_timeout():
    conditions = Conditions(late_addresses=1.0, slow_zone=0.0)
    world, visits = crowd(7, 60, 20, conditions)
    served_and_gone(world, visits)
    alone = aws_alone([visit.asked for visit in visits], 7, conditions)
    assert (sum(waits(visits)) - sum(alone)) / len(visits) < 20 < WIRES["task_changed"].visibility


def test_servers_that_spot_took_back_without_a_stop_code_have_the_cause_spot():
    world, visits = crowd(7, 60, 20, Conditions(interrupted=0.5, interrupted_after=(5.0, 120.0), untold=1.0))
    served_and_gone(world, visits)
    assert any(task.interrupted for task in world.platform.tasks.tasks.values())
    assert world.blamed() == 0


def test_lost_events_strand_no_participant_and_leave_nothing():
    world, visits = crowd(7, 60, 20, Conditions(lost=0.15))
    served_and_gone(world, visits)


def test_pages_are_served_in_an_account_with_ten_executions_while_two_hundred_servers_start():
    """The mappings are set as by `deploy`. A page without a free execution at the first try gets one at the next."""
    small = {"start_server": WIRES["start_server"]._replace(concurrency=starts(10))}
    world, visits = crowd(7, 200, 60, concurrency=10, wires=WIRES | small)
    served_and_gone(world, visits)
    assert world.cloud.most_invocations == 10
    assert sum(visit.unanswered for visit in visits) < sum(visit.pages for visit in visits) / 100
    assert not any("no answer" in visit.reason for visit in visits)


def test_a_function_beyond_its_timeout_is_ended_and_its_message_comes_again():
    world = SimulatedWorld(SEED)
    person = SimulatedParticipant(world, 0)
    slow = world.platform.documents
    create, times = slow.create, []

    def slowly(key, body):
        if key.startswith("_servers/") and not times:
            times.append(world.clock.seconds)
            world.clock.sleep(1000)
        return create(key, body)

    slow.create = slowly
    world.clock.spawn(person.walk)
    world.run(3600)
    assert world.start_server.crashed == 1
    assert person.visit.finished is not None
    assert person.visit.ready - person.visit.asked > WIRES["start_server"].visibility


def test_each_attempt_has_one_task():
    """There is one task for each attempt, on Spot or on demand, however often messages are repeated."""
    world, visits = crowd(5, 60, 30, Conditions(repeated=0.9))
    assert len(world.platform.tasks.tasks) == len(visits)


def test_a_fault_occurs_at_the_chosen_call():
    _, outcome = faults.run(faults.JOURNEYS[0], SEED, FaultAt(5, PortFault.CRASH_AFTER))
    assert str(PortFault.CRASH_AFTER) in outcome.story


def test_an_answer_to_a_closed_study_is_refused_and_the_participant_sees_that():
    world = SimulatedWorld(SEED)
    person = SimulatedParticipant(world, 0, read=100.0)
    world.clock.spawn(person.walk)
    world.clock.after(20, world.close)
    world.run(600)
    assert "study may be over" in person.visit.reason
    assert person.answered == []
    assert person.visit.asked is None


def test_a_watched_run_is_the_same_run():
    """The calls are counted in one run, and the faults are injected in others."""
    journey = next(j for j in faults.JOURNEYS if j.limits.get("warm_servers"))
    (one, outcome), (other, again) = (faults.run(journey, SEED, watched=watched) for watched in (True, False))
    assert one.cloud.timeline == other.cloud.timeline
    assert outcome == again


def test_time_passes_only_when_all_processes_wait():
    clock, seen = GreenletClock(1), []

    def wait(name, seconds):
        seen.append((clock.seconds, name))
        clock.sleep(seconds)
        seen.append((clock.seconds, name))

    clock.spawn(lambda: wait("long", 5))
    clock.spawn(lambda: wait("short", 1), delay=1)
    clock.run(10)
    assert seen == [(0, "long"), (1, "short"), (2, "short"), (5, "long")]


def test_queues_feed_the_functions_as_the_template_says():
    named, queues = template.functions(), template.resources("AWS::SQS::Queue")
    mappings = {m["FunctionName"]["Ref"]: m for m in template.resources("AWS::Lambda::EventSourceMapping").values()}
    for name, wire in WIRES.items():
        mapping = mappings[named[name]]
        queue = queues[mapping["EventSourceArn"]["Fn::GetAtt"][0]]
        concurrency = int(template.ReferenceValues().resolve(mapping["ScalingConfig"]["MaximumConcurrency"]))
        window = "MaximumBatchingWindowInSeconds"
        assert wire == (mapping["BatchSize"], mapping.get(window, 0), concurrency, queue["VisibilityTimeout"])
        assert queue["RedrivePolicy"]["maxReceiveCount"] == SimulatedWorld.RECEIVES
    made = template.resources("AWS::Lambda::Function")
    assert {name: made[named[name]]["Timeout"] for name in TIMEOUTS} == TIMEOUTS


def test_the_simulated_waiting_page_asks_as_often_as_the_real_one():
    script = scripts.join(Path(__file__).parents[2] / "hippodrome" / "web" / "game" / "main.js")
    (found,) = re.findall(r"const POLLS = \{(.*?)\};", script)
    told = {name: float(value.replace("_", "")) for name, value in re.findall(r"(\w+): ([\d_.]+)", found)}
    assert told == {name: value if name == "growth" else 1000 * value for name, value in POLLS.items()}
    ((longest, first),) = re.findall(r"pause\(Math\.min\(([\d_]+), ([\d_]+) \* 2 \*\* tries\)\)", script)
    after = [min(float(longest), float(first) * 2**tries) for tries in range(5)]
    assert after == [1000 * retry_delay(tries) for tries in range(5)]
