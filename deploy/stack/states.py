"""The states of a CloudFormation stack, and what `apply` does about each of them.

The names are those of CloudFormation's API (Stack, StackStatus). What leads where: its user guide, "Stack status
codes", "Continue rolling back an update", "Choose how to handle failures when provisioning resources"; and the API's
RollbackStack, which leads out of CREATE_FAILED and UPDATE_FAILED.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from console.problem import Problem


class Action(Enum):
    """The first thing that `apply` does."""

    CREATE = "make it"  # there is nothing, or an empty shell
    UPDATE = "bring it up to date"
    WAIT = "wait for what is going on"
    RECREATE = "delete what is left of it, and make it anew"  # it never came to life
    ROLL_BACK = "take the failed update back"  # RollbackStack
    CONTINUE = "go on taking the failed update back"  # ContinueUpdateRollback
    STOP = "leave it to the administrator"


ACTIONS: Mapping[str, Action] = {
    "CREATE_IN_PROGRESS": Action.WAIT,
    "CREATE_FAILED": Action.RECREATE,
    "CREATE_COMPLETE": Action.UPDATE,
    "ROLLBACK_IN_PROGRESS": Action.WAIT,
    "ROLLBACK_FAILED": Action.RECREATE,
    "ROLLBACK_COMPLETE": Action.RECREATE,
    "DELETE_IN_PROGRESS": Action.WAIT,
    "DELETE_FAILED": Action.STOP,
    "DELETE_COMPLETE": Action.CREATE,
    "UPDATE_IN_PROGRESS": Action.WAIT,
    "UPDATE_COMPLETE_CLEANUP_IN_PROGRESS": Action.WAIT,
    "UPDATE_COMPLETE": Action.UPDATE,
    "UPDATE_FAILED": Action.ROLL_BACK,
    "UPDATE_ROLLBACK_IN_PROGRESS": Action.WAIT,
    "UPDATE_ROLLBACK_FAILED": Action.CONTINUE,
    "UPDATE_ROLLBACK_COMPLETE_CLEANUP_IN_PROGRESS": Action.WAIT,
    "UPDATE_ROLLBACK_COMPLETE": Action.UPDATE,
    "REVIEW_IN_PROGRESS": Action.CREATE,
    "IMPORT_IN_PROGRESS": Action.WAIT,
    "IMPORT_COMPLETE": Action.UPDATE,
    "IMPORT_ROLLBACK_IN_PROGRESS": Action.WAIT,
    "IMPORT_ROLLBACK_FAILED": Action.STOP,
    "IMPORT_ROLLBACK_COMPLETE": Action.UPDATE,
}

_BECAUSE = {
    "DELETE_FAILED": "is half deleted",
    "IMPORT_ROLLBACK_FAILED": "has taken in resources by hand, which failed and could not be taken back",
}


def action_for(status: str) -> Action:
    """What to do about a stack in this state ("": there is none). Unknown states are left to the administrator."""
    return ACTIONS.get(status, Action.STOP) if status else Action.CREATE


def broken(status: str) -> bool:
    """Whether the stack was never complete, so that it can only be deleted."""
    return action_for(status) is Action.RECREATE


def problem(stack: str, status: str) -> Problem:
    """The problem of a stack that `apply` leaves to the administrator."""
    because = _BECAUSE.get(status, "is in a state that this version does not know")
    return Problem(
        f"The stack {stack} {because} ({status}).",
        f"Remove it with `python -m deploy destroy --stack {stack}` (the data stay), then run the same command again.",
    )
