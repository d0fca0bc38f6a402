"""The states of a CloudFormation stack, and what `apply` does about each of them.

The names come from CloudFormation's API (Stack, StackStatus). Sources for the ways out of a state: its user guide,
"Stack status codes", "Continue rolling back an update", "Choose how to handle failures when provisioning resources";
its API Reference, RollbackStack (the way out of CREATE_FAILED and UPDATE_FAILED).
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from hippodrome.console.problem import Problem


class StackAction(Enum):
    """The first thing that `apply` does about a stack."""

    CREATE = "make it"  # there is no stack, or one without resources
    UPDATE = "bring it up to date"
    WAIT = "wait for the present operation"
    RECREATE = "delete what is left of it, and make it anew"  # for a stack that was never complete
    ROLL_BACK = "take the failed update back"  # RollbackStack
    CONTINUE = "go on taking the failed update back"  # ContinueUpdateRollback
    STOP = "leave it to the administrator"


ACTIONS: Mapping[str, StackAction] = {
    "CREATE_IN_PROGRESS": StackAction.WAIT,
    "CREATE_FAILED": StackAction.RECREATE,
    "CREATE_COMPLETE": StackAction.UPDATE,
    "ROLLBACK_IN_PROGRESS": StackAction.WAIT,
    "ROLLBACK_FAILED": StackAction.RECREATE,
    "ROLLBACK_COMPLETE": StackAction.RECREATE,
    "DELETE_IN_PROGRESS": StackAction.WAIT,
    "DELETE_FAILED": StackAction.STOP,
    "DELETE_COMPLETE": StackAction.CREATE,
    "UPDATE_IN_PROGRESS": StackAction.WAIT,
    "UPDATE_COMPLETE_CLEANUP_IN_PROGRESS": StackAction.WAIT,
    "UPDATE_COMPLETE": StackAction.UPDATE,
    "UPDATE_FAILED": StackAction.ROLL_BACK,
    "UPDATE_ROLLBACK_IN_PROGRESS": StackAction.WAIT,
    "UPDATE_ROLLBACK_FAILED": StackAction.CONTINUE,
    "UPDATE_ROLLBACK_COMPLETE_CLEANUP_IN_PROGRESS": StackAction.WAIT,
    "UPDATE_ROLLBACK_COMPLETE": StackAction.UPDATE,
    "REVIEW_IN_PROGRESS": StackAction.CREATE,
    "IMPORT_IN_PROGRESS": StackAction.WAIT,
    "IMPORT_COMPLETE": StackAction.UPDATE,
    "IMPORT_ROLLBACK_IN_PROGRESS": StackAction.WAIT,
    "IMPORT_ROLLBACK_FAILED": StackAction.STOP,
    "IMPORT_ROLLBACK_COMPLETE": StackAction.UPDATE,
}

COMPLETE = {"CREATE_COMPLETE", "UPDATE_COMPLETE", "IMPORT_COMPLETE"}
"""The states of a stack whose last operation has succeeded."""

_BECAUSE = {
    "DELETE_FAILED": "is half deleted",
    "IMPORT_ROLLBACK_FAILED": "has taken in resources by hand, which failed and could not be taken back",
}


def action_for(status: str) -> StackAction:
    """Return what to do about a stack in this state ("": no stack). Unknown states are the administrator's task."""
    return ACTIONS.get(status, StackAction.STOP) if status else StackAction.CREATE


def problem(stack: str, status: str) -> Problem:
    """Explain a state of a stack that `apply` leaves to the administrator."""
    because = _BECAUSE.get(status, "is in a state that this version does not know")
    return Problem(
        f"The stack {stack} {because} ({status}).",
        f"Remove it with `hippodrome destroy --stack {stack}` (the data stay), then run the same command again.",
    )
