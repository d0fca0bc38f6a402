"""Decides what a sweep does about a server that stays in a state for too long: one rule per state. Pure.

The event that moves a server to its next state may be lost: a message goes to the dead-letter queue, an ECS event never
arrives, or a function is interrupted at every receive that its queue allows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from enum import StrEnum

from hippodrome.control.model.server import Server, ServerState, next_attempt
from hippodrome.control.ports import RunningTask

RETRY_AFTER = timedelta(minutes=3)  # if a server is not in its next state after this time, its message is sent again
LOST_AFTER = timedelta(minutes=10)  # a server that has no task after this time has lost it
NEVER_RUNS_AFTER = timedelta(minutes=20)  # a task that is not RUNNING after this time has failed
OVERDUE_AFTER = timedelta(minutes=5)  # if a server is open so long after its deadline, its timer has failed


class Remedy(StrEnum):
    """What the sweep does about a server."""

    START = "start"  # send the start message of the same attempt again
    RUNNING = "running"  # send task_changed the message that the task runs
    DNS = "dns"  # send task_changed the message to create the DNS record
    STOP = "stop"  # send the stop message again
    OVERDUE = "overdue"  # send a stop message, because the deadline is over
    LOST = "lost"  # clean up, and request the next attempt if there should be one
    REPLACE = "replace"  # request the next attempt again, and delete the timer


Rule = Callable[[Server, RunningTask | None, datetime], Remedy | None]


def remedy(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Return what the sweep does about this server; None if nothing has to be done.

    `task` is the server's living task; None if there is none.
    """
    if not record.is_closed and now > record.deadline + OVERDUE_AFTER:
        return Remedy.OVERDUE
    return RULES[record.state](record, task, now)


def _starting(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    waited = now - record.requested
    if task is None:
        return Remedy.LOST if waited > LOST_AFTER else Remedy.START if waited > RETRY_AFTER else None
    if task.runs and task.interface:
        return Remedy.RUNNING if waited > RETRY_AFTER else None
    return Remedy.LOST if waited > NEVER_RUNS_AFTER else None


def _naming(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    if task is None:
        return _without_task(record, now)
    if not record.dns:  # its certificate; the server gives up by itself if the authority refuses
        return Remedy.LOST if now > (record.running or record.requested) + LOST_AFTER else None
    return Remedy.DNS if now > (record.running or record.requested) + RETRY_AFTER else None


def _ready(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    return _without_task(record, now) if task is None else None


def _draining(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Stop it at once: the record does not say since when it drains, and a second stop message does no harm."""
    return Remedy.STOP


def _closed(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Request the next attempt, whose message may be lost. The sweep removes leftovers of closed servers anyway."""
    if next_attempt(record) is None or record.closed is None:
        return None
    return Remedy.REPLACE if RETRY_AFTER < now - record.closed <= NEVER_RUNS_AFTER else None


def _without_task(record: Server, now: datetime) -> Remedy | None:
    return Remedy.LOST if now > record.requested + LOST_AFTER else None


def _queued(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Do nothing: no record has this state. Without a record, the participant's waiting page requests the server."""
    return None


RULES: Mapping[ServerState, Rule] = {
    ServerState.QUEUED: _queued,
    ServerState.STARTING: _starting,
    ServerState.NAMING: _naming,
    ServerState.READY: _ready,
    ServerState.DRAINING: _draining,
    ServerState.CLOSED: _closed,
}
