"""What a sweep does about a server that stays in a state for too long: one rule per state. Pure.

What moves a server to its next state may be lost: a message becomes a dead letter, an ECS event never arrives, or a
function is interrupted at every receive that its queue allows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from enum import StrEnum

from hippodrome.model.server import Server, ServerState, next_attempt
from hippodrome.ports import RunningTask

RETRY_AFTER = timedelta(minutes=3)  # a server should be in its next state by then: the message is sent again
LOST_AFTER = timedelta(minutes=10)  # a server without a task after this time has lost it
NEVER_RUNS_AFTER = timedelta(minutes=20)  # a task not RUNNING by then has failed; no participant waits longer either
OVERDUE_AFTER = timedelta(minutes=5)  # after the deadline: its timer must have failed


class Remedy(StrEnum):
    """What the sweep does."""

    START = "start"  # send the start message of the same attempt again; it is started once
    RUNNING = "running"  # tell task_changed that its task runs
    DNS = "dns"  # create its DNS record again, and check it
    STOP = "stop"  # send the stop message again
    OVERDUE = "overdue"  # send a stop message: its deadline is over
    LOST = "lost"  # clean up, and replace it if it should be
    REPLACE = "replace"  # request the next attempt again


Rule = Callable[[Server, RunningTask | None, datetime], Remedy | None]


def remedy(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """What to do about this server and its living task, if it has one; None if nothing has to be done."""
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
    return Remedy.DNS if now > (record.running or record.requested) + RETRY_AFTER else None


def _ready(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    return _without_task(record, now) if task is None else None


def _draining(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """At once: the record does not say since when it drains, and a second stop message does no harm."""
    return Remedy.STOP


def _closed(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """The sweep removes leftovers wherever it finds them; but the next attempt may not have been requested."""
    if next_attempt(record) is None or record.closed is None:
        return None
    return Remedy.REPLACE if RETRY_AFTER < now - record.closed <= NEVER_RUNS_AFTER else None


def _without_task(record: Server, now: datetime) -> Remedy | None:
    return Remedy.LOST if now > record.requested + LOST_AFTER else None


def _queued(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Never in a record: without one, the participant's waiting page asks again."""
    return None


RULES: Mapping[ServerState, Rule] = {
    ServerState.QUEUED: _queued,
    ServerState.STARTING: _starting,
    ServerState.NAMING: _naming,
    ServerState.READY: _ready,
    ServerState.DRAINING: _draining,
    ServerState.CLOSED: _closed,
}
