"""What a sweep does about a server that stays in a state for too long: a rule for each state. Pure.

Whatever should move a server on may be lost: a message that ended as a dead letter, an event of ECS that never came, a
function that was cut off more often than its queue brings the message again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from enum import StrEnum

from hippodrome.model import server
from hippodrome.model.server import Server, State
from hippodrome.ports import RunningTask

ASK_AGAIN = timedelta(minutes=3)  # what should have happened by now is asked for again
UNSEEN = timedelta(minutes=10)  # a server without a task for this long has lost it
HOPELESS = timedelta(minutes=20)  # a task that has not begun to run by now never will; nobody waits longer for another
OVERTIME = timedelta(minutes=5)  # past its deadline, the timer must have failed


class Remedy(StrEnum):
    """What is to be done."""

    START = "start"  # it is asked for again: the same attempt, which is made once
    RUNS = "runs"  # task_changed is told that its task runs
    NAME = "name"  # its name is made again, and looked at
    STOP = "stop"  # it is told to go again
    OVERDUE = "overdue"  # it is told to stop, for its time is over
    LOST = "lost"  # it is cleaned up after, and replaced if it should be
    REPLACE = "replace"  # the attempt after it is asked for again


Rule = Callable[[Server, RunningTask | None, datetime], Remedy | None]


def remedy(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """What a server needs whose living task this is, if it has one; None if nothing."""
    if not record.is_closed and now > record.deadline + OVERTIME:
        return Remedy.OVERDUE
    return RULES[record.state](record, task, now)


def _launch(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    waited = now - record.requested
    if task is None:
        return Remedy.LOST if waited > UNSEEN else Remedy.START if waited > ASK_AGAIN else None
    if task.runs and task.interface:
        return Remedy.RUNS if waited > ASK_AGAIN else None
    return Remedy.LOST if waited > HOPELESS else None


def _dns(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    if task is None:
        return _without_task(record, now)
    return Remedy.NAME if now > (record.running or record.requested) + ASK_AGAIN else None


def _ready(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    return _without_task(record, now) if task is None else None


def _draining(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """At once: its record does not say since when, and who is told twice to go has gone."""
    return Remedy.STOP


def _closed(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """What it left behind is removed wherever that is found; but the next attempt may not have been asked for."""
    if server.next_attempt(record) is None or record.closed is None:
        return None
    return Remedy.REPLACE if ASK_AGAIN < now - record.closed <= HOPELESS else None


def _without_task(record: Server, now: datetime) -> Remedy | None:
    return Remedy.LOST if now > record.requested + UNSEEN else None


def _queued(record: Server, task: RunningTask | None, now: datetime) -> Remedy | None:
    """Never on record: who waits without a record asks again by their page."""
    return None


RULES: Mapping[State, Rule] = {
    State.QUEUED: _queued,
    State.STARTING: _launch,
    State.NAMING: _dns,
    State.READY: _ready,
    State.DRAINING: _draining,
    State.CLOSED: _closed,
}
