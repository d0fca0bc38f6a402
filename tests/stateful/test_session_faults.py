"""Each call of a pair's journey fails, is the last, or loses its reply: still no participant is stranded, and nothing is left."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest

from testing.exploration import sample_of_each
from testing.port_faults import FaultAt, PortFault
from tests.stateful.functions import Invocation
from tests.stateful.sessions import SessionWorld, always, ends_well, pairs
from tests.stateful.world import World

pytestmark = pytest.mark.usefixtures("numbered_sessions")

FAULTS = (PortFault.ERROR, PortFault.REPLY, PortFault.CRASH_BEFORE, PortFault.CRASH_AFTER)
PAIR = ("alice", "bob")


class Counted:
    """Counts the calls of each invocation, and injects a fault at one call of one of them."""

    def __init__(self, world: World, at: tuple[int, FaultAt] | None = None) -> None:
        self.calls: list[int] = []  # of each invocation, in their order
        invoke = world.functions.invoke

        def counted(
            function: str, about: str, act: Callable[[], Any], done: Callable[[Invocation], None], _: Any = None
        ) -> None:
            number = len(self.calls)
            self.calls.append(0)

            def finished(invocation: Invocation) -> None:
                self.calls[number] = invocation.calls
                done(invocation)

            invoke(function, about, act, finished, at[1] if at and at[0] == number else None)

        world.functions.invoke = counted  # type: ignore[method-assign]


def come(world: SessionWorld, *users: str) -> None:
    """Bring a pair to the page before the game, where the server is started ahead."""
    for user in users:
        world.ask(user)
        world.answer(user, "1")


def wait_together(world: SessionWorld, *users: str, rounds: int = 4) -> None:
    for _ in range(rounds):
        for user in users:
            world.poll(user)
        world.wait(2)


def meet(world: SessionWorld) -> None:
    """A server is started ahead, and the pair meets in the lobby."""
    come(world, *PAIR)
    world.go_on()
    for user in PAIR:
        world.answer(user, "2")
    wait_together(world, *PAIR)
    world.go_on()


def a_pair(world: SessionWorld) -> None:
    """The pair meets in the lobby, plays, and each goes on to the end alone."""
    meet(world)
    for task in [task for task in world.tasks if task.alive]:
        world.played(task)
    for user in PAIR:
        world.ask(user)
        world.deliver_all("stop")
    world.sweep()


def a_pair_without_a_server_ahead(world: SessionWorld) -> None:
    """They are matched before their start messages arrive."""
    come(world, *PAIR)
    for user in PAIR:
        world.answer(user, "2")
    wait_together(world, *PAIR)
    world.deliver_all("start")
    world.go_on()


def a_pair_whose_server_is_lost(world: SessionWorld) -> None:
    """The server is lost between the answers of the two members."""
    meet(world)
    for task in [task for task in world.tasks if task.alive]:
        world.played(task, answers=1)
        world.account.fleet.end(task, "SpotInterruption", "spot")
    world.move_all()
    world.deliver_all("tasks")
    world.go_on()


def one_alone(world: SessionWorld) -> None:
    """No other participant comes: this one is unmatched, and the server that was started ahead is stopped."""
    come(world, "alice")
    world.go_on()
    world.answer("alice", "2")
    for _ in range(14):  # longer than their patience, which is a minute
        world.poll("alice")
        world.wait(5)
    world.ask("alice")
    world.deliver_all("stop")
    world.sweep()
    world.deliver_all("stop")


def one_who_never_comes(world: SessionWorld) -> None:
    """A participant is under way and does not come: the server is stopped after half an hour, and no other starts after that."""
    come(world, "alice")
    world.go_on()
    for _ in range(3):
        world.wait(16 * 60)
        world.sweep()
        world.deliver_all("stop")
        world.go_on()


def with_a_warm_server(world: SessionWorld) -> None:
    """The pair gets a warm server."""
    world.go_on()
    meet(world)


JOURNEYS: dict[str, tuple[Callable[[SessionWorld], None], dict[str, Any]]] = {
    "a pair": (a_pair, {}),
    "a pair with limits": (a_pair, {"max_servers": 1, "max_server_hours": 4}),
    "a pair without a server ahead": (a_pair_without_a_server_ahead, {}),
    "a pair whose server is lost": (a_pair_whose_server_is_lost, {}),
    "one alone": (one_alone, {}),
    "one who never comes": (one_who_never_comes, {}),
    "a warm server": (with_a_warm_server, {"warm_servers": 1}),
    "alone with policies": (one_alone, {"after_patience": "policies"}),
}


FORMED: dict[str, tuple[list[int], list[str]]] = {
    **dict.fromkeys(JOURNEYS, ([2], [])),
    "one alone": ([], ["alice"]),
    "one who never comes": ([], []),
    "alone with policies": ([1], []),
}
"""How many members each session has, and who is unmatched, at the end of the journey."""


def begin(name: str, at: tuple[int, FaultAt] | None = None) -> tuple[SessionWorld, Counted]:
    journey, changes = JOURNEYS[name]
    world = SessionWorld(pairs(**changes), PAIR)
    counted = Counted(world, at)
    journey(world)
    always(world)
    return world, counted


@functools.cache
def places(name: str) -> list[tuple[int, FaultAt]]:
    """All calls of all invocations of the journey, each with every fault."""
    _, counted = begin(name)
    return [
        (number, FaultAt(call, fault))
        for number, calls in enumerate(counted.calls)
        for call in range(1, calls + 1)
        for fault in FAULTS
    ]


@pytest.mark.parametrize("name", JOURNEYS)
def test_each_journey_without_faults_ends_well(name: str) -> None:
    world, _ = begin(name)
    members = [len(session.members) for session in world.sessions()]
    unmatched = [user for user in PAIR if (membership := world.membership(user)) and membership.unmatched]
    assert (members, unmatched) == FORMED[name]
    ends_well(world)


@pytest.mark.explores
@pytest.mark.parametrize("name", JOURNEYS)
def test_a_fault_at_any_call_strands_no_participant_and_leaves_nothing(name: str) -> None:
    wrong: list[str] = []
    for number, fault in sample_of_each(places(name), 48, lambda place: place[1].fault, seed=len(name)):
        world: SessionWorld | None = None
        try:
            world, _ = begin(name, (number, fault))
            ends_well(world)
        except AssertionError as error:
            wrong.append(f"invocation {number}, {fault}: {error}")
    assert not wrong, "\n".join(wrong[:10])
