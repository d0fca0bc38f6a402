"""The ports on moto: an error or a timeout at any call of any journey strands no participant and leaves nothing behind.

Each journey runs once to count its calls, then once for each of its fault points: a call number, a kind of fault, how far
it reaches (`testing/aws_faults.py` says which there are, and that they strike below botocore). Queues deliver again, timers fire
and the sweep comes, as `testing/clocked_moto.py` has it; afterwards everybody must have been served or told how things are,
what they answered must be there, and no task, name, timer, cluster, place, open record, message or dead letter be left.
Nor may a function wait longer for AWS than it is given time.

All points are some thousands: `make hunt` plays them. The rule that chooses among them (`plan`): every call number of
every journey, with the next of the kinds and reaches that there are for its operation; and at the last such call of all
journeys, each kind that has not had its turn with that operation. `make test` plays a sample of those.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import pytest

from hippodrome.log import logger
from hippodrome.model import ids
from testing import clocked_moto
from testing.aws_faults import Fault, Kind, Made, Reach, invisible, kinds, reaches
from testing.clocked_moto import GAME, PROJECT, Person, Town
from tests import hunting
from tests.hunting import sample

USER, OTHER = "R_alice", "R_bob"
EACH, ALL = 1, 99  # fault points at each call
Calls = dict[str, list[Made]]  # by journey


@dataclass(frozen=True)
class Journey:
    """One way through the study; `begin` starts it, and returns the participants who must reach the end."""

    name: str
    begin: Callable[[Town], list[Person]]
    changes: dict[str, Any] = field(default_factory=dict)  # of the project
    finishes: bool = True  # whether they come to the last page where nothing goes wrong
    spot: bool = True  # whether it has room
    check: Callable[[Town], list[str]] = lambda town: []  # what else is wrong in the end
    alarms: bool = False  # whether messages may come to the dead letters, and so to somebody's eyes


def from_the_link(town: Town) -> list[Person]:
    return [Person(town, USER)]


def at_the_game(town: Town) -> list[Person]:
    return [Person(town, USER, at_game=True)]


def two_at_once(town: Town) -> list[Person]:
    return [Person(town, user, at_game=True) for user in (USER, OTHER)]


def nobody_plays(town: Town) -> list[Person]:
    return [Person(town, USER, at_game=True, leaves=True)]


def ends_by_itself(town: Town) -> list[Person]:
    town.ran = lambda task: town.clock.after(40, lambda: town.end(task))
    return nobody_plays(town)


def spot_strikes(town: Town) -> list[Person]:
    """AWS takes the first task back while the participant plays."""
    first: list[str] = []

    def ran(task: str) -> None:
        if not first:
            first.append(task)
            town.clock.after(30, lambda: town.end(task, "SpotInterruption", 143))

    town.ran = ran
    return at_the_game(town)


def stop_overtakes_start(town: Town) -> list[Person]:
    """Told to stop before it was started; the participant then asks for another one."""
    town.hold["start"] = 20
    people = at_the_game(town)
    town.hold.clear()
    town.publish("stop", {"projectId": PROJECT, "userId": USER})
    return people


def stopped_while_it_starts(town: Town) -> list[Person]:
    town.clock.after(5, lambda: town.publish("stop", {"projectId": PROJECT, "userId": USER, "attempt": 1}))
    return at_the_game(town)


def no_event_tells(town: Town) -> list[Person]:
    """The task ends after a while, and the event is lost: the sweep sees it, ten minutes after the request."""
    first: list[str] = []

    def ran(task: str) -> None:
        if not first:
            first.append(task)
            town.clock.after(25, lambda: ended(task))

    def ended(task: str) -> None:
        town.ended.add(task)
        town.world.task_event(task, "STOPPED")

    town.ran = ran
    town.sweeps_from = town.clock.seconds + 600
    return [Person(town, USER, at_game=True, comes=1000)]


def no_timer_fires(town: Town) -> list[Person]:
    """Nobody plays, and the timer is gone."""
    town.clock.after(60, town._schedules.clear)
    town.sweeps_from = town.clock.seconds + 540
    return nobody_plays(town)


def by_the_relays(town: Town) -> list[Person]:
    """A program starts its server, stops it with a delay, and a second time at once."""
    person = nobody_plays(town)[0]

    def ask(relay: str, form: dict[str, str]) -> Iterator[float]:
        for _ in range(Person.TRIES):
            answer = town.ask(relay, "POST", {"projectId": PROJECT, "userId": USER}, form)
            if answer and answer["status"] == 202:
                return
            yield 20

    def program() -> Iterator[float]:
        ticket = ids.ticket(town.project["secret"], USER, GAME)
        yield from ask("send_start_server_message", {"hippodrome-step": GAME, "hippodrome-ticket": ticket})
        while not (record := town.record(USER)) or record["state"] != "ready":
            yield 10
        token = town.token(USER)
        yield from ask("send_stop_server_message", {"token": token, "delay": "60"})
        yield from ask("send_stop_server_message", {"token": token, "delay": "30"})

    town.go_on(program())
    return [person]


def leftovers(town: Town) -> list[Person]:
    """Everything of a server that is closed; the first sweep comes at once."""
    label = ids.server_label(PROJECT, USER)
    name, now = ids.server_name(label, 1), town.clock.now()
    closed = {
        "projectId": PROJECT, "userId": USER, "attempt": 1, "state": "closed", "token": "", "cluster": name,
        "requested": f"{now - timedelta(hours=2):%Y-%m-%dT%H:%M:%SZ}", "closed": f"{now - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}",
        "deadline": f"{now - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}", "reason": "stopped", "dns": f"{name}.example.org",
    }  # fmt: skip
    town.put(f"_servers/{label}.json", json.dumps(closed).encode())
    world = town.world
    ecs, network = (
        world.client("ecs"),
        {"subnets": world.env["SUBNET"].split(","), "securityGroups": [world.env["SECURITY_GROUP"]]},
    )
    ecs.create_cluster(clusterName=name)
    for cluster in ("hippodrome", name):
        task = ecs.run_task(
            cluster=cluster, taskDefinition="hippodrome", launchType="FARGATE", startedBy=name,
            networkConfiguration={"awsvpcConfiguration": network},
        )["tasks"][0]["taskArn"]  # fmt: skip
        town.begun[task] = 0.0
        town.running.add(task)
    for kind in ("", "-delay"):
        world.client("scheduler").create_schedule(
            GroupName="hippodrome", Name=name + kind, ScheduleExpression="at(2100-01-01T00:00:00)",
            FlexibleTimeWindow={"Mode": "OFF"},
            Target={"Arn": world.env["STOP_SERVER_TOPIC_ARN"], "RoleArn": world.env["SCHEDULE_ROLE_ARN"], "Input": "{}"},
        )  # fmt: skip
    change = {"Name": f"{name}.example.org", "Type": "A", "TTL": 60, "ResourceRecords": [{"Value": "203.0.113.9"}]}
    world.client("route53").change_resource_record_sets(
        HostedZoneId=world.ids["zone"], ChangeBatch={"Changes": [{"Action": "UPSERT", "ResourceRecordSet": change}]}
    )
    town.put(
        f"_places/{PROJECT}.json",
        json.dumps({"held": {label: {"attempt": 1, "seconds": 600}}}).encode(),
    )
    town.clock.after(1, town._sweep)
    return []


def registering(town: Town) -> list[Person]:
    """A new version of the study; the researcher registers again if that failed."""
    changed = {**town.registration, "name": "Another name"}

    def researcher() -> Iterator[float]:
        for _ in range(Person.TRIES):
            try:
                answer = town.invoke("update_project_master_list", {"project": changed})
            except Exception as error:  # noqa: BLE001 - what Lambda tells the caller
                answer = {"problems": [type(error).__name__]}
            if answer.get("registered") == PROJECT:
                return
            town.failures.append(f"registering: {answer['problems']}")
            yield 10

    town.go_on(researcher())
    return []


def registered(town: Town) -> list[str]:
    """It is there once, as it should be, and its links and tickets are good as before."""
    projects = town.stored("project_master_list.json")["projects"]
    found = [(project["id"], project["name"], project["salt"]) for project in projects]
    expected = [(PROJECT, "Another name", town.project["salt"])]
    return [] if found == expected else [f"registered: {[(project, name) for project, name, _ in found]}"]


def erasing(town: Town) -> list[Person]:
    """A participant is erased while their server runs; the administrator repeats it if it was interrupted."""
    Person(town, USER, at_game=True, leaves=True)
    town.kept.clear()
    town.put(f"{PROJECT}/users/{OTHER}/answers/1.json", b'{"answers": {"said": "stays"}}')
    town.kept[f"{PROJECT}/users/{OTHER}/answers/1.json"] = {"said": "stays"}

    def administrator() -> Iterator[float]:
        yield 200  # a start message that failed comes again after 90 seconds, and would begin what was erased anew
        for _ in range(Person.TRIES):
            try:
                left = town.erase(PROJECT, USER)
            except Exception as error:  # noqa: BLE001 - what the command line makes a sentence of
                town.failures.append(f"erasing failed: {type(error).__name__}")
                yield 20
            else:
                assert not left
                return

    town.go_on(administrator())
    return []


def erased(town: Town) -> list[str]:
    label = ids.server_label(PROJECT, USER)
    return [f"{key} is still there" for key in town.stored_keys() if USER in key or label in key]


JOURNEYS = (
    Journey("from the link to the last page", from_the_link),
    Journey("Spot takes the server back", spot_strikes),
    Journey("a cluster of its own, and no room on Spot", at_the_game, {"cluster": "participant"}, spot=False),
    Journey("a study with limits", from_the_link, {"maxParticipants": 3, "maxServers": 1, "maxServerHours": 5}),
    Journey("two at once within the limits", two_at_once, {"maxServers": 2}),
    Journey("nobody plays, and the timer fires", nobody_plays, {"maxRuntime": 2}, finishes=False),
    Journey("nobody plays, and no timer fires", no_timer_fires, {"maxRuntime": 4}, finishes=False),
    Journey("the trial ends by itself", ends_by_itself, finishes=False),
    Journey("the stop comes before the start", stop_overtakes_start),
    Journey("the stop comes while it starts", stopped_while_it_starts),
    Journey("no event tells of its end", no_event_tells, alarms=True),  # that it runs cannot be dealt with any more
    Journey("programs use the relays", by_the_relays, finishes=False),
    Journey("the sweep finds leftovers", leftovers, {"maxServers": 3}),
    Journey("a study is registered anew", registering, check=registered),
    Journey("somebody is erased", erasing, check=erased),
)


@dataclass
class Outcome:
    """What came of one run."""

    journey: str
    fault: Fault | None
    made: Made | None
    calls: list[Made]
    wrong: list[str]  # nothing where all is well
    failures: list[str]

    def __str__(self) -> str:
        return f"{self.journey}: {self.fault} ({self.made}): {'; '.join(self.wrong)}. On the way: {self.failures}"


def run(town: Town, journey: Journey, fault: Fault | None = None) -> Outcome:
    """One run of a journey."""
    town.begin(fault)
    town.injector.spot = journey.spot
    people = journey.begin(town)
    town.live()
    wrong = [f"{person.user} is stranded" for person in people if not person.served_or_told]
    if fault is None and journey.finishes:
        wrong += [f"{person.user} is told {person.told!r}" for person in people if not person.finished]
    fine = ["dead letters"] if journey.alarms else []
    wrong += [f"{count} {what} left" for what, count in town.left().items() if count and what not in fine]
    wrong += [f"lost {key}" for key in town.lost()] + town.too_long + journey.check(town)
    injector = town.injector
    made = injector.calls[fault.number - 1] if fault else None
    if fault and not injector.struck:
        wrong.append("nothing went wrong")
    if town.failures and (fault is None or made is None or invisible(fault, made)):
        wrong.append(f"it could be seen: {town.failures}")
    return Outcome(journey.name, fault, made, injector.calls, wrong, town.failures)


def plan(calls: Calls, each: int = EACH) -> dict[str, list[Fault]]:
    """The fault points of each journey, by the rule above."""
    combos = {c.action: every(c.action) for made in calls.values() for c in made}
    turn = {action: itertools.cycle(order(found)) for action, found in combos.items()}
    points: dict[str, list[Fault]] = {name: [] for name in calls}
    last: dict[str, tuple[str, int]] = {}
    for name, made in calls.items():
        for number, (_, action) in enumerate(made, 1):
            last[action] = (name, number)
            chosen = itertools.islice(turn[action], min(each, len(combos[action])))
            points[name] += [Fault(number, kind, reach) for kind, reach in chosen]
    done = {(calls[name][p.number - 1].action, p.kind) for name, found in points.items() for p in found}
    for action, found in combos.items():
        name, number = last[action]
        missing = {kind: reach for kind, reach in order(found)[::-1] if (action, kind) not in done}
        points[name] += [Fault(number, kind, reach) for kind, reach in missing.items()]
    return points


def every(action: str) -> list[tuple[Kind, Reach]]:
    """All that can go wrong with an operation."""
    return [(kind, reach) for kind in kinds(action) for reach in reaches(action, kind)]


def order(combos: list[tuple[Kind, Reach]]) -> list[tuple[Kind, Reach]]:
    """The worst first: calls that were made and whose reply is lost; then the errors of the port."""
    return sorted(combos, key=lambda combo: (combo[1] is Reach.ATTEMPT, combo[0] is not Kind.READ))


@pytest.fixture(scope="module", autouse=True)
def _quiet() -> Iterator[None]:
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(level)


@pytest.fixture(scope="module")
def town() -> Iterator[Town]:
    with Town() as town:
        yield town


@pytest.fixture(scope="module")
def calls(town: Town) -> Calls:
    found = {}
    for journey in JOURNEYS:
        town.hold_study(**journey.changes)
        outcome = run(town, journey)
        assert not outcome.wrong, outcome
        found[journey.name] = outcome.calls
    return found


@pytest.mark.explores
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("journey", JOURNEYS, ids=lambda journey: journey.name)
def test_a_fault_at_any_call_strands_nobody_and_leaves_nothing(journey: Journey, town: Town, calls: Calls) -> None:
    made = calls[journey.name]
    points = sample(plan(calls, ALL if hunting.TIMES > 1 else EACH)[journey.name], 24)
    town.hold_study(**journey.changes)
    outcomes = [run(town, journey, fault) for fault in points]
    bad = [outcome for outcome in outcomes if outcome.wrong]
    unseen = sum(not outcome.failures for outcome in outcomes)
    print(f"{journey.name}: {len(made)} calls, {len(outcomes)} fault points, {unseen} of them unseen, {len(bad)} bad")
    assert not bad, f"{len(bad)} of {len(outcomes)}:\n" + "\n".join(map(str, bad[:20]))


def test_the_points_cover_every_call_and_all_that_can_go_wrong(calls: Calls) -> None:
    points = plan(calls)
    for name, made in calls.items():
        assert {point.number for point in points[name]} == set(range(1, len(made) + 1))
    done = {(calls[name][p.number - 1].action, p.kind, p.reach) for name, found in points.items() for p in found}
    actions = {call.action for made in calls.values() for call in made}
    assert {(action, kind) for action, kind, _ in done} == {
        (action, kind) for action in actions for kind in kinds(action)
    }
    assert {(kind, reach) for _, kind, reach in done} == {combo for action in actions for combo in every(action)}
    print(f"{sum(map(len, points.values()))} fault points of {sum(map(len, plan(calls, ALL).values()))}: ")
    print(
        f"{len(actions)} operations in {len(done)} ways; {sum(map(len, calls.values()))} calls in {len(calls)} journeys"
    )


def test_without_the_sweep_and_with_one_delivery_faults_would_leave_things_behind(
    town: Town, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exploration sees what it should: the same faults, without what repairs them."""

    def unswept(town: Town) -> list[Person]:
        town.sweeps_from = math.inf
        return from_the_link(town)

    monkeypatch.setattr(clocked_moto, "RECEIVES", 1)
    monkeypatch.setattr(clocked_moto, "HORIZON", 1800.0)
    town.hold_study()
    stops = [n for n, call in enumerate(calls[JOURNEYS[0].name], 1) if call.function == "stop_server"]
    assert all(run(town, Journey("unswept", unswept), Fault(n, Kind.CONNECT, Reach.CALL)).wrong for n in stops)
