"""The state machine: hypothesis chooses the next event, and its message, participant, task or function."""

from __future__ import annotations

from typing import Any

from hypothesis import event, note
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hippodrome.control.model.project import Project
from testing.port_faults import FaultAt, PortFault
from testing.studies import study
from tests.stateful import checks
from tests.stateful.world import World

FAULTS = st.builds(FaultAt, st.integers(1, 12), st.sampled_from(list(PortFault)))
MAYBE = st.none() | FAULTS
USERS = ("alice", "bob")
PEOPLE = st.sampled_from(USERS)
LIMITS: list[dict[str, int]] = [
    {},
    {"max_servers": 1},
    {"max_servers": 2, "max_server_hours": 2},
    {"max_participants": 1, "max_servers": 1},
]
BEGINNINGS = st.sampled_from(["nowhere", "at the game", "starting", "running", "ready"])


def project(limits: dict[str, int], own_clusters: bool, warm: int) -> Project:
    """Return the study, with the chosen settings."""
    return study(cluster="participant" if own_clusters else "installation", warm_servers=warm, **limits)


class Machine(RuleBasedStateMachine):
    """Participants, servers and the sweep; every message in its queue until it is delivered."""

    world: World

    @initialize(
        limits=st.sampled_from(LIMITS),
        own_clusters=st.booleans(),
        warm=st.sampled_from([0, 1, 2]),
        waiting=st.booleans(),
        alice=BEGINNINGS,
        bob=BEGINNINGS,
    )
    def the_study(
        self, limits: dict[str, int], own_clusters: bool, warm: int, waiting: bool, alice: str, bob: str
    ) -> None:
        """`warm`: the number of warm servers; `alice` and `bob`: the steps at which these two begin."""
        self.world = World(project(limits, own_clusters, warm), USERS)
        self.world.listener = lambda line: note(f"    {line}")
        if warm and waiting:
            self.world.go_on()
        for user, stands in (("alice", alice), ("bob", bob)):
            self.begin(user, stands)

    def begin(self, user: str, stands: str) -> None:
        """Bring a participant to where the run begins for them, without a fault."""
        if stands == "nowhere":
            return
        self.somebody_goes_on_to_the_game(user)
        if stands != "at the game":
            self.world.deliver_all("start")
        if stands == "running":
            self.world.move_all()
        if stands == "ready":
            self.world.go_on()

    # Messages

    @precondition(lambda self: self.world.visible())
    @rule(data=st.data(), fault=MAYBE)
    def messages_are_delivered(self, data: Any, fault: FaultAt | None) -> None:
        """Deliver one message, or several of a queue in any order; some may fail."""
        first = data.draw(st.sampled_from(self.world.visible()))
        others = [message for message in self.world.visible(first.queue) if message is not first]
        more = st.lists(st.sampled_from(others), max_size=3, unique_by=lambda m: m.number) if others else st.just([])
        self.world.deliver([first, *([] if first.queue == "start" else data.draw(more))], fault)

    @precondition(lambda self: self.world.visible())
    @rule(data=st.data(), fault=FAULTS)
    def a_message_is_delivered_and_something_goes_wrong(self, data: Any, fault: FaultAt) -> None:
        self.world.deliver([data.draw(st.sampled_from(self.world.visible()))], fault)

    @precondition(lambda self: self.world.queued or self.world.in_flight or self.world.done)
    @rule(data=st.data())
    def a_message_is_repeated(self, data: Any) -> None:
        """Repeat a message that waits, is being handled, or was handled before."""
        there = [*self.world.queued, *self.world.in_flight, *self.world.done]
        self.world.repeat(data.draw(st.sampled_from(there)))

    def unheard(self) -> list[Any]:
        return [message for message in self.world.queued if not message.failed]

    @precondition(lambda self: self.unheard())
    @rule(data=st.data())
    def a_message_is_lost(self, data: Any) -> None:
        """A message that never arrives: the sweep, timers and reloads have to repair that.

        Messages whose handling failed are not lost: they come again until they are dead letters, which alarm the administrator.
        """
        self.world.lose(data.draw(st.sampled_from(self.unheard())))

    @precondition(lambda self: self.world.visible() or self.world.moving())
    @rule()
    def what_waits_is_delivered_and_tasks_go_on(self) -> None:
        """The usual course of things, for a while."""
        for queue in ("start", "tasks", "stop"):
            self.world.deliver_all(queue)
        self.world.move_all()

    @precondition(lambda self: self.world.functions.waiting)
    @rule(data=st.data(), fault=MAYBE)
    def a_function_goes_on(self, data: Any, fault: FaultAt | None) -> None:
        waiting = st.sampled_from(self.world.functions.waiting)
        self.world.functions.go_on(data.draw(waiting), fault)

    # Participants

    @rule(user=PEOPLE, fault=MAYBE)
    def somebody_opens_the_link(self, user: str, fault: FaultAt | None) -> None:
        self.world.ask(user, fault=fault)

    @rule(user=PEOPLE)
    def somebody_goes_on_to_the_game(self, user: str) -> None:
        page = self.world.ask(user)
        for _ in range(2):
            if page.get("step") in ("1", "2"):
                page = self.world.answer(user, page["step"])

    def forms(self) -> list[tuple[str, str]]:
        return [(user, step) for user, person in self.world.people.items() for step in person.forms]

    @precondition(lambda self: self.forms())
    @rule(word=st.sampled_from(["yes", "no"]), data=st.data(), fault=MAYBE)
    def somebody_submits(self, word: str, data: Any, fault: FaultAt | None) -> None:
        """The form may be from any tab that they have opened."""
        user, step = data.draw(st.sampled_from(self.forms()))
        self.world.answer(user, step, word, fault)

    @precondition(lambda self: any(person.saw_the_game for person in self.world.people.values()))
    @rule(data=st.data(), fault=MAYBE)
    def somebody_asks_for_another_server(self, data: Any, fault: FaultAt | None) -> None:
        """The page may be that of an old tab."""
        there = [user for user, person in self.world.people.items() if person.saw_the_game]
        self.world.restart(data.draw(st.sampled_from(there)), fault)

    @rule(user=PEOPLE, which=st.sampled_from(["stop", "start"]), delay=st.sampled_from([0, 60]), fault=MAYBE)
    def somebody_uses_a_relay(self, user: str, which: str, delay: int, fault: FaultAt | None) -> None:
        self.world.relay(which, user, delay if which == "stop" else 0, fault)

    # Tasks and their trials

    def alive(self, *states: str) -> list[Any]:
        return [task for task in self.world.tasks if task.alive and task.last in states]

    @precondition(lambda self: self.world.moving())
    @rule(data=st.data())
    def a_task_goes_on(self, data: Any) -> None:
        """It begins to run, or its container ends, or it stops."""
        self.world.account.fleet.go_on(data.draw(st.sampled_from(self.world.moving())))

    @precondition(lambda self: self.alive("RUNNING"))
    @rule(data=st.data(), ends=st.booleans())
    def somebody_plays_to_the_end(self, data: Any, ends: bool) -> None:
        """The trial stores its answer, and may end at once."""
        task = data.draw(st.sampled_from(self.alive("RUNNING")))
        record = self.world.owner(task.name)
        if record and record.state == "ready" and record.task == task.arn and self.world.player(task):
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

    @rule(
        spot=st.sampled_from(["room", "full"]),
        demand=st.sampled_from(["room", "full", "refused"]),
        lag=st.sampled_from([0, 50]),
        known=st.booleans(),
    )
    def aws_is_as_it_is(self, spot: str, demand: str, lag: int, known: bool) -> None:
        """Set the capacity on Spot and on demand, the seconds until ECS lists a new task, and whether EC2 knows addresses."""
        fleet = self.world.account.fleet
        fleet.spot, fleet.demand = "refused" if demand == "refused" else spot, demand
        fleet.lag, fleet.addresses_known = lag, known

    @precondition(lambda self: self.world.account.zone.pending)
    @rule()
    def names_are_known_everywhere(self) -> None:
        self.world.account.zone.settle()

    @rule(seconds=st.sampled_from([16, 1, 35, 65, 300, 660, 1900]), cold=st.booleans())
    def time_passes(self, seconds: int, cold: bool) -> None:
        """`cold`: functions lose what they keep between invocations."""
        self.world.wait(seconds)
        if cold:
            self.world.functions.cool()

    @precondition(lambda self: self.world.timers_due())
    @rule(data=st.data())
    def a_timer_fires(self, data: Any) -> None:
        self.world.fire(data.draw(st.sampled_from(self.world.timers_due())))

    # The sweep and the administrator

    @rule(fault=MAYBE)
    def the_sweep_runs(self, fault: FaultAt | None) -> None:
        self.world.sweep(fault)

    @rule(fault=MAYBE)
    def the_administrator_stops_all(self, fault: FaultAt | None) -> None:
        self.world.stop_all(fault)

    @rule(closed=st.booleans(), heard=st.booleans())
    def the_study_is_registered_anew(self, closed: bool, heard: bool) -> None:
        """`heard`: warm servers are adapted at once, or only by the sweep."""
        self.world.open(not closed, heard)

    @rule(user=PEOPLE)
    def somebody_is_erased(self, user: str) -> None:
        if self.world.may_erase(user):
            self.world.erase(user)

    # Invariants

    @invariant()
    def all_is_as_it_should_be(self) -> None:
        checks.always(self.world)

    def ends_well(self) -> None:
        checks.ends_well(self.world)

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        for record in self.world.records():
            event(f"{record.state} {record.reason or ''}, attempt {record.attempt}")
        try:
            self.world.tell("nothing goes wrong any more")
            self.ends_well()
        finally:
            for invocation in [*self.world.functions.waiting]:
                self.world.functions.kill(invocation)
