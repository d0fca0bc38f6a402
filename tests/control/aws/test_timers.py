"""What `SchedulerTimers` and `SnsBus` ask of AWS, beyond the contract."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta, timezone

import pytest
from botocore.exceptions import ClientError

from hippodrome.control.ports import Topic
from testing.moto_world import MotoWorld

NAME = "s" + "a" * 20 + "-1"
MESSAGE = {"projectId": "study", "userId": "P1"}


def test_the_scheduler_gets_the_parameters_of_the_timer(moto_world: MotoWorld) -> None:
    at = datetime(2031, 7, 1, 14, 30, 59, 999_999, tzinfo=timezone(timedelta(hours=-4)))
    moto_world.platform.timers.set(NAME, at, MESSAGE)
    [call] = moto_world.calls
    assert call.action == "scheduler:CreateSchedule"
    asked = call.params
    assert asked["ScheduleExpression"] == "at(2031-07-01T18:30:59)"
    assert asked["ActionAfterCompletion"] == "DELETE"
    assert asked["FlexibleTimeWindow"] == {"Mode": "OFF"}
    assert asked["GroupName"] == "hippodrome"
    assert asked["Target"]["Arn"] == moto_world.env["STOP_SERVER_TOPIC_ARN"]
    assert asked["Target"]["RoleArn"] == moto_world.env["SCHEDULE_ROLE_ARN"]
    assert asked["Target"]["RetryPolicy"] == {"MaximumEventAgeInSeconds": 86_400, "MaximumRetryAttempts": 185}
    assert json.loads(asked["Target"]["Input"]) == MESSAGE


def test_a_timer_for_a_time_in_the_past_is_set_to_20_seconds_from_now(moto_world: MotoWorld) -> None:
    timers = moto_world.platform.timers
    for ago in (timedelta(hours=1), timedelta(0), timedelta(seconds=-5)):
        timers.set(NAME, moto_world.platform.now() - ago, MESSAGE)
        at, _ = moto_world.timers()[NAME]
        assert timedelta(seconds=15) < at - datetime.now(UTC) <= timedelta(seconds=20)


def test_a_time_without_a_zone_is_a_mistake(moto_world: MotoWorld) -> None:
    with pytest.raises(ValueError, match="time zone"):
        moto_world.platform.timers.set(NAME, datetime(2031, 1, 1), MESSAGE)


def test_a_timer_that_fires_while_it_is_replaced_is_created_anew(moto_world: MotoWorld) -> None:
    moto_world.fail("scheduler:CreateSchedule", "ConflictException")
    moto_world.platform.timers.set(NAME, moto_world.platform.now() + timedelta(hours=1), MESSAGE)
    assert moto_world.actions == ["scheduler:CreateSchedule", "scheduler:UpdateSchedule", "scheduler:CreateSchedule"]
    assert list(moto_world.timers()) == [NAME]


def test_a_timer_that_can_be_neither_created_nor_replaced_raises_the_error(moto_world: MotoWorld) -> None:
    moto_world.fail("scheduler:CreateSchedule", "ConflictException", times=9)
    with pytest.raises(ClientError, match="ResourceNotFoundException"):
        moto_world.platform.timers.set(NAME, moto_world.platform.now(), MESSAGE)
    assert len(moto_world.calls) == 6


@pytest.mark.parametrize("code", ["ThrottlingException", "ValidationException", "AccessDeniedException"])
def test_other_errors_of_the_scheduler_are_raised_unchanged(moto_world: MotoWorld, code: str) -> None:
    timers = moto_world.platform.timers
    moto_world.fail("scheduler:CreateSchedule", code)
    with pytest.raises(ClientError, match=code):
        timers.set(NAME, moto_world.platform.now(), MESSAGE)
    moto_world.fail("scheduler:DeleteSchedule", code)
    with pytest.raises(ClientError, match=code):
        timers.cancel(NAME)


def test_schedules_of_other_groups_are_not_listed(moto_world: MotoWorld) -> None:
    moto_world.client("scheduler").create_schedule(
        Name="theirs",
        ScheduleExpression="at(2031-01-01T00:00:00)",
        FlexibleTimeWindow={"Mode": "OFF"},
        Target={"Arn": "arn:aws:sqs:us-east-1:123456789012:q", "RoleArn": "arn:aws:iam::123456789012:role/r"},
    )
    assert list(moto_world.platform.timers.list()) == []


def test_sns_and_sqs_get_the_parameters_of_the_message(moto_world: MotoWorld) -> None:
    bus = moto_world.platform.bus
    bus.publish(Topic.STOP, MESSAGE)
    bus.send_delayed(MESSAGE, 30)
    publish, send = moto_world.calls
    assert (publish.action, send.action) == ("sns:Publish", "sqs:SendMessage")
    assert publish.params["TopicArn"] == moto_world.env["STOP_SERVER_TOPIC_ARN"]
    assert send.params["DelaySeconds"] == 30
    assert json.loads(publish.params["Message"]) == json.loads(send.params["MessageBody"]) == MESSAGE
    assert moto_world.receive("task")["Records"] == []


@pytest.mark.parametrize("seconds", [-1, 901])
def test_a_delay_that_sqs_does_not_accept_raises_value_error(moto_world: MotoWorld, seconds: int) -> None:
    with pytest.raises(ValueError, match="0 to 900"):
        moto_world.platform.bus.send_delayed(MESSAGE, seconds)


def test_without_raw_delivery_a_message_comes_in_an_envelope() -> None:
    with MotoWorld(raw_delivery=False) as world:
        world.platform.bus.publish(Topic.START, MESSAGE)
        [record] = world.receive("start")["Records"]
        envelope = json.loads(record["body"])
        assert envelope["Type"] == "Notification"
        assert json.loads(envelope["Message"]) == MESSAGE


def test_an_installation_works_in_another_region() -> None:
    with MotoWorld(region="ca-central-1") as world:
        world.platform.documents.create("a.json", b"{}")
        world.platform.bus.publish(Topic.START, MESSAGE)
        assert len(world.receive("start")["Records"]) == 1
