"""The ports on moto: an error or a timeout at any call of any journey strands no participant and leaves nothing behind.

Each journey runs once to count its calls, then once for each of its fault points: a call number, a kind of fault, and its
reach (`testing/aws_faults.py` lists the kinds and reaches; the faults occur below botocore). Queues deliver again, timers fire
and the sweep runs, as `testing/clocked_moto.py` does it. Afterwards every participant must have been served, or told why not; their
answers must be stored; and no task, name, timer, cluster, slot, open record, message or dead letter may be left.
No function may wait longer for AWS than its timeout.

There are some thousands of fault points: `make hunt` plays all of them. `plan` chooses among them: each call number of
each journey gets the next kind and reach of its operation; the last call of an operation also gets each kind that
this operation has not had yet. `make test` plays a sample of the chosen points.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import pytest

from hippodrome.model import ids
from testing import clocked_moto, exploration
from testing.aws_faults import AwsFault, FaultKind, MadeCall, Reach, invisible, kinds, reaches
from testing.clocked_moto import GAME, PROJECT, TimedInstallation, VisitorOnMoto
from testing.exploration import sample
from testing.quiet_log import quiet

USER, OTHER = "R_alice", "R_bob"
EACH, ALL = 1, 99  # fault points at each call
SEED = 20  # the sample has every kind and every reach of a fault
Calls = dict[str, list[MadeCall]]  # by journey


@dataclass(frozen=True)
class Journey:
    """One way through the study; `begin` starts it, and returns the participants who must reach the end."""

    name: str
    begin: Callable[[TimedInstallation], list[VisitorOnMoto]]
    changes: dict[str, Any] = field(default_factory=dict)  # of the project
    finishes: bool = True  # whether the participants come to the last page in a run without a fault
    spot: bool = True  # whether Spot has capacity
    check: Callable[[TimedInstallation], list[str]] = lambda installation: []  # returns what else is wrong at the end
    alarms: bool = False  # whether messages may become dead letters, which raise an alarm


def from_the_link(installation: TimedInstallation) -> list[VisitorOnMoto]:
    return [VisitorOnMoto(installation, USER)]


def at_the_game(installation: TimedInstallation) -> list[VisitorOnMoto]:
    return [VisitorOnMoto(installation, USER, at_game=True)]


def two_at_once(installation: TimedInstallation) -> list[VisitorOnMoto]:
    return [VisitorOnMoto(installation, user, at_game=True) for user in (USER, OTHER)]


def nobody_plays(installation: TimedInstallation) -> list[VisitorOnMoto]:
    return [VisitorOnMoto(installation, USER, at_game=True, leaves=True)]


def ends_by_itself(installation: TimedInstallation) -> list[VisitorOnMoto]:
    installation.on_running = lambda task: installation.clock.after(40, lambda: installation.end(task))
    return nobody_plays(installation)


def spot_strikes(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """AWS takes the first task back while the participant plays."""
    first: list[str] = []

    def ran(task: str) -> None:
        if not first:
            first.append(task)
            installation.clock.after(30, lambda: installation.end(task, "SpotInterruption", 143))

    installation.on_running = ran
    return at_the_game(installation)


def stop_overtakes_start(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """The stop message comes before the start message; the participant then asks for another server."""
    installation.delays["start"] = 20
    people = at_the_game(installation)
    installation.delays.clear()
    installation.publish("stop", {"projectId": PROJECT, "userId": USER})
    return people


def stopped_while_it_starts(installation: TimedInstallation) -> list[VisitorOnMoto]:
    installation.clock.after(
        5, lambda: installation.publish("stop", {"projectId": PROJECT, "userId": USER, "attempt": 1})
    )
    return at_the_game(installation)


def no_event_tells(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """The task ends after 25 seconds and its event is lost: the sweep notices it ten minutes after the request."""
    first: list[str] = []

    def ran(task: str) -> None:
        if not first:
            first.append(task)
            installation.clock.after(25, lambda: ended(task))

    def ended(task: str) -> None:
        installation.ended.add(task)
        installation.world.task_event(task, "STOPPED")

    installation.on_running = ran
    installation.sweeps_from = installation.clock.seconds + 600
    return [VisitorOnMoto(installation, USER, at_game=True, comes=1000)]


def no_timer_fires(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """The participant leaves, and the timer is gone."""
    installation.clock.after(60, installation._schedules.clear)
    installation.sweeps_from = installation.clock.seconds + 540
    return nobody_plays(installation)


def by_the_relays(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """A program starts its server, stops it with a delay of 60 seconds, and at once again with one of 30 seconds."""
    person = nobody_plays(installation)[0]

    def ask(relay: str, form: dict[str, str]) -> Iterator[float]:
        for _ in range(VisitorOnMoto.TRIES):
            answer = installation.ask(relay, "POST", {"projectId": PROJECT, "userId": USER}, form)
            if answer and answer["status"] == 202:
                return
            yield 20

    def program() -> Iterator[float]:
        ticket = ids.ticket(installation.project["secret"], USER, GAME)
        yield from ask("send_start_server_message", {"hippodrome-step": GAME, "hippodrome-ticket": ticket})
        while not (record := installation.record(USER)) or record["state"] != "ready":
            yield 10
        token = installation.token(USER)
        yield from ask("send_stop_server_message", {"token": token, "delay": "60"})
        yield from ask("send_stop_server_message", {"token": token, "delay": "30"})

    installation.go_on(program())
    return [person]


def leftovers(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """Create all resources of a server whose record is closed; the first sweep comes at once."""
    label = ids.server_label(PROJECT, USER)
    name, now = ids.server_name(label, 1), installation.clock.now()
    closed = {
        "projectId": PROJECT, "userId": USER, "attempt": 1, "state": "closed", "token": "", "cluster": name,
        "requested": f"{now - timedelta(hours=2):%Y-%m-%dT%H:%M:%SZ}", "closed": f"{now - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}",
        "deadline": f"{now - timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}", "reason": "stopped", "dns": f"{name}.example.org",
    }  # fmt: skip
    installation.put(f"_servers/{label}.json", json.dumps(closed).encode())
    world = installation.world
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
        installation.begun[task] = 0.0
        installation.running.add(task)
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
    installation.put(
        f"_places/{PROJECT}.json",
        json.dumps({"held": {label: {"attempt": 1, "seconds": 600}}}).encode(),
    )
    installation.clock.after(1, installation._sweep)
    return []


def registering(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """A new version of the study; the researcher registers again if that failed."""
    changed = {**installation.registration, "name": "Another name"}

    def researcher() -> Iterator[float]:
        for _ in range(VisitorOnMoto.TRIES):
            try:
                answer = installation.invoke("update_project_master_list", {"project": changed})
            except Exception as error:  # noqa: BLE001 - what Lambda tells the caller
                answer = {"problems": [type(error).__name__]}
            if answer.get("registered") == PROJECT:
                return
            installation.failures.append(f"registering: {answer['problems']}")
            yield 10

    installation.go_on(researcher())
    return []


def registered(installation: TimedInstallation) -> list[str]:
    """Whether the project is in the list once, under its new name and with its old salt; what is wrong, if anything."""
    projects = installation.stored("project_master_list.json")["projects"]
    found = [(project["id"], project["name"], project["salt"]) for project in projects]
    expected = [(PROJECT, "Another name", installation.project["salt"])]
    return [] if found == expected else [f"registered: {[(project, name) for project, name, _ in found]}"]


def erasing(installation: TimedInstallation) -> list[VisitorOnMoto]:
    """A participant is erased while their server runs; the administrator repeats it if it was interrupted."""
    VisitorOnMoto(installation, USER, at_game=True, leaves=True)
    installation.promised.clear()
    installation.put(f"{PROJECT}/users/{OTHER}/answers/1.json", b'{"answers": {"said": "stays"}}')
    installation.promised[f"{PROJECT}/users/{OTHER}/answers/1.json"] = {"said": "stays"}

    def administrator() -> Iterator[float]:
        yield 200  # a failed start message comes again after 90 seconds, and would make the erased documents again
        for _ in range(VisitorOnMoto.TRIES):
            try:
                left = installation.erase(PROJECT, USER)
            except Exception as error:  # noqa: BLE001 - what the command line makes a sentence of
                installation.failures.append(f"erasing failed: {type(error).__name__}")
                yield 20
            else:
                assert not left
                return

    installation.go_on(administrator())
    return []


def erased(installation: TimedInstallation) -> list[str]:
    label = ids.server_label(PROJECT, USER)
    return [f"{key} is still there" for key in installation.stored_keys() if USER in key or label in key]


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
    # The message that the task runs cannot be handled any more.
    Journey("no event tells of its end", no_event_tells, alarms=True),
    Journey("programs use the relays", by_the_relays, finishes=False),
    Journey("the sweep finds leftovers", leftovers, {"maxServers": 3}),
    Journey("a study is registered anew", registering, check=registered),
    Journey("somebody is erased", erasing, check=erased),
)


@dataclass
class Outcome:
    """The result of one run."""

    journey: str
    fault: AwsFault | None
    made: MadeCall | None
    calls: list[MadeCall]
    wrong: list[str]  # empty if nothing is wrong
    failures: list[str]

    def __str__(self) -> str:
        return f"{self.journey}: {self.fault} ({self.made}): {'; '.join(self.wrong)}. On the way: {self.failures}"


def run(installation: TimedInstallation, journey: Journey, fault: AwsFault | None = None) -> Outcome:
    """One run of a journey."""
    installation.begin(fault)
    installation.injector.spot = journey.spot
    people = journey.begin(installation)
    installation.live()
    wrong = [f"{person.user} is stranded" for person in people if not person.served_or_told]
    if fault is None and journey.finishes:
        wrong += [f"{person.user} is told {person.reason!r}" for person in people if not person.finished]
    fine = ["dead letters"] if journey.alarms else []
    wrong += [f"{count} {what} left" for what, count in installation.left().items() if count and what not in fine]
    wrong += [f"lost {key}" for key in installation.lost()] + installation.too_long + journey.check(installation)
    injector = installation.injector
    made = injector.calls[fault.number - 1] if fault else None
    if fault and not injector.struck:
        wrong.append("nothing went wrong")
    if installation.failures and (fault is None or made is None or invisible(fault, made)):
        wrong.append(f"it could be seen: {installation.failures}")
    return Outcome(journey.name, fault, made, injector.calls, wrong, installation.failures)


def plan(calls: Calls, each: int = EACH) -> dict[str, list[AwsFault]]:
    """Return the fault points of each journey, by the rule above."""
    combos = {c.action: faults_of(c.action) for made in calls.values() for c in made}
    turn = {action: itertools.cycle(worst_first(found)) for action, found in combos.items()}
    points: dict[str, list[AwsFault]] = {name: [] for name in calls}
    last: dict[str, tuple[str, int]] = {}
    for name, made in calls.items():
        for number, (_, action) in enumerate(made, 1):
            last[action] = (name, number)
            chosen = itertools.islice(turn[action], min(each, len(combos[action])))
            points[name] += [AwsFault(number, kind, reach) for kind, reach in chosen]
    done = {(calls[name][p.number - 1].action, p.kind) for name, found in points.items() for p in found}
    for action, found in combos.items():
        name, number = last[action]
        missing = {kind: reach for kind, reach in worst_first(found)[::-1] if (action, kind) not in done}
        points[name] += [AwsFault(number, kind, reach) for kind, reach in missing.items()]
    return points


def explored(calls: Calls) -> dict[str, list[AwsFault]]:
    """Return the fault points that are tried: in `make test` a sample."""
    points = plan(calls, ALL if exploration.TIMES > 1 else EACH)
    return {name: sample(found, 48, seed=SEED) for name, found in points.items()}


def faults_of(action: str) -> list[tuple[FaultKind, Reach]]:
    """Return all kinds and reaches of faults of an operation."""
    return [(kind, reach) for kind in kinds(action) for reach in reaches(action, kind)]


def worst_first(combos: list[tuple[FaultKind, Reach]]) -> list[tuple[FaultKind, Reach]]:
    """The worst first: calls that were made and whose reply is lost; then the errors of the port."""
    return sorted(combos, key=lambda combo: (combo[1] is Reach.ATTEMPT, combo[0] is not FaultKind.READ))


@pytest.fixture(scope="module", autouse=True)
def _quiet() -> Iterator[None]:
    with quiet():
        yield


@pytest.fixture(scope="module")
def installation() -> Iterator[TimedInstallation]:
    with TimedInstallation() as installation:
        yield installation


@pytest.fixture(scope="module")
def calls(installation: TimedInstallation) -> Calls:
    found = {}
    for journey in JOURNEYS:
        installation.hold_study(**journey.changes)
        outcome = run(installation, journey)
        assert not outcome.wrong, outcome
        found[journey.name] = outcome.calls
    return found


@pytest.mark.explores
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("journey", JOURNEYS, ids=lambda journey: journey.name)
def test_a_fault_at_any_call_strands_no_participant_and_leaves_nothing(
    journey: Journey, installation: TimedInstallation, calls: Calls
) -> None:
    made = calls[journey.name]
    points = explored(calls)[journey.name]
    installation.hold_study(**journey.changes)
    outcomes = [run(installation, journey, fault) for fault in points]
    bad = [outcome for outcome in outcomes if outcome.wrong]
    unseen = sum(not outcome.failures for outcome in outcomes)
    print(f"{journey.name}: {len(made)} calls, {len(outcomes)} fault points, {unseen} of them unseen, {len(bad)} bad")
    assert not bad, f"{len(bad)} of {len(outcomes)}:\n" + "\n".join(map(str, bad[:20]))


def test_the_fault_points_cover_every_call_and_every_kind_of_fault(calls: Calls) -> None:
    points = plan(calls)
    for name, made in calls.items():
        assert {point.number for point in points[name]} == set(range(1, len(made) + 1))
    done = {(calls[name][p.number - 1].action, p.kind, p.reach) for name, found in points.items() for p in found}
    actions = {call.action for made in calls.values() for call in made}
    assert {(action, kind) for action, kind, _ in done} == {
        (action, kind) for action in actions for kind in kinds(action)
    }
    assert {(kind, reach) for _, kind, reach in done} == {combo for action in actions for combo in faults_of(action)}
    tried = [point for found in explored(calls).values() for point in found]
    assert ({point.kind for point in tried}, {point.reach for point in tried}) == (set(FaultKind), set(Reach))
    print(f"{sum(map(len, points.values()))} fault points of {sum(map(len, plan(calls, ALL).values()))}: ")
    print(
        f"{len(actions)} operations in {len(done)} ways; {sum(map(len, calls.values()))} calls in {len(calls)} journeys"
    )


def test_without_the_sweep_and_with_one_delivery_faults_leave_something_behind(
    installation: TimedInstallation, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exploration notices damage: the same faults, without the sweep and the second delivery that repair it."""

    def unswept(installation: TimedInstallation) -> list[VisitorOnMoto]:
        installation.sweeps_from = math.inf
        return from_the_link(installation)

    monkeypatch.setattr(clocked_moto, "RECEIVES", 1)
    monkeypatch.setattr(clocked_moto, "HORIZON", 1800.0)
    installation.hold_study()
    stops = [n for n, call in enumerate(calls[JOURNEYS[0].name], 1) if call.function == "stop_server"]
    assert all(
        run(installation, Journey("unswept", unswept), AwsFault(n, FaultKind.CONNECT, Reach.CALL)).wrong for n in stops
    )
