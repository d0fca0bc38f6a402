"""The state machine of `state_machine.py`, for participants who play together: they also wait in a lobby, and leave it."""

from __future__ import annotations

from typing import Any

from hypothesis import event, note
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule

from testing.port_faults import FaultAt
from tests.stateful import sessions
from tests.stateful.sessions import USERS, SessionWorld, pairs
from tests.stateful.state_machine import MAYBE, Machine

PEOPLE = st.sampled_from(USERS)
LIMITS: list[dict[str, Any]] = [
    {},
    {"max_servers": 1},
    {"max_servers": 3, "max_server_hours": 6},
    {"after_patience": "policies"},
    {"warm_servers": 1},
]
BEGINNINGS = st.sampled_from(["nowhere", "under way", "in the lobby", "in the lobby", "ready"])


class SessionMachine(Machine):
    """Three participants of a study for pairs."""

    world: SessionWorld

    @initialize(
        limits=st.sampled_from(LIMITS), own_clusters=st.booleans(), stands=st.lists(BEGINNINGS, min_size=3, max_size=3)
    )
    def the_study(self, limits: dict[str, Any], own_clusters: bool, stands: list[str]) -> None:  # type: ignore[override]
        """`stands`: the step at which each participant begins."""
        cluster = "participant" if own_clusters else "installation"
        self.world = SessionWorld(pairs(cluster=cluster, **limits))
        self.world.listener = lambda line: note(f"    {line}")
        for user, where in zip(USERS, stands, strict=True):
            if where != "nowhere":
                self.world.ask(user)
                self.world.answer(user, "1")
        if "ready" in stands:
            self.world.go_on()
        waiting = [user for user, where in zip(USERS, stands, strict=True) if where not in ("nowhere", "under way")]
        for user in waiting:
            self.world.answer(user, "2")
        for _ in range(3 if "ready" in stands else 0):
            for user in waiting:
                self.world.poll(user)
            self.world.wait(2)

    @rule(users=st.permutations(USERS), rounds=st.integers(1, 4), fault=MAYBE)
    def they_wait_in_the_lobby(self, users: list[str], rounds: int, fault: FaultAt | None) -> None:
        """Their pages ask, in any order; one request may have a fault."""
        for _ in range(rounds):
            for number, user in enumerate(users):
                self.world.poll(user, fault if number == 0 else None)
            self.world.wait(2)

    @rule(user=PEOPLE, fault=MAYBE)
    def a_page_asks(self, user: str, fault: FaultAt | None) -> None:
        self.world.poll(user, fault)

    @rule(user=PEOPLE, fault=MAYBE)
    def somebody_closes_the_lobby(self, user: str, fault: FaultAt | None) -> None:
        self.world.close_page(user, fault)

    @rule(user=PEOPLE)
    def the_third_goes_on_to_the_game(self, user: str) -> None:
        self.somebody_goes_on_to_the_game(user)

    @precondition(lambda self: self.alive("RUNNING"))
    @rule(data=st.data(), answers=st.integers(1, 2), ends=st.booleans())
    def somebody_plays_to_the_end(self, data: Any, answers: int, ends: bool) -> None:  # type: ignore[override]
        """The trial stores its members' answers, perhaps not all of them, and may end at once."""
        task = data.draw(st.sampled_from(self.alive("RUNNING")))
        record = self.world.owner(task.name)
        if record and record.state == "ready" and record.task == task.arn and self.world.session_of(task):
            self.world.played(task, answers)
            if ends:
                self.world.account.fleet.end(task, "EssentialContainerExited", "done", 0)

    @rule(name=st.just("lobby"))
    def the_lobbys_document_is_lost(self, name: str) -> None:
        """It becomes unreadable, and its decisions are lost; no participant may come into two sessions."""
        if not self.world.functions.waiting and not self.world.decisions().formed:
            self.world.spoil_the_lobby()

    @rule(user=st.just(""))
    def somebody_is_erased(self, user: str) -> None:  # type: ignore[override]
        """`erase` has tests of its own (tests/deployment/operate/test_erase_sessions.py)."""

    @invariant()
    def all_is_as_it_should_be(self) -> None:
        sessions.always(self.world)

    def ends_well(self) -> None:
        sessions.ends_well(self.world)

    def teardown(self) -> None:
        for session in self.world.sessions() if hasattr(self, "world") else ():
            event(f"a session of {len(session.members)}")
        super().teardown()
