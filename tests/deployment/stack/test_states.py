"""Every state that a stack may have: what `apply` prints and does, and that the next run continues from there."""

from __future__ import annotations

from typing import Any

import botocore.session
import pytest

from hippodrome.console.problem import Problem
from hippodrome.deployment.lifecycle.apply import apply, plan
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.settings import StackSettings
from hippodrome.deployment.stack.states import StackAction
from testing.exploration import sample
from tests.deployment.fake_cloudformation import Step, happy
from tests.deployment.stack_world import DOMAIN, World

CLOUDFORMATION = botocore.session.get_session().get_service_model("cloudformation")
STATES: list[str] = CLOUDFORMATION.shape_for("StackStatus").enum
FIRST = StackSettings(domain=DOMAIN)
DELETED: list[Step] = [("DELETE_IN_PROGRESS", []), ("DELETE_COMPLETE", [])]
TAKEN_BACK: list[Step] = [("UPDATE_ROLLBACK_IN_PROGRESS", []), ("UPDATE_ROLLBACK_COMPLETE", [])]
WORKS = {
    "CREATE_COMPLETE",
    "UPDATE_COMPLETE",
    "UPDATE_ROLLBACK_COMPLETE",
    "IMPORT_COMPLETE",
    "IMPORT_ROLLBACK_COMPLETE",
}

ENDS = {  # the possible ends of each operation in progress
    "CREATE_IN_PROGRESS": ["CREATE_COMPLETE", "CREATE_FAILED", "ROLLBACK_COMPLETE"],
    "ROLLBACK_IN_PROGRESS": ["ROLLBACK_COMPLETE", "ROLLBACK_FAILED"],
    "DELETE_IN_PROGRESS": ["DELETE_COMPLETE", "DELETE_FAILED"],
    "UPDATE_IN_PROGRESS": ["UPDATE_COMPLETE", "UPDATE_FAILED", "UPDATE_ROLLBACK_FAILED"],
    "UPDATE_COMPLETE_CLEANUP_IN_PROGRESS": ["UPDATE_COMPLETE"],
    "UPDATE_ROLLBACK_IN_PROGRESS": ["UPDATE_ROLLBACK_COMPLETE", "UPDATE_ROLLBACK_FAILED"],
    "UPDATE_ROLLBACK_COMPLETE_CLEANUP_IN_PROGRESS": ["UPDATE_ROLLBACK_COMPLETE"],
    "IMPORT_IN_PROGRESS": ["IMPORT_COMPLETE", "IMPORT_ROLLBACK_FAILED"],
    "IMPORT_ROLLBACK_IN_PROGRESS": ["IMPORT_ROLLBACK_COMPLETE", "IMPORT_ROLLBACK_FAILED"],
}


def what_follows(status: str) -> list[list[Step]]:
    """Return the operations that CloudFormation executes for `apply` in that state."""
    return {
        StackAction.RECREATE: [list(DELETED)],
        StackAction.ROLL_BACK: [list(TAKEN_BACK)],
        StackAction.CONTINUE: [list(TAKEN_BACK)],
    }.get(states.action_for(status), [])


def test_every_state_of_a_stack_has_an_action() -> None:
    assert set(states.ACTIONS) == set(STATES)
    assert set(ENDS) == {status for status in STATES if states.action_for(status) is StackAction.WAIT}


@pytest.mark.explores
@pytest.mark.parametrize(
    ("status", "end"), sample([(status, end) for status in STATES for end in ENDS.get(status, [None])], 3)
)
def test_from_any_state_a_run_or_the_advised_remedy_and_a_run_succeed(
    world: World, status: str, end: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    world.stand(status)
    world.cloud.script = [(status, []), (end, [])] if end else []
    world.cloud.operations = what_follows(end or status)
    try:
        apply(world.account, "hippodrome", FIRST)
    except Problem as problem:
        assert states.action_for(end or status) is StackAction.STOP
        assert str(problem).count(". ") == 0, "one sentence"
        assert problem.advice.startswith("Remove it with `hippodrome destroy --stack hippodrome` (the data stay)")
        assert not world.cloud.called("create_change_set")
        world.cloud.operations = [list(DELETED)]
        world.cloud.delete_stack(StackName="hippodrome")  # destroy does this
        apply(world.account, "hippodrome", FIRST)
    assert world.cloud.stack is not None
    assert world.cloud.stack["StackStatus"] in WORKS
    assert not apply_again(world).changed
    if status in ENDS:
        assert f"The stack hippodrome is in {status}: waiting for that first." in capsys.readouterr().err


def apply_again(world: World) -> Any:
    world.cloud.text = world.built.text
    return apply(world.account, "hippodrome", StackSettings())


@pytest.mark.explores
@pytest.mark.parametrize("status", sample(STATES, 3))
def test_from_any_state_plan_gives_a_plan_or_a_problem_with_advice(world: World, status: str) -> None:
    world.stand(status)
    try:
        found = plan(world.account, "hippodrome", FIRST)
    except Problem as problem:
        assert states.action_for(status) in {
            StackAction.WAIT,
            StackAction.STOP,
            StackAction.ROLL_BACK,
            StackAction.CONTINUE,
        }
        assert problem.advice
    else:
        made = states.action_for(status) in {StackAction.CREATE, StackAction.RECREATE}
        assert found.kind == ("create" if made else "nothing")
    assert not world.cloud.calls or {name for name, _ in world.cloud.calls} == {"get_template"}


def test_a_stack_in_an_unknown_state_is_left_alone(world: World) -> None:
    world.stand("PAUSED_COMPLETE")
    with pytest.raises(Problem, match="does not know"):
        apply(world.account, "hippodrome", FIRST)
    assert world.cloud.calls == []


def test_a_failed_update_is_rolled_back_before_the_next(world: World) -> None:
    """In UPDATE_FAILED, the end of a failed update without rollback, CloudFormation accepts no change set with rollback."""
    world.stand("UPDATE_FAILED")
    world.cloud.operations = [list(TAKEN_BACK)]
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=30)).changed
    assert [name for name, _ in world.cloud.calls if name in {"rollback_stack", "execute_change_set"}] == [
        "rollback_stack",
        "execute_change_set",
    ]


def test_an_update_that_cannot_be_rolled_back_says_why(world: World) -> None:
    reason = "Resource handler returned message: Access denied"
    world.stand("UPDATE_FAILED")
    failed: list[Step] = [
        ("UPDATE_ROLLBACK_IN_PROGRESS", [("Sweep", "AWS::Lambda::Function", "UPDATE_FAILED", reason)]),
        ("UPDATE_ROLLBACK_FAILED", []),
    ]
    world.cloud.operations = [failed]
    with pytest.raises(Problem, match="The update could not be taken back") as caught:
        apply(world.account, "hippodrome", FIRST)
    assert any(reason in line for line in caught.value.details)
    world.cloud.operations = [list(TAKEN_BACK), happy("UPDATE")]
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=30)).changed
