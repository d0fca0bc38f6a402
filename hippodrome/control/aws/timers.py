"""Sets one-time timers on EventBridge Scheduler, all in one schedule group.

Facts (EventBridge Scheduler User Guide and API Reference, read November 2026). `at(yyyy-mm-ddThh:mm:ss)` is UTC unless
a time zone is given. A schedule fires within the minute that begins at its time; `ActionAfterCompletion=DELETE` deletes
it then. A name has 1 to 64 characters of `[0-9a-zA-Z-_.]`. No page documents what a time in the past does, and
Scheduler has refused one (DefangLabs/pulumi-defang, pull request 425), so such a time becomes `MIN_DELAY` from now.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.ports import Message

MIN_DELAY = timedelta(seconds=20)  # a timer's time is at least so far ahead, so that the request comes before it
MAX_TRIES = 3  # attempts at both calls: another function may create or delete the timer between the two


class SchedulerTimers:
    """Implements `hippodrome.control.ports.Timers`. A timer fires between its time and a minute later."""

    def __init__(self, client: Callable[[], Any], need: Callable[[str], str], now: Callable[[], datetime]) -> None:
        self._client = client
        self._need = need
        self._now = now

    def set(self, name: str, at: datetime, message: Message) -> None:
        """Set the timer, or replace the one of the same name. Raises ValueError if `at` has no time zone.

        AWS calls: one CreateSchedule; if the name exists, an UpdateSchedule too.
        """
        if at.tzinfo is None:
            raise ValueError("a timer's time needs a time zone")
        schedule = self._schedule(name, max(at, self._now() + MIN_DELAY), message)
        for attempt in range(MAX_TRIES):
            try:
                self._client().create_schedule(**schedule)
            except ClientError as error:
                if errors.code(error) != "ConflictException":
                    raise
            else:
                return
            try:
                self._client().update_schedule(**schedule)
            except ClientError as error:
                if attempt + 1 == MAX_TRIES or errors.code(error) != "ResourceNotFoundException":
                    raise
            else:
                return

    def cancel(self, name: str) -> None:
        try:
            self._client().delete_schedule(GroupName=self._need("SCHEDULE_GROUP"), Name=name)
        except ClientError as error:
            if errors.code(error) != "ResourceNotFoundException":
                raise

    def list(self) -> Iterator[str]:
        """Yield the names of all timers that have not fired. AWS calls: one ListSchedules for each 100 timers."""
        pages = self._client().get_paginator("list_schedules").paginate(GroupName=self._need("SCHEDULE_GROUP"))
        for page in pages:
            for schedule in page["Schedules"]:
                yield schedule["Name"]

    def _schedule(self, name: str, at: datetime, message: Message) -> dict[str, Any]:
        return {
            "GroupName": self._need("SCHEDULE_GROUP"),
            "Name": name,
            "ScheduleExpression": f"at({at.astimezone(UTC):%Y-%m-%dT%H:%M:%S})",
            "ScheduleExpressionTimezone": "UTC",
            "FlexibleTimeWindow": {"Mode": "OFF"},
            "ActionAfterCompletion": "DELETE",
            "Target": {
                "Arn": self._need("STOP_SERVER_TOPIC_ARN"),
                "RoleArn": self._need("SCHEDULE_ROLE_ARN"),
                "Input": json.dumps(dict(message)),
                # Scheduler's largest values, because the stop message must arrive.
                "RetryPolicy": {"MaximumEventAgeInSeconds": 86_400, "MaximumRetryAttempts": 185},
            },
        }
