"""The states of a CloudFormation stack, and what `apply` does about each of them.

The names are those of CloudFormation's API (Stack, StackStatus). What leads where: its user guide, "Stack status
codes", "Continue rolling back an update", "Choose how to handle failures when provisioning resources"; and the API's
RollbackStack, which leads out of CREATE_FAILED and UPDATE_FAILED.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from console.problem import Problem


class Act(Enum):
    """What `apply` does first."""

    MAKE = "make it"  # there is nothing, or an empty shell
    UPDATE = "bring it up to date"
    WAIT = "wait for what is going on"
    ANEW = "delete what is left of it, and make it anew"  # it never came to life
    ROLL_BACK = "take the failed update back"  # RollbackStack
    CONTINUE = "go on taking the failed update back"  # ContinueUpdateRollback
    STOP = "leave it to people"


ACTS: Mapping[str, Act] = {
    "CREATE_IN_PROGRESS": Act.WAIT,
    "CREATE_FAILED": Act.ANEW,
    "CREATE_COMPLETE": Act.UPDATE,
    "ROLLBACK_IN_PROGRESS": Act.WAIT,
    "ROLLBACK_FAILED": Act.ANEW,
    "ROLLBACK_COMPLETE": Act.ANEW,
    "DELETE_IN_PROGRESS": Act.WAIT,
    "DELETE_FAILED": Act.STOP,
    "DELETE_COMPLETE": Act.MAKE,
    "UPDATE_IN_PROGRESS": Act.WAIT,
    "UPDATE_COMPLETE_CLEANUP_IN_PROGRESS": Act.WAIT,
    "UPDATE_COMPLETE": Act.UPDATE,
    "UPDATE_FAILED": Act.ROLL_BACK,
    "UPDATE_ROLLBACK_IN_PROGRESS": Act.WAIT,
    "UPDATE_ROLLBACK_FAILED": Act.CONTINUE,
    "UPDATE_ROLLBACK_COMPLETE_CLEANUP_IN_PROGRESS": Act.WAIT,
    "UPDATE_ROLLBACK_COMPLETE": Act.UPDATE,
    "REVIEW_IN_PROGRESS": Act.MAKE,
    "IMPORT_IN_PROGRESS": Act.WAIT,
    "IMPORT_COMPLETE": Act.UPDATE,
    "IMPORT_ROLLBACK_IN_PROGRESS": Act.WAIT,
    "IMPORT_ROLLBACK_FAILED": Act.STOP,
    "IMPORT_ROLLBACK_COMPLETE": Act.UPDATE,
}

_BECAUSE = {
    "DELETE_FAILED": "is half deleted",
    "IMPORT_ROLLBACK_FAILED": "has taken in resources by hand, which failed and could not be taken back",
}


def act(status: str) -> Act:
    """What to do about a stack in that state ("": there is none). One that nobody knows here is left alone."""
    return ACTS.get(status, Act.STOP) if status else Act.MAKE


def broken(status: str) -> bool:
    """Whether the stack never came to life, so that only deleting helps."""
    return act(status) is Act.ANEW


def problem(stack: str, status: str) -> Problem:
    """What to tell about a stack that `apply` leaves to people."""
    because = _BECAUSE.get(status, "is in a state that this version does not know")
    return Problem(
        f"The stack {stack} {because} ({status}).",
        f"Remove it with `python -m deploy destroy --stack {stack}` (the data stay), then run the same command again.",
    )
