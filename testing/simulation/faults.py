"""Runs simulated journeys with a fault at each call: a crash before the call, a crash after it, or the loss of its reply.

Each journey is run once to count the functions' calls, then once for each call and each kind of fault, with the same
seed. Retries, timers and the sweep take their course. Afterwards each participant must have finished or been told why
not, each answer that they were told is stored must be there, and no resource may be left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec

from hippodrome.protocol.keys import answer_key
from testing.port_faults import FaultAt, PortFault
from testing.simulation import design_checks, session_checks
from testing.simulation.conditions import AUTHORITY, Conditions
from testing.simulation.designs import (
    DAY,
    LOOKS,
    PAGES,
    PAY,
    SITTINGS,
    SOUP,
    TOGETHER,
    WRONG,
    Designed,
    DesignedMember,
    Ways,
)
from testing.simulation.members import Habits, SimulatedMember
from testing.simulation.people import SimulatedParticipant, SimulatedVisit
from testing.simulation.world import PROJECT, SimulatedWorld

FAULTS = (PortFault.CRASH_BEFORE, PortFault.CRASH_AFTER, PortFault.REPLY)
HORIZON = 3.0 * 3600  # virtual seconds until everything must be over: six times the longest maxRuntime of a journey


@dataclass(frozen=True)
class SimulatedJourney:
    """One way through the study, and the conditions under which it is taken."""

    name: str
    conditions: Callable[[], Conditions] = Conditions
    person: Callable[[SimulatedWorld], SimulatedParticipant] = lambda world: SimulatedParticipant(world, 0)
    finishes: bool = True  # whether the participant comes to the last page if no fault is injected
    minutes: int = 30  # maxRuntime
    limits: Mapping[str, int] = field(default_factory=dict)
    others: int = 0  # participants who come at the same time
    comes: float = 0.0  # seconds until they come
    closes: float | None = None  # the second at which the study is closed; None: it stays open
    group: Sequence[Habits] = ()  # instead of `person` and `others`: participants who play together
    to_the_end: int | None = 0  # how many of the group come to the last page without a fault; None: it depends
    play: float = 60.0  # seconds for which the group plays
    project: Mapping[str, object] = field(default_factory=dict)  # other keys of the project
    ways: Sequence[Ways] = ()  # instead of `person` and `others`: participants of a study with a design
    ends: Sequence[str | None] = ()  # of each of them, the end that is reached without a fault; None: the last step
    horizon: float = HORIZON

    def people(self, world: SimulatedWorld) -> list[SimulatedParticipant]:
        """Make all participants of the journey. They come at the same time, but take different times to read."""
        if self.ways:
            kind = DesignedMember if world.project.has_sessions else Designed
            return [kind(world, number, ways=ways, play=self.play) for number, ways in enumerate(self.ways)]
        if self.group:
            return [
                SimulatedMember(world, number, habits=habits, play=self.play)
                for number, habits in enumerate(self.group)
            ]
        return [self.person(world), *(SimulatedParticipant(world, number) for number in range(1, 1 + self.others))]


JOURNEYS = (
    SimulatedJourney("a participant plays and finishes"),
    SimulatedJourney("Spot is sold out", conditions=lambda: Conditions(no_spot=lambda seconds: True)),
    SimulatedJourney(
        "Spot takes the server back", conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(70.0, 110.0))
    ),
    SimulatedJourney("AWS is slow", conditions=lambda: Conditions(slow_zone=1.0, late_addresses=1.0, late=1.0)),
    SimulatedJourney("the image cannot be pulled", conditions=lambda: Conditions(stillborn=1.0), finishes=False),
    SimulatedJourney(
        "the participant does not come to the game",
        person=lambda world: SimulatedParticipant(world, 0, leaves_at="wait"),
        finishes=False,
    ),
    SimulatedJourney(
        "within the project's limits", limits={"max_participants": 1, "max_servers": 1, "max_server_hours": 5}
    ),
    SimulatedJourney(
        "within limits Spot takes the server back",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(70.0, 110.0)),
        limits={"max_servers": 1, "max_server_hours": 1},
    ),
    SimulatedJourney("two come and there is room for one", limits={"max_servers": 1, "max_server_hours": 1}, others=1),
    SimulatedJourney("servers without names", conditions=lambda: Conditions(authority=AUTHORITY)),
    SimulatedJourney(
        "Spot takes a server without a name back",
        conditions=lambda: Conditions(authority=AUTHORITY, interrupted=1.0, interrupted_after=(70.0, 110.0)),
    ),
    SimulatedJourney("a participant takes a warm server", limits={"warm_servers": 1}, comes=150.0, closes=600.0),
    SimulatedJourney(
        "Spot takes back warm servers, assigned or not",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(155.0, 185.0)),
        limits={"warm_servers": 1},
        comes=150.0,
        closes=600.0,
    ),
    SimulatedJourney(
        "two come within limits and one server waits",
        limits={"warm_servers": 1, "max_servers": 2, "max_server_hours": 4},
        others=1,
        comes=150.0,
        closes=600.0,
    ),
    SimulatedJourney(
        "play beyond maxRuntime",
        person=lambda world: SimulatedParticipant(world, 0, play=7200),
        finishes=False,
        minutes=6,
    ),
)
USUAL = Habits()
PAIR: Mapping[str, object] = {"players": 2, "patience": 120.0}
JOURNEYS_OF_GROUPS = (
    SimulatedJourney("a pair plays and finishes", to_the_end=2, group=(USUAL, USUAL), project=PAIR),
    SimulatedJourney(
        "Spot takes a pair's server back",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(70.0, 110.0)),
        to_the_end=2,
        group=(USUAL, USUAL),
        project=PAIR,
    ),
    SimulatedJourney("of three who come for pairs, one is unmatched", to_the_end=3, group=(USUAL,) * 3, project=PAIR),
    SimulatedJourney("one who comes alone is unmatched", to_the_end=1, group=(USUAL,), project=PAIR),
    SimulatedJourney(
        "one who comes alone plays with a policy",
        to_the_end=1,
        group=(USUAL,),
        project={**PAIR, "after_patience": "policies"},
    ),
    SimulatedJourney(
        "they reload, have two tabs, and lose the network in the lobby",
        to_the_end=4,
        group=(Habits(leaves=3.0, beacon=0.4, back=0.0), Habits(tabs=2), Habits(offline=(1.0, 25.0)), USUAL),
        project=PAIR,
    ),
    SimulatedJourney(
        "some close the lobby's page, with a beacon and without one, and one comes back",
        to_the_end=2,
        group=(Habits(leaves=1.0), Habits(leaves=2.5, beacon=None), Habits(leaves=4.0, back=20.0), USUAL),
        project=PAIR,
    ),
    SimulatedJourney(
        "all close the lobby's page", group=(Habits(leaves=1.0), Habits(leaves=1.0, beacon=None)), project=PAIR
    ),
    SimulatedJourney(
        "one drops out of the game and is back in time",
        to_the_end=2,
        group=(USUAL, Habits(drops=(20.0, 12.0))),
        project=PAIR,
    ),
    SimulatedJourney(
        "one drops out of the game for too long", to_the_end=2, group=(USUAL, Habits(drops=(20.0, 80.0))), project=PAIR
    ),
    SimulatedJourney("one leaves the game for good", to_the_end=1, group=(USUAL, Habits(quits=20.0)), project=PAIR),
    SimulatedJourney("both leave the game for good", group=(Habits(quits=20.0), Habits(quits=25.0)), project=PAIR),
    SimulatedJourney(
        "a group of four, and AWS is slow",
        conditions=lambda: Conditions(slow_zone=1.0, late_addresses=1.0, late=1.0, s3=(0.1, 0.2)),
        to_the_end=4,
        group=(USUAL,) * 4,
        project={**PAIR, "players": 4},
    ),
    SimulatedJourney(
        "two pairs, and one warm server",
        to_the_end=4,
        group=(USUAL,) * 4,
        project=PAIR,
        limits={"warm_servers": 1},
        comes=150.0,
        closes=600.0,
    ),
    SimulatedJourney(
        "two pairs, and room for one server", to_the_end=2, group=(USUAL,) * 4, project=PAIR, limits={"max_servers": 1}
    ),
    SimulatedJourney(
        "a pair plays beyond maxRuntime",
        group=(Habits(drops=(30.0, 15.0)), USUAL),
        project=PAIR,
        minutes=6,
        play=7200.0,
        to_the_end=None,  # who has joined the last server when its time is over counts as left by the other
    ),
)

JOURNEYS_OF_DESIGNS = (
    SimulatedJourney(
        "somebody is right at the second try", project=SOUP, ways=[Ways({"quiz": ({"soups": "2"}, {"soups": "3"})})]
    ),
    SimulatedJourney(
        "three come at once, send everything twice, go back, or have two tabs",
        project=SOUP,
        ways=[Ways(twice=True), Ways(back=True), Ways(tabs=True)],
    ),
    SimulatedJourney(
        "somebody declines, and somebody fails the check",
        project=SOUP,
        ways=[Ways({"consent": ({"agree": "no"},)}, back=True), Ways(WRONG, tabs=True, back=True)],
        ends=["declined", "screenedOut"],
    ),
    SimulatedJourney(
        "time runs out at the check and at a page",
        project=SOUP,
        ways=[
            Ways({"quiz": ({"soups": "2"}, {"soups": "3"})}, pauses={"quiz": 500.0}, reloads=["quiz"]),
            Ways(pauses={"rate": 150.0}, reloads=["rate"]),
            Ways(pauses={"survey": 1300.0}, reloads=["survey"]),
        ],
        ends=["screenedOut", None, "late"],
    ),
    SimulatedJourney("the game is skipped", project=SOUP, ways=[Ways({"consent": ({"plays": "no"},)}, tabs=True)]),
    SimulatedJourney(
        "no server can run the game",
        conditions=lambda: Conditions(stillborn=1.0),
        project=SOUP,
        ways=[Ways()],
        ends=["failed"],
    ),
    SimulatedJourney(
        "games are repeated, in two tabs", project=LOOKS, play=20.0, ways=[Ways(tabs=True), Ways(back=True)]
    ),
    SimulatedJourney(
        "Spot takes the server back between the games",
        conditions=lambda: Conditions(interrupted=1.0, interrupted_after=(30.0, 90.0)),
        project=LOOKS,
        play=20.0,
        ways=[Ways(twice=True)],
    ),
    SimulatedJourney(
        "somebody is tired of the games",
        project=LOOKS,
        play=20.0,
        ways=[Ways({"about": ({"tired": "yes"},), "rate": ({"answer": "4"},)})],
        ends=["tired"],
    ),
    SimulatedJourney(
        "a warm server runs the games of whoever comes",
        project=LOOKS,
        play=20.0,
        ways=[Ways()],
        limits={"warm_servers": 1},
        comes=150.0,
        closes=900.0,
    ),
    SimulatedJourney(
        "one leaves, one comes back after an hour, and others have come",
        project={**SOUP, "ends": ()},
        ways=[
            Ways(leaves="rate"),
            Ways(pauses={"survey": 4500.0}),
            Ways(comes=4000.0),
            Ways(comes=4000.0),
            Ways(comes=4600.0),
        ],
        ends=["left by themselves"],
    ),
    SimulatedJourney(
        "two sittings a day apart",
        project=SITTINGS,
        ways=[
            Ways(pauses={"tomorrow": DAY}, reloads=["tomorrow"]),
            Ways(pauses={"tomorrow": DAY / 2 + 600}, tabs=True),
        ],
        horizon=DAY + HORIZON,
    ),
    SimulatedJourney(
        "a pair plays again a day later",
        project={**SITTINGS, "players": 2, "patience": 120.0},
        ways=[Ways(pauses={"tomorrow": DAY}), Ways(pauses={"tomorrow": DAY})],
        horizon=DAY + HORIZON,
    ),
    SimulatedJourney("a pair is assigned together", project=PAY, ways=[Ways(tabs=True), Ways(back=True)]),
    SimulatedJourney(
        "a pair plays several games in one order, and a third comes late",
        project=TOGETHER,
        play=20.0,
        ways=[Ways(tabs=True), Ways(), Ways(comes=400.0)],
    ),
    SimulatedJourney(
        "of four who come for pairs one declines, and one is unmatched",
        project=PAY,
        ways=[Ways({"ready": ({"answer": "no"},)}), Ways(), Ways(twice=True), Ways()],
        ends=["declined"],
    ),
)


@dataclass
class FaultOutcome:
    """The outcome of one run with one fault (None: without)."""

    journey: str
    fault: FaultAt | None
    visit: SimulatedVisit
    left: dict[str, int]
    lost: list[str]
    story: str = field(repr=False)
    seed: int = 0
    others: tuple[SimulatedVisit, ...] = ()
    wrong: tuple[str, ...] = ()  # what `session_checks` and `design_checks` have found

    @property
    def well(self) -> bool:
        """Whether nothing is left, no answer is lost, no participant is stranded, and no session is split or merged."""
        everyone = all(served_or_told(visit) for visit in (self.visit, *self.others))
        return not any(self.left.values()) and not self.lost and everyone and not self.wrong

    def __str__(self) -> str:
        fault = f"{self.fault.fault} at call {self.fault.call}" if self.fault else "no fault"
        ended = [how_it_ended(visit) for visit in (self.visit, *self.others)]
        about = f"{self.journey}, seed {self.seed}, {fault}: {ended}; left {self.left}; lost {self.lost}; {self.wrong}"
        return f"{about}\n{self.story}"


def how_it_ended(visit: SimulatedVisit) -> str:
    """Return `finished`, `stranded`, or why the study was over for the participant."""
    return "finished" if visit.finished is not None else visit.reason or "stranded"


def served_or_told(visit: SimulatedVisit) -> bool:
    """Return whether the participant has finished, has left by themselves, or was told why the study is over for them."""
    told = bool(visit.reason) and not visit.reason.startswith(("waited too long", "no answer"))
    return visit.finished is not None or told


def run(
    journey: SimulatedJourney, seed: int, fault: FaultAt | None = None, *, watched: bool = False
) -> tuple[SimulatedWorld, FaultOutcome]:
    """Run a journey once; return its world and outcome. `watched` (`SimulatedWorld.watch`) takes four times as long."""
    project = msgspec.structs.replace(PROJECT, max_runtime=journey.minutes, **journey.limits, **journey.project)
    world = SimulatedWorld(seed, journey.conditions(), project, pages=PAGES)
    world.cloud.fault = fault
    if watched:
        world.watch()
    world.ask_for_warm_servers()
    if journey.closes is not None:
        world.clock.after(journey.closes, world.close)
    people = journey.people(world)
    for person in people:
        world.clock.spawn(person.walk, delay=journey.comes)
    world.settle(journey.horizon)
    documents = world.platform.documents.kept
    lost = [s for p in people for s in p.answered if answer_key(world.project.id, p.visit.user, s) not in documents]
    first, *others = [person.visit for person in people]
    members = [person for person in people if isinstance(person, SimulatedMember)]
    designed = [person for person in people if isinstance(person, Designed)]
    wrong = (*session_checks.faults(documents, world.project, members), *design_checks.faults(world, designed))
    outcome = FaultOutcome(
        journey.name, fault, first, dict(world.left()), lost, world.story(), seed, tuple(others), wrong
    )
    return world, outcome


def calls(journey: SimulatedJourney, seed: int) -> int:
    """Return how many calls the functions make in a journey until nothing is left; later sweeps are not counted."""
    world, _ = run(journey, seed, watched=True)
    return world.calls_until_quiet


def points(journey: SimulatedJourney, seed: int) -> list[FaultAt]:
    """Return every fault of a journey: each kind at each call."""
    return [FaultAt(call, fault) for call in range(1, calls(journey, seed) + 1) for fault in FAULTS]


def explore(journey: SimulatedJourney, seed: int) -> Iterator[FaultOutcome]:
    """Run a journey once with each of its faults, and yield the outcome of each run."""
    for fault in points(journey, seed):
        yield run(journey, seed, fault)[1]
