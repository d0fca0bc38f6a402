"""Messages and faults in any order and number, for participants who play together."""

from __future__ import annotations

import pytest
from hypothesis import Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from hippodrome.control.servers.sweep import Sweep, SweepResult
from testing.exploration import examples
from testing.fake_platform import FakeDocuments
from tests.stateful.mutations import Mutation, assert_noticed, written_unread
from tests.stateful.session_machine import SessionMachine

pytestmark = pytest.mark.usefixtures("numbered_sessions")

PROFILE = settings(
    max_examples=examples(60),
    stateful_step_count=40,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
)
MUTATED = settings(PROFILE, max_examples=400, derandomize=True, phases=[Phase.generate])


@pytest.mark.explores
@pytest.mark.timeout(0)
def test_no_participant_is_stranded_and_no_group_split_or_merged_by_any_messages_and_faults() -> None:
    run_state_machine_as_test(SessionMachine, settings=PROFILE)


@seed(1)
class SeededMachine(SessionMachine):
    """The machine with a seed that notices every mutation within the first examples."""


MUTATIONS = {
    "a decision that was written over": Mutation(
        FakeDocuments,
        "replace",
        written_unread,
        r"in two sessions|does not know them|nobody will tell|waits for ever|two tasks run for|runs without a",
    ),
    "a membership that was written over": Mutation(
        FakeDocuments, "create", written_unread, r"a session changed|an answer changed"
    ),
    "a sweep that does nothing": Mutation(Sweep, "run", lambda sweep: SweepResult(), r"left behind: "),
}


@pytest.mark.parametrize("what", MUTATIONS)
def test_the_machine_notices_the_mutation(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_noticed(MUTATIONS[what], SeededMachine, MUTATED, monkeypatch)
