"""Waits until the names of deleted queues and schedule groups are free again, so that a stack can be made with them.

SQS: "When you delete a queue, you must wait at least 60 seconds before creating a queue with the same name" (API
reference, DeleteQueue; QueueDeletedRecently otherwise). CloudFormation does not wait: the stack rolls back, which
deletes queues once more. So `wait` looks for queues that were deleted in the last minute by a destroyed stack, a failed
creation or an update that was rolled back, and waits for the rest of the minute.

EventBridge Scheduler: a deleted group is in the state DELETING until its schedules are deleted (user guide, "Deleting a
schedule group"); until then its name is taken.

CloudFormation refuses a change set whose names are taken (user guide, "Validate stack deployments": resource name
conflict detection). So the wait comes before the change set.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.core.stages import Executor

KEPT = {"AWS::SQS::Queue": 60.0}  # resource type → seconds that AWS keeps its name
MARGIN = 10.0  # seconds more: the events' times are CloudFormation's, not the service's
PAUSE = 5  # seconds between two looks at the schedule group
LONGEST = 300  # seconds to wait for the schedule group at most
_STACKS = 3  # of the stacks of one name, the events of this many are read, the newest first


def remaining(account: Account, stack: str) -> float:
    """Return the seconds until the names of the stack's deleted resources are all free again; 0 if they are."""
    client = account.client("cloudformation")
    pages = client.get_paginator("list_stacks").paginate()
    answers = list(pages)
    now = _now(answers[-1] if answers else {})
    stacks = [summary for page in answers for summary in page["StackSummaries"] if summary["StackName"] == stack]
    stacks.sort(key=_last_change, reverse=True)
    seconds = [0.0]
    for summary in stacks[:_STACKS]:
        for kind, at in _deleted(client, summary["StackId"], now):
            seconds.append(KEPT[kind] + MARGIN - (now - at).total_seconds())
    return min(max(seconds), max(KEPT.values()) + MARGIN)


def wait(account: Account, stack: str) -> None:
    """Wait until the names are free, with a progress bar."""
    executor = Executor()
    title = "EventBridge is still deleting the timers of an earlier stack: waiting for that"
    executor.wait(lambda: _group_is_deleting(account, stack), LONGEST, pause=PAUSE, title=title)
    seconds_left = round(remaining(account, stack))
    if seconds_left <= 0:
        return
    with screen.ProgressBars() as bar:
        task = bar.add_task(f"AWS keeps the names of deleted queues for a minute: {seconds_left} s", total=seconds_left)
        for _ in range(seconds_left):
            executor.sleep(1)
            bar.advance(task)


def _group_is_deleting(account: Account, group: str) -> bool:
    try:
        schedule_group = account.client("scheduler").get_schedule_group(Name=group)
    except ClientError:  # there is none, or these credentials may not look: CloudFormation will say
        return False
    return bool(schedule_group["State"] == "DELETING")


def _deleted(client: Any, stack_id: str, now: datetime) -> Iterator[tuple[str, datetime]]:
    """Yield the type and time of each resource in `KEPT` that was deleted in this stack lately."""
    longest = max(KEPT.values()) + MARGIN
    for page in client.get_paginator("describe_stack_events").paginate(StackName=stack_id):
        for event in page["StackEvents"]:  # newest first
            at = event["Timestamp"]
            if (now - at).total_seconds() > longest:
                return
            if event["ResourceType"] in KEPT and event["ResourceStatus"] == "DELETE_COMPLETE":
                yield event["ResourceType"], at


def _last_change(summary: Mapping[str, Any]) -> datetime:
    times = (summary.get(name) for name in ("DeletionTime", "LastUpdatedTime", "CreationTime"))
    return max((at for at in times if at), default=datetime.min.replace(tzinfo=UTC))


def _now(answer: Mapping[str, Any]) -> datetime:
    """Return the time by AWS's clock, from the answer's header `date`; without the header, by this machine's clock."""
    date = answer.get("ResponseMetadata", {}).get("HTTPHeaders", {}).get("date", "")
    try:
        return parsedate_to_datetime(date)
    except (TypeError, ValueError):
        return datetime.now(UTC)
