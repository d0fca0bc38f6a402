"""The machine: hypothesis chooses what happens next, and to which message, participant, task or function."""

from __future__ import annotations

from typing import Any

from hypothesis import note
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hippodrome.project import Project
from tests.machine import checks
from tests.machine.account import Fault, Trouble
from tests.machine.world import World
from tests.studies import study

TROUBLE = st.none() | st.builds(Trouble, st.integers(1, 10), st.sampled_from(list(Fault)))
USERS = ("alice", "bob", "carol")
PEOPLE = st.sampled_from(USERS)
LIMITS: list[dict[str, int]] = [
    {},
    {"max_servers": 1},
    {"max_servers": 2, "max_server_hours": 3},
    {"max_participants": 2, "max_servers": 2},
]


def project(limits: dict[str, int], own_clusters: bool) -> Project:
    """The study in question."""
    return study(cluster="participant" if own_clusters else "installation", **limits)


class Machine(RuleBasedStateMachine):
    """Participants, servers and the sweep; every message in a bag."""

    world: World

    @initialize(limits=st.sampled_from(LIMITS), own_clusters=st.booleans())
    def the_study(self, limits: dict[str, int], own_clusters: bool) -> None:
        self.world = World(project(limits, own_clusters), USERS)
        self.world.listener = lambda line: note(f"    {line}")

    # Messages

    @rule(queue=st.sampled_from(["start", "stop", "tasks"]), data=st.data(), trouble=TROUBLE)
    def messages_are_delivered(self, queue: str, data: Any, trouble: Trouble | None) -> None:
        """One, or several in any order; only some may succeed."""
        if there := self.world.visible(queue):
            most = 1 if queue == "start" else 4
            some = st.lists(st.sampled_from(there), min_size=1, max_size=most, unique_by=lambda m: m.number)
            self.world.deliver(data.draw(some), trouble)

    @rule(data=st.data())
    def a_message_is_repeated(self, data: Any) -> None:
        """One that is waiting, being dealt with, or long done."""
        if there := [*self.world.bag, *self.world.in_flight, *self.world.done]:
            self.world.repeat(data.draw(st.sampled_from(there)))

    @rule()
    def what_waits_is_delivered_and_tasks_go_on(self) -> None:
        """The usual course of things, for a while."""
        for queue in ("start", "tasks", "stop"):
            for message in self.world.visible(queue):
                self.world.deliver([message])
        for task in self.world.tasks:
            self.move(task)

    @precondition(lambda self: self.world.functions.waiting)
    @rule(data=st.data(), trouble=TROUBLE)
    def a_function_goes_on(self, data: Any, trouble: Trouble | None) -> None:
        waiting = st.sampled_from(self.world.functions.waiting)
        self.world.functions.go_on(data.draw(waiting), trouble)

    # Participants

    @rule(user=PEOPLE, trouble=TROUBLE)
    def somebody_opens_the_link(self, user: str, trouble: Trouble | None) -> None:
        self.world.ask(user, trouble=trouble)

    @rule(user=PEOPLE)
    def somebody_goes_on_to_the_game(self, user: str) -> None:
        page = self.world.ask(user)
        for _ in range(2):
            if page.get("step") in ("1", "2"):
                page = self.world.answer(user, page["step"])

    @rule(user=PEOPLE, word=st.sampled_from(["yes", "no"]), data=st.data(), trouble=TROUBLE)
    def somebody_submits(self, user: str, word: str, data: Any, trouble: Trouble | None) -> None:
        """From any tab they ever opened."""
        if forms := self.world.people[user].forms:
            self.world.answer(user, data.draw(st.sampled_from(forms)), word, trouble)

    @rule(user=PEOPLE, trouble=TROUBLE)
    def somebody_asks_for_another_server(self, user: str, trouble: Trouble | None) -> None:
        if any("state" in page for page in self.world.people[user].pages):
            self.world.restart(user, trouble)

    @rule(user=PEOPLE, which=st.sampled_from(["stop", "start"]), delay=st.sampled_from([0, 60]), trouble=TROUBLE)
    def somebody_uses_a_relay(self, user: str, which: str, delay: int, trouble: Trouble | None) -> None:
        self.world.relay(which, user, delay if which == "stop" else 0, trouble)

    # Tasks and their trials

    def move(self, task: Any) -> None:
        if task.last == "PROVISIONING" and task.alive:
            self.world.account.fleet.begin(task)
        elif task.last != "STOPPED" and not task.alive:
            self.world.account.fleet.gone(task)

    def moving(self) -> list[Any]:
        return [t for t in self.world.tasks if t.last != "STOPPED" and (t.last == "PROVISIONING" or not t.alive)]

    def alive(self, *states: str) -> list[Any]:
        return [task for task in self.world.tasks if task.alive and task.last in states]

    @precondition(lambda self: self.moving())
    @rule(data=st.data())
    def a_task_goes_on(self, data: Any) -> None:
        """It runs, or has stopped."""
        self.move(data.draw(st.sampled_from(self.moving())))

    @precondition(lambda self: self.alive("RUNNING"))
    @rule(data=st.data(), ends=st.booleans())
    def somebody_plays_to_the_end(self, data: Any, ends: bool) -> None:
        """The trial stores its answer, and may end at once."""
        task = data.draw(st.sampled_from(self.alive("RUNNING")))
        record = self.world.record(task.name.partition("-")[0])
        if record and record.state == "ready" and record.task == task.arn:
            self.world.played(task)
            if ends:
                self.world.account.fleet.end(task, "EssentialContainerExited", "done", 0)

    @precondition(lambda self: self.alive("RUNNING", "PROVISIONING"))
    @rule(
        data=st.data(),
        how=st.sampled_from(["SpotInterruption", "idle", "crashed", "InfrastructureHealth", "TaskFailedToStart"]),
    )
    def a_task_ends(self, data: Any, how: str) -> None:
        """Spot's warning, a trial that ends by itself, or one that dies; it has stopped a little later."""
        task = data.draw(st.sampled_from(self.alive("RUNNING", "PROVISIONING")))
        code = "EssentialContainerExited" if how in ("idle", "crashed") else how
        if task.last == "PROVISIONING":
            code = "TaskFailedToStart"
        if code == "SpotInterruption" and not task.request.spot:
            code = "InfrastructureHealth"
        exit_code = {"idle": 0, "crashed": 1}.get(how) if code == "EssentialContainerExited" else None
        self.world.account.fleet.end(task, code, how, exit_code)

    # AWS

    @rule(spot=st.sampled_from(["room", "full"]), demand=st.sampled_from(["room", "full", "refused"]))
    def capacity_changes(self, spot: str, demand: str) -> None:
        fleet = self.world.account.fleet
        fleet.spot, fleet.demand = "refused" if demand == "refused" else spot, demand

    @rule(lag=st.sampled_from([0, 50]), known=st.booleans())
    def lists_are_late(self, lag: int, known: bool) -> None:
        """ECS's lists do not show new tasks yet; EC2 does not know addresses."""
        self.world.account.fleet.lag, self.world.account.fleet.addresses_known = lag, known

    @rule()
    def names_are_known_everywhere(self) -> None:
        self.world.account.zone.settle()

    @rule(seconds=st.sampled_from([1, 16, 35, 65, 300, 660, 1900]))
    def time_passes(self, seconds: int) -> None:
        self.world.wait(seconds)

    @precondition(lambda self: self.world.timers_due())
    @rule(data=st.data())
    def a_timer_fires(self, data: Any) -> None:
        self.world.fire(data.draw(st.sampled_from(self.world.timers_due())))

    @rule()
    def functions_are_cold(self) -> None:
        self.world.functions.cool()

    # Those who clean up

    @rule(trouble=TROUBLE)
    def the_sweep_runs(self, trouble: Trouble | None) -> None:
        self.world.sweep(trouble)

    @rule(trouble=TROUBLE)
    def the_administrator_stops_all(self, trouble: Trouble | None) -> None:
        self.world.stop_all(trouble)

    @rule(live=st.booleans())
    def the_study_is_closed_or_opened(self, live: bool) -> None:
        self.world.close(live)

    @rule(user=PEOPLE)
    def somebody_is_erased(self, user: str) -> None:
        if self.world.may_erase(user):
            self.world.erase(user)

    # What must hold

    @invariant()
    def all_is_as_it_should_be(self) -> None:
        checks.always(self.world)

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        try:
            self.world.tell("nothing goes wrong any more")
            checks.ends_well(self.world)
        finally:
            for invocation in [*self.world.functions.waiting]:
                self.world.functions.kill(invocation)
