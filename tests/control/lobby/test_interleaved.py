"""A stateful machine: functions of the lobby overlap in any order, crash at any call, and lose replies.

Participants poll, in one tab or several, close their pages, come back, are under way; the sweep runs; time passes.
After every step: no participant is in two sessions; no session has too many members or changes; no participant is matched
who has not asked since the proposal. At the end, every participant who still asks is a member of a session or unmatched.
"""

from __future__ import annotations

import random
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hippodrome.control.lobby.lobby import LobbyState
from testing.exploration import examples
from testing.port_faults import PortFault
from tests.control.lobby.interleaved import Crossing
from tests.control.lobby.waiting_room import pairs

USERS = ["ann", "bob", "cem", "dan", "eve"]
FAULTS = [PortFault.CRASH_BEFORE, PortFault.CRASH_AFTER, PortFault.REPLY, PortFault.ERROR]
users = st.sampled_from(USERS)
numbers = st.integers(0, 7)


class Machine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.formed: dict[str, Any] = {}  # each session's document as it was first read
        self.memberships: dict[str, Any] = {}

    @initialize(players=st.sampled_from([2, 3]), then=st.sampled_from(["unmatched", "policies"]))
    def install(self, players: int, then: str) -> None:
        self.crossing = Crossing(pairs(players=players, after_patience=then, patience=40))

    # Events

    @rule(user=users)
    def ask(self, user: str) -> None:
        """A page sends a request while other functions are still running."""
        self.crossing.visit(user)

    @rule(user=users)
    def ask_alone(self, user: str) -> None:
        self.crossing.finish(self.crossing.visit(user))

    @rule(first=users, second=users)
    def ask_in_turn(self, first: str, second: str) -> None:
        for user in (first, second, first, second):
            self.crossing.platform.wait(seconds=0.5)
            self.crossing.finish(self.crossing.visit(user))

    @rule(user=users)
    def close(self, user: str) -> None:
        self.crossing.leave(user)

    @rule(user=users)
    def start(self, user: str) -> None:
        self.crossing.under_way(user)

    @rule()
    def sweep(self) -> None:
        self.crossing.repair()

    @rule(which=numbers)
    def serve(self, which: int) -> None:
        """A server that was started becomes ready."""
        self.crossing.serve(which)

    @precondition(lambda self: self.crossing.running)
    @rule(which=numbers, calls=st.integers(1, 12))
    def go_on(self, which: int, calls: int) -> None:
        one = self.crossing.running[which % len(self.crossing.running)]
        for _ in range(calls):
            if not one.is_over:
                self.crossing.advance(one)

    @precondition(lambda self: self.crossing.running)
    @rule(which=numbers, fault=st.sampled_from(FAULTS))
    def fail(self, which: int, fault: PortFault) -> None:
        self.crossing.advance(self.crossing.running[which % len(self.crossing.running)], fault)

    @rule(seconds=st.sampled_from([0.3, 1.0, 2.0, 6.0, 12.0, 45.0]))
    def pass_time(self, seconds: float) -> None:
        self.crossing.platform.wait(seconds=seconds)

    @rule(chance=st.integers(0, 10**6))
    def bustle(self, chance: int) -> None:
        """Two or three participants ask again and again, some in a second tab; each request makes a few calls at a time."""
        dice = random.Random(chance)
        crossing, people = self.crossing, dice.sample(USERS, dice.choice([2, 3]))
        for _ in range(120):
            running = crossing.running
            if len(running) > 3 or (running and dice.random() < 0.75):
                fault = dice.choice(FAULTS) if dice.random() < 0.03 else None
                crossing.advance(dice.choice(running), fault)
            elif dice.random() < 0.08:
                self.close(dice.choice(people))
            elif dice.random() < 0.05:
                self.sweep()
            elif dice.random() < 0.1:
                self.serve(dice.randrange(10))
            else:
                crossing.visit(dice.choice(people))
                crossing.platform.wait(seconds=dice.choice([0, 0.2, 0.7, 1.5]))
            self.nothing_is_wrong()

    # Invariants

    @invariant()
    def nothing_is_wrong(self) -> None:
        if not hasattr(self, "crossing"):
            return
        assert self.crossing.wrong(USERS) == []
        for key, found in self.crossing.sessions().items():
            assert self.formed.setdefault(key, found) == found, "a session has changed"
        for user in USERS:
            if membership := self.crossing.membership(user):
                assert self.memberships.setdefault(user, membership) == membership, "a membership has changed"

    def teardown(self) -> None:
        if not hasattr(self, "crossing"):
            return
        crossing = self.crossing
        for one in list(crossing.running):
            crossing.finish(one)
        self.nothing_is_wrong()
        told: dict[str, Any] = {}
        for _ in range(40):  # 80 seconds: longer than patience and what a proposal takes
            crossing.serve()
            for user in USERS:
                told[user] = crossing.finish(crossing.visit(user)).result
            crossing.platform.wait(seconds=2)
        assert not [user for user in USERS if isinstance(told[user], LobbyState)], "a participant waits for ever"
        crossing.platform.wait(seconds=180)  # so that the sweep sends a lost start message again
        for _ in range(2):
            crossing.finish(crossing.repair())
            crossing.serve()
        assert crossing.wrong(USERS, at_rest=True) == []
        assert crossing.decisions().keys() <= {"version", "open"}, "a decision stays"
        self.nothing_is_wrong()


Machine.TestCase.settings = settings(max_examples=examples(30), stateful_step_count=15)
TestOverlapping = Machine.TestCase
