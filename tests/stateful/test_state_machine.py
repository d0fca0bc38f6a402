"""Messages and faults in any order and number: no participant is stranded, and nothing is left.

A stateful machine over participants, servers, warm servers and the sweep. The tests play the same examples every time; `make hunt`
plays others, and more of them. A run that fails prints its story.
"""

from __future__ import annotations

import pytest
from hypothesis import Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from hippodrome.control.limits.rules import ServerSlots, server_slots_key
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import ServerState
from hippodrome.control.servers import leftovers
from hippodrome.control.servers.leftovers import LeftoverReason
from hippodrome.control.servers.sweep import Sweep, SweepResult
from hippodrome.control.servers.termination import Termination
from hippodrome.control.servers.warm.handover import Handovers
from testing.exploration import examples
from testing.fake_platform import FakeDocuments
from testing.port_faults import FaultAt, PortFault
from testing.studies import study
from tests.stateful.mutations import Mutation, assert_noticed, written_unread
from tests.stateful.state_machine import Machine
from tests.stateful.world import World

PROFILE = settings(
    max_examples=examples(100),
    stateful_step_count=50,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
)
MUTATED = settings(PROFILE, max_examples=600, derandomize=True, phases=[Phase.generate])


@seed(3)
class SeededMachine(Machine):
    """The machine with a seed that notices every mutation within the first examples."""


@pytest.mark.explores
@pytest.mark.timeout(0)
def test_no_participant_is_stranded_and_nothing_is_left_by_any_messages_and_faults() -> None:
    run_state_machine_as_test(Machine, settings=PROFILE)


def test_an_assigned_warm_server_keeps_its_slot_if_another_delivery_cannot_start_a_server() -> None:
    world = World(study(max_servers=2, warm_servers=1), ("alice", "bob"))
    world.go_on()
    world.ask("bob")
    world.answer("bob", "1")
    start = next(message for message in world.queued if message.text == "start bob")
    world.repeat(start)
    world.deliver([start], FaultAt(3, PortFault.WAIT))  # the record is written, and no slot taken
    world.deliver_all("start")
    assert world.functions.waiting[0].waits_at == "documents.get"
    world.account.fleet.spot = world.account.fleet.demand = "refused"
    world.functions.go_on(world.functions.waiting[0])
    (bob,) = [record for record in world.records() if record.user_id == "bob"]
    held = from_json(world.account.kept[server_slots_key("maze")][0], ServerSlots).slots
    assert (bob.state, bob.label in held) == (ServerState.READY, True)


MUTATIONS = {
    "a record that was written over": Mutation(
        FakeDocuments,
        "replace",
        written_unread,
        r"its task is gone, and nobody will tell|two tasks run for|runs without a (place|timer)|is given twice|told to be",
    ),
    "an answer that was written over": Mutation(FakeDocuments, "create", written_unread, r"an answer changed"),
    "a sweep that takes what is starting": Mutation(
        leftovers,
        "why_left_over",
        lambda name, owner, scope, *, ours=False: owner and LeftoverReason.CLOSED,
        r"waits for ever: .*'state': '(starting|naming|queued)'|its task is gone, and nobody will tell|has no name"
        r"|sweep: \S+ of \S+, which is (starting|naming)",
    ),
    "a sweep that does nothing": Mutation(Sweep, "run", lambda sweep: SweepResult(), r"left behind: "),
    "names that stay": Mutation(
        Termination,
        "_delete_dns_records",
        lambda ending, going: None,
        r"there are names that were left over|left behind: .*'names'",
    ),
    "a warm server that is taken without asking its record": Mutation(
        Handovers,
        "_take_over",
        lambda giving, record: giving._repository.server(record.warm_server_label).server,
        r"is told to be .*'s, and is not|a warm server is given twice",
    ),
}


@pytest.mark.parametrize("what", MUTATIONS)
def test_the_machine_notices_the_mutation(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_noticed(MUTATIONS[what], SeededMachine, MUTATED, monkeypatch)
