"""A crash before, after, and with the lost reply of every call that the functions make in a journey.

Each journey is run once to count the calls, then once for each call and each kind of fault, with the same seed.
Retries, timers and the sweep do what they do; afterwards the participant must have been served or told so, what they
answered must be there, and nothing may be left running.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from protocol.keys import answer_key
from testing.port_faults import Fault, FaultAt
from testing.simulation.people import Person, Visit
from testing.simulation.ports import Conditions
from testing.simulation.world import PROJECT, World

FAULTS = (Fault.CRASH_BEFORE, Fault.CRASH_AFTER, Fault.REPLY)
HORIZON = 3.0 * 3600  # virtual seconds until everything must be over: three times the deadline, and the sweeps after it


@dataclass(frozen=True)
class Journey:
    """One way through the study."""

    name: str
    conditions: Callable[[], Conditions] = Conditions
    person: Callable[[World], Person] = lambda world: Person(world, 0)
    finishes: bool = True  # whether the participant comes to the last page where nothing goes wrong
    minutes: int = 30  # maxRuntime
    limits: Mapping[str, int] = field(default_factory=dict)
    others: int = 0  # participants who come at the same time
    comes: float = 0.0  # seconds until they come
    closes: float | None = None  # when the study is closed; else it stays open


JOURNEYS = (
    Journey("a participant plays and finishes"),
    Journey("Spot is sold out", conditions=lambda: Conditions(no_spot=lambda seconds: True)),
    Journey(
        "Spot takes the server back", conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(70.0, 110.0))
    ),
    Journey("AWS is slow", conditions=lambda: Conditions(slow_zone=1.0, late_addresses=1.0, late=1.0)),
    Journey("the image cannot be pulled", conditions=lambda: Conditions(stillborn=1.0), finishes=False),
    Journey("nobody comes to play", person=lambda world: Person(world, 0, leaves_at="wait"), finishes=False),
    Journey("within the project's limits", limits={"max_participants": 1, "max_servers": 1, "max_server_hours": 5}),
    Journey(
        "within limits Spot takes the server back",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(70.0, 110.0)),
        limits={"max_servers": 1, "max_server_hours": 1},
    ),
    Journey("two come and there is room for one", limits={"max_servers": 1, "max_server_hours": 1}, others=1),
    Journey("a participant takes a warm server", limits={"warm_servers": 1}, comes=150.0, closes=600.0),
    Journey(
        "Spot takes back warm servers, assigned or not",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(155.0, 185.0)),
        limits={"warm_servers": 1},
        comes=150.0,
        closes=600.0,
    ),
    Journey(
        "two come within limits and one server waits",
        limits={"warm_servers": 1, "max_servers": 2, "max_server_hours": 4},
        others=1,
        comes=150.0,
        closes=600.0,
    ),
    Journey("play beyond maxRuntime", person=lambda world: Person(world, 0, play=7200), finishes=False, minutes=6),
)


@dataclass
class Outcome:
    """What came of one run with one fault."""

    journey: str
    fault: FaultAt | None
    visit: Visit
    left: dict[str, int]
    lost: list[str]
    story: str = field(repr=False)
    seed: int = 0
    others: tuple[Visit, ...] = ()

    @property
    def well(self) -> bool:
        """Nothing left, nothing lost, and no participant stranded."""
        everybody = all(served_or_told(visit) for visit in (self.visit, *self.others))
        return not any(self.left.values()) and not self.lost and everybody

    def __str__(self) -> str:
        what = f"{self.fault.fault} at call {self.fault.call}" if self.fault else "no fault"
        ended = "finished" if self.visit.finished is not None else self.visit.told or "stranded"
        return f"{self.journey}, seed {self.seed}, {what}: {ended}; left {self.left}; lost {self.lost}\n{self.story}"


def served_or_told(visit: Visit) -> bool:
    """Whether the participant finished, left by themselves, or ended with a page that says how things are."""
    told = bool(visit.told) and not visit.told.startswith(("waited too long", "no answer"))
    return visit.finished is not None or told


def run(journey: Journey, seed: int, fault: FaultAt | None = None, *, watched: bool = False) -> tuple[World, Outcome]:
    """One run of a journey. With `watched` (`World.watch`) it takes four times as long; nothing else changes."""
    project = msgspec.structs.replace(PROJECT, max_runtime=journey.minutes, **journey.limits)
    world = World(seed, journey.conditions(), project)
    world.cloud.fault = fault
    if watched:
        world.watch()
    world.open()
    if journey.closes is not None:
        world.clock.after(journey.closes, world.close)
    people = [journey.person(world), *(Person(world, number) for number in range(1, 1 + journey.others))]
    for person in people:
        world.clock.spawn(person.walk, delay=journey.comes)
    world.settle(HORIZON)
    kept = world.platform.documents.kept
    lost = [s for p in people for s in p.answered if answer_key(world.project.id, p.visit.user, s) not in kept]
    first, *others = [person.visit for person in people]
    return world, Outcome(journey.name, fault, first, dict(world.left()), lost, world.story(), seed, tuple(others))


def calls(journey: Journey, seed: int) -> int:
    """How many calls the functions make in a journey until its server is gone; later sweeps are left out."""
    world, _ = run(journey, seed, watched=True)
    return world.calls_until_quiet


def points(journey: Journey, seed: int) -> list[FaultAt]:
    """Every fault of a journey: each kind at each call."""
    return [FaultAt(call, fault) for call in range(1, calls(journey, seed) + 1) for fault in FAULTS]


def explore(journey: Journey, seed: int) -> Iterator[Outcome]:
    """Every fault of a journey, one run each."""
    for fault in points(journey, seed):
        yield run(journey, seed, fault)[1]
